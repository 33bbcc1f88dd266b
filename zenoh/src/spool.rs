//! The hub's queue: events that not all robots have confirmed, in memory and in an SQLite database.
//!
//! An event is on the disk before it is sent. Events up to a damaged row are dropped, and later numbers continue after it, so that no number is used
//! twice. If the end of the queue is lost, the robots know its last number ([`Spool::number_on`]). If nothing can be read, the epoch is a new one,
//! and a followed input is read from its end, so that the robots get no event twice. Only the owner can read folder and files, because events are
//! private.

use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use roomcast_database::rusqlite::{self, OptionalExtension, Row, params};
use roomcast_database::{Database, DatabaseError, Schema, Transaction, is_damage};
use roomcast_ipc::own_file::require_own;
use roomcast_ipc::{clock, sequence};
use rustix::fs::OFlags;
use serde::{Deserialize, Serialize};

use crate::delay::clock_id;
use crate::wire::{Hex, Kind, Observation, Who, is_zero};

/// The database in its folder.
pub const FILE: &str = "narration.db";
/// The queue of version 0.1.0, which is read once.
const OLD_FILE: &str = "narration";
const SCHEMA: Schema = Schema {
    application: 0x524d_4348,
    migrations: &["-- A single row. `last` is the last number that was given; `confirmed` is 0 in a queue of version 0.1.0.
        CREATE TABLE head (id INTEGER PRIMARY KEY CHECK (id = 1), epoch INTEGER NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL,
            confirmed INTEGER NOT NULL, input TEXT, checksum INTEGER NOT NULL) STRICT;
        -- The content is JSON; the checksum is the CRC-32 of the other columns.
        CREATE TABLE narration (sequence INTEGER PRIMARY KEY, epoch INTEGER NOT NULL, content TEXT NOT NULL, checksum INTEGER NOT NULL) STRICT;"],
};
/// Longest line of the old file, in bytes.
const LINE_BYTES_MAX: u64 = 16 << 10;
/// Confirmations are written after so many events, or so long after the last write.
const NOTE_EACH: u64 = 64;
const NOTE_NS: u64 = 1_000_000_000;

/// Most numbers that one start skips because a robot reports them as used.
pub const TAKEN_MAX: u64 = 1024;

/// An error of the queue.
pub type SpoolError = DatabaseError;

/// The folder cannot be a spool: another start would fail like this one.
#[must_use]
pub fn is_of_configuration(error: &SpoolError) -> bool {
    match error {
        DatabaseError::Refused { .. } | DatabaseError::Newer { .. } => true,
        DatabaseError::File(_, _, source) => matches!(
            source.kind(),
            io::ErrorKind::NotFound
                | io::ErrorKind::AlreadyExists
                | io::ErrorKind::NotADirectory
                | io::ErrorKind::PermissionDenied
                | io::ErrorKind::ReadOnlyFilesystem
                | io::ErrorKind::InvalidInput
        ),
        _ => false,
    }
}

/// A place in the input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The file's number in its file system; 0 if the input is no file.
    pub file: u64,
    /// Bytes that were read.
    pub at: u64,
    /// A checksum of the bytes before that, which identifies the file; `None` in a spool of version 0.1.0.
    #[serde(default)]
    pub before: Option<u32>,
}

/// The state of the queue.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Head {
    epoch: Hex,
    /// The first stored number.
    first: u64,
    /// All robots have confirmed up to here; numbers between that and `first` were given up.
    #[serde(default)]
    confirmed: u64,
    /// How far the input was read; `None` if that is unknown.
    input: Option<Place>,
}

impl Head {
    fn new(input: Option<Place>) -> Self {
        Self { epoch: Hex(sequence::random_epoch()), first: 1, confirmed: 0, input }
    }
}

/// A line of the old file.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Entry {
    Head(Head),
    Kept {
        epoch: Hex,
        #[serde(flatten)]
        kept: Kept,
    },
}

