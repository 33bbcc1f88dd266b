//! One line of narration: a sentence, an action, a device's state, or a JSON object with person, time or presence.
//! `docs/json-lines.md` is the manual. Narrators, hubs and ROS 2 all read their lines here, so that none takes what another one refuses.
//! Pure.

use std::str::FromStr;

use serde::de::{Deserialize, Deserializer, Error};
use serde::{Serialize, Serializer};
use serde_json::Value;

use super::forms::{COUNT_MAX, form_of};
use super::{
    Action, DeviceState, Event, ObservedError, PERSON_NAME_BYTES_MAX, RoomName, SensorReport, Sentence, check_name,
    is_number,
};
use crate::ids::{PersonId, UnixNs};
use crate::parsing::{json_of_one_line_says, json_says};
use crate::text::{has_words, is_hidden, without_mark};

/// Longest line, in bytes, its end included.
pub const LINE_BYTES_MAX: u64 = 8192;
/// How far a time of observation may lie ahead: the clocks of cameras differ. The daemon takes such an event as observed now.
pub const AHEAD_NS: u64 = 60_000_000_000;

/// How a text is read. Messages have the numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
#[repr(u32)]
pub enum Kind {
    /// A plain sentence.
    #[default]
    Sentence = 0,
    /// An action in VirtualHome's notation.
    Action = 1,
    /// A device's state.
    Device = 2,
    /// Where a person is.
    Presence = 3,
}

impl Kind {
    const ALL: [Self; 4] = [Self::Sentence, Self::Action, Self::Device, Self::Presence];

    /// Its number in messages.
    #[must_use]
    pub fn number(self) -> u32 {
        self as u32
    }

    /// The kind of a number in messages.
    #[must_use]
    pub fn of_number(number: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.number() == number)
    }

    /// The kind of a text that stands alone: an action if it opens with `[`, a device's state if it reads "the ... is ...", else a sentence.
    #[must_use]
    pub fn of(text: &str) -> Self {
        match text.trim_start().starts_with('[') {
            true => Self::Action,
            // "The kitchen is empty." is a presence form.
            false if DeviceState::parse(text).is_some() && form_of(text).is_none() => Self::Device,
            false => Self::Sentence,
        }
    }

    /// The event of a text of this kind. A sentence may still be a presence form; the daemon decides that, since it knows names and
    /// rooms. Narrators ask this before they send, so that they send nothing that the daemon refuses.
    ///
    /// # Errors
    /// The text's fault, as this kind.
    pub fn event(self, text: &str) -> Result<Event, ObservedError> {
        Ok(match self {
            Self::Presence => Event::presence(text)?,
            Self::Action => Event::Did(Sentence::new(&Action::parse(text)?.sentence())?),
            Self::Device | Self::Sentence => Event::Did(Sentence::new(text)?),
        })
    }
}

/// The person of an event.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub enum Who {
    /// Somebody: the daemon attributes the event by fit.
    #[default]
    Somebody,
    /// The person of this number.
    Number(PersonId),
    /// The person of this name, which has letters or digits and fits into a message.
    Name(String),
}

/// Why a text names no person.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum WhoError {
    /// It has a control character.
    #[error("{text:?} holds the control character U+{code:04X}: remove it")]
    Control {
        /// The text.
        text: String,
        /// The character's code point.
        code: u32,
    },
    /// It is no number and no name.
    #[error("{text:?} is no person: give a number from 0 to {}, or a name of at most {} bytes with letters", PersonId::SOMEBODY.0 - 1, PERSON_NAME_BYTES_MAX)]
    NoPerson {
        /// The text.
        text: String,
    },
}

impl Who {
    /// The number in a message; [`PersonId::SOMEBODY`] for a name and for an unknown person.
    #[must_use]
    pub fn number(&self) -> PersonId {
        if let Self::Number(number) = self { *number } else { PersonId::SOMEBODY }
    }

    /// The name in a message; empty where there is none.
    #[must_use]
    pub fn name(&self) -> &str {
        if let Self::Name(name) = self { name } else { "" }
    }

