//! Habits of one home, learned while the persons are observed. The language model is the prior: it is one of the experts of a mixture. The loss of the
//! mixture exceeds that of its best expert by a bound at most (`mixture.rs`). Counts are kept by name, so that they survive changes of the map.
//!
//! A daemon calls `bind` for each map, `observe` for each sentence about a thing, `mix` and `next_rooms` for the model's scores, `be` and `come_back` for
//! presence, `tick` once a minute, `at_times` and `room_set` for forecasts of places, and `stored` for the state database.
//!
//! This module reads no clock and no file. Times are seconds since 1970 in local time, because the hour of the day matters. An observation in known
//! contexts allocates nothing.

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

use context::{Context, LAST, NONE, Number, SLOT_MASK, key, minute, split, time_class};
use counts::Counts;
use names::{ELSEWHERE, ELSEWHERE_NAME, Home, Names};
use next::Next;
use parts::names_of;
use stays::Stays;
use view::{OTHERS_MAX, View};

pub use context::{PART_HOURS, PARTS, Without};
pub use sets::AdaptiveSets;
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
    /// Most contexts: 40 bytes each.
    pub contexts_max: usize,
    /// Most counts: 8 bytes each, up to 16 while a context grows.
    pub counts_max: usize,
    /// Most names of things. A further thing replaces the one with the fewest counts.
    pub names_max: usize,
    /// Share of moments in which a room set must hold the person, 0 to 1.
    pub coverage: f64,
    /// Parts of the forecasts that are left out, to measure their effect.
    pub without: Without,
}

impl Default for HabitsOptions {
    /// At most 5 MiB.
    fn default() -> Self {
        Self {
            learn: true,
            half_life_days: 60.0,
            // As many as a table of 2^16 places holds.
            contexts_max: 7 << 13,
            counts_max: 1 << 17,
            names_max: 2_048,
            coverage: 0.9,
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
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
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
    /// Decayed observations of this person: all, after the last thing, the last two and three. Of a room: in it, after the last two and three.
    pub observations: Vec<f64>,
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
    /// Bytes of contexts and counts in memory.
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
            known: None,
            things: Next::new([&next::AGAIN, &next::THINGS], next::FIRST[0], options.without),
            rooms: Next::new([&next::ROOMS, &next::ROOMS], next::FIRST[1], options.without),
            stays: Stays::new(options.coverage, options.without),
        }
    }

    /// Observations, plus minutes in a known place.
    fn known_of(&self) -> f64 {
        self.observations + self.stays.watched_min()
    }

    fn context(&self, at_s: f64) -> Context {
        let Self { pace_s, last, times, stays, .. } = self;
        let [spent, pace] = [at_s - stays.entered_s, *pace_s].map(time_class);
        Context::new(stays.place, spent, at_s).after(last, *times, pace)
    }

    /// Adds a thing, or an unmapped one, to the context.
    fn turn(&mut self, number: Option<u16>) {
        let number = number.unwrap_or(NONE);
        let is_again = number == self.last[0];
        self.times = if is_again && number != NONE { self.times.saturating_add(1) } else { 0 };
        if !is_again {
            self.last.rotate_right(1);
            self.last[0] = number;
        }
    }

    /// A name lost its number.
    fn forget_name(&mut self, is: Number, number: u16) {
        self.known = None;
        match is {
            Number::Place => self.stays.forget_place(number),
            _ => self.last.iter_mut().filter(|own| **own == number).for_each(|own| *own = NONE),
        }
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
        places.add(ELSEWHERE_NAME.to_owned(), || None);
        places.bind(vec![ELSEWHERE_NAME.to_owned()]);
        Self {
            home: Home { things: Names::new(options.names_max), places, shares: Vec::new() },
            counts: Counts::new(options.contexts_max, options.counts_max, half_life_min),
            persons: Vec::new(),
            options,
        }
    }

    /// The options.
    #[must_use]
    pub fn options(&self) -> &HabitsOptions {
        &self.options
    }

