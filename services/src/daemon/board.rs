//! From events to the published snapshot: the pipeline's step, with sequence numbers, ages and flags. No clock and no port, so the daemon's loop, the
//! simulation and the tests drive the same code.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

use roomcast_ipc::MessageError;
use roomcast_ipc::raw::{
    ForecastV1, LEARNED_SHARE_S, MAX_HORIZONS, MAX_ROOMS, NAME_BYTES, PersonForecastsV1, PersonScoresV1, RoomScoresV1,
    RoomV1, reached, score_flags,
};

use super::ahead::Now;
use super::habits::{HomeHabits, PlaceSet};
use super::intake::OTHERS;
use super::journal::{Believed, Move, Moved, Outcome, Recovered};
use super::persons::{NotRenamed, Persons};
use super::sleep::{deeds, is_bed, may_be_done_lying, sleeps};
use super::understood::UnderstoodEvents;
use crate::config::May;
use crate::habits_reason::{ELSEWHERE, HorizonLine, PersonHabits, RoomReason, ThingReason};
use crate::moment::Moment;
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{Grounding, GroundingOptions, partitions};
use roomcast_core::habits::{Place as Whereabouts, WhenShares};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Presence, Voice};
use roomcast_core::pipeline::{Included, Pipeline, PipelineError, Prepared};
use roomcast_core::places::{Mention, PlaceMatcher};
use roomcast_core::prepared::Answer;
use roomcast_core::scorer::{LanguageModel, Progress};
use roomcast_core::semantic_map::SemanticMap;

use attribution::Reporter;
use messages::{NamedRooms, named_rooms};
use robots::Robots;
use tracking::{Sensors, Tracking};
use ways_out::ways_out;

mod attribution;
mod messages;
mod robots;
mod tracking;
mod ways_out;
mod whereabouts;

/// A map that messages cannot carry.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BoardError {
    /// The map has more partitions than a message has places.
    #[error(
        "the map has {partitions} partitions at this level, a message carries at most {MAX_ROOMS}: choose grounding.level = \"room\" or \"group\", or a smaller map"
    )]
    TooManyPartitions {
        /// The number of partitions.
        partitions: usize,
    },
    /// The id of a partition does not fit into a message.
    #[error(
        "the partition {id:?} cannot be named in a message (at most {NAME_BYTES} bytes): shorten its id in the scene"
    )]
    Name {
        /// The id.
        id: String,
        /// The cause.
        source: MessageError,
    },
}

/// A map that cannot replace the one in use.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MapError {
    /// The map does not fit into messages.
    #[error(transparent)]
    Board(#[from] BoardError),
    /// The map cannot be grounded, or its labels do not fit the model's context.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
}

/// An event, and the time at which it was received.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The event.
    pub observation: Observation,
    /// The time on the monotonic clock.
    pub received_ns: BootNs,
    /// Whether earlier events of its narrator were lost.
    pub after_gap: bool,
    /// The quota that it counts against in its person's window.
    pub voice: Voice,
    /// The narrator's start (source and epoch) that gave way to this event's start.
    pub leaves: Option<(u64, u64)>,
}

impl Entry {
    /// An event after no gap, of its source's own quota, for which no start gave way.
    #[must_use]
    pub fn new(observation: Observation, received_ns: BootNs) -> Self {
        let voice = Voice::of_source(observation.source);
        Self { observation, received_ns, after_gap: false, voice, leaves: None }
    }
}

/// The time of an event on the monotonic clock; negative before the machine's start. `None` if no clock tells, or if a wall-clock time is in the
/// future, so that the wall clock is or was wrong.
fn observed_at_ns(observation: &Observation, now_ns: BootNs, now_unix_ns: UnixNs) -> Option<i64> {
    let signed = |ns: u64| i64::try_from(ns).unwrap_or(i64::MAX);
    match (observation.observed_ns, observation.observed_unix_ns) {
        (BootNs(0), UnixNs(0)) => None,
        (BootNs(0), unix_ns) if unix_ns > now_unix_ns => None,
        (BootNs(0), unix_ns) => Some(signed(now_ns.0).saturating_sub(signed(now_unix_ns.since(unix_ns)))),
        (monotonic_ns, _) => Some(signed(monotonic_ns.0)),
    }
}

fn seconds(ns: i64) -> f64 {
    ns as f64 / 1e9
}

/// An event of a person that the forecasts do not have yet.
#[derive(Debug)]
struct Seen {
    name: EventId,
    person: PersonId,
    at_ns: i64,
    event: Event,
    /// A device turned off, and no key says that the person did it.
    is_off: bool,
}

/// An unnamed event, and the person that it fits.
#[derive(Debug, Clone, Copy)]
struct Attributed {
    event: EventId,
    person: PersonId,
}

