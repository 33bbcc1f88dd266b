//! `roomcast config`: the commented default configuration, or a check of one's own.

use std::path::PathBuf;

use super::{CommandResult, Failure};
use crate::exit_code;
use roomcast_llama::affinity;
use roomcast_llama::gguf::Header;
use roomcast_services::config::{Config, DEFAULT_TOML};
use roomcast_services::setup;

/// Arguments of `roomcast config`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Check this file, and that this machine has what it names, and print what it amounts to, instead of the commented defaults.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// Prints the manual, or the checked file with every default filled in.
///
/// # Errors
/// When the file is malformed, or names a scene, a model file or cores that this machine has not.
pub fn run(args: &Args) -> CommandResult {
    let text = match &args.check {
        None => DEFAULT_TOML.to_owned(),
        Some(path) => {
            let config = Config::load(path).map_err(|e| Failure::new(exit_code::CONFIG, e))?;
            check_names(&config)?;
            toml::to_string(&config).map_err(|e| Failure::new(exit_code::FAILURE, e))?
        }
    };
    super::print(&text)
}

/// Whether the daemon would find what the configuration names.
fn check_names(config: &Config) -> CommandResult {
    setup::load_map(config.scene.path.as_deref())?;
    if let Some(path) = &config.model.path {
        Header::read_language_model(path).map_err(|error| Failure::new(exit_code::MODEL, error))?;
    }
    setup::check_pin(config)?;
    affinity::check(&config.model.cores).map_err(|error| Failure::new(exit_code::CONFIG, error))
}
