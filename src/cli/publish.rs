//! `roomcast publish`: publishes the state of Roomcast for other programs.

use std::io::Write;

use super::{CommandResult, Failure, broker, service};
use crate::publish::{self, BridgeError, Way};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    to: To,
}

#[derive(Debug, clap::Subcommand)]
enum To {
    /// Publish rooms, persons, decisions and health over MQTT, with Home Assistant's discovery.
    Mqtt(MqttArgs),
}

#[derive(Debug, clap::Args)]
struct MqttArgs {
    #[command(flatten)]
    service: service::Args,
    #[command(flatten)]
    broker: broker::Args,
    /// The beginning of the topics, in place of the configuration's.
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// Connect to no broker; print each message that would be published, as a line of JSON. Ends with Ctrl-C.
    #[arg(long)]
    dry_run: bool,
    /// With --dry-run: end when everything was printed once.
    #[arg(long, requires = "dry_run", conflicts_with = "remove")]
    once: bool,
    /// Remove everything that a publisher with these topics has left at the broker, and end.
    #[arg(long, conflicts_with = "dry_run")]
    remove: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let To::Mqtt(args) = &args.to;
    let (stop, _log, mut config, domain) = args.service.begin()?;
    service::replace(&mut config.bridge.topic, &args.topic);
    config.check()?;
    let done = if args.dry_run {
        let mut print = |topic: &str, payload: &str| {
            let line = serde_json::json!({ "topic": topic, "payload": payload, "retain": true });
            let mut out = std::io::stdout().lock();
            writeln!(out, "{line}").and_then(|()| out.flush())
        };
        publish::run(&config, &domain, Way::Print { once: args.once, print: &mut print }, &stop)
    } else {
        let client = format!("roomcast-bridge-{}", config.bridge.topic.replace('/', "-"));
        let broker = args.broker.broker(&config.mqtt, client)?;
        match args.remove {
            true => {
                let runs = domain.open("roomcast-remove").and_then(|node| node.participants());
                if runs.is_ok_and(|names| names.iter().any(|name| name.starts_with("roomcast-publish"))) {
                    super::tell(format_args!(
                        "roomcast: a publisher runs in this domain: end it first, or it says everything again"
                    ));
                }
                publish::remove(&config, &broker, &stop)
            }
            false => publish::run(&config, &domain, Way::Broker(&broker), &stop),
        }
    };
    // `--remove` and `--once` have an end; otherwise this is a service.
    if done.is_ok() && (args.remove || args.once) && stop.requested() {
        return Err(service::interrupted("what the publisher was to do once may not be done"));
    }
    done.map_err(|error| match error {
        BridgeError::Mqtt(error) => broker::failure(error),
        BridgeError::Ipc(_) | BridgeError::NoDaemon => Failure::ipc(error),
        BridgeError::Print(_) | BridgeError::NotRemoved => Failure::failed(error),
    })
}
