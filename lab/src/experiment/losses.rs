//! Scores of probabilistic forecasts, summed per group, with bootstrap intervals over groups.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::resampling::{ci95, drawn};

/// Bins of the expected calibration error, of equal width over the probability of the likeliest outcome.
const ECE_BINS: usize = 15;
pub(super) const RESAMPLES: usize = 1000;

/// Sums over cases. They are additive, so a bootstrap resamples groups of cases by adding their sums.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sums {
    cases: f64,
    /// Negative log-likelihood, right, among the first five, reciprocal rank, Brier score.
    scores: [f64; 5],
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
        let reciprocal_rank = (1..=ties).map(|i| 1.0 / (greater + i) as f64).sum::<f64>() / ties as f64;
        let brier = probabilities.iter().map(|q| q * q).sum::<f64>() + 1.0 - 2.0 * p;
        let scores = [-p.max(f64::MIN_POSITIVE).ln(), within(1), within(5), reciprocal_rank, brier];
        let confidence = probabilities.iter().copied().fold(0.0, f64::max);
        let bin = &mut self.bins[((confidence * ECE_BINS as f64) as usize).min(ECE_BINS - 1)];
        self.cases += 1.0;
        let sums = self.scores.iter_mut().chain(bin);
        sums.zip(scores.into_iter().chain([1.0, confidence, within(1)])).for_each(|(sum, more)| *sum += more);
    }

    fn parts(&mut self) -> impl Iterator<Item = &mut f64> {
        std::iter::once(&mut self.cases).chain(&mut self.scores).chain(self.bins.as_flattened_mut())
    }

    pub fn merge(&mut self, other: &Self) {
        let mut other = *other;
        self.parts().zip(other.parts()).for_each(|(own, more)| *own += *more);
    }

    pub fn len(&self) -> usize {
        self.cases as usize
    }

    pub fn is_empty(&self) -> bool {
        self.cases == 0.0
    }

    /// The same means with the weight of one case; empty without cases.
    fn as_one_case(&self) -> Self {
        let (n, mut one) = (self.cases.max(1.0), *self);
        one.parts().for_each(|sum| *sum /= n);
        one
    }

    fn means(&self) -> Means {
        let n = self.cases.max(1.0);
        let gap = |[_, confidence, right]: &[f64; 3]| (confidence - right).abs();
        let ece = self.bins.iter().map(gap).sum::<f64>();
        let confidence = self.bins.iter().map(|[_, confidence, _]| confidence).sum::<f64>();
        let [nll_nats, top1, top5, mrr, brier] = self.scores;
        [nll_nats, top1, top5, mrr, brier, confidence, ece].map(|sum| sum / n)
    }
}

/// The parts of [`Figures`], in their order.
type Means = [f64; 7];

/// One value for each score of a forecast: a mean, or the interval of one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Figures<T> {
    pub nll_nats: T,
    /// Share of cases with the likeliest outcome, and with one of the five likeliest.
    pub top1: T,
    pub top5: T,
    pub mrr: T,
    /// Over all outcomes, 0 to 2.
    pub brier: T,
    /// Mean probability of the likeliest outcome: above `top1`, the forecast is overconfident.
    pub confidence: T,
    /// Expected calibration error of the likeliest outcome's probability, over 15 bins.
    pub ece: T,
}

impl<T> From<[T; 7]> for Figures<T> {
    fn from([nll_nats, top1, top5, mrr, brier, confidence, ece]: [T; 7]) -> Self {
        Self { nll_nats, top1, top5, mrr, brier, confidence, ece }
    }
}

/// Means over all cases, with intervals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    pub cases: usize,
    #[serde(flatten)]
    pub mean: Figures<f64>,
    /// Bootstrap intervals over groups; `None` if fewer than two have cases.
    pub ci95: Option<Figures<[f64; 2]>>,
}

/// A mean and its interval.
pub type Figure = (f64, Option<[f64; 2]>);

/// A mean with its interval in text.
pub fn shown((value, interval): Figure, decimals: usize) -> String {
    match interval {
        None => format!("{value:.decimals$}"),
        Some([low, high]) => format!("{value:.decimals$} [{low:.decimals$}, {high:.decimals$}]"),
    }
}

macro_rules! figures {
    ($($name:ident $field:ident),*) => {
        impl Summary {
            $(pub fn $name(&self) -> Figure {
                (self.mean.$field, self.ci95.map(|ci95| ci95.$field))
            })*
        }
    };
}

figures!(nll nll_nats, top1 top1, top5 top5, mrr mrr, brier brier, confidence confidence, ece ece);

/// Summarises groups of cases. It resamples whole groups, because the cases of one program depend on one another.
pub fn summarise(groups: &[Sums], seed: u64) -> Summary {
    bootstrap([groups], seed, |[all]| all.means())
}