    /// Whether nothing says who it is.
    #[must_use]
    pub fn is_somebody(&self) -> bool {
        *self == Self::Somebody
    }

    /// As it stands in a line of JSON; null for somebody.
    #[must_use]
    pub fn json(&self) -> Value {
        match self {
            Self::Somebody => Value::Null,
            Self::Number(number) => number.0.into(),
            Self::Name(name) => name.as_str().into(),
        }
    }
}

impl From<PersonId> for Who {
    fn from(number: PersonId) -> Self {
        if number == PersonId::SOMEBODY { Self::Somebody } else { Self::Number(number) }
    }
}

impl FromStr for Who {
    type Err = WhoError;

    /// A number, or else a name.
    fn from_str(text: &str) -> Result<Self, WhoError> {
        let text = text.trim();
        match text.parse() {
            Ok(number) if number != PersonId::SOMEBODY && is_number(text) => return Ok(Self::Number(number)),
            _ if check_name(text).is_ok() => return Ok(Self::Name(text.to_owned())),
            _ => {}
        }
        let shown = text.chars().take(80).collect();
        Err(match text.chars().find(|character| is_hidden(*character)) {
            Some(hidden) => WhoError::Control { text: shown, code: hidden.into() },
            None => WhoError::NoPerson { text: shown },
        })
    }
}

impl Serialize for Who {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.json().serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Who {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let value = Value::deserialize(deserializer)?;
        let number = value
            .as_u64()
            .and_then(|number| u32::try_from(number).ok())
            .map(PersonId)
            .filter(|number| *number != PersonId::SOMEBODY);
        let wrong = |found: &str| {
            D::Error::custom(format!(
                "{found}, expected a person's number from 0 to {}, or name",
                PersonId::SOMEBODY.0 - 1
            ))
        };
        match (value, number) {
            (Value::Null, _) => Ok(Self::Somebody),
            (Value::String(text), _) => text.parse().map_err(D::Error::custom),
            (_, Some(number)) => Ok(Self::Number(number)),
            (Value::Number(number), None) => Err(wrong(&format!("the number `{number}`"))),
            _ => Err(wrong("neither a number nor a text")),
        }
    }
}

/// What a line says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    /// How the text is read.
    pub kind: Kind,
    /// The text, in the notation of its kind.
    pub text: String,
    /// The person observed.
    pub person: Who,
    /// When it was observed, in Unix nanoseconds; none for now.
    pub observed_unix_ns: Option<UnixNs>,
    /// The number of persons that the narrator counted; 0 if it counted none.
    pub count: u8,
}

/// Why a line is no narration.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LineError {
    /// It is no observation.
    #[error(transparent)]
    Observed(#[from] ObservedError),
    /// It is malformed JSON, or a key is.
    #[error("{reason}; docs/json-lines.md has every key with an example")]
    Json {
        /// The key and its allowed values, or the column.
        reason: String,
    },
    /// It is too long, or not UTF-8.
    #[error("not a line of UTF-8 with at most {LINE_BYTES_MAX} bytes")]
    NoLine,
}

/// The text of a line's bytes, its end included; none of a blank line. What editors on Windows put before the first line is no part of it.
///
/// # Errors
/// [`LineError::NoLine`].
pub fn text_of(bytes: &[u8], is_first: bool) -> Result<Option<&str>, LineError> {
    if bytes.len() as u64 > LINE_BYTES_MAX {
        return Err(LineError::NoLine);
    }
    let text = std::str::from_utf8(bytes).map_err(|_| LineError::NoLine)?;
    let text = if is_first { without_mark(text) } else { text };
    Ok(Some(text).filter(|text| !text.trim().is_empty()))
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
    count: Option<Value>,
    observed_unix_s: Option<Value>,
    sensor: Option<Value>,
    id: Option<Value>,
    beyond: Option<Value>,
    #[serde(default, deserialize_with = "given")]
    on: Option<Value>,
    hold_s: Option<Value>,
    false_alarms_per_day: Option<Value>,
    only_on: Option<Value>,
}

