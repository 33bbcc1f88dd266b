//! What hears narrators: the port, the intake and the journal. It belongs to one thread at a time.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, bounded};
use crossbeam::select;
use roomcast_core::ids::EventId;
use roomcast_ipc::raw::NarrationV1;
use roomcast_ipc::{IpcError, Subscriber};

use super::board::Entry;
use super::intake::{Intake, IntakeCounters, Taken};
use super::journal::Journal;
use super::{LOG_INTERVAL_NS, Progress};
use crate::awake::Awake;
use crate::clock;
use crate::logging::Limiter;
use crate::stop::Stop;

/// Observations that may wait for the scorer.
pub(super) const QUEUE: usize = 65_536;
/// Messages taken from the port at once: a flood of them must not keep the scorer from its steps.
const AT_ONCE: usize = 2048;
/// The relief thread has the inbox at most so long after a step; an event that comes meanwhile wakes both threads.
const RELIEF: Duration = Duration::from_millis(5);

const FAST_CLOCK: &str = "the clock of this narrator's input is fast: its events count as observed now, and older ones as newer than they \
    are; set the clock of the machine that dates them (NTP)";

/// Counters of the intake, and sources known.
pub(super) type Counters = Arc<Mutex<(IntakeCounters, usize)>>;

/// Hears narrators, for whoever has it.
pub(super) struct Inbox {
    narration: Subscriber<NarrationV1>,
    /// What the port gave last.
    message: Box<NarrationV1>,
    intake: Intake,
    journal: Option<Journal>,
    counters: Counters,
    /// The port was not emptied the last time.
    more: bool,
    log_refused: Limiter,
    log_costly: Limiter,
    log_ahead: Limiter,
    log_port: Limiter,
}

impl Inbox {
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

