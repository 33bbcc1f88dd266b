//! From an event to its persons: the key, the name at the start of the text, or the joint filter.

use std::collections::{BTreeMap, BTreeSet};

use roomcast_core::grounding::Grounding;
use roomcast_core::ids::PersonId;
use roomcast_core::narration::forms::{self, COUNT_MAX, Subject};
use roomcast_core::narration::{DeviceState, Event, Observation, Presence, Quota, SensorKind, same_name};
use roomcast_core::scorer::LanguageModel;

use super::super::journal::Move;
use super::super::person_question::{UnderstoodLine, UnderstoodPerson};
use super::super::persons::{LATE_NS, Persons};
use super::super::sleep::{is_bed, sleeps};
use super::super::understood::{By, Reason, Understood, UnderstoodEvents};
use super::belief::Seen;
use super::map_in_use::{MapInUse, rooms_alike};
use super::records::Attributed;
use super::tracking::Said;
use super::{Engine, seconds};
use crate::config::May;

/// A person takes an unnamed event above this share: more than one half, and no rounding.
const HALF: f64 = 0.55;

/// Most texts near a presence form that are logged, until a restart.
const NEAR_MISSES_LOGGED: usize = 16;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in super::super) struct Reporter {
    /// The configuration names narrators, and this one is not among them.
    pub(in super::super) is_unknown: bool,
    pub(in super::super) may: May,
}

/// The persons of an event before they are numbers.
#[derive(Debug, Clone, PartialEq)]
enum Who {
    /// The key of the event, which is final.
    Key,
    /// A known name at the start of the text.
    Named(PersonId, Box<str>),
    Unknown(u8),
    /// All persons, or none: the event is about the house or a room.
    House,
}

/// Whether the joint filter took an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Weighed {
    Yes,
    /// One person at most can have caused the event, or the filter waits for the first scores of a changed map.
    NotNeeded,
    Refused(Reason),
}

fn is_keyed(observation: &Observation) -> bool {
    observation.person != PersonId::SOMEBODY && !observation.by_fit || observation.name.is_some()
}

/// From an event to its persons: who is known, and what narrators may say.
#[derive(Debug, Default)]
pub(super) struct Attribution {
    pub(super) persons: Persons,
    /// The narrators of the configuration by source, and the events that each may send.
    pub(super) named: BTreeMap<u64, May>,
    understood: UnderstoodEvents,
    /// Texts that resemble a presence form, once they were logged.
    near_misses: BTreeSet<String>,
}

impl Attribution {
    /// The narrator of an event. If the configuration names narrators, any other one may only send actions.
    pub(super) fn reporter(&self, source: u64, is_unknown: bool) -> Reporter {
        let may = if self.named.is_empty() { Some(May::ALL) } else { self.named.get(&source).copied() };
        Reporter { is_unknown, may: may.filter(|_| !is_unknown).unwrap_or(May::DID) }
    }

    /// Whether the daemon learns habits of a person: not of visitors, and not of persons that only unknown narrators report.
    pub(super) fn is_learned_of(&self, person: PersonId) -> bool {
        !self.persons.is_visitor(person) && (self.named.is_empty() || self.persons.is_trusted(person))
    }

    /// Texts of others may name a forgotten person.
    pub(super) fn forget_texts(&mut self) {
        self.understood = UnderstoodEvents::default();
        self.near_misses.clear();
    }

    pub(super) fn lose(&mut self, person: PersonId) {
        self.persons.remove(person);
        self.understood.forget(person);
    }

