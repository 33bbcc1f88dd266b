//! `roomcast narrate`: publishes observations.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::{CommandResult, Failure, print_json, ranges, service};
#[cfg(feature = "whole")]
use super::{broker, narrate_mqtt};
use roomcast_core::text::count;
use roomcast_ipc::{Domain, question};
use roomcast_services::clock;
use roomcast_services::config::Config;
use roomcast_services::daemon::{PersonAnswer, PersonQuestion, UNDERSTOOD_MAX, UnderstoodLine};
use roomcast_services::dry_run::DryRun;
use roomcast_services::narrator::{self, Input, Outcome, Pace, Who};
use roomcast_services::sensor_log::SensorRules;
use roomcast_services::stop::Stop;

/// Inputs other than a broker. Options that require `--mqtt` conflict with these: clap drops a requirement if another option excludes it.
#[cfg(feature = "whole")]
const OTHER_INPUTS: [&str; 4] = ["input", "fifo", "sensors", "speed"];

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// An activity program (or an included one's name), JSON lines (docs/json-lines.md), or plain lines; `-` is standard input.
    #[arg(value_name = "FILE", default_value = "-", conflicts_with = "fifo")]
    input: PathBuf,
    /// Make a FIFO there and publish the lines written into it, without end.
    #[arg(long, value_name = "PATH", conflicts_with = "speed")]
    fifo: Option<PathBuf>,
    /// Publish messages of an MQTT broker's devices: `mqtt://HOST[:PORT]`, or `mqtts://HOST[:PORT]` with --mqtt-ca; without a value, the broker of
    /// the configuration's section `[mqtt]`. The configuration's login and certificates are only for that one.
    #[cfg(feature = "whole")]
    #[arg(long, value_name = "URL", conflicts_with_all = OTHER_INPUTS, num_args = 0..=1)]
    mqtt: Option<Option<String>>,
    /// Publish a sensor log: intervals with sensor, kind and place, as in public smart-home data sets.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["input", "fifo"], requires = "rules")]
    sensors: Option<PathBuf>,
    /// The rules that turn MQTT messages or sensors' intervals into narration (docs/mqtt.md, docs/sensors.md); for MQTT in place of the
    /// configuration's mqtt.rules.
    #[arg(long, value_name = "FILE")]
    rules: Option<PathBuf>,
    /// A file with the broker's user name and password, a line each.
    #[cfg(feature = "whole")]
    #[arg(long, value_name = "FILE", requires = "mqtt", conflicts_with_all = OTHER_INPUTS)]
    mqtt_credentials: Option<PathBuf>,
    /// A PEM file with the certificates of the broker's certificate authority.
    #[cfg(feature = "whole")]
    #[arg(long, value_name = "FILE", requires = "mqtt", conflicts_with_all = OTHER_INPUTS)]
    mqtt_ca: Option<PathBuf>,
    /// Publish nothing: print how the daemon would understand each event, its person, place and belief. With --mqtt and without --json, print each
    /// message with its rule and sentence instead.
    #[arg(long)]
    dry_run: bool,
    /// This source's name, in place of the configuration's; it must differ between narrators.
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// The observed person, by number or name, if the input names none. Without it the daemon decides which person an event is about.
    #[arg(long, value_name = "N|NAME")]
    person: Option<Who>,
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

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log, mut config, domain) = args.service.begin()?;
    service::replace(&mut config.narrator.name, &args.name);
    service::replace(&mut config.narrator.linger_s, &args.linger);
    config.check()?;
    let pace = args.pace.map_or(Pace::Speed(args.speed), Pace::Seconds);
    let person = args.person.clone().unwrap_or_default();
    #[cfg(feature = "whole")]
    let is_mqtt = args.mqtt.is_some();
    #[cfg(not(feature = "whole"))]
    let is_mqtt = false;
    if args.rules.is_some() && args.sensors.is_none() && !is_mqtt {
        return Err(Failure::usage("--rules are for --mqtt or --sensors; give one of them"));
    }
    if let Some(fifo) = &args.fifo {
        narrator::make_fifo(fifo).map_err(Failure::input)?;
    }
    #[cfg(feature = "whole")]
    if let Some(address) = &args.mqtt {
        let given = broker::Args::of(address.clone(), args.mqtt_credentials.clone(), args.mqtt_ca.clone());
        let broker = given.broker(&config.mqtt, format!("roomcast-{}", config.narrator.name))?;
        let Some(rules) = args.rules.as_ref().or(config.mqtt.rules.as_ref()) else {
            let text = "no rules are named: give --rules FILE, or set rules in the section [mqtt] of the configuration";
            return Err(Failure::usage(text));
        };
        if args.dry_run {
            let rehearse = if args.json { narrate_mqtt::rehearse_as_json } else { narrate_mqtt::rehearse };
            return rehearse(&broker, rules, &person, &config, &stop);
        }
        let (lines, listener) = narrate_mqtt::listen(&broker, rules, person, &config, &stop)?;
        // The broker's connection ends first. Then the remaining lines are published.
        let patience = narrate_mqtt::patience(&stop)?;
        let outcome = publish(&config, &domain, lines, pace, &patience)?;
        if !patience.requested() {
            narrate_mqtt::join(listener)?;
        }
        return report(args, &outcome, &domain, stop.requested().then_some(Stopped::Service));
    }
    let source = match &args.sensors {
        Some(log) => read_sensors(log, args.rules.as_deref().unwrap_or(Path::new("rules.toml")), &person)?,
        None => Input::open(args.fifo.as_ref().unwrap_or(&args.input), person).map_err(Failure::input)?,
    };
    if args.dry_run {
        return dry_run(args, &config, source, &stop);
    }
    let has_end = args.sensors.is_some() || args.fifo.is_none() && service::has_end(&args.input);
    let outcome = publish(&config, &domain, source, pace, &stop)?;
    let stopped = match stop.requested() {
        true if !has_end => Some(Stopped::Service),
        true if !outcome.is_whole => Some(Stopped::Halfway),
        _ => None,
    };
    report(args, &outcome, &domain, stopped)
}