/// Owns the pipeline and the current snapshot.
#[derive(Debug)]
pub struct Board<M> {
    pipeline: Pipeline<M>,
    map: SemanticMap,
    grounding: GroundingOptions,
    /// The assumptions of a forecast about an unobserved person.
    options: ForecastOptions,
    mentions: PlaceMatcher,
    snapshot: RoomScoresV1,
    /// The rooms of a changed map, until a step has scored them. Until then the snapshot and the forecasts are for the previous map.
    next_rooms: Option<Box<NamedRooms>>,
    /// Values beyond the rooms and horizons stay zero.
    forecast: Box<ForecastV1>,
    /// Of the same step as the snapshot.
    person_scores: Box<PersonScoresV1>,
    /// Values beyond the rooms and horizons stay zero.
    person_forecasts: Box<PersonForecastsV1>,
    persons: Persons,
    /// The narrators of the configuration by source, and the events that each may send.
    named: BTreeMap<u64, May>,
    understood: UnderstoodEvents,
    /// The joint filter. `None` before the first event that needs it.
    tracking: Option<Box<Tracking>>,
    /// Each person's forecast with the belief of the joint filter, while that runs.
    told: BTreeMap<PersonId, Forecaster>,
    sensors: Sensors,
    robots: Robots,
    /// Local time minus the monotonic clock, in seconds.
    local_ahead_s: f64,
    /// Working memory of a step: the time of each person's newest event, and the person.
    newest_persons: Vec<(i64, PersonId)>,
    /// Attributions of unnamed events, for the state database.
    attributed: Vec<Attributed>,
    rescored: Vec<PersonId>,
    /// The persons that events moved, for the state database. Only events that a daemon with other known persons would attribute differently.
    moved: Vec<Moved>,
    no_moves: Vec<Vec<Move>>,
    /// Beliefs at a change of the map, for the state database.
    believed: Vec<Believed>,
    gone: Vec<PersonId>,
    seen: VecDeque<Seen>,
    /// The time at which each person's first unscored event was received.
    unscored: BTreeMap<PersonId, BootNs>,
    unscored_ns: Option<BootNs>,
    unscored_gap: bool,
    /// Room names that the map lacks, once they were logged.
    strange_rooms: BTreeSet<String>,
    /// Texts that resemble a presence form, once they were logged.
    near_misses: BTreeSet<String>,
    /// Working memory of a step: the sources in the order of the message, each with the number of newer ones of the same quota.
    newest_sources: Vec<(usize, Included)>,
    /// The newest turn of a source in published scores.
    named_turn: u64,
    /// The forecasts by person. A person without a history is removed.
    followed: BTreeMap<PersonId, Forecaster>,
    home: HomeHabits,
    /// The state database was read, and no expectation was written since. Restored persons without new events need no repetition.
    recalled: bool,
    /// The expectation after each person's newest restored event, as the state database has it; empty if the person was out.
    said: BTreeMap<PersonId, Vec<f64>>,
    /// Changes when a person is forgotten. The prefetcher must then forget its sentences.
    forgotten: u64,
    /// Grows with each step that asked the model, and with each removed person.
    askings: u64,
    told_ahead: (u64, u64),
    prepared: PreparedTally,
}

/// Counters of prefetching since the start, for the status.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PreparedTally {
    /// Prompts that steps scored.
    pub asked: u64,
    /// Prefetched answers that were kept.
    pub prepared: u64,
    /// Prefetched answers that a step used.
    pub used: u64,
}

/// Most unknown room names that are logged, until the map changes.
const STRANGE_ROOMS_LOGGED: usize = 16;

/// Most texts near a presence form that are logged, until a restart.
const NEAR_MISSES_LOGGED: usize = 16;

/// Most things in an explanation by habits.
const REASONS: usize = 12;

/// Most events whose memory is kept. Only a stall brings more at once.
const SEEN_KEPT: usize = 256;

/// The horizons of the published forecasts, in seconds.
pub const HORIZONS_S: [f32; MAX_HORIZONS] =
    [0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0, 900.0, 1800.0, 3600.0];

impl<M: LanguageModel> Board<M> {
    /// A board without scores. `epoch` is random per start of the daemon; `grounding` has the options of the pipeline's grounding.
    ///
    /// # Errors
    ///
    /// [`BoardError`] if the map does not fit into a message.
    pub fn new(
        pipeline: Pipeline<M>,
        map: SemanticMap,
        grounding: GroundingOptions,
        epoch: u64,
    ) -> Result<Self, BoardError> {
        let (room, room_count) = named_rooms(pipeline.grounding().partitions())?;
        let snapshot = RoomScoresV1 {
            epoch,
            model_fingerprint: pipeline.inside().model().fingerprint,
            map_fingerprint: map.fingerprint(),
            room_count,
            room,
            reached: reached::EXACT,
            ..Default::default()
        };
        Ok(Self {
            mentions: PlaceMatcher::new(&map, pipeline.grounding()),
            pipeline,
            map,
            grounding,
            options: ForecastOptions::default(),
            snapshot,
            next_rooms: None,
            forecast: Box::default(),
            person_scores: Box::default(),
            person_forecasts: Box::default(),
            persons: Persons::default(),
            named: BTreeMap::new(),
            understood: UnderstoodEvents::default(),
            tracking: None,
            told: BTreeMap::new(),
            sensors: Sensors::default(),
            robots: Robots::default(),
            local_ahead_s: 0.0,
            newest_persons: Vec::new(),
            attributed: Vec::new(),
            moved: Vec::new(),
            no_moves: Vec::new(),
            rescored: Vec::new(),
            believed: Vec::new(),
            gone: Vec::new(),
            seen: VecDeque::new(),
            unscored: BTreeMap::new(),
            unscored_ns: None,
            unscored_gap: false,
            strange_rooms: BTreeSet::new(),
            near_misses: BTreeSet::new(),
            newest_sources: Vec::new(),
            named_turn: 0,
            followed: BTreeMap::new(),
            home: HomeHabits::default(),
            recalled: false,
            said: BTreeMap::new(),
            forgotten: 0,
            askings: 0,
            told_ahead: (0, 0),
            prepared: PreparedTally::default(),
        })
    }

    /// Sets the names and residents of the home.
    #[must_use]
    pub fn with_persons(self, persons: Persons) -> Self {
        Self { persons, ..self }
    }

    /// Sets the narrators of the configuration by source ([`PersonsConfig::guard_s`]).
    ///
    /// [`PersonsConfig::guard_s`]: crate::config::PersonsConfig::guard_s
    #[must_use]
    pub(crate) fn with_named(self, named: impl IntoIterator<Item = (u64, May)>) -> Self {
        Self { named: named.into_iter().collect(), ..self }
    }

    #[must_use]
    pub(crate) fn with_forecast(self, options: ForecastOptions) -> Self {
        Self { options, ..self }
    }

    /// Sets the habits of the home.
    #[must_use]
    pub fn with_habits(self, mut home: HomeHabits) -> Self {
        home.bind(self.pipeline.grounding());
        Self { home, ..self }
    }

