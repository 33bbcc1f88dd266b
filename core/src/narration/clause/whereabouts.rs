//! Where the words after a subject put it: in a room, at home, out of the house, gone.

use super::Subject;
use super::names::{COUNT_MIN, NAME_WORDS_MAX, SUBJECT_WORDS_MAX, bare, cuts, may_be_new, names, parts};
use super::places::{
    ends, ends_away, ends_here, ends_out, in_the, is_a_place, is_a_town, is_a_way_out, is_at_somebodys, is_elsewhere,
    is_in_the_house, is_out_for, is_outside_by, is_outside_place, is_room, room_of,
};
use super::signs::{is_doubtful, is_past_state, is_reported, is_unreal};
use super::words::{List, STATE_VERBS, WORDS, first_word, has, is_a_way, is_verb, may_be_predicate};
use crate::narration::{Presence, deeds};

/// Whether words go on with what somebody is: "in the kitchen", "away until monday".
pub(super) fn is_state_ahead(rest: &str) -> bool {
    let words = ["not ", "still ", "now ", "on ", "off ", "coming", "in the ", "at the ", "going ", "late"];
    let is_place =
        || WORDS.out.after(rest).chain(WORDS.r#in.after(rest)).any(ends) || is_outside_by(rest, &["at", "in"]);
    words.iter().any(|word| rest.starts_with(word)) || is_place()
}

/// What a sentence's words after its subject say of where somebody is: presence, and the room where it is one.
pub(super) fn predicate(rest: &str) -> Option<(Presence, Option<&str>)> {
    let found = first_predicate(rest)?;
    // Who leaves and comes back is there.
    let last = [" and then ", ", then ", " and ", " but ", " then "].iter().find_map(|join| rest.rsplit_once(join));
    let comes_back =
        || last.and_then(|(_, last)| first_predicate(last)).is_some_and(|(last, _)| last == Presence::Present);
    if found.0 == Presence::Away && comes_back() { Some((Presence::Present, None)) } else { Some(found) }
}

/// What the first of several things says of it.
pub(super) fn first_predicate(rest: &str) -> Option<(Presence, Option<&str>)> {
    if !may_be_predicate(rest) {
        return None;
    }
    let rest = rest.strip_prefix("just ").unwrap_or(rest);
    // Who has left, and says not what, has left the house.
    let has_left = || {
        ["left", "has left", "have left"]
            .iter()
            .filter_map(|left| rest.strip_prefix(left))
            .any(|more| ends_away(more) || is_by_a_door(more))
    };
    // Who arrives at work is there.
    let arrives_outside = |arrives: &str| is_outside_by(arrives, &["at", "to", "into"]) && !works_here(arrives);
    if after_verb(rest, &WORDS.comes).any(arrives_outside) {
        return Some((Presence::Away, None));
    }
    let leaves_for = |said: &str| is_outside_by(said, &["for"]) || is_a_town(said, &["for "]);
    if follows(rest, &WORDS.leaves, &WORDS.house, ends)
        || after_verb(rest, &WORDS.leaves).any(leaves_for)
        || goes_out(rest)
        || rides_out(rest)
        || stays_elsewhere(rest)
        || has_left()
    {
        return Some((Presence::Away, None));
    }
    if let Some((_, presence)) = takes(rest) {
        return Some((presence, None));
    }
    if arrives(rest) {
        return Some((Presence::Present, None));
    }
    let state = state(rest)?;
    if is_in_doubt(state) {
        return None;
    }
    // Who is not home alone is home.
    let is_with_others = state.starts_with("not ") && crate::text::has_words(state, "alone");
    let is_out = |state: &str| WORDS.out.after(state).any(ends_away) || is_outside_by(state, &["at", "in"]);
    // "Sitting in a café", "in a meeting at work".
    let is_waiting = || after_verb(state, &WORDS.postures).any(is_out);
    let is_delayed = || after_verb(state, &WORDS.delayed).any(|at| is_out(at) || at.starts_with("at the office"));
    if !is_with_others && (is_out(state) || is_waiting() || is_delayed() || is_out_doing(state) || is_on_the_way(state))
    {
        return Some((Presence::Away, None));
    }
    // Who is at the office may be at work.
    let may_be_at_work = |room: &&str| *room == "office" && state.starts_with("at ");
    if let Some(room) = in_the(state).map(room_of).filter(|room| is_room(room) && !may_be_at_work(room)) {
        return Some((Presence::Present, Some(room)));
    }
    let is_in = WORDS.r#in.after(state).any(ends_here);
    is_in.then_some((Presence::Present, None))
}

/// Whether somebody is out to do something: "out running errands".
fn is_out_doing(state: &str) -> bool {
    state.strip_prefix("out ").is_some_and(|what| {
        let is_near = |word: &str| has(&WORDS.near_the_house, word) || has(&WORDS.rooms, word);
        first_word(what).ends_with("ing") && !what.split([' ', ',']).any(is_near)
    })
}

/// Whether somebody is on the way to where no room is: "on her way to the office". Who is on the way home, or out of a room, may be anywhere.
fn is_on_the_way(state: &str) -> bool {
    WORDS.ways_to.after(state).any(|to| to.strip_prefix(" to ").is_some_and(is_elsewhere))
}

/// What the last thing that somebody does says of where they are then: "takes her keys and leaves". Who leaves, and nobody says what, leaves the
/// house.
fn last_of_all(subject: &str, rest: &str, are_several: bool) -> Option<(Presence, Option<&'static str>)> {
    let joins = || [" and then ", ", then ", " and ", " then "].iter().find_map(|join| rest.rsplit_once(join));
    // "Leaves with ada and ben": what is joined are those who go along.
    let are_along = |(before, last): &(&str, &str)| {
        let with = LEAVES.iter().find_map(|verb| before.strip_prefix(verb)?.strip_prefix(" with "));
        with.is_some_and(|with| names(with).is_some()) && names(last).is_some() && !is_verb(first_word(last))
    };
    let joined = if are_several { joins().filter(|joined| !are_along(joined)) } else { None };
    let last = joined.map_or(rest, |(_, last)| last);
    let leaves_first = joined.is_some_and(|(before, last)| leaves_first(before, last));
    if !leaves_first && !may_be_predicate(last) {
        return None;
    }
    let role = bare(subject).is_some_and(|name| has(&WORDS.people, name));
    let is_person = role
        || has(&WORDS.pronouns, subject)
        || names(subject).is_some_and(|names| names.iter().all(|name| may_be_new(name)));
    // "Ada" of "ada and ben put on their coats and leave" does nothing alone.
    let verb = rest.split([' ', ',']).next().unwrap_or_default();
    let is_of_several = has(&WORDS.pronouns, subject) || parts(subject).nth(1).is_some();
    let does = !has(&WORDS.no_verbs, verb) && (is_of_several || is_verb(verb) || joined.is_none());
    if !is_person || !does || is_reported(rest) || is_past_state(rest) {
        return None;
    }
    // Who only works here has a home elsewhere.
    let goes_home =
        || ["goes home", "drives home", "heads home"].iter().any(|verb| last.strip_prefix(verb).is_some_and(ends));
    let goes = || ["goes", "go", "went"].iter().any(|verb| last.strip_prefix(verb).is_some_and(ends));
    let takes_leave = || joined.is_some_and(|(before, _)| WORDS.farewells.begin(before).any(|(_, more)| ends(more)));
    let is_off = joined.is_some() && (role && (goes_home() || goes()) || takes_leave() && goes());
    if leaves_the_house(last) || is_off || leaves_first {
        return Some((Presence::Away, None));
    }
    predicate(last)
        .map(|(presence, _)| presence)
        .filter(|presence| *presence == Presence::Away)
        .map(|away| (away, None))
}

/// Whether words behind a verb of leaving say by which way: "through the front door".
fn is_by_a_door(more: &str) -> bool {
    [" through ", " by ", " from ", " via "].iter().any(|by| more.strip_prefix(by).is_some_and(is_a_way_out))
}

/// Verbs of who leaves, and nobody says what.
const LEAVES: [&str; 3] = ["leaves", "leave", "left"];

/// Whether somebody leaves, and nobody says what. Who leaves after dinner may only plan to, and who is leaving has not left yet.
fn leaves_the_house(rest: &str) -> bool {
    let is_plan =
        |verb: &str, more: &str| verb != "left" && [" after ", " before "].iter().any(|when| more.starts_with(when));
    // What somebody leaves at home is a thing.
    let is_of_a_thing = |more: &str| {
        more.strip_prefix(" at ")
            .is_some_and(|place| WORDS.house.after(place).next().is_some() || is_a_place(more.trim_start()))
    };
    let leaves = |verb: &str, more: &str| {
        (ends_away(more) || is_by_a_door(more)) && !is_plan(verb, more) && !is_of_a_thing(more)
    };
    LEAVES.iter().any(|verb| rest.strip_prefix(verb).is_some_and(|more| leaves(verb, more)))
}

/// Whether the first of two deeds is that somebody leaves, and the other one what is done on the way out: "leaves and takes the dog with her".
fn leaves_first(before: &str, last: &str) -> bool {
    LEAVES.contains(&before)
        && has(&WORDS.on_leaving, first_word(last))
        && predicate(last).is_none_or(|(presence, _)| presence == Presence::Away)
}

/// Whether a subject is all, or all but a few.
fn is_of_all(subject: &str) -> bool {
    let begins = WORDS.everybody.iter().any(|all| subject.starts_with(all.as_str()));
    begins && (has(&WORDS.everybody, subject) || matches!(of_some(subject), Some(Subject::Others(_))))
}

/// What words say of all, that would not tell which place one person leaves: "everybody leaves".
fn all_leave(subject: &str, rest: &str) -> Option<(Presence, Option<&'static str>)> {
    let is_of_all = || is_of_all(subject) || so_many(subject).is_some() || is_of_guests(subject);
    (leaves_the_house(rest) && is_of_all()).then_some((Presence::Away, None))
}

/// How many persons a subject is by their number: "both", "all three", "the two of them".
pub(super) fn so_many(subject: &str) -> Option<usize> {
    if has(&WORDS.both, subject) || has(&WORDS.two, subject.strip_prefix("the ").unwrap_or(subject)) {
        return Some(2);
    }
    // The number alone may be that of others.
    let count = subject
        .strip_prefix("all ")
        .or_else(|| subject.strip_prefix("the "))
        .or_else(|| subject.strip_prefix("they all "))?;
    let (count, of) = count.split_once(' ').unwrap_or((count, ""));
    let is_whole = matches!(of, "of them" | "of us") || of.is_empty() && !subject.starts_with("the ");
    let place = WORDS.numbers.iter().position(|number| number == count).filter(|_| is_whole)?;
    Some(place + COUNT_MIN)
}

/// Whether a subject is all who do not live here: "the guests", "all our visitors".
pub(super) fn is_of_guests(subject: &str) -> bool {
    let guests = ["all of ", "all "].iter().find_map(|all| subject.strip_prefix(all)).unwrap_or(subject);
    let noun = guests.split_once(' ').filter(|(first, _)| has(&WORDS.determiners, first)).map(|(_, noun)| noun);
    noun.and_then(|noun| noun.strip_suffix('s')).is_some_and(|noun| has(&WORDS.guests, noun))
}

/// What words say of all that do something in one room: "everybody goes to the kitchen", "everybody sits down in the living room".
fn all_in_a_room<'a>(subject: &str, rest: &'a str) -> Option<(Presence, Option<&'a str>)> {
    if !is_of_all(subject) {
        return None;
    }
    let (at, place) =
        [" to the ", " into the ", " in the "].iter().filter_map(|to| rest.rsplit_once(to)).next_back()?;
    let is_done = !is_unreal(rest) && !at.contains([',', ' ']) || at.split(' ').count() <= 2 && !is_unreal(rest);
    (is_room(place) && is_done && !is_doubtful(rest)).then_some((Presence::Present, Some(place)))
}

