//! Passes narration from hubs to the daemon. Each narrator has its own port, so that the daemon's rates and quotas hold for each.

use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use roomcast_ipc::raw::{NarrationV1, RoomScoresV1};
use roomcast_ipc::{Domain, IpcError, Publisher, Subscriber, clock, sequence};
use roomcast_ros2::types;
use zenoh::bytes::ZBytes;

use crate::config::{Config, ROS2_NARRATOR};
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::line::{Age, line};
use crate::link::Link;
use crate::relay::{Offered, Relay};
use crate::stop::Stop;
use crate::understood::Wanted;
use crate::wire::{self, Arrived, Confirmed, Fault, Hex, Narrated, Numbered, Said};

/// Most queued messages. More are dropped, and their hub sends them again.
pub const HEARD_MAX: usize = 256;
const TICK: Duration = Duration::from_millis(50);
/// A hub gets a report at least this often.
const SAY_NS: u64 = 1_000_000_000;
/// A daemon that is silent for this long is away.
const SILENCE_NS: u64 = 2_000_000_000;
/// Events per second from ROS 2 that reach the daemon.
const RATE_PER_S: f64 = 100.0;
/// After this many repetitions without an answer, the log says what may be wrong.
const REPEATS: u32 = 2;

const NOT_TAKEN: &str = "the daemon does not take this narrator's narration: name it in the robot's configuration as \
    [[daemon.narrator]] with relayed = true, and see the daemon's log: it says what is above its rate, or said by another process";
const DROPPED: &str = "the daemon has dropped narration of this narrator: its log and status say whether it was too long for a window or \
    above the rate, which loses nothing of a [[daemon.narrator]] with relayed = true";

/// A narrator's message, as it came.
#[derive(Debug)]
pub struct Heard {
    narrator: usize,
    now_ns: u64,
    bytes: Vec<u8>,
}

/// The end of the queue for subscribers.
#[derive(Debug, Clone)]
pub struct Inlet(SyncSender<Heard>);

impl Inlet {
    /// Queues a narrator's message, unless it is too long or the queue is full.
    pub fn take(&self, narrator: usize, payload: &ZBytes) {
        if payload.len() <= wire::BYTES_MAX {
            let heard = Heard { narrator, now_ns: clock::monotonic_ns(), bytes: payload.to_bytes().into_owned() };
            // If the queue is full, the hub sends it again.
            let _taken = self.0.try_send(heard);
        }
    }
}

/// Both ends of the queue.
#[must_use]
pub fn inlet() -> (Inlet, Receiver<Heard>) {
    let (inlet, heard) = sync_channel(HEARD_MAX);
    (Inlet(inlet), heard)
}

enum From {
    /// A hub, which gets its reports by this key.
    Hub { key: String },
    /// A ROS 2 topic, whose messages are numbered here.
    Ros2 { epoch: u64, next: u64 },
}

struct Narrator {
    name: String,
    from: From,
    relay: Relay,
    port: Publisher<NarrationV1>,
    said: Confirmed,
    said_ns: u64,
    /// The queue of questions about how the daemon understood events, and the last event in them. `None` if the hub does not want answers.
    understood: Option<(SyncSender<Wanted>, u64)>,
    log: Limiter,
}

/// Runs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Config,
    domain: &Domain,
    link: Option<&Link>,
    heard: &Receiver<Heard>,
    wanted: &SyncSender<Wanted>,
    stop: &Stop,
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-in")?;
    let scores: Subscriber<RoomScoresV1> = node.subscriber()?;
    let keys = Keys::new(&config.site.name, config.robot.key());
    let mut narrators = Vec::new();
    for narrator in &config.narrator {
        let from = From::Hub { key: keys.confirmed(&narrator.name) };
        let understood = narrator.understood.then(|| (wanted.clone(), 0));
        let new = Narrator::new(&narrator.name, narrator.rate_per_s, from, node.publisher()?);
        narrators.push(Narrator { understood, ..new });
    }
    if config.ros2.narration {
        let from = From::Ros2 { epoch: sequence::random_epoch(), next: 1 };
        narrators.push(Narrator::new(ROS2_NARRATOR, RATE_PER_S, from, node.publisher()?));
    }
    let mut message = Box::<RoomScoresV1>::default();
    let mut alive_ns = 0;
    while !stop.requested() {
        let first = match heard.recv_timeout(TICK) {
            Ok(first) => Some(first),
            Err(RecvTimeoutError::Timeout) => None,
            // No subscriber is left until the link declares them again.
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(TICK);
                None
            }
        };
        for heard in first.into_iter().chain(heard.try_iter()) {
            if let Some(narrator) = narrators.get_mut(heard.narrator) {
                narrator.hear(&heard);
                narrator.send(clock::monotonic_ns())?;
            }
        }
        while scores.receive_into(&mut message)? {
            alive_ns = alive_ns.max(message.published_ns);
            for Narrator { name, relay, log, .. } in &mut narrators {
                let dropped = relay.confirm(&message, clock::monotonic_ns());
                if dropped > 0
                    && let Some(not_told) = log.pass(DROPPED, clock::monotonic_ns())
                {
                    tracing::error!(narrator = name, dropped, not_told, "{DROPPED}");
                }
            }
        }
        let now_ns = clock::monotonic_ns();
        let alive = now_ns.saturating_sub(alive_ns) < SILENCE_NS;
        for narrator in &mut narrators {
            narrator.send(now_ns)?;
            for message in narrator.relay.again(now_ns, alive) {
                narrator.port.send(&message)?;
            }
            if narrator.relay.repeats() >= REPEATS
                && let Some(not_told) = narrator.log.pass(NOT_TAKEN, now_ns)
            {
                tracing::error!(narrator = narrator.name, not_told, "{NOT_TAKEN}");
            }
            narrator.port.tick()?;
            narrator.say(link, now_ns);
        }
    }
    Ok(())
}

