//! Which rules match a message, and the lines that they make of it. What one rule says is in `rule.rs`.

use std::cell::{Cell, OnceCell};
use std::collections::HashMap;
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;

use roomcast_core::narration::{SENSOR_ID_BYTES_MAX, SensorKind};
use roomcast_core::parsing::{list_of_keyed, toml_says};
use roomcast_core::text::read_text_at_most;
use serde::de::IgnoredAny;
use sha2::{Digest, Sha256};

use super::{MqttError, RULES_MAX};
use crate::condition::{Condition, ConditionKeys, comparable};
use crate::line::{LINE_BYTES_MAX, Who, line_item};
use crate::rule::{Class, Device, Keys, Saying, Whereabouts};
use crate::sensor_log::RULES_BYTES_MAX;

/// Longest time for which a state must last: a day.
const LASTING_S_MAX: f64 = 86_400.0;

/// The rules that turn messages into narration.
#[derive(Debug, Clone, PartialEq)]
pub struct Rules(pub(super) Vec<Rule>);

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RulesFile {
    #[serde(rename = "rule", default, deserialize_with = "list_of_keyed")]
    rules: Vec<RuleKeys>,
}

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RuleKeys {
    topic: String,
    field: Option<String>,
    #[serde(alias = "equals")]
    when: Option<String>,
    #[serde(default)]
    unless: Vec<String>,
    above: Option<f64>,
    below: Option<f64>,
    for_s: Option<f64>,
    #[serde(default, deserialize_with = "list_of_keyed")]
    all: Vec<AlsoKeys>,
    #[serde(default)]
    retained: bool,
    #[serde(default)]
    repeats: bool,
    say: Option<String>,
    presence: Option<Whereabouts>,
    sensor: Option<SensorKind>,
    id: Option<String>,
    room: Option<String>,
    beyond: Option<String>,
    person: Option<Who>,
    count: Option<serde_json::Value>,
    quiet_s: Option<f64>,
    hold_s: Option<f64>,
    false_alarms_per_day: Option<f64>,
    #[serde(default)]
    only_on: bool,
}

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct AlsoKeys {
    field: String,
    #[serde(alias = "equals")]
    when: Option<String>,
    #[serde(default)]
    unless: Vec<String>,
    above: Option<f64>,
    below: Option<f64>,
}

/// A further condition: a rule reads only messages that meet it.
#[derive(Debug, Clone, PartialEq)]
struct Also {
    field: String,
    condition: Condition,
}

impl Also {
    fn new(keys: &AlsoKeys) -> Result<Self, String> {
        let AlsoKeys { field, when, unless, above, below } = keys;
        if !field.starts_with('/') {
            return Err("all: field is a JSON pointer and begins with a slash, as in \"/after/label\"".to_owned());
        }
        let keys = ConditionKeys { when: when.as_deref(), unless, above: *above, below: *below };
        let condition = Condition::new(keys).map_err(|fault| format!("all: {fault}"))?;
        Ok(Self { field: field.clone(), condition })
    }

    fn holds(&self, reading: &Reading<'_>) -> bool {
        reading.value(Some(&self.field)).is_some_and(|value| self.condition.holds(&value.compared))
    }
}

/// A level of a topic with a name in braces, as in `{room}_motion`.
#[derive(Debug, Clone, PartialEq)]
struct NamedLevel {
    before: String,
    name: String,
    after: String,
}

impl NamedLevel {
    /// `None` for a level without braces.
    fn new(level: &str) -> Result<Option<Self>, String> {
        let Some((before, rest)) = level.split_once('{') else { return Ok(None) };
        let (name, after) = rest.split_once('}').ok_or("a brace in the topic is not closed")?;
        let is_name = !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_');
        if !is_name || name == "value" || after.contains(['{', '}']) {
            return Err(format!(
                "{{{name}}} is no name for a part of the topic: give one of a-z and _, one for each level, as in {{room}}_motion"
            ));
        }
        Ok(Some(Self { before: before.to_owned(), name: name.to_owned(), after: after.to_owned() }))
    }

    /// The part of a level in place of the name.
    fn part<'a>(&self, level: &'a str) -> Option<&'a str> {
        let part = level.strip_prefix(self.before.as_str())?.strip_suffix(self.after.as_str())?;
        Some(part).filter(|part| !part.is_empty())
    }
}

