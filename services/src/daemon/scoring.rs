//! The scoring thread: takes narration in, scores, sends, and answers questions.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use roomcast_ipc::raw::{
    DecisionV1, ForecastV1, PersonForecastsV1, PersonScoresV1, RobotReportV1, RoomScoresV1, StatusResponseV1,
    score_flags,
};
use roomcast_ipc::{AnswerPort, IpcError, ItemScoresPublisher, Node, Publisher, StatusServer, Subscriber, question};
use sd_notify::NotifyState;

use super::answers::{FORGET_PATIENCE, answer_about_person, answer_change, write_habits};
use super::aside::Desk;
use super::asked::{Answered, Question};
use super::board::Board;
use super::cycle::Cycle;
use super::habits_question::{self, After, HabitsAnswer, HabitsQuestion, Importing};
use super::inbox::{Counters, Heard, Lending, QUEUE};
use super::journal::JournalHandle;
use super::keeper::Keeper;
use super::map_change::{KeptMap, MapAnswer, MapQuestion, Outcome};
use super::person_question::{PersonAnswer, PersonQuestion};
use super::{LOG_INTERVAL_NS, Progress};
use crate::clock;
use crate::logging::Limiter;
use crate::notify::notify;
use crate::stop::Stop;
use roomcast_core::ids::BootNs;
use roomcast_core::scorer::LanguageModel;

/// Silence before work for which nobody waits: a burst of narration is not held up by it.
const QUIET_NS: u64 = 50_000_000;
/// How often connections are renewed at least. Whoever joins or asks by this contract's crate wakes the daemon by itself.
const TICK: Duration = Duration::from_millis(250);
/// While a step that takes less runs, the port holds what comes: another thread that is woken for it takes a core from the step.
const SHORT_STEP_NS: u64 = 5_000_000;
/// Scores wait at most this long for the journal; after that they are sent without claiming what it does not hold yet.
const JOURNAL_PATIENCE: Duration = Duration::from_millis(5);

/// What the daemon sends and answers through.
pub(super) struct Ports {
    scores: Publisher<RoomScoresV1>,
    items: ItemScoresPublisher,
    forecasts: Publisher<ForecastV1>,
    persons: Publisher<PersonScoresV1>,
    person_forecasts: Publisher<PersonForecastsV1>,
    status: StatusServer,
    map_changes: AnswerPort,
    moments: AnswerPort,
    person_questions: AnswerPort,
    habits_questions: AnswerPort,
    reports: Subscriber<RobotReportV1>,
    decisions: Subscriber<DecisionV1>,
    report: Box<RobotReportV1>,
    decision: Box<DecisionV1>,
}

impl Ports {
    /// Opens all of them, the one that only one daemon can hold first.
    pub(super) fn open(node: &Node) -> Result<Self, IpcError> {
        Ok(Self {
            scores: node.publisher()?,
            items: node.item_scores_publisher()?,
            forecasts: node.publisher()?,
            persons: node.publisher()?,
            person_forecasts: node.publisher()?,
            status: node.status_server()?,
            map_changes: node.answer_port(question::MAP_CHANGE)?,
            moments: node.answer_port(question::MOMENT)?,
            person_questions: node.answer_port(question::PERSON)?,
            habits_questions: node.answer_port(question::HABITS)?,
            reports: node.subscriber()?,
            decisions: node.subscriber()?,
            report: Box::default(),
            decision: Box::default(),
        })
    }
}

