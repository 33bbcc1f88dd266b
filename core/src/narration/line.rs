//! One line of narration: a sentence, an action, a device's state, or a JSON object with person, time or presence.
//! `docs/json-lines.md` is the manual. Narrators, hubs and ROS 2 all read their lines here, so that none takes what another one refuses.

use std::str::FromStr;

use serde::de::{Deserialize, Deserializer, Error};
use serde_json::Value;

use super::forms::{COUNT_MAX, form_of};
use super::{Action, Event, RoomName, SensorReport, Sentence, TextError, check_name, device_state, is_number};
use crate::ids::{PersonId, UnixNs};
use crate::parsing::{json_of_one_line_says, json_says};
use crate::text::{has_words, without_mark};

/// Longest line, in bytes, its end included.
pub const LINE_BYTES_MAX: u64 = 8192;
/// How far a time of observation may lie ahead: the clocks of cameras differ. The daemon takes such an event as observed now.
pub const AHEAD_NS: u64 = 60_000_000_000;

/// How a text is read. Messages have the numbers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, strum::FromRepr, serde::Serialize, serde::Deserialize)]
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
    /// The kind of a text that stands alone: an action if it opens with `[`, a device's state if it reads "the ... is ...", else a sentence.
    #[must_use]
    pub fn of(text: &str) -> Self {
        match text.trim_start().starts_with('[') {
            true => Self::Action,
            // "The kitchen is empty." is a presence form.
            false if device_state(text).is_some() && form_of(text).is_none() => Self::Device,
            false => Self::Sentence,
        }
    }

    /// The event of a text of this kind. A sentence may still be a presence form; the daemon decides that, since it knows names and
    /// rooms. Narrators ask this before they send, so that they send nothing that the daemon refuses.
    ///
    /// # Errors
    /// The text's fault, as this kind.
    pub fn event(self, text: &str) -> Result<Event, TextError> {
        Ok(match self {
            Self::Presence => Event::presence(text)?,
            Self::Action => Event::Did(Sentence::new(&Action::parse(text)?.sentence())?),
            Self::Device | Self::Sentence => Event::Did(Sentence::new(text)?),
        })
    }
}

/// The person of an event; null in JSON for somebody.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(untagged)]
pub enum Who {
    /// Somebody: the daemon attributes the event by fit.
    #[default]
    Somebody,
    /// The person of this number.
    Number(PersonId),
    /// The person of this name, which has letters or digits and fits into a message.
    Name(String),
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
}

impl From<PersonId> for Who {
    fn from(number: PersonId) -> Self {
        if number == PersonId::SOMEBODY { Self::Somebody } else { Self::Number(number) }
    }
}

impl FromStr for Who {
    type Err = TextError;

    /// A number, or else a name.
    fn from_str(text: &str) -> Result<Self, TextError> {
        let text = text.trim();
        match text.parse() {
            Ok(number) if number != PersonId::SOMEBODY && is_number(text) => Ok(Self::Number(number)),
            _ => check_name(text).map(|()| Self::Name(text.to_owned())).map_err(TextError),
        }
    }
}

