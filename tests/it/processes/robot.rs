use std::io::Write;
use std::process::Stdio;

use roomcast_ipc::raw::{DecisionV1, RobotReportV1, action, decision_flags};
use roomcast_ipc::sequence;
use rustix::process::Signal;

use super::{World, decision_with, eventually, exit_code};

#[test]
fn a_second_planner_of_the_same_robot_is_refused() {
    let mut world = World::new("robots");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let first = world.start(&["planner", "--robot", "one", "--know", "0", "--room-time", "0"]);
    eventually("a decision", || decisions.newest().unwrap());
    let other = world.start(&["planner", "--robot", "zwei Küchen", "--know", "0", "--room-time", "0"]);
    let second = world.start(&["planner", "--robot", "one", "--know", "0"]);
    let (status, log) = world.wait(second);
    assert_eq!(status.code(), Some(i32::from(exit_code::IPC)), "{log}");
    let number = sequence::source_of_name("one");
    let holder = format!("roomcast-planner one {number:016x} (process {})", world.children[first].child.id());
    assert!(log.contains(&holder), "{log}");
    // A killed planner does not block its successor.
    world.end(first, Signal::KILL);
    let third = world.start(&["planner", "--robot", "one", "--know", "0", "--room-time", "0"]);
    let process = world.children[third].child.id();
    eventually("the third planner decides", || {
        assert!(world.children[third].child.try_wait().unwrap().is_none(), "process {process} ended");
        decisions.newest().unwrap().filter(|decision| decision.robot == sequence::source_of_name("one"))
    });
    assert!(world.children[other].child.try_wait().unwrap().is_none());
}

/// Exit code and errors of `roomcast report`.
fn report(world: &World, arguments: &[&str], input: &str) -> (i32, String) {
    let mut command = world.command(&[&["report"], arguments].concat());
    let mut child = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_planner_that_is_killed_in_a_round_goes_on_with_what_its_robot_has_done() {
    let mut world = World::new("robot");
    let config = world.directory.path().join("roomcast.toml");
    let text = format!(
        "[scene]\npath = \"apartment-e0\"\n[daemon]\nstate = {:?}\n[planner]\nrobot = \"vacuum\"\nknow_s = 0.0\ninterrupt = false\n",
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
    // The planner writes the round after it publishes the decision.
    let kept = format!("planner-{:016x}.db", sequence::source_of_name("vacuum"));
    let second_is_kept = |text: &str| text.contains(second.to()) && text.contains(first.to());
    eventually("the round is kept", || {
        let database = roomcast_database::look(&world.state().join(&kept)).ok()?;
        let round = database.query_row("SELECT group_concat(value) FROM round", [], |row| row.get::<_, String>(0));
        round.ok().filter(|text| second_is_kept(text))
    });

    world.children[planner].child.kill().unwrap();
    world.children[planner].child.wait().unwrap();
    world.start(&["planner", "--config", config]);
    let again = decision_with(&decisions, "the next planner's decision", |decision| decision.epoch != first.epoch);
    assert_eq!((again.to(), again.covered), (second.to(), second.covered), "{}", again.reason());
    assert!(again.has(decision_flags::REPORTED), "{}", again.reason());

    // One malformed line does not stop the others. A report may name a decision of the previous planner.
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

/// Participants' names must be ASCII; robots' names need not.
#[test]
fn a_robot_may_have_any_name() {
    let mut world = World::new("umlaut");
    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    let config = world.directory.path().join("roomcast.toml");
    std::fs::write(&config, "[planner]\nrobot = \"Staubi Ä\"\nknow_s = 0.0\n").unwrap();
    let config = config.to_str().unwrap();
    world.start(&["planner", "--config", config]);
    // Without a daemon, the planner's decision reports missing scores.
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
    world.start(&["planner", "--robot", "vacuum", "--know", "0"]);
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
