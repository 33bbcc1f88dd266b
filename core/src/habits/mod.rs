//! Habits of one home, learned while the persons are observed. The language model is the prior.
//!
//! The first day's forecasts are the language model's. Later forecasts also use the learned counts. The loss of the mixture exceeds its best expert's
//! loss by a bound at most (`mixture.rs`), and the model is one of the experts. Counts are kept by name, so that they survive changes of the map.
//!
//! Calls of a daemon, per person:
//!
//! ```text
//! map loaded or changed   bind(labels, rooms, shares)
//! sentence with a thing   observe(...)                 the last forecast is compared, then counts are learned
//! model's scores          mix(...)  -> label probabilities     next_rooms(...) -> room probabilities
//! presence, room seen     be(...)               come_back(...) into an unknown room
//! about once a minute     tick(...)                    forecasts whose time has come are learned from
//! forecast wanted         at_times(...) -> probabilities of the places     room_set(...) -> a set with a promise
//! now and then, at exit   stored() -> the state database
//! ```
//!
//! This module reads no clock and no file. Times are seconds since 1970 in local time, because the hour of the day matters. After warm-up an
//! observation allocates nothing.

use crate::grounding::{Grounding, partition_names};
use crate::ids::PersonId;

mod context;
mod counts;
mod leaving;
mod mixture;
mod names;
mod next;
mod parts;
mod pool;
mod sets;
mod stays;
mod stored;
mod view;

use context::{Context, LAST, minute, time_class};
use counts::Counts;
use names::{ELSEWHERE_NAME, Home, Names};
use next::Next;
use parts::{NONE, Part, SLOT_MASK, key, split};
use stays::Stays;
use view::{OTHERS_MAX, View};

pub use context::{PART_HOURS, PARTS};
pub use parts::Without;
pub use sets::{AdaptiveSets, SetOptions};
pub use stored::{BYTES_MAX, Stored, StoredError, StoredName, StoredPerson, StoredRow};

/// Most persons with habits. A further person replaces the person with the fewest observations.
pub const PERSONS_MAX: usize = 64;

/// How habits are learned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HabitsOptions {
    /// Whether habits are learned. Forecasts use learned habits either way.
    pub learn: bool,
    /// Half-life of counts, in days; 0 for no decay.
    pub half_life_days: f64,
    /// Most contexts: 20 bytes each.
    pub contexts_max: usize,
    /// Most blocks of up to four counts: 28 bytes each.
    pub blocks_max: usize,
    /// Most names of things.
    pub names_max: usize,
    /// Options of room sets.
    pub sets: SetOptions,
    /// Parts of the forecasts that are left out, to measure their effect.
    pub without: Without,
}

impl Default for HabitsOptions {
    /// At most 3.6 MiB.
    fn default() -> Self {
        Self {
            learn: true,
            half_life_days: 60.0,
            contexts_max: 1 << 16,
            blocks_max: 1 << 16,
            names_max: 2_048,
            sets: SetOptions::default(),
            without: Without::default(),
        }
    }
}

/// A thing that a person turned to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// The person.
    pub person: PersonId,
    /// The label's index in the bound map, if the sentence mentions a label.
    pub label: Option<usize>,
    /// The room's index in the bound map, if the room is known.
    pub room: Option<usize>,
    /// Time in seconds since 1970, local time.
    pub at_s: f64,
}

/// Where a person is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// In a room of the bound map.
    Room(usize),
    /// Out of the house, or outside the map.
    Elsewhere,
}

/// The parts of the probability that a thing comes next, or that it is in a room; the shares sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Shares {
    /// The probability.
    pub probability: f64,
    /// Share of the language model, alone and as the prior of habit.
    pub model: f64,
    /// Share of the things or rooms that followed the last things in this home; for a room, also of this room and this time spent.
    pub habit: f64,
    /// Share of the expected next thing and its known rooms; of a room only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub things: Option<f64>,
    /// Share of the part of the day.
    pub hour: f64,
    /// Decayed observations of this person: all (of a room: in this room), after the last thing, the last two and the last three.
    pub observations: [f64; 4],
}

/// Weights of the forecasts of a later place; they sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct WhenShares {
    /// The forecast without habits.
    pub shipped: f64,
    /// Length and destination of stays.
    pub leaving: f64,
    /// The person's places the same time later, in the past.
    pub later: f64,
}

