use iceoryx2::prelude::ZeroCopySend;

use super::{NAME_BYTES, layout};
use crate::text;

/// Value of [`ItemScoreV1::partition`]: the item lies in none.
pub const NO_PARTITION: u32 = u32::MAX;

/// Most items of a message: of a larger map the best. Shared memory is set aside for every message that may be under way, each as long as
/// the longest.
pub const MAX_ITEMS: usize = 1024;

layout! {
    /// User header of a slice of item scores: which snapshot they belong to.
    #[type_name("roomcast.ItemScoresHeaderV1")]
    pub struct ItemScoresHeaderV1 [64] {
        /// Epoch of the room scores that these items add up to.
        0 => epoch: u64,
        /// Sequence of those room scores.
        8 => sequence: u64,
        /// When they were computed: monotonic nanoseconds.
        16 => computed_ns: u64,
        /// Minor version of the layout: 1, which has `items`.
        24 => minor: u32,
        /// Items of the map. If the map has more items than the message, the message has the [`MAX_ITEMS`] with the best scores.
        28 => items: u32,
        /// Zero.
        32 => reserved: [u8; 32],
    }
}

layout! {
    /// The score of one item of the map. Sent only while somebody subscribes.
    #[type_name("roomcast.ItemScoreV1")]
    pub struct ItemScoreV1 [112] {
        /// The item's id in the map, UTF-8, zero padded, cut to fit.
        0 => id: [u8; NAME_BYTES],
        /// Its label, UTF-8, zero padded, cut to fit.
        48 => label: [u8; NAME_BYTES],
        /// s_i = s_c / n_l, in nats; of several persons, the mean of their shares of their label mass, times the mean label mass.
        96 => log_score_nats: f64,
        /// Index of its room in [`crate::raw::RoomScoresV1::rooms`], or [`NO_PARTITION`].
        104 => partition: u32,
        /// Items of the map with this label. Captions and rooms of that name count in n_l too, and not here.
        108 => label_items: u32,
    }
}

impl ItemScoreV1 {
    /// The item's id; empty when malformed.
    #[must_use]
    pub fn id(&self) -> &str {
        text::checked(&self.id)
    }

    /// The item's label; empty when malformed.
    #[must_use]
    pub fn label(&self) -> &str {
        text::checked(&self.label)
    }
}