impl Narrator {
    fn new(name: &str, rate_per_s: f64, from: From, port: Publisher<NarrationV1>) -> Self {
        let relay = Relay::new(name, rate_per_s);
        let (said, said_ns) = (Confirmed::default(), 0);
        Self { name: name.to_owned(), from, relay, port, said, said_ns, understood: None, log: Limiter::default() }
    }

    fn hear(&mut self, heard: &Heard) {
        match self.from {
            From::Hub { .. } => self.hear_hub(heard),
            From::Ros2 { epoch, next } => self.hear_ros2(heard, (epoch, next)),
        }
    }

    fn hear_ros2(&mut self, heard: &Heard, (epoch, sequence): (u64, u64)) {
        let observed = types::decode_string(&heard.bytes).map_err(|error| Fault(error.to_string()));
        let observed = observed.and_then(|text| line(&text, clock::unix_ns()));
        let message = observed.and_then(|(observation, Age { age_ns, ahead_ns })| {
            let (epoch, clock) = (Hex(epoch), Hex(0));
            let narrated = Narrated { epoch, sequence, first: 1, age_ns, ahead_ns, sent_ns: 0, clock, observation };
            let arrived = Arrived { now_ns: heard.now_ns, now_unix_ns: clock::unix_ns(), excess_ns: 0 };
            narrated.message(&self.name, arrived)
        });
        match message {
            Ok(message) if self.relay.offer(epoch, sequence, 1, Some(message)) == Offered::Taken => {
                self.from = From::Ros2 { epoch, next: sequence + 1 };
            }
            // ROS 2 has no confirmation that could slow its sender down.
            Ok(_) => self.refuse("it comes faster than the daemon takes it, and is dropped"),
            Err(fault) => self.refuse(&fault.0),
        }
    }

    fn hear_hub(&mut self, heard: &Heard) {
        let narrated = wire::read::<Narrated>(&heard.bytes);
        let numbered = match &narrated {
            Ok(Narrated { epoch, sequence, first, .. }) => {
                Ok(Numbered { epoch: *epoch, sequence: *sequence, first: *first })
            }
            Err(_) => wire::read(&heard.bytes),
        };
        let Numbered { epoch, sequence, first } = match numbered {
            Ok(numbered) => numbered,
            // It has no number, so later messages do not wait for it.
            Err(fault) => return self.complain("no number", &fault.0),
        };
        if epoch.0 == 0 || sequence == 0 || first == 0 {
            return self.complain("no number", "epoch, sequence and first are 1 or more");
        }
        let sent = narrated.as_ref().ok().map(|narrated| (narrated.clock.0, narrated.sent_ns));
        let excess_ns = |relay: &mut Relay| {
            let (clock, sent_ns) = sent?;
            relay.excess_ns(epoch.0, clock, sent_ns, heard.now_ns)
        };
        // An unknown delay counts as 0.
        let held_up_ns = excess_ns(&mut self.relay).unwrap_or(0);
        let arrived = Arrived { now_ns: heard.now_ns, now_unix_ns: clock::unix_ns(), excess_ns: held_up_ns };
        let (message, fault) = match narrated.and_then(|narrated| narrated.message(&self.name, arrived)) {
            Ok(message) => (Some(message), None),
            // Later messages wait for its number, so it is skipped.
            Err(fault) => (None, Some(fault)),
        };
        let before = self.relay.confirmed().epoch;
        if self.relay.offer(epoch.0, sequence, first, message) != Offered::Taken {
            return;
        }
        // A new start is known now: its clock is followed from its first message on.
        let _noted = excess_ns(&mut self.relay);
        if let Some(fault) = fault {
            self.refuse(&fault.0);
        }
        if before != epoch
            && before != Hex(0)
            && let Some(not_told) = self.log.pass("another start", clock::monotonic_ns())
        {
            tracing::warn!(
                narrator = self.name,
                not_told,
                "narration comes of another start than before: the hub has lost its spool, or another one has its name"
            );
        }
    }

    fn refuse(&mut self, fault: &str) {
        self.complain("refused", fault);
    }

