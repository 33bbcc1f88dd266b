//! The common part of rules of MQTT and of sensor logs: a sentence, a presence or the state of a sensor, its person, and the silence before it.
//!
//! A value in braces comes from outside. In `say` it stays inside its sentence ([`inside`]), and the line has [`FILLED_KIND`], unless the
//! placeholder stands for a name or a room in a presence form.

use std::time::Duration;

use roomcast_core::narration::SensorKind;
use roomcast_core::narration::forms::{COUNT_MAX, form_of};
use serde_json::{Map, Value};

use crate::condition::State;
use crate::line::{LINE_BYTES_MAX, Who, line_item};

/// Longest silence that a rule may wait for, in seconds: a week.
const QUIET_S_MAX: f64 = 604_800.0;

/// The kind of a line with values in its text: a device's state, in any words. A line of this kind never sets presence.
const FILLED_KIND: &str = "device";

#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub(crate) enum Whereabouts {
    Present,
    /// Out of the house, and expected back.
    Away,
    /// Out of the house, and not expected back.
    Gone,
    Empty,
}

/// The keys that both kinds of rules have, as they stand in a file.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Keys<'a> {
    pub(crate) say: Option<&'a str>,
    pub(crate) presence: Option<Whereabouts>,
    pub(crate) sensor: Option<SensorKind>,
    pub(crate) room: Option<&'a str>,
    pub(crate) person: Option<&'a Who>,
    pub(crate) count: Option<&'a Value>,
    pub(crate) quiet_s: Option<f64>,
    pub(crate) device: Device<'a>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Device<'a> {
    pub(crate) id: Option<&'a str>,
    pub(crate) beyond: Option<&'a str>,
    pub(crate) hold_s: Option<f64>,
    pub(crate) false_alarms_per_day: Option<f64>,
    pub(crate) only_on: bool,
}

/// The class of a rule's event. A value gives at most one event of each class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Class {
    Sentence,
    Presence,
    Sensor(SensorKind),
}

/// The event of a rule: a sentence, a presence or the state of a sensor. Names in braces are placeholders for values of its message or
/// interval.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Saying {
    pub(crate) class: Class,
    pub(crate) only_on: bool,
    keys: Map<String, Value>,
    quiet: Option<Duration>,
    /// The presence form of a sentence if all its placeholders stand for a name or a room.
    form: Option<&'static str>,
}

