//! One Bayesian filter over the joint places of all persons.
//!
//! ```text
//! p(x, t + d)  = sum over x' of p(x', t) prod over persons of P(x'_i -> x_i in d)        motion.rs
//! p(x | o)     = p(x) L(o | x) / sum over x of p(x) L(o | x)                             observe.rs, sensors.rs
//! ```
//!
//! The state x holds a place per known person and per unknown person. An observation is a likelihood over joint states, never an assignment
//! to a person, so an anonymous event that two persons can have caused leaves doubt about both. The attribution of an event is a posterior
//! that is read off afterwards. [`Tracker::forecast`] is the same filter, run ahead without observations; the daemon publishes the forecast of
//! habits that start from this belief, which is better for the place of a person (docs/tables.md).
//!
//! | part | file |
//! | --- | --- |
//! | rooms, doors, ways out | `home.rs` |
//! | how one person moves | `motion.rs` |
//! | the joint distribution | `belief.rs` |
//! | sensors and their learned rates | `sensors.rs` |
//! | the likelihood of each observation | `observe.rs` |
//! | the observations that moved the belief | `trace.rs` |
//!
//! **Inference.** The default keeps the 160 heaviest joint states of rooms, each with independent phases of its persons. [`Options::exact`] keeps
//! every joint state of rooms and phases. Neither needs random numbers: the same input gives the same belief to the bit.
//! Motion and silence alternate in steps of half a second to 32 s (Strang splitting), less than half of the time since the last observation
//! or 4 s. An event takes at most two more: the rest of the time, the last 4 s apart. Time below half a second waits for the next step.
//!
//! **Unknown persons.** A fixed number of slots stands for visitors. They come in through a way out, or a text names one. No observation turns a
//! resident into a visitor.
//!
//! **Sources.** Fortmann, Bar-Shalom and Scheffe (1983), joint probabilistic data association; Reid (1979), multiple hypothesis tracking; Oh,
//! Russell and Sastry (2009), MCMC data association; Wilson and Atkeson (2005), simultaneous tracking and activity recognition with binary
//! sensors; Ghahramani and Jordan (1997), factorial hidden Markov models; Nodelman, Shelton and Koller (2002), continuous-time Bayesian networks.
//!
//! Pure: no clock, no port. Times come in with the calls, in seconds.

mod belief;
mod home;
mod motion;
mod observe;
mod sensors;
mod trace;

#[cfg(test)]
mod properties;
#[cfg(test)]
mod situations;

pub use belief::SLOTS_MAX;
pub use home::{Home, ROOMS_MAX, RoomUse};
pub use motion::Movement;
pub use observe::{Observation, ROBOT_SILENT_S};
pub use sensors::{SensorKind, SensorSpec};
pub use trace::{Cause, Reason};

use belief::{Belief, Likelihood, SLOTS_MAX as SLOTS, State};
use motion::{Column, FINE, LONGEST, Phases, Place, STEP_S, Tables, column_of, place_of, places, room_at};
use sensors::{CLASSES, EMPTY, Sensor};
use trace::Trace;

/// Why a tracker cannot be set up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TrackerError {
    /// Too few or too many rooms.
    #[error("the map has {rooms} rooms: the tracker needs 1 to {ROOMS_MAX}; group rooms in the scene")]
    Rooms {
        /// How many.
        rooms: usize,
    },
    /// Too many persons.
    #[error("the tracker follows at most {SLOTS} persons, unknown ones included: forget persons who moved out")]
    Persons,
    /// An index that nothing has.
    #[error("the tracker has no {what} {index}")]
    Unknown {
        /// Room, person or sensor.
        what: &'static str,
        /// The index.
        index: usize,
    },
}

/// Settings of the filter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Most joint states that are kept.
    pub states: usize,
    /// States of a smaller probability are dropped.
    pub floor: f64,
    /// Each phase has states of its own. Otherwise the phases are a distribution within each state.
    pub phases_apart: bool,
    /// Slots for unknown persons.
    pub unknown: usize,
    /// Whether sensors' rates are learned.
    pub learns: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self { states: 160, floor: 3e-7, phases_apart: false, unknown: VISITORS, learns: true }
    }
}

