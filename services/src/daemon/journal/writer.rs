//! The writer of records, to a database on a disk that may fail.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use roomcast_database::rusqlite::{Error, ErrorCode};
use roomcast_database::{Database, DatabaseError, Transaction, count_sync, is_damage};

use roomcast_core::ids::PersonId;
use sd_notify::NotifyState;

use super::forget::{self, IsTheirs};
use super::learned::HabitRows;
use super::record::{KeptPerson, Record};
use super::recovered::Recovered;
use super::{Progress, old, store};
use crate::daemon::habits::Memory;
use crate::daemon::map_change::KeptMap;
use crate::notify::notify;

/// Silence before a sync.
const QUIET_BEFORE_SYNC: Duration = Duration::from_millis(100);
/// A note: the files of an earlier version were read.
const OLD_FILES_READ: &str = "read_old_files";

/// The error inside.
fn inner(error: DatabaseError) -> Error {
    match error {
        DatabaseError::Sqlite(_, source) => source,
        error => refused(error),
    }
}

fn is_full(error: &Error) -> bool {
    error.sqlite_error_code() == Some(ErrorCode::DiskFull)
}

fn refused(error: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::ToSqlConversionFailure(Box::new(error))
}

/// When the next sync is due. Writes wait for a sync, and scores wait for their writes, so a sync waits for silence. It is never later than promised, and
/// unless the promise asks for it, not sooner after the last one.
#[derive(Debug)]
pub(super) struct SyncDue {
    every: Duration,
    synced: Instant,
    /// Times of the first and the last write since; `None` after a sync.
    written: Option<(Instant, Instant)>,
}

impl SyncDue {
    /// The commits of a killed process need a sync, too.
    pub(super) fn new(every: Duration, now: Instant) -> Self {
        Self { every, synced: now, written: Some((now, now)) }
    }

    pub(super) fn wrote(&mut self, now: Instant) {
        let first = self.written.map_or(now, |(first, _)| first);
        self.written = Some((first, now));
    }

    /// After a failure the sync is due again.
    pub(super) fn synced(&mut self, done: bool, now: Instant) {
        self.synced = now;
        self.written = (!done).then_some((now, now));
    }

    pub(super) fn at(&self) -> Option<Instant> {
        let (first, last) = self.written?;
        Some((last + QUIET_BEFORE_SYNC).max(self.synced + self.every).min(first + self.every))
    }
}

/// Records since the last sync with their numbers, in bounded memory. The system takes for written what a sync has failed with, so they are written
/// again then.
#[derive(Debug, Default)]
struct Queue {
    records: VecDeque<(i64, Record)>,
    bytes: u64,
    /// The first ones are committed. The disk refused the others, which are tried again: a full disk may have room again.
    written: usize,
}

impl Queue {
    fn push(&mut self, number: i64, record: Record, bytes_max: u64) {
        self.bytes += record.bytes();
        self.records.push_back((number, record));
        while self.bytes > bytes_max
            && let Some((_, dropped)) = self.records.pop_front()
        {
            (self.bytes, self.written) = (self.bytes - dropped.bytes(), self.written.saturating_sub(1));
        }
    }

    fn unwritten(&self) -> impl Iterator<Item = &(i64, Record)> {
        self.records.iter().skip(self.written)
    }
}

/// The writer of the database; the journal's thread has one.
#[derive(Debug)]
pub struct Writer {
    database: Database,
    /// The state directory, for the files of earlier versions; none on a simulated disk.
    directory: Option<PathBuf>,
    /// The number of the last record.
    number: i64,
    /// About how many bytes the events have at most.
    bytes: u64,
    bytes_max: u64,
    boot_id: [u8; 16],
    queue: Queue,
    /// A sync has failed, and its records are not written again yet. Until then a sync that succeeds proves nothing.
    pub lacks_pages: bool,
    /// Deleted data is still in file or log: another program reads the database, or the disk has refused.
    is_to_erase: bool,
    /// Events that were deleted because there were too many.
    pub trimmed: usize,
    /// The habits in the database; `None` if they were never written.
    habits: Option<HabitRows>,
    /// The persons in the database.
    persons: Vec<KeptPerson>,
    /// The changed map in the database.
    map: Option<KeptMap>,
    pub(super) progress: Arc<Progress>,
}

