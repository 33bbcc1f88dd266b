//! Parser errors of JSON and TOML in plain words, and sections that refuse lists.
//!
//! `serde` names a program's types ("expected struct Box3", "expected f64"). Authors of a map or a configuration do not know these.

use std::fmt;
use std::marker::PhantomData;

use serde::de::value::{MapAccessDeserializer, StrDeserializer};
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::text::{excerpt, nearest, visible};

/// The message of a JSON error on one line, shortened by [`excerpt`].
///
/// ```
/// use roomcast_core::parsing::json_says;
///
/// let error = serde_json::from_str::<Vec<u32>>("[1, true]").unwrap_err();
/// assert_eq!(json_says(&error), "`true`, expected a whole number of 0 or more at line 1 column 8");
/// ```
#[must_use]
pub fn json_says(error: &serde_json::Error) -> String {
    excerpt(&visible(&in_words(&error.to_string(), "a list"))).into_owned()
}

/// The message of an error in one line of JSON, without the line number.
#[must_use]
pub fn json_of_one_line_says(error: &serde_json::Error) -> String {
    let said = json_says(error);
    let position = format!(" at line {} column {}", error.line(), error.column());
    match said.strip_suffix(&position) {
        // An error about the whole value has no column.
        Some(said) if error.column() == 0 => said.to_owned(),
        Some(said) => format!("{said} at column {}", error.column()),
        None => said,
    }
}

/// The message of a TOML error: the affected line, and below it the fault.
#[must_use]
pub fn toml_says(error: &toml::de::Error) -> String {
    let whole = error.to_string();
    let said = whole.trim_end().trim_start_matches("TOML parse error ");
    let shown = match said.strip_suffix(error.message().trim_end()) {
        Some(line) => {
            line.to_owned()
                + &in_words(
                    error.message().trim_end(),
                    "a list: [[NAME]] begins one of several, and [\"...\"] has texts",
                )
        }
        None => said.to_owned(),
    };
    excerpt(&shown).into_owned()
}

/// `serde`'s names of the value found, with their plain words.
const GIVEN: [(&str, &str); 12] = [
    ("invalid type: sequence", "a list"),
    ("invalid type: map", "keys and values"),
    ("invalid type: null", "null"),
    ("invalid type: unit value", "null"),
    ("invalid type: string ", "the text "),
    ("invalid type: integer ", "the number "),
    ("invalid type: floating point ", "the number "),
    ("invalid type: boolean ", ""),
    ("invalid type: ", ""),
    ("invalid value: integer ", "the number "),
    ("invalid value: string ", "the text "),
    ("invalid value: floating point ", "the number "),
];

/// Other phrases of `serde` with their plain words.
const WHOLE: [(&str, &str); 13] = [
    ("invalid datetime", "no date or time; write hours in quotes, such as \"22:00-07:00\""),
    ("unknown field ", "unknown key "),
    ("unknown variant ", "unknown word "),
    ("missing field ", "missing key "),
    ("duplicate field ", "given twice: the key "),
    ("EOF while parsing an object", "the text ends before its }"),
    ("EOF while parsing a list", "the text ends before its ]"),
    ("EOF while parsing a string", "the text ends within quotation marks"),
    ("EOF while parsing a value", "the text ends too early"),
    ("key must be a string", "write keys in double quotes"),
    ("trailing characters", "more stands behind the end"),
    ("invalid length ", "a list of "),
    ("wanted string or table", "give a text in quotes"),
];

/// `serde`'s names of the expected value, with their plain words.
const EXPECTED: [(&str, &str); 16] = [
    ("usize", "a whole number of 0 or more"),
    ("u64", "a whole number of 0 or more"),
    ("u32", "a whole number of 0 or more"),
    ("u16", "a whole number of 0 or more"),
    ("u8", "a whole number of 0 or more"),
    ("i64", "a whole number"),
    ("i32", "a whole number"),
    ("f64", "a number"),
    ("f32", "a number"),
    ("a boolean", "true or false"),
    ("a string", "a text in quotes"),
    ("a borrowed string", "a text in quotes"),
    ("path string", "a path in quotes"),
    ("a map", "keys and values"),
    ("socket address", "an address with a port, such as 127.0.0.1:9464"),
    ("unit", "null"),
];

