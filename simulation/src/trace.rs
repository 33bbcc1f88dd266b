//! The events of a home, with times: from days of activities, or from a sensor log.

use std::collections::HashSet;

use roomcast_core::grounding::Grounding;
use roomcast_core::narration::Sentence;
use roomcast_core::semantic_map::SemanticMap;

use crate::StudyError;
use crate::binding::{Binder, ItemChoice};
use crate::homer::Day;

/// Seconds of a day.
pub const DAY_S: f64 = 86_400.0;
/// The longest watched time, in days: every minute of it has a forecast. A wrong year in a log would make it decades.
pub const DAYS_MAX: usize = 1_100;

/// One event.
#[derive(Debug, Clone, PartialEq)]
pub struct Step {
    /// The time of the event, in seconds since 1970, local time.
    pub at_s: f64,
    /// The sentence.
    pub sentence: Sentence,
    /// The label in the sentence, as an index of [`Grounding::scored_labels`].
    pub label: Option<usize>,
    /// The room of that label.
    pub room: Option<usize>,
    /// Whether the map lacks the thing.
    pub lacking: bool,
    /// Whether the activity was never done in exactly this way before.
    pub unseen: bool,
}

/// A stay in a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// The start, in seconds since 1970, local time.
    pub from_s: f64,
    /// The end; not before the start.
    pub to_s: f64,
    /// A room of the map; `None` for elsewhere.
    pub room: Option<usize>,
}

/// All events and places of a person.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trace {
    /// The events, by time.
    pub steps: Vec<Step>,
    /// The start of each stay, and the place; elsewhere is the number after the last room.
    pub places: Vec<(f64, usize)>,
    /// The times when the home was watched, in order and without overlap.
    pub watched: Vec<(f64, f64)>,
    /// The start of each day, in order: of each given day, or of each calendar day.
    days: Vec<f64>,
}

impl Trace {
    /// Days of activities, one after the other. An object with the number of an item of the map is that item. Others are bound as `items`
    /// says, the same for all days. The person is in the room of the last thing until the next one.
    ///
    /// # Errors
    /// When an action makes no sentence, or there are more than [`DAYS_MAX`] days.
    pub fn of_days(
        days: &[Day],
        map: &SemanticMap,
        grounding: &Grounding,
        items: ItemChoice,
        seed: u64,
    ) -> Result<Self, StudyError> {
        if days.len() > DAYS_MAX {
            return Err(StudyError::TooManyDays { days: days.len() });
        }
        let mut binder = Binder::new(map, grounding, items);
        binder.begin(seed, "home");
        let mut trace = Self::default();
        let mut at_m = [0.0; 3];
        let mut scripts: HashSet<String> = HashSet::new();
        // A Monday.
        let first_s = 4.0 * DAY_S;
        for (number, day) in days.iter().enumerate() {
            let begin_s = first_s + number as f64 * DAY_S;
            let mut span: Option<(f64, f64)> = None;
            let mut unseen = Vec::with_capacity(day.actions.len());
            for activity in day.actions.chunk_by(|one, next| one.activity == next.activity) {
                let script = activity.iter().map(|timed| timed.action.to_string()).collect::<Vec<_>>().join(" ");
                let new = scripts.insert(script);
                unseen.extend(activity.iter().map(|_| new));
            }
            for (timed, unseen) in day.actions.iter().zip(unseen) {
                // A day may end after the next one has begun, but times must not decrease. Simultaneous events get the smallest possible
                // difference: an event does not reveal the next place before its own time.
                let at_s =
                    (begin_s + 60.0 * timed.done_min).max(trace.steps.last().map_or(0.0, |step| step.at_s.next_up()));
                let place = timed.action.objects().first().and_then(|object| {
                    let place = binder.bind(object, at_m)?;
                    let suffix = format!("-{}", object.id);
                    let own = map.items().iter().position(|item| {
                        item.id.ends_with(&suffix)
                            && place.label.is_some_and(|label| {
                                grounding.scored_labels()[label]
                                    .items
                                    .iter()
                                    .any(|id| map.items()[id.0 as usize].id == item.id)
                            })
                    });
                    let partition = own.map_or(place.partition, |item| grounding.item_partition()[item]);
                    let position_m = own.map_or(place.position_m, |item| map.items()[item].position_m);
                    Some((place.label, partition.map(|p| p.0 as usize), position_m))
                });
                let room = place.and_then(|(_, room, _)| room);
                if let Some((_, _, position_m)) = place {
                    at_m = position_m;
                }
                let sentence = Sentence::new(&timed.action.sentence())?;
                let label = place.and_then(|(label, ..)| label);
                let lacking = label.is_none() && !timed.action.objects().is_empty();
                trace.steps.push(Step { at_s, sentence, label, room, lacking, unseen });
                if let Some(room) = room
                    && trace.places.last().is_none_or(|(_, last)| *last != room)
                {
                    trace.places.push((at_s, room));
                }
                span = Some((span.map_or(at_s, |(from_s, _)| from_s), at_s));
            }
            // A day that continues after midnight is one day.
            trace.days.extend(span.map(|(from_s, _)| from_s));
            trace.watched.extend(span);
        }
        Ok(trace)
    }

