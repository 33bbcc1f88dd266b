//! How long a message was delayed, without synchronised clocks.
//!
//! The monotonic clocks of two machines differ by an unknown constant. The least difference between receiving and sending time over some minutes
//! belongs to the fastest message. A larger difference means a delay, in a queue or by a cut link. The delay of the fastest message is unknown and
//! counts as 0. Wall clocks are not used, so they need not agree.

use std::collections::VecDeque;

use roomcast_ipc::sequence;

/// The minimum covers this window and the previous one. Quartz clocks drift by 50 ppm: 60 ms in two windows.
const WINDOW_NS: u64 = 600_000_000_000;

/// The first message may be a delayed one. After this time, an undelayed one has arrived.
const KNOWN_NS: u64 = 2_000_000_000;

/// Identifies this machine's monotonic clock. It changes with every boot.
#[must_use]
pub fn clock_id() -> u64 {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    sequence::source_of_name(boot.trim())
}

/// Follows the delays of one sender.
#[derive(Debug, Clone, Default)]
pub struct Delay {
    /// The sender's clock, and when it was first heard.
    clock: Option<(u64, u64)>,
    /// Start and least difference of each window; two at most.
    windows: VecDeque<(u64, i64)>,
}

impl Delay {
    /// How much longer than the fastest message this one took. `sent_ns` is by the sender's `clock`, `now_ns` by this machine's. `None` until that
    /// clock was followed for two seconds.
    pub fn excess_ns(&mut self, clock: u64, sent_ns: u64, now_ns: u64) -> Option<u64> {
        if self.clock.is_none_or(|(own, _)| own != clock) {
            (self.clock, self.windows) = (Some((clock, now_ns)), VecDeque::new());
        }
        let difference = now_ns.wrapping_sub(sent_ns).cast_signed();
        match self.windows.back_mut() {
            Some((began_ns, least)) if now_ns.saturating_sub(*began_ns) < WINDOW_NS => *least = difference.min(*least),
            _ => {
                self.windows.push_back((now_ns, difference));
                if self.windows.len() > 2 {
                    self.windows.pop_front();
                }
            }
        }
        let least = self.windows.iter().map(|(_, least)| *least).min().unwrap_or(difference);
        let known = self.clock.is_some_and(|(_, since_ns)| now_ns.saturating_sub(since_ns) >= KNOWN_NS);
        known.then(|| difference.saturating_sub(least).unsigned_abs())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn what_was_held_up_is_known_without_a_common_clock() {
        let mut delay = Delay::default();
        // The sender's clock is ahead, then behind.
        for ahead in [5_000 * S, 0] {
            let clock = ahead + 1;
            assert_eq!(delay.excess_ns(clock, ahead + 10 * S, 110 * S), None, "nobody knows");
            assert_eq!(delay.excess_ns(clock, ahead + 20 * S, 180 * S), Some(60 * S), "held up for a minute");
            assert_eq!(delay.excess_ns(clock, ahead + 80 * S, 180 * S), Some(0));
        }
    }

    #[test]
    fn a_first_message_that_was_held_up_is_not_taken_for_a_fast_one() {
        let mut delay = Delay::default();
        assert_eq!(delay.excess_ns(1, 10 * S, 70 * S), None);
        assert_eq!(delay.excess_ns(1, 70 * S, 70 * S), None);
        assert_eq!(delay.excess_ns(1, 12 * S, 72 * S), Some(60 * S));
    }

    #[test]
    fn a_long_silence_is_no_new_beginning() {
        let mut delay = Delay::default();
        assert_eq!(delay.excess_ns(1, 0, 0), None);
        assert_eq!(delay.excess_ns(1, 10_000 * S, 10_030 * S), Some(30 * S));
        assert_eq!(delay.excess_ns(1, 10_030 * S, 10_030 * S), Some(0));
    }

    #[test]
    fn clocks_that_drift_apart_do_not_add_up() {
        let mut delay = Delay::default();
        for second in 0..86_400 {
            // The receiver's clock gains 50 microseconds a second.
            let excess_ns = delay.excess_ns(1, second * S, second * (S + 50_000)).unwrap_or(0);
            assert!(excess_ns <= 60_100_000, "{excess_ns}");
        }
    }

    #[test]
    fn any_numbers_are_taken() {
        let mut delay = Delay::default();
        for sent in [0, u64::MAX, i64::MAX.unsigned_abs(), 1 << 63] {
            for now in [0, u64::MAX, 1 << 63] {
                let _excess = delay.excess_ns(1, sent, now);
            }
        }
    }
}
