//! What a rule of MQTT and one of sensor logs have in common: what is said, of whom, and after which silence.

use std::time::Duration;

use serde_json::{Map, Value};

use crate::line::{LINE_BYTES_MAX, Who, line_item};

/// Longest silence that a rule may wait for, in seconds: a week.
const QUIET_S_MAX: f64 = 604_800.0;

/// What a rule says of who is where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Whereabouts {
    /// In the house.
    Present,
    /// Out of the house, and expected back.
    Away,
    /// Out of the house, and not expected back.
    Gone,
    /// Nobody is in the room.
    Empty,
}

impl Whereabouts {
    /// As it stands in a line of JSON.
    fn word(self) -> &'static str {
        match self {
            Self::Present => "present",
            Self::Away => "away",
            Self::Gone => "gone",
            Self::Empty => "empty",
        }
    }
}

/// The keys that both kinds of rules have, as they stand in a file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Keys<'a> {
    pub(crate) say: Option<&'a str>,
    pub(crate) presence: Option<Whereabouts>,
    pub(crate) room: Option<&'a str>,
    pub(crate) person: Option<&'a Who>,
    pub(crate) quiet_s: Option<f64>,
}

/// What a rule says: a sentence, or who is where, with names in braces for what its message or interval holds.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Saying {
    keys: Map<String, Value>,
    quiet: Option<Duration>,
}

impl Saying {
    /// Checks the keys; `names` may stand in braces.
    ///
    /// # Errors
    ///
    /// Which key is wrong, and what is allowed.
    pub(crate) fn new(keys: Keys<'_>, names: &[String]) -> Result<Self, String> {
        let Keys { say, presence, room, person, quiet_s } = keys;
        match (say, presence) {
            (None, None) => return Err("give say or presence".to_owned()),
            (Some(_), Some(_)) => return Err("say and presence exclude each other; make two rules of it".to_owned()),
            (Some(say), None) if say.trim().is_empty() => return Err("say is empty".to_owned()),
            _ => {}
        }
        let person = person.map_or(Value::Null, Who::json);
        if room.is_some() && !matches!(presence, Some(Whereabouts::Present | Whereabouts::Empty)) {
            return Err("room goes with presence = \"present\" or \"empty\" alone".to_owned());
        }
        if presence == Some(Whereabouts::Empty) && (room.is_none() || !person.is_null()) {
            return Err(
                "presence = \"empty\" says that nobody is in a room: it needs room, and has no person".to_owned()
            );
        }
        let mut written = Map::new();
        for (key, said, value) in [
            ("text", "say", say.map(Value::from)),
            ("presence", "presence", presence.map(|presence| presence.word().into())),
            ("room", "room", room.map(Value::from)),
            ("person", "person", Some(person).filter(|person| !person.is_null())),
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
        let saying = Self { keys: written, quiet: quiet.transpose()? };
        // What can be narrated at all is checked here, where the rule can be named.
        line_item(&saying.line(|_| "1".to_owned()), &Who::Somebody).map_err(|error| error.to_string())?;
        Ok(saying)
    }

    /// How long nothing else must be heard before it is said; none where it is said at once.
    pub(crate) fn quiet(&self) -> Option<Duration> {
        self.quiet
    }

    /// A key's text as it was given, placeholders and all.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn text(&self, key: &str) -> Option<&str> {
        self.keys.get(key).and_then(Value::as_str)
    }

    /// The line of JSON that says it, with the value of each name in braces.
    pub(crate) fn line(&self, value_of: impl Fn(&str) -> String) -> String {
        let filled = |value: &Value| value.as_str().map(|text| filled(text, usize::MAX, &value_of).unwrap_or_default());
        let filled = |value: &Value| filled(value).map_or_else(|| value.clone(), Value::from);
        Value::Object(self.keys.iter().map(|(key, value)| (key.clone(), filled(value))).collect()).to_string()
    }

    /// As [`Self::line`], but none where the line has more bytes than a line of narration may have. It is given up before it grows.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn short_line(&self, value_of: impl Fn(&str) -> String) -> Option<String> {
        let most = usize::try_from(LINE_BYTES_MAX).unwrap_or(usize::MAX);
        let mut keys = Map::new();
        for (key, value) in &self.keys {
            let value = match value.as_str() {
                Some(text) => filled(text, most, &value_of)?.into(),
                None => value.clone(),
            };
            keys.insert(key.clone(), value);
        }
        let line = Value::Object(keys).to_string();
        (line.len() <= most).then_some(line)
    }
}

/// The next name in braces: the text before it, the name, the text after it. None where no brace is left, an error where one is left alone.
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

/// A checked text with the names' values; a brace in a value stays what it is. None where it would have more bytes than `most`.
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

    const NOTHING: Keys<'static> = Keys { say: None, presence: None, room: None, person: None, quiet_s: None };

    fn names() -> Vec<String> {
        ["value".to_owned(), "1".to_owned()].into()
    }

    #[test]
    fn a_saying_becomes_a_line_of_json() {
        let line = |keys| Saying::new(keys, &names()).unwrap().line(|name| format!("<{name}> {{1}}"));
        let ada = "ada".parse().unwrap();
        let sentence = Keys { say: Some("They set the {1} to {value}."), person: Some(&Who::Number(2)), ..NOTHING };
        assert_eq!(line(sentence), r#"{"person":2,"text":"They set the <1> {1} to <value> {1}."}"#);
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
    fn a_fault_names_its_key() {
        let say = |say| Keys { say: Some(say), ..NOTHING };
        let away = Keys { presence: Some(Whereabouts::Away), ..NOTHING };
        for (keys, part) in [
            (NOTHING, "give say or presence"),
            (say(" "), "say is empty"),
            (say("They use {2}."), "say has {2}; it knows {value}, {1}"),
            (say("They use {value."), "say has a brace alone"),
            (say("They use value}."), "say has a brace alone"),
            (say("[Fly] <mug> (1)"), "Fly"),
            (Keys { say: Some("They sit."), ..away }, "say and presence exclude each other"),
            (Keys { room: Some("hall"), ..away }, "room goes with presence = \"present\""),
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
        assert!(Saying::new(away, &names()).unwrap_err().contains("\"present\" or \"empty\" alone"));
    }

    #[test]
    fn a_line_that_is_too_long_is_given_up() {
        let say = Keys { say: Some("{value}, {value} and {1}"), ..NOTHING };
        let saying = Saying::new(say, &names()).unwrap();
        let of = |text: &str| saying.short_line(|_| text.to_owned());
        assert_eq!(of("x").as_deref(), Some(r#"{"text":"x, x and x"}"#));
        assert_eq!((of(&"x".repeat(3_000)), of(&"\u{1}".repeat(600))), (None, None), "as JSON they are longer");
        assert!(of(&"x".repeat(2_700)).is_some());
    }
}