    /// A sensor log: its sentences, and a person's places by its intervals. At each moment the person is in the room of the interval that
    /// covers it (of several, the one that began last), else elsewhere if `away` covers it, else in the room of the last interval that
    /// began. The home is watched from the first sentence or interval to the last; absences before and after that do not count.
    ///
    /// # Errors When it lasts longer than [`DAYS_MAX`].
    pub fn of_sensors(
        mut steps: Vec<Step>,
        intervals: &[Interval],
        away: &[(f64, f64)],
        rooms: usize,
    ) -> Result<Self, StudyError> {
        steps.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        let mut edges: Vec<f64> = intervals.iter().flat_map(|i| [i.from_s, i.to_s]).collect();
        let times = || steps.iter().map(|step| step.at_s).chain(edges.iter().copied());
        let (begin_s, end_s) = (times().fold(f64::INFINITY, f64::min), times().fold(f64::NEG_INFINITY, f64::max));
        let midnight_s = (begin_s / DAY_S).floor() * DAY_S;
        let days = (((end_s - midnight_s) / DAY_S).max(0.0) as usize).saturating_add(1);
        if days > DAYS_MAX {
            return Err(StudyError::LongLog { from: date(begin_s), to: date(end_s) });
        }
        let away: Vec<(f64, f64)> = away
            .iter()
            .map(|(from_s, to_s)| (from_s.max(begin_s), to_s.min(end_s)))
            .filter(|(from_s, to_s)| from_s < to_s)
            .collect();
        edges.extend(away.iter().flat_map(|(from_s, to_s)| [*from_s, *to_s]));
        edges.sort_by(f64::total_cmp);
        edges.dedup();
        let mut sorted: Vec<Interval> = intervals.iter().copied().filter(|i| i.room.is_some()).collect();
        sorted.sort_by(|a, b| a.from_s.total_cmp(&b.from_s));
        let mut places: Vec<(f64, usize)> = Vec::new();
        let (mut begun, mut open): (usize, Vec<Interval>) = (0, Vec::new());
        for edge_s in &edges {
            while let Some(next) = sorted.get(begun).filter(|next| next.from_s <= *edge_s) {
                open.push(*next);
                begun += 1;
            }
            open.retain(|interval| interval.to_s > *edge_s);
            let out = away.iter().any(|(from_s, to_s)| from_s <= edge_s && edge_s < to_s);
            let covering = open.last().and_then(|interval| interval.room);
            let last = begun.checked_sub(1).and_then(|last| sorted[last].room);
            let Some(place) = covering.or(if out { Some(rooms) } else { last }) else { continue };
            if places.last().is_none_or(|(_, before)| *before != place) {
                places.push((*edge_s, place));
            }
        }
        let watched = if begin_s < end_s { vec![(begin_s, end_s)] } else { Vec::new() };
        let days = (0..days).map(|day| midnight_s + day as f64 * DAY_S).collect();
        Ok(Self { steps, places, watched, days })
    }

    /// The person's place at a moment, and the start of the stay: a room of the map, or elsewhere after the last one.
    #[must_use]
    pub fn place_at(&self, at_s: f64) -> Option<(f64, usize)> {
        let after = self.places.partition_point(|(from_s, _)| *from_s <= at_s);
        after.checked_sub(1).map(|at| self.places[at])
    }

    /// The person's time in a place between two moments, in seconds.
    pub fn time_in(&self, place: usize, from_s: f64, to_s: f64) -> f64 {
        let first = self.places.partition_point(|(at_s, _)| *at_s <= from_s).saturating_sub(1);
        let stays = self.places[first..].iter().take_while(|(at_s, _)| *at_s < to_s).enumerate();
        let time_s = |(index, (at_s, own)): (usize, &(f64, usize))| {
            let ends_s = self.places.get(first + index + 1).map_or(to_s, |(next_s, _)| next_s.min(to_s));
            if *own == place { (ends_s - at_s.max(from_s)).max(0.0) } else { 0.0 }
        };
        stays.map(time_s).sum()
    }

