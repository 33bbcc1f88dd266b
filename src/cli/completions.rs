//! `roomcast completions`: shell completion scripts.

use clap::CommandFactory;

use super::{Cli, CommandResult};

/// Arguments of `roomcast completions`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The shell to complete for.
    shell: clap_complete::Shell,
}

/// Prints the script on standard output.
pub fn run(args: &Args) -> CommandResult {
    clap_complete::generate(args.shell, &mut Cli::command(), "roomcast", &mut std::io::stdout());
    Ok(())
}
