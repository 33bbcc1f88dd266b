//! The records of the journal, as bytes.
//!
//! A record is four letters, the payload's length (u32), the CRC-32 of the payload (u32), the payload; integers little endian. Reading skips
//! what is damaged and goes on at the next record whose checksum is right.
//!
//! | letters | payload |
//! | --- | --- |
//! | `RCJ1` | a sentence: source, epoch, sequence, observed_ns, observed_unix_ns (u64 each), person (u32), the machine's boot id (16 bytes), the sentence |
//! | `RCJ3` | the same with a name, presence or an attribution: before the text come what it is (u8; bit 0: presence, bit 1: the person was found by fit, bit 4: the text is no plain sentence) and the person's name (u8 of bytes, the bytes). Former versions wrote more behind a presence and before it, which is not read |
//! | `RCJ2`, `RCJ4` | `RCJ1` and `RCJ3` carried over, see below |
//! | `RCJ5` | what became of an observation that was written before: its source, epoch, sequence (u64 each), the person that it is of (u32), whether that was found by fit (u8), the map's fingerprint (its first 8 bytes), and per room the probability that the model then gave (f32) |
//! | `RCJ6` | whose a start of a source is: its source and epoch (u64 each), and the port that speaks for it (16 bytes) |
//! | `RCJ7`, `RCJ8` | `RCJ1` and `RCJ3` of what was last said of a person, before all that the halves hold of it; `RCJ5` follows |
//! | `RCJ9` | that a person was forgotten then, or was a visitor and is gone by silence: the number (u32), and whether that was before all observations of the halves (u8) |
//! | `RCJB` | whom an observation moved that was written before, so that it is not read again with those who are known at a restart: its source, epoch and sequence (u64 each), and for each person whom it moved, in their order: the number (u32; all ones where it says that a room is empty), what it is (u8; bits 0 and 1 as in `RCJ3`, bit 2: it is what was observed, bit 3: it is what the one before is), the name (u8 of bytes, the bytes), and without bits 2 and 3 what it says of them (u16 of bytes, the bytes). None where it moved nobody |
//! | `RCJA` | where a person was believed to be when the map was changed: what was observed of them last by its source, epoch and sequence (u64 each), the person (u32), the changed map's fingerprint (its first 8 bytes), for how many seconds they had then been at what they did, and the totals and counts of how long they are at one thing and in one room (f32 each), and per room of that map the probability that they were in it (f32) |

use std::borrow::Cow;

use roomcast_core::forecast::PACES;
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Sentence};
use roomcast_ipc::{MAX_ROOMS, NAME_BYTES, Sender as Port};

