//! Habits as bytes and as JSON: versioned, checksummed, bounded, and checked before use.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::key::{Kind, NONE, Number, SLOT_MASK, key, parts};
use super::names::{Names, Numbered};
use super::pool::POWERS;
use super::{Habits, HabitsOptions, PERSONS_MAX, Person};
use crate::ids::PersonId;
use crate::parsing::{Keyed, json_says, list_of_keyed};

const MAGIC: &[u8; 8] = b"RCHABITS";
/// Changes when older programs cannot read the file.
pub(crate) const VERSION: u16 = 4;
/// The oldest readable version. Versions 2 and 3 had other experts and finer classes of time spent; version 2 had the scores of sets one by one.
const OLDEST: u16 = 2;
const CHECKSUM_BYTES: usize = 16;
/// Unused bytes after the version.
const UNUSED_BYTES: usize = 8;
/// Bytes of each person that only earlier versions use.
const UNUSED_OF_PERSON: usize = 16;
/// Largest readable state, in bytes.
pub const BYTES_MAX: usize = 16 << 20;

/// Greatest sum of observations: ten observations a second for a century make a third of it.
const MOST: f64 = 1e11;

/// Why a stored state cannot be used; it is rejected as a whole.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StoredError {
    /// It does not begin with the magic number.
    #[error("this is no file of habits: it does not begin as one")]
    Foreign,
    /// It is larger than [`BYTES_MAX`].
    #[error("the habits have {bytes} bytes, more than {BYTES_MAX}: they are damaged")]
    TooLarge {
        /// Its size.
        bytes: usize,
    },
    /// Another version wrote it.
    #[error(
        "the habits are of version {found}, this program reads versions {OLDEST} to {VERSION}: use the program that wrote them, or forget them"
    )]
    Version {
        /// Its version.
        found: u16,
    },
    /// Its checksum is wrong.
    #[error("the habits are damaged: their checksum is wrong; restore a copy, or begin again")]
    Checksum,
    /// The checksum is right, but a value is impossible.
    #[error("the habits are malformed: {what}; restore a copy, or begin again")]
    Malformed {
        /// The impossible value.
        what: String,
    },
}

pub(crate) fn malformed(what: impl Into<String>) -> StoredError {
    StoredError::Malformed { what: what.into() }
}

/// A name of a thing or place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredName {
    /// The name.
    pub name: String,
    /// The minute when it was last seen, since 1970, local time.
    pub seen_min: u32,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredAnchor {
    /// Empty since version 4: these are part of the person's weights.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) weights: Vec<f64>,
    pub(crate) stayed: f64,
    pub(crate) sampled: f64,
    pub(crate) miss: f64,
    pub(crate) outcomes: u64,
    /// Weighted number of true places per class of [`super::sets`].
    pub(crate) scores: Vec<f32>,
}

/// A person's model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredPerson {
    /// The person's number.
    pub number: u32,
    pub(crate) slot: u8,
    pub(crate) observations: f64,
    /// Repeated mentions, and all mentions.
    pub(crate) repeated: [f64; 2],
    /// The values of [`Person::learned`] in sequence.
    pub(crate) weights: Vec<f64>,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) anchors: Vec<StoredAnchor>,
}

/// The counts of the symbols that followed a context.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredRow {
    /// The kind of context.
    pub kind: u8,
    /// The person, in the lower six bits.
    pub slot: u8,
    /// The context.
    pub after: [u16; 3],
    /// The minute of the last change, since 1970, local time.
    pub touched_min: u32,
    /// The symbols with their counts as of that minute.
    pub counts: Vec<(u16, f32)>,
}

/// Habits as values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stored {
    /// The version of the program's habits.
    pub version: u16,
    /// The things.
    #[serde(deserialize_with = "list_of_keyed")]
    pub objects: Vec<StoredName>,
    /// The places.
    #[serde(deserialize_with = "list_of_keyed")]
    pub places: Vec<StoredName>,
    /// The persons.
    #[serde(deserialize_with = "list_of_keyed")]
    pub persons: Vec<StoredPerson>,
    /// The counts.
    #[serde(deserialize_with = "list_of_keyed")]
    pub rows: Vec<StoredRow>,
}

