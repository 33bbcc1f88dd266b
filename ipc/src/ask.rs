//! Questions to the daemon, and its answers as types: [`Domain::persons`], [`Domain::moment`], [`Domain::habits`], [`Domain::change_map`]
//! and [`Narrator::understood`](crate::Narrator::understood).
//!
//! The answers are JSON. A reader passes over unknown keys, so that answers can grow.

use std::time::Duration;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use crate::{Domain, IpcError, Node, question, sequence};

/// The name of the participant that asks.
const ASKER: &str = "question";

/// A person that the daemon knows.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct KnownPerson {
    /// The number.
    pub person: u32,
    /// The name, if the person has one.
    pub name: Option<String>,
    /// `unknown`, `present`, `away` or `gone`.
    pub presence: String,
    /// Seconds since the presence began.
    pub since_s: Option<f64>,
    /// Seconds since the last event of the person.
    pub silent_s: Option<f64>,
    /// Words for [`raw::person_flags`](crate::raw::person_flags).
    #[serde(default)]
    pub flags: Vec<String>,
}

/// A person of an event.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct UnderstoodPerson {
    /// The number.
    pub person: u32,
    /// The name, if the person has one.
    pub name: Option<String>,
}

/// An event as the daemon understood it.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct Understood {
    /// The event's number.
    pub sequence: u64,
    /// `did`, `present`, `away`, `gone`, `empty` or `everybody-away`.
    pub event: String,
    /// The persons of the event.
    #[serde(default)]
    pub persons: Vec<UnderstoodPerson>,
    /// How the daemon found the persons: `key`, `name`, `fit` or `house`.
    pub by: String,
    /// The thing or room that the event names, as the map calls it.
    pub place: Option<String>,
    /// The presence of the persons afterwards.
    pub presence: String,
    /// The reason, if the event changed no belief.
    pub why: Option<String>,
}

#[derive(Debug, Deserialize)]
pub(crate) struct PersonAnswer {
    done: bool,
    reason: Option<String>,
    #[serde(default)]
    persons: Vec<KnownPerson>,
    #[serde(default)]
    pub(crate) understood: Vec<Understood>,
}

/// What the daemon has learned of the home.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct LearnedHabits {
    /// Whether the daemon learns now.
    pub learn: bool,
    /// Whether a restarted daemon will know it.
    pub kept: bool,
    /// Counts of things, in all contexts.
    pub counts: usize,
    /// Memory, in bytes.
    pub bytes: usize,
    /// One entry per person with learned habits.
    #[serde(default)]
    pub persons: Vec<PersonHabits>,
}

/// What the daemon has learned of a person.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct PersonHabits {
    /// The number.
    pub person: u32,
    /// The name, if the person has one.
    pub name: Option<String>,
    /// Events that were learned from; older events count less.
    pub observations: f64,
}

/// A change of the map that the daemon has made.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct ChangedMap {
    /// Fingerprint of the map in use now, hexadecimal.
    pub map: String,
    /// Scores with a greater sequence are of this map.
    pub sequence: u64,
    /// Rooms of the map.
    pub rooms: usize,
    /// Items of the map.
    pub items: usize,
    /// Whether a restarted daemon will have this map.
    pub kept: bool,
}

#[derive(Debug, Deserialize)]
struct MapAnswer {
    outcome: String,
    reason: Option<String>,
    #[serde(flatten)]
    changed: ChangedMap,
}

/// Everything behind the newest scores.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Moment {
    /// The map in use, in the format of a scene file.
    pub scene: Value,
    /// Everything else, by its key.
    #[serde(flatten)]
    pub more: serde_json::Map<String, Value>,
}

/// Asks, and reads the answer.
pub(crate) fn ask<A: DeserializeOwned>(
    node: &Node,
    service: &'static str,
    asked: &Value,
    timeout: Duration,
) -> Result<A, IpcError> {
    let answer = node.question_port(service)?.ask(&asked.to_string(), timeout)?;
    serde_json::from_str(&answer).map_err(|source| IpcError::Answer { service, source })
}

/// A name that no other question has: the daemon does a change of one name once.
fn new_id() -> String {
    format!("{:016x}", sequence::random_epoch())
}

fn not_done(service: &'static str, reason: Option<String>) -> IpcError {
    IpcError::NotGiven {
        service,
        reason: reason.unwrap_or_else(|| "the daemon did not do it and gives no reason".into()),
    }
}

