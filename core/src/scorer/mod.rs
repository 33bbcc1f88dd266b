//! Scores of labels as continuations of a prompt (the paper's Equation 1).
//!
//! `s_c,i = prod_j p(c_i^j | N_h + B + c_i^(1..j-1))`, over all tokens `j` of label `i`, in nats as a sum of logarithms; corrected where
//! that was asked for ([`correction`]).
//!
//! [`Scorer`] holds the algorithm, [`LanguageModel`] what it needs of a model. The crate `roomcast-llama` has the real one;
//! [`table::TableModel`] is a deterministic one whose next-token table is known by construction, for tests.

use std::sync::Arc;

use self::certified::{Certified, Effort};
use self::correction::{Continuation, Correction};
use self::cutter::Cutter;
pub use crate::label_trie::Token;
use crate::label_trie::{END, LabelTrie, Node, PROMPT, TokenTree};
use crate::prompt::{BindingSequence, write_prompt};

pub mod certified;
pub mod correction;
pub mod cutter;
pub mod softmax;
pub mod table;

/// What a language model says of itself.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize)]
pub struct ModelInfo {
    /// Its own name, or the file's.
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
    /// Positions that prompt and label together may take.
    pub context_tokens: usize,
    /// Whether a prefix can be shared between continuations; not so with recurrent and hybrid models.
    pub shares_prefix: bool,
    /// The correction of scores that the model file recommends.
    pub correction: Correction,
    /// SHA-256 of the model file; zeros when there is none.
    #[serde(serialize_with = "hex::serialize")]
    pub fingerprint: [u8; 32],
}

/// A model that failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The file is no sound model; names it, and says what to do.
    #[error(transparent)]
    File(Box<dyn std::error::Error + Send + Sync>),
    /// The file cannot be loaded.
    #[error("failed to load the model {path}: {reason}; `roomcast model info` shows what the file is")]
    Load {
        /// The file.
        path: String,
        /// What the loader said.
        reason: String,
    },
    /// The file is sound, and there is no room to work with it.
    #[error(
        "the model {model} gets no memory for a context of {context_tokens} tokens ({reason}): raise the limit on memory \
         (MemoryMax=, ulimit -v), or lower model.context_tokens, or choose a smaller model.cache"
    )]
    Context {
        /// The model's name.
        model: String,
        /// How many tokens it was to hold.
        context_tokens: u32,
        /// What the loader said.
        reason: String,
    },
    /// Text that cannot be tokenised.
    #[error("failed to tokenise {text:?}: {reason}")]
    Tokenise {
        /// The text, shortened.
        text: String,
        /// What the tokeniser said.
        reason: String,
    },
    /// Prompt and labels do not fit in the context.
    #[error(
        "the prompt has {prompt} tokens and its labels need {tree} more, but the model's context holds {context}: shorten the history or raise model.context_tokens"
    )]
    TooLong {
        /// Tokens of the prompt.
        prompt: usize,
        /// Tokens of the tree behind it.
        tree: usize,
        /// Size of the context.
        context: usize,
    },
    /// The prompt has no token at all.
    #[error("the prompt is empty and the model has no start token: give narration or a binding sequence")]
    EmptyPrompt,
    /// The decoder failed.
    #[error("the model failed to decode {tokens} tokens: {reason}")]
    Decode {
        /// Tokens in the failing call.
        tokens: usize,
        /// What the decoder said.
        reason: String,
    },
    /// It was told to stop.
    #[error("scoring was broken off")]
    Stopped,
    /// The model gave a value that is not a number.
    #[error("the model gave logits that are not finite after {at}: the file is damaged or its quantisation is broken")]
    NotFinite {
        /// Where.
        at: String,
    },
    /// The model did not visit the rows that it was asked for.
    #[error(
        "the model gave {given} of {asked} rows of logits: LanguageModel::decode visits each row that it is asked for, and no other"
    )]
    Rows {
        /// How many of them came.
        given: usize,
        /// How many were asked for.
        asked: usize,
    },
}

