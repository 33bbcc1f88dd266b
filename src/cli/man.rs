//! `roomcast man`: the manual pages of all commands, for packages.

use std::path::{Path, PathBuf};

use clap::{Command, CommandFactory};

use super::{Cli, CommandResult, Failure, help};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder to write the pages into; it is made if it is missing.
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

pub fn run(args: &Args) -> CommandResult {
    let folder = &args.folder;
    let mut command = help::arranged(Cli::command()).disable_help_subcommand(true);
    command.build();
    let source = command.get_version().map_or_else(String::new, |version| format!("roomcast {version}"));
    std::fs::create_dir_all(folder).and_then(|()| write(&command, &source, folder)).map_err(|error| {
        let text = format!(
            "failed to write manual pages into {}: {error}; choose a folder that may be written",
            folder.display()
        );
        Failure::failed(text)
    })
}

fn write(command: &Command, source: &str, folder: &Path) -> std::io::Result<()> {
    for below in command.get_subcommands().filter(|below| !below.is_hide_set()) {
        write(below, source, folder)?;
    }
    clap_mangen::Man::new(command.clone()).source(source).generate_to(folder).map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    /// One package has two programs: their pages must have different names, and name their program.
    #[test]
    fn pages_are_of_this_program() {
        let folder = tempfile::tempdir().unwrap();
        run(&Args { folder: folder.path().to_owned() }).unwrap();
        let page = |name: &str| std::fs::read_to_string(folder.path().join(name));
        assert!(page("roomcast-zenoh.1").is_err() && page("roomcast-bridge.1").is_err());
        let header = format!("roomcast-publish-mqtt 1  \"roomcast {}\"", env!("CARGO_PKG_VERSION"));
        let mqtt = page("roomcast-publish-mqtt.1").unwrap();
        assert!(mqtt.lines().any(|line| line == format!(".TH {header} ")), "{}", &mqtt[..400]);
        assert!(page("roomcast.1").is_ok() && page("roomcast-scene-check.1").is_ok());
        // Links from roomcast.1 lead to every page, and to no other.
        let is_listed = |line: &str| Some(line.strip_suffix("(1)")?.replace('\\', "") + ".1");
        let files = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
        let pages: BTreeSet<String> = files.map(|name| name.into_string().unwrap()).collect();
        let mut listed = BTreeSet::from(["roomcast.1".to_owned()]);
        for name in &pages {
            listed.extend(page(name).unwrap().lines().filter_map(is_listed));
        }
        assert_eq!(listed, pages);
    }
}
