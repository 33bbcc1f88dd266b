//! Payloads, their layout, and what may be said in them.

mod decision;
mod forecast;
mod item_scores;
mod narration;
mod person_forecasts;
mod person_scores;
mod robot_report;
mod room_scores;
mod status;

pub use decision::{DecisionV1, REASON_TEXT_BYTES, action, decision_flags};
pub use forecast::{ForecastV1, MAX_HORIZONS, forecast_flags, probability_at};
pub use item_scores::{ItemScoreV1, ItemScoresHeaderV1, MAX_ITEMS, NO_PARTITION};
pub use narration::{NARRATION_TEXT_BYTES, NarrationV1, narration_kind};
pub use person_forecasts::{LEARNED_SHARE_S, PersonForecastV1, PersonForecastsV1};
pub use person_scores::{MAX_PERSONS, PersonScoresV1, PersonV1, person_flags, presence};
pub use robot_report::{NOTE_TEXT_BYTES, RobotReportV1, report_flags, report_kind};
pub use room_scores::{ALL_PERSONS, IncludedV1, MAX_ROOMS, MAX_SOURCES, RoomScoresV1, RoomV1, reached, score_flags};
pub use status::{StatusRequestV1, StatusResponseV1};

use iceoryx2::prelude::ZeroCopySend;

use crate::MessageError;

/// Bytes of a name in a message (room, item, label, policy), UTF-8, zero padded.
pub const NAME_BYTES: usize = 48;

/// One field of a message, for documentation and for other languages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// Bytes from the start of the message.
    pub offset: usize,
    /// Its name.
    pub name: &'static str,
    /// Its Rust type; arrays are stored in order, without gaps.
    pub kind: &'static str,
    /// Bytes.
    pub size: usize,
}

/// A structure without padding: each byte belongs to a field.
pub trait Layout {
    /// iceoryx2's name of the type, the same in every language.
    const TYPE_NAME: &'static str;
    /// Every field in order; together they cover the structure without gaps.
    const FIELDS: &'static [Field];
}

/// A structure that can be written to a log and read back.
pub trait ByteImage: Sized {
    /// The message's bytes in order, as they lie in shared memory: for a log that must give back every bit.
    ///
    /// ```
    /// use roomcast_ipc::raw::{ByteImage, NarrationV1, narration_kind};
    ///
    /// let message = NarrationV1::new(narration_kind::SENTENCE, "They grab the mug.")?;
    /// assert_eq!(NarrationV1::from_bytes(&message.to_bytes()), Some(message));
    /// assert_eq!(NarrationV1::from_bytes(b"too short"), None);
    /// # Ok::<(), roomcast_ipc::MessageError>(())
    /// ```
    fn to_bytes(&self) -> Vec<u8>;

    /// The message of these bytes; `None` if there are too many or too few. Check the message as one from an unknown sender.
    fn from_bytes(bytes: &[u8]) -> Option<Self>;
}

/// Quality of service of a publish-subscribe service. The first participant's settings hold until all participants have closed the
/// service, so each participant states all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ServiceQuality {
    /// Service name; the event service that wakes subscribers has the same.
    pub name: &'static str,
    /// Most publishers.
    pub publishers: usize,
    /// Most subscribers.
    pub subscribers: usize,
    /// Samples that wait for a subscriber; the oldest gives way.
    pub buffer: usize,
    /// Samples that a late subscriber gets.
    pub history: usize,
}

/// A message of a publish-subscribe service.
pub trait Message: Layout + Copy + Default + std::fmt::Debug + ZeroCopySend + 'static {
    /// Its service.
    const SERVICE: ServiceQuality;

    /// Judges a copy of a message: lengths, text, ranges. Nothing of a message may be believed before.
    ///
    /// # Errors
    ///
    /// The first fault, with the field's name.
    fn check(&self) -> Result<(), MessageError>;
}

/// All bytes zero, and a way from and to bytes.
pub(crate) trait Zero: Sized {
    const ZERO: Self;
    fn put(&self, out: &mut Vec<u8>);
    fn take(bytes: &mut &[u8]) -> Option<Self>;
}

macro_rules! zero {
    ($($kind:ty = $zero:expr),*) => { $(impl Zero for $kind {
        const ZERO: Self = $zero;

        fn put(&self, out: &mut Vec<u8>) {
            out.extend(self.to_le_bytes());
        }

        fn take(bytes: &mut &[u8]) -> Option<Self> {
            let (head, tail) = bytes.split_first_chunk()?;
            *bytes = tail;
            Some(Self::from_le_bytes(*head))
        }
    })* };
}
zero!(u8 = 0, u16 = 0, u32 = 0, u64 = 0, f32 = 0.0, f64 = 0.0);

