//! The next thing and the next room: whether it is the same as the last one, and which other one comes if not.
//!
//! Both questions have their own mixture, because an expert can be better at one of them. A thing that is mentioned again and again is one thing of
//! the context, and so are sentences about nothing that the map has. An outcome is counted in the context that was known at the forecast.

use super::Shares;
use super::context::Fact::{Five0, Five1, Five2, Four0, Four1, Four2, Here, Hours3, Last, Pace, Second, Spent, Third};
use super::context::{Context, Level, NONE, Without, key, level};
use super::pool::Begin::{After, Given};
use super::pool::Source::{Habit, Hour, Model, Things};
use super::pool::{Plan, Pool, expert};
use super::view::{Learner, View, add, normalise};

pub(crate) const SHARE: f64 = 0.005;
/// Smaller probabilities of things and of rooms are raised to these.
const FLOORS: [f64; 2] = [1e-6, 1e-4];
/// Symbols of repeated mentions.
const OTHER: u16 = 0;
const SAME: u16 = 1;
/// Less likely things use the map's rooms: the look-up costs more than it could change.
const UNLIKELY: f64 = 1e-3;
/// Observations that the map's rooms of a thing are worth.
const MAP_STRENGTH: f64 = 1.0;

/// The rooms of a thing in earlier turns.
pub(crate) static OF_THING: Level = level(13, "room-of-thing", &[Last], [0.0, MAP_STRENGTH]);

/// Another thing, after the last things and at this part of the day.
pub(crate) static THINGS: Plan = Plan {
    experts: &[
        expert(0, "", [0.15, 0.65], Model, Given),
        expert(40, "thing-habit", [0.08, 0.3], Habit, After(0, 0)).over(&[
            level(1, "thing-after-0", &[], [0.3, 4.0]),
            level(2, "thing-after-1", &[Last], [0.3, 2.0]),
            level(3, "thing-after-2", &[Last, Second], [0.3, 1.0]),
            level(4, "thing-after-3", &[Last, Second, Third], [0.3, 0.5]),
            level(5, "thing-after-4", &[Four0, Four1, Four2], [0.3, 0.25]),
            level(6, "thing-after-5", &[Five0, Five1, Five2], [0.3, 0.25]),
        ]),
        expert(41, "thing-hour", [0.06, 0.1], Hour, After(1, 2)).over(&[
            level(11, "thing-at-hour", &[Hours3], [0.5, 20.0]),
            level(12, "thing-after-1-at-hour", &[Last, Hours3], [0.5, 1.0]),
        ]),
    ],
    product: Some(expert(42, "thing-product", [0.71, 0.0], Model, Given)),
    even: 0.0,
};

/// The same thing again: how often any thing is mentioned again, and how often the last one was mentioned so often after the same things.
pub(crate) static AGAIN: Plan = Plan {
    experts: &[
        expert(0, "", [0.5, 0.0], Model, Given),
        expert(43, "again-habit", [0.3, 0.0], Habit, Given).over(&[
            level(7, "again-after-0", &[], [0.0, 2.0]).by_times(),
            level(8, "again-after-1", &[Last], [0.0, 1.0]).by_times(),
            level(9, "again-after-2", &[Last, Second], [0.0, 0.7]).by_times(),
            level(10, "again-after-3", &[Last, Second, Third], [0.0, 0.5]).by_times(),
        ]),
        expert(44, "again-share", [0.2, 0.0], Habit, Given),
    ],
    product: None,
    even: 0.0,
};
const BY_HABIT: usize = 1;
const BY_SHARE: usize = 2;

