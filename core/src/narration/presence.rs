//! Whether a person is in the house, said by a sensor, by a narrator or in a plain sentence. It is no sentence for the language model.

use std::fmt;

use super::SENTENCE_BYTES_MAX;
use super::clause::{self, Clause, Subject};
use crate::text::is_hidden;

/// Whether a person is in the house.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Presence {
    /// Nothing was observed of the person.
    #[default]
    Unknown,
    /// In the house.
    Present,
    /// Out of the house, and expected back.
    Away,
    /// Out of the house, and not expected back.
    Gone,
}

impl Presence {
    /// Its name in messages and on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::Present => "present",
            Self::Away => "away",
            Self::Gone => "gone",
        }
    }
}

/// Why a text says nothing about presence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no presence: say `present`, `present in the kitchen`, `away` or `gone`")]
pub struct PresenceError {
    text: String,
}

/// What was said of a person's presence.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct PresenceStatement {
    presence: Presence,
    room: Option<String>,
    subject: Option<String>,
    of_everybody: bool,
}

/// What stands before the presence of everybody, and before a room that nobody is in.
const EVERYBODY: &str = "everybody ";
const NOBODY: &str = "nobody in the ";
/// What stands between the names in a subject.
const AND: &str = " and ";

impl PresenceStatement {
    /// A statement; a room is kept only for who is present.
    ///
    /// # Errors
    /// An unknown presence states nothing, and a room's name has letters or digits, no control characters, and fits into a message.
    pub fn new(presence: Presence, room: Option<&str>) -> Result<Self, PresenceError> {
        let room = room.map(str::trim).filter(|_| presence == Presence::Present);
        let named = room.is_none_or(|room| {
            room.contains(char::is_alphanumeric) && !room.contains(is_hidden) && room.len() <= SENTENCE_BYTES_MAX / 2
        });
        let statement = Self { presence, room: room.map(str::to_owned), subject: None, of_everybody: false };
        if presence == Presence::Unknown || !named {
            return Err(PresenceError { text: statement.to_string() });
        }
        Ok(statement)
    }

    /// Reads what [`fmt::Display`] writes: `present`, `present in the kitchen`, `nobody in the kitchen`, `away`, `everybody away`,
    /// `everybody present`, `gone`.
    ///
    /// # Errors
    /// Anything else.
    ///
    /// ```
    /// use roomcast_core::narration::{Presence, PresenceStatement};
    ///
    /// let statement = PresenceStatement::parse("present in the kitchen")?;
    /// assert_eq!((statement.presence(), statement.room()), (Presence::Present, Some("kitchen")));
    /// # Ok::<(), roomcast_core::narration::PresenceError>(())
    /// ```
    pub fn parse(text: &str) -> Result<Self, PresenceError> {
        let text = text.trim();
        let (presence, room) = match text {
            // An article alone names no room.
            "present in the" | "nobody in the" => (Presence::Unknown, None),
            "present" => (Presence::Present, None),
            "away" => (Presence::Away, None),
            "everybody away" => return Ok(Self::of_all(Presence::Away)),
            "everybody present" => return Ok(Self::of_all(Presence::Present)),
            _ if text.starts_with(NOBODY) => return Self::empty(&text[NOBODY.len()..]),
            "gone" => (Presence::Gone, None),
            _ => {
                let room = text.strip_prefix("present in ").map(|room| room.strip_prefix("the ").unwrap_or(room));
                (if room.is_some() { Presence::Present } else { Presence::Unknown }, room)
            }
        };
        Self::new(presence, room).map_err(|_| PresenceError { text: text.chars().take(80).collect() })
    }

    /// What a plain sentence says of its persons: "They leave the house.", "Ada and Ben come home.", "The plumber is in the kitchen."; or of
    /// everybody: "Nobody is home." None where it says something else.
    #[must_use]
    pub fn of_sentence(sentence: &str) -> Option<Self> {
        clause::with_plain(sentence, Self::of_plain)
    }

    fn of_plain(said: &str) -> Option<Self> {
        let clause = Clause::read(said)?;
        let Clause { presence, room, .. } = clause;
        let of_everybody = match &clause.subject {
            // That nobody leaves says of nobody where they are.
            Subject::Nobody => {
                let statement = room.map_or_else(|| Some(Self::of_all(Presence::Away)), |room| Self::empty(room).ok());
                return statement.filter(|_| presence == Presence::Present && clause.is_state);
            }
            Subject::Other => return None,
            Subject::Everybody => true,
            Subject::Unnamed | Subject::Named(_) => false,
        };
        // Where each of them is, no sentence about all of them says.
        if of_everybody {
            return room.is_none().then_some(Self::of_all(presence));
        }
        let statement = Self::new(presence, room).ok()?;
        Some(match clause.subject {
            Subject::Named(names) => statement.with_subjects(&names),
            _ => statement,
        })
    }

    /// Whether a plain sentence says that its person comes home: who is there already is not meant.
    #[must_use]
    pub fn is_arrival(sentence: &str) -> bool {
        clause::with_plain(sentence, |said| Clause::read(said).is_some_and(|clause| clause.is_arrival))
    }

    /// The same statement of a sentence with this subject.
    #[must_use]
    pub fn with_subject(self, subject: &str) -> Self {
        Self { subject: Some(subject.to_owned()), ..self }
    }

    /// The same statement of a sentence about these names.
    pub(super) fn with_subjects<N: AsRef<str>>(self, names: &[N]) -> Self {
        let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
        self.with_subject(&names.join(AND))
    }

    fn of_all(presence: Presence) -> Self {
        Self { presence, room: None, subject: None, of_everybody: true }
    }

