use iceoryx2::prelude::ZeroCopySend;

use super::{MAX_ROOMS, Message, NAME_BYTES, ServiceQuality, at_most, in_range, layout};
use crate::{MessageError, sequence, text};

/// Most bytes of a decision's reason.
pub const REASON_TEXT_BYTES: usize = 256;

/// Values of [`DecisionV1::action`]; [`Action`](crate::Action) is their meaning.
pub mod action {
    /// Nothing is to be done: the robot waits in `to`, which may be another room than its own, or where it is if `to` is empty.
    pub const STAY: u32 = 0;
    /// The robot goes to `to` and works there.
    pub const GO: u32 = 1;
    /// The robot stops its work and waits where it disturbs nobody, at its dock if it has one.
    pub const PAUSE: u32 = 2;
}

/// Bits of [`DecisionV1::flags`].
pub mod decision_flags {
    /// Not the policy's choice but the safe fallback.
    pub const FALLBACK: u32 = 1;
    /// The scores were older than the planner's deadline.
    pub const STALE: u32 = 1 << 1;
    /// No scores were received at all.
    pub const NO_SCORES: u32 = 1 << 2;
    /// The daemon was silent for longer than its heartbeat allows.
    pub const DAEMON_SILENT: u32 = 1 << 3;
    /// Every room has been covered.
    pub const COVERED: u32 = 1 << 4;
    /// A person came into the room that the robot was in: what it did there is not done.
    pub const INTERRUPTED: u32 = 1 << 5;
    /// `covered` counts what the robot reported as finished; without this bit, the clock.
    pub const REPORTED: u32 = 1 << 6;
    /// The round's deadline leaves no later slot for this room.
    pub const DEADLINE: u32 = 1 << 7;
    /// Nothing is known of anybody: the room scores say nothing about persons.
    pub const NOT_KNOWN: u32 = 1 << 8;
    /// Everybody who is known is away.
    pub const NOBODY_HOME: u32 = 1 << 9;
    /// The robot has reported before and has been silent for longer than allowed.
    pub const ROBOT_SILENT: u32 = 1 << 10;
    /// The work was asked for before and its time is over: the robot owes a report of it, and is not to begin it again.
    pub const OWED: u32 = 1 << 11;
    /// Decided in another domain and repeated here, so that this domain's robots keep clear of that one. It is an order to none.
    pub const ELSEWHERE: u32 = 1 << 12;
    /// A person holds the robot: it does not work until `held_until_unix_ns`, or until a person resumes.
    pub const HELD: u32 = 1 << 13;
}

layout! {
    /// Where a robot goes next, and why.
    #[type_name("roomcast.DecisionV1")]
    pub struct DecisionV1 [768] {
        /// The robot.
        0 => robot: u64,
        /// Random per start of the planner.
        8 => epoch: u64,
        /// 1, 2, 3, ... within the epoch.
        16 => sequence: u64,
        /// When it was decided: monotonic nanoseconds.
        24 => decided_ns: u64,
        /// The same in Unix nanoseconds, for people.
        32 => decided_unix_ns: u64,
        /// Epoch of the scores it rests on; 0 for none.
        40 => scores_epoch: u64,
        /// Sequence of those scores.
        48 => scores_sequence: u64,
        /// Age of those scores at the decision, in nanoseconds.
        56 => scores_age_ns: u64,
        /// When the newest narration in those scores was observed: monotonic nanoseconds.
        64 => observed_ns: u64,
        /// Bit i: room i has been covered.
        72 => covered: u64,
        /// How likely somebody is in the room gone to, 0 to 1: by the forecast over the stay, where the policy plans by it; else the
        /// room's score.
        80 => probability: f64,
        /// How long the robot will stay there, in nanoseconds; 0 where no stay is planned.
        88 => stay_ns: u64,
        /// One of [`action`].
        96 => action: u32,
        /// Bits of [`decision_flags`].
        100 => flags: u32,
        /// Minor version of the layout: 4, which has `held_until_unix_ns` and `cleaned_min`; 3 has [`decision_flags::ELSEWHERE`]; 2 has `robot_name` and [`decision_flags::OWED`]; 1 has
        /// [`action::PAUSE`] and `cancels`.
        104 => minor: u32,
        /// Zero.
        108 => reserved_a: [u8; 4],
        /// The room it is in, UTF-8, zero padded; empty when unknown.
        112 => from: [u8; NAME_BYTES],
        /// The room it goes to (or stays in).
        160 => to: [u8; NAME_BYTES],
        /// The policy's name.
        208 => policy: [u8; NAME_BYTES],
        /// Why, in words, UTF-8, zero padded, cut to fit.
        256 => reason: [u8; REASON_TEXT_BYTES],
        /// Sequence of the decision of this epoch that does not hold any more, 0 for none.
        512 => cancels: u64,
        /// The robot's name, UTF-8, zero padded; empty where whoever decides does not tell it.
        520 => robot_name: [u8; NAME_BYTES],
        /// The end of a hold in Unix nanoseconds; 0 where there is no hold, or no end.
        568 => held_until_unix_ns: u64,
        /// Per room the whole minutes from its last cleaning to this decision, plus 1; 0 where none is known. 65535 stands for all longer times.
        576 => cleaned_min: [u16; MAX_ROOMS],
        /// Zero.
        704 => reserved: [u8; 64],
    }
}

