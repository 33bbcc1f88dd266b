//! The `roomcast` binary: the command line, and features for people at a terminal.

#![cfg_attr(not(feature = "whole"), allow(dead_code, reason = "commands that a smaller build leaves out use it"))]

use std::process::ExitCode;

use roomcast_cli::exit_code;

mod bar;
mod cli;
mod columns;
mod decided;
#[cfg(all(feature = "whole", test))]
#[path = "../tests/support/eventually.rs"]
#[expect(clippy::unwrap_used, reason = "a panic in a test is the report")]
mod eventually;
mod flags;
#[cfg(feature = "whole")]
mod home_assistant;
#[cfg(feature = "whole")]
mod http;
#[cfg(feature = "whole")]
mod hub;
#[cfg(feature = "whole")]
mod latency;
#[cfg(feature = "whole")]
mod metrics;
#[cfg(feature = "whole")]
mod publish;
mod reasons;
#[cfg(feature = "whole")]
mod robot_place;
#[cfg(feature = "whole")]
mod top;
#[cfg(feature = "whole")]
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
