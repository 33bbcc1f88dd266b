//! The rooms of a round: done, failed, and the remaining time.

use crate::config::PlannerConfig;
use roomcast_core::ids::BootNs;

/// Stays per room of a round without a configured length: one to do the room, one to wait for it.
const STAYS_PER_ROOM: u64 = 2;
/// A stay may end after the deadline by a fraction of itself, 1 over this: each decision comes a little after the previous stay.
const OVERTIME: u64 = 20;
/// Most slots in a plan; of a longer round it has the first.
const SLOTS_MAX: u64 = 256;
/// The shortest time before a failed room is tried again, or the length of a stay if that is shorter.
const RETRY_NS: u64 = 60_000_000_000;
/// The rest doubles with each further failure, up to this often.
const DOUBLINGS_MAX: u32 = 5;

/// Rooms are indices in the scores.
#[derive(Debug)]
pub(super) struct Round {
    pub(super) stay_ns: u64,
    /// The length of a round; without it, [`STAYS_PER_ROOM`] decides.
    length_ns: Option<u64>,
    /// The start; `None` between two rounds.
    pub(super) began_ns: Option<BootNs>,
    /// The deadline of the previous round of a given length: this round's deadline is that long after it.
    pub(super) due_ns: Option<BootNs>,
    covered: Vec<bool>,
    /// The last failure in each room.
    failed_ns: Vec<Option<BootNs>>,
    /// Failures in a row in each room.
    failures: Vec<u32>,
}

impl Round {
    pub(super) fn new(config: &PlannerConfig) -> Self {
        Self {
            stay_ns: nanoseconds(config.room_time_s),
            length_ns: config.round_s.map(nanoseconds),
            began_ns: None,
            due_ns: None,
            covered: Vec::new(),
            failed_ns: Vec::new(),
            failures: Vec::new(),
        }
    }

    pub(super) fn covered(&self) -> &[bool] {
        &self.covered
    }

    pub(super) fn undone(&self) -> usize {
        self.covered.iter().filter(|covered| !**covered).count()
    }

    pub(super) fn is_done(&self, room: usize) -> bool {
        self.covered.get(room).is_some_and(|covered| *covered)
    }

    pub(super) fn cover(&mut self, room: usize) {
        if let (Some(covered), Some(failures)) = (self.covered.get_mut(room), self.failures.get_mut(room)) {
            (*covered, *failures) = (true, 0);
        }
    }

    pub(super) fn set_done(&mut self, room: usize, is_done: bool) {
        self.covered.get_mut(room).into_iter().for_each(|covered| *covered = is_done);
    }

    pub(super) fn fail(&mut self, room: usize, now_ns: BootNs) {
        if let (Some(failed_ns), Some(failures)) = (self.failed_ns.get_mut(room), self.failures.get_mut(room)) {
            (*failed_ns, *failures) = (Some(now_ns), failures.saturating_add(1));
        }
    }

    /// The time and the number of the failures in a row, for each failed room that is undone.
    pub(super) fn failed(&self) -> impl Iterator<Item = (usize, BootNs, u32)> {
        let failed = self.failed_ns.iter().zip(&self.failures).enumerate();
        let failed = failed.filter_map(|(room, (failed_ns, failures))| Some((room, (*failed_ns)?, *failures)));
        failed.filter(|(room, ..)| !self.is_done(*room))
    }

    /// Restores the failures in a room from an earlier run.
    pub(super) fn restore_failed(&mut self, room: usize, failed_ns: BootNs, failures: u32) {
        self.fail(room, failed_ns);
        if let Some(known) = self.failures.get_mut(room) {
            *known = failures.max(1);
        }
    }

    pub(super) fn has_failed(&self, room: usize) -> bool {
        !self.is_done(room) && self.failed_ns.get(room).is_some_and(Option::is_some)
    }

    pub(super) fn rests(&self, room: usize, now_ns: BootNs) -> bool {
        let failed_ns = self.failed_ns.get(room).copied().flatten();
        let doublings = self.failures.get(room).map_or(0, |failures| failures.saturating_sub(1).min(DOUBLINGS_MAX));
        let rest_ns = self.stay_ns.min(RETRY_NS) << doublings;
        self.has_failed(room) && failed_ns.is_some_and(|failed_ns| now_ns < failed_ns.saturating_add(rest_ns))
    }

    /// The rooms have changed: each new one was at `before(new)`, if it existed.
    pub(super) fn move_rooms(&mut self, rooms: usize, before: impl Fn(usize) -> Option<usize>) {
        let at = |room: usize| before(room);
        self.covered = (0..rooms).map(|room| at(room).is_some_and(|old| self.is_done(old))).collect();
        self.failed_ns =
            (0..rooms).map(|room| at(room).and_then(|old| self.failed_ns.get(old).copied().flatten())).collect();
        self.failures = (0..rooms)
            .map(|room| at(room).and_then(|old| self.failures.get(old).copied()).unwrap_or_default())
            .collect();
    }

