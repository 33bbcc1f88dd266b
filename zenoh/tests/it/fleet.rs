//! A hub, a router and two robots as real processes, killed, stopped and restarted.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use roomcast_ipc::raw::{DecisionV1, IncludedV1, RoomScoresV1, action, decision_flags};
use roomcast_ipc::{Domain, Subscriber, clock, sequence};
use rustix::process::Signal;
use serde_json::Value;

use crate::support::{NO_ROUTER, Process, Robot, Watch, bridge, eventually, free_port, python, router, skipped};

/// The robots' `planner.deadline_ms`: a planner ignores scores that were not confirmed for this long, and makes a due decision within this time.
const DEADLINE_NS: u64 = 2_000_000_000;
/// A robot's stay, short for frequent decisions.
const STAY_S: f64 = 0.25;

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().map_or(default, |text| text.parse().unwrap())
}

/// A seeded generator.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % end
    }
}

fn hub(folder: &Path, way: &str, robots: &[&str], input: &Path) -> Process {
    let spool = folder.join("spool");
    let config = format!("{way}\n[hub]\nname = \"hall-camera\"\nrobots = {robots:?}\nspool = {spool:?}\n");
    let file = folder.join("hub.toml");
    std::fs::write(&file, config).unwrap();
    let input = input.to_owned();
    Process::start(folder.join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&file).arg("--input").arg(&input);
        command
    })
}

/// The newest confirmation of the hub's narration in a robot's scores.
fn included(scores: &Subscriber<RoomScoresV1>) -> Option<IncludedV1> {
    let newest = scores.newest().unwrap()?;
    let own = newest.included().iter().filter(|included| included.source == sequence::source_of_name("hall-camera"));
    own.max_by_key(|included| included.sequence).copied()
}

/// The decisions of one planner, and their delay.
#[derive(Default)]
struct Decided {
    /// Start of the current planner, and the epochs of its predecessors.
    started_ns: u64,
    ended: BTreeSet<u64>,
    last: Option<DecisionV1>,
    /// Sending time and name of scores; the newest last.
    scores: VecDeque<(u64, (u64, u64))>,
    made: u64,
    fallbacks: u64,
    /// The longest delay of a decision since the last look.
    worst_ns: u64,
    /// Decisions on scores that were not confirmed within the deadline.
    stale: Vec<String>,
}

impl Decided {
    /// The time at which a decision is due; `None` while the last one holds.
    fn due_ns(&self) -> Option<u64> {
        let Some(last) = &self.last else { return Some(self.started_ns + DEADLINE_NS) };
        if last.has(decision_flags::FALLBACK) {
            // A fallback holds until new scores come.
            return self.scores.iter().map(|(sent_ns, _)| *sent_ns).find(|sent_ns| *sent_ns > last.decided_ns);
        }
        let confirmed_ns = self.scores.back().map_or(0, |(sent_ns, _)| *sent_ns);
        Some(match last.action {
            action::GO => last.decided_ns + last.stay_ns,
            // A waiting decision holds while the daemon is alive.
            _ => last.decided_ns.max(confirmed_ns) + DEADLINE_NS,
        })
    }

    fn take_scores(&mut self, scores: &RoomScoresV1) {
        if self.scores.len() == 1024 {
            self.scores.pop_front();
        }
        self.scores.push_back((scores.published_ns, (scores.epoch, scores.sequence)));
    }

    fn take(&mut self, decision: DecisionV1) {
        // Messages of a killed planner may arrive late.
        if self.ended.contains(&decision.epoch) {
            return;
        }
        let late_ns = self.due_ns().map_or(0, |due_ns| decision.decided_ns.saturating_sub(due_ns));
        self.worst_ns = self.worst_ns.max(late_ns);
        self.made += 1;
        if decision.has(decision_flags::FALLBACK) {
            self.fallbacks += 1;
        } else {
            let name = (decision.scores_epoch, decision.scores_sequence);
            let sent = |(sent_ns, own): &&(u64, (u64, u64))| *own == name && *sent_ns <= decision.decided_ns;
            let sent_ns = self.scores.iter().rev().find(sent).map(|(sent_ns, _)| *sent_ns);
            let confirmed = sent_ns.is_some_and(|sent_ns| decision.decided_ns - sent_ns <= DEADLINE_NS);
            if decision.scores_age_ns > DEADLINE_NS && !confirmed {
                self.stale.push(format!("scores sent at {sent_ns:?}: {decision:?}"));
            }
        }
        self.last = Some(decision);
    }

