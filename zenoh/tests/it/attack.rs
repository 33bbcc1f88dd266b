//! A hostile peer at a router without rules: hostile bytes on every key, messages of many megabytes, invalid names, endless questions. All services
//! continue, and memory does not grow.

use std::fs;
use std::time::Duration;

use roomcast_zenoh::config::Router;
use roomcast_zenoh::link::{self, client};
use zenoh::Wait;

use crate::support::{NO_ROUTER, Process, Robot, Watch, bridge, eventually, free_port, python, router, skipped};

/// The limit on the peak memory of bridge and hub: less than with one of the longest messages.
const MEMORY_KIB_MAX: u64 = 64 << 10;

/// Unexpected payloads. The last one travels in many fragments.
fn payloads() -> Vec<Vec<u8>> {
    let text = |text: &str| text.as_bytes().to_vec();
    let numbers = text(
        r#"{"epoch":"ffffffffffffffff","sequence":18446744073709551615,"first":1,"age_ns":18446744073709551615,"sent_ns":18446744073709551615,"clock":"ffffffffffffffff","next":18446744073709551615,"confirmed":18446744073709551615,"refused":18446744073709551615,"stay_ns":18446744073709551615,"action":"go","to":"kitchen","reason":"","text":"\u001b[2J"}"#,
    );
    vec![
        Vec::new(),
        text("{}"),
        text("null"),
        text("\u{9b}2J\u{1b}[2J"),
        vec![0xff; 300],
        vec![b'['; 8000],
        text(r#"{"ask":"forget","person":"*"}"#),
        text(r#"{"rooms":{"a":[1e308]},"age_ns":-1,"sent_ns":1e99,"clock":"x"}"#),
        numbers,
        vec![b'{'; 100_000],
        vec![0; 2 * link::MESSAGE_BYTES_MAX],
        vec![b' '; 40 << 20],
    ]
}

fn keys() -> Vec<String> {
    let own = [
        "narration/hall-camera",
        "narration/other",
        "confirmed/hall-camera",
        "told/scores",
        "told/decision",
        "told/status",
        "told/habits",
        "told/a/b/c",
        "alive",
        "ask/moment",
        "ask/person",
    ];
    let of = |robot: &str| own.map(|key| format!("roomcast/home/{robot}/{key}"));
    let long = "x".repeat(3000);
    let ros2 = [
        "0/roomcast/narration/std_msgs::msg::dds_::String_/RIHS01_",
        "0/roomcast/narration/std_msgs::msg::dds_::String_/x",
    ];
    let names = ["robot-1", "robot-2", "\u{9b}2J", "a b", long.as_str()].map(of);
    names.into_iter().flatten().chain(ros2.map(str::to_owned)).collect()
}

/// Peak memory.
fn memory_kib(process: &Process) -> u64 {
    let status = fs::read_to_string(format!("/proc/{}/status", process.id())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

#[test]
fn a_foreign_client_of_an_open_router_stops_nothing() {
    let Some(python) = python() else { return skipped(NO_ROUTER) };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let way = format!("[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n");
    let more = format!(
        "[peers]\nhear = true\n[habits]\nshare = true\n[ask]\nmoment = true\nmap_change = true\nperson = true\n\
         [ros2]\nconnect = \"tcp/127.0.0.1:{port}\"\nnarration = true\n"
    );
    let mut robot = Robot::start("robot-1", &way, &["hall-camera"], &more);
    let (config, spool, lines) =
        (folder.path().join("hub.toml"), folder.path().join("spool"), folder.path().join("lines"));
    fs::write(&lines, "They walk to the kitchen.\n").unwrap();
    fs::write(&config, format!("{way}[hub]\nname = \"hall-camera\"\nrobots = [\"robot-1\"]\nspool = {spool:?}\n"))
        .unwrap();
    let (own, input) = (config.clone(), lines.clone());
    let mut hub = Process::start(folder.path().join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&own).arg("--input").arg(&input);
        command
    });
    let watch = Watch::start(&config);
    let is_of = |line: &serde_json::Value, topic: &str| line["key"] == format!("roomcast/home/robot-1/told/{topic}");
    let has = |count: u64| {
        watch.find("scores with what was narrated", |line| {
            is_of(line, "scores") && line["window"].as_u64() == Some(count)
        });
    };
    has(1);
    let stranger = Router { connect: format!("tcp/127.0.0.1:{port}"), ..Router::default() };
    let stranger = zenoh::open(client(&stranger).unwrap()).wait().unwrap();
    for key in keys() {
        for payload in payloads() {
            if payload.len() < 1000 {
                // Every question gets an answer or a refusal.
                let asked = stranger.get(&key).payload(payload.clone()).timeout(Duration::from_millis(200));
                drop(asked.wait().unwrap());
            }
            stranger.put(&key, payload).wait().unwrap();
        }
        stranger.delete(&key).wait().unwrap();
        while watch.lines.try_recv().is_ok() {}
    }
    let mut more = fs::File::options().append(true).open(&lines).unwrap();
    std::io::Write::write_all(&mut more, b"They open the fridge.\n").unwrap();
    has(2);
    // Another epoch in the hub's name, as of a second hub, is accepted and does not delay the first hub.
    let other = r#"{"epoch":"00000000000000aa","sequence":1,"first":1,"age_ns":0,"sent_ns":5,"clock":"0000000000000001","text":"They sleep."}"#;
    stranger.put("roomcast/home/robot-1/narration/hall-camera", other).wait().unwrap();
    has(3);
    std::io::Write::write_all(&mut more, b"They grab the milk.\n").unwrap();
    has(4);
    eventually("the planner decides after it", || {
        let line = watch.lines.try_recv().ok()?;
        (is_of(&line, "decision") && line["policy"].is_string()).then_some(())
    });
    for (what, process) in [("bridge", &mut robot.bridge), ("hub", &mut hub)] {
        assert!(process.is_alive(), "the {what} has ended");
        let memory_kib = memory_kib(process);
        assert!(memory_kib < MEMORY_KIB_MAX, "the {what} held {memory_kib} KiB");
    }
    assert!(robot.daemon.is_alive() && robot.planner.is_alive());
}
