//! A link to a broker for programs that send and receive. It runs in its own thread, with bounded memory, and reconnects for ever.
//!
//! Without a connection a message is rejected, not queued: the sender knows the current state, and an order must not be carried out an hour
//! later. The undelivered messages of a broken connection are dropped for the same reason. The number of the connection then changes, so
//! that the sender repeats current messages.

use std::collections::{BTreeSet, VecDeque};
use std::fmt::Display;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use roomcast_core::ids::BootNs;
use roomcast_core::text::visible;
use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnAck, Filter, LastWill, Packet, PubAckReason, Publish, PublishProperties};
use rumqttc::v5::{AsyncClient, Event, EventLoop, MqttOptions};
use tokio::time::timeout;

use super::client::{broken, correct_keep_alive, fault_of, renew};
use super::probe::{self, Probe};
use super::{Broker, FAREWELL, MqttError, PAYLOAD_BYTES_MAX, POLL, RECONNECT, RECONNECT_BROKEN_MAX};
use crate::clock;
use crate::logging::Limiter;
use crate::stop::Stop;

/// Most messages in the send queue.
pub const SAYING_MAX: usize = 128;
/// Most bytes of unread messages; the oldest are dropped.
pub const HEARING_BYTES_MAX: usize = 4 << 20;
const UNCONFIRMED_MAX: u16 = 32;
/// Bytes of a packet in addition to topic and payload: its head, the lengths, an identifier and the expiry.
const PACKET_BYTES: usize = 15;
/// Most topics in warnings about large messages.
const TOO_LARGE_MAX: usize = 64;
const QUIET_NS: u64 = 30_000_000_000;

/// A message from the broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Heard {
    /// Its topic.
    pub topic: String,
    /// The payload.
    pub payload: Vec<u8>,
    /// Whether the broker stored it: then it is a state, not an event.
    pub retained: bool,
}

/// The message that the broker publishes when this link is gone.
#[derive(Debug, Clone)]
pub struct Will {
    /// The topic, retained.
    pub topic: String,
    /// The payload.
    pub payload: String,
}

/// State of both threads.
#[derive(Debug, Default)]
struct Shared {
    /// The number of the current connection, 0 for none.
    connection: u64,
    connections: u64,
    heard: VecDeque<Heard>,
    heard_bytes: usize,
    /// Messages sent over this connection, and messages that the broker has confirmed.
    said: u64,
    confirmed: u64,
    refused: u64,
    disconnected: bool,
    turned_ns: BootNs,
    packet_max: Option<u32>,
    /// Topics with larger messages.
    too_large: BTreeSet<String>,
    /// Received messages with a payload that is too large.
    oversized: u64,
}

impl Shared {
    /// Whether the broker would end the connection at a message. Logged once per topic.
    fn is_too_large(&mut self, topic: &str, payload: &str) -> bool {
        let Some(packet_max) = self.packet_max else { return false };
        let bytes = PACKET_BYTES + topic.len() + payload.len();
        let is_too_large = u32::try_from(bytes).map_or(true, |bytes| bytes > packet_max);
        if is_too_large && self.too_large.len() < TOO_LARGE_MAX && self.too_large.insert(topic.to_owned()) {
            tracing::error!(
                topic,
                bytes,
                packet_max,
                "a message is larger than this broker takes, and is left out: raise the broker's largest packet (mosquitto: max_packet_size)"
            );
        }
        is_too_large
    }
}

/// The link. A drop ends it without a farewell, so the broker publishes the will.
#[derive(Debug)]
pub struct Link {
    client: AsyncClient,
    shared: Arc<Mutex<Shared>>,
    stop: Stop,
    thread: Option<JoinHandle<()>>,
}

fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Link {
    /// Connects, and subscribes to `filters` at every connection. A fault of the set-up is an error; the link waits for an absent broker.
    ///
    /// # Errors
    ///
    /// [`MqttError`] for an address or a file that cannot be used, or if the system cannot start a thread.
    pub fn start(broker: &Broker, mut filters: Vec<String>, will: Option<Will>) -> Result<Self, MqttError> {
        // It comes first, so that the broker answers it before any message can be too large.
        if !filters.is_empty() {
            filters.insert(0, probe::TOPIC.to_owned());
        }
        let mut options = broker.options()?;
        // The broker need not keep messages while this process is away.
        options.set_clean_start(true).set_session_expiry_interval(Some(0));
        options.set_outgoing_inflight_upper_limit(UNCONFIRMED_MAX);
        if let Some(Will { topic, payload }) = will {
            options.set_last_will(LastWill::new(topic, payload, QoS::AtLeastOnce, true, None));
        }
        let failed = |error: std::io::Error| MqttError::Client(error.to_string());
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build();
        let runtime = runtime.map_err(failed)?;
        let (client, events) = AsyncClient::new(options.clone(), SAYING_MAX);
        let shared = Arc::new(Mutex::new(Shared { turned_ns: clock::monotonic_ns(), ..Shared::default() }));
        let stop = Stop::new();
        let turning = Turning {
            broker: shown(&options),
            client: client.clone(),
            events,
            shared: Arc::clone(&shared),
            filters,
            probe: Probe::new(Instant::now()),
            log: Limiter::new(QUIET_NS),
            large: Limiter::new(QUIET_NS),
            greetings: Limiter::new(QUIET_NS),
            pause: RECONNECT,
            stop: stop.clone(),
        };
        let thread = std::thread::Builder::new().name("mqtt".to_owned());
        let thread = thread.spawn(move || runtime.block_on(turning.turn())).map_err(failed)?;
        Ok(Self { client, shared, stop, thread: Some(thread) })
    }

    /// The number of the current connection, 0 for none. After a new number, earlier messages may be lost.
    #[must_use]
    pub fn connection(&self) -> u64 {
        lock(&self.shared).connection
    }

    /// The time of the thread's last turn, in monotonic nanoseconds.
    #[must_use]
    pub fn turned_ns(&self) -> BootNs {
        lock(&self.shared).turned_ns
    }

    /// Sends a message; returns whether it was accepted. Without a connection, or with a full queue, it is not. A message that exceeds the
    /// broker's limit is left out, since it would end the connection and lose the others. `keep` is MQTT's retain; `for_s` is the time that
    /// the broker may store it for absent clients.
    pub fn say(&self, topic: &str, payload: &str, keep: bool, for_s: Option<u32>) -> bool {
        let mut shared = lock(&self.shared);
        if shared.connection == 0 {
            return false;
        }
        if shared.is_too_large(topic, payload) {
            return true;
        }
        let properties = PublishProperties { message_expiry_interval: for_s, ..PublishProperties::default() };
        let payload = payload.as_bytes().to_vec();
        let said = self.client.try_publish_with_properties(topic, QoS::AtLeastOnce, keep, payload, properties).is_ok();
        shared.said += u64::from(said);
        said
    }

    /// Messages of this connection without the broker's confirmation.
    #[must_use]
    pub fn unconfirmed(&self) -> u64 {
        let shared = lock(&self.shared);
        shared.said - shared.confirmed
    }

    /// Messages received since the last call.
    #[must_use]
    pub fn heard(&self) -> Vec<Heard> {
        let mut shared = lock(&self.shared);
        shared.heard_bytes = 0;
        shared.heard.drain(..).collect()
    }

    /// Waits for the broker's confirmations, at most two seconds, and leaves: no will is published.
    pub fn leave(mut self) {
        let start = Instant::now();
        while start.elapsed() < FAREWELL && self.connection() > 0 && self.unconfirmed() > 0 {
            std::thread::sleep(Duration::from_millis(10));
        }
        if self.connection() > 0 && self.client.try_disconnect().is_ok() {
            while start.elapsed() < FAREWELL && !lock(&self.shared).disconnected {
                std::thread::sleep(Duration::from_millis(10));
            }
        }
        self.end();
    }

    fn end(&mut self) {
        self.stop.request();
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.end();
    }
}

