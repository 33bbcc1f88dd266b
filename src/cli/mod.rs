//! The command line: one file per subcommand, each with its `Args` and its `run`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use roomcast_cli::{
    CommandResult, Failure, choice, count, ended, print, print_json, print_json_line, print_styled, ranges,
};
use roomcast_cli::{table, tell};

use crate::exit_code;
use roomcast_services::logging;

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
mod demo_story;
#[cfg(feature = "demo")]
mod demo_week;
mod doctor;
#[cfg(feature = "simulation")]
mod draw;
#[cfg(all(feature = "simulation", feature = "recordings"))]
mod explain;
mod habits;
mod help;
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
mod scene_import;
mod score;
mod service;
mod stage;
#[cfg(feature = "top")]
mod top;
#[cfg(feature = "view")]
mod view;

const CODES_AND_LOGS: &str = "\
Exit codes:
  0    success, also of a service that a signal stops
  1    any other failure
  2    wrong usage
  3    bad input: map, program, narration, recording
  4    bad configuration
  5    the model cannot be loaded or used
  6    shared memory, a service or another daemon
  7    a check found faults
  130  interrupted before the work was done

Services log to the journal under systemd, otherwise to standard error. ROOMCAST_LOG sets the level: \
warn, info (default), or info,roomcast=debug, as --verbose does.";

/// Forecasts which rooms people will be in, so that a robot works in others.
#[derive(Debug, Parser)]
#[command(name = "roomcast", version, propagate_version = true, after_long_help = CODES_AND_LOGS)]
pub struct Cli {
    /// Log each step.
    #[arg(short, long, global = true, display_order = 900)]
    verbose: bool,
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
    /// Print every key with its default, or check a file.
    Config(config::Args),
    /// Forecast where people will be (a service).
    ///
    /// It takes events from narrators, keeps what it knows about persons and habits, and sends scores and forecasts.
    Daemon(daemon::Args),
    /// Play a morning with a person and a robot.
    ///
    /// All parts run on this machine, apart from a running system.
    #[cfg(feature = "demo")]
    Demo(demo::Args),
    /// Check this machine, and a home with --config.
    ///
    /// Each fault has a remedy. With --config: map, rules, broker, robot and services.
    Doctor(doctor::Args),
    /// Now a command of the program `roomcast-lab`.
    #[command(hide = true, disable_help_flag = true)]
    Experiment(Moved),
    /// Show why the scores are as they are.
    ///
    /// Rooms, labels, tokens and items of one moment, with the narration behind them.
    #[cfg(all(feature = "simulation", feature = "recordings"))]
    Explain(explain::Args),
    /// Show, teach, forget, export or import habits.
    ///
    /// Habits are what a running daemon has learned about this home.
    Habits(habits::Args),
    /// Make a home's map, rules and configuration.
    ///
    /// It reads Home Assistant and a robot vacuum, and asks for missing values.
    #[cfg(feature = "home")]
    Init(init::Args),
    /// Measure the time from an event to a decision.
    ///
    /// The parts run as processes, as in a home.
    #[cfg(feature = "latency")]
    Latency(latency::Args),
    /// The other end of a measurement of `latency`, which starts it. Suggestions for a misspelt `latency` would name it if it began so.
    #[command(hide = true)]
    #[cfg(feature = "latency")]
    MeasuredEnd(latency::EndArgs),
    /// Write the manual pages.
    #[cfg(feature = "manuals")]
    Man(man::Args),
    /// Serve metrics for Prometheus (a service).
    ///
    /// Only on a loopback address.
    #[cfg(feature = "metrics")]
    Metrics(metrics::Args),
    /// Inspect, check or download a language model.
    Model(model::Args),
    /// Report events of people and sensors.
    ///
    /// Activity programs, JSON lines, plain sentences, sensor logs, or messages of devices over MQTT.
    Narrate(narrate::Args),
    /// List, correct, rename or forget persons.
    Person(person::Args),
    /// Decide where the robot goes (a service).
    ///
    /// It applies a policy and the rules of the home to the forecast.
    Planner(planner::Args),
    /// Publish rooms, persons and decisions over MQTT.
    ///
    /// For Home Assistant and others.
    #[cfg(feature = "publish")]
    Publish(publish::Args),
    /// Record all messages into an MCAP file.
    #[cfg(feature = "recordings")]
    Record(record::Args),
    /// Play a recording again, at any speed.
    #[cfg(feature = "recordings")]
    Replay(replay::Args),
    /// Send a robot's report or a person's order.
    ///
    /// Started, finished, failed, blocked, cancelled, docked, position, battery; hold, resume, clean, skip.
    Report(report::Args),
    /// Drive a robot vacuum; a dry run until --obey.
    ///
    /// A vacuum with Valetudo, or one that Home Assistant has.
    #[cfg(feature = "robot")]
    Robot(robot::Args),
    /// Import, check, change, show or draw a map.
    Scene(scene::Args),
    /// Score rooms and things after some sentences.
    Score(score::Args),
    /// Watch the running system in a terminal.
    ///
    /// Rooms over time, narration, likely objects, decisions, health.
    #[cfg(feature = "top")]
    Top(top::Args),
    /// Watch it in a browser, live or recorded.
    ///
    /// The plan, where persons are and will be, and what the robot does.
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
    help::arranged(Cli::command())
}

/// Parses the command line, runs it and returns the exit code. Prints an error once, on standard error.
pub fn main() -> ExitCode {
    let _log;
    let command = match Cli::from_arg_matches(&commands().get_matches()) {
        Ok(cli) => {
            if cli.verbose {
                logging::verbose();
            }
            _log = (cli.verbose && cli.command.only_prints()).then(logging::init);
            cli.command
        }
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
        Command::MeasuredEnd(args) => latency::run_end(&args),
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
