//! A deterministic language model for tests and benches. A seed determines its next-token probabilities.
//!
//! Its tokens are bytes. The logits after a sequence depend on its last [`TableModel::MEMORY`] tokens by a fixed hash, so that any score can be
//! recomputed by hand.

use super::correction::Correction;
use std::cell::Cell;

use super::{Clock, DecodeStats, IsStopped, LanguageModel, ModelError, ModelInfo, TextStart, Token};
use crate::label_trie::{PROMPT, TokenTree};

thread_local! {
    static NOW_NS: Cell<u64> = const { Cell::new(0) };
}

/// The deterministic model of this module.
#[derive(Debug, Clone)]
pub struct TableModel {
    info: ModelInfo,
    seed: u64,
    row: Vec<f32>,
    history: Vec<Token>,
    kept: Vec<Token>,
    is_slow: bool,
}

impl TableModel {
    /// Duration of a prompt for a slow model, in nanoseconds of its clock.
    pub const PROMPT_NS: u64 = 400_000_000;
    /// Number of previous tokens that the next one depends on.
    pub const MEMORY: usize = 8;
    /// 256 bytes and the start token.
    pub(crate) const VOCABULARY: usize = 257;
    const START: Token = Token(256);

    /// A model over bytes; another seed gives other probabilities.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self {
            info: ModelInfo {
                name: format!("table-{seed}"),
                architecture: "table".into(),
                description: "deterministic table over bytes, no language model".into(),
                parameters: 0,
                size_bytes: 0,
                vocabulary: Self::VOCABULARY,
                context_tokens: 1 << 20,
                shares_prefix: true,
                correction: Correction::default(),
                weakness: None,
                fingerprint: {
                    let mut fingerprint = [0; 32];
                    fingerprint[..8].copy_from_slice(&seed.to_le_bytes());
                    fingerprint
                },
            },
            seed,
            row: vec![0.0; Self::VOCABULARY],
            history: Vec::new(),
            kept: Vec::new(),
            is_slow: false,
        }
    }

    /// As [`Self::new`], but each prompt takes [`Self::PROMPT_NS`] by the model's clock. The clock is shared within a thread and otherwise stands
    /// still.
    #[must_use]
    pub fn slow(seed: u64) -> Self {
        Self { is_slow: true, ..Self::new(seed) }
    }

    /// Writes the logits after `sequence`, one per token: a fixed function of the seed and the last [`Self::MEMORY`] tokens.
    fn fill(&self, sequence: &[Token], row: &mut [f32]) {
        let recent = &sequence[sequence.len().saturating_sub(Self::MEMORY)..];
        let mut state = self.seed ^ 0x9e37_79b9_7f4a_7c15;
        for token in recent {
            state = mix(state ^ u64::from(token.0.cast_unsigned()));
        }
        for (token, logit) in (0_u64..).zip(row) {
            // Sixteen random bits over -4..4 nats.
            *logit = (mix(state.wrapping_add(token)) >> 48) as f32 / 8192.0 - 4.0;
        }
    }
}

/// The finaliser of SplitMix64.
fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

