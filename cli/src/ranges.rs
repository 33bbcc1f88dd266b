//! Ranges of numbers on the command line. If a number is outside, clap names the argument and the range.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;

use roomcast_core::narration::history::OBSERVATIONS_MAX;
use roomcast_llama::THREADS_MAX;
use roomcast_services::config::DEADLINE_MS_MAX;

/// Longest time in seconds: some 30 years.
const TIME_S_MAX: f64 = 1e9;
/// Longest time of one act in seconds: a day.
const ACT_S_MAX: f64 = 86_400.0;

/// Threads of one decoder call; 0 leaves the choice to the program.
pub fn threads() -> impl WholeParser<usize> {
    whole(0..=THREADS_MAX)
}

/// Observations in a history window.
pub fn observations() -> impl WholeParser<usize> {
    whole(1..=OBSERVATIONS_MAX)
}

/// Time for an answer, in milliseconds.
pub fn deadline_ms() -> impl WholeParser<u64> {
    whole(1..=DEADLINE_MS_MAX)
}

/// Time of a robot in a room, in whole seconds, for a simulation.
pub fn room_time_s() -> impl WholeParser<usize> {
    whole(1..=ACT_S_MAX as usize)
}

/// Any whole number, for instance a seed.
pub fn any() -> impl WholeParser<u64> {
    whole(0..=u64::MAX)
}

/// A whole number of at least 1.
pub fn some() -> impl WholeParser<u64> {
    whole(1..=TIME_S_MAX as u64)
}

/// A parser of whole numbers for clap.
pub trait WholeParser<T>: Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static {}

impl<T, F: Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static> WholeParser<T> for F {}

/// Accepts whole numbers within a range. The error names the range.
pub fn whole<T>(range: RangeInclusive<T>) -> impl WholeParser<T>
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync + 'static,
{
    move |text: &str| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| format!("give a whole number from {} to {}", range.start(), range.end()))
    }
}

/// A time or a weight in seconds, from 0.
pub fn time_s(text: &str) -> Result<f64, String> {
    number(text, |seconds| (0.0..=TIME_S_MAX).contains(&seconds), "give a number from 0 to 1000000000")
}

/// A number from 0 to 1.
pub fn share(text: &str) -> Result<f64, String> {
    number(text, |share| (0.0..=1.0).contains(&share), "give a number from 0 to 1")
}

/// A number above 0.
pub fn positive(text: &str) -> Result<f64, String> {
    number(text, |value| value > 0.0 && value <= TIME_S_MAX, "give a number above 0, at most 1000000000")
}

/// A time of an act or a stay, at least one second: the simulation's step.
pub fn act_s(text: &str) -> Result<f64, String> {
    number(text, |seconds| (1.0..=ACT_S_MAX).contains(&seconds), "give a number from 1 to 86400")
}

/// As [`act_s`], from 0.
pub fn act_s_or_none(text: &str) -> Result<f64, String> {
    number(text, |seconds| (0.0..=ACT_S_MAX).contains(&seconds), "give a number from 0 to 86400")
}

fn number(text: &str, fits: impl Fn(f64) -> bool, remedy: &str) -> Result<f64, String> {
    // Comparisons with NaN are false, so NaN never fits.
    text.parse().ok().filter(|value| fits(*value)).ok_or_else(|| remedy.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_number_or_out_of_range_fits_nowhere() {
        for text in ["nan", "inf", "-inf", "-1", "1e10", "", "x"] {
            for parse in [time_s, positive, act_s, act_s_or_none, share] {
                assert!(parse(text).is_err(), "{text}");
            }
        }
        assert!(share("1.01").is_err() && share("1") == Ok(1.0));
        assert_eq!((time_s("0"), act_s_or_none("0"), positive("1e-3")), (Ok(0.0), Ok(0.0), Ok(1e-3)));
        for text in ["0", "9", "-1", "1.5", "x", "", "99999999999999999999"] {
            assert_eq!(whole(1..=8_u64)(text), Err("give a whole number from 1 to 8".to_owned()), "{text}");
        }
        assert_eq!((whole(1..=8)("8"), any()("0"), some()("0").is_err()), (Ok(8), Ok(0), true));
        assert!(positive("0").is_err() && act_s("0.5").is_err() && act_s_or_none("86401").is_err());
    }
}
