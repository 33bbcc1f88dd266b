//! What other robots of the site are told, as decisions in this robot's own domain: its planner, with `planner.avoid_robots`, enters no room of theirs.
//! A robot that is not heard any more has no room: each goes on for itself.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use roomcast_ipc::{DecisionV1, Domain, IpcError, Message, NAME_BYTES, action, clock, sequence, text};
use serde::Deserialize;
use zenoh::query::Reply;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use crate::config::Config;
use crate::delay::Delay;
use crate::keys::Keys;
use crate::limiter::Limiter;
use crate::link::Link;
use crate::stop::Stop;
use crate::wire::{self, Fault, Hex};

/// Robots that are followed; more are not heard.
pub const PEERS_MAX: usize = 15;
/// A robot that was silent for so long has left its room: it says something every second.
const LEASE_NS: u64 = 3_500_000_000;
/// Messages that wait; more are dropped, and follow within seconds.
const WAITING_MAX: usize = 64;
const TICK: Duration = Duration::from_millis(100);

/// The topics of a robot that are heard.
pub const TOPICS: [&str; 2] = ["decision", "status"];

/// A message of a robot: its name in keys, what it is of, and its bytes.
pub struct Heard {
    robot: String,
    topic: String,
    bytes: Vec<u8>,
    /// When it was received, by this machine's monotonic clock and by its wall clock.
    now_ns: u64,
    now_unix_ns: u64,
}

/// Where a subscriber puts what it hears.
#[derive(Clone)]
pub struct Ear(SyncSender<Heard>);

/// Both ends of what waits to be looked at.
#[must_use]
pub fn ear() -> (Ear, Receiver<Heard>) {
    let (to, heard) = sync_channel(WAITING_MAX);
    (Ear(to), heard)
}

impl Ear {
    /// Takes a message of `roomcast/SITE/ROBOT/told/TOPIC`.
    pub fn take(&self, sample: &Sample) {
        let parts: Vec<&str> = sample.key_expr().as_str().split('/').collect();
        if let [_, _, robot, _, topic] = parts[..]
            && sample.payload().len() <= wire::BYTES_MAX
        {
            let bytes = sample.payload().to_bytes().into_owned();
            let (robot, topic) = (robot.to_owned(), topic.to_owned());
            let (now_ns, now_unix_ns) = (clock::monotonic_ns(), clock::unix_ns());
            let _dropped = self.0.try_send(Heard { robot, topic, bytes, now_ns, now_unix_ns });
        }
    }

    /// Asks for what was said before. Where that fails the session is at its end, and the next one is asked.
    fn ask(&self, session: &Session, site: &str) {
        for topic in TOPICS {
            let ear = self.clone();
            let earlier = move |reply: Reply| reply.into_result().into_iter().for_each(|sample| ear.take(&sample));
            let _asked = session.get(Keys::new(site, "*").told(topic)).callback(earlier).wait();
        }
    }
}

/// The numbers of the robots whose decisions are in this domain because they were heard here.
#[derive(Debug, Default)]
pub struct Followed(Mutex<BTreeSet<u64>>);

impl Followed {
    /// Whether a robot is one of them.
    #[must_use]
    pub fn has(&self, robot: u64) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).contains(&robot)
    }

    fn are(&self, robots: BTreeSet<u64>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = robots;
    }
}

/// What both messages have.
#[derive(Deserialize)]
struct Stamp {
    clock: Hex,
    sent_ns: u64,
    age_ns: u64,
}

#[derive(Deserialize)]
struct Decision {
    epoch: Hex,
    sequence: u64,
    action: String,
    from: String,
    to: String,
    policy: String,
    reason: String,
    probability: f64,
    stay_ns: u64,
    flags: u32,
}

struct Peer {
    delay: Delay,
    heard_ns: u64,
    last: Option<DecisionV1>,
    /// Its room was given up for it.
    silent: bool,
}

/// The other robots, as far as they are heard. Pure: time comes in as a number.
pub struct Peers {
    own: String,
    peers: BTreeMap<String, Peer>,
}

impl Peers {
    /// None heard yet; `own` is this robot's name in keys.
    #[must_use]
    pub fn new(own: &str) -> Self {
        Self { own: own.to_owned(), peers: BTreeMap::new() }
    }

