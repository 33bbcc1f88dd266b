//! Prefetching and idle-time work.

use super::{Due, Pipeline, PipelineError};
use crate::grounding::GroundedScores;
use crate::ids::PersonId;
use crate::narration::history::History;
use crate::prepared::{Answer, Outlook, PersonOutlook};
use crate::prompt::write_prompt;
use crate::scorer::certified::Effort;
use crate::scorer::{LabelScores, LanguageModel, Progress, ScoreError, Tokenisation};

/// Prefetches answers and does idle-time work: [`Pipeline::idle`].
#[derive(Debug)]
pub struct Idle<'a, M>(pub(super) &'a mut Pipeline<M>);

impl<M: LanguageModel> Idle<'_, M> {
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
    /// are unchanged. The second value is their weight ([`super::PersonScores::trust`]): 0, without a pass, of a weak model and of one that needs longer for
    /// a prompt than the deadline. The model has to read the narration of the last scored person
    /// again, which idle time does.
    ///
    /// # Errors
    /// If the model fails.
    pub fn rooms_of(&mut self, text: &str) -> Result<(Vec<f64>, f64), PipelineError> {
        let own = &mut *self.0;
        let is_slow = own.options.effort == Effort::Deadline && own.prompt_ns > own.options.deadline_ns;
        if is_slow || own.scorer.model().info().weakness.is_some() {
            let rooms = own.grounding.partitions().len();
            return Ok((vec![1.0 / rooms as f64; rooms], 0.0));
        }
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
        Ok((grounded.partition_probability, scores.trust))
    }

    /// Stores a prefetched answer, and returns whether it is useful. It is useless if its person has acted since, the labels have changed, or the
    /// person already has [`crate::prepared::ANSWERS_MAX`] answers. It may replace another person's answer.
    pub fn keep_answer(&mut self, answer: Answer) -> bool {
        self.0.answers.keep(answer, &self.0.histories)
    }

    /// Does a small part of the idle-time work: clears unusable data from the model's cache, and lets the model read what the next events need, so that
    /// no event waits for it. Returns whether there is more to do.
    pub fn tidy(&mut self) -> bool {
        self.0.scorer.tidy();
        self.read(true)
    }

    /// Does a small part of that work after an event. The events until the next cut of the window do their parts, so the event that cuts it takes no
    /// longer than others, even if no idle time was between them.
    pub fn read_on(&mut self) {
        self.read(false);
    }

    /// Returns whether there is more to read. A failure costs only time: the next event decodes the prompt, and reports the error if it persists.
    fn read(&mut self, is_idle: bool) -> bool {
        let Pipeline { scorer, histories, persons, prompt, options, read, is_unread, .. } = &mut *self.0;
        let Some(history) = read.and_then(|person| histories.get(person)) else { return false };
        if !options.binding.uses_narration() {
            return false;
        }
        let write = |prompt: &mut String, left: usize| {
            prompt.clear();
            for sentence in history.sentences().skip(left) {
                if !prompt.is_empty() {
                    prompt.push(' ');
                }
                prompt.push_str(sentence);
            }
        };
        let mut is_read = true;
        let mut note = |done: Result<bool, ScoreError>| {
            is_read &= done.unwrap_or_else(|error| {
                tracing::debug!(%error, "failed to read narration ahead");
                true
            });
        };
        if *is_unread {
            write(prompt, 0);
            note(scorer.read_ahead(prompt));
            *is_unread = !is_read;
            return true;
        }
        if persons.iter().filter(|person| person.at_home).nth(1).is_some() {
            // Another person's event takes the model's cache, and this window stays for the next event of this person.
            write(prompt, 0);
            note(scorer.read_part(prompt, 1));
        }
        if let Some((leave, events)) = history.next_cut() {
            write(prompt, leave);
            note(scorer.read_part(prompt, if is_idle { 1 } else { events }));
        }
        !is_read
    }
}