pub(super) struct Scoring<M> {
    cycle: Cycle<M>,
    ready: bool,
    ports: Ports,
    answered: Answered<MapAnswer>,
    answered_persons: Answered<PersonAnswer>,
    answered_habits: Answered<HabitsAnswer>,
    importing: Importing,
    kept_map: Option<KeptMap>,
    /// Writes what was learned; none without a state directory.
    keeper: Option<Keeper>,
    save_ns: u64,
    saved_ns: BootNs,
    inbox: Lending,
    /// What the last step took, as a guess at the next.
    step_ns: u64,
    /// Whoever scores ahead; none where nothing is prepared.
    desk: Option<Desk>,
    /// It was interrupted since it was told what is so.
    is_interrupted: bool,
    /// Until when what waits for silence waits.
    quiet_ns: BootNs,
    /// There is something to tidy up.
    is_untidy: bool,
    /// What a sentence may cost with the map in use, for the intake.
    sentence_tokens_max: Arc<AtomicUsize>,
    journal: Option<JournalHandle>,
    counters: Counters,
    progress: Progress,
    latency_ns: Option<Histogram<u64>>,
    tally: StatusResponseV1,
    log: Limiter,
    stop: Stop,
}

/// What the scoring thread works with beside its ports and the board.
pub(super) struct Tools {
    pub(super) kept_map: Option<KeptMap>,
    pub(super) keeper: Option<Keeper>,
    pub(super) save_ns: u64,
    pub(super) sentence_tokens_max: Arc<AtomicUsize>,
    pub(super) journal: Option<JournalHandle>,
    pub(super) counters: Counters,
    pub(super) progress: Progress,
    pub(super) desk: Option<Desk>,
    pub(super) stop: Stop,
}

impl<M: LanguageModel> Scoring<M> {
    /// `tally` is what the status answer says from the start.
    pub(super) fn new(cycle: Cycle<M>, ports: Ports, inbox: Lending, tools: Tools, tally: StatusResponseV1) -> Self {
        let Tools { kept_map, keeper, save_ns, sentence_tokens_max, journal, counters, progress, desk, stop } = tools;
        Self {
            cycle,
            ready: false,
            ports,
            answered: Answered::default(),
            answered_persons: Answered::default(),
            answered_habits: Answered::default(),
            importing: Importing::default(),
            kept_map,
            keeper,
            save_ns,
            saved_ns: clock::monotonic_ns(),
            inbox,
            step_ns: u64::MAX,
            desk,
            is_interrupted: false,
            quiet_ns: BootNs(0),
            is_untidy: false,
            sentence_tokens_max,
            journal,
            counters,
            progress,
            latency_ns: Histogram::new_with_max(60_000_000_000, 3).ok(),
            tally,
            log: Limiter::new(LOG_INTERVAL_NS),
            stop,
        }
    }

    pub(super) fn run(&mut self) -> Result<(), IpcError> {
        loop {
            let last = self.inbox.is_lost() || (self.stop.requested() && self.inbox.is_here());
            // A changed map is scored at once.
            let wait = !last && !self.cycle.step_due(clock::monotonic_ns());
            let idle = || {
                let now_ns = clock::monotonic_ns();
                Duration::from_nanos(self.cycle.idle_ns(now_ns).min(self.until_quiet_ns(now_ns))).min(TICK)
            };
            self.take(if wait { idle() } else { Duration::ZERO });
            let now_ns = clock::monotonic_ns();
            self.progress.scoring_ns.store(now_ns.0, Ordering::Relaxed);
            let events = self.cycle.waiting() as u64;
            self.take_answers(events > 0);
            self.see_robots(now_ns)?;
            let mut is_scored = false;
            if self.cycle.step_due(now_ns) {
                // Once it is to stop, what it hears with stays here: else it would go on as long as a step is due.
                if !last && !self.stop.requested() && self.step_ns >= SHORT_STEP_NS {
                    self.inbox.lend();
                }
                is_scored = self.step(now_ns);
                self.step_ns = clock::monotonic_ns().since(now_ns);
            }
            self.send(events)?;
            if is_scored {
                self.tell_expected();
            }
            if events > 0 {
                self.is_untidy = true;
                self.quiet_ns = clock::monotonic_ns().saturating_add(QUIET_NS);
            }
            if last {
                self.finish_habits();
                return Ok(());
            }
            // What comes after may wait for the scores: looking for questions alone takes as long as a small step.
            self.renew_connections()?;
            if self.change_map()? || self.answer_about_persons()? {
                self.cycle.score_again();
            }
            self.answer_about_habits()?;
            self.ports.status.answer(|| self.tally())?;
            // Whoever asks meanwhile waits for the first scores of a changed map.
            if self.cycle.board().is_scored() {
                let board = self.cycle.board_mut();
                let mut moment = || serde_json::to_string(&board.moment(clock::monotonic_ns())).unwrap_or_default();
                self.ports.moments.answer(|_| moment())?;
            }
            if self.inbox.waiting() == 0 && self.cycle.waiting() == 0 && !self.cycle.step_due(clock::monotonic_ns()) {
                self.look_after_habits(now_ns);
                self.use_silence();
            }
            self.inbox.call_back();
        }
    }

