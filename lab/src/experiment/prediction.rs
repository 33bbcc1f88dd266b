//! The quality of the forecast of the next object and the next room, next to baselines on the same cases.
//!
//! A case is a step of a program. After action k, the *next object* is the first object of the next action that names another object than
//! the last one (by its words). So "walk to the cup, find the cup" gives no case. There is no case if the map lacks the object. The object
//! in hand is removed from every forecast of objects, since it is not next.
//!
//! The *next room* is the room of the item that the object is bound to ([`ItemChoice`]). *Room-change* cases are the cases with another
//! room than that of the last bound object. In these, *room-if-changed* asks every forecast for the next room given that the person leaves:
//! the current room is removed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use roomcast_cli::{Failure, report_faults};
use serde::Serialize;

use super::baselines::{self, Baselines, Statistics};
use super::losses::{Summary, Sums, difference, macro_average, macro_difference, merged, summarise};
use super::{Progress, nothing_bound};
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Action, Program, Sentence};
use roomcast_core::places::PlaceMatcher;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::scorer::correction::Correction;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_simulation::ScoreSource;
use roomcast_simulation::binding::{Binder, ItemChoice};

#[derive(Debug, Clone)]
pub struct NamedProgram {
    pub path: PathBuf,
    pub program: Program,
    /// The activity of the program: its title, unless a manifest groups similar titles.
    pub activity: String,
}

/// Programs for one model, with the training data of the model and of the baselines.
#[derive(Debug, Clone)]
pub struct Part {
    pub programs: Vec<NamedProgram>,
    /// The programs of the model's training split, for the nearness of the others; may be empty.
    pub trained: Vec<NamedProgram>,
    pub statistics: Statistics,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Target {
    Object,
    /// The next room, over all cases.
    Room,
    /// The next room, over the cases in which the room changes.
    RoomChange,
    /// The next room among the rooms other than the current one, over the cases in which the room changes.
    RoomIfChanged,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub predictor: &'static str,
    pub target: Target,
    /// The map; "all" over several.
    pub scene: String,
    /// The choice among several things of a kind; `None` if it makes no difference.
    pub items: Option<&'static str>,
    /// The figures.
    #[serde(flatten)]
    pub summary: Summary,
    /// The model's figures minus these, on the same cases resampled together; `None` for the model itself.
    pub model_less_this: Option<Summary>,
    /// The same means, with intervals over activities.
    pub by_activity: Summary,
    /// Means with equal weights of the activities; its cases are activities.
    pub macro_average: Summary,
    /// As `model_less_this`, with intervals over activities.
    pub model_less_this_by_activity: Option<Summary>,
    /// As `model_less_this_by_activity`, for the means with equal weights of the activities.
    pub model_less_this_macro: Option<Summary>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// Cases of the target `object`, over all scenes.
    pub cases: usize,
    /// Programs evaluated: those with a case in any of the scenes.
    pub programs: usize,
    pub programs_without_case: usize,
    pub activities: usize,
    /// Next objects with the label of the last one, which give no cases, over all scenes.
    pub same_label: usize,
    /// The model's lead by the nearness of the closest program of its training split; empty if that is unknown.
    pub nearness: Vec<Near>,
    /// Next objects that the maps lack, the most frequent first, over all scenes.
    pub unbound: Vec<(String, usize)>,
    /// Share of next objects that the maps have.
    pub bound_share: f64,
    /// Scores that the model computed and the cache did not have.
    pub computed: usize,
    /// The corrections of the scores; models of different folds may recommend different ones.
    pub corrections: Vec<Correction>,
    pub rows: Vec<Row>,
}

/// The model's lead over Kneser-Ney with its cache, next object, over programs of similar nearness to the training split.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Near {
    /// Least and greatest nearness: the share of objects that a program has in common with the most similar one of the training split
    /// (Jaccard).
    pub nearness: [f64; 2],
    pub programs: usize,
    /// The model's figures minus Kneser-Ney's with its cache.
    pub model_less_kneser_ney_cache: Summary,
    /// The same, with intervals over activities.
    pub by_activity: Summary,
}

#[derive(Debug, Clone)]
pub struct Options {
    pub history: HistoryLimits,
    pub binding: BindingSequence,
    /// The choices among a label's items; each has a table.
    pub items: Vec<ItemChoice>,
    /// The assumptions of the forecast `model-near`.
    pub forecast: ForecastOptions,
    pub seed: u64,
}