/// Amount of learned data.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Learned {
    /// Observations learned from.
    pub observations: f64,
    /// Persons.
    pub persons: usize,
    /// Names of things.
    pub names: usize,
    /// Contexts.
    pub contexts: usize,
    /// Counts.
    pub counts: usize,
    /// Bytes of memory.
    pub bytes: usize,
}

#[derive(Debug, Clone)]
struct Person {
    number: PersonId,
    slot: u8,
    observations: f64,
    last_s: f64,
    /// Time between the last two observations.
    pace_s: f64,
    /// The last different things, the latest first, and the number of repeated mentions of the latest.
    last: [u16; LAST],
    times: u8,
    /// Repeated mentions, and all mentions.
    repeated: [f64; 2],
    /// The context of the latest forecast, or of the last observation.
    known: Option<Context>,
    things: Next,
    rooms: Next,
    stays: Stays,
}

impl Person {
    fn new(number: PersonId, slot: u8, options: &HabitsOptions) -> Self {
        Self {
            number,
            slot,
            observations: 0.0,
            last_s: f64::NEG_INFINITY,
            pace_s: f64::INFINITY,
            last: [NONE; LAST],
            times: 0,
            repeated: [1.0, 2.0],
            known: None,
            things: Next::new([&next::AGAIN, &next::THINGS], next::FIRST[0], options.without),
            rooms: Next::new([&next::ROOMS, &next::ROOMS], next::FIRST[1], options.without),
            stays: Stays::new(options.sets, options.without),
        }
    }

    /// Observations, plus minutes in a known place.
    fn known_of(&self) -> f64 {
        self.observations + self.stays.watched_min()
    }

    fn context(&self, at_s: f64) -> Context {
        let Self { pace_s, last, times, stays, .. } = self;
        let [spent, pace] = [at_s - stays.entered_s, *pace_s].map(time_class);
        Context { here: stays.place, last: *last, times: *times, spent, pace, horizon: 0, at_s }
    }

    /// Adds a thing, or an unmapped one, to the context.
    fn turn(&mut self, number: Option<u16>) {
        let number = number.unwrap_or(NONE);
        if number == self.last[0] {
            self.times = if number == NONE { 0 } else { self.times.saturating_add(1) };
            return;
        }
        self.times = 0;
        self.last.rotate_right(1);
        self.last[0] = number;
    }
}

/// Habits of one home.
#[derive(Debug, Clone)]
pub struct Habits {
    options: HabitsOptions,
    home: Home,
    counts: Counts,
    persons: Vec<Person>,
}

impl Habits {
    /// Habits without data and without a map.
    #[must_use]
    pub fn new(options: HabitsOptions) -> Self {
        let half_life_min = options.half_life_days * 1_440.0;
        let mut places = Names::new(1_024);
        // Elsewhere has the first number.
        places.add(ELSEWHERE_NAME.to_owned());
        places.bind(vec![ELSEWHERE_NAME.to_owned()]);
        Self {
            home: Home { things: Names::new(options.names_max), places, shares: Vec::new() },
            counts: Counts::new(options.contexts_max, options.blocks_max, half_life_min),
            persons: Vec::new(),
            options,
        }
    }

    /// The options.
    #[must_use]
    pub fn options(&self) -> &HabitsOptions {
        &self.options
    }

    /// Binds a map: its scored labels and its rooms, each name once, and row by row per label and room the share of the label's items in that room.
    /// Counts are kept.
    pub fn bind(&mut self, labels: Vec<String>, mut rooms: Vec<String>, shares: Vec<f64>) {
        rooms.push(ELSEWHERE_NAME.to_owned());
        let are_same_rooms = self.home.places.bound() == rooms;
        self.home.things.bind(labels);
        self.home.places.bind(rooms);
        self.home.shares = shares;
        for person in &mut self.persons {
            person.things.forget_forecast();
            person.rooms.forget_forecast();
            if !are_same_rooms {
                person.stays.forget_forecasts();
            }
        }
    }

    /// Drops forecasts that wait for their outcome, because the outcome will not be observed.
    pub fn drop_waiting(&mut self) {
        self.persons.iter_mut().for_each(|person| person.stays.forget_forecasts());
    }