    /// How the events of a narrator's start were understood, from a sequence on.
    pub(super) fn lines(
        &mut self,
        (map, grounding): (&mut MapInUse, &Grounding),
        (source, epoch, from): (u64, u64, u64),
    ) -> Vec<UnderstoodLine> {
        let Self { understood, persons, .. } = self;
        let line = |own: &Understood| {
            let found = own.event.sentence().and_then(|text| map.matcher.last(text.as_str()));
            let thing = found.map(|found| grounding.scored_labels()[found.label].text.clone());
            let room = own.event.room().and_then(|room| map.room(room, grounding));
            let place = thing.or_else(|| room.map(|room| grounding.partitions()[room].id.clone()));
            let why = own.reason.map(Reason::text).or(match &own.event {
                Event::Did(_) if place.is_none() => Some("the text names no place on the map"),
                Event::Present(Some(_)) | Event::Empty(_) if place.is_none() => {
                    Some("the map has no single room of this name: give the id of a room")
                }
                _ => None,
            });
            let person = |person: &PersonId| UnderstoodPerson {
                person: *person,
                name: persons.name_of(*person).map(str::to_owned),
            };
            UnderstoodLine {
                sequence: own.id.sequence,
                event: kind(&own.event).to_owned(),
                persons: own.persons().iter().map(person).collect(),
                by: own.by,
                left: found.is_some_and(|found| found.is_left),
                place,
                presence: own.event.person_presence(),
                why: why.map(str::to_owned),
                nearest_form: own.near_miss().map(str::to_owned),
            }
        };
        understood.of(source, epoch, from).map(line).collect()
    }

    /// The event as read, and its persons. The key is final; free text sets presence in the closed forms only.
    fn read(
        &self,
        home: (&MapInUse, &Grounding),
        observation: &Observation,
        reporter: Reporter,
    ) -> Result<(Who, Event), Reason> {
        let is_keyed = is_keyed(observation);
        let unknown = |count: u8| if is_keyed { Who::Key } else { Who::Unknown(count.clamp(1, COUNT_MAX)) };
        let Event::Did(sentence) = &observation.event else {
            if !reporter.may.presence {
                return Err(Reason::MayNotPresence);
            }
            let who = if observation.event.has_person() { unknown(observation.count) } else { Who::House };
            // A sensor may belong to a person.
            let who = if is_keyed && matches!(observation.event, Event::Sensor(_)) { Who::Key } else { who };
            return Ok((who, observation.event.clone()));
        };
        let text = sentence.as_str();
        if reporter.may.presence
            && observation.may_be_form
            && let Some(read) = self.read_form(home, observation, text)
        {
            return Ok(read);
        }
        if !reporter.may.did {
            return Err(Reason::MayNotDid);
        }
        let event = observation.event.clone();
        if is_keyed {
            return Ok((Who::Key, event));
        }
        if let Some((number, name)) = self.persons.at_start(text) {
            return Ok((Who::Named(number, name.into()), event));
        }
        if self.persons.begins_with_no_person(text) {
            return Err(Reason::NoPerson);
        }
        let count = if observation.count > 0 { observation.count } else { forms::count_of_persons(text).unwrap_or(1) };
        Ok((Who::Unknown(count.clamp(1, COUNT_MAX)), event))
    }

    /// A text that is a presence form. A form about another person than the key is an action of the key's person.
    fn read_form(
        &self,
        (map, grounding): (&MapInUse, &Grounding),
        observation: &Observation,
        text: &str,
    ) -> Option<(Who, Event)> {
        let key = || observation.name.as_deref().map_or(observation.person, |name| self.persons.number_of(name));
        let is_of_key = |name: &str| observation.name.as_deref().is_some_and(|own| same_name(own, name));
        let is_keyed = is_keyed(observation);
        let is_room = |room: &str| map.room(room, grounding).is_some() || rooms_alike(room, grounding).next().is_some();
        let is_name = |name: &str| is_keyed && is_of_key(name) || self.persons.called(name).is_some();
        let (subject, event) = forms::read(text, is_name, is_room)?;
        let who = match subject {
            Subject::House => Who::House,
            Subject::Unknown => Who::Unknown(1),
            Subject::Named(name) if is_keyed => {
                let is_own = is_of_key(&name) || self.persons.called(&name) == Some(key());
                return is_own.then_some((Who::Key, event));
            }
            Subject::Named(name) => Who::Named(self.persons.called(&name)?, name.into()),
        };
        match (is_keyed, &event) {
            // An empty room is about no person, whatever the key is.
            (true, Event::Empty(_)) => Some((who, event)),
            (true, Event::AllAway) => None,
            (true, _) => Some((Who::Key, event)),
            (false, _) => Some((who, event)),
        }
    }

