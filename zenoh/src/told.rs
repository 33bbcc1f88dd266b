//! The robot's published messages as JSON: the contract's messages by their field names, with ages in place of times.
//!
//! A monotonic time means nothing on another machine. So each message has the age of its content, and the sending time by the sender's own clock,
//! which lets a receiver compute its delay ([`crate::delay`]).

use std::io::Write;

use roomcast_core::habits::{PART_HOURS, PARTS};
use roomcast_ipc::raw::{DecisionV1, ForecastV1, PersonForecastsV1, RoomScoresV1, StatusResponseV1, decision_flags};
use roomcast_ipc::{Action, Presence, clock};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::wire::Hex;

/// A message's content, and when it was made.
#[derive(Debug, Clone)]
pub struct Told {
    /// A JSON object without its end. The fields of one sending follow.
    content: Vec<u8>,
    made_ns: u64,
}

/// An upper limit for the fields of one sending.
const TELLING_BYTES: usize = 256;

/// The sender's fields of a message.
#[derive(Debug, Clone, Copy)]
pub struct Teller {
    /// Random number of the start.
    pub start: u64,
    /// The message's number.
    pub number: u64,
    /// The sender's monotonic clock ([`crate::delay::clock_id`]).
    pub clock: u64,
    /// When it started, by that clock.
    pub started_ns: u64,
}

impl Told {
    fn new(content: &impl Serialize, made_ns: u64) -> Self {
        let mut content = serde_json::to_vec(content).unwrap_or_default();
        if content.pop() != Some(b'}') {
            content = b"{\"content\":null".to_vec();
        }
        Self { content, made_ns }
    }

    /// The message's bytes, with its age of now.
    #[must_use]
    pub fn bytes(&self, teller: Teller) -> Vec<u8> {
        let now_ns = clock::monotonic_ns();
        let mut bytes = Vec::with_capacity(self.content.len() + TELLING_BYTES);
        bytes.extend_from_slice(&self.content);
        let Teller { start, number, clock, started_ns } = teller;
        let up_ns = now_ns.saturating_sub(started_ns);
        let (unix_ns, age_ns) = (clock::unix_ns(), now_ns.saturating_sub(self.made_ns));
        // Writing to memory does not fail.
        let _written = write!(
            bytes,
            ",\"teller\":\"{start:016x}\",\"number\":{number},\"sent_ns\":{now_ns},\"clock\":\"{clock:016x}\",\
             \"sent_unix_ns\":{unix_ns},\"age_ns\":{age_ns},\"up_ns\":{up_ns}}}"
        );
        bytes
    }
}

fn hex(number: u64) -> Value {
    json!(Hex(number))
}

/// Six decimals are more than the precision.
fn rounded(probability: f32) -> Value {
    ((f64::from(probability) * 1e6).round() / 1e6).into()
}

/// A score in nats; null for -inf, which JSON lacks.
fn nats(score: f64) -> Value {
    if score.is_finite() { score.into() } else { Value::Null }
}

/// Room scores, of a checked message.
#[must_use]
pub fn scores(scores: &RoomScoresV1) -> Told {
    let rooms: Vec<Value> = scores
        .rooms()
        .iter()
        .map(|room| json!({"id": room.id(), "probability": room.probability, "log_score_nats": nats(room.log_score_nats)}))
        .collect();
    let content = json!({
        "epoch": hex(scores.epoch), "sequence": scores.sequence, "rooms": rooms, "persons": scores.persons,
        "window": scores.window, "label_mass": scores.label_mass, "reached": scores.reached, "flags": scores.flags,
        "map": fingerprint(&scores.map_fingerprint), "model": fingerprint(&scores.model_fingerprint),
        "observed_before_ns": (scores.observed_ns > 0).then(|| scores.computed_ns.saturating_sub(scores.observed_ns)),
    });
    Told::new(&content, scores.computed_ns)
}

fn fingerprint(bytes: &[u8; 32]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The forecast, of a checked message.
#[must_use]
pub fn forecast(forecast: &ForecastV1) -> Told {
    let horizons = forecast.horizon_count as usize;
    let rooms: Map<String, Value> = (0..forecast.room_count as usize)
        .filter_map(|room| forecast.room(room))
        .map(|(id, row)| (id.to_owned(), row.iter().copied().map(rounded).collect()))
        .collect();
    let content = json!({
        "epoch": hex(forecast.epoch), "sequence": forecast.sequence, "flags": forecast.flags,
        "horizons_s": forecast.horizon_s.iter().take(horizons).collect::<Vec<_>>(), "rooms": rooms,
        "elsewhere": forecast.elsewhere.iter().take(horizons).copied().map(rounded).collect::<Vec<_>>(),
    });
    Told::new(&content, forecast.computed_ns)
}

/// Each person's forecast and room sets, of a checked message.
#[must_use]
pub fn persons(message: &PersonForecastsV1) -> Told {
    let horizons = message.horizon_count as usize;
    let persons: Vec<Value> = message
        .persons()
        .iter()
        .map(|person| {
            let rooms: Map<String, Value> = message
                .rooms()
                .zip(&person.probability)
                .map(|(id, row)| (id.to_owned(), row.iter().take(horizons).copied().map(rounded).collect()))
                .collect();
            let sets: Vec<Value> = (0..horizons)
                .filter(|_| person.set_coverage > 0.0)
                .map(|horizon| {
                    let held = message.rooms().enumerate();
                    let held = held.filter(|(room, _)| person.set_holds(horizon, *room) == Some(true));
                    json!({
                        "rooms": held.map(|(_, id)| id).collect::<Vec<_>>(),
                        "elsewhere": person.set_holds_elsewhere(horizon) == Some(true),
                    })
                })
                .collect();
            json!({
                "person": person.person, "name": person.name(), "presence": Presence::of(person.presence).word(),
                "flags": person.flags, "rooms": rooms, "coverage": rounded(person.set_coverage), "sets": sets,
                "elsewhere": person.elsewhere.iter().take(horizons).copied().map(rounded).collect::<Vec<_>>(),
            })
        })
        .collect();
    let content = json!({
        "epoch": hex(message.epoch), "sequence": message.sequence, "horizons_s": message.horizons_s(),
        "persons": persons,
    });
    Told::new(&content, message.computed_ns)
}

/// Serialised without a map of values, since robots wait for decisions.
#[derive(Serialize)]
struct Decided<'a> {
    epoch: Hex,
    sequence: u64,
    action: &'static str,
    from: &'a str,
    to: &'a str,
    policy: &'a str,
    reason: &'a str,
    probability: f64,
    stay_ns: u64,
    flags: u32,
    fallback: bool,
    cancels: u64,
    scores_epoch: Hex,
    scores_sequence: u64,
    scores_age_ns: u64,
}