impl Options {
    /// The exact filter: every joint state is kept. For homes of few persons, and as the reference for tests.
    #[must_use]
    pub fn exact() -> Self {
        Self { states: usize::MAX, floor: 0.0, phases_apart: true, ..Self::default() }
    }
}

/// The filter.
#[derive(Debug, Clone)]
pub struct Tracker {
    home: Home,
    options: Options,
    belief: Belief,
    tables: Tables,
    sensors: Vec<Sensor>,
    now_s: f64,
    /// Until when the sensors' rates were learned.
    learned_s: f64,
    /// Units of long steps since the last observation that moved the belief.
    quiet: usize,
    /// Seconds of silence that are not weighed yet.
    silent_s: f64,
    /// Per room: until when the robot explains what sensors see.
    robot_until_s: Vec<f64>,
    /// The likelihood of the present observation or silence.
    likelihood: Likelihood,
    /// Per column: the probability of each phase of the most visible person there.
    seen: Vec<Phases>,
    /// Per slot: rooms, then elsewhere. And before the observation.
    marginals: Vec<f64>,
    earlier: Vec<f64>,
    /// Per room: the probability of each class.
    classes: Vec<[f64; CLASSES]>,
    empty: f64,
    trace: Trace,
}

impl Tracker {
    /// A tracker without persons and sensors, at a time in seconds.
    #[must_use]
    pub fn new(home: Home, options: Options, now_s: f64) -> Self {
        let rooms = home.rooms();
        let unknown = options.unknown.min(SLOTS - 1);
        let mut own = Self {
            belief: Belief::new(unknown, options.states.max(2), options.floor.clamp(0.0, 1e-5), options.phases_apart),
            tables: Tables::new(&home),
            sensors: Vec::new(),
            now_s: if now_s.is_finite() { now_s } else { 0.0 },
            learned_s: if now_s.is_finite() { now_s } else { 0.0 },
            quiet: 0,
            silent_s: 0.0,
            robot_until_s: vec![f64::NEG_INFINITY; rooms],
            likelihood: Likelihood::default(),
            seen: vec![[0.0; 4]; 1 + rooms],
            marginals: Vec::with_capacity(SLOTS * (1 + rooms)),
            earlier: Vec::with_capacity(SLOTS * (1 + rooms)),
            classes: vec![EMPTY_ROOM; rooms],
            empty: 1.0,
            trace: Trace::new(rooms),
            options,
            home,
        };
        own.summarise();
        own
    }

    /// The home.
    #[must_use]
    pub fn home(&self) -> &Home {
        &self.home
    }

    /// The time of the belief, in seconds.
    #[must_use]
    pub fn now_s(&self) -> f64 {
        self.now_s
    }

    /// Adds a person who may be anywhere. Returns the person's index.
    ///
    /// # Errors
    /// [`TrackerError::Persons`] beyond [`SLOTS_MAX`] persons, unknown ones included.
    pub fn add_person(&mut self) -> Result<usize, TrackerError> {
        let usual = Movement::usual(&self.home, 12);
        let weights = usual.destination.iter().sum::<f64>().max(1e-9);
        let mut prior = vec![(0, [0.3, 0.0, 0.0, 0.0])];
        for (room, weight) in usual.destination.iter().enumerate() {
            let share = (weight / weights) as f32;
            prior.push((1 + room as Column, [0.1 * share, 0.6 * share, 0.0, 0.0]));
        }
        self.belief.add(&prior)?;
        self.tables.add(usual);
        self.summarise();
        Ok(self.persons() - 1)
    }

