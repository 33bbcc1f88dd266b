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
    of_everybody: bool,
}

/// What stands before the presence of everybody, and before a room that nobody is in.
const EVERYBODY: &str = "everybody ";
const NOBODY: &str = "nobody in the ";
/// Subjects of sentences that say nothing of where anybody is.
const NOT_SAID: [&str; 3] = ["don't", "never", "please"];
/// Subjects that are no names.
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
const LEAVES: [&str; 12] = [
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
    "has left",
    "walks out of",
];
/// Verbs of going, and where somebody goes who is out then.
const GOES: [&str; 10] =
    ["goes", "go", "went", "has gone", "have gone", "is going", "are going", "is off", "are off", "heads"];
const ERRANDS: [&str; 11] = [
    "out",
    "to work",
    "to school",
    "to university",
    "to town",
    "to the shop",
    "to the shops",
    "to the supermarket",
    "shopping",
    "for a walk",
    "for a run",
];
const COMES: [&str; 9] = ["comes", "come", "came", "returns", "return", "returned", "arrives", "arrive", "arrived"];
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
/// What somebody is who is out of the house, and who is in it.
const OUT: [&str; 19] = [
    "away",
    "out",
    "gone",
    "gone out",
    "abroad",
    "not home",
    "not at home",
    "not in",
    "not here",
    "not in the house",
    "away from home",
    "out of the house",
    "out of home",
    "at work",
    "at school",
    "on holiday",
    "on vacation",
    "on a trip",
    "travelling",
];
const IN: [&str; 8] = ["home", "at home", "back", "back home", "in", "here", "in the house", "at the house"];
/// The last words of what rooms are called. What else somebody is in, as the bath, is for the language model.
const ROOMS: [&str; 20] = [
    "kitchen",
    "kitchenette",
    "bathroom",
    "bedroom",
    "room",
    "office",
    "study",
    "hall",
    "hallway",
    "corridor",
    "entrance",
    "lounge",
    "garage",
    "cellar",
    "basement",
    "attic",
    "pantry",
    "nursery",
    "playroom",
    "library",
];

/// What a sentence's words after its subject say of where somebody is: presence, and the room where it is one.
fn predicate(rest: &str) -> Option<(Presence, Option<&str>)> {
    let rest = rest.strip_prefix("just ").unwrap_or(rest);
    let follows = |verbs: &[&str], places: &[&str]| follows(rest, verbs, places);
    if follows(&LEAVES, &HOUSE) || follows(&LEAVES, &["for work", "for school"]) || goes_out(rest) {
        return Some((Presence::Away, None));
    }
    if arrives(rest) {
        return Some((Presence::Present, None));
    }
    let state = state(rest)?;
    if OUT.contains(&state) {
        return Some((Presence::Away, None));
    }
    if IN.contains(&state) {
        return Some((Presence::Present, None));
    }
    let room = state.strip_prefix("in the ").or_else(|| state.strip_prefix("at the "))?;
    let last = room.split([' ', '-']).next_back().unwrap_or_default();
    ROOMS.contains(&last).then_some((Presence::Present, Some(room)))
}

/// Whether words begin with one of the verbs and one of the places, and end there or go on with something else.
fn follows(rest: &str, verbs: &[&str], places: &[&str]) -> bool {
    const GOES_ON: [&str; 5] = [" and ", " with ", " for ", " to ", ","];
    let mut places_of = verbs.iter().filter_map(|verb| rest.strip_prefix(verb)?.strip_prefix(' '));
    let ends = |more: &str| more.is_empty() || GOES_ON.iter().any(|word| more.starts_with(word));
    places_of.any(|said| places.iter().any(|place| said.strip_prefix(place).is_some_and(ends)))
}

/// Whether a sentence's words after its subject say that somebody comes home.
fn arrives(rest: &str) -> bool {
    follows(rest, &COMES, &AT_HOUSE) || state(rest).is_some_and(|state| ["back", "back home"].contains(&state))
}

/// Whether a sentence's words after its subject say that somebody goes where they are out of the house: "has gone to work".
fn goes_out(rest: &str) -> bool {
    follows(rest, &GOES, &ERRANDS)
}

