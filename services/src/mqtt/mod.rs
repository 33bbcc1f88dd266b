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
//! sensor = "motion"                                # the state of a sensor: on, off, or null if it is unavailable
//! room = "{1}"
//!
//! [[rule]]
//! topic = "home/plug/power"
//! above = 15                                       # or `below`, `when`, `unless`: what means on
//! sensor = "appliance"
//! room = "kitchen"
//!
//! [[rule]]
//! topic = "home/binary_sensor/front_door/state"
//! when = "off"
//! presence = "away"
//! quiet_s = 600.0                                  # said when nothing else was said for so long
//! ```
//!
//! A message says one sentence, one presence and one sensor's state for each value that rules read in it (the payload, or a `field`): the first rule that
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
//! A connection over which nothing comes is probed, and renewed if the broker does not answer.

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

/// Messages that the broker may send before the first of them is acknowledged: MQTT's receive maximum.
pub const MESSAGES_AHEAD_MAX: u16 = 32;
/// Bytes of messages that a broker has sent further ahead than that: beyond them the oldest is said at once, and what is not acknowledged grows.
pub const HELD_BYTES_MAX: usize = 8 << 20;
/// The largest packet that the broker may send, in bytes: MQTT's maximum packet size. It drops larger messages by itself, and mosquitto up to
/// 2.0.11 then counts each of them against the receive maximum, so the limit is far above what homes publish.
pub const PACKET_BYTES_MAX: u32 = 16 << 20;
/// The largest payload that is read, in bytes; a larger one is dropped, counted and acknowledged, and the log names its topic.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 10;
/// Topics whose last value is remembered; more are spoken of without regard to repetition.
pub const TOPICS_MAX: usize = 65_536;
/// Rules that a file may have.
pub const RULES_MAX: usize = 4_096;
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

fn failed(error: impl Display) -> MqttError {
    MqttError::Client { reason: error.to_string() }
}

#[cfg(test)]
mod tests;
