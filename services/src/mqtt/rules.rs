//! Rules, and what each makes of a message.

use std::cell::{Cell, OnceCell};
use std::collections::HashMap;
use std::path::Path;
use std::rc::Rc;

use roomcast_core::parsing::{list_of_keyed, toml_says};
use roomcast_core::text::read_text_at_most;
use serde::de::IgnoredAny;
use sha2::{Digest, Sha256};

use super::{MqttError, RULES_MAX};
use crate::line::{LINE_BYTES_MAX, Who, line_item};
use crate::rule::{Keys, Saying, Whereabouts, comparable};
use crate::sensor_log::RULES_BYTES_MAX;

/// The rules by which messages become narration.
#[derive(Debug, Clone, PartialEq)]
pub struct Rules(pub(super) Vec<Rule>);

/// A rules file.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RulesFile {
    #[serde(rename = "rule", default, deserialize_with = "list_of_keyed")]
    rules: Vec<RuleKeys>,
}

/// A rule as it stands in the file.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RuleKeys {
    topic: String,
    field: Option<String>,
    when: Option<String>,
    #[serde(default)]
    unless: Vec<String>,
    #[serde(default)]
    retained: bool,
    #[serde(default)]
    repeats: bool,
    say: Option<String>,
    presence: Option<Whereabouts>,
    room: Option<String>,
    person: Option<Who>,
    quiet_s: Option<f64>,
}

/// What a rule is about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuleAbout<'a> {
    /// Its number, from 1.
    pub number: usize,
    /// Its filter.
    pub topic: &'a str,
    /// The value that it speaks of.
    pub when: Option<&'a str>,
    /// The room that it names; it may have placeholders.
    pub room: Option<String>,
    /// The person that it names; it may have placeholders.
    pub person: Option<String>,
    /// The sentence that it says; it may have placeholders.
    pub sentence: Option<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rule {
    topic: String,
    pub(super) field: Option<String>,
    when: Option<String>,
    /// The same, and the values of `unless`, as values are compared.
    compared_when: Option<String>,
    unless: Vec<String>,
    pub(super) retained: bool,
    /// Whether each message is an event of its own, as of a button.
    pub(super) repeats: bool,
    /// Whether it says who is where, and no sentence.
    pub(super) presence: bool,
    /// JSON pointers in its braces.
    pointers: Vec<String>,
    pub(super) saying: Saying,
}

/// What a rule makes of a message.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Said<'a> {
    /// The rule's number, from 1.
    pub(super) number: usize,
    pub(super) rule: &'a Rule,
    /// A line of JSON. None where the rule speaks of other values only: the value is remembered, so that the next one it speaks of is news.
    pub(super) line: Option<Line>,
    pub(super) value: Rc<Value>,
}

/// A line of JSON, or why there is none that can be narrated.
pub(super) type Line = Result<String, String>;

/// What a message says at one place.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Value {
    pub(super) text: String,
    compared: String,
    pub(super) own: Fingerprint,
}

/// A message, of which each part is read once, however many rules read it.
struct Reading<'a> {
    payload: &'a [u8],
    json: OnceCell<Option<serde_json::Value>>,
}

impl<'a> Reading<'a> {
    fn new(payload: &'a [u8]) -> Self {
        Self { payload, json: OnceCell::new() }
    }

    /// The payload as JSON; none where it is none.
    fn json(&self) -> Option<&serde_json::Value> {
        self.json.get_or_init(|| serde_json::from_slice(self.payload).ok()).as_ref()
    }

    /// The whole payload, or what it has at a pointer.
    fn value(&self, field: Option<&str>) -> Option<Rc<Value>> {
        let text = match field {
            // An empty payload is what a broker sends when a retained message is taken away: nobody has said anything.
            None => content(std::str::from_utf8(self.payload).ok()?.trim()).filter(|text| !text.is_empty())?,
            Some(field) => text_at(self.json()?, field)?,
        };
        let compared = comparable(&text);
        let own = fingerprint(compared.as_bytes());
        Some(Rc::new(Value { text, compared, own }))
    }
}

