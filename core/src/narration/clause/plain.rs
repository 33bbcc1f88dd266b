//! A sentence in plain words: lower case, without marks, as people and trackers write it.

use super::names::NAME_WORDS_MAX;
use super::places::ends;
use super::whereabouts::is_state_ahead;
use super::words::WORDS;

/// A sentence in plain form: in lower case, with short forms written out.
pub(in crate::narration) fn plain(sentence: &str) -> String {
    let mut text = String::with_capacity(sentence.len() + sentence.len() / 4);
    write_plain(sentence, &mut text);
    text
}

/// Writes a sentence in plain form.
fn write_plain(sentence: &str, text: &mut String) {
    text.clear();
    for part in unquoted(without_marks(sentence)) {
        text.extend(part.chars().flat_map(char::to_lowercase).map(|c| if c == '’' { '\'' } else { c }));
    }
    text.truncate(text.trim_end_matches(['.', '!']).len());
    // Behind speech: ", says ada".
    text.drain(..text.len() - text.trim_start_matches([' ', ',']).len());
    if text.contains(['\'', ':']) {
        write_out(text);
    }
    while let Some(at) = text.find(" & ") {
        text.replace_range(at..at + " & ".len(), " and ");
    }
    for (told, nobody) in [("there is nobody ", "nobody is "), ("there is no one ", "no one is ")] {
        if text.starts_with(told) {
            text.replace_range(..told.len(), nobody);
        }
    }
    for nobody in ["nobody in the ", "no one in the "] {
        if text.starts_with(nobody) {
            text.insert_str(nobody.len() - "in the ".len(), "is ");
        }
    }
    write_as_usual(text);
}

/// Writes what is said in several ways in one: "they are both in", "has just left", "is no longer in", "ada/ben".
fn write_as_usual(text: &mut String) {
    // "They have both gone out", "they are all in bed".
    for (verb, group) in [("are ", "both "), ("have ", "both "), ("are ", "all "), ("have ", "all ")] {
        let said = text.strip_prefix("they ").and_then(|rest| rest.strip_prefix(verb)?.strip_prefix(group));
        if let Some(rest) = said {
            *text = format!("{group}{verb}{rest}");
        }
    }
    write_neither(text);
    write_call(text);
    write_tracked(text);
    while let Some(at) = text.find(" no longer ") {
        text.replace_range(at..at + " no longer ".len(), " not ");
    }
    let between = |text: &str| {
        ["has ", "have ", "is ", "are "].iter().flat_map(|verb| text.match_indices(*verb)).find_map(|(at, verb)| {
            let begin = at + verb.len();
            let is_word = text[..at].ends_with(' ');
            let rest = &text[begin..];
            // "Ada and Ben are both home."
            let of_several = || WORDS.of_each.after(rest).find(|_| text[..at].contains(" and "));
            let end = WORDS.between.after(rest).chain(of_several()).find(|after| after.starts_with(' '))?;
            is_word.then(|| (begin, text.len() - end.len() + 1))
        })
    };
    while let Some((begin, end)) = between(text) {
        text.replace_range(begin..end, "");
    }
    let first = text.split(' ').next().unwrap_or_default();
    let are_names = |(one, other): (&str, &str)| {
        let is_name = |name: &str| !name.is_empty() && name.chars().all(char::is_alphabetic);
        is_name(one) && is_name(other)
    };
    if let Some(at) = first.find('/').filter(|_| first.split_once('/').is_some_and(are_names)) {
        text.replace_range(at..=at, " and ");
    }
}

/// Leaves out whom somebody speaks to who has come home: "honey, i am home" is "i am home".
fn write_call(text: &mut String) {
    let own = WORDS.calls.after(text).find_map(|more| {
        let own = more.strip_prefix(", ").or_else(|| more.strip_prefix("! "))?;
        own.starts_with("i am ").then_some(text.len() - own.len())
    });
    if let Some(at) = own {
        text.drain(..at);
    }
}

