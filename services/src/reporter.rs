//! The reporter turns a robot's reports, as lines of JSON or word by word, into messages for its planner.

use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::parsing::{Keyed, json_of_one_line_says, word};
use roomcast_ipc::raw::{Message, RobotReportV1, report_flags, report_kind};
use roomcast_ipc::{MessageError, sequence, text};

/// Longest line of input, in bytes.
pub const LINE_BYTES_MAX: u64 = 8192;

roomcast_core::choices! {
    /// The kind of a robot's report.
    pub enum Kind {
        /// The position of the robot.
        Position,
        /// The robot has begun to work in the room.
        Started,
        /// The work in the room is done.
        Finished,
        /// The work in the room failed.
        Failed,
        /// The robot cannot enter the room.
        Blocked,
        /// The robot is at its dock.
        Docked,
        /// The level of the battery.
        Battery,
        /// A person or the robot cancelled the decision.
        Cancelled,
        /// A person's order: the robot does not work, for some time or until it resumes.
        Hold,
        /// A person's order: the hold ends.
        Resume,
        /// A person's order: clean the room now.
        Clean,
        /// A person's order: skip the room today.
        Skip,
    }
}

impl Kind {
    fn number(self) -> u32 {
        match self {
            Self::Position => report_kind::POSITION,
            Self::Started => report_kind::STARTED,
            Self::Finished => report_kind::FINISHED,
            Self::Failed => report_kind::FAILED,
            Self::Blocked => report_kind::BLOCKED,
            Self::Docked => report_kind::DOCKED,
            Self::Battery => report_kind::BATTERY,
            Self::Cancelled => report_kind::CANCELLED,
            Self::Hold => report_kind::HOLD,
            Self::Resume => report_kind::RESUME,
            Self::Clean => report_kind::CLEAN,
            Self::Skip => report_kind::SKIP,
        }
    }
}

/// A report of a robot.
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Report {
    /// The kind.
    #[serde(rename = "report", deserialize_with = "word")]
    pub kind: Kind,
    /// The room, by its id or its name in the map.
    #[serde(default)]
    pub room: Option<String>,
    /// The battery's level, 0 to 1.
    #[serde(default)]
    pub battery: Option<f64>,
    /// The position of the robot, in the map's metres.
    #[serde(default)]
    pub position: Option<[f64; 3]>,
    /// The sequence of the decision that the report answers.
    #[serde(default)]
    pub decision: Option<u64>,
    /// The reason, in words.
    #[serde(default)]
    pub note: Option<String>,
    /// Seconds until a hold ends.
    #[serde(default)]
    pub for_s: Option<f64>,
}

/// A report is malformed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReporterError {
    /// The text is not JSON, or has an unknown key or a value of the wrong kind.
    #[error(
        "{reason}; expected {{\"report\": \"finished\"}}, with \"room\": text, \"battery\": 0 to 1, \"position\": [x, y, z] in metres, \
         \"decision\": number and \"note\": text if you like, and \"for_s\": seconds with \"hold\""
    )]
    Json {
        /// The fault and its key.
        reason: String,
    },
    /// A report of this kind needs another key.
    #[error("a report of the kind {kind} needs `{key}`: {remedy}")]
    Missing {
        /// The kind.
        kind: Kind,
        /// The missing key.
        key: &'static str,
        /// The remedy.
        remedy: &'static str,
    },
    /// A report of this kind must not have a key.
    #[error("a report of the kind {kind} has no `{key}`: {remedy}")]
    Useless {
        /// The kind.
        kind: Kind,
        /// The key.
        key: &'static str,
        /// The remedy.
        remedy: &'static str,
    },
    /// The time of a hold is outside its limits.
    #[error("`for_s` of a hold is {0}: give 1 to 1000000000 seconds")]
    HoldTime(f64),
    /// The contract rejects a value.
    #[error("the report is refused: {0}")]
    Message(#[from] MessageError),
}

impl Report {
    /// A report of a kind, with nothing more.
    #[must_use]
    pub fn new(kind: Kind) -> Self {
        Self { kind, room: None, battery: None, position: None, decision: None, note: None, for_s: None }
    }

