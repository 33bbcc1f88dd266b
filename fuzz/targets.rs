//! Fuzz targets. Each target takes any bytes, may refuse them, and panics if an invariant is broken. libFuzzer runs them (`fuzz_targets/`), and so
//! does `tests/it/fuzzed.rs`, over the corpus and seeded mutations of it.

#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::allow_attributes,
    reason = "each driver uses its own; a panic is the report"
)]

use roomcast_core::ids::{BootNs, UnixNs};
use std::cell::RefCell;
use std::io::{Read, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::label_trie::{LabelTrie, PROMPT, TokenTree};
use roomcast_core::narration::Program;
use roomcast_core::scorer::Token;
use roomcast_core::semantic_map::{SemanticMap, import};
use roomcast_ipc::raw::{
    ByteImage, DecisionV1, ForecastV1, Layout, Message, NarrationV1, PersonForecastsV1, PersonScoresV1, RobotReportV1,
    RoomScoresV1,
};
use roomcast_ipc::{Sender, sequence};
use roomcast_llama::gguf::Header;
use roomcast_services::config::{Config, IntakeLimits, PersonsConfig, PlannerConfig};
use roomcast_services::daemon::{Intake, Taken, journal};
use roomcast_services::dry_run::DryRun;
use roomcast_services::mqtt::{Listener, Rules};
use roomcast_services::narrator::{Who, line_item};
use roomcast_services::planner::Planner;
use roomcast_services::recording;
use roomcast_services::sensor_log::{Said, SensorRules};

/// The server of metrics and page is part of the program and not of a library.
#[path = "../src/http.rs"]
mod http;

/// A target has no visible effect unless it panics.
pub type Target = fn(&[u8]);

/// Every target by name.
pub const ALL: &[(&str, Target)] = &[
    ("configuration", configuration),
    ("gguf", gguf),
    ("home", home),
    ("http", requests),
    ("journal", journal),
    ("line", line),
    ("message", message),
    ("mqtt", mqtt),
    ("presence", presence),
    ("program", program),
    ("recording", recording),
    ("scene", scene),
    ("sensors", sensors),
    ("trie", trie),
    ("valetudo", valetudo),
];

/// An accepted scene stays equal when written and read again, and can be grounded.
pub fn scene(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(map) = SemanticMap::from_json(text) else { return };
    let again = SemanticMap::from_json(&map.to_json()).expect("a scene that was read can be written and read");
    assert_eq!((map.items(), map.labels()), (again.items(), again.labels()));
    if let Ok(grounding) = Grounding::new(&map, &GroundingOptions::default()) {
        assert_eq!(grounding.item_partition().len(), map.items().len());
    }
}

/// A robot's map that is accepted becomes a scene that can be written, read and furnished.
pub fn valetudo(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(imported) = import::valetudo(text, "fuzzed", &std::collections::HashMap::new()) else { return };
    let again =
        SemanticMap::from_json(&imported.map.to_json()).expect("a map that was imported can be written and read");
    assert_eq!(imported.map.fingerprint(), again.fingerprint());
    assert!(imported.furnish(import::Furnish::Typical).is_ok());
}

/// Registries of a home, separated by zeros: if accepted, they become a scene that can be furnished, and valid rules.
pub fn home(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let mut texts = text.split('\0');
    let Some(areas) = texts.next() else { return };
    let [floors, devices, entities, persons] = std::array::from_fn(|_| texts.next());
    let registries =
        import::Registries { areas, floors, devices, entities, persons, furnished: true, ..Default::default() };
    let Ok(home) = import::home_assistant(&registries, "fuzzed") else { return };
    if let Some(rules) = home.rules {
        Rules::parse(&rules).expect("rules that were written can be read");
    }
    assert!(home.imported.furnish(import::Furnish::Typical).is_ok());
}

/// Any bytes on a connection to the HTTP server get at most one answer, with the length in its header; nothing larger than the limit is passed on.
pub fn requests(bytes: &[u8]) {
    use std::cell::{Cell, RefCell};
    use std::rc::Rc;

    thread_local! {
        static RUNTIME: tokio::runtime::Runtime =
            tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().unwrap();
    }
    let (mut ours, theirs) = std::os::unix::net::UnixStream::pair().unwrap();
    // A pair of sockets holds at least this much.
    ours.write_all(&bytes[..bytes.len().min(64 << 10)]).unwrap();
    ours.shutdown(std::net::Shutdown::Write).unwrap();
    theirs.set_nonblocking(true).unwrap();
    let asked = Rc::new(Cell::new(0));
    let counted = Rc::clone(&asked);
    let answer = move |request: http::Request<'_>| {
        counted.set(counted.get() + 1);
        let lines = request.headers.iter().map(|(name, value)| name.as_str().len() + value.len());
        assert!(lines.sum::<usize>() + request.uri.to_string().len() <= http::HEADER_BYTES_MAX);
        hyper::Response::new("answered".to_owned())
    };
    RUNTIME.with(|runtime| {
        runtime.block_on(async {
            let theirs = tokio::net::UnixStream::from_std(theirs).unwrap();
            http::converse(theirs, Rc::new(RefCell::new(answer))).await;
        });
    });
    let mut said = Vec::new();
    // A server that leaves bytes unread resets the connection after its answer.
    let _reset = ours.read_to_end(&mut said);
    assert!(asked.get() <= 1, "{} requests of one connection were answered", asked.get());
    let Some(end) = said.windows(4).position(|end| end == b"\r\n\r\n") else {
        let (said, asked) = (String::from_utf8_lossy(&said), asked.get());
        assert!(said.is_empty() && asked == 0, "{asked} requests have half an answer: {said:?}");
        return;
    };
    let (head, body) = (String::from_utf8_lossy(&said[..end]).to_lowercase(), &said[end + 4..]);
    assert!(head.starts_with("http/1."), "{head}");
    assert_eq!(asked.get() == 1, body == b"answered");
    let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")?.parse().ok());
    // The answer to HEAD has the length that GET would have.
    assert!(body.is_empty() || length == Some(body.len()), "{head}");
}

