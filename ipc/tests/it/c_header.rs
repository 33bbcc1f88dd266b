//! `clients/c/roomcast.h` is cbindgen's output for the messages' sources, and a C compiler agrees with Rust on every size and offset.
//! `ROOMCAST_WRITE_HEADER=1` (`make c-header`) writes the header.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use roomcast_ipc::raw::{
    ByteImage, DecisionV1, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1, Layout, Message, NarrationV1,
    PersonForecastV1, PersonForecastsV1, PersonScoresV1, PersonV1, RobotReportV1, RoomScoresV1, RoomV1,
    StatusRequestV1, StatusResponseV1, action, report_kind,
};
use roomcast_ipc::{clock, sequence, text};

use crate::skipped::skipped;

const SOURCES: [&str; 10] = [
    "mod",
    "narration",
    "room_scores",
    "person_scores",
    "item_scores",
    "forecast",
    "person_forecasts",
    "decision",
    "robot_report",
    "status",
];

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// `RoomScoresV1` becomes `RoomcastRoomScoresV1`: C has no name spaces.
fn c_type(name: &str) -> String {
    format!("Roomcast{name}")
}

/// The messages' sources as plain Rust for cbindgen: without the macro, and with C names.
fn plain_rust() -> String {
    let mut plain = String::new();
    let mut module = None::<String>;
    let mut in_layout = false;
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/message");
    for source in SOURCES {
        let source = std::fs::read_to_string(folder.join(format!("{source}.rs"))).unwrap();
        let mut docs = String::new();
        for line in source.lines() {
            let line = line.trim();
            if line.starts_with("///") {
                let _ = writeln!(
                    docs,
                    "{}",
                    line.replace("[`", "")
                        .replace("`]", "")
                        .replace("crate::raw::", "")
                        .replace("crate::", "")
                        .replace('`', "")
                );
                continue;
            }
            if let Some(name) = line.strip_prefix("pub mod ").and_then(|rest| rest.strip_suffix(" {")) {
                module = Some(name.to_uppercase());
            } else if let Some(constant) = line.strip_prefix("pub const ") {
                let own = module.as_ref().map_or_else(String::new, |module| format!("{module}_"));
                let _ = writeln!(plain, "{docs}pub const ROOMCAST_{own}{constant}");
            } else if line == "layout! {" {
                in_layout = true;
            } else if in_layout && let Some(rest) = line.strip_prefix("pub struct ") {
                let name = rest.split(' ').next().unwrap();
                let _ = writeln!(plain, "{docs}#[repr(C)]\npub struct {} {{", c_type(name));
            } else if in_layout && let Some((offset, field)) = line.split_once(" => ") {
                let (name, kind) = field.trim_end_matches(',').split_once(": ").unwrap();
                let _ = writeln!(plain, "{docs}/// (Offset {offset}.)\npub {name}: {},", c_kind(kind));
            } else if line == "}" {
                if in_layout {
                    plain.push_str("}\n");
                    // The layout's own brace follows.
                    in_layout = false;
                }
                module = None;
            } else if line.starts_with("#[type_name") {
                continue;
            }
            if !line.starts_with("layout!") {
                docs.clear();
            }
        }
    }
    plain
}

/// A field's type with C's names for constants and structures.
fn c_kind(kind: &str) -> String {
    let mut kind = kind.to_owned();
    for name in ["IncludedV1", "RoomV1", "PersonV1", "PersonForecastV1"] {
        kind = kind.replace(name, &c_type(name));
    }
    for name in [
        "NAME_BYTES",
        "NARRATION_TEXT_BYTES",
        "REASON_TEXT_BYTES",
        "NOTE_TEXT_BYTES",
        "MAX_ROOMS",
        "MAX_PERSONS",
        "MAX_SOURCES",
        "MAX_HORIZONS",
    ] {
        kind = kind.replace(&format!("; {name}]"), &format!("; ROOMCAST_{name}]"));
    }
    kind
}

fn assertions<T: Layout>(out: &mut String) {
    let name = c_type(T::TYPE_NAME.strip_prefix("roomcast.").unwrap());
    let _ = writeln!(out, "_Static_assert(sizeof({name}) == {}, \"{name}\");", size_of::<T>());
    for field in T::FIELDS {
        let _ =
            writeln!(out, "_Static_assert(offsetof({name}, {0}) == {1}, \"{name}.{0}\");", field.name, field.offset);
    }
}

