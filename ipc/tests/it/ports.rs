//! The ports with real shared memory. Each test has its own domain.

use std::os::unix::fs::PermissionsExt;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use iceoryx2::prelude::ZeroCopySend;
use roomcast_ipc::raw::{
    DecisionV1, Field, ItemScoreV1, ItemScoresHeaderV1, Layout, MAX_ITEMS, Message, NarrationV1, RobotReportV1,
    RoomScoresV1, ServiceQuality, StatusResponseV1, narration_kind,
};
use roomcast_ipc::{Domain, IpcError, MessageError, question, text};

use crate::Private;
use crate::eventually::eventually;

impl Private {
    fn shared_memory_files(&self) -> usize {
        let prefix = self.domain.prefix();
        let files = std::fs::read_dir("/dev/shm").unwrap();
        files.filter(|file| file.as_ref().unwrap().file_name().to_string_lossy().starts_with(&prefix)).count()
    }
}

fn narration(sequence: u64, content: &str) -> NarrationV1 {
    let message = NarrationV1::new(narration_kind::SENTENCE, content).unwrap();
    NarrationV1 { source: 7, epoch: 1, sequence, ..message }
}

fn scores(sequence: u64) -> RoomScoresV1 {
    let mut scores = RoomScoresV1 { epoch: 9, sequence, room_count: 1, label_mass: 0.5, ..Default::default() };
    scores.room[0].id = text::encode("room id", "kitchen").unwrap();
    scores.room[0].probability = 1.0;
    scores
}

#[test]
fn a_narration_arrives_and_wakes() {
    let private = Private::new("arrives");
    let daemon = private.domain.open("daemon").unwrap();
    let subscriber = daemon.subscriber::<NarrationV1>().unwrap();
    let sender = private.domain.clone();
    let (read, was_read) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        let narrator = sender.open("narrator").unwrap();
        let publisher = narrator.publisher::<NarrationV1>().unwrap();
        publisher.send(&narration(1, "They grab the mug.")).unwrap();
        // If a publisher ends before the subscriber has noticed it, its messages are lost.
        was_read.recv().unwrap();
    });
    let message = eventually("the narration arrives", || {
        subscriber.wait(Duration::from_secs(5)).unwrap();
        subscriber.receive().unwrap()
    });
    assert_eq!(message.text(), "They grab the mug.");
    read.send(()).unwrap();
    thread.join().unwrap();
}

/// Each message has an answer, so both sides sleep before nearly every message, and a lost wake-up stops both.
#[test]
fn of_many_messages_each_wakes_whoever_waits_for_it() {
    const MESSAGES: u64 = 20_000;
    let private = Private::new("ping");
    let (here, there) = (private.domain.open("here").unwrap(), private.domain.clone());
    let (narrator, answers) = (here.publisher::<NarrationV1>().unwrap(), here.subscriber::<RoomScoresV1>().unwrap());
    let (ready, is_ready) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        let node = there.open("there").unwrap();
        let (heard, answer) = (node.subscriber::<NarrationV1>().unwrap(), node.publisher::<RoomScoresV1>().unwrap());
        ready.send(()).unwrap();
        // The next message means that the last answer was read, so the publisher may end after it.
        let mut next = 1;
        while next <= MESSAGES + 1 {
            assert!(heard.wait(Duration::MAX).unwrap(), "nothing ends a wait without an end");
            while let Some(message) = heard.receive().unwrap() {
                assert_eq!(message.sequence, next);
                answer.send(&scores(next)).unwrap();
                next += 1;
            }
        }
    });
    is_ready.recv().unwrap();
    for sequence in 1..=MESSAGES {
        narrator.send(&narration(sequence, "They grab the mug.")).unwrap();
        let answered = std::iter::repeat_with(|| {
            assert!(answers.wait(Duration::from_secs(60)).unwrap(), "woken for {sequence}");
            answers.newest().unwrap()
        });
        assert!(answered.flatten().any(|scores| scores.sequence == sequence));
    }
    narrator.send(&narration(MESSAGES + 1, "They leave.")).unwrap();
    thread.join().unwrap();
}

