use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use roomcast_ipc::Domain;

use super::{eventually, exit_code, roomcast};

/// A killed `demo` cannot stop its children.
#[test]
fn the_processes_of_a_killed_demo_end_with_it() {
    let mut demo = roomcast(&["demo", "--seconds", "60"]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let demo_id = demo.id().to_string();
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

/// The rooms of the person or robot, each with its first second, from the demo's log.
fn rooms_of(who: &str, log: &str) -> Vec<(usize, String)> {
    let entry = |line: &str| {
        let (time, event) = line.trim_start().split_once(" s  ")?;
        let way = event.strip_prefix(who)?.split('.').next()?.trim_end_matches(" (fallback)").trim_end_matches('.');
        let room = way.rsplit_once(" the ").map_or(way, |(_, room)| room);
        Some((time.parse().ok()?, room.to_owned()))
    };
    log.lines().filter_map(entry).collect()
}

fn room_at(rooms: &[(usize, String)], second: usize) -> Option<&str> {
    rooms.iter().rev().find(|(from_s, _)| *from_s <= second).map(|(_, room)| room.as_str())
}

/// The figures in the headline follow from the log, or equal the experiment's.
#[test]
#[ignore = "full"]
fn the_figures_of_the_demo_follow_from_its_log_and_equal_the_experiments() {
    const PROGRAM: &str = "p0-breakfast-and-television";
    let cell = ["--scene", "apartment-e0", "--program", PROGRAM, "--room-time", "25", "--seed", "3"];
    let output = roomcast(&["demo", "--seconds", "12"]).args(cell).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let log = String::from_utf8(output.stdout).unwrap();
    let (person, robot) = (rooms_of("Ada is now ", &log), rooms_of("Robot ", &log));

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
    let headline = format!("The robot shared a room with Ada for {shared_s} of {horizon_s} s, and {done}.");
    assert!(log.contains(&headline), "{headline}\n{log}");
    assert_eq!(done_s.len(), 3, "coverage-aware leaves a room undone: {log}");

    // A held item moves along: a person on the sofa drinks in the living room.
    let second = |sentence: &str| -> usize {
        let line = log.lines().find(|line| line.contains(sentence)).unwrap_or_else(|| panic!("no {sentence:?}: {log}"));
        line.trim_start().split_once(" s  ").unwrap().0.parse().unwrap()
    };
    for second in second("Ada sits on the sofa.")..=second("Ada drinks from the mug.") {
        assert_eq!(room_at(&person, second), Some("living room"), "{log}");
    }

    // The output ends with a chart: a row a room, and the legend.
    let chart: Vec<&str> = log.trim_end().lines().rev().take(5).collect();
    assert!(
        chart[0].contains("▄ Ada   ▀ robot") && chart[1].contains("0 s") && chart[4].starts_with("kitchen"),
        "{log}"
    );
    for odd in ["drink the mug", "does no room", "the nowhere", "beside"] {
        assert!(!log.contains(odd), "{odd}: {log}");
    }

    // Cargo builds roomcast-lab only with the tests of the lab's package.
    let lab = Path::new(env!("CARGO_BIN_EXE_roomcast")).with_file_name("roomcast-lab");
    if !lab.exists() {
        crate::skipped::skipped("roomcast-lab is not built: make lab");
        return;
    }
    let output = Command::new(lab).args(["table2", "--no-cache", "--json"]).args(cell).output().unwrap();
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

#[test]
fn the_readme_shows_what_the_command_prints() {
    let readme = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).unwrap();
    let block = |kind: &str| readme.split_once(kind).unwrap().1.split_once("```").unwrap().0.trim().to_owned();
    let narration = block("```sh").split('"').nth(1).unwrap().to_owned();
    let output = roomcast(&["score", "--narration", &narration]).output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    // Processors round differently in the last place.
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
