//! Publishes Roomcast's state over MQTT, for Home Assistant, Node-RED and other readers of topics.
//!
//! This is a separate participant, so that the daemon needs no sockets. It holds only the newest message of each kind and its last published values,
//! so an absent broker costs no memory. At every connection it publishes everything again, and removes unwanted topics of an earlier run.

use std::collections::BTreeSet;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, ForecastV1, PersonForecastsV1, RobotReportV1, RoomScoresV1};
use roomcast_ipc::{Domain, IpcError, Node, Publisher, Subscriber, sequence};
use roomcast_services::clock;
use roomcast_services::config::Config;
use roomcast_services::logging::Limiter;
use roomcast_services::mqtt::link::{Heard, Link, Will};
use roomcast_services::mqtt::{Broker, MqttError};
use roomcast_services::narrator::{self, CORRECTIONS, Input, Item, Pace};
use roomcast_services::notify::{Watchdog, notify};
use roomcast_services::planner::Planner;
use roomcast_services::receive::receive;
use roomcast_services::stop::Stop;
use sd_notify::NotifyState;

mod discovery;
mod known;
mod names;
mod orders;
mod outbox;

use crate::reasons::Reasons;
use known::{Known, OFFLINE};
use orders::Orders;
use outbox::{FOUND_MAX, Outbox, Picture, list_topic, listed};

/// Longest period of the main loop.
const TICK: Duration = Duration::from_millis(100);
/// How often the daemon is asked for its counters, and its timeout.
const ASK_AGAIN: Duration = Duration::from_secs(10);
/// An overwritten topic is published again at most this often.
const HEAL_EVERY: Duration = Duration::from_secs(10);
/// If the broker does not return its retained messages in this time, everything is published. A later run may then find unlisted topics.
const LISTEN: Duration = Duration::from_secs(5);
/// How often the domain's planners are looked up.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_millis(200);
/// The daemon is away when it has missed this many heartbeats and has been silent for at least two seconds.
const HEARTBEATS: u64 = 4;
const SILENCE_NS: u64 = 2_000_000_000;
/// How long `once` waits for the daemon, and `remove` for the broker.
const WAIT: Duration = Duration::from_secs(10);
/// If a turn of the connection's thread takes longer, the watchdog is not fed.
const TURN_MAX_NS: u64 = 5_000_000_000;
/// Most corrections that wait for the daemon.
const CORRECTIONS_MAX: usize = 8;
/// Least time between two complaints about malformed messages.
const QUIET_NS: u64 = 5_000_000_000;

#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    #[error(transparent)]
    Ipc(#[from] IpcError),
    #[error(transparent)]
    Mqtt(#[from] MqttError),
    #[error("failed to write to standard output: {0}; check where it leads")]
    Print(std::io::Error),
    /// No daemon publishes scores.
    #[error("no daemon has published scores and forecasts within {} s; start `roomcast daemon` in this domain", WAIT.as_secs())]
    NoDaemon,
    #[error("the broker has not taken everything away within {} s; is it there, and may this client write its topics?", WAIT.as_secs())]
    NotRemoved,
}

/// The destination of messages.
pub enum Way<'a> {
    Broker(&'a Broker),
    /// Lines of JSON for a reader; no broker is used.
    Print {
        /// Ends when everything was printed once.
        once: bool,
        /// Prints a topic and its payload.
        print: &'a mut dyn FnMut(&str, &str) -> std::io::Result<()>,
    },
}

impl<'a> Way<'a> {
    fn broker(&self) -> Option<&'a Broker> {
        match self {
            Self::Broker(broker) => Some(broker),
            Self::Print { .. } => None,
        }
    }
}

/// Handles the broker's messages, among them its retained ones.
struct Incoming {
    discovery: String,
    node: String,
    base: String,
    marker: String,
    nonce: String,
    /// The topics in the list of an earlier run, and the retained topics that may be in it.
    listed: BTreeSet<String>,
    kept: BTreeSet<String>,
    /// All retained messages have arrived.
    all: bool,
    orders: Orders,
}

/// Whether a topic matches a filter and has no wildcards.
fn fits(filter: &str, topic: &str) -> bool {
    let (filter, levels): (Vec<_>, Vec<_>) = (filter.split('/').collect(), topic.split('/').collect());
    let is_wanted = |(wanted, level): (&&str, &&str)| *wanted == "+" || wanted == level;
    !topic.contains(['+', '#', '\0']) && filter.len() == levels.len() && filter.iter().zip(&levels).all(is_wanted)
}