    /// Reads a line of JSON.
    ///
    /// # Errors
    /// [`ReporterError`] names the key.
    ///
    /// ```
    /// use roomcast_services::reporter::{Kind, Report};
    ///
    /// let report = Report::parse(r#"{"report": "finished", "room": "kitchen", "decision": 12}"#)?;
    /// assert_eq!((report.kind, report.decision), (Kind::Finished, Some(12)));
    /// # Ok::<(), roomcast_services::reporter::ReporterError>(())
    /// ```
    pub fn parse(line: &str) -> Result<Self, ReporterError> {
        let mut json = serde_json::Deserializer::from_str(line);
        let json_error = |reason: String| ReporterError::Json { reason };
        let Keyed(report) = serde_path_to_error::deserialize::<_, Keyed<Self>>(&mut json).map_err(|error| {
            let said = json_of_one_line_says(error.inner());
            // An error without a key has the path ".".
            json_error(if error.path().iter().next().is_some() { format!("{}: {said}", error.path()) } else { said })
        })?;
        json.end().map_err(|error| json_error(json_of_one_line_says(&error)))?;
        Ok(report)
    }
}

/// Numbers a robot's reports.
#[derive(Debug)]
pub struct Reporter {
    robot: u64,
    name: [u8; roomcast_ipc::raw::NAME_BYTES],
    epoch: u64,
    sequence: u64,
}

impl Reporter {
    /// The reporter of a robot; `epoch` is random per start.
    ///
    /// # Errors
    /// When the name is too long, or has control characters.
    pub fn new(robot: &str, epoch: u64) -> Result<Self, MessageError> {
        let name = text::encode("robot_name", robot)?;
        Ok(Self { robot: sequence::source_of_name(robot), name, epoch, sequence: 0 })
    }

