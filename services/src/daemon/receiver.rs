//! The receiver: port, intake and state database. It belongs to one thread at a time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded, unbounded};
use crossbeam::select;
use roomcast_core::ids::EventId;
use roomcast_ipc::raw::NarrationV1;
use roomcast_ipc::{IpcError, Subscriber};

use super::engine::Entry;
use super::intake::{Intake, IntakeCounters, Taken};
use super::journal::{Journal, Record};
use super::{LOG_INTERVAL_NS, Progress};
use crate::awake::Awake;
use crate::clock;
use crate::logging::Limiter;
use crate::stop::Stop;

/// About the most events that wait for the scorer; then they wait in the port.
pub(super) const QUEUE: usize = 65_536;
/// Most messages in one read of the port: a flood must not delay the scorer's steps.
const AT_ONCE: usize = 2048;
/// The standby thread returns the receiver at most this long after a step. An event in this time wakes both threads.
const STANDBY_POLL: Duration = Duration::from_millis(5);

const FAST_CLOCK: &str = "the clock of this narrator's input is fast: its events count as observed now, and older ones as newer than they \
    are; set the clock of the machine that dates them (NTP)";

/// The intake's counters, and the number of known sources.
pub(super) type Counters = Arc<Mutex<(IntakeCounters, usize)>>;

/// Receives events for the thread that holds it.
pub(super) struct EventReceiver {
    narration: Subscriber<NarrationV1>,
    message: Box<NarrationV1>,
    intake: Intake,
    journal: Option<Journal>,
    counters: Counters,
    /// The last read left messages in the port.
    more: bool,
    log_refused: Limiter,
    log_costly: Limiter,
    log_ahead: Limiter,
    log_port: Limiter,
}

impl EventReceiver {
    pub(super) fn new(
        narration: Subscriber<NarrationV1>,
        intake: Intake,
        journal: Option<Journal>,
        counters: Counters,
    ) -> Self {
        let limiter = || Limiter::new(LOG_INTERVAL_NS);
        Self {
            narration,
            message: Box::default(),
            intake,
            journal,
            counters,
            more: false,
            log_refused: limiter(),
            log_costly: limiter(),
            log_ahead: limiter(),
            log_port: limiter(),
        }
    }

    /// Sleeps until an event arrives or `patience` has passed, if `awake` lets it. Passes all received events to `take`.
    fn listen(&mut self, patience: Duration, awake: &mut Awake, take: impl FnMut(Heard)) {
        // The port wakes once for all its messages, so it would not wake for the remaining ones.
        let narration = &self.narration;
        let waited = if self.more { Ok(true) } else { awake.wait(patience, |patience| narration.wait(patience)) };
        let received = waited.and_then(|_| self.drain(take));
        if let Err(error) = received {
            // A failed port may recover, for instance when file descriptors become free.
            if let Some(not_told) = self.log_port.pass(clock::monotonic_ns()) {
                tracing::error!(%error, not_told, "cannot receive narration");
            }
            std::thread::sleep(patience);
        }
    }