/// How a text stands in a sequence.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextStart {
    /// At the beginning: the model's start token is put before it where the model wants one.
    Sequence,
    /// Somewhere within.
    Within,
}

/// Nanoseconds that never go back, from any beginning.
pub type Clock = fn() -> u64;

/// How many tokens a text costs, for threads that do not have the model.
pub type TokenCounter = Arc<dyn Fn(&str) -> usize + Send + Sync>;

/// Whether work for which nobody waits is to stop.
pub type IsStopped = Arc<dyn Fn() -> bool + Send + Sync>;

/// Whom work tells that it goes on.
pub type Progress = Arc<dyn Fn() + Send + Sync>;

/// What the scoring algorithm needs of a model: its description, tokens of a text, the text of a token, and logits. Everything else has a default.
pub trait LanguageModel {
    /// What the model says of itself.
    fn info(&self) -> &ModelInfo;

    /// The clock that steps are timed by, and end by under [`Effort::Deadline`]: this crate has none of its own. By the one given here
    /// nothing takes any time.
    fn clock(&self) -> Clock {
        || 0
    }

    /// Appends the tokens of `text` to `out`. Control tokens written in the text are taken as text.
    ///
    /// # Errors
    /// When the tokeniser fails.
    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError>;

    /// Whether a text is always cut into the tokens of its sentences, cut [`TextStart::Within`] one by one: a sentence ends with a full
    /// stop, an exclamation or a question mark before a space, and the space is not part of the next one.
    fn sentences_apart(&self) -> bool {
        false
    }

    /// Counts the tokens of a sentence within a prompt, on any thread. The one given here counts bytes, of which no tokeniser makes more
    /// tokens.
    fn token_counter(&self) -> TokenCounter {
        Arc::new(str::len)
    }

    /// The text of a token, for people.
    fn token_text(&self, token: Token) -> String;

    /// Takes memory for prompts and trees of so many tokens together, and frees the rest. A longer prompt takes more when it comes, up to
    /// the model's limit. The kept prefix may be forgotten.
    ///
    /// # Errors
    /// When there is no memory for it.
    fn reserve(&mut self, _positions: usize) -> Result<(), ModelError> {
        Ok(())
    }

    /// Forgets the kept prefix: the next call decodes the whole prompt. A model that keeps no prefix has nothing to forget.
    fn forget(&mut self) {}

    /// Decodes `prompt` (what it shares with the last call's prompt is kept, not decoded again), then `tree` behind it,
    /// and gives each row of logits to `visit`: row 0 follows the prompt (only when `want_prompt_row`), row `i + 1` follows tree node `i`.
    ///
    /// Every node is visited, or the scorer refuses the call ([`ModelError::Rows`]). One may be visited more than once with the same values up
    /// to rounding, when the tree has more paths than the model has sequences.
    ///
    /// # Errors
    /// When prompt and tree do not fit, or the decoder fails; the kept prefix is forgotten then.
    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError>;

    /// Reads a part of `prompt` that is small enough for an event to wait for, as a later [`LanguageModel::decode`] keeps it, and gives whether
    /// all of it is read. The one given here reads all at once.
    ///
    /// # Errors
    /// As [`LanguageModel::decode`].
    fn read(&mut self, prompt: &[Token]) -> Result<bool, ModelError> {
        self.decode(prompt, &TokenTree::default(), false, &mut |_, _| {})?;
        Ok(true)
    }

    /// The same model a second time, for a thread of its own beside this one's: it gives the same scores up to rounding, and ends with
    /// [`ModelError::Stopped`] soon after `is_stopped` says so. None where scoring costs nothing that could be done before.
    ///
    /// # Errors
    /// When there is no memory for it.
    fn twin(&self, _is_stopped: IsStopped) -> Result<Option<Self>, ModelError>
    where
        Self: Sized,
    {
        Ok(None)
    }

