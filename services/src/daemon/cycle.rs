//! The scoring loop without threads, ports, clock and disk: when to score, when to try again, what to send. Time and the
//! journal's progress come in as numbers and messages go out as values, so that the daemon's threads and the simulation of faults
//! (`tests/it/simulated.rs`) drive the same code.

use std::collections::VecDeque;

use roomcast_ipc::raw::{IncludedV1, MAX_SOURCES, RoomScoresV1, score_flags};

use super::{Board, Entry, Intake, Recovered};
use roomcast_core::ids::{BootNs, EventId, UnixNs};
use roomcast_core::pipeline::PipelineError;
use roomcast_core::scorer::LanguageModel;

/// So much narration is taken by one step at most: scores, heartbeats and signs of life do not wait for all of a flood.
const STEP_ENTRIES_MAX: usize = 512;
/// Once a step has taken so long, the model is asked about nobody else in it, for the same reason: one narrator may tell of many persons.
const STEP_NS_MAX: u64 = 250_000_000;
/// A failing scorer is tried again after this.
const RETRY_NS: u64 = 1_000_000_000;

/// A narration that was refused, and behind how many of those that wait it came.
#[derive(Debug)]
struct Refused {
    behind: usize,
    event: EventId,
}

/// The state of the scoring loop.
#[derive(Debug)]
pub struct Cycle<M> {
    board: Board<M>,
    /// What the next steps take into the histories, each with its number in the journal, 0 without one.
    waiting: VecDeque<(Entry, u64)>,
    /// Narrations of which the scores say that they were dealt with as soon as they contain what came before.
    refused: VecDeque<Refused>,
    /// The journal's number of the newest observation in the histories.
    entered_record: u64,
    /// The same of the newest record that the scores rest on: an observation, or whose one is.
    scored_record: u64,
    /// There is something to score: new narration, persons whom no step had time for, a step that failed, or nothing scored yet.
    due: bool,
    retry_ns: BootNs,
    /// The newest scores were not sent yet.
    fresh: bool,
    /// When the first narration that they newly contain was received.
    received_ns: Option<BootNs>,
    heartbeat_ns: u64,
    sent_ns: BootNs,
    /// The claims of the last message whose narration was all in the journal.
    claims: (u32, [IncludedV1; MAX_SOURCES]),
    /// The last message claimed less than its scores contain.
    not_told: bool,
    /// That message.
    less: Box<RoomScoresV1>,
}

