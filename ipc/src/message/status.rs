use iceoryx2::prelude::ZeroCopySend;

use super::{NAME_BYTES, layout};
use crate::text;

layout! {
    /// Asks the daemon how it is.
    #[type_name("roomcast.StatusRequestV1")]
    pub struct StatusRequestV1 [16] {
        /// Minor version of the layout that the asker knows: 0.
        0 => minor: u32,
        /// Zero.
        4 => reserved: [u8; 12],
    }
}

layout! {
    /// The daemon's health, versions and counters. Counters count since the daemon's start.
    #[type_name("roomcast.StatusResponseV1")]
    pub struct StatusResponseV1 [512] {
        /// The daemon's epoch, as in its scores.
        0 => epoch: u64,
        /// Sequence of its newest scores.
        8 => sequence: u64,
        /// When it started: Unix nanoseconds.
        16 => started_unix_ns: u64,
        /// When it answered: monotonic nanoseconds.
        24 => answered_ns: u64,
        /// Narrations received, in any condition.
        32 => received: u64,
        /// Narrations that went into a history.
        40 => accepted: u64,
        /// Narrations received a second time, and ignored.
        48 => duplicates: u64,
        /// Narrations that never arrived (gaps in sequence numbers).
        56 => missed: u64,
        /// Malformed messages, counted and dropped.
        64 => malformed: u64,
        /// Narrations refused by a source's rate limit or quota.
        72 => limited: u64,
        /// Scoring steps.
        80 => steps: u64,
        /// Narrations scored together with a newer one.
        88 => merged: u64,
        /// Steps that failed in the scorer.
        96 => failed_steps: u64,
        /// Snapshots sent, heartbeats not counted.
        104 => published: u64,
        /// Heartbeats sent.
        112 => heartbeats: u64,
        /// Narrations restored from the journal at the start.
        120 => restored: u64,
        /// Narrations that wait for the next step.
        128 => waiting: u64,
        /// Median time from the receipt of an event to its scores, over the run, in nanoseconds.
        136 => latency_p50_ns: u64,
        /// Event to scores, 99th percentile, in nanoseconds.
        144 => latency_p99_ns: u64,
        /// Event to scores, worst, in nanoseconds.
        152 => latency_max_ns: u64,
        /// SHA-256 of the model file.
        160 => model_fingerprint: [u8; 32],
        /// SHA-256 of the map.
        192 => map_fingerprint: [u8; 32],
        /// The daemon's process id.
        224 => process: u32,
        /// Narrators known.
        228 => sources: u32,
        /// Persons known.
        232 => persons: u32,
        /// Minor version of the layout: 1 has `forged`, `costly` and `learned`, 2 what
        /// follows `learned`, 3 `ahead`; they are 0 before.
        236 => minor: u32,
        /// Version of the daemon, UTF-8, zero padded.
        240 => version: [u8; NAME_BYTES],
        /// The map's name.
        288 => map: [u8; NAME_BYTES],
        /// The model's name.
        336 => model: [u8; NAME_BYTES],
        /// Journal: bytes on disk, of both its files.
        384 => journal_bytes: u64,
        /// Journal: failed writes, and at the start the number of damaged databases.
        392 => journal_failures: u64,
        /// Narrations in the name of a source that another port uses.
        400 => forged: u64,
        /// Narrations refused because their tokens do not fit the window.
        408 => costly: u64,
        /// Observations that the habits rest on.
        416 => learned: u64,
        /// Bytes of memory that the habits take.
        424 => habits_bytes: u64,
        /// Counts that the habits hold.
        432 => habits_counts: u64,
        /// Names of things that the habits hold.
        440 => habits_names: u32,
        /// Persons with learned habits.
        444 => habits_persons: u32,
        /// Prompts that steps asked the model about.
        448 => asked: u64,
        /// Answers prepared in idle time.
        456 => prepared: u64,
        /// Prepared answers that a step used.
        464 => prepared_used: u64,
        /// Nanoseconds of the processor spent preparing.
        472 => prepare_ns: u64,
        /// Narrations that a fast clock dated more than a second ahead. They count as observed when they came.
        480 => ahead: u64,
        /// How far the newest of them lay ahead, in nanoseconds.
        488 => ahead_ns: u64,
        /// Zero.
        496 => reserved: [u8; 16],
    }
}

impl StatusResponseV1 {
    /// The daemon's version.
    #[must_use]
    pub fn version(&self) -> &str {
        text::checked(&self.version)
    }

    /// The map's name.
    #[must_use]
    pub fn map(&self) -> &str {
        text::checked(&self.map)
    }

    /// The model's name.
    #[must_use]
    pub fn model(&self) -> &str {
        text::checked(&self.model)
    }
}
