//! The next room: whether the person leaves this one, and where to if so, by ten forecasts each.
//!
//! | expert | what it knows |
//! | --- | --- |
//! | model | the language model's room probabilities |
//! | habit | which rooms followed this room and the last one to three objects, backed off to the base |
//! | short | the same of this room and the last object alone |
//! | objects | the mixture's next object, and in which room it was found before |
//! | hour | which rooms followed this one at this part of the day, over short |
//! | before | which rooms followed this one and the one or two before it |
//! | pace | which rooms followed the last object, by how soon it came after what was before it |
//! | dwell | which rooms followed this one by the time spent there, and by the pace as well |
//! | staying | the share of times that the person stayed, and else the model |
//! | together | the others multiplied ([`super::together`]): what is sure of too much is believed less |
//!
//! The base is the model mixed with even chances, as for objects. Staying and destination are mixed apart from one another: who knows best
//! that somebody leaves need not know best where to. What comes next is counted for what was known when it was forecast: whoever was told
//! of elsewhere meanwhile left from where they were.

use super::counts::Counts;
use super::frame::Frame;
use super::key::{Kind, NONE, key, with_times};
use super::mixture::FixedShare;
use super::moment;
use super::together::Together;
use super::whose::Whose;

pub(crate) const EXPERTS: usize = 10;
pub(crate) const GATES: usize = 2;
pub(crate) const PRIOR: [f64; EXPERTS] = [0.1, 0.04, 0.04, 0.04, 0.04, 0.04, 0.04, 0.03, 0.03, 0.6];
/// The model's weight before anything was seen, of staying and leaving and of where to; the second of each where habit knows what came last.
pub(crate) const FIRST: [[f64; GATES]; 2] = [[0.4, 0.4], [0.8, 0.65]];
/// The powers that the products begin with: of staying and leaving those of habit, short, objects, hour, before, pace, dwell and staying; of
/// where to those of model, habit, short, objects, hour, before, pace and dwell.
pub(crate) const FACTORS: usize = 8;
const STAYING_POWERS: [f64; FACTORS] = [0.3, 0.2, 0.1, 0.2, 0.1, 0.1, 0.1, 0.2];
const DESTINATION_POWERS: [f64; FACTORS] = [0.15, 0.3, 0.15, 0.1, 0.15, 0.1, 0.1, 0.1];
/// The first of the rows that are multiplied.
const STAYING_FACTOR: usize = 1;
const DESTINATION_FACTOR: usize = 0;
const TOGETHER: usize = EXPERTS - 1;
pub(crate) const SHARE: f64 = 0.005;
const DISCOUNT: f64 = 0.5;
const CONCENTRATIONS: [f64; 4] = [2.0, 2.0, 1.0, 1.0];
/// The same of what is counted by the rooms before, by pace, and by time spent.
const BEFORE_CONCENTRATIONS: [f64; 2] = [1.0, 1.0];
const BY_TIME_CONCENTRATION: f64 = 2.0;
/// Of the model and of even chances in the base.
const BASE: [f64; 2] = [0.9, 0.1];
/// Of things that are less likely next, the map says where they are: looking one up takes longer than it could change anything.
const UNLIKELY: f64 = 1e-3;
/// How many observations what the map says of a thing's room is worth.
const MAP_STRENGTH: f64 = 1.0;
/// Upper ends of the times that are told apart, in seconds: between the last two observations, and spent in a room.
const PACES_S: [f64; 6] = [20.0, 60.0, 180.0, 600.0, 1_800.0, 7_200.0];
const DWELLS_S: [f64; 6] = [15.0, 60.0, 240.0, 960.0, 3_840.0, 15_360.0];

fn class(time_s: f64, ends_s: &[f64]) -> u16 {
    ends_s.partition_point(|end_s| *end_s <= time_s) as u16
}

