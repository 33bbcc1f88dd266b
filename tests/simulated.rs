//! Narrators, daemon and planner in one process, without threads, clock or shared memory: a seed decides what is said, what runs
//! when, what the transport drops, delays, doubles and reorders, and who is killed. After every step the invariants are checked:
//!
//! - every narration that was accepted is in the history, also after a restart, and none is in it twice;
//! - scores are those of exactly the narration that they contain, and claim no other;
//! - each person's scores are those that they would have alone, and all together say where somebody is;
//! - scores and forecasts are of one map, the one that the last good step scored, also when steps fail after a change;
//! - a restarted daemon believes everybody about where they were;
//! - no decision rests on scores past their deadline;
//! - the coverage-aware planner never waits while a room that it has to do is free;
//! - where the transport is faithful, all that living narrators say is confirmed in the end.
//!
//! The processes are the product's own: [`Account`], [`Intake`], [`Cycle`] with [`Board`], the journal's records, [`Planner`].
//! `ROOMCAST_SEEDS=10000` runs as many seeds, `ROOMCAST_SEED=17` the one, with a trace of its last steps when it fails.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a panic in a test is the report")]

use std::cell::Cell;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::rc::Rc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use roomcast_core::forecast::{ForecastOptions, Forecaster, Mentions};
use roomcast_core::grounding::{Grounding, GroundingOptions, PartitionLevel};
use roomcast_core::label_trie::TokenTree;
use roomcast_core::narration::{HistoryLimits, Observation};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::policy::PolicyName;
use roomcast_core::scorer::table::TableModel;
use roomcast_core::scorer::{DecodeStats, LanguageModel, ModelError, ModelInfo, TextStart, Token};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::{
    ForecastV1, NarrationV1, RoomScoresV1, action, decision_flags, forecast_flags, narration_kind, score_flags,
};
use roomcast_services::config::{IntakeLimits, PlannerConfig};
use roomcast_services::daemon::{Board, Cycle, Entry, Intake, Recovered, Taken, journal};
use roomcast_services::narrator::{Account, Item};
use roomcast_services::planner::Planner;

const MS: u64 = 1_000_000;
const SEEDS: u64 = 1000;
const STEPS: usize = 400;
const HEARTBEAT_NS: u64 = 100 * MS;
const DEADLINE_MS: u64 = 400;
const NARRATORS: usize = 2;
/// What the narration service keeps for a subscriber that joins, and the room scores' buffer.
const HISTORY: usize = 32;
const BUFFER: usize = 2;
const GROUNDING: GroundingOptions = GroundingOptions { level: PartitionLevel::Room, room_labels: false };
const BOOT: [u8; 16] = [7; 16];
const SCENE: &str = r#"{"format": "roomcast-scene", "version": 1, "name": "two", "rooms": [
  {"id": "a", "label": "a", "box": {"min_m": [0, 0, 0], "max_m": [1, 1, 1]}},
  {"id": "b", "label": "b", "box": {"min_m": [1, 0, 0], "max_m": [2, 1, 1]}}], "items": [
  {"id": "1", "label": "pan", "position_m": [0.5, 0.5, 0.5], "box": {"min_m": [0, 0, 0], "max_m": [0.5, 0.5, 0.5]}},
  {"id": "2", "label": "pad", "position_m": [1.5, 0.5, 0.5], "box": {"min_m": [1.5, 0, 0], "max_m": [1.8, 0.5, 0.5]}}]}"#;

/// The same map with a room and a thing more.
const LARGER_SCENE: &str = r#"{"format": "roomcast-scene", "version": 1, "name": "three", "rooms": [
  {"id": "a", "label": "a", "box": {"min_m": [0, 0, 0], "max_m": [1, 1, 1]}},
  {"id": "b", "label": "b", "box": {"min_m": [1, 0, 0], "max_m": [2, 1, 1]}},
  {"id": "c", "label": "c", "box": {"min_m": [2, 0, 0], "max_m": [3, 1, 1]}}], "items": [
  {"id": "1", "label": "pan", "position_m": [0.5, 0.5, 0.5], "box": {"min_m": [0, 0, 0], "max_m": [0.5, 0.5, 0.5]}},
  {"id": "2", "label": "pad", "position_m": [1.5, 0.5, 0.5], "box": {"min_m": [1.5, 0, 0], "max_m": [1.8, 0.5, 0.5]}},
  {"id": "3", "label": "pen", "position_m": [2.5, 0.5, 0.5], "box": {"min_m": [2.5, 0, 0], "max_m": [2.8, 0.5, 0.5]}}]}"#;
/// A fault planted into the system, which the invariants must find.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Planted {
    Nothing,
    /// The intake forgets what it took.
    NoDeduplication,
    /// The planner accepts scores of any age.
    NoDeadline,
    /// Damage on the disk goes unnoticed, as without a checksum: the checksum is made to fit it.
    NoChecksum,
    /// Scores claim narration that the journal does not hold yet.
    ClaimsBeforeJournal,
    /// A restarted daemon does not read its journal.
    NoJournal,
    /// A restarted daemon reads the journal into the history and not into the intake.
    NoDeduplicationAfterRestart,
    /// A restarted daemon does not know when its narration was observed.
    NoTimesAfterRestart,
    /// The transport shows the rooms of a changed map before there are scores of it.
    MapBeforeScores,
}