    fn note_near_miss(&mut self, observation: &Observation, event: &Event) {
        let Event::Did(text) = event else { return };
        if !observation.may_be_form || self.near_misses.len() >= NEAR_MISSES_LOGGED {
            return;
        }
        if let Some(form) = forms::near_miss(text.as_str())
            && self.near_misses.insert(text.to_string())
        {
            tracing::info!(
                text = text.as_str(),
                nearest = form.sentence,
                "this text sets no presence; write the nearest form, or send presence"
            );
        }
    }
}

impl<M: LanguageModel> Engine<M> {
    /// Takes in an event and gives the part of each person to `enter`. Gives whether the event reads the same in any company, and otherwise its
    /// moves, so that a restart does not read it again.
    pub(super) fn attribute(
        &mut self,
        observation: Observation,
        quota: Quota,
        reporter: Reporter,
        at_ns: Option<i64>,
        mut enter: impl FnMut(&mut Self, Observation),
    ) -> (bool, Vec<Move>) {
        let mut moves = self.records.no_moves();
        let mut understood = Understood::of(&observation);
        let (who, event) =
            match self.attribution.read((&self.map, self.scoring.pipeline.grounding()), &observation, reporter) {
                Ok(read) => read,
                Err(reason) => {
                    self.attribution.understood.add(understood.without_effect(reason));
                    return (false, moves);
                }
            };
        let is_sensor = matches!(event, Event::Sensor(_));
        let is_read_alone = who == Who::Key && event == observation.event && !is_sensor;
        self.attribution.note_near_miss(&observation, &event);
        understood.event = event.clone();
        understood.by = match who {
            Who::Key => By::Key,
            Who::Named(..) => By::Name,
            Who::Unknown(_) => By::Fit,
            Who::House => By::House,
        };
        let observed = observation.event.clone();
        let own = Observation { event, ..observation };
        let weighed = self.weigh(&own, &who, reporter, at_ns);
        let is_weighed = weighed == Weighed::Yes;
        if let Event::Empty(_) = own.event {
            if self.exclude(&own, reporter, at_ns) {
                moves.push(Move::of_a_room(&own, &observed));
            } else {
                understood.reason = Some(Reason::Guarded);
            }
            self.attribution.understood.add(understood);
            return (false, moves);
        }
        let mut take = |engine: &mut Self, own: Observation| match engine.take(own, quota, (reporter, false), at_ns) {
            Ok(own) => {
                understood.add_person(own.person);
                if !is_read_alone {
                    moves.push(Move::of(&own, &observed));
                }
                enter(engine, own);
            }
            Err(reason) => understood.reason = Some(reason),
        };
        if who == Who::Key && !is_sensor {
            let person = own.name.as_deref().map_or(own.person, |name| self.attribution.persons.number_of(name));
            take(self, Observation { person, ..own });
            self.attribution.understood.add(understood);
            return (is_read_alone, moves);
        }
        let is_unnamed = is_sensor || matches!(who, Who::Unknown(_)) && !own.by_fit;
        let parts = match (weighed, &who) {
            (Weighed::Yes, Who::Unknown(count)) if is_unnamed => self.shares(&own, *count),
            (Weighed::Yes, _) if is_sensor => self.shares(&own, 1),
            (Weighed::Refused(_), _) if is_unnamed => Vec::new(),
            _ if is_sensor => Vec::new(),
            _ => self.each(own, &who, reporter),
        };
        let is_unclear = parts.is_empty() && !is_sensor && is_weighed;
        parts.into_iter().for_each(|own| take(self, own));
        if is_unclear {
            understood.reason = Some(Reason::Unclear);
        } else if let (Weighed::Refused(reason), true) = (weighed, is_unnamed) {
            understood.reason = Some(reason);
        }
        if is_sensor && is_weighed && self.belief.tracking.as_ref().is_some_and(|own| own.had_robot()) {
            moves.push(Move::of_a_robot());
        }
        let is_noted = is_sensor && !matches!(weighed, Weighed::Refused(_));
        if (is_weighed || is_noted) && moves.is_empty() {
            // A restart weighs it again.
            moves.push(Move::of_nobody());
        }
        self.attribution.understood.add(understood);
        (is_read_alone, moves)
    }

