//! From the robot's services to whoever listens elsewhere, and to whoever asks later.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use roomcast_ipc::{
    DecisionV1, Domain, ForecastV1, IpcError, Message, Node, PersonForecastsV1, RoomScoresV1, StatusResponseV1,
    Subscriber, clock, sequence,
};
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
/// How often everybody hears that this robot is there and how silent its daemon is.
const STATUS: Duration = Duration::from_secs(1);
/// How often the daemon is asked for its counters, and how long it has to answer.
const ASK_AGAIN: Duration = Duration::from_secs(10);
const PATIENCE: Duration = Duration::from_millis(200);
/// So many decisions of others and none of this robot's are a mistake in a name. Planners of one domain decide in turn.
const STRANGERS: u32 = 10;
/// A daemon that was silent for so long is not asked.
const SILENCE_NS: u64 = 2_000_000_000;

/// The last value of each topic: for who joins later.
#[derive(Debug, Default)]
pub struct Last {
    told: Mutex<BTreeMap<String, Told>>,
    start: u64,
    number: AtomicU64,
    clock: u64,
}

impl Last {
    /// Nothing told yet.
    #[must_use]
    pub fn new() -> Arc<Self> {
        Arc::new(Self { start: sequence::random_epoch(), clock: clock_id(), ..Self::default() })
    }

    /// The random number of this start, which every message has.
    #[must_use]
    pub fn start(&self) -> u64 {
        self.start
    }

    fn told(&self) -> MutexGuard<'_, BTreeMap<String, Told>> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn teller(&self) -> Teller {
        let number = self.number.fetch_add(1, Ordering::Relaxed) + 1;
        Teller { start: self.start(), number, clock: self.clock }
    }

    /// Keeps a topic's value for who asks later; gives its bytes of now.
    pub fn keep(&self, key: &str, told: Told) -> Vec<u8> {
        let bytes = told.bytes(self.teller());
        self.told().insert(key.to_owned(), told);
        bytes
    }

    /// The bytes of now of a value that is kept.
    #[must_use]
    pub fn again(&self, key: &str) -> Option<Vec<u8>> {
        self.told().get(key).map(|told| told.bytes(self.teller()))
    }

    /// Answers a query with all values that it asks for, each with its age of now.
    pub fn answer(&self, query: &Query) {
        for (key, told) in self.told().iter() {
            if let Ok(key) = KeyExpr::try_from(key.clone())
                && query.key_expr().intersects(&key)
            {
                // Whoever asked may have left.
                let _answered = query.reply(key, told.bytes(self.teller())).wait();
            }
        }
    }
}

/// A service whose newest message is told.
struct Topic<M: Message> {
    port: Subscriber<M>,
    key: String,
    message: Box<M>,
    /// Epoch, sequence and time of what was taken last, and when something was told.
    said: Option<((u64, u64, u64), Instant)>,
}

impl<M: Message> Topic<M> {
    fn new(port: Subscriber<M>, key: String) -> Self {
        Self { port, key, message: Box::default(), said: None }
    }

