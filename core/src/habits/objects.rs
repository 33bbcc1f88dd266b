//! The next object: whether the last one is mentioned again, and which other one comes if not, each by several forecasts.
//!
//! Which other one, given that it is another:
//!
//! | expert | what it knows |
//! | --- | --- |
//! | model | the language model's probabilities |
//! | habit | what followed the last zero to five objects in this home, backed off to the base ([`super::reliance`]) |
//! | recency | what was turned to in this activity, over habit |
//! | hour | what was turned to at this part of the day, after the last object and at all, over what followed that |
//! | staying | what habit says of the things in the room where the person is |
//! | together | model, habit, hour and recency multiplied ([`super::together`]) |
//!
//! Whether the same one is mentioned again:
//!
//! | expert | what it knows |
//! | --- | --- |
//! | model | the language model's probability of the last object |
//! | habit | how often the last object was mentioned so often, after what came before it |
//! | share | how often any object is mentioned again |
//!
//! The base is the model mixed with even chances, by weights of its own: where the model is far off, a home is not to pay for it with
//! everything that is new. An object that is mentioned again and again is one object of the context, and so are sentences about nothing
//! that the map has.

use super::counts::Counts;
use super::frame::Frame;
use super::key::{self, Kind, NONE, key, with_times};
use super::mixture::FixedShare;
use super::moment;
use super::reliance::{ORDERS, Reliance};
use super::together::Together;
use super::whose::Whose;

pub(crate) const EXPERTS: usize = 6;
/// How well the last objects are known to habit, and last, that the map lacks what came last: each has weights of its own.
pub(crate) const GATES: usize = 5;
const LACKING: usize = GATES - 1;
/// The weights that the mixture's share goes to.
pub(crate) const PRIOR: [[f64; EXPERTS]; GATES] = [
    [0.20, 0.05, 0.03, 0.03, 0.03, 0.66],
    [0.15, 0.06, 0.03, 0.03, 0.03, 0.70],
    [0.12, 0.09, 0.03, 0.03, 0.03, 0.70],
    [0.10, 0.11, 0.03, 0.03, 0.03, 0.70],
    [0.20, 0.05, 0.03, 0.03, 0.03, 0.66],
];
/// The model's weight before anything was seen, by how well the last objects are known: a first day of few things is no worse than the
/// model alone, and a second day like the first need not wait until the weights have learned what its counts say.
pub(crate) const FIRST: [f64; GATES] = [0.95, 0.9, 0.5, 0.2, 0.95];
/// The powers that the product of forecasts begins with: of model, habit, hour and recency.
const POWERS: [f64; FACTORS] = [0.65, 0.3, 0.1, 0.05];
pub(crate) const FACTORS: usize = 4;
/// The same of those who say whether the last object is mentioned again.
pub(crate) const AGAIN_EXPERTS: usize = 3;
pub(crate) const AGAIN_PRIOR: [f64; AGAIN_EXPERTS] = [0.5, 0.3, 0.2];
pub(crate) const SHARE: f64 = 0.005;
/// Of the model and of even chances in the base.
const BASE: [f64; 2] = [0.9, 0.1];

/// Objects of the longest context.
pub(crate) const LAST: usize = ORDERS - 1;
const KINDS: [Kind; ORDERS] =
    [Kind::Object0, Kind::Object1, Kind::Object2, Kind::Object3, Kind::Object4, Kind::Object5];
const DISCOUNT: f64 = 0.5;
/// Contexts of how often an object is mentioned again, and how many observations the shorter one is worth.
const AGAIN: [(Kind, f64); 4] = [(Kind::Again0, 2.0), (Kind::Again1, 1.0), (Kind::Again2, 0.7), (Kind::Again3, 0.5)];
/// What is counted there.
const OTHER: u16 = 0;
const SAME: u16 = 1;
/// Objects that the recency cache holds.
const RECENT_MAX: usize = 48;
/// What an object in the cache is worth after each further one.
const RECENT_KEPT: f64 = 0.9;
/// Weight of the cache, of the things here, in their experts.
const CACHE: f64 = 0.6;
const HERE: f64 = 0.8;
/// What is held for impossible is unlikely.
const FLOOR: f64 = 1e-6;

/// Where the probability of a label comes from.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Parts {
    pub(crate) probability: f64,
    pub(crate) model: f64,
    pub(crate) habit: f64,
    pub(crate) recency: f64,
    pub(crate) hour: f64,
    pub(crate) staying: f64,
}

impl Parts {
    fn shares(&self) -> [f64; 5] {
        [self.model, self.habit, self.recency, self.hour, self.staying]
    }

