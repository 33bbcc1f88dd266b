//! The runs behind every table of the paper: activities in homes, policies, restarts.

use rayon::prelude::*;
use serde::Serialize;

use crate::binding::{Binder, ItemChoice, stable_hash};
use crate::clairvoyant::{self, Optimum};
use crate::homer::Day;
#[cfg(feature = "solver")]
use crate::mixed_integer;
use crate::timeline::{PersonOptions, Timeline};
use crate::world::{self, Cost, Disturbance, Knowledge, Run, WorldError, check_room_time, restart_rng};
use crate::{ScoreSource, StudyError};
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Program, Sentence};
use roomcast_core::places::{Mention, PlaceMatcher};
use roomcast_core::policy::{CoverageAware, DP_PARTITIONS_MAX, Policy, PolicyName};
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::semantic_map::SemanticMap;

/// An activity to be carried out.
#[derive(Debug, Clone, PartialEq)]
pub enum Activity {
    /// A program, at the pace of [`PersonOptions`].
    Program(Program),
    /// A household's day, at its own pace.
    Day(Day),
}

/// Options of activities and their narration.
#[derive(Debug, Clone)]
pub struct Options {
    /// The window of narration.
    pub history: HistoryLimits,
    /// The choice among a label's items.
    pub items: ItemChoice,
    /// The person's pace.
    pub person: PersonOptions,
    /// The rule for a disturbance.
    pub disturbance: Disturbance,
    /// The assumptions of the forecast.
    pub forecast: ForecastOptions,
    /// Restarts per cell and policy.
    pub restarts: u64,
    /// The seed of every draw.
    pub seed: u64,
}

impl Default for Options {
    /// The person takes the nearest item; the paper's person takes any. The restarts are enough for a mean that can be compared.
    fn default() -> Self {
        Self {
            history: HistoryLimits::default(),
            items: ItemChoice::Nearest,
            person: PersonOptions::default(),
            disturbance: Disturbance::SameRoom,
            forecast: ForecastOptions::default(),
            restarts: 1000,
            seed: 1,
        }
    }
}

/// One person's activity in a map, with the scores at each time.
#[derive(Debug, Clone)]
struct Track {
    timeline: Timeline,
    /// After each number of completed actions: S per partition, not normalised.
    scores: Vec<Vec<f64>>,
    /// After each number of completed actions: ln s_c per label, in nats.
    labels: Vec<Vec<f64>>,
    mentions: Vec<Option<Mention>>,
}

/// One or several persons in a map: everything that a robot can meet or know.
#[derive(Debug, Clone)]
pub struct Home<'a> {
    /// The map's name.
    pub scene: String,
    /// The activities' names.
    pub program: String,
    grounding: &'a Grounding,
    tracks: Vec<Track>,
    cost: Cost,
}

impl<'a> Home<'a> {
    /// Carries out activities at the same time, one person each, and scores the narration of each.
    ///
    /// # Errors
    /// When an activity cannot be carried out in the map, or the model fails.
    pub fn new<M: LanguageModel>(
        map: &'a SemanticMap,
        grounding: &'a Grounding,
        activities: &[(String, &Activity)],
        source: &mut ScoreSource<M>,
        binding: &BindingSequence,
        options: &Options,
    ) -> Result<Self, StudyError> {
        let mut binder = Binder::new(map, grounding, options.items);
        let mut mentions = PlaceMatcher::new(map, grounding);
        let mut grounded = GroundedScores::default();
        let mut tracks = Vec::with_capacity(activities.len());
        for (name, activity) in activities {
            binder.begin(options.seed, name);
            let start = stable_hash(&[&options.seed.to_le_bytes(), map.name().as_bytes(), name.as_bytes()]);
            let person = &options.person;
            let timeline = match activity {
                Activity::Program(program) => {
                    Timeline::of_program(program, map, grounding, &mut binder, person, start)?
                }
                Activity::Day(day) => Timeline::of_day(day, name, map, grounding, &mut binder, person, start)?,
            };
            let sentences: Vec<Sentence> = timeline.done.iter().map(|done| done.sentence.clone()).collect();
            let rows = source.score_steps(&sentences, options.history, binding)?;
            let mut scores = Vec::with_capacity(rows.len());
            for row in &rows {
                grounding.ground(row, &mut grounded)?;
                scores.push(grounded.partition_log_score_nats.iter().map(|log_score| log_score.exp()).collect());
            }
            let mentions = sentences.iter().map(|sentence| mentions.last(sentence.as_str())).collect();
            tracks.push(Track { timeline, scores, labels: rows, mentions });
        }
        source.flush()?;
        let timelines: Vec<&Timeline> = tracks.iter().map(|track| &track.timeline).collect();
        let cost = Cost::new(&timelines, map, grounding, options.disturbance)?;
        let program = activities.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>().join(" + ");
        Ok(Self { scene: map.name().to_owned(), program, grounding, tracks, cost })
    }

