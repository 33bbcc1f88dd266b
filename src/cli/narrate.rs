//! `roomcast narrate`: publishes observations.

use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

use super::{CommandResult, Failure, print_json, ranges, service};
use crate::mqtt::{self, Broker, Heard, MqttError, Rules};
use crate::narrator::{self, Input, Pace};
use crate::sensor_log::SensorRules;
use crate::stop::Stop;
use crate::{exit_code, logging};

/// Arguments of `roomcast narrate`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// An activity program (or a shipped one's name), JSON lines, or plain lines; `-` is standard input.
    #[arg(value_name = "FILE", default_value = "-", conflicts_with = "fifo")]
    input: PathBuf,
    /// Make a FIFO there and publish the lines written into it, for ever.
    #[arg(long, value_name = "PATH")]
    fifo: Option<PathBuf>,
    /// Publish what an MQTT broker's devices say: mqtt://HOST[:PORT], or mqtts://HOST[:PORT] with --mqtt-ca.
    #[arg(long, value_name = "URL", conflicts_with_all = ["input", "fifo"], requires = "rules")]
    mqtt: Option<String>,
    /// Publish a sensor log: intervals with sensor, kind and place, as public smart-home data sets have them.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["input", "fifo", "mqtt"], requires = "rules")]
    sensors: Option<PathBuf>,
    /// The rules by which MQTT messages or sensors' intervals become sentences; see docs/mqtt.md and docs/sensors.md.
    #[arg(long, value_name = "FILE")]
    rules: Option<PathBuf>,
    /// A file with the broker's user name and password, a line each.
    #[arg(long, value_name = "FILE", requires = "mqtt")]
    mqtt_credentials: Option<PathBuf>,
    /// A PEM file with the certificates that the broker's is signed by.
    #[arg(long, value_name = "FILE", requires = "mqtt")]
    mqtt_ca: Option<PathBuf>,
    /// This source's name, in place of the configuration's; it must differ between narrators.
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// The person that is observed, when the input does not say.
    #[arg(long, value_name = "N", default_value_t = 0)]
    person: u32,
    /// Seconds before each narration; 0 is as fast as the daemon takes them.
    #[arg(long, value_name = "SECONDS", conflicts_with = "speed", value_parser = ranges::time_s)]
    pace: Option<f64>,
    /// For programs and sensor logs: so many times faster than in reality.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = ranges::positive)]
    speed: f64,
    /// Seconds to wait at the end until the daemon has confirmed everything, in place of the configuration's.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::time_s)]
    linger: Option<f64>,
    /// Print the outcome as JSON.
    #[arg(long)]
    json: bool,
}

/// Publishes the input.
///
/// # Errors
///
/// When the input is malformed, a service cannot be opened, or the daemon did not confirm everything.
pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let _log = logging::init();
    let (mut config, domain) = args.service.load()?;
    let narrator = &mut config.narrator;
    if let Some(name) = &args.name {
        narrator.name.clone_from(name);
    }
    narrator.linger_s = args.linger.unwrap_or(narrator.linger_s);
    config.check().map_err(|error| Failure::new(exit_code::CONFIG, error))?;
    let pace = args.pace.map_or(Pace::Speed(args.speed), Pace::Seconds);
    let input = |error| Failure::new(exit_code::INPUT, error);
    if let Some(fifo) = &args.fifo {
        narrator::make_fifo(fifo).map_err(input)?;
    }
    let mut listener = None;
    let source = match (&args.mqtt, &args.sensors) {
        (Some(address), _) => {
            let (lines, thread) = listen(args, address, &config.narrator.name, &stop)?;
            listener = Some(thread);
            lines
        }
        (None, Some(log)) => read_sensors(log, args.rules.as_deref().unwrap_or(Path::new("rules.toml")))?,
        (None, None) if args.rules.is_some() => {
            return Err(Failure::new(exit_code::USAGE, "--rules are for --mqtt or --sensors; give one of them"));
        }
        (None, None) => Input::open(args.fifo.as_ref().unwrap_or(&args.input), args.person).map_err(input)?,
    };
    let outcome = narrator::run(&config.narrator, config.daemon.intake, &domain, source, pace, &stop)
        .map_err(|error| Failure::new(exit_code::IPC, error))?;
    // On a wish to stop the connection may take its time to close, and nothing is left to be said.
    if let Some(listener) = listener.filter(|_| !stop.requested()) {
        join(listener)?;
    }
    if args.json {
        print_json(&outcome)?;
    }
    let unconfirmed = outcome.sent - outcome.confirmed;
    if outcome.refused > 0 {
        let refused = outcome.refused;
        return Err(Failure::new(exit_code::INPUT, format!("{refused} lines were no narration; the log names them")));
    }
    if unconfirmed > 0 {
        let sent = outcome.sent;
        return Err(Failure::new(
            exit_code::IPC,
            format!(
                "{unconfirmed} of {sent} narrations were not confirmed; is a daemon running in {}?",
                service::shown(&domain)
            ),
        ));
    }
    Ok(())
}

