//! The narration history on disk, so that it outlives the daemon: an append-only file of records, each with a checksum, in two
//! halves of bounded size. A writer thread owns the file; nothing on the way from event to scores waits for the disk.
//!
//! A record is four letters, the payload's length (u32), the CRC-32 of the payload (u32), the payload; integers little endian. Reading skips
//! what is damaged and goes on at the next record whose checksum is right.
//!
//! | letters | payload |
//! | --- | --- |
//! | `RCJ1` | a sentence: source, epoch, sequence, observed_ns, observed_unix_ns (u64 each), person (u32), the machine's boot id (16 bytes), the sentence |
//! | `RCJ3` | the same with a name, presence or an attribution: before the text come what it is (u8; bit 0: presence, bit 1: the person was found by fit) and the person's name (u8 of bytes, the bytes) |
//! | `RCJ2`, `RCJ4` | `RCJ1` and `RCJ3` carried over, see below |
//! | `RCJ5` | what became of an observation that was written before: its source, epoch, sequence (u64 each), the person that it is of (u32), whether that was found by fit (u8), the map's fingerprint (its first 8 bytes), and per room the probability that the model then gave (f32) |
//! | `RCJ6` | whose a start of a source is: its source and epoch (u64 each), and the port that speaks for it (16 bytes) |
//! | `RCJ7`, `RCJ8` | `RCJ1` and `RCJ3` of what was last said of a person, before all that the halves hold of it; `RCJ5` follows |
//! | `RCJ9` | that a person was forgotten then, or was a visitor and is gone by silence: the number (u32), and whether that was before all observations of the halves (u8) |
//! | `RCJB` | whom an observation moved that was written before, so that it is not read again with those who are known at a restart: its source, epoch and sequence (u64 each), and for each person whom it moved, in their order: the number (u32; all ones where it says that a room is empty), what it is (u8; bits 0 and 1 as in `RCJ3`, bit 2: it is what was observed, bit 3: it is what the one before is), the name (u8 of bytes, the bytes), and without bits 2 and 3 what it says of them (u16 of bytes, the bytes). None where it moved nobody |
//! | `RCJA` | where a person was believed to be when the map was changed: what was observed of them last by its source, epoch and sequence (u64 each), the person (u32), the changed map's fingerprint (its first 8 bytes), for how many seconds they had then been at what they did, and the totals and counts of how long they are at one thing and in one room (f32 each), and per room of that map the probability that they were in it (f32) |
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

use std::borrow::Cow;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::fs;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use self::disk::Folder;
pub use self::disk::{Disk, Half};
use self::forget::IsTheirs;
pub(super) use self::forget::each_record;
use crate::state_file;
use crossbeam::channel::{Receiver, RecvTimeoutError, SendTimeoutError, Sender, bounded};
use roomcast_core::forecast::PACES;
use roomcast_core::narration::{Observation, PresenceStatement, SOMEBODY, Said, Sentence};
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_ipc::{MAX_ROOMS, NAME_BYTES, Sender as Port};

mod disk;
mod forget;
mod last_words;

/// Silence before a sync.
const QUIET_BEFORE_SYNC: Duration = Duration::from_millis(100);
const MAGIC: [u8; 4] = *b"RCJ1";
const MAGIC_CARRIED: [u8; 4] = *b"RCJ2";
const MAGIC_NAMED: [u8; 4] = *b"RCJ3";
const MAGIC_NAMED_CARRIED: [u8; 4] = *b"RCJ4";
const MAGIC_OUTCOME: [u8; 4] = *b"RCJ5";
const MAGIC_PORT: [u8; 4] = *b"RCJ6";
const MAGIC_KEPT: [u8; 4] = *b"RCJ7";
const MAGIC_NAMED_KEPT: [u8; 4] = *b"RCJ8";
const MAGIC_FORGOTTEN: [u8; 4] = *b"RCJ9";
const MAGIC_BELIEVED: [u8; 4] = *b"RCJA";
const MAGIC_MOVED: [u8; 4] = *b"RCJB";
/// Letters that a record may begin with.
const MAGICS: [[u8; 4]; 11] = [
    MAGIC,
    MAGIC_CARRIED,
    MAGIC_NAMED,
    MAGIC_NAMED_CARRIED,
    MAGIC_OUTCOME,
    MAGIC_PORT,
    MAGIC_KEPT,
    MAGIC_NAMED_KEPT,
    MAGIC_FORGOTTEN,
    MAGIC_BELIEVED,
    MAGIC_MOVED,
];
/// Those of an observation as it came, or carried over so that it is not taken again.
const MAGICS_TAKEN: [[u8; 4]; 4] = [MAGIC, MAGIC_CARRIED, MAGIC_NAMED, MAGIC_NAMED_CARRIED];
/// Those of which a copy in each half is enough, so that they go last where there is too little room.
const MAGICS_KEPT: [[u8; 4]; 6] =
    [MAGIC_CARRIED, MAGIC_NAMED_CARRIED, MAGIC_PORT, MAGIC_KEPT, MAGIC_NAMED_KEPT, MAGIC_FORGOTTEN];
const HEADER_BYTES: usize = 12;
/// Where the payload of an observation has the boot that it was made in.
const BOOT_AT: usize = 5 * 8 + 4;
const FIXED_BYTES: usize = BOOT_AT + 16;
/// No payload is longer: a sentence has at most 1024 bytes, a statement with its names not twice as many, and a name comes with two more.
const PAYLOAD_BYTES_MAX: usize = FIXED_BYTES + 2 + NAME_BYTES + 2 * roomcast_core::narration::SENTENCE_BYTES_MAX;
/// None of whom an observation moved is longer: eight clauses, each with what it says, of all who may be known.
const MOVED_BYTES_MAX: usize = 64 << 10;
/// A port, with which `RCJ6` ends.
const PORT_BYTES: usize = 16;
/// What `RCJ5` holds beside the rooms.
const OUTCOME_BYTES: usize = 3 * 8 + 4 + 1 + 8;
/// Bits of what a named record is.
const IS_PRESENCE: u8 = 1;
const IS_BY_FIT: u8 = 1 << 1;
/// The same of whom an observation moved: what it says of them is what was observed, or what it says of the one before.
const IS_AS_OBSERVED: u8 = 1 << 2;
const IS_AS_BEFORE: u8 = 1 << 3;
/// Records that may wait for the disk before the sender does.
const QUEUE: usize = 65_536;
/// So often in a row a rotation is put off where what was last said of persons cannot be read, before it goes on without that.
const UNREAD_MAX: u32 = 8;

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
    /// Another daemon has it.
    #[error("journal {}: another daemon is using it; stop that one, or set daemon.state to another directory", path.display())]
    Locked {
        /// The file.
        path: PathBuf,
    },
}

/// What was found at the start.
#[derive(Debug, Default, Clone)]
pub struct Recovered {
    /// The observations, oldest first.
    pub observations: Vec<Observation>,
    /// What is no history any more, but was taken: the last ones of sources that have been silent since, and what forgotten persons did.
    pub carried: Vec<Observation>,
    /// Per carried one, before which of the observations it stands.
    pub carried_before: Vec<usize>,
    /// The port that speaks for a start of a source, by the source's number and epoch.
    pub ports: BTreeMap<(u64, u64), Port>,
    /// What the model said of a person after one of the observations, whose index comes first; without rooms of one who was out.
    pub expectations: Vec<(usize, u32, Expectation)>,
    /// Who was forgotten, after the index of the observation that came next.
    pub forgotten: Vec<(usize, u32)>,
    /// Whom observations moved, by their source, epoch and sequence. Of others it is read in them.
    pub moved: HashMap<(u64, u64, u64), Vec<Move>>,
    /// The last observations of persons that were made before all these, until [`Recovered::join`] puts them in their place.
    kept: KeptWords,
    /// Those that were made before the machine was started last, by source, epoch and sequence.
    pub of_other_boots: HashSet<(u64, u64, u64)>,
    /// Where the observations are, by source, epoch and sequence.
    places: HashMap<(u64, u64, u64), usize>,
    /// Bytes that were no record: a torn end, or damage.
    pub damaged_bytes: u64,
    /// There was a full half, so that a rotation may have dropped what came before it.
    has_rotated: bool,
}

/// What was last said of persons before all that is in the halves; places are indices of these observations.
#[derive(Debug, Default, Clone)]
struct KeptWords {
    observations: Vec<Observation>,
    expectations: Vec<(usize, u32, Expectation)>,
    forgotten: Vec<(usize, u32)>,
    places: HashMap<(u64, u64, u64), usize>,
}

/// What the model said of a person, or where they were believed to be when the map was changed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Expectation {
    /// The first bytes of the fingerprint of the map whose rooms are meant.
    pub map: u64,
    /// How long they had been at what they did then, and so on ([`Forecaster::paces`]), where it is said where they were; none where it is where they are
    /// next.
    ///
    /// [`Forecaster::paces`]: roomcast_core::forecast::Forecaster::paces
    pub paces: Option<[f32; PACES]>,
    /// Per room the probability that the person is there next, or was there.
    pub probability: Vec<f32>,
}

/// Where a person was believed to be when the map was changed.
#[derive(Debug, Clone, PartialEq)]
pub struct Believed {
    /// What was observed of them last: its source, epoch and sequence.
    pub last: (u64, u64, u64),
    /// The person.
    pub person: u32,
    /// The first bytes of the changed map's fingerprint.
    pub map: u64,
    /// How long they had been at what they did then, and so on ([`Forecaster::paces`]).
    ///
    /// [`Forecaster::paces`]: roomcast_core::forecast::Forecaster::paces
    pub paces: [f64; PACES],
    /// Per room of the changed map the probability that they were in it.
    pub probability: Vec<f64>,
}

/// What an observation said of one person whom it moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Move {
    /// The person; [`SOMEBODY`] where it says that a room is empty.
    pub person: u32,
    /// By which name they were meant; none where that was by number, by fit, or as one of a group.
    pub name: Option<Box<str>>,
    /// Whether they were found by fit.
    pub by_fit: bool,
    /// What it says of them; none where it is what was observed.
    pub said: Option<Said>,
}

impl Move {
    /// Of an observation that was found to be of a person, what is not as it was `observed`.
    #[must_use]
    pub fn of(own: &Observation, observed: &Said) -> Self {
        let said = Some(&own.said).filter(|said| *said != observed).cloned();
        Self { person: own.person, name: own.name.clone(), by_fit: own.by_fit, said }
    }

    /// The same of one that says that a room is empty.
    #[must_use]
    pub fn of_a_room(own: &Observation, observed: &Said) -> Self {
        Self { person: SOMEBODY, name: None, by_fit: false, ..Self::of(own, observed) }
    }

    /// The observation of the person, made of the one that moved them.
    #[must_use]
    pub fn apply(self, observed: &Observation) -> Observation {
        let said = self.said.unwrap_or_else(|| observed.said.clone());
        Observation { person: self.person, name: self.name, by_fit: self.by_fit, said, ..*observed }
    }
}

