//! Real processes in private domains: what holds between narrator, daemon and planner when one is late, doubled, restarted,
//! fast, foreign or hostile. Nothing here sleeps for a fixed time to prove something, and nothing is held to a time.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a panic in a test is the report")]

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use iceoryx2::prelude::ZeroCopySend;
use roomcast_core::narration::{Observation, Sentence};
use roomcast_ipc::{
    ALL_PERSONS, DecisionV1, Domain, Field, Layout, MAX_ITEMS, Message, MessageError, NarrationV1, Node,
    PersonForecastsV1, RobotReportV1, RoomScoresV1, ServiceQuality, StatusResponseV1, Subscriber, action,
    decision_flags, narration_kind, question, score_flags, sequence,
};
use roomcast_services::daemon::journal;
use rustix::process::{Pid, Signal, kill_process};

#[expect(dead_code, reason = "a test needs some of them")]
#[path = "../src/exit_code.rs"]
mod exit_code;

/// Far longer than anything here takes, also on a loaded machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A private domain with its processes and their logs; gone when dropped.
struct World {
    directory: tempfile::TempDir,
    domain: Domain,
    children: Vec<Process>,
}

struct Process {
    child: Child,
    log: PathBuf,
}

/// A command without a domain to join.
fn roomcast(arguments: &[&str]) -> Command {
    // An installed binary can be tested instead of the one just built.
    let built = || env!("CARGO_BIN_EXE_roomcast").into();
    let mut command = Command::new(std::env::var_os("ROOMCAST_BINARY").unwrap_or_else(built));
    command.args(arguments).env_remove("ROOMCAST_CONFIG").stdin(Stdio::null());
    command
}

impl World {
    fn new(name: &str) -> Self {
        let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(directory.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
        Self { directory, domain, children: Vec::new() }
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = roomcast(arguments);
        command.arg("--root").arg(self.domain.root()).args(["--domain", self.domain.name()]);
        command
    }

    /// Starts a process that runs until the end of the test; returns its number.
    fn start(&mut self, arguments: &[&str]) -> usize {
        let log = self.directory.path().join(format!("log-{}", self.children.len()));
        let mut command = self.command(arguments);
        let child = command.stderr(File::create(&log).unwrap()).stdout(Stdio::null()).spawn().unwrap();
        self.children.push(Process { child, log });
        self.children.len() - 1
    }

    fn start_daemon(&mut self) -> usize {
        let state = self.state();
        self.start(&["daemon", "--state", state.to_str().unwrap()])
    }

    fn state(&self) -> PathBuf {
        self.directory.path().join("state")
    }

    /// Narrates lines and waits for the narrator's end; gives its exit code and outcome.
    fn narrate(&self, name: &str, lines: &str) -> (i32, serde_json::Value) {
        let file = self.directory.path().join(format!("{name}.txt"));
        std::fs::write(&file, lines).unwrap();
        self.narrate_file(name, &file)
    }

    fn narrate_file(&self, name: &str, file: &Path) -> (i32, serde_json::Value) {
        let mut command = self.command(&["narrate", file.to_str().unwrap(), "--name", name, "--pace", "0", "--json"]);
        let output = command.args(["--linger", "100"]).output().unwrap();
        let outcome = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        (output.status.code().unwrap(), outcome)
    }

    fn signal(&self, process: usize, signal: Signal) {
        kill_process(Pid::from_raw(self.children[process].child.id().cast_signed()).unwrap(), signal).unwrap();
    }

    fn wait(&mut self, process: usize) -> (ExitStatus, String) {
        let process = &mut self.children[process];
        let status = eventually("the process ends", || process.child.try_wait().unwrap());
        (status, std::fs::read_to_string(&process.log).unwrap())
    }

    fn assert_alive(&mut self) {
        for process in &mut self.children {
            if let Some(status) = process.child.try_wait().unwrap() {
                panic!("ended with {status}: {}", std::fs::read_to_string(&process.log).unwrap());
            }
        }
    }

    fn status(&self, node: &Node) -> StatusResponseV1 {
        node.status_client().unwrap().ask(PATIENCE).unwrap()
    }

    fn shared_memory_files(&self) -> Vec<String> {
        let prefix = self.domain.prefix();
        let names = std::fs::read_dir("/dev/shm").unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.starts_with(&prefix)).collect()
    }
}

impl Drop for World {
    fn drop(&mut self) {
        for process in &mut self.children {
            let _gone = process.child.kill();
            let _reaped = process.child.wait();
            if std::thread::panicking() {
                eprintln!("--- {}", std::fs::read_to_string(&process.log).unwrap_or_default());
            }
        }
        let _left = self.domain.clean_up();
    }
}

fn eventually<T>(what: &str, mut attempt: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = attempt() {
            return value;
        }
        assert!(start.elapsed() < PATIENCE, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The newest scores that satisfy a condition.
fn scores_with(scores: &Subscriber<RoomScoresV1>, what: &str, holds: impl Fn(&RoomScoresV1) -> bool) -> RoomScoresV1 {
    eventually(what, || scores.newest().unwrap().filter(&holds))
}

fn includes(scores: &RoomScoresV1, name: &str, number: u64) -> bool {
    let source = sequence::source_of_name(name);
    scores.included().iter().any(|included| included.source == source && included.sequence >= number)
}

#[test]
fn a_late_planner_has_the_scores_at_once_and_two_planners_do_not_disturb_each_other() {
    let mut world = World::new("late");
    world.start_daemon();
    let (code, outcome) = world.narrate("camera", "They walk to the kitchen.\nThey open the fridge.\n");
    assert_eq!((code, &outcome["confirmed"]), (0, &serde_json::json!(2)));

    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    world.start(&["planner", "--robot", "one", "--policy", "greedy-avoidance"]);
    world.start(&["planner", "--robot", "two", "--policy", "naive", "--seed", "3"]);
    let mut first = std::collections::BTreeMap::new();
    eventually("both robots decide", || {
        while let Some(decision) = decisions.receive().unwrap() {
            let decision = decision.unwrap();
            first.entry(decision.robot).or_insert(decision);
        }
        (first.len() == 2).then_some(())
    });
    for decision in first.values() {
        // No narration came after the planners: what they know, they got on joining.
        assert_eq!((decision.action, decision.flags), (action::GO, 0), "{}", decision.reason());
        assert!(decision.observed_ns > 0 && !decision.to().is_empty());
    }
    world.assert_alive();
}

/// Threads that the set-up left behind would make OpenMP put the scoring thread's to sleep wherever they wait for one another.
#[test]
fn only_the_scoring_thread_has_threads_of_the_decoder() {
    let mut world = World::new("threads");
    let config = world.directory.path().join("roomcast.toml");
    std::fs::write(&config, "[model]\nthreads = 2\n").unwrap();
    let state = world.state();
    let daemon = world.start(&["daemon", "--config", config.to_str().unwrap(), "--state", state.to_str().unwrap()]);
    assert_eq!(world.narrate("camera", "They walk to the kitchen.\n").0, 0);
    let process = PathBuf::from(format!("/proc/{}", world.children[daemon].child.id()));
    let name = |thread: PathBuf| std::fs::read_to_string(thread.join("comm")).unwrap_or_default();
    let threads = std::fs::read_dir(process.join("task")).unwrap().map(|thread| name(thread.unwrap().path()));
    let threads: Vec<String> = threads.collect();
    let count = |wanted: &str| threads.iter().filter(|thread| thread.trim_end() == wanted).count();
    // A thread is born with the name of the one that makes it.
    assert_eq!((count("scoring"), count("setup")), (2, 0), "{threads:?}");
    assert_eq!(count(name(process).trim_end()), 1, "{threads:?}");
}

/// What a sensor tells asks nothing of the model. Answers are prepared on after it.
#[test]
fn answers_are_prepared_on_after_an_event_that_asks_nothing() {
    let mut world = World::new("prepared");
    let config = world.directory.path().join("roomcast.toml");
    // Slow enough that there is more to do for the whole of the test.
    std::fs::write(&config, "[scoring]\nprepare = 256\nprepare_share = 0.03\n").unwrap();
    world.start(&["daemon", "--config", config.to_str().unwrap()]);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let mut sequence = 0;
    let mut tell = |person: u32, kind: u32, text: &str| {
        sequence += 1;
        let message = NarrationV1::new(kind, text).unwrap();
        let source = sequence::source_of_name("test");
        narration.send(&NarrationV1 { source, epoch: 1, sequence, person, ..message }).unwrap();
        scores_with(&scores, text, |scores| includes(scores, "test", sequence));
    };
    tell(7, narration_kind::SENTENCE, "They lie on the bed.");
    tell(0, narration_kind::SENTENCE, "They open the fridge.");
    let prepared = |world: &World, more_than: u64| {
        eventually("more answers", || Some(world.status(&node).prepared).filter(|prepared| *prepared > more_than))
    };
    prepared(&world, 0);
    let asked = world.status(&node).asked;
    tell(7, narration_kind::PRESENCE, "away");
    let before = world.status(&node);
    assert_eq!(before.asked, asked, "it asked nothing");
    // What was being answered may end; nine more are begun after it.
    prepared(&world, before.prepared + 9);
}

#[test]
fn the_history_survives_a_killed_daemon_and_nothing_is_taken_twice() {
    let mut world = World::new("killed");
    let daemon = world.start_daemon();
    assert_eq!(world.narrate("camera", "They walk to the kitchen.\nThey grab the mug.\nThey sit on the sofa.\n").0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let before = scores_with(&scores, "scores", |scores| includes(scores, "camera", 3));
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);

    world.start_daemon();
    let after = scores_with(&scores, "the new daemon's scores", |scores| scores.epoch != before.epoch);
    assert!(includes(&after, "camera", 3), "{:?}", after.included());
    assert_eq!(after.window, before.window);
    for (before, after) in before.rooms().iter().zip(after.rooms()) {
        assert_eq!(before.id(), after.id());
        assert!((before.log_score_nats - after.log_score_nats).abs() < 0.02, "the same history gives the same scores");
    }
    assert_eq!(world.status(&node).restored, 3);
}

#[test]
fn narration_that_a_daemon_did_not_confirm_reaches_the_next_one() {
    let mut world = World::new("unconfirmed");
    let file = world.directory.path().join("lines.txt");
    std::fs::write(&file, "They walk to the kitchen.\nThey grab the mug.\n").unwrap();
    // No daemon yet: the narrator waits with what it has said.
    let narrator =
        world.start(&["narrate", file.to_str().unwrap(), "--name", "early", "--pace", "0", "--linger", "100"]);
    let node = world.domain.open("test").unwrap();
    let heard = node.subscriber::<NarrationV1>().unwrap();
    eventually("the narrator speaks", || heard.receive().unwrap()).unwrap();
    world.start_daemon();
    let (status, log) = world.wait(narrator);
    assert!(status.success(), "{log}");
    assert_eq!(world.status(&node).accepted, 2);
}

#[test]
fn a_narrator_faster_than_the_scorer_loses_nothing() {
    let mut world = World::new("fast");
    world.start_daemon();
    let lines: String = (0..600).map(|number| format!("They do thing {number}.\n")).collect();
    let (code, outcome) = world.narrate("fast", &lines);
    assert_eq!((code, outcome), (0, serde_json::json!({"sent": 600, "confirmed": 600, "dropped": 0, "refused": 0})));
    let node = world.domain.open("test").unwrap();
    let status = world.status(&node);
    assert_eq!((status.accepted, status.missed, status.duplicates), (600, 0, 0));
    assert!(status.steps < 600 && status.merged > 0, "steps were merged: {} of {}", status.merged, status.steps);
    world.assert_alive();
}

#[test]
fn a_hostile_narrator_is_counted_and_the_daemon_goes_on() {
    let mut world = World::new("hostile");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let narration = node.publisher::<NarrationV1>().unwrap();
    let good = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
    let source = sequence::source_of_name("test");
    let good = NarrationV1 { source, epoch: 1, sequence: 1, ..good };
    let action = NarrationV1::new(narration_kind::ACTION, "[Fly] <moon> (1)").unwrap();
    let hostile = [
        NarrationV1 { text: [0xff; 1024], text_bytes: 1024, ..good },
        NarrationV1 { text_bytes: u32::MAX, ..good },
        NarrationV1 { text: [0x1b; 1024], text_bytes: 1024, ..good },
        NarrationV1 { kind: 77, ..good },
        NarrationV1 { source: 0, ..good },
        NarrationV1 { source, epoch: 1, sequence: 1, ..action },
    ];
    for message in &hostile {
        narration.send_unchecked(message).unwrap();
    }
    narration.send(&good).unwrap();
    scores_with(&scores, "the good one", |scores| includes(scores, "test", 1));
    let status = world.status(&node);
    assert_eq!((status.malformed, status.accepted), (hostile.len() as u64, 1));
    // Text that looks like a model's control token is text.
    let token = NarrationV1::new(narration_kind::SENTENCE, "<s></s><|endoftext|> They stand up.").unwrap();
    narration.send(&NarrationV1 { source, epoch: 1, sequence: 2, ..token }).unwrap();
    scores_with(&scores, "control tokens as text", |scores| includes(scores, "test", 2));
    world.assert_alive();
}

/// Persons have names, come and go, are renamed and forgotten, and a killed daemon's successor knows the same of them.
#[test]
fn persons_are_named_and_forgotten_over_a_kill() {
    let mut world = World::new("persons");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let forecasts = node.subscriber::<PersonForecastsV1>().unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let mut sequence = 0;
    let mut tell = |person: u32, name: &str, kind: u32, text: &str| {
        sequence += 1;
        let message = NarrationV1::new(kind, text).unwrap();
        let source = sequence::source_of_name("test");
        let person_name = roomcast_ipc::text::encode("name", name).unwrap();
        narration.send(&NarrationV1 { source, epoch: 1, sequence, person, person_name, ..message }).unwrap();
        scores_with(&scores, text, |scores| includes(scores, "test", sequence))
    };
    tell(0, "Ada", narration_kind::SENTENCE, "They open the fridge.");
    tell(7, "", narration_kind::SENTENCE, "They lie on the bed.");
    tell(ALL_PERSONS, "", narration_kind::SENTENCE, "They close the fridge.");
    let told = tell(7, "", narration_kind::PRESENCE, "away");
    assert!(told.persons == 2 && !told.has(score_flags::NOBODY_HOME));
    assert!(tell(0, "ada", narration_kind::SENTENCE, "Ada leaves the house.").has(score_flags::NOBODY_HOME));
    let forecast = eventually("the persons' forecasts", || {
        forecasts.newest().unwrap().filter(|told| told.persons().iter().all(|person| person.elsewhere[0] == 1.0))
    });
    assert_eq!(forecast.persons().len(), 2);

    let ask = |world: &World, arguments: &[&str]| {
        let output = world.command(&[&["person"], arguments, &["--json"]].concat()).output().unwrap();
        let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
    };
    let persons = |answer: &serde_json::Value| -> Vec<(String, String, String)> {
        let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
        let line =
            |line: &serde_json::Value| (line["person"].to_string(), text(&line["name"]), text(&line["presence"]));
        answer["persons"].as_array().unwrap().iter().map(line).collect()
    };
    let ada = roomcast_core::narration::person_number("ada").to_string();
    let row = |number: &str, name: &str, presence: &str| (number.to_owned(), name.to_owned(), presence.to_owned());
    let (code, answer, _) = ask(&world, &["list"]);
    assert_eq!((code, persons(&answer)), (0, vec![row("7", "", "away"), row(&ada, "ada", "away")]));
    let (code, answer, errors) = ask(&world, &["rename", "7", "Ben"]);
    assert_eq!((code, &answer["kept"]), (0, &serde_json::json!(true)), "{errors}");
    let (code, _, errors) = ask(&world, &["rename", "7", "ADA"]);
    assert!(code == 3 && errors.contains(&format!("ADA is person {ada} already")), "{errors}");
    assert_eq!(ask(&world, &["forget", "eve"]).0, 3);

    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    let daemon = world.start_daemon();
    let (_, answer, _) = ask(&world, &["list"]);
    assert_eq!(persons(&answer), [row("7", "Ben", "away"), row(&ada, "ada", "away")]);
    let (code, answer, errors) = ask(&world, &["forget", "ada"]);
    assert_eq!((code, persons(&answer)), (0, vec![row("7", "Ben", "away")]), "{errors}");
    let journal = std::fs::read(world.state().join("narration.journal")).unwrap();
    let journal = String::from_utf8_lossy(&journal);
    // What named nobody and was found to be hers, too.
    assert!(!journal.to_lowercase().contains("ada") && !journal.contains("fridge"), "{journal}");
    assert!(journal.contains("They lie on the bed."));
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    let daemon = world.start_daemon();
    let (_, answer, _) = ask(&world, &["list"]);
    assert_eq!(persons(&answer), [row("7", "Ben", "away")]);

    // That a name cannot be kept is no fault of the question.
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    std::fs::write(world.state().join("persons.json"), "{").unwrap();
    world.start_daemon();
    let (code, _, errors) = ask(&world, &["rename", "7", "Bert"]);
    assert!(code == 1 && errors.contains("repair or remove it"), "{code}: {errors}");
}

/// A configuration whose window holds few tokens, in `world`'s directory.
fn small_window(world: &World) -> String {
    let path = world.directory.path().join("small.toml");
    std::fs::write(&path, "[history]\ntokens = 256\n").unwrap();
    path.to_str().unwrap().to_owned()
}

/// Row "a sentence of one kilobyte that makes some 1 000 tokens" of the attacks: it is refused before it reaches the journal, said once
/// and counted, and its narrator is told. A journal that has such a sentence, from an older version, stops and blinds nobody.
#[test]
fn a_sentence_that_costs_more_than_the_window_harms_nobody() {
    let mut world = World::new("costly");
    let (config, state) = (small_window(&world), world.state());
    std::fs::create_dir(&state).unwrap();
    let costly = format!("They say {}.", "x9 ".repeat(330));
    let sentence = Sentence::new(&costly).unwrap();
    let observed = Observation { source: 5, epoch: 5, sequence: 5, ..Observation::of(5, sentence) };
    std::fs::write(state.join("narration.journal"), journal::encode(&observed, &[0; 16])).unwrap();
    let arguments = ["daemon", "--state", state.to_str().unwrap(), "--config", &config];
    let daemon = world.start(&arguments);
    let lines = format!("They walk to the kitchen.\n{costly}\n{costly}\nThey grab the mug.\n{costly}\n");
    let (code, outcome) = world.narrate("camera", &lines);
    let expected = serde_json::json!({"sent": 5, "confirmed": 2, "dropped": 3, "refused": 0});
    assert_eq!((code, outcome), (i32::from(exit_code::IPC), expected));
    let node = world.domain.open("test").unwrap();
    let status = world.status(&node);
    assert_eq!((status.costly, status.accepted, status.failed_steps, status.missed), (3, 2, 0, 0));
    world.signal(daemon, Signal::TERM);
    let (_, log) = world.wait(daemon);
    assert_eq!(log.matches("costs more tokens than a window holds").count(), 1, "{log}");
    assert!(log.contains("the journal has sentences of more than the 256 tokens"), "{log}");

    world.start(&arguments);
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let after = scores_with(&scores, "scores after the restart", |scores| includes(scores, "camera", 4));
    assert_eq!((after.window, after.has(score_flags::SCORER_FAILED)), (2, false));
}

/// Row "an honest narrator's source and epoch with sequence 2^64 - 1" of the attacks.
#[test]
fn what_a_stranger_says_in_a_narrators_name_is_dropped_and_counted() {
    let mut world = World::new("forged");
    world.start_daemon();
    let (node, stranger) = (world.domain.open("honest").unwrap(), world.domain.open("stranger").unwrap());
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let (honest, forging) = (node.publisher::<NarrationV1>().unwrap(), stranger.publisher::<NarrationV1>().unwrap());
    let said = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
    let said = NarrationV1 { source: sequence::source_of_name("honest"), epoch: 9, sequence: 1, ..said };
    honest.send(&said).unwrap();
    scores_with(&scores, "the first sentence", |scores| includes(scores, "honest", 1));
    for sequence in [2, u64::MAX] {
        forging.send(&NarrationV1 { sequence, ..said }).unwrap();
    }
    eventually("the forged ones are counted", || (world.status(&node).forged == 2).then_some(()));
    honest.send(&NarrationV1 { sequence: 2, ..said }).unwrap();
    let named = scores_with(&scores, "the next sentence", |scores| includes(scores, "honest", 2));
    assert_eq!((named.included()[0].sequence, named.included()[0].accepted, named.window), (2, 2, 2));
    assert_eq!(world.status(&node).missed, 0);
}

/// Row "two narrators of one name (the default's)" of the attacks.
#[test]
fn two_narrators_of_one_name_are_both_heard() {
    let mut world = World::new("namesakes");
    world.start_daemon();
    let file = world.directory.path().join("lines.txt");
    std::fs::write(&file, "They sit.\nThey stand up.\nThey sit.\nThey stand up.\nThey sit.\nThey sleep.\n").unwrap();
    let arguments = ["narrate", file.to_str().unwrap(), "--pace", "0.2", "--linger", "100"];
    let both = [world.start(&arguments), world.start(&arguments)];
    for narrator in both {
        let (status, log) = world.wait(narrator);
        assert!(status.success(), "{log}");
    }
    let status = world.status(&world.domain.open("test").unwrap());
    assert_eq!((status.accepted, status.missed, status.forged, status.duplicates), (12, 0, 0, 0));
}

/// Row "64 invented sources" of the attacks.
#[test]
fn invented_sources_lock_nobody_out() {
    let mut world = World::new("invented");
    let daemon = world.start_daemon();
    let lines: String = (0..4).map(|person| format!("{{\"text\": \"They sit.\", \"person\": {person}}}\n")).collect();
    assert_eq!(world.narrate("honest", &lines).0, 0);
    let node = world.domain.open("hostile").unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    let said = NarrationV1::new(narration_kind::SENTENCE, "They dance.").unwrap();
    let before = world.status(&node).received;
    for number in 1..=1000_u32 {
        let source = u64::from(number);
        narration.send(&NarrationV1 { source, epoch: 1, sequence: 1, person: 0, ..said }).unwrap();
        // No more than the port's buffer holds, so that all of them arrive.
        if number % 100 == 0 {
            let all = before + source;
            eventually("they are received", || (world.status(&node).received == all).then_some(()));
        }
    }
    // Narrators that have ended keep what nobody needs; the hostile one has no more than its eight.
    let status = world.status(&node);
    assert!(status.sources <= 9 && (status.persons, status.limited) == (4, 0), "{} sources", status.sources);
    assert_eq!(world.narrate("newcomer", "They sit.\n").0, 0);
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    drop((narration, node));
    world.start_daemon();
    assert_eq!(world.narrate("another", "They sit.\nThey stand up.\n").0, 0);
}

/// How often the threads of a process went to sleep by themselves.
fn sleeps(process: u32) -> u64 {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap().flatten();
    let status = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("status")).ok());
    let count = |status: String| {
        let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:").map(str::to_owned));
        line.unwrap().trim().parse::<u64>().unwrap()
    };
    status.map(count).sum()
}