    /// The narrator of an event. If the configuration names narrators, any other one may only send actions.
    fn reporter(&self, source: u64, is_unknown: bool) -> Reporter {
        let may = if self.named.is_empty() { Some(May::ALL) } else { self.named.get(&source).copied() };
        Reporter { is_unknown, may: may.filter(|_| !is_unknown).unwrap_or(May::DID) }
    }

    /// Calls `moved` after each call of the model's decoder.
    pub(super) fn watch_model(&mut self, moved: Progress) {
        self.pipeline.ahead().watch(moved);
    }

    /// The ids of the map's rooms, in the order of the habits.
    pub(super) fn room_ids(&self) -> impl Iterator<Item = &str> {
        self.pipeline.grounding().partitions().iter().map(|room| room.id.as_str())
    }

    /// The habits of the home.
    #[must_use]
    pub fn habits(&self) -> &HomeHabits {
        &self.home
    }

    /// The habits of the home, to change them or to take what must be written.
    pub fn habits_mut(&mut self) -> &mut HomeHabits {
        &mut self.home
    }

    /// Whether the joint filter runs: a sensor reported, or an unnamed event that two persons can have caused.
    #[must_use]
    pub fn is_joint(&self) -> bool {
        self.tracking.is_some()
    }

    /// Binds replaced habits to the map in use.
    pub(super) fn bind_habits(&mut self) {
        self.home.bind(self.pipeline.grounding());
    }