/// Every step of an accepted program has a sentence.
pub fn program(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(program) = Program::parse(text) else { return };
    for step in &program.steps {
        assert!(step.sentence().ends_with('.'));
        assert!(step.entry().duration_s >= 0.0);
    }
}

/// An accepted line becomes a message that the daemon accepts.
pub fn line(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(item) = line_item(text, &Who::Somebody) else { return };
    let message = NarrationV1::new(item.kind, &item.text).expect("what the narrator accepts is a message");
    let message = NarrationV1 { source: 1, epoch: 1, sequence: 1, ..message };
    message.check().expect("what the narrator sends passes the daemon's check");
    let taken = Intake::new(IntakeLimits::default()).take(&message, Sender::simulated(1), BootNs(1));
    assert!(matches!(taken, Taken::Accepted { .. }), "{taken:?}");
}

thread_local! {
    static HOME: RefCell<DryRun> = RefCell::new(home_of_two());
}

fn home_of_two() -> DryRun {
    let residents = ["Ada", "Ben"].map(str::to_owned).to_vec();
    let persons = PersonsConfig { residents, ..PersonsConfig::default() };
    DryRun::new(&Config { persons, ..Config::default() }, UnixNs(1_000_000_000_000_000_000))
        .expect("the shipped scene is a home")
}

/// A text that a camera reads from a poster or a screen sets no presence.
pub fn presence(bytes: &[u8]) {
    let Ok(poster) = std::str::from_utf8(bytes) else { return };
    for text in [format!("A poster reads: {poster}"), format!("On TV, {poster} Bye"), format!("Ada says {poster}")] {
        let Ok(item) = line_item(&text, &Who::Somebody) else { continue };
        let line = HOME.with_borrow_mut(|home| home.take(&item)).expect("the table model never fails");
        assert!(line.is_none_or(|line| line.understood.event == "did"), "{text}");
    }
}

/// An accepted configuration stays equal when written and read again.
pub fn configuration(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let Ok(config) = toml::from_str::<Config>(text) else { return };
    if config.check().is_ok() {
        let again = toml::to_string(&config).expect("a configuration can be written");
        assert_eq!(toml::from_str::<Config>(&again).as_ref(), Ok(&config));
    }
}

/// Any bytes can be read as a journal of earlier versions.
pub fn journal(bytes: &[u8]) {
    let _records = journal::old_records(&[bytes.to_vec(), Vec::new()], &[7; 16]);
}

/// The bytes as the image of a message, padded with zeros.
fn image<M: ByteImage + Layout>(bytes: &[u8]) -> M {
    let size = M::FIELDS.iter().map(|field| field.size).sum();
    let mut image = bytes.to_vec();
    image.resize(size, 0);
    M::from_bytes(&image).expect("an image of the right size is a message")
}

