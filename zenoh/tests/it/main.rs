//! Tests of `roomcast-zenoh` with real processes, routers and other implementations: one program.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a panic in a test is the report")]

mod access;
mod attack;
mod day;
#[path = "../../../tests/support/eventually.rs"]
mod eventually;
mod fleet;
#[expect(dead_code, reason = "the first hours are not compared with another day")]
#[path = "../../../tests/support/fleet_day.rs"]
mod fleet_day;
mod habits;
mod hostile;
mod hub;
mod limits;
mod recording;
mod ros2;
#[path = "../../../tests/support/skipped.rs"]
mod skipped;
mod support;
mod systemd;