/// Writes where somebody's phone is, as far as it tells whether they are in the house, as where they are: "paul's phone left the home zone" is
/// "paul left the home zone".
fn write_tracked(text: &mut String) {
    let Some(at) = text.find("'s ") else { return };
    let rest = &text[at + "'s ".len()..];
    let tracked = WORDS.trackers.after(rest).filter_map(|more| more.strip_prefix(' ')).find(|said| {
        WORDS
            .tracked
            .after(said)
            .any(|place| place.strip_prefix(' ').is_some_and(|place| WORDS.zones.after(place).any(ends)))
            || WORDS.tracked_states.after(said).any(ends)
    });
    if let Some(said) = tracked {
        let end = text.len() - said.len() - 1;
        text.replace_range(at..end, "");
    }
}

/// Writes what is denied of each of two as denied of both: "neither ada nor ben is home" is "ada and ben are not home", "neither of them is home" is
/// "both are not home".
fn write_neither(text: &mut String) {
    let Some(rest) = text.strip_prefix("neither ") else { return };
    let denied = |rest: &str| {
        let verbs = [("is ", "are not "), ("are ", "are not "), ("has ", "have not "), ("have ", "have not ")];
        verbs.iter().find_map(|(verb, denied)| Some(format!("{denied}{}", rest.strip_prefix(verb)?)))
    };
    let of_both = || WORDS.two.after(rest).find_map(|rest| Some(format!("both {}", denied(rest.strip_prefix(' ')?)?)));
    let of_two = || {
        let (one, rest) = rest.split_once(" nor ")?;
        let mut spaces = rest.match_indices(' ').take(NAME_WORDS_MAX);
        spaces.find_map(|(at, _)| Some(format!("{one} and {} {}", &rest[..at], denied(&rest[at + 1..])?)))
    };
    if let Some(written) = of_both().or_else(of_two) {
        *text = written;
    }
}

/// A sentence without what has no letters at its begin: "Ada goes to bed" of "- Ada goes to bed" and of "10:32 Ada goes to bed". A number counts what
/// stands behind it: "2 people".
fn without_marks(sentence: &str) -> &str {
    let mut said = sentence.trim();
    while let Some((word, rest)) = said.split_once(' ')
        && !word.contains(char::is_alphabetic)
        && !word.chars().all(char::is_numeric)
        && !word.contains(is_mark)
    {
        said = rest.trim_start();
    }
    said
}

fn is_mark(c: char) -> bool {
    matches!(c, '“' | '”' | '"')
}

/// The parts of a sentence without quotation marks, and without what somebody says between them: a name alone is no speech.
fn unquoted(sentence: &str) -> impl Iterator<Item = &str> {
    /// More words than these between quotation marks are speech.
    const NAME_WORDS: usize = 2;
    // Speech ends as a sentence does, or with the comma before who says it: "Everybody left.", "Ben left,".
    let is_name = |part: &str| {
        let words = part.split_whitespace().count();
        words <= NAME_WORDS && !(words > 1 && part.ends_with(['.', '!', '?', ',', '…']))
    };
    sentence.split(is_mark).enumerate().filter(move |(at, part)| at % 2 == 0 || is_name(part)).map(|(_, part)| part)
}

/// Writes short forms out.
fn write_out(text: &mut String) {
    const SHORT: [(&str, &str); 10] = [
        ("there's ", "there is "),
        ("can't", "can not"),
        ("won't", "will not"),
        ("n't", " not"),
        ("'re ", " are "),
        ("'ve ", " have "),
        ("'ll ", " will "),
        ("'d ", " would "),
        ("i'm ", "i am "),
        (": ", ", "),
    ];
    for (short, long) in SHORT {
        if text.contains(short) {
            *text = text.replace(short, long);
        }
    }
    // What belongs to somebody is not somebody: only before what somebody can be is it "is".
    while let Some((at, _)) = text.match_indices("'s ").find(|(at, _)| is_state_ahead(&text[at + 3..])) {
        text.replace_range(at..at + 3, " is ");
    }
}
