use iceoryx2::prelude::ZeroCopySend;

use super::{Message, NAME_BYTES, ServiceQuality, at_most, in_range, layout};
use crate::{MessageError, text};

/// Most bytes of a report's note.
pub const NOTE_TEXT_BYTES: usize = 120;

/// Values of [`RobotReportV1::kind`].
pub mod report_kind {
    /// Where the robot is.
    pub const POSITION: u32 = 0;
    /// It is in the room and has begun to work there.
    pub const STARTED: u32 = 1;
    /// The work in the room is done.
    pub const FINISHED: u32 = 2;
    /// The work in the room failed; the robot is free again.
    pub const FAILED: u32 = 3;
    /// It does not get into the room; the robot is free again.
    pub const BLOCKED: u32 = 4;
    /// It is at its dock, and charges.
    pub const DOCKED: u32 = 5;
    /// How full the battery is.
    pub const BATTERY: u32 = 6;
    /// Somebody, or the robot itself, took the decision back; the robot is free again.
    pub const CANCELLED: u32 = 7;
    /// A person's order, no report: the robot does not work until `until_unix_ns`, or until [`RESUME`]. `note` says why.
    pub const HOLD: u32 = 8;
    /// A person's order: the hold ends.
    pub const RESUME: u32 = 9;
    /// A person's order: clean `room` now.
    pub const CLEAN: u32 = 10;
    /// A person's order: skip `room` today.
    pub const SKIP: u32 = 11;
}

/// Bits of [`RobotReportV1::flags`].
pub mod report_flags {
    /// `position_m` says where the robot is.
    pub const HAS_POSITION: u32 = 1;
    /// `battery` says how full the battery is.
    pub const HAS_BATTERY: u32 = 1 << 1;
}

layout! {
    /// What a robot says of itself: where it is, and what became of a decision.
    #[type_name("roomcast.RobotReportV1")]
    pub struct RobotReportV1 [512] {
        /// The robot, by the number that decisions name it with.
        0 => robot: u64,
        /// Random per start of the reporter.
        8 => epoch: u64,
        /// 1, 2, 3, ... within the epoch.
        16 => sequence: u64,
        /// When it was so: monotonic nanoseconds.
        24 => reported_ns: u64,
        /// The same in Unix nanoseconds, for people.
        32 => reported_unix_ns: u64,
        /// Epoch of the decision that it answers, 0 for none.
        40 => decision_epoch: u64,
        /// Sequence of that decision, 0 for none.
        48 => decision_sequence: u64,
        /// Where the robot is, in the map's metres; it counts with [`report_flags::HAS_POSITION`].
        56 => position_m: [f64; 3],
        /// How full the battery is, 0 to 1; it counts with [`report_flags::HAS_BATTERY`].
        80 => battery: f64,
        /// One of [`report_kind`].
        88 => kind: u32,
        /// Bits of [`report_flags`].
        92 => flags: u32,
        /// Minor version of the layout: 1, which has orders of persons and `until_unix_ns`.
        96 => minor: u32,
        /// Zero.
        100 => reserved_a: [u8; 4],
        /// The robot's name, UTF-8, zero padded.
        104 => robot_name: [u8; NAME_BYTES],
        /// The room that it speaks of, UTF-8, zero padded; empty where the position or the decision tells.
        152 => room: [u8; NAME_BYTES],
        /// Why, in words, UTF-8, zero padded.
        200 => note: [u8; NOTE_TEXT_BYTES],
        /// The end of a hold in Unix nanoseconds; 0 for none.
        320 => until_unix_ns: u64,
        /// Zero.
        328 => reserved: [u8; 184],
    }
}

impl RobotReportV1 {
    /// The robot's name, of a checked message.
    #[must_use]
    pub fn robot_name(&self) -> &str {
        text::checked(&self.robot_name)
    }

    /// The room, of a checked message; empty where the position or the decision tells.
    #[must_use]
    pub fn room(&self) -> &str {
        text::checked(&self.room)
    }

    /// Why, of a checked message.
    #[must_use]
    pub fn note(&self) -> &str {
        text::checked(&self.note)
    }

    /// Whether it is a person's order to the planner, and says nothing of the robot.
    #[must_use]
    pub fn is_order(&self) -> bool {
        (report_kind::HOLD..=report_kind::SKIP).contains(&self.kind)
    }

    /// Where the robot is, if the report says so.
    #[must_use]
    pub fn position_m(&self) -> Option<[f64; 3]> {
        (self.flags & report_flags::HAS_POSITION != 0).then_some(self.position_m)
    }

    /// How full the battery is, 0 to 1, if the report says so.
    #[must_use]
    pub fn battery(&self) -> Option<f64> {
        (self.flags & report_flags::HAS_BATTERY != 0).then_some(self.battery)
    }
}

impl Message for RobotReportV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/robot-report", publishers: 8, subscribers: 8, buffer: 64, history: 8 };

    fn check(&self) -> Result<(), MessageError> {
        for (field, value) in [("robot", self.robot), ("epoch", self.epoch), ("sequence", self.sequence)] {
            if value == 0 {
                return Err(MessageError::OutOfRange { field, value: 0.0, allowed: "not 0" });
            }
        }
        at_most("kind", self.kind, report_kind::SKIP as usize, "0 to 11")?;
        for metres in self.position_m().unwrap_or_default() {
            in_range("position_m", metres, f64::MIN, f64::MAX, "finite")?;
        }
        in_range("battery", self.battery().unwrap_or(0.0), 0.0, 1.0, "0 to 1")?;
        for (field, bytes) in [("robot_name", &self.robot_name), ("room", &self.room)] {
            text::decode(field, bytes)?;
        }
        text::decode("note", &self.note)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_reports_are_refused() {
        let report = RobotReportV1 { robot: 1, epoch: 2, sequence: 3, ..Default::default() };
        report.check().unwrap();
        RobotReportV1 { kind: 12, ..report }.check().unwrap_err();
        RobotReportV1 { robot: 0, ..report }.check().unwrap_err();
        // What no flag claims is not read.
        let hostile = RobotReportV1 { battery: f64::NAN, position_m: [f64::NAN; 3], ..report };
        hostile.check().unwrap();
        assert_eq!((hostile.battery(), hostile.position_m()), (None, None));
        RobotReportV1 { flags: report_flags::HAS_BATTERY, ..hostile }.check().unwrap_err();
        RobotReportV1 { flags: report_flags::HAS_POSITION, ..hostile }.check().unwrap_err();
    }
}
