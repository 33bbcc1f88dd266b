//! Narration from MQTT: devices' states become sentences by a rules file.
//!
//! ```toml
//! [[rule]]
//! topic = "home/binary_sensor/fridge_door/state"   # an MQTT filter; + and # as MQTT has them
//! when = "on"                                      # the value that it speaks of; every value where left out
//! say = "They open the fridge."
//!
//! [[rule]]
//! topic = "home/+/+/state"
//! field = "/state"                                 # a JSON pointer into the payload; without it the payload is the value
//! say = "the {2} is {value}"                       # {1}, {2}: what the + stand for, underscores as spaces
//! person = "ada"                                   # a name, a number or a placeholder; somebody where left out
//!
//! [[rule]]
//! topic = "doorbell/faces"
//! field = "/event"
//! when = "seen"
//! presence = "present"
//! person = "{/name}"                               # a JSON pointer in braces: what the payload has there
//!
//! [[rule]]
//! topic = "home/motion/+/state"
//! when = "on"
//! presence = "present"                             # or "away", "gone": no sentence, but who is where
//! room = "{1}"
//!
//! [[rule]]
//! topic = "homeassistant/person/ada/state"
//! unless = ["home", "unknown"]                     # the values that it does not speak of: every other zone is away
//! presence = "away"
//! person = "ada"
//!
//! [[rule]]
//! topic = "home/binary_sensor/front_door/state"
//! when = "off"
//! presence = "away"
//! quiet_s = 600.0                                  # said when nothing else was said for so long
//! ```
//!
//! A message says one sentence and one presence for each value that rules read in it (the payload, or a `field`): the first rule that
//! fits speaks, and each that fits and has `quiet_s` begins to wait; a message that no rule fits is counted. A value that a topic repeats
//! says nothing new and is left out, but where `repeats = true` stands, as for buttons. A retained message tells how things are, not what has just
//! happened: at the first connection it is remembered and not said, unless its rule has `retained = true`; after a reconnection it is
//! said if it differs from what was heard before.
//!
//! The session is persistent, so that the broker keeps what arrives while this process or the connection is away; order is the broker's.
//! A message is acknowledged when what it says is settled: confirmed by the daemon, or refused for good ([`listen_until_settled`]). So the
//! broker holds whatever this process could lose, however it ends. What was confirmed and not yet acknowledged when it was killed is said
//! again by the next one: no more than [`MESSAGES_AHEAD_MAX`] messages, for further ones are said when acknowledgements have gone out. MQTT 5 tells
//! the broker how many messages it may send ahead, and how large one may be. mosquitto 2.0.11 sends further ahead all the same; that waits here.

use std::cell::{Cell, OnceCell};
use std::collections::{HashMap, HashSet, VecDeque};
use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::rc::Rc;
use std::time::{Duration, Instant};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnAck, DisconnectReasonCode, Packet, Publish, SubAck, SubscribeReasonCode};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, MqttState, StateError};
use rumqttc::{Outgoing, TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use serde::de::IgnoredAny;
use sha2::{Digest, Sha256};
use tokio::sync::watch;
use tokio::time::{sleep, timeout_at};

use crate::line::{LINE_BYTES_MAX, Who, line_item};
use crate::logging::Limiter;
use crate::mqtt_tally::Tally;
use crate::narrator::Settled;
use crate::rule::{Keys, Saying, Whereabouts};
use crate::sensor_log::RULES_BYTES_MAX;
use crate::stop::Stop;
use roomcast_core::text::{excerpt, read_at_most, read_text_at_most, visible};
use roomcast_ipc::clock;

/// Messages that the broker may send before the first of them is acknowledged: MQTT's receive maximum.
pub const MESSAGES_AHEAD_MAX: u16 = 32;
/// Bytes of messages that a broker has sent further ahead than that: beyond them the oldest is said at once, and what is not acknowledged grows.
pub const HELD_BYTES_MAX: usize = 8 << 20;
/// What a message that waits takes beside its topic and payload.
const HELD_BYTES_EACH: usize = 256;
/// The largest packet that the broker may send, in bytes: MQTT's maximum packet size. It passes over larger messages by itself.
pub const PACKET_BYTES_MAX: u32 = 1 << 20;
/// The largest payload that is read, in bytes; a larger one is refused by its topic.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 10;
/// Topics whose last value is remembered; more are spoken of without regard to repetition.
pub const TOPICS_MAX: usize = 65_536;
/// Rules that a file may have.
pub const RULES_MAX: usize = 4_096;
/// What Home Assistant says of a device that it does not hear: no state of the device, unless a rule speaks of it.
const NO_STATE: [&str; 2] = ["unknown", "unavailable"];
/// Lines that wait for silence at the same time; further ones are not said.
pub const WAITING_MAX: usize = 4_096;
/// Bytes of all lines that wait for silence; further ones are not said.
pub const WAITING_BYTES_MAX: usize = 1 << 20;
/// How long the connection is listened to before the wish to stop is looked at.
pub(crate) const POLL: Duration = Duration::from_millis(200);
/// Pause before a lost connection is tried again.
pub(crate) const RECONNECT: Duration = Duration::from_secs(1);
/// The longest pause where the broker itself is broken: it doubles until then.
pub(crate) const RECONNECT_BROKEN_MAX: Duration = Duration::from_secs(64);
/// How long the broker has at the end to confirm what was said last, or to take the last acknowledgements.
pub(crate) const FAREWELL: Duration = Duration::from_secs(2);
/// How often the broker is asked whether it is there.
pub(crate) const KEEP_ALIVE: Duration = Duration::from_secs(30);
/// Complaints about the connection come at most so often.
const QUIET_NS: u64 = 30_000_000_000;
/// How long, at the end, what was read may take to be settled. A narrator has a little longer to publish it.
const SETTLING: Duration = Duration::from_secs(4);
/// A broker whose identifiers have gone up so far takes them all in turn, and none again before.
const RISEN_LONG: u64 = 8 * MESSAGES_AHEAD_MAX as u64;
/// How long the broker keeps what arrives while this process is away: for ever, as far as the broker agrees.
const SESSION_EXPIRY_S: u32 = u32::MAX;

/// Why MQTT cannot be narrated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MqttError {
    /// A file cannot be read.
    #[error("failed to read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        source: std::io::Error,
    },
    /// A file of credentials has no user name, or no second line.
    #[error(
        "{path} is no file of credentials: give the user name in the first line, and the password in the second, which may be empty"
    )]
    Credentials {
        /// The file.
        path: PathBuf,
    },
    /// The rules are malformed.
    #[error("the rules {path} are malformed: {reason}; docs/mqtt.md shows what they look like")]
    Rules {
        /// The file.
        path: PathBuf,
        /// Where and why.
        reason: String,
    },
    /// The broker's address is none.
    #[error("{given:?} is no broker: {}", address_remedy(.given))]
    Address {
        /// What was given.
        given: String,
    },
    /// The broker's address has a login in it.
    #[error(
        "the broker's address has a user name or a password in it: write them into a file, a line each, and give that (--mqtt-credentials FILE, mqtt.credentials)"
    )]
    Login,
    /// Scheme and CA file do not fit together.
    #[error("{given:?} with{} a CA file: give mqtts://HOST[:PORT] with --mqtt-ca FILE, or mqtt://HOST[:PORT] without", if *.authority { "" } else { "out" })]
    Scheme {
        /// The address.
        given: String,
        /// Whether there is a CA file.
        authority: bool,
    },
    /// The CA file has no certificate.
    #[error("{path} holds no certificate: give a PEM file with those that the broker's is signed by")]
    Authority {
        /// The file.
        path: PathBuf,
    },
    /// The broker grants none of the rules' filters.
    #[error(
        "the broker {broker} refuses every subscription ({reason}): give this client the right to read the topics of the rules, or change the rules"
    )]
    Refused {
        /// The broker's address.
        broker: String,
        /// The last filter and the broker's word.
        reason: String,
    },
    /// The client gave up.
    #[error("the MQTT client failed: {reason}")]
    Client {
        /// Why.
        reason: String,
    },
}

/// What to write in place of an address that is none.
fn address_remedy(given: &str) -> String {
    let remedy = "give mqtt://HOST[:PORT], or mqtts://HOST[:PORT] with a CA file";
    let meant = format!("mqtt://{given}");
    let meant = Broker { address: if given.contains(':') { meant } else { meant + ":1883" }, ..Broker::default() };
    // The most frequent mistake: an address as other programs have it.
    match (given.contains("://"), meant.options()) {
        (false, Ok(_)) => format!("{remedy}, here {}", meant.address),
        _ => remedy.to_owned(),
    }
}

/// How a broker is reached.
#[derive(Debug, Clone, Default)]
pub struct Broker {
    /// `mqtt://HOST[:PORT]` or `mqtts://HOST[:PORT]`.
    pub address: String,
    /// The client's name, which the broker keeps the session under.
    pub client: String,
    /// A file with user name and password on one line each.
    pub credentials: Option<PathBuf>,
    /// A PEM file with the certificates of the authority that signed the broker's; required for `mqtts`.
    pub authority: Option<PathBuf>,
}

/// The rules by which messages become narration.
#[derive(Debug, Clone, PartialEq)]
pub struct Rules(Vec<Rule>);

/// A rules file.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RulesFile {
    #[serde(rename = "rule", default)]
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
struct Rule {
    topic: String,
    field: Option<String>,
    when: Option<String>,
    unless: Vec<String>,
    retained: bool,
    /// Whether each message is an event of its own, as of a button.
    repeats: bool,
    /// Whether it says who is where, and no sentence.
    presence: bool,
    /// JSON pointers in its braces.
    pointers: Vec<String>,
    saying: Saying,
}

/// What a rule makes of a message.
#[derive(Debug, Clone, PartialEq)]
struct Said<'a> {
    /// The rule's number, from 1.
    number: usize,
    rule: &'a Rule,
    /// A line of JSON. None where the rule speaks of other values only: the value is remembered, so that the next one it speaks of is news.
    line: Option<Line>,
    value: Rc<Value>,
}

/// A line of JSON, or why there is none that can be narrated.
type Line = Result<String, String>;

/// What a message says at one place.
#[derive(Debug, Clone, PartialEq)]
struct Value {
    text: String,
    own: Fingerprint,
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
            None => std::str::from_utf8(self.payload).ok().map(str::trim).filter(|text| !text.is_empty())?.to_owned(),
            Some(field) => text_at(self.json()?, field)?,
        };
        let own = fingerprint(text.as_bytes());
        Some(Rc::new(Value { text, own }))
    }
}

/// What becomes of a message by one rule.
#[derive(Debug, Clone, PartialEq)]
struct Outcome {
    /// The rule's number, from 1.
    number: usize,
    /// What it read.
    value: Rc<Value>,
    what: What,
}

#[derive(Debug, Clone, PartialEq)]
enum What {
    /// Said at once, as a line of JSON.
    Said(String),
    /// To be said after this silence.
    Waits(String, Duration),
    /// A rule before it has spoken of this value.
    Later,
    /// It speaks of other values.
    OtherValue,
    /// The topic's last value was the same.
    Repeated,
    /// Retained: how things are, not what has just happened.
    State,
    /// What it would say is no narration, for this reason.
    Unfit(String),
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
        let file: RulesFile = toml::from_str(text).map_err(|error| excerpt(&error.to_string()).into_owned())?;
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
            let says = rule.saying.line(|name| format!("{{{name}}}"));
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
    fn is_excepted(&self, number: usize, value: &str) -> bool {
        let rule = number.checked_sub(1).and_then(|at| self.0.get(at));
        rule.is_some_and(|rule| rule.unless.iter().any(|other| other.eq_ignore_ascii_case(value)))
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
    fn readings(&self, topic: &str, payload: &[u8]) -> Vec<Said<'_>> {
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
        Ok(Self { topic, field, when, unless, retained, repeats, presence: presence.is_some(), pointers, saying })
    }

    fn say(&self, number: usize, places: &[&str], reading: &Reading<'_>, value: Rc<Value>) -> Option<Said<'_>> {
        let text = &value.text;
        let is = |other: &String| other.eq_ignore_ascii_case(text);
        if self.when.as_ref().is_some_and(|when| !is(when)) || self.unless.iter().any(is) {
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
            return if reading.payload.trim_ascii().is_empty() { "is empty" } else { "is no text" }.to_owned();
        }
        let Some(json) = reading.json() else { return "is no JSON".to_owned() };
        let missing = self.field.iter().chain(&self.pointers).find(|pointer| text_at(json, pointer).is_none());
        missing.map_or_else(|| "does not fit".to_owned(), |pointer| format!("has nothing at {pointer}"))
    }
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
fn matches<'a>(filter: &str, topic: &'a str) -> Option<Vec<&'a str>> {
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

/// Counts of what came and what was said.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Heard {
    /// Lines of narration that messages became.
    pub said: u64,
    /// Messages that no rule fits.
    pub unfit: u64,
    /// Messages that said nothing new, or how things are.
    pub silent: u64,
    /// Messages of which a rule would say what is no narration.
    pub unsayable: u64,
    /// Messages that are larger than [`PAYLOAD_BYTES_MAX`].
    pub oversized: u64,
}

/// What is remembered of a text of any length: whether another one is the same.
type Fingerprint = [u8; 32];

fn fingerprint(text: &[u8]) -> Fingerprint {
    Sha256::digest(text).into()
}

/// What is said unless something else is said before.
#[derive(Debug)]
struct Waiting {
    line: String,
    since: Instant,
    quiet: Duration,
}

