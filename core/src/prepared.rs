//! Answers that are ready before the event: the scores of prompts that may come next.
//!
//! A prompt's label scores depend on the prompt, the labels and the model alone. So what was scored ahead is what the event would have
//! been given, whenever its prompt is the same to the letter; whatever else has happened meanwhile makes another prompt, and a miss.

use std::collections::HashMap;

use crate::scorer::LabelScores;

/// Most answers that are kept at once, of all persons together.
pub const ANSWERS_MAX: usize = 256;

/// The scores of one prompt.
#[derive(Debug, Default)]
pub(crate) struct Answer {
    /// Whose next prompt it would be.
    person: u32,
    pub(crate) scores: LabelScores,
    /// What an explanation shows: see [`crate::scorer::Scorer::token_log_prob_nats`].
    pub(crate) node_log_prob_nats: Vec<f64>,
}

/// Answers by their prompt, at most [`ANSWERS_MAX`].
#[derive(Debug, Default)]
pub(crate) struct PreparedAnswers {
    by_prompt: HashMap<String, Answer, foldhash::fast::RandomState>,
    /// Buffers of answers that are stale.
    spare: Vec<(String, Answer)>,
}

impl PreparedAnswers {
    pub(crate) fn contains(&self, prompt: &str) -> bool {
        self.by_prompt.contains_key(prompt)
    }

    pub(crate) fn is_full(&self) -> bool {
        self.by_prompt.len() >= ANSWERS_MAX
    }

    /// Gives a prompt's answer to `with`; true where there is one.
    pub(crate) fn take(&mut self, prompt: &str, with: impl FnOnce(&mut Answer)) -> bool {
        let Some((prompt, mut answer)) = self.by_prompt.remove_entry(prompt) else { return false };
        with(&mut answer);
        self.spare.push((prompt, answer));
        true
    }

    /// An empty answer to fill.
    pub(crate) fn begin(&mut self) -> Answer {
        self.spare.pop().map(|(_, answer)| answer).unwrap_or_default()
    }

    /// Keeps an answer to a person's next prompt.
    pub(crate) fn keep(&mut self, person: u32, prompt: &str, mut answer: Answer) {
        answer.person = person;
        self.by_prompt.insert(prompt.to_owned(), answer);
    }

    /// A person's answers are stale: their prompt goes on from somewhere else.
    pub(crate) fn drop_person(&mut self, person: u32) {
        self.spare.extend(self.by_prompt.extract_if(|_, answer| answer.person == person));
        self.spare.truncate(ANSWERS_MAX);
    }

    /// All are stale: the labels or the model's view of them are other ones.
    pub(crate) fn clear(&mut self) {
        self.by_prompt.clear();
        self.spare.clear();
    }
}
