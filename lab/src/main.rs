//! Roomcast's laboratory: the paper's tables and figures, and the project's own.

#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

mod commands;
mod experiment;
mod home_simulation;

/// The shipped activity programs for homes, by name, for tests.
#[cfg(test)]
const PROGRAMS: [(&str, &str); 3] = [
    ("p0-breakfast-and-television", include_str!("../../scenes/programs/p0-breakfast-and-television.txt")),
    ("p1-laundry-and-to-bed", include_str!("../../scenes/programs/p1-laundry-and-to-bed.txt")),
    ("p2-long-evening", include_str!("../../scenes/programs/p2-long-evening.txt")),
];

fn main() -> ExitCode {
    // Output into a pipe that closes (`| head -1`) ends the program, as it ends any other.
    sigpipe::reset();
    commands::main()
}
