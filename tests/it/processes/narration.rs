use std::path::Path;
use std::time::Duration;

use roomcast_core::narration::{Observation, Sentence};
use roomcast_ipc::raw::{ALL_PERSONS, NarrationV1, PersonForecastsV1, RoomScoresV1, narration_kind, score_flags};
use roomcast_ipc::{question, sequence};
use roomcast_services::daemon::Journal;
use rustix::process::Signal;

use super::{World, eventually, exit_code, includes, scores_with, scoring};

#[test]
fn narration_that_a_daemon_did_not_confirm_reaches_the_next_one() {
    let mut world = World::new("unconfirmed");
    let file = world.directory.path().join("lines.txt");
    std::fs::write(&file, "They walk to the kitchen.\nThey grab the mug.\n").unwrap();
    let narrator =
        world.start(&["narrate", file.to_str().unwrap(), "--name", "early", "--pace", "0", "--linger", "100"]);
    let node = world.domain.open("test").unwrap();
    let heard = node.subscriber::<NarrationV1>().unwrap();
    eventually("the narrator speaks", || heard.receive().unwrap());
    world.start_daemon();
    let (status, log) = world.wait(narrator);
    assert!(status.success(), "{log}");
    assert_eq!(world.status(&node).accepted, 2);
}

#[test]
fn a_narrator_faster_than_the_scorer_loses_nothing() {
    let mut world = World::new("fast");
    world.start_daemon();
    let lines: String = (0..600).map(|number| format!("They do thing {number}.\n")).collect();
    let (code, outcome) = world.narrate("fast", &lines);
    assert_eq!((code, outcome), (0, serde_json::json!({"sent": 600, "confirmed": 600, "dropped": 0, "refused": 0})));
    let node = world.domain.open("test").unwrap();
    let status = world.status(&node);
    assert_eq!((status.accepted, status.missed, status.duplicates), (600, 0, 0));
    assert!(status.steps < 600 && status.merged > 0, "steps were merged: {} of {}", status.merged, status.steps);
    world.assert_alive();
}

#[test]
fn a_hostile_narrator_is_counted_and_the_daemon_goes_on() {
    let (mut world, _, node, scores) = scoring("hostile");
    let narration = node.publisher::<NarrationV1>().unwrap();
    let good = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
    let source = sequence::source_of_name("test");
    let good = NarrationV1 { source, epoch: 1, sequence: 1, ..good };
    let action = NarrationV1::new(narration_kind::ACTION, "[Fly] <moon> (1)").unwrap();
    let hostile = [
        NarrationV1 { text: [0xff; 1024], text_bytes: 1024, ..good },
        NarrationV1 { text_bytes: u32::MAX, ..good },
        NarrationV1 { text: [0x1b; 1024], text_bytes: 1024, ..good },
        NarrationV1 { kind: 77, ..good },
        NarrationV1 { source: 0, ..good },
        NarrationV1 { source, epoch: 1, sequence: 1, ..action },
    ];
    for message in &hostile {
        narration.send_unchecked(message).unwrap();
    }
    narration.send(&good).unwrap();
    scores_with(&scores, "the good one", |scores| includes(scores, "test", 1));
    let status = world.status(&node);
    assert_eq!((status.malformed, status.accepted), (hostile.len() as u64, 1));
    // Text in the form of a model's control token stays text.
    let token = NarrationV1::new(narration_kind::SENTENCE, "<s></s><|endoftext|> They stand up.").unwrap();
    narration.send(&NarrationV1 { source, epoch: 1, sequence: 2, ..token }).unwrap();
    scores_with(&scores, "control tokens as text", |scores| includes(scores, "test", 2));
    world.assert_alive();
}