/// The content of a rule, for `doctor`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuleAbout<'a> {
    /// Its number, from 1.
    pub number: usize,
    /// Its filter.
    pub topic: &'a str,
    /// The value that it is for.
    pub when: Option<&'a str>,
    /// Its room, possibly with placeholders.
    pub room: Option<String>,
    /// Its room beyond a door, possibly with placeholders.
    pub beyond: Option<String>,
    /// Its person, possibly with placeholders.
    pub person: Option<String>,
    /// Its sentence, possibly with placeholders.
    pub sentence: Option<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rule {
    /// The filter for the broker.
    topic: String,
    /// The named level of each `+` of the filter.
    named: Vec<Option<NamedLevel>>,
    all: Vec<Also>,
    /// The time that the state must last before it is reported.
    pub(super) lasting: Option<Duration>,
    pub(super) field: Option<String>,
    when: Option<String>,
    condition: Condition,
    /// Distinguishes its condition from others in [`Rules::keys`].
    condition_key: String,
    pub(super) retained: bool,
    /// Whether each message is a new event, as from a button.
    pub(super) repeats: bool,
    pointers: Vec<String>,
    pub(super) saying: Saying,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Said<'a> {
    /// The rule's number, from 1.
    pub(super) number: usize,
    pub(super) rule: &'a Rule,
    /// A line of JSON. `None` if the rule is for other values: the value is remembered, so that the next matching value is new.
    pub(super) line: Option<Line>,
    pub(super) value: Rc<Value>,
    /// The state that decides whether it is new, if that is not the value.
    pub(super) held: Option<Held>,
}

/// A state that stays the same while its value changes, such as power above a limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Held {
    /// The device, or the rule and its topic.
    pub(super) place: Fingerprint,
    pub(super) own: Fingerprint,
    /// Whether it shows that a person is there or did something.
    pub(super) is_on: bool,
}

/// A line of JSON, or the reason why it is not narration.
pub(super) type Line = Result<String, String>;

/// The value at one place of a message.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Value {
    pub(super) text: String,
    compared: String,
    pub(super) own: Fingerprint,
}

/// A message with a cache: each part is read once, however many rules read it.
struct Reading<'a> {
    payload: &'a [u8],
    json: OnceCell<Option<serde_json::Value>>,
}

impl<'a> Reading<'a> {
    fn new(payload: &'a [u8]) -> Self {
        Self { payload, json: OnceCell::new() }
    }

    fn json(&self) -> Option<&serde_json::Value> {
        self.json.get_or_init(|| serde_json::from_slice(self.payload).ok()).as_ref()
    }

    /// The whole payload, or its value at a pointer.
    fn value(&self, field: Option<&str>) -> Option<Rc<Value>> {
        let text = match field {
            // A broker sends an empty payload when a retained message is removed: it is not an event.
            None => content(std::str::from_utf8(self.payload).ok()?.trim()).filter(|text| !text.is_empty())?,
            Some(field) => text_at(self.json()?, field)?,
        };
        Some(Value::of(text))
    }

    /// A null, which means that a sensor is unavailable.
    fn null(&self, field: Option<&str>) -> Option<Rc<Value>> {
        self.json()?.pointer(field?)?.is_null().then(|| Value::of("null".to_owned()))
    }
}

impl Value {
    fn of(text: String) -> Rc<Self> {
        let compared = comparable(&text);
        let own = fingerprint(compared.as_bytes());
        Rc::new(Self { text, compared, own })
    }
}

impl Rules {
    /// Reads and checks a rules file.
    ///
    /// # Errors
    ///
    /// [`MqttError::Read`], [`MqttError::Rules`] with the rule's number.
    pub fn load(path: &Path) -> Result<Self, MqttError> {
        // A relative path in an error would not show its folder.
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        match read_text_at_most(&path, RULES_BYTES_MAX) {
            Ok(text) => Self::parse(&text).map_err(|reason| MqttError::Rules(path, reason)),
            Err(source) => Err(MqttError::Read(path, source)),
        }
    }

    /// Reads and checks the text of a rules file.
    ///
    /// # Errors
    ///
    /// The fault, with the rule's number.
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