/// Decides which messages are said. Pure: time comes in.
#[derive(Debug)]
pub struct Listener {
    rules: Rules,
    /// The last value of each topic.
    last: HashMap<Fingerprint, Fingerprint>,
    /// What rules with `quiet_s` have to say, each line once.
    waiting: Vec<Waiting>,
    /// Whether what is retained now was retained before this process first listened.
    first_connection: bool,
    heard: Heard,
    /// Lines that rules would have said and that are no narration, and lines that found no room to wait for silence.
    refused: u64,
    /// How often each rule fitted a message.
    fitted: Vec<u64>,
}

impl Listener {
    /// One that has heard nothing yet.
    #[must_use]
    pub fn new(rules: Rules) -> Self {
        let fitted = vec![0; rules.0.len()];
        let (last, waiting, heard) = (HashMap::new(), Vec::new(), Heard::default());
        Self { rules, last, waiting, first_connection: true, heard, refused: 0, fitted }
    }

    /// The narration of a message that is to be said at once, as lines of JSON; `retained` is what the broker calls it.
    pub fn hear(&mut self, topic: &[u8], payload: &[u8], retained: bool, now: Instant) -> Vec<String> {
        let outcomes = self.outcomes(topic, payload, retained, now).into_iter();
        let said = outcomes.filter_map(|outcome| if let What::Said(line) = outcome.what { Some(line) } else { None });
        said.collect()
    }

    /// What becomes of a message by each rule that can read it, in their order; nothing where none can.
    fn outcomes(&mut self, topic: &[u8], payload: &[u8], retained: bool, now: Instant) -> Vec<Outcome> {
        let Ok(topic) = std::str::from_utf8(topic) else {
            self.heard.unfit += 1;
            return Vec::new();
        };
        if payload.len() > PAYLOAD_BYTES_MAX {
            self.heard.oversized += 1;
            // Each doubling of their number is one line: a camera behind a wide filter does not fill the log.
            if self.heard.oversized.is_power_of_two() {
                tracing::warn!(
                    topic,
                    bytes = payload.len(),
                    limit = PAYLOAD_BYTES_MAX,
                    oversized = self.heard.oversized,
                    "a message is too large and is passed over; leave its topic out of the rules"
                );
            }
            return Vec::new();
        }
        let readings = self.rules.readings(topic, payload);
        if readings.iter().all(|said| said.line.is_none()) {
            self.heard.unfit += 1;
        }
        let spoken_of: HashSet<Option<&str>> =
            readings.iter().filter(|said| said.line.is_some()).map(|said| said.rule.field.as_deref()).collect();
        let mut known: HashMap<Option<&str>, Option<Fingerprint>> = HashMap::new();
        let mut spoken: HashSet<(Option<&str>, bool)> = HashSet::new();
        let mut outcomes = Vec::with_capacity(readings.len());
        for Said { number, rule, line, value } in readings {
            let field = rule.field.as_deref();
            let own = value.own;
            // Every rule that reads one field reads one value there.
            let known = *known.entry(field).or_insert_with(|| {
                let place = fingerprint(format!("{topic}\n{}", field.unwrap_or_default()).as_bytes());
                let known = self.last.get(&place).copied();
                let is_state =
                    spoken_of.contains(&field) || !NO_STATE.iter().any(|no| no.eq_ignore_ascii_case(&value.text));
                if is_state && (known.is_some() || self.last.len() < TOPICS_MAX) {
                    self.last.insert(place, own);
                }
                known
            });
            let unknown = self.first_connection || known.is_none();
            let quiet = rule.saying.quiet();
            let what = match line {
                None => What::OtherValue,
                // The first that speaks of a value at once.
                Some(_) if quiet.is_none() && !spoken.insert((field, rule.presence)) => What::Later,
                Some(_) if known == Some(own) && (retained || !rule.repeats) => What::Repeated,
                Some(_) if retained && !rule.retained && unknown => What::State,
                Some(Err(reason)) => What::Unfit(reason),
                Some(Ok(line)) => match quiet {
                    None => What::Said(line),
                    Some(quiet) => What::Waits(line, quiet),
                },
            };
            outcomes.push(Outcome { number, value, what });
        }
        let said = outcomes.iter().filter(|outcome| matches!(outcome.what, What::Said(_))).count();
        if said > 0 {
            self.heard.said += said as u64;
            self.waiting.clear();
        }
        for outcome in &outcomes {
            match &outcome.what {
                What::Waits(line, quiet) if !self.wait(Waiting { line: line.clone(), since: now, quiet: *quiet }) => {
                    self.refuse(topic, outcome.number, "too much waits for silence");
                }
                What::Unfit(reason) => self.refuse(topic, outcome.number, reason),
                _ => {}
            }
        }
        for outcome in outcomes.iter().filter(|outcome| outcome.what != What::OtherValue) {
            if let Some(count) = self.fitted.get_mut(outcome.number.wrapping_sub(1)) {
                *count = count.saturating_add(1);
            }
        }
        let acts = |outcome: &Outcome| matches!(outcome.what, What::Said(_) | What::Waits(..));
        let fits = |outcome: &Outcome| outcome.what != What::OtherValue;
        if outcomes.iter().any(fits) && !outcomes.iter().any(acts) {
            let is_unsayable = outcomes.iter().any(|outcome| matches!(outcome.what, What::Unfit(_)));
            *(if is_unsayable { &mut self.heard.unsayable } else { &mut self.heard.silent }) += 1;
        }
        outcomes
    }

    /// Begins to wait; the same line begins again. Whether there is room.
    fn wait(&mut self, waiting: Waiting) -> bool {
        self.waiting.retain(|other| other.line != waiting.line);
        let has_room =
            self.waiting.len() < WAITING_MAX && self.waiting_bytes() + waiting.line.len() <= WAITING_BYTES_MAX;
        if has_room {
            self.waiting.push(waiting);
        }
        has_room
    }

    fn waiting_bytes(&self) -> usize {
        self.waiting.iter().map(|waiting| waiting.line.capacity()).sum()
    }

    /// Each doubling of their number is one line of the log.
    fn refuse(&mut self, topic: &str, rule: usize, reason: &str) {
        self.refused += 1;
        if self.refused.is_power_of_two() {
            tracing::warn!(topic, rule, reason, refused = self.refused, "what a rule would say is not narrated");
        }
    }

    /// What it was quiet for long enough to say, as lines of JSON.
    pub fn due(&mut self, now: Instant) -> Vec<String> {
        let due = |waiting: &mut Waiting| now.saturating_duration_since(waiting.since) >= waiting.quiet;
        let lines: Vec<_> = self.waiting.extract_if(.., due).map(|waiting| waiting.line).collect();
        self.heard.said += lines.len() as u64;
        lines
    }

    /// Silence counts from now on: before, nothing could be heard.
    fn listen_from(&mut self, now: Instant) {
        self.waiting.iter_mut().for_each(|waiting| waiting.since = now);
    }
}

/// What a broker may send again after a connection broke: messages that it may not have seen acknowledged. There are no more than packet
/// identifiers, however far ahead a broker sends.
///
/// What this side has not acknowledged comes again for sure. Of what it has acknowledged it cannot know: the acknowledgement may be lost
/// with the connection, and then the message comes again; or it has arrived, so that its identifier is free, and a new message has it, whose
/// own first sending was lost. Both look the same. So an identifier is free as soon as something shows that the broker has the
/// acknowledgement: the answer to a later ping, a session that is not kept, or another message of that identifier. In doubt the message is said
/// again, but where the broker cannot have come round to this identifier. It takes either the lowest that is free, or all from 1 to some end
/// in turn. Whichever it is, there are at least as many as the highest that it has used, so fewer new messages do not come round.
#[derive(Debug, Default)]
struct Recent {
    messages: HashMap<u16, Remembered>,
    /// New messages until now.
    new: u64,
    /// The identifier of the last new message, and how far identifiers have gone up until then without going back.
    last: u16,
    risen: u64,
    /// The highest identifier of the session until now.
    highest: u16,
}

#[derive(Debug, Clone, Copy)]
struct Remembered {
    connection: u64,
    text: Fingerprint,
    /// The last line that it said, or that was said before it.
    line: u64,
    /// Its number among the new messages.
    number: u64,
    acknowledged: Acknowledged,
}

/// What is known of an acknowledgement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Acknowledged {
    No,
    /// On its way.
    Sent,
    /// On its way, and a ping behind it.
    Pinged,
}

impl Recent {
    /// For a message that an earlier connection brought, the line that it waits for.
    fn again(&mut self, connection: u64, message: &Publish) -> Option<u64> {
        let ahead = u64::from(MESSAGES_AHEAD_MAX);
        let before = self.messages.get_mut(&message.pkid).filter(|_| message.dup && message.qos != QoS::AtMostOnce)?;
        if before.connection >= connection || before.text != Self::text(message) {
            return None;
        }
        // At most `ahead` new messages were lost on their way.
        let since = self.new - before.number;
        let is_long = self.risen > RISEN_LONG || u64::from(self.highest) > since + ahead;
        let counts = is_long && self.risen >= since && since + ahead < u64::from(u16::MAX);
        if before.acknowledged != Acknowledged::No && !counts {
            return None;
        }
        (before.connection, before.acknowledged) = (connection, Acknowledged::No);
        Some(before.line)
    }

    /// Takes note of a message that waits for a line.
    fn take(&mut self, connection: u64, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        // After the highest identifier comes 1.
        let step = (u32::from(message.pkid) + u32::from(u16::MAX) - u32::from(self.last)) % u32::from(u16::MAX);
        let is_near = (1..=2 * u32::from(MESSAGES_AHEAD_MAX)).contains(&step);
        self.risen = if is_near { self.risen + u64::from(step) } else { 0 };
        (self.new, self.last, self.highest) = (self.new + 1, message.pkid, self.highest.max(message.pkid));
        let (text, acknowledged) = (Self::text(message), Acknowledged::No);
        self.messages.insert(message.pkid, Remembered { connection, text, line, number: self.new, acknowledged });
    }

    /// What the client has sent.
    fn sent(&mut self, packet: &Outgoing) {
        match packet {
            Outgoing::PubAck(pkid) => {
                if let Some(message) = self.messages.get_mut(pkid) {
                    message.acknowledged = Acknowledged::Sent;
                }
            }
            Outgoing::PingReq => self.every(Acknowledged::Sent, Acknowledged::Pinged),
            _ => {}
        }
    }

    /// The broker has answered a ping: it has read all that was sent before.
    fn answered(&mut self) {
        self.messages.retain(|_, message| message.acknowledged != Acknowledged::Pinged);
    }

    /// A connection begins. Pings of the last one are not answered any more; of a session that the broker has not kept nothing comes again.
    fn connect(&mut self, is_kept: bool) {
        if is_kept {
            self.every(Acknowledged::Pinged, Acknowledged::Sent);
        } else {
            *self = Self::default();
        }
    }

    fn every(&mut self, from: Acknowledged, to: Acknowledged) {
        self.messages.values_mut().filter(|message| message.acknowledged == from).for_each(|m| m.acknowledged = to);
    }

    fn text(message: &Publish) -> Fingerprint {
        let mut text = Sha256::new();
        text.update((message.topic.len() as u64).to_le_bytes());
        text.update(&message.topic);
        text.update(&message.payload);
        text.finalize().into()
    }
}

/// A number of lines that are settled, as somebody else counts them: who tells, and who listens.
#[must_use]
pub fn settled() -> (Settled, SettledNews) {
    let (told, news) = watch::channel(0);
    (Box::new(move |lines| _ = told.send_replace(lines)), SettledNews(news))
}

/// Hears how many lines are settled; see [`settled`].
#[derive(Debug, Clone)]
pub struct SettledNews(watch::Receiver<u64>);

/// Messages of this connection that the broker has not seen acknowledged, oldest first, each with the line that has to be settled before.
#[derive(Debug, Default)]
struct Acknowledgements {
    waiting: VecDeque<(u64, u16)>,
    /// Acknowledgements that the client has and has not sent.
    on_way: usize,
    /// Lines that were written.
    written: u64,
    /// None where a line is settled when it is written.
    news: Option<SettledNews>,
}

impl Acknowledgements {
    /// Adds a message. A broker that sends further ahead than it may waits in vain for the oldest, and sends them again.
    fn put(&mut self, message: &Publish, line: u64) {
        if message.qos == QoS::AtMostOnce {
            return;
        }
        if self.waiting.len() > usize::from(u16::MAX) {
            self.waiting.pop_front();
        }
        self.waiting.push_back((line, message.pkid));
    }

    /// Acknowledges what may be, in its order, as far as the client has room.
    fn send(&mut self, client: &AsyncClient) {
        let settled = self.news.as_mut().map_or(self.written, |news| *news.0.borrow_and_update());
        while let Some((_, pkid)) = self.waiting.front().filter(|(line, _)| *line <= settled) {
            if client.try_ack(&Publish { qos: QoS::AtLeastOnce, pkid: *pkid, ..Publish::default() }).is_err() {
                return;
            }
            self.waiting.pop_front();
            self.on_way += 1;
        }
    }

    /// Whether one more message may be said before another one is acknowledged.
    fn have_room(&self) -> bool {
        self.waiting.len() + self.on_way < usize::from(MESSAGES_AHEAD_MAX)
    }

    /// The connection has ended, and what was on its way with it.
    fn forget(&mut self) {
        self.waiting.clear();
        self.on_way = 0;
    }

    /// Waits until more is settled; an error when nobody will tell any more.
    async fn news(&mut self) -> std::io::Result<()> {
        match &mut self.news {
            Some(news) => news.0.changed().await.map_err(|_| std::io::ErrorKind::BrokenPipe.into()),
            None => std::future::pending().await,
        }
    }
}