    /// The part of each person in an event that has one person at most.
    fn each(&mut self, own: Observation, who: &Who, reporter: Reporter) -> Vec<Observation> {
        match who {
            Who::Key => Vec::new(),
            Who::Named(person, name) => vec![Observation { person: *person, name: Some(name.clone()), ..own }],
            Who::House => {
                let away = Observation { event: Event::Away, ..own };
                self.attribution
                    .persons
                    .everybody()
                    .into_iter()
                    .map(|person| Observation { person, ..away.clone() })
                    .collect()
            }
            Who::Unknown(_) if own.by_fit => vec![own],
            Who::Unknown(count) => {
                let mut persons = self.attribution.persons.unnamed(reporter.is_unknown);
                persons.truncate((*count).into());
                self.note_attributed(&own, &persons);
                persons.into_iter().map(|person| Observation { person, by_fit: true, ..own.clone() }).collect()
            }
        }
    }

    fn note_attributed(&mut self, own: &Observation, persons: &[PersonId]) {
        if let [person] = *persons {
            self.records.attributed.push(Attributed { event: own.id(), person });
        }
    }

    /// How the events of a narrator's start were understood, from a sequence on.
    #[must_use]
    pub fn understood_lines(&mut self, source: u64, epoch: u64, from: u64) -> Vec<UnderstoodLine> {
        self.attribution.lines((&mut self.map, self.scoring.pipeline.grounding()), (source, epoch, from))
    }

    /// Why the filter does not take an event: its person is guarded, or a newer event counts.
    fn refusal(
        &mut self,
        own: &Observation,
        who_is: Option<PersonId>,
        reporter: Reporter,
        at_ns: i64,
    ) -> Option<Reason> {
        let is_guarded = match who_is {
            _ if !reporter.is_unknown => false,
            Some(person) => {
                self.attribution.persons.is_guarded(person, at_ns) || !self.attribution.persons.is_trusted(person)
            }
            None => self.attribution.persons.is_anybody_guarded(at_ns),
        };
        if is_guarded {
            return Some(Reason::Guarded);
        }
        match (&own.event, who_is) {
            // A device's own reports have their order.
            (Event::Sensor(report), _) => self.belief.sensors.note((own.source, report), who_is, at_ns).err(),
            (_, Some(person)) => {
                let part = Observation { person, event: own.event.clone(), name: None, ..*own };
                self.attribution.persons.is_outdated(&part, at_ns).then_some(Reason::Outdated)
            }
            // What an unknown person did long ago says nothing about the present.
            (_, None) => {
                let is_late = self.belief.tracking.as_ref().is_some_and(|own| own.is_older(at_ns, LATE_NS));
                is_late.then_some(Reason::Outdated)
            }
        }
    }

