//! The next thing: whether the last one is mentioned again, and which other one comes if not.
//!
//! | expert | source for another thing | for the same one |
//! | --- | --- | --- |
//! | model | the language model's probabilities | its probability of the last thing |
//! | habit | the things that followed the last things here, over the model | how often the last thing was mentioned so often, after the same things |
//! | hour | the things that followed the last thing at this part of the day | |
//! | share | | how often any thing is mentioned again |
//! | product | the others multiplied ([`super::pool`]) | |
//!
//! A thing that is mentioned again and again is one thing of the context, and so are sentences about nothing that the map has.

use super::counts::Counts;
use super::key::{self, Kind, NONE, key, with_times};
use super::mixture::FixedShare;
use super::moment;
use super::parts::{Expert, Without};
use super::pool::Pool;
use super::whose::View;

/// Experts: model, habit, hour and product.
const PRIOR: [f64; 4] = [0.15, 0.08, 0.06, 0.71];
/// The model's first weight: a first day with few things is no worse than the model alone.
pub(crate) const FIRST: f64 = 0.9;
const POWERS: [f64; 3] = [0.65, 0.3, 0.1];
/// First weights of the experts for a repeated mention: model, habit and share.
pub(crate) const AGAIN_PRIOR: [f64; 3] = [0.5, 0.3, 0.2];
pub(crate) const SHARE: f64 = 0.005;

/// Contexts of the next thing: number of last things, and observations that the shorter context is worth.
const AFTER: [(Kind, usize, f64); 6] = [
    (Kind::Object0, 0, 4.0),
    (Kind::Object1, 1, 2.0),
    (Kind::Object2, 2, 1.0),
    (Kind::Object3, 3, 0.5),
    (Kind::Object4, 4, 0.25),
    (Kind::Object5, 5, 0.25),
];
/// Things of the longest context.
const LAST: usize = 5;
/// As `AFTER`: at this part of the day, and after the last thing at this part of the day.
const HOUR_CONCENTRATIONS: [f64; 2] = [20.0, 1.0];
const DISCOUNT: f64 = 0.3;
const HOUR_DISCOUNT: f64 = 0.5;
/// Contexts of repeated mentions.
const AGAIN: [(Kind, usize, f64); 4] =
    [(Kind::Again0, 0, 2.0), (Kind::Again1, 1, 1.0), (Kind::Again2, 2, 0.7), (Kind::Again3, 3, 0.5)];
const OTHER: u16 = 0;
const SAME: u16 = 1;
/// Smaller probabilities are raised to this.
const FLOOR: f64 = 1e-6;

#[derive(Debug, Clone)]
pub(crate) struct Things {
    /// The last different things, the latest first, and the number of repeated mentions of the latest.
    last: [u16; LAST],
    pub(crate) times: u8,
    pub(crate) pool: Pool<4, 3>,
    pub(crate) again: FixedShare<3>,
    /// Repeated mentions, and all mentions.
    pub(crate) repeated: [f64; 2],
    /// Time of the latest forecast; the next thing is counted for its hour.
    at_s: f64,
    /// The index of the last thing, and each expert's probability that it is mentioned again.
    same: Option<usize>,
    said_again: [f64; 3],
    /// The model's share of habit and hour.
    kept: [f64; 2],
    pub(crate) observations: [f64; 4],
    /// Per thing of the map its probability in the latest forecast.
    pub(crate) mixed: Vec<f64>,
}

fn after(last: &[u16; LAST], things: usize) -> [u16; 3] {
    match things {
        0..=3 => std::array::from_fn(|at| if at < things { last[at] } else { NONE }),
        _ => key::digest(&last[..things]),
    }
}

impl Things {
    pub(crate) fn new(without: Without) -> Self {
        let uses = |expert: Expert| without.uses(expert as u8);
        let experts = [true, uses(Expert::ThingHabit), uses(Expert::ThingHour), uses(Expert::ThingProduct)];
        Self {
            last: [NONE; LAST],
            times: 0,
            pool: Pool::new(FIRST, PRIOR, POWERS, experts),
            again: FixedShare::new(FixedShare::of(
                AGAIN_PRIOR,
                [true, uses(Expert::AgainHabit), uses(Expert::AgainShare)],
            )),
            repeated: [1.0, 2.0],
            at_s: 0.0,
            same: None,
            said_again: [0.0; 3],
            kept: [1.0; 2],
            observations: [0.0; 4],
            mixed: Vec::new(),
        }
    }

    /// Drops the latest forecast, so that nothing is learned from it.
    pub(crate) fn forget_forecast(&mut self) {
        self.pool.forget();
        self.mixed.clear();
    }

    pub(crate) fn forget_number(&mut self, number: u16) {
        self.last.iter_mut().filter(|last| **last == number).for_each(|last| *last = NONE);
    }

    pub(crate) fn last_three(&self) -> [u16; 3] {
        [self.last[0], self.last[1], self.last[2]]
    }