/// A decision, of a checked message.
#[must_use]
pub fn decision(decision: &DecisionV1) -> Told {
    let content = Decided {
        epoch: Hex(decision.epoch),
        sequence: decision.sequence,
        action: Action::of(decision.action).word(),
        from: decision.from(),
        to: decision.to(),
        policy: decision.policy(),
        reason: decision.reason(),
        probability: decision.probability,
        stay_ns: decision.stay_ns,
        flags: decision.flags,
        fallback: decision.has(decision_flags::FALLBACK),
        cancels: decision.cancels,
        scores_epoch: Hex(decision.scores_epoch),
        scores_sequence: decision.scores_sequence,
        scores_age_ns: decision.scores_age_ns,
    };
    Told::new(&content, decision.decided_ns)
}

/// How often each room was visited, by part of the day.
#[must_use]
pub fn habits(visits: &[(String, [f64; PARTS])]) -> Told {
    let rooms: Map<String, Value> = visits.iter().map(|(room, counts)| (room.clone(), json!(counts))).collect();
    Told::new(&json!({ "part_hours": PART_HOURS, "rooms": rooms }), clock::monotonic_ns())
}

/// The robot's status: the daemon's silence, and its counters if it answered.
#[must_use]
pub fn status(robot: &str, silence_ns: Option<u64>, status: Option<&StatusResponseV1>) -> Told {
    let daemon = status.map(|status| {
        json!({
            "version": status.version(), "map": status.map(), "model": status.model(), "epoch": hex(status.epoch),
            "received": status.received, "accepted": status.accepted, "duplicates": status.duplicates,
            "missed": status.missed, "malformed": status.malformed, "limited": status.limited, "forged": status.forged,
            "ahead": status.ahead, "ahead_ns": status.ahead_ns,
            "published": status.published, "persons": status.persons, "sources": status.sources,
            "latency_p50_ns": status.latency_p50_ns, "latency_p99_ns": status.latency_p99_ns,
        })
    });
    let content = json!({ "robot": robot, "silence_ns": silence_ns, "daemon": daemon });
    Told::new(&content, clock::monotonic_ns())
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::text;

    use roomcast_ipc::raw::{action, presence};

    use super::*;

    fn told(told: &Told) -> Value {
        serde_json::from_slice(&told.bytes(Teller { start: 7, number: 3, clock: 1, started_ns: 0 })).unwrap()
    }

    #[test]
    fn a_message_says_its_age_by_no_clock_of_the_receiver() {
        let made_ns = clock::monotonic_ns() - 5_000_000;
        let message = told(&decision(&DecisionV1 {
            decided_ns: made_ns,
            action: action::GO,
            to: text::encode("to", "kitchen").unwrap(),
            ..Default::default()
        }));
        assert!(message["age_ns"].as_u64().unwrap() >= 5_000_000);
        assert_eq!(
            (&message["action"], &message["to"], &message["teller"]),
            (&json!("go"), &json!("kitchen"), &hex(7))
        );
    }

    #[test]
    fn scores_without_a_number_are_null() {
        let mut message = RoomScoresV1 { epoch: 1, sequence: 2, room_count: 2, ..Default::default() };
        message.room[0].id = text::encode("id", "kitchen").unwrap();
        message.room[0].log_score_nats = f64::NEG_INFINITY;
        message.room[1].id = text::encode("id", "hall").unwrap();
        message.room[1].probability = 0.25;
        let message = told(&scores(&message));
        assert_eq!(message["rooms"][0]["log_score_nats"], Value::Null);
        assert_eq!(message["rooms"][1], json!({"id": "hall", "probability": 0.25, "log_score_nats": 0.0}));
        assert_eq!(message["observed_before_ns"], Value::Null);
    }

    #[test]
    fn room_sets_are_told_by_name() {
        let mut message =
            PersonForecastsV1 { epoch: 1, room_count: 2, horizon_count: 1, person_count: 1, ..Default::default() };
        message.id[0] = text::encode("id", "kitchen").unwrap();
        message.id[1] = text::encode("id", "hall").unwrap();
        message.person[0].set_coverage = 0.9;
        message.person[0].room_set[0] = 0b10;
        message.person[0].probability[1][0] = 0.3;
        message.person[0].presence = presence::PRESENT;
        let message = told(&persons(&message));
        let person = &message["persons"][0];
        assert_eq!(person["sets"], json!([{"rooms": ["hall"], "elsewhere": false}]));
        assert_eq!((&person["presence"], &person["rooms"]["hall"]), (&json!("present"), &json!([0.3])));
    }
}