const PREDICTORS: [&str; 12] = [
    "model",
    "model-near",
    "model-cache",
    "model-kneser-ney-cache",
    "uniform",
    "frequency",
    "markov1",
    "markov2",
    "kneser-ney",
    "kneser-ney-cache",
    "stay",
    "no-narration",
];
const TARGETS: [Target; 4] = [Target::Object, Target::Room, Target::RoomChange, Target::RoomIfChanged];

/// Reads every program below `folder` in the order of their paths; `folder` may be a single file. A household's day is read as one program.
/// Other files are reported with their faults.
pub fn load_programs(folder: &Path) -> Result<Vec<NamedProgram>, Failure> {
    let mut files = Vec::new();
    let mut waiting = vec![folder.to_owned()];
    while let Some(path) = waiting.pop() {
        let failed = |error: std::io::Error| Failure::input(format!("failed to read {}: {error}", path.display()));
        if std::fs::metadata(&path).map_err(failed)?.is_dir() {
            for entry in std::fs::read_dir(&path).map_err(failed)? {
                waiting.push(entry.map_err(failed)?.path());
            }
        } else if path.extension().is_some_and(|extension| extension == "txt") || path == folder {
            files.push(path);
        }
    }
    files.sort();
    let (mut programs, mut faults) = (Vec::new(), Vec::new());
    for path in files {
        match roomcast_simulation::homer::load_any(&path) {
            Ok(program) => {
                // As manifests write titles.
                let activity = program.title.to_lowercase().split_whitespace().collect::<Vec<_>>().join(" ");
                faults.extend(program.notes.iter().map(|note| format!("{}: {note}", path.display())));
                programs.push(NamedProgram { path, program, activity });
            }
            Err(fault) => faults.push(fault.to_string()),
        }
    }
    if programs.is_empty() {
        let fault = faults.first().map(|fault| format!(" ({fault})")).unwrap_or_default();
        return Err(Failure::input(format!(
            "no activity program in {}{fault}: give a folder of .txt files in VirtualHome's format",
            folder.display()
        )));
    }
    report_faults(&faults);
    Ok(programs)
}

#[derive(Debug, Default)]
pub(super) struct LeftOut {
    unbound: BTreeMap<String, usize>,
    same_label: usize,
}

pub(super) struct Case {
    /// The number of completed actions.
    pub(super) done: usize,
    pub(super) object: usize,
    pub(super) room: Option<usize>,
    pub(super) here: Option<usize>,
    /// The last three objects, the latest last.
    context: [Option<String>; 3],
    /// The labels used so far, the latest last, and the label in hand, if the map has it. That one is not next.
    visited: Vec<usize>,
    in_hand: Option<usize>,
}

pub(super) fn cases(
    program: &Program,
    binder: &mut Binder<'_>,
    grounding: &Grounding,
    left_out: &mut LeftOut,
) -> Vec<Case> {
    let steps = &program.steps;
    let words: Vec<Option<String>> = steps.iter().map(|step| step.objects().first().map(|o| o.words())).collect();
    let mut cases = Vec::new();
    let mut context: [Option<String>; 3] = Default::default();
    let (mut visited, mut in_hand) = (Vec::new(), None);
    let (mut last_words, mut here) = (None, None);
    let mut at_m = [0.0; 3];
    for done in 1..=steps.len() {
        let step = &steps[done - 1];
        if let Some(object) = step.objects().first() {
            if last_words != words[done - 1] {
                context.rotate_left(1);
                context[2] = Some(baselines::key(&object.name, binder, grounding));
                in_hand = binder.label(&object.name);
                visited.extend(in_hand);
                last_words.clone_from(&words[done - 1]);
            }
            if let Some(place) = binder.bind(object, at_m) {
                at_m = place.position_m;
                here = place.partition.map(|p| p.0 as usize).or(here);
            }
        }
        let next = (done..steps.len()).find(|next| words[*next].is_some() && words[*next] != last_words);
        let Some(object) = next.and_then(|next| steps[next].objects().first()) else { continue };
        let place = binder.bind(object, at_m);
        let Some((place, label)) = place.and_then(|place| Some((place, place.label?))) else {
            *left_out.unbound.entry(object.words()).or_default() += 1;
            continue;
        };
        if in_hand == Some(label) {
            left_out.same_label += 1;
            continue;
        }
        cases.push(Case {
            done,
            object: label,
            room: place.partition.map(|p| p.0 as usize),
            here,
            context: context.clone(),
            visited: visited.clone(),
            in_hand,
        });
    }
    cases
}

