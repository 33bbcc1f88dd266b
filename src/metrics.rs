//! Metrics of the services for Prometheus, on a loopback address.
//!
//! This is a separate participant, so that the daemon needs no sockets. Latencies come from the scores themselves; counters are the daemon's own and
//! are asked for at a scrape.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use hyper::header::{CONTENT_TYPE, HeaderValue};
use hyper::{Response, StatusCode};

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::{Registry, Unit};
use roomcast_ipc::raw::{DecisionV1, RoomScoresV1, StatusResponseV1, decision_flags, score_flags};
use roomcast_ipc::{Domain, IpcError, QuestionPort, StatusClient, Subscriber, question};
use roomcast_services::clock;

use crate::decided::{Decided, News};
use crate::http::{HttpError, Request, Server, only_get, refusal};
use roomcast_core::ids::BootNs;
use roomcast_core::policy::PolicyName;
use roomcast_services::daemon::{HabitsAnswer, HabitsLine, HabitsQuestion};
use roomcast_services::stop::Stop;

/// Bounds of latency buckets in seconds: half a millisecond to ten seconds.
const BUCKETS_S: [f64; 14] = [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0];
/// Timeout of the daemon's counters, and the time for which its answer serves further scrapes.
const PATIENCE: Duration = Duration::from_millis(500);
const TICK: Duration = Duration::from_millis(100);
/// The label of all policies that are not Roomcast's own.
const OTHER_POLICY: &str = "other";
/// The content type that OpenMetrics requires.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

