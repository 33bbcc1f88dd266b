//! The joint filter in the daemon: who can have caused an event without a name, and where all persons are.
//!
//! It starts with the first sensor, or with the first unnamed event that two persons can have caused. Before that each event has one person, the
//! joint belief is the product of the persons' own beliefs, and their forecasters hold it.

use std::collections::BTreeMap;
use std::sync::Arc;

use roomcast_core::forecast::Forecaster;
use roomcast_core::grounding::Grounding;
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::narration::{Event, RoomName, SensorKind, SensorReport, Sentence};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::tracker::{self, Home, Movement, Observation, Options, SensorSpec, Tracker};

use super::super::persons::LATE_NS;
use super::attribution::Reason;
use super::map_in_use::room_named;
use super::robots::Robots;
use super::seconds;
use super::ways_out::ways_out;

/// Most sensors. A further one takes the place of the one that is silent longest, among those of the narrator with the most.
pub const SENSORS_MAX: usize = 256;

/// The probability that an event of a narrator is right, if the configuration knows it, and if not.
const TRUST: f64 = 0.99;
const TRUST_OTHERS: f64 = 0.7;

#[derive(Debug, Clone)]
struct Last {
    report: Arc<SensorReport>,
    person: Option<PersonId>,
    at_ns: i64,
    /// The log says that its reports disagree.
    is_warned: bool,
}

/// A device: its narrator, its kind and its id. Two narrators may use the same id, and one device may see motion and presence.
type Device = (u64, SensorKind, Box<str>);

fn device_of(source: u64, report: &SensorReport) -> Device {
    (source, report.kind, report.id.clone())
}

/// The devices that reported so far. They outlive a change of the map.
#[derive(Debug, Clone, Default)]
pub(super) struct Sensors(BTreeMap<Device, Last>);

impl Sensors {
    /// Returns the device that has to give way, if there is one too many. Fails if the device has a newer report.
    pub(super) fn note(
        &mut self,
        (source, report): (u64, &Arc<SensorReport>),
        person: Option<PersonId>,
        at_ns: i64,
    ) -> Result<Option<Device>, Reason> {
        let device = device_of(source, report);
        let (mut is_warned, mut left) = (false, None);
        match self.0.get(&device) {
            Some(last) if last.at_ns > at_ns => return Err(Reason::Outdated),
            Some(last) => {
                let device = |own: &SensorReport| {
                    (own.room.clone(), own.beyond.clone(), own.only_on, own.hold_s, own.false_alarms_per_day)
                };
                let differs = (device(&last.report), last.person) != (device(report), person);
                is_warned = last.is_warned || differs;
                if differs && !last.is_warned {
                    let (kind, id, now, before) = (report.kind, &*report.id, report, &last.report);
                    tracing::warn!(%kind, id, %now, %before, "the reports of a sensor disagree about its room, person or times: each change starts \
                         the filter again; give each device its own id");
                }
            }
            None if self.0.len() >= SENSORS_MAX => left = self.drop_one(),
            None => {}
        }
        if !self.0.contains_key(&device) {
            // Perhaps the narrator has another name now: the former state says nothing until it reports again.
            for ((_, kind, id), last) in &mut self.0 {
                let was = &last.report;
                let is_alike = (&was.room, &was.beyond, last.person) == (&report.room, &report.beyond, person);
                if (*kind, &**id) == (report.kind, &*report.id) && is_alike {
                    last.report = Arc::new(SensorReport { on: None, ..(**was).clone() });
                }
            }
        }
        self.0.insert(device, Last { report: Arc::clone(report), person, at_ns, is_warned });
        Ok(left)
    }

    /// A device reports from a room that the map lacks: its state is unknown until it reports from another one, or the map has the room.
    pub(super) fn lose(&mut self, (source, report): (u64, &SensorReport), at_ns: i64) {
        if let Some(last) = self.0.get_mut(&device_of(source, report)) {
            last.report = Arc::new(SensorReport { on: None, ..(*last.report).clone() });
            last.at_ns = last.at_ns.max(at_ns);
        }
    }

