use iceoryx2::prelude::ZeroCopySend;

use super::{
    MAX_HORIZONS, MAX_PERSONS, MAX_ROOMS, Message, NAME_BYTES, ServiceQuality, at_most, distinct, in_range, layout,
    presence,
};
use crate::{MessageError, text};

/// How far ahead the entries of [`PersonForecastV1::learned_share`] look, in seconds.
pub const LEARNED_SHARE_S: [f32; 3] = [60.0, 900.0, 3_600.0];

layout! {
    /// Where one person will be: P(room at `computed_ns` + horizon), and P(elsewhere), which together sum to one per horizon.
    #[type_name("roomcast.PersonForecastV1")]
    pub struct PersonForecastV1 [4416] {
        /// The person's number.
        0 => person: u32,
        /// One of [`crate::raw::presence`].
        4 => presence: u32,
        /// Bits of [`crate::raw::person_flags`].
        8 => flags: u32,
        /// Zero.
        12 => reserved_a: [u8; 4],
        /// The person's name, UTF-8, zero padded; empty for a person with a number only.
        16 => name: [u8; NAME_BYTES],
        /// Per horizon that the person is elsewhere, outside the map's rooms, 0 to 1.
        64 => elsewhere: [f32; MAX_HORIZONS],
        /// Per horizon the smallest set of rooms that holds the person with the coverage below; bit i is room i.
        128 => room_set: [u64; MAX_HORIZONS],
        /// The coverage that the sets are for, 0 to 1; 0 where there are no sets.
        256 => set_coverage: f32,
        /// Bit h: elsewhere belongs to the set of horizon h.
        260 => set_elsewhere: u32,
        /// Observations behind the person's habits, 0 without habits.
        264 => observations: f32,
        /// Share of the habits in the forecast, [`LEARNED_SHARE_S`] seconds ahead, 0 to 1.
        268 => learned_share: [f32; 3],
        /// Zero.
        280 => reserved: [u8; 40],
        /// `probability[room][horizon]`, 0 to 1.
        320 => probability: [[f32; MAX_HORIZONS]; MAX_ROOMS],
    }
}

layout! {
    /// Where each person will be.
    #[type_name("roomcast.PersonForecastsV1")]
    pub struct PersonForecastsV1 [38592] {
        /// Epoch of the room scores that it follows from.
        0 => epoch: u64,
        /// Sequence of those room scores.
        8 => sequence: u64,
        /// When it was computed: monotonic nanoseconds.
        16 => computed_ns: u64,
        /// When this message was sent: monotonic nanoseconds.
        24 => published_ns: u64,
        /// Rooms, at most 64.
        32 => room_count: u32,
        /// Horizons, at most 16.
        36 => horizon_count: u32,
        /// Persons known; `person` names at most 8 of them.
        40 => persons: u32,
        /// Entries in `person`, at most 8.
        44 => person_count: u32,
        /// Minor version of the layout: 1 has sets, `observations` and `learned_share`; they are 0 before.
        48 => minor: u32,
        /// Zero.
        52 => reserved: [u8; 76],
        /// The horizons in seconds, rising.
        128 => horizon_s: [f32; MAX_HORIZONS],
        /// The rooms' ids in the map's order, UTF-8, zero padded.
        192 => id: [[u8; NAME_BYTES]; MAX_ROOMS],
        /// The persons, in the order of their numbers; unused entries zero.
        3264 => person: [PersonForecastV1; MAX_PERSONS],
    }
}

impl PersonForecastV1 {
    /// The person's name, of a checked message; empty for a person with a number only.
    #[must_use]
    pub fn name(&self) -> &str {
        text::checked(&self.name)
    }

    /// Whether the set of a horizon holds a room; none where there are no sets.
    #[must_use]
    pub fn set_holds(&self, horizon: usize, room: usize) -> Option<bool> {
        let set = self.room_set.get(horizon).filter(|_| self.set_coverage > 0.0)?;
        Some(room < MAX_ROOMS && set >> room & 1 == 1)
    }

    /// Whether elsewhere belongs to the set of a horizon; none where there are no sets.
    #[must_use]
    pub fn set_holds_elsewhere(&self, horizon: usize) -> Option<bool> {
        (self.set_coverage > 0.0 && horizon < MAX_HORIZONS).then(|| self.set_elsewhere >> horizon & 1 == 1)
    }

    /// What this forecast gives the places of the set of a horizon together. The coverage is that of many sets on the long run. None where there are
    /// no sets.
    #[must_use]
    pub fn set_probability(&self, horizon: usize) -> Option<f64> {
        let elsewhere = self.set_holds_elsewhere(horizon)?.then(|| self.elsewhere[horizon]);
        let held = (0..MAX_ROOMS).filter(|room| self.set_holds(horizon, *room) == Some(true));
        Some(held.map(|room| self.probability[room][horizon]).chain(elsewhere).map(f64::from).sum())
    }
}