pub(super) const MAGIC: [u8; 4] = *b"RCJ1";
pub(super) const MAGIC_CARRIED: [u8; 4] = *b"RCJ2";
pub(super) const MAGIC_NAMED: [u8; 4] = *b"RCJ3";
pub(super) const MAGIC_NAMED_CARRIED: [u8; 4] = *b"RCJ4";
const MAGIC_OUTCOME: [u8; 4] = *b"RCJ5";
pub(super) const MAGIC_PORT: [u8; 4] = *b"RCJ6";
pub(super) const MAGIC_KEPT: [u8; 4] = *b"RCJ7";
pub(super) const MAGIC_NAMED_KEPT: [u8; 4] = *b"RCJ8";
const MAGIC_FORGOTTEN: [u8; 4] = *b"RCJ9";
const MAGIC_BELIEVED: [u8; 4] = *b"RCJA";
const MAGIC_MOVED: [u8; 4] = *b"RCJB";
/// Letters that a record may begin with.
pub(super) const MAGICS: [[u8; 4]; 11] = [
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
pub(super) const MAGICS_TAKEN: [[u8; 4]; 4] = [MAGIC, MAGIC_CARRIED, MAGIC_NAMED, MAGIC_NAMED_CARRIED];
/// Those of which a copy in each half is enough, so that they go last where there is too little room.
pub(super) const MAGICS_KEPT: [[u8; 4]; 6] =
    [MAGIC_CARRIED, MAGIC_NAMED_CARRIED, MAGIC_PORT, MAGIC_KEPT, MAGIC_NAMED_KEPT, MAGIC_FORGOTTEN];
pub(super) const HEADER_BYTES: usize = 12;
/// Where the payload of an observation has the boot that it was made in.
pub(super) const BOOT_AT: usize = 5 * 8 + 4;
pub(super) const FIXED_BYTES: usize = BOOT_AT + 16;
/// No payload is longer: a sentence has at most 1024 bytes, a statement with its names not twice as many, and a name comes with two more.
const PAYLOAD_BYTES_MAX: usize = FIXED_BYTES + 2 + NAME_BYTES + 2 * roomcast_core::narration::SENTENCE_BYTES_MAX;
/// None of whom an observation moved is longer: eight clauses, each with what it says, of all who may be known.
const MOVED_BYTES_MAX: usize = 64 << 10;
/// A port, with which `RCJ6` ends.
pub(super) const PORT_BYTES: usize = 16;
/// What `RCJ5` holds beside the rooms.
const OUTCOME_BYTES: usize = 3 * 8 + 4 + 1 + 8;
/// Bits of what a named record is.
const IS_PRESENCE: u8 = 1;
const IS_BY_FIT: u8 = 1 << 1;
/// The text is no plain sentence, so it is no presence form.
const IS_NO_FORM: u8 = 1 << 4;
/// The same of whom an observation moved: what it says of them is what was observed, or what it says of the one before.
const IS_AS_OBSERVED: u8 = 1 << 2;
const IS_AS_BEFORE: u8 = 1 << 3;

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
    /// The last event about them.
    pub last: EventId,
    /// The person.
    pub person: PersonId,
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
    /// The person; [`PersonId::SOMEBODY`] where it says that a room is empty.
    pub person: PersonId,
    /// By which name they were meant; none where that was by number, by fit, or as one of a group.
    pub name: Option<Box<str>>,
    /// Whether they were found by fit.
    pub by_fit: bool,
    /// The event of the person; `None` if it is the event as it came.
    pub event: Option<Event>,
}

impl Move {
    /// The part of a person in an event that came as `observed`.
    #[must_use]
    pub fn of(own: &Observation, observed: &Event) -> Self {
        let event = Some(&own.event).filter(|event| *event != observed).cloned();
        Self { person: own.person, name: own.name.clone(), by_fit: own.by_fit, event }
    }

    /// The part of no person, in an event that the joint filter weighed.
    #[must_use]
    pub(in crate::daemon) fn of_nobody() -> Self {
        Self { person: PersonId::SOMEBODY, name: None, by_fit: true, event: None }
    }

    /// The same of one that says that a room is empty.
    #[must_use]
    pub(in crate::daemon) fn of_a_room(own: &Observation, observed: &Event) -> Self {
        Self { person: PersonId::SOMEBODY, name: None, by_fit: false, ..Self::of(own, observed) }
    }

    /// The observation of the person, made of the one that moved them.
    #[must_use]
    pub fn apply(self, observed: &Observation) -> Observation {
        let event = self.event.unwrap_or_else(|| observed.event.clone());
        Observation { person: self.person, name: self.name, by_fit: self.by_fit, event, ..*observed }
    }
}

/// Whom an observation moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Moved {
    /// The event.
    pub observation: EventId,
    /// The persons, in the order in which they were.
    pub moves: Vec<Move>,
}

/// What became of an observation: whom it is of, and what the model said of that person after it.
#[derive(Debug, Clone, Copy)]
pub struct Outcome<'a> {
    /// The event.
    pub event: EventId,
    /// Whom it is of.
    pub person: PersonId,
    /// Whether it named nobody, and this person was found by fit.
    pub by_fit: bool,
    /// The first bytes of the map's fingerprint.
    pub map: u64,
    /// Per room the probability that the person is there next; empty where nothing was scored.
    pub probability: &'a [f64],
}

