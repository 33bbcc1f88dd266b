//! The next room: whether the person leaves this one, and the destination.
//!
//! | expert | source |
//! | --- | --- |
//! | model | the language model's room probabilities |
//! | habit | which rooms followed this room and the last one to three things, over the model |
//! | short | as habit, for this room and the last thing alone |
//! | things | the next thing, and in which room it was found before |
//! | hour | which rooms followed this one at this part of the day, over short |
//! | dwell | which rooms followed this one by the time spent there and the pace of events |
//! | product | the others multiplied ([`super::pool`]) |
//!
//! Staying and destination have separate mixtures, because an expert can be better at one of them. The next room is counted in the context that was
//! known at the forecast.

use super::counts::Counts;
use super::key::{Kind, NONE, key, with_times};
use super::moment::{self, time_class};
use super::parts::{Expert, Without};
use super::pool::Pool;
use super::whose::View;

const FORECASTS: usize = 6;
const EXPERTS: usize = FORECASTS + 1;
const PRIOR: [f64; EXPERTS] = [0.1, 0.06, 0.06, 0.06, 0.06, 0.06, 0.6];
/// The model's first weights, of staying and of the destination.
pub(crate) const FIRST: [f64; 2] = [0.4, 0.8];
const STAYING_POWERS: [f64; FORECASTS] = [0.0, 0.3, 0.2, 0.1, 0.2, 0.1];
const DESTINATION_POWERS: [f64; FORECASTS] = [0.15, 0.3, 0.15, 0.1, 0.15, 0.1];
pub(crate) const SHARE: f64 = 0.005;
const DISCOUNT: f64 = 0.5;
/// Share of uniform chances in habit's prior: it limits the cost of new rooms when the model is far off.
const EVEN: f64 = 0.05;
/// Less likely things use the map's rooms: the look-up costs more than it could change.
const UNLIKELY: f64 = 1e-3;
/// Observations that the map's rooms of a thing are worth.
const MAP_STRENGTH: f64 = 1.0;
/// Smaller probabilities are raised to this.
const FLOOR: f64 = 1e-4;

/// The context of a forecast of the next room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Known {
    pub(crate) here: u16,
    /// The last things, and the number of repeated mentions of the latest.
    pub(crate) last: [u16; 3],
    pub(crate) times: u8,
    /// Time spent here, and time between the last two observations.
    pub(crate) spent_s: f64,
    pub(crate) pace_s: f64,
    pub(crate) at_s: f64,
}

const CONTEXTS: usize = 6;
const HOUR: usize = 4;
const DWELL: usize = 5;

