//! Habits stay on the robot unless its configuration shares them. Shared habits are counts only.

use std::collections::BTreeMap;
use std::process::Command;

use roomcast_zenoh::config;
use roomcast_zenoh::link::client;
use serde_json::Value;
use zenoh::Wait;

use crate::support::{
    NO_ROUTER, Process, Robot, Watch, bridge, eventually, free_port, python, roomcast, router, skipped,
};

/// Ada is twice in the kitchen and leaves it, and once in the bathroom.
const LINES: &str = r#"{"text":"present in the kitchen","kind":"presence","person":"Ada"}
{"text":"present in the bathroom","kind":"presence","person":"Ada"}
{"text":"present in the kitchen","kind":"presence","person":"Ada"}
{"text":"present in the living room","kind":"presence","person":"Ada"}
"#;

fn counts(of: &Value) -> Vec<f64> {
    of.as_array().unwrap().iter().map(|count| count.as_f64().unwrap()).collect()
}

/// The visits of rooms in `roomcast habits show --json`.
fn own_counts(robot: &Robot) -> BTreeMap<String, Vec<f64>> {
    let mut command = Command::new(roomcast());
    command.args(["habits", "show", "--json", "--domain", robot.domain.name(), "--root"]).arg(robot.domain.root());
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let visits = answer["visits"].as_array().unwrap();
    visits.iter().map(|line| (line["room"].as_str().unwrap().to_owned(), counts(&line["by_part"]))).collect()
}

#[test]
fn habits_stay_on_the_robot_unless_they_are_shared_and_then_are_counts() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let names = ["robot-1", "robot-2"];
    let mut robots = [
        Robot::start(names[0], &way, &["hall-camera"], "[habits]\nshare = true"),
        Robot::start(names[1], &way, &["hall-camera"], ""),
    ];
    let (spool, config_file) = (folder.path().join("spool"), folder.path().join("hub.toml"));
    let hub = format!("{way}\n[hub]\nname = \"hall-camera\"\nrobots = {names:?}\nspool = {spool:?}\n");
    std::fs::write(&config_file, hub).unwrap();
    let lines = folder.path().join("lines");
    std::fs::write(&lines, LINES).unwrap();
    let mut hub = Process::start(folder.path().join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&config_file).stdin(std::fs::File::open(&lines).unwrap());
        command
    });
    assert_eq!(hub.wait(), 0, "{}", hub.said());
    let watch_config = folder.path().join("watch.toml");
    std::fs::write(&watch_config, &way).unwrap();
    let watch = Watch::start(&watch_config);
    // The bridge asks the daemon at its start, and then once a minute.
    robots.iter_mut().for_each(|robot| robot.bridge.restart());
    let mut heard = Vec::new();
    let shared = watch.find("counts of both visits", |line| {
        let key = line["key"].as_str().unwrap();
        heard.push(key.to_owned());
        let left = |room: &str| counts(&line["rooms"][room]).iter().sum::<f64>();
        key == "roomcast/home/robot-1/told/habits" && line["rooms"]["kitchen"].is_array() && left("kitchen") > 1.9
    });
    let told: BTreeMap<String, Vec<f64>> =
        shared["rooms"].as_object().unwrap().iter().map(|(room, of)| (room.clone(), counts(of))).collect();
    let sums: Vec<(&str, f64)> = told.iter().map(|(room, counts)| (room.as_str(), counts.iter().sum())).collect();
    assert_eq!(sums, [("bathroom", 1.0), ("kitchen", 2.0), ("main-room", 0.0)]);
    assert_eq!(told, own_counts(&robots[0]), "as the robot itself has them");
    assert!(shared.get("fault").is_none() && !shared.to_string().contains("Ada"), "{shared}");
    // The other robot has learned the same, and does not publish it, asked or not.
    assert_eq!(own_counts(&robots[1]), told);
    watch.find("the other robot's scores", |line| {
        let key = line["key"].as_str().unwrap();
        heard.push(key.to_owned());
        key == "roomcast/home/robot-2/told/status" && line["daemon"].is_object()
    });
    assert!(!heard.iter().any(|key| key == "roomcast/home/robot-2/told/habits"), "{heard:?}");
    let near = config::Router { connect: format!("tcp/127.0.0.1:{port}"), ..config::Router::default() };
    let operator = zenoh::open(client(&near).unwrap()).wait().unwrap();
    let keys = eventually("both robots answer", || {
        let replies = operator.get("roomcast/home/*/told/**").wait().unwrap();
        let keys = replies.into_iter().filter_map(|reply| reply.into_result().ok());
        let keys: Vec<String> = keys.map(|sample| sample.key_expr().to_string()).collect();
        let has = |robot: &str, topic: &str| keys.contains(&format!("roomcast/home/{robot}/told/{topic}"));
        (has("robot-1", "habits") && has("robot-2", "persons")).then_some(keys)
    });
    assert!(!keys.iter().any(|key| key == "roomcast/home/robot-2/told/habits"), "{keys:?}");
}
