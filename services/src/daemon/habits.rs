//! Learned habits next to the forecasts: the daemon's use of [`Habits`]. This module uses no disk and no port; clocks are arguments.
//!
//! Each observation is learned at most once. The [`EventId`] of the newest learned observation of each start of a source is stored together with the
//! habits. The ids contain no time, so clock steps do no harm. Ids and habits are written in one transaction, so restarts do no harm. The journal has
//! its observations in the order of learning: all observations up to the last one with a stored id were learned, and the later ones were not. A
//! restarted daemon learns these from its journal. If the journal has none of the ids, the order is unknown, and its observations are not learned.
//!
//! Hours of the day are local ones. Habits have a clock that follows the monotonic one. When the wall clock is set, the hour changes in spring or
//! autumn, or the machine slept, their times move by the same amount, so that no stay seems longer than it was.

use std::collections::BTreeMap;

use roomcast_core::forecast::Forecaster;
use roomcast_core::grounding::Grounding;
use roomcast_core::habits::{
    Habits, HabitsOptions, Learned, PARTS, PERSONS_MAX, Place, Shares, StoredError, Turn, WhenShares,
};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::Observation;
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_ipc::raw::{MAX_HORIZONS, MAX_ROOMS};

use super::zone::Zone;

/// Greater differences between wall clock and monotonic clock are clock steps, not corrections.
const CLOCK_SET_S: f64 = 30.0;
/// Most ageing of counts while no daemon runs, in seconds.
const AWAY_S: f64 = 7.0 * 86_400.0;
/// Interval at which time spent is counted.
const TICK_NS: u64 = 60_000_000_000;
/// After a longer gap between ticks the machine was suspended.
const ASLEEP_NS: u64 = 5 * TICK_NS;
/// A turn counts for a room if the person is there with more than this probability.
const SURE: f64 = 0.5;

/// Ids of learned observations: the newest sequence of each start of a source, the newest last, as many as the intake follows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Heard(Vec<EventId>);

impl Heard {
    pub(super) fn new(names: impl IntoIterator<Item = EventId>) -> Self {
        let mut heard = Self::default();
        names.into_iter().for_each(|name| _ = heard.note(name));
        heard
    }

    pub(super) fn names(&self) -> &[EventId] {
        &self.0
    }

    fn has(&self, event: EventId) -> bool {
        self.0.iter().any(|known| known.start() == event.start() && known.sequence >= event.sequence)
    }

    /// Adds an id. Returns true if it is new.
    fn note(&mut self, name: EventId) -> bool {
        if self.has(name) {
            return false;
        }
        match self.0.iter().position(|known| known.start() == name.start()) {
            Some(at) => _ = self.0.remove(at),
            None if self.0.len() >= SOURCES_MAX => _ = self.0.remove(0),
            None => {}
        }
        self.0.push(name);
        true
    }

    /// Number of learned observations among these, which are in order.
    fn learned_of(&self, observations: &[Observation]) -> usize {
        let last = observations.iter().rposition(|observation| self.has(observation.id()));
        last.map_or(if self.0.is_empty() { 0 } else { observations.len() }, |last| last + 1)
    }
}

/// State that outlives the daemon.
#[derive(Debug, Clone)]
pub struct Memory {
    /// The habits.
    pub habits: Habits,
    /// Ids of their observations.
    pub(super) heard: Heard,
    /// End of the counted time, in seconds since 1970, local time.
    pub(super) watched_until_s: f64,
}

impl Memory {
    /// Empty habits.
    #[must_use]
    pub fn new(options: HabitsOptions) -> Self {
        Self::of(Habits::new(options))
    }

    /// Habits from another home or run.
    #[must_use]
    pub fn of(habits: Habits) -> Self {
        Self { habits, heard: Heard::default(), watched_until_s: f64::NEG_INFINITY }
    }
}

/// The forecast of one person.
#[derive(Debug, Default)]
struct Prefetcher {
    /// Its time and the state of the habits; `None` if it is not valid.
    of: Option<(BootNs, u64)>,
    /// Per horizon and place, row by row; elsewhere comes last.
    probability: Vec<f64>,
    shares: Vec<WhenShares>,
    /// Per horizon the places of the set with the promised coverage.
    sets: Vec<PlaceSet>,
    /// Probability that the person is in the place that the habits assume.
    sure: f64,
}

/// A set of places: a bit per room, and elsewhere.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct PlaceSet {
    /// Bit i is room i.
    pub(super) rooms: u64,
    /// Whether elsewhere belongs to it.
    pub(super) elsewhere: bool,
}