    /// That nobody is in a room: of everybody who is in the house, wherever else they are.
    ///
    /// # Errors
    /// As [`PresenceStatement::new`].
    pub fn empty(room: &str) -> Result<Self, PresenceError> {
        Ok(Self { of_everybody: true, ..Self::new(Presence::Present, Some(room))? })
    }

    /// The room that nobody is in, where that is said.
    #[must_use]
    pub fn empty_room(&self) -> Option<&str> {
        self.room.as_deref().filter(|_| self.of_everybody)
    }

    /// Whether it is said of everybody who lives here or is in the house.
    #[must_use]
    pub fn is_of_everybody(&self) -> bool {
        self.of_everybody
    }

    /// What is said.
    #[must_use]
    pub fn presence(&self) -> Presence {
        self.presence
    }

    /// The subject of the plain sentence that said it, in lower case, where it is no pronoun: "ada", or "ada and ben".
    #[must_use]
    pub fn subject(&self) -> Option<&str> {
        self.subject.as_deref()
    }

    /// The names in the subject.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.subject.iter().flat_map(|subject| subject.split(AND))
    }

    /// The room that the person is in, in the narrator's words.
    #[must_use]
    pub fn room(&self) -> Option<&str> {
        self.room.as_deref().filter(|_| !self.of_everybody)
    }
}

impl fmt::Display for PresenceStatement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(room) = self.empty_room() {
            return write!(f, "{NOBODY}{room}");
        }
        if self.of_everybody {
            f.write_str(EVERYBODY)?;
        }
        f.write_str(self.presence.as_str())?;
        self.room.iter().try_for_each(|room| write!(f, " in the {room}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        for text in [
            "present",
            "present in the kitchen",
            "present in the living room",
            "away",
            "everybody away",
            "everybody present",
            "gone",
        ] {
            assert_eq!(PresenceStatement::parse(text).unwrap().to_string(), text);
        }
        let empty = PresenceStatement::parse("nobody in the living room").unwrap();
        assert_eq!((empty.empty_room(), empty.room(), empty.is_of_everybody()), (Some("living room"), None, true));
        assert_eq!(empty.to_string(), "nobody in the living room");
        for text in [
            "",
            "unknown",
            "present in",
            "present in the ",
            "nobody in the ",
            "nobody in",
            "asleep",
            "away in the kitchen",
            "present in \u{202e}",
        ] {
            PresenceStatement::parse(text).unwrap_err();
        }
        assert_eq!(PresenceStatement::new(Presence::Away, Some("kitchen")).unwrap().room(), None);
    }

    #[test]
    fn plain_sentences_say_it_too() {
        let of = |sentence: &str| PresenceStatement::of_sentence(sentence).map(|statement| statement.presence());
        for sentence in [
            "They leave the house.",
            "Ada leaves home.",
            "She left the apartment",
            "Ben goes out.",
            "They exit the flat.",
        ] {
            assert_eq!(of(sentence), Some(Presence::Away), "{sentence}");
        }
        for sentence in ["They come home.", "Ada came back.", "She returns home.", "He arrives at home."] {
            assert_eq!(of(sentence), Some(Presence::Present), "{sentence}");
        }
        for sentence in [
            "They leave the kitchen.",
            "They leave the house key on the table.",
            "They come to the table.",
            "They go out of the kitchen.",
            "They leave.",
            "Nobody leaves the house.",
            "Everybody is in the kitchen.",
            "They are in the bath.",
            "They are tired.",
            "The dishwasher is out.",
            "When Ada leaves the house",
            "Either Ada or Ben is away.",
            "Everybody else leaves the house.",
            "Ada and the dishwasher are out.",
            "Is Ada at home?",
            "",
        ] {
            assert_eq!(of(sentence), None, "{sentence}");
        }
    }

    #[test]
    fn a_sentence_says_what_somebody_is() {
        let of = |sentence: &str| PresenceStatement::of_sentence(sentence).unwrap();
        for (sentence, said, subject, of_everybody) in [
            ("Ada is away.", "away", Some("ada"), false),
            ("Ada is still at work.", "away", Some("ada"), false),
            ("He is not at home.", "away", None, false),
            ("Ben is now home.", "present", Some("ben"), false),
            ("Somebody is in the kitchen.", "present in the kitchen", None, false),
            ("Ada is in the living room", "present in the living room", Some("ada"), false),
            ("Nobody is home.", "everybody away", None, true),
            ("No one is at home!", "everybody away", None, true),
            ("Everybody is out.", "everybody away", None, true),
            ("Everyone has left the house.", "everybody away", None, true),
            ("Everyone left.", "everybody away", None, true),
            ("Ada has gone to work.", "away", Some("ada"), false),
            ("Ben left for work", "away", Some("ben"), false),
            ("They go shopping.", "away", None, false),
            ("Ada just left for work.", "away", Some("ada"), false),
            ("Ben leaves the house and locks the door.", "away", Some("ben"), false),
            ("The house is empty.", "everybody away", None, true),
            ("Nobody is in the kitchen.", "nobody in the kitchen", None, true),
            ("The plumber leaves the house.", "away", Some("plumber"), false),
            ("Then Ada quickly leaves the house.", "away", Some("ada"), false),
            ("Aunt Mary is in the guest room.", "present in the guest room", Some("aunt mary"), false),
            ("Ada and Ben leave the house.", "away", Some("ada and ben"), false),
            ("Ada, Ben, and the plumber are away.", "away", Some("ada and ben and plumber"), false),
            ("They all come home.", "everybody present", None, true),
        ] {
            let statement = of(sentence);
            assert_eq!((statement.to_string().as_str(), statement.subject()), (said, subject), "{sentence}");
            assert_eq!(statement.is_of_everybody(), of_everybody, "{sentence}");
        }
    }
}
