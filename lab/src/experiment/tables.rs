//! Tables I and II of the paper next to ours, the front of disturbance against coverage, and ablations.

use serde::Serialize;

use super::chart::{Chart, Mark, Series, histogram};
use super::distinct;
use super::report::{Report, Table};
use roomcast_cli::Column;
use roomcast_core::policy::PolicyName;
use roomcast_simulation::clairvoyant::{Optimum, bound_s};
use roomcast_simulation::study::{Cell, Decider, Figures, HorizonRow, figures};

#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperRow {
    pub name: &'static str,
    pub disturbance_mean: f64,
    pub disturbance_std: f64,
    /// Mean t_c; Table I has none.
    pub coverage_time_mean: Option<f64>,
    pub coverage_time_std: Option<f64>,
    pub failure_rate: f64,
}

const fn paper(name: &'static str, d: [f64; 2], t: Option<[f64; 2]>, failure_rate: f64) -> PaperRow {
    let (coverage_time_mean, coverage_time_std) = match t {
        Some([mean, std]) => (Some(mean), Some(std)),
        None => (None, None),
    };
    PaperRow {
        name,
        disturbance_mean: d[0],
        disturbance_std: d[1],
        coverage_time_mean,
        coverage_time_std,
        failure_rate,
    }
}

/// The paper's Table I: prompts, informed avoidance, one scene and program, T_r 25 and 50.
pub const PAPER_TABLE1: [PaperRow; 7] = [
    paper("random", [317.1, 86.3], None, 0.002),
    paper("p0", [163.4, 59.0], None, 0.007),
    paper("p1", [163.4, 59.0], None, 0.007),
    paper("p2", [237.2, 72.9], None, 0.020),
    paper("p3", [316.0, 85.7], None, 0.251),
    paper("p4", [285.3, 79.1], None, 0.753),
    paper("p5", [285.3, 79.1], None, 0.753),
];

/// The paper's Table II, over all scenes, programs and T_r.
pub const PAPER_TABLE2: [PaperRow; 3] = [
    paper("naive", [205.1, 114.3], Some([355.3, 225.2]), 0.183),
    paper("informed-avoidance", [145.3, 74.3], Some([428.8, 264.9]), 0.205),
    paper("greedy-avoidance", [100.6, 50.0], Some([251.6, 124.8]), 0.933),
];

/// The differences between our figures and the paper's, for the paper's set-up: the person takes any thing of a kind, and the window is the
/// whole narration.
pub const DIFFERENCES: &str = "What differs from the paper: its apartments, programs and action durations are not published. Ours have \
    its sizes (three rooms; 443, 357 and 324 items of 115, 98 and 100 labels; 18, 16 and 42 actions) and its pace: T is not given there, but \
    its naive policy shares 205.1 s with the person in homes of three rooms, so T is 615 s on average, 24 s per action, to which our \
    timelines are stretched. The paper asks a general language model; these figures are of the model named above. As in the paper, \
    the robot begins in a random room, moves in no time, and may return to rooms that are done; t_c is the mean over runs that covered.";

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table2 {
    /// One for each scene, program, T_r and policy.
    pub rows: Vec<Figures>,
    /// One for each policy, over everything.
    pub overall: Vec<Figures>,
    /// The paper's rows; empty if the set-up differs.
    pub paper: Vec<PaperRow>,
}

fn of(cells: &[Cell], decider: Decider) -> Vec<&Cell> {
    cells.iter().filter(|cell| cell.decider == decider).collect()
}

fn deciders(cells: &[Cell]) -> Vec<Decider> {
    distinct(cells.iter().map(|cell| cell.decider))
}

fn is_same(one: &Cell, other: &Cell) -> bool {
    (&one.scene, &one.program, one.room_time_s) == (&other.scene, &other.program, other.room_time_s)
}

const NAIVE: Decider = Decider::Policy(PolicyName::Naive);

/// Summarises cells as Table II does; `paper` are its rows, if the set-up is the paper's.
pub fn table2(cells: &[Cell], paper: &[PaperRow]) -> Table2 {
    let naive = of(cells, NAIVE);
    let rows = cells.iter().map(|cell| {
        let same = naive.iter().find(|naive| is_same(cell, naive));
        figures(&[cell], same.map(std::slice::from_ref))
    });
    let overall = deciders(cells).into_iter().map(|decider| figures(&of(cells, decider), Some(&naive)));
    Table2 { rows: rows.collect(), overall: overall.collect(), paper: paper.to_vec() }
}

