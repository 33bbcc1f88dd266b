//! `roomcast latency`: measures events to scores and decisions between real processes, and yardsticks for comparison.

use std::cell::Cell;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use indicatif::{ProgressBar, ProgressStyle};
use roomcast_ipc::Node;
use roomcast_ipc::raw::{DecisionV1, RoomScoresV1};
use serde_json::json;

use super::stage::Stage;
use super::{CommandResult, Failure, print_json, ranges, service};
use crate::latency::{self, LatencyError, Narrator, Path, Probe, Row, Taken};
use roomcast_core::narration::{Program, Sentence};
use roomcast_core::prepared::ANSWERS_MAX;
use roomcast_services::config::SPIN_US_MAX;
use roomcast_services::stop::Stop;

/// Loading the model is the slow part of the start.
const START_WITHIN: Duration = Duration::from_secs(120);
/// How often the progress has a line of its own without a terminal.
const SHOWN_EVERY: Duration = Duration::from_secs(10);

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Samples per path.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = ranges::some())]
    samples: u64,
    /// Milliseconds of silence before each sample, in which the processes fall asleep. From a few hundred on, at a person's pace, answers are
    /// prepared, and have a separate row.
    #[arg(long, value_name = "MS", default_value_t = 5, value_parser = ranges::any())]
    pause: u64,
    /// Which scorer: the model, none (every word is as likely), or both in turn.
    #[arg(long, value_parser = ["model", "none", "both"], default_value = "both")]
    scorer: String,
    /// With the machine idle, with one spinning thread per core, or both in turn.
    #[arg(long, value_parser = ["idle", "busy", "both"], default_value = "both")]
    load: String,
    /// Microseconds that daemon and planner stay awake after a message (`ipc.spin_us`).
    #[arg(long, value_name = "US", default_value_t = 0, value_parser = ranges::whole(0..=SPIN_US_MAX))]
    spin: u64,
    /// How many likely next sentences the daemon scores ahead (`scoring.prepare`), in place of the default.
    #[arg(long, value_name = "N", value_parser = ranges::whole(0..=ANSWERS_MAX))]
    prepare: Option<usize>,
    /// A file with the sentences to narrate, a line each, repeated; by default those of the included programs.
    #[arg(long, value_name = "FILE")]
    sentences: Option<PathBuf>,
    /// The scene file, or an included scene's name.
    #[arg(long, value_name = "FILE", default_value = "apartment-e0")]
    scene: PathBuf,
    /// A GGUF model; by default the embedded household model.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
pub struct EndArgs {
    /// Answer over this yardstick's path; by default keep every core busy.
    #[arg(long)]
    echo: Option<Path>,
    #[command(flatten)]
    service: service::Args,
}

/// A bar in a terminal. Elsewhere a line from time to time, since a measurement with long pauses takes minutes.
struct Progress {
    bar: ProgressBar,
    shown: Cell<Instant>,
}

impl Progress {
    fn new(samples: u64) -> Self {
        let bar = ProgressBar::new(samples);
        if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} samples, {eta} left") {
            bar.set_style(style);
        }
        bar.tick();
        Self { bar, shown: Cell::new(Instant::now()) }
    }

    fn measured(&self) {
        self.bar.inc(1);
        if self.bar.is_hidden() && self.shown.get().elapsed() >= SHOWN_EVERY {
            self.shown.set(Instant::now());
            let (done, all, left_s) = (self.bar.position(), self.bar.length().unwrap_or(0), self.bar.eta().as_secs());
            super::tell(format_args!("{done} of {all} samples, about {left_s} s left"));
        }
    }
}

impl From<LatencyError> for Failure {
    fn from(error: LatencyError) -> Self {
        match error {
            LatencyError::Ipc(error) => error.into(),
            _ => Self::failed(error),
        }
    }
}

