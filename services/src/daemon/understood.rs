//! How the daemon understood the newest events: the person, the place, the presence, and why an event changed no belief. Narrators ask for it.

use std::collections::VecDeque;

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::forms::{COUNT_MAX, near_miss};
use roomcast_core::narration::{Event, Observation};

/// Events that are remembered; the oldest goes first.
pub const UNDERSTOOD_MAX: usize = 512;

/// Why an event moved no person.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reason {
    /// The narrator may not send presence.
    MayNotPresence,
    /// The narrator may send presence only.
    MayNotDid,
    /// The text begins with a name that is no person's.
    NoPerson,
    /// A named narrator reported this person within `guard_s`.
    Guarded,
    /// A later event of the person or device says otherwise.
    Outdated,
    /// The filter weighed it, and no person has caused it with more than one half.
    Unclear,
    /// The map lacks the sensor's room, or there are too many sensors.
    NoSensor,
}

impl Reason {
    pub(super) fn text(self) -> &'static str {
        match self {
            Self::MayNotPresence => "this narrator may not set presence (daemon.narrator.may)",
            Self::MayNotDid => "this narrator may send presence only (daemon.narrator.may)",
            Self::NoPerson => "the text begins with a name from persons.not_persons",
            Self::Guarded => "a named narrator reported this person within persons.guard_s",
            Self::Outdated => "a later event of this person or device says otherwise",
            Self::Unclear => "several persons can have caused it: the belief about each of them changed a little",
            Self::NoSensor => "the map lacks the room of this sensor, or there are too many sensors",
        }
    }
}

/// How an event found its persons.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum By {
    /// The key of the event.
    #[default]
    Key,
    /// A known name at the start of the text.
    Name,
    /// The joint filter found them, or the home has one person.
    Fit,
    /// The event is about the house or a room.
    House,
}

/// One event as the daemon understood it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Understood {
    pub(super) id: EventId,
    /// The event; a presence form counts as presence.
    pub(super) event: Event,
    persons: [PersonId; COUNT_MAX as usize],
    count: u8,
    pub(super) by: By,
    /// Why it changed no belief.
    pub(super) reason: Option<Reason>,
}

impl Understood {
    pub(super) fn of(observation: &Observation) -> Self {
        Self {
            id: observation.id(),
            event: observation.event.clone(),
            persons: [PersonId(0); COUNT_MAX as usize],
            count: 0,
            by: By::Key,
            reason: None,
        }
    }

    /// Adds a person; an event about everybody keeps the first ones.
    pub(super) fn add_person(&mut self, person: PersonId) {
        if let Some(place) = self.persons.get_mut(usize::from(self.count)) {
            *place = person;
            self.count += 1;
        }
    }

    /// The same event, which changed no belief.
    pub(super) fn without_effect(self, reason: Reason) -> Self {
        Self { reason: Some(reason), ..self }
    }

    pub(super) fn persons(&self) -> &[PersonId] {
        &self.persons[..usize::from(self.count)]
    }

    /// The nearest presence form of a text that is none.
    pub(super) fn near_miss(&self) -> Option<&'static str> {
        self.event.sentence().and_then(|text| near_miss(text.as_str())).map(|form| form.sentence)
    }
}

#[derive(Debug, Clone, Default)]
pub(super) struct UnderstoodEvents(VecDeque<Understood>);

impl UnderstoodEvents {
    pub(super) fn add(&mut self, understood: Understood) {
        if self.0.len() == UNDERSTOOD_MAX {
            self.0.pop_front();
        }
        self.0.push_back(understood);
    }

    /// The events of a narrator's start from a sequence on, the oldest first.
    pub(super) fn of(&self, source: u64, epoch: u64, from: u64) -> impl Iterator<Item = &Understood> {
        self.0.iter().filter(move |own| own.id.start() == (source, epoch) && own.id.sequence >= from)
    }

    pub(super) fn forget(&mut self, person: PersonId) {
        self.0.retain(|own| !own.persons().contains(&person));
    }
}