fn activities<'a>(programs: impl Iterator<Item = &'a NamedProgram>) -> Vec<usize> {
    let mut known = BTreeMap::new();
    let number = |named: &'a NamedProgram| {
        let next = known.len();
        *known.entry(named.activity.as_str()).or_insert(next)
    };
    programs.map(number).collect()
}

/// The nearness of a program to the most similar one of others: the share of objects that two have in common.
fn nearness(program: &Program, trained: &[BTreeSet<String>]) -> f64 {
    let own = objects(program);
    let shared = |other: &BTreeSet<String>| {
        let common = own.intersection(other).count() as f64;
        common / (own.len() + other.len()) as f64
    };
    // The union of a and b objects with c in common has a + b - c.
    trained.iter().map(shared).map(|share| share / (1.0 - share)).fold(0.0, f64::max)
}

fn objects(program: &Program) -> BTreeSet<String> {
    program.steps.iter().filter_map(|step| step.objects().first()).map(|object| object.words()).collect()
}

/// Follows one person's narration alone; every action takes its typical time.
struct Listener {
    forecaster: Forecaster,
    heard: usize,
    at_s: f64,
}

impl Listener {
    fn new(rooms: usize, options: ForecastOptions) -> Self {
        Self { forecaster: Forecaster::new(rooms, options, 0.0), heard: 0, at_s: 0.0 }
    }

    /// Follows up to the `done`-th action; `rows` are the model's scores after each.
    fn hear(
        &mut self,
        program: &Program,
        said: &[Sentence],
        rows: &[Vec<f64>],
        done: usize,
        (mentions, grounding): (&mut PlaceMatcher, &Grounding),
    ) {
        for at in self.heard..done {
            self.at_s += program.steps[at].entry().duration_s;
            self.forecaster.observe(self.at_s, mentions.last(said[at].as_str()), grounding, &[]);
            self.forecaster.expect_next(grounding, &rows[at + 1], 1.0, 0);
        }
        self.heard = done;
    }
}

/// Sums by predictor and target, and by program of a part.
type Groups = Vec<Vec<Sums>>;

fn evaluate<M: LanguageModel>(
    (map, grounding): &(SemanticMap, Grounding),
    source: &mut ScoreSource<M>,
    part: &Part,
    (options, items): (&Options, ItemChoice),
    left_out: &mut LeftOut,
    progress: &Progress,
) -> Result<Groups, Failure> {
    let mut binder = Binder::new(map, grounding, items);
    let baselines = Baselines::new(&part.statistics, &mut binder, grounding);
    let mut grounded = GroundedScores::default();
    let blind = source.score([], &options.binding.clone().without_narration())?;
    let blind = probabilities(&blind);
    let blind_rooms = rooms_of(&blind, grounding, &mut grounded)?;
    let (labels, rooms) = (grounding.scored_labels().len(), grounding.partitions().len());
    let even_labels = vec![1.0 / labels as f64; labels];
    let even_rooms = vec![1.0 / rooms as f64; rooms];
    let frequency_rooms = rooms_of(&baselines.frequency, grounding, &mut grounded)?;
    let mut sums = vec![vec![Sums::default(); part.programs.len()]; PREDICTORS.len() * TARGETS.len()];
    let mut mentions = PlaceMatcher::new(map, grounding);

    for (index, NamedProgram { path, program, .. }) in part.programs.iter().enumerate() {
        binder.begin(options.seed, &path.file_stem().unwrap_or_default().to_string_lossy());
        let cases = cases(program, &mut binder, grounding, left_out);
        let Some(last) = cases.last() else {
            progress.step();
            continue;
        };
        let sentences = sentences(&program.steps[..last.done])?;
        let rows = source.score_steps(&sentences, options.history, &options.binding)?;
        let mut listener = Listener::new(rooms, options.forecast);
        for case in &cases {
            listener.hear(program, &sentences, &rows, case.done, (&mut mentions, grounding));
            let near_rooms = listener.forecaster.expected().unwrap_or(&even_rooms).to_vec();
            let model = probabilities(&rows[case.done]);
            let context @ [_, before, last] = case.context.each_ref().map(Option::as_deref);
            let chain = baselines.kneser_ney.after(context);
            let stay_rooms = baselines.stay(case.here, rooms);
            let (visited, in_hand) = (case.visited.as_slice(), case.in_hand);
            // Rooms are those of the labels unless they are given.
            let forecasts: [(Vec<f64>, Option<&[f64]>); PREDICTORS.len()] = [
                (model.clone(), None),
                (model.clone(), Some(&near_rooms)),
                (baselines::MODEL_CACHE.mixed(&model, visited, in_hand), None),
                (baselines::mixture(&model, &chain, visited, in_hand), None),
                (even_labels.clone(), Some(&even_rooms)),
                (baselines.frequency.clone(), Some(&frequency_rooms)),
                (baselines.markov1(last), None),
                (baselines.markov2(before, last), None),
                (chain.clone(), None),
                (baselines.kneser_ney.with_cache(&chain, visited, in_hand), None),
                (labels_in(&stay_rooms, grounding), Some(&stay_rooms)),
                (blind.clone(), Some(&blind_rooms)),
            ];
            for (predictor, (of_labels, of_rooms)) in forecasts.iter().enumerate() {
                let row = predictor * TARGETS.len();
                let others = in_hand.map(|label| without(of_labels, label));
                sums[row][index].add(others.as_deref().unwrap_or(of_labels), case.object);
                let Some(room) = case.room else { continue };
                let of_labels = || rooms_of(of_labels, grounding, &mut grounded);
                let of_rooms = of_rooms.map_or_else(of_labels, |rooms| Ok(rooms.to_vec()))?;
                sums[row + 1][index].add(&of_rooms, room);
                if let Some(here) = case.here.filter(|here| *here != room) {
                    sums[row + 2][index].add(&of_rooms, room);
                    sums[row + 3][index].add(&without(&of_rooms, here), room);
                }
            }
        }
        progress.step();
    }
    source.flush()?;
    Ok(sums)
}

