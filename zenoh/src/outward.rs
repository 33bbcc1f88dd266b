//! Publishes the robot's services to other machines, and answers later queries for their last values.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, Message, PersonForecastsV1, RoomScoresV1, StatusResponseV1, decision_flags,
};
use roomcast_ipc::{Domain, IpcError, Node, Subscriber, clock, sequence};
use zenoh::Wait;
use zenoh::key_expr::KeyExpr;
use zenoh::query::Query;

use crate::config::Config;
use crate::delay::clock_id;
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::link::Link;
use crate::stop::Stop;
use crate::told::{self, Teller, Told};

const TICK: Duration = Duration::from_millis(100);
/// How often the robot reports that it is there and how silent its daemon is.
const STATUS: Duration = Duration::from_secs(1);
/// How often the daemon is asked for its counters, and its timeout.
const ASK_AGAIN: Duration = Duration::from_secs(10);
const PATIENCE: Duration = Duration::from_millis(200);
/// If only decisions for other robots come for this long, a name is wrong: planners that start together decide within seconds.
const OTHERS_ALONE_NS: u64 = 30_000_000_000;
/// A daemon that is silent for this long is not asked.
const SILENCE_NS: u64 = 2_000_000_000;

/// The last value of each topic, for later subscribers.
#[derive(Debug, Default)]
pub struct Last {
    told: Mutex<BTreeMap<String, Told>>,
    start: u64,
    number: AtomicU64,
    clock: u64,
    started_ns: u64,
}

impl Last {
    /// Creates an empty store.
    #[must_use]
    pub fn new() -> Arc<Self> {
        let (start, clock, started_ns) = (sequence::random_epoch(), clock_id(), clock::monotonic_ns());
        Arc::new(Self { start, clock, started_ns, ..Self::default() })
    }

    /// The random number of this start, which is in every message.
    #[must_use]
    pub fn start(&self) -> u64 {
        self.start
    }

    /// When this bridge started, by the monotonic clock.
    #[must_use]
    pub fn started_ns(&self) -> u64 {
        self.started_ns
    }

    fn told(&self) -> MutexGuard<'_, BTreeMap<String, Told>> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn teller(&self) -> Teller {
        let number = self.number.fetch_add(1, Ordering::Relaxed) + 1;
        Teller { start: self.start(), number, clock: self.clock, started_ns: self.started_ns }
    }

    /// Stores a topic's value for later queries; returns its bytes with its age of now.
    pub fn keep(&self, key: &str, told: Told) -> Vec<u8> {
        let bytes = told.bytes(self.teller());
        self.told().insert(key.to_owned(), told);
        bytes
    }

    /// The stored value's bytes with its age of now.
    #[must_use]
    pub fn again(&self, key: &str) -> Option<Vec<u8>> {
        self.told().get(key).map(|told| told.bytes(self.teller()))
    }

    /// Answers a query with all matching values, each with its age of now.
    pub fn answer(&self, query: &Query) {
        for (key, told) in self.told().iter() {
            if let Ok(key) = KeyExpr::try_from(key.clone())
                && query.key_expr().intersects(&key)
            {
                // The asker may have left.
                let _answered = query.reply(key, told.bytes(self.teller())).wait();
            }
        }
    }
}

/// A service whose newest message is published.
struct Topic<M: Message> {
    port: Subscriber<M>,
    key: String,
    message: Box<M>,
    /// Epoch, sequence and time of the last message, and when it was last published.
    said: Option<((u64, u64, u64), Instant)>,
}

impl<M: Message> Topic<M> {
    fn new(port: Subscriber<M>, key: String) -> Self {
        Self { port, key, message: Box::default(), said: None }
    }

    /// Receives all waiting messages; returns whether `message` is now a new valid one that `wanted` accepts.
    fn take(&mut self, log: &mut Limiter, mut wanted: impl FnMut(&M) -> bool) -> Result<bool, IpcError> {
        let mut found = None;
        while let Some((checked, _)) = self.port.receive_from(&mut self.message)? {
            match checked {
                Ok(()) if wanted(&self.message) => found = Some(*self.message),
                Ok(()) => {}
                Err(error) => {
                    if let Some(not_told) = log.pass(M::SERVICE.name, clock::monotonic_ns()) {
                        tracing::warn!(%error, not_told, service = M::SERVICE.name, "malformed message");
                    }
                }
            }
        }
        if let Some(found) = found {
            *self.message = found;
        }
        Ok(found.is_some())
    }
}

/// Detects that the planner decides only for robots with other names.
#[derive(Debug, Default)]
struct OtherPlanners {
    /// Since when planners of this domain decide for other robots.
    since_ns: Option<u64>,
    /// A planner decides for this robot, or the warning was logged.
    is_settled: bool,
}

impl OtherPlanners {
    fn hear(&mut self, is_own: bool, now_ns: u64) {
        self.is_settled |= is_own;
        self.since_ns.get_or_insert(now_ns);
    }

    fn warn(&mut self, robot: &str) {
        if self.are_alone(clock::monotonic_ns()) {
            tracing::warn!(
                robot,
                "a planner decides for a robot of another name, and none for this one: give both one name (robot.name, planner.robot)"
            );
        }
    }

