//! `roomcast habits`: shows, forgets, exports, imports and learns the daemon's habits.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

use roomcast_ipc::question;

use super::service::{self, Asking};
use super::{CommandResult, Failure, print, table};
use crate::exit_code;
use roomcast_services::daemon::{HabitsAnswer, HabitsLine, HabitsQuestion, IMPORT_BYTES_MAX, PART_BYTES, Zone};
use roomcast_services::lessons::{self, Lessons};
use roomcast_services::logging;
use roomcast_services::narrator::{Faults, Who};
use roomcast_services::sensor_log::{self, SensorRules};
#[cfg(feature = "whole")]
use {roomcast_ipc::raw::narration_kind, roomcast_services::narrator::Item, roomcast_simulation::homer::Day};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Print how much was learned, for each person, and its share of the forecast.
    Show {
        #[command(flatten)]
        common: Asking,
        /// Print the daemon's answer as JSON.
        #[arg(long)]
        json: bool,
    },
    /// Forget the habits of a person, or of all persons.
    #[command(group(clap::ArgGroup::new("whom").required(true).args(["person", "all"])))]
    Forget {
        /// A name or a number.
        #[arg(long, value_name = "NAME")]
        person: Option<String>,
        /// Forget all persons.
        #[arg(long)]
        all: bool,
        #[command(flatten)]
        common: Asking,
    },
    /// Write the habits into a file, as JSON: names of things and rooms, with counts by hour.
    Export {
        /// The file; it must not exist.
        file: PathBuf,
        #[command(flatten)]
        common: Asking,
    },
    /// Replace the habits by exported ones.
    Import {
        /// The file.
        file: PathBuf,
        #[command(flatten)]
        common: Asking,
    },
    /// Learn from earlier narration, in addition to the present habits.
    Learn(LearnArgs),
}

#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("input").required(true).args(INPUTS)))]
struct LearnArgs {
    /// Lines of JSON with `observed_unix_s`, as `roomcast narrate` takes them; `-` for standard input.
    lines: Option<PathBuf>,
    /// A sensor log, whose times are local ones.
    #[arg(long, value_name = "LOG", requires = "rules")]
    sensors: Option<PathBuf>,
    /// The rules that turn the sensor log into narration (docs/sensors.md).
    #[arg(long, value_name = "FILE", requires = "sensors", conflicts_with_all = INPUTS.iter().filter(|input| **input != "sensors"))]
    rules: Option<PathBuf>,
    /// A recording (docs/recording.md).
    #[arg(long, value_name = "FILE")]
    recording: Option<PathBuf>,
    /// A folder of days of activities (HOMER+), in the order of their names, with local times.
    #[cfg(feature = "whole")]
    #[arg(long, value_name = "FOLDER")]
    days: Option<PathBuf>,
    /// The date of the first of these days; by default the last one was yesterday.
    #[cfg(feature = "whole")]
    #[arg(long, value_name = "YYYY-MM-DD", requires = "days", conflicts_with = "rules", conflicts_with_all = INPUTS.iter().filter(|input| **input != "days"))]
    first_day: Option<String>,
    /// The person, by name or number, if the input names none.
    #[arg(long)]
    person: Option<Who>,
    #[command(flatten)]
    common: Asking,
}

#[cfg(feature = "whole")]
const INPUTS: [&str; 4] = ["lines", "sensors", "recording", "days"];
#[cfg(not(feature = "whole"))]
const INPUTS: [&str; 3] = ["lines", "sensors", "recording"];