    /// The disturbance of a robot in each room at each step.
    #[must_use]
    pub fn cost(&self) -> &Cost {
        &self.cost
    }

    /// The persons' timelines.
    pub fn timelines(&self) -> impl Iterator<Item = &Timeline> {
        self.tracks.iter().map(|track| &track.timeline)
    }

    /// Actions that were skipped because the map lacks their objects.
    pub fn skipped(&self) -> impl Iterator<Item = &str> {
        self.tracks.iter().flat_map(|track| &track.timeline.skipped).map(String::as_str)
    }

    /// For each room the probability that anybody is there, 1 - prod(1 - p) over the persons, as the daemon gives it.
    fn probability(&self, at_s: f64) -> Vec<f64> {
        // In logarithms it is also exact for small p.
        let mut ln_nobody = vec![0.0_f64; self.cost.rooms()];
        for track in &self.tracks {
            let own = normalised(track.scores[track.timeline.done_by(at_s)].clone());
            ln_nobody.iter_mut().zip(own).for_each(|(sum, p)| *sum += (-p).ln_1p());
        }
        normalised(ln_nobody.into_iter().map(|sum| -sum.exp_m1()).collect())
    }

    /// The forecaster of a person with all events until this time.
    fn forecaster(&self, track: &Track, options: ForecastOptions, at_s: f64) -> Forecaster {
        let mut forecaster = Forecaster::new(self.cost.rooms(), options, 0.0);
        for (index, done) in track.timeline.done.iter().take(track.timeline.done_by(at_s)).enumerate() {
            forecaster.observe(done.at_s, track.mentions[index], self.grounding, &[]);
            forecaster.expect_next(self.grounding, &track.labels[index + 1], 1.0, 0);
        }
        forecaster
    }

    /// The robot's knowledge at the beginning of each slot.
    #[must_use]
    pub fn knowledge(&self, room_time_s: usize, forecast: ForecastOptions) -> Knowledge {
        let (rooms, steps) = (self.cost.rooms(), self.cost.steps());
        let starts: Vec<usize> = (0..steps).step_by(room_time_s.max(1)).collect();
        let scores = starts.iter().map(|from| self.probability(*from as f64)).collect();
        let expected_shared_s = starts
            .par_iter()
            .map(|now| {
                let forecasters: Vec<_> =
                    self.tracks.iter().map(|track| self.forecaster(track, forecast, *now as f64)).collect();
                let later = starts.iter().filter(|from| *from >= now);
                later
                    .flat_map(|from| {
                        let to = (from + room_time_s).min(steps);
                        let mut expected = vec![0.0; rooms];
                        for forecaster in &forecasters {
                            let (from_s, to_s) = ((from - now) as f64, (to - now) as f64);
                            let one = forecaster.expected_s(*now as f64, from_s, to_s);
                            expected.iter_mut().zip(one).for_each(|(sum, s)| *sum += s);
                        }
                        expected
                    })
                    .collect()
            })
            .collect();
        Knowledge { scores, expected_shared_s }
    }

