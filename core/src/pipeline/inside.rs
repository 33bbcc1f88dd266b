//! A look inside a pipeline, for explanations and for the daemon.

use std::sync::Arc;

use super::{Effort, Method, Person, PersonScores, Pipeline, PipelineOptions};
use crate::ids::PersonId;
use crate::narration::history::Histories;
use crate::prepared::Preparer;
use crate::scorer::{IsStopped, LanguageModel, ModelError, ModelInfo, PreparedLabels, Token, TokenCounter};

/// The parts of a pipeline, to be read: [`Pipeline::inside`].
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

    /// The labels' tokens and trie.
    pub fn prepared(self) -> &'a Arc<PreparedLabels> {
        &self.0.prepared
    }

    /// How this pipeline scores.
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

    /// Whether a person waits for the model: the scores do not contain the newest observation, or there are none yet.
    #[must_use]
    pub fn waits(self, person: PersonId) -> bool {
        self.0.persons.iter().any(|own| own.id == person && own.waits())
    }

    /// Whether any person waits for the model.
    #[must_use]
    pub fn is_behind(self) -> bool {
        self.0.persons.iter().any(Person::waits)
    }

    /// Whether a person with scores of the map before has none of the map in use.
    #[must_use]
    pub fn is_owing(self) -> bool {
        self.0.persons.iter().any(|own| own.at_home && own.is_owed)
    }

    /// Counts the tokens of a sentence, on any thread. With the token behind it a sentence has at most as many tokens as `history.tokens` of
    /// [`Inside::options`].
    pub fn token_counter(self) -> TokenCounter {
        self.0.scorer.model().token_counter()
    }

    /// A token's text, for people.
    pub fn token_text(self, token: Token) -> String {
        self.0.scorer.model().token_text(token)
    }

    /// Per token of a label ln p(token | prompt and the tokens before it), corrected, in nats, of the last step. `None` if several persons were
    /// scored, or if the method keeps no such numbers.
    #[must_use]
    pub fn token_log_prob_nats(self, label: usize) -> Option<Vec<f64>> {
        let exact_trie = self.0.options.method == Method::Trie && self.0.options.effort == Effort::Exact;
        // The model may have read the prompt of a person that is forgotten by now.
        let is_read = |person: &Person| person.at_home && self.0.read == Some(person.id);
        if exact_trie && self.0.persons.len() <= 1 && self.0.persons.iter().all(is_read) {
            self.0.scorer.token_log_prob_nats(&self.0.prepared, label)
        } else {
            None
        }
    }

    /// What the prior added to the sum over a label's tokens, in nats, in the last step; 0 without one, and where several persons were
    /// scored.
    #[must_use]
    pub fn prior_nats(self, label: usize) -> f64 {
        match self.0.persons.as_slice() {
            [] => self.0.prior_nats_of(&self.0.nobody, label),
            [person] => self.0.prior_nats_of(person, label),
            _ => 0.0,
        }
    }

    /// The same for one person; 0 for somebody unknown.
    #[must_use]
    pub fn prior_nats_of_person(self, person: PersonId, label: usize) -> f64 {
        let own = self.0.persons.iter().find(|known| known.id == person);
        own.map_or(0.0, |own| self.0.prior_nats_of(own, label))
    }

    /// What scores ahead for this pipeline, on any thread; it stops within a small step of the model where `is_stopped` says so. None where
    /// nothing can be prepared: without a model, and of answers that are not exact.
    ///
    /// # Errors
    /// When the model has no memory for a second cache.
    pub fn preparer(self, is_stopped: IsStopped) -> Result<Option<Preparer<M>>, ModelError> {
        if !self.0.keeps_answers() {
            return Ok(None);
        }
        Ok(self.0.scorer.model().twin(is_stopped)?.map(Preparer::new))
    }
}
