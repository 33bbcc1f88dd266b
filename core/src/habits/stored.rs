//! What was learned as bytes and as JSON: versioned, checksummed, bounded, and never believed before it was checked.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::key::Kind;
use crate::parsing::list_of_keyed;

/// Begins every file.
const MAGIC: &[u8; 8] = b"RCHABITS";
/// Changes when older programs cannot read the file.
pub(crate) const VERSION: u16 = 3;
/// The oldest one that is read: it had fewer forecasts of rooms, and scores of sets one by one.
pub(crate) const VERSION_2: u16 = 2;
const CHECKSUM_BYTES: usize = 16;
/// Bytes behind the version that say nothing.
const UNUSED_BYTES: usize = 8;
/// Largest state that is read, in bytes.
pub const BYTES_MAX: usize = 16 << 20;

/// Nobody observes more than this, in sum: a century of ten observations a second has a third of it.
const MOST: f64 = 1e11;

/// Why a stored state cannot be used. Nothing of it is.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StoredError {
    /// It is not what it says.
    #[error("this is no file of habits: it does not begin as one")]
    Foreign,
    /// It is larger than [`BYTES_MAX`].
    #[error("the habits have {bytes} bytes, more than {BYTES_MAX}: they are damaged")]
    TooLarge {
        /// How large.
        bytes: usize,
    },
    /// Another version wrote it.
    #[error(
        "the habits are of version {found}, this program reads versions {VERSION_2} and {VERSION}: use the program that wrote them, or forget them"
    )]
    Version {
        /// Which.
        found: u16,
    },
    /// Its checksum is wrong.
    #[error("the habits are damaged: their checksum is wrong; restore a copy, or begin again")]
    Checksum,
    /// It is whole, but says something impossible.
    #[error("the habits are malformed: {what}; restore a copy, or begin again")]
    Malformed {
        /// What.
        what: String,
    },
}

pub(crate) fn malformed(what: impl Into<String>) -> StoredError {
    StoredError::Malformed { what: what.into() }
}

/// A name and when it was last seen, in minutes since 1970, local time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredName {
    pub(crate) name: String,
    pub(crate) seen_min: u32,
}

/// What was learned of one horizon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredAnchor {
    pub(crate) weights: Vec<f64>,
    pub(crate) stayed: f64,
    pub(crate) sampled: f64,
    pub(crate) miss: f64,
    pub(crate) outcomes: u64,
    /// How often the truth had a probability of each class of [`super::sets`].
    pub(crate) scores: Vec<f32>,
}

/// What was learned of one person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredPerson {
    pub(crate) number: u32,
    pub(crate) slot: u8,
    pub(crate) observations: f64,
    pub(crate) stayed: f64,
    pub(crate) turned: f64,
    /// How often an object was mentioned again, of how many times.
    pub(crate) repeated: [f64; 2],
    /// Weights of the mixtures of objects, of staying, of destinations, of both bases, of mentioning again, powers of the products with what
    /// is known of them, and how far contexts are relied on.
    pub(crate) weights: Vec<f64>,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) anchors: Vec<StoredAnchor>,
}

/// What was counted in one context.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredRow {
    pub(crate) kind: u8,
    pub(crate) slot: u8,
    pub(crate) after: [u16; 3],
    pub(crate) touched_min: u32,
    pub(crate) counts: Vec<(u16, f32)>,
}

/// Everything that was learned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Stored {
    pub(crate) version: u16,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) objects: Vec<StoredName>,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) places: Vec<StoredName>,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) persons: Vec<StoredPerson>,
    #[serde(deserialize_with = "list_of_keyed")]
    pub(crate) rows: Vec<StoredRow>,
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
            [person.observations, person.stayed, person.turned].into_iter().for_each(|value| out.double(value));
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
        if !(VERSION_2..=VERSION).contains(&found) {
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

    /// Nothing impossible is in it: numbers are finite and in range. Counts of nothing, which earlier versions wrote, are dropped.
    pub(crate) fn checked(mut self) -> Result<Self, StoredError> {
        if !(VERSION_2..=VERSION).contains(&self.version) {
            return Err(StoredError::Version { found: self.version });
        }
        let positive = |value: f64| (0.0..=MOST).contains(&value);
        for person in &self.persons {
            let [repeated, turned] = person.repeated;
            let own = [person.observations, person.stayed, person.turned, repeated, turned];
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
            if !(person.stayed <= person.turned
                && repeated <= turned
                && person.anchors.iter().all(|a| a.stayed <= a.sampled && a.sampled > 0.0))
            {
                return Err(malformed(format!("person {} stayed more often than there were times", person.number)));
            }
        }
        let (mut contexts, mut symbols) = (BTreeSet::new(), BTreeSet::new());
        for row in &mut self.rows {
            if !Kind::ALL.iter().any(|kind| *kind as u8 == row.kind) {
                return Err(malformed(format!("unknown kind {} of counts", row.kind)));
            }
            if !row.counts.iter().all(|(_, count)| count.is_finite() && *count >= 0.0) {
                return Err(malformed(format!("a count of kind {} is no count", row.kind)));
            }
            row.counts.retain(|(_, count)| *count > 0.0);
            // What came twice would add up to more than was checked.
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

    /// As many as are said to follow; memory is taken only for what is there.
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
        Some(StoredPerson {
            number: self.long()?,
            slot: self.take::<1>()?[0],
            observations: self.double()?,
            stayed: self.double()?,
            turned: self.double()?,
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
