//! Help pages: commands in groups by task, an example on each page, and research options under their own heading.

use std::fmt::Write as _;

use clap::Command;
use roomcast_cli::take_negative_numbers;

/// The commands by task, in the order in which a new user needs them.
const GROUPS: [(&str, &[&str]); 6] = [
    ("Try it", &["demo", "score", "explain"]),
    ("Set up a home", &["init", "doctor", "config", "scene", "model"]),
    ("Run it", &["daemon", "planner", "narrate", "robot", "report", "publish", "metrics"]),
    ("Watch it", &["top", "view", "record", "replay"]),
    ("Correct it", &["person", "habits"]),
    ("Measure and install", &["latency", "completions", "man"]),
];

/// Options by heading. The others keep clap's heading.
const HEADINGS: [(&str, &[&str]); 3] = [
    ("Running system", &["config", "root", "domain", "patience"]),
    ("MQTT broker", &["mqtt", "mqtt-credentials", "mqtt-ca"]),
    (RESEARCH, &RESEARCH_OPTIONS),
];
const RESEARCH: &str = "Research";
/// Options that change the method. Only `--help` shows them.
const RESEARCH_OPTIONS: [&str; 15] = [
    "binding",
    "continuation",
    "deadline-ms",
    "effort",
    "equivalence",
    "history",
    "kv-cache",
    "level",
    "method",
    "no-room-labels",
    "prepare",
    "prior",
    "seed",
    "spin",
    "tokenisation",
];
/// Options for unusual set-ups. Only `--help` shows them, too.
const RARE: [&str; 2] = ["root", "domain"];

/// Examples by command. A test parses them.
const EXAMPLES: &[(&str, &str)] = &[
    ("", "roomcast demo\nroomcast score \"They open the fridge.\"\nroomcast COMMAND --help"),
    ("completions", "roomcast completions bash > ~/.local/share/bash-completion/completions/roomcast"),
    ("config", "roomcast config > roomcast.toml\nroomcast config --check roomcast.toml"),
    ("daemon", "roomcast daemon --config roomcast.toml\nroomcast daemon --scene flat.json --verbose"),
    ("demo", "roomcast demo\nroomcast demo --days 7"),
    ("doctor", "roomcast doctor\nroomcast doctor --config home/roomcast.toml"),
    ("explain", "roomcast explain \"They open the fridge.\"\nroomcast explain --where ada"),
    ("habits", "roomcast habits show"),
    ("habits export", "roomcast habits export habits.json"),
    ("habits forget", "roomcast habits forget --person ada"),
    ("habits import", "roomcast habits import habits.json"),
    ("habits learn", "roomcast habits learn --sensors log.tsv --rules rules.toml --person ada"),
    ("habits show", "roomcast habits show --json"),
    ("init", "roomcast init\nroomcast init --home-assistant http://homeassistant:8123 --token-file token --out home"),
    ("latency", "roomcast latency --samples 80 --load idle"),
    ("man", "roomcast man man1"),
    ("metrics", "roomcast metrics --listen 127.0.0.1:9464"),
    ("model", "roomcast model info"),
    ("model check", "roomcast model check model.gguf"),
    ("model info", "roomcast model info model.gguf"),
    ("model pull", "roomcast model pull HuggingFaceTB/SmolLM2-135M-Instruct-GGUF smollm2-135m-instruct-q8_0.gguf"),
    (
        "narrate",
        "echo \"They open the fridge.\" | roomcast narrate -\nroomcast narrate --mqtt --rules rules.toml --dry-run",
    ),
    ("person", "roomcast person list"),
    ("person correct", "roomcast person correct ada kitchen\nroomcast person correct ada away"),
    ("person forget", "roomcast person forget ada"),
    ("person list", "roomcast person list --json"),
    ("person rename", "roomcast person rename 3 ada"),
    ("planner", "roomcast planner --config roomcast.toml\nroomcast planner --room-time 300"),
    ("publish", "roomcast publish mqtt --dry-run --once"),
    ("publish mqtt", "roomcast publish mqtt --mqtt mqtt://127.0.0.1"),
    ("record", "roomcast record day.mcap --seconds 3600"),
    ("replay", "roomcast replay day.mcap --speed 10"),
    ("report", "roomcast report finished --room kitchen\nroomcast report hold --for 600"),
    ("robot", "roomcast robot\nroomcast robot --obey"),
    ("scene", "roomcast scene show studio"),
    ("scene apply", "roomcast scene apply changes.json"),
    ("scene change", "roomcast scene change flat.json changes.json --out new-flat.json"),
    ("scene check", "roomcast scene check flat.json --strict"),
    ("scene draw", "roomcast scene draw studio --out studio.svg"),
    ("scene import", "roomcast scene import valetudo.json --out flat.json --furnish typical"),
    ("scene show", "roomcast scene show apartment-e0 --json"),
    (
        "score",
        "roomcast score \"They open the fridge. They grab the milk.\"\nroomcast score --scene flat.json \"They sit.\"",
    ),
    ("top", "roomcast top\nroomcast top --json --snapshots 1"),
    ("view", "roomcast view\nroomcast view --recording day.mcap"),
];

