//! One line of narration: a sentence, an action, a device's state, or a JSON object that says of whom, when, and who is in the house.
//! `docs/json-lines.md` is the manual. Pure: from a line's text to what is sent.

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::str::FromStr;

use serde::de::{Deserialize, Deserializer, Unexpected, Visitor};
use serde_json::Value;

use crate::embedded;
use crate::message_text::said_of;
use roomcast_core::narration::{
    Named, Observed, ObservedError, Presence, PresenceError, PresenceStatement, ProgramError,
};
use roomcast_core::text::visible;
use roomcast_ipc::{ALL_PERSONS, MessageError, NarrationV1, narration_kind, text};

/// How far a time of observation may lie ahead: clocks differ, and a number of seconds is rounded.
pub(crate) const AHEAD_NS: u64 = 1_000_000_000;
/// Longest line of input, in bytes.
pub(crate) const LINE_BYTES_MAX: u64 = 8192;

/// Whom an observation is of.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub enum Who {
    /// Somebody: the daemon takes the person whom it fits best.
    #[default]
    Somebody,
    /// The person of this number.
    Number(u32),
    /// The person of this name, which has letters or digits and fits into a message.
    Name(String),
}

/// Why a text names no person.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no person: give a number from 0 to {}, or a name of at most {} bytes with letters", ALL_PERSONS - 1, roomcast_ipc::NAME_BYTES)]
pub struct WhoError {
    text: String,
}

impl Who {
    /// Writes who it is into a message.
    ///
    /// # Errors
    ///
    /// [`MessageError`] for a name that does not fit, which no [`FromStr`] gives.
    fn put(&self, message: &mut NarrationV1) -> Result<(), MessageError> {
        message.person = ALL_PERSONS;
        match self {
            Self::Somebody => {}
            Self::Number(number) => message.person = *number,
            Self::Name(name) => message.person_name = text::encode("person_name", name)?,
        }
        Ok(())
    }

    /// As it stands in a line of JSON; null for somebody.
    pub(crate) fn json(&self) -> Value {
        match self {
            Self::Somebody => Value::Null,
            Self::Number(number) => (*number).into(),
            Self::Name(name) => name.as_str().into(),
        }
    }
}

impl From<u32> for Who {
    /// [`ALL_PERSONS`] is somebody, as in messages.
    fn from(number: u32) -> Self {
        if number == ALL_PERSONS { Self::Somebody } else { Self::Number(number) }
    }
}

impl FromStr for Who {
    type Err = WhoError;

    /// A number, or else a name.
    fn from_str(text: &str) -> Result<Self, WhoError> {
        match Named::parse(text) {
            Ok(Named::Number(number)) => Ok(Self::Number(number)),
            Ok(Named::Name(name)) => Ok(Self::Name(name.to_owned())),
            Err(_) => Err(WhoError { text: text.trim().chars().take(80).collect() }),
        }
    }
}

impl<'de> Deserialize<'de> for Who {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Named;
        impl Visitor<'_> for Named {
            type Value = Who;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "a person's number from 0 to {}, or name", ALL_PERSONS - 1)
            }

            fn visit_i64<E: serde::de::Error>(self, number: i64) -> Result<Who, E> {
                let inside = u32::try_from(number).ok().filter(|number| *number != ALL_PERSONS);
                inside.map(Who::Number).ok_or_else(|| E::invalid_value(Unexpected::Signed(number), &self))
            }

            fn visit_u64<E: serde::de::Error>(self, number: u64) -> Result<Who, E> {
                match i64::try_from(number) {
                    Ok(number) => self.visit_i64(number),
                    Err(_) => Err(E::invalid_value(Unexpected::Unsigned(number), &self)),
                }
            }

            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Who, E> {
                text.parse().map_err(E::custom)
            }
        }
        deserializer.deserialize_any(Named)
    }
}

/// One narration to be.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// One of [`narration_kind`].
    pub kind: u32,
    /// The text, in the notation of its kind.
    pub text: String,
    /// The person observed.
    pub person: Who,
    /// When it was observed, in Unix nanoseconds; none for now.
    pub observed_unix_ns: Option<u64>,
    /// How long it takes in reality, in seconds: time that passes before it is observed.
    pub duration_s: f64,
}

impl Item {
    /// An observation of now.
    #[must_use]
    pub fn new(kind: u32, text: impl Into<String>, person: Who) -> Self {
        Self { kind, text: text.into(), person, observed_unix_ns: None, duration_s: 0.0 }
    }

