//! Detects another bridge or hub with this one's name. Hubs and operators would take two such bridges for one robot, and lines of a home would reach
//! both. The second one ends. No I/O: the time is an argument.

use serde::Deserialize;
use zenoh::sample::Sample;

use crate::wire::{self, Hex};

/// A message of a bridge that was just killed may still arrive. A bridge that is heard for longer than this runs.
const STAYS_NS: u64 = 2_000_000_000;
/// The log repeats the warning after this time.
const QUIET_NS: u64 = 60_000_000_000;

/// The order of two starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// This one started before the other.
    First,
    /// The other one started before.
    Second,
}

/// The start of a bridge, from one of its messages.
#[derive(Debug, Clone, Copy, Deserialize)]
pub struct Other {
    teller: Hex,
    /// The number of the message.
    number: u64,
    /// How long it has run. Earlier versions do not send this.
    up_ns: Option<u64>,
}

impl Other {
    /// Whether this is a later message of the same start. A router's storage repeats old ones with the same number.
    #[must_use]
    pub fn speaks_after(&self, before: &Self) -> bool {
        self.teller == before.teller && self.number > before.number
    }
}

/// The sender of a message.
#[must_use]
pub fn teller(sample: &Sample) -> Option<Other> {
    // Longer messages are never read.
    let bytes = Some(sample.payload()).filter(|payload| payload.len() <= wire::BYTES_MAX)?.to_bytes();
    wire::read(&bytes).ok()
}

/// Listens for other bridges with this robot's name.
#[derive(Debug)]
pub struct Namesake {
    own: u64,
    started_ns: u64,
    /// When another bridge was first heard.
    since_ns: Option<u64>,
    said_ns: Option<u64>,
}

impl Namesake {
    /// Creates a listener. `own` is the random number of this start.
    #[must_use]
    pub fn new(own: u64, started_ns: u64) -> Self {
        Self { own, started_ns, since_ns: None, said_ns: None }
    }

    /// The order of this start and another one that runs now; `None` for this start itself. An earlier version never ends by itself, so it counts as
    /// first.
    #[must_use]
    pub fn judge(&self, other: Other, now_ns: u64) -> Option<Order> {
        let up_ns = now_ns.saturating_sub(self.started_ns);
        let is_second = other.up_ns.is_none_or(|other_ns| other_ns > up_ns);
        (other.teller.0 != self.own).then_some(if is_second { Order::Second } else { Order::First })
    }

    /// Handles a message with this robot's name. Returns the order if another bridge runs and the log may say so.
    pub fn hear(&mut self, other: Other, now_ns: u64) -> Option<Order> {
        let order = self.judge(other, now_ns)?;
        let since_ns = *self.since_ns.get_or_insert(now_ns);
        let stays = now_ns.saturating_sub(since_ns) >= STAYS_NS;
        let says = stays && self.said_ns.is_none_or(|said_ns| now_ns.saturating_sub(said_ns) >= QUIET_NS);
        if says {
            self.said_ns = Some(now_ns);
        }
        says.then_some(order)
    }
}

/// Detects another hub with this hub's name: a robot reports the start that it heard last.
#[derive(Debug, Clone, Copy, Default)]
pub struct Rival {
    /// The start that the robot had heard before this hub came.
    before: Option<u64>,
    is_heard: bool,
}

impl Rival {
    /// Handles the start that a robot heard last, 0 for none. Returns the order if another hub speaks. An earlier start, for instance of a hub that
    /// lost its spool, is not reported again once this one is.
    pub fn hear(&mut self, start: u64, own: u64) -> Option<Order> {
        let before = *self.before.get_or_insert(start);
        self.is_heard |= start == own;
        let is_other = self.is_heard && start != own && start != 0;
        is_other.then_some(if before == own || before == 0 { Order::First } else { Order::Second })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn other(teller: u64, up_s: impl Into<Option<u64>>) -> Other {
        Other { teller: Hex(teller), number: 1, up_ns: up_s.into().map(|up_s| up_s * S) }
    }

    #[test]
    fn another_bridge_of_the_name_is_told_once_a_minute_and_what_a_killed_one_left_is_ignored() {
        let mut namesake = Namesake::new(7, 0);
        let mut at = |teller: u64, times: std::ops::Range<u64>| {
            times.filter(|second| namesake.hear(other(teller, 1), second * S).is_some()).collect::<Vec<_>>()
        };
        assert!(at(7, 0..200).is_empty(), "it is this one");
        assert!(at(8, 200..201).is_empty(), "it may be the start before this one");
        assert!(at(7, 201..202).is_empty());
        assert_eq!(at(8, 201..300), [202, 262]);
        // A third bridge, or another start of the second.
        assert_eq!(at(9, 300..400), [322, 382]);
    }

    #[test]
    fn of_two_bridges_of_one_name_the_younger_is_the_second() {
        let namesake = Namesake::new(7, 100 * S);
        for (heard, order) in [
            (other(7, 500), None),
            (other(8, 50), Some(Order::First)),
            (other(8, 150), Some(Order::Second)),
            (other(8, None), Some(Order::Second)),
        ] {
            assert_eq!(namesake.judge(heard, 200 * S), order, "{heard:?}");
        }
        // If both start at once, the delay of a message makes neither the second.
        assert_eq!(namesake.judge(other(8, 100), 200 * S + 1), Some(Order::First));
    }

    #[test]
    fn of_two_hubs_of_one_name_the_later_one_is_the_second() {
        let heard = |starts: &[u64]| {
            let mut rival = Rival::default();
            starts.iter().filter_map(|start| rival.hear(*start, 7)).collect::<Vec<_>>()
        };
        assert!(heard(&[0, 7, 7, 0, 7]).is_empty(), "the robot's bridge has started again");
        assert!(heard(&[8, 8, 7, 7]).is_empty(), "this hub has lost its spool");
        assert_eq!(heard(&[0, 7, 8, 7, 8]), [Order::First, Order::First]);
        assert_eq!(heard(&[8, 7, 8]), [Order::Second]);
    }
}
