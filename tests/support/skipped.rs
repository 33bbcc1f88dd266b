//! How a test says that it was skipped.

use std::fmt::Display;
use std::io::Write;

/// Writes the one line that `.ci/count` counts: `SKIPPED crate::test: reason`. The test then returns, and libtest takes it for passed;
/// `.ci/count` takes it off again.
pub(crate) fn skipped(reason: impl Display) {
    let thread = std::thread::current();
    let test = thread.name().unwrap_or("test");
    let line = format!("SKIPPED {}::{test}: {reason}\n", env!("CARGO_CRATE_NAME"));
    // libtest holds back what the macros print in a test that passes; the handle itself it lets through.
    let _unread = std::io::stderr().write_all(line.as_bytes());
}
