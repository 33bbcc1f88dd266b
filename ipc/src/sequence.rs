//! Gaps, duplicates and restarts, seen from `(source, epoch, sequence)`.

/// The meaning of a sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrival {
    /// The next number, or the first of a source.
    New,
    /// `missed` earlier messages have not arrived.
    AfterGap {
        /// The number of missing messages.
        missed: u64,
    },
    /// The message was seen before, or is older than the newest one: to be ignored.
    Duplicate,
    /// The number is more than [`JUMP_MAX`] ahead. No source loses so many messages, and if it counted, all later messages would be
    /// duplicates. The follower ignores it.
    TooFar,
}

/// Most numbers that a source may skip at once.
pub const JUMP_MAX: u64 = 1 << 32;

/// Follows one source: its epoch and the highest sequence number taken.
///
/// Epochs that were left behind stay known for a while, so that a delayed message of a former run is not taken for a
/// restart. A source's first message may have any sequence number: a late joiner has missed nothing that was promised to it.
///
/// ```
/// use roomcast_ipc::sequence::{Arrival, Follower};
///
/// let mut follower = Follower::default();
/// assert_eq!(follower.take(7, 1), Arrival::New);
/// assert_eq!(follower.take(7, 1), Arrival::Duplicate);
/// assert_eq!(follower.take(7, 4), Arrival::AfterGap { missed: 2 });
/// assert_eq!(follower.take(8, 1), Arrival::New);
/// assert_eq!(follower.take(7, 5), Arrival::Duplicate);
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Follower {
    epoch: u64,
    sequence: u64,
    /// Earlier epochs, the newest last.
    left: Vec<u64>,
}

impl Follower {
    const LEFT: usize = 8;

    /// Records a message and classifies it.
    pub fn take(&mut self, epoch: u64, sequence: u64) -> Arrival {
        if epoch == self.epoch {
            if sequence <= self.sequence {
                return Arrival::Duplicate;
            }
            let missed = if self.sequence == 0 { 0 } else { sequence - self.sequence - 1 };
            if missed > JUMP_MAX {
                return Arrival::TooFar;
            }
            self.sequence = sequence;
            return if missed == 0 { Arrival::New } else { Arrival::AfterGap { missed } };
        }
        if self.left.contains(&epoch) {
            return Arrival::Duplicate;
        }
        if self.epoch != 0 {
            if self.left.len() == Self::LEFT {
                self.left.remove(0);
            }
            self.left.push(self.epoch);
        }
        (self.epoch, self.sequence) = (epoch, sequence);
        Arrival::New
    }

    /// The epoch followed; 0 before the first message.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// The highest sequence number taken; 0 before the first message.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        self.sequence
    }
}

/// A random number for an epoch, never 0.
#[must_use]
pub fn random_epoch() -> u64 {
    use std::hash::{BuildHasher, Hasher, RandomState};
    // The standard library seeds each RandomState from the system's random source.
    let mut hasher = RandomState::new().build_hasher();
    hasher.write_u64(crate::clock::unix_ns());
    hasher.write_u32(std::process::id());
    hasher.finish().max(1)
}

/// A source's number from its name, the same on every machine: 64-bit FNV-1a, never 0.
///
/// ```
/// use roomcast_ipc::sequence::source_of_name;
/// assert_eq!(source_of_name("hall-camera"), source_of_name("hall-camera"));
/// assert_ne!(source_of_name("hall-camera"), source_of_name("kitchen-camera"));
/// ```
#[must_use]
pub fn source_of_name(name: &str) -> u64 {
    let mix = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
    name.bytes().fold(0xcbf2_9ce4_8422_2325, mix).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_that_restarts_often_does_not_grow_memory() {
        let mut follower = Follower::default();
        for epoch in 1..1000 {
            assert_eq!(follower.take(epoch, 1), Arrival::New);
        }
        assert!(follower.left.len() <= Follower::LEFT);
        assert_eq!(follower.take(998, 9), Arrival::Duplicate);
    }

    /// Row "sequence 2^64 - 1" of the attacks.
    #[test]
    fn a_jump_without_measure_hides_nothing_that_follows() {
        let mut follower = Follower::default();
        assert_eq!(follower.take(7, 4), Arrival::New);
        assert_eq!(follower.take(7, u64::MAX), Arrival::TooFar);
        assert_eq!(follower.take(7, 5), Arrival::New);
        assert_eq!(follower.take(7, 6 + JUMP_MAX), Arrival::AfterGap { missed: JUMP_MAX });
    }

    #[test]
    fn each_missing_message_counts() {
        let mut follower = Follower::default();
        assert_eq!(follower.take(7, 1), Arrival::New);
        for (sequence, missed) in [(3, 1), (6, 2), (107, 100)] {
            assert_eq!(follower.take(7, sequence), Arrival::AfterGap { missed });
        }
        assert_eq!(follower.take(7, 108), Arrival::New);
    }

    #[test]
    fn epochs_differ() {
        assert_ne!(random_epoch(), random_epoch());
    }
}
