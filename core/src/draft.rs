//! A second model's scores of a person's next thing, for guesses at the next sentence ([`crate::guess`]).
//!
//! A small model that was trained on household activities may predict the next thing better than a large general one, in a hundredth of its time.
//! The probabilities of both models have the same weight. Only guesses use the second model: all published scores come from the pipeline's own model.

use std::sync::Arc;

use crate::narration::history::History;
use crate::prompt::write_prompt;
use crate::scorer::correction::CorrectionChoice;
use crate::scorer::{LabelScores, LanguageModel, Method, ModelError, PreparedLabels, ScoreError, Scorer, Tokenisation};

/// Scores a person's next thing with its own model.
#[derive(Debug)]
pub struct Drafter<M> {
    scorer: Scorer<M>,
    correction: CorrectionChoice,
    /// The labels of the last call, and the same labels in this model's tokens.
    labels: Option<(Arc<PreparedLabels>, PreparedLabels)>,
    prompt: String,
    scores: LabelScores,
}

impl<M: LanguageModel> Drafter<M> {
    /// Uses `model`; what `correction` leaves open follows the model's recommendation.
    pub fn new(model: M, correction: CorrectionChoice) -> Self {
        let (scorer, scores) = (Scorer::new(model), LabelScores::default());
        Self { scorer, correction, labels: None, prompt: String::new(), scores }
    }

    /// Mixes this model's scores into `log_prob_nats`, another model's `ln s_c` per label of `labels` in nats. Each model's probabilities among the
    /// labels count half. If the narration is too long for this model, nothing changes.
    ///
    /// # Errors
    /// If the model fails, is stopped, or cannot score these labels; nothing changes then.
    pub fn mix(
        &mut self,
        labels: &Arc<PreparedLabels>,
        history: &History,
        log_prob_nats: &mut [f64],
    ) -> Result<(), ScoreError> {
        let own = match self.labels.take().filter(|(known, _)| Arc::ptr_eq(known, labels)) {
            Some((_, own)) => own,
            None => {
                let correction = self.correction.or(self.scorer.info().correction);
                self.scorer.prepare(labels.labels(), labels.binding(), labels.tokenisation(), correction)?
            }
        };
        let (_, own) = self.labels.insert((Arc::clone(labels), own));
        let trailing_space = own.tokenisation() == Tokenisation::Paper;
        write_prompt(history.sentences(), own.binding(), trailing_space, &mut self.prompt);
        let scored = self.scorer.score(own, &self.prompt, Method::Trie, &mut self.scores);
        // Privacy: a person's events are kept no longer than needed.
        self.prompt.clear();
        match scored {
            Err(ScoreError::Model(ModelError::TooLong { .. })) => return Ok(()),
            scored => scored?,
        }
        let whole = |nats: &[f64]| nats.iter().map(|nats| nats.exp()).sum::<f64>().max(f64::MIN_POSITIVE);
        let (theirs, ours) = (whole(log_prob_nats), whole(&self.scores.log_prob_nats));
        for (nats, own) in log_prob_nats.iter_mut().zip(&self.scores.log_prob_nats) {
            *nats = (0.5 * nats.exp() / theirs + 0.5 * own.exp() / ours).ln();
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::narration::history::HistoryLimits;
    use crate::narration::{Observation, Sentence};
    use crate::prompt::BindingSequence;
    use crate::scorer::correction::Correction;
    use crate::scorer::table::TableModel;

    const LABELS: [&str; 3] = ["mug", "table", "sofa"];

    fn prepared(seed: u64, labels: &[&str]) -> Arc<PreparedLabels> {
        let mut scorer = Scorer::new(TableModel::new(seed));
        let binding = BindingSequence::default();
        Arc::new(scorer.prepare(labels, &binding, Tokenisation::Joint, Correction::default()).unwrap())
    }

    fn history() -> History {
        let mut history = History::new(HistoryLimits::exact(3));
        history.push(Observation::of(1, Sentence::new("They walk to the mug.").unwrap()), 5);
        history
    }

    #[test]
    fn both_models_have_half_a_say() {
        let labels = prepared(1, &LABELS);
        let mut drafter = Drafter::new(TableModel::new(2), CorrectionChoice::default());
        let history = history();
        let mut prompt = String::new();
        write_prompt(history.sentences(), labels.binding(), false, &mut prompt);
        let mut alone = LabelScores::default();
        Scorer::new(TableModel::new(2)).score(&prepared(2, &LABELS), &prompt, Method::Trie, &mut alone).unwrap();
        let whole: f64 = alone.log_prob_nats.iter().map(|nats| nats.exp()).sum();
        // The other model's probabilities need not sum to one.
        let mut mixed = [0.08_f64.ln(), 0.02_f64.ln(), f64::NEG_INFINITY];
        drafter.mix(&labels, &history, &mut mixed).unwrap();
        for ((mixed, own), theirs) in mixed.iter().zip(&alone.log_prob_nats).zip([0.8, 0.2, 0.0]) {
            assert!((mixed.exp() - 0.5 * theirs - 0.5 * own.exp() / whole).abs() < 1e-12);
        }
        // The labels of a changed map are tokenised again.
        let changed = prepared(1, &["mug", "armchair"]);
        let mut mixed = [0.5_f64.ln(); 2];
        drafter.mix(&changed, &history, &mut mixed).unwrap();
        assert!((mixed.iter().map(|nats| nats.exp()).sum::<f64>() - 1.0).abs() < 1e-12);
    }
}
