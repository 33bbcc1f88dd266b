//! From a message to an observation: what is taken, what is refused, and what is counted. Pure: time comes in as a number.

use std::collections::BTreeMap;

use roomcast_ipc::sequence::{Arrival, Follower};
use roomcast_ipc::{MessageError, NarrationV1};

use roomcast_core::narration::Observation;
/// Most sources followed; those of further ones are refused, so that inventing sources exhausts nothing.
pub use roomcast_core::pipeline::SOURCES_MAX;

use crate::config::IntakeLimits;
use crate::message_text::sentence_of;
use crate::token_bucket::TokenBucket;

/// After this silence a source gives way to a new one where there are too many.
const FORGET_NS: u64 = 3_600_000_000_000;

/// What became of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Taken {
    /// It goes into the history.
    Accepted {
        /// The observation.
        observation: Observation,
        /// Observations of this source that were lost before it.
        missed: u64,
    },
    /// It was taken before.
    Duplicate,
    /// Its source sends too fast.
    Limited,
    /// It cannot be an observation; counted, logged, dropped.
    Malformed(String),
}

/// Counters since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IntakeCounters {
    /// Messages received, in any condition.
    pub received: u64,
    /// Those that went into a history.
    pub accepted: u64,
    /// Those received before.
    pub duplicates: u64,
    /// Those that never arrived.
    pub missed: u64,
    /// Those that were malformed.
    pub malformed: u64,
    /// Those above their source's rate, or from a source too many.
    pub limited: u64,
}

#[derive(Debug, Clone)]
struct Source {
    follower: Follower,
    bucket: TokenBucket,
    heard_ns: u64,
    /// A number that grows with every message of any source.
    turn: u64,
}

/// Decides about each message; remembers per source what was taken.
#[derive(Debug, Clone, Default)]
pub struct Intake {
    limits: IntakeLimits,
    sources: BTreeMap<u64, Source>,
    turns: u64,
    counters: IntakeCounters,
}

impl Intake {
    /// Nothing taken yet.
    #[must_use]
    pub fn new(limits: IntakeLimits) -> Self {
        Self { limits, ..Self::default() }
    }

    /// Takes note of an observation that a former run of the daemon took, so that it is not taken twice; they come in their order, and
    /// of too many sources those count that spoke last.
    pub fn restore(&mut self, observation: &Observation, now_ns: u64) {
        if let Some(source) = self.source(observation.source, now_ns, 0) {
            source.follower.take(observation.epoch, observation.sequence);
        }
    }

    /// Judges what a port gave: a message that has passed [`roomcast_ipc::Message::check`], or why it has not.
    pub fn receive(&mut self, received: Result<&NarrationV1, MessageError>, now_ns: u64) -> Taken {
        match received {
            Ok(message) => self.take(message, now_ns),
            Err(error) => {
                self.counters.received += 1;
                self.counters.malformed += 1;
                Taken::Malformed(error.to_string())
            }
        }
    }

    /// Judges a message that has passed [`roomcast_ipc::Message::check`].
    pub fn take(&mut self, message: &NarrationV1, now_ns: u64) -> Taken {
        self.counters.received += 1;
        let sentence = match sentence_of(message.kind, message.text()) {
            Ok(sentence) => sentence,
            Err(error) => {
                self.counters.malformed += 1;
                return Taken::Malformed(error.to_string());
            }
        };
        let Some(source) = self.source(message.source, now_ns, FORGET_NS) else {
            self.counters.limited += 1;
            return Taken::Limited;
        };
        if !source.bucket.has_one(now_ns) {
            self.counters.limited += 1;
            return Taken::Limited;
        }
        let missed = match source.follower.take(message.epoch, message.sequence) {
            Arrival::New => 0,
            Arrival::AfterGap { missed } => missed,
            Arrival::Duplicate => {
                self.counters.duplicates += 1;
                return Taken::Duplicate;
            }
        };
        source.bucket.take();
        self.counters.missed = self.counters.missed.saturating_add(missed);
        self.counters.accepted += 1;
        let observation = Observation {
            person: message.person,
            source: message.source,
            epoch: message.epoch,
            sequence: message.sequence,
            // An observation cannot lie in the future: a narrator's clock is not trusted beyond that.
            observed_ns: message.observed_ns.min(now_ns),
            observed_unix_ns: message.observed_unix_ns,
            sentence,
        };
        Taken::Accepted { observation, missed }
    }

    /// The counters.
    #[must_use]
    pub fn counters(&self) -> IntakeCounters {
        self.counters
    }

    /// Sources known.
    #[must_use]
    pub fn sources(&self) -> usize {
        self.sources.len()
    }

