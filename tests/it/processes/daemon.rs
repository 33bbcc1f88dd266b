use std::path::PathBuf;
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{DecisionV1, MAX_ITEMS, NarrationV1, RoomScoresV1, action, narration_kind};
use roomcast_ipc::{question, sequence};
use rustix::process::Signal;

use super::{PATIENCE, World, eventually, exit_code, includes, own_memory_kib, scores_with, scoring};

#[test]
fn a_late_planner_has_the_scores_at_once_and_two_planners_do_not_disturb_each_other() {
    let mut world = World::new("late");
    world.start_daemon();
    let (code, outcome) = world.narrate("camera", "They walk to the kitchen.\nThey open the fridge.\n");
    assert_eq!((code, &outcome["confirmed"]), (0, &serde_json::json!(2)));

    let node = world.domain.open("test").unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    world.start(&["planner", "--robot", "one", "--know", "0", "--policy", "greedy-avoidance"]);
    world.start(&["planner", "--robot", "two", "--know", "0", "--policy", "naive", "--seed", "3"]);
    let mut first = std::collections::BTreeMap::new();
    eventually("both robots decide", || {
        while let Some(decision) = decisions.receive().unwrap() {
            first.entry(decision.robot).or_insert(decision);
        }
        (first.len() == 2).then_some(())
    });
    for decision in first.values() {
        // No event came after the planners joined, so they got the scores on joining.
        assert_eq!((decision.action, decision.flags), (action::GO, 0), "{}", decision.reason());
        assert!(decision.observed_ns > 0 && !decision.to().is_empty());
    }
    world.assert_alive();
}

/// OpenMP puts the scoring thread's workers to sleep at every wait if the set-up leaves other threads behind.
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
    // A new thread inherits the name of its parent.
    assert_eq!((count("scoring"), count("setup")), (2, 0), "{threads:?}");
    assert_eq!(count(name(process).trim_end()), 1, "{threads:?}");
}

#[test]
fn answers_are_prepared_on_after_an_event_that_asks_nothing() {
    let mut world = World::new("prepared");
    let config = world.directory.path().join("roomcast.toml");
    // With this share the prefetcher has work left during the whole test.
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
    // One prefetch in progress may still end; ten more show that the prefetcher continues.
    prepared(&world, before.prepared + 9);
}

/// Voluntary context switches of all threads.
fn sleeps(process: u32) -> u64 {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap().flatten();
    let status = tasks.filter_map(|task| std::fs::read_to_string(task.path().join("status")).ok());
    let count = |status: String| {
        let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:").map(str::to_owned));
        line.unwrap().trim().parse::<u64>().unwrap()
    };
    status.map(count).sum()
}

/// `top --json --snapshots 1` used to wait without a message.
#[test]
#[ignore = "full"]
fn whoever_wants_one_snapshot_and_has_no_daemon_is_told() {
    let world = World::new("silent");
    let output = world.command(&["top", "--json", "--snapshots", "1"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), output.stdout.len()), (Some(6), 0), "{said}");
    assert!(said.contains("no daemon is heard in the domain") && said.contains("start `roomcast daemon`"), "{said}");
}

/// Daemon and planner share the program's pages, so only private memory counts for the planner.
#[test]
#[ignore = "full"]
fn an_idle_daemon_and_planner_wake_seldom_and_a_planner_is_small() {
    let mut world = World::new("idle");
    let both = [world.start_daemon(), world.start(&["planner", "--know", "0"])];
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let decisions = node.subscriber::<DecisionV1>().unwrap();
    scores_with(&scores, "scores", |_| true);
    eventually("a decision", || decisions.newest().unwrap());
    drop((scores, decisions, node));
    let ids = both.map(|process| world.children[process].child.id());
    // Other processes on the machine add wake-ups, so a busy period is measured again.
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

/// A configuration with a map of `count` items in four rooms, in `world`'s directory.
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

/// The attack: `top` reads a map of 20 000 items, with 64 MB of shared memory.
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

#[test]
fn a_second_daemon_is_refused_and_the_first_stops_cleanly() {
    let (mut world, first, node, scores) = scoring("second");
    let second = world.start(&["daemon"]);
    let holder = format!("roomcast-daemon (process {})", world.children[first].child.id());
    let log = world.children[second].log.clone();
    eventually("it says for whom it waits", || {
        let said = std::fs::read_to_string(&log).unwrap();
        said.lines().any(|line| line.contains("waiting up to 8 s") && line.contains(&holder)).then_some(())
    });
    world.assert_alive();
    let (status, log) = world.wait(second);
    assert_eq!(status.code(), Some(i32::from(exit_code::IPC)), "{log}");
    assert!(log.contains(&holder) && log.contains("roomcast/v1/room-scores"), "{log}");

    world.stop(first);
    drop((scores, node));
    assert!(world.domain.clean_up().unwrap());
    assert_eq!(world.shared_memory_files(), Vec::<String>::new());
    assert!(!world.domain.root().exists());
}

/// `top` joins a quiet system: no event comes after it.
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

/// The model file ends with a hole of 64 GiB, so that its checksum takes a minute. Another process tries the file first, unless its checksum is pinned.
#[test]
fn a_stop_while_the_model_loads_ends_the_daemon_and_the_trial_at_once() {
    let mut world = World::new("loading");
    let model = world.path("slow.gguf");
    std::fs::write(&model, roomcast_services::embedded::MODEL).unwrap();
    std::fs::OpenOptions::new().write(true).open(&model).unwrap().set_len(64 << 30).unwrap();
    let config = world.path("roomcast.toml");
    for pin in ["".to_owned(), format!("sha256 = \"{}\"\n", "0".repeat(64))] {
        std::fs::write(&config, format!("[model]\npath = {model:?}\n{pin}")).unwrap();
        let daemon = world.start(&["daemon", "--config", config.to_str().unwrap()]);
        let process = world.children[daemon].child.id();
        let of_daemon = format!("/proc/{process}/task/{process}/children");
        let reader = if pin.is_empty() {
            let child = || std::fs::read_to_string(&of_daemon).ok()?.trim().parse::<u32>().ok();
            eventually("the trial", child)
        } else {
            process
        };
        let opened = |reader: u32| std::fs::read_dir(format!("/proc/{reader}/fd")).ok();
        let reads = || {
            let mut files = opened(reader)?.flatten().filter_map(|file| std::fs::read_link(file.path()).ok());
            files.find(|file| *file == model)
        };
        eventually("the file is read", reads);
        let stopped = Instant::now();
        world.signal(daemon, Signal::TERM);
        let (status, log) = world.wait(daemon);
        assert!(status.success() && stopped.elapsed() < Duration::from_secs(20), "{status} {log}");
        assert!(pin.is_empty() || log.contains("unless daemon.state names a folder"), "{log}");
        eventually("the trial ends", || opened(reader).is_none().then_some(()));
    }
}