    fn drop_one(&mut self) -> Option<Device> {
        let mut devices = BTreeMap::<u64, usize>::new();
        self.0.keys().for_each(|(source, ..)| *devices.entry(*source).or_default() += 1);
        let (most, _) = devices.into_iter().max_by_key(|(_, count)| *count)?;
        let own = self.0.iter().filter(|((source, ..), _)| *source == most);
        let oldest = own.min_by_key(|(_, last)| last.at_ns)?.0.clone();
        self.0.remove(&oldest);
        Some(oldest)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether a bed of this person is occupied, or one of no person in the room.
    pub(super) fn has_on_bed(&self, person: PersonId, room: Option<&RoomName>) -> bool {
        let is_on = |last: &Last| last.report.kind == SensorKind::Bed && last.report.on == Some(true);
        let is_theirs = |last: &Last| last.person.map_or(last.report.room.as_ref() == room, |own| own == person);
        self.0.values().any(|last| is_on(last) && is_theirs(last))
    }

    pub(super) fn forget(&mut self, person: PersonId) {
        self.0.retain(|_, own| own.person != Some(person));
    }
}

/// The filter with the daemon's numbers of persons and the devices' ids.
#[derive(Debug, Clone)]
pub(super) struct Tracking {
    tracker: Tracker,
    /// The same, at the time of the last look.
    now: Tracker,
    /// By the tracker's index.
    persons: Vec<PersonId>,
    /// Nobody is known yet: the first person stands for the first one who will be.
    is_unnamed: bool,
    sensors: Vec<(Device, SensorSpec)>,
    hour: u8,
    /// Until when the hours have passed.
    passed_s: f64,
    /// The time of that look, while the filter is as it was.
    looked_ns: Option<i64>,
    /// A device or its person changed: the filter has to start again.
    is_stale: bool,
    /// The room of the last event.
    room: Option<usize>,
    /// A robot explains what the sensor of the last event saw.
    had_robot: bool,
    /// Texts of the last minute, with the time.
    said: Vec<(Text, f64)>,
    /// The last event was a repeated text.
    had_repeat: bool,
}

/// A text: its source, its person, and the number of unknown persons.
type Text = (u64, Sentence, Option<PersonId>, u8);

#[derive(Debug, Clone, Copy)]
pub(super) struct Said<'a> {
    pub(super) event: &'a Event,
    pub(super) source: u64,
    /// The person, if the event names one.
    pub(super) who: Option<PersonId>,
    /// The number of unknown persons.
    pub(super) count: u8,
    /// The persons that this number adds, if it may.
    pub(super) counted: &'a [PersonId],
    /// Per room the likelihood of an action's text; empty if it is unknown.
    pub(super) rooms: &'a [f64],
    /// The text names the place; otherwise the likelihood is the language model's.
    pub(super) is_named: bool,
    /// The room that the event names, and no other one.
    pub(super) room: Option<usize>,
    /// The person lies down, or sleeps.
    pub(super) is_lying: bool,
    /// The narrator is one that the configuration does not know.
    pub(super) is_unknown: bool,
    /// Of an event of a former run: whether a robot was in the sensor's room then.
    pub(super) robot: Option<bool>,
}