pub fn run(args: &Args) -> CommandResult {
    match &args.action {
        Action::Show { common, json } => {
            let answer = Asker::new(common)?.ask(&HabitsQuestion::Show)?;
            if *json { super::print_json(&answer) } else { print(&shown(&answer)) }
        }
        Action::Forget { person, common, .. } => {
            let answer = Asker::new(common)?
                .ask(&HabitsQuestion::Forget { id: service::question_name(), who: person.clone() })?;
            print(&format!("Forgotten.{}\n", after_restart(&answer)))
        }
        Action::Export { file, common } => {
            let (_, text) = Asker::new(common)?.export()?;
            write_new(file, |whole| whole.write_all(text.as_bytes())).map_err(|error| {
                let (code, remedy) = match error.kind() {
                    ErrorKind::AlreadyExists => (exit_code::INPUT, "give a file that does not exist yet"),
                    ErrorKind::StorageFull | ErrorKind::FileTooLarge | ErrorKind::QuotaExceeded => {
                        (exit_code::FAILURE, "make room there, or give a file elsewhere")
                    }
                    _ => (exit_code::FAILURE, "give a file in a folder that can be written"),
                };
                Failure::new(code, format!("cannot write {}: {error}; {remedy}", file.display()))
            })?;
            print(&format!("{} bytes in {}.\n", text.len(), file.display()))
        }
        Action::Import { file, common } => import(file, &Asker::new(common)?),
        Action::Learn(args) => learn(args),
    }
}

