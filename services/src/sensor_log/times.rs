//! Times as logs write them.

/// A larger plain number is not a number of seconds: it would be later than the year 5000, and today's milliseconds are more.
const SECONDS_MAX: f64 = 1e11;
/// The step of clocks in autumn, in seconds, on a Sunday before three o'clock.
pub(super) const FOLD_S: f64 = 3_600.0;
const FOLD_UNTIL_S: f64 = 3.0 * 3_600.0;
const MONTHS: &str = "january february march april may june july august september october november december";

/// Whether a time is local: a date without a zone, not a number of seconds.
pub(super) fn is_clock_time(field: &str) -> bool {
    field.parse::<f64>().is_err() && zone_of(field).1.is_none()
}

/// A time without its zone, and the zone's offset in seconds: "Z", "+01:00", "-0530".
fn zone_of(field: &str) -> (&str, Option<f64>) {
    let field = field.trim_end();
    if let Some(time) = field.strip_suffix('Z') {
        return (time, Some(0.0));
    }
    let marked = || {
        // Dates contain signs, too.
        let at = field.rfind(['+', '-']).filter(|at| field[..*at].contains(':'))?;
        let digits = field[at + 1..].replace(':', "");
        let number: u32 =
            digits.parse().ok().filter(|_| digits.len() == 4 && digits.bytes().all(|b| b.is_ascii_digit()))?;
        let (hours, minutes) = (number / 100, number % 100);
        let sign = if field[at..].starts_with('-') { -1.0 } else { 1.0 };
        (hours < 15 && minutes < 60).then_some((&field[..at], sign * f64::from(3_600 * hours + 60 * minutes)))
    };
    marked().map_or((field, None), |(time, ahead_s)| (time, Some(ahead_s)))
}

/// Whether the clock may have been set back between two of its times. Logs do not name their country. Summer time ends by an hour in the early hours of a
/// Sunday in every country.
pub(super) fn may_be_folded(start_s: f64, end_s: f64) -> bool {
    // The first day of 1970 was a Thursday.
    let is_sunday = (start_s / 86_400.0).floor().rem_euclid(7.0) == 3.0;
    let of_night = |at_s: f64| at_s.rem_euclid(86_400.0) < FOLD_UNTIL_S;
    is_sunday && of_night(start_s) && of_night(end_s) && (0.0..=FOLD_S).contains(&(start_s - end_s))
}

/// Seconds since 1970 of `2024-03-01 08:15:00` or `25-Feb-2008 00:20:14` (with `T`, `/` and fractions as well), without leap seconds: by
/// the local clock, or in UTC for a time with a zone. A plain number is returned. `None` for a date or time of day that does not exist, and
/// for a number too large for seconds.
#[must_use]
pub fn seconds(text: &str) -> Option<f64> {
    if let Ok(seconds) = text.parse::<f64>() {
        return (seconds.abs() <= SECONDS_MAX).then_some(seconds);
    }
    let (clock, ahead_s) = zone_of(text);
    // The time of day follows the last space or T before the first colon. Some months have a T.
    let ends_date = |at: usize, c: char| c == ' ' || (c == 'T' && clock[..at].ends_with(|c: char| c.is_ascii_digit()));
    let (at, _) = clock[..clock.find(':')?].char_indices().rfind(|(at, c)| ends_date(*at, *c))?;
    let (year, month, day) = date(&clock[..at])?;
    let mut parts = clock[at + 1..].trim().splitn(3, ':');
    let (hour, minute) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
    let second: f64 = parts.next().unwrap_or("0").parse().ok()?;
    if !(0.0..61.0).contains(&second) {
        return None;
    }
    let whole = tz::UtcDateTime::new(year, month, day, hour, minute, second as u8, 0).ok()?;
    Some(whole.unix_time() as f64 + second.fract() - ahead_s.unwrap_or_default())
}

/// Year, month and day of `2024-03-01`, of `01.03.2024`, and of `01-Mar-2024` or `Mar 1, 2024` with the month's English name. `/` and a
/// space separate as well. `01/03/2024` is ambiguous and gives `None`.
fn date(text: &str) -> Option<(i32, u8, u8)> {
    let mut parts = text.split(['-', '/', '.', ',', ' ']).filter(|part| !part.is_empty());
    let (first, second, third) = (parts.next()?, parts.next()?, parts.next()?);
    let is_german = || text.contains('.') && third.len() == 4;
    let (year, month, day) = match (month(first), month(second)) {
        (Some(month), _) => (third, month, second),
        (None, Some(month)) => (third, month, first),
        (None, None) if is_german() => (third, second.parse().ok()?, first),
        (None, None) => (first, second.parse().ok()?, third),
    };
    let (year, day) = (year.parse().ok()?, day.parse().ok()?);
    (parts.next().is_none() && (1..=9_999).contains(&year)).then_some((year, month, day))
}

/// The number of a month by its English name, or by its first three letters.
fn month(name: &str) -> Option<u8> {
    let name = name.to_ascii_lowercase();
    let is_name = |month: &&str| *month == name || month.get(..3) == Some(&name[..]);
    (1..).zip(MONTHS.split(' ')).find(|(_, month)| is_name(month)).map(|(number, _)| number)
}

pub(super) fn is_date(text: &str) -> bool {
    date(text.trim()).is_some()
}

/// Whether a field begins with a time, valid or not: with a number, or with digits that `-`, `/`, `.` or `:` separate.
pub(super) fn begins_with_time(field: &str) -> bool {
    let Some(word) = field.split_whitespace().next() else { return false };
    let is_number = word.parse().is_ok_and(f64::is_finite);
    let separators = word.chars().filter(|c| matches!(c, '-' | '/' | '.' | ':')).count();
    is_number || (word.starts_with(|c: char| c.is_ascii_digit()) && separators > 0)
}