impl Rules {
    /// Reads and checks a rules file.
    ///
    /// # Errors
    ///
    /// [`MqttError::Read`], [`MqttError::Rules`] with the rule's number.
    pub fn load(path: &Path) -> Result<Self, MqttError> {
        // Of a relative path nobody knows from where it was tried.
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        match read_text_at_most(&path, RULES_BYTES_MAX) {
            Ok(text) => Self::parse(&text).map_err(|reason| MqttError::Rules { path, reason }),
            Err(source) => Err(MqttError::Read { path, source }),
        }
    }

    /// Reads and checks the text of a rules file.
    ///
    /// # Errors
    ///
    /// What is wrong, with the rule's number.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: RulesFile = toml::from_str(text).map_err(|error| toml_says(&error))?;
        if file.rules.is_empty() || file.rules.len() > RULES_MAX {
            return Err(format!("{} rules; give 1 to {RULES_MAX}, each begins with [[rule]]", file.rules.len()));
        }
        let rules = (1..).zip(file.rules).map(|(number, keys)| {
            let rule = Rule::new(keys);
            rule.map_err(|fault: String| format!("rule {number}: {fault}"))
        });
        rules.collect::<Result<_, _>>().map(Self)
    }

    /// What `doctor` asks of each rule, in their order.
    pub fn about(&self) -> impl Iterator<Item = RuleAbout<'_>> {
        let text = |rule: &'_ Rule, key: &str| rule.saying.text(key).map(str::to_owned);
        (1..).zip(&self.0).map(move |(number, rule)| RuleAbout {
            number,
            topic: &rule.topic,
            when: rule.when.as_deref(),
            room: text(rule, "room"),
            person: text(rule, "person"),
            sentence: text(rule, "text"),
        })
    }

    /// By what each rule is known while its file is edited, in their order.
    #[must_use]
    pub fn keys(&self) -> Vec<String> {
        let keys = self.0.iter().map(|rule| {
            let says = rule.saying.template();
            let (field, when) = (rule.field.as_deref().unwrap_or_default(), rule.when.as_deref().unwrap_or_default());
            let mut text = format!("{}\n{field}\n{when}\n{says}", rule.topic);
            rule.unless.iter().for_each(|value| text.push_str(&format!("\n{value}")));
            hex::encode(&fingerprint(text.as_bytes())[..8])
        });
        keys.collect()
    }

    /// The numbers of the rules that can read a message, and whether they speak of its value.
    #[must_use]
    pub fn reads(&self, topic: &str, payload: &[u8]) -> Vec<(usize, bool)> {
        self.readings(topic, payload).iter().map(|said| (said.number, said.line.is_some())).collect()
    }

    /// Why no rule can read a message although one listens to its topic: that rule's number, and what the payload lacks, as in
    /// "is no JSON". None where a rule can, or where none listens.
    #[must_use]
    pub fn unreadable(&self, topic: &str, payload: &[u8]) -> Option<(usize, String)> {
        let (number, rule) = (1..).zip(&self.0).find(|(_, rule)| matches(&rule.topic, topic).is_some())?;
        let is_read = !self.readings(topic, payload).is_empty();
        (!is_read).then(|| (number, rule.lack(&Reading::new(payload))))
    }

    /// Whether a topic is one that this rule, by its number, listens to.
    #[must_use]
    pub fn fits(&self, number: usize, topic: &str) -> bool {
        number.checked_sub(1).and_then(|at| self.0.get(at)).is_some_and(|rule| matches(&rule.topic, topic).is_some())
    }

    /// Whether a rule, by its number, leaves a value out by its `unless`.
    pub(super) fn is_excepted(&self, number: usize, value: &str) -> bool {
        let rule = number.checked_sub(1).and_then(|at| self.0.get(at));
        rule.is_some_and(|rule| rule.unless.contains(&comparable(value)))
    }

    /// Filters to subscribe to, each once.
    #[must_use]
    pub fn filters(&self) -> Vec<String> {
        let mut filters: Vec<_> = self.0.iter().map(|rule| rule.topic.clone()).collect();
        filters.sort();
        filters.dedup();
        filters
    }

    /// What each rule that can read a message makes of it.
    pub(super) fn readings(&self, topic: &str, payload: &[u8]) -> Vec<Said<'_>> {
        let reading = Reading::new(payload);
        let mut values: HashMap<Option<&str>, Option<Rc<Value>>> = HashMap::new();
        let readings = (1..).zip(&self.0).filter_map(|(number, rule)| {
            let places = matches(&rule.topic, topic)?;
            let field = rule.field.as_deref();
            let value = values.entry(field).or_insert_with(|| reading.value(field)).clone()?;
            rule.say(number, &places, &reading, value)
        });
        readings.collect()
    }
}

