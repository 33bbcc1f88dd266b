//! What kind of sentence it is: of another time, asked, ordered, reported, denied, or said from afar.

use super::names::{NAME_WORDS_MAX, NEW_NAME_WORDS_MAX, bare, cuts};
use super::places::{ends, is_at_somebodys, is_elsewhere, is_indoors, is_outside_by, is_own_room};
use super::signs::{is_said, is_unreal, without_first};
use super::whereabouts::{after_verb, arrives, first_predicate, follows, is_of_what_was_left, predicate, state};
use super::words::{WORDS, first_word, has, is_verb};
use super::{Clause, Subject};
use crate::narration::{Presence, deeds};

/// Whether a plain sentence says what is so at another time, or again and again: "ada comes home tomorrow", "ben usually leaves the house",
/// "ada is back in ten minutes", "ben is home at six".
pub(in crate::narration) fn is_not_now(said: &str) -> bool {
    fn last_word(words: &str) -> &str {
        words.trim_end().rsplit([' ', ',']).next().unwrap_or_default()
    }
    let said = without_first(said);
    // "Ada and Ben leave" is one thought, "Ada leaves the house and comes back tomorrow" two.
    let is_whole = |at: usize| cuts(&said[..at]).any(|(_, rest)| first_predicate(rest).is_some());
    let joins = [" and ", " but "].into_iter().flat_map(|join| said.match_indices(join));
    let deeds = joins.map(|(at, _)| at).filter(|at| is_whole(*at));
    let is_thought = |at: &usize| WORDS.another_thought.iter().any(|begin| said[*at..].starts_with(begin.as_str()));
    let thought = said.match_indices([' ', ':']).map(|(at, _)| at).find(is_thought);
    let main = &said[..thought.into_iter().chain(deeds).min().unwrap_or(said.len())];
    let is_other_time = |at: usize, words: &str, after: &str| {
        let before = &main[..at];
        let is_whole = !after.starts_with(|c: char| c.is_alphanumeric() || c == '\'');
        // "A minute later" and "soon after" go on with what is told.
        let goes_on = matches!(words, "later" | "shortly" | "soon")
            && (before.is_empty()
                // "Later than usual" is now, "no later than six" is not.
                || after.starts_with(" than") && last_word(before) != "no"
                || has(&WORDS.units, last_word(before))
                || after.starts_with(',')
                || after.starts_with(" after"));
        let is_as_always = words == "always" && last_word(before) == "as";
        is_whole && !goes_on && !is_as_always && !has(&WORDS.lasting, last_word(before))
    };
    let mut begins = main.match_indices(' ').map(|(at, _)| at + 1).chain([0]);
    let is_at_another_time =
        begins.any(|at| WORDS.not_now.begin(&main[at..]).any(|(words, after)| is_other_time(at, words, after)));
    let goes_on = said[main.len()..].trim_start_matches(',').trim_start();
    let is_all = goes_on.is_empty() || goes_on.starts_with("and ") || goes_on.starts_with("then ");
    let is_planned = || is_at_an_hour(main) && !(is_all && ends_with_an_hour(main) && comes_home(main));
    let is_ahead = is_ahead(main) || is_planned() || cuts(main).any(|(_, rest)| is_back_at_a_time(rest));
    is_at_another_time || is_ahead
}

/// Whether a text has a time ahead: "in ten minutes".
fn is_ahead(text: &str) -> bool {
    text.match_indices(" in ").any(|(at, _)| {
        let mut words = text[at + 4..].split([' ', ',']).peekable();
        let is_count = |word: &&str| {
            word.starts_with(|c: char| c.is_ascii_digit())
                || has(&WORDS.hours, word)
                || ["a", "an", "some", "couple", "few", "of"].contains(word)
        };
        let counts = std::iter::from_fn(|| words.next_if(is_count)).count();
        counts > 0 && words.next().is_some_and(|word| has(&WORDS.units, word))
    })
}

/// Whether a text says at which hour something is done, which is then a plan, or what is done every day: "ada leaves at nine". What was done at an
/// hour has happened, and so has what was noted to the minute: "leaves the house at 8:15".
fn is_at_an_hour(text: &str) -> bool {
    let is_done = |word: &str| word.ends_with("ed") || has(&WORDS.past, word) || matches!(word, "has" | "have" | "had");
    text.match_indices(" at ").any(|(at, found)| {
        has(&WORDS.hours, first_word(&text[at + found.len()..])) && !text[..at].split(' ').any(is_done)
    })
}