fn changed(answer: PersonAnswer) -> Result<Vec<KnownPerson>, IpcError> {
    if answer.done { Ok(answer.persons) } else { Err(not_done(question::PERSON, answer.reason)) }
}

/// Asks the daemon once. Each question waits at most `timeout`: [`IpcError::NoAnswer`] says that no daemon answered.
impl Domain {
    /// The persons that the daemon knows.
    ///
    /// # Errors
    ///
    /// [`IpcError::NoAnswer`], [`IpcError::Answer`] for an answer of another version, and as [`Domain::open`].
    pub fn persons(&self, timeout: Duration) -> Result<Vec<KnownPerson>, IpcError> {
        let answer: PersonAnswer = ask(&self.open(ASKER)?, question::PERSON, &json!({"ask": "list"}), timeout)?;
        Ok(answer.persons)
    }

    /// Forgets a person, given by name or number. Returns the persons that the daemon knows then.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotGiven`] with the daemon's reason if it did not do it, and as [`Domain::persons`].
    pub fn forget_person(&self, who: &str, timeout: Duration) -> Result<Vec<KnownPerson>, IpcError> {
        let asked = json!({"ask": "forget", "id": new_id(), "who": who});
        changed(ask(&self.open(ASKER)?, question::PERSON, &asked, timeout)?)
    }

    /// Gives a person a name. Returns the persons that the daemon knows then.
    ///
    /// # Errors
    ///
    /// As [`Domain::forget_person`].
    pub fn rename_person(&self, who: &str, name: &str, timeout: Duration) -> Result<Vec<KnownPerson>, IpcError> {
        let asked = json!({"ask": "rename", "id": new_id(), "who": who, "name": name});
        changed(ask(&self.open(ASKER)?, question::PERSON, &asked, timeout)?)
    }

    /// What the daemon has learned of the home.
    ///
    /// # Errors
    ///
    /// As [`Domain::persons`].
    pub fn habits(&self, timeout: Duration) -> Result<LearnedHabits, IpcError> {
        ask(&self.open(ASKER)?, question::HABITS, &json!({"ask": "show"}), timeout)
    }

    /// Everything behind the newest scores.
    ///
    /// # Errors
    ///
    /// As [`Domain::persons`].
    pub fn moment(&self, timeout: Duration) -> Result<Moment, IpcError> {
        ask(&self.open(ASKER)?, question::MOMENT, &json!({}), timeout)
    }

    /// Changes the map of the daemon, all changes or none; `scenes/README.md` documents them.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotGiven`] with the daemon's reason if it did not change the map, and as [`Domain::persons`].
    pub fn change_map(&self, changes: &[Value], timeout: Duration) -> Result<ChangedMap, IpcError> {
        let asked = json!({"id": new_id(), "changes": changes});
        let answer: MapAnswer = ask(&self.open(ASKER)?, question::MAP_CHANGE, &asked, timeout)?;
        match answer.outcome.as_str() {
            "applied" => Ok(answer.changed),
            _ => Err(not_done(question::MAP_CHANGE, answer.reason)),
        }
    }

    /// The daemon's status.
    ///
    /// # Errors
    ///
    /// As [`Domain::persons`].
    pub fn status(&self, timeout: Duration) -> Result<crate::raw::StatusResponseV1, IpcError> {
        self.open(ASKER)?.status_client()?.ask(timeout)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_with_unknown_keys_is_read() {
        let answer: PersonAnswer = serde_json::from_str(
            r#"{"done": true, "kept": false, "new": 1, "persons": [], "understood": [{"sequence": 3, "event": "did",
                "persons": [{"person": 2, "name": "ada"}], "by": "key", "place": "fridge", "presence": "present"}]}"#,
        )
        .unwrap();
        let understood = &answer.understood[0];
        assert_eq!((understood.sequence, understood.place.as_deref()), (3, Some("fridge")));
        assert_eq!(understood.persons[0].name.as_deref(), Some("ada"));
    }

    #[test]
    fn a_refused_change_gives_the_reason() {
        let refused =
            PersonAnswer { done: false, reason: Some("no such person".into()), persons: vec![], understood: vec![] };
        assert!(changed(refused).unwrap_err().to_string().contains("no such person"));
    }
}