fn shown(options: &MqttOptions) -> String {
    let (host, port) = options.broker_address();
    format!("{host}:{port}")
}

struct Turning {
    broker: String,
    client: AsyncClient,
    events: EventLoop,
    shared: Arc<Mutex<Shared>>,
    /// The first is the probe's, if there are any.
    filters: Vec<String>,
    probe: Probe,
    log: Limiter,
    large: Limiter,
    greetings: Limiter,
    pause: Duration,
    stop: Stop,
}

impl Turning {
    async fn turn(mut self) {
        while !self.stop.requested() {
            let event = {
                // The check for a stop must not cancel the poll.
                let mut poll = pin!(self.events.poll());
                loop {
                    lock(&self.shared).turned_ns = clock::monotonic_ns();
                    if self.stop.requested() {
                        return;
                    }
                    let now = Instant::now();
                    if self.probe.is_unanswered(now) {
                        break None;
                    }
                    if self.probe.is_due(false, now)
                        && self.client.try_subscribe(probe::TOPIC, QoS::AtLeastOnce).is_ok()
                    {
                        self.probe.sent(now);
                    }
                    if let Ok(event) = timeout(POLL, poll.as_mut()).await {
                        break Some(event);
                    }
                }
            };
            let Some(event) = event else {
                self.lost(&probe::SILENT).await;
                continue;
            };
            match event {
                Ok(Event::Incoming(Packet::ConnAck(greeting))) => match fault_of(&greeting) {
                    Some(fault) => {
                        self.lost(&fault).await;
                        self.pause = (self.pause * 2).min(RECONNECT_BROKEN_MAX);
                    }
                    None => self.greet(&greeting),
                },
                Ok(event) => self.take(event),
                // The broker closes the connection after a farewell.
                Err(_) if lock(&self.shared).disconnected => return,
                Err(error) => self.lost(&broken(&error)).await,
            }
        }
    }

    async fn lost(&mut self, error: &impl Display) {
        self.lose();
        if !self.stop.requested()
            && let Some(not_told) = self.log.pass(clock::monotonic_ns())
        {
            tracing::warn!(broker = self.broker, %error, not_told, "no connection, trying again");
        }
        let pause = Instant::now();
        while !self.stop.requested() && pause.elapsed() < self.pause {
            lock(&self.shared).turned_ns = clock::monotonic_ns();
            tokio::time::sleep(POLL).await;
        }
    }

    /// Drops the unfinished messages of a broken connection. The lock keeps new messages out in the process.
    fn lose(&mut self) {
        let mut shared = lock(&self.shared);
        (shared.connection, shared.said, shared.confirmed) = (0, 0, 0);
        self.probe.stop();
        renew(&mut self.events);
    }

