//! Narrator, daemon and planner with the real model are killed at random moments, also while they start or publish, and restarted, while a robot
//! reports, fails and falls silent. In the end: no event is lost or recorded twice, every score follows from the narration that it claims, no
//! decision rests on stale scores, a room counts as done only after the robot's report, and no files are left.
//!
//! By default the test runs for some seconds. `ROOMCAST_CHAOS_CYCLES` sets the number of cycles, `ROOMCAST_CHAOS_SEED` the seed.
//! `ROOMCAST_CHAOS_CYCLES=1000 cargo test --release --test it chaos -- --include-ignored --nocapture` is the long run.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::{self, File};
use std::io::Write;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::Observation;
use roomcast_core::pipeline::Pipeline;
use roomcast_ipc::raw::{DecisionV1, IncludedV1, RobotReportV1, RoomScoresV1, action, decision_flags, score_flags};
use roomcast_ipc::{Domain, Node, Publisher, Subscriber, clock, sequence};
use roomcast_llama::LlamaModel;
use roomcast_services::config::Config;
use roomcast_services::daemon::journal;
use roomcast_services::reporter::{Kind, Report, Reporter};
use roomcast_services::setup;
use rustix::process::{Pid, Signal, kill_process};

use crate::eventually::waited;
use crate::number;

const DEFAULT_TIME: Duration = Duration::from_secs(8);
/// On a busy machine the time alone may be over before anything has happened.
const DEFAULT_CYCLES_MIN: u64 = 20;
const DEADLINE_NS: u64 = 500_000_000;
/// Quantised products differ a little with the shape of a batch, so scores within this tolerance are equal.
const TOLERANCE_NATS: f64 = 0.05;
const RECOMPUTED: usize = 400;
const PATIENCE: Duration = Duration::from_secs(60);
const NARRATOR: &str = "person";
const OBJECTS: [&str; 12] =
    ["fridge", "mug", "sofa", "bed", "shower", "toothbrush", "stove", "book", "sink", "television", "closet", "table"];
const VERBS: [&str; 3] = ["walk to", "look at", "touch"];

/// Whether this line reports that the person leaves. The next line implies the return.
fn leaves(number: usize) -> bool {
    number % 19 == 7
}

/// A narrator's line: the number is in its text, unless the person leaves.
fn line(number: usize) -> String {
    if leaves(number) {
        return r#"{"presence": "away"}"#.to_owned();
    }
    said(number)
}

