//! Places: rooms of the house, places out of it, and whether what follows one changes what was said of it.

use super::names::{MODIFIERS_MAX, NAME_WORDS_MAX};
use super::signs::is_said;
use super::words::{List, WORDS, first_word, has};
use crate::names::Names;

/// Whether nothing follows a place that changes what was said of it.
pub(super) fn ends(more: &str) -> bool {
    let goes_on = |words: &str| WORDS.goes_on.after(words).any(|rest| !rest.starts_with(char::is_alphanumeric));
    more.is_empty() || (more.starts_with([' ', ',']) && (goes_on(more.trim_start()) || is_outside(more.trim_start())))
}

/// The same after words that say that somebody is away: "leaves for bed" and "gone from the kitchen" are in the house.
pub(super) fn ends_away(more: &str) -> bool {
    let to = more.trim_start().split_once(' ').map_or("", |(_, to)| to);
    let is_out = || {
        WORDS.away_for.iter().any(|place| to.starts_with(place.as_str()))
            || is_outside(more.trim_start())
            || is_a_town(more, &[" to ", " from ", " for "])
    };
    // "On a business trip in Rome".
    if is_a_town(more, &[" in "]) {
        return true;
    }
    let is_a_time =
        || more.trim_start().split_once(' ').is_some_and(|(_, rest)| rest.starts_with(|c: char| c.is_ascii_digit()));
    let goes_on = [" from ", " for ", " to ", " by "].iter().any(|word| more.starts_with(word));
    ends(more) && !is_at_a_thing(more.trim_start()) && (!goes_on || is_a_time() || is_out())
}

/// Whether words name a place: "to the hotel", "at her desk".
pub(super) fn is_a_place(words: &str) -> bool {
    ["at ", "to ", "in "].iter().any(|to| {
        words.strip_prefix(to).is_some_and(|place| {
            has(&WORDS.determiners, place.split([' ', ',']).next().unwrap_or_default())
                && !place.starts_with("the moment")
        })
    })
}

/// The same as [`ends`] after words that say that somebody is there: who is "back at the hotel" is elsewhere.
pub(super) fn ends_here(more: &str) -> bool {
    let words = more.trim_start();
    ends(more) && !is_a_place(words) && !is_outside_by(words, &["at", "to", "into", "in"])
}

/// The same after words that say that somebody goes out: who "goes out to the balcony" may be in the house, and who goes "out from the kitchen" is.
pub(super) fn ends_out(more: &str) -> bool {
    let words = more.trim_start();
    let is_from_inside = || words.strip_prefix("from ").is_some_and(|place| is_inside(place) && !is_a_way_out(place));
    let is_by_the_door = || words.strip_prefix("at ").is_some_and(is_a_way_out);
    ends(more) && !is_from_inside() && (!is_a_place(words) || is_outside(words) || is_by_the_door())
}

/// The same after what is done out of the house, as "swimming" is: also at places that are not always out of it, as a pool.
fn ends_out_doing(more: &str) -> bool {
    let words = more.trim_start();
    let place = ["at ", "in "].iter().find_map(|at| words.strip_prefix(at)).filter(|place| noun_of(place) != *place);
    let is_out = |place: &str| is_outside_place(place) || is_a_resort(place) && !is_home_by_its_noun(place);
    place.map_or_else(|| ends_out(more), |place| ends_at(more) && is_out(place))
}

/// Whether a place is one to which people go for sport, a walk or to shop: "the lake", "the corner store".
fn is_a_resort(place: &str) -> bool {
    let noun = room_of(noun_of(place));
    has(&WORDS.resorts, noun.rsplit(' ').next().unwrap_or_default())
        && !noun.starts_with("app ")
        && !noun.starts_with("online ")
}

/// Whether nothing follows a place with "at" or "in" that changes what was said of it.
fn ends_at(more: &str) -> bool {
    let words = more.trim_start();
    more.starts_with(' ') && ["at ", "in "].iter().any(|at| words.starts_with(at)) && !words.contains(" to ")
}

