//! Whether a person is in the house, said by a sensor, by a narrator or in a plain sentence. It is no sentence for the language model.

use std::fmt;

use super::clause::{self, Clause, Subject};
use super::reading::{self, Fact};
use super::{Pronoun, SENTENCE_BYTES_MAX};
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
#[error("{text:?} is no presence: say `present`, `present in the kitchen`, `nobody in the kitchen`, `away` or `gone`")]
pub struct PresenceError {
    text: String,
}

/// What was said of a person's presence.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct PresenceStatement {
    presence: Presence,
    room: Option<String>,
    subject: Option<String>,
    whose: Whose,
    pronoun: Option<Pronoun>,
    /// It is of somebody whom its sentence is not about.
    is_beside: bool,
}

/// Whose presence a statement is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Whose {
    /// The subject's, or that of whom the narrator names.
    Subject,
    Everybody,
    /// That of so many who are there, and no others are.
    SoMany(usize),
    /// That of all who do not live here.
    Guests,
    /// That of everybody but the subject.
    Others,
    /// The subject's; everybody else is away.
    SubjectAlone,
    /// Nobody is in the room.
    Nobody,
}

/// What stands before the presence of everybody, and before a room that nobody is in.
const EVERYBODY: &str = "everybody ";
const BOTH: &str = "both ";
const GUESTS: &str = "guests ";
/// What stands before a number of persons, from three to what a number in words is read of.
const ALL: &str = "all ";
const SO_MANY: std::ops::RangeInclusive<usize> = 3..=clause::COUNT_MAX;
const OTHERS: &str = "everybody else ";
const ALONE: &str = "alone ";
const NOBODY: &str = "nobody in the ";
/// What stands between the names in a subject.
const AND: &str = " and ";