    /// The longest delay since the last look, including a decision that is overdue now.
    fn worst_ns(&mut self) -> u64 {
        let owed_ns = self.due_ns().map_or(0, |due_ns| clock::monotonic_ns().saturating_sub(due_ns));
        std::mem::take(&mut self.worst_ns).max(owed_ns)
    }
}

/// Follows a robot's planner in the robot's domain, through faults of daemon, bridge, hub and router.
struct Witness {
    decided: Arc<Mutex<Decided>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Witness {
    fn start(name: &'static str, domain: Domain) -> Self {
        let decided = Arc::new(Mutex::new(Decided { started_ns: clock::monotonic_ns(), ..Decided::default() }));
        let stop = Arc::<AtomicBool>::default();
        let (own, ends) = (Arc::clone(&decided), Arc::clone(&stop));
        let follow = move || {
            let node = domain.open("witness").unwrap();
            let (decisions, scores) =
                (node.subscriber::<DecisionV1>().unwrap(), node.subscriber::<RoomScoresV1>().unwrap());
            let robot = sequence::source_of_name(name);
            while !ends.load(Ordering::Relaxed) {
                roomcast_ipc::wait_for_any(&[&decisions, &scores], Duration::from_millis(50)).unwrap();
                let mut decided = own.lock().unwrap();
                // Decisions are received before the scores and processed after them, so that the scores behind them have arrived.
                let made: Vec<_> = std::iter::from_fn(|| decisions.receive().unwrap()).collect();
                while let Some(scores) = scores.receive().unwrap() {
                    decided.take_scores(&scores);
                }
                for decision in made.into_iter().filter(|decision| decision.robot == robot) {
                    decided.take(decision);
                }
            }
        };
        Self { decided, stop, thread: Some(std::thread::spawn(follow)) }
    }

    fn decided(&self) -> MutexGuard<'_, Decided> {
        self.decided.lock().unwrap()
    }

    fn restart(&self, planner: &mut Process) {
        let mut decided = self.decided();
        planner.restart();
        let last = decided.last.take();
        decided.ended.extend(last.map(|last| last.epoch));
        decided.started_ns = clock::monotonic_ns();
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        let _ended = self.thread.take().map(JoinHandle::join);
    }
}

/// Decisions on the operator's side.
#[derive(Default)]
struct Seen {
    decisions: u64,
    /// Decisions that looked younger than the deadline.
    fresh: u64,
    /// The time of each robot's newest decision.
    newest_ns: BTreeMap<String, u64>,
}

impl Seen {
    fn look(&mut self, line: &Value) {
        let key = line["key"].as_str().unwrap();
        let Some(robot) = key.strip_suffix("/told/decision") else { return };
        self.decisions += 1;
        let of = |key: &str| line[key].as_u64().unwrap();
        // On loopback all processes share one clock, so the claimed age can be checked.
        let made_ns = of("sent_ns").saturating_sub(of("age_ns") - line["held_up_ns"].as_u64().unwrap_or(0));
        let newest_ns = self.newest_ns.entry(robot.to_owned()).or_default();
        *newest_ns = made_ns.max(*newest_ns);
        if line["held_up_ns"].is_u64() && of("age_ns") < DEADLINE_NS {
            self.fresh += 1;
            let truly_ns = of("received_ns").saturating_sub(made_ns);
            assert!(truly_ns < DEADLINE_NS + 1_000_000_000, "a stale decision looks fresh: {line}");
        }
    }

    /// Whether decisions of `robots` robots arrived that were made after a time.
    fn has_all_since(&self, robots: usize, since_ns: u64) -> bool {
        self.newest_ns.values().filter(|newest_ns| **newest_ns >= since_ns).count() == robots
    }
}

