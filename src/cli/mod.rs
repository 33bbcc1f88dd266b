//! The command line: one file per subcommand, each with its `Args` and its `run`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser};

use roomcast_cli::{
    CommandResult, Failure, choice, commands, count, ended, print, print_json, print_json_line, print_styled, ranges,
};
use roomcast_cli::{table, tell};

use crate::exit_code;
use roomcast_services::logging;

#[cfg(feature = "whole")]
mod broker;
#[cfg(feature = "whole")]
mod completions;
mod config;
mod daemon;
#[cfg(feature = "whole")]
mod demo;
#[cfg(feature = "whole")]
mod demo_robot;
#[cfg(feature = "whole")]
mod demo_story;
#[cfg(feature = "whole")]
mod demo_week;
mod doctor;
#[cfg(feature = "whole")]
mod draw;
#[cfg(feature = "whole")]
mod explain;
#[cfg(feature = "whole")]
mod flow;
mod habits;
mod help;
mod home_source;
#[cfg(feature = "whole")]
mod init;
#[cfg(feature = "whole")]
mod latency;
#[cfg(feature = "whole")]
mod man;
#[cfg(feature = "whole")]
mod metrics;
mod model;
mod narrate;
#[cfg(feature = "whole")]
mod narrate_mqtt;
mod person;
mod planner;
#[cfg(feature = "whole")]
mod publish;
#[cfg(feature = "whole")]
mod record;
#[cfg(feature = "whole")]
mod replay;
mod report;
#[cfg(test)]
#[path = "../../tests/support/requirements.rs"]
mod requirements;
#[cfg(feature = "whole")]
mod robot;
mod scene;
mod scene_files;
mod scene_import;
mod score;
mod service;
mod stage;
#[cfg(feature = "whole")]
mod top;
#[cfg(feature = "whole")]
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

commands! {
    Command;
    /// The old name of `publish`.
    #[command(hide = true)]
    ["whole"] Bridge(publish::Args) bridge;
    /// Print a completion script for a shell.
    ["whole"] Completions(completions::Args) completions::run;
    /// Print every key with its default, or check a file.
    Config(config::Args) config::run;
    /// Forecast where people will be (a service).
    ///
    /// It takes events from narrators, keeps what it knows about persons and habits, and sends scores and forecasts.
    Daemon(daemon::Args) daemon::run;
    /// Play a morning with a person and a robot.
    ///
    /// All parts run on this machine, apart from a running system.
    ["whole"] Demo(demo::Args) demo::run;
    /// Check this machine, and a home with --config.
    ///
    /// Each fault has a remedy. With --config: map, rules, broker, robot and services.
    Doctor(doctor::Args) doctor::run;
    /// Now a command of the program `roomcast-lab`.
    #[command(hide = true, disable_help_flag = true)]
    Experiment(Moved) moved;
    /// Show why the scores are as they are.
    ///
    /// Rooms, labels, tokens and items of one moment, with the narration behind them.
    ["whole"] Explain(explain::Args) explain::run;
    /// Show, teach, forget, export or import habits.
    ///
    /// Habits are what a running daemon has learned about this home.
    Habits(habits::Args) habits::run;
    /// Make a home's map, rules and configuration.
    ///
    /// It reads Home Assistant and a robot vacuum, and asks for missing values.
    ["whole"] Init(init::Args) init::run;
    /// Measure the time from an event to a decision.
    ///
    /// The parts run as processes, as in a home.
    ["whole"] Latency(latency::Args) latency::run;
    /// The other end of a measurement of `latency`, which starts it. Suggestions for a misspelt `latency` would name it if it began so.
    #[command(hide = true)]
    ["whole"] MeasuredEnd(latency::EndArgs) latency::run_end;
    /// Write the manual pages.
    ["whole"] Man(man::Args) man::run;
    /// Serve metrics for Prometheus (a service).
    ///
    /// Only on a loopback address.
    ["whole"] Metrics(metrics::Args) metrics::run;
    /// Inspect, check or download a language model.
    Model(model::Args) model::run;
    /// Report events of people and sensors.
    ///
    /// Activity programs, JSON lines, plain sentences, sensor logs, or messages of devices over MQTT.
    Narrate(narrate::Args) narrate::run;
    /// List, correct, rename or forget persons.
    Person(person::Args) person::run;
    /// Decide where the robot goes (a service).
    ///
    /// It applies a policy and the rules of the home to the forecast.
    Planner(planner::Args) planner::run;
    /// Publish rooms, persons and decisions over MQTT.
    ///
    /// For Home Assistant and others.
    ["whole"] Publish(publish::Args) publish::run;
    /// Record all messages into an MCAP file.
    ["whole"] Record(record::Args) record::run;
    /// Play a recording again, at any speed.
    ["whole"] Replay(replay::Args) replay::run;
    /// Send a robot's report or a person's order.
    ///
    /// Started, finished, failed, blocked, cancelled, docked, position, battery; hold, resume, clean, skip.
    Report(report::Args) report::run;
    /// Drive a robot vacuum; a dry run until --obey.
    ///
    /// A vacuum with Valetudo, or one that Home Assistant has.
    ["whole"] Robot(robot::Args) robot::run;
    /// Import, check, change, show or draw a map.
    Scene(scene::Args) scene::run;
    /// Score rooms and things after some sentences.
    Score(score::Args) score::run;
    /// Watch the running system in a terminal.
    ///
    /// Rooms over time, narration, likely objects, decisions, health.
    ["whole"] Top(top::Args) top::run;
    /// Watch it in a browser, live or recorded.
    ///
    /// The plan, where persons are and will be, and what the robot does.
    ["whole"] View(view::Args) view::run;
}

/// The arguments of a command that another program has now.
#[derive(Debug, clap::Args)]
struct Moved {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

fn moved(Moved { words }: &Moved) -> CommandResult {
    let command: Vec<_> = std::iter::once("roomcast-lab").chain(words.iter().map(String::as_str)).collect();
    Err(Failure::usage(format!("the experiments are in the program roomcast-lab now: {}", command.join(" "))))
}

#[cfg(feature = "whole")]
fn bridge(args: &publish::Args) -> CommandResult {
    tell("roomcast: `roomcast bridge` is called `roomcast publish` now; the next version has no other name for it");
    publish::run(args)
}

impl Command {
    /// Whether a reader that leaves may end the command at once: it is in no domain and has no child processes.
    fn only_prints(&self) -> bool {
        match self {
            Self::Config(_) | Self::Doctor(_) | Self::Model(_) | Self::Scene(_) | Self::Score(_) => true,
            #[cfg(feature = "whole")]
            Self::Completions(_) | Self::Explain(_) | Self::Man(_) => true,
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
    ended("roomcast", command.run())
}
