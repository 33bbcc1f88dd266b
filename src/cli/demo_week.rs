//! `roomcast demo --days N`: some days of one home in a minute, in which the forecast improves.
//!
//! The person's days consist of the included activity programs at nearly the same hours, and of an absence on working days. The events go through the
//! daemon's own [`Engine`], with its model, its habits and a tick every minute, and through a second one that learns nothing. Once a minute both
//! forecast the person's place a quarter of an hour later, and are scored then.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_ipc::raw::PersonForecastV1;

use super::{CommandResult, Failure, count};
use crate::bar::bar;
use crate::columns::{columns, prose};
use roomcast_core::grounding::Grounding;
use roomcast_core::habits::HabitsOptions;
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Program};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_services::config::Config;
use roomcast_services::daemon::{Engine, Entry, HomeHabits, Memory, Zone};
use roomcast_services::{embedded, setup};
use roomcast_simulation::binding::ItemChoice;
use roomcast_simulation::homer::{Day, TimedAction};
use roomcast_simulation::trace::Trace;

const DAY_S: f64 = 86_400.0;
const MINUTE_S: f64 = 60.0;
/// The horizon that is scored.
const AHEAD_S: f64 = 900.0;
const PERSON: PersonId = PersonId(0);
/// The least probability in the loss, so that it stays finite.
const FLOOR: f64 = 1e-6;
const BAR_WIDTH: usize = 20;
const WEEKDAYS: [&str; 7] = ["Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday"];

/// An activity of a day: an included program, its start, the spread of the start between days, and the time per action; in minutes.
type Habit = (&'static str, f64, f64, f64);

const WORKDAY: [Habit; 3] = [
    ("p0-breakfast-and-television", 7.0 * 60.0, 10.0, 4.0),
    ("p2-long-evening", 17.5 * 60.0, 20.0, 4.5),
    ("p1-laundry-and-to-bed", 21.8 * 60.0, 15.0, 2.5),
];
const WEEKEND: [Habit; 3] = [
    ("p0-breakfast-and-television", 9.0 * 60.0, 25.0, 5.0),
    ("p2-long-evening", 16.0 * 60.0, 30.0, 6.0),
    ("p1-laundry-and-to-bed", 22.5 * 60.0, 20.0, 2.5),
];
/// On working days the person leaves this long after breakfast's last action, and returns at the evening's first.
const LEAVES_MIN: f64 = 12.0;

struct Life {
    trace: Trace,
    /// The absences.
    out: Vec<(f64, f64)>,
    rooms: usize,
}

#[derive(Debug, Clone)]
pub(super) struct Case {
    day: usize,
    /// Per place, elsewhere last: without habits, and with.
    without: Vec<f64>,
    with: Vec<f64>,
    /// The places of the set; `None` while there are no sets.
    set: Option<Vec<bool>>,
    learned: f64,
    truth: usize,
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Figures {
    cases: f64,
    /// Loss in nats, and share of cases in which the likeliest place was right: without habits, and with.
    without: [f64; 2],
    with: [f64; 2],
    /// Share of the forecast that was learned.
    learned: f64,
    /// Number of sets, share of them that held the person, and mean size.
    sets: f64,
    held: f64,
    size: f64,
}

impl Figures {
    fn of<'a>(cases: impl IntoIterator<Item = &'a Case>) -> Self {
        let mut sums = Self::default();
        for case in cases {
            sums.cases += 1.0;
            for (sums, p) in [(&mut sums.without, &case.without), (&mut sums.with, &case.with)] {
                let likeliest = (0..p.len()).max_by(|a, b| p[*a].total_cmp(&p[*b]));
                sums[0] -= p[case.truth].max(FLOOR).ln();
                sums[1] += f64::from(u8::from(likeliest == Some(case.truth)));
            }
            sums.learned += case.learned;
            if let Some(set) = &case.set {
                sums.sets += 1.0;
                sums.held += f64::from(u8::from(set[case.truth]));
                sums.size += set.iter().filter(|held| **held).count() as f64;
            }
        }
        let cases = sums.cases.max(1.0);
        for sum in sums.without.iter_mut().chain(&mut sums.with).chain([&mut sums.learned]) {
            *sum /= cases;
        }
        (sums.held, sums.size) = (sums.held / sums.sets.max(1.0), sums.size / sums.sets.max(1.0));
        sums
    }
}

fn failed(error: impl std::fmt::Display) -> Failure {
    Failure::failed(error.to_string())
}

impl Life {
    fn new(days: usize, map: &SemanticMap, grounding: &Grounding, seed: u64) -> Result<Self, Failure> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut of_days = Vec::new();
        let mut edges = Vec::new();
        for day in 0..days {
            let works = day % 7 < 5;
            let mut actions = Vec::new();
            for (index, (name, begins_min, differs_min, action_min)) in
                (if works { WORKDAY } else { WEEKEND }).into_iter().enumerate()
            {
                let text = embedded::program(name).ok_or_else(|| failed(format!("no program {name}")))?;
                let program = Program::parse(text.text).map_err(failed)?;
                let mut at_min = begins_min + differs_min * rng.random_range(-1.0..1.0);
                if works && index == 1 {
                    edges.push(day as f64 * DAY_S + MINUTE_S * (at_min - 1.0));
                }
                for action in program.steps {
                    at_min += action_min * rng.random_range(0.5..1.5);
                    actions.push(TimedAction { activity: name.to_owned(), action, done_min: at_min });
                }
                if works && index == 0 {
                    edges.push(day as f64 * DAY_S + MINUTE_S * (at_min + LEAVES_MIN));
                }
            }
            of_days.push(Day { actions });
        }
        let trace = Trace::of_days(&of_days, map, grounding, ItemChoice::Nearest, seed).map_err(failed)?;
        // The trace begins on its first Monday.
        let begins_s = trace.steps.first().map_or(0.0, |step| (step.at_s / DAY_S).floor() * DAY_S);
        let out = edges.chunks_exact(2).map(|edge| (begins_s + edge[0], begins_s + edge[1])).collect();
        Ok(Self { trace, out, rooms: grounding.partitions().len() })
    }

    /// The person's place; elsewhere is the last one.
    fn truth(&self, at_s: f64) -> Option<usize> {
        if self.out.iter().any(|(from_s, to_s)| *from_s <= at_s && at_s < *to_s) {
            return Some(self.rooms);
        }
        self.trace.place_at(at_s).map(|(_, place)| place)
    }

    fn said(&self) -> Vec<(f64, Event)> {
        let sentences = self.trace.steps.iter().map(|step| (step.at_s, Event::Did(step.sentence.clone())));
        let leaves = self.out.iter().map(|(from_s, _)| (*from_s, Event::Away));
        let mut said: Vec<_> = sentences.chain(leaves).collect();
        said.sort_by(|a, b| a.0.total_cmp(&b.0));
        said
    }
}