    /// Binds the map of a grounding: its labels, its rooms by name ([`partition_names`]), and the items in them.
    pub fn bind_to(&mut self, grounding: &Grounding) {
        let labels = grounding.label_texts().iter().map(|text| (*text).to_owned()).collect();
        // No room may have the name of elsewhere.
        let own = |name: String| if name == ELSEWHERE_NAME { format!("room {name}") } else { name };
        let rooms = partition_names(grounding.partitions()).into_iter().map(own);
        let weights = grounding.weights();
        let shares = (0..weights.rows()).flat_map(|label| weights.row(label));
        self.bind(labels, rooms.collect(), shares.copied().collect());
    }

    /// Turns learning on or off. Forecasts use learned habits either way.
    pub fn set_learning(&mut self, learn: bool) {
        self.options.learn = learn;
    }

    /// Number of rooms of the map, plus elsewhere, the last place.
    #[must_use]
    pub fn places(&self) -> usize {
        self.home.places()
    }

    fn known_person(&self, number: PersonId) -> Option<&Person> {
        self.persons.iter().find(|person| person.number == number)
    }

    fn person(&mut self, number: PersonId) -> usize {
        if let Some(at) = self.persons.iter().position(|person| person.number == number) {
            return at;
        }
        if self.persons.len() >= PERSONS_MAX {
            let least = |a: &&Person, b: &&Person| a.known_of().total_cmp(&b.known_of());
            if let Some(least) = self.persons.iter().min_by(least).map(|person| person.number) {
                self.forget(least);
            }
        }
        let free = |slot: &u8| self.persons.iter().all(|person| person.slot != *slot);
        let slot = (0..PERSONS_MAX as u8).find(free).unwrap_or(0);
        self.persons.push(Person::new(number, slot, &self.options));
        self.persons.len() - 1
    }

    fn view(&mut self, number: PersonId, now_s: f64) -> (View<'_>, &mut Person) {
        let at = self.person(number);
        // The other persons with the most observations.
        let mut others = [None; OTHERS_MAX];
        let mut least = [0.0; OTHERS_MAX];
        for other in self.persons.iter().filter(|other| other.number != number) {
            if let Some(rank) = (0..OTHERS_MAX).find(|rank| other.known_of() > least[*rank]) {
                others[rank..].rotate_right(1);
                least[rank..].rotate_right(1);
                (others[rank], least[rank]) = (Some(other.slot), other.known_of());
            }
        }
        let Self { persons, counts, home, options, .. } = self;
        let person = &mut persons[at];
        (View { counts, home, slot: person.slot, others, now_min: minute(now_s), without: options.without }, person)
    }

    /// The number of a place. While learning, a new one gets a number.
    fn number_of(&mut self, place: Place) -> Option<u16> {
        let rooms = self.home.rooms();
        let index = match place {
            Place::Elsewhere => rooms,
            Place::Room(room) => Some(room).filter(|room| *room < rooms)?,
        };
        self.home.places.learn(index, self.options.learn)
    }

    /// Learns from a turn: the last forecasts are compared with it, it is counted, and it becomes the context of the next forecast.
    pub fn observe(&mut self, turn: &Turn) {
        let (now_min, at) = (minute(turn.at_s), self.person(turn.person));
        let number = turn.label.and_then(|label| self.home.things.learn(label, self.options.learn));
        let place = turn.room.and_then(|room| self.number_of(Place::Room(room)));
        let Self { persons, counts, options: HabitsOptions { learn, .. }, home, .. } = self;
        let person = &mut persons[at];
        let context = person.known.unwrap_or_else(|| person.context(turn.at_s));
        let Person { slot, things, rooms, stays, repeated, known, .. } = person;
        if *learn {
            if let Some((room, place)) = turn.room.zip(place) {
                rooms.learn_weights(room);
                if known.is_some() {
                    rooms.other.count(counts, *slot, &context, place, turn.at_s);
                }
                if let Some(thing) = number {
                    counts.add(key(Part::RoomOfThing, *slot, [thing, NONE, NONE]), place, 1.0, now_min);
                }
            }
            if let Some((label, number)) = turn.label.zip(number) {
                if let Some(is_same) = things.learn_weights(label) {
                    *repeated = [repeated[0] + f64::from(u8::from(is_same)), repeated[1] + 1.0];
                }
                things.count_thing(counts, *slot, &context, number, turn.at_s);
            }
            person.observations += 1.0;
        }
        if number.is_some() || place.is_some() {
            things.forget_forecast();
            rooms.forget_forecast();
        }
        if let Some(place) = place {
            stays.learn_due(counts, *slot, home, turn.at_s, *learn);
            stays.be(counts, *slot, place, turn.at_s, *learn);
        }
        person.turn(number);
        person.pace_s = turn.at_s - person.last_s;
        person.last_s = person.last_s.max(turn.at_s);
        person.known = Some(person.context(turn.at_s));
    }

