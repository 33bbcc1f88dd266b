//! `roomcast completions`: shell completion scripts.

use clap::{Command, CommandFactory};

use super::{Cli, CommandResult};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The shell to complete for.
    shell: clap_complete::Shell,
}

pub fn run(args: &Args) -> CommandResult {
    super::print(&script(args.shell))
}

fn script(shell: clap_complete::Shell) -> String {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut visible(&Cli::command()), "roomcast", &mut script);
    String::from_utf8_lossy(&script).into_owned()
}

/// A copy without hidden commands and options, which the generators would offer.
fn visible(command: &Command) -> Command {
    // clap takes a static name: a few bytes per command, once, in a short process.
    let mut copy = Command::new(&*command.get_name().to_owned().leak())
        .propagate_version(command.is_propagate_version_set())
        .args(command.get_arguments().filter(|argument| !argument.is_hide_set()).cloned())
        .subcommands(command.get_subcommands().filter(|below| !below.is_hide_set()).map(visible));
    if let Some(version) = command.get_version() {
        copy = copy.version(&*version.to_owned().leak());
    }
    match command.get_about() {
        Some(about) => copy.about(about.clone()),
        None => copy,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn completions_offer_what_is_for_people_and_nothing_hidden() {
        for shell in [clap_complete::Shell::Bash, clap_complete::Shell::Zsh, clap_complete::Shell::Fish] {
            let script = script(shell);
            for offered in ["latency", "scene", "deadline-ms", "version", "shared-prefix"] {
                assert!(script.contains(offered), "{shell}: {offered} is missing");
            }
            for hidden in ["measured-end", "rehearse", "no-model"] {
                assert!(!script.contains(hidden), "{shell}: {hidden} is offered");
            }
        }
    }
}