struct Watcher<M>(Engine<M>);

impl<M: LanguageModel> Watcher<M> {
    fn hears(&mut self, sequence: u64, (at_s, event): &(f64, Event)) -> Result<(), Failure> {
        let at_ns = (at_s * 1e9) as u64;
        let observation = Observation {
            person: PERSON,
            observed_ns: BootNs(at_ns),
            observed_unix_ns: UnixNs(at_ns),
            source: 1,
            epoch: 1,
            ..Observation::saying(sequence, event.clone())
        };
        self.0.step([Entry::new(observation, BootNs(at_ns))], BootNs(at_ns), UnixNs(at_ns)).map_err(failed)?;
        self.0.tell_outcomes(|_| {});
        while self.0.tidy() {}
        Ok(())
    }

    /// The forecast per place, with the message itself.
    fn looks_ahead(&mut self, now_s: f64, rooms: usize) -> Option<(Vec<f64>, usize, &PersonForecastV1)> {
        let now_ns = (now_s * 1e9) as u64;
        self.0.tick(BootNs(now_ns), UnixNs(now_ns));
        self.0.person_scores(BootNs(now_ns));
        let message = self.0.person_forecasts(BootNs(now_ns));
        let horizon = message.horizons_s().iter().position(|horizon_s| f64::from(*horizon_s) == AHEAD_S)?;
        let own = message.persons().iter().find(|own| own.person == PERSON.0)?;
        let p = own.probability[..rooms].iter().map(|row| f64::from(row[horizon]));
        Some((p.chain([f64::from(own.elsewhere[horizon])]).collect(), horizon, own))
    }
}