impl PersonForecastsV1 {
    /// The rooms' ids in the map's order, of a checked message.
    pub fn rooms(&self) -> impl ExactSizeIterator<Item = &str> {
        self.id.iter().take(self.room_count as usize).map(|id| text::checked(id))
    }

    /// The horizons in seconds, rising.
    #[must_use]
    pub fn horizons_s(&self) -> &[f32] {
        self.horizon_s.get(..self.horizon_count as usize).unwrap_or(&self.horizon_s)
    }

    /// The persons, in the order of their numbers.
    #[must_use]
    pub fn persons(&self) -> &[PersonForecastV1] {
        self.person.get(..self.person_count as usize).unwrap_or(&self.person)
    }
}

impl Message for PersonForecastsV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/person-forecasts", publishers: 1, subscribers: 16, buffer: 2, history: 1 };

    fn check(&self) -> Result<(), MessageError> {
        at_most("room_count", self.room_count, MAX_ROOMS, "0 to 64")?;
        at_most("horizon_count", self.horizon_count, MAX_HORIZONS, "0 to 16")?;
        at_most("person_count", self.person_count, MAX_PERSONS, "0 to 8")?;
        let (rooms, horizons) = (self.room_count as usize, self.horizon_count as usize);
        for horizon_s in self.horizons_s() {
            in_range("horizon_s", f64::from(*horizon_s), 0.0, f64::from(f32::MAX), "0 or more, finite")?;
        }
        for id in self.id.iter().take(rooms) {
            if text::decode("room id", id)?.is_empty() {
                return Err(MessageError::Empty { field: "room id" });
            }
        }
        distinct("room id", self.id.iter().take(rooms))?;
        for person in self.persons() {
            at_most("presence", person.presence, presence::GONE as usize, "0 to 3")?;
            text::decode("name", &person.name)?;
            in_range("set_coverage", f64::from(person.set_coverage), 0.0, 1.0, "0 to 1")?;
            in_range("observations", f64::from(person.observations), 0.0, f64::from(f32::MAX), "0 or more, finite")?;
            for share in person.learned_share {
                in_range("learned_share", f64::from(share), 0.0, 1.0, "0 to 1")?;
            }
            let rows = person.probability.iter().take(rooms).chain(std::iter::once(&person.elsewhere));
            for probability in rows.flat_map(|row| row.iter().take(horizons)) {
                in_range("probability", f64::from(*probability), 0.0, 1.0, "0 to 1")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_counts_and_numbers_are_refused_and_reading_them_anyway_is_safe() {
        let mut forecasts =
            PersonForecastsV1 { room_count: 2, horizon_count: 3, person_count: 2, ..Default::default() };
        forecasts.check().unwrap_err();
        for (id, name) in forecasts.id.iter_mut().zip(["kitchen", "bathroom"]) {
            *id = text::encode("room id", name).unwrap();
        }
        forecasts.check().unwrap();
        let mut hostile = forecasts;
        hostile.person[1].elsewhere[2] = f32::NAN;
        assert!(matches!(hostile.check(), Err(MessageError::OutOfRange { field: "probability", .. })));
        let mut hostile = forecasts;
        hostile.person[0].learned_share[2] = 1.5;
        assert!(matches!(hostile.check(), Err(MessageError::OutOfRange { field: "learned_share", .. })));
        let mut hostile = forecasts;
        hostile.person[0].observations = f32::INFINITY;
        assert!(matches!(hostile.check(), Err(MessageError::OutOfRange { field: "observations", .. })));
        let hostile = PersonForecastsV1 { person_count: 9, horizon_count: 17, room_count: 65, ..forecasts };
        hostile.check().unwrap_err();
        assert_eq!((hostile.persons().len(), hostile.horizons_s().len()), (MAX_PERSONS, MAX_HORIZONS));
        assert_eq!(hostile.rooms().count(), MAX_ROOMS);
    }

    #[test]
    fn a_set_holds_rooms_only_where_there_is_one() {
        let mut person = PersonForecastV1::default();
        person.room_set[1] = 0b10;
        assert_eq!(person.set_holds(1, 1), None);
        person.set_coverage = 0.9;
        assert_eq!([person.set_holds(1, 0), person.set_holds(1, 1)], [Some(false), Some(true)]);
        assert_eq!([person.set_holds(0, 64), person.set_holds(16, 0)], [Some(false), None]);
        person.set_elsewhere = 0b10;
        assert_eq!([0, 1, 16].map(|h| person.set_holds_elsewhere(h)), [Some(false), Some(true), None]);
    }
}