#[test]
fn a_late_joiner_gets_the_newest_snapshot_from_a_tick_alone() {
    let private = Private::new("late");
    let daemon = private.domain.open("daemon").unwrap();
    let publisher = daemon.publisher::<RoomScoresV1>().unwrap();
    publisher.send(&scores(1)).unwrap();
    publisher.send(&scores(2)).unwrap();
    let planner = private.domain.open("planner").unwrap();
    let late = planner.subscriber::<RoomScoresV1>().unwrap();
    publisher.tick().unwrap();
    assert_eq!(eventually("a late subscriber gets the newest scores", || late.newest().unwrap()).sequence, 2);
}

/// A recorder gets later messages only.
#[test]
fn whoever_listens_from_now_gets_no_history() {
    let private = Private::new("now");
    let narrator = private.domain.open("narrator").unwrap();
    let publisher = narrator.publisher::<NarrationV1>().unwrap();
    publisher.send(&narration(1, "before")).unwrap();
    let others = private.domain.open("others").unwrap();
    let (late, from_now) =
        (others.subscriber::<NarrationV1>().unwrap(), others.subscriber_from_now::<NarrationV1>().unwrap());
    publisher.tick().unwrap();
    publisher.send(&narration(2, "after")).unwrap();
    let sequence = |subscriber: &roomcast_ipc::Subscriber<NarrationV1>| {
        eventually("the narration arrives", || subscriber.receive().unwrap()).sequence
    };
    assert_eq!([sequence(&late), sequence(&late), sequence(&from_now)], [1, 2, 2]);
    assert!(from_now.receive().unwrap().is_none());
}

#[test]
fn a_slow_subscriber_keeps_the_newest_and_the_publisher_does_not_wait() {
    let private = Private::new("slow");
    let daemon = private.domain.open("daemon").unwrap();
    let publisher = daemon.publisher::<RoomScoresV1>().unwrap();
    let slow = daemon.subscriber::<RoomScoresV1>().unwrap();
    for sequence in 1..=1000 {
        publisher.send(&scores(sequence)).unwrap();
    }
    assert_eq!(slow.newest().unwrap().unwrap().sequence, 1000);
}

#[test]
fn a_hostile_message_is_reported_and_the_next_one_is_good() {
    let private = Private::new("hostile");
    let node = private.domain.open("both").unwrap();
    let subscriber = node.subscriber::<NarrationV1>().unwrap();
    let publisher = node.publisher::<NarrationV1>().unwrap();
    let hostile = NarrationV1 { text: [0xff; 1024], text_bytes: 1024, ..narration(1, "x") };
    assert!(matches!(publisher.send(&hostile), Err(IpcError::Refused { .. })));
    publisher.send_unchecked(&hostile).unwrap();
    publisher.send_unchecked(&NarrationV1 { text_bytes: u32::MAX, ..narration(2, "x") }).unwrap();
    publisher.send(&narration(3, "They sit on the sofa.")).unwrap();
    let mut message = NarrationV1::default();
    let mut judged = || subscriber.receive_from(&mut message).unwrap().unwrap().0;
    assert!(matches!(judged(), Err(MessageError::NotUtf8 { at: 0, .. })));
    assert!(matches!(judged(), Err(MessageError::OutOfRange { .. })));
    assert_eq!((judged(), message.sequence), (Ok(()), 3));
}

#[test]
fn receive_drops_malformed_messages_and_counts_them() {
    let private = Private::new("drops");
    let node = private.domain.open("both").unwrap();
    let subscriber = node.subscriber::<NarrationV1>().unwrap();
    let publisher = node.publisher::<NarrationV1>().unwrap();
    publisher.send_unchecked(&NarrationV1 { text_bytes: u32::MAX, ..narration(1, "x") }).unwrap();
    publisher.send(&narration(2, "They sit on the sofa.")).unwrap();
    publisher.send_unchecked(&NarrationV1 { text: [0xff; 1024], text_bytes: 1024, ..narration(3, "x") }).unwrap();
    assert_eq!(subscriber.receive().unwrap().map(|message| message.sequence), Some(2));
    assert_eq!(subscriber.receive().unwrap(), None);
    assert_eq!(subscriber.malformed(), 2);
}

