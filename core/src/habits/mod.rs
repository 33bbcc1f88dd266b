//! What the people of one home do: learned while watching, over the language model as the prior.
//!
//! On the first day the forecasts are those of the language model, later those of the home, and a mixture with a bound decides
//! (`mixture.rs`): from its beginning on its loss exceeds that of its best expert, the model among them, by no more than the bound, where what happened is
//! told at once. Everything is keyed by words, so that it survives changes of the map; everything has a limit; counts of what followed what fade with a half-life.
//!
//! How a daemon uses it, per person:
//!
//! ```text
//! map loaded or changed   bind(labels, rooms, shares)
//! sentence with a thing   observe(...)                 what was forecast is compared, then learned from
//! model's scores          mix(...)  -> label probabilities     next_rooms(...) -> room probabilities
//! presence, room seen     be(...)               come_back(...) where no room is known
//! about once a minute     tick(...)                    forecasts whose time has come are learned from
//! forecast wanted         at(...) -> probabilities of the places     room_set(...) -> a set with a promise
//! now and then, at exit   to_bytes() -> the file
//! ```
//!
//! No clock, no file: times are seconds since 1970 in local time (hours of the day matter), and come in with the calls. Once warm an
//! observation allocates nothing.

use std::collections::BTreeMap;

use crate::grounding::{Grounding, partition_names};
use crate::ids::PersonId;
use crate::parsing::{Keyed, json_says};

mod counts;
mod frame;
mod key;
mod mixture;
mod moment;
mod objects;
mod reliance;
mod rooms;
mod sets;
mod smoothing;
mod stays;
mod stored;
mod together;
mod visits;
mod whose;
mod words;

use counts::{Counts, Limits};
use frame::{ELSEWHERE, Frame};
use key::{Kind, NONE, Number, SLOT_MASK, key, parts};
use objects::{Objects, Parts};
use rooms::{Known, Rooms};
use stays::{ANCHORS_S, Stays};
use stored::{Stored, StoredAnchor, StoredName, StoredPerson, StoredRow, malformed};
use together::Together;
use whose::{OTHERS_MAX, Whose};
use words::{Numbered, Words};

pub use sets::{AdaptiveSets, Issued, SetOptions};
pub use stored::{BYTES_MAX, StoredError};
pub use visits::{PART_HOURS, PARTS};

/// Persons that are learned of, at most; of further ones, he or she who was learned least of gives way.
pub const PERSONS_MAX: usize = 64;

/// How habits are learned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HabitsOptions {
    /// Whether anything is learned at all; what is known is used either way.
    pub learn: bool,
    /// Days after which what was seen counts half; 0 for never.
    pub half_life_days: f64,
    /// Seconds of silence after which another activity begins.
    pub activity_gap_s: f64,
    /// Contexts that are kept, at most: 24 bytes each, and 4 for finding them.
    pub contexts_max: usize,
    /// Blocks of up to four counts that are kept, at most: 28 bytes each.
    pub blocks_max: usize,
    /// Names of things that are kept, at most.
    pub names_max: usize,
    /// What room sets promise.
    pub sets: SetOptions,
}

impl Default for HabitsOptions {
    /// At most 3.6 MiB.
    fn default() -> Self {
        Self {
            learn: true,
            half_life_days: 60.0,
            activity_gap_s: 1_800.0,
            contexts_max: 1 << 16,
            blocks_max: 3 << 14,
            names_max: 2_048,
            sets: SetOptions::default(),
        }
    }
}

/// A thing that somebody turned to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Turn {
    /// Who.
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

/// How much of a probability comes from where; the shares sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Shares {
    /// The probability.
    pub probability: f64,
    /// Of the language model, alone and where habit backs off to it.
    pub model: f64,
    /// Of what followed the last things in this home.
    pub habit: f64,
    /// Of what was turned to in this activity.
    pub recency: f64,
    /// Of the part of the day.
    pub hour: f64,
    /// Of the things in the present room.
    pub staying: f64,
    /// Observations of this person at all; and after the last thing, the last two, the last three, of which older ones count less.
    pub observations: [f64; 4],
}

