//! The narration history on disk, so that it outlives the daemon: an append-only file of records, each with a checksum, in two
//! halves of bounded size. A writer thread owns the file; nothing on the way from event to scores waits for the disk.
//!
//! Observations are kept as they came. What the daemon made of one that names nobody, and what the model said after it, is kept beside it, so
//! that a restarted daemon believes the same. What was said before the map changed is not read by the map of now: `RCJA` says what it came to.
//!
//! When the older half goes, the last record of every source that it alone knew is carried over: what the source said then is
//! history no more, but what it says again is still known. So is whose port each source is. The last observations of every person are
//! carried over as history, so that nobody who says much makes the daemon forget where others are: up to twelve of each, as far as a quarter of
//! a half holds them.
//!
//! A record is handed to the system as soon as it is written, so a daemon that is killed loses nothing; what the machine loses with
//! its power is at most the last [`JournalOptions::sync_ms`].

use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{SendTimeoutError, Sender, bounded};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::Observation;
use roomcast_ipc::Sender as Port;

use self::disk::Folder;
pub use self::disk::{Disk, Half};
use self::forget::IsTheirs;
pub use self::record::{Believed, Expectation, Move, Moved, Outcome, encode, encode_outcome, encode_port};
pub(super) use self::record::{encode_believed, encode_forgotten, encode_moved};
pub use self::recovered::{Recovered, read_records};
pub use self::writer::Writer;
use crate::state_file;

mod disk;
mod forget;
mod last_words;
mod record;
mod recovered;
mod writer;

/// Records that may wait for the disk before the sender does.
const QUEUE: usize = 65_536;

/// Where and how the journal is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JournalOptions {
    /// The state directory.
    pub directory: PathBuf,
    /// Most bytes on disk, both halves together.
    pub bytes_max: u64,
    /// Milliseconds between two syncs to the disk.
    pub sync_ms: u64,
}

/// A journal that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JournalError {
    /// A file operation failed.
    #[error("journal {}: cannot {operation} it: {source}; check owner, mode and space of the state directory", path.display())]
    File {
        /// The file or directory.
        path: PathBuf,
        /// "make", "open", "read", ...
        operation: &'static str,
        /// The system's word.
        source: io::Error,
    },
    /// Another user could have put it there, or may write to it.
    #[error("journal {}: {source}", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// The reason and the remedy.
        source: io::Error,
    },
    /// Another daemon has it.
    #[error("journal {}: another daemon is using it; stop that one, or set daemon.state to another directory", path.display())]
    Locked {
        /// The file.
        path: PathBuf,
    },
}

#[derive(Debug, Default)]
struct Progress {
    written: Mutex<u64>,
    grew: Condvar,
    bytes: AtomicU64,
    failures: AtomicU64,
    /// The last sync has failed, so a restarted daemon may not find what was said.
    is_unsynced: AtomicBool,
}

/// What the writer is to do.
enum Work {
    /// Append a record.
    Append(Vec<u8>),
    /// Take out what a person did, and say whether that went well.
    Forget { person: PersonId, is_theirs: Box<IsTheirs>, done: Sender<io::Result<usize>> },
}

/// The way to the writer, for every thread that has something to write.
#[derive(Debug)]
struct Sink {
    /// None once the journal is being closed.
    work: Option<Sender<Work>>,
    /// How many records were handed over.
    appended: u64,
}

impl Sink {
    /// Waits where the queue is full. Whoever holds the sink waits with it, so that records have the numbers of their order.
    fn send(&mut self, record: Vec<u8>) -> u64 {
        if let Some(work) = &self.work
            && work.send(Work::Append(record)).is_ok()
        {
            self.appended += 1;
        }
        self.appended
    }
}

/// The journal of a running daemon.
#[derive(Debug)]
pub struct Journal {
    sink: Arc<Mutex<Sink>>,
    boot_id: [u8; 16],
    progress: Arc<Progress>,
    writer: Option<JoinHandle<()>>,
}

impl Journal {
    /// Opens (or begins) the journal and reads what it holds.
    ///
    /// # Errors
    ///
    /// [`JournalError`]; damaged records are no error.
    pub fn open(options: &JournalOptions) -> Result<(Self, Recovered), JournalError> {
        let directory = &options.directory;
        let failed = |operation| {
            let path = directory.clone();
            move |source| JournalError::File { path, operation, source }
        };
        state_file::make_folder(directory).map_err(failed("make"))?;
        let folder = Folder::open(directory, options.bytes_max).map_err(|(path, operation, source)| {
            match (operation, source.kind()) {
                ("lock", io::ErrorKind::WouldBlock) => JournalError::Locked { path },
                (disk::USE, _) => JournalError::Refused { path, source },
                _ => JournalError::File { path, operation, source },
            }
        })?;
        let boot_id = boot_id();
        let sync_every = Duration::from_millis(options.sync_ms.max(1));
        let (writer, recovered) =
            Writer::open(folder, (options.bytes_max / 2).max(4096), &boot_id).map_err(failed("read"))?;
        let mut writer = Writer { sync_every, ..writer };
        let progress = Arc::clone(&writer.progress);

        let (work, queue) = bounded(QUEUE);
        let writer = std::thread::Builder::new()
            .name("journal".to_owned())
            .spawn(move || writer.run(&queue))
            .map_err(failed("start the writer of"))?;
        let sink = Arc::new(Mutex::new(Sink { work: Some(work), appended: 0 }));
        Ok((Self { sink, boot_id, progress, writer: Some(writer) }, recovered))
    }

