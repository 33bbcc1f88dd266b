//! `roomcast view`: shows the plan in a browser, of the running system or of a recording.

use std::net::SocketAddr;
use std::path::PathBuf;

use super::{CommandResult, Failure, record, service};
use crate::http::HttpError;
use crate::view::{self, Place, ViewError};
use roomcast_services::{logging, notify};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The loopback address to serve on; port 0 takes a free one and prints it.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:9465")]
    listen: SocketAddr,
    /// Show a recording of `roomcast record` in place of the running system.
    #[arg(long, value_name = "FILE")]
    recording: Option<PathBuf>,
    /// Let every user of this machine look. Without it, a viewer needs the address with its key.
    #[arg(long)]
    no_key: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log) = (service::stop()?, logging::init());
    let place = if args.no_key { Place { address: args.listen, key: None } } else { Place::with_key(args.listen) };
    let ready = |address: SocketAddr| {
        super::tell(format_args!("open {} in a browser on this machine", place.url(address)));
        notify::notify(&[sd_notify::NotifyState::Ready]);
    };
    let served = match &args.recording {
        Some(_) if args.service.on_command_line() => {
            let text = "--config, --root and --domain name a running system: leave them out with --recording";
            return Err(Failure::usage(text));
        }
        Some(path) => {
            let recording = record::read_until(path, &|| stop.requested())?;
            view::run_recording(&place, recording, &stop, ready)
        }
        None => {
            let (config, domain) = args.service.load()?;
            let state = config.daemon.state_directory();
            view::run(&place, &domain, &config.planner.robot, state.as_deref(), &stop, ready)
        }
    };
    served.map_err(|error| match error {
        ViewError::Http(HttpError::NotLoopback(_)) => Failure::usage(error),
        ViewError::Ipc(_) => Failure::ipc(error),
        ViewError::Http(_) => Failure::failed(error),
    })
}