    /// Whether to log the warning now, which happens once.
    fn are_alone(&mut self, now_ns: u64) -> bool {
        let says =
            !self.is_settled && self.since_ns.is_some_and(|since| now_ns.saturating_sub(since) >= OTHERS_ALONE_NS);
        self.is_settled |= says;
        says
    }
}

struct Outlet<'a> {
    link: Option<&'a Link>,
    last: &'a Last,
    repeat: Duration,
    connections: u64,
    /// There is a new connection: everything is published again, because messages without a connection were lost.
    again: bool,
}

impl Outlet<'_> {
    /// Stores a topic's newest message for queries, and publishes it if it follows from new scores or decisions. Repetitions by the service are not
    /// published.
    fn tell<M: Message>(&self, topic: &mut Topic<M>, name: (u64, u64, u64), told: impl FnOnce(&M) -> Told) {
        let before = topic.said.map(|(said, _)| said);
        if before == Some(name) {
            return;
        }
        let told = told(&topic.message);
        if before.is_some_and(|(epoch, sequence, _)| (epoch, sequence) == (name.0, name.1)) {
            self.last.told().insert(topic.key.clone(), told);
            topic.said = topic.said.map(|(_, at)| (name, at));
        } else {
            topic.said = Some((name, Instant::now()));
            self.say(&topic.key, told);
        }
    }

    fn look(&mut self) {
        let connections = self.link.map_or(0, Link::connections);
        self.again = connections != self.connections;
        self.connections = connections;
    }

    /// Publishes values again that have not changed for long, even without a heartbeat of the service.
    fn repeat<M: Message>(&self, topic: &mut Topic<M>) {
        let Some((_, at)) = &mut topic.said else { return };
        if self.again || at.elapsed() >= self.repeat {
            *at = Instant::now();
            if let Some(bytes) = self.last.again(&topic.key) {
                self.put(&topic.key, bytes);
            }
        }
    }

    fn say(&self, key: &str, told: Told) {
        self.put(key, self.last.keep(key, told));
    }

    fn put(&self, key: &str, bytes: Vec<u8>) {
        if let Some(link) = self.link {
            link.put(key, bytes);
        }
    }
}

/// Publishes until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Config,
    domain: &Domain,
    (link, last): (Option<&Link>, &Last),
    stop: &Stop,
    alive: &dyn Fn(),
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh")?;
    let keys = Keys::new(&config.site.name, config.robot.key());
    let tell = &config.tell;
    // Scores are always followed: they show that the daemon lives.
    let mut scores = Topic::<RoomScoresV1>::new(node.subscriber()?, keys.told("scores"));
    let mut forecast = topic::<ForecastV1>(&node, tell.forecast, keys.told("forecast"))?;
    let mut persons = topic::<PersonForecastsV1>(&node, tell.persons, keys.told("persons"))?;
    let mut decision = topic::<DecisionV1>(&node, tell.decision, keys.told("decision"))?;
    let counters = node.status_client()?;
    let robot = sequence::source_of_name(&config.robot.name);
    let repeat = Duration::from_secs_f64(tell.repeat_s);
    let mut outlet = Outlet { link, last, repeat, connections: 0, again: false };
    let (mut log, mut published_ns, mut others) = (Limiter::default(), None::<u64>, OtherPlanners::default());
    let (mut asked, mut said, mut status) = (None::<Instant>, None::<Instant>, None::<StatusResponseV1>);
    while !stop.requested() {
        match &decision {
            // A decision follows its scores after a while and must not wait for the next scores.
            Some(decision) => roomcast_ipc::wait_for_any(&[&scores.port, &decision.port], TICK)?,
            None => scores.port.wait(TICK)?,
        };
        if let Some(topic) = &mut decision
            && topic.take(&mut log, |decision| {
                let (is_own, is_here) = (decision.robot == robot, !decision.has(decision_flags::ELSEWHERE));
                if is_here {
                    others.hear(is_own, clock::monotonic_ns());
                }
                is_own && is_here
            })?
        {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.decided_ns);
            outlet.tell(topic, name, told::decision);
        }
        others.warn(&config.robot.name);
        if scores.take(&mut log, |_| true)? {
            published_ns = Some(scores.message.published_ns);
            if tell.scores {
                let name = (scores.message.epoch, scores.message.sequence, scores.message.computed_ns);
                outlet.tell(&mut scores, name, told::scores);
            }
        }
        if let Some(topic) = &mut forecast
            && topic.take(&mut log, |_| true)?
        {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.computed_ns);
            outlet.tell(topic, name, told::forecast);
        }
        if let Some(topic) = &mut persons
            && topic.take(&mut log, |_| true)?
        {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.computed_ns);
            outlet.tell(topic, name, told::persons);
        }
        outlet.look();
        outlet.repeat(&mut scores);
        forecast.iter_mut().for_each(|topic| outlet.repeat(topic));
        persons.iter_mut().for_each(|topic| outlet.repeat(topic));
        decision.iter_mut().for_each(|topic| outlet.repeat(topic));
        let silence_ns = published_ns.map(|published_ns| clock::monotonic_ns().saturating_sub(published_ns));
        let lives = silence_ns.is_some_and(|silence_ns| silence_ns <= SILENCE_NS);
        if lives && asked.is_none_or(|asked| asked.elapsed() >= ASK_AGAIN) {
            asked = Some(Instant::now());
            status = counters.ask(PATIENCE).ok().or(status);
        }
        if said.is_none_or(|said| said.elapsed() >= STATUS) {
            said = Some(Instant::now());
            outlet.say(&keys.told("status"), told::status(&config.robot.name, silence_ns, status.as_ref()));
            alive();
        }
    }
    Ok(())
}