impl PlaceSet {
    /// The last place is elsewhere.
    fn of(held: &[bool]) -> Self {
        let Some((elsewhere, rooms)) = held.split_last() else { return Self::default() };
        let bit = |bits: u64, (room, held): (usize, &bool)| bits | u64::from(*held) << room;
        Self { rooms: rooms.iter().take(MAX_ROOMS).enumerate().fold(0, bit), elsewhere: *elsewhere }
    }
}

/// Use of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Next {
    /// It changes habits and the person's context.
    Learned,
    /// It changes the person's context: the place and the last thing.
    Recalled,
    /// It is ignored.
    Nothing,
}

/// Habits of the home in use.
#[derive(Debug)]
pub struct HomeHabits {
    memory: Memory,
    learn: bool,
    zone: Zone,
    is_of_the_past: bool,
    /// The monotonic clock and the local time of the same moment.
    clock: Option<(BootNs, f64)>,
    /// The next observations were learned by a former run.
    recalling: bool,
    next: Next,
    /// The newest observation with a new id.
    newest: Option<EventId>,
    labels: usize,
    ahead: BTreeMap<PersonId, Prefetcher>,
    /// Increases with every change of a forecast.
    state: u64,
    ticked_ns: BootNs,
    changed: bool,
    /// Number of changes of habits since the start.
    taken: u64,
    /// Persons' places when the habits were replaced.
    replaced: Vec<(PersonId, Place)>,
    /// Persons with new scores.
    rescored: Vec<PersonId>,
    /// Working memory: the model's label scores; forecasts without habits, and the same of a person who surely is where the habits assume.
    model: Vec<f64>,
    shipped: Vec<f64>,
    given: Vec<f64>,
    held: Vec<bool>,
}

impl Default for HomeHabits {
    /// Habits that neither learn nor know anything.
    fn default() -> Self {
        Self::new(Memory::new(HabitsOptions { learn: false, ..HabitsOptions::default() }), Zone::UTC)
    }
}

impl HomeHabits {
    /// Starts with stored habits.
    #[must_use]
    pub fn new(memory: Memory, zone: Zone) -> Self {
        Self {
            learn: memory.habits.options().learn,
            memory,
            zone,
            is_of_the_past: false,
            clock: None,
            recalling: false,
            next: Next::Nothing,
            newest: None,
            labels: 0,
            ahead: BTreeMap::new(),
            state: 0,
            ticked_ns: BootNs(0),
            changed: false,
            taken: 0,
            replaced: Vec::new(),
            rescored: Vec::new(),
            model: Vec::new(),
            shipped: Vec::new(),
            given: Vec::new(),
            held: Vec::new(),
        }
    }

    /// Learns from past observations: weeks without any may lie between them, and their clock is right.
    #[must_use]
    pub fn of_the_past(self) -> Self {
        Self { is_of_the_past: true, ..self }
    }

    fn is_idle(&self) -> bool {
        !self.learn && !self.is_known()
    }

    fn is_known(&self) -> bool {
        let learned = self.memory.habits.learned();
        learned.counts > 0 || learned.observations > 0.0
    }

    /// Marks a change of habits by anything but an observation.
    fn changes(&mut self) {
        self.taken += 1;
        self.state += 1;
        self.changed = true;
    }

    pub(super) fn bind(&mut self, grounding: &Grounding) {
        self.memory.habits.bind_to(grounding);
        self.labels = grounding.scored_labels().len();
        self.ahead.clear();
        self.state += 1;
        self.memory.habits.set_learning(false);
        for (person, place) in self.replaced.drain(..) {
            if let Some((_, now_s)) = self.clock {
                self.memory.habits.be(person, place, now_s);
            }
        }
        self.memory.habits.set_learning(self.learn);
    }

