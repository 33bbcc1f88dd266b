//! What a plain sentence says of where its persons are: its subject, and what the words after it mean.

use super::Presence;
use crate::names::Names;

/// Whom a sentence is about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Subject<'a> {
    /// One person, by a pronoun.
    Unnamed,
    /// Persons by what they are called.
    Named(Vec<&'a str>),
    Everybody,
    Nobody,
}

/// A sentence that says where its persons are.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Clause<'a> {
    pub(super) subject: Subject<'a>,
    pub(super) presence: Presence,
    pub(super) room: Option<&'a str>,
    /// It says how things are, not what happens.
    pub(super) is_state: bool,
    /// Somebody comes home.
    pub(super) is_arrival: bool,
}

/// Words that stand before a subject and say only when.
const FIRST: [&str; 9] = ["then", "now", "later", "today", "finally", "suddenly", "meanwhile", "afterwards", "and"];
/// Words between a subject and its verb that change nothing.
const BETWEEN: [&str; 12] = [
    "just", "also", "now", "then", "soon", "already", "finally", "quickly", "slowly", "quietly", "suddenly", "usually",
];
/// Words with which a sentence does not say of its subject that it is so.
const NOT_SAID: [&str; 29] = [
    "after", "are", "as", "because", "before", "don't", "either", "else", "except", "if", "is", "maybe", "neither",
    "never", "nor", "not", "of", "once", "or", "perhaps", "please", "probably", "since", "that", "until", "when",
    "where", "while", "without",
];
/// What a subject may begin with.
const DETERMINERS: [&str; 10] = ["the", "a", "an", "my", "our", "your", "their", "his", "her", "its"];
/// A subject has at most so many words, all its persons together.
const SUBJECT_WORDS_MAX: usize = 8;
/// A person's name in a sentence has at most so many words.
const NAME_WORDS_MAX: usize = 2;
const NOBODY: [&str; 4] = ["nobody", "noone", "no-one", "no one"];
const EVERYBODY: [&str; 8] =
    ["everybody", "everyone", "all", "both", "they all", "they both", "all of them", "both of them"];
/// How somebody is heard of who is not there, and what has not happened yet.
const FROM_AFAR: [&str; 24] = [
    "will",
    "would",
    "won't",
    "might",
    "may",
    "should",
    "is going to",
    "are going to",
    "plans",
    "wants",
    "hopes",
    "is coming",
    "are coming",
    "is late",
    "is delayed",
    "calls",
    "phones",
    "rings",
    "texts",
    "messages",
    "sends",
    "has called",
    "has texted",
    "has not",
];
/// Whose way somebody is on.
const ON_THE_WAY: [&str; 5] =
    ["is on the way", "is on their way", "is on his way", "is on her way", "are on their way"];
/// Subjects of one person that are no names.
const PRONOUNS: [&str; 10] = ["they", "he", "she", "it", "i", "we", "you", "somebody", "someone", "people"];
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

impl<'a> Clause<'a> {
    /// Reads a sentence in lower case; none where it does not say where its persons are.
    pub(super) fn read(sentence: &'a str) -> Option<Self> {
        let said = sentence.trim().trim_end_matches(['.', '!']);
        if ["the house is empty", "the home is empty", "the apartment is empty", "the flat is empty"].contains(&said) {
            let (subject, presence, room) = (Subject::Everybody, Presence::Away, None);
            return Some(Self { subject, presence, room, is_state: true, is_arrival: false });
        }
        let (subject, rest, (presence, room)) = cuts(said).find_map(|(subject, rest)| {
            // Who has left, and says not what, has left the house.
            let has_left = ["left", "has left", "have left"].contains(&rest);
            let said = if has_left { (Presence::Away, None) } else { predicate(rest)? };
            Some((subject, rest, said))
        })?;
        let subject = match subject {
            _ if NOBODY.contains(&subject) => Subject::Nobody,
            _ if EVERYBODY.contains(&subject) => Subject::Everybody,
            _ if PRONOUNS.contains(&subject) => Subject::Unnamed,
            _ => Subject::Named(names(subject)?),
        };
        Some(Self { subject, presence, room, is_state: state(rest).is_some(), is_arrival: arrives(rest) })
    }
}

/// The persons that a sentence in lower case may be about, from one word to the longest subject: of "ada and ben sit down" it gives "ada",
/// then "ada" and "ben". Most of it is not meant: only who knows the persons can tell.
pub(super) fn possible_subjects(sentence: &str) -> impl Iterator<Item = Vec<&str>> {
    cuts(sentence.trim()).filter_map(|(subject, _)| names(subject))
}

/// Whether a sentence says what somebody may do who is not there: call, be on the way, plan to come.
pub(super) fn is_from_afar(sentence: &str) -> bool {
    let begins = |rest: &str, words: &&str| {
        rest.strip_prefix(words).is_some_and(|more| !more.starts_with(char::is_alphanumeric))
    };
    cuts(sentence.trim()).any(|(_, rest)| FROM_AFAR.iter().chain(&ON_THE_WAY).any(|words| begins(rest, words)))
}

/// Every way to cut a sentence into a subject and what is said of it, the shortest subject first.
fn cuts(said: &str) -> impl Iterator<Item = (&str, &str)> {
    let mut said = said;
    while let Some(rest) = FIRST.iter().find_map(|word| said.strip_prefix(word)?.strip_prefix([' ', ','])) {
        said = rest.trim_start();
    }
    let spaces = said.match_indices(' ').take(SUBJECT_WORDS_MAX);
    spaces.map(move |(at, _)| {
        let mut subject = said[..at].trim_end_matches([' ', ',']);
        while let Some((before, _)) = subject.rsplit_once(' ').filter(|(_, last)| BETWEEN.contains(last)) {
            subject = before;
        }
        (subject, said[at..].trim_start())
    })
}

/// What the persons of a subject are called: "ada" and "plumber" of "ada and the plumber". None where one of them can be nobody.
fn names(subject: &str) -> Option<Vec<&str>> {
    let parts = subject.split(" and ").flat_map(|part| part.split(", ")).map(|part| part.trim_matches([' ', ',']));
    parts.filter(|part| !part.is_empty()).map(name).collect::<Option<Vec<_>>>().filter(|names| !names.is_empty())
}

fn name(part: &str) -> Option<&str> {
    let bare = part.split_once(' ').filter(|(first, _)| DETERMINERS.contains(first)).map_or(part, |(_, name)| name);
    let is_word = |word: &str| !word.is_empty() && !NOT_SAID.contains(&word) && !DETERMINERS.contains(&word);
    let words = bare.split(' ');
    let fits = words.clone().count() <= NAME_WORDS_MAX && words.clone().all(is_word);
    let is_other = [PRONOUNS.as_slice(), &NOBODY, &EVERYBODY].iter().any(|others| others.contains(&bare));
    (fits && !is_other && !Names::built_in().knows(bare)).then_some(bare)
}