/// The group that a written statement begins with, and what it says of it.
fn group(text: &str) -> Option<(&str, Whose)> {
    let groups = [(EVERYBODY, Whose::Everybody), (BOTH, Whose::SoMany(2)), (GUESTS, Whose::Guests)];
    let so_many = || {
        let (count, rest) = text.strip_prefix(ALL)?.split_once(' ')?;
        let count = count.parse().ok().filter(|count| SO_MANY.contains(count))?;
        Some((rest, Whose::SoMany(count)))
    };
    groups.into_iter().find_map(|(group, whose)| Some((text.strip_prefix(group)?, whose))).or_else(so_many)
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
        let statement = Self {
            presence,
            room: room.map(str::to_owned),
            subject: None,
            whose: Whose::Subject,
            pronoun: None,
            is_beside: false,
        };
        if presence == Presence::Unknown || !named {
            return Err(PresenceError { text: statement.to_string() });
        }
        Ok(statement)
    }

    /// Reads what [`fmt::Display`] writes: `present`, `present in the kitchen`, `nobody in the kitchen`, `away`, `everybody away`,
    /// `everybody present`, `everybody present in the kitchen`, `both away`, `all 3 away`, `guests away`, `gone`.
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
            _ if let Some((rest, whose)) = group(text) => {
                let all = Self::parse(rest)?;
                // Nobody but a visitor is gone.
                let is_of_all = all.whose == Whose::Subject && all.presence != Presence::Gone;
                let error = || PresenceError { text: text.chars().take(80).collect() };
                return is_of_all.then_some(Self { whose, ..all }).ok_or_else(error);
            }
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
        // Most say nothing of that.
        let is_any = reading::is(Fact::IsStatement, sentence, |plain| Self::of_plain(plain).is_some());
        is_any.then(|| reading::with_plain(sentence, Self::of_plain)).flatten()
    }

    /// The same of a sentence in plain form.
    pub(super) fn of_plain(said: &str) -> Option<Self> {
        let Clause { subject, presence, room, is_state, .. } = Clause::read(said)?;
        let of = |whose| Some(Self { whose, ..Self::new(presence, room).ok()? });
        let of_names = |whose, names: &[&str]| Some(of(whose)?.with_subjects(names));
        match subject {
            Subject::Other => None,
            // That nobody leaves says of nobody where they are.
            Subject::Nobody if presence != Presence::Present || !is_state => None,
            Subject::Nobody if room.is_some() => of(Whose::Nobody),
            Subject::Nobody => Some(Self { presence: Presence::Away, ..of(Whose::Everybody)? }),
            Subject::Everybody => of(Whose::Everybody),
            Subject::SoMany(count) => of(Whose::SoMany(count)),
            Subject::Guests => of(Whose::Guests),
            Subject::Others(names) => of_names(Whose::Others, &names),
            // Where only one is, others may be elsewhere in the house.
            Subject::Only(names) if presence == Presence::Present && is_state && room.is_none() => {
                of_names(Whose::SubjectAlone, &names)
            }
            Subject::Only(names) | Subject::Named(names) => of_names(Whose::Subject, &names),
            Subject::Unnamed => Some(Self { pronoun: clause::pronoun(said), ..of(Whose::Subject)? }),
        }
    }

    /// Whether a plain sentence says that its person comes home: who is there already is not meant.
    #[must_use]
    pub fn is_arrival(sentence: &str) -> bool {
        reading::is(Fact::IsArrival, sentence, clause::is_arrival)
    }

    /// The same of somebody whom its sentence is not about: of Ben, where it is "Ada hugs Ben."
    #[must_use]
    pub fn beside(self) -> Self {
        Self { is_beside: true, ..self }
    }

    /// Whether it is of somebody whom its sentence is not about.
    #[must_use]
    pub fn is_beside(&self) -> bool {
        self.is_beside
    }

    /// The same, said by a pronoun.
    #[must_use]
    pub fn with_pronoun(self, pronoun: Option<Pronoun>) -> Self {
        Self { pronoun, ..self }
    }

    fn with_subject(self, subject: &str) -> Self {
        Self { subject: Some(subject.to_owned()), ..self }
    }

    /// The same statement of a sentence about these names.
    pub(super) fn with_subjects<N: AsRef<str>>(self, names: &[N]) -> Self {
        let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
        self.with_subject(&names.join(AND))
    }

    /// Reads what [`fmt::Display`] wrote of a statement with a subject.
    ///
    /// # Errors
    /// As [`PresenceStatement::parse`].
    pub fn parse_of(text: &str, subject: &str) -> Result<Self, PresenceError> {
        let (rest, whose) = match (text.strip_prefix(OTHERS), text.strip_prefix(ALONE)) {
            (Some(rest), _) => (rest, Some(Whose::Others)),
            (_, Some(rest)) => (rest, Some(Whose::SubjectAlone)),
            _ => (text, None),
        };
        let statement = Self::parse(rest)?;
        Ok(Self { whose: whose.unwrap_or(statement.whose), ..statement }.with_subject(subject))
    }

    /// The same of those who are known, whatever stands before their names: of Ben, where it is of "sadly ben".
    #[must_use]
    pub fn of_known(self, mut is_known: impl FnMut(&str) -> bool) -> Self {
        let mut known = |name: &str| {
            let mut ends = name.match_indices(' ').map(|(at, _)| (&name[..at], &name[at + 1..]));
            let (_, own) = ends.find(|(before, own)| !clause::is_part_of_a_name(before) && is_known(own))?;
            (!is_known(name)).then(|| own.to_owned())
        };
        let names: Vec<_> = self.all_names().map(|name| (known(name), name)).collect();
        if names.iter().all(|(own, _)| own.is_none()) {
            return self;
        }
        let names: Vec<_> = names.into_iter().map(|(own, name)| own.unwrap_or_else(|| name.to_owned())).collect();
        self.with_subjects(&names)
    }

    /// The same of one person, who may be said to be elsewhere.
    pub(super) fn of_one(&self, presence: Presence) -> Self {
        let room = self.room.clone().filter(|_| presence == Presence::Present);
        Self { presence, room, subject: None, whose: Whose::Subject, pronoun: self.pronoun, is_beside: self.is_beside }
    }

    /// The same of who goes out instead.
    pub(super) fn leaving(self) -> Self {
        Self { presence: Presence::Away, room: None, ..self }
    }

    /// What it says of each of those whom it names; none where it says nothing of them.
    #[must_use]
    pub fn of_named(&self) -> Option<Self> {
        matches!(self.whose, Whose::Subject | Whose::SubjectAlone).then(|| self.of_one(self.presence))
    }

    /// What it says of each of those whom it does not name; none where it says nothing of them.
    #[must_use]
    pub fn of_others(&self) -> Option<Self> {
        match self.whose {
            Whose::Everybody | Whose::SoMany(_) | Whose::Guests | Whose::Others => Some(self.of_one(self.presence)),
            Whose::SubjectAlone => Some(self.of_one(Presence::Away)),
            Whose::Subject | Whose::Nobody => None,
        }
    }

    /// That nobody is in a room: of everybody who is in the house, wherever else they are.
    ///
    /// # Errors
    /// As [`PresenceStatement::new`].
    pub fn empty(room: &str) -> Result<Self, PresenceError> {
        Ok(Self { whose: Whose::Nobody, ..Self::new(Presence::Present, Some(room))? })
    }

    /// The room that nobody is in, where that is said.
    #[must_use]
    pub fn empty_room(&self) -> Option<&str> {
        self.room.as_deref().filter(|_| self.whose == Whose::Nobody)
    }

    /// Whether it is said of others than the narration's own person, or than those whom it names.
    #[must_use]
    pub fn is_of_everybody(&self) -> bool {
        self.whose != Whose::Subject
    }

    /// Of how many who are there it is said, where no others are.
    #[must_use]
    pub fn is_of_so_many(&self) -> Option<usize> {
        if let Whose::SoMany(count) = self.whose { Some(count) } else { None }
    }

    /// Whether it is said of all who do not live here.
    #[must_use]
    pub fn is_of_guests(&self) -> bool {
        self.whose == Whose::Guests
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

    /// The pronoun of the plain sentence that said it, where it is of one person by that.
    #[must_use]
    pub fn pronoun(&self) -> Option<Pronoun> {
        self.pronoun
    }

    /// The names of those whom it is about.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.all_names().filter(|_| self.whose != Whose::Others)
    }

    /// The names of those whom it is not about: everybody else is meant.
    pub fn excepted(&self) -> impl Iterator<Item = &str> {
        self.all_names().filter(|_| self.whose == Whose::Others)
    }

    /// All names in it.
    pub(super) fn all_names(&self) -> impl Iterator<Item = &str> {
        self.subject.iter().flat_map(|subject| subject.split(AND))
    }

    /// The room that the person is in, in the narrator's words.
    #[must_use]
    pub fn room(&self) -> Option<&str> {
        self.room.as_deref().filter(|_| self.whose != Whose::Nobody)
    }
}