/// Memory of a process that no other shares, in KiB.
fn own_memory_kib(process: u32) -> u64 {
    let rollup = std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap();
    let private = rollup.lines().filter(|line| line.starts_with("Private_"));
    private.map(|line| line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()).sum()
}

/// `top --json --snapshots 1` waited in silence where there was no daemon.
#[test]
fn whoever_wants_one_snapshot_and_has_no_daemon_is_told() {
    let world = World::new("silent");
    let output = world.command(&["top", "--json", "--snapshots", "1"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(6), 0), "{said}");
    assert!(said.contains("no daemon is heard in the domain") && said.contains("start `roomcast daemon`"), "{said}");
}

/// A planner that runs beside its daemon shares the program's pages with it.
#[test]
fn an_idle_daemon_and_planner_wake_seldom_and_a_planner_is_small() {
    let mut world = World::new("idle");
    let both = [world.start_daemon(), world.start(&["planner"])];
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    scores_with(&scores, "scores", |_| true);
    eventually("a decision", || decisions.newest().unwrap());
    drop((scores, decisions, node));
    let ids = both.map(|process| world.children[process].child.id());
    // Some time to settle, then a time to count in: what is counted is a rate. Whatever else runs here adds to it, so a busy time is tried again.
    std::thread::sleep(Duration::from_secs(2));
    let rates = |_| {
        let (before, start) = (ids.map(sleeps), Instant::now());
        std::thread::sleep(Duration::from_secs(8));
        let seconds = start.elapsed().as_secs_f64();
        let rates = ids.iter().zip(before).map(|(id, before)| (sleeps(*id) - before) as f64 / seconds);
        let rates: Vec<f64> = rates.collect();
        println!("wake-ups a second of daemon and planner: {rates:.1?}");
        rates
    };
    assert!((0..3).map(rates).any(|rates| rates.iter().sum::<f64>() < 16.0), "three times");
    let memory_kib = ids.map(own_memory_kib);
    println!("memory of daemon and planner that is theirs alone: {memory_kib:?} KiB");
    assert!(memory_kib[1] < 10_000, "{memory_kib:?} KiB");
}

