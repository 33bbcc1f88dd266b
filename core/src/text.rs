//! Characters allowed in names and sentences, counted nouns, excerpts for errors, and files of bounded size.

use std::borrow::Cow;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use strsim::osa_distance;

/// Reads a file. `None` if it has more than `bytes_max` bytes. The limit applies while reading, because a device or a pipe has no size.
///
/// # Errors
/// If it cannot be read.
pub fn read_at_most(path: &Path, bytes_max: u64) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= bytes_max).then_some(bytes))
}

/// Editors on Windows write it before a text.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// A number with a noun that has a plural in s: "1 room", "2 rooms".
#[must_use]
pub fn count(number: usize, noun: &str) -> String {
    format!("{number} {noun}{}", if number == 1 { "" } else { "s" })
}

/// The known word that a misspelt one resembles most, if at most a third of its letters must change. Only letters and digits are compared.
///
/// ```
/// use roomcast_core::text::nearest;
///
/// assert_eq!(nearest("ktchen", ["kitchen", "hall"]), Some("kitchen"));
/// assert_eq!(nearest("roomtime", ["room_time_s", "quiet"]), Some("room_time_s"));
/// assert_eq!(nearest("quite", ["room_time_s", "quiet"]), Some("quiet"));
/// assert_eq!(nearest("garden", ["kitchen", "hall"]), None);
/// ```
#[must_use]
pub fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // Longer texts are no misspelt word, and comparing them would cost time.
    if word.len() > 128 {
        return None;
    }
    let letters = |text: &str| text.chars().filter(|letter| letter.is_alphanumeric()).collect::<String>();
    let meant = letters(word);
    let (distance, best) = known.into_iter().map(|known| (osa_distance(&meant, &letters(known)), known)).min()?;
    (3 * distance <= meant.chars().count()).then_some(best)
}

/// As [`nearest`], as the end of an error: "; did you mean `kitchen`?", or nothing.
#[must_use]
pub fn did_you_mean<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    nearest(word, known).map_or_else(String::new, |known| format!("; did you mean `{known}`?"))
}

#[must_use]
pub(crate) fn without_mark(text: &str) -> &str {
    text.strip_prefix(BYTE_ORDER_MARK).unwrap_or(text)
}

/// Longer lines are shortened in errors to their beginning and end.
const LINE_CHARS: usize = 640;
const BEGINNING_CHARS: usize = 400;
const END_CHARS: usize = 200;
/// Most lines of an error.
const LINES: usize = 64;

/// Shortens a text for an error, for instance a parser's message, which may quote an input of any length. Of a long line, and of many lines, only the
/// beginning and the end remain.
///
/// ```
/// use roomcast_core::text::excerpt;
///
/// assert_eq!(excerpt("expected a number"), "expected a number");
/// assert!(excerpt(&"k".repeat(10_000_000)).len() < 700);
/// ```
#[must_use]
pub fn excerpt(text: &str) -> Cow<'_, str> {
    let cut = |line: &str| line.char_indices().nth(LINE_CHARS).is_some();
    if !text.lines().any(cut) && text.lines().nth(LINES).is_none() {
        return Cow::Borrowed(text);
    }
    let lines: Vec<Cow<'_, str>> = text.lines().map(excerpt_of_line).collect();
    Cow::Owned(match lines.len() {
        0..=LINES => lines.join("\n"),
        count => [&lines[..LINES / 2], &["...".into()], &lines[count - LINES / 2..]].concat().join("\n"),
    })
}

fn excerpt_of_line(line: &str) -> Cow<'_, str> {
    if line.char_indices().nth(LINE_CHARS).is_none() {
        return Cow::Borrowed(line);
    }
    let until = line.char_indices().nth(BEGINNING_CHARS).map_or(line.len(), |(at, _)| at);
    let from = line.char_indices().nth_back(END_CHARS - 1).map_or(0, |(at, _)| at);
    Cow::Owned(format!("{} ... {}", line[..until].trim_end(), line[from..].trim_start()))
}

/// As [`read_at_most`], for a text; a byte order mark is removed.
///
/// # Errors
/// As [`read_at_most`], and [`io::ErrorKind::InvalidData`] if it is not UTF-8, [`io::ErrorKind::FileTooLarge`] if it is larger.
pub fn read_text_at_most(path: &Path, bytes_max: u64) -> io::Result<String> {
    let too_large = || io::Error::new(io::ErrorKind::FileTooLarge, format!("it has more than {bytes_max} bytes"));
    let bytes = read_at_most(path, bytes_max)?.ok_or_else(too_large)?;
    let mut text =
        String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8"))?;
    text.drain(..text.len() - without_mark(&text).len());
    Ok(text)
}

