//! How one person moves: a Markov chain in continuous time over places.
//!
//! Each room has three places, because people who walk, sit or lie still differ in what sensors see and in what they do next:
//!
//! ```text
//! elsewhere ----- comes home ----> moving in a room with a way out; a person elsewhere has their phone, or left it at home
//! moving   in r -- 1/crossing ---> settled or still in r      with probability settle(r)
//!                                  moving in the next room    else, by destination
//! settled  in r -- stands up ----> moving in r                at leave(r) / (1 - settle(r)), so that people leave r at leave(r)
//! still    in r -- stands up ----> moving in r                at leave(r)
//! ```
//!
//! Motion sensors miss a still person for the whole stay: their silence must not outweigh everything else.
//! The destination is a weight per room. A way leads through the rooms between, and each takes its crossing time: this bounds the walking speed.
//! The phases make the stay in a room a mixture of exponentials, which ages: the longer a person stayed, the longer they will.

use std::sync::Arc;

use super::home::{Home, RoomUse};

/// A place of a person: two elsewhere, then three per room.
pub(super) type Place = u8;
/// Out of the house, with the phone.
pub(super) const ELSEWHERE: Place = 0;
/// Out of the house without the phone: a phone that stays at home must not hold its person there forever.
pub(super) const PHONELESS: Place = 1;
/// Share of departures without the phone.
pub(super) const FORGETS: f64 = 0.02;

/// Number of places in a home.
pub(super) fn places(rooms: usize) -> usize {
    2 + 3 * rooms
}

/// A person who walks in a room.
pub(super) fn moving(room: usize) -> Place {
    (2 + 3 * room) as Place
}

/// A person who stays in a room.
pub(super) fn settled(room: usize) -> Place {
    (3 + 3 * room) as Place
}

/// A person who stays in a room and is hardly seen: asleep, or in a blind spot.
pub(super) fn still(room: usize) -> Place {
    (4 + 3 * room) as Place
}

/// The places of a person without their phases: elsewhere, then each room.
pub(super) type Column = u8;
/// Probabilities of the phases of a column: walks, stays, is hardly seen; elsewhere, with and without the phone. The last is 0.
pub(super) type Phases = [f32; 4];

/// The column of a place.
pub(super) fn column_of(place: Place) -> Column {
    room_of(place).map_or(0, |room| 1 + room as Column)
}

/// The place of a phase.
pub(super) fn place_of(column: Column, phase: usize) -> Place {
    column.checked_sub(1).map_or(0, |room| moving(usize::from(room))) + phase as Place
}

/// The places of a column.
fn places_of(column: Column) -> std::ops::Range<usize> {
    let first = usize::from(place_of(column, 0));
    first..first + if column == 0 { 2 } else { 3 }
}

/// The room of a column; `None` for elsewhere.
pub(super) fn room_at(column: Column) -> Option<usize> {
    column.checked_sub(1).map(usize::from)
}

/// The room of a place; `None` for elsewhere.
pub(super) fn room_of(place: Place) -> Option<usize> {
    place.checked_sub(2).map(|own| usize::from(own / 3))
}

/// How well sensors see a person at this place: 0 elsewhere, 1 still, 2 settled, 3 moving.
pub(super) fn visibility(place: Place) -> usize {
    if place <= PHONELESS { 0 } else { 3 - usize::from((place - 2) % 3).clamp(0, 2) }
}

/// Share of the stays in which a motion sensor does not see the person: in most rooms, and in a bedroom.
const STILL: (f64, f64) = (0.12, 0.4);

/// Rates of one person. Habits, the hour and the language model's forecast supply them; [`Movement::usual`] is the default.
#[derive(Debug, Clone, PartialEq)]
pub struct Movement {
    /// Per room: hazard of leaving it, per second.
    pub leave_per_s: Vec<f64>,
    /// Per room: probability that a person who enters stays for a while.
    pub settle: Vec<f64>,
    /// Per room: weight as a destination.
    pub destination: Vec<f64>,
    /// Weight of elsewhere as a destination.
    pub outside: f64,
    /// Hazard of coming home, per second.
    pub home_per_s: f64,
}

/// Seconds of an hour.
const HOUR_S: f64 = 3_600.0;
/// Mean time out of the house, in seconds.
const OUT_S: f64 = 5.0 * HOUR_S;

impl Movement {
    /// Whether people usually sleep at a local hour.
    #[must_use]
    pub fn is_night(hour: u8) -> bool {
        !(6..23).contains(&hour)
    }