    /// Lets habits count time, about once a minute. Returns whether they did.
    pub fn tick(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> bool {
        if !self.home.is_tick_due(now_ns) || !self.is_scored() {
            return false;
        }
        self.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        self.watch();
        self.home.tick(now_ns, now_unix_ns, &self.followed);
        true
    }

    /// Replaces the map; the next step scores it. Returns the preparation of the model. Until a step succeeds, snapshot and forecasts stay those of
    /// the previous map.
    ///
    /// # Errors
    ///
    /// [`MapError`] if the map does not fit into a message or cannot be grounded. The old map then stays in use.
    pub fn change_map(&mut self, map: SemanticMap) -> Result<Prepared, MapError> {
        // Events on the old map are understood by the old map.
        self.watch();
        let rooms = named_rooms(&partitions(&map, self.grounding.level))?;
        let before: Vec<String> = self.pipeline.grounding().label_texts().into_iter().map(str::to_owned).collect();
        let prepared = self.pipeline.change_map(&map, &self.grounding)?;
        if prepared.again {
            let texts = self.pipeline.grounding().label_texts();
            let place: HashMap<&str, usize> = texts.iter().enumerate().map(|(place, text)| (*text, place)).collect();
            let new = |label: usize| before.get(label).and_then(|text| place.get(text.as_str()).copied());
            self.followed.values_mut().for_each(|own| own.relabel(&new));
        }
        self.next_rooms = Some(Box::new(rooms));
        self.strange_rooms.clear();
        self.rescored.clear();
        self.rescored.extend(self.persons.iter().map(|(person, _)| person));
        self.mentions = PlaceMatcher::new(&map, self.pipeline.grounding());
        self.map = map;
        self.tracking = None;
        self.robots.forget_rooms();
        self.note_beliefs();
        Ok(prepared)
    }

    /// Notes the belief about each person in the house, by the rooms of the changed map. A restart must not read earlier events by that map.
    fn note_beliefs(&mut self) {
        let map = self.map_number();
        let (new, rooms) = self.new_places();
        self.believed.clear();
        for (person, own) in &self.followed {
            let Some(known) = self.persons.get(*person).filter(|known| known.presence == Presence::Present) else {
                continue;
            };
            let mut own = own.clone();
            own.take_rooms(&new, rooms);
            let (last, paces, probability) = (known.last, own.paces(), own.belief().to_vec());
            self.believed.push(Believed { last, person: *person, map, paces, probability });
        }
    }

    /// The index in the changed map of each room of the newest scores, and the number of rooms of the changed map.
    fn new_places(&self) -> (Vec<Option<usize>>, usize) {
        let before = self.snapshot.rooms().iter().map(|room| room.id);
        let after = match self.next_rooms.as_deref() {
            Some((room, count)) => room.iter().take(*count as usize).map(|room| room.id).collect(),
            None => before.clone().collect::<Vec<_>>(),
        };
        (before.map(|id| after.iter().position(|other| *other == id)).collect(), after.len())
    }

    /// Passes the beliefs at a change of the map to `tell`, once, for the state database.
    pub fn tell_beliefs(&mut self, tell: impl FnMut(Believed)) {
        self.believed.drain(..).for_each(tell);
    }

    /// Passes the visitors that are gone by silence to `tell`, once, for the state database.
    pub fn tell_gone(&mut self, tell: impl FnMut(PersonId)) {
        self.gone.drain(..).for_each(tell);
    }

    /// Publishes a changed map after its first good step.
    fn adopt_map(&mut self) {
        // This is nearly every step, so it allocates nothing.
        if self.is_scored() {
            return;
        }
        let (new, rooms) = self.new_places();
        let Some(next) = self.next_rooms.take() else { return };
        let (room, room_count) = *next;
        self.snapshot.map_fingerprint = self.map.fingerprint();
        (self.snapshot.room, self.snapshot.room_count) = (room, room_count);
        *self.forecast = ForecastV1::default();
        self.home.bind(self.pipeline.grounding());
        if new.len() != rooms || new.iter().enumerate().any(|(place, new)| *new != Some(place)) {
            // The beliefs stay; events since the change are read with the new map.
            self.followed.values_mut().for_each(|own| own.take_rooms(&new, rooms));
        }
        let ways_in = ways_out(self.pipeline.grounding());
        self.followed.values_mut().for_each(|own| own.come_in_by(&ways_in));
        // The filter starts again with the rooms of the changed map.
        self.tracking = None;
        if !self.sensors.is_empty() {
            self.start_tracking(i64::try_from(self.snapshot.computed_ns).unwrap_or(i64::MAX));
        }
    }

    /// Whether the scores are for the map in use: false until the first scores of a changed map.
    pub(super) fn is_scored(&self) -> bool {
        self.next_rooms.is_none()
    }

    /// Whether the prefetcher's state is stale.
    #[must_use]
    pub(crate) fn is_ahead_due(&self) -> bool {
        self.is_scored() && self.told_ahead != (self.askings, self.forgotten)
    }

    /// The state for the prefetcher.
    pub fn now(&mut self) -> Now {
        self.told_ahead = (self.askings, self.forgotten);
        Now { outlook: self.pipeline.ahead().outlook(), forgotten: self.forgotten }
    }

    /// Stores a prefetched answer, if it is useful.
    pub fn keep_answer(&mut self, answer: Answer) {
        self.prepared.prepared += u64::from(self.pipeline.ahead().keep_answer(answer));
    }

    /// The counters of prefetching since the start.
    #[must_use]
    pub fn prepared(&self) -> PreparedTally {
        self.prepared
    }

    fn count_prepared(&mut self) {
        let scores = self.pipeline.scores();
        self.prepared.asked += scores.asked as u64;
        self.askings += u64::from(scores.asked > 0);
        self.prepared.used += scores.prepared as u64;
        if scores.prepared > 0 && scores.prepared == scores.asked {
            self.snapshot.flags |= score_flags::PREPARED;
        }
    }

    /// Makes the prefetcher forget all sentences.
    pub(super) fn forget_ahead(&mut self) {
        self.forgotten += 1;
    }

    /// The data behind the newest scores, and the habits, with the forecasts of `now_ns`.
    #[must_use]
    pub fn moment(&mut self, now_ns: BootNs) -> Moment {
        self.forecast(now_ns);
        let names =
            self.persons.iter().filter_map(|(person, _)| Some((person, self.persons.name_of(person)?.to_owned())));
        let known = self.home.persons().into_iter().map(|(person, _)| person);
        let known = known.filter(|person| self.persons.get(*person).is_some());
        Moment {
            names: names.collect(),
            habits: known.map(|person| self.habits_of(person)).collect(),
            ..Moment::of(&self.pipeline, &self.map, &self.grounding, Some(&self.snapshot))
        }
    }

    /// The parts of a person's latest forecast, with the room sets, for some horizons.
    pub(super) fn habits_ahead(&self, person: PersonId) -> Vec<HorizonLine> {
        let (Some((sure, shares)), Some((_, sets))) = (self.home.shares(person), self.home.sets(person)) else {
            return Vec::new();
        };
        let Some(probabilities) = self.home.probabilities(person) else { return Vec::new() };
        let rooms = self.snapshot.rooms();
        let told = HORIZONS_S.iter().zip(shares.iter().zip(sets).zip(probabilities));
        let told = told.filter(|(horizon_s, _)| LEARNED_SHARE_S.contains(horizon_s));
        let line = |(horizon_s, ((shares, set), row)): (&f32, ((&WhenShares, &PlaceSet), &[f64]))| {
            let of_places = row.split_last().map(|(elsewhere, known)| {
                let of_rooms = known.iter().enumerate().filter(|(room, _)| set.rooms >> room & 1 == 1);
                of_rooms.map(|(_, p)| p).chain(set.elsewhere.then_some(elsewhere)).sum()
            });
            let held = rooms.iter().enumerate().filter(|(room, _)| set.rooms >> room & 1 == 1);
            let held = held.map(|(_, room)| room.id().to_owned());
            HorizonLine {
                horizon_s: f64::from(*horizon_s),
                shipped: 1.0 - sure + sure * shares.shipped,
                leaving: sure * shares.leaving,
                later: sure * shares.later,
                set: held.chain(set.elsewhere.then(|| ELSEWHERE.to_owned())).collect(),
                set_probability: of_places,
            }
        };
        told.map(line).collect()
    }

    /// The part of habits in a person's latest forecast.
    fn habits_of(&self, person: PersonId) -> PersonHabits {
        let labels = self.pipeline.grounding().label_texts();
        let thing = |(label, text): (usize, &&str)| {
            Some(ThingReason { label: (*text).to_owned(), shares: self.home.why_thing(person, label)? })
        };
        let mut things: Vec<_> = labels.iter().enumerate().filter_map(thing).collect();
        things.sort_by(|a, b| b.shares.probability.total_cmp(&a.shares.probability));
        things.truncate(REASONS);
        let room = |(index, room): (usize, &RoomV1)| {
            Some(RoomReason { room: room.id().to_owned(), shares: self.home.why_room(person, index)? })
        };
        let mut rooms: Vec<_> = self.snapshot.rooms().iter().enumerate().filter_map(room).collect();
        rooms.sort_by(|a, b| b.shares.probability.total_cmp(&a.shares.probability));
        PersonHabits {
            person,
            observations: self.home.observations_of(person),
            things,
            rooms,
            forecast: self.habits_ahead(person),
            coverage: self.home.sets(person).map_or(0.0, |(coverage, _)| coverage),
            ..PersonHabits::default()
        }
    }

    /// Restores the events of a former run without scoring, with their times, and the expectations after some of them. Returns the number of events
    /// that were left out because they cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        let (map, mut costly) = (self.map_number(), 0);
        let Recovered { observations, mut expectations, forgotten, mut moved, of_other_boots, .. } = recovered;
        let started_unix_ns = now_unix_ns.saturating_sub(now_ns.0);
        self.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        let mut forgotten = forgotten.into_iter().peekable();
        let learned = self.home.begin_recall(&observations, now_ns, now_unix_ns);
        // Expectations of several persons after one step have no order.
        expectations.sort_by_key(|(after, person, _)| (*after, *person));
        let mut expectations = expectations.iter().peekable();
        for (index, mut observation) in observations.into_iter().enumerate() {
            if observation.by_fit {
                // The home may have given the person another number in the meantime.
                observation.person = self.persons.file().current(observation.person);
            }
            if index == learned {
                self.home.end_recall();
            }
            while let Some((_, person)) = forgotten.next_if(|(before, _)| *before <= index) {
                self.lose(person);
            }
            if self.pipeline.intake().is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.id());
                // The expectation after it rests on it.
                while expectations.next_if(|(after, ..)| *after <= index).is_some() {}
                continue;
            }
            let name = observation.id();
            let is_of_another_boot = of_other_boots.contains(&name);
            if is_of_another_boot {
                // The event was before the machine's start, whatever the wall clock says. A time of 0 would mean no time.
                observation.observed_unix_ns = observation.observed_unix_ns.min(started_unix_ns.max(UnixNs(1)));
            }
            let mut at_ns = observed_at_ns(&observation, now_ns, now_unix_ns);
            if is_of_another_boot {
                at_ns = Some(at_ns.unwrap_or(0).min(0));
            }
            let voice = Voice::of_source(observation.source);
            let is_unknown = !self.named.is_empty() && !self.named.contains_key(&observation.source);
            let reporter = self.reporter(observation.source, is_unknown);
            self.pipeline.intake().include(&observation, voice);
            let mut persons = Vec::new();
            if let Some(moves) = moved.remove(&name) {
                // A refused event has no moves.
                if !moves.is_empty() {
                    self.weigh_again(&observation, reporter, at_ns);
                }
                for own in moves {
                    let person = self.persons.file().current(own.person);
                    let own = Move { person, ..own }.apply(&observation);
                    if let Some(own) = self.retake(own, reporter, at_ns) {
                        persons.push(own.person);
                        self.enter_restored(voice, own);
                    }
                }
            } else {
                // A former run that was killed, or an older version, did not store the moves.
                let enter = |board: &mut Self, own: Observation| {
                    persons.push(own.person);
                    board.enter_restored(voice, own);
                };
                let (is_read_alone, mut moves) = self.attribute(observation, Voice::EARLIER, reporter, at_ns, enter);
                // The next start repeats these moves, whoever is known then. An attribution to one person is stored already.
                if persons.is_empty() || !is_read_alone && moves.len() != 1 {
                    self.moved.push(Moved { observation: name, moves });
                } else {
                    moves.clear();
                    self.no_moves.push(moves);
                }
            }
            while let Some((_, person, expectation)) = expectations.next_if(|(after, ..)| *after <= index) {
                let person = self.persons.file().current(*person);
                // The attribution may be lost. The event may then be another person's, and this expectation is void.
                if !persons.contains(&person) {
                    continue;
                }
                let said: Vec<f64> =
                    expectation.probability.iter().map(|probability| f64::from(*probability)).collect();
                // For a person who is out, the stored expectation is empty.
                if said.is_empty() {
                    self.said.insert(person, said);
                } else if let Some(own) = self.followed.get_mut(&person).filter(|_| expectation.map == map) {
                    match expectation.paces {
                        Some(paces) => {
                            own.believe(&said, paces.map(f64::from));
                            let heard_ns = self.persons.get(person).map_or(0, |known| known.heard_ns);
                            self.home.stayed(person, heard_ns, own);
                        }
                        None => {
                            own.expect(&said);
                            self.said.insert(person, said);
                        }
                    }
                }
            }
        }
        forgotten.for_each(|(_, person)| self.lose(person));
        self.recalled = true;
        self.home.end_restore();
        self.pipeline.intake().forget_voices();
        costly
    }

    /// Restores the part of one person in an event of a former run.
    fn enter_restored(&mut self, voice: Voice, own: Observation) {
        let person = own.person;
        self.pipeline.intake().enter(voice, own);
        self.follow();
        match self.persons.get_mut(person) {
            // The departure was published.
            Some(known) if known.presence == Presence::Gone => _ = self.persons.remove(person),
            Some(known) => known.restored = true,
            None => {}
        }
        self.said.remove(&person);
    }

    /// Sets, per start of a narrator, the last sequence that a former run handled and the state database has dropped.
    pub(super) fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.pipeline.intake().settle(settled);
    }

    /// Counts a refused event as handled, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, event: EventId) {
        self.pipeline.intake().pass_over(event);
    }

    /// The most tokens of a sentence, with the map in use.
    #[must_use]
    pub(crate) fn sentence_tokens_max(&self) -> usize {
        self.pipeline.inside().options().history.tokens
    }

    /// The first bytes of the map's fingerprint.
    pub(super) fn map_number(&self) -> u64 {
        let fingerprint = self.map.fingerprint();
        fingerprint.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    /// Forgets a person, and the events of other persons for which `is_theirs` holds. The next step's scores are without them.
    pub(super) fn forget(&mut self, person: PersonId, is_theirs: impl Fn(&Observation) -> bool) {
        self.watch();
        self.lose(person);
        self.pipeline.intake().forget_told(is_theirs);
        // Texts of others may name the person.
        self.understood = UnderstoodEvents::default();
        self.near_misses.clear();
        self.sensors.forget(person);
        self.home.forget(person);
        self.forget_ahead();
    }

    /// Forgets a person except for the habits.
    fn lose(&mut self, person: PersonId) {
        self.follow();
        self.persons.remove(person);
        self.attributed.retain(|attributed| attributed.person != person);
        self.moved.iter_mut().for_each(|moved| moved.moves.retain(|own| own.person != person));
        self.understood.forget(person);
        self.drop_person(person);
    }

    fn drop_person(&mut self, person: PersonId) {
        self.pipeline.intake().forget_person(person);
        self.askings += 1;
        self.followed.remove(&person);
        self.told.remove(&person);
        if let Some(tracking) = &mut self.tracking {
            tracking.remove(person);
        }
        self.home.lose(person);
    }

    /// Whether time alone changes the scores: a window ends, a visitor is gone, or the filter believes that a person left.
    #[must_use]
    pub fn is_overdue(&self, now_ns: BootNs) -> bool {
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        self.persons.expired(now_ns).is_some() || self.silent(now_ns).is_some() || self.departed().is_some()
    }

    fn departed(&self) -> Option<PersonId> {
        const OUT: f64 = 0.95;
        let is_present =
            |person: &PersonId| self.persons.get(*person).is_some_and(|own| own.presence == Presence::Present);
        let tracking = self.tracking.as_deref()?;
        tracking.persons().iter().copied().find(|person| is_present(person) && tracking.out_now(*person) > OUT)
    }

    /// The next person with a window that ends because the person was inactive for too long.
    fn silent(&self, now_ns: i64) -> Option<PersonId> {
        let limits = self.pipeline.inside().options().history;
        let mut windows = self.pipeline.inside().histories().iter().filter(|(_, history)| !history.is_empty());
        let silent = |person: PersonId| {
            self.persons.get(person).is_some_and(|known| limits.is_gap(seconds(now_ns.saturating_sub(known.did_ns))))
        };
        windows.find(|(person, _)| silent(*person)).map(|(person, _)| person)
    }

    fn lapse(&mut self, now_ns: BootNs) {
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        while let Some(person) = self.silent(now_ns) {
            self.pipeline.intake().end_window(person);
            if let Some(own) = self.followed.get_mut(&person) {
                own.end_window();
            }
            if !self.rescored.contains(&person) {
                self.rescored.push(person);
            }
        }
        while let Some(person) = self.persons.expired(now_ns) {
            self.persons.expire(person, now_ns);
            self.drop_person(person);
            if !self.gone.contains(&person) {
                self.gone.push(person);
            }
        }
        while let Some(person) = self.departed() {
            // A restart needs no record of it: the filter repeats it.
            let last = self.persons.get(person).map_or(EventId::new(0, 0, 0), |known| known.last);
            let observed_ns = BootNs(u64::try_from(now_ns).unwrap_or_default());
            let away =
                Observation { person, by_fit: true, observed_ns, ..Observation::saying(last.sequence, Event::Away) };
            let away = Observation { source: last.source, epoch: last.epoch, ..away };
            if let Ok(own) = self.take(away, Voice::EARLIER, (self.reporter(last.source, true), true), Some(now_ns)) {
                self.pipeline.intake().enter(Voice::EARLIER, own);
            }
        }
    }

    /// Updates the forecasts with the new events, and each person's forecast with their newest scores.
    fn watch(&mut self) {
        if self.next_rooms.is_some() {
            // The forecasts are for the previous map. New events wait for the first scores of the changed one.
            return;
        }
        self.follow();
        // Scores without the newest event do not predict the time after it.
        for own in self.pipeline.persons().filter(|own| own.at_home && own.is_current) {
            if let Some(followed) = self.followed.get_mut(&own.person) {
                followed.expect_next(self.pipeline.grounding(), own.label_log_prob_nats, own.number);
            }
        }
        while let Some(person) = self.home.next_rescored() {
            let Some(own) = self.pipeline.inside().person(person).filter(|own| own.at_home) else { continue };
            let Some(known) = self.persons.get(person) else { continue };
            let expected = self.followed.get(&person).and_then(Forecaster::expected);
            let rooms = expected.unwrap_or(&own.grounded.partition_probability);
            self.home.look_ahead(person, known.heard_ns, own.label_log_prob_nats, rooms);
        }
        self.seen.shrink_to(SEEN_KEPT);
    }

    fn is_learned_of(&self, person: PersonId) -> bool {
        is_learned_of(&self.persons, &self.named, person)
    }

    fn follow(&mut self) {
        let grounding = self.pipeline.grounding();
        for seen in self.seen.drain(..) {
            let at_s = seconds(seen.at_ns);
            self.home.next_is(seen.name, seen.person, is_learned_of(&self.persons, &self.named, seen.person));
            if seen.event == Event::Gone {
                self.followed.remove(&seen.person);
                self.home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere));
                continue;
            }
            let own = self.followed.entry(seen.person).or_insert_with(|| follower(grounding, self.options, seen.at_ns));
            match &seen.event {
                Event::Did(_) if seen.is_off => {}
                Event::Did(text) => {
                    let mention = self.mentions.last(text.as_str());
                    // The place before this action.
                    let was_on_bed = self.persons.get(seen.person).is_some_and(|known| known.on_bed);
                    let (mut near, mut rooms) = ([0.0; MAX_ROOMS], 0);
                    if was_on_bed {
                        rooms = fill(&mut near, own.at(at_s, 0.0));
                    }
                    // The model's scores after all events are for the time after them.
                    own.observe(at_s, mention, grounding, &[]);
                    self.home.turned(seen.person, seen.at_ns, turned_to(mention), own);
                    let Some(known) = self.persons.get_mut(seen.person) else { continue };
                    for deed in deeds(text.as_str()) {
                        let found = self.mentions.last(deed);
                        let row = |found: &Mention| grounding.weights().row(found.label);
                        let stays = |found: &Mention| {
                            let likeliest = (0..rooms).max_by(|a, b| near[*a].total_cmp(&near[*b]));
                            let is_here = likeliest.is_some_and(|room| row(found)[room] > SAME_ROOM);
                            known.on_bed && is_here && may_be_done_lying(deed)
                        };
                        let is_bed = |found: &Mention| is_bed(&grounding.scored_labels()[found.label].text);
                        let on_bed = found.map(|found| is_bed(&found) || stays(&found));
                        known.on_bed = sleeps(deed).or(on_bed).unwrap_or(known.on_bed && may_be_done_lying(deed));
                        if let Some(found) = found.filter(is_bed) {
                            rooms = fill(&mut near, row(&found).iter().copied());
                        }
                    }
                }
                Event::Present(named) => {
                    let name = named.as_ref().map_or("", |name| name.as_str());
                    let room = room_named(name, &self.map, grounding);
                    let alike = |other| room.is_none() && rooms_alike(name, grounding).any(|one| one == other);
                    let was_here = room.is_none_or(|room| own.at(at_s, 0.0).nth(room).is_some_and(|p| p > 0.5));
                    if !was_here
                        && !self.sensors.has_on_bed(seen.person, named.as_ref())
                        && let Some(known) = self.persons.get_mut(seen.person)
                    {
                        // Persons who walk into another room are up.
                        known.on_bed = false;
                    }
                    // An event that is older than the belief changes neither belief nor habits.
                    if own.enter_any(at_s, |other| Some(other) == room || alike(other)) {
                        self.home.is_in(seen.person, seen.at_ns, room.map(Whereabouts::Room));
                    }
                }
                _ => {
                    own.leave(at_s);
                    self.home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere));
                }
            }
        }
        let histories = self.pipeline.inside().histories();
        self.followed.retain(|person, _| histories.get(*person).is_some());
    }

    /// Keeps the newest `most` events that the forecasts do not have yet.
    fn drop_unwatched(&mut self, most: usize) {
        let excess = self.seen.len().saturating_sub(most);
        self.seen.drain(..excess);
    }

    /// Takes all entries into the histories, then scores the rooms once. Returns the time at which the oldest newly scored event was received, also
    /// if an earlier step failed to score it.
    ///
    /// # Errors
    ///
    /// If the model fails. The events stay in the histories. The snapshot keeps the last good scores, sets a flag, and does not claim the new events.
    pub fn step(
        &mut self,
        entries: impl IntoIterator<Item = Entry>,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
    ) -> Result<Option<BootNs>, PipelineError> {
        self.take_in(entries, now_ns, now_unix_ns);
        self.score_within(now_ns, now_unix_ns, u64::MAX)
    }

    /// The first part of a step: the events enter the histories of their persons. The state database can write them while the model scores.
    pub(super) fn take_in(&mut self, entries: impl IntoIterator<Item = Entry>, now_ns: BootNs, now_unix_ns: UnixNs) {
        // If no forecast was computed since the last step, its events are taken in now, with the scores of that step.
        self.watch();
        if self.next_rooms.is_some() {
            // A permanently failing scorer must not fill the memory.
            self.drop_unwatched(SEEN_KEPT);
        }
        self.persons.remove_gone();
        self.home.set_clock(now_ns, now_unix_ns);
        self.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        let mut costly = 0;
        for Entry { observation, received_ns, after_gap, voice, leaves } in entries {
            self.unscored_gap |= after_gap;
            if let Some((source, epoch)) = leaves {
                self.pipeline.intake().forget_source(source, epoch);
            }
            if self.pipeline.intake().is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.id());
                self.unscored_ns.get_or_insert(received_ns);
                continue;
            }
            let at_ns = observed_at_ns(&observation, now_ns, now_unix_ns).or(i64::try_from(received_ns.0).ok());
            let is_unknown = !self.named.is_empty() && voice.number == OTHERS;
            let reporter = self.reporter(observation.source, is_unknown);
            self.pipeline.intake().include(&observation, voice);
            let name = observation.id();
            let mut is_taken = false;
            let enter = |board: &mut Self, own: Observation| {
                is_taken = true;
                board.unscored.entry(own.person).or_insert(received_ns);
                board.pipeline.intake().enter(voice, own);
            };
            let (is_read_alone, moves) = self.attribute(observation, voice, reporter, at_ns, enter);
            // A restart must not move a person by an event that moved no person before.
            if !is_read_alone || !is_taken {
                self.moved.push(Moved { observation: name, moves });
            } else {
                self.no_moves.push(moves);
            }
            if !is_taken {
                self.unscored_ns.get_or_insert(received_ns);
            }
        }
        if costly > 0 {
            tracing::warn!(
                costly,
                "narration that was accepted for another map costs more tokens than a window holds now, and is left out"
            );
        }
        if self.next_rooms.is_none() && self.is_overdue(now_ns) {
            // Expiry depends on whether a person is in bed, which these events may change. Otherwise the events wait until the scores are sent.
            self.follow();
        }
        self.lapse(now_ns);
    }

    /// The second part of a step. After `patience_ns` it scores no further person: the next step goes on ([`Pipeline::score_within`]). The snapshot
    /// then has the last scores of the persons who wait, does not claim their observations, and says that it is behind. After a change of the map it
    /// stays of the map before until all persons have scores of the new one.
    ///
    /// # Errors
    ///
    /// As [`Board::step`].
    pub(super) fn score_within(
        &mut self,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
        patience_ns: u64,
    ) -> Result<Option<BootNs>, PipelineError> {
        if let Err(error) = self.pipeline.score_within(patience_ns) {
            self.snapshot.flags |= score_flags::SCORER_FAILED;
            self.count_prepared();
            return Err(error);
        }
        if self.next_rooms.is_some() && self.pipeline.inside().is_owing() {
            self.count_prepared();
            return Ok(None);
        }
        self.adopt_map();
        let pipeline = &self.pipeline;
        self.rescored
            .iter()
            .filter(|person| !pipeline.inside().waits(**person))
            .for_each(|person| self.home.rescored(*person));
        self.snapshot.sequence += 1;
        self.snapshot.computed_ns = now_ns.0;
        self.snapshot.computed_unix_ns = now_unix_ns.0;
        let mut received_ns = self.unscored_ns.take();
        self.unscored.retain(|person, first_ns| {
            let waits = pipeline.inside().waits(*person);
            if !waits {
                received_ns = Some(received_ns.map_or(*first_ns, |before_ns| before_ns.min(*first_ns)));
            }
            waits
        });
        self.snapshot.received_ns = received_ns.map_or(self.snapshot.received_ns, |received_ns| received_ns.0);
        self.snapshot.wait_ns = received_ns.map_or(0, |received_ns| now_ns.since(received_ns));
        self.snapshot.flags = if std::mem::take(&mut self.unscored_gap) { score_flags::GAP } else { 0 };
        self.count_prepared();
        self.fill();
        Ok(received_ns)
    }

    /// Names, numbers and presence of the persons.
    #[must_use]
    pub fn persons(&self) -> &Persons {
        &self.persons
    }

    /// Gives a person a name, or another one.
    ///
    /// # Errors
    /// If the name belongs to another person or is no name, or if the state database cannot be written.
    pub fn rename(&mut self, person: PersonId, name: &str) -> Result<(), NotRenamed> {
        self.persons.rename(person, name)
    }

    pub(super) fn persons_mut(&mut self) -> &mut Persons {
        &mut self.persons
    }

    /// Passes the outcomes of the last good step to `tell`, once, for the state database.
    pub fn tell_outcomes(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.tell_whose(&mut tell);
        self.tell_expected(tell);
        // A caller that stores moves has taken them before.
        self.tell_moved(|_| {});
    }

    /// Passes the moves of the last step's events to `tell`, once, for the state database. Without them, a restart would attribute the events by the
    /// persons known then.
    pub(super) fn tell_moved(&mut self, mut tell: impl FnMut(&Moved)) {
        for mut moved in self.moved.drain(..) {
            tell(&moved);
            moved.moves.clear();
            self.no_moves.push(moved.moves);
        }
    }

    /// Passes the attributions of unnamed events to `tell`, once. The scores rest on them.
    pub(super) fn tell_whose(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        let map = self.map_number();
        for Attributed { event, person } in self.attributed.drain(..) {
            tell(&Outcome { event, person, by_fit: true, map, probability: &[] });
        }
    }

    /// Passes each person's expectation to `tell`, once. This can wait until the scores and the forecast are sent.
    pub(super) fn tell_expected(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.watch();
        let map = self.map_number();
        let (recalled, said) = (self.recalled, &self.said);
        self.rescored.retain(|&person| {
            if self.pipeline.inside().waits(person) {
                return true;
            }
            // A person who is out has no expectation; the record confirms the attribution.
            let own = self.pipeline.inside().person(person).filter(|own| own.at_home);
            let expected = self.followed.get(&person).and_then(Forecaster::expected);
            let own = own.map(|own| expected.unwrap_or(&own.grounded.partition_probability));
            // If events were lost, the model's expectation differs from the stored one, and is written. It is also written if a killed daemon, or a
            // power loss, left none.
            let is_same = said.get(&person).is_some_and(|said| own.is_none_or(|own| are_alike(said, own)));
            let is_said = |restored| recalled && restored && is_same;
            if let Some(known) = self.persons.get(person).filter(|known| !is_said(known.restored)) {
                let probability = own.unwrap_or_default();
                tell(&Outcome { event: known.last, person, by_fit: false, map, probability });
            }
            false
        });
        if !self.pipeline.inside().is_behind() {
            self.recalled = false;
            self.said.clear();
        }
    }

    /// The newest snapshot, as last sent.
    #[must_use]
    pub fn snapshot(&self) -> &RoomScoresV1 {
        &self.snapshot
    }

    /// The pipeline.
    #[must_use]
    pub fn pipeline(&self) -> &Pipeline<M> {
        &self.pipeline
    }

    /// The map.
    #[must_use]
    pub fn map(&self) -> &SemanticMap {
        &self.map
    }

    /// Does a small part of the model's reading after an event.
    pub(super) fn read_on(&mut self) {
        self.pipeline.ahead().read_on();
    }

    /// Does a small part of the postponed work. Returns whether there is more.
    pub fn tidy(&mut self) -> bool {
        self.watch();
        self.pipeline.ahead().tidy()
    }
}

