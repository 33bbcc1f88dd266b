//! Absolute discount with interpolation, as in Kneser-Ney smoothing and the sequence memoizer: what a context has seen keeps its
//! count less a discount, and what that frees goes to the forecast of the shorter context.

use super::counts::Seen;

/// Mixes what a context has seen over the forecast `p` of a shorter one:
///
/// ```text
/// p(w) = (n_w - d_w) / (N + c) + (c + D) / (N + c) p'(w),   d_w = min(d, n_w),  D = sum of d_w
/// ```
///
/// `index` gives the place of a symbol in `p`; symbols that have none are left out. Gives the weight that `p'` keeps, and N.
pub(crate) fn smooth(
    seen: Seen<'_>,
    discount: f64,
    concentration: f64,
    index: impl Fn(u16) -> Option<usize>,
    p: &mut [f64],
) -> (f64, f64) {
    let (mut total, mut freed) = (0.0, 0.0);
    seen.symbols().filter(|(symbol, _)| index(*symbol).is_some()).for_each(|(_, count)| {
        total += count;
        freed += count.min(discount);
    });
    if total <= 0.0 {
        return (1.0, 0.0);
    }
    let scale = 1.0 / (total + concentration);
    let kept = (concentration + freed) * scale;
    p.iter_mut().for_each(|p| *p *= kept);
    seen.symbols().for_each(|(symbol, count)| {
        if let Some(p) = index(symbol).and_then(|index| p.get_mut(index)) {
            *p += (count - count.min(discount)) * scale;
        }
    });
    (kept, total)
}

#[cfg(test)]
mod tests {
    use super::super::counts::{Counts, Limits};
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn probabilities_stay_probabilities(
            adds in prop::collection::vec((0..12u16, 0.1..3.0f64), 0..40),
            discount in 0.0..1.0f64, concentration in 0.01..10.0f64,
        ) {
            let mut counts = Counts::new(Limits { rows: 4, blocks: 64, half_life_min: 0.0 });
            for (symbol, weight) in adds {
                counts.add(1, symbol, weight, 0);
            }
            let mut p = [0.1; 10];
            let index = |symbol: u16| (symbol < 10).then_some(usize::from(symbol));
            let (kept, total) = counts.get(1, 0).map_or((1.0, 0.0), |seen| smooth(seen, discount, concentration, index, &mut p));
            prop_assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            prop_assert!(p.iter().all(|p| *p > 0.0) && (0.0..=1.0).contains(&kept) && total >= 0.0);
        }
    }
}
