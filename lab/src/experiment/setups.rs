//! Table II under several set-ups side by side. The paper leaves open which of several things of a kind a person takes, how long an act
//! lasts, and how much narration is the window. These decide more than the policy does, so every combination is shown and none is chosen.
//!
//! Policies differ in how often they leave a room undone, and a policy that covers less also disturbs less. So each is also compared *at
//! the naive policy's share of failures*: a policy that fails more often is mixed, run by run, with `uncovered-first`, which always covers.
//! One that fails less often counts as it is. Coverage-aware avoidance takes the best mixture of its weights.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::chart::{Mark, Series};
use super::losses::RESAMPLES;
use super::report::Table;
use super::resampling::{ci95, drawn};
use super::tables::{PaperRow, coverage_chart, front_series, mixed};
use roomcast_cli::Column;
use roomcast_core::policy::PolicyName;
use roomcast_simulation::binding::ItemChoice;
use roomcast_simulation::study::{Cell, Decider};

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Setup {
    pub items: &'static str,
    /// Longest time of one act before stretching, in seconds.
    pub longest_act_s: f64,
    /// Observations in the window; `None` for the whole narration.
    pub window: Option<usize>,
}

impl Setup {
    fn window(self) -> String {
        self.window.map_or_else(|| "all".to_owned(), |window| window.to_string())
    }
}

/// A share with its 95 % interval by bootstrap over homes, over activities, and over models if there are several, each drawn separately: an
/// activity behaves alike in all homes (Owen, 2007, the pigeonhole bootstrap).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Share {
    pub value: f64,
    /// Low and high.
    pub ci95: [f64; 2],
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetupRow {
    /// The set-up.
    #[serde(flatten)]
    pub setup: Setup,
    pub models: usize,
    pub policy: String,
    pub disturbance_mean: f64,
    pub failure_rate: Share,
    /// The reduction of disturbance relative to the naive policy.
    pub less: Share,
    /// The same reduction at the naive policy's share of failures.
    pub less_at_naive_failures: Share,
}

/// The sums of one decider's runs in one home, over T_r.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Total {
    runs: f64,
    disturbance_s: f64,
    failures: f64,
}

impl Total {
    fn add(&mut self, other: &Self, times: f64) {
        self.runs += times * other.runs;
        self.disturbance_s += times * other.disturbance_s;
        self.failures += times * other.failures;
    }

    /// F and mean D_T.
    fn point(&self) -> (f64, f64) {
        let n = self.runs.max(1.0);
        (self.failures / n, self.disturbance_s / n)
    }
}

/// Totals by decider and pair of home and activity, for one model.
struct Totals {
    deciders: Vec<Decider>,
    /// The numbers of home and activity.
    pairs: Vec<[usize; 2]>,
    of: Vec<Vec<Total>>,
}

/// The number of a value among the known ones; a new one gets the next number.
fn number_of<T: PartialEq>(known: &mut Vec<T>, one: T) -> usize {
    known.iter().position(|other| *other == one).unwrap_or_else(|| {
        known.push(one);
        known.len() - 1
    })
}

impl Totals {
    fn new(cells: &[Cell]) -> Self {
        let (mut deciders, mut pairs, mut of) = (Vec::new(), Vec::new(), Vec::new());
        let (mut homes, mut activities) = (Vec::new(), Vec::new());
        for cell in cells {
            let pair = [number_of(&mut homes, &cell.scene), number_of(&mut activities, &cell.program)];
            let (decider, at) = (number_of(&mut deciders, cell.decider), number_of(&mut pairs, pair));
            of.resize(deciders.len(), Vec::new());
            of[decider].resize(pairs.len(), Total::default());
            let one = Total {
                runs: cell.runs.len() as f64,
                disturbance_s: cell.runs.iter().map(|run| run.disturbance_s).sum(),
                failures: cell.runs.iter().filter(|run| run.coverage_s.is_none()).count() as f64,
            };
            of[decider][at].add(&one, 1.0);
        }
        Self { deciders, pairs, of }
    }

