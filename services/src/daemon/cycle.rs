//! The scoring loop without threads, ports, clock and disk: when to score, to retry and to send. Times and the state database's progress are
//! parameters, and messages are return values. So the daemon's threads and the simulation of faults (`tests/it/simulated.rs`) drive the same code.

use std::collections::VecDeque;

use roomcast_ipc::raw::{IncludedV1, MAX_SOURCES, RoomScoresV1, score_flags};

use super::{Engine, Entry, Intake, Recovered};
use roomcast_core::ids::{BootNs, EventId, UnixNs};
use roomcast_core::pipeline::PipelineError;
use roomcast_core::scorer::LanguageModel;

/// Most events in one step: scores and heartbeats do not wait for a whole flood.
const STEP_ENTRIES_MAX: usize = 512;
/// After this time a step scores no further person, for the same reason: one narrator may report many persons.
const STEP_NS_MAX: u64 = 250_000_000;
/// A failed step is retried after this time.
const RETRY_NS: u64 = 1_000_000_000;

/// A refused event, behind so many waiting ones.
#[derive(Debug)]
struct Refused {
    behind: usize,
    event: EventId,
}

/// The state of the scoring loop.
#[derive(Debug)]
pub struct Cycle<M> {
    engine: Engine<M>,
    /// Events for the next steps, each with its number in the state database, 0 without one.
    waiting: VecDeque<(Entry, u64)>,
    /// Refused events. The scores confirm them as soon as they contain the events before them.
    refused: VecDeque<Refused>,
    /// The number in the state database of the newest event in the histories.
    entered_record: u64,
    /// The number of the newest record that the scores rest on: an event, or an attribution.
    scored_record: u64,
    /// There are new events, unscored persons, a failed step, or no scores yet.
    due: bool,
    retry_ns: BootNs,
    /// The newest scores were not sent.
    fresh: bool,
    /// The time at which the oldest newly scored event was received.
    received_ns: Option<BootNs>,
    heartbeat_ns: u64,
    sent_ns: BootNs,
    /// The claims of the last message whose events were all in the state database.
    claims: (u32, [IncludedV1; MAX_SOURCES]),
    not_told: bool,
    less: Box<RoomScoresV1>,
}

impl<M: LanguageModel> Cycle<M> {
    /// A loop without scores. If nothing changes, a heartbeat follows `heartbeat_ns` after each message.
    #[must_use]
    pub fn new(engine: Engine<M>, heartbeat_ns: u64) -> Self {
        Self {
            engine,
            waiting: VecDeque::new(),
            refused: VecDeque::new(),
            entered_record: 0,
            scored_record: 0,
            // The first step scores the restored events, or the binding sequence alone.
            due: true,
            retry_ns: BootNs(0),
            fresh: false,
            received_ns: None,
            heartbeat_ns,
            sent_ns: BootNs(0),
            claims: Default::default(),
            not_told: false,
            less: Box::default(),
        }
    }