/// A subject that is all but a few, or a few alone: "everybody except igor", "nobody but lily", "only lily".
pub(super) fn of_some(subject: &str) -> Option<Subject<'_>> {
    if let Some(only) = subject.strip_prefix("only ") {
        return names(only).map(Subject::Only);
    }
    let (all, but) = excepted(subject)?;
    match but? {
        but if has(&WORDS.everybody, all) => Some(Subject::Others(but)),
        but if has(&WORDS.nobody, all) => Some(Subject::Only(but)),
        _ => None,
    }
}

/// Whether words after a subject say that it is alone in the house: "is home alone", "is alone at home".
pub(super) fn is_alone(rest: &str) -> bool {
    let is_home = |place: &String| {
        let verbs = ["is ", "are ", "stays ", "stay ", "remains ", "remain "];
        let Some(said) = verbs.iter().find_map(|verb| rest.strip_prefix(verb)) else { return false };
        let said = said.strip_prefix("still ").or_else(|| said.strip_prefix("now ")).unwrap_or(said);
        let said = said.strip_prefix("all ").unwrap_or(said);
        let after = said.strip_prefix(place.as_str()).and_then(|rest| rest.strip_prefix(" alone")).is_some_and(ends);
        let before =
            || said.strip_prefix("alone ").and_then(|rest| rest.strip_prefix(place.as_str())).is_some_and(ends);
        after || before()
    };
    // Who is back alone may not be the only one.
    WORDS.r#in.iter().filter(|place| *place != "in" && !place.starts_with("back")).any(is_home)
}

