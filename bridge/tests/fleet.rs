//! A hub, a router and two robots as real processes: what holds while each is killed, stopped and started again.

#![expect(clippy::unwrap_used, reason = "a panic in a test is the report")]

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::time::Duration;

use roomcast_ipc::{IncludedV1, RoomScoresV1, Subscriber, sequence};
use rustix::process::Signal;

mod support;

use support::{NO_ROUTER, Process, Robot, Watch, bridge, eventually, free_port, python, router, skipped};

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().map_or(default, |text| text.parse().unwrap())
}

/// The same numbers for the same seed.
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

/// What a robot's scores say of the hub's narration; the newest.
fn included(scores: &Subscriber<RoomScoresV1>) -> Option<IncludedV1> {
    let newest = scores.newest().unwrap()?;
    let own = newest.included().iter().filter(|included| included.source == sequence::source_of_name("hall-camera"));
    own.max_by_key(|included| included.sequence).copied()
}

/// 0 narrations lost, 0 taken twice, no decision that looks fresher than it is, over as many faults as asked for:
/// `ROOMCAST_FLEET_CYCLES` (by default 12) and `ROOMCAST_FLEET_CUT_S` (6), the seconds for which the router stands still.
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
    let mut robots = names.map(|name| Robot::start(name, &way, &["hall-camera"], ""));
    let watch_config = folder.path().join("watch.toml");
    std::fs::write(&watch_config, &way).unwrap();
    let watch = Watch::start(&watch_config);
    let path = folder.path().join("lines");
    let mut lines = File::create(&path).unwrap();
    let mut hub = hub(folder.path(), &way, &names, &path);
    // Whoever follows the scores keeps on through restarts of the daemon.
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
    let (mut decisions, mut fresh) = (0_u64, 0_u64);
    watch.find("a decision whose delay is known", |line| {
        line["key"].as_str().unwrap().ends_with("/told/decision") && line["held_up_ns"].is_u64()
    });
    for cycle in 0..cycles {
        for _ in 0..1 + random.below(5) {
            writeln!(lines, "{}", acts[random.below(8) as usize]).unwrap();
            written += 1;
        }
        let robot = random.below(2) as usize;
        // Each fault at least once in the first eight cycles, then by chance.
        let fault = if cycle < 8 { cycle } else { random.below(8) };
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
            5 => robots[robot].planner.restart(),
            6 => {
                robots[robot].bridge.restart();
                hub.restart();
            }
            _ => {
                robots[robot].daemon.kill();
                robots[robot].bridge.kill();
                writeln!(lines, "{}", acts[0]).unwrap();
                written += 1;
                std::thread::sleep(Duration::from_millis(random.below(500)));
                robots[robot].bridge.restart();
                robots[robot].daemon.restart();
            }
        }
        while let Ok(line) = watch.lines.try_recv() {
            if !line["key"].as_str().unwrap().ends_with("/told/decision") {
                continue;
            }
            decisions += 1;
            let of = |key: &str| line[key].as_u64().unwrap();
            if line["held_up_ns"].is_null() {
                continue;
            }
            // Loopback has one clock, by which the claim is judged.
            let truly_ns = of("age_ns") - of("held_up_ns") + of("received_ns").saturating_sub(of("sent_ns"));
            if of("age_ns") < 2_000_000_000 {
                fresh += 1;
                assert!(truly_ns < 3_000_000_000, "a stale decision looks fresh: {line}");
            }
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
    eprintln!("{cycles} cycles, {written} narrations to two robots, {decisions} decisions seen, {fresh} of them fresh");
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
    // Nothing happens, and nothing is repeated for an hour: who joins now has it all the same, with its age.
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
    // A daemon that is gone is told of: its silence grows.
    robot.daemon.kill();
    late.find("the daemon's silence", |line| {
        line["key"] == key("status") && line["silence_ns"].as_u64().is_some_and(|silence_ns| silence_ns > 2_000_000_000)
    });
}

#[test]
fn a_hub_ends_when_every_robot_has_what_it_read() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"");
    let robot = Robot::start("robot-1", &way, &["hall-camera"], "");
    let input = folder.path().join("lines");
    std::fs::write(&input, "They walk to the kitchen.\n\nno\u{7}\n[Fly] <mug> (1)\n{\"text\":\"away\",\"kind\":\"presence\",\"person\":\"Ada\"}\n").unwrap();
    let fifo = folder.path().join("fifo");
    let spool = folder.path().join("spool");
    let config = folder.path().join("hub.toml");
    std::fs::write(
        &config,
        format!("{way}\n[hub]\nname = \"hall-camera\"\nrobots = [\"robot-1\"]\nspool = {spool:?}\n"),
    )
    .unwrap();
    let (own, text) = (config.clone(), input.clone());
    // Standard input ends, a file is followed.
    let mut hub = Process::start(fifo.with_extension("log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&own).stdin(File::open(&text).unwrap());
        command
    });
    // The router comes last.
    let _router = router(folder.path(), &python, port);
    assert_eq!(hub.wait(), 0, "{}", hub.said());
    let said = hub.said();
    assert!(said.contains(r#"{"last":2,"confirmed":2,"refused":2,"lost":0}"#), "{said}");
    drop(robot);
}

#[test]
fn a_wrong_set_up_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bridge.toml");
    let run = |text: &str| {
        std::fs::write(&file, text).unwrap();
        let output = bridge().args(["robot", "--config"]).arg(&file).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    for (text, says) in [
        ("", "router.connect"),
        ("[router]\nconect = 1", "unknown field `conect`"),
        ("[router]\nconnect = \"tls/host:7447\"\nca = \"/nowhere\"", "/nowhere"),
        ("[router]\nconnect = \"tcp/10.0.0.1:7447\"", "insecure"),
    ] {
        let (code, said) = run(text);
        assert!(code == Some(2) && said.contains(says), "{text:?}: {said}");
    }
    let printed = bridge().arg("config").output().unwrap();
    std::fs::write(&file, printed.stdout).unwrap();
    let output = bridge().args(["watch", "--config"]).arg(&file).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
}
