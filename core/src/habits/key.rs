//! What a count is kept under: of which kind, of whom, and after what, in 64 bits. Up to three things are named exactly; longer contexts by
//! a digest of 48 bits, of which two are the same once in 10^14.

/// No label before this one.
pub(crate) const NONE: u16 = u16::MAX;

/// Which count it is; also which numbers follow in the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Other objects after the last zero to five objects; the longest contexts by a digest.
    Object0 = 1,
    Object1,
    Object2,
    Object3,
    Object4,
    Object5,
    /// Whether the last object is mentioned again: by how often it was, and after the last one to three objects.
    Again0,
    Again1,
    Again2,
    Again3,
    /// Objects by part of the day and kind of day; after the last object by part of the day.
    ObjectHour,
    ObjectAfterHour,
    /// Rooms in which an object was.
    RoomOfObject,
    /// Next rooms: after a room; after one to three objects; after a room by part of the day.
    Room0,
    Room1,
    Room2,
    Room3,
    RoomHour,
    /// Exits and time spent: by time since the place was entered; by place as well; by part of the day as well.
    Stay,
    StayPlace,
    StayPlaceHour,
    /// Where a stay leads to: by place; by part of the day as well.
    Exit,
    ExitHour,
    /// Places a horizon later: by place; by hour as well; by time spent and hour as well.
    Later,
    LaterHour,
    LaterDwell,
    /// Next rooms: after a room and the one or two before it; after an object by the time between the last two observations; after a room by
    /// the time spent there, and by the time between observations as well.
    RoomBefore,
    RoomBefore2,
    RoomPace,
    RoomDwell,
    RoomDwellPace,
}

impl Kind {
    pub(crate) const ALL: [Self; 31] = [
        Self::Object0,
        Self::Object1,
        Self::Object2,
        Self::Object3,
        Self::Object4,
        Self::Object5,
        Self::Again0,
        Self::Again1,
        Self::Again2,
        Self::Again3,
        Self::ObjectHour,
        Self::ObjectAfterHour,
        Self::RoomOfObject,
        Self::Room0,
        Self::Room1,
        Self::Room2,
        Self::Room3,
        Self::RoomHour,
        Self::Stay,
        Self::StayPlace,
        Self::StayPlaceHour,
        Self::Exit,
        Self::ExitHour,
        Self::Later,
        Self::LaterHour,
        Self::LaterDwell,
        Self::RoomBefore,
        Self::RoomBefore2,
        Self::RoomPace,
        Self::RoomDwell,
        Self::RoomDwellPace,
    ];

    /// Which of the key's three numbers are objects and which are places; the symbol counted comes last.
    pub(crate) fn layout(self) -> [Number; 4] {
        use Number::{Object, Place, Plain};
        match self {
            Self::Object0 | Self::Object4 | Self::Object5 => [Plain, Plain, Plain, Object],
            Self::Again0 => [Plain; 4],
            Self::Again1 => [Object, Plain, Plain, Plain],
            Self::Again2 => [Object, Object, Plain, Plain],
            Self::Again3 => [Object, Object, Object, Plain],
            Self::Object1 | Self::ObjectAfterHour => [Object, Plain, Plain, Object],
            Self::Object2 => [Object, Object, Plain, Object],
            Self::Object3 => [Object, Object, Object, Object],
            Self::ObjectHour => [Plain, Plain, Plain, Object],
            Self::RoomOfObject | Self::Room1 | Self::RoomPace => [Object, Plain, Plain, Place],
            Self::Room0 | Self::RoomHour | Self::RoomDwell | Self::RoomDwellPace => [Place, Plain, Plain, Place],
            Self::RoomBefore => [Place, Place, Plain, Place],
            Self::RoomBefore2 => [Place, Place, Place, Place],
            Self::Room2 => [Object, Object, Plain, Place],
            Self::Room3 => [Object, Object, Object, Place],
            Self::Stay => [Plain; 4],
            Self::StayPlace | Self::StayPlaceHour => [Place, Plain, Plain, Plain],
            Self::Exit | Self::ExitHour | Self::Later | Self::LaterHour | Self::LaterDwell => {
                [Place, Plain, Plain, Place]
            }
        }
    }
}

/// What a number in a key stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Number {
    Object,
    Place,
    Plain,
}

/// Slots of persons; the bits above say how often the last thing was mentioned in a row.
pub(crate) const SLOT_MASK: u8 = 0x3f;
/// Mentions in a row that are told apart.
const TIMES_MAX: u8 = 3;

/// A person's slot together with how often the last thing was mentioned again.
pub(crate) fn with_times(slot: u8, times: u8) -> u8 {
    slot & SLOT_MASK | times.min(TIMES_MAX) << 6
}

/// The key of a person's count after three numbers.
pub(crate) fn key(kind: Kind, slot: u8, after: [u16; 3]) -> u64 {
    let [first, second, third] = after.map(u64::from);
    (kind as u64) << 56 | u64::from(slot) << 48 | first << 32 | second << 16 | third
}

/// Numbers of a context that is longer than three.
pub(crate) fn digest(context: &[u16]) -> [u16; 3] {
    // The finaliser of splitmix64 after each number. Files hold what comes out.
    let digest = context.iter().fold(0u64, |sum, number| {
        let mut hash = (sum ^ u64::from(*number)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        hash ^ (hash >> 31)
    });
    [(digest >> 32) as u16, (digest >> 16) as u16, digest as u16]
}

/// The parts of a key; none when its kind is unknown.
pub(crate) fn parts(key: u64) -> Option<(Kind, u8, [u16; 3])> {
    let kind = Kind::ALL.into_iter().find(|kind| *kind as u64 == key >> 56)?;
    Some((kind, (key >> 48) as u8, [(key >> 32) as u16, (key >> 16) as u16, key as u16]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_can_be_taken_apart() {
        for kind in Kind::ALL {
            assert_eq!(parts(key(kind, 63, [1, NONE, 0xabcd])), Some((kind, 63, [1, NONE, 0xabcd])));
        }
        assert_eq!(parts(u64::MAX), None);
        assert_eq!(parts(0), None);
        // Files of earlier starts hold these.
        assert_eq!(digest(&[1, 2, 3, 4, 5]), [27063, 5733, 20958]);
        assert_ne!(digest(&[1, 2, 3, 4]), digest(&[2, 1, 3, 4]));
    }
}
