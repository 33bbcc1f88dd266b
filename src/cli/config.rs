//! `roomcast config`: the commented default configuration, or a check of one's own.

use std::path::PathBuf;

use super::{CommandResult, Failure};
use crate::exit_code;
use roomcast_services::config::{Config, DEFAULT_TOML};

/// Arguments of `roomcast config`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Check this file and print what it amounts to, instead of the commented defaults.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// Prints the manual, or the checked file with every default filled in.
///
/// # Errors
/// When the file is malformed.
pub fn run(args: &Args) -> CommandResult {
    let text = match &args.check {
        None => DEFAULT_TOML.to_owned(),
        Some(path) => {
            let config = Config::load(path).map_err(|e| Failure::new(exit_code::CONFIG, e))?;
            toml::to_string(&config).map_err(|e| Failure::new(exit_code::FAILURE, e))?
        }
    };
    super::print(&text)
}
