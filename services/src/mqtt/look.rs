//! Tests a broker: whether it can be reached, whether it accepts the login, and which topics it has or receives in a time.
//!
//! For commands that look once and end. The broker keeps no session, and time, topics and bytes are bounded.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::time::Duration;

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, Packet, SubscribeReasonCode};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, MqttOptions};
use tokio::time::{Instant, timeout_at};

use roomcast_core::text::is_hidden;

use super::{Broker, MqttError};

/// Most topics in memory.
pub const TOPICS_MAX: usize = 10_000;
/// Most bytes of payloads in memory, in all.
pub const BYTES_MAX: usize = 32 << 20;
const CONNECT_MAX: Duration = Duration::from_secs(5);

/// The test of a broker failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LookError {
    /// The set-up cannot be used.
    #[error(transparent)]
    Setup(#[from] MqttError),
    /// There is no answer at the address.
    #[error("no broker answers at {0} ({1})")]
    Unreachable(String, String),
    /// The broker rejects the login.
    #[error("the broker {0} refuses the login ({1})")]
    Login(String, String),
    /// The other side speaks another protocol, or an older MQTT.
    #[error("what answers at {0} is no MQTT 5 broker ({1})")]
    Foreign(String, String),
    /// TLS fails.
    #[error("no secure connection to {0} ({1})")]
    Tls(String, String),
}

impl LookError {
    /// The remedy.
    #[must_use]
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Setup(_) => "correct mqtt.broker, mqtt.credentials and mqtt.ca in the configuration",
            Self::Unreachable { .. } => {
                "start the broker (systemctl start mosquitto), or correct its address (mqtt.broker)"
            }
            Self::Login { .. } => {
                "write the broker's user name and password, a line each, into the file that mqtt.credentials names"
            }
            Self::Foreign { .. } => "give the port of an MQTT 5 broker (mosquitto 1.6 or newer: 1883, with TLS 8883)",
            Self::Tls { .. } => {
                "give the certificates that the broker's is signed by in mqtt.ca, and the name that its certificate has as host"
            }
        }
    }
}

/// The last message of a topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Said {
    /// The payload; empty if there was no room for it.
    pub payload: Vec<u8>,
    /// Whether it was retained.
    pub retained: bool,
}

/// The result of a test.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Seen {
    /// Topics, and their last messages.
    pub topics: BTreeMap<String, Said>,
    /// Filters that the broker rejects, with its reason.
    pub refused: Vec<(String, String)>,
    bytes: usize,
}

impl Seen {
    fn take(&mut self, topic: String, payload: &[u8], retained: bool) {
        // A configuration cannot contain it, and it could control a terminal.
        if topic.contains(is_hidden) {
            return;
        }
        let before = self.topics.get(&topic).map_or(0, |said| said.payload.len());
        if !self.topics.contains_key(&topic) && self.topics.len() >= TOPICS_MAX {
            return;
        }
        let fits = self.bytes - before + payload.len() <= BYTES_MAX;
        let payload = if fits { payload.to_vec() } else { Vec::new() };
        self.bytes = self.bytes - before + payload.len();
        self.topics.insert(topic, Said { payload, retained });
    }
}

/// Collects a broker's topics for this time after the connection, or until `enough` returns true.
///
/// # Errors
///
/// [`LookError`] when the broker cannot be reached or refuses; a connection that breaks later gives a partial result.
pub fn look(
    broker: &Broker,
    filters: &[String],
    time: Duration,
    enough: impl Fn(&Seen) -> bool,
) -> Result<Seen, LookError> {
    let mut options = broker.options()?;
    options.set_clean_start(true).set_session_expiry_interval(Some(0));
    options.set_connection_timeout(CONNECT_MAX.as_secs());
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build();
    let runtime = runtime.map_err(|error| MqttError::Client(error.to_string()))?;
    runtime.block_on(turn(options, filters, time, enough))
}