    /// Removes a person. Persons with a higher index move down by one, and the person's own sensors become silent.
    pub fn remove_person(&mut self, person: usize) {
        let Some(slot) = self.slot(person) else { return };
        self.belief.remove(slot);
        self.tables.remove(1 + person);
        for sensor in &mut self.sensors {
            match sensor.slot {
                Some(own) if own == slot => {
                    sensor.on = None;
                    sensor.slot = Some(usize::MAX);
                }
                Some(own) if own > slot && own < SLOTS => sensor.slot = Some(own - 1),
                _ => {}
            }
        }
        self.trace.forget();
        self.summarise();
    }

    /// Number of known persons.
    #[must_use]
    pub fn persons(&self) -> usize {
        self.belief.slots() - self.unknown()
    }

    fn unknown(&self) -> usize {
        self.options.unknown.min(SLOTS - 1)
    }

    /// The slot of a person.
    fn slot(&self, person: usize) -> Option<usize> {
        let slot = person.checked_add(self.unknown())?;
        (slot < self.belief.slots()).then_some(slot)
    }

    /// The usual movement of a person at a local hour. A bedroom in which only other persons have a bed sensor is seldom a destination.
    #[must_use]
    pub fn usual(&self, person: usize, hour: u8) -> Movement {
        const OTHERS: f64 = 0.1;
        let mut own = Movement::usual(&self.home, hour);
        let slot = self.slot(person);
        for (room, weight) in own.destination.iter_mut().enumerate() {
            let has_bed = |sensor: &&Sensor| sensor.spec.kind == SensorKind::Bed && sensor.spec.room == Some(room);
            let mut beds = self.sensors.iter().filter(has_bed).peekable();
            if beds.peek().is_some() && beds.all(|bed| bed.slot.is_some() && bed.slot != slot) {
                *weight *= OTHERS;
            }
        }
        own
    }

    /// Sets how a person moves from now on: habits, the hour, or a forecast.
    pub fn set_movement(&mut self, person: usize, movement: &Movement) {
        let rooms = self.home.rooms();
        let fits =
            [&movement.leave_per_s, &movement.settle, &movement.destination].iter().all(|own| own.len() == rooms);
        let sound = movement.leave_per_s.iter().chain(&movement.settle).chain(&movement.destination);
        let sound = sound.chain([&movement.outside, &movement.home_per_s]).all(|rate| rate.is_finite() && *rate >= 0.0);
        if person < self.persons() && fits && sound {
            self.tables.set(1 + person, movement);
        }
    }

    /// Fills the transition tables of all persons whose movement changed. Homes with many rooms take seconds for it, so it waits for the next step.
    fn fill(&mut self) {
        if self.tables.are_full() {
            return;
        }
        let rooms = self.home.rooms();
        let is_sensed = |room: usize| {
            let mut doors = self.sensors.iter().map(|sensor| &sensor.spec);
            doors.any(|spec| spec.kind == SensorKind::Door && spec.room == Some(room) && spec.beyond.is_none())
        };
        let leak: Vec<f64> = (0..rooms).map(|room| if is_sensed(room) { DOOR_MISSES } else { 1.0 }).collect();
        self.tables.fill(&self.home, &leak);
    }

    /// Adds a sensor. Returns its index. Call [`Tracker::set_movement`] for each person after the last front door was added.
    ///
    /// # Errors
    /// [`TrackerError::Unknown`] for a room or person that does not exist.
    pub fn add_sensor(&mut self, spec: SensorSpec) -> Result<usize, TrackerError> {
        self.put_sensor(self.sensors.len(), spec)?;
        Ok(self.sensors.len() - 1)
    }

    /// Puts another sensor in the place of one. Its learned rates are forgotten. As [`Tracker::add_sensor`] otherwise.
    ///
    /// # Errors
    /// As [`Tracker::add_sensor`], and for a sensor that does not exist.
    pub fn replace_sensor(&mut self, sensor: usize, spec: SensorSpec) -> Result<(), TrackerError> {
        if sensor >= self.sensors.len() {
            return Err(TrackerError::Unknown { what: "sensor", index: sensor });
        }
        self.put_sensor(sensor, spec)
    }

