//! From events to the published snapshot, with sequence numbers, ages and flags: `take_in` (attribution and histories), `follow` (belief),
//! `score_within` (scores), and then, behind the scores, which wait for nothing, `forecast` and `person_forecasts` (publication). No clock and no
//! port, so the daemon's loop, the simulation and the tests drive the same code.

use std::collections::{BTreeMap, HashMap};

use roomcast_ipc::MessageError;
use roomcast_ipc::raw::{
    ForecastV1, ItemScoreV1, ItemScoresHeaderV1, MAX_HORIZONS, MAX_ROOMS, NAME_BYTES, PersonForecastsV1,
    PersonScoresV1, RoomScoresV1, score_flags,
};

use super::habits::HomeHabits;
use super::intake::OTHERS;
use super::persons::{NotRenamed, Persons};
use super::prefetch::Now;
use crate::config::May;
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{GroundingOptions, partitions};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Observation, Presence, Quota, SensorReport};
use roomcast_core::pipeline::{Pipeline, PipelineError, Prepared};
use roomcast_core::prepared::Answer;
use roomcast_core::scorer::{LanguageModel, Progress};
use roomcast_core::semantic_map::SemanticMap;

use attribution::Attribution;
use belief::Belief;
use map_in_use::{MapInUse, named_rooms};
use publication::Publication;
use records::Records;
use scored::Scoring;
use ways_out::ways_out;

pub use scored::PreparedTally;
pub use tracking::SENSORS_MAX;

mod attribution;
mod belief;
mod events;
mod habit_reasons;
mod map_in_use;
mod publication;
mod readings;
mod records;
mod restoring;
mod robots;
mod scored;
mod tracking;
mod ways_out;
mod whereabouts;

/// A map that messages cannot carry.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
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
    Engine(#[from] EngineError),
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
    pub quota: Quota,
    /// The narrator's start (source and epoch) that gave way to this event's start.
    pub leaves: Option<(u64, u64)>,
}

impl Entry {
    /// An event after no gap, of its source's own quota, for which no start gave way.
    #[must_use]
    pub fn new(observation: Observation, received_ns: BootNs) -> Self {
        let quota = Quota::of_source(observation.source);
        Self { observation, received_ns, after_gap: false, quota, leaves: None }
    }
}

/// The daemon's state, in parts along the flow: an event gets its persons, moves the belief, is scored, changes the habits, and is published.
#[derive(Debug)]
pub struct Engine<M> {
    map: MapInUse,
    attribution: Attribution,
    belief: Belief,
    scoring: Scoring<M>,
    home: HomeHabits,
    publication: Publication,
    records: Records,
}

/// The horizons of the published forecasts, in seconds.
pub const HORIZONS_S: [f32; MAX_HORIZONS] =
    [0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0, 900.0, 1800.0, 3600.0];

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

impl<M: LanguageModel> Engine<M> {
    /// An engine without scores. `epoch` is random per start of the daemon; `grounding` has the options of the pipeline's grounding.
    ///
    /// # Errors
    ///
    /// [`EngineError`] if the map does not fit into a message.
    pub fn new(
        pipeline: Pipeline<M>,
        map: SemanticMap,
        grounding: GroundingOptions,
        epoch: u64,
    ) -> Result<Self, EngineError> {
        let publication = Publication::new(&pipeline, &map, epoch)?;
        Ok(Self {
            map: MapInUse::new(map, grounding, pipeline.grounding()),
            attribution: Attribution::default(),
            belief: Belief::default(),
            scoring: Scoring::new(pipeline),
            home: HomeHabits::default(),
            publication,
            records: Records::default(),
        })
    }

    /// Sets the names and residents of the home.
    #[must_use]
    pub fn with_persons(mut self, persons: Persons) -> Self {
        self.attribution.persons = persons;
        self
    }

    /// Sets the narrators of the configuration by source ([`PersonsConfig::guard_s`]).
    ///
    /// [`PersonsConfig::guard_s`]: crate::config::PersonsConfig::guard_s
    #[must_use]
    pub(crate) fn with_named(mut self, named: impl IntoIterator<Item = (u64, May)>) -> Self {
        self.attribution.named = named.into_iter().collect();
        self
    }