/// A key that may be null, which differs from a key that is not there.
fn given<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Value>, D::Error> {
    Value::deserialize(deserializer).map(Some)
}

impl JsonLine {
    /// The keys of a sensor's report.
    fn report(&mut self) -> [(&'static str, Option<Value>); 6] {
        [
            ("id", self.id.take()),
            ("beyond", self.beyond.take()),
            ("on", self.on.take()),
            ("hold_s", self.hold_s.take()),
            ("false_alarms_per_day", self.false_alarms_per_day.take()),
            ("only_on", self.only_on.take()),
        ]
    }

    /// The report of a line with the key `sensor`.
    fn sensor(&mut self) -> Result<Option<String>, LineError> {
        let Some(kind) = self.sensor.take() else {
            let mut keys = self.report().into_iter();
            return match keys.find(|(_, value)| value.is_some()) {
                Some((key, _)) => {
                    Err(reason(&format!("\"{key}\" goes with \"sensor\"; give \"sensor\" or leave it out")))
                }
                None => Ok(None),
            };
        };
        if self.text.is_some() || self.presence.is_some() || self.kind.is_some() || self.count.is_some() {
            return Err(reason("\"sensor\" excludes \"text\", \"kind\", \"presence\" and \"count\"; send two lines"));
        }
        let mut keys = serde_json::Map::from_iter([("sensor".to_owned(), kind)]);
        let room = [("room", self.room.take())];
        for (key, value) in room.into_iter().chain(self.report()) {
            keys.extend(value.map(|value| (key.to_owned(), value)));
        }
        if !keys.contains_key("on") {
            return Err(reason("\"sensor\" needs \"on\": true, false, or null if the device is unavailable"));
        }
        let report = SensorReport::parse(&Value::Object(keys).to_string()).map_err(|fault| reason(&fault))?;
        Ok(Some(report.to_string()))
    }
}

impl Line {
    /// Reads one line: JSON if it opens with `{`, an action if with `[`, a device state or a sentence otherwise. `person` is the person of a
    /// line without one. JSON that is no object is refused.
    ///
    /// # Errors
    /// [`LineError`] with the key of a line of JSON, and the allowed values.
    pub fn read(line: &str, person: &Who) -> Result<Self, LineError> {
        let line = line.trim();
        if line.starts_with('{') {
            return Self::of_json(line, person);
        }
        if serde_json::from_str::<Value>(line).is_ok() {
            return Err(reason(
                "a line of JSON is an object, such as {\"text\": \"They sit down.\"}; a sentence stands without quotes",
            ));
        }
        let kind = Kind::of(line);
        kind.event(line)?;
        Ok(Self { kind, text: line.to_owned(), person: person.clone(), observed_unix_ns: None, count: 0 })
    }

    fn of_json(line: &str, person: &Who) -> Result<Self, LineError> {
        let mut json: JsonLine = serde_json::from_str(line).map_err(|error| reason(&json_of_one_line_says(&error)))?;
        let sensor = json.sensor()?;
        let is_sensor = sensor.is_some();
        let text = json.text.as_ref().map(|text| string("text", text)).transpose()?;
        let presence = json.presence.as_ref().map(|presence| string("presence", presence)).transpose()?;
        let (kind, text) = match (text, presence) {
            _ if is_sensor => (Kind::Presence, sensor.unwrap_or_default()),
            (Some(text), None) => {
                let kind = json.kind.as_ref().map_or_else(|| Ok(Kind::of(text)), kind_of)?;
                let room = json.room.as_ref().map(|room| string("room", room)).transpose()?;
                (kind, room.map_or_else(|| Ok(text.trim().to_owned()), |room| said_in(kind, text.trim(), room))?)
            }
            (None, Some(presence)) if json.kind.is_none() => {
                let room = json.room.as_ref().map(|room| string("room", room)).transpose()?;
                (Kind::Presence, statement(presence, room)?.to_string())
            }
            (Some(_), Some(_)) => {
                return Err(reason("\"text\" and \"presence\" exclude each other; send two lines"));
            }
            (None, None) => return Err(reason("give \"text\", \"presence\" or \"sensor\"")),
            (None, Some(_)) => return Err(reason("\"kind\" goes with \"text\", and not with \"presence\"")),
        };
        let own = json.person.as_ref().filter(|person| !person.is_null());
        let has_person = kind.event(&text)?.has_person();
        let person = match own {
            Some(_) if !has_person && !is_sensor => {
                return Err(reason("an empty room or house has no person; leave \"person\" out"));
            }
            Some(own) => {
                Who::deserialize(own).map_err(|error| reason(&format!("\"person\": {}", json_says(&error))))?
            }
            None if has_person => person.clone(),
            None => Who::Somebody,
        };
        let count = json.count.as_ref().map_or(Ok(0), count_of)?;
        let person = if count > 1 && own.is_none() { Who::Somebody } else { person };
        if count > 1 && (own.is_some() || !has_person) {
            return Err(reason("\"count\" counts unknown persons; leave \"person\" out, or \"count\""));
        }
        let observed_unix_ns = json.observed_unix_s.as_ref().map(unix_ns).transpose()?;
        Ok(Self { kind, text, person, observed_unix_ns, count })
    }