    /// Puts a person in a place without a turn: a presence event or a sensor reported it.
    pub fn be(&mut self, person: PersonId, place: Place, at_s: f64) {
        if let Some(number) = self.number_of(place) {
            self.moves(person, at_s, |stays, counts, slot, learn| stays.be(counts, slot, number, at_s, learn));
        }
    }

    /// The person's place is unknown from now on.
    pub fn lose(&mut self, person: PersonId, at_s: f64) {
        self.moves(person, at_s, |stays, counts, slot, learn| stays.be(counts, slot, NONE, at_s, learn));
    }

    /// Puts a person, absent before, into an unknown room of the house. The next forecasts use the earlier returns.
    pub fn come_back(&mut self, person: PersonId, at_s: f64) {
        self.moves(person, at_s, |stays, counts, slot, learn| stays.come_back(counts, slot, at_s, learn));
    }

    /// Due forecasts learn first: their outcome is the place before the move.
    fn moves(&mut self, person: PersonId, at_s: f64, go: impl FnOnce(&mut Stays, &mut Counts, u8, bool)) {
        let at = self.person(person);
        let Self { persons, counts, home, options: HabitsOptions { learn, .. }, .. } = self;
        let Person { slot, stays, .. } = &mut persons[at];
        stays.learn_due(counts, *slot, home, at_s, *learn);
        go(stays, counts, *slot, *learn);
    }

    /// Whether the person came back and has no known room since.
    #[must_use]
    pub fn is_back(&self, person: PersonId) -> bool {
        self.known_person(person).is_some_and(|person| person.stays.is_back)
    }

    /// The last known place, if it is in the bound map.
    #[must_use]
    pub fn place(&self, person: PersonId) -> Option<Place> {
        let place = self.home.places.index(self.known_person(person)?.stays.place)?;
        Some(if place == self.home.rooms() { Place::Elsewhere } else { Place::Room(place) })
    }

    /// Skips unobserved time until `now_s`: it is not counted, and due forecasts do not learn from it.
    pub fn pass(&mut self, now_s: f64) {
        let Self { persons, counts, home, .. } = self;
        for Person { slot, stays, .. } in persons {
            stays.learn_due(counts, *slot, home, now_s, false);
        }
    }

    /// Moves times of stays after a clock step of `by_s` seconds, so that no stay gets longer or shorter.
    pub fn shift_clock(&mut self, by_s: f64) {
        for person in &mut self.persons {
            person.last_s += by_s;
            person.stays.shift_clock(by_s);
        }
    }

    /// Moves counts after a clock step of `by_s` seconds, so that their age stays the same. Counts from a clock that was ahead of `now_s` are dated
    /// as of then. Otherwise they would not fade until then, and would outweigh new counts.
    pub fn shift_counts(&mut self, by_s: f64, now_s: f64) {
        let (by_min, now_min) = ((by_s / 60.0) as i64, minute(now_s));
        for touched_min in self.counts.touched_min() {
            let moved_min = i64::from(*touched_min).saturating_add(by_min).max(0);
            *touched_min = u32::try_from(moved_min).unwrap_or(u32::MAX).min(now_min);
        }
    }

    /// Per label of the map, the probability that the person turns to it next. `model` has the model's probabilities, which need not sum to one. The
    /// next turn is compared with the result.
    pub fn mix(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let (view, person) = self.view(person, at_s);
        let context = *person.known.insert(person.context(at_s));
        person.things.things(&view, &context, person.repeated, model);
        &person.things.mixed
    }

    /// Per room of the map, the probability that the next thing is there. Call it after [`Habits::mix`], whose forecast it uses. The next turn is
    /// compared with the result.
    pub fn next_rooms(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let (view, person) = self.view(person, at_s);
        let context = *person.known.insert(person.context(at_s));
        person.rooms.rooms(&view, &context, model, &person.things.mixed);
        &person.rooms.mixed
    }

    /// The shares of a label's probability in the person's latest forecast.
    #[must_use]
    pub fn explain(&self, person: PersonId, label: usize) -> Option<Shares> {
        Some(Shares { things: None, ..self.known_person(person)?.things.explain(label)? })
    }

