//! The interface to a language model: what a model must answer, what it says of itself, and how it fails.

use std::sync::Arc;

use super::Token;
use super::correction::Correction;
use crate::label_trie::TokenTree;

/// Description of a language model.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct ModelInfo {
    /// The model's name, or the file's.
    pub name: String,
    /// Architecture as llama.cpp names it ("llama").
    pub architecture: String,
    /// Quantisation and size in words ("llama 3M Q8_0").
    pub description: String,
    /// Number of parameters.
    pub parameters: u64,
    /// Size of the weights in bytes.
    pub size_bytes: u64,
    /// Size of the vocabulary.
    pub vocabulary: usize,
    /// Tokens that prompt and label together may take.
    pub context_tokens: usize,
    /// Whether continuations can share a prefix. Recurrent and hybrid models cannot.
    pub shares_prefix: bool,
    /// The correction of scores that the model file recommends.
    pub correction: Correction,
    /// Why its scores are noise ([`super::familiarity::weakness`]); `None` for a usable model, and for one that was not checked.
    pub weakness: Option<String>,
    /// SHA-256 of the model file; zeros if there is none.
    #[serde(serialize_with = "hex::serialize")]
    pub fingerprint: [u8; 32],
}

/// A failure of the model.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The file is not a valid model. The message names the file and the remedy.
    #[error(transparent)]
    File(Box<dyn std::error::Error + Send + Sync>),
    /// The file cannot be loaded.
    #[error("failed to load the model {path}: {reason}; `roomcast model info` shows what the file is")]
    Load {
        /// The file.
        path: String,
        /// The loader's message.
        reason: String,
    },
    /// The file is valid, but there is not enough memory for its context.
    #[error(
        "the model {model} gets no memory for a context of {context_tokens} tokens ({reason}): raise the limit on memory \
         (MemoryMax=, ulimit -v), or lower model.context_tokens, or choose a smaller model.cache"
    )]
    Context {
        /// The model's name.
        model: String,
        /// Tokens of the requested context.
        context_tokens: u32,
        /// The loader's message.
        reason: String,
    },
    /// Text that cannot be tokenised.
    #[error("failed to tokenise {text:?}: {reason}")]
    Tokenise {
        /// The text, shortened.
        text: String,
        /// The tokeniser's message.
        reason: String,
    },
    /// Prompt and labels do not fit in the context.
    #[error(
        "the prompt has {prompt} tokens and its labels need {tree} more, but the model's context holds {context}: shorten the history or raise model.context_tokens"
    )]
    TooLong {
        /// Tokens of the prompt.
        prompt: usize,
        /// Tokens of the tree after the prompt.
        tree: usize,
        /// Size of the context.
        context: usize,
    },
    /// The prompt has no tokens.
    #[error("the prompt is empty and the model has no start token: give narration or a binding sequence")]
    EmptyPrompt,
    /// The decoder failed.
    #[error("the model failed to decode {tokens} tokens: {reason}")]
    Decode {
        /// Tokens in the failing call.
        tokens: usize,
        /// The decoder's message.
        reason: String,
    },
    /// The caller asked the model to stop.
    #[error("scoring was broken off")]
    Stopped,
    /// The model gave a logit that is not finite.
    #[error("the model gave logits that are not finite after {at}: the file is damaged or its quantisation is broken")]
    NotFinite {
        /// The prompt, or the trie node.
        at: String,
    },
    /// The model did not visit exactly the rows that were asked for.
    #[error(
        "the model gave {given} of {asked} rows of logits: LanguageModel::decode visits each row that it is asked for, and no other"
    )]
    Rows {
        /// Rows visited.
        given: usize,
        /// Rows asked for.
        asked: usize,
    },
}

/// Position of a text in a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextStart {
    /// At the beginning: the tokeniser prepends the model's start token, if it has one.
    Sequence,
    /// After other text.
    Within,
}

/// Monotonic time in nanoseconds, with an arbitrary origin.
pub type Clock = fn() -> u64;

/// Counts the tokens of a text on threads that do not have the model.
pub type TokenCounter = Arc<dyn Fn(&str) -> usize + Send + Sync>;

/// Returns true if background work must stop.
pub type IsStopped = Arc<dyn Fn() -> bool + Send + Sync>;

/// Called by the model to report progress.
pub type Progress = Arc<dyn Fn() + Send + Sync>;

/// The scoring algorithm's interface to a model: description, tokens, text of a token, and logits. Everything else has a default.
pub trait LanguageModel {
    /// The model's description.
    fn info(&self) -> &ModelInfo;