    pub(super) fn set_clock(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) {
        if self.is_idle() {
            return;
        }
        let local_s = self.zone.local_s(now_unix_ns);
        if let Some((then_ns, then_s)) = self.clock {
            let set_s = local_s - then_s - (now_ns.0 as f64 - then_ns.0 as f64) / 1e9;
            if set_s.abs() > CLOCK_SET_S {
                if self.is_of_the_past {
                    // The outcomes of the last forecasts were not observed.
                    self.memory.habits.drop_waiting();
                }
                self.memory.habits.shift_clock(set_s);
                if !self.is_of_the_past {
                    self.memory.habits.shift_counts(set_s, f64::INFINITY);
                }
                self.state += 1;
            }
            if now_ns.since(then_ns) > ASLEEP_NS && !self.is_of_the_past {
                // The machine was suspended, and the time was unobserved.
                self.memory.habits.pass(local_s);
            }
        } else if !self.is_of_the_past {
            // Either the daemon was off for long or the clock is wrong. Both age the counts by a week at most.
            let away_s = local_s - self.memory.watched_until_s;
            let by_s = if away_s.is_finite() { away_s - away_s.clamp(0.0, AWAY_S) } else { 0.0 };
            self.memory.habits.shift_counts(by_s, local_s);
        }
        self.clock = Some((now_ns, local_s));
    }

    /// Local time minus monotonic clock, in whole seconds because clocks drift.
    pub(super) fn local_ahead_s(&self, now_ns: BootNs, unix_ns: UnixNs) -> f64 {
        (self.zone.local_s(unix_ns) - now_ns.seconds()).round()
    }

    /// Local time of a monotonic time, in seconds since 1970.
    fn local_s(&self, at_ns: i64) -> Option<f64> {
        self.clock.map(|(now_ns, local_s)| local_s + (at_ns as f64 - now_ns.0 as f64) / 1e9)
    }

    /// Starts restoring observations of a former run. Returns the number of those that it learned.
    pub(super) fn begin_recall(&mut self, observations: &[Observation], now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        self.set_clock(now_ns, now_unix_ns);
        self.recalling = true;
        self.memory.heard.learned_of(observations)
    }

    /// The restored observations that follow were not learned yet.
    pub(super) fn end_recall(&mut self) {
        if std::mem::take(&mut self.recalling) {
            let until_s = self.memory.watched_until_s.min(self.clock.map_or(f64::INFINITY, |(_, now_s)| now_s));
            self.memory.habits.pass(until_s);
        }
    }

    /// Ends restoring: the time since the last observation was unobserved.
    pub(super) fn end_restore(&mut self) {
        self.end_recall();
        if let Some((_, now_s)) = self.clock {
            self.memory.habits.pass(now_s);
        }
    }

    /// Announces the next observation and adds its id. Observations of visitors teach nothing. An observation with several clauses or persons is
    /// announced once for each of them.
    pub(super) fn next_is(&mut self, name: EventId, person: PersonId, lives_here: bool) {
        if self.is_idle() || self.clock.is_none() {
            self.next = Next::Nothing;
            return;
        }
        if self.memory.heard.note(name) {
            self.newest = Some(name);
        }
        let new = self.newest == Some(name);
        let lives_here = lives_here && (self.learn || self.has_room_for(person));
        self.next = match lives_here {
            true if self.learn && new && !self.recalling => Next::Learned,
            true => Next::Recalled,
            false => Next::Nothing,
        };
        self.changed |= new && !self.recalling;
        self.taken += u64::from(self.next == Next::Learned);
        self.state += 1;
    }

    /// Whether a person is known or fits without replacing another one.
    fn has_room_for(&self, person: PersonId) -> bool {
        let habits = &self.memory.habits;
        habits.persons().count() < PERSONS_MAX || habits.persons().any(|(known, _)| known == person)
    }

    /// A person did something with the mentioned label, if any. `own` contains the event already.
    pub(super) fn turned(&mut self, person: PersonId, at_ns: i64, mention: Option<usize>, own: &Forecaster) {
        let Some(at_s) = self.local_s(at_ns).filter(|_| self.next != Next::Nothing) else { return };
        let label = mention.filter(|label| *label < self.labels);
        let habits = &mut self.memory.habits;
        habits.set_learning(self.next == Next::Learned);
        let room = sure_of(own.belief()).filter(|_| label.is_some());
        habits.observe(&Turn { person, label, room, at_s });
        if room.is_none() {
            // A person who does something is in the house.
            habits.come_back(person, at_s);
        }
        if room.is_none() && label.is_some() && habits.is_back(person) {
            // The thing narrows down the place better than the earlier returns, even if it is in several rooms.
            habits.lose(person, at_s);
        }
        habits.set_learning(self.learn);
    }

    /// A person is in the house, in a reported room if any, or out of it. Rooms that the person's own forecaster infers are not
    /// learned, however likely; those of the joint filter are, once a minute.
    pub(super) fn is_in(&mut self, person: PersonId, at_ns: i64, told: Option<Place>) {
        let Some(at_s) = self.local_s(at_ns).filter(|_| self.next != Next::Nothing) else { return };
        let habits = &mut self.memory.habits;
        habits.set_learning(self.next == Next::Learned);
        match told {
            Some(place) => habits.be(person, place, at_s),
            None => habits.come_back(person, at_s),
        }
        habits.set_learning(self.learn);
    }