/// How the daemon understood the newest events; empty without an answer.
fn understood(outcome: &Outcome, domain: &Domain) -> Vec<UnderstoodLine> {
    const PATIENCE_S: u64 = 2;
    if outcome.confirmed == 0 {
        return Vec::new();
    }
    let (source, epoch) = outcome.start;
    let from = (outcome.sent + 1).saturating_sub(UNDERSTOOD_MAX as u64).max(1);
    let asker = service::Asker::new(domain, "roomcast-understood", question::PERSON, PATIENCE_S);
    let answer = asker.and_then(|asker| asker.ask::<PersonAnswer>(&PersonQuestion::Understood { source, epoch, from }));
    answer.map(|answer| answer.understood).unwrap_or_default()
}

fn dry_run(args: &Args, config: &Config, source: Input, stop: &Stop) -> CommandResult {
    let mut dry_run = DryRun::new(config, clock::unix_ns()).map_err(Failure::config)?;
    let (mut refused, mut fault) = (0_usize, None);
    source.each(|item| {
        let line = match item {
            Ok(item) => dry_run.take(&item).map_err(Failure::config),
            Err(reason) => {
                refused += 1;
                super::tell(format_args!("roomcast: {reason}"));
                Ok(None)
            }
        };
        let shown = line.and_then(|line| match line {
            Some(line) if args.json => super::print_json_line(&line),
            Some(line) => super::print(&line.shown()),
            None => Ok(()),
        });
        fault = shown.err();
        fault.is_none() && !stop.requested()
    });
    match (fault, refused) {
        (Some(fault), _) => Err(fault),
        (None, 0) => Ok(()),
        (None, _) => Err(Failure::input(format!("{} no narration", count(refused, "line")))),
    }
}

#[derive(Debug, Clone, Copy)]
enum Stopped {
    /// Work that goes on until it is stopped.
    Service,
    /// Work that should have reached its end.
    Halfway,
}

fn publish(config: &Config, domain: &Domain, source: Input, pace: Pace, stop: &Stop) -> Result<Outcome, Failure> {
    narrator::run(&config.narrator, config.daemon.intake, domain, source, pace, stop).map_err(Failure::ipc)
}

fn report(args: &Args, outcome: &Outcome, domain: &Domain, stopped: Option<Stopped>) -> CommandResult {
    if args.json {
        let mut printed = json!(outcome);
        printed["understood"] = json!(understood(outcome, domain));
        print_json(&printed)?;
    }
    match stopped {
        // The log reports refused lines. If a stop ends a service, refused and unconfirmed lines are no error.
        Some(Stopped::Service) => return Ok(()),
        Some(Stopped::Halfway) => {
            let Outcome { sent, confirmed, .. } = outcome;
            return Err(service::interrupted(&format!(
                "{} sent, {confirmed} of them confirmed",
                count(*sent as usize, "narration")
            )));
        }
        None => {}
    }
    let unconfirmed = outcome.sent - outcome.confirmed - outcome.dropped;
    if outcome.refused > 0 {
        let refused = outcome.refused;
        return Err(Failure::input(match refused {
            1 => "1 line was no narration; the log names it".to_owned(),
            _ => format!("{refused} lines were no narration; the log names the first of them"),
        }));
    }
    if outcome.dropped > 0 {
        let (dropped, sent) = (outcome.dropped, outcome.sent);
        return Err(Failure::ipc(format!(
            "the daemon dropped {dropped} of {sent} narrations; its log says why, for each source"
        )));
    }
    if unconfirmed > 0 {
        let sent = outcome.sent;
        return Err(Failure::ipc(format!(
            "{unconfirmed} of {} not confirmed; is a daemon running in {}?",
            count(sent as usize, "narration"),
            service::shown(domain)
        )));
    }
    Ok(())
}

fn read_sensors(log: &Path, rules: &Path, person: &Who) -> Result<Input, Failure> {
    let narrated =
        SensorRules::load(rules).and_then(|rules| rules.narrate_file(log, person)).map_err(Failure::input)?;
    let (lines, unfit, silent) = (narrated.said.len(), narrated.unfit, narrated.silent);
    tracing::info!(lines, unfit, silent, log = %log.display(), "sensor log read");
    Ok(Input::Log { items: narrated.said.into_iter().map(|said| said.item).collect(), faults: narrated.faults })
}
