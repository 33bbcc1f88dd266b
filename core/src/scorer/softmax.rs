//! The logarithm of a softmax's denominator, over one row of logits or over a few values.

/// Values per block: small enough to stay in the first-level cache between the maximum and the sum.
const BLOCK: usize = 1024;
/// Independent partial sums, so that the compiler can use the widest vector registers.
const LANES: usize = 16;

/// `ln(sum(exp(row)))` in nats, in one pass over memory.
///
/// Each block's maximum is taken first, then its exponentials are summed; a larger maximum rescales the previous sum. Returns minus infinity for an
/// empty row or a row of minus infinities. Returns NaN or plus infinity if the row holds such a value; callers refuse those.
#[must_use]
pub fn log_sum_exp(row: &[f32]) -> f64 {
    let mut highest = f32::NEG_INFINITY;
    let mut sum = 0.0_f64;
    for block in row.chunks(BLOCK) {
        let block_max = max(block);
        if block_max == f32::INFINITY {
            return f64::INFINITY;
        }
        if block_max > highest {
            sum *= (f64::from(highest) - f64::from(block_max)).exp();
            highest = block_max;
        }
        if highest > f32::NEG_INFINITY {
            sum += f64::from(sum_exp(block, highest));
        } else if block.iter().any(|value| value.is_nan()) {
            return f64::NAN;
        }
    }
    f64::from(highest) + sum.ln()
}

/// `ln(sum(exp(values)))` of a few values in nats, in double precision. Minus infinity for no values, NaN if any value is NaN.
#[must_use]
pub(crate) fn log_sum_exp_of(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let largest = values.clone().fold(f64::NEG_INFINITY, f64::max);
    if largest.is_infinite() {
        return if values.clone().any(f64::is_nan) { f64::NAN } else { largest };
    }
    largest + values.map(|value| (value - largest).exp()).sum::<f64>().ln()
}

/// The largest value, NaN ignored; a NaN shows in the sum.
fn max(block: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (chunks, rest) = block.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] = if chunk[lane] > lanes[lane] { chunk[lane] } else { lanes[lane] };
        }
    }
    lanes.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max)
}

fn sum_exp(block: &[f32], max: f32) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    let (chunks, rest) = block.as_chunks::<LANES>();
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] += exp_not_positive(chunk[lane] - max);
        }
    }
    lanes.iter().sum::<f32>() + rest.iter().map(|&x| exp_not_positive(x - max)).sum::<f32>()
}

/// `exp(x)` for `x <= 0`, without a branch, to about one unit in the last place of an f32.
///
/// `x = n ln 2 + r` with `|r| <= ln 2 / 2`; the Taylor polynomial of degree 7 on `r` leaves less than 1e-8; `2^n` is put together from its exponent
/// bits. Below -87 the result equals exp(-87), 1.6e-38.
#[inline(always)]
fn exp_not_positive(x: f32) -> f32 {
    let x = if x < -87.0 { -87.0 } else { x };
    // Adding and subtracting 1.5 * 2^23 rounds to the nearest integer.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, so that n times the first is exact.
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    // Without the instruction, `mul_add` is a slow function.
    let fused = |p: f32, term: f32| if cfg!(target_feature = "fma") { p.mul_add(r, term) } else { p * r + term };
    let p = [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0].into_iter().fold(1.0 / 5040.0, fused);
    // The low bits of `shifted` are n, in -126..=0; as an exponent it is biased by 127. An overflow check here would prevent vectorisation.
    p * f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn by_hand(row: &[f32]) -> f64 {
        let max = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        f64::from(max) + row.iter().map(|&x| (f64::from(x) - f64::from(max)).exp()).sum::<f64>().ln()
    }

    #[test]
    fn special_rows() {
        assert_eq!(log_sum_exp(&[]), f64::NEG_INFINITY);
        assert_eq!(log_sum_exp(&[f32::NEG_INFINITY; 40]), f64::NEG_INFINITY);
        assert!(log_sum_exp(&[0.0, f32::NAN]).is_nan());
        let mut row = [0.0; 64];
        row[3] = f32::NAN;
        assert!(log_sum_exp(&row).is_nan());
        let mut row = [f32::NEG_INFINITY; 2 * BLOCK];
        row[BLOCK + 5] = 1.0;
        assert!((log_sum_exp(&row) - 1.0).abs() < 1e-6);
        row[3] = f32::NAN;
        assert!(log_sum_exp(&row).is_nan(), "before the first number");
        let mut row = [0.0; 64];
        row[3] = f32::INFINITY;
        assert_eq!(log_sum_exp(&row), f64::INFINITY);
        assert!((log_sum_exp(&[0.0; 64]) - 64f64.ln()).abs() < 1e-6);
    }

    /// Flat rows have the most terms that count, and so the largest rounding errors.
    #[test]
    fn flat_rows_are_as_exact() {
        for size in [1, 15, 17, 1023, 1025, 50_001] {
            for offset in [0.0, 0.1, -7.3] {
                let row: Vec<f32> = (0..size).map(|at| offset + (at % 7) as f32 * 0.03).collect();
                assert!((log_sum_exp(&row) - by_hand(&row)).abs() < 4e-6, "{size} {offset}");
                let mut row = row;
                row[size - 1] = f32::NAN;
                assert!(log_sum_exp(&row).is_nan(), "{size} {offset}");
            }
        }
    }

    proptest::proptest! {
        #[test]
        fn agrees_with_double_precision(row in proptest::collection::vec(-200f32..200.0, 1..5000)) {
            proptest::prop_assert!((log_sum_exp(&row) - by_hand(&row)).abs() < 2e-6);
        }
    }
}
