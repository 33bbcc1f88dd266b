//! The results of the experiment: losses by predictor, target and day, differences from the mixture, and sets.

use serde::Serialize;

use super::super::losses::{Figures, Summary, difference, summarise};
use super::predictors::MIXTURE;
use super::tally::Tally;
use super::watch::Watch;
use super::{ALL, Days, HALF, Options, TARGETS, UNSEEN, cleaning};

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub day: Days,
    pub predictor: String,
    pub target: &'static str,
    pub n: usize,
    pub nll_nats: f64,
    pub mrr: f64,
    /// Share of cases with a right likeliest outcome.
    pub top1: f64,
    pub brier: f64,
    pub ece: f64,
    /// 95 % intervals by bootstrap over days; `None` for a single day.
    pub ci95: Option<Figures<[f64; 2]>>,
}

/// The mixture's figures minus another predictor's, on the same cases, with intervals by bootstrap over the same days.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    pub day: Days,
    pub target: &'static str,
    pub less: String,
    pub nll_nats: f64,
    pub nll_ci95: [f64; 2],
    /// Difference of the shares of cases with a right likeliest outcome.
    pub top1: f64,
    pub top1_ci95: [f64; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Sets {
    pub horizon_s: f64,
    pub coverage_asked: f64,
    /// Share of moments in which the set held the person.
    pub coverage: f64,
    pub size_mean: f64,
    /// Mean number of places in a set of the forecast without habits, with the same promise.
    pub size_mean_shipped: f64,
    pub coverage_shipped: f64,
    /// Coverage of sets that always have the likeliest place, as the daemon publishes them.
    pub coverage_never_empty: f64,
    pub size_mean_never_empty: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Days with cases.
    pub days: usize,
    /// Cases of the target `room`.
    pub cases: usize,
    pub rows: Vec<Row>,
    /// The mixture against the other predictors, over all days and over the second half.
    pub differences: Vec<Difference>,
    pub sets: Vec<Sets>,
    /// The value of the forecasts to a robot.
    pub cleaning: Vec<cleaning::Row>,
    /// Number of scores that were computed because the cache lacked them.
    pub computed: usize,
    pub learned: roomcast_core::habits::Learned,
}

/// The table, and the differences from the mixture.
fn rows(tally: &Tally, predictors: &[&str], seed: u64) -> (Vec<Row>, Vec<Difference>) {
    let days = tally.days();
    let whole = [ALL, HALF, UNSEEN].into_iter().filter(|stretch| *stretch != HALF || days > 1);
    let (mut rows, mut differences) = (Vec::new(), Vec::new());
    for (target, target_name) in TARGETS.iter().enumerate() {
        for (predictor, predictor_name) in predictors.iter().enumerate() {
            for day in (1..=days).map(Days::One).chain(whole.clone()) {
                let groups = tally.stretch(predictor, target, day);
                let summary: Summary = summarise(&groups, seed);
                if summary.cases == 0 {
                    continue;
                }
                rows.push(Row {
                    day,
                    predictor: (*predictor_name).to_owned(),
                    target: target_name,
                    n: summary.cases,
                    nll_nats: summary.mean.nll_nats,
                    mrr: summary.mean.mrr,
                    top1: summary.mean.top1,
                    brier: summary.mean.brier,
                    ece: summary.mean.ece,
                    ci95: summary.ci95,
                });
                if predictor != MIXTURE
                    && let less = difference(&tally.stretch(MIXTURE, target, day), &groups, seed)
                    && let Some(ci95) = less.ci95
                {
                    differences.push(Difference {
                        day,
                        target: target_name,
                        less: (*predictor_name).to_owned(),
                        nll_nats: less.mean.nll_nats,
                        nll_ci95: ci95.nll_nats,
                        top1: less.mean.top1,
                        top1_ci95: ci95.top1,
                    });
                }
            }
        }
    }
    (rows, differences)
}

pub(super) fn report(watch: &Watch<'_>, predictors: &[&str], options: &Options, computed: usize) -> Report {
    let (rows, differences) = rows(&watch.tally, predictors, options.seed);
    let sets = watch.horizons.iter().filter(|horizon| horizon.moments > 0.0);
    let sets = sets.map(|horizon| Sets {
        horizon_s: horizon.horizon_s,
        coverage_asked: options.habits.coverage,
        coverage: horizon.held[0] / horizon.moments,
        size_mean: horizon.size[0] / horizon.moments,
        size_mean_shipped: horizon.size[1] / horizon.moments,
        coverage_shipped: horizon.held[1] / horizon.moments,
        coverage_never_empty: horizon.held[2] / horizon.moments,
        size_mean_never_empty: horizon.size[2] / horizon.moments,
    });
    let all = |row: &&Row| row.day == ALL && row.target == "room" && row.predictor == "mixture";
    let cases = rows.iter().find(all).map_or(0, |row| row.n);
    let with_cases = rows.iter().filter(|row| matches!(row.day, Days::One(_)) && row.predictor == "mixture");
    let mut numbers: Vec<usize> =
        with_cases.filter_map(|row| if let Days::One(day) = row.day { Some(day) } else { None }).collect();
    numbers.sort_unstable();
    numbers.dedup();
    Report {
        days: numbers.len(),
        cases,
        rows,
        differences,
        sets: sets.collect(),
        cleaning: watch.cleaning.rows(options.seed),
        computed,
        learned: watch.mixture.learned(),
    }
}
