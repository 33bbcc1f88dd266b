//! What a plain sentence says of where its persons are: its subject, and what the words after it mean. The words are in `clause.toml`.

use super::Presence;
use names::{cuts, names, without_too};
use places::{ends, ends_here, in_the, is_room, room_of};
use signs::{denied, is_doubtful, is_said};
use whereabouts::{
    arrives, excepted, is_alone, is_anybody, is_in_doubt, is_of_guests, of_some, predicate, so_many, state, where_to,
};
use words::{WORDS, has};

mod company;
mod groups;
mod kind;
mod names;
mod places;
mod plain;
mod signs;
mod subject;
#[cfg(test)]
mod tests;
mod whereabouts;
mod words;

pub(super) use company::{
    companions, goes_home, goes_to_an_office, guests, is_arrival, is_guest, is_of_a_new_guest, is_own_arrival,
    is_visit, may_have_companions, moves_nobody, seen, takes_home, touched,
};
pub(super) use groups::{is_deed_of_all, is_deed_of_guests, is_of_so_many};
pub(super) use kind::{
    goes_on_with, is_from_afar, is_not_now, is_not_so, is_of_a_state, is_of_an_end, is_order, is_speech,
    may_be_elsewhere,
};
pub(super) use names::{
    COUNT_MAX, NAME_WORDS_MAX, begins_with_a_pronoun, first_name, is_named_thing, is_of_a_pronoun, is_of_persons,
    is_part_of_a_name, is_read_as_a_name, is_title, longest_subject, may_be_a_person, may_be_new, own_pronoun,
    possible_subjects, pronoun, titled, with_strangers, without_opening,
};
pub(super) use places::is_of_a_room;
pub(super) use plain::plain;
pub(super) use signs::{is_past_state, is_quoted, is_reported, is_unreal, without_first};
pub(super) use subject::{
    begins_with_persons, behind_opening, is_begin_of_a_list, is_of_a_stranger, known_before_a_verb,
};
pub(super) use whereabouts::is_of_what_was_left;
pub(super) use words::{Word, is, is_a_number_of, is_known_verb, is_verb, may_be_a_verb, may_be_third_person};

/// Whom a sentence is about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Subject<'a> {
    /// One person, by a pronoun.
    Unnamed,
    /// Persons by what they are called.
    Named(Vec<&'a str>),
    Everybody,
    /// So many who are there, and no others are.
    SoMany(usize),
    /// All who do not live here.
    Guests,
    /// Everybody but these.
    Others(Vec<&'a str>),
    /// These and nobody else.
    Only(Vec<&'a str>),
    Nobody,
    /// No person, or it is not told that it is so.
    Other,
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

impl<'a> Clause<'a> {
    /// Reads a sentence in plain form ([`plain`]); none where it does not say where somebody or something is.
    pub(super) fn read(said: &'a str) -> Option<Self> {
        let of = |subject, presence, room| Self { subject, presence, room, is_state: true, is_arrival: false };
        if is_not_now(said) || is_order(said) {
            return Some(of(Subject::Other, Presence::Present, None));
        }
        if let Some(place) =
            said.strip_prefix("the ").unwrap_or(said).split_once(" is empty").filter(|(_, more)| ends(more))
        {
            // Those alone are there.
            let only = excepted(place.1).map(|(_, names)| names.map_or(Subject::Other, Subject::Only));
            let is_doubtful = is_doubtful(place.1);
            let of_all = |subject| if is_doubtful { Subject::Other } else { only.unwrap_or(subject) };
            return match place.0 {
                "house" | "home" | "apartment" | "flat" => Some(match of_all(Subject::Everybody) {
                    only @ Subject::Only(_) => of(only, Presence::Present, None),
                    all => of(all, Presence::Away, None),
                }),
                room if is_room(room) => Some(of(of_all(Subject::Nobody), Presence::Present, Some(room))),
                _ => None,
            };
        }
        let is_nobody = |subject: &str| has(&WORDS.nobody, subject);
        let said = without_too(without_opening(said)).0;
        if let Some((_, rest)) = cuts(said).find(|(subject, rest)| is_nobody(subject) && state(rest).is_some()) {
            let is_house = |state: &&str| !WORDS.r#in.after(state).any(ends_here);
            let room = state(rest).filter(is_house).and_then(in_the).map(room_of).filter(|room| is_said(room));
            let presence = predicate(rest).map(|(presence, _)| presence);
            let presence = if room.is_some() { Presence::Present } else { presence? };
            let is_told = |word: &str| crate::text::has_words(rest, word);
            let subject = match excepted(rest) {
                // Nobody is back, but others may be home.
                _ if is_doubtful(rest) || is_told("with") || (room.is_none() && is_told("back")) => Subject::Other,
                Some((_, names)) => names.map_or(Subject::Other, Subject::Only),
                None => Subject::Nobody,
            };
            return Some(of(subject, presence, room));
        }
        let Some((subject, rest, (presence, room))) = where_to(said) else {
            // What somebody is not, in other words, moves nobody; nor what they are or are not.
            let is_denied = cuts(said).any(|(_, rest)| {
                state(rest).is_some_and(|state| {
                    let is_elsewhere = state.strip_prefix("not ").and_then(in_the).is_some();
                    is_elsewhere || is_in_doubt(state) || state.starts_with("neither ")
                })
            });
            return is_denied.then_some(of(Subject::Other, Presence::Present, None));
        };
        let subject = match subject {
            _ if has(&WORDS.nobody, subject) => Subject::Nobody,
            _ if has(&WORDS.everybody, subject) => match excepted(rest) {
                Some((_, names)) => names.map_or(Subject::Other, Subject::Others),
                None => Subject::Everybody,
            },
            _ if let Some(count) = so_many(subject) => Subject::SoMany(count),
            _ if is_of_guests(subject) => Subject::Guests,
            _ if has(&WORDS.pronouns, subject) || is_anybody(subject) => Subject::Unnamed,
            _ => of_some(subject)
                .or_else(|| {
                    names(subject)
                        .map(|names| if is_alone(rest) { Subject::Only(names) } else { Subject::Named(names) })
                })
                .unwrap_or(Subject::Other),
        };
        if is_past_state(rest) {
            return None;
        }
        let is_told = |word: &str| crate::text::has_words(rest, word);
        let subject = match subject {
            Subject::Everybody | Subject::SoMany(_) | Subject::Guests | Subject::Others(_) | Subject::Nobody
                if is_doubtful(denied(rest)) =>
            {
                Subject::Other
            }
            Subject::Only(_) if is_doubtful(rest) || is_told("with") || is_told("back") => Subject::Other,
            _ if rest.ends_with('?') => Subject::Other,
            subject => subject,
        };
        // "I am home" is said by who has come.
        let tells_of_oneself = presence == Presence::Present && room.is_none() && rest.starts_with("am ");
        let is_arrival = arrives(rest) || tells_of_oneself;
        Some(Self { subject, presence, room, is_state: state(rest).is_some(), is_arrival })
    }
}
