//! Questions to the daemon, and its answers as types: [`Domain::persons`], [`Domain::moment`], [`Domain::habits`], [`Domain::change_map`]
//! and [`Narrator::understood`](crate::Narrator::understood).
//!
//! Questions and answers are JSON. A reader passes over unknown keys, so that answers can grow.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{Domain, IpcError, Node, question, sequence};

const ASKER: &str = "question";

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "ask", rename_all = "kebab-case")]
pub(crate) enum PersonQuestion<'a> {
    List,
    Understood { source: u64, epoch: u64, from: u64 },
    Forget { id: String, who: &'a str },
    Rename { id: String, who: &'a str, name: &'a str },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(tag = "ask", rename_all = "kebab-case")]
enum HabitsQuestion {
    Show,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
struct MomentQuestion {}

#[derive(Debug, Serialize)]
struct MapQuestion<'a> {
    id: String,
    changes: &'a [MapChange],
}

/// A change of the map. Entries of items, rooms and doors are those of a scene file; `scenes/README.md` documents them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "change", rename_all = "kebab-case")]
pub enum MapChange {
    /// A new item.
    AddItem {
        /// The entry of the item.
        item: Value,
    },
    /// An item has another place.
    MoveItem {
        /// The id of the item.
        id: String,
        /// The new position.
        position_m: [f64; 3],
        /// The new extent.
        r#box: MapBox,
    },
    /// An item is gone.
    RemoveItem {
        /// The id of the item.
        id: String,
    },
    /// A new room.
    AddRoom {
        /// The entry of the room.
        room: Value,
        /// The entries of the doors that lead to the room.
        doors: Vec<Value>,
    },
    /// A room is gone, with its items and doors.
    RemoveRoom {
        /// The id of the room.
        id: String,
    },
}

/// A box in the map's metres: x east, y north, z up.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapBox {
    /// The corner with the least coordinates.
    pub min_m: [f64; 3],
    /// The corner with the greatest coordinates.
    pub max_m: [f64; 3],
}

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
    /// The thing or room that the event names, as the map calls it: `fridge`, not the fridge's room.
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

/// The learned habits of the home.
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

/// The learned habits of a person.
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
    /// The version of this answer, 1.
    pub version: u32,
    /// The epoch of the scores, hexadecimal.
    pub epoch: String,
    /// The sequence of the scores.
    pub sequence: u64,
    /// The time of the scores, in Unix nanoseconds.
    pub computed_unix_ns: u64,
    /// The name of the model.
    pub model: String,
    /// SHA-256 of the model file, hexadecimal.
    pub model_fingerprint: String,
    /// SHA-256 of the map, hexadecimal.
    pub map_fingerprint: String,
    /// The text between narration and label.
    pub binding: String,
    /// The sentences that the model read, the oldest first.
    pub narration: Vec<ReadSentence>,
    /// The newest event of each narrator that the scores contain.
    pub included: Vec<IncludedEvent>,
    /// The scores of the labels. With several persons, the scores for all of them together.
    pub labels: Vec<LabelScore>,
    /// With several persons, the scores of the labels for each person.
    #[serde(default)]
    pub persons: Vec<PersonLabels>,
    /// The person that the scores are of, if there is one person alone.
    pub alone: Option<u32>,
    /// The names of persons, by number.
    #[serde(default)]
    pub names: BTreeMap<u32, String>,
    /// Whether all known persons are out of the house. Then no label has a score.
    #[serde(default)]
    pub nobody_home: bool,
    /// The map in use, in the format of a scene file.
    pub scene: Value,
    /// Everything else, by its key.
    #[serde(flatten)]
    pub more: serde_json::Map<String, Value>,
}

/// A sentence that the model read.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct ReadSentence {
    /// The person that the sentence is about.
    pub person: u32,
    /// The sentence.
    pub text: String,
}

/// The newest event of a narrator that scores contain.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
pub struct IncludedEvent {
    /// The narrator's number, hexadecimal.
    pub source: String,
    /// The epoch of the narrator's start, hexadecimal.
    pub epoch: String,
    /// The number of the event.
    pub sequence: u64,
}

/// The model's score of a label.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct LabelScore {
    /// The label.
    pub label: String,
    /// The logarithm of the score, in nats; `None` for a score of zero.
    pub log_prob_nats: Option<f64>,
    /// The label's tokens; empty if their scores are not known one by one.
    #[serde(default)]
    pub tokens: Vec<TokenScore>,
    /// The share of the prior in the score, in nats.
    #[serde(default)]
    pub prior_nats: f64,
}