impl Broker {
    /// What the client needs to know, with the files read: whatever is wrong with the set-up shows here, before anything is connected.
    ///
    /// # Errors
    ///
    /// [`MqttError`] for an address or a file that cannot be used.
    pub fn options(&self) -> Result<MqttOptions, MqttError> {
        let wrong = || MqttError::Address { given: self.address.clone() };
        let (scheme, rest) = self.address.split_once("://").ok_or_else(wrong)?;
        let secure = match scheme {
            "mqtt" => false,
            "mqtts" => true,
            _ => return Err(wrong()),
        };
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        if rest.contains('@') {
            return Err(MqttError::Login);
        }
        // An address of IPv6 stands in brackets, and has colons of its own.
        let end = rest.rfind(']').map_or(0, |at| at + 1);
        let (host, port) = match rest[end..].rsplit_once(':') {
            Some((name, port)) => (&rest[..end + name.len()], port.parse().map_err(|_| wrong())?),
            None => (rest, if secure { 8883 } else { 1883 }),
        };
        if host.is_empty() || host.contains('/') || end == 0 && host.contains(':') {
            return Err(wrong());
        }
        let mut options = MqttOptions::new(&self.client, host, port);
        options.set_keep_alive(KEEP_ALIVE).set_clean_start(false);
        options.set_session_expiry_interval(Some(SESSION_EXPIRY_S));
        options.set_receive_maximum(Some(MESSAGES_AHEAD_MAX)).set_max_packet_size(Some(PACKET_BYTES_MAX));
        // Nothing is published; the client would set aside room for so many.
        options.set_outgoing_inflight_upper_limit(MESSAGES_AHEAD_MAX);
        if let Some(path) = &self.credentials {
            let text = read_text_at_most(path, RULES_BYTES_MAX)
                .map_err(|source| MqttError::Read { path: path.clone(), source })?;
            let mut lines = text.trim_start_matches('\u{feff}').lines();
            let (Some(user), Some(password)) = (lines.next().filter(|user| !user.is_empty()), lines.next()) else {
                return Err(MqttError::Credentials { path: path.clone() });
            };
            options.set_credentials(user, password);
        }
        match (&self.authority, secure) {
            (Some(path), true) => {
                let ca = read_at_most(path, RULES_BYTES_MAX)
                    .map_err(|source| MqttError::Read { path: path.clone(), source })?
                    .ok_or_else(|| MqttError::Authority { path: path.clone() })?;
                if !CertificateDer::pem_slice_iter(&ca).any(|certificate| certificate.is_ok()) {
                    return Err(MqttError::Authority { path: path.clone() });
                }
                // A second call finds one installed, and that is as good.
                let _installed = rustls::crypto::ring::default_provider().install_default();
                options.set_transport(Transport::tls_with_config(TlsConfiguration::Simple {
                    ca,
                    alpn: None,
                    client_auth: None,
                }));
            }
            (None, false) => {}
            (authority, _) => {
                return Err(MqttError::Scheme { given: self.address.clone(), authority: authority.is_some() });
            }
        }
        Ok(options)
    }
}

/// Listens to the broker and writes narration as lines of JSON to `out`, until it is asked to stop or `out` is closed. A lost connection
/// is tried again for ever. At the end the broker has the acknowledgement of all that was written.
///
/// # Errors
///
/// [`MqttError::Refused`] when the broker grants nothing, [`MqttError::Client`] when the client cannot go on.
pub fn listen(options: MqttOptions, rules: Rules, out: impl Write, stop: &Stop) -> Result<Heard, MqttError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(failed)?;
    runtime.block_on(Connection::new(options, rules, out).listen(stop))
}

/// As [`listen`], but the broker is told to be done with a message only when the lines that it became are settled, so that it says again
/// what this process has lost. Counts how often each rule fits a message, where there is a tally.
///
/// # Errors
///
/// As [`listen`].
pub fn listen_until_settled(
    options: MqttOptions,
    rules: Rules,
    tally: Option<Tally>,
    out: impl Write,
    news: SettledNews,
    stop: &Stop,
) -> Result<Heard, MqttError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(failed)?;
    let mut connection = Connection::new(options, rules, out);
    connection.acknowledgements.news = Some(news);
    connection.tally = tally;
    runtime.block_on(connection.listen(stop))
}

/// Listens as [`listen`] does, and writes what becomes of each message, for people: the rule, and what it would say, with what `remark` has to
/// say of that line of JSON. Nothing is narrated, and the broker keeps nothing of it: the client has a name of its own, and its session ends
/// with the connection.
///
/// # Errors
///
/// As [`listen`].
pub fn rehearse(
    mut options: MqttOptions,
    rules: Rules,
    out: impl Write,
    stop: &Stop,
    remark: &mut dyn FnMut(&str) -> Option<String>,
) -> Result<Heard, MqttError> {
    let client = format!("{}-dry-run-{}", options.client_id(), std::process::id());
    options.set_client_id(client).set_clean_start(true).set_session_expiry_interval(Some(0));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(failed)?;
    let mut connection = Connection::new(options, rules, out);
    connection.rehearsal = Some(remark);
    runtime.block_on(connection.listen(stop))
}

/// How a text from outside begins, on one line of a terminal: quotes as they are, so that JSON can be read.
#[must_use]
pub fn shown(bytes: &[u8]) -> String {
    const LONGEST: usize = 120;
    let text = String::from_utf8_lossy(bytes);
    let mut chars = text.chars();
    let start: String = chars.by_ref().take(LONGEST).collect();
    let rest = if chars.next().is_some() { "..." } else { "" };
    format!("{}{rest}", visible(&start))
}

/// What is beside a line that would be said; nothing where it needs no word.
type Remark<'a> = dyn FnMut(&str) -> Option<String> + 'a;

/// A line that would be said, with what there is to say of it.
fn remarked(line: &str, remark: &mut Remark<'_>) -> String {
    remark(line).map_or_else(|| line.to_owned(), |remark| format!("{line}\n    {}", visible(&remark)))
}

/// What becomes of a message, for people.
fn report(
    rules: &Rules,
    (topic, payload, retained): (&[u8], &[u8], bool),
    outcomes: &[Outcome],
    remark: &mut Remark<'_>,
) -> String {
    let quoted = |value: &Value| format!("\"{}\"", shown(value.text.as_bytes()));
    let mut text = format!("{}  {}{}", shown(topic), shown(payload), if retained { "  (retained)" } else { "" });
    for Outcome { number, value, what } in outcomes {
        let said = match what {
            What::Said(line) => format!("says {}", remarked(line, remark)),
            What::Waits(line, quiet) => {
                format!("says after {} s of silence {}", quiet.as_secs_f64(), remarked(line, remark))
            }
            What::Later => "is silent: a rule before it speaks of this value".to_owned(),
            What::OtherValue if rules.is_excepted(*number, &value.text) => {
                format!("is silent: {} is in its `unless`", quoted(value))
            }
            What::OtherValue => format!("is silent: {} is not its `when`", quoted(value)),
            What::Repeated => format!("is silent: {} is what the topic said before", quoted(value)),
            What::Unfit(reason) => {
                format!("is silent: what it would say is no narration: {}", shown(reason.as_bytes()))
            }
            What::State => "is silent: retained, so no event (`retained = true` says it)".to_owned(),
        };
        text.push_str(&format!("\n  rule {number} {said}"));
    }
    if outcomes.is_empty() {
        let lacks = std::str::from_utf8(topic).ok().and_then(|topic| rules.unreadable(topic, payload));
        text.push_str(&match lacks {
            Some((number, lack)) => format!("\n  rule {number} cannot read it: the payload {}", visible(&lack)),
            None => "\n  no rule can read it".to_owned(),
        });
    }
    text
}

fn failed(error: impl Display) -> MqttError {
    MqttError::Client { reason: error.to_string() }
}

/// What to say of a connection that broke. A broker that gives it to another client of the same name says so by MQTT 5, or closes it only, as
/// mosquitto 2.0.11 does.
pub(crate) fn broken(error: &ConnectionError) -> String {
    const REMEDY: &str = "another client has this one's name: give each narrator a narrator.name of its own, and start one bridge, and one robot \
        service for each robot";
    match error {
        ConnectionError::MqttState(StateError::ServerDisconnect {
            reason_code: DisconnectReasonCode::SessionTakenOver,
            ..
        }) => format!("the broker gave the connection away: {REMEDY}"),
        ConnectionError::MqttState(StateError::ConnectionAborted) => {
            format!("the broker closed the connection; where it does that again and again, {REMEDY}")
        }
        error => error.to_string(),
    }
}

/// Why a connection is of no use; none for one that is.
pub(crate) fn fault_of(greeting: &ConnAck) -> Option<&'static str> {
    let properties = greeting.properties.as_ref()?;
    if properties.receive_max == Some(0) {
        return Some(
            "the broker is broken: it allows no message at all (a receive maximum of 0, which MQTT 5 forbids)",
        );
    }
    let none = properties.max_packet_size == Some(0);
    none.then_some(
        "the broker is broken: it allows no packet at all (a maximum packet size of 0, which MQTT 5 forbids)",
    )
}

/// Makes the client ready to connect again, as if for the first time.
pub(crate) fn renew(events: &mut EventLoop) {
    events.clean();
    events.pending.clear();
    // What the last broker wished holds for its connection only.
    events.options.set_keep_alive(KEEP_ALIVE);
    let most = events.options.get_outgoing_inflight_upper_limit().unwrap_or(MESSAGES_AHEAD_MAX);
    events.state = MqttState::new(most, events.options.manual_acks());
}

/// A broker that wants no pings says 0, which the client takes for no pause at all between them.
pub(crate) fn correct_keep_alive(events: &mut EventLoop) {
    if events.options.keep_alive().is_zero() {
        events.options.set_keep_alive(KEEP_ALIVE);
    }
}

/// A subscription to each filter, one after the other, so that it is known which one the broker answers.
#[derive(Debug)]
struct Subscriptions {
    filters: Vec<String>,
    answered: usize,
    granted: usize,
    /// The next filter is to be asked for, as soon as the client has room.
    due: bool,
    /// The packet that the broker has to answer: more answers than questions say nothing.
    asked: Option<u16>,
    /// Filters whose refusal was told.
    told: HashSet<String>,
}

impl Subscriptions {
    fn new(filters: Vec<String>) -> Self {
        Self { filters, answered: 0, granted: 0, due: false, asked: None, told: HashSet::new() }
    }

    /// Begins at the first filter.
    fn start(&mut self) {
        (self.answered, self.granted, self.due, self.asked) = (0, 0, true, None);
    }

    /// Asks for the filter that is due, where the client has room.
    fn send(&mut self, client: &AsyncClient) {
        if self.due {
            let filter = self.filters.get(self.answered);
            self.due = filter.is_some_and(|filter| client.try_subscribe(filter, QoS::AtLeastOnce).is_err());
        }
    }

    /// Takes the broker's answer to the filter asked for last.
    fn take(&mut self, answer: &SubAck, broker: &str) -> Result<(), MqttError> {
        let Some(filter) = self.filters.get(self.answered).filter(|_| self.asked == Some(answer.pkid)) else {
            return Ok(());
        };
        let reason = answer.return_codes.first().copied().unwrap_or(SubscribeReasonCode::Unspecified);
        (self.answered, self.asked, self.due) = (self.answered + 1, None, true);
        match reason {
            SubscribeReasonCode::Success(quality) => {
                self.granted += 1;
                self.told.remove(filter);
                if quality == QoS::AtMostOnce {
                    tracing::warn!(
                        broker,
                        filter,
                        "the broker grants quality 0 only: what it sends while away is lost"
                    );
                }
            }
            refused => {
                if self.told.insert(filter.clone()) {
                    tracing::error!(broker, filter, reason = ?refused, "the broker refuses a subscription: nothing is heard of it; give this client the right to read it");
                }
                if self.answered == self.filters.len() && self.granted == 0 {
                    let reason = format!("{filter:?}: {refused:?}");
                    return Err(MqttError::Refused { broker: broker.to_owned(), reason });
                }
            }
        }
        Ok(())
    }
}

/// The client, what it has heard and where it says it.
struct Connection<'a, W> {
    broker: String,
    client: AsyncClient,
    events: EventLoop,
    listener: Listener,
    subscriptions: Subscriptions,
    recent: Recent,
    acknowledgements: Acknowledgements,
    /// Messages that wait until others are acknowledged, oldest first, and their bytes.
    held: VecDeque<Publish>,
    held_bytes: usize,
    connected: bool,
    log: Limiter,
    greetings: Limiter,
    /// The pause before the next connection.
    pause: Duration,
    /// What comes is left to the next session.
    leaves: bool,
    /// Reports what would be said, with a remark, in place of saying it.
    rehearsal: Option<&'a mut Remark<'a>>,
    /// Keeps how often each rule fits.
    tally: Option<Tally>,
    out: W,
}

/// Why the connection that an event tells of is of no use; none for one that is, and for other events.
fn fault(event: &Event) -> Option<&'static str> {
    if let Event::Incoming(Packet::ConnAck(greeting)) = event { fault_of(greeting) } else { None }
}

/// What listening comes to.
enum Turn {
    /// More is to come.
    On,
    /// Nobody reads any more.
    Unread,
}

/// What a message takes while it waits.
fn held_bytes(message: &Publish) -> usize {
    message.topic.len() + message.payload.len() + HELD_BYTES_EACH
}

fn write_line(out: &mut impl Write, line: &str) -> std::io::Result<()> {
    writeln!(out, "{line}").and_then(|()| out.flush())
}

