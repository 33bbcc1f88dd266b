//! `roomcast planner`: the service that decides where the robot goes.

use super::{CommandResult, Failure, service};
use roomcast_core::policy::PolicyName;
use roomcast_services::{logging, planner};

use crate::exit_code;

/// Arguments of `roomcast planner`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The robot's name, in place of the configuration's.
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// The policy, in place of the configuration's.
    #[arg(long, value_name = "POLICY")]
    policy: Option<PolicyName>,
    /// The seed of its random choices, in place of the configuration's.
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Seconds of work in every room, in place of the configuration's.
    #[arg(long, value_name = "SECONDS")]
    room_time: Option<f64>,
    /// Seconds from the begin of a round to its deadline, in place of the configuration's.
    #[arg(long, value_name = "SECONDS")]
    round: Option<f64>,
}

/// Runs the planner until it is asked to stop.
///
/// # Errors
///
/// When the configuration is malformed or a service cannot be opened.
pub fn run(args: &Args) -> CommandResult {
    let stop = service::stop()?;
    let _log = logging::init();
    let (mut config, domain) = args.service.load()?;
    let planned = &mut config.planner;
    if let Some(robot) = &args.robot {
        planned.robot.clone_from(robot);
    }
    planned.policy = args.policy.unwrap_or(planned.policy);
    planned.seed = args.seed.unwrap_or(planned.seed);
    planned.room_time_s = args.room_time.unwrap_or(planned.room_time_s);
    planned.round_s = args.round.or(planned.round_s);
    config.check().map_err(|error| Failure::new(exit_code::CONFIG, error))?;
    planner::run(&config, &domain, &stop).map_err(|error| Failure::new(exit_code::IPC, error))
}