impl<'de> Deserialize<'de> for Who {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let value = Value::deserialize(deserializer)?;
        match &value {
            Value::Null => return Ok(Self::Somebody),
            Value::String(text) => return text.parse().map_err(D::Error::custom),
            _ => {}
        }
        let number = value.as_u64().and_then(|number| u32::try_from(number).ok()).map(PersonId);
        let most = PersonId::SOMEBODY.0 - 1;
        let wrong = || D::Error::custom(format!("`{value}` is no person: give a number from 0 to {most}, or a name"));
        number.filter(|number| *number != PersonId::SOMEBODY).map(Self::Number).ok_or_else(wrong)
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

/// The text of a line's bytes, its end included; none of a blank line. What editors on Windows put before the first line is no part of it.
///
/// # Errors
/// A line that is too long, or not UTF-8.
pub fn text_of(bytes: &[u8], is_first: bool) -> Result<Option<&str>, TextError> {
    let text = std::str::from_utf8(bytes).ok().filter(|_| bytes.len() as u64 <= LINE_BYTES_MAX);
    let no_line = || TextError(format!("not a line of UTF-8 with at most {LINE_BYTES_MAX} bytes"));
    let text = text.ok_or_else(no_line)?;
    let text = if is_first { without_mark(text) } else { text };
    Ok(Some(text).filter(|text| !text.trim().is_empty()))
}

/// The keys of a line of JSON.
const KEYS: &str =
    "text kind presence room person count observed_unix_s sensor id on beyond hold_s false_alarms_per_day only_on";

/// A line of JSON. What its keys may hold is checked key by key, so that an error names the key.
#[derive(Debug, serde::Deserialize)]
struct JsonLine {
    text: Option<Value>,
    kind: Option<Value>,
    presence: Option<Value>,
    room: Option<Value>,
    person: Option<Value>,
    count: Option<Value>,
    observed_unix_s: Option<Value>,
    #[serde(flatten)]
    of_sensor: serde_json::Map<String, Value>,
}

impl JsonLine {
    /// The report of a line with the key `sensor`.
    fn sensor(&mut self) -> Result<Option<Event>, TextError> {
        let mut keys = std::mem::take(&mut self.of_sensor);
        if let Some(key) = keys.keys().find(|key| !KEYS.split(' ').any(|known| known == *key)) {
            let known = KEYS.replace(' ', "`, `");
            let error = format!("unknown field `{key}`, expected one of `{known}`");
            return reason(&json_of_one_line_says(&serde_json::Error::custom(error)));
        }
        if !keys.contains_key("sensor") {
            let stray = keys.keys().next();
            let fault = |key| reason(&format!("\"{key}\" goes with \"sensor\"; give \"sensor\" or leave it out"));
            return stray.map_or(Ok(None), fault);
        }
        if self.text.is_some() || self.presence.is_some() || self.kind.is_some() || self.count.is_some() {
            return reason("\"sensor\" excludes \"text\", \"kind\", \"presence\" and \"count\"; send two lines");
        }
        if !keys.contains_key("on") {
            return reason("\"sensor\" needs \"on\": true, false, or null if the device is unavailable");
        }
        keys.extend(self.room.take().map(|room| ("room".to_owned(), room)));
        let report = SensorReport::parse(&Value::Object(keys).to_string()).or_else(|fault| reason(&fault))?;
        Ok(Some(Event::Sensor(report.into())))
    }
}

impl Line {
    /// Reads one line: JSON if it opens with `{`, an action if with `[`, a device state or a sentence otherwise. `person` is the person of a
    /// line without one. JSON that is no object is refused.
    ///
    /// # Errors
    /// [`TextError`] with the key of a line of JSON, and the allowed values.
    pub fn read(line: &str, person: &Who) -> Result<Self, TextError> {
        let line = line.trim();
        if line.starts_with('{') {
            return Self::of_json(line, person);
        }
        if serde_json::from_str::<Value>(line).is_ok() {
            return reason(
                "a line of JSON is an object, such as {\"text\": \"They sit down.\"}; a sentence stands without quotes",
            );
        }
        let kind = Kind::of(line);
        kind.event(line)?;
        Ok(Self { kind, text: line.to_owned(), person: person.clone(), observed_unix_ns: None, count: 0 })
    }

