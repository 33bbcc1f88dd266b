//! What the people of one home do: learned while watching, over the language model as the prior.
//!
//! On the first day the forecasts are those of the language model, later those of the home. A mixture with a bound decides (`mixture.rs`): its loss
//! exceeds that of its best expert, the model among them, by no more than the bound, if what happened is known at once. Counts go by names, so that
//! they survive changes of the map. Everything has a limit, and counts fade with a half-life.
//!
//! How a daemon uses it, per person:
//!
//! ```text
//! map loaded or changed   bind(labels, rooms, shares)
//! sentence with a thing   observe(...)                 what was forecast is compared, then learned from
//! model's scores          mix(...)  -> label probabilities     next_rooms(...) -> room probabilities
//! presence, room seen     be(...)               come_back(...) into an unknown room
//! about once a minute     tick(...)                    forecasts whose time has come are learned from
//! forecast wanted         at_times(...) -> probabilities of the places     room_set(...) -> a set with a promise
//! now and then, at exit   to_bytes() -> the file
//! ```
//!
//! No clock, no file: times are seconds since 1970 in local time (hours of the day matter), and come in with the calls. Once warm an
//! observation allocates nothing.

use crate::grounding::{Grounding, partition_names};
use crate::ids::PersonId;

mod counts;
mod key;
mod leaving;
mod mixture;
mod moment;
mod names;
mod parts;
mod pool;
mod rooms;
mod sets;
mod smoothing;
mod stays;
mod stored;
mod things;
mod visits;
mod whose;

use counts::{Counts, Limits};
use key::{Kind, NONE, Number, SLOT_MASK, parts};
use names::{ELSEWHERE_NAME, Home, Names, Numbered};
use rooms::{Known, Rooms};
use stays::Stays;
use things::Things;
use whose::{OTHERS_MAX, View};

pub use moment::{PART_HOURS, PARTS};
pub use parts::Without;
pub use sets::{AdaptiveSets, Issued, SetOptions};
pub use stored::{BYTES_MAX, StoredError};

/// Persons that are learned of, at most. A further person takes the place of the one who was learned least of.
pub const PERSONS_MAX: usize = 64;

/// How habits are learned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HabitsOptions {
    /// Whether anything is learned at all; what is known is used either way.
    pub learn: bool,
    /// Days after which what was seen counts half; 0 for never.
    pub half_life_days: f64,
    /// Contexts that are kept, at most: 24 bytes each, and 4 for finding them.
    pub contexts_max: usize,
    /// Blocks of up to four counts that are kept, at most: 28 bytes each.
    pub blocks_max: usize,
    /// Names of things that are kept, at most.
    pub names_max: usize,
    /// What room sets promise.
    pub sets: SetOptions,
    /// Parts of the forecasts that are left out, to measure what they add.
    pub without: Without,
}

impl Default for HabitsOptions {
    /// At most 3.6 MiB.
    fn default() -> Self {
        Self {
            learn: true,
            half_life_days: 60.0,
            contexts_max: 1 << 16,
            blocks_max: 3 << 14,
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
    /// Which label of the map that is bound, if the sentence mentions one.
    pub label: Option<usize>,
    /// Which room of the map that is bound, if it is known.
    pub room: Option<usize>,
    /// When, in seconds since 1970, local time.
    pub at_s: f64,
}

/// Where a person is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// In a room of the map that is bound.
    Room(usize),
    /// Out of the house, or outside the map.
    Elsewhere,
}

/// The parts of the probability that a thing comes next; the shares sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Shares {
    /// The probability.
    pub probability: f64,
    /// Of the language model, alone and where habit backs off to it.
    pub model: f64,
    /// Of what followed the last things in this home.
    pub habit: f64,
    /// Of the part of the day.
    pub hour: f64,
    /// Observations of this person at all, and after the last thing, the last two and the last three. Older ones count less.
    pub observations: [f64; 4],
}

/// The parts of the probability that the next thing is in a room; the shares sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RoomShares {
    /// The probability.
    pub probability: f64,
    /// Of the language model, alone and where habit backs off to it.
    pub model: f64,
    /// Of where this person went from this room, after the last things and after so long.
    pub habit: f64,
    /// Of the next thing that is expected, and where things are.
    pub things: f64,
    /// Of the part of the day.
    pub hour: f64,
    /// Observations of this person in this room, after the last thing, the last two and the last three. Older ones count less.
    pub observations: [f64; 4],
}

