//! Habits as values, for the state database, and as JSON, for other programs: versioned, bounded, and checked before use.

use serde::{Deserialize, Serialize};

use super::context::{NONE, Number, SLOT_MASK, key, split};
use super::counts::Row;
use super::names::Names;
use super::parts::{KINDS, names_of};
use super::pool::{MOST, Pool};
use super::stays::Anchor;
use super::{Habits, HabitsOptions, PERSONS_MAX, Person};
use crate::ids::PersonId;
use crate::parsing::{Keyed, json_says, list_of_keyed};

/// Changes when older programs cannot read the state.
pub(crate) const VERSION: u16 = 7;
/// The version of 0.1.0: it had other experts, and the keys of some contexts had other numbers.
const OLDEST: u16 = 3;
/// Largest readable state, in bytes.
pub const BYTES_MAX: usize = 16 << 20;

/// Why a stored state cannot be used; it is rejected as a whole.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the habits are {0}")]
pub struct StoredError(String);

fn malformed(what: impl std::fmt::Display) -> StoredError {
    StoredError(format!("malformed: {what}; restore a copy, or begin again"))
}

/// A name of a thing or place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredName {
    /// The name.
    pub name: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StoredAnchor {
    pub(crate) stayed: f64,
    pub(crate) sampled: f64,
    pub(crate) miss: f64,
    /// Decayed number of true places per class of [`super::sets`].
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
    /// The learned weights of the person's mixtures, in the order of [`Person::pools`].
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

impl Person {
    /// The mixtures, always in the same sequence.
    fn pools(&mut self) -> impl Iterator<Item = &mut Pool> {
        let Self { things, rooms, stays, .. } = self;
        let nexts = [&mut things.other, &mut things.same, &mut rooms.same, &mut rooms.other];
        nexts.into_iter().chain(stays.anchors.iter_mut().map(|anchor| &mut anchor.pool))
    }

    fn stored(mut self) -> StoredPerson {
        let weights = self.pools().flat_map(|pool| pool.learned().collect::<Vec<_>>()).collect();
        let Self { number, slot, observations, things, stays, .. } = self;
        let anchors = stays.anchors.iter().map(|Anchor { sets, stayed: [stayed, sampled], .. }| {
            let (miss, scores) = sets.state();
            StoredAnchor { stayed: *stayed, sampled: *sampled, miss, scores }
        });
        let (repeated, anchors) = (things.repeated, anchors.collect());
        StoredPerson { number: number.0, slot, observations, repeated, weights, anchors }
    }

    /// A person of these values; `None` if they are impossible. Impossible weights are learned again, and all of an earlier version.
    fn restored(from: &StoredPerson, version: u16, options: &HabitsOptions) -> Option<Self> {
        let StoredPerson { number, slot, observations, repeated, weights, anchors } = from;
        let mut person = Self::new(PersonId(*number), *slot, options);
        let pairs = || anchors.iter().map(|anchor| [anchor.stayed, anchor.sampled]).chain([*repeated]);
        let is_possible = pairs().flatten().chain([*observations]).all(|value| (0.0..=MOST).contains(&value))
            && pairs().all(|[some, all]| some <= all)
            && anchors.len() == person.stays.anchors.len()
            && usize::from(*slot) < PERSONS_MAX;
        is_possible.then_some(())?;
        (person.observations, person.things.repeated) = (*observations, [repeated[0], repeated[1].max(1.0)]);
        let mut rest = weights.as_slice();
        for pool in person.pools().filter(|_| version == VERSION) {
            rest = pool.restore(rest)?;
        }
        for (own, anchor) in person.stays.anchors.iter_mut().zip(anchors) {
            own.stayed = [anchor.stayed, anchor.sampled.max(1.0)];
            if version > OLDEST {
                own.sets.restore(anchor.miss, &anchor.scores);
            }
        }
        Some(person)
    }
}

impl Habits {
    /// The habits as values: counts of names and hours, no sentences.
    #[must_use]
    pub fn stored(&self) -> Stored {
        let names = |names: &Names| names.names.iter().map(|name| StoredName { name: name.clone() }).collect();
        let row = |(key, Row { touched_min, counts }): (u64, Row)| {
            let (kind, slot, after) = split(key);
            StoredRow { kind, slot, after, touched_min, counts }
        };
        Stored {
            version: VERSION,
            objects: names(&self.home.things),
            places: names(&self.home.places),
            persons: self.persons.iter().cloned().map(Person::stored).collect(),
            rows: self.counts.rows().into_iter().map(row).collect(),
        }
    }

    /// Habits of these values, without a map and without places of persons. If there is more than the limits of `options` allow, the least useful
    /// counts are dropped. Of earlier versions the counts stay, except for those of removed contexts and of keys that had other numbers.
    ///
    /// # Errors
    /// [`StoredError`] when the values are of another version, or impossible.
    pub fn from_stored(options: HabitsOptions, stored: Stored) -> Result<Self, StoredError> {
        let Stored { version, objects, places, persons, rows } = stored;
        if !(OLDEST..=VERSION).contains(&version) {
            return Err(StoredError(format!(
                "of version {version}, this program reads versions {OLDEST} to {VERSION}: use the program that wrote them, or forget them"
            )));
        }
        let mut habits = Self::new(options);
        for (names, own) in [(objects, &mut habits.home.things), (places, &mut habits.home.places)] {
            for (at, StoredName { name }) in names.into_iter().enumerate() {
                if own.names.get(at) != Some(&name) && own.add(name.clone(), || None) != Some(at as u16) {
                    let text = format_args!("the name {name:?} comes twice, is too long, or is one too many");
                    return Err(malformed(text));
                }
            }
        }
        for from in &persons {
            let is_known = |other: &Person| other.number.0 == from.number || other.slot == from.slot;
            let person = Person::restored(from, version, &options).filter(|_| !habits.persons.iter().any(is_known));
            let impossible = || malformed(format_args!("person {} comes twice or has impossible values", from.number));
            habits.persons.push(person.ok_or_else(impossible)?);
        }
        for StoredRow { kind, slot, after, touched_min, mut counts } in rows {
            // A removed context, or one with other numbers.
            if KINDS[usize::from(kind)].is_none() || version == OLDEST && [11, 19, 20, 21, 26, 31].contains(&kind) {
                continue;
            }
            // Earlier versions wrote counts of no symbol.
            counts.retain(|(_, count)| *count != 0.0);
            let total: f64 = counts.iter().map(|(_, count)| f64::from(*count)).sum();
            let key = key(kind, slot, after);
            let exists = |(is, number): (Number, u16)| match is {
                Number::Thing => number == NONE || usize::from(number) < habits.home.things.names.len(),
                Number::Place => number == NONE || usize::from(number) < habits.home.places.names.len(),
                Number::Plain => true,
            };
            let is_count =
                |(symbol, count): &(u16, f32)| *count > 0.0 && *symbol != NONE && names_of(key, *symbol).all(exists);
            let is_possible = total <= MOST
                && counts.iter().all(is_count)
                && habits.persons.iter().any(|person| person.slot == slot & SLOT_MASK)
                && habits.counts.get(key, touched_min).is_none();
            if !is_possible {
                return Err(malformed(format_args!("counts of kind {kind} come twice or have impossible values")));
            }
            counts.iter().for_each(|(symbol, count)| habits.counts.add(key, *symbol, f64::from(*count), touched_min));
        }
        Ok(habits)
    }

    /// The habits as JSON.
    ///
    /// # Errors
    /// When writing JSON fails: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        serde_json::to_string(&self.stored()).map_err(malformed)
    }

    /// Reads JSON of [`Habits::to_json`].
    ///
    /// # Errors
    /// As [`Habits::from_stored`].
    pub fn from_json(options: HabitsOptions, json: &str) -> Result<Self, StoredError> {
        let Keyed(stored): Keyed<Stored> = serde_json::from_str(json).map_err(|error| malformed(json_says(&error)))?;
        Self::from_stored(options, stored)
    }
}