    fn shares_mut(&mut self) -> [&mut f64; 5] {
        [&mut self.model, &mut self.habit, &mut self.recency, &mut self.hour, &mut self.staying]
    }
}

/// What one person turns to.
#[derive(Debug, Clone)]
pub(crate) struct Objects {
    /// The last different objects, the latest first, and how often that was mentioned again.
    pub(crate) last: [u16; LAST],
    pub(crate) times: u8,
    recent: Vec<(u16, f64)>,
    pub(crate) mixtures: [FixedShare<EXPERTS>; GATES],
    pub(crate) together: [Together<FACTORS>; GATES],
    pub(crate) again: FixedShare<AGAIN_EXPERTS>,
    pub(crate) base: FixedShare<2>,
    pub(crate) reliance: Reliance,
    /// How often the last object was mentioned again, of how many times.
    pub(crate) repeated: f64,
    pub(crate) turned: f64,
    forecast: Forecast,
    pub(crate) observations: [f64; 4],
    /// Probabilities of the mixture.
    pub(crate) mixed: Vec<f64>,
}

/// The latest forecast.
#[derive(Debug, Clone, Default)]
struct Forecast {
    labels: usize,
    /// When it was made: what comes of it is counted for that hour.
    at_s: f64,
    /// The label of the last object, and what each expert says of its being mentioned again.
    same: Option<usize>,
    again: [f64; AGAIN_EXPERTS],
    /// Given another object, row by row: the model, the base, what contexts of each order add to it, recency, hour, staying, together;
    /// and below the contexts of each order what those of others in the home add, where there are any.
    rows: Vec<f64>,
    logs: Vec<f32>,
    /// Which cell of the reliance each order went by, which part it left to the shorter one, and the row of that.
    orders: [Option<(usize, f64, usize)>; ORDERS],
    gate: usize,
    /// The weights that the model keeps within habit and within hour, that habit keeps within recency and staying, and that what
    /// follows the last object keeps within hour.
    model_in_habit: f64,
    model_in_hour: f64,
    habit_in: [f64; 2],
    short_in_hour: f64,
}

/// Rows of a forecast.
const MODEL_ROW: usize = 0;
const BASE_ROW: usize = 1;
/// What follows the last object, within the rows from the base on.
const SHORT: usize = 2;
const HABIT_ROW: usize = BASE_ROW + ORDERS;
const RECENCY_ROW: usize = HABIT_ROW + 1;
const PRIOR_ROW: usize = RECENCY_ROW + 4;
const ROWS: usize = PRIOR_ROW + ORDERS;
/// The row of each expert.
const EXPERT_ROWS: [usize; EXPERTS] =
    [MODEL_ROW, HABIT_ROW, RECENCY_ROW, RECENCY_ROW + 1, RECENCY_ROW + 2, RECENCY_ROW + 3];
/// The experts.
const MODEL: usize = 0;
const HABIT: usize = 1;
const RECENCY: usize = 2;
const HOUR: usize = 3;
const STAYING: usize = 4;
const TOGETHER: usize = 5;
/// What is multiplied.
const FACTOR_ROWS: [usize; FACTORS] = [MODEL_ROW, HABIT_ROW, RECENCY_ROW + 1, RECENCY_ROW];

impl Objects {
    pub(crate) fn new() -> Self {
        Self {
            last: [NONE; LAST],
            times: 0,
            recent: Vec::with_capacity(RECENT_MAX),
            mixtures: std::array::from_fn(|gate| FixedShare::beginning_with(FIRST[gate], PRIOR[gate])),
            together: std::array::from_fn(|_| Together::steady(POWERS)),
            again: FixedShare::new(AGAIN_PRIOR),
            base: FixedShare::new(BASE),
            reliance: Reliance::new(),
            repeated: 1.0,
            turned: 2.0,
            forecast: Forecast::default(),
            observations: [0.0; 4],
            mixed: Vec::new(),
        }
    }

    /// Another map: the last forecast says nothing of its labels.
    pub(crate) fn forget_forecast(&mut self) {
        self.forecast.labels = 0;
        self.mixed.clear();
    }

    /// A number stands for something else from now on.
    pub(crate) fn forget_number(&mut self, number: u16) {
        self.last.iter_mut().filter(|last| **last == number).for_each(|last| *last = NONE);
        self.recent.retain(|(other, _)| *other != number);
    }

    /// The last three of them.
    pub(crate) fn last_three(&self) -> [u16; 3] {
        [self.last[0], self.last[1], self.last[2]]
    }

    /// Another activity begins.
    pub(crate) fn forget_activity(&mut self) {
        self.recent.clear();
    }