#[test]
fn a_second_daemon_is_refused_by_name_of_the_service() {
    let private = Private::new("second");
    let first = private.domain.open("daemon").unwrap();
    let held = first.publisher::<RoomScoresV1>().unwrap();
    // The waiting participant reports the holder once, long before its timeout.
    static TOLD: Mutex<Vec<(Instant, String)>> = Mutex::new(Vec::new());
    let tell = |error: &IpcError| TOLD.lock().unwrap().push((Instant::now(), error.to_string()));
    let second = private.domain.open("daemon").unwrap().telling_of_waits(tell);
    let start = Instant::now();
    let error = second.publisher::<RoomScoresV1>().unwrap_err();
    let told = std::mem::take(&mut *TOLD.lock().unwrap());
    assert!(told.len() == 1 && told[0].1.starts_with("daemon (process"), "{told:?}");
    assert!(told[0].0 - start < start.elapsed() / 2, "{:?} of {:?}", told[0].0 - start, start.elapsed());
    assert!(matches!(error, IpcError::Occupied { role: "publisher", limit: 1, .. }), "{error}");
    assert!(error.to_string().contains("roomcast/v1/room-scores"), "{error}");
    drop(held);
    second.publisher::<RoomScoresV1>().unwrap();
}

/// A later version of the scores under the old service name.
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[repr(C)]
#[type_name("roomcast.RoomScoresV2")]
struct RoomScoresV2 {
    epoch: u64,
}

impl Layout for RoomScoresV2 {
    const TYPE_NAME: &'static str = "roomcast.RoomScoresV2";
    const FIELDS: &'static [Field] = &[];
}

impl Message for RoomScoresV2 {
    const SERVICE: ServiceQuality = RoomScoresV1::SERVICE;

    fn check(&self) -> Result<(), MessageError> {
        Ok(())
    }
}

#[test]
fn one_subscriber_too_many_is_told_who_is_there() {
    let private = Private::new("crowd");
    let node = private.domain.open("crowd").unwrap();
    let places = RobotReportV1::SERVICE.subscribers;
    let _all: Vec<_> = (0..places).map(|_| node.subscriber::<RobotReportV1>().unwrap()).collect();
    let error = node.subscriber::<RobotReportV1>().unwrap_err();
    let said = error.to_string();
    assert!(matches!(error, IpcError::Occupied { role: "subscriber", limit, .. } if limit == places), "{said}");
    assert!(said.starts_with("crowd (process") && said.contains("are here already"), "{said}");
}

#[test]
fn another_message_version_is_one_error_that_names_both_sides() {
    let private = Private::new("version");
    let node = private.domain.open("new-daemon").unwrap();
    let _running = node.publisher::<RoomScoresV2>().unwrap();
    let error = node.subscriber::<RoomScoresV1>().unwrap_err().to_string();
    assert!(error.contains("roomcast.RoomScoresV2 of 8 bytes"), "{error}");
    assert!(error.contains("roomcast.RoomScoresV1 of 6016 bytes"), "{error}");
}

#[test]
fn item_scores_flow_only_when_wanted() {
    let private = Private::new("items");
    let node = private.domain.open("both").unwrap();
    let publisher = node.item_scores_publisher().unwrap();
    assert!(!publisher.wanted() && !publisher.tick().unwrap());
    let subscriber = node.item_scores_subscriber().unwrap();
    assert!(publisher.wanted());
    assert!(publisher.tick().unwrap(), "the first one wants them now");
    assert!(!publisher.tick().unwrap());
    let header = ItemScoresHeaderV1 { epoch: 1, sequence: 5, ..Default::default() };
    for count in [3, 700] {
        let items = (0..count).map(|index| ItemScoreV1 { partition: index, ..Default::default() });
        publisher.send(header, items.collect::<Vec<_>>().into_iter()).unwrap();
        let received = subscriber.newest().unwrap().unwrap();
        assert_eq!((received.header.sequence, received.items.len()), (5, count as usize));
        assert_eq!(received.items.last().unwrap().partition, count - 1);
    }
}

#[test]
fn status_is_answered_or_its_absence_is_said() {
    let private = Private::new("status");
    let node = private.domain.open("both").unwrap();
    let client = node.status_client().unwrap();
    assert!(matches!(client.ask(Duration::from_millis(50)), Err(IpcError::NoAnswer { .. })));
    let server = node.status_server().unwrap();
    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        while stopped.try_recv().is_err() {
            server.answer(|| StatusResponseV1 { steps: 42, ..Default::default() }).unwrap();
            // The daemon's pace.
            std::thread::sleep(Duration::from_millis(1));
        }
    });
    assert_eq!(client.ask(Duration::from_secs(30)).unwrap().steps, 42);
    stop.send(()).unwrap();
    thread.join().unwrap();
}