impl<T: Zero + Copy, const N: usize> Zero for [T; N] {
    const ZERO: Self = [T::ZERO; N];

    fn put(&self, out: &mut Vec<u8>) {
        self.iter().for_each(|element| element.put(out));
    }

    fn take(bytes: &mut &[u8]) -> Option<Self> {
        let mut array = Self::ZERO;
        for element in &mut array {
            *element = T::take(bytes)?;
        }
        Some(array)
    }
}

/// Defines a structure with its offsets written down, and refuses to compile when they are wrong or leave gaps.
macro_rules! layout {
    (
        $(#[doc = $doc:literal])*
        #[type_name($type_name:tt)]
        pub struct $name:ident [$size:literal] {
            $($(#[doc = $field_doc:literal])* $offset:literal => $field:ident: $kind:ty,)*
        }
    ) => {
        $(#[doc = $doc])*
        #[doc = ""]
        #[doc = concat!("Size ", $size, " bytes, type name `", $type_name, "`.")]
        #[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
        #[repr(C)]
        #[type_name($type_name)]
        pub struct $name {
            $($(#[doc = $field_doc])* #[doc = concat!("(Offset ", $offset, ".)")] pub $field: $kind,)*
        }

        impl $crate::message::Layout for $name {
            const TYPE_NAME: &'static str = $type_name;
            const FIELDS: &'static [$crate::message::Field] = &[
                $($crate::message::Field {
                    offset: $offset,
                    name: stringify!($field),
                    kind: stringify!($kind),
                    size: size_of::<$kind>(),
                },)*
            ];
        }

        impl $crate::message::ByteImage for $name {
            fn to_bytes(&self) -> Vec<u8> {
                let mut bytes = Vec::with_capacity(size_of::<Self>());
                $crate::message::Zero::put(self, &mut bytes);
                bytes
            }

            fn from_bytes(mut bytes: &[u8]) -> Option<Self> {
                let message = <Self as $crate::message::Zero>::take(&mut bytes)?;
                bytes.is_empty().then_some(message)
            }
        }

        const _: () = {
            let mut end = 0;
            $(
                assert!($offset == end, "a gap or an overlap before this field");
                assert!(std::mem::offset_of!($name, $field) == $offset);
                end += size_of::<$kind>();
            )*
            assert!(end == $size && size_of::<$name>() == $size);
        };

        impl $crate::message::Zero for $name {
            const ZERO: Self = Self { $($field: <$kind as $crate::message::Zero>::ZERO,)* };

            fn put(&self, out: &mut Vec<u8>) {
                $($crate::message::Zero::put(&self.$field, out);)*
            }

            fn take(bytes: &mut &[u8]) -> Option<Self> {
                Some(Self { $($field: $crate::message::Zero::take(bytes)?,)* })
            }
        }

        impl Default for $name {
            /// All bytes zero.
            fn default() -> Self {
                <Self as $crate::message::Zero>::ZERO
            }
        }
    };
}
pub(crate) use layout;

/// Refuses values that are not finite or outside `low..=high`.
fn in_range(field: &'static str, value: f64, low: f64, high: f64, allowed: &'static str) -> Result<(), MessageError> {
    if value >= low && value <= high { Ok(()) } else { Err(MessageError::OutOfRange { field, value, allowed }) }
}

/// Refuses a list that holds the same name twice: a look-up would give either.
fn distinct<'a>(
    field: &'static str,
    names: impl Iterator<Item = &'a [u8; NAME_BYTES]> + Clone,
) -> Result<(), MessageError> {
    let mut rest = names;
    while let Some(name) = rest.next() {
        if rest.clone().any(|other| other == name) {
            return Err(MessageError::Twice { field });
        }
    }
    Ok(())
}

/// Refuses a count above the capacity of its array.
fn at_most(field: &'static str, count: u32, capacity: usize, allowed: &'static str) -> Result<(), MessageError> {
    if count as usize <= capacity {
        Ok(())
    } else {
        Err(MessageError::OutOfRange { field, value: f64::from(count), allowed })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_type_name_is_the_one_that_iceoryx2_compares() {
        // SAFETY: reading a type's name touches no memory of the type.
        #[expect(unsafe_code, reason = "the trait's method is unsafe to call")]
        let name = unsafe { <NarrationV1 as ZeroCopySend>::type_name() };
        assert_eq!(name, NarrationV1::TYPE_NAME);
    }
}
