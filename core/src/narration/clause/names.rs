//! Who a subject names: names, pronouns, titles, and lists of them.

use super::signs::{is_reported, without_first};
use super::words::{WORDS, first_word, has, is_possible};
use super::{Clause, Subject};
use crate::narration::{PERSON_NAME_BYTES_MAX, Pronoun, deeds};

/// A plain sentence without what it begins with of no person: "lena goes jogging" of "although it rains, lena goes jogging".
pub(in crate::narration) fn without_opening(said: &str) -> &str {
    let opens = WORDS.openings.after(said).any(|more| more.starts_with(' '));
    let Some((opening, main)) = said.split_once(", ").filter(|_| opens) else { return said };
    // What "we leave after dinner" may only plan.
    let is_of_oneself = matches!(first_word(main), "i" | "we" | "you");
    if is_of_oneself || is_reported(opening) { said } else { main }
}

/// The longest subject of which each part is a person, and what is said of it.
pub(in crate::narration) fn longest_subject<'a>(
    said: &'a str,
    mut is_person: impl FnMut(&str) -> bool,
) -> Option<(Vec<String>, &'a str)> {
    // "The plumber igor" is igor, and "my wife ada" is ada.
    let mut person = |part| {
        let own = |part: &'a str| {
            let (_, name) = part.split_once(' ').filter(|(first, _)| has(&WORDS.determiners, first))?;
            name.split_once(' ').filter(|(kind, _)| has(&WORDS.people, kind)).map(|(_, own)| own)
        };
        own(part).filter(|own| is_person(own)).or_else(|| bare(part).filter(|name| is_person(name)))
    };
    let found = cuts(said).filter_map(|(subject, rest)| {
        let names: Vec<&str> = parts(subject).map(&mut person).collect::<Option<_>>()?;
        (!names.is_empty()).then_some((names, rest))
    });
    found.last().map(|(names, rest)| (names.into_iter().map(str::to_owned).collect(), rest))
}

/// Whether words before a name make it another one: "ada's mother", "mrs. novak".
pub(in crate::narration) fn is_part_of_a_name(before: &str) -> bool {
    let last = before.rsplit(' ').next().unwrap_or_default();
    last.ends_with("'s") || last.ends_with("s'") || is_any_title(last)
}

/// Whether a name of several words has one that is a thing's or a room's: "front door", "baby monitor".
pub(in crate::narration) fn is_named_thing(name: &str) -> bool {
    let (title, own) = titled(name);
    let is_device = |word: &str| has(&WORDS.nothing, word) || has(&WORDS.rooms, word) || has(&WORDS.devices, word);
    let is_thing = |word: &str| is_device(word) || title.is_none() && !is_possible(word);
    !has(&WORDS.people, name) && name.contains(' ') && own.split(' ').any(is_thing)
}

/// A subject of several persons, of whom one is known at least, and the others are written as names: "ada and igor sit on the sofa".
pub(in crate::narration) fn with_strangers<'a>(
    said: &'a str,
    is_known: &mut dyn FnMut(&str) -> bool,
    is_name: &dyn Fn(&str) -> bool,
) -> Option<(Vec<String>, &'a str)> {
    if !said.contains(" and ") {
        return None;
    }
    let found = cuts(said).filter_map(|(subject, rest)| {
        let all: Vec<&str> = names(subject)?;
        let verb = rest.split([' ', ',']).next().unwrap_or_default();
        let mut is_of_one = false;
        let mut is_person = |name: &&str| {
            let is_here = is_known(name) || has(&WORDS.people, name);
            is_of_one |= is_here;
            is_here || (!name.contains(' ') && may_be_a_person(name) && is_name(name))
        };
        let are_persons = all.len() > 1 && all.iter().all(&mut is_person);
        (are_persons && is_of_one && verb != "and" && !has(&WORDS.no_verbs, verb)).then_some((all, rest))
    });
    found.last().map(|(names, rest)| (names.into_iter().map(str::to_owned).collect(), rest))
}