/// Whether what somebody goes for, with what follows it, is out of the house: "out", "swimming at the lake", "away from home".
pub(super) fn is_out_for(words: &str) -> bool {
    WORDS.errands.begin(words).any(|(what, more)| match what {
        // Who goes away from something in the house is in it.
        "away" => ends_out(more) && (!more.starts_with(" from ") || ends_away(more)),
        "out" | "outside" | "abroad" => ends_out(more),
        _ => ends_out_doing(more),
    })
}

/// Whether a place is the way out of the house: "the front door", "the garage".
pub(super) fn is_a_way_out(place: &str) -> bool {
    WORDS.ways_by.after(noun_of(place)).any(ends)
}

/// Whether a place is in the house, and not the house itself.
fn is_inside(place: &str) -> bool {
    !is_outside_place(place) && is_in_the_house(place) && !WORDS.house.after(place).any(ends)
}

/// Whether a place is one of the house by the noun that it ends with: the garden is, and a garden center is none.
fn is_home_by_its_noun(place: &str) -> bool {
    let noun = room_of(noun_of(place));
    let noun = noun.split_once(" of ").map_or(noun, |(noun, _)| noun);
    let last = noun.rsplit(' ').next().unwrap_or_default();
    let is_thing = Names::built_in().knows(noun) || Names::built_in().knows(last);
    !is_outside_place(place) && (is_thing || is_room(noun) || has(&WORDS.near_the_house, last))
}

/// Whether words name a thing in the house that somebody is at: "at the desk".
fn is_at_a_thing(words: &str) -> bool {
    words.strip_prefix("at ").is_some_and(|place| {
        let noun = room_of(noun_of(place));
        noun_of(place) != place && Names::built_in().knows(noun) && !is_room(noun) && !is_outside_place(place)
    })
}

/// Whether words begin with a place that no home has, behind a word such as "at" or "to", and end there or go on with what changes nothing: "to
/// work", "back at her school", "from the doctor".
pub(super) fn is_outside(words: &str) -> bool {
    is_outside_by(words, &["to", "into", "at", "from", "for", "in"])
}

/// The same behind one of `to`.
pub(super) fn is_outside_by(words: &str, to: &[&str]) -> bool {
    let words = ["back ", "off ", "over ", "down "].iter().find_map(|way| words.strip_prefix(way)).unwrap_or(words);
    let mut places = to.iter().filter_map(|to| words.strip_prefix(to)?.strip_prefix(' '));
    places.any(is_outside_place)
}

/// A place without its article: "new cinema" of "the new cinema".
pub(super) fn noun_of(place: &str) -> &str {
    place.split_once(' ').filter(|(first, _)| has(&WORDS.determiners, first)).map_or(place, |(_, noun)| noun)
}

/// Whether words begin with a place that no home has: "the new cinema", "football practice".
pub(super) fn is_outside_place(place: &str) -> bool {
    let mut nouns = std::iter::successors(Some(noun_of(place)), |noun| {
        let (first, rest) = noun.split_once(' ')?;
        let is_modifier = first.chars().all(|c| c.is_alphanumeric() || c == '-' || c == '\'')
            && ![&WORDS.goes_on, &WORDS.no_verbs, &WORDS.rooms, &WORDS.determiners, &WORDS.not_said]
                .iter()
                .any(|words| has(words, first));
        is_modifier.then_some(rest)
    });
    nouns.by_ref().take(1 + MODIFIERS_MAX).any(|noun| WORDS.outside.after(noun).any(ends))
}

/// Whether a place is one of the house or may be; of the places at home, only an office may be driven to.
pub(super) fn is_in_the_house(place: &str) -> bool {
    let noun = noun_of(place);
    let is_thing = Names::built_in().knows(room_of(noun)) || is_room(room_of(place));
    let is_near = || room_of(noun).split(' ').any(|word| has(&WORDS.near_the_house, word));
    WORDS.house.after(place).any(ends) || ((is_thing || is_near()) && first_word(noun) != "office")
}

/// Whether words behind "to" or "for" name a place with an article, or one that no home has, which is not in the house: "the lake", "work".
pub(super) fn is_elsewhere(place: &str) -> bool {
    is_outside_place(place) || (noun_of(place) != place && !is_in_the_house(place))
}