    fn drain(&mut self, mut take: impl FnMut(Heard)) -> Result<(), IpcError> {
        let mut messages = 0;
        while messages < AT_ONCE
            && let Some((checked, sender)) = self.narration.receive_from(&mut self.message)?
        {
            messages += 1;
            let now_ns = clock::monotonic_ns();
            let received = checked.map(|()| &*self.message);
            let source = received.as_ref().map_or(0, |received| received.source);
            if !self.intake.knows_port(sender) {
                self.intake.note_alive(self.narration.senders());
            }
            // The successor of a killed narrator takes over its quota at once.
            let epoch = received.as_ref().map_or(0, |received| received.epoch);
            if self.intake.is_contested(source, epoch, sender) {
                self.intake.note_alive(self.narration.senders().into_iter().filter(|sender| sender.is_running()));
            }
            let name = self.message.source_name();
            let refused = match self.intake.receive(received, sender, now_ns) {
                Taken::Accepted { observation, missed, quota, leaves, binds, ahead_ns } => {
                    if let Some(ahead_ns) = ahead_ns
                        && let Some(not_told) = self.log_ahead.pass(now_ns)
                    {
                        let ahead_s = ahead_ns as f64 / 1e9;
                        tracing::warn!(source, name, ahead_s, not_told, "{FAST_CLOCK}");
                    }
                    let number = self.journal.as_ref().map_or(0, |journal| {
                        if binds {
                            let start = (observation.source, observation.epoch);
                            journal.handle.append(Record::Port { start, port: sender });
                        }
                        journal.handle.append(&observation)
                    });
                    let entry = Entry { observation, received_ns: now_ns, after_gap: missed > 0, quota, leaves };
                    take(Heard::Entry(entry, number));
                    match missed {
                        0 => None,
                        1 => Some("1 narration before it was lost".to_owned()),
                        _ => Some(format!("{missed} narrations before it were lost")),
                    }
                }
                Taken::Duplicate => None,
                Taken::Limited => Some("it comes faster than daemon.intake allows, and is dropped".to_owned()),
                Taken::Forged => Some(
                    "another process speaks in its name, and is not heard: end one of the two, or restart the narrator"
                        .to_owned(),
                ),
                Taken::Costly { tokens, most, first } => {
                    take(Heard::PassedOver(EventId::new(source, self.message.epoch, self.message.sequence)));
                    // A limit, because a process can invent any number of sources.
                    if first && let Some(not_told) = self.log_costly.pass(now_ns) {
                        tracing::warn!(
                            source,
                            name,
                            tokens,
                            most,
                            not_told,
                            "a sentence costs more tokens than a window holds, and is dropped, as others of this source will be: shorten it, or raise model.context_tokens and history.tokens"
                        );
                    }
                    None
                }
                Taken::Malformed(why) => Some(why),
            };
            if let Some(why) = refused
                && let Some(not_told) = self.log_refused.pass(now_ns)
            {
                tracing::warn!(source, why, not_told, "narration");
            }
        }
        self.more = messages == AT_ONCE;
        if messages > 0 {
            let counters = (self.intake.counters(), self.intake.sources());
            *self.counters.lock().unwrap_or_else(PoisonError::into_inner) = counters;
        }
        Ok(())
    }
}

/// An event for the scorer.
pub(super) enum Heard {
    /// An accepted event, and its number in the state database.
    Entry(Entry, u64),
    /// A refused event.
    PassedOver(EventId),
}

/// The scoring thread's side: it holds the receiver, or has lent it to the standby thread.
pub(super) struct ReceiverLoan {
    own: Option<Box<EventReceiver>>,
    /// The standby thread has ended with the receiver.
    is_lost: bool,
    to_relief: Sender<Box<EventReceiver>>,
    from_relief: Receiver<Box<EventReceiver>>,
    queue: Receiver<Heard>,
    /// The standby thread must keep the receiver.
    busy: Arc<AtomicBool>,
    awake: Awake,
}

impl ReceiverLoan {
    /// The two sides; the scoring thread starts with the receiver, and waits as `awake` says.
    pub(super) fn new(receiver: EventReceiver, awake: Awake, progress: Progress, stop: Stop) -> (Self, Standby) {
        // There is one receiver, so sending it never blocks.
        let ((to_relief, from_scoring), (to_scoring, from_relief)) = (bounded(1), bounded(1));
        // A bounded one would take its whole memory at once.
        let (queue_in, queue) = unbounded();
        let busy = Arc::new(AtomicBool::new(false));
        let (kept, given) = (Arc::clone(&busy), from_relief.clone());
        let standby = Standby { from_scoring, to_scoring, given, queue: queue_in, busy: kept, progress, stop };
        (Self { own: Some(Box::new(receiver)), is_lost: false, to_relief, from_relief, queue, busy, awake }, standby)
    }

    /// Lends the receiver to the standby thread until [`ReceiverLoan::call_back`], unless the standby thread has it.
    pub(super) fn lend(&mut self) {
        self.busy.store(true, Ordering::SeqCst);
        // The receiver may have returned unnoticed. If it returns at this moment, the standby thread takes it back ([`Standby::give_back`]).
        if let Some(receiver) = self.own.take().or_else(|| self.from_relief.try_recv().ok()) {
            // It fails only if the standby thread has ended; the main thread also sees that.
            let _handed = self.to_relief.send(receiver);
        }
    }

    pub(super) fn call_back(&self) {
        self.busy.store(false, Ordering::SeqCst);
    }

    pub(super) fn is_here(&self) -> bool {
        self.own.is_some()
    }