    /// The message without its sender and time.
    ///
    /// # Errors
    ///
    /// [`MessageError`] when text or name cannot be in a message.
    pub(crate) fn message(&self) -> Result<NarrationV1, MessageError> {
        let mut message = NarrationV1::new(self.kind, &self.text)?;
        self.person.put(&mut message)?;
        Ok(message)
    }
}

/// Why a line is no narration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// It is no observation.
    #[error(transparent)]
    Observed(#[from] ObservedError),
    /// It says nothing about presence.
    #[error(transparent)]
    Presence(#[from] PresenceError),
    /// It cannot be a message.
    #[error(transparent)]
    Message(#[from] MessageError),
    /// It is malformed JSON, or a key is.
    #[error("{reason}; docs/json-lines.md has every key with an example")]
    Json {
        /// Which key and what is allowed there, or in which column.
        reason: String,
    },
    /// It is too long, or not UTF-8.
    #[error("not a line of UTF-8 with at most {LINE_BYTES_MAX} bytes")]
    NoLine,
}

/// A line or file that is no narration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InputError {
    /// It cannot be read.
    #[error("cannot read {name}: {source}")]
    Read {
        /// The file, or "standard input".
        name: String,
        /// The system's word.
        source: io::Error,
    },
    /// Neither a file nor the name of a shipped activity program.
    #[error(
        "there is no file {name}: give a program's file, a file of lines, or a shipped program by its name, {}",
        embedded::program_names()
    )]
    Missing {
        /// What was given.
        name: String,
    },
    /// What is to be a FIFO is something else.
    #[error("{path} is there and is no named pipe: remove it, give another path, or leave out --fifo to read it once")]
    NoFifo {
        /// The file.
        path: PathBuf,
    },
    /// The program is malformed.
    #[error(transparent)]
    Program(#[from] ProgramError),
    /// A line is no narration.
    #[error("line {line}: {source}")]
    Line {
        /// From 1.
        line: u64,
        /// Why.
        source: LineError,
    },
}

/// Lines that are no narration: how many there are, and of the first of them what is wrong, in words. However many there are, they take no
/// more memory.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Faults {
    told: Vec<String>,
    count: u64,
}

impl Faults {
    /// Of so many lines it is told what is wrong.
    pub const TOLD: usize = 100;

    /// Takes in what is wrong with a line.
    pub fn add(&mut self, line: u64, reason: impl fmt::Display) {
        self.add_at(format_args!("line {line}"), reason);
    }

    /// Takes in what is wrong at a place that is no line.
    pub fn add_at(&mut self, place: impl fmt::Display, reason: impl fmt::Display) {
        self.count += 1;
        if self.told.len() < Self::TOLD {
            self.told.push(format!("{place}: {reason}"));
        }
    }

    /// What is wrong with the first of them, each with its line's number.
    #[must_use]
    pub fn told(&self) -> &[String] {
        &self.told
    }

    /// How many there are.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }
}

/// A line of JSON. What its keys may hold is checked key by key, so that an error names the key.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct JsonLine {
    text: Option<Value>,
    kind: Option<Value>,
    presence: Option<Value>,
    room: Option<Value>,
    person: Option<Value>,
    observed_unix_s: Option<Value>,
}

/// One line as an item: JSON if it opens with `{`, an action if with `[`, a device state or a sentence otherwise. It is of `person` where
/// it does not say. What is JSON and no object is none of them.
///
/// # Errors
///
/// [`LineError`] with the key, where it is JSON, and what is allowed.
pub fn line_item(line: &str, person: &Who) -> Result<Item, LineError> {
    let line = line.trim();
    if !line.starts_with('{') && serde_json::from_str::<Value>(line).is_ok() {
        return Err(reason(
            "a line of JSON is an object, such as {\"text\": \"They sit down.\"}; a sentence stands without quotes",
        ));
    }
    let item =
        if line.starts_with('{') { json_item(line, person)? } else { Item::new(kind_of(line)?, line, person.clone()) };
    // What the daemon would refuse is refused here, where somebody sees it.
    item.message()?;
    said_of(item.kind, &item.text)?;
    Ok(item)
}

