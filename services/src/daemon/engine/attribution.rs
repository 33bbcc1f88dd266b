//! From an event to its persons: the key, the name at the start of the text, or the joint filter.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use roomcast_core::grounding::Grounding;
use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::forms::{self, COUNT_MAX, Subject};
use roomcast_core::narration::{Event, Observation, Sentence, device_state, person_number};
use smallvec::SmallVec;

use super::super::person_question::{By, UNDERSTOOD_MAX, UnderstoodLine, UnderstoodPerson};
use super::super::persons::Persons;
use super::map_in_use::{MapInUse, rooms_alike};
use crate::config::May;

/// A person takes an unnamed event above this share. It is clearly above one half, so that rounding does not decide between two equal persons.
pub(super) const HALF: f64 = 0.55;

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
pub(super) enum Who {
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
pub(super) enum Weighed {
    Yes,
    /// One person at most can have caused the event, or the filter waits for the first scores of a changed map.
    NotNeeded,
    Refused(Reason),
}

/// Why an event moved no person.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr)]
pub(super) enum Reason {
    #[strum(
        serialize = "this narrator may not set presence: name it in [[daemon.narrator]] with may = [\"presence\"]; `person correct` is roomcast-person"
    )]
    MayNotPresence,
    #[strum(
        serialize = "this narrator may send presence only: give it may = [\"did\", \"presence\"] in [[daemon.narrator]]"
    )]
    MayNotDid,
    #[strum(serialize = "the text begins with a name from persons.not_persons")]
    NoPerson,
    #[strum(serialize = "the text says that nobody is there, or that a person is not")]
    Nobody,
    #[strum(serialize = "a named narrator reported this person within persons.guard_s")]
    Guarded,
    #[strum(serialize = "a later event of this person or device says otherwise")]
    Outdated,
    #[strum(serialize = "several persons can have caused it: the belief about each of them changed a little")]
    Unclear,
    #[strum(serialize = "the same text within a minute counts once")]
    Repeated,
    #[strum(serialize = "sensors hold each person in the house: the belief about each of them changed a little")]
    Held,
    #[strum(serialize = "the map lacks the room of this sensor")]
    UnknownRoom,
    #[strum(serialize = "there are too many persons for this sensor: forget persons who moved out")]
    NoSensor,
}

/// One event as the daemon understood it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Understood {
    pub(super) id: EventId,
    /// The event; a presence form counts as presence.
    pub(super) event: Event,
    pub(super) persons: SmallVec<[PersonId; 4]>,
    pub(super) by: By,
    /// Why it changed no belief.
    pub(super) reason: Option<Reason>,
}

pub(super) fn is_keyed(observation: &Observation) -> bool {
    observation.person != PersonId::SOMEBODY && !observation.by_fit || observation.name.is_some()
}