    /// Stays and destinations of a resident before the home is known. `hour` is the local hour, 0 to 23.
    #[must_use]
    pub fn usual(home: &Home, hour: u8) -> Self {
        let is_night = Self::is_night(hour);
        // Mean stay in seconds, probability to stay after entering, weight as a destination.
        let of = |usage: RoomUse| match usage {
            RoomUse::Bedroom if is_night => (3.0 * HOUR_S, 0.95, 0.5),
            RoomUse::Bedroom => (0.7 * HOUR_S, 0.9, 0.15),
            RoomUse::Bathroom => (420.0, 0.95, 0.15),
            RoomUse::Kitchen => (900.0, 0.9, 0.25),
            RoomUse::Living => (2_400.0, 0.9, 0.25),
            RoomUse::Office => (2_700.0, 0.95, 0.15),
            RoomUse::Hall => (30.0, 0.1, 0.02),
            RoomUse::Other => (900.0, 0.8, 0.08),
        };
        let rooms = || (0..home.rooms()).map(|room| of(home.usage(room)));
        Self {
            leave_per_s: rooms().map(|(stay_s, _, _)| 1.0 / stay_s).collect(),
            settle: rooms().map(|(_, settle, _)| settle).collect(),
            destination: rooms().map(|(_, _, weight)| weight).collect(),
            outside: if is_night { 0.005 } else { 0.06 },
            home_per_s: 1.0 / if is_night { 2.0 * OUT_S } else { OUT_S },
        }
    }

    /// An unknown person: stays in the living rooms, leaves after two hours. Each slot comes less often than visitors do: this rate also
    /// explains false alarms.
    #[must_use]
    pub fn visitor(home: &Home) -> Self {
        let mut own = Self::usual(home, 12);
        own.outside = 0.25;
        own.home_per_s = 1.0 / (60.0 * 24.0 * HOUR_S);
        own
    }

    /// Rate from one place to another, per second, as `visit(from, to, rate)`. A sensed door that is shut lets `leak` (per room with a way out) of the people through.
    fn rates(&self, home: &Home, leak: &[f64], forgets: f64, mut visit: impl FnMut(Place, Place, f64)) {
        let count = home.rooms();
        let exits: f64 = (0..count).map(|room| home.way_out(room)).sum();
        for (room, leak) in leak.iter().enumerate().take(count) {
            let crossing = 1.0 / home.crossing_s(room);
            let settle = self.settle[room].clamp(0.01, 0.99);
            let stands_up = self.leave_per_s[room].clamp(1e-7, 0.5) / (1.0 - settle);
            visit(settled(room), moving(room), stands_up);
            visit(still(room), moving(room), self.leave_per_s[room].clamp(1e-7, 0.5));
            let unseen = if home.usage(room) == RoomUse::Bedroom { STILL.1 } else { STILL.0 };
            visit(moving(room), settled(room), crossing * settle * (1.0 - unseen));
            visit(moving(room), still(room), crossing * settle * unseen);
            let goes = crossing * (1.0 - settle);
            let mut total = 0.0;
            for destination in (0..count).filter(|to| *to != room && home.hop(room, Some(*to)).is_some()) {
                total += self.destination[destination].max(1e-6);
            }
            let way_out = home.hop(room, None);
            let outside = if way_out.is_some() { self.outside.max(1e-6) } else { 0.0 };
            total += outside;
            if total <= 0.0 {
                continue;
            }
            for destination in 0..count {
                if let Some(next) = home.hop(room, Some(destination)).filter(|_| destination != room) {
                    visit(moving(room), moving(next), goes * self.destination[destination].max(1e-6) / total);
                }
            }
            match way_out {
                Some(next) if next == room => {
                    let leaves = goes * leak * outside / total;
                    visit(moving(room), ELSEWHERE, leaves * (1.0 - forgets));
                    visit(moving(room), PHONELESS, leaves * forgets);
                }
                Some(next) => visit(moving(room), moving(next), goes * outside / total),
                None => {}
            }
            if home.way_out(room) > 0.0 {
                let returns = self.home_per_s * leak * home.way_out(room) / exits;
                visit(ELSEWHERE, moving(room), returns);
                visit(PHONELESS, moving(room), returns);
            }
        }
    }
}

/// The unit of steps in seconds.
pub(super) const STEP_S: f64 = 0.5;
/// A step has at most so many units, or a multiple of them up to the longest.
pub(super) const FINE: usize = 8;
pub(super) const LONGEST: usize = 64;
/// Doubled steps, up to an hour, for forecasts.
const DOUBLED: usize = 14;
/// Less probable ways do not move a belief.
const LEAST: f32 = 1e-9;