/// A sentence with the line's number.
fn said(number: usize) -> String {
    let (object, verb) = (OBJECTS[number * 5 % OBJECTS.len()], VERBS[number % VERBS.len()]);
    format!("They {verb} the {object} {number}.")
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Role {
    Daemon,
    Planner,
    Narrator,
}

struct Process {
    child: Child,
    started: Instant,
    /// Whether the process has sent its first message.
    recovered: bool,
}

/// One message of scores.
#[derive(Debug, Clone)]
struct Seen {
    epoch: u64,
    sequence: u64,
    claim: Option<IncludedV1>,
    window: usize,
    log_score_nats: Vec<f64>,
}

/// The test's ports. Fields drop in order, and the ports must drop before the node.
struct Observer {
    scores: Subscriber<RoomScoresV1>,
    decisions: Subscriber<DecisionV1>,
    reports: Publisher<RobotReportV1>,
    node: Node,
}

struct World {
    rng: ChaCha8Rng,
    directory: tempfile::TempDir,
    domain: Domain,
    config: PathBuf,
    processes: BTreeMap<Role, Process>,
    observer: Option<Observer>,
    /// Files of the test's own node in the domain.
    own: Vec<String>,
    /// Lines given to the current narrator, by sequence number from 1.
    given: Vec<usize>,
    next_line: usize,
    /// Start of the current narrator; earlier events are from its predecessors.
    narrator_started_ns: u64,
    /// The current narrator's epoch, from its first claim, and the number of its claimed lines.
    narrator_epoch: Option<u64>,
    claimed: u64,
    daemon_epochs: Vec<u64>,
    planner_epochs: HashSet<u64>,
    seen: Vec<Seen>,
    /// The newest sending time of each snapshot.
    sent_ns: HashMap<(u64, u64), u64>,
    /// The robot, and the rooms that it reported as done.
    reporter: Reporter,
    finished: HashSet<String>,
    /// Room ids in the order of the scores.
    rooms: Vec<String>,
    tally: Tally,
    recovery_us: BTreeMap<Role, Histogram<u64>>,
}

#[derive(Debug, Default)]
struct Tally {
    cycles: u64,
    kills: [u64; 3],
    /// Kills before the process had sent a message.
    kills_at_start: u64,
    messages: u64,
    decisions: u64,
    fallbacks: u64,
    stale_decisions: u64,
    wrong_claims: u64,
    /// Processes that ended by themselves and were restarted.
    gave_up: u64,
}

impl World {
    fn new(seed: u64) -> Self {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(directory.path().join("d"), &format!("chaos-{}", std::process::id())).unwrap();
        let config = directory.path().join("roomcast.toml");
        let text = format!(
            "[model]\nthreads = 1\n[daemon]\nstate = {:?}\nheartbeat_ms = 100\njournal_bytes = 67108864\n\
             [planner]\nknow_s = 0.0\npolicy = \"greedy-avoidance\"\nroom_time_s = 0.02\ndeadline_ms = {}\n\
             report_timeout_s = 1.0\nreports = \"always\"\n\
             [narrator]\nname = {NARRATOR:?}\nlinger_s = 0.0\n",
            directory.path().join("state"),
            DEADLINE_NS / 1_000_000,
        );
        fs::write(&config, text).unwrap();
        let node = domain.open("chaos").unwrap();
        let own = files_of(&domain);
        Self {
            own,
            rng: ChaCha8Rng::seed_from_u64(seed),
            observer: Some(Observer {
                scores: node.subscriber().unwrap(),
                decisions: node.subscriber().unwrap(),
                reports: node.publisher().unwrap(),
                node,
            }),
            directory,
            domain,
            config,
            processes: BTreeMap::new(),
            given: Vec::new(),
            next_line: 0,
            narrator_started_ns: 0,
            narrator_epoch: None,
            claimed: 0,
            daemon_epochs: Vec::new(),
            planner_epochs: HashSet::new(),
            seen: Vec::new(),
            sent_ns: HashMap::new(),
            reporter: Reporter::new("robot", 1).unwrap(),
            finished: HashSet::new(),
            rooms: Vec::new(),
            tally: Tally::default(),
            recovery_us: BTreeMap::new(),
        }
    }

    fn log(&self, role: Role) -> PathBuf {
        self.directory.path().join(format!("{role:?}.log"))
    }

    fn start(&mut self, role: Role) {
        let arguments: &[&str] = match role {
            Role::Daemon => &["daemon"],
            Role::Planner => &["planner"],
            Role::Narrator => &["narrate", "-", "--pace", "0"],
        };
        let log = File::options().create(true).append(true).open(self.log(role)).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        command.args(arguments).arg("--root").arg(self.domain.root()).args(["--domain", self.domain.name()]);
        command.arg("--config").arg(&self.config).stdin(Stdio::piped()).stdout(Stdio::null());
        let started_ns = clock::monotonic_ns();
        let child = command.stderr(log).spawn().unwrap();
        self.processes.insert(role, Process { child, started: Instant::now(), recovered: false });
        if role == Role::Narrator {
            // A narrator's feeder repeats unconfirmed lines.
            let confirmed = usize::try_from(self.claimed).unwrap();
            let again = self.given.split_off(confirmed.min(self.given.len()));
            self.given.clear();
            (self.narrator_started_ns, self.narrator_epoch, self.claimed) = (started_ns, None, 0);
            for number in again {
                self.give(number);
            }
        }
    }

    /// Without a narrator the line waits for the next one.
    fn give(&mut self, number: usize) {
        self.given.push(number);
        let narrator = self.processes.get_mut(&Role::Narrator);
        if let Some(input) = narrator.and_then(|narrator| narrator.child.stdin.as_mut()) {
            // If the narrator has just ended, the next narrator gets the line.
            let _gone = writeln!(input, "{}", line(number));
        }
    }

    fn kill(&mut self, role: Role) {
        let Some(mut process) = self.processes.remove(&role) else { return };
        process.child.kill().unwrap();
        process.child.wait().unwrap();
        self.tally.kills[role as usize] += 1;
        self.tally.kills_at_start += u64::from(!process.recovered);
    }

    fn recovered(&mut self, role: Role) {
        let Some(process) = self.processes.get_mut(&role).filter(|process| !process.recovered) else { return };
        process.recovered = true;
        let took_us = u64::try_from(process.started.elapsed().as_micros()).unwrap();
        self.recovery_us.entry(role).or_insert_with(|| Histogram::new(3).unwrap()).record(took_us).unwrap();
    }

    fn all_recovered(&self) -> bool {
        [Role::Daemon, Role::Planner, Role::Narrator]
            .iter()
            .all(|role| self.processes.get(role).is_some_and(|p| p.recovered))
    }

    /// Gives lines, checks every message, and restarts processes that ended by themselves.
    fn go_on(&mut self, until: impl Fn(&Self) -> bool, at_most: Duration) {
        let start = Instant::now();
        while !until(self) && start.elapsed() < at_most {
            if self.given.len() as u64 - self.claimed.min(self.given.len() as u64) < 20 && self.rng.random_bool(0.4) {
                let number = self.next_line;
                self.next_line += 1;
                self.give(number);
            }
            self.look();
            for role in [Role::Daemon, Role::Planner, Role::Narrator] {
                let ended = self.processes.get_mut(&role).and_then(|process| process.child.try_wait().unwrap());
                if let Some(status) = ended {
                    println!("{role:?} ended by itself: {status}: {}", self.last_words(role));
                    self.tally.gave_up += 1;
                    self.processes.remove(&role);
                    self.start(role);
                }
            }
        }
    }

    fn last_words(&self, role: Role) -> String {
        let log = fs::read_to_string(self.log(role)).unwrap_or_default();
        log.lines().last().unwrap_or_default().to_owned()
    }

    fn look(&mut self) {
        let Some(observer) = &self.observer else { return };
        observer.scores.wait(Duration::from_millis(4)).unwrap();
        // Decisions are read first, so that the scores behind them have arrived too.
        let decisions: Vec<_> = std::iter::from_fn(|| observer.decisions.receive().unwrap()).collect();
        let scores: Vec<_> = std::iter::from_fn(|| observer.scores.receive().unwrap()).collect();
        assert_eq!((observer.decisions.malformed(), observer.scores.malformed()), (0, 0));
        for scores in scores {
            self.look_at_scores(&scores);
        }
        for decision in decisions {
            self.look_at_decision(&decision);
        }
    }

    fn look_at_scores(&mut self, scores: &RoomScoresV1) {
        self.tally.messages += 1;
        if self.rooms.is_empty() {
            self.rooms = scores.rooms().iter().map(|room| room.id().to_owned()).collect();
        }
        self.sent_ns.insert((scores.epoch, scores.sequence), scores.published_ns);
        if !self.daemon_epochs.contains(&scores.epoch) {
            self.daemon_epochs.push(scores.epoch);
            self.recovered(Role::Daemon);
        }
        let narrator = sequence::source_of_name(NARRATOR);
        let claims = scores.included().iter().filter(|claim| claim.source == narrator);
        // The claim of the current start, or else the newest.
        let claim = claims.max_by_key(|claim| (Some(claim.epoch) == self.narrator_epoch, claim.observed_ns)).copied();
        if let Some(claim) = claim.filter(|claim| claim.observed_ns >= self.narrator_started_ns) {
            // A claim contains only given lines and never decreases. A message of a killed daemon may arrive late.
            let late = self.daemon_epochs.last() != Some(&scores.epoch);
            let other = self.narrator_epoch.is_some_and(|epoch| epoch != claim.epoch);
            let given = self.given.len() as u64;
            if other || claim.sequence > given || (claim.sequence < self.claimed && !late) {
                println!("wrong claim {claim:?}: {given} given, {} claimed before", self.claimed);
                self.tally.wrong_claims += 1;
            }
            self.narrator_epoch = Some(claim.epoch);
            self.claimed = self.claimed.max(claim.sequence);
            self.recovered(Role::Narrator);
        }
        if !scores.has(score_flags::HEARTBEAT) {
            self.seen.push(Seen {
                epoch: scores.epoch,
                sequence: scores.sequence,
                claim,
                window: usize::try_from(scores.window).unwrap(),
                log_score_nats: scores.rooms().iter().map(|room| room.log_score_nats).collect(),
            });
        }
    }

    fn look_at_decision(&mut self, decision: &DecisionV1) {
        if self.planner_epochs.insert(decision.epoch) {
            self.recovered(Role::Planner);
        }
        self.tally.decisions += 1;
        let done = (0..64).filter(|room| decision.covered & (1 << room) != 0);
        for id in done.filter_map(|room: usize| self.rooms.get(room)) {
            assert!(self.finished.contains(id), "{id} counts as done, and the robot has not said so: {decision:?}");
        }
        self.obey(decision);
        if decision.has(decision_flags::FALLBACK) {
            self.tally.fallbacks += 1;
            return;
        }
        let sent_ns = self.sent_ns.get(&(decision.scores_epoch, decision.scores_sequence));
        let confirmed = sent_ns.is_some_and(|sent_ns| decision.decided_ns.saturating_sub(*sent_ns) <= DEADLINE_NS);
        if decision.scores_age_ns > DEADLINE_NS && !confirmed {
            println!("stale: {} ms old, last sent at {sent_ns:?}, {decision:?}", decision.scores_age_ns / 1_000_000);
            self.tally.stale_decisions += 1;
        }
    }

    /// The robot usually obeys at once. It may fail, or stay silent.
    fn obey(&mut self, decision: &DecisionV1) {
        let Some(observer) = self.observer.as_ref().filter(|_| decision.action == action::GO) else { return };
        let kind = match self.rng.random_range(0..100) {
            0..3 => return,
            3..10 => Kind::Failed,
            10..15 => Kind::Blocked,
            _ => Kind::Finished,
        };
        let room = decision.to().to_owned();
        let report = Report { room: Some(room.clone()), decision: Some(decision.sequence), ..Report::new(kind) };
        let message = self.reporter.message(&report, BootNs(clock::monotonic_ns()), UnixNs(clock::unix_ns())).unwrap();
        observer.reports.send(&message).unwrap();
        observer.reports.tick().unwrap();
        if kind == Kind::Finished {
            self.finished.insert(room);
        }
    }

    /// One kill of a random process at a random moment.
    fn cycle(&mut self) {
        self.tally.cycles += 1;
        let roles = [Role::Daemon, Role::Planner, Role::Narrator];
        let role = roles[self.rng.random_range(0..3)];
        match self.rng.random_range(0..10) {
            // At a random moment shortly after its start.
            0..4 => {
                self.kill(role);
                self.start(role);
                let moment = Duration::from_micros(self.rng.random_range(0..60_000));
                std::thread::sleep(moment);
            }
            // While narration and scores are on their way.
            4..7 => {
                let number = self.next_line;
                self.next_line += 1;
                self.give(number);
                std::thread::sleep(Duration::from_micros(self.rng.random_range(0..8000)));
            }
            _ => {
                let moment = Duration::from_millis(self.rng.random_range(0..200));
                self.go_on(|_| false, moment);
            }
        }
        self.kill(role);
        if self.rng.random_bool(0.2) {
            // Without the process for up to 0.9 s, so that the planner may fall back.
            let moment = Duration::from_millis(self.rng.random_range(0..900));
            self.go_on(|_| false, moment);
        }
        self.start(role);
        if self.rng.random_bool(0.7) {
            self.go_on(Self::all_recovered, PATIENCE);
            assert!(self.all_recovered(), "not recovered within {PATIENCE:?}: {}", self.last_words(role));
        }
    }

    fn stop(&mut self) {
        for process in self.processes.values_mut() {
            kill_process(Pid::from_raw(process.child.id().cast_signed()).unwrap(), Signal::TERM).unwrap();
        }
        for (_, mut process) in std::mem::take(&mut self.processes) {
            let status = process.child.wait().unwrap();
            // A panic's exit code is 101; an abort has none.
            assert!(status.code().is_some_and(|code| code != 101), "a process ended with {status}");
        }
    }

    fn left_behind(&self) -> Vec<String> {
        let mut left = files_of(&self.domain);
        left.retain(|file| !self.own.contains(file));
        left
    }
}

fn files_of(domain: &Domain) -> Vec<String> {
    let prefix = domain.prefix();
    let shared = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut files: Vec<String> =
        shared.filter(|name| name.starts_with(&prefix)).map(|name| format!("/dev/shm/{name}")).collect();
    let mut folders = vec![domain.root().to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).into_iter().flatten() {
            let path = entry.unwrap().path();
            if path.is_dir() && (path.ends_with("nodes") || path.ends_with("services")) {
                folders.push(path);
            } else {
                files.push(path.display().to_string());
            }
        }
    }
    files
}