impl Incoming {
    fn new(config: &Config) -> Self {
        let (base, node) = (config.bridge.topic.clone(), discovery::node(&config.bridge));
        Self {
            discovery: config.bridge.discovery.clone(),
            marker: format!("{base}/bridge/connected"),
            orders: Orders::new(&base),
            nonce: format!("{:016x}", sequence::random_epoch()),
            base,
            node,
            listed: BTreeSet::new(),
            kept: BTreeSet::new(),
            all: false,
        }
    }

    /// Filters of the state topics.
    fn told(&self) -> impl Iterator<Item = String> {
        let own = ["rooms", "persons", "robots"].map(|kind| format!("{}/{kind}/+", self.base));
        let single = ["status", "daemon", "health", "home", "narrated"].map(|topic| format!("{}/{topic}", self.base));
        own.into_iter().chain(single)
    }

    /// The filter of discovery topics.
    fn entities(&self) -> Option<String> {
        (!self.discovery.is_empty()).then(|| format!("{}/+/{}/+/config", self.discovery, self.node))
    }

    fn filters(&self) -> Vec<String> {
        self.told()
            .chain(self.entities())
            .chain(self.orders.filters())
            .chain([list_topic(&self.base), self.marker.clone()])
            .collect()
    }

    /// Starts a new connection. The marker comes back after all retained messages.
    fn connect(&mut self, link: &Link) -> bool {
        self.all = false;
        self.listed.clear();
        self.kept.clear();
        link.say(&self.marker, &self.nonce, false, None)
    }

    fn hear(&mut self, heard: Heard, outbox: &mut Outbox) {
        let Heard { topic, payload, retained } = heard;
        if topic == self.marker {
            if payload == self.nonce.as_bytes() && !self.all {
                self.all = true;
                // State messages have no origin: only topics in the list of an earlier run are ours.
                let own = std::mem::take(&mut self.kept).into_iter().filter(|topic| self.listed.contains(topic));
                own.for_each(|topic| outbox.find(topic));
                outbox.hear_all();
            }
        } else if self.all {
            outbox.hear(&topic, &payload);
        } else if !retained || payload.is_empty() {
            // A message that is not retained is new.
        } else if topic == list_topic(&self.base) {
            self.listed = listed(&payload, &self.base, &self.node);
            self.kept.retain(|topic| self.listed.contains(topic));
        } else if self.entities().is_some_and(|filter| fits(&filter, &topic)) {
            if discovery::is_own(&payload, &self.node) {
                outbox.find(topic);
            }
        } else if self.kept.len() < FOUND_MAX && self.told().any(|filter| fits(&filter, &topic)) {
            self.kept.insert(topic);
        }
    }
}

struct Ports {
    scores: Subscriber<RoomScoresV1>,
    forecasts: Subscriber<ForecastV1>,
    persons: Subscriber<PersonForecastsV1>,
    decisions: Subscriber<DecisionV1>,
    /// `None` if the service has no free place; then robots' places are unknown.
    reports: Option<Subscriber<RobotReportV1>>,
    log: Limiter,
    message: Box<(RoomScoresV1, ForecastV1, PersonForecastsV1, DecisionV1, RobotReportV1)>,
}

impl Ports {
    fn open(node: &Node) -> Result<Self, IpcError> {
        Ok(Self {
            scores: node.subscriber()?,
            forecasts: node.subscriber()?,
            persons: node.subscriber()?,
            decisions: node.subscriber()?,
            reports: node.subscriber().ok(),
            log: Limiter::new(QUIET_NS),
            message: Box::default(),
        })
    }

    fn take(&mut self, known: &mut Known, own: &str) -> Result<(), IpcError> {
        let Self { scores, forecasts, persons, decisions, reports, log, message } = self;
        let (of_rooms, forecast, of_persons, decision, report) = &mut **message;
        while receive(scores, of_rooms, log)? {
            known.take_scores(of_rooms);
        }
        while receive(forecasts, forecast, log)? {
            known.take_forecast(forecast);
        }
        while receive(persons, of_persons, log)? {
            known.take_persons(of_persons);
        }
        while receive(decisions, decision, log)? {
            known.take_decision(decision, own);
        }
        if let Some(reports) = reports {
            while receive(reports, report, log)? {
                known.take_report(report);
            }
        }
        Ok(())
    }
}

/// Passes what comes from the broker on to the daemon and to the planners. Both ways open with the first order.
struct Forwarder<'a> {
    config: &'a Config,
    domain: &'a Domain,
    node: &'a Node,
    stop: &'a Stop,
    reports: Option<Publisher<RobotReportV1>>,
    corrections: Option<SyncSender<Item>>,
}

