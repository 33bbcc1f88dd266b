//! The files of earlier versions, which are read once.
//!
//! The journal has two files of records. A record is four letters, the payload's length (u32), the CRC-32 of the payload (u32), the payload; integers little endian.

use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use roomcast_core::forecast::PACES;
use roomcast_core::habits::{BYTES_MAX as HABITS_BYTES_MAX, Habits, HabitsOptions};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Sentence};
use roomcast_core::parsing::{Keyed, json_says};
use roomcast_core::semantic_map::{MAX_FILE_BYTES, SemanticMap};
use roomcast_ipc::Sender as Port;
use roomcast_ipc::raw::NAME_BYTES;

use super::old_habits;
use super::record::{Expectation, KeptPerson, Move, Moved, Record};
use crate::daemon::habits::{Heard, Memory};
use crate::daemon::map_change::KeptMap;
use crate::state_file;

/// The older half, then the current one.
const FILES: [&str; 2] = ["narration.journal.old", "narration.journal"];
/// The current half of a daemon that was killed before it had renamed it.
const NEXT: &str = "narration.journal.next";
/// The names that the home gave.
const PERSONS: &str = "persons.json";
/// The habits, and a file that was damaged.
pub(super) const HABITS: [&str; 2] = ["habits", "habits.damaged"];
/// The changed map.
const MAP: &str = "changed-map.json";
/// The files with events and names.
pub(super) const EVENTS: [&str; 3] = [FILES[0], FILES[1], PERSONS];
/// Most names of learned events that are read.
const NAMES_MAX: u32 = 4_096;
/// Most bytes of them that are read.
const PERSONS_BYTES_MAX: u64 = 1 << 20;
const PAYLOAD_BYTES_MAX: usize = 64 << 10;
/// Bits of a named record.
const IS_PRESENCE: u8 = 1;
const IS_BY_FIT: u8 = 1 << 1;
const IS_AS_OBSERVED: u8 = 1 << 2;
const IS_AS_BEFORE: u8 = 1 << 3;
const IS_NO_FORM: u8 = 1 << 4;

/// The records of both files, oldest first, of each file at most so many bytes; `boot_id` names the machine's start of now.
pub(super) fn read(directory: &Path, bytes_max: u64, boot_id: &[u8; 16]) -> Vec<Record> {
    let current = if directory.join(FILES[1]).exists() { FILES[1] } else { NEXT };
    let halves = [FILES[0], current].map(|file| {
        let path = directory.join(file);
        newest(&path, bytes_max.saturating_add(1 << 20)).unwrap_or_else(|error| {
            tracing::warn!(%error, path = %path.display(), "the journal of an earlier version cannot be read");
            Vec::new()
        })
    });
    records(&halves, boot_id)
}

/// The last bytes of a file.
fn newest(path: &Path, bytes_max: u64) -> io::Result<Vec<u8>> {
    state_file::require_own(path)?;
    let mut file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        opened => opened?,
    };
    let over = file.metadata()?.len().saturating_sub(bytes_max);
    file.seek(SeekFrom::Start(over))?;
    let mut bytes = Vec::new();
    file.take(bytes_max).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Removes files of earlier versions, large files that they set aside included.