impl Drop for World {
    fn drop(&mut self) {
        for process in self.processes.values_mut() {
            let _gone = process.child.kill();
            let _reaped = process.child.wait();
        }
        if std::thread::panicking() {
            for role in [Role::Daemon, Role::Planner, Role::Narrator] {
                let log = fs::read_to_string(self.log(role)).unwrap_or_default();
                let last: Vec<_> = log.lines().rev().take(10).collect();
                eprintln!("--- {role:?}, newest first\n{}", last.join("\n"));
            }
        }
    }
}

/// The greatest difference between the scores and those of the `window` narrations up to `end`, in nats.
fn difference(pipeline: &mut Pipeline<LlamaModel>, history: &[Observation], end: usize, seen: &Seen) -> f64 {
    pipeline.intake().forget_person(PersonId(0));
    // A person who left has no window and no room.
    let has_left = history[..end].last().is_some_and(|last| last.sentence().is_none());
    let start = end.saturating_sub(seen.window.max(usize::from(has_left)));
    let scores = pipeline.step(history[start..end].iter().cloned()).unwrap();
    let expected = &scores.grounded.partition_log_score_nats;
    let apart = |(a, b): (&f64, &f64)| if a == b { 0.0 } else { (a - b).abs() };
    expected.iter().zip(&seen.log_score_nats).map(apart).fold(0.0, f64::max)
}

