//! Scores of probabilistic forecasts, summed per group, with bootstrap intervals over groups.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::resampling::{ci95, drawn};

/// Bins of the expected calibration error, of equal width over the probability of the likeliest outcome.
pub(crate) const ECE_BINS: usize = 15;
pub(super) const RESAMPLES: usize = 1000;

/// Sums over cases. They are additive, so a bootstrap resamples groups of cases by adding their sums.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sums {
    cases: f64,
    nll_nats: f64,
    top1: f64,
    top5: f64,
    reciprocal_rank: f64,
    brier: f64,
    /// For each bin: cases, sum of the greatest probability, cases with a correct likeliest outcome.
    bins: [[f64; 3]; ECE_BINS],
}

impl Sums {
    /// Adds a case: `probabilities` sum to one, `truth` is the outcome. Equal probabilities share their ranks, so that a forecast without
    /// knowledge gains nothing from the order of outcomes.
    pub fn add(&mut self, probabilities: &[f64], truth: usize) {
        let Some(p) = probabilities.get(truth).copied() else { return };
        let greater = probabilities.iter().filter(|q| **q > p).count();
        let ties = probabilities.iter().filter(|q| **q == p).count();
        let within = |k: usize| (k.saturating_sub(greater) as f64 / ties as f64).min(1.0);
        self.cases += 1.0;
        self.nll_nats -= p.max(f64::MIN_POSITIVE).ln();
        self.top1 += within(1);
        self.top5 += within(5);
        self.reciprocal_rank += (1..=ties).map(|i| 1.0 / (greater + i) as f64).sum::<f64>() / ties as f64;
        self.brier += probabilities.iter().map(|q| q * q).sum::<f64>() + 1.0 - 2.0 * p;
        let confidence = probabilities.iter().copied().fold(0.0, f64::max);
        let bin = ((confidence * ECE_BINS as f64) as usize).min(ECE_BINS - 1);
        self.bins[bin][0] += 1.0;
        self.bins[bin][1] += confidence;
        self.bins[bin][2] += within(1);
    }

    pub(crate) fn merge(&mut self, other: &Self) {
        self.cases += other.cases;
        self.nll_nats += other.nll_nats;
        self.top1 += other.top1;
        self.top5 += other.top5;
        self.reciprocal_rank += other.reciprocal_rank;
        self.brier += other.brier;
        for (own, more) in self.bins.iter_mut().flatten().zip(other.bins.iter().flatten()) {
            *own += more;
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.cases as usize
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.cases == 0.0
    }

    /// The same means with the weight of one case; empty without cases.
    fn as_one_case(&self) -> Self {
        let n = self.cases.max(1.0);
        let mut one = Self::default();
        one.merge(self);
        for sum in
            [&mut one.cases, &mut one.nll_nats, &mut one.top1, &mut one.top5, &mut one.reciprocal_rank, &mut one.brier]
                .into_iter()
                .chain(one.bins.iter_mut().flatten())
        {
            *sum /= n;
        }
        one
    }

    fn means(&self) -> [f64; METRICS.len()] {
        let n = self.cases.max(1.0);
        let gap = |[_, confidence, right]: &[f64; 3]| (confidence - right).abs();
        let ece = self.bins.iter().map(gap).sum::<f64>();
        let confidence = self.bins.iter().map(|[_, confidence, _]| confidence).sum::<f64>();
        [self.nll_nats, self.top1, self.top5, self.reciprocal_rank, self.brier, confidence, ece].map(|sum| sum / n)
    }
}

const METRICS: [&str; 7] = ["nll_nats", "top1", "top5", "mrr", "brier", "confidence", "ece"];

/// 95 % intervals, each `[low, high]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Intervals {
    /// For the mean negative log-likelihood.
    pub nll_nats: [f64; 2],
    /// For the share of cases with the likeliest outcome.
    pub top1: [f64; 2],
    /// For the share of cases with one of the five likeliest outcomes.
    pub top5: [f64; 2],
    /// For the mean reciprocal rank.
    pub mrr: [f64; 2],
    /// For the Brier score.
    pub brier: [f64; 2],
    /// For the mean confidence.
    pub confidence: [f64; 2],
    /// For the expected calibration error.
    pub ece: [f64; 2],
}

