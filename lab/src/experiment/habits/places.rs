//! Later places: once a minute a forecast of each horizon, scored and learned from when it is due.

use super::cleaning::{Cleaning, STAY_S, Sight};
use super::predictors::{PERSON, normalise};
use super::watch::Watch;
use super::{HORIZONS_S, OUT_S, ROOM_AT};
use roomcast_core::forecast::Forecaster;
use roomcast_core::habits::Habits;
use roomcast_simulation::trace::Trace;

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
