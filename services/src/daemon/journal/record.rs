//! The records that the daemon writes down.

use roomcast_core::forecast::PACES;
use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::{Event, Observation, same_name};
use roomcast_ipc::Sender as Port;
use serde::{Deserialize, Serialize};

/// One thing to write down.
#[derive(Debug, Clone, PartialEq)]
pub enum Record {
    /// An observation as it came.
    Event {
        /// The observation.
        observation: Observation,
        /// The machine has not been started since.
        is_of_this_boot: bool,
    },
    /// An accepted observation without its text.
    Taken(EventId),
    /// The port that speaks for a start of a source, by the source's number and epoch.
    Port {
        /// Source and epoch.
        start: (u64, u64),
        /// The port.
        port: Port,
    },
    /// The person that an observation was attributed to.
    Found {
        /// The observation.
        of: EventId,
        /// The person.
        person: PersonId,
    },
    /// The model's expectation of a person after an observation.
    Expected {
        /// The observation.
        of: EventId,
        /// The person.
        person: PersonId,
        /// The model's probabilities.
        expectation: Expectation,
    },
    /// The persons that an observation moved.
    Moved(Moved),
    /// A visitor is gone by silence.
    Gone {
        /// The visitor.
        person: PersonId,
        /// The newest observation that had entered then. `None` if it is the newest of the database.
        after: Option<EventId>,
    },
}

impl Record {
    /// About how many bytes the record takes.
    pub(super) fn bytes(&self) -> u64 {
        let text = |event: &Event| match event {
            Event::Did(sentence) => sentence.as_str().len(),
            Event::Sensor(_) => SENSOR_BYTES,
            presence => presence.room().map_or(0, str::len),
        };
        let bytes = match self {
            Self::Event { observation, .. } => EVENT_BYTES + text(&observation.event),
            Self::Moved(moved) => {
                moved.moves.iter().map(|own| PART_BYTES + own.event.as_ref().map_or(0, text)).sum::<usize>()
            }
            Self::Expected { expectation, .. } => PART_BYTES + 4 * expectation.probability.len(),
            Self::Taken(_) | Self::Port { .. } => PART_BYTES,
            Self::Found { .. } | Self::Gone { .. } => 0,
        };
        bytes as u64
    }
}

/// Bytes of an event's row next to its text, about, and of a row that belongs to an event.
pub(super) const EVENT_BYTES: usize = 160;
pub(super) const PART_BYTES: usize = 48;
/// Bytes of a sensor's report, about.
const SENSOR_BYTES: usize = 64;

impl From<&Observation> for Record {
    fn from(observation: &Observation) -> Self {
        Self::Event { observation: observation.clone(), is_of_this_boot: true }
    }
}

impl From<&Outcome<'_>> for Record {
    fn from(outcome: &Outcome<'_>) -> Self {
        let Outcome { event: of, person, by_fit, map, probability } = *outcome;
        if by_fit {
            return Self::Found { of, person };
        }
        let probability = probability.iter().map(|probability| *probability as f32).collect();
        Self::Expected { of, person, expectation: Expectation { map, paces: None, probability } }
    }
}

impl From<&Moved> for Record {
    fn from(moved: &Moved) -> Self {
        Self::Moved(moved.clone())
    }
}

/// The model's expectation of a person, or the belief about their place when the map changed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Expectation {
    /// The first bytes of the fingerprint of the map that has the rooms.
    pub map: u64,
    /// For a belief, how long the person had been at their last action, and so on ([`Forecaster::paces`]); `None` for an expectation.
    ///
    /// [`Forecaster::paces`]: roomcast_core::forecast::Forecaster::paces
    pub paces: Option<[f32; PACES]>,
    /// Per room the probability that the person is there next, or was there.
    pub probability: Vec<f32>,
}

/// The part of one person in an observation that moved them.
#[derive(Debug, Clone, PartialEq)]
pub struct Move {
    /// The person; [`PersonId::SOMEBODY`] if the event is an empty room.
    pub person: PersonId,
    /// The name that the narrator used; `None` for a number, a fit or a group.
    pub name: Option<Box<str>>,
    /// Whether they were found by fit.
    pub by_fit: bool,
    /// The event of the person; `None` if it is the event as it came.
    pub event: Option<Event>,
}

impl Move {
    /// The part of a person in an event that came as `observed`.
    #[must_use]
    pub fn of(own: &Observation, observed: &Event) -> Self {
        let event = Some(&own.event).filter(|event| *event != observed).cloned();
        Self { person: own.person, name: own.name.clone(), by_fit: own.by_fit, event }
    }

    /// The part of no person, in an event that the joint filter weighed.
    #[must_use]
    pub(in crate::daemon) fn of_nobody() -> Self {
        Self { person: PersonId::SOMEBODY, name: None, by_fit: true, event: None }
    }

    /// The part of a robot: it explains what the sensor saw.
    #[must_use]
    pub(in crate::daemon) fn of_a_robot() -> Self {
        Self { event: Some(Event::Present(None)), ..Self::of_nobody() }
    }

    /// Whether it is the part of a robot.
    #[must_use]
    pub(in crate::daemon) fn is_of_a_robot(&self) -> bool {
        *self == Self::of_a_robot()
    }

    /// The part of an event that is an empty room.
    #[must_use]
    pub(in crate::daemon) fn of_a_room(own: &Observation, observed: &Event) -> Self {
        Self { person: PersonId::SOMEBODY, name: None, by_fit: false, ..Self::of(own, observed) }
    }

    /// The observation of the person, made of the one that moved them.
    #[must_use]
    pub fn apply(self, observed: &Observation) -> Observation {
        let event = self.event.unwrap_or_else(|| observed.event.clone());
        Observation { person: self.person, name: self.name, by_fit: self.by_fit, event, ..*observed }
    }
}

/// The persons that an observation moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Moved {
    /// The event.
    pub observation: EventId,
    /// The persons, in the order in which they were.
    pub moves: Vec<Move>,
}

/// The outcome of an observation: its person, and the model's expectation of that person after it.
#[derive(Debug, Clone, Copy)]
pub struct Outcome<'a> {
    /// The event.
    pub event: EventId,
    /// Its person.
    pub person: PersonId,
    /// Whether the narrator named no person, and the daemon found this one by fit.
    pub by_fit: bool,
    /// The first bytes of the map's fingerprint.
    pub map: u64,
    /// Per room the probability that the person is there next; empty if there is no score.
    pub probability: &'a [f64],
}

/// Earlier names that a person keeps, the newest.
const FORMER_MAX: usize = 8;

/// A person with a name that the home gave.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeptPerson {
    /// The number.
    pub number: PersonId,
    /// The name; narrators may use it in any case.
    pub name: String,
    /// Whether they live here; `None` if the configuration decides.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resident: Option<bool>,
    /// Earlier names, oldest first: narrators that use them mean this person.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub former: Vec<String>,
}

impl KeptPerson {
    /// The names that mean this person, the newest first.
    pub(in crate::daemon) fn names(&self) -> impl Iterator<Item = &str> {
        std::iter::once(self.name.as_str()).chain(self.former.iter().rev().map(String::as_str))
    }

    /// The same person with another name.
    pub(in crate::daemon) fn renamed(&self, name: &str) -> Self {
        let mut former: Vec<String> = self.former.iter().chain([&self.name]).cloned().collect();
        former.retain(|former| !same_name(former, name));
        former.drain(..former.len().saturating_sub(FORMER_MAX));
        Self { name: name.to_owned(), former, ..self.clone() }
    }
}
