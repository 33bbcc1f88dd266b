//! Suspension, simulated by a time namespace with its boot clock set ahead.

use std::process::Command;

use roomcast_ipc::clock::monotonic_ns;

use crate::skipped::skipped;

/// Set in the child process in the namespace.
const SAY: &str = "ROOMCAST_SAY_THE_TIME";
const SUSPENDED_S: u64 = 1_000_000;

#[test]
fn time_in_which_the_machine_is_suspended_counts() {
    const THIS: &str = "clock::time_in_which_the_machine_is_suspended_counts";
    if std::env::var_os(SAY).is_some() {
        return println!("the time: {}", monotonic_ns());
    }
    let program = std::env::current_exe().unwrap();
    let suspended = |s: u64| {
        let mut command = Command::new("unshare");
        command.args(["--map-root-user", "--time", "--boottime", &s.to_string(), "--fork"]).arg(&program);
        let output = command.args(["--exact", THIS, "--nocapture"]).env(SAY, "1").output().ok()?;
        let said = String::from_utf8(output.stdout).unwrap();
        let time = said.split("the time: ").nth(1)?.split_whitespace().next()?;
        Some(time.parse::<u64>().unwrap())
    };
    let (Some(before), Some(after)) = (suspended(0), suspended(SUSPENDED_S)) else {
        return skipped("no time namespace can be made (unshare --time)".to_owned());
    };
    assert!(after - before >= SUSPENDED_S * 1_000_000_000, "{before} and {after}");
}