impl Writer {
    /// Reads the database, and goes on with it. Its events may have `bytes_max`; `boot_id` names the machine's start of now. The
    /// files of earlier versions in `directory` are read once.
    ///
    /// # Errors
    /// When the database cannot be read; rows that are damaged are no error.
    pub fn open(
        database: Database,
        directory: Option<PathBuf>,
        bytes_max: u64,
        boot_id: &[u8; 16],
    ) -> Result<(Self, Recovered), Error> {
        let progress = Arc::new(Progress::default());
        let mut writer = Self {
            database,
            directory,
            number: 0,
            bytes: 0,
            bytes_max,
            boot_id: *boot_id,
            queue: Queue::default(),
            lacks_pages: false,
            is_to_erase: false,
            trimmed: 0,
            habits: None,
            persons: Vec::new(),
            map: None,
            progress,
        };
        let recovered = match writer.start() {
            Err(error) if is_damage(&error) => {
                writer.database.start_anew(&error).map_err(inner)?;
                writer.start()?
            }
            started => started?,
        };
        writer.tell_bytes();
        let damaged = writer.tell_set_aside();
        writer.progress.failures.store(damaged, Ordering::Relaxed);
        Ok((writer, recovered))
    }

    fn start(&mut self) -> Result<Recovered, Error> {
        self.begin()?;
        self.import()?;
        match self.database.write_synced(count_sync) {
            // A failed sync loses pages that a killed daemon has left. What is read after it is on the disk.
            Err(error) if !is_damage(&error) => {
                self.recover_from(&error);
                if self.lacks_pages {
                    self.reopen()?;
                }
            }
            synced => synced?,
        }
        self.is_to_erase = self.database.write(|transaction| store::has_note(transaction, store::TO_ERASE))?;
        let recovered = self.recover()?;
        self.habits.clone_from(&recovered.habits);
        self.persons.clone_from(&recovered.persons);
        self.map.clone_from(&recovered.map);
        Ok(recovered)
    }

    /// The content for a daemon that starts now.
    ///
    /// # Errors
    /// When the database cannot be read.
    pub fn recover(&mut self) -> Result<Recovered, Error> {
        self.database.write(store::recover)
    }

    fn begin(&mut self) -> Result<(), Error> {
        let boot_id = self.boot_id;
        let number = self.database.write(|transaction| {
            store::begin_boot(transaction, &boot_id)?;
            store::last_number(transaction)
        })?;
        // The next sync counts the bytes.
        (self.number, self.bytes) = (self.number.max(number), self.bytes_max.saturating_add(1));
        Ok(())
    }

    /// Reads the journal of earlier versions, once.
    fn import(&mut self) -> Result<(), Error> {
        let Some(directory) = &self.directory else { return Ok(()) };
        if self.database.write(|transaction| store::has_note(transaction, OLD_FILES_READ))? {
            return Ok(());
        }
        // A database that lost the mark, or was lost, had newer events and names than the old files.
        let is_new = self.number == 0 && self.database.set_aside().next().is_none();
        let records = if is_new { old::read(directory, self.bytes_max, &self.boot_id) } else { Vec::new() };
        let persons = if is_new { old::persons(directory) } else { Vec::new() };
        let map = is_new.then(|| old::changed_map(directory)).flatten();
        let (first, count) = (self.number + 1, records.len());
        self.database.write(|transaction| {
            let numbered = (first..).zip(&records);
            numbered.into_iter().try_for_each(|(number, record)| store::write(transaction, number, record))?;
            if !persons.is_empty() {
                store::write_persons(transaction, &persons)?;
            }
            if map.is_some() {
                store::write_map(transaction, map.as_ref())?;
            }
            store::note(transaction, OLD_FILES_READ)
        })?;
        if count > 0 {
            self.number += count as i64;
            tracing::info!(records = count, directory = %directory.display(), "the journal of an earlier version was read");
        }
        self.begin()
    }

    /// Writes the records that the disk refused before, then `batch`. Records that it refuses now stay in memory, as many as the database may hold.
    ///
    /// # Errors
    /// When the disk refuses, or is full.
    pub fn write(&mut self, batch: impl IntoIterator<Item = Record>) -> Result<(), Error> {
        for record in batch {
            self.number += 1;
            self.queue.push(self.number, record, self.bytes_max);
        }
        self.write_out(None).inspect_err(|error| self.recover_from(error))
    }