/// Writes a file completely or not at all. Only its owner can read it: habits are private.
fn write_new(path: &Path, fill: impl FnOnce(&mut File) -> io::Result<()>) -> io::Result<()> {
    // An existing file is not replaced, and that is checked before anything is written.
    if path.symlink_metadata().is_ok() {
        return Err(ErrorKind::AlreadyExists.into());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut whole = tempfile::Builder::new().prefix(".roomcast-").tempfile_in(folder)?;
    fill(whole.as_file_mut())?;
    whole.as_file().sync_all()?;
    whole.persist_noclobber(path).map_err(|error| error.error)?;
    File::open(folder)?.sync_all()
}

fn read(file: &Path, most: u64) -> Result<String, Failure> {
    let fault = |reason: String| {
        let text = format!("cannot read {}: {reason}; give a file of text", file.display());
        Failure::input(text)
    };
    let mut text = String::new();
    let read = match file.as_os_str() == "-" {
        true => io::stdin().take(most + 1).read_to_string(&mut text),
        false => File::open(file).and_then(|file| file.take(most + 1).read_to_string(&mut text)),
    };
    read.map_err(|error| fault(error.to_string()))?;
    if text.is_empty() || text.len() as u64 > most {
        return Err(fault(format!("it has {} bytes, 1 to {most} are taken", text.len())));
    }
    Ok(text)
}

fn import(file: &Path, asker: &Asker) -> CommandResult {
    let text = read(file, IMPORT_BYTES_MAX as u64)?;
    let answer = asker.replace(&text, None)?;
    let answer =
        done(answer).map_err(|failure| Failure::new(failure.code, format!("{}: {failure}", file.display())))?;
    print(&format!("Imported: {}.{}\n", known(&answer), after_restart(&answer)))
}

/// "0 observations and 84 hours in known places": a person with presence events alone has only hours. Old observations count less, so the numbers can
/// fall.
fn counted([observations, hours]: [f64; 2]) -> String {
    // Adding 0 turns -0 into 0.
    let (observations, hours) = (observations.round() + 0.0, hours.round() + 0.0);
    let plural = |count: f64| if count == 1.0 { "" } else { "s" };
    let (of_things, of_hours) = (plural(observations), plural(hours));
    format!("{observations} observation{of_things} and {hours} hour{of_hours} in known places")
}

fn total(answer: &HabitsAnswer) -> [f64; 2] {
    let of = |each: fn(&HabitsLine) -> f64| answer.persons.iter().map(each).sum::<f64>();
    [of(|line| line.observations), of(|line| line.watched_h)]
}

fn known(answer: &HabitsAnswer) -> String {
    format!("{} of {}", counted(total(answer)), super::count(answer.persons.len(), "person"))
}

/// Learns from a file in this process, then replaces the daemon's habits.
fn learn(args: &LearnArgs) -> CommandResult {
    /// In a busy home the habits may change during each attempt.
    const ATTEMPTS: usize = 3;
    let _log = logging::init();
    let (read, unit) = lessons_of(args)?;
    tell_faults(read.faults());
    if read.lessons().is_empty() {
        let text = "nothing in it can be learned from: it has no narration with a time in the past; a sensor log is given with --sensors and --rules";
        return Err(Failure::input(text));
    }
    let (config, _) = args.common.service.load()?;
    let asker = Asker::new(&args.common)?;
    for attempt in 1..=ATTEMPTS {
        let (before, learned) = asker.export()?;
        let engine = lessons::engine(&config, &learned, read.zone().clone())?;
        let narrations = read.lessons().len();
        let learned = lessons::teach(engine, read.lessons().to_vec(), |told| {
            if told % 1_000 == 0 {
                super::tell(format_args!("roomcast: {told} of {narrations} narrations"));
            }
        });
        let answer = asker.replace(&learned?, Some(before.taken))?;
        if !answer.learned_meanwhile || attempt == ATTEMPTS {
            let answer = done(answer)?;
            let (now, then) = (total(&answer), total(&before));
            print(&format!(
                "Learned: {} of {}; {} now.{}\n",
                counted([now[0] - then[0], now[1] - then[1]]),
                super::count(narrations, "narration"),
                known(&answer),
                after_restart(&answer)
            ))?;
            return match usize::try_from(read.faults().count()).unwrap_or(usize::MAX) {
                0 => Ok(()),
                faults => Err(Failure::input(format!("{} left out", super::count(faults, unit)))),
            };
        }
    }
    Ok(())
}

/// The lessons, and the unit of its faults.
fn lessons_of(args: &LearnArgs) -> Result<(Lessons, &'static str), Failure> {
    let person = args.person.clone().unwrap_or_default();
    let (zone, now_unix_ns) = (Zone::local(), roomcast_services::clock::unix_ns());
    #[cfg(feature = "whole")]
    if let Some(folder) = &args.days {
        let days = roomcast_cli::days::read(folder)?;
        let first_s = first_day_s(args.first_day.as_deref(), days.len(), zone.local_s(now_unix_ns))?;
        let mut lessons = Lessons::of_local_time(&zone, now_unix_ns);
        for TimedItem { day, action, at_s, item } in day_items(&days, first_s, &person) {
            lessons.take(format_args!("day {day}, action {action}"), &item, Some(at_s));
        }
        return Ok((lessons, "action"));
    }
    match (&args.sensors, &args.rules, &args.recording, &args.lines) {
        (Some(log), Some(rules), ..) => {
            let narrated =
                SensorRules::load(rules).and_then(|rules| rules.in_zone(zone.clone()).narrate_file(log, &person));
            let narrated = narrated.map_err(Failure::input)?;
            roomcast_cli::tell_unfit(&narrated);
            let mut lessons = Lessons::of_local_time(&zone, now_unix_ns);
            lessons.take_sensors(narrated);
            Ok((lessons, "line"))
        }
        #[cfg(feature = "whole")]
        (_, _, Some(recording), _) => {
            let recording = super::record::read(recording)?;
            let mut lessons = Lessons::of_wall_clock(zone, now_unix_ns);
            lessons.take_recording(&recording);
            Ok((lessons, "narration"))
        }
        (.., Some(lines)) => {
            let mut lessons = Lessons::of_wall_clock(zone, now_unix_ns);
            lessons.take_lines(&read(lines, sensor_log::FILE_BYTES_MAX)?, &person);
            Ok((lessons, "line"))
        }
        _ => Err(Failure::usage("this build reads no recordings; give lines or --sensors")),
    }
}

fn tell_faults(faults: &Faults) {
    const TOLD: usize = 20;
    faults.told().iter().take(TOLD).for_each(|fault| super::tell(format_args!("roomcast: {fault}")));
    if faults.count() > TOLD as u64 {
        super::tell(format_args!("roomcast: and {} more", faults.count() - TOLD as u64));
    }
}

/// The start of the first of these days, in seconds since 1970, local time.
#[cfg(feature = "whole")]
fn first_day_s(date: Option<&str>, days: usize, now_s: f64) -> Result<f64, Failure> {
    const DAY_S: f64 = 86_400.0;
    let Some(date) = date else {
        return Ok(((now_s / DAY_S).floor() - days as f64).max(0.0) * DAY_S);
    };
    sensor_log::seconds(&format!("{date} 00:00:00"))
        .filter(|at_s| *at_s >= 0.0)
        .ok_or_else(|| Failure::usage(format!("--first-day {date:?} is no date: give YYYY-MM-DD")))
}

#[cfg(feature = "whole")]
struct TimedItem {
    /// From 1, as is the action's number in the day.
    day: usize,
    action: usize,
    /// In seconds since 1970, local time.
    at_s: f64,
    item: Item,
}

/// The narration of successive days, each action at its time. Times never go back, even if a day ends after the start of the next one.
#[cfg(feature = "whole")]
fn day_items(days: &[Day], first_s: f64, person: &Who) -> impl Iterator<Item = TimedItem> {
    let mut last_s = first_s;
    let days = (1..).zip(days).flat_map(move |(day, actions)| {
        let begin_s = first_s + 86_400.0 * (day - 1) as f64;
        (1..).zip(&actions.actions).map(move |(action, timed)| (day, action, begin_s + 60.0 * timed.done_min, timed))
    });
    days.map(move |(day, action, at_s, timed)| {
        last_s = at_s.max(last_s);
        let item = Item::new(narration_kind::SENTENCE, timed.action.sentence(), person.clone());
        TimedItem { day, action, at_s: last_s, item }
    })
}

/// The text in parts that fit a question, also as JSON.
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

fn after_restart(answer: &HabitsAnswer) -> &'static str {
    if answer.kept { "" } else { " A restarted daemon does not know this: daemon.state keeps habits." }
}