/// From an event to its persons: who is known, and what narrators may say.
#[derive(Debug, Default)]
pub(super) struct Attribution {
    pub(super) persons: Persons,
    /// The narrators of the configuration by source, and the events that each may send.
    pub(super) named: BTreeMap<u64, May>,
    /// The newest events; the oldest one goes first.
    pub(super) understood: VecDeque<Understood>,
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
        self.understood.clear();
        self.near_misses.clear();
    }

    pub(super) fn lose(&mut self, person: PersonId) {
        self.persons.remove(person);
        self.understood.retain(|own| !own.persons.contains(&person));
    }

    pub(super) fn remember(&mut self, understood: Understood) {
        if self.understood.len() == UNDERSTOOD_MAX {
            self.understood.pop_front();
        }
        self.understood.push_back(understood);
    }

    /// How the events of a narrator's start were understood, from a sequence on.
    pub(super) fn lines(
        &mut self,
        (map, grounding): (&mut MapInUse, &Grounding),
        (source, epoch, from): (u64, u64, u64),
    ) -> Vec<UnderstoodLine> {
        let Self { understood, persons, .. } = self;
        let nearest = |text: &Sentence| forms::near_miss(text.as_str());
        let line = |own: &Understood| {
            let found = own.event.sentence().and_then(|text| map.matcher.last(text.as_str()));
            let thing = found.map(|found| grounding.scored_labels()[found.label].text.clone());
            let room = own.event.room().and_then(|room| map.room(room, grounding));
            let place = thing.or_else(|| room.map(|room| grounding.partitions()[room].id.clone()));
            let why = match &own.event {
                Event::Did(_) if place.is_none() => Some("the text names no place on the map"),
                Event::Present(Some(_)) | Event::Empty(_) if place.is_none() => {
                    Some("the map has no single room of this name: give the id of a room")
                }
                _ => None,
            };
            let why = own
                .reason
                .filter(|reason| why.is_none() || own.event.sentence().is_some() || *reason != Reason::Unclear)
                .map(<&str>::from)
                .or(why);
            let person = |person: &PersonId| UnderstoodPerson {
                person: *person,
                name: persons.name_of(*person).map(str::to_owned),
            };
            UnderstoodLine {
                sequence: own.id.sequence,
                event: <&str>::from(&own.event).to_owned(),
                persons: own.persons.iter().map(person).collect(),
                by: own.by,
                left: found.is_some_and(|found| found.is_left),
                place,
                presence: own.event.person_presence(),
                why: why.map(str::to_owned),
                nearest_form: own.event.sentence().and_then(nearest).map(|form| form.sentence.to_owned()),
            }
        };
        let of_start = |own: &&Understood| own.id.start() == (source, epoch) && own.id.sequence >= from;
        understood.iter().filter(of_start).map(line).collect()
    }

    /// The event as read, and its persons. The key is final; free text sets presence in the closed forms only.
    pub(super) fn read(
        &self,
        home: (&MapInUse, &Grounding),
        observation: &Observation,
        reporter: Reporter,
    ) -> Result<(Who, Event), Reason> {
        let is_keyed = is_keyed(observation);
        let unknown = |count: u8| if is_keyed { Who::Key } else { Who::Unknown(count.clamp(1, COUNT_MAX)) };
        let Event::Did(sentence) = &observation.event else {
            // A sensor may belong to a person.
            let is_bound = is_keyed && matches!(observation.event, Event::Sensor(_));
            let has_person = is_bound || observation.event.has_person();
            let who = if has_person { unknown(observation.count) } else { Who::House };
            return reporter.may.presence.then(|| (who, observation.event.clone())).ok_or(Reason::MayNotPresence);
        };
        let text = sentence.as_str();
        if observation.may_be_form
            && let Some(read) = self.read_form(home, observation, text)
        {
            return reporter.may.presence.then_some(read).ok_or(Reason::MayNotPresence);
        }
        if !reporter.may.did {
            return Err(Reason::MayNotDid);
        }
        let who = if is_keyed {
            Who::Key
        } else if forms::says_nobody(text, |room| home.0.room(room, home.1).is_some()) {
            return Err(Reason::Nobody);
        } else if let Some((number, name)) = self.persons.at_start(text) {
            Who::Named(number, name.into())
        } else if self.persons.begins_with_no_person(text) {
            return Err(Reason::NoPerson);
        } else {
            // A text invents no persons; the key "count" may.
            let counted =
                || forms::count_of_persons(text).unwrap_or(1).min(self.persons.followed().len().clamp(1, 255) as u8);
            unknown(if observation.count > 0 { observation.count } else { counted() })
        };
        Ok((who, observation.event.clone()))
    }

    /// A text that is a presence form. A form about another person than the key is an action of the key's person.
    fn read_form(
        &self,
        (map, grounding): (&MapInUse, &Grounding),
        observation: &Observation,
        text: &str,
    ) -> Option<(Who, Event)> {
        let key = observation.name.as_deref().map_or(observation.person, |name| self.persons.number_of(name));
        let is_keyed = is_keyed(observation);
        let is_room = |room: &str| map.room(room, grounding).is_some() || rooms_alike(room, grounding).next().is_some();
        let is_name = |name: &str| match self.persons.called(name) {
            known if is_keyed => known.unwrap_or_else(|| person_number(name)) == key,
            known => known.is_some(),
        };
        let (_, subject, event) = forms::read(text, is_name, is_room)?;
        let who = match subject {
            // An empty room is about no person, whatever the key is.
            Subject::House if is_keyed && event == Event::AllAway => return None,
            Subject::House => Who::House,
            _ if is_keyed => Who::Key,
            Subject::Unknown => Who::Unknown(1),
            Subject::Named(name) => Who::Named(self.persons.called(&name)?, name.into()),
        };
        Some((who, event))
    }

    pub(super) fn note_near_miss(&mut self, observation: &Observation, event: &Event) {
        let Event::Did(text) = event else { return };
        let may_log = observation.may_be_form && self.near_misses.len() < NEAR_MISSES_LOGGED;
        if may_log
            && let Some(form) = forms::near_miss(text.as_str())
            && self.near_misses.insert(text.to_string())
        {
            let (text, nearest) = (text.as_str(), form.sentence);
            tracing::info!(text, nearest, "this text sets no presence; write the nearest form, or send presence");
        }
    }
}

/// Whether an event says that a device is off or done: the device may have done that by itself, so it says nothing about a place.
pub(super) fn is_off(event: &Event) -> bool {
    const OFF: [&str; 6] = ["off", "closed", "locked", "done", "finished", "idle"];
    let device = event.sentence().and_then(|sentence| device_state(sentence.as_str()));
    device.is_some_and(|(_, state)| OFF.contains(&state))
}