/// The names by which iceoryx2 compares types, and the services with their quality.
fn names() -> String {
    fn type_name<T: Layout>(out: &mut String) {
        let name = T::TYPE_NAME.strip_prefix("roomcast.").unwrap();
        let _ = writeln!(out, "#define ROOMCAST_TYPE_NAME_{} \"{}\"", name.to_uppercase(), T::TYPE_NAME);
    }
    fn service<M: Message>(out: &mut String) {
        let quality = M::SERVICE;
        let name = quality.name.rsplit('/').next().unwrap().to_uppercase().replace('-', "_");
        let _ = writeln!(
            out,
            "#define ROOMCAST_SERVICE_{name} \"{}\"\n#define ROOMCAST_{name}_MAX_PUBLISHERS {}\n#define ROOMCAST_{name}_MAX_SUBSCRIBERS {}\n\
             #define ROOMCAST_{name}_BUFFER_SIZE {}\n#define ROOMCAST_{name}_HISTORY_SIZE {}",
            quality.name, quality.publishers, quality.subscribers, quality.buffer, quality.history
        );
    }
    let mut out = String::from("\n/* Type names, as iceoryx2 compares them. */\n");
    type_name::<NarrationV1>(&mut out);
    type_name::<RoomScoresV1>(&mut out);
    type_name::<PersonScoresV1>(&mut out);
    type_name::<ItemScoreV1>(&mut out);
    type_name::<ItemScoresHeaderV1>(&mut out);
    type_name::<ForecastV1>(&mut out);
    type_name::<PersonForecastsV1>(&mut out);
    type_name::<DecisionV1>(&mut out);
    type_name::<RobotReportV1>(&mut out);
    type_name::<StatusRequestV1>(&mut out);
    type_name::<StatusResponseV1>(&mut out);
    out.push_str("\n/* Publish-subscribe services and their quality; every participant states all of it. Safe overflow is on. */\n");
    service::<NarrationV1>(&mut out);
    service::<RoomScoresV1>(&mut out);
    service::<PersonScoresV1>(&mut out);
    service::<ForecastV1>(&mut out);
    service::<PersonForecastsV1>(&mut out);
    service::<DecisionV1>(&mut out);
    service::<RobotReportV1>(&mut out);
    out
}

fn header() -> String {
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("messages.rs");
    std::fs::write(&source, plain_rust()).unwrap();
    let mut trailer = names();
    trailer.push_str("\n#if defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L\n#include <stddef.h>\n");
    assertions::<NarrationV1>(&mut trailer);
    assertions::<IncludedV1>(&mut trailer);
    assertions::<RoomV1>(&mut trailer);
    assertions::<RoomScoresV1>(&mut trailer);
    assertions::<PersonV1>(&mut trailer);
    assertions::<PersonScoresV1>(&mut trailer);
    assertions::<ItemScoresHeaderV1>(&mut trailer);
    assertions::<ItemScoreV1>(&mut trailer);
    assertions::<ForecastV1>(&mut trailer);
    assertions::<PersonForecastV1>(&mut trailer);
    assertions::<PersonForecastsV1>(&mut trailer);
    assertions::<DecisionV1>(&mut trailer);
    assertions::<RobotReportV1>(&mut trailer);
    assertions::<StatusRequestV1>(&mut trailer);
    assertions::<StatusResponseV1>(&mut trailer);
    trailer.push_str("#endif\n");
    let mut config = cbindgen::Config {
        language: cbindgen::Language::C,
        cpp_compat: true,
        include_guard: Some("ROOMCAST_H".to_owned()),
        no_includes: true,
        sys_includes: vec!["stdint.h".to_owned()],
        header: Some(
            "/* Roomcast's contract between processes, made by cbindgen from the crate roomcast-ipc: `make c-header`. Do not edit.\n \
             *\n * Monotonic nanoseconds (`*_ns`) are of CLOCK_BOOTTIME, which counts suspension; `*_unix_ns` is wall clock, for people. */"
                .to_owned(),
        ),
        trailer: Some(trailer),
        documentation_style: cbindgen::DocumentationStyle::C99,
        line_length: 120,
        ..cbindgen::Config::default()
    };
    // No function refers to the structures, so cbindgen would drop them.
    config.export.include = plain_rust()
        .lines()
        .filter_map(|line| line.strip_prefix("pub struct ")?.split(' ').next().map(str::to_owned))
        .collect();
    let bindings = cbindgen::Builder::new().with_src(&source).with_config(config).generate().unwrap();
    let mut text = Vec::new();
    bindings.write(&mut text);
    String::from_utf8(text).unwrap()
}