impl Tracking {
    /// A filter that believes what the forecasters believe. The `fresh` report of a device comes later. `None` if the map has too many rooms.
    pub(super) fn new(
        (map, grounding): (&SemanticMap, &Grounding),
        persons: impl Iterator<Item = PersonId>,
        (followed, is_lying): (&BTreeMap<PersonId, Forecaster>, impl Fn(PersonId) -> bool),
        (sensors, fresh): (&Sensors, Option<(u64, &SensorReport)>),
        (at_ns, local_ahead_s): (i64, f64),
    ) -> Option<Self> {
        let home = Home::of(map, grounding.partitions(), &ways_out(grounding)).ok()?;
        let at_s = seconds(at_ns);
        let hour = ((at_s + local_ahead_s).rem_euclid(86_400.0) / 3_600.0) as u8;
        let tracker = Tracker::new(home, Options::default(), at_s);
        let now = tracker.clone();
        let mut own = Self {
            tracker,
            now,
            persons: Vec::new(),
            is_unnamed: false,
            sensors: Vec::new(),
            hour,
            passed_s: at_s,
            looked_ns: None,
            is_stale: false,
            room: None,
            had_robot: false,
            said: Vec::new(),
            had_repeat: false,
        };
        for person in persons {
            own.index_of(person);
        }
        if own.persons.is_empty() {
            own.is_unnamed = own.index_of(PersonId(0)).is_some();
        }
        for (device, last) in &sensors.0 {
            // A person that is gone takes the devices along.
            if last.person.is_none_or(|person| own.persons.contains(&person)) {
                own.sensor_of((map, grounding), (device.0, &last.report), last.person);
            }
        }
        own.refill();
        for (person, forecaster) in followed {
            let Some(who) = own.persons.iter().position(|other| other == person) else { continue };
            let rooms: Vec<f64> = forecaster.at(at_s, 0.0).collect();
            if rooms.len() != own.tracker.home().rooms() {
                // The forecaster knows the map before.
                continue;
            }
            if forecaster.elsewhere(at_s, 0.0) > 0.5 {
                own.tracker.observe(at_s, &Observation::Away { who: Some(who) }, 1.0);
            } else {
                own.tracker.observe(at_s, &Observation::Action { who: Some(who), rooms: &rooms }, 1.0);
                if is_lying(*person) {
                    own.tracker.observe(at_s, &Observation::Lies { who }, 1.0);
                }
            }
        }
        let fresh = fresh.map(|(source, report)| device_of(source, report));
        for (device, last) in sensors.0.iter().filter(|(device, _)| fresh.as_ref() != Some(*device)) {
            if let Some(sensor) = own.sensors.iter().position(|(own, _)| own == device) {
                own.tracker.observe(at_s, &Observation::Sensor { sensor, on: last.report.on }, TRUST);
            }
        }
        Some(own)
    }

    /// The tracker's index of a person; a new person is added if there is room.
    pub(super) fn index_of(&mut self, person: PersonId) -> Option<usize> {
        if let Some(known) = self.persons.iter().position(|other| *other == person) {
            return Some(known);
        }
        let index = self.tracker.add_person().ok()?;
        self.persons.push(person);
        let usual = self.tracker.usual(index, self.hour);
        self.tracker.set_movement(index, &usual);
        Some(index)
    }

    /// The first person who becomes known is the one whom the sensors saw before.
    pub(super) fn admit(&mut self, person: PersonId) {
        if !std::mem::take(&mut self.is_unnamed) {
            return;
        }
        if self.persons.iter().skip(1).any(|other| *other == person) {
            self.remove(self.persons[0]);
        } else {
            self.persons[0] = person;
        }
    }

    /// The tracker's index of a device, which is added if it is new. `None` if the map lacks its room, or if the device changed.
    fn sensor_of(
        &mut self,
        (map, grounding): (&SemanticMap, &Grounding),
        (source, report): (u64, &SensorReport),
        person: Option<PersonId>,
    ) -> Option<usize> {
        let room = |name: &Option<_>| match name {
            None => Some(None),
            Some(name) => room_named(RoomName::as_str(name), map, grounding).map(Some),
        };
        let person = match person {
            Some(person) => Some(self.index_of(person)?),
            None => None,
        };
        let spec = SensorSpec {
            kind: report.kind,
            room: room(&report.room)?,
            beyond: room(&report.beyond)?,
            person,
            holds: !report.only_on,
            false_alarms_per_day: report.false_alarms_per_day,
            hold_s: report.hold_s,
        };
        if let Some(known) =
            self.sensors.iter().position(|(own, _)| (own.0, own.1, &own.2) == (source, report.kind, &report.id))
        {
            self.is_stale |= self.sensors[known].1 != spec;
            return (!self.is_stale).then_some(known);
        }
        let alike = |(own, (device, known)): (usize, &(Device, SensorSpec))| {
            let is_same = (device.1, &device.2) == (report.kind, &report.id);
            (is_same && (known.room, known.beyond, known.person) == (spec.room, spec.beyond, spec.person))
                .then_some(own)
        };
        let former: Vec<usize> = self.sensors.iter().enumerate().filter_map(alike).collect();
        for sensor in former {
            self.tracker.observe(self.tracker.now_s(), &Observation::Sensor { sensor, on: None }, TRUST);
        }
        let of_a_door_or_bed = |spec: &SensorSpec| matches!(spec.kind, SensorKind::Door | SensorKind::Bed);
        let mut refill = of_a_door_or_bed(&spec);
        let own = (device_of(source, report), spec);
        let index = match self.sensors.iter().position(|(device, _)| device.2.is_empty()) {
            Some(vacant) => {
                self.tracker.replace_sensor(vacant, spec).ok()?;
                refill |= of_a_door_or_bed(&std::mem::replace(&mut self.sensors[vacant], own).1);
                vacant
            }
            None => {
                let added = self.tracker.add_sensor(spec).ok()?;
                self.sensors.push(own);
                added
            }
        };
        if refill {
            self.refill();
        }
        Some(index)
    }