    /// The line, unless its time lies further ahead than clocks differ ([`AHEAD_NS`]).
    ///
    /// # Errors
    /// [`LineError`] with how far ahead that is.
    pub fn observed_by(self, now_unix_ns: UnixNs) -> Result<Self, LineError> {
        match self.observed_unix_ns {
            Some(observed_ns) if observed_ns > now_unix_ns.saturating_add(AHEAD_NS) => {
                let (ahead_s, most_s) = (observed_ns.since(now_unix_ns) as f64 / 1e9, AHEAD_NS / 1_000_000_000);
                Err(reason(&format!(
                    "\"observed_unix_s\" lies {ahead_s:.0} s ahead, at most {most_s} s are allowed: set the clock of the machine that gives it (NTP), or leave the key out for now"
                )))
            }
            _ => Ok(self),
        }
    }
}

fn kind_of(value: &Value) -> Result<Kind, LineError> {
    const ALLOWED: &str = "\"sentence\", \"action\", \"device\" or \"presence\"";
    Kind::deserialize(value).map_err(|_| key_error("kind", value, ALLOWED))
}

/// A number of persons.
fn count_of(value: &Value) -> Result<u8, LineError> {
    let count = value.as_u64().and_then(|count| u8::try_from(count).ok());
    count
        .filter(|count| (1..=COUNT_MAX).contains(count))
        .ok_or_else(|| key_error("count", value, &format!("a number of persons from 1 to {COUNT_MAX}")))
}

/// A sentence with the room of its camera: the room's name ends the text, unless the text has it. A presence form stays as it is.
fn said_in(kind: Kind, text: &str, room: &str) -> Result<String, LineError> {
    let room = RoomName::new(room).map_err(ObservedError::from)?.as_str().replace('_', " ");
    if !matches!(kind, Kind::Sentence | Kind::Device) || DeviceState::parse(text).is_some() {
        return Err(reason("\"room\" goes with a sentence; an action, a device or a presence names its own room"));
    }
    if form_of(text).is_some() || has_words(&text.to_lowercase(), &room.to_lowercase()) {
        return Ok(text.to_owned());
    }
    Ok(format!("{} in the {room}.", text.trim_end_matches(['.', '!', '?'])))
}

/// The presence that the keys of a line state.
fn statement(presence: &str, room: Option<&str>) -> Result<Event, LineError> {
    let room = room.map(RoomName::new).transpose().map_err(ObservedError::from)?;
    let event = match presence {
        "present" => return Ok(Event::Present(room)),
        "empty" => {
            let room = room.ok_or_else(|| reason("\"presence\": \"empty\" needs a \"room\""))?;
            return Ok(Event::Empty(room));
        }
        "away" => Event::Away,
        "gone" => Event::Gone,
        _ => {
            let allowed = "\"present\", \"away\", \"gone\" or \"empty\"";
            return Err(key_error("presence", &presence.into(), allowed));
        }
    };
    match room {
        Some(_) => {
            Err(reason("\"room\" goes with \"presence\": \"present\" or \"empty\" alone; leave one of them out"))
        }
        None => Ok(event),
    }
}

/// Whole nanoseconds of seconds since 1970; the caller checks for future times.
fn unix_ns(value: &Value) -> Result<UnixNs, LineError> {
    const ALLOWED: &str = "seconds since 1970, as in 1709280900.5, or leave it out for now";
    match value.as_f64() {
        // About the year 2500. 0 is what a clock that was never set says.
        Some(seconds) if (1.0..=1.7e10).contains(&seconds) => Ok(UnixNs((seconds * 1e9) as u64)),
        _ => Err(key_error("observed_unix_s", value, ALLOWED)),
    }
}

fn string<'a>(key: &str, value: &'a Value) -> Result<&'a str, LineError> {
    value.as_str().ok_or_else(|| key_error(key, value, "a text"))
}