#[test]
fn questions_in_words_are_answered_at_any_length_or_their_absence_is_said() {
    let private = Private::new("questions");
    let node = private.domain.open("both").unwrap();
    let client = node.question_port(question::MOMENT).unwrap();
    assert!(matches!(client.ask("{}", Duration::from_millis(50)), Err(IpcError::NoAnswer { .. })));
    let server = node.answer_port(question::MOMENT).unwrap();
    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        while stopped.try_recv().is_err() {
            server.answer(|asked| asked.unwrap().chars().rev().collect()).unwrap();
            // The daemon's pace.
            std::thread::sleep(Duration::from_millis(1));
        }
    });
    let patience = Duration::from_secs(30);
    assert_eq!(client.ask("stressed", patience).unwrap(), "desserts");
    // Longer than the ports' buffers: the question's buffer grows, and the answer is in a file.
    let long = "ab".repeat(400_000);
    assert_eq!(client.ask(&long, patience).unwrap(), "ba".repeat(400_000));
    // An answer may contain personal data, so its file is deleted after it is read.
    assert_eq!(answer_files(&private.domain), 0);
    // If the file cannot be written, as on a full disk, the asker gets the reason at once.
    let (root, moved) = (private.domain.root(), private.domain.root().with_extension("moved"));
    std::fs::rename(root, &moved).unwrap();
    let error = client.ask(&long, patience).unwrap_err();
    let why = error.to_string();
    assert!(matches!(error, IpcError::NotGiven { .. }) && why.contains("the answer of 800000 bytes cannot"), "{why}");
    std::fs::rename(&moved, root).unwrap();
    assert_eq!(client.ask(&long, patience).unwrap(), "ba".repeat(400_000));
    let too_long = "a".repeat(question::QUESTION_BYTES_MAX + 1);
    assert!(matches!(client.ask(&too_long, patience), Err(IpcError::Refused { .. })));
    stop.send(()).unwrap();
    thread.join().unwrap();
}

/// Formerly, a client never got an answer that took longer than half a second.
#[test]
fn a_daemon_that_answers_slowly_is_asked_once() {
    let private = Private::new("slow");
    let node = private.domain.open("both").unwrap();
    let (server, client) = (node.answer_port(question::MOMENT).unwrap(), node.question_port(question::MOMENT).unwrap());
    let (told, is_told) = std::sync::mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        let mut asked = 0;
        let mut answer = |_: Result<&str, _>| {
            asked += 1;
            std::thread::sleep(Duration::from_millis(1_200));
            "late".to_owned()
        };
        while is_told.try_recv().is_err() {
            server.answer(&mut answer).unwrap();
        }
        asked
    });
    let answer = client.ask("{}", Duration::from_secs(60));
    told.send(()).unwrap();
    assert_eq!((answer.unwrap().as_str(), thread.join().unwrap()), ("late", 1));
}

/// A daemon allocates its shared memory at the start. Formerly, a full `/dev/shm` ended it by a signal at the next long answer.
#[test]
fn neither_a_long_answer_nor_many_items_take_more_shared_memory() {
    let private = Private::new("no-more");
    let (daemon, other) = (private.domain.open("daemon").unwrap(), private.domain.open("other").unwrap());
    let server = daemon.answer_port(question::MOMENT).unwrap();
    let client = other.question_port(question::MOMENT).unwrap();
    let (items_out, items_in) = (daemon.item_scores_publisher().unwrap(), other.item_scores_subscriber().unwrap());
    let talk = |bytes: usize, items: usize| {
        std::thread::scope(|scope| {
            scope.spawn(|| while server.answer(|_| "a".repeat(bytes)).unwrap() == 0 {});
            assert_eq!(client.ask("{}", Duration::from_secs(30)).unwrap().len(), bytes);
        });
        items_out.tick().unwrap();
        items_out.send(ItemScoresHeaderV1::default(), (0..items).map(|_| ItemScoreV1::default())).unwrap();
        assert_eq!(items_in.newest().unwrap().unwrap().items.len(), items);
    };
    talk(10, 8);
    let before = private.shared_memory_files();
    talk(question::ANSWER_BYTES_MAX, 600);
    talk(question::ANSWER_BYTES_MAX + 1, MAX_ITEMS);
    talk(200_000, 8);
    assert_eq!(private.shared_memory_files(), before);
}

