//! Prefetching and idle-time work.

use super::{Due, Pipeline, PipelineError};
use crate::grounding::GroundedScores;
use crate::ids::PersonId;
use crate::narration::history::History;
use crate::prepared::{Answer, Outlook, PersonOutlook};
use crate::prompt::write_prompt;
use crate::scorer::{LabelScores, LanguageModel, Progress, Tokenisation};

/// Prefetches answers and does idle-time work: [`Pipeline::ahead`].
#[derive(Debug)]
pub struct Ahead<'a, M>(pub(super) &'a mut Pipeline<M>);

impl<M: LanguageModel> Ahead<'_, M> {
    /// Registers `moved`, which is called after each call of the decoder, so that a watchdog does not take a long step for a hang.
    pub fn watch(&mut self, moved: Progress) {
        self.0.scorer.watch(moved);
    }

    /// The state that determines likely next prompts. Drops stale prefetched answers.
    pub fn outlook(&mut self) -> Outlook {
        let round = self.0.answers.begin(&self.0.histories);
        let of = |(person, history): (PersonId, &History)| {
            let own = self.0.persons.iter().find(|own| own.id == person && own.at_home && own.due == Due::Nothing);
            let label_log_prob_nats = own.map(|own| own.scores.log_prob_nats.clone()).unwrap_or_default();
            PersonOutlook { person, history: history.clone(), label_log_prob_nats }
        };
        Outlook::new(&self.0.prepared, self.0.histories.iter().map(of).collect(), round)
    }

    /// The room probabilities after one sentence alone, without any person's window; of an empty text, after none. Scores, windows and explanations
    /// are unchanged. The model has to read the narration of the last scored person again, which idle time does.
    ///
    /// # Errors
    /// If the model fails.
    pub fn rooms_of(&mut self, text: &str) -> Result<Vec<f64>, PipelineError> {
        let own = &mut *self.0;
        let trailing_space = own.options.tokenisation == Tokenisation::Paper;
        let mut prompt = String::new();
        let text = Some(text).filter(|text| !text.is_empty());
        write_prompt(text, &own.options.binding, trailing_space, &mut prompt);
        let (mut scores, mut grounded, mut nodes) = (LabelScores::default(), GroundedScores::default(), Vec::new());
        own.scorer.exchange_nodes(&mut nodes);
        let scored = own.scorer.score(&own.prepared, &prompt, own.options.method, &mut scores);
        own.scorer.exchange_nodes(&mut nodes);
        own.is_unread = true;
        scored?;
        own.grounding.ground(&scores.log_prob_nats, &mut grounded)?;
        Ok(grounded.partition_probability)
    }

    /// Stores a prefetched answer, and returns whether it is useful. It is useless if its person has acted since, the labels have changed, or the
    /// person already has [`crate::prepared::ANSWERS_MAX`] answers. It may replace another person's answer.
    pub fn keep_answer(&mut self, answer: Answer) -> bool {
        self.0.answers.keep(answer, &self.0.histories)
    }

    /// Does a small step of idle-time work: clears unusable data from the model's cache, cuts full history windows, and decodes narration that the
    /// model has not read yet, so that no event waits for it. Returns whether there is more to do.
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
        // A failure costs only time: the next event decodes the prompt, and reports the error if it persists.
        self.0.is_unread = !self.0.scorer.read_ahead(&self.0.prompt).unwrap_or_else(|error| {
            tracing::debug!(%error, "failed to read narration ahead");
            true
        });
        self.0.is_unread
    }
}
