//! What was last said of each person outlives the half that held it, however much others say: a restarted daemon knows where everybody is.
//!
//! At a rotation the new half begins with all of it: with what the half that stays began with, and with what only the half that goes
//! still says. So of two halves the newer one's beginning counts.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::person_number;

use super::disk::{Disk, Half};
use super::record::{MAGIC, MAGIC_KEPT, MAGIC_NAMED, MAGIC_NAMED_KEPT, Moved, Record, each_record, encode_forgotten};
use super::writer::Writer;

/// At most so many observations of each person are kept, fewer where they do not fit.
const WORDS: [usize; 5] = [12, 6, 3, 2, 1];

/// A record with its bytes.
type Raw<'a> = (&'a [u8], Record);

impl<D: Disk> Writer<D> {
    /// Records of what only the older half still says: the newest observations of persons, with what became of them, and who was forgotten.
    pub(super) fn last_words(&self) -> io::Result<Vec<u8>> {
        Ok(last_words(&self.disk.read(Half::Older)?, &self.disk.read(Half::Current)?, self.half_bytes / 4))
    }
}

/// The same of the bytes of two halves, in at most so many bytes.
fn last_words(older: &[u8], current: &[u8], bytes_max: u64) -> Vec<u8> {
    let goes = in_order(older, current);
    let mut stays = Vec::new();
    each_record(current, |raw, record| {
        if !matches!(record, Record::Kept(_) | Record::Forgotten { is_before: true, .. }) {
            stays.push((raw, record));
        }
    });
    let all = || goes.iter().map(|(_, record)| record).chain(stays.iter().map(|(_, record)| record));
    for words in WORDS {
        let needed = newest(all(), words);
        let kept = chosen(&goes, &stays, &needed);
        if kept.iter().map(Vec::len).sum::<usize>() as u64 <= bytes_max || words == 1 {
            let mut surplus = kept.iter().map(Vec::len).sum::<usize>() as u64;
            let fits = kept.into_iter().skip_while(|words| {
                let goes = surplus > bytes_max;
                surplus -= words.len() as u64;
                goes
            });
            return fits.flatten().collect();
        }
    }
    Vec::new()
}

/// What goes with the older half, in the order in which it was said: first what the current half begins with.
fn in_order<'a>(older: &'a [u8], current: &'a [u8]) -> Vec<Raw<'a>> {
    let (mut before, mut events) = (Vec::new(), BTreeSet::new());
    each_record(current, |raw, record| match record {
        Record::Kept(ref observation) => {
            events.insert(observation.id());
            before.push((raw, record));
        }
        Record::Outcome { event, .. } | Record::Moved(Moved { observation: event, .. }) if events.contains(&event) => {
            before.push((raw, record));
        }
        Record::Forgotten { is_before: true, .. } => before.push((raw, record)),
        _ => {}
    });
    let is_first = before.is_empty();
    each_record(older, |raw, record| {
        // What this half began with is among what the next one begins with, if that begins with anything.
        let is_old = matches!(record, Record::Kept(_) | Record::Forgotten { is_before: true, .. });
        if is_first || !is_old {
            before.push((raw, record));
        }
    });
    before
}