    /// The content of each rule for `doctor`, in order.
    pub fn about(&self) -> impl Iterator<Item = RuleAbout<'_>> {
        let text = |rule: &'_ Rule, key: &str| rule.saying.text(key).map(str::to_owned);
        (1..).zip(&self.0).map(move |(number, rule)| RuleAbout {
            number,
            topic: &rule.topic,
            when: rule.when.as_deref(),
            room: text(rule, "room"),
            beyond: text(rule, "beyond"),
            person: text(rule, "person"),
            sentence: text(rule, "text"),
        })
    }

    /// A key for each rule, which stays when other rules in its file are edited, in order.
    #[must_use]
    pub fn keys(&self) -> Vec<String> {
        let keys = self.0.iter().map(|rule| {
            let says = rule.saying.template();
            let (field, when) = (rule.field.as_deref().unwrap_or_default(), rule.when.as_deref().unwrap_or_default());
            let text = format!("{}\n{field}\n{when}\n{says}{}", rule.topic, rule.condition_key);
            hex::encode(&fingerprint(text.as_bytes())[..8])
        });
        keys.collect()
    }

    /// The numbers of the rules that can read a message, and whether they are for its value.
    #[must_use]
    pub fn reads(&self, topic: &str, payload: &[u8]) -> Vec<(usize, bool)> {
        self.readings(topic, payload).iter().map(|said| (said.number, said.line.is_some())).collect()
    }

    /// The number of a rule for the topic, and the defect of the payload, as in "is no JSON". `None` if a rule can read the message, or no
    /// rule is for the topic.
    #[must_use]
    pub fn unreadable(&self, topic: &str, payload: &[u8]) -> Option<(usize, String)> {
        let (number, rule) = (1..).zip(&self.0).find(|(_, rule)| rule.places(topic).is_some())?;
        let readings = self.readings(topic, payload);
        let is_read = readings.iter().any(|said| !said.rule.condition.lacks_number(&said.value.compared));
        (!is_read).then(|| (number, rule.lack(&Reading::new(payload))))
    }

    /// Whether the rule with this number is for a topic.
    #[must_use]
    pub fn fits(&self, number: usize, topic: &str) -> bool {
        self.rule(number).is_some_and(|rule| rule.places(topic).is_some())
    }

    /// Whether the rule with this number excludes a value by its `unless`.
    pub(super) fn is_excepted(&self, number: usize, value: &str) -> bool {
        self.rule(number).is_some_and(|rule| rule.condition.excepts(&comparable(value)))
    }

    pub(super) fn is_numeric(&self, number: usize) -> bool {
        self.rule(number).is_some_and(|rule| rule.condition.is_numeric())
    }

    /// Whether different values can be the same state to the rule with this number.
    pub(super) fn holds_states(&self, number: usize) -> bool {
        let is_sensor = |rule: &Rule| matches!(rule.saying.class, Class::Sensor(_));
        self.rule(number).is_some_and(|rule| is_sensor(rule) || rule.condition.is_numeric())
    }

    fn rule(&self, number: usize) -> Option<&Rule> {
        number.checked_sub(1).and_then(|at| self.0.get(at))
    }

    /// The filters to subscribe to, each once.
    #[must_use]
    pub fn filters(&self) -> Vec<String> {
        let mut filters: Vec<_> = self.0.iter().map(|rule| rule.topic.clone()).collect();
        filters.sort();
        filters.dedup();
        filters
    }

    /// The reading of each rule that can read a message.
    pub(super) fn readings(&self, topic: &str, payload: &[u8]) -> Vec<Said<'_>> {
        let reading = Reading::new(payload);
        let mut values: HashMap<Option<&str>, Option<Rc<Value>>> = HashMap::new();
        let readings = (1..).zip(&self.0).filter_map(|(number, rule)| {
            let places = rule.places(topic)?;
            if !rule.all.iter().all(|also| also.holds(&reading)) {
                return None;
            }
            let field = rule.field.as_deref();
            let value = values.entry(field).or_insert_with(|| reading.value(field)).clone();
            let null = || reading.null(field).filter(|_| matches!(rule.saying.class, Class::Sensor(_)));
            rule.say((number, topic), &places, &reading, value.or_else(null)?)
        });
        readings.collect()
    }
}

/// The MQTT filter of a rule's topic, and the name of each level that may vary.
fn filter_of(topic: &str) -> Result<(String, Vec<Option<NamedLevel>>), String> {
    let mut captures = Vec::new();
    let mut filter = Vec::new();
    for level in topic.split('/') {
        let own = NamedLevel::new(level)?;
        if level == "+" || own.is_some() {
            captures.push(own.clone());
        }
        filter.push(if own.is_some() { "+" } else { level });
    }
    let topic = filter.join("/");
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
    Ok((topic, captures))
}

fn lasting_of(for_s: f64) -> Result<Duration, String> {
    let allowed = for_s > 0.0 && for_s <= LASTING_S_MAX;
    let lasting = Duration::try_from_secs_f64(for_s).ok().filter(|_| allowed);
    lasting.ok_or_else(|| format!("for_s is {for_s}; give seconds above 0, at most {LASTING_S_MAX}"))
}