    /// Writes the records that are not written, and new habits, in one transaction.
    fn write_out(&mut self, new: Option<HabitRows>) -> Result<(), Error> {
        if !self.is_behind() && new.is_none() {
            return Ok(());
        }
        let is_again = self.lacks_pages;
        if is_again {
            self.reopen()?;
            self.queue.written = 0;
            // SQLite does not know any more which part of the log it has copied, and a full disk has no other space.
            self.database.make_room().or_else(|error| if is_full(&error) { Ok(()) } else { Err(error) })?;
        }
        let Self { database, queue, habits, persons, map, .. } = self;
        let known = habits.as_ref().filter(|habits| !habits.is_damaged());
        let before = known.filter(|_| !is_again);
        let rows = new.as_ref().or(known.filter(|_| is_again));
        database.write(|transaction| {
            queue.unwritten().try_for_each(|(number, record)| store::write(transaction, *number, record))?;
            if is_again {
                store::write_persons(transaction, persons)?;
                store::write_map(transaction, map.as_ref())?;
            }
            rows.map_or(Ok(()), |rows| rows.write(transaction, before))
        })?;
        *habits = new.or(habits.take());
        self.bytes = self.bytes.saturating_add(queue.unwritten().map(|(_, record)| record.bytes()).sum());
        (queue.written, self.lacks_pages) = (queue.records.len(), false);
        // A flood does not wait for the next sync.
        if self.bytes > self.bytes_max.saturating_add(self.bytes_max / 4) { self.trim() } else { Ok(()) }
    }

    /// Opens the database again: SQLite drops the damaged end of the log.
    fn reopen(&mut self) -> Result<(), Error> {
        self.database.reopen().map_err(inner)?;
        self.begin()
    }

    /// Deletes the oldest events if there are too many.
    fn trim(&mut self) -> Result<(), Error> {
        if self.bytes > self.bytes_max {
            let bytes_max = self.bytes_max;
            let (trimmed, bytes) = self.database.write(|transaction| store::trim(transaction, bytes_max))?;
            (self.trimmed, self.bytes) = (self.trimmed + trimmed, bytes);
        }
        Ok(())
    }

    /// After an error that says damage, the database is opened again with the next records. If the damage stays, a new database begins.
    fn recover_from(&mut self, error: &Error) {
        if self.lacks_pages && is_damage(error) {
            match self.database.start_anew(error) {
                Ok(()) => _ = self.tell_set_aside(),
                Err(error) => tracing::error!(%error, "the damaged state database cannot be set aside"),
            }
        }
        self.lacks_pages |= match error.sqlite_error_code() {
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => false,
            // Copying the log syncs.
            Some(ErrorCode::DiskFull) => self.database.make_room().is_err_and(|error| !is_full(&error)),
            // SQLite syncs in some writes, too, and a failed sync may have lost pages.
            _ => true,
        };
    }

    /// Brings all commits to the disk, and deletes the oldest events first if there are too many.
    ///
    /// # Errors
    /// When the disk refuses, or no name leads to the database any more.
    pub fn sync(&mut self) -> Result<(), Error> {
        self.synced(count_sync)
    }