/// A model whose scores depend on every token of the prompt, so that one narration more or less shows. Fails when told to.
#[derive(Debug)]
struct WholePrompt {
    table: TableModel,
    failures: Rc<Cell<u32>>,
}

impl WholePrompt {
    fn new(failures: &Rc<Cell<u32>>) -> Self {
        Self { table: TableModel::new(0), failures: Rc::clone(failures) }
    }
}

impl LanguageModel for WholePrompt {
    fn info(&self) -> &ModelInfo {
        self.table.info()
    }

    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
        self.table.tokenise(text, start, out)
    }

    fn token_text(&self, token: Token) -> String {
        self.table.token_text(token)
    }

    fn forget(&mut self) {}

    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError> {
        if self.failures.get() > 0 {
            self.failures.set(self.failures.get() - 1);
            return Err(ModelError::Decode { tokens: prompt.len(), reason: "told to fail".to_owned() });
        }
        let mix = |hash: u64, token: &Token| (hash ^ u64::from(token.0.cast_unsigned())).wrapping_mul(0x100_0000_01b3);
        let seed = prompt.iter().fold(0xcbf2_9ce4_8422_2325, mix);
        TableModel::new(seed).decode(prompt, tree, want_prompt_row, visit)
    }

    fn tidy(&mut self, _keep: usize) {}
}

/// Where the daemon's pieces are between two steps.
struct Daemon {
    intake: Intake,
    cycle: Cycle<WholePrompt>,
    /// From the ear to the scoring loop.
    queue: VecDeque<(Entry, u64)>,
    /// From the ear to the journal's writer.
    records: VecDeque<Vec<u8>>,
    appended: u64,
    written: u64,
    /// Stopped until then, as by SIGSTOP.
    hung_ns: u64,
    /// How many of the accepted observations the cycle has entered, and the scores contain.
    entered: usize,
    scored: usize,
    /// Which of the maps is in use, and which one the scores are of.
    map: usize,
    scored_map: usize,
    /// No scores were sent since the start.
    restarted: bool,
}

struct Narrator {
    name: String,
    account: Account,
    /// What the service keeps for a daemon that joins.
    history: VecDeque<NarrationV1>,
    wire: VecDeque<NarrationV1>,
    scores: VecDeque<RoomScoresV1>,
}

struct Robot {
    planner: Planner,
    scores: VecDeque<RoomScoresV1>,
    /// Per scores, when the newest message of them that arrived was sent, and whether it said that the scorer had failed.
    heard: BTreeMap<(u64, u64), (u64, bool, u64)>,
    /// The newest forecast: in each room the same chance at all times.
    forecast: ForecastV1,
    free: bool,
}

struct World {
    rng: ChaCha8Rng,
    planted: Planted,
    /// Whether the transport is iceoryx2's: in order, nothing lost between living participants.
    faithful: bool,
    persons: u32,
    maps: [SemanticMap; 2],
    options: PipelineOptions,
    failures: Rc<Cell<u32>>,
    now_ns: u64,
    epochs: u64,
    said: u64,
    daemon: Option<Daemon>,
    narrators: Vec<Narrator>,
    robot: Robot,
    last_sent: Option<RoomScoresV1>,
    /// Nobody is killed any more.
    calm: bool,
    disk: Vec<u8>,
    /// What must be in the history, in order.
    accepted: Vec<Observation>,
    taken: BTreeSet<(u64, u64, u64)>,
    /// What damage to the journal took, which may be lost, and be taken again.
    damaged: BTreeSet<(u64, u64, u64)>,
    /// What scores were sent that contain and claim it: its narrator may have forgotten it.
    claimed: BTreeSet<(u64, u64, u64)>,
    trace: VecDeque<String>,
    tally: Tally,
}

/// What happened, to see that the seeds reach what they are to test.
#[derive(Debug, Default, Clone, Copy)]
struct Tally {
    accepted: u64,
    duplicates: u64,
    missed: u64,
    malformed: u64,
    scored: u64,
    held_back: u64,
    failed: u64,
    decisions: u64,
    fallbacks: u64,
    planned: u64,
    daemon_kills: u64,
    torn: u64,
    damaged: u64,
    several: u64,
    map_changes: u64,
    restored: u64,
}

type Check = Result<(), String>;

fn ensure(holds: bool, what: impl FnOnce() -> String) -> Check {
    if holds { Ok(()) } else { Err(what()) }
}

