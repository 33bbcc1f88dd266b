//! Forecasts of the same outcomes as one: each alone, and all of them multiplied, mixed by fixed share.
//!
//! Each expert begins with the probabilities of another one and mixes what its contexts have seen over them, level by level. A sum of forecasts
//! follows the most confident one. The product `p(w) ~ product over i of p_i(w)^l_i` keeps the outcomes that all forecasts find likely: those things
//! that the model expects and this home has. After every outcome each power `l_i` takes a gradient step, which shrinks as its information grows.

use super::context::{Context, Level, Part, Without};
use super::mixture::FixedShare;
use super::view::{View, add, normalise};

/// Greatest sum of observations: ten observations a second for a century make a third of it.
pub(crate) const MOST: f64 = 1e11;
/// Information of the first powers, and the least information later.
const FIRST_INFORMATION: f64 = 40.0;
const INFORMATION: f64 = 20.0;
/// Share of the information that is kept at each outcome: about the last five hundred outcomes count.
const KEPT: f64 = 0.998;
/// Greatest gradient, and the range of the powers.
const STEEPEST: f64 = 10.0;
const POWERS: std::ops::RangeInclusive<f64> = -0.5..=1.5;
/// Smaller probabilities are raised to this.
const FLOOR: f32 = 1e-7;

/// What an expert knows, in the words of an explanation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Source {
    Model,
    Habit,
    Things,
    Hour,
}

/// Where the probabilities of an expert begin: the caller writes them, or they are those of another expert after so many of its levels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Begin {
    Given,
    After(usize, usize),
}

#[derive(Debug)]
pub(crate) struct Expert {
    pub(crate) part: Part,
    /// Weight in the mixture, in proportion, and first power in the product.
    prior: f64,
    power: f64,
    source: Source,
    begin: Begin,
    pub(crate) levels: &'static [Level],
}

pub(crate) const fn expert(number: u8, name: &'static str, weights: [f64; 2], source: Source, begin: Begin) -> Expert {
    Expert { part: Part { number, name }, prior: weights[0], power: weights[1], source, begin, levels: &[] }
}

impl Expert {
    pub(crate) const fn over(self, levels: &'static [Level]) -> Self {
        Self { levels, ..self }
    }
}

/// The experts of a pool, the forecast without habits first.
#[derive(Debug)]
pub(crate) struct Plan {
    pub(crate) experts: &'static [Expert],
    /// The product of all experts, if there is one.
    pub(crate) product: Option<Expert>,
}

#[derive(Debug, Clone)]
pub(crate) struct Pool {
    plan: &'static Plan,
    pub(crate) mixture: FixedShare,
    /// Per factor of the product its power and the information about it.
    powers: Vec<[f64; 2]>,
    /// The latest forecasts and their product, row by row.
    rows: Vec<f64>,
    /// Per row, the share of the first row in it.
    pub(crate) kept: Vec<f64>,
    /// Own observations in the contexts of expert 1, at most four.
    pub(crate) observations: Vec<f64>,
    pub(crate) width: usize,
    /// The mixture of the rows.
    pub(crate) mixed: Vec<f64>,
}

/// The natural logarithm, to four digits: a forecast of a home computes a thousand of them.
fn ln(p: f64) -> f64 {
    let bits = (p as f32).max(FLOOR).to_bits();
    let exponent = (bits >> 23) as f32 - 127.0;
    let mantissa = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    // ln(m) = 2 artanh((m - 1) / (m + 1)), with the mantissa around one.
    let (mantissa, exponent) = if mantissa > 1.414 { (0.5 * mantissa, exponent + 1.0) } else { (mantissa, exponent) };
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let square = t * t;
    f64::from(exponent * std::f32::consts::LN_2 + 2.0 * t * (1.0 + square * (1.0 / 3.0 + square * 0.2)))
}

impl Pool {
    /// `first` is the first weight of the forecast without habits.
    pub(crate) fn new(plan: &'static Plan, first: f64, without: Without) -> Self {
        let weight = |expert: &Expert| if without.uses(expert.part) { expert.prior } else { 0.0 };
        let factors = if plan.product.is_some() { plan.experts } else { &[] };
        let power = |expert: &Expert| match without.uses(expert.part) {
            true => [expert.power, FIRST_INFORMATION],
            false => [0.0, f64::MAX],
        };
        Self {
            plan,
            mixture: FixedShare::new(first, plan.experts.iter().chain(&plan.product).map(weight)),
            powers: factors.iter().map(power).collect(),
            rows: Vec::new(),
            kept: vec![0.0; plan.experts.len()],
            observations: vec![0.0; plan.experts[1].levels.len().min(4)],
            width: 0,
            mixed: Vec::new(),
        }
    }

    /// Begins forecasts of `width` outcomes. If one is impossible, all rows must give it nothing.
    pub(crate) fn begin(&mut self, width: usize) {
        self.width = width;
        self.rows.clear();
        self.rows.resize(self.mixture.weights.len() * width, 0.0);
        self.kept.fill(0.0);
        self.kept[0] = 1.0;
    }

    /// Drops the latest forecast. It teaches no more.
    pub(crate) fn forget(&mut self) {
        self.width = 0;
        self.mixed.clear();
    }

    pub(crate) fn row(&self, expert: usize) -> &[f64] {
        &self.rows[expert * self.width..][..self.width]
    }

    pub(crate) fn row_mut(&mut self, expert: usize) -> &mut [f64] {
        &mut self.rows[expert * self.width..][..self.width]
    }

