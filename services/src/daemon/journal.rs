//! The narration history on disk, so that it outlives the daemon: an append-only file of records, each with a checksum, in two
//! halves of bounded size. A writer thread owns the file; nothing on the way from event to scores waits for the disk.
//!
//! A record is `"RCJ1"`, the payload's length (u32), the CRC-32 of the payload (u32), the payload; integers little endian. The
//! payload is source, epoch, sequence, observed_ns, observed_unix_ns (u64 each), person (u32), the machine's boot id (16 bytes)
//! and the sentence. Reading skips what is damaged and goes on at the next record whose checksum is right.
//!
//! When the older half goes, the last record of every source that it alone knew is carried over as `"RCJ2"`: what the source said then is
//! history no more, but what it says again is still known.
//!
//! A record is handed to the system as soon as it is written, so a daemon that is killed loses nothing; what the machine loses with
//! its power is at most the last [`JournalOptions::sync_ms`].

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};
use rustix::fs::FlockOperation;

use super::intake::SOURCES_MAX;
use roomcast_core::narration::{Observation, Sentence};

const MAGIC: [u8; 4] = *b"RCJ1";
const MAGIC_CARRIED: [u8; 4] = *b"RCJ2";
const HEADER_BYTES: usize = 12;
const FIXED_BYTES: usize = 5 * 8 + 4 + 16;
/// No payload is longer: a sentence has at most 1024 bytes.
const PAYLOAD_BYTES_MAX: usize = FIXED_BYTES + roomcast_core::narration::SENTENCE_BYTES_MAX;
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
    /// Another daemon has it.
    #[error("journal {}: another daemon is using it; stop that one, or set daemon.state to another directory", path.display())]
    Locked {
        /// The file.
        path: PathBuf,
    },
}

/// What was found at the start.
#[derive(Debug, Default)]
pub struct Recovered {
    /// The observations, oldest first.
    pub observations: Vec<Observation>,
    /// The last ones of sources that have been silent since: too old for the history, but taken.
    pub carried: Vec<Observation>,
    /// Bytes that were no record: a torn end, or damage.
    pub damaged_bytes: u64,
}

#[derive(Debug, Default)]
struct Progress {
    written: Mutex<u64>,
    grew: Condvar,
    bytes: AtomicU64,
    failures: AtomicU64,
}

/// The journal of a running daemon.
#[derive(Debug)]
pub struct Journal {
    records: Option<Sender<Vec<u8>>>,
    appended: u64,
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
        let failed = |path: &Path, operation| {
            let path = path.to_owned();
            move |source| JournalError::File { path, operation, source }
        };
        fs::create_dir_all(directory).map_err(failed(directory, "make"))?;
        let (current, older) = (directory.join("narration.journal"), directory.join("narration.journal.old"));
        let mut file = open_file(&current).map_err(failed(&current, "open"))?;
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {}
            Err(rustix::io::Errno::WOULDBLOCK) => return Err(JournalError::Locked { path: current }),
            Err(error) => return Err(failed(&current, "lock")(error.into())),
        }
        sync_folder(&current).map_err(failed(directory, "sync"))?;
        let boot_id = boot_id();
        let mut recovered = Recovered::default();
        let mut older_length = 0;
        match fs::read(&older) {
            Ok(bytes) => {
                older_length = bytes.len() as u64;
                read_records(&bytes, &boot_id, &mut recovered);
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failed(&older, "read")(error)),
        }
        let mut last = BTreeMap::new();
        let mut note = |found: &Recovered, in_current| {
            for observation in found.carried.iter().chain(&found.observations) {
                last.insert(observation.source, (encode(observation, &boot_id), in_current));
            }
        };
        note(&recovered, false);
        let (mut bytes, mut newer) = (Vec::new(), Recovered::default());
        file.read_to_end(&mut bytes).map_err(failed(&current, "read"))?;
        read_records(&bytes, &boot_id, &mut newer);
        note(&newer, true);
        recovered.observations.append(&mut newer.observations);
        recovered.carried.append(&mut newer.carried);
        recovered.damaged_bytes += newer.damaged_bytes;

        let (records, queue) = bounded(QUEUE);
        let progress = Arc::new(Progress::default());
        progress.bytes.store(older_length + bytes.len() as u64, Ordering::Relaxed);
        let mut writer = Writer {
            file,
            current,
            older,
            length: bytes.len() as u64,
            older_length,
            open: open_file,
            unwritten: Vec::new(),
            unsynced: Vec::new(),
            synced: bytes.len() as u64,
            sync_data: File::sync_data,
            last,
            half_bytes: (options.bytes_max / 2).max(4096),
            sync_every: Duration::from_millis(options.sync_ms.max(1)),
            progress: Arc::clone(&progress),
        };
        let writer = std::thread::Builder::new()
            .name("journal".to_owned())
            .spawn(move || writer.run(&queue))
            .map_err(failed(directory, "start the writer of"))?;
        let journal = Self { records: Some(records), appended: 0, boot_id, progress, writer: Some(writer) };
        Ok((journal, recovered))
    }

    /// Hands an observation to the writer; returns its number, for [`JournalHandle::wait_for`].
    pub fn append(&mut self, observation: &Observation) -> u64 {
        let record = encode(observation, &self.boot_id);
        if let Some(records) = &self.records
            && records.send(record).is_ok()
        {
            self.appended += 1;
        }
        self.appended
    }

    /// What other threads may ask of the journal.
    #[must_use]
    pub fn handle(&self) -> JournalHandle {
        JournalHandle { progress: Arc::clone(&self.progress) }
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        drop(self.records.take());
        if let Some(writer) = self.writer.take() {
            // A writer that panicked has said so; there is nothing left to do here.
            let _ended = writer.join();
        }
    }
}