/// What stands before "except", and the persons that stand behind it; none where they are no persons.
pub(super) fn excepted(words: &str) -> Option<(&str, Option<Vec<&str>>)> {
    let cuts = WORDS.except.iter().filter_map(|except| {
        let (at, _) = words
            .match_indices(except.as_str())
            .find(|(at, _)| words[..*at].ends_with([' ', ',']) && words[at + except.len()..].starts_with(' '))?;
        Some((at, at + except.len()))
    });
    // "Except for", not "except".
    let (begin, end) = cuts.min_by_key(|(begin, end)| (*begin, usize::MAX - *end))?;
    Some((words[..begin].trim_end_matches([' ', ',']), names(words[end..].trim_start())))
}

/// Whether a subject is somebody without a name who may live here: "a woman", "the old man", and not "the delivery man".
pub(super) fn is_anybody(subject: &str) -> bool {
    let mut words = subject.split(' ');
    words.next().is_some_and(|first| has(&WORDS.determiners, first))
        && subject.split(' ').count() <= 3
        && !subject.split(' ').any(|word| has(&WORDS.trades, word))
        && subject.rsplit(' ').next().is_some_and(|last| has(&WORDS.anybody, last))
}

/// What follows one of the verbs that words begin with.
pub(super) fn after_verb<'a>(rest: &'a str, verbs: &List) -> impl Iterator<Item = &'a str> {
    verbs.after(rest).filter_map(|after| after.strip_prefix(' '))
}