impl Rule {
    fn new(keys: RuleKeys) -> Result<Self, String> {
        let RuleKeys { topic, field, when, unless, retained, repeats, say, presence, room, person, quiet_s } = keys;
        if when.is_some() && !unless.is_empty() {
            return Err("when and unless exclude each other: a rule speaks of one value, or of all but some".to_owned());
        }
        let levels: Vec<_> = topic.split('/').collect();
        let wild = |level: &&str| level.contains(['+', '#']) && level.len() > 1;
        if levels.first() == Some(&"$share") {
            return Err(format!(
                "the topic {topic:?} is a shared subscription, which would take messages from its other clients: leave $share and the name behind it out"
            ));
        }
        if topic.is_empty() || levels.iter().any(wild) || levels.iter().rev().skip(1).any(|level| *level == "#") {
            return Err(format!("the topic {topic:?} is no MQTT filter (+ and # stand alone, # at the end)"));
        }
        if field.as_ref().is_some_and(|field| !field.starts_with('/')) {
            return Err("field is a JSON pointer and begins with a slash, as in \"/state\"".to_owned());
        }
        let places = levels.iter().filter(|level| **level == "+").count();
        let (say, room, person) = (say.as_deref(), room.as_deref(), person.as_ref());
        let named = person.map(|person| person.json().as_str().unwrap_or_default().to_owned());
        let texts = [say, room, named.as_deref()];
        let pointers: Vec<_> = texts.into_iter().flatten().flat_map(pointers).map(str::to_owned).collect();
        let places = (1..=places).map(|n| n.to_string());
        let names: Vec<_> = std::iter::once("value".to_owned()).chain(places).chain(pointers.iter().cloned()).collect();
        let saying = Saying::new(Keys { say, presence, room, person, quiet_s }, &names)?;
        let compared_when = when.as_deref().map(comparable);
        let unless = unless.iter().map(|value| comparable(value)).collect();
        let presence = presence.is_some();
        Ok(Self { topic, field, when, compared_when, unless, retained, repeats, presence, pointers, saying })
    }