/// Of each person the newest observations that changed something; among them the newest that has their name, by which they are known
/// when what is said of all is read again. And the newest of those of which nothing was told since: a daemon that was killed, or lost it with the
/// power, did not come to that.
fn newest<'a>(records: impl Iterator<Item = &'a Record>, words: usize) -> BTreeMap<PersonId, Vec<EventId>> {
    let mut newest = BTreeMap::<PersonId, Vec<EventId>>::new();
    let (mut keyed, mut of_themselves) = (BTreeMap::new(), BTreeMap::<PersonId, EventId>::new());
    // By the number that they were named with, which may be another one to the home.
    let mut untold = BTreeMap::<PersonId, Vec<EventId>>::new();
    for record in records {
        if let Record::Outcome { event, by_fit: false, .. } = record
            && let Some(untold) = keyed.get(event).and_then(|number| untold.get_mut(number))
        {
            let told = untold.iter().position(|untold| untold == event).map_or(0, |place| place + 1);
            untold.drain(..told);
        }
        match record {
            Record::Observation(own) | Record::Kept(own) if own.name.is_some() || own.person != PersonId::SOMEBODY => {
                let event = own.id();
                let number = own.name.as_deref().map_or(own.person, person_number);
                keyed.insert(event, number);
                let untold = untold.entry(number).or_default();
                untold.push(event);
                untold.drain(..untold.len().saturating_sub(words));
            }
            Record::Moved(Moved { observation, moves }) => {
                let named = moves.iter().filter(|own| own.name.is_some());
                of_themselves.extend(named.map(|own| (own.person, *observation)));
            }
            Record::Outcome { event, person, by_fit: false, .. } if keyed.contains_key(event) => {
                of_themselves.insert(*person, *event);
                let own = newest.entry(*person).or_default();
                own.retain(|known| known != event);
                own.push(*event);
                own.drain(..own.len().saturating_sub(words));
            }
            Record::Outcome { event, person, by_fit: false, .. } => {
                let own = newest.entry(*person).or_default();
                own.retain(|known| known != event);
                own.push(*event);
                own.drain(..own.len().saturating_sub(words));
            }
            Record::Forgotten { person, .. } => {
                newest.remove(person);
                of_themselves.remove(person);
                untold.remove(person);
            }
            _ => {}
        }
    }
    for (person, own) in &mut newest {
        if let Some(name) = of_themselves.get(person).copied().filter(|name| !own.contains(name)) {
            own.insert(0, name);
        }
    }
    for (number, untold) in untold {
        newest.entry(number).or_default().extend(untold);
    }
    newest
}

/// The records to keep: each observation with what became of it, and who was forgotten.
fn chosen(goes: &[Raw<'_>], stays: &[Raw<'_>], needed: &BTreeMap<PersonId, Vec<EventId>>) -> Vec<Vec<u8>> {
    let mut needed: BTreeSet<EventId> = needed.values().flatten().copied().collect();
    // Of each kind the newest.
    let mut outcomes = BTreeMap::<EventId, BTreeMap<(PersonId, bool, bool), &[u8]>>::new();
    let mut moved = BTreeMap::<EventId, &[u8]>::new();
    for (raw, record) in goes.iter().chain(stays) {
        match record {
            Record::Outcome { event, person, by_fit, expectation } if needed.contains(event) => {
                let is_belief = expectation.paces.is_some();
                outcomes.entry(*event).or_default().insert((*person, *by_fit, is_belief), raw);
            }
            Record::Moved(Moved { observation, .. }) if needed.contains(observation) => {
                moved.insert(*observation, raw);
            }
            _ => {}
        }
    }
    let forgotten = |record: &Record| match record {
        Record::Forgotten { person, .. } => Some(*person),
        _ => None,
    };
    let mut kept = Vec::new();
    for (at, (raw, record)) in goes.iter().enumerate() {
        match record {
            Record::Observation(observation) | Record::Kept(observation) => {
                let event = observation.id();
                if !needed.remove(&event) {
                    continue;
                }
                let outcomes = outcomes.remove(&event).unwrap_or_default();
                let is_named = raw.starts_with(&MAGIC_NAMED) || raw.starts_with(&MAGIC_NAMED_KEPT);
                let mut words = if is_named { MAGIC_NAMED_KEPT.to_vec() } else { MAGIC_KEPT.to_vec() };
                words.extend_from_slice(&raw[MAGIC.len()..]);
                words.extend_from_slice(moved.get(&event).copied().unwrap_or_default());
                words.extend(outcomes.into_values().flatten());
                kept.push(words);
            }
            Record::Forgotten { person, .. } => {
                // Of one who was forgotten again later, that one counts.
                let again = |(_, record): &Raw<'_>| forgotten(record) == Some(*person);
                if !goes[at + 1..].iter().any(again) && !stays.iter().any(again) {
                    kept.push(encode_forgotten(*person, true));
                }
            }
            _ => {}
        }
    }
    kept
}
