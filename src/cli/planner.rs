//! `roomcast planner`: arguments and start.

use std::path::PathBuf;

use super::choice::{self, choice};
use super::{CommandResult, Failure, ranges, service};
use roomcast_core::policy::PolicyName;
use roomcast_services::config::{Forced, PlannerConfig, Reports};
use roomcast_services::planner;

#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    service: service::Args,
    /// The robot's name, in place of the configuration's.
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// The policy, in place of the configuration's.
    #[arg(long, value_name = "POLICY", value_parser = choice::policy())]
    policy: Option<PolicyName>,
    /// The seed of its random choices, in place of the configuration's.
    #[arg(long, value_name = "N", value_parser = ranges::any())]
    seed: Option<u64>,
    /// Seconds of work in every room, in place of the configuration's; 0 decides with every new score.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::time_s)]
    room_time: Option<f64>,
    /// Seconds from the beginning of a round to its deadline, in place of the configuration's; a round takes one stay at least.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::positive)]
    round: Option<f64>,
    /// Longest wait in seconds until each resident was observed, in place of the configuration's; 0 does not wait.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::time_s)]
    know: Option<f64>,
    /// What to do if a room is occupied and the deadline leaves no later time for it, in place of the configuration's.
    #[arg(long, value_name = "HOW", value_parser = choice::<Forced>())]
    forced: Option<Forced>,
    /// Whether to avoid rooms that are in a person's room set at any time of the stay, in place of the configuration's.
    #[arg(long, value_name = "BOOL")]
    avoid_sets: Option<bool>,
    /// Whether the robot's work ends when a person comes into its room, in place of the configuration's.
    #[arg(long, value_name = "BOOL")]
    interrupt: Option<bool>,
    /// Seconds for which the person must be there before that, in place of the configuration's.
    #[arg(long, value_name = "SECONDS", value_parser = ranges::time_s)]
    interrupt_after: Option<f64>,
    /// Which reports of done work count, in place of the configuration's.
    #[arg(long, value_name = "WHOSE", value_parser = choice::<Reports>())]
    reports: Option<Reports>,
    /// The daemon's scene file, in place of the configuration's: the robot's positions are placed on it.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
}

impl Args {
    fn apply(&self, planned: &mut PlannerConfig) -> Result<(), String> {
        service::replace(&mut planned.robot, &self.robot);
        planned.policy = self.policy.unwrap_or(planned.policy);
        planned.seed = self.seed.unwrap_or(planned.seed);
        planned.room_time_s = self.room_time.unwrap_or(planned.room_time_s);
        planned.round_s = self.round.or(planned.round_s);
        planned.know_s = self.know.unwrap_or(planned.know_s);
        planned.forced = self.forced.unwrap_or(planned.forced);
        planned.avoid_sets = self.avoid_sets.unwrap_or(planned.avoid_sets);
        planned.interrupt = self.interrupt.unwrap_or(planned.interrupt);
        planned.interrupt_after_s = self.interrupt_after.unwrap_or(planned.interrupt_after_s);
        planned.reports = self.reports.unwrap_or(planned.reports);
        let stay_s = planned.room_time_s;
        match planned.round_s.filter(|round_s| *round_s < stay_s) {
            Some(round_s) if self.round.is_some() || self.room_time.is_some() => {
                let name = |option, key, given| if given { option } else { key };
                let round = name("--round", "the configuration's planner.round_s", self.round.is_some());
                let stay = name("--room-time", "the configuration's planner.room_time_s", self.room_time.is_some());
                Err(format!(
                    "{round} is {round_s} s, less than a stay of {stay_s} s ({stay}): give a round of {stay_s} to 1000000000 s, or \
                     shorter stays"
                ))
            }
            _ => Ok(()),
        }
    }
}

pub fn run(args: &Args) -> CommandResult {
    let (stop, _log, mut config, domain) = args.service.begin()?;
    args.apply(&mut config.planner).map_err(Failure::usage)?;
    config.scene.path = args.scene.clone().or(config.scene.path);
    config.check()?;
    planner::run(&config, &domain, &stop).map_err(Failure::ipc)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn a_round_that_is_too_short_is_named_by_whoever_gave_it() {
        let apply = |line: &[&str]| {
            let line = Line::try_parse_from([&["planner"], line].concat()).map_err(|error| error.to_string())?;
            line.args.apply(&mut PlannerConfig::default())
        };
        let short = apply(&["--round", "10"]).unwrap_err();
        assert!(
            short.starts_with("--round is 10 s, less than a stay of 600 s (the configuration's planner.room_time_s)")
        );
        assert!(short.contains("give a round of 600 to 1000000000 s"), "{short}");
        let both = apply(&["--round", "10", "--room-time", "20"]).unwrap_err();
        assert!(both.contains("a stay of 20 s (--room-time)"), "{both}");
        apply(&["--round", "30", "--room-time", "20"]).unwrap();
        for (option, value) in [("--round", "nan"), ("--round", "0"), ("--room-time", "nan"), ("--forced", "maybe")] {
            let error = apply(&[option, value]).unwrap_err();
            assert!(error.contains(option), "{error}");
        }
    }
}