impl<'a, W: Write> Connection<'a, W> {
    fn new(mut options: MqttOptions, rules: Rules, out: W) -> Self {
        options.set_manual_acks(true);
        let (host, port) = options.broker_address();
        let subscriptions = Subscriptions::new(rules.filters());
        // One subscription, one farewell, and every acknowledgement.
        let (client, events) = AsyncClient::new(options, 2 + usize::from(MESSAGES_AHEAD_MAX));
        let (listener, recent) = (Listener::new(rules), Recent::default());
        Self {
            broker: format!("{host}:{port}"),
            client,
            events,
            listener,
            subscriptions,
            recent,
            acknowledgements: Acknowledgements::default(),
            held: VecDeque::new(),
            held_bytes: 0,
            connected: false,
            log: Limiter::new(QUIET_NS),
            greetings: Limiter::new(QUIET_NS),
            pause: RECONNECT,
            leaves: false,
            rehearsal: None,
            tally: None,
            out,
        }
    }

    async fn listen(mut self, stop: &Stop) -> Result<Heard, MqttError> {
        let mut connections = 0_u64;
        loop {
            let turn = match self.next(|_| stop.requested()).await {
                Ok(Some(Ok(event))) => match fault(&event) {
                    Some(fault) => {
                        let turn = self.lost(&fault, &mut connections, stop).await?;
                        self.pause = (self.pause * 2).min(RECONNECT_BROKEN_MAX);
                        turn
                    }
                    None => self.take(&event, &mut connections)?,
                },
                Ok(Some(Err(error))) => self.lost(&broken(&error), &mut connections, stop).await?,
                Ok(None) => break,
                Err(_) => Turn::Unread,
            };
            self.keep_tally(false);
            if matches!(turn, Turn::Unread) {
                self.keep_tally(true);
                return Ok(self.listener.heard);
            }
        }
        self.leave(&mut connections).await?;
        self.keep_tally(true);
        Ok(self.listener.heard)
    }

    /// The next event; none when `is_over`, an error when nobody reads any more. Looking at that, acknowledging what is settled, and saying what
    /// it was quiet for long enough to say, breaks off nothing that is under way: a slow broker has the client's own limit to answer in.
    async fn next(
        &mut self,
        is_over: impl Fn(&Acknowledgements) -> bool,
    ) -> std::io::Result<Option<Result<Event, ConnectionError>>> {
        let Self {
            client, events, listener, subscriptions, acknowledgements, out, connected, leaves, rehearsal, ..
        } = self;
        let mut poll = pin!(events.poll());
        loop {
            subscriptions.send(client);
            acknowledgements.send(client);
            if is_over(acknowledgements) {
                return Ok(None);
            }
            // Without a connection nothing can be heard, which is no silence.
            let due = if *connected && !*leaves { listener.due(Instant::now()) } else { Vec::new() };
            let mut shown = |line: &String| match rehearsal {
                Some(remark) => format!("after silence\n  says {}", remarked(line, *remark)),
                None => line.clone(),
            };
            due.iter().try_for_each(|line| write_line(out, &shown(line)))?;
            acknowledgements.written += due.len() as u64;
            tokio::select! {
                event = poll.as_mut() => return Ok(Some(event)),
                news = acknowledgements.news() => news?,
                () = sleep(POLL) => {}
            }
        }
    }

    fn keep_tally(&mut self, at_end: bool) {
        if let Some(tally) = &mut self.tally {
            tally.keep(&self.listener.fitted, at_end);
        }
    }

    fn take(&mut self, event: &Event, connections: &mut u64) -> Result<Turn, MqttError> {
        match event {
            Event::Incoming(Packet::ConnAck(greeting)) => {
                *connections += 1;
                (self.connected, self.pause) = (true, RECONNECT);
                correct_keep_alive(&mut self.events);
                self.recent.connect(greeting.session_present);
                self.listener.first_connection = *connections == 1;
                self.listener.listen_from(Instant::now());
                if let Some(held_back) = self.greetings.pass(clock::monotonic_ns()) {
                    tracing::info!(broker = self.broker, connections, held_back, "connected");
                }
                // Again at every connection: a broker that lost its sessions would say nothing any more.
                self.subscriptions.start();
            }
            Event::Outgoing(Outgoing::Subscribe(pkid)) => self.subscriptions.asked = Some(*pkid),
            Event::Outgoing(packet) => {
                self.recent.sent(packet);
                if matches!(packet, Outgoing::PubAck(_)) {
                    self.acknowledgements.on_way = self.acknowledgements.on_way.saturating_sub(1);
                    return self.say_held(*connections, |_, room| room);
                }
            }
            Event::Incoming(Packet::PingResp(_)) => self.recent.answered(),
            Event::Incoming(Packet::SubAck(answer)) => self.subscriptions.take(answer, &self.broker)?,
            Event::Incoming(Packet::Publish(_)) if self.leaves => {}
            Event::Incoming(Packet::Publish(message)) => {
                self.held_bytes += held_bytes(message);
                self.held.push_back(message.clone());
                return self.say_held(*connections, |_, room| room);
            }
            _ => {}
        }
        Ok(Turn::On)
    }

    /// Says what waits, oldest first, while `may` allows it, which hears whether there is room for one more, and where too much waits.
    fn say_held(&mut self, connections: u64, may: impl Fn(&Publish, bool) -> bool) -> Result<Turn, MqttError> {
        while let Some(message) = self.held.pop_front() {
            let room = self.acknowledgements.have_room() || self.held_bytes > HELD_BYTES_MAX;
            if !may(&message, room) {
                self.held.push_front(message);
                break;
            }
            self.held_bytes = self.held_bytes.saturating_sub(held_bytes(&message));
            let line = match self.recent.again(connections, &message) {
                Some(line) => line,
                None => {
                    if self.hear(&message).is_err() {
                        return Ok(Turn::Unread);
                    }
                    self.recent.take(connections, &message, self.acknowledgements.written);
                    self.acknowledgements.written
                }
            };
            self.acknowledgements.put(&message, line);
        }
        Ok(Turn::On)
    }

    /// Writes what a message says, or what becomes of it.
    fn hear(&mut self, message: &Publish) -> std::io::Result<()> {
        let (topic, payload, retained, now) = (&message.topic, &message.payload, message.retain, Instant::now());
        if let Some(remark) = &mut self.rehearsal {
            let outcomes = self.listener.outcomes(topic, payload, retained, now);
            let text = report(&self.listener.rules, (topic, payload, retained), &outcomes, *remark);
            return write_line(&mut self.out, &text);
        }
        let lines = self.listener.hear(topic, payload, retained, now);
        self.acknowledgements.written += lines.len() as u64;
        lines.iter().try_for_each(|line| write_line(&mut self.out, line))
    }

    /// Takes what was read before the connection broke: the broker sends it again and it is recognised. Then a pause.
    async fn lost(&mut self, error: &impl Display, connections: &mut u64, stop: &Stop) -> Result<Turn, MqttError> {
        // Whoever is asked to stop tries no more.
        if !stop.requested()
            && let Some(held_back) = self.log.pass(clock::monotonic_ns())
        {
            tracing::warn!(broker = self.broker, %error, held_back, "no connection, trying again");
        }
        let mut turn = self.drain(connections)?;
        if matches!(turn, Turn::On) {
            turn = self.say_held(*connections, |_, _| true)?;
        }
        // Subscriptions that were not sent are made again at the next connection.
        renew(&mut self.events);
        self.subscriptions.due = false;
        self.acknowledgements.forget();
        self.connected = false;
        let pause = Instant::now();
        while !stop.requested() && pause.elapsed() < self.pause {
            sleep(POLL).await;
        }
        Ok(turn)
    }

    fn drain(&mut self, connections: &mut u64) -> Result<Turn, MqttError> {
        while let Some(event) = self.events.state.events.pop_front() {
            if matches!(self.take(&event, connections)?, Turn::Unread) {
                return Ok(Turn::Unread);
            }
        }
        Ok(Turn::On)
    }

