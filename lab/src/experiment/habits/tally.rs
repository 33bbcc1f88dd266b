//! Sums of losses by predictor, target and day.

use super::super::losses::Sums;
use super::{Days, HALF, TARGETS, UNSEEN};

/// Sums of losses by predictor, target and day: of all cases, and of cases in new activities.
pub(super) struct Tally {
    sums: Vec<Vec<Sums>>,
    unseen: Vec<Vec<Sums>>,
}

impl Tally {
    pub(super) fn new(predictors: usize) -> Self {
        let none = vec![Vec::new(); predictors * TARGETS.len()];
        Self { sums: none.clone(), unseen: none }
    }

    /// The sums of a stretch of days, of all in which anything was measured.
    pub(super) fn stretch(&self, predictor: usize, target: usize, day: Days) -> Vec<Sums> {
        let of = if day == UNSEEN { &self.unseen } else { &self.sums };
        let mut sums = of[predictor * TARGETS.len() + target].clone();
        sums.resize(self.days(), Sums::default());
        match day {
            Days::One(day) => vec![sums[day - 1]],
            HALF => sums.split_off(self.days() / 2),
            Days::Some(_) => sums,
        }
    }

    pub(super) fn days(&self) -> usize {
        self.sums.iter().map(Vec::len).max().unwrap_or(0)
    }

    pub(super) fn add(
        &mut self,
        predictor: usize,
        target: usize,
        (day, unseen): (usize, bool),
        p: &[f64],
        truth: usize,
    ) {
        for (sums, counts) in [(&mut self.sums, true), (&mut self.unseen, unseen)] {
            let days = &mut sums[predictor * TARGETS.len() + target];
            if days.len() <= day {
                days.resize(day + 1, Sums::default());
            }
            if counts {
                days[day].add(p, truth);
            }
        }
    }
}