impl Saying {
    /// Checks the keys; `names` may stand in braces.
    ///
    /// # Errors
    ///
    /// The wrong key, and the allowed values.
    pub(crate) fn new(keys: Keys<'_>, names: &[String]) -> Result<Self, String> {
        let Keys { say, presence, sensor, room, person, count, quiet_s, device } = keys;
        let class = match (say, presence, sensor) {
            (None, None, None) => {
                let text = "give say, presence or the state of a sensor: \"as\" in the rules of a log, \"sensor\" in those of MQTT";
                return Err(text.to_owned());
            }
            (Some(say), None, None) if say.trim().is_empty() => return Err("say is empty".to_owned()),
            (Some(_), None, None) => Class::Sentence,
            (None, Some(_), None) => Class::Presence,
            (None, None, Some(kind)) => Class::Sensor(kind),
            (Some(_), Some(_), None) => {
                return Err("say and presence exclude each other; make two rules of it".to_owned());
            }
            (_, _, Some(_)) => {
                return Err("the state of a sensor excludes say and presence; make two rules of it".to_owned());
            }
        };
        let person = person.map_or(Value::Null, |person| serde_json::json!(person));
        match class {
            Class::Sensor(kind) => check_sensor(kind, &keys)?,
            _ if device != Device::default() => {
                return Err(
                    "id, beyond, hold_s, false_alarms_per_day and only_on go with the state of a sensor".to_owned()
                );
            }
            _ => {}
        }
        if room.is_some() && matches!(presence, Some(Whereabouts::Away | Whereabouts::Gone)) {
            return Err("room goes with say, a sensor, and presence = \"present\" or \"empty\"".to_owned());
        }
        if presence == Some(Whereabouts::Empty) && (room.is_none() || !person.is_null()) {
            return Err(
                "presence = \"empty\" says that nobody is in a room: it needs room, and has no person".to_owned()
            );
        }
        let mut written = Map::new();
        for (key, said, value) in [
            ("text", "say", say.map(Value::from)),
            ("presence", "presence", presence.map(|presence| <&str>::from(presence).into())),
            ("sensor", "sensor", sensor.map(|kind| kind.to_string().into())),
            ("id", "id", device.id.map(Value::from)),
            ("room", "room", room.map(Value::from)),
            ("beyond", "beyond", device.beyond.map(Value::from)),
            ("person", "person", Some(person).filter(|person| !person.is_null())),
            ("count", "count", count.cloned()),
            ("hold_s", "hold_s", device.hold_s.map(Value::from)),
            ("false_alarms_per_day", "false_alarms_per_day", device.false_alarms_per_day.map(Value::from)),
            ("only_on", "only_on", device.only_on.then_some(Value::Bool(true))),
        ] {
            let Some(value) = value else { continue };
            if let Some(text) = value.as_str() {
                check_names(text, names).map_err(|fault| format!("{said} {fault}"))?;
            }
            written.insert(key.to_owned(), value);
        }
        let quiet = quiet_s.map(|quiet_s| {
            let allowed = quiet_s > 0.0 && quiet_s <= QUIET_S_MAX;
            let quiet = Duration::try_from_secs_f64(quiet_s).ok().filter(|_| allowed);
            quiet.ok_or_else(|| format!("quiet_s is {quiet_s}; give seconds above 0, at most {QUIET_S_MAX}"))
        });
        let form = say.and_then(|say| form_of(&filled(say, usize::MAX, &|_| "value".to_owned())?));
        let saying = Self { class, only_on: device.only_on, keys: written, quiet: quiet.transpose()?, form };
        // Checked here, since this error can name the rule.
        let line = match class {
            Class::Sensor(_) => saying.report(Some(true), "1", |_| "1".to_owned()).unwrap_or_default(),
            _ => saying.line(|_| "1".to_owned()),
        };
        line_item(&line, &Who::Somebody).map_err(|error| error.to_string())?;
        Ok(saying)
    }

    pub(crate) fn quiet(&self) -> Option<Duration> {
        self.quiet
    }

    /// A key's text as given, with placeholders.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn text(&self, key: &str) -> Option<&str> {
        self.keys.get(key).and_then(Value::as_str)
    }

    /// The keys as given, with placeholders, as JSON.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn template(&self) -> String {
        Value::Object(self.keys.clone()).to_string()
    }

    /// The event's line of JSON, with the value of each name in braces.
    pub(crate) fn line(&self, value_of: impl Fn(&str) -> String) -> String {
        self.line_within(usize::MAX, &value_of).unwrap_or_default()
    }

    /// As [`Self::line`], but `None` if the line exceeds the limit of a line of narration. It stops before the line grows.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn short_line(&self, value_of: impl Fn(&str) -> String) -> Option<String> {
        let most = usize::try_from(LINE_BYTES_MAX).unwrap_or(usize::MAX);
        self.line_within(most, &value_of).filter(|line| line.len() <= most)
    }

    /// The line of JSON for a sensor's state; `None` if it exceeds the limit of a line. A rule without an id has the default one.
    pub(crate) fn report(&self, on: State, id: &str, value_of: impl Fn(&str) -> String) -> Option<String> {
        let most = usize::try_from(LINE_BYTES_MAX).unwrap_or(usize::MAX);
        let mut keys = self.filled_keys(most, &value_of)?;
        keys.entry("id").or_insert_with(|| id.into());
        keys.insert("on".to_owned(), on.into());
        Some(Value::Object(keys).to_string()).filter(|line| line.len() <= most)
    }

    fn line_within(&self, most: usize, value_of: &impl Fn(&str) -> String) -> Option<String> {
        self.filled_keys(most, value_of).map(|keys| Value::Object(keys).to_string())
    }

    fn filled_keys(&self, most: usize, value_of: &impl Fn(&str) -> String) -> Option<Map<String, Value>> {
        let mut keys = Map::new();
        for (key, value) in &self.keys {
            let value = match value.as_str() {
                Some(say) if key == "text" => {
                    let text = filled(say, most, &|name| inside(&value_of(name)))?;
                    let is_form = self.form.is_some() && form_of(&text) == self.form;
                    // An action's notation is never a presence.
                    if say.contains('{') && !say.starts_with('[') && !is_form {
                        keys.insert("kind".to_owned(), FILLED_KIND.into());
                    }
                    text.into()
                }
                Some(text) if key == "count" => counted(filled(text, most, value_of)?),
                Some(text) => filled(text, most, value_of)?.into(),
                None => value.clone(),
            };
            keys.insert(key.clone(), value);
        }
        Some(keys)
    }
}

