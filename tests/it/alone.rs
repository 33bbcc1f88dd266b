//! Tests that count the resources of their process.

use std::process::Command;

const ALONE: &str = "ROOMCAST_TEST_ALONE";

/// Whether this test has its own process. If not, it has run and passed in one when this returns, and the caller returns too.
pub(crate) fn is_alone() -> bool {
    let thread = std::thread::current();
    // Under cargo-nextest, and with one thread, no other test runs in this process.
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