/// How much each forecast of a later place counts for; they sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct WhenShares {
    /// The forecast without this home.
    pub shipped: f64,
    /// How long stays last, and where they lead.
    pub leaving: f64,
    /// Where the person was that much later before.
    pub later: f64,
}

/// How much is known.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Learned {
    /// Observations learned from.
    pub observations: f64,
    /// Persons.
    pub persons: usize,
    /// Names of things.
    pub names: usize,
    /// Contexts and counts in them.
    pub contexts: usize,
    /// Counts.
    pub counts: usize,
    /// Bytes held in memory by all of it.
    pub bytes: usize,
}

#[derive(Debug, Clone)]
struct Person {
    number: PersonId,
    slot: u8,
    observations: f64,
    last_s: f64,
    /// How long after the one before it the last observation came.
    pace_s: f64,
    things: Things,
    rooms: Rooms,
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
            things: Things::new(options.without),
            rooms: Rooms::new(options.without),
            stays: Stays::new(options.sets, options.without),
        }
    }

    /// How much is known: what they did, and for how many minutes it is known where they were.
    fn known_of(&self) -> f64 {
        self.observations + self.stays.watched_min()
    }

    /// What is known now of the room of the next thing.
    fn known(&self, at_s: f64) -> Known {
        let Self { pace_s, things, stays, .. } = self;
        let spent_s = at_s - stays.entered_s;
        Known { here: stays.place, last: things.last_three(), times: things.times, spent_s, pace_s: *pace_s, at_s }
    }
}

/// What is known of a home.
#[derive(Debug, Clone)]
pub struct Habits {
    options: HabitsOptions,
    home: Home,
    counts: Counts,
    persons: Vec<Person>,
    is_converted: bool,
}

impl Habits {
    /// Knows nothing yet, and no map.
    #[must_use]
    pub fn new(options: HabitsOptions) -> Self {
        let half_life_min = options.half_life_days * 1_440.0;
        let mut places = Names::new(1_024);
        // The first number is elsewhere's.
        places.add(ELSEWHERE_NAME.to_owned(), 0);
        places.bind(vec![ELSEWHERE_NAME.to_owned()]);
        Self {
            home: Home { things: Names::new(options.names_max), places, shares: Vec::new() },
            counts: Counts::new(Limits { rows: options.contexts_max, blocks: options.blocks_max, half_life_min }),
            persons: Vec::new(),
            is_converted: false,
            options,
        }
    }

    /// How habits are learned.
    #[must_use]
    pub fn options(&self) -> &HabitsOptions {
        &self.options
    }

    /// Takes up a map: its scored labels and its rooms in words, each name once, and per label and room, row by row, the share of the
    /// label's items that lie there. What was learned by name stays.
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

    /// Forecasts that wait for their outcome are dropped: it will not be seen.
    pub fn drop_waiting(&mut self) {
        self.persons.iter_mut().for_each(|person| person.stays.forget_forecasts());
    }

    /// Takes up the map that a grounding is of: its labels, its rooms by their names ([`partition_names`]), and what lies where.
    pub fn bind_to(&mut self, grounding: &Grounding) {
        let labels = grounding.label_texts().iter().map(|text| (*text).to_owned()).collect();
        // No room has the name of being out.
        let own = |name: String| if name == ELSEWHERE_NAME { format!("room {name}") } else { name };
        let rooms = partition_names(grounding.partitions()).into_iter().map(own);
        let weights = grounding.weights();
        let shares = (0..weights.rows()).flat_map(|label| weights.row(label));
        self.bind(labels, rooms.collect(), shares.copied().collect());
    }

    /// Whether anything is learned from now on; what is known is used either way.
    pub fn set_learning(&mut self, learn: bool) {
        self.options.learn = learn;
    }

    /// Rooms of the map and elsewhere, which comes last.
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

