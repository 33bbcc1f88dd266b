use iceoryx2::prelude::ZeroCopySend;

use super::{MAX_ROOMS, Message, NAME_BYTES, ServiceQuality, at_most, distinct, in_range, layout, reached};
use crate::{MessageError, text};

/// Most persons in one message; the longest silent ones are left out, and [`PersonScoresV1::persons`] says how many there are.
pub const MAX_PERSONS: usize = 8;

/// Bits of [`PersonV1::flags`].
pub mod person_flags {
    /// Each observation of the person is from before the daemon's start.
    pub const RESTORED: u32 = 1;
    /// Nothing for long, on a bed: possibly asleep.
    pub const ASLEEP: u32 = 1 << 1;
    /// The newest narration had no name, and fitted this person best.
    pub const BY_FIT: u32 = 1 << 2;
    /// Not of the household: forgotten after a silence.
    pub const VISITOR: u32 = 1 << 3;
    /// The model does not know the words of the person's narration or of the map's labels.
    pub const UNFAMILIAR: u32 = 1 << 4;
}

/// Values of [`PersonV1::presence`]; [`Presence`](crate::Presence) is their meaning.
pub mod presence {
    /// The person was not observed yet.
    pub const UNKNOWN: u32 = 0;
    /// In the house.
    pub const PRESENT: u32 = 1;
    /// Out of the house, and expected back.
    pub const AWAY: u32 = 2;
    /// Out of the house, and not expected back.
    pub const GONE: u32 = 3;
}

layout! {
    /// One person's scores, as if this person were alone.
    #[type_name("roomcast.PersonV1")]
    pub struct PersonV1 [2176] {
        /// The person's number, as narrators give it.
        0 => person: u32,
        /// How their scores were reached, as in room scores.
        4 => reached: u32,
        /// When they were observed last: monotonic nanoseconds, 0 where that was before the machine's start.
        8 => observed_ns: u64,
        /// Narrations in their window.
        16 => window: u64,
        /// Total probability of all labels as continuations, 0 to about 1.
        24 => label_mass: f64,
        /// Bits of [`person_flags`].
        32 => flags: u32,
        /// One of [`presence`].
        36 => presence: u32,
        /// That the person is elsewhere next, outside the map's rooms, 0 to 1: 1 while away or gone.
        40 => elsewhere: f64,
        /// Since when `presence` holds: monotonic nanoseconds, 0 where that was before the machine's start.
        48 => since_ns: u64,
        /// The person's name, UTF-8, zero padded; empty for a person with a number only.
        56 => name: [u8; NAME_BYTES],
        /// Zero.
        104 => reserved: [u8; 24],
        /// Per room Equation 2's sum over its items, in nats; `-inf` when it has none.
        128 => log_score_nats: [f64; MAX_ROOMS],
        /// Per room, the true value lies at or above this, in nats.
        640 => lower_log_score_nats: [f64; MAX_ROOMS],
        /// Per room, the true value lies at or below this, in nats.
        1152 => upper_log_score_nats: [f64; MAX_ROOMS],
        /// Per room the score's share of all rooms' scores, 0 to 1: that the person is there next. With `elsewhere` they sum to one.
        1664 => probability: [f64; MAX_ROOMS],
    }
}

layout! {
    /// The scores of each person, which the room scores of the same epoch and sequence speak of together.
    #[type_name("roomcast.PersonScoresV1")]
    pub struct PersonScoresV1 [20608] {
        /// Epoch of the room scores that it goes with.
        0 => epoch: u64,
        /// Sequence of those room scores.
        8 => sequence: u64,
        /// When they were computed: monotonic nanoseconds.
        16 => computed_ns: u64,
        /// When this message was sent: monotonic nanoseconds.
        24 => published_ns: u64,
        /// SHA-256 of the map.
        32 => map_fingerprint: [u8; 32],
        /// Persons with a history; `person` names at most 8 of them.
        64 => persons: u32,
        /// Entries in `person`, at most 8.
        68 => person_count: u32,
        /// Rooms, at most 64.
        72 => room_count: u32,
        /// Minor version of the layout: 0.
        76 => minor: u32,
        /// Zero.
        80 => reserved: [u8; 48],
        /// The rooms' ids in the map's order, UTF-8, zero padded.
        128 => id: [[u8; NAME_BYTES]; MAX_ROOMS],
        /// The persons, in the order of their numbers; unused entries zero.
        3200 => person: [PersonV1; MAX_PERSONS],
    }
}

