//! The keys that rules of MQTT and of sensor logs share: the sentence or presence, the person, and the silence before it.
//!
//! A value in braces comes from outside. In `say` it stays inside its sentence ([`inside`]), and the line has [`FILLED_KIND`], unless the
//! placeholder stands for a name or a room in a presence form.

use std::time::Duration;

use roomcast_core::narration::forms::form_of;
use serde_json::{Map, Value};

use crate::line::{LINE_BYTES_MAX, Who, line_item};

/// Longest silence that a rule may wait for, in seconds: a week.
const QUIET_S_MAX: f64 = 604_800.0;

/// The kind of a line with values in its text: a device's state, in any words. A line of this kind never sets presence.
const FILLED_KIND: &str = "device";

/// The presence that a rule reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Whereabouts {
    /// In the house.
    Present,
    /// Out of the house, and expected back.
    Away,
    /// Out of the house, and not expected back.
    Gone,
    /// The room has no people in it.
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

/// The event of a rule: a sentence or a presence, with names in braces for values of its message or interval.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Saying {
    keys: Map<String, Value>,
    quiet: Option<Duration>,
    /// The presence form of a sentence with placeholders that all stand for a name or a room.
    form: Option<&'static str>,
}

impl Saying {
    /// Checks the keys; `names` may stand in braces.
    ///
    /// # Errors
    ///
    /// The wrong key, and the allowed values.
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
        let form = say.and_then(|say| form_of(&filled(say, usize::MAX, &|_| "value".to_owned())?));
        let saying = Self { keys: written, quiet: quiet.transpose()?, form };
        // Checked here, since the error can name the rule.
        line_item(&saying.line(|_| "1".to_owned()), &Who::Somebody).map_err(|error| error.to_string())?;
        Ok(saying)
    }

    /// The silence before it is sent; `None` for at once.
    pub(crate) fn quiet(&self) -> Option<Duration> {
        self.quiet
    }

    /// A key's text as it was given, placeholders and all.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn text(&self, key: &str) -> Option<&str> {
        self.keys.get(key).and_then(Value::as_str)
    }

    /// The keys as they were given, placeholders and all, as JSON.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn template(&self) -> String {
        Value::Object(self.keys.clone()).to_string()
    }

    /// The line of JSON that says it, with the value of each name in braces.
    pub(crate) fn line(&self, value_of: impl Fn(&str) -> String) -> String {
        self.line_within(usize::MAX, &value_of).unwrap_or_default()
    }

    /// As [`Self::line`], but `None` if the line has more bytes than a line of narration may have. It is given up before it grows.
    #[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
    pub(crate) fn short_line(&self, value_of: impl Fn(&str) -> String) -> Option<String> {
        let most = usize::try_from(LINE_BYTES_MAX).unwrap_or(usize::MAX);
        self.line_within(most, &value_of).filter(|line| line.len() <= most)
    }

    fn line_within(&self, most: usize, value_of: &impl Fn(&str) -> String) -> Option<String> {
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
                Some(text) => filled(text, most, value_of)?.into(),
                None => value.clone(),
            };
            keys.insert(key.clone(), value);
        }
        Some(Value::Object(keys).to_string())
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

/// A value in the way in which rules compare it: numbers as numbers, texts without regard to upper and lower case.
#[cfg_attr(not(feature = "mqtt"), allow(dead_code, reason = "only MQTT asks"))]
pub(crate) fn comparable(value: &str) -> String {
    // Longer ones are the codes of tags and keys, which a number does not hold exactly.
    const DIGITS_MAX: usize = 15;
    let value = value.trim();
    let is_number = value.len() <= DIGITS_MAX
        && value.contains(|c: char| c.is_ascii_digit())
        && value.starts_with(|c: char| c.is_ascii_digit() || matches!(c, '+' | '-' | '.'));
    match value.parse::<f64>() {
        // 0 and -0 are one number.
        Ok(number) if is_number && number.is_finite() => (number + 0.0).to_string(),
        _ => value.to_lowercase(),
    }
}

/// The next name in braces: the text before it, the name, the text after it. `None` if no brace is left, an error for a brace without its partner.
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

/// A checked text with the names' values; a brace in a value stays. `None` if the text would have more bytes than `most`.
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
    fn numbers_compare_as_numbers_and_texts_without_case() {
        let is_same = |one, other| comparable(one) == comparable(other);
        for (one, other) in [("0", "0.0"), ("0", "-0"), ("1", "+1.00"), ("0.5", ".5"), ("100", "1e2"), ("ON", "on")] {
            assert!(is_same(one, other), "{one} {other}");
        }
        assert!(is_same("GEÖFFNET", "geöffnet"));
        for (one, other) in [("0", ""), ("0", "off"), ("1", "true"), ("inf", "infinity"), ("0", "0 W")] {
            assert!(!is_same(one, other), "{one} {other}");
        }
        assert!(!is_same("9007199254740993", "9007199254740992"), "codes of tags");
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
        assert_eq!(of("x").as_deref(), Some(r#"{"kind":"device","text":"x, x and x"}"#));
        assert_eq!((of(&"x".repeat(3_000)), of(&"\u{1}".repeat(600))), (None, None), "as JSON they are longer");
        assert!(of(&"x".repeat(2_700)).is_some());
    }
}