    /// A clairvoyant robot's knowledge: the cost itself.
    fn truth(&self, room_time_s: usize) -> Knowledge {
        let (rooms, slots) = (self.cost.rooms(), self.cost.slots(room_time_s));
        let count = slots.len() / rooms;
        Knowledge {
            scores: vec![vec![1.0 / rooms as f64; rooms]; count],
            expected_shared_s: (0..count).map(|slot| slots[slot * rooms..].to_vec()).collect(),
        }
    }
}

fn normalised(mut scores: Vec<f64>) -> Vec<f64> {
    let total: f64 = scores.iter().sum();
    let even = 1.0 / scores.len().max(1) as f64;
    scores.iter_mut().for_each(|score| *score = if total > 0.0 { *score / total } else { even });
    scores
}

/// The decider.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Decider {
    /// A policy of a real robot; coverage-aware has its default weight.
    Policy(PolicyName),
    /// Coverage-aware avoidance with this weight, in seconds of disturbance per failure.
    CoverageAware(f64),
    /// The clairvoyant optimum. It covers whenever that is possible.
    Clairvoyant,
}

impl Decider {
    /// Its name in tables.
    #[must_use]
    pub fn name(self) -> String {
        match self {
            Self::Policy(name) => name.as_str().to_owned(),
            Self::CoverageAware(weight_s) => format!("coverage-aware {weight_s}"),
            Self::Clairvoyant => "clairvoyant".to_owned(),
        }
    }

    fn policy(self) -> Box<dyn Policy> {
        match self {
            Self::Policy(name) => name.policy(),
            Self::CoverageAware(weight_s) => Box::new(CoverageAware::new(Some(weight_s))),
            Self::Clairvoyant => Box::new(CoverageAware::clairvoyant()),
        }
    }
}

/// One cell of a table: a home, a T_r, a decider, and all restarts.
#[derive(Debug, Clone)]
pub struct Cell {
    /// The map.
    pub scene: String,
    /// The activity.
    pub program: String,
    /// T_r.
    pub room_time_s: usize,
    /// The decider.
    pub decider: Decider,
    /// The runs in the order of the restarts, so that cells of one home and T_r are paired.
    pub runs: Vec<Run>,
    /// The clairvoyant optimum, per starting room.
    pub optima: Vec<Optimum>,
    /// T.
    pub horizon_s: usize,
}

/// Runs every decider in every home at every T_r. The optimum of each is found by HiGHS and, up to [`ROOMS_PROGRAMMED_MAX`] rooms, by
/// dynamic programming, which must agree, and no run may be better.
///
/// # Errors
/// When T_r does not fit, a solver fails, or one of these checks does.
pub fn run(
    homes: &[Home<'_>],
    room_times_s: &[usize],
    deciders: &[Decider],
    options: &Options,
    cell_is_done: impl Fn(),
) -> Result<Vec<Cell>, StudyError> {
    let mut cells = Vec::new();
    for home in homes {
        for &room_time_s in room_times_s {
            check_room_time(room_time_s, home.cost.steps())?;
            let knowledge = home.knowledge(room_time_s, options.forecast);
            let truth = home.truth(room_time_s);
            let optima = optima(home, room_time_s)?;
            for &decider in deciders {
                let known = if decider == Decider::Clairvoyant { &truth } else { &knowledge };
                let runs = restarts(home, room_time_s, known, decider, options)?;
                if let Some(run) = runs.iter().find(|run| run.disturbance_s < bound_of(&optima, run) - 1e-6) {
                    let (found_s, bound_s) = (run.disturbance_s, bound_of(&optima, run));
                    return Err(StudyError::BelowBound { decider: decider.name(), found_s, bound_s });
                }
                cells.push(Cell {
                    scene: home.scene.clone(),
                    program: home.program.clone(),
                    room_time_s,
                    decider,
                    runs,
                    optima: optima.clone(),
                    horizon_s: home.cost.steps(),
                });
                cell_is_done();
            }
        }
    }
    Ok(cells)
}

/// All restarts of one decider with the given knowledge, in their order. Every decider has the same starts and draws.
///
/// # Errors
/// When T_r does not fit or the policy refuses.
pub fn restarts(
    home: &Home<'_>,
    room_time_s: usize,
    known: &Knowledge,
    decider: Decider,
    options: &Options,
) -> Result<Vec<Run>, WorldError> {
    let restarts = (0..options.restarts).into_par_iter();
    let run = |restart| {
        let mut rng = restart_rng(options.seed, restart);
        world::run(&home.cost, room_time_s, known, &mut *decider.policy(), &mut rng)
    };
    restarts.map(run).collect()
}

/// Averages of runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Means {
    /// Mean and standard deviation of D_T.
    pub disturbance_s: (f64, f64),
    /// Mean and standard deviation of t_c over the runs that covered; absent if none did.
    pub coverage_s: Option<(f64, f64)>,
    /// F: share of runs without full coverage.
    pub failure_rate: f64,
}