/// No narration is lost or taken twice, no decision rests on expired scores or looks younger than it is, and a due decision or its fallback comes
/// within the deadline. `ROOMCAST_FLEET_CYCLES` (default 12) sets the number of faults, `ROOMCAST_FLEET_CUT_S` (default 6) the seconds without the
/// router.
#[test]
fn nothing_is_lost_or_taken_twice_over_kills_restarts_and_cuts() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let (cycles, cut_s) = (number("ROOMCAST_FLEET_CYCLES", 12), number("ROOMCAST_FLEET_CUT_S", 6));
    let mut random = Random(number("ROOMCAST_FLEET_SEED", 1));
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let mut router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let names = ["robot-1", "robot-2"];
    let mut robots = names.map(|name| {
        let planner = format!("[planner]\nrobot = {name:?}\nroom_time_s = {STAY_S}\navoid_robots = true\n");
        let robot = format!(
            "{planner}[daemon]\njournal_bytes = 67108864\n[model]\nthreads = 1\n\
             [[daemon.narrator]]\nname = \"hall-camera\"\nrelayed = true\nrate_per_s = 0.0\n"
        );
        Robot::start_with(name, &way, &robot, "[peers]\nhear = true\n[[narrator]]\nname = \"hall-camera\"\n")
    });
    let witnesses = [0, 1].map(|robot| Witness::start(names[robot], robots[robot].domain.clone()));
    let watch_config = folder.path().join("watch.toml");
    std::fs::write(&watch_config, &way).unwrap();
    let watch = Watch::start(&watch_config);
    let path = folder.path().join("lines");
    let mut lines = File::create(&path).unwrap();
    let mut hub = hub(folder.path(), &way, &names, &path);
    // A subscriber to the scores continues through restarts of the daemon.
    let nodes = [0, 1].map(|robot| robots[robot].domain.open("test").unwrap());
    let scores = [0, 1].map(|robot| nodes[robot].subscriber::<RoomScoresV1>().unwrap());
    let acts = [
        "[Walk] <kitchen> (1)",
        "[Open] <fridge> (1)",
        "[Grab] <milk> (1)",
        "[Walk] <sofa> (1)",
        "[Sit] <sofa> (1)",
        "[Switchon] <television> (1)",
        "[Walk] <bathroom> (1)",
        "[Grab] <towel> (1)",
    ];
    let mut written = 0;
    let mut seen = Seen::default();
    let mut worst_ns = [0; 2];
    watch.find("a decision whose delay is known", |line| {
        line["key"].as_str().unwrap().ends_with("/told/decision") && line["held_up_ns"].is_u64()
    });
    for cycle in 0..cycles {
        for _ in 0..1 + random.below(5) {
            writeln!(lines, "{}", acts[random.below(8) as usize]).unwrap();
            written += 1;
        }
        let robot = random.below(2) as usize;
        // The first eight cycles have each fault once; later ones are random.
        let fault = if cycle < 8 { cycle } else { random.below(8) };
        // A random moment.
        std::thread::sleep(Duration::from_millis(random.below(300)));
        match fault {
            0 => hub.restart(),
            1 => robots[robot].bridge.restart(),
            2 => {
                router.kill();
                std::thread::sleep(Duration::from_millis(random.below(1500)));
                router.restart();
            }
            3 => {
                router.signal(Signal::STOP);
                std::thread::sleep(Duration::from_secs(cut_s));
                router.signal(Signal::CONT);
            }
            4 => robots[robot].daemon.restart(),
            5 => witnesses[robot].restart(&mut robots[robot].planner),
            6 => {
                robots[robot].bridge.restart();
                hub.restart();
            }
            _ => {
                robots[robot].daemon.kill();
                robots[robot].bridge.kill();
                writeln!(lines, "{}", acts[0]).unwrap();
                written += 1;
                // Sometimes long enough for a fallback.
                std::thread::sleep(Duration::from_millis(random.below(5000)));
                robots[robot].bridge.restart();
                robots[robot].daemon.restart();
            }
        }
        // Usually the next fault waits until the operator sees both robots again. Otherwise it falls into this recovery.
        let (since_ns, waits) = (clock::monotonic_ns(), random.below(4) > 0);
        while waits && !seen.has_all_since(robots.len(), since_ns) {
            seen.look(
                &watch.find("both robots decide", |line| line["key"].as_str().unwrap().ends_with("/told/decision")),
            );
        }
        watch.lines.try_iter().for_each(|line| seen.look(&line));
        for (robot, witness) in witnesses.iter().enumerate() {
            let mut decided = witness.decided();
            let late_ns = decided.worst_ns();
            worst_ns[robot] = late_ns.max(worst_ns[robot]);
            assert!(late_ns <= DEADLINE_NS, "cycle {cycle}, fault {fault}: {} decides {late_ns} ns late", names[robot]);
            assert!(decided.stale.is_empty(), "cycle {cycle}, fault {fault}: {:?}", decided.stale);
        }
    }
    for (robot, scores) in scores.iter().enumerate() {
        let mut last = None;
        eventually(&format!("robot {robot} has all {written}"), || {
            last = included(scores).or(last);
            last.filter(|included| included.sequence >= written)
        });
        let last = last.unwrap();
        assert_eq!((last.sequence, last.accepted), (written, written), "robot {robot}: each once");
    }
    assert!(hub.is_alive() && robots.iter_mut().all(|robot| robot.bridge.is_alive()));
    // No hub reported a false loss.
    assert!(!hub.said().contains("has dropped narration"), "every daemon has accepted all");
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 0);
    assert!(hub.said().trim_end().ends_with(r#""refused":0,"lost":0}"#), "{}", hub.said());
    let Seen { decisions, fresh, .. } = seen;
    let [made, fallbacks] = [|decided: &Decided| decided.made, |decided: &Decided| decided.fallbacks]
        .map(|count| witnesses.iter().map(|witness| count(&witness.decided())).sum::<u64>());
    eprintln!(
        "{cycles} cycles, {written} narrations to two robots; {made} decisions made, {fallbacks} of them fallbacks, at most {:?} after they \
         were due; {decisions} seen by the operator, {fresh} of them fresh",
        worst_ns.map(Duration::from_nanos)
    );
    assert!(fresh >= cycles, "too few decisions were seen to say anything");
}

#[test]
fn who_joins_late_has_the_last_values_and_sees_who_is_there() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let mut robot = Robot::start("robot-1", &way, &[], "");
    let watch_config = folder.path().join("watch.toml");
    std::fs::write(&watch_config, &way).unwrap();
    let key = |topic: &str| format!("roomcast/home/robot-1/told/{topic}");
    let first = Watch::start(&watch_config);
    let scores = first.find("scores", |line| line["key"] == key("scores"));
    // Messages are repeated only once an hour, but a late listener gets the newest at once, with their age.
    let late = Watch::start(&watch_config);
    let mut missing = vec!["scores", "forecast", "persons", "decision", "status"];
    let mut alive = false;
    while !missing.is_empty() || !alive {
        let line = late.find(&format!("{missing:?}"), |line| {
            line["alive"] == true || missing.iter().any(|topic| line["key"] == key(topic))
        });
        alive |= line["alive"] == true;
        if line["key"] == key("scores") {
            assert_eq!((&line["epoch"], &line["rooms"]), (&scores["epoch"], &scores["rooms"]));
            assert!(line["age_ns"].as_u64() >= scores["age_ns"].as_u64());
        }
        missing.retain(|topic| line["key"] != key(topic));
    }
    robot.bridge.kill();
    late.find("the robot goes", |line| line["alive"] == false);
    robot.bridge.restart();
    late.find("the robot comes back", |line| line["alive"] == true);
    late.find("the daemon's heartbeat", |line| {
        line["key"] == key("status") && line["silence_ns"].as_u64().is_some_and(|silence_ns| silence_ns < 2_000_000_000)
    });
    // A dead daemon shows as growing silence.
    robot.daemon.kill();
    late.find("the daemon's silence", |line| {
        line["key"] == key("status") && line["silence_ns"].as_u64().is_some_and(|silence_ns| silence_ns > 2_000_000_000)
    });
}