    /// The day of a moment, from 0.
    pub fn day(&self, at_s: f64) -> usize {
        self.days.partition_point(|begin_s| *begin_s <= at_s).saturating_sub(1)
    }
}

fn date(at_s: f64) -> String {
    match tz::UtcDateTime::from_timespec(at_s.floor() as i64, 0) {
        Ok(time) => format!("{}-{:02}-{:02}", time.year(), time.month(), time.month_day()),
        Err(_) => format!("second {at_s:.0} since 1970"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::homer::TimedAction;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::narration::Action;

    #[test]
    fn the_covering_interval_counts_then_the_last_one_then_the_absence() {
        let interval = |from_s, to_s, room| Interval { from_s, to_s, room: Some(room) };
        let intervals =
            [interval(0.0, 100.0, 0), interval(20.0, 30.0, 1), interval(150.0, 160.0, 1), interval(900.0, 901.0, 2)];
        let trace = Trace::of_sensors(Vec::new(), &intervals, &[(200.0, 800.0)], 3).unwrap();
        let place = |at_s| trace.place_at(at_s).map(|(_, place)| place);
        assert_eq!(
            [0.0, 25.0, 50.0, 140.0, 170.0, 500.0, 850.0, 950.0].map(place),
            [Some(0), Some(1), Some(0), Some(1), Some(1), Some(3), Some(1), Some(2)]
        );
        assert_eq!(place(-1.0), None);
        let in_kitchen = |from_s, to_s| trace.time_in(0, from_s, to_s);
        assert_eq!([in_kitchen(0.0, 60.0), in_kitchen(25.0, 40.0), in_kitchen(110.0, 300.0)], [50.0, 10.0, 0.0]);
        assert_eq!((trace.time_in(3, 100.0, 1_000.0), trace.time_in(2, 2_000.0, 2_010.0)), (600.0, 10.0));
    }

    /// Absences in weeks before and after the log are not correct forecasts.
    #[test]
    fn a_home_is_watched_as_long_as_its_log_lasts() {
        let intervals = [Interval { from_s: 1_000.0, to_s: 4_600.0, room: Some(0) }];
        let trace = Trace::of_sensors(Vec::new(), &intervals, &[(-9e6, 9e6), (4_700.0, 9e5)], 2).unwrap();
        assert_eq!((trace.watched.as_slice(), trace.days.len()), (&[(1_000.0, 4_600.0)][..], 1));
        let of_years = |to_s| Trace::of_sensors(Vec::new(), &[Interval { to_s, ..intervals[0] }], &[], 2);
        assert!(of_years(DAY_S * (DAYS_MAX as f64 - 0.5)).is_ok());
        for to_s in [DAY_S * (DAYS_MAX as f64 + 0.5), 1e300] {
            let fault = of_years(to_s).unwrap_err().to_string();
            assert!(fault.contains("1970-01-01"), "{fault}");
        }
        assert_eq!([0.0, 951_782_400.0, 1_709_251_199.0].map(date), ["1970-01-01", "2000-02-29", "2024-02-29"]);
    }

    #[test]
    fn a_day_is_a_file_however_late_it_ends() {
        let map = SemanticMap::from_json(include_str!("../../scenes/flat.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let timed = |notation: &str, done_min| TimedAction {
            activity: "a".into(),
            action: Action::parse(notation).unwrap(),
            done_min,
        };
        let day = Day {
            actions: vec![
                timed("[OPEN] <fridge> (1)", 480.0),
                timed("[SIT] <bed> (1)", 1_500.0),
                // The same time, another room.
                timed("[OPEN] <fridge> (1)", 1_500.0),
            ],
        };
        let trace = Trace::of_days(&[day.clone(), day], &map, &grounding, ItemChoice::First, 1).unwrap();
        assert_eq!(trace.steps.iter().map(|step| trace.day(step.at_s)).collect::<Vec<_>>(), [0, 0, 0, 1, 1, 1]);
        for step in &trace.steps {
            assert_eq!(trace.place_at(step.at_s).map(|(_, room)| room), step.room, "told before it is said");
        }
    }
}
