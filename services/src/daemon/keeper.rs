//! The thread that turns habits into rows for the state database, in parallel with scoring. The scoring thread waits for it only to forget habits, and at
//! the end.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, bounded};

use super::habits::Memory;
use super::journal::{HabitRows, JournalHandle};

/// Longest wait of a write for the disk.
const PATIENCE: Duration = Duration::from_secs(60);

/// Work for the keeper.
enum Work {
    Write(Box<Memory>),
    /// As `Write`, after a person was forgotten: no byte of the old rows may stay. It gets an answer.
    Forget(Box<Memory>, Instant, Sender<io::Result<()>>),
}

#[derive(Debug)]
pub(super) struct Keeper {
    /// The last write has failed.
    failed: Arc<AtomicBool>,
    work: Option<Sender<Work>>,
    thread: Option<JoinHandle<()>>,
}

impl Keeper {
    /// Starts the thread.
    pub(super) fn start(journal: JournalHandle) -> io::Result<Self> {
        let (work, queue) = bounded(1);
        let failed = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&failed);
        let thread =
            std::thread::Builder::new().name("habits".to_owned()).spawn(move || run(&journal, &queue, &told))?;
        Ok(Self { failed, work: Some(work), thread: Some(thread) })
    }

    /// Whether the last write has failed, so that the habits must be passed again. Returns true once per failure.
    pub(super) fn has_failed(&self) -> bool {
        self.failed.swap(false, Ordering::Relaxed)
    }

    /// Passes habits to the thread. Returns false if the last ones still wait.
    pub(super) fn write(&self, memory: Memory) -> bool {
        self.work.as_ref().is_some_and(|work| work.try_send(Work::Write(Box::new(memory))).is_ok())
    }

    /// Passes the last habits to the thread, and waits for its end.
    pub(super) fn finish(&mut self, memory: Option<Memory>) {
        if let (Some(work), Some(memory)) = (&self.work, memory) {
            // It fails only if the thread has ended, and the log says so.
            let _handed = work.send(Work::Write(Box::new(memory)));
        }
        drop(self.work.take());
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
    }

    /// Writes the remaining habits after a person was forgotten, and waits `until` then.
    pub(super) fn forget(&self, memory: Memory, until: Instant) -> io::Result<()> {
        let (done, answer) = bounded(1);
        let work = Work::Forget(Box::new(memory), until, done);
        let sent = self.work.as_ref().map(|queue| queue.send_deadline(work, until));
        match sent.map(|sent| sent.map(|()| answer.recv_deadline(until))) {
            Some(Ok(Ok(result))) => result,
            _ => Err(io::Error::from(io::ErrorKind::TimedOut)),
        }
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        self.finish(None);
    }
}

fn run(journal: &JournalHandle, queue: &Receiver<Work>, failed: &AtomicBool) {
    let write = |memory: &Memory, is_forgotten: bool, until: Instant| {
        let rows = HabitRows::of(memory).map_err(io::Error::other);
        let written = rows.and_then(|rows| journal.write_habits(rows, is_forgotten, until));
        failed.store(written.is_err(), Ordering::Relaxed);
        written.inspect_err(|error| {
            tracing::warn!(%error, "the habits cannot be written to the state database; the daemon tries again later");
        })
    };
    for work in queue {
        match work {
            Work::Write(memory) => _ = write(&memory, false, Instant::now() + PATIENCE),
            Work::Forget(memory, until, done) => {
                // The asker may have stopped waiting.
                let _told = done.send(write(&memory, true, until));
            }
        }
    }
}