/// Files of unread answers.
fn answer_files(domain: &Domain) -> usize {
    let files = std::fs::read_dir(domain.root()).unwrap().map(|file| file.unwrap().path());
    files.filter(|path| path.extension().is_some_and(|end| end == "answer")).count()
}

/// Several clients ask one service at once, each for a long answer. Formerly all answers used one file, and a refused change read as done.
#[test]
fn nobody_reads_what_somebody_else_was_answered() {
    const ASKERS: usize = 4;
    let private = Private::new("mixed-up");
    let node = private.domain.open("daemon").unwrap();
    let server = node.answer_port(question::MOMENT).unwrap();
    let domain = &private.domain;
    std::thread::scope(|scope| {
        let ask = |asker: usize| {
            let node = domain.open("asker").unwrap();
            let client = node.question_port(question::MOMENT).unwrap();
            let own = asker.to_string().repeat(question::ANSWER_BYTES_MAX + 1);
            for _ in 0..50 {
                assert!(client.ask(&own, Duration::from_secs(60)).unwrap() == own, "asker {asker}");
            }
        };
        let askers: Vec<_> = (1..=ASKERS).map(|asker| scope.spawn(move || ask(asker))).collect();
        while !askers.iter().all(std::thread::ScopedJoinHandle::is_finished) {
            server.answer(|asked| asked.unwrap().to_owned()).unwrap();
        }
    });
    assert_eq!(answer_files(domain), 0, "each was read");
}

/// Few unread answers are kept. A daemon deletes them at its start and end, and when it forgets a person.
#[test]
fn unread_answers_are_few_and_can_be_forgotten() {
    let private = Private::new("unread");
    let (domain, node) = (&private.domain, private.domain.open("daemon").unwrap());
    let of_before = |service: &str| domain.root().join(format!("{}{service}-0123456789abcdef.answer", domain.prefix()));
    for service in ["moment", "person"] {
        std::fs::write(of_before(service), "of a daemon that was killed").unwrap();
    }
    let server = node.answer_port(question::MOMENT).unwrap();
    assert!(!of_before("moment").exists() && of_before("person").exists(), "each service has its own");
    std::fs::remove_file(of_before("person")).unwrap();
    let client = node.question_port(question::MOMENT).unwrap();
    // The client gives up before the answer comes.
    let unread = |times: usize| {
        for _ in 0..times {
            assert!(client.ask("{}", Duration::from_millis(1)).is_err());
            server.answer(|_| "a".repeat(question::ANSWER_BYTES_MAX + 1)).unwrap();
        }
    };
    unread(3 * question::ANSWER_FILES_MAX);
    assert_eq!(answer_files(domain), question::ANSWER_FILES_MAX);
    server.forget_answers();
    assert_eq!(answer_files(domain), 0);
    unread(1);
    assert_eq!(answer_files(domain), 1);
    drop(server);
    assert_eq!(answer_files(domain), 0);
}

#[test]
fn cleaning_up_leaves_nothing() {
    let private = Private::new("clean");
    let node = private.domain.open("daemon").unwrap();
    let publisher = node.publisher::<RoomScoresV1>().unwrap();
    assert!(private.shared_memory_files() > 0);
    assert!(!private.domain.clean_up().unwrap(), "a domain with somebody in it stays");
    drop((publisher, node));
    assert!(private.domain.clean_up().unwrap());
    assert_eq!(private.shared_memory_files(), 0);
    assert!(!private.domain.root().exists());
}

/// iceoryx2's counter of participants exists until the last participant ends.
#[test]
fn the_last_one_out_leaves_nothing_in_shared_memory() {
    let private = Private::new("last-out");
    let [first, second] = ["first", "second"].map(|name| private.domain.open(name).unwrap());
    let publisher = first.publisher::<RoomScoresV1>().unwrap();
    drop((publisher, first));
    assert!(private.shared_memory_files() > 0, "somebody is there still");
    drop(second);
    assert_eq!(private.shared_memory_files(), 0);
    drop(private.domain.open("third").unwrap());
    assert_eq!(private.shared_memory_files(), 0);
}