/// Means over all cases, with intervals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// The number of cases.
    pub cases: usize,
    /// Mean negative log-likelihood in nats.
    pub nll_nats: f64,
    /// Share of cases with the likeliest outcome.
    pub top1: f64,
    /// Share of cases with one of the five likeliest outcomes.
    pub top5: f64,
    /// Mean reciprocal rank.
    pub mrr: f64,
    /// Mean Brier score over all outcomes, 0 to 2.
    pub brier: f64,
    /// Mean probability of the likeliest outcome: above `top1`, the forecast is overconfident.
    pub confidence: f64,
    /// Expected calibration error of the likeliest outcome's probability, over 15 bins.
    pub ece: f64,
    /// Bootstrap intervals over groups; `None` if fewer than two have cases.
    pub ci95: Option<Intervals>,
}

impl Summary {
    fn with(&self, value: f64, of: impl Fn(&Intervals) -> [f64; 2]) -> (f64, Option<[f64; 2]>) {
        (value, self.ci95.as_ref().map(of))
    }

    /// The likelihood and its interval.
    #[must_use]
    pub fn nll(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.nll_nats, |ci95| ci95.nll_nats)
    }

    /// The share of cases with the likeliest outcome, and its interval.
    #[must_use]
    pub fn top1(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.top1, |ci95| ci95.top1)
    }

    /// The share of cases with one of the five likeliest outcomes, and its interval.
    #[must_use]
    pub fn top5(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.top5, |ci95| ci95.top5)
    }

    /// The mean reciprocal rank and its interval.
    #[must_use]
    pub fn mrr(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.mrr, |ci95| ci95.mrr)
    }

    /// The Brier score and its interval.
    #[must_use]
    pub fn brier(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.brier, |ci95| ci95.brier)
    }

    /// The mean confidence and its interval.
    #[must_use]
    pub fn confidence(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.confidence, |ci95| ci95.confidence)
    }

    /// The calibration error and its interval.
    #[must_use]
    pub fn ece(&self) -> (f64, Option<[f64; 2]>) {
        self.with(self.ece, |ci95| ci95.ece)
    }
}

/// Summarises groups of cases. It resamples whole groups, because the cases of one program depend on one another.
#[must_use]
pub(crate) fn summarise(groups: &[Sums], seed: u64) -> Summary {
    bootstrap([groups], seed, |[all]| all.means())
}

/// Merges groups, in the order of their first member; `of` gives the merged group of each.
#[must_use]
pub(crate) fn merged(groups: &[Sums], of: &[usize]) -> Vec<Sums> {
    let mut merged = vec![Sums::default(); of.iter().max().map_or(0, |most| most + 1)];
    for (group, of) in groups.iter().zip(of) {
        merged[*of].merge(group);
    }
    merged
}

/// As [`summarise`], with equal weights of the groups, however many cases they have.
#[must_use]
pub(crate) fn macro_average(groups: &[Sums], seed: u64) -> Summary {
    summarise(&alike(groups), seed)
}

/// As [`difference`], with equal weights of the groups.
#[must_use]
pub(crate) fn macro_difference(groups: &[Sums], others: &[Sums], seed: u64) -> Summary {
    difference(&alike(groups), &alike(others), seed)
}

fn alike(groups: &[Sums]) -> Vec<Sums> {
    groups.iter().filter(|group| !group.is_empty()).map(Sums::as_one_case).collect()
}

/// The means of one forecast minus those of another on the same cases in the same groups. Both are resampled together, so the difficulty of
/// the cases cancels, which is most of the width of each interval. So an interval on one side of zero separates them even if their own
/// intervals overlap.
#[must_use]
pub fn difference(groups: &[Sums], others: &[Sums], seed: u64) -> Summary {
    bootstrap([groups, others], seed, |[own, other]| {
        let (own, other) = (own.means(), other.means());
        std::array::from_fn(|metric| own[metric] - other[metric])
    })
}

