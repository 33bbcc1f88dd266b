//! Who comes along: companions, guests, groups, and whoever is seen, touched or visited.

use super::kind::{is_not_now, is_not_so};
use super::names::{NAME_WORDS_MAX, SUBJECT_WORDS_MAX, cuts, names, parts, without_too};
use super::places::{ends, ends_here, is_outside_by, is_room, room_of};
use super::signs::{is_reported, is_said};
use super::whereabouts::{after_verb, takes, where_to, works_here};
use super::words::{WORDS, first_word, has, is_a_way, is_verb};
use super::{Clause, Subject};
use crate::narration::{Presence, deeds};

/// Whether a text may say who is taken along.
pub(in crate::narration) fn may_have_companions(said: &str) -> bool {
    // One look at each word: all these verbs are one. "Her hands" are none.
    let mut before = "";
    let mut tells_of_others = |word| {
        let is_noun = has(&WORDS.determiners, std::mem::replace(&mut before, word));
        [&WORDS.takes, &WORDS.perceives, &WORDS.sends, &WORDS.lets].into_iter().any(|verbs| has(verbs, word))
            || !is_noun && deeds::may_touch(word)
    };
    said.contains(" with ") || said.split(|c: char| !c.is_alphanumeric()).any(&mut tells_of_others)
}

/// Whether it says that its person comes home.
pub(in crate::narration) fn is_arrival(said: &str) -> bool {
    Clause::read(said).is_some_and(|clause| clause.is_arrival)
}

/// Whether it says where something is that is no person, or does not tell whose place it says.
pub(in crate::narration) fn moves_nobody(said: &str) -> bool {
    Clause::read(said).is_some_and(|clause| clause.subject == Subject::Other)
}

/// Whether a subject says who does something, and that they do.
fn is_of_somebody(subject: &str) -> bool {
    is_said(subject) && !WORDS.nobody.after(subject).any(|more| more.is_empty() || more.starts_with(' '))
}

/// Who is known and there, as somebody touches them: "lena" of "paul hugs lena".
pub(in crate::narration) fn touched(said: &str, mut is_known: impl FnMut(&str) -> bool) -> Vec<&str> {
    // Who meets somebody at work is there, and a call brings nobody home.
    let is_elsewhere = || {
        WORDS.afar.is_in(said) || said.match_indices(' ').any(|(at, _)| is_outside_by(&said[at + 1..], &["at", "in"]))
    };
    if is_not_so(said) || is_reported(said) || is_elsewhere() || deeds::is_broadcast(said) {
        return Vec::new();
    }
    let mut of = |more: &str| -> Option<usize> {
        let ends = more.match_indices([' ', ',']).map(|(at, _)| at).take(NAME_WORDS_MAX).chain([more.len()]);
        ends.filter(|at| names(&more[..*at]).is_some_and(|names| names.iter().all(|name| is_known(name)))).last()
    };
    // What somebody "misses doing" is not done.
    let is_done = |(subject, rest): &(&str, &str)| is_of_somebody(subject) && !first_word(rest).ends_with("ing");
    let touched = cuts(said).take(NAME_WORDS_MAX).filter(is_done).find_map(|(_, rest)| {
        let more = deeds::touched(rest)?;
        names(&more[..of(more)?])
    });
    touched.unwrap_or_default()
}