/// Whether the daemon learns habits of a person: not of visitors, and not of persons that only unknown narrators report.
fn is_learned_of(persons: &Persons, named: &BTreeMap<u64, May>, person: PersonId) -> bool {
    !persons.is_visitor(person) && (named.is_empty() || persons.is_trusted(person))
}

/// A thing with a smaller share in the person's room is in another room.
const SAME_ROOM: f64 = 0.05;

/// Fills the start of a row. Returns the number of values.
fn fill(row: &mut [f64], values: impl Iterator<Item = f64>) -> usize {
    row.iter_mut().zip(values).map(|(place, value)| *place = value).count()
}

/// Whether two expectations are equal up to the rounding of the state database. A wider bound would gain nothing: the included model scores an equal
/// window identically to the last bit, also after a restart. Another window changes the probabilities by about 1e-2, and no claim waits for these
/// records.
fn are_alike(said: &[f64], now: &[f64]) -> bool {
    const ROUNDING: f64 = 1e-6;
    said.len() == now.len() && said.iter().zip(now).all(|(said, now)| (said - now).abs() < ROUNDING)
}

/// The label, unless the person left it.
fn turned_to(mention: Option<Mention>) -> Option<usize> {
    mention.filter(|found| !found.is_left).map(|found| found.label)
}