    fn of_json(line: &str, person: &Who) -> Result<Self, TextError> {
        let mut json: JsonLine = serde_json::from_str(line).or_else(|error| reason(&json_of_one_line_says(&error)))?;
        let sensor = json.sensor()?;
        let of_key = |key, value: &Option<Value>| match value {
            Some(Value::String(text)) => Ok(Some(text.clone())),
            Some(value) => key_error(key, value, "a text"),
            None => Ok(None),
        };
        let (text, presence) = (of_key("text", &json.text)?, of_key("presence", &json.presence)?);
        let room = of_key("room", &json.room)?;
        let (kind, text) = match (sensor, text, presence) {
            (Some(report), ..) => (Kind::Presence, report.to_string()),
            (None, Some(text), None) => {
                let (text, kind) = (text.trim(), json.kind.as_ref().map(kind_of).transpose()?);
                let kind = kind.unwrap_or_else(|| Kind::of(text));
                (kind, room.map_or_else(|| Ok(text.to_owned()), |room| said_in(kind, text, &room))?)
            }
            (None, None, Some(presence)) if json.kind.is_none() => {
                (Kind::Presence, statement(&presence, room.as_deref())?.to_string())
            }
            (None, Some(_), Some(_)) => return reason("\"text\" and \"presence\" exclude each other; send two lines"),
            (None, None, None) => return reason("give \"text\", \"presence\" or \"sensor\""),
            (None, None, Some(_)) => return reason("\"kind\" goes with \"text\", and not with \"presence\""),
        };
        let event = kind.event(&text)?;
        let has_person = event.has_person();
        let own = json.person.as_ref().filter(|person| !person.is_null());
        if own.is_some() && !has_person && !matches!(event, Event::Sensor(_)) {
            return reason("an empty room or house has no person; leave \"person\" out");
        }
        let count = json.count.as_ref().map_or(Ok(0), count_of)?;
        if count > 1 && !has_person {
            return reason("an empty room or house has no person; leave \"count\" out");
        }
        if count > 1 && own.is_some() {
            return reason("\"count\" counts unknown persons; leave \"person\" out, or \"count\"");
        }
        if own.is_none() && matches!(&event, Event::Sensor(report) if report.kind == super::SensorKind::Phone) {
            return reason("\"phone\" is the phone of a person; give \"person\"");
        }
        let person = match own {
            Some(own) => {
                Who::deserialize(own).or_else(|error| reason(&format!("\"person\": {}", json_says(&error))))?
            }
            None if has_person && count <= 1 => person.clone(),
            None => Who::Somebody,
        };
        let observed_unix_ns = json.observed_unix_s.as_ref().map(unix_ns).transpose()?;
        Ok(Self { kind, text, person, observed_unix_ns, count })
    }

