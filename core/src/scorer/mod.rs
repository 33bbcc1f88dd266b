//! Scores of labels as continuations of a prompt (the paper's Equation 1).
//!
//! `s_c,i = prod_j p(c_i^j | N_h + B + c_i^(1..j-1))`, over all tokens `j` of label `i`, in nats as a sum of logarithms; corrected on request
//! ([`correction`]).
//!
//! [`Scorer`] holds the algorithm, [`LanguageModel`] is its interface to a model. The crate `roomcast-llama` has the real model;
//! [`table::TableModel`] is a deterministic one with a known next-token table, for tests.

use std::sync::Arc;

use self::certified::{Certified, Effort};
use self::correction::{Continuation, Correction};
use self::cutter::Cutter;
use self::familiarity::Familiarity;
pub use crate::label_trie::Token;
use crate::label_trie::{END, LabelTrie, Node, PROMPT, TokenTree};
use crate::prompt::{BindingSequence, write_prompt};

pub mod certified;
pub mod correction;
pub mod cutter;
pub mod familiarity;
pub mod softmax;
pub mod table;

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
    /// Why its scores are noise ([`familiarity::weakness`]); `None` for a usable model, and for one that was not checked.
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

    /// The clock for step times and for [`Effort::Deadline`]; this crate has no clock of its own. The default stands still.
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

crate::choices! {
    /// How labels are scored. All methods give the same scores up to rounding; the slower ones verify the trie.
    #[derive(Default, Hash)]
    pub enum Method {
        /// Each label by itself, the whole prompt every time.
        Independent,
        /// The prompt once, one sequence per label.
        SharedPrefix,
        /// The prompt once, then the labels' token trie.
        #[default]
        Trie,
    }
}

impl Method {
    /// Whether this method supports `effort`: the other methods always score every label.
    #[must_use]
    pub fn allows(self, effort: Effort) -> bool {
        self == Self::Trie || effort == Effort::Exact
    }
}

crate::choices! {
    /// How prompt and label are cut into tokens.
    #[derive(Default, Hash)]
    pub enum Tokenisation {
        /// Together, so that a label is cut as the model saw it in text (`" mug"`).
        #[default]
        Joint,
        /// Each part by itself, the binding sequence with its trailing space.
        Paper,
    }
}

/// A failure of scoring.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScoreError {
    /// The model failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A label without words.
    #[error("label {index} ({label:?}) has no tokens: give it words, or remove it from the map")]
    EmptyLabel {
        /// Index of the label.
        index: usize,
        /// Text of the label.
        label: String,
    },
    /// There is no label.
    #[error("there is no label to score: the map has no items, and room names are switched off")]
    NoLabels,
}

/// The labels of a map, cut into tokens after one binding sequence: built once, used for every event.
#[derive(Debug, Clone)]
pub struct PreparedLabels {
    labels: Vec<String>,
    tokens: Vec<Vec<Token>>,
    /// All tokens, or under [`Continuation::Labels`] only those that distinguish the labels.
    trie: LabelTrie,
    inner_tree: TokenTree,
    /// One chain per label, for [`Method::SharedPrefix`].
    chains: LabelTrie,
    chain_tree: TokenTree,
    /// Per node of `chains`: its node in `trie`.
    chain_nodes: Vec<usize>,
    /// Tokens at the end of the prompt that the labels' tokens replace because a merge crosses the boundary; nearly always 0.
    replaced: usize,
    binding: BindingSequence,
    tokenisation: Tokenisation,
    correction: Correction,
    familiarity: Familiarity,
    /// `ln g_c` per label, in nats.
    gain_nats: Vec<f64>,
}

impl PreparedLabels {
    /// The labels' texts, in the caller's order.
    #[must_use]
    pub fn labels(&self) -> &[String] {
        &self.labels
    }

    /// The tokens of each label.
    #[must_use]
    pub fn tokens(&self) -> &[Vec<Token>] {
        &self.tokens
    }

    /// The trie.
    #[must_use]
    pub fn trie(&self) -> &LabelTrie {
        &self.trie
    }

