//! Places of robots by their own reports, not by decisions.

use std::collections::BTreeMap;

use roomcast_ipc::raw::{DecisionV1, RobotReportV1, report_kind};

const ROBOTS_MAX: usize = 64;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum Place {
    /// No report: no robot obeys the decisions, or its driver is in a dry run.
    #[default]
    DryRun,
    Dock,
    /// The room's id.
    Room(String),
    /// Reports without a place.
    NotKnown,
}

impl Place {
    #[must_use]
    pub fn room(&self) -> Option<&str> {
        if let Self::Room(room) = self { Some(room) } else { None }
    }

    /// The place in words; `name` gives a room's name.
    #[must_use]
    pub fn words(&self, name: impl Fn(&str) -> String) -> String {
        match self {
            Self::DryRun => "dry run".to_owned(),
            Self::Dock => "on its dock".to_owned(),
            Self::Room(room) => name(room),
            Self::NotKnown => "unknown".to_owned(),
        }
    }
}

#[derive(Debug, Default)]
pub struct Places(BTreeMap<u64, Place>);

impl Places {
    /// Handles a report. `decision` is the robot's last one, which a report without a room may answer.
    pub fn take(&mut self, report: &RobotReportV1, decision: Option<&DecisionV1>) {
        if report.is_order() || self.0.len() >= ROBOTS_MAX && !self.0.contains_key(&report.robot) {
            return;
        }
        let place = self.0.entry(report.robot).or_insert(Place::NotKnown);
        let answered = decision.filter(|decision| decision.sequence == report.decision_sequence);
        let room = match (report.room(), answered) {
            ("", Some(decision)) if report.kind == report_kind::STARTED => decision.to(),
            (room, _) => room,
        };
        let is_on_the_way = report.kind == report_kind::POSITION && report.position_m().is_some();
        *place = match report.kind {
            report_kind::DOCKED => Place::Dock,
            report_kind::BATTERY => return,
            _ if !room.is_empty() => Place::Room(room.to_owned()),
            report_kind::STARTED => Place::NotKnown,
            _ if is_on_the_way && *place == Place::Dock => Place::NotKnown,
            _ => return,
        };
    }

    #[must_use]
    pub fn of(&self, robot: u64) -> Place {
        self.0.get(&robot).cloned().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::text;

    #[test]
    fn a_robot_is_where_it_says_and_not_where_it_is_to_go() {
        let mut places = Places::default();
        let to = text::encode("to", "kitchen").unwrap();
        let decision = DecisionV1 { robot: 1, sequence: 4, to, ..Default::default() };
        let mut after = |kind, decision_sequence, room: &str| {
            let room = text::encode("room", room).unwrap();
            let report = RobotReportV1 { robot: 1, kind, decision_sequence, room, ..Default::default() };
            places.take(&report, Some(&decision));
            (places.of(1).words(str::to_owned), places.of(2).words(str::to_owned))
        };
        let dry = || "dry run".to_owned();
        assert_eq!(after(report_kind::HOLD, 0, ""), (dry(), dry()), "an order of a person says nothing of the robot");
        assert_eq!(after(report_kind::BATTERY, 0, ""), ("unknown".to_owned(), dry()));
        assert_eq!(after(report_kind::DOCKED, 0, "").0, "on its dock");
        assert_eq!(after(report_kind::STARTED, 4, "").0, "kitchen");
        assert_eq!(after(report_kind::FINISHED, 4, "").0, "kitchen");
        assert_eq!(after(report_kind::POSITION, 0, "hall").0, "hall");
        assert_eq!(after(report_kind::STARTED, 3, "").0, "unknown", "it answers another decision");
    }
}