fn json_item(line: &str, person: &Who) -> Result<Item, LineError> {
    let json: JsonLine = serde_json::from_str(line).map_err(|error| syntax_error(&error))?;
    let text = json.text.as_ref().map(|text| string("text", text)).transpose()?;
    let presence = json.presence.as_ref().map(|presence| string("presence", presence)).transpose()?;
    let (kind, text) = match (text, presence) {
        (Some(text), None) if json.room.is_none() => {
            let kind = json.kind.as_ref().map(|kind| string("kind", kind)).transpose()?;
            let kind = match kind {
                Some("sentence") => narration_kind::SENTENCE,
                Some("action") => narration_kind::ACTION,
                Some("device") => narration_kind::DEVICE,
                Some(_) => return Err(key_error("kind", json.kind.as_ref(), "\"sentence\", \"action\" or \"device\"")),
                None => kind_of(text)?,
            };
            (kind, text.trim().to_owned())
        }
        (None, Some(presence)) if json.kind.is_none() => {
            let room = json.room.as_ref().map(|room| string("room", room)).transpose()?;
            let presence = match presence {
                "present" => Presence::Present,
                "away" => Presence::Away,
                "gone" => Presence::Gone,
                "empty" => return empty_item(&json, room),
                _ => {
                    let allowed = "\"present\", \"away\", \"gone\" or \"empty\"";
                    return Err(key_error("presence", json.presence.as_ref(), allowed));
                }
            };
            if room.is_some() && presence != Presence::Present {
                return Err(reason(
                    "\"room\" goes with \"presence\": \"present\" or \"empty\" alone; leave one of them out",
                ));
            }
            let room = room.map(|room| room.trim().strip_prefix("the ").unwrap_or(room));
            (narration_kind::PRESENCE, PresenceStatement::new(presence, room)?.to_string())
        }
        (Some(_), Some(_)) => {
            return Err(reason("\"text\" and \"presence\" exclude each other; send two lines"));
        }
        (None, None) => return Err(reason("give \"text\" or \"presence\"")),
        (Some(_), None) => return Err(reason("\"room\" goes with \"presence\": \"present\", and not with \"text\"")),
        (None, Some(_)) => return Err(reason("\"kind\" goes with \"text\", and not with \"presence\"")),
    };
    let person = match &json.person {
        None | Some(Value::Null) => person.clone(),
        Some(value) => Who::deserialize(value).map_err(|error| reason(&format!("\"person\": {error}")))?,
    };
    let observed_unix_ns = json.observed_unix_s.as_ref().map(unix_ns).transpose()?;
    Ok(Item { observed_unix_ns, ..Item::new(kind, text, person) })
}

/// That nobody is in a room.
fn empty_item(json: &JsonLine, room: Option<&str>) -> Result<Item, LineError> {
    let room = room.ok_or_else(|| reason("\"presence\": \"empty\" needs a \"room\""))?;
    if json.person.as_ref().is_some_and(|person| !person.is_null()) {
        return Err(reason("\"presence\": \"empty\" is of everybody; leave \"person\" out"));
    }
    let room = room.trim().strip_prefix("the ").unwrap_or(room);
    let empty = PresenceStatement::empty(room)?;
    let observed_unix_ns = json.observed_unix_s.as_ref().map(unix_ns).transpose()?;
    Ok(Item { observed_unix_ns, ..Item::new(narration_kind::PRESENCE, empty.to_string(), Who::Somebody) })
}

/// Whole nanoseconds of seconds since 1970; what lies in the future is for whoever has a clock.
fn unix_ns(value: &Value) -> Result<u64, LineError> {
    const ALLOWED: &str = "seconds since 1970, as in 1709280900.5, or leave it out for now";
    match value.as_f64() {
        // About the year 2500. 0 is what a clock that was never set says.
        Some(seconds) if (1.0..=1.7e10).contains(&seconds) => Ok((seconds * 1e9) as u64),
        _ => Err(key_error("observed_unix_s", Some(value), ALLOWED)),
    }
}

fn string<'a>(key: &str, value: &'a Value) -> Result<&'a str, LineError> {
    value.as_str().ok_or_else(|| key_error(key, Some(value), "a text"))
}

fn key_error(key: &str, value: Option<&Value>, allowed: &str) -> LineError {
    let mut shown = value.map(Value::to_string).unwrap_or_default();
    if let Some((end, _)) = shown.char_indices().nth(80) {
        shown.truncate(end);
    }
    reason(&format!("\"{key}\" is {shown}; give {allowed}"))
}

fn reason(reason: &str) -> LineError {
    LineError::Json { reason: reason.to_owned() }
}

fn syntax_error(error: &serde_json::Error) -> LineError {
    LineError::Json { reason: error_of_one_line(error) }
}

/// A parser's error about a text of one line, which it calls the first.
pub(crate) fn error_of_one_line(error: &serde_json::Error) -> String {
    // It quotes a key as it came.
    let said = visible(&error.to_string()).into_owned();
    let position = format!(" at line {} column {}", error.line(), error.column());
    let place = |said: &str| format!("{said} at column {}", error.column());
    said.strip_suffix(&position).map_or_else(|| said.clone(), place)
}