/// Whom an observation moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Moved {
    /// The observation's source, epoch and sequence.
    pub observation: (u64, u64, u64),
    /// The persons, in the order in which they were.
    pub moves: Vec<Move>,
}

/// What became of an observation: whom it is of, and what the model said of that person after it.
#[derive(Debug, Clone, Copy)]
pub struct Outcome<'a> {
    /// The observation's source.
    pub source: u64,
    /// Its epoch.
    pub epoch: u64,
    /// Its number in that epoch.
    pub sequence: u64,
    /// Whom it is of.
    pub person: u32,
    /// Whether it named nobody, and this person was found by fit.
    pub by_fit: bool,
    /// The first bytes of the map's fingerprint.
    pub map: u64,
    /// Per room the probability that the person is there next; empty where nothing was scored.
    pub probability: &'a [f64],
}

#[derive(Debug, Default)]
struct Progress {
    written: Mutex<u64>,
    grew: Condvar,
    bytes: AtomicU64,
    failures: AtomicU64,
}

/// What the writer is to do.
enum Work {
    /// Append a record.
    Append(Vec<u8>),
    /// Take out what a person did, and say whether that went well.
    Forget { person: u32, is_theirs: Box<IsTheirs>, done: Sender<io::Result<usize>> },
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
    pub(super) fn see_off(&self, person: u32) {
        self.sink.lock().unwrap_or_else(PoisonError::into_inner).send(encode_forgotten(person, false));
    }