    /// Sleeps until there is narration or `patience` has passed, and takes in all that was received, unless enough waits already.
    fn take(&mut self, patience: Duration) {
        if self.cycle.waiting() >= QUEUE {
            return;
        }
        let cycle = &mut self.cycle;
        self.inbox.listen(patience, |heard| match heard {
            Heard::Entry(entry, number) => cycle.enter(entry, number),
            Heard::PassedOver(event) => cycle.pass_over(event),
        });
    }

    /// Takes in where robots are and go: their motion explains what sensors see. A malformed message says nothing.
    fn see_robots(&mut self, now_ns: BootNs) -> Result<(), IpcError> {
        let (ports, board) = (&mut self.ports, self.cycle.board_mut());
        while ports.decisions.receive_into(&mut ports.decision)? {
            board.see_decision(&ports.decision, now_ns);
        }
        while ports.reports.receive_into(&mut ports.report)? {
            board.see_report(&ports.report, now_ns);
        }
        Ok(())
    }

    /// Hands the newest messages to whoever has joined since.
    fn renew_connections(&mut self) -> Result<(), IpcError> {
        self.ports.scores.tick()?;
        if self.ports.items.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.send_items()?;
        }
        if self.ports.forecasts.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.ports.forecasts.send(self.cycle.board_mut().forecast(clock::monotonic_ns()))?;
        }
        if self.ports.persons.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.ports.persons.send(self.cycle.board_mut().person_scores(clock::monotonic_ns()))?;
        }
        if self.ports.person_forecasts.tick()? && self.cycle.board().snapshot().sequence > 0 {
            self.ports.person_forecasts.send(self.cycle.board_mut().person_forecasts(clock::monotonic_ns()))?;
        }
        Ok(())
    }

    fn send_items(&self) -> Result<(), IpcError> {
        let Some((header, items)) = self.cycle.board().items() else { return Ok(()) };
        self.ports.items.send(header, items)
    }

    /// Gives whether it scored.
    fn step(&mut self, now_ns: BootNs) -> bool {
        self.tally.steps += 1;
        let waited = self.cycle.waiting();
        // Attributions do not depend on scores: the journal writes them while the model scores.
        let (journal, mut attributed) = (&self.journal, 0);
        let mut tell = |board: &mut Board<M>| {
            board.tell_moved(|moved| attributed = journal.as_ref().map_or(0, |journal| journal.keep_moved(moved)));
            board.tell_whose(|outcome| attributed = journal.as_ref().map_or(0, |journal| journal.append(outcome)));
        };
        let done = self.cycle.step_and_tell(now_ns, clock::unix_ns(), &mut tell);
        tell(self.cycle.board_mut());
        self.tally.merged += ((waited - self.cycle.waiting()) as u64).saturating_sub(1);
        self.cycle.rests_on(attributed);
        if let Err(error) = done {
            self.tally.failed_steps += 1;
            if let Some(not_told) = self.log.pass(now_ns) {
                tracing::error!(%error, not_told, "scoring failed; the narration is kept and scored with the next step");
            }
            return false;
        }
        if let Some(journal) = &self.journal
            && !journal.wait_for(self.cycle.scored_record(), JOURNAL_PATIENCE)
            && let Some(not_told) = self.log.pass(now_ns)
        {
            tracing::warn!(
                not_told,
                "the journal is slower than the scorer; narration is confirmed when it is written"
            );
        }
        // Not while some have no scores of a changed map yet.
        self.cycle.board().is_scored()
    }

    /// Writes down what is expected of whom, and who is gone, so that a restart believes the same.
    fn tell_expected(&mut self) {
        let journal = &self.journal;
        self.cycle.board_mut().tell_gone(|person| {
            if let Some(journal) = journal {
                journal.see_off(person);
            }
        });
        self.cycle.board_mut().tell_expected(|outcome| {
            if let Some(journal) = journal {
                journal.append(outcome);
            }
        });
    }

    /// Takes what was scored ahead; where there is narration, that ends.
    fn take_answers(&mut self, is_event: bool) {
        let Some(desk) = &self.desk else { return };
        if is_event {
            desk.interrupt();
            self.is_interrupted = true;
        }
        let board = self.cycle.board_mut();
        desk.answers().for_each(|answer| board.keep_answer(answer));
    }

    /// Whether there is something to look ahead from.
    fn is_ahead_due(&self) -> bool {
        let board = self.cycle.board();
        self.desk.is_some() && board.is_scored() && (self.is_interrupted || board.is_ahead_due())
    }

    /// How long until what waits for silence is done.
    fn until_quiet_ns(&self, now_ns: BootNs) -> u64 {
        if self.is_untidy || self.is_ahead_due() { self.quiet_ns.since(now_ns) } else { u64::MAX }
    }

    /// Does a small part of what waits for silence: tidies up, then says what is so now to whoever scores ahead. At once it would take the core
    /// from whoever the scores have woken: the system lets them wait there, since whoever wakes others mostly sleeps then.
    fn use_silence(&mut self) {
        if self.until_quiet_ns(clock::monotonic_ns()) > 0 || self.inbox.has_more() {
            return;
        }
        if self.is_untidy {
            self.is_untidy = self.cycle.tidy();
        } else if let Some(desk) = &self.desk {
            desk.look(self.cycle.board_mut().now());
            self.is_interrupted = false;
        }
    }

    /// Sends what is to be sent now; `events` narrations came since the last time.
    fn send(&mut self, events: u64) -> Result<(), IpcError> {
        let before_ns = clock::monotonic_ns();
        let written = self.journal.as_ref().map_or(u64::MAX, JournalHandle::written);
        if !self.cycle.message_due(before_ns, written) {
            return Ok(());
        }
        let behind = self.inbox.has_more() || self.cycle.waiting() > 0;
        let Some(message) = self.cycle.message(before_ns, written, behind) else { return Ok(()) };
        self.ports.scores.send(message)?;
        let (is_heartbeat, after_ns) = (message.has(score_flags::HEARTBEAT), clock::monotonic_ns());
        // Behind the scores, which wait for nothing; a planner waits for the forecast that belongs to them. Time alone changes where a
        // person may be, so a heartbeat has a new one too. All are sent, whoever listens: who joins later is given the last one, which is
        // no older than the scores, and names nobody who is forgotten.
        self.send_about_persons(before_ns)?;
        if is_heartbeat {
            self.tally.heartbeats += 1;
            return Ok(());
        }
        self.tally.published += 1;
        // Also what a step before took in that failed: its wait was the longest.
        if let Some(received_ns) = self.cycle.newly_received_ns()
            && let Some(latency_ns) = &mut self.latency_ns
        {
            latency_ns.saturating_record(after_ns.since(received_ns));
        }
        let message = self.cycle.board().snapshot();
        self.tally.sequence = message.sequence;
        if self.ports.items.wanted() {
            self.send_items()?;
        }
        // Every event has one of these: metrics and the status answer tell the same in sum.
        tracing::debug!(
            sequence = message.sequence,
            events,
            wait_us = message.wait_ns / 1000,
            tokenise_us = message.tokenise_ns / 1000,
            prefix_us = message.prefix_ns / 1000,
            trie_us = message.trie_ns / 1000,
            ground_us = message.ground_ns / 1000,
            publish_us = after_ns.since(before_ns) / 1000,
            label_mass = message.label_mass,
            "step"
        );
        if !self.ready {
            self.ready = true;
            let board = self.cycle.board();
            let (model, map) = (board.pipeline().inside().model().name.as_str(), board.map().name());
            let (labels, rooms) = (board.pipeline().inside().prepared().labels().len(), message.rooms().len());
            tracing::info!(model, map, labels, rooms, "ready: the first scores are out");
            notify(&[NotifyState::Ready]);
        }
        Ok(())
    }

    /// Sends the forecast, the persons' scores and their forecasts.
    fn send_about_persons(&mut self, now_ns: BootNs) -> Result<(), IpcError> {
        self.ports.forecasts.send(self.cycle.board_mut().forecast(now_ns))?;
        self.ports.persons.send(self.cycle.board_mut().person_scores(now_ns))?;
        self.ports.person_forecasts.send(self.cycle.board_mut().person_forecasts(now_ns))?;
        Ok(())
    }

    /// Does what was asked of the map; returns whether it changed.
    fn change_map(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered, journal, kept_map, ports, tally, inbox, sentence_tokens_max, .. } = self;
        let board = cycle.board_mut();
        let mut changed = false;
        ports.map_changes.answer(|asked| {
            answered.answer::<MapQuestion>(asked, |asked| {
                inbox.lend();
                let answer = answer_change(board, (journal.as_ref(), kept_map.as_ref()), asked);
                if answer.outcome == Outcome::Applied {
                    changed = true;
                    tally.map_fingerprint = board.map().fingerprint();
                    sentence_tokens_max.store(board.sentence_tokens_max(), Ordering::Relaxed);
                }
                let MapAnswer { outcome, reason, items, new_labels, .. } = &answer;
                let reason = reason.as_deref().map(for_the_log);
                tracing::info!(?outcome, reason, items, new_labels, "map change");
                answer
            })
        })?;
        Ok(changed)
    }

    /// Answers questions about persons; returns whether somebody was forgotten or has another name.
    fn answer_about_persons(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered_persons, answered_habits, ports, journal, keeper, inbox, .. } = self;
        let Ports { moments, habits_questions, person_questions, .. } = ports;
        let board = cycle.board_mut();
        let mut changed = false;
        person_questions.answer(|asked| {
            let mut is_new = false;
            let told = answered_persons.answer::<PersonQuestion>(asked, |asked| {
                let changes = asked.as_ref().is_ok_and(|asked| asked.id().is_some());
                if changes {
                    inbox.lend();
                }
                let answer = answer_about_person(board, (journal.as_ref(), keeper.as_ref()), asked);
                if changes {
                    // Answers that nobody has read may tell of them.
                    [&*moments, &*habits_questions, &*person_questions]
                        .into_iter()
                        .for_each(AnswerPort::forget_answers);
                    changed |= answer.done;
                    is_new = true;
                    let reason = answer.reason.as_deref().map(for_the_log);
                    tracing::info!(done = answer.done, reason, kept = answer.kept, "person");
                }
                answer
            });
            if is_new {
                // Those before may tell of somebody who is forgotten now.
                answered_persons.cut_before_last(|answer| answer.persons.clear());
                answered_habits.cut(|answer| answer.persons.clear());
            }
            told
        })?;
        Ok(changed)
    }

    /// Answers questions about habits.
    fn answer_about_habits(&mut self) -> Result<(), IpcError> {
        let Self { cycle, answered_habits, importing, ports, keeper, inbox, .. } = self;
        let (board, habits_questions) = (cycle.board_mut(), &ports.habits_questions);
        habits_questions.answer(|asked| {
            let mut is_new = false;
            let told = answered_habits.answer::<HabitsQuestion>(asked, |asked| {
                inbox.lend();
                let (mut answer, after) = habits_question::answer(board, importing, asked, clock::monotonic_ns());
                answer.kept = keeper.is_some();
                if after == After::Forget {
                    // Answers that nobody has read tell of what is forgotten, and so do those that are remembered.
                    habits_questions.forget_answers();
                    is_new = true;
                    if let Err(error) = write_habits(board, keeper.as_ref(), Instant::now() + FORGET_PATIENCE) {
                        answer.reason = Some(format!(
                            "it holds until the daemon starts again: the habits cannot be written: {error}"
                        ));
                        answer.kept = false;
                    }
                    let reason = answer.reason.as_deref().map(for_the_log);
                    tracing::info!(reason, kept = answer.kept, "habits were changed on request");
                }
                answer
            });
            if is_new {
                answered_habits.cut_before_last(|answer| answer.persons.clear());
            }
            told
        })?;
        Ok(())
    }

    /// Lets habits count time, and has them written now and then.
    fn look_after_habits(&mut self, now_ns: BootNs) {
        let board = self.cycle.board_mut();
        board.tick(now_ns, clock::unix_ns());
        let is_due = now_ns.since(self.saved_ns) >= self.save_ns;
        let Some(keeper) = self.keeper.as_ref().filter(|_| is_due) else { return };
        self.saved_ns = now_ns;
        if keeper.has_failed() {
            board.habits_mut().keep_changed();
        }
        if let Some(memory) = board.habits_mut().memory_if_changed()
            && !keeper.write(memory)
        {
            board.habits_mut().keep_changed();
        }
    }

    /// Writes what was learned, before the end.
    fn finish_habits(&mut self) {
        // What was observed last, too.
        self.cycle.tidy();
        let habits = self.cycle.board_mut().habits_mut();
        if self.keeper.as_ref().is_some_and(Keeper::has_failed) {
            habits.keep_changed();
        }
        let memory = habits.memory_if_changed();
        if let Some(keeper) = &mut self.keeper {
            keeper.finish(memory);
        }
    }

    fn tally(&self) -> StatusResponseV1 {
        let (counters, sources) = *self.counters.lock().unwrap_or_else(PoisonError::into_inner);
        let quantile = |q| self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.value_at_quantile(q));
        let habits = self.cycle.board().habits().learned();
        let prepared = self.cycle.board().prepared();
        StatusResponseV1 {
            learned: habits.observations as u64,
            habits_bytes: habits.bytes as u64,
            habits_counts: habits.counts as u64,
            habits_names: habits.names as u32,
            habits_persons: habits.persons as u32,
            asked: prepared.asked,
            prepared: prepared.prepared,
            prepared_used: prepared.used,
            prepare_ns: self.desk.as_ref().map_or(0, Desk::spent_ns),
            answered_ns: clock::monotonic_ns().0,
            received: counters.received,
            accepted: counters.accepted,
            duplicates: counters.duplicates,
            missed: counters.missed,
            malformed: counters.malformed,
            limited: counters.limited,
            forged: counters.forged,
            costly: counters.costly,
            ahead: counters.ahead,
            ahead_ns: counters.ahead_ns,
            sources: sources as u32,
            persons: self.cycle.board().snapshot().persons,
            waiting: (self.inbox.waiting() + self.cycle.waiting()) as u64,
            latency_p50_ns: quantile(0.5),
            latency_p99_ns: quantile(0.99),
            latency_max_ns: self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.max()),
            journal_bytes: self.journal.as_ref().map_or(0, JournalHandle::bytes),
            journal_failures: self.journal.as_ref().map_or(0, JournalHandle::failures),
            ..self.tally
        }
    }
}

/// A reason as a line of the log has room for: it may quote a question, which may be long.
fn for_the_log(reason: &str) -> String {
    reason.chars().take(200).collect()
}
