//! What was last said of each person outlives the half that held it, however much others say: a restarted daemon knows where everybody is.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use roomcast_core::narration::PERSONS_MAX;

use super::forget::each_record;
use super::{MAGIC, MAGIC_FORGOTTEN, MAGIC_KEPT, MAGIC_NAMED, MAGIC_NAMED_KEPT, Record, Writer, encode_forgotten};

/// So many observations of each person are kept.
const WORDS: usize = 2;

/// An observation by its source, epoch and sequence.
type Name = (u64, u64, u64);

impl Writer {
    /// Records of what only the older half still says: the newest observations of persons, with what became of them, and who was forgotten.
    pub(super) fn last_words(&self) -> io::Result<Vec<u8>> {
        let older = match std::fs::read(&self.older) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            read => read?,
        };
        Ok(last_words(&older, &std::fs::read(&self.current)?, self.half_bytes / 4))
    }
}

/// The same of the bytes of two halves; of more than `bytes_max` the newest.
fn last_words(older: &[u8], current: &[u8], bytes_max: u64) -> Vec<u8> {
    let mut newest = BTreeMap::<u32, Vec<Name>>::new();
    let mut forgotten = BTreeSet::new();
    for half in [older, current] {
        each_record(half, |_, record| match record {
            Record::Outcome { name, person, .. } => {
                let words = newest.entry(person).or_default();
                words.retain(|known| *known != name);
                words.push(name);
                words.drain(..words.len().saturating_sub(WORDS));
            }
            Record::Forgotten { person, .. } => _ = newest.remove(&person),
            _ => {}
        });
    }
    each_record(current, |_, record| {
        if let Record::Forgotten { person, .. } = record {
            forgotten.insert(person);
        }
    });
    // Of each observation that is kept, what became of it.
    let mut outcomes = BTreeMap::<Name, Vec<u8>>::new();
    for half in [older, current] {
        each_record(half, |raw, record| {
            if let Record::Outcome { name, person, .. } = record
                && newest.get(&person).is_some_and(|words| words.contains(&name))
            {
                outcomes.entry(name).or_default().extend_from_slice(raw);
            }
        });
    }
    let mut kept = Vec::new();
    each_record(older, |raw, record| match record {
        Record::Observation(observation) | Record::Kept(observation) => {
            let name = (observation.source, observation.epoch, observation.sequence);
            let Some(outcomes) = outcomes.remove(&name) else { return };
            let is_named = raw.starts_with(&MAGIC_NAMED) || raw.starts_with(&MAGIC_NAMED_KEPT);
            let mut words = if is_named { MAGIC_NAMED_KEPT.to_vec() } else { MAGIC_KEPT.to_vec() };
            words.extend_from_slice(&raw[MAGIC.len()..]);
            words.extend(outcomes);
            kept.push(words);
        }
        // Forgotten again later, that one counts.
        Record::Forgotten { person, .. } if forgotten.insert(person) => kept.push(encode_forgotten(person, true)),
        _ => {}
    });
    let are_forgotten = kept.iter().filter(|words| words.starts_with(&MAGIC_FORGOTTEN)).count();
    let mut surplus = are_forgotten.saturating_sub(PERSONS_MAX);
    kept.retain(|words| {
        let goes = surplus > 0 && words.starts_with(&MAGIC_FORGOTTEN);
        surplus -= usize::from(goes);
        !goes
    });
    let mut bytes = kept.iter().map(Vec::len).sum::<usize>() as u64;
    let newest = kept.into_iter().skip_while(|words| {
        let goes = bytes > bytes_max;
        bytes -= words.len() as u64;
        goes
    });
    newest.flatten().collect()
}