/// What somebody is, in a sentence that says it: "is still away" is "away".
fn state(rest: &str) -> Option<&str> {
    let mut state = ["is ", "are ", "am "].iter().find_map(|verb| rest.strip_prefix(verb))?;
    while let Some(rest) =
        ["still ", "now ", "already ", "currently ", "just "].iter().find_map(|word| state.strip_prefix(word))
    {
        state = rest;
    }
    Some(state)
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
        let statement = Self { presence, room: room.map(str::to_owned), subject: None, of_everybody: false };
        if presence == Presence::Unknown || !named {
            return Err(PresenceError { text: statement.to_string() });
        }
        Ok(statement)
    }

    /// Reads what [`fmt::Display`] writes: `present`, `present in the kitchen`, `nobody in the kitchen`, `away`, `everybody away`, `gone`.
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
            _ if text.starts_with(NOBODY) => return Self::empty(&text[NOBODY.len()..]),
            "gone" => (Presence::Gone, None),
            _ => {
                let room = text.strip_prefix("present in ").map(|room| room.strip_prefix("the ").unwrap_or(room));
                (if room.is_some() { Presence::Present } else { Presence::Unknown }, room)
            }
        };
        Self::new(presence, room).map_err(|_| PresenceError { text: text.chars().take(80).collect() })
    }

    /// What a plain sentence says of its person: "They leave the house.", "Ada comes home.", "Ben is at work.", "Somebody is in the kitchen.";
    /// or of everybody: "Nobody is home." None where it says something else.
    #[must_use]
    pub fn of_sentence(sentence: &str) -> Option<Self> {
        let lower = sentence.to_lowercase();
        let said = lower.trim().trim_end_matches(['.', '!']);
        if ["the house is empty", "the home is empty", "the apartment is empty", "the flat is empty"].contains(&said) {
            return Some(Self::of_all(Presence::Away));
        }
        // The subject is one word: a pronoun or a name.
        let (subject, rest) = match said.strip_prefix("no one ") {
            Some(rest) => ("nobody", rest),
            None => said.split_once(' ')?,
        };
        if NOT_SAID.contains(&subject) {
            return None;
        }
        // Who has left, and says not what, has left the house.
        let has_left = ["left", "has left", "have left"].contains(&rest);
        let (presence, room) = if has_left { (Presence::Away, None) } else { predicate(rest)? };
        let of_everybody = match subject {
            "nobody" | "noone" | "no-one" => {
                // That nobody leaves says of nobody where they are.
                let nobody_is_in = presence == Presence::Present && state(rest).is_some();
                let statement = room.map_or_else(|| Some(Self::of_all(Presence::Away)), |room| Self::empty(room).ok());
                return statement.filter(|_| nobody_is_in);
            }
            "everybody" | "everyone" | "all" | "both" => true,
            _ => false,
        };
        // Where each of them is, no sentence about all of them says.
        if of_everybody {
            return (room.is_none() && presence == Presence::Away).then_some(Self::of_all(presence));
        }
        let subject = Some(subject).filter(|subject| !PRONOUNS.contains(subject)).map(str::to_owned);
        Some(Self { subject, ..Self::new(presence, room).ok()? })
    }

    /// Whether a plain sentence says that its person comes home: who is there already is not meant.
    #[must_use]
    pub fn is_arrival(sentence: &str) -> bool {
        let lower = sentence.to_lowercase();
        let said = lower.trim().trim_end_matches(['.', '!']);
        said.split_once(' ').is_some_and(|(_, rest)| arrives(rest))
    }

    /// The same statement of a sentence with this subject.
    #[must_use]
    pub fn with_subject(self, subject: &str) -> Self {
        Self { subject: Some(subject.to_owned()), ..self }
    }

    fn of_all(presence: Presence) -> Self {
        Self { presence, room: None, subject: None, of_everybody: true }
    }

    /// That nobody is in a room: of everybody who is in the house, wherever else they are.
    fn empty(room: &str) -> Result<Self, PresenceError> {
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

    /// The subject of the plain sentence that said it, in lower case, where it is no pronoun.
    #[must_use]
    pub fn subject(&self) -> Option<&str> {
        self.subject.as_deref()
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
        for text in
            ["present", "present in the kitchen", "present in the living room", "away", "everybody away", "gone"]
        {
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
        ] {
            let statement = of(sentence);
            assert_eq!((statement.to_string().as_str(), statement.subject()), (said, subject), "{sentence}");
            assert_eq!(statement.is_of_everybody(), of_everybody, "{sentence}");
        }
    }
}
