//! What the people of the home do, learned beside their forecasts: the daemon's use of [`Habits`]. No disk, no port; the clocks come in as
//! numbers.
//!
//! Nothing is learned twice. What an observation is called ([`EventId`]) is kept together with what was learned
//! from it: of each start of a source the newest sequence. That holds whatever the clocks do, since no time is in it; over restarts, since
//! both are written as one; and when the journal's older half goes, since only the names are compared that are still there. The journal
//! has its observations in the order in which they were learned, so all up to the last one with a name that is kept were learned, and those
//! behind it were not: a daemon that was killed learns these from its journal. Where the journal holds none of the names, nobody can tell,
//! and nothing of it is learned.
//!
//! Hours of the day are local ones. Habits go by a clock that runs on with the monotonic one; where the wall clock is set, or the hour
//! changes in spring and autumn, or the machine slept, their times are moved by as much, so that nobody seems to have stayed for that long.

use std::collections::BTreeMap;
use std::ffi::OsStr;

use roomcast_core::forecast::Forecaster;
use roomcast_core::grounding::Grounding;
use roomcast_core::habits::{
    Habits, HabitsOptions, Learned, PARTS, PERSONS_MAX, Place, RoomShares, Shares, StoredError, Turn, WhenShares,
};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::Observation;
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_ipc::raw::{MAX_HORIZONS, MAX_ROOMS};

/// A difference between wall clock and monotonic clock that is more than the correction of a clock that runs.
const CLOCK_SET_S: f64 = 30.0;
/// What was learned grows older by at most so much while no daemon runs, in seconds.
const AWAY_S: f64 = 7.0 * 86_400.0;
/// How often time spent is counted.
const TICK_NS: u64 = 60_000_000_000;
/// A clock that nobody looked at for longer, though time spent is counted every minute, is that of a machine that slept.
const ASLEEP_NS: u64 = 5 * TICK_NS;
/// A room counts as the one where something was done if the person is believed to be there with more than this.
const SURE: f64 = 0.5;

/// Why there is no local time zone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NoZone {
    /// What is missing.
    pub reason: String,
    /// What to do.
    pub remedy: String,
}

/// The local time zone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Zone(Option<tz::TimeZone>);

impl Zone {
    /// Without one: local time is UTC.
    pub const UTC: Self = Self(None);

    /// The machine's; UTC where it says none, and the log says so.
    #[must_use]
    pub fn local() -> Self {
        Self::find().unwrap_or_else(|NoZone { reason, remedy }| {
            tracing::warn!("{reason}; hours of the day are those of UTC: {remedy}");
            Self::UTC
        })
    }

    /// The machine's, as `date` has it: what the environment variable `TZ` says, a name as `Europe/Berlin`, a file or a rule as
    /// `CET-1CEST,M3.5.0,M10.5.0/3`; UTC where it is empty, and `/etc/localtime` where it is not set.
    ///
    /// # Errors
    /// [`NoZone`].
    pub fn find() -> Result<Self, NoZone> {
        Self::of_variable(std::env::var_os("TZ").as_deref())
    }

    pub(crate) fn of_variable(value: Option<&OsStr>) -> Result<Self, NoZone> {
        let Some(value) = value else {
            return tz::TimeZone::local().map(|zone| Self(Some(zone))).map_err(|error| NoZone {
                reason: format!("no time zone is set: TZ is not, and /etc/localtime cannot be read: {error}"),
                remedy: "timedatectl set-timezone Europe/Berlin, or your own, or set TZ".to_owned(),
            });
        };
        if value.is_empty() {
            return Ok(Self::UTC);
        }
        // The library itself reads no environment.
        let zone = value.to_str().and_then(|value| tz::TimeZone::from_posix_tz(value).ok());
        zone.map(|zone| Self(Some(zone))).ok_or_else(|| NoZone {
            reason: format!("TZ is {value:?}, which is no time zone of this machine"),
            remedy: "correct it, or install the package tzdata; a rule as CET-1CEST,M3.5.0,M10.5.0/3 needs none"
                .to_owned(),
        })
    }

