//! Policies: the next room of a free robot, given the rooms' scores. Policies are pure; randomness comes only from the given generator.
//!
//! One file per policy. A room is a partition of the grounding, by index.

use std::fmt;
use std::str::FromStr;

use rand::{Rng, RngExt};

use crate::semantic_map::PartitionId;

mod coverage_aware;
mod greedy_avoidance;
mod informed_avoidance;
mod naive;
mod uncovered_first;

pub use coverage_aware::{
    CoverageAware, DP_PARTITIONS_MAX, Plan, WEIGHT_DEFAULT_S, WEIGHT_DEFAULT_SLOTS, WEIGHT_DEFAULT_STAY, plan,
};
pub use greedy_avoidance::GreedyAvoidance;
pub use informed_avoidance::InformedAvoidance;
pub use naive::Naive;
pub use uncovered_first::UncoveredFirst;

/// The state of a robot that is about to choose.
#[derive(Debug, Clone, Copy, Default)]
pub struct RobotState<'a> {
    /// Per partition: the robot's work there is finished.
    pub covered: &'a [bool],
    /// Per partition: the robot must not go there now, for example because a person has just entered. Empty if all are open.
    pub closed: &'a [bool],
    /// T_r: the length of a slot in seconds. The robot does one partition per slot.
    pub room_time_s: f64,
    /// Expected time that robot and person share each partition in each remaining slot, in seconds: slots x partitions, slot by slot. Empty without a
    /// forecast or a horizon.
    pub expected_shared_s: &'a [f64],
    /// Per partition: factor on the price of leaving it undone. Empty if all are equal.
    pub weights: &'a [f64],
}

/// A decision with its reason.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The partition to go to.
    pub partition: PartitionId,
    /// The reason in words. It names no room, because the policy knows only indices.
    pub reason: String,
}

/// A failure to decide.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PolicyError {
    /// There is no partition, or all are closed.
    #[error("there is no partition to choose from: the scene needs at least one room that is not closed to the robot")]
    NoPartitions,
    /// Inputs have different sizes.
    #[error(
        "{what} has {found} entries where {expected} were expected: scores and robot state must come from the same map"
    )]
    Shape {
        /// The input.
        what: &'static str,
        /// Its number of entries.
        found: usize,
        /// The expected number of entries.
        expected: usize,
    },
    /// A score is NaN.
    #[error("the score of partition {partition} is no number: the scores cannot be compared")]
    NotANumber {
        /// Index of the partition.
        partition: usize,
    },
    /// There is no policy of this name.
    #[error("unknown policy `{name}`: known are {}", PolicyName::ALL.map(PolicyName::as_str).join(", "))]
    Unknown {
        /// The given name.
        name: String,
    },
}

impl RobotState<'_> {
    /// Whether the robot may go to a partition now.
    #[must_use]
    pub fn is_open(&self, partition: usize) -> bool {
        !self.closed.get(partition).copied().unwrap_or(false)
    }

    /// Open partitions among the first `partitions`.
    fn open(&self, partitions: usize) -> impl Iterator<Item = usize> + Clone {
        (0..partitions).filter(|partition| self.is_open(*partition))
    }
}

/// Chooses the next partition.
pub trait Policy: fmt::Debug + Send {
    /// The policy's name on the command line.
    fn name(&self) -> PolicyName;

    /// Chooses an open partition among `scores.len()`. A greater score is a likelier presence of the person (S_j of Equation 3 or its normalised
    /// probability: the paper's policies use only the order).
    ///
    /// # Errors
    /// [`PolicyError`] if there is no partition to choose from, or the inputs do not fit together.
    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError>;
}

/// The policies, by their names on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PolicyName {
    /// [`Naive`], the paper's baseline.
    Naive,
    /// [`InformedAvoidance`] of the paper.
    InformedAvoidance,
    /// [`GreedyAvoidance`] of the paper.
    GreedyAvoidance,
    /// [`UncoveredFirst`].
    UncoveredFirst,
    /// [`CoverageAware`].
    CoverageAware,
}

