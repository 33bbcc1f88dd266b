//! Rooms of other robots, present or on their way, by their planners' decisions. Pure: time is an argument.
//!
//! No robot enters a room where another works, or waits where another waits. A waiting robot makes way for one that comes to work, so that
//! no room stays undone. If two decide for one room before they hear of each other, the one with the smaller number keeps it and the other
//! leaves: both know both numbers, so they agree without a message. A planner cannot avoid robots that it does not hear.

use std::collections::BTreeMap;

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::{DecisionV1, NAME_BYTES, RoomScoresV1, action, decision_flags};
use roomcast_ipc::text;

/// Most robots that are followed. If there are more, the one with the earliest end is dropped.
const ROBOTS_MAX: usize = 16;
/// Time after a stay in which a late robot's next decision may still come, in nanoseconds.
const LATE_NS: u64 = 10_000_000_000;
/// The same for a robot that works until it reports, however long its stay was expected to take. Its planner may have ended without a
/// message.
const AT_WORK_NS: u64 = 7_200 * 1_000_000_000;

/// The last decision for another robot.
#[derive(Debug, Clone, Copy)]
struct Claim {
    decision: (u64, u64),
    room: [u8; NAME_BYTES],
    /// It has no work there.
    waits: bool,
    /// 0 without a room.
    until_ns: BootNs,
    /// The log has named its room as missing from the map.
    is_told: bool,
}

#[derive(Debug)]
pub(super) struct Others {
    own: u64,
    robots: BTreeMap<u64, Claim>,
}

impl Others {
    /// `own` is the number of the planner's robot.
    pub(super) fn new(own: u64) -> Self {
        Self { own, robots: BTreeMap::new() }
    }

    pub(super) fn hear(&mut self, decision: &DecisionV1, now_ns: BootNs) {
        let name = (decision.epoch, decision.sequence);
        let old = |claim: &Claim| claim.decision.0 == name.0 && claim.decision.1 > name.1;
        if decision.robot == self.own || self.robots.get(&decision.robot).is_some_and(old) {
            return;
        }
        let is_somewhere = decision.action != action::PAUSE && !decision.to().is_empty();
        let waits = decision.action != action::GO;
        let more_ns = if !waits && decision.has(decision_flags::REPORTED) { AT_WORK_NS } else { LATE_NS };
        let end_ns = BootNs(decision.decided_ns).min(now_ns).saturating_add(decision.stay_ns).saturating_add(more_ns);
        let until_ns = if is_somewhere { end_ns } else { BootNs(0) };
        let is_told = self.robots.get(&decision.robot).is_some_and(|claim| claim.is_told);
        self.robots.insert(decision.robot, Claim { decision: name, room: decision.to, waits, until_ns, is_told });
        if self.robots.len() > ROBOTS_MAX
            && let Some(first) = self.robots.iter().min_by_key(|(_, claim)| claim.until_ns).map(|(robot, _)| *robot)
        {
            self.robots.remove(&first);
        }
    }

    /// For each room of the scores, whether another robot works there, or with `waiting_too` also waits.
    pub(super) fn taken(&self, scores: &RoomScoresV1, waiting_too: bool, now_ns: BootNs) -> Vec<bool> {
        let counts = |claim: &Claim| waiting_too || !claim.waits;
        let taken = |id: &[u8; NAME_BYTES]| self.claims(now_ns).any(|(_, claim)| claim.room == *id && counts(claim));
        scores.rooms().iter().map(|room| taken(&room.id)).collect()
    }

    /// Whether another robot has precedence in a room where this robot works or waits: work before waiting, then the smaller number.
    pub(super) fn go_before(&self, room: &[u8; NAME_BYTES], waits: bool, now_ns: BootNs) -> bool {
        let before = |robot: u64, claim: &Claim| (claim.waits, robot) < (waits, self.own);
        self.claims(now_ns).any(|(robot, claim)| claim.room == *room && before(*robot, claim))
    }

    /// A robot in a room that the map lacks, and that room; each robot once.
    pub(super) fn of_another_map(&mut self, scores: &RoomScoresV1) -> Option<(u64, String)> {
        let is_known = |claim: &Claim| scores.rooms().iter().any(|room| room.id == claim.room);
        let lacks = |claim: &Claim| !claim.is_told && claim.until_ns > BootNs(0) && !is_known(claim);
        let (robot, claim) = self.robots.iter_mut().find(|(_, claim)| lacks(claim))?;
        claim.is_told = true;
        Some((*robot, text::decode("to", &claim.room).unwrap_or_default().to_owned()))
    }