/// Whether a plain sentence is what somebody says who has come home: "i am home".
pub(in crate::narration) fn is_own_arrival(said: &str) -> bool {
    said.strip_prefix("i am ").is_some_and(|state| WORDS.r#in.after(state).any(ends_here))
}

/// Whether a plain sentence says that its person goes to an office by that name alone: "ada goes to the office".
pub(in crate::narration) fn goes_to_an_office(said: &str) -> bool {
    let is_office = |way: &str| {
        ["to the office", "to his office", "to her office", "to their office", "to my office"]
            .iter()
            .any(|to| way.strip_prefix("off ").unwrap_or(way).strip_prefix(to).is_some_and(ends))
    };
    let goes = |rest: &str| {
        let ways = [&WORDS.goes, &WORDS.travels, &WORDS.comes].into_iter().flat_map(|verbs| after_verb(rest, verbs));
        ways.chain(deeds::moves(rest)).any(is_office)
    };
    let mut found = cuts(said).take(NAME_WORDS_MAX);
    found.any(|(subject, rest)| is_said(subject) && goes(rest) && !works_here(rest))
        && !is_not_so(said)
        && !is_reported(said)
}

/// Who is where the persons of a plain sentence are, as it says of where they are: "ben" of "ada leaves the house with ben", "lily" of "ada takes
/// lily to school". Those alone who are known.
pub(in crate::narration) fn companions(said: &str, mut is_known: impl FnMut(&str) -> bool) -> Vec<&str> {
    let (said, too) = without_too(said);
    let Some((_, rest, _)) = where_to(said) else { return Vec::new() };
    let mut known = |words| -> Option<Vec<&str>> {
        let names = names(words)?;
        names.iter().all(|name| is_known(name)).then_some(names)
    };
    let is_along = |before: &&str| !WORDS.not_along.iter().any(|word| format!(" {before} ").contains(word.as_str()));
    let with = rest.split_once(" with ").filter(|(before, _)| is_along(before)).map(|(_, with)| with);
    // The longest words behind "with" that are persons. "With Lily still asleep" is not with Lily.
    let goes_on = |more: &str| {
        let more = more.trim_start();
        let follows = |word: &String| {
            more.strip_prefix(word.as_str()).is_some_and(|rest| !rest.starts_with(char::is_alphanumeric))
        };
        more.is_empty() || more.starts_with(',') || WORDS.along.iter().any(follows)
    };
    let with = with.and_then(|with| {
        let ends_at = with.match_indices([' ', ',']).map(|(at, _)| at).take(SUBJECT_WORDS_MAX).chain([with.len()]);
        ends_at.filter_map(|at| Some((known(&with[..at])?, &with[at..]))).last()
    });
    let with = with.filter(|(_, more)| goes_on(more)).map(|(names, _)| names);
    with.or_else(|| known(takes(rest)?.0)).or_else(|| known(too?)).unwrap_or_default()
}

/// Whom somebody lets into the house: "igor" of "ben lets igor in". What else is let in has no name, or is no person.
pub(in crate::narration) fn guests(said: &str) -> Vec<&str> {
    let of = |rest| {
        after_verb(rest, &WORDS.lets).find_map(|said| {
            let mut ins = said.match_indices(" in").filter_map(|(at, _)| {
                let more = &said[at + " in".len()..];
                let more = ["to the house", "to the apartment", "to the flat"]
                    .iter()
                    .find_map(|to| more.strip_prefix(to))
                    .unwrap_or(more);
                ends_here(more).then(|| names(&said[..at]))?
            });
            ins.next().filter(|names| !names.iter().any(is_a_way))
        })
    };
    if is_not_now(said) || is_reported(said) {
        return Vec::new();
    }
    // Of whom it is told who lets them in, not what somebody says of it.
    cuts(said)
        .take(NAME_WORDS_MAX)
        .find_map(|(subject, rest)| of(rest).filter(|_| is_of_somebody(subject)))
        .unwrap_or_default()
}

/// Whether a plain sentence says that somebody goes home: who lives here comes then, and who does not goes.
pub(in crate::narration) fn goes_home(said: &str) -> bool {
    let is_home =
        |place: &str| ["home", "back home"].iter().any(|home| place.strip_prefix(home).is_some_and(ends_here));
    let goes = |rest: &str| [&WORDS.goes, &WORDS.travels].iter().any(|verbs| after_verb(rest, verbs).any(is_home));
    // "Ada lets Ben go home" is of Ben, and one alone "goes".
    let is_own = |subject: &str, rest: &str| {
        let are_several = has(&WORDS.pronouns, subject) || parts(subject).nth(1).is_some();
        is_said(subject) && (are_several || is_verb(first_word(rest)))
    };
    let is_told = || !is_not_so(said) && !is_reported(said);
    cuts(said).take(NAME_WORDS_MAX).any(|(subject, rest)| goes(rest) && is_own(subject, rest)) && is_told()
}

/// Whether a plain sentence says that somebody visits whom it calls by name, or nobody in particular: who does not live here comes then.
pub(in crate::narration) fn is_visit(said: &str) -> bool {
    let is_named = |whom: &str| !has(&WORDS.determiners, first_word(whom));
    let is_visit = |rest| after_verb(rest, &WORDS.visits).any(is_named) || has(&WORDS.visits, rest);
    cuts(said).take(NAME_WORDS_MAX).any(|(_, rest)| is_visit(rest)) && !is_not_so(said)
}

/// Whether a plain sentence says that somebody is taken home, and not brought: "ada drives ben home".
pub(in crate::narration) fn takes_home(said: &str) -> bool {
    let is_taken = |rest: &str| !rest.starts_with("br") && matches!(takes(rest), Some((_, Presence::Present)));
    cuts(said).take(NAME_WORDS_MAX).any(|(_, rest)| is_taken(rest))
}

/// Whom somebody sees in a room or sends there, the room, and whether they are there already: "ben", "bedroom" of "ada sees ben in the bedroom". Those
/// alone who are known.
pub(in crate::narration) fn seen(
    said: &str,
    mut is_known: impl FnMut(&str) -> bool,
) -> Option<(Vec<&str>, &str, bool)> {
    if is_not_now(said) || said.ends_with('?') {
        return None;
    }
    let mut known = |words| names(words).filter(|names| names.iter().all(|name| is_known(name)));
    cuts(said).take(NAME_WORDS_MAX).filter(|(subject, _)| is_of_somebody(subject)).find_map(|(_, rest)| {
        [(&WORDS.perceives, " in the ", true), (&WORDS.sends, " to the ", false)].into_iter().find_map(
            |(verbs, to, is_there)| {
                let (who, place) = after_verb(rest, verbs).find_map(|after| after.split_once(to))?;
                let room = Some(room_of(place)).filter(|room| is_room(room))?;
                Some((known(who)?, room, is_there))
            },
        )
    })
}

/// Whether a plain sentence says that a guest is one more than those of whom was told: "a guest arrives".
pub(in crate::narration) fn is_of_a_new_guest(said: &str) -> bool {
    let is_new = |part: &str| {
        let noun = ["a ", "another "].iter().find_map(|article| part.strip_prefix(article));
        noun.is_some_and(|noun| has(&WORDS.guests, noun))
    };
    cuts(said).take(NAME_WORDS_MAX).any(|(subject, _)| parts(subject).any(is_new))
}

/// Whether a name in lower case is what any guest is called.
pub(in crate::narration) fn is_guest(name: &str) -> bool {
    has(&WORDS.guests, name)
}
