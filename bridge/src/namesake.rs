//! Whether another bridge tells in this robot's name. Hubs and operators take the two for one robot: a hub counts as confirmed what either of them
//! has taken, and the other one never gets it. Pure: time comes in as a number.

use serde::Deserialize;
use zenoh::sample::Sample;

use crate::wire::{self, Hex};

/// What a bridge that was killed a moment ago has said may still come in. Whoever is heard for longer is there.
const STAYS_NS: u64 = 2_000_000_000;
/// It is said once in so long.
const QUIET_NS: u64 = 60_000_000_000;

#[derive(Deserialize)]
struct Stamp {
    teller: Hex,
}

/// The random number of the start that tells something.
#[must_use]
pub fn teller(sample: &Sample) -> Option<u64> {
    // More bytes are read by nobody.
    let bytes = Some(sample.payload()).filter(|payload| payload.len() <= wire::BYTES_MAX)?.to_bytes();
    wire::read::<Stamp>(&bytes).ok().map(|stamp| stamp.teller.0)
}

/// Listens for others of this robot's name.
#[derive(Debug)]
pub struct Namesake {
    own: u64,
    /// When another was heard first.
    since_ns: Option<u64>,
    said_ns: Option<u64>,
}

impl Namesake {
    /// Nobody heard yet; `own` is the random number of this start.
    #[must_use]
    pub fn new(own: u64) -> Self {
        Self { own, since_ns: None, said_ns: None }
    }

    /// Takes who tells in this robot's name; whether it is to be said now that there is another.
    pub fn hear(&mut self, teller: u64, now_ns: u64) -> bool {
        if teller == self.own {
            return false;
        }
        let since_ns = *self.since_ns.get_or_insert(now_ns);
        let stays = now_ns.saturating_sub(since_ns) >= STAYS_NS;
        let says = stays && self.said_ns.is_none_or(|said_ns| now_ns.saturating_sub(said_ns) >= QUIET_NS);
        if says {
            self.said_ns = Some(now_ns);
        }
        says
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn another_of_the_name_is_told_of_once_in_a_while_and_what_a_killed_one_left_is_none() {
        let mut namesake = Namesake::new(7);
        let mut at = |teller: u64, times: std::ops::Range<u64>| {
            times.filter(|second| namesake.hear(teller, second * S)).collect::<Vec<_>>()
        };
        assert!(at(7, 0..200).is_empty(), "it is this one");
        assert!(at(8, 200..201).is_empty(), "it may be the start before this one");
        assert!(at(7, 201..202).is_empty());
        assert_eq!(at(8, 201..300), [202, 262]);
        // A third one, or another start of the second.
        assert_eq!(at(9, 300..400), [322, 382]);
    }
}
