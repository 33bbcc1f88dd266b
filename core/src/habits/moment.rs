//! Parts of the day of a wall-clock time, and classes of times spent.

/// Hours of one part of the day, from midnight on, in local time.
pub const PART_HOURS: u16 = 3;
/// Parts of a day.
pub const PARTS: usize = 24 / PART_HOURS as usize;
/// Upper ends of the classes of time spent, in seconds.
pub(crate) const CLASSES_S: [f64; 6] = [15.0, 60.0, 240.0, 960.0, 3_840.0, 15_360.0];
pub(crate) const CLASSES: usize = CLASSES_S.len() + 1;

pub(crate) fn time_class(time_s: f64) -> u16 {
    CLASSES_S.partition_point(|end_s| *end_s <= time_s) as u16
}

/// The begin and the end of a class.
pub(crate) fn class_s(class: usize) -> [f64; 2] {
    let begin_s = class.checked_sub(1).map_or(0.0, |before| CLASSES_S[before]);
    [begin_s, CLASSES_S.get(class).copied().unwrap_or(2.0 * begin_s)]
}

/// A minute after a clock step.
pub(crate) fn shifted(minute: u32, by_min: i64) -> u32 {
    u32::try_from(i64::from(minute).saturating_add(by_min).max(0)).unwrap_or(u32::MAX)
}

/// Minutes since 1970 in local time; earlier times are 0.
pub(crate) fn minute(at_s: f64) -> u32 {
    (at_s / 60.0).clamp(0.0, f64::from(u32::MAX)) as u32
}

/// The hour of the day, divided by `hours`.
pub(crate) fn part_of_day(at_s: f64, hours: u16) -> u16 {
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