impl Forwarder<'_> {
    /// Takes a correction or an order; a wrong one is a warning.
    fn take(&mut self, heard: &Heard, orders: &mut Orders, known: &Known) -> Result<(), BridgeError> {
        let topic = &heard.topic;
        if let Some(read) = orders.correction(topic, &heard.payload, known.correctable(), &known.named_rooms()) {
            if let Err(error) = read.and_then(|item| self.correct(item)) {
                tracing::warn!(error, topic, "a correction over MQTT is not taken");
            }
            return Ok(());
        }
        let times = (clock::monotonic_ns(), clock::unix_ns());
        let robots = known.robots(&self.config.planner.robot);
        match orders.read(topic, &heard.payload, &robots, &known.rooms(), times) {
            Ok(order) => {
                let reports = match &mut self.reports {
                    Some(reports) => reports,
                    None => self.reports.insert(self.node.publisher()?),
                };
                reports.send(&order)?;
            }
            Err(error) => tracing::warn!(error, topic, "an order over MQTT is not taken"),
        }
        Ok(())
    }

    fn correct(&mut self, item: Item) -> Result<(), String> {
        let sender = match &mut self.corrections {
            Some(sender) => sender,
            None => self.corrections.insert(send_corrections(self.config, self.domain, self.stop)?),
        };
        sender.try_send(item).map_err(|_| "earlier corrections wait for the daemon".to_owned())
    }
}

/// Whether a time has passed since `last`, which then becomes now.
fn is_due(last: &mut Option<Instant>, every: Duration) -> bool {
    let is_due = last.is_none_or(|last| last.elapsed() >= every);
    if is_due {
        *last = Some(Instant::now());
    }
    is_due
}

/// Publishes until asked to stop, or, with `once`, until everything was printed.
///
/// # Errors
///
/// [`BridgeError`] if a service or the broker's configuration is unusable, or no daemon publishes scores.
pub fn run(config: &Config, domain: &Domain, mut way: Way<'_>, stop: &Stop) -> Result<(), BridgeError> {
    let node = domain.open("roomcast-publish")?;
    let mut ports = Ports::open(&node)?;
    let status = node.status_client()?;
    let mut reasons = Reasons::new(&node)?;
    let mut incoming = Incoming::new(config);
    let link = way.broker().map(|broker| open(config, broker, &incoming)).transpose()?;
    notify(&[NotifyState::Ready]);
    let mut known = Known::default().with_advisor(Planner::for_advice(config));
    let mut forwarder = Forwarder { config, domain, node: &node, stop, reports: None, corrections: None };
    // Printed messages are not retained.
    let mut outbox = link.as_ref().map_or_else(Outbox::default, |_| Outbox::with_list(&incoming.base, &incoming.node));
    let silent_ns = SILENCE_NS.max(config.daemon.heartbeat_ms.saturating_mul(1_000_000 * HEARTBEATS));
    let interval = Duration::from_secs_f64(config.bridge.interval_s);
    let start = Instant::now();
    let (mut connection, mut connected, mut watchdog) = (0, start, Watchdog::default());
    let (mut drawn, mut asked, mut looked, mut healed) = (None, None, None, Some(start));
    while !stop.requested() {
        ports.scores.wait(TICK)?;
        ports.take(&mut known, &config.planner.robot)?;
        let alive = known.silence_ns(clock::monotonic_ns()).is_some_and(|silence_ns| silence_ns <= silent_ns);
        if alive && is_due(&mut asked, ASK_AGAIN) {
            known.take_status(status.ask(PATIENCE).ok());
        }
        // A planner may end right after its first decision.
        if known.take_new_robot() | is_due(&mut looked, LOOK_AGAIN) {
            // A failed list changes nothing; the next one will show the participants.
            if let Ok(participants) = node.participants() {
                known.take_planners(&participants, &config.planner.robot);
            }
        }
        if let Some(link) = &link {
            let (now, ordered) = listen(link, connection, &mut incoming, &mut outbox);
            for order in &ordered {
                forwarder.take(order, &mut incoming.orders, &known)?;
            }
            // A new planner gets the last orders.
            forwarder.reports.as_ref().map(Publisher::tick).transpose()?;
            connected = if connection == now { connected } else { Instant::now() };
            connection = now;
        }
        if is_due(&mut healed, HEAL_EVERY) {
            outbox.heal();
        }
        if is_due(&mut drawn, interval) {
            let complete = known.is_complete() && (incoming.all || link.is_none());
            if alive && let Some(reasons) = reasons.refresh(known.persons_known().into_iter()) {
                known.take_reasons(reasons);
            }
            known.advise(clock::monotonic_ns(), clock::unix_ns(), &config.planner.robot);
            outbox.want(known.picture(&config.bridge, &config.planner.robot, alive), complete);
        }
        match (&mut way, &link) {
            // The list of topics needs the broker's retained messages, so it comes first.
            (Way::Broker(_), Some(link)) if incoming.all || connected.elapsed() >= LISTEN => send(link, &mut outbox),
            (Way::Print { once, print }, _) if known.is_complete() || !*once => {
                // The picture was drawn before everything was known.
                if *once {
                    outbox.want(known.picture(&config.bridge, &config.planner.robot, alive), true);
                }
                print_all(&mut outbox, print)?;
                if *once {
                    return Ok(());
                }
            }
            (Way::Print { .. }, _) if start.elapsed() >= WAIT => return Err(BridgeError::NoDaemon),
            _ => {}
        }
        if link.as_ref().is_none_or(|link| clock::monotonic_ns().since(link.turned_ns()) <= TURN_MAX_NS) {
            watchdog.lives();
        }
    }
    notify(&[NotifyState::Stopping]);
    if let Some(link) = link {
        let _said = link.say(&format!("{}/status", config.bridge.topic), OFFLINE, true, None);
        link.leave();
    }
    Ok(())
}