/// An event of the queue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    /// Its number; 0 before it is stored.
    pub sequence: u64,
    /// The clock of `observed_ns`; 0 before it is stored.
    clock: Hex,
    observed_ns: u64,
    observed_unix_ns: u64,
    /// Time by which the input's clock was ahead.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub ahead_ns: u64,
    /// How far the input was read with it; `None` if that is unknown.
    input: Option<Place>,
    /// The observation.
    #[serde(flatten)]
    pub observation: Observation,
}

impl Kept {
    /// An observation of `age_ns` ago; `input` is the place behind it, if the input has places.
    #[must_use]
    pub fn new(observation: Observation, age_ns: u64, input: Option<Place>) -> Self {
        let observed_ns = clock::monotonic_ns().saturating_sub(age_ns);
        let observed_unix_ns = clock::unix_ns().saturating_sub(age_ns);
        Self { sequence: 0, clock: Hex(0), observed_ns, observed_unix_ns, ahead_ns: 0, input, observation }
    }

    /// The input's clock was ahead by this time.
    #[must_use]
    pub fn with_ahead(self, ahead_ns: u64) -> Self {
        Self { ahead_ns, ..self }
    }
}

/// The queue.
#[derive(Debug)]
pub struct Spool {
    database: Database,
    head: Head,
    clock: Hex,
    kept: VecDeque<Kept>,
    keep: usize,
    /// The first stored number in the database, and the time of that write.
    noted: (u64, u64),
    /// A write has failed and may have lost earlier ones: the next one writes all events again.
    has_failed: bool,
    /// Numbers that this start has skipped.
    taken: u64,
}

impl Spool {
    /// Opens the queue in a folder, which is created if missing, with its stored events. More than `keep` of them stay until [`Self::trim`], so that
    /// the hub counts the dropped ones.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] for a folder that cannot be used, or that another hub uses.
    pub fn open(folder: &Path, keep: usize) -> Result<Self, SpoolError> {
        let path = folder.join(FILE);
        let failed = |operation| {
            let path = path.clone();
            move |source| SpoolError::File(path, operation, source)
        };
        // A link, also one to a missing file, is refused below.
        if fs::symlink_metadata(&path).is_err() {
            begin(&path, read_old(folder).map_err(failed("read the queue of an earlier version before"))?)?;
        }
        let mut database = Database::open(&path, SCHEMA)?;
        let failed_sqlite = |source| SpoolError::Sqlite(path.clone(), source);
        let found = match read(&database) {
            Err(error) if is_damage(&error) => {
                database.start_anew(&error)?;
                read(&database)
            }
            found => found,
        };
        let Found { head, kept, given_up } = found.map_err(failed_sqlite)?;
        let path = path.display();
        if given_up > 0 {
            tracing::error!(%path, given_up, "the spool is damaged: narrations before the damage are given up; is the disk failing?");
        }
        let head = head.unwrap_or_else(|| {
            tracing::error!(
                %path,
                "the spool cannot be read: its narrations are given up, and a followed input is read from its end; is the disk failing, or was the spool emptied?"
            );
            Head::new(None)
        });
        let (clock, noted) = (Hex(clock_id()), (head.first, clock::monotonic_ns()));
        let mut spool = Self { database, head, clock, kept, keep, noted, has_failed: true, taken: 0 };
        spool.write(0, true)?;
        Ok(spool)
    }