    /// A person was in a room when the map changed. The new map may put the last events elsewhere; this teaches nothing.
    pub(super) fn stayed(&mut self, person: PersonId, at_ns: i64, own: &Forecaster) {
        let (Some(at_s), Some(room)) = (self.local_s(at_ns), sure_of(own.belief())) else { return };
        if !self.is_idle() && self.memory.habits.place(person).is_some() {
            self.memory.habits.set_learning(false);
            self.memory.habits.be(person, Place::Room(room), at_s);
            self.memory.habits.set_learning(self.learn);
        }
    }

    /// A room is empty. A person of this room who is now believed elsewhere has left it with an unknown destination.
    pub(super) fn is_empty(&mut self, person: PersonId, at_ns: i64, room: usize, own: &Forecaster) {
        let Some(at_s) = self.local_s(at_ns).filter(|_| self.next != Next::Nothing) else { return };
        let is_here = self.memory.habits.place(person) == Some(Place::Room(room));
        let here = own.belief().get(room).copied().unwrap_or_default();
        if is_here && own.belief().iter().any(|p| *p > here) {
            self.memory.habits.set_learning(self.next == Next::Learned);
            self.memory.habits.lose(person, at_s);
            self.memory.habits.set_learning(self.learn);
        }
    }

    /// A person is no longer followed: they left after their last event.
    pub(super) fn lose(&mut self, person: PersonId) {
        self.ahead.remove(&person);
        if self.memory.habits.place(person).is_some() || self.memory.habits.is_back(person) {
            self.memory.habits.set_learning(false);
            self.memory.habits.be(person, Place::Elsewhere, f64::NEG_INFINITY);
            self.memory.habits.set_learning(self.learn);
        }
    }

    pub(super) fn rescored(&mut self, person: PersonId) {
        if !self.is_idle() {
            self.rescored.push(person);
        }
    }

    pub(super) fn next_rescored(&mut self) -> Option<PersonId> {
        self.rescored.pop()
    }

    /// Takes the model's forecast after the event at `at_ns`: log-probabilities of labels in nats with their weight, and probabilities of rooms. Without
    /// weight all labels are equally likely.
    pub(super) fn look_ahead(
        &mut self,
        person: PersonId,
        at_ns: i64,
        (labels_nats, trust): (&[f64], f64),
        rooms: &[f64],
    ) {
        let fits = labels_nats.len() == self.labels && rooms.len() + 1 == self.memory.habits.places();
        // Visitors have no habits.
        let is_known = self.memory.habits.persons().any(|(known, _)| known == person);
        let Some(at_s) = self.local_s(at_ns).filter(|_| fits && is_known) else { return };
        let most_nats = labels_nats.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.model.clear();
        self.model.extend(labels_nats.iter().map(|nats| (nats - most_nats).exp().powf(trust)));
        self.memory.habits.mix(person, at_s, &self.model);
        self.memory.habits.next_rooms(person, at_s, rooms);
    }

    pub(super) fn is_tick_due(&self, now_ns: BootNs) -> bool {
        !self.is_idle() && now_ns.since(self.ticked_ns) >= TICK_NS
    }

    /// Counts time for every followed person.
    pub(super) fn tick(
        &mut self,
        (now_ns, now_unix_ns): (BootNs, UnixNs),
        followed: &BTreeMap<PersonId, Forecaster>,
        is_learned_of: impl Fn(PersonId) -> bool,
    ) {
        self.set_clock(now_ns, now_unix_ns);
        // After a start, the place of the last event may be older than what the former run learned.
        let is_first = std::mem::replace(&mut self.ticked_ns, now_ns) == BootNs(0);
        let Some((_, now_s)) = self.clock else { return };
        let from_s = now_ns.seconds();
        for (person, own) in followed {
            if own.is_tracked() && is_learned_of(*person) {
                self.memory.habits.set_learning(self.learn && !is_first);
                self.believe(*person, own, (from_s, now_s));
                self.memory.habits.set_learning(self.learn);
            }
            if self.memory.habits.place(*person).is_some() {
                let mut shipped = |ahead_s: f64, row: &mut [f64]| _ = own.write_given((from_s, ahead_s), |_| true, row);
                self.memory.habits.tick(*person, now_s, &mut shipped);
            }
        }
        self.changed |= self.learn && !followed.is_empty();
        self.state += 1;
    }