/// A map of `count` items in four rooms, in `world`'s directory, and a configuration with it.
fn large_map(world: &World, count: usize) -> String {
    let room = |n: usize| {
        format!(r#"{{"id": "r{n}", "label": "room {n}", "box": {{"min_m": [{n}, 0, 0], "max_m": [{}, 1, 1]}}}}"#, n + 1)
    };
    let item = |n: usize| {
        let x = (n % 4) as f64 + 0.5;
        format!(
            r#"{{"id": "i{n}", "label": "thing {}", "position_m": [{x}, 0.5, 0.5], "box": {{"min_m": [{x}, 0.4, 0.4], "max_m": [{}, 0.6, 0.6]}}}}"#,
            n % 50,
            x + 0.1
        )
    };
    let (rooms, items): (Vec<_>, Vec<_>) = ((0..4).map(room).collect(), (0..count).map(item).collect());
    let scene = format!(
        r#"{{"format": "roomcast-scene", "version": 1, "name": "large", "rooms": [{}], "items": [{}]}}"#,
        rooms.join(","),
        items.join(",")
    );
    let (path, config) = (world.directory.path().join("large.json"), world.directory.path().join("large.toml"));
    std::fs::write(&path, scene).unwrap();
    std::fs::write(&config, format!("[scene]\npath = {path:?}\n")).unwrap();
    config.to_str().unwrap().to_owned()
}

/// Row "`top` on a map of 20 000 items with 64 MB of shared memory" of the attacks.
#[test]
fn what_is_sent_of_a_large_map_is_bounded() {
    let mut world = World::new("large");
    let config = large_map(&world, 20_000);
    world.start(&["daemon", "--config", &config]);
    let node = world.domain.open("test").unwrap();
    let items = node.item_scores_subscriber().unwrap();
    let best = eventually("item scores", || items.newest().unwrap());
    assert_eq!((best.header.items, best.items.len()), (20_000, MAX_ITEMS));
    let moment = node.question_port(question::MOMENT).unwrap().ask("{}", PATIENCE).unwrap();
    assert!(moment.len() > 1 << 20, "an answer of {} bytes", moment.len());
    let size = |name: &String| std::fs::metadata(format!("/dev/shm/{name}")).map_or(0, |about| about.len());
    let bytes: u64 = world.shared_memory_files().iter().map(size).sum();
    assert!(bytes < 48 << 20, "{bytes} bytes of shared memory");
    assert_eq!(world.narrate("newcomer", "They sit.\n").0, 0);
}

/// The scores of a later version under the old service's name.
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[repr(C)]
#[type_name("roomcast.RoomScoresV2")]
struct RoomScoresV2 {
    epoch: u64,
}

impl Layout for RoomScoresV2 {
    const TYPE_NAME: &'static str = "roomcast.RoomScoresV2";
    const FIELDS: &'static [Field] = &[];
}

impl Message for RoomScoresV2 {
    const SERVICE: ServiceQuality = RoomScoresV1::SERVICE;

    fn check(&self) -> Result<(), MessageError> {
        Ok(())
    }
}

#[test]
fn another_version_of_a_message_is_one_clear_error() {
    let mut world = World::new("version");
    let node = world.domain.open("later-daemon").unwrap();
    let _running = node.publisher::<RoomScoresV2>().unwrap();
    let planner = world.start(&["planner"]);
    let (status, log) = world.wait(planner);
    assert_eq!(status.code(), Some(i32::from(exit_code::IPC)), "{log}");
    assert!(log.contains("roomcast.RoomScoresV2") && log.contains("roomcast.RoomScoresV1"), "{log}");
}

#[test]
fn a_second_daemon_is_refused_and_the_first_stops_cleanly() {
    let mut world = World::new("second");
    let first = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let second = world.start(&["daemon"]);
    let (status, log) = world.wait(second);
    assert_eq!(status.code(), Some(i32::from(exit_code::IPC)), "{log}");
    let holder = format!("roomcast-daemon (process {})", world.children[first].child.id());
    assert!(log.contains(&holder) && log.contains("roomcast/v1/room-scores"), "{log}");

    world.signal(first, Signal::TERM);
    let (status, log) = world.wait(first);
    assert!(status.success(), "{log}");
    drop((scores, node));
    assert!(world.domain.clean_up().unwrap());
    assert_eq!(world.shared_memory_files(), Vec::<String>::new());
    assert!(!world.domain.root().exists());
}

/// `top` on a quiet system: nothing is narrated after it has joined.
#[test]
fn whoever_joins_has_the_item_scores_without_a_new_event() {
    let mut world = World::new("items");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = scores_with(&node.subscriber::<RoomScoresV1>().unwrap(), "the first scores", |_| true);
    let items = node.item_scores_subscriber().unwrap();
    let newest = eventually("item scores", || items.newest().unwrap());
    assert_eq!((newest.header.epoch, newest.header.sequence), (scores.epoch, scores.sequence));
    assert!(newest.items.len() > 30 && newest.items.iter().all(|item| item.log_score_nats.is_finite()));
}

/// As `timeout` and terminals do it: a signal to the process, and another at once to its group.
#[test]
fn signals_in_a_row_are_one_wish_to_stop() {
    let mut world = World::new("twice");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    scores_with(&node.subscriber::<RoomScoresV1>().unwrap(), "the first scores", |_| true);
    for signal in [Signal::TERM, Signal::INT, Signal::TERM] {
        world.signal(daemon, signal);
    }
    let (status, log) = world.wait(daemon);
    assert!(status.success() && log.contains("stopped"), "{status}: {log}");
    drop(node);
    assert!(world.domain.clean_up().unwrap());
    assert_eq!(world.shared_memory_files(), Vec::<String>::new());
}

#[test]
fn a_second_planner_of_the_same_robot_is_refused() {
    let mut world = World::new("robots");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let first = world.start(&["planner", "--robot", "one", "--room-time", "0"]);
    eventually("a decision", || decisions.newest().unwrap());
    let other = world.start(&["planner", "--robot", "zwei Küchen", "--room-time", "0"]);
    let second = world.start(&["planner", "--robot", "one"]);
    let (status, log) = world.wait(second);
    assert_eq!(status.code(), Some(i32::from(exit_code::IPC)), "{log}");
    let number = sequence::source_of_name("one");
    let holder = format!("roomcast-planner one {number:016x} (process {})", world.children[first].child.id());
    assert!(log.contains(&holder), "{log}");
    // A planner that was killed is in nobody's way.
    world.signal(first, Signal::KILL);
    world.wait(first);
    let third = world.start(&["planner", "--robot", "one", "--room-time", "0"]);
    let process = world.children[third].child.id();
    eventually("the third planner decides", || {
        assert!(world.children[third].child.try_wait().unwrap().is_none(), "process {process} ended");
        decisions.newest().unwrap().filter(|decision| decision.robot == sequence::source_of_name("one"))
    });
    assert!(world.children[other].child.try_wait().unwrap().is_none());
}

/// `demo` is killed and cannot end what it has started.
#[test]
fn the_processes_of_a_killed_demo_end_with_it() {
    let mut demo = roomcast(&["demo", "--seconds", "60"]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let demo_id = demo.id().to_string();
    // Process, and its arguments.
    let children = || -> Vec<(u32, Vec<String>)> {
        let processes =
            std::fs::read_dir("/proc").unwrap().filter_map(|entry| entry.unwrap().file_name().into_string().ok());
        let of_demo = processes.filter_map(|id| id.parse().ok()).filter(|id: &u32| {
            let environment = std::fs::read(format!("/proc/{id}/environ")).unwrap_or_default();
            let wanted = format!("ROOMCAST_STAGE={demo_id}");
            environment.split(|&byte| byte == 0).any(|variable| variable == wanted.as_bytes())
        });
        let arguments = |id| {
            let line = std::fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
            String::from_utf8_lossy(&line).split('\0').map(str::to_owned).collect()
        };
        of_demo.map(|id| (id, arguments(id))).collect()
    };
    let started = eventually("daemon, planner and narrator run", || Some(children()).filter(|all| all.len() == 3));
    demo.kill().unwrap();
    demo.wait().unwrap();
    eventually("they end", || children().is_empty().then_some(()));
    let of = |option: &str| {
        let arguments = &started[0].1;
        arguments[arguments.iter().position(|argument| argument == option).unwrap() + 1].clone()
    };
    let root = PathBuf::from(of("--root"));
    assert!(Domain::new(&root, &of("--domain")).unwrap().clean_up().unwrap());
    std::fs::remove_dir_all(root.parent().unwrap()).unwrap();
}

/// Who was in which room from which second on, as the demo's log says.
fn rooms_of(who: &str, log: &str) -> Vec<(usize, String)> {
    let entry = |line: &str| {
        let (time, event) = line.trim_start().split_once(" s  ")?;
        let way = event.strip_prefix(who)?.split(':').next()?.trim_end_matches(" (fallback)");
        let room = way.rsplit_once(" the ").map_or(way, |(_, room)| room);
        Some((time.parse().ok()?, room.to_owned()))
    };
    log.lines().filter_map(entry).collect()
}

fn room_at(rooms: &[(usize, String)], second: usize) -> Option<&str> {
    rooms.iter().rev().find(|(from_s, _)| *from_s <= second).map(|(_, room)| room.as_str())
}

/// Every figure of the demo's headline follows from the lines above it, and the others are the experiment's.
#[test]
fn the_figures_of_the_demo_follow_from_its_log_and_equal_the_experiments() {
    const PROGRAM: &str = "p0-breakfast-and-television";
    let cell = ["--scene", "apartment-e0", "--program", PROGRAM, "--room-time", "25", "--seed", "3"];
    let output = roomcast(&["demo", "--seconds", "12"]).args(cell).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let log = String::from_utf8(output.stdout).unwrap();
    let (person, robot) = (rooms_of("person ", &log), rooms_of("robot ", &log));

    // 18 steps of 24 s each.
    let horizon_s = 18 * 24;
    assert!(log.contains(&format!("18 steps, {horizon_s} s of a person's time")), "{log}");
    let shared_s = (0..horizon_s).filter(|second| room_at(&person, *second) == room_at(&robot, *second)).count();
    let ends = robot.iter().skip(1).map(|(from_s, _)| *from_s).chain([horizon_s]);
    let mut done_s = std::collections::BTreeMap::new();
    for ((from_s, room), to_s) in robot.iter().zip(ends) {
        if from_s + 25 <= to_s {
            done_s.entry(room.as_str()).or_insert(from_s + 25);
        }
    }
    let done = match done_s.len() {
        3 => format!("every room was done after {} s", done_s.values().max().unwrap()),
        _ => "not every room was done".to_owned(),
    };
    let headline = format!("The robot shared a room with the person for {shared_s} of {horizon_s} s, and {done}.");
    assert!(log.contains(&headline), "{headline}\n{log}");
    assert_eq!(done_s.len(), 3, "coverage-aware leaves a room undone: {log}");

    // What is held is carried along: who drinks on the sofa is in the living room.
    let second = |sentence: &str| -> usize {
        let line = log.lines().find(|line| line.contains(sentence)).unwrap_or_else(|| panic!("no {sentence:?}: {log}"));
        line.trim_start().split_once(" s  ").unwrap().0.parse().unwrap()
    };
    for second in second("They sit on the sofa.")..=second("They drink the mug.") {
        assert_eq!(room_at(&person, second), Some("living room"), "{log}");
    }

    let output = roomcast(&["experiment", "table2", "--no-cache", "--json"]).args(cell).output().unwrap();
    let table: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
    for policy in ["coverage-aware", "informed-avoidance", "naive"] {
        let of_policy = |row: &&serde_json::Value| row["policy"] == policy;
        let row = table["rows"].as_array().unwrap().iter().find(of_policy).unwrap();
        let figure = |key: &str| row[key].as_f64().unwrap();
        let expected = [
            format!("{:.1}", figure("disturbance_mean")),
            format!("{:.1}", figure("coverage_time_mean")),
            format!("{:.1}", 100.0 * figure("failure_rate")),
        ];
        let line = log.lines().find(|line| line.contains(&format!("simulated: {policy}"))).unwrap();
        let words: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(words[2..5], expected, "{policy}: {line}");
    }
}

#[test]
fn a_stopped_daemon_makes_the_planner_stay() {
    let mut world = World::new("stopped");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    world.start(&["planner", "--room-time", "0.05"]);
    let flagged = |wanted: bool| {
        eventually("a decision", || {
            let decision = decisions.receive().unwrap()?.unwrap();
            (decision.has(decision_flags::FALLBACK) == wanted).then_some(decision)
        })
    };
    assert_eq!(flagged(false).action, action::GO);
    world.signal(daemon, Signal::STOP);
    let fallback = flagged(true);
    assert_eq!(fallback.action, action::STAY);
    assert_eq!(fallback.from(), fallback.to());
    world.signal(daemon, Signal::CONT);
    assert_eq!(flagged(false).action, action::GO);
}

#[test]
fn lines_that_are_no_narration_are_named_and_the_others_go_through() {
    let mut world = World::new("lines");
    world.start_daemon();
    let (code, outcome) = world.narrate("lines", "They sit.\n[Fly] <moon> (1)\n{\"txt\": 1}\nThey stand up.\n");
    assert_eq!(code, i32::from(exit_code::INPUT));
    assert_eq!(outcome, serde_json::json!({"sent": 2, "confirmed": 2, "dropped": 0, "refused": 2}));
}

const MOVED: &str = r#"[{"change": "move-item", "id": "fridge-1", "position_m": [0.5, 0.5, 0.5],
    "box": {"min_m": [0.2, 0.2, 0.0], "max_m": [0.8, 0.8, 1.6]}}]"#;

/// Applies changes to the running daemon's map by the command; gives its exit code and answer.
fn apply(world: &World, changes: &str, more: &[&str]) -> (i32, serde_json::Value, String) {
    let file = world.directory.path().join("changes.json");
    std::fs::write(&file, changes).unwrap();
    let mut command = world.command(&["scene", "apply", file.to_str().unwrap(), "--json"]);
    let output = command.args(more).output().unwrap();
    let answer = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
}

/// Room probabilities by id.
fn probabilities(scores: &RoomScoresV1) -> std::collections::BTreeMap<String, f64> {
    scores.rooms().iter().map(|room| (room.id().to_owned(), room.probability)).collect()
}

#[test]
fn the_map_of_a_running_daemon_changes_without_a_restart_and_without_the_model() {
    let mut world = World::new("changes");
    let daemon = world.start_daemon();
    assert_eq!(world.narrate("camera", "They walk to the kitchen.\nThey open the fridge.\n").0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let before = scores_with(&scores, "scores", |scores| includes(scores, "camera", 2));

    // The fridge goes from the kitchen to the main room: regrouped, and the model has nothing to do.
    let (code, answer, error) = apply(&world, MOVED, &[]);
    assert_eq!((code, answer["new_labels"].as_u64()), (0, Some(0)), "{answer} {error}");
    let after =
        scores_with(&scores, "scores of the new map", |scores| scores.map_fingerprint != before.map_fingerprint);
    assert_eq!(after.epoch, before.epoch, "the same daemon");
    assert_eq!((after.tokenise_ns, after.prefix_ns, after.trie_ns), (0, 0, 0), "nothing was decoded");
    assert!(after.sequence > answer["sequence"].as_u64().unwrap() && includes(&after, "camera", 2));
    let (old, new) = (probabilities(&before), probabilities(&after));
    assert!(new["main-room"] > old["main-room"] + 0.01 && new["kitchen"] < old["kitchen"], "{old:?} {new:?}");

    // The scene file changed in the same way gives the same map and the same scores.
    let file = world.directory.path().join("changed.json");
    let changes = world.directory.path().join("changes.json");
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
    let changed = command.args(["scene", "change", "studio"]).arg(&changes).arg("--out").arg(&file).output().unwrap();
    assert!(changed.status.success(), "{changed:?}");
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
    command.args(["score", "--json", "--narration", "They walk to the kitchen. They open the fridge.", "--scene"]);
    let once: serde_json::Value = serde_json::from_slice(&command.arg(&file).output().unwrap().stdout).unwrap();
    for room in once["partitions"].as_array().unwrap() {
        let probability = room["probability"].as_f64().unwrap();
        assert!((probability - new[room["id"].as_str().unwrap()]).abs() < 5e-3, "{once} {new:?}");
    }

    // A new room with a new kind of thing: the model is prepared for the words, in the running daemon.
    let room = r#"[{"change": "add-room", "room": {"id": "garage", "label": "garage",
        "box": {"min_m": [7, 0, 0], "max_m": [10, 3, 2.5]}}, "doors": [{"id": "k-g", "rooms": ["kitchen", "garage"], "position_m": [6.9, 1, 1]}]},
        {"change": "add-item", "item": {"id": "unicycle-1", "label": "unicycle", "position_m": [8, 1, 0.5],
        "box": {"min_m": [7.8, 0.8, 0], "max_m": [8.2, 1.2, 1]}}}]"#;
    let (code, answer, error) = apply(&world, room, &["--expect", answer["map"].as_str().unwrap()]);
    assert_eq!(
        (code, answer["new_labels"].as_u64(), answer["rooms"].as_u64()),
        (0, Some(2), Some(4)),
        "{answer} {error}"
    );
    let with_garage = scores_with(&scores, "scores with a garage", |scores| scores.room_count == 4);
    let garage = with_garage.rooms().iter().find(|room| room.id() == "garage").unwrap();
    assert!(garage.probability > 0.0 && garage.log_score_nats.is_finite());
    assert!(includes(&with_garage, "camera", 2) && with_garage.window == before.window);

    // What cannot be is refused, and changes nothing.
    let (code, refused, error) = apply(&world, r#"[{"change": "remove-item", "id": "piano-1"}]"#, &[]);
    assert_eq!((code, &refused["map"]), (i32::from(exit_code::INPUT), &answer["map"]), "{error}");
    assert!(error.contains("there is no item \"piano-1\""), "{error}");
    let (code, refused, error) = apply(&world, MOVED, &["--expect", &"0".repeat(64)]);
    assert_eq!((code, &refused["outcome"]), (i32::from(exit_code::INPUT), &serde_json::json!("other-map")), "{error}");

    // A daemon that is killed begins with the changed map again.
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    world.start_daemon();
    let restarted = scores_with(&scores, "the new daemon's scores", |scores| scores.epoch != before.epoch);
    assert_eq!(restarted.map_fingerprint, with_garage.map_fingerprint);
}