    /// What a person's forecasts are made from, and the person.
    fn view(&mut self, number: PersonId, now_s: f64) -> (View<'_>, &mut Person) {
        let at = self.person(number);
        // The others of the home who were learned most of.
        let mut others = [None; OTHERS_MAX];
        let mut least = [0.0; OTHERS_MAX];
        for (_, other) in self.persons.iter().enumerate().filter(|(index, _)| *index != at) {
            if let Some(rank) = (0..OTHERS_MAX).find(|rank| other.known_of() > least[*rank]) {
                others[rank..].rotate_right(1);
                least[rank..].rotate_right(1);
                (others[rank], least[rank]) = (Some(other.slot), other.known_of());
            }
        }
        let Self { persons, counts, home, options, .. } = self;
        let (person, now_min, without) = (&mut persons[at], moment::minute(now_s), options.without);
        (View { counts, home, slot: person.slot, others, now_min, times: 0, without }, person)
    }

    /// The number of a thing of the map, which gets one if something is learned.
    fn thing_number(&mut self, label: usize, now_min: u32) -> Option<u16> {
        if !self.options.learn {
            return self.home.things.number(label);
        }
        let numbered = self.home.things.see(label, now_min);
        self.number(numbered, Number::Object)
    }

    /// As [`Habits::thing_number`], of a place.
    fn place_number(&mut self, place: Place, now_min: u32) -> Option<u16> {
        let index = match place {
            Place::Elsewhere => self.home.rooms(),
            Place::Room(room) if room < self.home.rooms() => room,
            Place::Room(_) => return None,
        };
        if !self.options.learn {
            return self.home.places.number(index);
        }
        let numbered = self.home.places.see(index, now_min);
        self.number(numbered, Number::Place)
    }

    /// A number that stood for something else is forgotten first.
    fn number(&mut self, numbered: Numbered, what: Number) -> Option<u16> {
        let number = match numbered {
            Numbered::As(number) => return Some(number),
            Numbered::Reused(number) => number,
            Numbered::Refused => return None,
        };
        for person in &mut self.persons {
            match what {
                Number::Object => person.things.forget_number(number),
                Number::Place | Number::Plain => person.stays.forget_number(number),
            }
            person.rooms.know(None);
        }
        // Of which things a digest is, it does not say.
        let is_free = |(kind, _, after): (Kind, u8, [u16; 3])| {
            let is_digest = what == Number::Object && matches!(kind, Kind::Object4 | Kind::Object5);
            !is_digest && kind.layout().into_iter().zip(after).all(|(is, other)| is != what || other != number)
        };
        self.counts.retain(
            |key| parts(key).is_some_and(is_free),
            |key, symbol| parts(key).is_some_and(|(kind, ..)| kind.layout()[3] != what || symbol != number),
        );
        Some(number)
    }

    /// A person turned to something: the last forecasts are compared with it, it is counted, and it is the context of what comes next.
    pub fn observe(&mut self, turn: &Turn) {
        let (now_min, at) = (moment::minute(turn.at_s), self.person(turn.person));
        let number = turn.label.and_then(|label| self.thing_number(label, now_min));
        let place = turn.room.and_then(|room| self.place_number(Place::Room(room), now_min));
        let Self { persons, counts, options: HabitsOptions { learn, .. }, home, .. } = self;
        let person = &mut persons[at];
        let Person { slot, things, rooms, stays, .. } = person;
        if *learn {
            if let Some((room, place)) = turn.room.zip(place) {
                rooms.learn_weights(room);
                rooms.count(counts, *slot, place, number, turn.at_s);
            }
            if let Some((label, number)) = turn.label.zip(number) {
                things.learn_weights(label);
                things.count(counts, *slot, number, turn.at_s);
            }
            person.observations += 1.0;
        }
        things.turn(number);
        if number.is_some() || place.is_some() {
            things.forget_forecast();
            rooms.forget_forecast();
        }
        if let Some(place) = place {
            stays.learn_due(counts, *slot, home, turn.at_s, *learn);
            stays.be(counts, *slot, place, turn.at_s, *learn);
        }
        person.pace_s = turn.at_s - person.last_s;
        person.last_s = person.last_s.max(turn.at_s);
        let known = person.known(turn.at_s);
        person.rooms.know(Some(known));
    }

    /// A person is in a place, without having turned to anything: told, or seen.
    pub fn be(&mut self, person: PersonId, place: Place, at_s: f64) {
        if let Some(number) = self.place_number(place, moment::minute(at_s)) {
            self.moves(person, at_s, |stays, counts, slot, learn| stays.be(counts, slot, number, at_s, learn));
        }
    }