    fn count(&self, which: usize) -> usize {
        self.pairs.iter().map(|pair| pair[which] + 1).max().unwrap_or(0)
    }
}

/// F and mean D_T of each decider.
type Points = Vec<(Decider, (f64, f64))>;

/// Pools models, with each pair of home and activity so many times.
fn points<'t>(models: impl Iterator<Item = &'t Totals> + Clone, times: &[f64]) -> Points {
    let deciders = models.clone().next().map_or(&[][..], |first| &first.deciders);
    let of_decider = |(index, decider): (usize, &Decider)| {
        let mut sum = Total::default();
        for model in models.clone() {
            model.of[index].iter().zip(times).for_each(|(one, times)| sum.add(one, *times));
        }
        (*decider, sum.point())
    };
    deciders.iter().enumerate().map(of_decider).collect()
}

/// The figures of a decider: F, D_T relative to the naive policy's, and the same at the naive policy's F.
fn shown(points: &Points, decider: Decider) -> [f64; 3] {
    let find = |wanted: Decider| points.iter().find(|(other, _)| *other == wanted).map(|(_, point)| *point);
    let (naive_f, naive_s) = find(Decider::Policy(PolicyName::Naive)).unwrap_or_default();
    let own = find(decider).unwrap_or_default();
    let is_planned = decider == Decider::Policy(PolicyName::CoverageAware);
    let candidates: Vec<(f64, f64)> = if is_planned {
        let front = points.iter().filter(|(other, _)| matches!(other, Decider::CoverageAware(_)) || *other == decider);
        front.map(|(_, point)| *point).collect()
    } else {
        std::iter::once(own).chain(find(Decider::Policy(PolicyName::UncoveredFirst))).collect()
    };
    // A decider that fails less often than the naive policy gains nothing from more failures.
    let gains = own.0 > naive_f || is_planned;
    let at_naive_s = if gains { mixed(&candidates, naive_f).unwrap_or(own.1) } else { own.1 };
    let less = |s: f64| if naive_s > 0.0 { 1.0 - s / naive_s } else { 0.0 };
    [own.0, less(own.1), less(at_naive_s)]
}

/// The rows of one set-up; `models` are the cells of each model, for the same homes in the same order. Coverage-aware avoidance has a row
/// only for its default weight.
pub fn rows(setup: Setup, models: &[Vec<Cell>], seed: u64) -> Vec<SetupRow> {
    let totals: Vec<Totals> = models.iter().map(|cells| Totals::new(cells)).collect();
    let Some(first) = totals.first() else { return Vec::new() };
    let drawn_points = |[models, homes, activities]: &[Vec<usize>; 3]| {
        let drawn = |of: &[usize], one: usize| of.iter().filter(|other| **other == one).count() as f64;
        let times: Vec<f64> =
            first.pairs.iter().map(|[home, activity]| drawn(homes, *home) * drawn(activities, *activity)).collect();
        // The draw may contain only homes and activities without a common cell.
        let any = times.iter().any(|times| *times > 0.0);
        any.then(|| points(models.iter().map(|model| &totals[*model]), &times))
    };
    let every: [Vec<usize>; 3] = [totals.len(), first.count(0), first.count(1)].map(|count| (0..count).collect());
    let Some(all) = drawn_points(&every) else { return Vec::new() };
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let samples: Vec<_> =
        (0..RESAMPLES).filter_map(|_| drawn_points(&every.each_ref().map(|of| drawn(of, &mut rng)))).collect();
    let named = first.deciders.iter().filter(|decider| !matches!(decider, Decider::CoverageAware(_)));
    let row = |decider: &Decider| {
        let values = shown(&all, *decider);
        let resampled: Vec<[f64; 3]> = samples.iter().map(|points| shown(points, *decider)).collect();
        let share = |index: usize| {
            let value = values[index];
            Share { value, ci95: ci95(resampled.iter().map(|values| values[index]).collect()).unwrap_or([value; 2]) }
        };
        let disturbance_mean = all.iter().find(|(other, _)| other == decider).map_or(0.0, |(_, (_, d))| *d);
        SetupRow {
            setup,
            models: totals.len(),
            policy: decider.name(),
            disturbance_mean,
            failure_rate: share(0),
            less: share(1),
            less_at_naive_failures: share(2),
        }
    };
    named.map(row).collect()
}