    /// Seconds since 1970 in local time.
    #[must_use]
    pub fn local_s(&self, unix_ns: UnixNs) -> f64 {
        let unix_s = unix_ns.0 / 1_000_000_000;
        let zone = self.0.as_ref().zip(i64::try_from(unix_s).ok());
        let offset_s = zone.and_then(|(zone, unix_s)| Some(zone.find_local_time_type(unix_s).ok()?.ut_offset()));
        unix_ns.seconds() + f64::from(offset_s.unwrap_or_default())
    }
}

/// Names of what was learned: the newest sequence of each start of a source, as many as the intake follows, the newest last.
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

    /// Takes note of a name; says whether it is new.
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

    /// How many of these, in their order, were learned.
    fn learned_of(&self, observations: &[Observation]) -> usize {
        let last = observations.iter().rposition(|observation| self.has(observation.id()));
        last.map_or(if self.0.is_empty() { 0 } else { observations.len() }, |last| last + 1)
    }
}

/// What outlives the daemon.
#[derive(Debug, Clone)]
pub struct Memory {
    /// What was learned.
    pub habits: Habits,
    /// Of which observations.
    pub(super) heard: Heard,
    /// Time spent was counted until then, in seconds since 1970, local time.
    pub(super) watched_until_s: f64,
}

impl Memory {
    /// Nothing yet.
    #[must_use]
    pub fn new(options: HabitsOptions) -> Self {
        Self::of(Habits::new(options))
    }

    /// What was learned elsewhere.
    #[must_use]
    pub fn of(habits: Habits) -> Self {
        Self { habits, heard: Heard::default(), watched_until_s: f64::NEG_INFINITY }
    }
}

/// Where one person will be.
#[derive(Debug, Default)]
struct Ahead {
    /// Of when it is, and of which state of the habits; none where nothing is known.
    of: Option<(BootNs, u64)>,
    /// Per horizon and place, row by row; elsewhere comes last.
    probability: Vec<f64>,
    shares: Vec<WhenShares>,
    /// Per horizon the places of the set with the promised coverage.
    sets: Vec<PlaceSet>,
    /// How far the person is believed to be where the habits have them.
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
    /// Of places of which elsewhere comes last.
    fn of(held: &[bool]) -> Self {
        let Some((elsewhere, rooms)) = held.split_last() else { return Self::default() };
        let bit = |bits: u64, (room, held): (usize, &bool)| bits | u64::from(*held) << room;
        Self { rooms: rooms.iter().take(MAX_ROOMS).enumerate().fold(0, bit), elsewhere: *elsewhere }
    }
}

/// What becomes of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Next {
    /// It is learned from.
    Learned,
    /// It says where somebody is, and what they did last.
    Recalled,
    /// It is passed over.
    Nothing,
}

/// Habits of the home in use.
#[derive(Debug)]
pub struct HomeHabits {
    memory: Memory,
    learn: bool,
    zone: Zone,
    is_of_the_past: bool,
    /// The monotonic clock and the local time at the same moment.
    clock: Option<(BootNs, f64)>,
    /// What comes now was learned by a former run.
    recalling: bool,
    next: Next,
    /// The newest observation that was not known before.
    newest: Option<EventId>,
    labels: usize,
    ahead: BTreeMap<PersonId, Ahead>,
    /// Grows with everything that changes a forecast.
    state: u64,
    ticked_ns: BootNs,
    changed: bool,
    /// How often what is known was changed since the start: by what was learned, forgotten, or put in its place.
    taken: u64,
    /// Who was where when what was learned was replaced.
    replaced: Vec<(PersonId, Place)>,
    /// Persons whose scores are new.
    rescored: Vec<PersonId>,
    /// Working memory: the model's labels, and forecasts without this home.
    model: Vec<f64>,
    shipped: Vec<f64>,
    held: Vec<bool>,
}

