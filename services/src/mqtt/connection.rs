//! A connection that receives messages.

use std::collections::VecDeque;
use std::fmt::Display;
use std::io::Write;
use std::pin::pin;
use std::time::{Duration, Instant};

use roomcast_core::text::visible;
use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Packet, Publish};
use rumqttc::v5::{AsyncClient, ConnectionError, Event, EventLoop, MqttOptions};
use tokio::time::{sleep, timeout_at};

use super::acknowledgements::Acknowledgements;
use super::client::{broken, correct_keep_alive, fault_of, renew};
use super::copies::Copies;
use super::listener::{Heard, Listener};
use super::probe::{self, Probe};
use super::recent::Recent;
use super::rehearsal::{Remark, remarked, report};
use super::rules::{Rules, covers};
use super::subscriptions::Subscriptions;
use super::tally::Tally;
use super::{
    FAREWELL, HELD_BYTES_MAX, MESSAGES_AHEAD_MAX, MqttError, PAYLOAD_BYTES_MAX, POLL, RECONNECT, RECONNECT_BROKEN_MAX,
};
use crate::clock;
use crate::logging::Limiter;
use crate::stop::Stop;

/// Memory of a queued message in addition to its topic and payload.
const HELD_BYTES_EACH: usize = 256;
const QUIET_NS: u64 = 30_000_000_000;
/// The longest wait at the end until the last lines are settled. A narrator has a little longer to publish them.
const SETTLING: Duration = Duration::from_secs(4);

pub(super) struct Connection<'a, W> {
    broker: String,
    client: AsyncClient,
    events: EventLoop,
    listener: Listener,
    subscriptions: Subscriptions,
    probe: Probe,
    probe_waits: bool,
    /// Rules also read the probe's topic.
    probe_is_read: bool,
    recent: Recent,
    copies: Copies,
    pub(super) acknowledgements: Acknowledgements,
    /// Messages that wait for acknowledgements of others, oldest first, and their bytes.
    held: VecDeque<Held>,
    held_bytes: usize,
    connected: bool,
    log: Limiter,
    greetings: Limiter,
    oversized: Limiter,
    pause: Duration,
    /// New messages are left to the next session.
    leaves: bool,
    /// Reports lines with a remark instead of writing them.
    pub(super) rehearsal: Option<&'a mut Remark<'a>>,
    pub(super) tally: Option<Tally>,
    out: W,
}

pub(super) fn fault(event: &Event) -> Option<&'static str> {
    if let Event::Incoming(Packet::ConnAck(greeting)) = event { fault_of(greeting) } else { None }
}

enum Turn {
    On,
    Unread,
}

struct Held {
    message: Publish,
    /// Only the beginning of a payload that is too large is stored.
    payload_bytes: usize,
}

impl Held {
    /// Copies a message out of its receive buffer, which is as large as the largest message in it.
    fn of(message: &Publish) -> Self {
        let read = message.payload.len().min(PAYLOAD_BYTES_MAX + 1);
        let copy = Publish {
            topic: message.topic.to_vec().into(),
            payload: message.payload[..read].to_vec().into(),
            ..message.clone()
        };
        Self { message: copy, payload_bytes: message.payload.len() }
    }

    fn bytes(&self) -> usize {
        self.message.topic.len() + self.message.payload.len() + HELD_BYTES_EACH
    }
}

fn write_line(out: &mut impl Write, line: &str) -> std::io::Result<()> {
    writeln!(out, "{line}").and_then(|()| out.flush())
}

impl<'a, W: Write> Connection<'a, W> {
    pub(super) fn new(mut options: MqttOptions, rules: Rules, out: W) -> Self {
        options.set_manual_acks(true);
        let (host, port) = options.broker_address();
        let filters = rules.filters();
        let probe_is_read = filters.iter().any(|filter| covers(filter, probe::TOPIC));
        let subscriptions = Subscriptions::new(filters);
        // One subscription, one probe, one farewell, and every acknowledgement.
        let (client, events) = AsyncClient::new(options, 3 + usize::from(MESSAGES_AHEAD_MAX));
        let (listener, recent) = (Listener::new(rules), Recent::default());
        Self {
            broker: format!("{host}:{port}"),
            client,
            events,
            listener,
            subscriptions,
            probe: Probe::new(Instant::now()),
            probe_waits: false,
            probe_is_read,
            recent,
            copies: Copies::default(),
            acknowledgements: Acknowledgements::default(),
            held: VecDeque::new(),
            held_bytes: 0,
            connected: false,
            log: Limiter::new(QUIET_NS),
            greetings: Limiter::new(QUIET_NS),
            oversized: Limiter::new(QUIET_NS),
            pause: RECONNECT,
            leaves: false,
            rehearsal: None,
            tally: None,
            out,
        }
    }

