//! `roomcast config`: the commented default configuration, or a check of one's own.

use std::path::{Path, PathBuf};

use super::doctor::segment_of_no_room;
use super::{CommandResult, Failure};
use crate::exit_code;
use roomcast_llama::affinity;
use roomcast_llama::gguf::Header;
#[cfg(feature = "mqtt")]
use roomcast_services::config::MqttConfig;
use roomcast_services::config::{Config, DEFAULT_TOML};
#[cfg(feature = "mqtt")]
use roomcast_services::logging::chain;
#[cfg(feature = "mqtt")]
use roomcast_services::mqtt::{Broker, MqttError, Rules};
use roomcast_services::setup;

/// Arguments of `roomcast config`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Check this file, and that this machine has what it names, and print what it amounts to, instead of the commented defaults.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// Prints the manual, or the checked file with every default filled in.
///
/// # Errors
/// When the file is malformed, or names a scene, a model file, cores or rules that this machine has not, a broker's address that is none, or a
/// room that the scene has not.
pub fn run(args: &Args) -> CommandResult {
    let text = match &args.check {
        None => DEFAULT_TOML.to_owned(),
        Some(path) => {
            let config = Config::load(path).map_err(|e| Failure::new(exit_code::CONFIG, e))?;
            check_names(&config, path)?;
            toml::to_string(&config).map_err(|e| Failure::new(exit_code::FAILURE, e))?
        }
    };
    super::print(&text)
}

/// Whether the services would find what the configuration names. All that is wrong is said at once.
fn check_names(config: &Config, file: &Path) -> CommandResult {
    let map = setup::load_map(config.scene.path.as_deref());
    let segments = map.as_ref().ok().and_then(|map| segment_of_no_room(config, map, &file.display().to_string()));
    let segments = segments.map(|(found, remedy)| Failure::new(exit_code::CONFIG, format!("{found}: {remedy}")));
    let model = config.model.path.as_deref().map_or(Ok(()), |path| {
        Header::read_language_model(path).map(|_| ()).map_err(|error| Failure::new(exit_code::MODEL, error))
    });
    // Of a file that is no model the checksum says nothing more.
    let pin = if model.is_ok() { setup::check_pin(config).map_err(Failure::from) } else { Ok(()) };
    let cores = affinity::check(&config.model.cores).map_err(|error| Failure::new(exit_code::CONFIG, error));
    let mut failures: Vec<Failure> = [map.map(|_| ()).map_err(Failure::from), model, pin, cores]
        .into_iter()
        .filter_map(Result::err)
        .chain(segments)
        .collect();
    #[cfg(feature = "mqtt")]
    failures.extend(check_mqtt(&config.mqtt));
    if failures.len() <= 1 {
        return failures.pop().map_or(Ok(()), Err);
    }
    let lines: Vec<String> = failures.iter().map(|failure| format!("- {failure}")).collect();
    let text = format!("{}: {} things are wrong:\n{}", file.display(), lines.len(), lines.join("\n"));
    Err(Failure::new(failures[0].code, text))
}

/// What is wrong with the section `[mqtt]`: with the broker's address and its files, and with the rules.
#[cfg(feature = "mqtt")]
fn check_mqtt(config: &MqttConfig) -> Vec<Failure> {
    let broker = config.broker.as_ref().map(|address| Broker {
        address: address.clone(),
        client: "roomcast".to_owned(),
        credentials: config.credentials.clone(),
        authority: config.ca.clone(),
    });
    let broker = broker.and_then(|broker| broker.options().err()).map(|error| ("mqtt.broker", error));
    let rules = config.rules.as_deref().and_then(|path| Rules::load(path).err()).map(|error| ("mqtt.rules", error));
    let failed = |(key, error): (&str, MqttError)| {
        let remedy = match &error {
            MqttError::Read { .. } if key == "mqtt.rules" => "; correct the path, or let roomcast init write rules",
            MqttError::Read { .. } => "; correct mqtt.credentials and mqtt.ca",
            _ => "",
        };
        Failure::new(exit_code::CONFIG, format!("{key}: {}{remedy}", chain(&error)))
    };
    broker.into_iter().chain(rules).map(failed).collect()
}