    /// The narrator's epoch.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.head.epoch.0
    }

    /// The first stored number.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.head.first
    }

    /// The last used number; one less than `first` if the queue is empty.
    #[must_use]
    pub fn last(&self) -> u64 {
        self.head.first + self.kept.len() as u64 - 1
    }

    /// All robots have confirmed up to this number, as far as the database knows.
    #[must_use]
    pub fn confirmed(&self) -> u64 {
        self.head.confirmed
    }

    /// How far the input was read; `None` if that is unknown.
    #[must_use]
    pub fn input(&self) -> Option<Place> {
        self.kept.back().map_or(self.head.input, |kept| kept.input)
    }

    /// The narration of a number.
    #[must_use]
    pub fn get(&self, sequence: u64) -> Option<&Kept> {
        let place = sequence.checked_sub(self.head.first)?;
        self.kept.get(usize::try_from(place).ok()?)
    }

    /// The age. The wall clock gives it for an event from before the machine's last start, and for one without a monotonic time.
    #[must_use]
    pub fn age_ns(&self, kept: &Kept) -> u64 {
        if kept.clock == self.clock && kept.observed_ns > 0 {
            clock::monotonic_ns().saturating_sub(kept.observed_ns)
        } else {
            clock::unix_ns().saturating_sub(kept.observed_unix_ns)
        }
    }

    /// Skips numbers if a robot reports `next` as the next one: the disk has lost them, and a new event must not reuse them. Empty events take these
    /// numbers; a robot without them ignores empty events. Returns the number of skipped ones, or `None` if there are too many for a loss.
    ///
    /// # Errors
    ///
    /// [`SpoolError`]; then no number is skipped.
    pub fn number_on(&mut self, next: u64) -> Result<Option<u64>, SpoolError> {
        let count = next.saturating_sub(self.last() + 1);
        if count > TAKEN_MAX - self.taken {
            return Ok(None);
        }
        if count > 0 {
            let nothing = Observation { text: String::new(), kind: Kind::Sentence, person: Who::Somebody, count: 0 };
            let nothing = Kept::new(nothing, 0, self.input());
            self.append((0..count).map(|_| nothing.clone()).collect())?;
            self.taken += count;
        }
        Ok(Some(count))
    }

    /// Stores events. They are on the disk when this returns.
    ///
    /// # Errors
    ///
    /// [`SpoolError`]; then none of them is stored.
    pub fn append(&mut self, events: Vec<Kept>) -> Result<(), SpoolError> {
        let (first, clock, old) = (self.last() + 1, self.clock, self.kept.len());
        self.kept.extend((first..).zip(events).map(|(sequence, event)| Kept { sequence, clock, ..event }));
        let written = self.write(old, true);
        if written.is_err() {
            self.kept.truncate(old);
        }
        self.trim();
        written
    }

    /// Writes the events after the `old` ones and the head, and deletes the confirmed events, in one transaction; syncs on request. After a failure all
    /// events are written again.
    fn write(&mut self, old: usize, sync: bool) -> Result<(), SpoolError> {
        let Self { database, head, kept, has_failed, .. } = self;
        let last = head.first + kept.len() as u64 - 1;
        let all = std::mem::replace(has_failed, true);
        if all {
            database.reopen()?;
        }
        let write = |transaction: &Transaction<'_>| {
            let (old, first) = if all { (0, i64::MAX) } else { (old, head.first.cast_signed()) };
            transaction.prepare_cached("DELETE FROM narration WHERE sequence < ?1")?.execute([first])?;
            kept.range(old..).try_for_each(|kept| insert(transaction, head.epoch, kept))?;
            write_head(transaction, head, last)
        };
        let written = if sync { database.write_synced(write) } else { database.write(write) };
        written.map_err(|source| SpoolError::Sqlite(database.path().to_owned(), source))?;
        self.has_failed = false;
        self.noted = (self.head.first, clock::monotonic_ns());
        Ok(())
    }

    /// Drops all but the newest `keep` events.
    pub fn trim(&mut self) {
        let over = self.kept.len().saturating_sub(self.keep);
        self.forget(over);
    }

    /// Removes the events up to and including a number, which all robots have confirmed. The disk is updated now and then: after a kill the hub sends
    /// some of them again, and the robots ignore them.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] when the disk refuses; the next call tries again.
    pub fn confirm(&mut self, sequence: u64) -> Result<(), SpoolError> {
        let over = (sequence.min(self.last()) + 1).saturating_sub(self.head.first);
        if over > 0 {
            self.forget(usize::try_from(over).unwrap_or(usize::MAX));
            self.head.confirmed = self.head.first - 1;
        }
        let (now_ns, (first, at_ns)) = (clock::monotonic_ns(), self.noted);
        let new = self.head.first.saturating_sub(first);
        if new >= NOTE_EACH || (new > 0 && now_ns.saturating_sub(at_ns) >= NOTE_NS) {
            self.noted.1 = now_ns;
            self.write(self.kept.len(), false)?;
        }
        Ok(())
    }

    fn forget(&mut self, count: usize) {
        for kept in self.kept.drain(..count.min(self.kept.len())) {
            (self.head.first, self.head.input) = (kept.sequence + 1, kept.input);
        }
    }
}

