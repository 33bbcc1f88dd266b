use rustix::process::Signal;

use super::{PATIENCE, World, eventually, exit_code};

fn scrape(address: &str) -> String {
    use std::io::{Read, Write};
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    stream.write_all(b"GET /metrics HTTP/1.0\r\nHost: localhost\r\n\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

/// The labels, if any, are part of `name`.
fn metric(text: &str, name: &str) -> Option<f64> {
    text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.trim().parse().ok())
}

#[test]
fn metrics_of_a_running_daemon_are_scraped() {
    let mut world = World::new("metrics");
    let daemon = world.start_daemon();
    world.start(&["planner", "--robot", "one", "--know", "0"]);
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

    world.end(daemon, Signal::KILL);
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
