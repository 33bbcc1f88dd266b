//! Narration: what a person has just done, as one sentence per observation, and the window of it that a prompt holds.
//!
//! Three kinds of observation become sentences: atomic actions in VirtualHome's notation ([`Action`]), device states
//! ([`DeviceState`]) and plain sentences of any captioning source ([`Sentence`]). An action is observed when it is complete.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;

use crate::text::is_hidden;

use reading::Fact;
use several::Holds;

mod about;
pub mod action;
mod clause;
mod deeds;
pub mod history;
pub mod line;
mod person;
mod presence;
pub mod program;
mod reading;
mod several;

pub use about::About;
pub use action::{Action, ActionEntry, ActionError, LINE_BYTES_MAX, ObjectRef, table as action_table};
pub use history::{Histories, History, HistoryLimits, PERSONS_MAX, Voice};
pub use person::{
    NameWord, Named, PERSON_NAME_BYTES_MAX, Pronoun, ReadName, SOMEBODY, check_name, is_number, name_words,
    person_number, same_but_for_accents, same_name,
};
pub use presence::{Presence, PresenceError, PresenceStatement};
pub use program::{DAY_MINUTES_MAX, PROGRAM_BYTES_MAX, Program, ProgramError, STEPS_MAX};

/// Longest sentence of one observation, in bytes of UTF-8; the narration message holds as many.
pub const SENTENCE_BYTES_MAX: usize = 1024;

/// Why a text is no sentence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SentenceError {
    /// Nothing but space and punctuation.
    #[error("the sentence holds no letter or digit: say what was observed, such as `They open the fridge.`")]
    Empty,
    /// Longer than [`SENTENCE_BYTES_MAX`].
    #[error(
        "the sentence has {bytes} bytes, more than {SENTENCE_BYTES_MAX}: shorten it or send it as several observations"
    )]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// A control character.
    #[error("the sentence holds the control character U+{code:04X}: remove it")]
    Control {
        /// Its code point.
        code: u32,
    },
}

/// A plain sentence in the form the prompt wants: single spaces, a capital first letter, closing punctuation. Its copies share one text.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Sentence(Arc<str>);

impl Sentence {
    /// Normalises `text`. Line breaks and tabs count as space.
    ///
    /// # Errors
    /// Empty, overlong texts and control characters are refused.
    pub fn new(text: &str) -> Result<Self, SentenceError> {
        if text.len() > SENTENCE_BYTES_MAX {
            return Err(SentenceError::TooLong { bytes: text.len() });
        }
        if let Some(c) = text.chars().find(|c| is_hidden(*c) && !c.is_whitespace()) {
            return Err(SentenceError::Control { code: c.into() });
        }
        if !text.contains(char::is_alphanumeric) {
            return Err(SentenceError::Empty);
        }
        let mut sentence = String::with_capacity(text.len() + 1);
        for word in text.split_whitespace() {
            if sentence.is_empty() {
                let mut letters = word.chars();
                sentence.extend(letters.next().into_iter().flat_map(char::to_uppercase));
                sentence.push_str(letters.as_str());
            } else {
                sentence.push(' ');
                sentence.push_str(word);
            }
        }
        if !sentence.ends_with(['.', '!', '?']) {
            while sentence.ends_with([',', ';', ':', ' ']) {
                sentence.pop();
            }
            sentence.push('.');
        }
        match sentence.len() {
            0..=SENTENCE_BYTES_MAX => Ok(Self(sentence.into())),
            bytes => Err(SentenceError::TooLong { bytes }),
        }
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Sentence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The state of a device, "the oven is on".
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct DeviceState {
    /// The device, without article ("oven").
    pub device: String,
    /// What it is ("on", "open", "at 20 degrees").
    pub state: String,
}

impl DeviceState {
    /// Reads "the oven is on"; `None` if the text has another form, in which case it is a plain sentence.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.trim().trim_end_matches('.');
        let rest = text.strip_prefix("the ").or_else(|| text.strip_prefix("The "))?;
        let (device, state) = rest.split_once(" is ")?;
        let (device, state) = (device.trim(), state.trim());
        (!device.is_empty() && !state.is_empty()).then(|| Self { device: device.to_owned(), state: state.to_owned() })
    }

    /// "The oven is on."
    ///
    /// # Errors
    /// As [`Sentence::new`].
    pub fn sentence(&self) -> Result<Sentence, SentenceError> {
        Sentence::new(&format!("The {} is {}", self.device, self.state))
    }
}

/// What was observed, before it becomes a sentence.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Observed {
    /// An atomic action, complete.
    Action(Action),
    /// A device changed its state.
    Device(DeviceState),
    /// Any other sentence.
    Sentence(Sentence),
}

