//! The tests that need more than one crate, or real processes: one program, so that what they test is linked once.
//!
//! A test that takes long, or needs a program from elsewhere, is marked `#[ignore = "full"]`: `make test` leaves it to `make test-full`.

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
#[path = "../support/lived_day.rs"]
mod lived_day;
#[path = "../support/mosquitto.rs"]
mod mosquitto;
mod mqtt;
mod processes;
#[path = "../support/robot_map.rs"]
mod robot_map;
mod scoring;
mod setup;
mod shapes;
mod simulated;
#[path = "../support/skipped.rs"]
mod skipped;
mod soak;
mod syscalls;
mod systemd;
mod world;