    /// Restores the events of a former run, and lets `intake` know them as duplicates. Returns the number of events that were left out because they
    /// cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, intake: &mut Intake, now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        recovered.taken.iter().for_each(|event| intake.restore(*event));
        recovered.ports.iter().for_each(|(name, port)| intake.restore_port(*name, *port));
        self.engine.settle(recovered.settled.clone());
        self.engine.restore(recovered, now_ns, now_unix_ns)
    }

    /// Takes in a refused event, which the scores must confirm so that its narrator stops waiting. A confirmation includes all earlier events. So it
    /// waits until the scores contain those.
    pub fn pass_over(&mut self, event: EventId) {
        self.refused.push_back(Refused { behind: self.waiting.len(), event });
        self.pass_over_up_to(0);
        self.due = true;
    }

    /// Passes over the refused events behind so many waiting ones. Returns whether there was one.
    fn pass_over_up_to(&mut self, taken: usize) -> bool {
        let is_next = |own: &&Refused| own.behind <= taken;
        let passed = self.refused.iter().take_while(is_next).count();
        for Refused { event, .. } in self.refused.drain(..passed) {
            self.engine.pass_over(event);
        }
        self.refused.iter_mut().for_each(|own| own.behind -= taken);
        passed > 0
    }

    /// Takes in an accepted event; `record` is its number in the state database, 0 without one.
    pub fn enter(&mut self, entry: Entry, record: u64) {
        self.waiting.push_back((entry, record));
        self.due = true;
    }

    /// The number of events that no step has taken.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Whether a step is due: at once for a new event, after a second for a failed step, or because time alone changes the scores.
    #[must_use]
    pub fn step_due(&self, now_ns: BootNs) -> bool {
        let due = self.due || self.engine.is_overdue(now_ns);
        due && (now_ns >= self.retry_ns || !self.waiting.is_empty())
    }

    /// Takes waiting events and scores as many persons as the time allows, at least one. If work remains, another step is due at once.
    ///
    /// # Errors
    ///
    /// If the model fails. The events stay in the histories, and a later step scores them.
    pub fn step(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> Result<(), PipelineError> {
        self.step_and_tell(now_ns, now_unix_ns, |_| {})
    }

    /// The same; `tell` gets the engine after the observations have entered the histories, and before the model scores them.
    ///
    /// # Errors
    ///
    /// As [`Cycle::step`].
    pub(super) fn step_and_tell(
        &mut self,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
        tell: impl FnOnce(&mut Engine<M>),
    ) -> Result<(), PipelineError> {
        let failed_before = self.engine.snapshot().has(score_flags::SCORER_FAILED);
        let most = self.waiting.len().min(STEP_ENTRIES_MAX);
        let taken = self.waiting.drain(..most);
        let entered_record = &mut self.entered_record;
        let entries = taken.map(|(entry, record)| {
            *entered_record = (*entered_record).max(record);
            entry
        });
        let sequence = self.engine.snapshot().sequence;
        self.engine.take_in(entries, now_ns, now_unix_ns);
        tell(&mut self.engine);
        let stepped = self.engine.score_within(now_ns, now_unix_ns, STEP_NS_MAX);
        let is_news = self.pass_over_up_to(most);
        match stepped {
            Ok(received_ns) => self.received_ns = received_ns,
            Err(error) => {
                if !failed_before {
                    // Planners must know at once, not with the next heartbeat.
                    self.sent_ns = BootNs(0);
                }
                self.due = true;
                self.retry_ns = now_ns.saturating_add(RETRY_NS);
                return Err(error);
            }
        }
        self.due = is_news || !self.waiting.is_empty() || self.engine.pipeline().inside().is_behind();
        self.fresh |= self.engine.snapshot().sequence > sequence;
        self.scored_record = self.scored_record.max(self.entered_record);
        Ok(())
    }

    /// The scores also rest on this record of the state database: they claim no event before it is written.
    pub fn rests_on(&mut self, record: u64) {
        self.scored_record = self.scored_record.max(record);
    }

    /// The newest record that the scores rest on. [`Cycle::message`] claims new events once it is written.
    #[must_use]
    pub fn scored_record(&self) -> u64 {
        self.scored_record
    }

    /// Whether new scores, a heartbeat or delayed claims can be sent. `written` is the last written record.
    #[must_use]
    pub(crate) fn message_due(&self, now_ns: BootNs, written: u64) -> bool {
        let confirmation = now_ns.since(self.sent_ns) >= self.heartbeat_ns || (self.not_told && self.durable(written));
        self.engine.snapshot().sequence > 0 && (self.fresh || confirmation)
    }

    /// The time until the next heartbeat or retry, if no event arrives. Claims that wait for the state database are checked every 50 ms.
    #[must_use]
    pub(crate) fn idle_ns(&self, now_ns: BootNs) -> u64 {
        const JOURNAL_NS: u64 = 50_000_000;
        let heartbeat_ns = match self.engine.snapshot().sequence {
            0 => u64::MAX,
            _ => self.sent_ns.saturating_add(self.heartbeat_ns).since(now_ns),
        };
        let retry_ns = if self.due { self.retry_ns.since(now_ns) } else { u64::MAX };
        let journal_ns = if self.not_told { JOURNAL_NS } else { u64::MAX };
        heartbeat_ns.min(retry_ns).min(journal_ns)
    }

    fn durable(&self, written: u64) -> bool {
        written >= self.scored_record
    }

    /// The message to send now, if one is due.
    ///
    /// Scores with events beyond `written` are sent, but do not claim these events. A claim lets the narrator forget the event, so it must survive a
    /// killed daemon.
    pub fn message(&mut self, now_ns: BootNs, written: u64, behind: bool) -> Option<&RoomScoresV1> {
        if !self.message_due(now_ns, written) {
            return None;
        }
        let durable = self.durable(written);
        let message = self.engine.message(now_ns, !self.fresh, behind);
        self.not_told = !durable;
        self.fresh = false;
        self.sent_ns = now_ns;
        if durable {
            self.claims = (message.source_count, message.included);
            return Some(message);
        }
        *self.less = *message;
        (self.less.source_count, self.less.included) = self.claims;
        Some(&self.less)
    }

    /// Takes the time at which the oldest newly scored event was received.
    pub(crate) fn newly_received_ns(&mut self) -> Option<BootNs> {
        self.received_ns.take()
    }

    /// Makes a step due at once, after a change of the map.
    pub fn score_again(&mut self) {
        (self.due, self.retry_ns) = (true, BootNs(0));
    }

    /// The engine, to change it.
    pub fn engine_mut(&mut self) -> &mut Engine<M> {
        &mut self.engine
    }

    /// The engine, without the loop.
    #[must_use]
    pub fn into_engine(self) -> Engine<M> {
        self.engine
    }

    /// The engine.
    #[must_use]
    pub fn engine(&self) -> &Engine<M> {
        &self.engine
    }

    /// Does a small part of the model's reading after an event ([`roomcast_core::pipeline::Idle::read_on`]).
    pub fn read_on(&mut self) {
        self.engine.read_on();
    }

    /// Does a small part of the postponed work. Returns whether there is more.
    pub fn tidy(&mut self) -> bool {
        self.engine.tidy()
    }
}
