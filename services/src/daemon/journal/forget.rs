//! What a person did is taken out of the journal. What remains of each of their records is that it was taken: its source, epoch and
//! sequence, so that a narrator that sends it again does not bring it back.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::io;

use roomcast_core::narration::{Observation, SOMEBODY, Sentence};

use super::{Disk, HEADER_BYTES, Half, MAGIC_CARRIED, Record, Writer, decode, encode, encode_forgotten};

/// Says whether an observation is of the forgotten person or names them. Of one that named nobody it is told whose it was found to be.
pub(super) type IsTheirs = dyn Fn(&Observation, Option<u32>) -> bool + Send;

/// What stands for the sentence of a person who is forgotten.
const BLANK: &str = "Forgotten.";

impl<D: Disk> Writer<D> {
    /// Rewrites both halves, and what the disk has refused so far, without what `is_theirs` says, `person`. A half stays whole until its
    /// successor is. What is kept aside is removed: it may hold more than can be read. Gives how many records were theirs.
    pub(super) fn forget(&mut self, person: u32, is_theirs: &IsTheirs) -> io::Result<usize> {
        self.rewrite()?;
        let (older, current) = (self.disk.read(Half::Older)?, self.disk.read(Half::Current)?);
        let mut attributed = BTreeMap::new();
        for half in [&older, &current, &self.unwritten] {
            attributions(half, &mut attributed);
        }
        let forgets = Forgets { person, is_theirs, attributed, records: Cell::new(0) };
        if !older.is_empty() {
            let kept = forgets.without(&older);
            self.names_synced = false;
            self.disk.prepare(&kept)?;
            self.disk.place(Half::Older)?;
            self.older_length = kept.len() as u64;
        }
        let kept = forgets.without(&current);
        self.names_synced = false;
        self.disk.prepare(&kept)?;
        self.disk.place(Half::Current)?;
        self.length = kept.len() as u64;
        (self.lacks_pages, self.is_torn) = (false, false);
        self.unsynced.clear();
        self.unwritten = forgets.without(&self.unwritten);
        for last in self.last.values_mut() {
            last.record = forgets.without(&last.record);
        }
        self.last.retain(|_, last| last.record.len() > HEADER_BYTES);
        self.kept = forgets.without(&self.kept);
        self.progress.bytes.store(self.older_length + self.length, std::sync::atomic::Ordering::Relaxed);
        self.disk.remove_aside()?;
        self.disk.sync_names()?;
        self.names_synced = true;
        // What was said of everybody before this does not bring them back after a restart.
        self.write(&encode_forgotten(person, false))?;
        Ok(forgets.records.get())
    }
}

struct Forgets<'a> {
    person: u32,
    is_theirs: &'a IsTheirs,
    /// Whose an observation that named nobody is.
    attributed: BTreeMap<(u64, u64, u64), u32>,
    /// How many records were theirs.
    records: Cell<usize>,
}

impl Forgets<'_> {
    fn is_theirs(&self, observation: &Observation) -> bool {
        let name = (observation.source, observation.epoch, observation.sequence);
        let found = self.attributed.get(&name).copied();
        let found = found.or(observation.by_fit.then_some(observation.person));
        let is_theirs = (self.is_theirs)(observation, found);
        self.records.set(self.records.get() + usize::from(is_theirs));
        is_theirs
    }

    /// The records without what is theirs; whatever is no record goes, too.
    fn without(&self, bytes: &[u8]) -> Vec<u8> {
        let mut kept = Vec::with_capacity(bytes.len());
        each_record(bytes, |raw, record| match record {
            Record::Observation(observation) | Record::Carried(observation) if self.is_theirs(&observation) => {
                kept.extend(blank(&observation));
            }
            Record::Kept(observation) if self.is_theirs(&observation) => {}
            Record::Outcome { person, .. } | Record::Forgotten { person, .. } if person == self.person => {}
            _ => kept.extend_from_slice(raw),
        });
        kept
    }
}

/// A record that only says that an observation was taken.
fn blank(observation: &Observation) -> Vec<u8> {
    let Ok(sentence) = Sentence::new(BLANK) else { return Vec::new() };
    let Observation { source, epoch, .. } = *observation;
    let nothing = Observation { person: SOMEBODY, source, epoch, ..Observation::of(observation.sequence, sentence) };
    let mut record = encode(&nothing, &[0; 16]);
    record[..MAGIC_CARRIED.len()].copy_from_slice(&MAGIC_CARRIED);
    record
}

fn attributions(bytes: &[u8], found: &mut BTreeMap<(u64, u64, u64), u32>) {
    each_record(bytes, |_, record| {
        if let Record::Outcome { name, person, by_fit: true, .. } = record {
            found.insert(name, person);
        }
    });
}

/// Every whole record with its bytes; what is none is stepped over.
pub(super) fn each_record<'a>(bytes: &'a [u8], mut take: impl FnMut(&'a [u8], Record)) {
    let mut rest = bytes;
    while !rest.is_empty() {
        let length = match decode(rest, &[0; 16]) {
            Some((record, length)) => {
                take(&rest[..length], record);
                length
            }
            None => 1,
        };
        rest = &rest[length..];
    }
}
