use iceoryx2::prelude::ZeroCopySend;

use super::{Message, NAME_BYTES, ServiceQuality, at_most, distinct, in_range, layout};
use crate::{MessageError, text};

/// Most rooms (partitions) in one message. A map with more cannot be served by the daemon.
pub const MAX_ROOMS: usize = 64;
/// Most narrators named in one message; the longest silent ones are left out, and a flag says so.
pub const MAX_SOURCES: usize = 16;
/// Value of [`RoomScoresV1::person`]: the message speaks of all persons together.
pub const ALL_PERSONS: u32 = u32::MAX;

/// Values of [`RoomScoresV1::reached`]: the reason for the end of scoring.
pub mod reached {
    /// Every label was scored; bounds equal scores.
    pub const EXACT: u32 = 0;
    /// The ranking of the rooms is certain, the scores are bounds.
    pub const RANKING: u32 = 1;
    /// The most likely room is certain.
    pub const TOP: u32 = 2;
    /// Time ran out; the bounds hold the exact scores.
    pub const DEADLINE: u32 = 3;
}

/// Bits of [`RoomScoresV1::flags`].
pub mod score_flags {
    /// Sent again unchanged, to say that the daemon lives: same sequence, newer `published_ns`.
    pub const HEARTBEAT: u32 = 1;
    /// No narration yet: the scores are what the model says about an unknown past.
    pub const NO_NARRATION: u32 = 1 << 1;
    /// More narration had arrived when this was published: newer scores follow.
    pub const BEHIND: u32 = 1 << 2;
    /// Narration was lost on the way (a gap in its sequence numbers).
    pub const GAP: u32 = 1 << 3;
    /// More sources said something new than there are places: `included` names the most recent ones, and the others wait for their
    /// confirmation.
    pub const SOURCES_CUT: u32 = 1 << 4;
    /// The last scoring attempt failed; these are the last good scores, sent again at once, with the narration and of the map that
    /// they are of. A later attempt scores what this one could not.
    pub const SCORER_FAILED: u32 = 1 << 5;
    /// All known persons and residents are away: no room is likely, and their scores are `-inf`.
    pub const NOBODY_HOME: u32 = 1 << 6;
    /// The model scored all of it before the narration came: `timing_ns` has no decoder in it.
    pub const PREPARED: u32 = 1 << 7;
    /// The model does not know the words of a person's narration or of the map's labels: the scores say little, and weigh less in the
    /// forecast.
    pub const UNFAMILIAR: u32 = 1 << 8;
    /// The model fails the check of its first scores: all scores are noise, and forecasts leave them out. The daemon's log has the reason.
    pub const MODEL_WEAK: u32 = 1 << 9;
}

layout! {
    /// The newest narration of one start of a source that a message's scores contain, or that was dealt with otherwise. Several
    /// processes may use one source at once, each with an epoch of its own.
    #[type_name("roomcast.IncludedV1")]
    pub struct IncludedV1 [40] {
        /// The narrator.
        0 => source: u64,
        /// Its epoch.
        8 => epoch: u64,
        /// Highest sequence number dealt with; all accepted ones up to it went through the history.
        16 => sequence: u64,
        /// When that was observed: monotonic nanoseconds.
        24 => observed_ns: u64,
        /// Narrations of this source in this epoch that the daemon has accepted, those of its journal included.
        32 => accepted: u64,
    }
}

layout! {
    /// How likely somebody is in one room soon.
    #[type_name("roomcast.RoomV1")]
    pub struct RoomV1 [80] {
        /// The partition's id in the map, UTF-8, zero padded.
        0 => id: [u8; NAME_BYTES],
        /// Of one person, Equation 2's sum over the room's items, in nats; `-inf` when it has none. Of several, the logarithm of
        /// `probability`.
        48 => log_score_nats: f64,
        /// The true value lies at or above this, in nats.
        56 => lower_log_score_nats: f64,
        /// The true value lies at or below this, in nats.
        64 => upper_log_score_nats: f64,
        /// Of one person, the score's share of all rooms' scores, 0 to 1: that they are there next; they sum to one. Of several, that
        /// somebody is there next; they sum to their number at most.
        72 => probability: f64,
    }
}

