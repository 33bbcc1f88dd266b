//! How well a model knows the words of a prompt and of a map, judged by its vocabulary.
//!
//! A vocabulary of frequent words has the words of the training text whole, and spells other words in pieces. So tokens per byte tell known text from
//! other languages, source code and nonsense, without a pass of the decoder. Up to [`KNOWN`] the scores have their full weight in a forecast. From
//! [`UNKNOWN`] on they have none: a forecast must not be sure after words that the model does not know. `roomcast-lab familiarity` prints the data
//! (docs/tables.md): they support the first limit, and the second is a choice.
//!
//! A vocabulary of letters or bytes needs many tokens for any text. There the limit is `SLACK` times the tokens of plain narration.

use super::correction::Correction;
use super::{LabelScores, LanguageModel, Method, ModelError, ScoreError, Scorer, TextStart, Token, Tokenisation};
use crate::prompt::{BindingSequence, write_prompt};

/// Tokens per byte of text with the full weight.
pub const KNOWN: f64 = 0.32;
/// Tokens per byte of text without weight.
pub const UNKNOWN: f64 = 0.42;
/// How many times the tokens of plain narration a known text may have.
const SLACK: f64 = 1.25;
const PLAIN: &str = "They walk to the kitchen. They open the fridge. They grab the milk. They sit down on the sofa. They wash their hands.";

/// The vocabulary of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vocabulary {
    known: f64,
}

impl Vocabulary {
    /// Measures how the model cuts plain narration.
    ///
    /// # Errors
    /// If the tokeniser fails.
    pub fn of<M: LanguageModel>(model: &M) -> Result<Self, ModelError> {
        let mut tokens = Vec::new();
        model.tokenise(PLAIN, TextStart::Within, &mut tokens)?;
        Ok(Self { known: KNOWN.max(SLACK * tokens.len() as f64 / PLAIN.len() as f64) })
    }

    /// The weight of scores after a text with so many tokens and bytes, 0 to 1. 1 for no text.
    #[must_use]
    pub fn trust(self, tokens: usize, bytes: usize) -> f64 {
        let excess = tokens as f64 / bytes.max(1) as f64 - self.known;
        (1.0 - excess / (UNKNOWN - KNOWN)).clamp(0.0, 1.0)
    }
}

/// What the scores of one map weigh after a prompt.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Familiarity {
    vocabulary: Vocabulary,
    /// The weight that the map's labels allow.
    labels: f64,
    /// Of the binding sequence at the end of each prompt, with the start token.
    binding_tokens: usize,
    binding_bytes: usize,
}

impl Familiarity {
    pub(crate) fn of<M: LanguageModel, L: AsRef<str>>(
        model: &M,
        (labels, tokens): (&[L], &[Vec<Token>]),
        binding: &str,
    ) -> Result<Self, ModelError> {
        let vocabulary = Vocabulary::of(model)?;
        let mut of_binding = Vec::new();
        model.tokenise(binding, TextStart::Sequence, &mut of_binding)?;
        // Each label follows a space.
        let bytes = labels.iter().map(|label| label.as_ref().len() + 1).sum();
        let labels = vocabulary.trust(tokens.iter().map(Vec::len).sum(), bytes);
        Ok(Self { vocabulary, labels, binding_tokens: of_binding.len(), binding_bytes: binding.len() })
    }

    pub(crate) fn trust(&self, prompt_tokens: usize, prompt_bytes: usize) -> f64 {
        let tokens = prompt_tokens.saturating_sub(self.binding_tokens);
        self.vocabulary.trust(tokens, prompt_bytes.saturating_sub(self.binding_bytes)).min(self.labels)
    }
}

/// A morning in a kitchen, for checks of a model.
pub const CHECK_NARRATION: [&str; 4] =
    ["They walk to the kitchen.", "They open the fridge.", "They grab the milk.", "They close the fridge."];
/// Likely and unlikely labels for these checks, some of several tokens.
pub const CHECK_LABELS: [&str; 12] = [
    "bed",
    "coffee maker",
    "cup",
    "fridge",
    "garden hose",
    "grandfather clock",
    "kitchen",
    "living room",
    "sofa",
    "table",
    "toothbrush",
    "washing machine",
];

/// The least total probability of [`CHECK_LABELS`], cut into `tokens`, after [`CHECK_NARRATION`] by Equation 1: ten times chance. Below this, scores
/// are noise.
#[must_use]
pub fn check_mass_min(tokens: &[Vec<Token>], vocabulary: usize) -> f64 {
    let chance: f64 = tokens.iter().map(|label| (vocabulary.max(2) as f64).powf(-(label.len() as f64))).sum();
    (10.0 * chance).max(1e-3)
}

