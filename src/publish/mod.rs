//! The bridge: what Roomcast knows, over MQTT, for Home Assistant, Node-RED and whoever reads topics.
//!
//! A participant of its own, beside the daemon and not in it: the daemon keeps its hands free of sockets. It holds the newest message of
//! each kind and what it has said last, nothing else, so a broker that is away costs no memory. At every connection it says everything
//! again, and takes away what an earlier run has left there and nobody wants any more.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use roomcast_ipc::{
    DecisionV1, Domain, ForecastV1, IpcError, PersonForecastsV1, Publisher, RobotReportV1, RoomScoresV1, Subscriber,
    sequence,
};
use roomcast_services::clock;
use roomcast_services::config::Config;
use roomcast_services::logging::Limiter;
use roomcast_services::mqtt::link::{Heard, Link, Will};
use roomcast_services::mqtt::{Broker, MqttError};
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

/// How often connections are renewed at least.
const TICK: Duration = Duration::from_millis(100);
/// How often the daemon is asked for its counters, and how long it has to answer.
const ASK_AGAIN: Duration = Duration::from_secs(10);
/// What somebody else has overwritten is said again at most so often.
const HEAL_EVERY: Duration = Duration::from_secs(10);
/// A broker that does not give back what it keeps is told everything after so long; a later run may find topics then that no list names.
const LISTEN: Duration = Duration::from_secs(5);
/// How often it is looked which planners there are.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
const PATIENCE: Duration = Duration::from_millis(200);
/// The daemon is away when it has missed so many heartbeats, and is silent for two seconds at least.
const HEARTBEATS: u64 = 4;
const SILENCE_NS: u64 = 2_000_000_000;
/// How long `once` waits for the daemon, and taking away for the broker.
const WAIT: Duration = Duration::from_secs(10);
/// How long the connection's thread may take for a turn before this process no longer says that it lives.
const TURN_MAX_NS: u64 = 5_000_000_000;
/// Complaints about malformed messages come at most so often.
const QUIET_NS: u64 = 5_000_000_000;

/// Why there is no bridge.
#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    /// A service.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The broker.
    #[error(transparent)]
    Mqtt(#[from] MqttError),
    /// What is printed cannot be written.
    #[error("failed to write to standard output: {0}; check where it leads")]
    Print(std::io::Error),
    /// Nobody publishes scores.
    #[error("no daemon has published scores and forecasts within {} s; start `roomcast daemon` in this domain", WAIT.as_secs())]
    NoDaemon,
    /// What the broker keeps could not be taken away.
    #[error("the broker has not taken everything away within {} s; is it there, and may this client write its topics?", WAIT.as_secs())]
    NotRemoved,
}

/// Where messages go.
pub enum Way<'a> {
    /// To a broker.
    Broker(&'a Broker),
    /// To whoever reads them, as lines of JSON; nothing is published.
    Print {
        /// Ends when everything was printed once.
        once: bool,
        /// Takes topic, payload and whether it is retained.
        print: &'a mut dyn FnMut(&str, &str) -> std::io::Result<()>,
    },
}

/// What the broker tells of itself, and of what it keeps.
struct Ears {
    discovery: String,
    node: String,
    base: String,
    marker: String,
    nonce: String,
    /// The topics that the list of an earlier run names, and what was heard that may be among them.
    listed: BTreeSet<String>,
    kept: BTreeSet<String>,
    /// Everything that the broker keeps was heard.
    all: bool,
    /// Orders of persons.
    orders: Orders,
}

/// Whether a topic is one that messages can be published to, and that a filter asks for.
fn fits(filter: &str, topic: &str) -> bool {
    let (filter, levels): (Vec<_>, Vec<_>) = (filter.split('/').collect(), topic.split('/').collect());
    let is_wanted = |(wanted, level): (&&str, &&str)| *wanted == "+" || wanted == level;
    !topic.contains(['+', '#', '\0']) && filter.len() == levels.len() && filter.iter().zip(&levels).all(is_wanted)
}

impl Ears {
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

