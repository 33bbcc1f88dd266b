//! Real processes in private domains: what holds between narrator, daemon and planner when one is late, doubled, restarted,
//! fast, foreign or hostile. Nothing here sleeps for a fixed time to prove something, and nothing is held to a time.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a panic in a test is the report")]

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use roomcast_ipc::{DecisionV1, Domain, Node, RobotReportV1, RoomScoresV1, StatusResponseV1, Subscriber, sequence};
use rustix::process::{Pid, Signal, kill_process};

mod commands;
mod daemon;
mod demo;
mod front_door;
mod habits;
mod map;
mod metrics;
mod narration;
mod recordings;
mod robot;
#[path = "../support/skipped.rs"]
mod skipped;

use roomcast_cli::exit_code;

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
        let mut outcome: serde_json::Value =
            serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        // A test of its own looks at how events were understood.
        let understood = outcome.as_object_mut().and_then(|outcome| outcome.remove("understood"));
        assert!(understood.is_some_and(|understood| understood.is_array()));
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

/// Memory of a process that no other shares, in KiB.
fn own_memory_kib(process: u32) -> u64 {
    let rollup = std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap();
    let private = rollup.lines().filter(|line| line.starts_with("Private_"));
    private.map(|line| line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()).sum()
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

/// Waits until the recorder has its last port; a narrator that has just left may count as a listener for a while.
fn recorder_listens(node: &Node) {
    recorders_listen(node, 1);
}

/// The next decision that satisfies a condition.
fn decision_with(decisions: &Subscriber<DecisionV1>, what: &str, holds: impl Fn(&DecisionV1) -> bool) -> DecisionV1 {
    eventually(what, || {
        let next = decisions.receive().unwrap()?;
        holds(&next).then_some(next)
    })
}

/// What `roomcast habits` answers, and its exit code.
fn habits(world: &World, arguments: &[&str]) -> (i32, serde_json::Value, String) {
    let output = world.command(&[&["habits"], arguments].concat()).output().unwrap();
    let answer = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
}

/// Waits until so many recorders have their last port.
fn recorders_listen(node: &Node, count: usize) {
    let reports = node.publisher::<RobotReportV1>().unwrap();
    eventually("the recorders listen", || {
        let listeners = reports.listeners();
        (listeners.iter().filter(|name| *name == "roomcast-record").count() == count).then_some(())
    });
}
