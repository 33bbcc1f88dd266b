//! What an operator sees: every message of every robot of the site as a line of JSON, and which robots come and go.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use roomcast_ipc::clock;
use serde_json::{Map, Value, json};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::config::{Config, ConfigError};
use crate::delay::Delay;
use crate::habits;
use crate::link::{Declare, Link, LinkError};
use crate::stop::Stop;
use crate::wire::{Fault, Hex};

/// Messages that wait to be printed, and their bytes; more are dropped.
const WAITING_MAX: usize = 1024;
const WAITING_BYTES_MAX: usize = 16 << 20;
/// Most bytes of a message.
const BYTES_MAX: usize = 1 << 20;
/// Clocks that are followed; of more, all are followed from the start again.
const CLOCKS_MAX: usize = 4096;

/// Why nothing can be watched.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The way to the router.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Nobody reads what is printed.
    #[error("cannot write to standard output: {0}")]
    Print(io::Error),
}

enum Heard {
    Said { key: String, bytes: Vec<u8>, now_ns: u64 },
    Alive { key: String, alive: bool },
}

/// Prints until asked to stop.
///
/// # Errors
///
/// [`WatchError`]; a router that is away is none.
pub fn run(config: &Config, stop: &Stop) -> Result<(), WatchError> {
    config.check_watch()?;
    let (to, heard) = sync_channel(WAITING_MAX);
    let waiting = Arc::<AtomicUsize>::default();
    let _link = Link::start(&config.router, declare(config.site.name.clone(), to, Arc::clone(&waiting)))?;
    let mut delays = BTreeMap::<u64, Delay>::new();
    let mut out = io::stdout().lock();
    while !stop.requested() {
        let heard = match heard.recv_timeout(Duration::from_millis(200)) {
            Ok(heard) => heard,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(Duration::from_millis(200));
                continue;
            }
        };
        let line = match heard {
            Heard::Alive { key, alive } => json!({ "key": key, "alive": alive }),
            Heard::Said { key, bytes, now_ns } => {
                waiting.fetch_sub(bytes.len(), Ordering::Relaxed);
                match read(&key, &bytes) {
                    Ok(mut message) => {
                        aged(&mut message, &mut delays, now_ns);
                        message.insert("key".to_owned(), key.into());
                        message.insert("received_ns".to_owned(), now_ns.into());
                        Value::Object(message)
                    }
                    Err(fault) => json!({ "key": key, "fault": fault.to_string() }),
                }
            }
        };
        let line = line.to_string();
        writeln!(out, "{}", harmless(&line)).and_then(|()| out.flush()).map_err(WatchError::Print)?;
    }
    Ok(())
}

/// JSON that a terminal obeys in nothing: JSON itself escapes control characters below the space alone. Those above are in strings.
fn harmless(json: &str) -> Cow<'_, str> {
    if !json.contains(char::is_control) {
        return Cow::Borrowed(json);
    }
    let mut escaped = String::with_capacity(json.len() + 16);
    for character in json.chars() {
        match u32::from(character) {
            code if character.is_control() => escaped.push_str(&format!("\\u{code:04x}")),
            _ => escaped.push(character),
        }
    }
    Cow::Owned(escaped)
}

/// A robot's message: a JSON object, and of habits nothing but counts that can be.
fn read(key: &str, bytes: &[u8]) -> Result<Map<String, Value>, Fault> {
    if key.rsplit('/').next() == Some(habits::TOPIC) {
        habits::read(bytes)?;
    }
    match serde_json::from_slice(bytes) {
        Ok(Value::Object(message)) => Ok(message),
        _ => Err(Fault("no JSON object".to_owned())),
    }
}

/// Adds to a message's age what it was held up for; `held_up_ns` is null while that is not known.
fn aged(message: &mut Map<String, Value>, delays: &mut BTreeMap<u64, Delay>, now_ns: u64) {
    let id = message.get("clock").and_then(|id| serde_json::from_value::<Hex>(id.clone()).ok());
    let number = |key: &str| message.get(key).and_then(Value::as_u64);
    let (Some(Hex(id)), Some(sent_ns), Some(age_ns)) = (id, number("sent_ns"), number("age_ns")) else {
        return;
    };
    if delays.len() >= CLOCKS_MAX && !delays.contains_key(&id) {
        delays.clear();
    }
    let excess_ns = delays.entry(id).or_default().excess_ns(id, sent_ns, now_ns);
    message.insert("age_ns".to_owned(), age_ns.saturating_add(excess_ns.unwrap_or(0)).into());
    message.insert("held_up_ns".to_owned(), excess_ns.into());
}

fn declare(site: String, to: SyncSender<Heard>, waiting: Arc<AtomicUsize>) -> Declare {
    Box::new(move |session: &Session| {
        let said = {
            let (to, waiting) = (to.clone(), Arc::clone(&waiting));
            move |sample: Sample| {
                let length = sample.payload().len();
                if length > BYTES_MAX {
                    return;
                }
                let before = waiting.fetch_add(length, Ordering::Relaxed);
                let sent = before + length <= WAITING_BYTES_MAX && {
                    let (key, bytes) = (sample.key_expr().to_string(), sample.payload().to_bytes().into_owned());
                    to.try_send(Heard::Said { key, bytes, now_ns: clock::monotonic_ns() }).is_ok()
                };
                if !sent {
                    waiting.fetch_sub(length, Ordering::Relaxed);
                }
            }
        };
        let told = format!("roomcast/{site}/*/told/**");
        let subscriber = session.declare_subscriber(&told).callback(said.clone()).wait()?;
        let of_before = to.clone();
        // What was told before: asked for, since nobody keeps it but who told it.
        let earlier = move |reply: zenoh::query::Reply| {
            if let Ok(sample) = reply.into_result() {
                said(sample);
            }
        };
        session.get(&told).callback(earlier).wait()?;
        let seen = move |sample: Sample| {
            let alive = sample.kind() == SampleKind::Put;
            let _dropped = of_before.try_send(Heard::Alive { key: sample.key_expr().to_string(), alive });
        };
        let tokens = format!("roomcast/{site}/*/alive");
        let tokens = session.liveliness().declare_subscriber(tokens).history(true).callback(seen).wait()?;
        Ok(vec![Box::new(subscriber), Box::new(tokens)])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_printed_commands_no_terminal() {
        let message = json!({ "key": "roomcast/home/\u{9b}2J/told", "reason": "\u{1b}[2J\u{7f}\u{85}Küche" });
        let text = message.to_string();
        let printed = harmless(&text);
        assert!(!printed.contains(char::is_control), "{printed}");
        assert_eq!(serde_json::from_str::<Value>(&printed).unwrap(), message);
        assert!(matches!(harmless("{\"a\":\"Küche\"}"), Cow::Borrowed(_)));
    }
}