impl<M: LanguageModel> Cycle<M> {
    /// A loop that has scored nothing; `heartbeat_ns` after a message the next one confirms it.
    #[must_use]
    pub fn new(board: Board<M>, heartbeat_ns: u64) -> Self {
        Self {
            board,
            waiting: VecDeque::new(),
            refused: VecDeque::new(),
            entered_record: 0,
            scored_record: 0,
            // The first step scores what the journal gave, or the binding sequence alone.
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

    /// Takes what the journal kept of a former run into the histories, and makes `intake` know it, so that it is not taken twice. Gives how
    /// many were left out, because they cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, intake: &mut Intake, now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        recovered.taken().for_each(|event| intake.restore(event));
        recovered.ports.iter().for_each(|(name, port)| intake.restore_port(*name, *port));
        self.board.settle(recovered.settled.clone());
        self.board.restore(recovered, now_ns, now_unix_ns)
    }

    /// Takes note of a narration that was refused: scores say that it was dealt with, so that its narrator does not wait for it. They do not before
    /// they contain what came before it: they claim that with it.
    pub fn pass_over(&mut self, event: EventId) {
        self.refused.push_back(Refused { behind: self.waiting.len(), event });
        self.pass_over_up_to(0);
        self.due = true;
    }

    /// Passes over what was refused behind so many of those that wait; says whether there was any.
    fn pass_over_up_to(&mut self, taken: usize) -> bool {
        let is_next = |own: &&Refused| own.behind <= taken;
        let passed = self.refused.iter().take_while(is_next).count();
        for Refused { event, .. } in self.refused.drain(..passed) {
            self.board.pass_over(event);
        }
        self.refused.iter_mut().for_each(|own| own.behind -= taken);
        passed > 0
    }

    /// Takes an accepted observation for the next step; `record` is its number in the journal, 0 without one.
    pub fn enter(&mut self, entry: Entry, record: u64) {
        self.waiting.push_back((entry, record));
        self.due = true;
    }

    /// Observations that no step has taken yet.
    #[must_use]
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Whether a step is due: new narration at once, a failed step after a second, and what time alone changes.
    #[must_use]
    pub fn step_due(&self, now_ns: BootNs) -> bool {
        let due = self.due || self.board.is_overdue(now_ns);
        due && (now_ns >= self.retry_ns || !self.waiting.is_empty())
    }

    /// Takes what waits in, as much as a step takes at most, and scores once: so many persons as there is time for, at least one. Another step
    /// is due at once where there is more.
    ///
    /// # Errors
    ///
    /// When the model fails. The observations are in the histories all the same, and a later step scores them.
    pub fn step(&mut self, now_ns: BootNs, now_unix_ns: UnixNs) -> Result<(), PipelineError> {
        self.step_and_tell(now_ns, now_unix_ns, |_| {})
    }

    /// The same; `tell` gets the board after the observations have entered the histories, and before the model scores them.
    ///
    /// # Errors
    ///
    /// As [`Cycle::step`].
    pub(super) fn step_and_tell(
        &mut self,
        now_ns: BootNs,
        now_unix_ns: UnixNs,
        tell: impl FnOnce(&mut Board<M>),
    ) -> Result<(), PipelineError> {
        let failed_before = self.board.snapshot().has(score_flags::SCORER_FAILED);
        let most = self.waiting.len().min(STEP_ENTRIES_MAX);
        let taken = self.waiting.drain(..most);
        let entered_record = &mut self.entered_record;
        let entries = taken.map(|(entry, record)| {
            *entered_record = (*entered_record).max(record);
            entry
        });
        let sequence = self.board.snapshot().sequence;
        self.board.take_in(entries, now_ns, now_unix_ns);
        tell(&mut self.board);
        let stepped = self.board.score_within(now_ns, now_unix_ns, STEP_NS_MAX);
        let is_news = self.pass_over_up_to(most);
        match stepped {
            Ok(received_ns) => self.received_ns = received_ns,
            Err(error) => {
                if !failed_before {
                    // Planners learn it at once, not with the next heartbeat.
                    self.sent_ns = BootNs(0);
                }
                self.due = true;
                self.retry_ns = now_ns.saturating_add(RETRY_NS);
                return Err(error);
            }
        }
        self.due = is_news || !self.waiting.is_empty() || self.board.pipeline().inside().is_behind();
        self.fresh |= self.board.snapshot().sequence > sequence;
        self.scored_record = self.scored_record.max(self.entered_record);
        Ok(())
    }

    /// The scores rest on a record of the journal beside their narration: they claim nothing before it is written.
    pub fn rests_on(&mut self, record: u64) {
        self.scored_record = self.scored_record.max(record);
    }

    /// The journal's number of the newest narration that the scores contain: what [`Cycle::message`] wants written.
    #[must_use]
    pub fn scored_record(&self) -> u64 {
        self.scored_record
    }

    /// Whether there is something to send: new scores, a heartbeat, or claims that had to wait for the journal. `written` is how far the
    /// journal is.
    #[must_use]
    pub(crate) fn message_due(&self, now_ns: BootNs, written: u64) -> bool {
        let confirmation = now_ns.since(self.sent_ns) >= self.heartbeat_ns || (self.not_told && self.durable(written));
        self.board.snapshot().sequence > 0 && (self.fresh || confirmation)
    }

    /// How long there is nothing to do unless something arrives: until the next heartbeat, or until a failed step is tried again. What waits
    /// for the journal is looked after every few milliseconds.
    #[must_use]
    pub(crate) fn idle_ns(&self, now_ns: BootNs) -> u64 {
        const JOURNAL_NS: u64 = 50_000_000;
        // Without scores there is nothing to confirm.
        let heartbeat_ns = match self.board.snapshot().sequence {
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

    /// The message that is to be sent now, if one is due.
    ///
    /// Scores that contain narration beyond `written` are sent all the same, but do not claim it: a claim is what lets a narrator forget,
    /// and must survive a killed daemon.
    pub fn message(&mut self, now_ns: BootNs, written: u64, behind: bool) -> Option<&RoomScoresV1> {
        if !self.message_due(now_ns, written) {
            return None;
        }
        let durable = self.durable(written);
        let message = self.board.message(now_ns, !self.fresh, behind);
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

    /// When the first narration was received that the newest scores contain and those before them did not; given once.
    pub(crate) fn newly_received_ns(&mut self) -> Option<BootNs> {
        self.received_ns.take()
    }

    /// Makes a step due at once: the map has changed.
    pub fn score_again(&mut self) {
        (self.due, self.retry_ns) = (true, BootNs(0));
    }

    /// The board, to change its map or to forecast.
    pub fn board_mut(&mut self) -> &mut Board<M> {
        &mut self.board
    }

    /// The board alone, for whoever has no use for the loop any more.
    #[must_use]
    pub fn into_board(self) -> Board<M> {
        self.board
    }

    /// The board.
    #[must_use]
    pub fn board(&self) -> &Board<M> {
        &self.board
    }

    /// A small part of the work that can wait until there is nothing else to do. Gives whether there is more.
    pub fn tidy(&mut self) -> bool {
        self.board.tidy()
    }
}
