//! The clauses of a text that says things of several persons: "Mia goes to her room and Tom cooks." is two, of Mia and of Tom.

use std::borrow::Cow;

use super::{clause, reading};

/// A text has at most so many clauses of their own; what follows belongs to the last.
pub(super) const CLAUSES_MAX: usize = 8;

/// What stands between two clauses of one sentence, beside [`WHEN`].
const JOINS: [&str; 5] = [", and ", " and ", ", but ", " but ", ", "];
/// Begin a clause that says when another one is so, and whether it is so itself; they stand before it or behind it.
const WHEN: [(&str, Holds); 13] = [
    ("while ", Holds::So),
    ("as ", Holds::So),
    ("after ", Holds::So),
    ("because ", Holds::So),
    ("since ", Holds::So),
    ("although ", Holds::So),
    ("though ", Holds::So),
    ("whenever ", Holds::AtHome),
    ("as soon as ", Holds::AtHome),
    ("when ", Holds::AtHome),
    ("once ", Holds::AtHome),
    ("before ", Holds::NotYet),
    ("until ", Holds::NotYet),
];
/// What stands between two sentences of one text.
const ENDS: [&str; 4] = [". ", "! ", "? ", "; "];
/// A full stop behind so few letters is that of a short form: "Dr. Grey".
const SHORT_FORM: usize = 3;

/// Whether what a clause says is so.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Holds {
    /// It is told.
    #[default]
    So,
    /// It may be a rule rather than what happens, and sends nobody away: "When Ada leaves, Ben sings."
    AtHome,
    /// It has not happened: "before Ada leaves".
    NotYet,
}

/// A clause of a text.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Part<'a> {
    pub(super) text: &'a str,
    pub(super) holds: Holds,
    /// The clause that says whom its pronoun means: "Ada leaves" of "Before Ada leaves, she sings."
    pub(super) whose: Option<&'a str>,
}

impl Part<'_> {
    /// Its text, with the names of those whom its pronoun means.
    pub(super) fn named(&self, is_known: &mut dyn FnMut(&str) -> bool) -> Cow<'_, str> {
        let names = self.whose.map(|whose| {
            reading::with_plain(whose, |whose| {
                let is_person = |name: &str| is_known(name) || clause::is(clause::Word::People, name);
                clause::longest_subject(whose, is_person).map_or_else(Vec::new, |(names, _)| names)
            })
        });
        match (names.filter(|names| !names.is_empty()), self.text.split_once(' ')) {
            (Some(names), Some((_, rest))) => Cow::Owned(format!("{} {rest}", names.join(" and "))),
            _ => Cow::Borrowed(self.text),
        }
    }
}

/// The clauses that were found.
#[derive(Debug, Default)]
struct Found<'a> {
    parts: [Part<'a>; CLAUSES_MAX],
    count: usize,
}

impl<'a> Found<'a> {
    fn push(&mut self, part: Part<'a>) {
        if let Some(place) = self.parts.get_mut(self.count) {
            *place = part;
            self.count += 1;
        }
    }