#[test]
fn a_hub_ends_when_every_robot_has_what_it_read_and_says_how_it_was_understood() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let daemon = "[planner]\nrobot = \"robot-1\"\n[daemon]\njournal_bytes = 67108864\n[model]\nthreads = 1\n[[daemon.narrator]]\nname = \"hall-camera\"\nrelayed = true\n";
    let hears = "[[narrator]]\nname = \"hall-camera\"\nunderstood = true\n";
    let robot = Robot::start_with("robot-1", &way, daemon, hears);
    let input = folder.path().join("lines");
    std::fs::write(&input, "They walk to the kitchen.\n\nno\u{7}\n[Fly] <mug> (1)\n{\"text\":\"away\",\"kind\":\"presence\",\"person\":\"Ada\"}\n").unwrap();
    let spool = folder.path().join("spool");
    let config = folder.path().join("hub.toml");
    std::fs::write(
        &config,
        format!("{way}\n[hub]\nname = \"hall-camera\"\nrobots = [\"robot-1\"]\nspool = {spool:?}\n"),
    )
    .unwrap();
    let (own, text) = (config.clone(), input.clone());
    // Standard input ends; a file would be followed.
    let mut hub = Process::start(folder.path().join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&own).stdin(File::open(&text).unwrap());
        command
    });
    // The router starts last.
    let _router = router(folder.path(), &python, port);
    assert_eq!(hub.wait(), 0, "{}", hub.said());
    let said = hub.said();
    assert!(said.contains(r#"{"last":2,"confirmed":2,"refused":2,"lost":0}"#), "{said}");
    // The robot's daemon explains its understanding of both lines.
    let explained: Vec<Value> = said.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let of = |number: u64| explained.iter().find(|line| line["sequence"] == number).unwrap();
    assert_eq!((&of(1)["event"], &of(1)["place"]), (&"did".into(), &"kitchen".into()), "{said}");
    assert_eq!(
        (&of(2)["presence"], &of(2)["persons"][0]["name"], &of(2)["robot"]),
        (&"away".into(), &"Ada".into(), &"robot-1".into()),
        "{said}"
    );
    drop(robot);
}

/// A copied configuration gives two robots one name. Both would get the lines of one home.
#[test]
fn of_two_robots_of_one_name_the_second_ends() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let start = |number: usize, name: &str| {
        let config = folder.path().join(format!("{number}.toml"));
        let (root, own) = (folder.path().join(number.to_string()), format!("{name}-{}", std::process::id()));
        let text = format!(
            "[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[robot]\nname = {name:?}\n[ipc]\nroot = {root:?}\ndomain = {own:?}\n"
        );
        std::fs::write(&config, text).unwrap();
        Process::start(folder.path().join(format!("{number}.log")), move || {
            let mut command = bridge();
            command.arg("robot").arg("--config").arg(&config);
            command
        })
    };
    let is_connected = |bridge: &Process| bridge.said().contains("connected").then_some(());
    let mut bridges = vec![start(1, "robot-1")];
    eventually("the first one is connected", || is_connected(&bridges[0]));
    // Time for the first bridge to publish its status, which no robot of another name hears.
    std::thread::sleep(Duration::from_secs(2));
    bridges.extend([start(2, "robot-1"), start(3, "robot-2")]);
    eventually("the second one of the name ends", || (!bridges[1].is_alive()).then_some(()));
    let said = bridges[1].said();
    assert!(said.contains("another bridge uses the robot's name \"robot-1\" at this site, and was first"), "{said}");
    eventually("another name is connected", || is_connected(&bridges[2]));
    // A killed bridge's session stays at the router for a while, and must not exclude its successor.
    bridges[0].kill();
    std::fs::remove_file(&bridges[1].log).unwrap();
    bridges[1].restart();
    eventually("it is connected", || is_connected(&bridges[1]));
    // It would end within this time.
    std::thread::sleep(Duration::from_secs(4));
    assert!(bridges[1..].iter_mut().all(Process::is_alive), "{}", bridges[1].said());
    // Killed processes leave shared memory behind.
    bridges.iter_mut().for_each(Process::kill);
    for (number, name) in ["robot-1", "robot-1", "robot-2"].into_iter().enumerate() {
        let root = folder.path().join((number + 1).to_string());
        let domain = Domain::new(root, &format!("{name}-{}", std::process::id())).unwrap();
        domain.clean_up().unwrap();
    }
}