    /// Hands an observation to the writer; returns its number, for [`JournalHandle::wait_for`].
    pub fn append(&mut self, observation: &Observation) -> u64 {
        let record = encode(observation, &self.boot_id);
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(record)
    }

    /// Hands to the writer which port speaks for a start of a source, by its number and epoch.
    pub fn bind(&mut self, name: (u64, u64), port: Port) {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_port(name, port));
    }

    /// What other threads may ask of the journal.
    #[must_use]
    pub fn handle(&self) -> JournalHandle {
        JournalHandle { sink: Arc::clone(&self.sink), progress: Arc::clone(&self.progress) }
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        drop(self.sink.lock().unwrap_or_else(PoisonError::into_inner).work.take());
        if let Some(writer) = self.writer.take() {
            // A writer that panicked has said so; there is nothing left to do here.
            let _ended = writer.join();
        }
    }
}

/// A view of the journal's progress.
#[derive(Debug, Clone)]
pub struct JournalHandle {
    sink: Arc<Mutex<Sink>>,
    progress: Arc<Progress>,
}

impl JournalHandle {
    /// Hands to the writer what became of an observation; returns its number, for [`JournalHandle::wait_for`].
    pub fn append(&self, outcome: &Outcome<'_>) -> u64 {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_outcome(outcome))
    }

    /// Hands to the writer whom an observation moved; returns its number, for [`JournalHandle::wait_for`].
    pub(super) fn keep_moved(&self, moved: &Moved) -> u64 {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_moved(moved))
    }

    /// Hands to the writer where somebody was believed to be when the map was changed; returns its number, for [`JournalHandle::wait_for`].
    pub(super) fn keep_belief(&self, believed: &Believed) -> u64 {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_believed(believed))
    }

    /// Hands to the writer that a visitor is gone, which was told: a restart does not tell it again.
    pub(super) fn see_off(&self, person: PersonId) {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_forgotten(person, false));
    }

    /// Takes out of the journal what a person did, before and after a restart of the machine: the observations of which `is_theirs` says so,
    /// which is told whose those are found to be that named nobody. Gives how many they are. Waits for it `until` then.
    ///
    /// # Errors
    ///
    /// When the disk refuses, or takes longer; the journal is whole all the same, and may hold all or part of it.
    pub fn forget(
        &self,
        person: PersonId,
        is_theirs: impl Fn(&Observation, Option<PersonId>) -> bool + Send + 'static,
        until: Instant,
    ) -> io::Result<usize> {
        let (done, answer) = bounded(1);
        let work = self.sink.lock().unwrap_or_else(PoisonError::into_inner).work.clone();
        let forget = Work::Forget { person, is_theirs: Box::new(is_theirs), done };
        match work.map(|work| work.send_deadline(forget, until)) {
            Some(Ok(())) => {
                answer.recv_deadline(until).unwrap_or_else(|_| Err(io::Error::from(io::ErrorKind::TimedOut)))
            }
            Some(Err(SendTimeoutError::Timeout(_))) => Err(io::Error::from(io::ErrorKind::TimedOut)),
            Some(Err(SendTimeoutError::Disconnected(_))) | None => Err(io::Error::other("the journal is closed")),
        }
    }

    /// Waits until the record of that number has been handed to the system, at most `patience`; returns whether it has.
    ///
    /// Writing runs beside scoring and is over long before, so this hardly ever waits.
    #[must_use]
    pub fn wait_for(&self, number: u64, patience: Duration) -> bool {
        let written = self.progress.written.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.progress.grew.wait_timeout_while(written, patience, |written| *written < number);
        let (written, _) = waited.unwrap_or_else(PoisonError::into_inner);
        *written >= number
    }

    /// Records that have been handed to the system (or that it refused: nobody is to wait for a full disk).
    #[must_use]
    pub fn written(&self) -> u64 {
        *self.progress.written.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes on disk, both halves together.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.progress.bytes.load(Ordering::Relaxed)
    }

    /// Whether the last sync went well: the disk has what was written, and the files have their names.
    pub(super) fn is_kept(&self) -> bool {
        !self.progress.is_unsynced.load(Ordering::Relaxed)
    }

    /// Writes or syncs that failed: a full disk, for instance. The daemon goes on without them.
    #[must_use]
    pub fn failures(&self) -> u64 {
        self.progress.failures.load(Ordering::Relaxed)
    }
}

/// Monotonic times of another boot say nothing about this one.
fn boot_id() -> [u8; 16] {
    let mut id = [0; 16];
    let text = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    let digits: Vec<u8> = text.chars().filter_map(|digit| digit.to_digit(16)).map(|digit| digit as u8).collect();
    for (byte, pair) in id.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = pair[0] << 4 | pair[1];
    }
    id
}

#[cfg(test)]
mod tests;