impl Rule {
    fn new(keys: RuleKeys) -> Result<Self, String> {
        let RuleKeys { topic, field, when, unless, above, below, retained, repeats, say, presence, sensor, .. } = keys;
        let condition = Condition::new(ConditionKeys { when: when.as_deref(), unless: &unless, above, below })?;
        let (topic, captures) = filter_of(&topic)?;
        if field.as_ref().is_some_and(|field| !field.starts_with('/')) {
            return Err("field is a JSON pointer and begins with a slash, as in \"/state\"".to_owned());
        }
        let names_a_room = captures.iter().flatten().any(|named| named.name == "room");
        let places = captures.iter().filter(|named| named.is_none()).count();
        // The room in the topic is the room of the event, if the rule gives no other.
        let is_placed = sensor.is_some() || presence.is_some();
        let room = keys.room.as_deref().or((names_a_room && is_placed).then_some("{room}"));
        let (say, person) = (say.as_deref(), keys.person.as_ref());
        let (id, beyond) = (keys.id.as_deref(), keys.beyond.as_deref());
        let named = person.map(|person| person.name().to_owned());
        let count = keys.count.as_ref().and_then(serde_json::Value::as_str);
        let texts = [say, room, named.as_deref(), id, beyond, count];
        let pointers: Vec<_> = texts.into_iter().flatten().flat_map(pointers).map(str::to_owned).collect();
        let places = (1..=places).map(|n| n.to_string());
        let parts = captures.iter().flatten().map(|named| named.name.clone());
        let names: Vec<_> =
            std::iter::once("value".to_owned()).chain(places).chain(parts).chain(pointers.iter().cloned()).collect();
        let RuleKeys { hold_s, false_alarms_per_day, only_on, quiet_s, .. } = keys;
        let device = Device { id, beyond, hold_s, false_alarms_per_day, only_on };
        let count = keys.count.as_ref();
        let saying = Saying::new(Keys { say, presence, sensor, room, person, count, quiet_s, device }, &names)?;
        let mut condition_key: String = unless.iter().map(|value| format!("\n{}", comparable(value))).collect();
        for (name, limit) in [("above", above), ("below", below)] {
            condition_key.extend(limit.map(|limit| format!("\n{name} {limit}")));
        }
        for also in &keys.all {
            condition_key.push_str(&format!(
                "\n{} {:?} {:?} {:?} {:?}",
                also.field, also.when, also.unless, also.above, also.below
            ));
        }
        let all = keys.all.iter().map(Also::new).collect::<Result<_, _>>()?;
        let lasting = keys.for_s.map(lasting_of).transpose()?;
        if lasting.is_some() && (quiet_s.is_some() || repeats) {
            return Err(
                "for_s excludes quiet_s and repeats: a rule waits for its value to last, or for silence".to_owned()
            );
        }
        if sensor.is_some() && is_literal(&topic, id) {
            let id = default_id(&topic, field.as_deref());
            let is_short = id.len() <= SENSOR_ID_BYTES_MAX;
            if !is_short {
                return Err(format!(
                    "its topic and field are no id of a sensor, which has {SENSOR_ID_BYTES_MAX} bytes: give id"
                ));
            }
        }
        // A device without "off" repeats its report. A sensor's state also counts when the narrator starts.
        let (retained, repeats) = (retained || sensor.is_some() && !only_on, repeats || only_on);
        Ok(Self {
            topic,
            named: captures,
            all,
            lasting,
            field,
            when,
            condition,
            condition_key,
            retained,
            repeats,
            pointers,
            saying,
        })
    }

    fn place_of(&self, name: &str) -> Option<usize> {
        self.named.iter().position(|named| named.as_ref().is_some_and(|named| named.name == name))
    }

