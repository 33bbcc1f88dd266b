//! From histories to scores: the pipeline, the events that wait for scores, and what the prefetcher knows.

use std::collections::BTreeMap;

use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::narration::{Observation, Quota};
use roomcast_core::pipeline::Pipeline;
use roomcast_core::prepared::Answer;
use roomcast_core::scorer::LanguageModel;

use super::readings::Readings;
use super::seconds;
use crate::daemon::persons::Persons;
use crate::daemon::prefetch::Now;

/// Counters of prefetching since the start, for the status.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PreparedTally {
    /// Prompts that steps scored.
    pub asked: u64,
    /// Prefetched answers that were kept.
    pub prepared: u64,
    /// Prefetched answers that a step used.
    pub used: u64,
}

#[derive(Debug)]
pub(super) struct Scoring<M> {
    pub(super) pipeline: Pipeline<M>,
    pub(super) readings: Readings,
    /// The time at which each person's first unscored event was received.
    unscored: BTreeMap<PersonId, BootNs>,
    unscored_ns: Option<BootNs>,
    unscored_gap: bool,
    /// The persons with an event whose expectation was not passed on.
    pub(super) rescored: Vec<PersonId>,
    pub(super) tally: PreparedTally,
    /// Changes when a person is forgotten. The prefetcher must then forget its sentences.
    forgotten: u64,
    /// Grows with each step that asked the model, and with each removed person.
    askings: u64,
    told_prefetcher: (u64, u64),
}

impl<M: LanguageModel> Scoring<M> {
    pub(super) fn new(pipeline: Pipeline<M>) -> Self {
        Self {
            pipeline,
            readings: Readings::default(),
            unscored: BTreeMap::new(),
            unscored_ns: None,
            unscored_gap: false,
            rescored: Vec::new(),
            tally: PreparedTally::default(),
            forgotten: 0,
            askings: 0,
            told_prefetcher: (0, 0),
        }
    }

    /// An event was received. `after_gap`: earlier ones of its narrator were lost.
    pub(super) fn receive(&mut self, after_gap: bool) {
        self.unscored_gap |= after_gap;
    }

    /// The part of one person in an event enters that person's history.
    pub(super) fn enter(&mut self, quota: Quota, own: Observation, received_ns: BootNs) {
        self.unscored.entry(own.person).or_insert(received_ns);
        self.pipeline.intake().enter(quota, own);
    }

    /// An event without a part for the model is confirmed with the next scores.
    pub(super) fn wait(&mut self, received_ns: BootNs) {
        self.unscored_ns.get_or_insert(received_ns);
    }

    pub(super) fn rescore(&mut self, person: PersonId) {
        if !self.rescored.contains(&person) {
            self.rescored.push(person);
        }
    }

    /// The time at which the oldest newly scored event was received, and whether events were lost before. Persons that still wait keep their times.
    pub(super) fn take_scored(&mut self) -> (Option<BootNs>, bool) {
        let mut received_ns = self.unscored_ns.take();
        let pipeline = &self.pipeline;
        self.unscored.retain(|person, first_ns| {
            let waits = pipeline.inside().waits(*person);
            if !waits {
                received_ns = Some(received_ns.map_or(*first_ns, |before_ns| before_ns.min(*first_ns)));
            }
            waits
        });
        (received_ns, std::mem::take(&mut self.unscored_gap))
    }

    /// Counts what a step asked the model. Returns whether prefetched answers gave all scores.
    pub(super) fn count(&mut self) -> bool {
        let scores = self.pipeline.scores();
        self.tally.asked += scores.asked as u64;
        self.askings += u64::from(scores.asked > 0);
        self.tally.used += scores.prepared as u64;
        scores.prepared > 0 && scores.prepared == scores.asked
    }

    /// The next person with a window that ends because the person was inactive for too long.
    pub(super) fn silent(&self, persons: &Persons, now_ns: i64) -> Option<PersonId> {
        let limits = self.pipeline.inside().options().history;
        let mut windows = self.pipeline.inside().histories().iter().filter(|(_, history)| !history.is_empty());
        let silent = |person: PersonId| {
            persons.get(person).is_some_and(|known| limits.is_gap(seconds(now_ns.saturating_sub(known.did_ns))))
        };
        windows.find(|(person, _)| silent(*person)).map(|(person, _)| person)
    }

    pub(super) fn drop_person(&mut self, person: PersonId) {
        self.pipeline.intake().forget_person(person);
        self.askings += 1;
    }

    /// Whether the prefetcher's state is stale.
    pub(super) fn is_prefetch_due(&self) -> bool {
        self.told_prefetcher != (self.askings, self.forgotten)
    }

    /// The state for the prefetcher.
    pub(super) fn now(&mut self) -> Now {
        self.told_prefetcher = (self.askings, self.forgotten);
        Now { outlook: self.pipeline.idle().outlook(), forgotten: self.forgotten }
    }

    /// Stores a prefetched answer, if it is useful.
    pub(super) fn keep_answer(&mut self, answer: Answer) {
        self.tally.prepared += u64::from(self.pipeline.idle().keep_answer(answer));
    }

    /// Makes the prefetcher forget all sentences.
    pub(super) fn forget_prefetched(&mut self) {
        self.forgotten += 1;
    }
}
