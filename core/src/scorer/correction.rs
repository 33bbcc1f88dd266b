//! Corrections of Equation 1, so that scores reflect the next object instead of the frequency of words.
//!
//! A language model spreads its probability over all texts, and a map's labels are only a few of them. This has two side effects, each with its
//! correction:
//!
//! **Unusual words cost.** A word that is not in the vocabulary is several tokens ("def" "ib" "rill" "ator"). Each token that surprises the model
//! lowers the score, even if no other label of the map begins this way. [`Continuation::Labels`] lets a label's tokens after the first compete only
//! with the continuations of the map's labels: `p(t | n) / sum over children t' of n of p(t' | n)`. If a label ends at a node with children
//! ("coffee", "coffee maker"), the label gets the probability that its continuations leave. A node's children then add up to exactly the node's
//! probability. Tokens after the last one shared with another label are certain and not decoded. The cost of the first token remains. A label also
//! gets the probability of every text that begins like it, words outside the map included.
//!
//! **Common words win.** Frequently used objects score high after any narration. A *prior weight* `a` divides a label's score by its score under a
//! blank narration, to the power of `a`: `s'_c = k s_c g_c` with the gain `g_c = s_c(blank)^-a`. 0 leaves Equation 1 as it is; 1 is the pointwise
//! mutual information of Holtzman et al., "Surface Form Competition" (2021). The scale `k = min(1, sum s_c) / sum s_c g_c` gives the labels the same
//! sum as before. (A sum can exceed 1 under plain Equation 1 if one label begins another, and if labels have the same tokens.) `s_c(blank)` counts as
//! at least e^-20 of the largest, so that a very rare word does not gain without bound.
//!
//! Neither is in the paper. Both are off unless the configuration or the model file asks for them (GGUF keys `roomcast.continuation` and
//! `roomcast.prior`). The embedded model's file does.

use std::str::FromStr;

use super::softmax::log_sum_exp_of as log_sum_exp;
use crate::label_trie::{LabelTrie, Token};

/// GGUF key of the recommended [`Continuation`], a string: `free` or `labels`.
pub(crate) const CONTINUATION_KEY: &str = "roomcast.continuation";
/// GGUF key of the recommended prior weight, a number from 0 to 1.
pub(crate) const PRIOR_KEY: &str = "roomcast.prior";

crate::choices! {
    /// The competitors of a label's tokens after the first.
    #[derive(Default, Hash)]
    pub enum Continuation {
        /// Every token of the vocabulary: Equation 1.
        #[default]
        Free,
        /// Continuations of the map's other labels.
        Labels,
    }
}

impl Continuation {
    /// The tokens that share the probability of `node`; `None` for the whole vocabulary. The first tokens after a prompt always compete with the
    /// whole vocabulary.
    pub(super) fn rivals(self, trie: &LabelTrie, node: Option<usize>) -> Option<impl Iterator<Item = Token> + Clone> {
        let node = node.filter(|_| self == Self::Labels)?;
        Some(trie.children(Some(node)).map(|child| trie.nodes()[child].token))
    }
}

/// How label scores are corrected. The default is plain Equation 1.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Correction {
    /// The competitors of a label's tokens after the first.
    pub continuation: Continuation,
    /// The prior weight `a`, one of [`PRIOR_WEIGHTS`].
    #[serde(deserialize_with = "checked_weight")]
    pub prior: f64,
}

/// Range of the prior weight.
pub const PRIOR_WEIGHTS: std::ops::RangeInclusive<f64> = 0.0..=1.0;

/// A recording is untrusted, so its weight is checked.
fn checked_weight<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let weight: f64 = serde::Deserialize::deserialize(deserializer)?;
    match PRIOR_WEIGHTS.contains(&weight) {
        true => Ok(weight),
        false => Err(serde::de::Error::custom(format!("the prior weight is {weight}, not a number from 0 to 1"))),
    }
}

impl std::fmt::Display for Correction {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { continuation, prior } = self;
        write!(f, "Equation 1")?;
        match (continuation, *prior == 0.0) {
            (Continuation::Free, true) => Ok(()),
            (Continuation::Free, false) => write!(f, " with a prior of {prior}"),
            (Continuation::Labels, true) => write!(f, " with labels' continuations"),
            (Continuation::Labels, false) => write!(f, " with labels' continuations and a prior of {prior}"),
        }
    }
}

impl Correction {
    /// The correction that a model file recommends; `value` gives the text of a metadata key.
    ///
    /// # Errors
    /// If a value is invalid.
    pub fn recommended(value: impl Fn(&str) -> Option<String>) -> Result<Self, String> {
        let start = |text: &str| text.chars().take(40).collect::<String>();
        let continuation = match value(CONTINUATION_KEY) {
            None => Continuation::default(),
            Some(text) => Continuation::from_str(&text)
                .map_err(|_| format!("{CONTINUATION_KEY} is {:?}, not \"free\" or \"labels\"", start(&text)))?,
        };
        let prior = match value(PRIOR_KEY) {
            None => 0.0,
            Some(text) => prior_weight(&text).map_err(|fault| format!("{PRIOR_KEY} is {:?}: {fault}", start(&text)))?,
        };
        Ok(Self { continuation, prior })
    }
}

/// Parses a prior weight.
///
/// # Errors
/// If it is not a number from 0 to 1.
pub fn prior_weight(text: &str) -> Result<f64, String> {
    match f64::from_str(text) {
        Ok(weight) if PRIOR_WEIGHTS.contains(&weight) => Ok(weight),
        _ => Err("give a number from 0 to 1".into()),
    }
}

