//! The scoring thread: receives events, scores, sends, and answers questions.

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

use super::answers::{answer_about_person, answer_change, forget_habits};
use super::asked::{Answered, Question};
use super::cycle::Cycle;
use super::engine::Engine;
use super::habits_question::{self, After, HabitsAnswer, HabitsQuestion, Importing};
use super::journal::{JournalHandle, PATIENCE};
use super::map_change::{MapAnswer, MapQuestion, Outcome};
use super::person_question::{PersonAnswer, PersonQuestion};
use super::prefetch_thread::PrefetchHandle;
use super::receiver::{Counters, Heard, QUEUE, ReceiverLoan};
use super::{LOG_INTERVAL_NS, Progress};
use crate::clock;
use crate::logging::Limiter;
use crate::notify::notify;
use crate::stop::Stop;
use roomcast_core::ids::BootNs;
use roomcast_core::scorer::LanguageModel;

/// Silence before low-priority work, so that it does not delay a burst of events.
const QUIET_NS: u64 = 50_000_000;
/// The model reads on so long after the scores: on a busy machine the scheduler queues the planner, which the scores wake, on this thread's core.
const READ_ON_NS: u64 = 1_000_000;
/// Longest time between renewals of connections. Participants that use this contract's crate wake the daemon when they join or ask.
const TICK: Duration = Duration::from_millis(250);
/// During shorter steps the port buffers the events: waking another thread for them would take a core from the step.
const SHORT_STEP_NS: u64 = 5_000_000;
/// Longest wait of scores for the journal. After that they are sent without the claim to events that the journal lacks.
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
    /// Opens all ports, the exclusive one first.
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
    /// The fingerprint of the configured scene, hexadecimal.
    scene: String,
    save_ns: u64,
    saved_ns: BootNs,
    receiver: ReceiverLoan,
    /// Duration of the last step, as an estimate of the next.
    step_ns: u64,
    /// The background scorer; `None` when prefetching is off.
    handle: Option<PrefetchHandle>,
    /// It was interrupted since the last snapshot for prefetching.
    is_interrupted: bool,
    /// Low-priority work is postponed until this time.
    quiet_ns: BootNs,
    /// The engine has work for [`Cycle::tidy`].
    is_untidy: bool,
    /// The model reads on from this time on.
    reads_on_ns: Option<BootNs>,
    /// Most tokens of a sentence with the map in use, for the intake.
    sentence_tokens_max: Arc<AtomicUsize>,
    journal: Option<JournalHandle>,
    counters: Counters,
    progress: Progress,
    latency_ns: Option<Histogram<u64>>,
    tally: StatusResponseV1,
    log: Limiter,
    /// The log has the warning that the model is slower than the deadline.
    is_slow_told: bool,
    stop: Stop,
}

/// Further parts of the scoring thread.
pub(super) struct Tools {
    pub(super) scene: String,
    pub(super) save_ns: u64,
    pub(super) sentence_tokens_max: Arc<AtomicUsize>,
    pub(super) journal: Option<JournalHandle>,
    pub(super) counters: Counters,
    pub(super) progress: Progress,
    pub(super) handle: Option<PrefetchHandle>,
    pub(super) stop: Stop,
}

impl<M: LanguageModel> Scoring<M> {
    /// `tally` is the first status answer.
    pub(super) fn new(
        cycle: Cycle<M>,
        ports: Ports,
        receiver: ReceiverLoan,
        tools: Tools,
        tally: StatusResponseV1,
    ) -> Self {
        let Tools { scene, save_ns, sentence_tokens_max, journal, counters, progress, handle, stop } = tools;
        Self {
            cycle,
            ready: false,
            ports,
            answered: Answered::default(),
            answered_persons: Answered::default(),
            answered_habits: Answered::default(),
            importing: Importing::default(),
            scene,
            save_ns,
            saved_ns: clock::monotonic_ns(),
            receiver,
            step_ns: u64::MAX,
            handle,
            is_interrupted: false,
            quiet_ns: BootNs(0),
            is_untidy: false,
            reads_on_ns: None,
            sentence_tokens_max,
            journal,
            counters,
            progress,
            latency_ns: Histogram::new_with_max(60_000_000_000, 3).ok(),
            tally,
            log: Limiter::new(LOG_INTERVAL_NS),
            is_slow_told: false,
            stop,
        }
    }