/// An observation as a record; `boot_id` names the boot that its monotonic times belong to.
#[must_use]
pub fn encode(observation: &Observation, boot_id: &[u8; 16]) -> Vec<u8> {
    let name = observation.name.as_deref().unwrap_or_default().as_bytes();
    let (is_presence, text) = text_of(&observation.event);
    let no_form = if observation.may_be_form || is_presence != 0 { 0 } else { IS_NO_FORM };
    let kind = is_presence | no_form | if observation.by_fit { IS_BY_FIT } else { 0 };
    let text = text.as_bytes();
    let named = kind != 0 || !name.is_empty();
    let mut payload = Vec::with_capacity(HEADER_BYTES + FIXED_BYTES + 2 + name.len() + text.len());
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    for number in [
        observation.source,
        observation.epoch,
        observation.sequence,
        observation.observed_ns.0,
        observation.observed_unix_ns.0,
    ] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
    payload.extend_from_slice(&observation.person.0.to_le_bytes());
    payload.extend_from_slice(boot_id);
    if named {
        // A name has at most 48 bytes.
        payload.extend_from_slice(&[kind, name.len() as u8]);
        payload.extend_from_slice(name);
    }
    payload.extend_from_slice(text);
    sealed(if named { MAGIC_NAMED } else { MAGIC }, payload)
}

