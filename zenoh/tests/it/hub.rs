//! A hub without a router.

use std::path::Path;

use roomcast_zenoh::spool::{Kept, Spool};
use roomcast_zenoh::wire::{Kind, Observation, Who};
use rustix::process::Signal;

use crate::support::{Process, bridge, eventually, free_port};

/// A hub with one event to send.
fn hub(folder: &Path, input: &Path) -> Process {
    let spool = folder.join("spool");
    let observation =
        Observation { text: "They sit.".to_owned(), kind: Kind::Sentence, person: Who::Somebody, count: 0 };
    Spool::open(&spool, 10).unwrap().append(vec![Kept::new(observation, 0, None)]).unwrap();
    let port = free_port();
    let config = format!(
        "[router]\nconnect = \"tcp/127.0.0.1:{port}\"\n[hub]\nname = \"hall-camera\"\nrobots = [\"robot-1\"]\nspool = {spool:?}\n"
    );
    let (file, input) = (folder.join("hub.toml"), input.to_owned());
    std::fs::write(&file, config).unwrap();
    Process::start(folder.join("hub.log"), move || {
        let mut command = bridge();
        command.arg("hub").arg("--config").arg(&file).arg("--input").arg(&input);
        command
    })
}

#[test]
fn an_input_that_fails_is_told_while_narration_is_still_sent() {
    let folder = tempfile::tempdir().unwrap();
    // The file opens, but cannot be read: the start of a process's memory is unmapped.
    let mut hub = hub(folder.path(), Path::new("/proc/self/mem"));
    eventually("the log tells of the input", || hub.said().contains("the input cannot be read any more").then_some(()));
    assert!(hub.is_alive(), "the robot has not confirmed what was read before");
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 1);
    assert!(hub.said().contains("cannot read"), "{}", hub.said());
}

/// The hub does not wait for a writer, and loses no line of the first one.
#[test]
fn a_hub_with_a_fifo_starts_reads_its_first_writer_and_stops() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("lines");
    rustix::fs::mkfifoat(rustix::fs::CWD, &input, rustix::fs::Mode::from_raw_mode(0o600)).unwrap();
    let mut hub = hub(folder.path(), &input);
    let misses_router = |hub: &Process| hub.said().contains("router").then_some(());
    eventually("it misses the router", || misses_router(&hub));
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 0, "nobody has written yet");
    hub.restart();
    let mut writer = std::process::Command::new("sh");
    writer.args(["-c", "echo \"They walk to the kitchen.\" > \"$0\""]).arg(&input);
    assert!(writer.status().unwrap().success());
    let is_kept = || {
        let files = std::fs::read_dir(folder.path().join("spool")).unwrap().flatten();
        let mut texts = files.filter_map(|file| std::fs::read(file.path()).ok());
        texts.any(|text| String::from_utf8_lossy(&text).contains("They walk to the kitchen.")).then_some(())
    };
    eventually("the line is kept", is_kept);
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 0);
    assert!(hub.said().contains(r#"{"last":2,"confirmed":0,"refused":0,"lost":0}"#), "{}", hub.said());
}

/// Formerly a removed spool gave the hub a new epoch from the first line of its input, and the robots received every line twice.
#[test]
fn a_hub_whose_spool_was_emptied_says_nothing_again() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("lines");
    std::fs::write(&input, "").unwrap();
    let mut hub = hub(folder.path(), &input);
    let spool = ["spool/narration.db", "spool/narration.db-wal"].map(|file| folder.path().join(file));
    let has =
        |text: &str| spool.iter().any(|file| String::from_utf8_lossy(&std::fs::read(file).unwrap()).contains(text));
    // A restarted hub reads from the end of its input and may miss an earlier line, so the line is repeated.
    let say = |text: &str| {
        eventually("the line is kept", || {
            let mut lines = std::fs::OpenOptions::new().append(true).open(&input).unwrap();
            std::io::Write::write_all(&mut lines, format!("{text}\n").as_bytes()).unwrap();
            has(text).then_some(())
        });
    };
    say("They stand up.");
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 0);
    spool.iter().for_each(|file| std::fs::write(file, "").unwrap());
    hub.restart();
    say("They open the fridge.");
    assert!(!has("They stand up."), "{}", hub.said());
    hub.signal(Signal::TERM);
    assert_eq!(hub.wait(), 0);
}

/// `timeout` and terminals signal a process and then its group.
#[test]
fn a_doubled_signal_is_one_request() {
    let folder = tempfile::tempdir().unwrap();
    let input = folder.path().join("lines");
    std::fs::write(&input, "").unwrap();
    let mut hub = hub(folder.path(), &input);
    // The signal handlers are set before the hub connects to the router.
    eventually("it misses the router", || hub.said().contains("router").then_some(()));
    hub.signal(Signal::INT);
    hub.signal(Signal::INT);
    assert_eq!(hub.wait(), 0);
    assert!(hub.said().contains(r#"{"last":1,"confirmed":0,"refused":0,"lost":0}"#), "{}", hub.said());
}
