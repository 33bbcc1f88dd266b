//! Enums for the numbers in messages.

use std::fmt;

use crate::raw::{action, narration_kind, presence, reached, report_kind};

macro_rules! words {
    ($(#[$about:meta])* $name:ident of $module:ident: $($(#[$doc:meta])* $variant:ident = $constant:ident $word:literal),+ $(,)?) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum $name {
            $($(#[$doc])* $variant,)+
            /// A number that this version does not know.
            Unknown(u32),
        }

        impl $name {
            /// The meaning of a number in a message.
            #[must_use]
            pub const fn of(number: u32) -> Self {
                match number {
                    $($module::$constant => Self::$variant,)+
                    other => Self::Unknown(other),
                }
            }

            /// Its number in messages.
            #[must_use]
            pub const fn number(self) -> u32 {
                match self {
                    $(Self::$variant => $module::$constant,)+
                    Self::Unknown(number) => number,
                }
            }

            /// The word for it.
            #[must_use]
            pub const fn word(self) -> &'static str {
                match self {
                    $(Self::$variant => $word,)+
                    Self::Unknown(_) => "unknown",
                }
            }

            /// The meaning of a word; `None` for a word that this version does not know.
            #[must_use]
            pub fn of_word(word: &str) -> Option<Self> {
                match word {
                    $($word => Some(Self::$variant),)+
                    _ => None,
                }
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(self.word())
            }
        }
    };
}

words! {
    /// What a decision asks of the robot.
    Action of action:
    /// The robot waits.
    Stay = STAY "stay",
    /// The robot goes to the room and works there.
    Go = GO "go",
    /// The robot stops its work and waits at a place without people.
    Pause = PAUSE "pause",
}

words! {
    /// Why scoring stopped.
    Reached of reached:
    /// Every label was scored.
    Exact = EXACT "exact",
    /// The ranking of the rooms is certain.
    Ranking = RANKING "ranking",
    /// The most likely room is certain.
    Top = TOP "top",
    /// Time ran out.
    Deadline = DEADLINE "deadline",
}

words! {
    /// Whether a person is in the house.
    Presence of presence:
    /// No event has named the person.
    NotObserved = UNKNOWN "unknown",
    /// In the house.
    Present = PRESENT "present",
    /// Out of the house, and expected back.
    Away = AWAY "away",
    /// Out of the house, and not expected back.
    Gone = GONE "gone",
}

words! {
    /// The kind of a narration.
    NarrationKind of narration_kind:
    /// A sentence.
    Sentence = SENTENCE "sentence",
    /// An action in VirtualHome's notation.
    Action = ACTION "action",
    /// The state of a device.
    Device = DEVICE "device",
    /// The presence of a person, or an empty room.
    Presence = PRESENCE "presence",
}

words! {
    /// The kind of a robot's report.
    ReportKind of report_kind:
    /// The position of the robot.
    Position = POSITION "position",
    /// The robot has begun to work in the room.
    Started = STARTED "started",
    /// The work in the room is done.
    Finished = FINISHED "finished",
    /// The work in the room failed.
    Failed = FAILED "failed",
    /// The robot cannot enter the room.
    Blocked = BLOCKED "blocked",
    /// The robot is at its dock.
    Docked = DOCKED "docked",
    /// The level of the battery.
    Battery = BATTERY "battery",
    /// A person or the robot cancelled the decision.
    Cancelled = CANCELLED "cancelled",
    /// An order of a person: the robot does not work.
    Hold = HOLD "hold",
    /// An order of a person: the hold ends.
    Resume = RESUME "resume",
    /// An order of a person: clean the room now.
    Clean = CLEAN "clean",
    /// An order of a person: skip the room today.
    Skip = SKIP "skip",
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_number_and_each_word_give_the_same_meaning_back() {
        for number in 0..4 {
            assert_eq!(Action::of(number).number(), number);
            assert_eq!(Presence::of_word(Presence::of(number).word()), Some(Presence::of(number)));
        }
        for number in 0..12 {
            assert_eq!(ReportKind::of_word(ReportKind::of(number).word()), Some(ReportKind::of(number)));
        }
    }

    #[test]
    fn an_unknown_number_keeps_its_number_and_an_unknown_word_is_none() {
        assert_eq!((Action::of(99), Action::of(99).word()), (Action::Unknown(99), "unknown"));
        assert_eq!(Action::Unknown(99).number(), 99);
        assert_eq!((Action::of_word("dance"), Action::of_word("unknown")), (None, None));
    }
}