/// What somebody of a longer name may be called for short: "ada" of "ada lovelace".
pub(in crate::narration) fn first_name(name: &str) -> Option<&str> {
    let (first, others) = name.trim().split_once(' ')?;
    let (word, last) = (first.to_lowercase(), others.rsplit(' ').next().unwrap_or_default().to_lowercase());
    let no_names = [&WORDS.nothing, &WORDS.anybody, &WORDS.people, &WORDS.groups, &WORDS.begin];
    let is_name = !is_any_title(&word) && !no_names.iter().any(|words| has(words, &word));
    (is_name && !has(&WORDS.people, &last) && !has(&WORDS.anybody, &last)).then_some(first)
}

/// Whether a word is a title, or what a relative is called before the name: "mrs.", "aunt".
fn is_any_title(word: &str) -> bool {
    let word = word.trim_end_matches('.').to_lowercase();
    has(&WORDS.addresses, &word) || has(&WORDS.titles, &word)
}

/// A name's title, if it has one, and the rest: "mrs." and "novak" of "mrs. novak", "grandma" and "edith" of "grandma edith".
pub(in crate::narration) fn titled(name: &str) -> (Option<&str>, &str) {
    let parts = name.trim().split_once(' ').filter(|(first, _)| is_any_title(first));
    parts.map_or((None, name.trim()), |(title, name)| (Some(title), name.trim_start()))
}

/// Whether a name may be a person's: it is no thing, and no other word.
pub(in crate::narration) fn may_be_a_person(name: &str) -> bool {
    bare(name).is_some_and(is_possible) && !has(&WORDS.nothing, name) && !has(&WORDS.groups, name)
}

/// A subject has at most so many words, all its persons together.
pub(super) const SUBJECT_WORDS_MAX: usize = 24;

/// The name of somebody who is known has at most so many words.
pub(in crate::narration) const NAME_WORDS_MAX: usize = 4;

/// So many words stand between an article and the place that it is of.
pub(super) const MODIFIERS_MAX: usize = 2;

/// The least number of persons in `numbers` of the table, and the greatest.
pub(super) const COUNT_MIN: usize = 2;

pub(in crate::narration) const COUNT_MAX: usize = 8;

/// The name of somebody of whom nobody has told yet has at most so many words.
pub(super) const NEW_NAME_WORDS_MAX: usize = 2;

/// The persons that a plain sentence may be about, from one word to the longest subject: of "ada and ben sit down" it gives "ada", then
/// "ada" and "ben". Most of it is not meant: only who knows the persons can tell.
pub(in crate::narration) fn possible_subjects(said: &str) -> impl Iterator<Item = Vec<&str>> {
    cuts(said)
        .filter_map(|(subject, _)| parts(subject).map(|part| bare(part).filter(|name| is_possible(name))).collect())
}

/// By which pronoun a plain sentence is of one person: "she opens the fridge".
pub(in crate::narration) fn pronoun(said: &str) -> Option<Pronoun> {
    pronoun_of(first_word(without_first(said)))
}

fn pronoun_of(word: &str) -> Option<Pronoun> {
    match word {
        "he" | "his" | "himself" => Some(Pronoun::He),
        "she" | "her" | "herself" => Some(Pronoun::She),
        _ => None,
    }
}

/// What a plain sentence calls its own person by, as far as it tells: "ada brushes her teeth".
/// "ben kisses her" and "ada kisses his cheek" tell it of somebody else.
pub(in crate::narration) fn own_pronoun(said: &str) -> Option<Pronoun> {
    const GIVES: [&str; 8] = ["gives", "gave", "brings", "brought", "hands", "passes", "shows", "buys"];
    const EATS: [&str; 7] = ["eats", "ate", "drinks", "drank", "has", "finishes", "sips"];
    // "Washes her hands" hands nothing to anybody.
    let is_verb = |subject: &str| !has(&WORDS.possessives, subject.rsplit(' ').next().unwrap_or_default());
    let mut deeds = cuts(said).take(NAME_WORDS_MAX).filter(|(subject, _)| is_verb(subject));
    if deeds.any(|(_, rest)| deeds::touched(rest).is_some()) {
        return None;
    }
    let words = || said.split([' ', ',']).chain(["", ""]);
    let (befores, nouns, lasts) = ([""].into_iter().chain(words()), words().skip(1), words().skip(2));
    words().zip(befores).zip(nouns.zip(lasts)).find_map(|((word, before), (noun, last))| {
        let is_own = |noun: &str| has(&WORDS.own, noun) || has(&WORDS.meals, noun) && EATS.contains(&before);
        let is_told = word.ends_with("self") || (is_own(noun) || is_own(last)) && !GIVES.contains(&before);
        pronoun_of(word).filter(|_| is_told)
    })
}