/// What was said before the map changed is not read by the map of now.
#[test]
fn a_daemon_that_is_killed_after_a_map_change_believes_everybody_where_they_were() {
    let mut world = World::new("moved");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let forecasts = node.subscriber::<PersonForecastsV1>().unwrap();
    assert_eq!(world.narrate("camera", "{\"person\": \"ada\", \"text\": \"She opens the fridge.\"}\n").0, 0);
    let kitchen = |what: &str, holds: &dyn Fn(&PersonForecastsV1) -> bool| {
        let told =
            eventually(what, || forecasts.newest().unwrap().filter(|told| told.persons().len() == 1 && holds(told)));
        let room = told.rooms().position(|room| room == "kitchen").unwrap();
        (told.persons()[0].probability[room][0], told.epoch, told.sequence)
    };
    let (before, epoch, sequence) = kitchen("a forecast", &|_| true);
    assert!(before > 0.7, "{before}");
    let (code, answer, error) = apply(&world, MOVED, &[]);
    assert_eq!((code, &answer["kept"]), (0, &serde_json::json!(true)), "{error}");
    let (changed, ..) = kitchen("a forecast of the changed map", &|told| told.sequence > sequence);
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    world.start_daemon();
    let (after, ..) = kitchen("a forecast after the restart", &|told| told.epoch != epoch);
    // Silence makes nobody surer within the seconds that a start takes.
    assert!(changed > 0.7 && after > 0.6 && after < changed + 0.01, "{before} {changed} {after}");
}

#[test]
fn a_running_systems_scores_are_explained_down_to_the_tokens() {
    let mut world = World::new("explain");
    world.start_daemon();
    let lines = "They walk to the kitchen.\nThey open the fridge.\nThey grab the milk.\n";
    assert_eq!(world.narrate("camera", lines).0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let scores = scores_with(&scores, "scores", |scores| includes(scores, "camera", 3));
    let plan = world.directory.path().join("plan.svg");
    let mut command =
        world.command(&["explain", "--live", "--json", "--top", "1000", "--plan", plan.to_str().unwrap()]);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let explained: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let read: Vec<_> = lines.lines().map(serde_json::Value::from).collect();
    assert_eq!(explained["narration"].as_array(), Some(&read));
    let mut labels = 0;
    for (id, probability) in probabilities(&scores) {
        let partitions = explained["partitions"].as_array().unwrap();
        let partition = partitions.iter().find(|partition| partition["id"] == id.as_str()).unwrap();
        assert!((partition["probability"].as_f64().unwrap() - probability).abs() < 1e-9, "{id}");
        for label in partition["labels"].as_array().unwrap() {
            let sum: f64 =
                label["tokens"].as_array().unwrap().iter().map(|token| token["log_prob_nats"].as_f64().unwrap()).sum();
            let sum = sum + label["prior_nats"].as_f64().unwrap();
            assert!((sum - label["log_prob_nats"].as_f64().unwrap()).abs() < 1e-9, "{label}");
            labels += 1;
        }
    }
    assert!(labels > 30, "{labels} labels stand behind the studio's rooms");
    assert!(std::fs::read_to_string(plan).unwrap().contains("They grab the milk."));
}

/// Of several persons the rooms are as likely as the daemon publishes them: that somebody's next thing is there.
#[test]
fn of_several_persons_the_rooms_are_explained_as_they_are_published() {
    let mut world = World::new("explain-all");
    world.start_daemon();
    let lines = "{\"person\": \"ada\", \"text\": \"They open the fridge.\"}\n{\"person\": \"ben\", \"text\": \"They lie on the bed.\"}\n";
    assert_eq!(world.narrate("camera", lines).0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let scores = scores_with(&scores, "scores", |scores| includes(scores, "camera", 2));
    let output = world.command(&["explain", "--live", "--json"]).output().unwrap();
    let explained: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(explained["persons"].as_array().unwrap().len(), 2);
    let partitions = explained["partitions"].as_array().unwrap();
    for (id, probability) in probabilities(&scores) {
        let partition = partitions.iter().find(|partition| partition["id"] == id.as_str()).unwrap();
        assert!((partition["probability"].as_f64().unwrap() - probability).abs() < 1e-9, "{id}");
    }
    let falls = |pair: &[serde_json::Value]| pair[0]["probability"].as_f64() >= pair[1]["probability"].as_f64();
    assert!(partitions.windows(2).all(falls), "{partitions:?}");
}

/// What a scrape of the loopback address gives.
fn scrape(address: &str) -> String {
    use std::io::{Read, Write};
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    stream.write_all(b"GET /metrics HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

/// A metric's value; the labels, if any, are part of its name.
fn metric(text: &str, name: &str) -> Option<f64> {
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.trim().parse().ok())
}

#[test]
fn metrics_of_a_running_daemon_are_scraped() {
    let mut world = World::new("metrics");
    let daemon = world.start_daemon();
    world.start(&["planner", "--robot", "one"]);
    let serving = world.start(&["metrics", "--listen", "127.0.0.1:0"]);
    let log = world.children[serving].log.clone();
    let address = eventually("the address is printed", || {
        let said = std::fs::read_to_string(&log).unwrap();
        Some(said.split("http://").nth(1)?.split_once("/metrics")?.0.to_owned())
    });
    assert_eq!(world.narrate("camera", "They walk to the kitchen.\nThey open the fridge.\n").0, 0);
    let text = eventually("both narrations are counted, and the decision", || {
        let text = scrape(&address);
        let counted = metric(&text, "roomcast_narrations_total{outcome=\"accepted\"}") == Some(2.0);
        (counted && text.contains("roomcast_decisions_total{")).then_some(text)
    });
    assert!(
        text.starts_with("HTTP/1.0 200") && text.contains("openmetrics-text") && text.ends_with("# EOF\n"),
        "{text}"
    );
    assert_eq!(metric(&text, "roomcast_daemon_up"), Some(1.0));
    assert_eq!(metric(&text, "roomcast_sources"), Some(1.0));
    let steps = metric(&text, "roomcast_event_to_scores_seconds_count").unwrap();
    let unseen = metric(&text, "roomcast_scores_unseen_total").unwrap();
    assert!(steps >= 1.0 && steps + unseen >= 1.0, "{text}");
    assert!(metric(&text, "roomcast_event_to_scores_seconds_sum").unwrap() > 0.0);
    assert!(metric(&text, "roomcast_step_seconds_sum{stage=\"prefix\"}").unwrap() > 0.0);
    assert!(metric(&text, "roomcast_scores_silence_seconds").unwrap() < PATIENCE.as_secs_f64());
    let rooms: f64 = ["kitchen", "main-room", "bathroom"]
        .iter()
        .map(|room| metric(&text, &format!("roomcast_room_probability{{room=\"{room}\"}}")).unwrap())
        .sum();
    assert!((rooms - 1.0).abs() < 1e-9, "{rooms}");
    assert!(text.contains("model=\"") && text.contains(env!("CARGO_PKG_VERSION")));

    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    let down = eventually("the daemon is down", || {
        Some(scrape(&address)).filter(|t| metric(t, "roomcast_daemon_up") == Some(0.0))
    });
    assert!(metric(&down, "roomcast_scores_silence_seconds").unwrap() > 0.0);

    let refused = world.command(&["metrics", "--listen", "0.0.0.0:0"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(i32::from(exit_code::CONFIG)));
    let off = world.command(&["metrics"]).output().unwrap();
    assert_eq!(off.status.code(), Some(i32::from(exit_code::CONFIG)));
    assert!(String::from_utf8(off.stderr).unwrap().contains("metrics are off"));
}

#[test]
fn a_wrong_set_up_of_narrate_is_its_end() {
    let world = World::new("wrong");
    let rules = world.directory.path().join("rules.toml");
    std::fs::write(&rules, "[[rule]]\ntopic = \"a\"\nsay = \"They sit.\"").unwrap();
    let (rules, nowhere) = (rules.to_str().unwrap(), "/nowhere/at-all");
    let mqtt = |arguments: &[&'static str]| [&["--rules", rules, "--mqtt"], arguments].concat();
    for (arguments, code, part) in [
        (mqtt(&["http://127.0.0.1:1"]), exit_code::USAGE, "no broker"),
        (mqtt(&["mqtt://h:99999"]), exit_code::USAGE, "no broker"),
        (mqtt(&["mqtts://127.0.0.1:1"]), exit_code::USAGE, "without a CA file"),
        (mqtt(&["mqtt://127.0.0.1:1", "--mqtt-ca", nowhere]), exit_code::USAGE, "with a CA file"),
        (mqtt(&["mqtts://127.0.0.1:1", "--mqtt-ca", nowhere]), exit_code::INPUT, nowhere),
        (mqtt(&["mqtt://127.0.0.1:1", "--mqtt-credentials", nowhere]), exit_code::INPUT, nowhere),
        (vec!["--fifo", rules], exit_code::INPUT, "no named pipe"),
        (vec!["--linger", "nan"], exit_code::USAGE, "a number from 0"),
        (vec!["--linger=-1"], exit_code::USAGE, "a number from 0"),
        (vec!["--name", ""], exit_code::CONFIG, "narrator.name"),
    ] {
        let output = world.command(&["narrate"]).args(&arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(code)), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
}

/// Whoever wrote the wrong address is told so: the configuration, or the command line.
#[test]
fn a_broker_that_is_none_is_the_fault_of_who_names_it() {
    let world = World::new("broker");
    let config = world.directory.path().join("roomcast.toml");
    for (address, part) in [("http://h", "no broker"), ("mqtt://ada:secret@h", "user name"), ("mqtts://h", "CA file")] {
        std::fs::write(&config, format!("[mqtt]\nbroker = {address:?}\nrules = \"rules.toml\"\n")).unwrap();
        for command in [&["narrate"][..], &["bridge", "mqtt"], &["robot"]] {
            // A narrator has no broker unless it is told so.
            let asked = if command == ["narrate"] { &["--mqtt"][..] } else { &[] };
            let configured = [asked, &["--config", config.to_str().unwrap()]].concat();
            let given = vec!["--mqtt", address];
            for (more, code) in [(configured, exit_code::CONFIG), (given, exit_code::USAGE)] {
                let output = world.command(command).args(&more).output().unwrap();
                let said = String::from_utf8(output.stderr).unwrap();
                assert_eq!(output.status.code(), Some(i32::from(code)), "{command:?} {more:?}: {said}");
                assert!(said.contains(part) && !said.contains("secret"), "{command:?} {more:?}: {said}");
            }
        }
    }
}

/// What goes on until it is stopped has done its work then, whatever it has heard on the way; what has an end has not.
#[test]
fn a_signal_ends_a_service_well_and_interrupts_work_that_has_an_end() {
    let mut world = World::new("stopped");
    let path = |world: &World, name: &str| world.directory.path().join(name).to_str().unwrap().to_owned();
    let (fifo, lines) = (path(&world, "fifo"), path(&world, "lines"));
    std::fs::write(&lines, "They sit.\n{\"no\": \"narration\"}\nThey stand up.\n").unwrap();
    // No daemon and no planner is there: nothing of it is confirmed. Each says on standard error that it is at its work.
    let until = |world: &World, process: usize, word: &str| {
        let log = world.children[process].log.clone();
        eventually(word, || std::fs::read_to_string(&log).ok().filter(|log| log.contains(word)));
    };
    for (number, signal) in [Signal::INT, Signal::TERM].into_iter().enumerate() {
        let follows = world.start(&["narrate", "--fifo", &fifo, "--name", "follows", "--linger", "1000"]);
        eventually("a FIFO", || Path::new(&fifo).exists().then_some(()));
        std::fs::write(&fifo, std::fs::read(&lines).unwrap()).unwrap();
        until(&world, follows, "skipped");
        world.signal(follows, signal);
        let (status, log) = world.wait(follows);
        assert_eq!(status.code(), Some(i32::from(exit_code::OK)), "{log}");

        let ends = world.start(&["narrate", &lines, "--name", "ends", "--linger", "1000"]);
        until(&world, ends, "skipped");
        world.signal(ends, signal);
        let (status, log) = world.wait(ends);
        assert_eq!(status.code(), Some(i32::from(exit_code::INTERRUPTED)), "{log}");
        assert!(log.contains("interrupted: "), "{log}");

        let name = path(&world, &format!("recording-{number}"));
        let ends = world.start(&["record", &name, "--seconds", "100000"]);
        eventually("a recording", || Path::new(&name).exists().then_some(()));
        world.signal(ends, signal);
        let (status, log) = world.wait(ends);
        assert_eq!(status.code(), Some(i32::from(exit_code::INTERRUPTED)), "{log}");
        assert!(log.contains("interrupted: 0 messages in "), "{log}");

        let mut piped = world.command(&["report", "-"]);
        piped.stdin(Stdio::piped()).stderr(Stdio::piped());
        let mut piped = piped.spawn().unwrap();
        let mut said = std::io::BufReader::new(piped.stderr.take().unwrap());
        piped.stdin.as_mut().unwrap().write_all(b"not a report\n").unwrap();
        std::io::BufRead::read_line(&mut said, &mut String::new()).unwrap();
        kill_process(Pid::from_raw(piped.id().cast_signed()).unwrap(), signal).unwrap();
        assert_eq!(piped.wait().unwrap().code(), Some(i32::from(exit_code::OK)));

        // A file of reports: it is read to its end, and then nobody is there to hear them.
        let reports = path(&world, &format!("reports-{number}"));
        std::fs::write(&reports, "not a report\n{\"report\": \"docked\"}\n").unwrap();
        let log = File::create(path(&world, "log-report")).unwrap();
        let mut whole = world.command(&["report", "-", "--wait", "1000"]);
        let mut whole = whole.stdin(File::open(&reports).unwrap()).stderr(log).spawn().unwrap();
        let log = path(&world, "log-report");
        eventually("a bad line", || std::fs::read_to_string(&log).ok().filter(|log| log.contains("line 1")));
        kill_process(Pid::from_raw(whole.id().cast_signed()).unwrap(), signal).unwrap();
        assert_eq!(whole.wait().unwrap().code(), Some(i32::from(exit_code::INTERRUPTED)));
    }
}

/// On a full disk, or where nobody reads, what is told on standard error is lost and the command goes on.
#[test]
fn standard_error_that_cannot_be_written_ends_no_command_by_a_panic() {
    let world = World::new("untold");
    let file = world.directory.path().join("reports");
    std::fs::write(&file, "not a report\n").unwrap();
    let full = || File::options().write(true).open("/dev/full").unwrap();
    for (arguments, code) in [
        (&["report", "-"][..], exit_code::INPUT),
        (&["habits", "learn", file.to_str().unwrap()], exit_code::INPUT),
        (&["narrate", "/nowhere/at-all"], exit_code::INPUT),
    ] {
        let mut command = world.command(arguments);
        let status = command.stdin(File::open(&file).unwrap()).stdout(Stdio::null()).stderr(full()).status().unwrap();
        assert_eq!(status.code(), Some(i32::from(code)), "{arguments:?}");
    }
}

#[test]
fn the_doctor_blames_the_part_that_is_wrong() {
    let world = World::new("doctor");
    let output = world.command(&["doctor", "--json", "--scene", "/nowhere/at-all"]).output().unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::CHECK)));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let finding = |check: &str| {
        let findings = report["findings"].as_array().unwrap();
        findings.iter().find(|finding| finding["check"] == check).unwrap().clone()
    };
    let scene = finding("scene");
    assert_eq!(scene["verdict"], "wrong");
    assert!(scene["found"].as_str().unwrap().contains("no scene /nowhere/at-all"), "{scene}");
    assert_eq!(finding("model")["verdict"], "good");
    let messages = finding("messages");
    assert!(messages["found"].as_str().unwrap().contains(world.domain.root().to_str().unwrap()), "{messages}");
}

#[test]
fn a_sensor_log_is_narrated() {
    let mut world = World::new("sensors");
    world.start_daemon();
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    let log = world.directory.path().join("log.tsv");
    let good = std::fs::read_to_string(data.join("sensors.tsv")).unwrap();
    std::fs::write(&log, format!("{good}at noon\tlater\tdoor\tMagnetic\tHall\n")).unwrap();
    let mut command = world.command(&["narrate", "--pace", "0", "--json", "--linger", "100", "--name", "home"]);
    let output =
        command.arg("--sensors").arg(&log).arg("--rules").arg(data.join("sensor-rules.toml")).output().unwrap();
    let outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(outcome, serde_json::json!({"sent": 7, "confirmed": 7, "dropped": 0, "refused": 1}));
    assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("line 12") && said.contains("at noon"), "{said}");
    let node = world.domain.open("test").unwrap();
    assert_eq!(world.status(&node).accepted, 7);
}

#[test]
fn output_into_a_pipe_that_closes_ends_quietly() {
    for arguments in
        [&["completions", "bash"][..], &["config"], &["scene", "show", "apartment-e0", "--json"], &["help"]]
    {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output =
            command.args(arguments).stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(String::from_utf8(output.stderr).unwrap(), "", "{arguments:?}");
    }
}

#[test]
fn output_that_cannot_be_written_is_an_error_and_no_panic() {
    let score = ["score", "--narration", "They sit."];
    for arguments in [&["completions", "bash"][..], &["config"], &["doctor"], &score, &["scene", "show", "studio"]] {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let output = roomcast(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::FAILURE)), "{arguments:?}: {said}");
        assert!(said.contains("standard output: No space left on device"), "{arguments:?}: {said}");
    }
}