#[test]
fn persons_are_named_and_forgotten_over_a_kill() {
    let mut world = World::new("persons");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let forecasts = node.subscriber::<PersonForecastsV1>().unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let mut sequence = 0;
    let mut tell = |person: u32, name: &str, kind: u32, text: &str| {
        sequence += 1;
        let message = NarrationV1::new(kind, text).unwrap();
        let source = sequence::source_of_name("test");
        let person_name = roomcast_ipc::text::encode("name", name).unwrap();
        narration.send(&NarrationV1 { source, epoch: 1, sequence, person, person_name, ..message }).unwrap();
        scores_with(&scores, text, |scores| includes(scores, "test", sequence))
    };
    tell(0, "Ada", narration_kind::SENTENCE, "They open the fridge.");
    tell(7, "", narration_kind::SENTENCE, "They lie on the bed.");
    tell(ALL_PERSONS, "", narration_kind::SENTENCE, "They close the fridge.");
    let told = tell(7, "", narration_kind::PRESENCE, "away");
    assert!(told.persons == 2 && !told.has(score_flags::NOBODY_HOME));
    assert!(tell(0, "ada", narration_kind::SENTENCE, "Ada leaves the house.").has(score_flags::NOBODY_HOME));
    let forecast = eventually("the persons' forecasts", || {
        forecasts.newest().unwrap().filter(|told| told.persons().iter().all(|person| person.elsewhere[0] > 0.99))
    });
    assert_eq!(forecast.persons().len(), 2);

    let ask = |world: &World, arguments: &[&str]| {
        let output = world.command(&[&["person"], arguments, &["--json"]].concat()).output().unwrap();
        let answer: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        (output.status.code().unwrap(), answer, String::from_utf8(output.stderr).unwrap())
    };
    let persons = |answer: &serde_json::Value| -> Vec<(String, String, String)> {
        let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
        let line =
            |line: &serde_json::Value| (line["person"].to_string(), text(&line["name"]), text(&line["presence"]));
        answer["persons"].as_array().unwrap().iter().map(line).collect()
    };
    let ada = roomcast_core::narration::person_number("ada").to_string();
    let row = |number: &str, name: &str, presence: &str| (number.to_owned(), name.to_owned(), presence.to_owned());
    let (code, answer, _) = ask(&world, &["list"]);
    assert_eq!((code, persons(&answer)), (0, vec![row("7", "", "away"), row(&ada, "Ada", "away")]));
    let (code, answer, errors) = ask(&world, &["rename", "7", "Ben"]);
    assert_eq!((code, &answer["kept"]), (0, &serde_json::json!(true)), "{errors}");
    let (code, _, errors) = ask(&world, &["rename", "7", "ADA"]);
    assert!(code == 3 && errors.contains(&format!("ADA is person {ada} already")), "{errors}");
    assert_eq!(ask(&world, &["forget", "eve"]).0, 3);

    world.end(daemon, Signal::KILL);
    let daemon = world.start_daemon();
    let (_, answer, _) = ask(&world, &["list"]);
    assert_eq!(persons(&answer), [row("7", "Ben", "away"), row(&ada, "Ada", "away")]);
    let (code, answer, errors) = ask(&world, &["forget", "ada"]);
    assert_eq!((code, persons(&answer)), (0, vec![row("7", "Ben", "away")]), "{errors}");
    let files = ["roomcast.db", "roomcast.db-wal"].map(|name| std::fs::read(world.state().join(name)).unwrap());
    let journal = String::from_utf8_lossy(&files.concat()).into_owned();
    // Also an event without a name that the daemon attributed to her.
    assert!(!journal.to_lowercase().contains("ada") && !journal.contains("the fridge"), "{journal}");
    assert!(journal.contains("They lie on the bed."));
    world.end(daemon, Signal::KILL);
    let daemon = world.start_daemon();
    let (_, answer, _) = ask(&world, &["list"]);
    assert_eq!(persons(&answer), [row("7", "Ben", "away")]);
    world.end(daemon, Signal::KILL);
}