impl Means {
    /// The averages of some runs.
    #[must_use]
    pub fn of<'a>(runs: impl Iterator<Item = &'a Run> + Clone) -> Self {
        let count = runs.clone().count();
        let covered = runs.clone().filter_map(|run| run.coverage_s).map(|s| s as f64);
        let covering = covered.clone().count();
        Self {
            disturbance_s: moments(runs.map(|run| run.disturbance_s)),
            coverage_s: (covering > 0).then(|| moments(covered)),
            failure_rate: 1.0 - covering as f64 / count.max(1) as f64,
        }
    }
}

fn bound_of(optima: &[Optimum], run: &Run) -> f64 {
    let optimum = optima[run.start];
    if run.coverage_s.is_some() { optimum.covering_s.unwrap_or(f64::INFINITY) } else { optimum.free_s }
}

/// Most rooms for which the dynamic program is exact; the robot's own is covered from the start.
pub const ROOMS_PROGRAMMED_MAX: usize = DP_PARTITIONS_MAX + 1;

#[cfg(not(feature = "solver"))]
fn optima(home: &Home<'_>, room_time_s: usize) -> Result<Vec<Optimum>, StudyError> {
    match home.cost.rooms() {
        rooms if rooms > ROOMS_PROGRAMMED_MAX => Err(StudyError::NeedsSolver { rooms }),
        _ => Ok(clairvoyant::by_dynamic_program(&home.cost, room_time_s)),
    }
}

#[cfg(feature = "solver")]
fn optima(home: &Home<'_>, room_time_s: usize) -> Result<Vec<Optimum>, StudyError> {
    if home.cost.rooms() > ROOMS_PROGRAMMED_MAX {
        let solve = |start, cover| mixed_integer::optimum_s(&home.cost, room_time_s, start, cover);
        return (0..home.cost.rooms())
            .map(|start| {
                let free_s = solve(start, false)?.unwrap_or(0.0);
                Ok(Optimum { covering_s: solve(start, true)?, free_s })
            })
            .collect();
    }
    let optima = clairvoyant::by_dynamic_program(&home.cost, room_time_s);
    for (start, optimum) in optima.iter().enumerate() {
        for (cover, dynamic_s) in [(true, optimum.covering_s), (false, Some(optimum.free_s))] {
            let solver_s = mixed_integer::optimum_s(&home.cost, room_time_s, start, cover)?;
            let agree = match (dynamic_s, solver_s) {
                (Some(a), Some(b)) => (a - b).abs() < 1e-6,
                (a, b) => a == b,
            };
            if !agree {
                return Err(StudyError::SolversDisagree { dynamic_s, solver_s });
            }
        }
    }
    Ok(optima)
}

