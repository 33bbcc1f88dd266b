//! Cuts a prompt into tokens, each sentence once.
//!
//! From event to event a prompt gains one sentence and keeps the others, and its binding sequence is always the same. Where a model's
//! vocabulary allows it ([`LanguageModel::sentences_apart`]), the prompt is cut sentence by sentence, and the sentences cut lately are
//! remembered. For other models the whole prompt is cut anew.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

use super::{LanguageModel, ModelError, TextStart, Token};
use crate::narration::SENTENCE_BYTES_MAX;

/// Sentences that are remembered: the default windows of a dozen persons. The oldest makes room for a new one.
const REMEMBERED: usize = 256;

/// The sentences cut lately, with their tokens. Memory is used again: a warm cutter allocates only for a sentence longer than the one whose
/// place it takes.
#[derive(Debug, Default)]
pub(super) struct Cutter {
    /// Of the sentences, in the same places, to find them fast.
    hashes: Vec<u64>,
    sentences: Vec<(String, Vec<Token>)>,
    /// The place that the next sentence takes.
    next: usize,
}

impl Cutter {
    /// Appends the tokens of `text` to `out`: exactly those that [`LanguageModel::tokenise`] gives.
    ///
    /// # Errors
    /// When the tokeniser fails.
    pub(super) fn cut<M: LanguageModel>(
        &mut self,
        model: &M,
        text: &str,
        start: TextStart,
        out: &mut Vec<Token>,
    ) -> Result<(), ModelError> {
        if !model.sentences_apart() {
            return model.tokenise(text, start, out);
        }
        // The start token, where the model wants one.
        model.tokenise("", start, out)?;
        let mut rest = text;
        // A lone space at the very end stays with what is before it: by itself it would be no text at all.
        while let Some(stop) = sentence_end(rest).filter(|stop| stop + 2 < rest.len()) {
            self.cut_sentence(model, &rest[..=stop], out)?;
            rest = &rest[stop + 2..];
        }
        self.cut_sentence(model, rest, out)
    }

    fn cut_sentence<M: LanguageModel>(
        &mut self,
        model: &M,
        sentence: &str,
        out: &mut Vec<Token>,
    ) -> Result<(), ModelError> {
        let hash = BuildHasherDefault::<DefaultHasher>::default().hash_one(sentence);
        let known = (self.hashes.iter().zip(&self.sentences)).find(|(h, (text, _))| **h == hash && text == sentence);
        if let Some((_, (_, tokens))) = known {
            out.extend_from_slice(tokens);
            return Ok(());
        }
        let before = out.len();
        model.tokenise(sentence, TextStart::Within, out)?;
        if sentence.len() > SENTENCE_BYTES_MAX {
            // No narrator's: not worth its memory.
            return Ok(());
        }
        if self.sentences.len() < REMEMBERED {
            self.hashes.push(0);
            self.sentences.push(Default::default());
            self.next = self.sentences.len() - 1;
        }
        self.hashes[self.next] = hash;
        let (text, tokens) = &mut self.sentences[self.next];
        text.clear();
        text.push_str(sentence);
        tokens.clear();
        tokens.extend_from_slice(&out[before..]);
        self.next = (self.next + 1) % REMEMBERED;
        Ok(())
    }
}

/// Where in `text` the first sentence has its last byte, if another follows.
fn sentence_end(text: &str) -> Option<usize> {
    text.as_bytes().windows(2).position(|pair| matches!(pair, [b'.' | b'!' | b'?', b' ']))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use proptest::test_runner::{Config, TestRunner};

    use super::*;
    use crate::scorer::llama::LlamaOptions;
    use crate::setup::load_model;

    /// Sentences, and what narrators should not send: more of them than are remembered, and joined in every way.
    #[test]
    fn a_prompt_cut_by_sentences_is_the_prompt_cut_whole() {
        let model = load_model(None, &LlamaOptions { context_tokens: 64, ..Default::default() }).unwrap();
        assert!(model.sentences_apart(), "no token of the embedded model crosses from one sentence to the next");
        let texts: Vec<(String, Vec<i32>)> =
            serde_json::from_str(include_str!("../../models/household-tokens.json")).unwrap();
        let texts: Vec<String> = texts.into_iter().map(|(text, _)| text).collect();
        assert!(texts.len() > REMEMBERED);
        let joint =
            prop::sample::select(vec![". ", ".  ", " ", ".", "", ". . ", "...", ".\u{2581}", "? ", "! ", "?! "]);
        let prompt = prop::collection::vec((prop::sample::select(texts), joint), 0..12);
        let cutter = std::cell::RefCell::new(Cutter::default());
        let mut runner = TestRunner::new(Config { cases: 2000, failure_persistence: None, ..Config::default() });
        let result = runner.run(&prompt, |parts| {
            let prompt: String = parts.iter().flat_map(|(text, joint)| [text.as_str(), joint]).collect();
            for start in [TextStart::Sequence, TextStart::Within] {
                let (mut whole, mut cut) = (Vec::new(), Vec::new());
                model.tokenise(&prompt, start, &mut whole).unwrap();
                cutter.borrow_mut().cut(&model, &prompt, start, &mut cut).unwrap();
                prop_assert_eq!(&cut, &whole, "{:?}", prompt);
            }
            Ok(())
        });
        result.unwrap();
        assert_eq!(cutter.borrow().sentences.len(), REMEMBERED);
    }
}
