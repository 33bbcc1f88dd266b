//! Entry of observations into the histories.

use std::collections::BTreeMap;

use super::{Pipeline, Quota};
use crate::ids::{EventId, PersonId};
use crate::narration::Observation;
use crate::scorer::LanguageModel;

/// Adds observations to the histories and removes them: [`Pipeline::intake`].
#[derive(Debug)]
pub struct Intake<'a, M>(pub(super) &'a mut Pipeline<M>);

impl<M: LanguageModel> Intake<'_, M> {
    /// Adds observations to the histories without scoring; each source is its own quota. It cannot fail, and a later failure of scoring loses no
    /// observation. Persons who leave home lose their window; persons reported as gone are forgotten. Returns the number of sentences that were left
    /// out because each takes more tokens than a window holds.
    pub fn observe(&mut self, observations: impl IntoIterator<Item = Observation>) -> usize {
        self.hear(observations.into_iter().map(|observation| (Quota::of_source(observation.source), observation)))
    }

    /// As [`Intake::observe`], with a quota per observation.
    pub fn hear(&mut self, observations: impl IntoIterator<Item = (Quota, Observation)>) -> usize {
        let mut costly = 0;
        for (quota, observation) in observations {
            let tokens = observation.sentence().map(|text| self.0.scorer.cost_of(text));
            if tokens.is_some_and(|tokens| tokens > self.0.options.history.tokens) {
                costly += 1;
                self.pass_over(observation.id());
                continue;
            }
            self.include(&observation, quota);
            self.0.enter_of(quota, observation, tokens);
        }
        costly
    }

    /// Adds an observation to its person's history. Scores do not count it as included: see [`Intake::include`].
    pub fn enter(&mut self, quota: Quota, observation: Observation) {
        let tokens = observation.sentence().map(|text| self.0.scorer.cost_of(text));
        self.0.enter_of(quota, observation, tokens);
    }

    /// Whether a sentence alone takes more tokens than a window holds.
    pub fn is_costly(&mut self, observation: &Observation) -> bool {
        let most = self.0.options.history.tokens;
        // An upper bound without the tokeniser: one token per byte, a space before the sentence, and the separator after it.
        observation.sentence().is_some_and(|text| text.len() + 2 > most && self.0.scorer.cost_of(text) > most)
    }

    /// Attributes all observations so far to a former run, with unknown quotas. Among waiting persons, the one with the newest observation is scored
    /// first.
    pub fn forget_quotas(&mut self) {
        self.0.histories.forget_quotas();
        for own in &mut self.0.persons {
            own.unscored.iter_mut().for_each(|unscored| unscored.quota = Quota::EARLIER.number);
            own.waits_from = u64::MAX - own.waits_until;
        }
    }

    /// Ends a person's window because the last observation is too old for a forecast. Returns whether the person's scores change; the next step
    /// computes them.
    pub fn end_window(&mut self, person: PersonId) -> bool {
        let ended = self.0.histories.get_mut(person).is_some_and(|history| history.end() > 0);
        if let Some(own) = self.0.persons.iter_mut().find(|own| ended && own.id == person) {
            own.wait_from(self.0.heard.turns());
        }
        ended
    }

    /// Counts an event as handled without a history entry, so that its narrator does not wait for it.
    pub fn pass_over(&mut self, event: EventId) {
        self.0.heard.pass_over(event);
    }

    /// Counts an observation as included in the next scores, for any number of persons.
    pub fn include(&mut self, observation: &Observation, quota: Quota) {
        self.0.heard.include(observation, quota);
    }

    /// Sets the last sequence per (source, epoch) that a former run handled. All events up to it count as accepted.
    pub fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.0.heard.settle(settled);
    }

    /// Forgets a start of a source that was replaced by another source.
    pub fn forget_source(&mut self, source: u64, epoch: u64) {
        self.0.heard.forget(source, epoch);
    }

    /// Forgets a person.
    pub fn forget_person(&mut self, person: PersonId) {
        // Prefetched prompts and the model's cache contain the person's actions.
        self.0.answers.clear();
        self.0.scorer.forget();
        self.0.histories.remove(person);
        self.0.persons.retain(|p| p.id != person);
    }

    /// Removes the observations that `is_it` selects from all histories. The next step rescores their persons.
    pub fn forget_told(&mut self, is_it: impl Fn(&Observation) -> bool) {
        let changed = self.0.histories.forget(is_it);
        if !changed.is_empty() {
            self.0.answers.clear();
            self.0.scorer.forget();
        }
        let turn = self.0.heard.turns();
        let theirs = self.0.persons.iter_mut().filter(|own| changed.contains(&own.id) && own.at_home);
        theirs.for_each(|own| own.wait_from(turn));
    }
}