/// What is known when a next room is forecast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Known {
    /// Where the person is, and was before, the latest first.
    pub(crate) here: u16,
    pub(crate) before: [u16; 2],
    /// The last objects, and how often the latest was mentioned again.
    pub(crate) last: [u16; 3],
    pub(crate) times: u8,
    /// Since when the person is here, how long after what was before it the last observation came, and when that was.
    pub(crate) entered_s: f64,
    pub(crate) pace_s: f64,
    pub(crate) at_s: f64,
}

impl Known {
    /// The contexts in which the next room is counted, each with how often the last object was mentioned again, if that matters there.
    fn contexts(&self) -> [(Kind, u8, [u16; 3]); CONTEXTS] {
        let Self { here, before: [before, before_it], last: [first, second, third], times, .. } = *self;
        let (pace, dwell) = (class(self.pace_s, &PACES_S), class(self.at_s - self.entered_s, &DWELLS_S));
        [
            (Kind::Room0, 0, [here, NONE, NONE]),
            (Kind::Room1, times, [first, NONE, NONE]),
            (Kind::Room2, times, [first, second, NONE]),
            (Kind::Room3, times, [first, second, third]),
            (Kind::RoomHour, 0, [here, moment::part_of_day(self.at_s, 3), NONE]),
            (Kind::RoomBefore, 0, [here, before, NONE]),
            (Kind::RoomBefore2, 0, [here, before, before_it]),
            (Kind::RoomPace, 0, [first, pace, NONE]),
            (Kind::RoomDwell, 0, [here, dwell, NONE]),
            (Kind::RoomDwellPace, 0, [here, dwell, pace]),
        ]
    }
}

/// The experts that back off to the base, in which the model is.
const OVER_MODEL: [usize; 5] = [1, 2, 5, 6, 7];

/// Contexts of a next room, and the places of some among them.
const CONTEXTS: usize = 10;
const HOUR: usize = 4;
const BEFORE: usize = 5;
const PACE: usize = 7;
const DWELL: usize = 8;

/// The rooms that one person goes to.
#[derive(Debug, Clone)]
pub(crate) struct Rooms {
    pub(crate) staying: [FixedShare<EXPERTS>; GATES],
    pub(crate) destination: [FixedShare<EXPERTS>; GATES],
    pub(crate) base: FixedShare<2>,
    pub(crate) staying_together: [Together<FACTORS>; GATES],
    pub(crate) destination_together: [Together<FACTORS>; GATES],
    logs: Vec<f32>,
    /// How often the person stayed, of how many times.
    pub(crate) stayed: f64,
    pub(crate) turned: f64,
    /// The latest forecast: experts row by row.
    experts: Vec<f64>,
    rooms: usize,
    here: Option<usize>,
    gate: usize,
    /// What was known of it, or when something was observed last.
    known: Option<Known>,
    /// The weight that the model keeps within each of [`OVER_MODEL`], and the observations after this room, and after the last one to three
    /// things.
    model_in: [f64; OVER_MODEL.len()],
    pub(crate) observations: [f64; 4],
    pub(crate) mixed: Vec<f64>,
}

impl Rooms {
    pub(crate) fn new() -> Self {
        Self {
            staying: FIRST[0].map(|first| FixedShare::beginning_with(first, PRIOR)),
            destination: FIRST[1].map(|first| FixedShare::beginning_with(first, PRIOR)),
            base: FixedShare::new(BASE),
            staying_together: std::array::from_fn(|_| Together::new(STAYING_POWERS)),
            destination_together: std::array::from_fn(|_| Together::new(DESTINATION_POWERS)),
            logs: Vec::new(),
            stayed: 1.0,
            turned: 2.0,
            experts: Vec::new(),
            rooms: 0,
            here: None,
            gate: 0,
            known: None,
            model_in: [1.0; OVER_MODEL.len()],
            observations: [0.0; 4],
            mixed: Vec::new(),
        }
    }