/// The first participant was killed between creating the counter and giving it a size.
#[test]
fn a_counter_without_a_size_keeps_nobody_out() {
    let private = Private::new("no-size");
    let node = private.domain.open("first").unwrap();
    let prefix = private.domain.prefix();
    let names = std::fs::read_dir("/dev/shm").unwrap().map(|file| file.unwrap().path());
    let ours = |path: &std::path::PathBuf| path.file_name().unwrap().to_string_lossy().starts_with(&prefix);
    let counter = names.filter(ours).find(|path| path.extension().is_some_and(|end| end == "global_mgmt")).unwrap();
    drop(node);
    let file = std::fs::File::create(&counter).unwrap();
    file.set_modified(std::time::SystemTime::now() - Duration::from_secs(60)).unwrap();
    private.domain.open("second").unwrap();
}

/// The maker of a service was killed between the service's file and its memory, or before it opened the memory to others. iceoryx2 waits for such a
/// service and then always refuses it.
#[test]
fn a_service_without_memory_keeps_nobody_out() {
    let private = Private::new("half-service");
    let node = private.domain.open("maker").unwrap();
    let publisher = node.publisher::<RoomScoresV1>().unwrap();
    let prefix = private.domain.prefix();
    let services = private.domain.root().join("services");
    let files: Vec<_> = std::fs::read_dir(&services).unwrap().map(|file| file.unwrap().path()).collect();
    let contents: Vec<_> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    drop((publisher, node));
    for (file, content) in files.iter().zip(contents) {
        assert!(!file.exists(), "{file:?} outlives its service");
        std::fs::write(file, content).unwrap();
        std::fs::set_permissions(file, std::fs::Permissions::from_mode(0o400)).unwrap();
    }
    let unread = std::path::PathBuf::from(format!("/dev/shm/{prefix}1234.dynamic"));
    std::fs::write(&unread, [0; 64]).unwrap();
    std::fs::set_permissions(&unread, std::fs::Permissions::from_mode(0o200)).unwrap();

    let node = private.domain.open("next").unwrap();
    let publisher = node.publisher::<RoomScoresV1>().unwrap();
    let subscriber = node.subscriber::<RoomScoresV1>().unwrap();
    publisher.send(&scores(1)).unwrap();
    assert_eq!(eventually("the scores arrive", || subscriber.newest().unwrap()).sequence, 1);
    eventually("the unread answer goes", || (!unread.exists()).then_some(()));
    drop((publisher, subscriber, node));
}

/// Two domains with one name in two roots share file names in shared memory. Each took the other's participants for dead and removed their ports
/// after some seconds, and daemons received no more messages.
#[test]
fn what_a_running_process_uses_stays_whatever_root_it_has() {
    let private = Private::new("two-roots");
    let mut other = std::process::Command::new("sleep").arg("60").spawn().unwrap();
    let number = (u128::from(other.id()) << 64) | 5;
    let file = std::path::PathBuf::from(format!("/dev/shm/{}{number}.data", private.domain.prefix()));
    std::fs::write(&file, [0; 64]).unwrap();
    let content = std::fs::File::options().write(true).open(&file).unwrap();
    content.set_permissions(std::fs::Permissions::from_mode(0o600)).unwrap();
    content.set_modified(std::time::SystemTime::now() - Duration::from_secs(60)).unwrap();
    let node = private.domain.open("one").unwrap();
    node.clean_up_dead();
    assert!(file.exists(), "its owner runs");
    drop(node);
    private.domain.clean_up().unwrap();
    assert!(file.exists(), "its owner runs, and takes part elsewhere");
    // The process has ended, and its parent has not reaped it.
    other.kill().unwrap();
    let node = private.domain.open("two").unwrap();
    eventually("the file of the ended owner goes", || {
        node.clean_up_dead();
        (!file.exists()).then_some(())
    });
    drop(node);
    other.wait().unwrap();
}

#[test]
fn cleaning_up_spares_what_is_not_the_domains() {
    let private = Private::new("spares");
    let note = private.domain.root().join("note");
    std::fs::write(&note, "not ours").unwrap();
    drop(private.domain.open("test").unwrap().publisher::<RoomScoresV1>().unwrap());
    assert!(private.domain.clean_up().unwrap());
    assert_eq!(std::fs::read_to_string(&note).unwrap(), "not ours");
    let left = std::fs::read_dir(private.domain.root()).unwrap().count();
    assert_eq!((left, private.shared_memory_files()), (1, 0));
}