    /// Takes out of the journal what a person did, before and after a restart of the machine: the observations of which `is_theirs` says so,
    /// which is told whose those are found to be that named nobody. Gives how many they are. Waits at most `patience` for the writer to take it
    /// up, and as long for it to be done.
    ///
    /// # Errors
    ///
    /// When the disk refuses, or takes longer; the journal is whole all the same, and may hold all or part of it.
    pub fn forget(
        &self,
        person: u32,
        is_theirs: impl Fn(&Observation, Option<u32>) -> bool + Send + 'static,
        patience: Duration,
    ) -> io::Result<usize> {
        let (done, answer) = bounded(1);
        let work = self.sink.lock().unwrap_or_else(PoisonError::into_inner).work.clone();
        let forget = Work::Forget { person, is_theirs: Box::new(is_theirs), done };
        match work.map(|work| work.send_timeout(forget, patience)) {
            Some(Ok(())) => {
                answer.recv_timeout(patience).unwrap_or_else(|_| Err(io::Error::from(io::ErrorKind::TimedOut)))
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

    /// Writes or syncs that failed: a full disk, for instance. The daemon goes on without them.
    #[must_use]
    pub fn failures(&self) -> u64 {
        self.progress.failures.load(Ordering::Relaxed)
    }
}

/// The last record of one start of a source.
#[derive(Debug)]
struct Last {
    record: Vec<u8>,
    /// The current half has it.
    in_current: bool,
    /// Grows with every record.
    turn: u64,
}

/// When the next sync is due: some time after what was written, because whatever is to be written during a sync waits for it, and so do the
/// scores that rest on it. Never later than promised, and, unless that asks for it, not sooner after the last one.
#[derive(Debug)]
struct SyncDue {
    every: Duration,
    synced: Instant,
    /// When the first and the last was written since; none where all is synced.
    written: Option<(Instant, Instant)>,
}

impl SyncDue {
    /// What a process before has left is to be synced.
    fn new(every: Duration, now: Instant) -> Self {
        Self { every, synced: now, written: Some((now, now)) }
    }

    fn wrote(&mut self, now: Instant) {
        let first = self.written.map_or(now, |(first, _)| first);
        self.written = Some((first, now));
    }

    /// What a sync failed with is synced again.
    fn synced(&mut self, done: bool, now: Instant) {
        self.synced = now;
        self.written = (!done).then_some((now, now));
    }

    fn at(&self) -> Option<Instant> {
        let (first, last) = self.written?;
        Some((last + QUIET_BEFORE_SYNC).max(self.synced + self.every).min(first + self.every))
    }
}

/// What writes the two halves to a disk; the journal's thread has one.
#[derive(Debug)]
pub struct Writer<D> {
    disk: D,
    length: u64,
    older_length: u64,
    /// Records that the disk refused, tried again with the next ones: a full disk may have room again.
    unwritten: Vec<u8>,
    /// What the current half has had since the last sync, in pieces, each with where it begins. The system takes for written what a sync has
    /// failed with, so it is written again.
    unsynced: Vec<(u64, Vec<u8>)>,
    /// A sync has failed, and what it lost is not written again yet.
    lacks_pages: bool,
    /// An append has failed, and what it left behind is not cut off yet.
    is_torn: bool,
    /// The disk knows the names of the halves.
    names_synced: bool,
    /// The last record of each start of a source. What the current half has not is carried over at the next rotation.
    last: BTreeMap<(u64, u64), Last>,
    /// Whose each of them is; every half has all of these records.
    ports: BTreeMap<(u64, u64), Vec<u8>>,
    /// Records written.
    turn: u64,
    /// What was last said of persons in a half that a rotation has dropped, until the new one has it.
    kept: Vec<u8>,
    /// Rotations put off in a row because that could not be read.
    unread: u32,
    half_bytes: u64,
    sync_every: Duration,
    progress: Arc<Progress>,
}

impl<D: Disk> Writer<D> {
    /// Reads what the disk holds, of which `boot_id` names the boot of now, and goes on behind it. A half has at most `half_bytes`.
    ///
    /// # Errors
    /// When a half cannot be read; damaged records are no error.
    pub fn open(disk: D, half_bytes: u64, boot_id: &[u8; 16]) -> io::Result<(Self, Recovered)> {
        let older = disk.read(Half::Older)?;
        let mut recovered = Recovered { has_rotated: !older.is_empty(), ..Recovered::default() };
        read_records(&older, boot_id, &mut recovered);
        let (mut last, mut turn) = (BTreeMap::new(), 0);
        let mut note = |carried: &[Observation], observations: &[Observation], in_current| {
            for observation in carried.iter().chain(observations) {
                turn += 1;
                let record = encode(observation, boot_id);
                last.insert((observation.source, observation.epoch), Last { record, in_current, turn });
            }
        };
        let (carried, observations) = (recovered.carried.len(), recovered.observations.len());
        note(&recovered.carried, &recovered.observations, false);
        let current = disk.read(Half::Current)?;
        read_records(&current, boot_id, &mut recovered);
        note(&recovered.carried[carried..], &recovered.observations[observations..], true);
        let ports = recovered.ports.iter().map(|(name, port)| (*name, encode_port(*name, *port))).collect();
        let progress = Arc::new(Progress::default());
        let (older_length, length) = (older.len() as u64, current.len() as u64);
        progress.bytes.store(older_length + length, Ordering::Relaxed);
        let writer = Self {
            disk,
            length,
            older_length,
            unwritten: Vec::new(),
            // A process before may have been killed before it synced.
            unsynced: sound_pieces(&older, &current),
            lacks_pages: false,
            is_torn: false,
            names_synced: false,
            last,
            ports,
            turn,
            kept: Vec::new(),
            unread: 0,
            half_bytes,
            sync_every: Duration::from_secs(1),
            progress,
        };
        Ok((writer, recovered))
    }

    fn run(&mut self, queue: &Receiver<Work>) {
        let mut due = SyncDue::new(self.sync_every, Instant::now());
        loop {
            let now = Instant::now();
            // Only what is still to be done has a time.
            let until = due.at().or_else(|| (!self.unwritten.is_empty()).then_some(now + self.sync_every));
            let received = match until {
                Some(until) => queue.recv_deadline(until),
                None => queue.recv().map_err(|_| RecvTimeoutError::Disconnected),
            };
            match received {
                Ok(work) => {
                    self.work(work, queue);
                    due.wrote(Instant::now());
                }
                Err(RecvTimeoutError::Timeout) if !self.unwritten.is_empty() => {
                    let written = self.write(&[]);
                    if written.is_ok() {
                        due.wrote(Instant::now());
                    }
                    self.note(written);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if due.at().is_some_and(|at| Instant::now() >= at) {
                let done = self.sync();
                due.synced(done.is_ok(), Instant::now());
                self.note(done);
            }
        }
        if !self.unwritten.is_empty() {
            let written = self.write(&[]);
            self.note(written);
        }
        let done = self.sync().or_else(|_| self.sync());
        self.note(done);
    }

    /// Does some work, and what waits behind it.
    fn work(&mut self, first: Work, queue: &Receiver<Work>) {
        let (mut batch, mut records) = (Vec::new(), 0);
        // What waits already goes out in one write.
        for work in std::iter::once(first).chain(queue.try_iter().take(1023)) {
            match work {
                Work::Append(record) => {
                    batch.extend_from_slice(&record);
                    records += 1;
                }
                Work::Forget { person, is_theirs, done } => {
                    self.append(&std::mem::take(&mut batch), std::mem::take(&mut records));
                    // Whoever asked may have lost patience.
                    let _told = done.send(self.forget(person, &*is_theirs));
                }
            }
        }
        self.append(&batch, records);
    }

    /// Writes so many records; their number counts also when that fails: nobody is to wait for a full disk.
    fn append(&mut self, batch: &[u8], records: u64) {
        if records == 0 {
            return;
        }
        let written = self.write(batch);
        self.note(written);
        *self.progress.written.lock().unwrap_or_else(PoisonError::into_inner) += records;
        self.progress.grew.notify_all();
    }

    /// Brings what was written to the disk, and the names of the halves; what that fails with is written again, for the next sync.
    ///
    /// # Errors
    /// When the disk refuses, or what is written has no name any more.
    pub fn sync(&mut self) -> io::Result<()> {
        self.sync_current()?;
        if !self.names_synced {
            self.disk.sync_names()?;
            self.names_synced = true;
        }
        self.disk.require_name()
    }

    fn sync_current(&mut self) -> io::Result<()> {
        self.rewrite()?;
        if let Err(error) = self.disk.sync() {
            self.lacks_pages = true;
            self.rewrite()?;
            return Err(error);
        }
        self.unsynced.clear();
        Ok(())
    }

    /// Writes again what a sync has lost, in its place: at no time is anything gone from the file. Until that went well, a sync that succeeds
    /// says nothing.
    fn rewrite(&mut self) -> io::Result<()> {
        if self.lacks_pages {
            self.disk.rewrite(&self.unsynced)?;
            self.lacks_pages = false;
        }
        Ok(())
    }

    /// Cuts off what an append that failed has left behind: where the file ends must be known before anything is written to it.
    fn cut_torn(&mut self) -> io::Result<()> {
        if self.is_torn {
            self.disk.cut(self.length)?;
            self.is_torn = false;
        }
        Ok(())
    }

    /// Drops the oldest of what the disk refuses, so that the rest fits into so many bytes; what is carried over goes last.
    fn trim_unwritten(&mut self, bytes_max: u64) {
        while self.unwritten.len() as u64 > bytes_max {
            let mut from = 0;
            while MAGICS_KEPT.iter().any(|magic| self.unwritten[from..].starts_with(magic)) {
                from += record_bytes(&self.unwritten[from..]);
            }
            if from >= self.unwritten.len() {
                from = 0;
            }
            let until = from + record_bytes(&self.unwritten[from..]);
            self.unwritten.drain(from..until);
        }
    }

    /// Writes what was refused before, then `batch`, whole records; what is refused now is kept, as much of it as a half may hold.
    ///
    /// # Errors
    /// When the disk refuses, or is full.
    pub fn write(&mut self, batch: &[u8]) -> io::Result<()> {
        self.unwritten.extend_from_slice(batch);
        let written = self.write_out();
        if written.is_err() {
            self.trim_unwritten(self.half_bytes);
        }
        written
    }

    fn write_out(&mut self) -> io::Result<()> {
        let mut is_new = self.length == 0;
        while !self.unwritten.is_empty() {
            let fitting = fitting(&self.unwritten, self.half_bytes.saturating_sub(self.length));
            match (fitting, is_new) {
                (0, false) => {
                    self.rotate()?;
                    is_new = true;
                }
                // What a half begins with leaves no room for one as long as this.
                (0, true) => _ = self.unwritten.drain(..record_bytes(&self.unwritten)),
                _ => {
                    self.append_records(fitting)?;
                    is_new = false;
                }
            }
        }
        Ok(())
    }

    /// Appends so many bytes of what is to be written, whole records.
    fn append_records(&mut self, bytes: usize) -> io::Result<()> {
        self.cut_torn()?;
        if let Err(error) = self.disk.append(&self.unwritten[..bytes]) {
            self.is_torn = true;
            // Where that fails, too, it is tried again before the next append; until then reading steps over it.
            self.cut_torn()?;
            return Err(error);
        }
        let written: Vec<u8> = self.unwritten.drain(..bytes).collect();
        self.take_note(&written);
        add_piece(&mut self.unsynced, self.length, &written);
        self.length += bytes as u64;
        self.progress.bytes.store(self.older_length + self.length, Ordering::Relaxed);
        Ok(())
    }

    /// Remembers of each source what the current half has of it now.
    fn take_note(&mut self, mut records: &[u8]) {
        while !records.is_empty() {
            let (record, after) = records.split_at(record_bytes(records));
            if record.starts_with(&MAGIC_PORT) {
                self.ports.insert(source_of(record), record.to_vec());
            } else if MAGICS_TAKEN.iter().any(|magic| record.starts_with(magic)) {
                self.turn += 1;
                let last = Last { record: record.to_vec(), in_current: true, turn: self.turn };
                self.last.insert(source_of(record), last);
            }
            records = after;
        }
    }

    /// The full half becomes the old one, whose predecessor goes, but for the last words of sources and persons that only it knew: with these
    /// the new half begins, and the disk has them before anything goes. The lock moves to the new file before the old one lets go.
    fn rotate(&mut self) -> io::Result<()> {
        self.sync_current()?;
        let mut quiet: Vec<_> =
            self.last.iter().filter(|(_, last)| !last.in_current).map(|(name, last)| (last.turn, *name)).collect();
        quiet.sort_unstable();
        // More than the daemon knows, and of sources that it has forgotten: the longest silent.
        for (_, name) in quiet.iter().rev().skip(SOURCES_MAX) {
            self.last.remove(name);
        }
        if self.ports.len() > SOURCES_MAX {
            self.ports.retain(|name, _| self.last.contains_key(name));
        }
        let mut carried = self.carried();
        // A rotation that got no further before has put the full half in place already: another file has its name now, or none.
        let is_first = self.disk.is_current()?;
        if is_first {
            self.kept = match self.last_words() {
                Ok(words) => words,
                // The next write tries again, and what this one brings waits for it.
                Err(error) if self.unread < UNREAD_MAX => {
                    self.unread += 1;
                    return Err(error);
                }
                // What can never be read again must not end the journal.
                Err(error) => {
                    self.note(Err(error));
                    Vec::new()
                }
            };
            self.unread = 0;
        }
        carried.extend_from_slice(&self.kept);
        self.disk.prepare(&carried)?;
        self.names_synced = false;
        if is_first {
            self.disk.retire()?;
            self.older_length = self.length;
        }
        self.disk.place(Half::Current)?;
        self.length = carried.len() as u64;
        (self.lacks_pages, self.is_torn) = (false, false);
        self.unsynced.clear();
        self.kept.clear();
        self.last.values_mut().for_each(|last| last.in_current = false);
        self.take_note(&carried);
        self.progress.bytes.store(self.older_length + self.length, Ordering::Relaxed);
        Ok(())
    }

    /// What the next half begins with: whose the sources are, and the last record of those that the current one has not. Where that is more than a
    /// quarter of a half, the newest start of every port comes first, then the second of every port: whoever invents sources pushes out its own.
    fn carried(&self) -> Vec<u8> {
        let quiet = self.last.iter().filter(|(_, last)| !last.in_current);
        let starts: BTreeSet<_> = self.ports.keys().chain(quiet.map(|(name, _)| name)).collect();
        let mut newest: Vec<_> =
            starts.into_iter().map(|name| (self.last.get(name).map_or(0, |last| last.turn), *name)).collect();
        newest.sort_unstable_by_key(|(turn, _)| Reverse(*turn));
        let mut of_ports = BTreeMap::<_, usize>::new();
        let mut ranked: Vec<_> = newest
            .into_iter()
            .map(|(turn, name)| {
                // The port is what a record of one ends with; a start without one is for itself.
                let port = self.ports.get(&name).map(|record| &record[record.len() - PORT_BYTES..]);
                let rank = of_ports.entry((port, port.is_none().then_some(name))).or_default();
                *rank += 1;
                (*rank, Reverse(turn), name)
            })
            .collect();
        ranked.sort_unstable();
        let (mut ports, mut words) = (Vec::new(), Vec::new());
        for (_, _, name) in ranked {
            let port = self.ports.get(&name).map_or(&[][..], Vec::as_slice);
            let last = self.last.get(&name).filter(|last| !last.in_current).map_or(&[][..], |last| &last.record);
            if (ports.len() + words.len() + port.len() + last.len()) as u64 > self.half_bytes / 4 {
                break;
            }
            ports.extend_from_slice(port);
            if let Some(payload) = last.get(MAGIC.len()..) {
                let named = last.starts_with(&MAGIC_NAMED) || last.starts_with(&MAGIC_NAMED_CARRIED);
                words.extend_from_slice(if named { &MAGIC_NAMED_CARRIED } else { &MAGIC_CARRIED });
                words.extend_from_slice(payload);
            }
        }
        [ports, words].concat()
    }

    fn note(&self, result: io::Result<()>) {
        if let Err(error) = result {
            let failures = self.progress.failures.fetch_add(1, Ordering::Relaxed) + 1;
            if failures.is_power_of_two() {
                tracing::warn!(%error, failures, disk = ?self.disk, "the journal cannot be written; the history in memory is complete");
            }
        }
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

/// An observation as a record; `boot_id` names the boot that its monotonic times belong to.
#[must_use]
pub fn encode(observation: &Observation, boot_id: &[u8; 16]) -> Vec<u8> {
    let name = observation.name.as_deref().unwrap_or_default().as_bytes();
    let (is_presence, text) = text_of(&observation.said);
    let kind = is_presence | if observation.by_fit { IS_BY_FIT } else { 0 };
    let text = text.as_bytes();
    let named = kind != 0 || !name.is_empty();
    let mut payload = Vec::with_capacity(HEADER_BYTES + FIXED_BYTES + 2 + name.len() + text.len());
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    for number in [
        observation.source,
        observation.epoch,
        observation.sequence,
        observation.observed_ns,
        observation.observed_unix_ns,
    ] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
    payload.extend_from_slice(&observation.person.to_le_bytes());
    payload.extend_from_slice(boot_id);
    if named {
        // A name has at most 48 bytes.
        payload.extend_from_slice(&[kind, name.len() as u8]);
        payload.extend_from_slice(name);
    }
    payload.extend_from_slice(text);
    sealed(if named { MAGIC_NAMED } else { MAGIC }, payload)
}

/// What is said as a record has it, and whether it is a presence.
fn text_of(said: &Said) -> (u8, Cow<'_, str>) {
    match said {
        Said::Sentence(sentence) => (0, Cow::Borrowed(sentence.as_str())),
        Said::Presence(statement) => {
            let text = match statement.subject() {
                Some(subject) => format!("{statement}\n{subject}"),
                None => statement.to_string(),
            };
            (IS_PRESENCE, Cow::Owned(text))
        }
    }
}

/// What such a text says.
fn said_of(text: &str, kind: u8) -> Option<Said> {
    Some(match kind & IS_PRESENCE {
        0 => Said::Sentence(Sentence::new(text).ok()?),
        _ => Said::Presence(match text.split_once('\n') {
            Some((text, subject)) => PresenceStatement::parse_of(text, subject).ok()?,
            None => PresenceStatement::parse(text).ok()?,
        }),
    })
}

/// Whom an observation moved, as a record.
#[must_use]
pub fn encode_moved(moved: &Moved) -> Vec<u8> {
    let (source, epoch, sequence) = moved.observation;
    let mut payload = vec![0; HEADER_BYTES];
    for number in [source, epoch, sequence] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
    let mut before = None;
    for Move { person, name, by_fit, said } in &moved.moves {
        let name = name.as_deref().unwrap_or_default().as_bytes();
        let (kind, text) = match said {
            None => (IS_AS_OBSERVED, None),
            Some(said) if before == Some(said) => (IS_AS_BEFORE, None),
            Some(said) => {
                let (kind, text) = text_of(said);
                (kind, Some(text))
            }
        };
        payload.extend_from_slice(&person.to_le_bytes());
        // A name has at most 48 bytes.
        payload.extend_from_slice(&[kind | if *by_fit { IS_BY_FIT } else { 0 }, name.len() as u8]);
        payload.extend_from_slice(name);
        if let Some(text) = text {
            payload.extend_from_slice(&(text.len() as u16).to_le_bytes());
            payload.extend_from_slice(text.as_bytes());
        }
        before = said.as_ref();
    }
    sealed(MAGIC_MOVED, payload)
}

/// What became of an observation, as a record.
#[must_use]
pub fn encode_outcome(outcome: &Outcome<'_>) -> Vec<u8> {
    let mut payload = Vec::with_capacity(HEADER_BYTES + OUTCOME_BYTES + 4 * outcome.probability.len());
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    for number in [outcome.source, outcome.epoch, outcome.sequence] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
    payload.extend_from_slice(&outcome.person.to_le_bytes());
    payload.push(u8::from(outcome.by_fit));
    payload.extend_from_slice(&outcome.map.to_le_bytes());
    for probability in outcome.probability {
        payload.extend_from_slice(&(*probability as f32).to_le_bytes());
    }
    sealed(MAGIC_OUTCOME, payload)
}

/// Where somebody was believed to be when the map was changed, as a record.
#[must_use]
pub fn encode_believed(believed: &Believed) -> Vec<u8> {
    let Believed { last: (source, epoch, sequence), person, map, paces, probability } = believed;
    let mut payload = Vec::with_capacity(HEADER_BYTES + OUTCOME_BYTES + 4 * (PACES + probability.len()));
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    for number in [source, epoch, sequence] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
    payload.extend_from_slice(&person.to_le_bytes());
    payload.extend_from_slice(&map.to_le_bytes());
    for number in paces.iter().chain(probability) {
        payload.extend_from_slice(&(*number as f32).to_le_bytes());
    }
    sealed(MAGIC_BELIEVED, payload)
}

/// Which port speaks for a start of a source, as a record.
#[must_use]
pub fn encode_port(name: (u64, u64), port: Port) -> Vec<u8> {
    let payload = [&[0; HEADER_BYTES][..], &name.0.to_le_bytes(), &name.1.to_le_bytes(), &port.to_bytes()];
    sealed(MAGIC_PORT, payload.concat())
}

/// That a person was forgotten, as a record; `is_before` all observations of the halves.
pub(super) fn encode_forgotten(person: u32, is_before: bool) -> Vec<u8> {
    let payload = [&[0; HEADER_BYTES][..], &person.to_le_bytes(), &[u8::from(is_before)]];
    sealed(MAGIC_FORGOTTEN, payload.concat())
}

/// A record of its payload, which stands behind room for the header.
fn sealed(magic: [u8; 4], mut record: Vec<u8>) -> Vec<u8> {
    let (length, checksum) = ((record.len() - HEADER_BYTES) as u32, crc32fast::hash(&record[HEADER_BYTES..]));
    record[..4].copy_from_slice(&magic);
    record[4..8].copy_from_slice(&length.to_le_bytes());
    record[8..HEADER_BYTES].copy_from_slice(&checksum.to_le_bytes());
    record
}

/// The source of a whole record, and its epoch.
fn source_of(record: &[u8]) -> (u64, u64) {
    let mut payload = record.get(HEADER_BYTES..).unwrap_or_default();
    let mut number = || take_u64(&mut payload).unwrap_or_default();
    (number(), number())
}

/// Bytes of the first of some whole records; all of them where it is none.
fn record_bytes(records: &[u8]) -> usize {
    let length = records.get(4..).and_then(|mut rest| take_u32(&mut rest));
    length.map_or(records.len(), |length| (HEADER_BYTES + length as usize).min(records.len()))
}

/// Adds bytes to pieces of a file, to the last one where they begin at its end.
fn add_piece(pieces: &mut Vec<(u64, Vec<u8>)>, at: u64, bytes: &[u8]) {
    match pieces.last_mut().filter(|(from, piece)| from + piece.len() as u64 == at) {
        Some((_, piece)) => piece.extend_from_slice(bytes),
        None => pieces.push((at, bytes.to_vec())),
    }
}

/// Of the current half as a start has read it the pieces that are surely what the disk has there: whole records in a row, which say something that
/// the halves say nowhere else. A disk that gives a block of elsewhere, or of before, may have something else in its place, and nobody is to
/// write over that what it gave.
fn sound_pieces(older: &[u8], current: &[u8]) -> Vec<(u64, Vec<u8>)> {
    let mut found = HashMap::<&[u8], usize>::new();
    for half in [older, current] {
        each_record(half, |raw, _| *found.entry(raw).or_default() += 1);
    }
    let (begin, mut pieces) = (current.as_ptr().addr(), Vec::new());
    each_record(current, |raw, _| add_piece(&mut pieces, (raw.as_ptr().addr() - begin) as u64, raw));
    pieces.retain(|(_, piece)| {
        let mut says_more = false;
        each_record(piece, |raw, _| says_more |= found.get(raw) == Some(&1));
        says_more
    });
    pieces
}

/// Bytes of the first of some whole records, as many of them as have so much room.
fn fitting(records: &[u8], room: u64) -> usize {
    let mut bytes = 0;
    while bytes < records.len() {
        let next = bytes + record_bytes(&records[bytes..]);
        if next as u64 > room {
            break;
        }
        bytes = next;
    }
    bytes
}

/// Reads all records of a file's bytes after those that were read before; whatever is none is counted and stepped over. Monotonic times of
/// another boot than `boot_id` become 0.
pub fn read_records(bytes: &[u8], boot_id: &[u8; 16], recovered: &mut Recovered) {
    let mut rest = bytes;
    let mut begins = true;
    while !rest.is_empty() {
        match decode(rest, boot_id) {
            Some((record, length)) => {
                if begins && matches!(record, Record::Kept(_) | Record::Forgotten { is_before: true, .. }) {
                    // What a newer half begins with has all of what the older one began with.
                    recovered.kept = KeptWords::default();
                    begins = false;
                }
                let made_in = rest.get(HEADER_BYTES + BOOT_AT..).and_then(|rest| rest.first_chunk());
                if let Record::Observation(observation) | Record::Kept(observation) = &record
                    && made_in != Some(boot_id)
                {
                    recovered.of_other_boots.insert(name_of(observation));
                }
                match record {
                    // A disk may give a block twice, or one as it was before: what is named the same is the same.
                    Record::Observation(observation) if recovered.has(&observation) => {}
                    Record::Kept(observation) if recovered.has(&observation) => {}
                    Record::Observation(observation) => {
                        recovered.places.insert(name_of(&observation), recovered.observations.len());
                        recovered.observations.push(observation);
                    }
                    Record::Carried(observation) => {
                        recovered.carried.push(observation);
                        recovered.carried_before.push(recovered.observations.len());
                    }
                    Record::Outcome { name, person, by_fit, expectation } => {
                        recovered.note_outcome(name, person, by_fit, expectation);
                    }
                    Record::Moved(Moved { observation, moves }) => {
                        recovered.moved.insert(observation, moves);
                    }
                    Record::Port { name, port } => {
                        recovered.ports.insert(name, port);
                    }
                    Record::Kept(observation) => {
                        let kept = &mut recovered.kept;
                        kept.places.insert(name_of(&observation), kept.observations.len());
                        kept.observations.push(observation);
                    }
                    Record::Forgotten { person, is_before: true } => {
                        recovered.kept.forgotten.push((recovered.kept.observations.len(), person));
                    }
                    Record::Forgotten { person, is_before: false } => {
                        recovered.forgotten.push((recovered.observations.len(), person));
                    }
                }
                rest = &rest[length..];
            }
            None => {
                let next = rest[1..].windows(MAGIC.len()).position(|window| MAGICS.iter().any(|magic| window == magic));
                let skipped = next.map_or(rest.len(), |next| next + 1);
                recovered.damaged_bytes += skipped as u64;
                rest = &rest[skipped..];
            }
        }
    }
}

/// An observation by its source, epoch and sequence.
fn name_of(observation: &Observation) -> (u64, u64, u64) {
    (observation.source, observation.epoch, observation.sequence)
}

impl Recovered {
    /// Whether an observation was read before.
    fn has(&self, observation: &Observation) -> bool {
        let name = name_of(observation);
        self.places.contains_key(&name) || self.kept.places.contains_key(&name)
    }

    /// All that was taken, in its order.
    pub fn taken(&self) -> impl Iterator<Item = &Observation> {
        let mut carried = self.carried_before.iter().zip(&self.carried).peekable();
        let mut observations = self.observations.iter().enumerate().peekable();
        std::iter::from_fn(move || {
            let next = observations.peek().map_or(usize::MAX, |(index, _)| *index);
            let first = carried.next_if(|(before, _)| **before <= next).map(|(_, observation)| observation);
            first.or_else(|| observations.next().map(|(_, observation)| observation))
        })
    }

    /// Per start of a source up to which sequence rotations have dropped what it said. A narrator that was told of it must not take it for lost.
    #[must_use]
    pub fn settled(&self) -> BTreeMap<(u64, u64), u64> {
        let mut settled = BTreeMap::new();
        if self.has_rotated {
            for Observation { source, epoch, sequence, .. } in &self.observations {
                settled.entry((*source, *epoch)).or_insert(sequence.saturating_sub(1));
            }
        }
        for Observation { source, epoch, sequence, .. } in &self.carried {
            let last = settled.entry((*source, *epoch)).or_default();
            *last = (*last).max(*sequence);
        }
        settled
    }

    /// What became of an observation that was read before; of one that is gone it says nothing.
    fn note_outcome(&mut self, name: (u64, u64, u64), person: u32, by_fit: bool, expectation: Expectation) {
        let Self { observations, expectations, kept, places, .. } = self;
        let found = match places.get(&name) {
            Some(index) => Some((*index, observations, expectations)),
            None => kept.places.get(&name).map(|index| (*index, &mut kept.observations, &mut kept.expectations)),
        };
        let Some((index, observations, expectations)) = found else { return };
        if by_fit {
            let observation = &mut observations[index];
            (observation.person, observation.by_fit) = (person, true);
        }
        // Of whom an observation is that named nobody was told beside it.
        if !by_fit {
            expectations.push((index, person, expectation));
        }
    }

    /// The same with the last observations of persons that were made before these in their place, the first.
    #[must_use]
    pub fn join(mut self) -> Self {
        let KeptWords { mut observations, mut expectations, mut forgotten, .. } = std::mem::take(&mut self.kept);
        let before = observations.len();
        self.carried_before.iter_mut().for_each(|index| *index += before);
        observations.append(&mut self.observations);
        expectations.extend(self.expectations.drain(..).map(|(index, person, said)| (index + before, person, said)));
        forgotten.extend(self.forgotten.drain(..).map(|(index, person)| (index + before, person)));
        Self { observations, expectations, forgotten, ..self }
    }
}

/// What a record holds.
pub(super) enum Record {
    Observation(Observation),
    Carried(Observation),
    Outcome { name: (u64, u64, u64), person: u32, by_fit: bool, expectation: Expectation },
    Moved(Moved),
    Port { name: (u64, u64), port: Port },
    Kept(Observation),
    Forgotten { person: u32, is_before: bool },
}

/// The record that some bytes begin with, and how many of them it has.
fn decode(bytes: &[u8], boot_id: &[u8; 16]) -> Option<(Record, usize)> {
    let (&magic, mut header) = bytes.split_first_chunk::<4>()?;
    if !MAGICS.contains(&magic) {
        return None;
    }
    let length = take_u32(&mut header)? as usize;
    let checksum = take_u32(&mut header)?;
    if length > if magic == MAGIC_MOVED { MOVED_BYTES_MAX } else { PAYLOAD_BYTES_MAX } {
        return None;
    }
    let payload = header.get(..length)?;
    if crc32fast::hash(payload) != checksum {
        return None;
    }
    let record = match magic {
        MAGIC_OUTCOME => decode_outcome(payload)?,
        MAGIC_BELIEVED => decode_believed(payload)?,
        MAGIC_MOVED => Record::Moved(decode_moved(payload)?),
        MAGIC_PORT => decode_port(payload)?,
        MAGIC_FORGOTTEN => decode_forgotten(payload)?,
        MAGIC_KEPT | MAGIC_NAMED_KEPT => Record::Kept(decode_observation(payload, magic == MAGIC_NAMED_KEPT, boot_id)?),
        MAGIC | MAGIC_NAMED => Record::Observation(decode_observation(payload, magic == MAGIC_NAMED, boot_id)?),
        _ => Record::Carried(decode_observation(payload, magic == MAGIC_NAMED_CARRIED, boot_id)?),
    };
    Some((record, HEADER_BYTES + length))
}

fn decode_observation(mut payload: &[u8], named: bool, boot_id: &[u8; 16]) -> Option<Observation> {
    let (source, epoch, sequence) = (take_u64(&mut payload)?, take_u64(&mut payload)?, take_u64(&mut payload)?);
    let (observed_ns, observed_unix_ns) = (take_u64(&mut payload)?, take_u64(&mut payload)?);
    let person = take_u32(&mut payload)?;
    let (boot, mut text) = payload.split_at_checked(boot_id.len())?;
    let (mut kind, mut name) = (0, None);
    if named {
        (kind, name) = take_kind_and_name(&mut text)?;
    }
    let said = said_of(std::str::from_utf8(text).ok()?, kind)?;
    let observed_ns = if boot == boot_id { observed_ns } else { 0 };
    let by_fit = kind & IS_BY_FIT != 0;
    Some(Observation { person, name, by_fit, source, epoch, sequence, observed_ns, observed_unix_ns, said })
}

/// What somebody's part of a record is, and their name, if they have one there.
fn take_kind_and_name(bytes: &mut &[u8]) -> Option<(u8, Option<Box<str>>)> {
    let (&[kind, length], rest) = bytes.split_first_chunk()?;
    let (name, rest) = rest.split_at_checked(length.into())?;
    let name = std::str::from_utf8(name).ok().filter(|name| name.len() <= NAME_BYTES)?;
    *bytes = rest;
    Some((kind, Some(name).filter(|name| !name.is_empty()).map(Into::into)))
}

fn decode_moved(mut payload: &[u8]) -> Option<Moved> {
    let observation = (take_u64(&mut payload)?, take_u64(&mut payload)?, take_u64(&mut payload)?);
    let mut moves = Vec::<Move>::new();
    while !payload.is_empty() {
        let person = take_u32(&mut payload)?;
        let (kind, name) = take_kind_and_name(&mut payload)?;
        let said = if kind & IS_AS_OBSERVED != 0 {
            None
        } else if kind & IS_AS_BEFORE != 0 {
            moves.last()?.said.clone()
        } else {
            let (length, rest) = payload.split_first_chunk()?;
            let (text, rest) = rest.split_at_checked(u16::from_le_bytes(*length).into())?;
            payload = rest;
            Some(said_of(std::str::from_utf8(text).ok()?, kind)?)
        };
        moves.push(Move { person, name, by_fit: kind & IS_BY_FIT != 0, said });
    }
    Some(Moved { observation, moves })
}

fn decode_outcome(mut payload: &[u8]) -> Option<Record> {
    let name = (take_u64(&mut payload)?, take_u64(&mut payload)?, take_u64(&mut payload)?);
    let person = take_u32(&mut payload)?;
    let (&by_fit, mut payload) = payload.split_first()?;
    let map = take_u64(&mut payload)?;
    let expectation = Expectation { map, paces: None, probability: take_probability(payload)? };
    Some(Record::Outcome { name, person, by_fit: by_fit != 0, expectation })
}

fn decode_believed(mut payload: &[u8]) -> Option<Record> {
    let name = (take_u64(&mut payload)?, take_u64(&mut payload)?, take_u64(&mut payload)?);
    let (person, map) = (take_u32(&mut payload)?, take_u64(&mut payload)?);
    let mut paces = [0.0; PACES];
    for pace in &mut paces {
        *pace = f32::from_bits(take_u32(&mut payload)?);
    }
    let expectation = Expectation { map, paces: Some(paces), probability: take_probability(payload)? };
    paces.iter().all(|pace| pace.is_finite() && *pace >= 0.0).then_some(Record::Outcome {
        name,
        person,
        by_fit: false,
        expectation,
    })
}

/// A probability per room, of which a record has the rest.
fn take_probability(payload: &[u8]) -> Option<Vec<f32>> {
    let (rooms, rest) = payload.as_chunks();
    let probability: Vec<f32> = rooms.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    let sound = rest.is_empty()
        && rooms.len() <= MAX_ROOMS
        && probability.iter().all(|probability| (0.0..=1.0).contains(probability));
    sound.then_some(probability)
}

fn decode_port(mut payload: &[u8]) -> Option<Record> {
    let name = (take_u64(&mut payload)?, take_u64(&mut payload)?);
    Some(Record::Port { name, port: Port::from_bytes(payload.try_into().ok()?) })
}

fn decode_forgotten(mut payload: &[u8]) -> Option<Record> {
    let person = take_u32(&mut payload)?;
    matches!(payload, [0 | 1]).then(|| Record::Forgotten { person, is_before: payload == [1] })
}

fn take_u64(bytes: &mut &[u8]) -> Option<u64> {
    let (head, tail) = bytes.split_first_chunk()?;
    *bytes = tail;
    Some(u64::from_le_bytes(*head))
}

fn take_u32(bytes: &mut &[u8]) -> Option<u32> {
    let (head, tail) = bytes.split_first_chunk()?;
    *bytes = tail;
    Some(u32::from_le_bytes(*head))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use roomcast_core::narration::person_number;
    use std::path::Path;

    /// A folder on a disk that fails as it is told.
    #[derive(Debug)]
    struct Failing {
        folder: Folder,
        /// Nothing can be made or written, but for a part of it.
        is_full: bool,
        /// A next file finds no name.
        keeps_names: bool,
        /// A sync fails, and loses all that the open file has: its pages count as written.
        loses: bool,
        /// Names do not reach the disk.
        names_fail: bool,
        /// What a sync lost cannot be written again, and what an append left cannot be cut off.
        keeps_faults: bool,
        /// Nothing can be read.
        unreadable: bool,
        /// What is read of the current half from a byte on, in place of what is there.
        misread: Option<(usize, Vec<u8>)>,
    }

    impl Disk for Failing {
        fn read(&self, half: Half) -> io::Result<Vec<u8>> {
            if self.unreadable {
                return Err(io::Error::other("cannot be read"));
            }
            let mut bytes = self.folder.read(half)?;
            if let Some((at, given)) = self.misread.as_ref().filter(|_| half == Half::Current) {
                bytes[*at..*at + given.len()].copy_from_slice(given);
            }
            Ok(bytes)
        }

        fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
            match self.is_full {
                true => self.folder.append(&bytes[..bytes.len() / 2]).and(Err(io::ErrorKind::StorageFull.into())),
                false => self.folder.append(bytes),
            }
        }

        fn cut(&mut self, length: u64) -> io::Result<()> {
            match self.keeps_faults {
                true => Err(io::ErrorKind::StorageFull.into()),
                false => self.folder.cut(length),
            }
        }

        fn rewrite(&mut self, pieces: &[(u64, Vec<u8>)]) -> io::Result<()> {
            match self.keeps_faults {
                true => Err(io::ErrorKind::StorageFull.into()),
                false => self.folder.rewrite(pieces),
            }
        }

        fn sync(&mut self) -> io::Result<()> {
            if self.loses {
                let length = self.folder.read(Half::Current)?.len();
                self.folder.rewrite(&[(0, vec![0; length])])?;
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.folder.sync()
        }

        fn prepare(&mut self, bytes: &[u8]) -> io::Result<()> {
            match self.is_full {
                true => Err(io::ErrorKind::StorageFull.into()),
                false => self.folder.prepare(bytes),
            }
        }

        fn is_current(&self) -> io::Result<bool> {
            self.folder.is_current()
        }

        fn retire(&mut self) -> io::Result<()> {
            self.folder.retire()
        }

        fn place(&mut self, half: Half) -> io::Result<()> {
            match self.keeps_names {
                true => Err(io::ErrorKind::StorageFull.into()),
                false => self.folder.place(half),
            }
        }

        fn sync_names(&mut self) -> io::Result<()> {
            match self.names_fail {
                true => Err(io::ErrorKind::StorageFull.into()),
                false => self.folder.sync_names(),
            }
        }

        fn remove_aside(&mut self) -> io::Result<()> {
            self.folder.remove_aside()
        }
    }

    fn observation(sequence: u64) -> Observation {
        let sentence = Sentence::new(&format!("They do thing {sequence}.")).unwrap();
        let (observed_ns, observed_unix_ns) = (100 + sequence, 5);
        Observation {
            person: 3,
            source: 7,
            epoch: 1,
            observed_ns,
            observed_unix_ns,
            ..Observation::of(sequence, sentence)
        }
    }

    fn options(directory: &Path, bytes_max: u64) -> JournalOptions {
        JournalOptions { directory: directory.to_owned(), bytes_max, sync_ms: 1 }
    }

    /// Row "a sparse narration.journal.old of 4 GB" of the attacks; and a journal that was allowed to be larger before.
    #[test]
    fn a_half_that_is_too_large_is_kept_aside_and_its_newest_part_read() {
        let directory = tempfile::tempdir().unwrap();
        let (current, older) =
            (directory.path().join("narration.journal"), directory.path().join("narration.journal.old"));
        let large = options(directory.path(), 16 << 20);
        let (mut journal, _) = Journal::open(&large).unwrap();
        let all = 30_000;
        (0..all).for_each(|sequence| _ = journal.append(&observation(sequence)));
        drop(journal);
        let whole = fs::read(&current).unwrap();
        assert!(whole.len() > 2 << 20);
        let sparse = fs::File::create(&older).unwrap();
        sparse.set_len(4 << 30).unwrap();
        let small = options(directory.path(), 8192);
        let (mut journal, recovered) = Journal::open(&small).unwrap();
        let newest: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        assert_eq!(newest, (all - newest.len() as u64..all).collect::<Vec<_>>());
        assert!(newest.len() > 1000 && newest.len() < all as usize);
        let [kept, other] = [&current, &older].map(|half| PathBuf::from(format!("{}.large-1", half.display())));
        assert_eq!(fs::read(&kept).unwrap(), whole);
        assert_eq!(fs::metadata(&other).unwrap().len(), 4 << 30);
        assert!(fs::metadata(&older).unwrap().len() < 2 << 20);
        // It goes on as any journal does, and is not set aside again.
        journal.append(&observation(all));
        drop(journal);
        let (_journal, recovered) = Journal::open(&small).unwrap();
        assert_eq!(recovered.carried.iter().chain(&recovered.observations).last().unwrap().sequence, all);
        assert!(!PathBuf::from(format!("{}.large-2", older.display())).exists());
    }

    /// Whoever is forgotten is in no file of the state directory afterwards, whatever was kept aside.
    #[test]
    fn what_is_kept_aside_goes_when_somebody_is_forgotten() {
        let directory = tempfile::tempdir().unwrap();
        let (mut journal, _) = Journal::open(&options(directory.path(), 16 << 20)).unwrap();
        let carla = |sequence| {
            let sentence = Sentence::new("Carla opens the fridge.").unwrap();
            Observation { person: 7, source: 3, epoch: 1, ..Observation::of(sequence, sentence) }
        };
        (0..20_000).for_each(|sequence| _ = journal.append(&carla(sequence)));
        drop(journal);
        let (journal, _) = Journal::open(&options(directory.path(), 8192)).unwrap();
        // One whose number follows none: somebody has removed the others.
        let current = directory.path().join("narration.journal");
        let first = PathBuf::from(format!("{}.large-1", current.display()));
        fs::copy(&first, format!("{}.large-64", current.display())).unwrap();
        let is_carla = |observation: &Observation, _: Option<u32>| observation.person == 7;
        assert!(journal.handle().forget(7, is_carla, Duration::from_secs(60)).unwrap() > 0);
        drop(journal);
        for file in fs::read_dir(directory.path()).unwrap() {
            let path = file.unwrap().path();
            let bytes = fs::read(&path).unwrap();
            assert!(!bytes.windows(5).any(|word| word == b"Carla"), "{}", path.display());
        }
        assert!(!first.exists());
    }

    #[test]
    fn what_was_appended_comes_back() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 1 << 20);
        for run in 0..3 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let expected: Vec<_> = (0..run * 10).map(observation).collect();
            assert_eq!(recovered.observations, expected);
            for sequence in run * 10..(run + 1) * 10 {
                let number = journal.append(&observation(sequence));
                assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
            }
        }
    }

    #[test]
    fn the_size_is_bounded_and_the_newest_survive() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let (mut journal, _) = Journal::open(&options).unwrap();
        for sequence in 0..2000 {
            let number = journal.append(&observation(sequence));
            if sequence % 50 == 0 {
                assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
            }
        }
        let handle = journal.handle();
        drop(journal);
        let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
        assert!(size <= 16_384, "{size}");
        assert_eq!(handle.bytes(), size, "what is told is what is on the disk");
        let (journal, recovered) = Journal::open(&options).unwrap();
        assert_eq!(journal.handle().bytes(), size);
        assert_eq!(recovered.observations.last().unwrap().sequence, 1999);
        assert!(recovered.observations.len() > 50);
    }

    #[test]
    fn a_source_that_fell_silent_stays_known() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let quiet = Observation { source: 99, ..observation(41) };
        let mut sequence = 0;
        for run in 0..4 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let known = recovered.carried.iter().chain(&recovered.observations).filter(|o| **o == quiet).count();
            assert!(run == 0 || known > 0, "{run}: {recovered:?}");
            assert!(
                recovered
                    .observations
                    .windows(2)
                    .all(|pair| pair[0].source == 99 || pair[0].sequence < pair[1].sequence || pair[1].source == 99)
            );
            let port = recovered.ports.get(&(quiet.source, quiet.epoch));
            assert!(run == 0 || port == Some(&Port::simulated(3)), "{run}: {port:?}");
            if run == 0 {
                journal.bind((quiet.source, quiet.epoch), Port::simulated(3));
                journal.append(&quiet);
            }
            // Some rotations in every run.
            for _ in 0..700 {
                sequence += 1;
                let number = journal.append(&observation(sequence));
                assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
            }
            drop(journal);
            let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
            assert!(size <= 16_384, "{size}");
        }
    }

    /// A writer of an empty journal.
    fn writer(folder: &Path, half_bytes: u64) -> Writer<Failing> {
        let folder = Folder::open(folder, 1 << 30).unwrap();
        let disk = Failing {
            folder,
            is_full: false,
            keeps_names: false,
            loses: false,
            names_fail: false,
            keeps_faults: false,
            unreadable: false,
            misread: None,
        };
        Writer::open(disk, half_bytes, &[0; 16]).unwrap().0
    }

    #[test]
    fn a_quiet_source_stays_known_when_the_disk_is_full_at_a_rotation() {
        let directory = tempfile::tempdir().unwrap();
        let (current, older) =
            (directory.path().join("narration.journal"), directory.path().join("narration.journal.old"));
        let boot = [0; 16];
        let mut writer = writer(directory.path(), 4096);
        let quiet = Observation { source: 99, ..observation(41) };
        writer.write(&encode(&quiet, &boot)).unwrap();
        let mut sequence = 0;
        let mut next = || {
            sequence += 1;
            encode(&observation(sequence), &boot)
        };
        // Nothing of the quiet source in the second half.
        while !older.exists() {
            writer.write(&next()).unwrap();
        }
        for round in 0..4 {
            // There is no room for the next half; it comes later.
            writer.disk.is_full = true;
            while writer.length + 300 < 4096 {
                writer.disk.is_full = false;
                writer.write(&next()).unwrap();
                writer.disk.is_full = true;
            }
            for _ in 0..5 {
                writer.write(&next()).unwrap_err();
            }
            writer.disk.is_full = false;
            writer.write(&next()).unwrap();
            let mut recovered = Recovered::default();
            for half in [&older, &current] {
                read_records(&fs::read(half).unwrap(), &boot, &mut recovered);
            }
            let known = recovered.carried.iter().chain(&recovered.observations).any(|o| *o == quiet);
            assert!(known, "a restart after rotation {round} takes it again");
            assert_eq!(recovered.observations.last().unwrap().sequence, sequence_of(&writer));
            assert_eq!(recovered.damaged_bytes, 0);
        }
    }

    /// Who is named once is known again, however often all are spoken of afterwards.
    #[test]
    fn words_about_all_push_no_own_word_out() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let own = Observation { source: 99, name: Some("ada".into()), ..observation(1) };
        let of_all = |sequence: u64| {
            let said = Said::Presence(PresenceStatement::parse("everybody present in the kitchen").unwrap());
            Observation { source: 98, person: u32::MAX, said, ..observation(sequence) }
        };
        let told = |journal: &Journal, o: &Observation| {
            let Observation { source, epoch, sequence, .. } = *o;
            let outcome = Outcome { source, epoch, sequence, person: 1, by_fit: false, map: 7, probability: &[] };
            journal.handle().append(&outcome);
        };
        let mut sequence = 0;
        for run in 0..3 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let recovered = recovered.join();
            if run == 0 {
                journal.append(&own);
                told(&journal, &own);
                for word in (2..20).map(of_all) {
                    journal.append(&word);
                    told(&journal, &word);
                }
            } else {
                assert!(recovered.observations.iter().any(|o| o.source == 99), "ada is lost in run {run}");
            }
            for _ in 0..700 {
                sequence += 1;
                journal.append(&observation(sequence));
            }
        }
    }

    /// A daemon that was killed before it scored what it had taken, or lost with the power what it told of it: the next rotation knows whose that is all
    /// the same, and drops nobody.
    #[test]
    fn of_whom_nothing_was_told_is_kept_too() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let away = Said::Presence(PresenceStatement::parse("away").unwrap());
        let of = |sequence: u64, name: &str, said: Said| Observation {
            source: 99,
            person: u32::MAX,
            name: Some(name.into()),
            said,
            ..observation(sequence)
        };
        let mut sequence = 0;
        for run in 0..4 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let recovered = recovered.join();
            if run == 0 {
                let told = of(1, "ada", observation(1).said);
                journal.append(&told);
                let (source, epoch, person) = (99, 1, person_number("ada"));
                let probability = &[0.5, 0.5];
                journal.handle().append(&Outcome {
                    source,
                    epoch,
                    sequence: 1,
                    person,
                    by_fit: false,
                    map: 7,
                    probability,
                });
                journal.append(&of(2, "ada", away.clone()));
                journal.append(&of(3, "ben", away.clone()));
                journal.append(&Observation { source: 99, person: 5, ..observation(4) });
            } else {
                let kept: Vec<_> =
                    recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
                assert_eq!(kept, [1, 2, 3, 4], "{run}");
            }
            for _ in 0..700 {
                sequence += 1;
                let number = journal.append(&observation(sequence));
                let (source, epoch, person, map) = (7, 1, 3, 7);
                let probability = &[0.5, 0.5];
                let outcome = Outcome { source, epoch, sequence, person, by_fit: false, map, probability };
                assert!(
                    journal.handle().wait_for(number.max(journal.handle().append(&outcome)), Duration::from_secs(30))
                );
            }
        }
    }

    /// One narrator that says ten times what the journal holds makes the daemon forget nobody.
    #[test]
    fn who_says_much_pushes_nobody_out() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let boot = boot_id();
        let quiet = |sequence: u64, name: &str, said: &str| {
            let said = PresenceStatement::parse(said).map(Said::Presence);
            let said = said.unwrap_or_else(|_| Said::Sentence(Sentence::new("They lie on the bed.").unwrap()));
            Observation { source: 99, name: Some(name.into()), said, ..observation(sequence) }
        };
        let told = |journal: &Journal, o: &Observation, person: u32, probability: &[f64]| {
            let Observation { source, epoch, sequence, .. } = *o;
            journal.handle().append(&Outcome { source, epoch, sequence, person, by_fit: false, map: 7, probability })
        };
        let words = [
            quiet(1, "ada", "They walk."),
            quiet(2, "ben", "present"),
            quiet(3, "eve", "away"),
            quiet(4, "ada", "They lie."),
            quiet(5, "all", "everybody away"),
        ];
        let mut sequence = 0;
        for run in 0..4 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let recovered = recovered.join();
            if run == 0 {
                for (word, person) in words.iter().zip([1, 2, 3, 1, 4]) {
                    journal.append(word);
                    told(&journal, word, person, if person == 3 { &[] } else { &[0.25, 0.75] });
                }
                // Eve is forgotten, and then said to be away with everybody.
                let is_eve = |o: &Observation, _| o.name.as_deref() == Some("eve");
                assert_eq!(journal.handle().forget(3, is_eve, Duration::from_secs(30)).unwrap(), 1);
                journal.append(&quiet(6, "ben", "present in the kitchen"));
                told(&journal, &quiet(6, "ben", "present"), 2, &[1.0, 0.0]);
            } else {
                let kept: Vec<u64> =
                    recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
                assert_eq!(kept, [1, 2, 4, 5, 6], "{run}");
                assert_eq!(recovered.observations[..5].iter().filter(|o| o.source == 99).count(), 5);
                let of_ben: Vec<_> = recovered.expectations.iter().filter(|(_, person, _)| *person == 2).collect();
                assert_eq!(of_ben.len(), 2);
                assert_eq!((of_ben[1].0, &of_ben[1].2.probability[..]), (4, &[1.0, 0.0][..]));
                assert_eq!(recovered.forgotten, [(4, 3)], "{run}");
            }
            for _ in 0..700 {
                sequence += 1;
                let number = journal.append(&observation(sequence));
                let number = number.max(told(&journal, &observation(sequence), 0, &[0.5, 0.5]));
                assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
            }
            drop(journal);
            let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
            assert!(size <= 16_384, "{size}");
        }
        assert_ne!(boot, [0; 16]);
    }

    /// Words of one person that lie in different halves come back in their order, and so do those of one who was forgotten before.
    #[test]
    fn last_words_keep_their_order_over_rotations() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 8192);
        let of_ada = |sequence: u64| Observation { source: 99, name: Some("ada".into()), ..observation(sequence) };
        let say = |journal: &mut Journal, o: &Observation, person: u32, by_fit: bool| {
            journal.append(o);
            let Observation { source, epoch, sequence, .. } = *o;
            let outcome = Outcome { source, epoch, sequence, person, by_fit, map: 7, probability: &[] };
            let number = journal.handle().append(&outcome);
            assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
        };
        let (mut noise, mut expected) = (0, Vec::new());
        for round in 0..12 {
            let (mut journal, recovered) = Journal::open(&options).unwrap();
            let recovered = recovered.join();
            let of_source = recovered.observations.iter().filter(|o| o.source == 99 && o.sequence < 1000);
            assert_eq!(of_source.map(|o| o.sequence).collect::<Vec<_>>(), expected, "{round}");
            match round {
                0 | 1 | 2 | 6 => {
                    say(&mut journal, &of_ada(round), 1, false);
                    expected.push(round);
                }
                4 => {
                    journal.handle().forget(1, |o, _| o.source == 99, Duration::from_secs(30)).unwrap();
                    expected.clear();
                }
                // What names somebody and changes nothing does not count.
                7 => (0..20).for_each(|number| say(&mut journal, &of_ada(1000 + number), 1, true)),
                _ => {}
            }
            // About one rotation and a half.
            for _ in 0..35 {
                noise += 1;
                say(&mut journal, &observation(noise), 0, false);
            }
        }
        assert_eq!(expected, [6]);
    }

    /// A disk that cannot be read for a while takes nobody's last words; one that can never be read again does not end the journal.
    #[test]
    fn a_rotation_that_cannot_read_is_put_off_and_not_for_ever() {
        for (fails, is_known) in [(UNREAD_MAX, true), (u32::MAX, false)] {
            let folder = tempfile::tempdir().unwrap();
            let mut writer = writer(folder.path(), 4096);
            let ada = Observation { source: 99, name: Some("ada".into()), ..observation(1) };
            let outcome =
                Outcome { source: 99, epoch: 1, sequence: 1, person: 1, by_fit: false, map: 7, probability: &[] };
            writer.write(&[encode(&ada, &[0; 16]), encode_outcome(&outcome)].concat()).unwrap();
            let mut failed = 0;
            // Until nothing but last words can have ada's.
            for sequence in 2..400 {
                writer.disk.unreadable = failed < fails;
                failed += u32::from(writer.write(&encode(&observation(sequence), &[0; 16])).is_err());
            }
            writer.disk.unreadable = false;
            let mut recovered = Recovered::default();
            for half in [Half::Older, Half::Current] {
                read_records(&writer.disk.read(half).unwrap(), &[0; 16], &mut recovered);
            }
            let back = recovered.join().observations;
            assert_eq!(back.iter().any(|own| own.source == 99), is_known, "{fails}");
            writer.write(&encode(&observation(400), &[0; 16])).unwrap();
            assert!(failed >= fails.min(UNREAD_MAX) && writer.unwritten.is_empty(), "{failed}");
        }
    }

    fn sequence_of(writer: &Writer<Failing>) -> u64 {
        let mut recovered = Recovered::default();
        read_records(&writer.last[&(7, 1)].record, &[0; 16], &mut recovered);
        recovered.observations[0].sequence
    }

    #[test]
    fn two_daemons_cannot_share_it() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 1 << 20);
        let _first = Journal::open(&options).unwrap();
        assert!(matches!(Journal::open(&options), Err(JournalError::Locked { .. })));
    }

    /// Nothing that a person did stays in the journal, in neither half, and what a narrator sends again does not bring it back.
    #[test]
    fn who_is_forgotten_leaves_no_trace() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 16_384);
        let (mut journal, _) = Journal::open(&options).unwrap();
        let handle = journal.handle();
        let of = |sequence: u64, name: &str| {
            let sentence = Sentence::new(&format!("They do secret {sequence}.")).unwrap();
            let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
            let person = u32::MAX;
            Observation { person, name, source: 7, epoch: sequence / 64, ..Observation::of(sequence, sentence) }
        };
        for sequence in 1..=120 {
            let name = ["ada", "ben", ""][sequence as usize % 3];
            let mut number = journal.append(&of(sequence, name));
            if name.is_empty() {
                let (source, epoch, person) = (7, sequence / 64, 1 + sequence as u32 % 2);
                let outcome = Outcome { source, epoch, sequence, person, by_fit: true, map: 1, probability: &[] };
                number = handle.append(&outcome);
            }
            // More at once than a half holds would be cut.
            assert!(handle.wait_for(number, Duration::from_secs(30)));
        }
        let is_ada = |o: &Observation| o.name.as_deref() == Some("ada");
        let is_theirs = move |o: &Observation, found: Option<u32>| is_ada(o) || found == Some(1);
        assert!(handle.forget(1, is_theirs, Duration::from_secs(30)).unwrap() > 0);
        assert_eq!(handle.forget(1, is_theirs, Duration::from_secs(30)).unwrap(), 0);
        let last = journal.append(&of(121, "ben"));
        assert!(handle.wait_for(last, Duration::from_secs(30)));
        let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
        assert_eq!(handle.bytes(), size);
        assert!(matches!(Journal::open(&options), Err(JournalError::Locked { .. })));
        drop(journal);
        let (_, recovered) = Journal::open(&options).unwrap();
        let theirs = |o: &Observation| is_ada(o) || (o.by_fit && o.person == 1);
        assert!(!recovered.observations.iter().any(theirs) && recovered.observations.len() > 50);
        assert!(recovered.observations.iter().any(|o| o.by_fit && o.person == 2));
        let all: Vec<u8> = ["narration.journal", "narration.journal.old"]
            .iter()
            .flat_map(|half| fs::read(directory.path().join(half)).unwrap())
            .collect();
        let all = String::from_utf8_lossy(&all);
        assert!(!all.contains("ada") && !all.contains("secret 3.") && all.contains("secret 4."));
        // All is still known to be taken, in its order.
        let taken: Vec<u64> = recovered.taken().map(|o| o.sequence).collect();
        assert!(taken.windows(2).all(|pair| pair[0] < pair[1]) && taken.last() == Some(&121), "{taken:?}");
    }

    /// Names, presence and attributions come back as they were; what the model said comes with the observation that it followed.
    #[test]
    fn who_was_where_comes_back() {
        let boot = [3; 16];
        let named = |sequence: u64, name: &str| Observation { name: Some(name.into()), ..observation(sequence) };
        let away = Said::Presence(PresenceStatement::parse("away").unwrap());
        let told = [
            observation(1),
            named(2, "Ada"),
            Observation { said: away, ..named(3, "Éva") },
            Observation { person: u32::MAX, ..observation(4) },
        ];
        let mut bytes: Vec<u8> = told.iter().flat_map(|observation| encode(observation, &boot)).collect();
        let outcome = |sequence: u64, by_fit: bool, probability: &'static [f64]| {
            let (person, map) = (9, 77);
            encode_outcome(&Outcome { source: 7, epoch: 1, sequence, person, by_fit, map, probability })
        };
        for outcome in [outcome(2, false, &[0.25, 0.75]), outcome(4, true, &[]), outcome(99, true, &[1.0])] {
            bytes.extend_from_slice(&outcome);
        }
        let (last, probability) = ((7, 1, 2), vec![0.5, 0.5]);
        bytes.extend(encode_believed(&Believed { last, person: 9, map: 78, paces: [40.5; PACES], probability }));
        let mut recovered = Recovered::default();
        read_records(&bytes, &boot, &mut recovered);
        let attributed = Observation { person: 9, by_fit: true, ..told[3].clone() };
        assert_eq!(recovered.observations, [told[0].clone(), told[1].clone(), told[2].clone(), attributed.clone()]);
        let next = Expectation { map: 77, paces: None, probability: vec![0.25, 0.75] };
        let was = Expectation { map: 78, paces: Some([40.5; PACES]), probability: vec![0.5, 0.5] };
        assert_eq!(recovered.expectations, [(1, 9, next), (1, 9, was)]);
        assert_eq!(recovered.damaged_bytes, 0);
        // Whom an observation moved comes back in its order, nobody included.
        let said = |text: &str| PresenceStatement::parse(text).ok().map(Said::Presence);
        let sentence = Sentence::new("Mia cooks.").ok().map(Said::Sentence);
        let by = |person: u32, name: &str, said: Option<Said>| {
            let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
            Move { person, name, by_fit: person == 3, said }
        };
        let moved = [
            Moved { observation: (7, 1, 1), moves: Vec::new() },
            Moved {
                observation: (7, 1, 2),
                moves: vec![
                    by(1, "Éva", None),
                    by(2, "", said("away")),
                    by(3, "", said("away")),
                    by(u32::MAX, "", said("nobody in the kitchen")),
                    by(4, "Mia", sentence.clone()),
                    by(5, "", sentence),
                    by(6, "", None),
                ],
            },
        ];
        let mut again = Recovered::default();
        read_records(&moved.iter().flat_map(encode_moved).collect::<Vec<u8>>(), &boot, &mut again);
        assert_eq!(again.damaged_bytes, 0);
        for Moved { observation, moves } in moved {
            assert_eq!(again.moved.remove(&observation), Some(moves));
        }
        // An attribution that is carried over stays one.
        let mut again = Recovered::default();
        read_records(&encode(&attributed, &boot), &boot, &mut again);
        assert_eq!(again.observations, [attributed]);
    }

    #[test]
    fn another_boots_monotonic_time_is_dropped() {
        let mut recovered = Recovered::default();
        read_records(&encode(&observation(1), &[1; 16]), &[2; 16], &mut recovered);
        read_records(&encode(&observation(2), &[2; 16]), &[2; 16], &mut recovered);
        assert_eq!(recovered.observations[0].observed_ns, 0);
        assert_eq!(recovered.of_other_boots, HashSet::from([(7, 1, 1)]));
    }

    proptest! {
        #[test]
        fn a_torn_end_loses_one_record_and_damage_only_what_it_touches(cut in 0usize..500, at in 0usize..500, bit in 0u8..8) {
            let boot = [0; 16];
            let whole: Vec<u8> = (0..5).flat_map(|n| encode(&observation(n), &boot)).collect();
            let record = whole.len() / 5;

            let cut = cut.min(whole.len());
            let mut torn = Recovered::default();
            read_records(&whole[..cut], &boot, &mut torn);
            prop_assert_eq!(torn.observations.len(), cut / record);

            let mut damaged = whole.clone();
            let at = at % damaged.len();
            damaged[at] ^= 1 << bit;
            let mut found = Recovered::default();
            read_records(&damaged, &boot, &mut found);
            prop_assert_eq!(found.observations.len(), 4);
            let lost = (at / record) as u64;
            prop_assert!(found.observations.iter().all(|o| o.sequence != lost && *o == observation(o.sequence)));
        }

        #[test]
        fn arbitrary_bytes_are_no_trap(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
            let mut recovered = Recovered::default();
            read_records(&bytes, &[0; 16], &mut recovered);
            prop_assert!(recovered.damaged_bytes as usize <= bytes.len());
        }
    }

    /// A rotation that fails after the full half got its new name loses nothing, at the next one or at a restart.
    #[test]
    fn a_rotation_that_fails_half_way_keeps_both_halves() {
        for restarts in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let older = folder.path().join("narration.journal.old");
            let mut writer = writer(folder.path(), 4096);
            let mut sequence = 0;
            let mut next = || {
                sequence += 1;
                encode(&observation(sequence), &[0; 16])
            };
            while !older.exists() {
                writer.write(&next()).unwrap();
            }
            let before = writer.last.len();
            writer.disk.keeps_names = true;
            while writer.write(&next()).is_ok() {}
            let full = fs::read(&older).unwrap();
            assert!(full.len() > 2048 && !folder.path().join("narration.journal").exists());
            if restarts {
                drop(writer);
                writer = self::writer(folder.path(), 4096);
            }
            writer.disk.keeps_names = false;
            writer.write(&next()).unwrap();
            assert_eq!(fs::read(&older).unwrap(), full);
            assert_eq!(writer.last.len(), before);
        }
    }

    /// A sync keeps out of the way of what is written, is never later than promised, and not more frequent than that.
    #[test]
    fn a_sync_waits_for_silence_and_not_longer_than_promised() {
        let (start, every) = (Instant::now(), Duration::from_secs(1));
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut due = SyncDue::new(every, start);
        assert_eq!(due.at(), Some(at(1000)), "what a process before has left");
        due.synced(true, at(1003));
        assert_eq!(due.at(), None);
        // After a long silence it follows soon, and not at once.
        due.wrote(at(5000));
        due.wrote(at(5002));
        assert_eq!(due.at(), Some(at(5102)));
        due.synced(true, at(5105));
        // More often than promised it is not.
        due.wrote(at(5600));
        assert_eq!(due.at(), Some(at(6105)));
        // Who never falls silent does not put it off.
        for ms in (6050..6600).step_by(50) {
            due.wrote(at(ms));
        }
        assert_eq!(due.at(), Some(at(6600)));
        due.synced(false, at(6604));
        assert_eq!(due.at(), Some(at(7604)), "what it failed with is tried again");
        let mut due = SyncDue::new(Duration::from_millis(1), start);
        due.wrote(at(50));
        assert_eq!(due.at(), Some(at(1)));
    }

    /// A power loss that finds a folder not synced takes all that was written to a new half: so that is tried again.
    #[test]
    fn names_that_a_sync_fails_with_are_synced_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path(), 4096);
        writer.sync().unwrap();
        writer.disk.names_fail = true;
        // No name has changed.
        writer.write(&encode(&observation(1), &[0; 16])).unwrap();
        writer.sync().unwrap();
        let mut sequence = 1;
        while !folder.path().join("narration.journal.old").exists() {
            sequence += 1;
            writer.write(&encode(&observation(sequence), &[0; 16])).unwrap();
        }
        writer.sync().unwrap_err();
        writer.sync().unwrap_err();
        writer.disk.names_fail = false;
        writer.sync().unwrap();
    }

    /// A disk that fails twice in a row: what a sync lost is not written again at once, and what a failed append left is not cut off at once.
    /// The next sync and the next append do that first.
    #[test]
    fn faults_behind_faults_take_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path(), 1 << 16);
        let record = |sequence| encode(&observation(sequence), &[7; 16]);
        let read = |writer: &Writer<Failing>| {
            let mut recovered = Recovered::default();
            read_records(&writer.disk.read(Half::Current).unwrap(), &[7; 16], &mut recovered);
            let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
            (sequences, recovered.damaged_bytes)
        };
        writer.write(&record(1)).unwrap();
        (writer.disk.loses, writer.disk.keeps_faults) = (true, true);
        writer.sync().unwrap_err();
        (writer.disk.loses, writer.disk.keeps_faults) = (false, false);
        writer.sync().unwrap();
        assert_eq!(read(&writer), (vec![1], 0));

        (writer.disk.is_full, writer.disk.keeps_faults) = (true, true);
        writer.write(&record(2)).unwrap_err();
        // As long as nobody knows where the file ends, nothing is put behind it.
        writer.disk.is_full = false;
        writer.write(&record(3)).unwrap_err();
        writer.disk.keeps_faults = false;
        writer.write(&record(4)).unwrap();
        assert_eq!(read(&writer), (vec![1, 2, 3, 4], 0));
    }

    /// More at once than a half holds, as from a daemon that stood still, goes into both.
    #[test]
    fn a_batch_larger_than_half_is_rotated_and_not_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path(), 4096);
        let batch: Vec<u8> = (1..=60).flat_map(|sequence| encode(&observation(sequence), &[7; 16])).collect();
        assert!(batch.len() > 4096 && batch.len() < 7000, "{}", batch.len());
        writer.write(&batch).unwrap();
        let (_, recovered) = Writer::open(writer.disk, 4096, &[7; 16]).unwrap();
        assert_eq!(recovered.observations.len(), 60);
    }

    /// Whoever invents sources leaves the others whose they are and what they said last, also in the smallest journal.
    #[test]
    fn invented_sources_push_out_their_own() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path(), 4096);
        let said = |source, epoch| encode(&Observation { source, epoch, ..observation(epoch) }, &[7; 16]);
        let (honest, stranger) = (Port::simulated(1), Port::simulated(2));
        writer.write(&[encode_port((7, 1), honest), said(7, 1)].concat()).unwrap();
        for epoch in 1..=200 {
            writer.write(&[encode_port((99, epoch), stranger), said(99, epoch)].concat()).unwrap();
        }
        let (_, recovered) = Writer::open(writer.disk, 4096, &[7; 16]).unwrap();
        assert_eq!(recovered.ports.get(&(7, 1)), Some(&honest));
        assert!(recovered.carried.iter().any(|last| (last.source, last.sequence) == (7, 1)));
        assert_eq!(recovered.settled().get(&(7, 1)), Some(&1));
    }

    /// What another daemon wrote and did not sync is written again, too.
    #[test]
    fn what_a_killed_daemon_wrote_is_synced() {
        let folder = tempfile::tempdir().unwrap();
        let mut first = writer(folder.path(), 1 << 16);
        first.write(&encode(&observation(1), &[7; 16])).unwrap();
        drop(first);
        let mut second = writer(folder.path(), 1 << 16);
        second.disk.loses = true;
        assert!(second.sync().is_err());
        second.disk.loses = false;
        second.sync().unwrap();
        let mut recovered = Recovered::default();
        read_records(&second.disk.read(Half::Current).unwrap(), &[7; 16], &mut recovered);
        assert_eq!((recovered.observations.len(), recovered.damaged_bytes), (1, 0));
    }

    /// A disk that gives a start a block of elsewhere, or of before, and then fails a sync: what it gave is not written over what it has.
    #[test]
    fn what_was_misread_is_not_written_over_the_disk() {
        let boot = [7; 16];
        for is_stale in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            let mut first = writer(folder.path(), 1 << 16);
            for sequence in 1..=20 {
                first.write(&encode(&observation(sequence), &boot)).unwrap();
            }
            first.sync().unwrap();
            let mut disk = first.disk;
            let whole = disk.read(Half::Current).unwrap();
            disk.misread = Some((512, if is_stale { vec![0; 512] } else { whole[1024..1536].to_vec() }));
            let (mut second, recovered) = Writer::open(disk, 1 << 16, &boot).unwrap();
            assert!((10..18).contains(&recovered.observations.len()), "{}", recovered.observations.len());
            second.write(&encode(&observation(21), &boot)).unwrap();
            // The sync loses what others had not brought to the disk: of where the block came from, too, and what is new.
            let length = second.disk.folder.read(Half::Current).unwrap().len();
            second.disk.folder.rewrite(&[(1152, vec![0; length - 1152])]).unwrap();
            second.lacks_pages = true;
            second.sync().unwrap();
            second.disk.misread = None;
            let mut recovered = Recovered::default();
            read_records(&second.disk.read(Half::Current).unwrap(), &boot, &mut recovered);
            let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
            assert_eq!((sequences, recovered.damaged_bytes), ((1..=21).collect(), 0), "{is_stale}");
        }
    }

    /// A disk that gives a block twice, or a daemon that was told again what its disk hid from it, makes nobody say anything twice.
    #[test]
    fn what_is_read_twice_is_said_once() {
        let boot = [7; 16];
        let all: Vec<u8> = [1, 2, 3, 2, 3, 4, 1].iter().flat_map(|n| encode(&observation(*n), &boot)).collect();
        let mut recovered = Recovered::default();
        read_records(&all, &boot, &mut recovered);
        read_records(&all, &boot, &mut recovered);
        let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        assert_eq!(sequences, [1, 2, 3, 4]);
    }

    /// A named pipe would be waited for, and a device read without end.
    #[test]
    fn a_journal_that_is_no_plain_file_is_refused() {
        for name in ["narration.journal", "narration.journal.old"] {
            let folder = tempfile::tempdir().unwrap();
            std::os::unix::fs::symlink("/dev/null", folder.path().join(name)).unwrap();
            let options = JournalOptions { directory: folder.path().to_owned(), bytes_max: 8192, sync_ms: 1000 };
            let error = Journal::open(&options).unwrap_err().to_string();
            assert!(error.contains("no plain file"), "{name}: {error}");
        }
    }

    /// Row "fsync that fails once" of the attacks: what was written before it is lost with the power, if it is not written again.
    #[test]
    fn what_a_sync_fails_with_is_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let current = folder.path().join("narration.journal");
        let mut writer = writer(folder.path(), 1 << 16);
        writer.disk.loses = true;
        for sequence in 1..=3 {
            writer.write(&encode(&observation(sequence), &[7; 16])).unwrap();
        }
        assert!(writer.sync().is_err());
        writer.disk.loses = false;
        writer.write(&encode(&observation(4), &[7; 16])).unwrap();
        writer.sync().unwrap();
        let mut recovered = Recovered::default();
        read_records(&fs::read(&current).unwrap(), &[7; 16], &mut recovered);
        let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        assert_eq!((sequences, recovered.damaged_bytes), (vec![1, 2, 3, 4], 0));
    }
}