    /// Takes the place that the joint filter is sure of. Events that several persons can have caused tell no place, and the filter learns later whose they were.
    fn believe(&mut self, person: PersonId, own: &Forecaster, (from_s, now_s): (f64, f64)) {
        /// Less probable places are no habit.
        const KNOWN: f64 = 0.9;
        let out = own.elsewhere(from_s, 0.0);
        let room = own.belief().iter().position(|p| (1.0 - out) * p > KNOWN).map(Place::Room);
        let Some(place) = room.or((out > KNOWN).then_some(Place::Elsewhere)) else { return };
        let is_known = self.memory.habits.persons().any(|(known, _)| known == person);
        if is_known && self.memory.habits.place(person) != Some(place) {
            self.memory.habits.be(person, place, now_s);
        }
    }

    /// A person's forecast per horizon (always the same horizons, now first) and place, row by row, elsewhere last. For now it is the joint filter's
    /// belief. `None` if only the forecast without habits exists.
    pub(super) fn forecast(
        &mut self,
        person: PersonId,
        own: &Forecaster,
        now_ns: BootNs,
        horizons_s: &[f32; MAX_HORIZONS],
    ) -> Option<&[f64]> {
        let now_s = self.local_s(i64::try_from(now_ns.0).unwrap_or(i64::MAX)).filter(|_| !self.is_idle())?;
        let of = (now_ns, self.state);
        let ahead = self.ahead.entry(person).or_default();
        if ahead.of != Some(of) {
            ahead.of = None;
            let from_s = now_ns.seconds();
            let (place, is_back) = (self.memory.habits.place(person), self.memory.habits.is_back(person));
            let is_there = |room: Option<usize>| match place {
                Some(Place::Elsewhere) => room.is_none(),
                Some(Place::Room(own)) => room == Some(own),
                // The joint filter knows the room better than the earlier returns.
                None => is_back && room.is_some() && !own.is_tracked(),
            };
            let places = self.memory.habits.places();
            let is_known = self.memory.habits.persons().any(|(known, _)| known == person);
            if own.belief().len() + 1 != places || !is_known {
                return None;
            }
            let horizons_s = horizons_s.map(f64::from);
            let mut sure = 0.0;
            for rows in [&mut self.shipped, &mut self.given] {
                rows.clear();
                rows.resize(horizons_s.len() * places, 0.0);
            }
            let rows = self.shipped.chunks_exact_mut(places).zip(self.given.chunks_exact_mut(places));
            for ((shipped, given), ahead_s) in rows.zip(horizons_s) {
                own.write_given((from_s, ahead_s), |_| true, shipped);
                sure = own.write_given((from_s, ahead_s), is_there, given);
            }
            let Prefetcher { probability, shares, sets, .. } = ahead;
            self.memory.habits.at_times(person, (now_s, &horizons_s), &self.given, probability, shares);
            // Thresholds of sets were learned while the believed place was the habits' place. Otherwise sets cover the belief.
            sets.clear();
            let rows = self.shipped.chunks_exact(places).zip(self.given.chunks_exact(places));
            for ((row, (shipped, given)), horizon_s) in probability.chunks_exact_mut(places).zip(rows).zip(horizons_s) {
                // The belief outside of that place keeps the forecast without habits.
                let mix = |row: &mut [f64]| {
                    let rest = shipped.iter().zip(given).map(|(all, given)| (all - sure * given).max(0.0));
                    row.iter_mut().zip(rest).for_each(|(p, rest)| *p = sure * *p + rest);
                };
                let is_elsewhere = sure <= SURE;
                if is_elsewhere {
                    mix(row);
                }
                self.memory.habits.room_set(person, horizon_s, row, is_elsewhere, &mut self.held);
                sets.push(PlaceSet::of(&self.held));
                if !is_elsewhere {
                    mix(row);
                }
            }
            if own.is_tracked() {
                ahead.probability[..places].copy_from_slice(&self.shipped[..places]);
            }
            (ahead.sure, ahead.of) = (sure, Some(of));
        }
        Some(&ahead.probability)
    }

