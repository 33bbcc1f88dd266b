use std::fmt::Display;
use std::io::Write;

/// Writes the line that `.ci/count` counts: `SKIPPED crate::test: reason`. libtest counts the test as passed, and `.ci/count` subtracts it.
pub(crate) fn skipped(reason: impl Display) {
    let thread = std::thread::current();
    let test = thread.name().unwrap_or("test");
    let line = format!("SKIPPED {}::{test}: {reason}\n", env!("CARGO_CRATE_NAME"));
    // libtest captures the macros' output of a passing test, but not writes to the handle.
    let _unread = std::io::stderr().write_all(line.as_bytes());
}