/// Why a text is no observation.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ObservedError {
    /// It opens with `[` and so claims to be an action.
    #[error(transparent)]
    Action(#[from] ActionError),
    /// It is no sentence either.
    #[error(transparent)]
    Sentence(#[from] SentenceError),
    /// It claims to say who is there.
    #[error(transparent)]
    Presence(#[from] PresenceError),
}

impl Observed {
    /// Reads one line of any kind: an action if it opens with `[`, a device state if it reads "the ... is ...", else a sentence.
    ///
    /// # Errors
    /// The line's own fault, as an action or as a sentence.
    pub fn parse(line: &str) -> Result<Self, ObservedError> {
        if line.trim_start().starts_with('[') {
            return Ok(Self::Action(Action::parse(line)?));
        }
        let sentence = Sentence::new(line)?;
        Ok(DeviceState::parse(sentence.as_str()).map_or(Self::Sentence(sentence), Self::Device))
    }

    /// Its sentence in the narration.
    ///
    /// # Errors
    /// A device state made by hand may hold what no sentence may.
    pub fn sentence(&self) -> Result<Sentence, SentenceError> {
        match self {
            Self::Action(action) => Sentence::new(&action.sentence()),
            Self::Device(device) => device.sentence(),
            Self::Sentence(sentence) => Ok(sentence.clone()),
        }
    }
}

/// What an observation says.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Said {
    /// What was done: it enters the prompt, and whoever does something is in the house.
    Sentence(Sentence),
    /// Where the person is. It is no sentence for the language model.
    Presence(PresenceStatement),
}

impl Said {
    /// What a sentence says: one that says in plain words where its person is, and nothing of what they do, is a statement; any other is done
    /// in the house. Who comes home does something. A text that may be about several persons in turn stays as it is for
    /// [`Said::clauses`], which is told who they are.
    #[must_use]
    pub fn of(sentence: Sentence) -> Self {
        if Self::may_be_several(&sentence) {
            return Self::Sentence(sentence);
        }
        Self::statement_of(sentence.as_str()).map_or(Self::Sentence(sentence), Self::Presence)
    }

    /// Whether a sentence may say things of several persons who are not all in its subject.
    fn may_be_several(sentence: &Sentence) -> bool {
        let text = sentence.as_str();
        reading::is(Fact::MaybeSeveral, text, |plain| {
            // Whom it is about behind a comma or a colon only who knows the persons can tell.
            several::may_be_several(text) || plain.contains(", ") || clause::may_have_companions(plain)
        })
    }

    fn is(&self, fact: Fact, read: impl FnOnce(&str) -> bool) -> bool {
        self.sentence().is_some_and(|sentence| reading::is(fact, sentence.as_str(), read))
    }

    /// What a sentence says of where its persons are, behind what it begins with: "Carefully, Ben leaves the house."
    fn statement_in(text: &str, is_known: &mut dyn FnMut(&str) -> bool) -> Option<PresenceStatement> {
        PresenceStatement::of_sentence(text).or_else(|| {
            reading::with_plain(text, |plain| PresenceStatement::of_plain(clause::behind_opening(plain, is_known)?))
        })
    }

    /// The statement that a sentence is, if it is one.
    fn statement_of(text: &str) -> Option<PresenceStatement> {
        PresenceStatement::of_sentence(text).and_then(Self::stated)
    }

    /// A statement, where it is not that somebody comes home.
    fn stated(statement: PresenceStatement) -> Option<PresenceStatement> {
        let is_stated = statement.presence() == Presence::Away
            || statement.is_of_everybody()
            || statement.room().or(statement.empty_room()).is_some();
        is_stated.then_some(statement)
    }

    /// What each clause of a text says, in their order, where it is more than one sentence of one person: "Mia goes to her room and Tom leaves
    /// the house." is of Mia, and that Tom is away. `is_known` says whether a name is a person's, and `is_visitor` whether that of one with a home
    /// elsewhere. Empty where the text says what it is.
    #[must_use]
    pub fn clauses(
        &self,
        mut is_known: impl FnMut(&str) -> bool,
        mut is_visitor: impl FnMut(&str) -> bool,
    ) -> Vec<Self> {
        let Self::Sentence(sentence) = self else { return Vec::new() };
        if !Self::may_be_several(sentence) {
            return Vec::new();
        }
        let (parts, count) = several::clauses(sentence.as_str(), &mut is_known);
        let parts = &parts[..count];
        let is_all = count == 1 && parts.iter().all(|part| part.holds == Holds::So);
        let mut said = Vec::new();
        for part in parts.iter().filter(|part| part.holds != Holds::NotYet) {
            let of_part = Self::of_part(part, sentence, is_all, &mut is_known, &mut is_visitor);
            said.extend(of_part.into_iter().flatten());
        }
        said
    }

    /// What one clause of a sentence says: of its own persons, of those who are with them, and of those whom they let in. `is_all` says that it is
    /// the whole sentence, which then says what it is where it is of nobody else.
    fn of_part(
        part: &several::Part<'_>,
        sentence: &Sentence,
        is_all: bool,
        is_known: &mut dyn FnMut(&str) -> bool,
        is_visitor: &mut dyn FnMut(&str) -> bool,
    ) -> [Option<Self>; 3] {
        let clause = &*part.named(is_known);
        // Where its person is in the end: who comes back does something.
        let last = several::sentences(clause).filter_map(|one| Some((one, Self::statement_in(one, is_known)?))).last();
        if part.holds == Holds::AtHome
            && last.as_ref().is_some_and(|(_, statement)| statement.presence() == Presence::Away)
        {
            return [None, None, None];
        }
        if let Some(seen) = Self::seen(clause, is_known) {
            return seen;
        }
        let along = last.as_ref().filter(|(_, statement)| !statement.is_of_everybody()).and_then(|(one, statement)| {
            reading::with_plain(one, |plain| {
                // Who comes along may be somebody new.
                let comes = statement.presence() == Presence::Present && statement.room().is_none();
                let is_new = |name: &str| {
                    comes && !name.contains(' ') && clause::may_be_a_person(name) && is_written_as_a_name(one, name)
                };
                let names = clause::companions(plain, |name| is_known(name) || is_new(name));
                // A visitor is taken home out of this house.
                let is_out = clause::takes_home(plain) && names.iter().any(|name| is_visitor(name));
                let with = statement.of_one(if is_out { Presence::Away } else { statement.presence() });
                (!names.is_empty()).then(|| (with.with_subjects(&names), is_out))
            })
        });
        let (with, is_out) = along.map_or((None, false), |(with, is_out)| (Some(with), is_out));
        let guests = Self::guests(clause, is_known);
        let behind =
            last.as_ref().filter(|(one, _)| PresenceStatement::of_sentence(one).is_none()).and_then(|(one, _)| {
                reading::with_plain(one, |plain| Sentence::new(clause::behind_opening(plain, &mut *is_known)?).ok())
            });
        let behind = behind.map(Self::Sentence);
        let whose = |statement: PresenceStatement| match statement.subject() {
            None if !statement.is_of_everybody() => {
                let names = Self::Sentence(sentence_or(clause, sentence)).known_names(&mut *is_known);
                if names.is_empty() { statement } else { statement.with_subjects(&names) }
            }
            _ => statement,
        };
        let stated = last.and_then(|(_, statement)| match is_out {
            true => Some(statement.leaving()),
            false => Self::stated(statement),
        });
        let own = match stated.map(whose) {
            Some(statement) => Some(Self::Presence(statement)),
            // "Carefully, Ben comes home" is what Ben does.
            None if behind.is_some() => behind,
            None if !is_all || with.is_some() || guests.is_some() => {
                Some(Self::Sentence(sentence_or(clause, sentence)))
            }
            None => None,
        };
        let beside = |statement: PresenceStatement| Self::Presence(statement.beside());
        [own, with.map(beside), guests.map(beside)]
    }

    /// What a clause says of those whom its person sees in a room, or sends there: of where its person is it says nothing.
    fn seen(clause: &str, is_known: &mut dyn FnMut(&str) -> bool) -> Option<[Option<Self>; 3]> {
        let who = reading::with_plain(clause, |plain| {
            clause::longest_subject(plain, &mut *is_known).map_or_else(Vec::new, |(names, _)| names)
        });
        reading::with_plain(clause, |plain| {
            let (names, room, is_there) = clause::seen(plain, is_known)?;
            let own = if who.is_empty() { None } else { PresenceStatement::new(Presence::Present, None).ok() };
            let other = match is_there {
                true => {
                    let there = PresenceStatement::new(Presence::Present, Some(room)).ok()?;
                    Self::Presence(there.with_subjects(&names).beside())
                }
                false => Self::Sentence(Sentence::new(&format!("{} goes to the {room}", names.join(" and "))).ok()?),
            };
            Some([own.map(|own| Self::Presence(own.with_subjects(&who))), Some(other), None])
        })
    }

    /// That those are there whom somebody touches, or lets in: who is known, is called by what they are, or is written as a name.
    fn guests(clause: &str, is_known: &mut dyn FnMut(&str) -> bool) -> Option<PresenceStatement> {
        reading::with_plain(clause, |plain| {
            let names = clause::guests(plain);
            let mut is_person = |name: &&str| {
                is_known(name)
                    || clause::is(clause::Word::People, name)
                    || clause::may_be_a_person(name) && clause::may_be_new(name) && is_written_as_a_name(clause, name)
            };
            let are_persons = !names.is_empty() && names.iter().all(&mut is_person);
            let names = if are_persons { names } else { clause::touched(plain, &mut *is_known) };
            let here = if names.is_empty() { None } else { PresenceStatement::parse("present").ok() };
            here.map(|here| here.with_subjects(&names))
        })
    }

    /// The sentence for the prompt, if it is one.
    #[must_use]
    pub fn sentence(&self) -> Option<&Sentence> {
        match self {
            Self::Sentence(sentence) => Some(sentence),
            Self::Presence(_) => None,
        }
    }

    /// The persons that a sentence names, where `is_known` says so of all of them, in lower case: of "Ada and Ben sit down" both. Of the longest
    /// such subject.
    #[must_use]
    pub fn known_names(&self, mut is_known: impl FnMut(&str) -> bool) -> Vec<String> {
        let Self::Sentence(sentence) = self else { return Vec::new() };
        reading::with_plain(sentence.as_str(), |said| {
            clause::longest_subject(said, &mut is_known).map_or_else(Vec::new, |(names, _)| names)
        })
    }

    /// Whether it may name a person among those it is about: whoever `is_them` says that a name is.
    #[must_use]
    pub fn may_name(&self, mut is_them: impl FnMut(&str) -> bool) -> bool {
        match self {
            Self::Sentence(sentence) => {
                let text = sentence.as_str();
                let mut may_name = |part| {
                    reading::with_plain(part, |said| clause::possible_subjects(said).flatten().any(&mut is_them))
                };
                may_name(text) || several::parts(text).any(may_name)
            }
            Self::Presence(statement) => statement.all_names().any(&mut is_them),
        }
    }

    /// Whether it says of a device that something has ended, which anything may have ended: "The light is off."
    #[must_use]
    pub fn is_of_an_end(&self) -> bool {
        self.is(Fact::IsOfAnEnd, clause::is_of_an_end)
    }

    /// Whether it says what somebody may do who is not there: "Ada calls.", "Ben is on his way.", "They will be home soon."
    #[must_use]
    pub fn is_from_afar(&self) -> bool {
        self.is(Fact::IsFromAfar, clause::is_from_afar)
    }

    /// Whether it says what somebody is, or where they go, and not that they are or come home: "Ada is at the gym.", "Ben flies to Rome.", "Ada is
    /// late." Whether that is in the house, only who knows the map can tell.
    #[must_use]
    pub fn may_be_elsewhere(&self) -> bool {
        self.is(Fact::MayBeElsewhere, clause::may_be_elsewhere)
    }

    /// Whether it is about somebody by a pronoun: "They open the fridge."
    #[must_use]
    pub fn is_of_a_pronoun(&self) -> bool {
        self.is(Fact::IsOfAPronoun, clause::is_of_a_pronoun)
    }

    /// Whether it reads the same whoever is known, where its narrator says whose it is: one clause of a pronoun, or a presence of one person.
    #[must_use]
    pub fn is_read_alone(&self) -> bool {
        match self {
            Self::Sentence(sentence) => {
                let is_of_one =
                    || PresenceStatement::of_sentence(sentence.as_str()).is_none_or(|stated| !stated.is_of_everybody());
                self.is_of_a_pronoun() && !self.goes_home() && !Self::may_be_several(sentence) && is_of_one()
            }
            Self::Presence(statement) => statement.subject().is_none() && !statement.is_of_everybody(),
        }
    }

    /// Whether it is about so many who are there and no others, and how many: "They both go to bed." is of two, "All three leave." of three.
    #[must_use]
    pub fn is_of_so_many(&self) -> Option<usize> {
        match self {
            Self::Sentence(sentence) => reading::with_plain(sentence.as_str(), clause::is_of_so_many),
            Self::Presence(statement) => statement.is_of_so_many(),
        }
    }

    /// Whether it is about all who do not live here: "The guests sit down.", "The visitors leave."
    #[must_use]
    pub fn is_of_guests(&self) -> bool {
        match self {
            Self::Sentence(_) => self.is(Fact::IsDeedOfGuests, clause::is_deed_of_guests),
            Self::Presence(statement) => statement.is_of_guests(),
        }
    }

    /// Whether it says what everybody does who is there: "Everybody goes to bed."
    #[must_use]
    pub fn is_of_all(&self) -> bool {
        self.is(Fact::IsDeedOfAll, clause::is_deed_of_all)
    }

    /// Whether it says that its person goes home: who does not live here leaves then.
    #[must_use]
    pub fn goes_home(&self) -> bool {
        self.is(Fact::GoesHome, clause::goes_home)
    }

    /// Whether it says that its person visits somebody by name: who does not live here comes then, and who does goes.
    #[must_use]
    pub fn is_visit(&self) -> bool {
        self.is(Fact::IsVisit, clause::is_visit)
    }

    /// Whether it says what its person left behind, wherever they are now: "Ada left the light on in the office."
    #[must_use]
    pub fn is_of_what_was_left(&self) -> bool {
        self.is(Fact::IsOfWhatWasLeft, clause::is_of_what_was_left)
    }

    /// Whether it tells of a guest beside those who are known: "A guest arrives."
    #[must_use]
    pub fn is_of_a_new_guest(&self) -> bool {
        self.is(Fact::IsOfANewGuest, clause::is_of_a_new_guest)
    }

    /// Whether any guest is called so: "guest", "visitor".
    #[must_use]
    pub fn is_guest(name: &str) -> bool {
        clause::is_guest(&name.to_lowercase())
    }

    /// By which pronoun it is about one person: "She opens the fridge."
    #[must_use]
    pub fn pronoun(&self) -> Option<Pronoun> {
        match self {
            Self::Sentence(sentence) => reading::with_plain(sentence.as_str(), clause::pronoun),
            Self::Presence(statement) => statement.pronoun(),
        }
    }

    /// By which pronoun a sentence goes on about whom it names: "Ada brushes her teeth."
    #[must_use]
    pub fn own_pronoun(&self) -> Option<Pronoun> {
        self.sentence().and_then(|sentence| reading::with_plain(sentence.as_str(), clause::own_pronoun))
    }

    /// Whether it is what somebody says who has come home: "I'm home!"
    #[must_use]
    pub fn is_own_arrival(&self) -> bool {
        self.is(Fact::IsOwnArrival, clause::is_own_arrival)
    }

    /// Whether it says that its person goes to an office: where the map has none by that name, to the one out of the house.
    #[must_use]
    pub fn goes_to_an_office(&self) -> bool {
        self.is(Fact::GoesToAnOffice, clause::goes_to_an_office)
    }

    /// Whether it says where something is that is no person, or does not tell whose place it says: "The robot is in the kitchen.", "Somebody else
    /// is in the kitchen.", "Tom is not in the study."
    #[must_use]
    pub fn moves_nobody(&self) -> bool {
        self.sentence().is_some_and(|sentence| {
            let first = several::sentences(sentence.as_str()).next().unwrap_or_default();
            reading::is(Fact::MovesNobody, first, clause::moves_nobody)
        })
    }

    /// Whom a sentence is about; `is_known` says whether a name is a person's. A statement has names of its own.
    #[must_use]
    pub fn about(&self, mut is_known: impl FnMut(&str) -> bool) -> About {
        // Many ways to cut a sentence ask for the same few names.
        let mut asked: HashMap<String, bool> = HashMap::new();
        let mut is_known = |name: &str| match asked.get(name) {
            Some(known) => *known,
            None => {
                let known = is_known(name);
                asked.insert(name.to_owned(), known);
                known
            }
        };
        match self {
            Self::Sentence(sentence) => reading::with_plain(sentence.as_str(), |said| {
                about::about(said, &mut is_known, &|name| is_written_as_a_name(sentence.as_str(), name))
            }),
            Self::Presence(statement) => match statement.names().map(str::to_owned).collect::<Vec<_>>() {
                names if names.is_empty() => About::Somebody,
                names => About::Named(names),
            },
        }
    }

    /// Whether two names may be one person's: "Zoë" and "Zoe"; "Mrs. Novak" and "Novak"; "Grandma Edith" and "Edith". "Mr. Novak" is somebody else
    /// than "Mrs. Novak".
    #[must_use]
    pub fn may_be_one(one: &str, other: &str) -> bool {
        ReadName::new(one).may_be_one(&ReadName::new(other))
    }

    /// Whether a sentence that says `name` may mean somebody who is known: also by the first of several names.
    #[must_use]
    pub fn may_mean(known: &str, name: &str) -> bool {
        ReadName::new(known).may_be_called(&ReadName::new(name))
    }

    /// What somebody of a longer name may be called for short, with a title or without: "ada" of "Dr. Ada Lovelace".
    #[must_use]
    pub fn first_name(name: &str) -> Option<&str> {
        let (_, name) = clause::titled(name);
        clause::first_name(name)
    }

    /// A name without its title: "novak" of "mrs. novak".
    #[must_use]
    pub fn without_title(name: &str) -> &str {
        clause::titled(name).1
    }

    /// Whether a name is another word for one person or several: "he", "everybody".
    #[must_use]
    pub(crate) fn is_pronoun(name: &str) -> bool {
        let name = name.to_lowercase();
        clause::is(clause::Word::Pronoun, &name) || clause::is(clause::Word::Everybody, &name)
    }

    /// Whether it tells what somebody says to others, whatever place that mentions.
    #[must_use]
    pub fn is_speech(&self) -> bool {
        self.is(Fact::IsSpeech, clause::is_speech)
    }

    /// Whether somebody of whom nobody has told yet may go by a name in a sentence.
    #[must_use]
    pub fn may_be_new(name: &str) -> bool {
        clause::may_be_new(name) && !clause::is_named_thing(name)
    }

    /// Whether a name is that of weather, food or the like, and no person's unless somebody is known by it: "fire", "snow".
    #[must_use]
    pub fn is_stuff(name: &str) -> bool {
        clause::is(clause::Word::Stuff, name)
    }

    /// Whether a word may be read as a name by itself: "august" and "can" are other words.
    #[must_use]
    pub fn is_read_as_a_name(word: &str) -> bool {
        clause::is_read_as_a_name(&word.to_lowercase())
    }

    /// What it says of somebody who is known to be its person, behind `words` that it begins with: "leaves the house" of "August leaves the house.", or
    /// of what begins with the deed. None where no verb follows.
    #[must_use]
    pub fn of_its_person(&self, words: &str) -> Option<Self> {
        let rest = self.sentence()?.as_str().strip_prefix(words)?.trim_start();
        let verb = rest.split([' ', ',', '.', '!']).next().unwrap_or_default().to_lowercase();
        let rest = format!("{verb}{}", rest.get(verb.len()..)?);
        let said = match verb.ends_with("ing") {
            true => format!("They are {rest}"),
            false => format!("He {}", Some(rest).filter(|_| clause::is_verb(&verb))?),
        };
        Some(Self::of(Sentence::new(&said).ok()?))
    }

    /// What it makes of its person.
    #[must_use]
    pub fn presence(&self) -> Presence {
        match self {
            Self::Sentence(_) => Presence::Present,
            Self::Presence(statement) => statement.presence(),
        }
    }
}

impl fmt::Display for Said {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sentence(sentence) => sentence.fmt(f),
            Self::Presence(statement) => statement.fmt(f),
        }
    }
}

