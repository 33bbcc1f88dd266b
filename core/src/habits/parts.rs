//! The parts of the forecasts. Each can be left out, to measure how much it adds. The language model and the shipped forecast always stay.

use super::key::Kind;

/// Experts of the mixtures, and what one of them goes by.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Expert {
    ThingHabit = 40,
    ThingHour,
    ThingProduct,
    AgainHabit,
    AgainShare,
    RoomHabit,
    RoomShort,
    RoomThings,
    RoomHour,
    RoomDwell,
    RoomProduct,
    Leaving,
    ByPlace,
    Later,
    NextRoom,
}

/// Every part by its name: experts, and counts of one kind of context.
const PARTS: [(&str, u8); 40] = {
    use Expert::*;
    [
        ("thing-habit", ThingHabit as u8),
        ("thing-hour", ThingHour as u8),
        ("thing-product", ThingProduct as u8),
        ("thing-after-0", Kind::Object0 as u8),
        ("thing-after-1", Kind::Object1 as u8),
        ("thing-after-2", Kind::Object2 as u8),
        ("thing-after-3", Kind::Object3 as u8),
        ("thing-after-4", Kind::Object4 as u8),
        ("thing-after-5", Kind::Object5 as u8),
        ("thing-at-hour", Kind::ObjectHour as u8),
        ("thing-after-1-at-hour", Kind::ObjectAfterHour as u8),
        ("again-habit", AgainHabit as u8),
        ("again-share", AgainShare as u8),
        ("again-after-0", Kind::Again0 as u8),
        ("again-after-1", Kind::Again1 as u8),
        ("again-after-2", Kind::Again2 as u8),
        ("again-after-3", Kind::Again3 as u8),
        ("room-habit", RoomHabit as u8),
        ("room-short", RoomShort as u8),
        ("room-things", RoomThings as u8),
        ("room-hour", RoomHour as u8),
        ("room-dwell", RoomDwell as u8),
        ("room-product", RoomProduct as u8),
        ("room-of-thing", Kind::RoomOfObject as u8),
        ("room-after-room", Kind::Room0 as u8),
        ("room-after-1", Kind::Room1 as u8),
        ("room-after-2", Kind::Room2 as u8),
        ("room-after-3", Kind::Room3 as u8),
        ("leaving", Leaving as u8),
        ("by-place", ByPlace as u8),
        ("later", Later as u8),
        ("next-room", NextRoom as u8),
        ("stay", Kind::Stay as u8),
        ("stay-by-place", Kind::StayPlace as u8),
        ("stay-by-hour", Kind::StayPlaceHour as u8),
        ("exit", Kind::Exit as u8),
        ("exit-by-hour", Kind::ExitHour as u8),
        ("later-by-place", Kind::Later as u8),
        ("later-by-hour", Kind::LaterHour as u8),
        ("later-by-dwell", Kind::LaterDwell as u8),
    ]
};

/// Parts of the forecasts that are left out; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Without(u64);

impl Without {
    /// The names of all parts.
    pub fn names() -> impl Iterator<Item = &'static str> {
        PARTS.into_iter().map(|(name, _)| name)
    }

    /// Without one more part; `None` if there is none of this name.
    #[must_use]
    pub fn and(self, name: &str) -> Option<Self> {
        let (_, bit) = PARTS.into_iter().find(|(own, _)| *own == name)?;
        Some(Self(self.0 | 1 << bit))
    }

    /// Whether an expert or a kind of context is used.
    pub(crate) fn uses(self, part: u8) -> bool {
        self.0 >> part & 1 == 0
    }
}