fn kind_of(text: &str) -> Result<u32, ObservedError> {
    Ok(match Observed::parse(text)? {
        Observed::Action(_) => narration_kind::ACTION,
        Observed::Device(_) => narration_kind::DEVICE,
        Observed::Sentence(_) => narration_kind::SENTENCE,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A log has one line for each refused one, whatever its keys are.
    #[test]
    fn a_refused_line_forges_no_line_of_a_log() {
        let keys = [r"\u001b[2J", r"a\nWARN forged", r"\u202e", r"\r"];
        for key in keys {
            let refused = line_item(&format!(r#"{{"{key}": 1}}"#), &Who::Somebody).unwrap_err().to_string();
            assert!(!refused.contains(roomcast_core::text::is_hidden) && refused.contains("\\u"), "{refused}");
        }
    }

    fn item(line: &str) -> Result<Item, LineError> {
        line_item(line, &Who::Number(3))
    }

    #[test]
    fn every_form_of_line_becomes_an_item() {
        let sentence = |text: &str, person| Item::new(narration_kind::SENTENCE, text, person);
        assert_eq!(item("They sit down.").unwrap(), sentence("They sit down.", Who::Number(3)));
        let action = Item::new(narration_kind::ACTION, "[Grab] <mug> (1)", Who::Number(3));
        assert_eq!(item("[Grab] <mug> (1)").unwrap(), action);
        let device = Item::new(narration_kind::DEVICE, "the oven is on", Who::Number(3));
        assert_eq!(item("the oven is on").unwrap(), device);
        // Who leaves is said in a sentence, too, which the daemon understands.
        assert_eq!(item("Ada leaves the house.").unwrap(), sentence("Ada leaves the house.", Who::Number(3)));
        for (json, person) in [
            (r#"{"text": "They sit down.", "person": 9}"#, Who::Number(9)),
            (r#"{"text": "They sit down.", "person": "9"}"#, Who::Number(9)),
            (r#"{"text": "They sit down.", "person": " Ada "}"#, Who::Name("Ada".to_owned())),
            (r#"{"text": "They sit down.", "person": null}"#, Who::Number(3)),
        ] {
            assert_eq!(item(json).unwrap(), sentence("They sit down.", person), "{json}");
        }
        for bad in ["[Fly] <mug> (1)", "...", "a\u{7}b", r#"{"text": "They sit.", "kind": "action"}"#] {
            item(bad).unwrap_err();
        }
    }

    #[test]
    fn presence_is_said_by_json() {
        for (json, text, person) in [
            (r#"{"room": "the hall", "presence": "empty"}"#, "nobody in the hall", Who::Somebody),
            (r#"{"person": "ada", "presence": "away"}"#, "away", Who::Name("ada".to_owned())),
            (r#"{"presence": "gone", "person": 7}"#, "gone", Who::Number(7)),
            (r#"{"presence": "present"}"#, "present", Who::Number(3)),
            (r#"{"presence": "present", "room": "kitchen"}"#, "present in the kitchen", Who::Number(3)),
            (r#"{"presence": "present", "room": "the living room"}"#, "present in the living room", Who::Number(3)),
        ] {
            assert_eq!(item(json).unwrap(), Item::new(narration_kind::PRESENCE, text, person), "{json}");
        }
    }

    #[test]
    fn an_error_names_the_key_and_what_is_allowed() {
        for (json, part) in [
            ("{\"txt\": \"a\"}", "unknown field `txt`, expected one of `text`, `kind`, `presence`, `room`, `person`"),
            ("{\"text\": \"They sit.\"", "at column 20"),
            ("{}", "give \"text\" or \"presence\""),
            (r#"{"text": 3}"#, "\"text\" is 3; give a text"),
            (r#"{"text": "They sit.", "kind": "word"}"#, "\"kind\" is \"word\"; give \"sentence\", \"action\" or"),
            (r#"{"text": "They sit.", "presence": "away"}"#, "\"text\" and \"presence\" exclude each other"),
            (r#"{"text": "They sit.", "room": "hall"}"#, "\"room\" goes with \"presence\""),
            (
                r#"{"presence": "away", "room": "hall"}"#,
                "\"room\" goes with \"presence\": \"present\" or \"empty\" alone",
            ),
            (r#"{"presence": "present", "room": ""}"#, "is no presence"),
            (r#"{"presence": "present", "room": 3}"#, "\"room\" is 3; give a text"),
            (
                r#"{"presence": "asleep"}"#,
                "\"presence\" is \"asleep\"; give \"present\", \"away\", \"gone\" or \"empty\"",
            ),
            (r#"{"presence": "empty"}"#, "\"presence\": \"empty\" needs a \"room\""),
            (r#"{"presence": "empty", "room": "hall", "person": "ada"}"#, "is of everybody; leave \"person\" out"),
            (r#"{"presence": "unknown"}"#, "\"presence\" is \"unknown\""),
            (r#"{"presence": "away", "kind": "sentence"}"#, "\"kind\" goes with \"text\""),
            (r#"{"text": "They sit.", "person": -1}"#, "\"person\": invalid value: integer `-1`, expected a person's"),
            (r#"{"text": "They sit.", "person": 4294967295}"#, "number from 0 to 4294967294, or name"),
            (r#"{"text": "They sit.", "person": 1.5}"#, "\"person\": invalid type: floating point `1.5`"),
            (r#"{"text": "They sit.", "person": ""}"#, "\"person\": \"\" is no person"),
            (r#"{"text": "They sit.", "person": "-3"}"#, "\"person\": \"-3\" is no person"),
            (r#"{"text": "They sit.", "observed_unix_s": "noon"}"#, "\"observed_unix_s\" is \"noon\"; give seconds"),
            (r#"{"text": "They sit.", "observed_unix_s": -1}"#, "\"observed_unix_s\" is -1"),
            (r#"{"text": "They sit.", "observed_unix_s": 0}"#, "\"observed_unix_s\" is 0; give seconds since 1970"),
            ("null", "a line of JSON is an object"),
            ("12345", "a line of JSON is an object"),
            ("[1, 2]", "a line of JSON is an object"),
            (r#""They sit.""#, "a sentence stands without quotes"),
        ] {
            let error = item(json).unwrap_err().to_string();
            assert!(error.contains(part), "{json}: {error}");
            let manual = error.contains("docs/json-lines.md") || error.contains("is no presence");
            assert!(manual && !error.contains("line 1"), "{json}: {error}");
        }
        assert!(item(r#"{"text": ".", "kind": "sentence"}"#).unwrap_err().to_string().contains("no letter or digit"));
    }

    /// The lines of the manual's blocks of one kind.
    fn manual(kind: &str) -> Vec<&'static str> {
        const MANUAL: &str = include_str!("../../docs/json-lines.md");
        let fence = format!("```json {kind}\n");
        let blocks = MANUAL.split(&fence[..]).skip(1);
        blocks.flat_map(|block| block.split("```").next().unwrap_or_default().lines()).collect()
    }

    #[test]
    fn every_example_of_the_manual_is_narration_and_every_key_has_one() {
        let examples = manual("narration");
        for line in &examples {
            item(line).unwrap_or_else(|error| panic!("{line}: {error}"));
        }
        for key in ["text", "kind", "presence", "room", "person", "observed_unix_s"] {
            assert!(examples.iter().any(|line| line.contains(&format!("\"{key}\":"))), "{key}");
        }
        // Reports are another command's, which refuses narration as this one refuses them.
        let reports = manual("report");
        assert_eq!(reports.len(), 8);
        for line in reports {
            serde_json::from_str::<serde_json::Map<String, Value>>(line).unwrap();
            assert!(item(line).unwrap_err().to_string().contains("unknown field `report`"), "{line}");
        }
    }

    #[test]
    fn a_message_says_of_whom_it_is() {
        let of = |person: Who| {
            let message = Item::new(narration_kind::SENTENCE, "They sit.", person).message().unwrap();
            (message.person, message.person_name().to_owned())
        };
        assert_eq!(of(Who::Somebody), (ALL_PERSONS, String::new()));
        assert_eq!(of(Who::Number(7)), (7, String::new()));
        assert_eq!(of("Ada".parse().unwrap()), (ALL_PERSONS, "Ada".to_owned()));
        assert_eq!(Who::from(ALL_PERSONS), Who::Somebody);
        for refused in ["", " ", "...", "4294967295", "a\u{202e}b", &"a".repeat(49)] {
            refused.parse::<Who>().unwrap_err();
        }
    }

    #[test]
    fn a_time_of_observation_is_kept_to_the_microsecond() {
        let item = item(r#"{"text": "They sit.", "observed_unix_s": 1709280900.5}"#).unwrap();
        assert_eq!(item.observed_unix_ns, Some(1_709_280_900_500_000_000));
    }
}
