//! Read access to a pipeline, for explanations and for the daemon.

use std::sync::Arc;

use super::{Effort, Method, Person, PersonScores, Pipeline, PipelineOptions};
use crate::ids::PersonId;
use crate::narration::history::Histories;
use crate::prepared::Preparer;
use crate::scorer::{IsStopped, LanguageModel, ModelError, ModelInfo, PreparedLabels, Token, TokenCounter};

/// Read access to a pipeline's parts: [`Pipeline::inside`].
#[derive(Debug)]
pub struct Inside<'a, M>(pub(super) &'a Pipeline<M>);

impl<M> Clone for Inside<'_, M> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<M> Copy for Inside<'_, M> {}

impl<'a, M: LanguageModel> Inside<'a, M> {
    /// The model's own description.
    pub fn model(self) -> &'a ModelInfo {
        self.0.scorer.info()
    }

    /// The labels with their tokens and trie.
    pub fn prepared(self) -> &'a Arc<PreparedLabels> {
        &self.0.prepared
    }

    /// The pipeline's options.
    pub fn options(self) -> &'a PipelineOptions {
        &self.0.options
    }

    /// The histories of all persons.
    pub fn histories(self) -> &'a Histories {
        &self.0.histories
    }

    /// The sentences that the model read for the newest scores, with their persons, the oldest first.
    pub fn read_sentences(self) -> impl Iterator<Item = (PersonId, &'a str)> + use<'a, M> {
        self.0.persons.iter().flat_map(|person| person.sentences().map(|sentence| (person.id, sentence)))
    }

    /// The scores of one person, if there are any.
    #[must_use]
    pub fn person(self, person: PersonId) -> Option<PersonScores<'a>> {
        self.0.persons().find(|scores| scores.person == person)
    }

    /// Whether a person waits for the model: the scores lack the newest observation, or there are none yet.
    #[must_use]
    pub fn waits(self, person: PersonId) -> bool {
        self.0.persons.iter().any(|own| own.id == person && own.waits())
    }

    /// Whether any person waits for the model.
    #[must_use]
    pub fn is_behind(self) -> bool {
        self.0.persons.iter().any(Person::waits)
    }

    /// Whether a person had scores for the previous map and has none yet for the current one.
    #[must_use]
    pub fn is_owing(self) -> bool {
        self.0.persons.iter().any(|own| own.at_home && own.is_owed)
    }

    /// Counts the tokens of a sentence, on any thread. A sentence and its separator have at most `history.tokens` of [`Inside::options`].
    pub fn token_counter(self) -> TokenCounter {
        self.0.scorer.model().token_counter()
    }

    /// The readable text of a token.
    pub fn token_text(self, token: Token) -> String {
        self.0.scorer.model().token_text(token)
    }

    /// `ln p(token | prompt and the tokens before it)` per token of a label in the last step, corrected, in nats. `None` if several persons were
    /// scored, or if the method does not keep these values.
    #[must_use]
    pub fn token_log_prob_nats(self, label: usize) -> Option<Vec<f64>> {
        let exact_trie = self.0.options.method == Method::Trie && self.0.options.effort == Effort::Exact;
        // The last prompt may belong to a person forgotten since.
        let is_read = |person: &Person| person.at_home && self.0.read == Some(person.id);
        if exact_trie && self.0.persons.len() <= 1 && self.0.persons.iter().all(is_read) {
            self.0.scorer.token_log_prob_nats(&self.0.prepared, label)
        } else {
            None
        }
    }

    /// The prior's contribution to a label's score in the last step, in nats: `ln g_c + ln k`. 0 without a prior, and if several persons were scored.
    #[must_use]
    pub fn prior_nats(self, label: usize) -> f64 {
        match self.0.persons.as_slice() {
            [] => self.0.prior_nats_of(&self.0.nobody, label),
            [person] => self.0.prior_nats_of(person, label),
            _ => 0.0,
        }
    }

    /// As [`Inside::prior_nats`] for one person; 0 for an unknown person.
    #[must_use]
    pub fn prior_nats_of_person(self, person: PersonId, label: usize) -> f64 {
        let own = self.0.persons.iter().find(|known| known.id == person);
        own.map_or(0.0, |own| self.0.prior_nats_of(own, label))
    }

    /// A background scorer for this pipeline, usable on any thread. It stops within one small decoding step after `is_stopped` returns true. `None`
    /// if prefetching is impossible: the model has no twin, or answers are not exact.
    ///
    /// # Errors
    /// If the model has no memory for a second cache.
    pub fn preparer(self, is_stopped: IsStopped) -> Result<Option<Preparer<M>>, ModelError> {
        if !self.0.keeps_answers() {
            return Ok(None);
        }
        Ok(self.0.scorer.model().twin(is_stopped)?.map(Preparer::new))
    }
}
