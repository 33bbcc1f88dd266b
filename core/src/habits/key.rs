//! Keys of counts, 64 bits: the kind, the person's slot, and the context. Up to three things are stored exactly. A longer context is a digest of 48
//! bits; two contexts collide once in 10^14.

pub(crate) const NONE: u16 = u16::MAX;

/// Kinds of counts, which also decide the meaning of the key's numbers. Files hold these values: values of removed kinds stay unused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Other things after the last zero to five things; the longest contexts by a digest.
    Object0 = 1,
    Object1 = 2,
    Object2 = 3,
    Object3 = 4,
    Object4 = 5,
    Object5 = 6,
    /// Whether the last thing is mentioned again: by its number of mentions, and after the last one to three things.
    Again0 = 7,
    Again1 = 8,
    Again2 = 9,
    Again3 = 10,
    /// Things by part of the day; after the last thing by part of the day.
    ObjectHour = 11,
    ObjectAfterHour = 12,
    /// Rooms in which a thing was.
    RoomOfObject = 13,
    /// Next rooms: after a room; after one to three things; after a room by part of the day; by time spent and pace.
    Room0 = 14,
    Room1 = 15,
    Room2 = 16,
    Room3 = 17,
    RoomHour = 18,
    RoomDwellPace = 31,
    /// Where a stay leads: by place; by part of the day as well.
    Exit = 22,
    ExitHour = 23,
    /// Places a horizon later: by place; by hour as well; by time spent and hour as well.
    Later = 24,
    LaterHour = 25,
    LaterDwell = 26,
    /// Exits and time spent: by time since the place was entered; by place as well; by part of the day as well.
    Stay = 19,
    StayPlace = 20,
    StayPlaceHour = 21,
}

impl Kind {
    /// Every kind, with the meanings of the key's three numbers and of the counted symbol.
    const ALL: [(Self, [Number; 4]); 27] = {
        use Number::{Object as O, Place as P, Plain as N};
        [
            (Self::Object0, [N, N, N, O]),
            (Self::Object1, [O, N, N, O]),
            (Self::Object2, [O, O, N, O]),
            (Self::Object3, [O, O, O, O]),
            (Self::Object4, [N, N, N, O]),
            (Self::Object5, [N, N, N, O]),
            (Self::Again0, [N, N, N, N]),
            (Self::Again1, [O, N, N, N]),
            (Self::Again2, [O, O, N, N]),
            (Self::Again3, [O, O, O, N]),
            (Self::ObjectHour, [N, N, N, O]),
            (Self::ObjectAfterHour, [O, N, N, O]),
            (Self::RoomOfObject, [O, N, N, P]),
            (Self::Room0, [P, N, N, P]),
            (Self::Room1, [O, N, N, P]),
            (Self::Room2, [O, O, N, P]),
            (Self::Room3, [O, O, O, P]),
            (Self::RoomHour, [P, N, N, P]),
            (Self::RoomDwellPace, [P, N, N, P]),
            (Self::Exit, [P, N, N, P]),
            (Self::ExitHour, [P, N, N, P]),
            (Self::Later, [P, N, N, P]),
            (Self::LaterHour, [P, N, N, P]),
            (Self::LaterDwell, [P, N, N, P]),
            (Self::Stay, [N, N, N, N]),
            (Self::StayPlace, [P, N, N, N]),
            (Self::StayPlaceHour, [P, N, N, N]),
        ]
    };

    /// The kind with this number in a file, unless it was removed.
    pub(crate) fn of(number: u8) -> Option<Self> {
        Self::ALL.into_iter().map(|(kind, _)| kind).find(|kind| *kind as u8 == number)
    }

    pub(crate) fn layout(self) -> [Number; 4] {
        Self::ALL.into_iter().find(|(kind, _)| *kind == self).map_or([Number::Plain; 4], |(_, layout)| layout)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Number {
    Object,
    Place,
    Plain,
}

/// Bits of the slot; the bits above hold how often the last thing was mentioned in a row.
pub(crate) const SLOT_MASK: u8 = 0x3f;
/// Most mentions in a row that are counted apart.
const TIMES_MAX: u8 = 3;

/// Joins a slot and the number of repeated mentions.
pub(crate) fn with_times(slot: u8, times: u8) -> u8 {
    slot & SLOT_MASK | times.min(TIMES_MAX) << 6
}

pub(crate) fn key(kind: Kind, slot: u8, after: [u16; 3]) -> u64 {
    let [first, second, third] = after.map(u64::from);
    (kind as u64) << 56 | u64::from(slot) << 48 | first << 32 | second << 16 | third
}

/// Hashes a context that is longer than three things.
pub(crate) fn digest(context: &[u16]) -> [u16; 3] {
    // The finaliser of splitmix64 after each number. Files hold the result.
    let digest = context.iter().fold(0u64, |sum, number| {
        let mut hash = (sum ^ u64::from(*number)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        hash ^ (hash >> 31)
    });
    [(digest >> 32) as u16, (digest >> 16) as u16, digest as u16]
}

/// Splits a key; `None` if its kind is unknown.
pub(crate) fn parts(key: u64) -> Option<(Kind, u8, [u16; 3])> {
    let kind = Kind::of((key >> 56) as u8)?;
    Some((kind, (key >> 48) as u8, [(key >> 32) as u16, (key >> 16) as u16, key as u16]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_can_be_taken_apart() {
        for (kind, _) in Kind::ALL {
            assert_eq!(parts(key(kind, 63, [1, NONE, 0xabcd])), Some((kind, 63, [1, NONE, 0xabcd])));
        }
        assert_eq!(parts(u64::MAX), None);
        assert_eq!(parts(0), None);
        // Existing files hold this value.
        assert_eq!(digest(&[1, 2, 3, 4, 5]), [27063, 5733, 20958]);
        assert_ne!(digest(&[1, 2, 3, 4]), digest(&[2, 1, 3, 4]));
    }
}