    /// Mixes what the contexts have seen over the rows. `index` gives the outcome of a counted symbol.
    pub(crate) fn smooth(&mut self, view: &View<'_>, context: &Context, index: impl Fn(u16) -> Option<usize>) {
        for (at, expert) in self.plan.experts.iter().enumerate() {
            self.pass_on(at, 0);
            for (depth, level) in expert.levels.iter().enumerate() {
                let (left, seen) = view.smooth(level, context, &index, self.row_mut(at));
                self.kept[at] *= left;
                if at == 1 {
                    self.observations.get_mut(depth).into_iter().for_each(|own| *own = seen);
                }
                self.pass_on(at, depth + 1);
            }
        }
    }

    /// Copies a row to the experts that begin with it.
    fn pass_on(&mut self, from: usize, depth: usize) {
        let width = self.width;
        for (to, expert) in self.plan.experts.iter().enumerate() {
            if expert.begin == Begin::After(from, depth) {
                self.rows.copy_within(from * width..(from + 1) * width, to * width);
                self.kept[to] = self.kept[from];
            }
        }
    }

    /// Multiplies the rows, if the plan has a product, and mixes all.
    pub(crate) fn forecast(&mut self) {
        let width = self.width.max(1);
        if self.plan.product.is_some() {
            let (rows, product) = self.rows.split_at_mut(self.powers.len() * self.width);
            for (row, [power, _]) in rows.chunks_exact(width).zip(&self.powers) {
                product.iter_mut().zip(row).for_each(|(sum, p)| *sum += power * ln(*p));
            }
            let impossible = product.iter_mut().zip(rows).filter(|(_, p)| **p <= 0.0);
            impossible.for_each(|(sum, _)| *sum = f64::NEG_INFINITY);
            let greatest = product.iter().copied().fold(f64::MIN, f64::max);
            product.iter_mut().for_each(|sum| *sum = f64::from(((*sum - greatest) as f32).exp()));
            normalise(product);
        }
        self.mixed.clear();
        self.mixed.resize(self.width, 0.0);
        let rows = self.rows.chunks_exact(width).zip(&self.mixture.weights);
        rows.for_each(|(row, weight)| add(&mut self.mixed, row, *weight));
    }

    pub(crate) fn learn(&mut self, outcome: usize, share: f64) {
        let width = self.width;
        self.mixture.learn(|row| self.rows[row * width + outcome], share, 1.0);
        let (rows, product) = self.rows.split_at(self.powers.len() * width);
        for (row, [power, information]) in rows.chunks_exact(width).zip(&mut self.powers) {
            // Of the logarithm under the product.
            let (mut mean, mut square) = (0.0, 0.0);
            for (log, p) in row.iter().map(|p| ln(*p)).zip(product) {
                mean += p * log;
                square += p * log * log;
            }
            let steep = (ln(row[outcome]) - mean).clamp(-STEEPEST, STEEPEST);
            *information = KEPT * *information + (square - mean * mean).max(0.0) + (1.0 - KEPT) * INFORMATION;
            *power = (*power + steep / *information).clamp(*POWERS.start(), *POWERS.end());
        }
    }

    /// The learned numbers: weights, then powers.
    pub(crate) fn learned(&self) -> impl Iterator<Item = f64> {
        self.mixture.weights.iter().chain(self.powers.as_flattened()).copied()
    }

    /// Restores learned numbers, and returns those after them. Impossible numbers are learned again.
    pub(crate) fn restore<'a>(&mut self, learned: &'a [f64]) -> Option<&'a [f64]> {
        let (weights, rest) = learned.split_at_checked(self.mixture.weights.len())?;
        let (powers, rest) = rest.split_at_checked(2 * self.powers.len())?;
        let powers = powers.as_chunks().0;
        let is_possible = |[power, known]: &[f64; 2]| POWERS.contains(power) && (0.0..=MOST).contains(known);
        let is_sum = (weights.iter().sum::<f64>() - 1.0).abs() < 1e-6;
        if is_sum && weights.iter().all(|weight| *weight >= 0.0) && powers.iter().all(is_possible) {
            self.mixture.weights.copy_from_slice(weights);
            self.powers.copy_from_slice(powers);
        }
        Some(rest)
    }

    /// Counts an outcome in every context.
    pub(crate) fn count(&self, view: &mut View<'_>, context: &Context, symbol: u16, at_s: f64) {
        let levels = self.plan.experts.iter().flat_map(|expert| expert.levels);
        levels.for_each(|level| view.count(level, context, (symbol, 1.0), at_s));
    }

    /// The share of each source in an outcome's probability. Each factor's share of the product is its power.
    pub(crate) fn explain(&self, outcome: usize) -> [f64; 4] {
        let power = |row: usize| self.powers.get(row).map_or(0.0, |[power, _]| power.max(0.0));
        let experts = self.plan.experts;
        let of_all = (0..experts.len()).map(power).sum::<f64>().max(f64::MIN_POSITIVE);
        let weights = &self.mixture.weights;
        let of_product = weights.get(experts.len()).map_or(0.0, |weight| weight * self.row(experts.len())[outcome]);
        let mut shares = [0.0; 4];
        for (row, expert) in experts.iter().enumerate() {
            let part = weights[row] * self.row(row)[outcome] + of_product * power(row) / of_all;
            let of_model = (self.kept[row] * self.row(0)[outcome] / self.row(row)[outcome]).min(1.0);
            shares[Source::Model as usize] += part * of_model;
            shares[expert.source as usize] += part * (1.0 - of_model);
        }
        let total = shares.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        shares.map(|share| share / total)
    }
}