#[test]
fn what_killed_participants_left_half_made_is_cleaned_up_and_keeps_nobody_out() {
    let private = Private::new("half-made");
    let (root, prefix) = (private.domain.root().to_owned(), private.domain.prefix());
    let node = private.domain.open("test").unwrap();
    let scores = node.publisher::<RoomScoresV1>().unwrap();
    // A participant without a monitor, one without details, and an unfinished service: first new, then a minute old.
    let nodes = root.join("nodes");
    let (joining, cleaned) = (nodes.join("1234567"), nodes.join("7654321"));
    let monitor = nodes.join(format!("{prefix}7654321.node_monitor"));
    let service = root.join("services").join(format!("{prefix}{}.service", "0".repeat(40)));
    std::fs::create_dir(&joining).unwrap();
    std::fs::write(joining.join(format!("{prefix}node.details")), "").unwrap();
    std::fs::create_dir(&cleaned).unwrap();
    std::fs::write(&monitor, "").unwrap();
    std::fs::write(&service, "").unwrap();
    // A participant with an unfinished monitor: its files are not readable yet.
    let starting = nodes.join("5555555");
    std::fs::create_dir(&starting).unwrap();
    std::fs::write(starting.join(format!("{prefix}node.details")), "").unwrap();
    let unreadable = ["node_monitor", "node_monitor_owner_lock", "node_monitor_context"]
        .map(|kind| nodes.join(format!("{prefix}5555555.{kind}")));
    for file in &unreadable {
        std::fs::write(file, "").unwrap();
    }
    // The remains of a port of process 4321; its participant no longer exists.
    let orphan = format!("/dev/shm/{prefix}{}_{}.event_mgmt", "0".repeat(40), (7_u128 << 96) + (4321 << 64));
    let orphan = std::path::PathBuf::from(orphan);
    std::fs::write(&orphan, "what ports have").unwrap();
    let made = [&joining, &cleaned, &monitor, &service, &orphan, &starting].into_iter().chain(&unreadable);
    let made: Vec<_> = made.collect();
    node.clean_up_dead();
    assert!(made.iter().all(|path| path.exists()), "what may just be in the making is left alone");
    for path in &made {
        let minute_ago = std::time::SystemTime::now() - Duration::from_secs(60);
        std::fs::File::open(path).unwrap().set_modified(minute_ago).unwrap();
    }
    for file in &unreadable {
        std::fs::set_permissions(file, std::fs::Permissions::from_mode(0o200)).unwrap();
    }
    node.clean_up_dead();
    assert!(made.iter().all(|path| !path.exists()), "{made:?}");
    scores.send(&self::scores(1)).unwrap();
    drop((scores, node));
}

#[test]
fn what_belongs_to_the_living_is_left_alone_however_old() {
    let private = Private::new("living");
    let (daemon, planner) = (private.domain.open("daemon").unwrap(), private.domain.open("planner").unwrap());
    // A port may be younger than its participant by more than a second.
    std::thread::sleep(Duration::from_millis(1100));
    let publisher = daemon.publisher::<RoomScoresV1>().unwrap();
    let subscriber = planner.subscriber::<RoomScoresV1>().unwrap();
    publisher.send(&scores(1)).unwrap();
    assert_eq!(eventually("the scores arrive", || subscriber.newest().unwrap()).sequence, 1);
    // Ports with growing messages have their memory in numbered segments, unopened so far.
    let items = daemon.item_scores_publisher().unwrap();
    let (moments, status) = (daemon.answer_port(question::MOMENT).unwrap(), daemon.status_server().unwrap());
    let mut files = Vec::new();
    let mut folders = vec![private.domain.root().to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path.clone());
            }
            files.push(path);
        }
    }
    let prefix = private.domain.prefix();
    let shared = std::fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
    files.extend(shared.filter(|path| path.file_name().unwrap().to_string_lossy().starts_with(&prefix)));
    for path in &files {
        let minute_ago = std::time::SystemTime::now() - Duration::from_secs(60);
        // Sockets cannot be opened and keep their age.
        if let Ok(file) = std::fs::File::open(path) {
            file.set_modified(minute_ago).unwrap();
        }
    }
    daemon.clean_up_dead();
    planner.clean_up_dead();
    let gone: Vec<_> = files.iter().filter(|path| !path.exists()).collect();
    assert!(gone.is_empty(), "{gone:?}");
    publisher.send(&scores(2)).unwrap();
    assert_eq!(eventually("the next scores arrive", || subscriber.newest().unwrap()).sequence, 2);
    let (question, asked) = (planner.question_port(question::MOMENT).unwrap(), planner.status_client().unwrap());
    let stop = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                moments.answer(|asked| asked.unwrap().to_uppercase()).unwrap();
                status.answer(StatusResponseV1::default).unwrap();
                // The daemon's pace.
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        let answers = (question.ask("still here", Duration::from_secs(10)), asked.ask(Duration::from_secs(10)));
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
        assert_eq!(answers.0.unwrap(), "STILL HERE");
        answers.1.unwrap();
    });
    drop((publisher, subscriber, items, question, asked, moments, status, daemon, planner));
}

