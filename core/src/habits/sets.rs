//! Sets of places that hold the person with the promised coverage in the long run, however good the forecast is.
//!
//! Adaptive conformal inference (Gibbs and Candes): a set takes the places with at least a threshold probability, a quantile of the probabilities
//! of true places. The quantile moves by a step after every hit and miss, so that the share of misses converges to the target even while the home
//! changes. A night is one long hit, so the quantile covers about a week: with a memory of hours, sets would be small at night and whole homes by day.

/// Step of the quantile after each outcome.
const STEP: f64 = 0.0005;
/// How far the share of misses may go below 0 and above 1.
const SERIES: f64 = 0.5;
/// Classes of probabilities of true places, of equal width in [`odds`].
const CLASSES: usize = 256;
/// Probabilities are clamped to this distance from 0 and 1.
const NEAREST: f64 = 1e-4;
/// Outcomes after which one counts half: five days of minutes.
const HALF_LIFE: f64 = 7_200.0;
/// With fewer outcomes a quantile is unreliable: sets take places of a tenth or more.
const FEW: f64 = 20.0;
const AT_FIRST: f64 = 0.1;
/// Rounding error of a sum of probabilities.
const ROUNDING: f64 = 1e-9;

/// The logarithm of the odds of a probability, in nats.
fn odds(p: f64) -> f64 {
    let p = p.clamp(NEAREST, 1.0 - NEAREST);
    (p / (1.0 - p)).ln()
}

/// The sets of one horizon.
#[derive(Debug, Clone, PartialEq)]
pub struct AdaptiveSets {
    coverage: f64,
    never_empty: bool,
    /// Share of misses of the quantile.
    miss: f64,
    /// Per class, the least likely first, decayed number of true places, and their sum.
    seen: Vec<f64>,
    total: f64,
    threshold: f64,
}

impl AdaptiveSets {
    /// Sets without outcomes: they take places of a tenth or more. Sets that are `never_empty` always take the likeliest place: their coverage is at
    /// least the promised one.
    #[must_use]
    pub fn new(coverage: f64, never_empty: bool) -> Self {
        let coverage = coverage.clamp(0.0, 1.0);
        let (miss, seen) = (1.0 - coverage, vec![0.0; CLASSES]);
        let mut sets = Self { coverage, never_empty, miss, seen, total: 0.0, threshold: 0.0 };
        sets.threshold = sets.least();
        sets
    }

    fn least(&self) -> f64 {
        if self.miss >= 1.0 {
            return f64::INFINITY;
        }
        if self.miss > 0.0 && self.knows_little() {
            return AT_FIRST;
        }
        // Misses that the quantile allows, with the next outcome included.
        let mut misses = self.miss * (self.total + 1.0) - 1.0;
        if misses < 0.0 {
            return 0.0;
        }
        for (class, seen) in self.seen.iter().enumerate() {
            if *seen > misses {
                let at = 2.0 * odds(1.0) * ((class as f64 + misses / seen) / CLASSES as f64 - 0.5);
                return 1.0 / (1.0 + (-at).exp());
            }
            misses -= seen;
        }
        1.0 - NEAREST
    }

    /// The least probability of a place in a set that is made now.
    #[must_use]
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// Writes the places of the set with this threshold.
    pub fn set(&self, probabilities: &[f64], threshold: f64, set: &mut Vec<bool>) {
        set.clear();
        set.extend(probabilities.iter().map(|p| *p >= threshold));
        let likeliest = (0..probabilities.len()).max_by(|a, b| probabilities[*a].total_cmp(&probabilities[*b]));
        if let Some(likeliest) = likeliest.filter(|_| self.never_empty) {
            set[likeliest] = true;
        }
    }

    /// Whether there were too few outcomes for a learned threshold.
    pub(crate) fn knows_little(&self) -> bool {
        self.total < FEW
    }

    /// Writes the fewest places with the coverage in sum.
    pub(crate) fn cover(&self, probabilities: &[f64], set: &mut Vec<bool>) {
        set.clear();
        set.resize(probabilities.len(), false);
        let mut held = 0.0;
        while held < self.coverage - ROUNDING || self.never_empty && held <= 0.0 {
            let open = (0..probabilities.len()).rev().filter(|place| !set[*place]);
            let Some(next) = open.max_by(|a, b| probabilities[*a].total_cmp(&probabilities[*b])) else { return };
            set[next] = true;
            held += probabilities[next];
        }
    }

    /// Learns the forecast's probability of the person's place after the horizon; `threshold` is the one of the set.
    pub fn learn(&mut self, p: f64, threshold: f64) {
        let kept = (-1.0 / HALF_LIFE).exp2();
        self.seen.iter_mut().for_each(|seen| *seen *= kept);
        let class = (odds(p) / (2.0 * odds(1.0)) + 0.5) * CLASSES as f64;
        self.seen[(class as usize).min(CLASSES - 1)] += 1.0;
        self.total = self.total * kept + 1.0;
        self.miss += STEP * (1.0 - self.coverage - f64::from(u8::from(p < threshold)));
        // Beyond 0 and 1 sets hold all places or no place, until a long series of misses or hits is balanced.
        self.miss = self.miss.clamp(-SERIES, 1.0 + SERIES);
        self.threshold = self.least();
    }