#[test]
fn the_c_header_is_what_the_messages_are() {
    let path = repository().join("clients/c/roomcast.h");
    let header = header();
    if std::env::var_os("ROOMCAST_WRITE_HEADER").is_some() {
        std::fs::write(&path, &header).unwrap();
    }
    let known = std::fs::read_to_string(&path).unwrap_or_default();
    if known != header {
        let different = known.lines().zip(header.lines()).position(|(a, b)| a != b);
        panic!(
            "{} is out of date from line {:?} on; run `make c-header`",
            path.display(),
            different.map(|line| line + 1)
        );
    }
}

/// Compiles an example; `None` without a compiler.
fn compiled(folder: &Path, name: &str, standard: &str) -> Option<PathBuf> {
    let (program, sources) = (folder.join(name), repository().join("clients/c"));
    let mut compiler = Command::new("cc");
    compiler
        .arg(standard)
        .args(["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-o"])
        .arg(&program)
        .arg("-I")
        .arg(&sources);
    let Ok(compiled) = compiler.arg(sources.join(format!("{name}.c"))).output() else {
        skipped("there is no C compiler (apt-get install gcc)");
        return None;
    };
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    Some(program)
}

#[test]
fn a_c_robot_answers_its_decision() {
    let folder = tempfile::tempdir().unwrap();
    let Some(program) = compiled(folder.path(), "report", "-std=gnu11") else { return };
    let decision = DecisionV1 {
        robot: sequence::source_of_name("robot"),
        epoch: 7,
        sequence: 3,
        action: action::GO,
        to: text::encode("to", "kitchen").unwrap(),
        ..Default::default()
    };
    let (from, to) = (folder.path().join("decision"), folder.path().join("report.bin"));
    let run = |decision: DecisionV1| {
        std::fs::write(&from, decision.to_bytes()).unwrap();
        Command::new(&program).arg(&from).arg(&to).output().unwrap()
    };
    assert!(run(decision).status.success());
    let report = RobotReportV1::from_bytes(&std::fs::read(&to).unwrap()).unwrap();
    report.check().unwrap();
    assert_eq!((report.robot, report.decision_epoch, report.decision_sequence), (decision.robot, 7, 3));
    assert_eq!((report.kind, report.room(), report.battery()), (report_kind::FINISHED, "kitchen", Some(0.8)));
    assert!(report.reported_ns <= clock::monotonic_ns(), "the clock is the contract's");
    assert!(!run(DecisionV1 { sequence: 0, ..decision }).status.success(), "no decision has this number");
    assert!(!run(DecisionV1 { action: action::PAUSE, ..decision }).status.success());
    assert!(!run(DecisionV1 { robot: 9, ..decision }).status.success(), "another robot's");
}

#[test]
fn a_c_program_reads_what_rust_wrote() {
    let folder = tempfile::tempdir().unwrap();
    let Some(program) = compiled(folder.path(), "rooms", "-std=c11") else { return };

    let mut scores = RoomScoresV1 { epoch: 7, sequence: 3, room_count: 2, label_mass: 0.5, ..Default::default() };
    for (room, (id, probability)) in scores.room.iter_mut().zip([("kitchen", 0.75), ("living-room", 0.25)]) {
        room.id = text::encode("id", id).unwrap();
        room.probability = probability;
    }
    let run = |bytes: &[u8]| {
        let image = folder.path().join("scores");
        std::fs::write(&image, bytes).unwrap();
        Command::new(&program).arg(&image).output().unwrap()
    };
    let printed = run(&scores.to_bytes());
    assert_eq!(String::from_utf8(printed.stdout).unwrap(), "scores 3: go to living-room (next with 0.250)\n");
    assert!(printed.status.success());
    assert!(!run(&scores.to_bytes()[1..]).status.success());
    assert!(!run(&RoomScoresV1 { room_count: 65, ..scores }.to_bytes()).status.success());
}