    /// Takes a message; gives what the planner is to hear of it.
    ///
    /// # Errors
    ///
    /// [`Fault`] for what is no message of a robot.
    pub fn hear(&mut self, heard: &Heard) -> Result<Option<DecisionV1>, Fault> {
        if heard.robot == self.own {
            return Ok(None);
        }
        let stamp: Stamp = wire::read(&heard.bytes)?;
        if self.peers.len() >= PEERS_MAX && !self.peers.contains_key(&heard.robot) {
            // One that has left gives its place.
            let Some(left) = self.peers.iter().find(|(_, peer)| peer.silent).map(|(robot, _)| robot.clone()) else {
                return Ok(None);
            };
            self.peers.remove(&left);
        }
        let decision = match heard.topic.as_str() {
            "decision" => Some(wire::read::<Decision>(&heard.bytes)?),
            _ => None,
        };
        let new = Peer { delay: Delay::default(), heard_ns: 0, last: None, silent: false };
        let peer = self.peers.entry(heard.robot.clone()).or_insert(new);
        // What is not known yet counts as nothing: a room may be taken for longer than it is.
        let excess_ns = peer.delay.excess_ns(stamp.clock.0, stamp.sent_ns, heard.now_ns).unwrap_or(0);
        if excess_ns >= LEASE_NS {
            // It lay in a queue for longer than it may be believed.
            return Ok(None);
        }
        if let (Some(own), Some(last)) = (&decision, peer.last)
            && own.epoch.0 == last.epoch
            && own.sequence.saturating_sub(last.sequence) > sequence::JUMP_MAX
        {
            return Err(Fault(format!("decision {} is too far ahead of {}", own.sequence, last.sequence)));
        }
        peer.heard_ns = peer.heard_ns.max(heard.now_ns);
        let back = std::mem::replace(&mut peer.silent, false);
        let Some(decision) = decision else { return Ok(peer.last.filter(|_| back)) };
        let age_ns = stamp.age_ns.saturating_add(excess_ns);
        let message = message(heard, &decision, age_ns)?;
        let old = |last: DecisionV1| last.epoch == message.epoch && last.sequence >= message.sequence;
        if peer.last.is_some_and(old) && !back {
            return Ok(None);
        }
        peer.last = Some(message);
        Ok(Some(message))
    }

    /// What the planner is to hear of robots that have fallen silent: they have no room any more.
    pub fn fallen_silent(&mut self, now_ns: u64) -> Vec<(String, Option<DecisionV1>)> {
        let silent = |peer: &Peer| !peer.silent && now_ns.saturating_sub(peer.heard_ns) > LEASE_NS;
        let fallen = self.peers.iter_mut().filter(|(_, peer)| silent(peer));
        let leave = fallen.map(|(robot, peer)| {
            peer.silent = true;
            let (nowhere, reason) = ([0; NAME_BYTES], text::encode_cut("it is not heard any more"));
            let gone = |last| DecisionV1 {
                action: action::PAUSE,
                from: nowhere,
                to: nowhere,
                policy: nowhere,
                probability: 0.0,
                stay_ns: 0,
                flags: 0,
                reason,
                ..last
            };
            (robot.clone(), peer.last.map(gone))
        });
        leave.collect()
    }

    /// What holds of all robots that are heard. The service keeps the last message alone, so who joins has to be told of the others.
    pub fn standing(&self) -> impl Iterator<Item = DecisionV1> {
        self.peers.values().filter(|peer| !peer.silent).filter_map(|peer| peer.last)
    }

    /// Their numbers.
    fn numbers(&self) -> BTreeSet<u64> {
        self.peers.keys().map(|robot| sequence::source_of_name(robot)).collect()
    }
}

fn message(heard: &Heard, decision: &Decision, age_ns: u64) -> Result<DecisionV1, Fault> {
    let fault = |error: roomcast_ipc::MessageError| Fault(error.to_string());
    let message = DecisionV1 {
        robot: sequence::source_of_name(&heard.robot),
        epoch: decision.epoch.0,
        sequence: decision.sequence,
        decided_ns: heard.now_ns.saturating_sub(age_ns),
        decided_unix_ns: heard.now_unix_ns.saturating_sub(age_ns),
        stay_ns: decision.stay_ns,
        action: action::of_word(&decision.action),
        flags: decision.flags,
        probability: decision.probability,
        minor: 2,
        robot_name: text::encode_cut(&heard.robot),
        from: text::encode("from", &decision.from).map_err(fault)?,
        to: text::encode("to", &decision.to).map_err(fault)?,
        policy: text::encode("policy", &decision.policy).map_err(fault)?,
        reason: text::encode_cut(&decision.reason),
        ..DecisionV1::default()
    };
    message.check().map_err(fault)?;
    Ok(message)
}