    /// State for restarts: the share of misses, and the decayed number of true places per class.
    pub(crate) fn state(&self) -> (f64, Vec<f32>) {
        (self.miss, self.seen.iter().map(|seen| *seen as f32).collect())
    }

    /// Restores a state without its impossible values.
    pub(crate) fn restore(&mut self, miss: f64, seen: &[f32]) {
        let possible = |seen: &f32| if seen.is_finite() && *seen > 0.0 { f64::from(*seen) } else { 0.0 };
        self.seen.iter_mut().zip(seen).for_each(|(own, seen)| *own = possible(seen));
        self.total = self.seen.iter().sum();
        if miss.is_finite() {
            self.miss = miss.clamp(-SERIES, 1.0 + SERIES);
        }
        self.threshold = self.least();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Overconfident forecasts in a home that changes half-way.
    fn coverage(never_empty: bool, seed: u64, late: usize) -> (f64, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut sets = AdaptiveSets::new(0.9, never_empty);
        let (mut held, mut size, mut set) = (0.0, 0.0, Vec::new());
        let mut waiting = std::collections::VecDeque::new();
        // Two weeks of minutes.
        const MOMENTS: usize = 20_160;
        for moment in 0..MOMENTS {
            let likely = if moment < MOMENTS / 2 { 0.97 } else { 0.6 };
            // Probabilities vary a little.
            let p: Vec<f64> = vec![0.8, 0.1, 0.05, 0.05].into_iter().map(|p| p * rng.random_range(0.9..1.0)).collect();
            let truth = if rng.random::<f64>() < likely { 0 } else { rng.random_range(1..4) };
            let threshold = sets.threshold();
            sets.set(&p, threshold, &mut set);
            held += f64::from(u8::from(set[truth]));
            size += set.iter().filter(|held| **held).count() as f64;
            waiting.push_back((p[truth], threshold));
            if waiting.len() > late {
                let (p, threshold) = waiting.pop_front().unwrap();
                sets.learn(p, threshold);
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
        /// A covering set has the coverage, takes the likeliest places, and is minimal.
        #[test]
        fn what_is_covered_is_what_was_promised(
            raw in prop::collection::vec(prop_oneof![Just(0.0), Just(0.5), 0.0..1.0f64], 1..65),
            coverage in 0.0..=1.0f64,
        ) {
            let total = raw.iter().sum::<f64>().max(f64::MIN_POSITIVE);
            let p: Vec<f64> = raw.iter().map(|p| p / total).collect();
            let mut set = vec![true; 3];
            AdaptiveSets::new(coverage, true).cover(&p, &mut set);
            prop_assert_eq!(set.len(), p.len());
            let held = |set: &[bool]| p.iter().zip(set).filter(|(_, held)| **held).map(|(p, _)| p).sum::<f64>();
            prop_assert!(held(&set) >= coverage - 1e-6 || !set.contains(&false));
            prop_assert!(set.contains(&true));
            let least = (0..p.len()).filter(|place| set[*place]).min_by(|a, b| p[*a].total_cmp(&p[*b])).unwrap();
            prop_assert!((0..p.len()).all(|place| set[place] || p[place] <= p[least]));
            set[least] = false;
            prop_assert!(held(&set) < coverage || !set.contains(&true) || held(&set) <= 0.0);
        }

        #[test]
        fn a_set_takes_the_likelier_first_and_state_survives(
            raw in prop::collection::vec(0.01..1.0f64, 2..8),
            truths in prop::collection::vec(0..8usize, 0..700),
        ) {
            let total: f64 = raw.iter().sum();
            let p: Vec<f64> = raw.iter().map(|p| p / total).collect();
            let mut sets = AdaptiveSets::new(0.9, true);
            for truth in truths.into_iter().filter(|truth| *truth < p.len()) {
                sets.learn(p[truth], sets.threshold());
            }
            let mut set = Vec::new();
            sets.set(&p, sets.threshold(), &mut set);
            let least_in = (0..p.len()).filter(|i| set[*i]).map(|i| p[i]).fold(f64::INFINITY, f64::min);
            prop_assert!((0..p.len()).all(|i| set[i] || p[i] <= least_in) && set.contains(&true));
            let (miss, seen) = sets.state();
            let mut again = AdaptiveSets::new(0.9, true);
            again.restore(miss, &seen);
            let mut other = Vec::new();
            again.set(&p, again.threshold(), &mut other);
            prop_assert_eq!(set, other);
        }
    }
}
