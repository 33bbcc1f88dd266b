//! The next thing and the next room: whether it is the same as the last one, and which other one comes if not.
//!
//! Both questions have their own mixture, because an expert can be better at one of them. A thing that is mentioned again and again is one thing of
//! the context, and so are sentences about nothing that the map has. An outcome is counted in the context that was known at the forecast.

use super::Shares;
use super::context::Fact::{Five0, Five1, Five2, Here, Hours3, Last, Pace, Second, Spent, Third};
use super::context::{Context, Level, NONE, Without, level};
use super::pool::Begin::{After, Given};
use super::pool::Source::{Habit, Hour, Model, Things};
use super::pool::{Plan, Pool, expert};
use super::view::{View, add, normalise, smooth};

pub(crate) const SHARE: f64 = 0.005;
/// Smaller probabilities of things and of rooms are raised to these.
const FLOORS: [f64; 2] = [1e-6, 1e-4];
/// Symbols of repeated mentions.
const OTHER: u16 = 0;
const SAME: u16 = 1;
/// Less likely things use the map's rooms: the look-up costs more than it could change.
const UNLIKELY: f64 = 1e-3;

/// The rooms of a thing in earlier turns, over those of the map.
pub(crate) static OF_THING: Level = level(13, "room-of-thing", &[Last], [0.0, 1.0]);

/// Another thing, after the last things and at this part of the day.
pub(crate) static THINGS: Plan = Plan {
    experts: &[
        expert(0, "", [0.15, 0.65], Model, Given),
        expert(40, "thing-habit", [0.08, 0.3], Habit, After(0, 0)).over(&[
            level(1, "thing-after-0", &[], [0.3, 4.0]),
            level(2, "thing-after-1", &[Last], [0.3, 2.0]),
            level(3, "thing-after-2", &[Last, Second], [0.3, 1.0]),
            level(4, "thing-after-3", &[Last, Second, Third], [0.3, 0.5]),
            level(6, "thing-after-5", &[Five0, Five1, Five2], [0.3, 0.25]),
        ]),
        expert(41, "thing-hour", [0.06, 0.1], Hour, After(1, 2)).over(&[
            level(11, "thing-at-hour", &[Hours3], [0.5, 20.0]),
            level(12, "thing-after-1-at-hour", &[Last, Hours3], [0.5, 1.0]),
        ]),
    ],
    product: Some(expert(42, "thing-product", [0.71, 0.0], Model, Given)),
};

/// The same thing again: how often any thing is mentioned again, and how often the last one was mentioned so often after the same things.
pub(crate) static AGAIN: Plan = Plan {
    experts: &[
        expert(0, "", [0.5, 0.0], Model, Given),
        expert(44, "again-share", [0.2, 0.0], Habit, Given),
        expert(43, "again-habit", [0.3, 0.0], Habit, After(1, 0)).over(&[
            level(7, "again-after-0", &[], [0.0, 2.0]).by_times(),
            level(8, "again-after-1", &[Last], [0.0, 1.0]).by_times(),
            level(9, "again-after-2", &[Last, Second], [0.0, 0.7]).by_times(),
            level(10, "again-after-3", &[Last, Second, Third], [0.0, 0.5]).by_times(),
        ]),
    ],
    product: None,
};

static DWELL: [Level; 1] = [level(31, "", &[Here, Spent, Pace], [0.5, 2.0])];
/// The same room or another one: after this room and the last things, by the rooms of the next thing, at this part of the day, and by the time spent
/// and the pace of events.
pub(crate) static ROOMS: Plan = Plan {
    experts: &[
        expert(0, "", [0.1, 0.15], Model, Given),
        expert(45, "room-habit", [0.06, 0.3], Habit, After(0, 0)).over(&[
            level(14, "room-after-room", &[Here], [0.5, 4.0]),
            level(16, "room-after-2", &[Last, Second], [0.5, 0.5]).by_times(),
            level(17, "room-after-3", &[Last, Second, Third], [0.5, 0.5]).by_times(),
        ]),
        expert(47, "room-things", [0.06, 0.1], Things, Given),
        expert(48, "room-hour", [0.06, 0.15], Hour, After(1, 1)).over(&[level(18, "", &[Here, Hours3], [0.5, 2.0])]),
        expert(49, "room-dwell", [0.06, 0.1], Habit, After(1, 1)).over(&DWELL),
    ],
    product: Some(expert(50, "room-product", [0.6, 0.0], Model, Given)),
};
const BY_THINGS: usize = 2;

/// The model's first weight for the same thing again, another thing, the same room and another room. With a high one for things, a first day with few
/// things is no worse than the model alone.
pub(crate) const FIRST: [[f64; 2]; 2] = [[0.5, 0.9], [0.4, 0.8]];

/// A forecast of the next thing or of the next room.
#[derive(Debug, Clone)]
pub(crate) struct Next {
    pub(crate) same: Pool,
    pub(crate) other: Pool,
    here: Option<usize>,
    /// Repeated outcomes, and all outcomes.
    pub(crate) repeated: [f64; 2],
    /// The probabilities of the latest forecast.
    pub(crate) mixed: Vec<f64>,
}