/// The number of the table for a step of so many units.
fn table_of(units: usize) -> usize {
    if units <= FINE { units - 1 } else { units / FINE + FINE - 2 }
}

/// The phases times a matrix, a row per former phase.
pub(super) fn moved(own: &Phases, by: &[Phases; 4]) -> Phases {
    let mut to = [0.0; 4];
    for (share, row) in own.iter().zip(by) {
        to.iter_mut().zip(row).for_each(|(to, p)| *to += share * p);
    }
    to
}

/// A column within a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stay {
    /// The probability of each phase of those who stay, a row per former phase.
    pub(super) shares: [Phases; 4],
    /// Per phase: the probability to leave the column.
    pub(super) leave: Phases,
}

/// A way to another column within a step: the probability of each phase there, a row per phase here.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Way {
    /// The highest probability among the phases here.
    pub(super) most: f32,
    /// Per phase here: the probability of this way.
    pub(super) leave: Phases,
    pub(super) to: Column,
    pub(super) shares: [Phases; 4],
}

/// Transition probabilities of one person.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Transitions {
    places: usize,
    columns: Column,
    /// Over one, two, four and more units, row by row.
    doubled: Vec<Vec<f64>>,
    /// By step and column: the phases of those who stay, the ways to other columns, most probable first, and where these begin.
    stays: Vec<Stay>,
    ways: Vec<Way>,
    starts: Vec<usize>,
    /// Per place and place: the rate, for events that are transitions.
    rates: Vec<f64>,
}

impl Transitions {
    pub(super) fn new(home: &Home) -> Self {
        let places = places(home.rooms());
        let square = || vec![0.0; places * places];
        let doubled = (0..DOUBLED).map(|_| square()).collect();
        Self {
            places,
            columns: 1 + home.rooms() as Column,
            doubled,
            stays: Vec::new(),
            ways: Vec::new(),
            starts: Vec::new(),
            rates: square(),
        }
    }

    /// Fills the tables for these rates. The first is a Taylor series of the generator; the others are its powers.
    pub(super) fn fill(&mut self, home: &Home, movement: &Movement, leak: &[f64], forgets: f64) {
        let places = self.places;
        self.rates.fill(0.0);
        movement.rates(home, leak, forgets, |from, to, rate| {
            self.rates[usize::from(from) * places + usize::from(to)] += rate;
        });
        first(&self.rates, places, &mut self.doubled[0]);
        for level in 1..DOUBLED {
            let (before, own) = self.doubled.split_at_mut(level);
            square(&before[level - 1], places, &mut own[0]);
        }
        let (mut own, mut next) = (self.doubled[0].clone(), Vec::new());
        self.stays.clear();
        self.ways.clear();
        self.starts.clear();
        let columns = self.columns;
        for table in 0..=table_of(LONGEST) {
            if table > 0 {
                let more = &self.doubled[if table < FINE { 0 } else { FINE.ilog2() as usize }];
                product(&own, more, places, &mut next);
                std::mem::swap(&mut own, &mut next);
            }
            for from in 0..columns {
                let start = self.ways.len();
                self.starts.push(start);
                let ways = (0..columns).filter(|to| *to != from).map(|to| {
                    let shares = shares(&own, places, from, to);
                    let leave = shares.map(|row| row.iter().sum());
                    Way { most: leave.into_iter().fold(0.0, f32::max), leave, to, shares }
                });
                self.ways.extend(ways.filter(|way| way.most > LEAST));
                self.ways[start..].sort_unstable_by(|a, b| b.most.total_cmp(&a.most).then(a.to.cmp(&b.to)));
                let leave = |phase: usize| self.ways[start..].iter().map(|way| way.leave[phase]).sum();
                self.stays.push(Stay { shares: shares(&own, places, from, from), leave: std::array::from_fn(leave) });
            }
        }
        self.starts.push(self.ways.len());
    }

    /// Who stays in a column within a step of so many units, and where the others go, most probable first.
    pub(super) fn row(&self, units: usize, from: Column) -> (&Stay, &[Way]) {
        let row = table_of(units) * usize::from(self.columns) + usize::from(from);
        (&self.stays[row], &self.ways[self.starts[row]..self.starts[row + 1]])
    }