/// Makes the database with the queue of an earlier version, if there is one. It gets its name when it is complete, so that a hub that is killed
/// before begins again.
fn begin(path: &Path, old: Option<Found>) -> Result<(), SpoolError> {
    let found = old.unwrap_or_else(|| Found { head: Some(Head::new(Some(Place::default()))), ..Found::default() });
    let unfinished = path.with_extension("new");
    let mut database = Database::open(&unfinished, SCHEMA)?;
    let written = database.write(|transaction| {
        transaction.execute_batch("DELETE FROM head; DELETE FROM narration")?;
        let Some(head) = &found.head else { return Ok(()) };
        found.kept.iter().try_for_each(|kept| insert(transaction, head.epoch, kept))?;
        write_head(transaction, head, head.first + found.kept.len() as u64 - 1)
    });
    let erased = written.and_then(|()| database.erase());
    erased.map_err(|source| SpoolError::Sqlite(unfinished.clone(), source))?;
    drop(database);
    if found.given_up > 0 {
        tracing::error!(
            given_up = found.given_up,
            "the queue of an earlier version is damaged: narrations before the damage are given up"
        );
    }
    // SQLite would read a log that a removed database has left.
    for extension in ["new-wal", "new-shm", "db-wal", "db-shm"] {
        let _removed = fs::remove_file(path.with_extension(extension));
    }
    let named = fs::rename(&unfinished, path);
    named.map_err(|source| SpoolError::File(unfinished, "rename", source))
}

fn insert(transaction: &Transaction<'_>, epoch: Hex, kept: &Kept) -> rusqlite::Result<()> {
    let content = serde_json::to_string(kept).map_err(|error| rusqlite::Error::ToSqlConversionFailure(error.into()))?;
    let (sequence, epoch) = (kept.sequence.cast_signed(), epoch.0.cast_signed());
    let checksum = checksum(&(sequence, epoch, &content));
    let mut insert = transaction.prepare_cached("INSERT OR REPLACE INTO narration VALUES (?1, ?2, ?3, ?4)")?;
    insert.execute(params![sequence, epoch, content, checksum]).map(|_| ())
}

fn write_head(transaction: &Transaction<'_>, head: &Head, last: u64) -> rusqlite::Result<()> {
    let input = head.input.and_then(|input| serde_json::to_string(&input).ok());
    let numbers = [head.epoch.0, head.first, last, head.confirmed].map(u64::cast_signed);
    let [epoch, first, last, confirmed] = numbers;
    let checksum = checksum(&(numbers, &input));
    let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO head VALUES (1, ?1, ?2, ?3, ?4, ?5, ?6)")?;
    write.execute(params![epoch, first, last, confirmed, input, checksum]).map(|_| ())
}

fn checksum(columns: &impl std::fmt::Debug) -> u32 {
    crc32fast::hash(format!("{columns:?}").as_bytes())
}

/// The content of a queue.
#[derive(Debug, Default)]
struct Found {
    /// `None` if nothing of it can be read.
    head: Option<Head>,
    kept: VecDeque<Kept>,
    /// Events before the damage.
    given_up: u64,
}