    /// Has `moved` called after each call of the decoder. By the one given here nothing takes so long that anybody waits for it.
    fn watch(&mut self, _moved: Progress) {}

    /// Drops what the last call left behind beyond the first `keep` tokens of its prompt, all that the next prompt will have of them;
    /// called while idle.
    fn tidy(&mut self, _keep: usize) {}
}

/// What a call of [`LanguageModel::decode`] cost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DecodeStats {
    /// Calls of the decoder: each reads all weights once.
    pub calls: u32,
    /// Prompt tokens decoded, those kept from the last call not counted.
    pub prompt_tokens_decoded: u32,
    /// Tree tokens decoded, repeats included.
    pub tree_tokens_decoded: u32,
    /// Nanoseconds within the decoder's calls: what is left of a step's time is ours.
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
    /// How labels are scored. All methods give the same scores up to rounding; they are kept side by side as the proof.
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
    /// Whether this method can end where the effort says: the others score every label, however long it takes.
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

/// A failed scoring.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScoreError {
    /// The model failed.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A label without words.
    #[error("label {index} ({label:?}) has no tokens: give it words, or remove it from the map")]
    EmptyLabel {
        /// Its index.
        index: usize,
        /// Its text.
        label: String,
    },
    /// No label at all.
    #[error("there is no label to score: the map has no items, and room names are switched off")]
    NoLabels,
}

/// The labels of a map, cut into tokens behind one binding sequence: built once, used for every event.
#[derive(Debug, Clone)]
pub struct PreparedLabels {
    labels: Vec<String>,
    tokens: Vec<Vec<Token>>,
    /// Of all tokens, or under [`Continuation::Labels`] of those that tell the labels apart.
    trie: LabelTrie,
    /// Inner nodes of the trie, for [`Method::Trie`].
    inner_tree: TokenTree,
    /// One chain per label, for [`Method::SharedPrefix`].
    chains: LabelTrie,
    chain_tree: TokenTree,
    /// Per node of the chains its node in the trie.
    chain_nodes: Vec<usize>,
    /// Tokens at the end of the prompt that labels replace, because a merge crosses the boundary; nearly always 0.
    replaced: usize,
    binding: BindingSequence,
    tokenisation: Tokenisation,
    correction: Correction,
    /// Per label `ln g_c` of the prior, in nats.
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

    /// Tokens of the longest label.
    #[must_use]
    pub(crate) fn longest_label(&self) -> usize {
        self.tokens.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// The binding sequence that the labels stand behind.
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

    /// Per label `ln g_c` of the prior, in nats, the greatest 0; zeros without one.
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
    /// Per label `ln s_c` in nats: Equation 1, corrected.
    pub log_prob_nats: Vec<f64>,
    /// Tokens of the prompt.
    pub prompt_tokens: usize,
    /// `ln k` of the prior in nats: with a label's gain, what was added to the sum over its tokens.
    pub scale_nats: f64,
    /// What was decoded.
    pub stats: DecodeStats,
    /// Nanoseconds spent cutting the prompt into tokens.
    pub tokenise_ns: u64,
    /// Nanoseconds in decoder calls that held the prompt.
    pub prefix_ns: u64,
    /// Nanoseconds in what came after them: the rest of the trie, and the walk over it.
    pub trie_ns: u64,
    /// The method that was used: [`Method::Independent`] where the model cannot share a prefix.
    pub method: Method,
}

/// The scoring algorithm over a model; owns every buffer that an event needs.
#[derive(Debug)]
pub struct Scorer<M> {
    model: M,
    /// A row of logits without a node's children, where a label ends at the node.
    without_children: Vec<f32>,
    rows: Rows,
    /// The last prompt's tokens, without those that labels replace.
    prompt: Vec<Token>,
    /// How many of the last prompt's tokens the next one will begin with, as far as is known: all but the binding sequence.
    kept_tokens: usize,
    cutter: Cutter,
    /// Per trie node `ln p(token | path to its parent)`, then `ln q(n)`, of the last [`Scorer::score`] by [`Method::Trie`].
    node_log_prob_nats: Vec<f64>,
}

impl<M: LanguageModel> Scorer<M> {
    /// A scorer over a model.
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