pub fn run(args: &Args) -> CommandResult {
    let sentences = sentences(args.sentences.as_deref())?;
    let stop = service::stop()?;
    let wanted = |asked: &str, of: [&'static str; 2]| -> Vec<&'static str> {
        of.into_iter().filter(|one| asked == "both" || asked == *one).collect()
    };
    let (scorers, loads) = (wanted(&args.scorer, ["none", "model"]), wanted(&args.load, ["idle", "busy"]));
    let runs = (scorers.len() * loads.len()) as u64;
    let progress = Progress::new(runs * 2 * (args.samples + args.warm_up()));
    let mut rows = Vec::new();
    for scorer in scorers {
        for load in &loads {
            let measured = measure(args, (scorer, load), &sentences, &stop, &progress);
            if stop.requested() {
                return Err(Failure::interrupted("interrupted; everything is cleaned up"));
            }
            rows.extend(measured?);
        }
    }
    progress.bar.finish_and_clear();
    if args.json {
        return print_json(&json!({ "rows": rows }));
    }
    print(&rows)
}

pub fn run_end(args: &EndArgs) -> CommandResult {
    let stop = service::stop()?;
    let Some(path) = args.echo else {
        latency::spin(&stop);
        return Ok(());
    };
    let (_, domain) = args.service.load()?;
    let node = domain.open("roomcast-measured-end")?;
    Ok(latency::echo(path, &node, &stop)?)
}

impl Args {
    /// Samples that are dropped until caches and connections are warm.
    fn warm_up(&self) -> u64 {
        (self.samples / 20).clamp(10, 100)
    }
}

/// One scorer under one load: first scores, then decisions, each with the yardsticks. The second part's yardsticks are dropped.
fn measure(
    args: &Args,
    kind: (&'static str, &'static str),
    sentences: &[String],
    stop: &Stop,
    progress: &Progress,
) -> Result<Vec<Row>, Failure> {
    let mut stage = Stage::new("latency")?;
    let prepare = args.prepare.map(|prepare| format!("[scoring]\nprepare = {prepare}\n")).unwrap_or_default();
    stage.configure(&format!("[ipc]\nspin_us = {}\n{prepare}", args.spin))?;
    let node = stage.domain().open("roomcast-latency")?;
    let result = on_stage(args, kind, sentences, (&mut stage, &node), stop, progress);
    // The node must be dropped before the domain can be removed.
    drop(node);
    // If a process has ended, its own error is clearer.
    if result.is_err() && !stop.requested() {
        stage.check()?;
    }
    result
}

fn on_stage(
    args: &Args,
    (scorer, load): (&'static str, &'static str),
    sentences: &[String],
    (stage, node): (&mut Stage, &Node),
    stop: &Stop,
    progress: &Progress,
) -> Result<Vec<Row>, Failure> {
    let mut daemon = vec!["--scene".into(), args.scene.clone().into_os_string()];
    match (&args.model, scorer) {
        (_, "none") => daemon.push("--no-model".into()),
        (Some(model), _) => daemon.extend(["--model".into(), model.clone().into_os_string()]),
        (None, _) => {}
    }
    stage.start("daemon", &daemon)?;
    let mut probes = yardsticks(stage, node)?;
    let scores = node.subscriber::<RoomScoresV1>()?;
    wait_for(stage, stop, || Ok(scores.newest()?.is_some()))?;
    if load == "busy" {
        stage.start("measured-end", &[])?;
    }
    probes.push(Probe::Scores(Narrator::new(node, "latency", sentences)?, scores));
    let pause = Duration::from_millis(args.pause);
    let take = |probes: &mut Vec<Probe>| {
        latency::interleaved(probes, args.samples, args.warm_up(), pause, stop, || progress.measured())
    };
    let row = |probe: &Probe, samples_ns: &Histogram<u64>| Row::new(probe.path(), scorer, load, samples_ns);
    let Taken { histograms, prepared, computed } = take(&mut probes)?;
    let mut rows: Vec<Row> = probes.iter().zip(&histograms).rev().map(|(probe, samples)| row(probe, samples)).collect();
    if !prepared.is_empty() {
        rows.insert(1, Row::new(Path::EventToScoresPrepared, scorer, load, &prepared));
        if !computed.is_empty() {
            rows.insert(2, Row::new(Path::EventToScoresComputed, scorer, load, &computed));
        }
    }

    // The planner replaces the scores' subscriber: each path wakes only its own processes.
    let narrator = match probes.pop() {
        Some(Probe::Scores(narrator, _)) => narrator,
        _ => Narrator::new(node, "latency-decision", sentences)?,
    };
    let decisions = node.subscriber::<DecisionV1>()?;
    stage.start("planner", &["--room-time".into(), "0".into()])?;
    wait_for(stage, stop, || Ok(decisions.newest()?.is_some()))?;
    probes.push(Probe::Decision(narrator, decisions));
    let histograms = take(&mut probes)?.histograms;
    if let (Some(probe), Some(samples)) = (probes.last(), histograms.last()) {
        let behind_scores = rows.iter().take_while(|row| row.path != Path::BareIceoryx2).count();
        rows.insert(behind_scores, row(probe, samples));
    }
    Ok(rows)
}

/// The yardsticks, with a process at the other end of each.
fn yardsticks(stage: &mut Stage, node: &Node) -> Result<Vec<Probe>, Failure> {
    let echo = |path: &str| ["--echo".into(), path.into()];
    let (counters, input, output) = Probe::eventfd()?;
    stage.start_with("measured-end", &echo("eventfd"), Stdio::from(input), Stdio::from(output))?;
    let (socket, there) = Probe::unix_socket()?;
    stage.start_with("measured-end", &echo("unix-socket"), Stdio::from(there), Stdio::null())?;
    // The sender of requests must exist before its listener.
    let bare = Probe::bare_iceoryx2(node)?;
    stage.start("measured-end", &echo("bare-iceoryx2"))?;
    Ok(vec![counters, socket, bare])
}

fn wait_for(stage: &mut Stage, stop: &Stop, mut there: impl FnMut() -> Result<bool, Failure>) -> CommandResult {
    let start = Instant::now();
    while !stop.requested() && !there()? {
        stage.check()?;
        if start.elapsed() > START_WITHIN {
            let within = START_WITHIN.as_secs();
            return Err(Failure::failed(format!("the processes were not ready within {within} s")));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}

/// The actions of the included programs, or the lines of a file.
fn sentences(file: Option<&std::path::Path>) -> Result<Vec<String>, Failure> {
    let mut sentences = Vec::new();
    if let Some(file) = file {
        let fail = |error: &dyn std::fmt::Display| Failure::input(format!("{}: {error}", file.display()));
        let text = std::fs::read_to_string(file).map_err(|error| fail(&error))?;
        for line in text.lines().filter(|line| !line.trim().is_empty()) {
            sentences.push(Sentence::new(line).map_err(|error| fail(&error))?.as_str().to_owned());
        }
        if sentences.is_empty() {
            return Err(fail(&"it has no sentence: write one on each line"));
        }
        return Ok(sentences);
    }
    for shipped in roomcast_services::embedded::PROGRAMS {
        let program = Program::parse(shipped.text)?;
        sentences.extend(program.steps.iter().map(roomcast_core::narration::Action::sentence));
    }
    Ok(sentences)
}

fn print(rows: &[Row]) -> CommandResult {
    let us = |ns: u64| format!("{:.1}", ns as f64 / 1e3);
    let ratio = |row: &Row, of: fn(&Row) -> u64| {
        let same = |bare: &&Row| (bare.path, bare.scorer, bare.load) == (Path::BareIceoryx2, row.scorer, row.load);
        let bare = rows.iter().find(same);
        bare.map(|bare| format!("{:.2}", of(row) as f64 / of(bare).max(1) as f64)).unwrap_or_default()
    };
    let mut table = roomcast_cli::table_of(
        rows,
        &[
            ("path", &|row| json!(row.path).as_str().unwrap_or_default().to_owned()),
            ("scorer", &|row| row.scorer.to_owned()),
            ("load", &|row| row.load.to_owned()),
            ("n", &|row| row.n.to_string()),
            ("p50 (us)", &|row| us(row.p50_ns)),
            ("p90 (us)", &|row| us(row.p90_ns)),
            ("p99 (us)", &|row| us(row.p99_ns)),
            ("p99.9 (us)", &|row| us(row.p999_ns)),
            ("max (us)", &|row| us(row.max_ns)),
            ("p50 / bare", &|row| ratio(row, |row| row.p50_ns)),
            ("p99 / bare", &|row| ratio(row, |row| row.p99_ns)),
        ],
    );
    // In a narrow terminal this many columns would break names and figures.
    table.set_content_arrangement(comfy_table::ContentArrangement::Disabled);
    super::print(&format!(
        "{table}\nRound trips between processes, in microseconds: a narration there, scores or a decision back. The yardsticks carry the \
         same\nsizes and do nothing in between. A first part takes scores and yardsticks in turn, a second part decisions; what the daemon \
         has\nprepared by then makes decisions come sooner than the scores above.\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Args as _, FromArgMatches as _};

    fn parsed(line: &str) -> Result<Args, clap::Error> {
        let line = ["latency"].into_iter().chain(line.split_whitespace());
        Args::from_arg_matches(&Args::augment_args(clap::Command::new("latency")).try_get_matches_from(line)?)
    }

    /// The command line and the configuration have the same limits.
    #[test]
    fn the_command_line_takes_what_the_configuration_takes() {
        for (option, key, most) in
            [("--spin", "ipc]\nspin_us", SPIN_US_MAX), ("--prepare", "scoring]\nprepare", ANSWERS_MAX as u64)]
        {
            for (number, fits) in [(0, true), (most, true), (most + 1, false)] {
                let config: roomcast_services::config::Config = toml::from_str(&format!("[{key} = {number}")).unwrap();
                assert_eq!(config.check().is_ok(), fits, "{key} = {number}");
                assert_eq!(parsed(&format!("{option} {number}")).is_ok(), fits, "{option} {number}");
            }
        }
    }
}
