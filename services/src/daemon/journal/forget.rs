//! What a person did is taken out of the journal. What remains of each of their records is that it was taken: its source, epoch and
//! sequence, so that a narrator that sends it again does not bring it back.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::io;

use roomcast_core::ids::{BootNs, EventId, PersonId};
use roomcast_core::narration::{Event, Observation, Presence, Sentence};

use super::disk::{Disk, Half};
use super::record::{
    BOOT_AT, FIXED_BYTES, HEADER_BYTES, MAGIC_CARRIED, MAGIC_KEPT, MAGIC_NAMED, MAGIC_NAMED_KEPT, Move, Moved, Record,
    decode, each_record, encode, encode_forgotten, encode_moved,
};
use super::writer::{Last, Writer};

/// Says whether an observation is of the forgotten person or names them. Of one that named nobody it is told whose it was found to be.
pub(super) type IsTheirs = dyn Fn(&Observation, Option<PersonId>) -> bool + Send;

/// What stands for the sentence of a person who is forgotten.
const BLANK: &str = "Forgotten.";

impl<D: Disk> Writer<D> {
    /// Rewrites both halves, and what the disk has refused so far, without what `is_theirs` says, `person`. A half stays whole until its
    /// successor is. What is kept aside is removed: it may hold more than can be read. Gives how many records were theirs. Where nothing is of them,
    /// nothing is written, for which a full disk may have no room.
    pub(super) fn forget(&mut self, person: PersonId, is_theirs: &IsTheirs) -> io::Result<usize> {
        self.rewrite()?;
        let (older, current) = (self.disk.read(Half::Older)?, self.disk.read(Half::Current)?);
        let (mut attributed, mut moved) = (BTreeMap::new(), BTreeMap::new());
        for half in [&older, &current, &self.unwritten, &self.kept] {
            attributions(half, &mut attributed, &mut moved);
        }
        let (records, taken) = (Cell::new(0), RefCell::default());
        let forgets = Forgets { person, is_theirs, attributed, records, moved, taken };
        let kept_older = forgets.without(&older);
        let kept = forgets.without(&current);
        let unwritten = forgets.without(&self.unwritten);
        let lasts: Vec<Vec<u8>> = self.last.values().map(|last| forgets.without(&last.record)).collect();
        let is_same = |(last, own): (&Last, &Vec<u8>)| last.record == *own;
        if kept_older == older
            && kept == current
            && unwritten == self.unwritten
            && self.last.values().zip(&lasts).all(is_same)
        {
            self.disk.remove_aside()?;
            return Ok(0);
        }
        if !older.is_empty() {
            self.names_synced = false;
            self.disk.prepare(&kept_older)?;
            self.disk.place(Half::Older)?;
            self.older_length = kept_older.len() as u64;
        }
        self.names_synced = false;
        self.disk.prepare(&kept)?;
        self.disk.place(Half::Current)?;
        self.length = kept.len() as u64;
        (self.lacks_pages, self.is_torn) = (false, false);
        self.unsynced.clear();
        self.unwritten = unwritten;
        for (last, record) in self.last.values_mut().zip(lasts) {
            last.record = record;
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
    person: PersonId,
    is_theirs: &'a IsTheirs,
    /// Whose observations are found to be, each by itself: not those that are of a group.
    attributed: BTreeMap<EventId, BTreeSet<PersonId>>,
    /// How many records were theirs.
    records: Cell<usize>,
    /// Whom all observations moved.
    moved: BTreeMap<EventId, Vec<Move>>,
    /// The observations that were theirs, and what they said.
    taken: RefCell<BTreeMap<EventId, Event>>,
}

impl Forgets<'_> {
    fn is_theirs(&self, observation: &Observation) -> bool {
        let name = observation.id();
        let found = self.attributed.get(&name).into_iter().flatten().copied();
        let mut found = found.chain(observation.by_fit.then_some(observation.person)).peekable();
        let is_theirs = match found.peek() {
            Some(_) => found.any(|found| (self.is_theirs)(observation, Some(found))),
            None => (self.is_theirs)(observation, None),
        };
        if is_theirs {
            self.records.set(self.records.get() + 1);
            self.taken.borrow_mut().insert(name, observation.event.clone());
        }
        is_theirs
    }

    /// Whom else an observation moved, which was theirs: whether these are in the house, and nothing else of it.
    fn others_of(&self, moves: &[Move], observed: &Event) -> Vec<Move> {
        let others = moves.iter().filter(|own| ![self.person, PersonId::SOMEBODY].contains(&own.person));
        let other = |own: &Move| {
            let event = bare_presence(own.event.as_ref().unwrap_or(observed));
            Move { event: Some(event), ..own.clone() }
        };
        others.map(other).collect()
    }

    /// A record of theirs without what is of them: where others are whom it moved stays so. None where it moved nobody else.
    fn bare(&self, raw: &[u8], observation: &Observation) -> Option<Vec<u8>> {
        let name = observation.id();
        let mut bare = observation.clone();
        if let Some(moves) = self.moved.get(&name) {
            if self.others_of(moves, &observation.event).is_empty() {
                return None;
            }
            (bare.person, bare.name, bare.by_fit) = (PersonId::SOMEBODY, None, false);
            bare.event = Event::Did(Sentence::new(BLANK).ok()?);
        } else {
            // By whose key it is, or whom it was found to be of, it is somebody else's.
            let found = self.attributed.get(&name).into_iter().flatten().next().copied();
            let found = found.or(observation.by_fit.then_some(observation.person));
            bare.event = bare_presence(&observation.event);
            let is_somebodys = bare.person != PersonId::SOMEBODY || bare.name.is_some() || found.is_some();
            if !is_somebodys || (self.is_theirs)(&bare, found) {
                return None;
            }
        }
        Some(encode_again(&bare, raw))
    }

    /// Whom else an observation moved. Where its own record is lost, what it says of others may still name them.
    fn others(&self, moved: &Moved) -> Option<Vec<Move>> {
        let EventId { source, epoch, sequence } = moved.observation;
        if let Some(observed) = self.taken.borrow().get(&moved.observation) {
            return Some(self.others_of(&moved.moves, observed)).filter(|others| !others.is_empty());
        }
        let names_them = |own: &&Move| {
            let Some(event) = own.event.clone() else { return false };
            let observation = Observation { source, epoch, ..Observation::saying(sequence, event) };
            (self.is_theirs)(
                &Observation { person: own.person, name: own.name.clone(), ..observation },
                Some(own.person),
            )
        };
        let others = moved.moves.iter().filter(|own| own.person != self.person && !names_them(own));
        Some(others.cloned().collect())
    }

    /// The records without what is theirs; whatever is no record goes, too.
    fn without(&self, bytes: &[u8]) -> Vec<u8> {
        let mut kept = Vec::with_capacity(bytes.len());
        each_record(bytes, |raw, record| match record {
            Record::Observation(observation) if self.is_theirs(&observation) => {
                kept.extend(self.bare(raw, &observation).unwrap_or_else(|| blank(&observation)));
            }
            Record::Carried(observation) if self.is_theirs(&observation) => kept.extend(blank(&observation)),
            Record::Kept(observation) if self.is_theirs(&observation) => {
                kept.extend(self.bare(raw, &observation).unwrap_or_default());
            }
            Record::Outcome { person, .. } | Record::Forgotten { person, .. } if person == self.person => {}
            Record::Moved(moved) => match self.others(&moved) {
                Some(moves) if moves == moved.moves => kept.extend_from_slice(raw),
                Some(moves) => kept.extend(encode_moved(&Moved { moves, ..moved })),
                None => {}
            },
            _ => kept.extend_from_slice(raw),
        });
        kept
    }
}

/// An observation in place of its own record, of which its times stay, and what kind of record it is.
fn encode_again(observation: &Observation, raw: &[u8]) -> Vec<u8> {
    let mut boot_id = [0; 16];
    let (at, bytes) = (HEADER_BYTES + BOOT_AT, HEADER_BYTES + FIXED_BYTES);
    boot_id.copy_from_slice(&raw[at..bytes]);
    let own = decode(raw, &boot_id).map_or(BootNs(0), |(record, _)| match record {
        Record::Observation(own) | Record::Kept(own) => own.observed_ns,
        _ => BootNs(0),
    });
    let mut record = encode(&Observation { observed_ns: own, ..observation.clone() }, &boot_id);
    if raw.starts_with(&MAGIC_KEPT) || raw.starts_with(&MAGIC_NAMED_KEPT) {
        let is_named = record.starts_with(&MAGIC_NAMED);
        record[..MAGIC_KEPT.len()].copy_from_slice(if is_named { &MAGIC_NAMED_KEPT } else { &MAGIC_KEPT });
    }
    record
}

/// The presence of an event, without text and room.
fn bare_presence(event: &Event) -> Event {
    match event.person_presence() {
        Presence::Away => Event::Away,
        Presence::Gone => Event::Gone,
        Presence::Present | Presence::Unknown => Event::Present(None),
    }
}

/// A record that only says that an observation was taken.
fn blank(observation: &Observation) -> Vec<u8> {
    let Ok(sentence) = Sentence::new(BLANK) else { return Vec::new() };
    let Observation { source, epoch, .. } = *observation;
    let nothing =
        Observation { person: PersonId::SOMEBODY, source, epoch, ..Observation::of(observation.sequence, sentence) };
    let mut record = encode(&nothing, &[0; 16]);
    record[..MAGIC_CARRIED.len()].copy_from_slice(&MAGIC_CARRIED);
    record
}

fn attributions(
    bytes: &[u8],
    found: &mut BTreeMap<EventId, BTreeSet<PersonId>>,
    moved: &mut BTreeMap<EventId, Vec<Move>>,
) {
    each_record(bytes, |_, record| match record {
        Record::Outcome { event, person, by_fit: true, .. } => _ = found.entry(event).or_default().insert(person),
        Record::Moved(Moved { observation, moves }) => {
            let own = moves.iter().filter(|own| own.name.is_some() || own.by_fit).map(|own| own.person);
            let mut own = own.peekable();
            if own.peek().is_some() {
                found.entry(observation).or_default().extend(own);
            }
            moved.insert(observation, moves);
        }
        _ => {}
    });
}