/// Replaces `serde`'s words in a message; `list` is the word for a list.
fn in_words(said: &str, list: &str) -> String {
    // The expectation comes last: the value before it may be any text.
    let (given, expected) = said.rsplit_once(", expected ").map_or((said, None), |(given, rest)| (given, Some(rest)));
    let begin = |text: &str, table: &[(&str, &str)]| {
        table.iter().find_map(|(own, word)| Some(format!("{word}{}", text.strip_prefix(own)?)))
    };
    let given = begin(given, &GIVEN).or_else(|| begin(given, &WHOLE)).unwrap_or_else(|| given.to_owned());
    let given = match given.strip_prefix("invalid socket address syntax") {
        Some(rest) => format!("no address with a port, such as 127.0.0.1:9464{rest}"),
        None => given,
    };
    let Some(expected) = expected else { return given };
    let unknown = given.strip_prefix("unknown ").and_then(|rest| rest.split_once('`')?.1.strip_suffix('`'));
    let meant = unknown.and_then(|unknown| nearest(unknown, expected.split('`').skip(1).step_by(2)));
    let given = meant.map_or(given.clone(), |meant| format!("{given} (did you mean `{meant}`?)"));
    let is_of_the_program = ["struct ", "internally tagged enum ", "struct variant "];
    let (what, place) = match expected.find(" at line ") {
        Some(at) => expected.split_at(at),
        None => (expected, ""),
    };
    let what = if what == "a sequence" {
        list.to_owned()
    } else if let Some(length) = what.strip_prefix("an array of length ") {
        format!("{length} of them")
    } else if is_of_the_program.iter().any(|kind| what.starts_with(kind)) {
        "keys and values".to_owned()
    } else {
        EXPECTED.iter().find(|(own, _)| *own == what).map_or(what, |(_, words)| words).to_owned()
    };
    format!("{given}, expected {what}{place}")
}

/// Deserialises a struct from keys, and refuses a list: `serde` accepts a list of the fields in order.
///
/// For `#[serde(deserialize_with = "keyed")]`.
///
/// # Errors
/// Those of `T`, and if the value is a list.
pub fn keyed<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    struct Keys<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Keys<T> {
        type Value = T;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("keys and values")
        }

        fn visit_map<A: MapAccess<'de>>(self, keys: A) -> Result<T, A::Error> {
            T::deserialize(MapAccessDeserializer::new(keys))
        }
    }
    deserializer.deserialize_map(Keys(PhantomData))
}

/// Deserialises an enum from a text. For other values the error asks for a text; `serde_json` would say "expected value".
///
/// For `#[serde(deserialize_with = "word")]`.
///
/// # Errors
/// Those of `T`, and if the value is not a text.
pub fn word<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    struct Word<T>(PhantomData<T>);
    impl<'de, T: Deserialize<'de>> Visitor<'de> for Word<T> {
        type Value = T;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a text in quotes")
        }

        fn visit_str<E: Error>(self, text: &str) -> Result<T, E> {
            T::deserialize(StrDeserializer::new(text))
        }
    }
    deserializer.deserialize_str(Word(PhantomData))
}