    pub(super) async fn listen(mut self, stop: &Stop) -> Result<Heard, MqttError> {
        let mut connections = 0_u64;
        loop {
            let turn = match self.next(|_| stop.requested()).await {
                Ok(Some(Ok(event))) => match fault(&event) {
                    Some(fault) => {
                        let turn = self.lost(&fault, &mut connections, stop).await?;
                        self.pause = (self.pause * 2).min(RECONNECT_BROKEN_MAX);
                        turn
                    }
                    None => self.take(&event, &mut connections)?,
                },
                Ok(Some(Err(error))) => self.lost(&broken(&error), &mut connections, stop).await?,
                Ok(None) if stop.requested() => break,
                Ok(None) => self.lost(&probe::SILENT, &mut connections, stop).await?,
                Err(_) => Turn::Unread,
            };
            self.keep_tally(false);
            if matches!(turn, Turn::Unread) {
                self.keep_tally(true);
                return Ok(self.listener.heard);
            }
        }
        self.leave(&mut connections).await?;
        self.keep_tally(true);
        Ok(self.listener.heard)
    }

    /// The next event; `None` if `is_over` or the broker did not answer a probe, an error if the reader is gone. The checks, the
    /// acknowledgements and the lines after a silence do not cancel the poll: a slow broker has the client's own time limit.
    async fn next(
        &mut self,
        is_over: impl Fn(&Acknowledgements) -> bool,
    ) -> std::io::Result<Option<Result<Event, ConnectionError>>> {
        let Self {
            client,
            events,
            listener,
            subscriptions,
            probe,
            probe_waits,
            held,
            acknowledgements,
            out,
            connected,
            leaves,
            rehearsal,
            ..
        } = self;
        let mut poll = pin!(events.poll());
        loop {
            let (now, is_busy) = (Instant::now(), acknowledgements.are_open() || !held.is_empty());
            if *connected && !*leaves && probe.is_due(is_busy, now) && !*probe_waits && subscriptions.are_at_rest() {
                *probe_waits = client.try_subscribe(probe::TOPIC, QoS::AtLeastOnce).is_ok();
                if *probe_waits {
                    probe.sent(now);
                }
            }
            if !*probe_waits {
                subscriptions.send(client);
            }
            acknowledgements.send(client);
            if is_over(acknowledgements) || !*leaves && probe.is_unanswered(now) {
                return Ok(None);
            }
            // Without a connection there is no silence, since nothing can arrive.
            let due = if *connected && !*leaves { listener.due(Instant::now()) } else { Vec::new() };
            let mut shown = |line: &String| match rehearsal {
                Some(remark) => format!("after silence\n  says {}", remarked(line, *remark)),
                None => line.clone(),
            };
            due.iter().try_for_each(|line| write_line(out, &shown(line)))?;
            acknowledgements.written += due.len() as u64;
            tokio::select! {
                event = poll.as_mut() => return Ok(Some(event)),
                news = acknowledgements.news() => news?,
                () = sleep(POLL) => {}
            }
        }
    }

    fn keep_tally(&mut self, at_end: bool) {
        if let Some(tally) = &mut self.tally {
            tally.keep(&self.listener.fitted, at_end);
        }
    }

    fn take(&mut self, event: &Event, connections: &mut u64) -> Result<Turn, MqttError> {
        match event {
            Event::Incoming(Packet::ConnAck(greeting)) => {
                *connections += 1;
                (self.connected, self.pause) = (true, RECONNECT);
                correct_keep_alive(&mut self.events);
                self.recent.connect(greeting.session_present);
                if !greeting.session_present {
                    self.copies.forget();
                }
                self.listener.first_connection = *connections == 1;
                self.listener.listen_from(Instant::now());
                self.probe.start(Instant::now());
                if let Some(not_told) = self.greetings.pass(clock::monotonic_ns()) {
                    tracing::info!(broker = self.broker, connections, not_told, "connected");
                }
                // At every connection: a broker that lost its sessions would send no messages.
                self.subscriptions.start(greeting);
            }
            Event::Outgoing(Outgoing::Subscribe(_)) if self.probe_waits => self.probe_waits = false,
            Event::Outgoing(Outgoing::Subscribe(pkid) | Outgoing::Unsubscribe(pkid)) => self.subscriptions.sent(*pkid),
            Event::Outgoing(packet) => {
                self.recent.sent(packet);
                if matches!(packet, Outgoing::PubAck(_)) {
                    self.acknowledgements.on_way = self.acknowledgements.on_way.saturating_sub(1);
                    return self.say_held(*connections, |_, room| room);
                }
            }
            Event::Incoming(Packet::PingResp(_)) => self.recent.answered(),
            Event::Incoming(Packet::SubAck(answer)) => self.subscriptions.take(answer, &self.broker)?,
            Event::Incoming(Packet::UnsubAck(answer)) => self.subscriptions.ended(answer),
            Event::Incoming(Packet::Publish(_)) if self.leaves => {}
            Event::Incoming(Packet::Publish(message)) => {
                if message.qos != QoS::AtMostOnce {
                    self.probe.hear(&message.topic, Instant::now());
                }
                let held = Held::of(message);
                self.held_bytes += held.bytes();
                self.held.push_back(held);
                return self.say_held(*connections, |_, room| room);
            }
            _ => {}
        }
        Ok(Turn::On)
    }