/// Whether words begin with one of the verbs and one of the places, and what follows those says the same.
pub(super) fn follows(rest: &str, verbs: &List, places: &List, ends: fn(&str) -> bool) -> bool {
    after_verb(rest, verbs).any(|said| places.after(said).any(ends))
}

/// Whether a sentence's words after its subject say that somebody comes home.
pub(super) fn arrives(rest: &str) -> bool {
    let is_back =
        |state: &str| ["back home", "back"].iter().any(|back| state.strip_prefix(back).is_some_and(ends_here));
    // "Comes to visit Ada", "drops by".
    let comes_to = |said: &str| {
        said.strip_prefix("to ")
            .is_some_and(|to| WORDS.purposes.begin(to).any(|(_, more)| more.is_empty() || more.starts_with(' ')))
    };
    // Who visits, and nobody says whom, comes here.
    let visits = || WORDS.visits.after(rest).any(|more| ends_here(more) && !more.starts_with(" at "));
    follows(rest, &WORDS.comes, &WORDS.at_house, ends_here)
        || visits()
        || after_verb(rest, &WORDS.comes).any(comes_to)
        || follows(rest, &WORDS.drops_in, &WORDS.at_house, ends_here)
        || state(rest).is_some_and(is_back)
        || matches!(takes(rest), Some((_, Presence::Present)))
}

/// Whether somebody goes by a vehicle, which no home has room for, or takes what carries many: "drives to the lake", "takes the bus to town".
fn rides_out(rest: &str) -> bool {
    let goes_to = |said: &str| said.strip_prefix("to ").is_some_and(|to| !to.is_empty() && !is_in_the_house(to));
    let drives =
        |said: &str| ["away", "off"].iter().any(|way| said.strip_prefix(way).is_some_and(ends_out)) || goes_to(said);
    // A toy is taken from a shelf.
    let from = |more: &str| is_outside_by(more, &["from"]) || is_a_town(more, &["from "]);
    let boards = |more: &str| match first_word(more) {
        "" => true,
        // Who does something more has come home.
        "home" | "back" => ![" and ", " then "].iter().any(|join| more.contains(join)),
        "to" => goes_to(more),
        "from" => from(more),
        _ => ends(&format!(" {more}")) && !crate::text::has_words(more, "it"),
    };
    let is_left = ["change", "gets off", "get off"].iter().any(|verb| rest.starts_with(verb));
    after_verb(rest, &WORDS.vehicles).any(drives)
        || (!is_left && deeds::carrier(rest).is_some_and(boards))
        || deeds::vehicle(rest).is_some_and(goes_to)
}