    fn put_sensor(&mut self, index: usize, spec: SensorSpec) -> Result<(), TrackerError> {
        for room in [spec.room, spec.beyond].into_iter().flatten() {
            if room >= self.home.rooms() {
                return Err(TrackerError::Unknown { what: "room", index: room });
            }
        }
        let slot = match spec.person {
            Some(person) => Some(self.slot(person).ok_or(TrackerError::Unknown { what: "person", index: person })?),
            None => None,
        };
        let is_front = |spec: &SensorSpec| spec.kind == SensorKind::Door && spec.beyond.is_none();
        let was_front = self.sensors.get(index).is_some_and(|former| is_front(&former.spec));
        match self.sensors.get_mut(index) {
            Some(former) => *former = Sensor::new(spec, slot),
            None => self.sensors.push(Sensor::new(spec, slot)),
        }
        self.trace.put_sensor(index);
        if is_front(&spec) || was_front {
            self.tables.reset(&self.home);
        }
        Ok(())
    }

    /// Whether a sensed front door is open now.
    fn is_open(&self) -> bool {
        let is_front = |sensor: &Sensor| sensor.spec.kind == SensorKind::Door && sensor.spec.beyond.is_none();
        self.sensors.iter().any(|sensor| is_front(sensor) && sensor.on != Some(false))
    }

    /// Runs the filter to a time. Each step moves all persons and weighs the sensors' silence.
    pub fn advance(&mut self, now_s: f64) {
        if !now_s.is_finite() {
            return;
        }
        self.settle(now_s);
        // A short step comes last: in a long one, silence would speak against a person who only just came.
        let rest = ((now_s - self.now_s) / STEP_S) as usize;
        let last = if rest > 0 { (rest - 1) % FINE + 1 } else { 0 };
        [rest - last, last].into_iter().filter(|units| *units > 0).for_each(|units| self.step(units));
        if self.silent_s > 0.0 {
            self.fill_silence(self.silent_s);
            self.belief.weigh(&mut self.likelihood);
            self.silent_s = 0.0;
        }
        self.summarise();
        if self.options.learns {
            self.learn_time((self.now_s - self.learned_s).min(LONGEST_S));
        }
        self.learned_s = self.now_s;
    }

    /// Takes the long steps up to a time, and leaves what is shorter to [`Tracker::advance`]. Beliefs after a later advance are the same with and
    /// without it, to the bit.
    pub fn settle(&mut self, now_s: f64) {
        let longest_s = LONGEST as f64 * STEP_S;
        if now_s.is_finite() && now_s - self.now_s > LONGEST_S {
            // After such a silence the belief no longer changes: whole steps are left out.
            self.now_s += ((now_s - self.now_s - LONGEST_S) / longest_s).ceil() * longest_s;
        }
        if now_s.is_finite() && now_s - self.now_s >= STEP_S {
            // A copy of this filter that goes on from here shares the tables.
            self.fill();
        }
        loop {
            let next = (self.quiet / 4).next_power_of_two().clamp(FINE, LONGEST);
            if !now_s.is_finite() || now_s - self.now_s < next as f64 * STEP_S {
                break;
            }
            self.step(next);
            self.quiet += next;
        }
    }

    /// One step of so many units.
    fn step(&mut self, units: usize) {
        self.release();
        self.fill();
        let half_s = 0.5 * units as f64 * STEP_S;
        self.fill_silence(self.silent_s + half_s);
        let set = usize::from(self.is_open());
        let (tables, unknown) = (&self.tables, self.unknown());
        self.belief.step(&mut self.likelihood, units, |slot| tables.of(number(slot, unknown), set));
        self.silent_s = half_s;
        self.now_s += units as f64 * STEP_S;
    }

    /// Sensors that never report "off" are off after their hold time.
    fn release(&mut self) {
        for sensor in &mut self.sensors {
            if !sensor.spec.holds && sensor.on == Some(true) && self.now_s - sensor.since_s >= sensor.hold_s() {
                sensor.on = Some(false);
                sensor.since_s = self.now_s;
            }
        }
    }

