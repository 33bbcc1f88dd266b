//! The state database in `roomcast.db`, which outlives the daemon. One thread writes to it; the way from event to scores never waits for the disk.
//!
//! Observations are kept as they came. The daemon's attribution and the model's expectation are kept with them, so that a restarted daemon believes
//! the same. Events from before a change of the map are not read with the new map: a belief keeps their result.
//!
//! A commit outlives the daemon at once; a power loss takes at most the time between two syncs. The tables are in `journal/schema.sql`,
//! and its migrations in the other `.sql` files, in the order of `SCHEMA` below.

use std::fs;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, bounded};
pub use roomcast_database::DatabaseError as JournalError;
use roomcast_database::rusqlite::{Error, ErrorCode};
use roomcast_database::{Database, Schema};

pub use self::learned::HabitRows;
pub use self::old::memory as old_memory;
pub use self::old::records as old_records;
pub(super) use self::old::{habits as old_habits, persons as old_persons};
pub use self::record::{Expectation, KeptPerson, Move, Moved, Outcome, Record};
pub use self::recovered::Recovered;
pub use self::week::{PersonDay, week};
use self::writer::SyncDue;
pub use self::writer::Writer;
use super::habits::Memory;

mod forget;
mod learned;
mod old;
mod old_habits;
mod record;
mod recovered;
mod store;
mod week;
mod writer;

/// The database in the state directory.
pub const FILE: &str = "roomcast.db";
/// Its tables; the number marks Roomcast's files.
pub const SCHEMA: Schema = Schema {
    application: 0x524d_4353,
    migrations: &[
        include_str!("journal/schema.sql"),
        include_str!("journal/departures.sql"),
        include_str!("journal/names.sql"),
        include_str!("journal/views.sql"),
        include_str!("journal/map.sql"),
        include_str!("journal/contexts.sql"),
        include_str!("journal/found.sql"),
    ],
};
/// Records that may wait for the disk before the sender does.
const QUEUE: usize = 8_192;
/// Longest wait of a change for the disk.
pub(super) const PATIENCE: Duration = Duration::from_secs(5);

/// The threads' view of the journal.
#[derive(Debug, Default)]
struct Progress {
    sink: Mutex<Sink>,
    written: Mutex<u64>,
    grew: Condvar,
    bytes: AtomicU64,
    failures: AtomicU64,
    /// The newest habits that are not written.
    habits: Mutex<Option<Memory>>,
    /// The last sync has failed, so a restarted daemon may lack events.
    is_unsynced: AtomicBool,
}

/// Work for the writer.
enum Work {
    /// Append a record.
    Append(Record),
    /// Anything else, behind the records before it.
    Do(Box<dyn FnOnce(&mut Writer) + Send>),
}

/// The way to the writer.
#[derive(Debug, Default)]
struct Sink {
    /// `None` after the end of the journal.
    work: Option<Sender<Work>>,
    /// How many records were handed over.
    appended: u64,
}

/// The journal of a running daemon. It ends with this.
#[derive(Debug)]
pub struct Journal {
    /// Access for other threads.
    pub handle: JournalHandle,
    writer: Option<JoinHandle<()>>,
}

impl Journal {
    /// Opens or begins the database in the state directory and reads it. Its events have about `bytes_max` at most.
    ///
    /// # Errors
    ///
    /// [`JournalError`]; damage is no error.
    pub fn open(directory: &Path, bytes_max: u64, sync_every: Duration) -> Result<(Self, Recovered), JournalError> {
        let path = directory.join(FILE);
        let opened = Database::open(&path, SCHEMA)?;
        let (mut writer, recovered) = Writer::open(opened, Some(directory.to_owned()), bytes_max, &boot_id())
            .map_err(|source| JournalError::Sqlite(path.clone(), source))?;
        let handle = JournalHandle { progress: Arc::clone(&writer.progress) };
        let (work, queue) = bounded(QUEUE);
        handle.sink().work = Some(work);
        let writer = std::thread::Builder::new()
            .name("journal".to_owned())
            .spawn(move || run(&mut writer, &queue, sync_every))
            .map_err(|source| JournalError::File(path, "start the writer of", source))?;
        Ok((Self { handle, writer: Some(writer) }, recovered))
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        drop(self.handle.sink().work.take());
        if let Some(writer) = self.writer.take() {
            // A writer that panicked has said so; there is nothing left to do here.
            let _ended = writer.join();
        }
    }
}

/// Access to the journal, for any thread.
#[derive(Debug, Clone)]
pub struct JournalHandle {
    progress: Arc<Progress>,
}

impl JournalHandle {
    fn sink(&self) -> MutexGuard<'_, Sink> {
        self.progress.sink.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands a record to the writer; returns its number, for [`JournalHandle::wait_for`]. Waits if the queue is full, and all other threads with it, so
    /// that records have the numbers of their order.
    pub fn append(&self, record: impl Into<Record>) -> u64 {
        let mut sink = self.sink();
        let is_sent = sink.work.as_ref().is_some_and(|work| work.send(Work::Append(record.into())).is_ok());
        sink.appended += u64::from(is_sent);
        sink.appended
    }