    /// Begins another round of all rooms at the deadline. No stay fits before it any more, so the round begins a little early. Its deadline
    /// does not move, so rounds do not drift.
    pub(super) fn begin_again(&mut self) {
        self.due_ns = self.length_ns.and(self.end_ns());
        self.forget();
    }

    fn forget(&mut self) {
        self.covered.fill(false);
        self.end();
    }

    pub(super) fn end(&mut self) {
        self.began_ns = None;
        self.failed_ns.fill(None);
    }

    fn end_ns(&self) -> Option<BootNs> {
        let began_ns = self.began_ns?;
        let default_ns = || self.stay_ns.saturating_mul(STAYS_PER_ROOM.saturating_mul(self.covered.len() as u64));
        let length_ns = self.length_ns.unwrap_or_else(default_ns);
        // After a longer pause of the planner the round begins now.
        let due_ns = self.due_ns.filter(|due_ns| began_ns.0.abs_diff(due_ns.0) <= self.stay_ns);
        Some(due_ns.unwrap_or(began_ns).saturating_add(length_ns))
    }

    /// The number of stays before the round's deadline; `None` for a robot without stays.
    pub(super) fn slots_left(&self, now_ns: BootNs) -> Option<usize> {
        let left_ns = self.end_ns()?.saturating_add(self.stay_ns / OVERTIME).since(now_ns);
        left_ns.checked_div(self.stay_ns).map(|slots| slots.min(SLOTS_MAX) as usize)
    }

    /// Whether a completed round continues without work: a round of a given length does, to its deadline.
    pub(super) fn goes_on(&self, now_ns: BootNs) -> bool {
        self.length_ns.is_some() && self.slots_left(now_ns).is_some_and(|slots| slots > 0)
    }
}

/// Converts a time of the configuration, which limits it.
pub(super) fn nanoseconds(seconds: f64) -> u64 {
    (seconds.max(0.0) * 1e9) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_room_that_failed_rests_for_a_while_and_is_no_failure_once_it_is_done() {
        let mut round = Round::new(&PlannerConfig { room_time_s: 600.0, ..PlannerConfig::default() });
        round.move_rooms(2, |_| None);
        round.fail(1, BootNs(5));
        assert!(
            round.has_failed(1)
                && round.rests(1, BootNs(5))
                && !round.rests(1, BootNs(5 + RETRY_NS))
                && !round.has_failed(0)
        );
        // A room that the robot's map lacks cannot be done, however often it is tried.
        round.fail(1, BootNs(5));
        assert!(round.rests(1, BootNs(5 + RETRY_NS)) && !round.rests(1, BootNs(5 + 2 * RETRY_NS)));
        (0..40).for_each(|_| round.fail(1, BootNs(5)));
        assert!(round.rests(1, BootNs(5 + 31 * RETRY_NS)) && !round.rests(1, BootNs(5 + 32 * RETRY_NS)));
        round.cover(1);
        assert!(!round.has_failed(1) && !round.rests(1, BootNs(5)));
        // Rooms that no map has are not an error.
        round.fail(9, BootNs(5));
        round.cover(9);
        assert!(!round.has_failed(9) && !round.is_done(9));
    }

    #[test]
    fn rounds_of_a_given_length_do_not_drift() {
        const S: u64 = 1_000_000_000;
        let config = PlannerConfig { room_time_s: 10.0, round_s: Some(36.0), ..PlannerConfig::default() };
        let mut round = Round::new(&config);
        round.move_rooms(2, |_| None);
        let mut now_ns = 100 * S;
        let mut begun = Vec::new();
        for _ in 0..20 {
            begun.push(now_ns);
            round.began_ns = Some(BootNs(now_ns));
            while round.slots_left(BootNs(now_ns)) != Some(0) {
                now_ns += 10 * S;
            }
            round.begin_again();
        }
        for (place, began_ns) in begun.iter().enumerate() {
            let due_ns = 100 * S + 36 * S * place as u64;
            assert!(began_ns.abs_diff(due_ns) <= 10 * S, "round {place} begins at {began_ns}, due at {due_ns}");
        }
        // After a long pause the round has its whole length.
        round.began_ns = Some(BootNs(now_ns + 1000 * S));
        assert_eq!(round.slots_left(BootNs(now_ns + 1000 * S)), Some(3));
    }

    #[test]
    fn a_changed_map_keeps_what_is_known_of_rooms_that_stay() {
        let mut round = Round::new(&PlannerConfig::default());
        round.move_rooms(2, |_| None);
        round.cover(0);
        round.fail(1, BootNs(5));
        round.move_rooms(3, |room| room.checked_sub(1));
        assert_eq!(round.covered(), [false, true, false]);
        assert!(round.has_failed(2) && !round.has_failed(0));
    }
}