    /// A person is no longer where they were, and it is not known where they are.
    pub fn lose(&mut self, person: PersonId, at_s: f64) {
        self.moves(person, at_s, |stays, counts, slot, learn| stays.be(counts, slot, NONE, at_s, learn));
    }

    /// A person who was out is in the house, in an unknown room. Where they go from there is known of earlier returns.
    pub fn come_back(&mut self, person: PersonId, at_s: f64) {
        self.moves(person, at_s, |stays, counts, slot, learn| stays.come_back(counts, slot, at_s, learn));
    }

    /// Where a person was when a forecast's time came is known only until they go on.
    fn moves(&mut self, person: PersonId, at_s: f64, go: impl FnOnce(&mut Stays, &mut Counts, u8, bool)) {
        let at = self.person(person);
        let Self { persons, counts, home, options: HabitsOptions { learn, .. }, .. } = self;
        let Person { slot, stays, .. } = &mut persons[at];
        stays.learn_due(counts, *slot, home, at_s, *learn);
        go(stays, counts, *slot, *learn);
    }

    /// Whether a person came back, and was seen in no room since.
    #[must_use]
    pub fn is_back(&self, person: PersonId) -> bool {
        self.known_person(person).is_some_and(|person| person.stays.is_back())
    }

    /// Where a person was told or seen to be last, if that is a place of the map.
    #[must_use]
    pub fn place(&self, person: PersonId) -> Option<Place> {
        let place = self.home.places.index(self.known_person(person)?.stays.place)?;
        Some(if place == self.home.rooms() { Place::Elsewhere } else { Place::Room(place) })
    }

    /// Nothing was watched until `now_s`: that time is not counted, and forecasts whose time has come are not learned from.
    pub fn pass(&mut self, now_s: f64) {
        let Self { persons, counts, home, .. } = self;
        for Person { slot, stays, .. } in persons {
            stays.learn_due(counts, *slot, home, now_s, false);
        }
    }

    /// The clock was set on by so many seconds, or back: everybody is where they were for as long as they were.
    pub fn shift_clock(&mut self, by_s: f64) {
        for person in &mut self.persons {
            person.last_s += by_s;
            person.stays.shift_clock(by_s);
        }
    }

    /// The minutes in which something was last seen are changed.
    fn change_minutes(&mut self, change: impl Fn(u32) -> u32) {
        let Home { things, places, .. } = &mut self.home;
        let seen_min = things.seen_min().chain(places.seen_min()).chain(self.counts.touched_min());
        seen_min.for_each(|minute| *minute = change(*minute));
    }

    /// The clock was set on by so many seconds, or back, and what was counted before is as old as it was.
    pub fn shift_counts(&mut self, by_s: f64) {
        self.change_minutes(|minute| moment::shifted(minute, (by_s / 60.0) as i64));
    }

    /// What was learned by a clock that was ahead counts as of now. It would not fade until then, and what is learned meanwhile would count for
    /// nothing next to it.
    pub fn no_later_than(&mut self, now_s: f64) {
        self.change_minutes(|minute| minute.min(moment::minute(now_s)));
    }

    /// Per label of the map the probability that it is turned to next, from the model's probabilities (which need not sum to one).
    /// It is compared with what comes next.
    pub fn mix(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let (view, Person { things, .. }) = self.view(person, at_s);
        things.forecast(view, at_s, model);
        &things.mixed
    }

    /// Per room of the map the probability that the next thing is there, from the model's. To be called after [`Habits::mix`], whose
    /// next thing is among what is mixed. It is compared with what comes next.
    pub fn next_rooms(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let (view, person) = self.view(person, at_s);
        let known = person.known(at_s);
        person.rooms.forecast(view, known, (model, &person.things.mixed));
        &person.rooms.mixed
    }

    /// The parts of the probability of a label, in the latest forecast of a person.
    #[must_use]
    pub fn explain(&self, person: PersonId, label: usize) -> Option<Shares> {
        let Person { things, .. } = self.known_person(person)?;
        let [model, habit, hour] = things.explain(label)?;
        Some(Shares { probability: things.mixed[label], model, habit, hour, observations: things.observations })
    }

