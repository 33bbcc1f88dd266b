//! `roomcast man`: the manual pages of all commands, for packages.

use std::path::PathBuf;

use clap::CommandFactory;

use super::{Cli, CommandResult, Failure};
use crate::exit_code;

/// Arguments of `roomcast man`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder to write the pages into; it is made if it is missing.
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

/// Writes one page per command.
///
/// # Errors
///
/// When the folder cannot be written.
pub fn run(args: &Args) -> CommandResult {
    let folder = &args.folder;
    std::fs::create_dir_all(folder).and_then(|()| clap_mangen::generate_to(Cli::command(), folder)).map_err(|error| {
        let text = format!(
            "failed to write manual pages into {}: {error}; choose a folder that may be written",
            folder.display()
        );
        Failure::new(exit_code::FAILURE, text)
    })
}
