//! The published messages: scores, forecasts and items.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use roomcast_core::forecast::Forecaster;
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::Presence;
use roomcast_core::pipeline::{Included, Pipeline};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::scorer::certified::Effort;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::tracker::SURELY_EMPTY;
use roomcast_ipc::raw::{
    ALL_PERSONS, ForecastV1, IncludedV1, ItemScoreV1, ItemScoresHeaderV1, LEARNED_SHARE_S, MAX_HORIZONS, MAX_ITEMS,
    MAX_PERSONS, MAX_ROOMS, MAX_SOURCES, NO_PARTITION, PersonForecastV1, PersonForecastsV1, PersonScoresV1, PersonV1,
    RoomScoresV1, RoomV1, forecast_flags, person_flags, reached, score_flags,
};
use roomcast_ipc::text;

use super::belief::Belief;
use super::map_in_use::{NamedRooms, named_rooms};
use super::tracking::Tracking;
use super::{EngineError, HORIZONS_S, HomeHabits};
use crate::daemon::persons::Persons;

#[derive(Debug)]
pub(super) struct Publication {
    pub(super) snapshot: RoomScoresV1,
    /// Values beyond the rooms and horizons stay zero.
    pub(super) forecast: Box<ForecastV1>,
    /// Of the same step as the snapshot.
    pub(super) person_scores: Box<PersonScoresV1>,
    /// Values beyond the rooms and horizons stay zero.
    person_forecasts: Box<PersonForecastsV1>,
    /// Working memory of the forecast.
    pub(super) house: Independent,
    visitors: Vec<f64>,
    /// Working memory: the sources in the order of the message, each with the number of newer ones of the same quota.
    newest_sources: Vec<(usize, Included)>,
    /// Working memory: the time of each person's newest event, and the person.
    newest_persons: Vec<(i64, PersonId)>,
    /// The newest turn of a source in published scores.
    named_turn: u64,
}

impl Publication {
    pub(super) fn new<M: LanguageModel>(
        pipeline: &Pipeline<M>,
        map: &SemanticMap,
        epoch: u64,
    ) -> Result<Self, EngineError> {
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
        let mut person_scores: Box<PersonScoresV1> = Box::default();
        person_scores.id = room.map(|room| room.id);
        Ok(Self {
            snapshot,
            forecast: Box::default(),
            person_scores,
            person_forecasts: Box::default(),
            house: Independent::default(),
            visitors: Vec::new(),
            newest_sources: Vec::new(),
            newest_persons: Vec::new(),
            named_turn: 0,
        })
    }

    /// A changed map has its first scores.
    pub(super) fn change_map(&mut self, fingerprint: [u8; 32], (room, room_count): NamedRooms) {
        self.snapshot.map_fingerprint = fingerprint;
        (self.snapshot.room, self.snapshot.room_count) = (room, room_count);
        self.person_scores.id = room.map(|room| room.id);
        *self.forecast = ForecastV1::default();
    }

    /// Gives the snapshot the number and times of a step. `received_ns`: when its oldest newly scored event was received.
    pub(super) fn number(
        &mut self,
        (now_ns, now_unix_ns): (BootNs, UnixNs),
        received_ns: Option<BootNs>,
        (after_gap, is_cut): (bool, bool),
    ) {
        let snapshot = &mut self.snapshot;
        snapshot.sequence += 1;
        if !is_cut {
            (snapshot.computed_ns, snapshot.computed_unix_ns) = (now_ns.0, now_unix_ns.0);
        }
        snapshot.received_ns = received_ns.map_or(snapshot.received_ns, |received_ns| received_ns.0);
        snapshot.wait_ns = received_ns.map_or(0, |received_ns| now_ns.since(received_ns));
        snapshot.flags = if after_gap { score_flags::GAP } else { 0 };
    }

