//! `roomcast metrics`: metrics of a running system for Prometheus.

use std::net::SocketAddr;

use super::{CommandResult, Failure, service};
use crate::http::HttpError;
use crate::metrics::{self, MetricsError};
use roomcast_services::notify;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The loopback address to serve on, in place of the configuration's; port 0 takes a free one and prints it.
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<SocketAddr>,
}

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log, config, domain) = args.service.begin()?;
    let Some(address) = args.listen.or(config.metrics.listen) else {
        return Err(Failure::config(
            "metrics are off: set listen = \"127.0.0.1:9464\" in the section [metrics], or give --listen",
        ));
    };
    let served = metrics::run(address, &domain, &stop, |address| {
        super::tell(format_args!("metrics at http://{address}/metrics"));
        notify::notify(&[sd_notify::NotifyState::Ready]);
    });
    served.map_err(|error| match error {
        MetricsError::Http(HttpError::NotLoopback(_)) => Failure::config(error),
        MetricsError::Ipc(_) => Failure::ipc(error),
        MetricsError::Http(_) => Failure::failed(error),
    })
}
