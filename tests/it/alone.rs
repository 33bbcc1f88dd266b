//! Tests that count what their own process holds.

use std::process::Command;

const ALONE: &str = "ROOMCAST_TEST_ALONE";

/// Whether this test has a process of its own. Otherwise it is run in one, and has passed there when this returns: the caller returns, too.
pub(crate) fn is_alone() -> bool {
    let thread = std::thread::current();
    // Under cargo-nextest, and with one thread, no other test runs beside this one.
    let Some(test) = thread.name().filter(|name| *name != "main") else { return true };
    if std::env::var_os(ALONE).is_some() || std::env::var_os("NEXTEST").is_some() {
        return true;
    }
    let mut command = Command::new(std::env::current_exe().unwrap());
    let output = command.args(["--exact", test, "--nocapture", "--include-ignored"]).env(ALONE, "1").output().unwrap();
    println!("{}", String::from_utf8_lossy(&output.stdout));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    false
}
