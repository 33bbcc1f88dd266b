//! Sets of places with a promise: how often they hold the person, on the long run, whatever the forecast is worth.
//!
//! Adaptive conformal inference (Gibbs and Candes): a set takes the places whose probability is at least a threshold, a quantile of
//! the probabilities that the truth had of late; the quantile asked moves by a step after every hit and miss, so that the share of
//! misses goes to what is asked even while the home changes. What happened is known only a horizon later, and is learned then. Of all
//! sets with the same coverage these have the fewest places on average.
//!
//! Where nothing is likely a set may be empty; that belongs to the coverage asked. Whoever must not be told nothing asks for
//! [`SetOptions::never_empty`], and is then right more often than asked.

/// What sets promise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SetOptions {
    /// Share of moments in which the person is to be in the set, 0 to 1.
    pub coverage: f64,
    /// How far the quantile moves after each outcome.
    pub step: f64,
    /// Always take the likeliest place: the coverage is then at least what is asked.
    pub never_empty: bool,
}

impl Default for SetOptions {
    fn default() -> Self {
        Self { coverage: 0.9, step: 0.005, never_empty: true }
    }
}

/// What a set is made by.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Issued {
    threshold: f64,
}

impl Issued {
    /// Whether the set holds `place`, without regard to [`SetOptions::never_empty`].
    #[must_use]
    pub fn holds(&self, probabilities: &[f64], place: usize) -> bool {
        probabilities.get(place).is_some_and(|p| 1.0 - p <= self.threshold)
    }
}

/// How far beyond 0 and 1 the share of misses may be owed.
const SERIES: f64 = 0.5;
/// Outcomes whose scores are remembered.
pub(crate) const SCORES: usize = 600;

/// The sets of one horizon.
#[derive(Debug, Clone, PartialEq)]
pub struct AdaptiveSets {
    options: SetOptions,
    /// Share of misses that the quantile is set for.
    miss: f64,
    /// Scores, one less the probability of the truth, as they came, the oldest at `oldest` once there are [`SCORES`], and sorted.
    scores: Vec<f32>,
    sorted: Vec<f32>,
    oldest: usize,
    outcomes: u64,
}

impl AdaptiveSets {
    /// Sets that have seen nothing: they begin with the places of a tenth or more.
    #[must_use]
    pub fn new(options: SetOptions) -> Self {
        let coverage = options.coverage.clamp(0.0, 1.0);
        Self {
            options: SetOptions { coverage, ..options },
            miss: 1.0 - coverage,
            scores: Vec::with_capacity(SCORES),
            sorted: Vec::with_capacity(SCORES),
            oldest: 0,
            outcomes: 0,
        }
    }

    /// How many outcomes were learned from.
    #[must_use]
    pub fn outcomes(&self) -> u64 {
        self.outcomes
    }

    /// The score up to which places are taken.
    fn threshold(&self) -> f64 {
        /// With fewer outcomes a quantile says little.
        const FEW: usize = 20;
        if self.miss <= 0.0 {
            return f64::INFINITY;
        }
        if self.miss >= 1.0 {
            return f64::NEG_INFINITY;
        }
        if self.sorted.len() < FEW {
            return 0.9;
        }
        let rank = ((1.0 - self.miss) * (self.sorted.len() + 1) as f64).ceil() as usize;
        match self.sorted.get(rank.max(1) - 1) {
            Some(score) => f64::from(*score),
            None => f64::INFINITY,
        }
    }

    /// What a set of this moment is made by.
    #[must_use]
    pub fn issue(&self) -> Issued {
        Issued { threshold: self.threshold() }
    }

    /// Which of the places with these probabilities are in the set.
    pub fn set(&self, probabilities: &[f64], issued: Issued, set: &mut Vec<bool>) {
        set.clear();
        set.extend((0..probabilities.len()).map(|place| issued.holds(probabilities, place)));
        if self.options.never_empty {
            let likeliest = (0..probabilities.len()).max_by(|a, b| probabilities[*a].total_cmp(&probabilities[*b]));
            if let Some(likeliest) = likeliest {
                set[likeliest] = true;
            }
        }
    }

