//! Several forecasts multiplied: each to a power that is learned.
//!
//! ```text
//! p(w) ~ product over i of p_i(w)^l_i
//! ```
//!
//! Where a sum of forecasts believes whichever is surest, a product keeps what all of them hold likely: of the things that the model
//! expects, those that this home has. The powers go down the gradient of the loss after every outcome: by steady steps, or the farther the
//! less was learned in that direction (Newton's step with the information of all outcomes so far, of which the newest count). A product
//! may be worse than any of its factors; it is one expert among others of a mixture with a bound.

use nalgebra::{SMatrix, SVector};

/// How far steady steps go along a gradient.
const RATE: f64 = 0.01;
/// What the powers begin with is worth this much information.
const PRIOR_INFORMATION: f64 = 20.0;
/// How much of what was learned is kept at each outcome: the newest five hundred count.
const KEPT: f64 = 0.998;
/// The longest step of a gradient, and the range of the powers.
const STEEPEST: f64 = 10.0;
const POWERS: std::ops::RangeInclusive<f64> = -0.5..=1.5;
/// What is less likely than this is no better known to be so.
const FLOOR: f32 = 1e-7;

/// The powers of `N` forecasts, what is known of them, and what the latest forecast says of the logarithms of each.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Together<const N: usize> {
    powers: SVector<f64, N>,
    steady: bool,
    information: SMatrix<f64, N, N>,
    expected: SVector<f64, N>,
    /// How the logarithms of the factors vary together, by the latest forecast.
    covariance: SMatrix<f64, N, N>,
}

/// The natural logarithm, to four digits: a home's forecast takes a thousand of them.
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

/// `e^x` for `x` from -80 to 0, to four digits.
fn exp(x: f32) -> f32 {
    let x = x.max(-80.0) * std::f32::consts::LOG2_E;
    let whole = x.floor();
    let t = (x - whole) * std::f32::consts::LN_2;
    let part = 1.0 + t * (1.0 + t * (0.5 + t * (1.0 / 6.0 + t * (1.0 / 24.0 + t / 120.0))));
    f32::from_bits(((whole + 127.0) as u32) << 23) * part
}

/// The sum of products, in lanes: in one order after the other it takes several times as long.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 16;
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut sums = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        sums.iter_mut().zip(a).zip(b).for_each(|((sum, a), b)| *sum += a * b);
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    rest + sums.iter().sum::<f32>()
}

impl<const N: usize> Together<N> {
    pub(crate) fn new(powers: [f64; N]) -> Self {
        Self {
            powers: powers.into(),
            steady: false,
            information: SMatrix::identity() * PRIOR_INFORMATION,
            expected: SVector::zeros(),
            covariance: SMatrix::zeros(),
        }
    }

    /// As [`Together::new`], with powers that go by steady steps: of many outcomes they cost less.
    pub(crate) fn steady(powers: [f64; N]) -> Self {
        Self { steady: true, ..Self::new(powers) }
    }

    pub(crate) fn powers(&self) -> [f64; N] {
        self.powers.into()
    }

    /// What is kept across restarts: the powers, and what is known of them, column by column.
    pub(crate) fn state(&self) -> impl Iterator<Item = &f64> {
        self.powers.iter().chain(&self.information)
    }

    /// Powers that were stored without what is known of them; those that cannot be are ignored.
    pub(crate) fn restore_powers(&mut self, powers: [f64; N]) {
        if powers.iter().all(|power| POWERS.contains(power)) {
            self.powers = powers.into();
        }
    }

    /// Takes up a state; what cannot be is ignored.
    pub(crate) fn restore(&mut self, powers: [f64; N], information: &[f64]) {
        let information = (information.len() == N * N).then(|| SMatrix::<f64, N, N>::from_column_slice(information));
        let possible = |matrix: &SMatrix<f64, N, N>| {
            matrix.iter().all(|cell| cell.is_finite()) && matrix == &matrix.transpose() && matrix.cholesky().is_some()
        };
        let Some(information) = information.filter(possible) else { return };
        self.restore_powers(powers);
        self.information = information;
    }