    /// Length of the longest label in tokens.
    #[must_use]
    pub(crate) fn longest_label(&self) -> usize {
        self.tokens.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// The binding sequence before the labels.
    #[must_use]
    pub fn binding(&self) -> &BindingSequence {
        &self.binding
    }

    /// How prompt and labels are cut.
    #[must_use]
    pub fn tokenisation(&self) -> Tokenisation {
        self.tokenisation
    }

    /// How scores are corrected.
    #[must_use]
    pub fn correction(&self) -> Correction {
        self.correction
    }

    /// `ln g_c` per label in nats, the greatest 0; all 0 without a prior.
    #[must_use]
    pub(crate) fn gain_nats(&self) -> &[f64] {
        &self.gain_nats
    }

    fn rescale(&self, scores: &mut LabelScores) {
        scores.scale_nats = match self.correction.prior {
            0.0 => 0.0,
            _ => correction::rescale(&mut scores.log_prob_nats, &self.gain_nats),
        };
    }
}

/// The scores of one prompt.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LabelScores {
    /// `ln s_c` per label in nats: Equation 1, corrected.
    pub log_prob_nats: Vec<f64>,
    /// Tokens of the prompt.
    pub prompt_tokens: usize,
    /// The weight of these scores in a forecast, 0 to 1. Below 1 the model does not know the words ([`familiarity`]); 0 for a weak model.
    pub trust: f64,
    /// `ln k` of the prior in nats. It and the label's gain were added to the sum over the label's tokens.
    pub scale_nats: f64,
    /// Cost of decoding.
    pub stats: DecodeStats,
    /// Nanoseconds spent on tokenising the prompt.
    pub tokenise_ns: u64,
    /// Nanoseconds in decoder calls that held the prompt.
    pub prefix_ns: u64,
    /// Nanoseconds after those calls: the rest of the trie, and the pass over it.
    pub trie_ns: u64,
    /// The method used: [`Method::Independent`] if the model cannot share a prefix.
    pub method: Method,
}

/// The scoring algorithm over a model; owns every buffer that an event needs.
#[derive(Debug)]
pub struct Scorer<M> {
    model: M,
    /// Scratch: a row of logits without a node's children, for labels that end at the node.
    without_children: Vec<f32>,
    rows: Rows,
    /// The last prompt's tokens, without the replaced ones.
    prompt: Vec<Token>,
    /// Tokens of the last prompt that the next one probably shares: all but the binding sequence.
    kept_tokens: usize,
    cutter: Cutter,
    /// Per trie node `ln p(token | path to its parent)`, then `ln q(n)`, from the last [`Scorer::score`] by [`Method::Trie`].
    node_log_prob_nats: Vec<f64>,
}

impl<M: LanguageModel> Scorer<M> {
    /// A scorer that uses `model`.
    pub fn new(model: M) -> Self {
        Self {
            model,
            without_children: Vec::new(),
            rows: Rows::default(),
            prompt: Vec::new(),
            kept_tokens: 0,
            cutter: Cutter::default(),
            node_log_prob_nats: Vec::new(),
        }
    }

    /// The model's description.
    pub fn info(&self) -> &ModelInfo {
        self.model.info()
    }

    /// The model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// The model, without the scorer.
    pub fn into_model(self) -> M {
        self.model
    }

    /// Registers `moved`, which the model calls after each call of the decoder.
    pub fn watch(&mut self, moved: Progress) {
        self.model.watch(moved);
    }

    /// Allocates memory for `positions` tokens of prompt and labels together ([`LanguageModel::reserve`]).
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn reserve(&mut self, positions: usize) -> Result<(), ScoreError> {
        Ok(self.model.reserve(positions)?)
    }

    /// Drops all kept prefixes.
    pub fn forget(&mut self) {
        self.model.forget();
    }

    /// Housekeeping for idle time.
    pub fn tidy(&mut self) {
        self.model.tidy(self.kept_tokens);
    }

