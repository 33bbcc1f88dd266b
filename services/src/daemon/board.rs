//! From observations to the snapshot that is published: the pipeline's step, with sequence numbers, ages and flags. No clock,
//! no port: the daemon's loop, the simulation and the tests drive it alike.

use std::cmp::Reverse;
use std::collections::BTreeSet;

use roomcast_ipc::{
    ALL_PERSONS, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1, LEARNED_SHARE_S, MAX_HORIZONS, MAX_ITEMS,
    MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, MessageError, NAME_BYTES, NO_PARTITION, PersonForecastV1, PersonForecastsV1,
    PersonScoresV1, PersonV1, RoomScoresV1, RoomV1, forecast_flags, reached, score_flags, text,
};

use super::habits::{HomeHabits, Name, PlaceSet};
use super::intake::OTHERS;
use super::journal::{Outcome, Recovered};
use super::persons::{Persons, is_bed, message_ns, presence_value, sleeps};
use crate::habits_reason::{ELSEWHERE, HorizonLine, PersonHabits, RoomReason, ThingReason};
use crate::moment::Moment;
use roomcast_core::forecast::{ForecastOptions, Forecaster, Mention, Mentions};
use roomcast_core::grounding::{Grounding, GroundingOptions, Partition, partitions};
use roomcast_core::habits::{Place as Whereabouts, WhenShares};
use roomcast_core::narration::{Observation, Presence, PresenceStatement, SOMEBODY, Said, Voice, same_name};
use roomcast_core::pipeline::{Included, PersonScores, Pipeline, PipelineError, Prepared};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::scorer::certified::Effort;
use roomcast_core::semantic_map::SemanticMap;

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
    pub received_ns: u64,
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
    pub fn new(observation: Observation, received_ns: u64) -> Self {
        let voice = Voice::of_source(observation.source);
        Self { observation, received_ns, after_gap: false, voice, leaves: None }
    }
}

/// When something was observed, on the monotonic clock; negative where that was before the machine's start, which the wall clock knows.
/// None where no clock tells.
fn observed_at_ns(observation: &Observation, now_ns: u64, now_unix_ns: u64) -> Option<i64> {
    let signed = |ns: u64| i64::try_from(ns).unwrap_or(i64::MAX);
    match (observation.observed_ns, observation.observed_unix_ns) {
        (0, 0) => None,
        (0, unix_ns) => Some(signed(now_ns).saturating_sub(signed(now_unix_ns.saturating_sub(unix_ns)))),
        (monotonic_ns, _) => Some(signed(monotonic_ns)),
    }
}

fn seconds(ns: i64) -> f64 {
    ns as f64 / 1e9
}

/// An observation that the forecasts do not know yet.
#[derive(Debug)]
struct Seen {
    name: Name,
    person: u32,
    at_ns: i64,
    presence: Presence,
    /// What was said, where it has to be understood by the map: a sentence, or a room's name.
    words: String,
    is_sentence: bool,
}

/// An observation that named nobody, and whom it fitted.
#[derive(Debug, Clone, Copy)]
struct Attributed {
    source: u64,
    epoch: u64,
    sequence: u64,
    person: u32,
}

/// What says where somebody is.
#[derive(Debug, Clone, Copy)]
enum Place {
    /// A label that was mentioned.
    Label(usize),
    /// A room.
    Room(usize),
}

/// Owns the pipeline and the current snapshot.
#[derive(Debug)]
pub struct Board<M> {
    pipeline: Pipeline<M>,
    map: SemanticMap,
    grounding: GroundingOptions,
    /// What a forecast assumes before it has watched its person.
    options: ForecastOptions,
    mentions: Mentions,
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
    /// Narrators that the configuration names, by the number of their source; where there are any, the others are strangers.
    named: BTreeSet<u64>,
    /// Working memory of a step: when each person was observed last, and their number.
    newest_persons: Vec<(i64, u32)>,
    /// What the journal does not know yet: whose an observation that named nobody is, and whose scores are new.
    attributed: Vec<Attributed>,
    rescored: Vec<u32>,
    /// What the forecasts do not know yet are the first `unwatched` of them; the others are memory to be used again.
    seen: Vec<Seen>,
    unwatched: usize,
    /// Of the narration that no step has scored yet: when its first was received, and whether some was lost before it.
    unscored_ns: Option<u64>,
    unscored_gap: bool,
    /// Rooms that somebody was said to be in and that the map does not have, as they were logged.
    strange_rooms: BTreeSet<String>,
    /// Working memory of a step: the sources that the scores name, in the order of the message, each with how many newer ones of its voice
    /// there are.
    newest_sources: Vec<(usize, Included)>,
    /// The newest turn of a source that scores were told with.
    named_turn: u64,
    /// Per person where they will be; persons unknown to the histories are forgotten.
    followed: std::collections::BTreeMap<u32, Forecaster>,
    /// What is learned of the home.
    home: HomeHabits,
    /// Nothing was told to the journal since it was read: what it says of those who were not heard since needs no repetition.
    recalled: bool,
}

