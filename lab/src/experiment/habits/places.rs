//! Later places: once a minute a forecast of each horizon, scored and learned from when it is due.

use std::collections::VecDeque;

use super::cleaning::{Cleaning, STAY_S, Sight};
use super::report::Tally;
use super::watch::{MIXTURE, MODEL, Others, PERSISTENCE, PERSON, STAY, WITHOUT_MODEL, Watch, normalise, staying};
use super::{CHAINS, HORIZONS_S, OUT_S, PREDICTORS, ROOM_AT};
use roomcast_core::forecast::Forecaster;
use roomcast_core::habits::{AdaptiveSets, Habits, Issued, SetOptions};
use roomcast_simulation::trace::Trace;

/// A forecast of places before its outcome.
pub(super) struct Waiting {
    due_s: f64,
    day: usize,
    place: u32,
    before: Vec<u32>,
    predicted: Vec<Vec<f64>>,
    issued: [Issued; 3],
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
    pub(super) fn all(sets: SetOptions) -> Vec<Self> {
        let promise = |never_empty| AdaptiveSets::new(SetOptions { never_empty, ..sets });
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
    fn settle(&mut self, now_s: f64, target: usize, trace: &Trace, tally: &mut Tally) {
        while self.waiting.front().is_some_and(|waiting| waiting.due_s <= now_s) {
            let Some(waiting) = self.waiting.pop_front() else { break };
            let Some((_, truth)) = trace.place_at(waiting.due_s) else { continue };
            for (predictor, p) in waiting.predicted.iter().enumerate() {
                tally.add(predictor, target, (waiting.day, false), p, truth);
            }
            let [mixture, shipped] = [MIXTURE, MODEL].map(|predictor| &waiting.predicted[predictor]);
            for (which, p) in [mixture, shipped, mixture].into_iter().enumerate() {
                let mut set = Vec::new();
                self.sets[which].set(p, waiting.issued[which], &mut set);
                self.held[which] += f64::from(u8::from(set[truth]));
                self.size[which] += set.iter().filter(|held| **held).count() as f64;
                self.sets[which].learn(p, waiting.issued[which], truth);
            }
            self.moments += 1.0;
            self.others.turned += 1.0;
            self.others.stayed += f64::from(u8::from(truth == waiting.place as usize));
            self.others.chains.iter_mut().for_each(|chain| chain.learn(&waiting.before, truth));
        }
    }

    /// Keeps a forecast of each predictor; `mixtures` has those of the mixture, without the model, and of the reduced mixtures.
    fn expect(
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
        let issued = std::array::from_fn(|which| self.sets[which].issue());
        self.waiting.push_back(Waiting { due_s, day, place: here as u32, before: before.to_vec(), predicted, issued });
    }
}

/// The forecast of places without habits.
struct Shipped<'a> {
    forecaster: &'a mut Forecaster,
    now_s: f64,
    out_since_s: Option<f64>,
    places: usize,
}

impl Shipped<'_> {
    fn write(&mut self, horizon_s: f64, p: &mut [f64]) {
        let home = self.out_since_s.map_or(1.0, |since_s| {
            let scale_s = OUT_S + self.now_s - since_s;
            1.0 - (scale_s / (scale_s + horizon_s)).powi(2)
        });
        p.iter_mut().zip(self.forecaster.at(self.now_s, horizon_s)).for_each(|(p, own)| *p = home * own);
        p[self.places - 1] = 1.0 - home;
    }

    fn rows(&mut self, horizons_s: &[f64]) -> Vec<f64> {
        let mut rows = vec![0.0; horizons_s.len() * self.places];
        rows.chunks_exact_mut(self.places).zip(horizons_s).for_each(|(row, horizon_s)| self.write(*horizon_s, row));
        rows
    }

    /// A mixture's forecast.
    fn mixed(&mut self, habits: &mut Habits, horizons_s: &[f64]) -> Vec<f64> {
        let (mut rows, mut shares) = (Vec::new(), Vec::new());
        let shipped = self.rows(horizons_s);
        habits.at_times(PERSON, (self.now_s, horizons_s), &shipped, &mut rows, &mut shares);
        rows
    }

    /// Lets the robots begin their next stay.
    fn clean(&mut self, habits: &mut Habits, cleaning: &mut Cleaning, stays: usize, trace: &Trace) {
        let (places, now_s) = (self.places, self.now_s);
        let middles_s: Vec<f64> = (0..stays).map(|stay| (stay as f64 + 0.5) * STAY_S).collect();
        let (without, with) = (self.rows(&middles_s), self.mixed(habits, &middles_s));
        let in_rooms =
            |rows: &[f64]| rows.chunks_exact(places).flat_map(|row| row[..places - 1].to_vec()).collect::<Vec<_>>();
        // At the begin and at the end of the first stay.
        let mut in_set = vec![false; places];
        for ahead_s in [0.0, STAY_S] {
            let (p, mut set) = (self.mixed(habits, &[ahead_s]), Vec::new());
            habits.room_set(PERSON, ahead_s, &p, false, &mut set);
            in_set.iter_mut().zip(set).for_each(|(held, own)| *held |= own);
        }
        let sight = Sight { shipped: &in_rooms(&without), mixture: &in_rooms(&with), set: &in_set[..places - 1] };
        cleaning.stay((now_s, trace.day(now_s)), &sight, trace);
    }
}

impl Watch<'_> {
    /// Scores and learns the forecasts that are due, then forecasts later places.
    pub(super) fn moment(&mut self, now_s: f64, until_s: f64) {
        let Some((_, here)) = self.trace.place_at(now_s) else { return };
        let places = self.rooms + 1;
        let Self { mixture, without_model, reduced, forecaster, cleaning, horizons, tally, trace, .. } = self;
        let mut shipped = Shipped { forecaster, now_s, out_since_s: self.out_since_s, places };
        mixture.tick(PERSON, now_s, &mut |horizon_s, p| shipped.write(horizon_s, p));
        for habits in &mut *reduced {
            habits.tick(PERSON, now_s, &mut |horizon_s, p| shipped.write(horizon_s, p));
        }
        without_model.tick(PERSON, now_s, &mut |_, p| p.fill(1.0));
        if let Some(stays) = cleaning.stays_left(now_s, until_s) {
            shipped.clean(mixture, cleaning, stays, trace);
        }
        // Per mixture the probabilities at all horizons, row by row.
        let (mut of_even, mut shares) = (Vec::new(), Vec::new());
        let even = vec![1.0; HORIZONS_S.len() * places];
        without_model.at_times(PERSON, (now_s, &HORIZONS_S), &even, &mut of_even, &mut shares);
        let mut mixtures = vec![shipped.mixed(mixture, &HORIZONS_S), of_even];
        mixtures.extend(reduced.iter_mut().map(|habits| shipped.mixed(habits, &HORIZONS_S)));
        mixtures.iter_mut().flat_map(|rows| rows.chunks_exact_mut(places)).for_each(normalise);
        let all_shipped = shipped.rows(&HORIZONS_S);
        let day = trace.day(now_s);
        for (index, horizon) in horizons.iter_mut().enumerate() {
            horizon.settle(now_s, ROOM_AT + index, trace, tally);
            if now_s + horizon.horizon_s <= until_s {
                let rows: Vec<&[f64]> = mixtures.iter().map(|rows| &rows[index * places..][..places]).collect();
                horizon.expect((now_s, day), here, &self.places, &all_shipped[index * places..][..places], &rows);
            }
        }
    }
}