#[derive(Debug, thiserror::Error)]
pub enum MetricsError {
    #[error("metrics: {0}")]
    Http(#[from] HttpError),
    #[error(transparent)]
    Ipc(#[from] IpcError),
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Stage {
    stage: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct NarrationOutcome {
    outcome: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Room {
    room: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct DecisionKind {
    policy: &'static str,
    fallback: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Versions {
    version: String,
    model: String,
    model_fingerprint: String,
    map: String,
    map_fingerprint: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Person {
    person: u32,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ForecastPart {
    person: u32,
    horizon_s: u32,
    part: &'static str,
}

type Ratio = Gauge<f64, AtomicU64>;

#[derive(Debug)]
struct Metrics {
    registry: Registry,
    event_to_scores: Histogram,
    stages: Family<Stage, Histogram, fn() -> Histogram>,
    scores_seen: Counter,
    scores_unseen: Counter,
    malformed_scores: Counter,
    room_probability: Family<Room, Ratio>,
    label_mass: Ratio,
    scores_age: Ratio,
    scores_silence: Ratio,
    narration_age: Ratio,
    decisions: Family<DecisionKind, Counter>,
    daemon_up: Gauge,
    daemon_start: Ratio,
    narrations: Family<NarrationOutcome, Counter>,
    ahead: Counter,
    ahead_s: Ratio,
    waiting: Gauge,
    steps: Counter,
    failed_steps: Counter,
    merged: Counter,
    heartbeats: Counter,
    journal_bytes: Gauge,
    journal_failures: Counter,
    sources: Gauge,
    persons: Gauge,
    habits_bytes: Gauge,
    habits_counts: Gauge,
    habits_names: Gauge,
    asked: Counter,
    prepared: Counter,
    prepared_used: Counter,
    prepare_s: Counter<f64, AtomicU64>,
    habits_observations: Family<Person, Ratio>,
    habits_shares: Family<ForecastPart, Ratio>,
    versions: Family<Versions, Gauge>,
    /// The newest scores, for recognising repetitions and for their age at a scrape.
    newest: Option<RoomScoresV1>,
    /// Each robot's last decision, so that a repetition does not count.
    decided: Decided,
}

fn latency_histogram() -> Histogram {
    Histogram::new(BUCKETS_S)
}

fn seconds(nanoseconds: u64) -> f64 {
    nanoseconds as f64 / 1e9
}

impl Metrics {
    fn new() -> Self {
        let mut metrics = Self {
            registry: Registry::with_prefix("roomcast"),
            event_to_scores: latency_histogram(),
            stages: Family::new_with_constructor(latency_histogram),
            scores_seen: Counter::default(),
            scores_unseen: Counter::default(),
            malformed_scores: Counter::default(),
            room_probability: Family::default(),
            label_mass: Ratio::default(),
            scores_age: Ratio::default(),
            scores_silence: Ratio::default(),
            narration_age: Ratio::default(),
            decisions: Family::default(),
            daemon_up: Gauge::default(),
            daemon_start: Ratio::default(),
            narrations: Family::default(),
            ahead: Counter::default(),
            ahead_s: Ratio::default(),
            waiting: Gauge::default(),
            steps: Counter::default(),
            failed_steps: Counter::default(),
            merged: Counter::default(),
            heartbeats: Counter::default(),
            journal_bytes: Gauge::default(),
            journal_failures: Counter::default(),
            sources: Gauge::default(),
            persons: Gauge::default(),
            habits_bytes: Gauge::default(),
            habits_counts: Gauge::default(),
            habits_names: Gauge::default(),
            asked: Counter::default(),
            prepared: Counter::default(),
            prepared_used: Counter::default(),
            prepare_s: Counter::default(),
            habits_observations: Family::default(),
            habits_shares: Family::default(),
            versions: Family::default(),
            newest: None,
            decided: Decided::default(),
        };
        metrics.register();
        metrics
    }

    /// Long, because it is a list: each metric with its text.
    fn register(&mut self) {
        let r = &mut self.registry;
        let s = Unit::Seconds;
        r.register_with_unit(
            "event_to_scores",
            "From the receipt of a narration to its scores",
            s.clone(),
            self.event_to_scores.clone(),
        );
        r.register_with_unit("step", "Stages of a scoring step", s.clone(), self.stages.clone());
        r.register("scores", "Snapshots of new scores seen here", self.scores_seen.clone());
        r.register("scores_unseen", "Snapshots that came and were not seen here", self.scores_unseen.clone());
        r.register("scores_malformed", "Snapshots that were malformed", self.malformed_scores.clone());
        r.register(
            "room_probability",
            "Probability that a person turns to the room next",
            self.room_probability.clone(),
        );
        r.register(
            "label_mass",
            "Probability that what comes next is, or begins as, a label of the map",
            self.label_mass.clone(),
        );
        r.register_with_unit("scores_age", "Since the newest scores were computed", s.clone(), self.scores_age.clone());
        r.register_with_unit(
            "scores_silence",
            "Since the daemon last confirmed its scores",
            s.clone(),
            self.scores_silence.clone(),
        );
        r.register_with_unit(
            "narration_age",
            "Since the newest narration in the scores was observed",
            s.clone(),
            self.narration_age.clone(),
        );
        r.register("decisions", "Decisions of planners seen here", self.decisions.clone());
        r.register("daemon_up", "Whether the daemon answers", self.daemon_up.clone());
        r.register_with_unit(
            "daemon_start_time",
            "When the daemon started, in Unix time",
            s,
            self.daemon_start.clone(),
        );
        r.register(
            "narrations",
            "Narrations by what became of them, since the daemon's start",
            self.narrations.clone(),
        );
        r.register(
            "narrations_ahead",
            "Narrations from a fast clock: they count as observed when they came",
            self.ahead.clone(),
        );
        r.register(
            "narration_ahead_seconds",
            "How far the newest narration from a fast clock lay ahead",
            self.ahead_s.clone(),
        );
        r.register("narrations_waiting", "Narrations that wait for the next step", self.waiting.clone());
        r.register("steps", "Scoring steps since the daemon's start", self.steps.clone());
        r.register("steps_failed", "Scoring steps in which the model failed", self.failed_steps.clone());
        r.register("narrations_merged", "Narrations scored together with a newer one", self.merged.clone());
        r.register("heartbeats", "Heartbeats since the daemon's start", self.heartbeats.clone());
        r.register("journal_size_bytes", "Bytes of the state database and its log on disk", self.journal_bytes.clone());
        r.register("journal_failures", "Faults of the state database's files", self.journal_failures.clone());
        r.register("sources", "Narrators known", self.sources.clone());
        r.register("persons", "Persons known", self.persons.clone());
        r.register("habits_size_bytes", "Bytes of memory that habits take", self.habits_bytes.clone());
        r.register("habits_counts", "Counts that habits hold", self.habits_counts.clone());
        r.register("habits_names", "Names of things that habits hold", self.habits_names.clone());
        r.register("answers_asked", "Prompts that scoring steps asked the model about", self.asked.clone());
        r.register("answers_prepared", "Answers prepared in idle time", self.prepared.clone());
        r.register("answers_used", "Prepared answers that a step used", self.prepared_used.clone());
        r.register("prepare_seconds", "Time of the processor spent preparing answers", self.prepare_s.clone());
        r.register(
            "habits_observations",
            "Observations that a person's habits rest on",
            self.habits_observations.clone(),
        );
        r.register(
            "habits_forecast_share",
            "How much of a person's present forecast comes from where, 0 to 1",
            self.habits_shares.clone(),
        );
        r.register("daemon", "Versions, model and map", self.versions.clone());
    }

    /// Counts scores, repetitions included.
    fn take(&mut self, scores: &RoomScoresV1) {
        let is_repetition = scores.has(score_flags::HEARTBEAT);
        // How many scores another daemon sent before is unknown.
        let known = self.newest.filter(|known| known.epoch == scores.epoch).map(|known| known.sequence);
        if let Some(new) = known.and_then(|known| scores.sequence.checked_sub(known)) {
            // A repetition of unseen scores shows that they were sent.
            self.scores_unseen.inc_by(if is_repetition { new } else { new.saturating_sub(1) });
        }
        if known.is_none_or(|known| scores.sequence > known) && !is_repetition {
            self.scores_seen.inc();
            // A step without narration (the first one, a changed map) has no event for measuring latency.
            if scores.wait_ns > 0 {
                self.event_to_scores.observe(seconds(scores.published_ns.saturating_sub(scores.received_ns)));
            }
            let stages = [
                ("wait", scores.wait_ns),
                ("tokenise", scores.tokenise_ns),
                ("prefix", scores.prefix_ns),
                ("trie", scores.trie_ns),
                ("ground", scores.ground_ns),
            ];
            for (stage, taken_ns) in stages {
                self.stages.get_or_create(&Stage { stage }).observe(seconds(taken_ns));
            }
        }
        // Another daemon may have the same map in other partitions.
        if self
            .newest
            .is_some_and(|known| (known.epoch, known.map_fingerprint) != (scores.epoch, scores.map_fingerprint))
        {
            self.room_probability.clear();
        }
        for room in scores.rooms() {
            self.room_probability.get_or_create(&Room { room: room.id().to_owned() }).set(room.probability);
        }
        self.label_mass.set(scores.label_mass);
        self.newest = Some(*scores);
    }

    fn decide(&mut self, decision: &DecisionV1) {
        if self.decided.take(decision) != News::Decision {
            return;
        }
        let fallback = if decision.has(decision_flags::FALLBACK) { "true" } else { "false" };
        // A foreign planner may name any policy, and ever new ones.
        let known = PolicyName::ALL.map(PolicyName::as_str).into_iter().find(|known| *known == decision.policy());
        let kind = DecisionKind { policy: known.unwrap_or(OTHER_POLICY), fallback };
        self.decisions.get_or_create(&kind).inc();
    }

    fn ask(&self, status: Option<&StatusResponseV1>) {
        self.daemon_up.set(i64::from(status.is_some()));
        let Some(status) = status else { return };
        let set = |counter: &Counter, value: u64| counter.inner().store(value, Ordering::Relaxed);
        let gauge = |gauge: &Gauge, value: u64| {
            gauge.set(i64::try_from(value).unwrap_or(i64::MAX));
        };
        for (outcome, count) in [
            ("accepted", status.accepted),
            ("duplicate", status.duplicates),
            ("missed", status.missed),
            ("malformed", status.malformed),
            ("limited", status.limited),
            ("forged", status.forged),
            ("costly", status.costly),
            ("restored", status.restored),
        ] {
            set(&self.narrations.get_or_create(&NarrationOutcome { outcome }), count);
        }
        set(&self.ahead, status.ahead);
        self.ahead_s.set(seconds(status.ahead_ns));
        set(&self.steps, status.steps);
        set(&self.failed_steps, status.failed_steps);
        set(&self.merged, status.merged);
        set(&self.heartbeats, status.heartbeats);
        set(&self.journal_failures, status.journal_failures);
        set(&self.asked, status.asked);
        set(&self.prepared, status.prepared);
        set(&self.prepared_used, status.prepared_used);
        self.prepare_s.inner().store(seconds(status.prepare_ns).to_bits(), Ordering::Relaxed);
        gauge(&self.waiting, status.waiting);
        gauge(&self.journal_bytes, status.journal_bytes);
        gauge(&self.sources, status.sources.into());
        gauge(&self.persons, status.persons.into());
        gauge(&self.habits_bytes, status.habits_bytes);
        gauge(&self.habits_counts, status.habits_counts);
        gauge(&self.habits_names, status.habits_names.into());
        self.daemon_start.set(seconds(status.started_unix_ns));
        self.versions.clear();
        let versions = Versions {
            version: status.version().to_owned(),
            model: status.model().to_owned(),
            model_fingerprint: hex::encode(status.model_fingerprint),
            map: status.map().to_owned(),
            map_fingerprint: hex::encode(status.map_fingerprint),
        };
        self.versions.get_or_create(&versions).set(1);
    }

    /// Replaces the counts of habits, so that forgotten persons disappear.
    fn habits(&self, learned: &HabitsAnswer) {
        self.habits_observations.clear();
        self.habits_shares.clear();
        for HabitsLine { person, observations, forecast, .. } in &learned.persons {
            self.habits_observations.get_or_create(&Person { person: person.0 }).set(*observations);
            for line in forecast {
                for (part, share) in [("model", line.shipped), ("leaving", line.leaving), ("later", line.later)] {
                    let of = ForecastPart { person: person.0, horizon_s: line.horizon_s as u32, part };
                    self.habits_shares.get_or_create(&of).set(share);
                }
            }
        }
    }

    fn text(&self, now_ns: BootNs) -> String {
        if let Some(scores) = &self.newest {
            self.scores_age.set(seconds(scores.age_ns(now_ns.0)));
            self.scores_silence.set(seconds(scores.silence_ns(now_ns.0)));
            if scores.observed_ns > 0 {
                self.narration_age.set(seconds(now_ns.since(BootNs(scores.observed_ns))));
            }
        }
        let mut text = String::new();
        // Writing into a String does not fail.
        let _written = prometheus_client::encoding::text::encode(&mut text, &self.registry);
        text
    }
}

/// Serves metrics until asked to stop. `ready` gets the address, with the port that was chosen for port 0.
///
/// # Errors
///
/// [`MetricsError`] for an address that is not loopback or is taken, and if a service is lost.
pub fn run(
    address: SocketAddr,
    domain: &Domain,
    stop: &Stop,
    ready: impl FnOnce(SocketAddr),
) -> Result<(), MetricsError> {
    let node = domain.open("roomcast-metrics")?;
    let scores: Subscriber<RoomScoresV1> = node.subscriber()?;
    // Earlier decisions do not count as seen: each start would count them again.
    let decisions: Subscriber<DecisionV1> = node.subscriber_from_now()?;
    let (status, habits) = (node.status_client()?, node.question_port(question::HABITS)?);
    let metrics = Arc::new(Mutex::new(Metrics::new()));
    let mut scrapes = Scrapes { status, habits, metrics: Arc::clone(&metrics), asked: None };
    let mut server = Server::start(address, stop, move |request| scrapes.answer(request))?;
    ready(server.address());
    while !stop.requested() {
        scores.wait(TICK)?;
        let mut metrics = metrics.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(scores) = scores.receive()? {
            metrics.take(&scores);
        }
        let new = scores.malformed() - metrics.malformed_scores.get();
        metrics.malformed_scores.inc_by(new);
        while let Some(decision) = decisions.receive()? {
            metrics.decide(&decision);
        }
        drop(metrics);
        server.look_after()?;
    }
    server.join();
    Ok(())
}

struct Scrapes {
    status: StatusClient,
    habits: QuestionPort,
    metrics: Arc<Mutex<Metrics>>,
    asked: Option<Instant>,
}

impl Scrapes {
    fn answer(&mut self, request: Request<'_>) -> Response<String> {
        if request.changes {
            return only_get();
        }
        if request.uri.path() != "/metrics" {
            return refusal(StatusCode::NOT_FOUND, "see /metrics");
        }
        let mut response = Response::new(self.text());
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(OPEN_METRICS));
        response
    }

    fn text(&mut self) -> String {
        // A silent daemon delays one of several simultaneous scrapes.
        let fresh = self.asked.is_some_and(|asked| asked.elapsed() < PATIENCE);
        let begun = Instant::now();
        let answer = (!fresh).then(|| self.status.ask(PATIENCE).ok());
        let learned = answer.as_ref().and_then(|status| self.learned(status.as_ref()?, begun));
        let metrics = self.metrics.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(answer) = answer {
            self.asked = Some(Instant::now());
            metrics.ask(answer.as_ref());
        }
        // Without an answer the last counts stay.
        if let Some(learned) = learned {
            metrics.habits(&learned);
        }
        metrics.text(clock::monotonic_ns())
    }

    /// The daemon's learned habits, within the rest of the timeout since `begun`; `None` without an answer.
    fn learned(&self, status: &StatusResponseV1, begun: Instant) -> Option<HabitsAnswer> {
        if status.habits_persons == 0 {
            // Without learned habits there is no question.
            return Some(HabitsAnswer::default());
        }
        let question = serde_json::to_string(&HabitsQuestion::Show).ok()?;
        let left = PATIENCE.saturating_sub(begun.elapsed());
        serde_json::from_str(&self.habits.ask(&question, left).ok()?).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eventually::eventually;
    use crate::http::REQUEST_TIME;
    use rand::seq::IndexedRandom;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use roomcast_core::ids::PersonId;
    use roomcast_ipc::text;
    use roomcast_services::habits_reason::HorizonLine;
    use std::io::{Read, Write};

    /// A planner may name its policy anything, and change the name every time.
    #[test]
    fn foreign_policies_are_one_series() {
        let (mut metrics, mut sequence) = (Metrics::new(), 0);
        let mut decide = |policy: &str| {
            sequence += 1;
            let policy = text::encode("policy", policy).unwrap();
            let decision = DecisionV1 { policy, sequence, ..DecisionV1::default() };
            // A repetition counts once.
            (0..2).for_each(|_| metrics.decide(&decision));
        };
        PolicyName::ALL.iter().for_each(|policy| decide(policy.as_str()));
        (0..1000).for_each(|number| decide(&format!("policy-{number}")));
        decide("other");
        let text = metrics.text(BootNs(0));
        let series: Vec<_> = text.lines().filter(|line| line.starts_with("roomcast_decisions_total")).collect();
        assert_eq!(series.len(), PolicyName::ALL.len() + 1, "{series:?}");
        for line in [
            "roomcast_decisions_total{policy=\"coverage-aware\",fallback=\"false\"} 1",
            "roomcast_decisions_total{policy=\"other\",fallback=\"false\"} 1001",
        ] {
            assert!(series.contains(&line), "{line}\n{text}");
        }
    }

    #[test]
    fn steps_are_measured_once_and_gaps_are_counted() {
        let mut metrics = Metrics::new();
        let mut scores = RoomScoresV1 {
            epoch: 1,
            sequence: 1,
            room_count: 1,
            wait_ns: 1,
            received_ns: 1_000_000,
            published_ns: 4_000_000,
            prefix_ns: 2_500_000,
            ..Default::default()
        };
        scores.room[0].id = text::encode("id", "kitchen").unwrap();
        scores.room[0].probability = 0.75;
        metrics.take(&scores);
        metrics.take(&RoomScoresV1 { flags: score_flags::HEARTBEAT, published_ns: 9_000_000, ..scores });
        metrics.take(&RoomScoresV1 { sequence: 4, ..scores });
        let text = metrics.text(BootNs(10_000_000));
        for line in [
            "roomcast_event_to_scores_seconds_count 2",
            "roomcast_event_to_scores_seconds_bucket{le=\"0.002\"} 0",
            "roomcast_event_to_scores_seconds_bucket{le=\"0.005\"} 2",
            "roomcast_step_seconds_bucket{le=\"0.005\",stage=\"prefix\"} 2",
            "roomcast_scores_total 2",
            "roomcast_scores_unseen_total 2",
            "roomcast_room_probability{room=\"kitchen\"} 0.75",
        ] {
            assert!(text.lines().any(|own| own == line), "{line}\n{text}");
        }
        assert!(text.ends_with("# EOF\n"));
    }

    /// Each of a daemon's snapshots counts once, as seen or unseen, in any order of repetitions.
    #[test]
    fn every_snapshot_was_seen_or_was_not() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for _ in 0..200 {
            let (mut metrics, mut last) = (Metrics::new(), 1);
            metrics.take(&RoomScoresV1 { epoch: 1, sequence: 1, ..Default::default() });
            for sequence in 1..=20 {
                let flags = if rng.random() { score_flags::HEARTBEAT } else { 0 };
                if rng.random() {
                    last = sequence;
                    metrics.take(&RoomScoresV1 { epoch: 1, sequence, flags, ..Default::default() });
                }
            }
            assert_eq!(metrics.scores_seen.get() + metrics.scores_unseen.get(), last);
        }
    }

    /// If a daemon restarts with other partitions of the same map, the earlier rooms disappear.
    #[test]
    fn rooms_are_those_of_the_newest_scores() {
        let mut metrics = Metrics::new();
        for (epoch, map, rooms) in [
            (1, 1, &["kitchen", "bedroom"][..]),
            (2, 1, &["day-rooms", "bedroom"]),
            (2, 2, &["day-rooms"]),
            (3, 2, &["kitchen"]),
        ] {
            let mut scores = RoomScoresV1 {
                epoch,
                sequence: 1,
                room_count: rooms.len() as u32,
                map_fingerprint: [map; 32],
                ..Default::default()
            };
            for (place, id) in rooms.iter().enumerate() {
                scores.room[place].id = text::encode("id", id).unwrap();
            }
            metrics.take(&scores);
            let text = metrics.text(BootNs(1));
            let told = text.lines().filter(|line| line.starts_with("roomcast_room_probability{")).count();
            let all = rooms.iter().all(|id| text.contains(&format!("roomcast_room_probability{{room=\"{id}\"}}")));
            assert!(told == rooms.len() && all, "{text}");
        }
    }

    #[test]
    fn what_was_learned_of_each_person_is_told_until_they_are_forgotten() {
        let metrics = Metrics::new();
        metrics.ask(Some(&StatusResponseV1 {
            habits_bytes: 4_096,
            habits_counts: 12,
            habits_names: 3,
            ..Default::default()
        }));
        let line = HorizonLine {
            horizon_s: 900.0,
            shipped: 0.25,
            leaving: 0.625,
            later: 0.125,
            set: Vec::new(),
            set_probability: None,
        };
        let ada = HabitsLine {
            person: PersonId(7),
            name: Some("ada".to_owned()),
            observations: 41.5,
            watched_h: 0.0,
            forecast: vec![line],
        };
        metrics.habits(&HabitsAnswer { persons: vec![ada], ..HabitsAnswer::default() });
        let text = metrics.text(BootNs(1));
        for line in [
            "roomcast_habits_size_bytes 4096",
            "roomcast_habits_counts 12",
            "roomcast_habits_names 3",
            "roomcast_habits_observations{person=\"7\"} 41.5",
            "roomcast_habits_forecast_share{person=\"7\",horizon_s=\"900\",part=\"model\"} 0.25",
            "roomcast_habits_forecast_share{person=\"7\",horizon_s=\"900\",part=\"leaving\"} 0.625",
        ] {
            assert!(text.lines().any(|own| own == line), "{line}\n{text}");
        }
        metrics.habits(&HabitsAnswer::default());
        assert!(!metrics.text(BootNs(2)).contains("person=\"7\""));
    }

    /// If the daemon is busy or away, no person is forgotten.
    #[test]
    fn who_does_not_answer_has_forgotten_nobody() {
        let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(folder.path().join("d"), &format!("silent-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let (status, habits) = (node.status_client().unwrap(), node.question_port(question::HABITS).unwrap());
        let metrics = Arc::new(Mutex::new(Metrics::new()));
        let ada =
            HabitsLine { person: PersonId(7), name: None, observations: 41.5, watched_h: 0.0, forecast: Vec::new() };
        metrics.lock().unwrap().habits(&HabitsAnswer { persons: vec![ada], ..HabitsAnswer::default() });
        let mut scrapes = Scrapes { status, habits, metrics, asked: None };
        let knows_ada = |text: &str| text.contains("roomcast_habits_observations{person=\"7\"} 41.5");
        let without = scrapes.text();
        assert!(knows_ada(&without) && without.contains("roomcast_daemon_up 0"), "{without}");
        // A daemon that answers for its counters only, until it has learned habits.
        let (stop, server) = (Stop::new(), node.status_server().unwrap());
        let (asked, persons) = (stop.clone(), Arc::new(AtomicU64::new(1)));
        let known = Arc::clone(&persons);
        let daemon = std::thread::spawn(move || {
            while !asked.requested() {
                let habits_persons = known.load(Ordering::Relaxed) as u32;
                server.answer(|| StatusResponseV1 { habits_persons, ..Default::default() }).unwrap();
                // The daemon's pace.
                std::thread::sleep(Duration::from_millis(1));
            }
        });
        let mut again = || {
            scrapes.asked = None;
            scrapes.text()
        };
        let busy =
            eventually("the daemon is up", || Some(again()).filter(|text| text.contains("roomcast_daemon_up 1")));
        assert!(knows_ada(&busy), "{busy}");
        persons.store(0, Ordering::Relaxed);
        eventually("no habits are left", || (!knows_ada(&again())).then_some(()));
        stop.request();
        daemon.join().unwrap();
        drop((scrapes, node));
        let _left = domain.clean_up();
    }

    struct Served {
        address: SocketAddr,
        stop: Stop,
        thread: Option<std::thread::JoinHandle<Result<(), MetricsError>>>,
        domain: Domain,
        _folder: tempfile::TempDir,
    }

    impl Served {
        fn start(name: &str) -> Self {
            let folder = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
            let domain = Domain::new(folder.path().join("d"), &format!("{name}-{}", std::process::id())).unwrap();
            let (stop, (found, address)) = (Stop::new(), std::sync::mpsc::channel());
            let (own_stop, own_domain) = (stop.clone(), domain.clone());
            let any = "127.0.0.1:0".parse().unwrap();
            let thread =
                std::thread::spawn(move || run(any, &own_domain, &own_stop, |address| found.send(address).unwrap()));
            let address = address.recv_timeout(Duration::from_secs(60)).unwrap();
            Self { address, stop, thread: Some(thread), domain, _folder: folder }
        }

        fn connect(&self) -> std::net::TcpStream {
            let stream = std::net::TcpStream::connect(self.address).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
            stream
        }

        /// A scrape must be answered, whatever else is connected.
        fn scrape(&self) -> Duration {
            let start = Instant::now();
            let mut stream = self.connect();
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            assert!(text.starts_with("HTTP/1.1 200") && text.ends_with("# EOF\n"), "{text}");
            start.elapsed()
        }
    }

    impl Drop for Served {
        fn drop(&mut self) {
            self.stop.request();
            let ended = self.thread.take().map(std::thread::JoinHandle::join);
            let _left = self.domain.clean_up();
            if !std::thread::panicking() {
                assert!(matches!(ended, Some(Ok(Ok(())))));
            }
        }
    }

    fn resident_kb() -> u64 {
        let text = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
        line.unwrap().parse().unwrap()
    }

    /// Half a second for an absent daemon, and as much for a busy machine.
    const SOON: Duration = Duration::from_secs(2);

    /// A foreign page's name may resolve to this machine, and its script would read the answer.
    #[test]
    fn a_scrape_that_names_another_machine_is_refused() {
        let served = Served::start("host");
        for host in ["Host: evil.example\r\n", "Host: 192.168.1.2:9464\r\n", ""] {
            let mut stream = served.connect();
            write!(stream, "GET /metrics HTTP/1.1\r\n{host}\r\n").unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            assert!(text.starts_with("HTTP/1.1 421") && !text.contains("roomcast_"), "{host:?}: {text}");
        }
        served.scrape();
    }

    #[test]
    fn idle_connections_keep_no_scrape_out() {
        let served = Served::start("idle");
        let mut idle: Vec<_> = (0..110).map(|_| served.connect()).collect();
        assert!(served.scrape() < SOON);
        // Accepted connections are closed after their timeout, the others at once.
        for stream in &mut idle {
            let mut nothing = Vec::new();
            let _reset = stream.read_to_end(&mut nothing);
            assert!(nothing.is_empty());
        }
        assert!(served.scrape() < SOON);
    }

    #[test]
    fn a_header_without_end_is_refused_and_takes_no_memory() {
        let served = Served::start("header");
        let line = format!("X-Filler: {}\r\n", "x".repeat(1000));
        for (start, more, all) in [
            ("X-Filler: ", "x".repeat(1 << 16), 300 << 20),
            ("", line, 60 << 20),
            ("Range: ", "1".repeat(99), 60 << 20),
        ] {
            let before = resident_kb();
            let mut stream = served.connect();
            let _gone = write!(stream, "GET /metrics HTTP/1.1\r\nHost: localhost\r\n{start}");
            let mut written = 0;
            while written < all && stream.write_all(more.as_bytes()).is_ok() {
                written += more.len();
            }
            let kilobytes = resident_kb().saturating_sub(before);
            assert!(written < all, "it reads on for {written} bytes");
            assert!(kilobytes < 32 << 10, "{kilobytes} kB");
            assert!(served.scrape() < SOON);
        }
    }

    #[test]
    fn one_connection_has_one_answer_however_many_requests_it_sends() {
        let served = Served::start("pipelined");
        let request = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n";
        let mut stream = served.connect();
        let _gone = stream.write_all(&request.repeat(1000));
        assert!(served.scrape() < SOON);
        let mut text = Vec::new();
        let _reset = stream.read_to_end(&mut text);
        let answers = String::from_utf8_lossy(&text).matches("HTTP/1.1 ").count();
        assert!(answers <= 1, "{answers}");
    }

    #[test]
    fn a_connection_that_dawdles_is_closed() {
        let served = Served::start("slow");
        let mut stream = served.connect();
        let start = Instant::now();
        // A byte now and then never makes a request.
        while start.elapsed() < 2 * REQUEST_TIME && stream.write_all(b"G").is_ok() {
            std::thread::sleep(TICK);
        }
        assert!(start.elapsed() < REQUEST_TIME + SOON);
    }

    #[test]
    fn any_bytes_are_survived() {
        let served = Served::start("bytes");
        let mut rng = ChaCha8Rng::seed_from_u64(22);
        let words: [&[u8]; 12] = [
            b"GET ",
            b"POST ",
            b"/metrics",
            b" HTTP/1.1",
            b"\r\n",
            b"\r\n\r\n",
            b"Host: x",
            b"Content-Length: ",
            b"99999999999",
            b"Transfer-Encoding: chunked",
            b"\0\xff",
            b"ffffffff\r\n",
        ];
        for _ in 0..300 {
            let mut stream = served.connect();
            let mut bytes: Vec<u8> = Vec::new();
            for _ in 0..rng.random_range(0..40) {
                bytes.extend(*words.choose(&mut rng).unwrap());
            }
            for _ in 0..rng.random_range(0..3) {
                bytes.push(rng.random());
            }
            let _gone = stream.write_all(&bytes);
        }
        assert!(served.scrape() < SOON);
    }
}