impl LanguageModel for TableModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn clock(&self) -> Clock {
        if self.is_slow { || NOW_NS.get() } else { || 0 }
    }

    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
        if start == TextStart::Sequence {
            out.push(Self::START);
        }
        out.extend(text.bytes().map(|b| Token(i32::from(b))));
        Ok(())
    }

    fn token_text(&self, token: Token) -> String {
        u8::try_from(token.0).map_or_else(|_| "<start>".into(), |b| char::from(b).to_string())
    }

    fn forget(&mut self) {
        self.kept.clear();
    }

    fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
        Ok(Some(self.clone()))
    }

    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError> {
        if self.is_slow {
            NOW_NS.set(NOW_NS.get() + Self::PROMPT_NS);
        }
        let context = self.info.context_tokens;
        if prompt.len() + tree.len() > context {
            return Err(ModelError::TooLong { prompt: prompt.len(), tree: tree.len(), context });
        }
        let shared = super::common_prefix(&self.kept, prompt);
        self.kept.clear();
        self.kept.extend_from_slice(prompt);
        let mut row = std::mem::take(&mut self.row);
        let mut history = std::mem::take(&mut self.history);
        if want_prompt_row {
            self.fill(prompt, &mut row);
            visit(0, &row);
        }
        for index in 0..tree.len() {
            history.clear();
            let mut node = index as u32;
            while node != PROMPT && history.len() < Self::MEMORY {
                history.push(tree.token(node as usize));
                node = tree.parent(node as usize);
            }
            history.extend(prompt.iter().rev().take(Self::MEMORY.saturating_sub(history.len())));
            history.reverse();
            self.fill(&history, &mut row);
            visit(index + 1, &row);
        }
        self.row = row;
        self.history = history;
        Ok(DecodeStats {
            calls: 1,
            prompt_tokens_decoded: (prompt.len() - shared) as u32,
            tree_tokens_decoded: tree.len() as u32,
            decoder_ns: 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::correction::Continuation;
    use super::super::{LabelScores, Method, Scorer, Tokenisation, softmax};
    use super::*;
    use crate::prompt::{BindingSequence, write_prompt};

    fn logits_after(model: &TableModel, sequence: &[Token]) -> Vec<f32> {
        let mut row = vec![0.0; TableModel::VOCABULARY];
        model.fill(sequence, &mut row);
        row
    }

    fn by_hand(model: &TableModel, prompt: &str, label: &str) -> f64 {
        let mut sequence = Vec::new();
        model.tokenise(prompt, TextStart::Sequence, &mut sequence).unwrap();
        let mut sum = 0.0;
        for byte in format!(" {label}").bytes() {
            let row = logits_after(model, &sequence);
            sum += f64::from(row[usize::from(byte)]) - softmax::log_sum_exp(&row);
            sequence.push(Token(i32::from(byte)));
        }
        sum
    }

    proptest::proptest! {
        /// Equation 1 by all three methods, against the product computed by hand from the table.
        #[test]
        fn every_method_gives_equation_1(
            seed: u64,
            narration in proptest::collection::vec("[A-Z][a-z ]{0,30}\\.", 0..6),
            labels in proptest::collection::hash_set("[a-c]{1,4}( [a-c]{1,3})?", 1..30),
            binding in proptest::sample::select(BindingSequence::all_built_in().collect::<Vec<_>>()),
        ) {
            let labels: Vec<String> = labels.into_iter().collect();
            let model = TableModel::new(seed);
            let mut scorer = Scorer::new(model.clone());
            let prepared = scorer.prepare(&labels, &binding, Tokenisation::Joint, Correction::default()).unwrap();
            let mut prompt = String::new();
            write_prompt(narration.iter().map(String::as_str), &binding, false, &mut prompt);
            let mut scores = LabelScores::default();
            for method in [Method::Trie, Method::SharedPrefix, Method::Independent] {
                scorer.score(&prepared, &prompt, method, &mut scores).unwrap();
                for (label, &score) in labels.iter().zip(&scores.log_prob_nats) {
                    proptest::prop_assert!((score - by_hand(&model, &prompt, label)).abs() < 1e-9);
                }
            }
        }
    }

    /// `ln s` of `labels[of]` under [`Continuation::Labels`], computed by its definition over the labels' bytes. Every label begins with the space
    /// after the prompt.
    fn among_labels_by_hand(model: &TableModel, prompt: &str, labels: &[String], of: usize) -> f64 {
        let mut sequence = Vec::new();
        model.tokenise(prompt, TextStart::Sequence, &mut sequence).unwrap();
        let mut sum = 0.0;
        for at in 0..=labels[of].len() {
            let said = &labels[of][..at];
            let logits = logits_after(model, &sequence);
            let all: f64 = logits.iter().map(|&logit| f64::from(logit).exp()).sum();
            let next: std::collections::BTreeSet<u8> =
                labels.iter().filter_map(|label| label.strip_prefix(said)?.bytes().next()).collect();
            let others: f64 = next.iter().map(|&byte| f64::from(logits[usize::from(byte)]).exp()).sum();
            let Some(&byte) = labels[of].as_bytes().get(at) else {
                // The label's end gets the probability that the others leave.
                return if next.is_empty() { sum } else { sum + (1.0 - others / all).ln() };
            };
            let free = at == 0 || labels.iter().any(|label| label == said);
            sum += f64::from(logits[usize::from(byte)]) - if free { all } else { others }.ln();
            sequence.push(Token(i32::from(byte)));
        }
        sum
    }

    proptest::proptest! {
        /// Both corrections by all three methods, against their definitions.
        #[test]
        fn every_method_corrects_alike(
            seed: u64,
            narration in proptest::collection::vec("[A-Z][a-z ]{0,30}\\.", 1..4),
            labels in proptest::collection::hash_set("[a-c]{1,4}( [a-c]{1,3})?", 1..30),
            prior in proptest::sample::select(vec![0.0, 0.3, 1.0]),
        ) {
            let labels: Vec<String> = labels.into_iter().collect();
            let spaced: Vec<String> = labels.iter().map(|label| format!(" {label}")).collect();
            let model = TableModel::new(seed);
            let binding = BindingSequence::default();
            let by_hand = |prompt: &str| -> Vec<f64> {
                (0..labels.len()).map(|label| among_labels_by_hand(&model, prompt, &spaced, label)).collect()
            };
            let mut prompt = String::new();
            write_prompt([], &binding, false, &mut prompt);
            let blank = by_hand(&prompt);
            write_prompt(narration.iter().map(String::as_str), &binding, false, &mut prompt);
            let narrated = by_hand(&prompt);
            let sum = |values: &[f64]| values.iter().map(|value| value.exp()).sum::<f64>().ln();
            let floor = blank.iter().copied().fold(f64::MIN, f64::max) - 20.0;
            let gain = |blank: f64| -prior * blank.max(floor);
            let gained: Vec<f64> = narrated.iter().zip(&blank).map(|(score, &blank)| score + gain(blank)).collect();
            // No probability is lost: after the first byte the labels' scores sum to its probability.
            let first = sum(&narrated);
            let mut head = Vec::new();
            model.tokenise(&prompt, TextStart::Sequence, &mut head).unwrap();
            let row = logits_after(&model, &head);
            proptest::prop_assert!((first - f64::from(row[32]) + softmax::log_sum_exp(&row)).abs() < 1e-5);

            let mut scorer = Scorer::new(model.clone());
            let correction = Correction { continuation: Continuation::Labels, prior };
            let prepared = scorer.prepare(&labels, &binding, Tokenisation::Joint, correction).unwrap();
            let mut scores = LabelScores::default();
            for method in [Method::Trie, Method::SharedPrefix, Method::Independent] {
                scorer.score(&prepared, &prompt, method, &mut scores).unwrap();
                for (label, &score) in scores.log_prob_nats.iter().enumerate() {
                    let expected = sum(&narrated) - sum(&gained) + gained[label];
                    proptest::prop_assert!((score - expected).abs() < 1e-4, "{method:?} {score} {expected}");
                    if method == Method::Trie {
                        let tokens = scorer.token_log_prob_nats(&prepared, label).unwrap();
                        proptest::prop_assert_eq!(tokens.len(), spaced[label].len());
                        let sum = tokens.iter().sum::<f64>() + prepared.gain_nats()[label] + scores.scale_nats;
                        proptest::prop_assert!((sum - score).abs() < 1e-9);
                    }
                }
            }
        }
    }

    /// The probability of a label's end is not computed as a difference of two nearly equal numbers.
    #[test]
    fn a_very_unlikely_end_is_as_exact() {
        let trie = crate::label_trie::LabelTrie::distinct_prefixes(&[vec![Token(1)], vec![Token(1), Token(2)]]);
        let mut logits = [0.0_f32; TableModel::VOCABULARY];
        logits[2] = 30.0;
        let mut given = Vec::new();
        let rivals = Continuation::Labels.rivals(&trie, Some(0));
        let mut row = Vec::new();
        assert!(super::super::rows::read_row(&trie, Some(0), rivals, &logits, &mut row, |_, log| given.push(log)));
        let others = (TableModel::VOCABULARY as f64 - 1.0).ln();
        assert!((given[0] - (others - 30.0)).abs() < 1e-5 && given[1].abs() < 1e-9, "{given:?}");
        // A row in which no label is possible is valid.
        let trie =
            crate::label_trie::LabelTrie::distinct_prefixes(&[vec![Token(1), Token(2)], vec![Token(1), Token(3)]]);
        logits[2..4].fill(f32::NEG_INFINITY);
        let rivals = Continuation::Labels.rivals(&trie, Some(0));
        assert!(super::super::rows::read_row(&trie, Some(0), rivals, &logits, &mut row, |_, log| given.push(log)));
        assert_eq!(given[2..], [-2_f64.ln(); 2]);
        // A row with NaN is not.
        logits[2..4].fill(f32::NAN);
        let rivals = Continuation::Labels.rivals(&trie, Some(0));
        assert!(!super::super::rows::read_row(&trie, Some(0), rivals, &logits, &mut row, |_, _| ()));
    }

    #[test]
    fn no_labels_and_empty_labels_are_refused() {
        let mut scorer = Scorer::new(TableModel::new(1));
        let binding = BindingSequence::default();
        assert!(scorer.prepare::<&str>(&[], &binding, Tokenisation::Joint, Correction::default()).is_err());
        assert!(scorer.prepare(&["mug", " "], &binding, Tokenisation::Joint, Correction::default()).is_err());
    }
}