    /// The numbers of a context in the key.
    fn after(&self, order: usize) -> [u16; 3] {
        let [first, second, third, ..] = self.last;
        match order {
            0 => [NONE; 3],
            1 => [first, NONE, NONE],
            2 => [first, second, NONE],
            3 => [first, second, third],
            longer => key::digest(&self.last[..longer.min(LAST)]),
        }
    }

    /// Forecasts the next object over the map's labels, from the model's probabilities (which need not sum to one).
    pub(crate) fn forecast(&mut self, whose: Whose<'_>, frame: &Frame, here: Option<usize>, at_s: f64, model: &[f64]) {
        let labels = model.len();
        let first = self.last[0];
        let same = frame.label(first).filter(|label| *label < labels);
        let mut forecast = std::mem::take(&mut self.forecast);
        (forecast.labels, forecast.at_s) = (labels, at_s);
        forecast.same = same;
        // Every row that is read is written first.
        forecast.rows.resize(ROWS * labels, 0.0);
        let (own, rest) = forecast.rows.split_at_mut(labels);
        let total: f64 = own
            .iter_mut()
            .zip(model)
            .map(|(own, p)| {
                *own = p.max(FLOOR);
                *own
            })
            .sum();
        let others = total - same.map_or(0.0, |same| own[same]);
        // Of a single label there is no other.
        let scale = if others > 0.0 { 1.0 / others } else { 0.0 };
        let again_by_model = same.map_or(0.0, |same| std::mem::take(&mut own[same]) / total);
        own.iter_mut().for_each(|own| *own *= scale);

        let [of_model, of_even] = *self.base.weights();
        let even = 1.0 / (labels - usize::from(same.is_some())).max(1) as f64;
        let (levels, rest) = rest.split_at_mut((ORDERS + 1) * labels);
        let (rest, priors) = rest.split_at_mut((PRIOR_ROW - RECENCY_ROW) * labels);
        levels.iter_mut().zip(&*own).for_each(|(base, p)| *base = of_model * p + of_even * even);
        if let Some(same) = same {
            levels[same] = 0.0;
        }
        self.observations = [0.0; 4];
        let index = |number| if number == first { None } else { frame.label(number) };
        let (mut kept, mut model_in_short) = (1.0, of_model);
        // All are looked up before any is read: so the processor waits for them together.
        let seen: [_; ORDERS] = std::array::from_fn(|order| whose.own(KINDS[order], self.after(order)));
        for (order, kind) in KINDS.into_iter().enumerate() {
            let (shorter, longer) = levels[order * labels..].split_at_mut(labels);
            let p = &mut longer[..labels];
            p.copy_from_slice(shorter);
            let after = self.after(order);
            let of_others = whose.prior(kind, after, DISCOUNT, Reliance::concentration(order), index, p);
            let below = match of_others {
                Some(_) => {
                    priors[order * labels..(order + 1) * labels].copy_from_slice(p);
                    PRIOR_ROW + order
                }
                None => BASE_ROW + order,
            };
            let (used, total) = self.reliance.blend(order, seen[order], index, p);
            forecast.orders[order] = used.map(|(cell, left)| (cell, left, below));
            kept *= of_others.unwrap_or(1.0) * used.map_or(1.0, |(_, left)| left);
            if let Some(seen) = self.observations.get_mut(order) {
                *seen = total;
            }
            if order + 1 == SHORT {
                model_in_short = of_model * kept;
            }
        }
        forecast.model_in_habit = of_model * kept;
        forecast.gate = match kept {
            _ if first == NONE => LACKING,
            kept if kept > 0.5 => 0,
            kept if kept > 0.2 => 1,
            kept if kept > 0.05 => 2,
            _ => 3,
        };
        let habit = &levels[ORDERS * labels..];
        let (recency, rest) = rest.split_at_mut(labels);
        let (hour, rest) = rest.split_at_mut(labels);
        let (staying, together) = rest.split_at_mut(labels);

        let cached: f64 = self.recent.iter().filter(|(n, _)| index(*n).is_some()).map(|(_, w)| w).sum();
        let cache = if cached > 0.0 { CACHE } else { 0.0 };
        recency.iter_mut().zip(habit).for_each(|(p, habit)| *p = (1.0 - cache) * habit);
        for (number, weight) in &self.recent {
            if let Some(label) = index(*number) {
                recency[label] += cache * weight / cached;
            }
        }

        hour.copy_from_slice(&levels[SHORT * labels..(SHORT + 1) * labels]);
        let (part, kind_of_day) = (moment::part_of_day(at_s, 3), u16::from(moment::weekend(at_s)));
        let (at_all, _) = whose.smooth(Kind::ObjectHour, [part, kind_of_day, NONE], DISCOUNT, 20.0, index, hour);
        let (after, _) = whose.smooth(Kind::ObjectAfterHour, [first, part, NONE], DISCOUNT, 1.0, index, hour);

        let in_room = |label: usize| here.map_or(0.0, |here| frame.share(label, here));
        let there: f64 = habit.iter().enumerate().map(|(label, p)| p * in_room(label)).sum();
        let kept = if there > 0.0 { 1.0 - HERE } else { 1.0 };
        forecast.habit_in = [1.0 - cache, kept];
        forecast.short_in_hour = at_all * after;
        forecast.model_in_hour = model_in_short * at_all * after;
        for (label, (p, habit)) in staying.iter_mut().zip(habit).enumerate() {
            *p = kept * habit + if there > 0.0 { HERE * habit * in_room(label) / there } else { 0.0 };
        }
        let factors = [&*own, habit, &*hour, &*recency];
        self.together[forecast.gate].forecast(factors, same, &mut forecast.logs, together);

        let again = match same {
            Some(_) if others > 0.0 => {
                forecast.again = [again_by_model, self.again_by_habit(whose), self.repeated / self.turned]
                    .map(|p| p.clamp(FLOOR, 1.0 - FLOOR));
                self.again.mix(&forecast.again)
            }
            Some(_) => 1.0,
            None => 0.0,
        };
        let weights = self.mixtures[forecast.gate].weights();
        self.mixed.clear();
        self.mixed.resize(labels, 0.0);
        for (row, weight) in EXPERT_ROWS.into_iter().zip(weights) {
            let row = &forecast.rows[row * labels..(row + 1) * labels];
            let weight = (1.0 - again) * weight;
            self.mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p);
        }
        if let Some(same) = same {
            self.mixed[same] = again;
        }
        self.forecast = forecast;
    }

    /// How likely the last object is mentioned again, by how often it was after the same things.
    fn again_by_habit(&self, whose: Whose<'_>) -> f64 {
        let whose = Whose { times: self.times, ..whose };
        let mut p = self.repeated / self.turned;
        for (order, (kind, concentration)) in AGAIN.into_iter().enumerate() {
            let mut mix = |seen: super::counts::Seen<'_>, concentration: f64| {
                let (mut total, mut same) = (0.0, 0.0);
                for (symbol, count) in seen.symbols() {
                    total += count;
                    same += if symbol == SAME { count } else { 0.0 };
                }
                p = (same + concentration * p) / (total + concentration);
            };
            let after = self.after(order);
            whose.of_others(kind, after).for_each(|seen| mix(seen, 4.0 * concentration));
            if let Some(seen) = whose.own(kind, after) {
                mix(seen, concentration);
            }
        }
        p
    }

    /// Where the probability of a label in the latest forecast comes from.
    pub(crate) fn explain(&self, label: usize) -> Option<Parts> {
        let Forecast { labels, same, again, rows, gate, .. } = &self.forecast;
        let Forecast { model_in_habit, model_in_hour, habit_in, short_in_hour, .. } = &self.forecast;
        let probability = *self.mixed.get(label).filter(|p| label < *labels && **p > 0.0)?;
        if *same == Some(label) {
            // Of a single label that is all there is.
            let total = self.again.mix(again);
            let part = |expert: usize| {
                if total > 0.0 { self.again.weights()[expert] * again[expert] / total } else { 1.0 / 3.0 }
            };
            return Some(Parts { probability, model: part(0), habit: part(1) + part(2), ..Parts::default() });
        }
        let weights = self.mixtures[*gate].weights();
        let p: [f64; EXPERTS] = EXPERT_ROWS.map(|row| rows[row * labels + label]);
        let total: f64 = p.iter().zip(weights).map(|(p, weight)| p * weight).sum();
        if total <= 0.0 {
            return None;
        }
        // Within habit the model keeps what the counts leave to it; recency, hour and staying keep some of what they begin with, and only
        // what they add to it is theirs.
        let share = |of: f64, expert: usize| (of / p[expert].max(f64::MIN_POSITIVE)).min(1.0);
        let in_habit = share(model_in_habit * p[MODEL], HABIT);
        let of_habit = |kept: f64, expert: usize| share(kept * p[HABIT], expert);
        let parts_of = |expert: usize| -> Parts {
            let mut parts = Parts::default();
            match expert {
                MODEL => parts.model = 1.0,
                HABIT => (parts.model, parts.habit) = (in_habit, 1.0 - in_habit),
                HOUR => {
                    let short = rows[(BASE_ROW + SHORT) * labels + label];
                    let kept = share(short_in_hour * short, HOUR);
                    parts.model = share(model_in_hour * p[MODEL], HOUR).min(kept);
                    (parts.habit, parts.hour) = (kept - parts.model, 1.0 - kept);
                }
                expert => {
                    let kept = of_habit(habit_in[usize::from(expert == STAYING)], expert);
                    (parts.model, parts.habit) = (in_habit * kept, (1.0 - in_habit) * kept);
                    let own = if expert == STAYING { &mut parts.staying } else { &mut parts.recency };
                    *own = 1.0 - kept;
                }
            }
            parts
        };
        let mut sum = Parts { probability, ..Parts::default() };
        let mut add = |weight: f64, parts: Parts| {
            for (sum, part) in sum.shares_mut().into_iter().zip(parts.shares()) {
                *sum += weight * part;
            }
        };
        for expert in (0..EXPERTS).filter(|expert| *expert != TOGETHER) {
            add(weights[expert] * p[expert] / total, parts_of(expert));
        }
        // Of a product each factor has as much as its power.
        let powers = self.together[*gate].powers().map(|power| power.max(0.0));
        let of_all = powers.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        for (power, factor) in powers.into_iter().zip([MODEL, HABIT, HOUR, RECENCY]) {
            add(weights[TOGETHER] * p[TOGETHER] / total * power / of_all, parts_of(factor));
        }
        Some(sum)
    }

    /// Learns how good the latest forecast was: the person turned to `label`.
    pub(crate) fn learn_weights(&mut self, label: usize) {
        let Forecast { labels, same, again, rows, orders, gate, .. } = &self.forecast;
        if label >= *labels {
            return;
        }
        if same.is_some() && *labels > 1 {
            let is_same = *same == Some(label);
            self.turned += 1.0;
            self.repeated += f64::from(u8::from(is_same));
            let given = again.map(|p| if is_same { p } else { 1.0 - p });
            self.again.learn(&given, &AGAIN_PRIOR, SHARE, 1.0);
        }
        if *same == Some(label) {
            return;
        }
        let p = |row: usize| rows[row * labels + label];
        let even = 1.0 / (labels - usize::from(same.is_some())).max(1) as f64;
        self.base.learn(&[p(MODEL_ROW), even], &BASE, SHARE, 1.0);
        self.mixtures[*gate].learn(&EXPERT_ROWS.map(p), &PRIOR[*gate], SHARE, 1.0);
        self.together[*gate].learn(FACTOR_ROWS.map(p));
        // After what the map lacks anything may come: of what it has that says nothing.
        for (order, used) in orders.iter().enumerate().filter(|_| *gate != LACKING) {
            if let Some((cell, left, below)) = *used {
                let of_shorter = left * p(below) / p(BASE_ROW + order + 1).max(f64::MIN_POSITIVE);
                self.reliance.learn(cell, of_shorter.min(1.0));
            }
        }
    }

    /// Counts that the person turned to `number`.
    pub(crate) fn count(&self, counts: &mut Counts, slot: u8, number: u16, at_s: f64) {
        let now_min = moment::minute(at_s);
        let first = self.last[0];
        if first != NONE {
            let same = if number == first { SAME } else { OTHER };
            for (order, (kind, _)) in AGAIN.into_iter().enumerate() {
                counts.add(key(kind, with_times(slot, self.times), self.after(order)), same, 1.0, now_min);
            }
        }
        if number == first {
            return;
        }
        for (order, kind) in KINDS.into_iter().enumerate() {
            counts.add(key(kind, slot, self.after(order)), number, 1.0, now_min);
        }
        let at_s = if self.forecast.labels > 0 { self.forecast.at_s } else { at_s };
        let (part, kind_of_day) = (moment::part_of_day(at_s, 3), u16::from(moment::weekend(at_s)));
        counts.add(key(Kind::ObjectAfterHour, slot, [first, part, NONE]), number, 1.0, now_min);
        counts.add(key(Kind::ObjectHour, slot, [part, kind_of_day, NONE]), number, 1.0, now_min);
    }

    /// The person has turned to something that the map lacks.
    pub(crate) fn turn_away(&mut self) {
        if self.last[0] != NONE {
            self.times = 0;
            self.last.rotate_right(1);
            self.last[0] = NONE;
        }
    }

    /// The person has turned to `number`.
    pub(crate) fn turn(&mut self, number: u16) {
        if number == self.last[0] {
            self.times = self.times.saturating_add(1);
            return;
        }
        self.times = 0;
        self.last.rotate_right(1);
        self.last[0] = number;
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