impl Stored {
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut out = Writer(Vec::with_capacity(64 * self.rows.len() + 4096));
        out.0.extend_from_slice(MAGIC);
        out.0.extend_from_slice(&self.version.to_le_bytes());
        out.0.extend_from_slice(&[0; UNUSED_BYTES]);
        for names in [&self.objects, &self.places] {
            out.length(names.len());
            for StoredName { name, seen_min } in names {
                out.length(name.len());
                out.0.extend_from_slice(name.as_bytes());
                out.0.extend_from_slice(&seen_min.to_le_bytes());
            }
        }
        out.length(self.persons.len());
        for person in &self.persons {
            out.0.extend_from_slice(&person.number.to_le_bytes());
            out.0.push(person.slot);
            out.double(person.observations);
            out.0.extend_from_slice(&[0; UNUSED_OF_PERSON]);
            person.repeated.into_iter().for_each(|value| out.double(value));
            out.doubles(&person.weights);
            out.length(person.anchors.len());
            for anchor in &person.anchors {
                out.doubles(&anchor.weights);
                [anchor.stayed, anchor.sampled, anchor.miss].into_iter().for_each(|value| out.double(value));
                out.0.extend_from_slice(&anchor.outcomes.to_le_bytes());
                out.length(anchor.scores.len());
                anchor.scores.iter().for_each(|score| out.0.extend_from_slice(&score.to_le_bytes()));
            }
        }
        out.length(self.rows.len());
        for row in &self.rows {
            out.0.extend_from_slice(&[row.kind, row.slot]);
            row.after.iter().for_each(|number| out.0.extend_from_slice(&number.to_le_bytes()));
            out.0.extend_from_slice(&row.touched_min.to_le_bytes());
            out.length(row.counts.len());
            for (symbol, count) in &row.counts {
                out.0.extend_from_slice(&symbol.to_le_bytes());
                out.0.extend_from_slice(&count.to_le_bytes());
            }
        }
        let sum = checksum(&out.0);
        out.0.extend_from_slice(&sum);
        out.0
    }

    /// Reads and checks bytes that [`Stored::to_bytes`] wrote.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Result<Self, StoredError> {
        if bytes.len() > BYTES_MAX {
            return Err(StoredError::TooLarge { bytes: bytes.len() });
        }
        let Some((magic, rest)) = bytes.split_first_chunk::<8>() else { return Err(StoredError::Foreign) };
        if magic != MAGIC {
            return Err(StoredError::Foreign);
        }
        let Some((version, _)) = rest.split_first_chunk::<2>() else { return Err(StoredError::Checksum) };
        let found = u16::from_le_bytes(*version);
        if !(OLDEST..=VERSION).contains(&found) {
            return Err(StoredError::Version { found });
        }
        let Some((body, sum)) = bytes.split_last_chunk::<CHECKSUM_BYTES>() else { return Err(StoredError::Checksum) };
        if checksum(body) != *sum {
            return Err(StoredError::Checksum);
        }
        let mut read = Reader(body.get(MAGIC.len() + 2..).unwrap_or_default());
        let stored = read.stored(found).ok_or_else(|| malformed("it ends early"))?;
        if !read.0.is_empty() {
            return Err(malformed(format!("{} bytes are left over", read.0.len())));
        }
        stored.checked()
    }

    /// Converts an earlier version: weights of experts are learned again, and counts of removed kinds are dropped.
    fn convert(&mut self) {
        for person in &mut self.persons {
            person.weights.clear();
            if self.version == OLDEST {
                person
                    .anchors
                    .iter_mut()
                    .for_each(|anchor| (anchor.miss, anchor.outcomes, anchor.scores) = (f64::NAN, 0, Vec::new()));
            }
        }
        // The classes of pace are others now.
        self.rows.retain(|row| Kind::of(row.kind).map_or(row.kind > 31, |kind| kind != Kind::RoomDwellPace));
        let mut coarser: BTreeMap<_, StoredRow> = BTreeMap::new();
        for mut row in std::mem::take(&mut self.rows) {
            // Two former classes of time spent are one class.
            match Kind::of(row.kind) {
                Some(Kind::Stay | Kind::StayPlace | Kind::StayPlaceHour) => row.after[1] = row.after[1].div_ceil(2),
                // Earlier versions counted weekends separately.
                Some(Kind::ObjectHour) => row.after[1] = NONE,
                Some(Kind::LaterDwell) => row.after[1] = row.after[1] & 0xff00 | (row.after[1] & 0xff).div_ceil(2),
                _ => {
                    self.rows.push(row);
                    continue;
                }
            }
            let empty = || StoredRow { counts: Vec::new(), ..row.clone() };
            let own = coarser.entry((row.kind, row.slot, row.after)).or_insert_with(empty);
            own.touched_min = own.touched_min.max(row.touched_min);
            for (symbol, count) in row.counts {
                match own.counts.iter_mut().find(|(known, _)| *known == symbol) {
                    Some((_, known)) => *known += count,
                    None => own.counts.push((symbol, count)),
                }
            }
        }
        self.rows.extend(coarser.into_values());
    }

    /// Checks that all numbers are finite and in range. Drops counts of no symbol, which earlier versions wrote.
    pub(crate) fn checked(mut self) -> Result<Self, StoredError> {
        if !(OLDEST..=VERSION).contains(&self.version) {
            return Err(StoredError::Version { found: self.version });
        }
        let positive = |value: f64| (0.0..=MOST).contains(&value);
        for person in &self.persons {
            let [repeated, turned] = person.repeated;
            let own = [person.observations, repeated, turned];
            let of_anchors = person.anchors.iter().flat_map(|anchor| [anchor.stayed, anchor.sampled]);
            if !own.into_iter().chain(of_anchors).all(positive) {
                return Err(malformed(format!("a count of person {} is no count", person.number)));
            }
            if person.anchors.iter().any(|anchor| anchor.outcomes as f64 > MOST) {
                return Err(malformed(format!(
                    "sets of person {} have more outcomes than there can be",
                    person.number
                )));
            }
            if repeated > turned || !person.anchors.iter().all(|a| a.stayed <= a.sampled && a.sampled > 0.0) {
                return Err(malformed(format!("person {} stayed more often than there were times", person.number)));
            }
        }
        if self.version < VERSION {
            self.convert();
        }
        let (mut contexts, mut symbols) = (BTreeSet::new(), BTreeSet::new());
        for row in &mut self.rows {
            if Kind::of(row.kind).is_none() {
                return Err(malformed(format!("unknown kind {} of counts", row.kind)));
            }
            if !row.counts.iter().all(|(_, count)| count.is_finite() && *count >= 0.0) {
                return Err(malformed(format!("a count of kind {} is no count", row.kind)));
            }
            row.counts.retain(|(_, count)| *count > 0.0);
            // Duplicates could add up to more than the checked limit.
            symbols.clear();
            let once = row.counts.iter().all(|(symbol, _)| symbols.insert(*symbol));
            let total: f64 = row.counts.iter().map(|(_, count)| f64::from(*count)).sum();
            if !once || total > MOST || !contexts.insert((row.kind, row.slot, row.after)) {
                return Err(malformed(format!(
                    "counts of kind {} come twice, or are more than there can be",
                    row.kind
                )));
            }
        }
        Ok(self)
    }
}