/// The same room or another one: after this room and the last things, by the rooms of the next thing, at this part of the day, and by the time spent
/// and the pace of events.
pub(crate) static ROOMS: Plan = Plan {
    experts: &[
        expert(0, "", [0.1, 0.15], Model, Given),
        expert(45, "room-habit", [0.06, 0.3], Habit, After(0, 0)).over(&[
            level(14, "room-after-room", &[Here], [0.5, 4.0]),
            level(15, "room-after-1", &[Last], [0.5, 2.0]).by_times(),
            level(16, "room-after-2", &[Last, Second], [0.5, 0.5]).by_times(),
            level(17, "room-after-3", &[Last, Second, Third], [0.5, 0.5]).by_times(),
        ]),
        expert(46, "room-short", [0.06, 0.15], Habit, After(1, 2)),
        expert(47, "room-things", [0.06, 0.1], Things, Given),
        expert(48, "room-hour", [0.06, 0.15], Hour, After(1, 2)).over(&[level(
            18,
            "room-by-hour",
            &[Here, Hours3],
            [0.5, 2.0],
        )]),
        expert(49, "room-dwell", [0.06, 0.1], Habit, After(1, 1)).over(&[level(
            31,
            "room-by-dwell",
            &[Here, Spent, Pace],
            [0.5, 2.0],
        )]),
    ],
    product: Some(expert(50, "room-product", [0.6, 0.0], Model, Given)),
    even: 0.05,
};
const BY_THINGS: usize = 3;

/// The model's first weight for the same thing again, another thing, the same room and another room. With a high one for things, a first day with few
/// things is no worse than the model alone.
pub(crate) const FIRST: [[f64; 2]; 2] = [[0.5, 0.9], [0.4, 0.8]];

/// A forecast of the next thing or of the next room.
#[derive(Debug, Clone)]
pub(crate) struct Next {
    pub(crate) same: Pool,
    pub(crate) other: Pool,
    here: Option<usize>,
    /// The probabilities of the latest forecast.
    pub(crate) mixed: Vec<f64>,
}