#[test]
fn arguments_out_of_range_or_without_effect_are_refused_before_anything_runs() {
    let score = ["score", "--narration", "They sit."];
    let explain = ["explain", "--narration", "They sit."];
    let recording = ["explain", "--recording", "day.mcap"];
    let table2 = ["experiment", "table2"];
    let pareto = ["experiment", "pareto"];
    let import = ["scene", "import", "map.json", "--out", "scene.json"];
    let valetudo = ["scene", "import", "map.json", "--out", "scene.json", "--format", "valetudo"];
    let habits = ["experiment", "habits", "--sensors", "log", "--rules", "rules.toml", "--scene", "studio"];
    let cases: [(&[&str], &[&str]); 45] = [
        (&import, &["--up", "y"]),
        (&import, &["--keep-spellings"]),
        (&import, &["--names", "names.toml"]),
        (&import, &["--rules", "rules.toml"]),
        (&import, &["--token-file", "token"]),
        (&valetudo, &["--up", "y"]),
        (&valetudo, &["--keep-spellings"]),
        (&valetudo, &["--equivalence", "names.txt"]),
        (&habits, &["--items", "nearest"]),
        (&["experiment", "horizon"], &["--restarts", "7"]),
        (&["experiment", "horizon"], &["--room-time", "25"]),
        (&["experiment", "horizon"], &["--disturbance", "in-sight"]),
        (&["experiment", "card", "--shared", "data"], &["--only", "no such title"]),
        (&score, &["--threads", "100000"]),
        (&score, &["--steps", "3"]),
        (&score, &["--effort", "ranking", "--method", "independent"]),
        (&score, &["--deadline-ms", "3"]),
        (&score, &["--effort", "deadline", "--deadline-ms", "0"]),
        (&score, &["--history", "0"]),
        (&score, &["--prior", "1.5"]),
        (&score, &["--prior", "nan"]),
        (&["explain", "--live"], &["--prior", "0.5"]),
        (&recording, &["--continuation", "free"]),
        (&score, &["--history", "99999999999"]),
        (&explain, &["--threads", "257"]),
        (&explain, &["--at", "3"]),
        (&explain, &["--sequence", "3"]),
        (&explain, &["--config", "/nonexistent"]),
        (&explain, &["--root", "/x"]),
        (&explain, &["--live"]),
        (&["explain", "--live"], &["--binding", "p1"]),
        (&["explain", "--live"], &["--at", "3"]),
        (&recording, &["--at", "nan"]),
        (&recording, &["--history", "3"]),
        (&recording, &["--root", "/x"]),
        (&table2, &["--threads", "100000"]),
        (&table2, &["--restarts", "0"]),
        (&table2, &["--pace", "nan"]),
        (&table2, &["--pace=-1"]),
        (&table2, &["--object-time", "nan"]),
        (&table2, &["--stay-time", "0"]),
        (&table2, &["--longest-act", "0"]),
        (&table2, &["--history", "0"]),
        (&pareto, &["--weight", "nan"]),
        (&pareto, &["--weight=-5"]),
    ];
    for (command, more) in cases {
        let mut command = roomcast(command);
        let output = command.args(more).env_remove("ROOMCAST_ROOT").env_remove("ROOMCAST_DOMAIN").output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{command:?}: {said}");
        assert_eq!(output.stdout, b"", "{command:?}");
    }
}

/// What the training writes of a fold, with the shipped model: `held_out` and `trained` are programs.
fn write_fold(folder: &Path, trained: &str, held_out: &str) {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    std::fs::create_dir_all(folder).unwrap();
    for name in ["household.gguf", "household-statistics.json"] {
        std::fs::copy(models.join(name), folder.join(name)).unwrap();
    }
    let files = |name: &str| serde_json::json!({ "files": [format!("programs/{name}")] });
    let splits = serde_json::json!({ "train": files(trained), "test": files(held_out), "sealed": files("c.txt") });
    std::fs::write(folder.join("manifest.json"), serde_json::json!({ "splits": splits }).to_string()).unwrap();
}

