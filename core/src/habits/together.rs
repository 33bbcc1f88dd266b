//! Several forecasts multiplied: each to a power that is learned.
//!
//! ```text
//! p(w) ~ product over i of p_i(w)^l_i
//! ```
//!
//! Where a sum of forecasts believes whichever is surest, a product keeps what all of them hold likely: of the things that the model
//! expects, those that this home has. The powers go down the gradient of the loss after every outcome. A product may be worse than any
//! of its factors; it is one expert among others of a mixture with a bound.

/// How far the powers go along a gradient.
const RATE: f64 = 0.01;
/// The longest step of a gradient, and the range of the powers.
const STEEPEST: f64 = 10.0;
const POWERS: std::ops::RangeInclusive<f64> = -0.5..=1.5;
/// What is less likely than this is no better known to be so.
const FLOOR: f32 = 1e-7;

/// The powers of `N` forecasts, and what the latest forecast says of the logarithms of each.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Together<const N: usize> {
    powers: [f64; N],
    expected: [f64; N],
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

impl<const N: usize> Together<N> {
    pub(crate) fn new(powers: [f64; N]) -> Self {
        Self { powers, expected: [0.0; N] }
    }

    pub(crate) fn powers(&self) -> &[f64; N] {
        &self.powers
    }

    /// Powers that were stored; those that cannot be are ignored.
    pub(crate) fn restore(&mut self, powers: [f64; N]) {
        if powers.iter().all(|power| POWERS.contains(power)) {
            self.powers = powers;
        }
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
        logs.resize((N + 1) * length, 0.0);
        let (sums, logs) = logs.split_at_mut(length);
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
        for (expected, logs) in self.expected.iter_mut().zip(logs.chunks_exact(length.max(1))) {
            let sum: f32 = logs.iter().zip(sums.iter()).map(|(log, p)| log * p).sum();
            *expected = f64::from(sum * scale);
        }
    }

    /// Learns from an outcome to which the factors of the latest forecast gave these probabilities.
    pub(crate) fn learn(&mut self, given: [f64; N]) {
        for ((power, expected), p) in self.powers.iter_mut().zip(&self.expected).zip(given) {
            let steep = (f64::from(ln((p as f32).max(FLOOR))) - expected).clamp(-STEEPEST, STEEPEST);
            *power = (*power + RATE * steep).clamp(*POWERS.start(), *POWERS.end());
        }
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