    /// Binds a map: its labels and its rooms, each name once, and row by row per label and room the share of the label's items in that room.
    pub fn bind(&mut self, labels: Vec<String>, mut rooms: Vec<String>, shares: Vec<f64>) {
        rooms.push(ELSEWHERE_NAME.to_owned());
        let are_same_rooms = self.home.places.bound == rooms;
        self.home.things.bind(labels);
        self.home.places.bind(rooms);
        self.home.shares = shares;
        let nexts = self.persons.iter_mut().flat_map(|person| [&mut person.things, &mut person.rooms]);
        nexts.for_each(Next::forget_forecast);
        if !are_same_rooms {
            self.drop_waiting();
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
        let least = self.persons.iter().min_by(|a, b| a.known_of().total_cmp(&b.known_of()));
        if let Some(least) = least.map(|person| person.number).filter(|_| self.persons.len() >= PERSONS_MAX) {
            self.forget(least);
        }
        let free = |slot: &u8| self.persons.iter().all(|person| person.slot != *slot);
        let slot = (0..PERSONS_MAX as u8).find(free).unwrap_or(0);
        self.persons.push(Person::new(number, slot, &self.options));
        self.persons.len() - 1
    }

    fn view(&mut self, number: PersonId, now_s: f64) -> (View<'_>, &mut Person) {
        let at = self.person(number);
        // The other persons with the most observations, and one place for the next.
        let mut others = [(0.0, None); OTHERS_MAX + 1];
        for other in self.persons.iter().filter(|other| other.number != number) {
            others[OTHERS_MAX] = (other.known_of(), Some(other.slot));
            others.sort_by(|a, b| b.0.total_cmp(&a.0));
        }
        let Self { persons, counts, home, options: HabitsOptions { without, learn: learns, .. } } = self;
        let (person, now_min) = (&mut persons[at], minute(now_s));
        (View { counts, home, slot: person.slot, others, now_min, without: *without, learns: *learns }, person)
    }

    /// The number of a name of the map. While learning, a new name gets one. At the limit it gets the number of the name with the fewest counts, and
    /// these counts are dropped. Digests with that name stay: they are used again only if the same other things surround the new one.
    fn number_of(&mut self, is: Number, index: usize, now_min: u32) -> Option<u16> {
        let Self { home, counts, persons, options, .. } = self;
        // Elsewhere stays.
        let (names, first) = if is == Number::Place { (&mut home.places, 1) } else { (&mut home.things, 0) };
        if !options.learn {
            return names.number(index);
        }
        let known = names.names.len();
        names.learn(index, || {
            let mut times = vec![0.0; known];
            for (key, seen) in counts.all(now_min) {
                let counted =
                    seen.symbols().filter(|(symbol, _)| names_of(key, *symbol).next_back() == Some((is, *symbol)));
                counted.for_each(|(symbol, count)| times[usize::from(symbol)] += count);
            }
            let least = (first..known).min_by(|a, b| times[*a].total_cmp(&times[*b]))? as u16;
            counts.retain(|key, symbol| names_of(key, symbol).all(|name| name != (is, least)));
            persons.iter_mut().for_each(|person| person.forget_name(is, least));
            Some(least)
        })
    }

    /// The number of a place, as in [`Habits::number_of`].
    fn place_number(&mut self, place: Place, at_s: f64) -> Option<u16> {
        let rooms = self.home.rooms();
        let index = match place {
            Place::Elsewhere => rooms,
            Place::Room(room) => Some(room).filter(|room| *room < rooms)?,
        };
        self.number_of(Number::Place, index, minute(at_s))
    }

    /// Learns from a turn: the last forecasts are compared with it, it is counted, and it becomes the context of the next forecast.
    pub fn observe(&mut self, turn: &Turn) {
        let Turn { label, room, at_s, .. } = *turn;
        let number = label.and_then(|label| self.number_of(Number::Thing, label, minute(at_s)));
        let place = room.and_then(|room| self.place_number(Place::Room(room), at_s));
        let (mut view, person) = self.view(turn.person, at_s);
        let context = person.known.unwrap_or_else(|| person.context(at_s));
        let Person { things, rooms, known, observations, .. } = &mut *person;
        if view.learns {
            if let Some((room, place)) = room.zip(place) {
                rooms.learn_weights(room);
                if known.is_some() {
                    rooms.other.count(&mut view, &context, place, at_s);
                }
                if let Some(thing) = number {
                    view.count(&next::OF_THING, &context.of_thing(thing), (place, 1.0), at_s);
                }
            }
            if let Some((label, number)) = label.zip(number) {
                things.learn_weights(label);
                things.count_thing(&mut view, &context, number, at_s);
            }
            *observations += 1.0;
        }
        if number.is_some() || place.is_some() {
            [things, rooms].into_iter().for_each(Next::forget_forecast);
        }
        if let Some(place) = place {
            person.stays.be(&mut view, place, at_s);
        }
        person.turn(number);
        person.pace_s = at_s - person.last_s;
        person.last_s = person.last_s.max(at_s);
        person.known = Some(person.context(at_s));
    }

    /// Puts a person in a place without a turn: a presence event or a sensor reported it.
    pub fn be(&mut self, person: PersonId, place: Place, at_s: f64) {
        if let Some(number) = self.place_number(place, at_s) {
            self.go(person, number, at_s);
        }
    }

    /// The person's place is unknown from now on.
    pub fn lose(&mut self, person: PersonId, at_s: f64) {
        self.go(person, NONE, at_s);
    }

    /// Puts a person, absent before, into an unknown room of the house. The next forecasts use the earlier returns.
    pub fn come_back(&mut self, person: PersonId, at_s: f64) {
        let at = self.person(person);
        if self.persons[at].stays.place == ELSEWHERE {
            self.go(person, NONE, at_s);
            self.persons[at].stays.is_back = true;
        }
    }

    fn go(&mut self, person: PersonId, place: u16, at_s: f64) {
        let (mut view, person) = self.view(person, at_s);
        person.stays.be(&mut view, place, at_s);
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
        let learn = std::mem::replace(&mut self.options.learn, false);
        for at in 0..self.persons.len() {
            let (mut view, person) = self.view(self.persons[at].number, now_s);
            person.stays.learn_due(&mut view, now_s);
        }
        self.options.learn = learn;
    }

    /// Moves times of stays after a clock step of `by_s` seconds, so that no stay gets longer or shorter.
    pub fn shift_clock(&mut self, by_s: f64) {
        for person in &mut self.persons {
            person.last_s += by_s;
            person.stays.shift_clock(by_s);
        }
    }

    /// Moves counts after a clock step of `by_s` seconds, so that their age stays the same. Counts dated later than `now_s` are dated `now_s`: they
    /// would not fade until then.
    pub fn shift_counts(&mut self, by_s: f64, now_s: f64) {
        let (by_min, now_min) = ((by_s / 60.0) as i64, minute(now_s));
        for touched_min in self.counts.touched_min() {
            let moved_min = i64::from(*touched_min).saturating_add(by_min).max(0);
            *touched_min = u32::try_from(moved_min).unwrap_or(u32::MAX).min(now_min);
        }
    }

    /// Per label of the map, the probability that the person turns to it next. The model's probabilities need not sum to one. The next turn teaches.
    pub fn mix(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let (view, person) = self.view(person, at_s);
        let context = *person.known.insert(person.context(at_s));
        person.things.things(&view, &context, model);
        &person.things.mixed
    }

    /// Per room of the map, the probability that the next thing is there. It uses the forecast of [`Habits::mix`]. The next turn teaches.
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
        let (mut view, Person { stays, .. }) = self.view(person, now_s);
        stays.learn_due(&mut view, now_s);
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

    /// The places of the set with the promised coverage, for probabilities of [`Habits::at_times`]. If the person's place is unknown, or `another` kind of
    /// forecast is given, no threshold was learned: the set then takes the likeliest places up to the coverage.
    pub fn room_set(&mut self, person: PersonId, horizon_s: f64, p: &[f64], another: bool, set: &mut Vec<bool>) {
        let (at, another) = (self.person(person), another || self.place(person).is_none());
        self.persons[at].stays.set(horizon_s, p, another, set);
    }

    /// Per room of the bound map, decayed number of visits that ended in each part of the day, of all persons together.
    #[must_use]
    pub fn visits(&self, now_s: f64) -> Vec<[f64; PARTS]> {
        let of_person = |person: &Person, place, part| {
            let key = key(leaving::EXIT[1].part.number, person.slot, [place, part as u16, NONE]);
            self.counts.get(key, minute(now_s)).map_or(0.0, |seen| seen.sum())
        };
        let ended = |place, part| self.persons.iter().map(|person| of_person(person, place, part)).sum();
        let rooms = (0..self.home.rooms()).map(|room| self.home.places.number(room));
        rooms.map(|place| std::array::from_fn(|part| place.map_or(0.0, |place| ended(place, part)))).collect()
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
        Learned {
            observations: self.persons.iter().map(|person| person.observations).sum(),
            persons: self.persons.len(),
            names: self.home.things.names.len(),
            contexts,
            counts,
            bytes: self.counts.bytes(),
        }
    }

    /// Forgets a person. Returns false if the person had no habits.
    pub fn forget(&mut self, person: PersonId) -> bool {
        let Some(at) = self.persons.iter().position(|other| other.number == person) else { return false };
        let slot = self.persons.remove(at).slot;
        self.counts.retain(|key, _| split(key).1 & SLOT_MASK != slot);
        true
    }
}

#[cfg(test)]
mod tests;