/// Any bytes in shared memory are safe to check; messages that pass the check are safe to use.
pub fn message(bytes: &[u8]) {
    let Some((kind, bytes)) = bytes.split_first() else { return };
    match kind % 7 {
        0 => {
            let message: NarrationV1 = image(bytes);
            let mut intake = Intake::new(IntakeLimits::default());
            let checked = message.check();
            let passed = checked.is_ok();
            match intake.receive(checked.map(|()| &message), Sender::simulated(1), BootNs(5)) {
                Taken::Accepted { observation, .. } => {
                    assert!(passed && observation.observed_ns <= BootNs(5));
                    assert!(!observation.event.to_string().contains(char::is_control));
                    assert_eq!(intake.take(&message, Sender::simulated(1), BootNs(6)), Taken::Duplicate);
                }
                Taken::Malformed(why) => assert!(!why.is_empty()),
                other => panic!("{other:?}"),
            }
        }
        1 => {
            let scores: RoomScoresV1 = image(bytes);
            // Unchecked messages are safe to read, too.
            assert!(scores.rooms().len() <= 64 && scores.included().len() <= 16);
            if scores.check().is_ok() {
                let config = PlannerConfig { room_time_s: 1.0, ..PlannerConfig::default() };
                let mut planner = Planner::new(&config, 1);
                planner.take(&scores, BootNs(scores.published_ns.max(scores.computed_ns))).expect("its own time");
                planner
                    .take_forecast(&ForecastV1 { epoch: scores.epoch, ..ForecastV1::default() }, BootNs(0))
                    .expect("long ago");
                for now_ns in [0, scores.published_ns, scores.published_ns.saturating_add(1 << 40)] {
                    if let Ok(Some(decision)) = planner.decide(BootNs(now_ns), UnixNs(0)) {
                        decision.check().expect("the planner's decisions pass the check");
                    }
                }
            }
        }
        5 => {
            let report: RobotReportV1 = image(bytes);
            if report.check().is_ok() {
                let config = PlannerConfig { robot: "robot".to_owned(), ..PlannerConfig::default() };
                let mut planner = Planner::new(&config, 1);
                planner.take(&RoomScoresV1 { room_count: 2, ..RoomScoresV1::default() }, BootNs(0)).expect("long ago");
                let own = RobotReportV1 { robot: sequence::source_of_name("robot"), ..report };
                // A room outside the map is a fault of the report only.
                let _placed = planner.take_report(&own, BootNs(5));
                for now_ns in [0, 5, 1 << 40] {
                    if let Ok(Some(decision)) = planner.decide(BootNs(now_ns), UnixNs(0)) {
                        decision.check().expect("the planner's decisions pass the check");
                    }
                }
            }
        }
        2 => {
            let decision: DecisionV1 = image(bytes);
            if decision.check().is_ok() {
                assert!(!decision.reason().contains(char::is_control));
            }
        }
        4 => {
            let scores: PersonScoresV1 = image(bytes);
            // Unchecked messages are safe to read, too.
            assert!(scores.rooms().len() <= 64 && scores.persons().len() <= 8);
            if scores.check().is_ok() {
                for person in scores.persons() {
                    assert!(scores.probabilities(person).all(|(room, p)| !room.is_empty() && (0.0..=1.0).contains(&p)));
                }
            }
        }
        6 => {
            let forecasts: PersonForecastsV1 = image(bytes);
            // Unchecked messages are safe to read, too.
            assert!(forecasts.persons().len() <= 8 && forecasts.horizons_s().len() <= 16);
            if forecasts.check().is_ok() {
                assert!(forecasts.rooms().len() <= 64 && forecasts.rooms().all(|room| !room.is_empty()));
            }
        }
        _ => {
            let forecast: ForecastV1 = image(bytes);
            if forecast.check().is_ok() {
                for room in 0..forecast.room_count as usize {
                    assert!(forecast.room(room).is_some());
                }
            }
            // Even without the check, a room beyond the count does not exist.
            assert!(forecast.room(usize::MAX).is_none());
        }
    }
}