/// Feeds both engines; reports every day's cases at its end.
fn watch<M: LanguageModel>(
    life: &Life,
    with: Engine<M>,
    without: Engine<M>,
    mut day_is_over: impl FnMut(usize, &[Case]) -> CommandResult,
) -> CommandResult {
    let (mut with, mut without) = (Watcher(with), Watcher(without));
    let said = life.said();
    let (Some((first_s, _)), Some((last_s, _))) = (said.first(), said.last()) else { return Ok(()) };
    let begins_s = (first_s / DAY_S).floor() * DAY_S;
    let day_of = |at_s: f64| ((at_s - begins_s) / DAY_S) as usize;
    let (mut waiting, mut over): (VecDeque<(f64, Case)>, Vec<Case>) = Default::default();
    let (mut next, mut now_s) = (0, first_s + MINUTE_S);
    while now_s <= *last_s {
        while let Some(observed) = said.get(next).filter(|(at_s, _)| *at_s <= now_s) {
            next += 1;
            with.hears(next as u64, observed)?;
            without.hears(next as u64, observed)?;
        }
        while waiting.front().is_some_and(|(due_s, _)| *due_s <= now_s) {
            let Some(((_, mut case), truth)) = waiting.pop_front().zip(life.truth(now_s)) else { break };
            if over.last().is_some_and(|last| last.day != case.day) {
                day_is_over(over[0].day, &std::mem::take(&mut over))?;
            }
            case.truth = truth;
            over.push(case);
        }
        let plain = without.looks_ahead(now_s, life.rooms).map(|(p, ..)| p);
        if let (Some(plain), Some((p, horizon, own))) = (plain, with.looks_ahead(now_s, life.rooms)) {
            let places = (0..life.rooms).map(|room| own.set_holds(horizon, room));
            let set = places.chain([own.set_holds_elsewhere(horizon)]).collect();
            let learned = f64::from(own.learned_share[1]);
            let case = Case { day: day_of(now_s), without: plain, with: p, set, learned, truth: 0 };
            waiting.push_back((now_s + AHEAD_S, case));
        }
        now_s += MINUTE_S;
    }
    if over.is_empty() { Ok(()) } else { day_is_over(over[0].day, &over) }
}

pub(super) fn run(config: &Config, days: usize, seed: u64) -> CommandResult {
    let engine = |learn: bool| {
        let (pipeline, map) = setup::open(config)?;
        let engine = Engine::new(pipeline, map, config.grounding, 1).map_err(failed)?;
        let options = HabitsOptions { learn, ..config.habits.options() };
        Ok::<_, Failure>(engine.with_habits(HomeHabits::new(Memory::new(options), Zone::UTC)))
    };
    let (with, without) = (engine(true)?, engine(false)?);
    let life = Life::new(days, with.map(), with.pipeline().grounding(), seed)?;
    let is_wide = columns() >= WIDE;
    let text = format!(
        "One person in {} for {}: {} observations. Each minute the daemon forecasts the room in 15 minutes, without habits and with the habits that \
         it has learned by then. \"Right\" is the share of minutes in which the likeliest room was right. The loss is smaller when a right room \
         had a high probability. The room set should hold the person in 90 % of the minutes.",
        with.map().name(),
        count(days, "day"),
        life.said().len()
    );
    super::print(&format!("{}\n\n{}\n", prose(&text), heading(is_wide)))?;
    let (mut all, mut by_day) = (Vec::new(), Vec::new());
    watch(&life, with, without, |day, cases| {
        all.extend_from_slice(cases);
        let figures = Figures::of(cases);
        by_day.push((WEEKDAYS[day % 7], figures));
        super::print(&line(WEEKDAYS[day % 7], &figures, is_wide))
    })?;
    super::print(&format!("{}\n{}", line("all days", &Figures::of(&all), is_wide), chart(&by_day)))
}

/// Wrong forecasts of each day, without habits and with.
fn chart(days: &[(&str, Figures)]) -> String {
    const CELLS: usize = 40;
    let wrong = |of: [f64; 2]| 1.0 - of[1];
    let most = days.iter().flat_map(|(_, own)| [wrong(own.without), wrong(own.with)]).fold(0.01, f64::max);
    let mut text = "Wrong forecasts, without habits (░) and with (█):\n\n".to_owned();
    for (name, own) in days {
        let cells = (wrong(own.without) / most * CELLS as f64).round() as usize;
        let without = format!("{} {:.0} %", "░".repeat(cells), 100.0 * wrong(own.without));
        let with = format!("{} {:.0} %", bar(wrong(own.with) / most, CELLS), 100.0 * wrong(own.with));
        text += &format!("{name:<10} {without}\n{:<10} {with}\n", "");
    }
    text
}

/// The width of the table with the bars.
const WIDE: usize = 113;
/// The least width of a terminal for the table without them.
#[cfg(test)]
const NARROW: usize = 60;