    /// Takes all that waits; whether `message` is now another good one that `wanted` accepts.
    fn take(&mut self, log: &mut Limiter, wanted: impl Fn(&M) -> bool) -> Result<bool, IpcError> {
        let mut found = None;
        while let Some(checked) = self.port.receive_into(&mut self.message)? {
            match checked {
                Ok(()) if wanted(&self.message) => found = Some(*self.message),
                Ok(()) => {}
                Err(error) => {
                    if let Some(not_told) = log.pass(clock::monotonic_ns()) {
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

/// What is told where.
struct Mouth<'a> {
    link: Option<&'a Link>,
    last: &'a Last,
    repeat: Duration,
}

impl Mouth<'_> {
    /// Takes a topic's newest message: whoever asks gets it from now on. It is told where it follows from new scores or decisions; what the
    /// service only says again is not.
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

    /// Tells again what has not changed for long: a heartbeat of the service is not needed for that.
    fn repeat<M: Message>(&self, topic: &mut Topic<M>) {
        let Some((_, at)) = &mut topic.said else { return };
        if at.elapsed() >= self.repeat {
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

/// Runs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Config,
    domain: &Domain,
    link: Option<&Link>,
    last: &Last,
    stop: &Stop,
    alive: &dyn Fn(),
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh")?;
    let keys = Keys::new(&config.site.name, config.robot.key());
    let tell = &config.tell;
    // Scores are followed in any case: they say that the daemon lives.
    let mut scores = Topic::<RoomScoresV1>::new(node.subscriber()?, keys.told("scores"));
    let mut forecast = topic::<ForecastV1>(&node, tell.forecast, keys.told("forecast"))?;
    let mut persons = topic::<PersonForecastsV1>(&node, tell.persons, keys.told("persons"))?;
    let mut decision = topic::<DecisionV1>(&node, tell.decision, keys.told("decision"))?;
    let counters = node.status_client()?;
    let robot = sequence::source_of_name(&config.robot.name);
    let mouth = Mouth { link, last, repeat: Duration::from_secs_f64(tell.repeat_s) };
    let (mut log, mut published_ns) = (Limiter::default(), None::<u64>);
    // Decisions of other robots, until one of this robot's has come. They are expected where the bridge follows others.
    let strangers = Cell::new(if config.peers.hear { STRANGERS } else { 0 });
    let (mut asked, mut said, mut status) = (None::<Instant>, None::<Instant>, None::<StatusResponseV1>);
    while !stop.requested() {
        match &decision {
            // A decision follows its scores by itself, and is not to wait for the next ones.
            Some(decision) => roomcast_ipc::wait_for_any(&[&scores.port, &decision.port], TICK)?,
            None => scores.port.wait(TICK)?,
        };
        if let Some(topic) = &mut decision && topic.take(&mut log, |decision| {
            let is_own = decision.robot == robot;
            let count = if is_own { STRANGERS } else { strangers.get().saturating_add(1) };
            if !is_own && count == STRANGERS {
                tracing::warn!(
                    robot = config.robot.name,
                    "the planner decides for a robot of another name: give both one name (robot.name, planner.robot)"
                );
            }
            strangers.set(count.max(strangers.get()));
            is_own
        })? {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.decided_ns);
            mouth.tell(topic, name, told::decision);
        }
        if scores.take(&mut log, |_| true)? {
            published_ns = Some(scores.message.published_ns);
            if tell.scores {
                let name = (scores.message.epoch, scores.message.sequence, scores.message.computed_ns);
                mouth.tell(&mut scores, name, told::scores);
            }
        }
        if let Some(topic) = &mut forecast
            && topic.take(&mut log, |_| true)?
        {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.computed_ns);
            mouth.tell(topic, name, told::forecast);
        }
        if let Some(topic) = &mut persons
            && topic.take(&mut log, |_| true)?
        {
            let name = (topic.message.epoch, topic.message.sequence, topic.message.computed_ns);
            mouth.tell(topic, name, told::persons);
        }
        mouth.repeat(&mut scores);
        forecast.iter_mut().for_each(|topic| mouth.repeat(topic));
        persons.iter_mut().for_each(|topic| mouth.repeat(topic));
        decision.iter_mut().for_each(|topic| mouth.repeat(topic));
        let silence_ns = published_ns.map(|published_ns| clock::monotonic_ns().saturating_sub(published_ns));
        let lives = silence_ns.is_some_and(|silence_ns| silence_ns <= SILENCE_NS);
        if lives && asked.is_none_or(|asked| asked.elapsed() >= ASK_AGAIN) {
            asked = Some(Instant::now());
            status = counters.ask(PATIENCE).ok().or(status);
        }
        if said.is_none_or(|said| said.elapsed() >= STATUS) {
            said = Some(Instant::now());
            mouth.say(&keys.told("status"), told::status(&config.robot.name, silence_ns, status.as_ref()));
            alive();
        }
    }
    Ok(())
}

/// A topic, where it is told of.
fn topic<M: Message>(node: &Node, wanted: bool, key: String) -> Result<Option<Topic<M>>, IpcError> {
    let port = wanted.then(|| node.subscriber()).transpose()?;
    Ok(port.map(|port| Topic::new(port, key)))
}