/// A user's choice of correction. Fields left out follow the model file.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CorrectionChoice {
    /// The competitors of a label's tokens after the first; as the model file recommends if left out.
    pub continuation: Option<Continuation>,
    /// Weight from 0 to 1 of the division by the scores of a blank narration; as the model file recommends if left out.
    pub prior: Option<f64>,
}

impl CorrectionChoice {
    /// Plain Equation 1, whatever the model file recommends.
    pub const EQUATION_1: Self = Self { continuation: Some(Continuation::Free), prior: Some(0.0) };

    /// This correction, whatever the model file recommends.
    #[must_use]
    pub fn exactly(Correction { continuation, prior }: Correction) -> Self {
        Self { continuation: Some(continuation), prior: Some(prior) }
    }

    /// This choice, with the model's recommendation for fields left out.
    #[must_use]
    pub fn or(self, recommended: Correction) -> Correction {
        Correction {
            continuation: self.continuation.unwrap_or(recommended.continuation),
            prior: self.prior.unwrap_or(recommended.prior),
        }
    }
}

/// Scores under a blank narration count as at most this far below the largest, in nats.
const DEEPEST_NATS: f64 = 20.0;

/// `ln g_c` per label in nats, from `ln s_c(blank)`. A common constant makes the greatest 0.
pub(super) fn gains(blank_log_prob_nats: &[f64], prior: f64) -> Vec<f64> {
    let largest = blank_log_prob_nats.iter().copied().fold(f64::MIN, f64::max);
    let raised = || blank_log_prob_nats.iter().map(|&blank| blank.max(largest - DEEPEST_NATS));
    let least = raised().fold(f64::INFINITY, f64::min);
    raised().map(|blank| prior * (least - blank)).collect()
}

/// Adds the gains and `ln k` to the scores, in nats, and returns `ln k`.
pub(super) fn rescale(log_prob_nats: &mut [f64], gain_nats: &[f64]) -> f64 {
    let before = log_sum_exp(log_prob_nats.iter().copied()).min(0.0);
    log_prob_nats.iter_mut().zip(gain_nats).for_each(|(score, gain)| *score += gain);
    let scale_nats = before - log_sum_exp(log_prob_nats.iter().copied());
    // If every score is zero, they stay zero.
    let scale_nats = if scale_nats.is_finite() { scale_nats } else { 0.0 };
    log_prob_nats.iter_mut().for_each(|score| *score += scale_nats);
    scale_nats
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blank_narration_keeps_its_sum_and_is_flattened() {
        let blank = [0.6_f64.ln(), 0.1_f64.ln(), 0.001_f64.ln()];
        for prior in [0.0, 0.3, 1.0] {
            let mut corrected = blank;
            rescale(&mut corrected, &gains(&blank, prior));
            let corrected = corrected.map(f64::exp);
            assert!((corrected.iter().sum::<f64>() - 0.701).abs() < 1e-12);
            let ratio = (corrected[0] / corrected[2]).ln();
            assert!((ratio - (1.0 - prior) * 600_f64.ln()).abs() < 1e-12);
        }
    }

    #[test]
    fn what_is_never_said_does_not_get_all() {
        let gains = gains(&[-1.0, -2.0, -90.0, f64::NEG_INFINITY], 1.0);
        assert_eq!(gains, [-20.0, -19.0, 0.0, 0.0]);
        let mut scores = [-1.0, -2.0, -90.0, -30.0];
        rescale(&mut scores, &gains);
        assert!(scores[0] > -1.4 && scores[1] > -1.4 && scores[3] < -9.0, "{scores:?}");
    }

    /// Under plain Equation 1 "coffee" and "coffee maker" may sum to more than 1.
    #[test]
    fn no_score_comes_to_more_than_one() {
        let mut scores = [0.70_f64.ln(), 0.63_f64.ln()];
        rescale(&mut scores, &gains(&[0.02_f64.ln(), 0.002_f64.ln()], 1.0));
        assert!(scores.iter().all(|score| *score <= 0.0) && (log_sum_exp(scores.into_iter())).abs() < 1e-12);
        let mut nothing = [f64::NEG_INFINITY; 2];
        assert_eq!(rescale(&mut nothing, &[0.0, -1.0]), 0.0);
        assert_eq!(nothing, [f64::NEG_INFINITY; 2]);
    }

    #[test]
    fn what_a_file_recommends_is_read_or_refused() {
        let read = |continuation: Option<&str>, prior: Option<&str>| {
            Correction::recommended(|key| if key == PRIOR_KEY { prior } else { continuation }.map(ToOwned::to_owned))
        };
        assert_eq!(read(None, None), Ok(Correction::default()));
        let recommended = Correction { continuation: Continuation::Labels, prior: 0.45 };
        assert_eq!(read(Some("labels"), Some("0.450000")), Ok(recommended));
        for (continuation, prior) in
            [(Some("Labels"), None), (None, Some("nan")), (None, Some("1.5")), (None, Some(""))]
        {
            assert!(read(continuation, prior).unwrap_err().contains("roomcast."));
        }
        let written = serde_json::to_string(&recommended).unwrap();
        assert_eq!(serde_json::from_str::<Correction>(&written).unwrap(), recommended);
        assert!(serde_json::from_str::<Correction>(&written.replace("0.45", "3e9")).is_err());
        assert_eq!(CorrectionChoice::EQUATION_1.or(recommended), Correction::default());
        assert_eq!(CorrectionChoice::default().or(recommended), recommended);
    }
}
