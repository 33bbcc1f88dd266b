//! Forecasts of the same outcomes as one: each alone, and all of them multiplied, mixed by fixed share.
//!
//! ```text
//! product: p(w) ~ product over i of p_i(w)^l_i
//! ```
//!
//! A sum of forecasts follows the most confident one. A product keeps the outcomes that all forecasts find likely: those things that the model
//! expects and this home has. After every outcome each power `l_i` takes a gradient step, which shrinks as its information grows. A product may be
//! worse than any of its factors, so it is one expert of a mixture with a bound.

use super::mixture::FixedShare;

/// Information of the first powers, and the least information later.
const FIRST_INFORMATION: f64 = 40.0;
const INFORMATION: f64 = 20.0;
/// Share of the information that is kept at each outcome: about the last five hundred outcomes count.
const KEPT: f64 = 0.998;
/// Greatest gradient, and the range of the powers.
const STEEPEST: f64 = 10.0;
pub(crate) const POWERS: std::ops::RangeInclusive<f64> = -0.5..=1.5;
/// Smaller probabilities are raised to this.
const FLOOR: f32 = 1e-7;

/// `M` forecasts; the product is the last of the `N` experts.
#[derive(Debug, Clone)]
pub(crate) struct Pool<const N: usize, const M: usize> {
    pub(crate) mixture: FixedShare<N>,
    /// Per forecast its power and the information about it.
    pub(crate) powers: [[f64; 2]; M],
    /// Per forecast, mean and variance of its logarithm under the latest product.
    expected: [[f64; 2]; M],
    /// The latest forecasts and their product, row by row.
    rows: Vec<f64>,
    logs: Vec<f32>,
    width: usize,
    without: Option<usize>,
    /// The mixture of the rows.
    pub(crate) mixed: Vec<f64>,
}

/// The natural logarithm, to four digits: a forecast of a home computes a thousand of them.
fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = (bits >> 23) as f32 - 127.0;
    let mantissa = f32::from_bits(bits & 0x007f_ffff | 0x3f80_0000);
    // ln(m) = 2 artanh((m - 1) / (m + 1)), with the mantissa around one.
    let (mantissa, exponent) = if mantissa > 1.414 { (0.5 * mantissa, exponent + 1.0) } else { (mantissa, exponent) };
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let square = t * t;
    exponent * std::f32::consts::LN_2 + 2.0 * t * (1.0 + square * (1.0 / 3.0 + square * 0.2))
}

impl<const N: usize, const M: usize> Pool<N, M> {
    /// The first expert starts with the weight `first`; the others divide the rest by `prior`.
    pub(crate) fn new(first: f64, prior: [f64; N], powers: [f64; M], has: [bool; N]) -> Self {
        Self {
            mixture: FixedShare::beginning_with(first, FixedShare::of(prior, has)),
            powers: std::array::from_fn(|at| if has[at] { [powers[at], FIRST_INFORMATION] } else { [0.0, f64::MAX] }),
            expected: [[0.0; 2]; M],
            rows: Vec::new(),
            logs: Vec::new(),
            width: 0,
            without: None,
            mixed: Vec::new(),
        }
    }

    /// The rows for forecasts of `width` outcomes; the outcome `without` cannot happen.
    pub(crate) fn begin(&mut self, width: usize, without: Option<usize>) -> [&mut [f64]; M] {
        (self.width, self.without) = (width, without);
        self.rows.clear();
        self.rows.resize(N * width, 0.0);
        let mut rest = self.rows.as_mut_slice();
        std::array::from_fn(|_| rest.split_off_mut(..width).unwrap_or_default())
    }

    /// Drops the latest forecast, so that nothing is learned from it.
    pub(crate) fn forget(&mut self) {
        self.width = 0;
        self.mixed.clear();
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// The probability that a row gives to an outcome, given that `without` does not happen.
    pub(crate) fn given(&self, row: usize, outcome: usize) -> f64 {
        let row = &self.rows[row * self.width..][..self.width];
        let left = self.without.map_or(1.0, |without| 1.0 - row[without]);
        if self.without == Some(outcome) { 0.0 } else { row[outcome] / left.max(1e-9) }
    }

    pub(crate) fn forecast(&mut self) {
        let width = self.width;
        self.logs.clear();
        self.logs.resize((M + 1) * width, 0.0);
        let (rows, product) = self.rows.split_at_mut(M * width);
        let (sums, logs) = self.logs.split_at_mut(width);
        for ((logs, row), [power, _]) in
            logs.chunks_exact_mut(width.max(1)).zip(rows.chunks_exact(width.max(1))).zip(&self.powers)
        {
            for ((log, sum), p) in logs.iter_mut().zip(sums.iter_mut()).zip(row) {
                *log = ln((*p as f32).max(FLOOR));
                *sum += *power as f32 * *log;
            }
        }
        if let Some(sum) = self.without.and_then(|without| sums.get_mut(without)) {
            *sum = f32::NEG_INFINITY;
        }
        let greatest = sums.iter().copied().fold(f32::NEG_INFINITY, f32::max).max(f32::MIN);
        sums.iter_mut().for_each(|sum| *sum = (*sum - greatest).exp());
        let total: f32 = sums.iter().sum();
        let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
        product.iter_mut().zip(&*sums).for_each(|(p, sum)| *p = f64::from(sum * scale));
        for (expected, logs) in self.expected.iter_mut().zip(logs.chunks_exact(width.max(1))) {
            let (mut mean, mut square) = (0.0, 0.0);
            for (log, sum) in logs.iter().zip(&*sums) {
                mean += sum * log;
                square += sum * log * log;
            }
            let mean = f64::from(scale * mean);
            *expected = [mean, f64::from(scale * square) - mean * mean];
        }
        self.mixed.clear();
        self.mixed.resize(width, 0.0);
        for (row, weight) in self.rows.chunks_exact(width.max(1)).zip(self.mixture.weights()) {
            let left = self.without.map_or(1.0, |without| 1.0 - row[without]);
            let weight = weight / left.max(1e-9);
            self.mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p);
        }
        self.without.into_iter().for_each(|without| self.mixed[without] = 0.0);
        let total: f64 = self.mixed.iter().sum();
        if total > 0.0 {
            self.mixed.iter_mut().for_each(|mixed| *mixed /= total);
        }
    }

    pub(crate) fn learn(&mut self, outcome: usize, share: f64) {
        self.mixture.learn(&std::array::from_fn(|row| self.given(row, outcome)), share, 1.0);
        for (row, ([power, information], [expected, varies])) in self.powers.iter_mut().zip(self.expected).enumerate() {
            let p = self.rows[row * self.width + outcome];
            let steep = (f64::from(ln((p as f32).max(FLOOR))) - expected).clamp(-STEEPEST, STEEPEST);
            *information = KEPT * *information + varies.max(0.0) + (1.0 - KEPT) * INFORMATION;
            *power = (*power + steep / *information).clamp(*POWERS.start(), *POWERS.end());
        }
    }

    /// The share of each forecast in an outcome's probability. Each factor's share of the product is its power.
    pub(crate) fn parts(&self, outcome: usize) -> [f64; M] {
        let powers = self.powers.map(|[power, _]| power.max(0.0));
        let of_all = powers.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let weights = self.mixture.weights();
        let of = |row: usize| weights[row] * self.given(row, outcome);
        let parts: [f64; M] = std::array::from_fn(|row| of(row) + of(M) * powers[row] / of_all);
        let total = parts.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        parts.map(|part| part / total)
    }
}
