//! Tests of several crates or of real processes, in one program: its dependencies are linked once.
//!
//! `#[ignore = "full"]` marks long tests and tests of foreign programs: `make test-full` runs them, `make test` does not.

#![expect(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a panic in a test is the report")]

mod allocations;
mod alone;
mod browser;
mod chaos;
#[path = "../support/eventually.rs"]
mod eventually;
mod exhaustion;
#[path = "../support/fake_valetudo.rs"]
mod fake_valetudo;
mod fuzzed;
mod home_assistant;
mod household;
#[path = "../support/household.rs"]
mod household_day;
mod influence;
mod limits;
mod manual;
#[path = "../support/mosquitto.rs"]
mod mosquitto;
mod mqtt;
mod processes;
mod scoring;
mod setup;
mod simulated;
#[path = "../support/skipped.rs"]
mod skipped;
mod soak;
mod syscalls;
mod systemd;
mod world;

/// The number in a variable of the environment.
fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}: give a number")))
}
