//! The prefetcher's thread ([`Prefetcher`]) at a low priority, so that other threads get most of its core. It stops within one small call of the model
//! when an event arrives, and continues with the next [`Now`].

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
use super::prefetch::{Now, Prefetcher};
use crate::clock;
use crate::logging::Limiter;
use crate::power;

/// The thread's niceness. On a core that another thread also wants, it gets a ninth of that thread's time. Under `SCHED_IDLE` or at niceness 19, the
/// thread would wait for many seconds on a busy machine. It would then also not release a lock that another thread needs, and not end.
const NICER: i32 = 10;

#[derive(Debug, Default)]
struct Shared {
    /// Grows with every event and every look.
    moment: AtomicU64,
    /// The prefetcher works for this moment. If `moment` is another, its work is stale.
    worked_for: AtomicU64,
    spent_ns: AtomicU64,
}

#[derive(Debug)]
pub(super) struct PrefetchHandle {
    shared: Arc<Shared>,
    now: Sender<(u64, Now)>,
    /// Takes back a look that the prefetcher has not read.
    unread: Receiver<(u64, Now)>,
    answers: Receiver<Answer>,
}

/// The prefetcher's side.
#[derive(Debug)]
pub(super) struct PrefetchThread {
    shared: Arc<Shared>,
    now: Receiver<(u64, Now)>,
    answers: Sender<Answer>,
    /// The thread's quota of a core, at most 1.
    share: f64,
    on_battery: bool,
    log: Limiter,
}

/// The two sides. The prefetcher uses at most `share` of a core, and on battery none unless `on_battery`.
pub(super) fn pair(share: f64, on_battery: bool) -> (PrefetchHandle, PrefetchThread) {
    let shared = Arc::<Shared>::default();
    let ((now, unread), (answered, answers)) = (bounded(1), bounded(ANSWERS_MAX));
    let log = Limiter::new(LOG_INTERVAL_NS);
    let prefetching =
        PrefetchThread { shared: Arc::clone(&shared), now: unread.clone(), answers: answered, share, on_battery, log };
    (PrefetchHandle { shared, now, unread, answers }, prefetching)
}

impl PrefetchHandle {
    /// Stops the current guess: an event arrived, and the guess would take its core and memory.
    pub(super) fn interrupt(&self) {
        self.shared.moment.fetch_add(1, Ordering::SeqCst);
    }

    /// Replaces a look that the prefetcher has not read.
    pub(super) fn look(&self, now: Now) {
        let moment = self.shared.moment.fetch_add(1, Ordering::SeqCst) + 1;
        if let Err(TrySendError::Full(now)) = self.now.try_send((moment, now)) {
            let _replaced = self.unread.try_recv();
            // There is room, because only this side sends. It fails only if the other side has ended; the main thread also sees that.
            let _sent = self.now.try_send(now);
        }
    }

    pub(super) fn answers(&self) -> impl Iterator<Item = Answer> {
        self.answers.try_iter()
    }

    /// CPU time of the prefetcher, in nanoseconds.
    pub(super) fn spent_ns(&self) -> u64 {
        self.shared.spent_ns.load(Ordering::Relaxed)
    }
}

impl Drop for PrefetchHandle {
    /// The thread then ends within one small call of the model.
    fn drop(&mut self) {
        self.interrupt();
    }
}

impl PrefetchThread {
    /// Tells the model whether the work is stale.
    pub(super) fn is_stopped(&self) -> IsStopped {
        let shared = Arc::clone(&self.shared);
        Arc::new(move || shared.moment.load(Ordering::SeqCst) != shared.worked_for.load(Ordering::SeqCst))
    }

    /// Runs until the other side ends.
    pub(super) fn run<M: LanguageModel, D: LanguageModel>(mut self, mut ahead: Prefetcher<M, D>) {
        if let Err(error) = lower_priority() {
            tracing::warn!(%error, "answers are prepared at the priority of everything else: the system does not lower it");
        }
        let is_stopped = self.is_stopped();
        let mut rests_until = Instant::now();
        let Ok(mut news) = self.now.recv() else { return };
        loop {
            // Resting keeps the prefetcher within its share of a core. A newer look may come while it rests.
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

    fn answer<M: LanguageModel, D: LanguageModel>(&mut self, ahead: &mut Prefetcher<M, D>, rests_until: &mut Instant) {
        match self.work(rests_until, || ahead.answer()) {
            // A full queue means that the scoring thread is busy; these answers would soon be stale.
            Ok(Some(answer)) => drop(self.answers.try_send(answer)),
            Ok(None) | Err(ScoreError::Model(ModelError::Stopped)) => {}
            Err(error) => {
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, not_told, "an answer cannot be prepared; the event is scored when it comes");
                }
            }
        }
    }

    /// Sets the pause that keeps the quota after this work.
    fn work<T>(&self, rests_until: &mut Instant, work: impl FnOnce() -> T) -> T {
        let before_ns = thread_ns();
        let done = work();
        let took_ns = thread_ns().saturating_sub(before_ns);
        self.shared.spent_ns.fetch_add(took_ns, Ordering::Relaxed);
        *rests_until = Instant::now() + Duration::from_nanos((took_ns as f64 * (1.0 / self.share - 1.0)) as u64);
        done
    }

    fn pauses(&self) -> bool {
        !self.on_battery && power::is_on_battery(Path::new(power::SUPPLIES))
    }
}

fn thread_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    u64::try_from(i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec)).unwrap_or_default()
}

/// On Linux, niceness belongs to the thread.
fn lower_priority() -> io::Result<()> {
    Ok(nice(NICER).map(drop)?)
}