    /// Forecasts the next thing. The model's probabilities need not sum to one.
    pub(crate) fn forecast(&mut self, view: View<'_>, at_s: f64, model: &[f64]) {
        let width = model.len();
        let last = self.last[0];
        (self.at_s, self.same) = (at_s, view.home.things.index(last).filter(|thing| *thing < width));
        let index = |number| if number == last { None } else { view.home.things.index(number) };
        let [own, habit, hour] = self.pool.begin(width, self.same);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOOR));
        let total: f64 = own.iter().sum();
        let again_by_model = self.same.map_or(0.0, |same| std::mem::take(&mut own[same]) / total);
        let others: f64 = own.iter().sum();
        own.iter_mut().for_each(|own| *own /= others.max(f64::MIN_POSITIVE));
        habit.copy_from_slice(own);
        let mut kept = 1.0;
        self.observations = [0.0; 4];
        for (kind, things, concentration) in AFTER {
            let (left, seen) = view.smooth((kind, after(&self.last, things)), (DISCOUNT, concentration), index, habit);
            kept *= left;
            if let Some(own) = self.observations.get_mut(things) {
                *own = seen;
            }
            if things == 1 {
                hour.copy_from_slice(habit);
                self.kept[1] = kept;
            }
        }
        self.kept[0] = kept;
        let part = moment::part_of_day(at_s, 3);
        self.kept[1] *=
            view.smooth((Kind::ObjectHour, [part, NONE, NONE]), (HOUR_DISCOUNT, HOUR_CONCENTRATIONS[0]), index, hour).0;
        self.kept[1] *= view
            .smooth((Kind::ObjectAfterHour, [last, part, NONE]), (HOUR_DISCOUNT, HOUR_CONCENTRATIONS[1]), index, hour)
            .0;
        self.pool.forecast();
        let again = match self.same {
            Some(_) if others > 0.0 => {
                let [repeated, turned] = self.repeated;
                self.said_again = [again_by_model, self.again_by_habit(view), repeated / turned];
                self.said_again.iter_mut().for_each(|p| *p = p.clamp(FLOOR, 1.0 - FLOOR));
                self.again.mix(&self.said_again)
            }
            same => f64::from(u8::from(same.is_some())),
        };
        self.mixed.clear();
        self.mixed.extend(self.pool.mixed.iter().map(|p| (1.0 - again) * p));
        if let Some(same) = self.same {
            self.mixed[same] = again;
        }
    }

    /// Probability of a repeated mention, after the same things and as many mentions.
    fn again_by_habit(&self, mut view: View<'_>) -> f64 {
        view.times = self.times;
        let mut p = self.repeated[0] / self.repeated[1];
        for (kind, things, concentration) in AGAIN {
            for (seen, strength) in view.seen(kind, after(&self.last, things)) {
                let (same, total) = seen.symbols().fold((0.0, 0.0), |(same, total), (symbol, count)| {
                    (same + if symbol == SAME { count } else { 0.0 }, total + count)
                });
                p = (same + strength * concentration * p) / (total + strength * concentration);
            }
        }
        p
    }

    /// The shares of model, habit and hour in a thing's probability in the latest forecast.
    pub(crate) fn explain(&self, thing: usize) -> Option<[f64; 3]> {
        if *self.mixed.get(thing)? <= 0.0 {
            return None;
        }
        if self.same == Some(thing) {
            let total = self.again.mix(&self.said_again);
            let of_model = if total > 0.0 { self.again.weights()[0] * self.said_again[0] / total } else { 1.0 / 3.0 };
            return Some([of_model, 1.0 - of_model, 0.0]);
        }
        let parts = self.pool.parts(thing);
        let of_model =
            |row: usize| (self.kept[row - 1] * self.pool.given(0, thing) / self.pool.given(row, thing)).min(1.0);
        let [habit, hour] = [1, 2].map(|row| parts[row] * (1.0 - of_model(row)));
        Some([1.0 - habit - hour, habit, hour])
    }

    /// Learns from the outcome: the person turned to `thing`.
    pub(crate) fn learn_weights(&mut self, thing: usize) {
        if thing >= self.pool.width() {
            return;
        }
        if self.same.is_some() && self.pool.width() > 1 {
            let is_same = self.same == Some(thing);
            self.repeated[1] += 1.0;
            self.repeated[0] += f64::from(u8::from(is_same));
            self.again.learn(&self.said_again.map(|p| if is_same { p } else { 1.0 - p }), SHARE, 1.0);
        }
        if self.same != Some(thing) {
            self.pool.learn(thing, SHARE);
        }
    }

    pub(crate) fn count(&self, counts: &mut Counts, slot: u8, number: u16, at_s: f64) {
        let now_min = moment::minute(at_s);
        let last = self.last[0];
        if last != NONE {
            let same = if number == last { SAME } else { OTHER };
            for (kind, things, _) in AGAIN {
                counts.add(key(kind, with_times(slot, self.times), after(&self.last, things)), same, 1.0, now_min);
            }
        }
        if number == last {
            return;
        }
        for (kind, things, _) in AFTER {
            counts.add(key(kind, slot, after(&self.last, things)), number, 1.0, now_min);
        }
        let part = moment::part_of_day(if self.pool.width() > 0 { self.at_s } else { at_s }, 3);
        counts.add(key(Kind::ObjectHour, slot, [part, NONE, NONE]), number, 1.0, now_min);
        counts.add(key(Kind::ObjectAfterHour, slot, [last, part, NONE]), number, 1.0, now_min);
    }

    /// Adds a thing, or an unmapped one (`None`), to the context.
    pub(crate) fn turn(&mut self, number: Option<u16>) {
        let number = number.unwrap_or(NONE);
        if number == self.last[0] {
            self.times = if number == NONE { 0 } else { self.times.saturating_add(1) };
            return;
        }
        self.times = 0;
        self.last.rotate_right(1);
        self.last[0] = number;
    }
}