fn small_window(world: &World) -> String {
    let path = world.directory.path().join("small.toml");
    std::fs::write(&path, "[history]\ntokens = 256\n").unwrap();
    path.to_str().unwrap().to_owned()
}

/// The attack: a sentence of one kilobyte makes about 1 000 tokens. The daemon refuses it before the journal, logs it once and counts it. A state
/// database of an older version may contain one; it blocks no later event.
#[test]
fn a_sentence_that_costs_more_than_the_window_harms_nobody() {
    let mut world = World::new("costly");
    let (config, state) = (small_window(&world), world.state());
    std::fs::create_dir(&state).unwrap();
    let costly = format!("They say {}.", "x9 ".repeat(330));
    let sentence = Sentence::new(&costly).unwrap();
    let observed = Observation { source: 5, epoch: 5, sequence: 5, ..Observation::of(5, sentence) };
    Journal::open(&state, 1 << 20, Duration::from_secs(1)).unwrap().0.handle.append(&observed);
    let arguments = ["daemon", "--state", state.to_str().unwrap(), "--config", &config];
    let daemon = world.start(&arguments);
    let lines = format!("They walk to the kitchen.\n{costly}\n{costly}\nThey grab the mug.\n{costly}\n");
    let (code, outcome) = world.narrate("camera", &lines);
    let expected = serde_json::json!({"sent": 5, "confirmed": 2, "dropped": 3, "refused": 0});
    assert_eq!((code, outcome), (i32::from(exit_code::IPC), expected));
    let node = world.domain.open("test").unwrap();
    let status = world.status(&node);
    assert_eq!((status.costly, status.accepted, status.failed_steps, status.missed), (3, 2, 0, 0));
    world.signal(daemon, Signal::TERM);
    let (_, log) = world.wait(daemon);
    assert_eq!(log.matches("costs more tokens than a window holds").count(), 1, "{log}");
    assert!(log.contains("the state database has sentences of more than the 256 tokens"), "{log}");

    world.start(&arguments);
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let after = scores_with(&scores, "scores after the restart", |scores| includes(scores, "camera", 4));
    assert_eq!((after.window, after.has(score_flags::SCORER_FAILED)), (2, false));
}

/// The attack: another process sends an honest narrator's source and epoch with sequence 2^64 - 1.
#[test]
fn events_in_the_name_of_another_narrator_are_dropped_and_counted() {
    let mut world = World::new("forged");
    world.start_daemon();
    let (node, stranger) = (world.domain.open("honest").unwrap(), world.domain.open("stranger").unwrap());
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let (honest, forging) = (node.publisher::<NarrationV1>().unwrap(), stranger.publisher::<NarrationV1>().unwrap());
    let said = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
    let said = NarrationV1 { source: sequence::source_of_name("honest"), epoch: 9, sequence: 1, ..said };
    honest.send(&said).unwrap();
    scores_with(&scores, "the first sentence", |scores| includes(scores, "honest", 1));
    for sequence in [2, u64::MAX] {
        forging.send(&NarrationV1 { sequence, ..said }).unwrap();
    }
    eventually("the forged ones are counted", || (world.status(&node).forged == 2).then_some(()));
    honest.send(&NarrationV1 { sequence: 2, ..said }).unwrap();
    let named = scores_with(&scores, "the next sentence", |scores| includes(scores, "honest", 2));
    assert_eq!((named.included()[0].sequence, named.included()[0].accepted, named.window), (2, 2, 2));
    assert_eq!(world.status(&node).missed, 0);
}

/// The attack: two narrators use one name, as with the default name.
#[test]
fn two_narrators_of_one_name_are_both_heard() {
    let mut world = World::new("namesakes");
    world.start_daemon();
    let file = world.directory.path().join("lines.txt");
    std::fs::write(&file, "They sit.\nThey stand up.\nThey sit.\nThey stand up.\nThey sit.\nThey sleep.\n").unwrap();
    let arguments = ["narrate", file.to_str().unwrap(), "--pace", "0.2", "--linger", "100"];
    let both = [world.start(&arguments), world.start(&arguments)];
    for narrator in both {
        let (status, log) = world.wait(narrator);
        assert!(status.success(), "{log}");
    }
    let status = world.status(&world.domain.open("test").unwrap());
    assert_eq!((status.accepted, status.missed, status.forged, status.duplicates), (12, 0, 0, 0));
}

