//! `roomcast habits`: what the daemon has learned of the home, to forget it, to take it elsewhere and back.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use roomcast_ipc::{QuestionPort, question, sequence};

use super::{CommandResult, Failure, print, service, table};
use crate::exit_code;
use roomcast_services::daemon::{HabitsAnswer, HabitsLine, HabitsQuestion, IMPORT_BYTES_MAX, PART_BYTES};

/// Arguments of `roomcast habits`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Say how much was learned, of whom, and how much of the forecast comes from it.
    Show {
        #[command(flatten)]
        common: Common,
        /// Print the daemon's answer as JSON.
        #[arg(long)]
        json: bool,
    },
    /// Forget what was learned of a person, or all of it.
    Forget {
        /// A name or a number.
        #[arg(long, value_name = "NAME", required_unless_present = "all")]
        person: Option<String>,
        /// Forget everybody.
        #[arg(long, conflicts_with = "person")]
        all: bool,
        #[command(flatten)]
        common: Common,
    },
    /// Write what was learned into a file, as JSON: names of things and rooms, with counts by hour.
    Export {
        /// The file; it must not exist.
        file: PathBuf,
        #[command(flatten)]
        common: Common,
    },
    /// Put what was exported in place of what was learned.
    Import {
        /// The file.
        file: PathBuf,
        #[command(flatten)]
        common: Common,
    },
}

/// Options of every action.
#[derive(Debug, clap::Args)]
struct Common {
    #[command(flatten)]
    service: service::Args,
    /// Seconds to wait for the daemon.
    #[arg(long, value_name = "SECONDS", default_value_t = 10)]
    patience: u64,
}

/// Asks the running daemon.
///
/// # Errors
/// When no daemon answers, or it refuses.
pub fn run(args: &Args) -> CommandResult {
    match &args.action {
        Action::Show { common, json } => {
            let answer = Asker::new(common)?.ask(&HabitsQuestion::Show)?;
            if *json { super::print_json(&answer) } else { print(&shown(&answer)) }
        }
        Action::Forget { person, common, .. } => {
            let answer = Asker::new(common)?.ask(&HabitsQuestion::Forget { id: name(), who: person.clone() })?;
            print(&format!("Forgotten.{}\n", after_restart(&answer)))
        }
        Action::Export { file, common } => {
            let answer = Asker::new(common)?.ask(&HabitsQuestion::Export)?;
            let text = answer.export.as_deref().unwrap_or_default();
            write(file, text).map_err(|error| {
                let text = format!("cannot write {}: {error}; give a file that does not exist yet", file.display());
                Failure::new(exit_code::INPUT, text)
            })?;
            print(&format!("{} bytes in {}.\n", text.len(), file.display()))
        }
        Action::Import { file, common } => import(file, &Asker::new(common)?),
    }
}

/// Nobody else may read what somebody does all day.
fn write(file: &Path, text: &str) -> std::io::Result<()> {
    use std::io::Write;
    use std::os::unix::fs::OpenOptionsExt;
    let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(file)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()
}

fn import(file: &Path, asker: &Asker) -> CommandResult {
    let unreadable = |reason: String| {
        let text =
            format!("cannot import {}: {reason}; give a file that `roomcast habits export` wrote", file.display());
        Failure::new(exit_code::INPUT, text)
    };
    let mut text = String::new();
    let read =
        std::fs::File::open(file).and_then(|file| file.take(IMPORT_BYTES_MAX as u64 + 1).read_to_string(&mut text));
    read.map_err(|error| unreadable(error.to_string()))?;
    if text.len() > IMPORT_BYTES_MAX {
        return Err(unreadable(format!("it has more than {IMPORT_BYTES_MAX} bytes")));
    }
    let parts = parts_of(&text);
    let whole = name();
    let mut last = None;
    for (part, text) in parts.iter().enumerate() {
        let question = HabitsQuestion::Import {
            id: name(),
            whole: whole.clone(),
            part,
            parts: parts.len(),
            text: (*text).to_owned(),
        };
        last = Some(asker.ask(&question)?);
    }
    let Some(answer) = last else { return Err(unreadable("it is empty".to_owned())) };
    print(&format!(
        "Imported: {} counts of {} persons.{}\n",
        answer.counts,
        answer.persons.len(),
        after_restart(&answer)
    ))
}

