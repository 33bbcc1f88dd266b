//! Narration from MQTT: devices' states become sentences by a rules file; `docs/mqtt.md` is its manual.
//!
//! Each value that rules read in a message (the payload, or a `field`) gives at most one sentence, one presence and one sensor's state: of
//! the matching rules the first one counts. Each matching rule with `quiet_s` also begins to wait. A message without a matching rule is
//! counted. A repeated value of a topic is skipped, unless the rule has `repeats = true`, as for buttons. A retained message is a state,
//! not an event. At the first connection it is remembered and gives no line, unless its rule has `retained = true`. After a reconnection it
//! gives a line if it differs from the last value.
//!
//! The session is persistent: the broker keeps messages while this process or the connection is away, and it decides their order. A message
//! is acknowledged when its lines are settled: confirmed by the daemon, or rejected for good ([`listen_until_settled`]). So the broker
//! keeps every message that this process could lose, however it ends. After a kill, the next process repeats confirmed messages without an
//! acknowledgement. They are at most [`MESSAGES_AHEAD_MAX`], since later messages wait for the acknowledgements, and
//! those whose acknowledgement the broker had not read. MQTT 5 gives the broker
//! the number of messages that it may send ahead, and their largest size. mosquitto 2.0.11 sends more, and those wait here. A silent
//! connection is probed, and renewed if the broker does not answer.

use std::fmt::Display;
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

use rumqttc::v5::MqttOptions;

use crate::stop::Stop;

mod acknowledgements;
mod broker;
mod client;
mod connection;
mod copies;
mod listener;
mod probe;
mod recent;
mod rehearsal;
mod rules;
mod subscriptions;

pub mod link;
pub mod look;
pub mod tally;

pub use acknowledgements::{SettledNews, settled};
pub use broker::Broker;
pub use listener::{Heard, Listener};
pub use rehearsal::shown;
pub use rules::{RuleAbout, Rules};

use broker::address_remedy;
use connection::Connection;
use tally::Tally;

/// Most messages that the broker may send before the first of them is acknowledged: MQTT's receive maximum.
pub const MESSAGES_AHEAD_MAX: u16 = 32;
/// Bytes of messages beyond that number. If there are more, the oldest is processed at once, and more messages are unacknowledged.
pub const HELD_BYTES_MAX: usize = 8 << 20;
/// The largest packet that the broker may send, in bytes: MQTT's maximum packet size. It drops larger messages by itself. mosquitto up to
/// 2.0.11 then counts each of them against the receive maximum, so the limit is far above the messages of homes.
pub const PACKET_BYTES_MAX: u32 = 16 << 20;
/// The largest payload, in bytes. A larger one is dropped, counted and acknowledged, and the log names its topic.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 10;
/// Most topics with a remembered value. Repetitions on further topics are not recognised.
pub const TOPICS_MAX: usize = 65_536;
/// Most rules of a file.
pub const RULES_MAX: usize = 4_096;
/// Most lines that wait for silence; further ones are rejected.
pub const WAITING_MAX: usize = 4_096;
/// Most bytes of all lines that wait for silence; further ones are rejected.
pub const WAITING_BYTES_MAX: usize = 1 << 20;
/// The interval of checks for a stop.
pub(crate) const POLL: Duration = Duration::from_millis(200);
pub(crate) const RECONNECT: Duration = Duration::from_secs(1);
/// The longest pause while the broker itself is broken; the pause doubles up to this.
pub(crate) const RECONNECT_BROKEN_MAX: Duration = Duration::from_secs(64);
/// The broker's time at the end to confirm the last messages, or to take the last acknowledgements.
pub(crate) const FAREWELL: Duration = Duration::from_secs(2);
pub(crate) const KEEP_ALIVE: Duration = Duration::from_secs(30);

/// MQTT cannot be narrated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MqttError {
    /// A file cannot be read.
    #[error("failed to read {0}: {1}")]
    Read(PathBuf, #[source] std::io::Error),
    /// A file of credentials has no user name, or no second line.
    #[error(
        "{0} is no file of credentials: give the user name in the first line, and the password in the second, which may be empty"
    )]
    Credentials(PathBuf),
    /// The rules are malformed.
    #[error("the rules {0} are malformed: {1}; docs/mqtt.md shows what they look like")]
    Rules(PathBuf, String),
    /// The broker's address is malformed.
    #[error("{0:?} is no broker: {remedy}", remedy = address_remedy(.0))]
    Address(String),
    /// The broker's address contains a login.
    #[error(
        "the broker's address has a user name or a password in it: write them into a file, a line each, and give that (--mqtt-credentials FILE, mqtt.credentials)"
    )]
    Login,
    /// Scheme and CA file do not fit together.
    #[error("{0:?} with{out} a CA file: give mqtts://HOST[:PORT] with --mqtt-ca FILE, or mqtt://HOST[:PORT] without", out = if *.1 { "" } else { "out" })]
    Scheme(String, bool),
    /// The CA file has no certificate.
    #[error("{0} holds no certificate: give a PEM file with those that the broker's is signed by")]
    Authority(PathBuf),
    /// The broker rejects all filters of the rules.
    #[error(
        "the broker {0} refuses every subscription ({1}): give this client the right to read the topics of the rules, or change the rules"
    )]
    Refused(String, String),
    /// The client gave up.
    #[error("the MQTT client failed: {0}")]
    Client(String),
}

/// Receives messages and writes narration as lines of JSON to `out`, until a stop is requested or `out` is closed. It reconnects for ever.
/// At the end the broker has the acknowledgements of all written messages.
///
/// # Errors
///
/// [`MqttError::Refused`] when the broker grants nothing, [`MqttError::Client`] when the client cannot go on.
pub fn listen(options: MqttOptions, rules: Rules, out: impl Write, stop: &Stop) -> Result<Heard, MqttError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(failed)?;
    runtime.block_on(Connection::new(options, rules, out).listen(stop))
}

/// As [`listen`], but a message is acknowledged only after its lines are settled, so that the broker repeats lost ones. Counts the matches
/// of each rule if there is a tally.
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

/// Receives messages as [`listen`] does, and writes a report about each: the rule, and its line with the text of `remark` about it. It
/// sends no narration. The client has another name and its session ends with the connection, so the narrator's session stays unchanged.
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

fn failed(error: impl Display) -> MqttError {
    MqttError::Client(error.to_string())
}

#[cfg(test)]
mod tests;