/// How much of the probability that the next thing is in a room comes from where; the shares sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RoomShares {
    /// The probability.
    pub probability: f64,
    /// Of the language model, alone and where habit backs off to it.
    pub model: f64,
    /// Of where this person went from this room and those before it, after the last things, after so long, and at such a pace.
    pub habit: f64,
    /// Of the next thing that is expected, and where things are.
    pub things: f64,
    /// Of the part of the day.
    pub hour: f64,
    /// Of how often this person stays.
    pub staying: f64,
    /// Observations of this person in this room, after the last thing, the last two, the last three; older ones count less.
    pub observations: [f64; 4],
}

/// How much each forecast of a later place counts for; they sum to one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct WhenShares {
    /// The forecast without this home.
    pub shipped: f64,
    /// That the person is still, or again, in the same place.
    pub persistence: f64,
    /// The hazard of leaving, and where to.
    pub semi_markov: f64,
    /// Where the person was that much later at such times before.
    pub later: f64,
}

/// Of a forecast that nothing is added to.
const NOTHING_KNOWN: WhenShares = WhenShares { shipped: 1.0, persistence: 0.0, semi_markov: 0.0, later: 0.0 };

impl WhenShares {
    fn of(weights: [f64; stays::EXPERTS]) -> Self {
        let [shipped, persistence, semi_markov, later_by_place, later] = weights;
        Self { shipped, persistence, semi_markov, later: later_by_place + later }
    }
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
    objects: Objects,
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
            objects: Objects::new(),
            rooms: Rooms::new(),
            stays: Stays::new(options.sets),
        }
    }

    /// How much is known: what they did, and for how many minutes it is known where they were.
    fn known_of(&self) -> f64 {
        self.observations + self.stays.watched_min()
    }

    /// What is known now of the room of the next thing.
    fn known(&self, at_s: f64) -> Known {
        let Self { pace_s, objects, stays, .. } = self;
        Known {
            here: stays.place,
            before: stays.before,
            last: objects.last_three(),
            times: objects.times,
            entered_s: stays.entered_s,
            pace_s: *pace_s,
            at_s,
        }
    }
}

/// What is known of a home.
#[derive(Debug, Clone)]
pub struct Habits {
    options: HabitsOptions,
    objects: Words,
    places: Words,
    counts: Counts,
    frame: Frame,
    persons: Vec<Person>,
}

