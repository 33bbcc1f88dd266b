//! Several forecasts as one, by fixed share (Herbster and Warmuth, "Tracking the Best Expert"), with its bound.
//!
//! After every outcome the weight of each expert is multiplied by the probability that it gave to what happened, and a share of all
//! weight goes back to where the weights began. With prior weights `v` and share `a`, over `T` outcomes the total loss of the mixture
//! in nats exceeds the loss of expert `i` by at most
//!
//! ```text
//! ln(1 / v_i) + (T - 1) ln(1 / (1 - a + a v_i))
//! ```
//!
//! and the loss of any sequence of experts with `m` changes by at most one more `ln(1 / (a v))` per change. If outcomes come so often that many are
//! alike, probabilities are raised to a power `r` below one. Both bounds then grow by the factor `1 / r`.

/// The weights of `N` experts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FixedShare<const N: usize> {
    weights: [f64; N],
    prior: [f64; N],
}

impl<const N: usize> FixedShare<N> {
    pub(crate) fn new(prior: [f64; N]) -> Self {
        Self { weights: prior, prior }
    }

    /// As [`FixedShare::new`], with the first expert's weight set; the prior divides the rest among the others. The bound then uses this weight, and
    /// shares still go to the prior.
    pub(crate) fn beginning_with(first: f64, prior: [f64; N]) -> Self {
        let mut weights = prior;
        let rest: f64 = prior.iter().skip(1).sum();
        if rest <= 0.0 {
            return Self { weights: prior, prior };
        }
        weights.iter_mut().skip(1).for_each(|weight| *weight *= (1.0 - first) / rest);
        weights.iter_mut().take(1).for_each(|weight| *weight = first);
        Self { weights, prior }
    }

    /// The prior without the experts that do not count.
    pub(crate) fn of(prior: [f64; N], counts: [bool; N]) -> [f64; N] {
        let mut prior = prior;
        prior.iter_mut().zip(counts).filter(|(_, counts)| !counts).for_each(|(p, _)| *p = 0.0);
        let total: f64 = prior.iter().sum();
        prior.map(|p| p / total)
    }

    /// The weights of the experts; they sum to one.
    pub(crate) fn weights(&self) -> &[f64; N] {
        &self.weights
    }

    /// The weights, to restore stored ones.
    pub(crate) fn weights_mut(&mut self) -> &mut [f64] {
        &mut self.weights
    }

    /// The mixture's probability of an outcome with these probabilities of the experts.
    pub(crate) fn mix(&self, probabilities: &[f64; N]) -> f64 {
        self.weights.iter().zip(probabilities).map(|(weight, p)| weight * p).sum()
    }

    /// Learns from an outcome to which the experts gave `probabilities`; `rate` is above 0 and at most 1.
    pub(crate) fn learn(&mut self, probabilities: &[f64; N], share: f64, rate: f64) {
        let prior = &self.prior;
        let mut total = 0.0;
        for (weight, p) in self.weights.iter_mut().zip(probabilities) {
            let p = p.max(f64::MIN_POSITIVE);
            *weight *= if rate == 1.0 { p } else { p.powf(rate) };
            total += *weight;
        }
        if !(total > 0.0 && total.is_finite()) {
            self.weights = *prior;
            return;
        }
        for (weight, prior) in self.weights.iter_mut().zip(prior) {
            *weight = (1.0 - share) * *weight / total + share * prior;
        }
    }
}

/// The most that the mixture can lose to expert `i`, with prior weight `prior`, over `outcomes`, in nats.
#[cfg(test)]
pub(crate) fn bound_nats(prior: f64, share: f64, outcomes: usize) -> f64 {
    -prior.ln() - (outcomes.max(1) - 1) as f64 * (1.0 - share + share * prior).ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn no_expert_is_better_by_more_than_the_bound(
            outcomes in prop::collection::vec([1e-9..1.0f64, 1e-9..1.0f64, 1e-9..1.0f64], 1..400),
            share in 0.0..0.2f64,
            first in 0.05..0.9f64,
            rate in prop::sample::select(vec![1.0, 0.3, 0.05]),
        ) {
            let prior = [first, (1.0 - first) * 0.75, (1.0 - first) * 0.25];
            let mut mixture = FixedShare::new(prior);
            let (mut loss, mut losses) = (0.0, [0.0; 3]);
            for outcome in &outcomes {
                loss -= mixture.mix(outcome).ln();
                losses.iter_mut().zip(outcome).for_each(|(sum, p)| *sum -= p.ln());
                mixture.learn(outcome, share, rate);
                prop_assert!((mixture.weights().iter().sum::<f64>() - 1.0).abs() < 1e-9);
            }
            for (own, prior) in losses.into_iter().zip(prior) {
                prop_assert!(loss <= own + bound_nats(prior, share, outcomes.len()) / rate + 1e-6);
            }
        }

        /// The tracking bound: a sequence of experts pays once per change.
        #[test]
        fn a_change_of_the_best_expert_costs_once(at in 1..200usize, more in 1..200usize, share in 0.005..0.1f64) {
            let prior = [0.5, 0.5];
            let mut mixture = FixedShare::new(prior);
            let mut loss = 0.0;
            for outcome in 0..at + more {
                let p = if outcome < at { [0.9, 0.1] } else { [0.1, 0.9] };
                loss -= mixture.mix(&p).ln();
                mixture.learn(&p, share, 1.0);
            }
            let best = -0.9f64.ln() * (at + more) as f64;
            let switched = -(share * 0.5).ln();
            prop_assert!(loss <= best + bound_nats(0.5, share, at + more) + switched + 1e-6);
        }
    }
}