    /// Cuts labels into tokens after a binding sequence, and builds their trie.
    ///
    /// Under [`Tokenisation::Joint`] a label's tokens are the tokens of binding sequence and label together, minus those of the binding sequence
    /// alone. If a merge crosses the boundary for any label, the crossing tokens of the binding sequence are scored with every label, so that all
    /// scores remain comparable.
    ///
    /// All gains are 0: [`Scorer::prepare`] also computes the prior's gains.
    ///
    /// # Errors
    /// If there is no label, a label has no tokens, or the tokeniser fails.
    pub fn cut<L: AsRef<str>>(
        &self,
        labels: &[L],
        binding: &BindingSequence,
        tokenisation: Tokenisation,
        correction: Correction,
    ) -> Result<PreparedLabels, ScoreError> {
        if labels.is_empty() {
            return Err(ScoreError::NoLabels);
        }
        let mut stem = Vec::new();
        let mut tokens = Vec::with_capacity(labels.len());
        let mut replaced = 0;
        match tokenisation {
            Tokenisation::Paper => {
                for label in labels {
                    let mut own = Vec::new();
                    self.model.tokenise(label.as_ref(), TextStart::Within, &mut own)?;
                    tokens.push(own);
                }
            }
            Tokenisation::Joint => {
                self.model.tokenise(binding.stem(), TextStart::Within, &mut stem)?;
                let mut shared = stem.len();
                for label in labels {
                    let mut joint = Vec::new();
                    self.model.tokenise(
                        &format!("{} {}", binding.stem(), label.as_ref()),
                        TextStart::Within,
                        &mut joint,
                    )?;
                    shared = shared.min(common_prefix(&stem, &joint));
                    tokens.push(joint);
                }
                replaced = stem.len() - shared;
                for joint in &mut tokens {
                    joint.drain(..shared);
                }
            }
        }
        if let Some(index) = tokens.iter().zip(labels).position(|(t, l)| t.is_empty() || l.as_ref().trim().is_empty()) {
            return Err(ScoreError::EmptyLabel { index, label: labels[index].as_ref().to_owned() });
        }
        let of_binding = if tokenisation == Tokenisation::Paper { binding.text() } else { binding.stem() };
        let familiarity = Familiarity::of(&self.model, (labels, tokens.as_slice()), of_binding)?;
        let trie = match correction.continuation {
            Continuation::Free => LabelTrie::new(&tokens),
            Continuation::Labels => LabelTrie::distinct_prefixes(&tokens),
        };
        let mut chain_nodes = Vec::new();
        let mut paths: Vec<Vec<Token>> = Vec::with_capacity(tokens.len());
        for label in 0..tokens.len() {
            let first = chain_nodes.len();
            chain_nodes.extend(trie.path(label));
            chain_nodes[first..].reverse();
            paths.push(chain_nodes[first..].iter().map(|&node| trie.nodes()[node].token).collect());
        }
        let chains = LabelTrie::chains(&paths);
        Ok(PreparedLabels {
            labels: labels.iter().map(|l| l.as_ref().to_owned()).collect(),
            inner_tree: TokenTree::of_inner_nodes(&trie),
            chain_tree: TokenTree::of_inner_nodes(&chains),
            gain_nats: vec![0.0; tokens.len()],
            tokens,
            trie,
            chains,
            chain_nodes,
            replaced,
            binding: binding.clone(),
            tokenisation,
            correction,
            familiarity,
        })
    }

    /// Computes the labels' gains from a blank narration if there is a prior. The kept prefix is lost then.
    ///
    /// # Errors
    /// If the model fails.
    pub(crate) fn learn_prior(&mut self, prepared: &mut PreparedLabels) -> Result<(), ScoreError> {
        let Correction { prior, .. } = prepared.correction;
        if prior > 0.0 {
            let mut blank = String::new();
            write_prompt([], &prepared.binding, prepared.tokenisation == Tokenisation::Paper, &mut blank);
            let mut scores = LabelScores::default();
            prepared.gain_nats.fill(0.0);
            self.score(prepared, &blank, Method::Trie, &mut scores)?;
            prepared.gain_nats = correction::gains(&scores.log_prob_nats, prior);
            self.node_log_prob_nats.clear();
        }
        Ok(())
    }