/// Merges groups, in the order of their first member; `of` gives the merged group of each.
pub fn merged(groups: &[Sums], of: &[usize]) -> Vec<Sums> {
    let mut merged = vec![Sums::default(); of.iter().max().map_or(0, |most| most + 1)];
    for (group, of) in groups.iter().zip(of) {
        merged[*of].merge(group);
    }
    merged
}

/// As [`summarise`], with equal weights of the groups, however many cases they have.
pub fn macro_average(groups: &[Sums], seed: u64) -> Summary {
    summarise(&alike(groups), seed)
}

/// As [`difference`], with equal weights of the groups.
pub fn macro_difference(groups: &[Sums], others: &[Sums], seed: u64) -> Summary {
    difference(&alike(groups), &alike(others), seed)
}

fn alike(groups: &[Sums]) -> Vec<Sums> {
    groups.iter().filter(|group| !group.is_empty()).map(Sums::as_one_case).collect()
}

/// The means of one forecast minus those of another on the same cases in the same groups. Both are resampled together, so the difficulty of
/// the cases cancels, which is most of the width of each interval. So an interval on one side of zero separates them even if their own
/// intervals overlap.
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
fn bootstrap<const ROWS: usize>(rows: [&[Sums]; ROWS], seed: u64, value: impl Fn([Sums; ROWS]) -> Means) -> Summary {
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
    let mut samples: [Vec<f64>; 7] = Default::default();
    for _ in 0..if groups.len() > 1 { RESAMPLES } else { 0 } {
        let sample = total(&drawn(&groups, &mut rng));
        if sample.iter().all(|sums| sums.cases > 0.0) {
            samples.iter_mut().zip(value(sample)).for_each(|(samples, mean)| samples.push(mean));
        }
    }
    let cases = all.first().map_or(0, Sums::len);
    let mean = Figures::from(value(all));
    let [.., drawn] = &mut samples;
    let added = drawn.iter().sum::<f64>() / drawn.len() as f64 - mean.ece;
    // For one forecast it is never negative; for a difference it may be.
    let least = if ROWS == 1 { 0.0 } else { f64::NEG_INFINITY };
    drawn.iter_mut().for_each(|sample| *sample = (*sample - added).max(least));
    let is_drawn = !drawn.is_empty();
    let ci95 = is_drawn.then(|| samples.map(|samples| ci95(samples).unwrap_or_default()).into());
    Summary { cases, mean, ci95 }
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
        assert!((summary.mean.nll_nats - 10f64.ln()).abs() < 1e-12);
        assert!((summary.mean.top1 - 0.1).abs() < 1e-12 && (summary.mean.top5 - 0.5).abs() < 1e-12);
        let harmonic: f64 = (1..=10).map(|i| 1.0 / f64::from(i)).sum();
        assert!((summary.mean.mrr - harmonic / 10.0).abs() < 1e-12);
        assert!((summary.mean.brier - 0.9).abs() < 1e-12);
        assert!(summary.mean.ece < 1e-12);
    }

    #[test]
    fn a_certain_and_right_forecast_is_perfect_and_a_wrong_one_is_not() {
        let mut sums = Sums::default();
        sums.add(&[0.0, 1.0], 1);
        let right = summarise(&[sums], 1);
        assert_eq!(
            (right.mean.nll_nats, right.mean.top1, right.mean.mrr, right.mean.brier, right.mean.ece),
            (0.0, 1.0, 1.0, 0.0, 0.0)
        );
        sums.add(&[0.0, 1.0], 0);
        let wrong = summarise(&[sums], 1);
        assert!(
            wrong.mean.nll_nats > 300.0 && wrong.mean.brier == 1.0 && wrong.mean.ece == 0.5 && wrong.mean.top1 == 0.5
        );
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
        assert!(low <= few.mean.top1 && few.mean.top1 <= high);
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
        assert!(forecast.mean.ece < 0.01 && (forecast.mean.confidence - 0.7).abs() < 1e-12, "{forecast:?}");
        let [low, high] = forecast.ci95.unwrap().ece;
        assert!(low <= forecast.mean.ece && forecast.mean.ece <= high, "{forecast:?}");
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
        assert!((pooled.mean.top1 - 16.0 / 18.0).abs() < 1e-12 && (alike.mean.top1 - 0.5).abs() < 1e-12);
        assert_eq!((pooled.cases, alike.cases), (18, 2));
        assert!((alike.mean.ece - 0.3).abs() < 1e-12, "{}", alike.mean.ece);
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
        assert!((gain.mean.nll_nats - (own.mean.nll_nats - other.mean.nll_nats)).abs() < 1e-12);
        let none = difference(&better, &better, 1);
        assert_eq!((none.mean.nll_nats, none.ci95.unwrap().mrr), (0.0, [0.0, 0.0]));
    }
}
