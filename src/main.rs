//! The `roomcast` binary: the command line, and features for people at a terminal.

#![cfg_attr(
    not(all(feature = "demo", feature = "simulation", feature = "latency", feature = "recordings")),
    allow(dead_code, reason = "commands that a smaller build leaves out use it")
)]

use std::process::ExitCode;

use roomcast_cli::exit_code;

mod bar;
mod cli;
mod columns;
mod decided;
#[cfg(all(test, feature = "view"))]
#[path = "../tests/support/eventually.rs"]
#[expect(clippy::unwrap_used, reason = "a panic in a test is the report")]
mod eventually;
mod flags;
#[cfg(feature = "home")]
mod home_assistant;
#[cfg(any(feature = "metrics", feature = "view"))]
mod http;
#[cfg(feature = "pull")]
mod hub;
#[cfg(feature = "latency")]
mod latency;
#[cfg(feature = "metrics")]
mod metrics;
#[cfg(feature = "publish")]
mod publish;
mod reasons;
#[cfg(any(feature = "publish", feature = "top", feature = "view"))]
mod robot_place;
#[cfg(any(feature = "top", feature = "view"))]
mod top;
#[cfg(feature = "view")]
mod view;

fn main() -> ExitCode {
    // This check comes before any code that needs much stack.
    match roomcast_ipc::limits::too_low() {
        Some(fault) => {
            roomcast_cli::tell(format_args!("roomcast: {fault}"));
            ExitCode::from(exit_code::FAILURE)
        }
        None => run(),
    }
}

/// A separate frame: with a small stack it is never entered.
#[inline(never)]
fn run() -> ExitCode {
    cli::main()
}
