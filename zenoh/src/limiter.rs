//! Lets one log message of each kind through per interval and counts the rest. A frequent kind hides no other kind.

use std::collections::BTreeMap;

/// Nanoseconds between two of a kind.
const QUIET_NS: u64 = 5_000_000_000;
/// Most kinds. Other machines can cause any number. If the table is full, kinds that were quiet for long are forgotten; until then a new kind is not
/// logged.
const KINDS_MAX: usize = 16;

#[derive(Debug, Default)]
struct Held {
    next_ns: u64,
    held: u64,
}

/// Lets one message of a kind through and counts the others of that kind.
#[derive(Debug)]
pub struct Limiter<K = &'static str> {
    kinds: BTreeMap<K, Held>,
}

impl<K> Default for Limiter<K> {
    fn default() -> Self {
        Self { kinds: BTreeMap::new() }
    }
}

impl<K: Ord> Limiter<K> {
    /// Whether to log a message of this kind now; if so, how many were suppressed since the last.
    pub fn pass(&mut self, kind: K, now_ns: u64) -> Option<u64> {
        if self.kinds.len() >= KINDS_MAX && !self.kinds.contains_key(&kind) {
            self.kinds.retain(|_, held| now_ns < held.next_ns);
            if self.kinds.len() >= KINDS_MAX {
                return None;
            }
        }
        let held = self.kinds.entry(kind).or_default();
        if now_ns < held.next_ns {
            held.held += 1;
            return None;
        }
        held.next_ns = now_ns.saturating_add(QUIET_NS);
        Some(std::mem::take(&mut held.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a complaint that came twice a second took every turn and hid a loss.
    #[test]
    fn a_complaint_hides_none_of_another_kind() {
        let mut log = Limiter::default();
        let tenths = |tenth: u64| tenth * 100_000_000;
        let often: Vec<_> = (0..200).filter_map(|tenth| log.pass("often", tenths(tenth))).collect();
        assert_eq!(often, [0, 49, 49, 49]);
        assert_eq!(log.pass("seldom", tenths(3)), Some(0));
    }

    #[test]
    fn kinds_without_end_take_no_memory_and_no_log() {
        let mut log = Limiter::<String>::default();
        let passed = (0..1000).filter(|kind: &u64| log.pass(kind.to_string(), 0).is_some()).count();
        assert_eq!((passed, log.kinds.len()), (KINDS_MAX, KINDS_MAX));
        assert_eq!(log.pass("new".to_owned(), QUIET_NS), Some(0), "the others were quiet for long");
    }
}