/// Names of rooms that the map does not have which are logged, until the map changes.
const STRANGE_ROOMS_LOGGED: usize = 16;

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
            model_fingerprint: pipeline.model().fingerprint,
            map_fingerprint: map.fingerprint(),
            room_count,
            room,
            reached: reached::EXACT,
            ..Default::default()
        };
        Ok(Self {
            mentions: Mentions::new(&map, pipeline.grounding()),
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
            named: BTreeSet::new(),
            newest_persons: Vec::new(),
            attributed: Vec::new(),
            rescored: Vec::new(),
            seen: Vec::new(),
            unwatched: 0,
            unscored_ns: None,
            unscored_gap: false,
            strange_rooms: BTreeSet::new(),
            newest_sources: Vec::new(),
            named_turn: 0,
            followed: std::collections::BTreeMap::new(),
            home: HomeHabits::default(),
            recalled: false,
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
    pub fn with_named(self, named: impl IntoIterator<Item = u64>) -> Self {
        Self { named: named.into_iter().collect(), ..self }
    }

    /// The same with other assumptions about how long people stay.
    #[must_use]
    pub fn with_forecast(self, options: ForecastOptions) -> Self {
        Self { options, ..self }
    }

    /// The same with habits of the home.
    #[must_use]
    pub fn with_habits(self, mut home: HomeHabits) -> Self {
        home.bind(self.pipeline.grounding());
        Self { home, ..self }
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

    /// Binds habits that were replaced to the map in use.
    pub(super) fn bind_habits(&mut self) {
        self.home.bind(self.pipeline.grounding());
    }

    /// Lets habits count the time spent, about once a minute, and gives whether it did.
    pub fn tick(&mut self, now_ns: u64, now_unix_ns: u64) -> bool {
        if !self.home.is_tick_due(now_ns) || !self.is_scored() {
            return false;
        }
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
        let prepared = self.pipeline.change_map(&map, &self.grounding)?;
        self.next_rooms = Some(Box::new(rooms));
        self.strange_rooms.clear();
        self.rescored.clear();
        self.rescored.extend(self.persons.iter().map(|(person, _)| person));
        self.mentions = Mentions::new(&map, self.pipeline.grounding());
        self.map = map;
        Ok(prepared)
    }

    /// After the first good step with a changed map: the snapshot is of it, and the forecasts too.
    fn adopt_map(&mut self, now_ns: u64, now_unix_ns: u64) {
        let Some(next) = self.next_rooms.take() else { return };
        let (room, room_count) = *next;
        let ids = |rooms: &[RoomV1], count: u32| -> Vec<_> {
            rooms.iter().map(|room| room.id).take(count as usize).collect()
        };
        let same_rooms = ids(&self.snapshot.room, self.snapshot.room_count) == ids(&room, room_count);
        self.snapshot.map_fingerprint = self.map.fingerprint();
        (self.snapshot.room, self.snapshot.room_count) = (room, room_count);
        *self.forecast = ForecastV1::default();
        self.home.bind(self.pipeline.grounding());
        if same_rooms {
            return;
        }
        // What was believed of other rooms says nothing of these, but what was observed does.
        let unwatched = std::mem::take(&mut self.unwatched);
        self.followed.clear();
        let grounding = self.pipeline.grounding();
        for (person, history) in self.pipeline.histories().iter() {
            let Some(known) = self.persons.get(person) else { continue };
            let mut own = None;
            for observation in history.observations() {
                let Some(at_ns) = observed_at_ns(observation, now_ns, now_unix_ns) else { continue };
                let own = own.get_or_insert_with(|| follower(grounding, self.options, at_ns));
                let words = place_words(observation.sentence().unwrap_or_default(), observation);
                if words.is_empty() {
                    continue;
                }
                let mention = self.mentions.last(words);
                own.observe(seconds(at_ns), mention, grounding, &[]);
            }
            let mut own = own.unwrap_or_else(|| follower(grounding, self.options, known.since_ns));
            if known.presence == Presence::Away {
                own.leave(seconds(known.since_ns));
            }
            self.followed.insert(person, own);
        }
        for seen in &self.seen[..unwatched] {
            let own = self.followed.get(&seen.person);
            self.home.next_is(seen.name, seen.person, !self.persons.is_visitor(seen.person));
            if let Some(own) = own.filter(|_| seen.is_sentence && seen.presence == Presence::Present) {
                let label = turned_to(self.mentions.last(&seen.words));
                self.home.turned(seen.person, seen.at_ns, label, own);
            } else {
                let out = seen.presence != Presence::Present;
                let room = room_named(&seen.words, &self.map, grounding).filter(|_| !out).map(Whereabouts::Room);
                let place = if out { Some(Whereabouts::Elsewhere) } else { room };
                self.home.is_in(seen.person, seen.at_ns, place, own);
            }
        }
    }

    /// Whether the scores are of the map in use: not while a changed map waits for its first ones.
    pub(super) fn is_scored(&self) -> bool {
        self.next_rooms.is_none()
    }

    /// All that is behind the newest scores, and what was learned, in the forecasts of `now_ns`.
    #[must_use]
    pub fn moment(&mut self, now_ns: u64) -> Moment {
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
    pub(super) fn habits_ahead(&self, person: u32) -> Vec<HorizonLine> {
        let (Some((sure, shares)), Some((_, sets))) = (self.home.shares(person), self.home.sets(person)) else {
            return Vec::new();
        };
        let rooms = self.snapshot.rooms();
        let told = HORIZONS_S.iter().zip(shares.iter().zip(sets));
        let told = told.filter(|(horizon_s, _)| LEARNED_SHARE_S.contains(horizon_s));
        let line = |(horizon_s, (shares, set)): (&f32, (&WhenShares, &PlaceSet))| {
            let held = rooms.iter().enumerate().filter(|(room, _)| set.rooms >> room & 1 == 1);
            let held = held.map(|(_, room)| room.id().to_owned());
            HorizonLine {
                horizon_s: f64::from(*horizon_s),
                shipped: 1.0 - sure + sure * shares.shipped,
                persistence: sure * shares.persistence,
                leaving: sure * shares.semi_markov,
                later: sure * shares.later,
                set: held.chain(set.elsewhere.then(|| ELSEWHERE.to_owned())).collect(),
            }
        };
        told.map(line).collect()
    }

    /// What was learned of a person, in the latest forecast.
    fn habits_of(&self, person: u32) -> PersonHabits {
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
        }
    }

    /// Enters observations of a former run without scoring: into the histories, and with their times into the forecasts, together with what
    /// the model said after some of them. Gives how many were left out, because they cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, now_ns: u64, now_unix_ns: u64) -> usize {
        let (map, mut costly) = (self.map_number(), 0);
        let Recovered { observations, mut expectations, forgotten, .. } = recovered;
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
            if self.pipeline.is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.source, observation.epoch, observation.sequence);
                // What was said of its person then rests on it.
                while expectations.next_if(|(after, ..)| *after <= index).is_some() {}
                continue;
            }
            let at_ns = observed_at_ns(&observation, now_ns, now_unix_ns);
            let voice = Voice::of_source(observation.source);
            let is_strange = !self.named.is_empty() && !self.named.contains(&observation.source);
            self.pipeline.include(&observation, voice);
            for clause in self.clauses(observation) {
                self.exclude(&clause, is_strange, at_ns);
                for own in self.of_persons(clause) {
                    let Some(own) = self.take(own, Voice::EARLIER, is_strange, at_ns) else { continue };
                    let person = own.person;
                    self.pipeline.enter(voice, own);
                    self.follow();
                    match self.persons.get_mut(person) {
                        // They were told of.
                        Some(known) if known.presence == Presence::Gone => _ = self.persons.remove(person),
                        Some(known) => known.restored = true,
                        None => {}
                    }
                }
            }
            while let Some((_, person, expectation)) = expectations.next_if(|(after, ..)| *after <= index) {
                let person = self.persons.file().current(*person);
                let said: Vec<f64> =
                    expectation.probability.iter().map(|probability| f64::from(*probability)).collect();
                if let Some(own) = self.followed.get_mut(&person).filter(|_| expectation.map == map) {
                    own.expect(&said);
                }
            }
        }
        forgotten.for_each(|(_, person)| self.lose(person));
        self.recalled = true;
        self.home.end_restore();
        self.pipeline.forget_voices();
        costly
    }

    /// Takes note of a narration that was refused, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, source: u64, epoch: u64, sequence: u64) {
        self.pipeline.pass_over(source, epoch, sequence);
    }

    /// How many tokens a sentence may cost with the map in use.
    #[must_use]
    pub fn sentence_tokens_max(&self) -> usize {
        self.pipeline.options().history.tokens
    }

    /// The first bytes of the map's fingerprint.
    fn map_number(&self) -> u64 {
        let fingerprint = self.map.fingerprint();
        fingerprint.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    /// The observations that one of several clauses stands for, each of those whom it names; itself where it has one.
    fn clauses(&self, observation: Observation) -> impl Iterator<Item = Observation> + use<M> {
        let said = observation.said.clauses(|name| self.persons.is_name_known(name));
        // What is keyed, or was found by fit, is so in the clauses that name nobody.
        let own = |said: Said| {
            let mut names = if said.is_of_a_pronoun() { Vec::new() } else { self.persons.named(&said) };
            let is_own = |name: &String| match &observation.name {
                Some(own) => same_name(own, name),
                None => self.persons.number_of(name) == observation.person,
            };
            if names.is_empty() || (names.len() == 1 && names.iter().all(is_own)) {
                return Observation { said, ..observation.clone() };
            }
            let name = if names.len() == 1 { names.pop().map(Into::into) } else { None };
            Observation { person: SOMEBODY, name, by_fit: false, said, ..observation.clone() }
        };
        let several: Vec<Observation> = said.into_iter().map(own).collect();
        several.is_empty().then_some(observation).into_iter().chain(several)
    }

    /// The observations of persons that one stands for; none where it moves nobody ("The milk is out."), or where its subject is somebody who is not known
    /// and may be anywhere ("Carl is on his way.").
    fn of_persons(&self, mut observation: Observation) -> impl Iterator<Item = Observation> + use<M> {
        let said = &observation.said;
        // A sentence that says where somebody else is, or that they come, is of them, whoever's narrator heard it.
        let is_keyed = observation.person != SOMEBODY || observation.name.is_some();
        let statement = match said {
            _ if !is_keyed => None,
            Said::Presence(statement) => Some(statement.clone()),
            Said::Sentence(sentence) => PresenceStatement::of_sentence(sentence.as_str()),
        };
        if statement.is_some_and(|statement| self.persons.is_of_others(&observation, &statement)) {
            (observation.person, observation.name) = (SOMEBODY, None);
        }
        let said = &observation.said;
        let is_open = observation.person == SOMEBODY && observation.name.is_none();
        let is_thing = |name: &str| self.mentions.knows(name) && !self.persons.is_name_known(name);
        let is_of_things = match said {
            Said::Presence(statement) => statement.names().any(is_thing),
            Said::Sentence(_) => said.moves_nobody(),
        };
        let is_unknown =
            || is_open && said.is_from_afar() && !said.is_of_a_pronoun() && self.persons.named(said).is_empty();
        // What has ended brings nobody home.
        let is_over = || is_open && said.is_of_an_end() && self.persons.count().1 == 0;
        let is_of_none = || is_open && self.persons.is_of_nobody(said);
        let is_of_nobody = is_of_things || is_over() || is_of_none() || is_unknown();
        (!is_of_nobody).then(|| self.persons.each(observation)).into_iter().flatten()
    }

    /// Decides whom an observation is of, and takes note of it: also for the forecasts, where its time is known. Gives it back for the
    /// history, unless something later has said otherwise of whether its person is in the house.
    /// What a stranger says of somebody who is guarded is passed over, too.
    fn take(
        &mut self,
        mut observation: Observation,
        voice: Voice,
        is_strange: bool,
        at_ns: Option<i64>,
    ) -> Option<Observation> {
        let noted_ns = at_ns.unwrap_or_default();
        match &observation.name {
            Some(name) => {
                observation.person = self.persons.number_of(name);
                self.persons.remember(observation.source, observation.person, noted_ns);
            }
            None if observation.person == SOMEBODY => {
                observation.name = self.persons.named(&observation.said).pop().map(Into::into);
                let is_meant = || observation.said.is_of_one_pronoun();
                let meant = || self.persons.antecedent(observation.source, noted_ns).filter(|_| is_meant());
                let person = match &observation.name {
                    Some(name) => self.persons.number_of(name),
                    None => meant().unwrap_or_else(|| self.fitting(&observation.said, noted_ns)),
                };
                if observation.name.is_some() {
                    self.persons.remember(observation.source, person, noted_ns);
                }
                (observation.person, observation.by_fit) = (person, observation.name.is_none());
                let Observation { source, epoch, sequence, .. } = observation;
                self.attributed.push(Attributed { source, epoch, sequence, person });
            }
            None if observation.by_fit => {
                // Who was told apart by a sentence's subject before a restart goes by it again.
                let mut names = self.persons.named(&observation.said).into_iter();
                let own = names.find(|name| self.persons.number_of(name) == observation.person);
                observation.name = own.map(Into::into);
                observation.by_fit = observation.name.is_none();
            }
            None => {}
        }
        if is_strange && self.persons.is_guarded(observation.person, noted_ns) {
            return None;
        }
        // After such a silence a visitor was gone, whether or not anybody looked meanwhile.
        if self.persons.has_expired(observation.person, noted_ns) {
            self.watch();
            self.persons.remove(observation.person);
            self.drop_person(observation.person);
        }
        let is_outdated = at_ns.is_some_and(|at_ns| self.persons.is_outdated(&observation, at_ns));
        if is_outdated || self.persons.is_heard_from_afar(&observation) {
            return None;
        }
        if let Some(dropped) = self.persons.note(&observation, voice, noted_ns) {
            self.drop_person(dropped);
        }
        if !is_strange {
            self.persons.guard(observation.person, noted_ns);
        }
        if !self.rescored.contains(&observation.person) {
            self.rescored.push(observation.person);
        }
        let Some(at_ns) = at_ns else { return Some(observation) };
        if self.unwatched == self.seen.len() {
            let (words, presence) = (String::new(), Presence::Unknown);
            self.seen.push(Seen { name: (0, 0, 0), person: 0, at_ns: 0, presence, words, is_sentence: false });
        }
        if let Said::Presence(statement) = &observation.said
            && let Some(room) = statement.room()
        {
            self.note_room(room);
        }
        let place = &mut self.seen[self.unwatched];
        self.unwatched += 1;
        (place.person, place.at_ns, place.presence) = (observation.person, at_ns, observation.said.presence());
        place.name = (observation.source, observation.epoch, observation.sequence);
        place.words.clear();
        let (words, is_sentence) = match &observation.said {
            Said::Sentence(sentence) => (place_words(sentence.as_str(), &observation), true),
            Said::Presence(statement) => (statement.room().unwrap_or_default(), false),
        };
        place.words.push_str(words);
        place.is_sentence = is_sentence;
        Some(observation)
    }

    /// Takes a statement that a room is empty into the forecasts.
    fn exclude(&mut self, observation: &Observation, is_strange: bool, at_ns: Option<i64>) {
        let Said::Presence(statement) = &observation.said else { return };
        let Some(empty) = statement.empty_room() else { return };
        if is_strange && self.persons.is_anybody_guarded(at_ns.unwrap_or_default()) {
            return;
        }
        self.note_room(empty);
        // Of a changed map nobody knows yet where they are.
        let (Some(at_ns), None) = (at_ns, &self.next_rooms) else { return };
        // What was observed before it comes first.
        self.follow();
        if let Some(room) = room_named(empty, &self.map, self.pipeline.grounding()) {
            self.followed.values_mut().for_each(|own| own.exclude(seconds(at_ns), room));
        }
    }

    /// Says once of each name that no room of the map has it: whoever is said to be there is present, and nothing is known of where.
    fn note_room(&mut self, room: &str) {
        let is_strange = self.next_rooms.is_none() && room_named(room, &self.map, self.pipeline.grounding()).is_none();
        if is_strange && self.strange_rooms.len() < STRANGE_ROOMS_LOGGED && self.strange_rooms.insert(room.to_owned()) {
            let rooms = self.snapshot.rooms().iter().map(RoomV1::id).collect::<Vec<_>>().join(", ");
            tracing::warn!(
                room,
                rooms,
                "somebody is said to be in a room that the map does not have: they count as present, in no room in particular; correct the narrator or the scene"
            );
        }
    }

    /// Whom an observation that names nobody fits best: where each person is believed to be, and what the model expects of them next.
    fn fitting(&mut self, said: &Said, at_ns: i64) -> u32 {
        /// What an expected object counts beside being where it is.
        const NEXT: f64 = 0.5;
        // As far as everything before it is known.
        self.watch();
        let Self { persons, pipeline, followed, mentions, map, next_rooms, .. } = self;
        let grounding = pipeline.grounding();
        let place = match said {
            Said::Sentence(sentence) => mentions.last(sentence.as_str()).map(|found| Place::Label(found.label)),
            Said::Presence(statement) => {
                statement.room().and_then(|room| room_named(room, map, grounding)).map(Place::Room)
            }
        };
        // Of a map that has not been scored yet nobody knows where they are.
        let place = place.filter(|_| next_rooms.is_none());
        persons.fitting(said, at_ns, |person| {
            let (Some(own), Some(place)) = (followed.get(&person), place) else { return 0.0 };
            let mut belief = own.at(seconds(at_ns), 0.0);
            match place {
                Place::Label(label) => {
                    let here: f64 = belief.zip(grounding.weights().row(label).iter()).map(|(p, share)| p * share).sum();
                    let next = pipeline.person(person).filter(|own| own.at_home && own.grounded.label_mass > 0.0);
                    let share = |own: PersonScores<'_>| {
                        Some(own.label_log_prob_nats.get(label)?.exp() / own.grounded.label_mass)
                    };
                    // Whoever has just been heard of has no scores yet.
                    let next = next.and_then(share).unwrap_or_default();
                    here + NEXT * next
                }
                Place::Room(room) => belief.nth(room).unwrap_or_default(),
            }
        })
    }

    /// Forgets a person altogether; the next step's scores are without them.
    pub(super) fn forget(&mut self, person: u32) {
        self.watch();
        self.lose(person);
        self.home.forget(person);
    }

    /// Knows nothing of a person any more, but for what was learned.
    fn lose(&mut self, person: u32) {
        self.follow();
        self.persons.remove(person);
        self.attributed.retain(|attributed| attributed.person != person);
        self.drop_person(person);
    }

    fn drop_person(&mut self, person: u32) {
        self.pipeline.forget_person(person);
        self.followed.remove(&person);
        self.home.lose(person);
    }

    /// Whether time alone changes the scores: a window ends, or a visitor is gone.
    #[must_use]
    pub fn is_overdue(&self, now_ns: u64) -> bool {
        let now_ns = i64::try_from(now_ns).unwrap_or(i64::MAX);
        self.persons.expired(now_ns).is_some() || self.silent(now_ns).is_some()
    }

    /// The next person whose window is to end, because they did nothing for too long.
    fn silent(&self, now_ns: i64) -> Option<u32> {
        let limits = self.pipeline.options().history;
        let mut windows = self.pipeline.histories().iter().filter(|(_, history)| !history.is_empty());
        let silent = |person: u32| {
            self.persons.get(person).is_some_and(|known| limits.is_gap(seconds(now_ns.saturating_sub(known.did_ns))))
        };
        windows.find(|(person, _)| silent(*person)).map(|(person, _)| person)
    }

    /// Does what time alone asks for.
    fn lapse(&mut self, now_ns: u64) {
        let now_ns = i64::try_from(now_ns).unwrap_or(i64::MAX);
        while let Some(person) = self.silent(now_ns) {
            self.pipeline.end_window(person);
            if !self.rescored.contains(&person) {
                self.rescored.push(person);
            }
        }
        while let Some(person) = self.persons.expired(now_ns) {
            self.persons.expire(person, now_ns);
            self.drop_person(person);
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
                followed.expect(&own.grounded.partition_probability);
            }
        }
        while let Some(person) = self.home.next_rescored() {
            let Some(own) = self.pipeline.person(person).filter(|own| own.at_home) else { continue };
            let Some(known) = self.persons.get(person) else { continue };
            let rooms = &own.grounded.partition_probability;
            self.home.look_ahead(person, known.heard_ns, own.label_log_prob_nats, rooms);
        }
        self.seen.truncate(SEEN_KEPT);
    }

    /// Takes what was observed into the forecasts.
    fn follow(&mut self) {
        let grounding = self.pipeline.grounding();
        for seen in &self.seen[..std::mem::take(&mut self.unwatched)] {
            let at_s = seconds(seen.at_ns);
            self.home.next_is(seen.name, seen.person, !self.persons.is_visitor(seen.person));
            if seen.presence == Presence::Gone {
                let own = self.followed.remove(&seen.person);
                self.home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere), own.as_ref());
                continue;
            }
            let own = self.followed.entry(seen.person).or_insert_with(|| follower(grounding, self.options, seen.at_ns));
            if seen.presence == Presence::Away {
                own.leave(at_s);
                self.home.is_in(seen.person, seen.at_ns, Some(Whereabouts::Elsewhere), Some(own));
            } else if seen.is_sentence && seen.words.is_empty() {
                // What has ended by itself, or by anybody, says nothing of where they are.
            } else if seen.is_sentence {
                // What the model says after all of them is for what comes then, not for what lies between them.
                let mention = self.mentions.last(&seen.words);
                own.observe(at_s, mention, grounding, &[]);
                self.home.turned(seen.person, seen.at_ns, turned_to(mention), own);
                if let Some(known) = self.persons.get_mut(seen.person) {
                    let on_bed = mention.map(|found| is_bed(&grounding.scored_labels()[found.label].text));
                    known.on_bed = sleeps(&seen.words).or(on_bed).unwrap_or(known.on_bed);
                }
            } else {
                let room = room_named(&seen.words, &self.map, grounding);
                own.enter(at_s, room);
                self.home.is_in(seen.person, seen.at_ns, room.map(Whereabouts::Room), Some(own));
            }
        }
        let histories = self.pipeline.histories();
        self.followed.retain(|person, _| histories.get(*person).is_some());
    }

    /// Keeps the newest `most` of what the forecasts do not know yet.
    fn drop_unwatched(&mut self, most: usize) {
        let excess = self.unwatched.saturating_sub(most);
        self.seen[..self.unwatched].rotate_left(excess);
        self.unwatched -= excess;
    }

    /// Where persons will be from `now_ns` on, for the horizons of `HORIZONS_S`: of several persons, the probability that any of them is in
    /// a room. Without an observation every room is as likely, and a flag says so.
    pub fn forecast(&mut self, now_ns: u64) -> &ForecastV1 {
        self.watch();
        let (message, rooms) = (&mut *self.forecast, self.snapshot.rooms());
        (message.epoch, message.sequence) = (self.snapshot.epoch, self.snapshot.sequence);
        (message.computed_ns, message.published_ns) = (now_ns, now_ns);
        (message.room_count, message.person) = (self.snapshot.room_count, self.snapshot.person);
        (message.horizon_count, message.horizon_s) = (HORIZONS_S.len() as u32, HORIZONS_S);
        (message.minor, message.flags) = (2, 0);
        let persons = || self.persons.iter().filter(|(_, known)| known.presence != Presence::Gone);
        // Somebody who lives here may be anywhere, also out, as long as nothing was observed of them.
        let not_known = self.followed.is_empty() || self.persons.is_anybodys_guess();
        if not_known {
            message.flags |= forecast_flags::NOT_KNOWN;
        }
        if persons().any(|(_, known)| known.restored) {
            message.flags |= forecast_flags::RESTORED;
        }
        if self.persons.nobody_is_home() {
            message.flags |= forecast_flags::NOBODY_HOME;
        }
        if !not_known && self.persons.misses_residents() {
            message.flags |= forecast_flags::RESIDENT_UNKNOWN;
        }
        for (id, room) in message.id.iter_mut().zip(rooms) {
            *id = room.id;
        }
        let now_s = now_ns as f64 / 1e9;
        let mut free = [[1.0; MAX_ROOMS]; MAX_HORIZONS];
        let mut elsewhere = [1.0; MAX_HORIZONS];
        for (person, own) in &self.followed {
            let by_habit = self.home.forecast(*person, own, now_ns, &HORIZONS_S);
            for (place, horizon_s) in HORIZONS_S.iter().enumerate() {
                let free = free[place].iter_mut();
                if let Some((gone, known)) = by_habit.and_then(|rows| row(rows, place)?.split_last()) {
                    free.zip(known).for_each(|(free, p)| *free *= 1.0 - p);
                    elsewhere[place] *= gone;
                } else {
                    free.zip(own.at(now_s, f64::from(*horizon_s))).for_each(|(free, p)| *free *= 1.0 - p);
                    elsewhere[place] *= own.elsewhere(now_s, f64::from(*horizon_s));
                }
            }
        }
        for place in 0..MAX_HORIZONS {
            for (row, free) in message.probability.iter_mut().zip(free[place]).take(rooms.len()) {
                let occupied = if not_known { 1.0 / rooms.len() as f64 } else { 1.0 - free };
                row[place] = occupied.clamp(0.0, 1.0) as f32;
            }
            message.elsewhere[place] = if not_known { 0.0 } else { elsewhere[place] as f32 };
        }
        message
    }

    /// Where each person will be, as [`Board::forecast`]; of at most [`MAX_PERSONS`], those that [`Board::persons`] names.
    pub fn person_forecasts(&mut self, now_ns: u64) -> &PersonForecastsV1 {
        self.watch();
        let signed_ns = i64::try_from(now_ns).unwrap_or(i64::MAX);
        let (message, scores) = (&mut *self.person_forecasts, &self.person_scores);
        (message.epoch, message.sequence) = (self.snapshot.epoch, self.snapshot.sequence);
        (message.computed_ns, message.published_ns, message.minor) = (now_ns, now_ns, 1);
        (message.room_count, message.id) = (scores.room_count, scores.id);
        (message.horizon_count, message.horizon_s) = (HORIZONS_S.len() as u32, HORIZONS_S);
        (message.persons, message.person_count) = (scores.persons, scores.person_count);
        let (rooms, now_s) = (scores.room_count as usize, now_ns as f64 / 1e9);
        let mut places = message.person.iter_mut();
        for (person, place) in scores.persons().iter().map(|scores| scores.person).zip(&mut places) {
            *place = PersonForecastV1 { person, name: self.persons.name_bytes(person), ..PersonForecastV1::default() };
            let presence = self.persons.get(person).map_or(Presence::Gone, |known| known.presence);
            (place.presence, place.flags) = (presence_value(presence), self.persons.flags(person, signed_ns));
            let own = self.followed.get(&person);
            let rows = own.and_then(|own| self.home.forecast(person, own, now_ns, &HORIZONS_S));
            let by_habit = rows.is_some();
            for (horizon, horizon_s) in HORIZONS_S.iter().enumerate() {
                if let Some((gone, known)) = rows.and_then(|rows| row(rows, horizon)?.split_last()) {
                    place.elsewhere[horizon] = *gone as f32;
                    for (row, probability) in place.probability.iter_mut().zip(known).take(rooms) {
                        row[horizon] = probability.clamp(0.0, 1.0) as f32;
                    }
                    continue;
                }
                let Some(own) = own else {
                    // Who is gone is followed no more; of somebody present no clock told when anything was observed.
                    let is_here = presence == Presence::Present;
                    let even = if is_here { 1.0 / rooms.max(1) as f32 } else { 0.0 };
                    place.probability.iter_mut().take(rooms).for_each(|row| row[horizon] = even);
                    place.elsewhere[horizon] = f32::from(u8::from(!is_here));
                    continue;
                };
                place.elsewhere[horizon] = own.elsewhere(now_s, f64::from(*horizon_s)) as f32;
                let probability = own.at(now_s, f64::from(*horizon_s));
                for (row, probability) in place.probability.iter_mut().zip(probability).take(rooms) {
                    row[horizon] = probability.clamp(0.0, 1.0) as f32;
                }
            }
            place.observations = self.home.observations_of(person) as f32;
            if by_habit {
                write_learned(&self.home, person, place);
            }
        }
        places.for_each(|place| *place = PersonForecastV1::default());
        message
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
        now_ns: u64,
        now_unix_ns: u64,
    ) -> Result<Option<u64>, PipelineError> {
        // What nobody wanted a forecast from, nor was there time for: with the scores of its own step.
        self.watch();
        if self.next_rooms.is_some() {
            // A scorer that fails on and on must not fill the memory.
            self.drop_unwatched(SEEN_KEPT);
        }
        self.persons.remove_gone();
        self.home.set_clock(now_ns, now_unix_ns);
        let mut costly = 0;
        for Entry { observation, received_ns, after_gap, voice, leaves } in entries {
            self.unscored_ns = Some(self.unscored_ns.map_or(received_ns, |first| first.min(received_ns)));
            self.unscored_gap |= after_gap;
            if let Some((source, epoch)) = leaves {
                self.pipeline.forget_source(source, epoch);
            }
            if self.pipeline.is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.source, observation.epoch, observation.sequence);
                continue;
            }
            let at_ns = observed_at_ns(&observation, now_ns, now_unix_ns).or(i64::try_from(received_ns).ok());
            let is_strange = !self.named.is_empty() && voice.number == OTHERS;
            self.pipeline.include(&observation, voice);
            for clause in self.clauses(observation) {
                self.exclude(&clause, is_strange, at_ns);
                for own in self.of_persons(clause) {
                    if let Some(own) = self.take(own, voice, is_strange, at_ns) {
                        self.pipeline.enter(voice, own);
                    }
                }
            }
        }
        if costly > 0 {
            tracing::warn!(
                costly,
                "narration that was accepted for another map costs more tokens than a window holds now, and is left out"
            );
        }
        if self.next_rooms.is_none() {
            // Who lies in bed does not expire like others.
            self.follow();
        }
        self.lapse(now_ns);
        if let Err(error) = self.pipeline.score() {
            self.snapshot.flags |= score_flags::SCORER_FAILED;
            return Err(error);
        }
        self.adopt_map(now_ns, now_unix_ns);
        self.home.rescored(&self.rescored);
        self.snapshot.sequence += 1;
        self.snapshot.computed_ns = now_ns;
        self.snapshot.computed_unix_ns = now_unix_ns;
        let received_ns = self.unscored_ns.take();
        self.snapshot.received_ns = received_ns.unwrap_or(self.snapshot.received_ns);
        self.snapshot.wait_ns = received_ns.map_or(0, |received_ns| now_ns.saturating_sub(received_ns));
        self.snapshot.flags = if std::mem::take(&mut self.unscored_gap) { score_flags::GAP } else { 0 };
        self.fill();
        Ok(received_ns)
    }

    /// The scores of the last good step as a message, to be sent at `now_ns`: again unchanged when `heartbeat`.
    pub fn message(&mut self, now_ns: u64, heartbeat: bool, behind: bool) -> &RoomScoresV1 {
        let message = &mut self.snapshot;
        message.published_ns = now_ns;
        message.flags &= !(score_flags::HEARTBEAT | score_flags::BEHIND);
        message.flags |= if heartbeat { score_flags::HEARTBEAT } else { 0 };
        message.flags |= if behind { score_flags::BEHIND } else { 0 };
        message
    }

    /// Each person's scores of the last good step as a message, to be sent at `now_ns`: of at most [`MAX_PERSONS`], those who were observed
    /// last.
    pub fn person_scores(&mut self, now_ns: u64) -> &PersonScoresV1 {
        self.watch();
        let message = &mut *self.person_scores;
        message.published_ns = now_ns;
        let now_ns = i64::try_from(now_ns).unwrap_or(i64::MAX);
        for person in message.person.iter_mut().take(message.person_count as usize) {
            person.flags = self.persons.flags(person.person, now_ns);
            person.name = self.persons.name_bytes(person.person);
        }
        message
    }

    /// Who is who, and who is in the house.
    #[must_use]
    pub fn persons(&self) -> &Persons {
        &self.persons
    }

    /// The same, to give names.
    pub(super) fn persons_mut(&mut self) -> &mut Persons {
        &mut self.persons
    }

    /// What became of the observations of the last good step, for the journal; each is told once.
    pub fn tell_outcomes(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        let map = self.map_number();
        for Attributed { source, epoch, sequence, person } in self.attributed.drain(..) {
            tell(&Outcome { source, epoch, sequence, person, by_fit: true, map, probability: &[] });
        }
        let recalled = std::mem::take(&mut self.recalled);
        for person in self.rescored.drain(..) {
            let Some(known) = self.persons.get(person).filter(|known| !(recalled && known.restored)) else { continue };
            // Of who is out it says whose the observation is.
            let own = self.pipeline.person(person).filter(|own| own.at_home);
            let probability = own.map_or(&[][..], |own| &own.grounded.partition_probability[..]);
            let (source, epoch, sequence) = known.last;
            tell(&Outcome { source, epoch, sequence, person, by_fit: false, map, probability });
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

    /// Work that can wait until there is nothing else to do.
    pub fn tidy(&mut self) {
        self.watch();
        self.pipeline.tidy();
    }

    /// The items' scores of the last step, of at most [`MAX_ITEMS`] the best, with the header that ties them to the snapshot; none while a
    /// changed map waits for its first scores.
    pub fn items(&self) -> Option<(ItemScoresHeaderV1, impl ExactSizeIterator<Item = ItemScoreV1> + '_)> {
        if self.next_rooms.is_some() {
            return None;
        }
        let RoomScoresV1 { epoch, sequence, computed_ns, .. } = self.snapshot;
        let items = self.map.items().len() as u32;
        let header = ItemScoresHeaderV1 { epoch, sequence, computed_ns, minor: 1, items, ..Default::default() };
        let mut counts = vec![0_u32; self.map.labels().len()];
        for item in self.map.items() {
            counts[item.label.0 as usize] += 1;
        }
        let grounding = self.pipeline.grounding();
        let scores: Vec<f64> = grounding.item_log_score_nats(&self.pipeline.scores().label_log_prob_nats).collect();
        let mut chosen: Vec<usize> = (0..scores.len()).collect();
        if chosen.len() > MAX_ITEMS {
            chosen.select_nth_unstable_by(MAX_ITEMS, |a, b| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b)));
            chosen.truncate(MAX_ITEMS);
            chosen.sort_unstable();
        }
        let items = chosen.into_iter().map(move |place| {
            let item = &self.map.items()[place];
            ItemScoreV1 {
                id: text::encode_cut(&item.id),
                label: text::encode_cut(&self.map.labels()[item.label.0 as usize]),
                log_score_nats: scores[place],
                partition: grounding.item_partition()[place].map_or(NO_PARTITION, |partition| partition.0),
                label_items: counts[item.label.0 as usize],
            }
        });
        Some((header, items))
    }

    /// Copies the pipeline's scores into the snapshot.
    fn fill(&mut self) {
        let scores = self.pipeline.scores();
        let snapshot = &mut self.snapshot;
        let grounded = &scores.grounded;
        let values = grounded.partition_log_score_nats.iter().zip(&grounded.partition_probability);
        let bounds = scores.lower_log_score_nats.iter().zip(&scores.upper_log_score_nats);
        for ((room, (score, probability)), (lower, upper)) in snapshot.room.iter_mut().zip(values).zip(bounds) {
            *room = RoomV1 {
                log_score_nats: *score,
                lower_log_score_nats: *lower,
                upper_log_score_nats: *upper,
                probability: *probability,
                ..*room
            };
        }
        snapshot.reached = reached_value(scores.reached);
        snapshot.label_mass = grounded.label_mass;
        snapshot.observed_ns = scores.newest_observed_ns;
        snapshot.tokenise_ns = scores.timing.tokenise_ns;
        snapshot.prefix_ns = scores.timing.prefix_ns;
        snapshot.trie_ns = scores.timing.trie_ns;
        snapshot.ground_ns = scores.timing.ground_ns;

        let (persons, present) = self.persons.count();
        let shown = || self.pipeline.persons().filter(|own| own.at_home || present == 0).map(|own| own.person);
        snapshot.person = if shown().count() == 1 { shown().next().unwrap_or(ALL_PERSONS) } else { ALL_PERSONS };
        snapshot.persons = persons as u32;
        snapshot.window = self.pipeline.persons().map(|own| own.window as u64).sum();
        snapshot.flags |= if self.persons.nobody_is_home() { score_flags::NOBODY_HOME } else { 0 };
        snapshot.flags |= if persons == 0 { score_flags::NO_NARRATION } else { 0 };

        self.newest_sources.clear();
        for own in &scores.included {
            let newer =
                scores.included.iter().filter(|other| other.voice == own.voice && other.turn > own.turn).count();
            self.newest_sources.push((newer, *own));
        }
        // Each voice's newest first, so that nobody's confirmation is pushed out by another's sources; by source where all is equal, so
        // that the same step gives the same message.
        self.newest_sources.sort_unstable_by_key(|(newer, own)| (*newer, Reverse(own.turn), own.source, own.epoch));
        // A source that was named before, and has said nothing since, waits for no confirmation.
        let is_new = |own: &Included| own.turn > self.named_turn;
        let cut = self.newest_sources.iter().skip(MAX_SOURCES).any(|(_, own)| is_new(own));
        self.named_turn = self.newest_sources.iter().map(|(_, own)| own.turn).max().unwrap_or_default();
        self.newest_sources.truncate(MAX_SOURCES);
        snapshot.source_count = self.newest_sources.len() as u32;
        snapshot.included = Default::default();
        for (place, (_, included)) in snapshot.included.iter_mut().zip(&self.newest_sources) {
            *place = IncludedV1 {
                source: included.source,
                epoch: included.epoch,
                sequence: included.sequence,
                observed_ns: included.observed_ns,
                accepted: included.accepted,
            };
        }
        snapshot.flags |= if cut { score_flags::SOURCES_CUT } else { 0 };
        self.fill_persons();
    }

    /// Copies each person's scores into their message.
    fn fill_persons(&mut self) {
        self.newest_persons.clear();
        self.newest_persons.extend(self.persons.iter().map(|(person, known)| (known.heard_ns, person)));
        // Residents before visitors, and of both those who were observed last.
        let persons = &self.persons;
        let rank = |(heard_ns, person): &(i64, u32)| (persons.is_visitor(*person), Reverse(*heard_ns), *person);
        self.newest_persons.sort_unstable_by_key(rank);
        // Who finds no place among them is not told of, and waits for nothing.
        for (_, person) in self.newest_persons.drain(MAX_PERSONS.min(self.newest_persons.len())..) {
            if let Some(known) = self.persons.get_mut(person) {
                known.told = true;
            }
        }
        self.newest_persons.sort_unstable_by_key(|(_, person)| *person);

        let (message, snapshot) = (&mut *self.person_scores, &self.snapshot);
        (message.epoch, message.sequence) = (snapshot.epoch, snapshot.sequence);
        (message.computed_ns, message.map_fingerprint) = (snapshot.computed_ns, snapshot.map_fingerprint);
        message.persons = snapshot.persons;
        message.room_count = snapshot.room_count;
        // Those beyond the rooms are zero in the snapshot, too.
        for (id, room) in message.id.iter_mut().zip(&snapshot.room) {
            *id = room.id;
        }
        let mut places = message.person.iter_mut();
        let mut count = 0;
        for &(heard_ns, person) in &self.newest_persons {
            let Some(known) = self.persons.get_mut(person) else { continue };
            let own = self.pipeline.person(person);
            // Who is gone has no scores, and is told of all the same.
            if own.is_none() && known.presence != Presence::Gone {
                continue;
            }
            let Some(place) = places.next() else { break };
            count += 1;
            known.told = true;
            *place = PersonV1 {
                person,
                presence: presence_value(known.presence),
                observed_ns: message_ns(heard_ns),
                since_ns: message_ns(known.since_ns),
                elsewhere: if known.presence == Presence::Present { 0.0 } else { 1.0 },
                ..PersonV1::default()
            };
            let Some(own) = own else {
                let rooms = snapshot.room_count as usize;
                for row in [&mut place.log_score_nats, &mut place.lower_log_score_nats, &mut place.upper_log_score_nats]
                {
                    row.iter_mut().take(rooms).for_each(|score| *score = f64::NEG_INFINITY);
                }
                continue;
            };
            (place.reached, place.window) = (reached_value(own.reached), own.window as u64);
            place.label_mass = own.grounded.label_mass;
            for (row, values) in [
                (&mut place.log_score_nats, &own.grounded.partition_log_score_nats[..]),
                (&mut place.lower_log_score_nats, own.lower_log_score_nats),
                (&mut place.upper_log_score_nats, own.upper_log_score_nats),
                (&mut place.probability, &own.grounded.partition_probability),
            ] {
                let used = values.len().min(MAX_ROOMS);
                row[..used].copy_from_slice(&values[..used]);
            }
        }
        places.for_each(|place| *place = PersonV1::default());
        message.person_count = count;
    }
}