/// Whether a word in lower case may be read as a name by itself; "august" and "can" are other words.
pub(in crate::narration) fn is_read_as_a_name(word: &str) -> bool {
    names(word).is_some()
}

/// Whether a plain sentence begins with a pronoun.
pub(in crate::narration) fn is_of_a_pronoun(said: &str) -> bool {
    cuts(said).next().is_some_and(|(subject, _)| has(&WORDS.pronouns, subject))
}

/// Whether a plain text begins with a pronoun and what its person does.
pub(in crate::narration) fn begins_with_a_pronoun(said: &str) -> bool {
    cuts(said).next().is_some_and(|(subject, rest)| {
        let verb = first_word(rest);
        has(&WORDS.pronouns, subject) && !verb.is_empty() && !has(&WORDS.no_verbs, verb)
    })
}

/// Whether a plain text says where persons are of whom `is_known` says so.
pub(in crate::narration) fn is_of_persons(said: &str, mut is_known: impl FnMut(&str) -> bool) -> bool {
    let names = Clause::read(said).map(|clause| clause.subject);
    matches!(names, Some(Subject::Named(names) | Subject::Only(names)) if names.iter().all(|name| is_known(name)))
}

/// Whether a word in lower case is written with a full stop before a name.
pub(in crate::narration) fn is_title(word: &str) -> bool {
    has(&WORDS.titles, word)
}

/// Every way to cut a sentence into a subject and what is said of it, the shortest subject first.
pub(super) fn cuts(said: &str) -> impl Iterator<Item = (&str, &str)> {
    let said = without_first(said);
    let spaces = said.match_indices(' ').take(SUBJECT_WORDS_MAX);
    let cuts = spaces.map(move |(at, _)| {
        let mut subject = said[..at].trim_end_matches([' ', ',']);
        // "Ada and Ben both leave."
        let is_no_part = |(before, last): &(&str, &str)| {
            has(&WORDS.between, last) || has(&WORDS.of_each, last) && before.contains(" and ")
        };
        while let Some((before, _)) = subject.rsplit_once(' ').filter(is_no_part) {
            subject = before;
        }
        (subject, said[at..].trim_start())
    });
    // What "showers and leaves" is a second deed of nobody new.
    cuts.filter(|(subject, _)| !subject.ends_with(" and"))
}

/// A sentence, and who does the same by what stands at its end: "ben" of "ada leaves the house, and so does ben" and of "ada leaves the house and
/// ben too".
pub(super) fn without_too(said: &str) -> (&str, Option<&str>) {
    const SO: [&str; 5] = ["so does ", "so do ", "so is ", "so are ", "so did "];
    const TOO: [&str; 5] = [" too", " does too", " do too", " is too", " as well"];
    // Most have neither.
    let ends_too = || TOO.iter().any(|too| said.trim_end_matches(',').ends_with(too));
    if !said.contains(" so ") && !ends_too() {
        return (said, None);
    }
    let joined = [", and ", " and ", ", "].iter().find_map(|join| said.rsplit_once(join));
    // "And so do ben and igor".
    let so =
        [", and ", " and ", ", "].iter().flat_map(|join| SO.iter().map(move |so| (join, so))).find_map(|(join, so)| {
            let (at, rest) = said
                .match_indices(so)
                .find_map(|(at, _)| Some((said[..at].strip_suffix(join)?, &said[at + so.len()..])))?;
            Some((at, rest))
        });
    let too = || {
        let (before, last) = joined?;
        let last = last.trim_end_matches(',');
        TOO.iter().rev().find_map(|too| Some((before, last.strip_suffix(too)?.trim_end_matches(','))))
    };
    let found = so.or_else(too).filter(|(_, who)| names(who).is_some());
    found.map_or((said, None), |(said, who)| (said.trim_end_matches([' ', ',']), Some(who)))
}