impl Found {
    /// Adds an event of an epoch. Events before a gap are dropped.
    fn push(&mut self, epoch: Hex, kept: Kept) {
        let head = self.head.get_or_insert(Head { epoch, first: kept.sequence, confirmed: 0, input: None });
        let next = head.first + self.kept.len() as u64;
        if head.epoch != epoch || kept.sequence < next {
            return;
        }
        if kept.sequence > next {
            self.given_up += kept.sequence - head.first;
            self.kept.clear();
            head.first = kept.sequence;
        }
        head.input = head.input.or(kept.input);
        self.kept.push_back(kept);
    }

    /// Takes a later line's state of the queue.
    fn go_on(&mut self, later: Head) {
        let head = self.head.get_or_insert(later);
        if later.epoch == head.epoch && later.first >= head.first {
            while self.kept.front().is_some_and(|kept| kept.sequence < later.first) {
                self.kept.pop_front();
            }
            *head = later;
        }
    }
}

fn is_sane(epoch: Hex, first: u64) -> bool {
    epoch.0 != 0 && (1..u64::MAX / 2).contains(&first)
}

fn read(database: &Database) -> rusqlite::Result<Found> {
    let connection = database.connection()?;
    let mut found = Found::default();
    let head = |row: &Row<'_>| {
        let numbers: [i64; 4] = [row.get(1)?, row.get(2)?, row.get(3)?, row.get(4)?];
        // Invalid text fails the checksum.
        let input: Option<String> = row.get(5).unwrap_or_default();
        let is_whole = row.get::<_, i64>(6)? == i64::from(checksum(&(numbers, &input)));
        let [epoch, first, last, confirmed] = numbers.map(i64::cast_unsigned);
        let input = input.and_then(|input| serde_json::from_str(&input).ok());
        Ok(is_whole.then_some((Head { epoch: Hex(epoch), first, confirmed, input }, last)))
    };
    let head = connection.query_row("SELECT * FROM head", [], head).optional()?.flatten();
    found.head = head.map(|(head, _)| head);
    let mut query = connection.prepare("SELECT * FROM narration ORDER BY sequence")?;
    let mut rows = query.query([])?;
    while let Some(row) = rows.next()? {
        let (sequence, epoch): (i64, i64) = (row.get(0)?, row.get(1)?);
        let Ok(content) = row.get::<_, String>(2) else { continue };
        let is_whole = row.get::<_, i64>(3)? == i64::from(checksum(&(sequence, epoch, &content)));
        let epoch = Hex(epoch.cast_unsigned());
        if let Some(kept) = serde_json::from_str::<Kept>(&content).ok().filter(|_| is_whole)
            && is_sane(epoch, kept.sequence)
        {
            found.push(epoch, kept);
        }
    }
    // The head has the numbers of a lost end.
    if let (Some((_, last)), Some(head)) = (head, &mut found.head)
        && last >= head.first + found.kept.len() as u64
    {
        found.given_up += last + 1 - head.first;
        found.kept.clear();
        head.first = last + 1;
    }
    Ok(found)
}