/// The command line with groups, headings and examples.
pub fn arranged(command: Command) -> Command {
    let groups = groups(&command);
    let command = with_headings(take_negative_numbers(command), "");
    let template =
        "{about-with-newline}\n{usage-heading} {usage}\n\n".to_owned() + &groups + "\nOptions:\n{options}{after-help}";
    command.help_template(template)
}

fn groups(command: &Command) -> String {
    let mut text = String::new();
    for (heading, names) in GROUPS {
        let known: Vec<_> = names.iter().filter_map(|name| command.find_subcommand(name)).collect();
        if !known.is_empty() {
            let _ = writeln!(text, "{heading}:");
        }
        for own in known {
            let about = own.get_about().map_or_else(String::new, ToString::to_string);
            let _ = writeln!(text, "  {:<12} {about}", own.get_name());
        }
        text.push('\n');
    }
    text.truncate(text.trim_end().len());
    text + "\n"
}

fn with_headings(command: Command, path: &str) -> Command {
    let arranged = |arg: clap::Arg| {
        let Some(long) = arg.get_long().map(str::to_owned) else { return arg };
        let is_rare = RESEARCH_OPTIONS.contains(&&*long) || RARE.contains(&&*long);
        let heading = HEADINGS.iter().find(|(_, options)| options.contains(&&*long));
        let arg = arg.hide_env_values(true).hide_short_help(is_rare);
        heading.map_or(arg.clone(), |(heading, _)| arg.help_heading(*heading))
    };
    let examples = EXAMPLES.iter().find(|(own, _)| *own == path).map(|(_, examples)| *examples);
    let examples = examples.map(|examples| format!("Examples:\n  {}", examples.replace('\n', "\n  ")));
    let command = match examples {
        Some(examples) => match command.get_after_long_help().cloned() {
            Some(more) => command.after_long_help(format!("{examples}\n\n{more}")).after_help(examples),
            None => command.after_help(examples),
        },
        None => command,
    };
    command.mut_args(arranged).mut_subcommands(|own| {
        let path = format!("{path} {}", own.get_name());
        with_headings(own, path.trim_start())
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::cli::commands;

    /// Each page that a user can open, by the words after `roomcast`.
    fn pages(command: &Command, path: &str, all: &mut BTreeMap<String, Command>) {
        all.insert(path.to_owned(), command.clone());
        for own in command.get_subcommands().filter(|own| !own.is_hide_set() && own.get_name() != "help") {
            pages(own, format!("{path} {}", own.get_name()).trim_start(), all);
        }
    }

    fn all_pages() -> BTreeMap<String, Command> {
        let mut all = BTreeMap::new();
        pages(&commands(), "", &mut all);
        all
    }

    #[test]
    fn each_command_is_in_one_group_and_fits_into_80_columns() {
        let all = commands();
        let own: Vec<&str> = all.get_subcommands().filter(|own| !own.is_hide_set()).map(Command::get_name).collect();
        let mut grouped: Vec<&str> = GROUPS.iter().flat_map(|(_, names)| *names).copied().collect();
        grouped.sort_unstable();
        assert_eq!(own, grouped);
        let page = commands().render_help().to_string();
        let wide: Vec<&str> = page.lines().filter(|line| line.chars().count() > 80).collect();
        assert!(wide.is_empty(), "{wide:?}");
        assert!(page.contains("Set up a home:\n  init ") && page.contains("\nExamples:\n  roomcast demo\n"), "{page}");
        assert!(!page.contains("Exit codes") && commands().render_long_help().to_string().contains("Exit codes"));
    }

    #[test]
    fn each_page_has_examples_that_parse() {
        let all = all_pages();
        assert_eq!(
            all.keys().map(String::as_str).collect::<Vec<_>>(),
            EXAMPLES.iter().map(|own| own.0).collect::<Vec<_>>()
        );
        for (page, examples) in EXAMPLES.iter().filter(|(page, _)| !page.is_empty()) {
            let help = all[*page].clone().render_help().to_string();
            for example in examples.lines() {
                assert!(help.contains(example), "{page}: {help}");
                parse(example).unwrap_or_else(|error| panic!("{example}: {error}"));
            }
        }
    }

    #[test]
    fn research_options_have_their_own_heading_and_no_place_on_the_short_page() {
        let page = all_pages().remove("score").unwrap();
        let (short, long) = (page.clone().render_help().to_string(), page.clone().render_long_help().to_string());
        assert!(!short.contains("--tokenisation") && short.contains("--scene"), "{short}");
        assert!(
            long.split_once("\nResearch:").is_some_and(|(_, research)| research.contains("--tokenisation")),
            "{long}"
        );
        assert!(short.lines().count() < 30 && long.lines().count() > 60, "{short}");
    }

    /// Parses the arguments of the first `roomcast` in a shell line.
    fn parse(line: &str) -> Result<(), String> {
        let line = line.split_once("roomcast ").map_or(line, |(_, after)| after);
        let end = [" > ", " | ", " && ", " 2>", " &", ";"].iter().filter_map(|end| line.find(end)).min();
        let line = &line[..end.unwrap_or(line.len())];
        let words = line.split('"').enumerate().flat_map(|(at, part)| match at % 2 {
            0 => part.split_whitespace().map(|word| word.trim_matches('\'')).collect(),
            _ => vec![part],
        });
        match commands().try_get_matches_from(std::iter::once("roomcast").chain(words)) {
            Ok(_) => Ok(()),
            Err(error) if !error.use_stderr() => Ok(()),
            Err(error) => Err(error.to_string()),
        }
    }

    /// The manual may not show a command or an option that the program does not have.
    #[test]
    fn each_command_in_the_manual_parses() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let pages = std::fs::read_dir(root.join("docs")).unwrap().map(|entry| entry.unwrap().path());
        let (mut faults, mut count) = (Vec::new(), 0);
        for page in pages.chain(["README.md", "scenes/README.md", "systemd/README.md"].map(|name| root.join(name))) {
            if page.extension().is_none_or(|ending| ending != "md") {
                continue;
            }
            let text = std::fs::read_to_string(&page).unwrap();
            for block in text.split("```sh\n").skip(1) {
                let block = block.split("```").next().unwrap_or_default().replace("\\\n", " ");
                for line in block.lines() {
                    let line = line.split(" #").next().unwrap_or_default().trim();
                    let command = line.strip_prefix("target/release/").unwrap_or(line);
                    if command.starts_with("roomcast ") && !command.contains("COMMAND") {
                        count += 1;
                        parse(command)
                            .unwrap_or_else(|error| faults.push(format!("{}: {command}: {error}", page.display())));
                    }
                }
            }
        }
        assert!(faults.is_empty() && count > 50, "{count} commands; {}", faults.join("\n"));
    }

    #[test]
    fn the_page_on_commands_shows_the_help() {
        let page = include_str!("../../docs/commands.md");
        let help = commands().render_help().to_string();
        let help: Vec<&str> = help.lines().map(str::trim_end).collect();
        let help = help.join("\n");
        assert!(
            page.contains(&format!("```text\n{}\n```", help.trim_end())),
            "docs/commands.md has another help than:\n{help}"
        );
        let missing: Vec<_> = all_pages()
            .into_keys()
            .filter(|path| !page.contains(path.split(' ').next_back().unwrap_or_default()))
            .collect();
        assert!(missing.is_empty(), "docs/commands.md does not name {missing:?}");
    }
}