/// An element of a list that must have keys: see [`keyed`].
#[derive(Debug, Deserialize)]
#[serde(transparent, bound = "T: Deserialize<'de>")]
pub struct Keyed<T>(#[serde(deserialize_with = "keyed")] pub T);

/// As [`keyed`], for a list of structs.
///
/// # Errors
/// Those of `T`, and if an element is a list.
pub fn list_of_keyed<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    Ok(Vec::<Keyed<T>>::deserialize(deserializer)?.into_iter().map(|entry| entry.0).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize, Default)]
    #[serde(deny_unknown_fields, default)]
    struct File {
        #[serde(deserialize_with = "keyed")]
        part: Part,
        #[serde(deserialize_with = "list_of_keyed")]
        parts: Vec<Part>,
        names: Vec<String>,
        place: Option<[f64; 3]>,
    }

    #[derive(Debug, Deserialize, Default)]
    #[serde(deny_unknown_fields, default)]
    struct Part {
        count: u32,
        share: f64,
        is_on: bool,
    }

    #[test]
    fn no_word_of_the_program_is_told() {
        let words =
            ["struct", "enum", "variant", "sequence", "f64", "u32", "usize", "EOF", "unit", "field", "invalid type"];
        for json in [
            "[]",
            "3",
            "{\"part\": []}",
            "{\"part\": 3}",
            "{\"part\": [1, 2.0]}",
            "{\"parts\": {}}",
            "{\"parts\": [[1]]}",
            "{\"parts\": [1]}",
            "{\"names\": \"ada\"}",
            "{\"names\": [3]}",
            "{\"place\": [1, 2]}",
            "{\"place\": \"here\"}",
            "{\"part\": {\"count\": -1}}",
            "{\"part\": {\"count\": 1.5}}",
            "{\"part\": {\"share\": \"much\"}}",
            "{\"part\": {\"is_on\": 1}}",
            "{\"part\": {\"x\": 1}}",
            "{",
            "{\"part\"",
            "{'part': 1}",
            "[",
            "\"",
            "",
            "{} {}",
            "{\"names\": [\"a",
            "{\"part\": {}, \"part\": {}}",
            "{\"names\": null}",
        ] {
            let error = serde_json::from_str::<Keyed<File>>(json).unwrap_err();
            let said = json_says(&error);
            assert!(!words.iter().any(|word| said.contains(word)), "{json}: {said}");
        }
        for toml in [
            "part = 3",
            "part = []",
            "parts = 3",
            "[parts]\ncount = 1",
            "parts = [[1]]",
            "names = \"ada\"",
            "names = [3]",
            "[part]\ncount = -1",
            "[part]\ncount = \"2\"",
            "[part]\nshare = true",
            "[part]\nis_on = \"yes\"",
            "[part]\nx = 1",
            "place = [1, 2]",
        ] {
            let said = toml_says(&toml::from_str::<File>(toml).unwrap_err());
            assert!(!words.iter().any(|word| said.contains(word)), "{toml}: {said}");
        }
    }

    #[test]
    fn the_nearest_key_and_quotes_for_hours_are_suggested() {
        for (toml, said) in [
            (
                "[part]\nshar = 1",
                "unknown key `shar` (did you mean `share`?), expected one of `count`, `share`, `is_on`",
            ),
            ("[part]\nx = 1", "unknown key `x`, expected one of"),
            ("names = [22:00-07:00]", "write hours in quotes, such as \"22:00-07:00\""),
        ] {
            let told = toml_says(&toml::from_str::<File>(toml).unwrap_err());
            assert!(told.starts_with("at line ") && told.contains(said), "{told}");
        }
    }

    #[test]
    fn what_is_given_stays_as_it_is() {
        let error = serde_json::from_str::<u32>("\"invalid type: map, expected struct X\"").unwrap_err();
        let said = json_says(&error);
        assert!(
            said.starts_with("the text \"invalid type: map, expected struct X\", expected a whole number"),
            "{said}"
        );
        let said = toml_says(&toml::from_str::<File>("names = 'expected f64'").unwrap_err());
        assert!(said.contains("names = 'expected f64'"), "{said}");
    }

    #[test]
    fn a_list_stands_for_no_keys() {
        assert!(toml::from_str::<File>("part = [1, 2.0, true]").is_err());
        assert!(toml::from_str::<File>("parts = [[1, 2.0, true]]").is_err());
        let file: File = toml::from_str("[part]\ncount = 1\n[[parts]]\nshare = 0.5\n[[parts]]\n").unwrap();
        assert_eq!((file.part.count, file.parts.len()), (1, 2));
    }
}