    /// [`Scorer::cut`] plus the gains of the prior; done once per map, binding sequence and model.
    ///
    /// # Errors
    /// As [`Scorer::cut`], and if the model fails.
    pub fn prepare<L: AsRef<str>>(
        &mut self,
        labels: &[L],
        binding: &BindingSequence,
        tokenisation: Tokenisation,
        correction: Correction,
    ) -> Result<PreparedLabels, ScoreError> {
        let mut prepared = self.cut(labels, binding, tokenisation, correction)?;
        self.learn_prior(&mut prepared)?;
        Ok(prepared)
    }

    /// Scores every label after `prompt`, written by [`crate::prompt::write_prompt`] with the same binding sequence (with its trailing space under
    /// [`Tokenisation::Paper`]).
    ///
    /// If the model cannot share a prefix, [`Method::Independent`] is used; `out.method` records it.
    ///
    /// # Errors
    /// If the prompt does not fit or the model fails. `out` is invalid then.
    pub fn score(
        &mut self,
        prepared: &PreparedLabels,
        prompt: &str,
        method: Method,
        out: &mut LabelScores,
    ) -> Result<(), ScoreError> {
        let now = self.model.clock();
        let start = now();
        self.begin(prepared, prompt, method, out)?;
        out.tokenise_ns = now().saturating_sub(start);
        match out.method {
            Method::Trie => self.score_trie(prepared, &prepared.trie, &prepared.inner_tree, None, out),
            Method::SharedPrefix => {
                let places = Some(prepared.chain_nodes.as_slice());
                self.score_trie(prepared, &prepared.chains, &prepared.chain_tree, places, out)
            }
            Method::Independent => self.score_independent(prepared, out),
        }?;
        if out.method != Method::Trie {
            self.node_log_prob_nats.clear();
        }
        prepared.rescale(out);
        Ok(())
    }

    /// Swaps the data behind [`Scorer::token_log_prob_nats`] with that from another scorer.
    pub(crate) fn exchange_nodes(&mut self, nodes: &mut Vec<f64>) {
        std::mem::swap(&mut self.node_log_prob_nats, nodes);
    }

    /// Tokens that a sentence takes in a window, its separator included.
    pub(crate) fn cost_of(&mut self, sentence: &str) -> usize {
        match self.sentence_tokens(sentence) {
            Ok(tokens) => tokens + 1,
            // An upper bound; scoring will report the error.
            Err(_) => sentence.len(),
        }
    }

    /// Tokens of `sentence` within a prompt. They are cached for the prompt that will contain it.
    ///
    /// # Errors
    /// If the tokeniser fails.
    pub fn sentence_tokens(&mut self, sentence: &str) -> Result<usize, ScoreError> {
        self.cutter.cut_narration(&self.model, sentence, &mut self.prompt)?;
        Ok(self.prompt.len())
    }

    fn cut_prompt(&mut self, prompt: &str) -> Result<(), ScoreError> {
        Ok(self.cutter.cut_prompt(&self.model, prompt, &mut self.prompt)?)
    }

    /// Cuts the prompt into tokens and resets `out`.
    fn begin(
        &mut self,
        prepared: &PreparedLabels,
        prompt: &str,
        method: Method,
        out: &mut LabelScores,
    ) -> Result<(), ScoreError> {
        self.cut_prompt(prompt)?;
        out.prompt_tokens = self.prompt.len();
        let is_weak = self.model.info().weakness.is_some();
        out.trust = if is_weak { 0.0 } else { prepared.familiarity.trust(out.prompt_tokens, prompt.len()) };
        self.kept_tokens = self.cutter.narration_tokens().unwrap_or(out.prompt_tokens);
        self.prompt.truncate(self.prompt.len().saturating_sub(prepared.replaced));
        if self.prompt.is_empty() {
            return Err(ModelError::EmptyPrompt.into());
        }
        out.method = if self.model.info().shares_prefix { method } else { Method::Independent };
        out.stats = DecodeStats::default();
        out.prefix_ns = 0;
        out.trie_ns = 0;
        out.log_prob_nats.clear();
        self.node_log_prob_nats.clear();
        Ok(())
    }

