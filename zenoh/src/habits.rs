//! Publishes how often each room was visited, by part of the day and for all persons together, if `habits.share` is set. Receivers check the message
//! too: a peer's bytes are untrusted.

use std::time::{Duration, Instant};

use roomcast_core::habits::PARTS;
use roomcast_ipc::raw::{MAX_ROOMS, NAME_BYTES};
use roomcast_ipc::{Domain, IpcError, QuestionPort, clock, question};
use serde::Deserialize;

use crate::config::Config;
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::link::Link;
use crate::outward::Last;
use crate::stop::Stop;
use crate::told;
use crate::wire::Fault;

/// The topic's name in keys.
pub const TOPIC: &str = "habits";
/// Largest message in bytes. Each room has an id, for which JSON may need six bytes a byte, and counts.
pub const BYTES_MAX: usize = 32 << 10;
/// Larger counts are invalid: this is one visit a second for thirty years.
const COUNT_MAX: f64 = 1e9;
/// Largest answer of the daemon, which has more in it than is published.
const ANSWER_BYTES_MAX: usize = 1 << 20;

/// How often the daemon is asked, how soon again without an answer, and its timeout.
const ASK: Duration = Duration::from_secs(60);
const ASK_AGAIN: Duration = Duration::from_secs(5);
const PATIENCE: Duration = Duration::from_secs(2);
const TICK: Duration = Duration::from_millis(200);
/// The question of `roomcast habits show --json`.
const QUESTION: &str = r#"{"ask":"show"}"#;

/// A room, and how many visits ended there in each part of the day.
pub type Visits = (String, [f64; PARTS]);

#[derive(Deserialize)]
struct Line {
    room: String,
    by_part: [f64; PARTS],
}

/// The public part of the daemon's answer. The rest, which names persons, is ignored.
#[derive(Deserialize)]
struct Answer {
    visits: Vec<Line>,
}

fn answered(answer: &str) -> Result<Vec<Visits>, Fault> {
    if answer.len() > ANSWER_BYTES_MAX {
        return Err(Fault(format!("an answer of {} bytes, at most {ANSWER_BYTES_MAX}", answer.len())));
    }
    let answer: Answer = serde_json::from_str(answer).map_err(|error| Fault(error.to_string()))?;
    let visits = answer.visits.into_iter().map(|Line { room, by_part }| (room, by_part)).collect();
    checked(visits)
}

fn checked(visits: Vec<Visits>) -> Result<Vec<Visits>, Fault> {
    if visits.len() > MAX_ROOMS {
        return Err(Fault(format!("{} rooms, at most {MAX_ROOMS}", visits.len())));
    }
    for (room, counts) in &visits {
        if room.is_empty() || room.len() > NAME_BYTES || room.chars().any(char::is_control) {
            return Err(Fault(format!("a room's id has 1 to {NAME_BYTES} bytes without control characters")));
        }
        if !counts.iter().all(|count| (0.0..=COUNT_MAX).contains(count)) {
            return Err(Fault(format!("a count of visits is 0 to {COUNT_MAX}")));
        }
    }
    Ok(visits)
}

/// Reads another robot's habits.
///
/// # Errors
///
/// [`Fault`] for too many bytes, for unexpected JSON, and for invalid rooms or counts.
pub fn read(bytes: &[u8]) -> Result<Vec<Visits>, Fault> {
    #[derive(Deserialize)]
    struct Message {
        rooms: std::collections::BTreeMap<String, [f64; PARTS]>,
    }
    if bytes.len() > BYTES_MAX {
        return Err(Fault(format!("{} bytes, at most {BYTES_MAX}", bytes.len())));
    }
    let message: Message = serde_json::from_slice(bytes).map_err(|error| Fault(error.to_string()))?;
    checked(message.rooms.into_iter().collect())
}