    /// The likelihood of silence for some seconds.
    fn fill_silence(&mut self, seconds: f64) {
        for sensor in self.sensors.iter_mut().filter(|sensor| sensor.dead > 0.0) {
            sensor.note_inside(sensor.slot.map_or(0.0, |slot| self.belief.inside(slot)));
        }
        self.likelihood.clear(1 + self.home.rooms(), self.belief.slots());
        for sensor in &self.sensors {
            let (Some(on), false) = (sensor.evidence(self.now_s), sensor.spec.kind == SensorKind::Door) else {
                continue;
            };
            let robot = sensor.spec.room.is_some_and(|room| self.has_robot(room));
            let flips = sensor.silence(on, robot);
            let silent = flips.map(|flip| ((flips[EMPTY] - flip) * seconds).clamp(-30.0, 30.0).exp());
            sensor.weigh(silent, &mut self.likelihood);
        }
    }

    /// The likelihood of what sensors of some kinds show now. `left_s`: a person may have left a room unseen within this time, in seconds.
    fn fill_states(&mut self, left_s: f64, counts: impl Fn(SensorKind) -> bool) {
        self.likelihood.clear(1 + self.home.rooms(), self.belief.slots());
        for sensor in &self.sensors {
            let robot = sensor.sees_robots() && sensor.spec.room.is_some_and(|room| self.has_robot(room));
            let is_left_out = robot || sensor.spec.kind == SensorKind::Door || !counts(sensor.spec.kind);
            let (Some(on), false) = (sensor.evidence(self.now_s), is_left_out) else { continue };
            let mut shown = sensor.shows(on);
            if on {
                let least = shown[1..].iter().fold(1.0, |least: f64, own| least.min(*own));
                shown[EMPTY] = shown[EMPTY].max((sensor.hold_s() / left_s).min(least));
            }
            sensor.weigh(shown, &mut self.likelihood);
        }
    }

    fn learn_time(&mut self, seconds: f64) {
        for number in 0..self.sensors.len() {
            let Some(on) = self.sensors[number].evidence(self.now_s) else { continue };
            let Some(classes) = self.classes_of(number) else { continue };
            self.sensors[number].learn_time(on, classes, seconds);
        }
    }

    /// The probability of each class for a sensor's room. `None` if it has no room, or if the robot is there.
    fn classes_of(&self, number: usize) -> Option<[f64; CLASSES]> {
        let spec = &self.sensors[number].spec;
        let room = spec.room.filter(|_| spec.kind != SensorKind::Door && spec.person.is_none())?;
        (!self.has_robot(room)).then(|| self.classes[room])
    }

    /// Refills the marginals from the joint states.
    fn summarise(&mut self) {
        let rooms = self.home.rooms();
        self.empty = 0.0;
        self.marginals.clear();
        self.marginals.resize(self.belief.slots() * (rooms + 1), 0.0);
        self.seen.fill([0.0; 4]);
        for state in self.belief.states() {
            let weight = state.weight as f32;
            let (any, mut several) = state.rooms();
            if any == 0 {
                self.empty += state.weight;
            }
            for ((column, phases), own) in state.slots().zip(self.marginals.chunks_exact_mut(rooms + 1)) {
                let room = room_at(column);
                own[room.unwrap_or(rooms)] += state.weight;
                if room.is_some_and(|room| several >> room & 1 == 0) {
                    add(&mut self.seen[usize::from(column)], weight, phases);
                }
            }
            while several != 0 {
                let column = several.trailing_zeros() as Column + 1;
                add(&mut self.seen[usize::from(column)], weight, &state.seen(column));
                several &= several - 1;
            }
        }
        for (own, seen) in self.classes.iter_mut().zip(&self.seen[1..]) {
            let [moving, settled, still, _] = seen.map(|p| f64::from(p.max(0.0)));
            *own = [(1.0 - moving - settled - still).max(0.0), still, settled, moving];
        }
    }