/// The paper's row, if the set-up is the paper's; its duration of an act is not published.
fn paper<'p>(row: &SetupRow, papers: &'p [PaperRow]) -> Option<&'p PaperRow> {
    let same = row.setup.items == <&str>::from(ItemChoice::Uniform) && row.setup.window.is_none();
    papers.iter().find(|paper| same && paper.name == row.policy)
}

/// The rows as a table; `papers` are the paper's, empty if homes and robot differ.
pub fn table(rows: &[SetupRow], papers: &[PaperRow]) -> Table {
    let share = |share: &Share| {
        let [low, high] = share.ci95;
        format!("{:.1} % [{:.1}, {:.1}]", 100.0 * share.value, 100.0 * low, 100.0 * high)
    };
    let of_paper = |p: &PaperRow| format!("{}, {:.1} %", p.disturbance_mean, 100.0 * p.failure_rate);
    let columns: [Column<'_, SetupRow>; 10] = [
        ("things", &|row| row.setup.items.to_owned()),
        ("longest act (s)", &|row| row.setup.longest_act_s.to_string()),
        ("window", &|row| row.setup.window()),
        ("models", &|row| row.models.to_string()),
        ("policy", &|row| row.policy.clone()),
        ("D_T (s)", &|row| format!("{:.1}", row.disturbance_mean)),
        ("F", &|row| share(&row.failure_rate)),
        ("less than naive", &|row| share(&row.less)),
        ("less at naive's F", &|row| share(&row.less_at_naive_failures)),
        ("paper: D_T (s), F", &|row| paper(row, papers).map_or_else(String::new, of_paper)),
    ];
    Table::of("setups", "Under every set-up", rows, &columns)
}

/// Disturbance against failed coverage over all cells of a set-up: coverage-aware avoidance by its weight, and each other policy mixed with
/// `uncovered-first`.
pub fn curves(setup: Setup, cells: &[Cell]) -> (String, String) {
    let totals = Totals::new(cells);
    let points = points(std::iter::once(&totals), &vec![1.0; totals.pairs.len()]);
    let shown = |(f, d): (f64, f64)| (100.0 * f, d);
    let covers = points.iter().find(|(decider, _)| *decider == Decider::Policy(PolicyName::UncoveredFirst));
    let is_front = |decider: &Decider| matches!(decider, Decider::CoverageAware(_));
    let front = points.iter().filter(|(decider, _)| is_front(decider)).map(|(_, point)| shown(*point));
    let mut series = vec![front_series(front.collect())];
    for (decider, point) in &points {
        if matches!(decider, Decider::CoverageAware(_) | Decider::Clairvoyant) {
            continue;
        }
        let with =
            covers.filter(|(other, _)| other != decider && *decider != Decider::Policy(PolicyName::CoverageAware));
        let points: Vec<_> = with.map(|(_, covers)| shown(*covers)).into_iter().chain([shown(*point)]).collect();
        let mark = if points.len() > 1 { Mark::Line } else { Mark::Points };
        series.push(Series { name: decider.name(), points, mark });
    }
    let window = setup.window();
    let name = format!("curves-{}-{}-{window}", setup.items, setup.longest_act_s);
    let title = format!(
        "Disturbance at a share of failures: {} things, acts up to {} s, window {window}",
        setup.items, setup.longest_act_s
    );
    (name, coverage_chart(title, series).svg())
}

#[cfg(test)]
mod tests {
    use super::super::tables::PAPER_TABLE2;
    use super::*;
    use roomcast_simulation::world::Run;

    const SETUP: Setup = Setup { items: "nearest", longest_act_s: 10.0, window: Some(16) };

