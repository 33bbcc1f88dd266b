//! Which persons a sentence begins with, where others and other words stand before them.

use super::kind::is_not_now;
use super::names::{NAME_WORDS_MAX, SUBJECT_WORDS_MAX, bare, cuts, is_part_of_a_name, may_be_new, parts};
use super::signs::{is_doubtful, is_reported, is_said, without_first};
use super::whereabouts::{excepted, predicate};
use super::words::{WORDS, Word, first_word, has, is, is_verb};
use super::{Clause, Subject};

/// What a plain sentence says behind what it begins with of no person: "ben opens the fridge" of "carefully, ben opens the fridge" and of "alert, ben
/// opens the fridge". None where it is not told that it is so, or where somebody speaks.
pub(in crate::narration) fn behind_opening(said: &str, mut is_known: impl FnMut(&str) -> bool) -> Option<&str> {
    let said = without_first(said);
    let is_opening = |opening: &str, is_known: &mut dyn FnMut(&str) -> bool| {
        let is_of_persons = opening.split(", ").any(|part| is_of_persons_alone(part, &mut *is_known));
        !is_of_persons && !is_reported(opening) && !is_doubtful(opening)
    };
    let mut commas = said.match_indices(", ").map(|(at, comma)| (&said[..at], &said[at + comma.len()..]));
    let found = commas.by_ref().take(OPENINGS_MAX).find(|(_, main)| begins_with_persons(main, &mut is_known));
    let (_, main) = found.filter(|(opening, _)| is_opening(opening, &mut is_known))?;
    (!is_not_now(said)).then_some(main)
}

/// Who is known and stands right before the first verb of a plain sentence, whatever stands before them: "ben" of "hungry ben opens the fridge", what
/// follows, and whether it is told that it is so. None where the sentence begins with what they do.
pub(in crate::narration) fn known_before_a_verb<'a>(
    said: &'a str,
    is_known: &mut dyn FnMut(&str) -> bool,
) -> Option<(&'a str, &'a str, bool)> {
    // Where words begin and end. What a comma follows ends what stands before it: "as always, ben".
    let (mut places, mut count, mut at) = ([(0, ""); SUBJECT_WORDS_MAX], 0, 0);
    for (place, word) in places.iter_mut().zip(said.split(' ')) {
        *place = (at, word);
        at += word.len() + 1;
        count += 1;
    }
    let words = &places[..count];
    let is_verb_at = |at: usize| words.get(at).is_some_and(|(_, word)| is_verb(word));
    let mut found = None;
    for verb in (0..words.len()).filter(|at| is_verb_at(*at)).take(VERBS_MAX) {
        let name_from = |begin: &usize| said[words[*begin].0..words[verb].0].trim_end_matches([' ', ',', ';', ':']);
        let mut begins = verb.saturating_sub(NAME_WORDS_MAX).max(1)..verb;
        let begin = begins.find(|begin| bare(name_from(begin)) == Some(name_from(begin)) && is_known(name_from(begin)));
        found = begin.map(|begin| (words[begin].0, name_from(&begin), &said[words[verb].0..]));
        // "Tired ben opens it", "hungry lucas opens it".
        let goes_on = words[verb].1.ends_with("ed") || is_verb_at(verb + 1) && is_known(words[verb].1);
        if found.is_some() || !goes_on {
            break;
        }
    }
    let (begin, name, rest) = found?;
    let before = said[..begin].trim_end();
    let is_supposed = || before.split([' ', ',']).any(|word| has(&WORDS.supposes, word));
    (!is_part_of_a_name(before)).then(|| (name, rest, is_said(before) && !is_reported(before) && !is_supposed()))
}

/// A sentence is looked at behind so many commas for whom it is about.
const OPENINGS_MAX: usize = 4;

/// So many words of it that may be verbs are looked at for who stands before them.
const VERBS_MAX: usize = 3;

/// Whether a plain text begins with persons who are known or called by what they are, and what they do.
pub(in crate::narration) fn begins_with_persons(said: &str, mut is_known: impl FnMut(&str) -> bool) -> bool {
    let subjects = cuts(said).filter(|(subject, _)| is_of_persons_alone(subject, &mut is_known));
    subjects.last().is_some_and(|(subject, rest)| {
        let verb = first_word(rest);
        let is_several = parts(subject).nth(1).is_some();
        !has(&WORDS.no_verbs, verb) && (is_verb(verb) || is_several)
    })
}

/// Whether a plain text says by itself that somebody is away, in a room or comes home, of whom nobody may have told yet.
pub(in crate::narration) fn is_of_a_stranger(said: &str) -> bool {
    // Of one person alone no verb has the form of several: "ben and tom leave" is one clause.
    let is_of_one = |name: &str| {
        let rest =
            cuts(said).find_map(|(subject, rest)| (bare(subject) == Some(name)).then_some(rest)).unwrap_or_default();
        rest.split([' ', ',']).next().is_some_and(is_verb)
    };
    let is_of = |clause: Clause<'_>| match clause.subject {
        Subject::Named(names) => names.iter().all(|name| may_be_new(name)) && (names.len() > 1 || is_of_one(names[0])),
        // Of the children nobody knows how many they are.
        Subject::Other => cuts(said)
            .any(|(subject, rest)| predicate(rest).is_some() && is(Word::Group, subject.trim_start_matches("the "))),
        _ => false,
    };
    Clause::read(said).is_some_and(is_of)
}

/// Whether all that a plain text has are persons, as the begin of a list has: "ada, ben".
pub(in crate::narration) fn is_begin_of_a_list(text: &str, mut is_known: impl FnMut(&str) -> bool) -> bool {
    text.split(", ").all(|part| is_of_persons_alone(part, &mut is_known))
}

/// Whether all that a plain text has are persons: "ada and the plumber".
pub(in crate::narration) fn is_of_persons_alone(subject: &str, mut is_known: impl FnMut(&str) -> bool) -> bool {
    let mut is_person = |part: &str| {
        let is_all = has(&WORDS.everybody, part) || has(&WORDS.nobody, part);
        is_all || bare(part).is_some_and(|name| is_known(name) || has(&WORDS.people, name))
    };
    // "Nobody but ada" goes on with "and ben".
    let subject = match excepted(subject) {
        Some((all, Some(_))) if has(&WORDS.everybody, all) || has(&WORDS.nobody, all) => return true,
        _ => subject.strip_prefix("only ").unwrap_or(subject),
    };
    parts(subject).next().is_some() && parts(subject).all(&mut is_person)
}