fn shares(shares: Option<[f64; 3]>) -> String {
    shares.map(|s| s.map(|s| format!("{:.0} %", 100.0 * s)).join(", ")).unwrap_or_default()
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.1}"))
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// Rows as a table for people and CSV, next to the paper's if there are any.
pub fn table_of(name: &str, title: &str, rows: &[Figures], papers: &[PaperRow]) -> Table {
    let paper = |row: &Figures| {
        let all = row.scene == "all" || row.room_time_s == 0;
        papers.iter().find(|paper| all && paper.name == row.policy)
    };
    let time = |p: &PaperRow| format!("{} ± {}", number(p.coverage_time_mean), number(p.coverage_time_std));
    let columns: [Column<'_, Figures>; 16] = [
        ("scene", &|row| row.scene.clone()),
        ("program", &|row| row.program.clone()),
        ("T_r (s)", &|row| if row.room_time_s == 0 { "all".to_owned() } else { row.room_time_s.to_string() }),
        ("policy", &|row| row.policy.clone()),
        ("runs", &|row| row.restarts.to_string()),
        ("D_T mean (s)", &|row| format!("{:.1}", row.disturbance_mean)),
        ("D_T std (s)", &|row| format!("{:.1}", row.disturbance_std)),
        ("t_c mean (s)", &|row| number(row.coverage_time_mean)),
        ("t_c std (s)", &|row| number(row.coverage_time_std)),
        ("F", &|row| percent(row.failure_rate)),
        ("D_T <, =, > naive", &|row| shares(row.disturbance_against_naive)),
        ("t_c <, =, > naive", &|row| shares(row.coverage_time_against_naive)),
        ("bound (s)", &|row| number(row.bound_s)),
        ("regret (s)", &|row| number(row.regret_s)),
        ("paper D_T", &|row| {
            paper(row).map(|p| format!("{} ± {}", p.disturbance_mean, p.disturbance_std)).unwrap_or_default()
        }),
        ("paper t_c, F", &|row| {
            paper(row).map(|p| format!("{}, {}", time(p), percent(p.failure_rate))).unwrap_or_default()
        }),
    ];
    let shown = if papers.is_empty() { columns.len() - 2 } else { columns.len() };
    Table::of(name, title, rows, &columns[..shown])
}

/// The reduction of each decider's disturbance relative to the naive policy, in words.
pub fn headline(overall: &[Figures]) -> String {
    let Some(naive) = overall.iter().find(|row| row.policy == PolicyName::Naive.as_str()) else { return String::new() };
    let others = overall.iter().filter(|row| row.policy != naive.policy).map(|row| {
        let less = 100.0 * (1.0 - row.disturbance_mean / naive.disturbance_mean);
        format!("{} {less:.1} % less ({} of runs without coverage)", row.policy, percent(row.failure_rate))
    });
    format!(
        "Disturbance against the naive policy ({} of runs without coverage): {}.",
        percent(naive.failure_rate),
        others.collect::<Vec<_>>().join(", ")
    )
}

/// Histograms of D_T by decider, as in the paper's Figures 4 and 5, over all cells and by T_r.
pub fn histograms(cells: &[Cell]) -> Vec<(String, String)> {
    let mut room_times: Vec<usize> = cells.iter().map(|cell| cell.room_time_s).collect();
    room_times.sort_unstable();
    room_times.dedup();
    let chart = |title: String, keep: &dyn Fn(&Cell) -> bool| {
        let values = |cells: &[&Cell]| -> Vec<f64> {
            let runs = cells.iter().filter(|cell| keep(cell)).flat_map(|cell| &cell.runs);
            runs.map(|run| run.disturbance_s).collect()
        };
        let greatest = values(&cells.iter().collect::<Vec<_>>()).into_iter().fold(1.0, f64::max);
        let bin = (greatest / 30.0).ceil();
        let series = deciders(cells).into_iter().map(|decider| {
            let points = histogram(&values(&of(cells, decider)), bin);
            Series { name: decider.name(), points, mark: Mark::Steps }
        });
        let series = series.collect();
        Chart { title, x: "D_T (s)".into(), y: "share of runs".into(), series }.svg()
    };
    let mut charts = vec![("disturbance".to_owned(), chart("Disturbance over all cells".into(), &|_| true))];
    for room_time_s in room_times {
        let title = format!("Disturbance at T_r = {room_time_s} s");
        charts.push((format!("disturbance-{room_time_s}"), chart(title, &|cell| cell.room_time_s == room_time_s)));
    }
    charts
}

/// Whether the front of coverage-aware avoidance dominates a policy's point in one cell.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Domination {
    pub scene: String,
    pub program: String,
    pub room_time_s: usize,
    pub policy: String,
    pub disturbance_mean: f64,
    pub failure_rate: f64,
    /// The weight with a point that is at least as good in both and better in one, if there is one.
    pub weight_s: Option<f64>,
    /// Otherwise the front's D_T at that F, with weights mixed run by run.
    pub front_s: Option<f64>,
    /// The clairvoyant bound at that F.
    pub bound_s: Option<f64>,
    /// "dominated", "dominated by mixing weights", "nothing could" or "not dominated".
    pub verdict: &'static str,
}

