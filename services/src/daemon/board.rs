//! From observations to the snapshot that is published: the pipeline's step, with sequence numbers, ages and flags. No clock,
//! no port: the daemon's loop, the simulation and the tests drive it alike.

use std::cmp::Reverse;

use roomcast_ipc::{
    ALL_PERSONS, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1, MAX_HORIZONS, MAX_PERSONS, MAX_ROOMS,
    MAX_SOURCES, MessageError, NAME_BYTES, NO_PARTITION, PersonScoresV1, PersonV1, RoomScoresV1, RoomV1,
    forecast_flags, person_flags, reached, score_flags, text,
};

use crate::moment::Moment;
use roomcast_core::forecast::{ForecastOptions, Forecaster, Mentions};
use roomcast_core::grounding::{GroundingOptions, Partition, partitions};
use roomcast_core::narration::Observation;
use roomcast_core::pipeline::{Included, Pipeline, PipelineError, Prepared};
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
}

/// Where one person will be.
#[derive(Debug)]
struct Followed {
    forecaster: Forecaster,
    /// Nothing was observed of the person since the daemon's start: what is known of them is from the journal.
    restored: bool,
}

impl Followed {
    fn new(rooms: usize, at_s: f64, restored: bool) -> Self {
        Self { forecaster: Forecaster::new(rooms, ForecastOptions::default(), at_s), restored }
    }
}

/// When something was observed, in monotonic seconds; negative where that was before the machine's start, which the wall clock knows.
/// None where no clock tells.
fn observed_s(observation: &Observation, now_ns: u64, now_unix_ns: u64) -> Option<f64> {
    match (observation.observed_ns, observation.observed_unix_ns) {
        (0, 0) => None,
        (0, unix_ns) => Some((now_ns as f64 - now_unix_ns.saturating_sub(unix_ns) as f64) / 1e9),
        (monotonic_ns, _) => Some(monotonic_ns as f64 / 1e9),
    }
}

/// An observation that the forecasts do not know yet.
#[derive(Debug, Default)]
struct Seen {
    person: u32,
    /// Monotonic.
    observed_ns: u64,
    sentence: String,
}