impl PersonV1 {
    /// The person's name, of a checked message; empty for a person with a number only.
    #[must_use]
    pub fn name(&self) -> &str {
        text::checked(&self.name)
    }

    /// Whether a bit of [`person_flags`] is set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }
}

impl PersonScoresV1 {
    /// The rooms' ids in the map's order, of a checked message.
    pub fn rooms(&self) -> impl ExactSizeIterator<Item = &str> {
        self.id.iter().take(self.room_count as usize).map(|id| text::checked(id))
    }

    /// The persons, in the order of their numbers.
    #[must_use]
    pub fn persons(&self) -> &[PersonV1] {
        self.person.get(..self.person_count as usize).unwrap_or(&self.person)
    }

    /// Each room's id and the probability that the person is there next.
    pub fn probabilities<'a>(&'a self, person: &'a PersonV1) -> impl ExactSizeIterator<Item = (&'a str, f64)> {
        self.rooms().zip(person.probability)
    }
}

impl Message for PersonScoresV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/person-scores", publishers: 1, subscribers: 16, buffer: 2, history: 1 };

    fn check(&self) -> Result<(), MessageError> {
        for (field, value) in [("epoch", self.epoch), ("sequence", self.sequence)] {
            if value == 0 {
                return Err(MessageError::OutOfRange { field, value: 0.0, allowed: "not 0" });
            }
        }
        if self.room_count == 0 {
            return Err(MessageError::Empty { field: "room" });
        }
        at_most("room_count", self.room_count, MAX_ROOMS, "1 to 64")?;
        at_most("person_count", self.person_count, MAX_PERSONS, "0 to 8")?;
        let rooms = self.room_count as usize;
        for id in self.id.iter().take(rooms) {
            if text::decode("room id", id)?.is_empty() {
                return Err(MessageError::Empty { field: "room id" });
            }
        }
        distinct("room id", self.id.iter().take(rooms))?;
        for person in self.persons() {
            at_most("reached", person.reached, reached::DEADLINE as usize, "0 to 3")?;
            at_most("presence", person.presence, presence::GONE as usize, "0 to 3")?;
            in_range("label_mass", person.label_mass, 0.0, f64::MAX, "0 or more, finite")?;
            in_range("elsewhere", person.elsewhere, 0.0, 1.0, "0 to 1")?;
            text::decode("name", &person.name)?;
            for probability in person.probability.iter().take(rooms) {
                in_range("probability", *probability, 0.0, 1.0, "0 to 1")?;
            }
            for (field, values) in [
                ("log_score_nats", &person.log_score_nats),
                ("lower_log_score_nats", &person.lower_log_score_nats),
                ("upper_log_score_nats", &person.upper_log_score_nats),
            ] {
                for value in values.iter().take(rooms) {
                    in_range(field, *value, f64::NEG_INFINITY, f64::MAX, "-inf or finite")?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> PersonScoresV1 {
        let mut scores =
            PersonScoresV1 { epoch: 3, sequence: 1, room_count: 2, persons: 2, person_count: 2, ..Default::default() };
        scores.id[0] = text::encode("room id", "kitchen").unwrap();
        scores.id[1] = text::encode("room id", "bathroom").unwrap();
        for (number, (person, share)) in (0..).zip(scores.person.iter_mut().zip([0.75, 0.5])) {
            person.person = number;
            (person.probability[0], person.probability[1]) = (share, 1.0 - share);
        }
        scores
    }

    #[test]
    fn it_says_where_each_person_is() {
        let scores = good();
        scores.check().unwrap();
        let of = |person: usize| scores.probabilities(&scores.persons()[person]).collect::<Vec<_>>();
        assert_eq!(of(0), [("kitchen", 0.75), ("bathroom", 0.25)]);
        assert_eq!(of(1), [("kitchen", 0.5), ("bathroom", 0.5)]);
    }

    #[test]
    fn hostile_counts_and_numbers_are_refused_and_reading_them_anyway_is_safe() {
        let too_many = PersonScoresV1 { person_count: 9, room_count: 65, ..good() };
        too_many.check().unwrap_err();
        assert_eq!((too_many.persons().len(), too_many.rooms().len()), (MAX_PERSONS, MAX_ROOMS));

        let mut not_a_number = good();
        not_a_number.person[1].probability[1] = f64::NAN;
        assert!(matches!(not_a_number.check(), Err(MessageError::OutOfRange { field: "probability", .. })));
        not_a_number.person_count = 1;
        not_a_number.check().unwrap();

        let mut nameless = good();
        nameless.id[1] = [0; NAME_BYTES];
        nameless.check().unwrap_err();
    }
}
