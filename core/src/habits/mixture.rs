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

use super::view::normalise;

/// The weights of some experts.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FixedShare {
    /// The weights sum to one.
    pub(crate) weights: Vec<f64>,
    prior: Vec<f64>,
}

impl FixedShare {
    /// The first expert starts with the weight `first`; the prior divides the rest among the others. The bound uses this weight, and shares go back
    /// to the prior.
    pub(crate) fn new(first: f64, prior: impl Iterator<Item = f64>) -> Self {
        let mut prior: Vec<f64> = prior.collect();
        normalise(&mut prior);
        let rest: f64 = prior.iter().skip(1).sum();
        let share = |(expert, prior)| if expert == 0 { first } else { prior * ((1.0 - first) / rest) };
        let weights = if rest > 0.0 { prior.iter().enumerate().map(share).collect() } else { prior.clone() };
        Self { weights, prior }
    }

    /// Learns from an outcome to which each expert gave a probability; `rate` is above 0 and at most 1.
    pub(crate) fn learn(&mut self, probability: impl Fn(usize) -> f64, share: f64, rate: f64) {
        let mut total = 0.0;
        for (expert, weight) in self.weights.iter_mut().enumerate() {
            let p = probability(expert).max(f64::MIN_POSITIVE);
            *weight *= if rate == 1.0 { p } else { p.powf(rate) };
            total += *weight;
        }
        if !(total > 0.0 && total.is_finite()) {
            self.weights.copy_from_slice(&self.prior);
            return;
        }
        for (weight, prior) in self.weights.iter_mut().zip(&self.prior) {
            *weight = (1.0 - share) * *weight / total + share * prior;
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The most that the mixture can lose to expert `i`, with prior weight `prior`, over `outcomes`, in nats.
    pub(crate) fn bound_nats(prior: f64, share: f64, outcomes: usize) -> f64 {
        -prior.ln() - (outcomes.max(1) - 1) as f64 * (1.0 - share + share * prior).ln()
    }

    fn mix(mixture: &FixedShare, p: &[f64]) -> f64 {
        mixture.weights.iter().zip(p).map(|(weight, p)| weight * p).sum()
    }

    proptest! {
        #[test]
        fn no_expert_is_better_by_more_than_the_bound(
            outcomes in prop::collection::vec([1e-9..1.0f64, 1e-9..1.0f64, 1e-9..1.0f64], 1..400),
            share in 0.0..0.2f64,
            first in 0.05..0.9f64,
            rate in prop::sample::select(vec![1.0, 0.3, 0.05]),
        ) {
            let prior = [first, (1.0 - first) * 0.75, (1.0 - first) * 0.25];
            let mut mixture = FixedShare::new(first, prior.into_iter());
            let (mut loss, mut losses) = (0.0, [0.0; 3]);
            for outcome in &outcomes {
                loss -= mix(&mixture, outcome).ln();
                losses.iter_mut().zip(outcome).for_each(|(sum, p)| *sum -= p.ln());
                mixture.learn(|expert| outcome[expert], share, rate);
                prop_assert!((mixture.weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            }
            for (own, prior) in losses.into_iter().zip(prior) {
                prop_assert!(loss <= own + bound_nats(prior, share, outcomes.len()) / rate + 1e-6);
            }
        }

        /// The tracking bound: a sequence of experts pays once per change.
        #[test]
        fn a_change_of_the_best_expert_costs_once(at in 1..200usize, more in 1..200usize, share in 0.005..0.1f64) {
            let mut mixture = FixedShare::new(0.5, [0.5, 0.5].into_iter());
            let mut loss = 0.0;
            for outcome in 0..at + more {
                let p = if outcome < at { [0.9, 0.1] } else { [0.1, 0.9] };
                loss -= mix(&mixture, &p).ln();
                mixture.learn(|expert| p[expert], share, 1.0);
            }
            let best = -0.9f64.ln() * (at + more) as f64;
            let switched = -(share * 0.5).ln();
            prop_assert!(loss <= best + bound_nats(0.5, share, at + more) + switched + 1e-6);
        }
    }
}