/// The queue of version 0.1.0: each line is a checksum and JSON. `None` without a file.
fn read_old(folder: &Path) -> io::Result<Option<Found>> {
    const DIGITS: usize = 8;
    let path = folder.join(OLD_FILE);
    require_own(&path)?;
    let mut file = match open_plain(OpenOptions::new().read(true), &path) {
        Ok(file) => BufReader::new(file),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    let entry = |line: &[u8]| -> Option<Entry> {
        let (digits, json) = line.strip_suffix(b"\n")?.split_at_checked(DIGITS)?;
        let checksum = u32::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
        let json = json.strip_prefix(b" ")?;
        (crc32fast::hash(json) == checksum).then(|| serde_json::from_slice(json).ok())?
    };
    let (mut line, mut found) = (Vec::new(), Found::default());
    loop {
        line.clear();
        if io::Read::take(&mut file, LINE_BYTES_MAX).read_until(b'\n', &mut line)? == 0 {
            return Ok(Some(found));
        }
        match entry(&line) {
            Some(Entry::Head(head)) if is_sane(head.epoch, head.first) => found.go_on(head),
            Some(Entry::Kept { epoch, kept }) if is_sane(epoch, kept.sequence) => found.push(epoch, kept),
            _ => {}
        }
    }
}

/// Opens a regular file. Opening a FIFO would wait for its other end and ignore signals.
pub(crate) fn open_plain(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    // With this flag the system refuses a FIFO without a reader at once.
    let file = options.custom_flags(OFlags::NONBLOCK.bits().cast_signed()).open(path);
    let is_other = match &file {
        Ok(file) => !file.metadata()?.is_file(),
        Err(_) => fs::metadata(path).is_ok_and(|about| !about.is_file()),
    };
    if is_other {
        let fault = format!("{} is no plain file: remove it", path.display());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, fault));
    }
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observation(text: &str) -> Observation {
        Observation { text: text.to_owned(), kind: Kind::Sentence, person: Who::Somebody, count: 0 }
    }

    fn append(spool: &mut Spool, count: u64) {
        for _ in 0..count {
            let mut input = spool.input().unwrap_or_default();
            input.at += 10;
            spool.append(vec![Kept::new(observation("They sit."), 7, Some(input))]).unwrap();
        }
    }

    fn open(folder: &Path) -> Spool {
        Spool::open(folder, 1000).unwrap()
    }

    fn place(spool: &Spool) -> (u64, u64, Option<u64>) {
        (spool.first(), spool.last(), spool.input().map(|place| place.at))
    }

    #[test]
    fn a_killed_hub_goes_on_with_its_queue() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = open(folder.path());
        assert_eq!(place(&spool), (1, 0, Some(0)));
        append(&mut spool, 200);
        let epoch = spool.epoch();
        let in_use = Spool::open(folder.path(), 100).unwrap_err();
        assert!(in_use.to_string().contains("another process uses it") && !is_of_configuration(&in_use), "{in_use}");
        spool.confirm(150).unwrap();
        // Confirmations are written now and then.
        spool.confirm(160).unwrap();
        assert!(spool.get(160).is_none() && spool.get(161).unwrap().sequence == 161 && spool.get(201).is_none());
        drop(spool);
        let mut spool = open(folder.path());
        assert_eq!((spool.epoch(), spool.confirmed(), place(&spool)), (epoch, 150, (151, 200, Some(2000))));
        append(&mut spool, 1);
        spool.confirm(u64::MAX).unwrap();
        drop(spool);
        let spool = open(folder.path());
        assert_eq!((spool.epoch(), spool.last(), spool.input().unwrap().at), (epoch, 201, 2010));
    }

    #[test]
    fn numbers_go_on_behind_damaged_rows() {
        for (damage, expected) in [
            (
                "UPDATE narration SET content = replace(content, 'sit', 'lie') WHERE sequence = 3",
                (true, 4, 6, Some(60)),
            ),
            ("DELETE FROM narration WHERE sequence = 3", (true, 4, 6, Some(60))),
            ("DELETE FROM narration WHERE sequence = 6", (true, 7, 6, Some(0))),
            ("UPDATE head SET confirmed = 2", (true, 1, 6, Some(60))),
            ("DELETE FROM head", (true, 1, 6, Some(60))),
            ("DELETE FROM head; DELETE FROM narration", (false, 1, 0, None)),
        ] {
            let folder = tempfile::tempdir().unwrap();
            let mut spool = open(folder.path());
            append(&mut spool, 6);
            let epoch = spool.epoch();
            spool.database.connection().unwrap().execute_batch(damage).unwrap();
            drop(spool);
            let spool = open(folder.path());
            let (first, last, at) = place(&spool);
            assert_eq!((spool.epoch() == epoch, first, last, at), expected, "{damage}");
        }
    }

    #[test]
    fn an_emptied_or_damaged_queue_starts_at_the_end_of_the_input() {
        for content in [&b""[..], b"nonsense"] {
            let folder = tempfile::tempdir().unwrap();
            append(&mut open(folder.path()), 3);
            for suffix in ["-wal", "-shm"] {
                fs::remove_file(folder.path().join(format!("{FILE}{suffix}"))).unwrap();
            }
            fs::write(folder.path().join(FILE), content).unwrap();
            let mut spool = open(folder.path());
            assert_eq!(spool.number_on(4).unwrap(), Some(3));
            drop(spool);
            assert_eq!(place(&open(folder.path())), (1, 3, None));
        }
    }

    #[test]
    fn a_failed_write_is_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = open(folder.path());
        append(&mut spool, 5);
        let other = rusqlite::Connection::open(folder.path().join(FILE)).unwrap();
        other.execute_batch("BEGIN IMMEDIATE").unwrap();
        spool.append(vec![Kept::new(observation("They sit."), 0, None)]).unwrap_err();
        assert_eq!(spool.last(), 5, "a narration that is not on the disk is not kept");
        other.execute_batch("ROLLBACK").unwrap();
        append(&mut spool, 1);
        drop(spool);
        assert_eq!(place(&open(folder.path())), (1, 6, Some(60)));
    }

    #[test]
    fn narrations_that_wait_for_the_disk_keep_their_age() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = open(folder.path());
        let dated = Kept::new(observation("They sit."), 7, None);
        // Time of the real clock passes for it.
        std::thread::sleep(std::time::Duration::from_millis(5));
        spool.append(vec![dated]).unwrap();
        assert!(spool.age_ns(spool.get(1).unwrap()) >= 5_000_007);
    }

    #[test]
    fn numbers_that_a_robot_has_are_not_given_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100_000).unwrap();
        append(&mut spool, 5);
        assert_eq!(spool.number_on(4).unwrap(), Some(0));
        // The disk has lost 6 to 9.
        assert_eq!(spool.number_on(10).unwrap(), Some(4));
        append(&mut spool, 1);
        let nothing = spool.get(9).unwrap().observation.clone();
        assert_eq!((spool.last(), spool.input().unwrap().at), (10, 60));
        nothing.message().unwrap_err();
        spool.get(10).unwrap().observation.message().unwrap();
        // An arbitrary number from a robot does not fill the spool.
        assert_eq!(spool.number_on(u64::MAX).unwrap(), None);
        assert_eq!(spool.number_on(11 + TAKEN_MAX - 4).unwrap(), Some(TAKEN_MAX - 4));
        assert_eq!(spool.number_on(spool.last() + 2).unwrap(), None);
        let last = spool.last();
        drop(spool);
        assert_eq!(open(folder.path()).last(), last);
    }

    #[test]
    fn events_from_before_the_machines_start_keep_their_age() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = open(folder.path());
        let hour_ns = 3_600_000_000_000;
        let ages = [0, 60_000_000_000, clock::monotonic_ns() + hour_ns, clock::monotonic_ns() + 72 * hour_ns];
        spool.append(ages.map(|age_ns| Kept::new(observation("They sit."), age_ns, None)).into()).unwrap();
        for (number, age_ns) in (1..).zip(ages) {
            let since_ns = spool.age_ns(spool.get(number).unwrap()).saturating_sub(age_ns);
            assert!(since_ns < 60_000_000_000, "{age_ns}: {since_ns}");
        }
    }

    #[test]
    fn given_up_narrations_are_not_confirmed_after_a_start() {
        let folder = tempfile::tempdir().unwrap();
        let open = |keep| {
            let spool = Spool::open(folder.path(), keep).unwrap();
            (spool.first(), spool.last(), spool.confirmed(), spool)
        };
        let (.., mut spool) = open(1000);
        append(&mut spool, 300);
        spool.confirm(64).unwrap();
        drop(spool);
        let (first, last, confirmed, mut spool) = open(100);
        assert_eq!((first, last, confirmed), (65, 300, 64), "the hub counts those that go from here");
        spool.trim();
        assert_eq!((spool.first(), spool.confirmed()), (201, 64));
        append(&mut spool, 1);
        drop(spool);
        let (.., confirmed, mut spool) = open(1000);
        assert_eq!(confirmed, 64);
        spool.trim();
        spool.confirm(290).unwrap();
        assert_eq!((spool.first(), spool.confirmed()), (291, 290));
    }

    #[test]
    fn a_folder_that_can_be_no_spool_is_a_fault_of_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        for path in [&file, &file.join("spool"), Path::new("/proc/spool")] {
            let error = Spool::open(path, 100).unwrap_err();
            assert!(is_of_configuration(&error), "{error}");
        }
        for target in ["/dev/zero", "missing"] {
            std::os::unix::fs::symlink(target, folder.path().join(FILE)).unwrap();
            let error = Spool::open(folder.path(), 10).unwrap_err();
            assert!(is_of_configuration(&error) && error.to_string().contains("symbolic link"), "{error}");
            fs::remove_file(folder.path().join(FILE)).unwrap();
        }
    }

    #[test]
    fn narration_is_its_owners_alone() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("hub");
        let _spool = open(&path);
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!([path.clone(), path.join(FILE)].map(|path| mode(&path)), [0o700, 0o600]);
    }

    #[test]
    fn the_queue_is_bounded_in_memory_and_on_disk() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        append(&mut spool, 130);
        assert_eq!((spool.first(), spool.last()), (31, 130));
        for _ in 0..50 {
            let dated = || Kept::new(observation("They sit."), 0, None);
            spool.append((0..100).map(|_| dated()).collect()).unwrap();
            spool.confirm(spool.last()).unwrap();
        }
        assert_eq!((spool.first(), spool.last()), (5131, 5130));
        assert!(fs::metadata(folder.path().join(FILE)).unwrap().len() < 1 << 20);
    }

    #[test]
    fn the_queue_of_an_earlier_version_is_read_once() {
        let folder = tempfile::tempdir().unwrap();
        let line = |json: &str| format!("{:08x} {json}\n", crc32fast::hash(json.as_bytes()));
        let kept = |sequence: u64| {
            line(&format!(
                r#"{{"kept":{{"epoch":"000000000000002a","sequence":{sequence},"clock":"0000000000000001","observed_ns":5,"observed_unix_ns":6,"input":{{"file":3,"at":{sequence}0}},"text":"They sit."}}}}"#
            ))
        };
        let head = |first: u64| {
            line(&format!(r#"{{"head":{{"epoch":"000000000000002a","first":{first},"confirmed":1,"input":null}}}}"#))
        };
        let lines = [head(2), kept(2), kept(3), "cut off\n".to_owned(), kept(4), head(3), kept(5)].concat();
        let old = folder.path().join(OLD_FILE);
        fs::write(&old, &lines).unwrap();
        // A hub was killed at its first start.
        drop(Database::open(&folder.path().join("narration.new"), SCHEMA).unwrap());
        for _ in 0..2 {
            let spool = open(folder.path());
            assert_eq!((spool.epoch(), spool.confirmed(), place(&spool)), (42, 1, (3, 5, Some(50))));
        }
        assert_eq!(fs::read_to_string(&old).unwrap(), lines);
        // A damaged line in the middle.
        for suffix in ["", "-wal", "-shm"] {
            fs::remove_file(folder.path().join(format!("{FILE}{suffix}"))).unwrap();
        }
        fs::write(&old, [head(2), kept(2), kept(4)].concat()).unwrap();
        assert_eq!(place(&open(folder.path())), (4, 4, Some(40)));
    }
}