impl fmt::Display for PresenceStatement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(room) = self.empty_room() {
            return write!(f, "{NOBODY}{room}");
        }
        f.write_str(match self.whose {
            Whose::Everybody => EVERYBODY,
            Whose::SoMany(2) => BOTH,
            Whose::SoMany(count) => return write!(f, "{ALL}{count} {}", self.of_one(self.presence)),
            Whose::Guests => GUESTS,
            Whose::Others => OTHERS,
            Whose::SubjectAlone => ALONE,
            Whose::Subject | Whose::Nobody => "",
        })?;
        f.write_str(self.presence.as_str())?;
        self.room.iter().try_for_each(|room| write!(f, " in the {room}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever is told what can be said can say all of it, and no form of one person or room is left out.
    #[test]
    fn the_error_names_forms_that_are_read() {
        let error = PresenceStatement::parse("empty kitchen").unwrap_err().to_string();
        let forms: Vec<&str> = error.split('`').skip(1).step_by(2).collect();
        assert_eq!(forms, ["present", "present in the kitchen", "nobody in the kitchen", "away", "gone"]);
        for form in forms {
            assert_eq!(PresenceStatement::parse(form).unwrap().to_string(), form);
        }
    }

    #[test]
    fn what_is_written_is_read() {
        for text in [
            "present",
            "present in the kitchen",
            "present in the living room",
            "away",
            "everybody away",
            "everybody present",
            "everybody present in the kitchen",
            "both away",
            "both present in the kitchen",
            "all 3 away",
            "all 4 present in the kitchen",
            "guests away",
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
            "everybody gone",
            "guests gone",
            "all 1 away",
            "all 2 away",
            "all 99 away",
            "all away",
            "everybody else away",
            "everybody everybody away",
            "everybody nobody in the kitchen",
            "alone present",
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
            "They leave.",
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
            "Nobody leaves the house.",
            "They are in the bath.",
            "They are tired.",
            "The dishwasher is out.",
            "When Ada leaves the house",
            "Either Ada or Ben is away.",
            "Everybody else leaves the house.",
            "Ada and the dishwasher are out.",
            "Is Ada at home?",
            "\"Everybody leaves the house\", says the radio.",
            "Ben shouts: “Ada leaves the house!”",
            "Both parents go to work.",
            "2 people are in the kitchen.",
            "Jonas says goodbye to Priya, who leaves the house.",
            "Everybody leaves for bed.",
            "Everybody leaves for the living room.",
            "Everybody is gone from the kitchen.",
            "Ada is away from the desk.",
            "Everybody leaves tonight.",
            "Everybody is out now?",
            "Everybody leaves the house, if the alarm rings.",
            "Nobody is home, is it?",
            "Nobody is home at night.",
            "Nobody is back yet.",
            "Only Lily is back.",
            "Nobody is home with Lily.",
            "Only Lily is home with Ben.",
            "Everybody except me leaves the house.",
            "Nobody but him is home.",
            "Ben walks to the office to work.",
            "Ada walks upstairs to work at her desk.",
            "Ada goes to work at her desk.",
            "Ben drops his bag at the office.",
            "Ada picks up the phone from work.",
            "They bring the cup back.",
            "Grandparents leave the house.",
            "Sophie takes the mug from the table.",
            "Sophie picks up the bag from the chair.",
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
            ("Everybody is in the kitchen.", "everybody present in the kitchen", None, true),
            ("Everybody leaves.", "everybody away", None, true),
            ("Everybody except Igor leaves.", "everybody else away", Some("igor"), true),
            (
                "Everybody but Ada and the plumber leaves the house.",
                "everybody else away",
                Some("ada and plumber"),
                true,
            ),
            ("Everybody leaves the house, except for Igor.", "everybody else away", Some("igor"), true),
            (
                "All of us are in the garden room apart from Ben.",
                "everybody else present in the garden room",
                Some("ben"),
                true,
            ),
            ("Only Lily is home.", "alone present", Some("lily"), true),
            ("Nobody but Lily is at home.", "alone present", Some("lily"), true),
            ("Nobody is home except Lily.", "alone present", Some("lily"), true),
            ("Only Ada and Ben are home.", "alone present", Some("ada and ben"), true),
            ("Only Lily leaves the house.", "away", Some("lily"), false),
            ("Only Lily is in the kitchen.", "present in the kitchen", Some("lily"), false),
            ("Lily stays home.", "present", Some("lily"), false),
            ("Lily is home alone.", "alone present", Some("lily"), true),
            ("The house is empty except for Lily.", "alone present", Some("lily"), true),
            ("The kitchen is empty except for Lily.", "present in the kitchen", Some("lily"), false),
            ("Ada leaves the house and comes back.", "present", Some("ada"), false),
            ("Everybody goes to the kitchen.", "everybody present in the kitchen", None, true),
            (
                "Everybody but Lily sits down in the living room.",
                "everybody else present in the living room",
                Some("lily"),
                true,
            ),
            ("Will leaves the house.", "away", Some("will"), false),
            ("Ada takes the dog for a walk.", "away", Some("ada"), false),
            ("Everybody leaves for work.", "everybody away", None, true),
            ("Lily and Ada are alone at home now.", "alone present", Some("lily and ada"), true),
            ("Lily is alone in the kitchen.", "present in the kitchen", Some("lily"), false),
            ("Everybody leaves the house without Lily.", "everybody else away", Some("lily"), true),
            ("Ada leaves the house without Lily.", "away", Some("ada"), false),
            ("Ada, Ben and Lily leave the house.", "away", Some("ada and ben and lily"), false),
            ("Sophie drops Lily off at school.", "away", Some("sophie"), false),
            ("Sophie picks up Lily from school.", "away", Some("sophie"), false),
            ("Sophie brings Lily home.", "present", Some("sophie"), false),
            ("Sophie takes Lily to school.", "away", Some("sophie"), false),
            ("Ben drives to work and Ada stays at home.", "away", Some("ben"), false),
        ] {
            let statement = of(sentence);
            if let Some(subject) = subject {
                assert_eq!(PresenceStatement::parse_of(said, subject).unwrap(), statement, "{sentence}");
            }
            assert_eq!((statement.to_string().as_str(), statement.subject()), (said, subject), "{sentence}");
            assert_eq!(statement.is_of_everybody(), of_everybody, "{sentence}");
        }
    }
}