    /// What the model says of itself.
    pub fn info(&self) -> &ModelInfo {
        self.model.info()
    }

    /// The model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Has `moved` called after each call of the decoder.
    pub fn watch(&mut self, moved: Progress) {
        self.model.watch(moved);
    }

    /// Takes memory for prompts and labels of so many tokens together ([`LanguageModel::reserve`]).
    ///
    /// # Errors
    /// When there is no memory for it.
    pub fn reserve(&mut self, positions: usize) -> Result<(), ScoreError> {
        Ok(self.model.reserve(positions)?)
    }

    /// Forgets the kept prefix, as a fresh scorer would start.
    pub fn forget(&mut self) {
        self.model.forget();
    }

    /// Work that can wait until no event does.
    pub fn tidy(&mut self) {
        self.model.tidy(self.kept_tokens);
    }

    /// Cuts labels into tokens behind a binding sequence, and builds their trie.
    ///
    /// Under [`Tokenisation::Joint`] a label's tokens are what binding sequence and label have together beyond the
    /// binding sequence by itself. Where a merge crosses the boundary for any label, the crossing tokens of the binding
    /// sequence are scored with every label, so that all remain comparable.
    ///
    /// Every label gains alike: [`Scorer::prepare`] also learns the prior.
    ///
    /// # Errors
    /// When there is no label, a label has no tokens, or the tokeniser fails.
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
        })
    }

    /// Learns the labels' gains from a blank narration, where there is a prior; the kept prefix is lost then.
    ///
    /// # Errors
    /// When the model fails.
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

    /// [`Scorer::cut`], then the prior of the labels: all that is done once for a map, a binding sequence and a model.
    ///
    /// # Errors
    /// As those two.
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

    /// Scores every label behind `prompt`, the text that [`crate::prompt::write_prompt`] wrote for the same binding
    /// sequence (with its trailing space under [`Tokenisation::Paper`]).
    ///
    /// A model that cannot share a prefix is scored by [`Method::Independent`], and `out` says so.
    ///
    /// # Errors
    /// When the prompt does not fit or the model fails; `out` is not to be used then.
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

    /// Exchanges what [`Scorer::token_log_prob_nats`] explains of the last score for that of another scorer.
    pub(crate) fn exchange_nodes(&mut self, nodes: &mut Vec<f64>) {
        std::mem::swap(&mut self.node_log_prob_nats, nodes);
    }

    /// What a sentence costs in a window.
    pub(crate) fn cost_of(&mut self, sentence: &str) -> usize {
        match self.sentence_tokens(sentence) {
            Ok(tokens) => tokens + 1,
            // A safe bound; scoring will name the failure.
            Err(_) => sentence.len(),
        }
    }

    /// How many tokens `sentence` has within a prompt. It is cut once: the prompt that it becomes part of finds its tokens.
    ///
    /// # Errors
    /// When the tokeniser fails.
    pub fn sentence_tokens(&mut self, sentence: &str) -> Result<usize, ScoreError> {
        self.cutter.cut_narration(&self.model, sentence, &mut self.prompt)?;
        Ok(self.prompt.len())
    }

    fn cut_prompt(&mut self, prompt: &str) -> Result<(), ScoreError> {
        Ok(self.cutter.cut_prompt(&self.model, prompt, &mut self.prompt)?)
    }

    /// Cuts the prompt into tokens and clears `out`.
    fn begin(
        &mut self,
        prepared: &PreparedLabels,
        prompt: &str,
        method: Method,
        out: &mut LabelScores,
    ) -> Result<(), ScoreError> {
        self.cut_prompt(prompt)?;
        out.prompt_tokens = self.prompt.len();
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

    /// Per token of a label ln p(token | prompt and the tokens before it), in nats, of the last [`Scorer::score`]; the last one's with
    /// that of the label's ending there, where another goes on. None unless that was by [`Method::Trie`], which alone keeps them.
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

    /// Scores behind `prompt` as far as the question needs, by [`Method::Trie`]: the prompt and a guess at the nodes that
    /// matter go in one call, the rest follows only while `state.bounds` do not answer `effort`'s question, and, under
    /// [`Effort::Deadline`], while the next call would end before `deadline` (as the last ones suggest).
    ///
    /// `out.log_prob_nats` is exact for decided labels, but for the scale of a prior, which is common to all, and an estimate within the
    /// bounds for the others. A model that cannot share a prefix is scored exactly.
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
            if let Err(error) = self.rows.check(bad_row) {
                self.model.forget();
                return Err(error.into());
            }
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

    /// Reads a small part of a prompt ahead, so that the next one that begins with it decodes only the rest. Gives whether all of it is read.
    ///
    /// # Errors
    /// When it does not fit or the model fails.
    pub(crate) fn read_ahead(&mut self, prompt: &str) -> Result<bool, ScoreError> {
        self.cut_prompt(prompt)?;
        self.kept_tokens = self.prompt.len();
        if self.prompt.is_empty() || !self.model.info().shares_prefix {
            return Ok(true);
        }
        Ok(self.model.read(&self.prompt)?)
    }

    /// Scores the labels of one trie behind `self.prompt`, and appends them to `out`. `places` gives the place of the trie's nodes in
    /// that of `prepared`; without it, they are the same.
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
        if let Err(error) = self.rows.check(bad_row) {
            self.model.forget();
            return Err(error.into());
        }
        let decoded = now();
        // Parents stand before their children, so one pass turns conditional probabilities into q(n).
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

/// Which rows of logits a call of [`LanguageModel::decode`] was asked for, and which came: whoever brings a model may forget one.
#[derive(Debug, Default)]
struct Rows {
    /// Row 0 follows the prompt.
    came: Vec<bool>,
    given: usize,
    /// One came that nobody asked for.
    is_beyond: bool,
}

impl Rows {
    fn ask(&mut self, nodes: usize, with_prompt: bool) {
        self.came.clear();
        self.came.resize(1 + nodes, false);
        self.came[0] = !with_prompt;
        (self.given, self.is_beyond) = (usize::from(!with_prompt), false);
    }

    /// Takes note of a row; whether it was asked for.
    fn take(&mut self, row: usize) -> bool {
        let Some(came) = self.came.get_mut(row) else {
            self.is_beyond = true;
            return false;
        };
        self.given += usize::from(!std::mem::replace(came, true));
        true
    }

    /// Whether all came and none beside them, and none of them was bad.
    fn check(&self, bad_row: Option<usize>) -> Result<(), ModelError> {
        let asked = self.came.len();
        match bad_row {
            Some(row) => Err(ModelError::NotFinite { at: row_name(row) }),
            None if self.given < asked || self.is_beyond => Err(ModelError::Rows { given: self.given, asked }),
            None => Ok(()),
        }
    }
}

/// Gives `ln p(child | path)` of every child of `parent` (the trie's roots for `None`) from the row of logits that follows
/// it. With `rivals`, the node's children in the trie of all labels, only they share the probability out, and, where a label ends at
/// the node, all that is none of them: `without_children` holds the row without them then. False when what was needed of the row is not
/// finite; minus infinity is a probability of zero.
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
                // No label is possible here: none is likelier than another.
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

/// Length of what two token sequences begin with in common.
#[must_use]
pub fn common_prefix(a: &[Token], b: &[Token]) -> usize {
    a.iter().zip(b).take_while(|(a, b)| a == b).count()
}