    /// A device gives way to another one: it says nothing any more, and its place has no id.
    pub(super) fn vacate(&mut self, device: &Device) {
        let Some(sensor) = self.sensors.iter().position(|(own, _)| own == device) else { return };
        self.tracker.observe(self.tracker.now_s(), &Observation::Sensor { sensor, on: None }, TRUST);
        self.sensors[sensor].0.2 = "".into();
    }

    /// Lets all persons move as is usual at a local hour.
    fn move_by(&mut self, hour: u8) {
        let was_night = Movement::is_night(self.hour);
        self.hour = hour;
        if was_night == Movement::is_night(hour) {
            return;
        }
        self.refill();
    }

    fn refill(&mut self) {
        let hour = self.hour;
        for index in 0..self.persons.len() {
            let usual = self.tracker.usual(index, hour);
            self.tracker.set_movement(index, &usual);
        }
    }

    /// Weighs an event. Returns whether it says something to the filter.
    pub(super) fn weigh(
        &mut self,
        home: (&SemanticMap, &Grounding),
        said: Said<'_>,
        (at_ns, local_ahead_s): (i64, f64),
    ) -> bool {
        let at_s = seconds(at_ns);
        self.looked_ns = None;
        self.pass(at_s, local_ahead_s);
        // Persons and devices are added at the time of the event, with and without a look before it.
        self.tracker.advance(at_s);
        if let Some(person) = said.who.filter(|_| !matches!(said.event, Event::Sensor(_))) {
            self.admit(person);
        }
        let who = match said.who {
            Some(person) => match self.index_of(person) {
                Some(index) => Some(index),
                None => return false,
            },
            None => None,
        };
        (self.room, self.had_robot) = (said.room, false);
        let trust = if said.is_unknown { TRUST_OTHERS } else { TRUST };
        let observation = match said.event {
            Event::Sensor(report) => {
                let Some(sensor) = self.sensor_of(home, (said.source, report), said.who) else { return false };
                if self.is_older(at_ns, LATE_NS) {
                    self.tracker.set_late(sensor, report.on);
                    return true;
                }
                let room = self.sensors[sensor].1.room;
                if let (Some(is_there), Some(room)) = (said.robot, room) {
                    let rooms = if is_there { &[room][..] } else { &[] };
                    self.tracker.observe(at_s, &Observation::Robot { rooms }, TRUST);
                }
                self.had_robot = room.is_some_and(|room| self.tracker.has_robot(room));
                Observation::Sensor { sensor, on: report.on }
            }
            Event::Did(_) if said.is_named || said.rooms.is_empty() => Observation::Action { who, rooms: said.rooms },
            Event::Did(_) => Observation::Text { who, rooms: said.rooms },
            Event::Present(_) => Observation::Present { who, room: said.room },
            Event::Away => Observation::Away { who },
            Event::Gone => Observation::Gone { who },
            Event::AllAway => Observation::AllAway,
            Event::Empty(_) => match said.room {
                Some(room) => Observation::Empty { room },
                None => return false,
            },
        };
        self.had_repeat = self.is_repeated(&said, at_s);
        if self.had_repeat {
            self.tracker.repeat(at_s, &observation);
            return true;
        }
        for person in said.counted {
            if self.at(*person).is_none()
                && let Some(who) = self.index_of(*person)
            {
                self.tracker.observe(at_s, &Observation::Present { who: Some(who), room: None }, trust);
            }
        }
        match (said.count, said.room) {
            // The text names the room once: it is no second observation.
            (2.., Some(room)) => {
                let persons = said.count.into();
                self.tracker.observe(at_s, &Observation::Count { room, persons }, trust);
            }
            (2.., None) if !matches!(said.event, Event::Did(_)) => {
                (0..said.count).for_each(|_| self.tracker.observe(at_s, &observation, trust));
            }
            _ => self.tracker.observe(at_s, &observation, trust),
        }
        if let Some(who) = who.filter(|_| said.is_lying) {
            self.tracker.observe(at_s, &Observation::Lies { who }, trust);
        }
        true
    }