    /// Runs work in a transaction that brings all commits to the disk.
    fn synced(&mut self, work: impl FnOnce(&Transaction<'_>) -> Result<(), Error>) -> Result<(), Error> {
        let synced = self.try_synced(work);
        self.progress.is_unsynced.store(synced.is_err(), Ordering::Relaxed);
        synced.inspect_err(|error| self.recover_from(error))
    }

    fn try_synced(&mut self, work: impl FnOnce(&Transaction<'_>) -> Result<(), Error>) -> Result<(), Error> {
        self.write_out(None)?;
        self.trim()?;
        self.database.write_synced(work)?;
        self.queue = Queue::default();
        self.tell_bytes();
        if self.is_to_erase {
            // The next sync tries again.
            let _erased = self.erase();
        }
        Ok(())
    }

    /// Takes a person out, with the events that `is_theirs` finds, and the files of earlier versions and damaged databases, which may hold them. Gives the
    /// number of their events.
    ///
    /// # Errors
    /// When the disk refuses, or another program reads the database. Each sync tries again to erase.
    pub(in crate::daemon) fn forget(&mut self, person: PersonId, is_theirs: &IsTheirs) -> Result<usize, Error> {
        self.write([])?;
        self.number += 1;
        let number = self.number;
        let forgotten = self.database.write(|transaction| {
            store::note(transaction, store::TO_ERASE)?;
            forget::forget(transaction, person, is_theirs, number)
        });
        let theirs = forgotten.inspect_err(|error| self.recover_from(error))?;
        if let Some(directory) = &self.directory {
            old::remove(directory, &old::EVENTS).map_err(refused)?;
        }
        // Also when nothing has changed: an earlier call may have failed before this.
        self.erase()?;
        Ok(theirs)
    }

    /// Writes the habits, with the records that the disk refused before.
    ///
    /// # Errors
    /// When the disk refuses.
    pub fn write_habits(&mut self, memory: &Memory) -> Result<(), Error> {
        let rows = HabitRows::of(memory).map_err(refused)?;
        self.write_out(Some(rows)).inspect_err(|error| self.recover_from(error))
    }

    /// Writes the habits that wait, if any. If the disk refuses, they wait again.
    pub(super) fn write_waiting_habits(&mut self) -> Result<(), Error> {
        let progress = Arc::clone(&self.progress);
        let waiting = || progress.habits.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(memory) = waiting().take() else { return Ok(()) };
        self.write_habits(&memory).inspect_err(|_| _ = waiting().get_or_insert(memory))
    }

    /// Writes the waiting habits after a person was forgotten: no byte of the old rows stays.
    ///
    /// # Errors
    /// When the disk refuses. The habits are written later.
    pub(in crate::daemon) fn forget_habits(&mut self) -> Result<(), Error> {
        let noted = self.database.write(|transaction| store::note(transaction, store::TO_ERASE));
        noted.inspect_err(|error| self.recover_from(error))?;
        self.write_waiting_habits()?;
        if let Some(directory) = &self.directory {
            old::remove(directory, &old::HABITS).map_err(refused)?;
        }
        self.erase()
    }

    /// Replaces the persons with a name that the home gave, on the disk.
    ///
    /// # Errors
    /// When the disk refuses; then the old ones stay.
    pub(in crate::daemon) fn write_persons(&mut self, persons: Vec<KeptPerson>) -> Result<(), Error> {
        self.synced(|transaction| store::write_persons(transaction, &persons))?;
        self.persons = persons;
        Ok(())
    }

    /// Replaces the changed map, on the disk.
    ///
    /// # Errors
    /// When the disk refuses; then the old one stays.
    pub(in crate::daemon) fn write_map(&mut self, map: KeptMap) -> Result<(), Error> {
        self.synced(|transaction| store::write_map(transaction, Some(&map)))?;
        self.map = Some(map);
        Ok(())
    }

    /// Removes all deleted data, also from the databases that were set aside.
    fn erase(&mut self) -> Result<(), Error> {
        self.is_to_erase = true;
        self.database.remove_set_aside().map_err(refused)?;
        self.tell_set_aside();
        let erased = self.database.erase().and_then(|()| self.database.write(store::remove_to_erase));
        erased.inspect_err(|error| self.recover_from(error))?;
        self.is_to_erase = false;
        // Nothing that a later sync loses was written before this.
        self.queue = Queue::default();
        self.tell_bytes();
        Ok(())
    }

    /// Whether there is work that the disk refused.
    pub(super) fn is_behind(&self) -> bool {
        self.queue.written < self.queue.records.len() || self.lacks_pages || self.is_to_erase
    }

    /// Runs a statement, for a test that plants a fault.
    #[doc(hidden)]
    pub fn plant(&mut self, statement: &str) {
        let _planted = self.database.connection().and_then(|connection| connection.execute_batch(statement));
    }

    /// Names the databases that were set aside, for `systemctl status` and the log. Gives their number.
    fn tell_set_aside(&self) -> u64 {
        let files: Vec<_> = self.database.set_aside().map(|file| file.display().to_string()).collect();
        let (count, files) = (files.len() as u64, files.join(", "));
        let status = if count > 0 { format!("set aside because of damage: {files}") } else { String::new() };
        notify(&[NotifyState::Status(&status)]);
        if count > 0 {
            tracing::warn!(
                files,
                "damaged state databases lie aside: events, names, habits and a changed map can be missing since then; remove the files when the cause is known"
            );
        }
        count
    }

    fn tell_bytes(&self) {
        self.progress.bytes.store(self.database.bytes(), Ordering::Relaxed);
    }

    /// Does some work, and reports when the disk refuses.
    pub(super) fn tries(&mut self, work: impl FnOnce(&mut Self) -> Result<(), Error>) -> bool {
        let Err(error) = work(self) else { return true };
        let failures = self.progress.failures.fetch_add(1, Ordering::Relaxed) + 1;
        if failures.is_power_of_two() {
            tracing::warn!(%error, failures, "the state database cannot be written; the history in memory is complete");
        }
        false
    }
}
