//! `roomcast daemon`: the service that scores.

use std::path::PathBuf;

use super::{CommandResult, model, service};
use roomcast_services::daemon;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The scene file, or an included scene's name, in place of the configuration's.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// The GGUF model, in place of the configuration's.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// The state directory with the state database, in place of the configuration's.
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Score without a model, every word as likely as every other: for `roomcast latency`.
    #[arg(long, hide = true, conflicts_with = "model")]
    no_model: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log, mut config, domain) = args.service.begin()?;
    config.scene.path = args.scene.clone().or(config.scene.path);
    config.model.path = args.model.clone().or(config.model.path);
    config.daemon.state = args.state.clone().or(config.daemon.state);
    config.check()?;
    // Code that reads the state directory later would report this fault less clearly.
    if let Some(fault) = config.state_fault() {
        return Err(fault.into());
    }
    if !args.no_model {
        let Some(tried) = stop.while_loading(|| model::try_configured(&config)) else { return Ok(()) };
        tried?;
    }
    let ended = if args.no_model {
        daemon::run_without_model(&config, &domain, &stop)
    } else {
        daemon::run(&config, &domain, &stop)
    };
    Ok(ended?)
}
