//! What an operator sees: every message of every robot of the site as a line of JSON, and which robots come and go.

use std::collections::BTreeMap;
use std::io::{self, Write};
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

/// Messages that wait to be printed; more are dropped.
const WAITING_MAX: usize = 1024;
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
    let _link = Link::start(&config.router, declare(config.site.name.clone(), to))?;
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
            Heard::Said { key, bytes, now_ns } => match read(&key, &bytes) {
                Ok(mut message) => {
                    aged(&mut message, &mut delays, now_ns);
                    message.insert("key".to_owned(), key.into());
                    message.insert("received_ns".to_owned(), now_ns.into());
                    Value::Object(message)
                }
                Err(fault) => json!({ "key": key, "fault": fault.to_string() }),
            },
        };
        writeln!(out, "{line}").and_then(|()| out.flush()).map_err(WatchError::Print)?;
    }
    Ok(())
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

fn declare(site: String, to: SyncSender<Heard>) -> Declare {
    Box::new(move |session: &Session| {
        let said = {
            let to = to.clone();
            move |sample: Sample| {
                if sample.payload().len() <= BYTES_MAX {
                    let (key, bytes) = (sample.key_expr().to_string(), sample.payload().to_bytes().into_owned());
                    let _dropped = to.try_send(Heard::Said { key, bytes, now_ns: clock::monotonic_ns() });
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