    /// The first clause of sentences; one that stands before it and says when it is so is found by that.
    fn begin(&mut self, text: &'a str, is_person: &mut dyn FnMut(&str) -> bool) -> Part<'a> {
        match subordinate(text, is_person).filter(|_| self.count + 2 <= CLAUSES_MAX) {
            Some((clause, main)) => {
                self.push(clause);
                main
            }
            None => Part { text, ..Part::default() },
        }
    }
}

/// Whether a text may have more than one clause.
pub(super) fn may_be_several(text: &str) -> bool {
    next_join(text, 0).is_some()
}

/// The clauses of a text, in its own words and order. Another one begins where somebody is named who `is_person`, with what they do.
/// A sentence about a pronoun belongs to the clause before it.
pub(super) fn clauses(text: &str, mut is_person: impl FnMut(&str) -> bool) -> ([Part<'_>; CLAUSES_MAX], usize) {
    let mut found = Found::default();
    let mut own = found.begin(text, &mut is_person);
    let mut at = 0;
    while let Some((end, next)) = next_join(own.text, at) {
        at = next;
        if found.count + 1 == CLAUSES_MAX {
            break;
        }
        let (head, join, tail) = (&own.text[..end], &own.text[end..next], &own.text[next..]);
        if !is_cut(own.holds, head, join, tail, &mut is_person) {
            continue;
        }
        let when = when(join);
        // "Ada leaves when Ben comes" may be a rule, too.
        let holds = if when == Some(Holds::AtHome) { Holds::AtHome } else { own.holds };
        found.push(Part { text: head, holds, ..own });
        own = match is_end(join) {
            true => found.begin(tail, &mut is_person),
            false => Part { text: tail, holds: when.filter(|when| *when != Holds::So).unwrap_or(holds), whose: None },
        };
        at = 0;
    }
    found.push(own);
    (found.parts, found.count)
}

/// Whether another clause begins behind words that may stand between two.
fn is_cut(holds: Holds, head: &str, join: &str, tail: &str, is_person: &mut dyn FnMut(&str) -> bool) -> bool {
    let is_end = is_end(join);
    // What goes on with what has not happened may not have happened either.
    if holds == Holds::NotYet {
        return is_end && !ends_with_short_form(head);
    }
    let when = when(join);
    // Whose pronoun it is does not matter there.
    let begins = begins(tail, is_person)
        || when == Some(Holds::NotYet) && plain(tail, clause::begins_with_a_pronoun)
        || is_end && subordinate(tail, is_person).is_some();
    // A comma alone joins what two persons do, and parts of much else.
    let begins = begins
        && (join != ", " || reading::with_plain(head, |head| clause::begins_with_persons(head, &mut *is_person)))
        && !(when.is_some() && reading::with_plain(head, |head| clause::goes_on_with(head, join.trim())));
    let ends = || match is_end {
        true => !ends_with_short_form(head) && !clause::is_quoted(head),
        // What somebody says or sees of two others is one clause.
        false => !reading::with_plain(head, clause::is_reported),
    };
    begins && ends() && reading::with_plain(head, |head| !clause::is_begin_of_a_list(head, &mut *is_person))
}

/// Whether a text begins with persons and what they do.
fn begins(text: &str, is_person: &mut dyn FnMut(&str) -> bool) -> bool {
    // "Gets up, showers, leaves the house": a name that ends like a verb has a capital.
    let word = text.split([' ', ',']).next().unwrap_or_default();
    let is_deed = word.starts_with(char::is_lowercase) && clause::is_verb(word);
    plain(text, |text| clause::begins_with_persons(text, is_person) || (!is_deed && clause::is_of_a_stranger(text)))
}

/// Reads the first sentence of a text in plain form.
fn plain<T>(text: &str, read: impl FnOnce(&str) -> T) -> T {
    reading::with_plain(begin_of(sentences(text).next().unwrap_or_default()), read)
}

/// What stands between clauses and says when one of them is so makes of the one behind it.
fn when(join: &str) -> Option<Holds> {
    let word = join.strip_prefix(',').unwrap_or(join).strip_prefix(' ')?;
    WHEN.iter().find(|(when, _)| when.eq_ignore_ascii_case(word)).map(|(_, holds)| *holds)
}

/// A clause that says when the main clause behind it is so, and that with all that follows: "while ada cooks" and "ben sings" of "While Ada cooks, Ben
/// sings." None where either is of no person.
fn subordinate<'a>(text: &'a str, is_person: &mut dyn FnMut(&str) -> bool) -> Option<(Part<'a>, Part<'a>)> {
    let is_begin = |word: &str| text.get(..word.len()).is_some_and(|begin| begin.eq_ignore_ascii_case(word));
    let (word, holds) = WHEN.iter().filter(|(word, _)| is_begin(word)).max_by_key(|(word, _)| word.len())?;
    let rest = &text[word.len()..];
    let mut at = 0;
    while let Some((end, next)) = next_join(rest, at) {
        at = next;
        let (clause, main) = (&rest[..end], &rest[next..]);
        if is_end(&rest[end..next]) && !ends_with_short_form(clause) {
            return None;
        }
        let is_of_a_pronoun = plain(main, clause::begins_with_a_pronoun);
        // "Although Ada is out, the light is on" tells of Ada alone.
        let tells_of_persons =
            *holds == Holds::So && reading::with_plain(clause, |clause| clause::is_of_persons(clause, &mut *is_person));
        if &rest[end..next] != ", " || !(is_of_a_pronoun || tells_of_persons || begins(main, is_person)) {
            continue;
        }
        // Of a pronoun it does not tell whose it is.
        let is_named = reading::with_plain(clause, |clause| clause::begins_with_persons(clause, &mut *is_person));
        let is_pronouns = !is_named && reading::with_plain(clause, clause::begins_with_a_pronoun);
        if reading::with_plain(clause, clause::is_reported) || !(is_named || (is_pronouns && !is_of_a_pronoun)) {
            continue;
        }
        // "After Ada leaves, Ben will sing": what is not so does not tell whether the other is.
        let is_so = is_named && !plain(main, clause::is_not_so);
        let whose = is_of_a_pronoun.then_some(clause);
        let main = match holds {
            Holds::AtHome => Part { text: main, holds: Holds::AtHome, whose },
            Holds::So | Holds::NotYet => Part { text: main, holds: Holds::So, whose },
        };
        let holds = if is_so { *holds } else { Holds::NotYet };
        return Some((Part { text: clause, holds, whose: None }, main));
    }
    None
}

/// The sentences of a clause.
pub(super) fn sentences(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = Some(text);
    std::iter::from_fn(move || {
        let text = rest?;
        let mut at = 0;
        while let Some((end, next)) = next_join(text, at) {
            if is_end(&text[end..next]) && !ends_with_short_form(&text[..end]) {
                rest = Some(&text[next..]);
                return Some(&text[..end]);
            }
            at = next;
        }
        rest = None;
        Some(text)
    })
}

/// All that stands between the words that may stand between clauses.
pub(super) fn parts(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = Some(text);
    std::iter::from_fn(move || {
        let text = rest?;
        let (end, next) = next_join(text, 0).unwrap_or((text.len(), text.len()));
        rest = Some(&text[next..]).filter(|rest| !rest.is_empty());
        Some(&text[..end])
    })
}

fn is_end(join: &str) -> bool {
    ENDS.contains(&join)
}

fn ends_with_short_form(head: &str) -> bool {
    let word = head.rsplit(' ').next().unwrap_or_default();
    word.chars().count() <= SHORT_FORM
        && word.chars().all(char::is_alphabetic)
        && clause::is_title(&word.to_lowercase())
}

/// Where the next words that may stand between clauses begin and end, from `at` on; of those that begin at one place the longest.
fn next_join(text: &str, at: usize) -> Option<(usize, usize)> {
    let bytes = text.as_bytes();
    (at..bytes.len()).filter(|begin| matches!(bytes[*begin], b' ' | b',' | b'.' | b'!' | b'?' | b';')).find_map(
        |begin| {
            let is_here = |join: &&&str| {
                bytes[begin..].get(..join.len()).is_some_and(|part| part.eq_ignore_ascii_case(join.as_bytes()))
            };
            let longest = JOINS.iter().chain(&ENDS).filter(is_here).map(|join| join.len()).max();
            // ", while" and " while".
            let from = begin + if bytes[begin..].starts_with(b", ") { ", ".len() } else { " ".len() };
            let is_when = |word: &&str| {
                text.as_bytes()
                    .get(from..from + word.len())
                    .is_some_and(|part| part.eq_ignore_ascii_case(word.as_bytes()))
            };
            let may_be_when = matches!(bytes[begin], b' ' | b',');
            let when = WHEN.iter().map(|(word, _)| *word).filter(is_when).map(|word| from + word.len() - begin).max();
            Some((begin, begin + longest.max(when.filter(|_| may_be_when))?))
        },
    )
}

/// As much of the begin of a text as tells whether another clause begins there.
fn begin_of(text: &str) -> &str {
    const BYTES: usize = 256;
    let mut end = text.len().min(BYTES);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_subject_begins_another_clause() {
        let split = |text: &str| {
            let (found, count) = clauses(text, |name| ["ada", "ben", "tom", "aunt mary"].contains(&name));
            found[..count].iter().map(|part| part.text).collect::<Vec<_>>().join("|")
        };
        for (text, expected) in [
            ("Ada goes to her room and Tom goes to the kitchen.", "Ada goes to her room|Tom goes to the kitchen."),
            ("Ada cooks, and Ben sets the table.", "Ada cooks|Ben sets the table."),
            ("Ada leaves the house. Ben opens the fridge.", "Ada leaves the house|Ben opens the fridge."),
            ("The plumber repairs the shower while Ada reads.", "The plumber repairs the shower|Ada reads."),
            ("Ada cooks and Ben and Tom sit on the sofa.", "Ada cooks|Ben and Tom sit on the sofa."),
            ("Ada and Ben sit down and Tom quickly leaves.", "Ada and Ben sit down|Tom quickly leaves."),
            ("Ada cooks. She eats and Aunt Mary sleeps.", "Ada cooks. She eats|Aunt Mary sleeps."),
            ("Ada is away and nobody is in the kitchen.", "Ada is away|nobody is in the kitchen."),
            ("Ada cooks and Cleo leaves the house.", "Ada cooks|Cleo leaves the house."),
            ("Ada cooks and the children leave the house.", "Ada cooks|the children leave the house."),
            ("Ada opens the door that squeaks and Ben leaves.", "Ada opens the door that squeaks|Ben leaves."),
            ("Ada sits on the sofa, Ben opens the fridge.", "Ada sits on the sofa|Ben opens the fridge."),
            ("ADA LEAVES THE HOUSE AND BEN OPENS THE FRIDGE.", "ADA LEAVES THE HOUSE|BEN OPENS THE FRIDGE."),
            ("Ada cooks. But Ben leaves the house.", "Ada cooks|But Ben leaves the house."),
        ] {
            assert_eq!(split(text), expected);
        }
        for text in [
            "Ada gets up, showers and leaves for work.",
            "Ben eats, dresses and goes to work.",
            "Ada gets up, showers, leaves the house and drives off.",
            "ADA GETS UP, SHOWERS AND LEAVES FOR WORK.",
            "Ada and Ben sit on the sofa.",
            "Ada, Ben and Tom sit on the sofa.",
            "Ada, Ben and Tom leave the house.",
            "Ada, Ben, Tom and Aunt Mary left the house.",
            "Xaver, Ada and Ben leave the house.",
            "Ada hugs Ben and Tom.",
            "Ada plays with Ben and Tom in the kitchen.",
            "Ada watches Ben and Tom play.",
            "Ada says that Ben cooks and Tom sleeps.",
            "If Ada cooks and Ben leaves the house, lock the door.",
            "Ada asks whether Tom cooks and Ben leaves the house.",
            "The radio says: \"Ada cooks. Ben leaves the house.\"",
            "In the bathroom, Ada brushes her teeth.",
            "They open the fridge and grab the milk.",
            "Ada opens the fridge. She grabs the milk.",
            "Ada fills the mug and Tom's bowl.",
            "Ada greets Dr. Tom.",
            "The dishwasher is on and the oven is off.",
        ] {
            assert_eq!(split(text), text);
        }
        let many = "Ada cooks and ".repeat(40);
        let (found, count) = clauses(&many, |name| name == "ada");
        assert_eq!((count, found.iter().map(|part| part.text.len()).sum::<usize>() + 7 * 5), (CLAUSES_MAX, many.len()));
    }

    #[test]
    fn a_clause_may_have_sentences() {
        let all = |text: &'static str| sentences(text).collect::<Vec<_>>();
        assert_eq!(all("Ada cooks. She eats."), ["Ada cooks", "She eats."]);
        assert_eq!(all("Dr. Grey cooks; she eats and sleeps"), ["Dr. Grey cooks", "she eats and sleeps"]);
        assert_eq!(all("Ada cooks."), ["Ada cooks."]);
    }
}