/// A view of the journal's progress.
#[derive(Debug, Clone)]
pub struct JournalHandle {
    progress: Arc<Progress>,
}

impl JournalHandle {
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

struct Writer {
    file: File,
    current: PathBuf,
    older: PathBuf,
    length: u64,
    older_length: u64,
    /// Opens a new half.
    open: fn(&Path) -> io::Result<File>,
    /// Records that the disk refused, tried again with the next ones: a full disk may have room again.
    unwritten: Vec<u8>,
    /// Records that were written since the last sync. The system takes for written what a sync has failed with, so they are written again.
    unsynced: Vec<u8>,
    /// Where they begin.
    synced: u64,
    /// [`File::sync_data`], or a disk that fails.
    sync_data: fn(&File) -> io::Result<()>,
    /// Per source its last record, and whether the current half has it. What it has not is carried over at the next rotation.
    last: BTreeMap<u64, (Vec<u8>, bool)>,
    half_bytes: u64,
    sync_every: Duration,
    progress: Arc<Progress>,
}

impl Writer {
    fn run(&mut self, queue: &Receiver<Vec<u8>>) {
        let mut synced = Instant::now();
        let mut dirty = false;
        loop {
            match queue.recv_timeout(self.sync_every) {
                Ok(record) => {
                    let mut batch = record;
                    let mut records = 1;
                    // What waits already goes out in one write.
                    for record in queue.try_iter().take(1023) {
                        batch.extend_from_slice(&record);
                        records += 1;
                    }
                    let written = self.write(&batch);
                    self.note(written);
                    dirty = true;
                    // The number counts also when writing failed: nobody is to wait for a full disk.
                    *self.progress.written.lock().unwrap_or_else(PoisonError::into_inner) += records;
                    self.progress.grew.notify_all();
                }
                Err(RecvTimeoutError::Timeout) if !self.unwritten.is_empty() => {
                    let written = self.write(&[]);
                    self.note(written);
                    dirty = true;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if dirty && synced.elapsed() >= self.sync_every {
                let done = self.sync();
                dirty = done.is_err();
                self.note(done);
                synced = Instant::now();
            }
        }
        if !self.unwritten.is_empty() {
            let written = self.write(&[]);
            self.note(written);
        }
        let done = self.sync().or_else(|_| self.sync());
        self.note(done);
    }

    /// Brings what was written to the disk; what that fails with is written again, for the next sync.
    fn sync(&mut self) -> io::Result<()> {
        if let Err(error) = (self.sync_data)(&self.file) {
            self.write_again()?;
            return Err(error);
        }
        self.synced = self.length;
        self.unsynced.clear();
        Ok(())
    }

    /// Writes what may not be on the disk once more, in its place: at no time is anything gone from the file.
    fn write_again(&self) -> io::Result<()> {
        // The file appends, so it is written to through another descriptor.
        let again = format!("/proc/self/fd/{}", self.file.as_raw_fd());
        OpenOptions::new().write(true).open(again)?.write_all_at(&self.unsynced, self.synced)
    }

    /// Drops the oldest of what the disk refuses, so that the rest fits into a half; last words that are carried over go last.
    fn trim_unwritten(&mut self) {
        while self.unwritten.len() as u64 > self.half_bytes {
            let mut from = 0;
            while self.unwritten[from..].starts_with(&MAGIC_CARRIED) {
                from += record_bytes(&self.unwritten[from..]);
            }
            if from >= self.unwritten.len() {
                from = 0;
            }
            let until = from + record_bytes(&self.unwritten[from..]);
            self.unwritten.drain(from..until);
        }
    }

    /// Writes what was refused before, then `batch`; what is refused now is kept, as much of it as a half may hold.
    fn write(&mut self, batch: &[u8]) -> io::Result<()> {
        self.unwritten.extend_from_slice(batch);
        self.trim_unwritten();
        if self.length + self.unwritten.len() as u64 > self.half_bytes && self.length > 0 {
            self.rotate()?;
            self.trim_unwritten();
        }
        if let Err(error) = self.file.write_all(&self.unwritten) {
            // Part of it may have been taken: cut it off again. If that fails too, reading steps over it.
            let _cut = self.file.set_len(self.length);
            return Err(error);
        }
        self.length += self.unwritten.len() as u64;
        let mut rest = &self.unwritten[..];
        while !rest.is_empty() {
            let (record, after) = rest.split_at(record_bytes(rest));
            self.last.insert(source_of(record), (record.to_vec(), true));
            rest = after;
        }
        self.unsynced.append(&mut self.unwritten);
        self.progress.bytes.store(self.older_length + self.length, Ordering::Relaxed);
        Ok(())
    }

    /// The full half becomes the old one, whose predecessor goes, but for the last words of sources that only it knew. The lock moves to the
    /// new file before the old one lets go.
    fn rotate(&mut self) -> io::Result<()> {
        if let Err(error) = (self.sync_data)(&self.file) {
            self.write_again()?;
            return Err(error);
        }
        let quiet: Vec<u64> =
            self.last.iter().filter(|(_, (_, current))| !current).map(|(source, _)| *source).collect();
        // More than the daemon knows, and of sources that it has forgotten.
        for source in quiet.iter().skip(SOURCES_MAX) {
            self.last.remove(source);
        }
        let mut carried: Vec<u8> = Vec::new();
        for (record, _) in self.last.values().filter(|(_, in_current)| !in_current) {
            carried.extend_from_slice(&MAGIC_CARRIED);
            carried.extend_from_slice(&record[MAGIC.len()..]);
        }
        // In a journal of the least size it is the newest narration that counts.
        carried.truncate(if carried.len() as u64 > self.half_bytes / 4 { 0 } else { carried.len() });
        // A rotation that got no further before has put the full half in place already: another file has its name now, or none.
        if names_file(&self.current, &self.file)? {
            fs::rename(&self.current, &self.older)?;
        }
        self.older_length = self.length;
        let file = (self.open)(&self.current)?;
        rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive)?;
        self.file = file;
        self.length = 0;
        self.synced = 0;
        self.unsynced.clear();
        // The new half has nothing yet. What is carried goes first into it, and is tried again like everything that the disk refuses.
        self.last.values_mut().for_each(|(_, in_current)| *in_current = false);
        self.unwritten.splice(..0, carried);
        self.note(sync_folder(&self.current));
        Ok(())
    }

    fn note(&self, result: io::Result<()>) {
        if let Err(error) = result {
            let failures = self.progress.failures.fetch_add(1, Ordering::Relaxed) + 1;
            if failures.is_power_of_two() {
                tracing::warn!(%error, failures, path = %self.current.display(), "the journal cannot be written; the history in memory is complete");
            }
        }
    }
}

/// Whether `path` names the open file.
fn names_file(path: &Path, file: &File) -> io::Result<bool> {
    use std::os::unix::fs::MetadataExt;
    match fs::symlink_metadata(path) {
        Ok(there) => {
            let ours = file.metadata()?;
            Ok((there.dev(), there.ino()) == (ours.dev(), ours.ino()))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Brings the names of a file's folder to the disk: without it a power loss may undo a rename.
pub(super) fn sync_folder(file: &Path) -> io::Result<()> {
    File::open(file.parent().unwrap_or(Path::new(".")))?.sync_all()
}

fn open_file(path: &Path) -> io::Result<File> {
    use std::os::unix::fs::OpenOptionsExt;
    OpenOptions::new().read(true).append(true).create(true).mode(0o600).open(path)
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
    let sentence = observation.sentence.as_str().as_bytes();
    let length = FIXED_BYTES + sentence.len();
    let mut record = Vec::with_capacity(HEADER_BYTES + length);
    record.extend_from_slice(&MAGIC);
    record.extend_from_slice(&(length as u32).to_le_bytes());
    record.extend_from_slice(&[0; 4]);
    for number in [
        observation.source,
        observation.epoch,
        observation.sequence,
        observation.observed_ns,
        observation.observed_unix_ns,
    ] {
        record.extend_from_slice(&number.to_le_bytes());
    }
    record.extend_from_slice(&observation.person.to_le_bytes());
    record.extend_from_slice(boot_id);
    record.extend_from_slice(sentence);
    let checksum = crc32fast::hash(&record[HEADER_BYTES..]);
    record[8..HEADER_BYTES].copy_from_slice(&checksum.to_le_bytes());
    record
}

/// The source of a whole record.
fn source_of(record: &[u8]) -> u64 {
    record.get(HEADER_BYTES..).and_then(|mut payload| take_u64(&mut payload)).unwrap_or_default()
}

/// Bytes of the first of some whole records; all of them where it is none.
fn record_bytes(records: &[u8]) -> usize {
    let length = records.get(4..).and_then(|mut rest| take_u32(&mut rest));
    length.map_or(records.len(), |length| (HEADER_BYTES + length as usize).min(records.len()))
}

/// Reads all records of a file's bytes; whatever is none is counted and stepped over. Monotonic times of another boot than
/// `boot_id` become 0.
pub fn read_records(bytes: &[u8], boot_id: &[u8; 16], recovered: &mut Recovered) {
    let mut rest = bytes;
    while !rest.is_empty() {
        match decode(rest, boot_id) {
            Some((observation, length)) => {
                let carried = rest.starts_with(&MAGIC_CARRIED);
                if carried { &mut recovered.carried } else { &mut recovered.observations }.push(observation);
                rest = &rest[length..];
            }
            None => {
                let next = rest[1..].windows(MAGIC.len()).position(|window| window == MAGIC || window == MAGIC_CARRIED);
                let skipped = next.map_or(rest.len(), |next| next + 1);
                recovered.damaged_bytes += skipped as u64;
                rest = &rest[skipped..];
            }
        }
    }
}

fn decode(bytes: &[u8], boot_id: &[u8; 16]) -> Option<(Observation, usize)> {
    let mut header = bytes.strip_prefix(&MAGIC).or_else(|| bytes.strip_prefix(&MAGIC_CARRIED))?;
    let length = take_u32(&mut header)? as usize;
    let checksum = take_u32(&mut header)?;
    if !(FIXED_BYTES..=PAYLOAD_BYTES_MAX).contains(&length) {
        return None;
    }
    let mut payload = header.get(..length)?;
    if crc32fast::hash(payload) != checksum {
        return None;
    }
    let (source, epoch, sequence) = (take_u64(&mut payload)?, take_u64(&mut payload)?, take_u64(&mut payload)?);
    let (observed_ns, observed_unix_ns) = (take_u64(&mut payload)?, take_u64(&mut payload)?);
    let person = take_u32(&mut payload)?;
    let (boot, sentence) = payload.split_at_checked(boot_id.len())?;
    let sentence = Sentence::new(std::str::from_utf8(sentence).ok()?).ok()?;
    let observed_ns = if boot == boot_id { observed_ns } else { 0 };
    let observation = Observation { person, source, epoch, sequence, observed_ns, observed_unix_ns, sentence };
    Some((observation, HEADER_BYTES + length))
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

    fn observation(sequence: u64) -> Observation {
        Observation {
            person: 3,
            source: 7,
            epoch: 1,
            sequence,
            observed_ns: 100 + sequence,
            observed_unix_ns: 5,
            sentence: Sentence::new(&format!("They do thing {sequence}.")).unwrap(),
        }
    }

    fn options(directory: &Path, bytes_max: u64) -> JournalOptions {
        JournalOptions { directory: directory.to_owned(), bytes_max, sync_ms: 1 }
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
            if run == 0 {
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
    fn writer(current: &Path, older: &Path, half_bytes: u64) -> Writer {
        Writer {
            file: open_file(current).unwrap(),
            current: current.to_owned(),
            older: older.to_owned(),
            length: 0,
            older_length: 0,
            open: open_file,
            unwritten: Vec::new(),
            unsynced: Vec::new(),
            synced: 0,
            sync_data: File::sync_data,
            last: BTreeMap::new(),
            half_bytes,
            sync_every: Duration::from_secs(1),
            progress: Arc::default(),
        }
    }

    /// The disk is full just when the last words of a quiet source are carried over: they come with what is written next.
    #[test]
    fn a_quiet_source_stays_known_when_the_disk_is_full_at_a_rotation() {
        let directory = tempfile::tempdir().unwrap();
        let (current, older) =
            (directory.path().join("narration.journal"), directory.path().join("narration.journal.old"));
        let boot = [0; 16];
        let mut writer = writer(&current, &older, 4096);
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
            // The next rotation opens a half that takes nothing, as on a full disk; room comes later.
            writer.open = |path| {
                open_file(path)?;
                OpenOptions::new().append(true).open("/dev/full")
            };
            while writer.write(&next()).is_ok() {}
            writer.write(&next()).unwrap_err();
            writer.file = open_file(&current).unwrap();
            writer.open = open_file;
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

    fn sequence_of(writer: &Writer) -> u64 {
        let mut recovered = Recovered::default();
        read_records(&writer.last[&7].0, &[0; 16], &mut recovered);
        recovered.observations[0].sequence
    }

    #[test]
    fn two_daemons_cannot_share_it() {
        let directory = tempfile::tempdir().unwrap();
        let options = options(directory.path(), 1 << 20);
        let _first = Journal::open(&options).unwrap();
        assert!(matches!(Journal::open(&options), Err(JournalError::Locked { .. })));
    }

    #[test]
    fn another_boots_monotonic_time_is_dropped() {
        let mut recovered = Recovered::default();
        read_records(&encode(&observation(1), &[1; 16]), &[2; 16], &mut recovered);
        assert_eq!(recovered.observations[0].observed_ns, 0);
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

    /// A rotation that fails after the new half was made loses nothing at the next one.
    #[test]
    fn a_rotation_that_fails_half_way_keeps_both_halves() {
        fn made_and_failed(path: &Path) -> io::Result<File> {
            open_file(path)?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        }
        let folder = tempfile::tempdir().unwrap();
        let current = folder.path().join("narration.journal");
        let older = folder.path().join("narration.journal.old");
        let mut writer = writer(&current, &older, 4096);
        let mut sequence = 0;
        let mut next = || {
            sequence += 1;
            encode(&observation(sequence), &[0; 16])
        };
        while !older.exists() {
            writer.write(&next()).unwrap();
        }
        let before = writer.last.len();
        writer.open = made_and_failed;
        while writer.write(&next()).is_ok() {}
        let full = fs::read(&older).unwrap();
        assert!(full.len() > 2048 && fs::read(&current).unwrap().is_empty());
        writer.open = open_file;
        writer.write(&next()).unwrap();
        assert_eq!(fs::read(&older).unwrap(), full);
        assert_eq!(writer.last.len(), before);
    }

    /// Row "fsync that fails once" of the attacks: what was written before it is lost with the power, if it is not written again.
    #[test]
    fn what_a_sync_fails_with_is_written_again() {
        /// Fails, and forgets all that it was given: the pages count as written.
        fn failing(file: &File) -> io::Result<()> {
            let length = usize::try_from(file.metadata()?.len()).unwrap_or_default();
            // The file appends, so it is overwritten through another descriptor.
            let lost = OpenOptions::new().write(true).open(format!("/proc/self/fd/{}", file.as_raw_fd()))?;
            lost.write_all_at(&vec![0; length], 0)?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        }
        let folder = tempfile::tempdir().unwrap();
        let current = folder.path().join("narration.journal");
        let older = folder.path().join("narration.journal.old");
        let mut writer = Writer { sync_data: failing, ..writer(&current, &older, 1 << 16) };
        for sequence in 1..=3 {
            writer.write(&encode(&observation(sequence), &[7; 16])).unwrap();
        }
        assert!(writer.sync().is_err());
        writer.sync_data = File::sync_data;
        writer.write(&encode(&observation(4), &[7; 16])).unwrap();
        writer.sync().unwrap();
        let mut recovered = Recovered::default();
        read_records(&fs::read(&current).unwrap(), &[7; 16], &mut recovered);
        let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        assert_eq!((sequences, recovered.damaged_bytes), (vec![1, 2, 3, 4], 0));
    }
}
