//! The parts of the forecasts, once: experts, and contexts of counts. Each can be left out, to measure how much it adds. The language model and the
//! shipped forecast always stay.
//!
//! A key of counts has 64 bits: the part, the person's slot, and three numbers. Up to three things are stored exactly. A longer context is a digest of
//! 48 bits; two contexts collide once in 10^14.

/// Greatest sum of observations: ten observations a second for a century make a third of it.
pub(crate) const MOST: f64 = 1e11;

pub(crate) const NONE: u16 = u16::MAX;
/// Bits of the slot; the bits above hold how often the last thing was mentioned in a row.
pub(crate) const SLOT_MASK: u8 = 0x3f;
/// Most mentions in a row that are counted apart.
pub(crate) const TIMES_MAX: u8 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Number {
    Object,
    Place,
    Plain,
}

macro_rules! parts {
    (experts { $($expert:ident = $expert_number:literal $expert_name:literal,)* }
     contexts { $($context:ident = $number:literal $name:literal [$($is:ident)*],)* }) => {
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        #[repr(u8)]
        pub(crate) enum Part { $($expert = $expert_number,)* $($context = $number,)* }

        impl Part {
            const NAMES: &'static [(Self, &'static str)] =
                &[$((Self::$expert, $expert_name),)* $((Self::$context, $name),)*];
            /// The contexts, each with the meanings of the key's three numbers and of the counted symbol.
            const CONTEXTS: &'static [(Self, [Number; 4])] = &[$((Self::$context, [$(Number::$is),*]),)*];
        }
    };
}

parts! {
    experts {
        ThingHabit = 40 "thing-habit",
        ThingHour = 41 "thing-hour",
        ThingProduct = 42 "thing-product",
        AgainHabit = 43 "again-habit",
        AgainShare = 44 "again-share",
        RoomHabit = 45 "room-habit",
        RoomShort = 46 "room-short",
        RoomThings = 47 "room-things",
        RoomHour = 48 "room-hour",
        RoomDwell = 49 "room-dwell",
        RoomProduct = 50 "room-product",
        Leaving = 51 "leaving",
        ByPlace = 52 "by-place",
        Later = 53 "later",
    }
    // The database holds these numbers: those of removed contexts stay unused.
    contexts {
        ThingAfter0 = 1 "thing-after-0" [Plain Plain Plain Object],
        ThingAfter1 = 2 "thing-after-1" [Object Plain Plain Object],
        ThingAfter2 = 3 "thing-after-2" [Object Object Plain Object],
        ThingAfter3 = 4 "thing-after-3" [Object Object Object Object],
        // A digest.
        ThingAfter4 = 5 "thing-after-4" [Plain Plain Plain Object],
        ThingAfter5 = 6 "thing-after-5" [Plain Plain Plain Object],
        ThingAtHour = 11 "thing-at-hour" [Plain Plain Plain Object],
        ThingAfter1AtHour = 12 "thing-after-1-at-hour" [Object Plain Plain Object],
        AgainAfter0 = 7 "again-after-0" [Plain Plain Plain Plain],
        AgainAfter1 = 8 "again-after-1" [Object Plain Plain Plain],
        AgainAfter2 = 9 "again-after-2" [Object Object Plain Plain],
        AgainAfter3 = 10 "again-after-3" [Object Object Object Plain],
        RoomOfThing = 13 "room-of-thing" [Object Plain Plain Place],
        RoomAfterRoom = 14 "room-after-room" [Place Plain Plain Place],
        RoomAfter1 = 15 "room-after-1" [Object Plain Plain Place],
        RoomAfter2 = 16 "room-after-2" [Object Object Plain Place],
        RoomAfter3 = 17 "room-after-3" [Object Object Object Place],
        RoomByHour = 18 "room-by-hour" [Place Plain Plain Place],
        RoomByDwell = 31 "room-by-dwell" [Place Plain Plain Place],
        // Exits and time spent.
        Stay = 19 "stay" [Plain Plain Plain Plain],
        StayByPlace = 20 "stay-by-place" [Place Plain Plain Plain],
        StayByHour = 21 "stay-by-hour" [Place Plain Plain Plain],
        // Where a stay leads.
        Exit = 22 "exit" [Place Plain Plain Place],
        ExitByHour = 23 "exit-by-hour" [Place Plain Plain Place],
        // The place a horizon later.
        LaterByPlace = 24 "later-by-place" [Place Plain Plain Place],
        LaterByHour = 25 "later-by-hour" [Place Plain Plain Place],
        LaterByDwell = 26 "later-by-dwell" [Place Plain Plain Place],
    }
}

impl Part {
    /// The context with this number in a file, unless it was removed, and what its numbers are.
    pub(crate) fn context(number: u8) -> Option<(Self, [Number; 4])> {
        Self::CONTEXTS.iter().copied().find(|(part, _)| *part as u8 == number)
    }
}

/// Parts of the forecasts that are left out; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Without(u64);

impl Without {
    /// The names of all parts.
    pub fn names() -> impl Iterator<Item = &'static str> {
        Part::NAMES.iter().map(|(_, name)| *name)
    }

    /// Without one more part; `None` if there is none of this name.
    #[must_use]
    pub fn and(self, name: &str) -> Option<Self> {
        let (part, _) = Part::NAMES.iter().find(|(_, own)| *own == name)?;
        Some(Self(self.0 | 1 << *part as u8))
    }

    pub(crate) fn uses(self, part: Part) -> bool {
        self.0 >> part as u8 & 1 == 0
    }
}

pub(crate) fn key(part: Part, slot: u8, after: [u16; 3]) -> u64 {
    let [first, second, third] = after.map(u64::from);
    (part as u64) << 56 | u64::from(slot) << 48 | first << 32 | second << 16 | third
}

/// The kind of context, the slot and the numbers of a key.
pub(crate) fn split(key: u64) -> (u8, u8, [u16; 3]) {
    ((key >> 56) as u8, (key >> 48) as u8, [(key >> 32) as u16, (key >> 16) as u16, key as u16])
}

/// Hashes a context that is longer than three things.
pub(crate) fn digest(context: &[u16]) -> [u16; 3] {
    // The finaliser of splitmix64 after each number. The database holds the result.
    let digest = context.iter().fold(0u64, |sum, number| {
        let mut hash = (sum ^ u64::from(*number)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        hash ^ (hash >> 31)
    });
    [(digest >> 32) as u16, (digest >> 16) as u16, digest as u16]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_can_be_taken_apart() {
        for (part, layout) in Part::CONTEXTS {
            assert_eq!(split(key(*part, 63, [1, NONE, 0xabcd])), (*part as u8, 63, [1, NONE, 0xabcd]));
            assert_eq!(Part::context(*part as u8), Some((*part, *layout)));
        }
        // Existing databases hold this value.
        assert_eq!(digest(&[1, 2, 3, 4, 5]), [27063, 5733, 20958]);
        assert_ne!(digest(&[1, 2, 3, 4]), digest(&[2, 1, 3, 4]));
    }
}