    fn greet(&mut self, greeting: &ConnAck) {
        self.pause = RECONNECT;
        correct_keep_alive(&mut self.events);
        let mut shared = lock(&self.shared);
        shared.connections += 1;
        shared.packet_max = greeting.properties.as_ref().and_then(|properties| properties.max_packet_size);
        let connections = shared.connections;
        let filters: Vec<_> = self.filters.iter().map(|path| Filter::new(path, QoS::AtLeastOnce)).collect();
        // The subscription precedes all messages, so that no answer is missed.
        if !filters.is_empty() {
            match self.client.try_subscribe_many(filters) {
                Ok(()) => {
                    self.probe.start(Instant::now());
                    self.probe.sent(Instant::now());
                }
                Err(error) => tracing::error!(broker = self.broker, %error, "cannot subscribe"),
            }
        }
        (shared.connection, shared.said, shared.confirmed) = (connections, 0, 0);
        if let Some(not_told) = self.greetings.pass(clock::monotonic_ns()) {
            tracing::info!(broker = self.broker, connections, not_told, "connected");
        }
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Incoming(Packet::SubAck(answer)) => {
                for (filter, reason) in self.filters.iter().zip(&answer.return_codes).skip(1) {
                    if !matches!(reason, rumqttc::v5::mqttbytes::v5::SubscribeReasonCode::Success(_)) {
                        tracing::error!(
                            broker = self.broker,
                            filter,
                            ?reason,
                            "the broker refuses a subscription: nothing is heard of it; give this client the right to read it"
                        );
                    }
                }
            }
            Event::Incoming(Packet::PubAck(answer)) => {
                let mut shared = lock(&self.shared);
                shared.confirmed += 1;
                if !matches!(answer.reason, PubAckReason::Success | PubAckReason::NoMatchingSubscribers) {
                    shared.refused += 1;
                    // The log has one line for each doubling of their number.
                    if shared.refused.is_power_of_two() {
                        tracing::error!(broker = self.broker, reason = ?answer.reason, refused = shared.refused, "the broker refuses what is published; give this client the right to write its topics");
                    }
                }
            }
            Event::Incoming(Packet::Publish(message)) => self.hear(message),
            Event::Outgoing(Outgoing::Disconnect) => lock(&self.shared).disconnected = true,
            _ => {}
        }
    }

    fn hear(&mut self, message: Publish) {
        if message.qos != QoS::AtMostOnce {
            self.probe.hear(&message.topic, Instant::now());
        }
        let Ok(topic) = String::from_utf8(message.topic.to_vec()) else { return };
        if topic == probe::TOPIC {
            return;
        }
        let mut shared = lock(&self.shared);
        if message.payload.len() > PAYLOAD_BYTES_MAX {
            shared.oversized += 1;
            if let Some(not_told) = self.large.pass(clock::monotonic_ns()) {
                tracing::warn!(
                    topic = &*visible(&topic),
                    bytes = message.payload.len(),
                    limit = PAYLOAD_BYTES_MAX,
                    dropped = shared.oversized,
                    not_told,
                    "a message is too large and is dropped"
                );
            }
            return;
        }
        let heard = Heard { topic, payload: message.payload.to_vec(), retained: message.retain };
        shared.heard_bytes += heard.topic.len() + heard.payload.len();
        shared.heard.push_back(heard);
        while shared.heard_bytes > HEARING_BYTES_MAX
            && let Some(oldest) = shared.heard.pop_front()
        {
            shared.heard_bytes = shared.heard_bytes.saturating_sub(oldest.topic.len() + oldest.payload.len());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mosquitto::{ANYBODY, Mosquitto, NO_BROKER, free_port};
    use crate::skipped::skipped;

    fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
        crate::eventually::eventually(what, || holds().then_some(()));
    }

    fn link(port: u16, client: &str, filter: &str) -> Link {
        let address = format!("mqtt://127.0.0.1:{port}");
        let broker = Broker { address, client: client.to_owned(), ..Broker::default() };
        let will = Will { topic: format!("will/{client}"), payload: "gone".to_owned() };
        Link::start(&broker, vec![filter.to_owned()], Some(will)).unwrap()
    }

    fn hear_until(link: &Link, payload: &str) -> Vec<Heard> {
        let mut all = Vec::new();
        eventually(payload, || {
            all.extend(link.heard());
            all.iter().any(|heard| heard.payload == payload.as_bytes())
        });
        all
    }

    #[test]
    fn what_is_said_without_a_connection_is_refused_and_not_carried_out_later() {
        let port = free_port();
        let (speaker, ears) = (link(port, "speaker", "none"), link(port, "ears", "order/#"));
        assert!((0..1000).all(|_| !speaker.say("order/clean", "stale", false, None)));
        let Some(mut broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY) else {
            skipped(NO_BROKER);
            return;
        };
        eventually("both are connected", || speaker.connection() > 0 && ears.connection() > 0);
        assert!(speaker.say("order/clean", "one", false, Some(30)));
        assert_eq!(hear_until(&ears, "one").len(), 1);
        eventually("the broker has it", || speaker.unconfirmed() == 0);
        // The broker goes. A message sent before the link notices is lost.
        let first = speaker.connection();
        broker.stop();
        eventually("the link notices", || {
            speaker.say("order/clean", "stale", false, None);
            speaker.connection() != first
        });
        let _broker = Mosquitto::start(port, tempfile::tempdir().unwrap(), ANYBODY).unwrap();
        eventually("both are connected again", || speaker.connection() > first && ears.connection() > 1);
        assert!(speaker.say("order/clean", "two", false, None));
        assert_eq!(hear_until(&ears, "two").len(), 1, "nothing stale came before it");
    }

    #[test]
    fn who_is_dropped_leaves_a_will_and_who_leaves_does_not() {
        let Some((_broker, port)) = Mosquitto::ready() else { return };
        let ears = link(port, "ears", "will/#");
        let (dropped, leaving) = (link(port, "dropped", "none"), link(port, "leaving", "none"));
        eventually("all are connected", || [&ears, &dropped, &leaving].iter().all(|link| link.connection() > 0));
        assert!(leaving.say("will/leaving", "farewell", true, None));
        leaving.leave();
        drop(dropped);
        let heard = hear_until(&ears, "gone");
        let said: Vec<_> = heard.iter().map(|heard| heard.topic.as_str()).collect();
        assert_eq!(said, ["will/leaving", "will/dropped"], "{heard:?}");
    }

    /// One message beyond the broker's limit ended the connection again and again, and no message arrived.
    #[test]
    fn what_is_larger_than_the_broker_takes_is_left_out() {
        let port = free_port();
        let access = format!("{ANYBODY}\nmax_packet_size 400");
        let Some(_broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), &access) else {
            skipped(NO_BROKER);
            return;
        };
        let (speaker, ears) = (link(port, "speaker", "none"), link(port, "ears", "told/#"));
        eventually("both are connected", || speaker.connection() > 0 && ears.connection() > 0);
        for bytes in 360..420 {
            let topic = format!("told/{bytes}");
            assert!(speaker.say(&topic, &"x".repeat(bytes), false, Some(30)));
            eventually("the broker has it", || speaker.unconfirmed() == 0);
        }
        assert!(speaker.say("told/last", "last", false, None));
        let heard = hear_until(&ears, "last");
        assert!(heard.len() > 10 && heard.len() < 40, "{}", heard.len());
        assert_eq!(speaker.connection(), 1, "it is the same connection");
    }

    #[test]
    fn many_images_do_not_silence_the_link() {
        let Some((broker, port)) = Mosquitto::ready() else { return };
        let ears = link(port, "ears", "robot/#");
        eventually("it is connected", || ears.connection() > 0);
        broker.publish(&vec![("robot/map", "x".repeat(1_200_000), false); 64]);
        broker.publish(&[("robot/state", "docked".into(), false)]);
        assert_eq!(hear_until(&ears, "docked").len(), 1);
        assert_eq!(ears.connection(), 1, "it is the same connection");
        assert_eq!(lock(&ears.shared).oversized, 64);
    }

    #[test]
    fn what_nobody_reads_fills_no_memory() {
        const BYTES: usize = 60 << 10;
        let Some((broker, port)) = Mosquitto::ready() else { return };
        let ears = link(port, "ears", "#");
        eventually("it is connected", || ears.connection() > 0);
        let (long, too_long) = ("x".repeat(BYTES), "y".repeat(PAYLOAD_BYTES_MAX + 1));
        for _ in 0..4 {
            broker.publish(&vec![("long", long.clone(), false); 64]);
            broker.publish(&[("long", too_long.clone(), false)]);
        }
        broker.publish(&[("last", "last".into(), false)]);
        eventually("the last one has come", || {
            lock(&ears.shared).heard.back().is_some_and(|heard| heard.topic == "last")
        });
        assert!(lock(&ears.shared).heard_bytes <= HEARING_BYTES_MAX);
        let heard = ears.heard();
        assert!(heard.len() > 32 && heard.len() <= HEARING_BYTES_MAX / BYTES + 1, "{}", heard.len());
        assert!(heard.iter().all(|heard| heard.payload.first() != Some(&b'y')));
    }
}