impl Default for HomeHabits {
    /// Learns nothing and knows nothing.
    fn default() -> Self {
        Self::new(Memory::new(HabitsOptions { learn: false, ..HabitsOptions::default() }), Zone::UTC)
    }
}

impl HomeHabits {
    /// With what was learned before.
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
            held: Vec::new(),
        }
    }

    /// Learns from the past: between what it is told, whole weeks may lie in which nobody watched, and the clock is right.
    #[must_use]
    pub fn of_the_past(self) -> Self {
        Self { is_of_the_past: true, ..self }
    }

    /// Nothing is learned, and nothing is known.
    fn is_idle(&self) -> bool {
        !self.learn && !self.is_known()
    }

    fn is_known(&self) -> bool {
        let learned = self.memory.habits.learned();
        learned.counts > 0 || learned.observations > 0.0
    }

    /// What was learned is no longer what it was, by something else than an observation.
    fn changes(&mut self) {
        self.taken += 1;
        self.state += 1;
        self.changed = true;
    }

    /// Takes up a map.
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

    /// Takes note of the time.
    pub(super) fn set_clock(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) {
        if self.is_idle() {
            return;
        }
        let local_s = self.zone.local_s(now_unix_ns);
        if let Some((then_ns, then_s)) = self.clock {
            let set_s = local_s - then_s - (now_ns.0 as f64 - then_ns.0 as f64) / 1e9;
            if set_s.abs() > CLOCK_SET_S {
                if self.is_of_the_past {
                    // Nobody was there to see what came of the last forecasts.
                    self.memory.habits.drop_waiting();
                }
                self.memory.habits.shift_clock(set_s);
                if !self.is_of_the_past {
                    self.memory.habits.shift_counts(set_s);
                }
                self.state += 1;
            }
            if now_ns.since(then_ns) > ASLEEP_NS && !self.is_of_the_past {
                // The machine slept, and nobody watched.
                self.memory.habits.pass(local_s);
            }
        } else if !self.is_of_the_past {
            if self.memory.watched_until_s.is_finite() {
                // Whether nobody watched for long or the clock is wrong, nobody knows; either way the home did not change as much as that.
                let away_s = local_s - self.memory.watched_until_s;
                self.memory.habits.shift_counts(away_s - away_s.clamp(0.0, AWAY_S));
            }
            self.memory.habits.no_later_than(local_s);
        }
        self.clock = Some((now_ns, local_s));
    }

    /// Local time less the monotonic clock, in whole seconds: clocks drift.
    pub(super) fn local_ahead_s(&self, now_ns: BootNs, unix_ns: UnixNs) -> f64 {
        (self.zone.local_s(unix_ns) - now_ns.seconds()).round()
    }

    /// Seconds since 1970 in local time, of a time of the monotonic clock.
    fn local_s(&self, at_ns: i64) -> Option<f64> {
        self.clock.map(|(now_ns, local_s)| local_s + (at_ns as f64 - now_ns.0 as f64) / 1e9)
    }

    /// Observations of a former run come: how many of them were learned by it.
    pub(super) fn begin_recall(&mut self, observations: &[Observation], now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        self.set_clock(now_ns, now_unix_ns);
        self.recalling = true;
        self.memory.heard.learned_of(observations)
    }

    /// Those that were learned are over; what comes was not learned, though it was observed before.
    pub(super) fn end_recall(&mut self) {
        if std::mem::take(&mut self.recalling) {
            let until_s = self.memory.watched_until_s.min(self.clock.map_or(f64::INFINITY, |(_, now_s)| now_s));
            self.memory.habits.pass(until_s);
        }
    }

    /// All of them have come: nobody watched between the last one and now.
    pub(super) fn end_restore(&mut self) {
        self.end_recall();
        if let Some((_, now_s)) = self.clock {
            self.memory.habits.pass(now_s);
        }
    }

    /// The next observation is this one, of one who lives here or of a visitor, of whom nothing is learned; takes note of it.
    /// One of several clauses, or about several persons, comes once for each of them.
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

    /// Whether a person is known, or nobody would have to be forgotten for them.
    fn has_room_for(&self, person: PersonId) -> bool {
        let habits = &self.memory.habits;
        habits.persons().count() < PERSONS_MAX || habits.persons().any(|(known, _)| known == person)
    }

    /// Somebody did something with the label that was mentioned, if any; `own` knows it already.
    pub(super) fn turned(&mut self, person: PersonId, at_ns: i64, mention: Option<usize>, own: &Forecaster) {
        let Some(at_s) = self.local_s(at_ns).filter(|_| self.next != Next::Nothing) else { return };
        let label = mention.filter(|label| *label < self.labels);
        let habits = &mut self.memory.habits;
        habits.set_learning(self.next == Next::Learned);
        let room = sure_of(own.belief()).filter(|_| label.is_some());
        habits.observe(&Turn { person, label, room, at_s });
        if room.is_none() {
            // Whoever does something is in the house.
            habits.come_back(person, at_s);
        }
        if room.is_none() && label.is_some() && habits.is_back(person) {
            // What they turn to, be it in one of several rooms, says more of where they are than where they go when they come home.
            habits.lose(person, at_s);
        }
        habits.set_learning(self.learn);
    }

    /// Somebody is in the house, in a room if one was told, or out of it. A room that nobody told of is not learned, however well it can be guessed.
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

    /// Somebody was in a room when the map was changed, whatever their last words say by the map of now; nothing is learned of that.
    pub(super) fn stayed(&mut self, person: PersonId, at_ns: i64, own: &Forecaster) {
        let (Some(at_s), Some(room)) = (self.local_s(at_ns), sure_of(own.belief())) else { return };
        if !self.is_idle() && self.memory.habits.place(person).is_some() {
            self.memory.habits.set_learning(false);
            self.memory.habits.be(person, Place::Room(room), at_s);
            self.memory.habits.set_learning(self.learn);
        }
    }

    /// Whoever was in a room is not there any more: those of the persons who are believed elsewhere now have left it, for nobody knows where.
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

    /// Nobody follows a person any more: they left when they were last told of.
    pub(super) fn lose(&mut self, person: PersonId) {
        self.ahead.remove(&person);
        if self.memory.habits.place(person).is_some() || self.memory.habits.is_back(person) {
            self.memory.habits.set_learning(false);
            self.memory.habits.be(person, Place::Elsewhere, f64::NEG_INFINITY);
            self.memory.habits.set_learning(self.learn);
        }
    }

    /// A person's scores are new.
    pub(super) fn rescored(&mut self, person: PersonId) {
        if !self.is_idle() {
            self.rescored.push(person);
        }
    }

    /// Whose scores are new, one after the other.
    pub(super) fn next_rescored(&mut self) -> Option<PersonId> {
        self.rescored.pop()
    }

    /// What the model says that a person turns to next, after what was observed at `at_ns`: per label its log-probability in nats, per
    /// room its probability.
    pub(super) fn look_ahead(&mut self, person: PersonId, at_ns: i64, labels_nats: &[f64], rooms: &[f64]) {
        let fits = labels_nats.len() == self.labels && rooms.len() + 1 == self.memory.habits.places();
        // Of a visitor nothing is known.
        let is_known = self.memory.habits.persons().any(|(known, _)| known == person);
        let Some(at_s) = self.local_s(at_ns).filter(|_| fits && is_known) else { return };
        let most_nats = labels_nats.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.model.clear();
        self.model.extend(labels_nats.iter().map(|nats| (nats - most_nats).exp()));
        self.memory.habits.mix(person, at_s, &self.model);
        self.memory.habits.next_rooms(person, at_s, rooms);
        self.state += 1;
    }

    /// Whether time spent is to be counted.
    pub(super) fn is_tick_due(&self, now_ns: BootNs) -> bool {
        !self.is_idle() && now_ns.since(self.ticked_ns) >= TICK_NS
    }

    /// Time passes for everybody who is followed.
    pub(super) fn tick(&mut self, now_ns: BootNs, now_unix_ns: UnixNs, followed: &BTreeMap<PersonId, Forecaster>) {
        self.set_clock(now_ns, now_unix_ns);
        self.ticked_ns = now_ns;
        let Some((_, now_s)) = self.clock else { return };
        let from_s = now_ns.seconds();
        for (person, own) in followed {
            if self.memory.habits.place(*person).is_some() {
                self.memory.habits.tick(*person, now_s, &mut |ahead_s, out| write_shipped(own, from_s, ahead_s, out));
            }
        }
        self.changed |= self.learn && !followed.is_empty();
        self.state += 1;
    }

    /// Where a person will be: per horizon (always the same ones) and place, row by row, elsewhere last. None where the forecast without habits is
    /// all there is.
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
            let out = own.elsewhere(from_s, 0.0);
            let sure = match self.memory.habits.place(person) {
                Some(Place::Elsewhere) => out,
                Some(Place::Room(room)) => (1.0 - out) * own.belief().get(room).copied().unwrap_or_default(),
                None if self.memory.habits.is_back(person) => 1.0 - out,
                None => 0.0,
            };
            let places = self.memory.habits.places();
            let is_known = self.memory.habits.persons().any(|(known, _)| known == person);
            if own.belief().len() + 1 != places || !is_known {
                return None;
            }
            self.shipped.clear();
            self.shipped.resize(horizons_s.len() * places, 0.0);
            for (row, ahead_s) in self.shipped.chunks_exact_mut(places).zip(horizons_s) {
                write_shipped(own, from_s, f64::from(*ahead_s), row);
            }
            let horizons_s = horizons_s.map(f64::from);
            let Ahead { probability, shares, sets, .. } = ahead;
            self.memory.habits.at_times(person, (now_s, &horizons_s), &self.shipped, probability, shares);
            // What sets promise was learned from forecasts of whoever is where habits have them; others have sets of what is believed.
            sets.clear();
            let rows = probability.chunks_exact_mut(places).zip(self.shipped.chunks_exact(places));
            for ((row, shipped), horizon_s) in rows.zip(horizons_s) {
                // Where they are believed to be elsewhere than habits have them, sets are of what is believed.
                let mix = |row: &mut [f64]| {
                    row.iter_mut().zip(shipped).for_each(|(p, own)| *p = sure * *p + (1.0 - sure) * own);
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
            (ahead.sure, ahead.of) = (sure, Some(of));
        }
        Some(&ahead.probability)
    }

    /// How much of a person's latest forecast is from where, by horizon: of the whole, where the habits are sure of the person's place.
    pub(super) fn shares(&self, person: PersonId) -> Option<(f64, &[WhenShares])> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some((ahead.sure, &ahead.shares))
    }

    /// The sets of places of a person's latest forecast, by horizon, and the coverage that they promise.
    pub(super) fn sets(&self, person: PersonId) -> Option<(f64, &[PlaceSet])> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some((self.memory.habits.options().sets.coverage, &ahead.sets))
    }

    /// The latest forecast of a person, by horizon: the probability of each place, elsewhere last.
    pub(super) fn probabilities(&self, person: PersonId) -> Option<impl Iterator<Item = &[f64]>> {
        let ahead = self.ahead.get(&person).filter(|ahead| ahead.of.is_some())?;
        Some(ahead.probability.chunks_exact(self.memory.habits.places().max(1)))
    }

    /// How much of a person's latest forecast comes from what was learned, by horizon, 0 to 1.
    pub(super) fn learned_shares(&self, person: PersonId) -> Option<impl Iterator<Item = f64>> {
        let (sure, shares) = self.shares(person)?;
        Some(shares.iter().map(move |shares| (sure * (1.0 - shares.shipped)).clamp(0.0, 1.0)))
    }

    /// Where the probability comes from that a person turns to a thing next.
    pub(super) fn why_thing(&self, person: PersonId, label: usize) -> Option<Shares> {
        self.memory.habits.explain(person, label)
    }

    /// Where the probability comes from that the next thing is in a room.
    pub(super) fn why_room(&self, person: PersonId, room: usize) -> Option<RoomShares> {
        self.memory.habits.explain_room(person, room)
    }

    /// How many observations of a person the habits rest on.
    pub(super) fn observations_of(&self, person: PersonId) -> f64 {
        self.memory.habits.observations(person)
    }

    /// Forgets a person; says whether anything was known.
    pub(super) fn forget(&mut self, person: PersonId) -> bool {
        self.ahead.remove(&person);
        self.changes();
        self.memory.habits.forget(person)
    }

    /// Replaces what was learned, but not of what; a map is to be bound next.
    pub(super) fn replace(&mut self, habits: Habits) {
        self.memory.habits = habits;
        self.memory.habits.set_learning(self.learn);
        self.changes();
    }

    /// Forgets everybody; a map is to be bound next.
    pub(super) fn forget_all(&mut self) {
        self.replace(Habits::new(*self.memory.habits.options()));
    }

    /// What was learned, as JSON.
    ///
    /// # Errors
    /// When it cannot be written as JSON: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        self.memory.habits.to_json()
    }

    /// Takes up what another run, or another home, has learned, in place of what this one has.
    pub(super) fn take_json(&mut self, json: &str) -> Result<(), StoredError> {
        let before = &self.memory.habits;
        let mut habits = Habits::from_json(*before.options(), json)?;
        if let Some((_, now_s)) = self.clock {
            // It may be of a machine whose clock was ahead.
            habits.no_later_than(now_s);
        }
        let places = before.persons().filter_map(|(person, _)| Some((person, before.place(person)?)));
        self.replaced = places.collect();
        self.replace(habits);
        Ok(())
    }

    /// How much is known.
    #[must_use]
    pub fn learned(&self) -> Learned {
        self.memory.habits.learned()
    }

    /// Per room of the map, how many visits ended in each part of the day.
    pub(super) fn visits(&self) -> Vec<[f64; PARTS]> {
        self.clock.map_or_else(Vec::new, |(_, now_s)| self.memory.habits.visits(now_s))
    }

    /// How often what is known was changed since the start: by an observation, by forgetting, by an import.
    #[must_use]
    pub fn taken(&self) -> u64 {
        self.taken
    }

    /// Whether anything is learned.
    #[must_use]
    pub(crate) fn learns_now(&self) -> bool {
        self.learn
    }

    /// For about how many hours it was known where a person was.
    pub(super) fn watched_h(&self, person: PersonId) -> f64 {
        self.memory.habits.watched_min(person) / 60.0
    }

    /// Persons of whom something is known, with the number of observations.
    #[must_use]
    pub fn persons(&self) -> Vec<(PersonId, f64)> {
        self.memory.habits.persons().collect()
    }

    /// What is to be written, if anything has changed since this was asked last.
    pub fn memory_if_changed(&mut self) -> Option<Memory> {
        if !std::mem::take(&mut self.changed) {
            return None;
        }
        let watched_until_s = self.clock.map_or(self.memory.watched_until_s, |(_, now_s)| now_s);
        self.memory.watched_until_s = watched_until_s;
        Some(self.memory.clone())
    }

    /// It could not be written: it is to be asked for again.
    pub fn keep_changed(&mut self) {
        self.changed = true;
    }
}

/// The room that somebody is in, if that is sure enough: one alone can be.
fn sure_of(belief: &[f64]) -> Option<usize> {
    belief.iter().position(|p| *p > SURE)
}

/// What the forecast without habits says; elsewhere comes last.
fn write_shipped(own: &Forecaster, now_s: f64, ahead_s: f64, out: &mut [f64]) {
    let Some((elsewhere, rooms)) = out.split_last_mut() else { return };
    rooms.fill(0.0);
    rooms.iter_mut().zip(own.at(now_s, ahead_s)).for_each(|(p, own)| *p = own);
    *elsewhere = own.elsewhere(now_s, ahead_s);
}

#[cfg(test)]
mod tests;
