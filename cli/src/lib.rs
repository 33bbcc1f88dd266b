//! Shared parts of the command lines `roomcast` and `roomcast-lab`: exit codes, errors, output, checked arguments, and models that another process
//! tries first.

// `println!` and `eprintln!` panic if the output cannot be written, for instance on a full disk. `print` returns an error, and `tell` goes on.
#![warn(clippy::print_stdout, clippy::print_stderr)]

use std::fmt;
use std::io::Write;

use roomcast_core::grounding::GroundingError;
use roomcast_core::narration::TextError;
pub use roomcast_core::text::count;
use roomcast_core::text::visible_lines;
use roomcast_ipc::IpcError;
use roomcast_services::config::ConfigError;
use roomcast_services::daemon::{DaemonError, JournalError};
use roomcast_services::lessons::LessonError;
use roomcast_services::sensor_log::SensorLog;
use roomcast_services::setup::SetupError;
#[cfg(feature = "simulation")]
use roomcast_simulation::{ScoresError, StudyError};

pub mod choice;
#[cfg(feature = "simulation")]
pub mod days;
pub mod exit_code;
pub mod model;
pub mod ranges;

/// A failed command: the documented exit code and the chain of causes, printed once by `main`.
#[derive(Debug)]
pub struct Failure {
    /// One of [`exit_code`]'s constants.
    pub code: u8,
    /// What failed, where, and the remedy.
    pub error: AnyError,
}

type AnyError = Box<dyn std::error::Error + Send + Sync>;

impl Failure {
    /// Wraps an error with its exit code.
    pub fn new(code: u8, error: impl Into<AnyError>) -> Self {
        Self { code, error: error.into() }
    }
}

macro_rules! constructors {
    ($($name:ident $code:ident),*) => {
        impl Failure {
            $(
                #[doc = concat!("A failure with [`exit_code::", stringify!($code), "`].")]
                pub fn $name(error: impl Into<AnyError>) -> Self {
                    Self::new(exit_code::$code, error)
                }
            )*
        }
    };
}

constructors!(usage USAGE, input INPUT, config CONFIG, model MODEL, ipc IPC, check CHECK, failed FAILURE, interrupted INTERRUPTED);

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
            DaemonError::Engine(_) => exit_code::INPUT,
            DaemonError::Ipc(_) | DaemonError::Journal(JournalError::Locked { .. }) => exit_code::IPC,
            DaemonError::Affinity(_) => exit_code::CONFIG,
            _ => exit_code::FAILURE,
        };
        Self::new(code, error)
    }
}

macro_rules! convert {
    ($($error:ty => $constructor:ident),*) => {
        $(impl From<$error> for Failure {
            fn from(error: $error) -> Self {
                Self::$constructor(error)
            }
        })*
    };
}

convert!(ConfigError => config, GroundingError => input, TextError => input, IpcError => ipc);

impl From<LessonError> for Failure {
    fn from(error: LessonError) -> Self {
        match error {
            LessonError::Setup(error) => error.into(),
            LessonError::Engine(_) => Self::new(exit_code::INPUT, error),
            _ => Self::new(exit_code::FAILURE, error),
        }
    }
}

#[cfg(feature = "simulation")]
impl From<ScoresError> for Failure {
    fn from(error: ScoresError) -> Self {
        StudyError::from(error).into()
    }
}

#[cfg(feature = "simulation")]
impl From<StudyError> for Failure {
    fn from(error: StudyError) -> Self {
        let code = match &error {
            StudyError::Scores(ScoresError::Score(_)) | StudyError::Model(_) => exit_code::MODEL,
            StudyError::Scores(ScoresError::Cache { .. }) | StudyError::BelowBound { .. } => exit_code::FAILURE,
            #[cfg(feature = "optimum")]
            StudyError::Solver(_) | StudyError::SolversDisagree { .. } => exit_code::FAILURE,
            _ => exit_code::INPUT,
        };
        Self::new(code, error)
    }
}

/// The result of a subcommand.
pub type CommandResult = Result<(), Failure>;