async fn turn(
    options: MqttOptions,
    filters: &[String],
    time: Duration,
    enough: impl Fn(&Seen) -> bool,
) -> Result<Seen, LookError> {
    let (host, port) = options.broker_address();
    let name = format!("{host}:{port}");
    let (client, mut events) = AsyncClient::new(options, 4);
    let mut seen = Seen::default();
    let mut asked = 0;
    let mut until = Instant::now() + CONNECT_MAX;
    let mut connected = false;
    while !enough(&seen) {
        let Ok(event) = timeout_at(until, events.poll()).await else {
            if connected {
                break;
            }
            let fault = format!("no answer within {} s", CONNECT_MAX.as_secs());
            return Err(LookError::Unreachable(name, fault));
        };
        match event {
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                (connected, until) = (true, Instant::now() + time);
                subscribe(&client, filters.get(asked))?;
            }
            Ok(Event::Incoming(Packet::SubAck(answer))) => {
                let reason = answer.return_codes.first().copied().unwrap_or(SubscribeReasonCode::Unspecified);
                if !matches!(reason, SubscribeReasonCode::Success(_)) {
                    seen.refused.push((filters.get(asked).cloned().unwrap_or_default(), format!("{reason:?}")));
                }
                asked += 1;
                subscribe(&client, filters.get(asked))?;
            }
            Ok(Event::Incoming(Packet::Publish(message))) => {
                if let Ok(topic) = String::from_utf8(message.topic.to_vec()) {
                    seen.take(topic, &message.payload, message.retain);
                }
            }
            Ok(_) => {}
            Err(_) if connected => break,
            Err(error) => return Err(fault(name, error)),
        }
    }
    if connected && client.try_disconnect().is_ok() {
        let _left = timeout_at(Instant::now() + Duration::from_millis(200), events.poll()).await;
    }
    Ok(seen)
}

fn subscribe(client: &AsyncClient, filter: Option<&String>) -> Result<(), LookError> {
    let Some(filter) = filter else { return Ok(()) };
    let asked = client.try_subscribe(filter, QoS::AtMostOnce);
    asked.map_err(|error| MqttError::Client(error.to_string()).into())
}

fn fault(broker: String, error: ConnectionError) -> LookError {
    use ConnectReturnCode::{
        BadAuthenticationMethod, BadUserNamePassword, Banned, NotAuthorized, RefusedProtocolVersion,
        UnsupportedProtocolVersion,
    };
    match error {
        ConnectionError::ConnectionRefused(code) => match code {
            BadUserNamePassword | NotAuthorized | BadAuthenticationMethod | Banned => {
                LookError::Login(broker, format!("{code:?}"))
            }
            RefusedProtocolVersion | UnsupportedProtocolVersion => LookError::Foreign(broker, format!("{code:?}")),
            _ => LookError::Unreachable(broker, format!("it refuses the connection: {code:?}")),
        },
        // Another protocol also ends the connection without an answer.
        ConnectionError::Io(error) | ConnectionError::Tls(rumqttc::TlsError::Io(error))
            if is_of_network(error.kind()) =>
        {
            LookError::Unreachable(broker, error.to_string())
        }
        ConnectionError::Tls(error) => LookError::Tls(broker, error.to_string()),
        ConnectionError::Timeout(_) => {
            let fault = format!("it accepts the connection and says nothing within {} s", CONNECT_MAX.as_secs());
            LookError::Foreign(broker, fault)
        }
        ConnectionError::Io(error) if error.kind() == ErrorKind::InvalidData => {
            LookError::Tls(broker, error.to_string())
        }
        error => LookError::Foreign(broker, error.to_string()),
    }
}