impl PolicyName {
    /// All policies, the paper's first.
    pub const ALL: [Self; 5] =
        [Self::Naive, Self::InformedAvoidance, Self::GreedyAvoidance, Self::UncoveredFirst, Self::CoverageAware];

    /// The name on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Naive => "naive",
            Self::InformedAvoidance => "informed-avoidance",
            Self::GreedyAvoidance => "greedy-avoidance",
            Self::UncoveredFirst => "uncovered-first",
            Self::CoverageAware => "coverage-aware",
        }
    }

    /// Creates the policy; coverage-aware gets its default weight.
    #[must_use]
    pub fn policy(self) -> Box<dyn Policy> {
        match self {
            Self::Naive => Box::new(Naive),
            Self::InformedAvoidance => Box::new(InformedAvoidance),
            Self::GreedyAvoidance => Box::new(GreedyAvoidance),
            Self::UncoveredFirst => Box::new(UncoveredFirst),
            Self::CoverageAware => Box::new(CoverageAware::new(None)),
        }
    }
}

impl fmt::Display for PolicyName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl FromStr for PolicyName {
    type Err = PolicyError;

    fn from_str(name: &str) -> Result<Self, PolicyError> {
        Self::ALL
            .into_iter()
            .find(|policy| policy.as_str() == name)
            .ok_or_else(|| PolicyError::Unknown { name: name.to_owned() })
    }
}

/// Checks the inputs: at least one open partition, scores that are numbers, equal sizes.
fn check(state: &RobotState<'_>, scores: &[f64]) -> Result<(), PolicyError> {
    if state.open(scores.len()).next().is_none() {
        return Err(PolicyError::NoPartitions);
    }
    if let Some(partition) = scores.iter().position(|score| score.is_nan()) {
        return Err(PolicyError::NotANumber { partition });
    }
    if state.covered.len() != scores.len() {
        return Err(PolicyError::Shape { what: "covered", found: state.covered.len(), expected: scores.len() });
    }
    if !state.closed.is_empty() && state.closed.len() != scores.len() {
        return Err(PolicyError::Shape { what: "closed", found: state.closed.len(), expected: scores.len() });
    }
    if !state.expected_shared_s.len().is_multiple_of(scores.len()) {
        return Err(PolicyError::Shape {
            what: "the forecast's last slot",
            found: state.expected_shared_s.len() % scores.len(),
            expected: scores.len(),
        });
    }
    Ok(())
}

/// The index of a partition as an id. Grounding bounds the number of partitions far below 2^32.
fn partition_id(index: usize) -> PartitionId {
    PartitionId(u32::try_from(index).unwrap_or(u32::MAX))
}

/// Uniform over the given partitions. Always draws once, so that paired runs stay paired.
fn uniform(partitions: &[usize], rng: &mut dyn Rng) -> Option<usize> {
    let draw: f64 = rng.random();
    // The product may round up to the length itself.
    let index = ((draw * partitions.len() as f64) as usize).min(partitions.len().saturating_sub(1));
    partitions.get(index).copied()
}

