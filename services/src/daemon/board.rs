//! From observations to the snapshot that is published: the pipeline's step, with sequence numbers, ages and flags. No clock,
//! no port: the daemon's loop, the simulation and the tests drive it alike.

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
    /// More partitions than a message has places.
    #[error(
        "the map has {partitions} partitions at this level, a message carries at most {MAX_ROOMS}: choose grounding.level = \"room\" or \"group\", or a smaller map"
    )]
    TooManyPartitions {
        /// How many.
        partitions: usize,
    },
    /// A partition's id does not fit.
    #[error(
        "the partition {id:?} cannot be named in a message (at most {NAME_BYTES} bytes): shorten its id in the scene"
    )]
    Name {
        /// The id.
        id: String,
        /// Why.
        source: MessageError,
    },
}

/// A map that cannot take the place of the one in use.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MapError {
    /// Messages cannot carry it.
    #[error(transparent)]
    Board(#[from] BoardError),
    /// It cannot be grounded, or its labels do not fit the model's context.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
}

/// An observation and when it was received, in monotonic nanoseconds.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// What was observed.
    pub observation: Observation,
    /// When the daemon received it.
    pub received_ns: BootNs,
    /// Whether observations of its source were lost before it.
    pub after_gap: bool,
    /// For whom it counts in its person's window.
    pub voice: Voice,
    /// The start of a source, by number and epoch, that gives way to its source.
    pub leaves: Option<(u64, u64)>,
}

impl Entry {
    /// An observation after no gap, for which nobody gives way, of its source's own voice.
    #[must_use]
    pub fn new(observation: Observation, received_ns: BootNs) -> Self {
        let voice = Voice::of_source(observation.source);
        Self { observation, received_ns, after_gap: false, voice, leaves: None }
    }
}

/// When something was observed, on the monotonic clock; negative where that was before the machine's start, which the wall clock knows.
/// None where no clock tells: also where the wall clock stands before that time, so that it was set wrong since, or then.
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
    /// A device was found off, and no key says that its person did it.
    is_off: bool,
}

/// An observation that named nobody, and whom it fitted.
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
    /// What a forecast assumes before it has watched its person.
    options: ForecastOptions,
    mentions: PlaceMatcher,
    snapshot: RoomScoresV1,
    /// The rooms of a changed map, until a step has scored them; the snapshot and the forecasts are of the map before it.
    next_rooms: Option<Box<NamedRooms>>,
    /// The newest forecast; what is beyond the rooms and horizons stays zero.
    forecast: Box<ForecastV1>,
    /// Each person's scores, of the same step as the snapshot.
    person_scores: Box<PersonScoresV1>,
    /// The newest forecast of each person; what is beyond the rooms and horizons stays zero.
    person_forecasts: Box<PersonForecastsV1>,
    /// Who is who, and who is in the house.
    persons: Persons,
    /// Narrators that the configuration names, by the number of their source, and the events that each may send.
    named: BTreeMap<u64, May>,
    /// How the newest events were understood.
    understood: UnderstoodEvents,
    /// The joint filter, from the first event on that needs it; and the devices that reported.
    tracking: Option<Box<Tracking>>,
    /// While it runs, each person's forecast with its belief.
    told: BTreeMap<PersonId, Forecaster>,
    sensors: Sensors,
    robots: Robots,
    /// Local time less the monotonic clock, in seconds.
    local_ahead_s: f64,
    /// Working memory of a step: when each person was observed last, and their number.
    newest_persons: Vec<(i64, PersonId)>,
    /// What the journal does not know yet: whose an observation that named nobody is, and whose scores are new.
    attributed: Vec<Attributed>,
    rescored: Vec<PersonId>,
    /// The same of whom observations moved that could be read otherwise by another company.
    moved: Vec<Moved>,
    /// Memory for the moves of further observations.
    no_moves: Vec<Vec<Move>>,
    /// The same of where everybody was when the map was changed, and of visitors who are gone by silence.
    believed: Vec<Believed>,
    gone: Vec<PersonId>,
    /// Events that the forecasts do not have yet.
    seen: VecDeque<Seen>,
    /// Of the narration that no step has scored yet: when its first was received, of each person and of nobody, and whether some was lost before it.
    unscored: BTreeMap<PersonId, BootNs>,
    unscored_ns: Option<BootNs>,
    unscored_gap: bool,
    /// Rooms that somebody was said to be in and that the map does not have, as they were logged.
    strange_rooms: BTreeSet<String>,
    /// Texts that resemble a presence form and are none, as they were logged.
    near_misses: BTreeSet<String>,
    /// Working memory of a step: the sources that the scores name, in the order of the message, each with how many newer ones of its voice
    /// there are.
    newest_sources: Vec<(usize, Included)>,
    /// The newest turn of a source that scores were told with.
    named_turn: u64,
    /// Per person where they will be; persons unknown to the histories are forgotten.
    followed: BTreeMap<PersonId, Forecaster>,
    /// What is learned of the home.
    home: HomeHabits,
    /// Nothing was told to the journal since it was read: what it says of those who were not heard since needs no repetition.
    recalled: bool,
    /// What the model has said after each person's newest restored observation, as far as the journal knows; nothing of who was out.
    said: BTreeMap<PersonId, Vec<f64>>,
    /// Changes when somebody is forgotten, whom nobody who works ahead may know any more.
    forgotten: u64,
    /// Grows with each step that asked the model, and with each person whose answers went with them; and what of this and of the forgetting was told to
    /// whoever works ahead.
    askings: u64,
    told_ahead: (u64, u64),
    prepared: PreparedTally,
}