/// Whether somebody stays where others live: "is at vera's", "sleeps at his mother's", "is visiting her parents".
fn stays_elsewhere(rest: &str) -> bool {
    let at = |said: &str| said.starts_with("at ") && is_at_somebodys(&format!(" {said}"));
    let is_others = |whom: &str| {
        let (first, noun) = whom.split_once(' ').unwrap_or_default();
        let is_one = || {
            WORDS
                .people
                .after(noun)
                .chain(WORDS.relatives.after(noun))
                .any(|more| ends(more.strip_prefix('s').unwrap_or(more)))
        };
        has(&WORDS.determiners, first) && first != "the" && is_one()
    };
    after_verb(rest, &WORDS.stays).any(at)
        || state(rest).is_some_and(at)
        || after_verb(rest, &WORDS.visits).any(is_others)
}

/// Whether it is not told which of several things somebody is: "either in the kitchen or out", "out of milk".
pub(super) fn is_in_doubt(state: &str) -> bool {
    [" or ", " nor "].iter().any(|or| state.contains(or)) || is_not_in(state)
}

/// What somebody is out of who is not in it, or has none of it: "out of the shower", "out of milk". Who is out of the house is away.
fn is_not_in(state: &str) -> bool {
    let of = state.strip_prefix("out of ");
    of.is_some_and(|of| {
        !WORDS.house.after(of).any(ends)
            && !["town", "home"].iter().any(|place| of.strip_prefix(place).is_some_and(ends))
    })
}

/// Whether a sentence's words after its subject say that somebody goes where they are out of the house: "has gone to work".
fn goes_out(rest: &str) -> bool {
    const WHERE: [&str; 8] = ["to", "into", "for", "in", "around", "through", "across", "along"];
    // "Has gone to pick up a pizza": who has only set out says from where.
    let is_gone = ["has gone ", "have gone ", "went out "].iter().any(|gone| rest.starts_with(gone));
    let is_errand = |said: &str| {
        let what = ["to ", "off to ", "out to "].iter().find_map(|to| said.strip_prefix(to));
        what.is_some_and(|what| {
            deeds::is_errand(what, is_gone) || deeds::fetched_from(what).is_some_and(is_outside_place)
        })
    };
    let is_off =
        |said: &str| ["off to ", "off for "].iter().any(|off| said.strip_prefix(off).is_some_and(is_elsewhere));
    let is_to_outside = |said: &str| is_outside_by(said, &WHERE) || is_off(said) || is_errand(said);
    let mut ways = after_verb(rest, &WORDS.goes).chain(after_verb(rest, &WORDS.travels)).chain(deeds::moves(rest));
    let is_off_to = || {
        ["is ", "are ", "goes ", "go ", "went ", "sets ", "set "]
            .iter()
            .any(|verb| rest.strip_prefix(verb).is_some_and(is_off))
    };
    let takes_a_walk = || {
        let is_animal = |said: &str| WORDS.animals.after(said).any(ends_out);
        follows(rest, &WORDS.takes, &WORDS.outings, ends_out)
            || ["walks ", "walk ", "walked "].iter().any(|walks| rest.strip_prefix(walks).is_some_and(is_animal))
    };
    // "Steps out", "slips out of the house".
    let moves_out = || {
        let is_out = |said: &str| {
            let more = said.strip_prefix("out")?;
            Some(
                ends_out(more) && !more.starts_with(" to ")
                    || more.strip_prefix(" of ").is_some_and(|of| WORDS.house.after(of).any(ends)),
            )
        };
        [&WORDS.moves, &WORDS.travels]
            .iter()
            .any(|verbs| after_verb(rest, verbs).any(|said| is_out(said) == Some(true)))
    };
    let is_by_the_door = || {
        let mut ways = [&WORDS.goes, &WORDS.travels].into_iter();
        ways.any(|verbs| follows(rest, verbs, &WORDS.ways_out, ends_out))
    };
    (after_verb(rest, &WORDS.goes).any(is_out_for)
        || moves_out()
        || takes_a_walk()
        || is_by_the_door()
        || is_off_to()
        || deeds::moves(rest).is_some_and(|said| is_out_for(said) && said.contains(' '))
        || ways.any(is_to_outside))
        && !works_here(rest)
}