    #[must_use]
    pub(crate) fn with_forecast(mut self, options: ForecastOptions) -> Self {
        self.belief.options = options;
        self
    }

    /// Sets the habits of the home.
    #[must_use]
    pub fn with_habits(self, mut home: HomeHabits) -> Self {
        home.bind(self.scoring.pipeline.grounding());
        Self { home, ..self }
    }

    /// Calls `moved` after each call of the model's decoder.
    pub(super) fn watch_model(&mut self, moved: Progress) {
        self.scoring.pipeline.idle().watch(moved);
    }

    /// The ids of the map's rooms, in the order of the habits.
    pub(super) fn room_ids(&self) -> impl Iterator<Item = &str> {
        self.scoring.pipeline.grounding().partitions().iter().map(|room| room.id.as_str())
    }

    /// Fails with the rooms of the map if it has no single room of this name.
    pub(super) fn check_room(&self, name: &str) -> Result<(), String> {
        let rooms = || self.room_ids().collect::<Vec<_>>().join(", ");
        let found = self.map.room(name, self.scoring.pipeline.grounding());
        found.map(|_| ()).ok_or_else(|| format!("the map has no single room {name:?}: give {}", rooms()))
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
        self.belief.tracking.is_some()
    }

    /// Binds replaced habits to the map in use.
    pub(super) fn bind_habits(&mut self) {
        self.home.bind(self.scoring.pipeline.grounding());
    }

    /// Lets habits count time, about once a minute. Returns whether they did.
    pub fn tick(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> bool {
        if !self.home.is_tick_due(now_ns) || !self.is_scored() {
            return false;
        }
        self.belief.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        self.watch();
        self.belief.track(self.scoring.pipeline.grounding(), now_ns);
        let is_learned_of = |person| self.attribution.is_learned_of(person);
        self.home.tick((now_ns, now_unix_ns), self.belief.forecasters(), is_learned_of);
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
        let rooms = named_rooms(&partitions(&map, self.map.options.level))?;
        let before: Vec<String> =
            self.scoring.pipeline.grounding().label_texts().into_iter().map(str::to_owned).collect();
        let prepared = self.scoring.pipeline.change_map(&map, &self.map.options)?;
        if prepared.again {
            let texts = self.scoring.pipeline.grounding().label_texts();
            let place: HashMap<&str, usize> = texts.iter().enumerate().map(|(place, text)| (*text, place)).collect();
            let new = |label: usize| before.get(label).and_then(|text| place.get(text.as_str()).copied());
            self.belief.followed.values_mut().for_each(|own| own.relabel(&new));
        }
        self.scoring.rescored.clear();
        self.scoring.rescored.extend(self.attribution.persons.iter().map(|(person, _)| person));
        self.map.change(map, rooms, self.scoring.pipeline.grounding());
        self.belief.tracking = None;
        self.scoring.readings.clear();
        self.belief.robots.forget_rooms();
        self.note_beliefs();
        Ok(prepared)
    }

    /// Publishes a changed map after its first good step.
    fn adopt_map(&mut self) {
        // This is nearly every step, so it allocates nothing.
        if self.is_scored() {
            return;
        }
        let (new, rooms) = self.new_places();
        let Some(next) = self.map.next_rooms.take() else { return };
        self.publication.change_map(self.map.map.fingerprint(), *next);
        self.home.bind(self.scoring.pipeline.grounding());
        if new.len() != rooms || new.iter().enumerate().any(|(place, new)| *new != Some(place)) {
            // The beliefs stay; events since the change are read with the new map.
            self.belief.followed.values_mut().for_each(|own| own.take_rooms(&new, rooms));
        }
        let ways_in = ways_out(self.scoring.pipeline.grounding());
        self.belief.followed.values_mut().for_each(|own| own.come_in_by(&ways_in));
        // The filter starts again with the rooms of the changed map.
        self.belief.tracking = None;
        if !self.belief.sensors.is_empty() {
            self.start_tracking(None, i64::try_from(self.publication.snapshot.computed_ns).unwrap_or(i64::MAX));
        }
    }

    /// Whether the scores are for the map in use: false until the first scores of a changed map.
    pub(super) fn is_scored(&self) -> bool {
        self.map.is_scored()
    }

    /// Whether the prefetcher's state is stale.
    #[must_use]
    pub(crate) fn is_prefetch_due(&self) -> bool {
        self.is_scored() && self.scoring.is_prefetch_due()
    }

    /// The state for the prefetcher.
    pub fn now(&mut self) -> Now {
        self.scoring.now()
    }

    /// Stores a prefetched answer, if it is useful.
    pub fn keep_answer(&mut self, answer: Answer) {
        self.scoring.keep_answer(answer);
    }

    /// The counters of prefetching since the start.
    #[must_use]
    pub fn prepared(&self) -> PreparedTally {
        self.scoring.tally
    }

    /// Makes the prefetcher forget all sentences.
    pub(super) fn forget_prefetched(&mut self) {
        self.scoring.forget_prefetched();
    }

    /// Sets, per start of a narrator, the last sequence that a former run handled and the state database has dropped.
    pub(super) fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.scoring.pipeline.intake().settle(settled);
    }