    /// Multiplies forecasts into `out`; what has none is `without`.
    pub(crate) fn forecast(
        &mut self,
        factors: [&[f64]; N],
        without: Option<usize>,
        logs: &mut Vec<f32>,
        out: &mut [f64],
    ) {
        let length = out.len();
        logs.clear();
        logs.resize((N + 2) * length, 0.0);
        let (sums, logs) = logs.split_at_mut(length);
        let (weighted, logs) = logs.split_at_mut(length);
        for ((logs, factor), power) in logs.chunks_exact_mut(length.max(1)).zip(factors).zip(&self.powers) {
            let power = *power as f32;
            for ((log, sum), p) in logs.iter_mut().zip(sums.iter_mut()).zip(factor) {
                *log = ln((*p as f32).max(FLOOR));
                *sum += power * *log;
            }
        }
        if let Some(sum) = without.and_then(|without| sums.get_mut(without)) {
            *sum = f32::NEG_INFINITY;
        }
        let greatest = sums.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let mut total = 0.0;
        for sum in sums.iter_mut() {
            *sum = exp(*sum - greatest);
            total += *sum;
        }
        if let Some(without) = without.filter(|without| *without < length) {
            total -= std::mem::take(&mut sums[without]);
        }
        let scale = if total > 0.0 { 1.0 / total } else { 0.0 };
        out.iter_mut().zip(sums.iter()).for_each(|(out, sum)| *out = f64::from(sum * scale));
        let row = |factor: usize| &logs[factor * length..(factor + 1) * length];
        for factor in 0..N {
            let expected = f64::from(scale * dot(row(factor), sums));
            self.expected[factor] = expected;
            if self.steady {
                continue;
            }
            weighted.iter_mut().zip(row(factor)).zip(sums.iter()).for_each(|((own, log), p)| *own = log * p);
            for other in 0..=factor {
                let of_both = f64::from(scale * dot(row(other), weighted));
                let varies = of_both - expected * self.expected[other];
                (self.covariance[(factor, other)], self.covariance[(other, factor)]) = (varies, varies);
            }
        }
    }

    /// Learns from an outcome to which the factors of the latest forecast gave these probabilities.
    pub(crate) fn learn(&mut self, given: [f64; N]) {
        let steep = SVector::<f64, N>::from_fn(|factor, _| {
            (f64::from(ln((given[factor] as f32).max(FLOOR))) - self.expected[factor]).clamp(-STEEPEST, STEEPEST)
        });
        if self.steady {
            self.powers += steep * RATE;
            self.powers.apply(|power| *power = power.clamp(*POWERS.start(), *POWERS.end()));
            return;
        }
        self.information *= KEPT;
        self.information += self.covariance;
        (0..N).for_each(|at| self.information[(at, at)] += (1.0 - KEPT) * PRIOR_INFORMATION);
        let Some(information) = self.information.cholesky() else {
            // What was known is not what it was by rounding: it is learned again.
            self.information = SMatrix::identity() * PRIOR_INFORMATION;
            return;
        };
        self.powers += information.solve(&steep);
        self.powers.apply(|power| *power = power.clamp(*POWERS.start(), *POWERS.end()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_product_learns_whom_to_follow() {
        let mut together = Together::new([0.5, 0.5]);
        let (right, wrong) = ([0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]);
        let (mut logs, mut out) = (Vec::new(), [0.0; 4]);
        together.forecast([&right, &wrong], None, &mut logs, &mut out);
        assert!((out[0] - out[3]).abs() < 1e-4 && (out.iter().sum::<f64>() - 1.0).abs() < 1e-5, "{out:?}");
        for turn in 0..1000 {
            together.forecast([&right, &wrong], None, &mut logs, &mut out);
            let truth = if turn % 10 < 7 { 0 } else { 1 + turn % 3 };
            together.learn([right[truth], wrong[truth]]);
        }
        assert!(together.powers()[0] > 0.7 && together.powers()[1] < 0.2, "{together:?}");
        together.forecast([&right, &wrong], Some(0), &mut logs, &mut out);
        assert!(out[0] == 0.0 && (out.iter().sum::<f64>() - 1.0).abs() < 1e-5, "{out:?}");
    }

    proptest! {
        #[test]
        fn logarithms_and_powers_are_those_of_the_library(x in 1e-7..1.0f32) {
            prop_assert!((ln(x) - x.ln()).abs() < 2e-4, "{} {}", ln(x), x.ln());
            prop_assert!((exp(x.ln()) / x - 1.0).abs() < 2e-4);
        }

        #[test]
        fn whatever_is_learned_it_is_a_forecast(
            rows in prop::collection::vec([0.0..1.0f64, 0.0..1.0f64, 0.0..1.0f64], 1..12),
            truths in prop::collection::vec(0..12usize, 0..200),
        ) {
            let mut together = Together::new([0.6, 0.3, 0.1]);
            let factors: [Vec<f64>; 3] = std::array::from_fn(|i| rows.iter().map(|row| row[i]).collect());
            let (mut logs, mut out) = (Vec::new(), vec![0.0; rows.len()]);
            for truth in truths {
                let truth = truth % rows.len();
                together.forecast([&factors[0], &factors[1], &factors[2]], None, &mut logs, &mut out);
                together.learn(rows[truth]);
                prop_assert!((out.iter().sum::<f64>() - 1.0).abs() < 1e-4 && out.iter().all(|p| *p >= 0.0));
            }
        }
    }
}
