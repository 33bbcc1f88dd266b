//! Prefetching: scores of likely next prompts, computed before the event.
//!
//! A prompt's label scores depend only on the prompt, the labels and the model. If the prompt is identical, the prefetched scores are exactly the
//! scores that the event would have got. Any other event changes the prompt, which is a miss.
//!
//! A [`Preparer`] has its own model, so it can run on another thread than the [`crate::pipeline::Pipeline`]. The pipeline gives an [`Outlook`], and
//! stores each [`Answer`] until its prompt comes.

use std::hash::BuildHasher;
use std::sync::Arc;

use crate::ids::PersonId;
use crate::narration::history::{Histories, History};
use crate::narration::{Event, Sentence};
use crate::prompt::write_prompt;
use crate::scorer::{LabelScores, LanguageModel, Method, PreparedLabels, ScoreError, Scorer, Tokenisation};

/// Most stored answers, of all persons together.
pub const ANSWERS_MAX: usize = 256;

/// One person's state for predicting the next prompt.
#[derive(Debug, Clone)]
pub struct PersonOutlook {
    /// The person.
    pub person: PersonId,
    /// The person's latest events.
    pub history: History,
    /// `ln s_c` per label in nats. Empty if the person is out of the house, or if the scores lack the latest event.
    pub label_log_prob_nats: Vec<f64>,
}

/// A snapshot of the state that determines likely next prompts.
#[derive(Debug, Clone)]
pub struct Outlook {
    /// The labels to score.
    pub labels: Arc<PreparedLabels>,
    /// All known persons, sorted by id.
    pub persons: Vec<PersonOutlook>,
    round: u64,
}

/// A possible next prompt.
#[derive(Debug)]
pub struct Ask {
    labels: Arc<PreparedLabels>,
    round: u64,
    person: PersonId,
    /// [`History::told`] of the person at the time of the snapshot.
    told: u64,
    prompt: String,
    hash: u64,
}

impl Ask {
    /// A hash of the prompt: equal for equal prompts, otherwise almost surely different.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.hash
    }
}

/// The scores of a possible next prompt.
#[derive(Debug)]
pub struct Answer {
    ask: Ask,
    pub(crate) scores: LabelScores,
    /// Data for explanations: see [`Scorer::token_log_prob_nats`].
    pub(crate) node_log_prob_nats: Vec<f64>,
    is_spent: bool,
}

/// Scores possible next prompts with its own model.
#[derive(Debug)]
pub struct Preparer<M> {
    scorer: Scorer<M>,
}

impl<M: LanguageModel> Preparer<M> {
    /// Uses `model`, which must score like the pipeline's model.
    pub fn new(model: M) -> Self {
        Self { scorer: Scorer::new(model) }
    }

    /// The person's prompt after `sentence`, said by the quota of the person's newest event. `None` if the person has no event yet, or no current
    /// scores.
    pub fn ask(&mut self, outlook: &Outlook, person: PersonId, sentence: &Sentence) -> Option<Ask> {
        let own = outlook.persons.iter().find(|own| own.person == person)?;
        if own.label_log_prob_nats.is_empty() {
            return None;
        }
        let tokens = self.scorer.cost_of(sentence.as_str());
        let (mut next, quota) = own.history.newest()?;
        next.event = Event::Did(sentence.clone());
        let mut history = own.history.clone();
        history.hear(next, quota, tokens);
        let labels = Arc::clone(&outlook.labels);
        let mut prompt = String::new();
        write_prompt(history.sentences(), labels.binding(), labels.tokenisation() == Tokenisation::Paper, &mut prompt);
        let hash = hash_of(&prompt);
        Some(Ask { labels, round: outlook.round, person, told: own.history.told(), prompt, hash })
    }

    /// Scores the prompt.
    ///
    /// # Errors
    /// If the model fails, or is stopped.
    pub fn answer(&mut self, ask: Ask) -> Result<Answer, ScoreError> {
        let mut scores = LabelScores::default();
        self.scorer.score(&ask.labels, &ask.prompt, Method::Trie, &mut scores)?;
        let mut node_log_prob_nats = Vec::new();
        self.scorer.exchange_nodes(&mut node_log_prob_nats);
        Ok(Answer { ask, scores, node_log_prob_nats, is_spent: false })
    }
}

fn hash_of(prompt: &str) -> u64 {
    foldhash::fast::FixedState::default().hash_one(prompt)
}

/// Stored answers by prompt, at most [`ANSWERS_MAX`].
#[derive(Debug, Default)]
pub(crate) struct PreparedAnswers {
    kept: Vec<Answer>,
    /// Useless answers, freed later in idle time: the thread that made them may be using the allocator.
    stale: Vec<Answer>,
    /// Increases when all earlier prompts become useless.
    round: u64,
}

impl PreparedAnswers {
    /// Calls `with` with a prompt's answer, and returns whether there is one. Allocates and frees nothing.
    pub(crate) fn take(&mut self, prompt: &str, with: impl FnOnce(&mut Answer)) -> bool {
        if self.kept.is_empty() {
            return false;
        }
        let hash = hash_of(prompt);
        let is_it = |answer: &&mut Answer| answer.ask.hash == hash && !answer.is_spent && answer.ask.prompt == prompt;
        let Some(answer) = self.kept.iter_mut().find(is_it) else { return false };
        answer.is_spent = true;
        with(answer);
        true
    }

    /// Drops used answers and answers for persons with newer events, reserves memory, and returns the round.
    pub(crate) fn begin(&mut self, histories: &Histories) -> u64 {
        self.kept.retain(|answer| !answer.is_spent && answer.is_current(histories));
        self.kept.reserve_exact(ANSWERS_MAX.saturating_sub(self.kept.len()));
        self.stale.clear();
        self.stale.reserve_exact(2 * ANSWERS_MAX);
        self.round
    }

    /// Stores an answer if it is useful. If the store is full, it replaces a used answer or the last (least likely) answer of another person.
    pub(crate) fn keep(&mut self, answer: Answer, histories: &Histories) -> bool {
        let mut is_of_use = answer.ask.round == self.round && answer.is_current(histories);
        if is_of_use && self.kept.len() >= ANSWERS_MAX {
            let is_others = |kept: &Answer| kept.ask.person != answer.ask.person;
            let spent = self.kept.iter().position(|kept| kept.is_spent);
            match spent.or_else(|| self.kept.iter().rposition(is_others)) {
                Some(least) => self.stale.push(self.kept.remove(least)),
                None => is_of_use = false,
            }
        }
        if is_of_use {
            self.kept.push(answer)
        } else {
            self.stale.push(answer)
        }
        is_of_use
    }

    /// Invalidates all answers, even those still being computed: the labels have changed, or a person was forgotten.
    pub(crate) fn clear(&mut self) {
        self.kept.clear();
        self.stale.clear();
        self.round += 1;
    }
}

impl Answer {
    fn is_current(&self, histories: &Histories) -> bool {
        histories.get(self.ask.person).is_some_and(|history| history.told() == self.ask.told)
    }
}

impl Outlook {
    pub(crate) fn new(labels: &Arc<PreparedLabels>, persons: Vec<PersonOutlook>, round: u64) -> Self {
        Self { labels: Arc::clone(labels), persons, round }
    }

    /// Changes when all earlier answers become invalid.
    #[must_use]
    pub fn round(&self) -> u64 {
        self.round
    }
}