    /// Waits until what was said is settled and acknowledged, and sends a farewell behind that; then stays until the broker has closed the
    /// connection: it has read all then. What it sends meanwhile, and what nobody settles, is not acknowledged and comes again in the next session.
    async fn leave(&mut self, connections: &mut u64) -> Result<(), MqttError> {
        if !self.connected {
            return Ok(());
        }
        // What was read with an event before is said still: nobody has seen it yet. What waits comes again, but for what the broker does not keep.
        if matches!(self.drain(connections)?, Turn::Unread) {
            return Ok(());
        }
        self.held.retain(|message| message.qos == QoS::AtMostOnce);
        self.held_bytes = self.held.iter().map(held_bytes).sum();
        if matches!(self.say_held(*connections, |_, _| true)?, Turn::Unread) {
            return Ok(());
        }
        self.leaves = true;
        let end = Instant::now() + SETTLING;
        let is_settled = |open: &Acknowledgements| open.waiting.is_empty() || Instant::now() >= end;
        while let Ok(Some(event)) = self.next(is_settled).await {
            let Ok(event) = event else { return Ok(()) };
            self.take(&event, connections)?;
        }
        let end = tokio::time::Instant::now() + FAREWELL;
        // It finds no room while too many acknowledgements are on their way.
        let mut said = false;
        loop {
            said = said || self.client.try_disconnect().is_ok();
            let Ok(Ok(_)) = timeout_at(end, self.events.poll()).await else { return Ok(()) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mosquitto::{ANYBODY, Mosquitto, NO_BROKER};
    use crate::skipped::skipped;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rumqttc::v5::Client;
    use std::io::{BufRead, BufReader, Read};
    use std::process::Command;
    use std::sync::{Arc, Mutex, PoisonError};

    const RULES: &str = r#"
        [[rule]]
        topic = "home/binary_sensor/fridge_door/state"
        when = "on"
        say = "They open the fridge."

        [[rule]]
        topic = "home/+/+/json"
        field = "/state/power"
        say = "the {2} is {value}"
        person = 1
        retained = true
    "#;

    fn hear(listener: &mut Listener, topic: &str, payload: &str, retained: bool) -> Option<String> {
        let mut lines = listener.hear(topic.as_bytes(), payload.as_bytes(), retained, Instant::now());
        assert!(lines.len() <= 1, "{lines:?}");
        lines.pop()
    }

    #[test]
    fn rules_make_sentences() {
        let rules = Rules::parse(RULES).unwrap();
        let line =
            |topic: &str, payload: &[u8]| rules.readings(topic, payload).into_iter().find_map(|said| said.line?.ok());
        let fridge = line("home/binary_sensor/fridge_door/state", b"ON").unwrap();
        assert_eq!(fridge, r#"{"text":"They open the fridge."}"#);
        assert_eq!(rules.readings("home/binary_sensor/fridge_door/state", b"off")[0].line, None);
        let coffee = line("home/switch/coffee_maker/json", br#"{"state": {"power": "on"}}"#).unwrap();
        assert_eq!(coffee, r#"{"person":1,"text":"the coffee maker is on"}"#);
        assert!(rules.readings("home/switch/coffee_maker/json", b"{").is_empty());
        assert!(rules.readings("elsewhere", b"\xff\xfe").is_empty());
    }

    const SEVERAL: &str = r#"
        [[rule]]
        topic = "z/+"
        field = "/occupancy"
        when = "true"
        presence = "present"
        room = "{1}"

        [[rule]]
        topic = "z/+"
        field = "/state"
        when = "on"
        say = "They turn on the lamp."

        [[rule]]
        topic = "z/+"
        field = "/state"
        say = "the lamp is {value}"

        [[rule]]
        topic = "z/+"
        field = "/state"
        when = "on"
        presence = "present"
    "#;

    #[test]
    fn one_message_says_several_things() {
        let mut listener = Listener::new(Rules::parse(SEVERAL).unwrap());
        let mut said = |payload: &str| listener.hear(b"z/hall", payload.as_bytes(), false, Instant::now());
        assert_eq!(
            said(r#"{"occupancy": true, "state": "ON", "linkquality": 80}"#),
            [
                r#"{"presence":"present","room":"hall"}"#,
                r#"{"text":"They turn on the lamp."}"#,
                r#"{"presence":"present"}"#
            ]
        );
        assert!(said(r#"{"occupancy": true, "state": "ON", "linkquality": 81}"#).is_empty(), "both values repeat");
        assert_eq!(
            said(r#"{"occupancy": true, "state": "OFF"}"#),
            [r#"{"text":"the lamp is OFF"}"#],
            "one of two is news"
        );
        assert_eq!(said(r#"{"occupancy": false}"#), Vec::<String>::new());
        assert_eq!(said(r#"{"occupancy": true}"#).len(), 1);
        assert_eq!(listener.heard, Heard { said: 5, unfit: 1, silent: 1, ..Heard::default() });
    }

    #[test]
    fn a_person_is_named_by_the_payload() {
        let rules = "[[rule]]\ntopic = \"faces\"\nfield = \"/event\"\nwhen = \"seen\"\npresence = \"present\"\n\
            room = \"{/where/room}\"\nperson = \"{/name}\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let mut said = |payload: &str| hear(&mut listener, "faces", payload, false);
        let line = said(r#"{"event": "seen", "name": "ada", "where": {"room": "hall"}}"#).unwrap();
        assert_eq!(line, r#"{"person":"ada","presence":"present","room":"hall"}"#);
        assert_eq!(said(r#"{"event": "seen", "where": {"room": "hall"}}"#), None, "nobody is named");
    }

    #[test]
    fn a_rehearsal_tells_which_rule_says_what() {
        let mut listener = Listener::new(Rules::parse(SEVERAL).unwrap());
        let mut told = |topic: &str, payload: &str, retained| {
            let outcomes = listener.outcomes(topic.as_bytes(), payload.as_bytes(), retained, Instant::now());
            let mut remark = |line: &str| line.contains("kitchen").then(|| "no kitchen\u{1b}".to_owned());
            report(&listener.rules, (topic.as_bytes(), payload.as_bytes(), retained), &outcomes, &mut remark)
        };
        let on = r#"{"occupancy": true, "state": "ON"}"#;
        let text = told("z/hall", on, true);
        assert_eq!(text.matches("is silent: retained").count(), 3, "{text}");
        let text = told("z/kitchen", on, false);
        assert!(text.starts_with(&format!("z/kitchen  {on}\n")), "JSON can be read: {text}");
        let said = "\n  rule 1 says {\"presence\":\"present\",\"room\":\"kitchen\"}\n    no kitchen\\u001b\n";
        assert!(text.contains(said), "{text}");
        assert!(text.contains("\n  rule 2 says {\"text\":\"They turn on the lamp.\"}"), "{text}");
        assert!(text.contains("\n  rule 3 is silent: a rule before it"), "{text}");
        assert_eq!(told("z/kitchen", on, false).matches("is what the topic said before").count(), 3);
        assert!(
            told("z/kitchen", r#"{"occupancy": false}"#, false)
                .contains("rule 1 is silent: \"false\" is not its `when`")
        );
        let text = told("else\u{1b}[2J", "\u{7}", false);
        assert!(text.ends_with("no rule can read it") && !text.contains(['\u{1b}', '\u{7}']), "{text:?}");
        // What turns the direction of a line, or makes it long, does neither.
        let text = told("z/kitchen", &format!("{{\"state\": \"\u{202e}\u{9b}{}\"}}", "x".repeat(200)), false);
        assert!(text.starts_with("z/kitchen  {\"state\": \"\\u202e\\u009bxxx") && text.contains("xxx..."), "{text:?}");
        assert!(!text.contains(['\u{202e}', '\u{9b}']), "{text:?}");
        for (payload, lacks) in [("ON", "is no JSON"), (r#"{"linkquality": 80}"#, "has nothing at /occupancy")] {
            let text = told("z/hall", payload, false);
            assert!(text.ends_with(&format!("\n  rule 1 cannot read it: the payload {lacks}")), "{text}");
        }
    }

    #[test]
    fn what_an_unread_payload_lacks_is_known() {
        let rules = Rules::parse(
            "[[rule]]\ntopic = \"lamp\"\nsay = \"the lamp is {value}\"\n[[rule]]\ntopic = \"face\"\n\
            field = \"/event\"\npresence = \"present\"\nperson = \"{/name}\"",
        );
        let rules = rules.unwrap();
        let lack = |topic, payload: &[u8]| rules.unreadable(topic, payload);
        assert_eq!(lack("lamp", b"on"), None);
        assert_eq!(lack("else", b"on"), None, "no rule listens there");
        assert_eq!(lack("lamp", b"\xff"), Some((1, "is no text".to_owned())));
        assert_eq!(lack("lamp", b" "), Some((1, "is empty".to_owned())));
        assert_eq!(lack("face", b"seen"), Some((2, "is no JSON".to_owned())));
        assert_eq!(lack("face", br#"{"name": "ada"}"#), Some((2, "has nothing at /event".to_owned())));
        assert_eq!(lack("face", br#"{"event": "seen"}"#), Some((2, "has nothing at /name".to_owned())));
        assert_eq!(lack("face", br#"{"event": "seen", "name": "ada"}"#), None);
    }

    /// A retained message that is taken away comes as an empty one: it says of nobody that they are away.
    #[test]
    fn an_empty_payload_says_nothing() {
        let rules =
            "[[rule]]\ntopic = \"person\"\nunless = [\"home\", \"unknown\"]\npresence = \"away\"\nperson = \"ada\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        for (payload, lines) in [("", 0), (" \n", 0), ("home", 0), ("not_home", 1)] {
            assert_eq!(listener.hear(b"person", payload.as_bytes(), false, Instant::now()).len(), lines, "{payload:?}");
        }
    }

    /// Of a payload of JSON a rule names the values; all of it is no words of a sentence.
    #[test]
    fn an_object_in_braces_is_not_said() {
        let rules = "[[rule]]\ntopic = \"lamp\"\nsay = \"the lamp is {value}\"\n[[rule]]\ntopic = \"plug\"\n\
            field = \"/state\"\nsay = \"the plug is {value}, {/more}\"\n[[rule]]\ntopic = \"door\"\nsay = \"They use the door.\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let mut hear =
            |topic: &str, payload: &str| listener.hear(topic.as_bytes(), payload.as_bytes(), false, Instant::now());
        assert!(hear("lamp", r#"{"state": "on"}"#).is_empty() && hear("lamp", "[1, 2]").is_empty());
        assert!(hear("plug", r#"{"state": "on", "more": {"a": 1}}"#).is_empty());
        assert_eq!(hear("plug", r#"{"state": "off", "more": "idle"}"#), [r#"{"text":"the plug is off, idle"}"#]);
        assert_eq!(hear("lamp", "{on"), [r#"{"text":"the lamp is {on"}"#], "no JSON");
        assert_eq!(hear("door", r#"{"state": "on"}"#).len(), 1, "it says nothing of the value");
        assert_eq!(listener.heard, Heard { said: 3, unsayable: 3, ..Heard::default() });
    }

    #[test]
    fn an_address_without_a_scheme_is_told_with_one() {
        let told = |address: &str| {
            let broker = Broker { address: address.to_owned(), ..Broker::default() };
            broker.options().unwrap_err().to_string()
        };
        assert!(told("192.168.1.5:1884").ends_with("with a CA file, here mqtt://192.168.1.5:1884"));
        assert!(told("broker.lan").ends_with("with a CA file, here mqtt://broker.lan:1883"));
        for address in ["tcp://broker.lan", "", "a:b:c"] {
            assert!(told(address).ends_with("with a CA file"), "{}", told(address));
        }
    }

    #[test]
    fn missing_rules_are_told_with_the_whole_path() {
        let told = Rules::load(Path::new("no-such-rules.toml")).unwrap_err().to_string();
        let whole = std::path::absolute("no-such-rules.toml").unwrap();
        assert!(told.contains(&whole.display().to_string()), "{told}");
    }

    /// What programs and devices of smart homes send, in their own shapes.
    #[test]
    fn devices_of_many_makers_are_understood() {
        let rules = r#"
            [[rule]]
            topic = "zigbee2mqtt/hall_motion"
            field = "/occupancy"
            when = "true"
            presence = "present"
            room = "hall"
            [[rule]]
            topic = "zigbee2mqtt/fridge"
            field = "/contact"
            when = "false"
            say = "They open the fridge."
            [[rule]]
            topic = "zigbee2mqtt/button"
            field = "/action"
            when = "single"
            repeats = true
            say = "They press the button."
            [[rule]]
            topic = "stat/+/POWER"
            when = "ON"
            say = "They turn on the {1}."
            [[rule]]
            topic = "tele/door/SENSOR"
            field = "/Switch1"
            when = "ON"
            say = "They open the front door."
            [[rule]]
            topic = "esp-bath/binary_sensor/motion/state"
            when = "ON"
            presence = "present"
            room = "bathroom"
            [[rule]]
            topic = "frigate/+/person"
            unless = ["0"]
            presence = "present"
            room = "{1}"
            [[rule]]
            topic = "shellies/+/input_event/0"
            field = "/event"
            when = "S"
            say = "They press the {1}."
            [[rule]]
            topic = "owntracks/+/phone/event"
            field = "/event"
            when = "leave"
            presence = "away"
            person = "{1}"
            [[rule]]
            topic = "homeassistant/person/ada/state"
            when = "home"
            presence = "present"
            person = "Ada"
            [[rule]]
            topic = "homeassistant/person/ada/state"
            unless = ["home", "unknown", "unavailable"]
            presence = "away"
            person = "Ada""#;
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        for (topic, payload, expected) in [
            (
                "zigbee2mqtt/hall_motion",
                r#"{"battery":97,"illuminance":12,"occupancy":true,"linkquality":120}"#,
                r#"{"presence":"present","room":"hall"}"#,
            ),
            ("zigbee2mqtt/hall_motion", r#"{"battery":96,"occupancy":true}"#, ""),
            ("zigbee2mqtt/hall_motion", r#"{"battery":96}"#, ""),
            (
                "zigbee2mqtt/fridge",
                r#"{"battery":100,"contact":false,"voltage":3005}"#,
                r#"{"text":"They open the fridge."}"#,
            ),
            ("zigbee2mqtt/button", r#"{"action":"single"}"#, r#"{"text":"They press the button."}"#),
            ("zigbee2mqtt/button", r#"{"battery":88}"#, ""),
            ("zigbee2mqtt/button", r#"{"action":"single"}"#, r#"{"text":"They press the button."}"#),
            ("stat/coffee_maker/POWER", "ON", r#"{"text":"They turn on the coffee maker."}"#),
            (
                "tele/door/SENSOR",
                r#"{"Time":"2025-11-24T07:30:00","Switch1":"ON"}"#,
                r#"{"text":"They open the front door."}"#,
            ),
            ("esp-bath/binary_sensor/motion/state", "ON", r#"{"presence":"present","room":"bathroom"}"#),
            ("frigate/kitchen/person", "0", ""),
            ("frigate/kitchen/person", "2", r#"{"presence":"present","room":"kitchen"}"#),
            (
                "shellies/door_bell/input_event/0",
                r#"{"event":"S","event_cnt":7}"#,
                r#"{"text":"They press the door bell."}"#,
            ),
            (
                "owntracks/ada/phone/event",
                r#"{"_type":"transition","event":"leave","desc":"Home"}"#,
                r#"{"person":"ada","presence":"away"}"#,
            ),
            ("homeassistant/person/ada/state", "home", r#"{"person":"Ada","presence":"present"}"#),
            // Another zone than home is out of the house, and what Home Assistant does not know is nothing.
            ("homeassistant/person/ada/state", "unavailable", ""),
            ("homeassistant/person/ada/state", "home", ""),
            ("homeassistant/person/ada/state", "Work", r#"{"person":"Ada","presence":"away"}"#),
            ("homeassistant/person/ada/state", "unknown", ""),
            ("homeassistant/person/ada/state", "not_home", r#"{"person":"Ada","presence":"away"}"#),
        ] {
            let said = hear(&mut listener, topic, payload, false).unwrap_or_default();
            assert_eq!(said, expected, "{topic} {payload}");
        }
    }

    #[test]
    fn a_device_that_was_not_heard_for_a_while_has_done_nothing() {
        let rules = "[[rule]]\ntopic = \"door\"\nwhen = \"off\"\nsay = \"They close the door.\"\n\
            [[rule]]\ntopic = \"watched\"\nwhen = \"unavailable\"\nsay = \"the lamp is gone\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let said = ["off", "unavailable", "off", "unknown", "off", "on", "off"]
            .map(|value| hear(&mut listener, "door", value, false).is_some());
        assert_eq!(said, [true, false, false, false, false, false, true]);
        let said = ["unavailable", "unavailable", "on", "unavailable"]
            .map(|value| hear(&mut listener, "watched", value, false).is_some());
        assert_eq!(said, [true, false, false, true], "a rule that speaks of it");
        let mut rehearsed =
            Listener::new(Rules::parse("[[rule]]\ntopic = \"a\"\nunless = [\"0\"]\npresence = \"present\"").unwrap());
        let outcomes = rehearsed.outcomes(b"a", b"0", false, Instant::now());
        assert!(
            report(&rehearsed.rules, (b"a", b"0", false), &outcomes, &mut |_| None)
                .ends_with("\"0\" is in its `unless`")
        );
    }

    #[test]
    fn rules_say_who_is_where() {
        let rules = "[[rule]]\ntopic = \"motion/+\"\nwhen = \"on\"\npresence = \"present\"\nroom = \"{1}\"\n\
            [[rule]]\ntopic = \"phone/+\"\nwhen = \"not_home\"\npresence = \"away\"\nperson = \"{1}\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let mut said = |topic, payload| hear(&mut listener, topic, payload, false);
        assert_eq!(said("motion/living_room", "on").unwrap(), r#"{"presence":"present","room":"living room"}"#);
        assert_eq!(said("phone/ada", "not_home").unwrap(), r#"{"person":"ada","presence":"away"}"#);
        assert_eq!(said("phone/ada", "home"), None);
    }

    #[test]
    fn silence_after_the_front_door_says_that_they_are_away() {
        let rules = "[[rule]]\ntopic = \"door\"\nwhen = \"closed\"\nsay = \"They close the front door.\"\n\
            [[rule]]\ntopic = \"door\"\nwhen = \"closed\"\npresence = \"away\"\nperson = \"ada\"\nquiet_s = 600.0\n\
            [[rule]]\ntopic = \"door\"\nwhen = \"closed\"\npresence = \"away\"\nperson = \"ben\"\nquiet_s = 900.0\n\
            [[rule]]\ntopic = \"motion\"\nwhen = \"on\"\npresence = \"present\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let door = |listener: &mut Listener, value: &str, seconds| {
            !listener.hear(b"door", value.as_bytes(), false, at(seconds)).is_empty()
        };
        assert!(door(&mut listener, "closed", 0));
        assert_eq!(listener.hear(b"motion", b"on", false, at(300)).len(), 1);
        assert_eq!(listener.due(at(10_000)), Vec::<String>::new(), "somebody moved");
        // Opening it says nothing, so it breaks no silence; closing it begins the silence again.
        assert!(!door(&mut listener, "open", 20_000) && door(&mut listener, "closed", 20_100));
        assert!(!door(&mut listener, "open", 20_200) && door(&mut listener, "closed", 20_300));
        assert!(!door(&mut listener, "closed", 20_400), "a value that repeats says nothing new");
        assert_eq!(listener.due(at(20_899)), Vec::<String>::new());
        // One silence does not end the other.
        assert_eq!(listener.due(at(20_900)), [r#"{"person":"ada","presence":"away"}"#]);
        assert_eq!(listener.due(at(21_200)), [r#"{"person":"ben","presence":"away"}"#]);
        assert_eq!(listener.due(at(99_999)), Vec::<String>::new());
        // Time without a connection is no silence.
        assert!(!door(&mut listener, "open", 100_000) && door(&mut listener, "closed", 100_000));
        listener.listen_from(at(100_599));
        assert_eq!(listener.due(at(101_198)), Vec::<String>::new());
        assert_eq!(listener.due(at(101_199)).len(), 1);
        // What is retained from before this process is no event.
        listener.first_connection = true;
        assert!(listener.hear(b"door", b"open", true, at(200_000)).is_empty());
        assert!(listener.hear(b"door", b"closed", true, at(200_000)).is_empty());
        assert_eq!(listener.due(at(300_000)).len(), 1, "ben's silence of before");
        assert_eq!(listener.heard, Heard { said: 9, unfit: 4, silent: 2, ..Heard::default() });
    }

    #[test]
    fn filters_fit_as_mqtt_has_it() {
        assert_eq!(matches("a/+/c", "a/b/c"), Some(vec!["b"]));
        assert_eq!(matches("a/#", "a/b/c"), Some(vec![]));
        assert_eq!(matches("a/#", "a"), Some(vec![]));
        assert_eq!(matches("a/+", "a/b/c"), None);
        assert_eq!(matches("a/b/c", "a/b"), None);
    }

    #[test]
    fn malformed_rules_are_named() {
        for (text, part) in [
            ("[[rule]]\ntopic = \"a/b#\"\nsay = \"x\"", "rule 1: the topic"),
            ("[[rule]]\ntopic = \"#/b\"\nsay = \"x\"", "rule 1: the topic"),
            ("[[rule]]\ntopic = \"a\"\nsay = \" \"", "rule 1: say is empty"),
            ("[[rule]]\ntopic = \"a/+\"\nsay = \"the {2} is {value}\"", "rule 1: say has {2}; it knows {value}, {1}"),
            (
                "[[rule]]\ntopic = \"a\"\npresence = \"present\"\nroom = \"{1}\"",
                "rule 1: room has {1}; it knows {value}",
            ),
            (
                "[[rule]]\ntopic = \"a\"\npresence = \"home\"",
                "unknown variant `home`, expected one of `present`, `away`, `gone`, `empty`",
            ),
            ("[[rule]]\ntopic = \"a\"\npresence = \"empty\"", "rule 1: presence = \"empty\" says that nobody"),
            ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nperson = -1", "expected a person's number"),
            ("[[rule]]\ntopic = \"a\"", "rule 1: give say or presence"),
            ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nfield = \"state\"", "JSON pointer"),
            (
                "[[rule]]\ntopic = \"a\"\nsay = \"x\"\nwhen = \"on\"\nunless = [\"off\"]",
                "rule 1: when and unless exclude",
            ),
            ("[[rule]]\ntopic = \"a\"\nsays = \"x\"", "unknown field"),
        ] {
            let error = Rules::parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
        let folder = tempfile::tempdir().unwrap();
        let error = Rules::load(&pem(folder.path(), "rules.toml", "")).unwrap_err().to_string();
        assert!(error.ends_with("docs/mqtt.md shows what they look like"), "{error}");
    }

    #[test]
    fn what_no_rule_speaks_of_makes_the_next_value_news() {
        let mut listener = Listener::new(Rules::parse(RULES).unwrap());
        let door = "home/binary_sensor/fridge_door/state";
        let said =
            ["on", "on", "off", "on", "off", "on"].map(|value| hear(&mut listener, door, value, false).is_some());
        assert_eq!(said, [true, false, false, true, false, true]);
        assert_eq!(listener.heard, Heard { said: 3, unfit: 2, silent: 1, ..Heard::default() });
    }

    #[test]
    fn retained_and_repeated_messages_say_nothing_new() {
        let mut listener = Listener::new(Rules::parse(RULES).unwrap());
        let door = "home/binary_sensor/fridge_door/state";
        let oven = "home/switch/oven/json";
        assert_eq!(hear(&mut listener, door, "on", true), None);
        assert!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, true).unwrap().contains("the oven is on"));
        assert_eq!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, false), None);
        listener.first_connection = false;
        // Retained again after a reconnection: changed while away, so it is an event; the same, so it is not.
        assert_eq!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, true), None);
        assert!(hear(&mut listener, oven, r#"{"state": {"power": "off"}}"#, true).unwrap().contains("the oven is off"));
        assert_eq!(listener.heard, Heard { said: 2, unfit: 0, silent: 3, ..Heard::default() });
    }

    #[test]
    fn addresses_and_their_faults() {
        let broker = |address: &str| Broker { address: address.into(), client: "test".into(), ..Broker::default() };
        assert_eq!(broker("mqtt://hub").options().unwrap().broker_address(), ("hub".into(), 1883));
        assert_eq!(broker("mqtt://hub:99").options().unwrap().broker_address(), ("hub".into(), 99));
        assert_eq!(broker("mqtt://hub:99/").options().unwrap().broker_address(), ("hub".into(), 99));
        assert_eq!(broker("mqtt://[::1]").options().unwrap().broker_address(), ("[::1]".into(), 1883));
        assert_eq!(broker("mqtt://[::1]:99").options().unwrap().broker_address(), ("[::1]".into(), 99));
        for wrong in [
            "hub",
            "http://hub",
            "mqtt://",
            "mqtt://hub:port",
            "mqtt://hub:99999",
            "mqtt://::1",
            "mqtt://hub/a",
            "mqtt://a:1:2",
        ] {
            assert!(matches!(broker(wrong).options(), Err(MqttError::Address { .. })), "{wrong}");
        }
        let login = broker("mqtt://home:secret@hub").options().unwrap_err().to_string();
        assert!(login.contains("--mqtt-credentials FILE") && !login.contains("secret"), "{login}");
        let folder = tempfile::tempdir().unwrap();
        let with = |address: &str, authority| Broker { authority, ..broker(address) }.options().unwrap_err();
        let text = Some(pem(folder.path(), "text", "no certificate"));
        assert!(with("mqtts://hub", None).to_string().contains("without a CA file"));
        assert!(with("mqtt://hub", text.clone()).to_string().contains("with a CA file"));
        assert!(matches!(with("mqtts://hub", text), MqttError::Authority { .. }));
        assert!(matches!(with("mqtts://hub", Some(folder.path().join("nowhere"))), MqttError::Read { .. }));
        for text in ["robot\n", "robot", "", "\nsecret\n"] {
            let credentials = Some(pem(folder.path(), "short", text));
            let broker = Broker { credentials, address: "mqtt://hub".to_owned(), ..Broker::default() };
            let error = broker.options().unwrap_err();
            assert!(matches!(error, MqttError::Credentials { .. }), "{text:?}: {error}");
        }
    }

    /// A PEM file, and its path.
    fn pem(folder: &Path, name: &str, text: &str) -> PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// An authority that signs a certificate for this machine; gives the authority's certificate, and the other with its key.
    fn certificates() -> (String, String, String) {
        use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
        let mut params = CertificateParams::new(Vec::new()).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
        let own = params.signed_by(&key, &authority).unwrap();
        (authority.as_ref().pem(), own.pem(), key.serialize_pem())
    }

    /// How a connection that must not come about ends: with what the client says of its first attempt.
    fn refusal(broker: &Broker) -> String {
        let (_client, mut connection) = Client::new(broker.options().unwrap(), 10);
        connection.recv().unwrap().unwrap_err().to_string()
    }

    /// TLS with certificates of an own authority, and credentials from a file.
    #[test]
    fn a_broker_is_reached_by_tls_with_credentials_and_by_nobody_else() {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let folder = tempfile::tempdir().unwrap();
        let (authority, own, key) = certificates();
        let authority = pem(folder.path(), "authority.pem", &authority);
        let (own, key) = (pem(folder.path(), "broker.pem", &own), pem(folder.path(), "broker.key", &key));
        let passwords = folder.path().join("passwords");
        let made =
            Command::new("mosquitto_passwd").args(["-b", "-c"]).arg(&passwords).args(["robot", "secret"]).output();
        if !made.is_ok_and(|made| made.status.success()) {
            skipped(NO_BROKER);
            return;
        }
        let (authority_path, own, key) = (authority.display(), own.display(), key.display());
        let access = format!(
            "cafile {authority_path}\ncertfile {own}\nkeyfile {key}\nallow_anonymous false\npassword_file {}",
            passwords.display()
        );
        let Some(_broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), &access) else {
            skipped(NO_BROKER);
            return;
        };
        let to = Broker {
            address: format!("mqtts://localhost:{port}"),
            client: "listener".into(),
            credentials: Some(pem(folder.path(), "credentials", "robot\nsecret\n")),
            authority: Some(authority.clone()),
        };

        // Another authority, another password, no TLS: no connection.
        let stranger = pem(folder.path(), "stranger.pem", &certificates().0);
        let error = refusal(&Broker { authority: Some(stranger), ..to.clone() });
        assert!(error.contains("certificate"), "{error}");
        let wrong = pem(folder.path(), "wrong", "robot\nguess\n");
        let error = refusal(&Broker { credentials: Some(wrong), ..to.clone() });
        assert!(error.contains("NotAuthorized") || error.contains("BadUserNamePassword"), "{error}");
        refusal(&Broker { address: format!("mqtt://localhost:{port}"), authority: None, ..to.clone() });

        let rules =
            Rules::parse("[[rule]]\ntopic = \"home/oven\"\nsay = \"the oven is {value}\"\nretained = true").unwrap();
        let (reader, writer) = std::io::pipe().unwrap();
        let stop = Stop::new();
        let (own_stop, own_options) = (stop.clone(), to.options().unwrap());
        let listening = std::thread::spawn(move || listen(own_options, rules, writer, &own_stop));
        let (client, mut connection) = Client::new(Broker { client: "publisher".into(), ..to }.options().unwrap(), 10);
        client.try_publish("home/oven", QoS::AtLeastOnce, true, "on").unwrap();
        while !matches!(connection.recv().unwrap().unwrap(), Event::Incoming(Packet::PubAck(_))) {}
        let line = BufReader::new(reader).lines().next().unwrap().unwrap();
        assert!(line.contains("the oven is on"), "{line}");
        stop.request();
        assert_eq!(listening.join().unwrap().unwrap().said, 1);
    }

    /// Two clients of one name at a real broker: whoever loses its place is told what it may be.
    #[tokio::test]
    async fn a_client_whose_place_is_taken_says_so() {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let Some(_broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        let address = format!("mqtt://127.0.0.1:{port}");
        let broker = Broker { address, client: "roomcast-home".to_owned(), credentials: None, authority: None };
        let client = || AsyncClient::new(broker.options().unwrap(), 4);
        let ((_one, mut first), (_other, mut second)) = (client(), client());
        while !matches!(first.poll().await, Ok(Event::Incoming(Packet::ConnAck(_)))) {}
        while !matches!(second.poll().await, Ok(Event::Incoming(Packet::ConnAck(_)))) {}
        let error = loop {
            if let Err(error) = first.poll().await {
                break error;
            }
        };
        assert!(broken(&error).contains("another client has this one's name"), "{error}");
    }

    /// A real broker with retained messages, restarted in the middle: the narration is complete and in order.
    #[test]
    fn nothing_is_lost_over_a_restart_of_the_broker() {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        broker.publish(&[("home/switch/oven/json", r#"{"state": {"power": "on"}}"#.into(), true)]);
        let rules = Rules::parse("[[rule]]\ntopic = \"home/step\"\nsay = \"They do step {value}.\"\n[[rule]]\ntopic = \"home/+/+/json\"\nfield = \"/state/power\"\nsay = \"the {2} is {value}\"\nretained = true").unwrap();
        let (reader, writer) = std::io::pipe().unwrap();
        let stop = Stop::new();
        let own_stop = stop.clone();
        let to = Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "listener".into(), ..Broker::default() };
        let listening = std::thread::spawn(move || listen(to.options().unwrap(), rules, writer, &own_stop));
        let mut lines = BufReader::new(reader).lines().map(Result::unwrap);
        // What is retained comes first: the subscription stands.
        assert!(lines.next().unwrap().contains("the oven is on"));
        let steps =
            |range: std::ops::Range<u32>| range.map(|n| ("home/step", n.to_string(), false)).collect::<Vec<_>>();
        // So many that it is known to count its identifiers.
        broker.publish(&steps(1000..1100));
        for n in 1000..1100 {
            assert!(lines.next().unwrap().contains(&format!("They do step {n}.")));
        }
        broker.publish(&steps(0..50));
        let broker = broker.restart();
        // The listener may not be back yet: its session is.
        broker.publish(&steps(50..100));
        for n in 0..100 {
            let line = lines.next().unwrap();
            assert!(line.contains(&format!("They do step {n}.")), "step {n}: {line}");
        }
        stop.request();
        let heard = listening.join().unwrap().unwrap();
        assert_eq!((heard.said, heard.unfit), (201, 0));
    }

    /// Held by tests that look at the memory of this process: one must not see what the other's messages take.
    static MEMORY: Mutex<()> = Mutex::new(());

    /// Memory that this process has, in bytes.
    fn resident() -> u64 {
        let text = std::fs::read_to_string("/proc/self/status").unwrap();
        let kilobytes = text.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
        kilobytes.unwrap().parse::<u64>().unwrap() << 10
    }

    /// A listener in a thread of its own, and what it says.
    struct Listening {
        thread: std::thread::JoinHandle<Result<Heard, MqttError>>,
        lines: std::io::Lines<BufReader<std::io::PipeReader>>,
        stop: Stop,
    }

    impl Listening {
        fn start(port: u16, rules: &str) -> Self {
            let to =
                Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "listener".into(), ..Broker::default() };
            let (reader, writer) = std::io::pipe().unwrap();
            let (stop, rules) = (Stop::new(), Rules::parse(rules).unwrap());
            let own_stop = stop.clone();
            let thread = std::thread::spawn(move || listen(to.options().unwrap(), rules, writer, &own_stop));
            Self { thread, lines: BufReader::new(reader).lines(), stop }
        }

        fn next(&mut self) -> Option<String> {
            self.lines.next().map(Result::unwrap)
        }

        /// Stops it as a signal does; what it still says, and its counts.
        fn end(self) -> (Vec<String>, Heard) {
            self.stop.request();
            let rest = self.lines.map(Result::unwrap).collect();
            (rest, self.thread.join().unwrap().unwrap())
        }
    }

    fn free_port() -> u16 {
        std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
    }

    /// What a stand-in for a broker greets with.
    const CONNACK: [u8; 5] = [0x20, 3, 0, 0, 0];

    const STEPS: &str = "[[rule]]\ntopic = \"home/step\"\nsay = \"They do step {value}.\"";

    /// A rehearsal beside the narrator of the same name: it tells what would be said, and the narrator's session keeps every message.
    #[test]
    fn a_rehearsal_takes_nothing_from_the_narrator() {
        let port = free_port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        broker.publish(&[("home/start", "first".into(), true)]);
        let rules =
            format!("{STEPS}\n[[rule]]\ntopic = \"home/start\"\nsay = \"They do the {{value}}.\"\nretained = true");
        let mut first = Listening::start(port, &rules);
        assert!(first.next().unwrap().contains("the first"));
        first.end();
        broker.publish(&[("home/step", "1".into(), false)]);

        let to = Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "listener".into(), ..Broker::default() };
        let (reader, writer) = std::io::pipe().unwrap();
        let (stop, own) = (Stop::new(), Rules::parse(&rules).unwrap());
        let own_stop = stop.clone();
        let rehearsal =
            std::thread::spawn(move || rehearse(to.options().unwrap(), own, writer, &own_stop, &mut |_| None));
        let mut lines = BufReader::new(reader).lines().map(Result::unwrap);
        assert_eq!(lines.next().unwrap(), "home/start  first  (retained)");
        assert_eq!(lines.next().unwrap(), r#"  rule 2 says {"text":"They do the first."}"#);
        broker.publish(&[("home/step", "2".into(), false)]);
        assert_eq!(lines.next().unwrap(), "home/step  2");
        assert_eq!(lines.next().unwrap(), r#"  rule 1 says {"text":"They do step 2."}"#);
        stop.request();
        assert_eq!(rehearsal.join().unwrap().unwrap().said, 2);

        let mut second = Listening::start(port, &rules);
        let said: Vec<_> = (0..3).map(|_| second.next().unwrap()).collect();
        for step in ["step 1", "step 2"] {
            assert!(said.iter().any(|line| line.contains(step)), "{said:?}");
        }
        second.end();
    }

    /// Row "MQTT backlog" of the attacks. `ROOMCAST_MQTT_RESTARTS=1000` is the long form; a restart takes about a second.
    /// `ROOMCAST_MQTT_SEED` chooses other moments.
    #[test]
    fn a_backlog_of_5000_messages_is_said_once_and_in_order_over_restarts() {
        const BACKLOG: u32 = 5_000;
        let _alone = MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
        let restarts = std::env::var("ROOMCAST_MQTT_RESTARTS").map_or(6, |text| text.parse().unwrap());
        let port = free_port();
        let Some(mut broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        let seed = std::env::var("ROOMCAST_MQTT_SEED").map_or(22, |text| text.parse().unwrap());
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // Its session stands when what is said after it has come.
        broker.publish(&[("home/start", "first".into(), true)]);
        let start = "[[rule]]\ntopic = \"home/start\"\nsay = \"They do the {value}.\"\nretained = true";
        let mut first = Listening::start(port, &format!("{STEPS}\n{start}"));
        assert!(first.next().unwrap().contains("the first"));
        assert_eq!(first.end().1.said, 1);
        let before = resident();
        let mut largest = 0;
        let (mut published, mut said) = (0, 0);
        let mut check = |line: &str| {
            assert!(line.contains(&format!("They do step {said}.")), "step {said}: {line}");
            said += 1;
            said
        };
        for restart in 0..restarts {
            let backlog: Vec<_> =
                (published..published + BACKLOG).map(|n| ("home/step", n.to_string(), false)).collect();
            broker.publish(&backlog);
            published += BACKLOG;
            // One is asked to stop in the middle of the backlog, and the next one goes on; now and then the broker restarts, too.
            if restart % 3 == 2 {
                broker = broker.restart();
            }
            let mut listening = Listening::start(port, STEPS);
            for _ in 0..rng.random_range(0..BACKLOG) {
                check(&listening.next().unwrap());
            }
            largest = largest.max(resident().saturating_sub(before));
            let (rest, heard) = listening.end();
            assert_eq!((heard.unfit, heard.oversized), (0, 0));
            let mut now = rest.iter().map(|line| check(line)).last().unwrap_or_default();
            let mut listening = Listening::start(port, STEPS);
            let mut middle = (restart % 3 == 1).then(|| published - rng.random_range(0..BACKLOG / 2));
            while now < published {
                now = check(&listening.next().unwrap());
                if middle.is_some_and(|middle| now >= middle) {
                    middle = None;
                    broker = broker.restart();
                    // It is behind all that the broker sends again: whoever has said it has acknowledged that.
                    broker.publish(&[("home/step", published.to_string(), false)]);
                    published += 1;
                }
            }
            let (rest, _heard) = listening.end();
            assert_eq!(rest, Vec::<String>::new());
        }
        println!("{restarts} restarts, {published} messages, at most {largest} bytes more than before");
        assert!(largest < 64 << 20, "{largest} bytes more");
    }

    /// Hears lines as a daemon takes them that is slower than the broker.
    struct Slow(Arc<Mutex<Vec<u8>>>);

    impl Write for Slow {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            std::thread::sleep(Duration::from_millis(2));
            Ok(())
        }
    }

    /// mosquitto 2.0.11 sends its whole queue at once, however few messages it was told to send ahead.
    #[test]
    fn who_is_killed_in_a_backlog_says_few_messages_twice() {
        const BACKLOG: u64 = 2_000;
        let port = free_port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        let (mut next, mut twice, mut lives) = (0, 0, 0);
        let mut live = |most: Duration| {
            let to =
                Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "killed".into(), ..Broker::default() };
            let (out, stop) = (Arc::new(Mutex::new(Vec::new())), Stop::new());
            let connection =
                Connection::new(to.options().unwrap(), Rules::parse(STEPS).unwrap(), Slow(Arc::clone(&out)));
            let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().unwrap();
            // It is gone from one moment to the next, without a farewell.
            let killed =
                runtime.block_on(async { tokio::time::timeout(most, connection.listen(&stop)).await.is_err() });
            assert!(killed);
            let said = String::from_utf8(std::mem::take(&mut *out.lock().unwrap())).unwrap();
            let steps = said.lines().map(|line| {
                let (_, step) = line.split_once("step ").unwrap();
                step.split_once('.').unwrap().0.parse::<u64>().unwrap()
            });
            let steps: Vec<u64> = steps.collect();
            let Some(first) = steps.first().copied() else { return next };
            assert!(
                first <= next && next - first <= u64::from(MESSAGES_AHEAD_MAX),
                "{next} is next, and {first} is said"
            );
            assert!(steps.iter().copied().eq(first..first + steps.len() as u64), "{steps:?}");
            (twice, lives) = (twice + next - first, lives + 1);
            next = first + steps.len() as u64;
            next
        };
        // The session, and then what waits for it.
        live(Duration::from_millis(300));
        let backlog: Vec<_> = (0..BACKLOG).map(|n| ("home/step", n.to_string(), false)).collect();
        broker.publish(&backlog);
        let began = Instant::now();
        while live(Duration::from_millis(700)) < BACKLOG {
            assert!(began.elapsed() < Duration::from_secs(120));
        }
        println!("{lives} lives, {BACKLOG} messages, {twice} of them twice");
        assert!(lives > 2);
    }

    #[test]
    fn silence_behind_a_real_broker_is_said_when_it_has_lasted() {
        let port = free_port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        let door = "[[rule]]\ntopic = \"home/door\"\nwhen = \"closed\"\npresence = \"away\"\nquiet_s = 1.0";
        broker.publish(&[("home/step", "first".into(), true)]);
        let mut listening = Listening::start(port, &format!("{STEPS}\nretained = true\n{door}"));
        assert!(listening.next().unwrap().contains("step first"));
        // A step that follows breaks the silence of the first closing, and nothing that of the second.
        broker.publish(&[("home/door", "closed".into(), false), ("home/step", "next".into(), false)]);
        assert!(listening.next().unwrap().contains("step next"));
        broker.publish(&[("home/door", "open".into(), false), ("home/door", "closed".into(), false)]);
        let closed = Instant::now();
        assert_eq!(listening.next().unwrap(), r#"{"presence":"away"}"#);
        assert!(closed.elapsed() > Duration::from_millis(500), "it waited: {:?}", closed.elapsed());
        assert_eq!(listening.end().0, Vec::<String>::new());
    }

    /// Row "MQTT payloads of 10 MB" of the attacks.
    #[test]
    fn oversized_messages_are_refused_by_name_and_passed_over() {
        let _alone = MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
        let port = free_port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        broker.publish(&[("home/step", "first".into(), true)]);
        let rules =
            format!("{STEPS}\nretained = true\n[[rule]]\ntopic = \"home/camera\"\nsay = \"They look at {{value}}.\"");
        let mut listening = Listening::start(port, &rules);
        assert!(listening.next().unwrap().contains("step first"));
        let before = resident();
        let of = |bytes: usize| "x".repeat(bytes);
        for round in 0..6 {
            // What the broker passes over itself, what is refused here, and what is narration after all.
            broker.publish(&[("home/camera", of(10 << 20), false), ("home/camera", of(17 << 20), false)]);
            broker.publish(&[("home/camera", of(PAYLOAD_BYTES_MAX + 1), false)]);
            broker.publish(&[("home/camera", of(PACKET_BYTES_MAX as usize - 64), false)]);
            broker.publish(&[("home/step", round.to_string(), false)]);
            assert!(listening.next().unwrap().contains(&format!("They do step {round}.")));
        }
        let more = resident().saturating_sub(before);
        let (rest, heard) = listening.end();
        assert_eq!((rest.len(), heard.said, heard.oversized), (0, 7, 12));
        assert!(more < 128 << 20, "{more} bytes more");
    }

    /// Row "a refused subscription" of the attacks. mosquitto's own list of rights grants every subscription, so the broker is a stand-in.
    #[test]
    fn a_refused_subscription_is_an_error_with_its_name() {
        const NOT_AUTHORIZED: u8 = 0x87;
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let broker = move |codes: &[u8]| {
            let (mut stream, _) = socket.accept().unwrap();
            let mut packet = [0; 512];
            let _connect = stream.read(&mut packet).unwrap();
            stream.write_all(&CONNACK).unwrap();
            for code in codes {
                let _subscribe = stream.read(&mut packet).unwrap();
                stream.write_all(&[0x90, 4, packet[2], packet[3], 0, *code]).unwrap();
            }
            // A granted filter gets a message of quality 0.
            if codes.iter().any(|code| *code < 0x80) {
                stream.write_all(b"\x30\x0d\x00\x09home/step\x001").unwrap();
            }
            // Until the client has left.
            let _rest = stream.read_to_end(&mut Vec::new());
        };
        let refused = "[[rule]]\ntopic = \"secret/#\"\nsay = \"They hide {value}.\"";
        let listening = Listening::start(port, refused);
        broker(&[NOT_AUTHORIZED]);
        let error = listening.thread.join().unwrap().unwrap_err().to_string();
        assert!(error.contains("\"secret/#\": NotAuthorized"), "{error}");
        // Where another filter is granted, that one is heard.
        let mut listening = Listening::start(port, &format!("{STEPS}\n{refused}"));
        let answering = std::thread::spawn(move || broker(&[0, NOT_AUTHORIZED]));
        assert!(listening.next().unwrap().contains("step 1"));
        assert_eq!(listening.end().1.said, 1);
        answering.join().unwrap();
    }

    /// A broker that sends anything: the generator of its kind, by seeds.
    #[test]
    fn a_broker_that_sends_anything_is_survived() {
        let message = |rng: &mut ChaCha8Rng| {
            let topic = b"home/step";
            let payload: Vec<u8> = (0..rng.random_range(0..40)).map(|_| rng.random()).collect();
            let mut packet = vec![0x30 | (rng.random_range(0..16_u8))];
            packet.push(u8::try_from(2 + topic.len() + 2 + 1 + payload.len()).unwrap());
            packet.extend([0, u8::try_from(topic.len()).unwrap()]);
            packet.extend(topic);
            packet.extend([0, rng.random(), 0]);
            packet.extend(payload);
            packet
        };
        let seeds: Vec<u64> = (0..64).collect();
        std::thread::scope(|scope| {
            for seeds in seeds.chunks(8) {
                scope.spawn(move || {
                    for seed in seeds {
                        let mut rng = ChaCha8Rng::seed_from_u64(*seed);
                        let mut bytes = Vec::new();
                        for _ in 0..rng.random_range(1..200) {
                            bytes.extend(message(&mut rng));
                        }
                        for _ in 0..rng.random_range(0..8) {
                            let at = rng.random_range(0..bytes.len());
                            bytes[at] = rng.random();
                        }
                        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
                        let mut listening = Listening::start(socket.local_addr().unwrap().port(), STEPS);
                        let (mut stream, _) = socket.accept().unwrap();
                        let mut greeting = [0; 256];
                        let _read = stream.read(&mut greeting).unwrap();
                        let _gone = stream.write_all(&CONNACK).and_then(|()| stream.write_all(&bytes));
                        drop(stream);
                        listening.stop.request();
                        while listening.next().is_some() {}
                        let ended = listening.thread.join();
                        assert!(ended.is_ok_and(|heard| heard.is_ok()), "seed {seed}");
                    }
                });
            }
        });
    }

    #[test]
    fn an_occupancy_sensor_says_that_a_room_is_empty() {
        let rules = "[[rule]]\ntopic = \"+/occupancy\"\nwhen = \"off\"\npresence = \"empty\"\nroom = \"{1}\"";
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        let said = hear(&mut listener, "living_room/occupancy", "off", false).unwrap();
        assert_eq!(said, r#"{"presence":"empty","room":"living room"}"#);
    }

    /// Row "4 200 messages of control characters" of the attacks: whatever is published, what waits for silence has few bytes.
    #[test]
    fn what_waits_for_silence_is_bounded_in_bytes() {
        let rules = "[[rule]]\ntopic = \"home/+/state\"\nsay = \"the {1} is {value}\"\nquiet_s = 600.0";
        let start = Instant::now();
        let after = start + Duration::from_secs(600);
        let bytes = |listener: &Listener| listener.waiting.iter().map(|waiting| waiting.line.capacity()).sum::<usize>();
        for (text, waits) in [
            ("\u{1}".repeat(PAYLOAD_BYTES_MAX - 20), false),
            ("x".repeat(PAYLOAD_BYTES_MAX - 20), false),
            ("\u{1}".repeat(1_300), false),
            ("on\u{1b}[2J".to_owned(), false),
            ("x".repeat(400), true),
            ("on".to_owned(), true),
        ] {
            let mut listener = Listener::new(Rules::parse(rules).unwrap());
            for n in 0..4_200 {
                let (topic, payload) = (format!("home/t{n}/state"), format!("{text}{n:08}"));
                assert!(listener.hear(topic.as_bytes(), payload.as_bytes(), false, start).is_empty());
                assert!(bytes(&listener) <= WAITING_BYTES_MAX);
            }
            let kept = listener.waiting.len();
            assert_eq!(kept > 0, waits, "{kept} lines of {} bytes", text.len());
            assert!(kept <= WAITING_MAX && listener.refused == 4_200 - kept as u64, "{kept}: {:?}", listener.heard);
            let due = listener.due(after);
            assert_eq!(due.len(), kept);
            assert!(due.iter().all(|line| line_item(line, &Who::Somebody).is_ok()));
        }
        // There is room again, and what cannot be said is no word that ends a silence.
        let mut listener = Listener::new(Rules::parse(&format!("{rules}\n{STEPS}")).unwrap());
        assert!(listener.hear(b"home/lamp/state", b"on", false, start).is_empty());
        assert!(listener.hear(b"home/step", b"\x07", false, start).is_empty());
        assert_eq!(listener.due(after), [r#"{"text":"the lamp is on"}"#]);
    }

    /// Row "900 rules for one field" of the attacks: a message is read once, however many rules look into it.
    #[test]
    fn a_message_is_read_once_for_all_rules() {
        let rule =
            |n: usize| format!("[[rule]]\ntopic = \"z\"\nfield = \"/a\"\nwhen = \"{n}\"\nsay = \"the lamp is on\"\n");
        let mut listener = Listener::new(Rules::parse(&(0..900).map(rule).collect::<String>()).unwrap());
        let items = "1,".repeat(PAYLOAD_BYTES_MAX / 2 - 20);
        let payload = format!(r#"{{"b":[{items}1],"a":"none"}}"#);
        let one = Instant::now();
        for _ in 0..10 {
            serde_json::from_str::<serde_json::Value>(&payload).unwrap();
        }
        let one = one.elapsed() / 10;
        let all = Instant::now();
        listener.hear(b"z", payload.as_bytes(), false, all);
        let all = all.elapsed();
        assert!(all < one * 100, "900 rules took {all:?}, reading it once {one:?}");
        assert_eq!((listener.heard.unfit, listener.heard.oversized), (1, 0));
    }

    /// A broker that lies: it does what a test says.
    struct Liar {
        socket: std::net::TcpListener,
        stream: Option<std::net::TcpStream>,
    }

    /// A message of quality 1.
    fn message(topic: &str, payload: &str, pkid: u16, dup: bool) -> Vec<u8> {
        let rest = 2 + topic.len() + 2 + 1 + payload.len();
        assert!(rest < 128);
        let mut packet = vec![0x32 | u8::from(dup) << 3, rest as u8, 0, topic.len() as u8];
        packet.extend(topic.as_bytes());
        packet.extend(pkid.to_be_bytes());
        packet.push(0);
        packet.extend(payload.as_bytes());
        packet
    }

    impl Liar {
        fn new() -> (Self, u16) {
            let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
            let port = socket.local_addr().unwrap().port();
            (Self { socket, stream: None }, port)
        }

        /// The next packet that comes.
        fn read(&mut self) -> Option<(u8, Vec<u8>)> {
            let stream = self.stream.as_mut().unwrap();
            let mut head = [0; 2];
            stream.read_exact(&mut head).ok()?;
            let (mut length, mut shift, mut byte) = (usize::from(head[1] & 127), 7, head[1]);
            while byte & 128 != 0 {
                let mut more = [0];
                stream.read_exact(&mut more).ok()?;
                byte = more[0];
                length |= usize::from(byte & 127) << shift;
                shift += 7;
            }
            let mut body = vec![0; length];
            stream.read_exact(&mut body).ok()?;
            Some((head[0] >> 4, body))
        }

        fn write(&mut self, bytes: &[u8]) {
            self.stream.as_mut().unwrap().write_all(bytes).unwrap();
        }

        /// Takes a connection, greets it with these properties, and grants its subscription.
        fn greet(&mut self, is_kept: bool, properties: &[u8]) {
            // Whoever was connected learns that it is over.
            self.stream = None;
            self.stream = Some(self.socket.accept().unwrap().0);
            let _connect = self.read().unwrap();
            let length = properties.len() as u8;
            let greeting = [&[0x20, 3 + length, u8::from(is_kept), 0, length], properties].concat();
            self.write(&greeting);
        }

        fn grant(&mut self) {
            let (_, subscribe) = self.read_kind(8);
            self.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1]);
        }

        /// The next packet of a kind; pings between are answered.
        fn read_kind(&mut self, kind: u8) -> (u8, Vec<u8>) {
            loop {
                let packet = self.read().unwrap();
                if packet.0 == 12 {
                    self.write(&[0xd0, 0]);
                }
                if packet.0 == kind {
                    return packet;
                }
            }
        }

        fn acknowledged(&mut self, messages: usize) {
            (0..messages).for_each(|_| _ = self.read_kind(4));
        }
    }

    const BELL: &str = "[[rule]]\ntopic = \"bell\"\nrepeats = true\nsay = \"They ring the bell for {value}.\"";

    /// A broker that takes the lowest free identifier, whose acknowledgements it has, and whose new messages are lost on their way.
    #[test]
    fn an_identifier_that_was_acknowledged_is_free_for_a_new_message() {
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, BELL);
        for round in 0..4 {
            broker.greet(round > 0, &[]);
            broker.grant();
            // From the second time on: their first sending was lost with the link.
            broker.write(&[message("bell", "ada", 1, round > 0), message("bell", "ben", 2, round > 0)].concat());
            for name in ["ada", "ben"] {
                assert_eq!(listening.next().unwrap(), format!("{{\"text\":\"They ring the bell for {name}.\"}}"));
            }
            broker.acknowledged(2);
        }
        assert_eq!(listening.end().1.said, 8);
    }

    /// What this side has not acknowledged comes again for sure, whatever identifiers the broker takes.
    #[test]
    fn what_was_not_acknowledged_is_recognised() {
        let (mut broker, port) = Liar::new();
        let to = Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "listener".into(), ..Broker::default() };
        let (reader, writer) = std::io::pipe().unwrap();
        let (stop, rules) = (Stop::new(), Rules::parse(BELL).unwrap());
        let (mut tell, news) = settled();
        let own_stop = stop.clone();
        let thread = std::thread::spawn(move || {
            listen_until_settled(to.options().unwrap(), rules, None, writer, news, &own_stop)
        });
        let mut lines = BufReader::new(reader).lines().map(Result::unwrap);
        broker.greet(false, &[]);
        broker.grant();
        broker.write(&message("bell", "ada", 1, false));
        assert!(lines.next().unwrap().contains("ada"));
        broker.greet(true, &[]);
        broker.grant();
        broker.write(&[message("bell", "ada", 1, true), message("bell", "ben", 2, true)].concat());
        assert!(lines.next().unwrap().contains("ben"));
        tell(2);
        broker.acknowledged(2);
        stop.request();
        assert_eq!(thread.join().unwrap().unwrap().said, 2);
    }

    /// A broker that counts, and has not got the last acknowledgements; until a ping shows that it has them.
    #[test]
    fn a_broker_that_counts_says_nothing_twice_until_it_has_answered_a_ping() {
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, BELL);
        let all = 100_u16;
        broker.greet(false, &[]);
        broker.grant();
        for n in 1..=all {
            broker.write(&message("bell", &n.to_string(), n, false));
            assert!(listening.next().unwrap().contains(&format!("for {n}.")));
        }
        broker.acknowledged(usize::from(all));
        // It wants a ping each second now. The last message is new: its first sending was lost.
        broker.greet(true, &[19, 0, 1]);
        broker.grant();
        let again: Vec<_> = (all - 20..=all).flat_map(|n| message("bell", &n.to_string(), n, true)).collect();
        broker.write(&again);
        broker.write(&message("bell", "last", all + 1, true));
        assert!(listening.next().unwrap().contains("for last."), "the others are recognised");
        broker.acknowledged(22);
        broker.read_kind(12);
        broker.write(&message("bell", "more", all + 2, false));
        assert!(listening.next().unwrap().contains("for more."));
        broker.greet(true, &[]);
        broker.grant();
        broker.write(&message("bell", "last", all + 1, true));
        assert!(listening.next().unwrap().contains("for last."), "it had the acknowledgement");
        // A session that is not kept brings nothing again.
        broker.greet(false, &[]);
        broker.grant();
        broker.write(&message("bell", "more", all + 2, true));
        assert!(listening.next().unwrap().contains("for more."));
        listening.end();
    }

    /// A narrator that has just started, in the middle of a session whose broker counts; the broker ends before it has written down any
    /// acknowledgement, and sends everything again.
    #[test]
    fn a_broker_that_counts_says_nothing_twice_to_a_young_narrator() {
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, BELL);
        let ids = 9_949..=10_001_u16;
        let all =
            |dup: bool| ids.clone().flat_map(move |n| message("bell", &n.to_string(), n, dup)).collect::<Vec<_>>();
        broker.greet(true, &[]);
        broker.grant();
        broker.write(&all(false));
        for n in ids.clone() {
            assert!(listening.next().unwrap().contains(&format!("for {n}.")));
        }
        broker.acknowledged(ids.len());
        broker.greet(true, &[]);
        broker.grant();
        broker.write(&all(true));
        broker.write(&message("bell", "last", 10_002, false));
        assert!(listening.next().unwrap().contains("for last."));
        broker.acknowledged(ids.len() + 1);
        assert_eq!(listening.end().1.said, ids.len() as u64 + 1);
    }

    /// Row "server keep alive 0" of the attacks: the broker wants no pings, and none is too late.
    #[test]
    fn a_broker_that_wants_no_pings_is_not_left() {
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, STEPS);
        broker.greet(false, &[19, 0, 0]);
        broker.grant();
        let start = Instant::now();
        let mut n = 0;
        while start.elapsed() < Duration::from_secs(4) {
            broker.write(&message("home/step", &n.to_string(), 1, false));
            assert!(listening.next().unwrap().contains(&format!("step {n}.")));
            n += 1;
            std::thread::sleep(Duration::from_millis(300));
        }
        broker.socket.set_nonblocking(true).unwrap();
        assert!(broker.socket.accept().is_err(), "one connection is enough");
        listening.end();
    }

    /// Row "receive maximum 0" of the attacks, and the same broker when it has come to its senses.
    #[test]
    fn a_broker_that_allows_nothing_is_tried_again() {
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, STEPS);
        let start = Instant::now();
        broker.greet(false, &[33, 0, 0]);
        broker.greet(false, &[33, 0, 0]);
        broker.greet(false, &[]);
        assert!(start.elapsed() > Duration::from_millis(2_500), "the second pause is longer: {:?}", start.elapsed());
        broker.grant();
        broker.write(&message("home/step", "1", 1, false));
        assert!(listening.next().unwrap().contains("step 1."));
        listening.end();
    }

    /// Row "150 answers to one subscription" of the attacks.
    #[test]
    fn more_answers_than_questions_say_nothing() {
        let rule = |n: usize| format!("[[rule]]\ntopic = \"t{n:03}\"\nsay = \"They do step {{value}}.\"\n");
        let (mut broker, port) = Liar::new();
        let mut listening = Listening::start(port, &(0..200).map(rule).collect::<String>());
        broker.greet(false, &[]);
        let (_, subscribe) = broker.read_kind(8);
        broker.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1].repeat(150));
        (1..200).for_each(|_| broker.grant());
        broker.write(&message("t199", "1", 1, false));
        assert!(listening.next().unwrap().contains("step 1."));
        listening.end();
    }
}
