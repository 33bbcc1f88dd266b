//! `roomcast robot`: drives a vacuum by the planner's decisions.

use std::io::Write;

use super::choice::choice;
use super::{CommandResult, Failure, broker, service};
use roomcast_services::config::RobotKind;
use roomcast_services::setup;
use roomcast_services::vacuum::{self, DriveError, Way};

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    #[command(flatten)]
    broker: broker::Args,
    /// The robot's protocol, in place of the configuration's.
    #[arg(long, value_name = "KIND", value_parser = choice::<RobotKind>())]
    kind: Option<RobotKind>,
    /// The robot's topic, in place of the configuration's: Valetudo's prefix and identifier, or Home Assistant's state topics of the vacuum.
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// The robot's name, in place of the configuration's planner.robot.
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// Send the commands to the robot. Without it, and without robot.obey in the configuration, they are only printed.
    #[arg(long)]
    obey: bool,
}

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log, mut config, domain) = args.service.begin()?;
    config.robot.obey |= args.obey;
    service::replace(&mut config.robot.kind, &args.kind);
    service::replace(&mut config.robot.topic, &args.topic);
    service::replace(&mut config.planner.robot, &args.robot);
    config.check()?;
    // Rooms may be named by other words than the map's ids.
    if !config.robot.segments.is_empty() {
        let map = setup::load_map(config.scene.path.as_deref())?;
        config.robot.segments = vacuum::by_ids(&config.robot.segments, &map);
    }
    // A broker disconnects an earlier client with the same name, so a dry run has another one.
    let dry = if config.robot.obey { String::new() } else { format!("-dry-run-{}", std::process::id()) };
    let client = format!("roomcast-robot-{}{dry}", config.robot.topic.replace('/', "-"));
    let broker = args.broker.broker(&config.mqtt, client)?;
    let mut show = |topic: &str, payload: &str| {
        let line = serde_json::json!({ "topic": topic, "payload": payload });
        let mut out = std::io::stdout().lock();
        writeln!(out, "{line}").and_then(|()| out.flush())
    };
    let way = if config.robot.obey { Way::Obey } else { Way::Show(&mut show) };
    if !config.robot.obey {
        super::tell(format_args!("roomcast: a dry run: what the robot would be told is printed; --obey tells it"));
    }
    vacuum::run(&config, &domain, &broker, way, &stop).map_err(|error| match error {
        DriveError::Mqtt(error) => broker::failure(error),
        DriveError::Ipc(_) => Failure::ipc(error),
        DriveError::Name(_) | DriveError::NoStay => Failure::config(error),
        _ => Failure::failed(error),
    })
}
