//! Parts of the day and kinds of day of a wall-clock time.

/// A minute, on a clock that was set on by so many, or back.
pub(crate) fn shifted(minute: u32, by_min: i64) -> u32 {
    u32::try_from(i64::from(minute).saturating_add(by_min).max(0)).unwrap_or(u32::MAX)
}

/// Minutes since 1970 in local time; what is earlier counts as 0.
pub(crate) fn minute(at_s: f64) -> u32 {
    (at_s / 60.0).clamp(0.0, f64::from(u32::MAX)) as u32
}

/// The hour of the day, divided by `hours`.
pub(crate) fn part_of_day(at_s: f64, hours: u16) -> u16 {
    ((at_s.rem_euclid(86_400.0) / 3_600.0) as u16 / hours.max(1)).min(23)
}

/// Whether it is Saturday or Sunday.
pub(crate) fn weekend(at_s: f64) -> bool {
    // 1970 began on a Thursday.
    let day = ((at_s / 86_400.0).floor() + 4.0).rem_euclid(7.0);
    !(1.0..6.0).contains(&day)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_an_hour_and_a_day_of_the_week() {
        // 2024-03-01 08:15:00, a Friday.
        let friday_s = 1_709_251_200.0 + 8.25 * 3_600.0;
        assert_eq!((part_of_day(friday_s, 1), part_of_day(friday_s, 3), weekend(friday_s)), (8, 2, false));
        assert!(
            weekend(friday_s + 86_400.0) && weekend(friday_s + 2.0 * 86_400.0) && !weekend(friday_s + 3.0 * 86_400.0)
        );
        assert_eq!((minute(-5.0), part_of_day(-60.0, 1)), (0, 23));
    }
}
