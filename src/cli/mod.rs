//! The command line: one file per subcommand, each with its `Args` and its `run`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use roomcast_cli::{
    CommandResult, Failure, choice, count, ended, print, print_json, print_json_line, print_styled, ranges,
};
use roomcast_cli::{table, take_negative_numbers, tell};

use crate::exit_code;

#[cfg(feature = "mqtt")]
mod broker;
#[cfg(feature = "manuals")]
mod completions;
mod config;
mod daemon;
#[cfg(feature = "demo")]
mod demo;
#[cfg(feature = "demo")]
mod demo_robot;
#[cfg(feature = "demo")]
mod demo_week;
mod doctor;
#[cfg(feature = "simulation")]
mod draw;
#[cfg(all(feature = "simulation", feature = "recordings"))]
mod explain;
mod habits;
mod home_source;
#[cfg(feature = "home")]
mod init;
#[cfg(feature = "latency")]
mod latency;
#[cfg(feature = "manuals")]
mod man;
#[cfg(feature = "metrics")]
mod metrics;
mod model;
mod narrate;
#[cfg(feature = "mqtt")]
mod narrate_mqtt;
mod person;
mod planner;
#[cfg(feature = "publish")]
mod publish;
#[cfg(feature = "recordings")]
mod record;
#[cfg(feature = "recordings")]
mod replay;
mod report;
#[cfg(test)]
#[path = "../../tests/support/requirements.rs"]
mod requirements;
#[cfg(feature = "robot")]
mod robot;
mod scene;
mod scene_files;
mod score;
mod service;
mod stage;
#[cfg(feature = "top")]
mod top;
#[cfg(feature = "view")]
mod view;

const CODES_AND_LOGS: &str = "\
Exit codes: 0 all went well; 1 anything else failed; 2 usage; 3 input (scene, program, narration, recording); 4 configuration; 5 model; \
6 shared memory, a service or another daemon; 7 a check found faults; 130 interrupted before the work was done. A service that a signal \
asks to stop ends with 0.

Services log to the journal under systemd, else to standard error. ROOMCAST_LOG says what is told: warn, info (the default), or \
info,roomcast=debug for a line per step.";

/// Predicts which rooms people will be in next, so that a robot works somewhere else.
#[derive(Debug, Parser)]
#[command(name = "roomcast", version, propagate_version = true, after_help = CODES_AND_LOGS)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// The old name of `publish`.
    #[cfg(feature = "publish")]
    #[command(hide = true)]
    Bridge(publish::Args),
    /// Print a completion script for a shell.
    #[cfg(feature = "manuals")]
    Completions(completions::Args),
    /// Print the commented default configuration, or check one.
    Config(config::Args),
    /// Score the rooms: the service between narrators and planners.
    Daemon(daemon::Args),
    /// Show the whole system at work on this machine.
    #[cfg(feature = "demo")]
    Demo(demo::Args),
    /// Say whether this machine can run Roomcast, and how well; with --config, check a home's set-up.
    Doctor(doctor::Args),
    /// Now a command of the program `roomcast-lab`.
    #[command(hide = true, disable_help_flag = true)]
    Experiment(Moved),
    /// Explain the scores of one moment: rooms, labels, tokens, items and the narration behind them.
    #[cfg(all(feature = "simulation", feature = "recordings"))]
    Explain(explain::Args),
    /// Show the habits that a running daemon has learned, let it learn from earlier narration, forget them, export and import them.
    Habits(habits::Args),
    /// Set up a home: its map, rules and configuration from Home Assistant and a robot vacuum; asks for missing values.
    #[cfg(feature = "home")]
    Init(init::Args),
    /// Measure how long events take to become scores and decisions, between real processes.
    #[cfg(feature = "latency")]
    Latency(latency::Args),
    /// The other end of a measurement of `latency`, which starts it.
    #[command(hide = true)]
    #[cfg(feature = "latency")]
    LatencyEnd(latency::EndArgs),
    /// Write the manual pages of all commands.
    #[cfg(feature = "manuals")]
    Man(man::Args),
    /// Serve metrics of a running system for Prometheus, on a loopback address.
    #[cfg(feature = "metrics")]
    Metrics(metrics::Args),
    /// Inspect, check and fetch language models.
    Model(model::Args),
    /// Publish what a person does: activity programs, JSON lines, plain sentences, sensor logs, or what devices say over MQTT.
    Narrate(narrate::Args),
    /// List the persons that a running daemon knows, correct the belief about a person, rename or forget a person.
    Person(person::Args),
    /// Decide where the robot goes: the service that applies a policy to the scores.
    Planner(planner::Args),
    /// Publish what Roomcast knows over MQTT, for Home Assistant and others.
    #[cfg(feature = "publish")]
    Publish(publish::Args),
    /// Record everything on the services into an MCAP file.
    #[cfg(feature = "recordings")]
    Record(record::Args),
    /// Replay a recording, bit for bit, at any speed.
    #[cfg(feature = "recordings")]
    Replay(replay::Args),
    /// Tell a robot's planner what the robot does: started, finished, failed, blocked, cancelled, docked, position, battery.
    Report(report::Args),
    /// Drive a robot vacuum by the planner's decisions: Valetudo, or what Home Assistant has. Only says what it would do, until --obey.
    #[cfg(feature = "robot")]
    Robot(robot::Args),
    /// Import, check, change, show and draw semantic maps.
    Scene(scene::Args),
    /// Score every label, item and partition of a scene once.
    Score(score::Args),
    /// Watch a running system: rooms over time, narration, likely objects, decisions, health.
    #[cfg(feature = "top")]
    Top(top::Args),
    /// Show the plan in a browser: where persons are and will be, and what the robot does, now or in a recording.
    #[cfg(feature = "view")]
    View(view::Args),
}

