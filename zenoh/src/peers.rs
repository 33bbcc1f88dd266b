//! Receives other robots' decisions and repeats them in this robot's domain. With `planner.avoid_robots`, its planner does not enter their rooms. A
//! robot that has fallen silent has no room.
//!
//! Such a decision has a flag that it was decided elsewhere, so that no driver takes it for an order. If a robot's planner runs in this domain, its
//! decisions are not repeated. Planners hear that one directly; if only the router carried them, a cut link would free its room.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use roomcast_ipc::raw::{DecisionV1, Message, NAME_BYTES, action, decision_flags};
use roomcast_ipc::{Action, Domain, IpcError, Sender, clock, sequence, text};
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

/// Most robots that are followed. More are ignored.
pub const PEERS_MAX: usize = 15;
/// A robot that is silent for this long has left its room. Robots send every second.
const LEASE_NS: u64 = 3_500_000_000;
/// Most queued messages. More are dropped; new ones follow within seconds.
const WAITING_MAX: usize = 64;
const TICK: Duration = Duration::from_millis(100);
/// Time in which the domain's history arrives. Planners send it within two ticks, and it is read before any peer's message.
const HISTORY_PATIENCE: Duration = Duration::from_millis(250);
/// Most known robots of this domain. If there are more, the one with the smallest number is dropped.
const HERE_MAX: usize = 64;
const FULL: &str = "as many other robots are followed as can be: nobody keeps clear of it, nor of others like it";
const LOST: &str = "other robots are not heard any more: their rooms are free for this one";

/// The topics that are received from a robot.
pub const TOPICS: [&str; 2] = ["decision", "status"];

/// A robot's message: the robot's name in keys, the topic, and the bytes.
pub struct Heard {
    robot: String,
    topic: String,
    bytes: Vec<u8>,
    /// When it was received, by this machine's monotonic and wall clocks.
    now_ns: u64,
    now_unix_ns: u64,
}

/// The end of the queue for subscribers.
#[derive(Clone)]
pub struct Inlet(SyncSender<Heard>);

/// Both ends of the queue.
#[must_use]
pub fn inlet() -> (Inlet, Receiver<Heard>) {
    let (to, heard) = sync_channel(WAITING_MAX);
    (Inlet(to), heard)
}

impl Inlet {
    /// Queues a message of `roomcast/SITE/ROBOT/told/TOPIC`.
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

    /// Queries earlier messages. A failure means that the session ends; the next session is asked again.
    fn ask(&self, session: &Session, site: &str) {
        for topic in TOPICS {
            let inlet = self.clone();
            let earlier = move |reply: Reply| reply.into_result().into_iter().for_each(|sample| inlet.take(&sample));
            let _asked = session.get(Keys::new(site, "*").told(topic)).callback(earlier).wait();
        }
    }
}

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
    number: u64,
    delay: Delay,
    heard_ns: u64,
    last: Option<DecisionV1>,
    /// It fell silent, and its room was given up.
    silent: bool,
}

/// A planner of this domain: the random number of its start, and its port.
struct Here {
    epoch: u64,
    sender: Sender,
}

/// The other robots that are heard. No I/O: the time is an argument.
pub struct Peers {
    own: u64,
    /// The robots whose planners decide in this domain.
    here: BTreeMap<u64, Here>,
    peers: BTreeMap<String, Peer>,
    /// The log has said that there is no place for another robot.
    is_full: bool,
}

impl Peers {
    /// Creates an empty table. `own` is this robot's name in keys.
    #[must_use]
    pub fn new(own: &str) -> Self {
        Self { own: sequence::source_of_name(own), here: BTreeMap::new(), peers: BTreeMap::new(), is_full: false }
    }

    /// Records a checked decision of this domain, and its port.
    pub fn see(&mut self, decision: &DecisionV1, sender: Sender) {
        let DecisionV1 { robot, epoch, .. } = *decision;
        if decision.has(decision_flags::ELSEWHERE) {
            return;
        }
        self.here.insert(robot, Here { epoch, sender });
        if self.here.len() > HERE_MAX {
            self.here.pop_first();
        }
        // The robot is heard here, so silence over the router must not be reported for it.
        self.peers.retain(|_, peer| peer.number != robot && peer.last.is_none_or(|last| last.epoch != epoch));
    }