pub fn domination(cells: &[Cell]) -> Vec<Domination> {
    let mut found = Vec::new();
    for name in [PolicyName::Naive, PolicyName::InformedAvoidance] {
        for base in of(cells, Decider::Policy(name)) {
            let point = figures(&[base], None);
            // Weight, F and D_T.
            let front = cells.iter().filter(|cell| is_same(cell, base)).filter_map(|cell| {
                let Decider::CoverageAware(weight_s) = cell.decider else { return None };
                let row = figures(&[cell], None);
                Some((weight_s, (row.failure_rate, row.disturbance_mean)))
            });
            let (weights_s, front): (Vec<f64>, Vec<(f64, f64)>) = front.unzip();
            let better = |(f, d): &(f64, f64)| {
                let (f_gain, d_gain) = (point.failure_rate - f, point.disturbance_mean - d);
                f_gain >= -1e-9 && d_gain >= -1e-9 && f_gain + d_gain > 1e-9
            };
            let single = front.iter().position(better).map(|at| weights_s[at]);
            let front_s = mixed(&front, point.failure_rate);
            let verdict = match (single, front_s, point.regret_s) {
                (Some(_), ..) => "dominated",
                (None, Some(front_s), _) if front_s < point.disturbance_mean - 1e-9 => "dominated by mixing weights",
                (.., Some(regret_s)) if regret_s <= 1e-6 => "nothing could",
                _ => "not dominated",
            };
            found.push(Domination {
                scene: base.scene.clone(),
                program: base.program.clone(),
                room_time_s: base.room_time_s,
                policy: point.policy,
                disturbance_mean: point.disturbance_mean,
                failure_rate: point.failure_rate,
                weight_s: single,
                front_s,
                bound_s: point.bound_s,
                verdict,
            });
        }
    }
    found
}

/// The least D of two points (F, D) of a front, mixed so that F is at most `failure_rate`.
pub fn mixed(front: &[(f64, f64)], failure_rate: f64) -> Option<f64> {
    let within = front.iter().filter(|(f, _)| *f <= failure_rate);
    let pairs = within.flat_map(|own| front.iter().map(move |other| (own, other)));
    let mixed = pairs.map(|((f0, d0), (f1, d1))| match *f1 <= failure_rate {
        true => d0.min(*d1),
        false => d0 + (failure_rate - f0) / (f1 - f0) * (d1 - d0),
    });
    mixed.reduce(f64::min)
}

/// Coverage-aware avoidance: points of failures in percent and disturbance in seconds.
pub fn front_series(mut points: Vec<(f64, f64)>) -> Series {
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    Series { name: "coverage-aware, by weight".into(), points, mark: Mark::Line }
}

pub fn coverage_chart(title: String, series: Vec<Series>) -> Chart {
    Chart { title, x: "runs without full coverage (%)".into(), y: "mean D_T (s)".into(), series }
}

/// Disturbance against failed coverage over all cells, with the bound.
pub fn front_chart(cells: &[Cell]) -> Chart {
    let mut series = Vec::new();
    let mut front = Vec::new();
    for decider in deciders(cells) {
        let row = figures(&of(cells, decider), None);
        let point = (100.0 * row.failure_rate, row.disturbance_mean);
        match decider {
            Decider::CoverageAware(_) => front.push(point),
            Decider::Clairvoyant => {}
            Decider::Policy(_) => series.push(Series { name: decider.name(), points: vec![point], mark: Mark::Points }),
        }
    }
    series.insert(0, front_series(front));
    let optima: Vec<Optimum> =
        of(cells, NAIVE).into_iter().flat_map(|cell| cell.runs.iter().map(|run| cell.optima[run.start])).collect();
    let bound = (0..=20).filter_map(|i| Some((5.0 * f64::from(i), bound_s(&optima, f64::from(i) / 20.0)?))).collect();
    series.push(Series { name: "clairvoyant bound".into(), points: bound, mark: Mark::Line });
    coverage_chart("Disturbance against coverage, over all cells".into(), series)
}

pub fn domination_table(rows: &[Domination]) -> Table {
    let columns: [Column<'_, Domination>; 10] = [
        ("scene", &|row| row.scene.clone()),
        ("program", &|row| row.program.clone()),
        ("T_r (s)", &|row| row.room_time_s.to_string()),
        ("policy", &|row| row.policy.clone()),
        ("D_T (s)", &|row| format!("{:.1}", row.disturbance_mean)),
        ("F", &|row| percent(row.failure_rate)),
        ("weight (s)", &|row| row.weight_s.map_or_else(|| "-".to_owned(), |w| w.to_string())),
        ("front at F (s)", &|row| number(row.front_s)),
        ("bound at F (s)", &|row| number(row.bound_s)),
        ("verdict", &|row| row.verdict.to_owned()),
    ];
    Table::of("domination", "Does the front dominate?", rows, &columns)
}

