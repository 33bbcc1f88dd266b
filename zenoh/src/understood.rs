//! How the daemon understood a hub's events: the bridge asks the daemon, and the hub prints the answers.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use roomcast_ipc::{Domain, IpcError, question, sequence};
use serde::Deserialize;
use serde_json::{Value, json};

use crate::keys::Keys;
use crate::link::Link;
use crate::stop::Stop;
use crate::wire::{self, Hex};

/// Most queued requests. Further ones are made again at the next confirmation.
const WAITING_MAX: usize = 16;
/// Bytes of the lines in one message; the rest of [`wire::BYTES_MAX`] is for its other keys.
const LINES_BYTES_MAX: usize = wire::BYTES_MAX - 512;
const TICK: Duration = Duration::from_millis(200);
const PATIENCE: Duration = Duration::from_secs(2);

/// Events of a narrator that the daemon has confirmed.
#[derive(Debug, Clone)]
pub struct Wanted {
    /// The narrator's name.
    pub narrator: String,
    /// The epoch of its start.
    pub epoch: u64,
    /// The first number.
    pub from: u64,
    /// The last number.
    pub to: u64,
}

/// Both ends of the queue of requests.
#[must_use]
pub fn queue() -> (SyncSender<Wanted>, Receiver<Wanted>) {
    sync_channel(WAITING_MAX)
}

/// A message to a hub.
#[derive(Debug, Deserialize)]
pub struct Understood {
    /// The epoch of its start.
    pub epoch: Hex,
    /// One object for each event, with its number as `sequence`.
    pub understood: Vec<serde_json::Map<String, Value>>,
}

/// The events of the daemon's answer from one number to another, as messages of at most [`wire::BYTES_MAX`] bytes.
fn messages(answer: &str, wanted: &Wanted) -> Vec<Vec<u8>> {
    let mut answer: Value = serde_json::from_str(answer).unwrap_or_default();
    let Value::Array(lines) = answer["understood"].take() else { return Vec::new() };
    let is_wanted =
        |line: &Value| line["sequence"].as_u64().is_some_and(|number| (wanted.from..=wanted.to).contains(&number));
    let (mut messages, mut part, mut bytes) = (Vec::new(), Vec::new(), 0);
    let mut close = |part: &mut Vec<Value>| {
        let part = std::mem::take(part);
        if !part.is_empty() {
            messages.push(json!({"epoch": Hex(wanted.epoch), "understood": part}).to_string().into_bytes());
        }
    };
    for line in lines.into_iter().filter(is_wanted) {
        let own = line.to_string().len() + 1;
        if bytes + own > LINES_BYTES_MAX {
            close(&mut part);
            bytes = 0;
        }
        if own <= LINES_BYTES_MAX {
            bytes += own;
            part.push(line);
        }
    }
    close(&mut part);
    messages
}

/// Asks for confirmed events and sends the answers to their hubs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened.
pub fn run(keys: &Keys, domain: &Domain, link: &Link, wanted: &Receiver<Wanted>, stop: &Stop) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-understood")?;
    let port = node.question_port(question::PERSON)?;
    while !stop.requested() {
        let wanted = match wanted.recv_timeout(TICK) {
            Ok(wanted) => wanted,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        };
        let Wanted { narrator, epoch, from, .. } = &wanted;
        let source = sequence::source_of_name(narrator);
        let asked = json!({"ask": "understood", "source": source, "epoch": epoch, "from": from}).to_string();
        match port.ask(&asked, PATIENCE) {
            Ok(answer) => {
                for message in messages(&answer, &wanted) {
                    let _sent = link.put(&keys.confirmed(narrator), message);
                }
            }
            Err(error) => tracing::debug!(narrator, %error, "the daemon does not say how it understood events"),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_are_cut_into_messages_that_a_hub_reads() {
        let line = |number: u64| json!({"sequence": number, "event": "did", "why": "x".repeat(400)});
        let answer = json!({"done": true, "understood": (1..=60).map(line).collect::<Vec<_>>()}).to_string();
        let wanted = Wanted { narrator: "hall-camera".to_owned(), epoch: 7, from: 3, to: 50 };
        let messages = messages(&answer, &wanted);
        assert!(messages.len() > 1);
        let read = messages.iter().flat_map(|message| {
            let Understood { epoch, understood } = wire::read(message).unwrap();
            assert_eq!(epoch, Hex(7));
            understood
        });
        let numbers: Vec<_> = read.map(|line| line["sequence"].as_u64().unwrap()).collect();
        assert_eq!(numbers, (3..=50).collect::<Vec<_>>());
        assert!(super::messages("no answer", &wanted).is_empty());
    }
}