    /// `ln p(token | prompt and the tokens before it)` per token of a label, in nats, from the last [`Scorer::score`]. If another label continues
    /// this one, the last value includes the probability that the label ends here. `None` if the last score was not by [`Method::Trie`].
    #[must_use]
    pub fn token_log_prob_nats(&self, prepared: &PreparedLabels, label: usize) -> Option<Vec<f64>> {
        let nodes = prepared.trie.nodes();
        if self.node_log_prob_nats.len() != nodes.len() {
            return None;
        }
        // Tokens that no other label shares are not in the trie: they are certain.
        let mut tokens = vec![0.0; prepared.tokens.get(label)?.len()];
        for node in prepared.trie.path(label) {
            let Node { parent, depth, .. } = nodes[node];
            let before = if parent == PROMPT { 0.0 } else { self.node_log_prob_nats[parent as usize] };
            let place = (depth as usize).min(tokens.len()) - 1;
            tokens[place] += self.node_log_prob_nats[node] - before;
        }
        Some(tokens)
    }

    fn score_independent(&mut self, prepared: &PreparedLabels, out: &mut LabelScores) -> Result<(), ScoreError> {
        let mut places = prepared.chain_nodes.as_slice();
        while !places.is_empty() {
            // A chain ends before the next node that follows the prompt.
            let follows_prompt = |&place: &usize| prepared.trie.nodes()[place].parent == PROMPT;
            let length = places.iter().skip(1).position(follows_prompt).map_or(places.len(), |next| next + 1);
            let (chain, rest) = places.split_at(length);
            let tokens: Vec<_> = chain.iter().map(|&place| prepared.trie.nodes()[place].token).collect();
            let trie = LabelTrie::chains(&[tokens]);
            self.model.forget();
            self.score_trie(prepared, &trie, &TokenTree::of_inner_nodes(&trie), Some(chain), out)?;
            places = rest;
        }
        self.model.forget();
        Ok(())
    }

    /// Scores labels after `prompt` until `state.bounds` answer `effort`'s question, by [`Method::Trie`]. The first call decodes the prompt and a
    /// guess at the important nodes. Further calls follow while the question is open and, under [`Effort::Deadline`], while the next call is expected
    /// to end before `deadline_ns`, judged by the last call's duration.
    ///
    /// For decided labels `out.log_prob_nats` is exact except for the prior's scale, which is common to all labels. For the others it is an estimate
    /// within the bounds. A model that cannot share a prefix is scored exactly.
    ///
    /// # Errors
    /// As [`Scorer::score`].
    pub(crate) fn score_certified(
        &mut self,
        prepared: &PreparedLabels,
        state: &mut Certified,
        prompt: &str,
        effort: Effort,
        deadline_ns: Option<u64>,
        out: &mut LabelScores,
    ) -> Result<(), ScoreError> {
        let now = self.model.clock();
        let start = now();
        self.begin(prepared, prompt, Method::Trie, out)?;
        out.tokenise_ns = now().saturating_sub(start);
        let trie = &prepared.trie;
        state.decoded.fill(false);
        if !self.model.info().shares_prefix {
            out.method = Method::Independent;
            self.score_independent(prepared, out)?;
            prepared.rescale(out);
            return Ok(());
        }
        let mut first = true;
        loop {
            let call = now();
            state.plan(trie);
            let mut softmax_ns = 0;
            let mut bad_row = None;
            let Certified { conditional, decoded, sent, tree, .. } = &mut *state;
            let (without_children, rows) = (&mut self.without_children, &mut self.rows);
            rows.ask(tree.len(), first);
            let stats = self.model.decode(&self.prompt, tree, first, &mut |row, logits| {
                if !rows.take(row) {
                    return;
                }
                let start = now();
                let parent = match row {
                    0 => None,
                    _ => {
                        let place = sent[row - 1] as usize;
                        if std::mem::replace(&mut decoded[place], true) {
                            return;
                        }
                        Some(trie.inner()[place] as usize)
                    }
                };
                let rivals = prepared.correction.continuation.rivals(trie, parent);
                if !read_row(trie, parent, rivals, logits, without_children, |child, log_prob_nats| {
                    conditional[child] = log_prob_nats.exp();
                }) {
                    bad_row = Some(row);
                }
                softmax_ns += now().saturating_sub(start);
            })?;
            self.rows.check(bad_row).inspect_err(|_| self.model.forget())?;
            let call_ns = now().saturating_sub(call);
            out.stats += stats;
            let settling = now();
            let answered = state.settle(trie, effort);
            let settle_ns = now().saturating_sub(settling);
            if first {
                out.prefix_ns += call_ns.saturating_sub(softmax_ns);
                out.trie_ns += softmax_ns + settle_ns;
            } else {
                out.trie_ns += call_ns + settle_ns;
            }
            first = false;
            let late = deadline_ns.is_some_and(|end_ns| now().saturating_add(call_ns) > end_ns);
            if answered || (effort == Effort::Deadline && late) {
                break;
            }
            state.want_more(trie, effort);
        }
        out.log_prob_nats.clear();
        out.log_prob_nats.extend(trie.label_end().iter().map(|&end| state.q[end as usize].ln()));
        prepared.rescale(out);
        state.guess(trie, effort);
        Ok(())
    }