    fn claims(&self, now_ns: BootNs) -> impl Iterator<Item = (&u64, &Claim)> {
        self.robots.iter().filter(move |(_, claim)| claim.until_ns > now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    fn decision(robot: u64, sequence: u64, to: &str) -> DecisionV1 {
        let to = text::encode("to", to).unwrap();
        DecisionV1 {
            robot,
            epoch: 1,
            sequence,
            decided_ns: S,
            stay_ns: 60 * S,
            action: action::GO,
            to,
            ..Default::default()
        }
    }

    /// Two vacuums' imported maps had different ids for one kitchen: neither robot avoided the other, and the log did not say so.
    #[test]
    fn a_robot_whose_rooms_the_map_lacks_is_named_once() {
        let mut scores = RoomScoresV1 { room_count: 1, ..Default::default() };
        scores.room[0].id = text::encode("id", "kitchen-3").unwrap();
        let mut others = Others::new(5);
        others.hear(&decision(8, 1, "kitchen-3"), BootNs(S));
        others.hear(&DecisionV1 { action: action::PAUSE, ..decision(7, 1, "") }, BootNs(S));
        assert_eq!(others.of_another_map(&scores), None);
        others.hear(&decision(9, 1, "kitchen-16"), BootNs(S));
        assert_eq!(others.of_another_map(&scores), Some((9, "kitchen-16".to_owned())));
        others.hear(&decision(9, 2, "hall-17"), BootNs(S));
        assert_eq!(others.of_another_map(&scores), None);
    }

    #[test]
    fn a_room_is_taken_until_its_robot_goes_elsewhere_or_its_time_is_over() {
        let mut scores = RoomScoresV1 { room_count: 2, ..Default::default() };
        scores.room[0].id = text::encode("id", "kitchen").unwrap();
        scores.room[1].id = text::encode("id", "hall").unwrap();
        let kitchen = scores.room[0].id;
        let mut others = Others::new(5);
        others.hear(&decision(5, 1, "hall"), BootNs(S));
        others.hear(&decision(9, 2, "kitchen"), BootNs(S));
        assert_eq!(
            (others.taken(&scores, false, BootNs(2 * S)), others.go_before(&kitchen, false, BootNs(2 * S))),
            (vec![true, false], false)
        );
        others.hear(&decision(9, 1, "hall"), BootNs(S));
        assert_eq!(others.taken(&scores, false, BootNs(2 * S)), [true, false], "it was older");
        assert_eq!(others.taken(&scores, false, BootNs(71 * S)), [false, false]);
        others.hear(&decision(3, 1, "kitchen"), BootNs(S));
        others.hear(&DecisionV1 { action: action::PAUSE, ..decision(9, 3, "") }, BootNs(S));
        assert_eq!(
            (others.taken(&scores, false, BootNs(2 * S)), others.go_before(&kitchen, false, BootNs(2 * S))),
            (vec![true, false], true)
        );
        // A reporting robot works until its next decision.
        others.hear(&DecisionV1 { flags: decision_flags::REPORTED, ..decision(9, 4, "kitchen") }, BootNs(S));
        assert_eq!(others.taken(&scores, false, BootNs(3_600 * S)), [true, false]);
        others.hear(&DecisionV1 { flags: decision_flags::REPORTED, ..decision(9, 5, "hall") }, BootNs(S));
        assert_eq!(others.taken(&scores, false, BootNs(3_600 * S)), [false, true]);
        assert_eq!(others.taken(&scores, false, BootNs(7_300 * S)), [false, false], "its planner may have ended");
        others.hear(&DecisionV1 { action: action::PAUSE, ..decision(9, 6, "") }, BootNs(S));
        // A time in the future counts as now.
        others.hear(&DecisionV1 { decided_ns: u64::MAX, ..decision(3, 2, "hall") }, BootNs(S));
        assert_eq!(others.taken(&scores, false, BootNs(72 * S)), [false, false]);
        (10..1000).for_each(|robot| others.hear(&decision(robot, 1, "hall"), BootNs(S)));
        assert!(others.robots.len() <= ROBOTS_MAX);
    }
}