/// Asks the daemon and publishes changes, and the rest every `tell.repeat_s`. Runs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when the service cannot be opened.
pub fn run(config: &Config, domain: &Domain, link: &Link, last: &Last, stop: &Stop) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-habits")?;
    let port = node.question_port(question::HABITS)?;
    let key = Keys::new(&config.site.name, config.robot.key()).told(TOPIC);
    let repeat = Duration::from_secs_f64(config.tell.repeat_s);
    let (mut next, mut log, mut connections) = (Instant::now(), Limiter::default(), 0);
    let mut said = None::<(Vec<Visits>, Instant)>;
    while !stop.requested() {
        if Instant::now() >= next {
            let asked = ask(&port);
            next = Instant::now() + if asked.is_ok() { ASK } else { ASK_AGAIN };
            match asked {
                Ok(visits) if said.as_ref().is_none_or(|(before, _)| *before != visits) => {
                    link.put(&key, last.keep(&key, told::habits(&visits)));
                    said = Some((visits, Instant::now()));
                }
                Ok(_) => {}
                // The status reports a daemon that is away.
                Err(fault) => {
                    if let Some(not_told) = log.pass("habits", clock::monotonic_ns()) {
                        tracing::debug!(%fault, not_told, "the daemon says nothing of habits");
                    }
                }
            }
        }
        let before = std::mem::replace(&mut connections, link.connections());
        if let Some((_, at)) = said.as_mut().filter(|(_, at)| before != connections || at.elapsed() >= repeat) {
            *at = Instant::now();
            if let Some(bytes) = last.again(&key) {
                link.put(&key, bytes);
            }
        }
        std::thread::sleep(TICK);
    }
    Ok(())
}

fn ask(port: &QuestionPort) -> Result<Vec<Visits>, Fault> {
    let answer = port.ask(QUESTION, PATIENCE).map_err(|error| Fault(error.to_string()))?;
    answered(&answer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::told::Teller;

    #[test]
    fn of_the_daemons_answer_only_counts_of_rooms_are_told() {
        let answer = r#"{"done":true,"persons":[{"person":7,"name":"Ada","observations":3}],"export":"They sit.",
            "visits":[{"room":"kitchen","by_part":[0,0,1.5,0,0,0,0,2]}]}"#;
        let visits = answered(answer).unwrap();
        let bytes = told::habits(&visits).bytes(Teller { start: 1, number: 2, clock: 3, started_ns: 0 });
        assert_eq!(read(&bytes).unwrap(), visits);
        let text = String::from_utf8(bytes).unwrap();
        for private in ["Ada", "person", "They sit"] {
            assert!(!text.contains(private), "{private}: {text}");
        }
        let keys: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
        let keys: Vec<&str> = keys.keys().map(String::as_str).collect();
        assert_eq!(
            keys,
            ["age_ns", "clock", "number", "part_hours", "rooms", "sent_ns", "sent_unix_ns", "teller", "up_ns"]
        );
    }

    #[test]
    fn the_most_that_a_map_can_have_fits() {
        let long = |room: usize| (format!("{}{room:02}", "\"".repeat(NAME_BYTES - 2)), [COUNT_MAX - 0.25; PARTS]);
        let visits: Vec<Visits> = (0..MAX_ROOMS).map(long).collect();
        let bytes =
            told::habits(&visits).bytes(Teller { start: u64::MAX, number: u64::MAX, clock: u64::MAX, started_ns: 0 });
        assert_eq!(read(&bytes).unwrap().len(), MAX_ROOMS);
    }

    #[test]
    fn hostile_bytes_are_refused() {
        let of = |room: &str, counts: &str| read(format!(r#"{{"rooms":{{"{room}":{counts}}}}}"#).as_bytes());
        of("kitchen", "[0,1,2,3,4,5,6,7.5]").unwrap();
        for (room, counts) in [
            ("", "[0,1,2,3,4,5,6,7]"),
            ("a\\u001b[2J", "[0,1,2,3,4,5,6,7]"),
            (&"a".repeat(NAME_BYTES + 1), "[0,1,2,3,4,5,6,7]"),
            ("a", "[0,1,2]"),
            ("a", "[0,1,2,3,4,5,6,7,8]"),
            ("a", "[0,1,2,3,4,5,6,-1]"),
            ("a", "[0,1,2,3,4,5,6,1e300]"),
            ("a", "[0,1,2,3,4,5,6,null]"),
            ("a", "7"),
        ] {
            of(room, counts).unwrap_err();
        }
        let many: Vec<String> = (0..=MAX_ROOMS).map(|room| format!(r#""{room}":[0,0,0,0,0,0,0,0]"#)).collect();
        read(format!("{{\"rooms\":{{{}}}}}", many.join(",")).as_bytes()).unwrap_err();
        for bad in [b"".as_slice(), b"null", b"{}", b"\xff", &[b' '; BYTES_MAX + 1]] {
            read(bad).unwrap_err();
        }
        answered(r#"{"visits":[{"room":"a","by_part":[1]}]}"#).unwrap_err();
        answered("{}").unwrap_err();
    }
}