    /// Whether a robot with this number, or a planner with this start, decides in this domain: the robot may have another name in keys. A planner
    /// that has ended here may go on elsewhere.
    fn is_here(&self, robot: u64, epoch: Option<u64>) -> bool {
        let is =
            |(number, here): (&u64, &Here)| (*number == robot || Some(here.epoch) == epoch) && here.sender.is_running();
        robot == self.own || self.here.iter().any(is)
    }

    /// Handles a message; returns the decision for the planner, if any.
    ///
    /// # Errors
    ///
    /// [`Fault`] if it is not a robot's message.
    pub fn hear(&mut self, heard: &Heard) -> Result<Option<DecisionV1>, Fault> {
        // The decision has only the number, and two names can have the same.
        let number = sequence::source_of_name(&heard.robot);
        if self.is_here(number, None) {
            return Ok(None);
        }
        let stamp: Stamp = wire::read(&heard.bytes)?;
        let decision = match heard.topic.as_str() {
            "decision" => Some(wire::read::<Decision>(&heard.bytes)?),
            _ => None,
        };
        if decision.as_ref().is_some_and(|decision| self.is_here(number, Some(decision.epoch.0))) {
            return Ok(None);
        }
        if self.peers.len() >= PEERS_MAX && !self.peers.contains_key(&heard.robot) {
            // A robot that has left makes room.
            let Some(left) = self.peers.iter().find(|(_, peer)| peer.silent).map(|(robot, _)| robot.clone()) else {
                let is_told = std::mem::replace(&mut self.is_full, true);
                return if is_told { Ok(None) } else { Err(Fault(FULL.to_owned())) };
            };
            self.peers.remove(&left);
            self.is_full = false;
        }
        let new = Peer { number, delay: Delay::default(), heard_ns: 0, last: None, silent: false };
        let peer = self.peers.entry(heard.robot.clone()).or_insert(new);
        // An unknown delay counts as 0: a room may be avoided for too long.
        let excess_ns = peer.delay.excess_ns(stamp.clock.0, stamp.sent_ns, heard.now_ns).unwrap_or(0);
        if excess_ns >= LEASE_NS {
            // The message was queued for too long to be valid.
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
        let message = message(heard, number, &decision, age_ns)?;
        let old = |last: DecisionV1| last.epoch == message.epoch && last.sequence >= message.sequence;
        if peer.last.is_some_and(old) && !back {
            return Ok(None);
        }
        peer.last = Some(message);
        Ok(Some(message))
    }

    /// Decisions that free the rooms of robots that have fallen silent.
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
                flags: decision_flags::ELSEWHERE,
                reason,
                ..last
            };
            (robot.clone(), peer.last.map(gone))
        });
        leave.collect()
    }

    /// The valid decisions of all robots that are heard. The service keeps only the last message, so new subscribers need the others again.
    pub fn standing(&self) -> impl Iterator<Item = DecisionV1> {
        self.peers.values().filter(|peer| !peer.silent).filter_map(|peer| peer.last)
    }
}

