//! The units as systemd itself judges them.

#![expect(clippy::unwrap_used, reason = "a panic in a test is the report")]

use std::path::Path;
use std::process::Command;

const UNITS: [&str; 4] =
    ["roomcast-daemon.service", "roomcast-planner.service", "roomcast-narrator.service", "roomcast-metrics.service"];

/// The units, with the path of the binary that was just built.
fn installed() -> Option<tempfile::TempDir> {
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        eprintln!("SKIPPED: systemd-analyze is not installed");
        return None;
    }
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd");
    let directory = tempfile::tempdir().unwrap();
    for unit in UNITS.iter().chain(&["roomcast.target"]) {
        let text = std::fs::read_to_string(source.join(unit)).unwrap();
        let text = text.replace("/usr/bin/roomcast", env!("CARGO_BIN_EXE_roomcast"));
        std::fs::write(directory.path().join(unit), text).unwrap();
    }
    Some(directory)
}

#[test]
fn systemd_finds_no_fault_with_the_units() {
    let Some(directory) = installed() else { return };
    for unit in UNITS.iter().chain(&["roomcast.target"]) {
        let mut verify = Command::new("systemd-analyze");
        verify.arg("verify").arg(directory.path().join(unit));
        let output = verify.env("SYSTEMD_UNIT_PATH", format!("{}:", directory.path().display())).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !said.contains("roomcast"), "{unit}: {said}");
    }
}

#[test]
fn the_units_exposure_is_2_or_better() {
    let Some(directory) = installed() else { return };
    for unit in UNITS {
        let mut security = Command::new("systemd-analyze");
        security.args(["security", "--offline=true", "--threshold=20"]).arg(directory.path().join(unit));
        let output = security.output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        println!("{unit}: {}", said.lines().last().unwrap_or_default());
        assert!(output.status.success(), "{unit}: {said}{}", String::from_utf8_lossy(&output.stderr));
    }
}

#[test]
fn the_shipped_configuration_is_one() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd/roomcast.toml");
    roomcast::config::Config::load(&path).unwrap();
}
