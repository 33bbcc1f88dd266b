//! Participants are killed at any moment, mostly while they join, open ports or clean up. No file of theirs stays, and their places become free.
//!
//! `ROOMCAST_KILLS=2500 ROOMCAST_KILLS_SEED=2 cargo test --release --workspace --test it killed` sets the number of kills and the seed.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, SystemTime};

use roomcast_ipc::raw::{DecisionV1, ForecastV1, Message, NarrationV1, RoomScoresV1, StatusResponseV1, narration_kind};
use roomcast_ipc::{Domain, Node, Subscriber, question};

use crate::Private;
use crate::eventually::{eventually, waited};

const KILLS: usize = 300;
/// Set in a child: role, root path, domain name.
const CHILD: &str = "ROOMCAST_KILLED_CHILD";

/// Opens the ports of a daemon, planner or narrator and uses them until the process is killed.
fn take_part(role: &str, node: &Node) {
    let narration = NarrationV1::new(narration_kind::SENTENCE, "They grab the mug.").unwrap();
    let narration = NarrationV1 { source: 7, epoch: 1, sequence: 1, ..narration };
    match role {
        "daemon" => {
            let heard = node.subscriber::<NarrationV1>().unwrap();
            let scores = node.publisher::<RoomScoresV1>().unwrap();
            let forecast = node.publisher::<ForecastV1>().unwrap();
            let items = node.item_scores_publisher().unwrap();
            let status = node.status_server().unwrap();
            let moments = node.answer_port(question::MOMENT).unwrap();
            loop {
                scores.send_unchecked(&RoomScoresV1::default()).unwrap();
                forecast.send_unchecked(&ForecastV1::default()).unwrap();
                let _answered = status.answer(StatusResponseV1::default);
                let _answered = moments.answer(|_| String::new());
                items.tick().unwrap();
                scores.tick().unwrap();
                while heard.receive().unwrap().is_some() {}
                heard.wait(Duration::from_millis(3)).unwrap();
                node.clean_up_dead();
            }
        }
        "planner" => {
            let scores = node.subscriber::<RoomScoresV1>().unwrap();
            let decisions = node.publisher::<DecisionV1>().unwrap();
            loop {
                scores.wait(Duration::from_millis(3)).unwrap();
                while scores.receive().unwrap().is_some() {}
                decisions.send_unchecked(&DecisionV1::default()).unwrap();
                decisions.tick().unwrap();
            }
        }
        _ => {
            let said = node.publisher::<NarrationV1>().unwrap();
            let scores = node.subscriber::<RoomScoresV1>().unwrap();
            loop {
                said.send(&narration).unwrap();
                said.tick().unwrap();
                scores.wait(Duration::from_millis(3)).unwrap();
                while scores.receive().unwrap().is_some() {}
            }
        }
    }
}

/// The next message, malformed or not: the children send empty ones.
fn received<M: Message>(subscriber: &Subscriber<M>) -> Option<M> {
    let mut message = M::default();
    subscriber.receive_from(&mut message).unwrap().map(|_| message)
}

/// In a child process, which runs this same test, takes part until the kill.
fn take_part_as_child() {
    let Ok(what) = std::env::var(CHILD) else { return };
    let [role, root, name] = what.split(' ').collect::<Vec<_>>()[..] else { panic!("{what:?}") };
    let node = Domain::new(root, name).unwrap().open(role).unwrap();
    take_part(role, &node);
}

fn start(role: &str, domain: &Domain) -> Child {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "killed::nothing_stays_of_participants_killed_at_any_moment", "--nocapture"]);
    command.env(CHILD, format!("{role} {} {}", domain.root().display(), domain.name()));
    command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().unwrap()
}

fn files(domain: &Domain) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let prefix = domain.prefix();
    let mut folders = vec![domain.root().to_owned(), Path::new("/dev/shm").to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let (path, name) = (entry.path(), entry.file_name().into_string().unwrap());
            if path.is_dir() && path.starts_with(domain.root()) {
                if path.parent().unwrap().ends_with("nodes") {
                    files.push(path.clone());
                }
                folders.push(path);
            } else if name.starts_with(&prefix) {
                files.push(path);
            }
        }
    }
    files
}

/// Half-made files are removed only after some seconds, so the test makes them a minute old.
fn age(files: &[PathBuf]) {
    for path in files {
        // Sockets cannot be opened, nor files without permission.
        if let Ok(file) = std::fs::File::open(path) {
            file.set_modified(SystemTime::now() - Duration::from_secs(60)).unwrap();
        }
    }
}

fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}: give a number")))
}

