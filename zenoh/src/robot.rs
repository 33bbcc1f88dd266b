//! The bridge of a robot: its threads, and its declarations at a router.

use std::any::Any;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use roomcast_ipc::{IpcError, clock};
use sd_notify::NotifyState;
use zenoh::query::Query;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::config::{Config, ConfigError};
use crate::keys::Keys;
use crate::link::{Declare, Link, LinkError};
use crate::namesake::{self, Namesake, Order, Other};
use crate::outward::{self, Last};
use crate::ros2::run::{Places, Ros2Error};
use crate::stop::Stop;
use crate::{ask, habits, inward, peers, ros2, understood};

const NAMESAKE: &str = "another bridge uses this robot's name; this one was first, and the other one ends: give each robot of the site a name of \
    its own (robot.key, else robot.name)";
/// Time for other bridges of this robot's name to answer. A bridge that was just killed does not answer.
const PATIENCE: Duration = Duration::from_secs(1);

/// Why a bridge ends.
#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The connection to the router.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// A service of the robot.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// ROS 2.
    #[error(transparent)]
    Ros2(#[from] Ros2Error),
    /// Another bridge with this name was first.
    #[error(
        "another bridge uses the robot's name {0:?} at this site, and was first: give each robot of the site a name of its own (robot.key, else robot.name), or end the other one"
    )]
    Namesake(String),
    /// A thread.
    #[error("the program has a fault: its thread {0} has ended by a panic, which the log has")]
    Panic(String),
    /// The system refuses a thread.
    #[error("cannot start a thread: {0}; {limit}", limit = roomcast_ipc::limits::on_threads())]
    Thread(std::io::Error),
}

impl BridgeError {
    /// Whether the configuration or a file in it is at fault. A restart does not help then.
    #[must_use]
    pub fn is_of_configuration(&self) -> bool {
        match self {
            Self::Config(_) | Self::Namesake(_) => true,
            Self::Ros2(error) => !matches!(error, Ros2Error::Ipc(_)),
            Self::Link(error) => matches!(error, LinkError::Config(_)),
            Self::Ipc(_) | Self::Panic(_) | Self::Thread(_) => false,
        }
    }
}

/// Starts a part of this program. If one part ends, all end.
fn start<'scope>(
    scope: &'scope thread::Scope<'scope, '_>,
    stop: &'scope Stop,
    name: &str,
    run: impl FnOnce() -> Result<(), IpcError> + Send + 'scope,
) -> Result<thread::ScopedJoinHandle<'scope, Result<(), IpcError>>, BridgeError> {
    let part = move || {
        let _ends = stop.at_end();
        run()
    };
    thread::Builder::new().name(name.to_owned()).spawn_scoped(scope, part).map_err(|error| {
        // Threads that run already must end, too.
        stop.request();
        BridgeError::Thread(error)
    })
}

/// Runs until asked to stop.
///
/// # Errors
///
/// [`BridgeError`]. A router that is away is no error.
pub fn run(config: &Config, stop: &Stop) -> Result<(), BridgeError> {
    config.check_robot()?;
    let domain = config.domain()?;
    let last = Last::new();
    let (inlet, heard) = inward::inlet();
    let (asking, asked) = sync_channel(ask::WAITING_MAX);
    let (wanting, wanted) = understood::queue();
    // A hub's number is its place in the list; ROS 2 comes behind the hubs.
    let ros2_inlet = config.ros2.narration.then(|| (config.narrator.len(), inlet.clone()));
    let (peer_inlet, peers_heard) = peers::inlet();
    let site = !config.router.connect.is_empty();
    let second = Second { found: Arc::default(), stop: stop.clone() };
    let declare = || declare(config, &last, inlet, asking, peer_inlet.clone(), second.clone());
    let link = site.then(|| Link::start(&config.router, declare())).transpose()?;
    let ros2 = match config.ros2.router() {
        Some(router) => Some((Places::load(&config.ros2)?, Link::start(&router, Box::new(|_| Ok(Vec::new())))?)),
        None => None,
    };
    let (link, ros2, stopper, last_told) = (link.as_ref(), ros2.as_ref(), stop, &last);
    let peer_inlet = &peer_inlet;
    let ended = thread::scope(|scope| {
        let domain = &domain;
        let inward =
            start(scope, stopper, "inward", move || inward::run(config, domain, link, &heard, &wanting, stopper))?;
        let mut threads = Vec::new();
        if !ask::allowed(&config.ask).is_empty() {
            threads.push(start(scope, stopper, "ask", move || ask::run(config, domain, &asked, stopper))?);
        }
        if config.peers.hear {
            let listen = move || peers::run(config, domain, link, (peer_inlet, &peers_heard), stopper);
            threads.push(start(scope, stopper, "peers", listen)?);
        }
        if let Some(link) = link.filter(|_| config.habits.share) {
            let share = move || habits::run(config, domain, link, last_told, stopper);
            threads.push(start(scope, stopper, "habits", share)?);
        }
        let tells_understood = config.narrator.iter().any(|narrator| narrator.understood);
        if let Some(link) = link.filter(|_| tells_understood) {
            let keys = Keys::new(&config.site.name, config.robot.key());
            threads.push(start(scope, stopper, "understood", move || {
                understood::run(&keys, domain, link, &wanted, stopper)
            })?);
        }
        if let Some((places, link)) = ros2 {
            let speak = move || ros2::run::run(&config.ros2, places, domain, link, ros2_inlet, stopper);
            threads.push(start(scope, stopper, "ros2", speak)?);
        }
        notify(&[NotifyState::Ready]);
        // The watchdog is fed only while narration is forwarded.
        let alive = || {
            if !inward.is_finished() {
                notify(&[NotifyState::Watchdog]);
            }
        };
        let outward = {
            let _ends = stopper.at_end();
            outward::run(config, domain, (link, &last), stopper, &alive).map_err(BridgeError::Ipc)
        };
        notify(&[NotifyState::Stopping]);
        let ends: Vec<_> = std::iter::once(inward).chain(threads).map(ended).collect();
        outward.and(ends.into_iter().collect())
    });
    if second.found.load(Ordering::Relaxed) {
        return Err(BridgeError::Namesake(config.robot.key().to_owned()));
    }
    ended
}

