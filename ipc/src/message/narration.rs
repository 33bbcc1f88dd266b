use iceoryx2::prelude::ZeroCopySend;

use super::{Message, NAME_BYTES, ServiceQuality, layout};
use crate::{MessageError, text};

/// Most bytes of a narration's text.
pub const NARRATION_TEXT_BYTES: usize = 1024;

/// Most persons that one narration may count.
pub const COUNT_MAX: usize = 8;

/// Values of [`NarrationV1::kind`].
pub mod narration_kind {
    /// A plain sentence from any captioning source: "They grab the mug."
    pub const SENTENCE: u32 = 0;
    /// An atomic action in VirtualHome's notation: `[Grab] <mug> (1)`.
    pub const ACTION: u32 = 1;
    /// A device's state: "the oven is on".
    pub const DEVICE: u32 = 2;
    /// Where a person is, without an action that a language model could read: `present`, `present in the kitchen`, `away`, `gone`. Or
    /// the state of a sensor, as JSON.
    pub const PRESENCE: u32 = 3;
}

layout! {
    /// One observation of a person, from a narrator: an action that is complete, a device state, or a sentence.
    ///
    /// `(source, epoch, sequence)` names it for good: what a narrator sends again under the same name is not taken twice.
    #[type_name("roomcast.NarrationV1")]
    pub struct NarrationV1 [1216] {
        /// The narrator, the same over restarts; 0 is not allowed.
        0 => source: u64,
        /// Random per start of the narrator.
        8 => epoch: u64,
        /// 1, 2, 3, ... within the epoch.
        16 => sequence: u64,
        /// When it was observed: monotonic nanoseconds.
        24 => observed_ns: u64,
        /// When it was observed: Unix nanoseconds, for people.
        32 => observed_unix_ns: u64,
        /// Which person, where `person_name` is empty; each has a history of its own. [`crate::raw::ALL_PERSONS`] is an unknown
        /// person: the daemon weighs the event for all persons.
        40 => person: u32,
        /// One of [`narration_kind`].
        44 => kind: u32,
        /// Bytes of text that follow in `text`, 1 to 1 024.
        48 => text_bytes: u32,
        /// Minor version of the layout: 1, which has `person_name`, [`narration_kind::PRESENCE`] and somebody; `count` is 0 in older ones.
        52 => minor: u32,
        /// The narrator's name, for people.
        56 => source_name: [u8; NAME_BYTES],
        /// The person's name, UTF-8, zero padded; empty where `person` says who it is.
        104 => person_name: [u8; NAME_BYTES],
        /// The number of persons that the narrator counted, at most 8; 0 if it counted none.
        152 => count: u32,
        /// Zero.
        156 => reserved: [u8; 36],
        /// The text, UTF-8, the rest zero.
        192 => text: [u8; NARRATION_TEXT_BYTES],
    }
}

impl NarrationV1 {
    /// A message with this text; the narrator's port fills in source, epoch and sequence.
    ///
    /// # Errors
    ///
    /// [`MessageError`] when the text is empty, too long or has control characters.
    ///
    /// ```
    /// use roomcast_ipc::raw::{NarrationV1, narration_kind};
    ///
    /// let message = NarrationV1::new(narration_kind::ACTION, "[Grab] <mug> (1)")?;
    /// assert_eq!(message.text(), "[Grab] <mug> (1)");
    /// assert!(NarrationV1::new(narration_kind::SENTENCE, "two\nlines").is_err());
    /// # Ok::<(), roomcast_ipc::MessageError>(())
    /// ```
    pub fn new(kind: u32, content: &str) -> Result<Self, MessageError> {
        if content.is_empty() {
            return Err(MessageError::Empty { field: "text" });
        }
        let text = text::encode("text", content)?;
        #[expect(clippy::cast_possible_truncation, reason = "it fits into 1024 bytes")]
        let text_bytes = content.len() as u32;
        Ok(Self { kind, text, text_bytes, minor: 1, ..Self::default() })
    }

    /// The text of a checked message; empty when it was not checked and is malformed.
    #[must_use]
    pub fn text(&self) -> &str {
        text::checked(&self.text)
    }

    /// The person's name of a checked message; empty where `person` says who it is.
    #[must_use]
    pub fn person_name(&self) -> &str {
        text::checked(&self.person_name)
    }

    /// The number of persons of a checked message.
    #[must_use]
    pub fn counted(&self) -> u8 {
        self.count.try_into().unwrap_or_default()
    }

    /// The narrator's name of a checked message.
    #[must_use]
    pub fn source_name(&self) -> &str {
        text::checked(&self.source_name)
    }
}

impl Message for NarrationV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/narration", publishers: 8, subscribers: 4, buffer: 256, history: 32 };

    fn check(&self) -> Result<(), MessageError> {
        for (field, value) in [("source", self.source), ("epoch", self.epoch), ("sequence", self.sequence)] {
            if value == 0 {
                return Err(MessageError::OutOfRange { field, value: 0.0, allowed: "not 0" });
            }
        }
        super::at_most("kind", self.kind, narration_kind::PRESENCE as usize, "0 to 3")?;
        super::at_most("count", self.count, COUNT_MAX, "0 to 8")?;
        super::at_most("text_bytes", self.text_bytes, NARRATION_TEXT_BYTES, "1 to 1024")?;
        let content = text::decode("text", &self.text)?;
        if content.is_empty() {
            return Err(MessageError::Empty { field: "text" });
        }
        if content.len() != self.text_bytes as usize {
            return Err(MessageError::OutOfRange {
                field: "text_bytes",
                value: f64::from(self.text_bytes),
                allowed: "the number of bytes before the first zero",
            });
        }
        text::decode("source_name", &self.source_name)?;
        text::decode("person_name", &self.person_name)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> NarrationV1 {
        NarrationV1 { source: 7, epoch: 1, sequence: 1, ..NarrationV1::new(0, "They grab the mug.").unwrap() }
    }

    #[test]
    fn a_good_message_passes() {
        good().check().unwrap();
    }

    #[test]
    fn each_fault_is_named() {
        let faults = [
            NarrationV1 { source: 0, ..good() },
            NarrationV1 { sequence: 0, ..good() },
            NarrationV1 { kind: 9, ..good() },
            NarrationV1 { count: 9, ..good() },
            NarrationV1 { text_bytes: 5000, ..good() },
            NarrationV1 { text_bytes: 3, ..good() },
            NarrationV1 { text: [0xff; NARRATION_TEXT_BYTES], text_bytes: 1024, ..good() },
            NarrationV1 { text: [0; NARRATION_TEXT_BYTES], text_bytes: 0, ..good() },
            NarrationV1 { source_name: [0x1b; NAME_BYTES], ..good() },
        ];
        for fault in faults {
            fault.check().unwrap_err();
        }
        assert!(NarrationV1::new(0, &"a".repeat(1025)).is_err());
        NarrationV1 { text_bytes: 1024, text: [b'a'; NARRATION_TEXT_BYTES], ..good() }.check().unwrap();
    }
}