/// The text in parts that a question can carry, as JSON too.
fn parts_of(text: &str) -> Vec<&str> {
    let mut parts = Vec::new();
    let mut rest = text;
    while !rest.is_empty() {
        let mut end = rest.len().min(PART_BYTES);
        while !rest.is_char_boundary(end) {
            end -= 1;
        }
        let (part, after) = rest.split_at(end);
        parts.push(part);
        rest = after;
    }
    parts
}

/// A name that no other question has.
fn name() -> String {
    format!("{:016x}", sequence::random_epoch())
}

fn after_restart(answer: &HabitsAnswer) -> &'static str {
    if answer.kept { "" } else { " A restarted daemon does not know this: daemon.state keeps habits." }
}

struct Asker {
    port: QuestionPort,
    patience: Duration,
}

impl Asker {
    fn new(common: &Common) -> Result<Self, Failure> {
        let (_, domain) = common.service.load()?;
        let port = domain.open("roomcast-habits").and_then(|node| node.question_port(question::HABITS));
        let port = port.map_err(|error| Failure::new(exit_code::IPC, error))?;
        Ok(Self { port, patience: Duration::from_secs(common.patience) })
    }

    fn ask(&self, question: &HabitsQuestion) -> Result<HabitsAnswer, Failure> {
        let question = serde_json::to_string(question).map_err(|error| Failure::new(exit_code::FAILURE, error))?;
        let text = self.port.ask(&question, self.patience).map_err(|error| Failure::new(exit_code::IPC, error))?;
        let answer: HabitsAnswer = serde_json::from_str(&text).map_err(|error| {
            let text = format!("the daemon's answer cannot be read: {error}; use one version of Roomcast");
            Failure::new(exit_code::IPC, text)
        })?;
        let reason = answer.reason.as_deref();
        if !answer.done {
            let text = format!("the daemon changed nothing: {}", reason.unwrap_or("no reason given"));
            return Err(Failure::new(exit_code::INPUT, text));
        }
        match reason {
            Some(reason) => Err(Failure::new(exit_code::FAILURE, reason)),
            None => Ok(answer),
        }
    }
}

/// How much was learned, as a table.
fn shown(answer: &HabitsAnswer) -> String {
    let mut text = match answer.learn {
        true => "Learning.".to_owned(),
        false => "Not learning (habits.learn = false).".to_owned(),
    };
    let HabitsAnswer { names, contexts, counts, bytes, .. } = answer;
    text += &format!(" {counts} counts in {contexts} contexts of {names} things, {bytes} bytes.\n");
    if answer.persons.is_empty() {
        return text + "Nothing was learned of anybody yet.\n";
    }
    let mut table = table(&["person", "name", "observations", "in 1 min", "in 15 min", "in 1 h"]);
    for line in &answer.persons {
        let HabitsLine { person, name, observations, forecast } = line;
        // Of the forecast, what is not the forecast without habits.
        let mut learned = forecast.iter().map(|line| format!("{:.0} %", 100.0 * (1.0 - line.shipped)));
        let mut next = || learned.next().unwrap_or_else(|| "-".to_owned());
        let name = name.clone().unwrap_or_default();
        table.add_row([person.to_string(), name, format!("{observations:.0}"), next(), next(), next()]);
    }
    format!("{text}{table}\nThe last columns say how much of the forecast for then comes from what was learned.\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_the_sum_of_its_parts() {
        let text = "\u{e4}\"".repeat(PART_BYTES);
        let parts = parts_of(&text);
        assert_eq!(parts.concat(), text);
        assert!(parts.iter().all(|part| part.len() <= PART_BYTES && !part.is_empty()));
        // Half of it are quotes, which JSON writes with two bytes.
        let question = serde_json::to_string(&parts[0]).unwrap();
        assert!(question.len() < question::QUESTION_BYTES_MAX);
        assert!(parts_of("").is_empty());
    }

    #[test]
    fn a_table_says_how_much_was_learned() {
        let line = HabitsLine { person: 7, name: Some("ada".to_owned()), observations: 41.6, forecast: Vec::new() };
        let answer = HabitsAnswer { learn: true, counts: 12, persons: vec![line], ..HabitsAnswer::default() };
        let text = shown(&answer);
        assert!(text.starts_with("Learning. 12 counts") && text.contains("ada") && text.contains("42"), "{text}");
        assert!(shown(&HabitsAnswer::default()).contains("Not learning"));
    }
}
