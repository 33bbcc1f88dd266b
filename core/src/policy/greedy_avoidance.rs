//! The paper's greedy avoidance.

use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, check, least, partition_id, uniform};

/// The paper's greedy avoidance: the room with the least score, ties by chance. It may return to finished rooms.
#[derive(Debug, Clone, Copy, Default)]
pub struct GreedyAvoidance;

impl Policy for GreedyAvoidance {
    fn name(&self) -> PolicyName {
        PolicyName::GreedyAvoidance
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let best = least(state.open(scores.len()), scores);
        let partition = uniform(&best, rng).ok_or(PolicyError::NoPartitions)?;
        Ok(Choice { partition: partition_id(partition), reason: "least likely to be occupied".to_owned() })
    }
}
