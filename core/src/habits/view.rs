//! What a person's counts add to a forecast, over those of the other persons in the home.
//!
//! Absolute discount with interpolation, as in Kneser-Ney smoothing and the sequence memoizer: what a context has seen keeps its count less a
//! discount, and what that frees goes to the forecast of the shorter context:
//!
//! ```text
//! p(w) = (n_w - d_w) / (N + c) + (c + D) / (N + c) p'(w),   d_w = min(d, n_w),  D = sum of d_w
//! ```

use super::context::{Context, Level, Without, minute};
use super::counts::{Counts, Seen};
use super::names::Home;

/// Most other persons in a prior: those with the most observations.
pub(crate) const OTHERS_MAX: usize = 3;
/// Own observations that outweigh one observation of another person.
const OTHERS_STRENGTH: f64 = 4.0;

/// The counts and the home, for one event or forecast of a person.
#[derive(Debug)]
pub(crate) struct View<'a> {
    pub(crate) counts: &'a mut Counts,
    pub(crate) home: &'a Home,
    pub(crate) slot: u8,
    /// The persons with the most observations, with their slots, the first of them in use.
    pub(crate) others: [(f64, Option<u8>); OTHERS_MAX + 1],
    pub(crate) now_min: u32,
    pub(crate) without: Without,
    pub(crate) learns: bool,
}

impl View<'_> {
    /// Counts a symbol in a context, if this is learned.
    pub(crate) fn count(&mut self, level: &Level, context: &Context, (symbol, weight): (u16, f64), at_s: f64) {
        if self.learns {
            self.counts.add(context.key(level, self.slot), symbol, weight, minute(at_s));
        }
    }

    /// The counts of a key, if its level is used.
    pub(crate) fn get(&self, level: &Level, key: u64) -> Option<Seen<'_>> {
        self.without.uses(level.part).then(|| self.counts.get(key, self.now_min)).flatten()
    }

    /// The counts in a context, each with its strength: first the others', then the person's.
    pub(crate) fn seen(&self, level: &Level, context: &Context) -> impl Iterator<Item = (Seen<'_>, f64)> {
        let others = self.others[..OTHERS_MAX].iter().filter_map(|(_, slot)| Some(((*slot)?, OTHERS_STRENGTH)));
        let slots = others.chain([(self.slot, 1.0)]);
        slots.filter_map(|(slot, strength)| Some((self.get(level, context.key(level, slot))?, strength)))
    }

    /// Mixes a context over the forecast `p` of a shorter one. `index` gives the place of a symbol in `p`, if any. Returns the shorter one's remaining
    /// weight, and the person's own observations.
    pub(crate) fn smooth(
        &self,
        level: &Level,
        context: &Context,
        index: impl Fn(u16) -> Option<usize>,
        p: &mut [f64],
    ) -> (f64, f64) {
        let (mut kept, mut own) = (1.0, 0.0);
        for (seen, strength) in self.seen(level, context) {
            let (left, total) = smooth(seen, [level.discount, strength * level.concentration], &index, p);
            kept *= left;
            own = if strength == 1.0 { total } else { own };
        }
        (kept, own)
    }
}

pub(crate) fn smooth(
    seen: Seen<'_>,
    [discount, concentration]: [f64; 2],
    index: impl Fn(u16) -> Option<usize>,
    p: &mut [f64],
) -> (f64, f64) {
    let (mut total, mut freed) = (0.0, 0.0);
    for (_, count) in seen.symbols().filter(|(symbol, _)| index(*symbol).is_some()) {
        total += count;
        freed += count.min(discount);
    }
    if total <= 0.0 {
        return (1.0, 0.0);
    }
    let scale = 1.0 / (total + concentration);
    let kept = (concentration + freed) * scale;
    p.iter_mut().for_each(|p| *p *= kept);
    for (symbol, count) in seen.symbols() {
        if let Some(p) = index(symbol).and_then(|index| p.get_mut(index)) {
            *p += (count - count.min(discount)) * scale;
        }
    }
    (kept, total)
}

/// Adds a weighted row to `sums`.
pub(crate) fn add(sums: &mut [f64], row: &[f64], weight: f64) {
    sums.iter_mut().zip(row).for_each(|(sum, p)| *sum += weight * p);
}

/// Scales probabilities to a sum of one; uniform if all are zero.
pub(crate) fn normalise(p: &mut [f64]) {
    let total: f64 = p.iter().sum();
    let even = 1.0 / p.len().max(1) as f64;
    p.iter_mut().for_each(|p| *p = if total > 0.0 { *p / total } else { even });
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn probabilities_stay_probabilities(
            adds in prop::collection::vec((0..12u16, 0.1..3.0f64), 0..40),
            discount in 0.0..1.0f64, concentration in 0.01..10.0f64,
        ) {
            let mut counts = Counts::new(4, 64, 0.0);
            for (symbol, weight) in adds {
                counts.add(1, symbol, weight, 0);
            }
            let mut p = [0.1; 10];
            let index = |symbol: u16| (symbol < 10).then_some(usize::from(symbol));
            let (kept, total) = counts.get(1, 0).map_or((1.0, 0.0), |seen| smooth(seen, [discount, concentration], index, &mut p));
            prop_assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            prop_assert!(p.iter().all(|p| *p > 0.0) && (0.0..=1.0).contains(&kept) && total >= 0.0);
        }
    }
}