/// Why the scores of a model are noise: it expects none of twelve common things after plain narration. `None` for a usable model.
///
/// # Errors
/// If the model fails.
pub fn weakness<M: LanguageModel>(scorer: &mut Scorer<M>) -> Result<Option<String>, ScoreError> {
    let binding = BindingSequence::default();
    let prepared = scorer.prepare(&CHECK_LABELS, &binding, Tokenisation::Joint, Correction::default())?;
    let mut prompt = String::new();
    write_prompt(CHECK_NARRATION, &binding, false, &mut prompt);
    let mut scores = LabelScores::default();
    scorer.score(&prepared, &prompt, Method::Trie, &mut scores)?;
    scorer.forget();
    let mass: f64 = scores.log_prob_nats.iter().map(|log_prob_nats| log_prob_nats.exp()).sum();
    let needed = check_mass_min(prepared.tokens(), scorer.info().vocabulary);
    Ok((mass < needed).then(|| {
        format!(
            "after four plain sentences it expects twelve common things with {mass:.1e} in all, and {needed:.0e} is needed: it does not know how such a \
             sentence goes on"
        )
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::label_trie::TokenTree;
    use crate::scorer::DecodeStats;
    use crate::scorer::ModelInfo;
    use crate::scorer::table::TableModel;

    /// Knows its words whole, and spells others in letters.
    #[derive(Debug)]
    struct Words(TableModel);

    impl LanguageModel for Words {
        fn info(&self) -> &ModelInfo {
            self.0.info()
        }

        fn tokenise(&self, text: &str, _start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
            for word in text.split_inclusive(' ') {
                let is_known = PLAIN.contains(word.trim_end()) || "Next, the human will go to the mug".contains(word);
                let letters = if is_known { 1 } else { word.len() };
                out.extend(word.bytes().take(letters).map(|byte| Token(i32::from(byte))));
            }
            Ok(())
        }

        fn token_text(&self, token: Token) -> String {
            self.0.token_text(token)
        }

        fn decode(
            &mut self,
            prompt: &[Token],
            tree: &TokenTree,
            want_prompt_row: bool,
            visit: &mut dyn FnMut(usize, &[f32]),
        ) -> Result<DecodeStats, ModelError> {
            self.0.decode(prompt, tree, want_prompt_row, visit)
        }
    }

    fn trust_after(labels: &[&str], sentences: &[&str]) -> f64 {
        let mut scorer = Scorer::new(Words(TableModel::new(1)));
        let binding = BindingSequence::default();
        let prepared = scorer.prepare(labels, &binding, Tokenisation::Joint, Correction::default()).unwrap();
        let mut prompt = String::new();
        write_prompt(sentences.iter().copied(), &binding, false, &mut prompt);
        let mut scores = LabelScores::default();
        scorer.score(&prepared, &prompt, Method::Trie, &mut scores).unwrap();
        scores.trust
    }

    #[test]
    fn words_that_a_vocabulary_spells_take_the_weight_from_the_scores() {
        assert_eq!(trust_after(&["mug"], &[]), 1.0);
        assert_eq!(trust_after(&["mug"], &["They open the fridge.", "They wash their hands."]), 1.0);
        assert_eq!(trust_after(&["mug"], &["Sie öffnen den Kühlschrank."]), 0.0);
        // One unknown thing among known words.
        let partly = trust_after(&["mug"], &["They open the Schrank. They walk to the kitchen."]);
        assert!(partly > 0.0, "{partly}");
        // Labels of a map in another language.
        assert_eq!(trust_after(&["Kühlschrank", "Wohnzimmer"], &["They open the fridge."]), 0.0);
    }

    #[test]
    fn a_vocabulary_of_bytes_is_judged_by_its_own_tokens() {
        let bytes = Vocabulary::of(&TableModel::new(1)).unwrap();
        assert_eq!((bytes.trust(1_000, 1_000), bytes.trust(0, 0)), (1.0, 1.0));
        let words = Vocabulary { known: KNOWN };
        assert_eq!(
            [words.trust(32, 100), words.trust(42, 100), words.trust(90, 100)].map(|w| (w * 1e9).round()),
            [1e9, 0.0, 0.0]
        );
        assert!((words.trust(37, 100) - 0.5).abs() < 1e-9);
    }

    #[test]
    fn a_model_that_expects_no_common_thing_is_weak() {
        let reason = weakness(&mut Scorer::new(TableModel::new(1))).unwrap().unwrap();
        assert!(reason.contains("common things") && reason.contains("1e-3"), "{reason}");
    }
}