/// Whether somebody works in the house: "goes to work at her desk", "from home".
pub(super) fn works_here(said: &str) -> bool {
    let Some((_, after)) = said.split_once("to work") else { return false };
    [" from home", " at her ", " at his ", " at their ", " at the ", " on "].iter().any(|here| after.starts_with(here))
}

/// Whom somebody takes along who goes out of the house or comes home, and which: "lily" and away of "takes lily to school", "drops lily off at
/// school" and "picks lily up from school"; "lily" and present of "brings lily home".
pub(super) fn takes(rest: &str) -> Option<(&str, Presence)> {
    let mut taken = after_verb(rest, &WORDS.takes);
    let is_errand = |place: &str| WORDS.errands.begin(place).any(|(own, after)| own.contains(' ') && ends(after));
    let where_to = |place: &str| {
        let place =
            ["off ", "up ", "a lift ", "a ride "].iter().find_map(|word| place.strip_prefix(word)).unwrap_or(place);
        let is_home = ["home", "back home", "back"].iter().any(|home| place.strip_prefix(home).is_some_and(ends));
        let is_out = is_outside_by(place, &["to", "into", "at"]) && !works_here(place);
        match is_home && !is_out {
            true => Some(Presence::Present),
            false => (is_out || is_errand(place) || is_outside_by(place, &["from"])).then_some(Presence::Away),
        }
    };
    taken.find_map(|said| {
        let said = ["off ", "up "].iter().find_map(|word| said.strip_prefix(word)).unwrap_or(said);
        let spaces = said.match_indices(' ').take(SUBJECT_WORDS_MAX);
        let mut cuts = spaces.map(|(at, _)| (&said[..at], &said[at + 1..]));
        cuts.find_map(|(taken, place)| Some((taken, where_to(place)?))).filter(|(taken, _)| {
            let is_group = || {
                taken
                    .split_once(' ')
                    .is_some_and(|(first, noun)| has(&WORDS.determiners, first) && has(&WORDS.groups, noun))
            };
            has(&WORDS.animals, taken) || is_group() || names(taken).is_some_and(|names| !names.iter().any(is_a_way))
        })
    })
}

/// Whether a plain sentence says what somebody left behind, who may be anywhere now: "ada left the light on in the office". Who left the kitchen
/// did so from there.
pub(in crate::narration) fn is_of_what_was_left(said: &str) -> bool {
    const WHERE: [&str; 5] = [" on", " in ", " at ", " open", " running"];
    let is_left = |rest: &str| {
        let left = ["left ", "leaves ", "leave ", "forgot "]
            .iter()
            .find_map(|verb| rest.strip_prefix(verb))
            .unwrap_or_default();
        let thing = WHERE.iter().filter_map(|place| left.find(place)).min().map_or("", |at| &left[..at]);
        let (first, noun) = thing.split_once(' ').unwrap_or_default();
        has(&WORDS.determiners, first) && !is_room(noun)
    };
    cuts(said).take(NAME_WORDS_MAX).any(|(_, rest)| is_left(rest))
}

/// What somebody is, in a sentence that says it: "is still away" is "away".
pub(super) fn state(rest: &str) -> Option<&str> {
    let mut state = STATE_VERBS.iter().find_map(|verb| rest.strip_prefix(verb))?;
    while let Some(rest) = ["still ", "now ", "already ", "currently ", "just ", "alone ", "all alone "]
        .iter()
        .find_map(|word| state.strip_prefix(word))
    {
        state = rest;
    }
    Some(state)
}

/// Presence, and the room where it is one.
type Whereabouts<'a> = (Presence, Option<&'a str>);

/// The first subject of a plain sentence of which it says where they are, what follows it, and what that says.
pub(super) fn where_to(said: &str) -> Option<(&str, &str, Whereabouts<'_>)> {
    let are_several = said.contains(" and ") || said.contains(" then ");
    cuts(said).find_map(|(subject, rest)| {
        let where_to = predicate(rest).or_else(|| last_of_all(subject, rest, are_several));
        let of_all = || all_leave(subject, rest).or_else(|| all_in_a_room(subject, rest));
        Some((subject, rest, where_to.or_else(of_all)?))
    })
}
