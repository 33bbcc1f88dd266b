//! The paper's informed avoidance.

use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, check, partition_id, uniform};

/// The paper's informed avoidance: uniform over all rooms except the one with the greatest score. Among several greatest, the excluded one is drawn
/// by chance; a single room is kept.
#[derive(Debug, Clone, Copy, Default)]
pub struct InformedAvoidance;

impl Policy for InformedAvoidance {
    fn name(&self) -> PolicyName {
        PolicyName::InformedAvoidance
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let greatest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let tied: Vec<usize> = (0..scores.len()).filter(|p| scores[*p] == greatest).collect();
        let avoided = uniform(&tied, rng);
        let open: Vec<usize> = state.open(scores.len()).collect();
        let others: Vec<usize> = open.iter().copied().filter(|p| open.len() == 1 || Some(*p) != avoided).collect();
        let partition = uniform(&others, rng).ok_or(PolicyError::NoPartitions)?;
        Ok(Choice {
            partition: partition_id(partition),
            reason: "any room but the likeliest to be occupied".to_owned(),
        })
    }
}