/// Whether a text has a name in lower case with a capital, where that says something: not in a text without small letters.
fn is_written_as_a_name(text: &str, name: &str) -> bool {
    let mut words = text.split(|c: char| !(c.is_alphanumeric() || matches!(c, '-' | '\'' | '’')));
    let last = name.rsplit(' ').next().unwrap_or_default();
    // "O'Neill" is one word, and "Igor's" is Igor.
    let is_it = |word: &str| {
        let lower = || word.replace('’', "'").to_lowercase();
        let is_same = |lower: String| lower == last || lower.strip_suffix("'s") == Some(last);
        word.starts_with(char::is_uppercase) && word.chars().any(char::is_lowercase) && is_same(lower())
    };
    words.any(is_it)
}

/// A clause as a sentence; the whole one where it has no letters.
fn sentence_or(clause: &str, whole: &Sentence) -> Sentence {
    Sentence::new(clause).unwrap_or_else(|_| whole.clone())
}

/// One observation: who, from where, when, and what it says.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Observation {
    /// The person observed; each has a history of their own. [`SOMEBODY`] until it is decided whom it fits.
    pub person: u32,
    /// The name that the narrator gave the person, which counts before the number.
    pub name: Option<Box<str>>,
    /// The narrator named nobody, and `person` is whom it fitted best.
    pub by_fit: bool,
    /// The narrator that sent it.
    pub source: u64,
    /// Random number of the narrator's process start: a new one begins a new count of sequences.
    pub epoch: u64,
    /// Counts the narrator's observations within an epoch.
    pub sequence: u64,
    /// Monotonic time of the observation, in nanoseconds.
    pub observed_ns: u64,
    /// Wall clock, in nanoseconds since 1970, for people.
    pub observed_unix_ns: u64,
    /// What is said.
    pub said: Said,
}