fn follower(grounding: &Grounding, options: ForecastOptions, at_ns: i64) -> Forecaster {
    let mut own = Forecaster::new(grounding.partitions().len(), options, seconds(at_ns));
    own.come_in_by(&ways_out(grounding));
    own
}

/// The partition that a room's name means: by its own name, or as the one that contains the room. `None` if several match.
fn room_named(name: &str, map: &SemanticMap, grounding: &Grounding) -> Option<usize> {
    let partitions = grounding.partitions();
    if let Some(with_id) = partitions.iter().position(|partition| partition.id == name) {
        return Some(with_id);
    }
    let mut alike = rooms_alike(name, grounding);
    if let Some(first) = alike.next() {
        return alike.next().is_none().then_some(first);
    }
    let room = map.find_one_room(name)?;
    let mut within = (0..).zip(partitions).filter(|(_, partition)| partition.rooms.contains(&room));
    let (only, _) = within.next()?;
    // A room that is divided into several partitions is none of them.
    within.next().is_none().then_some(only)
}

fn rooms_alike<'a>(name: &'a str, grounding: &'a Grounding) -> impl Iterator<Item = usize> + 'a {
    (0..).zip(grounding.partitions()).filter(move |(_, partition)| partition.label == name).map(|(at, _)| at)
}

#[cfg(test)]
mod tests;