impl Habits {
    /// Knows nothing yet, and no map.
    #[must_use]
    pub fn new(options: HabitsOptions) -> Self {
        let half_life_min = options.half_life_days * 1_440.0;
        let mut places = Words::new(1_024);
        // The first number is elsewhere's.
        places.number_of(ELSEWHERE_NAME, 0);
        Self {
            objects: Words::new(options.names_max),
            places,
            counts: Counts::new(Limits { rows: options.contexts_max, blocks: options.blocks_max, half_life_min }),
            frame: Frame::new(Vec::new(), Vec::new(), Vec::new()),
            persons: Vec::new(),
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
    pub fn bind(&mut self, labels: Vec<String>, rooms: Vec<String>, shares: Vec<f64>) {
        let are_same_rooms = self.frame.rooms == rooms;
        self.frame = Frame::new(labels, rooms, shares);
        for label in 0..self.frame.labels.len() {
            if let Some(number) = self.objects.number(&self.frame.labels[label]) {
                self.frame.name_label(label, number);
            }
        }
        for room in 0..self.frame.rooms.len() {
            if let Some(number) = self.places.number(&self.frame.rooms[room]) {
                self.frame.name_place(room, number);
            }
        }
        for person in &mut self.persons {
            person.objects.forget_forecast();
            person.rooms.forget_forecast();
            if !are_same_rooms {
                person.stays.forget_forecasts();
            }
        }
    }

    /// What was forecast is not learned from: nobody will see what comes of it.
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
        self.frame.places()
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

    /// The slots of those in the home who were learned most of, apart from one.
    fn others(&self, at: usize) -> [Option<u8>; OTHERS_MAX] {
        let mut others = [None; OTHERS_MAX];
        let mut least = [0.0; OTHERS_MAX];
        for (_, other) in self.persons.iter().enumerate().filter(|(index, _)| *index != at) {
            if let Some(rank) = (0..OTHERS_MAX).find(|rank| other.known_of() > least[*rank]) {
                others[rank..].rotate_right(1);
                least[rank..].rotate_right(1);
                (others[rank], least[rank]) = (Some(other.slot), other.known_of());
            }
        }
        others
    }

    fn label_number(&mut self, label: usize, now_min: u32) -> Option<u16> {
        if let Some(number) = self.frame.label_number(label) {
            self.objects.touch(number, now_min);
            return Some(number);
        }
        let number = match self.objects.number_of(self.frame.labels.get(label)?, now_min) {
            Numbered::Known(number) | Numbered::New(number) => number,
            Numbered::Reused(number) => {
                self.frame.drop_number(number);
                for person in &mut self.persons {
                    person.objects.forget_number(number);
                    person.rooms.forget_known();
                }
                self.drop_counts(Number::Object, number);
                number
            }
            Numbered::Refused => return None,
        };
        self.frame.name_label(label, number);
        Some(number)
    }

    /// The number of a place; one that has none yet gets it where something is learned.
    fn place_number(&mut self, place: Place, now_min: u32, learn: bool) -> Option<u16> {
        let Place::Room(room) = place else { return Some(ELSEWHERE) };
        if !learn {
            return self.frame.place_number(room).filter(|_| room < self.frame.rooms.len());
        }
        if let Some(number) = self.frame.place_number(room).filter(|_| room < self.frame.rooms.len()) {
            self.places.touch(number, now_min);
            return Some(number);
        }
        // Elsewhere keeps its number, however long nobody was out.
        self.places.touch(ELSEWHERE, now_min);
        let number = match self.places.number_of(self.frame.rooms.get(room)?, now_min) {
            Numbered::Known(number) | Numbered::New(number) => number,
            Numbered::Reused(number) => {
                self.frame.drop_place_number(number);
                for person in &mut self.persons {
                    person.stays.forget_number(number);
                    person.rooms.forget_known();
                }
                self.drop_counts(Number::Place, number);
                number
            }
            Numbered::Refused => return None,
        };
        self.frame.name_place(room, number);
        Some(number)
    }

    /// A number stands for something else from now on.
    fn drop_counts(&mut self, what: Number, number: u16) {
        let names = |key: u64| {
            let (kind, _, after) = parts(key)?;
            // Which numbers a digest is of, it does not say.
            let digested = what == Number::Object && matches!(kind, Kind::Object4 | Kind::Object5);
            (!digested).then_some((kind.layout(), after))
        };
        self.counts.retain(
            |key| names(key).is_some_and(|(is, after)| (0..3).all(|at| is[at] != what || after[at] != number)),
            |key, symbol| names(key).is_some_and(|(is, _)| is[3] != what || symbol != number),
        );
    }

    /// Somebody turned to something: the last forecasts are compared with it, it is counted, and it is the context of what comes next.
    pub fn observe(&mut self, turn: &Turn) {
        let learn = self.options.learn;
        let now_min = moment::minute(turn.at_s);
        let at = self.person(turn.person);
        let number = turn.label.and_then(|label| match learn {
            true => self.label_number(label, now_min),
            false => self.frame.label_number(label),
        });
        let room = turn.room.filter(|room| *room < self.frame.rooms.len());
        let place = room.and_then(|room| self.place_number(Place::Room(room), now_min, learn));
        let Self { persons, counts, options, frame, .. } = self;
        let person = &mut persons[at];
        let Person { slot, objects, rooms, stays, .. } = person;
        let slot = *slot;
        let pace_s = turn.at_s - person.last_s;
        if pace_s > options.activity_gap_s {
            objects.forget_activity();
        }
        (person.last_s, person.pace_s) = (person.last_s.max(turn.at_s), pace_s);
        if learn {
            if let Some((room, place)) = room.zip(place) {
                rooms.learn_weights(room);
                rooms.count(counts, slot, place, number, turn.at_s);
            }
            if let Some((label, number)) = turn.label.zip(number) {
                objects.learn_weights(label);
                objects.count(counts, slot, number, turn.at_s);
            }
            person.observations += 1.0;
        }
        match number {
            Some(number) => objects.turn(number),
            None => objects.turn_away(),
        }
        if number.is_some() || place.is_some() {
            objects.forget_forecast();
            rooms.forget_forecast();
        }
        if let Some(place) = place {
            stays.learn_due(counts, slot, frame, turn.at_s, learn);
            stays.be(counts, slot, place, turn.at_s, learn);
        }
        let known = person.known(turn.at_s);
        person.rooms.know(known);
    }

    /// Somebody is in a place, without having turned to anything: told, or seen.
    pub fn be(&mut self, person: PersonId, place: Place, at_s: f64) {
        let at = self.person(person);
        let learn = self.options.learn;
        let Some(number) = self.place_number(place, moment::minute(at_s), learn) else { return };
        let Self { persons, counts, frame, .. } = self;
        let Person { slot, stays, objects, .. } = &mut persons[at];
        // Where they were when a forecast's time came is known only until they go on.
        stays.learn_due(counts, *slot, frame, at_s, learn);
        stays.be(counts, *slot, number, at_s, learn);
        if stays.elsewhere() {
            objects.forget_activity();
        }
    }

    /// Somebody is no longer where they were, and nobody knows where they are instead.
    pub fn lose(&mut self, person: PersonId, at_s: f64) {
        let at = self.person(person);
        let Self { persons, counts, frame, options, .. } = self;
        let Person { slot, stays, .. } = &mut persons[at];
        stays.learn_due(counts, *slot, frame, at_s, options.learn);
        stays.be(counts, *slot, NONE, at_s, options.learn);
    }

    /// Somebody who was out is in the house, and nobody knows in which room. Where they go from there is known of earlier returns.
    pub fn come_back(&mut self, person: PersonId, at_s: f64) {
        let at = self.person(person);
        let Self { persons, counts, frame, options, .. } = self;
        let Person { slot, stays, .. } = &mut persons[at];
        stays.learn_due(counts, *slot, frame, at_s, options.learn);
        stays.come_back(counts, *slot, at_s, options.learn);
    }

    /// Whether somebody came back, and was seen in no room since.
    #[must_use]
    pub fn is_back(&self, person: PersonId) -> bool {
        self.persons.iter().any(|other| other.number == person && other.stays.is_back())
    }

    /// Where a person was told or seen to be last, if that is a place of the map.
    #[must_use]
    pub fn place(&self, person: PersonId) -> Option<Place> {
        let number = self.persons.iter().find(|other| other.number == person)?.stays.place;
        let place = self.frame.place(number)?;
        Some(if place == self.frame.elsewhere() { Place::Elsewhere } else { Place::Room(place) })
    }

    /// Nobody watched until `now_s`: that time is not counted, and forecasts whose time has come are not learned from.
    pub fn pass(&mut self, now_s: f64) {
        let Self { persons, counts, frame, .. } = self;
        for Person { slot, stays, .. } in persons {
            stays.learn_due(counts, *slot, frame, now_s, false);
        }
    }

    /// The clock was set on by so many seconds, or back: everybody is where they were for as long as they were.
    pub fn shift_clock(&mut self, by_s: f64) {
        for person in &mut self.persons {
            person.last_s += by_s;
            person.stays.shift_clock(by_s);
        }
    }

    /// The clock was set on by so many seconds, or back, and what was counted before is as old as it was.
    pub fn shift_counts(&mut self, by_s: f64) {
        let by_min = (by_s / 60.0) as i64;
        self.counts.shift_clock(by_min);
        self.objects.shift_clock(by_min);
        self.places.shift_clock(by_min);
    }

    /// What was learned by a clock that was ahead, or is said to have been, counts as of now. It would not fade until then, and what is
    /// learned meanwhile would count for nothing beside it.
    pub fn no_later_than(&mut self, now_s: f64) {
        let now_min = moment::minute(now_s);
        self.counts.no_later_than(now_min);
        self.objects.no_later_than(now_min);
        self.places.no_later_than(now_min);
    }

    /// Per label of the map the probability that it is turned to next, from the model's probabilities (which need not sum to one).
    /// It is compared with what comes next.
    ///
    /// # Panics
    /// When `model` has fewer entries than the map has labels.
    pub fn mix(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let at = self.person(person);
        let others = self.others(at);
        let Self { persons, counts, frame, .. } = self;
        let Person { slot, objects, stays, .. } = &mut persons[at];
        let whose = Whose { counts, slot: *slot, others, now_min: moment::minute(at_s), times: 0 };
        objects.forecast(whose, frame, frame.room(stays.place), at_s, model);
        &objects.mixed
    }

    /// Per room of the map the probability that the next thing is there, from the model's. To be called after [`Habits::mix`], whose
    /// next object is among what is mixed. It is compared with what comes next.
    ///
    /// # Panics
    /// When `model` has fewer entries than the map has rooms.
    pub fn next_rooms(&mut self, person: PersonId, at_s: f64, model: &[f64]) -> &[f64] {
        let at = self.person(person);
        let others = self.others(at);
        let Self { persons, counts, frame, .. } = self;
        let known = persons[at].known(at_s);
        let Person { slot, objects, rooms, .. } = &mut persons[at];
        let whose = Whose { counts, slot: *slot, others, now_min: moment::minute(at_s), times: 0 };
        rooms.forecast(whose, frame, known, (model, &objects.mixed));
        &rooms.mixed
    }

    /// Where the probability of a label comes from, in the latest forecast of a person.
    #[must_use]
    pub fn explain(&self, person: PersonId, label: usize) -> Option<Shares> {
        let person = self.persons.iter().find(|other| other.number == person)?;
        let Parts { probability, model, habit, recency, hour, staying } = person.objects.explain(label)?;
        Some(Shares { probability, model, habit, recency, hour, staying, observations: person.objects.observations })
    }

    /// Where the probability of a room comes from, in the latest forecast of the next room of a person.
    #[must_use]
    pub fn explain_room(&self, person: PersonId, room: usize) -> Option<RoomShares> {
        let person = self.persons.iter().find(|other| other.number == person)?;
        let parts = person.rooms.by_expert(room)?;
        let probability: f64 = parts.iter().map(|(part, _)| part).sum();
        if probability <= 0.0 {
            return None;
        }
        let model = parts.iter().map(|(part, of_model)| part * of_model).sum::<f64>() / probability;
        let [_, habit, short, things, hour, before, pace, dwell, staying] =
            parts.map(|(part, of_model)| part * (1.0 - of_model) / probability);
        Some(RoomShares {
            probability,
            model,
            habit: habit + short + before + pace + dwell,
            things,
            hour,
            staying,
            observations: person.rooms.observations,
        })
    }

    /// Time passes: time spent is counted, forecasts whose time has come are learned from, and once a minute one more is made to be
    /// learned from. `shipped` writes what the forecast without habits says of the places (elsewhere comes last) so many seconds ahead.
    pub fn tick(&mut self, person: PersonId, now_s: f64, shipped: &mut dyn FnMut(f64, &mut [f64])) {
        let at = self.person(person);
        let others = self.others(at);
        let Self { persons, counts, frame, options, .. } = self;
        let Person { slot, rooms, stays, .. } = &mut persons[at];
        stays.learn_due(counts, *slot, frame, now_s, options.learn);
        if stays.due(now_s) {
            let whose = Whose { counts, slot: *slot, others, now_min: moment::minute(now_s), times: 0 };
            stays.sample(whose, frame, now_s, &rooms.mixed, shipped);
        }
    }

    /// Per place (elsewhere comes last) the probability that the person is there at `now_s + horizon_s`, into `out`. `shipped` is what the
    /// forecast without habits says, and what is given back where nothing is known.
    pub fn at(
        &mut self,
        person: PersonId,
        now_s: f64,
        horizon_s: f64,
        shipped: &[f64],
        out: &mut Vec<f64>,
    ) -> WhenShares {
        let at = self.person(person);
        let others = self.others(at);
        let Self { persons, counts, frame, .. } = self;
        let Person { slot, rooms, stays, .. } = &mut persons[at];
        let whose = Whose { counts, slot: *slot, others, now_min: moment::minute(now_s), times: 0 };
        let mut shares = NOTHING_KNOWN;
        let given = |weights| shares = WhenShares::of(weights);
        stays.at(whose, frame, (now_s, &[horizon_s]), &rooms.mixed, shipped, out, given);
        shares
    }

    /// As [`Habits::at`] for several times ahead, in ascending order, at less cost: row by row in `shipped` and `out`, and each with its
    /// shares.
    pub fn at_times(
        &mut self,
        person: PersonId,
        (now_s, horizons_s): (f64, &[f64]),
        shipped: &[f64],
        out: &mut Vec<f64>,
        shares: &mut Vec<WhenShares>,
    ) {
        let at = self.person(person);
        let others = self.others(at);
        let Self { persons, counts, frame, .. } = self;
        let Person { slot, rooms, stays, .. } = &mut persons[at];
        let whose = Whose { counts, slot: *slot, others, now_min: moment::minute(now_s), times: 0 };
        shares.clear();
        let given = |weights| shares.push(WhenShares::of(weights));
        stays.at(whose, frame, (now_s, horizons_s), &rooms.mixed, shipped, out, given);
    }

    /// Which places are in the set with the promised coverage, for probabilities that [`Habits::at`] gave for that time. Where the person's place is
    /// not known, or these are of `another` kind than what [`Habits::at`] gives, nothing was learned of such, and the set has that much of them.
    ///
    /// # Panics
    /// When `probabilities` has fewer entries than there are places.
    pub fn room_set(
        &mut self,
        person: PersonId,
        horizon_s: f64,
        probabilities: &[f64],
        another: bool,
        set: &mut Vec<bool>,
    ) {
        let at = self.person(person);
        let another = another || self.place(person).is_none();
        self.persons[at].stays.set(horizon_s, probabilities, another, set);
    }

    /// How much is known of one person, in observations.
    #[must_use]
    pub fn observations(&self, person: PersonId) -> f64 {
        self.persons.iter().find(|other| other.number == person).map_or(0.0, |person| person.observations)
    }

    /// For about how many minutes it was known where a person was.
    #[must_use]
    pub fn watched_min(&self, person: PersonId) -> f64 {
        self.persons.iter().find(|other| other.number == person).map_or(0.0, |person| person.stays.watched_min())
    }

    /// Persons of whom something was observed, with the number of observations.
    pub fn persons(&self) -> impl Iterator<Item = (PersonId, f64)> {
        self.persons.iter().map(|person| (person.number, person.observations))
    }

    /// How much is known, and what it takes.
    #[must_use]
    pub fn learned(&self) -> Learned {
        let (contexts, counts) = self.counts.len();
        Learned {
            observations: self.persons.iter().map(|person| person.observations).sum(),
            persons: self.persons.len(),
            names: self.objects.len(),
            contexts,
            counts,
            bytes: self.counts.bytes() + self.objects.bytes() + self.places.bytes(),
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

    /// Dates names by the counts that are left: what nobody else turned to says nothing of when that was.
    fn date_names(&mut self) {
        let (mut objects, mut places) = (vec![0; self.objects.len()], vec![0; self.places.len()]);
        for (key, touched_min, counts) in self.counts.rows() {
            let Some((kind, _, after)) = parts(key) else { continue };
            let is_digest = matches!(kind, Kind::Object4 | Kind::Object5);
            let of_key = after.into_iter().zip(kind.layout()).filter(|_| !is_digest);
            let of_counts = counts.iter().map(|(symbol, _)| (*symbol, kind.layout()[3]));
            for (number, what) in of_key.chain(of_counts) {
                let seen = match what {
                    Number::Object => objects.get_mut(usize::from(number)),
                    Number::Place => places.get_mut(usize::from(number)),
                    _ => None,
                };
                if let Some(seen) = seen {
                    *seen = touched_min.max(*seen);
                }
            }
        }
        (0..).zip(objects).for_each(|(number, seen_min)| self.objects.set_seen_min(number, seen_min));
        (0..).zip(places).for_each(|(number, seen_min)| self.places.set_seen_min(number, seen_min));
    }

    fn stored(&self) -> Stored {
        let names = |words: &Words| {
            (0..words.len() as u16)
                .filter_map(|n| Some(StoredName { name: words.name(n)?.to_owned(), seen_min: words.seen_min(n) }))
                .collect()
        };
        let person = |person: &Person| StoredPerson {
            number: person.number.0,
            slot: person.slot,
            observations: person.observations,
            stayed: person.rooms.stayed,
            turned: person.rooms.turned,
            repeated: [person.objects.repeated, person.objects.turned],
            weights: (person.objects.mixtures.iter().flat_map(|mixture| mixture.weights()))
                .chain(person.rooms.staying.iter().flat_map(|mixture| mixture.weights()))
                .chain(person.rooms.destination.iter().flat_map(|mixture| mixture.weights()))
                .chain(person.objects.base.weights())
                .chain(person.rooms.base.weights())
                .chain(person.objects.again.weights())
                .chain(person.objects.together.iter().flat_map(Together::state))
                .chain(person.rooms.staying_together.iter().flat_map(Together::state))
                .chain(person.rooms.destination_together.iter().flat_map(Together::state))
                .chain(person.objects.reliance.state())
                .copied()
                .collect(),
            anchors: (person.stays.anchors.iter())
                .map(|anchor| {
                    let (miss, outcomes, scores) = anchor.sets.state();
                    StoredAnchor {
                        weights: anchor.mixture.weights().to_vec(),
                        stayed: anchor.stayed,
                        sampled: anchor.sampled,
                        miss,
                        outcomes,
                        scores: scores.collect(),
                    }
                })
                .collect(),
        };
        let row = |(key, touched_min, counts): (u64, u32, Vec<(u16, f32)>)| {
            let (kind, slot, after) = parts(key)?;
            Some(StoredRow { kind: kind as u8, slot, after, touched_min, counts })
        };
        Stored {
            version: stored::VERSION,
            objects: names(&self.objects),
            places: names(&self.places),
            persons: self.persons.iter().map(person).collect(),
            rows: self.counts.rows().into_iter().filter_map(row).collect(),
        }
    }

    /// Takes up what was stored. No map is bound, and nobody is anywhere.
    fn restore(options: HabitsOptions, stored: &Stored) -> Result<Self, StoredError> {
        let mut habits = Self::new(options);
        for (names, words, limit) in
            [(&stored.objects, &mut habits.objects, "things"), (&stored.places, &mut habits.places, "places")]
        {
            for (at, StoredName { name, seen_min }) in names.iter().enumerate() {
                let fits = match words.number_of(name, *seen_min) {
                    Numbered::New(number) | Numbered::Known(number) => usize::from(number) == at,
                    Numbered::Reused(_) | Numbered::Refused => false,
                };
                if !fits {
                    return Err(malformed(format!(
                        "the name {name:?} of {limit} comes twice, is too long, or is one too many"
                    )));
                }
            }
        }
        let mut slots = BTreeMap::new();
        for from in &stored.persons {
            let number = PersonId(from.number);
            let known = habits.persons.iter().any(|person| person.number == number);
            if known || usize::from(from.slot) >= PERSONS_MAX || slots.insert(from.slot, from.number).is_some() {
                return Err(malformed(format!("person {} comes twice, or where nobody can be", from.number)));
            }
            let mut person = Person::new(number, from.slot, &options);
            person.observations = from.observations;
            (person.rooms.stayed, person.rooms.turned) = (from.stayed, from.turned.max(1.0));
            let mut weights = from.weights.as_slice();
            // In the order in which they are stored.
            let weights = &mut weights;
            let Person { objects, rooms, .. } = &mut person;
            for mixture in &mut objects.mixtures {
                mixture.restore(taken(weights, number)?);
            }
            // Version 2 had other forecasts of rooms: how good each was is learned again, what they count is kept.
            let earlier = stored.version == stored::VERSION_2;
            for mixture in rooms.staying.iter_mut().chain(&mut rooms.destination) {
                match earlier {
                    true => taken::<ROOM_EXPERTS_OF_2>(weights, number).map(|_| ())?,
                    false => mixture.restore(taken(weights, number)?),
                }
            }
            objects.base.restore(taken(weights, number)?);
            rooms.base.restore(taken(weights, number)?);
            objects.again.restore(taken(weights, number)?);
            for together in &mut objects.together {
                match earlier {
                    true => together.restore_powers(taken(weights, number)?),
                    false => restore_together(together, weights, number)?,
                }
            }
            for together in rooms.staying_together.iter_mut().chain(&mut rooms.destination_together) {
                match earlier {
                    true => taken::<ROOM_FACTORS_OF_2>(weights, number).map(|_| ())?,
                    false => restore_together(together, weights, number)?,
                }
            }
            objects.reliance.restore(&taken(weights, number)?);
            [person.objects.repeated, person.objects.turned] = [from.repeated[0], from.repeated[1].max(1.0)];
            if from.anchors.len() != ANCHORS_S.len() {
                return Err(malformed(format!("horizons of person {} are missing", from.number)));
            }
            for (anchor, from) in person.stays.anchors.iter_mut().zip(&from.anchors) {
                if let Ok(weights) = from.weights.as_slice().try_into() {
                    anchor.mixture.restore(weights);
                }
                (anchor.stayed, anchor.sampled) = (from.stayed, from.sampled);
                match earlier {
                    true => anchor.sets.restore_scores(from.miss, from.outcomes, &from.scores),
                    false => anchor.sets.restore(from.miss, from.outcomes, &from.scores),
                }
            }
            habits.persons.push(person);
        }
        for row in &stored.rows {
            let Some(kind) = Kind::ALL.into_iter().find(|kind| *kind as u8 == row.kind) else { continue };
            let layout = kind.layout();
            let exists = |is: Number, number: u16| match is {
                Number::Object => number == NONE || usize::from(number) < habits.objects.len(),
                Number::Place => number == NONE || usize::from(number) < habits.places.len(),
                Number::Plain => true,
            };
            let whole = slots.contains_key(&(row.slot & SLOT_MASK))
                && (0..3).all(|at| exists(layout[at], row.after[at]))
                && row.counts.iter().all(|(symbol, _)| *symbol != NONE && exists(layout[3], *symbol));
            if !whole {
                return Err(malformed("a count names somebody or something that has no name"));
            }
            for (symbol, count) in &row.counts {
                habits.counts.add(key(kind, row.slot, row.after), *symbol, f64::from(*count), row.touched_min);
            }
        }
        Ok(habits)
    }

    /// What was learned, as bytes with a version and a checksum: counts of names and hours, no sentences.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        self.stored().to_bytes()
    }

    /// Takes up what [`Habits::to_bytes`] gave. Limits are those of `options`: what is too much is left out, the least useful first.
    ///
    /// # Errors
    /// When the bytes are damaged, of another version, or say something impossible: [`StoredError`] says which. Nothing is taken up then.
    pub fn from_bytes(options: HabitsOptions, bytes: &[u8]) -> Result<Self, StoredError> {
        Self::restore(options, &Stored::from_bytes(bytes)?)
    }

    /// What was learned, as JSON for people and other programs.
    ///
    /// # Errors
    /// When it cannot be written as JSON: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        serde_json::to_string(&self.stored()).map_err(|error| malformed(error.to_string()))
    }

    /// Takes up what [`Habits::to_json`] gave.
    ///
    /// # Errors
    /// As [`Habits::from_bytes`].
    pub fn from_json(options: HabitsOptions, json: &str) -> Result<Self, StoredError> {
        if json.len() > 4 * BYTES_MAX {
            return Err(StoredError::TooLarge { bytes: json.len() });
        }
        let Keyed(stored): Keyed<Stored> = serde_json::from_str(json).map_err(|error| malformed(json_says(&error)))?;
        Self::restore(options, &stored.checked()?)
    }
}

/// Forecasts of rooms and factors of their products in version 2 of the file.
const ROOM_EXPERTS_OF_2: usize = 7;
const ROOM_FACTORS_OF_2: usize = 5;

/// Takes up the next of a person's stored products.
fn restore_together<const N: usize>(
    together: &mut Together<N>,
    weights: &mut &[f64],
    person: PersonId,
) -> Result<(), StoredError> {
    let powers = taken(weights, person)?;
    let Some((information, rest)) = weights.split_at_checked(N * N) else {
        return Err(malformed(format!("weights of person {person} are missing")));
    };
    *weights = rest;
    together.restore(powers, information);
    Ok(())
}

/// The next of a person's stored weights.
fn taken<const N: usize>(weights: &mut &[f64], person: PersonId) -> Result<[f64; N], StoredError> {
    let Some((own, rest)) = weights.split_first_chunk() else {
        return Err(malformed(format!("weights of person {person} are missing")));
    };
    *weights = rest;
    Ok(*own)
}

/// Elsewhere among the names of places; no room has an empty word for a name, and none has this one.
const ELSEWHERE_NAME: &str = "(elsewhere)";

#[cfg(test)]
mod tests;