/// Whether a home may have a room that is called so.
pub(super) fn is_room(name: &str) -> bool {
    has(&WORDS.rooms, name.split([' ', '-']).next_back().unwrap_or_default())
        && !has(&WORDS.rooms_elsewhere, name)
        && is_said(name)
}

/// What comes after "in the" or "at the".
pub(super) fn in_the(state: &str) -> Option<&str> {
    state.strip_prefix("in the ").or_else(|| state.strip_prefix("at the "))
}

/// A room's name: what stands before the words that change nothing.
pub(super) fn room_of(words: &str) -> &str {
    let ends_at = words.match_indices([' ', ',']).map(|(at, _)| at).find(|at| ends(&words[*at..]));
    &words[..ends_at.unwrap_or(words.len())]
}

/// Whether words name a place by nothing but its name, which is none of a home: "for Berlin", "in rome".
pub(super) fn is_a_town(words: &str, to: &[&str]) -> bool {
    let mut places = to.iter().filter_map(|to| words.strip_prefix(to));
    places.any(|place| {
        let name = first_word(place);
        let is_word = |words: &List| words.iter().any(|own| own.split(' ').any(|word| word == name));
        let is_name = name.len() > 3 && name.chars().all(char::is_alphabetic) && !has(&WORDS.determiners, name);
        is_name
            && ends(&place[name.len()..])
            && !Names::built_in().knows(name)
            && ![&WORDS.rooms, &WORDS.house, &WORDS.not_said, &WORDS.goes_on, &WORDS.away_for, &WORDS.pronouns]
                .into_iter()
                .any(is_word)
            && !name.ends_with("ing")
    })
}

/// Whether a plain sentence has the house of somebody else as a place: "at his parents' house", "at vera's".
pub(super) fn is_at_somebodys(said: &str) -> bool {
    let is_house = |of: &str, after: &str| {
        (of.ends_with("'s") || of.ends_with("s'"))
            && ["house", "home", "place", "flat", "apartment"].contains(&first_word(after))
    };
    said.match_indices(" at ").any(|(at, _)| {
        let place = &said[at + " at ".len()..];
        let mut spaces = place.match_indices(' ').map(|(at, _)| at).take(NAME_WORDS_MAX);
        let is_whole = (place.ends_with("'s") || place.ends_with("s'")) && place.split(' ').count() <= NAME_WORDS_MAX;
        is_whole || spaces.any(|at| is_house(&place[..at], &place[at + 1..]))
    })
}

/// Whether somebody is in the house by what they are, whatever they do there: "home sick", "at home watching football", "in her room".
pub(super) fn is_indoors(state: &str) -> bool {
    let is_outside =
        |words: &str| words.match_indices(' ').any(|(at, _)| is_outside_by(&words[at + 1..], &["at", "in"]));
    let goes_on = |more: &str| {
        let words = more.strip_prefix(' ').unwrap_or_default();
        let what = first_word(words);
        let is_doing = has(&WORDS.at_home, what) || what.ends_with("ing");
        ends_here(more) || is_own_room(words) || is_doing && !is_outside(words)
    };
    // "Safely home".
    let state = state.split_once(' ').filter(|(how, _)| how.ends_with("ly")).map_or(state, |(_, state)| state);
    is_own_room(state) || WORDS.indoors.after(state).any(goes_on)
}

/// Whether words name a room that is somebody's own, and nothing says that it is out of the house: "in his room", "up to her bedroom".
pub(super) fn is_own_room(words: &str) -> bool {
    let place = words.strip_prefix("up ").or_else(|| words.strip_prefix("back ")).unwrap_or(words);
    let place = ["in ", "to ", "into "].iter().find_map(|to| place.strip_prefix(to)).unwrap_or_default();
    let (whose, room) = place.split_once(' ').unwrap_or_default();
    // An office is rather the one out of the house.
    let is_room = |room: &str| has(&WORDS.rooms, room) && room != "office";
    has(&WORDS.possessives, whose) && is_room(first_word(room)) && ends_here(&room[first_word(room).len()..])
}

/// Whether words are a room of the house behind "in the".
pub(in crate::narration) fn is_of_a_room(words: &str) -> bool {
    words.strip_prefix("in the ").is_some_and(|place| is_room(room_of(place)))
}