/// Whether a character is forbidden in names and sentences: control characters, which could affect terminals and logs, and invisible characters,
/// which make a text look like another one (directions, zero width, line ends, tags). Messages between processes refuse the same characters.
#[must_use]
pub fn is_hidden(character: char) -> bool {
    character.is_control()
        || matches!(character,
            '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
            | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Alphabets with letters that look alike, from Unicode's table of confusable characters.
const ALPHABETS: [(&str, &[std::ops::RangeInclusive<char>]); 5] = [
    ("Latin", &['A'..='Z', 'a'..='z', '\u{c0}'..='\u{24f}', '\u{1e00}'..='\u{1eff}']),
    ("Greek", &['\u{370}'..='\u{3ff}', '\u{1f00}'..='\u{1fff}']),
    ("Cyrillic", &['\u{400}'..='\u{52f}', '\u{1c80}'..='\u{1c8f}', '\u{a640}'..='\u{a69f}']),
    ("Armenian", &['\u{531}'..='\u{58f}']),
    ("Cherokee", &['\u{13a0}'..='\u{13ff}', '\u{ab70}'..='\u{abbf}']),
];
/// Greek and Cyrillic letters, and the Latin letters that look like them, from Unicode's table of confusable characters.
const LOOKS: [(&str, &str); 2] = [
    ("АВЕЅІЈКМНОРСТУХԚԜаеѕіјорсухԁԛԝһ", "ABESIJKMHOPCTYXQWaesijopcyxdqwh"),
    ("ΑΒΕΖΗΙΚΜΝΟΡΤΥΧαινορυ", "ABEZHIKMNOPTYXaivopu"),
];

/// A name in lower case, with letters replaced by the Latin letters that look like them.
fn look_of(name: &str) -> String {
    let looks = |letter: char| {
        let pair = |(letters, latin): &(&str, &str)| letters.chars().zip(latin.chars()).find(|(one, _)| *one == letter);
        LOOKS.iter().find_map(pair).map_or(letter, |(_, latin)| latin)
    };
    name.chars().map(looks).collect::<String>().to_lowercase()
}

/// A warning about a person's name, if a word mixes alphabets with letters that look alike, or if the name looks like a known one. Programs treat
/// such a name as another person, but readers see the known one.
///
/// ```
/// use roomcast_core::text::odd_name;
///
/// // The first letter is Cyrillic.
/// assert!(odd_name("\u{410}da", []).is_some_and(|odd| odd.contains("mixes Latin and Cyrillic letters")));
/// assert_eq!(odd_name("Анна", ["Ada"]), None);
/// ```
#[must_use]
pub fn odd_name<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let alphabets = |word: &str| {
        let is_of = |(_, ranges): &&(&str, &[std::ops::RangeInclusive<char>])| {
            word.chars().any(|letter| ranges.iter().any(|range| range.contains(&letter)))
        };
        ALPHABETS.iter().filter(is_of).map(|(alphabet, _)| *alphabet).collect::<Vec<_>>()
    };
    let words = name.split(|character: char| !character.is_alphanumeric());
    let mixed = words.map(alphabets).find(|alphabets| alphabets.len() > 1);
    let look = look_of(name);
    let alike = known.into_iter().find(|other| look_of(other) == look && other.to_lowercase() != name.to_lowercase());
    match (mixed, alike) {
        (None, None) => None,
        (Some(mixed), None) => {
            Some(format!("{name:?} mixes {} letters: write it in one alphabet", mixed.join(" and ")))
        }
        (_, Some(other)) => {
            Some(format!("{name:?} looks like {other:?} and is another name: write it in the same letters"))
        }
    }
}

/// Makes an untrusted text safe for a terminal or a log, on one line: hidden characters become JSON escapes such as `\u001b`.
///
/// ```
/// use roomcast_core::text::visible;
///
/// assert_eq!(visible("a\u{1b}[2J\nb"), "a\\u001b[2J\\u000ab");
/// ```
#[must_use]
pub fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, is_hidden)
}

/// As [`visible`] for several lines in columns: line ends and tabs stay.
#[must_use]
pub fn visible_lines(text: &str) -> Cow<'_, str> {
    escaped(text, |character| is_hidden(character) && !matches!(character, '\n' | '\t'))
}