    /// Passes habits to the writer. If it cannot write them, the next ones replace them.
    pub(super) fn keep_habits(&self, memory: Memory) {
        *self.progress.habits.lock().unwrap_or_else(PoisonError::into_inner) = Some(memory);
        if let Some(queue) = self.queue() {
            // If the queue is full, they wait for the next ones, or for the end.
            let _sent = queue.try_send(Work::Do(Box::new(|writer| _ = writer.tries(Writer::write_waiting_habits))));
        }
    }

    fn queue(&self) -> Option<Sender<Work>> {
        self.sink().work.clone()
    }

    /// Lets the writer do some work behind the records before it, and waits for that `until` then.
    ///
    /// # Errors
    /// When the disk refuses, or takes longer. The database has all of the work or none.
    pub(super) fn ask<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Writer) -> Result<T, Error> + Send + 'static,
        until: Instant,
    ) -> io::Result<T> {
        let (done, answer) = bounded(1);
        // The asker may have lost patience.
        let work = Work::Do(Box::new(move |writer| _ = done.send(work(writer).map_err(with_kind))));
        match self.queue().map(|queue| queue.send_deadline(work, until)) {
            Some(Ok(())) => {
                answer.recv_deadline(until).unwrap_or_else(|_| Err(io::Error::from(io::ErrorKind::TimedOut)))
            }
            Some(Err(SendTimeoutError::Timeout(_))) => Err(io::Error::from(io::ErrorKind::TimedOut)),
            Some(Err(SendTimeoutError::Disconnected(_))) | None => Err(io::Error::other("the journal is closed")),
        }
    }

    /// Waits until the record of that number has been handed to the system, at most `patience`; returns whether it has.
    ///
    /// A commit runs in parallel with scoring and ends long before it, so this hardly ever waits.
    #[must_use]
    pub fn wait_for(&self, number: u64, patience: Duration) -> bool {
        let written = self.progress.written.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.progress.grew.wait_timeout_while(written, patience, |written| *written < number);
        let (written, _) = waited.unwrap_or_else(PoisonError::into_inner);
        *written >= number
    }

    /// Records that have been handed to the system (or that it refused: no narrator waits for a full disk).
    #[must_use]
    pub fn written(&self) -> u64 {
        *self.progress.written.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes on disk, of file and log.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.progress.bytes.load(Ordering::Relaxed)
    }

    /// Whether the last sync went well: the disk has all commits, and the file has its name.
    pub(super) fn is_kept(&self) -> bool {
        !self.progress.is_unsynced.load(Ordering::Relaxed)
    }

    /// Writes or syncs that failed: a full disk, for instance. The daemon goes on without them.
    #[must_use]
    pub fn failures(&self) -> u64 {
        self.progress.failures.load(Ordering::Relaxed)
    }
}

/// The writer's thread.
fn run(writer: &mut Writer, queue: &Receiver<Work>, sync_every: Duration) {
    let mut due = SyncDue::new(sync_every, Instant::now());
    loop {
        let now = Instant::now();
        // Without work there is no time.
        let until = due.at().or_else(|| writer.is_behind().then_some(now + sync_every));
        let received = match until {
            Some(until) => queue.recv_deadline(until),
            None => queue.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        match received {
            Ok(work) => {
                do_work(writer, work, queue);
                due.wrote(Instant::now());
            }
            Err(RecvTimeoutError::Timeout) if writer.is_behind() => {
                if writer.tries(|writer| writer.write([])) {
                    due.wrote(Instant::now());
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        if due.at().is_some_and(|at| Instant::now() >= at) {
            due.synced(writer.tries(Writer::sync), Instant::now());
        }
    }
    writer.tries(|writer| writer.write([]));
    writer.tries(Writer::write_waiting_habits);
    writer.tries(|writer| writer.sync().or_else(|_| writer.sync()));
}

/// Does some work, and what waits behind it.
fn do_work(writer: &mut Writer, first: Work, queue: &Receiver<Work>) {
    let mut batch = Vec::new();
    // What waits already goes out in one transaction.
    for work in std::iter::once(first).chain(queue.try_iter().take(1023)) {
        match work {
            Work::Append(record) => batch.push(record),
            Work::Do(work) => {
                append(writer, std::mem::take(&mut batch));
                work(writer);
            }
        }
    }
    append(writer, batch);
}

/// Writes records; their number counts also when that fails: no narrator waits for a full disk.
fn append(writer: &mut Writer, batch: Vec<Record>) {
    let records = batch.len() as u64;
    if records > 0 {
        writer.tries(|writer| writer.write(batch));
        *writer.progress.written.lock().unwrap_or_else(PoisonError::into_inner) += records;
        writer.progress.grew.notify_all();
    }
}

fn with_kind(error: Error) -> io::Error {
    let is_busy = error.sqlite_error_code() == Some(ErrorCode::DatabaseBusy);
    io::Error::new(if is_busy { io::ErrorKind::ResourceBusy } else { io::ErrorKind::Other }, error)
}

/// Monotonic times of another boot say nothing about this one.
fn boot_id() -> [u8; 16] {
    let text = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let id = hex::decode(text.trim().replace('-', "")).unwrap_or_default();
    id.try_into().unwrap_or_default()
}

/// The content of the database in a state directory, also while a daemon uses it.
///
/// # Errors
/// When there is none, or it cannot be read.
pub fn look(directory: &Path) -> Result<Recovered, Error> {
    store::recover(&roomcast_database::look(&directory.join(FILE))?.transaction()?)
}

#[cfg(test)]
pub(super) mod notes;
#[cfg(test)]
mod tests;