    fn say(&self, number: usize, places: &[&str], reading: &Reading<'_>, value: Rc<Value>) -> Option<Said<'_>> {
        let (text, compared) = (&value.text, &value.compared);
        if self.compared_when.as_ref().is_some_and(|when| when != compared) || self.unless.contains(compared) {
            return Some(Said { number, rule: self, line: None, value });
        }
        // What a pointer in braces does not find leaves nothing to say.
        let at = |pointer: &str| reading.json().and_then(|json| text_at(json, pointer));
        if self.pointers.iter().any(|pointer| at(pointer).is_none()) {
            return None;
        }
        let is_structure = Cell::new(false);
        let of_payload = |text: String| {
            let is_one = text.starts_with(['{', '[']) && serde_json::from_str::<IgnoredAny>(&text).is_ok();
            is_structure.set(is_structure.get() || is_one);
            text
        };
        let line = self.saying.short_line(|name| match name.parse::<usize>() {
            Ok(number) => places.get(number.wrapping_sub(1)).map(|place| place.replace('_', " ")).unwrap_or_default(),
            Err(_) if name.starts_with('/') => of_payload(at(name).unwrap_or_default()),
            Err(_) => of_payload(text.clone()),
        });
        if is_structure.get() {
            let reason =
                "what stands in braces is a JSON object or list: name one of its values, as in {/state} or by `field`";
            return Some(Said { number, rule: self, line: Some(Err(reason.to_owned())), value });
        }
        // What no line may be is refused here: it takes no place where lines wait.
        let line = line.ok_or_else(|| format!("it has more than {LINE_BYTES_MAX} bytes")).and_then(|line| {
            let judged = line_item(&line, &Who::Somebody).map_err(|error| error.to_string());
            judged.map(|_| line)
        });
        Some(Said { number, rule: self, line: Some(line), value })
    }
}

impl Rule {
    /// What a payload that this rule cannot read lacks.
    fn lack(&self, reading: &Reading<'_>) -> String {
        if self.field.is_none() && reading.value(None).is_none() {
            let is_empty = matches!(reading.payload.trim_ascii(), b"" | b"\"\"");
            return if is_empty { "is empty" } else { "is no text" }.to_owned();
        }
        let Some(json) = reading.json() else { return "is no JSON".to_owned() };
        let missing = self.field.iter().chain(&self.pointers).find(|pointer| text_at(json, pointer).is_none());
        missing.map_or_else(|| "does not fit".to_owned(), |pointer| format!("has nothing at {pointer}"))
    }
}

/// What a payload says: a text in JSON is its content.
fn content(payload: &str) -> Option<String> {
    let json = payload.starts_with('"').then(|| serde_json::from_str::<String>(payload).ok()).flatten();
    Some(json.as_deref().unwrap_or(payload).trim().to_owned())
}

/// A text or number of a payload.
fn text_at(payload: &serde_json::Value, pointer: &str) -> Option<String> {
    match payload.pointer(pointer)? {
        serde_json::Value::String(text) => Some(text.trim().to_owned()),
        serde_json::Value::Null => None,
        other => Some(other.to_string()),
    }
}

/// The JSON pointers that stand in braces in a text.
fn pointers(text: &str) -> impl Iterator<Item = &str> {
    text.split('{')
        .skip(1)
        .filter_map(|rest| rest.split_once('}'))
        .map(|(name, _)| name)
        .filter(|name| name.starts_with('/'))
}

/// What the `+` of a filter stand for in a topic; none when it does not fit.
pub(super) fn matches<'a>(filter: &str, topic: &'a str) -> Option<Vec<&'a str>> {
    let mut places = Vec::new();
    let mut levels = topic.split('/');
    for wanted in filter.split('/') {
        if wanted == "#" {
            return Some(places);
        }
        let level = levels.next()?;
        match wanted {
            "+" => places.push(level),
            _ if wanted == level => {}
            _ => return None,
        }
    }
    levels.next().is_none().then_some(places)
}

/// Whether every topic that fits the filter `narrow` also fits `wide`.
pub(super) fn covers(wide: &str, narrow: &str) -> bool {
    // Wildcards at the beginning stand for no topic of the broker's own.
    if wide.starts_with(['+', '#']) && narrow.starts_with('$') {
        return false;
    }
    let mut levels = narrow.split('/');
    for wanted in wide.split('/') {
        if wanted == "#" {
            return true;
        }
        match levels.next() {
            Some(level) if level == wanted || wanted == "+" && level != "#" => {}
            _ => return false,
        }
    }
    levels.next().is_none()
}

/// What is remembered of a text of any length: whether another one is the same.
pub(super) type Fingerprint = [u8; 32];

pub(super) fn fingerprint(text: &[u8]) -> Fingerprint {
    Sha256::digest(text).into()
}
