//! The next thing and the next room: whether it is the same as the last one, and which other one comes if not.
//!
//! Both questions have their own mixture, because an expert can be better at one of them. A thing that is mentioned again and again is one thing of
//! the context, and so are sentences about nothing that the map has. An outcome is counted in the context that was known at the forecast.

use super::Shares;
use super::context::Context;
use super::counts::Counts;
use super::parts::{Part, Without};
use super::pool::Begin::{After, Given};
use super::pool::Source::{Habit, Hour, Model, Things};
use super::pool::{Plan, Pool, expert};
use super::view::{View, level, normalise};

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

/// Another thing, after the last things and at this part of the day.
pub(crate) const THINGS: Plan = Plan {
    experts: &[
        expert(None, [0.15, 0.65], Model, Given, &[]),
        expert(
            Some(Part::ThingHabit),
            [0.08, 0.3],
            Habit,
            After(0, 0),
            &[
                level(Part::ThingAfter0, 0.3, 4.0),
                level(Part::ThingAfter1, 0.3, 2.0),
                level(Part::ThingAfter2, 0.3, 1.0),
                level(Part::ThingAfter3, 0.3, 0.5),
                level(Part::ThingAfter4, 0.3, 0.25),
                level(Part::ThingAfter5, 0.3, 0.25),
            ],
        ),
        expert(
            Some(Part::ThingHour),
            [0.06, 0.1],
            Hour,
            After(1, 2),
            &[level(Part::ThingAtHour, 0.5, 20.0), level(Part::ThingAfter1AtHour, 0.5, 1.0)],
        ),
    ],
    product: Some((Part::ThingProduct, 0.71)),
    even: 0.0,
};

/// The same thing again: how often any thing is mentioned again, and how often the last one was mentioned so often after the same things.
pub(crate) const AGAIN: Plan = Plan {
    experts: &[
        expert(None, [0.5, 0.0], Model, Given, &[]),
        expert(
            Some(Part::AgainHabit),
            [0.3, 0.0],
            Habit,
            Given,
            &[
                level(Part::AgainAfter0, 0.0, 2.0),
                level(Part::AgainAfter1, 0.0, 1.0),
                level(Part::AgainAfter2, 0.0, 0.7),
                level(Part::AgainAfter3, 0.0, 0.5),
            ],
        ),
        expert(Some(Part::AgainShare), [0.2, 0.0], Habit, Given, &[]),
    ],
    product: None,
    even: 0.0,
};
const BY_HABIT: usize = 1;
const BY_SHARE: usize = 2;

/// The same room or another one: after this room and the last things, by the rooms of the next thing, at this part of the day, and by the time spent
/// and the pace of events.
pub(crate) const ROOMS: Plan = Plan {
    experts: &[
        expert(None, [0.1, 0.15], Model, Given, &[]),
        expert(
            Some(Part::RoomHabit),
            [0.06, 0.3],
            Habit,
            After(0, 0),
            &[
                level(Part::RoomAfterRoom, 0.5, 4.0),
                level(Part::RoomAfter1, 0.5, 2.0),
                level(Part::RoomAfter2, 0.5, 0.5),
                level(Part::RoomAfter3, 0.5, 0.5),
            ],
        ),
        expert(Some(Part::RoomShort), [0.06, 0.15], Habit, After(1, 2), &[]),
        expert(Some(Part::RoomThings), [0.06, 0.1], Things, Given, &[]),
        expert(Some(Part::RoomHour), [0.06, 0.15], Hour, After(1, 2), &[level(Part::RoomByHour, 0.5, 2.0)]),
        expert(Some(Part::RoomDwell), [0.06, 0.1], Habit, After(1, 1), &[level(Part::RoomByDwell, 0.5, 2.0)]),
    ],
    product: Some((Part::RoomProduct, 0.6)),
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
        let (width, last) = (model.len(), context.last[0]);
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
        self.here = view.home.room(context.here).filter(|room| *room < model.len());
        self.other.begin(model.len(), self.here);
        let own = self.other.row_mut(0);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOORS[1]));
        normalise(own);
        rooms_of(view, context, things, index, self.other.row_mut(BY_THINGS));
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
        if outcome >= self.other.width() {
            return None;
        }
        let is_same = self.here == Some(outcome);
        if !is_same {
            self.other.learn(outcome, SHARE);
        }
        (self.same.width() > 0).then(|| {
            self.same.learn(usize::from(!is_same), SHARE);
            is_same
        })
    }

    /// Counts a thing.
    pub(crate) fn count_thing(&self, counts: &mut Counts, slot: u8, context: &Context, number: u16, at_s: f64) {
        let last = context.last[0];
        if last != super::NONE {
            self.same.count(counts, slot, context, if number == last { SAME } else { OTHER }, at_s);
        }
        if number != last {
            self.other.count(counts, slot, context, number, at_s);
        }
    }
}

/// Writes the rooms of the expected things: those of earlier turns, over the map's rooms.
fn rooms_of(
    view: &View<'_>,
    context: &Context,
    things: &[f64],
    index: impl Fn(u16) -> Option<usize>,
    rooms: &mut [f64],
) {
    for (thing, p) in things.iter().enumerate() {
        let mut of_map = *p;
        let number = view.home.things.number(thing).filter(|_| *p > UNLIKELY);
        let last = |number| Context { last: [number; super::context::LAST], ..*context };
        if let Some(seen) = number.and_then(|number| view.own(Part::RoomOfThing, &last(number))) {
            let total: f64 = seen.symbols().filter(|(n, _)| index(*n).is_some()).map(|(_, count)| count).sum();
            let scale = p / (total + MAP_STRENGTH);
            for (number, count) in seen.symbols() {
                index(number).into_iter().for_each(|room| rooms[room] += count * scale);
            }
            of_map = MAP_STRENGTH * scale;
        }
        rooms.iter_mut().zip(view.home.shares_of(thing)).for_each(|(sum, share)| *sum += of_map * share);
    }
    rooms.iter_mut().for_each(|p| *p += FLOORS[1]);
    normalise(rooms);
}
