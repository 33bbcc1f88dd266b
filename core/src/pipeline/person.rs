//! One person's part of a pipeline: their scores, and the work that is still due.

use super::PipelineOptions;
use crate::grounding::{GroundedScores, Grounding, GroundingError};
use crate::ids::PersonId;
use crate::narration::history::{History, Quota};
use crate::prompt::write_prompt;
use crate::scorer::certified::{Bounds, Certified, Effort};
use crate::scorer::{LabelScores, Tokenisation};

/// Work due before a person's scores are current.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Due {
    Nothing,
    /// The model's label scores are current; the sums per partition are not.
    Grounding,
    /// The model must be asked.
    Scoring,
}

/// The first event of a source start that a person's scores do not contain yet.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unscored {
    pub(super) source: u64,
    pub(super) epoch: u64,
    pub(super) sequence: u64,
    pub(super) quota: u64,
}

#[derive(Debug)]
pub(super) struct Person {
    pub(super) id: PersonId,
    pub(super) at_home: bool,
    pub(super) scores: LabelScores,
    pub(super) grounded: GroundedScores,
    pub(super) lower_log_score_nats: Vec<f64>,
    pub(super) upper_log_score_nats: Vec<f64>,
    /// Set only for partial answers.
    pub(super) certified: Option<Certified>,
    pub(super) due: Due,
    /// Turns of the first and the newest event that wait for the scores.
    pub(super) waits_from: u64,
    pub(super) waits_until: u64,
    pub(super) unscored: Vec<Unscored>,
    /// The person had scores for the previous map and has none yet for the current one.
    pub(super) is_owed: bool,
    /// Number of the scores, unique among all persons.
    pub(super) number: u64,
    /// The prompt behind the scores, and the end of each sentence in it in bytes. The history may have been cut since.
    pub(super) prompt: String,
    pub(super) sentence_ends: Vec<usize>,
    pub(super) window: usize,
}

impl Person {
    pub(super) fn new(id: PersonId) -> Self {
        Self {
            id,
            at_home: true,
            scores: LabelScores::default(),
            grounded: GroundedScores::default(),
            lower_log_score_nats: Vec::new(),
            upper_log_score_nats: Vec::new(),
            certified: None,
            due: Due::Scoring,
            waits_from: 0,
            waits_until: 0,
            unscored: Vec::new(),
            is_owed: false,
            number: 0,
            prompt: String::new(),
            sentence_ends: Vec::new(),
            window: 0,
        }
    }

    /// Whether the model must be asked.
    pub(super) fn waits(&self) -> bool {
        self.at_home && self.due == Due::Scoring
    }

    /// Whether there are scores for the current map.
    pub(super) fn is_scored(&self) -> bool {
        !self.grounded.partition_probability.is_empty()
    }

    /// The quotas of the unscored events. [`Quota::EARLIER`] if the scores changed by time alone.
    pub(super) fn quotas(&self) -> impl Iterator<Item = u64> {
        let of_none = self.unscored.is_empty().then_some(Quota::EARLIER.number);
        self.unscored.iter().map(|own| own.quota).chain(of_none)
    }

    /// Marks the person for scoring; `turn` is the turn of the newest event.
    pub(super) fn wait_from(&mut self, turn: u64) {
        if self.due != Due::Scoring {
            self.waits_from = turn;
        }
        (self.due, self.waits_until) = (Due::Scoring, turn);
    }

    pub(super) fn write_prompt(&mut self, history: Option<&History>, options: &PipelineOptions) {
        let trailing_space = options.tokenisation == Tokenisation::Paper;
        let sentences = || history.into_iter().flat_map(History::sentences);
        write_prompt(sentences(), &options.binding, trailing_space, &mut self.prompt);
        self.window = history.map_or(0, History::len);
        self.sentence_ends.clear();
        if options.binding.uses_narration() {
            let mut end = 0;
            for sentence in sentences() {
                end += sentence.len();
                self.sentence_ends.push(end);
                end += 1;
            }
        }
    }

    /// The bounds of a partial answer.
    pub(super) fn partial(&self) -> Option<&Bounds> {
        self.certified.as_ref().map(|certified| &certified.bounds).filter(|bounds| bounds.reached != Effort::Exact)
    }

    pub(super) fn reached(&self) -> Effort {
        self.partial().map_or(Effort::Exact, |bounds| bounds.reached)
    }

    pub(super) fn ground(&mut self, grounding: &Grounding) -> Result<(), GroundingError> {
        if self.at_home {
            grounding.ground(&self.scores.log_prob_nats, &mut self.grounded)?;
        } else {
            self.scores.log_prob_nats.clear();
            self.scores.log_prob_nats.resize(grounding.scored_labels().len(), f64::NEG_INFINITY);
            self.grounded.nowhere(grounding.partitions().len());
            self.certified = None;
            (self.window, self.prompt, self.sentence_ends) = Default::default();
        }
        let (mut lower, mut upper) =
            (std::mem::take(&mut self.lower_log_score_nats), std::mem::take(&mut self.upper_log_score_nats));
        lower.clear();
        upper.clear();
        match self.partial() {
            Some(bounds) => {
                lower.extend(bounds.lower.iter().map(|score| score.ln()));
                upper.extend(bounds.upper.iter().map(|score| score.ln()));
            }
            None => {
                lower.extend_from_slice(&self.grounded.partition_log_score_nats);
                upper.extend_from_slice(&self.grounded.partition_log_score_nats);
            }
        }
        (self.lower_log_score_nats, self.upper_log_score_nats) = (lower, upper);
        Ok(())
    }

    /// Bounds of a partition's probability: its lower bound against the others' upper bounds, and the reverse.
    pub(super) fn probability_bounds(&self, partition: usize) -> (f64, f64) {
        let Some(Bounds { lower, upper, .. }) = self.partial() else {
            let exact = self.grounded.partition_probability[partition];
            return (exact, exact);
        };
        let even = 1.0 / lower.len() as f64;
        let others = |side: &[f64]| -> f64 {
            side.iter().enumerate().filter(|(other, _)| *other != partition).map(|(_, score)| score).sum()
        };
        // If no partition has a score, all are equally likely.
        let share = |own: f64, others: f64| if own + others > 0.0 { own / (own + others) } else { even };
        (share(lower[partition], others(upper)), share(upper[partition], others(lower)))
    }

    pub(super) fn sentences(&self) -> impl Iterator<Item = &str> {
        let starts = std::iter::once(0).chain(self.sentence_ends.iter().map(|end| end + 1));
        starts.zip(&self.sentence_ends).map(|(start, &end)| &self.prompt[start..end])
    }
}