/// Whether the hour is the last that a text says: behind "at six in winter" and "at six, maybe" it is no longer told as it happens.
fn ends_with_an_hour(text: &str) -> bool {
    const MORE: [&str; 11] =
        ["past", "to", "o'clock", "sharp", "today", "am", "pm", "fifteen", "twenty", "thirty", "forty-five"];
    const PARTS: [&str; 4] = [" in the morning", " in the afternoon", " in the evening", " at night"];
    let text = PARTS.iter().find_map(|part| text.strip_suffix(part)).unwrap_or(text);
    text.rsplit_once(" at ").is_some_and(|(_, time)| {
        let mut words = time.split(' ');
        words.clone().next().is_some_and(|first| has(&WORDS.hours, first))
            && words.all(|word| has(&WORDS.hours, word) || MORE.contains(&word))
            && !time.ends_with(" to")
    })
}

/// Whether a text says that somebody comes home, which is told when it happens, also with the hour: "comes home at six".
fn comes_home(text: &str) -> bool {
    // "Back at the office" is elsewhere.
    let is_home = |more: &str| {
        let at = more.strip_prefix(" at ").map(first_word);
        !more.starts_with(char::is_alphanumeric) && at.is_none_or(|first| has(&WORDS.hours, first))
    };
    cuts(text).any(|(subject, rest)| is_said(subject) && follows(rest, &WORDS.comes, &WORDS.r#in, is_home))
}

/// Whether words after a subject say when it will be there: "is home at six", "is back by noon".
fn is_back_at_a_time(rest: &str) -> bool {
    let Some(state) = state(rest) else { return false };
    let mut times =
        WORDS.r#in.after(state).filter_map(|after| after.strip_prefix(" at ").or_else(|| after.strip_prefix(" by ")));
    times.any(|time| time.starts_with(|c: char| c.is_ascii_digit()) || has(&WORDS.hours, first_word(time)))
}

/// Whether a plain sentence says what somebody is, or where they go, and not that they are or come home: "ada is at the gym", "ada is late", "ada
/// flies to rome". Whether that is in the house, only who knows the map can tell.
pub(in crate::narration) fn may_be_elsewhere(said: &str) -> bool {
    const WAYS: [&str; 10] = ["at ", "in ", "on ", "to ", "into ", "along ", "around ", "through ", "across ", "past "];
    let is_going = |rest: &str| {
        let ways = [&WORDS.goes, &WORDS.comes, &WORDS.travels].into_iter().flat_map(|verbs| after_verb(rest, verbs));
        let mut ways = ways.chain(deeds::moves(rest));
        ways.any(|way| WAYS.iter().any(|to| way.trim_start_matches("back ").starts_with(to)) && !is_own_room(way))
    };
    // Who "is cooking" does something.
    let is_something = |rest: &str| {
        let what = state(rest).and_then(|state| state.split([' ', ',']).next());
        what.is_some_and(|what| !what.ends_with("ing") || has(&WORDS.under_way, what))
            && !state(rest).is_some_and(is_indoors)
    };
    Clause::read(said).is_none() && cuts(said).any(|(_, rest)| is_going(rest) || is_something(rest))
}

/// Whether a plain sentence says that somebody speaks: "ada tells ben to go to the kitchen".
pub(in crate::narration) fn is_speech(said: &str) -> bool {
    cuts(said)
        .take(NAME_WORDS_MAX)
        .any(|(_, rest)| has(&WORDS.speaks, rest.split([' ', ',', ':']).next().unwrap_or_default()))
}

/// Whether a plain sentence says what state a device is in: "the oven is on", "the door opens".
pub(in crate::narration) fn is_of_a_state(said: &str) -> bool {
    let is_of_a_state = |(_, rest): (&str, &str)| {
        let begun = state(rest).is_some_and(|state| WORDS.begun.after(state).any(ends));
        begun || ["opens", "closes"].iter().any(|verb| rest.strip_prefix(verb).is_some_and(ends))
    };
    cuts(said).any(is_of_a_state) || is_of_an_end(said)
}

/// Whether a plain sentence tells somebody to do something: "ada, come to the kitchen".
pub(in crate::narration) fn is_order(said: &str) -> bool {
    said.split_once(", ").is_some_and(|(whom, order)| {
        let is_one = !whom.contains(" and ") && whom.split(' ').count() <= NEW_NAME_WORDS_MAX && bare(whom).is_some();
        is_one && has(&WORDS.orders, first_word(order))
    })
}

/// Whether a plain sentence says what somebody may do who is not there: call, be on the way, plan to come.
pub(in crate::narration) fn is_from_afar(said: &str) -> bool {
    let begins = |rest: &str, words: &String| {
        rest.strip_prefix(words.as_str()).is_some_and(|more| !more.starts_with(char::is_alphanumeric))
    };
    // Who comes home from work is there, and so is who is home from work.
    let is_home = |clause: &Clause<'_>| {
        clause.is_arrival || clause.is_state && clause.presence == Presence::Present && clause.room.is_none()
    };
    if Clause::read(said).is_some_and(|clause| is_home(&clause) && clause.subject != Subject::Other) {
        return false;
    }
    let is_outside = || said.match_indices(' ').any(|(at, _)| is_outside_by(&said[at + 1..], &["at", "in"]));
    let is_afar = || WORDS.afar.is_in(said) || is_outside() || is_at_somebodys(said) || is_of_what_was_left(said);
    // What somebody does last tells where they are: "takes the bus home and opens the fridge".
    let last = [" and then ", ", then ", " and "].iter().find_map(|join| said.rsplit_once(join)).map(|(_, last)| last);
    let is_back = last.is_some_and(|last| is_verb(first_word(last)) && (arrives(last) || !may_be_from_afar(last)));
    let is_elsewhere = || !is_back && cuts(said).take(NAME_WORDS_MAX).any(|(_, rest)| may_be_done_elsewhere(rest));
    let begins_afar = || {
        !last.is_some_and(arrives)
            && cuts(said).any(|(_, rest)| WORDS.from_afar.iter().any(|words| begins(rest, words)))
    };
    begins_afar() || is_afar() || is_elsewhere()
}

/// Whether words after a subject say what may be done from elsewhere.
fn may_be_from_afar(rest: &str) -> bool {
    may_be_done_elsewhere(rest)
        || has(&WORDS.speaks, first_word(rest))
        || predicate(rest).is_some_and(|(presence, _)| presence == Presence::Away)
}

/// Whether what is said of a subject may be done by somebody who is not in the house.
fn may_be_done_elsewhere(rest: &str) -> bool {
    deeds::may_be_done_elsewhere(rest) || leaves_elsewhere(rest)
}

/// Whether somebody leaves where they can only have been out of the house: "leaves work", "left the gym". An office is rather the one out of it.
fn leaves_elsewhere(rest: &str) -> bool {
    // "Leaves the house. Then she comes home."
    let is_house = |place: &str| WORDS.house.after(place).any(|more| !more.starts_with(char::is_alphanumeric));
    after_verb(rest, &WORDS.leaves).any(|place| !is_house(place) && is_elsewhere(place))
}

/// Whether what a plain sentence says does not happen now: it is denied, planned, possible, or of another time.
pub(in crate::narration) fn is_not_so(said: &str) -> bool {
    is_not_now(said) || cuts(said).take(NAME_WORDS_MAX).any(|(_, rest)| is_unreal(rest))
}

/// Whether a word behind a plain text belongs to its verb: "after" of "ada looks after".
pub(in crate::narration) fn goes_on_with(said: &str, word: &str) -> bool {
    let verb = said.rsplit(' ').next().unwrap_or_default();
    word.trim_start_matches([',', ' ']).eq_ignore_ascii_case("after") && has(&WORDS.verbs_with_after, verb)
}

/// Whether a plain sentence says of a device that something has ended.
pub(in crate::narration) fn is_of_an_end(said: &str) -> bool {
    cuts(said).any(|(subject, rest)| {
        let is_thing = subject.strip_prefix("the ").is_some_and(|name| !has(&WORDS.people, name));
        is_thing && state(rest).is_some_and(|state| WORDS.ended.after(state).any(ends))
    })
}