    fn places<'a>(&self, topic: &'a str) -> Option<Vec<&'a str>> {
        let places = matches(&self.topic, topic)?;
        let part = |(level, named): (&'a str, &Option<NamedLevel>)| match named {
            Some(named) => named.part(level),
            None => Some(level),
        };
        places.into_iter().zip(&self.named).map(part).collect()
    }

    fn say(
        &self,
        (number, topic): (usize, &str),
        places: &[&str],
        reading: &Reading<'_>,
        value: Rc<Value>,
    ) -> Option<Said<'_>> {
        let (text, compared) = (&value.text, &value.compared);
        let said = |line: Option<Line>, held: Option<Held>, value| Some(Said { number, rule: self, line, value, held });
        let state = match self.saying.class {
            Class::Sensor(kind) => match self.condition.state(kind, self.field.as_deref(), compared) {
                Ok(state) if self.saying.only_on && state != Some(true) => return said(None, None, value),
                Ok(state) => Some(state),
                Err(fault) => return said(Some(Err(fault)), None, value),
            },
            _ => None,
        };
        // The side of the limit matters, not the number.
        let held = self.condition.is_numeric().then(|| {
            let holds = self.condition.holds(compared);
            let place = format!("{topic}\n{}\n{number}", self.field.as_deref().unwrap_or_default());
            Held { place: fingerprint(place.as_bytes()), own: fingerprint(&[u8::from(holds)]), is_on: holds }
        });
        if state.is_none() && !self.condition.holds(compared) {
            return said(None, held, value);
        }
        // Without a value for a pointer in braces there is no line.
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
        let value_of = |name: &str| match name.parse::<usize>() {
            Ok(number) => {
                let mut unnamed = self.named.iter().zip(places).filter(|(named, _)| named.is_none());
                unnamed.nth(number.wrapping_sub(1)).map(|(_, place)| place.replace('_', " ")).unwrap_or_default()
            }
            Err(_) if name.starts_with('/') => of_payload(at(name).unwrap_or_default()),
            Err(_) if self.place_of(name).is_some() => {
                let place = self.place_of(name).and_then(|place| places.get(place));
                place.map(|place| place.replace('_', " ")).unwrap_or_default()
            }
            Err(_) => of_payload(text.clone()),
        };
        let line = match state {
            Some(on) => self.saying.report(on, &default_id(topic, self.field.as_deref()), value_of),
            None => self.saying.short_line(value_of),
        };
        if is_structure.get() {
            let reason =
                "what stands in braces is a JSON object or list: name one of its values, as in {/state} or by `field`";
            return said(Some(Err(reason.to_owned())), None, value);
        }
        // A malformed line is rejected here, so that it takes no place among the waiting lines.
        let line = line.ok_or_else(|| format!("it has more than {LINE_BYTES_MAX} bytes")).and_then(|line| {
            let judged = line_item(&line, &Who::Somebody).map_err(|error| error.to_string());
            judged.map(|_| line)
        });
        let held = match (state, &line) {
            (Some(on), Ok(line)) => {
                // Several topics of one device give one state.
                let id = serde_json::from_str::<serde_json::Value>(line).ok()?["id"].to_string();
                let (place, own) = (fingerprint(id.as_bytes()), fingerprint(line.as_bytes()));
                Some(Held { place, own, is_on: on == Some(true) })
            }
            _ => held,
        };
        said(Some(line), held, value)
    }
}

/// The default id of a sensor: its topic, and the place of its value in the message.
fn default_id(topic: &str, field: Option<&str>) -> String {
    format!("{topic}{}", field.unwrap_or_default())
}

/// Whether a rule's default id is known before a message comes.
fn is_literal(topic: &str, id: Option<&str>) -> bool {
    id.is_none() && !topic.contains(['+', '#'])
}

impl Rule {
    /// The defect of a payload that this rule cannot read.
    fn lack(&self, reading: &Reading<'_>) -> String {
        if reading.value(self.field.as_deref()).is_some_and(|value| self.condition.lacks_number(&value.compared)) {
            return "is no number".to_owned();
        }
        if self.field.is_none() && reading.value(None).is_none() {
            let is_empty = matches!(reading.payload.trim_ascii(), b"" | b"\"\"");
            return if is_empty { "is empty" } else { "is no text" }.to_owned();
        }
        let Some(json) = reading.json() else { return "is no JSON".to_owned() };
        let missing = self.field.iter().chain(&self.pointers).find(|pointer| text_at(json, pointer).is_none());
        missing.map_or_else(|| "does not fit".to_owned(), |pointer| format!("has nothing at {pointer}"))
    }
}

/// The content of a payload: a JSON string without its quotes.
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

fn pointers(text: &str) -> impl Iterator<Item = &str> {
    text.split('{')
        .skip(1)
        .filter_map(|rest| rest.split_once('}'))
        .map(|(name, _)| name)
        .filter(|name| name.starts_with('/'))
}

/// The parts of a topic in place of the `+` of a filter; `None` if it does not match.
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

/// Whether every topic that matches the filter `narrow` also matches `wide`.
pub(super) fn covers(wide: &str, narrow: &str) -> bool {
    // Wildcards at the beginning do not match the broker's own topics.
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

/// Replaces a text of any length in a comparison.
pub(super) type Fingerprint = [u8; 32];

pub(super) fn fingerprint(text: &[u8]) -> Fingerprint {
    Sha256::digest(text).into()
}