    /// Weighs an event in the joint filter, which starts if the event needs it.
    fn weigh(&mut self, own: &Observation, who: &Who, reporter: Reporter, at_ns: Option<i64>) -> Weighed {
        let Some(at_ns) = at_ns else { return Weighed::NotNeeded };
        let who_is = match who {
            Who::Key => Some(own.name.as_deref().map_or(own.person, |name| self.attribution.persons.number_of(name))),
            Who::Named(person, _) => Some(*person),
            Who::Unknown(_) | Who::House => None,
        };
        if let Some(reason) = self.refusal(own, who_is, reporter, at_ns) {
            return Weighed::Refused(reason);
        }
        // The filter knows no rooms of a changed map before its first scores.
        if self.map.next_rooms.is_some() {
            return Weighed::NotNeeded;
        }
        let count = if let Who::Unknown(count) = who { *count } else { 0 };
        let is_shared = count > 1 || count == 1 && self.attribution.persons.are_several(reporter.is_unknown);
        if self.belief.tracking.is_none() && (is_shared || !self.belief.sensors.is_empty()) {
            self.start_tracking(at_ns);
        }
        if self.belief.tracking.is_none() {
            return Weighed::NotNeeded;
        }
        let reading = if reporter.is_unknown { None } else { self.reading(&own.event) };
        let mention = own.event.sentence().and_then(|text| self.map.matcher.last(text.as_str()));
        let grounding = self.scoring.pipeline.grounding();
        let row = mention.map(|found| {
            let fits = |room| {
                let share = found.share(grounding, room);
                if found.is_left { 1.0 - share } else { share }
            };
            (0..grounding.partitions().len()).map(fits).collect::<Vec<f64>>()
        });
        let room = match &own.event {
            Event::Did(_) => row.as_deref().and_then(likeliest),
            event => event.room().and_then(|room| self.map.room(room, grounding)),
        };
        let text = own.event.sentence().map_or("", |text| text.as_str());
        let is_on_bed =
            mention.is_some_and(|found| !found.is_left && is_bed(&grounding.scored_labels()[found.label].text));
        let is_lying = sleeps(text).unwrap_or(is_on_bed);
        let rooms = row.as_deref().or(reading.as_deref()).unwrap_or_default();
        let said = Said {
            event: &own.event,
            source: own.source,
            who: who_is,
            count,
            rooms,
            is_named: row.is_some(),
            room,
            is_lying,
            is_unknown: reporter.is_unknown,
            robot: self.belief.restored_robot,
        };
        let home = (&self.map.map, grounding);
        let Some(tracking) = &mut self.belief.tracking else { return Weighed::NotNeeded };
        if count > 1 && !self.attribution.persons.has_residents() {
            // Nothing limits the number of persons.
            for person in self.attribution.persons.unnamed(reporter.is_unknown).into_iter().take(count.into()) {
                tracking.index_of(person);
            }
        }
        let is_taken = tracking.weigh(home, said, (at_ns, self.belief.local_ahead_s));
        if tracking.is_stale() {
            // A device or its person changed; the filter starts again with its newest report.
            self.start_tracking(at_ns);
            return Weighed::NotNeeded;
        }
        if is_taken {
            self.note_bed(&own.event, who_is);
        }
        match own.event {
            _ if is_taken => Weighed::Yes,
            Event::Sensor(_) => Weighed::Refused(Reason::NoSensor),
            _ => Weighed::NotNeeded,
        }
    }

    /// A bed's sensor says that its person lies or is up.
    fn note_bed(&mut self, event: &Event, who_is: Option<PersonId>) {
        let Event::Sensor(report) = event else { return };
        let (SensorKind::Bed, Some(on), Some(tracking)) = (report.kind, report.on, &self.belief.tracking) else {
            return;
        };
        let lies = |person: &PersonId| who_is.map_or_else(|| tracking.share(*person) > HALF, |own| own == *person);
        for person in tracking.persons().iter().filter(|person| lies(person)) {
            if let Some(known) = self.attribution.persons.get_mut(*person) {
                known.on_bed = on;
            }
        }
    }

    /// Weighs an event of a former run, which has stored its persons, and whether a robot explained it.
    pub(super) fn weigh_again(
        &mut self,
        observation: &Observation,
        reporter: Reporter,
        at_ns: Option<i64>,
        robot: bool,
    ) {
        if let Ok((who, event)) =
            self.attribution.read((&self.map, self.scoring.pipeline.grounding()), observation, reporter)
        {
            let own = Observation { event, name: observation.name.clone(), ..*observation };
            self.belief.restored_robot = Some(robot);
            self.weigh(&own, &who, reporter, at_ns);
            self.belief.restored_robot = None;
        }
    }