#[test]
fn nothing_stays_of_participants_killed_at_any_moment() {
    take_part_as_child();
    let private = Private::new("killed");
    let domain = &private.domain;
    let kills = number("ROOMCAST_KILLS").map_or(KILLS, |kills| usize::try_from(kills).unwrap());
    let mut random = number("ROOMCAST_KILLS_SEED").unwrap_or(1).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    // Xorshift is random enough for the moments.
    let mut below = |limit: u64| {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random % limit
    };
    let node = domain.open("test").unwrap();
    let living = node.subscriber::<RoomScoresV1>().unwrap();
    let own = files(domain).len();
    let roles = ["daemon", "planner", "narrator"];
    let mut children = roles.map(|role| start(role, domain));
    for _ in 0..kills {
        let who = below(3) as usize;
        // A random moment of its life.
        std::thread::sleep(Duration::from_micros(below(20_000)));
        children[who].kill().unwrap();
        children[who].wait().unwrap();
        children[who] = start(roles[who], domain);
    }
    for child in &mut children {
        child.kill().unwrap();
        child.wait().unwrap();
    }
    // Sockets keep their age: half-made ones are removed after ten seconds.
    let mut left = Vec::new();
    let _clean = waited(Duration::from_secs(40), || {
        node.clean_up_dead();
        let still = files(domain);
        if still == left {
            age(&still);
        }
        left = still;
        (left.len() <= own).then_some(())
    });
    drop((living, node));
    let left = files(domain);
    println!("{kills} kills, left behind: {}", left.len());
    assert!(left.is_empty(), "{left:#?}");
    assert!(domain.clean_up().unwrap());
}

/// The maker of a service is killed before its shared memory has a size. iceoryx2 alone would wait forever for the size: to open the service, to
/// send, or to clean up.
#[test]
fn memory_that_never_got_its_size_keeps_nobody_waiting() {
    let private = Private::new("sizeless");
    let domain = &private.domain;
    let services = |domain: &Domain| {
        let mut services = files(domain);
        services.retain(|file| file.extension().is_some_and(|ending| ending == "dynamic"));
        services
    };
    let mut child = start("daemon", domain);
    // A daemon has seven ports, each with its service.
    eventually("the child opens its ports", || (services(domain).len() >= 7).then_some(()));
    child.kill().unwrap();
    child.wait().unwrap();
    for memory in services(domain) {
        std::fs::File::create(memory).unwrap();
    }
    // A thread, so that an endless wait fails the test.
    let (done, ended) = std::sync::mpsc::channel();
    let own = domain.clone();
    std::thread::spawn(move || {
        let node = own.open("next").unwrap();
        let scores = node.publisher::<RoomScoresV1>().unwrap();
        node.clean_up_dead();
        scores.send_unchecked(&RoomScoresV1::default()).unwrap();
        drop((scores, node));
        done.send(own.clean_up().unwrap()).unwrap();
    });
    assert!(ended.recv_timeout(Duration::from_secs(60)).expect("somebody still waits after a minute"));
    assert_eq!(files(domain), Vec::<PathBuf>::new());
}

/// A participant's folder and the files of its monitor.
fn entries_of(child: &Child, domain: &Domain) -> Vec<PathBuf> {
    let of_child = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy();
        let number = name.trim_start_matches(&domain.prefix()).split('.').next().and_then(|id| id.parse::<u128>().ok());
        number.is_some_and(|number| (number >> 64) as u32 == child.id())
    };
    let nodes = std::fs::read_dir(domain.root().join("nodes")).unwrap().map(|entry| entry.unwrap().path());
    nodes.filter(of_child).collect()
}

/// iceoryx2 may momentarily fail to remove a dead participant from a service: the monitor is then removed, but the entry stays.
#[test]
fn a_participant_without_its_monitor_leaves_its_services() {
    let private = Private::new("monitor");
    let domain = &private.domain;
    // Without this participant the whole service would be removed.
    let node = domain.open("stays").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let mut child = start("daemon", domain);
    eventually("the child sends its first message", || received(&scores));
    child.kill().unwrap();
    child.wait().unwrap();
    for entry in entries_of(&child, domain).iter().filter(|entry| entry.is_file()) {
        std::fs::remove_file(entry).unwrap();
    }
    age(&entries_of(&child, domain));
    node.clean_up_dead();
    assert_eq!(entries_of(&child, domain), Vec::<PathBuf>::new());
    // The last participant of a service removes it.
    drop((scores, node));
    let mut services = files(domain);
    services.retain(|file| file.extension().is_some_and(|ending| ending == "service" || ending == "dynamic"));
    assert!(services.is_empty(), "{services:#?}");
    assert!(domain.clean_up().unwrap());
}