/// Starts a thread that sends corrections to the daemon, one after the other, as `roomcast person correct` does. It ends with its sender.
fn send_corrections(config: &Config, domain: &Domain, stop: &Stop) -> Result<SyncSender<Item>, String> {
    let (sender, items) = sync_channel(CORRECTIONS_MAX);
    let (mut own, limits) = (config.narrator.clone(), config.daemon.intake);
    (own.name, own.linger_s) = (CORRECTIONS.to_owned(), WAIT.as_secs_f64());
    let (domain, stop) = (domain.clone(), stop.clone());
    let send = move || {
        for item in items {
            match narrator::run(&own, limits, &domain, Input::Items(vec![item]), Pace::Seconds(0.0), &stop) {
                Ok(outcome) if outcome.confirmed > 0 => {}
                Ok(_) => tracing::warn!("the daemon did not confirm a correction over MQTT; send it again"),
                Err(error) => tracing::warn!(%error, "failed to send a correction over MQTT"),
            }
        }
    };
    std::thread::Builder::new().name("corrections".to_owned()).spawn(send).map_err(|error| error.to_string())?;
    Ok(sender)
}

/// Removes everything that a bridge has retained at the broker, and ends.
///
/// # Errors
///
/// [`BridgeError`] if the broker cannot be reached or refuses.
pub fn remove(config: &Config, broker: &Broker, stop: &Stop) -> Result<(), BridgeError> {
    let mut incoming = Incoming::new(config);
    let link = Link::start(broker, incoming.filters(), None)?;
    let (mut outbox, mut connection, start) = (Outbox::with_list(&incoming.base, &incoming.node), 0, Instant::now());
    while !stop.requested() {
        std::thread::sleep(TICK);
        (connection, _) = listen(&link, connection, &mut incoming, &mut outbox);
        outbox.want(Picture::new(), incoming.all);
        send(&link, &mut outbox);
        if connection > 0 && incoming.all && outbox.is_done() && link.unconfirmed() == 0 {
            link.leave();
            return Ok(());
        }
        if start.elapsed() >= WAIT {
            return Err(BridgeError::NotRemoved);
        }
    }
    Ok(())
}

fn open(config: &Config, broker: &Broker, incoming: &Incoming) -> Result<Link, MqttError> {
    let will = Will { topic: format!("{}/status", config.bridge.topic), payload: OFFLINE.to_owned() };
    Link::start(broker, incoming.filters(), Some(will))
}

/// Handles the broker's messages. Returns the number of the connection, and persons' orders. A retained order is old and ignored.
fn listen(link: &Link, before: u64, incoming: &mut Incoming, outbox: &mut Outbox) -> (u64, Vec<Heard>) {
    let mut connection = link.connection();
    if connection != before {
        outbox.lose();
        if connection > 0 && !incoming.connect(link) {
            connection = 0;
        }
    }
    let (orders, others): (Vec<_>, Vec<_>) =
        link.heard().into_iter().partition(|heard| incoming.orders.has(&heard.topic));
    others.into_iter().for_each(|heard| incoming.hear(heard, outbox));
    (connection, orders.into_iter().filter(|heard| !heard.retained).collect())
}

fn send(link: &Link, outbox: &mut Outbox) {
    while let Some((topic, payload)) = outbox.next().map(|(topic, payload)| (topic.to_owned(), payload.to_owned())) {
        if !link.say(&topic, &payload, true, None) {
            return;
        }
        outbox.done(&topic);
    }
}

fn print_all(outbox: &mut Outbox, print: &mut dyn FnMut(&str, &str) -> std::io::Result<()>) -> Result<(), BridgeError> {
    while let Some((topic, payload)) = outbox.next().map(|(topic, payload)| (topic.to_owned(), payload.to_owned())) {
        print(&topic, &payload).map_err(BridgeError::Print)?;
        outbox.done(&topic);
    }
    Ok(())
}

#[cfg(test)]
mod tests;
