//! The predictors that are compared, and those that need no habits.

use super::chains::Chain;
use super::{CHAINS, FLOOR};
use roomcast_core::ids::PersonId;

pub(super) const PERSON: PersonId = PersonId(0);
pub(super) const MIXTURE: usize = 0;
pub(super) const MODEL: usize = 1;
pub(super) const STAY: usize = 3;
pub(super) const PERSISTENCE: usize = 4;
pub(super) const WITHOUT_MODEL: usize = 9;

/// Chains of one kind of symbols, and the counts of the predictors that never expect a move.
pub(super) struct Others {
    pub(super) chains: [Chain; CHAINS.len()],
    pub(super) stayed: f64,
    pub(super) turned: f64,
}

impl Others {
    pub(super) fn new() -> Self {
        Self { chains: CHAINS.map(|(_, style)| Chain::new(style)), stayed: 1.0, turned: 2.0 }
    }
}

pub(super) fn normalise(p: &mut [f64]) {
    let total: f64 = p.iter().map(|p| p + FLOOR).sum();
    p.iter_mut().for_each(|p| *p = (*p + FLOOR) / total);
}
