//! A robot follows its decisions and reports on its work.

use std::time::Duration;

use crate::follow::{Decision, Follow};
use crate::raw::{DecisionV1, Message, RobotReportV1, report_flags};
use crate::{Domain, IpcError, Node, Publisher, ReportKind, clock, sequence, text};

/// A report: [`Robot::report`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report<'a> {
    /// The kind.
    pub kind: ReportKind,
    /// The room; empty for the room of the decision that is followed.
    pub room: &'a str,
    /// The reason, for people. It is cut if it is too long.
    pub note: &'a str,
    /// The level of the battery, 0 to 1.
    pub battery: Option<f64>,
    /// The position in the map's metres.
    pub position_m: Option<[f64; 3]>,
}

impl Report<'_> {
    /// A report with nothing else.
    #[must_use]
    pub const fn new(kind: ReportKind) -> Self {
        Self { kind, room: "", note: "", battery: None, position_m: None }
    }
}

/// Follows the decisions for one robot, and reports: [`Domain::robot`].
///
/// Its name is the robot's name in the planner's configuration, `planner.robot`. Reports are not confirmed.
#[derive(Debug)]
pub struct Robot {
    decisions: Follow<DecisionV1>,
    publisher: Publisher<RobotReportV1>,
    followed: Option<Decision>,
    name: String,
    robot: u64,
    epoch: u64,
    sequence: u64,
    _node: Node,
}

impl Robot {
    pub(crate) fn open(domain: &Domain, name: &str) -> Result<Self, IpcError> {
        let node = domain.open(name)?;
        Ok(Self {
            decisions: Follow::open(&node)?,
            publisher: node.publisher()?,
            followed: None,
            name: name.to_owned(),
            robot: sequence::source_of_name(name),
            epoch: sequence::random_epoch(),
            sequence: 0,
            _node: node,
        })
    }

    /// Waits for the next decision for this robot, `None` if none comes within `timeout`: its planner may be silent, or run in another domain.
    ///
    /// # Errors
    ///
    /// [`IpcError::Port`].
    pub fn next(&mut self, timeout: Duration) -> Result<Option<Decision>, IpcError> {
        let start = std::time::Instant::now();
        let publisher = &self.publisher;
        let key = |message: &DecisionV1| (message.epoch, message.sequence);
        loop {
            let left = timeout.saturating_sub(start.elapsed());
            // A planner that starts later gets the newest reports.
            let Some(message) = self.decisions.next_within(left, key, || publisher.tick().map(|_| ()))? else {
                return Ok(None);
            };
            let decision = Decision(message);
            let known = self.followed.as_ref().map(|known| key(known.raw()));
            if decision.raw().robot == self.robot && !decision.is_elsewhere() && known != Some(key(decision.raw())) {
                self.followed = Some(decision.clone());
                return Ok(Some(decision));
            }
        }
    }

    /// The decision that the robot follows.
    #[must_use]
    pub fn decision(&self) -> Option<&Decision> {
        self.followed.as_ref()
    }

    /// The robot is in the room of its decision and has begun to work.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn started(&mut self) -> Result<usize, IpcError> {
        self.report(&Report::new(ReportKind::Started))
    }

    /// The work in the room is done.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn finished(&mut self) -> Result<usize, IpcError> {
        self.report(&Report::new(ReportKind::Finished))
    }

    /// The work in the room failed. The robot is free again.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn failed(&mut self, note: &str) -> Result<usize, IpcError> {
        self.report(&Report { note, ..Report::new(ReportKind::Failed) })
    }

    /// The robot cannot enter the room. It is free again.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn blocked(&mut self, note: &str) -> Result<usize, IpcError> {
        self.report(&Report { note, ..Report::new(ReportKind::Blocked) })
    }

    /// A person, or the robot itself, cancelled the decision. The robot is free again.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn cancelled(&mut self, note: &str) -> Result<usize, IpcError> {
        self.report(&Report { note, ..Report::new(ReportKind::Cancelled) })
    }

    /// The robot is at its dock.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn docked(&mut self, battery: Option<f64>) -> Result<usize, IpcError> {
        self.report(&Report { battery, ..Report::new(ReportKind::Docked) })
    }

    /// The level of the battery, 0 to 1.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn battery(&mut self, level: f64) -> Result<usize, IpcError> {
        self.report(&Report { battery: Some(level), ..Report::new(ReportKind::Battery) })
    }

    /// The position of the robot in the map's metres.
    ///
    /// # Errors
    ///
    /// As [`Robot::report`].
    pub fn position(&mut self, position_m: [f64; 3]) -> Result<usize, IpcError> {
        self.report(&Report { position_m: Some(position_m), ..Report::new(ReportKind::Position) })
    }

    /// Sends a report. Returns the number of participants that received it: 0 if no planner listens.
    ///
    /// # Errors
    ///
    /// [`IpcError::Refused`] for what no message holds, [`IpcError::Port`].
    pub fn report(&mut self, report: &Report<'_>) -> Result<usize, IpcError> {
        use ReportKind::{Blocked, Cancelled, Failed, Finished, Started};

        let refused = |source| IpcError::Refused { service: RobotReportV1::SERVICE.name, source };
        let of_a_room = matches!(report.kind, Started | Finished | Failed | Blocked | Cancelled);
        let answered = self.followed.as_ref().filter(|own| of_a_room && ["", own.room()].contains(&report.room));
        let room = answered.map_or(report.room, Decision::room);
        let flags = [
            (report.position_m.is_some(), report_flags::HAS_POSITION),
            (report.battery.is_some(), report_flags::HAS_BATTERY),
        ];
        let message = RobotReportV1 {
            robot: self.robot,
            epoch: self.epoch,
            sequence: self.sequence + 1,
            reported_ns: clock::monotonic_ns(),
            reported_unix_ns: clock::unix_ns(),
            decision_epoch: answered.map_or(0, |own| own.raw().epoch),
            decision_sequence: answered.map_or(0, |own| own.raw().sequence),
            position_m: report.position_m.unwrap_or_default(),
            battery: report.battery.unwrap_or_default(),
            kind: report.kind.number(),
            flags: flags.iter().filter(|(is_set, _)| *is_set).map(|(_, flag)| flag).sum(),
            robot_name: text::encode_cut(&self.name),
            room: text::encode("room", room).map_err(refused)?,
            note: text::encode_cut(report.note),
            ..RobotReportV1::default()
        };
        let receivers = self.publisher.send(&message)?;
        self.sequence += 1;
        Ok(receivers)
    }
}