    /// The forecast of the house from `now_ns` on.
    pub(super) fn forecast(
        &mut self,
        belief: &Belief,
        known_persons: &Persons,
        home: &mut HomeHabits,
        now_ns: BootNs,
    ) -> &ForecastV1 {
        let tracker = belief.tracking.as_ref().map(|own| own.now());
        let (message, rooms) = (&mut *self.forecast, self.snapshot.rooms());
        (message.epoch, message.sequence) = (self.snapshot.epoch, self.snapshot.sequence);
        (message.computed_ns, message.published_ns) = (now_ns.0, now_ns.0);
        (message.room_count, message.person) = (self.snapshot.room_count, self.snapshot.person);
        (message.horizon_count, message.horizon_s) = (HORIZONS_S.len() as u32, HORIZONS_S);
        (message.minor, message.flags) = (2, 0);
        let persons = || known_persons.iter().filter(|(_, known)| known.presence != Presence::Gone);
        let followed = belief.forecasters();
        if persons().any(|(_, known)| known.restored) {
            message.flags |= forecast_flags::RESTORED;
        }
        // Persons outside the joint filter count by their own forecasts.
        let tracking = belief.tracking.as_deref();
        let untracked: Vec<&Forecaster> = match tracking {
            Some(own) => followed.iter().filter(|(person, _)| !own.follows(**person)).map(|(_, own)| own).collect(),
            None => Vec::new(),
        };
        let now_s = now_ns.seconds();
        let others_out: f64 = untracked.iter().map(|own| own.elsewhere(now_s, 0.0)).product();
        let is_empty =
            tracker.map_or(known_persons.are_all_away(), |own| own.house_empty() * others_out >= SURELY_EMPTY);
        // A resident without an event may be anywhere, also out. Sensors show the occupied rooms all the same, but no empty house.
        let (nobody, misses) = (belief.followed.is_empty(), known_persons.misses_residents());
        let not_known = match tracking.is_some_and(Tracking::is_sensed) {
            true => is_empty && (nobody || misses),
            false => nobody || misses && known_persons.are_all_away(),
        };
        for (is_so, flag) in [
            (not_known, forecast_flags::NOT_KNOWN),
            (is_empty && !not_known, forecast_flags::NOBODY_HOME),
            ((nobody || misses) && !not_known, forecast_flags::RESIDENT_UNKNOWN),
        ] {
            message.flags |= if is_so { flag } else { 0 };
        }
        for (of_scores, flag) in [
            (score_flags::UNFAMILIAR, forecast_flags::UNFAMILIAR),
            (score_flags::MODEL_WEAK, forecast_flags::MODEL_WEAK),
        ] {
            message.flags |= if self.snapshot.has(of_scores) { flag } else { 0 };
        }
        for (id, room) in message.id.iter_mut().zip(rooms) {
            *id = room.id;
        }
        let mut others_free = [1.0; MAX_ROOMS];
        for own in &untracked {
            others_free.iter_mut().zip(own.at(now_s, 0.0)).for_each(|(free, p)| *free *= 1.0 - p);
        }
        self.house.update(rooms.len(), followed, home, now_ns);
        let Independent { free, elsewhere, .. } = &self.house;
        // Visitors have no forecast of their own: they move as the filter lets them.
        self.visitors.clear();
        if let Some(own) = tracker {
            own.without_visitors(&HORIZONS_S, &mut self.visitors);
        }
        let visitors =
            |place: usize, column: usize| self.visitors.get(place * (rooms.len() + 1) + column).unwrap_or(&1.0);
        let free = |place: usize, room: usize| free[place * rooms.len() + room] * visitors(place, room);
        let elsewhere: [f64; MAX_HORIZONS] =
            std::array::from_fn(|place| elsewhere[place] * visitors(place, rooms.len()));
        for place in 0..MAX_HORIZONS {
            // The part of the persons' dependence now that remains: the joint belief differs from the product of the persons' beliefs by it.
            let stays = |own: &Forecaster| own.stays(now_s, f64::from(HORIZONS_S[place]));
            let common: f64 = if tracker.is_some() { followed.values().map(stays).product() } else { 0.0 };
            let joint = |of: f64, now: f64, own: f64| (own + common * (of - now)).clamp(0.0, 1.0);
            for (room, row) in message.probability.iter_mut().enumerate().take(rooms.len()) {
                let occupied = match tracker {
                    _ if not_known => 1.0 / rooms.len() as f64,
                    Some(own) => {
                        let occupied = 1.0 - (1.0 - own.occupied(room)) * others_free[room];
                        joint(occupied, 1.0 - free(0, room), 1.0 - free(place, room))
                    }
                    None => 1.0 - free(place, room),
                };
                row[place] = occupied.clamp(0.0, 1.0) as f32;
            }
            message.elsewhere[place] = match tracker {
                _ if not_known => 0.0,
                Some(own) => joint(own.house_empty() * others_out, elsewhere[0], elsewhere[place]) as f32,
                None => elsewhere[place] as f32,
            };
        }
        message
    }

