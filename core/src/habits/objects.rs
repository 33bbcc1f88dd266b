//! The next object: six forecasts, and which of them to believe.
//!
//! | expert | what it knows |
//! | --- | --- |
//! | model | the language model's probabilities |
//! | habit | what followed the last zero to three objects in this home, backed off to the base ([`super::smoothing`]) |
//! | short | the same of the last object alone |
//! | recency | what was turned to in this activity, over habit |
//! | hour | what was turned to at this part of the day, after the last object and at all, over habit |
//! | staying | what habit says of the things in the room where the person is |
//!
//! The base is the model mixed with even chances, by weights of its own: where the model is far off, a home is not to pay for it with
//! everything that is new. An object that is mentioned again and again is one object of the context, and how often it was counts as well.

use super::counts::Counts;
use super::frame::Frame;
use super::key::{Kind, NONE, key, with_times};
use super::mixture::FixedShare;
use super::moment;
use super::whose::Whose;

pub(crate) const EXPERTS: usize = 6;
/// How well the last objects are known to habit: each has weights of its own.
pub(crate) const GATES: usize = 4;
/// The weights that the mixture begins with, and that its share goes to.
pub(crate) const PRIOR: [[f64; EXPERTS]; GATES] = [
    [0.55, 0.18, 0.07, 0.12, 0.04, 0.04],
    [0.45, 0.25, 0.10, 0.12, 0.04, 0.04],
    [0.35, 0.35, 0.10, 0.08, 0.08, 0.04],
    [0.25, 0.45, 0.10, 0.08, 0.08, 0.04],
];
pub(crate) const SHARE: f64 = 0.01;
/// Of the model and of even chances in the base.
const BASE: [f64; 2] = [0.9, 0.1];

const DISCOUNT: f64 = 0.5;
const CONCENTRATIONS: [f64; 4] = [4.0, 2.0, 1.0, 0.5];
/// Objects that the recency cache holds.
const RECENT_MAX: usize = 48;
/// What an object in the cache is worth after each further one.
const RECENT_KEPT: f64 = 0.9;
/// Weight of the cache, of the things here, in their experts.
const CACHE: f64 = 0.6;
const HERE: f64 = 0.8;

/// The weights that the model keeps within habit and within short, and habit within recency, hour and staying.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Kept {
    pub(crate) model_in_habit: f64,
    pub(crate) model_in_short: f64,
    pub(crate) habit_in: [f64; 3],
}

/// What one person turns to.
#[derive(Debug, Clone)]
pub(crate) struct Objects {
    /// The last different objects, the latest first, and how often that was mentioned again.
    pub(crate) last: [u16; 3],
    pub(crate) times: u8,
    recent: Vec<(u16, f64)>,
    pub(crate) mixtures: [FixedShare<EXPERTS>; GATES],
    pub(crate) base: FixedShare<2>,
    /// The latest forecast: experts row by row, the gate, the weight that the model keeps in habit, the observations by order.
    experts: Vec<f64>,
    labels: usize,
    gate: usize,
    kept: Kept,
    pub(crate) observations: [f64; 4],
    /// Probabilities of the mixture.
    pub(crate) mixed: Vec<f64>,
}

impl Objects {
    pub(crate) fn new() -> Self {
        Self {
            last: [NONE; 3],
            times: 0,
            recent: Vec::with_capacity(RECENT_MAX),
            mixtures: PRIOR.map(FixedShare::new),
            base: FixedShare::new(BASE),
            experts: Vec::new(),
            labels: 0,
            gate: 0,
            kept: Kept { model_in_habit: 1.0, model_in_short: 1.0, habit_in: [1.0; 3] },
            observations: [0.0; 4],
            mixed: Vec::new(),
        }
    }

    /// Another map: the last forecast says nothing of its labels.
    pub(crate) fn forget_forecast(&mut self) {
        self.labels = 0;
        self.mixed.clear();
    }

    /// A number stands for something else from now on.
    pub(crate) fn forget_number(&mut self, number: u16) {
        self.last.iter_mut().filter(|last| **last == number).for_each(|last| *last = NONE);
        self.recent.retain(|(other, _)| *other != number);
    }

    /// Another activity begins.
    pub(crate) fn forget_activity(&mut self) {
        self.recent.clear();
    }

