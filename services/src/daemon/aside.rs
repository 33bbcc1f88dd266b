//! The thread that scores ahead ([`Ahead`]), at the lowest priority: the system takes its core away for whoever has something to do. It stops
//! within a small call of the model when narration comes, and goes on from the next [`Now`].

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use roomcast_core::prepared::{ANSWERS_MAX, Answer};
use roomcast_core::scorer::{IsStopped, LanguageModel, ModelError, ScoreError};
use rustix::time::{ClockId, clock_gettime};

use super::LOG_INTERVAL_NS;
use super::ahead::{Ahead, Now};
use crate::logging::Limiter;
use crate::power;
use roomcast_ipc::clock;

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
    /// Whoever waits for the thread's end waits for a small call of the model at most.
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
    pub(super) fn run<M: LanguageModel>(mut self, mut ahead: Ahead<M>) {
        if let Err(error) = lower_priority() {
            tracing::warn!(%error, "answers are prepared at the priority of everything else: the system does not lower it");
        }
        let is_stopped = self.is_stopped();
        let mut next = self.now.recv().ok();
        while let Some((moment, now)) = next.take() {
            self.shared.worked_for.store(moment, Ordering::SeqCst);
            let mut wait = if self.pauses() { None } else { self.work(|| ahead.look(now)).1 };
            while let Some(pause) = wait
                && next.is_none()
            {
                match self.now.recv_timeout(pause) {
                    Ok(newer) => next = Some(newer),
                    Err(RecvTimeoutError::Disconnected) => return,
                    Err(RecvTimeoutError::Timeout) if is_stopped() || ahead.is_done() => wait = None,
                    Err(RecvTimeoutError::Timeout) => wait = self.answer(&mut ahead),
                }
            }
            if next.is_none() {
                next = self.now.recv().ok();
            }
        }
    }

    /// Scores one guess. Gives how long to do nothing then; none where nothing is left to do.
    fn answer<M: LanguageModel>(&mut self, ahead: &mut Ahead<M>) -> Option<Duration> {
        let (answered, pause) = self.work(|| ahead.answer());
        match answered {
            // There is room for all that is kept: who does not take them has no time, and they are soon stale.
            Ok(Some(answer)) => drop(self.answers.try_send(answer)),
            Ok(None) | Err(ScoreError::Model(ModelError::Stopped)) => return None,
            Err(error) => {
                if let Some(held_back) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, held_back, "an answer cannot be prepared; the event is scored when it comes");
                }
                return None;
            }
        }
        pause
    }

    /// Does something, and gives for how long to do nothing then, so that this takes its share.
    fn work<T>(&self, work: impl FnOnce() -> T) -> (T, Option<Duration>) {
        let before_ns = thread_ns();
        let done = work();
        let took_ns = thread_ns().saturating_sub(before_ns);
        self.shared.spent_ns.fetch_add(took_ns, Ordering::Relaxed);
        (done, Some(Duration::from_nanos((took_ns as f64 * (1.0 / self.share - 1.0)) as u64)))
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

/// Lets this thread run only where nobody else wants to: under SCHED_IDLE. A niceness is not enough: whoever wakes up on its core may wait for the
/// end of its slice, which is 3 ms.
///
/// libc, which is in the build anyway, because rustix has no such call, and the crates that have one bring a dozen others.
fn lower_priority() -> io::Result<()> {
    let none = libc::sched_param { sched_priority: 0 };
    #[expect(unsafe_code, reason = "no safe crate of this build has the call")]
    // SAFETY: the thread is the calling one, so it runs; the parameters live until the call returns, which only reads them.
    let failed = unsafe { libc::pthread_setschedparam(libc::pthread_self(), libc::SCHED_IDLE, &raw const none) };
    if failed == 0 { Ok(()) } else { Err(io::Error::from_raw_os_error(failed)) }
}