/// The text of an event in a record, and whether it is a presence.
fn text_of(event: &Event) -> (u8, Cow<'_, str>) {
    match event {
        Event::Did(sentence) => (0, Cow::Borrowed(sentence.as_str())),
        presence => (IS_PRESENCE, Cow::Owned(presence.to_string())),
    }
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

/// Whom an observation moved, as a record.
#[must_use]
pub(in crate::daemon) fn encode_moved(moved: &Moved) -> Vec<u8> {
    let mut payload = vec![0; HEADER_BYTES];
    put_event(&mut payload, moved.observation);
    let mut before = None;
    for Move { person, name, by_fit, event } in &moved.moves {
        let name = name.as_deref().unwrap_or_default().as_bytes();
        let (kind, text) = match event {
            None => (IS_AS_OBSERVED, None),
            Some(event) if before == Some(event) => (IS_AS_BEFORE, None),
            Some(event) => {
                let (kind, text) = text_of(event);
                (kind, Some(text))
            }
        };
        payload.extend_from_slice(&person.0.to_le_bytes());
        // A name has at most 48 bytes.
        payload.extend_from_slice(&[kind | if *by_fit { IS_BY_FIT } else { 0 }, name.len() as u8]);
        payload.extend_from_slice(name);
        if let Some(text) = text {
            payload.extend_from_slice(&(text.len() as u16).to_le_bytes());
            payload.extend_from_slice(text.as_bytes());
        }
        before = event.as_ref();
    }
    sealed(MAGIC_MOVED, payload)
}

/// What became of an observation, as a record.
#[must_use]
pub fn encode_outcome(outcome: &Outcome<'_>) -> Vec<u8> {
    let mut payload = Vec::with_capacity(HEADER_BYTES + OUTCOME_BYTES + 4 * outcome.probability.len());
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    put_event(&mut payload, outcome.event);
    payload.extend_from_slice(&outcome.person.0.to_le_bytes());
    payload.push(u8::from(outcome.by_fit));
    payload.extend_from_slice(&outcome.map.to_le_bytes());
    for probability in outcome.probability {
        payload.extend_from_slice(&(*probability as f32).to_le_bytes());
    }
    sealed(MAGIC_OUTCOME, payload)
}

/// Where somebody was believed to be when the map was changed, as a record.
#[must_use]
pub(in crate::daemon) fn encode_believed(believed: &Believed) -> Vec<u8> {
    let Believed { last, person, map, paces, probability } = believed;
    let mut payload = Vec::with_capacity(HEADER_BYTES + OUTCOME_BYTES + 4 * (PACES + probability.len()));
    payload.extend_from_slice(&[0; HEADER_BYTES]);
    put_event(&mut payload, *last);
    payload.extend_from_slice(&person.0.to_le_bytes());
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
pub(in crate::daemon) fn encode_forgotten(person: PersonId, is_before: bool) -> Vec<u8> {
    let payload = [&[0; HEADER_BYTES][..], &person.0.to_le_bytes(), &[u8::from(is_before)]];
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

/// Every whole record with its bytes; what is none is stepped over.
pub(in crate::daemon) fn each_record<'a>(bytes: &'a [u8], mut take: impl FnMut(&'a [u8], Record)) {
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

/// The source of a whole record, and its epoch.
pub(super) fn source_of(record: &[u8]) -> (u64, u64) {
    let mut payload = record.get(HEADER_BYTES..).unwrap_or_default();
    let mut number = || take_u64(&mut payload).unwrap_or_default();
    (number(), number())
}

/// Bytes of the first of some whole records; all of them where it is none.
pub(super) fn record_bytes(records: &[u8]) -> usize {
    let length = records.get(4..).and_then(|mut rest| take_u32(&mut rest));
    length.map_or(records.len(), |length| (HEADER_BYTES + length as usize).min(records.len()))
}

/// What a record holds.
pub(in crate::daemon) enum Record {
    Observation(Observation),
    Carried(Observation),
    Outcome { event: EventId, person: PersonId, by_fit: bool, expectation: Expectation },
    Moved(Moved),
    Port { name: (u64, u64), port: Port },
    Kept(Observation),
    Forgotten { person: PersonId, is_before: bool },
}

/// The record that some bytes begin with, and how many of them it has.
pub(super) fn decode(bytes: &[u8], boot_id: &[u8; 16]) -> Option<(Record, usize)> {
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
    let EventId { source, epoch, sequence } = take_event(&mut payload)?;
    let (observed_ns, observed_unix_ns) = (take_u64(&mut payload)?, take_u64(&mut payload)?);
    let person = PersonId(take_u32(&mut payload)?);
    let (boot, mut text) = payload.split_at_checked(boot_id.len())?;
    let (mut kind, mut name) = (0, None);
    if named {
        (kind, name) = take_kind_and_name(&mut text)?;
    }
    let event = event_of(std::str::from_utf8(text).ok()?, kind)?;
    let observed_ns = if boot == boot_id { observed_ns } else { 0 };
    let by_fit = kind & IS_BY_FIT != 0;
    Some(Observation {
        person,
        name,
        by_fit,
        source,
        epoch,
        sequence,
        observed_ns: BootNs(observed_ns),
        observed_unix_ns: UnixNs(observed_unix_ns),
        count: 0,
        may_be_form: kind & IS_NO_FORM == 0,
        event,
    })
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
    let observation = take_event(&mut payload)?;
    let mut moves = Vec::<Move>::new();
    while !payload.is_empty() {
        let person = PersonId(take_u32(&mut payload)?);
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

fn decode_outcome(mut payload: &[u8]) -> Option<Record> {
    let event = take_event(&mut payload)?;
    let person = PersonId(take_u32(&mut payload)?);
    let (&by_fit, mut payload) = payload.split_first()?;
    let map = take_u64(&mut payload)?;
    let expectation = Expectation { map, paces: None, probability: take_probability(payload)? };
    Some(Record::Outcome { event, person, by_fit: by_fit != 0, expectation })
}

fn decode_believed(mut payload: &[u8]) -> Option<Record> {
    let event = take_event(&mut payload)?;
    let (person, map) = (PersonId(take_u32(&mut payload)?), take_u64(&mut payload)?);
    let mut paces = [0.0; PACES];
    for pace in &mut paces {
        *pace = f32::from_bits(take_u32(&mut payload)?);
    }
    let expectation = Expectation { map, paces: Some(paces), probability: take_probability(payload)? };
    paces.iter().all(|pace| pace.is_finite() && *pace >= 0.0).then_some(Record::Outcome {
        event,
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
    let person = PersonId(take_u32(&mut payload)?);
    matches!(payload, [0 | 1]).then(|| Record::Forgotten { person, is_before: payload == [1] })
}

fn put_event(payload: &mut Vec<u8>, event: EventId) {
    for number in [event.source, event.epoch, event.sequence] {
        payload.extend_from_slice(&number.to_le_bytes());
    }
}

fn take_event(bytes: &mut &[u8]) -> Option<EventId> {
    Some(EventId::new(take_u64(bytes)?, take_u64(bytes)?, take_u64(bytes)?))
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
