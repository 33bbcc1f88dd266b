//! Cuts a prompt into tokens, each sentence once.
//!
//! From event to event a prompt gains one sentence and keeps the others, and its binding sequence is always the same. Where a model's
//! vocabulary allows it ([`LanguageModel::sentences_apart`]), the prompt is cut sentence by sentence: what it begins with as the prompt
//! before did is taken from there, and the other sentences cut lately are remembered. For other models the whole prompt is cut every time.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

use super::{LanguageModel, ModelError, TextStart, Token};
use crate::narration::SENTENCE_BYTES_MAX;

/// Sentences that are remembered: the default windows of a dozen persons. The oldest makes room for a new one.
pub const REMEMBERED: usize = 256;

/// The sentences cut lately, with their tokens. Memory is used again: a warm cutter allocates only for a sentence longer than the one whose
/// place it takes.
#[derive(Debug, Default)]
pub struct Cutter {
    /// Of the sentences, in the same places, to find them fast.
    hashes: Vec<u64>,
    sentences: Vec<(String, Vec<Token>)>,
    /// The place that the next sentence takes.
    next: usize,
    before: Prompt,
}

/// A prompt that was cut.
#[derive(Debug, Default)]
struct Prompt {
    text: String,
    tokens: Vec<Token>,
    /// Where another sentence follows: bytes of the text, tokens.
    ends: Vec<(usize, usize)>,
}

impl Prompt {
    /// Keeps the sentences that `text` begins with too, and more follows: their bytes, their tokens.
    fn keep(&mut self, text: &str) -> (usize, usize) {
        let same = self.text.as_bytes().iter().zip(text.as_bytes()).take_while(|(a, b)| a == b).count();
        let kept = self.ends.partition_point(|&(bytes, _)| bytes <= same && bytes < text.len());
        self.ends.truncate(kept);
        self.ends.last().copied().unwrap_or_default()
    }
}

impl Cutter {
    /// How many tokens the last prompt has before its last sentence, the binding sequence; none where that is not known.
    pub(crate) fn narration_tokens(&self) -> Option<usize> {
        self.before.ends.last().map(|&(_, tokens)| tokens)
    }

    /// Gives the tokens of a prompt into `out`: exactly those that [`LanguageModel::tokenise`] gives.
    ///
    /// # Errors
    /// When the tokeniser fails.
    pub fn cut_prompt<M: LanguageModel>(
        &mut self,
        model: &M,
        text: &str,
        out: &mut Vec<Token>,
    ) -> Result<(), ModelError> {
        out.clear();
        if !model.sentences_apart() {
            return model.tokenise(text, TextStart::Sequence, out);
        }
        // Taken: nothing is known of a prompt that fails half way.
        let mut before = std::mem::take(&mut self.before);
        let (begin, tokens) = before.keep(text);
        out.extend_from_slice(&before.tokens[..tokens]);
        if begin == 0 {
            // The start token, where the model wants one.
            model.tokenise("", TextStart::Sequence, out)?;
        }
        self.cut_from(begin, model, text, out, |end| before.ends.push(end))?;
        before.text.clear();
        before.text.push_str(text);
        before.tokens.clear();
        before.tokens.extend_from_slice(out);
        self.before = before;
        Ok(())
    }

    /// Gives the tokens of a piece of narration within a prompt into `out`.
    ///
    /// # Errors
    /// When the tokeniser fails.
    pub fn cut_narration<M: LanguageModel>(
        &mut self,
        model: &M,
        text: &str,
        out: &mut Vec<Token>,
    ) -> Result<(), ModelError> {
        out.clear();
        if !model.sentences_apart() {
            return model.tokenise(text, TextStart::Within, out);
        }
        self.cut_from(0, model, text, out, |_| ())
    }

    /// Appends the tokens of what follows the first `begin` bytes; says where another sentence follows, in bytes and tokens.
    fn cut_from<M: LanguageModel>(
        &mut self,
        mut begin: usize,
        model: &M,
        text: &str,
        out: &mut Vec<Token>,
        mut ended: impl FnMut((usize, usize)),
    ) -> Result<(), ModelError> {
        // A lone space at the very end stays with what is before it: by itself it would be no text at all.
        while let Some(next) = next_sentence(&text[begin..]).map(|next| begin + next).filter(|next| *next < text.len())
        {
            self.cut_sentence(model, &text[begin..next - 1], out)?;
            begin = next;
            ended((begin, out.len()));
        }
        self.cut_sentence(model, &text[begin..], out)
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

/// Where in `text` the second sentence begins, behind a space.
fn next_sentence(text: &str) -> Option<usize> {
    text.as_bytes().windows(2).position(|pair| matches!(pair, [b'.' | b'!' | b'?', b' '])).map(|end| end + 2)
}