    /// A source, known or new; in a full house the one that has been silent for longest goes, if that is `forget_ns` at least.
    fn source(&mut self, id: u64, now_ns: u64, forget_ns: u64) -> Option<&mut Source> {
        if !self.sources.contains_key(&id) && self.sources.len() >= SOURCES_MAX {
            let (silent, source) = self.sources.iter().min_by_key(|(_, source)| source.turn)?;
            if now_ns.saturating_sub(source.heard_ns) < forget_ns {
                return None;
            }
            let silent = *silent;
            self.sources.remove(&silent);
        }
        let bucket = TokenBucket::full(self.limits, now_ns);
        let new = || Source { follower: Follower::default(), bucket, heard_ns: 0, turn: 0 };
        self.turns += 1;
        let source = self.sources.entry(id).or_insert_with(new);
        (source.heard_ns, source.turn) = (now_ns, self.turns);
        Some(source)
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::narration_kind;

    use super::*;

    fn message(source: u64, epoch: u64, sequence: u64, text: &str) -> NarrationV1 {
        let kind = if text.starts_with('[') { narration_kind::ACTION } else { narration_kind::SENTENCE };
        NarrationV1 { source, epoch, sequence, observed_ns: 5, ..NarrationV1::new(kind, text).unwrap() }
    }

    #[test]
    fn each_narration_is_taken_once_and_gaps_are_counted() {
        let mut intake = Intake::new(IntakeLimits::default());
        let first = intake.take(&message(7, 1, 1, "[Grab] <mug> (1)"), 10);
        let Taken::Accepted { observation, missed: 0 } = first else { panic!("{first:?}") };
        assert_eq!(observation.sentence.as_str(), "They grab the mug.");
        assert_eq!(intake.take(&message(7, 1, 1, "[Grab] <mug> (1)"), 11), Taken::Duplicate);
        assert!(matches!(intake.take(&message(7, 1, 4, "They sit."), 12), Taken::Accepted { missed: 2, .. }));
        assert!(matches!(intake.take(&message(8, 1, 1, "They sit."), 12), Taken::Accepted { .. }));
        assert!(matches!(intake.take(&message(7, 1, 5, "[Fly] <mug> (1)"), 13), Taken::Malformed(_)));
        let counters = intake.counters();
        assert_eq!((counters.received, counters.accepted, counters.duplicates), (5, 3, 1));
        assert_eq!((counters.missed, counters.malformed), (2, 1));
    }

    #[test]
    fn a_flooding_source_is_held_and_the_others_are_not() {
        let mut intake = Intake::new(IntakeLimits { rate_per_s: 10.0, burst: 5.0 });
        let taken = (1..=100).filter(|n| matches!(intake.take(&message(7, 1, *n, "A."), 0), Taken::Accepted { .. }));
        assert_eq!(taken.count(), 5);
        assert!(matches!(intake.take(&message(8, 1, 1, "B."), 0), Taken::Accepted { .. }));
        // A tenth of a second later there is room for one; what it lost is known as missed.
        let later = intake.take(&message(7, 1, 101, "C."), 100_000_000);
        assert!(matches!(later, Taken::Accepted { missed: 95, .. }));
    }

    #[test]
    fn invented_sources_exhaust_nothing() {
        let mut intake = Intake::new(IntakeLimits::default());
        for source in 1..10_000 {
            intake.take(&message(source, 1, 1, "A."), 0);
        }
        assert_eq!(intake.sources(), SOURCES_MAX);
        assert!(matches!(intake.take(&message(3, 1, 2, "A."), 0), Taken::Accepted { .. }));
    }

    #[test]
    fn of_too_many_sources_those_count_that_spoke_last() {
        let mut intake = Intake::new(IntakeLimits::default());
        let Taken::Accepted { observation, .. } = intake.take(&message(1, 1, 1, "A."), 0) else { panic!() };
        for source in 1..=100 {
            intake.restore(&Observation { source, ..observation.clone() }, 7);
        }
        assert_eq!(intake.sources(), SOURCES_MAX);
        assert_eq!(intake.take(&message(100, 1, 1, "A."), 8), Taken::Duplicate);
        assert_eq!(intake.take(&message(36, 1, 1, "A."), 8), Taken::Limited);
        // An hour later there is room for a new one, and for one only while the others speak.
        for source in 38..=100 {
            assert!(matches!(intake.take(&message(source, 1, 2, "A."), FORGET_NS), Taken::Accepted { .. }));
        }
        assert!(matches!(intake.take(&message(36, 1, 1, "A."), FORGET_NS + 7), Taken::Accepted { .. }));
        assert_eq!(intake.take(&message(35, 1, 1, "A."), FORGET_NS + 7), Taken::Limited);
    }

    #[test]
    fn a_narrator_cannot_date_an_observation_into_the_future() {
        let mut intake = Intake::new(IntakeLimits::default());
        let future = NarrationV1 { observed_ns: u64::MAX, ..message(7, 1, 1, "A.") };
        let taken = intake.take(&future, 99);
        assert!(matches!(taken, Taken::Accepted { observation, .. } if observation.observed_ns == 99));
    }
}