    pub(super) fn run(&mut self) -> Result<(), IpcError> {
        loop {
            let last = self.receiver.is_lost() || (self.stop.requested() && self.receiver.is_here());
            // A changed map is scored at once.
            let wait = !last && !self.cycle.step_due(clock::monotonic_ns());
            let idle = || {
                let now_ns = clock::monotonic_ns();
                let until_ns =
                    self.until_quiet_ns(now_ns).min(self.reads_on_ns.map_or(u64::MAX, |at_ns| at_ns.since(now_ns)));
                Duration::from_nanos(self.cycle.idle_ns(now_ns).min(until_ns)).min(TICK)
            };
            self.take(if wait { idle() } else { Duration::ZERO });
            let now_ns = clock::monotonic_ns();
            self.progress.scoring_ns.store(now_ns.0, Ordering::Relaxed);
            let events = self.cycle.waiting() as u64;
            self.take_answers(events > 0);
            self.see_robots(now_ns)?;
            let mut is_scored = false;
            if self.cycle.step_due(now_ns) {
                // A stopping thread keeps the receiver: otherwise it would continue while a step is due.
                if !last && !self.stop.requested() && self.step_ns >= SHORT_STEP_NS {
                    self.receiver.lend();
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
            // The rest may wait for the scores: checking for questions alone takes as long as a small step.
            self.renew_connections()?;
            if self.change_map()? || self.answer_about_persons()? {
                self.cycle.score_again();
            }
            self.answer_about_habits()?;
            self.ports.status.answer(|| self.tally())?;
            // These questions wait for the first scores of a changed map.
            if self.cycle.engine().is_scored() {
                let engine = self.cycle.engine_mut();
                let mut moment = || serde_json::to_string(&engine.moment(clock::monotonic_ns())).unwrap_or_default();
                self.ports.moments.answer(|_| moment())?;
            }
            if events > 0 && is_scored {
                self.reads_on_ns = Some(clock::monotonic_ns().saturating_add(READ_ON_NS));
            }
            self.read_on();
            if self.receiver.waiting() == 0 && self.cycle.waiting() == 0 && !self.cycle.step_due(clock::monotonic_ns())
            {
                self.look_after_habits(now_ns);
                self.use_silence();
            }
            self.receiver.call_back();
        }
    }

    /// Sleeps until an event arrives or `patience` has passed, and receives all events, unless the queue is full.
    fn take(&mut self, patience: Duration) {
        if self.cycle.waiting() >= QUEUE {
            return;
        }
        let cycle = &mut self.cycle;
        self.receiver.listen(patience, |heard| match heard {
            Heard::Entry(entry, number) => cycle.enter(entry, number),
            Heard::PassedOver(event) => cycle.pass_over(event),
        });
    }

    /// Receives positions and targets of robots, whose motion explains sensor events. Malformed messages are ignored.
    fn see_robots(&mut self, now_ns: BootNs) -> Result<(), IpcError> {
        let (ports, engine) = (&mut self.ports, self.cycle.engine_mut());
        while ports.decisions.receive_into(&mut ports.decision)? {
            engine.see_decision(&ports.decision, now_ns);
        }
        while ports.reports.receive_into(&mut ports.report)? {
            engine.see_report(&ports.report, now_ns);
        }
        Ok(())
    }

    /// Sends the newest messages to new participants.
    fn renew_connections(&mut self) -> Result<(), IpcError> {
        self.ports.scores.tick()?;
        if self.ports.items.tick()? && self.cycle.engine().snapshot().sequence > 0 {
            self.send_items()?;
        }
        if self.ports.forecasts.tick()? && self.cycle.engine().snapshot().sequence > 0 {
            self.ports.forecasts.send(self.cycle.engine_mut().forecast(clock::monotonic_ns()))?;
        }
        if self.ports.persons.tick()? && self.cycle.engine().snapshot().sequence > 0 {
            self.ports.persons.send(self.cycle.engine_mut().person_scores(clock::monotonic_ns()))?;
        }
        if self.ports.person_forecasts.tick()? && self.cycle.engine().snapshot().sequence > 0 {
            self.ports.person_forecasts.send(self.cycle.engine_mut().person_forecasts(clock::monotonic_ns()))?;
        }
        Ok(())
    }

    fn send_items(&self) -> Result<(), IpcError> {
        let Some((header, items)) = self.cycle.engine().items() else { return Ok(()) };
        self.ports.items.send(header, items)
    }

    /// Returns true if all persons have scores.
    fn step(&mut self, now_ns: BootNs) -> bool {
        self.tally.steps += 1;
        let waited = self.cycle.waiting();
        let (journal, mut attributed) = (&self.journal, 0);
        let mut tell = |engine: &mut Engine<M>| {
            engine.tell_moved(|moved| attributed = journal.as_ref().map_or(0, |journal| journal.append(moved)));
            engine.tell_whose(|outcome| attributed = journal.as_ref().map_or(0, |journal| journal.append(outcome)));
        };
        let done = self.cycle.step_and_tell(now_ns, clock::unix_ns(), &mut tell);
        tell(self.cycle.engine_mut());
        self.tally.merged += ((waited - self.cycle.waiting()) as u64).saturating_sub(1);
        self.cycle.rests_on(attributed);
        if let Err(error) = done {
            self.tally.failed_steps += 1;
            if let Some(not_told) = self.log.pass(now_ns) {
                tracing::error!(%error, not_told, "scoring failed; the narration is kept and scored with the next step");
            }
            return false;
        }
        let engine = self.cycle.engine();
        if engine.pipeline().scores().is_cut && !std::mem::replace(&mut self.is_slow_told, true) {
            tracing::warn!(
                deadline_ms = engine.pipeline().inside().options().deadline_ns / 1_000_000,
                "the model takes longer for an event than scoring.deadline_ms: the last scores are sent at once, with the flag BEHIND, and new scores when \
                 they are ready. Raise the limit, or use a smaller model"
            );
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
        // False while persons lack scores of a changed map.
        self.cycle.engine().is_scored()
    }

    /// Writes expectations and departures to the journal, so that a restart believes the same.
    fn tell_expected(&mut self) {
        let journal = &self.journal;
        self.cycle.engine_mut().tell_gone(|gone| {
            if let Some(journal) = journal {
                journal.append(gone);
            }
        });
        self.cycle.engine_mut().tell_expected(|outcome| {
            if let Some(journal) = journal {
                journal.append(outcome);
            }
        });
    }

    /// Takes prefetched scores. An event interrupts prefetching.
    fn take_answers(&mut self, is_event: bool) {
        let Some(handle) = &self.handle else { return };
        if is_event {
            handle.interrupt();
            self.is_interrupted = true;
        }
        let engine = self.cycle.engine_mut();
        handle.answers().for_each(|answer| engine.keep_answer(answer));
    }

    /// Whether the prefetcher needs a new snapshot.
    fn is_prefetch_due(&self) -> bool {
        let engine = self.cycle.engine();
        self.handle.is_some() && engine.is_scored() && (self.is_interrupted || engine.is_prefetch_due())
    }

    /// Time until low-priority work is due.
    fn until_quiet_ns(&self, now_ns: BootNs) -> u64 {
        if self.is_untidy || self.is_prefetch_due() { self.quiet_ns.since(now_ns) } else { u64::MAX }
    }

    /// The model reads a part of the next window. In a burst the next event is here already, and it reads at once.
    fn read_on(&mut self) {
        let is_due = self.reads_on_ns.is_some_and(|at_ns| at_ns <= clock::monotonic_ns());
        let is_burst = self.reads_on_ns.is_some() && (self.receiver.has_more() || self.cycle.waiting() > 0);
        if is_due || is_burst {
            self.reads_on_ns = None;
            self.cycle.read_on();
        }
    }

    /// Does a small part of the low-priority work: tidies up, or passes a snapshot to the prefetcher. Right after the scores it would take the core
    /// from the processes that the scores have woken: the scheduler queues them here, since a waking process mostly sleeps soon.
    fn use_silence(&mut self) {
        if self.until_quiet_ns(clock::monotonic_ns()) > 0 || self.receiver.has_more() {
            return;
        }
        if self.is_untidy {
            self.is_untidy = self.cycle.tidy();
        } else if let Some(handle) = &self.handle {
            handle.look(self.cycle.engine_mut().now());
            self.is_interrupted = false;
        }
    }

    /// Sends the due messages; `events` arrived since the last call.
    fn send(&mut self, events: u64) -> Result<(), IpcError> {
        let before_ns = clock::monotonic_ns();
        let written = self.journal.as_ref().map_or(u64::MAX, JournalHandle::written);
        if !self.cycle.message_due(before_ns, written) {
            return Ok(());
        }
        let behind = self.receiver.has_more() || self.cycle.waiting() > 0;
        let Some(message) = self.cycle.message(before_ns, written, behind) else { return Ok(()) };
        self.ports.scores.send(message)?;
        let (is_heartbeat, after_ns) = (message.has(score_flags::HEARTBEAT), clock::monotonic_ns());
        // These follow the scores, which wait for nothing; a planner waits for the matching forecast. Time alone changes where a person may be, so
        // each heartbeat has a new forecast. All are sent even without subscribers: a later subscriber gets the last ones, which are as new as the
        // scores and name no forgotten person.
        self.send_about_persons(before_ns)?;
        if is_heartbeat {
            self.tally.heartbeats += 1;
            return Ok(());
        }
        self.tally.published += 1;
        // Includes the events of a failed step, which waited longest.
        if let Some(received_ns) = self.cycle.newly_received_ns()
            && let Some(latency_ns) = &mut self.latency_ns
        {
            latency_ns.saturating_record(after_ns.since(received_ns));
        }
        let message = self.cycle.engine().snapshot();
        self.tally.sequence = message.sequence;
        if self.ports.items.wanted() {
            self.send_items()?;
        }
        // Every event has one of these lines, so that metrics and the status answer agree in sum.
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
            let engine = self.cycle.engine();
            let (model, map) = (engine.pipeline().inside().model().name.as_str(), engine.map().name());
            let (labels, rooms) = (engine.pipeline().inside().prepared().labels().len(), message.rooms().len());
            tracing::info!(model, map, labels, rooms, "ready: the first scores are out");
            notify(&[NotifyState::Ready]);
        }
        Ok(())
    }

    fn send_about_persons(&mut self, now_ns: BootNs) -> Result<(), IpcError> {
        self.ports.forecasts.send(self.cycle.engine_mut().forecast(now_ns))?;
        self.ports.person_forecasts.send(self.cycle.engine_mut().person_forecasts(now_ns))?;
        // The planner does not wait for these.
        self.ports.persons.send(self.cycle.engine_mut().person_scores(now_ns))?;
        Ok(())
    }

    /// Applies requested map changes. Returns true if the map changed.
    fn change_map(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered, journal, scene, ports, tally, receiver, sentence_tokens_max, .. } = self;
        let engine = cycle.engine_mut();
        let mut changed = false;
        ports.map_changes.answer(|asked| {
            answered.answer::<MapQuestion>(asked, |asked| {
                receiver.lend();
                let answer = answer_change(engine, journal.as_ref(), scene, asked);
                if answer.outcome == Outcome::Applied {
                    changed = true;
                    tally.map_fingerprint = engine.map().fingerprint();
                    sentence_tokens_max.store(engine.sentence_tokens_max(), Ordering::Relaxed);
                }
                let MapAnswer { outcome, reason, items, new_labels, .. } = &answer;
                let reason = reason.as_deref().map(for_the_log);
                tracing::info!(?outcome, reason, items, new_labels, "map change");
                answer
            })
        })?;
        Ok(changed)
    }

    /// Answers questions about persons. Returns true if a person was forgotten or renamed.
    fn answer_about_persons(&mut self) -> Result<bool, IpcError> {
        let Self { cycle, answered_persons, answered_habits, ports, journal, receiver, .. } = self;
        let Ports { moments, habits_questions, person_questions, .. } = ports;
        let engine = cycle.engine_mut();
        let mut changed = false;
        person_questions.answer(|asked| {
            let mut is_new = false;
            let told = answered_persons.answer::<PersonQuestion>(asked, |asked| {
                let changes = asked.as_ref().is_ok_and(|asked| asked.id().is_some());
                if changes {
                    receiver.lend();
                }
                let answer = answer_about_person(engine, journal.as_ref(), asked);
                if changes {
                    // Unread answers may name a forgotten person.
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
                // Earlier remembered answers may name a forgotten person.
                answered_persons.cut_before_last(|answer| answer.persons.clear());
                answered_habits.cut(|answer| answer.persons.clear());
            }
            told
        })?;
        Ok(changed)
    }

    fn answer_about_habits(&mut self) -> Result<(), IpcError> {
        let Self { cycle, answered_habits, importing, ports, journal, receiver, .. } = self;
        let (engine, habits_questions) = (cycle.engine_mut(), &ports.habits_questions);
        habits_questions.answer(|asked| {
            let mut is_new = false;
            let told = answered_habits.answer::<HabitsQuestion>(asked, |asked| {
                receiver.lend();
                let (mut answer, after) = habits_question::answer(engine, importing, asked, clock::monotonic_ns());
                answer.kept = journal.is_some();
                if after == After::Forget {
                    // Unread and remembered answers contain forgotten habits.
                    habits_questions.forget_answers();
                    is_new = true;
                    if let Err(error) = forget_habits(engine, journal.as_ref(), Instant::now() + PATIENCE) {
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

    /// Lets habits count time, and saves them at intervals.
    fn look_after_habits(&mut self, now_ns: BootNs) {
        let engine = self.cycle.engine_mut();
        engine.tick(now_ns, clock::unix_ns());
        let is_due = now_ns.since(self.saved_ns) >= self.save_ns;
        let Some(journal) = self.journal.as_ref().filter(|_| is_due) else { return };
        self.saved_ns = now_ns;
        engine.habits_mut().memory_if_changed().into_iter().for_each(|memory| journal.keep_habits(memory));
    }

    /// Writes the habits before the end.
    fn finish_habits(&mut self) {
        // The last observations count, too.
        self.cycle.tidy();
        let memory = self.cycle.engine_mut().habits_mut().memory_if_changed();
        if let Some((journal, memory)) = self.journal.as_ref().zip(memory) {
            journal.keep_habits(memory);
        }
    }

    fn tally(&self) -> StatusResponseV1 {
        let (counters, sources) = *self.counters.lock().unwrap_or_else(PoisonError::into_inner);
        let quantile = |q| self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.value_at_quantile(q));
        let habits = self.cycle.engine().habits().learned();
        let prepared = self.cycle.engine().prepared();
        StatusResponseV1 {
            learned: habits.observations as u64,
            habits_bytes: habits.bytes as u64,
            habits_counts: habits.counts as u64,
            habits_names: habits.names as u32,
            habits_persons: habits.persons as u32,
            asked: prepared.asked,
            prepared: prepared.prepared,
            prepared_used: prepared.used,
            prepare_ns: self.handle.as_ref().map_or(0, PrefetchHandle::spent_ns),
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
            persons: self.cycle.engine().snapshot().persons,
            waiting: (self.receiver.waiting() + self.cycle.waiting()) as u64,
            latency_p50_ns: quantile(0.5),
            latency_p99_ns: quantile(0.99),
            latency_max_ns: self.latency_ns.as_ref().map_or(0, |latency_ns| latency_ns.max()),
            journal_bytes: self.journal.as_ref().map_or(0, JournalHandle::bytes),
            journal_failures: self.journal.as_ref().map_or(0, JournalHandle::failures),
            ..self.tally
        }
    }
}

/// Shortens a reason for the log, because it may quote a long question.
fn for_the_log(reason: &str) -> String {
    reason.chars().take(200).collect()
}
