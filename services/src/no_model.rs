//! A scorer without a language model: all words are equally likely. A step then costs only Roomcast's own work around the model, which
//! `roomcast latency --scorer none` measures.

use roomcast_core::label_trie::TokenTree;
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{Clock, DecodeStats, LanguageModel, ModelError, ModelInfo, TextStart, Token};
use roomcast_ipc::clock;

/// Words that are equally likely to come next.
const WORDS: usize = 128;

/// See the module's documentation.
#[derive(Debug, Clone)]
pub struct NoModel {
    info: ModelInfo,
}

impl Default for NoModel {
    fn default() -> Self {
        Self {
            info: ModelInfo {
                name: "none".into(),
                architecture: "none".into(),
                description: "no language model: every word is as likely as every other".into(),
                parameters: 0,
                size_bytes: 0,
                vocabulary: WORDS,
                context_tokens: 1 << 20,
                shares_prefix: true,
                correction: Correction::default(),
                weakness: None,
                fingerprint: [0; 32],
            },
        }
    }
}

impl LanguageModel for NoModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn clock(&self) -> Clock {
        clock::monotonic_ns
    }

    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
        if start == TextStart::Sequence {
            out.push(Token(0));
        }
        out.extend(text.split_ascii_whitespace().map(|_| Token(0)));
        Ok(())
    }

    fn sentences_apart(&self) -> bool {
        true
    }

    fn token_text(&self, _token: Token) -> String {
        "(word)".into()
    }

    fn decode(
        &mut self,
        _prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError> {
        let first = usize::from(!want_prompt_row);
        (first..=tree.len()).for_each(|row| visit(row, &[0.0; WORDS]));
        Ok(DecodeStats::default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::prompt::BindingSequence;
    use roomcast_core::scorer::{LabelScores, Method, Scorer, Tokenisation};

    #[test]
    fn every_word_is_as_likely() {
        let mut scorer = Scorer::new(NoModel::default());
        let prepared = scorer
            .prepare(
                &["mug", "washing machine"],
                &BindingSequence::default(),
                Tokenisation::Joint,
                Correction::default(),
            )
            .unwrap();
        let mut scores = LabelScores::default();
        scorer.score(&prepared, "They walk. Next, the human will go to the", Method::Trie, &mut scores).unwrap();
        let word = -(WORDS as f64).ln();
        assert!((scores.log_prob_nats[0] - word).abs() < 1e-6 && (scores.log_prob_nats[1] - 2.0 * word).abs() < 1e-6);
    }
}