    /// Sleeps until there is narration or `patience` has passed, as long as `awake` lets it; gives what is there to `take`.
    fn listen(&mut self, patience: Duration, awake: &mut Awake, take: impl FnMut(Heard)) {
        // The port wakes once for all that came, so nothing would wake for what was left there.
        let narration = &self.narration;
        let waited = if self.more { Ok(true) } else { awake.wait(patience, |patience| narration.wait(patience)) };
        let received = waited.and_then(|_| self.drain(take));
        if let Err(error) = received {
            // A port that fails may recover, when file descriptors become free for instance.
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
            // A killed narrator's successor has its voice at once.
            let epoch = received.as_ref().map_or(0, |received| received.epoch);
            if self.intake.is_contested(source, epoch, sender) {
                self.intake.note_alive(self.narration.senders().into_iter().filter(|sender| sender.is_running()));
            }
            let name = self.message.source_name();
            let refused = match self.intake.receive(received, sender, now_ns) {
                Taken::Accepted { observation, missed, voice, leaves, binds, ahead_ns } => {
                    if let Some(ahead_ns) = ahead_ns
                        && let Some(not_told) = self.log_ahead.pass(now_ns)
                    {
                        let ahead_s = ahead_ns as f64 / 1e9;
                        tracing::warn!(source, name, ahead_s, not_told, "{FAST_CLOCK}");
                    }
                    let number = self.journal.as_mut().map_or(0, |journal| {
                        if binds {
                            journal.bind((observation.source, observation.epoch), sender);
                        }
                        journal.append(&observation)
                    });
                    let entry = Entry { observation, received_ns: now_ns, after_gap: missed > 0, voice, leaves };
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
                    // Sources may be invented.
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

/// What the inbox gives the scorer.
pub(super) enum Heard {
    /// An accepted observation, with its number in the journal.
    Entry(Entry, u64),
    /// One that was refused for good.
    PassedOver(EventId),
}

/// The scoring thread's side of the inbox: it has it, or has lent it to the relief thread.
pub(super) struct Lending {
    own: Option<Box<Inbox>>,
    /// The relief thread has ended, and the inbox with it.
    is_lost: bool,
    to_relief: Sender<Box<Inbox>>,
    from_relief: Receiver<Box<Inbox>>,
    /// What the relief thread received.
    queue: Receiver<Heard>,
    /// The relief thread is to keep the inbox.
    busy: Arc<AtomicBool>,
    awake: Awake,
}

impl Lending {
    /// With the inbox, and the relief thread's side of it; this one stays awake as `awake` says.
    pub(super) fn new(inbox: Inbox, awake: Awake, progress: Progress, stop: Stop) -> (Self, Relief) {
        // There is one inbox: sending it never waits.
        let ((to_relief, from_scoring), (to_scoring, from_relief)) = (bounded(1), bounded(1));
        let (queue_in, queue) = bounded(QUEUE);
        let busy = Arc::new(AtomicBool::new(false));
        let (kept, given) = (Arc::clone(&busy), from_relief.clone());
        let relief = Relief { from_scoring, to_scoring, given, queue: queue_in, busy: kept, progress, stop };
        (Self { own: Some(Box::new(inbox)), is_lost: false, to_relief, from_relief, queue, busy, awake }, relief)
    }

    /// Gives the inbox to the relief thread until [`Lending::call_back`], if it does not have it already.
    pub(super) fn lend(&mut self) {
        self.busy.store(true, Ordering::SeqCst);
        // It may have come back unnoticed, while something else did. One that comes back right now the relief thread takes again.
        if let Some(inbox) = self.own.take().or_else(|| self.from_relief.try_recv().ok()) {
            // It fails only when the relief thread is gone, and the main thread sees that too.
            let _handed = self.to_relief.send(inbox);
        }
    }

    /// Lets the relief thread return the inbox.
    pub(super) fn call_back(&self) {
        self.busy.store(false, Ordering::SeqCst);
    }

    /// Whether the inbox is at hand.
    pub(super) fn is_here(&self) -> bool {
        self.own.is_some()
    }

    /// Whether it will never come back.
    pub(super) fn is_lost(&self) -> bool {
        self.is_lost
    }

    /// Observations that the relief thread received.
    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Whether more was received, or lies in the port, than was taken.
    pub(super) fn has_more(&self) -> bool {
        !self.queue.is_empty() || self.own.as_ref().is_some_and(|inbox| inbox.more)
    }

    /// Sleeps until there is narration or `patience` has passed, and gives all that was received to `take`.
    pub(super) fn listen(&mut self, patience: Duration, mut take: impl FnMut(Heard)) {
        let mut has_taken = false;
        if self.own.is_none() {
            select! {
                recv(self.from_relief) -> inbox => {
                    self.is_lost = inbox.is_err();
                    self.own = inbox.ok();
                }
                recv(self.queue) -> received => if let Ok(heard) = received {
                    has_taken = true;
                    take(heard);
                },
                default(patience) => {}
            }
        }
        // First what the relief thread received, while it had the inbox.
        for heard in self.queue.try_iter() {
            has_taken = true;
            take(heard);
        }
        if let Some(inbox) = &mut self.own {
            inbox.listen(if has_taken { Duration::ZERO } else { patience }, &mut self.awake, |heard| {
                has_taken = true;
                take(heard);
            });
        }
        if has_taken {
            self.awake.heard();
        }
    }
}

/// Listens while the scoring thread is busy.
pub(super) struct Relief {
    from_scoring: Receiver<Box<Inbox>>,
    to_scoring: Sender<Box<Inbox>>,
    /// What was given to the scoring thread, and not taken by it.
    given: Receiver<Box<Inbox>>,
    queue: Sender<Heard>,
    busy: Arc<AtomicBool>,
    progress: Progress,
    stop: Stop,
}

impl Relief {
    pub(super) fn run(self) {
        // The scorer needs the cores.
        let mut asleep = Awake::new(0);
        let moved = |now_ns| self.progress.relief_ns.store(now_ns, Ordering::Relaxed);
        loop {
            // Without the inbox it has nothing to do, and so cannot stand still. It ends with the scoring thread.
            moved(u64::MAX);
            let Ok(inbox) = self.from_scoring.recv() else { return };
            let mut own = Some(inbox);
            while let Some(mut inbox) = own {
                moved(clock::monotonic_ns().0);
                // It fails only when the scoring thread is gone, and the main thread sees that too.
                inbox.listen(RELIEF, &mut asleep, |heard| drop(self.queue.send(heard)));
                own = if self.is_to_keep() { Some(inbox) } else { self.give_back(inbox) };
            }
        }
    }

    fn is_to_keep(&self) -> bool {
        self.busy.load(Ordering::SeqCst) && !self.stop.requested()
    }

    /// Gives the inbox to the scoring thread. Where that lends it at this moment it has found it nowhere: it comes back, since otherwise nobody would
    /// hear anything for a whole step.
    fn give_back(&self, inbox: Box<Inbox>) -> Option<Box<Inbox>> {
        // It fails only when the scoring thread is gone, and the main thread sees that too.
        let _given = self.to_scoring.send(inbox);
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
        let domain = Domain::new(root.path(), &format!("inbox-{}", std::process::id())).unwrap();
        let node = domain.open("test").unwrap();
        let intake = Intake::new(IntakeLimits::default());
        let inbox = Inbox::new(node.subscriber().unwrap(), intake, None, Counters::default());
        let (mut lending, relief) = Lending::new(inbox, Awake::new(0), Progress::default(), Stop::default());
        lending.lend();
        let inbox = relief.from_scoring.try_recv().unwrap();
        // Called back, and lent again before it has come.
        lending.call_back();
        assert!(!relief.is_to_keep());
        lending.lend();
        let inbox = relief.give_back(inbox).expect("it is heard from during the step");
        // Called back for good.
        lending.call_back();
        assert!(relief.give_back(inbox).is_none());
        lending.listen(Duration::from_millis(1), drop);
        assert!(lending.is_here() && !lending.is_lost());
        drop((lending, node));
        domain.clean_up().unwrap();
    }
}