impl Known {
    /// The contexts of the next room, each with the number of repeated mentions if it matters there, and with the observations that the shorter
    /// context is worth.
    fn contexts(&self) -> [(Kind, u8, [u16; 3], f64); CONTEXTS] {
        let Self { here, last: [first, second, third], times, .. } = *self;
        let [pace, dwell] = [self.pace_s, self.spent_s].map(time_class);
        [
            (Kind::Room0, 0, [here, NONE, NONE], 4.0),
            (Kind::Room1, times, [first, NONE, NONE], 2.0),
            (Kind::Room2, times, [first, second, NONE], 0.5),
            (Kind::Room3, times, [first, second, third], 0.5),
            (Kind::RoomHour, 0, [here, moment::part_of_day(self.at_s, 3), NONE], 2.0),
            (Kind::RoomDwellPace, 0, [here, dwell, pace], 2.0),
        ]
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Rooms {
    pub(crate) staying: Pool<EXPERTS, FORECASTS>,
    pub(crate) destination: Pool<EXPERTS, FORECASTS>,
    here: Option<usize>,
    /// The context of the latest forecast, or of the last observation.
    known: Option<Known>,
    kept: [f64; FORECASTS],
    pub(crate) observations: [f64; 4],
    pub(crate) mixed: Vec<f64>,
}

impl Rooms {
    pub(crate) fn new(without: Without) -> Self {
        use Expert::{RoomDwell, RoomHabit, RoomHour, RoomProduct, RoomShort, RoomThings};
        let [habit, short, things, hour, dwell, product] =
            [RoomHabit, RoomShort, RoomThings, RoomHour, RoomDwell, RoomProduct]
                .map(|expert| without.uses(expert as u8));
        let experts = [true, habit, short, things, hour, dwell, product];
        Self {
            staying: Pool::new(FIRST[0], PRIOR, STAYING_POWERS, experts),
            destination: Pool::new(FIRST[1], PRIOR, DESTINATION_POWERS, experts),
            here: None,
            known: None,
            kept: [1.0; FORECASTS],
            observations: [0.0; 4],
            mixed: Vec::new(),
        }
    }

    /// Drops the latest forecast, so that nothing is learned from it.
    pub(crate) fn forget_forecast(&mut self) {
        self.destination.forget();
        self.mixed.clear();
    }

    pub(crate) fn know(&mut self, known: Option<Known>) {
        self.known = known;
    }

    pub(crate) fn forecast(&mut self, view: View<'_>, known: Known, (model, things): (&[f64], &[f64])) {
        let width = model.len();
        let index = |number| view.home.room(number);
        (self.known, self.here) = (Some(known), index(known.here).filter(|here| *here < width));
        let [own, habit, short, by_thing, hour, dwell] = self.destination.begin(width, self.here);
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOOR));
        normalise(own);
        let contexts = known.contexts();
        let over = |context: usize, p: &mut [f64]| {
            let (kind, times, after, concentration) = contexts[context];
            let mut view = view;
            view.times = times;
            view.smooth((kind, after), (DISCOUNT, concentration), index, p)
        };
        habit.iter_mut().zip(&*own).for_each(|(habit, p)| *habit = (1.0 - EVEN) * p + EVEN / width as f64);
        let mut kept = 1.0 - EVEN;
        for order in 0..self.observations.len() {
            let (left, seen) = over(order, habit);
            kept *= left;
            self.observations[order] = seen;
            match order {
                0 => (self.kept[5], _) = (kept, dwell.copy_from_slice(habit)),
                1 => {
                    short.copy_from_slice(habit);
                    hour.copy_from_slice(habit);
                    (self.kept[2], self.kept[4]) = (kept, kept);
                }
                _ => {}
            }
        }
        self.kept[1] = kept;
        self.kept[3] = 0.0;
        self.kept[4] *= over(HOUR, hour).0;
        self.kept[5] *= over(DWELL, dwell).0;
        for (thing, p) in things.iter().enumerate() {
            let mut of_map = *p;
            let number = view.home.things.number(thing).filter(|_| *p > UNLIKELY);
            if let Some(seen) = number.and_then(|number| view.own(Kind::RoomOfObject, [number, NONE, NONE])) {
                let total: f64 = seen.symbols().filter(|(n, _)| index(*n).is_some()).map(|(_, count)| count).sum();
                let scale = p / (total + MAP_STRENGTH);
                for (number, count) in seen.symbols() {
                    index(number).into_iter().for_each(|room| by_thing[room] += count * scale);
                }
                of_map = MAP_STRENGTH * scale;
            }
            by_thing.iter_mut().zip(view.home.shares_of(thing)).for_each(|(sum, share)| *sum += of_map * share);
        }
        by_thing.iter_mut().for_each(|p| *p += FLOOR);
        normalise(by_thing);

        let stays: Option<[f64; FORECASTS]> =
            self.here.map(|here| [own[here], habit[here], short[here], by_thing[here], hour[here], dwell[here]]);
        self.destination.forecast();
        self.mixed.clear();
        self.mixed.extend(&self.destination.mixed);
        if let Some((here, stays)) = self.here.zip(stays) {
            for (row, stay) in self.staying.begin(2, None).into_iter().zip(stays) {
                row.copy_from_slice(&[stay, 1.0 - stay]);
            }
            self.staying.forecast();
            let stay = if self.mixed.iter().any(|p| *p > 0.0) { self.staying.mixed[0] } else { 1.0 };
            self.mixed.iter_mut().for_each(|p| *p *= 1.0 - stay);
            self.mixed[here] = stay;
        }
    }

    /// The shares in a room's probability in the latest forecast: of the model, of the rooms after rooms and things, of the next thing, and of the
    /// hour.
    pub(crate) fn explain(&self, room: usize) -> Option<[f64; 4]> {
        if *self.mixed.get(room)? <= 0.0 {
            return None;
        }
        let (pool, at) = if self.here == Some(room) { (&self.staying, 0) } else { (&self.destination, room) };
        let parts = pool.parts(at);
        let of_model: [f64; FORECASTS] = std::array::from_fn(|row| {
            parts[row]
                * if row == 0 { 1.0 } else { (self.kept[row] * pool.given(0, at) / pool.given(row, at)).min(1.0) }
        });
        let [_, habit, short, things, hour, dwell]: [f64; FORECASTS] =
            std::array::from_fn(|row| parts[row] - of_model[row]);
        Some([of_model.iter().sum(), habit + short + dwell, things, hour])
    }

    /// Learns from the outcome: the next thing was in `room`.
    pub(crate) fn learn_weights(&mut self, room: usize) {
        if room >= self.destination.width() {
            return;
        }
        if self.here.is_some() {
            self.staying.learn(usize::from(self.here != Some(room)), SHARE);
        }
        if self.here != Some(room) {
            self.destination.learn(room, SHARE);
        }
    }

    pub(crate) fn count(&self, counts: &mut Counts, slot: u8, number: u16, thing: Option<u16>, at_s: f64) {
        let now_min = moment::minute(at_s);
        for (kind, times, after, _) in self.known.iter().flat_map(Known::contexts) {
            counts.add(key(kind, with_times(slot, times), after), number, 1.0, now_min);
        }
        if let Some(thing) = thing {
            counts.add(key(Kind::RoomOfObject, slot, [thing, NONE, NONE]), number, 1.0, now_min);
        }
    }
}

/// Scales probabilities to a sum of one; uniform if all are zero.
pub(crate) fn normalise(p: &mut [f64]) {
    let total: f64 = p.iter().sum();
    let even = 1.0 / p.len().max(1) as f64;
    p.iter_mut().for_each(|p| *p = if total > 0.0 { *p / total } else { even });
}