    /// Takes an observation in. `trust` is the narrator's: the probability that the observation is right. Sensors have their own model.
    ///
    /// Times that go backwards count as now. Persons, rooms and sensors that do not exist are ignored.
    pub fn observe(&mut self, at_s: f64, observation: &Observation<'_>, trust: f64) {
        self.advance(at_s);
        self.trace.attribute([0.0; SLOTS]);
        self.earlier.clone_from(&self.marginals);
        let trust = if trust.is_finite() { trust.clamp(0.05, 0.999) } else { 0.5 };
        let Some(cause) = observe::weigh(self, observation, trust) else { return };
        self.note_dead(cause);
        self.quiet = 0;
        let shares = observe::attribute(self, observation);
        self.trace.record(self.now_s, cause, shares, (&self.earlier, &self.marginals));
    }

    /// What speaks for a person in the house speaks for a person with an empty phone, too.
    fn note_dead(&mut self, cause: Cause) {
        let columns = self.home.rooms() + 1;
        for (number, sensor) in self.sensors.iter_mut().enumerate().filter(|(_, sensor)| sensor.dead > 0.0) {
            let is_cause = matches!(cause, Cause::Sensor { sensor, .. } if sensor == number);
            let (Some(slot), false) = (sensor.slot, is_cause) else { continue };
            let inside = |list: &[f64]| 1.0 - list.get(slot * columns + columns - 1).copied().unwrap_or(1.0);
            let (before, after) = (inside(&self.earlier), inside(&self.marginals));
            sensor.dead = (sensor.dead * after / before.max(1e-9)).clamp(1e-9, after.max(1e-9));
        }
    }

    /// A text that was said a moment ago says nothing new: its attribution is read off, and the belief stays.
    pub fn repeat(&mut self, at_s: f64, observation: &Observation<'_>) {
        self.advance(at_s);
        self.earlier.clone_from(&self.marginals);
        self.trace.attribute(observe::attribute(self, observation));
    }

    /// Sets a sensor's state by a report of a time long before the belief's: it holds from now on, but its flip says nothing about the present.
    pub fn set_late(&mut self, sensor: usize, on: Option<bool>) {
        self.trace.attribute([0.0; SLOTS]);
        if let Some(own) = self.sensors.get_mut(sensor) {
            // A device without "off" has turned off since then.
            own.on = on.map(|on| on && own.spec.holds);
            own.since_s = self.now_s;
            let inside = own.slot.map_or(0.0, |slot| self.belief.inside(slot));
            own.note_phone(own.on == Some(true), inside);
        }
    }

    /// Probability that a person is in a room; of `None`, elsewhere.
    #[must_use]
    pub fn probability(&self, person: usize, room: Option<usize>) -> f64 {
        let rooms = self.home.rooms();
        let Some(slot) = self.slot(person) else { return 0.0 };
        self.marginals.get(slot * (rooms + 1) + room.unwrap_or(rooms).min(rooms)).copied().unwrap_or(0.0)
    }

    /// Whether a robot explains what sensors see in a room.
    #[must_use]
    pub fn has_robot(&self, room: usize) -> bool {
        self.robot_until_s.get(room).is_some_and(|until_s| self.now_s < *until_s)
    }

    /// Probability that at least one person, known or unknown, is in a room.
    #[must_use]
    pub fn occupied(&self, room: usize) -> f64 {
        self.classes.get(room).map_or(0.0, |own| 1.0 - own[0])
    }

    /// Probability that no person is in the house.
    #[must_use]
    pub fn house_empty(&self) -> f64 {
        self.empty
    }

    /// Probability that at least so many unknown persons are in the house.
    #[must_use]
    pub fn visitors(&self, at_least: usize) -> f64 {
        let visitors = |state: &State<'_>| state.slots().take(self.unknown()).filter(|(column, _)| *column > 0).count();
        let states = self.belief.states().filter(|state| visitors(state) >= at_least);
        states.fold(0.0, |sum, state| sum + state.weight)
    }