struct Asker(service::Asker);

impl Asker {
    fn new(common: &Asking) -> Result<Self, Failure> {
        common.asker("roomcast-habits", question::HABITS).map(Self)
    }

    /// Replaces the daemon's habits, if it still has the expected number of observations.
    fn replace(&self, json: &str, expected: Option<u64>) -> Result<HabitsAnswer, Failure> {
        let (parts, whole) = (parts_of(json), service::question_name());
        let mut last = HabitsAnswer::default();
        for (part, text) in parts.iter().enumerate() {
            last = self.0.ask(&HabitsQuestion::Import {
                id: service::question_name(),
                whole: whole.clone(),
                part,
                parts: parts.len(),
                text: (*text).to_owned(),
                expected,
            })?;
            if !last.done {
                break;
            }
        }
        Ok(last)
    }

    fn ask(&self, question: &HabitsQuestion) -> Result<HabitsAnswer, Failure> {
        done(self.0.ask(question)?)
    }

    /// All habits, and the answer that has them.
    fn export(&self) -> Result<(HabitsAnswer, String), Failure> {
        exported(self.ask(&HabitsQuestion::Export)?)
    }
}

/// The habits in an answer. An answer without them is an error: even empty habits have content.
fn exported(mut answer: HabitsAnswer) -> Result<(HabitsAnswer, String), Failure> {
    match answer.export.take().filter(|text| !text.is_empty()) {
        Some(text) => Ok((answer, text)),
        None => {
            let text = "the daemon's answer does not have what was learned; use one version of Roomcast";
            Err(Failure::ipc(text))
        }
    }
}