    /// Another map: the last forecast says nothing of its rooms.
    pub(crate) fn forget_forecast(&mut self) {
        self.rooms = 0;
        self.mixed.clear();
    }

    /// A number stands for something else from now on.
    pub(crate) fn forget_known(&mut self) {
        self.known = None;
    }

    /// This is what is known now of what comes next.
    pub(crate) fn know(&mut self, known: Known) {
        self.known = Some(known);
    }

    /// Forecasts the room of the next object, from the model's room probabilities and the mixture's next object.
    pub(crate) fn forecast(
        &mut self,
        whose: Whose<'_>,
        frame: &Frame,
        known: Known,
        (model, objects): (&[f64], &[f64]),
    ) {
        let rooms = model.len();
        self.known = Some(known);
        (self.rooms, self.here) = (rooms, frame.room(known.here).filter(|here| *here < rooms));
        self.experts.clear();
        self.experts.resize(EXPERTS * rooms, 0.0);
        let (own, rest) = self.experts.split_at_mut(rooms);
        let (habit, rest) = rest.split_at_mut(rooms);
        let (short, rest) = rest.split_at_mut(rooms);
        let (by_object, rest) = rest.split_at_mut(rooms);
        let (hour, rest) = rest.split_at_mut(rooms);
        let (before, rest) = rest.split_at_mut(rooms);
        let (pace, rest) = rest.split_at_mut(rooms);
        let (dwell, rest) = rest.split_at_mut(rooms);
        let (staying, together) = rest.split_at_mut(rooms);

        const FLOOR: f64 = 1e-4;
        let total: f64 = model.iter().map(|p| p.max(FLOOR)).sum();
        own.iter_mut().zip(model).for_each(|(own, p)| *own = p.max(FLOOR) / total);

        let [of_model, of_even] = *self.base.weights();
        habit.iter_mut().zip(&*own).for_each(|(habit, p)| *habit = of_model * p + of_even / rooms as f64);
        let index = |number| frame.room(number);
        let contexts = known.contexts();
        // Mixes what was seen in a context over a shorter one; gives the weight that this keeps, and what was seen.
        let over = |context: usize, concentration: f64, p: &mut [f64]| {
            let (kind, times, after) = contexts[context];
            let mut whose = whose;
            whose.times = times;
            whose.smooth(kind, after, DISCOUNT, concentration, index, p)
        };
        let mut kept = of_model;
        let mut model_in = [of_model; OVER_MODEL.len()];
        for (order, concentration) in CONCENTRATIONS.into_iter().enumerate() {
            let (left, seen) = over(order, concentration, habit);
            kept *= left;
            self.observations[order] = seen;
            match order {
                // What follows this room is what those by the rooms before it and by time spent begin with.
                0 => {
                    [&mut *before, &mut *dwell].into_iter().for_each(|p| p.copy_from_slice(habit));
                    (model_in[2], model_in[4]) = (kept, kept);
                }
                1 => {
                    short.copy_from_slice(habit);
                    model_in[1] = kept;
                }
                _ => {}
            }
        }
        model_in[0] = kept;
        self.gate = usize::from(kept < 0.2 * of_model);
        for (context, concentration) in (BEFORE..).zip(BEFORE_CONCENTRATIONS) {
            model_in[2] *= over(context, concentration, before).0;
        }
        pace.copy_from_slice(short);
        model_in[3] = model_in[1] * over(PACE, BY_TIME_CONCENTRATION, pace).0;
        for context in [DWELL, DWELL + 1] {
            model_in[4] *= over(context, BY_TIME_CONCENTRATION, dwell).0;
        }
        self.model_in = model_in;

        // Looked up together, they are waited for together.
        const AT_ONCE: usize = 16;
        for (part, objects) in objects.chunks(AT_ONCE).enumerate() {
            let first = part * AT_ONCE;
            let mut found = [None; AT_ONCE];
            for ((label, p), found) in (first..).zip(objects).zip(&mut found) {
                // Where a thing is that is next to impossible need not be looked up.
                let number = frame.label_number(label).filter(|_| *p > UNLIKELY);
                *found = number.and_then(|number| whose.own(Kind::RoomOfObject, [number, NONE, NONE]));
            }
            for ((label, p), found) in (first..).zip(objects).zip(found) {
                let mut strength = MAP_STRENGTH;
                if let Some(found) = found {
                    let total: f64 = found.symbols().filter(|(n, _)| index(*n).is_some()).map(|(_, count)| count).sum();
                    let scale = p / (total + MAP_STRENGTH);
                    for (number, count) in found.symbols() {
                        if let Some(room) = index(number) {
                            by_object[room] += count * scale;
                        }
                    }
                    strength /= total + MAP_STRENGTH;
                }
                let of_label = frame.shares_of(label).iter();
                by_object.iter_mut().zip(of_label).for_each(|(sum, share)| *sum += p * strength * share);
            }
        }
        let total: f64 = by_object.iter().sum::<f64>() + rooms as f64 * FLOOR;
        by_object.iter_mut().for_each(|p| *p = (*p + FLOOR) / total);

        hour.copy_from_slice(short);
        over(HOUR, 2.0, hour);

        staying.copy_from_slice(own);
        if let Some(here) = self.here {
            let stay = self.stayed / self.turned;
            let others = (1.0 - own[here]).max(f64::MIN_POSITIVE);
            staying.iter_mut().for_each(|p| *p *= (1.0 - stay) / others);
            staying[here] = if rooms > 1 { stay } else { 1.0 };
        }

        let rows: [&[f64]; EXPERTS - 1] = [own, habit, short, by_object, hour, before, pace, dwell, staying];
        let factors = std::array::from_fn(|factor| rows[DESTINATION_FACTOR + factor]);
        self.destination_together[self.gate].forecast(factors, self.here, &mut self.logs, together);
        if let Some(here) = self.here {
            let stay = rooms <= 1 || together.iter().all(|p| *p <= 0.0);
            let factors: [[f64; 2]; FACTORS] = std::array::from_fn(|factor| {
                let stay = rows[STAYING_FACTOR + factor][here];
                [stay, 1.0 - stay]
            });
            let mut either = [1.0, 0.0];
            if !stay {
                let factors = factors.each_ref().map(|factor| factor.as_slice());
                self.staying_together[self.gate].forecast(factors, None, &mut self.logs, &mut either);
            }
            together.iter_mut().for_each(|p| *p *= either[1]);
            together[here] = either[0];
        }

        self.mixed.clear();
        self.mixed.resize(rooms, 0.0);
        for expert in 0..EXPERTS {
            let row = &self.experts[expert * rooms..(expert + 1) * rooms];
            let weight = self.destination[self.gate].weights()[expert];
            let leaves = self.here.map_or(1.0, |here| 1.0 - row[here]);
            if leaves > 0.0 {
                self.mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p / leaves);
            }
        }
        if let Some(here) = self.here {
            let stays = self.staying[self.gate].weights();
            let stay: f64 = (0..EXPERTS).map(|expert| stays[expert] * self.experts[expert * rooms + here]).sum();
            self.mixed[here] = 0.0;
            let others: f64 = self.mixed.iter().sum();
            let stay = if others > 0.0 { stay } else { 1.0 };
            self.mixed.iter_mut().for_each(|p| *p *= (1.0 - stay) / others.max(f64::MIN_POSITIVE));
            self.mixed[here] = stay;
        }
    }

    /// What each expert adds to the probability of a room in the latest forecast, and how much of that is the model's.
    pub(crate) fn by_expert(&self, room: usize) -> Option<[(f64, f64); TOGETHER]> {
        let mixed = *self.mixed.get(room).filter(|_| room < self.rooms)?;
        let p = |expert: usize, room: usize| self.experts[expert * self.rooms + room];
        let part = |expert: usize| match self.here {
            Some(here) if here == room => self.staying[self.gate].weights()[expert] * p(expert, room),
            here => {
                let leaves = here.map_or(1.0, |here| 1.0 - p(expert, here));
                self.destination[self.gate].weights()[expert] * p(expert, room) / leaves.max(f64::MIN_POSITIVE)
            }
        };
        let mut parts: [f64; TOGETHER] = std::array::from_fn(part);
        let of_product = part(TOGETHER);
        // Of a product each factor has as much as its power.
        let (powers, first) = match self.here {
            Some(here) if here == room => (self.staying_together[self.gate].powers(), STAYING_FACTOR),
            _ => (self.destination_together[self.gate].powers(), DESTINATION_FACTOR),
        };
        let powers = powers.map(|power| power.max(0.0));
        let of_all = powers.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        for (part, power) in parts[first..].iter_mut().zip(powers) {
            *part += of_product * power / of_all;
        }
        let total: f64 = parts.iter().sum();
        let scale = if total > 0.0 { mixed / total } else { 0.0 };
        let mut parts = parts.map(|part| (part * scale, 0.0));
        parts[0].1 = 1.0;
        for (expert, kept) in OVER_MODEL.into_iter().zip(self.model_in) {
            parts[expert].1 = (kept * p(0, room) / p(expert, room).max(f64::MIN_POSITIVE)).min(1.0);
        }
        Some(parts)
    }

    /// Learns how good the latest forecast was: the next object was in `room`.
    pub(crate) fn learn_weights(&mut self, room: usize) {
        if room >= self.rooms {
            return;
        }
        self.base.learn(&[self.experts[room], 1.0 / self.rooms as f64], &BASE, SHARE, 1.0);
        let p = |expert: usize, room: usize| self.experts[expert * self.rooms + room];
        let Some(here) = self.here else {
            self.destination[self.gate].learn(&std::array::from_fn(|expert| p(expert, room)), &PRIOR, SHARE, 1.0);
            self.learn_where(room);
            return;
        };
        self.turned += 1.0;
        let stays = |factor: usize| p(STAYING_FACTOR + factor, here);
        let given = |stay: f64| if room == here { stay } else { 1.0 - stay };
        let given = std::array::from_fn(|factor| given(stays(factor)));
        self.staying_together[self.gate].learn(given);
        let p = |expert: usize, room: usize| self.experts[expert * self.rooms + room];
        if room == here {
            self.stayed += 1.0;
            self.staying[self.gate].learn(&std::array::from_fn(|expert| p(expert, here)), &PRIOR, SHARE, 1.0);
        } else {
            self.staying[self.gate].learn(&std::array::from_fn(|expert| 1.0 - p(expert, here)), &PRIOR, SHARE, 1.0);
            let given = |expert| p(expert, room) / (1.0 - p(expert, here)).max(1e-9);
            self.destination[self.gate].learn(&std::array::from_fn(given), &PRIOR, SHARE, 1.0);
            self.learn_where(room);
        }
    }

    /// The person went to `room`: the powers of the forecasts of where to learn from it.
    fn learn_where(&mut self, room: usize) {
        let p = |factor: usize| self.experts[(DESTINATION_FACTOR + factor) * self.rooms + room];
        self.destination_together[self.gate].learn(std::array::from_fn(p));
    }

    /// Counts that the next object, `object`, was in the place `number`.
    pub(crate) fn count(&self, counts: &mut Counts, slot: u8, number: u16, object: Option<u16>, at_s: f64) {
        let now_min = moment::minute(at_s);
        for (kind, times, after) in self.known.iter().flat_map(Known::contexts) {
            counts.add(key(kind, with_times(slot, times), after), number, 1.0, now_min);
        }
        if let Some(object) = object {
            counts.add(key(Kind::RoomOfObject, slot, [object, NONE, NONE]), number, 1.0, now_min);
        }
    }
}