    /// The parts of an event without a name, after the filter weighed it: a person takes it with a posterior above one half. If the filter believes
    /// that a person is out, or back, the presence changes.
    fn shares(&mut self, own: &Observation, count: u8) -> Vec<Observation> {
        /// A person is out above the first, and in below the second, whatever the event says.
        const OUT: (f64, f64) = (0.9, 0.1);
        /// The device belongs to the person.
        const SURE: f64 = 0.999;
        let Some(tracking) = &self.belief.tracking else { return Vec::new() };
        let grounding = self.scoring.pipeline.grounding();
        let room = match &own.event {
            Event::Sensor(report) if report.kind == SensorKind::Door || report.on != Some(true) => None,
            Event::Sensor(report) => report.room.as_ref(),
            Event::Present(room) => room.as_ref(),
            _ => None,
        };
        let place = room.and_then(|room| self.map.room(room.as_str(), grounding));
        let counted = tracking.room().filter(|_| count > 1);
        let is_counted = |person: PersonId| counted.is_some() && tracking.probability(person, counted) > 0.5;
        let part = |person: &PersonId| {
            let person = *person;
            let out = tracking.probability(person, None);
            let presence = self.attribution.persons.get(person).map_or(Presence::Unknown, |known| known.presence);
            let is_theirs = tracking.share(person) > HALF || is_counted(person);
            let is_here = place.is_some_and(|room| tracking.probability(person, Some(room)) > 0.5);
            let event = match &own.event {
                Event::Away | Event::Gone if is_theirs && out > 0.5 => own.event.clone(),
                Event::Sensor(report) if is_theirs && report.on == Some(false) && out > 0.5 => Event::Away,
                Event::Sensor(_) if out > OUT.0 && presence == Presence::Present => Event::Away,
                Event::Did(_) | Event::Present(_) if is_theirs && out < 0.5 => own.event.clone(),
                Event::Sensor(_) if is_theirs && is_here => Event::Present(room.cloned()),
                Event::Sensor(report) if presence != Presence::Present && report.on == Some(true) => {
                    // A phone knows its person.
                    let is_bound = tracking.share(person) > SURE;
                    if is_bound && out < 0.5 || is_theirs && out < OUT.1 { Event::Present(None) } else { return None }
                }
                _ => return None,
            };
            Some(Observation { person, name: None, by_fit: true, event, ..*own })
        };
        let followed = self.attribution.persons.followed();
        let persons = tracking.persons().iter().filter(|person| followed.contains(person) || count > 1);
        let parts: Vec<Observation> = persons.filter_map(part).collect();
        let unknown = |person: &PersonId| self.attribution.persons.get(*person).is_none() && !followed.contains(person);
        let took_part = |person: &PersonId| parts.iter().any(|own| own.person == *person);
        let idle: Vec<PersonId> =
            tracking.persons().iter().copied().filter(|person| unknown(person) && !took_part(person)).collect();
        if let [only] = &parts[..]
            && only.event == own.event
        {
            let person = only.person;
            self.note_attributed(own, &[person]);
        }
        if let Some(tracking) = &mut self.belief.tracking {
            idle.into_iter().for_each(|person| tracking.remove(person));
        }
        parts
    }

    /// Takes in again the part of one person that a former run read in an event, in any company. An empty room gives nothing.
    pub(super) fn retake(&mut self, own: Observation, reporter: Reporter, at_ns: Option<i64>) -> Option<Observation> {
        if own.person == PersonId::SOMEBODY {
            self.exclude(&own, reporter, at_ns);
            return None;
        }
        self.take(own, Quota::EARLIER, (reporter, true), at_ns).ok()
    }

