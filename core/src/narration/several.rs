//! The clauses of a text that says things of several persons: "Mia goes to her room and Tom cooks." is two, of Mia and of Tom.

use super::clause;

/// A text has at most so many clauses of their own; what follows belongs to the last.
pub(super) const CLAUSES_MAX: usize = 8;

/// What stands between two clauses of one sentence.
const JOINS: [&str; 7] = [", and ", " and ", ", while ", " while ", ", but ", " but ", ", "];
/// What stands between two sentences of one text.
const ENDS: [&str; 4] = [". ", "! ", "? ", "; "];
/// A full stop behind so few letters is that of a short form: "Dr. Grey".
const SHORT_FORM: usize = 3;

/// Whether a text may have more than one clause.
pub(super) fn may_be_several(text: &str) -> bool {
    next_join(text, 0).is_some()
}

/// The clauses of a text, in its own words and order. Another one begins where somebody is named who `is_person`, with what they do.
/// A sentence about a pronoun belongs to the clause before it.
pub(super) fn clauses(text: &str, mut is_person: impl FnMut(&str) -> bool) -> ([&str; CLAUSES_MAX], usize) {
    let (mut found, mut count) = ([""; CLAUSES_MAX], 0);
    let (mut from, mut at) = (0, 0);
    while let Some((end, next)) = next_join(text, at) {
        at = next;
        if count + 1 == CLAUSES_MAX {
            break;
        }
        let (head, tail) = (&text[from..end], &text[next..]);
        // "Gets up, showers, leaves the house": a name that ends like a verb has a capital.
        let word = tail.split([' ', ',']).next().unwrap_or_default();
        let is_deed = word.starts_with(char::is_lowercase) && clause::is_verb(word);
        let begins = clause::with_plain(begin_of(tail), |tail| {
            clause::begins_with_persons(tail, &mut is_person) || (!is_deed && clause::is_of_a_stranger(tail))
        });
        // A comma alone joins what two persons do, and parts of much else.
        let begins = begins
            && (&text[end..next] != ", "
                || clause::with_plain(head, |head| clause::begins_with_persons(head, &mut is_person)));
        let ends = || match is_end(&text[end..next]) {
            true => !ends_with_short_form(head) && !clause::is_quoted(head),
            // What somebody says or sees of two others is one clause.
            false => !clause::with_plain(head, clause::is_reported),
        };
        if begins && ends() && clause::with_plain(head, |head| !clause::is_begin_of_a_list(head, &mut is_person)) {
            (found[count], count, from) = (head, count + 1, next);
        }
    }
    found[count] = &text[from..];
    (found, count + 1)
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
            let longest = JOINS.iter().chain(&ENDS).filter(is_here).map(|join| join.len()).max()?;
            Some((begin, begin + longest))
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
            found[..count].join("|")
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
        assert_eq!((count, found.iter().map(|part| part.len()).sum::<usize>() + 7 * 5), (CLAUSES_MAX, many.len()));
    }

    #[test]
    fn a_clause_may_have_sentences() {
        let all = |text: &'static str| sentences(text).collect::<Vec<_>>();
        assert_eq!(all("Ada cooks. She eats."), ["Ada cooks", "She eats."]);
        assert_eq!(all("Dr. Grey cooks; she eats and sleeps"), ["Dr. Grey cooks", "she eats and sleeps"]);
        assert_eq!(all("Ada cooks."), ["Ada cooks."]);
    }
}