fn key_error(key: &str, value: &Value, allowed: &str) -> LineError {
    let mut shown = value.to_string();
    if let Some((end, _)) = shown.char_indices().nth(80) {
        shown.truncate(end);
    }
    reason(&format!("\"{key}\" is {shown}; give {allowed}"))
}

fn reason(reason: &str) -> LineError {
    LineError::Json { reason: reason.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences_of_a_camera_end_with_its_room() {
        for (text, room, expected) in [
            ("A woman is chopping vegetables.", "living_room", "A woman is chopping vegetables in the living room."),
            ("A woman sits on the sofa", "the hall", "A woman sits on the sofa in the hall."),
            ("They walk through the Living Room!", "living_room", "They walk through the Living Room!"),
            ("Ada leaves the house.", "hall", "Ada leaves the house."),
            ("A woman is studying.", "study", "A woman is studying in the study."),
        ] {
            let json = serde_json::json!({ "text": text, "room": room }).to_string();
            assert_eq!(Line::read(&json, &Who::Somebody).unwrap().text, expected);
        }
    }

    #[test]
    fn a_refused_line_forges_no_line_of_a_log() {
        let keys = [r"\u001b[2J", r"a\nWARN forged", r"\u202e", r"\r"];
        for key in keys {
            let refused = Line::read(&format!(r#"{{"{key}": 1}}"#), &Who::Somebody).unwrap_err().to_string();
            assert!(!refused.contains(is_hidden) && refused.contains("\\u"), "{refused}");
        }
    }

    /// A name with letters that fits was refused for having none, or for being too long.
    #[test]
    fn of_a_name_that_hides_something_it_is_said_what() {
        for (hidden, code) in [('\u{200d}', "U+200D"), ('\u{feff}', "U+FEFF"), ('\u{7}', "U+0007")] {
            let line = serde_json::json!({ "text": "They sit.", "person": format!("Zoë{hidden}A") }).to_string();
            let refused = Line::read(&line, &Who::Somebody).unwrap_err().to_string();
            assert!(refused.contains("holds the control character") && refused.contains(code), "{refused}");
            assert!(!refused.contains(hidden), "{refused}");
        }
        let refused = "!".parse::<Who>().unwrap_err().to_string();
        assert!(refused.contains("is no person"), "{refused}");
    }

    fn item(line: &str) -> Result<Line, LineError> {
        Line::read(line, &Who::Number(PersonId(3)))
    }

    fn said(kind: Kind, text: &str, person: Who) -> Line {
        Line { kind, text: text.to_owned(), person, observed_unix_ns: None, count: 0 }
    }

    #[test]
    fn every_form_of_line_becomes_an_item() {
        let sentence = |text, person| said(Kind::Sentence, text, person);
        assert_eq!(item("They sit down.").unwrap(), sentence("They sit down.", Who::Number(PersonId(3))));
        let action = said(Kind::Action, "[Grab] <mug> (1)", Who::Number(PersonId(3)));
        assert_eq!(item("[Grab] <mug> (1)").unwrap(), action);
        let form = sentence("The kitchen is empty.", Who::Number(PersonId(3)));
        assert_eq!(item("The kitchen is empty.").unwrap(), form);
        let device = said(Kind::Device, "the oven is on", Who::Number(PersonId(3)));
        assert_eq!(item("the oven is on").unwrap(), device);
        // The daemon reads a presence form; the line keeps its text.
        assert_eq!(item("Ada leaves the house.").unwrap(), sentence("Ada leaves the house.", Who::Number(PersonId(3))));
        for (json, person) in [
            (r#"{"text": "They sit down.", "person": 9}"#, Who::Number(PersonId(9))),
            (r#"{"text": "They sit down.", "person": "9"}"#, Who::Number(PersonId(9))),
            (r#"{"text": "They sit down.", "person": " Ada "}"#, Who::Name("Ada".to_owned())),
            (r#"{"text": "They sit down.", "person": null}"#, Who::Number(PersonId(3))),
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
            (r#"{"presence": "gone", "person": 7}"#, "gone", Who::Number(PersonId(7))),
            (r#"{"presence": "present"}"#, "present", Who::Number(PersonId(3))),
            (r#"{"presence": "present", "room": "kitchen"}"#, "present in the kitchen", Who::Number(PersonId(3))),
            (r#"{"text": "away", "kind": "presence", "person": "ada"}"#, "away", Who::Name("ada".to_owned())),
            (r#"{"text": " nobody in the hall", "kind": "presence"}"#, "nobody in the hall", Who::Somebody),
            (
                r#"{"presence": "present", "room": "the living room"}"#,
                "present in the living room",
                Who::Number(PersonId(3)),
            ),
        ] {
            assert_eq!(item(json).unwrap(), said(Kind::Presence, text, person), "{json}");
        }
    }

    #[test]
    fn an_error_names_the_key_and_what_is_allowed() {
        for (json, part) in [
            (
                "{\"txt\": \"a\"}",
                "unknown key `txt` (did you mean `text`?), expected one of `text`, `kind`, `presence`, `room`, `person`",
            ),
            ("{\"text\": \"They sit.\"", "at column 20"),
            ("{}", "give \"text\", \"presence\" or \"sensor\""),
            (r#"{"text": 3}"#, "\"text\" is 3; give a text"),
            (r#"{"text": "They sit.", "kind": "word"}"#, "\"kind\" is \"word\"; give \"sentence\", \"action\","),
            (r#"{"text": "They sit.", "presence": "away"}"#, "\"text\" and \"presence\" exclude each other"),
            (r#"{"text": "[Walk] <hall> (1)", "room": "hall"}"#, "\"room\" goes with a sentence"),
            (r#"{"text": "the lamp is on", "room": "hall"}"#, "\"room\" goes with a sentence"),
            (r#"{"text": "They sit.", "room": ""}"#, "is no presence"),
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
            (r#"{"presence": "empty", "room": "hall", "person": "ada"}"#, "has no person; leave \"person\" out"),
            (r#"{"text": "nobody in the hall", "kind": "presence", "person": 3}"#, "leave \"person\" out"),
            (r#"{"presence": "unknown"}"#, "\"presence\" is \"unknown\""),
            (r#"{"text": "They sit.", "count": 0}"#, "\"count\" is 0; give a number of persons from 1 to 8"),
            (r#"{"text": "They sit.", "count": 10000}"#, "\"count\" is 10000; give a number of persons"),
            (r#"{"text": "They sit.", "count": "two"}"#, "\"count\" is \"two\"; give a number of persons"),
            (r#"{"text": "They sit.", "count": 2, "person": "ada"}"#, "\"count\" counts unknown persons"),
            (r#"{"sensor": "motion", "id": "a", "room": "hall"}"#, "\"sensor\" needs \"on\""),
            (r#"{"sensor": "motion", "id": "a", "on": true}"#, "needs the \"room\""),
            (r#"{"sensor": "motion", "id": "a", "room": "hall", "on": true, "text": "a"}"#, "\"sensor\" excludes"),
            (r#"{"text": "They sit.", "on": true}"#, "\"on\" goes with \"sensor\""),
            (r#"{"presence": "away", "kind": "sentence"}"#, "\"kind\" goes with \"text\""),
            (r#"{"text": "They sit.", "person": -1}"#, "\"person\": the number `-1`, expected a person's"),
            (r#"{"text": "They sit.", "person": 4294967295}"#, "number from 0 to 4294967294, or name"),
            (r#"{"text": "They sit.", "person": 1.5}"#, "\"person\": the number `1.5`"),
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
        const MANUAL: &str = include_str!("../../../docs/json-lines.md");
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
        for key in [
            "text",
            "kind",
            "presence",
            "room",
            "person",
            "count",
            "observed_unix_s",
            "sensor",
            "id",
            "on",
            "beyond",
            "hold_s",
            "false_alarms_per_day",
            "only_on",
        ] {
            assert!(examples.iter().any(|line| line.contains(&format!("\"{key}\":"))), "{key}");
        }
        // Reports are another command's, which refuses narration as this one refuses them.
        let reports = manual("report");
        assert_eq!(reports.len(), 12);
        for line in reports {
            serde_json::from_str::<serde_json::Map<String, Value>>(line).unwrap();
            assert!(item(line).unwrap_err().to_string().contains("unknown key `report`"), "{line}");
        }
    }

    #[test]
    fn a_time_of_observation_is_kept_to_the_microsecond() {
        let item = item(r#"{"text": "They sit.", "observed_unix_s": 1709280900.5}"#).unwrap();
        assert_eq!(item.observed_unix_ns, Some(UnixNs(1_709_280_900_500_000_000)));
    }

    #[test]
    fn a_time_further_ahead_than_clocks_differ_is_refused_with_the_remedy() {
        let by = |observed_s: u64, now_ns| {
            let line = item(&format!(r#"{{"text": "They sit.", "observed_unix_s": {observed_s}}}"#)).unwrap();
            line.observed_by(now_ns)
        };
        let error = by(62, UnixNs(1_000_000_000)).unwrap_err().to_string();
        assert!(
            error.contains("\"observed_unix_s\" lies 61 s ahead, at most 60 s are allowed: set the clock"),
            "{error}"
        );
        by(61, UnixNs(1_000_000_000)).unwrap();
    }

    #[test]
    fn who_it_is_goes_through_json() {
        for (who, json) in [
            (Who::Somebody, "null"),
            (Who::Number(PersonId(7)), "7"),
            (Who::Name("Ada".to_owned()), "\"Ada\""),
            (Who::Number(PersonId(7)), "\" 7\""),
        ] {
            assert_eq!(serde_json::from_str::<Who>(json).unwrap(), who, "{json}");
            assert_eq!(serde_json::from_value::<Who>(serde_json::to_value(&who).unwrap()).unwrap(), who);
        }
        assert_eq!(Who::from(PersonId::SOMEBODY), Who::Somebody);
        for refused in ["", " ", "...", "4294967295", "a\u{202e}b", "me", &"a".repeat(49)] {
            refused.parse::<Who>().unwrap_err();
        }
    }

    #[test]
    fn bytes_are_a_line() {
        let longest = " ".repeat(LINE_BYTES_MAX as usize - 2) + "a\n";
        assert_eq!(text_of(longest.as_bytes(), false), Ok(Some(longest.as_str())));
        for none in [format!(" {longest}").as_bytes(), b"\xff\n"] {
            assert_eq!(text_of(none, true), Err(LineError::NoLine));
        }
        let marked = "\u{feff}They sit.\n";
        assert_eq!(text_of(marked.as_bytes(), true), Ok(Some("They sit.\n")));
        assert_eq!(text_of(marked.as_bytes(), false), Ok(Some(marked)));
        for blank in ["", "\n", " \r\n", "\u{feff}\n"] {
            assert_eq!(text_of(blank.as_bytes(), true), Ok(None));
        }
    }
}