    /// Each person's forecast from `now_ns` on.
    pub(super) fn person_forecasts(
        &mut self,
        belief: &Belief,
        known_persons: &Persons,
        home: &mut HomeHabits,
        now_ns: BootNs,
    ) -> &PersonForecastsV1 {
        let signed_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        let followed = belief.forecasters();
        let (message, scores) = (&mut *self.person_forecasts, &self.person_scores);
        (message.epoch, message.sequence) = (self.snapshot.epoch, self.snapshot.sequence);
        (message.computed_ns, message.published_ns, message.minor) = (now_ns.0, now_ns.0, 1);
        (message.room_count, message.id) = (scores.room_count, scores.id);
        (message.horizon_count, message.horizon_s) = (HORIZONS_S.len() as u32, HORIZONS_S);
        let before = std::mem::replace(&mut message.person_count, scores.person_count) as usize;
        message.persons = scores.persons;
        let rooms = scores.room_count as usize;
        let (used, places) = (scores.persons().len(), &mut message.person);
        for (scores, place) in scores.persons().iter().zip(places.iter_mut()) {
            let person = PersonId(scores.person);
            let name = text::encode_cut(known_persons.name_of(person).unwrap_or_default());
            *place = PersonForecastV1 { person: person.0, name, ..PersonForecastV1::default() };
            let presence = known_persons.get(person).map_or(Presence::Gone, |known| known.presence);
            place.presence = presence as u32;
            place.flags = known_persons.flags(person, signed_ns) | scores.flags & person_flags::UNFAMILIAR;
            let own = followed.get(&person);
            let by_habit = own.is_some_and(|own| self.house.fill_rows((person, own), home, now_ns));
            if own.is_some() {
                for (horizon, (gone, known)) in self.house.by_horizon().enumerate() {
                    place.elsewhere[horizon] = gone as f32;
                    for (row, probability) in place.probability.iter_mut().zip(known).take(rooms) {
                        row[horizon] = probability.clamp(0.0, 1.0) as f32;
                    }
                }
            } else {
                // Persons that are gone have no forecast. A present person has none if the events had no time.
                let is_here = presence == Presence::Present;
                let even = if is_here { 1.0 / rooms.max(1) as f32 } else { 0.0 };
                place.probability.iter_mut().take(rooms).for_each(|row| row.fill(even));
                place.elsewhere.fill(f32::from(u8::from(!is_here)));
            }
            place.observations = home.observations_of(person) as f32;
            if by_habit {
                write_learned(home, person, place);
            }
        }
        places.iter_mut().take(before).skip(used).for_each(|place| *place = PersonForecastV1::default());
        message
    }

    /// The snapshot as a message to send at `now_ns`.
    pub(super) fn message(&mut self, now_ns: BootNs, heartbeat: bool, behind: bool) -> &RoomScoresV1 {
        let message = &mut self.snapshot;
        message.published_ns = now_ns.0;
        message.flags &= !(score_flags::HEARTBEAT | score_flags::BEHIND);
        message.flags |= if heartbeat { score_flags::HEARTBEAT } else { 0 };
        message.flags |= if behind { score_flags::BEHIND } else { 0 };
        message
    }

    /// Each person's scores as a message to send at `now_ns`.
    pub(super) fn person_scores(&mut self, known_persons: &Persons, now_ns: BootNs) -> &PersonScoresV1 {
        let message = &mut *self.person_scores;
        message.published_ns = now_ns.0;
        let now_ns = i64::try_from(now_ns.0).unwrap_or(i64::MAX);
        for person in message.person.iter_mut().take(message.person_count as usize) {
            let id = PersonId(person.person);
            person.flags = known_persons.flags(id, now_ns) | person.flags & person_flags::UNFAMILIAR;
            person.name = text::encode_cut(known_persons.name_of(id).unwrap_or_default());
        }
        message
    }