/// What was prepared since the start, for the status.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PreparedTally {
    /// Prompts that steps asked about.
    pub asked: u64,
    /// Answers that were prepared and of use.
    pub prepared: u64,
    /// Prepared answers that a step used.
    pub used: u64,
}

/// Names of rooms that the map does not have which are logged, until the map changes.
const STRANGE_ROOMS_LOGGED: usize = 16;

/// Texts that resemble a presence form and are none which are logged, until a restart.
const NEAR_MISSES_LOGGED: usize = 16;

/// Things whose probability is explained by habits.
const REASONS: usize = 12;

/// Observations whose memory is used again: more come at once after a stand-still only.
const SEEN_KEPT: usize = 256;

/// The horizons that the forecast is published for, in seconds.
pub const HORIZONS_S: [f32; MAX_HORIZONS] =
    [0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0, 900.0, 1800.0, 3600.0];

impl<M: LanguageModel> Board<M> {
    /// A board without scores; `epoch` is random per start of the daemon, `grounding` what the pipeline's map is grounded by.
    ///
    /// # Errors
    ///
    /// [`BoardError`] when the map does not fit into a message.
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

    /// The same with the names and residents of a home.
    #[must_use]
    pub fn with_persons(self, persons: Persons) -> Self {
        Self { persons, ..self }
    }

    /// The same with narrators that the configuration names, by the numbers of their sources ([`PersonsConfig::guard_s`]).
    ///
    /// [`PersonsConfig::guard_s`]: crate::config::PersonsConfig::guard_s
    #[must_use]
    pub(crate) fn with_named(self, named: impl IntoIterator<Item = (u64, May)>) -> Self {
        Self { named: named.into_iter().collect(), ..self }
    }

    /// The same with other assumptions about how long people stay.
    #[must_use]
    pub(crate) fn with_forecast(self, options: ForecastOptions) -> Self {
        Self { options, ..self }
    }

    /// The same with habits of the home.
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

    /// Has `moved` called after each call of the model's decoder.
    pub(super) fn watch_model(&mut self, moved: Progress) {
        self.pipeline.ahead().watch(moved);
    }

    /// The ids of the map's rooms, in the order in which habits have them.
    pub(super) fn room_ids(&self) -> impl Iterator<Item = &str> {
        self.pipeline.grounding().partitions().iter().map(|room| room.id.as_str())
    }

    /// What is learned of the home.
    #[must_use]
    pub fn habits(&self) -> &HomeHabits {
        &self.home
    }

    /// The same, to forget or to replace it, and to take what is to be written.
    pub fn habits_mut(&mut self) -> &mut HomeHabits {
        &mut self.home
    }

