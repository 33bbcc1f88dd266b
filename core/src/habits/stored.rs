//! Habits as values, for the state database, and as JSON, for other programs: versioned, bounded, and checked before use.

use serde::{Deserialize, Serialize};

use super::names::Names;
use super::parts::{MOST, NONE, Number, Part, SLOT_MASK, key, split};
use super::pool::Pool;
use super::{Habits, HabitsOptions, PERSONS_MAX, Person};
use crate::ids::PersonId;
use crate::parsing::{Keyed, json_says, list_of_keyed};

/// Changes when older programs cannot read the state.
pub(crate) const VERSION: u16 = 5;
/// The version of 0.1.0: it had other experts, and the keys of some contexts had other numbers.
const OLDEST: u16 = 3;
/// Largest readable state, in bytes.
pub const BYTES_MAX: usize = 16 << 20;

/// Why a stored state cannot be used; it is rejected as a whole.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum StoredError {
    /// Another version wrote it.
    #[error(
        "the habits are of version {found}, this program reads versions {OLDEST} to {VERSION}: use the program that wrote them, or forget them"
    )]
    Version {
        /// Its version.
        found: u16,
    },
    /// A value is impossible.
    #[error("the habits are malformed: {what}; restore a copy, or begin again")]
    Malformed {
        /// The impossible value.
        what: String,
    },
}

fn malformed(what: impl Into<String>) -> StoredError {
    StoredError::Malformed { what: what.into() }
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

impl Stored {
    /// Converts the version of 0.1.0: its counts stay, except for those with other numbers in their keys; the rest is learned again.
    fn convert(&mut self) {
        for person in &mut self.persons {
            person.weights.clear();
            for anchor in &mut person.anchors {
                (anchor.miss, anchor.scores) = (f64::NAN, Vec::new());
            }
        }
        use Part::{LaterByDwell, RoomByDwell, Stay, StayByHour, StayByPlace, ThingAtHour};
        let others = [ThingAtHour, RoomByDwell, Stay, StayByPlace, StayByHour, LaterByDwell];
        self.rows.retain(|row| others.iter().all(|part| *part as u8 != row.kind));
    }
}

impl StoredPerson {
    fn check(&self) -> Result<(), StoredError> {
        let [repeated, turned] = self.repeated;
        let of_anchors = self.anchors.iter().flat_map(|a| [a.stayed, a.sampled]);
        let mut all = [self.observations, repeated, turned].into_iter().chain(of_anchors);
        if !all.all(|value| (0.0..=MOST).contains(&value)) {
            return Err(malformed(format!("a count of person {} is no count", self.number)));
        }
        if repeated > turned || !self.anchors.iter().all(|a| a.stayed <= a.sampled && a.sampled > 0.0) {
            return Err(malformed(format!("person {} stayed more often than there were times", self.number)));
        }
        Ok(())
    }
}

impl StoredRow {
    /// Checks the counts, and drops those of no symbol, which earlier versions wrote.
    fn check(&mut self) -> Result<(), StoredError> {
        self.counts.retain(|(_, count)| *count != 0.0);
        self.counts.sort_by_key(|(symbol, _)| *symbol);
        let is_once = self.counts.windows(2).all(|pair| pair[0].0 < pair[1].0);
        let total: f64 = self.counts.iter().map(|(_, count)| f64::from(*count)).sum();
        let is_sound = is_once && total <= MOST && self.counts.iter().all(|(_, count)| *count > 0.0);
        if !is_sound {
            return Err(malformed(format!("counts of kind {} are no counts, come twice, or are too large", self.kind)));
        }
        Ok(())
    }
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
        let anchors = self.stays.anchors.iter().map(|anchor| {
            let ((miss, scores), [stayed, sampled]) = (anchor.sets.state(), anchor.stayed);
            StoredAnchor { stayed, sampled, miss, scores }
        });
        StoredPerson {
            number: self.number.0,
            slot: self.slot,
            observations: self.observations,
            repeated: self.repeated,
            weights,
            anchors: anchors.collect(),
        }
    }

    /// Restores a person; impossible weights are learned again.
    fn restore(&mut self, from: &StoredPerson) -> Result<(), StoredError> {
        self.observations = from.observations;
        self.repeated = [from.repeated[0], from.repeated[1].max(1.0)];
        let mut rest = from.weights.as_slice();
        for pool in self.pools().filter(|_| !from.weights.is_empty()) {
            let missing = || malformed(format!("weights of person {} are missing", from.number));
            rest = pool.restore(rest).ok_or_else(missing)?;
        }
        if from.anchors.len() != self.stays.anchors.len() {
            return Err(malformed(format!("horizons of person {} are missing", from.number)));
        }
        for (anchor, from) in self.stays.anchors.iter_mut().zip(&from.anchors) {
            anchor.stayed = [from.stayed, from.sampled];
            anchor.sets.restore(from.miss, &from.scores);
        }
        Ok(())
    }
}