/// The rows of one scene and one binding, from the sums of all programs.
fn rows(scene: &str, items: ItemChoice, sums: &Groups, of_activity: &[usize], seed: u64) -> Vec<Row> {
    let by_activity: Groups = sums.iter().map(|groups| merged(groups, of_activity)).collect();
    let rows = sums.iter().zip(&by_activity).enumerate().map(|(index, (groups, activities))| {
        let model = index % TARGETS.len();
        // The model is the first predictor.
        let is_other = index >= TARGETS.len();
        let target = TARGETS[model];
        Row {
            predictor: PREDICTORS[index / TARGETS.len()],
            target,
            scene: scene.to_owned(),
            items: (target != Target::Object).then(|| items.into()),
            summary: summarise(groups, seed),
            model_less_this: is_other.then(|| difference(&sums[model], groups, seed)),
            by_activity: summarise(activities, seed),
            macro_average: macro_average(activities, seed),
            model_less_this_by_activity: is_other.then(|| difference(&by_activity[model], activities, seed)),
            model_less_this_macro: is_other.then(|| macro_difference(&by_activity[model], activities, seed)),
        }
    });
    rows.collect()
}

/// The lead by thirds of the programs, the farthest from the training split first.
fn by_nearness(sums: &Groups, parts: &[Part], of_activity: &[usize], seed: u64) -> Vec<Near> {
    if parts.iter().any(|part| part.trained.is_empty()) {
        return Vec::new();
    }
    let of_part = |part: &Part| {
        let trained: Vec<BTreeSet<String>> = part.trained.iter().map(|named| objects(&named.program)).collect();
        part.programs.iter().map(|named| nearness(&named.program, &trained)).collect::<Vec<_>>()
    };
    let near: Vec<f64> = parts.iter().flat_map(of_part).collect();
    let row =
        |predictor: &str| PREDICTORS.iter().position(|name| *name == predictor).map(|at| &sums[at * TARGETS.len()]);
    let (Some(model), Some(cache)) = (row("model"), row("kneser-ney-cache")) else { return Vec::new() };
    let mut order: Vec<usize> = (0..near.len()).filter(|program| !model[*program].is_empty()).collect();
    order.sort_by(|a, b| near[*a].total_cmp(&near[*b]));
    let third = order.len().div_ceil(3).max(1);
    let of = |programs: &[usize]| {
        let pick = |row: &[Sums]| programs.iter().map(|program| row[*program]).collect::<Vec<_>>();
        let (model, cache) = (pick(model), pick(cache));
        let activity: Vec<usize> = programs.iter().map(|program| of_activity[*program]).collect();
        Near {
            nearness: [programs.first(), programs.last()].map(|program| program.map_or(0.0, |program| near[*program])),
            programs: programs.len(),
            model_less_kneser_ney_cache: difference(&model, &cache, seed),
            by_activity: difference(&merged(&model, &activity), &merged(&cache, &activity), seed),
        }
    };
    order.chunks(third).map(of).collect()
}