/// Files under the domain's names that any user may put into `/dev/shm` after a participant has joined.
#[test]
fn pipes_and_links_in_shared_memory_hold_up_nobody_and_stay_as_they_are() {
    use std::os::unix::fs::MetadataExt;

    let private = Private::new("planted");
    let prefix = private.domain.prefix();
    let planted = |name: &str| std::path::PathBuf::from(format!("/dev/shm/{prefix}{name}"));
    let outside = tempfile::tempdir().unwrap();
    let victim = outside.path().join("victim");
    std::fs::File::create(&victim).unwrap().set_len(64 << 20).unwrap();
    std::fs::set_permissions(&victim, std::fs::Permissions::from_mode(0o644)).unwrap();
    let sparse = planted("sparse.data");
    let is_root = rustix::process::geteuid().is_root();
    let plant = |private: &Private| {
        rustix::fs::mkfifoat(rustix::fs::CWD, planted("evil.data"), rustix::fs::Mode::from_raw_mode(0o666)).unwrap();
        std::os::unix::fs::symlink(&victim, planted("link.data")).unwrap();
        std::os::unix::fs::symlink("/nowhere", planted("dangling.data")).unwrap();
        std::fs::create_dir(planted("folder.data")).unwrap();
        std::fs::File::create(&sparse).unwrap().set_len(1 << 20).unwrap();
        std::fs::set_permissions(&sparse, std::fs::Permissions::from_mode(0o644)).unwrap();
        if is_root {
            // Only root can give a file to another user.
            std::os::unix::fs::lchown(planted("evil.data"), Some(65_534), Some(65_534)).unwrap();
            std::fs::File::create(planted("theirs.data")).unwrap().set_len(1 << 20).unwrap();
            std::os::unix::fs::lchown(planted("theirs.data"), Some(65_534), Some(65_534)).unwrap();
        }
        private.shared_memory_files()
    };
    let node = private.domain.open("before").unwrap();
    plant(&private);
    let publisher = node.publisher::<RoomScoresV1>().unwrap();
    let subscriber = node.subscriber::<RoomScoresV1>().unwrap();
    publisher.send(&scores(1)).unwrap();
    assert_eq!(eventually("the scores arrive", || subscriber.newest().unwrap()).sequence, 1);
    node.clean_up_dead();
    // A participant's own file gets its pages. The target of a link gets none.
    assert_eq!(std::fs::metadata(&victim).unwrap().blocks(), 0);
    assert!(std::fs::metadata(&sparse).unwrap().blocks() * 512 >= 1 << 20);
    if is_root {
        assert_eq!(std::fs::metadata(planted("theirs.data")).unwrap().blocks(), 0);
        let refused = private.domain.open("after").unwrap_err();
        assert!(matches!(refused, IpcError::ForeignSharedMemory { owner: 65_534, .. }), "{refused}");
        for theirs in ["evil.data", "theirs.data"] {
            std::os::unix::fs::lchown(planted(theirs), Some(0), Some(0)).unwrap();
        }
    }
    let after = private.domain.open("after").unwrap();
    let decisions = after.publisher::<DecisionV1>().unwrap();
    assert_eq!(std::fs::metadata(&victim).unwrap().mode() & 0o777, 0o644, "a link is not followed");
    assert_eq!(std::fs::metadata(&sparse).unwrap().mode() & 0o777, 0o600);
    assert!(std::fs::symlink_metadata(planted("evil.data")).is_ok() && planted("folder.data").is_dir());
    std::fs::remove_dir(planted("folder.data")).unwrap();
    drop((decisions, after, publisher, subscriber, node));
}
