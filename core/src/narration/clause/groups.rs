//! What groups without names do: all, the guests, so many of them.

use super::kind::is_not_now;
use super::names::cuts;
use super::signs::{is_doubtful, is_past_state, is_said, is_unreal};
use super::whereabouts::{is_of_guests, so_many};
use super::words::{WORDS, has, is_verb};

/// Of how many persons who are there a plain sentence says what they do.
pub(in crate::narration) fn is_of_so_many(said: &str) -> Option<usize> {
    cuts(said).find_map(|(subject, rest)| so_many(subject).filter(|_| is_deed_of_a_group(said, subject, rest)))
}

/// Whether a plain sentence says what all do who do not live here.
pub(in crate::narration) fn is_deed_of_guests(said: &str) -> bool {
    cuts(said).any(|(subject, rest)| is_of_guests(subject) && is_deed_of_a_group(said, subject, rest))
}

/// Whether a plain sentence says what everybody does who is there: "everybody goes to bed".
pub(in crate::narration) fn is_deed_of_all(said: &str) -> bool {
    cuts(said).any(|(subject, rest)| has(&WORDS.everybody, subject) && is_deed_of_a_group(said, subject, rest))
}

/// Whether words after a group say what it does now.
fn is_deed_of_a_group(said: &str, subject: &str, rest: &str) -> bool {
    let verb = rest.split([' ', ',']).next().unwrap_or_default();
    let is_not_so = is_past_state(rest) || is_unreal(rest) || is_doubtful(rest) || is_not_now(said);
    // "Both lamps are on": no verb of several ends so.
    let is_thing = match subject.starts_with("every") {
        true => !is_verb(verb),
        false => verb.ends_with('s') && !verb.ends_with("ss"),
    };
    // "Of them" belongs to the subject.
    let is_other = has(&WORDS.no_verbs, verb)
        || has(&WORDS.groups, verb)
        || has(&WORDS.except, verb)
        || WORDS.numbers.iter().any(|number| number == verb);
    // "Both are in bed" says it of them.
    let is_said = is_said(verb) || matches!(verb, "is" | "are");
    is_said && !is_thing && !is_other && !is_not_so
}