layout! {
    /// A full snapshot of what the daemon knows: a late joiner needs nothing else.
    ///
    /// The same `(epoch, sequence)` may come again as a heartbeat, every 250 ms, with a newer `published_ns`.
    #[type_name("roomcast.RoomScoresV1")]
    pub struct RoomScoresV1 [6016] {
        /// Random per start of the daemon.
        0 => epoch: u64,
        /// 1, 2, 3, ... within the epoch; a jump means that snapshots were overwritten before they were read.
        8 => sequence: u64,
        /// When the scores were computed: monotonic nanoseconds. Their age counts from here.
        16 => computed_ns: u64,
        /// The same in Unix nanoseconds, for people.
        24 => computed_unix_ns: u64,
        /// When this very message was sent: monotonic nanoseconds. The daemon's age counts from here.
        32 => published_ns: u64,
        /// When the newest contained narration was observed: monotonic nanoseconds, 0 for none.
        40 => observed_ns: u64,
        /// The receipt of the first narration that is new in these scores; without a new one, the last such
        /// time. Monotonic nanoseconds, 0 for none.
        48 => received_ns: u64,
        /// SHA-256 of the model file.
        56 => model_fingerprint: [u8; 32],
        /// SHA-256 of the map.
        88 => map_fingerprint: [u8; 32],
        /// Total probability of all labels as continuations, 0 to about 1; of several persons, the mean.
        120 => label_mass: f64,
        /// Narrations in the window that the scores were computed from.
        128 => window: u64,
        /// Time from `received_ns` to the start of the step, in nanoseconds; 0 where the scores contain nothing new.
        136 => wait_ns: u64,
        /// Step's time: tokenising.
        144 => tokenise_ns: u64,
        /// Step's time: decoding new narration and binding sequence.
        152 => prefix_ns: u64,
        /// Step's time: decoding the labels' trie.
        160 => trie_ns: u64,
        /// Step's time: grounding.
        168 => ground_ns: u64,
        /// The person of these scores, or [`ALL_PERSONS`].
        176 => person: u32,
        /// Persons known.
        180 => persons: u32,
        /// Rooms in `rooms`, at most 64.
        184 => room_count: u32,
        /// Entries in `included`, at most 16.
        188 => source_count: u32,
        /// One of [`reached`].
        192 => reached: u32,
        /// Bits of [`score_flags`].
        196 => flags: u32,
        /// Minor version of the layout: 0.
        200 => minor: u32,
        /// Zero.
        204 => reserved: [u8; 52],
        /// Per source, the newest narration contained; unused entries zero.
        256 => included: [IncludedV1; MAX_SOURCES],
        /// The rooms in the map's order; unused entries zero.
        896 => room: [RoomV1; MAX_ROOMS],
    }
}

impl RoomV1 {
    /// The room's id, of a checked message.
    #[must_use]
    pub fn id(&self) -> &str {
        text::checked(&self.id)
    }
}

impl RoomScoresV1 {
    /// The rooms, in the map's order.
    #[must_use]
    pub fn rooms(&self) -> &[RoomV1] {
        self.room.get(..self.room_count as usize).unwrap_or(&self.room)
    }

    /// Per source, the newest narration that the scores contain.
    #[must_use]
    pub fn included(&self) -> &[IncludedV1] {
        self.included.get(..self.source_count as usize).unwrap_or(&self.included)
    }

    /// Nanoseconds since the scores were computed.
    #[must_use]
    pub fn age_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.computed_ns)
    }

    /// Nanoseconds since the daemon last said that it lives.
    #[must_use]
    pub fn silence_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.published_ns)
    }

    /// Whether a bit of [`score_flags`] is set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }
}

impl Message for RoomScoresV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/room-scores", publishers: 1, subscribers: 16, buffer: 2, history: 1 };

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
        at_most("source_count", self.source_count, MAX_SOURCES, "0 to 16")?;
        at_most("reached", self.reached, reached::DEADLINE as usize, "0 to 3")?;
        // A sum of f64 probabilities may exceed 1 by rounding, and the labels of a chain overlap.
        in_range("label_mass", self.label_mass, 0.0, f64::MAX, "0 or more, finite")?;
        for room in self.rooms() {
            if text::decode("room id", &room.id)?.is_empty() {
                return Err(MessageError::Empty { field: "room id" });
            }
            in_range("probability", room.probability, 0.0, 1.0, "0 to 1")?;
            for (field, value) in [
                ("log_score_nats", room.log_score_nats),
                ("lower_log_score_nats", room.lower_log_score_nats),
                ("upper_log_score_nats", room.upper_log_score_nats),
            ] {
                in_range(field, value, f64::NEG_INFINITY, f64::MAX, "-inf or finite")?;
            }
        }
        distinct("room id", self.rooms().iter().map(|room| &room.id))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn good() -> RoomScoresV1 {
        let mut scores = RoomScoresV1 { epoch: 3, sequence: 1, room_count: 2, label_mass: 0.8, ..Default::default() };
        for (room, (id, probability)) in scores.room.iter_mut().zip([("kitchen", 0.75), ("bathroom", 0.25)]) {
            room.id = text::encode("room id", id).unwrap();
            room.probability = probability;
            room.log_score_nats = probability.ln();
        }
        scores
    }

    #[test]
    fn a_snapshot_says_its_rooms() {
        let scores = good();
        scores.check().unwrap();
        assert_eq!(scores.rooms().iter().map(RoomV1::id).collect::<Vec<_>>(), ["kitchen", "bathroom"]);
    }

    #[test]
    fn hostile_counts_and_numbers_are_refused_and_reading_them_anyway_is_safe() {
        let mut too_many = good();
        too_many.room_count = u32::MAX;
        too_many.source_count = 17;
        too_many.check().unwrap_err();
        assert_eq!((too_many.rooms().len(), too_many.included().len()), (MAX_ROOMS, MAX_SOURCES));

        let mut not_a_number = good();
        not_a_number.room[1].probability = f64::NAN;
        assert!(matches!(not_a_number.check(), Err(MessageError::OutOfRange { field: "probability", .. })));

        let mut nameless = good();
        nameless.room[0].id = [0; NAME_BYTES];
        nameless.check().unwrap_err();
    }

    #[test]
    fn two_rooms_of_one_id_are_refused() {
        let mut scores = good();
        // Bytes behind the last room do not count.
        scores.room[2].id = scores.room[0].id;
        scores.check().unwrap();
        scores.room[1].id = scores.room[0].id;
        assert_eq!(scores.check(), Err(MessageError::Twice { field: "room id" }));
    }
}