    /// Counts a refused event as handled, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, event: EventId) {
        self.scoring.pipeline.intake().pass_over(event);
    }

    /// The most tokens of a sentence, with the map in use.
    #[must_use]
    pub(crate) fn sentence_tokens_max(&self) -> usize {
        self.scoring.pipeline.inside().options().history.tokens
    }

    /// Forgets a person, and the events of other persons for which `is_theirs` holds. The next step's scores are without them.
    pub(super) fn forget(&mut self, person: PersonId, is_theirs: impl Fn(&Observation) -> bool) {
        self.watch();
        self.lose(person);
        self.scoring.pipeline.intake().forget_told(is_theirs);
        self.attribution.forget_texts();
        self.scoring.readings.clear();
        self.belief.sensors.forget(person);
        self.home.forget(person);
        self.forget_prefetched();
    }

    /// Forgets a person except for the habits.
    fn lose(&mut self, person: PersonId) {
        self.follow();
        self.attribution.lose(person);
        self.records.lose(person);
        self.drop_person(person);
    }

    fn drop_person(&mut self, person: PersonId) {
        self.scoring.drop_person(person);
        self.belief.drop_person(person);
        self.home.lose(person);
    }

    /// Whether time alone changes the scores: a window ends, a visitor is gone, or the filter believes that a person left or came.
    #[must_use]
    pub fn is_overdue(&self, now_ns: BootNs) -> bool {
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        let persons = &self.attribution.persons;
        persons.expired(now_ns).is_some()
            || self.scoring.silent(persons, now_ns).is_some()
            || self.belief.crossed(persons).is_some()
    }

    fn lapse(&mut self, now_ns: BootNs) {
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        while let Some(person) = self.scoring.silent(&self.attribution.persons, now_ns) {
            self.scoring.pipeline.intake().end_window(person);
            if let Some(own) = self.belief.followed.get_mut(&person) {
                own.end_window();
            }
            self.scoring.rescore(person);
        }
        while let Some(person) = self.attribution.persons.expired(now_ns) {
            self.attribution.persons.expire(person, now_ns);
            self.drop_person(person);
            self.records.note_gone(person);
        }
        while let Some((person, event)) = self.belief.crossed(&self.attribution.persons) {
            // A restart needs no record of it: the filter repeats it.
            let before = self.attribution.persons.get(person);
            let (last, heard_ns) = before.map_or((EventId::new(0, 0, 0), now_ns), |known| (known.last, known.heard_ns));
            let observed_ns = BootNs(u64::try_from(now_ns).unwrap_or_default());
            let own = Observation { person, by_fit: true, observed_ns, ..Observation::saying(last.sequence, event) };
            let own = Observation { source: last.source, epoch: last.epoch, ..own };
            if let Ok(own) =
                self.take(own, Quota::EARLIER, (self.attribution.reporter(last.source, true), true), Some(now_ns))
            {
                self.scoring.pipeline.intake().enter(Quota::EARLIER, own);
            }
            let on_bed = self.belief.sensors.has_on_bed(person, None);
            if let Some(known) = self.attribution.persons.get_mut(person) {
                known.on_bed |= on_bed && known.presence == Presence::Present;
                // It is no event: a late one of the person still counts.
                known.heard_ns = heard_ns;
            }
        }
    }

    /// Updates the forecasts with the new events, and each person's forecast with their newest scores.
    fn watch(&mut self) {
        self.update();
        if !self.is_scored() {
            return;
        }
        while let Some(person) = self.home.next_rescored() {
            let Some(own) = self.scoring.pipeline.inside().person(person).filter(|own| own.at_home) else { continue };
            let Some(known) = self.attribution.persons.get(person) else { continue };
            let expected = self.belief.followed.get(&person).and_then(Forecaster::expected);
            let rooms = expected.unwrap_or(&own.grounded.partition_probability);
            self.home.look_ahead(person, known.heard_ns, (own.label_log_prob_nats, own.trust), rooms);
        }
    }

    /// The same without the habits' forecasts of the next thing and room, which no message has.
    fn update(&mut self) {
        if !self.is_scored() {
            // The forecasts are for the previous map. New events wait for the first scores of the changed one.
            return;
        }
        self.follow();
        self.belief.expect(&self.scoring.pipeline);
    }

    /// Starts the joint filter with the belief of the forecasters; the `fresh` report of a device comes later.
    fn start_tracking(&mut self, fresh: Option<(u64, &SensorReport)>, at_ns: i64) {
        self.watch();
        let home = (&self.map, self.scoring.pipeline.grounding());
        self.belief.start_tracking(home, &self.attribution.persons, fresh, at_ns);
    }

    fn follow(&mut self) {
        self.read_seen();
        self.belief.follow((&mut self.map, &self.scoring.pipeline), &mut self.attribution, &mut self.home);
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
        if !self.is_scored() {
            // A permanently failing scorer must not fill the memory.
            self.belief.drop_unwatched();
        }
        self.scoring.readings.begin();
        self.attribution.persons.remove_gone();
        self.home.set_clock(now_ns, now_unix_ns);
        self.belief.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        let mut costly = 0;
        for Entry { observation, received_ns, after_gap, quota, leaves } in entries {
            self.scoring.receive(after_gap);
            if let Some((source, epoch)) = leaves {
                self.scoring.pipeline.intake().forget_source(source, epoch);
            }
            if self.scoring.pipeline.intake().is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.id());
                self.scoring.wait(received_ns);
                continue;
            }
            let at_ns = observed_at_ns(&observation, now_ns, now_unix_ns).or(i64::try_from(received_ns.0).ok());
            let is_unknown = !self.attribution.named.is_empty() && quota.number == OTHERS;
            let reporter = self.attribution.reporter(observation.source, is_unknown);
            self.scoring.pipeline.intake().include(&observation, quota);
            let name = observation.id();
            self.records.begin(name);
            let mut is_taken = false;
            let enter = |engine: &mut Self, own: Observation| {
                is_taken = true;
                engine.scoring.enter(quota, own, received_ns);
            };
            let (is_read_alone, moves) = self.attribute(observation, quota, reporter, at_ns, enter);
            // A restart must not move a person by an event that moved no person before.
            if !is_read_alone || !is_taken {
                self.records.note_moves(name, moves);
            } else {
                self.records.drop_moves(moves);
            }
            if !is_taken {
                self.scoring.wait(received_ns);
            }
        }
        if costly > 0 {
            tracing::warn!(
                costly,
                "narration that was accepted for another map costs more tokens than a window holds now, and is left out"
            );
        }
        if self.is_scored() && self.is_overdue(now_ns) {
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
    /// As [`Engine::step`].
    pub(super) fn score_within(
        &mut self,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
        patience_ns: u64,
    ) -> Result<Option<BootNs>, PipelineError> {
        if let Err(error) = self.scoring.pipeline.score_within(patience_ns) {
            self.publication.snapshot.flags |= score_flags::SCORER_FAILED;
            self.count();
            return Err(error);
        }
        if !self.is_scored() && self.scoring.pipeline.inside().is_owing() {
            self.count();
            return Ok(None);
        }
        self.adopt_map();
        let pipeline = &self.scoring.pipeline;
        self.scoring
            .rescored
            .iter()
            .filter(|person| !pipeline.inside().waits(**person))
            .for_each(|person| self.home.rescored(*person));
        let (received_ns, after_gap) = self.scoring.take_scored();
        let is_cut = self.scoring.pipeline.scores().is_cut;
        self.publication.number((now_ns, now_unix_ns), received_ns, (after_gap, is_cut));
        self.count();
        self.publication.fill(&self.scoring.pipeline, &mut self.attribution.persons);
        Ok(received_ns)
    }

    fn count(&mut self) {
        if self.scoring.count() {
            self.publication.snapshot.flags |= score_flags::PREPARED;
        }
    }

    /// The forecast from `now_ns` on, for `HORIZONS_S`: per room the probability that at least one person is in it. Without an event all rooms are
    /// equally likely, and a flag says so.
    pub fn forecast(&mut self, now_ns: BootNs) -> &ForecastV1 {
        self.look(now_ns);
        self.publication.forecast(&self.belief, &self.attribution.persons, &mut self.home, now_ns)
    }

    /// Each person's forecast, as [`Engine::forecast`], of at most [`MAX_PERSONS`](roomcast_ipc::raw::MAX_PERSONS).
    pub fn person_forecasts(&mut self, now_ns: BootNs) -> &PersonForecastsV1 {
        self.look(now_ns);
        self.publication.person_forecasts(&self.belief, &self.attribution.persons, &mut self.home, now_ns)
    }

    fn look(&mut self, now_ns: BootNs) {
        self.update();
        self.belief.track(self.scoring.pipeline.grounding(), now_ns);
    }

    /// The scores of the last good step as a message to send at `now_ns`; `heartbeat` if they are unchanged.
    pub fn message(&mut self, now_ns: BootNs, heartbeat: bool, behind: bool) -> &RoomScoresV1 {
        // If `SCORER_FAILED` is set, waiting persons do not set `BEHIND`.
        let waits =
            !self.publication.snapshot.has(score_flags::SCORER_FAILED) && self.scoring.pipeline.inside().is_behind();
        self.publication.message(now_ns, heartbeat, behind || waits)
    }

    /// Each person's scores of the last good step as a message to send at `now_ns`, of at most [`MAX_PERSONS`](roomcast_ipc::raw::MAX_PERSONS).
    pub fn person_scores(&mut self, now_ns: BootNs) -> &PersonScoresV1 {
        self.watch();
        self.publication.person_scores(&self.attribution.persons, now_ns)
    }

    /// The scores of the last step's best items, at most [`MAX_ITEMS`](roomcast_ipc::raw::MAX_ITEMS), with the header that ties them to the snapshot. `None` while a changed map
    /// waits for its first scores.
    pub fn items(&self) -> Option<(ItemScoresHeaderV1, impl ExactSizeIterator<Item = ItemScoreV1> + '_)> {
        self.is_scored().then(|| self.publication.items(&self.map.map, &self.scoring.pipeline))
    }

    /// Names, numbers and presence of the persons.
    #[must_use]
    pub fn persons(&self) -> &Persons {
        &self.attribution.persons
    }

    /// Gives a person a name, or another one.
    ///
    /// # Errors
    /// If the name belongs to another person or is no name, or if the state database cannot be written.
    pub fn rename(&mut self, person: PersonId, name: &str) -> Result<(), NotRenamed> {
        self.attribution.persons.rename(person, name)
    }

    pub(super) fn persons_mut(&mut self) -> &mut Persons {
        &mut self.attribution.persons
    }

    /// The newest snapshot, as last sent.
    #[must_use]
    pub fn snapshot(&self) -> &RoomScoresV1 {
        &self.publication.snapshot
    }

    /// The pipeline.
    #[must_use]
    pub fn pipeline(&self) -> &Pipeline<M> {
        &self.scoring.pipeline
    }

    /// The map.
    #[must_use]
    pub fn map(&self) -> &SemanticMap {
        &self.map.map
    }

    /// Does a small part of the model's reading after an event.
    pub(super) fn read_on(&mut self) {
        self.scoring.pipeline.idle().read_on();
    }

    /// Does a small part of the postponed work. Returns whether there is more.
    pub fn tidy(&mut self) -> bool {
        self.watch();
        self.scoring.pipeline.idle().tidy()
    }
}

#[cfg(test)]
mod tests;
