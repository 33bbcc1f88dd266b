//! Scores of labels as continuations of a prompt (the paper's Equation 1).
//!
//! `s_c,i = prod_j p(c_i^j | N_h + B + c_i^(1..j-1))`, over all tokens `j` of label `i`, in nats as a sum of logarithms; corrected on request
//! ([`correction`]).
//!
//! [`Scorer`] holds the algorithm, [`LanguageModel`] is its interface to a model. The crate `roomcast-llama` has the real model;
//! [`table::TableModel`] is a deterministic one with a known next-token table, for tests.

use self::certified::{Certified, Effort};
use self::correction::{Continuation, Correction};
use self::cutter::Cutter;
use self::familiarity::Familiarity;
pub use self::language_model::{
    Clock, DecodeStats, IsStopped, LanguageModel, ModelError, ModelInfo, Progress, TextStart, TokenCounter,
};
use self::rows::{Rows, read_row};
pub use crate::label_trie::Token;
use crate::label_trie::{LabelTrie, Node, PROMPT, TokenTree};
use crate::prompt::{BindingSequence, write_prompt};

pub mod certified;
pub mod correction;
pub mod cutter;
pub mod familiarity;
mod language_model;
mod rows;
pub mod softmax;
pub mod table;

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
        self.cutter.cut_narration(&self.model, sentence, TextStart::Within, &mut self.prompt)?;
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
        self.cutter.cut_narration(&self.model, prompt, TextStart::Sequence, &mut self.prompt)?;
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

/// Length of the common prefix of two token sequences.
#[must_use]
pub fn common_prefix(a: &[Token], b: &[Token]) -> usize {
    a.iter().zip(b).take_while(|(a, b)| a == b).count()
}