    /// The next message: a report about the time `now_ns`.
    ///
    /// # Errors
    /// [`ReporterError`] names the missing key, or the value that the contract rejects.
    pub fn message(
        &mut self,
        report: &Report,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
    ) -> Result<RobotReportV1, ReporterError> {
        let missing = |key, remedy| Err(ReporterError::Missing { kind: report.kind, key, remedy });
        match report.kind {
            Kind::Battery if report.battery.is_none() => return missing("battery", "give 0 (empty) to 1 (full)"),
            Kind::Position if report.position.is_none() && report.room.is_none() => {
                return missing("position", "give [x, y, z] in the map's metres, or a room");
            }
            Kind::Clean | Kind::Skip if report.room.is_none() => return missing("room", "give the id of a room"),
            _ => {}
        }
        let useless = |key, remedy| Err(ReporterError::Useless { kind: report.kind, key, remedy });
        if matches!(report.kind, Kind::Hold | Kind::Resume) && report.room.is_some() {
            return useless("room", "it is about the whole robot; `skip` leaves out a room");
        }
        match report.for_s {
            Some(_) if report.kind != Kind::Hold => return useless("for_s", "give it with hold"),
            Some(for_s) if !(1.0..=1e9).contains(&for_s) => return Err(ReporterError::HoldTime(for_s)),
            _ => {}
        }
        let flag = |given: bool, flag| if given { flag } else { 0 };
        let message = RobotReportV1 {
            robot: self.robot,
            epoch: self.epoch,
            sequence: self.sequence + 1,
            reported_ns: now_ns.0,
            reported_unix_ns: now_unix_ns.0,
            decision_sequence: report.decision.unwrap_or(0),
            position_m: report.position.unwrap_or_default(),
            battery: report.battery.unwrap_or_default(),
            kind: report.kind.number(),
            flags: flag(report.position.is_some(), report_flags::HAS_POSITION)
                | flag(report.battery.is_some(), report_flags::HAS_BATTERY),
            minor: 1,
            until_unix_ns: report.for_s.map_or(0, |for_s| now_unix_ns.0.saturating_add((for_s * 1e9) as u64)),
            robot_name: self.name,
            room: text::encode("room", report.room.as_deref().unwrap_or(""))?,
            note: text::encode("note", report.note.as_deref().unwrap_or(""))?,
            ..Default::default()
        };
        message.check()?;
        self.sequence += 1;
        Ok(message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_becomes_a_message_and_its_number_grows_with_good_ones_alone() {
        let mut reporter = Reporter::new("vacuum", 9).unwrap();
        let line = r#"{"report": "docked", "room": "hall", "battery": 0.8, "position": [1, 2.5, 0], "decision": 3, "note": "full"}"#;
        let message = reporter.message(&Report::parse(line).unwrap(), BootNs(5), UnixNs(6)).unwrap();
        assert_eq!((message.kind, message.sequence, message.epoch), (report_kind::DOCKED, 1, 9));
        assert_eq!((message.robot, message.robot_name()), (sequence::source_of_name("vacuum"), "vacuum"));
        assert_eq!((message.room(), message.note(), message.decision_sequence), ("hall", "full", 3));
        assert_eq!((message.battery(), message.position_m()), (Some(0.8), Some([1.0, 2.5, 0.0])));
        let nothing = Report::new(Kind::Finished);
        reporter.message(&Report { battery: Some(1.5), ..nothing.clone() }, BootNs(7), UnixNs(8)).unwrap_err();
        let message = reporter.message(&nothing, BootNs(7), UnixNs(8)).unwrap();
        assert_eq!((message.sequence, message.flags, message.room()), (2, 0, ""));
    }

    #[test]
    fn orders_of_persons_are_reports_too() {
        let mut reporter = Reporter::new("vacuum", 9).unwrap();
        let line = r#"{"report": "hold", "for_s": 60, "note": "meeting"}"#;
        let hold = reporter.message(&Report::parse(line).unwrap(), BootNs(5), UnixNs(1_000_000_000)).unwrap();
        assert_eq!((hold.kind, hold.until_unix_ns, hold.note()), (report_kind::HOLD, 61_000_000_000, "meeting"));
        let of_a_room = Report { room: Some("kitchen".to_owned()), ..Report::new(Kind::Hold) };
        let fault = reporter.message(&of_a_room, BootNs(5), UnixNs(6)).unwrap_err().to_string();
        assert!(fault.contains("hold has no `room`"), "{fault}");
        let resume = reporter.message(&Report::new(Kind::Resume), BootNs(5), UnixNs(6)).unwrap();
        assert!(resume.is_order() && resume.until_unix_ns == 0);
        for (line, part) in [
            (r#"{"report": "clean"}"#, "needs `room`: give the id of a room"),
            (r#"{"report": "skip"}"#, "needs `room`"),
            (r#"{"report": "resume", "for_s": 60}"#, "resume has no `for_s`"),
            (r#"{"report": "hold", "for_s": 0}"#, "1 to 1000000000 seconds"),
        ] {
            let error = reporter.message(&Report::parse(line).unwrap(), BootNs(1), UnixNs(1)).unwrap_err().to_string();
            assert!(error.contains(part), "{line}: {error}");
        }
    }

    #[test]
    fn errors_name_the_key_and_what_is_allowed() {
        let mut reporter = Reporter::new("vacuum", 9).unwrap();
        for (line, part) in [
            ("{}", "missing key `report`"),
            (r#"{"report": "done"}"#, "report: unknown word `done`, expected one of `position`, `started`, `finished`"),
            (
                r#"{"report": 3}"#,
                "report: the number `3`, expected a text in quotes at column 12; expected {\"report\"",
            ),
            (r#"{"report": null}"#, "report: null, expected a text in quotes"),
            (r#"{"report": "docked", "romm": "hall"}"#, "unknown key `romm`"),
            (r#"{"report": "docked", "battery": "full"}"#, "battery: the text \"full\", expected a number"),
            (r#"{"report": "docked", "position": [1, 2]}"#, "position"),
            (r#"{"report": "docked"} {}"#, "more stands behind the end"),
            ("finished", "at column 2; expected"),
            (r#"["finished", "bathroom"]"#, "a list, expected keys and values"),
            (r#"{"report": "battery"}"#, "needs `battery`: give 0 (empty) to 1 (full)"),
            (r#"{"report": "position"}"#, "needs `position`"),
            (r#"{"report": "docked", "battery": 80}"#, "battery"),
            (r#"{"report": "docked", "room": "a\nb"}"#, "room"),
        ] {
            let error = Report::parse(line)
                .and_then(|report| reporter.message(&report, BootNs(1), UnixNs(1)))
                .unwrap_err()
                .to_string();
            assert!(error.contains(part), "{line}: {error}");
        }
        assert!(Reporter::new(&"x".repeat(49), 9).is_err());
    }
}
