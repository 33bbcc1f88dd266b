//! The least score among the rooms still to do.

use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, check, least, partition_id, uniform};

/// The least score among the rooms still to do; among all rooms if everything is done. Ties by chance.
#[derive(Debug, Clone, Copy, Default)]
pub struct UncoveredFirst;

impl Policy for UncoveredFirst {
    fn name(&self) -> PolicyName {
        PolicyName::UncoveredFirst
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let open = state.open(scores.len());
        let all_done = open.clone().all(|p| state.covered[p]);
        let best = least(open.filter(|p| all_done || !state.covered[*p]), scores);
        let partition = uniform(&best, rng).ok_or(PolicyError::NoPartitions)?;
        let reason = if !all_done {
            "least likely to be occupied of the rooms still to do"
        } else if state.covered.iter().all(|done| *done) {
            "all rooms are done: least likely to be occupied"
        } else {
            "waits in a room that is done: least likely to be occupied"
        };
        Ok(Choice { partition: partition_id(partition), reason: reason.to_owned() })
    }
}