/// Whether the fault is the network or the name of the host, and not the other side.
fn is_of_network(kind: ErrorKind) -> bool {
    !matches!(
        kind,
        ErrorKind::InvalidData | ErrorKind::UnexpectedEof | ErrorKind::ConnectionReset | ErrorKind::ConnectionAborted
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eventually::eventually;
    use crate::mosquitto::{Mosquitto, free_port};
    use std::io::{Read, Write};
    use std::net::TcpListener;

    const SHORT: Duration = Duration::from_millis(500);

    fn broker(port: u16) -> Broker {
        Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "look".to_owned(), ..Broker::default() }
    }

    /// Answers the first bytes of a connection with `answer`, and ends it.
    fn foreign(answer: &'static [u8]) -> u16 {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let _read = stream.read(&mut [0; 1024]);
            let _written = stream.write_all(answer);
        });
        port
    }

    #[test]
    fn what_is_no_broker_is_told_from_one_that_is_away() {
        let nobody = look(&broker(free_port()), &[], SHORT, |_| false).unwrap_err();
        assert!(matches!(nobody, LookError::Unreachable { .. }), "{nobody}");
        assert!(nobody.remedy().contains("start the broker"));
        for answer in [&b"HTTP/1.1 400 Bad Request\r\n\r\n"[..], b""] {
            let web = look(&broker(foreign(answer)), &[], SHORT, |_| false).unwrap_err();
            assert!(matches!(web, LookError::Foreign { .. }), "{web:?}");
        }
        let unknown = Broker { address: "mqtt://no-such-host.invalid".to_owned(), ..broker(1) };
        let unknown = look(&unknown, &[], SHORT, |_| false).unwrap_err();
        assert!(matches!(unknown, LookError::Unreachable { .. }), "{unknown}");
        let wrong = Broker { address: "http://x".to_owned(), ..broker(1) };
        assert!(matches!(look(&wrong, &[], SHORT, |_| false), Err(LookError::Setup(_))));
    }

    #[test]
    fn topics_that_are_kept_and_topics_that_come_are_seen() {
        let Some((_broker, port)) = Mosquitto::ready() else { return };
        let link =
            crate::mqtt::link::Link::start(&Broker { client: "speaker".to_owned(), ..broker(port) }, vec![], None)
                .unwrap();
        eventually("it is connected", || (link.connection() > 0).then_some(()));
        assert!(link.say("home/kept", "one", true, None));
        eventually("the broker has it", || (link.unconfirmed() == 0).then_some(()));
        let looking = std::thread::spawn(move || {
            let filters = ["home/#".to_owned(), "other/+".to_owned()];
            look(&broker(port), &filters, Duration::from_secs(30), |seen| seen.topics.len() == 2)
        });
        eventually("both topics are seen", || {
            link.say("other/new", "two", false, None);
            looking.is_finished().then_some(())
        });
        let seen = looking.join().unwrap().unwrap();
        let kept = Said { payload: b"one".to_vec(), retained: true };
        assert_eq!(seen.topics["home/kept"], kept);
        assert_eq!((seen.topics["other/new"].retained, seen.refused.len()), (false, 0));
        link.leave();
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut seen = Seen::default();
        (0..TOPICS_MAX + 5).for_each(|number| seen.take(number.to_string(), b"x", false));
        assert_eq!((seen.topics.len(), seen.bytes), (TOPICS_MAX, TOPICS_MAX));
        let large = vec![0; BYTES_MAX - TOPICS_MAX + 1];
        seen.take("1".to_owned(), &large, false);
        assert_eq!(seen.bytes, BYTES_MAX);
        seen.take("2".to_owned(), b"xx", false);
        assert_eq!((seen.topics["2"].payload.len(), seen.bytes), (0, BYTES_MAX - 1));
    }

    #[test]
    fn a_topic_with_hidden_characters_is_not_seen() {
        let mut seen = Seen::default();
        for topic in ["\u{1b}]0;x\u{7}rob/one", "a\nb", "a/\u{202e}b", "a/\u{9b}b", "küche/licht"] {
            seen.take(topic.to_owned(), b"x", true);
        }
        assert_eq!(seen.topics.keys().collect::<Vec<_>>(), ["küche/licht"]);
    }
}
