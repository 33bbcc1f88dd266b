use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use roomcast_ipc::raw::{Message, NarrationV1, RoomScoresV1, narration_kind};
use roomcast_ipc::sequence;
use roomcast_services::recording::{Recorded, Recording};

use super::{
    World, exit_code, includes, probabilities, recorder_listens, recorders_listen, roomcast, scores_with, scoring,
};

#[test]
fn a_running_systems_scores_are_explained_down_to_the_tokens() {
    let mut world = World::new("explain");
    world.start_daemon();
    let lines = "They walk to the kitchen.\nThey open the fridge.\nThey grab the milk.\n";
    assert_eq!(world.narrate("camera", lines).0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let scores = scores_with(&scores, "scores", |scores| includes(scores, "camera", 3));
    let plan = world.directory.path().join("plan.svg");
    let mut command =
        world.command(&["explain", "--live", "--json", "--top", "1000", "--plan", plan.to_str().unwrap()]);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let explained: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let read: Vec<_> = lines.lines().map(serde_json::Value::from).collect();
    assert_eq!(explained["narration"].as_array(), Some(&read));
    let mut labels = 0;
    for (id, probability) in probabilities(&scores) {
        let partitions = explained["partitions"].as_array().unwrap();
        let partition = partitions.iter().find(|partition| partition["id"] == id.as_str()).unwrap();
        assert!((partition["probability"].as_f64().unwrap() - probability).abs() < 1e-9, "{id}");
        for label in partition["labels"].as_array().unwrap() {
            let sum: f64 =
                label["tokens"].as_array().unwrap().iter().map(|token| token["log_prob_nats"].as_f64().unwrap()).sum();
            let sum = sum + label["prior_nats"].as_f64().unwrap();
            assert!((sum - label["log_prob_nats"].as_f64().unwrap()).abs() < 1e-9, "{label}");
            labels += 1;
        }
    }
    assert!(labels > 30, "{labels} labels stand behind the studio's rooms");
    assert!(std::fs::read_to_string(plan).unwrap().contains("They grab the milk."));
}

/// A room's probability for several persons: at least one person's next item is there.
#[test]
fn of_several_persons_the_rooms_are_explained_as_they_are_published() {
    let mut world = World::new("explain-all");
    world.start_daemon();
    let lines = "{\"person\": \"ada\", \"text\": \"They open the fridge.\"}\n{\"person\": \"ben\", \"text\": \"They lie on the bed.\"}\n";
    assert_eq!(world.narrate("camera", lines).0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let scores = scores_with(&scores, "scores", |scores| includes(scores, "camera", 2));
    let output = world.command(&["explain", "--live", "--json"]).output().unwrap();
    let explained: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(explained["persons"].as_array().unwrap().len(), 2);
    let partitions = explained["partitions"].as_array().unwrap();
    for (id, probability) in probabilities(&scores) {
        let partition = partitions.iter().find(|partition| partition["id"] == id.as_str()).unwrap();
        assert!((partition["probability"].as_f64().unwrap() - probability).abs() < 1e-9, "{id}");
    }
    let falls = |pair: &[serde_json::Value]| pair[0]["probability"].as_f64() >= pair[1]["probability"].as_f64();
    assert!(partitions.windows(2).all(falls), "{partitions:?}");
}

/// The last recorded scores.
fn last_scores(recording: &Recording) -> RoomScoresV1 {
    let scores = recording.messages.iter().rev().find_map(|(_, message)| match message {
        Recorded::RoomScores(scores) => Some(**scores),
        _ => None,
    });
    scores.unwrap()
}

#[test]
fn a_recorded_run_replays_to_the_same_narration_and_scores_and_explains_any_of_them() {
    let (mut world, _, node, _scores) = scoring("record");
    // Events before the recording belong to its windows.
    assert_eq!(world.narrate("early", "They wake up.\nThey walk to the bathroom.\n").0, 0);
    let file = world.directory.path().join("day.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    let lines = "They walk to the kitchen.\nThey open the fridge.\nThey grab the milk.\nThey close the fridge.\n";
    for (number, line) in lines.lines().enumerate() {
        assert_eq!(world.narrate(&format!("camera-{number}"), line).0, 0);
    }
    let log = world.stop(recorder);

    let recording = roomcast_services::recording::read(&file).unwrap();
    let narration = |recording: &Recording| -> Vec<Vec<u8>> {
        let messages = recording.messages.iter().map(|(_, message)| message);
        messages.filter(|m| m.topic() == NarrationV1::SERVICE.name).map(|m| m.to_bytes()).collect()
    };
    let recorded = last_scores(&recording);
    let told = recording.messages.iter().filter_map(|(_, message)| match message {
        Recorded::Narration(narration) => Some(narration.text().to_owned()),
        _ => None,
    });
    assert_eq!(told.collect::<Vec<_>>().join("\n") + "\n", lines, "{log}");
    assert_eq!(recorded.window, 6);

    let explain = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
        let output = command.args(["explain", "--recording", file.to_str().unwrap()]).args(more).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    let text = explain(&["--top", "3"]);
    assert!(text.contains("They wake up.") && text.contains("They close the fridge."), "{text}");
    let earlier = explain(&["--sequence", &(recorded.sequence - 1).to_string()]);
    assert!(earlier.contains("They grab the milk.") && !earlier.contains("They close the fridge."), "{earlier}");

    // A replay into another domain gives the same narration, and scores within the scorer's tolerance.
    let (mut other, _, other_node, other_scores) = scoring("replay");
    let early = "They wake up.\nThey walk to the bathroom.\n";
    assert_eq!(other.narrate("early", early).0, 0);
    let second = other.directory.path().join("again.mcap");
    let recorder = other.start(&["record", second.to_str().unwrap()]);
    recorder_listens(&other_node);
    let replayed = other.command(&["replay", file.to_str().unwrap(), "--speed", "50"]).output().unwrap();
    assert!(replayed.status.success(), "{replayed:?}");
    let said = String::from_utf8(replayed.stderr).unwrap();
    assert!(said.contains(&format!("4 of {} messages replayed", recording.messages.len())), "{said}");
    assert!(
        said.contains("the others are scores, forecasts, decisions and reports") && !said.contains("before"),
        "{said}"
    );
    let last = scores_with(&other_scores, "all of it", |scores| includes(scores, "camera-3", 1));
    other.stop(recorder);
    let again = roomcast_services::recording::read(&second).unwrap();
    assert_eq!(narration(&again), narration(&recording), "bit for bit");
    assert_eq!(last.window, recorded.window);
    for (a, b) in recorded.rooms().iter().zip(last.rooms()) {
        assert!((a.probability - b.probability).abs() < 5e-3 && a.id == b.id, "{} {}", a.probability, b.probability);
    }
    let twice = other.command(&["replay", file.to_str().unwrap(), "--speed", "50"]).output().unwrap();
    let said = String::from_utf8(twice.stderr).unwrap();
    assert!(said.contains("the daemon has taken in 4 of them before and takes none twice"), "{said}");
    // The daemon has all events, so replay need not wait.
    let at_once =
        other.command(&["replay", file.to_str().unwrap(), "--speed", "50", "--linger", "0"]).output().unwrap();
    assert!(at_once.status.success(), "{at_once:?}");
    // A running daemon would treat every recorded message as current.
    let beside = other.command(&["replay", file.to_str().unwrap(), "--all", "--speed", "50"]).output().unwrap();
    assert_eq!(beside.status.code(), Some(i32::from(exit_code::IPC)), "{beside:?}");
    let said = String::from_utf8(beside.stderr).unwrap();
    assert!(said.contains("a daemon (\"roomcast-daemon\") runs in") && !said.contains("replayed in"), "{said}");
}

/// A running narrator resends its history to late listeners, including events of persons that were forgotten since then.
#[test]
fn a_recording_has_nothing_of_who_was_forgotten_before_it_began() {
    let (mut world, _, node, scores) = scoring("forgotten");
    let narration = node.publisher::<NarrationV1>().unwrap();
    let mut sequence = 0;
    let mut tell = |name: &str, text: &str| {
        sequence += 1;
        let message = NarrationV1::new(narration_kind::SENTENCE, text).unwrap();
        let source = sequence::source_of_name("test");
        let person_name = roomcast_ipc::text::encode("name", name).unwrap();
        narration.send(&NarrationV1 { source, epoch: 1, sequence, person_name, ..message }).unwrap();
        scores_with(&scores, text, |scores| includes(scores, "test", sequence))
    };
    // Packed bytes contain a short name by chance.
    tell("Bartholomew", "They open the fridge.");
    tell("Ada", "They sit on the sofa.");
    let forgotten = world.command(&["person", "forget", "bartholomew"]).output().unwrap();
    assert!(forgotten.status.success(), "{forgotten:?}");
    let file = world.directory.path().join("later.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    // The next event of a narrator resends its history to late listeners.
    tell("Ada", "They stand up.");
    let log = world.stop(recorder);
    let recording = roomcast_services::recording::read(&file).unwrap();
    let told = recording.messages.iter().filter_map(|(_, message)| match message {
        Recorded::Narration(narration) => Some(narration.text().to_owned()),
        _ => None,
    });
    assert_eq!(told.collect::<Vec<_>>(), ["They stand up."], "{log}");
    let whole = String::from_utf8_lossy(&std::fs::read(&file).unwrap()).to_lowercase();
    assert!(!whole.contains("bartholomew"));
    // Chunks are packed: the data behind the last scores has no text of his either.
    let explained = explain_recording(&file, &["--json"]).to_lowercase();
    assert!(explained.contains("they stand up.") && !explained.contains("bartholomew"), "{explained}");
}

/// A message of a ROS 2 recording: type, creation time, number, bytes.
type OfRos2 = (String, u64, u32, Vec<u8>);

/// The messages of a ROS 2 recording by topic.
fn of_ros2(bytes: &[u8]) -> BTreeMap<String, Vec<OfRos2>> {
    let mut topics = BTreeMap::<_, Vec<OfRos2>>::new();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!((schema.encoding.as_str(), message.channel.message_encoding.as_str()), ("ros2msg", "cdr"));
        assert!(message.channel.metadata["topic_type_hash"].starts_with("RIHS01_"));
        assert!(message.channel.metadata["offered_qos_profiles"].contains("reliability: 1"));
        let entry = (schema.name.clone(), message.publish_time, message.sequence, message.data.to_vec());
        topics.entry(message.channel.topic.clone()).or_default().push(entry);
    }
    topics
}

/// Two recorders run together. The ROS 2 recording must equal the conversion of the other one.
#[test]
fn a_recording_for_ros_2_says_what_was_narrated_scored_decided_and_reported() {
    use roomcast_ros2::content::{of_person, of_rooms};
    use roomcast_ros2::types::{Classification, Header, MarkerArray, Text, decode};
    use roomcast_ros2::words;

    let (mut world, daemon, node, _scores) = scoring("record-ros2");
    let path = |name: &str| world.directory.path().join(name).to_str().unwrap().to_owned();
    let (own, theirs) = (path("own.mcap"), path("theirs.mcap"));
    let recorders = [world.start(&["record", &own]), world.start(&["record", "--profile", "ros2", &theirs])];
    recorders_listen(&node, 2);
    let planner = world.start(&["planner", "--know", "0", "--room-time", "0.2"]);
    let lines = [
        r#"{"person": "Ada", "text": "They walk to the kitchen."}"#,
        r#"{"person": "Ada", "text": "[Grab] <mug> (1)"}"#,
        "Ada opens the fridge.",
    ];
    let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
    assert_eq!(world.narrate("camera", &lines).0, 0);
    let reported = world.command(&["report", "started", "--room", "kitchen", "--note", "all well"]).output().unwrap();
    assert!(reported.status.success(), "{reported:?}");
    // The senders stop first, so that both recordings end alike.
    for process in [planner, daemon].into_iter().chain(recorders) {
        world.stop(process);
    }

    let bytes = std::fs::read(&theirs).unwrap();
    let profile = mcap::read::LinearReader::new(&bytes).unwrap().find_map(|record| match record.unwrap() {
        mcap::records::Record::Header(header) => Some(header.profile),
        _ => None,
    });
    assert_eq!(profile.as_deref(), Some("ros2"));
    let topics = of_ros2(&bytes);
    let kinds: Vec<_> = topics.iter().map(|(topic, messages)| (topic.as_str(), messages[0].0.as_str())).collect();
    let (text, rooms) = ("std_msgs/msg/String", "vision_msgs/msg/Classification");
    assert_eq!(
        kinds,
        [
            ("/roomcast/decision", text),
            ("/roomcast/markers", "visualization_msgs/msg/MarkerArray"),
            ("/roomcast/narration", text),
            ("/roomcast/person/ada", rooms),
            ("/roomcast/person/ada/in_600s", rooms),
            ("/roomcast/person/ada/in_60s", rooms),
            ("/roomcast/report", text),
            ("/roomcast/rooms", rooms),
            ("/roomcast/rooms/in_600s", rooms),
            ("/roomcast/rooms/in_60s", rooms),
        ]
    );
    let texts = |topic: &str| -> Vec<String> {
        topics[topic].iter().map(|(_, _, _, bytes)| decode::<Text>(bytes).unwrap().data).collect()
    };
    let narrated = ["Ada: They walk to the kitchen.", "Ada: They grab the mug.", "Ada opens the fridge."];
    assert_eq!(texts("/roomcast/narration"), narrated);
    assert_eq!(texts("/roomcast/report"), ["robot has begun to work in kitchen: all well"]);

    let own = roomcast_services::recording::read(Path::new(&own)).unwrap();
    let decided = own.messages.iter().filter_map(|(_, message)| match message {
        Recorded::Decision(decision) => Some(words::decision(decision, "robot").data),
        _ => None,
    });
    let decided: Vec<_> = decided.collect();
    assert_eq!(texts("/roomcast/decision"), decided);
    assert!(decided[0].starts_with("robot goes to ") && decided[0].contains(": "), "{decided:?}");
    let classified = |topic: &str| -> Vec<(u32, u64, Classification)> {
        let messages = topics[topic].iter();
        messages
            .map(|(_, made, number, bytes)| {
                let told: Classification = decode(bytes).unwrap();
                assert_eq!(told.header, Header::of_unix_ns(*made, "map"));
                (*number, *made, told)
            })
            .collect()
    };
    let clocks_ns = own.messages.iter().find_map(|(_, message)| match message {
        Recorded::RoomScores(scores) => Some(scores.computed_unix_ns - scores.computed_ns),
        _ => None,
    });
    let clocks_ns = clocks_ns.unwrap();
    // Each recorder drops repeated forecasts by its own clock, and may miss some on a busy machine. Shared ones are equal. A heartbeat repeats a
    // number 250 ms later.
    for (end, ahead_s) in [("", 0.0), ("/in_60s", 60.0), ("/in_600s", 600.0)] {
        let (mut expected_rooms, mut expected_ada) = (Vec::new(), Vec::new());
        for (_, message) in &own.messages {
            match message {
                Recorded::Forecast(forecast) => {
                    let rooms = of_rooms(forecast, ahead_s, Header::default());
                    expected_rooms.push((forecast.sequence as u32, forecast.computed_ns, rooms.results));
                }
                Recorded::PersonForecasts(message) => {
                    let ada = message.persons().iter().map(|ada| of_person(message, ada, ahead_s, Header::default()));
                    let stamp = (message.sequence as u32, message.computed_ns);
                    expected_ada.extend(ada.map(|ada| (stamp.0, stamp.1, ada.results)));
                }
                _ => {}
            }
        }
        for (topic, expected) in [("rooms", expected_rooms), ("person/ada", expected_ada)] {
            let told = classified(&format!("/roomcast/{topic}{end}"));
            let pairs = told.iter().flat_map(|told| expected.iter().map(move |own| (told, own)));
            let is_one = |told: &(u32, u64, _), own: &(u32, u64, _)| {
                told.0 == own.0 && told.1.abs_diff(own.1 + clocks_ns) < 100_000_000
            };
            let both: Vec<_> = pairs.filter(|(told, own)| is_one(told, own)).collect();
            both.iter().for_each(|(told, own)| assert_eq!(told.2.results, own.2, "{topic}{end}"));
            assert!(both.iter().any(|(told, _)| told.0 > 1), "{topic}{end}: nothing after the narration: {told:?}");
        }
    }
    let rooms = classified("/roomcast/rooms");
    for (_, made, _, bytes) in &topics["/roomcast/markers"] {
        let drawn: MarkerArray = decode(bytes).unwrap();
        let (.., of) = rooms.iter().rfind(|(.., rooms)| rooms.header == Header::of_unix_ns(*made, "map")).unwrap();
        let names = drawn.markers.iter().filter(|marker| !marker.text.is_empty());
        assert_eq!(names.count(), of.results.len());
    }

    for arguments in [&["replay", &theirs][..], &["explain", "--recording", &theirs]] {
        let output = roomcast(arguments).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "{said}");
        assert!(
            said.contains("has the profile \"ros2\", and only those of the profile \"roomcast\" are read"),
            "{said}"
        );
    }
}

/// One person is only present, one leaves, and one window ends after an hour of silence.
#[test]
fn a_recorded_household_is_explained_by_name() {
    let (mut world, _, node, _scores) = scoring("record-home");
    let long_ago = roomcast_ipc::clock::unix_ns() as f64 / 1e9 - 7_200.0;
    let early = format!(
        r#"{{"person": "ada", "text": "They lie on the bed.", "observed_unix_s": {long_ago}}}
{{"person": "ben", "presence": "present"}}
{{"person": "cleo", "text": "They wash the dishes."}}
"#
    );
    assert_eq!(world.narrate("early", &early).0, 0);
    let renamed = world.command(&["person", "rename", "cleo", "Cleopatra"]).output().unwrap();
    assert!(renamed.status.success(), "{renamed:?}");
    let file = world.directory.path().join("home.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    let lines = [
        r#"{"person": "ada", "text": "They open the fridge."}"#,
        r#"{"person": "cleo", "text": "They dry the dishes."}"#,
        r#"{"person": "Dora", "text": "They sit on the sofa."}"#,
        "Dora leaves the house.",
    ];
    for (number, line) in lines.iter().enumerate() {
        assert_eq!(world.narrate(&format!("camera-{number}"), &format!("{line}\n")).0, 0);
    }
    world.stop(recorder);
    let explain = |more: &[&str]| explain_recording(&file, more);
    let recording = roomcast_services::recording::read(&file).unwrap();
    let last = last_scores(&recording);
    for sequence in last.sequence - 3..=last.sequence {
        let explained: serde_json::Value =
            serde_json::from_str(&explain(&["--sequence", &sequence.to_string(), "--json"])).unwrap();
        let scores = recording.messages.iter().find_map(|(_, message)| match message {
            Recorded::RoomScores(scores) if scores.sequence == sequence => Some(scores),
            _ => None,
        });
        for (id, probability) in probabilities(scores.unwrap()) {
            let partitions = explained["partitions"].as_array().unwrap();
            let partition = partitions.iter().find(|partition| partition["id"] == id.as_str()).unwrap();
            assert!((partition["probability"].as_f64().unwrap() - probability).abs() < 1e-9, "{sequence}: {id}");
        }
    }
    let text = explain(&[]);
    assert!(text.contains("Cleopatra") && !text.contains("They lie on the bed."), "{text}");
    assert!(explain(&["--person", "cleopatra"]).contains("They dry the dishes."));
}

fn explain_recording(file: &Path, more: &[&str]) -> String {
    let output = roomcast(&["explain", "--recording", file.to_str().unwrap()]).args(more).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}
