//! Where robots are, and on which way: their motion explains what sensors see there.

use std::collections::BTreeMap;

use roomcast_core::ids::BootNs;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::tracker::{Home, ROBOT_SILENT_S};
use roomcast_ipc::raw::{DecisionV1, RobotReportV1, action, report_kind};

use super::Engine;

/// Most robots; reports of further ones explain nothing.
const ROBOTS_MAX: usize = 16;

/// A robot without a report or decision for this long explains nothing: an hour, as the filter has it.
const SILENT_NS: u64 = (ROBOT_SILENT_S * 1e9) as u64;

/// Unchanged rooms are given to the filter again after this time.
const AGAIN_NS: u64 = 60_000_000_000;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Robot {
    room: Option<usize>,
    to: Option<usize>,
    /// At its dock, after its work, or in a pause.
    stands: bool,
    /// It reported at least once. A robot that does not obey makes no motion.
    reports: bool,
    heard_ns: BootNs,
}

impl Robot {
    /// Whether it may move in the same rooms.
    fn is_alike(&self, other: &Self) -> bool {
        (self.room, self.to, self.stands, self.reports) == (other.room, other.to, other.stands, other.reports)
    }
}

/// The robots, by the number that decisions name them with.
#[derive(Debug, Clone, Default)]
pub(super) struct Robots {
    robots: BTreeMap<u64, Robot>,
    pub(super) told_ns: BootNs,
}

impl Robots {
    fn get(&mut self, robot: u64) -> Option<&mut Robot> {
        if self.robots.len() >= ROBOTS_MAX && !self.robots.contains_key(&robot) {
            return None;
        }
        Some(self.robots.entry(robot).or_default())
    }

    /// The rooms in which robots may move: each robot's room, and the rooms on its way.
    pub(super) fn rooms(&self, home: &Home, now_ns: BootNs) -> Vec<usize> {
        let mut rooms = Vec::new();
        for robot in self
            .robots
            .values()
            .filter(|robot| robot.reports && !robot.stands && now_ns.since(robot.heard_ns) < SILENT_NS)
        {
            rooms.extend(robot.room);
            let mut here = robot.room;
            for _ in 0..home.rooms() {
                let (Some(from), Some(to)) = (here, robot.to) else { break };
                here = home.hop(from, Some(to)).filter(|_| from != to);
                rooms.extend(here);
            }
            rooms.extend(robot.to);
        }
        rooms
    }

    /// The map's rooms have other numbers now.
    pub(super) fn forget_rooms(&mut self) {
        self.robots.clear();
    }
}

impl<M: LanguageModel> Engine<M> {
    pub(in crate::daemon) fn see_report(&mut self, report: &RobotReportV1, now_ns: BootNs) {
        let is_bare = report.kind == report_kind::BATTERY && report.position_m().is_none() && report.room().is_empty();
        if is_bare || report.is_order() {
            return;
        }
        let grounding = self.scoring.pipeline.grounding();
        let named = Some(report.room()).filter(|room| !room.is_empty());
        let named = named.and_then(|room| self.map.room(room, grounding));
        let holds = |position: [f64; 3]| {
            let mut rooms = grounding.partitions().iter();
            rooms.position(|room| room.spaces.iter().any(|space| space.contains(&position)))
        };
        let room = named.or_else(|| report.position_m().and_then(holds));
        let Some(robot) = self.belief.robots.get(report.robot) else { return };
        let before = *robot;
        (robot.heard_ns, robot.reports) = (now_ns, true);
        robot.room = room.or(if report.kind == report_kind::STARTED { robot.to } else { None }).or(robot.room);
        match report.kind {
            report_kind::STARTED => robot.stands = false,
            report_kind::POSITION => robot.stands &= before.room == robot.room,
            report_kind::BATTERY => {}
            _ => (robot.to, robot.stands) = (None, true),
        }
        if robot.room == robot.to {
            robot.to = None;
        }
        if !before.is_alike(robot) || now_ns.since(self.belief.robots.told_ns) > AGAIN_NS {
            self.belief.tell_robots(now_ns);
        }
    }

    pub(in crate::daemon) fn see_decision(&mut self, decision: &DecisionV1, now_ns: BootNs) {
        let to = self.map.room(decision.to(), self.scoring.pipeline.grounding());
        let Some(robot) = self.belief.robots.get(decision.robot) else { return };
        let before = *robot;
        robot.heard_ns = now_ns;
        if decision.action == action::GO {
            (robot.to, robot.stands) = (to, false);
        } else {
            (robot.to, robot.stands) = (None, true);
        }
        if !before.is_alike(robot) || now_ns.since(self.belief.robots.told_ns) > AGAIN_NS {
            self.belief.tell_robots(now_ns);
        }
    }
}