/// Runs until asked to stop. `ear` is the other end of `heard`, for what was said before.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Config,
    domain: &Domain,
    link: Option<&Link>,
    (ear, heard): (&Ear, &Receiver<Heard>),
    followed: &Followed,
    stop: &Stop,
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-peers")?;
    let decisions = node.publisher::<DecisionV1>()?;
    let mut peers = Peers::new(config.robot.key());
    let (mut log, mut connections) = (Limiter::default(), 0);
    while !stop.requested() {
        let first = heard.recv_timeout(TICK).ok();
        if let Some(link) = link.filter(|link| link.connections() != connections)
            && let Some((_, session)) = link.session()
        {
            connections = link.connections();
            ear.ask(&session, &config.site.name);
        }
        for heard in first.into_iter().chain(heard.try_iter()) {
            match peers.hear(&heard) {
                Ok(Some(decision)) => {
                    followed.are(peers.numbers());
                    decisions.send(&decision)?;
                }
                Ok(None) => {}
                Err(fault) => {
                    if let Some(not_told) = log.pass(heard.robot.clone(), clock::monotonic_ns()) {
                        tracing::warn!(robot = heard.robot, %fault, not_told, "no message of a robot");
                    }
                }
            }
        }
        for (robot, gone) in peers.fallen_silent(clock::monotonic_ns()) {
            tracing::warn!(robot, "another robot is not heard any more: its room is free for this one");
            if let Some(gone) = gone {
                decisions.send(&gone)?;
            }
        }
        // Whoever has heard them takes them for no news, and who comes as others go has not.
        if decisions.tick()? {
            peers.standing().try_for_each(|decision| decisions.send(&decision))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::told::{self, Teller};

    const S: u64 = 1_000_000_000;
    const NOW_UNIX_NS: u64 = 1_700_000_000 * S;

    fn heard(robot: &str, topic: &str, bytes: Vec<u8>, now_ns: u64) -> Heard {
        Heard { robot: robot.to_owned(), topic: topic.to_owned(), bytes, now_ns, now_unix_ns: NOW_UNIX_NS }
    }

    fn decided(sequence: u64, to: &str) -> DecisionV1 {
        DecisionV1 {
            epoch: 7,
            sequence,
            decided_ns: clock::monotonic_ns(),
            stay_ns: 60 * S,
            action: action::GO,
            flags: 65,
            probability: 0.25,
            from: text::encode("from", "hall").unwrap(),
            to: text::encode("to", to).unwrap(),
            policy: text::encode("policy", "coverage-aware").unwrap(),
            reason: text::encode_cut("nobody is there"),
            ..Default::default()
        }
    }

    fn told(sequence: u64, to: &str) -> Vec<u8> {
        told::decision(&decided(sequence, to)).bytes(Teller { start: 1, number: sequence, clock: 1 })
    }

    /// All that another robot's planner says of its decision is known here: a probability of 0 was said that nobody had told.
    #[test]
    fn a_decision_is_in_this_domain_what_it_was_in_its_own() {
        let own = decided(3, "kitchen");
        let heard = heard("robot-2", "decision", told(3, "kitchen"), clock::monotonic_ns());
        let decision = Peers::new("robot-1").hear(&heard).unwrap().unwrap();
        let (robot, robot_name) = (sequence::source_of_name("robot-2"), text::encode_cut("robot-2"));
        let DecisionV1 { decided_ns, decided_unix_ns, minor, .. } = decision;
        assert_eq!(decision, DecisionV1 { robot, robot_name, decided_ns, decided_unix_ns, minor, ..own });
    }

    /// The service keeps one message: a planner that joined knew the room of one robot, and went into another's.
    #[test]
    fn who_joins_hears_of_every_robot() {
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("peers-{}", std::process::id())).unwrap();
        let mut config = Config::default();
        "robot-1".clone_into(&mut config.robot.name);
        let (ear, heard_here) = ear();
        let (followed, stop) = (Followed::default(), Stop::default());
        let now_ns = clock::monotonic_ns();
        for (robot, room) in [("robot-2", "kitchen"), ("robot-3", "bathroom"), ("robot-4", "hall")] {
            ear.0.send(heard(robot, "decision", told(1, room), now_ns)).unwrap();
        }
        std::thread::scope(|scope| {
            let (ear, config, domain, followed, stop) = (&ear, &config, &domain, &followed, &stop);
            scope.spawn(move || run(config, domain, None, (ear, &heard_here), followed, stop).unwrap());
            let _ends = stop.at_end();
            let node = domain.open("planner").unwrap();
            // The second one comes after all was said.
            for _ in 0..2 {
                let planner = node.subscriber::<DecisionV1>().unwrap();
                let mut rooms = BTreeSet::new();
                while rooms.len() < 3 {
                    while let Some(decision) = planner.receive().unwrap() {
                        let decision = decision.unwrap();
                        assert!(followed.has(decision.robot));
                        rooms.insert(decision.to().to_owned());
                    }
                    // Robots that are there say so.
                    for robot in ["robot-2", "robot-3", "robot-4"] {
                        let status = told::status(robot, None, None).bytes(Teller { start: 1, number: 1, clock: 1 });
                        ear.0.send(heard(robot, "status", status, clock::monotonic_ns())).unwrap();
                    }
                    std::thread::sleep(Duration::from_millis(10));
                }
                assert!(rooms.iter().eq(["bathroom", "hall", "kitchen"]), "{rooms:?}");
            }
        });
        domain.clean_up().unwrap();
    }

    #[test]
    fn a_robots_decisions_are_heard_once_and_given_up_when_it_falls_silent() {
        let now_ns = clock::monotonic_ns();
        let mut peers = Peers::new("robot-1");
        assert_eq!(peers.hear(&heard("robot-1", "decision", told(1, "hall"), now_ns)).unwrap(), None);
        let first = peers.hear(&heard("robot-2", "decision", told(1, "kitchen"), now_ns)).unwrap().unwrap();
        assert_eq!(
            (first.robot, first.to(), first.action),
            (sequence::source_of_name("robot-2"), "kitchen", action::GO)
        );
        assert_eq!(first.robot_name(), "robot-2");
        assert_eq!(peers.hear(&heard("robot-2", "decision", told(1, "kitchen"), now_ns)).unwrap(), None);
        peers.hear(&heard("robot-2", "decision", told(u64::MAX, "hall"), now_ns)).err().unwrap();
        assert!(peers.fallen_silent(now_ns + S).is_empty());
        let gone = peers.fallen_silent(now_ns + 4 * S).remove(0).1.unwrap();
        assert_eq!((gone.action, gone.to(), gone.sequence), (action::PAUSE, "", 1));
        assert!(peers.fallen_silent(now_ns + 9 * S).is_empty(), "said once");
        // It comes back with what it was told last.
        let status = told::status("robot-2", None, None).bytes(Teller { start: 1, number: 3, clock: 1 });
        let back = peers.hear(&heard("robot-2", "status", status, now_ns + 1)).unwrap().unwrap();
        assert_eq!((back.to(), back.action), ("kitchen", action::GO));
    }

    /// Who joins asks for what was told before: both clocks date it by its age.
    #[test]
    fn a_decision_of_before_is_dated_by_both_clocks() {
        let decided = String::from_utf8(told(1, "hall")).unwrap();
        let age = decided.rfind("\"age_ns\":").unwrap();
        let decided = format!("{}\"age_ns\":{}}}", &decided[..age], 600 * S);
        let now_ns = 10_000 * S;
        let heard = heard("robot-2", "decision", decided.into_bytes(), now_ns);
        let decision = Peers::new("robot-1").hear(&heard).unwrap().unwrap();
        assert_eq!((decision.decided_ns, decision.decided_unix_ns), (now_ns - 600 * S, NOW_UNIX_NS - 600 * S));
    }

    #[test]
    fn hostile_bytes_are_refused_and_robots_without_end_take_no_memory() {
        let mut peers = Peers::new("robot-1");
        for bytes in [b"".to_vec(), b"{}".to_vec(), b"null".to_vec(), told(1, "a").split_off(3), vec![b'x'; 9000]] {
            peers.hear(&heard("robot-2", "decision", bytes, 1)).err().unwrap();
        }
        let hidden = String::from_utf8(told(1, "hall")).unwrap().replace("hall", "h\\u001bl");
        peers.hear(&heard("robot-2", "decision", hidden.into_bytes(), 1)).err().unwrap();
        for robot in 0..1000 {
            let _heard = peers.hear(&heard(&robot.to_string(), "decision", told(1, "hall"), 1)).unwrap();
        }
        assert!(peers.peers.len() <= PEERS_MAX);
        // Those that have left give their places to others.
        assert_eq!(peers.fallen_silent(60 * S).len(), PEERS_MAX);
        let newcomer = peers.hear(&heard("newcomer", "decision", told(1, "hall"), 60 * S)).unwrap();
        assert_eq!(newcomer.map(|decision| decision.to().to_owned()).as_deref(), Some("hall"));
        assert!(peers.peers.len() <= PEERS_MAX);
    }
}