impl Next {
    /// `plans` are of the same thing or room again, and of another one.
    pub(crate) fn new(plans: [&'static Plan; 2], [same, other]: [f64; 2], without: Without) -> Self {
        let (same, other) = (Pool::new(plans[0], same, without), Pool::new(plans[1], other, without));
        Self { same, other, here: None, repeated: [1.0, 2.0], mixed: Vec::new() }
    }

    /// Drops the latest forecast. It teaches no more.
    pub(crate) fn forget_forecast(&mut self) {
        self.other.forget();
        self.mixed.clear();
    }

    /// Forecasts the next thing. The model's probabilities need not sum to one.
    pub(crate) fn things(&mut self, view: &View<'_>, context: &Context, model: &[f64]) {
        let last = context.get(Last);
        self.begin(view.home.things.index(last), model, FLOORS[0]);
        if let Some(here) = self.here {
            let own = self.other.row_mut(0);
            let again = std::mem::take(&mut own[here]);
            normalise(own);
            self.same.begin(2);
            for (row, p) in [again, self.repeated[0] / self.repeated[1]].into_iter().enumerate() {
                let p = p.clamp(FLOORS[0], 1.0 - FLOORS[0]);
                self.same.row_mut(row).copy_from_slice(&[p, 1.0 - p]);
            }
            self.same.smooth(view, context, |symbol| Some(usize::from(symbol != SAME)));
        }
        self.other.smooth(view, context, |number| if number == last { None } else { view.home.things.index(number) });
        self.mix();
    }

    /// Forecasts the next room from the model's probabilities and the expected next things.
    pub(crate) fn rooms(&mut self, view: &View<'_>, context: &Context, model: &[f64], things: &[f64]) {
        let index = |number| view.home.places.index(number).filter(|room| *room < model.len());
        self.begin(index(context.get(Here)), model, FLOORS[1]);
        let of_map = view.home.shares.chunks_exact(model.len().max(1));
        for ((thing, p), of_map) in things.iter().enumerate().zip(of_map) {
            self.mixed.clear();
            self.mixed.extend(of_map);
            let number = view.home.things.number(thing).filter(|_| *p > UNLIKELY);
            let key = number.map(|number| context.of_thing(number).key(&OF_THING, view.slot));
            if let Some(seen) = key.and_then(|key| view.get(&OF_THING, key)) {
                smooth(seen, [OF_THING.discount, OF_THING.concentration], index, &mut self.mixed);
            }
            add(self.other.row_mut(BY_THINGS), &self.mixed, *p);
        }
        let by_things = self.other.row_mut(BY_THINGS);
        by_things.iter_mut().for_each(|p| *p += FLOORS[1]);
        normalise(by_things);
        self.other.smooth(view, context, index);
        if let Some(here) = self.here {
            self.same.begin(2);
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

    /// Begins with the model's probabilities. If there is no other outcome than the last one, there is no question whether it comes again.
    fn begin(&mut self, here: Option<usize>, model: &[f64], floor: f64) {
        self.here = here.filter(|here| *here < model.len() && model.len() > 1);
        self.other.begin(model.len());
        let own = self.other.row_mut(0);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(floor));
        normalise(own);
    }

    fn mix(&mut self) {
        self.other.forecast();
        self.mixed.clone_from(&self.other.mixed);
        let Some(here) = self.here else { return self.same.forget() };
        self.same.forecast();
        let same = self.same.mixed[0];
        self.mixed.iter_mut().for_each(|p| *p *= 1.0 - same);
        self.mixed[here] = same;
    }

    /// The shares of the sources in an outcome's probability in the latest forecast.
    pub(crate) fn explain(&self, outcome: usize) -> Option<Shares> {
        let probability = self.mixed.get(outcome).copied().filter(|p| *p > 0.0)?;
        let is_same = self.here == Some(outcome);
        let [model, habit, things, hour] = if is_same { self.same.explain(0) } else { self.other.explain(outcome) };
        let (observations, things) = (self.other.observations.clone(), Some(things));
        Some(Shares { probability, model, habit, things, hour, observations })
    }

    /// Learns from the outcome of the latest forecast, if there is one.
    pub(crate) fn learn_weights(&mut self, outcome: usize) {
        let is_same = self.here == Some(outcome);
        if outcome < self.other.width && !is_same {
            self.other.learn(outcome, SHARE);
        }
        if outcome < self.other.width && self.here.is_some() {
            self.same.learn(usize::from(!is_same), SHARE);
            self.repeated = [self.repeated[0] + f64::from(u8::from(is_same)), self.repeated[1] + 1.0];
        }
    }

    /// Counts a thing.
    pub(crate) fn count_thing(&self, view: &mut View<'_>, context: &Context, number: u16, at_s: f64) {
        let last = context.get(Last);
        if last != NONE {
            self.same.count(view, context, if number == last { SAME } else { OTHER }, at_s);
        }
        if number != last {
            self.other.count(view, context, number, at_s);
        }
    }
}