    /// Processes queued messages, oldest first, while `may` allows it. Its argument says whether there is room for one more, or the queue
    /// is too large.
    fn say_held(&mut self, connections: u64, may: impl Fn(&Publish, bool) -> bool) -> Result<Turn, MqttError> {
        while let Some(held) = self.held.pop_front() {
            let room = self.acknowledgements.have_room() || self.held_bytes > HELD_BYTES_MAX;
            if !may(&held.message, room) {
                self.held.push_front(held);
                break;
            }
            self.held_bytes = self.held_bytes.saturating_sub(held.bytes());
            let Held { message, payload_bytes } = held;
            let line = match self.recent.again(connections, &message) {
                Some(line) => line,
                None => {
                    if !self.copies.take(&message) && self.hear(&message, payload_bytes).is_err() {
                        return Ok(Turn::Unread);
                    }
                    self.recent.take(connections, &message, self.acknowledgements.written);
                    self.acknowledgements.written
                }
            };
            self.acknowledgements.put(&message, line);
        }
        Ok(Turn::On)
    }

    fn hear(&mut self, message: &Publish, payload_bytes: usize) -> std::io::Result<()> {
        let (topic, payload, retained, now) = (&message.topic, &message.payload, message.retain, Instant::now());
        if topic == probe::TOPIC && !self.probe_is_read {
            return Ok(());
        }
        if payload_bytes > PAYLOAD_BYTES_MAX
            && let Some(not_told) = self.oversized.pass(clock::monotonic_ns())
        {
            let (topic, dropped) = (String::from_utf8_lossy(topic), self.listener.heard.oversized + 1);
            tracing::warn!(
                topic = &*visible(&topic),
                bytes = payload_bytes,
                limit = PAYLOAD_BYTES_MAX,
                dropped,
                not_told,
                "a message is too large and is dropped; leave its topic out of the rules"
            );
        }
        if let Some(remark) = &mut self.rehearsal {
            let outcomes = self.listener.outcomes(topic, payload, retained, now);
            let text = report(&self.listener.rules, (topic, payload, retained), &outcomes, *remark);
            return write_line(&mut self.out, &text);
        }
        let lines = self.listener.hear(topic, payload, retained, now);
        self.acknowledgements.written += lines.len() as u64;
        lines.iter().try_for_each(|line| write_line(&mut self.out, line))
    }

    /// Processes the messages that were read before the connection broke: the broker sends them again, and they are recognised. Then a
    /// pause.
    async fn lost(&mut self, error: &impl Display, connections: &mut u64, stop: &Stop) -> Result<Turn, MqttError> {
        // After a request to stop there is no new try.
        if !stop.requested()
            && let Some(not_told) = self.log.pass(clock::monotonic_ns())
        {
            tracing::warn!(broker = self.broker, %error, not_told, "no connection, trying again");
        }
        let mut turn = self.drain(connections)?;
        if matches!(turn, Turn::On) {
            turn = self.say_held(*connections, |_, _| true)?;
        }
        // The next connection makes unsent subscriptions again.
        renew(&mut self.events);
        self.subscriptions.stop();
        self.probe.stop();
        self.probe_waits = false;
        self.acknowledgements.forget();
        self.connected = false;
        let pause = Instant::now();
        while !stop.requested() && pause.elapsed() < self.pause {
            sleep(POLL).await;
        }
        Ok(turn)
    }

    fn drain(&mut self, connections: &mut u64) -> Result<Turn, MqttError> {
        while let Some(event) = self.events.state.events.pop_front() {
            if matches!(self.take(&event, connections)?, Turn::Unread) {
                return Ok(Turn::Unread);
            }
        }
        Ok(Turn::On)
    }

    /// Waits until the lines are settled and acknowledged, sends a farewell, and stays until the broker closes the connection, which shows
    /// that it has read everything. Later or unsettled messages are not acknowledged, and come again in the next session.
    async fn leave(&mut self, connections: &mut u64) -> Result<(), MqttError> {
        if !self.connected {
            return Ok(());
        }
        // Messages read with an event are still processed. Queued messages come again, except messages that the broker does not store.
        if matches!(self.drain(connections)?, Turn::Unread) {
            return Ok(());
        }
        self.held.retain(|held| held.message.qos == QoS::AtMostOnce);
        self.held_bytes = self.held.iter().map(Held::bytes).sum();
        if matches!(self.say_held(*connections, |_, _| true)?, Turn::Unread) {
            return Ok(());
        }
        self.leaves = true;
        let end = Instant::now() + SETTLING;
        let is_settled = |open: &Acknowledgements| open.waiting.is_empty() || Instant::now() >= end;
        while let Ok(Some(event)) = self.next(is_settled).await {
            let Ok(event) = event else { return Ok(()) };
            self.take(&event, connections)?;
        }
        let end = tokio::time::Instant::now() + FAREWELL;
        // The client has no room while too many acknowledgements are in its queue.
        let mut said = false;
        loop {
            said = said || self.client.try_disconnect().is_ok();
            let Ok(Ok(_)) = timeout_at(end, self.events.poll()).await else { return Ok(()) };
        }
    }
}