fn least(candidates: impl Iterator<Item = usize> + Clone, scores: &[f64]) -> Vec<usize> {
    let best = candidates.clone().map(|p| scores[p]).fold(f64::INFINITY, f64::min);
    candidates.filter(|p| scores[*p] == best).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn shares(name: PolicyName, covered: &[bool], scores: &[f64]) -> Vec<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut policy = name.policy();
        let state = RobotState { covered, room_time_s: 60.0, ..RobotState::default() };
        let mut counts = vec![0.0; scores.len()];
        for _ in 0..20_000 {
            counts[policy.choose(&state, scores, &mut rng).unwrap().partition.0 as usize] += 1.0 / 20_000.0;
        }
        counts
    }

    fn assert_shares(name: PolicyName, covered: &[bool], scores: &[f64], expected: &[f64]) {
        let found = shares(name, covered, scores);
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 0.02, "{name}: {found} instead of {expected}");
        }
    }

    #[test]
    fn each_policy_chooses_as_defined() {
        let (none, some) = ([false; 4], [true, false, false, true]);
        let scores = [0.1, 0.5, 0.3, 0.1];
        assert_shares(PolicyName::Naive, &some, &scores, &[0.25; 4]);
        assert_shares(PolicyName::GreedyAvoidance, &some, &scores, &[0.5, 0.0, 0.0, 0.5]);
        assert_shares(PolicyName::InformedAvoidance, &some, &scores, &[1.0 / 3.0, 0.0, 1.0 / 3.0, 1.0 / 3.0]);
        assert_shares(PolicyName::UncoveredFirst, &some, &scores, &[0.0, 0.0, 1.0, 0.0]);
        assert_shares(PolicyName::UncoveredFirst, &none, &scores, &[0.5, 0.0, 0.0, 0.5]);
        assert_shares(PolicyName::UncoveredFirst, &[true; 4], &scores, &[0.5, 0.0, 0.0, 0.5]);
        assert_shares(PolicyName::CoverageAware, &some, &scores, &[0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn ties_and_single_rooms_are_no_trap() {
        assert_shares(PolicyName::InformedAvoidance, &[false; 2], &[0.5, 0.5], &[0.5, 0.5]);
        assert_shares(PolicyName::InformedAvoidance, &[false], &[1.0], &[1.0]);
        assert_shares(PolicyName::GreedyAvoidance, &[false; 2], &[f64::NEG_INFINITY; 2], &[0.5, 0.5]);
    }

    #[test]
    fn faults_are_named() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut choose = |covered: &[bool], expected_shared_s: &[f64], scores: &[f64]| {
            let state = RobotState { covered, room_time_s: 60.0, expected_shared_s, ..RobotState::default() };
            Naive.choose(&state, scores, &mut rng).unwrap_err().to_string()
        };
        assert!(choose(&[], &[], &[]).contains("at least one room"));
        assert!(choose(&[true], &[], &[0.1, 0.2]).contains("covered has 1 entries where 2"));
        assert!(choose(&[true; 2], &[0.0; 3], &[0.1, 0.2]).contains("forecast"));
        assert!(choose(&[true; 2], &[], &[0.1, f64::NAN]).contains("partition 1 is no number"));
        assert!("greedy".parse::<PolicyName>().unwrap_err().to_string().contains("greedy-avoidance"));
    }

    proptest! {
        #[test]
        fn the_choice_is_always_a_partition(
            scores in prop::collection::vec(prop_oneof![Just(f64::NEG_INFINITY), -10.0..10.0f64], 1..20),
            slots in 0usize..5, seed: u64,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let covered: Vec<bool> = scores.iter().map(|_| rng.random()).collect();
            let expected: Vec<f64> = (0..slots * scores.len()).map(|_| rng.random()).collect();
            let mut closed: Vec<bool> = scores.iter().map(|_| rng.random()).collect();
            closed[0] &= closed.contains(&false) && scores.len() > 1;
            let state = RobotState {
                covered: &covered, closed: &closed, room_time_s: 60.0, expected_shared_s: &expected, ..RobotState::default()
            };
            for name in PolicyName::ALL {
                prop_assert_eq!(name.as_str().parse::<PolicyName>(), Ok(name));
                let choice = name.policy().choose(&state, &scores, &mut rng).unwrap();
                prop_assert!((choice.partition.0 as usize) < scores.len() && !closed[choice.partition.0 as usize]);
            }
            let all_closed = RobotState { closed: &vec![true; scores.len()], ..state };
            prop_assert_eq!(Naive.choose(&all_closed, &scores, &mut rng), Err(PolicyError::NoPartitions));
        }
    }
}
