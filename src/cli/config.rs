//! `roomcast config`: prints the commented default configuration, or checks a file.

use std::path::{Path, PathBuf};

use super::{CommandResult, Failure, doctor, service};
use crate::exit_code;
use roomcast_core::text::visible;
use roomcast_llama::affinity;
use roomcast_llama::gguf::Header;
use roomcast_services::config::{Config, ConfigError, DEFAULT_TOML};
use roomcast_services::setup;
#[cfg(feature = "whole")]
use roomcast_services::{
    config::MqttConfig,
    logging::chain,
    mqtt::{Broker, MqttError},
};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// Check this file and everything that it names on this machine, instead of printing the commented defaults.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// Prints the manual, or that the checked file is in order.
pub fn run(args: &Args) -> CommandResult {
    let text = match &args.check {
        None => DEFAULT_TOML.to_owned(),
        Some(path) => {
            let config = Config::read(path).map_err(Failure::config)?;
            check_names(&config, path)?;
            format!("ok: {}\n", path.display())
        }
    };
    super::print(&text)
}

/// Checks the values and the names in a configuration. All faults are reported at once; lesser problems are remarks.
fn check_names(config: &Config, file: &Path) -> CommandResult {
    let value = |fault: ConfigError| {
        let fault = ConfigError::InFile { path: file.to_owned(), fault: Box::new(fault) };
        Failure::config(fault)
    };
    let folders = [config.root_fault(), config.state_fault()].into_iter().flatten();
    let mut failures: Vec<Failure> = config.faults().into_iter().chain(folders).map(value).collect();
    let map = setup::load_map(config.scene.path.as_deref());
    let model = config
        .model
        .path
        .as_deref()
        .map_or(Ok(()), |path| Header::read_language_model(path).map(|_| ()).map_err(Failure::model));
    // The checksum of a file that is no model adds nothing.
    let pin = if model.is_ok() { setup::check_pin(config).map_err(Failure::from) } else { Ok(()) };
    let cores = affinity::check(&config.model.cores).map_err(Failure::config);
    let (wrong, limited) = doctor::names(config, map.as_ref().ok(), file);
    failures.extend([map.map(|_| ()).map_err(Failure::from), model, pin, cores].into_iter().filter_map(Result::err));
    failures.extend(wrong.into_iter().map(Failure::config));
    #[cfg(feature = "whole")]
    failures.extend(check_broker(&config.mqtt));
    for remark in limited.into_iter().chain(service::overridden(config)) {
        super::tell(format_args!("roomcast: {}", visible(&remark)));
    }
    if failures.len() <= 1 {
        return failures.pop().map_or(Ok(()), Err);
    }
    let lines: Vec<String> = failures.iter().map(|failure| format!("- {failure}")).collect();
    let text = format!("{}: {} things are wrong:\n{}", file.display(), lines.len(), lines.join("\n"));
    // A missing map has one exit code in all commands.
    let missing = failures.iter().map(|failure| failure.code).find(|code| *code == exit_code::INPUT);
    Err(Failure::new(missing.unwrap_or(failures[0].code), text))
}

#[cfg(feature = "whole")]
fn check_broker(config: &MqttConfig) -> Option<Failure> {
    let broker = Broker {
        address: config.broker.clone()?,
        client: "roomcast".to_owned(),
        credentials: config.credentials.clone(),
        authority: config.ca.clone(),
    };
    let error = broker.options().err()?;
    let remedy = match &error {
        MqttError::Read { .. } => "; correct mqtt.credentials and mqtt.ca",
        _ => "",
    };
    Some(Failure::config(format!("mqtt.broker: {}{remedy}", chain(&error))))
}
