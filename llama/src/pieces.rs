//! The tokens of a short text by a SentencePiece vocabulary: those of llama.cpp, in a tenth of its time.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

use roomcast_core::scorer::Token;

/// Most bytes of a text with the space before it. In a long text llama.cpp is faster, because it sorts the pairs.
const BYTES_MAX: usize = 256;

/// Token and score by text, with a space for U+2581. Only texts of ASCII.
#[derive(Debug)]
pub(crate) struct Pieces(HashMap<Box<[u8]>, (Token, f32), BuildHasherDefault<Fnv>>);

/// FNV-1a. A text only looks keys up and adds none.
#[derive(Debug, Default)]
struct Fnv(u64);

impl Hasher for Fnv {
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_usize((*byte).into()));
    }

    fn write_usize(&mut self, number: usize) {
        self.0 = (self.0 ^ number as u64).wrapping_mul(0x100_0000_01b3);
    }

    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 32)
    }
}

impl Pieces {
    /// `tokens` are the texts of a vocabulary without user-defined tokens, in order. No score is NaN.
    pub(crate) fn new<'a>(tokens: impl Iterator<Item = (&'a str, Token, f32)>) -> Self {
        // llama.cpp replaces each space, so it finds no token with one. Of equal texts it finds the last.
        let known = tokens.filter(|(text, ..)| !text.contains(' ')).map(|(text, token, score)| {
            (text.replace('\u{2581}', " ").into_bytes().into_boxed_slice(), (token, score))
        });
        Self(known.filter(|(text, _)| text.is_ascii()).collect())
    }

    /// Appends the tokens of a text within a prompt. Returns false, and appends nothing, if the text is long, or if a part is no token: llama.cpp
    /// spells that in bytes.
    pub(crate) fn cut(&self, text: &str, out: &mut Vec<Token>) -> bool {
        if text.is_empty() || text.len() >= BYTES_MAX || !text.is_ascii() {
            return false;
        }
        let mut line = [b' '; BYTES_MAX];
        line[1..=text.len()].copy_from_slice(text.as_bytes());
        let mut count = 1 + text.len();
        // Part i is `line[starts[i]..starts[i + 1]]`, and `joined[i]` is the score of the token that it makes with part i + 1, NaN without one.
        let mut starts: [usize; BYTES_MAX + 1] = std::array::from_fn(|at| at);
        let mut joined = [f32::NAN; BYTES_MAX];
        let score = |from: usize, to: usize| self.0.get(&line[from..to]).map_or(f32::NAN, |(_, score)| *score);
        (1..count).for_each(|end| joined[end - 1] = score(end - 1, end + 1));
        while let Some(best) = best(&joined[..count - 1]) {
            starts.copy_within(best + 2..=count, best + 1);
            joined.copy_within(best + 1..count - 1, best);
            count -= 1;
            if best > 0 {
                joined[best - 1] = score(starts[best - 1], starts[best + 1]);
            }
            if best + 1 < count {
                joined[best] = score(starts[best], starts[best + 2]);
            }
        }
        let before = out.len();
        let parts = starts[..=count].windows(2).map(|ends| &line[ends[0]..ends[1]]);
        out.extend(parts.map_while(|part| self.0.get(part).map(|(token, _)| *token)));
        let is_whole = out.len() == before + count;
        if !is_whole {
            out.truncate(before);
        }
        is_whole
    }
}

/// The pair with the highest score, the first of equal ones.
fn best(joined: &[f32]) -> Option<usize> {
    let mut best = None;
    for (at, score) in joined.iter().enumerate().filter(|(_, score)| !score.is_nan()) {
        if best.is_none_or(|best: usize| *score > joined[best]) {
            best = Some(at);
        }
    }
    best
}