/// The arguments of a command that another program has now.
#[derive(Debug, clap::Args)]
struct Moved {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl From<Moved> for Failure {
    fn from(Moved { words }: Moved) -> Self {
        let command: Vec<_> = std::iter::once("roomcast-lab".to_owned()).chain(words).collect();
        Self::new(
            exit_code::USAGE,
            format!("the experiments are in the program roomcast-lab now: {}", command.join(" ")),
        )
    }
}

impl Command {
    /// Whether a reader that leaves may end the command at once: it is in no domain and has no child processes.
    fn only_prints(&self) -> bool {
        match self {
            Self::Config(_) | Self::Doctor(_) | Self::Model(_) | Self::Scene(_) | Self::Score(_) => true,
            #[cfg(feature = "manuals")]
            Self::Completions(_) | Self::Man(_) => true,
            #[cfg(all(feature = "simulation", feature = "recordings"))]
            Self::Explain(_) => true,
            _ => false,
        }
    }
}

fn commands() -> clap::Command {
    take_negative_numbers(Cli::command())
}

/// Parses the command line, runs it and returns the exit code. Prints an error once, on standard error.
#[must_use]
pub fn main() -> ExitCode {
    let command = match Cli::from_arg_matches(&commands().get_matches()) {
        Ok(cli) => cli.command,
        Err(error) => error.format(&mut commands()).exit(),
    };
    roomcast_ipc::end_where_iceoryx2_panics("roomcast", exit_code::IPC);
    if command.only_prints() {
        // When a pipe closes (`| head -1`), the command ends as usual programs do.
        sigpipe::reset();
    }
    let result = match command {
        #[cfg(feature = "publish")]
        Command::Bridge(args) => {
            tell(
                "roomcast: `roomcast bridge` is called `roomcast publish` now; the next version has no other name for it",
            );
            publish::run(&args)
        }
        #[cfg(feature = "manuals")]
        Command::Completions(args) => completions::run(&args),
        Command::Config(args) => config::run(&args),
        Command::Daemon(args) => daemon::run(&args),
        #[cfg(feature = "demo")]
        Command::Demo(args) => demo::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Experiment(args) => Err(args.into()),
        #[cfg(all(feature = "simulation", feature = "recordings"))]
        Command::Explain(args) => explain::run(&args),
        #[cfg(feature = "home")]
        Command::Init(args) => init::run(&args),
        #[cfg(feature = "latency")]
        Command::Latency(args) => latency::run(&args),
        #[cfg(feature = "latency")]
        Command::LatencyEnd(args) => latency::run_end(&args),
        #[cfg(feature = "manuals")]
        Command::Man(args) => man::run(&args),
        #[cfg(feature = "metrics")]
        Command::Metrics(args) => metrics::run(&args),
        Command::Habits(args) => habits::run(&args),
        Command::Model(args) => model::run(&args),
        Command::Narrate(args) => narrate::run(&args),
        Command::Person(args) => person::run(&args),
        Command::Planner(args) => planner::run(&args),
        #[cfg(feature = "publish")]
        Command::Publish(args) => publish::run(&args),
        #[cfg(feature = "recordings")]
        Command::Record(args) => record::run(&args),
        #[cfg(feature = "recordings")]
        Command::Replay(args) => replay::run(&args),
        Command::Report(args) => report::run(&args),
        #[cfg(feature = "robot")]
        Command::Robot(args) => robot::run(&args),
        Command::Scene(args) => scene::run(&args),
        Command::Score(args) => score::run(&args),
        #[cfg(feature = "top")]
        Command::Top(args) => top::run(&args),
        #[cfg(feature = "view")]
        Command::View(args) => view::run(&args),
    };
    ended("roomcast", result)
}