/// The model's score of a token of a label.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct TokenScore {
    /// The text of the token.
    pub piece: String,
    /// The logarithm of the score after the tokens before it, in nats.
    pub log_prob_nats: f64,
}

/// The scores of the labels for one person.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct PersonLabels {
    /// The number of the person.
    pub person: u32,
    /// The scores.
    pub labels: Vec<LabelScore>,
}

pub(crate) fn ask<A: DeserializeOwned>(
    node: &Node,
    service: &'static str,
    question: &impl Serialize,
    timeout: Duration,
) -> Result<A, IpcError> {
    let question = serde_json::to_string(question).map_err(|source| IpcError::Answer { service, source })?;
    let answer = node.question_port(service)?.ask(&question, timeout)?;
    serde_json::from_str(&answer).map_err(|source| IpcError::Answer { service, source })
}

/// The daemon makes a change with one id only once, so each question gets its own.
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
        let answer: PersonAnswer = ask(&self.open(ASKER)?, question::PERSON, &PersonQuestion::List, timeout)?;
        Ok(answer.persons)
    }

    /// Forgets a person, given by name or number. Returns the persons that the daemon knows then.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotGiven`] with the daemon's reason if it did not do it, and as [`Domain::persons`].
    pub fn forget_person(&self, who: &str, timeout: Duration) -> Result<Vec<KnownPerson>, IpcError> {
        let asked = PersonQuestion::Forget { id: new_id(), who };
        changed(ask(&self.open(ASKER)?, question::PERSON, &asked, timeout)?)
    }

    /// Gives a person a name. Returns the persons that the daemon knows then.
    ///
    /// # Errors
    ///
    /// As [`Domain::forget_person`].
    pub fn rename_person(&self, who: &str, name: &str, timeout: Duration) -> Result<Vec<KnownPerson>, IpcError> {
        let asked = PersonQuestion::Rename { id: new_id(), who, name };
        changed(ask(&self.open(ASKER)?, question::PERSON, &asked, timeout)?)
    }

    /// The learned habits of the home.
    ///
    /// # Errors
    ///
    /// As [`Domain::persons`].
    pub fn habits(&self, timeout: Duration) -> Result<LearnedHabits, IpcError> {
        ask(&self.open(ASKER)?, question::HABITS, &HabitsQuestion::Show, timeout)
    }

    /// Everything behind the newest scores.
    ///
    /// # Errors
    ///
    /// As [`Domain::persons`].
    pub fn moment(&self, timeout: Duration) -> Result<Moment, IpcError> {
        ask(&self.open(ASKER)?, question::MOMENT, &MomentQuestion {}, timeout)
    }

    /// Changes the map of the daemon, all changes or none; `scenes/README.md` documents them.
    ///
    /// # Errors
    ///
    /// [`IpcError::NotGiven`] with the daemon's reason if it did not change the map, and as [`Domain::persons`].
    pub fn change_map(&self, changes: &[MapChange], timeout: Duration) -> Result<ChangedMap, IpcError> {
        let asked = MapQuestion { id: new_id(), changes };
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
    fn questions_are_written_as_the_daemon_reads_them() {
        let text = |question: &dyn Fn() -> serde_json::Result<String>| question().unwrap();
        assert_eq!(text(&|| serde_json::to_string(&MomentQuestion {})), "{}");
        assert_eq!(text(&|| serde_json::to_string(&HabitsQuestion::Show)), r#"{"ask":"show"}"#);
        assert_eq!(text(&|| serde_json::to_string(&PersonQuestion::List)), r#"{"ask":"list"}"#);
        let understood = PersonQuestion::Understood { source: 1, epoch: 2, from: 3 };
        let expected = r#"{"ask":"understood","source":1,"epoch":2,"from":3}"#;
        assert_eq!(text(&|| serde_json::to_string(&understood)), expected);
        let changes = [MapChange::RemoveItem { id: "mug-1".into() }];
        let expected = r#"{"id":"a","changes":[{"change":"remove-item","id":"mug-1"}]}"#;
        assert_eq!(text(&|| serde_json::to_string(&MapQuestion { id: "a".into(), changes: &changes })), expected);
    }

    #[test]
    fn a_refused_change_gives_the_reason() {
        let refused =
            PersonAnswer { done: false, reason: Some("no such person".into()), persons: vec![], understood: vec![] };
        assert!(changed(refused).unwrap_err().to_string().contains("no such person"));
    }
}