/// Figures of one or several cells of a decider: the columns of the paper's Table II.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// The map; "all" over several.
    pub scene: String,
    /// The activity; "all" over several.
    pub program: String,
    /// T_r in seconds; 0 over several.
    pub room_time_s: usize,
    /// The decider.
    pub policy: String,
    /// The number of runs.
    pub restarts: usize,
    /// Mean D_T.
    pub disturbance_mean: f64,
    /// Standard deviation of D_T over runs.
    pub disturbance_std: f64,
    /// Mean t_c over the runs that covered; absent if none did.
    pub coverage_time_mean: Option<f64>,
    /// Standard deviation of t_c.
    pub coverage_time_std: Option<f64>,
    /// F: share of runs without full coverage.
    pub failure_rate: f64,
    /// Shares of runs with a D_T smaller, equal and larger than the naive policy's from the same start.
    pub disturbance_against_naive: Option<[f64; 3]>,
    /// Shares of runs with a smaller, equal and larger t_c. A failed run counts as later than all others.
    pub coverage_time_against_naive: Option<[f64; 3]>,
    /// Least mean D_T of a clairvoyant robot that fails as often; absent if the task cannot be covered that often.
    pub bound_s: Option<f64>,
    /// Mean D_T minus that bound.
    pub regret_s: Option<f64>,
}

/// Summarises cells of one decider; `naive` are the cells of the naive policy in the same order.
#[must_use]
pub fn figures(cells: &[&Cell], naive: Option<&[&Cell]>) -> Figures {
    let runs = || cells.iter().flat_map(|cell| &cell.runs);
    let means = Means::of(runs());
    let (disturbance_mean, disturbance_std) = means.disturbance_s;
    let restarts = runs().count();
    let of_one = |value: fn(&Cell) -> &str| {
        let first = cells.first().map_or("", |cell| value(cell));
        if cells.iter().all(|cell| value(cell) == first) { first.to_owned() } else { "all".to_owned() }
    };
    let room_time_s = cells.first().map_or(0, |cell| cell.room_time_s);
    let against = |value: fn(&Run) -> f64| {
        let base = naive?.iter().flat_map(|cell| &cell.runs);
        let mut counts = [0_usize; 3];
        for (own, base) in runs().zip(base) {
            counts[match value(own).total_cmp(&value(base)) {
                std::cmp::Ordering::Less => 0,
                std::cmp::Ordering::Equal => 1,
                std::cmp::Ordering::Greater => 2,
            }] += 1;
        }
        Some(counts.map(|count| count as f64 / restarts.max(1) as f64))
    };
    // The bound uses the starts that were drawn, so that the luck of the draw is no regret.
    let of_run = |cell: &&Cell| -> Vec<Optimum> { cell.runs.iter().map(|run| cell.optima[run.start]).collect() };
    let bounds = cells.iter().map(|cell| clairvoyant::bound_s(&of_run(cell), failure_rate(cell)));
    let bound_s = bounds.sum::<Option<f64>>().map(|sum| sum / cells.len().max(1) as f64);
    Figures {
        scene: of_one(|cell| &cell.scene),
        program: of_one(|cell| &cell.program),
        room_time_s: if cells.iter().all(|cell| cell.room_time_s == room_time_s) { room_time_s } else { 0 },
        policy: cells.first().map(|cell| cell.decider.name()).unwrap_or_default(),
        restarts,
        disturbance_mean,
        disturbance_std,
        coverage_time_mean: means.coverage_s.map(|(mean, _)| mean),
        coverage_time_std: means.coverage_s.map(|(_, std)| std),
        failure_rate: means.failure_rate,
        disturbance_against_naive: against(|run| run.disturbance_s),
        coverage_time_against_naive: against(|run| run.coverage_s.map_or(f64::INFINITY, |s| s as f64)),
        bound_s,
        regret_s: bound_s.map(|bound_s| disturbance_mean - bound_s),
    }
}