    /// The parts of the probability of a room, in the latest forecast of the next room of a person.
    #[must_use]
    pub fn explain_room(&self, person: PersonId, room: usize) -> Option<RoomShares> {
        let Person { rooms, .. } = self.known_person(person)?;
        let [model, habit, things, hour] = rooms.explain(room)?;
        let (probability, observations) = (rooms.mixed[room], rooms.observations);
        Some(RoomShares { probability, model, habit, things, hour, observations })
    }

    /// Time passes: time spent is counted, forecasts whose time has come are learned from, and once a minute one more is made to be
    /// learned from. `shipped` writes what the forecast without habits says of the places (elsewhere comes last) so many seconds ahead.
    pub fn tick(&mut self, person: PersonId, now_s: f64, shipped: &mut dyn FnMut(f64, &mut [f64])) {
        self.moves(person, now_s, |_, _, _, _| {});
        let (view, Person { rooms, stays, .. }) = self.view(person, now_s);
        if stays.is_due(now_s) {
            stays.sample(view, now_s, &rooms.mixed, shipped);
        }
    }

    /// Per time ahead (ascending) and place (elsewhere comes last) the probability that the person is there then, row by row into `out`, with the
    /// shares of the forecasts. `shipped` is what the forecast without habits says, and what is given back if nothing is known.
    pub fn at_times(
        &mut self,
        person: PersonId,
        (now_s, horizons_s): (f64, &[f64]),
        shipped: &[f64],
        out: &mut Vec<f64>,
        shares: &mut Vec<WhenShares>,
    ) {
        let (view, Person { rooms, stays, .. }) = self.view(person, now_s);
        let cells = horizons_s.len() * view.home.places();
        out.clear();
        out.extend_from_slice(&shipped[..cells.min(shipped.len())]);
        out.resize(cells, 0.0);
        shares.clear();
        stays.forecast(view, (now_s, horizons_s), &rooms.mixed, out, |[shipped, leaving, by_place, later], _| {
            shares.push(WhenShares { shipped, leaving, later: by_place + later });
        });
    }

    /// Which places are in the set with the promised coverage, for probabilities that [`Habits::at_times`] gave for that time. If the person's place
    /// is not known, or these are of `another` kind, nothing was learned of such forecasts: the set has that much of them.
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

    /// How much is known of one person, in observations.
    #[must_use]
    pub fn observations(&self, person: PersonId) -> f64 {
        self.known_person(person).map_or(0.0, |person| person.observations)
    }

    /// For about how many minutes it was known where a person was.
    #[must_use]
    pub fn watched_min(&self, person: PersonId) -> f64 {
        self.known_person(person).map_or(0.0, |person| person.stays.watched_min())
    }

    /// Persons of whom something was observed, with the number of observations.
    pub fn persons(&self) -> impl Iterator<Item = (PersonId, f64)> {
        self.persons.iter().map(|person| (person.number, person.observations))
    }

    /// How much is known, and what it takes.
    #[must_use]
    pub fn learned(&self) -> Learned {
        let (contexts, counts) = self.counts.len();
        let Home { things, places, .. } = &self.home;
        Learned {
            observations: self.persons.iter().map(|person| person.observations).sum(),
            persons: self.persons.len(),
            names: things.len(),
            contexts,
            counts,
            bytes: self.counts.bytes() + things.bytes() + places.bytes(),
        }
    }

    /// Forgets a person; says whether anything was known.
    pub fn forget(&mut self, person: PersonId) -> bool {
        let Some(at) = self.persons.iter().position(|other| other.number == person) else { return false };
        let slot = self.persons.remove(at).slot;
        self.counts.retain(|key| parts(key).is_some_and(|(_, other, _)| other & SLOT_MASK != slot), |_, _| true);
        self.date_names();
        true
    }

    /// Dates names by the counts that are left: the time when only a forgotten person turned to a thing is forgotten too.
    fn date_names(&mut self) {
        let Home { things, places, .. } = &mut self.home;
        things.seen_min().chain(places.seen_min()).for_each(|seen_min| *seen_min = 0);
        for (key, touched_min, counts) in self.counts.rows() {
            let Some((kind, _, after)) = parts(key) else { continue };
            let of_counts = counts.iter().map(|(symbol, _)| (*symbol, kind.layout()[3]));
            for (number, what) in after.into_iter().zip(kind.layout()).chain(of_counts) {
                match what {
                    Number::Object => things.date(number, touched_min),
                    Number::Place => places.date(number, touched_min),
                    Number::Plain => {}
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