fn message(heard: &Heard, robot: u64, decision: &Decision, age_ns: u64) -> Result<DecisionV1, Fault> {
    let fault = |error: roomcast_ipc::MessageError| Fault(error.to_string());
    let message = DecisionV1 {
        robot,
        epoch: decision.epoch.0,
        sequence: decision.sequence,
        decided_ns: heard.now_ns.saturating_sub(age_ns),
        decided_unix_ns: heard.now_unix_ns.saturating_sub(age_ns),
        stay_ns: decision.stay_ns,
        // A later version may have more actions. This robot's planner then avoids the other robot's target room.
        action: Action::of_word(&decision.action).unwrap_or(Action::Stay).number(),
        flags: decision.flags | decision_flags::ELSEWHERE,
        probability: decision.probability,
        minor: 3,
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

/// Runs until asked to stop. `inlet` is the other end of `heard`, for queried messages.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(
    config: &Config,
    domain: &Domain,
    link: Option<&Link>,
    (inlet, heard): (&Inlet, &Receiver<Heard>),
    stop: &Stop,
) -> Result<(), IpcError> {
    let node = domain.open("roomcast-zenoh-peers")?;
    let decisions = node.publisher::<DecisionV1>()?;
    let here = node.subscriber::<DecisionV1>()?;
    let mut peers = Peers::new(config.robot.key());
    let (mut log, mut losses, mut connections) = (Limiter::default(), Limiter::default(), 0);
    let (mut own, mut lost) = (DecisionV1::default(), Vec::new());
    std::thread::sleep(HISTORY_PATIENCE);
    while !stop.requested() {
        let first = heard.recv_timeout(TICK).ok();
        if let Some(link) = link.filter(|link| link.connections() != connections)
            && let Some((_, session)) = link.session()
        {
            connections = link.connections();
            inlet.ask(&session, &config.site.name);
        }
        // Own decisions are read first: a message over the router was decided earlier.
        while let Some((checked, sender)) = here.receive_from(&mut own)? {
            if checked.is_ok() {
                peers.see(&own, sender);
            }
        }
        for heard in first.into_iter().chain(heard.try_iter()) {
            match peers.hear(&heard) {
                Ok(Some(decision)) => {
                    decisions.send(&decision)?;
                }
                Ok(None) => {}
                Err(fault) => {
                    if let Some(not_told) = log.pass(heard.robot.clone(), clock::monotonic_ns()) {
                        tracing::warn!(robot = heard.robot, %fault, not_told, "what a robot says is not used");
                    }
                }
            }
        }
        for (robot, gone) in peers.fallen_silent(clock::monotonic_ns()) {
            lost.push(robot);
            if let Some(gone) = gone {
                decisions.send(&gone)?;
            }
        }
        // Made-up names cause any number of silent robots, so the log is limited.
        if !lost.is_empty() && losses.pass(LOST, clock::monotonic_ns()).is_some() {
            tracing::warn!(robots = lost.join(", "), "{LOST}");
            lost.clear();
        }
        // Present subscribers ignore repetitions; new ones need them.
        if decisions.tick()? {
            for decision in peers.standing() {
                decisions.send(&decision)?;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eventually::eventually;
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
        told::decision(&decided(sequence, to)).bytes(Teller { start: 1, number: sequence, clock: 1, started_ns: 0 })
    }

    /// Every field of another robot's decision arrives. Regression: an unknown probability arrived as 0.
    #[test]
    fn a_decision_is_in_this_domain_what_it_was_in_its_own() {
        let own = decided(3, "kitchen");
        let heard = heard("robot-2", "decision", told(3, "kitchen"), clock::monotonic_ns());
        let decision = Peers::new("robot-1").hear(&heard).unwrap().unwrap();
        let (robot, robot_name) = (sequence::source_of_name("robot-2"), text::encode_cut("robot-2"));
        let DecisionV1 { decided_ns, decided_unix_ns, minor, .. } = decision;
        let flags = own.flags | decision_flags::ELSEWHERE;
        assert_eq!(decision, DecisionV1 { robot, robot_name, decided_ns, decided_unix_ns, flags, minor, ..own });
    }

    /// Regression: the service keeps one message, so a new planner knew one robot's room and entered another's.
    #[test]
    fn who_joins_hears_of_every_robot() {
        let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("peers-{}", std::process::id())).unwrap();
        let mut config = Config::default();
        "robot-1".clone_into(&mut config.robot.name);
        let (inlet, heard_here) = inlet();
        let stop = Stop::default();
        let now_ns = clock::monotonic_ns();
        for (robot, room) in
            [("robot-2", "kitchen"), ("robot-3", "bathroom"), ("robot-4", "hall"), ("robot-5", "study")]
        {
            inlet.0.send(heard(robot, "decision", told(1, room), now_ns)).unwrap();
        }
        std::thread::scope(|scope| {
            let (inlet, config, domain, stop) = (&inlet, &config, &domain, &stop);
            scope.spawn(move || run(config, domain, None, (inlet, &heard_here), stop).unwrap());
            let _ends = stop.at_end();
            let node = domain.open("planner").unwrap();
            // This robot's planner is in this domain.
            let here = node.publisher().unwrap();
            let robot_5 = sequence::source_of_name("robot-5");
            here.send(&DecisionV1 { robot: robot_5, epoch: 8, ..decided(1, "study") }).unwrap();
            // The second planner joins after all messages were sent.
            for _ in 0..2 {
                let planner = node.subscriber::<DecisionV1>().unwrap();
                let mut rooms = std::collections::BTreeSet::new();
                eventually("it hears of three robots", || {
                    while let Some(decision) = planner.receive().unwrap() {
                        assert_eq!(decision.has(decision_flags::ELSEWHERE), decision.robot != robot_5);
                        if decision.robot != robot_5 {
                            rooms.insert(decision.to().to_owned());
                        }
                    }
                    here.tick().unwrap();
                    for robot in ["robot-2", "robot-3", "robot-4"] {
                        let status = told::status(robot, None, None).bytes(Teller {
                            start: 1,
                            number: 1,
                            clock: 1,
                            started_ns: 0,
                        });
                        inlet.0.send(heard(robot, "status", status, clock::monotonic_ns())).unwrap();
                    }
                    (rooms.len() >= 3).then_some(())
                });
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
        // It comes back with its last decision.
        let status = told::status("robot-2", None, None).bytes(Teller { start: 1, number: 3, clock: 1, started_ns: 0 });
        let back = peers.hear(&heard("robot-2", "status", status, now_ns + 1)).unwrap().unwrap();
        assert_eq!((back.to(), back.action), ("kitchen", action::GO));
    }

    /// Regression: with two robots in one domain, a cut router made each bridge report a pause for the other robot. Its vacuum went home, and its
    /// room was taken.
    #[test]
    fn nothing_is_said_of_a_robot_whose_planner_is_in_this_domain() {
        let now_ns = clock::monotonic_ns();
        let runs = Sender::simulated(1);
        let here = DecisionV1 { robot: sequence::source_of_name("robot-2"), ..decided(1, "kitchen") };
        let other = |told: Vec<u8>| String::from_utf8(told).unwrap().replace(&"0".repeat(15), &"1".repeat(15));
        let mut peers = Peers::new("robot-1");
        // It was heard over the router before its planner was heard here.
        assert!(peers.hear(&heard("robot-2", "decision", told(1, "kitchen"), now_ns)).unwrap().is_some());
        assert!(peers.hear(&heard("key-of-2", "decision", told(1, "kitchen"), now_ns)).unwrap().is_some());
        peers.see(&DecisionV1 { flags: decision_flags::ELSEWHERE, ..here }, runs);
        assert_eq!(peers.standing().count(), 2, "another bridge has repeated it");
        peers.see(&here, runs);
        assert_eq!((peers.standing().count(), peers.fallen_silent(now_ns + 4 * S).len()), (0, 0));
        for robot in ["robot-2", "key-of-2"] {
            assert_eq!(peers.hear(&heard(robot, "decision", told(2, "hall"), now_ns)).unwrap(), None, "{robot}");
        }
        // A message with a made-up start does not count either.
        let made_up = other(told(3, "hall")).into_bytes();
        assert_eq!(peers.hear(&heard("robot-2", "decision", made_up, now_ns)).unwrap(), None);
        // A planner that has ended here may have been started elsewhere.
        let mut ended = std::process::Command::new("true").spawn().unwrap();
        ended.wait().unwrap();
        peers.see(&here, Sender::from_bytes((u128::from(ended.id()) << 64).to_le_bytes()));
        assert!(peers.hear(&heard("robot-2", "decision", told(4, "hall"), now_ns)).unwrap().is_some());
    }

    /// A new bridge queries earlier messages. Both clocks date them by their ages.
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
        let all = (0..1000).map(|robot: u64| peers.hear(&heard(&robot.to_string(), "decision", told(1, "hall"), 1)));
        let faults: Vec<_> = all.filter_map(Result::err).collect();
        assert!(matches!(&faults[..], [Fault(fault)] if fault == FULL), "{faults:?}");
        assert!(peers.peers.len() <= PEERS_MAX);
        // Robots that have left make room for others.
        assert_eq!(peers.fallen_silent(60 * S).len(), PEERS_MAX);
        let newcomer = peers.hear(&heard("newcomer", "decision", told(1, "hall"), 60 * S)).unwrap();
        assert_eq!(newcomer.map(|decision| decision.to().to_owned()).as_deref(), Some("hall"));
        assert!(peers.peers.len() <= PEERS_MAX);
    }
}