    /// Decodes a small part of `prompt` in advance, so that the next prompt that begins with it decodes only the rest. Returns whether all of it is
    /// decoded.
    ///
    /// # Errors
    /// If the prompt does not fit or the model fails.
    pub(crate) fn read_ahead(&mut self, prompt: &str) -> Result<bool, ScoreError> {
        self.cut_prompt(prompt)?;
        self.kept_tokens = self.prompt.len();
        if self.prompt.is_empty() || !self.model.info().shares_prefix {
            return Ok(true);
        }
        Ok(self.model.read(&self.prompt)?)
    }

    /// Decodes a small part of `prompt` for later ([`LanguageModel::read_part`]). Returns whether all of it is decoded.
    ///
    /// # Errors
    /// If the model fails.
    pub(crate) fn read_part(&mut self, prompt: &str, calls: usize) -> Result<bool, ScoreError> {
        self.cut_prompt(prompt)?;
        Ok(self.model.read_part(&self.prompt, calls)?)
    }

    /// Scores the labels of `trie` after `self.prompt`, and appends the scores to `out`. `places` maps nodes of `trie` to nodes of `prepared.trie`;
    /// `None` if the two tries are the same.
    fn score_trie(
        &mut self,
        prepared: &PreparedLabels,
        trie: &LabelTrie,
        tree: &TokenTree,
        places: Option<&[usize]>,
        out: &mut LabelScores,
    ) -> Result<(), ScoreError> {
        let now = self.model.clock();
        let start = now();
        let nodes = trie.nodes();
        self.node_log_prob_nats.clear();
        self.node_log_prob_nats.resize(nodes.len(), f64::NEG_INFINITY);
        let (log_prob, without_children) = (&mut self.node_log_prob_nats, &mut self.without_children);
        let rows = &mut self.rows;
        rows.ask(tree.len(), true);
        let mut bad_row = None;
        let mut softmax_ns = 0;
        let stats = self.model.decode(&self.prompt, tree, true, &mut |row, logits| {
            if !rows.take(row) {
                return;
            }
            let start = now();
            let parent = row.checked_sub(1).map(|place| trie.inner()[place] as usize);
            let place = parent.map(|node| places.map_or(node, |places| places[node]));
            let rivals = prepared.correction.continuation.rivals(&prepared.trie, place);
            if !read_row(trie, parent, rivals, logits, without_children, |child, log_prob_nats| {
                log_prob[child] = log_prob_nats;
            }) {
                bad_row = Some(row);
            }
            softmax_ns += now().saturating_sub(start);
        })?;
        self.rows.check(bad_row).inspect_err(|_| self.model.forget())?;
        let decoded = now();
        // Parents precede their children, so one pass turns conditional probabilities into q(n).
        for index in 0..nodes.len() {
            if nodes[index].parent != PROMPT {
                log_prob[index] += log_prob[nodes[index].parent as usize];
            }
        }
        out.log_prob_nats.extend(trie.label_end().iter().map(|&end| log_prob[end as usize]));
        out.stats += stats;
        let decode_ns = decoded.saturating_sub(start);
        out.prefix_ns += decode_ns.saturating_sub(softmax_ns);
        out.trie_ns += softmax_ns + now().saturating_sub(decoded);
        Ok(())
    }
}

