//! An option's requirements hold with all other options: clap drops a requirement if a given option excludes the required one.

use super::commands;

fn all(command: &clap::Command, words: &str, found: &mut Vec<(String, clap::Command)>) {
    let words = format!("{words} {}", command.get_name());
    command.get_subcommands().for_each(|own| all(own, &words, found));
    found.push((words, command.clone()));
}

/// The requirements of an option; clap has them only in its debug text.
fn required_by(arg: &clap::Arg) -> Vec<String> {
    let text = format!("{arg:?}");
    let list = text.split_once(", requires: [").and_then(|(_, rest)| rest.split_once(']')).unwrap_or_default().0;
    list.split("(IsPresent, \"").skip(1).filter_map(|one| Some(one.split_once('"')?.0.to_owned())).collect()
}

fn excludes(command: &clap::Command, one: &clap::Arg, other: &clap::Arg) -> bool {
    let names =
        |a: &clap::Arg, b: &clap::Arg| command.get_arg_conflicts_with(a).iter().any(|own| own.get_id() == b.get_id());
    let alternatives = command.get_groups().any(|group| {
        let has = |arg: &clap::Arg| group.get_args().any(|own| own == arg.get_id());
        !group.clone().is_multiple() && has(one) && has(other)
    });
    alternatives || names(one, other) || names(other, one)
}

#[test]
fn what_excludes_a_required_argument_excludes_what_requires_it() {
    let mut found = Vec::new();
    all(&commands(), "", &mut found);
    let (mut requirements, mut dropped) = (Vec::new(), Vec::new());
    for (words, command) in &found {
        for arg in command.get_arguments() {
            for required in required_by(arg) {
                let target = command.get_arguments().find(|own| own.get_id() == required.as_str());
                let target = target.unwrap_or_else(|| panic!("{words} has no {required}"));
                let is_other = |other: &&clap::Arg| ![arg.get_id(), target.get_id()].contains(&other.get_id());
                let others = command.get_arguments().filter(is_other);
                let silent = others.filter(|other| excludes(command, target, other) && !excludes(command, arg, other));
                dropped.extend(silent.map(|other| format!("{words}: {} with {}", arg.get_id(), other.get_id())));
                requirements.push(format!("{words} {} {required}", arg.get_id()));
            }
        }
    }
    // The debug text still has the expected form.
    let known = [" roomcast scene draw caption scores", " roomcast-lab forecast split manifest"];
    assert!(requirements.iter().any(|own| known.contains(&own.as_str())), "{requirements:?}");
    assert!(dropped.is_empty(), "{dropped:#?}");
}