/// Draws groups with cases. The draws depend only on `seed` and the number of these groups. A single group always gives the same draw, so
/// it has no interval.
///
/// The calibration error is a mean of absolute values, which grows when cases are drawn again. So the mean of that growth is subtracted
/// from its samples.
fn bootstrap<const ROWS: usize>(
    rows: [&[Sums]; ROWS],
    seed: u64,
    value: impl Fn([Sums; ROWS]) -> [f64; METRICS.len()],
) -> Summary {
    let groups = rows.iter().map(|row| row.len()).min().unwrap_or(0);
    let groups: Vec<usize> = (0..groups).filter(|group| rows.iter().any(|row| !row[*group].is_empty())).collect();
    let total = |groups: &[usize]| {
        rows.map(|row| {
            let mut sum = Sums::default();
            groups.iter().for_each(|group| sum.merge(&row[*group]));
            sum
        })
    };
    let all = total(&groups);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut samples: [Vec<f64>; METRICS.len()] = Default::default();
    for _ in 0..if groups.len() > 1 { RESAMPLES } else { 0 } {
        let sample = total(&drawn(&groups, &mut rng));
        if sample.iter().all(|sums| sums.cases > 0.0) {
            samples.iter_mut().zip(value(sample)).for_each(|(samples, mean)| samples.push(mean));
        }
    }
    let [nll_nats, top1, top5, mrr, brier, confidence, ece] = value(all);
    let [.., drawn] = &mut samples;
    let added = drawn.iter().sum::<f64>() / drawn.len() as f64 - ece;
    // For one forecast it is never negative; for a difference it may be.
    let least = if ROWS == 1 { 0.0 } else { f64::NEG_INFINITY };
    drawn.iter_mut().for_each(|sample| *sample = (*sample - added).max(least));
    let ci95 = match samples.map(ci95) {
        [Some(nll_nats), Some(top1), Some(top5), Some(mrr), Some(brier), Some(confidence), Some(ece)] => {
            Some(Intervals { nll_nats, top1, top5, mrr, brier, confidence, ece })
        }
        _ => None,
    };
    let cases = all.first().map_or(0.0, |sums| sums.cases) as usize;
    Summary { cases, nll_nats, top1, top5, mrr, brier, confidence, ece, ci95 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forecast_that_knows_nothing_has_the_scores_of_chance() {
        let mut sums = Sums::default();
        (0..10).for_each(|truth| sums.add(&[0.1; 10], truth));
        let summary = summarise(&[sums], 1);
        assert_eq!(summary.cases, 10);
        assert!((summary.nll_nats - 10f64.ln()).abs() < 1e-12);
        assert!((summary.top1 - 0.1).abs() < 1e-12 && (summary.top5 - 0.5).abs() < 1e-12);
        let harmonic: f64 = (1..=10).map(|i| 1.0 / f64::from(i)).sum();
        assert!((summary.mrr - harmonic / 10.0).abs() < 1e-12);
        assert!((summary.brier - 0.9).abs() < 1e-12);
        assert!(summary.ece < 1e-12);
    }

    #[test]
    fn a_certain_and_right_forecast_is_perfect_and_a_wrong_one_is_not() {
        let mut sums = Sums::default();
        sums.add(&[0.0, 1.0], 1);
        let right = summarise(&[sums], 1);
        assert_eq!((right.nll_nats, right.top1, right.mrr, right.brier, right.ece), (0.0, 1.0, 1.0, 0.0, 0.0));
        sums.add(&[0.0, 1.0], 0);
        let wrong = summarise(&[sums], 1);
        assert!(wrong.nll_nats > 300.0 && wrong.brier == 1.0 && wrong.ece == 0.5 && wrong.top1 == 0.5);
    }

    #[test]
    fn intervals_hold_the_mean_and_shrink_with_more_groups() {
        let groups = |n: usize| -> Vec<Sums> {
            (0..n)
                .map(|i| {
                    let mut sums = Sums::default();
                    sums.add(&[0.7, 0.3], i % 2);
                    sums
                })
                .collect()
        };
        let (few, many) = (summarise(&groups(20), 1), summarise(&groups(2000), 1));
        let [low, high] = few.ci95.unwrap().top1;
        let width = |s: &Summary| s.ci95.map(|ci95| ci95.top1[1] - ci95.top1[0]).unwrap();
        assert!(low <= few.top1 && few.top1 <= high);
        assert!(width(&many) < 0.2 * width(&few));
        assert_eq!(summarise(&groups(20), 1), few);
    }

    /// A forecast that is right as often as it says has an error by chance alone, and drawing cases again adds to it.
    #[test]
    fn the_interval_of_a_calibration_error_holds_it() {
        let group = |i: usize| {
            let mut sums = Sums::default();
            (0..3).for_each(|_| sums.add(&[0.7, 0.3], usize::from(i * 7 % 10 >= 7)));
            sums
        };
        let groups: Vec<Sums> = (0..40).map(group).collect();
        let forecast = summarise(&groups, 1);
        assert!(forecast.ece < 0.01 && (forecast.confidence - 0.7).abs() < 1e-12, "{forecast:?}");
        let [low, high] = forecast.ci95.unwrap().ece;
        assert!(low <= forecast.ece && forecast.ece <= high, "{forecast:?}");
    }

    /// A program without a case is never drawn, and one program has no interval.
    #[test]
    fn groups_without_cases_change_nothing_and_one_group_has_no_interval() {
        let mut sums = [Sums::default(); 2];
        sums[0].add(&[0.7, 0.3], 0);
        sums[1].add(&[0.7, 0.3], 1);
        let [one, other] = sums;
        let none = Sums::default();
        assert_eq!(summarise(&[none, one, none, other, none, none], 1), summarise(&[one, other], 1));
        assert!(summarise(&[one, other], 1).ci95.is_some());
        assert_eq!([summarise(&[one], 1), summarise(&[none, one], 1), summarise(&[], 1)].map(|s| s.ci95), [None; 3]);
        assert_eq!(difference(&[one, none], &[one, none], 1).ci95, None);
    }

    /// An activity with many programs does not dominate the others.
    #[test]
    fn a_macro_average_counts_groups_alike() {
        let group = |right: usize, wrong: usize| {
            let mut sums = Sums::default();
            (0..right).for_each(|_| sums.add(&[0.8, 0.2], 0));
            (0..wrong).for_each(|_| sums.add(&[0.8, 0.2], 1));
            sums
        };
        let programs = [group(8, 0), group(0, 1), group(8, 0), group(0, 1), Sums::default()];
        let activities = merged(&programs, &[0, 1, 0, 1, 2]);
        assert_eq!(activities.len(), 3);
        let (pooled, alike) = (summarise(&activities, 1), macro_average(&activities, 1));
        assert!((pooled.top1 - 16.0 / 18.0).abs() < 1e-12 && (alike.top1 - 0.5).abs() < 1e-12);
        assert_eq!((pooled.cases, alike.cases), (18, 2));
        assert!((alike.ece - 0.3).abs() < 1e-12, "{}", alike.ece);
    }

    #[test]
    fn a_difference_on_the_same_cases_is_surer_than_either_forecast() {
        // Hard and easy groups widen both intervals; one forecast is better in every group by nearly the same amount.
        let groups = |bonus: f64| -> Vec<Sums> {
            (0..40)
                .map(|i| {
                    let mut sums = Sums::default();
                    let p = [0.15, 0.75][i % 2] + bonus + 0.001 * (i % 5) as f64 * bonus;
                    sums.add(&[p, 1.0 - p], 0);
                    sums
                })
                .collect()
        };
        let (better, worse) = (groups(0.1), groups(0.0));
        let (own, other) = (summarise(&better, 1), summarise(&worse, 1));
        assert!(own.ci95.unwrap().brier[1] > other.ci95.unwrap().brier[0], "each by itself overlaps");
        let gain = difference(&better, &worse, 1);
        assert!(gain.ci95.is_some_and(|gain| gain.brier[1] < 0.0 && gain.nll_nats[1] < 0.0));
        assert!((gain.nll_nats - (own.nll_nats - other.nll_nats)).abs() < 1e-12);
        let none = difference(&better, &better, 1);
        assert_eq!((none.nll_nats, none.ci95.unwrap().mrr), (0.0, [0.0, 0.0]));
    }
}