#[test]
fn a_wrong_set_up_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("zenoh.toml");
    let run = |text: &str| {
        std::fs::write(&file, text).unwrap();
        let output = bridge().args(["robot", "--config"]).arg(&file).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    for (text, says) in [
        ("", "router.connect"),
        ("[router]\nconect = 1", "unknown key `conect`"),
        ("[router]\nconnect = \"tls/host:7447\"\nca = \"/nowhere\"", "/nowhere"),
        ("[router]\nconnect = \"tcp/10.0.0.1:7447\"", "insecure"),
    ] {
        let (code, said) = run(text);
        assert!(code == Some(2) && said.contains(says), "{text:?}: {said}");
    }
    let spool = folder.path().join("spool");
    let hub =
        format!("[router]\nconnect = \"tcp/127.0.0.1:1\"\n[hub]\nname = \"a\"\nrobots = [\"b\"]\nspool = {spool:?}\n");
    std::fs::write(&file, hub).unwrap();
    let output = bridge().args(["hub", "--input", "/nowhere", "--config"]).arg(&file).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && said.contains("cannot read /nowhere"), "{said}");
    let printed = bridge().arg("config").output().unwrap();
    std::fs::write(&file, printed.stdout).unwrap();
    let output = bridge().args(["watch", "--config"]).arg(&file).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}
