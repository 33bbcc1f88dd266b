//! Real processes in private domains: late, doubled, restarted, fast or hostile. No test asserts a duration or sleeps for a fixed time as proof.

use roomcast_ipc::raw::{DecisionV1, RobotReportV1, RoomScoresV1};
use roomcast_ipc::{Node, Subscriber, sequence};

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

use roomcast_cli::exit_code;

use crate::eventually::{PATIENCE, eventually};
use crate::world::{World, roomcast};

fn scores_with(scores: &Subscriber<RoomScoresV1>, what: &str, holds: impl Fn(&RoomScoresV1) -> bool) -> RoomScoresV1 {
    eventually(what, || scores.newest().unwrap().filter(&holds))
}

/// A daemon that has published its first scores: its number, a node in its domain, and the scores.
fn scoring(name: &str) -> (World, usize, Node, Subscriber<RoomScoresV1>) {
    let mut world = World::new(name);
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    (world, daemon, node, scores)
}

pub(crate) fn includes(scores: &RoomScoresV1, name: &str, number: u64) -> bool {
    let source = sequence::source_of_name(name);
    scores.included().iter().any(|included| included.source == source && included.sequence >= number)
}

fn own_memory_kib(process: u32) -> u64 {
    let rollup = std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap();
    let private = rollup.lines().filter(|line| line.starts_with("Private_"));
    private.map(|line| line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()).sum()
}

const MOVED: &str = r#"[{"change": "move-item", "id": "fridge-1", "position_m": [0.5, 0.5, 0.5],
    "box": {"min_m": [0.2, 0.2, 0.0], "max_m": [0.8, 0.8, 1.6]}}]"#;

/// Applies changes with `roomcast scene apply`; returns exit code, answer and errors.
fn apply(world: &World, changes: &str, more: &[&str]) -> (i32, serde_json::Value, String) {
    let file = world.directory.path().join("changes.json");
    std::fs::write(&file, changes).unwrap();
    let mut command = world.command(&["scene", "apply", file.to_str().unwrap(), "--json"]);
    let output = command.args(more).output().unwrap();
    let answer = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
}

fn probabilities(scores: &RoomScoresV1) -> std::collections::BTreeMap<String, f64> {
    scores.rooms().iter().map(|room| (room.id().to_owned(), room.probability)).collect()
}

/// A narrator that has just left may count as a listener for a while, so recorders are counted by name.
fn recorder_listens(node: &Node) {
    recorders_listen(node, 1);
}

fn decision_with(decisions: &Subscriber<DecisionV1>, what: &str, holds: impl Fn(&DecisionV1) -> bool) -> DecisionV1 {
    eventually(what, || {
        let next = decisions.receive().unwrap()?;
        holds(&next).then_some(next)
    })
}

/// Exit code, answer and errors of `roomcast habits`.
fn habits(world: &World, arguments: &[&str]) -> (i32, serde_json::Value, String) {
    let output = world.command(&[&["habits"], arguments].concat()).output().unwrap();
    let answer = serde_json::from_slice(&output.stdout).unwrap_or_default();
    (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
}

fn recorders_listen(node: &Node, count: usize) {
    let reports = node.publisher::<RobotReportV1>().unwrap();
    eventually("the recorders listen", || {
        let listeners = reports.listeners();
        (listeners.iter().filter(|name| *name == "roomcast-record").count() == count).then_some(())
    });
}