fn check_sensor(kind: SensorKind, keys: &Keys<'_>) -> Result<(), String> {
    let has_person = keys.person.is_some_and(|person| !person.is_somebody());
    if kind == SensorKind::Phone && !has_person {
        return Err("a phone needs the person who carries it: give person".to_owned());
    }
    if keys.count.is_some() || keys.quiet_s.is_some() {
        return Err("count and quiet_s go with say or presence".to_owned());
    }
    // JSON has no such numbers, so the report itself would lack them.
    let Device { hold_s, false_alarms_per_day, .. } = keys.device;
    for (key, value) in [("hold_s", hold_s), ("false_alarms_per_day", false_alarms_per_day)] {
        if value.is_some_and(|value| !value.is_finite()) {
            return Err(format!("{key} is no finite number"));
        }
    }
    Ok(())
}

/// A number of persons in a message, limited to the most that a line may count.
fn counted(text: String) -> Value {
    match text.trim().parse::<u64>() {
        Ok(number) if number > 0 => number.min(COUNT_MAX.into()).into(),
        _ => text.into(),
    }
}

/// Quotation marks, brackets and the ends of sentences of other scripts: a value ends before each of them.
const ENDS: &str = "\"\u{201c}\u{201d}\u{201e}\u{201f}\u{2018}\u{201a}\u{201b}`\u{ab}\u{bb}\u{2039}\u{203a}\u{300c}\u{300d}\u{300e}\u{300f}\
    ()[]{}<>|!?;\u{2026}\u{203c}\u{2047}\u{2048}\u{2049}\u{3002}\u{ff0e}\u{ff61}\u{ff01}\u{ff1f}\u{ff1a}\u{ff1b}\u{964}\u{61f}\u{6d4}\u{61b}\u{1362}\u{2014}\
    \n\r\u{b}\u{c}\u{85}\u{2028}\u{2029}";

/// A value as it may stand inside a sentence. It ends before a quotation mark, a bracket, a line break or the end of a sentence. A full stop
/// between digits or between small letters ends none ("21.5", "a.m"), nor does a colon between digits or an apostrophe between letters.
fn inside(value: &str) -> String {
    let value =
        value.trim_start_matches(|c: char| c.is_whitespace() || c == '\'' || c == '\u{2019}' || ENDS.contains(c));
    let mut before = ' ';
    let mut rest = value.chars().peekable();
    let mut out = String::with_capacity(value.len());
    while let Some(character) = rest.next() {
        let after = rest.peek().copied().unwrap_or(' ');
        let between = |is: fn(&char) -> bool| is(&before) && is(&after);
        let stays = match character {
            '.' => between(char::is_ascii_digit) || between(|c| c.is_lowercase()),
            ':' => between(char::is_ascii_digit),
            '\'' | '\u{2019}' => between(|c| c.is_alphanumeric()),
            other => !ENDS.contains(other),
        };
        if !stays {
            break;
        }
        out.push(if character.is_whitespace() { ' ' } else { character });
        before = character;
    }
    out.truncate(out.trim_end().len());
    out
}

/// The next name in braces: the text before it, the name, and the text after it. `None` without a brace, an error for a brace without its
/// partner.
fn next_name(text: &str) -> Option<Result<(&str, &str, &str), ()>> {
    let (before, rest) = text.split_at(text.find(['{', '}'])?);
    let inner = rest.strip_prefix('{').and_then(|rest| rest.split_once('}')).filter(|(name, _)| !name.contains('{'));
    Some(inner.map(|(name, after)| (before, name, after)).ok_or(()))
}