/// Folds are pooled, and the sealed split is opened once: what is found is in the file before it is shown.
#[test]
fn folds_are_pooled_and_the_sealed_split_is_opened_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = |below: &str| folder.path().join(below).display().to_string();
    std::fs::create_dir(path("programs")).unwrap();
    let shipped = ["p0-breakfast-and-television", "p1-laundry-and-to-bed", "p2-long-evening"];
    for (name, program) in ["a", "b", "c"].iter().zip(shipped) {
        let from = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("scenes/programs/{program}.txt"));
        std::fs::copy(from, path(&format!("programs/{name}.txt"))).unwrap();
    }
    let run = |command: &str, more: &[&str]| {
        let programs = path("programs");
        let output =
            roomcast(&["experiment", command, "--programs", &programs, "--scene", "studio", "--no-cache", "--json"])
                .args(more)
                .output()
                .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        (output.status.code(), serde_json::from_slice::<serde_json::Value>(&output.stdout).ok(), said)
    };
    let input = Some(i32::from(exit_code::INPUT));

    write_fold(Path::new(&path("folds/fold-1")), "a.txt", "b.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("1 finished fold,") && said.contains("training/run.py"), "{said}");
    write_fold(Path::new(&path("folds/fold-2")), "b.txt", "a.txt");
    let (_, report, said) = run("folds", &["--folds", &path("folds")]);
    let report = report.unwrap_or_else(|| panic!("{said}"));
    assert_eq!((&report[0]["programs"], &report[0]["activities"]), (&2.into(), &2.into()));
    write_fold(Path::new(&path("folds/fold-2")), "a.txt", "b.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("b.txt is held out by two folds"), "{said}");
    write_fold(Path::new(&path("folds/fold-2")), "a.txt", "a.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("so it was not held out"), "{said}");

    let (record, trained, none) = (path("sealed.json"), path("folds/fold-1"), path("programs"));
    let sealed = ["--trained", &trained, "--record", &record, "--places", &none];
    let manifest = path("folds/fold-1/manifest.json");
    let (code, _, said) = run("forecast", &["--manifest", &manifest, "--split", "sealed"]);
    assert!(code == input && said.contains("opened once"), "{said}");
    // A record that cannot be written is found out before the model, which is none here, is looked at.
    let nowhere = path("none/sealed.json");
    let unread = ["--trained", &path("folds/none"), "--record", &nowhere, "--places", &none];
    let (code, _, said) = run("sealed", &unread);
    assert!(code == input && said.contains("cannot be written down") && said.contains("--record"), "{said}");
    let (_, shown, said) = run("sealed", &sealed);
    let shown = shown.unwrap_or_else(|| panic!("{said}"));
    let written = std::fs::read_to_string(&record).unwrap();
    let entries: serde_json::Value = serde_json::from_str(&written).unwrap();
    assert_eq!((entries.as_array().unwrap().len(), &entries[0]["reports"]), (1, &shown));
    let (code, shown, said) = run("sealed", &sealed);
    assert!(code == input && shown.is_none() && said.contains("opened already"), "{said}");
    assert_eq!(std::fs::read_to_string(&record).unwrap(), written);
}

#[test]
fn errors_name_the_file_and_the_remedy_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let empty = file("empty.json", "");
    let graph = file("graph.json", r#"{"nodes": [], "edges": []}"#);
    let day = file("day.txt", "wake_up (06:00 - 06:10)\n\n### wake_up-00.txt\n\n[WALK] <bedroom> (162) [1]\n370.0\n");
    let json = file("model.json", "{\n \"a\": 1}");
    let out = folder.path().join("out.json").to_str().unwrap().to_owned();
    let shipped = "studio, apartment-e0";
    let cases: [(&[&str], &[&str]); 12] = [
        (
            &["scene", "change", "studio", &empty, "--out", &out],
            &["changes /", "empty.json: the text ends too early", "a JSON list"],
        ),
        (&["scene", "change", "studio", "nope", "--out", &out], &["changes nope: cannot be read"]),
        (&["scene", "apply", &empty], &["changes /", "empty.json: the text ends too early"]),
        (&["scene", "draw", "studio", "--scores", "nope"], &["scores nope: cannot be read"]),
        (&["score", "--scene", "nowhere"], &["no scene nowhere", shipped]),
        (&["score", "--program", "nowhere"], &["program nowhere", "p0-breakfast-and-television"]),
        (&["narrate", "p0-breakfast"], &["no file p0-breakfast: ", "p0-breakfast-and-television"]),
        (&["score", "--program", &day], &["day.txt: line 5", "HOMER+", "`roomcast experiment`"]),
        (&["score", "--narration", "[Teleport] <mug> (1)"], &["unknown action `Teleport`", "`walk`"]),
        (&["experiment", "table2", "--scene", "studio", "--scene", "studio"], &["another of the scenes has its name"]),
        (&["model", "check", "nope"], &["model file nope", "check the path"]),
        (&["model", "info", &json], &[r#"starts with "{\n \"", not with"#]),
    ];
    for (arguments, parts) in cases {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && !said.contains(".: "), "{arguments:?}: {said}");
        for part in parts {
            assert_eq!(said.matches(part).count(), 1, "{arguments:?}: {part} in {said}");
        }
    }
    let output = roomcast(&["scene", "check", &graph]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("graph.json: nodes: unknown key") && said.contains("`roomcast scene import`"), "{said}");
    assert!(String::from_utf8(output.stderr).unwrap().contains("1 scene with errors, 0 warnings"));
}

#[test]
fn a_number_that_does_not_fit_is_answered_with_what_does() {
    let cases: [(&[&str], &str); 13] = [
        (&["narrate", "--pace", "-1"], "give a number from 0 to 1000000000"),
        (&["narrate", "--pace", "soon"], "give a number from 0 to 1000000000"),
        (&["narrate", "--speed", "-2"], "give a number above 0, at most 1000000000"),
        (&["narrate", "--person", "-1"], "give a number from 0 to 4294967294, or a name"),
        (&["replay", "day.mcap", "--speed", "fast"], "give a number above 0"),
        (&["replay", "day.mcap", "--linger", "-1"], "give a whole number from 0"),
        (&["record", "day.mcap", "--seconds", "0"], "give a whole number from 1"),
        (&["planner", "--room-time", "-1"], "give a number from 0 to 1000000000"),
        (&["top", "--snapshots", "-1"], "give a whole number from 0"),
        (&["score", "--prior", "-0.5", "--narration", "x"], "give a number from 0 to 1"),
        (&["score", "--threads", "many", "--narration", "x"], "give a whole number from 0 to"),
        (&["scene", "draw", "studio", "--scale", "-1"], "give a number from 0.1 to 8"),
        (&["experiment", "table2", "--seed", "-1"], "give a whole number from 0"),
    ];
    for (arguments, remedy) in cases {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{arguments:?}: {said}");
        assert!(said.contains(remedy), "{arguments:?}: {said}");
    }
    // What has no effect is refused, too.
    for arguments in [
        &["narrate", "--mqtt", "mqtt://127.0.0.1", "--rules", "rules.toml", "--speed", "2"][..],
        &["narrate", "--fifo", "/tmp/narration", "--speed", "2"],
    ] {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{arguments:?}: {said}");
        assert!(said.contains("cannot be used with"), "{arguments:?}: {said}");
    }
}

#[test]
fn recordings_that_cannot_be_are_refused_before_anything_is_written() {
    let world = World::new("record-where");
    let ended = |arguments: &[&str]| {
        let output = world.command(arguments).current_dir(world.directory.path()).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = ended(&["record", "-", "--seconds", "1"]);
    assert_eq!(code, Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(said.contains("not to standard output") && !world.directory.path().join("-").exists(), "{said}");
    let (code, said) = ended(&["record", "night.mcap", "--profile", "nonsense"]);
    assert_eq!(code, Some(i32::from(exit_code::USAGE)), "{said}");
    assert!(
        said.contains("roomcast") && said.contains("ros2") && !world.directory.path().join("night.mcap").exists(),
        "{said}"
    );
    std::fs::write(world.directory.path().join("day.mcap"), "precious").unwrap();
    let (there, said) = ended(&["record", "day.mcap", "--seconds", "1"]);
    assert!(said.contains("exists already"), "{said}");
    let (also, said) = ended(&["record", "day.mcap", "--profile", "ros2", "--seconds", "1"]);
    assert!(also == there && said.contains("exists already"), "{said}");
    assert_eq!(std::fs::read(world.directory.path().join("day.mcap")).unwrap(), b"precious");
    let (missing, said) = ended(&["replay", "night.mcap"]);
    assert!(said.contains("night.mcap"), "{said}");
    assert_eq!((there, missing), (Some(i32::from(exit_code::INPUT)), Some(i32::from(exit_code::INPUT))));
}

#[test]
fn a_configuration_is_held_to_what_this_machine_has() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("roomcast.toml");
    let check = |text: &str| {
        std::fs::write(&path, text).unwrap();
        let mut command = roomcast(&["config", "--check", path.to_str().unwrap()]);
        let output = command.env_remove("ROOMCAST_ROOT").env_remove("ROOMCAST_DOMAIN").output().unwrap();
        (output.status.success(), String::from_utf8(output.stderr).unwrap())
    };
    assert_eq!(check("[scene]\npath = \"ward\"\n"), (true, String::new()));
    for (text, part) in [
        ("[scene]\npath = \"/nowhere/flat.json\"", "no scene /nowhere/flat.json"),
        ("[model]\npath = \"/nowhere/model.gguf\"", "/nowhere/model.gguf"),
        ("[model]\ncores = [100000]", "model.cores names core 100000"),
        (&format!("[model]\nsha256 = \"{}\"", "0".repeat(64)), "model.sha256 pins 0000"),
    ] {
        let (fine, said) = check(text);
        assert!(!fine && said.contains(part), "{text}: {said}");
    }
    // What a home names is held to what there is, too, and all is said at once.
    let text = "[scene]\npath = \"studio\"\n[robot.segments]\nkichen = \"16\"\n";
    let mqtt = "[mqtt]\nbroker = \"10.0.0.5\"\nrules = \"home.rules.toml\"\n";
    let (fine, said) = check(&format!("{text}{mqtt}"));
    let rules = folder.path().join("home.rules.toml");
    for part in [
        "names the room \"kichen\", which the map does not have: write \"kitchen\"; the map's rooms are kitchen, main-room, bathroom",
        "mqtt.broker: \"10.0.0.5\" is no broker: give mqtt://HOST[:PORT]",
        "here mqtt://10.0.0.5:1883",
        &format!("failed to read {}: No such file", rules.display()),
        "correct mqtt.rules in the configuration; roomcast init writes rules",
        "3 things are wrong",
    ] {
        assert!(!fine && said.contains(part), "{part} in {said}");
    }
    std::fs::write(rules, "[[rule]]\ntopic = \"a\"\nsay = \"They sit.\"\n").unwrap();
    let good = format!("{text}{mqtt}").replace("kichen", "kitchen").replace("10.0.0.5", "mqtt://10.0.0.5");
    assert_eq!(
        check(&good),
        (true, String::new()),
        "rules lie beside their configuration, whatever the working folder"
    );
}

#[test]
fn maps_that_are_odd_are_told_of() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let whole = include_str!("data/two_rooms.json");
    let mut odd: serde_json::Value = serde_json::from_str(whole).unwrap();
    odd["doors"][0]["position_m"] = serde_json::json!([90, 90, 1]);
    odd["items"][0]["position_m"] = serde_json::json!([90, 90, 1]);
    let odd = file("odd.json", &odd.to_string());
    let output = roomcast(&["scene", "check", &odd, &file("half.json", &whole[..whole.len() / 2])]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(said.contains("doors[0] (") && said.contains("m from \"kitchen\""), "{said}");
    assert!(said.contains("items[0] (\"mug-1\"): position_m lies"), "{said}");
    assert!(said.contains("half.json: ends too early, in line"), "{said}");

    let polygon =
        r#"{"rooms": [{"name": "studio", "vertices": [[0, 0], [4, 0], [4, 3], [2, 4], [0, 3]]}], "objects": []}"#;
    let map = file("polygon.json", polygon);
    let out = folder.path().join("out.json");
    let arguments = ["scene", "import", "--format", "open-vocabulary", &map, "--out", out.to_str().unwrap()];
    let output = roomcast(&arguments).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let scene: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&out).unwrap()).unwrap();
    assert_eq!((&scene["version"], scene["rooms"][0]["footprint"][0].as_array().map(Vec::len)), (&2.into(), Some(5)));
}

/// Every example of the manual is taken by a real daemon.
#[test]
fn the_examples_of_json_lines_are_narrated() {
    let manual = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/json-lines.md")).unwrap();
    let blocks = manual.split("```json narration\n").skip(1);
    let lines: String = blocks.map(|block| block.split("```").next().unwrap()).collect();
    let mut world = World::new("json-lines");
    world.start_daemon();
    let (code, outcome) = world.narrate("manual", &lines);
    let count = lines.lines().count();
    assert_eq!((code, &outcome["sent"], &outcome["refused"]), (0, &count.into(), &0.into()), "{outcome}");
    assert!(count >= 8);
}

/// Waits until the recorder has its last port; a narrator that has just left may count as a listener for a while.
fn recorder_listens(node: &Node) {
    recorders_listen(node, 1);
}

/// How far recorded scores are from those that were computed again, as `explain --recording` says it.
fn difference_of(explained: &str) -> f64 {
    let said = explained.split("differ by at most ").nth(1).unwrap().split_whitespace().next().unwrap();
    said.trim_end_matches('.').parse().unwrap()
}

#[test]
fn a_recorded_run_replays_to_the_same_narration_and_scores_and_explains_any_of_them() {
    let mut world = World::new("record");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    // What was said before the recording belongs to its windows.
    assert_eq!(world.narrate("early", "They wake up.\nThey walk to the bathroom.\n").0, 0);
    let file = world.directory.path().join("day.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    let lines = "They walk to the kitchen.\nThey open the fridge.\nThey grab the milk.\nThey close the fridge.\n";
    for (number, line) in lines.lines().enumerate() {
        assert_eq!(world.narrate(&format!("camera-{number}"), line).0, 0);
    }
    world.signal(recorder, Signal::TERM);
    let (status, log) = world.wait(recorder);
    assert!(status.success(), "{log}");

    let recording = roomcast_services::recording::read(&file).unwrap();
    let narration = |recording: &roomcast_services::recording::Recording| -> Vec<Vec<u8>> {
        let messages = recording.messages.iter().map(|(_, message)| message);
        messages.filter(|m| m.topic() == NarrationV1::SERVICE.name).map(|m| m.to_bytes()).collect()
    };
    let last_scores =
        |recording: &roomcast_services::recording::Recording| recording.moment(None, None).unwrap().scores;
    let recorded = last_scores(&recording);
    let told = recording.messages.iter().filter_map(|(_, message)| match message {
        roomcast_services::recording::Recorded::Narration(narration) => Some(narration.text().to_owned()),
        _ => None,
    });
    assert_eq!(told.collect::<Vec<_>>().join("\n") + "\n", lines, "{log}");
    assert_eq!(recorded.window, 6);

    // Explained from the file alone, by its number and by its time.
    let explain = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        let output = command.args(["explain", "--recording", file.to_str().unwrap()]).args(more).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    let text = explain(&["--top", "3"]);
    assert!(text.contains("They wake up.") && text.contains("They close the fridge."), "{text}");
    assert!(difference_of(&text) < 5e-3, "{text}");
    let earlier = explain(&["--sequence", &(recorded.sequence - 1).to_string()]);
    assert!(earlier.contains("They grab the milk.") && !earlier.contains("They close the fridge."), "{earlier}");

    // Into a fresh domain: the same narration, and scores that agree as far as the scorer's tolerance goes.
    let mut other = World::new("replay");
    other.start_daemon();
    let other_node = other.domain.open("test").unwrap();
    let other_scores = other_node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&other_scores, "the first scores", |_| true);
    let early = "They wake up.\nThey walk to the bathroom.\n";
    assert_eq!(other.narrate("early", early).0, 0);
    let second = other.directory.path().join("again.mcap");
    let recorder = other.start(&["record", second.to_str().unwrap()]);
    recorder_listens(&other_node);
    let replayed = other.command(&["replay", file.to_str().unwrap(), "--speed", "50"]).output().unwrap();
    assert!(replayed.status.success(), "{replayed:?}");
    let said = String::from_utf8(replayed.stderr).unwrap();
    assert!(said.contains(&format!("4 of {} messages replayed", recording.messages.len())), "{said}");
    assert!(
        said.contains("the others are scores, forecasts, decisions and reports") && !said.contains("before"),
        "{said}"
    );
    let last = scores_with(&other_scores, "all of it", |scores| includes(scores, "camera-3", 1));
    other.signal(recorder, Signal::TERM);
    assert!(other.wait(recorder).0.success());
    let again = roomcast_services::recording::read(&second).unwrap();
    assert_eq!(narration(&again), narration(&recording), "bit for bit");
    assert_eq!(last.window, recorded.window);
    for (a, b) in recorded.rooms().iter().zip(last.rooms()) {
        assert!((a.probability - b.probability).abs() < 5e-3 && a.id == b.id, "{} {}", a.probability, b.probability);
    }
    let twice = other.command(&["replay", file.to_str().unwrap(), "--speed", "50"]).output().unwrap();
    let said = String::from_utf8(twice.stderr).unwrap();
    assert!(said.contains("the daemon has taken in 4 of them before and takes none twice"), "{said}");
}

/// A narrator that runs on keeps what it said for whoever joins late, also what the home has forgotten since.
#[test]
fn a_recording_has_nothing_of_who_was_forgotten_before_it_began() {
    let mut world = World::new("forgotten");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let narration = node.publisher::<NarrationV1>().unwrap();
    let mut sequence = 0;
    let mut tell = |name: &str, text: &str| {
        sequence += 1;
        let message = NarrationV1::new(narration_kind::SENTENCE, text).unwrap();
        let source = sequence::source_of_name("test");
        let person_name = roomcast_ipc::text::encode("name", name).unwrap();
        narration.send(&NarrationV1 { source, epoch: 1, sequence, person_name, ..message }).unwrap();
        scores_with(&scores, text, |scores| includes(scores, "test", sequence))
    };
    tell("Bob", "They open the fridge.");
    tell("Ada", "They sit on the sofa.");
    let forgotten = world.command(&["person", "forget", "bob"]).output().unwrap();
    assert!(forgotten.status.success(), "{forgotten:?}");
    let file = world.directory.path().join("later.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    // What a narrator has to say next hands late listeners the history first.
    tell("Ada", "They stand up.");
    world.signal(recorder, Signal::TERM);
    let (status, log) = world.wait(recorder);
    assert!(status.success(), "{log}");
    let recording = roomcast_services::recording::read(&file).unwrap();
    let told = recording.messages.iter().filter_map(|(_, message)| match message {
        roomcast_services::recording::Recorded::Narration(narration) => Some(narration.text().to_owned()),
        _ => None,
    });
    assert_eq!(told.collect::<Vec<_>>(), ["They stand up."], "{log}");
    let whole = String::from_utf8_lossy(&std::fs::read(&file).unwrap()).to_lowercase();
    let moments = recording.moments.iter().map(|moment| serde_json::to_string(moment).unwrap().to_lowercase());
    assert!(!whole.contains("bob") && moments.filter(|text| text.contains("bob")).count() == 0);
}

/// What was answered before somebody was forgotten is told again to whoever asks the same question again, without them.
#[test]
fn who_is_forgotten_is_in_no_answer_that_is_given_again() {
    let mut world = World::new("answered");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let port = node.question_port(question::HABITS).unwrap();
    let ask = |question: &str| port.ask(question, Duration::from_secs(20)).unwrap();
    let lines = "{\"person\": \"ada\", \"text\": \"They open the fridge.\"}\n".repeat(3);
    assert_eq!(world.narrate("camera", &lines).0, 0);
    eventually("something is learned of her", || ask(r#"{"ask": "show"}"#).contains("ada").then_some(()));
    let question = r#"{"ask": "forget", "id": "7", "who": "nobody"}"#;
    let first = ask(question);
    assert!(first.contains("ada") && first == ask(question), "{first}");
    let forgotten = world.command(&["person", "forget", "ada"]).output().unwrap();
    assert!(forgotten.status.success(), "{forgotten:?}");
    let again = ask(question);
    assert!(!again.contains("ada") && again.contains("nothing was learned of"), "{again}");
}

/// Waits until so many recorders have their last port.
fn recorders_listen(node: &Node, count: usize) {
    let reports = node.publisher::<RobotReportV1>().unwrap();
    eventually("the recorders listen", || {
        let listeners = reports.listeners();
        (listeners.iter().filter(|name| *name == "roomcast-record").count() == count).then_some(())
    });
}

/// The messages of a file that was written for ROS 2, by topic: type, when it was made, bytes.
fn of_ros2(bytes: &[u8]) -> std::collections::BTreeMap<String, Vec<(String, u64, Vec<u8>)>> {
    let mut topics = std::collections::BTreeMap::<_, Vec<_>>::new();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("ros2msg", "cdr"));
        assert!(message.channel.metadata["topic_type_hash"].starts_with("RIHS01_"));
        assert!(message.channel.metadata["offered_qos_profiles"].contains("reliability: 1"));
        let entry = (schema.name.clone(), message.publish_time, message.data.to_vec());
        topics.entry(message.channel.topic.clone()).or_default().push(entry);
    }
    topics
}

/// Two recorders hear the same: what ROS 2 reads in the one file is what the other, which is replayed, has.
#[test]
fn a_recording_for_ros_2_says_what_was_narrated_scored_decided_and_reported() {
    use roomcast_ros2::content::{of_all, of_one};
    use roomcast_ros2::types::{Classification, Header, MarkerArray, Text, decode};
    use roomcast_ros2::words;
    use roomcast_services::recording::Recorded;

    let mut world = World::new("record-ros2");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let path = |name: &str| world.directory.path().join(name).to_str().unwrap().to_owned();
    let (own, theirs) = (path("own.mcap"), path("theirs.mcap"));
    let recorders = [world.start(&["record", &own]), world.start(&["record", "--profile", "ros2", &theirs])];
    recorders_listen(&node, 2);
    let planner = world.start(&["planner", "--room-time", "0.2"]);
    let lines = [
        r#"{"person": "Ada", "text": "They walk to the kitchen."}"#,
        r#"{"person": "Ada", "text": "[Grab] <mug> (1)"}"#,
        "Ada opens the fridge.",
    ];
    let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
    assert_eq!(world.narrate("camera", &lines).0, 0);
    let reported = world.command(&["report", "started", "--room", "kitchen", "--note", "all well"]).output().unwrap();
    assert!(reported.status.success(), "{reported:?}");
    // Whoever speaks ends first, so that both hear the same end.
    for process in [planner, daemon].into_iter().chain(recorders) {
        world.signal(process, Signal::TERM);
        let (status, log) = world.wait(process);
        assert!(status.success(), "{log}");
    }

    let bytes = std::fs::read(&theirs).unwrap();
    let profile = mcap::read::LinearReader::new(&bytes).unwrap().find_map(|record| match record.unwrap() {
        mcap::records::Record::Header(header) => Some(header.profile),
        _ => None,
    });
    assert_eq!(profile.as_deref(), Some("ros2"));
    let topics = of_ros2(&bytes);
    let kinds: Vec<_> = topics.iter().map(|(topic, messages)| (topic.as_str(), messages[0].0.as_str())).collect();
    let (text, rooms) = ("std_msgs/msg/String", "vision_msgs/msg/Classification");
    assert_eq!(
        kinds,
        [
            ("/roomcast/decision", text),
            ("/roomcast/markers", "visualization_msgs/msg/MarkerArray"),
            ("/roomcast/narration", text),
            ("/roomcast/person/p_ada", rooms),
            ("/roomcast/report", text),
            ("/roomcast/rooms", rooms),
        ]
    );
    let texts = |topic: &str| -> Vec<String> {
        topics[topic].iter().map(|(_, _, bytes)| decode::<Text>(bytes).unwrap().data).collect()
    };
    let narrated = ["Ada: They walk to the kitchen.", "Ada: They grab the mug.", "Ada opens the fridge."];
    assert_eq!(texts("/roomcast/narration"), narrated);
    assert_eq!(texts("/roomcast/report"), ["robot has begun to work in kitchen: all well"]);

    let own = roomcast_services::recording::read(Path::new(&own)).unwrap();
    let decided = own.messages.iter().filter_map(|(_, message)| match message {
        Recorded::Decision(decision) => Some(words::decision(decision, "robot").data),
        _ => None,
    });
    let decided: Vec<_> = decided.collect();
    assert_eq!(texts("/roomcast/decision"), decided);
    assert!(decided[0].starts_with("robot goes to ") && decided[0].contains(": "), "{decided:?}");
    let classified = |topic: &str| -> Vec<Classification> {
        let messages = topics[topic].iter();
        messages
            .map(|(_, made, bytes)| {
                let told: Classification = decode(bytes).unwrap();
                assert_eq!(told.header, Header::of_unix_ns(*made, "map"));
                told
            })
            .collect()
    };
    let scored = own.messages.iter().filter_map(|(_, message)| match message {
        Recorded::RoomScores(scores) => Some(of_all(scores, Header::of_unix_ns(scores.computed_unix_ns, "map"))),
        _ => None,
    });
    assert_eq!(classified("/roomcast/rooms"), scored.collect::<Vec<_>>());
    let of_persons = own.messages.iter().filter_map(|(_, message)| match message {
        Recorded::PersonScores(scores) => Some(scores),
        _ => None,
    });
    let of_persons = of_persons
        .flat_map(|scores| scores.persons().iter().map(|person| of_one(scores, person, Header::default()).results));
    let ada: Vec<_> = classified("/roomcast/person/p_ada").into_iter().map(|told| told.results).collect();
    assert_eq!(ada, of_persons.collect::<Vec<_>>());
    let rooms = classified("/roomcast/rooms");
    for (_, made, bytes) in &topics["/roomcast/markers"] {
        let drawn: MarkerArray = decode(bytes).unwrap();
        let of = rooms.iter().rfind(|rooms| rooms.header == Header::of_unix_ns(*made, "map")).unwrap();
        let names = drawn.markers.iter().filter(|marker| !marker.text.is_empty());
        assert_eq!(names.count(), of.results.len());
    }

    // It is for others: nothing here reads it as its own.
    for arguments in [&["replay", &theirs][..], &["explain", "--recording", &theirs]] {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "{said}");
        assert!(
            said.contains("has the profile \"ros2\", and only those of the profile \"roomcast\" are read"),
            "{said}"
        );
    }
}

/// Several persons, one of whom only a presence is known, one who left, and a window that an hour's silence ended.
#[test]
fn a_recorded_household_is_explained_by_name() {
    let mut world = World::new("record-home");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let long_ago = roomcast_ipc::clock::unix_ns() as f64 / 1e9 - 7_200.0;
    let early = format!(
        r#"{{"person": "ada", "text": "They lie on the bed.", "observed_unix_s": {long_ago}}}
{{"person": "ben", "presence": "present"}}
{{"person": "cleo", "text": "They wash the dishes."}}
"#
    );
    assert_eq!(world.narrate("early", &early).0, 0);
    let renamed = world.command(&["person", "rename", "cleo", "Cleopatra"]).output().unwrap();
    assert!(renamed.status.success(), "{renamed:?}");
    let file = world.directory.path().join("home.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    let lines = [
        r#"{"person": "ada", "text": "They open the fridge."}"#,
        r#"{"person": "cleo", "text": "They dry the dishes."}"#,
        r#"{"person": "Dora", "text": "They sit on the sofa."}"#,
        "Dora leaves the house.",
    ];
    for (number, line) in lines.iter().enumerate() {
        assert_eq!(world.narrate(&format!("camera-{number}"), &format!("{line}\n")).0, 0);
    }
    world.signal(recorder, Signal::TERM);
    let (status, log) = world.wait(recorder);
    assert!(status.success(), "{log}");
    let explain = |more: &[&str]| explain_recording(&file, more);
    let recording = roomcast_services::recording::read(&file).unwrap();
    let last = recording.moment(None, None).unwrap().scores;
    for sequence in last.sequence - 3..=last.sequence {
        let text = explain(&["--sequence", &sequence.to_string()]);
        assert!(difference_of(&text) < 5e-3, "scores {sequence}: {text}");
        assert!(!text.contains("They contain"), "scores {sequence}: {text}");
    }
    let text = explain(&[]);
    assert!(text.contains("Cleopatra") && !text.contains("They lie on the bed."), "{text}");
    assert!(explain(&["--person", "cleopatra"]).contains("They dry the dishes."));
}

/// What `explain` says of a recording.
fn explain_recording(file: &Path, more: &[&str]) -> String {
    let output = roomcast(&["explain", "--recording", file.to_str().unwrap()]).args(more).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Sentences that name nobody are of whom the daemon took them for, also where nobody was ever named.
#[test]
fn a_recorded_sentence_without_a_person_is_explained_as_the_daemon_took_it() {
    let early = [
        "{\"text\": \"They open the fridge.\", \"person\": \"ada\"}\n{\"text\": \"They take a shower.\", \"person\": \"ben\"}\n",
        "{\"presence\": \"present\", \"person\": \"ada\"}\n{\"presence\": \"away\", \"person\": \"ben\"}\n",
    ];
    for (round, early) in early.into_iter().enumerate() {
        let mut world = World::new(&format!("record-by-fit-{round}"));
        world.start_daemon();
        let node = world.domain.open("test").unwrap();
        let scores = node.subscriber::<RoomScoresV1>().unwrap();
        scores_with(&scores, "the first scores", |_| true);
        assert_eq!(world.narrate("early", early).0, 0);
        let file = world.directory.path().join("home.mcap");
        let recorder = world.start(&["record", file.to_str().unwrap()]);
        recorder_listens(&node);
        let lines = ["They grab the milk.", "They dry themselves with the towel.", "They close the fridge."];
        for (number, line) in lines.iter().enumerate() {
            assert_eq!(world.narrate(&format!("camera-{number}"), &format!("{line}\n")).0, 0);
        }
        world.signal(recorder, Signal::TERM);
        let (status, log) = world.wait(recorder);
        assert!(status.success(), "{log}");
        let explain = |more: &[&str]| explain_recording(&file, more);
        let text = explain(&[]);
        assert!(difference_of(&text) < 5e-3 && !text.contains("They contain"), "{text}");
        let of_ada = explain(&["--person", "ada"]);
        let is_hers = |line: &str| of_ada.contains(line);
        assert!(is_hers("They grab the milk.") && is_hers("They close the fridge."), "{of_ada}");
    }
}

#[test]
fn latency_measures_every_path_beside_its_yardsticks() {
    let arguments = ["latency", "--samples", "5", "--pause", "1", "--scorer", "none", "--load", "idle", "--json"];
    let output = roomcast(&arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let paths: Vec<_> = rows.iter().map(|row| row["path"].as_str().unwrap()).collect();
    assert_eq!(paths, ["event-to-scores", "event-to-decision", "bare-iceoryx2", "unix-socket", "eventfd"]);
    for row in rows {
        assert_eq!(
            (row["n"].as_u64(), row["scorer"].as_str(), row["load"].as_str()),
            (Some(5), Some("none"), Some("idle"))
        );
        let at: Vec<_> =
            ["p50_ns", "p90_ns", "p99_ns", "p999_ns", "max_ns"].map(|key| row[key].as_u64().unwrap()).into();
        assert!(at[0] > 0 && at.is_sorted(), "{row}");
    }
    let refused = roomcast(&["latency", "--samples", "0"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(i32::from(exit_code::USAGE)));
}

/// The first screen of the README shows one command and what it prints: both are run again.
#[test]
fn the_readme_shows_what_the_command_prints() {
    let readme = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).unwrap();
    let block = |kind: &str| readme.split_once(kind).unwrap().1.split_once("```").unwrap().0.trim().to_owned();
    let narration = block("```sh").split('"').nth(1).unwrap().to_owned();
    let output = roomcast(&["score", "--narration", &narration]).output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    // Room and probability; processors round differently in the last place.
    let rows = |text: &str| -> Vec<(String, f64)> {
        let rows = text.lines().filter_map(|line| line.split_once(" %"));
        let rows = rows.filter_map(|(row, _)| {
            row.rsplit_once("  ").map(|(room, share)| (room.trim().to_owned(), share.trim().parse()))
        });
        rows.filter_map(|(room, share)| share.ok().map(|share| (room, share))).collect()
    };
    let (shown, found) = (rows(&block("```text")), rows(&printed));
    assert!(!shown.is_empty() && found.len() >= shown.len(), "{printed}");
    for ((room, shown), (found_room, found)) in shown.iter().zip(&found) {
        assert!(room == found_room && (shown - found).abs() < 1.0, "{room} {shown} %, now {found_room} {found} %");
    }
}

/// What `roomcast report` ends with, and what it says.
fn report(world: &World, arguments: &[&str], input: &str) -> (i32, String) {
    let mut command = world.command(&[&["report"], arguments].concat());
    let mut child = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

/// The next decision that satisfies a condition.
fn decision_with(decisions: &Subscriber<DecisionV1>, what: &str, holds: impl Fn(&DecisionV1) -> bool) -> DecisionV1 {
    eventually(what, || {
        let next = decisions.receive().unwrap()?.unwrap();
        holds(&next).then_some(next)
    })
}

/// The robot's own word says what is done, and the round outlives the planner.
#[test]
fn a_planner_that_is_killed_in_a_round_goes_on_with_what_its_robot_has_done() {
    let mut world = World::new("robot");
    let config = world.directory.path().join("roomcast.toml");
    let text = format!(
        "[scene]\npath = \"apartment-e0\"\n[daemon]\nstate = {:?}\n[planner]\nrobot = \"vacuum\"\ninterrupt = false\n",
        world.state()
    );
    std::fs::write(&config, text).unwrap();
    let config = config.to_str().unwrap();
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    world.start(&["daemon", "--config", config]);
    let planner = world.start(&["planner", "--config", config]);
    let first = decision_with(&decisions, "the first decision", |decision| decision.action == action::GO);
    assert!(!first.has(decision_flags::REPORTED));
    let (code, said) = report(
        &world,
        &["finished", "--config", config, "--room", first.to(), "--decision", &first.sequence.to_string()],
        "",
    );
    assert_eq!((code, said.as_str()), (0, ""));
    let second = decision_with(&decisions, "the second decision", |decision| decision.sequence > first.sequence);
    assert!(second.has(decision_flags::REPORTED) && second.covered.count_ones() == 1, "{}", second.reason());
    // The file is written after the decision.
    let kept = format!("planner-{:016x}.json", sequence::source_of_name("vacuum"));
    let second_is_kept = |text: &str| text.contains(second.to()) && text.contains(first.to());
    eventually("the round is kept", || {
        std::fs::read_to_string(world.state().join(&kept)).ok().filter(|text| second_is_kept(text))
    });

    world.children[planner].child.kill().unwrap();
    world.children[planner].child.wait().unwrap();
    world.start(&["planner", "--config", config]);
    let again = decision_with(&decisions, "the next planner's decision", |decision| decision.epoch != first.epoch);
    assert_eq!((again.to(), again.covered), (second.to(), second.covered), "{}", again.reason());
    assert!(again.has(decision_flags::REPORTED), "{}", again.reason());

    // As lines: one is malformed, the others count, and the answer may name the decision of the planner before.
    let lines = format!(
        "{{\"report\": \"done\"}}\n{{\"report\": \"position\", \"position\": [1, 1, 0]}}\n\
         {{\"report\": \"finished\", \"decision\": {}, \"battery\": 0.1}}\n",
        second.sequence
    );
    let (code, said) = report(&world, &["-", "--config", config], &lines);
    assert_eq!(code, i32::from(exit_code::INPUT), "{said}");
    assert!(said.contains("line 1: report: unknown word `done`, expected one of"), "{said}");
    let third = decision_with(&decisions, "the robot charges", |decision| decision.sequence > again.sequence);
    assert_eq!((third.action, third.covered.count_ones()), (action::PAUSE, 2), "{}", third.reason());
    let (code, _) = report(&world, &["battery", "--config", config, "--battery", "0.9"], "");
    assert_eq!(code, 0);
    let fourth = decision_with(&decisions, "the robot is ready", |decision| decision.sequence > third.sequence);
    assert_eq!((fourth.action, fourth.covered), (action::GO, third.covered), "{}", fourth.reason());
}

/// Names of participants are ASCII; those of robots are not.
#[test]
fn a_robot_may_have_any_name() {
    let mut world = World::new("umlaut");
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let config = world.directory.path().join("roomcast.toml");
    std::fs::write(&config, "[planner]\nrobot = \"Staubi Ä\"\n").unwrap();
    let config = config.to_str().unwrap();
    world.start(&["planner", "--config", config]);
    // Without a daemon it says that it has no scores.
    let first = decision_with(&decisions, "the first decision", |_| true);
    assert_eq!(first.robot_name(), "Staubi Ä");
    let said = report(&world, &["docked", "--config", config], "");
    assert_eq!(said, (0, String::new()));
    let (code, said) = report(&world, &["docked", "--robot", "Staubi Ö", "--wait", "0.1"], "");
    assert_eq!(code, i32::from(exit_code::IPC), "{said}");
    assert!(said.contains("but one of `Staubi Ä`: give --robot 'Staubi Ä'"), "{said}");
}

#[test]
fn a_report_that_nobody_can_hear_or_understand_says_so() {
    let mut world = World::new("report");
    let (code, said) = report(&world, &["finished", "--wait", "0.1"], "");
    assert_eq!(code, i32::from(exit_code::IPC), "{said}");
    assert!(said.contains("nobody listens to 1 report of the robot `robot`"), "{said}");
    let other = world.domain.open("other").unwrap();
    let reports = other.subscriber::<RobotReportV1>().unwrap();
    let reports_port = other.publisher::<RobotReportV1>().unwrap();
    let mut command = world.command(&["report", "docked", "--wait", "0.1", "--note", "home"]);
    let docked = command.stderr(Stdio::piped()).spawn().unwrap();
    assert_eq!(eventually("the report", || reports.newest().unwrap()).note(), "home");
    let output = docked.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("no planner of the robot `robot`"), "{said}");
    // A planner of another robot hears nothing of this one.
    world.start(&["planner", "--robot", "vacuum"]);
    eventually("the planner listens", || (reports_port.subscribers() > 1).then_some(()));
    let (code, said) = report(&world, &["finished", "--wait", "0.1"], "");
    assert_eq!(code, i32::from(exit_code::IPC), "{said}");
    assert!(said.contains("but one of `vacuum`: give --robot 'vacuum'"), "{said}");
    for (arguments, code, part) in [
        (&["battery"][..], exit_code::INPUT, "needs `battery`: give 0 (empty) to 1 (full)"),
        (&["finishd"], exit_code::USAGE, "[possible values: position, started, finished"),
        (&["docked", "--battery", "80"], exit_code::USAGE, "give a number from 0 to 1"),
        (&["position", "--position", "1,2"], exit_code::USAGE, "give three numbers in metres"),
        (&["-", "--room", "hall"], exit_code::USAGE, "--room is for one report"),
    ] {
        let (found, said) = report(&world, arguments, "");
        assert_eq!(found, i32::from(code), "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?}: {said}");
    }
}

/// What `roomcast habits` answers, and its exit code.
fn habits(world: &World, arguments: &[&str]) -> (i32, serde_json::Value, String) {
    let output = world.command(&[&["habits"], arguments].concat()).output().unwrap();
    let answer = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
}

/// Observations of all persons that habits were learned from.
fn learned(world: &World) -> f64 {
    let (code, answer, errors) = habits(world, &["show", "--json"]);
    assert_eq!(code, 0, "{errors}");
    answer["persons"].as_array().unwrap().iter().map(|person| person["observations"].as_f64().unwrap()).sum()
}

/// However a daemon ends, and whatever became of its file, it begins again, and has learned each observation once.
#[test]
fn habits_are_learned_once_over_kills_and_damage() {
    const WALK: &str = "They open the fridge.\nThey grab the kettle.\nThey sit on the sofa.\nThey go to bed.\n";
    let mut world = World::new("habits");
    let config = world.directory.path().join("roomcast.toml");
    std::fs::write(&config, "[habits]\nsave_s = 1.0\n").unwrap();
    let (config, state) = (config.to_str().unwrap().to_owned(), world.state());
    let start = |world: &mut World| world.start(&["daemon", "--config", &config, "--state", state.to_str().unwrap()]);
    let file = world.state().join("habits");
    let mut daemon = start(&mut world);
    assert_eq!(world.narrate("one", WALK).0, 0);
    let once = eventually("it is learned", || Some(learned(&world)).filter(|learned| *learned > 2.0));
    for number in 2..5_u32 {
        // Before and after it was written.
        if number % 2 == 0 {
            eventually("it is written", || file.exists().then_some(()));
        }
        world.signal(daemon, Signal::KILL);
        world.wait(daemon);
        daemon = start(&mut world);
        assert_eq!(learned(&world), f64::from(number - 1) * once);
        assert_eq!(world.narrate(&format!("walk-{number}"), WALK).0, 0);
        eventually("all is learned", || (learned(&world) == f64::from(number) * once).then_some(()));
    }
    world.signal(daemon, Signal::TERM);
    assert!(world.wait(daemon).0.success());
    let mode = std::os::unix::fs::PermissionsExt::mode(&std::fs::metadata(&file).unwrap().permissions());
    assert_eq!(mode & 0o777, 0o600);
    let whole = std::fs::read(&file).unwrap();
    assert!(!String::from_utf8_lossy(&whole).contains("They"), "words of things, no sentences");
    daemon = start(&mut world);
    assert_eq!(learned(&world), 4.0 * once);

    // Half of the file: it is set aside, and the journal teaches what it holds.
    world.signal(daemon, Signal::KILL);
    world.wait(daemon);
    std::fs::write(&file, &whole[..whole.len() / 2]).unwrap();
    daemon = start(&mut world);
    assert_eq!(learned(&world), 4.0 * once);
    assert!(world.state().join("habits.damaged").exists());
    // Forgotten is forgotten over a kill, also what was set aside.
    assert_eq!(habits(&world, &["forget", "--person", "eve"]).0, 3);
    let (code, _, errors) = habits(&world, &["forget", "--all"]);
    assert_eq!((code, learned(&world)), (0, 0.0), "{errors}");
    assert!(!world.state().join("habits.damaged").exists());
    world.signal(daemon, Signal::KILL);
    let (_, log) = world.wait(daemon);
    assert!(log.contains("the habits file cannot be used"), "{log}");
    start(&mut world);
    assert_eq!(learned(&world), 0.0);
}

/// What another home has learned becomes the forecast, and is gone from it when it is forgotten.
#[test]
fn imported_habits_change_the_forecast_until_they_are_forgotten() {
    use roomcast_core::habits::{Habits, HabitsOptions, Place};
    const PERSON: u32 = 3;
    // Ten minutes in the living room, ten minutes in the kitchen, the whole day long.
    let mut teacher = Habits::new(HabitsOptions::default());
    let rooms = ["kitchen", "living room", "bathroom"].map(str::to_owned).to_vec();
    teacher.bind(vec!["sofa".to_owned()], rooms, vec![0.0, 1.0, 0.0]);
    let now_s = roomcast_ipc::clock::unix_ns() as f64 / 1e9;
    for minute in 0..4 * 1_440_u32 {
        let at_s = now_s - 5.0 * 86_400.0 + 60.0 * f64::from(minute);
        teacher.be(PERSON, Place::Room(usize::from(minute / 10 % 2 == 0)), at_s);
        teacher.tick(PERSON, at_s, &mut |_, p| p.fill(0.25));
    }
    let mut world = World::new("import");
    let export = world.directory.path().join("export.json");
    std::fs::write(&export, teacher.to_json().unwrap()).unwrap();
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let forecasts = node.subscriber::<PersonForecastsV1>().unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let mut number = 0;
    // In the kitchen in a quarter of an hour.
    let mut kitchen = || {
        number += 1;
        let message = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
        let source = sequence::source_of_name("test");
        narration.send(&NarrationV1 { source, epoch: 1, sequence: number, person: PERSON, ..message }).unwrap();
        let told = scores_with(&scores, "it is scored", |scores| includes(scores, "test", number));
        let forecast = eventually("the forecast", || {
            forecasts.newest().unwrap().filter(|forecast| forecast.sequence >= told.sequence)
        });
        let room = forecast.rooms().position(|room| room == "kitchen").unwrap();
        let horizon = forecast.horizon_s.iter().position(|horizon_s| *horizon_s == 900.0).unwrap();
        let own = forecast.persons()[0];
        let all: f32 = own.elsewhere[horizon] + own.probability.iter().map(|row| row[horizon]).sum::<f32>();
        assert!((all - 1.0).abs() < 1e-4, "{all}");
        own.probability[room][horizon]
    };
    let before = kitchen();
    let (code, _, errors) = habits(&world, &["import", export.to_str().unwrap()]);
    assert_eq!(code, 0, "{errors}");
    let known = kitchen();
    assert!(known > before + 0.2 && known > 0.6, "{before} {known}");
    let (_, answer, _) = habits(&world, &["show", "--json"]);
    let shipped = answer["persons"][0]["forecast"][1]["shipped"].as_f64().unwrap();
    assert!(shipped < 0.5, "{answer}");
    // Every twenty minutes of four days both rooms were left once; a visit of before counts nearly as much as one of now.
    let visits = |room: usize| {
        let line = &answer["visits"][room];
        (line["room"].as_str().unwrap(), line["by_part"].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).sum())
    };
    let rooms: [(&str, f64); 3] = [visits(0), visits(1), visits(2)];
    assert!(rooms.iter().all(|(room, count)| (270.0..=292.0).contains(count) == (*room != "bathroom")), "{rooms:?}");
    let copy = world.directory.path().join("copy.json");
    assert_eq!(habits(&world, &["export", copy.to_str().unwrap()]).0, 0);
    assert!(std::fs::read_to_string(&copy).unwrap().contains("living room"));
    assert_eq!(habits(&world, &["export", copy.to_str().unwrap()]).0, 3, "a file is not overwritten");
    std::fs::write(&copy, "{}").unwrap();
    let (code, _, errors) = habits(&world, &["import", copy.to_str().unwrap()]);
    assert!(code == 3 && errors.contains("the daemon changed nothing"), "{errors}");
    assert!(kitchen() > 0.6);

    // To forget a person is to forget their habits.
    let output = world.command(&["person", "forget", "3"]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let after = kitchen();
    assert!((after - before).abs() < 0.15, "{before} {after}");
    world.signal(daemon, Signal::TERM);
    assert!(world.wait(daemon).0.success());
}

/// What was narrated before the daemon was there is learned in addition to what it has learned by itself.
#[test]
fn habits_are_learned_from_lines_with_times() {
    let mut world = World::new("learn");
    world.start_daemon();
    assert_eq!(world.narrate("camera", "They open the fridge.\n").0, 0);
    eventually("it is learned", || (learned(&world) == 1.0).then_some(()));
    let day = |day: u32| {
        let at_s = f64::from(day).mul_add(86_400.0, 1_709_280_900.0);
        let line = |at_s: f64, text: &str| format!(r#"{{"text": "{text}", "observed_unix_s": {at_s}, "person": 3}}"#);
        [line(at_s, "They sit on the sofa."), line(at_s + 900.0, "They open the fridge.")].join("\n")
    };
    let file = world.directory.path().join("days.jsonl");
    let ahead = r#"{"text": "They sit on the sofa.", "observed_unix_s": 4e9, "person": 3}"#;
    let lines = (0..5).map(day).collect::<Vec<_>>().join("\n") + "\nThey have no time.\n\n" + ahead;
    std::fs::write(&file, lines).unwrap();
    // The rest is learned, and what is left out is said.
    let (code, _, errors) = habits(&world, &["learn", file.to_str().unwrap()]);
    let said = errors.contains("line 11: it has no time") && errors.contains("line 13: its time lies");
    assert!(code == 3 && said && errors.contains("2 lines left out"), "{errors}");
    assert_eq!(learned(&world), 11.0);
    // Without times there is nothing to learn.
    std::fs::write(&file, "They sit on the sofa.\n").unwrap();
    assert_eq!(habits(&world, &["learn", file.to_str().unwrap()]).0, 3);
    assert_eq!(habits(&world, &["learn"]).0, 2);
    assert_eq!(learned(&world), 11.0);
}

/// What was recorded, and days of activities, teach a home as well.
#[test]
fn habits_are_learned_from_a_recording_and_from_days() {
    let mut world = World::new("learn-days");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let file = world.directory.path().join("day.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    assert_eq!(world.narrate("camera", "They open the fridge.\nThey sit on the sofa.\n").0, 0);
    eventually("it is learned", || (learned(&world) == 2.0).then_some(()));
    world.signal(recorder, Signal::TERM);
    assert!(world.wait(recorder).0.success());
    assert_eq!(habits(&world, &["forget", "--all"]).0, 0);
    assert_eq!(learned(&world), 0.0);
    let (code, _, errors) = habits(&world, &["learn", "--recording", file.to_str().unwrap()]);
    assert_eq!((code, learned(&world)), (0, 2.0), "{errors}");

    let days = world.directory.path().join("days");
    std::fs::create_dir(&days).unwrap();
    for day in 0..3 {
        let text = "### breakfast-00.txt\n[OPEN] <fridge> (305) [1]\n420.0\n[SIT] <sofa> (368) [2]\n430.5\n";
        std::fs::write(days.join(format!("{day:03}.txt")), text).unwrap();
    }
    let days = days.to_str().unwrap();
    let learn = ["learn", "--days", days, "--first-day", "2024-03-04", "--person", "3"];
    let (code, _, errors) = habits(&world, &learn);
    assert_eq!((code, learned(&world)), (0, 8.0), "{errors}");
    let (_, answer, _) = habits(&world, &["show", "--json"]);
    let of = |person: u64| answer["persons"].as_array().unwrap().iter().find(|own| own["person"] == person).cloned();
    assert_eq!(of(3).unwrap()["observations"], 6.0, "{answer}");
    assert_eq!(habits(&world, &["learn", "--days", days, "--first-day", "soon"]).0, 2);
    // What is not yet is not learned, nor from a sensor log; and a log in plain seconds harms nothing.
    let (code, _, errors) = habits(&world, &["learn", "--days", days, "--first-day", "2200-01-01"]);
    assert!(code == 3 && errors.contains("day 1, action 1: its time lies"), "{errors}");
    let (log, rules) = (world.directory.path().join("log.tsv"), world.directory.path().join("rules.toml"));
    std::fs::write(&rules, "[[rule]]\nsay = \"They open the {sensor}.\"\n").unwrap();
    let learn = |text: &str| {
        std::fs::write(&log, text).unwrap();
        habits(&world, &["learn", "--sensors", log.to_str().unwrap(), "--rules", rules.to_str().unwrap()])
    };
    let (code, _, errors) = learn("2200-03-01 08:00:00\t2200-03-01 08:00:08\tfridge\t-\t-\n100\t105\tfridge\t-\t-\n");
    assert!(code == 3 && errors.contains("line 1: its time lies") && errors.contains("1 line left out"), "{errors}");
    assert_eq!(learned(&world), 9.0);
    let (code, _, errors) = learn("1709280900000\t1709280905000\tfridge\t-\t-\n");
    assert!(code == 3 && errors.contains("milliseconds"), "{errors}");
    assert_eq!(learned(&world), 9.0);
    // A restarted daemon knows all of it.
    drop((scores, node));
    world.signal(daemon, Signal::TERM);
    assert!(world.wait(daemon).0.success());
    let daemon = world.start_daemon();
    assert_eq!(learned(&world), 9.0);
    assert_eq!(habits(&world, &["learn", "--days", world.state().to_str().unwrap()]).0, 3);
    world.signal(daemon, Signal::TERM);
    assert!(world.wait(daemon).0.success());
}