fn heading(is_wide: bool) -> String {
    if is_wide {
        return format!(
            "{:<10} | without: loss  right | with: loss  right | {:<BAR_WIDTH$} learned | room set: rooms  right",
            "", "right, with habits"
        );
    }
    format!(
        "{:<9}  {:<12}  {:<12}  {:7}  room set\n{:<9}  {:>5} {:>6}  {:>5} {:>6}  learned  {:>4} {:>6}",
        "", "without", "with", "", "", "loss", "right", "loss", "right", "size", "right"
    )
}

fn line(name: &str, figures: &Figures, is_wide: bool) -> String {
    let Figures { without, with, learned, sets, held, size, .. } = figures;
    if !is_wide {
        let sets = if *sets > 0.0 { format!("{size:>4.1} {:>4.0} %", 100.0 * held) } else { "none yet".to_owned() };
        return format!(
            "{name:<9}  {:>5.2} {:>4.0} %  {:>5.2} {:>4.0} %  {:>5.0} %  {sets:>11}\n",
            without[0],
            100.0 * without[1],
            with[0],
            100.0 * with[1],
            100.0 * learned
        );
    }
    let sets = if *sets > 0.0 { format!("{size:.1}  {:.0} %", 100.0 * held) } else { "none yet".to_owned() };
    format!(
        "{name:<10} | {:>9.2} nats {:>4.0} % | {:>5.2} nats {:>4.0} % | {:<BAR_WIDTH$} {:>5.0} % | {sets:>17}\n",
        without[0],
        100.0 * without[1],
        with[0],
        100.0 * with[1],
        bar(with[1], BAR_WIDTH),
        100.0 * learned
    )
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::pipeline::{Pipeline, PipelineOptions};
    use roomcast_core::scorer::table::TableModel;

    use super::*;

    fn engine(learn: bool) -> Engine<TableModel> {
        let map = setup::load_map(Some("apartment-e0".as_ref())).unwrap();
        let options = GroundingOptions::default();
        let grounding = Grounding::new(&map, &options).unwrap();
        let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
        let habits = HabitsOptions { learn, ..HabitsOptions::default() };
        let engine = Engine::new(pipeline, map, options, 1).unwrap();
        engine.with_habits(HomeHabits::new(Memory::new(habits), Zone::UTC))
    }

    /// The daily figures must follow from the minutes, and the week must show progress.
    #[test]
    fn a_week_makes_the_forecast_good() {
        let (with, without) = (engine(true), engine(false));
        let life = Life::new(7, with.map(), with.pipeline().grounding(), 3).unwrap();
        assert_eq!(life.out.len(), 5);
        let mut days = Vec::new();
        watch(&life, with, without, |day, cases| {
            assert!(cases.iter().all(|case| case.day == day));
            days.push((day, cases.to_vec()));
            Ok(())
        })
        .unwrap();
        assert_eq!(days.iter().map(|(day, _)| *day).collect::<Vec<_>>(), (0..7).collect::<Vec<_>>());
        for (_, cases) in &days {
            let figures = Figures::of(cases);
            // The same figures, computed again from the cases.
            let n = cases.len() as f64;
            let loss = cases.iter().map(|case| -case.with[case.truth].max(1e-6).ln()).sum::<f64>() / n;
            let right = |p: &[f64], truth: usize| p.iter().all(|other| *other <= p[truth]);
            let hits = cases.iter().filter(|case| right(&case.with, case.truth)).count() as f64 / n;
            assert!((figures.with[0] - loss).abs() < 1e-9 && (figures.with[1] - hits).abs() < 2e-2, "{figures:?}");
            assert!(cases.iter().all(|case| (case.with.iter().sum::<f64>() - 1.0).abs() < 1e-4));
            assert!(line("Monday", &figures, true).contains(&format!("{:.2} nats", figures.with[0])));
            for (is_wide, most) in [(true, WIDE), (false, NARROW)] {
                let table = heading(is_wide) + "\n" + &line("Wednesday", &figures, is_wide);
                let widths = table.lines().map(|line| line.chars().count());
                assert!(widths.max() <= Some(most), "{table}");
            }
        }
        let of = |day: usize| Figures::of(&days[day].1);
        let (first, last, plain) = (of(0).with, of(4).with, of(4).without);
        assert!(last[0] < first[0] && last[0] < 0.7 * plain[0], "{first:?} {last:?} {plain:?}");
        let all: Vec<Case> = days.iter().skip(1).flat_map(|(_, cases)| cases.clone()).collect();
        let sets = Figures::of(&all);
        assert!(sets.held > 0.85 && sets.size < 3.0, "{sets:?}");
    }
}
