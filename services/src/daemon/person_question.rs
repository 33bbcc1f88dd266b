//! Questions about persons: the questions on `roomcast/v1/person` and their answers. Pure.

use roomcast_core::ids::PersonId;
use roomcast_core::narration::Presence;
use serde::{Deserialize, Serialize};

use super::asked::{Answer, Question};

/// Events whose understanding the daemon remembers; the oldest goes first.
pub const UNDERSTOOD_MAX: usize = 512;

/// A question. A change has a unique name; the same name gets the same answer, without a second change.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "ask", rename_all = "kebab-case", deny_unknown_fields)]
pub enum PersonQuestion {
    /// The known persons.
    List,
    /// How the events of one narrator were understood; the daemon remembers the newest 512 events of all narrators.
    Understood {
        /// The narrator's source, as in its messages.
        source: u64,
        /// The epoch of its start.
        epoch: u64,
        /// The first sequence.
        from: u64,
    },
    /// Where a person is believed to be, and why.
    Where {
        /// A name or a number.
        who: String,
    },
    /// Whether the map has a single room of a name, before a person is corrected to be there.
    Room {
        /// The room's id, name or alias.
        room: String,
    },
    /// Forget a person: their history, their forecast, their name, and their entries in the state database.
    Forget {
        /// The question's name.
        id: String,
        /// A name or a number.
        who: String,
    },
    /// Give a person a name, or another one.
    Rename {
        /// The question's name.
        id: String,
        /// A name or a number.
        who: String,
        /// The new name.
        name: String,
    },
}

impl Question for PersonQuestion {
    fn id(&self) -> Option<&str> {
        if let Self::Forget { id, .. } | Self::Rename { id, .. } = self { Some(id) } else { None }
    }
}

/// A person, as the daemon knows them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PersonLine {
    /// The number.
    pub person: PersonId,
    /// The name, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Whether they are in the house.
    pub presence: Presence,
    /// Seconds since the presence began; `None` before the first event.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since_s: Option<f64>,
    /// Seconds since they were observed last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub silent_s: Option<f64>,
    /// Words for [`roomcast_ipc::raw::person_flags`].
    pub flags: Vec<String>,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PersonAnswer {
    /// Whether it was done.
    pub done: bool,
    /// The reason for a refusal, or the work that is left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The change failed on the disk; the question itself was right.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub failed: bool,
    /// Whether a restarted daemon has the change, which needs a state directory.
    pub kept: bool,
    /// All persons that are known now.
    pub persons: Vec<PersonLine>,
    /// The events that [`PersonQuestion::Understood`] asks for, the oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub understood: Vec<UnderstoodLine>,
    /// The answer to [`PersonQuestion::Where`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub whereabouts: Option<Whereabouts>,
}

/// Where a person is believed to be, and why.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Whereabouts {
    /// The person.
    pub person: UnderstoodPerson,
    /// The rooms and "elsewhere", the most probable first.
    pub places: Vec<PlaceLine>,
    /// The probability that no person is in the house.
    pub house_empty: f64,
    /// The probability that an unknown person is in the house.
    pub visited: f64,
    /// The same for two or more of them.
    #[serde(default)]
    pub visited_by_two: f64,
    /// The joint filter runs. It starts with the first sensor, or with the first unnamed event that two persons can have caused.
    pub is_joint: bool,
    /// The filter follows this person.
    #[serde(default)]
    pub is_followed: bool,
    /// Sensors that turn on without a person much more often than their kind.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub noisy: Vec<NoisySensor>,
}

/// A place with its probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlaceLine {
    /// The room's id, or "elsewhere".
    pub place: String,
    /// The probability that the person is there.
    pub probability: f64,
    /// The events that moved it most, the strongest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub why: Vec<WhyLine>,
}

/// One event that moved a belief.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WhyLine {
    /// `sensor`, `did`, `present`, `away`, `empty` or `count`.
    pub what: String,
    /// The sensor's kind and id, and its state.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor: Option<String>,
    /// Seconds since then.
    pub ago_s: f64,
    /// Change of the log-odds; positive speaks for the place.
    pub log_odds: f64,
    /// `weak`, `clear` or `strong`.
    pub weight: String,
    /// The probability that this person caused it.
    pub share: f64,
    /// Another person who may have caused it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub or: Option<UnderstoodPerson>,
}

/// A sensor that turns on without a person much more often than its kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NoisySensor {
    /// Its id.
    pub id: String,
    /// False alarms per day, as learned.
    pub per_day: f64,
    /// The usual number of its kind.
    pub usual_per_day: f64,
}

/// A person of an event.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnderstoodPerson {
    /// The number.
    pub person: PersonId,
    /// The name, if the person has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

/// How an event found its persons.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnderstoodLine {
    /// The event's number in its narrator's epoch.
    pub sequence: u64,
    /// `did`, `present`, `away`, `gone`, `empty` or `everybody-away`.
    pub event: String,
    /// Its persons.
    pub persons: Vec<UnderstoodPerson>,
    /// How they were found.
    pub by: By,
    /// The thing or room that the event names, as the map calls it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub place: Option<String>,
    /// The persons leave that room.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub left: bool,
    /// The presence of its persons afterwards.
    pub presence: Presence,
    /// Why the event changed no belief, or gave its persons no place.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// The nearest presence form, if the text resembles one and is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nearest_form: Option<String>,
}

impl Answer for PersonAnswer {
    fn reason(&mut self) -> &mut Option<String> {
        &mut self.reason
    }
}