fn checksum(bytes: &[u8]) -> [u8; CHECKSUM_BYTES] {
    let digest = Sha256::digest(bytes);
    std::array::from_fn(|at| digest[at])
}

struct Writer(Vec<u8>);

impl Writer {
    fn length(&mut self, length: usize) {
        self.0.extend_from_slice(&u32::try_from(length).unwrap_or(u32::MAX).to_le_bytes());
    }

    fn double(&mut self, value: f64) {
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn doubles(&mut self, values: &[f64]) {
        self.length(values.len());
        values.iter().for_each(|value| self.double(*value));
    }
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    fn long(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn double(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    /// Reads a list; memory grows only with the bytes that are present.
    fn list<T>(&mut self, mut one: impl FnMut(&mut Self) -> Option<T>) -> Option<Vec<T>> {
        let length = self.long()?;
        let mut list = Vec::new();
        for _ in 0..length {
            list.push(one(self)?);
        }
        Some(list)
    }

    fn name(&mut self) -> Option<StoredName> {
        let length = self.long()? as usize;
        let (name, rest) = self.0.split_at_checked(length)?;
        self.0 = rest;
        Some(StoredName { name: String::from_utf8(name.to_vec()).ok()?, seen_min: self.long()? })
    }

    fn anchor(&mut self) -> Option<StoredAnchor> {
        Some(StoredAnchor {
            weights: self.list(Self::double)?,
            stayed: self.double()?,
            sampled: self.double()?,
            miss: self.double()?,
            outcomes: self.take().map(u64::from_le_bytes)?,
            scores: self.list(|read| read.take().map(f32::from_le_bytes))?,
        })
    }

    fn person(&mut self) -> Option<StoredPerson> {
        let (number, slot, observations) = (self.long()?, self.take::<1>()?[0], self.double()?);
        self.take::<UNUSED_OF_PERSON>()?;
        Some(StoredPerson {
            number,
            slot,
            observations,
            repeated: [self.double()?, self.double()?],
            weights: self.list(Self::double)?,
            anchors: self.list(Self::anchor)?,
        })
    }

    fn row(&mut self) -> Option<StoredRow> {
        let [kind, slot] = self.take()?;
        let number = |read: &mut Self| read.take().map(u16::from_le_bytes);
        Some(StoredRow {
            kind,
            slot,
            after: [number(self)?, number(self)?, number(self)?],
            touched_min: self.long()?,
            counts: self.list(|read| Some((number(read)?, read.take().map(f32::from_le_bytes)?)))?,
        })
    }

    fn stored(&mut self, version: u16) -> Option<Stored> {
        self.take::<UNUSED_BYTES>()?;
        Some(Stored {
            version,
            objects: self.list(Self::name)?,
            places: self.list(Self::name)?,
            persons: self.list(Self::person)?,
            rows: self.list(Self::row)?,
        })
    }
}

enum Learned<'a> {
    /// Weights, which sum to one.
    Weights(&'a mut [f64]),
    /// Powers, each with its information.
    Powers(&'a mut [[f64; 2]]),
}

impl Person {
    /// The learned numbers, always in the same order.
    fn learned(&mut self) -> Vec<Learned<'_>> {
        let Self { things, rooms, stays, .. } = self;
        let mut all = vec![
            Learned::Weights(things.pool.mixture.weights_mut()),
            Learned::Powers(&mut things.pool.powers),
            Learned::Weights(things.again.weights_mut()),
        ];
        for pool in [&mut rooms.staying, &mut rooms.destination] {
            all.extend([Learned::Weights(pool.mixture.weights_mut()), Learned::Powers(&mut pool.powers)]);
        }
        all.extend(stays.anchors.iter_mut().map(|anchor| Learned::Weights(anchor.mixture.weights_mut())));
        all
    }

    fn stored(&mut self) -> StoredPerson {
        let weights = self.learned().into_iter().flat_map(|learned| match learned {
            Learned::Weights(weights) => weights.to_vec(),
            Learned::Powers(powers) => powers.as_flattened().to_vec(),
        });
        let weights = weights.collect();
        let anchors = self.stays.anchors.iter().map(|anchor| {
            let ((miss, outcomes, scores), [stayed, sampled]) = (anchor.sets.state(), anchor.stayed);
            StoredAnchor { weights: Vec::new(), stayed, sampled, miss, outcomes, scores: scores.collect() }
        });
        StoredPerson {
            number: self.number.0,
            slot: self.slot,
            observations: self.observations,
            repeated: self.things.repeated,
            weights,
            anchors: anchors.collect(),
        }
    }

    /// Restores a person; impossible numbers are learned again.
    fn restore(&mut self, from: &StoredPerson) -> Result<(), StoredError> {
        self.observations = from.observations;
        self.things.repeated = [from.repeated[0], from.repeated[1].max(1.0)];
        let mut rest = from.weights.as_slice();
        for learned in if rest.is_empty() { Vec::new() } else { self.learned() } {
            let length = match &learned {
                Learned::Weights(own) => own.len(),
                Learned::Powers(own) => own.as_flattened().len(),
            };
            let Some((given, after)) = rest.split_at_checked(length) else {
                return Err(malformed(format!("weights of person {} are missing", from.number)));
            };
            rest = after;
            let are_possible =
                |[power, information]: &[f64; 2]| POWERS.contains(power) && (0.0..=MOST).contains(information);
            match learned {
                Learned::Weights(own)
                    if given.iter().all(|weight| *weight >= 0.0) && (given.iter().sum::<f64>() - 1.0).abs() < 1e-6 =>
                {
                    own.copy_from_slice(given);
                }
                Learned::Powers(own) if given.as_chunks().0.iter().all(are_possible) => {
                    own.copy_from_slice(given.as_chunks().0)
                }
                Learned::Weights(_) | Learned::Powers(_) => {}
            }
        }
        if from.anchors.len() != self.stays.anchors.len() {
            return Err(malformed(format!("horizons of person {} are missing", from.number)));
        }
        for (anchor, from) in self.stays.anchors.iter_mut().zip(&from.anchors) {
            anchor.stayed = [from.stayed, from.sampled];
            anchor.sets.restore(from.miss, from.outcomes, &from.scores);
        }
        Ok(())
    }
}

impl Habits {
    /// The habits as values.
    #[must_use]
    pub fn stored(&self) -> Stored {
        let names = |names: &Names| {
            names.iter().map(|(name, seen_min)| StoredName { name: name.to_owned(), seen_min }).collect()
        };
        let row = |(key, touched_min, counts): (u64, u32, Vec<(u16, f32)>)| {
            let (kind, slot, after) = parts(key)?;
            Some(StoredRow { kind: kind as u8, slot, after, touched_min, counts })
        };
        Stored {
            version: VERSION,
            objects: names(&self.home.things),
            places: names(&self.home.places),
            persons: self.persons.clone().iter_mut().map(Person::stored).collect(),
            rows: self.counts.rows().into_iter().filter_map(row).collect(),
        }
    }

    /// Restores stored habits, without a map and without places of persons.
    fn restore(options: HabitsOptions, stored: &Stored) -> Result<Self, StoredError> {
        let mut habits = Self::new(options);
        habits.is_converted = stored.version < VERSION;
        let names = [(&stored.objects, &mut habits.home.things, 0), (&stored.places, &mut habits.home.places, 1)];
        for (names, own, known) in names {
            for (at, StoredName { name, seen_min }) in names.iter().enumerate() {
                let is_known = at < known && own.iter().nth(at).is_some_and(|(own, _)| own == name);
                let fits = is_known || own.add(name.clone(), *seen_min) == Numbered::As(at as u16);
                own.date(at as u16, *seen_min);
                if !fits {
                    return Err(malformed(format!("the name {name:?} comes twice, is too long, or is one too many")));
                }
            }
        }
        let mut slots = BTreeSet::new();
        for from in &stored.persons {
            let number = PersonId(from.number);
            let is_known = habits.known_person(number).is_some();
            if is_known || usize::from(from.slot) >= PERSONS_MAX || !slots.insert(from.slot) {
                return Err(malformed(format!(
                    "person {} comes twice, or in a place that does not exist",
                    from.number
                )));
            }
            let mut person = Person::new(number, from.slot, &options);
            person.restore(from)?;
            habits.persons.push(person);
        }
        for row in &stored.rows {
            let Some(kind) = Kind::of(row.kind) else { continue };
            let exists = |(is, number): (Number, u16)| match is {
                Number::Object => number == NONE || usize::from(number) < habits.home.things.len(),
                Number::Place => number == NONE || usize::from(number) < habits.home.places.len(),
                Number::Plain => true,
            };
            let [first, second, third, counted] = kind.layout();
            let is_whole = slots.contains(&(row.slot & SLOT_MASK))
                && [first, second, third].into_iter().zip(row.after).all(exists)
                && row.counts.iter().all(|(symbol, _)| *symbol != NONE && exists((counted, *symbol)));
            if !is_whole {
                return Err(malformed("a count names a person or a thing that has no name"));
            }
            for (symbol, count) in &row.counts {
                habits.counts.add(key(kind, row.slot, row.after), *symbol, f64::from(*count), row.touched_min);
            }
        }
        Ok(habits)
    }

    /// Whether an earlier version wrote the file: counts are kept, and weights of experts are learned again.
    #[must_use]
    pub fn is_converted(&self) -> bool {
        self.is_converted
    }

    /// Habits as bytes with a version and a checksum: counts of names and hours, no sentences.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        self.stored().to_bytes()
    }

    /// Reads bytes of [`Habits::to_bytes`]. If there is more than the limits of `options` allow, the least useful counts are dropped.
    ///
    /// # Errors
    /// [`StoredError`] when the bytes are damaged, of another version, or impossible. Nothing is used then.
    pub fn from_bytes(options: HabitsOptions, bytes: &[u8]) -> Result<Self, StoredError> {
        Self::restore(options, &Stored::from_bytes(bytes)?)
    }

    /// Habits as JSON for people and other programs.
    ///
    /// # Errors
    /// When writing JSON fails: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        serde_json::to_string(&self.stored()).map_err(|error| malformed(error.to_string()))
    }

    /// Reads JSON of [`Habits::to_json`].
    ///
    /// # Errors
    /// As [`Habits::from_bytes`].
    pub fn from_json(options: HabitsOptions, json: &str) -> Result<Self, StoredError> {
        if json.len() > 4 * BYTES_MAX {
            return Err(StoredError::TooLarge { bytes: json.len() });
        }
        let Keyed(stored): Keyed<Stored> = serde_json::from_str(json).map_err(|error| malformed(json_says(&error)))?;
        Self::from_stored(options, stored)
    }

    /// Habits of these values.
    ///
    /// # Errors
    /// As [`Habits::from_bytes`].
    pub fn from_stored(options: HabitsOptions, stored: Stored) -> Result<Self, StoredError> {
        Self::restore(options, &stored.checked()?)
    }
}
