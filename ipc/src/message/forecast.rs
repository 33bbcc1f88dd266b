use iceoryx2::prelude::ZeroCopySend;

use super::{MAX_ROOMS, Message, NAME_BYTES, ServiceQuality, at_most, distinct, in_range, layout};
use crate::{MessageError, text};

/// Most points in time of a forecast.
pub const MAX_HORIZONS: usize = 16;

/// Bits of [`ForecastV1::flags`].
pub mod forecast_flags {
    /// No person was observed, or a resident was not observed and all others are away; and no sensor shows a person: all rooms are equally likely.
    pub const NOT_KNOWN: u32 = 1;
    /// The last event of a person is from before the daemon's start.
    pub const RESTORED: u32 = 1 << 1;
    /// The house is empty now.
    pub const NOBODY_HOME: u32 = 1 << 2;
    /// A resident was not observed and may be in any room. Without sensors, the probabilities lack this resident.
    pub const RESIDENT_UNKNOWN: u32 = 1 << 3;
    /// The scores have the flag of this name: belief, stays and habits take the place of the model for the persons concerned.
    pub const UNFAMILIAR: u32 = 1 << 4;
    /// The scores have the flag of this name: the forecast rests on belief, stays and habits alone.
    pub const MODEL_WEAK: u32 = 1 << 5;
}

layout! {
    /// P(room is occupied at `computed_ns` + horizon), for a grid of horizons.
    #[type_name("roomcast.ForecastV1")]
    pub struct ForecastV1 [7360] {
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
        /// Person, or [`crate::raw::ALL_PERSONS`].
        40 => person: u32,
        /// Minor version of the layout: 1 has `flags`, 2 has `elsewhere`; they are 0 before.
        44 => minor: u32,
        /// Bits of [`forecast_flags`].
        48 => flags: u32,
        /// Probability per horizon that all persons are elsewhere, outside the map's rooms, 0 to 1.
        52 => elsewhere: [f32; MAX_HORIZONS],
        /// Zero.
        116 => reserved: [u8; 12],
        /// The horizons in seconds, rising.
        128 => horizon_s: [f32; MAX_HORIZONS],
        /// The rooms' ids, UTF-8, zero padded.
        192 => id: [[u8; NAME_BYTES]; MAX_ROOMS],
        /// `probability[room][horizon]`, 0 to 1: that a person is there. A horizon's column and `elsewhere` sum to one for one person,
        /// and the column to at most their number for several. The sum of a room's row has no meaning.
        3264 => probability: [[f32; MAX_HORIZONS]; MAX_ROOMS],
    }
}

/// A row of probabilities at a time since the forecast was computed: interpolated between two horizons, constant before the first and after
/// the last horizon.
#[must_use]
pub fn probability_at(horizons_s: &[f32], row: &[f32], since_s: f64) -> f64 {
    let mut before: Option<(f64, f64)> = None;
    for (horizon_s, probability) in horizons_s.iter().zip(row).map(|(at, p)| (f64::from(*at), f64::from(*p))) {
        if horizon_s >= since_s {
            return match before {
                Some((from_s, from)) if horizon_s > from_s => {
                    from + (probability - from) * (since_s - from_s) / (horizon_s - from_s)
                }
                _ => probability,
            };
        }
        before = Some((horizon_s, probability));
    }
    before.map_or(0.0, |(_, last)| last)
}

impl ForecastV1 {
    /// The horizons in seconds, rising.
    #[must_use]
    pub fn horizons_s(&self) -> &[f32] {
        self.horizon_s.get(..self.horizon_count as usize).unwrap_or(&self.horizon_s)
    }

    /// The rooms' ids in the map's order, of a checked message, each with its probabilities, one per horizon.
    pub fn rooms(&self) -> impl Iterator<Item = (&str, &[f32])> {
        (0..self.room_count as usize).filter_map(|index| self.room(index))
    }

    /// Whether a bit of [`forecast_flags`] is set.
    #[must_use]
    pub fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }

    /// Room `index`'s id and its probabilities, one per horizon; none when there is no such room.
    #[must_use]
    pub fn room(&self, index: usize) -> Option<(&str, &[f32])> {
        if index >= self.room_count as usize {
            return None;
        }
        let row = self.probability.get(index)?.get(..self.horizon_count as usize)?;
        Some((text::checked(self.id.get(index)?), row))
    }
}

impl Message for ForecastV1 {
    const SERVICE: ServiceQuality =
        ServiceQuality { name: "roomcast/v1/forecast", publishers: 1, subscribers: 16, buffer: 2, history: 1 };

    fn check(&self) -> Result<(), MessageError> {
        at_most("room_count", self.room_count, MAX_ROOMS, "0 to 64")?;
        at_most("horizon_count", self.horizon_count, MAX_HORIZONS, "0 to 16")?;
        let (rooms, horizons) = (self.room_count as usize, self.horizon_count as usize);
        for horizon_s in self.horizon_s.iter().take(horizons) {
            in_range("horizon_s", f64::from(*horizon_s), 0.0, f64::from(f32::MAX), "0 or more, finite")?;
        }
        for elsewhere in self.elsewhere.iter().take(horizons) {
            in_range("elsewhere", f64::from(*elsewhere), 0.0, 1.0, "0 to 1")?;
        }
        for (id, row) in self.id.iter().zip(&self.probability).take(rooms) {
            text::decode("room id", id)?;
            for probability in row.iter().take(horizons) {
                in_range("probability", f64::from(*probability), 0.0, 1.0, "0 to 1")?;
            }
        }
        distinct("room id", self.id.iter().take(rooms))
    }
}
