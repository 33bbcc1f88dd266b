//! The facts of a forecast, as keys of counts: the place, the last things, time spent and the part of the day.

use super::parts::{NONE, Part, SLOT_MASK, TIMES_MAX, digest, key};

/// Hours of one part of the day, from midnight on, in local time.
pub const PART_HOURS: u16 = 3;
/// Parts of a day.
pub const PARTS: usize = 24 / PART_HOURS as usize;
/// Upper ends of the classes of time spent, in seconds.
pub(crate) const CLASSES_S: [f64; 6] = [15.0, 60.0, 240.0, 960.0, 3_840.0, 15_360.0];
pub(crate) const CLASSES: usize = CLASSES_S.len() + 1;
/// Things of the longest context.
pub(crate) const LAST: usize = 5;

/// The facts of a forecast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Context {
    pub(crate) here: u16,
    /// The last different things, the latest first, and the number of repeated mentions of the latest.
    pub(crate) last: [u16; LAST],
    pub(crate) times: u8,
    /// Classes of the time spent here and of the time between the last two observations.
    pub(crate) spent: u16,
    pub(crate) pace: u16,
    pub(crate) horizon: u16,
    pub(crate) at_s: f64,
}

impl Context {
    /// Of a stay, without things.
    pub(crate) fn of_stay(here: u16, spent: u16, at_s: f64) -> Self {
        Self { here, last: [NONE; LAST], times: 0, spent, pace: 0, horizon: 0, at_s }
    }

    pub(crate) fn key(&self, part: Part, slot: u8) -> u64 {
        let (times, after) = self.numbers(part);
        key(part, slot & SLOT_MASK | times.min(TIMES_MAX) << 6, after)
    }

    /// The numbers of a part's key: the repeated mentions if they matter there, and three more.
    fn numbers(&self, part: Part) -> (u8, [u16; 3]) {
        let Self { here, last, times, spent, pace, horizon, at_s } = *self;
        let after = |things: usize| match things {
            0..=3 => std::array::from_fn(|at| if at < things { last[at] } else { NONE }),
            _ => digest(&last[..things]),
        };
        let hour = |hours| part_of_day(at_s, hours);
        match part {
            Part::ThingAfter0 => (0, after(0)),
            Part::ThingAfter1 => (0, after(1)),
            Part::ThingAfter2 => (0, after(2)),
            Part::ThingAfter3 => (0, after(3)),
            Part::ThingAfter4 => (0, after(4)),
            Part::ThingAfter5 => (0, after(5)),
            Part::ThingAtHour => (0, [hour(PART_HOURS), NONE, NONE]),
            Part::ThingAfter1AtHour => (0, [last[0], hour(PART_HOURS), NONE]),
            Part::AgainAfter0 => (times, after(0)),
            Part::AgainAfter1 | Part::RoomAfter1 => (times, after(1)),
            Part::AgainAfter2 | Part::RoomAfter2 => (times, after(2)),
            Part::AgainAfter3 | Part::RoomAfter3 => (times, after(3)),
            Part::RoomOfThing => (0, after(1)),
            Part::RoomByDwell => (0, [here, spent, pace]),
            Part::Stay => (0, [NONE, spent, NONE]),
            Part::StayByPlace => (0, [here, spent, NONE]),
            Part::StayByHour => (0, [here, spent, hour(PART_HOURS)]),
            Part::RoomByHour | Part::ExitByHour => (0, [here, hour(PART_HOURS), NONE]),
            Part::LaterByPlace => (0, [here, horizon, NONE]),
            Part::LaterByHour => (0, [here, horizon, hour(PART_HOURS)]),
            Part::LaterByDwell => (0, [here, horizon << 8 | spent, hour(2)]),
            // After a room, and experts, which have no counts.
            _ => (0, [here, NONE, NONE]),
        }
    }
}

pub(crate) fn time_class(time_s: f64) -> u16 {
    CLASSES_S.partition_point(|end_s| *end_s <= time_s) as u16
}

/// The begin and the end of a class.
pub(crate) fn class_s(class: usize) -> [f64; 2] {
    let begin_s = class.checked_sub(1).map_or(0.0, |before| CLASSES_S[before]);
    [begin_s, CLASSES_S.get(class).copied().unwrap_or(2.0 * begin_s)]
}

/// Minutes since 1970 in local time; earlier times are 0.
pub(crate) fn minute(at_s: f64) -> u32 {
    (at_s / 60.0).clamp(0.0, f64::from(u32::MAX)) as u32
}

/// The hour of the day, divided by `hours`.
fn part_of_day(at_s: f64, hours: u16) -> u16 {
    ((at_s.rem_euclid(86_400.0) / 3_600.0) as u16 / hours.max(1)).min(23)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_an_hour() {
        // 2024-03-01 08:15:00.
        let friday_s = 1_709_251_200.0 + 8.25 * 3_600.0;
        assert_eq!((part_of_day(friday_s, 1), part_of_day(friday_s, 3)), (8, 2));
        assert_eq!((minute(-5.0), part_of_day(-60.0, 1)), (0, 23));
    }
}
