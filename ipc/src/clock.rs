//! The two clocks of the contract.

use std::time::{SystemTime, UNIX_EPOCH};

use rustix::time::{ClockId, clock_gettime};

/// `CLOCK_BOOTTIME` in nanoseconds: the same for all processes of a machine, never set back, and running on while the machine is suspended,
/// so that scores from before a suspension are old after it. For ages.
#[must_use]
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Boottime);
    // The clock starts near boot: neither part is negative, and 2^64 ns are 584 years.
    now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
}

/// Nanoseconds since 1970-01-01 UTC, for people; 0 when the wall clock stands before that.
#[must_use]
pub fn unix_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |age| u64::try_from(age.as_nanos()).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn monotonic_time_does_not_go_back() {
        let first = monotonic_ns();
        assert!(first > 0);
        assert!(monotonic_ns() >= first);
    }

    /// Row "a machine that was suspended" of the attacks.
    #[test]
    fn time_in_which_the_machine_is_suspended_counts() {
        let nanoseconds = |clock| {
            let now = clock_gettime(clock);
            now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
        };
        let before = nanoseconds(ClockId::Boottime);
        let now = monotonic_ns();
        assert!((before..=nanoseconds(ClockId::Boottime)).contains(&now));
        // Where it was never suspended, and the clocks are nobody's own, both clocks are one.
        assert!(now >= nanoseconds(ClockId::Monotonic).saturating_sub(1_000_000_000));
    }
}