fn topic<M: Message>(node: &Node, wanted: bool, key: String) -> Result<Option<Topic<M>>, IpcError> {
    let port = wanted.then(|| node.subscriber()).transpose()?;
    Ok(port.map(|port| Topic::new(port, key)))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use roomcast_ipc::raw::action;
    use roomcast_ipc::text;
    use zenoh::Session;

    use super::*;
    use crate::eventually::eventually;

    const S: u64 = 1_000_000_000;

    #[test]
    fn a_planner_that_decides_for_another_robot_alone_is_told_of_once() {
        let told = |heard: &[(bool, u64)]| {
            let mut others = OtherPlanners::default();
            let said = (0..1000).filter(|second| {
                let now = heard.iter().filter(|(_, at)| at == second);
                now.for_each(|(is_own, _)| others.hear(*is_own, second * S));
                others.are_alone(second * S)
            });
            said.collect::<Vec<u64>>()
        };
        assert_eq!(told(&[(false, 5), (false, 605)]), [35], "ten decisions took hours");
        assert!(told(&[(false, 5), (true, 9), (false, 605)]).is_empty(), "two planners of one domain");
        assert!(told(&[]).is_empty(), "no planner runs");
    }

    fn router(port: u16) -> Session {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", "\"router\"".to_owned()),
            ("listen/endpoints", format!("[\"tcp/127.0.0.1:{port}\"]")),
            ("scouting/multicast/enabled", "false".to_owned()),
            ("scouting/gossip/enabled", "false".to_owned()),
        ] {
            config.insert_json5(key, &value).unwrap();
        }
        zenoh::open(config).wait().unwrap()
    }

    /// Regression: a decision made while the connection was cut was published only at the next repetition, up to an hour later. Until then the others
    /// used the previous room.
    #[test]
    fn what_is_decided_while_the_connection_is_cut_is_told_when_it_is_back() {
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("cut-{}", std::process::id())).unwrap();
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let mut config = Config::default();
        config.router.connect = format!("tcp/127.0.0.1:{port}");
        config.tell.repeat_s = 3600.0;
        let key = Keys::new(&config.site.name, config.robot.key()).told("decision");
        let (stop, last) = (Stop::default(), Last::new());
        let heard = |router: &Session| {
            let (to, heard) = channel();
            let take = move |sample: zenoh::sample::Sample| {
                let message: serde_json::Value = serde_json::from_slice(&sample.payload().to_bytes()).unwrap();
                let _heard = to.send(message["to"].as_str().unwrap().to_owned());
            };
            router.declare_subscriber(&key).callback(take).background().wait().unwrap();
            heard
        };
        let first = router(port);
        let at_first = heard(&first);
        let link = Link::start(&config.router, Box::new(|_| Ok(Vec::new()))).unwrap();
        std::thread::scope(|scope| {
            let (link, config, domain, last, stop) = (&link, &config, &domain, &*last, &stop);
            let _ends = stop.at_end();
            scope.spawn(move || run(config, domain, (Some(link), last), stop, &|| ()).unwrap());
            let node = domain.open("planner").unwrap();
            let planner = node.publisher().unwrap();
            let decide = |sequence: u64, room: &str| {
                let robot = sequence::source_of_name(&config.robot.name);
                let (decided_ns, to) = (clock::monotonic_ns(), text::encode("to", room).unwrap());
                let decision =
                    DecisionV1 { robot, epoch: 7, sequence, decided_ns, action: action::GO, to, ..Default::default() };
                planner.send(&decision).unwrap();
                // A tick sends the service's history to new subscribers.
                planner.tick().unwrap();
            };
            let next = |heard: &std::sync::mpsc::Receiver<String>| loop {
                planner.tick().unwrap();
                if let Ok(room) = heard.recv_timeout(Duration::from_millis(50)) {
                    break room;
                }
            };
            decide(1, "kitchen");
            assert_eq!(next(&at_first), "kitchen");
            first.close().wait().unwrap();
            eventually("the link notices", || (!link.is_connected()).then_some(()));
            decide(2, "bathroom");
            let said = || String::from_utf8(last.again(&key)?).ok().filter(|said| said.contains("bathroom"));
            eventually("the decision is the last one", said);
            let second = router(port);
            assert_eq!(next(&heard(&second)), "bathroom");
        });
        domain.clean_up().unwrap();
    }
}
