//! What writes records to a disk that may fail: halves, rotations, syncs.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io;
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError};
use roomcast_core::narration::Observation;
use roomcast_core::pipeline::SOURCES_MAX;

use super::disk::{Disk, Half};
use super::record::*;
use super::recovered::{Recovered, read_records};
use super::{Progress, Work};

/// Silence before a sync.
const QUIET_BEFORE_SYNC: Duration = Duration::from_millis(100);
/// So often in a row a rotation is put off where what was last said of persons cannot be read, before it goes on without that.
pub(super) const UNREAD_MAX: u32 = 8;

/// The last record of one start of a source.
#[derive(Debug)]
pub(super) struct Last {
    pub(super) record: Vec<u8>,
    /// The current half has it.
    in_current: bool,
    /// Grows with every record.
    turn: u64,
}

/// When the next sync is due: some time after what was written, because whatever is to be written during a sync waits for it, and so do the
/// scores that rest on it. Never later than promised, and, unless that asks for it, not sooner after the last one.
#[derive(Debug)]
pub(super) struct SyncDue {
    every: Duration,
    synced: Instant,
    /// When the first and the last was written since; none where all is synced.
    written: Option<(Instant, Instant)>,
}

impl SyncDue {
    /// What a process before has left is to be synced.
    pub(super) fn new(every: Duration, now: Instant) -> Self {
        Self { every, synced: now, written: Some((now, now)) }
    }

    pub(super) fn wrote(&mut self, now: Instant) {
        let first = self.written.map_or(now, |(first, _)| first);
        self.written = Some((first, now));
    }

    /// What a sync failed with is synced again.
    pub(super) fn synced(&mut self, done: bool, now: Instant) {
        self.synced = now;
        self.written = (!done).then_some((now, now));
    }

    pub(super) fn at(&self) -> Option<Instant> {
        let (first, last) = self.written?;
        Some((last + QUIET_BEFORE_SYNC).max(self.synced + self.every).min(first + self.every))
    }
}

/// What writes the two halves to a disk; the journal's thread has one.
#[derive(Debug)]
pub struct Writer<D> {
    pub(super) disk: D,
    pub(super) length: u64,
    pub(super) older_length: u64,
    /// Records that the disk refused, tried again with the next ones: a full disk may have room again.
    pub(super) unwritten: Vec<u8>,
    /// What the current half has had since the last sync, in pieces, each with where it begins. The system takes for written what a sync has
    /// failed with, so it is written again.
    pub(super) unsynced: Vec<(u64, Vec<u8>)>,
    /// A sync has failed, and what it lost is not written again yet.
    pub(super) lacks_pages: bool,
    /// An append has failed, and what it left behind is not cut off yet.
    pub(super) is_torn: bool,
    /// The disk knows the names of the halves.
    pub(super) names_synced: bool,
    /// The last record of each start of a source. What the current half has not is carried over at the next rotation.
    pub(super) last: BTreeMap<(u64, u64), Last>,
    /// Whose each of them is; every half has all of these records.
    pub(super) ports: BTreeMap<(u64, u64), Vec<u8>>,
    /// Records written.
    pub(super) turn: u64,
    /// What was last said of persons in a half that a rotation has dropped, until the new one has it.
    pub(super) kept: Vec<u8>,
    /// Rotations put off in a row because that could not be read.
    pub(super) unread: u32,
    pub(super) half_bytes: u64,
    pub(super) sync_every: Duration,
    pub(super) progress: Arc<Progress>,
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

    pub(super) fn run(&mut self, queue: &Receiver<Work>) {
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
        let synced = self.sync_all();
        self.progress.is_unsynced.store(synced.is_err(), Ordering::Relaxed);
        synced
    }

    fn sync_all(&mut self) -> io::Result<()> {
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
    pub(super) fn rewrite(&mut self) -> io::Result<()> {
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
