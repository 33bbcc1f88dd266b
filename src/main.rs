//! The `roomcast` binary: parse, run, exit code.

use std::process::ExitCode;

fn main() -> ExitCode {
    roomcast::cli::main()
}