/// Ends this bridge if another one with its name was first.
#[derive(Debug, Clone)]
struct Second {
    found: Arc<AtomicBool>,
    stop: Stop,
}

impl Second {
    fn end(&self) {
        self.found.store(true, Ordering::Relaxed);
        self.stop.request();
    }
}

fn ended(thread: thread::ScopedJoinHandle<'_, Result<(), IpcError>>) -> Result<(), BridgeError> {
    let name = thread.thread().name().unwrap_or_default().to_owned();
    thread.join().map_err(|_| BridgeError::Panic(name))?.map_err(BridgeError::Ipc)
}

/// Notifies systemd, if it runs this program.
pub(crate) fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "systemd cannot be notified");
    }
}

fn declare(
    config: &Config,
    last: &Arc<Last>,
    inlet: inward::Inlet,
    asking: SyncSender<ask::Asked>,
    peer_inlet: peers::Inlet,
    second: Second,
) -> Declare {
    let (config, last) = (config.clone(), Arc::clone(last));
    Box::new(move |session: &Session| {
        let keys = Keys::new(&config.site.name, config.robot.key());
        let mut declared: Vec<Box<dyn Any + Send>> = Vec::new();
        // This check comes before any line reaches the bridge.
        let namesake = Namesake::new(last.start(), last.started_ns());
        let ask = || -> zenoh::Result<Vec<Other>> {
            let replies = session.get(keys.told("status")).timeout(PATIENCE).wait()?;
            Ok(replies.into_iter().filter_map(|reply| reply.result().ok().and_then(namesake::teller)).collect())
        };
        let before = ask()?;
        let others = if before.is_empty() { Vec::new() } else { ask()? };
        let runs = |other: &&Other| before.iter().any(|before| other.speaks_after(before));
        let judge = |other: &Other| namesake.judge(*other, clock::monotonic_ns());
        if others.iter().filter(runs).any(|other| judge(other) == Some(Order::Second)) {
            second.end();
            return Ok(declared);
        }
        for (number, narrator) in config.narrator.iter().enumerate() {
            let inlet = inlet.clone();
            let take = move |sample: Sample| inlet.take(number, sample.payload());
            declared.push(Box::new(session.declare_subscriber(keys.narration(&narrator.name)).callback(take).wait()?));
        }
        let own = Arc::clone(&last);
        let answer = move |query: Query| own.answer(&query);
        declared.push(Box::new(session.declare_queryable(keys.all_told()).callback(answer).wait()?));
        let (namesake, second) = (Mutex::new(namesake), second.clone());
        let robot = config.robot.key().to_owned();
        let listen = move |sample: Sample| {
            let mut namesake = namesake.lock().unwrap_or_else(PoisonError::into_inner);
            match namesake::teller(&sample).and_then(|other| namesake.hear(other, clock::monotonic_ns())) {
                Some(Order::First) => tracing::error!(robot, "{NAMESAKE}"),
                Some(Order::Second) => second.end(),
                None => {}
            }
        };
        declared.push(Box::new(session.declare_subscriber(keys.told("status")).callback(listen).wait()?));
        for (name, service) in ask::allowed(&config.ask) {
            let asking = asking.clone();
            let take = move |query: Query| ask::take(&asking, service, query);
            declared.push(Box::new(session.declare_queryable(keys.ask(name)).callback(take).wait()?));
        }
        if config.peers.hear {
            for topic in peers::TOPICS {
                let (key, inlet) = (Keys::new(&config.site.name, "*").told(topic), peer_inlet.clone());
                let take = move |sample: Sample| inlet.take(&sample);
                declared.push(Box::new(session.declare_subscriber(&key).callback(take).wait()?));
            }
        }
        // The token is last: a peer that sees it may ask at once.
        declared.push(Box::new(session.liveliness().declare_token(keys.alive()).wait()?));
        Ok(declared)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thread_that_panics_stops_the_others_and_is_an_error() {
        let stop = Stop::default();
        thread::scope(|scope| {
            let own = &stop;
            let other = move || {
                while !own.requested() {
                    thread::yield_now();
                }
                Ok(())
            };
            let other = scope.spawn(other);
            let panics = move || -> Result<(), IpcError> {
                let _ends = own.at_end();
                panic!("a fault");
            };
            let panics = thread::Builder::new().name("ask".to_owned()).spawn_scoped(scope, panics).unwrap();
            ended(other).unwrap();
            assert!(ended(panics).unwrap_err().to_string().contains("its thread ask has ended by a panic"));
        });
    }
}