/// F of one cell.
#[must_use]
pub fn failure_rate(cell: &Cell) -> f64 {
    cell.runs.iter().filter(|run| run.coverage_s.is_none()).count() as f64 / cell.runs.len().max(1) as f64
}

fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let n = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / n;
    (mean, (values.map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// The quality of the forecast at a horizon, next to simpler forecasts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HorizonRow {
    /// The predictor: `joined` (the forecast module), `persistence` (each person stays in place) or `scores` (the paper's).
    pub predictor: &'static str,
    /// The horizon in seconds.
    pub horizon_s: usize,
    /// Cases: one per completed action, person and horizon within the timeline.
    pub cases: usize,
    /// Mean Brier score over rooms, 0 to 2.
    pub brier: f64,
    /// Mean negative log-likelihood in nats.
    pub nll_nats: f64,
}

/// A person who stays in place: 0.95 here, and the rest evenly over the other rooms. Without other rooms, 1 here.
fn persistence(rooms: usize, here: usize) -> Vec<f64> {
    let others = rooms.saturating_sub(1);
    let other = if others > 0 { 0.05 / others as f64 } else { 0.0 };
    (0..rooms).map(|room| if room == here { 1.0 - other * others as f64 } else { other }).collect()
}

/// Evaluates the forecast after every completed action at each horizon. Persistence puts 0.95 on the likeliest present room, since a
/// certain forecast that is wrong once has no finite likelihood.
#[must_use]
pub fn horizons(homes: &[Home<'_>], forecast: ForecastOptions, horizons_s: &[usize]) -> Vec<HorizonRow> {
    const PREDICTORS: [&str; 3] = ["joined", "persistence", "scores"];
    let mut sums = vec![[0.0; 3]; PREDICTORS.len() * horizons_s.len()];
    for home in homes {
        let rooms = home.cost.rooms();
        for track in &home.tracks {
            let mut forecaster = Forecaster::new(rooms, forecast, 0.0);
            for (index, done) in track.timeline.done.iter().enumerate() {
                let scores = normalised(track.scores[index + 1].clone());
                forecaster.observe(done.at_s, track.mentions[index], home.grounding, &[]);
                forecaster.expect_next(home.grounding, &track.labels[index + 1], 1.0, 0);
                let belief = forecaster.belief();
                let here = (0..rooms).max_by(|a, b| belief[*a].total_cmp(&belief[*b])).unwrap_or(0);
                let stays = persistence(rooms, here);
                for (column, horizon_s) in horizons_s.iter().enumerate() {
                    let Some(truth) = track.timeline.rooms.get(done.at_s as usize + horizon_s) else { continue };
                    let joined: Vec<f64> = forecaster.at(done.at_s, *horizon_s as f64).collect();
                    for (predictor, p) in [&joined, &stays, &scores].into_iter().enumerate() {
                        let sum = &mut sums[predictor * horizons_s.len() + column];
                        let hit = p[truth.0 as usize];
                        sum[0] += 1.0;
                        sum[1] += p.iter().map(|q| q * q).sum::<f64>() + 1.0 - 2.0 * hit;
                        sum[2] -= hit.max(f64::MIN_POSITIVE).ln();
                    }
                }
            }
        }
    }
    // A horizon beyond all timelines has no cases.
    let with_cases = sums.iter().enumerate().filter(|(_, [cases, ..])| *cases > 0.0);
    with_cases
        .map(|(index, [cases, brier, nll])| HorizonRow {
            predictor: PREDICTORS[index / horizons_s.len()],
            horizon_s: horizons_s[index % horizons_s.len()],
            cases: *cases as usize,
            brier: brier / cases,
            nll_nats: nll / cases,
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::scorer::correction::CorrectionChoice;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{Method, Tokenisation};

    fn options() -> Options {
        Options { items: ItemChoice::Uniform, restarts: 300, ..Options::default() }
    }

    fn with_homes(activities: &[usize], check: impl FnOnce(&[Home<'_>])) {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let labels = grounding.label_texts();
        let mut source = ScoreSource::new(
            TableModel::new(1),
            &labels,
            Method::Trie,
            Tokenisation::Joint,
            CorrectionChoice::default(),
            None,
        )
        .unwrap();
        let programs =
            crate::PROGRAMS.map(|(name, text)| (name.to_owned(), Activity::Program(Program::parse(text).unwrap())));
        let chosen: Vec<_> = activities.iter().map(|i| (programs[*i].0.clone(), &programs[*i].1)).collect();
        let home = Home::new(&map, &grounding, &chosen, &mut source, &BindingSequence::default(), &options()).unwrap();
        check(&[home]);
    }

    const ALL: [Decider; 4] = [
        Decider::Policy(PolicyName::Naive),
        Decider::Policy(PolicyName::InformedAvoidance),
        Decider::Policy(PolicyName::CoverageAware),
        Decider::Clairvoyant,
    ];

    #[test]
    fn a_table_obeys_the_closed_forms_and_the_bound() {
        with_homes(&[0], |homes| {
            let cells = run(homes, &[25, 50], &ALL, &options(), || {}).unwrap();
            assert_eq!(cells.len(), 8);
            let naive = figures(&[&cells[0]], None);
            assert!((naive.disturbance_mean - homes[0].cost().naive_disturbance()).abs() < 15.0);
            let best = figures(&[&cells[3]], Some(&[&cells[0]]));
            assert_eq!(best.failure_rate, 0.0);
            assert!(best.regret_s.unwrap().abs() < 1e-6, "{best:?}");
            assert!(cells.iter().all(|cell| figures(&[cell], None).regret_s.is_none_or(|regret| regret > -1e-6)));
            let shares = best.disturbance_against_naive.unwrap();
            assert_eq!(shares.iter().sum::<f64>(), 1.0, "{shares:?}");
            // With a high weight, a plan with the true costs always covers, and so does one with the forecast's.
            assert_eq!(figures(&[&cells[2]], None).failure_rate, 0.0);
            let again = run(homes, &[25, 50], &ALL, &options(), || {}).unwrap();
            assert!(cells.iter().zip(&again).all(|(a, b)| a.runs == b.runs), "one seed, one table");
        });
    }

    #[test]
    fn several_persons_add_up() {
        with_homes(&[0, 1], |both| {
            with_homes(&[0], |one| {
                with_homes(&[1], |other| {
                    let sum = one[0].cost().naive_disturbance() + other[0].cost().naive_disturbance();
                    assert!((both[0].cost().naive_disturbance() - sum).abs() < 1e-9);
                    let expected = both[0].knowledge(50, ForecastOptions::default()).expected_shared_s;
                    // Two people, 50 seconds: the first slot expects 100 seconds over all rooms.
                    assert!((expected[0][..3].iter().sum::<f64>() - 100.0).abs() < 1e-6);
                });
            });
        });
    }

    #[test]
    fn persistence_is_a_distribution_in_any_map() {
        for rooms in 1..9 {
            for here in 0..rooms {
                let stays = persistence(rooms, here);
                assert!((stays.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{stays:?}");
                assert!(stays.iter().all(|p| *p <= stays[here]), "{stays:?}");
            }
        }
    }

    #[test]
    fn horizons_are_scored_for_each_predictor() {
        with_homes(&[2], |homes| {
            let rows = horizons(homes, ForecastOptions::default(), &[1, 30, 1_000_000]);
            // No timeline lasts a million seconds.
            assert_eq!(rows.len(), 6);
            assert!(rows.iter().all(|row| row.cases > 0 && row.horizon_s < 60));
            assert!(rows[0].cases == 42 || rows[0].cases == 41);
            assert!(rows[0].brier < 0.5, "{rows:?}");
        });
    }
}