    /// Whether a narrator sent the same text within a minute, without a presence in between. Named narrators may repeat texts of known persons.
    fn is_repeated(&mut self, said: &Said<'_>, at_s: f64) -> bool {
        const AGAIN_S: f64 = 60.0;
        const KEPT: usize = 16;
        let own = match said.event {
            Event::Sensor(_) => return false,
            Event::Did(text) if said.who.is_none() || said.is_unknown => {
                (said.source, text.clone(), said.who, said.count)
            }
            _ => {
                self.said.clear();
                return false;
            }
        };
        self.said.retain(|(_, last_s)| at_s - last_s < AGAIN_S);
        let is_known = self.said.iter().any(|(other, _)| *other == own);
        if !is_known {
            if self.said.len() == KEPT {
                self.said.remove(0);
            }
            self.said.push((own, at_s));
        }
        is_known
    }

    /// Lets persons move as is usual at each local hour up to a time. The changes end at the same steps with and without a look.
    fn pass(&mut self, at_s: f64, local_ahead_s: f64) {
        const HOUR_S: f64 = 3_600.0;
        let first = ((self.passed_s + local_ahead_s) / HOUR_S).floor() as i64 + 1;
        let last = ((at_s + local_ahead_s) / HOUR_S).floor() as i64;
        for hours in first.max(last - 47)..=last {
            self.tracker.settle(hours as f64 * HOUR_S - local_ahead_s);
            self.move_by(hours.rem_euclid(24) as u8);
        }
        self.passed_s = self.passed_s.max(at_s);
    }

    /// Looks at the filter at a time. Its own steps end at the same times with and without a look at it, so that a restart believes the same.
    pub(super) fn look(&mut self, now_ns: i64, local_ahead_s: f64) {
        if self.looked_ns == Some(now_ns) {
            return;
        }
        let now_s = seconds(now_ns);
        self.pass(now_s, local_ahead_s);
        self.tracker.settle(now_s);
        self.now.clone_from(&self.tracker);
        self.now.advance(now_s);
        self.looked_ns = Some(now_ns);
    }

    pub(super) fn robots(&mut self, robots: &Robots, at_ns: i64) {
        self.looked_ns = None;
        let rooms = robots.rooms(self.tracker.home(), BootNs(u64::try_from(at_ns).unwrap_or_default()));
        self.tracker.observe(seconds(at_ns), &Observation::Robot { rooms: &rooms }, TRUST);
    }

    pub(super) fn remove(&mut self, person: PersonId) {
        if let Some(index) = self.persons.iter().position(|other| *other == person) {
            self.is_unnamed &= index > 0;
            self.tracker.remove_person(index);
            self.now.remove_person(index);
            self.looked_ns = None;
            self.persons.remove(index);
            // The person's devices are silent now, and new ones if they report again; indices of others moved down.
            for ((_, _, id), spec) in &mut self.sensors {
                match spec.person {
                    Some(own) if own == index => *id = "".into(),
                    Some(own) if own > index => spec.person = Some(own - 1),
                    _ => {}
                }
            }
        }
    }

    /// Whether a time lies more than `late_ns` before the filter's.
    pub(super) fn is_older(&self, at_ns: i64, late_ns: i64) -> bool {
        seconds(at_ns.saturating_add(late_ns)) < self.tracker.now_s()
    }

    /// Whether a device or its person changed, so that the filter has to start again.
    pub(super) fn is_stale(&self) -> bool {
        self.is_stale
    }

    /// Whether a device has a state, so that the filter knows something also before a person is known.
    pub(super) fn is_sensed(&self) -> bool {
        (0..self.sensors.len()).any(|sensor| self.tracker.is_on(sensor).is_some())
    }