/// Removes a participant's entry and then kills it, so its places in services stay taken.
fn end_without_entry(mut child: Child, domain: &Domain) {
    let entries = entries_of(&child, domain);
    assert!(entries.len() > 1, "a folder and a monitor: {entries:?}");
    for path in entries {
        if path.is_dir() { std::fs::remove_dir_all(path).unwrap() } else { std::fs::remove_file(path).unwrap() }
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

/// iceoryx2 may remove a dead participant and leave its places taken. Here the test removes the entry before the kill.
#[test]
fn a_place_whose_holder_is_no_participant_any_more_comes_free() {
    let private = Private::new("places");
    let domain = &private.domain;
    // Without this participant the services would be removed.
    let node = domain.open("stays").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let child = start("daemon", domain);
    eventually("the child sends its first message", || received(&scores));
    end_without_entry(child, domain);
    let next = node.publisher::<RoomScoresV1>().unwrap();
    next.send_unchecked(&RoomScoresV1 { sequence: 77, ..RoomScoresV1::default() }).unwrap();
    eventually("the scores of the next publisher arrive", || received(&scores).filter(|scores| scores.sequence == 77));
    drop((scores, next, node));
    assert!(domain.clean_up().unwrap());
}

/// The same with a dead holder among living ones.
#[test]
fn a_place_of_nobody_comes_free_among_those_of_the_living() {
    let private = Private::new("among");
    let domain = &private.domain;
    let node = domain.open("stays").unwrap();
    let heard = node.subscriber::<NarrationV1>().unwrap();
    let child = start("narrator", domain);
    eventually("the child sends its first message", || received(&heard));
    let living: Vec<_> =
        (1..NarrationV1::SERVICE.publishers).map(|_| node.publisher::<NarrationV1>().unwrap()).collect();
    end_without_entry(child, domain);
    let last = node.publisher::<NarrationV1>().unwrap();
    drop((heard, living, last, node));
    assert!(domain.clean_up().unwrap());
}

/// The files of a service with its last participant killed before it removed them: closed to others, or still open after a slightly earlier kill.
fn leave_service_behind(domain: &Domain, closed: bool) {
    let all = files(domain);
    let node = domain.open("leaves").unwrap();
    let scores = node.publisher::<RoomScoresV1>().unwrap();
    let ending = |path: &Path| path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_owned();
    let of_services: Vec<_> = files(domain)
        .into_iter()
        .filter(|path| !all.contains(path) && ["service", "dynamic"].contains(&ending(path).as_str()))
        .map(|path| (std::fs::File::open(&path).unwrap(), std::fs::read(&path).unwrap(), path))
        .collect();
    // Messages and their wake-ups.
    assert_eq!(of_services.len(), 4);
    drop((scores, node));
    for (mut file, before, path) in of_services {
        assert!(!path.exists());
        let mut after = Vec::new();
        file.read_to_end(&mut after).unwrap();
        if !closed {
            // iceoryx2 closes a list with all ones in its change counter. A removed participant's number becomes all ones too, but that number was
            // large.
            for (after, before) in after.chunks_exact_mut(8).zip(before.chunks_exact(8)) {
                if after == [0xff; 8] && before[2..] == [0; 6] {
                    after.copy_from_slice(before);
                }
            }
        }
        std::fs::write(&path, after).unwrap();
        std::fs::set_permissions(path, file.metadata().unwrap().permissions()).unwrap();
    }
}

#[test]
fn a_service_that_was_closed_and_not_removed_keeps_nobody_out() {
    let private = Private::new("closed");
    let domain = &private.domain;
    let node = domain.open("stays").unwrap();
    leave_service_behind(domain, true);
    let scores = node.publisher::<RoomScoresV1>().unwrap();
    drop((scores, node));
    assert!(files(domain).is_empty(), "{:#?}", files(domain));
}

#[test]
fn a_service_that_nobody_is_in_is_removed() {
    let private = Private::new("unused");
    let domain = &private.domain;
    let node = domain.open("stays").unwrap();
    let own = files(domain);
    leave_service_behind(domain, false);
    assert_eq!(files(domain).len(), own.len() + 4);
    eventually("the service is removed", || {
        node.clean_up_dead();
        (files(domain) == own).then_some(())
    });
    drop(node);
    assert!(files(domain).is_empty(), "{:#?}", files(domain));
}

/// The maker was killed just now, before the memory had a size.
#[test]
fn a_service_that_was_just_not_finished_keeps_nobody_out_for_long() {
    let private = Private::new("halves");
    let domain = &private.domain;
    let node = domain.open("stays").unwrap();
    let own = files(domain);
    leave_service_behind(domain, true);
    let now = SystemTime::now();
    for path in files(domain).into_iter().filter(|path| !own.contains(path)) {
        if path.extension().is_some_and(|ending| ending == "dynamic") {
            std::fs::File::create(path).unwrap();
        } else {
            std::fs::File::open(path).unwrap().set_modified(now).unwrap();
        }
    }
    let scores = node.publisher::<RoomScoresV1>().unwrap();
    drop((scores, node));
    assert!(files(domain).is_empty(), "{:#?}", files(domain));
}