    /// Takes in the part of one person, unless a later event says otherwise or the person is guarded. A part that a former run took in counts
    /// in any case.
    pub(super) fn take(
        &mut self,
        observation: Observation,
        quota: Quota,
        (reporter, was_taken): (Reporter, bool),
        at_ns: Option<i64>,
    ) -> Result<Observation, Reason> {
        if !was_taken
            && reporter.is_unknown
            && self.attribution.persons.is_guarded(observation.person, at_ns.unwrap_or_default())
        {
            return Err(Reason::Guarded);
        }
        let at_ns = at_ns.map(|at_ns| self.attribution.persons.in_order(&observation, at_ns));
        let noted_ns = at_ns.unwrap_or_default();
        // After such a silence a visitor was gone, although no step noticed it.
        if self.attribution.persons.has_expired(observation.person, noted_ns) {
            self.watch();
            self.attribution.persons.remove(observation.person);
            self.drop_person(observation.person);
        }
        if !was_taken && at_ns.is_some_and(|at_ns| self.attribution.persons.is_outdated(&observation, at_ns)) {
            return Err(Reason::Outdated);
        }
        let did_ns = self.attribution.persons.get(observation.person).map_or(i64::MIN, |known| known.did_ns);
        let silent_s = seconds(noted_ns.saturating_sub(did_ns));
        if let Some(dropped) = self.attribution.persons.note(&observation, quota, noted_ns) {
            self.drop_person(dropped);
        }
        if !reporter.is_unknown {
            self.attribution.persons.guard(observation.person, noted_ns);
        }
        self.scoring.rescore(observation.person);
        if let Event::Present(Some(room)) = &observation.event {
            self.map.note_room(room.as_str(), self.scoring.pipeline.grounding());
        }
        let Some(at_ns) = at_ns else { return Ok(observation) };
        self.belief.see(Seen {
            name: observation.id(),
            person: observation.person,
            at_ns,
            event: observation.event.clone(),
            is_off: observation.by_fit && is_off(&observation.event),
            ends_window: self.scoring.pipeline.inside().options().history.is_gap(silent_s),
            is_read: !reporter.is_unknown && matches!(observation.event, Event::Did(_)),
            rooms: None,
        });
        Ok(observation)
    }

    /// Takes the event that a room is empty into the forecasts. Gives whether the daemon believes it.
    pub(super) fn exclude(&mut self, observation: &Observation, reporter: Reporter, at_ns: Option<i64>) -> bool {
        let Event::Empty(empty) = &observation.event else { return false };
        if reporter.is_unknown && self.attribution.persons.is_anybody_guarded(at_ns.unwrap_or_default()) {
            return false;
        }
        self.map.note_room(empty.as_str(), self.scoring.pipeline.grounding());
        // The belief has no rooms of a changed map yet.
        let (Some(at_ns), None) = (at_ns, &self.map.next_rooms) else { return true };
        // Earlier events come first.
        self.follow();
        if let Some(room) = self.map.room(empty.as_str(), self.scoring.pipeline.grounding()) {
            let name = observation.id();
            for (person, own) in &mut self.belief.followed {
                own.exclude(seconds(at_ns), room);
                self.home.next_is(name, *person, self.attribution.is_learned_of(*person));
                self.home.is_empty(*person, at_ns, room, own);
            }
        }
        true
    }
}

fn kind(event: &Event) -> &'static str {
    match event {
        Event::Did(_) => "did",
        Event::Present(_) => "present",
        Event::Away => "away",
        Event::Gone => "gone",
        Event::AllAway => "everybody-away",
        Event::Empty(_) => "empty",
        Event::Sensor(_) => "sensor",
    }
}

/// Whether an event says that a device is off or done: the device may have done that by itself, so it says nothing about a place.
pub(super) fn is_off(event: &Event) -> bool {
    const OFF: [&str; 6] = ["off", "closed", "locked", "done", "finished", "idle"];
    let device = event.sentence().and_then(|sentence| DeviceState::parse(sentence.as_str()));
    device.is_some_and(|device| OFF.contains(&device.state.as_str()))
}

/// The room with the largest share; `None` if all share alike.
fn likeliest(shares: &[f64]) -> Option<usize> {
    let most = (0..shares.len()).max_by(|a, b| shares[*a].total_cmp(&shares[*b]))?;
    shares.iter().any(|other| *other < shares[most]).then_some(most)
}
