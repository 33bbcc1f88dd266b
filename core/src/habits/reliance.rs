//! How far a context is relied on: what it leaves to the forecast of the shorter one is learned, for contexts of each length by how
//! often they were seen and how many different things followed.
//!
//! ```text
//! p(w) = (1 - e) n_w / N + e p'(w)
//! ```
//!
//! A home where everything follows a routine and one where nothing does need different `e`. It begins as the discounts of
//! [`super::smoothing`] would have it, and goes to the share of outcomes that were the shorter forecast's doing: `e p'(w) / p(w)` on
//! average, the step of expectation maximisation, one outcome at a time.

use super::counts::Seen;

/// Contexts have 0 to 5 things.
pub(crate) const ORDERS: usize = 6;
/// Numbers of observations below which they are told apart.
const SEEN: [f64; 5] = [0.6, 1.5, 2.5, 5.0, 10.0];
/// What an observation of each range counts for at the beginning.
const SEEN_TYPICAL: [f64; SEEN.len() + 1] = [0.4, 1.0, 2.0, 3.5, 7.0, 20.0];
/// Different things that are told apart: one, two, more.
const KINDS_MAX: usize = 3;
/// Cells of what is learned.
pub(crate) const CELLS: usize = ORDERS * SEEN_TYPICAL.len() * KINDS_MAX;
const DISCOUNT: f64 = 0.5;
const CONCENTRATIONS: [f64; ORDERS] = [4.0, 2.0, 1.0, 0.5, 0.5, 0.5];
/// How many outcomes the beginning is worth, and how many are remembered.
const PRIOR_STRENGTH: f64 = 8.0;
const REMEMBERED: f64 = 400.0;
/// Nothing is certain, and nothing without any use.
const LEAST: f64 = 0.002;

/// What contexts leave to the shorter ones, and from how many outcomes that is known.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Reliance {
    cells: [[f64; 2]; CELLS],
}

fn cell(order: usize, total: f64, kinds: usize) -> usize {
    let seen = SEEN.iter().position(|end| total < *end).unwrap_or(SEEN.len());
    (order * SEEN_TYPICAL.len() + seen) * KINDS_MAX + kinds.clamp(1, KINDS_MAX) - 1
}

impl Reliance {
    pub(crate) fn new() -> Self {
        let begin = |cell: usize| {
            let (kinds, rest) = (cell % KINDS_MAX + 1, cell / KINDS_MAX);
            let (seen, order) = (SEEN_TYPICAL[rest % SEEN_TYPICAL.len()], rest / SEEN_TYPICAL.len());
            let freed = (DISCOUNT * kinds as f64).min(DISCOUNT * seen);
            let concentration = CONCENTRATIONS[order];
            [(concentration + freed) / (concentration + seen), PRIOR_STRENGTH]
        };
        Self { cells: std::array::from_fn(begin) }
    }

    /// How many observations the shorter context is worth at the beginning.
    pub(crate) fn concentration(order: usize) -> f64 {
        CONCENTRATIONS[order]
    }

    /// Mixes what a context has seen over the forecast `p` of a shorter one. Gives the cell that says how, the weight that the shorter
    /// one keeps, and the number of observations; no cell where nothing was seen.
    pub(crate) fn blend(
        &self,
        order: usize,
        seen: Option<Seen<'_>>,
        index: impl Fn(u16) -> Option<usize>,
        p: &mut [f64],
    ) -> (Option<(usize, f64)>, f64) {
        let Some(seen) = seen else { return (None, 0.0) };
        let (mut total, mut kinds) = (0.0, 0);
        seen.symbols().filter(|(symbol, _)| index(*symbol).is_some()).for_each(|(_, count)| {
            total += count;
            kinds += 1;
        });
        if total <= 0.0 {
            return (None, 0.0);
        }
        let cell = cell(order, total, kinds);
        let left = self.cells[cell][0];
        p.iter_mut().for_each(|p| *p *= left);
        let scale = (1.0 - left) / total;
        seen.symbols().for_each(|(symbol, count)| {
            if let Some(p) = index(symbol).and_then(|index| p.get_mut(index)) {
                *p += count * scale;
            }
        });
        (Some((cell, left)), total)
    }

    /// Learns which share of an outcome's probability was the shorter forecast's.
    pub(crate) fn learn(&mut self, cell: usize, share: f64) {
        let [left, outcomes] = &mut self.cells[cell];
        *outcomes = (*outcomes + 1.0).min(REMEMBERED);
        *left = (*left + (share - *left) / *outcomes).clamp(LEAST, 1.0 - LEAST);
    }

    /// What is kept across restarts.
    pub(crate) fn state(&self) -> impl Iterator<Item = &f64> {
        self.cells.iter().flatten()
    }

    /// Takes up a state; what cannot be is ignored.
    pub(crate) fn restore(&mut self, state: &[f64; 2 * CELLS]) {
        for (own, [left, outcomes]) in self.cells.iter_mut().zip(state.as_chunks::<2>().0) {
            if (LEAST..=1.0 - LEAST).contains(left) && (1.0..=REMEMBERED).contains(outcomes) {
                *own = [*left, *outcomes];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::counts::{Counts, Limits};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_home_of_routines_is_relied_on_and_one_without_is_not() {
        let mut reliance = Reliance::new();
        let mut counts = Counts::new(Limits { rows: 4, blocks: 64, half_life_min: 0.0 });
        counts.add(1, 3, 1.0, 0);
        let index = |symbol: u16| Some(usize::from(symbol));
        let forecast = |reliance: &Reliance| {
            let mut p = [0.1; 10];
            let (used, _) = reliance.blend(3, counts.get(1, 0), index, &mut p);
            (used.unwrap(), p)
        };
        let ((_, at_first), _) = forecast(&reliance);
        for _ in 0..200 {
            let ((cell, left), p) = forecast(&reliance);
            reliance.learn(cell, left * 0.1 / p[3]);
        }
        let ((_, relied), p) = forecast(&reliance);
        assert!(relied < 0.1 && p[3] > 0.9 && at_first > 0.3, "{at_first} {relied} {p:?}");
        for _ in 0..400 {
            let ((cell, _), _) = forecast(&reliance);
            reliance.learn(cell, 1.0);
        }
        let ((_, not_relied), _) = forecast(&reliance);
        assert!(not_relied > 0.6, "{not_relied}");
    }

    proptest! {
        #[test]
        fn probabilities_stay_probabilities(
            adds in prop::collection::vec((0..12u16, 0.1..3.0f64), 0..40),
            learned in prop::collection::vec((0..CELLS, 0.0..=1.0f64), 0..300), order in 0..ORDERS,
        ) {
            let mut counts = Counts::new(Limits { rows: 4, blocks: 64, half_life_min: 0.0 });
            for (symbol, weight) in adds {
                counts.add(1, symbol, weight, 0);
            }
            let mut reliance = Reliance::new();
            learned.into_iter().for_each(|(cell, share)| reliance.learn(cell, share));
            let mut p = [0.1; 10];
            let index = |symbol: u16| (symbol < 10).then_some(usize::from(symbol));
            let (used, total) = reliance.blend(order, counts.get(1, 0), index, &mut p);
            prop_assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            prop_assert!(p.iter().all(|p| *p > 0.0) && total >= 0.0);
            prop_assert!(used.is_none_or(|(_, left)| (LEAST..=1.0 - LEAST).contains(&left)));
            let state: Vec<f64> = reliance.state().copied().collect();
            let mut again = Reliance::new();
            again.restore(state.as_slice().try_into().unwrap());
            prop_assert_eq!(again, reliance);
        }
    }
}