    /// Whether the joint filter runs: a sensor reported, or an unnamed event that two persons can have caused.
    #[must_use]
    pub fn is_joint(&self) -> bool {
        self.tracking.is_some()
    }

    /// Binds habits that were replaced to the map in use.
    pub(super) fn bind_habits(&mut self) {
        self.home.bind(self.pipeline.grounding());
    }

    /// Lets habits count the time spent, about once a minute, and gives whether it did.
    pub fn tick(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> bool {
        if !self.home.is_tick_due(now_ns) || !self.is_scored() {
            return false;
        }
        self.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        self.watch();
        self.home.tick(now_ns, now_unix_ns, &self.followed);
        true
    }

    /// Takes a changed map in place of the one in use; the next step's scores are of it. Gives what it asked of the model. Until a step
    /// succeeds, snapshot and forecasts stay those of the map before.
    ///
    /// # Errors
    ///
    /// [`MapError`] when the map does not fit into a message, or cannot be grounded; the old one stays in use then.
    pub fn change_map(&mut self, map: SemanticMap) -> Result<Prepared, MapError> {
        // What was seen on the old map is understood by it.
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

    /// Takes note of where everybody in the house is believed to be, by the rooms of a changed map: what they said before is not to be read by it.
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

    /// Which room of a changed map each room of the newest scores is, and how many the changed one has.
    fn new_places(&self) -> (Vec<Option<usize>>, usize) {
        let before = self.snapshot.rooms().iter().map(|room| room.id);
        let after = match self.next_rooms.as_deref() {
            Some((room, count)) => room.iter().take(*count as usize).map(|room| room.id).collect(),
            None => before.clone().collect::<Vec<_>>(),
        };
        (before.map(|id| after.iter().position(|other| *other == id)).collect(), after.len())
    }

    /// Where everybody was believed to be when the map was changed, for the journal; each is told once.
    pub fn tell_beliefs(&mut self, tell: impl FnMut(Believed)) {
        self.believed.drain(..).for_each(tell);
    }

    /// Visitors who are gone by silence, for the journal; each is told once.
    pub fn tell_gone(&mut self, tell: impl FnMut(PersonId)) {
        self.gone.drain(..).for_each(tell);
    }

    /// After the first good step with a changed map: the snapshot is of it, and the forecasts too.
    fn adopt_map(&mut self) {
        // Nearly every step: nothing is allocated for it.
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
            // Where somebody is believed to be stays so; what was observed meanwhile is taken in with the new map.
            self.followed.values_mut().for_each(|own| own.take_rooms(&new, rooms));
        }
        let ways_in = ways_out(self.pipeline.grounding());
        self.followed.values_mut().for_each(|own| own.come_in_by(&ways_in));
        // It starts again with the rooms of the changed map.
        self.tracking = None;
        if !self.sensors.is_empty() {
            self.start_tracking(i64::try_from(self.snapshot.computed_ns).unwrap_or(i64::MAX));
        }
    }

    /// Whether the scores are of the map in use: not while a changed map waits for its first ones.
    pub(super) fn is_scored(&self) -> bool {
        self.next_rooms.is_none()
    }

    /// Whether something has changed since the last [`Board::now`].
    #[must_use]
    pub(crate) fn is_ahead_due(&self) -> bool {
        self.is_scored() && self.told_ahead != (self.askings, self.forgotten)
    }

    /// What whoever works ahead has to know.
    pub fn now(&mut self) -> Now {
        self.told_ahead = (self.askings, self.forgotten);
        Now { outlook: self.pipeline.ahead().outlook(), forgotten: self.forgotten }
    }

    /// Keeps an answer for when it is asked for, if it is of use.
    pub fn keep_answer(&mut self, answer: Answer) {
        self.prepared.prepared += u64::from(self.pipeline.ahead().keep_answer(answer));
    }

    /// What was prepared since the start.
    #[must_use]
    pub fn prepared(&self) -> PreparedTally {
        self.prepared
    }

    /// After a step: what it asked, and what was ready.
    fn count_prepared(&mut self) {
        let scores = self.pipeline.scores();
        self.prepared.asked += scores.asked as u64;
        self.askings += u64::from(scores.asked > 0);
        self.prepared.used += scores.prepared as u64;
        if scores.prepared > 0 && scores.prepared == scores.asked {
            self.snapshot.flags |= score_flags::PREPARED;
        }
    }

    /// Whoever works ahead is to forget what it has heard.
    pub(super) fn forget_ahead(&mut self) {
        self.forgotten += 1;
    }

    /// All that is behind the newest scores, and what was learned, in the forecasts of `now_ns`.
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

    /// How much of a person's latest forecast comes from where, for some horizons, with the sets.
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
                persistence: sure * shares.persistence,
                leaving: sure * shares.semi_markov,
                later: sure * shares.later,
                set: held.chain(set.elsewhere.then(|| ELSEWHERE.to_owned())).collect(),
                set_probability: of_places,
            }
        };
        told.map(line).collect()
    }

    /// What was learned of a person, in the latest forecast.
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

    /// Enters observations of a former run without scoring: into the histories, and with their times into the forecasts, together with what
    /// the model said after some of them. Gives how many were left out, because they cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        let (map, mut costly) = (self.map_number(), 0);
        let Recovered { observations, mut expectations, forgotten, mut moved, of_other_boots, .. } = recovered;
        let started_unix_ns = now_unix_ns.saturating_sub(now_ns.0);
        self.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        let mut forgotten = forgotten.into_iter().peekable();
        let learned = self.home.begin_recall(&observations, now_ns, now_unix_ns);
        // What is said of several persons after one step is told in no particular order.
        expectations.sort_by_key(|(after, person, _)| (*after, *person));
        let mut expectations = expectations.iter().peekable();
        for (index, mut observation) in observations.into_iter().enumerate() {
            if observation.by_fit {
                // The home may have given the person another number since.
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
                // What was said of its person then rests on it.
                while expectations.next_if(|(after, ..)| *after <= index).is_some() {}
                continue;
            }
            let name = observation.id();
            let is_of_another_boot = of_other_boots.contains(&name);
            if is_of_another_boot {
                // However little the wall clock says has passed, it was before the machine's start; 0 would say that it has no time.
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
                // What the former run refused has no moves.
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
                // An older daemon has not said whom it moved, or one that was killed.
                let enter = |board: &mut Self, own: Observation| {
                    persons.push(own.person);
                    board.enter_restored(voice, own);
                };
                let (is_read_alone, mut moves) = self.attribute(observation, Voice::EARLIER, reporter, at_ns, enter);
                // It stays so, whoever is known at the next start. Whose one of one person is was told already.
                if persons.is_empty() || !is_read_alone && moves.len() != 1 {
                    self.moved.push(Moved { observation: name, moves });
                } else {
                    moves.clear();
                    self.no_moves.push(moves);
                }
            }
            while let Some((_, person, expectation)) = expectations.next_if(|(after, ..)| *after <= index) {
                let person = self.persons.file().current(*person);
                // Whose the observation was may be lost: then it may be somebody else's now, and says nothing of this one.
                if !persons.contains(&person) {
                    continue;
                }
                let said: Vec<f64> =
                    expectation.probability.iter().map(|probability| f64::from(*probability)).collect();
                // Of one who is out it is known all the same that they were told of.
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

    /// Enters an observation of a former run that is a person's.
    fn enter_restored(&mut self, voice: Voice, own: Observation) {
        let person = own.person;
        self.pipeline.intake().enter(voice, own);
        self.follow();
        match self.persons.get_mut(person) {
            // They were told of.
            Some(known) if known.presence == Presence::Gone => _ = self.persons.remove(person),
            Some(known) => known.restored = true,
            None => {}
        }
        self.said.remove(&person);
    }

    /// Takes note up to which sequence a former run has dealt with the starts of sources, of which the journal tells no more.
    pub(super) fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.pipeline.intake().settle(settled);
    }

    /// Takes note of a narration that was refused, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, event: EventId) {
        self.pipeline.intake().pass_over(event);
    }

    /// How many tokens a sentence may cost with the map in use.
    #[must_use]
    pub(crate) fn sentence_tokens_max(&self) -> usize {
        self.pipeline.inside().options().history.tokens
    }

    /// The first bytes of the map's fingerprint.
    pub(super) fn map_number(&self) -> u64 {
        let fingerprint = self.map.fingerprint();
        fingerprint.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    /// Forgets a person altogether, with what `is_theirs` says of others' observations; the next step's scores are without them.
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

    /// Knows nothing of a person any more, but for what was learned.
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

    /// Whether time alone changes the scores: a window ends, or a visitor is gone.
    #[must_use]
    pub fn is_overdue(&self, now_ns: BootNs) -> bool {
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        self.persons.expired(now_ns).is_some() || self.silent(now_ns).is_some() || self.departed().is_some()
    }

    /// The next person that counts as present although the filter believes that the person left.
    fn departed(&self) -> Option<PersonId> {
        const OUT: f64 = 0.95;
        let is_present =
            |person: &PersonId| self.persons.get(*person).is_some_and(|own| own.presence == Presence::Present);
        let tracking = self.tracking.as_deref()?;
        tracking.persons().iter().copied().find(|person| is_present(person) && tracking.out_now(*person) > OUT)
    }

    /// The next person whose window is to end, because they did nothing for too long.
    fn silent(&self, now_ns: i64) -> Option<PersonId> {
        let limits = self.pipeline.inside().options().history;
        let mut windows = self.pipeline.inside().histories().iter().filter(|(_, history)| !history.is_empty());
        let silent = |person: PersonId| {
            self.persons.get(person).is_some_and(|known| limits.is_gap(seconds(now_ns.saturating_sub(known.did_ns))))
        };
        windows.find(|(person, _)| silent(*person)).map(|(person, _)| person)
    }

    /// Does what time alone asks for.
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
            // A restart believes the same without a record: the filter says it again.
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

    /// Takes the scored observations into the forecasts of their persons, and each person's own scores into theirs.
    fn watch(&mut self) {
        if self.next_rooms.is_some() {
            // The forecasts are of the map before; what is observed waits for the first scores of the new one.
            return;
        }
        self.follow();
        // What the model said before something that it has not scored yet says nothing of what comes after that.
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

    /// Takes the new events into the forecasts.
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
                    // The room and the bed before this deed.
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

    /// Takes all entries as one step: every one goes into its history, then the rooms are scored once. Gives when the first narration that
    /// the scores newly contain was received, also by a step before that failed.
    ///
    /// # Errors
    ///
    /// When the model fails. The observations are in the histories all the same; the snapshot keeps the last good scores, says
    /// so in its flags, and does not claim the new narration.
    pub fn step(
        &mut self,
        entries: impl IntoIterator<Item = Entry>,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
    ) -> Result<Option<BootNs>, PipelineError> {
        self.take_in(entries, now_ns, now_unix_ns);
        self.score_within(now_ns, now_unix_ns, u64::MAX)
    }

    /// The first part of a step: the observations enter the histories of their persons. The journal can write them while the model scores.
    pub(super) fn take_in(&mut self, entries: impl IntoIterator<Item = Entry>, now_ns: BootNs, now_unix_ns: UnixNs) {
        // What nobody wanted a forecast from, nor was there time for: with the scores of its own step.
        self.watch();
        if self.next_rooms.is_some() {
            // A scorer that fails on and on must not fill the memory.
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
            // What moves nobody may be of one who is away, and calls.
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
            // Who lies in bed does not expire like others. At any other time what was observed waits for the scores to be sent.
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

    /// Who is who, and who is in the house.
    #[must_use]
    pub fn persons(&self) -> &Persons {
        &self.persons
    }

    /// Gives a person a name, or another one.
    ///
    /// # Errors
    /// In words, when the name is somebody else's or none, or the file cannot be written.
    pub fn rename(&mut self, person: PersonId, name: &str) -> Result<(), NotRenamed> {
        self.persons.rename(person, name)
    }

    /// The same, to give names.
    pub(super) fn persons_mut(&mut self) -> &mut Persons {
        &mut self.persons
    }

    /// What became of the observations of the last good step, for the journal; each is told once.
    pub fn tell_outcomes(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.tell_whose(&mut tell);
        self.tell_expected(tell);
        // Who does not ask for it has no journal to keep it in.
        self.tell_moved(|_| {});
    }

    /// Whom the observations of the last step moved, nobody included, for the journal; each is told once. A restart that read them again would do so
    /// with those who are known then.
    pub(super) fn tell_moved(&mut self, mut tell: impl FnMut(&Moved)) {
        for mut moved in self.moved.drain(..) {
            tell(&moved);
            moved.moves.clear();
            self.no_moves.push(moved.moves);
        }
    }

    /// Of the outcomes those on which scores rest: whose an observation is that names nobody.
    pub(super) fn tell_whose(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        let map = self.map_number();
        for Attributed { event, person } in self.attributed.drain(..) {
            tell(&Outcome { event, person, by_fit: true, map, probability: &[] });
        }
    }

    /// The other outcomes: where each person's next thing is expected. They can wait for the scores and the forecast.
    pub(super) fn tell_expected(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.watch();
        let map = self.map_number();
        let (recalled, said) = (self.recalled, &self.said);
        self.rescored.retain(|&person| {
            if self.pipeline.inside().waits(person) {
                return true;
            }
            // Of who is out it says whose the observation is.
            let own = self.pipeline.inside().person(person).filter(|own| own.at_home);
            let expected = self.followed.get(&person).and_then(Forecaster::expected);
            let own = own.map(|own| expected.unwrap_or(&own.grounded.partition_probability));
            // Where a part of their narration was lost, the model says something else of the rest, and that is what is believed from now on.
            // And what a daemon that was killed did not tell, or lost with the power, is told now.
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

    /// The current snapshot, as it was sent last.
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

    /// A small part of the work that can wait until there is nothing else to do. Gives whether there is more.
    pub fn tidy(&mut self) -> bool {
        self.watch();
        self.pipeline.ahead().tidy()
    }
}

/// Whether the daemon learns habits of a person: not of a visitor, nor of a person that only unknown narrators report.
fn is_learned_of(persons: &Persons, named: &BTreeMap<u64, May>, person: PersonId) -> bool {
    !persons.is_visitor(person) && (named.is_empty() || persons.is_trusted(person))
}

/// A smaller share of a thing than this is in the room that somebody is believed in: it is in another one.
const SAME_ROOM: f64 = 0.05;

/// Fills the begin of a row; gives how much of it.
fn fill(row: &mut [f64], values: impl Iterator<Item = f64>) -> usize {
    row.iter_mut().zip(values).map(|(place, value)| *place = value).count()
}

/// Whether probabilities are the same but for how the journal rounds them. A wider bound would gain nothing: the included model scores the same window
/// to the last bit again, also when it has read nothing before, another window moves it by some 1e-2, and no claim waits for what is told again.
fn are_alike(said: &[f64], now: &[f64]) -> bool {
    const ROUNDING: f64 = 1e-6;
    said.len() == now.len() && said.iter().zip(now).all(|(said, now)| (said - now).abs() < ROUNDING)
}

/// The label that is turned to, and not left.
fn turned_to(mention: Option<Mention>) -> Option<usize> {
    mention.filter(|found| !found.is_left).map(|found| found.label)
}

/// A person who is followed from now on.
fn follower(grounding: &Grounding, options: ForecastOptions, at_ns: i64) -> Forecaster {
    let mut own = Forecaster::new(grounding.partitions().len(), options, seconds(at_ns));
    own.come_in_by(&ways_out(grounding));
    own
}

/// The partition that a room's name means, by its own name or as the one that the room lies in; none where several have the name.
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
    // A room in parts is none of them.
    within.next().is_none().then_some(only)
}

/// The partitions that are called so.
fn rooms_alike<'a>(name: &'a str, grounding: &'a Grounding) -> impl Iterator<Item = usize> + 'a {
    (0..).zip(grounding.partitions()).filter(move |(_, partition)| partition.label == name).map(|(at, _)| at)
}

#[cfg(test)]
mod tests;
