//! Roomcast's laboratory: the paper's tables and figures, and the project's own.

#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

mod commands;
mod experiment;
mod home_simulation;

fn main() -> ExitCode {
    // Output into a pipe that closes (`| head -1`) ends the program, as it ends any other.
    sigpipe::reset();
    commands::main()
}
