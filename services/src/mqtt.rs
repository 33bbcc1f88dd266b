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
//! person = 1
//! ```
//!
//! The first rule that fits a message speaks; a message that no rule fits is counted. A value that a topic repeats says nothing new
//! and is left out. A retained message tells how things are, not what has just happened: at the first connection it is remembered
//! and not said, unless its rule has `retained = true`; after a reconnection it is said if it differs from what was heard before.
//!
//! The session is persistent and a message is acknowledged only when it was handed on, so that the broker keeps what arrives while this
//! process or the connection is away; order is the broker's.

use std::collections::HashMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rumqttc::{Client, Event, MqttOptions, Packet, Publish, QoS, TlsConfiguration, Transport};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use serde_json::json;

use crate::stop::Stop;

/// Topics whose last value is remembered; more are spoken of without regard to repetition.
const TOPICS_MAX: usize = 65_536;
/// Rules that a file may have.
const RULES_MAX: usize = 4_096;
/// How long the connection is listened to before the wish to stop is looked at.
const POLL: Duration = Duration::from_millis(200);
/// Pause before a lost connection is tried again.
const RECONNECT: Duration = Duration::from_secs(1);

/// Why MQTT cannot be narrated.
#[derive(Debug, thiserror::Error)]
pub enum MqttError {
    /// A file cannot be read.
    #[error("failed to read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        source: std::io::Error,
    },
    /// The rules are malformed.
    #[error("the rules {path} are malformed: {reason}")]
    Rules {
        /// The file.
        path: PathBuf,
        /// Where and why.
        reason: String,
    },
    /// The broker's address is none.
    #[error("{given:?} is no broker: give mqtt://HOST[:PORT], or mqtts://HOST[:PORT] with a CA file")]
    Address {
        /// What was given.
        given: String,
    },
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
    /// The client gave up.
    #[error("the MQTT client failed: {reason}")]
    Client {
        /// Why.
        reason: String,
    },
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
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rules {
    #[serde(rename = "rule")]
    rules: Vec<Rule>,
}

#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Rule {
    topic: String,
    field: Option<String>,
    when: Option<String>,
    say: String,
    #[serde(default)]
    person: u32,
    #[serde(default)]
    retained: bool,
}

/// What a rule says about a message.
#[derive(Debug, Clone, PartialEq)]
struct Said {
    /// None where the rules speak of other values only: the value is remembered, so that the next one they speak of is news.
    text: Option<String>,
    person: u32,
    value: String,
    retained: bool,
}

impl Rules {
    /// Reads and checks a rules file.
    ///
    /// # Errors
    ///
    /// [`MqttError::Read`], [`MqttError::Rules`] with the rule's number.
    pub fn load(path: &Path) -> Result<Self, MqttError> {
        let text = std::fs::read_to_string(path).map_err(|source| MqttError::Read { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|reason| MqttError::Rules { path: path.to_owned(), reason })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let rules: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        if rules.rules.is_empty() || rules.rules.len() > RULES_MAX {
            return Err(format!("{} rules; give 1 to {RULES_MAX}", rules.rules.len()));
        }
        for (number, rule) in (1..).zip(&rules.rules) {
            let levels: Vec<_> = rule.topic.split('/').collect();
            let wild = |level: &&str| level.contains(['+', '#']) && level.len() > 1;
            if rule.topic.is_empty()
                || levels.iter().any(wild)
                || levels.iter().rev().skip(1).any(|level| *level == "#")
            {
                return Err(format!(
                    "rule {number}: the topic {:?} is no MQTT filter (+ and # stand alone, # at the end)",
                    rule.topic
                ));
            }
            if rule.say.trim().is_empty() {
                return Err(format!("rule {number}: say is empty"));
            }
            if rule.field.as_ref().is_some_and(|field| !field.starts_with('/')) {
                return Err(format!(
                    "rule {number}: field is a JSON pointer and begins with a slash, as in \"/state\""
                ));
            }
        }
        Ok(rules)
    }

    /// Filters to subscribe to, each once.
    fn filters(&self) -> Vec<String> {
        let mut filters: Vec<_> = self.rules.iter().map(|rule| rule.topic.clone()).collect();
        filters.sort();
        filters.dedup();
        filters
    }

    /// The first rule that speaks of the message, else the first that can read it.
    fn say(&self, topic: &str, payload: &[u8]) -> Option<Said> {
        let readings = || self.rules.iter().filter_map(|rule| rule.say(topic, payload));
        readings().find(|said| said.text.is_some()).or_else(|| readings().next())
    }
}

impl Rule {
    fn say(&self, topic: &str, payload: &[u8]) -> Option<Said> {
        let places = matches(&self.topic, topic)?;
        let value = match &self.field {
            None => std::str::from_utf8(payload).ok()?.trim().to_owned(),
            Some(field) => match serde_json::from_slice::<serde_json::Value>(payload).ok()?.pointer(field)? {
                serde_json::Value::String(text) => text.trim().to_owned(),
                other => other.to_string(),
            },
        };
        let (person, retained) = (self.person, self.retained);
        if self.when.as_ref().is_some_and(|when| !when.eq_ignore_ascii_case(&value)) {
            return Some(Said { text: None, person, value, retained });
        }
        let mut text = self.say.replace("{value}", &value);
        for (number, place) in (1..).zip(places) {
            text = text.replace(&format!("{{{number}}}"), &place.replace('_', " "));
        }
        Some(Said { text: Some(text), person, value, retained })
    }
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
    /// Messages that a rule made narration of.
    pub said: u64,
    /// Messages that no rule fits.
    pub unfit: u64,
    /// Messages that said nothing new, or how things are.
    pub silent: u64,
}

/// Decides which messages are said.
#[derive(Debug)]
struct Listener {
    rules: Rules,
    last: HashMap<String, String>,
    /// Whether what is retained now was retained before this process first listened.
    first_connection: bool,
    heard: Heard,
}

impl Listener {
    fn new(rules: Rules) -> Self {
        Self { rules, last: HashMap::new(), first_connection: true, heard: Heard::default() }
    }