    /// Learns where the person was when the horizon had passed; `probabilities` and `issued` are those of the moment of the forecast.
    pub fn learn(&mut self, probabilities: &[f64], issued: Issued, truth: usize) {
        if truth >= probabilities.len() {
            return;
        }
        let hit = issued.holds(probabilities, truth);
        let score = (1.0 - probabilities[truth]) as f32;
        if self.scores.len() < SCORES {
            self.scores.push(score);
        } else {
            let old = std::mem::replace(&mut self.scores[self.oldest], score);
            self.oldest = (self.oldest + 1) % SCORES;
            let at = self.sorted.partition_point(|other| *other < old);
            if at < self.sorted.len() {
                self.sorted.remove(at);
            }
        }
        let at = self.sorted.partition_point(|other| *other < score);
        self.sorted.insert(at, score);
        let asked = 1.0 - self.options.coverage;
        self.miss += self.options.step * (asked - f64::from(u8::from(!hit)));
        // Beyond 0 and 1 all or nothing is taken, until what went wrong in a long series is made good.
        self.miss = self.miss.clamp(-SERIES, 1.0 + SERIES);
        self.outcomes += 1;
    }

    /// What is kept across restarts: the share of misses and the scores, oldest first.
    pub(crate) fn state(&self) -> (f64, u64, impl ExactSizeIterator<Item = f32>) {
        let (newer, older) = self.scores.split_at(self.oldest.min(self.scores.len()));
        let count = self.scores.len();
        (self.miss, self.outcomes, (0..count).map(move |at| *older.get(at).unwrap_or_else(|| &newer[at - older.len()])))
    }

    /// Takes up a state; scores that are none are left out.
    pub(crate) fn restore(&mut self, miss: f64, outcomes: u64, scores: impl Iterator<Item = f32>) {
        self.scores.clear();
        self.scores.extend(scores.filter(|score| (0.0..=1.1).contains(score)).take(SCORES));
        self.sorted.clone_from(&self.scores);
        self.sorted.reserve(SCORES - self.sorted.len());
        self.sorted.sort_by(f32::total_cmp);
        self.oldest = 0;
        self.outcomes = outcomes;
        if miss.is_finite() {
            self.miss = miss.clamp(-SERIES, 1.0 + SERIES);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A forecast that is wrong in its confidence, and a home that changes half-way.
    fn coverage(never_empty: bool, seed: u64, late: usize) -> (f64, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut sets = AdaptiveSets::new(SetOptions { never_empty, ..SetOptions::default() });
        let (mut held, mut size, mut set) = (0.0, 0.0, Vec::new());
        let mut waiting = std::collections::VecDeque::new();
        const MOMENTS: usize = 8000;
        for moment in 0..MOMENTS {
            let likely = if moment < MOMENTS / 2 { 0.97 } else { 0.6 };
            // Not quite the same each time.
            let p: Vec<f64> = vec![0.8, 0.1, 0.05, 0.05].into_iter().map(|p| p * rng.random_range(0.9..1.0)).collect();
            let truth = if rng.random::<f64>() < likely { 0 } else { rng.random_range(1..4) };
            let issued = sets.issue();
            sets.set(&p, issued, &mut set);
            held += f64::from(u8::from(set[truth]));
            size += set.iter().filter(|held| **held).count() as f64;
            waiting.push_back((p, issued, truth));
            if waiting.len() > late {
                let (p, issued, truth) = waiting.pop_front().unwrap();
                sets.learn(&p, issued, truth);
            }
        }
        (held / MOMENTS as f64, size / MOMENTS as f64)
    }

    #[test]
    fn the_coverage_is_what_was_asked_even_when_the_home_changes_and_labels_come_late() {
        for late in [0, 15, 60] {
            let (exact, _) = coverage(false, 1, late);
            assert!((exact - 0.9).abs() < 0.01, "{exact}");
            let (at_least, size) = coverage(true, 1, late);
            assert!(at_least > 0.9 && size >= 1.0, "{at_least}");
        }
    }

    proptest! {
        #[test]
        fn a_set_takes_the_likelier_first_and_state_survives(
            raw in prop::collection::vec(0.01..1.0f64, 2..8),
            truths in prop::collection::vec(0..8usize, 0..700),
        ) {
            let total: f64 = raw.iter().sum();
            let p: Vec<f64> = raw.iter().map(|p| p / total).collect();
            let mut sets = AdaptiveSets::new(SetOptions::default());
            for truth in truths {
                sets.learn(&p, sets.issue(), truth);
            }
            let mut set = Vec::new();
            sets.set(&p, sets.issue(), &mut set);
            let least_in = (0..p.len()).filter(|i| set[*i]).map(|i| p[i]).fold(f64::INFINITY, f64::min);
            prop_assert!((0..p.len()).all(|i| set[i] || p[i] <= least_in) && set.contains(&true));
            let (miss, outcomes, scores) = sets.state();
            let mut again = AdaptiveSets::new(SetOptions::default());
            again.restore(miss, outcomes, scores);
            let mut other = Vec::new();
            again.set(&p, again.issue(), &mut other);
            prop_assert_eq!(set, other);
        }
    }
}
