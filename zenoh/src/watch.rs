//! Prints every message of every robot of the site as a line of JSON, and which robots come and go.

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

/// Most queued messages, and their bytes. More are dropped.
const WAITING_MAX: usize = 1024;
const WAITING_BYTES_MAX: usize = 16 << 20;
/// Largest message in bytes.
const BYTES_MAX: usize = 1 << 20;
/// How often a stop is checked, and how long printing may take after it.
const STOP_TICK: Duration = Duration::from_millis(100);
const STOP_PATIENCE: Duration = Duration::from_secs(1);
/// Most clocks that are followed. If there are more, all are followed from the start again.
const ROBOTS_MAX: usize = 4096;

/// Why watching fails.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The connection to the router.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// Standard output fails.
    #[error("cannot write to standard output: {0}")]
    Print(io::Error),
}

enum Heard {
    Said { key: String, bytes: Vec<u8>, now_ns: u64 },
    Alive { key: String, alive: bool },
}

impl Heard {
    /// Its share of the queue's bytes.
    fn size(&self) -> usize {
        match self {
            Self::Said { key, bytes, .. } => key.len() + bytes.len(),
            Self::Alive { key, .. } => key.len(),
        }
    }
}

/// The end of the queue for subscribers.
#[derive(Clone)]
struct Inlet {
    to: SyncSender<Heard>,
    waiting: Arc<AtomicUsize>,
}

impl Inlet {
    /// Queues a message of `size` bytes if there is room. Otherwise `heard` is not called, so no bytes are copied.
    fn take(&self, size: usize, heard: impl FnOnce() -> Heard) {
        let before = self.waiting.fetch_add(size, Ordering::Relaxed);
        if before + size > WAITING_BYTES_MAX || self.to.try_send(heard()).is_err() {
            self.waiting.fetch_sub(size, Ordering::Relaxed);
        }
    }
}

/// Prints until asked to stop.
///
/// # Errors
///
/// [`WatchError`]. A router that is away is no error.
pub fn run(config: &Config, stop: &Stop) -> Result<(), WatchError> {
    config.check_watch()?;
    let (to, heard) = sync_channel(WAITING_MAX);
    let waiting = Arc::<AtomicUsize>::default();
    let inlet = Inlet { to, waiting: Arc::clone(&waiting) };
    let _link = Link::start(&config.router, declare(config.site.name.clone(), inlet))?;
    end_where_nobody_reads(stop.clone());
    let mut delays = BTreeMap::<String, Delay>::new();
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
        waiting.fetch_sub(heard.size(), Ordering::Relaxed);
        let line = match heard {
            Heard::Alive { key, alive } => json!({ "key": key, "alive": alive }),
            Heard::Said { key, bytes, now_ns } => match read(&key, &bytes) {
                Ok(mut message) => {
                    aged(&key, &mut message, &mut delays, now_ns);
                    message.insert("key".to_owned(), key.into());
                    message.insert("received_ns".to_owned(), now_ns.into());
                    Value::Object(message)
                }
                Err(fault) => json!({ "key": key, "fault": fault.to_string() }),
            },
        };
        if !print(&mut out, &line.to_string()).map_err(WatchError::Print)? {
            break;
        }
    }
    Ok(())
}

/// Prints a line; returns whether the reader still reads. A reader such as `head` may stop early.
fn print(out: &mut impl Write, line: &str) -> io::Result<bool> {
    match writeln!(out, "{}", harmless(line)).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        printed => printed.map(|()| true),
    }
}

/// Ends the process after a stop request even if printing is blocked.
fn end_where_nobody_reads(stop: Stop) {
    let wait = move || {
        while !stop.requested() {
            std::thread::sleep(STOP_TICK);
        }
        std::thread::sleep(STOP_PATIENCE);
        std::process::exit(0);
    };
    // Without this thread, a second signal ends the process.
    let _thread = std::thread::Builder::new().name("stop".to_owned()).spawn(wait);
}

/// Makes JSON harmless for terminals: JSON escapes control characters below the space, but not the higher ones.
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

/// Reads a robot's message as a JSON object. Habits must be valid.
fn read(key: &str, bytes: &[u8]) -> Result<Map<String, Value>, Fault> {
    if key.rsplit('/').next() == Some(habits::TOPIC) {
        habits::read(bytes)?;
    }
    match serde_json::from_slice(bytes) {
        Ok(Value::Object(message)) => Ok(message),
        _ => Err(Fault("no JSON object".to_owned())),
    }
}

