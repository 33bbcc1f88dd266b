//! The thread that scores ahead ([`Ahead`]), at a lower priority than everything else: whoever has something to do gets most of its core. It stops
//! within a small call of the model when narration comes, and goes on from the next [`Now`].

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use roomcast_core::prepared::{ANSWERS_MAX, Answer};
use roomcast_core::scorer::{IsStopped, LanguageModel, ModelError, ScoreError};
use rustix::process::nice;
use rustix::time::{ClockId, clock_gettime};

use super::LOG_INTERVAL_NS;
use super::ahead::{Ahead, Now};
use crate::clock;
use crate::logging::Limiter;
use crate::power;

/// How much nicer than the rest the thread is: it has a ninth of what they have of a core that both want. Under SCHED_IDLE, or with all the niceness
/// that there is, it would get no time on a busy machine for many seconds, also to leave a lock that another thread waits for, or to end.
const NICER: i32 = 10;

/// What both sides share: which moment is worked for, and what the work took.
#[derive(Debug, Default)]
struct Shared {
    /// Grows with every event.
    moment: AtomicU64,
    /// The moment that is worked for.
    worked_for: AtomicU64,
    spent_ns: AtomicU64,
}

/// The scoring thread's side.
#[derive(Debug)]
pub(super) struct Desk {
    shared: Arc<Shared>,
    now: Sender<(u64, Now)>,
    /// To take back what was not read yet.
    unread: Receiver<(u64, Now)>,
    answers: Receiver<Answer>,
}

/// The other thread's side.
#[derive(Debug)]
pub(super) struct Aside {
    shared: Arc<Shared>,
    now: Receiver<(u64, Now)>,
    answers: Sender<Answer>,
    /// What this may take of a core.
    share: f64,
    on_battery: bool,
    log: Limiter,
}

/// Both sides; `share` of a core is taken at most, and on battery none unless `on_battery`.
pub(super) fn pair(share: f64, on_battery: bool) -> (Desk, Aside) {
    let shared = Arc::<Shared>::default();
    let ((now, unread), (answered, answers)) = (bounded(1), bounded(ANSWERS_MAX));
    let log = Limiter::new(LOG_INTERVAL_NS);
    let aside = Aside { shared: Arc::clone(&shared), now: unread.clone(), answers: answered, share, on_battery, log };
    (Desk { shared, now, unread, answers }, aside)
}

impl Desk {
    /// Something was narrated: what is being scored is of no use any more, and takes a core and memory from what is.
    pub(super) fn interrupt(&self) {
        self.shared.moment.fetch_add(1, Ordering::SeqCst);
    }

    /// Begins with what is so now, in place of what was not begun.
    pub(super) fn look(&self, now: Now) {
        let moment = self.shared.moment.fetch_add(1, Ordering::SeqCst) + 1;
        if let Err(TrySendError::Full(now)) = self.now.try_send((moment, now)) {
            let _replaced = self.unread.try_recv();
            // There is room: nobody else sends. It fails only where the other side has ended, and the main thread sees that too.
            let _sent = self.now.try_send(now);
        }
    }

    /// The answers that have come since.
    pub(super) fn answers(&self) -> impl Iterator<Item = Answer> {
        self.answers.try_iter()
    }

    /// Time of the processor that was spent, in nanoseconds.
    pub(super) fn spent_ns(&self) -> u64 {
        self.shared.spent_ns.load(Ordering::Relaxed)
    }
}

impl Drop for Desk {
    /// Whoever waits for the thread's end waits for a small call of the model.
    fn drop(&mut self) {
        self.interrupt();
    }
}

impl Aside {
    /// Whether what is worked for is over, for the model to look at.
    pub(super) fn is_stopped(&self) -> IsStopped {
        let shared = Arc::clone(&self.shared);
        Arc::new(move || shared.moment.load(Ordering::SeqCst) != shared.worked_for.load(Ordering::SeqCst))
    }

    /// Works until the other side ends.
    pub(super) fn run<M: LanguageModel, D: LanguageModel>(mut self, mut ahead: Ahead<M, D>) {
        if let Err(error) = lower_priority() {
            tracing::warn!(%error, "answers are prepared at the priority of everything else: the system does not lower it");
        }
        let is_stopped = self.is_stopped();
        let mut rests_until = Instant::now();
        let Ok(mut news) = self.now.recv() else { return };
        loop {
            // What was taken is rested first, while there may be something newer.
            match self.now.recv_deadline(rests_until) {
                Ok(newer) => {
                    news = newer;
                    continue;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            let (moment, now) = news;
            self.shared.worked_for.store(moment, Ordering::SeqCst);
            self.work(&mut rests_until, || ahead.look(now));
            news = loop {
                let goes_on = !ahead.is_done() && !is_stopped() && !self.pauses();
                let newer = match goes_on {
                    true => self.now.recv_deadline(rests_until),
                    false => self.now.recv().map_err(|_| RecvTimeoutError::Disconnected),
                };
                match newer {
                    Ok(newer) => break newer,
                    Err(RecvTimeoutError::Disconnected) => return,
                    Err(RecvTimeoutError::Timeout) if is_stopped() => {}
                    Err(RecvTimeoutError::Timeout) => self.answer(&mut ahead, &mut rests_until),
                }
            };
        }
    }

    /// Scores one guess. Where that fails, nothing is left to do.
    fn answer<M: LanguageModel, D: LanguageModel>(&mut self, ahead: &mut Ahead<M, D>, rests_until: &mut Instant) {
        match self.work(rests_until, || ahead.answer()) {
            // There is room for all that is kept: who does not take them has no time, and they are soon stale.
            Ok(Some(answer)) => drop(self.answers.try_send(answer)),
            Ok(None) | Err(ScoreError::Model(ModelError::Stopped)) => {}
            Err(error) => {
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, not_told, "an answer cannot be prepared; the event is scored when it comes");
                }
            }
        }
    }

    /// Does something; until then nothing is done, so that this takes its share.
    fn work<T>(&self, rests_until: &mut Instant, work: impl FnOnce() -> T) -> T {
        let before_ns = thread_ns();
        let done = work();
        let took_ns = thread_ns().saturating_sub(before_ns);
        self.shared.spent_ns.fetch_add(took_ns, Ordering::Relaxed);
        *rests_until = Instant::now() + Duration::from_nanos((took_ns as f64 * (1.0 / self.share - 1.0)) as u64);
        done
    }

    /// Whether the machine runs on battery, and nothing is to be done then.
    fn pauses(&self) -> bool {
        !self.on_battery && power::is_on_battery(Path::new(power::SUPPLIES))
    }
}

/// Time that this thread has had of the processor, in nanoseconds.
fn thread_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    u64::try_from(i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec)).unwrap_or_default()
}

/// On Linux a thread's own.
fn lower_priority() -> io::Result<()> {
    Ok(nice(NICER).map(drop)?)
}