impl World {
    fn new(seed: u64, planted: Planted) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let persons = rng.random_range(1..=2);
        // With two persons the window is exact, so that the oracle need not know when it was compacted.
        let slack = if persons == 1 { rng.random_range(0..4) } else { 0 };
        let history = HistoryLimits { observations: rng.random_range(1..6), slack, tokens: 1024 };
        let mut world = Self {
            planted,
            faithful: rng.random_bool(0.5),
            persons,
            maps: [SCENE, LARGER_SCENE].map(|scene| SemanticMap::from_json(scene).unwrap()),
            options: PipelineOptions { history, ..Default::default() },
            failures: Rc::default(),
            now_ns: 1_000 * MS,
            epochs: 0,
            said: 0,
            daemon: None,
            narrators: Vec::new(),
            robot: Robot {
                planner: Planner::new(&PlannerConfig::default(), 1),
                scores: VecDeque::new(),
                heard: BTreeMap::new(),
                forecast: ForecastV1::default(),
                free: true,
            },
            last_sent: None,
            calm: false,
            disk: Vec::new(),
            accepted: Vec::new(),
            taken: BTreeSet::new(),
            damaged: BTreeSet::new(),
            claimed: BTreeSet::new(),
            trace: VecDeque::new(),
            tally: Tally::default(),
            rng,
        };
        for number in 0..NARRATORS {
            let name = format!("narrator-{number}");
            let account = Account::new(&name, world.epoch());
            let (history, wire, scores) = Default::default();
            world.narrators.push(Narrator { name, account, history, wire, scores });
        }
        world.start_planner();
        world
    }

    fn epoch(&mut self) -> u64 {
        self.epochs += 1;
        self.epochs
    }

    fn note(&mut self, what: impl FnOnce() -> String) {
        if self.trace.len() == 60 {
            self.trace.pop_front();
        }
        let line = format!("{:>7.3} s  {}", self.now_ns as f64 / 1e9, what());
        self.trace.push_back(line);
    }

    fn pipeline(&self, map: usize, history: HistoryLimits, failures: &Rc<Cell<u32>>) -> Pipeline<WholePrompt> {
        let grounding = Grounding::new(&self.maps[map], &GROUNDING).unwrap();
        let options = PipelineOptions { history, ..self.options.clone() };
        Pipeline::new(WholePrompt::new(failures), grounding, options).unwrap()
    }

    /// One step of whoever the seed chooses.
    fn step(&mut self) -> Check {
        self.now_ns += self.rng.random_range(0..8 * MS);
        match self.rng.random_range(0..1000) {
            0..200 => self.narrate(),
            200..400 => return self.ingest(),
            400..500 => self.write(),
            500..680 => return self.score(),
            680..780 => self.confirm(),
            780..960 => return self.plan(),
            960..970 => self.now_ns += self.rng.random_range(0..600) * MS,
            970..976 => self.hang(),
            976..979 => self.failures.set(self.rng.random_range(1..4)),
            979..981 => self.change_map(),
            981..988 => return self.kill_daemon(),
            988..992 => self.kill_narrator(),
            992..995 => self.start_planner(),
            _ => return self.start_daemon(),
        }
        Ok(())
    }

    fn narrate(&mut self) {
        let who = self.rng.random_range(0..self.narrators.len());
        if !self.narrators[who].account.may_send() {
            return;
        }
        self.said += 1;
        let (kind, text) = match self.rng.random_range(0..3) {
            0 => (narration_kind::ACTION, format!("[Grab] <thing_{}> (1)", self.said)),
            1 => (narration_kind::DEVICE, format!("the lamp {} is on", self.said)),
            _ => {
                let thing = ["pan", "pad", "pen"][self.rng.random_range(0..3)];
                (narration_kind::SENTENCE, format!("They do thing {} with the {thing}.", self.said))
            }
        };
        let person = self.rng.random_range(0..self.persons);
        let item = Item { kind, text, person, duration_s: 0.0 };
        let now_ns = self.now_ns;
        let narrator = &mut self.narrators[who];
        let message = narrator.account.next(&item, now_ns, now_ns).unwrap();
        if narrator.history.len() == HISTORY {
            narrator.history.pop_front();
        }
        narrator.history.push_back(message);
        // Without a subscriber a message goes nowhere but into the history.
        if self.daemon.is_some() {
            self.narrators[who].wire.push_back(message);
        }
        self.note(|| format!("narrator {who} says {}: {:?}", message.sequence, message.text()));
    }

    /// The next message of some narrator's wire, as the transport gives it.
    fn delivered(&mut self) -> Option<NarrationV1> {
        let who = self.rng.random_range(0..self.narrators.len());
        let wire = &mut self.narrators[who].wire;
        if self.faithful || wire.is_empty() {
            return wire.pop_front();
        }
        let place = if self.rng.random_bool(0.2) { self.rng.random_range(0..wire.len()) } else { 0 };
        let message = wire.remove(place)?;
        match self.rng.random_range(0..10) {
            0 => None,
            1 => {
                wire.push_back(message);
                Some(message)
            }
            2 => Some(NarrationV1 { text_bytes: self.rng.random(), ..message }),
            _ => Some(message),
        }
    }

    fn awake(&self) -> bool {
        self.daemon.as_ref().is_some_and(|daemon| self.now_ns >= daemon.hung_ns)
    }

    /// What the daemon's ear does with one message.
    fn ingest(&mut self) -> Check {
        if !self.awake() {
            return Ok(());
        }
        let Some(message) = self.delivered() else { return Ok(()) };
        let now_ns = self.now_ns;
        let Some(daemon) = &mut self.daemon else { return Ok(()) };
        if self.planted == Planted::NoDeduplication {
            daemon.intake = Intake::new(IntakeLimits::default());
        }
        let checked = roomcast_ipc::Message::check(&message).map(|()| &message);
        let taken = daemon.intake.receive(checked, now_ns);
        let counted = daemon.intake.counters();
        ensure(
            counted.received == counted.accepted + counted.duplicates + counted.limited + counted.malformed,
            || format!("the counters do not add up: {counted:?}"),
        )?;
        match taken {
            Taken::Accepted { observation, missed } => {
                daemon.appended += 1;
                daemon.records.push_back(journal::encode(&observation, &BOOT));
                let entry = Entry { observation: observation.clone(), received_ns: now_ns, after_gap: missed > 0 };
                daemon.queue.push_back((entry, daemon.appended));
                self.tally.accepted += 1;
                self.tally.missed += missed;
                let name = (observation.source, observation.epoch, observation.sequence);
                ensure(self.taken.insert(name), || format!("taken twice: {name:?}"))?;
                // Damage to the journal may have taken a narration that nobody sends again.
                let lost = self.faithful && missed > self.damaged.len() as u64;
                ensure(!lost, || format!("lost on a faithful transport: {missed} before {name:?}"))?;
                self.accepted.push(observation);
                self.note(|| format!("daemon accepts {name:?}"));
            }
            Taken::Duplicate => self.tally.duplicates += 1,
            Taken::Malformed(_) => self.tally.malformed += 1,
            Taken::Limited => {}
        }
        Ok(())
    }

    /// The journal's writer hands some records to the system.
    fn write(&mut self) {
        if !self.awake() {
            return;
        }
        let Some(daemon) = &mut self.daemon else { return };
        let count = self.rng.random_range(0..=daemon.records.len());
        for record in daemon.records.drain(..count) {
            self.disk.extend_from_slice(&record);
            daemon.written += 1;
        }
    }

    /// The map in use is changed, and the steps after it may fail.
    fn change_map(&mut self) {
        if !self.awake() {
            return;
        }
        let failures = self.rng.random_range(0..4);
        let Some(daemon) = &mut self.daemon else { return };
        daemon.map = 1 - daemon.map;
        daemon.cycle.board_mut().change_map(self.maps[daemon.map].clone()).unwrap();
        daemon.cycle.score_again();
        self.failures.set(failures);
        self.tally.map_changes += 1;
        self.note(|| format!("the map changes; the next {failures} steps fail"));
    }

    /// What the daemon's scoring thread does in one round.
    fn score(&mut self) -> Check {
        if !self.awake() {
            return Ok(());
        }
        let (now_ns, failing) = (self.now_ns, self.failures.get() > 0);
        let Some(daemon) = &mut self.daemon else { return Ok(()) };
        let contained = daemon.entered + daemon.queue.len();
        for (entry, record) in daemon.queue.drain(..) {
            daemon.cycle.enter(entry, record);
        }
        daemon.entered = contained;
        if daemon.cycle.step_due(now_ns) {
            match daemon.cycle.step(now_ns, now_ns) {
                Ok(()) => {
                    daemon.scored = contained;
                    daemon.scored_map = daemon.map;
                    self.tally.scored += 1;
                }
                Err(error) => {
                    ensure(failing, || format!("scoring failed: {error}"))?;
                    self.tally.failed += 1;
                }
            }
        }
        // The loop waits for the journal a moment; mostly that is enough.
        if self.rng.random_bool(0.8) {
            while let Some(record) = daemon.records.pop_front() {
                self.disk.extend_from_slice(&record);
                daemon.written += 1;
            }
        }
        let written = if self.planted == Planted::ClaimsBeforeJournal { u64::MAX } else { daemon.written };
        let mut message = daemon.cycle.message(now_ns, written, self.rng.random_bool(0.1)).copied();
        if self.planted == Planted::MapBeforeScores
            && let Some(message) = &mut message
        {
            message.map_fingerprint = daemon.cycle.board().map().fingerprint();
        }
        self.tally.held_back += u64::from(message.is_some() && written < daemon.cycle.scored_record());
        if self.rng.random_bool(0.3) {
            daemon.cycle.tidy();
        }
        let Some(message) = message else { return Ok(()) };
        self.check_scores(&message)?;
        self.check_persons(&message)?;
        self.check_restored()?;
        self.note(|| format!("daemon sends {} with {} claims", message.sequence, message.source_count));
        if !self.calm && self.rng.random_bool(0.01) {
            // Killed in the middle of a publish: some subscribers have it, some have not.
            if self.rng.random_bool(0.5) {
                self.sent(&message, 1);
            }
            return self.kill_daemon();
        }
        self.sent(&message, usize::MAX);
        self.last_sent = Some(message);
        Ok(())
    }

    /// Puts scores into the buffers of the first `subscribers`.
    fn sent(&mut self, message: &RoomScoresV1, subscribers: usize) {
        let scored = self.daemon.as_ref().map_or(0, |daemon| daemon.scored);
        let covers = |o: &&Observation| {
            let claim = message.included().iter().find(|claim| (claim.source, claim.epoch) == (o.source, o.epoch));
            claim.is_some_and(|claim| o.sequence <= claim.sequence)
        };
        let claimed = self.accepted[..scored].iter().filter(covers);
        self.claimed.extend(claimed.map(|o| (o.source, o.epoch, o.sequence)));
        let buffers = self.narrators.iter_mut().map(|narrator| &mut narrator.scores).chain([&mut self.robot.scores]);
        for buffer in buffers.take(subscribers) {
            // The transport delays; it keeps the newest.
            if self.faithful || self.rng.random_bool(0.9) {
                buffer.push_back(*message);
                if buffer.len() > BUFFER {
                    buffer.pop_front();
                }
            }
        }
    }

    /// Scores equal those of exactly what they contain, and claim nothing beyond it.
    fn check_scores(&mut self, message: &RoomScoresV1) -> Check {
        let daemon = self.daemon.as_ref().unwrap();
        let contained = &self.accepted[..daemon.scored];
        for claim in message.included() {
            let newest = contained.iter().rev().find(|o| o.source == claim.source);
            let holds = newest.is_some_and(|o| o.epoch != claim.epoch || claim.sequence <= o.sequence)
                && contained.iter().any(|o| (o.epoch, o.sequence) == (claim.epoch, claim.sequence));
            ensure(holds, || format!("scores {} claim {claim:?}, which they do not contain", message.sequence))?;
        }
        // With a window that is cut now and then, the message says how much of the past it holds.
        let (shown, history) = if self.persons == 1 {
            let window = usize::try_from(message.window).unwrap_or(usize::MAX);
            ensure(window <= contained.len(), || format!("a window of {window} of {} narrations", contained.len()))?;
            (&contained[contained.len() - window..], HistoryLimits { observations: 1000, ..self.options.history })
        } else {
            (contained, self.options.history)
        };
        let fingerprint = self.maps[daemon.scored_map].fingerprint();
        ensure(message.map_fingerprint == fingerprint, || format!("scores {} of another map", message.sequence))?;
        let mut oracle = self.pipeline(daemon.scored_map, history, &Rc::default());
        let expected = oracle.step(shown.iter().cloned()).unwrap();
        let rooms = expected.grounded.partition_log_score_nats.len();
        ensure(message.rooms().len() == rooms, || format!("scores {} of other rooms", message.sequence))?;
        for (room, expected) in message.rooms().iter().zip(&expected.grounded.partition_log_score_nats) {
            ensure((room.log_score_nats - expected).abs() < 1e-9, || {
                format!(
                    "scores {} are not those of the {} narrations they contain: {} has {}, which is {expected}",
                    message.sequence,
                    contained.len(),
                    room.id(),
                    room.log_score_nats
                )
            })?;
        }
        // Every accepted narration that was entered is in the histories, as far as their windows reach.
        let entered = &self.accepted[..daemon.entered];
        for (person, history) in daemon.cycle.board().pipeline().histories().iter() {
            let expected = entered.iter().filter(|o| o.person == person).rev();
            let held = history.observations().rev();
            ensure(held.zip(expected).all(|(held, expected)| held == expected), || {
                format!("the history of person {person} lacks accepted narration")
            })?;
        }
        Ok(())
    }

    /// Each person's scores are those that they would have alone.
    fn check_persons(&mut self, message: &RoomScoresV1) -> Check {
        let (now_ns, history) = (self.now_ns, HistoryLimits { observations: 1000, ..self.options.history });
        let Some(daemon) = &mut self.daemon else { return Ok(()) };
        let told = *daemon.cycle.board_mut().persons(now_ns);
        let forecast = *daemon.cycle.board_mut().forecast(now_ns);
        let (map, scored) = (daemon.scored_map, daemon.scored);
        ensure((told.epoch, told.sequence) == (message.epoch, message.sequence), || {
            "persons of other scores".to_owned()
        })?;
        ensure(forecast.room_count == message.room_count, || "a forecast of other rooms".to_owned())?;
        let contained = &self.accepted[..scored];
        let mut nobody = vec![1.0; message.rooms().len()];
        for person in told.persons() {
            let own: Vec<_> = contained.iter().filter(|o| o.person == person.person).collect();
            let window = usize::try_from(person.window).unwrap_or(usize::MAX).min(own.len());
            let mut oracle = self.pipeline(map, history, &Rc::default());
            let alone = oracle.step(own[own.len() - window..].iter().copied().cloned()).unwrap();
            for ((told, alone), nobody) in
                person.probability.iter().zip(&alone.grounded.partition_probability).zip(&mut nobody)
            {
                ensure((told - alone).abs() < 1e-9, || {
                    format!("scores {}: person {} has {told}, alone {alone}", message.sequence, person.person)
                })?;
                *nobody *= 1.0 - told;
            }
        }
        if !told.persons().is_empty() {
            for (room, nobody) in message.rooms().iter().zip(nobody) {
                ensure((room.probability - (1.0 - nobody)).abs() < 1e-12, || {
                    format!("scores {}: somebody is in {} with {}", message.sequence, room.id(), room.probability)
                })?;
            }
        }
        self.tally.several += u64::from(told.persons().len() > 1);
        Ok(())
    }

    /// A restarted daemon's first forecast is that of all the narration that its scores contain, with its times.
    fn check_restored(&mut self) -> Check {
        let now_ns = self.now_ns;
        let Some(daemon) = &mut self.daemon else { return Ok(()) };
        // Where the map was changed meanwhile, the histories alone are understood by it.
        if !std::mem::take(&mut daemon.restarted) || daemon.scored_map != 0 {
            return Ok(());
        }
        let contained = &self.accepted[..daemon.scored];
        let forecast = *daemon.cycle.board_mut().forecast(now_ns);
        ensure(forecast.has(forecast_flags::NOT_KNOWN) == contained.is_empty(), || {
            format!("the first forecast after a start has the flags {}", forecast.flags)
        })?;
        if contained.is_empty() {
            return Ok(());
        }
        let grounding = Grounding::new(&self.maps[0], &GROUNDING).unwrap();
        let mut mentions = Mentions::new(&self.maps[0], &grounding);
        let rooms = grounding.partitions().len();
        let mut nobody = vec![1.0; rooms];
        for person in daemon.cycle.board_mut().persons(now_ns).persons() {
            let own: Vec<_> = contained.iter().filter(|o| o.person == person.person).collect();
            let at_s = |o: &Observation| o.observed_ns as f64 / 1e9;
            let mut forecaster = Forecaster::new(rooms, ForecastOptions::default(), at_s(own[0]));
            for observation in own {
                let mention = mentions.last(observation.sentence.as_str());
                forecaster.observe(at_s(observation), mention, &grounding, &[]);
            }
            forecaster.expect(&person.probability[..rooms]);
            let at = forecaster.at(now_ns as f64 / 1e9, 0.0);
            nobody.iter_mut().zip(at).for_each(|(nobody, p)| *nobody *= 1.0 - p);
        }
        for (own, nobody) in forecast.probability.iter().zip(nobody) {
            ensure((f64::from(own[0]) - (1.0 - nobody)).abs() < 1e-5, || {
                format!("after a restart a room is occupied with {}, by the narration with {}", own[0], 1.0 - nobody)
            })?;
        }
        self.tally.restored += 1;
        Ok(())
    }

    fn confirm(&mut self) {
        let who = self.rng.random_range(0..self.narrators.len());
        let narrator = &mut self.narrators[who];
        if let Some(scores) = narrator.scores.pop_front() {
            narrator.account.confirm(&scores);
        }
    }

    fn hang(&mut self) {
        let until_ns = self.now_ns + self.rng.random_range(0..1500) * MS;
        if let Some(daemon) = &mut self.daemon {
            daemon.hung_ns = until_ns;
            self.note(|| "daemon hangs".to_owned());
        }
    }

    fn kill_daemon(&mut self) -> Check {
        let Some(daemon) = self.daemon.take() else { return Ok(()) };
        self.tally.daemon_kills += 1;
        // The record that was being written may be torn.
        if let Some(record) = daemon.records.front()
            && self.rng.random_bool(0.5)
        {
            self.disk.extend_from_slice(&record[..self.rng.random_range(0..record.len())]);
            self.tally.torn += 1;
        }
        // What the journal did not get is lost, and may be: nothing claimed it, so its narrator still has it.
        let kept = self.accepted.len() - daemon.records.len();
        for lost in self.accepted.split_off(kept) {
            let name = (lost.source, lost.epoch, lost.sequence);
            ensure(!self.claimed.contains(&name), || {
                format!("{name:?} was accepted and claimed, and did not survive the daemon")
            })?;
            self.taken.remove(&name);
        }
        for narrator in &mut self.narrators {
            narrator.wire.clear();
        }
        self.note(|| "daemon killed".to_owned());
        if self.rng.random_bool(0.15) {
            self.damage_disk();
        }
        Ok(())
    }

    /// One bit of the journal flips while nobody runs. The narration it belonged to is lost, and nothing else.
    fn damage_disk(&mut self) {
        if self.disk.is_empty() {
            return;
        }
        let at = self.rng.random_range(0..self.disk.len());
        self.disk[at] ^= 1 << self.rng.random_range(0..8);
        self.tally.damaged += 1;
        self.note(|| format!("byte {at} of the journal is damaged"));
        if self.planted == Planted::NoChecksum {
            seal(&mut self.disk);
        }
    }

    fn start_daemon(&mut self) -> Check {
        if self.daemon.is_some() {
            return Ok(());
        }
        let pipeline = self.pipeline(0, self.options.history, &self.failures);
        let board = Board::new(pipeline, self.maps[0].clone(), GROUNDING, self.epoch()).unwrap();
        let mut cycle = Cycle::new(board, HEARTBEAT_NS);
        let mut intake = Intake::new(IntakeLimits::default());
        let mut recovered = Recovered::default();
        if self.planted != Planted::NoJournal {
            journal::read_records(&self.disk, &BOOT, &mut recovered);
        }
        self.note(|| format!("daemon starts with {} narrations", recovered.observations.len()));
        self.check_recovered(&recovered)?;
        self.accepted.clone_from(&recovered.observations);
        let (entered, scored) = (self.accepted.len(), self.accepted.len());
        let mut forgetful = Intake::new(IntakeLimits::default());
        let known = if self.planted == Planted::NoDeduplicationAfterRestart { &mut forgetful } else { &mut intake };
        if self.planted == Planted::NoTimesAfterRestart {
            (recovered.observations.iter_mut()).for_each(|o| (o.observed_ns, o.observed_unix_ns) = (0, 0));
        }
        cycle.restore(recovered.observations, known, self.now_ns, self.now_ns);
        let (queue, records) = Default::default();
        self.daemon = Some(Daemon {
            intake,
            cycle,
            queue,
            records,
            appended: 0,
            written: 0,
            hung_ns: 0,
            entered,
            scored,
            map: 0,
            scored_map: 0,
            restarted: true,
        });
        for narrator in &mut self.narrators {
            narrator.wire = narrator.history.clone();
        }
        Ok(())
    }

    /// What comes back is what was accepted, but for what the damaged bytes held, and nothing that was never said.
    fn check_recovered(&mut self, recovered: &Recovered) -> Check {
        let mut back = recovered.observations.iter().peekable();
        let mut lost = Vec::new();
        for accepted in &self.accepted {
            if back.next_if(|o| *o == accepted).is_none() {
                lost.push((accepted.source, accepted.epoch, accepted.sequence));
            }
        }
        ensure(back.peek().is_none(), || format!("the journal gives back what was never accepted: {:?}", back.peek()))?;
        // Damage happens while the daemon is down; each flips a single bit.
        let damages = self.tally.damaged as usize;
        ensure(lost.len() <= damages, || format!("{} narrations missing from the history: {lost:?}", lost.len()))?;
        for name in lost {
            self.taken.remove(&name);
            self.claimed.remove(&name);
            self.damaged.insert(name);
        }
        Ok(())
    }

    fn kill_narrator(&mut self) {
        let who = self.rng.random_range(0..self.narrators.len());
        let epoch = self.epoch();
        let reached = self.rng.random_range(0..=self.narrators[who].wire.len());
        let narrator = &mut self.narrators[who];
        narrator.account = Account::new(&narrator.name, epoch);
        narrator.history.clear();
        // What was sent and not received dies with its sender, from some message on.
        narrator.wire.truncate(reached);
        narrator.scores.clear();
        narrator.scores.extend(self.last_sent.filter(|_| self.daemon.is_some()));
        self.note(|| format!("narrator {who} restarts with epoch {epoch}"));
    }

    fn start_planner(&mut self) {
        let room_time_s = self.rng.random_range(0.0..0.3);
        let config = PlannerConfig {
            policy: PolicyName::ALL[self.rng.random_range(0..PolicyName::ALL.len())],
            seed: self.rng.random(),
            room_time_s,
            round_s: self.rng.random_bool(0.5).then(|| room_time_s * self.rng.random_range(1.0..5.0)),
            deadline_ms: if self.planted == Planted::NoDeadline { 1 << 40 } else { DEADLINE_MS },
            ..Default::default()
        };
        let planner = Planner::new(&config, self.epoch());
        let scores = self.last_sent.filter(|_| self.daemon.is_some()).into_iter().collect();
        self.robot = Robot { planner, scores, heard: BTreeMap::new(), forecast: ForecastV1::default(), free: true };
        self.note(|| "planner starts".to_owned());
    }

    /// What the planner does in one round.
    fn plan(&mut self) -> Check {
        let now_ns = self.now_ns;
        let robot = &mut self.robot;
        while let Some(scores) = robot.scores.pop_front() {
            robot.planner.take(&scores);
            let name = (scores.epoch, scores.sequence);
            let heard = robot.heard.entry(name).or_default();
            if scores.published_ns >= heard.0 {
                *heard = (scores.published_ns, scores.has(score_flags::SCORER_FAILED), scores.computed_ns);
            }
            let mut forecast = ForecastV1 {
                epoch: scores.epoch,
                computed_ns: scores.published_ns,
                published_ns: scores.published_ns,
                room_count: scores.room_count,
                horizon_count: 1,
                ..ForecastV1::default()
            };
            for (room, score) in scores.rooms().iter().enumerate() {
                forecast.id[room] = score.id;
                forecast.probability[room][0] = [0.0, 0.5, 1.0][self.rng.random_range(0..3)];
            }
            robot.planner.take_forecast(&forecast);
            robot.forecast = forecast;
        }
        let free = now_ns >= robot.planner.free_ns();
        let Some(decision) = robot.planner.decide(now_ns, now_ns).unwrap() else { return Ok(()) };
        ensure(free, || "a decision of a robot that is not free".to_owned())?;
        let deadline_ns = DEADLINE_MS * MS;
        self.tally.decisions += 1;
        if decision.has(decision_flags::FALLBACK) {
            self.tally.fallbacks += 1;
            ensure(decision.action == action::STAY && decision.from == decision.to, || {
                format!("a fallback that moves the robot: {decision:?}")
            })?;
        } else {
            let name = (decision.scores_epoch, decision.scores_sequence);
            let heard = robot.heard.get(&name);
            let fresh = heard.is_some_and(|(sent_ns, failed, computed_ns)| {
                now_ns - sent_ns <= deadline_ns && (!failed || now_ns - computed_ns <= deadline_ns)
            });
            ensure(fresh, || format!("a decision on stale scores {name:?}: {heard:?} at {now_ns}"))?;
            let known = &robot.forecast;
            let planned = decision.policy() == PolicyName::CoverageAware.as_str()
                && decision.stay_ns > 0
                && known.epoch == decision.scores_epoch
                && now_ns - known.published_ns <= deadline_ns;
            let rooms = (0..known.room_count as usize).map(|room| (room, known.probability[room][0]));
            let mut to_do = rooms.filter(|(room, _)| decision.covered & (1 << room) == 0);
            let waits = || (0..64).any(|room| decision.covered & (1 << room) != 0 && known.id[room] == decision.to);
            let put_off = planned && to_do.any(|(_, probability)| probability == 0.0) && waits();
            ensure(!put_off, || format!("free work is put off: {decision:?}"))?;
            self.tally.planned += u64::from(planned);
        }
        robot.free = !decision.has(decision_flags::FALLBACK);
        self.note(|| format!("planner decides {:?}: {}", decision.to(), decision.reason()));
        Ok(())
    }

    /// Faults cease; on a faithful transport everything that living narrators said is confirmed, and the robot is not held back.
    fn settle(&mut self) -> Check {
        self.calm = true;
        self.failures.set(0);
        self.start_daemon()?;
        for _ in 0..600 {
            self.now_ns += 5 * MS;
            self.ingest()?;
            self.write();
            self.score()?;
            self.confirm();
            self.plan()?;
        }
        if !self.faithful {
            return Ok(());
        }
        for (who, narrator) in self.narrators.iter().enumerate() {
            let under_way = narrator.account.under_way();
            ensure(under_way == 0, || format!("{under_way} narrations of narrator {who} are never confirmed"))?;
        }
        ensure(self.robot.free, || "the planner never leaves its fallback".to_owned())
    }
}