    /// Whether this number stands for the first person who will be known.
    pub(super) fn is_nobody(&self, person: PersonId) -> bool {
        self.is_unnamed && self.persons.first() == Some(&person)
    }

    pub(super) fn persons(&self) -> &[PersonId] {
        &self.persons
    }

    /// The probability that a person caused the last event.
    pub(super) fn share(&self, person: PersonId) -> f64 {
        self.at(person).map_or(0.0, |index| self.tracker.attribution(index))
    }

    /// The probability that a person is in a room; of `None`, out of the house.
    pub(super) fn probability(&self, person: PersonId, room: Option<usize>) -> f64 {
        self.at(person).map_or(0.0, |index| self.tracker.probability(index, room))
    }

    /// The probability that a person was out of the house at the last look.
    pub(super) fn out_now(&self, person: PersonId) -> Option<f64> {
        self.at(person).filter(|_| self.looked_ns.is_some()).map(|index| self.now.probability(index, None))
    }

    fn at(&self, person: PersonId) -> Option<usize> {
        self.persons.iter().position(|other| *other == person)
    }

    /// A person's forecast with the filter's belief about the present.
    pub(super) fn tell(&self, person: PersonId, own: &Forecaster, told: &mut Forecaster) {
        match self.at(person) {
            Some(index) => {
                let rooms = 0..self.now.home().rooms();
                let out = self.now.probability(index, None);
                told.track(own, rooms.map(|room| self.now.probability(index, Some(room))), out);
            }
            None => told.clone_from(own),
        }
    }

    pub(super) fn follows(&self, person: PersonId) -> bool {
        self.at(person).is_some()
    }

    /// The events that moved the belief about a person and a place most, the strongest first.
    pub(super) fn why(&self, person: PersonId, room: Option<usize>) -> impl Iterator<Item = tracker::Reason> {
        let reasons = self.at(person).map_or([None; 3], |index| self.now.why(index, room));
        reasons.into_iter().flatten()
    }

    /// The id of a device of the filter, and its kind.
    pub(super) fn device(&self, sensor: usize) -> Option<(&str, SensorKind)> {
        self.sensors.get(sensor).map(|((_, _, id), spec)| (&**id, spec.kind))
    }

    /// Devices that turn on much more often without a person than is usual, with both numbers per day.
    pub(super) fn noisy(&self) -> impl Iterator<Item = (&str, f64, f64)> {
        let noisy = self.now.noisy();
        noisy.filter_map(|(sensor, learned, usual)| Some((&*self.sensors.get(sensor)?.0.2, learned, usual)))
    }

    pub(super) fn had_repeat(&self) -> bool {
        self.had_repeat
    }

    pub(super) fn had_robot(&self) -> bool {
        self.had_robot
    }

    pub(super) fn room(&self) -> Option<usize> {
        self.room
    }

    pub(super) fn now(&self) -> &Tracker {
        &self.now
    }
}

#[cfg(test)]
mod tests {
    use std::io::{self, Write};
    use std::sync::Mutex;

    use super::*;

    #[derive(Debug, Clone, Default)]
    struct Log(Arc<Mutex<Vec<u8>>>);

    impl Write for Log {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_device_whose_reports_disagree_is_named_in_the_log_once() {
        let (log, mut sensors) = (Log::default(), Sensors::default());
        let copy = log.clone();
        let subscriber = tracing_subscriber::fmt().with_writer(move || copy.clone()).with_ansi(false).finish();
        tracing::subscriber::with_default(subscriber, || {
            for (at_ns, room) in (0..).zip(["hall", "hall", "kitchen", "hall"]) {
                let text = format!(r#"{{"sensor":"motion","id":"pir-7","room":"{room}","on":{}}}"#, at_ns % 2 == 0);
                let report = Arc::new(SensorReport::parse(&text).unwrap());
                sensors.note((1, &report), None, at_ns).unwrap();
            }
        });
        let text = String::from_utf8(log.0.lock().unwrap().clone()).unwrap();
        assert!(text.matches("disagree").count() == 1 && text.contains("pir-7"), "{text}");
    }
}
