//! Work that can be done before it is needed.

use super::{Due, Pipeline};
use crate::ids::PersonId;
use crate::narration::history::History;
use crate::prepared::{Answer, Outlook, PersonOutlook};
use crate::scorer::{LanguageModel, Progress};

/// Prepares answers, and does the work that can wait: [`Pipeline::ahead`].
#[derive(Debug)]
pub struct Ahead<'a, M>(pub(super) &'a mut Pipeline<M>);

impl<M: LanguageModel> Ahead<'_, M> {
    /// Has `moved` called after each call of the decoder: a thread that works so long is not taken for one that stands still.
    pub fn watch(&mut self, moved: Progress) {
        self.0.scorer.watch(moved);
    }

    /// What says which prompts may come next. Kept answers that are stale are dropped.
    pub fn outlook(&mut self) -> Outlook {
        let round = self.0.answers.begin(&self.0.histories);
        let of = |(person, history): (PersonId, &History)| {
            let own = self.0.persons.iter().find(|own| own.id == person && own.at_home && own.due == Due::Nothing);
            let label_log_prob_nats = own.map(|own| own.scores.log_prob_nats.clone()).unwrap_or_default();
            PersonOutlook { person, history: history.clone(), label_log_prob_nats }
        };
        Outlook::new(&self.0.prepared, self.0.histories.iter().map(of).collect(), round)
    }

    /// Keeps an answer for when it is asked for, and gives whether it is of use: not where its person has done something else since, the
    /// labels are other ones, or there are [`crate::prepared::ANSWERS_MAX`] of theirs. Another person's may go for it.
    pub fn keep_answer(&mut self, answer: Answer) -> bool {
        self.0.answers.keep(answer, &self.0.histories)
    }

    /// A small part of the work that can wait until no event does: clears the model's cache of what the next event cannot use, cuts the
    /// history windows that are full, and reads narration that the model has not read yet, so that no event waits for it. Gives whether there
    /// is more.
    pub fn tidy(&mut self) -> bool {
        self.0.scorer.tidy();
        let Some(person) = self.0.read else { return false };
        let Some(history) = self.0.histories.get_mut(person) else { return false };
        self.0.is_unread |= history.compact() > 0;
        if !self.0.is_unread || !self.0.options.binding.uses_narration() {
            return false;
        }
        self.0.prompt.clear();
        for sentence in history.sentences() {
            if !self.0.prompt.is_empty() {
                self.0.prompt.push(' ');
            }
            self.0.prompt.push_str(sentence);
        }
        // A failure costs the next event time, and shows there if it lasts.
        self.0.is_unread = !self.0.scorer.read_ahead(&self.0.prompt).unwrap_or_else(|error| {
            tracing::debug!(%error, "failed to read narration ahead");
            true
        });
        self.0.is_unread
    }
}