impl DecisionV1 {
    /// The robot's name; empty where the decision has none, or one that is not of this robot's number.
    #[must_use]
    pub fn robot_name(&self) -> &str {
        let name = text::checked(&self.robot_name);
        if sequence::source_of_name(name) == self.robot { name } else { "" }
    }

    /// The room the robot is in.
    #[must_use]
    pub fn from(&self) -> &str {
        text::checked(&self.from)
    }

    /// The room it goes to.
    #[must_use]
    pub fn to(&self) -> &str {
        text::checked(&self.to)
    }

    /// The policy's name.
    #[must_use]
    pub fn policy(&self) -> &str {
        text::checked(&self.policy)
    }

    /// Why.
    #[must_use]
    pub fn reason(&self) -> &str {
        text::checked(&self.reason)
    }

    /// When a room was last cleaned before this decision, in Unix seconds, by its place in the map; none where that is not known.
    #[must_use]
    pub fn cleaned_unix_s(&self, room: usize) -> Option<u64> {
        let minutes = self.cleaned_min.get(room).filter(|minutes| **minutes < u16::MAX)?.checked_sub(1)?;
        Some((self.decided_unix_ns / 60_000_000_000).saturating_sub(minutes.into()) * 60)
    }

    /// Whether a bit of [`decision_flags`] is set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }
}

impl Message for DecisionV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/decision", publishers: 8, subscribers: 16, buffer: 16, history: 1 };

    fn check(&self) -> Result<(), MessageError> {
        for (field, value) in [("robot", self.robot), ("epoch", self.epoch), ("sequence", self.sequence)] {
            if value == 0 {
                return Err(MessageError::OutOfRange { field, value: 0.0, allowed: "not 0" });
            }
        }
        at_most("action", self.action, action::PAUSE as usize, "0 to 2")?;
        in_range("probability", self.probability, 0.0, 1.0, "0 to 1")?;
        for (field, bytes) in
            [("from", &self.from), ("to", &self.to), ("policy", &self.policy), ("robot_name", &self.robot_name)]
        {
            text::decode(field, bytes)?;
        }
        text::decode("reason", &self.reason)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What answers or cancels it says 0 for no decision.
    #[test]
    fn a_decision_has_a_robot_an_epoch_and_a_sequence() {
        let decision = DecisionV1 { robot: 1, epoch: 2, sequence: 3, ..Default::default() };
        decision.check().unwrap();
        for (field, without) in [
            ("robot", DecisionV1 { robot: 0, ..decision }),
            ("epoch", DecisionV1 { epoch: 0, ..decision }),
            ("sequence", DecisionV1 { sequence: 0, ..decision }),
        ] {
            assert_eq!(without.check().unwrap_err().to_string(), format!("{field}: 0, allowed is not 0"));
        }
    }

    #[test]
    fn the_last_cleaning_of_a_room_is_known_to_the_minute() {
        let mut decision = DecisionV1 { decided_unix_ns: 10_000 * 1_000_000_000, ..Default::default() };
        assert_eq!(decision.cleaned_unix_s(1), None);
        decision.cleaned_min[1] = 61;
        assert_eq!([1, 64].map(|room| decision.cleaned_unix_s(room)), [Some(6_360), None]);
    }

    /// Whoever decides for one robot cannot take another one's name.
    #[test]
    fn a_name_counts_for_the_robot_whose_number_it_has() {
        let robot_name = text::encode("robot_name", "Staubi Ä").unwrap();
        let robot = sequence::source_of_name("Staubi Ä");
        let named = DecisionV1 { robot, epoch: 2, sequence: 3, robot_name, ..Default::default() };
        named.check().unwrap();
        assert_eq!(named.robot_name(), "Staubi Ä");
        assert_eq!(DecisionV1 { robot: named.robot + 1, ..named }.robot_name(), "");
        assert_eq!(DecisionV1 { robot_name: [0; NAME_BYTES], ..named }.robot_name(), "");
        DecisionV1 { robot_name: [1; NAME_BYTES], ..named }.check().unwrap_err();
    }
}