fn escaped(text: &str, is_escaped: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_escaped) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for character in text.chars() {
        if is_escaped(character) {
            // JSON escapes keep a JSON document valid.
            shown.extend(character.encode_utf16(&mut [0; 2]).iter().map(|unit| format!("\\u{unit:04x}")));
        } else {
            shown.push(character);
        }
    }
    Cow::Owned(shown)
}

/// Whether a text contains any of these words, or sequences of words, as whole words. Upper and lower case ASCII letters are equal.
///
/// ```
/// use roomcast_core::text::has_words;
///
/// assert!(has_words("ben gives ada the mug", &["ben", "ada"]) && !has_words("an adaptor", &["ada"]));
/// assert!(has_words("Ben gives Ada the mug", &["ada"]));
/// ```
#[must_use]
pub fn has_words(text: &str, any: &[&str]) -> bool {
    let begins = text.char_indices().scan(false, |in_word, (at, c)| {
        let was_in_word = std::mem::replace(in_word, c.is_alphanumeric());
        Some((!was_in_word).then_some(at))
    });
    let is_at = |at: usize, words: &str| {
        let found = text.get(at..at + words.len()).is_some_and(|found| found.eq_ignore_ascii_case(words));
        found && !text[at + words.len()..].starts_with(char::is_alphanumeric)
    };
    begins.flatten().any(|at| any.iter().any(|words| !words.is_empty() && is_at(at, words)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_hidden_is_made_visible() {
        assert!(matches!(visible("Küche 👍"), Cow::Borrowed("Küche 👍")));
        assert_eq!(
            visible("\u{1b}]0;x\u{7}\u{9b}\u{202e}\u{e0041}\r\n\t"),
            "\\u001b]0;x\\u0007\\u009b\\u202e\\udb40\\udc41\\u000d\\u000a\\u0009"
        );
        assert_eq!(visible_lines("a\tb\n\u{1b}[1m\r"), "a\tb\n\\u001b[1m\\u000d");
    }

    #[test]
    fn an_excerpt_is_short_and_has_both_ends() {
        let whole = "ä".repeat(LINE_CHARS);
        assert!(matches!(excerpt(&whole), Cow::Borrowed(_)));
        let long = format!("invalid type: string \"{}\", expected a number at line 1", "ä".repeat(1 << 20));
        let said = excerpt(&long);
        assert!(said.starts_with("invalid type: string \"ää") && said.ends_with("ää\", expected a number at line 1"));
        assert!(said.chars().count() <= LINE_CHARS, "{said}");
        let lines = format!("first\n{}{long}\nlast", "kkk\n".repeat(1 << 16));
        let said = excerpt(&lines);
        assert!(said.starts_with("first\nkkk\n") && said.ends_with("\nlast") && said.len() < 4_000, "{said}");
        // An excerpt of an excerpt is unchanged.
        assert_eq!(excerpt(&excerpt(&long)), excerpt(&long));
    }

    #[test]
    fn names_of_mixed_alphabets_or_that_look_like_a_known_name_are_odd() {
        for (name, known, odd) in [
            ("\u{410}da", None, Some("mixes Latin and Cyrillic letters")),
            ("B\u{3bf}b", None, Some("mixes Latin and Greek letters")),
            ("\u{410}da", Some("Ada"), Some("looks like \"Ada\"")),
            // A whole word of another alphabet, and in capitals.
            ("\u{430}\u{441}\u{435}", Some("ace"), Some("looks like \"ace\"")),
            ("\u{410}NN\u{410}", Some("Anna"), Some("looks like \"Anna\"")),
            ("Ada Анна", Some("Ada"), None),
            ("Zoë Müller", Some("Zoe"), None),
            ("Ada", Some("ADA"), None),
            ("Ελένη", Some("Ada"), None),
            ("Łukasz", None, None),
            ("美咲", None, None),
        ] {
            let said = odd_name(name, known);
            assert_eq!(said.is_some(), odd.is_some(), "{name}: {said:?}");
            assert!(said.unwrap_or_default().contains(odd.unwrap_or_default()), "{name}");
        }
        for (letters, latin) in LOOKS {
            assert_eq!(letters.chars().count(), latin.chars().count());
        }
    }

    /// This device reports a size of 0 and never ends.
    #[test]
    fn what_has_no_size_is_read_to_its_limit() {
        let device = Path::new("/dev/zero");
        assert_eq!(read_at_most(device, 1000).unwrap(), None);
        assert_eq!(read_text_at_most(device, 1000).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
        assert_eq!(read_at_most(Path::new("/dev/null"), 0).unwrap(), Some(Vec::new()));
    }
}