    pub(super) fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// Events from the standby thread that are not taken yet.
    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    pub(super) fn has_more(&self) -> bool {
        !self.queue.is_empty() || self.own.as_ref().is_some_and(|receiver| receiver.more)
    }

    /// Sleeps until an event arrives or `patience` has passed. Passes all received events to `take`.
    pub(super) fn listen(&mut self, patience: Duration, mut take: impl FnMut(Heard)) {
        let mut has_taken = false;
        if self.own.is_none() {
            select! {
                recv(self.from_relief) -> receiver => {
                    self.is_lost = receiver.is_err();
                    self.own = receiver.ok();
                }
                recv(self.queue) -> received => if let Ok(heard) = received {
                    has_taken = true;
                    take(heard);
                },
                default(patience) => {}
            }
        }
        // Events of the standby thread are older than those in the port.
        for heard in self.queue.try_iter() {
            has_taken = true;
            take(heard);
        }
        if let Some(receiver) = &mut self.own {
            receiver.listen(if has_taken { Duration::ZERO } else { patience }, &mut self.awake, |heard| {
                has_taken = true;
                take(heard);
            });
        }
        if has_taken {
            self.awake.heard();
        }
    }
}

/// Receives while the scoring thread is busy.
pub(super) struct Standby {
    from_scoring: Receiver<Box<EventReceiver>>,
    to_scoring: Sender<Box<EventReceiver>>,
    /// Receivers that were returned to the scoring thread and not taken.
    given: Receiver<Box<EventReceiver>>,
    queue: Sender<Heard>,
    busy: Arc<AtomicBool>,
    progress: Progress,
    stop: Stop,
}

impl Standby {
    pub(super) fn run(self) {
        // It does not spin: the scorer needs the cores.
        let mut asleep = Awake::new(0);
        let moved = |now_ns| self.progress.standby_ns.store(now_ns, Ordering::Relaxed);
        loop {
            // Without the receiver it cannot hang. It ends with the scoring thread.
            moved(u64::MAX);
            let Ok(receiver) = self.from_scoring.recv() else { return };
            let mut own = Some(receiver);
            while let Some(mut receiver) = own {
                moved(clock::monotonic_ns().0);
                if self.queue.len() < QUEUE {
                    // It fails only if the scoring thread has ended; the main thread also sees that.
                    receiver.listen(STANDBY_POLL, &mut asleep, |heard| drop(self.queue.send(heard)));
                } else {
                    std::thread::sleep(STANDBY_POLL);
                }
                own = if self.is_to_keep() { Some(receiver) } else { self.give_back(receiver) };
            }
        }
    }

    fn is_to_keep(&self) -> bool {
        self.busy.load(Ordering::SeqCst) && !self.stop.requested()
    }

    /// Returns the receiver. If the scoring thread lends at this moment, it has found no receiver. The standby thread then takes it back, because
    /// otherwise no thread would receive events during a whole step.
    fn give_back(&self, receiver: Box<EventReceiver>) -> Option<Box<EventReceiver>> {
        // It fails only if the scoring thread has ended; the main thread also sees that.
        let _given = self.to_scoring.send(receiver);
        if self.is_to_keep() { self.given.try_recv().ok() } else { None }
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::Domain;

    use super::*;
    use crate::config::IntakeLimits;

    #[test]
    fn an_inbox_that_is_lent_while_it_comes_back_is_with_who_listens() {
        let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let domain = Domain::new(root.path(), &format!("receiver-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let intake = Intake::new(IntakeLimits::default());
        let receiver = EventReceiver::new(node.subscriber().unwrap(), intake, None, Counters::default());
        let (mut loan, standby) = ReceiverLoan::new(receiver, Awake::new(0), Progress::default(), Stop::default());
        loan.lend();
        let receiver = standby.from_scoring.try_recv().unwrap();
        loan.call_back();
        assert!(!standby.is_to_keep());
        loan.lend();
        let receiver = standby.give_back(receiver).expect("it is heard from during the step");
        loan.call_back();
        assert!(standby.give_back(receiver).is_none());
        loan.listen(Duration::from_millis(1), drop);
        assert!(loan.is_here() && !loan.is_lost());
        drop((loan, node));
        domain.clean_up().unwrap();
    }
}
