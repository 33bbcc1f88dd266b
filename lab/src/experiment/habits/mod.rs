//! Measures the learning of a home: every forecast is made before its outcome is learned, over days with times.
//!
//! A case is a sentence. *object* forecasts the next thing other than the last one, which every forecast excludes; cases whose next thing is not on
//! the map are left out, as in `experiment forecast`. *object-or-same* and *room* forecast the next mentioned thing, the same or another one, and its
//! room; *room-if-changed* forecasts the room given that it changes. *room-at-...* forecasts once a minute the person's place that much later,
//! elsewhere included; its cases lie within the observed time.

use std::collections::VecDeque;

use roomcast_cli::Failure;
use serde::Serialize;

use super::baselines::Statistics;
use super::{Progress, nothing_bound};
use chains::Style;
use roomcast_core::forecast::ForecastOptions;
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::habits::{Habits, HabitsOptions, Without};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_simulation::ScoreSource;
use roomcast_simulation::trace::Trace;
use watch::Watch;

pub(crate) mod chains;
pub mod cleaning;
mod horizon;
mod places;
mod predictors;
mod report;
mod tally;
mod watch;

pub use report::{Difference, Report, Row, Sets};

/// The predictors, in the order of the table. *counts* has only the things after the last one to three things, by Kneser-Ney; *without-model* is the
/// mixture with uniform chances instead of the model.
pub const PREDICTORS: [&str; 10] = [
    "mixture",
    "model",
    "counts",
    "stay",
    "persistence",
    "markov1",
    "markov2",
    "kneser-ney-cache",
    "ppm",
    "without-model",
];
/// The targets, in the order of the table.
pub const TARGETS: [&str; 8] = [
    "object",
    "room",
    "room-if-changed",
    "room-at-60s",
    "room-at-300s",
    "room-at-900s",
    "room-at-3600s",
    "object-or-same",
];
const OBJECT: usize = 0;
const ROOM: usize = 1;
const ROOM_IF_CHANGED: usize = 2;
/// The first target with a horizon.
const ROOM_AT: usize = 3;
const OBJECT_OR_SAME: usize = 7;
/// Horizons of the targets that have one, in seconds.
pub const HORIZONS_S: [f64; 4] = [60.0, 300.0, 900.0, 3_600.0];
/// Chains, and their predictors.
const CHAINS: [(usize, Style); 5] =
    [(2, Style::KneserNey), (5, Style::Markov(1)), (6, Style::Markov(2)), (7, Style::KneserNeyCache), (8, Style::Ppm)];
/// Time from one moment to the next.
const MOMENT_S: f64 = 60.0;
/// Silence after which a new window begins, as in the daemon.
const GAP_S: f64 = 3_600.0;
/// Silence after which another activity begins.
const ACTIVITY_S: f64 = 1_800.0;
/// Mean absence in the forecast without habits, in seconds.
const OUT_S: f64 = 4.0 * 3_600.0;
/// Smaller probabilities of a baseline are raised to this.
const FLOOR: f64 = 1e-6;

#[derive(Debug, Clone)]
pub struct Options {
    pub history: HistoryLimits,
    pub binding: BindingSequence,
    pub habits: HabitsOptions,
    /// Options of the forecast without habits.
    pub forecast: ForecastOptions,
    /// Mixtures without some parts, with their names: further predictors.
    pub without: Vec<(String, Without)>,
    pub seed: u64,
}

/// A day's number, or several days.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Days {
    /// One of them, from 1.
    One(usize),
    /// All days, the second half, or the cases of all days in activities that were never done in exactly this way before.
    Some(&'static str),
}

pub const ALL: Days = Days::Some("all");
pub const HALF: Days = Days::Some("second-half");
/// The cases of all days in activities that were never done in exactly this way before.
pub const UNSEEN: Days = Days::Some("unseen-scripts");

/// Empty habits that are bound to a map.
pub fn bound(options: HabitsOptions, grounding: &Grounding) -> Habits {
    let mut habits = Habits::new(options);
    habits.bind_to(grounding);
    habits
}