    /// The scores of the best items, with the header that ties them to the snapshot.
    pub(super) fn items<'a, M: LanguageModel>(
        &self,
        map: &'a SemanticMap,
        pipeline: &'a Pipeline<M>,
    ) -> (ItemScoresHeaderV1, impl ExactSizeIterator<Item = ItemScoreV1> + 'a) {
        let RoomScoresV1 { epoch, sequence, computed_ns, .. } = self.snapshot;
        let items = map.items().len() as u32;
        let header = ItemScoresHeaderV1 { epoch, sequence, computed_ns, minor: 1, items, ..Default::default() };
        let mut counts = vec![0_u32; map.labels().len()];
        for item in map.items() {
            counts[item.label.0 as usize] += 1;
        }
        let grounding = pipeline.grounding();
        let scores: Vec<f64> = grounding.item_log_score_nats(&pipeline.scores().label_log_prob_nats).collect();
        let mut chosen: Vec<usize> = (0..scores.len()).collect();
        if chosen.len() > MAX_ITEMS {
            chosen.select_nth_unstable_by(MAX_ITEMS, |a, b| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b)));
            chosen.truncate(MAX_ITEMS);
            chosen.sort_unstable();
        }
        let items = chosen.into_iter().map(move |place| {
            let item = &map.items()[place];
            ItemScoreV1 {
                id: text::encode_cut(&item.id),
                label: text::encode_cut(&map.labels()[item.label.0 as usize]),
                log_score_nats: scores[place],
                partition: grounding.item_partition()[place].map_or(NO_PARTITION, |partition| partition.0),
                label_items: counts[item.label.0 as usize],
            }
        });
        (header, items)
    }

    /// Fills the snapshot and the persons' scores after a step.
    pub(super) fn fill<M: LanguageModel>(&mut self, pipeline: &Pipeline<M>, known_persons: &mut Persons) {
        let scores = pipeline.scores();
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
        snapshot.observed_ns = scores.newest_observed_ns.0;
        snapshot.tokenise_ns = scores.timing.tokenise_ns;
        snapshot.prefix_ns = scores.timing.prefix_ns;
        snapshot.trie_ns = scores.timing.trie_ns;
        snapshot.ground_ns = scores.timing.ground_ns;

        let (persons, present) = known_persons.count();
        let shown = || pipeline.persons().filter(|own| own.at_home || present == 0).map(|own| own.person);
        snapshot.person =
            if shown().count() == 1 { shown().next().map_or(ALL_PERSONS, |person| person.0) } else { ALL_PERSONS };
        snapshot.persons = persons as u32;
        snapshot.window = pipeline.persons().map(|own| own.window as u64).sum();
        snapshot.flags |= if known_persons.are_all_away() && !known_persons.misses_residents() {
            score_flags::NOBODY_HOME
        } else {
            0
        };
        snapshot.flags |= if persons == 0 { score_flags::NO_NARRATION } else { 0 };
        snapshot.flags |= match pipeline.inside().model().weakness {
            Some(_) => score_flags::MODEL_WEAK,
            None if scores.trust < 1.0 => score_flags::UNFAMILIAR,
            None => 0,
        };

        self.newest_sources.clear();
        for own in &scores.included {
            let newer =
                scores.included.iter().filter(|other| other.quota == own.quota && other.turn > own.turn).count();
            self.newest_sources.push((newer, *own));
        }
        // The newest start of each quota first, so that one narrator's starts push out no confirmation of another. Ties are ordered by source, so
        // that equal steps give equal messages.
        self.newest_sources.sort_unstable_by_key(|(newer, own)| (*newer, Reverse(own.turn), own.source, own.epoch));
        // A start that was published before, without an event since, needs no confirmation.
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
                observed_ns: included.observed_ns.0,
                accepted: included.accepted,
            };
        }
        snapshot.flags |= if cut { score_flags::SOURCES_CUT } else { 0 };
        self.fill_persons(pipeline, known_persons);
    }

    fn fill_persons<M: LanguageModel>(&mut self, pipeline: &Pipeline<M>, known_persons: &mut Persons) {
        self.newest_persons.clear();
        self.newest_persons.extend(known_persons.iter().map(|(person, known)| (known.heard_ns, person)));
        // Residents come before visitors, then persons of named narrators, then persons with newer events. Unknown narrators can invent any number of
        // persons.
        let persons = &*known_persons;
        let rank = |(heard_ns, person): &(i64, PersonId)| {
            (persons.is_visitor(*person), !persons.is_trusted(*person), Reverse(*heard_ns), *person)
        };
        self.newest_persons.sort_unstable_by_key(rank);
        // A person without a place is not published, and waits for nothing.
        for (_, person) in self.newest_persons.drain(MAX_PERSONS.min(self.newest_persons.len())..) {
            if let Some(known) = known_persons.get_mut(person) {
                known.told = true;
            }
        }
        self.newest_persons.sort_unstable_by_key(|(_, person)| *person);

        let (message, snapshot) = (&mut *self.person_scores, &self.snapshot);
        (message.epoch, message.sequence) = (snapshot.epoch, snapshot.sequence);
        (message.computed_ns, message.map_fingerprint) = (snapshot.computed_ns, snapshot.map_fingerprint);
        message.persons = snapshot.persons;
        message.room_count = snapshot.room_count;
        let mut places = message.person.iter_mut();
        let mut count = 0;
        for &(heard_ns, person) in &self.newest_persons {
            let Some(known) = known_persons.get_mut(person) else { continue };
            let own = pipeline.inside().person(person);
            // Persons that are gone have no scores, but are published once.
            if own.is_none() && known.presence != Presence::Gone {
                continue;
            }
            let Some(place) = places.next() else { break };
            count += 1;
            known.told = true;
            *place = PersonV1 {
                person: person.0,
                presence: known.presence as u32,
                observed_ns: heard_ns.try_into().unwrap_or_default(),
                since_ns: known.since_ns.try_into().unwrap_or_default(),
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
            place.flags = if own.at_home && own.trust < 1.0 { person_flags::UNFAMILIAR } else { 0 };
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
        let before = std::mem::replace(&mut message.person_count, count) as usize;
        message.person.iter_mut().take(before).skip(count as usize).for_each(|place| *place = PersonV1::default());
    }
}

/// The house by horizon if its persons moved independently.
#[derive(Debug, Default)]
pub(super) struct Independent {
    /// The probability that a room is free, horizon by horizon.
    free: Vec<f64>,
    /// The probability that all persons are elsewhere.
    elsewhere: [f64; MAX_HORIZONS],
    /// A person's forecast: horizon by horizon the rooms, then elsewhere.
    rows: Vec<f64>,
}

impl Independent {
    fn update(
        &mut self,
        rooms: usize,
        followed: &BTreeMap<PersonId, Forecaster>,
        home: &mut HomeHabits,
        now_ns: BootNs,
    ) {
        let (mut free, mut elsewhere) = (std::mem::take(&mut self.free), [1.0; MAX_HORIZONS]);
        free.clear();
        free.resize(rooms * MAX_HORIZONS, 1.0);
        for (person, own) in followed {
            self.fill_rows((*person, own), home, now_ns);
            for ((free, elsewhere), (gone, known)) in
                free.chunks_exact_mut(rooms.max(1)).zip(&mut elsewhere).zip(self.by_horizon())
            {
                free.iter_mut().zip(known).for_each(|(free, p)| *free *= 1.0 - p);
                *elsewhere *= gone;
            }
        }
        (self.free, self.elsewhere) = (free, elsewhere);
    }

    /// Fills in a person's forecast, by habit if there is one. Returns whether there is.
    pub(super) fn fill_rows(
        &mut self,
        (person, own): (PersonId, &Forecaster),
        home: &mut HomeHabits,
        now_ns: BootNs,
    ) -> bool {
        self.rows.clear();
        if let Some(rows) = home.forecast(person, own, now_ns, &HORIZONS_S) {
            self.rows.extend_from_slice(rows);
            return true;
        }
        for horizon_s in HORIZONS_S.map(f64::from) {
            self.rows.extend(own.at(now_ns.seconds(), horizon_s));
            self.rows.push(own.elsewhere(now_ns.seconds(), horizon_s));
        }
        false
    }

    /// By horizon: the probability of elsewhere, and of each room.
    pub(super) fn by_horizon(&self) -> impl Iterator<Item = (f64, &[f64])> {
        let rows = self.rows.chunks_exact((self.rows.len() / HORIZONS_S.len()).max(1));
        rows.filter_map(|row| row.split_last()).map(|(gone, known)| (*gone, known))
    }
}

/// The room sets of a person's latest forecast, and the learned share of it.
fn write_learned(home: &HomeHabits, person: PersonId, place: &mut PersonForecastV1) {
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

/// The message's value for the way in which scores were reached.
fn reached_value(effort: Effort) -> u32 {
    match effort {
        Effort::Exact => reached::EXACT,
        Effort::Ranking => reached::RANKING,
        Effort::Top => reached::TOP,
        Effort::Deadline => reached::DEADLINE,
    }
}