    /// The line, unless its time lies further ahead than clocks differ ([`AHEAD_NS`]).
    ///
    /// # Errors
    /// [`TextError`] with how far ahead that is.
    pub fn observed_by(self, now_unix_ns: UnixNs) -> Result<Self, TextError> {
        let ahead_ns = self.observed_unix_ns.map_or(0, |observed_ns| observed_ns.since(now_unix_ns));
        if ahead_ns > AHEAD_NS {
            let (ahead_s, most_s) = (ahead_ns as f64 / 1e9, AHEAD_NS / 1_000_000_000);
            return reason(&format!(
                "\"observed_unix_s\" lies {ahead_s:.0} s ahead, at most {most_s} s are allowed: set the clock of the machine that gives it (NTP), or leave the key out for now"
            ));
        }
        Ok(self)
    }
}

fn kind_of(value: &Value) -> Result<Kind, TextError> {
    const ALLOWED: &str = "\"sentence\", \"action\", \"device\" or \"presence\"";
    Kind::deserialize(value).or_else(|_| key_error("kind", value, ALLOWED))
}

fn count_of(value: &Value) -> Result<u8, TextError> {
    let count = (1..=COUNT_MAX).find(|count| value.as_u64() == Some((*count).into()));
    count.map_or_else(|| key_error("count", value, &format!("a number of persons from 1 to {COUNT_MAX}")), Ok)
}

/// A sentence with the room of its camera: the room's name ends the text, unless the text has it. A presence form stays as it is.
fn said_in(kind: Kind, text: &str, room: &str) -> Result<String, TextError> {
    let room = RoomName::new(room)?.as_str().replace('_', " ");
    if !matches!(kind, Kind::Sentence | Kind::Device) || device_state(text).is_some() {
        return reason("\"room\" goes with a sentence; an action, a device or a presence names its own room");
    }
    if form_of(text).is_some() || has_words(&text.to_lowercase(), &[&room.to_lowercase()]) {
        return Ok(text.to_owned());
    }
    Ok(format!("{} in the {room}.", text.trim_end_matches(['.', '!', '?'])))
}

/// The presence that the keys of a line state.
fn statement(presence: &str, room: Option<&str>) -> Result<Event, TextError> {
    match (presence, room.map(RoomName::new).transpose()?) {
        ("present", room) => Ok(Event::Present(room)),
        ("empty", Some(room)) => Ok(Event::Empty(room)),
        ("empty", None) => reason("\"presence\": \"empty\" needs a \"room\""),
        ("away" | "gone", None) => Event::presence(presence),
        ("away" | "gone", Some(_)) => {
            reason("\"room\" goes with \"presence\": \"present\" or \"empty\" alone; leave one of them out")
        }
        _ => key_error("presence", &presence.into(), "\"present\", \"away\", \"gone\" or \"empty\""),
    }
}

fn unix_ns(value: &Value) -> Result<UnixNs, TextError> {
    match value.as_f64() {
        // About the year 2500. 0 is what a clock that was never set says.
        Some(seconds) if (1.0..=1.7e10).contains(&seconds) => Ok(UnixNs((seconds * 1e9) as u64)),
        _ => key_error("observed_unix_s", value, "seconds since 1970, as in 1709280900.5, or leave it out for now"),
    }
}

fn key_error<T>(key: &str, value: &Value, allowed: &str) -> Result<T, TextError> {
    let shown: String = value.to_string().chars().take(80).collect();
    reason(&format!("\"{key}\" is {shown}; give {allowed}"))
}

fn reason<T>(reason: &str) -> Result<T, TextError> {
    Err(TextError(format!("{reason}; docs/json-lines.md has every key with an example")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::text::is_hidden;

    #[test]
    fn a_refused_line_forges_no_line_of_a_log_and_names_a_hidden_character() {
        for key in [r"\u001b[2J", r"a\nWARN forged", r"\u202e", r"\r"] {
            let refused = item(&format!(r#"{{"{key}": 1}}"#)).unwrap_err().to_string();
            assert!(!refused.contains(is_hidden) && refused.contains("\\u"), "{refused}");
        }
        for (hidden, code) in [('\u{200d}', "U+200D"), ('\u{feff}', "U+FEFF"), ('\u{7}', "U+0007")] {
            let line = serde_json::json!({ "text": "They sit.", "person": format!("Zoë{hidden}A") }).to_string();
            let refused = item(&line).unwrap_err().to_string();
            assert!(refused.contains("holds the control character") && refused.contains(code), "{refused}");
            assert!(!refused.contains(hidden), "{refused}");
        }
    }

    fn item(line: &str) -> Result<Line, TextError> {
        Line::read(line, &Who::Number(PersonId(3)))
    }

    /// `tests/data/lines.json` has the other lines.
    #[test]
    fn lines_have_the_default_person_unless_they_count_persons_or_are_about_a_room() {
        for (line, person) in [
            ("They sit down.", Who::Number(PersonId(3))),
            ("[Grab] <mug> (1)", Who::Number(PersonId(3))),
            (r#"{"text": "They sit down.", "person": null}"#, Who::Number(PersonId(3))),
            (r#"{"presence": "present"}"#, Who::Number(PersonId(3))),
            (r#"{"text": "They sit down.", "count": 2}"#, Who::Somebody),
            (r#"{"room": "the hall", "presence": "empty"}"#, Who::Somebody),
            (r#"{"text": "They sit down.", "person": " Ada "}"#, Who::Name("Ada".to_owned())),
        ] {
            assert_eq!(item(line).unwrap().person, person, "{line}");
        }
    }

    #[test]
    fn an_error_names_the_key_and_what_is_allowed() {
        const REFUSED: &str = r#"
            {"txt": "a"} => unknown key `txt` (did you mean `text`?), expected one of `text`, `kind`, `presence`, `room`, `person`
            {"text": "They sit." => at column 20
            {} => give "text", "presence" or "sensor"
            {"text": 3} => "text" is 3; give a text
            {"text": "They sit.", "kind": "word"} => "kind" is "word"; give "sentence", "action",
            {"text": "They sit.", "presence": "away"} => "text" and "presence" exclude each other
            {"text": "[Walk] <hall> (1)", "room": "hall"} => "room" goes with a sentence
            {"text": "They sit.", "room": ""} => is no presence
            {"presence": "away", "room": "hall"} => "room" goes with "presence": "present" or "empty" alone
            {"presence": "present", "room": 3} => "room" is 3; give a text
            {"presence": "asleep"} => "presence" is "asleep"; give "present", "away", "gone" or "empty"
            {"presence": "empty"} => "presence": "empty" needs a "room"
            {"presence": "empty", "room": "hall", "person": "ada"} => has no person; leave "person" out
            {"text": "They sit.", "count": 0} => "count" is 0; give a number of persons from 1 to 8
            {"text": "They sit.", "count": 2, "person": "ada"} => "count" counts unknown persons
            {"sensor": "motion", "id": "a", "room": "hall"} => "sensor" needs "on"
            {"sensor": "motion", "id": "a", "on": true} => needs the "room"
            {"sensor": "motion", "id": "a", "room": "", "on": true} => "" is no room: give a room's id
            {"sensor": "motion", "id": "a", "room": "hall", "on": true, "text": "a"} => "sensor" excludes
            {"text": "They sit.", "on": true} => "on" goes with "sensor"
            {"presence": "away", "kind": "sentence"} => "kind" goes with "text"
            {"text": "They sit.", "person": -1} => "person": `-1` is no person
            {"text": "They sit.", "person": 4294967295} => number from 0 to 4294967294, or a name
            {"text": "They sit.", "person": 1.5} => "person": `1.5` is no person
            {"text": "They sit.", "person": ""} => "person": "" is no name
            {"text": "They sit.", "person": "-3"} => "person": "-3" is a number
            {"text": "They sit.", "observed_unix_s": "noon"} => "observed_unix_s" is "noon"; give seconds
            null => a line of JSON is an object
            "They sit." => a sentence stands without quotes"#;
        for (json, part) in REFUSED.trim().lines().map(|row| row.split_once(" => ").unwrap()) {
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
        for key in KEYS.split(' ') {
            assert!(examples.iter().any(|line| line.contains(&format!("\"{key}\":"))), "{key}");
        }
        // Reports are another command's, which refuses narration as this one refuses them.
        let reports = manual("report");
        assert_eq!(reports.len(), 12);
        for line in reports {
            serde_json::from_str::<serde_json::Map<String, Value>>(line).unwrap();
            assert!(item(line).unwrap_err().to_string().contains("unknown key `"), "{line}");
        }
    }

    #[test]
    fn times_are_kept_to_the_microsecond_and_not_far_ahead() {
        let of = |seconds: f64| item(&format!(r#"{{"text": "They sit.", "observed_unix_s": {seconds}}}"#)).unwrap();
        assert_eq!(of(1_709_280_900.5).observed_unix_ns, Some(UnixNs(1_709_280_900_500_000_000)));
        let by = |seconds: f64| of(seconds).observed_by(UnixNs(1_000_000_000)).map_err(|error| error.to_string());
        by(61.0).unwrap();
        let error = by(62.0).unwrap_err();
        assert!(error.contains("lies 61 s ahead, at most 60 s are allowed: set the clock"), "{error}");
    }

    #[test]
    fn who_it_is_goes_through_json() {
        let name = Who::Name("Ada".to_owned());
        for (who, json) in [(Who::Somebody, "null"), (Who::Number(PersonId(7)), "\" 7\""), (name, "\"Ada\"")] {
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
            text_of(none, true).unwrap_err();
        }
    }
}