    fn complain(&mut self, kind: &'static str, fault: &str) {
        if let Some(not_told) = self.log.pass(kind, clock::monotonic_ns()) {
            tracing::warn!(narrator = self.name, fault, not_told, "no narration");
        }
    }

    fn send(&mut self, now_ns: u64) -> Result<(), IpcError> {
        while let Some(message) = self.relay.send(now_ns) {
            self.port.send(&message)?;
        }
        Ok(())
    }

    /// Asks how the daemon understood the events that it has confirmed since.
    fn ask_understood(&mut self, confirmed: Confirmed) {
        let Some((wanted, last)) = &mut self.understood else { return };
        if confirmed.epoch != self.said.epoch {
            // An earlier start of this bridge handled the events before the first confirmation.
            *last = if self.said.epoch == Hex(0) { confirmed.confirmed } else { 0 };
        }
        let (narrator, epoch, from, to) = (self.name.clone(), confirmed.epoch.0, *last + 1, confirmed.confirmed);
        if to >= from && wanted.try_send(Wanted { narrator, epoch, from, to }).is_ok() {
            *last = to;
        }
    }

    /// Reports to the hub how far its narration is, if that has changed or the last report is old.
    fn say(&mut self, link: Option<&Link>, now_ns: u64) {
        let confirmed = self.relay.confirmed();
        let (Some(link), From::Hub { key }) = (link, &self.from) else { return };
        if (confirmed == self.said && now_ns.saturating_sub(self.said_ns) < SAY_NS) || !link.is_connected() {
            return;
        }
        if let Ok(bytes) = serde_json::to_vec(&Said { confirmed, explains: self.understood.is_some() })
            && link.put(key, bytes)
        {
            self.ask_understood(confirmed);
            (self.said, self.said_ns) = (confirmed, now_ns);
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    const S: u64 = 1_000_000_000;

    struct OneHub {
        narrator: Narrator,
        domain: Domain,
        _folder: tempfile::TempDir,
    }

    impl Drop for OneHub {
        fn drop(&mut self) {
            self.domain.clean_up().unwrap();
        }
    }

    impl OneHub {
        fn new(name: &str) -> Self {
            let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
            let domain = Domain::new(folder.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
            let port = domain.open("test").unwrap().publisher().unwrap();
            let from = From::Hub { key: String::new() };
            Self { narrator: Narrator::new("hub", 1e6, from, port), domain, _folder: folder }
        }

        /// Hears a narration that its hub sent at `sent_s`, with some keys changed; returns the daemon's message.
        fn hear(&mut self, sequence: u64, (sent_s, now_s): (u64, u64), changed: Value) -> Option<NarrationV1> {
            let mut message = json!({
                "epoch": Hex(9), "sequence": sequence, "first": 1, "age_ns": 0, "sent_ns": sent_s * S, "clock": Hex(1), "text": "They sit.",
            });
            message.as_object_mut().unwrap().extend(changed.as_object().unwrap().clone());
            let bytes = serde_json::to_vec(&message).unwrap();
            self.narrator.hear(&Heard { narrator: 0, now_ns: now_s * S, bytes });
            self.narrator.relay.send(now_s * S)
        }
    }

    /// A hub of a later version may send an unknown kind: that narration is lost, but not the ones behind it.
    #[test]
    fn a_narration_of_an_unknown_form_is_passed_over_with_its_number() {
        let mut heard = OneHub::new("form");
        assert!(heard.hear(1, (1, 1), json!({})).is_some());
        let forms = [
            json!({"kind": "smell"}),
            json!({"text": 7}),
            json!({"text": null}),
            json!({"person": {"name": "Ada"}}),
            json!({"age_ns": -1}),
            json!({"clock": "later"}),
        ];
        for (number, changed) in (2..).zip(&forms) {
            assert_eq!(heard.hear(number, (2, 2), changed.clone()), None, "{changed}");
        }
        let passed_over = forms.len() as u64;
        let confirmed = heard.narrator.relay.confirmed();
        assert_eq!((confirmed.next, confirmed.refused), (2 + passed_over, passed_over));
        assert_eq!(
            heard.hear(2 + passed_over, (3, 3), json!({})).map(|message| message.sequence),
            Some(2 + passed_over)
        );
        // A message without a number cannot be skipped.
        for changed in [json!({"sequence": "three"}), json!({"epoch": 7}), json!({"first": 0}), json!({"first": null})]
        {
            assert_eq!(heard.hear(3 + passed_over, (4, 4), changed.clone()), None, "{changed}");
        }
        assert_eq!(heard.narrator.relay.confirmed().next, 3 + passed_over);
    }

    /// If a hub narrates seldom, its delay is known from the second message on.
    #[test]
    fn the_first_message_of_a_start_says_how_fast_one_can_be() {
        let mut heard = OneHub::new("delay");
        let first = heard.hear(1, (1_000, 100), json!({})).unwrap();
        assert_eq!(first.observed_ns, 100 * S, "nobody knows");
        let second = heard.hear(2, (1_010, 170), json!({})).unwrap();
        assert_eq!(second.observed_ns, 110 * S, "it was held up for a minute");
    }
}
