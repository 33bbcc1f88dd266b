//! Answers that are ready before the event: the scores of prompts that may come next.
//!
//! A prompt's label scores depend on the prompt, the labels and the model alone. So what was scored ahead is what the event would have
//! been given, whenever its prompt is the same to the letter; whatever else has happened meanwhile makes another prompt, and a miss.
//!
//! A [`Preparer`] has a model of its own, so it can work on another thread than the [`crate::pipeline::Pipeline`]: that gives an
//! [`Outlook`], and keeps each [`Answer`] until it is asked for.

use std::hash::BuildHasher;
use std::sync::Arc;

use crate::ids::PersonId;
use crate::narration::history::{Histories, History};
use crate::narration::{Event, Sentence};
use crate::prompt::write_prompt;
use crate::scorer::{LabelScores, LanguageModel, Method, PreparedLabels, ScoreError, Scorer, Tokenisation};

/// Most answers that are kept at once, of all persons together.
pub const ANSWERS_MAX: usize = 256;

/// One person, as far as it says what comes next.
#[derive(Debug, Clone)]
pub struct PersonOutlook {
    /// Who.
    pub person: PersonId,
    /// What they did last.
    pub history: History,
    /// Per label `ln s_c` in nats; empty of whoever is out of the house, or whose scores are not of what they did last.
    pub label_log_prob_nats: Vec<f64>,
}

/// All that says which prompts may come next, as it was at one moment.
#[derive(Debug, Clone)]
pub struct Outlook {
    /// The labels to score.
    pub labels: Arc<PreparedLabels>,
    /// Everybody who is known, in the order of their numbers.
    pub persons: Vec<PersonOutlook>,
    round: u64,
}

/// A prompt that may come next.
#[derive(Debug)]
pub struct Ask {
    labels: Arc<PreparedLabels>,
    round: u64,
    person: PersonId,
    /// How much was told of the person before.
    told: u64,
    prompt: String,
    hash: u64,
}

impl Ask {
    /// A number that two prompts share where they are the same, and else hardly ever.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.hash
    }
}

/// The scores of a prompt that may come next.
#[derive(Debug)]
pub struct Answer {
    ask: Ask,
    pub(crate) scores: LabelScores,
    /// What an explanation shows: see [`Scorer::token_log_prob_nats`].
    pub(crate) node_log_prob_nats: Vec<f64>,
    is_spent: bool,
}

/// Scores prompts that may come next, with a model of its own.
#[derive(Debug)]
pub struct Preparer<M> {
    scorer: Scorer<M>,
}

impl<M: LanguageModel> Preparer<M> {
    /// On a model that answers as the pipeline's does.
    pub fn new(model: M) -> Self {
        Self { scorer: Scorer::new(model) }
    }

    /// The prompt that a person has after `sentence`, told by the voice that spoke last; none where nothing was told of them, or they have
    /// no scores of now.
    pub fn ask(&mut self, outlook: &Outlook, person: PersonId, sentence: &Sentence) -> Option<Ask> {
        let own = outlook.persons.iter().find(|own| own.person == person)?;
        if own.label_log_prob_nats.is_empty() {
            return None;
        }
        let tokens = self.scorer.cost_of(sentence.as_str());
        let (mut next, voice) = own.history.newest()?;
        next.event = Event::Did(sentence.clone());
        let mut history = own.history.clone();
        history.hear(next, voice, tokens);
        let labels = Arc::clone(&outlook.labels);
        let mut prompt = String::new();
        write_prompt(history.sentences(), labels.binding(), labels.tokenisation() == Tokenisation::Paper, &mut prompt);
        let hash = hash_of(&prompt);
        Some(Ask { labels, round: outlook.round, person, told: own.history.told(), prompt, hash })
    }

    /// Scores it.
    ///
    /// # Errors
    /// When the model fails, or was stopped.
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

/// Answers by their prompt, at most [`ANSWERS_MAX`].
#[derive(Debug, Default)]
pub(crate) struct PreparedAnswers {
    kept: Vec<Answer>,
    /// Of no use any more, and freed in silence: the thread that made them may be in the middle of using its memory.
    stale: Vec<Answer>,
    /// Grows when all that was asked before is of no use.
    round: u64,
}

impl PreparedAnswers {
    /// Gives a prompt's answer to `with`; true where there is one. Allocates and frees nothing.
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

    /// Begins with what is of use still: answers for whom nothing was told since. Makes room for more.
    pub(crate) fn begin(&mut self, histories: &Histories) -> u64 {
        self.kept.retain(|answer| !answer.is_spent && answer.is_current(histories));
        self.kept.reserve_exact(ANSWERS_MAX.saturating_sub(self.kept.len()));
        self.stale.clear();
        self.stale.reserve_exact(2 * ANSWERS_MAX);
        self.round
    }

    /// Keeps an answer, if it is of use; where there is no room, in place of a spent one or the least likely of somebody else, which came last.
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

    /// All are stale, also those that are on their way: the labels or the model's view of them are other ones, or somebody is forgotten.
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
    /// What was known when the answers of `round` began.
    pub(crate) fn new(labels: &Arc<PreparedLabels>, persons: Vec<PersonOutlook>, round: u64) -> Self {
        Self { labels: Arc::clone(labels), persons, round }
    }

    /// Another one says that no answer from before is kept any more.
    #[must_use]
    pub fn round(&self) -> u64 {
        self.round
    }
}
