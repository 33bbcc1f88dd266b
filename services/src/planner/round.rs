//! The rooms of a round: what is done, what the robot could not do, and the time that is left.

use crate::config::PlannerConfig;
use roomcast_core::ids::BootNs;

/// How many stays a round has for each room, where the configuration gives no deadline: one to do it, one to wait for it.
const STAYS_PER_ROOM: u64 = 2;
/// A stay may end so much after the deadline, as a share of itself: each decision comes a little after the stay before it.
const OVERTIME: u64 = 20;
/// Most slots that are planned at once: of a round with more, the first.
const SLOTS_MAX: u64 = 256;
/// A room that the robot could not do is not tried again before so long, or before a stay would be over if that is shorter.
const RETRY_NS: u64 = 60_000_000_000;
/// After each further failure it rests for twice as long, so often.
const DOUBLINGS_MAX: u32 = 5;

/// One round of all rooms, by their places in the scores.
#[derive(Debug)]
pub(super) struct Round {
    /// How long the robot stays in a room.
    pub(super) stay_ns: u64,
    /// How long a round is; without it, so long as [`STAYS_PER_ROOM`] says.
    length_ns: Option<u64>,
    /// When it began; none between two rounds.
    pub(super) began_ns: Option<BootNs>,
    /// When the round before was due, of a given length: so long after that this one is.
    pub(super) due_ns: Option<BootNs>,
    covered: Vec<bool>,
    /// When the robot last could not do the room.
    failed_ns: Vec<Option<BootNs>>,
    /// How often it could not do it in a row.
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

    /// How many rooms there are to go on with.
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

    /// The room is to be done again in this round, or needs no work in it.
    pub(super) fn set_done(&mut self, room: usize, is_done: bool) {
        self.covered.get_mut(room).into_iter().for_each(|covered| *covered = is_done);
    }

    /// The robot could not do the room.
    pub(super) fn fail(&mut self, room: usize, now_ns: BootNs) {
        if let (Some(failed_ns), Some(failures)) = (self.failed_ns.get_mut(room), self.failures.get_mut(room)) {
            (*failed_ns, *failures) = (Some(now_ns), failures.saturating_add(1));
        }
    }

    /// When the robot last could not do a room, of those that are still to do, and how often in a row.
    pub(super) fn failed(&self) -> impl Iterator<Item = (usize, BootNs, u32)> {
        let failed = self.failed_ns.iter().zip(&self.failures).enumerate();
        let failed = failed.filter_map(|(room, (failed_ns, failures))| Some((room, (*failed_ns)?, *failures)));
        failed.filter(|(room, ..)| !self.is_done(*room))
    }

    /// Takes up what another run has seen of a room.
    pub(super) fn restore_failed(&mut self, room: usize, failed_ns: BootNs, failures: u32) {
        self.fail(room, failed_ns);
        if let Some(known) = self.failures.get_mut(room) {
            *known = failures.max(1);
        }
    }

    /// Whether the robot could not do a room, which is still to do.
    pub(super) fn has_failed(&self, room: usize) -> bool {
        !self.is_done(room) && self.failed_ns.get(room).is_some_and(Option::is_some)
    }

    /// Whether a room that failed may not be tried again yet.
    pub(super) fn rests(&self, room: usize, now_ns: BootNs) -> bool {
        let failed_ns = self.failed_ns.get(room).copied().flatten();
        let doublings = self.failures.get(room).map_or(0, |failures| failures.saturating_sub(1).min(DOUBLINGS_MAX));
        let rest_ns = self.stay_ns.min(RETRY_NS) << doublings;
        self.has_failed(room) && failed_ns.is_some_and(|failed_ns| now_ns < failed_ns.saturating_add(rest_ns))
    }

    /// The rooms are others: each new one was at `before(new)`, if it was there.
    pub(super) fn move_rooms(&mut self, rooms: usize, before: impl Fn(usize) -> Option<usize>) {
        let at = |room: usize| before(room);
        self.covered = (0..rooms).map(|room| at(room).is_some_and(|old| self.is_done(old))).collect();
        self.failed_ns =
            (0..rooms).map(|room| at(room).and_then(|old| self.failed_ns.get(old).copied().flatten())).collect();
        self.failures = (0..rooms)
            .map(|room| at(room).and_then(|old| self.failures.get(old).copied()).unwrap_or_default())
            .collect();
    }

    /// The round has come to its deadline, and another one of all rooms begins. No stay fits before the deadline any more, so it begins a little
    /// before it; its own deadline is where it would be otherwise, and rounds do not drift.
    pub(super) fn begin_again(&mut self) {
        self.due_ns = self.length_ns.and(self.end_ns());
        self.forget();
    }

    /// The round is over, and nothing of it counts.
    fn forget(&mut self) {
        self.covered.fill(false);
        self.end();
    }

    /// The round is over; what is done stays done.
    pub(super) fn end(&mut self) {
        self.began_ns = None;
        self.failed_ns.fill(None);
    }

    /// The round's deadline.
    fn end_ns(&self) -> Option<BootNs> {
        let began_ns = self.began_ns?;
        let default_ns = || self.stay_ns.saturating_mul(STAYS_PER_ROOM.saturating_mul(self.covered.len() as u64));
        let length_ns = self.length_ns.unwrap_or_else(default_ns);
        // A planner that paused for longer begins afresh.
        let due_ns = self.due_ns.filter(|due_ns| began_ns.0.abs_diff(due_ns.0) <= self.stay_ns);
        Some(due_ns.unwrap_or(began_ns).saturating_add(length_ns))
    }

    /// How many stays fit before the round's deadline. A robot that stays nowhere has no round to plan.
    pub(super) fn slots_left(&self, now_ns: BootNs) -> Option<usize> {
        let left_ns = self.end_ns()?.saturating_add(self.stay_ns / OVERTIME).since(now_ns);
        left_ns.checked_div(self.stay_ns).map(|slots| slots.min(SLOTS_MAX) as usize)
    }

    /// Whether a round that is done goes on without work: one of a given length does, to its deadline.
    pub(super) fn goes_on(&self, now_ns: BootNs) -> bool {
        self.length_ns.is_some() && self.slots_left(now_ns).is_some_and(|slots| slots > 0)
    }
}

/// A time of the configuration, which bounds it.
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
        // A room that no map of the robot has cannot be done, however often it is tried.
        round.fail(1, BootNs(5));
        assert!(round.rests(1, BootNs(5 + RETRY_NS)) && !round.rests(1, BootNs(5 + 2 * RETRY_NS)));
        (0..40).for_each(|_| round.fail(1, BootNs(5)));
        assert!(round.rests(1, BootNs(5 + 31 * RETRY_NS)) && !round.rests(1, BootNs(5 + 32 * RETRY_NS)));
        round.cover(1);
        assert!(!round.has_failed(1) && !round.rests(1, BootNs(5)));
        // Places that no map has are no fault.
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