impl Habits {
    /// The habits as values: counts of names and hours, no sentences.
    #[must_use]
    pub fn stored(&self) -> Stored {
        let names = |names: &Names| names.names().iter().map(|name| StoredName { name: name.clone() }).collect();
        let row = |(key, touched_min, counts): (u64, u32, Vec<(u16, f32)>)| {
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
    /// counts are dropped.
    ///
    /// # Errors
    /// [`StoredError`] when the values are of another version, or impossible. Then the habits stay as they were.
    pub fn from_stored(options: HabitsOptions, mut stored: Stored) -> Result<Self, StoredError> {
        let mut habits = Self::new(options);
        match stored.version {
            OLDEST => stored.convert(),
            found if !(OLDEST..=VERSION).contains(&found) => return Err(StoredError::Version { found }),
            _ => {}
        }
        let names = [(&stored.objects, &mut habits.home.things, 0), (&stored.places, &mut habits.home.places, 1)];
        for (names, own, known) in names {
            for (at, StoredName { name }) in names.iter().enumerate() {
                let is_known = at < known && own.names().get(at) == Some(name);
                if !is_known && own.add(name.clone()) != Some(at as u16) {
                    return Err(malformed(format!("the name {name:?} comes twice, is too long, or is one too many")));
                }
            }
        }
        for from in &stored.persons {
            from.check()?;
            let number = PersonId(from.number);
            let is_known = habits.persons.iter().any(|other| other.number == number || other.slot == from.slot);
            if is_known || usize::from(from.slot) >= PERSONS_MAX {
                return Err(malformed(format!("person {number} comes twice, or in a place that does not exist")));
            }
            let mut person = Person::new(number, from.slot, &options);
            person.restore(from)?;
            habits.persons.push(person);
        }
        for mut row in stored.rows {
            row.check()?;
            // A removed context.
            let Some((part, [first, second, third, counted])) = Part::context(row.kind) else { continue };
            let exists = |(is, number): (Number, u16)| match is {
                Number::Object => number == NONE || usize::from(number) < habits.home.things.names().len(),
                Number::Place => number == NONE || usize::from(number) < habits.home.places.names().len(),
                Number::Plain => true,
            };
            let is_whole = habits.persons.iter().any(|person| person.slot == row.slot & SLOT_MASK)
                && [first, second, third].into_iter().zip(row.after).all(exists)
                && row.counts.iter().all(|(symbol, _)| *symbol != NONE && exists((counted, *symbol)));
            if !is_whole {
                return Err(malformed("a count names a person or a thing that has no name"));
            }
            let key = key(part, row.slot, row.after);
            if habits.counts.get(key, row.touched_min).is_some() {
                return Err(malformed(format!("counts of kind {} come twice", row.kind)));
            }
            for (symbol, count) in &row.counts {
                habits.counts.add(key, *symbol, f64::from(*count), row.touched_min);
            }
        }
        Ok(habits)
    }

    /// The habits as JSON.
    ///
    /// # Errors
    /// When writing JSON fails: a fault of the program.
    pub fn to_json(&self) -> Result<String, StoredError> {
        serde_json::to_string(&self.stored()).map_err(|error| malformed(error.to_string()))
    }

    /// Reads JSON of [`Habits::to_json`].
    ///
    /// # Errors
    /// As [`Habits::from_stored`].
    pub fn from_json(options: HabitsOptions, json: &str) -> Result<Self, StoredError> {
        if json.len() > 4 * BYTES_MAX {
            return Err(malformed(format!("{} bytes are more than {}", json.len(), 4 * BYTES_MAX)));
        }
        let Keyed(stored): Keyed<Stored> = serde_json::from_str(json).map_err(|error| malformed(json_says(&error)))?;
        Self::from_stored(options, stored)
    }
}