/// Makes every checksum of the journal fit what it holds, which is what a reader without checksums sees.
fn seal(disk: &mut [u8]) {
    let mut at = 0;
    while let Some(header) = disk.get(at..at + 12) {
        let length = u32::from_le_bytes(header[4..8].try_into().unwrap()) as usize;
        match disk.get(at + 12..at + 12 + length) {
            Some(payload) if header[..4] == *b"RCJ1" => {
                let checksum = crc32fast::hash(payload);
                disk[at + 8..at + 12].copy_from_slice(&checksum.to_le_bytes());
                at += 12 + length;
            }
            _ => at += 1,
        }
    }
}

/// Plays a seed; the error says what was violated, when, and what happened before.
fn play(seed: u64, planted: Planted) -> Result<Tally, String> {
    let mut world = World::new(seed, planted);
    let result = (0..STEPS)
        .try_for_each(|number| world.step().map_err(|what| format!("step {number}: {what}")))
        .and_then(|()| world.settle().map_err(|what| format!("after the faults: {what}")));
    match result {
        Ok(()) => Ok(world.tally),
        Err(what) => {
            let trace: Vec<_> = world.trace.iter().map(|line| format!("    {line}\n")).collect();
            Err(format!(
                "seed {seed}, {what}\n{}  again with: ROOMCAST_SEED={seed} cargo test --release --test simulated",
                trace.concat()
            ))
        }
    }
}

fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{variable} is {text:?}: give a number")))
}

#[test]
fn no_seed_violates_an_invariant() {
    let seeds = number("ROOMCAST_SEED").map_or(0..number("ROOMCAST_SEEDS").unwrap_or(SEEDS), |seed| seed..seed + 1);
    let played: Vec<_> = seeds.clone().into_par_iter().map(|seed| play(seed, Planted::Nothing)).collect();
    let mut total = Tally::default();
    let mut violated = Vec::new();
    for result in played {
        match result {
            Ok(tally) => {
                total.accepted += tally.accepted;
                total.duplicates += tally.duplicates;
                total.missed += tally.missed;
                total.malformed += tally.malformed;
                total.scored += tally.scored;
                total.held_back += tally.held_back;
                total.failed += tally.failed;
                total.decisions += tally.decisions;
                total.fallbacks += tally.fallbacks;
                total.planned += tally.planned;
                total.daemon_kills += tally.daemon_kills;
                total.torn += tally.torn;
                total.damaged += tally.damaged;
                total.several += tally.several;
                total.map_changes += tally.map_changes;
                total.restored += tally.restored;
            }
            Err(what) => {
                println!("{}", what.lines().next().unwrap_or_default());
                violated.push(what);
            }
        }
    }
    println!("{} seeds: {total:?}", seeds.end - seeds.start);
    assert!(violated.is_empty(), "{} seeds violate an invariant; the first:\n{}", violated.len(), violated[0]);
    if seeds.end - seeds.start >= 100 {
        // Seeds that reach none of this would prove nothing.
        for reached in [
            total.duplicates,
            total.missed,
            total.malformed,
            total.held_back,
            total.failed,
            total.fallbacks,
            total.planned,
        ] {
            assert!(reached > 0, "{total:?}");
        }
        assert!(total.several > 0 && total.map_changes > 0 && total.restored > 0, "{total:?}");
        assert!(total.torn > 0 && total.damaged > 0 && total.daemon_kills > 0, "{total:?}");
    }
}

#[test]
fn planted_faults_are_found() {
    for (planted, violation) in [
        (Planted::NoDeduplication, "taken twice"),
        (Planted::NoDeadline, "stale scores"),
        (Planted::NoChecksum, "never accepted"),
        (Planted::ClaimsBeforeJournal, "did not survive the daemon"),
        (Planted::NoJournal, "missing from the history"),
        (Planted::NoDeduplicationAfterRestart, "taken twice"),
        (Planted::NoTimesAfterRestart, "after a"),
        (Planted::MapBeforeScores, "of another map"),
    ] {
        let found = (0..500).into_par_iter().filter_map(|seed| play(seed, planted).err()).collect::<Vec<_>>();
        let as_expected = found.iter().filter(|what| what.lines().next().unwrap_or("").contains(violation)).count();
        println!("{planted:?}: found by {} of 500 seeds, by its own invariant by {as_expected}", found.len());
        assert!(as_expected > 0, "{planted:?}: {:?}", found.first());
    }
}
