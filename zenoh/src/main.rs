//! The command line of `roomcast-zenoh`.

use std::error::Error;
use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};
use clap_complete::Shell;
use roomcast_zenoh::config::{self, Config};
use roomcast_zenoh::stop::Stop;
use roomcast_zenoh::{hub, robot, watch};
use tracing_subscriber::EnvFilter;

/// Exit code for a fault in the configuration.
const CONFIG: u8 = 2;
/// Exit code for any other fault.
const FAILURE: u8 = 1;
/// After a second request to stop.
const SECOND_SIGNAL: u8 = 130;
/// zenoh logs every attempt to connect; the link logs a failure once.
const LOG: &str = "info,zenoh=off";

/// Roomcast beyond one machine, over zenoh: narration from hubs in, scores and decisions out (docs/fleet.md).
#[derive(Debug, Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// On a robot: receives narration from hubs and publishes what its daemon and planner say.
    Robot {
        #[command(flatten)]
        file: File,
        /// The domain's root path, in place of the configuration's.
        #[arg(long, value_name = "DIR", env = "ROOMCAST_ROOT")]
        root: Option<PathBuf>,
        /// The domain's name, in place of the configuration's.
        #[arg(long, value_name = "NAME", env = "ROOMCAST_DOMAIN")]
        domain: Option<String>,
    },
    /// On another machine: keeps lines of narration until every robot has confirmed them.
    Hub {
        #[command(flatten)]
        file: File,
        /// Lines: `-` for standard input, a FIFO, or a file that grows and is followed.
        #[arg(long, default_value = "-")]
        input: PathBuf,
    },
    /// Prints what the robots of the site say, a line of JSON for each message.
    Watch(File),
    /// Prints the configuration, every key with its default.
    Config,
    /// Prints an example of the router's configuration: mutual TLS, and who may read and write what.
    Router,
    /// Prints a shell's completion script.
    Completions {
        /// The shell to complete for.
        shell: Shell,
    },
}

#[derive(Debug, clap::Args)]
struct File {
    /// The configuration; `roomcast-zenoh config` prints every key.
    #[arg(long, value_name = "FILE", env = "ROOMCAST_ZENOH_CONFIG")]
    config: PathBuf,
}

fn main() -> ExitCode {
    // This check comes before any code that needs much stack.
    match roomcast_ipc::limits::too_low() {
        Some(fault) => {
            let _told = writeln!(io::stderr(), "roomcast-zenoh: {fault}");
            ExitCode::from(FAILURE)
        }
        None => start(),
    }
}

/// A separate frame: with a small stack it is never entered.
#[inline(never)]
fn start() -> ExitCode {
    let arguments = Arguments::parse();
    roomcast_ipc::end_where_iceoryx2_panics("roomcast-zenoh", FAILURE);
    let filter = EnvFilter::try_from_env("ROOMCAST_LOG").unwrap_or_else(|_| EnvFilter::new(LOG));
    let colours = io::stderr().is_terminal();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr).with_ansi(colours).init();
    match run(arguments.command) {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, error)) => {
            // Standard error may be closed.
            let _told = writeln!(io::stderr(), "roomcast-zenoh: {}", chain(error.as_ref()));
            ExitCode::from(code)
        }
    }
}

fn chain(error: &dyn Error) -> String {
    let causes = std::iter::successors(error.source(), |cause| (*cause).source());
    causes.map(ToString::to_string).fold(error.to_string(), |said, cause| {
        // Many errors quote their cause already.
        if said.contains(&cause) { said } else { format!("{said}: {cause}") }
    })
}

type Failure = (u8, Box<dyn Error>);

fn failure(error: impl Error + 'static) -> Failure {
    (FAILURE, Box::new(error))
}

fn load(file: &File) -> Result<(Config, Stop), Failure> {
    let config = Config::load(&file.config).map_err(|error| (CONFIG, error.into()))?;
    Ok((config, Stop::on_signals(SECOND_SIGNAL, || ()).map_err(failure)?))
}

fn run(command: Command) -> Result<(), Failure> {
    let code = |is_of_configuration| if is_of_configuration { CONFIG } else { FAILURE };
    // A reader such as `head` may close the pipe early. That is not a failure.
    let print = |text: &str| match io::stdout().write_all(text.as_bytes()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        printed => printed.map_err(failure),
    };
    match command {
        Command::Config => print(config::MANUAL),
        Command::Router => print(include_str!("router.json5")),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Arguments::command(), "roomcast-zenoh", &mut script);
            print(&String::from_utf8_lossy(&script))
        }
        Command::Robot { file, root, domain } => {
            let (mut config, stop) = load(&file)?;
            config.ipc.root = root.or(config.ipc.root);
            config.ipc.domain = domain.unwrap_or(config.ipc.domain);
            config.check_robot().map_err(|error| (CONFIG, error.into()))?;
            robot::run(&config, &stop).map_err(|error| (code(error.is_of_configuration()), error.into()))
        }
        Command::Hub { file, input } => {
            let (config, stop) = load(&file)?;
            config.check_hub().map_err(|error| (CONFIG, error.into()))?;
            let outcome =
                hub::run(&config, &input, &stop).map_err(|error| (code(error.is_of_configuration()), error.into()))?;
            let line = serde_json::to_string(&outcome).map_err(failure)?;
            print(&format!("{line}\n"))
        }
        Command::Watch(file) => {
            let (config, stop) = load(&file)?;
            config.check_watch().map_err(|error| (CONFIG, error.into()))?;
            watch::run(&config, &stop).map_err(failure)
        }
    }
}