    /// The clock for step times and for [`super::certified::Effort::Deadline`]; this crate has no clock of its own. The default stands still.
    fn clock(&self) -> Clock {
        || 0
    }

    /// Appends the tokens of `text` to `out`. Control tokens written in the text are taken as text.
    ///
    /// # Errors
    /// If the tokeniser fails.
    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError>;

    /// Returns true if the tokens of a text are always the concatenation of its sentences' tokens, each cut with [`TextStart::Within`]. A sentence
    /// ends with a full stop, an exclamation or a question mark before a space; the space is not part of the next one.
    fn sentences_apart(&self) -> bool {
        false
    }

    /// Counts the tokens of a sentence within a prompt, on any thread. The default counts bytes, an upper bound for any tokeniser.
    fn token_counter(&self) -> TokenCounter {
        Arc::new(str::len)
    }

    /// The readable text of a token.
    fn token_text(&self, token: Token) -> String;

    /// Allocates memory for `positions` tokens of prompt and tree together, and frees the rest. A longer prompt allocates more on demand, up to the
    /// model's limit. The kept prefix may be lost.
    ///
    /// # Errors
    /// If there is not enough memory.
    fn reserve(&mut self, _positions: usize) -> Result<(), ModelError> {
        Ok(())
    }

    /// Drops all kept prefixes: the next call decodes the whole prompt. Does nothing if the model keeps none.
    fn forget(&mut self) {}

    /// Decodes `prompt` (the prefix shared with the last call's prompt is reused), then `tree` after it, and passes each row of logits to `visit`:
    /// row 0 follows the prompt (only if `want_prompt_row`), row `i + 1` follows tree node `i`.
    ///
    /// Every node must be visited, or the scorer refuses the call ([`ModelError::Rows`]). A node may be visited more than once with the same values
    /// up to rounding, if the tree has more paths than the model has sequences.
    ///
    /// # Errors
    /// If prompt and tree do not fit, or the decoder fails; the kept prefix is dropped then.
    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError>;

    /// Decodes a part of `prompt` short enough not to delay an event, for reuse by a later [`LanguageModel::decode`]. Returns whether the whole
    /// prompt is decoded. The default decodes everything at once.
    ///
    /// # Errors
    /// As [`LanguageModel::decode`].
    fn read(&mut self, prompt: &[Token]) -> Result<bool, ModelError> {
        self.decode(prompt, &TokenTree::default(), false, &mut |_, _| {})?;
        Ok(true)
    }

    /// Decodes a further part of a prompt that another decode may need later, for example after the next cut of a window, without the loss of the kept
    /// prefix. The part is short enough not to delay an event, and `calls` such calls decode all if the model is fast enough. Returns whether the
    /// whole prompt is decoded. The default does nothing.
    ///
    /// # Errors
    /// As [`LanguageModel::decode`].
    fn read_part(&mut self, _prompt: &[Token], _calls: usize) -> Result<bool, ModelError> {
        Ok(true)
    }

    /// A second instance of the model for a background thread. It gives the same scores up to rounding, and fails with [`ModelError::Stopped`] soon
    /// after `is_stopped` returns true. `None` if prefetching would save no time.
    ///
    /// # Errors
    /// If there is not enough memory.
    fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError>
    where
        Self: Sized,
    {
        Ok(None)
    }

    /// Registers `moved`, which is called after each call of the decoder. The default ignores it.
    fn watch(&mut self, _moved: Progress) {}

    /// Drops the last call's data after the first `keep` tokens of its prompt: the next prompt shares only these tokens. Called while idle.
    fn tidy(&mut self, _keep: usize) {}
}

/// Cost of a call of [`LanguageModel::decode`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DecodeStats {
    /// Calls of the decoder: each reads all weights once.
    pub calls: u32,
    /// Prompt tokens decoded, without those reused from the last call.
    pub prompt_tokens_decoded: u32,
    /// Tree tokens decoded, repeats included.
    pub tree_tokens_decoded: u32,
    /// Nanoseconds within the decoder's calls.
    pub decoder_ns: u64,
}

impl std::ops::AddAssign for DecodeStats {
    fn add_assign(&mut self, other: Self) {
        self.calls += other.calls;
        self.prompt_tokens_decoded += other.prompt_tokens_decoded;
        self.tree_tokens_decoded += other.tree_tokens_decoded;
        self.decoder_ns += other.decoder_ns;
    }
}