    fn cell(program: &str, decider: Decider, runs: &[(f64, bool)]) -> Cell {
        let run = |(disturbance_s, covers): &(f64, bool)| Run {
            disturbance_s: *disturbance_s,
            coverage_s: covers.then_some(75),
            start: 0,
        };
        let runs = runs.iter().map(run).collect();
        Cell {
            scene: "s".into(),
            program: program.into(),
            room_time_s: 25,
            decider,
            runs,
            optima: Vec::new(),
            horizon_s: 100,
        }
    }

    /// An effect of the activity alone is not surer after three homes.
    #[test]
    fn homes_and_activities_are_drawn_apart() {
        let failures = [("p", 0), ("q", 1), ("r", 3)];
        let cells = |scenes: &[&str]| -> Vec<Cell> {
            let of = |scene: &str, (program, failures): (&str, usize)| {
                let runs: Vec<(f64, bool)> = (0..4).map(|run| (20.0, run >= failures)).collect();
                Cell { scene: scene.into(), ..cell(program, Decider::Policy(PolicyName::Naive), &runs) }
            };
            scenes.iter().flat_map(|scene| failures.map(|activity| of(scene, activity))).collect()
        };
        let rate = |scenes: &[&str]| rows(SETUP, &[cells(scenes)], 1)[0].failure_rate;
        let (one, three) = (rate(&["s"]), rate(&["s", "t", "u"]));
        assert_eq!(one.value, three.value);
        assert_eq!(one.ci95, [0.0, 0.75]);
        assert_eq!(three.ci95, [0.0, 0.75]);
    }

    #[test]
    fn policies_are_compared_at_the_naive_policys_failures() {
        let policy = Decider::Policy;
        let cells: Vec<Cell> = ["p", "q"]
            .iter()
            .flat_map(|program| {
                [
                    cell(
                        program,
                        policy(PolicyName::Naive),
                        &[(20.0, true), (20.0, true), (20.0, true), (20.0, false)],
                    ),
                    cell(program, policy(PolicyName::InformedAvoidance), &[(10.0, true), (10.0, false)]),
                    cell(program, policy(PolicyName::UncoveredFirst), &[(14.0, true), (14.0, true)]),
                    cell(program, policy(PolicyName::CoverageAware), &[(8.0, true), (8.0, true)]),
                    cell(program, Decider::CoverageAware(1.0), &[(4.0, false), (4.0, false)]),
                ]
            })
            .collect();
        let rows = rows(SETUP, std::slice::from_ref(&cells), 1);
        let of = |policy: &str| rows.iter().find(|row| row.policy == policy).unwrap();
        assert_eq!(rows.len(), 4, "other weights are no rows");
        assert_eq!((of("naive").less.value, of("naive").failure_rate.value), (0.0, 0.25));
        // Half of the runs may be informed: 0.5 * 10 + 0.5 * 14 = 12 of 20 s.
        let informed = of("informed-avoidance");
        assert!((informed.less.value - 0.5).abs() < 1e-12);
        assert!((informed.less_at_naive_failures.value - 0.4).abs() < 1e-12, "{informed:?}");
        // A quarter of the runs at weight 1: 0.25 * 4 + 0.75 * 8 = 7 of 20 s.
        assert!((of("coverage-aware").less_at_naive_failures.value - 0.65).abs() < 1e-12);
        assert!((of("uncovered-first").less_at_naive_failures.value - 0.3).abs() < 1e-12);
        // Identical homes leave no uncertainty.
        assert!(rows.iter().all(|row| row.less.ci95 == [row.less.value; 2]));
        let two = super::rows(SETUP, &[cells.clone(), cells.clone()], 1);
        assert_eq!(two[1].models, 2);
        assert_eq!(two[1].less, rows[1].less);
        assert!(curves(SETUP, &cells).1.contains("coverage-aware, by weight"));
        assert!(table(&rows, &PAPER_TABLE2).rows.iter().all(|row| row[9].is_empty()));
        let as_paper = super::rows(Setup { items: "uniform", window: None, ..SETUP }, &[cells], 1);
        assert_eq!(table(&as_paper, &PAPER_TABLE2).rows[1][9], "145.3, 20.5 %");
        assert!(table(&as_paper, &[]).rows[1][9].is_empty(), "of other homes the paper says nothing");
    }
}