/// The sets of a person's latest forecast, and how much of it was learned.
fn write_learned(home: &HomeHabits, person: u32, place: &mut PersonForecastV1) {
    if let Some((coverage, sets)) = home.sets(person) {
        place.set_coverage = coverage as f32;
        for (horizon, (bits, set)) in place.room_set.iter_mut().zip(sets).enumerate() {
            *bits = set.rooms;
            place.set_elsewhere |= u32::from(set.elsewhere) << horizon;
        }
    }
    let Some(learned) = home.learned_shares(person) else { return };
    for (horizon_s, learned) in HORIZONS_S.iter().zip(learned) {
        if let Some(at) = LEARNED_SHARE_S.iter().position(|told_s| told_s == horizon_s) {
            place.learned_share[at] = learned as f32;
        }
    }
}

/// The row of a horizon.
fn row(rows: &[f64], horizon: usize) -> Option<&[f64]> {
    rows.chunks_exact((rows.len() / HORIZONS_S.len()).max(1)).nth(horizon)
}

/// The words of a sentence that say where its person is: none where a device that was found to be theirs has ended something.
fn place_words<'a>(sentence: &'a str, observation: &Observation) -> &'a str {
    if observation.by_fit && observation.said.is_of_an_end() { "" } else { sentence }
}

