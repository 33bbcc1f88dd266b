//! Cuts a prompt into tokens, each sentence once.
//!
//! A prompt gains one sentence per event and keeps the rest; its binding sequence is constant. If sentences are tokenised independently
//! ([`LanguageModel::sentences_apart`]), the cutter reuses the tokens of the sentences that the previous prompt began with, and caches other recent
//! sentences. Otherwise it cuts the whole prompt every time.

use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

use super::{LanguageModel, ModelError, TextStart, Token};
use crate::narration::SENTENCE_BYTES_MAX;

/// Cached sentences: enough for the default windows of a dozen persons. A new sentence replaces the oldest.
pub const REMEMBERED: usize = 256;

/// Recent sentences with their tokens. Once warm, the cutter allocates only if a sentence is longer than the one it replaces.
#[derive(Debug, Default)]
pub struct Cutter {
    /// Hash per entry of `sentences`, for fast lookup.
    hashes: Vec<u64>,
    sentences: Vec<(String, Vec<Token>)>,
    /// Index that the next new sentence takes.
    next: usize,
    before: Prompt,
}

#[derive(Debug, Default)]
struct Prompt {
    text: String,
    tokens: Vec<Token>,
    /// Ends of all sentences but the last: (bytes of the text, tokens).
    ends: Vec<(usize, usize)>,
}

impl Prompt {
    /// Keeps the leading sentences that `text` shares, except its last one. Returns their length in bytes and in tokens.
    fn keep(&mut self, text: &str) -> (usize, usize) {
        let mut from = 0;
        let is_same = |&&(end, _): &&(usize, usize)| {
            let own = std::mem::replace(&mut from, end)..end;
            end < text.len() && self.text.as_bytes()[own.clone()] == text.as_bytes()[own]
        };
        let kept = self.ends.iter().take_while(is_same).count();
        self.ends.truncate(kept);
        self.ends.last().copied().unwrap_or_default()
    }
}

impl Cutter {
    /// Tokens of the last prompt before its last sentence, which is the binding sequence. `None` if it has one sentence, or was not cut by sentences.
    pub(crate) fn narration_tokens(&self) -> Option<usize> {
        self.before.ends.last().map(|&(_, tokens)| tokens)
    }

    /// Writes the tokens of a prompt to `out`: exactly those of [`LanguageModel::tokenise`].
    ///
    /// # Errors
    /// If the tokeniser fails.
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
        // Taken, so that a prompt that fails half way leaves no state.
        let mut before = std::mem::take(&mut self.before);
        let (begin, tokens) = before.keep(text);
        out.extend_from_slice(&before.tokens[..tokens]);
        if begin == 0 {
            // The start token, if the model wants one.
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

    /// Writes the tokens of narration to `out`: within a prompt, or of a prompt that the next one does not continue.
    ///
    /// # Errors
    /// If the tokeniser fails.
    pub fn cut_narration<M: LanguageModel>(
        &mut self,
        model: &M,
        text: &str,
        start: TextStart,
        out: &mut Vec<Token>,
    ) -> Result<(), ModelError> {
        out.clear();
        if !model.sentences_apart() {
            return model.tokenise(text, start, out);
        }
        if start == TextStart::Sequence {
            model.tokenise("", start, out)?;
        }
        self.cut_from(0, model, text, out, |_| ())
    }

    /// Appends the tokens of the text from byte `begin`. Calls `ended` at every sentence boundary with the position in bytes and in tokens.
    fn cut_from<M: LanguageModel>(
        &mut self,
        mut begin: usize,
        model: &M,
        text: &str,
        out: &mut Vec<Token>,
        mut ended: impl FnMut((usize, usize)),
    ) -> Result<(), ModelError> {
        // A lone space at the very end stays with the previous sentence: alone it would be an empty text.
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
            // Longer than any narrator's sentence: not worth the memory.
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

/// Byte position of the second sentence, after the space.
fn next_sentence(text: &str) -> Option<usize> {
    text.as_bytes().windows(2).position(|pair| matches!(pair, [b'.' | b'!' | b'?', b' '])).map(|end| end + 2)
}