#[test]
#[ignore = "full"]
fn nothing_is_lost_wrong_or_stale_whoever_is_killed() {
    let cycles = number("ROOMCAST_CHAOS_CYCLES");
    let seed = number("ROOMCAST_CHAOS_SEED").unwrap_or(1);
    let mut world = World::new(seed);
    for role in [Role::Daemon, Role::Planner, Role::Narrator] {
        world.start(role);
    }
    world.go_on(World::all_recovered, PATIENCE);
    let start = Instant::now();
    let least = |world: &World| world.tally.cycles < DEFAULT_CYCLES_MIN || start.elapsed() < DEFAULT_TIME;
    while cycles.map_or_else(|| least(&world), |cycles| world.tally.cycles < cycles) {
        world.cycle();
        if world.tally.cycles.is_multiple_of(100) {
            println!("{} cycles in {:.0} s", world.tally.cycles, start.elapsed().as_secs_f64());
        }
    }
    // Without kills, all lines are confirmed.
    world.go_on(World::all_recovered, PATIENCE);
    let confirmed = |world: &World| world.claimed == world.given.len() as u64;
    let waiting = Instant::now();
    while !confirmed(&world) {
        world.look();
        assert!(waiting.elapsed() < PATIENCE, "{} of {} lines are confirmed", world.claimed, world.given.len());
    }
    world.stop();

    let took_s = start.elapsed().as_secs_f64();

    // The history in the state database.
    let history = journal::look(&world.directory.path().join("state")).unwrap().observations;
    let texts: HashSet<&str> = history.iter().filter_map(|o| o.sentence()).collect();
    let done = (0..world.next_line).filter(|number| !leaves(*number));
    let lost = done.filter(|number| !texts.contains(said(*number).as_str())).count();
    let names: HashMap<_, _> = history.iter().enumerate().map(|(at, o)| (o.id(), at)).collect();
    let twice = history.len() - names.len();

    // Recompute scores from their claims. Scores that waited for the journal contain a little more than they claim.
    let (mut pipeline, _) = setup::open(&Config::load(&world.config).unwrap()).unwrap();
    let every = world.seen.len().div_ceil(RECOMPUTED).max(1);
    let (mut compared, mut first) = (0_u64, 0);
    for (index, seen) in world.seen.iter().enumerate() {
        let first_of_daemon = index == 0 || world.seen[index - 1].epoch != seen.epoch;
        let end = match seen.claim {
            // The first scores after a start may wait for a journal record: they claim no event, and contain the journal's events.
            None => continue,
            Some(claim) => match names.get(&EventId::new(claim.source, claim.epoch, claim.sequence)) {
                Some(at) => at + 1,
                None => {
                    println!("scores {}/{} claim what the history lacks: {claim:?}", seen.epoch, seen.sequence);
                    world.tally.wrong_claims += 1;
                    continue;
                }
            },
        };
        if !(index % every == 0 || (first_of_daemon && first < RECOMPUTED)) {
            continue;
        }
        first += usize::from(first_of_daemon);
        compared += 1;
        let mut nearest = f64::INFINITY;
        for end in end..=(end + 40).min(history.len()) {
            nearest = nearest.min(difference(&mut pipeline, &history, end, seen));
            if nearest <= TOLERANCE_NATS {
                break;
            }
        }
        if nearest > TOLERANCE_NATS {
            // These figures distinguish a wrong claim from scores of events that were lost with daemon and narrator before they reached the journal.
            let later = world.seen[index + 1..].iter().take_while(|later| later.epoch == seen.epoch).count();
            let same_claim = index > 0 && !first_of_daemon && world.seen[index - 1].claim == seen.claim;
            let around = &history[end.saturating_sub(3)..(end + 6).min(history.len())];
            let around: Vec<_> = around.iter().map(|o| (o.epoch, o.sequence, &o.event)).collect();
            println!(
                "scores {}/{} are {nearest:.3} nats from what they claim, record {end} of {}: {seen:?}; \
                 {later} later ones of the same daemon, same claim as those before: {same_claim}; around it: {around:?}",
                seen.epoch,
                seen.sequence,
                history.len()
            );
            world.tally.wrong_claims += 1;
        }
    }

    // A participant killed while it joined is removed after 10 s, when it no longer counts as joining.
    let node = world.observer.take().unwrap().node;
    let _clean = waited(Duration::from_secs(40), || {
        node.clean_up_dead();
        world.left_behind().is_empty().then_some(())
    });
    drop(node);
    let left = world.left_behind();
    let tally = std::mem::take(&mut world.tally);
    println!("{} cycles in {took_s:.0} s, seed {seed}: {tally:?}", tally.cycles);
    println!(
        "narrations {}, lost {lost}, taken twice {twice}; scores compared with their claims {compared}",
        world.next_line
    );
    for (role, took_us) in &world.recovery_us {
        let ms = |us: u64| us as f64 / 1e3;
        println!(
            "{role:?}: recovered {} times, p50 {:.0} ms, worst {:.0} ms",
            took_us.len(),
            ms(took_us.value_at_quantile(0.5)),
            ms(took_us.max())
        );
    }
    assert_eq!((lost, twice), (0, 0), "narrations lost, narrations taken twice");
    assert_eq!((tally.wrong_claims, tally.stale_decisions), (0, 0), "wrong claims, stale decisions");
    println!("left behind: {}", left.len());
    assert!(left.is_empty(), "left behind: {left:?}");
    assert!(world.domain.clean_up().unwrap());
    assert_eq!(files_of(&world.domain), Vec::<String>::new(), "left behind by the clean-up of the domain");
    assert!(tally.decisions > 0 && tally.messages > 0 && compared > 0, "nothing happened");
}
