//! The paper's naive baseline.

use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, check, partition_id, uniform};

/// The paper's baseline: uniform over all rooms, the present one included. It ignores the scores.
#[derive(Debug, Clone, Copy, Default)]
pub struct Naive;

impl Policy for Naive {
    fn name(&self) -> PolicyName {
        PolicyName::Naive
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let all: Vec<usize> = state.open(scores.len()).collect();
        let partition = uniform(&all, rng).ok_or(PolicyError::NoPartitions)?;
        Ok(Choice { partition: partition_id(partition), reason: "any room, by chance".to_owned() })
    }
}