/// Evaluates in several maps. `open` gives the source of scores for a part, by its number, and a map's labels. Programs of several parts
/// are pooled, for example if each part is a fold with another model.
pub fn run<M: LanguageModel>(
    maps: &[(SemanticMap, Grounding)],
    parts: &[Part],
    options: &Options,
    progress: &Progress,
    mut open: impl FnMut(usize, &Grounding) -> Result<ScoreSource<M>, Failure>,
) -> Result<Report, Failure> {
    let mut report = Report::default();
    let of_activity = activities(parts.iter().flat_map(|part| &part.programs));
    let mut unbound: BTreeMap<String, usize> = BTreeMap::new();
    // By binding, over all maps.
    let mut all: Vec<Groups> = Vec::new();
    for scene in maps {
        let mut of_scene: Vec<Groups> = vec![vec![Vec::new(); PREDICTORS.len() * TARGETS.len()]; options.items.len()];
        for (number, part) in parts.iter().enumerate() {
            let mut source = open(number, &scene.1)?;
            for (index, items) in options.items.iter().enumerate() {
                let mut left_out = LeftOut::default();
                let sums = evaluate(scene, &mut source, part, (options, *items), &mut left_out, progress)?;
                of_scene[index].iter_mut().zip(sums).for_each(|(groups, more)| groups.extend(more));
                if index == 0 {
                    report.same_label += left_out.same_label;
                    left_out.unbound.into_iter().for_each(|(name, n)| *unbound.entry(name).or_default() += n);
                }
            }
            report.computed += source.computed();
            if !report.corrections.contains(&source.correction()) {
                report.corrections.push(source.correction());
            }
        }
        let cases: usize = of_scene.first().map_or(0, |groups| groups[0].iter().map(Sums::len).sum());
        if cases == 0 {
            return Err(nothing_bound(scene.0.name()));
        }
        report.cases += cases;
        report.add_rows(scene.0.name(), &of_scene, &of_activity, options);
        if all.is_empty() {
            all = of_scene;
        } else {
            for (sum, more) in all.iter_mut().flatten().flatten().zip(of_scene.iter().flatten().flatten()) {
                sum.merge(more);
            }
        }
    }
    if maps.len() > 1 {
        report.add_rows("all", &all, &of_activity, options);
    }
    if let Some(groups) = all.first() {
        report.nearness = by_nearness(groups, parts, &of_activity, options.seed);
        let with_case: Vec<usize> = (0..of_activity.len()).filter(|program| !groups[0][*program].is_empty()).collect();
        report.programs = with_case.len();
        report.programs_without_case = of_activity.len() - with_case.len();
        report.activities = with_case.iter().map(|program| of_activity[*program]).collect::<BTreeSet<_>>().len();
    }
    let missing: usize = unbound.values().sum();
    report.bound_share = report.cases as f64 / (report.cases + missing) as f64;
    report.unbound = unbound.into_iter().collect();
    report.unbound.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
    Ok(report)
}

impl Report {
    /// The rows of a scene with every binding; rows that do not depend on it appear once.
    fn add_rows(&mut self, scene: &str, of_items: &[Groups], of_activity: &[usize], options: &Options) {
        for (index, (items, sums)) in options.items.iter().zip(of_items).enumerate() {
            let rows = rows(scene, *items, sums, of_activity, options.seed);
            self.rows.extend(rows.into_iter().filter(|row| index == 0 || row.target != Target::Object));
        }
    }
}

pub fn sentences(steps: &[Action]) -> Result<Vec<Sentence>, Failure> {
    steps.iter().map(|step| Ok(Sentence::new(&step.sentence())?)).collect()
}

pub fn probabilities(log_prob_nats: &[f64]) -> Vec<f64> {
    let greatest = log_prob_nats.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut labels: Vec<f64> = log_prob_nats.iter().map(|l| (l - greatest).exp()).collect();
    let total: f64 = labels.iter().sum();
    labels.iter_mut().for_each(|p| *p /= total);
    labels
}

