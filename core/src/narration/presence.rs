//! Whether a person is in the house, said by a sensor, by a narrator or in a plain sentence. It is no sentence for the language model.

use std::fmt;

use super::SENTENCE_BYTES_MAX;
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
}

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
        let statement = Self { presence, room: room.map(str::to_owned), subject: None };
        if presence == Presence::Unknown || !named {
            return Err(PresenceError { text: statement.to_string() });
        }
        Ok(statement)
    }

    /// Reads what [`fmt::Display`] writes: `present`, `present in the kitchen`, `away`, `gone`.
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
            "present in the" => (Presence::Unknown, None),
            "present" => (Presence::Present, None),
            "away" => (Presence::Away, None),
            "gone" => (Presence::Gone, None),
            _ => {
                let room = text.strip_prefix("present in ").map(|room| room.strip_prefix("the ").unwrap_or(room));
                (if room.is_some() { Presence::Present } else { Presence::Unknown }, room)
            }
        };
        Self::new(presence, room).map_err(|_| PresenceError { text: text.chars().take(80).collect() })
    }

    /// What a plain sentence says of its person: "They leave the house.", "Ada comes home."; none where it says something else.
    #[must_use]
    pub fn of_sentence(sentence: &str) -> Option<Self> {
        const LEAVES: [&str; 10] = [
            "leaves",
            "leave",
            "left",
            "goes out of",
            "go out of",
            "went out of",
            "exits",
            "exit",
            "exited",
            "have left",
        ];
        const COMES: [&str; 9] =
            ["comes", "come", "came", "returns", "return", "returned", "arrives", "arrive", "arrived"];
        const NOT_SAID: [&str; 6] = ["nobody", "noone", "no-one", "don't", "never", "please"];
        const PRONOUNS: [&str; 14] = [
            "they",
            "he",
            "she",
            "it",
            "i",
            "we",
            "you",
            "somebody",
            "someone",
            "everybody",
            "everyone",
            "people",
            "all",
            "both",
        ];
        const HOUSE: [&str; 6] = ["the house", "the home", "the apartment", "the flat", "the building", "home"];
        const AT_HOUSE: [&str; 10] = [
            "home",
            "back home",
            "back",
            "at home",
            "at the house",
            "back to the house",
            "to the house",
            "into the house",
            "back into the house",
            "back to the apartment",
        ];
        let lower = sentence.to_lowercase();
        let said = lower.trim().trim_end_matches(['.', '!']);
        // The subject is one word: a pronoun or a name.
        let (subject, rest) = said.split_once(' ')?;
        if NOT_SAID.contains(&subject) {
            return None;
        }
        let follows = |verbs: &[&str], places: &[&str]| {
            let mut places_of = verbs.iter().filter_map(|verb| rest.strip_prefix(verb)?.strip_prefix(' '));
            places_of.any(|place| places.contains(&place))
        };
        let presence = if follows(&LEAVES, &HOUSE) || ["goes out", "go out", "went out"].contains(&rest) {
            Presence::Away
        } else if follows(&COMES, &AT_HOUSE) {
            Presence::Present
        } else {
            return None;
        };
        let subject = Some(subject).filter(|subject| !PRONOUNS.contains(subject)).map(str::to_owned);
        Some(Self { presence, room: None, subject })
    }

    /// What is said.
    #[must_use]
    pub fn presence(&self) -> Presence {
        self.presence
    }

    /// The subject of the plain sentence that said it, in lower case, where it is no pronoun.
    #[must_use]
    pub fn subject(&self) -> Option<&str> {
        self.subject.as_deref()
    }

    /// The room that the person is in, in the narrator's words.
    #[must_use]
    pub fn room(&self) -> Option<&str> {
        self.room.as_deref()
    }
}

impl fmt::Display for PresenceStatement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.presence.as_str())?;
        self.room.iter().try_for_each(|room| write!(f, " in the {room}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        for text in ["present", "present in the kitchen", "present in the living room", "away", "gone"] {
            assert_eq!(PresenceStatement::parse(text).unwrap().to_string(), text);
        }
        for text in
            ["", "unknown", "present in", "present in the ", "asleep", "away in the kitchen", "present in \u{202e}"]
        {
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
            "",
        ] {
            assert_eq!(of(sentence), None, "{sentence}");
        }
    }
}