    /// Per horizon, which rise: the probability of each room that no unknown person is there, then of the house. Row by row into `free`, which is
    /// left empty if there hardly is a visitor.
    pub fn without_visitors(&self, horizons_s: &[f32], free: &mut Vec<f64>) {
        const FEW: f64 = 1e-3;
        free.clear();
        if self.visitors(1) < FEW || !self.tables.are_full() {
            return;
        }
        let columns = self.home.rooms() + 1;
        free.resize(horizons_s.len() * columns, 1.0);
        let tables = self.tables.of(0, usize::from(self.is_open()));
        let (mut own, mut spare) = (Vec::new(), vec![0.0; places(self.home.rooms())]);
        for slot in 0..self.unknown() {
            own.clear();
            own.resize(spare.len(), 0.0);
            for state in self.belief.states() {
                let Some((column, phases)) = state.slots().nth(slot) else { continue };
                for (phase, share) in phases.iter().enumerate().filter(|(_, share)| **share > 0.0) {
                    own[usize::from(place_of(column, phase))] += state.weight * f64::from(*share);
                }
            }
            let mut from_s = 0.0;
            for (row, until_s) in free.chunks_exact_mut(columns).zip(horizons_s) {
                tables.run(f64::from(until_s - from_s), &mut own, &mut spare);
                from_s = *until_s;
                let (out, rooms) = own.split_at(2);
                row.iter_mut()
                    .zip(rooms.chunks_exact(3))
                    .for_each(|(row, phases)| *row *= 1.0 - phases.iter().sum::<f64>());
                row[columns - 1] *= out.iter().sum::<f64>();
            }
        }
        free.iter_mut().for_each(|own| *own = own.clamp(0.0, 1.0));
    }

    /// Attribution of the last observation: the probability that a person caused it.
    #[must_use]
    pub fn attribution(&self, person: usize) -> f64 {
        self.slot(person).map_or(0.0, |slot| self.trace.last_share(slot))
    }

    /// The three observations that moved the belief about a person and a place most, the strongest first.
    #[must_use]
    pub fn why(&self, person: usize, room: Option<usize>) -> [Option<Reason>; 3] {
        let rooms = self.home.rooms();
        let Some(slot) = self.slot(person) else { return [None; 3] };
        let held = |sensor: usize| self.sensors[sensor].on == Some(true);
        self.trace.strongest((slot, room.unwrap_or(rooms).min(rooms)), self.now_s, self.unknown(), held)
    }

    /// Sensors with learned false alarms above five times the usual and three a day. Both numbers are per day.
    pub fn noisy(&self) -> impl Iterator<Item = (usize, f64, f64)> {
        self.sensors.iter().enumerate().filter_map(|(number, sensor)| {
            let (learned, usual) = sensor.false_alarms_per_day();
            (learned > 3.0 && learned > 5.0 * usual).then_some((number, learned, usual))
        })
    }

    /// Whether a sensor is on; `None` before its first report.
    #[must_use]
    pub fn is_on(&self, sensor: usize) -> Option<bool> {
        self.sensors.get(sensor)?.on
    }

