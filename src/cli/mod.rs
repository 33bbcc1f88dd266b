//! The command line: one file per subcommand, each with its `Args` and its `run`.

use std::fmt;
use std::io::Write;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::exit_code;

mod completions;
mod config;
mod doctor;
mod explain;
mod model;
mod scene;
mod score;

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

impl From<crate::setup::SetupError> for Failure {
    fn from(error: crate::setup::SetupError) -> Self {
        Self::new(error.exit_code(), error)
    }
}

/// What every subcommand returns.
pub type CommandResult = Result<(), Failure>;

/// A bar of `share` (0 to 1) in at most `width` cells, in eighths of a cell.
#[must_use]
pub fn bar(share: f64, width: usize) -> String {
    const EIGHTHS: [&str; 8] = ["", "▏", "▎", "▍", "▌", "▋", "▊", "▉"];
    let eighths = (share.clamp(0.0, 1.0) * width as f64 * 8.0).round() as usize;
    format!("{}{}", "█".repeat(eighths / 8), EIGHTHS[eighths % 8])
}

/// An empty table in the one style that all commands print.
#[must_use]
pub fn table(header: &[&str]) -> comfy_table::Table {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::NOTHING).set_header(header);
    table
}

/// Prints a value as indented JSON on standard output.
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print_json(value: &impl serde::Serialize) -> CommandResult {
    let text = serde_json::to_string_pretty(value).map_err(|e| Failure::new(exit_code::FAILURE, e))?;
    writeln!(std::io::stdout().lock(), "{text}").map_err(|e| Failure::new(exit_code::FAILURE, e))
}

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
    /// Print the commented default configuration, or check one.
    Config(config::Args),
    /// Say whether this machine can run Roomcast, and how well.
    Doctor(doctor::Args),
    /// Explain the scores of one moment: rooms, labels, tokens, items and the narration behind them.
    Explain(explain::Args),
    /// Inspect, check and fetch language models.
    Model(model::Args),
    /// Score every label, item and partition of a scene once.
    Score(score::Args),
    /// Import, check, show and draw semantic maps.
    Scene(scene::Args),
}

/// Parses the command line, runs it and gives the exit code; prints an error once, on standard error.
#[must_use]
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Completions(args) => completions::run(&args),
        Command::Config(args) => config::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Explain(args) => explain::run(&args),
        Command::Model(args) => model::run(&args),
        Command::Score(args) => score::run(&args),
        Command::Scene(args) => scene::run(&args),
    };
    match result {
        Ok(()) => ExitCode::from(exit_code::OK),
        Err(failure) => {
            eprintln!("roomcast: {failure}");
            ExitCode::from(failure.code)
        }
    }
}