/// The label that is turned to, and not left.
fn turned_to(mention: Option<Mention>) -> Option<usize> {
    mention.filter(|found| !found.is_left).map(|found| found.label)
}

/// A person who is followed from now on.
fn follower(grounding: &Grounding, options: ForecastOptions, at_ns: i64) -> Forecaster {
    Forecaster::new(grounding.partitions().len(), options, seconds(at_ns))
}

/// The partition that a room's name means, by its own name or as the one that the room lies in.
fn room_named(name: &str, map: &SemanticMap, grounding: &Grounding) -> Option<usize> {
    let partitions = grounding.partitions();
    let own = partitions.iter().position(|partition| partition.id == name || partition.label == name);
    own.or_else(|| {
        let room = map.find_room(name)?;
        let mut within = (0..).zip(partitions).filter(|(_, partition)| partition.rooms.contains(&room));
        let (only, _) = within.next()?;
        // A room in parts is none of them.
        within.next().is_none().then_some(only)
    })
}

/// How a message says how scores were reached.
fn reached_value(effort: Effort) -> u32 {
    match effort {
        Effort::Exact => reached::EXACT,
        Effort::Ranking => reached::RANKING,
        Effort::Top => reached::TOP,
        Effort::Deadline => reached::DEADLINE,
    }
}

