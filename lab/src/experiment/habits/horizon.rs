//! Forecasts of a later place that wait for the truth, and their room sets.

use super::super::baselines::staying;
use super::predictors::{MIXTURE, MODEL, Others, PERSISTENCE, STAY, WITHOUT_MODEL, normalise};
use super::tally::Tally;
use super::{CHAINS, HORIZONS_S, PREDICTORS};
use roomcast_core::habits::AdaptiveSets;
use roomcast_simulation::trace::Trace;
use std::collections::VecDeque;

/// A forecast of places before its outcome.
pub(super) struct Waiting {
    due_s: f64,
    day: usize,
    place: u32,
    before: Vec<u32>,
    predicted: Vec<Vec<f64>>,
    thresholds: [f64; 3],
}

/// One horizon: pending forecasts, other predictors, and sets.
pub(super) struct Horizon {
    pub(super) horizon_s: f64,
    pub(super) waiting: VecDeque<Waiting>,
    others: Others,
    sets: [AdaptiveSets; 3],
    pub(super) held: [f64; 3],
    pub(super) size: [f64; 3],
    pub(super) moments: f64,
}

impl Horizon {
    pub(super) fn all(coverage: f64) -> Vec<Self> {
        let promise = |never_empty| AdaptiveSets::new(coverage, never_empty);
        let horizon = |horizon_s| Self {
            horizon_s,
            waiting: VecDeque::new(),
            others: Others::new(),
            sets: [promise(false), promise(false), promise(true)],
            held: [0.0; 3],
            size: [0.0; 3],
            moments: 0.0,
        };
        HORIZONS_S.map(horizon).into()
    }

    /// Scores the forecasts that are due, and learns from them.
    pub(super) fn settle(&mut self, now_s: f64, target: usize, trace: &Trace, tally: &mut Tally) {
        while self.waiting.front().is_some_and(|waiting| waiting.due_s <= now_s) {
            let Some(waiting) = self.waiting.pop_front() else { break };
            let Some((_, truth)) = trace.place_at(waiting.due_s) else { continue };
            for (predictor, p) in waiting.predicted.iter().enumerate() {
                tally.add(predictor, target, (waiting.day, false), p, truth);
            }
            let [mixture, shipped] = [MIXTURE, MODEL].map(|predictor| &waiting.predicted[predictor]);
            for (which, p) in [mixture, shipped, mixture].into_iter().enumerate() {
                let mut set = Vec::new();
                self.sets[which].set(p, waiting.thresholds[which], &mut set);
                self.held[which] += f64::from(u8::from(set[truth]));
                self.size[which] += set.iter().filter(|held| **held).count() as f64;
                self.sets[which].learn(p[truth], waiting.thresholds[which]);
            }
            self.moments += 1.0;
            self.others.turned += 1.0;
            self.others.stayed += f64::from(u8::from(truth == waiting.place as usize));
            self.others.chains.iter_mut().for_each(|chain| chain.learn(&waiting.before, truth));
        }
    }

    /// Keeps a forecast of each predictor; `mixtures` has those of the mixture, without the model, and of the reduced mixtures.
    pub(super) fn expect(
        &mut self,
        (now_s, day): (f64, usize),
        here: usize,
        before: &[u32],
        shipped: &[f64],
        mixtures: &[&[f64]],
    ) {
        let places = shipped.len();
        let mut predicted = vec![Vec::new(); PREDICTORS.len()];
        predicted.extend(mixtures[2..].iter().map(|p| p.to_vec()));
        (predicted[MIXTURE], predicted[WITHOUT_MODEL]) = (mixtures[0].to_vec(), mixtures[1].to_vec());
        predicted[MODEL] = shipped.to_vec();
        normalise(&mut predicted[MODEL]);
        predicted[STAY] = staying(Some(here), 0.95, places);
        predicted[PERSISTENCE] = staying(Some(here), self.others.stayed / self.others.turned, places);
        for ((predictor, _), chain) in CHAINS.into_iter().zip(&self.others.chains) {
            predicted[predictor] = chain.predict(before, places);
            normalise(&mut predicted[predictor]);
        }
        let due_s = now_s + self.horizon_s;
        let thresholds = std::array::from_fn(|which| self.sets[which].threshold());
        self.waiting.push_back(Waiting {
            due_s,
            day,
            place: here as u32,
            before: before.to_vec(),
            predicted,
            thresholds,
        });
    }
}