fn check_names(mut text: &str, names: &[String]) -> Result<(), String> {
    while let Some(next) = next_name(text) {
        let Ok((_, name, after)) = next else { return Err("has a brace alone; they stand around a name".to_owned()) };
        if !names.iter().any(|known| known == name) {
            let known: Vec<_> = names.iter().map(|name| format!("{{{name}}}")).collect();
            return Err(format!("has {{{name}}}; it knows {}", known.join(", ")));
        }
        text = after;
    }
    Ok(())
}

/// A checked text with the names' values. A brace in a value stays. `None` if the text would exceed `most` bytes.
fn filled(mut text: &str, most: usize, value_of: &impl Fn(&str) -> String) -> Option<String> {
    let mut out = String::with_capacity(text.len());
    while let Some(Ok((before, name, after))) = next_name(text) {
        out.push_str(before);
        out.push_str(&value_of(name));
        if out.len() > most {
            return None;
        }
        text = after;
    }
    out.push_str(text);
    (out.len() <= most).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::ids::PersonId;

    const NOTHING: Keys<'static> = Keys {
        say: None,
        presence: None,
        sensor: None,
        room: None,
        person: None,
        count: None,
        quiet_s: None,
        device: Device { id: None, beyond: None, hold_s: None, false_alarms_per_day: None, only_on: false },
    };

    fn names() -> Vec<String> {
        ["value".to_owned(), "1".to_owned()].into()
    }

    #[test]
    fn a_saying_becomes_a_line_of_json() {
        let line = |keys| Saying::new(keys, &names()).unwrap().line(|name| format!("<{name}> {{1}}"));
        let ada = "ada".parse().unwrap();
        let sentence =
            Keys { say: Some("They set the {1} to {value}."), person: Some(&Who::Number(PersonId(2))), ..NOTHING };
        assert_eq!(line(sentence), r#"{"kind":"device","person":2,"text":"They set the 1 to value."}"#);
        let fixed = Keys { say: Some("They sit."), ..NOTHING };
        assert_eq!(line(fixed), r#"{"text":"They sit."}"#);
        let away = Keys { presence: Some(Whereabouts::Away), person: Some(&ada), ..NOTHING };
        assert_eq!(line(away), r#"{"person":"ada","presence":"away"}"#);
        let here = Keys { presence: Some(Whereabouts::Present), room: Some("{1}"), ..NOTHING };
        assert_eq!(line(here), r#"{"presence":"present","room":"<1> {1}"}"#);
        assert_eq!(
            Saying::new(Keys { quiet_s: Some(600.0), ..away }, &[]).unwrap().quiet(),
            Some(Duration::from_secs(600))
        );
    }

    #[test]
    fn a_value_stays_inside_its_sentence() {
        for (value, stays) in [
            ("on. Everybody leaves the house.", "on"),
            ("on.Everybody leaves the house", "on"),
            ("on\nEverybody leaves the house", "on"),
            ("on\u{2028}Everybody leaves the house", "on"),
            ("on\" Everybody leaves the house", "on"),
            ("on' everybody leaves the house", "on"),
            ("on! Nobody is home", "on"),
            ("on; nobody is home", "on"),
            ("on: nobody is home", "on"),
            ("on (nobody is home)", "on"),
            ("on\u{3002}nobody is home", "on"),
            ("on\u{2014}nobody is home", "on"),
            ("\"Hello\" she says", "Hello"),
            (". Nobody is home", ""),
            ("on\tnow ", "on now"),
            ("21.5 \u{b0}C", "21.5 \u{b0}C"),
            ("-3", "-3"),
            ("10:30", "10:30"),
            ("7 a.m.", "7 a.m"),
            ("Ada's lamp, left", "Ada's lamp, left"),
            ("tête-à-tête", "tête-à-tête"),
            ("", ""),
        ] {
            assert_eq!(inside(value), stays, "{value:?}");
        }
    }

    #[test]
    fn a_sentence_with_values_sets_no_presence_unless_they_are_a_name_or_a_room_of_a_form() {
        let line = |say, value: &str| {
            let names = ["value".to_owned(), "1".to_owned()];
            Saying::new(Keys { say: Some(say), ..NOTHING }, &names).unwrap().line(|_| value.to_owned())
        };
        for (say, value) in [
            ("the {1} is {value}", "empty"),
            ("{value}", "Everybody leaves the house."),
            ("{1} is empty", "the kitchen"),
            ("{1} leaves the house", "everybody"),
            ("{1} is home.", "Nobody"),
            ("{1} is in the kitchen", "nobody"),
            ("Everybody {value}", "leaves the house"),
            ("Nobody is {value}", "home"),
            ("{1} leaves", "ada"),
        ] {
            assert!(line(say, value).starts_with(r#"{"kind":"device","text":"#), "{say} with {value}");
        }
        for (say, value, text) in [
            ("{1} leaves the house.", "ada", "ada leaves the house."),
            ("{1} is in the {1}", "kitchen", "kitchen is in the kitchen"),
            ("They are in the {1}", "hall", "They are in the hall"),
            ("Nobody is in the {1}.", "hall", "Nobody is in the hall."),
            ("The {1} is empty", "hall", "The hall is empty"),
            ("{1} comes home", "ada. Everybody leaves the house", "ada comes home"),
            ("Everybody leaves the house", "", "Everybody leaves the house"),
        ] {
            assert_eq!(line(say, value), format!(r#"{{"text":"{text}"}}"#));
        }
        assert_eq!(line("[Grab] <{1}> (1)", "mug"), r#"{"text":"[Grab] <mug> (1)"}"#);
    }

    #[test]
    fn a_fault_names_its_key() {
        let say = |say| Keys { say: Some(say), ..NOTHING };
        let away = Keys { presence: Some(Whereabouts::Away), ..NOTHING };
        for (keys, part) in [
            (NOTHING, "give say, presence or the state of a sensor: \"as\""),
            (say(" "), "say is empty"),
            (say("They use {2}."), "say has {2}; it knows {value}, {1}"),
            (say("They use {value."), "say has a brace alone"),
            (say("They use value}."), "say has a brace alone"),
            (say("[Fly] <mug> (1)"), "Fly"),
            (Keys { say: Some("They sit."), ..away }, "say and presence exclude each other"),
            (Keys { room: Some("hall"), ..away }, "and presence = \"present\""),
            (Keys { quiet_s: Some(0.0), ..away }, "quiet_s is 0; give seconds above 0, at most 604800"),
            (Keys { quiet_s: Some(f64::NAN), ..away }, "quiet_s is NaN"),
            (Keys { quiet_s: Some(1e300), ..away }, "quiet_s is 1"),
        ] {
            let error = Saying::new(keys, &names()).unwrap_err();
            assert!(error.contains(part), "{keys:?}: {error}");
        }
    }

    #[test]
    fn a_room_can_be_empty_and_nobody_in_particular_is_not_there() {
        let empty = Keys { presence: Some(Whereabouts::Empty), room: Some("{1}"), ..NOTHING };
        let line = Saying::new(empty, &names()).unwrap().line(|_| "hall".to_owned());
        assert_eq!(line, r#"{"presence":"empty","room":"hall"}"#);
        let ada = "ada".parse().unwrap();
        for keys in [Keys { room: None, ..empty }, Keys { person: Some(&ada), ..empty }] {
            let error = Saying::new(keys, &names()).unwrap_err();
            assert!(error.contains("needs room, and has no person"), "{error}");
        }
        let away = Keys { presence: Some(Whereabouts::Away), ..empty };
        assert!(Saying::new(away, &names()).unwrap_err().contains("\"present\" or \"empty\""));
    }

    #[test]
    fn a_line_that_is_too_long_is_given_up() {
        let say = Keys { say: Some("{value}, {value} and {1}"), ..NOTHING };
        let saying = Saying::new(say, &names()).unwrap();
        let of = |text: &str| saying.short_line(|_| text.to_owned());
        assert_eq!(of("x").as_deref(), Some(r#"{"kind":"device","text":"x, x and x"}"#));
        assert_eq!((of(&"x".repeat(3_000)), of(&"\u{1}".repeat(600))), (None, None), "as JSON they are longer");
        assert!(of(&"x".repeat(2_700)).is_some());
    }

    #[test]
    fn a_sensors_rule_becomes_its_report() {
        let mira = "Mira".parse().unwrap();
        let device = Device { hold_s: Some(90.0), false_alarms_per_day: Some(2.0), ..Device::default() };
        let bed = Keys { sensor: Some(SensorKind::Bed), room: Some("{1}"), person: Some(&mira), device, ..NOTHING };
        let report = |keys: Keys<'_>, on| {
            let names = ["1".to_owned()];
            Saying::new(keys, &names).unwrap().report(on, "beds/left", |_| "bedroom".to_owned()).unwrap()
        };
        assert_eq!(
            report(bed, Some(true)),
            r#"{"false_alarms_per_day":2.0,"hold_s":90.0,"id":"beds/left","on":true,"person":"Mira","room":"bedroom","sensor":"bed"}"#
        );
        let door = Device { id: Some("front"), beyond: Some("porch"), ..Device::default() };
        let door = Keys { sensor: Some(SensorKind::Door), room: Some("hall"), device: door, ..NOTHING };
        assert_eq!(report(door, None), r#"{"beyond":"porch","id":"front","on":null,"room":"hall","sensor":"door"}"#);
        let phone = Keys { sensor: Some(SensorKind::Phone), person: Some(&mira), ..NOTHING };
        assert_eq!(report(phone, Some(false)), r#"{"id":"beds/left","on":false,"person":"Mira","sensor":"phone"}"#);
        let motion = Keys { sensor: Some(SensorKind::Motion), room: Some("hall"), ..NOTHING };
        for (keys, fault) in [
            (Keys { person: None, ..phone }, "needs the person who carries it"),
            (Keys { room: Some("hall"), ..phone }, "a phone has no \"room\""),
            (Keys { room: None, ..motion }, "needs the \"room\" that it sees"),
            (Keys { say: Some("They sit."), ..motion }, "excludes say and presence"),
            (Keys { quiet_s: Some(5.0), ..motion }, "count and quiet_s go with say"),
            (Keys { device: Device { beyond: Some("a"), ..Device::default() }, ..motion }, "\"beyond\" goes with"),
            (
                Keys { device: Device { hold_s: Some(-1.0), ..Device::default() }, ..motion },
                "\"hold_s\" is out of range",
            ),
            (
                Keys { device: Device { hold_s: Some(f64::NAN), ..Device::default() }, ..motion },
                "hold_s is no finite number",
            ),
            (
                Keys { device: Device { false_alarms_per_day: Some(f64::INFINITY), ..Device::default() }, ..motion },
                "false_alarms_per_day is no finite number",
            ),
            (Keys { device: Device { id: Some("{2}"), ..Device::default() }, ..motion }, "id has {2}"),
            (Keys { say: Some("They sit."), device, ..NOTHING }, "go with the state of a sensor"),
        ] {
            let error = Saying::new(keys, &names()).unwrap_err();
            assert!(error.contains(fault), "{keys:?}: {error}");
        }
    }

    #[test]
    fn a_rule_counts_persons_by_a_number_or_by_its_message() {
        let two = serde_json::json!(2);
        let value = serde_json::json!("{value}");
        let here = Keys { presence: Some(Whereabouts::Present), room: Some("hall"), ..NOTHING };
        let line = |count, text: &str| {
            Saying::new(Keys { count: Some(count), ..here }, &names()).unwrap().line(|_| text.to_owned())
        };
        assert_eq!(line(&two, ""), r#"{"count":2,"presence":"present","room":"hall"}"#);
        assert_eq!(line(&value, "3"), r#"{"count":3,"presence":"present","room":"hall"}"#);
        assert_eq!(line(&value, "20"), r#"{"count":8,"presence":"present","room":"hall"}"#);
        assert!(line_item(&line(&value, "0"), &Who::Somebody).is_err());
        let ten = serde_json::json!(10);
        assert!(Saying::new(Keys { count: Some(&ten), ..here }, &names()).unwrap_err().contains("from 1 to 8"));
    }
}
