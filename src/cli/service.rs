//! Shared by the commands of services: configuration and domain.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::time::Duration;

use roomcast_ipc::{Domain, QuestionPort, sequence};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::{Failure, ranges, stage};
use crate::exit_code;
use roomcast_services::config::Config;
use roomcast_services::logging;
use roomcast_services::stop::Stop;

/// Environment variables that override the configuration, for every command that joins a domain.
const ROOT_VARIABLE: &str = "ROOMCAST_ROOT";
const DOMAIN_VARIABLE: &str = "ROOMCAST_DOMAIN";

pub fn overridden(config: &Config) -> Vec<String> {
    overridden_by(config, |name| std::env::var_os(name))
}

fn overridden_by(config: &Config, variable: impl Fn(&str) -> Option<OsString>) -> Vec<String> {
    let root = config.ipc.root.as_ref().map(|root| root.as_os_str());
    let keys =
        [(ROOT_VARIABLE, "ipc.root", root), (DOMAIN_VARIABLE, "ipc.domain", Some(OsStr::new(&config.ipc.domain)))];
    let other = |(name, key, own): (&str, &str, Option<&OsStr>)| {
        let value = variable(name).filter(|value| Some(value.as_os_str()) != own)?;
        let value = value.to_string_lossy().into_owned();
        Some(format!(
            "{name} is set to {value:?} here, and commands that are started here take it in place of {key}; unset it to use the file's"
        ))
    };
    keys.into_iter().filter_map(other).collect()
}

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The configuration file; see `roomcast config` for all keys.
    #[arg(long, value_name = "FILE", env = "ROOMCAST_CONFIG")]
    config: Option<PathBuf>,
    /// The domain's root path, in place of the configuration's.
    #[arg(long, value_name = "DIR", env = ROOT_VARIABLE)]
    root: Option<PathBuf>,
    /// The domain's name, in place of the configuration's.
    #[arg(long, value_name = "NAME", env = DOMAIN_VARIABLE)]
    domain: Option<String>,
}

impl Args {
    /// Whether the command line itself, not only the environment, names a configuration or a domain.
    pub fn on_command_line(&self) -> bool {
        let given = |value: Option<&OsStr>, name| value.is_some() && value != std::env::var_os(name).as_deref();
        given(self.config.as_ref().map(|path| path.as_os_str()), "ROOMCAST_CONFIG")
            || given(self.root.as_ref().map(|path| path.as_os_str()), ROOT_VARIABLE)
            || given(self.domain.as_ref().map(OsStr::new), DOMAIN_VARIABLE)
    }

    pub fn config_file(&self) -> Option<&Path> {
        self.config.as_deref()
    }

    pub fn begin(&self) -> Result<(Stop, logging::Log, Config, Domain), Failure> {
        let (stop, log) = (stop()?, logging::init());
        let (config, domain) = self.load()?;
        Ok((stop, log, config, domain))
    }

    pub fn load(&self) -> Result<(Config, Domain), Failure> {
        let mut config = self.config.as_deref().map(Config::load).transpose()?.unwrap_or_default();
        config.ipc.root = self.root.clone().or(config.ipc.root);
        replace(&mut config.ipc.domain, &self.domain);
        let domain = config.ipc.domain().map_err(Failure::config)?;
        Ok((config, domain))
    }
}

/// Replaces a value of the configuration if the command line has one.
pub fn replace<T: Clone>(configured: &mut T, given: &Option<T>) {
    if let Some(given) = given {
        configured.clone_from(given);
    }
}

#[derive(Debug, clap::Args)]
pub struct Asking {
    #[command(flatten)]
    pub service: Args,
    /// Seconds to wait for the daemon.
    #[arg(long, value_name = "SECONDS", default_value_t = 10, value_parser = ranges::any())]
    pub patience: u64,
}

impl Asking {
    pub fn asker(&self, participant: &str, service: &'static str) -> Result<Asker, Failure> {
        Asker::new(&self.service.load()?.1, participant, service, self.patience)
    }
}

/// Asks one of the daemon's services of questions.
pub struct Asker {
    port: QuestionPort,
    patience: Duration,
}

impl Asker {
    /// Joins the domain as `participant`, to ask on `service` and wait `patience_s` seconds for each answer.
    pub fn new(domain: &Domain, participant: &str, service: &'static str, patience_s: u64) -> Result<Self, Failure> {
        let port = domain.open(participant).and_then(|node| node.question_port(service))?;
        Ok(Self { port, patience: Duration::from_secs(patience_s) })
    }

    pub fn ask<A: DeserializeOwned>(&self, question: &impl Serialize) -> Result<A, Failure> {
        let question = serde_json::to_string(question).map_err(Failure::failed)?;
        let text = self.port.ask(&question, self.patience)?;
        serde_json::from_str(&text).map_err(|error| {
            let text = format!("the daemon's answer cannot be read: {error}; use one version of Roomcast");
            Failure::ipc(text)
        })
    }
}

pub fn question_name() -> String {
    format!("{:016x}", sequence::random_epoch())
}

/// A domain as messages name it.
pub fn shown(domain: &Domain) -> String {
    format!("the domain {} at {}", domain.name(), domain.root().display())
}

/// Whether this input has an end, so that an earlier stop counts as an interruption. Pipes, FIFOs and terminals have none. `-` is standard input; a
/// name that is no file is of an included program.
pub fn has_end(path: &Path) -> bool {
    if path.as_os_str() == "-" {
        let about = rustix::fs::fstat(std::io::stdin());
        return about.is_ok_and(|about| rustix::fs::FileType::from_raw_mode(about.st_mode).is_file());
    }
    std::fs::metadata(path).map_or(true, |about| about.is_file())
}

/// The failure of a command that was stopped before its work was done.
pub fn interrupted(done: &str) -> Failure {
    Failure::interrupted(format!("interrupted: {done}"))
}

/// A stop on signals, and at the end of the parent process on a stage.
pub fn stop() -> Result<Stop, Failure> {
    let stop = Stop::on_signals(exit_code::INTERRUPTED, logging::finish);
    stop.and_then(|stop| stage::leave_with_parent().map(|()| stop))
        .map_err(|error| Failure::failed(format!("cannot handle signals: {error}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_environment_overrides_is_told() {
        let config: Config = toml::from_str("[ipc]\ndomain = \"roomcast\"").unwrap();
        let told = |set: &[(&str, &str)]| {
            overridden_by(&config, |name| set.iter().find(|(own, _)| *own == name).map(|(_, value)| value.into()))
        };
        assert!(told(&[]).is_empty() && told(&[("ROOMCAST_DOMAIN", "roomcast")]).is_empty());
        let both = told(&[("ROOMCAST_DOMAIN", "other"), ("ROOMCAST_ROOT", "/run/a")]);
        assert!(
            both[0].starts_with("ROOMCAST_ROOT is set to \"/run/a\" here") && both[0].contains("ipc.root"),
            "{both:?}"
        );
        assert!(
            both[1].starts_with("ROOMCAST_DOMAIN is set to \"other\" here") && both[1].contains("ipc.domain"),
            "{both:?}"
        );
    }
}