    /// The filter run ahead without observations: per person the probability of each room, then of elsewhere; and per room, that at least one
    /// person is there. Given the present joint state, persons move independently.
    #[must_use]
    pub fn forecast(&self, horizon_s: f64) -> Forecast {
        if !self.tables.are_full() {
            let mut own = self.clone();
            own.fill();
            return own.forecast(horizon_s);
        }
        let (rooms, slots) = (self.home.rooms(), self.belief.slots());
        let (places, columns) = (places(rooms), rooms + 1);
        let set = usize::from(self.is_open());
        let (mut own, mut spare) = (Vec::new(), vec![0.0; places]);
        // Per slot, place and column.
        let mut later = vec![0.0; slots * places * columns];
        let mut run = |slot: usize, place: usize, ahead: &mut [f64]| {
            own.clear();
            own.resize(places, 0.0);
            own[place] = 1.0;
            self.tables.of(number(slot, self.unknown()), set).run(horizon_s.min(HORIZON_S), &mut own, &mut spare);
            own.iter().enumerate().for_each(|(to, p)| ahead[usize::from(column_of(to as Place))] += p);
        };
        let mut forecast = Forecast {
            rooms,
            persons: vec![0.0; (slots - self.unknown()) * columns],
            occupied: vec![0.0; rooms],
            empty: 0.0,
        };
        let mut ahead = vec![0.0; columns];
        let mut free = vec![1.0; columns];
        for state in self.belief.states() {
            free.fill(1.0);
            let mut out = 1.0;
            for (slot, (column, phases)) in state.slots().enumerate() {
                ahead.fill(0.0);
                let all: f32 = phases.iter().sum();
                for (phase, share) in phases.iter().enumerate().filter(|(_, share)| **share > 0.0) {
                    let from = usize::from(place_of(column, phase));
                    let later = &mut later[(slot * places + from) * columns..][..columns];
                    if later.iter().all(|p| *p == 0.0) {
                        run(slot, from, later);
                    }
                    ahead.iter_mut().zip(later).for_each(|(own, p)| *own += f64::from(share / all) * *p);
                }
                free.iter_mut().zip(&ahead).for_each(|(free, p)| *free *= 1.0 - p);
                out *= ahead[0];
                if let Some(person) = slot.checked_sub(self.unknown()) {
                    let own = &mut forecast.persons[person * columns..][..columns];
                    own.iter_mut().zip(&ahead).for_each(|(own, p)| *own += state.weight * p);
                }
            }
            forecast.occupied.iter_mut().zip(&free[1..]).for_each(|(own, free)| *own += state.weight * (1.0 - free));
            forecast.empty += state.weight * out;
        }
        forecast
    }
}

/// The number of a slot's tables: 0 of unknown persons, then of each known person.
fn number(slot: usize, unknown: usize) -> usize {
    (slot + 1).saturating_sub(unknown)
}

fn add(to: &mut Phases, weight: f32, phases: &Phases) {
    to.iter_mut().zip(phases).for_each(|(to, p)| *to += weight * p);
}

/// The classes of an empty room.
const EMPTY_ROOM: [f64; CLASSES] = [1.0, 0.0, 0.0, 0.0];

/// Share of the people who pass a shut door without its sensor seeing it.
const DOOR_MISSES: f64 = 0.05;

/// Visitors are counted up to this number.
pub const VISITORS: usize = 2;

/// The house counts as empty from this probability on.
pub const SURELY_EMPTY: f64 = 0.9;

/// Longest silence that is played in steps, in seconds.
const LONGEST_S: f64 = 2.0 * 86_400.0;

/// Farther ahead the forecast no longer changes, in seconds.
const HORIZON_S: f64 = 86_400.0;

/// Where everybody will be.
#[derive(Debug, Clone, PartialEq)]
pub struct Forecast {
    rooms: usize,
    /// Per person: elsewhere, then each room.
    persons: Vec<f64>,
    occupied: Vec<f64>,
    empty: f64,
}

impl Forecast {
    /// Probability that a person is in a room then; of `None`, elsewhere.
    #[must_use]
    pub fn probability(&self, person: usize, room: Option<usize>) -> f64 {
        let column = room.map_or(0, |room| room + 1);
        let own = (column <= self.rooms).then_some(person * (self.rooms + 1) + column);
        own.and_then(|own| self.persons.get(own)).copied().unwrap_or(0.0)
    }

    /// Probability that at least one person is in a room then.
    #[must_use]
    pub fn occupied(&self, room: usize) -> f64 {
        self.occupied.get(room).copied().unwrap_or(0.0)
    }

    /// Probability that no person is in the house then.
    #[must_use]
    pub fn house_empty(&self) -> f64 {
        self.empty
    }
}