/// The parts of a subject that are joined by "and".
pub(super) fn parts(subject: &str) -> impl Iterator<Item = &str> {
    // "Both Ada and Ben."
    let subject = subject.strip_prefix("both ").filter(|names| names.contains(" and ")).unwrap_or(subject);
    // Commas alone join nobody: "Ada, Ben is away" speaks to Ada.
    let commas = if subject.contains(" and ") { ", " } else { " and " };
    let parts = subject.split(" and ").flat_map(move |part| part.split(commas));
    parts.map(|part| part.trim_matches([' ', ','])).filter(|part| !part.is_empty())
}

/// What the persons of a subject are called: "ada" and "plumber" of "ada and the plumber". None where one of them is a thing, or where it is
/// not told whom it is of.
pub(super) fn names(subject: &str) -> Option<Vec<&str>> {
    // "Ada and the dog" is Ada.
    let persons = parts(subject).filter(|part| !has(&WORDS.animals, part));
    persons.map(person_of).collect::<Option<Vec<_>>>().filter(|names| !names.is_empty())
}

/// What a person is called in a part of a subject; none of a thing.
fn person_of(part: &str) -> Option<&str> {
    let name = bare(part)?;
    let has_determiner = part.split(' ').next().is_some_and(|first| has(&WORDS.determiners, first));
    let first = name.split(' ').next().unwrap_or_default();
    // What somebody has is nobody, unless it is a person: "ada's mother".
    let is_had = first.ends_with("'s") && !has(&WORDS.people, name.rsplit(' ').next().unwrap_or_default());
    let is_group = || has(&WORDS.groups, name.rsplit(' ').next().unwrap_or_default());
    // "Ada believes Ben" is nobody: what is said of him is what she believes.
    let is_supposed = || name.split(' ').skip(1).any(|word| has(&WORDS.supposes, word));
    let is_nothing = has(&WORDS.nothing, first) || is_had || is_group() || is_supposed();
    // "2 people" is a count, and no name fits into a message that is longer.
    let is_nothing =
        is_nothing || first.starts_with(|c: char| c.is_ascii_digit()) || name.len() > PERSON_NAME_BYTES_MAX;
    // "Her friend igor" is igor.
    let named = || {
        let is_had = part.split(' ').next().is_some_and(|first| has(&WORDS.possessives, first));
        let (kind, name) = name.split_once(' ').filter(|_| is_had)?;
        let is_name = has(&WORDS.people, kind) && may_be_new(name) && !has(&WORDS.nothing, name);
        (is_name && !has(&WORDS.rooms, name.rsplit(' ').next().unwrap_or_default())).then_some(name)
    };
    let is_possible = is_possible(name) && !is_nothing;
    let is_person = is_possible && (!has_determiner || has(&WORDS.people, name));
    if is_person { Some(name) } else { named().filter(|name| is_possible && self::is_possible(name)) }
}

/// A name without what stands before and after it: "plumber" of "the plumber", "ada" of "ada reluctantly".
pub(super) fn bare(part: &str) -> Option<&str> {
    let bare = part.split_once(' ').filter(|(first, _)| has(&WORDS.determiners, first)).map_or(part, |(_, name)| name);
    let bare = match bare.rsplit_once(' ') {
        Some((name, last)) if last.ends_with("ly") && !name.split(' ').any(|word| has(&WORDS.titles, word)) => name,
        _ => bare,
    };
    let first = bare.split(' ').next()?;
    let is_other = has(&WORDS.nobody, bare) || has(&WORDS.everybody, first);
    // "Will" by itself is a name: "will leaves the house".
    let is_name = |word: &str| matches!(word, "will" | "may") && bare == word;
    let is_word = |word: &str| {
        is_name(word)
            || !(word.is_empty()
                || has(&WORDS.determiners, word)
                || has(&WORDS.not_said, word)
                || has(&WORDS.pronouns, word)
                || has(&WORDS.nobody, word)
                || has(&WORDS.everybody, word))
    };
    let fits = bare.split(' ').count() <= NAME_WORDS_MAX && bare.split(' ').all(is_word);
    (fits && !is_other && !bare.contains(',')).then_some(bare)
}

/// Whether somebody of whom nobody has told yet may go by a name.
pub(in crate::narration) fn may_be_new(name: &str) -> bool {
    titled(name).1.split(' ').count() <= NEW_NAME_WORDS_MAX
}