/// Labels of any tokens: the path to each label's end spells the label, and the nodes are in preorder.
pub fn trie(bytes: &[u8]) {
    let labels: Vec<Vec<Token>> = bytes
        .split(|byte| *byte == 0)
        .filter(|label| !label.is_empty())
        .take(200)
        .map(|label| label.iter().take(64).map(|byte| Token(i32::from(byte % 16))).collect())
        .collect();
    if labels.is_empty() {
        return;
    }
    for trie in [LabelTrie::new(&labels), LabelTrie::chains(&labels)] {
        for (label, end) in labels.iter().zip(trie.label_end()) {
            let mut spelled = Vec::new();
            let mut node = *end;
            while node != PROMPT {
                let at = trie.nodes()[node as usize];
                assert!(at.parent == PROMPT || at.parent < node, "a parent stands before its children");
                spelled.push(at.token);
                node = at.parent;
            }
            spelled.reverse();
            assert_eq!(&spelled, label);
        }
        for (index, node) in trie.nodes().iter().enumerate() {
            assert!(node.subtree >= 1 && index + node.subtree as usize <= trie.nodes().len());
        }
        let tree = TokenTree::of_inner_nodes(&trie);
        assert_eq!(tree.len(), trie.inner().len());
        for index in 0..tree.len() {
            let (first, end) = tree.paths(index);
            assert!(first < end && end <= tree.path_count());
        }
    }
}

/// A model file is read or refused, and all parts that are read lie within the file.
pub fn gguf(bytes: &[u8]) {
    let mut file = tempfile::NamedTempFile::new_in(std::env::temp_dir()).expect("a file for the model");
    file.write_all(bytes).expect("the model is written");
    if let Ok(header) = Header::read_language_model(file.path()) {
        for tensor in &header.tensors {
            assert!(tensor.start + tensor.size_bytes <= bytes.len() as u64);
        }
    }
}

/// Messages with any topic and payload, separated by zeros: each output is a line of JSON that the narrator reads or refuses.
pub fn mqtt(bytes: &[u8]) {
    const RULES: &str = "[[rule]]\ntopic = \"home/+/state\"\nsay = \"They use the {1}: {value}.\"\n\
        [[rule]]\ntopic = \"json/#\"\nfield = \"/state\"\nsay = \"the lamp is {value}\"\nretained = true\n\
        [[rule]]\ntopic = \"motion/+\"\npresence = \"present\"\nroom = \"{1}\"\nperson = \"{value}\"\n\
        [[rule]]\ntopic = \"#\"\npresence = \"away\"\nperson = \"{value}\"\nquiet_s = 1.0";
    let mut listener = Listener::new(Rules::parse(RULES).unwrap());
    let mut parts = bytes.split(|byte| *byte == 0);
    while let (Some(topic), Some(payload)) = (parts.next(), parts.next()) {
        for retained in [false, true] {
            let now = Instant::now();
            let said = listener.hear(topic, payload, retained, now);
            for line in said.into_iter().chain(listener.due(now + Duration::from_secs(1))) {
                assert!(!line.contains('\n') && line.starts_with('{'));
                let _refused = line_item(&line, &Who::Somebody);
            }
        }
    }
}

/// Any bytes as a recording: read or refused, within the limits of memory. A moment that is found can be explained or not.
pub fn recording(bytes: &[u8]) {
    if let Ok(Some(found)) = recording::find(Path::new("fuzzed"), bytes, recording::Wanted::Last) {
        let _explained = found.moment.explain(3);
    }
}

/// Any bytes as a sensor log: each line is narrated, skipped or refused independently.
pub fn sensors(bytes: &[u8]) {
    const RULES: &str = "[[rule]]\nsay = \"They open the {sensor} for {seconds} seconds.\"\nshortest_s = 1.0\nagain_s = 2.0\n\
        [[rule]]\nat = \"end\"\nkind = \"door\"\nsay = \"They close the {sensor} in the {place}.\"\n\
        [[rule]]\npresence = \"away\"\nperson = \"{sensor}\"\nquiet_s = 3.0";
    let narrated = SensorRules::parse(RULES).unwrap().narrate(bytes, &Who::Somebody);
    let lines = bytes.split(|byte| *byte == b'\n').count();
    assert!(narrated.said.len() as u64 + narrated.faults.count() <= 3 * lines as u64, "a line for each rule at most");
    for Said { item, .. } in &narrated.said {
        assert!(item.duration_s >= 0.0, "time does not go back");
        NarrationV1::new(item.kind, &item.text).expect("what is narrated is a message");
    }
}