/// Lists commands, each with its arguments and its function, as an enumeration with a function that runs them. A command may need a feature.
#[macro_export]
macro_rules! commands {
    ($command:ident; $($(#[$about:meta])* $([$feature:tt])? $name:ident($args:ty) $run:path;)*) => {
        #[derive(Debug, clap::Subcommand)]
        enum $command {
            $($(#[$about])* $(#[cfg(feature = $feature)])? $name($args),)*
        }

        impl $command {
            fn run(&self) -> $crate::CommandResult {
                match self {
                    $($(#[cfg(feature = $feature)])? Self::$name(args) => $run(args),)*
                }
            }
        }
    };
}

/// An empty table in the style of all commands. In a terminal it keeps to the terminal's width.
#[must_use]
pub fn table(header: &[&str]) -> comfy_table::Table {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::NOTHING).set_header(header);
    // A serial line or a container may report a width of 0.
    const COLUMNS_MIN: u16 = 20;
    if table.width().is_none_or(|columns| columns >= COLUMNS_MIN) {
        table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    }
    table
}

/// The head of a column, and its cell in a row.
pub type Column<'c, R> = (&'c str, &'c dyn Fn(&R) -> String);

/// A table with a line for each row.
pub fn table_of<'r, R: 'r>(rows: impl IntoIterator<Item = &'r R>, columns: &[Column<'_, R>]) -> comfy_table::Table {
    let mut table = table(&columns.iter().map(|(head, _)| *head).collect::<Vec<_>>());
    table.add_rows(rows.into_iter().map(|row| columns.iter().map(|(_, cell)| cell(row)).collect::<Vec<_>>()));
    table
}

/// Prints on standard output and flushes it, because an unflushed buffer is lost without an error. Control characters are made visible: much of the
/// text is untrusted.
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print(text: &str) -> CommandResult {
    print_styled(&visible_lines(text))
}

/// As [`print()`], for a text with colours. The caller has made every untrusted part [`visible`](roomcast_core::text::visible).
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print_styled(text: &str) -> CommandResult {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|error| {
        let text = format!("failed to write to standard output: {error}; check where it leads");
        Failure::failed(text)
    })
}

/// Writes a line on standard error. On a full disk the line is lost.
pub fn tell(line: impl fmt::Display) {
    let _untold = writeln!(std::io::stderr(), "{}", visible_lines(&line.to_string()));
}

/// Prints a value as indented JSON on standard output.
///
/// # Errors
/// When it cannot be written, for instance into a closed pipe.
pub fn print_json(value: &impl serde::Serialize) -> CommandResult {
    let text = serde_json::to_string_pretty(value).map_err(Failure::failed)?;
    print(&format!("{text}\n"))
}

/// Prints a value as one line of JSON.
pub fn print_json_line(value: &impl serde::Serialize) -> CommandResult {
    let text = serde_json::to_string(value).map_err(Failure::failed)?;
    print(&format!("{text}\n"))
}

/// Reports how many intervals of a log no rule fits.
pub fn tell_unfit(log: &SensorLog) {
    if log.unfit > 0 {
        let intervals = count(usize::try_from(log.unfit).unwrap_or(usize::MAX), "interval");
        tell(format_args!("roomcast: no rule fits {intervals}"));
    }
}

/// Names the first ten files that were skipped.
pub fn report_faults(faults: &[String]) {
    report_first_faults(faults, faults.len() as u64);
}

/// As [`report_faults`], with `count` faults in all.
pub fn report_first_faults(first: &[String], count: u64) {
    const TOLD: u64 = 10;
    first.iter().take(TOLD as usize).for_each(|fault| tell(format_args!("roomcast: skipped: {fault}")));
    if count > TOLD {
        tell(format_args!("roomcast: skipped {} more", count - TOLD));
    }
}

/// Lets every option of a command take a negative number, so that the error names the allowed range.
#[must_use]
pub fn take_negative_numbers(command: clap::Command) -> clap::Command {
    let values = |arg: clap::Arg| {
        let option = arg.get_action().takes_values() && !arg.is_positional();
        if option { arg.allow_negative_numbers(true) } else { arg }
    };
    command.mut_args(values).mut_subcommands(take_negative_numbers)
}

/// The exit code of a command; prints its error once, on standard error.
#[must_use]
pub fn ended(program: &str, result: CommandResult) -> std::process::ExitCode {
    match result {
        Ok(()) => exit_code::OK.into(),
        Err(failure) => {
            tell(format_args!("{program}: {failure}"));
            failure.code.into()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_daemon_has_its_own_code_also_where_only_its_journal_shows_it() {
        let code = |error: JournalError| Failure::from(DaemonError::Journal(error)).code;
        assert_eq!(code(JournalError::Locked("journal".into())), exit_code::IPC);
    }

    /// An unusable scene or model ends every command with the same code.
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