impl Observation {
    /// What a text says rather than a port: of person 0, by source 0 in its epoch 0, at no known time.
    #[must_use]
    pub fn of(sequence: u64, sentence: Sentence) -> Self {
        Self::saying(sequence, Said::Sentence(sentence))
    }

    /// The same of whatever is said.
    #[must_use]
    pub fn saying(sequence: u64, said: Said) -> Self {
        let (person, name, by_fit) = (0, None, false);
        Self { person, name, by_fit, source: 0, epoch: 0, sequence, observed_ns: 0, observed_unix_ns: 0, said }
    }

    /// The sentence for the prompt; none where only presence is said.
    #[must_use]
    pub fn sentence(&self) -> Option<&str> {
        self.said.sentence().map(Sentence::as_str)
    }

    /// Seconds from `earlier` to this observation by the clock that both have, the monotonic one first; none where there is none, 0 where
    /// they come in the other order. Where the monotonic clock goes back and the wall clock does not, the machine was started between them.
    #[must_use]
    pub(crate) fn seconds_after(&self, earlier: &Self) -> Option<f64> {
        let between = |from_ns: u64, to_ns: u64| (from_ns > 0 && to_ns > 0).then(|| to_ns.checked_sub(from_ns));
        let monotonic = between(earlier.observed_ns, self.observed_ns);
        let unix = between(earlier.observed_unix_ns, self.observed_unix_ns);
        let nanoseconds = match (monotonic, unix) {
            (Some(Some(after)), _) | (Some(None) | None, Some(Some(after))) => after,
            (None, None) => return None,
            _ => 0,
        };
        Some(nanoseconds as f64 / 1e9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A sentence of names and "and" can be cut in hundreds of ways; each asks for the same few names.
    #[test]
    fn a_sentence_asks_for_each_name_once() {
        let names: Vec<String> = "BCDFGHJKLMNPQRSTVWXYZ"
            .chars()
            .flat_map(|first| "aeiou".chars().map(move |second| format!("{first}{second}b")))
            .collect();
        for joined in [" and ", ", ", " "] {
            let mut text = names.join(joined);
            text.truncate(SENTENCE_BYTES_MAX - 32);
            let said = Said::of(Sentence::new(&format!("{text} opens the fridge.")).unwrap());
            let mut asked = std::collections::BTreeMap::<String, usize>::new();
            let _ = said.about(|name| {
                *asked.entry(name.to_owned()).or_default() += 1;
                true
            });
            assert!(asked.values().all(|times| *times == 1) && asked.len() <= 128, "{joined:?}: {}", asked.len());
        }
    }

    #[test]
    fn sentences_are_normalised_or_refused() {
        let normal = |text: &str| Sentence::new(text).map(|s| s.to_string());
        assert_eq!(normal("  she opens\n the  fridge ").as_deref(), Ok("She opens the fridge."));
        assert_eq!(normal("Is it on?").as_deref(), Ok("Is it on?"));
        assert_eq!(normal("then,").as_deref(), Ok("Then."));
        assert_eq!(normal("éteint la lampe").as_deref(), Ok("Éteint la lampe."));
        assert_eq!(normal(" ... "), Err(SentenceError::Empty));
        assert_eq!(normal("a\u{0}b"), Err(SentenceError::Control { code: 0 }));
        assert_eq!(normal(&"a".repeat(1025)), Err(SentenceError::TooLong { bytes: 1025 }));
        assert_eq!(normal(&"a".repeat(1024)), Err(SentenceError::TooLong { bytes: 1025 }));
    }

    #[test]
    fn who_says_that_they_leave_says_nothing_to_the_model() {
        let of = |text: &str| Said::of(Sentence::new(text).unwrap());
        assert_eq!(of("They leave the house."), Said::Presence(PresenceStatement::parse("away").unwrap()));
        assert_eq!(of("They come home").sentence().map(Sentence::as_str), Some("They come home."));
        assert_eq!(of("They grab the mug").presence(), Presence::Present);
    }

    #[test]
    fn each_clause_says_something_of_its_own() {
        let of = |text: &str| {
            let said = Said::of(Sentence::new(text).unwrap());
            let of_clause = |said: &Said| match said {
                Said::Presence(statement) => format!("{}: {statement}", statement.subject().unwrap_or("-")),
                Said::Sentence(sentence) => sentence.to_string(),
            };
            let clauses = said.clauses(|name| ["mia", "tom"].contains(&name), |_| false);
            clauses.iter().map(of_clause).collect::<Vec<_>>().join(" | ")
        };
        for (text, expected) in [
            ("Mia goes to her room and Tom leaves the house.", "Mia goes to her room. | tom: away"),
            ("Mia leaves the house. She takes the car.", "mia: away"),
            ("Mia opens the door. She leaves the house.", "mia: away"),
            ("Mia and Tom leave the house.", "mia and tom: away"),
            ("They leave the house and lock the door.", "-: away"),
            ("Mia is away and nobody is in the kitchen.", "mia: away | -: nobody in the kitchen"),
            ("Mia leaves the house with Tom.", "mia: away | tom: away"),
            ("She leaves the house with Tom today.", "-: away | tom: away"),
            ("Mia takes Tom to school.", "mia: away | tom: away"),
            ("Mia is in the kitchen with Tom.", "mia: present in the kitchen | tom: present in the kitchen"),
            ("Mia comes home with Tom.", "Mia comes home with Tom. | tom: present"),
            ("Mia leaves the house with a suitcase.", "mia: away"),
            ("Mia leaves the house with Tom's suitcase.", "mia: away"),
            ("Mia comes home with the milk.", ""),
            ("Mia takes the dog for a walk.", "mia: away"),
            ("Mia takes the milk out of the fridge.", ""),
            ("Mia takes the cake out.", ""),
            ("Mia plays with Tom in the kitchen.", ""),
            ("They open the fridge and grab the milk.", ""),
            ("Mia opens the fridge. She grabs the milk.", ""),
            ("They open the fridge.", ""),
            ("They leave the house.", ""),
            ("Mia gets up, showers and leaves for work.", "mia: away"),
            ("Tom eats, dresses and goes to work.", "tom: away"),
            ("Mia gets up, showers, leaves the house and drives off.", "mia: away"),
            ("Mia wakes up, stretches and is in the kitchen.", ""),
            ("Mia leaves the house, and so does Tom.", "mia: away | tom: away"),
            ("Mia leaves the house and Tom too.", "mia: away | tom: away"),
            ("Mia leaves and so does Tom.", "mia: away | tom: away"),
            ("Mia comes home and so does Tom.", "Mia comes home and so does Tom. | tom: present"),
            ("Mia and Tom put on their coats and leave for work.", "mia and tom: away"),
            ("Mia and her friend Igor leave the house.", "mia and igor: away"),
            ("Tom opens the front door and Igor comes in.", "Tom opens the front door. | Igor comes in."),
            ("Tom lets Igor in.", "Tom lets Igor in. | igor: present"),
            (
                "Tom lets Igor and the plumber into the house.",
                "Tom lets Igor and the plumber into the house. | igor and plumber: present",
            ),
            ("Tom lets the cat in.", ""),
            ("Tom lets sunlight in.", ""),
            ("Tom lets her in.", ""),
            ("Mia comes home from work and puts the groceries into the fridge.", ""),
        ] {
            assert_eq!(of(text), expected, "{text}");
        }
    }

    #[test]
    fn a_clause_that_says_when_is_of_its_own_person() {
        let of = |text: &str| {
            let said = Said::of(Sentence::new(text).unwrap());
            let of_clause = |said: &Said| match said {
                Said::Presence(statement) => format!("{}: {statement}", statement.subject().unwrap_or("-")),
                Said::Sentence(sentence) => sentence.to_string(),
            };
            let clauses = said.clauses(|name| ["mia", "jon", "anna"].contains(&name), |name| name == "anna");
            clauses.iter().map(of_clause).collect::<Vec<_>>().join(" | ")
        };
        for (text, expected) in [
            ("While Jon takes a shower, Mia leaves.", "Jon takes a shower. | mia: away"),
            ("Mia leaves while Jon takes a shower.", "mia: away | Jon takes a shower."),
            ("Before Jon leaves, he goes to the kitchen.", "Jon goes to the kitchen."),
            ("Before Jon leaves, Mia goes to the kitchen.", "Mia goes to the kitchen."),
            ("Before she leaves, Jon goes to the kitchen.", "Jon goes to the kitchen."),
            ("Mia goes to the kitchen before Jon leaves the house.", "Mia goes to the kitchen."),
            ("Mia goes to the kitchen before she leaves the house.", "Mia goes to the kitchen."),
            ("Mia sings before Jon cooks and Anna leaves the house. Jon sits down.", "Mia sings. | Jon sits down."),
            ("After Mia leaves, Jon goes to the office.", "mia: away | Jon goes to the office."),
            ("Jon goes to the office after Mia leaves.", "Jon goes to the office. | mia: away"),
            ("As Mia leaves, Jon and Anna sit down.", "mia: away | Jon and Anna sit down."),
            ("Jon sings. While he cooks, Mia leaves the house.", "Jon sings. | mia: away"),
            ("Mia stays in the kitchen until Jon leaves.", "mia: present in the kitchen"),
            ("When Mia leaves, Jon goes to the office.", "Jon goes to the office."),
            ("Once Mia comes home, Jon leaves the house.", "Mia comes home."),
            ("As soon as Jon cooks, Mia sits down.", "Jon cooks. | Mia sits down."),
            ("Mia leaves the house when Jon comes home.", "Jon comes home."),
            ("After Mia leaves the house, Jon will cook.", "Jon will cook."),
            ("After Jon and Mia leave the house, Anna sings.", "jon and mia: away | Anna sings."),
            ("Jon looks after Mia and Anna leaves.", "Jon looks after Mia. | anna: away"),
            ("When Mia leaves the house, the heating goes down.", ""),
            ("When Mia leaves the house, lock the door.", ""),
            ("After dinner, Jon cooks.", ""),
            ("Jon is as tall as Mia.", ""),
            ("Mia leaves. Jon leaves. Anna leaves.", "mia: away | jon: away | anna: away"),
            ("When Mia leaves, Jon leaves.", ""),
            ("Because Jon is at work, Mia cooks.", "jon: away | Mia cooks."),
            ("Mia stays home because Jon is at work.", "Mia stays home. | jon: away"),
            ("Since Jon left the house, Mia is reading.", "jon: away | Mia is reading."),
            ("Although Jon is out, Mia cooks.", "jon: away | Mia cooks."),
            ("Whenever Mia is out, Jon sings.", "Jon sings."),
            ("Although Mia is out, the light is on.", "mia: away | The light is on."),
            ("As Mia left, the dog barked.", "mia: away | The dog barked."),
            ("Since Mia is in the kitchen, the light is on.", "mia: present in the kitchen | The light is on."),
            ("After Mia leaves, the light will be off.", "The light will be off."),
            ("When Mia is out, the light is on.", ""),
            ("Mia is sad because Jon will leave the house.", "Mia is sad. | Jon will leave the house."),
            ("Mia says that she stays because Jon leaves the house.", ""),
            ("Before Mia leaves the house and Jon goes to work, Anna sings.", "Anna sings."),
            ("Jon says that Mia leaves, Anna sings.", ""),
            ("As Mia usually leaves the house, Jon cooks.", "Mia usually leaves the house. | Jon cooks."),
            ("If Mia leaves the house, Jon leaves the house.", ""),
            ("Jon takes Anna home.", "jon: away | anna: away"),
            ("Jon brings Anna home.", "Jon brings Anna home. | anna: present"),
            ("Anna takes Jon home.", "Anna takes Jon home. | jon: present"),
            ("Mia leaves with Jon and Anna.", "mia: away | jon and anna: away"),
            ("Mia and the dog go out and lock the door.", "mia: away"),
            ("Mia sees Jon in the bedroom.", "mia: present | jon: present in the bedroom"),
            ("Mia sends Jon to the bathroom.", "mia: present | Jon goes to the bathroom."),
            ("Mia sees Jon in the mirror.", ""),
            ("Mia leaves! Jon cooks; Anna leaves the house.", "mia: away | Jon cooks. | anna: away"),
        ] {
            assert_eq!(of(text), expected, "{text}");
        }
    }

    #[test]
    fn who_goes_home_does_so_now() {
        let goes_home = |text: &str| Said::of(Sentence::new(text).unwrap()).goes_home();
        for text in ["Anna goes home.", "Anna and Igor go home.", "She drives home after dinner.", "They go back home."]
        {
            assert!(goes_home(text), "{text}");
        }
        for text in [
            "Anna wants to go home.",
            "Anna almost goes home.",
            "Mia tells Anna to go home.",
            "Anna lets Mia go home.",
            "Anna does not go home.",
            "Anna goes home tomorrow.",
            "Jon asks whether Anna goes home.",
            "Anna goes to the home office.",
            "Anna will go home.",
        ] {
            assert!(!goes_home(text), "{text}");
        }
    }

    #[test]
    fn so_many_are_counted() {
        let count = |text: &str| Said::of(Sentence::new(text).unwrap()).is_of_so_many();
        for text in
            ["Both leave.", "They both go to bed.", "Both of them leave the house.", "They both sit on the sofa."]
        {
            assert_eq!(count(text), Some(2), "{text}");
        }
        for (text, expected) in
            [("All three leave.", 3), ("All four of them go to bed.", 4), ("The three of us sit on the sofa.", 3)]
        {
            assert_eq!(count(text), Some(expected), "{text}");
        }
        for text in [
            "Both parents go to work.",
            "They open both doors.",
            "They both will leave.",
            "Both lamps are on.",
            "All three lamps are on.",
            "All leave.",
            "Three leave.",
        ] {
            assert_eq!(count(text), None, "{text}");
        }
    }

    #[test]
    fn what_has_ended_is_nobodys_place() {
        let ended = |text: &str| Said::of(Sentence::new(text).unwrap()).is_of_an_end();
        for text in [
            "The bathroom light is off.",
            "The dishwasher is now done.",
            "the front door is locked",
            "The lights are off.",
        ] {
            assert!(ended(text), "{text}");
        }
        for text in ["The oven is on.", "The fridge is open.", "The plumber is done.", "They are done.", "Ada is off."]
        {
            assert!(!ended(text), "{text}");
        }
    }

    #[test]
    fn a_sentence_names_those_who_are_known() {
        let known = |text: &str| {
            let said = Said::of(Sentence::new(text).unwrap());
            said.known_names(|name| ["ada", "ben", "plumber", "aunt mary"].contains(&name)).join("+")
        };
        assert_eq!(known("Ada and Ben sit on the sofa."), "ada+ben");
        assert_eq!(known("The plumber walks to the kitchen."), "plumber");
        assert_eq!(known("Then Aunt Mary and Ada wash the dishes."), "aunt mary+ada");
        assert_eq!(known("Ada quickly grabs the mug."), "ada");
        assert_eq!(known("Ada and Zoe sit on the sofa."), "ada");
        assert_eq!(known("They give Ada the mug."), "");
        let may_name = |text: &str| Said::of(Sentence::new(text).unwrap()).may_name(|name| name == "ben");
        assert!(may_name("Ada and Ben sit down.") && may_name("Ada and Ben leave the house."));
        assert!(may_name("Ada cooks. Then Ben eats.") && may_name("Ada cooks and Ben eats."));
        assert!(!may_name("They talk to Ben and Ada."));
    }

    #[test]
    fn who_calls_or_will_come_may_be_anywhere() {
        let afar = |text: &str| Said::of(Sentence::new(text).unwrap()).is_from_afar();
        for sentence in
            ["Ada calls.", "Ada will be home soon.", "The plumber is on his way.", "They text Ben that they are late."]
        {
            assert_eq!(afar(sentence), !sentence.starts_with("They"), "{sentence}");
        }
        for sentence in [
            "Ada forgot her umbrella.",
            "Ada takes the bus home.",
            "Ada lands in Berlin.",
            "Ada buys milk and pays.",
            "Ada sees Jon.",
            "Ada is leaving.",
        ] {
            assert!(afar(sentence), "{sentence}");
        }
        for sentence in [
            "They come home.",
            "Ada opens the fridge.",
            "Ada willingly washes the dishes.",
            "Ada takes the bus home and opens the fridge.",
            "Ada buys bread and puts it into the fridge.",
            "Ada rings and comes in.",
            "Ada comes home from work and puts the groceries into the fridge.",
        ] {
            assert!(!afar(sentence), "{sentence}");
        }
    }

    #[test]
    fn every_kind_of_line_becomes_a_sentence() {
        let sentence = |line: &str| Observed::parse(line).unwrap().sentence().unwrap().to_string();
        assert_eq!(sentence("[Walk] <washing_machine> (1)"), "They walk to the washing machine.");
        assert_eq!(sentence("the oven is on"), "The oven is on.");
        assert_eq!(sentence("Somebody sings"), "Somebody sings.");
        assert!(matches!(Observed::parse("the oven is on").unwrap(), Observed::Device(_)));
        assert!(matches!(Observed::parse("[Fly] <mug> (1)"), Err(ObservedError::Action(_))));
    }

    proptest! {
        #[test]
        fn normalising_twice_changes_nothing(text in "\\PC{0,200}") {
            if let Ok(sentence) = Sentence::new(&text) {
                prop_assert_eq!(Sentence::new(sentence.as_str()), Ok(sentence.clone()));
                prop_assert!(!sentence.as_str().contains("  "));
            }
        }
    }
}