/// Owns the pipeline and the current snapshot.
#[derive(Debug)]
pub struct Board<M> {
    pipeline: Pipeline<M>,
    map: SemanticMap,
    grounding: GroundingOptions,
    mentions: Mentions,
    snapshot: RoomScoresV1,
    /// The rooms of a changed map, until a step has scored them; the snapshot and the forecasts are of the map before it.
    next_rooms: Option<Box<NamedRooms>>,
    /// The newest forecast; what is beyond the rooms and horizons stays zero.
    forecast: Box<ForecastV1>,
    /// Each person's scores, of the same step as the snapshot.
    persons: Box<PersonScoresV1>,
    /// Working memory of a step: when each person was observed last, and their number.
    newest_persons: Vec<((u64, u64), u32)>,
    accepted: std::collections::BTreeMap<u64, u64>,
    /// What the forecasts do not know yet are the first `unwatched` of them; the others are memory to be used again.
    seen: Vec<Seen>,
    unwatched: usize,
    /// Of the narration that no step has scored yet: when its first was received, and whether some was lost before it.
    unscored_ns: Option<u64>,
    unscored_gap: bool,
    /// Working memory of a step: the sources that the scores name, newest first.
    newest_sources: Vec<Included>,
    /// Per person where they will be; persons unknown to the histories are forgotten.
    followed: std::collections::BTreeMap<u32, Followed>,
}

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
            snapshot,
            next_rooms: None,
            forecast: Box::default(),
            persons: Box::default(),
            newest_persons: Vec::new(),
            accepted: std::collections::BTreeMap::new(),
            seen: Vec::new(),
            unwatched: 0,
            unscored_ns: None,
            unscored_gap: false,
            newest_sources: Vec::new(),
            followed: std::collections::BTreeMap::new(),
        })
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
        if same_rooms {
            return;
        }
        // What was believed of other rooms says nothing of these, but what was observed does.
        self.unwatched = 0;
        let former = std::mem::take(&mut self.followed);
        let grounding = self.pipeline.grounding();
        for (person, history) in self.pipeline.histories().iter() {
            let restored = former.get(&person).is_some_and(|followed| followed.restored);
            for observation in history.observations() {
                let Some(at_s) = observed_s(observation, now_ns, now_unix_ns) else { continue };
                let fresh = || Followed::new(grounding.partitions().len(), at_s, restored);
                let followed = self.followed.entry(person).or_insert_with(fresh);
                let mention = self.mentions.last(observation.sentence.as_str());
                followed.forecaster.observe(at_s, mention, grounding, &[]);
            }
        }
    }

    /// Whether the scores are of the map in use: not while a changed map waits for its first ones.
    pub(super) fn is_scored(&self) -> bool {
        self.next_rooms.is_none()
    }

    /// All that is behind the newest scores.
    #[must_use]
    pub fn moment(&self) -> Moment {
        Moment::of(&self.pipeline, &self.map, &self.grounding, Some(&self.snapshot))
    }

    /// Enters observations of a former run, oldest first, without scoring: into the histories, and with their times into the forecasts.
    pub fn restore(&mut self, observations: impl IntoIterator<Item = Observation>, now_ns: u64, now_unix_ns: u64) {
        for observation in observations {
            *self.accepted.entry(observation.source).or_default() += 1;
            let grounding = self.pipeline.grounding();
            if let Some(at_s) = observed_s(&observation, now_ns, now_unix_ns) {
                let fresh = || Followed::new(grounding.partitions().len(), at_s, true);
                let followed = self.followed.entry(observation.person).or_insert_with(fresh);
                // What the model said then is gone; what it says after the last one comes with the first step.
                let mention = self.mentions.last(observation.sentence.as_str());
                followed.forecaster.observe(at_s, mention, grounding, &[]);
            }
            self.pipeline.observe([observation]);
        }
        let histories = self.pipeline.histories();
        self.followed.retain(|person, _| histories.get(*person).is_some());
    }

    /// Takes the scored observations into the forecasts of their persons, and each person's own scores into theirs.
    fn watch(&mut self) {
        if self.next_rooms.is_some() {
            // The forecasts are of the map before; what is observed waits for the first scores of the new one.
            return;
        }
        let grounding = self.pipeline.grounding();
        for Seen { person, observed_ns, sentence } in &self.seen[..std::mem::take(&mut self.unwatched)] {
            let at_s = *observed_ns as f64 / 1e9;
            let fresh = || Followed::new(grounding.partitions().len(), at_s, false);
            let followed = self.followed.entry(*person).or_insert_with(fresh);
            // What the model says after all of them is for what comes then, not for what lies between them.
            followed.forecaster.observe(at_s, self.mentions.last(sentence), grounding, &[]);
            followed.restored = false;
        }
        for own in self.pipeline.persons() {
            if let Some(followed) = self.followed.get_mut(&own.person) {
                followed.forecaster.expect(&own.grounded.partition_probability);
            }
        }
        self.seen.truncate(SEEN_KEPT);
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
        (message.minor, message.flags) = (1, 0);
        if self.followed.is_empty() {
            message.flags |= forecast_flags::NOT_KNOWN;
        }
        if self.followed.values().any(|followed| followed.restored) {
            message.flags |= forecast_flags::RESTORED;
        }
        for (id, room) in message.id.iter_mut().zip(rooms) {
            *id = room.id;
        }
        let now_s = now_ns as f64 / 1e9;
        for (place, horizon_s) in HORIZONS_S.iter().enumerate() {
            let mut free = [1.0; MAX_ROOMS];
            for followed in self.followed.values() {
                let probability = followed.forecaster.at(now_s, f64::from(*horizon_s));
                free.iter_mut().zip(probability).for_each(|(free, p)| *free *= 1.0 - p);
            }
            for (row, free) in message.probability.iter_mut().zip(free).take(rooms.len()) {
                let occupied = if self.followed.is_empty() { 1.0 / rooms.len() as f64 } else { 1.0 - free };
                row[place] = occupied.clamp(0.0, 1.0) as f32;
            }
        }
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
        let (accepted, seen, unwatched) = (&mut self.accepted, &mut self.seen, &mut self.unwatched);
        let (unscored_ns, unscored_gap) = (&mut self.unscored_ns, &mut self.unscored_gap);
        self.pipeline.observe(entries.into_iter().map(|Entry { observation: o, received_ns: at_ns, after_gap }| {
            *unscored_ns = Some(unscored_ns.map_or(at_ns, |first| first.min(at_ns)));
            *unscored_gap |= after_gap;
            *accepted.entry(o.source).or_default() += 1;
            if *unwatched == seen.len() {
                seen.push(Seen::default());
            }
            let place = &mut seen[*unwatched];
            *unwatched += 1;
            (place.person, place.observed_ns) = (o.person, o.observed_ns);
            place.sentence.clear();
            place.sentence.push_str(o.sentence.as_str());
            o
        }));
        if let Err(error) = self.pipeline.score() {
            self.snapshot.flags |= score_flags::SCORER_FAILED;
            return Err(error);
        }
        self.adopt_map(now_ns, now_unix_ns);
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
    pub fn persons(&mut self, now_ns: u64) -> &PersonScoresV1 {
        self.watch();
        let message = &mut *self.persons;
        message.published_ns = now_ns;
        for person in message.person.iter_mut().take(message.person_count as usize) {
            let restored = self.followed.get(&person.person).is_some_and(|followed| followed.restored);
            person.flags = if restored { person_flags::RESTORED } else { 0 };
        }
        message
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

    /// The items' scores of the last step, with the header that ties them to the snapshot; none while a changed map waits for its first
    /// scores.
    pub fn items(&self) -> Option<(ItemScoresHeaderV1, impl ExactSizeIterator<Item = ItemScoreV1> + '_)> {
        if self.next_rooms.is_some() {
            return None;
        }
        let RoomScoresV1 { epoch, sequence, computed_ns, .. } = self.snapshot;
        let header = ItemScoresHeaderV1 { epoch, sequence, computed_ns, ..Default::default() };
        let mut counts = vec![0_u32; self.map.labels().len()];
        for item in self.map.items() {
            counts[item.label.0 as usize] += 1;
        }
        let grounding = self.pipeline.grounding();
        let scores = grounding.item_log_score_nats(&self.pipeline.scores().label_log_prob_nats);
        let placed = self.map.items().iter().zip(grounding.item_partition()).zip(scores);
        let items = placed.map(move |((item, partition), log_score_nats)| ItemScoreV1 {
            id: text::encode_cut(&item.id),
            label: text::encode_cut(&self.map.labels()[item.label.0 as usize]),
            log_score_nats,
            partition: partition.map_or(NO_PARTITION, |partition| partition.0),
            label_items: counts[item.label.0 as usize],
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

        let (mut persons, mut last) = (0, ALL_PERSONS);
        for (person, _) in self.pipeline.histories().iter() {
            persons += 1;
            last = person;
        }
        snapshot.persons = persons;
        snapshot.window = self.pipeline.persons().map(|own| own.window as u64).sum();
        snapshot.person = if persons == 1 { last } else { ALL_PERSONS };

        self.newest_sources.clear();
        self.newest_sources.extend_from_slice(&scores.included);
        // By source where times are equal, so that the same step gives the same message.
        self.newest_sources.sort_unstable_by_key(|included| (Reverse(included.observed_ns), included.source));
        let cut = self.newest_sources.len() > MAX_SOURCES;
        self.newest_sources.truncate(MAX_SOURCES);
        snapshot.source_count = self.newest_sources.len() as u32;
        snapshot.included = Default::default();
        for (place, included) in snapshot.included.iter_mut().zip(&self.newest_sources) {
            *place = IncludedV1 {
                source: included.source,
                epoch: included.epoch,
                sequence: included.sequence,
                observed_ns: included.observed_ns,
                accepted: self.accepted.get(&included.source).copied().unwrap_or(0),
            };
        }
        snapshot.flags |= if cut { score_flags::SOURCES_CUT } else { 0 };
        snapshot.flags |= if self.newest_sources.is_empty() { score_flags::NO_NARRATION } else { 0 };
        self.fill_persons();
    }

    /// Copies each person's scores into their message.
    fn fill_persons(&mut self) {
        self.newest_persons.clear();
        for (person, history) in self.pipeline.histories().iter() {
            let newest = history.observations().next_back();
            self.newest_persons.push((newest.map_or((0, 0), |o| (o.observed_ns, o.observed_unix_ns)), person));
        }
        self.newest_persons.sort_unstable_by_key(|(observed, person)| (Reverse(*observed), *person));
        self.newest_persons.truncate(MAX_PERSONS);
        self.newest_persons.sort_unstable_by_key(|(_, person)| *person);

        let (message, snapshot) = (&mut *self.persons, &self.snapshot);
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
        for &((observed_ns, _), person) in &self.newest_persons {
            let (Some(own), Some(place)) = (self.pipeline.person(person), places.next()) else { continue };
            count += 1;
            let window = own.window as u64;
            let label_mass = own.grounded.label_mass;
            let reached = reached_value(own.reached);
            (place.person, place.reached, place.observed_ns) = (person, reached, observed_ns);
            (place.window, place.label_mass) = (window, label_mass);
            for (row, values) in [
                (&mut place.log_score_nats, &own.grounded.partition_log_score_nats[..]),
                (&mut place.lower_log_score_nats, own.lower_log_score_nats),
                (&mut place.upper_log_score_nats, own.upper_log_score_nats),
                (&mut place.probability, &own.grounded.partition_probability),
            ] {
                let (used, unused) = row.split_at_mut(values.len().min(MAX_ROOMS));
                used.copy_from_slice(&values[..used.len()]);
                unused.fill(0.0);
            }
        }
        places.for_each(|place| *place = PersonV1::default());
        message.person_count = count;
    }
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

    use roomcast_core::grounding::Grounding;
    use roomcast_core::label_trie::TokenTree;
    use roomcast_core::narration::Sentence;
    use roomcast_core::pipeline::PipelineOptions;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{DecodeStats, ModelError, ModelInfo, TextStart, Token};
    use roomcast_core::semantic_map::delta::parse_changes;
    use roomcast_ipc::Message;

    use super::*;

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
        Entry { observation: observation(person, at_ns, sentence), received_ns: at_ns, after_gap: false }
    }

    fn occupied(board: &mut Board<TableModel>, room: usize, now_ns: u64) -> f32 {
        board.forecast(now_ns).probability[room][0]
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
            after.restore(kept, now_ns, now_unix_ns);
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
        let told = board.persons(30 * S);
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
        let told = *both.persons(100 * S);
        told.check().unwrap();
        assert_eq!((told.persons().len(), told.rooms().collect::<Vec<_>>()), (2, vec!["kitchen", "living-room"]));
        for (own, person) in alone.iter_mut().zip(told.persons()) {
            // To the bit, and alone also to the bit what the snapshot says.
            let of_own = *own.persons(100 * S);
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
