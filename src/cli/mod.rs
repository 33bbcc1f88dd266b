//! The command line: one file per subcommand, each with its `Args` and its `run`.

// `println!` and `eprintln!` panic where standard output or standard error cannot be written, on a full disk for instance; `print` gives an
// error, and `tell` goes on.
#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::fmt;
use std::io::Write;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

pub use roomcast_core::text::count;
use roomcast_core::text::visible_lines;
use roomcast_services::daemon::{DaemonError, JournalError};
use roomcast_services::lessons::LessonError;
use roomcast_services::setup::SetupError;

use crate::exit_code;

#[cfg(feature = "bridge")]
mod bridge;
#[cfg(feature = "mqtt")]
mod broker;
mod choice;
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
#[cfg(feature = "lab")]
mod draw;
#[cfg(feature = "lab")]
mod experiment;
#[cfg(all(feature = "lab", feature = "recordings"))]
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
mod ranges;
#[cfg(feature = "recordings")]
mod record;
#[cfg(feature = "recordings")]
mod replay;
mod report;
#[cfg(test)]
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

/// A failed command: the documented exit code and the chain of causes, printed once by [`main`].
#[derive(Debug)]
pub struct Failure {
    /// One of [`exit_code`]'s constants.
    pub code: u8,
    /// What failed, where, and the remedy.
    pub error: Box<dyn std::error::Error + Send + Sync>,
}

impl Failure {
    /// Wraps an error with the exit code it stands for.
    pub fn new(code: u8, error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self { code, error: error.into() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&roomcast_services::logging::chain(&*self.error))
    }
}

impl From<SetupError> for Failure {
    fn from(error: SetupError) -> Self {
        let code = match &error {
            SetupError::Config(_) => exit_code::CONFIG,
            SetupError::Scene(_)
            | SetupError::NoScene { .. }
            | SetupError::Program(_)
            | SetupError::NoProgram { .. }
            | SetupError::Grounding(_) => exit_code::INPUT,
            _ => exit_code::MODEL,
        };
        Self::new(code, error)
    }
}

impl From<DaemonError> for Failure {
    fn from(error: DaemonError) -> Self {
        let code = match error {
            DaemonError::Setup(error) => return error.into(),
            DaemonError::Board(_) => exit_code::INPUT,
            DaemonError::Ipc(_) | DaemonError::Journal(JournalError::Locked { .. }) => exit_code::IPC,
            DaemonError::Affinity(_) => exit_code::CONFIG,
            _ => exit_code::FAILURE,
        };
        Self::new(code, error)
    }
}

impl From<LessonError> for Failure {
    fn from(error: LessonError) -> Self {
        match error {
            LessonError::Setup(error) => error.into(),
            LessonError::Board(_) => Self::new(exit_code::INPUT, error),
            _ => Self::new(exit_code::FAILURE, error),
        }
    }
}

/// What every subcommand returns.
pub type CommandResult = Result<(), Failure>;

/// An empty table in the one style that all commands print; in a terminal it keeps to its width.
#[must_use]
pub fn table(header: &[&str]) -> comfy_table::Table {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::NOTHING).set_header(header);
    // A serial line, or a container's, may say that it has none.
    const COLUMNS_MIN: u16 = 20;
    if table.width().is_none_or(|columns| columns >= COLUMNS_MIN) {
        table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    }
    table
}

/// Prints on standard output, to the end: what is left in a buffer would be lost without an error. Much of it comes from outside, and
/// none of it reaches a terminal as anything but text.
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print(text: &str) -> CommandResult {
    print_styled(&visible_lines(text))
}

/// The same for a text with colours, of which every part that comes from outside is [`visible`](roomcast_core::text::visible).
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print_styled(text: &str) -> CommandResult {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|error| {
        let text = format!("failed to write to standard output: {error}; check where it leads");
        Failure::new(exit_code::FAILURE, text)
    })
}

/// Writes a line on standard error. Where that cannot be written, on a full disk for instance, nobody is left to tell.
pub fn tell(line: impl fmt::Display) {
    let _untold = writeln!(std::io::stderr(), "{}", visible_lines(&line.to_string()));
}

/// Prints a value as indented JSON on standard output.
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print_json(value: &impl serde::Serialize) -> CommandResult {
    let text = serde_json::to_string_pretty(value).map_err(|e| Failure::new(exit_code::FAILURE, e))?;
    print(&format!("{text}\n"))
}