/// Brier score and likelihood by horizon, as charts and a table.
pub fn horizon_report(rows: &[HorizonRow]) -> (Table, Vec<(String, String)>) {
    let columns: [Column<'_, HorizonRow>; 5] = [
        ("predictor", &|row| row.predictor.to_owned()),
        ("t (s)", &|row| row.horizon_s.to_string()),
        ("cases", &|row| row.cases.to_string()),
        ("Brier", &|row| format!("{:.3}", row.brier)),
        ("nll (nats)", &|row| format!("{:.3}", row.nll_nats)),
    ];
    let table = Table::of("horizon", "The forecast by horizon", rows, &columns);
    let chart = |title: &str, y: &str, value: fn(&HorizonRow) -> f64| {
        let mut series: Vec<Series> = Vec::new();
        for row in rows {
            let point = (row.horizon_s as f64, value(row));
            match series.iter_mut().find(|s| s.name == row.predictor) {
                Some(series) => series.points.push(point),
                None => series.push(Series { name: row.predictor.to_owned(), points: vec![point], mark: Mark::Line }),
            }
        }
        Chart { title: title.into(), x: "ahead (s)".into(), y: y.into(), series }.svg()
    };
    let charts = vec![
        ("horizon-brier".to_owned(), chart("Where the person will be: Brier score", "Brier score", |row| row.brier)),
        ("horizon-nll".to_owned(), chart("Where the person will be: likelihood", "nll (nats)", |row| row.nll_nats)),
    ];
    (table, charts)
}

pub fn table2_report(table: &Table2, cells: &[Cell], notes: Vec<String>, pictures: Vec<(String, String)>) -> Report {
    let mut figures = histograms(cells);
    figures.extend(pictures);
    Report {
        title: "Disturbance and coverage by policy (the paper's Table II)".into(),
        notes,
        tables: vec![
            table_of("overall", "Over all scenes, programs and T_r", &table.overall, &table.paper),
            table_of("table2", "By scene, program and T_r", &table.rows, &table.paper),
        ],
        figures,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_simulation::world::Run;

    fn cell(decider: Decider, runs: &[(f64, bool)]) -> Cell {
        let runs = runs
            .iter()
            .map(|(disturbance_s, covers)| Run {
                disturbance_s: *disturbance_s,
                coverage_s: covers.then_some(75),
                start: 0,
            })
            .collect();
        let optima = vec![Optimum { covering_s: Some(10.0), free_s: 4.0 }];
        Cell { scene: "s".into(), program: "p".into(), room_time_s: 25, decider, runs, optima, horizon_s: 100 }
    }

    #[test]
    fn fronts_are_judged_against_points_and_the_bound() {
        let informed = Decider::Policy(PolicyName::InformedAvoidance);
        let cells = [
            cell(NAIVE, &[(20.0, true), (20.0, false)]),
            cell(informed, &[(4.0, false), (10.0, true)]),
            cell(Decider::CoverageAware(5.0), &[(15.0, true), (15.0, true)]),
            cell(Decider::CoverageAware(0.0), &[(4.0, false), (4.0, false)]),
        ];
        let found = domination(&cells);
        assert_eq!((found[0].verdict, found[0].weight_s), ("dominated", Some(5.0)));
        assert_eq!(found[1].verdict, "nothing could");
        assert_eq!(found[1].bound_s, Some(7.0));
        assert_eq!(found[1].front_s, Some(9.5));
        let svg = front_chart(&cells).svg();
        assert!(svg.contains("clairvoyant bound") && svg.contains("informed-avoidance"));
    }

    #[test]
    fn table2_pairs_runs_with_the_naive_policys() {
        let informed = Decider::Policy(PolicyName::InformedAvoidance);
        let cells = [cell(NAIVE, &[(20.0, true), (20.0, false)]), cell(informed, &[(10.0, true), (20.0, true)])];
        let table = table2(&cells, &PAPER_TABLE2);
        assert_eq!(table.overall[1].disturbance_against_naive, Some([0.5, 0.5, 0.0]));
        assert_eq!(table.overall[1].coverage_time_against_naive, Some([0.5, 0.5, 0.0]));
        assert!(headline(&table.overall).contains("informed-avoidance 25.0 % less"));
        let report = table2_report(&table, &cells, vec![DIFFERENCES.into()], Vec::new());
        assert!(report.html().contains("paper D_T"));
        // Another set-up has no rows of the paper.
        let own = table2_report(&table2(&cells, &[]), &cells, Vec::new(), Vec::new());
        assert!(!own.html().contains("paper D_T"));
    }
}