/// Makes narration of a sensor log.
fn read_sensors(log: &Path, rules: &Path) -> Result<Input, Failure> {
    let input = |error| Failure::new(exit_code::INPUT, error);
    let narrated = SensorRules::load(rules).and_then(|rules| rules.narrate_file(log)).map_err(input)?;
    let (lines, unfit, silent) = (narrated.items.len(), narrated.unfit, narrated.silent);
    tracing::info!(lines, unfit, silent, log = %log.display(), "sensor log read");
    Ok(Input::Log(narrated.items))
}

/// Listens to the broker in a thread of its own; its lines come through a pipe, whose small buffer holds it back while the daemon is
/// behind: what is in it is acknowledged, and goes with this process.
fn listen(args: &Args, address: &str, name: &str, stop: &Stop) -> Result<(Input, Listener), Failure> {
    let rules = Rules::load(args.rules.as_deref().unwrap_or(Path::new("rules.toml"))).map_err(mqtt_failure)?;
    let broker = Broker {
        address: address.to_owned(),
        client: format!("roomcast-{name}"),
        credentials: args.mqtt_credentials.clone(),
        authority: args.mqtt_ca.clone(),
    };
    let options = broker.options().map_err(mqtt_failure)?;
    let (reader, writer) = std::io::pipe().map_err(|error| Failure::new(exit_code::FAILURE, error))?;
    // The least there is, a page; a system that refuses leaves it larger.
    let _resized = rustix::pipe::fcntl_setpipe_size(&writer, 4096);
    let stop = stop.clone();
    let listener = std::thread::Builder::new().name("mqtt".to_owned());
    let listener = listener
        .spawn(move || mqtt::listen(options, rules, writer, &stop))
        .map_err(|error| Failure::new(exit_code::FAILURE, format!("cannot start the mqtt thread: {error}")))?;
    Ok((Input::Lines { name: address.to_owned(), stream: Box::new(reader), person: args.person }, listener))
}

type Listener = JoinHandle<Result<Heard, MqttError>>;

/// How listening ended, which it does by itself only when the client cannot go on.
fn join(listener: Listener) -> CommandResult {
    let heard = listener.join().map_err(|_| Failure::new(exit_code::FAILURE, "the mqtt thread ended unexpectedly"))?;
    let heard = heard.map_err(mqtt_failure)?;
    tracing::info!(said = heard.said, unfit = heard.unfit, silent = heard.silent, "left the broker");
    Ok(())
}

fn mqtt_failure(error: MqttError) -> Failure {
    let code = match error {
        MqttError::Address { .. } | MqttError::Scheme { .. } => exit_code::USAGE,
        MqttError::Read { .. } | MqttError::Rules { .. } | MqttError::Authority { .. } => exit_code::INPUT,
        MqttError::Client { .. } => exit_code::FAILURE,
    };
    Failure::new(code, error)
}