    /// Rates from a column to another, per second. A settled person stands up first: their rate is the rate at which they leave.
    pub(super) fn rates(&self, from: Column, to: Column) -> [Phases; 4] {
        let own = |from: usize, to: usize| self.rates[from * self.places + to];
        let walking = places_of(from).start;
        let all: f64 = (0..self.places).map(|to| own(walking, to)).sum();
        let mut rates = [[0.0; 4]; 4];
        for (row, from) in rates.iter_mut().zip(places_of(from)) {
            let stands_up = if from == walking || walking == 0 { 1.0 } else { own(from, walking) / all.max(1e-9) };
            let here = if walking == 0 { from } else { walking };
            row.iter_mut().zip(places_of(to)).for_each(|(rate, to)| *rate = (stands_up * own(here, to)) as f32);
        }
        rates
    }

    /// The distribution a time later, from a distribution over places. `own` and `spare` have one entry per place.
    pub(super) fn run(&self, horizon_s: f64, own: &mut Vec<f64>, spare: &mut Vec<f64>) {
        let mut left = (horizon_s / STEP_S) as usize;
        for (level, dense) in self.doubled.iter().enumerate().rev() {
            while left >> level > 0 {
                left -= 1 << level;
                spare.fill(0.0);
                for (p, row) in own.iter().zip(dense.chunks(self.places)).filter(|(p, _)| **p > 0.0) {
                    spare.iter_mut().zip(row).for_each(|(to, share)| *to += p * share);
                }
                std::mem::swap(own, spare);
            }
        }
    }
}

/// The probabilities of the phases of one column from those of another.
fn shares(dense: &[f64], places: usize, from: Column, to: Column) -> [Phases; 4] {
    let mut own = [[0.0; 4]; 4];
    for (row, from) in own.iter_mut().zip(places_of(from)) {
        row.iter_mut().zip(places_of(to)).for_each(|(own, to)| *own = dense[from * places + to] as f32);
    }
    own
}

/// The transition tables of all persons: first of unknown persons, then of each known person. Persons with equal movement share theirs.
#[derive(Debug, Clone)]
pub(super) struct Tables {
    movements: Arc<Vec<Movement>>,
    /// While the sensed front doors are shut, and while one is open; `None` until the next step fills them.
    filled: Vec<Option<[Arc<Transitions>; 2]>>,
    /// The tables of a number before its first fill.
    none: Arc<Transitions>,
}

impl Tables {
    pub(super) fn new(home: &Home) -> Self {
        let none = Arc::new(Transitions::new(home));
        Self { movements: Arc::new(vec![Movement::visitor(home)]), filled: vec![None], none }
    }

    pub(super) fn add(&mut self, movement: Movement) {
        Arc::make_mut(&mut self.movements).push(movement);
        self.filled.push(None);
    }

    pub(super) fn remove(&mut self, number: usize) {
        Arc::make_mut(&mut self.movements).remove(number);
        self.filled.remove(number);
    }

    pub(super) fn set(&mut self, number: usize, movement: &Movement) {
        if self.movements[number] != *movement {
            Arc::make_mut(&mut self.movements)[number].clone_from(movement);
            self.filled[number] = None;
        }
    }

    /// A front door was added: all persons move by other ways out, and as is usual at noon.
    pub(super) fn reset(&mut self, home: &Home) {
        let own = Arc::make_mut(&mut self.movements);
        own.fill(Movement::usual(home, 12));
        own[0] = Movement::visitor(home);
        self.filled.fill(None);
    }

    pub(super) fn are_full(&self) -> bool {
        self.filled.iter().all(Option::is_some)
    }

    /// Fills the missing tables. `leak` is the share of the people who pass a shut door, per room with a way out.
    pub(super) fn fill(&mut self, home: &Home, leak: &[f64]) {
        let (movements, filled) = (&self.movements, &mut self.filled);
        for number in 0..filled.len() {
            if filled[number].is_some() {
                continue;
            }
            // An unknown person has no phone to forget: one place less.
            let forgets = if number == 0 { 0.0 } else { FORGETS };
            let is_alike = |other: &usize| number > 0 && movements[*other] == movements[number];
            let alike = (1..filled.len()).filter(is_alike).find_map(|other| filled[other].clone());
            let new = |leak: &[f64]| {
                let mut own = Transitions::new(home);
                own.fill(home, &movements[number], leak, forgets);
                Arc::new(own)
            };
            filled[number] = alike.or_else(|| {
                let shut = new(leak);
                let is_same = leak.iter().all(|leak| *leak == 1.0);
                let open = if is_same { Arc::clone(&shut) } else { new(&vec![1.0; leak.len()]) };
                Some([shut, open])
            });
        }
    }