/// Adds a message's delay to its age; `held_up_ns` is null while the delay is unknown. Clocks are followed per robot, since a robot writes only below
/// its own name: a false time harms only its sender.
fn aged(key: &str, message: &mut Map<String, Value>, delays: &mut BTreeMap<String, Delay>, now_ns: u64) {
    let id = message.get("clock").and_then(|id| serde_json::from_value::<Hex>(id.clone()).ok());
    let number = |key: &str| message.get(key).and_then(Value::as_u64);
    let (Some(Hex(id)), Some(sent_ns), Some(age_ns)) = (id, number("sent_ns"), number("age_ns")) else {
        return;
    };
    let robot = key.split('/').nth(2).unwrap_or_default();
    if delays.len() >= ROBOTS_MAX && !delays.contains_key(robot) {
        delays.clear();
    }
    let excess_ns = delays.entry(robot.to_owned()).or_default().excess_ns(id, sent_ns, now_ns);
    message.insert("age_ns".to_owned(), age_ns.saturating_add(excess_ns.unwrap_or(0)).into());
    message.insert("held_up_ns".to_owned(), excess_ns.into());
}

fn declare(site: String, inlet: Inlet) -> Declare {
    Box::new(move |session: &Session| {
        let said = {
            let inlet = inlet.clone();
            move |sample: Sample| {
                let (key, payload) = (sample.key_expr().as_str(), sample.payload());
                if payload.len() > BYTES_MAX {
                    return;
                }
                inlet.take(key.len() + payload.len(), || {
                    let bytes = payload.to_bytes().into_owned();
                    Heard::Said { key: key.to_owned(), bytes, now_ns: clock::monotonic_ns() }
                });
            }
        };
        let told = format!("roomcast/{site}/*/told/**");
        let subscriber = session.declare_subscriber(&told).callback(said.clone()).wait()?;
        let of_before = inlet.clone();
        // Earlier messages are queried, since only their senders keep them.
        let earlier = move |reply: zenoh::query::Reply| {
            if let Ok(sample) = reply.into_result() {
                said(sample);
            }
        };
        session.get(&told).callback(earlier).wait()?;
        let seen = move |sample: Sample| {
            let alive = sample.kind() == SampleKind::Put;
            let key = sample.key_expr().as_str();
            of_before.take(key.len(), || Heard::Alive { key: key.to_owned(), alive });
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
    fn what_waits_is_bounded_with_its_keys() {
        let (to, heard) = sync_channel(WAITING_MAX);
        let inlet = Inlet { to, waiting: Arc::default() };
        let take = |size: usize| {
            inlet.take(size, || Heard::Said { key: "k".repeat(size / 2), bytes: vec![0; size - size / 2], now_ns: 0 });
        };
        (0..40).for_each(|_| take(1 << 20));
        assert_eq!(inlet.waiting.load(Ordering::Relaxed), WAITING_BYTES_MAX);
        let waits: Vec<usize> = heard.try_iter().map(|heard| heard.size()).collect();
        assert_eq!(waits, [1 << 20; WAITING_BYTES_MAX >> 20]);
        // Their number is limited too.
        inlet.waiting.store(0, Ordering::Relaxed);
        (0..2 * WAITING_MAX).for_each(|_| take(2));
        assert_eq!((heard.try_iter().count(), inlet.waiting.load(Ordering::Relaxed)), (WAITING_MAX, 2 * WAITING_MAX));
    }

    /// Robots may share a clock, and can learn each other's clock ids. Regression: one robot's false times made the others look old.
    #[test]
    fn a_robot_that_lies_about_its_clock_harms_itself_alone() {
        const S: u64 = 1_000_000_000;
        let mut delays = BTreeMap::new();
        let mut held_up = |robot: &str, clock: u64, sent_ns: u64, now_s: u64| {
            let message = json!({ "clock": Hex(clock), "sent_ns": sent_ns, "age_ns": 7 });
            let mut message = message.as_object().unwrap().clone();
            aged(&format!("roomcast/home/{robot}/told/status"), &mut message, &mut delays, now_s * S);
            (message["held_up_ns"].as_u64(), message["age_ns"].as_u64().unwrap())
        };
        assert_eq!(held_up("robot-1", 1, 100 * S, 10), (None, 7));
        held_up("robot-9", 1, 1_000_000 * S, 11);
        for second in 12..20 {
            assert_eq!(held_up("robot-1", 1, (90 + second) * S, second), (Some(0), 7));
            // An endless series of clocks belongs to the robot that names them.
            (0..1000).for_each(|clock| _ = held_up("robot-9", clock, u64::MAX, second));
        }
        assert_eq!(held_up("robot-1", 1, 109 * S, 21), (Some(2 * S), 2 * S + 7));
    }

    #[test]
    fn a_reader_that_has_enough_is_no_failure() {
        struct Reader(io::ErrorKind);
        impl Write for Reader {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(self.0.into())
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        assert!(!print(&mut Reader(io::ErrorKind::BrokenPipe), "{}").unwrap());
        print(&mut Reader(io::ErrorKind::StorageFull), "{}").unwrap_err();
        assert!(print(&mut Vec::new(), "{}").unwrap());
    }

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