/// The rows of logits that a call of [`LanguageModel::decode`] must visit, and those that it visited. A model of another author may miss one.
#[derive(Debug, Default)]
struct Rows {
    /// Row 0 follows the prompt.
    came: Vec<bool>,
    given: usize,
    /// A row came that was not asked for.
    is_beyond: bool,
}

impl Rows {
    fn ask(&mut self, nodes: usize, with_prompt: bool) {
        self.came.clear();
        self.came.resize(1 + nodes, false);
        self.came[0] = !with_prompt;
        (self.given, self.is_beyond) = (usize::from(!with_prompt), false);
    }

    /// Records a row, and returns whether it was asked for.
    fn take(&mut self, row: usize) -> bool {
        let Some(came) = self.came.get_mut(row) else {
            self.is_beyond = true;
            return false;
        };
        self.given += usize::from(!std::mem::replace(came, true));
        true
    }

    /// Fails unless exactly the rows asked for came and all are finite.
    fn check(&self, bad_row: Option<usize>) -> Result<(), ModelError> {
        let asked = self.came.len();
        match bad_row {
            Some(row) => Err(ModelError::NotFinite { at: row_name(row) }),
            None if self.given < asked || self.is_beyond => Err(ModelError::Rows { given: self.given, asked }),
            None => Ok(()),
        }
    }
}

/// Calls `give` with `ln p(child | path)` for every child of `parent` (the trie's roots for `None`), from the row of logits after `parent`.
///
/// `rivals` are the node's children in the trie of all labels. With them, only the children share the probability; if a label ends at the node, it
/// competes too, with the probability of all other tokens (`without_children` is scratch for this).
///
/// Returns false if a value that was needed is not finite. Minus infinity counts as a probability of zero.
fn read_row(
    trie: &LabelTrie,
    parent: Option<usize>,
    rivals: Option<impl Iterator<Item = Token> + Clone>,
    logits: &[f32],
    without_children: &mut Vec<f32>,
    mut give: impl FnMut(usize, f64),
) -> bool {
    let place = |token: Token| usize::try_from(token.0).ok().filter(|&place| place < logits.len());
    let mut end = f64::NEG_INFINITY;
    let mut impossible = None;
    let denominator = match rivals {
        None => softmax::log_sum_exp(logits),
        Some(mut rivals) => {
            let children = rivals.clone().filter_map(place);
            let shared = softmax::log_sum_exp_of(children.clone().map(|place| f64::from(logits[place])));
            if rivals.any(|token| token == END) {
                without_children.clear();
                without_children.extend_from_slice(logits);
                children.for_each(|place| without_children[place] = f32::NEG_INFINITY);
                end = softmax::log_sum_exp(without_children);
                softmax::log_sum_exp_of([shared, end].into_iter())
            } else if shared == f64::NEG_INFINITY {
                // No label is possible here: the children are equally likely.
                impossible = Some(-(children.count() as f64).ln());
                0.0
            } else {
                shared
            }
        }
    };
    end -= denominator;
    for child in trie.children(parent) {
        let token = trie.nodes()[child].token;
        let logit = place(token).map_or(f64::NEG_INFINITY, |place| f64::from(logits[place]));
        give(child, if token == END { end } else { impossible.unwrap_or(logit - denominator) });
    }
    denominator.is_finite()
}

fn row_name(row: usize) -> String {
    if row == 0 { "the prompt".to_owned() } else { format!("trie node {}", row - 1) }
}

/// Length of the common prefix of two token sequences.
#[must_use]
pub fn common_prefix(a: &[Token], b: &[Token]) -> usize {
    a.iter().zip(b).take_while(|(a, b)| a == b).count()
}