#[test]
fn lines_that_are_no_narration_are_named_and_the_others_go_through() {
    let mut world = World::new("lines");
    world.start_daemon();
    let (code, outcome) = world.narrate("lines", "They sit.\n[Fly] <moon> (1)\n{\"txt\": 1}\nThey stand up.\n");
    assert_eq!(code, i32::from(exit_code::INPUT));
    assert_eq!(outcome, serde_json::json!({"sent": 2, "confirmed": 2, "dropped": 0, "refused": 2}));
}

#[test]
fn a_sensor_log_is_narrated() {
    let mut world = World::new("sensors");
    world.start_daemon();
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    let log = world.directory.path().join("log.tsv");
    let good = std::fs::read_to_string(data.join("sensors.tsv")).unwrap();
    std::fs::write(&log, format!("{good}at noon\tlater\tdoor\tMagnetic\tHall\n")).unwrap();
    let mut command = world.command(&["narrate", "--pace", "0", "--json", "--linger", "100", "--name", "home"]);
    let output =
        command.arg("--sensors").arg(&log).arg("--rules").arg(data.join("sensor-rules.toml")).output().unwrap();
    let mut outcome: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let understood = outcome.as_object_mut().unwrap().remove("understood").unwrap();
    let sequences: Vec<_> = understood.as_array().unwrap().iter().map(|line| line["sequence"].as_u64()).collect();
    assert_eq!(sequences, (1..=7).map(Some).collect::<Vec<_>>());
    assert_eq!(outcome, serde_json::json!({"sent": 7, "confirmed": 7, "dropped": 0, "refused": 1}));
    assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("line 12") && said.contains("at noon"), "{said}");
    let node = world.domain.open("test").unwrap();
    assert_eq!(world.status(&node).accepted, 7);
}

#[test]
fn the_examples_of_json_lines_are_narrated() {
    let manual = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/json-lines.md")).unwrap();
    let blocks = manual.split("```json narration\n").skip(1);
    let lines: String = blocks.map(|block| block.split("```").next().unwrap()).collect();
    let mut world = World::new("json-lines");
    world.start_daemon();
    let (code, outcome) = world.narrate("manual", &lines);
    let count = lines.lines().count();
    assert_eq!((code, &outcome["sent"], &outcome["refused"]), (0, &count.into(), &0.into()), "{outcome}");
    assert!(count >= 8);
}

/// A repeated question gets its earlier answer again, without the persons that were forgotten since then.
#[test]
fn who_is_forgotten_is_in_no_answer_that_is_given_again() {
    let mut world = World::new("answered");
    world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let port = node.question_port(question::HABITS).unwrap();
    let ask = |question: &str| port.ask(question, Duration::from_secs(20)).unwrap();
    let lines = "{\"person\": \"ada\", \"text\": \"They open the fridge.\"}\n".repeat(3);
    assert_eq!(world.narrate("camera", &lines).0, 0);
    eventually("something is learned of her", || ask(r#"{"ask": "show"}"#).contains("ada").then_some(()));
    let question = r#"{"ask": "forget", "id": "7", "who": "nobody"}"#;
    let first = ask(question);
    assert!(first.contains("ada") && first == ask(question), "{first}");
    let forgotten = world.command(&["person", "forget", "ada"]).output().unwrap();
    assert!(forgotten.status.success(), "{forgotten:?}");
    let again = ask(question);
    assert!(!again.contains("ada") && again.contains("nothing was learned of"), "{again}");
}
