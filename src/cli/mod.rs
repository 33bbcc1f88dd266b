//! The command line: one file per subcommand, each with its `Args` and its `run`.

use std::fmt;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::exit_code;

mod completions;
mod model;

/// A failed command: the documented exit code and the chain of causes, printed once by [`main`].
#[derive(Debug)]
pub struct Failure {
    /// One of [`exit_code`]'s constants.
    pub code: u8,
    /// What failed, where, and the remedy.
    pub error: Box<dyn std::error::Error + Send + Sync>,
}

impl Failure {
    /// Wraps an error with the exit code it stands for.
    pub fn new(code: u8, error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self { code, error: error.into() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.error)?;
        let mut cause = self.error.source();
        while let Some(error) = cause {
            write!(f, ": {error}")?;
            cause = error.source();
        }
        Ok(())
    }
}

/// What every subcommand returns.
pub type CommandResult = Result<(), Failure>;

/// Which room a person will be in next, in time for the robot to be elsewhere.
#[derive(Debug, Parser)]
#[command(name = "roomcast", version, propagate_version = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Print a completion script for a shell.
    Completions(completions::Args),
    /// Inspect and fetch language models.
    Model(model::Args),
}

/// Parses the command line, runs it and gives the exit code; prints an error once, on standard error.
#[must_use]
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Completions(args) => completions::run(&args),
        Command::Model(args) => model::run(&args),
    };
    match result {
        Ok(()) => ExitCode::from(exit_code::OK),
        Err(failure) => {
            eprintln!("roomcast: {failure}");
            ExitCode::from(failure.code)
        }
    }
}