/// The answer, if everything was done.
fn done(answer: HabitsAnswer) -> Result<HabitsAnswer, Failure> {
    let reason = answer.reason.as_deref();
    if !answer.done {
        let text = format!("the daemon changed nothing: {}", reason.unwrap_or("no reason given"));
        return Err(Failure::input(text));
    }
    match reason {
        Some(reason) => Err(Failure::failed(reason)),
        None => Ok(answer),
    }
}

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
    let mut table = table(&["person", "name", "observations", "hours", "in 1 min", "in 15 min", "in 1 h"]);
    for line in &answer.persons {
        let HabitsLine { person, name, observations, watched_h, forecast } = line;
        // The share of the forecast that is not the forecast without habits.
        let mut learned = forecast.iter().map(|line| format!("{:.0} %", 100.0 * (1.0 - line.shipped)));
        let mut next = || learned.next().unwrap_or_else(|| "-".to_owned());
        let name = name.clone().unwrap_or_default();
        let (observations, hours) = (format!("{observations:.0}"), format!("{watched_h:.0}"));
        table.add_row([person.to_string(), name, observations, hours, next(), next(), next()]);
    }
    text += &format!(
        "{table}\nAn observation mentions a thing; the hours are those in which a person's place was known. The last columns say how much of the forecast \
        for then habits make up. With few observations and hours they assume more than they know.\n"
    );
    if answer.persons.iter().any(|line| line.forecast.is_empty()) {
        text += "Of whom they have a -, nothing was observed since the daemon began.\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::ids::PersonId;

    /// An empty file must not pass as an export.
    #[test]
    fn an_answer_without_what_was_learned_is_no_export() {
        for export in [None, Some(String::new())] {
            let answer = HabitsAnswer { done: true, export, ..HabitsAnswer::default() };
            assert_eq!(exported(answer).unwrap_err().code, exit_code::IPC);
        }
        let answer = HabitsAnswer { export: Some("{}".to_owned()), taken: 7, ..HabitsAnswer::default() };
        let (answer, text) = exported(answer).unwrap();
        assert_eq!((answer.taken, text.as_str()), (7, "{}"));
    }

    /// On a full disk there must be no partial file, which would block the next try.
    #[test]
    fn a_file_is_written_whole_or_not_at_all() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("habits.json");
        let full = |whole: &mut File| {
            whole.write_all(b"half")?;
            Err(ErrorKind::StorageFull.into())
        };
        assert_eq!(write_new(&path, full).unwrap_err().kind(), ErrorKind::StorageFull);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        write_new(&path, |whole| whole.write_all(b"all")).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        // An existing file is not replaced, even if it appears during the write.
        assert_eq!(write_new(&path, |_| panic!("it is there")).unwrap_err().kind(), ErrorKind::AlreadyExists);
        let other = folder.path().join("other.json");
        let come = |whole: &mut File| {
            std::fs::write(&other, "theirs")?;
            whole.write_all(b"ours")
        };
        assert_eq!(write_new(&other, come).unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(std::fs::read_to_string(&other).unwrap(), "theirs");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }

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

    #[cfg(feature = "whole")]
    #[test]
    fn days_of_activities_are_narrated_with_their_times() {
        let day = Day::parse("### a.txt\n[GRAB] <mug> (12) [1]\n1439.0\n[OPEN] <fridge> (3) [2]\n1450.5\n").unwrap();
        let now_s = 1_709_251_200.0 + 2.5 * 86_400.0;
        let first_s = first_day_s(Some("2024-03-01"), 2, now_s).unwrap();
        assert_eq!(first_s, 1_709_251_200.0);
        let items: Vec<_> = day_items(&[day.clone(), day], first_s, &Who::Number(PersonId(3))).collect();
        let minutes = |timed: &TimedItem| (timed.day, timed.action, (timed.at_s - first_s) / 60.0);
        let expected = [(1, 1, 1439.0), (1, 2, 1450.5), (2, 1, 2879.0), (2, 2, 2890.5)];
        assert_eq!(items.iter().map(minutes).collect::<Vec<_>>(), expected);
        assert!(items[0].item.text.contains("mug") && items[0].item.person == Who::Number(PersonId(3)));
        for wrong in ["yesterday", "2026-11-31", "1969-12-31"] {
            assert_eq!(first_day_s(Some(wrong), 1, now_s).unwrap_err().code, exit_code::USAGE, "{wrong}");
        }
        // Without a date the last day was yesterday, by local time.
        assert_eq!(
            [first_day_s(None, 1, now_s).unwrap(), first_day_s(None, 2, now_s).unwrap()],
            [first_s + 86_400.0, first_s]
        );
    }

    #[test]
    fn a_table_says_how_much_was_learned() {
        let name = Some("ada".to_owned());
        let line = HabitsLine { person: PersonId(7), name, observations: 41.6, watched_h: 83.7, forecast: Vec::new() };
        let answer = HabitsAnswer { learn: true, counts: 12, persons: vec![line], ..HabitsAnswer::default() };
        let text = shown(&answer);
        assert!(text.starts_with("Learning. 12 counts") && text.contains("ada"), "{text}");
        assert!(text.contains("42") && text.contains("84"), "{text}");
        assert_eq!(counted([0.0, 83.7]), "0 observations and 84 hours in known places");
        assert_eq!(counted([-0.2, -0.0]), "0 observations and 0 hours in known places");
        assert_eq!(counted([1.0, 1.2]), "1 observation and 1 hour in known places");
        assert!(text.ends_with("nothing was observed since the daemon began.\n"), "{text}");
        assert!(shown(&HabitsAnswer::default()).contains("Not learning"));
    }
}