impl Next {
    /// `plans` are of the same thing or room again, and of another one.
    pub(crate) fn new(plans: [&'static Plan; 2], [same, other]: [f64; 2], without: Without) -> Self {
        let (same, other) = (Pool::new(plans[0], same, without), Pool::new(plans[1], other, without));
        Self { same, other, here: None, mixed: Vec::new() }
    }

    /// Drops the latest forecast. It teaches no more.
    pub(crate) fn forget_forecast(&mut self) {
        self.other.forget();
        self.mixed.clear();
    }

    /// Forecasts the next thing. The model's probabilities need not sum to one. `repeated` has the repeated mentions and all mentions.
    pub(crate) fn things(&mut self, view: &View<'_>, context: &Context, repeated: [f64; 2], model: &[f64]) {
        let (width, last) = (model.len(), context.get(Last));
        self.here = view.home.things.index(last).filter(|thing| *thing < width);
        self.other.begin(width, self.here);
        let own = self.other.row_mut(0);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOORS[0]));
        let total: f64 = own.iter().sum();
        let again = self.here.map_or(0.0, |same| std::mem::take(&mut own[same]) / total);
        let others: f64 = own.iter().sum();
        own.iter_mut().for_each(|own| *own /= others.max(f64::MIN_POSITIVE));
        self.other.smooth(view, context, |number| if number == last { None } else { view.home.things.index(number) });
        if self.here.is_some() {
            self.same.begin(2, None);
            let share = repeated[0] / repeated[1];
            for (row, p) in [(0, again), (BY_HABIT, share), (BY_SHARE, share)] {
                let p = p.clamp(FLOORS[0], 1.0 - FLOORS[0]);
                self.same.row_mut(row).copy_from_slice(&[p, 1.0 - p]);
            }
            self.same.smooth(view, context, |symbol| Some(usize::from(symbol != SAME)));
        }
        self.mix();
    }

    /// Forecasts the next room from the model's probabilities and the expected next things.
    pub(crate) fn rooms(&mut self, view: &View<'_>, context: &Context, model: &[f64], things: &[f64]) {
        let index = |number| view.home.room(number).filter(|room| *room < model.len());
        self.here = view.home.room(context.get(Here)).filter(|room| *room < model.len());
        self.other.begin(model.len(), self.here);
        let own = self.other.row_mut(0);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOORS[1]));
        normalise(own);
        rooms_of(view, things, index, self.other.row_mut(BY_THINGS));
        self.other.smooth(view, context, index);
        if let Some(here) = self.here {
            self.same.begin(2, None);
            self.same.kept.copy_from_slice(&self.other.kept);
            for row in 0..ROOMS.experts.len() {
                let others = self.other.row_mut(row);
                let stay = std::mem::take(&mut others[here]);
                others.iter_mut().for_each(|p| *p /= (1.0 - stay).max(1e-9));
                self.same.row_mut(row).copy_from_slice(&[stay, 1.0 - stay]);
            }
        }
        self.mix();
    }

    fn mix(&mut self) {
        self.other.forecast();
        self.mixed.clear();
        self.mixed.extend(&self.other.mixed);
        let Some(here) = self.here else { return self.same.forget() };
        let is_only = self.mixed.iter().all(|p| *p <= 0.0);
        self.same.forecast();
        let same = if is_only { 1.0 } else { self.same.mixed[0] };
        self.mixed.iter_mut().for_each(|p| *p *= 1.0 - same);
        self.mixed[here] = same;
        if is_only {
            self.same.forget();
        }
    }

    /// The shares of the sources in an outcome's probability in the latest forecast.
    pub(crate) fn explain(&self, outcome: usize) -> Option<Shares> {
        let probability = self.mixed.get(outcome).copied().filter(|p| *p > 0.0)?;
        let [model, habit, things, hour] = match self.here == Some(outcome) {
            false => self.other.explain(outcome),
            true if self.same.width() == 0 => [1.0, 0.0, 0.0, 0.0],
            true => self.same.explain(0),
        };
        Some(Shares { probability, model, habit, things: Some(things), hour, observations: self.other.observations })
    }

    /// Learns from an outcome. Returns whether it was the same as the last one, if that was asked.
    pub(crate) fn learn_weights(&mut self, outcome: usize) -> Option<bool> {
        let is_same = self.here == Some(outcome);
        if outcome < self.other.width() && !is_same {
            self.other.learn(outcome, SHARE);
        }
        (outcome < self.other.width() && self.same.width() > 0).then(|| {
            self.same.learn(usize::from(!is_same), SHARE);
            is_same
        })
    }

    /// Counts a thing.
    pub(crate) fn count_thing(&self, learner: &mut Learner<'_>, context: &Context, number: u16, at_s: f64) {
        let last = context.get(Last);
        if last != NONE {
            self.same.count(learner, context, if number == last { SAME } else { OTHER }, at_s);
        }
        if number != last {
            self.other.count(learner, context, number, at_s);
        }
    }
}

/// Writes the rooms of the expected things: those of earlier turns, over the map's rooms.
fn rooms_of(view: &View<'_>, things: &[f64], index: impl Fn(u16) -> Option<usize>, rooms: &mut [f64]) {
    for (thing, p) in things.iter().enumerate() {
        let mut of_map = *p;
        let number = view.home.things.number(thing).filter(|_| *p > UNLIKELY);
        let seen =
            number.and_then(|number| view.get(&OF_THING, key(OF_THING.part.number, view.slot, [number, NONE, NONE])));
        if let Some(seen) = seen {
            let seen = || seen.symbols().filter_map(|(number, count)| Some((index(number)?, count)));
            let scale = p / (seen().map(|(_, count)| count).sum::<f64>() + MAP_STRENGTH);
            seen().for_each(|(room, count)| rooms[room] += count * scale);
            of_map = MAP_STRENGTH * scale;
        }
        add(rooms, view.home.shares_of(thing), of_map);
    }
    rooms.iter_mut().for_each(|p| *p += FLOORS[1]);
    normalise(rooms);
}