    /// Forecasts the next object over the map's labels, from the model's probabilities (which need not sum to one).
    pub(crate) fn forecast(&mut self, whose: Whose<'_>, frame: &Frame, here: Option<usize>, at_s: f64, model: &[f64]) {
        let labels = model.len();
        self.labels = labels;
        self.experts.clear();
        self.experts.resize(EXPERTS * labels, 0.0);
        let (own, rest) = self.experts.split_at_mut(labels);
        let (habit, rest) = rest.split_at_mut(labels);
        let (short, rest) = rest.split_at_mut(labels);
        let (recency, rest) = rest.split_at_mut(labels);
        let (hour, staying) = rest.split_at_mut(labels);

        // What the model holds for impossible is unlikely: a home may do it all the same.
        const FLOOR: f64 = 1e-6;
        let total: f64 = model.iter().map(|p| p.max(FLOOR)).sum();
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOOR) / total);

        let [of_model, of_even] = *self.base.weights();
        habit.iter_mut().zip(&*own).for_each(|(habit, p)| *habit = of_model * p + of_even / labels as f64);
        self.observations = [0.0; 4];
        let index = |number| frame.label(number);
        let [first, second, third] = self.last;
        let after = [[NONE; 3], [first, NONE, NONE], [first, second, NONE], [first, second, third]];
        let again = Whose { times: self.times, ..whose };
        let mut kept = 1.0;
        for (order, kind) in [Kind::Object0, Kind::Object1, Kind::Object2, Kind::Object3].into_iter().enumerate() {
            let whose = if order == 0 { whose } else { again };
            let (left, seen) = whose.smooth(kind, after[order], DISCOUNT, CONCENTRATIONS[order], index, habit);
            kept *= left;
            self.observations[order] = seen;
            if order == 1 {
                short.copy_from_slice(habit);
                self.kept.model_in_short = of_model * kept;
            }
        }
        self.kept.model_in_habit = of_model * kept;
        self.gate = match kept {
            kept if kept > 0.5 => 0,
            kept if kept > 0.2 => 1,
            kept if kept > 0.05 => 2,
            _ => 3,
        };

        let cached: f64 = self.recent.iter().filter(|(n, _)| *n != first && index(*n).is_some()).map(|(_, w)| w).sum();
        let cache = if cached > 0.0 { CACHE } else { 0.0 };
        recency.iter_mut().zip(&*habit).for_each(|(p, habit)| *p = (1.0 - cache) * habit);
        for (number, weight) in self.recent.iter().filter(|(number, _)| *number != first) {
            if let Some(label) = index(*number) {
                recency[label] += cache * weight / cached;
            }
        }

        hour.copy_from_slice(habit);
        let (part, kind_of_day) = (moment::part_of_day(at_s, 3), u16::from(moment::weekend(at_s)));
        let (at_all, _) = whose.smooth(Kind::ObjectHour, [part, kind_of_day, NONE], DISCOUNT, 20.0, index, hour);
        let (after, _) = again.smooth(Kind::ObjectAfterHour, [first, part, NONE], DISCOUNT, 1.0, index, hour);

        let in_room = |label: usize| here.map_or(0.0, |here| frame.share(label, here));
        let there: f64 = habit.iter().enumerate().map(|(label, p)| p * in_room(label)).sum();
        let kept = if there > 0.0 { 1.0 - HERE } else { 1.0 };
        self.kept.habit_in = [1.0 - cache, at_all * after, kept];
        for (label, (p, habit)) in staying.iter_mut().zip(&*habit).enumerate() {
            *p = kept * habit + if there > 0.0 { HERE * habit * in_room(label) / there } else { 0.0 };
        }

        let weights = self.mixtures[self.gate].weights();
        self.mixed.clear();
        self.mixed.resize(labels, 0.0);
        for (expert, weight) in weights.iter().enumerate() {
            let row = &self.experts[expert * labels..(expert + 1) * labels];
            self.mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p);
        }
    }

    /// What each expert gives to a label in the latest forecast, and its weight.
    pub(crate) fn by_expert(&self, label: usize) -> Option<([f64; EXPERTS], [f64; EXPERTS])> {
        let p = |expert: usize| self.experts[expert * self.labels + label];
        (label < self.labels).then(|| (std::array::from_fn(p), *self.mixtures[self.gate].weights()))
    }

    /// What experts keep of one another, in the latest forecast.
    pub(crate) fn kept(&self) -> Kept {
        self.kept
    }

    /// Learns how good the latest forecast was: the person turned to `label`.
    pub(crate) fn learn_weights(&mut self, label: usize) {
        if let Some((p, _)) = self.by_expert(label) {
            self.base.learn(&[p[0], 1.0 / self.labels as f64], &BASE, SHARE, 1.0);
            self.mixtures[self.gate].learn(&p, &PRIOR[self.gate], SHARE, 1.0);
        }
    }

    /// Counts that the person turned to `number`.
    pub(crate) fn count(&self, counts: &mut Counts, slot: u8, number: u16, at_s: f64) {
        let now_min = moment::minute(at_s);
        let [first, second, third] = self.last;
        let (part, kind_of_day) = (moment::part_of_day(at_s, 3), u16::from(moment::weekend(at_s)));
        let after = [
            (Kind::Object3, [first, second, third]),
            (Kind::Object2, [first, second, NONE]),
            (Kind::Object1, [first, NONE, NONE]),
            (Kind::ObjectAfterHour, [first, part, NONE]),
        ];
        let again = with_times(slot, self.times);
        for (kind, after) in after {
            counts.add(key(kind, again, after), number, 1.0, now_min);
        }
        counts.add(key(Kind::Object0, slot, [NONE; 3]), number, 1.0, now_min);
        counts.add(key(Kind::ObjectHour, slot, [part, kind_of_day, NONE]), number, 1.0, now_min);
    }

    /// The person has turned to `number`.
    pub(crate) fn turn(&mut self, number: u16) {
        if number == self.last[0] {
            self.times = self.times.saturating_add(1);
            return;
        }
        self.times = 0;
        self.last = [number, self.last[0], self.last[1]];
        let mut known = false;
        for (other, weight) in &mut self.recent {
            *weight *= RECENT_KEPT;
            if *other == number {
                *weight += 1.0;
                known = true;
            }
        }
        if known {
            return;
        }
        if self.recent.len() == RECENT_MAX {
            let least = (0..RECENT_MAX).min_by(|a, b| self.recent[*a].1.total_cmp(&self.recent[*b].1));
            least.map(|least| self.recent.swap_remove(least));
        }
        self.recent.push((number, 1.0));
    }
}