    /// Those of what is told.
    fn told(&self) -> impl Iterator<Item = String> {
        let own = ["rooms", "persons", "robots"].map(|kind| format!("{}/{kind}/+", self.base));
        let single = ["status", "daemon", "health", "home", "narrated"].map(|topic| format!("{}/{topic}", self.base));
        own.into_iter().chain(single)
    }

    /// That of entities.
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

    /// A new connection: the marker comes back behind all that the broker keeps.
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
                // What is told has no origin of its own: an earlier run has listed what it told, and all else is somebody else's.
                let own = std::mem::take(&mut self.kept).into_iter().filter(|topic| self.listed.contains(topic));
                own.for_each(|topic| outbox.find(topic));
                outbox.hear_all();
            }
        } else if self.all {
            outbox.hear(&topic, &payload);
        } else if !retained || payload.is_empty() {
            // What comes now is new.
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

/// The daemon's and the planners' services.
struct Ports {
    scores: Subscriber<RoomScoresV1>,
    forecasts: Subscriber<ForecastV1>,
    persons: Subscriber<PersonForecastsV1>,
    decisions: Subscriber<DecisionV1>,
    /// None where all places of this service are taken: robots' places are not known then.
    reports: Option<Subscriber<RobotReportV1>>,
    log: Limiter,
    message: Box<(RoomScoresV1, ForecastV1, PersonForecastsV1, DecisionV1, RobotReportV1)>,
}

impl Ports {
    /// Takes whatever has come.
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

/// Publishes until it is asked to stop, or, printing once, until all was printed.
///
/// # Errors
///
/// [`BridgeError`] when a service or the broker's set-up cannot be used, or nobody publishes scores.
pub fn run(config: &Config, domain: &Domain, mut way: Way<'_>, stop: &Stop) -> Result<(), BridgeError> {
    let node = domain.open("roomcast-publish")?;
    let mut ports = Ports {
        scores: node.subscriber()?,
        forecasts: node.subscriber()?,
        persons: node.subscriber()?,
        decisions: node.subscriber()?,
        reports: node.subscriber().ok(),
        log: Limiter::new(QUIET_NS),
        message: Box::default(),
    };
    let status = node.status_client()?;
    let mut reasons = Reasons::new(&node)?;
    let mut ears = Ears::new(config);
    let link = match &way {
        Way::Broker(broker) => Some(open(config, broker, &ears)?),
        Way::Print { .. } => None,
    };
    notify(&[NotifyState::Ready]);
    let advisor = Planner::for_advice(config);
    let mut known = Known::default().with_advisor(advisor);
    let mut reports: Option<Publisher<RobotReportV1>> = None;
    // What is printed stands nowhere.
    let mut outbox = match &link {
        Some(_) => Outbox::with_list(&ears.base, &ears.node),
        None => Outbox::default(),
    };
    let silent_ns = SILENCE_NS.max(config.daemon.heartbeat_ms.saturating_mul(1_000_000 * HEARTBEATS));
    let interval = Duration::from_secs_f64(config.bridge.interval_s);
    let start = Instant::now();
    let (mut connection, mut drawn, mut asked, mut watchdog) =
        (0, None::<Instant>, None::<Instant>, Watchdog::default());
    let (mut looked, mut connected, mut healed) = (None::<Instant>, start, start);
    while !stop.requested() {
        ports.scores.wait(TICK)?;
        ports.take(&mut known, &config.planner.robot)?;
        let alive = known.silence_ns(clock::monotonic_ns()).is_some_and(|silence_ns| silence_ns <= silent_ns);
        if alive && asked.is_none_or(|asked| asked.elapsed() >= ASK_AGAIN) {
            asked = Some(Instant::now());
            known.take_status(status.ask(PATIENCE).ok());
        }
        // Whose planner ends right after its first decision was there, too.
        if known.take_new_robot() || looked.is_none_or(|looked| looked.elapsed() >= LOOK_AGAIN) {
            looked = Some(Instant::now());
            // A list that fails changes nothing: whoever is there is there the next time.
            if let Ok(participants) = node.participants() {
                known.take_planners(&participants, &config.planner.robot);
            }
        }
        if let Some(link) = &link {
            let (now, ordered) = listen(link, connection, &mut ears, &mut outbox);
            for order in ordered {
                let times = (clock::monotonic_ns(), clock::unix_ns());
                let (robots, rooms) = (known.robots(&config.planner.robot), known.rooms());
                match ears.orders.read(&order.topic, &order.payload, &robots, &rooms, times) {
                    Ok(order) => {
                        if reports.is_none() {
                            reports = Some(node.publisher()?);
                        }
                        reports.as_ref().map(|reports| reports.send(&order)).transpose()?;
                    }
                    Err(error) => {
                        let topic = order.topic;
                        tracing::warn!(error, topic, "an order over MQTT is not taken");
                    }
                }
            }
            // A planner that joins gets the last orders.
            reports.as_ref().map(Publisher::tick).transpose()?;
            connected = if connection == now { connected } else { Instant::now() };
            connection = now;
        }
        if healed.elapsed() >= HEAL_EVERY {
            healed = Instant::now();
            outbox.heal();
        }
        if drawn.is_none_or(|drawn| drawn.elapsed() >= interval) {
            drawn = Some(Instant::now());
            let complete = known.is_complete() && (ears.all || link.is_none());
            if alive && let Some(reasons) = reasons.refresh(known.persons_known().into_iter()) {
                known.take_reasons(reasons);
            }
            known.advise(clock::monotonic_ns(), clock::unix_ns(), &config.planner.robot);
            outbox.want(known.picture(&config.bridge, &config.planner.robot, alive), complete);
        }
        match (&mut way, &link) {
            // First the list of topics, which is made of what the broker keeps.
            (Way::Broker(_), Some(link)) if ears.all || connected.elapsed() >= LISTEN => send(link, &mut outbox),
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
        let turns = |link: &Link| clock::monotonic_ns().since(link.turned_ns()) <= TURN_MAX_NS;
        if link.as_ref().is_none_or(turns) {
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

/// Takes everything away that a bridge has left at the broker, and ends.
///
/// # Errors
///
/// [`BridgeError`] when the broker cannot be reached, or refuses.
pub fn remove(config: &Config, broker: &Broker, stop: &Stop) -> Result<(), BridgeError> {
    let mut ears = Ears::new(config);
    let link = Link::start(broker, ears.filters(), None)?;
    let (mut outbox, mut connection, start) = (Outbox::with_list(&ears.base, &ears.node), 0, Instant::now());
    while !stop.requested() {
        std::thread::sleep(TICK);
        (connection, _) = listen(&link, connection, &mut ears, &mut outbox);
        outbox.want(Picture::new(), ears.all);
        send(&link, &mut outbox);
        if connection > 0 && ears.all && outbox.is_done() && link.unconfirmed() == 0 {
            link.leave();
            return Ok(());
        }
        if start.elapsed() >= WAIT {
            return Err(BridgeError::NotRemoved);
        }
    }
    Ok(())
}

fn open(config: &Config, broker: &Broker, ears: &Ears) -> Result<Link, MqttError> {
    let will = Will { topic: format!("{}/status", config.bridge.topic), payload: OFFLINE.to_owned() };
    Link::start(broker, ears.filters(), Some(will))
}

/// Takes what the broker says; gives the number of the connection, and the orders of persons. An order that the broker has kept is an old one.
fn listen(link: &Link, before: u64, ears: &mut Ears, outbox: &mut Outbox) -> (u64, Vec<Heard>) {
    let mut connection = link.connection();
    if connection != before {
        outbox.lose();
        if connection > 0 && !ears.connect(link) {
            connection = 0;
        }
    }
    let (orders, others): (Vec<_>, Vec<_>) = link.heard().into_iter().partition(|heard| ears.orders.has(&heard.topic));
    others.into_iter().for_each(|heard| ears.hear(heard, outbox));
    (connection, orders.into_iter().filter(|heard| !heard.retained).collect())
}

/// Says what is new, as much as may be under way.
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