/// Prints a value as one line of JSON.
pub fn print_json_line(value: &impl serde::Serialize) -> CommandResult {
    let text = serde_json::to_string(value).map_err(|error| Failure::new(exit_code::FAILURE, error))?;
    print(&format!("{text}\n"))
}

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
    /// Publish what Roomcast knows over MQTT, for Home Assistant and others.
    #[cfg(feature = "bridge")]
    Bridge(bridge::Args),
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
    /// Say whether this machine can run Roomcast, and how well; with --config, what is wrong with a home's set-up.
    Doctor(doctor::Args),
    /// Reproduce the paper's tables and figures, and ours.
    #[cfg(feature = "lab")]
    Experiment(experiment::Args),
    /// Explain the scores of one moment: rooms, labels, tokens, items and the narration behind them.
    #[cfg(all(feature = "lab", feature = "recordings"))]
    Explain(explain::Args),
    /// Say what a running daemon has learned of the home, let it learn from before, forget it, or take it elsewhere.
    Habits(habits::Args),
    /// Set up a home: its map, rules and configuration from Home Assistant and a robot vacuum; asks for what is not given.
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
    /// Say who a running daemon knows, forget somebody, or give somebody a name.
    Person(person::Args),
    /// Decide where the robot goes: the service that applies a policy to the scores.
    Planner(planner::Args),
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

impl Command {
    /// Whether a reader that leaves may end the command at once: it holds no place in a domain, and no processes.
    fn only_prints(&self) -> bool {
        match self {
            Self::Config(_) | Self::Doctor(_) | Self::Model(_) | Self::Scene(_) | Self::Score(_) => true,
            #[cfg(feature = "manuals")]
            Self::Completions(_) | Self::Man(_) => true,
            #[cfg(feature = "lab")]
            Self::Experiment(_) => true,
            #[cfg(all(feature = "lab", feature = "recordings"))]
            Self::Explain(_) => true,
            _ => false,
        }
    }
}

/// The commands. A number after an option is its value where it is negative, too, so that the error says what is allowed.
fn commands() -> clap::Command {
    fn take_negative_numbers(command: clap::Command) -> clap::Command {
        let values = |arg: clap::Arg| {
            let option = arg.get_action().takes_values() && !arg.is_positional();
            if option { arg.allow_negative_numbers(true) } else { arg }
        };
        command.mut_args(values).mut_subcommands(take_negative_numbers)
    }
    take_negative_numbers(Cli::command())
}

/// Parses the command line, runs it and gives the exit code; prints an error once, on standard error.
#[must_use]
pub fn main() -> ExitCode {
    let command = match Cli::from_arg_matches(&commands().get_matches()) {
        Ok(cli) => cli.command,
        Err(error) => error.format(&mut commands()).exit(),
    };
    roomcast_ipc::end_where_iceoryx2_panics("roomcast", exit_code::IPC);
    if command.only_prints() {
        // Output into a pipe that closes (`| head -1`) ends the command as it ends any other.
        sigpipe::reset();
    }
    let result = match command {
        #[cfg(feature = "bridge")]
        Command::Bridge(args) => bridge::run(&args),
        #[cfg(feature = "manuals")]
        Command::Completions(args) => completions::run(&args),
        Command::Config(args) => config::run(&args),
        Command::Daemon(args) => daemon::run(&args),
        #[cfg(feature = "demo")]
        Command::Demo(args) => demo::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        #[cfg(feature = "lab")]
        Command::Experiment(args) => experiment::run(&args),
        #[cfg(all(feature = "lab", feature = "recordings"))]
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
    match result {
        Ok(()) => ExitCode::from(exit_code::OK),
        Err(failure) => {
            // The exit code says it too.
            tell(format_args!("roomcast: {failure}"));
            ExitCode::from(failure.code)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// clap finds a default of another type than its option only when it reads the option.
    #[cfg(feature = "lab")]
    #[test]
    fn defaults_of_each_experiment_have_the_types_of_their_options() {
        use clap::CommandFactory;

        let command = Cli::command();
        let experiments = command.find_subcommand("experiment").unwrap().get_subcommands();
        for name in experiments.map(|one| one.get_name().to_owned()) {
            // A missing argument is an error; a wrong type is a panic.
            let _read = Cli::try_parse_from(["roomcast", "experiment", &name]);
        }
    }

    #[test]
    fn another_daemon_has_its_own_code_also_where_only_its_journal_shows_it() {
        let code = |error: JournalError| Failure::from(DaemonError::Journal(error)).code;
        assert_eq!(code(JournalError::Locked { path: "journal".into() }), exit_code::IPC);
    }

    /// A scene or a model that cannot be used ends every command with the same code.
    #[test]
    fn one_fault_has_one_code_in_every_command() {
        let setup = |scene: &str, model: &str| {
            let text = format!("[scene]\npath = {scene:?}\n[model]\npath = {model:?}\n");
            let config: roomcast_services::config::Config = toml::from_str(&text).unwrap();
            roomcast_services::setup::open(&config).err().unwrap()
        };
        for (scene, model, code) in
            [("/nowhere.json", "", exit_code::INPUT), ("studio", "/nowhere.gguf", exit_code::MODEL)]
        {
            let codes = [
                Failure::from(setup(scene, model)).code,
                Failure::from(DaemonError::from(setup(scene, model))).code,
                Failure::from(LessonError::from(setup(scene, model))).code,
            ];
            assert_eq!(codes, [code; 3], "{scene} {model}");
        }
    }
}