    /// The narration of a message, if it is to be said, as a line of JSON.
    fn hear(&mut self, message: &Publish) -> Option<String> {
        let Some(said) = self.rules.say(&message.topic, &message.payload) else {
            self.heard.unfit += 1;
            return None;
        };
        let known = self.last.contains_key(&message.topic);
        let repeated = self.last.get(&message.topic) == Some(&said.value);
        if known || self.last.len() < TOPICS_MAX {
            self.last.insert(message.topic.clone(), said.value.clone());
        }
        let Some(text) = said.text else {
            self.heard.unfit += 1;
            return None;
        };
        let stale = message.retain && !said.retained && (self.first_connection || !known);
        if repeated || stale {
            self.heard.silent += 1;
            return None;
        }
        self.heard.said += 1;
        Some(json!({"text": text, "person": said.person}).to_string())
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
        let (host, port) = match rest.rsplit_once(':') {
            Some((host, port)) => (host, port.parse().map_err(|_| wrong())?),
            None => (rest, if secure { 8883 } else { 1883 }),
        };
        if host.is_empty() || host.contains('/') {
            return Err(wrong());
        }
        let mut options = MqttOptions::new(&self.client, host, port);
        options.set_keep_alive(Duration::from_secs(30)).set_clean_session(false).set_manual_acks(true);
        // A message above the limit ends the connection, and the broker sends it again first: a wide filter may meet pictures.
        options.set_max_packet_size(PACKET_BYTES_MAX, PACKET_BYTES_MAX);
        if let Some(path) = &self.credentials {
            let text =
                std::fs::read_to_string(path).map_err(|source| MqttError::Read { path: path.clone(), source })?;
            let mut lines = text.lines();
            options.set_credentials(lines.next().unwrap_or_default(), lines.next().unwrap_or_default());
        }
        match (&self.authority, secure) {
            (Some(path), true) => {
                let ca = std::fs::read(path).map_err(|source| MqttError::Read { path: path.clone(), source })?;
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

/// The largest message that is received, in bytes.
const PACKET_BYTES_MAX: usize = 16 << 20;
/// Messages that are remembered, to know those that a broker sends again; brokers keep fewer than this unacknowledged.
const HEARD_MAX: usize = 256;

/// Listens to the broker and writes narration as lines of JSON to `out`, until it is asked to stop or `out` is closed. A lost connection
/// is tried again for ever.
///
/// # Errors
///
/// [`MqttError::Client`] when the client cannot go on.
pub fn listen(options: MqttOptions, rules: Rules, mut out: impl Write, stop: &Stop) -> Result<Heard, MqttError> {
    let filters = rules.filters();
    let mut listener = Listener::new(rules);
    let failed = |error: &dyn std::fmt::Display| MqttError::Client { reason: error.to_string() };
    // Requests are sent from this very loop: there is room for a subscription to each filter, and for acknowledgements.
    let broker = options.broker_address();
    let broker = format!("{}:{}", broker.0, broker.1);
    let (client, mut connection) = Client::new(options, filters.len() + 256);
    let mut connections = 0_u64;
    // What a broker sends again after a connection broke is what it did not see acknowledged: it may have been heard.
    let mut heard = std::collections::VecDeque::with_capacity(HEARD_MAX);
    while !stop.requested() {
        let Ok(event) = connection.recv_timeout(POLL) else { continue };
        match event {
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                connections += 1;
                listener.first_connection = connections == 1;
                tracing::info!(broker, connections, "connected");
                // Again at every connection: a broker that lost its sessions would say nothing any more.
                for filter in &filters {
                    client.try_subscribe(filter, QoS::AtLeastOnce).map_err(|error| failed(&error))?;
                }
            }
            Ok(Event::Incoming(Packet::Publish(message))) => {
                let known = |(at, of): &(u64, Publish)| {
                    *at < connections
                        && of.pkid == message.pkid
                        && of.topic == message.topic
                        && of.payload == message.payload
                };
                if message.dup && message.qos != QoS::AtMostOnce && heard.iter().any(known) {
                    client.try_ack(&message).map_err(|error| failed(&error))?;
                    continue;
                }
                if message.qos != QoS::AtMostOnce {
                    heard.truncate(HEARD_MAX - 1);
                    heard.push_front((connections, message.clone()));
                }
                if let Some(line) = listener.hear(&message)
                    && writeln!(out, "{line}").and_then(|()| out.flush()).is_err()
                {
                    // The reader has left; what is not acknowledged stays with the broker.
                    break;
                }
                client.try_ack(&message).map_err(|error| failed(&error))?;
            }
            Ok(_) => {}
            Err(error) => {
                tracing::warn!(broker, %error, "no connection, trying again");
                std::thread::sleep(RECONNECT);
            }
        }
    }
    // What is left is to be polite; a broker that is gone does not mind.
    let _disconnected = client.try_disconnect();
    Ok(listener.heard)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader};
    use std::process::{Child, Command, Stdio};

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

    fn publish(topic: &str, payload: &str, retain: bool) -> Publish {
        Publish { retain, ..Publish::new(topic, QoS::AtLeastOnce, payload) }
    }

    #[test]
    fn rules_make_sentences() {
        let rules = Rules::parse(RULES).unwrap();
        let said = rules.say("home/binary_sensor/fridge_door/state", b"ON").unwrap();
        assert_eq!((said.text.as_deref(), said.person), (Some("They open the fridge."), 0));
        assert_eq!(rules.say("home/binary_sensor/fridge_door/state", b"off").unwrap().text, None);
        let said = rules.say("home/switch/coffee_maker/json", br#"{"state": {"power": "on"}}"#).unwrap();
        assert_eq!((said.text.as_deref(), said.person), (Some("the coffee maker is on"), 1));
        assert!(rules.say("home/switch/coffee_maker/json", b"{").is_none());
        assert!(rules.say("elsewhere", b"\xff\xfe").is_none());
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
            ("[[rule]]\ntopic = \"a\"\nsay = \" \"", "say is empty"),
            ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nfield = \"state\"", "JSON pointer"),
            ("[[rule]]\ntopic = \"a\"\nsays = \"x\"", "unknown field"),
        ] {
            let error = Rules::parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn what_no_rule_speaks_of_makes_the_next_value_news() {
        let mut listener = Listener::new(Rules::parse(RULES).unwrap());
        let door = "home/binary_sensor/fridge_door/state";
        let said =
            ["on", "on", "off", "on", "off", "on"].map(|value| listener.hear(&publish(door, value, false)).is_some());
        assert_eq!(said, [true, false, false, true, false, true]);
        assert_eq!(listener.heard, Heard { said: 3, unfit: 2, silent: 1 });
    }

    #[test]
    fn retained_and_repeated_messages_say_nothing_new() {
        let mut listener = Listener::new(Rules::parse(RULES).unwrap());
        let door = "home/binary_sensor/fridge_door/state";
        let oven = "home/switch/oven/json";
        assert_eq!(listener.hear(&publish(door, "on", true)), None);
        assert!(
            listener.hear(&publish(oven, r#"{"state": {"power": "on"}}"#, true)).unwrap().contains("the oven is on")
        );
        assert_eq!(listener.hear(&publish(oven, r#"{"state": {"power": "on"}}"#, false)), None);
        listener.first_connection = false;
        // Retained again after a reconnection: changed while away, so it is an event; the same, so it is not.
        assert_eq!(listener.hear(&publish(oven, r#"{"state": {"power": "on"}}"#, true)), None);
        assert!(
            listener.hear(&publish(oven, r#"{"state": {"power": "off"}}"#, true)).unwrap().contains("the oven is off")
        );
        assert_eq!(listener.heard, Heard { said: 2, unfit: 0, silent: 3 });
    }

    #[test]
    fn addresses_and_their_faults() {
        let broker = |address: &str| Broker { address: address.into(), client: "test".into(), ..Broker::default() };
        assert_eq!(broker("mqtt://hub").options().unwrap().broker_address(), ("hub".into(), 1883));
        assert_eq!(broker("mqtt://hub:99").options().unwrap().broker_address(), ("hub".into(), 99));
        for wrong in ["hub", "http://hub", "mqtt://", "mqtt://hub:port", "mqtt://hub:99999"] {
            assert!(matches!(broker(wrong).options(), Err(MqttError::Address { .. })), "{wrong}");
        }
        let folder = tempfile::tempdir().unwrap();
        let with = |address: &str, authority| Broker { authority, ..broker(address) }.options().unwrap_err();
        let text = Some(pem(folder.path(), "text", "no certificate"));
        assert!(with("mqtts://hub", None).to_string().contains("without a CA file"));
        assert!(with("mqtt://hub", text.clone()).to_string().contains("with a CA file"));
        assert!(matches!(with("mqtts://hub", text), MqttError::Authority { .. }));
        assert!(matches!(with("mqtts://hub", Some(folder.path().join("nowhere"))), MqttError::Read { .. }));
    }

    const ANYBODY: &str = "allow_anonymous true";

    struct Mosquitto {
        child: Child,
        port: u16,
        folder: tempfile::TempDir,
    }

    impl Mosquitto {
        /// `access` says who may come in, in the words of its configuration.
        fn start(port: u16, folder: tempfile::TempDir, access: &str) -> Option<Self> {
            let config = folder.path().join("mosquitto.conf");
            let text = format!(
                "listener {port} 127.0.0.1\n{access}\npersistence true\npersistence_location {}/\nautosave_interval 1\nautosave_on_changes true\n",
                folder.path().display()
            );
            std::fs::write(&config, text).unwrap();
            // Debian's package puts it where an ordinary user's path does not lead; as root it would become another user.
            let program =
                ["/usr/sbin/mosquitto", "/usr/bin/mosquitto"].into_iter().find(|path| Path::new(path).exists())?;
            std::fs::write(&config, std::fs::read_to_string(&config).unwrap() + "user root\n").unwrap();
            let mut command = Command::new(program);
            command.arg("-c").arg(&config).stdout(Stdio::null()).stderr(Stdio::null());
            let child = command.spawn().unwrap();
            let deadline = std::time::Instant::now() + Duration::from_secs(20);
            while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
                assert!(std::time::Instant::now() < deadline, "mosquitto does not listen on port {port}");
                std::thread::sleep(Duration::from_millis(20));
            }
            Some(Self { child, port, folder })
        }

        fn restart(mut self) -> Self {
            self.stop();
            let Self { port, .. } = self;
            let folder = std::mem::replace(&mut self.folder, tempfile::tempdir().unwrap());
            drop(self);
            Self::start(port, folder, ANYBODY).unwrap()
        }

        fn stop(&mut self) {
            // SIGTERM, so that it writes its sessions down.
            let pid = rustix::process::Pid::from_child(&self.child);
            let _ended = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
            let _waited = self.child.wait();
        }

        /// Publishes messages in order and returns when the broker has all of them.
        fn publish(&self, messages: &[(&str, String, bool)]) {
            let (client, mut connection) = Client::new(MqttOptions::new("publisher", "127.0.0.1", self.port), 1000);
            // A broker that has just begun to listen may still turn its first clients away.
            let deadline = std::time::Instant::now() + Duration::from_secs(20);
            loop {
                match connection.recv().unwrap() {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => break,
                    Ok(_) => {}
                    Err(error) => {
                        assert!(std::time::Instant::now() < deadline, "no connection to port {}: {error}", self.port);
                        std::thread::sleep(Duration::from_millis(20));
                    }
                }
            }
            for (topic, payload, retain) in messages {
                client.try_publish(*topic, QoS::AtLeastOnce, *retain, payload.as_bytes()).unwrap();
            }
            let mut acknowledged = 0;
            while acknowledged < messages.len() {
                if let Event::Incoming(Packet::PubAck(_)) = connection.recv().unwrap().unwrap() {
                    acknowledged += 1;
                }
            }
        }
    }

    impl Drop for Mosquitto {
        fn drop(&mut self) {
            self.stop();
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
            eprintln!("SKIPPED: mosquitto is not installed (apt-get install mosquitto)");
            return;
        }
        let (authority_path, own, key) = (authority.display(), own.display(), key.display());
        let access = format!(
            "cafile {authority_path}\ncertfile {own}\nkeyfile {key}\nallow_anonymous false\npassword_file {}",
            passwords.display()
        );
        let Some(_broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), &access) else {
            eprintln!("SKIPPED: mosquitto is not installed (apt-get install mosquitto)");
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

    /// A real broker with retained messages, restarted in the middle: the narration is complete and in order.
    #[test]
    fn nothing_is_lost_over_a_restart_of_the_broker() {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let Some(broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            eprintln!("SKIPPED: mosquitto is not installed (apt-get install mosquitto)");
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
        assert_eq!((heard.said, heard.unfit), (101, 0));
    }
}