    /// The shares of a room's probability in the person's latest forecast of the next room.
    #[must_use]
    pub fn explain_room(&self, person: PersonId, room: usize) -> Option<Shares> {
        self.known_person(person)?.rooms.explain(room)
    }

    /// Counts time spent and learns from due forecasts. Once a minute it makes one more forecast to learn from later. `shipped` writes the forecast
    /// without habits, so many seconds ahead, per place; elsewhere comes last.
    pub fn tick(&mut self, person: PersonId, now_s: f64, shipped: &mut dyn FnMut(f64, &mut [f64])) {
        self.moves(person, now_s, |_, _, _, _| {});
        let (view, Person { stays, .. }) = self.view(person, now_s);
        stays.sample(&view, now_s, shipped);
    }

    /// Writes per time ahead (ascending) and place (elsewhere last) the person's probability, row by row into `out`, and returns the weights of the
    /// forecasts. `shipped` writes the forecast without habits, which is also the result without learned habits.
    pub fn at_times(
        &mut self,
        person: PersonId,
        (now_s, horizons_s): (f64, &[f64]),
        shipped: &[f64],
        out: &mut Vec<f64>,
        shares: &mut Vec<WhenShares>,
    ) {
        let (view, Person { stays, .. }) = self.view(person, now_s);
        let cells = horizons_s.len() * view.home.places();
        out.clear();
        out.extend_from_slice(&shipped[..cells.min(shipped.len())]);
        out.resize(cells, 0.0);
        shares.clear();
        stays.forecast(&view, (now_s, horizons_s), out, |[shipped, leaving, by_place, later], _| {
            shares.push(WhenShares { shipped, leaving, later: by_place + later });
        });
    }

    /// The places of the set with the promised coverage, for probabilities of [`Habits::at_times`] for that time. If the person's place is unknown,
    /// or `another` kind of forecast is given, no threshold was learned: the set then takes the likeliest places up to the coverage.
    pub fn room_set(
        &mut self,
        person: PersonId,
        horizon_s: f64,
        probabilities: &[f64],
        another: bool,
        set: &mut Vec<bool>,
    ) {
        let (at, another) = (self.person(person), another || self.place(person).is_none());
        self.persons[at].stays.set(horizon_s, probabilities, another, set);
    }

    /// Per room of the bound map, decayed number of visits that ended in each part of the day, of all persons together.
    #[must_use]
    pub fn visits(&self, now_s: f64) -> Vec<[f64; PARTS]> {
        let now_min = minute(now_s);
        let ended = |place: u16, part: u16| -> f64 {
            let of = |slot| self.counts.get(key(Part::ExitByHour, slot, [place, part, NONE]), now_min);
            let seen = self.persons.iter().filter_map(|person| of(person.slot));
            seen.map(|seen| seen.symbols().map(|(_, count)| count).sum::<f64>()).sum()
        };
        let room = |room| {
            let place = self.home.places.number(room);
            std::array::from_fn(|part| place.map_or(0.0, |place| ended(place, part as u16)))
        };
        (0..self.home.rooms()).map(room).collect()
    }

    /// Minutes for which the person's place was known, about.
    #[must_use]
    pub fn watched_min(&self, person: PersonId) -> f64 {
        self.known_person(person).map_or(0.0, |person| person.stays.watched_min())
    }

    /// Persons with observations, and their number of observations.
    pub fn persons(&self) -> impl Iterator<Item = (PersonId, f64)> {
        self.persons.iter().map(|person| (person.number, person.observations))
    }

    /// Amount and size of learned data.
    #[must_use]
    pub fn learned(&self) -> Learned {
        let (contexts, counts) = self.counts.len();
        let Home { things, places, .. } = &self.home;
        Learned {
            observations: self.persons.iter().map(|person| person.observations).sum(),
            persons: self.persons.len(),
            names: things.names().len(),
            contexts,
            counts,
            bytes: self.counts.bytes() + things.bytes() + places.bytes(),
        }
    }

    /// Forgets a person. Returns false if the person had no habits.
    pub fn forget(&mut self, person: PersonId) -> bool {
        let Some(at) = self.persons.iter().position(|other| other.number == person) else { return false };
        let slot = self.persons.remove(at).slot;
        self.counts.retain(|key| split(key).1 & SLOT_MASK != slot);
        true
    }
}

#[cfg(test)]
mod tests;