/// Probabilities given that the outcome is another one.
fn without(probabilities: &[f64], outcome: usize) -> Vec<f64> {
    let mut others = probabilities.to_vec();
    others[outcome] = 0.0;
    let total: f64 = others.iter().sum();
    others.iter_mut().for_each(|p| *p /= total.max(f64::MIN_POSITIVE));
    others
}

fn rooms_of(labels: &[f64], grounding: &Grounding, grounded: &mut GroundedScores) -> Result<Vec<f64>, Failure> {
    // Rounding may leave a probability above one, which is not a log-probability.
    let log_prob_nats: Vec<f64> = labels.iter().map(|p| p.ln().min(0.0)).collect();
    grounding.ground(&log_prob_nats, grounded)?;
    Ok(grounded.partition_probability.clone())
}

/// A forecast of rooms as a forecast of labels: each room's probability in equal parts for its items.
fn labels_in(rooms: &[f64], grounding: &Grounding) -> Vec<f64> {
    let items = |room: usize| -> Vec<f64> {
        grounding
            .scored_labels()
            .iter()
            .enumerate()
            .map(|(c, label)| grounding.weights()[(c, room)] * label.count)
            .collect()
    };
    // Labels with all items outside every room keep a little, since they can still be next.
    let mut labels = vec![1e-6; grounding.scored_labels().len()];
    for (room, probability) in rooms.iter().enumerate() {
        let items = items(room);
        let total: f64 = items.iter().sum();
        if total > 0.0 {
            labels.iter_mut().zip(&items).for_each(|(label, count)| *label += probability * count / total);
        }
    }
    let total: f64 = labels.iter().sum();
    labels.iter_mut().for_each(|p| *p /= total);
    labels
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::scorer::correction::CorrectionChoice;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{Method, Tokenisation};
    use roomcast_services::embedded::EmbeddedText;

    fn studio() -> (SemanticMap, Grounding) {
        let map = SemanticMap::from_json(include_str!("../../../scenes/studio.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        (map, grounding)
    }

    #[test]
    fn a_case_is_a_step_with_another_object_ahead() {
        let (map, grounding) = studio();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::First);
        let text =
            "T\nd\n\n[Walk] <fridge> (1)\n[Open] <fridge> (1)\n[Find] <spaceship> (1)\n[Sit] <couch> (1)\n[StandUp]\n";
        let program = Program::parse(text).unwrap();
        let mut left_out = LeftOut::default();
        let cases = cases(&program, &mut binder, &grounding, &mut left_out);
        // After walk and open, the spaceship is next and cannot be bound; after it, the sofa; then nothing.
        assert_eq!(left_out.unbound, BTreeMap::from([("spaceship".to_owned(), 2)]));
        assert_eq!(cases.len(), 1);
        assert_eq!(
            (cases[0].done, cases[0].context.each_ref().map(Option::as_deref)),
            (3, [None, Some("fridge"), Some("spaceship")])
        );
        assert_eq!(grounding.scored_labels()[cases[0].object].text, "sofa");
        assert_ne!(cases[0].room, cases[0].here);
    }

    /// A couch is a sofa to this map, so it is not another thing.
    #[test]
    fn the_same_label_again_is_no_case() {
        let (map, grounding) = studio();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::First);
        let text = "T\nd\n\n[Walk] <fridge> (1)\n[Find] <sofa> (1)\n[Sit] <couch> (1)\n[Walk] <fridge> (1)\n";
        let mut left_out = LeftOut::default();
        let cases = cases(&Program::parse(text).unwrap(), &mut binder, &grounding, &mut left_out);
        assert_eq!(cases.iter().map(|case| case.done).collect::<Vec<_>>(), [1, 3]);
        assert_eq!((left_out.same_label, left_out.unbound.len()), (1, 0));
    }

    #[test]
    fn nearness_is_the_share_of_objects_in_common_with_the_most_similar_program() {
        let program = |text: &str| Program::parse(&format!("T\nd\n\n{text}")).unwrap();
        let own = program("[Walk] <fridge> (1)\n[Find] <sofa> (1)\n");
        let trained = [
            objects(&program("[Walk] <fridge> (1)\n[Find] <bed> (1)\n[Find] <cup> (1)\n")),
            objects(&program("[Walk] <bed> (1)\n")),
        ];
        assert!((nearness(&own, &trained) - 0.25).abs() < 1e-12);
        assert_eq!(nearness(&own, &[]), 0.0);
        assert!((nearness(&own, &[objects(&own)]) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn the_report_has_every_predictor_and_target_for_each_scene() {
        let programs = roomcast_services::embedded::PROGRAMS.map(|EmbeddedText { name, text }| NamedProgram {
            path: name.into(),
            program: Program::parse(text).unwrap(),
            activity: name.into(),
        });
        let statistics = Statistics::fit(programs.iter().map(|p| &p.program));
        let part = Part { programs: programs.to_vec(), trained: programs.to_vec(), statistics };
        let options = Options {
            history: HistoryLimits::default(),
            binding: BindingSequence::default(),
            items: vec![ItemChoice::Uniform, ItemChoice::Nearest],
            forecast: ForecastOptions::default(),
            seed: 1,
        };
        let run_with = |parts: &[Part]| {
            run(&[studio()], parts, &options, &Progress::hidden(), |_, grounding| {
                Ok(ScoreSource::new(
                    TableModel::new(1),
                    &grounding.label_texts(),
                    Method::Trie,
                    Tokenisation::Joint,
                    CorrectionChoice::default(),
                    None,
                )?)
            })
            .unwrap()
        };
        let report = run_with(std::slice::from_ref(&part));
        // Twelve predictors: of the object once, of three targets of rooms with each binding.
        assert_eq!(report.rows.len(), 84);
        assert_eq!((report.nearness.len(), report.activities), (3, 3));
        assert!(report.nearness.iter().all(|near| near.nearness == [1.0, 1.0]));
        assert!(report.cases > 40 && report.rows.iter().all(|row| row.summary.mean.nll_nats.is_finite()));
        let find =
            |predictor, target| report.rows.iter().find(|r| r.predictor == predictor && r.target == target).unwrap();
        assert_eq!(find("stay", Target::RoomChange).summary.mean.top1, 0.0);
        let uniform = find("uniform", Target::Room).summary;
        assert!((uniform.mean.nll_nats - 3f64.ln()).abs() < 1e-9 && (uniform.mean.top1 - 1.0 / 3.0).abs() < 1e-9);
        // The thing in hand is not among the next ones.
        let labels = studio().1.scored_labels().len() as f64;
        let even = find("uniform", Target::Object).summary.mean.nll_nats;
        assert!(even < labels.ln() - 1e-6 && even > (labels - 1.0).ln() - 1e-9);
        // A person who leaves one of three rooms has two left.
        let chance = find("uniform", Target::RoomIfChanged).summary;
        assert!((chance.mean.nll_nats - 2f64.ln()).abs() < 1e-9 && (chance.mean.top1 - 0.5).abs() < 1e-9);
        assert!(
            find("model", Target::RoomIfChanged).summary.mean.top1
                >= find("model", Target::RoomChange).summary.mean.top1
        );
        // Fitted on the evaluated programs, a chain of second order beats one of first order, and that beats frequencies.
        let nll = |predictor| find(predictor, Target::Object).summary.mean.nll_nats;
        assert!(nll("markov2") <= nll("markov1") && nll("markov1") < nll("frequency"));
        assert!(nll("kneser-ney") < nll("markov1") && nll("kneser-ney-cache") < nll("frequency"));
        assert_eq!(report, run_with(std::slice::from_ref(&part)));
        // A program of missing things has no case, and is never drawn.
        let mut more = part.clone();
        let text = "T\nd\n\n[Walk] <spaceship> (1)\n[Grab] <antenna> (1)\n";
        let nothing = Program::parse(text).unwrap();
        more.programs.insert(1, NamedProgram { path: "n".into(), program: nothing, activity: "n".into() });
        let beside = run_with(&[more]);
        assert_eq!((&beside.rows, &beside.nearness, beside.programs), (&report.rows, &report.nearness, 3));
        assert_eq!((beside.programs_without_case, beside.activities, report.programs_without_case), (1, 3, 0));
        // Programs of two parts with the same statistics are pooled to the same table.
        let [mut first, mut second] = [part.clone(), part.clone()];
        second.programs = first.programs.split_off(1);
        assert_eq!(report.rows, run_with(&[first, second]).rows);
    }
}