/// Runs the experiment over the trace from its first day to its last.
pub fn run<M: LanguageModel>(
    trace: &Trace,
    (map, grounding): (&SemanticMap, &Grounding),
    source: &mut ScoreSource<M>,
    statistics: &Statistics,
    options: &Options,
    progress: &Progress,
) -> Result<Report, Failure> {
    // Places can be known without sentences.
    if trace.places.is_empty() && trace.steps.iter().all(|step| step.label.is_none()) {
        return Err(nothing_bound(map.name()));
    }
    let reduced = options.without.iter().map(|(name, _)| name.as_str());
    let predictors: Vec<_> = PREDICTORS.into_iter().chain(reduced).collect();
    let mut watch = Watch::new(trace, (map, grounding), statistics, options);
    let mut grounded = GroundedScores::default();
    let mut steps = trace.steps.iter().enumerate().peekable();
    // Scores of one window, up to the next long silence.
    let mut scores: VecDeque<Vec<f64>> = VecDeque::new();
    let mut now_s = f64::NEG_INFINITY;
    for (begin_s, end_s) in &trace.watched {
        watch.cleaning.begin();
        // If a day begins in the minute in which another ends, time does not go back.
        now_s = now_s.max((begin_s / MOMENT_S).floor() * MOMENT_S);
        // Sentences of a day's last minute are included; those of the next day are not.
        loop {
            let until_s = now_s.min(*end_s);
            while let Some((at, step)) = steps.next_if(|(_, step)| step.at_s <= until_s) {
                if scores.is_empty() {
                    let silent = |at: &usize| trace.steps[*at].at_s - trace.steps[at - 1].at_s > GAP_S;
                    let end = (at + 1..trace.steps.len()).find(silent).unwrap_or(trace.steps.len());
                    let sentences: Vec<_> = trace.steps[at..end].iter().map(|step| step.sentence.clone()).collect();
                    scores
                        .extend(source.score_steps(&sentences, options.history, &options.binding)?.into_iter().skip(1));
                }
                watch.tell(step.at_s);
                if let Some(scores) = scores.pop_front() {
                    watch.step(step, &scores, &mut grounded)?;
                }
                progress.step();
            }
            watch.tell(until_s);
            if now_s > *end_s {
                break;
            }
            watch.moment(now_s, *end_s);
            now_s += MOMENT_S;
        }
        watch.horizons.iter_mut().for_each(|horizon| horizon.waiting.clear());
    }
    source.flush()?;
    Ok(report::report(&watch, &predictors, options, source.computed()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::narration::{Action, Sentence};
    use roomcast_core::scorer::correction::CorrectionChoice;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{Method, Tokenisation};
    use roomcast_simulation::binding::ItemChoice;
    use roomcast_simulation::homer::{Day, TimedAction};
    use roomcast_simulation::trace::Interval;
    use roomcast_simulation::trace::Step;

    fn flat() -> (SemanticMap, Grounding) {
        let map = SemanticMap::from_json(include_str!("../../../../scenes/flat.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        (map, grounding)
    }

    fn watch(trace: &Trace, home: &(SemanticMap, Grounding), forecast: ForecastOptions) -> Report {
        try_watch(trace, home, forecast).unwrap()
    }

    fn try_watch(
        trace: &Trace,
        (map, grounding): &(SemanticMap, Grounding),
        forecast: ForecastOptions,
    ) -> Result<Report, Failure> {
        let labels = grounding.label_texts();
        let (method, tokens) = (Method::Trie, Tokenisation::Joint);
        let correction = CorrectionChoice::default();
        let mut source = ScoreSource::new(TableModel::new(1), &labels, method, tokens, correction, None).unwrap();
        let options = Options {
            history: HistoryLimits::default(),
            binding: BindingSequence::default(),
            habits: HabitsOptions::default(),
            forecast,
            without: Vec::new(),
            seed: 1,
        };
        run(trace, (map, grounding), &mut source, &Statistics::default(), &options, &Progress::hidden())
    }

    fn all<'a>(report: &'a Report, target: &str, predictor: &str) -> &'a Row {
        let row = |row: &&Row| row.day == ALL && row.target == target && row.predictor == predictor;
        report.rows.iter().find(row).unwrap()
    }

    /// A day's forecasts of places do not depend on later days, even if the next day begins within the hour. The case of its last thing waits for the
    /// next day's first thing.
    #[test]
    fn no_day_is_forecast_by_who_has_seen_later_ones() {
        let home = flat();
        let day = |number: usize| {
            let notation = ["[OPEN] <fridge> (1)", "[SIT] <bed> (1)", "[SIT] <sofa> (1)"];
            let timed = |minute| TimedAction {
                activity: "a".into(),
                action: Action::parse(notation[number % 3]).unwrap(),
                done_min: f64::from(minute),
            };
            Day { actions: (10..=1_430).step_by(40).map(timed).collect() }
        };
        let days: Vec<Day> = (0..5).map(day).collect();
        let seen = |days: &[Day]| {
            let trace = Trace::of_days(days, &home.0, &home.1, ItemChoice::First, 1).unwrap();
            let mut report = watch(&trace, &home, ForecastOptions::default());
            assert_eq!(report.days, days.len());
            assert_eq!(report.rows.iter().any(|row| row.day == HALF), days.len() > 1);
            let settled = |row: &Row| row.day == Days::One(1) || row.target.starts_with("room-at");
            report.rows.retain(|row| matches!(row.day, Days::One(day) if day < 3) && settled(row));
            report.rows
        };
        let [_, until, whole] = [1, 2, 5].map(|count| seen(&days[..count]));
        assert!(until.iter().any(|row| row.day == Days::One(2) && row.target == "room-at-3600s"));
        assert_eq!(until, whole);
    }

    /// The fridge is open from 8:00 to 8:10, and a person lies in bed from 8:05 to 8:20: at 8:10 the person is in bed.
    #[test]
    fn who_stays_is_told_what_the_others_are_told() {
        let home = flat();
        let (map, grounding) = &home;
        let mut mentions = roomcast_core::places::PlaceMatcher::new(map, grounding);
        let room_of = |name: &str| {
            let room = map.find_room(name).unwrap();
            grounding.partitions().iter().position(|p| p.rooms.contains(&room)).unwrap()
        };
        let (kitchen, bedroom) = (room_of("kitchen"), room_of("bedroom"));
        let (mut steps, mut intervals) = (Vec::new(), Vec::new());
        for day in 0..6 {
            let at = |minute: f64| f64::from(day) * roomcast_simulation::trace::DAY_S + (480.0 + minute) * 60.0;
            intervals.push(Interval { from_s: at(0.0), to_s: at(10.0), room: Some(kitchen) });
            intervals.push(Interval { from_s: at(5.0), to_s: at(20.0), room: Some(bedroom) });
            for (text, minute, room) in [
                ("They open the fridge.", 0.0, kitchen),
                ("They close the fridge.", 10.0, kitchen),
                ("They get up from the bed.", 20.0, bedroom),
            ] {
                let sentence = Sentence::new(text).unwrap();
                let label = mentions.last(text).map(|found| found.label);
                let (at_s, room) = (at(minute), Some(room));
                steps.push(Step { at_s, sentence, label, room, lacking: false, unseen: false });
            }
        }
        let trace = Trace::of_sensors(steps, &intervals, &[], grounding.partitions().len()).unwrap();
        let report = watch(&trace, &home, ForecastOptions::default());
        // At 8:00 and 8:10 the next thing is at the reported place; at 8:20, except on the last day, it is elsewhere.
        assert_eq!((all(&report, "room", "stay").n, all(&report, "room-if-changed", "stay").n), (17, 5));
        for predictor in ["stay", "persistence"] {
            let right = all(&report, "room", predictor).top1 * 17.0;
            assert!(right > 10.0, "{predictor}: {right} of 17, and staying is right in 12");
        }
        // Without habits, the next room and later rooms have the same forecast.
        let even = watch(&trace, &home, ForecastOptions { any_thing: 1.0, ..ForecastOptions::default() });
        assert_ne!(all(&even, "room", "model").nll_nats, all(&report, "room", "model").nll_nats);
    }

    /// A trace with sensors but no sentences: places are measured, things and next rooms are not.
    #[test]
    fn a_home_without_a_word_is_measured_by_its_places() {
        let home = flat();
        let interval = |hour: u8| Interval {
            from_s: 3_600.0 * f64::from(hour),
            to_s: 3_600.0 * f64::from(hour) + 600.0,
            room: Some(usize::from(hour % 2)),
        };
        let intervals: Vec<_> = (0..48).map(interval).collect();
        let rooms = home.1.partitions().len();
        let trace = Trace::of_sensors(Vec::new(), &intervals, &[], rooms).unwrap();
        let report = watch(&trace, &home, ForecastOptions::default());
        assert!(report.rows.iter().all(|row| row.target.starts_with("room-at")));
        let loss = |predictor| all(&report, "room-at-3600s", predictor).nll_nats;
        assert!(loss("mixture") < loss("stay") && report.sets.len() == 4 && !report.cleaning.is_empty());
        // Sentences without things have rooms, too.
        let step = |Interval { from_s, room, .. }: &Interval| Step {
            at_s: *from_s,
            sentence: Sentence::new("They walk.").unwrap(),
            label: None,
            room: *room,
            lacking: false,
            unseen: false,
        };
        let walks = Trace::of_sensors(intervals.iter().map(step).collect(), &intervals, &[], rooms).unwrap();
        let report = watch(&walks, &home, ForecastOptions::default());
        assert_eq!((report.cases, report.rows.iter().filter(|row| row.target == "object").count()), (47, 0));
        // Without places and things there are no cases.
        let nothing = Trace::of_sensors(vec![step(&intervals[0])], &[], &[], rooms).unwrap();
        let report = try_watch(&nothing, &home, ForecastOptions::default());
        assert!(report.unwrap_err().to_string().contains("has none of the things"));
    }

    /// The first thing of each activity is mentioned again in it, and activities begin with different things.
    #[test]
    fn the_cache_holds_an_activity_from_its_first_thing_on() {
        let home = flat();
        let labels = home.1.scored_labels().len();
        assert!(labels > 20);
        let mut steps = Vec::new();
        for activity in 0..labels - 1 {
            for (at, label) in [activity, labels - 1, activity].into_iter().enumerate() {
                let at_s = 7_200.0 * activity as f64 + 60.0 * at as f64;
                let sentence = Sentence::new("They look at it.").unwrap();
                steps.push(Step { at_s, sentence, label: Some(label), room: Some(0), lacking: false, unseen: false });
            }
        }
        let interval = Interval { from_s: 0.0, to_s: 7_200.0 * labels as f64, room: Some(0) };
        let trace = Trace::of_sensors(steps, &[interval], &[], home.1.partitions().len()).unwrap();
        let report = watch(&trace, &home, ForecastOptions::default());
        let loss = |predictor| all(&report, "object", predictor).nll_nats;
        assert!(loss("kneser-ney-cache") < loss("counts") - 0.3, "{} {}", loss("kneser-ney-cache"), loss("counts"));
    }
}