/// The rooms of a message, and how many they are.
type NamedRooms = ([RoomV1; MAX_ROOMS], u32);

/// The rooms of a message for these partitions, without scores.
fn named_rooms(partitions: &[Partition]) -> Result<NamedRooms, BoardError> {
    if partitions.len() > MAX_ROOMS {
        return Err(BoardError::TooManyPartitions { partitions: partitions.len() });
    }
    let mut rooms = [RoomV1::default(); MAX_ROOMS];
    for (room, partition) in rooms.iter_mut().zip(partitions) {
        let name = |source| BoardError::Name { id: partition.id.clone(), source };
        room.id = text::encode("room id", &partition.id).map_err(name)?;
    }
    Ok((rooms, partitions.len() as u32))
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::rc::Rc;

    use proptest::prelude::*;
    use roomcast_core::grounding::Grounding;
    use roomcast_core::label_trie::TokenTree;
    use roomcast_core::narration::Sentence;
    use roomcast_core::pipeline::PipelineOptions;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{DecodeStats, ModelError, ModelInfo, TextStart, Token};
    use roomcast_core::semantic_map::delta::parse_changes;
    use roomcast_ipc::{Message, narration_kind};

    use super::*;
    use crate::config::PersonsConfig;
    use crate::daemon::PersonsFile;
    use crate::message_text::said_of;

    const S: u64 = 1_000_000_000;
    const TWO_ROOMS: &str = include_str!("../../../tests/data/two_rooms.json");

    fn board() -> Board<TableModel> {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let options = GroundingOptions::default();
        let grounding = Grounding::new(&map, &options).unwrap();
        let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
        Board::new(pipeline, map, options, 1).unwrap()
    }

    fn observation(person: u32, at_ns: u64, sentence: &str) -> Observation {
        Observation {
            person,
            observed_ns: at_ns,
            observed_unix_ns: 1_000_000 * S + at_ns,
            ..Observation::of(at_ns, Sentence::new(sentence).unwrap())
        }
    }

    proptest! {
        /// The bound on what one narrator alone does: with a guard, whatever a stranger says moves nothing of a person of whom a named one tells, to
        /// the last bit, and no room falls below what those persons give it; nor after a restart.
        #[test]
        fn a_stranger_moves_nothing_of_a_guarded_person(
            said in prop::collection::vec((0..12_usize, 0..4_u32, 0..50_u64), 1..40),
        ) {
            const NAMED: u64 = 7;
            let config = || PersonsConfig { residents: vec!["0".to_owned(), "1".to_owned()], guard_s: 600.0, ..PersonsConfig::default() };
            let home = || board().with_persons(Persons::new(config(), PersonsFile::default())).with_named([NAMED]);
            let own = Voice { number: NAMED, share: 1 };
            let strange = Voice { number: OTHERS, share: 1 };
            let entry = |source: u64, voice: Voice, person: u32, at_ns: u64, text: &str| {
                let kind = if text.starts_with("They") { narration_kind::SENTENCE } else { narration_kind::PRESENCE };
                let said = said_of(kind, text).unwrap();
                let observation = Observation { source, person, said, ..observation(person, at_ns, "They sit.") };
                Entry { voice, ..Entry::new(observation, at_ns) }
            };
            let (mut with, mut without) = (home(), home());
            let (mut heard, mut heard_alone) = (Vec::new(), Vec::new());
            let mut at_ns = 1000 * S;
            for person in 0..2 {
                at_ns += S;
                let first = entry(NAMED, own, person, at_ns, ["They open the fridge.", "They sit on the sofa."][person as usize]);
                heard.push(first.observation.clone());
                heard_alone.push(first.observation.clone());
                with.step([first.clone()], at_ns, 1_000_000 * S + at_ns).unwrap();
                without.step([first], at_ns, 1_000_000 * S + at_ns).unwrap();
            }
            for (what, person, later_s) in said {
                at_ns += S / 4;
                let who = [0, 1, 2, SOMEBODY][person as usize];
                let text = [
                    "They open the fridge.", "They sit on the sofa.", "They leave the house.", "They go to bed.", "away", "gone", "present in the kitchen",
                    "present in the living room", "They walk to the sofa.", "They come home.", "present", "They watch television.",
                ][what];
                // It dates what it says as it likes.
                let strange = entry(9, strange, who, at_ns - later_s * S, text);
                heard.push(strange.observation.clone());
                with.step([strange], at_ns, 1_000_000 * S + at_ns).unwrap();
                without.step([], at_ns, 1_000_000 * S + at_ns).unwrap();
                let rooms = |board: &Board<TableModel>| board.snapshot().rooms().iter().map(|room| room.probability).collect::<Vec<_>>();
                for (with, without) in rooms(&with).iter().zip(rooms(&without)) {
                    prop_assert!(*with >= without - 1e-12, "{with} is less than {without}");
                }
            }
            let (mut again, mut again_alone) = (home(), home());
            again.restore(recovered(heard), at_ns, 1_000_000 * S + at_ns);
            again_alone.restore(recovered(heard_alone), at_ns, 1_000_000 * S + at_ns);
            again.step([], at_ns, 1_000_000 * S + at_ns).unwrap();
            again_alone.step([], at_ns, 1_000_000 * S + at_ns).unwrap();
            for (with, without) in [(&mut with, &mut without), (&mut again, &mut again_alone)] {
                let (scores, alone) = (*with.person_scores(at_ns), *without.person_scores(at_ns));
                let (ahead, ahead_alone) = (*with.person_forecasts(at_ns), *without.person_forecasts(at_ns));
                for person in 0..2 {
                    let of = |scores: &PersonScoresV1| *scores.persons().iter().find(|own| own.person == person).unwrap();
                    prop_assert_eq!(of(&scores).probability, of(&alone).probability);
                    prop_assert_eq!(of(&scores).presence, of(&alone).presence);
                    let of = |ahead: &PersonForecastsV1| *ahead.persons().iter().find(|own| own.person == person).unwrap();
                    prop_assert_eq!(of(&ahead).probability, of(&ahead_alone).probability);
                    prop_assert_eq!(of(&ahead).elsewhere, of(&ahead_alone).elsewhere);
                }
            }
        }
    }

    /// Without a guard, and when it is over, a stranger is heard.
    #[test]
    fn a_guard_ends() {
        let config = |guard_s| PersonsConfig { guard_s, ..PersonsConfig::default() };
        for (guard_s, later_s, is_heard) in [(0.0, 1, true), (600.0, 599, false), (600.0, 602, true)] {
            let mut board = board().with_persons(Persons::new(config(guard_s), PersonsFile::default())).with_named([1]);
            let at_ns = 1000 * S;
            let later_ns = at_ns + later_s * S;
            let own = Entry::new(observation(0, at_ns, "They open the fridge."), at_ns);
            let strange = Observation { source: 9, ..observation(0, later_ns, "They sit on the sofa.") };
            let strange = Entry { voice: Voice { number: OTHERS, share: 1 }, ..Entry::new(strange, later_ns) };
            board.step([own, strange], later_ns, 1_000_000 * S + later_ns).unwrap();
            let read: Vec<_> = board.pipeline().read_sentences().map(|(_, said)| said.to_owned()).collect();
            assert_eq!(read.contains(&"They sit on the sofa.".to_owned()), is_heard, "{guard_s} {later_s}: {read:?}");
        }
    }

    fn recovered(observations: impl IntoIterator<Item = Observation>) -> Recovered {
        let mut recovered = Recovered::default();
        recovered.observations = observations.into_iter().collect();
        recovered
    }

    /// Fails as often as it is told to.
    #[derive(Debug)]
    struct Failing {
        table: TableModel,
        failures: Rc<Cell<u32>>,
    }

    impl LanguageModel for Failing {
        fn info(&self) -> &ModelInfo {
            self.table.info()
        }

        fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
            self.table.tokenise(text, start, out)
        }

        fn token_text(&self, token: Token) -> String {
            self.table.token_text(token)
        }

        fn forget(&mut self) {}

        fn decode(
            &mut self,
            prompt: &[Token],
            tree: &TokenTree,
            want_prompt_row: bool,
            visit: &mut dyn FnMut(usize, &[f32]),
        ) -> Result<DecodeStats, ModelError> {
            if let Some(left) = self.failures.get().checked_sub(1) {
                self.failures.set(left);
                return Err(ModelError::Decode { tokens: prompt.len(), reason: "told to fail".to_owned() });
            }
            self.table.decode(prompt, tree, want_prompt_row, visit)
        }

        fn tidy(&mut self, _keep: usize) {}
    }

    fn failing_board(failures: &Rc<Cell<u32>>) -> Board<Failing> {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let options = GroundingOptions::default();
        let grounding = Grounding::new(&map, &options).unwrap();
        let model = Failing { table: TableModel::new(7), failures: Rc::clone(failures) };
        let pipeline = Pipeline::new(model, grounding, PipelineOptions::default()).unwrap();
        Board::new(pipeline, map, options, 1).unwrap()
    }

    #[test]
    fn a_changed_map_is_published_with_its_first_scores() {
        let failures = Rc::<Cell<u32>>::default();
        let mut board = failing_board(&failures);
        for (at_s, sentence) in DAY {
            board.step([entry(0, at_s * S, sentence)], at_s * S, at_s * S).unwrap();
        }
        let before = *board.message(75 * S, false, false);
        let sofa = board.forecast(75 * S).probability[1][0];
        assert!(sofa > 0.8, "{sofa}");

        let room = r#"[{"change": "add-room", "room": {"id": "hall", "label": "hall", "box": {"min_m": [9, 0, 0], "max_m": [12, 3, 2.5]}}}]"#;
        let map = board.map().changed(parse_changes(room).unwrap()).unwrap();
        board.change_map(map).unwrap();
        for step in 0..3 {
            failures.set(1);
            let at_ns = (76 + step) * S;
            board.step([entry(0, at_ns, "They walk to the hall.")], at_ns, at_ns).unwrap_err();
            board.tidy();
            let message = *board.message(at_ns, true, false);
            let as_before = RoomScoresV1 { published_ns: message.published_ns, flags: message.flags, ..before };
            assert_eq!(message, as_before);
            assert_eq!(message.flags, score_flags::SCORER_FAILED | score_flags::HEARTBEAT);
            let forecast = board.forecast(at_ns);
            assert_eq!((forecast.room_count, forecast.flags), (2, 0));
            assert!(forecast.probability[1][0] > 0.8, "{:?}", forecast.probability[1]);
            assert!(board.items().is_none());
        }
        board.step([], 80 * S, 80 * S).unwrap();
        let after = *board.message(80 * S, false, false);
        assert_eq!((after.room_count, after.flags), (3, 0));
        assert_ne!(after.map_fingerprint, before.map_fingerprint);
        assert!((after.rooms().iter().map(|room| room.probability).sum::<f64>() - 1.0).abs() < 1e-9);
        let forecast = board.forecast(80 * S);
        assert_eq!((forecast.room_count, forecast.flags), (3, 0));
        assert!(forecast.probability[2][0] > 0.5, "what was observed meanwhile is known: {:?}", forecast.probability);
        assert!(board.items().is_some());
    }

    fn entry(person: u32, at_ns: u64, sentence: &str) -> Entry {
        Entry::new(observation(person, at_ns, sentence), at_ns)
    }

    fn occupied(board: &mut Board<TableModel>, room: usize, now_ns: u64) -> f32 {
        board.forecast(now_ns).probability[room][0]
    }

    /// Narrators that said one thing each, one after the other, wait for nothing; those that say it at once wait for their places.
    #[test]
    fn only_what_waits_is_cut() {
        let mut board = board();
        let told = |source: u64, at_ns: u64| {
            let observation = Observation { source, epoch: 1, ..observation(0, at_ns, "They walk to the hall.") };
            Entry::new(observation, at_ns)
        };
        let mut cut = |sources: std::ops::Range<u64>, at_ns: u64| {
            board.step(sources.map(|source| told(source, at_ns)), at_ns, at_ns).unwrap();
            board.snapshot().has(score_flags::SOURCES_CUT)
        };
        let most = MAX_SOURCES as u64;
        for source in 0..2 * most {
            assert!(!cut(source..source + 1, (10 + source) * S), "{source}");
        }
        assert!(!cut(100..100 + most, 100 * S));
        assert!(cut(200..201 + most, 101 * S));
        assert!(!cut(0..0, 102 * S));
    }

    const DAY: [(u64, &str); 4] = [
        (10, "They walk to the kitchen."),
        (25, "They grab the coffee maker."),
        (60, "They walk to the sofa."),
        (70, "They sit on the sofa."),
    ];

    #[test]
    fn a_restart_remembers_where_everybody_is() {
        let mut before = board();
        for (at_s, sentence) in DAY {
            before.step([entry(3, at_s * S, sentence)], at_s * S, at_s * S).unwrap();
        }
        let now_ns = 80 * S;
        let was = occupied(&mut before, 1, now_ns);
        assert!(was > 0.7, "{was}");
        assert_eq!(before.forecast(now_ns).flags, 0);

        // The same boot, and a later one, whose clock begins again and whose journal's monotonic times are dropped.
        for later_boot in [false, true] {
            let mut after = board();
            let kept = DAY.map(|(at_s, sentence)| {
                let whole = observation(3, at_s * S, sentence);
                if later_boot { Observation { observed_ns: 0, ..whole } } else { whole }
            });
            let (now_ns, now_unix_ns) = (if later_boot { 2 * S } else { 80 * S }, 1_000_080 * S);
            after.restore(recovered(kept), now_ns, now_unix_ns);
            after.step([], now_ns, now_unix_ns).unwrap();
            let is = occupied(&mut after, 1, now_ns);
            assert!((was - is).abs() < 0.05, "{was} before, {is} after a restart");
            assert_eq!(after.forecast(now_ns).flags, forecast_flags::RESTORED);
            after.step([entry(3, now_ns + S, "They sit on the sofa.")], now_ns + S, now_unix_ns + S).unwrap();
            assert_eq!(after.forecast(now_ns + S).flags, 0);
        }
    }

    /// What a failed step took in is told by the step that scores it: its wait is the longest there is.
    #[test]
    fn a_failed_step_loses_neither_gap_nor_latency() {
        let failures = Rc::<Cell<u32>>::default();
        let mut board = failing_board(&failures);
        board.step([], S, S).unwrap();
        failures.set(2);
        let lost = Entry { after_gap: true, ..entry(0, 2 * S, "They grab the mug.") };
        board.step([lost], 2 * S, 2 * S).unwrap_err();
        board.step([entry(0, 3 * S, "They sit on the sofa.")], 3 * S, 3 * S).unwrap_err();
        assert_eq!(board.step([], 5 * S, 5 * S).unwrap(), Some(2 * S));
        let snapshot = board.snapshot();
        assert_eq!((snapshot.received_ns, snapshot.wait_ns), (2 * S, 3 * S));
        assert_eq!(snapshot.flags, score_flags::GAP);
        // Once.
        assert_eq!(board.step([], 6 * S, 6 * S).unwrap(), None);
        assert_eq!((board.snapshot().received_ns, board.snapshot().wait_ns, board.snapshot().flags), (2 * S, 0, 0));
    }

    #[test]
    fn what_is_not_known_is_flagged() {
        let mut board = board();
        board.step([], S, S).unwrap();
        assert_eq!(board.forecast(S).flags, forecast_flags::NOT_KNOWN);
        assert_eq!(board.forecast(S).probability[0][0], 0.5);
        board.step([entry(0, 2 * S, "They stand up.")], 2 * S, 2 * S).unwrap();
        assert_eq!(board.forecast(2 * S).flags, 0);
    }

    #[test]
    fn of_too_many_persons_those_are_told_who_were_observed_last() {
        let mut board = board();
        for person in 0..12 {
            let at_ns = u64::from(20 - person) * S;
            board.step([entry(person, at_ns, "They grab the mug.")], 30 * S, 30 * S).unwrap();
        }
        let told = board.person_scores(30 * S);
        told.check().unwrap();
        assert_eq!(told.persons().iter().map(|person| person.person).collect::<Vec<_>>(), (0..8).collect::<Vec<_>>());
        assert_eq!(told.persons, 12);
    }

    /// Each person's forecast rests on what the model says of them, and not on what it says of another.
    #[test]
    fn a_persons_forecast_is_that_of_the_person_alone() {
        let mut alone = [0, 1].map(|_| board());
        let mut both = board();
        for (number, (at_s, sentence)) in (0..).zip(DAY.into_iter().chain([(90, "They grab the mug.")])) {
            let person = number % 2;
            both.step([entry(person, at_s * S, sentence)], at_s * S, at_s * S).unwrap();
            alone[person as usize].step([entry(person, at_s * S, sentence)], at_s * S, at_s * S).unwrap();
        }
        let told = *both.person_scores(100 * S);
        told.check().unwrap();
        assert_eq!((told.persons().len(), told.rooms().collect::<Vec<_>>()), (2, vec!["kitchen", "living-room"]));
        for (own, person) in alone.iter_mut().zip(told.persons()) {
            // To the bit, and alone also to the bit what the snapshot says.
            let of_own = *own.person_scores(100 * S);
            assert_eq!(of_own.persons(), [*person]);
            for (room, scores) in own.snapshot().rooms().iter().enumerate() {
                assert_eq!(scores.probability.to_bits(), person.probability[room].to_bits());
                assert_eq!(scores.log_score_nats.to_bits(), person.log_score_nats[room].to_bits());
            }
        }
        for (room, scores) in both.snapshot().rooms().iter().enumerate() {
            let nobody: f64 = told.persons().iter().map(|person| 1.0 - person.probability[room]).product();
            assert_eq!(scores.probability, 1.0 - nobody);
        }
        let of = |board: &mut Board<TableModel>| board.forecast(100 * S).probability;
        let [first, second] = &mut alone;
        let (first, second, both) = (of(first), of(second), of(&mut both));
        for (room, horizon) in (0..2).flat_map(|room| (0..MAX_HORIZONS).map(move |horizon| (room, horizon))) {
            let [p, q] = [first, second].map(|of| f64::from(of[room][horizon]));
            let expected = 1.0 - (1.0 - p) * (1.0 - q);
            assert!((f64::from(both[room][horizon]) - expected).abs() < 1e-6, "{room} {horizon}: {p} {q}");
        }
    }
}
