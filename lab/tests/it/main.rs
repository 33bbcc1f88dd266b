//! The program `roomcast-lab`: its arguments, and experiments that take files.

#![expect(clippy::unwrap_used, reason = "a panic in a test is the report")]

use std::path::Path;
use std::process::{Command, Stdio};

use roomcast_cli::exit_code;

fn lab(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast-lab"));
    command.args(arguments).stdin(Stdio::null());
    command
}

#[test]
fn arguments_out_of_range_or_without_effect_are_refused_before_anything_runs() {
    let table2 = ["table2"];
    let pareto = ["pareto"];
    let habits = ["habits", "--sensors", "log", "--rules", "rules.toml", "--scene", "studio"];
    let cases: [(&[&str], &[&str]); 16] = [
        (&habits, &["--items", "nearest"]),
        (&["horizon"], &["--restarts", "7"]),
        (&["horizon"], &["--room-time", "25"]),
        (&["horizon"], &["--disturbance", "in-sight"]),
        (&["card", "--shared", "data"], &["--only", "no such title"]),
        (&table2, &["--threads", "100000"]),
        (&table2, &["--restarts", "0"]),
        (&table2, &["--pace", "nan"]),
        (&table2, &["--pace=-1"]),
        (&table2, &["--object-time", "nan"]),
        (&table2, &["--stay-time", "0"]),
        (&table2, &["--longest-act", "0"]),
        (&table2, &["--history", "0"]),
        (&pareto, &["--weight", "nan"]),
        (&pareto, &["--weight=-5"]),
        (&table2, &["--seed", "-1"]),
    ];
    for (command, more) in cases {
        let mut command = lab(command);
        let output = command.args(more).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(i32::from(exit_code::USAGE)), "{command:?}: {said}");
        assert_eq!(output.stdout, b"", "{command:?}");
    }
}

#[test]
fn two_scenes_of_one_name_are_refused() {
    let output = lab(&["table2", "--scene", "studio", "--scene", "studio"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::INPUT)), "{said}");
    assert_eq!(said.matches("another of the scenes has its name").count(), 1, "{said}");
}

/// Another process loads the model file first; its error appears once.
#[test]
fn a_file_that_is_no_model_is_refused_with_one_error() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("model.gguf");
    std::fs::write(&file, "no model").unwrap();
    let scores = ["table2", "--scene", "studio", "--no-cache", "--model", file.to_str().unwrap()];
    let output = lab(&scores).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(exit_code::MODEL)), "{said}");
    assert_eq!((said.lines().count(), said.matches("model.gguf").count()), (1, 1), "{said}");
}

/// The files that the training writes for a fold, with the included model. `held_out` and `trained` are programs.
fn write_fold(folder: &Path, fold: &str, trained: &str, held_out: &str) {
    let models = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../models"));
    std::fs::create_dir_all(folder).unwrap();
    for name in ["household.gguf", "household-statistics.json"] {
        std::fs::copy(models.join(name), folder.join(name)).unwrap();
    }
    let files = |name: &str| serde_json::json!({ "files": [format!("programs/{name}")] });
    let splits = serde_json::json!({ "train": files(trained), "test": files(held_out), "sealed": files("c.txt") });
    let manifest = serde_json::json!({ "command": format!("run.py --fold {fold}"), "splits": splits });
    std::fs::write(folder.join("manifest.json"), manifest.to_string()).unwrap();
}

/// The result is in the file before the program prints it.
#[test]
fn folds_are_pooled_and_the_sealed_split_is_opened_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = |below: &str| folder.path().join(below).display().to_string();
    std::fs::create_dir(path("programs")).unwrap();
    let shipped = ["p0-breakfast-and-television", "p1-laundry-and-to-bed", "p2-long-evening"];
    for (name, program) in ["a", "b", "c"].iter().zip(shipped) {
        let from = format!(concat!(env!("CARGO_MANIFEST_DIR"), "/../scenes/programs/{}.txt"), program);
        std::fs::copy(from, path(&format!("programs/{name}.txt"))).unwrap();
    }
    let run = |command: &str, more: &[&str]| {
        let programs = path("programs");
        let output = lab(&[command, "--programs", &programs, "--scene", "studio", "--no-cache", "--json"])
            .args(more)
            .output()
            .unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        (output.status.code(), serde_json::from_slice::<serde_json::Value>(&output.stdout).ok(), said)
    };
    let input = Some(i32::from(exit_code::INPUT));

    write_fold(Path::new(&path("folds/fold-1")), "1", "a.txt", "b.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("1 finished fold,") && said.contains("training/run.py"), "{said}");
    write_fold(Path::new(&path("folds/fold-2")), "2", "b.txt", "a.txt");
    let (_, report, said) = run("folds", &["--folds", &path("folds")]);
    let report = report.unwrap_or_else(|| panic!("{said}"));
    assert_eq!((&report[0]["programs"], &report[0]["activities"]), (&2.into(), &2.into()));
    write_fold(Path::new(&path("folds/fold-2")), "2", "a.txt", "b.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("b.txt is held out by two folds"), "{said}");
    write_fold(Path::new(&path("folds/fold-2")), "2", "a.txt", "a.txt");
    let (code, _, said) = run("folds", &["--folds", &path("folds")]);
    assert!(code == input && said.contains("so it was not held out"), "{said}");

    write_fold(Path::new(&path("sealed")), "sealed", "a.txt", "b.txt");
    let (record, trained, none) = (path("sealed.json"), path("sealed"), path("programs"));
    let sealed = ["--trained", &trained, "--record", &record, "--places", &none];
    let manifest = path("folds/fold-1/manifest.json");
    let (code, _, said) = run("forecast", &["--manifest", &manifest, "--split", "sealed"]);
    assert!(code == input && said.contains("opened once"), "{said}");
    // A record that cannot be written is an error before the model, missing here, is read.
    let nowhere = path("none/sealed.json");
    let unread = ["--trained", &path("folds/none"), "--record", &nowhere, "--places", &none];
    let (code, _, said) = run("sealed", &unread);
    assert!(code == input && said.contains("cannot be written down") && said.contains("--record"), "{said}");
    // The split stays sealed for another model, and until all inputs are complete.
    let (code, _, said) = run("sealed", &["--trained", &path("folds/fold-1"), "--record", &record, "--places", &none]);
    assert!(code == input && said.contains("--fold sealed"), "{said}");
    let (code, _, said) = run("sealed", &[&sealed[..], &["--scene", "nowhere.json"]].concat());
    assert!(code == input && said.contains("nowhere.json"), "{said}");
    assert_eq!(std::fs::read_to_string(&record).unwrap().trim(), "[]");
    let (_, shown, said) = run("sealed", &sealed);
    let shown = shown.unwrap_or_else(|| panic!("{said}"));
    let written = std::fs::read_to_string(&record).unwrap();
    let entries: serde_json::Value = serde_json::from_str(&written).unwrap();
    assert_eq!((entries.as_array().unwrap().len(), &entries[0]["reports"]), (1, &shown));
    assert_eq!(entries[0]["model"]["trained_by"], "run.py --fold sealed");
    let (code, shown, said) = run("sealed", &sealed);
    assert!(code == input && shown.is_none() && said.contains("opened already"), "{said}");
    assert_eq!(std::fs::read_to_string(&record).unwrap(), written);
}
