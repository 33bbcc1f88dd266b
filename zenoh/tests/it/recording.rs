//! A ROS 2 recording, read by other implementations: by mcap-ros2-support with the schemas in it, by rosbags as a folder of rosbag2.

use std::path::Path;
use std::process::{Command, Stdio};

use roomcast_ipc::Domain;
use roomcast_ipc::raw::{DecisionV1, RobotReportV1, RoomScoresV1};
use rustix::process::Signal;
use serde_json::Value;

use crate::support::{Process, eventually, python, roomcast, skipped};

#[test]
fn two_other_implementations_read_a_recording_as_it_was_made() {
    let python = python().filter(|python| {
        let has = Command::new(python).args(["-c", "import mcap_ros2, rosbags"]).output();
        has.is_ok_and(|output| output.status.success())
    });
    let Some(python) = python else {
        return skipped(
            "PyPI's mcap-ros2-support and rosbags are not installed for the tests (`make zenoh` does, with a network)",
        );
    };
    let folder = tempfile::Builder::new().prefix("rcb-").tempdir_in("/tmp").unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let domain = Domain::new(folder.path().join("d"), &format!("recording-{}", std::process::id())).unwrap();
    let of = domain.clone();
    let command = move |arguments: &[&str]| {
        let mut command = Command::new(roomcast());
        command.args(arguments).env_remove("ROOMCAST_CONFIG").stdin(Stdio::null());
        command.arg("--root").arg(of.root()).args(["--domain", of.name()]);
        command
    };
    let start = |log: &str, arguments: &[&str]| {
        let arguments: Vec<String> = arguments.iter().map(|&argument| argument.to_owned()).collect();
        let command = command.clone();
        Process::start(folder.path().join(log), move || {
            command(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
        })
    };
    let mut daemon = start("daemon.log", &["daemon", "--state", &path("state")]);
    let node = domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    eventually("the first scores", || scores.newest().unwrap());
    let (theirs, own) = (path("theirs.mcap"), path("own.mcap"));
    let mut recorders =
        [start("theirs.log", &["record", "--profile", "ros2", &theirs]), start("own.log", &["record", &own])];
    let reports = node.publisher::<RobotReportV1>().unwrap();
    eventually("the recorders listen", || {
        let listeners = reports.listeners();
        (listeners.iter().filter(|name| *name == "roomcast-record").count() == 2).then_some(())
    });
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let mut planner = start("planner.log", &["planner", "--room-time", "0.2"]);
    let lines = ["They walk to the kitchen.", "They open the fridge.", "They sit on the sofa."];
    let lines: String = lines.iter().map(|text| format!("{{\"person\": \"Ada\", \"text\": \"{text}\"}}\n")).collect();
    std::fs::write(path("lines"), lines).unwrap();
    let narrated = command(&["narrate", &path("lines"), "--pace", "0", "--linger", "100"]).output().unwrap();
    assert!(narrated.status.success(), "{narrated:?}");
    eventually("a decision", || decisions.newest().unwrap());
    // The senders stop first, so that both recordings end alike.
    for process in [&mut planner, &mut daemon].into_iter().chain(&mut recorders) {
        process.signal(Signal::TERM);
        assert_eq!(process.wait(), 0, "{}", process.said());
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/recording.py");
    let output = Command::new(python).arg(script).args([&theirs, &own]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let counts: Value = serde_json::from_slice(&output.stdout).unwrap();
    println!("messages by topic: {counts}");
    assert_eq!(counts["/roomcast/narration"], 3);
    for topic in ["/roomcast/rooms", "/roomcast/person/ada", "/roomcast/markers", "/roomcast/decision"] {
        assert!(counts[topic].as_u64().is_some_and(|count| count > 0), "{topic}: {counts}");
    }
}