    /// Weights in a person's latest forecast by horizon, and the probability that the habits have the right place.
    pub(super) fn shares(&self, person: PersonId) -> Option<(f64, &[WhenShares])> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some((ahead.sure, &ahead.shares))
    }

    /// The sets of a person's latest forecast by horizon, and their promised coverage.
    pub(super) fn sets(&self, person: PersonId) -> Option<(f64, &[PlaceSet])> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some((self.memory.habits.options().coverage, &ahead.sets))
    }

    /// The latest forecast of a person, by horizon: the probability of each place, elsewhere last.
    pub(super) fn probabilities(&self, person: PersonId) -> Option<impl Iterator<Item = &[f64]>> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some(ahead.probability.chunks_exact(self.memory.habits.places().max(1)))
    }

    /// Share of habits in a person's latest forecast by horizon, 0 to 1.
    pub(super) fn learned_shares(&self, person: PersonId) -> Option<impl Iterator<Item = f64>> {
        let (sure, shares) = self.shares(person)?;
        Some(shares.iter().map(move |shares| (sure * (1.0 - shares.shipped)).clamp(0.0, 1.0)))
    }

    /// The shares in the probability that a person turns to a thing next.
    pub(super) fn why_thing(&self, person: PersonId, label: usize) -> Option<Shares> {
        self.memory.habits.explain(person, label)
    }

    /// The shares in the probability that the next thing is in a room.
    pub(super) fn why_room(&self, person: PersonId, room: usize) -> Option<Shares> {
        self.memory.habits.explain_room(person, room)
    }

    /// Decayed observations of a person.
    pub(super) fn observations_of(&self, person: PersonId) -> f64 {
        self.memory.habits.persons().find(|(known, _)| *known == person).map_or(0.0, |(_, observations)| observations)
    }

    /// Forgets a person. Returns false if the person had no habits.
    pub(super) fn forget(&mut self, person: PersonId) -> bool {
        self.ahead.remove(&person);
        self.changes();
        self.memory.habits.forget(person)
    }

    /// Replaces the habits, but not the ids of learned observations. The caller must bind a map next.
    pub(super) fn replace(&mut self, habits: Habits) {
        self.memory.habits = habits;
        self.memory.habits.set_learning(self.learn);
        self.changes();
    }

    /// Forgets all persons. The caller must bind a map next.
    pub(super) fn forget_all(&mut self) {
        self.replace(Habits::new(*self.memory.habits.options()));
    }

    /// The habits as JSON.
    ///
    /// # Errors
    /// When writing JSON fails: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        self.memory.habits.to_json()
    }

    /// Replaces the habits by those of another run or home.
    pub(super) fn take_json(&mut self, json: &str) -> Result<(), StoredError> {
        let before = &self.memory.habits;
        let mut habits = Habits::from_json(*before.options(), json)?;
        if let Some((_, now_s)) = self.clock {
            // They may come from a machine with a clock that is ahead.
            habits.shift_counts(0.0, now_s);
        }
        let places = before.persons().filter_map(|(person, _)| Some((person, before.place(person)?)));
        self.replaced = places.collect();
        self.replace(habits);
        Ok(())
    }

    /// Amount of learned data.
    #[must_use]
    pub fn learned(&self) -> Learned {
        self.memory.habits.learned()
    }

    /// Per room of the map, the number of visits that ended in each part of the day.
    pub(super) fn visits(&self) -> Vec<[f64; PARTS]> {
        self.clock.map_or_else(Vec::new, |(_, now_s)| self.memory.habits.visits(now_s))
    }

    /// Number of changes of habits since the start: by observations, by forgetting, by imports.
    #[must_use]
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Whether habits are learned.
    #[must_use]
    pub(crate) fn learns_now(&self) -> bool {
        self.learn
    }

    /// Hours for which a person's place was known, about.
    pub(super) fn watched_h(&self, person: PersonId) -> f64 {
        self.memory.habits.watched_min(person) / 60.0
    }

    /// Persons with habits, and their number of observations.
    #[must_use]
    pub fn persons(&self) -> Vec<(PersonId, f64)> {
        self.memory.habits.persons().collect()
    }

    /// The state to write, if it has changed since the last call.
    pub fn memory_if_changed(&mut self) -> Option<Memory> {
        if !std::mem::take(&mut self.changed) {
            return None;
        }
        let watched_until_s = self.clock.map_or(self.memory.watched_until_s, |(_, now_s)| now_s);
        self.memory.watched_until_s = watched_until_s;
        Some(self.memory.clone())
    }
}

/// The room with more than [`SURE`] probability; at most one can have it.
fn sure_of(belief: &[f64]) -> Option<usize> {
    belief.iter().position(|p| *p > SURE)
}

#[cfg(test)]
mod tests;