    /// The tables of a number; the second set while a sensed front door is open.
    pub(super) fn of(&self, number: usize, set: usize) -> &Transitions {
        self.filled[number].as_ref().map_or(&self.none, |own| &own[set])
    }
}

/// `exp(Q STEP_S)`: with the fastest rate of one in two seconds, four terms and a division by four leave an error below 1e-9.
fn first(rates: &[f64], places: usize, out: &mut Vec<f64>) {
    const QUARTERS: f64 = 4.0;
    let mut generator: Vec<f64> = rates.iter().map(|rate| rate * STEP_S / QUARTERS).collect();
    for place in 0..places {
        let row = place * places..(place + 1) * places;
        let leaves: f64 = generator[row.clone()].iter().sum();
        generator[row.start + place] -= leaves;
    }
    let mut term = vec![0.0; places * places];
    (0..places).for_each(|place| term[place * (places + 1)] = 1.0);
    let mut sum = term.clone();
    let mut next = vec![0.0; places * places];
    for order in 1..=6 {
        product(&term, &generator, places, &mut next);
        next.iter_mut().for_each(|own| *own /= f64::from(order));
        std::mem::swap(&mut term, &mut next);
        sum.iter_mut().zip(&term).for_each(|(sum, own)| *sum += own);
    }
    square(&sum, places, &mut next);
    square(&next, places, out);
    // Rounding must not lose anybody.
    for row in out.chunks_mut(places) {
        row.iter_mut().for_each(|own| *own = own.max(0.0));
        let all: f64 = row.iter().sum();
        row.iter_mut().for_each(|own| *own /= all);
    }
}

fn square(own: &[f64], places: usize, out: &mut Vec<f64>) {
    product(own, own, places, out);
}

fn product(a: &[f64], b: &[f64], places: usize, out: &mut Vec<f64>) {
    out.clear();
    out.resize(places * places, 0.0);
    for (row, out) in a.chunks(places).zip(out.chunks_mut(places)) {
        for (share, row) in row.iter().zip(b.chunks(places)).filter(|(share, _)| **share != 0.0) {
            out.iter_mut().zip(row).for_each(|(out, own)| *out += share * own);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn home() -> Home {
        let uses = [RoomUse::Bedroom, RoomUse::Hall, RoomUse::Bathroom];
        Home::new(&uses, &[(0, 1), (1, 2)], &[0.0, 1.0, 0.0]).unwrap()
    }

    #[test]
    fn rows_of_every_step_sum_to_one_and_follow_the_doors() {
        let home = home();
        let mut own = Transitions::new(&home);
        own.fill(&home, &Movement::usual(&home, 12), &[1.0; 3], FORGETS);
        for row in own.doubled.iter().flat_map(|dense| dense.chunks(own.places)) {
            assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-9 && row.iter().all(|p| *p >= 0.0));
        }
        // From and to a room, in the first and second phase.
        let reached = |units: usize, phase: usize, from: Column, to: Column| {
            own.row(units, from).1.iter().find(|way| way.to == to).map_or(0.0, |way| f64::from(way.shares[phase][0]))
        };
        assert!(reached(1, 0, 1, 3) < 0.1 * reached(1, 0, 1, 2), "the hall lies between");
        let doubled = |level: usize| own.doubled[level][usize::from(settled(0)) * own.places + usize::from(moving(2))];
        assert!((4..=6).all(|level| (reached(1 << level, 1, 1, 3) - doubled(level)).abs() < 1e-6));
        assert_eq!(own.rates(1, 3), [[0.0; 4]; 4]);
    }

    #[test]
    fn people_leave_a_room_at_the_given_hazard() {
        let home = home();
        let mut movement = Movement::usual(&home, 12);
        movement.leave_per_s[0] = 1.0 / 1_800.0;
        let mut own = Transitions::new(&home);
        own.fill(&home, &movement, &[1.0; 3], FORGETS);
        let mut start = vec![0.0; own.places];
        start[usize::from(settled(0))] = 1.0;
        own.run(60.0, &mut start, &mut vec![0.0; 11]);
        let left = 1.0 - [settled(0), still(0), moving(0)].map(|place| start[usize::from(place)]).iter().sum::<f64>();
        // Some of them came back.
        assert!(left > 0.5 * 60.0 / 1_800.0 && left < 60.0 / 1_800.0, "{left}");
    }
}