pub(super) fn remove(directory: &Path, files: &[&str]) -> io::Result<()> {
    for file in files {
        let aside = (1..=64).map(|number| format!("{file}.large-{number}"));
        for name in aside.chain([(*file).to_owned(), NEXT.to_owned()]) {
            match fs::remove_file(PathBuf::from(directory).join(name)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
        }
    }
    Ok(())
}

/// What a file of an earlier version says. If it cannot be used, the log says so.
fn content<T>(
    (directory, name): (&Path, &str),
    bytes_max: u64,
    parse: impl FnOnce(&[u8]) -> Result<T, String>,
    remedy: &str,
) -> Option<T> {
    let path = directory.join(name);
    let read = state_file::read(&path, bytes_max).map_err(|error| error.to_string());
    read.and_then(|bytes| bytes.map(|bytes| parse(&bytes)).transpose()).unwrap_or_else(|reason| {
        tracing::warn!(reason, path = %path.display(), "a file of an earlier version cannot be used: {remedy}");
        None
    })
}

/// The persons in the file of an earlier version.
pub(in crate::daemon) fn persons(directory: &Path) -> Vec<KeptPerson> {
    let parse = |bytes: &[u8]| {
        let persons: Vec<Keyed<KeptPerson>> = serde_json::from_slice(bytes).map_err(|error| json_says(&error))?;
        Ok(persons.into_iter().map(|Keyed(person)| person).collect())
    };
    let remedy = "the names in it are not known; give them again with `roomcast person rename`";
    content((directory, PERSONS), PERSONS_BYTES_MAX, parse, remedy).unwrap_or_default()
}

/// The changed map in the file of an earlier version.
pub(super) fn changed_map(directory: &Path) -> Option<KeptMap> {
    #[derive(serde::Deserialize)]
    struct Kept {
        /// The fingerprint of the configured scene.
        base: String,
        scene: serde_json::Value,
    }
    let parse = |bytes: &[u8]| {
        let Kept { base, scene } = serde_json::from_slice(bytes).map_err(|error| json_says(&error))?;
        let map = SemanticMap::from_json(&scene.to_string()).map_err(|error| crate::logging::chain(&error))?;
        Ok(KeptMap::new(base, &map))
    };
    content((directory, MAP), 2 * MAX_FILE_BYTES, parse, "the configured scene is used; apply the changes again")
}

/// The habits in the file of an earlier version.
pub(in crate::daemon) fn habits(directory: &Path, options: HabitsOptions) -> Option<Memory> {
    let bytes_max = HABITS_BYTES_MAX as u64 + 24 * u64::from(NAMES_MAX) + 24;
    let remedy = "only the events in the state database are learned";
    content((directory, HABITS[0]), bytes_max, |bytes| memory(bytes, options), remedy)
}

/// The habits in the bytes of that file.
///
/// # Errors
/// When the bytes are damaged, of another version, or say something impossible: why.
pub fn memory(bytes: &[u8], options: HabitsOptions) -> Result<Memory, String> {
    let early = || "it ends early".to_owned();
    let mut rest = bytes.strip_prefix(b"RCHOME1\n").ok_or("it does not begin as one of this version")?;
    if take_u32(&mut rest).ok_or_else(early)? != crc32fast::hash(rest) {
        return Err("its checksum is wrong".to_owned());
    }
    let watched_until_s = f64::from_bits(take_u64(&mut rest).ok_or_else(early)?);
    let count = take_u32(&mut rest).filter(|count| *count <= NAMES_MAX && !watched_until_s.is_nan());
    let count = count.ok_or("it says something impossible")?;
    let heard = (0..count).map(|_| take_event(&mut rest)).collect::<Option<Vec<_>>>().ok_or_else(early)?;
    let habits = Habits::from_stored(options, old_habits::stored(rest)?).map_err(|error| error.to_string())?;
    Ok(Memory { habits, heard: Heard::new(heard), watched_until_s })
}

/// The records of some files' bytes, oldest first; damage is stepped over.
#[must_use]
pub fn records(halves: &[Vec<u8>; 2], boot_id: &[u8; 16]) -> Vec<Record> {
    let [mut first, mut last] = [Vec::new(), Vec::new()];
    for half in halves {
        let mut kept = Vec::new();
        let mut rest = half.as_slice();
        while !rest.is_empty() {
            let Some((letter, record, bytes)) = decode(rest, boot_id) else {
                rest = &rest[1..];
                continue;
            };
            rest = &rest[bytes..];
            // The last words of each person come before the halves' own records; the newer half has all words of the older one.
            match letter {
                b'7' | b'8' => kept.push(record),
                b'9' if rest_says_before(half, rest, bytes) => kept.push(record),
                _ => last.push(record),
            }
        }
        if !kept.is_empty() {
            first = kept;
        }
    }
    first.append(&mut last);
    first
}

/// Whether the record of `bytes` in front of `rest` says that a person was forgotten before the halves' own records.
fn rest_says_before(half: &[u8], rest: &[u8], bytes: usize) -> bool {
    let end = half.len() - rest.len();
    half[end - bytes..end].last() == Some(&1)
}

/// The record that some bytes begin with, the last of its letters, and how many bytes it has.
fn decode(bytes: &[u8], boot_id: &[u8; 16]) -> Option<(u8, Record, usize)> {
    let (&[b'R', b'C', b'J', letter], mut header) = bytes.split_first_chunk::<4>()? else { return None };
    let (length, checksum) = (take_u32(&mut header)? as usize, take_u32(&mut header)?);
    let payload = header.get(..length).filter(|_| length <= PAYLOAD_BYTES_MAX)?;
    if crc32fast::hash(payload) != checksum {
        return None;
    }
    let record = match letter {
        b'1' | b'7' => observation(payload, false, boot_id)?,
        b'3' | b'8' => observation(payload, true, boot_id)?,
        b'2' | b'4' => Record::Taken(take_event(&mut { payload })?),
        b'5' => outcome(payload)?,
        b'6' => {
            let mut rest = payload;
            let start = (take_u64(&mut rest)?, take_u64(&mut rest)?);
            Record::Port { start, port: Port::from_bytes(rest.try_into().ok()?) }
        }
        b'9' => Record::Gone { person: take_person(&mut { payload })?, after: None },
        b'A' => belief(payload)?,
        b'B' => Record::Moved(moved(payload)?),
        _ => return None,
    };
    Some((letter, record, 12 + length))
}

fn observation(mut payload: &[u8], named: bool, boot_id: &[u8; 16]) -> Option<Record> {
    let EventId { source, epoch, sequence } = take_event(&mut payload)?;
    let (observed_ns, observed_unix_ns) = (BootNs(take_u64(&mut payload)?), UnixNs(take_u64(&mut payload)?));
    let person = take_person(&mut payload)?;
    let (boot, mut text) = payload.split_at_checked(boot_id.len())?;
    let (kind, name) = if named { take_kind_and_name(&mut text)? } else { (0, None) };
    let observation = Observation {
        person,
        name,
        by_fit: kind & IS_BY_FIT != 0,
        source,
        epoch,
        observed_ns,
        observed_unix_ns,
        may_be_form: kind & IS_NO_FORM == 0,
        ..Observation::saying(sequence, event_of(std::str::from_utf8(text).ok()?, kind)?)
    };
    Some(Record::Event { observation, is_of_this_boot: boot == boot_id })
}

/// The event of such a text.
fn event_of(text: &str, kind: u8) -> Option<Event> {
    if kind & IS_PRESENCE == 0 {
        return Some(Event::Did(Sentence::new(text).ok()?));
    }
    // Former versions wrote the subject behind the presence, and groups of persons before it; RCJB has the persons.
    let text = text.split('\n').next().unwrap_or_default();
    let groups = ["everybody else ", "everybody ", "alone ", "both ", "guests "];
    let of_group = || groups.iter().find_map(|group| text.strip_prefix(group));
    let of_all = || text.strip_prefix("all ").and_then(|rest| rest.split_once(' ')).map(|(_, rest)| rest);
    let event = Event::presence(text);
    event.or_else(|error| of_group().or_else(of_all).map_or(Err(error), Event::presence)).ok()
}

/// A person's part of a record, and their name, if it has one.
fn take_kind_and_name(bytes: &mut &[u8]) -> Option<(u8, Option<Box<str>>)> {
    let (&[kind, length], rest) = bytes.split_first_chunk()?;
    let (name, rest) = rest.split_at_checked(length.into())?;
    let name = std::str::from_utf8(name).ok().filter(|name| name.len() <= NAME_BYTES)?;
    *bytes = rest;
    Some((kind, Some(name).filter(|name| !name.is_empty()).map(Into::into)))
}

fn moved(mut payload: &[u8]) -> Option<Moved> {
    let observation = take_event(&mut payload)?;
    let mut moves = Vec::<Move>::new();
    while !payload.is_empty() {
        let person = take_person(&mut payload)?;
        let (kind, name) = take_kind_and_name(&mut payload)?;
        let event = if kind & IS_AS_OBSERVED != 0 {
            None
        } else if kind & IS_AS_BEFORE != 0 {
            moves.last()?.event.clone()
        } else {
            let (length, rest) = payload.split_first_chunk()?;
            let (text, rest) = rest.split_at_checked(u16::from_le_bytes(*length).into())?;
            payload = rest;
            Some(event_of(std::str::from_utf8(text).ok()?, kind)?)
        };
        moves.push(Move { person, name, by_fit: kind & IS_BY_FIT != 0, event });
    }
    Some(Moved { observation, moves })
}

fn outcome(mut payload: &[u8]) -> Option<Record> {
    let (of, person) = (take_event(&mut payload)?, take_person(&mut payload)?);
    let (&by_fit, mut payload) = payload.split_first()?;
    if by_fit != 0 {
        return Some(Record::Found { of, person });
    }
    let map = take_u64(&mut payload)?;
    Some(Record::Expected { of, person, expectation: Expectation { map, paces: None, probability: numbers(payload)? } })
}

fn belief(mut payload: &[u8]) -> Option<Record> {
    let (of, person) = (take_event(&mut payload)?, take_person(&mut payload)?);
    let map = take_u64(&mut payload)?;
    let (paces, probability) = payload.split_at_checked(4 * PACES)?;
    let paces = Some(numbers(paces)?.try_into().ok()?);
    Some(Record::Expected { of, person, expectation: Expectation { map, paces, probability: numbers(probability)? } })
}

fn numbers(bytes: &[u8]) -> Option<Vec<f32>> {
    let (numbers, rest) = bytes.as_chunks();
    rest.is_empty().then(|| numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
}

fn take_event(bytes: &mut &[u8]) -> Option<EventId> {
    Some(EventId::new(take_u64(bytes)?, take_u64(bytes)?, take_u64(bytes)?))
}

fn take_person(bytes: &mut &[u8]) -> Option<PersonId> {
    take_u32(bytes).map(PersonId)
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
