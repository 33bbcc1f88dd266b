//! llama.cpp as a [`LanguageModel`].
//!
//! **The prefix stays.** After a call the cache holds the prompt on every sequence in use. The next call removes only the difference and
//! decodes only the rest.
//!
//! **Other prefixes too.** A window loses its oldest sentences at once, and then nearly all of its tokens have other positions. So the
//! next window is decoded in small parts before, and its cells wait outside the context ([`LanguageModel::read_part`]). Persons who act in
//! turn have their prefixes there, too.
//!
//! **One batch.** New prompt tokens and the tree behind them go to the decoder in one call. A token carries the ids of all paths through
//! it, and a prompt token the ids of all paths, which needs the unified cache. Trees with more paths than sequences go in several calls.

use std::cell::RefCell;
use std::io::Read;
use std::num::NonZeroU32;
use std::path::Path;
use std::sync::{Arc, LazyLock};
use std::time::Instant;

use llama_cpp_2::context::LlamaContext;
use llama_cpp_2::context::params::LlamaContextParams;
use llama_cpp_2::context::session::{LlamaStateSeqFlags, SeqState};
use llama_cpp_2::llama_batch::LlamaBatch;
use llama_cpp_2::model::LlamaModel as Weights;
use llama_cpp_2::model::params::LlamaModelParams;
use llama_cpp_2::token::LlamaToken;
use llama_cpp_2::token_type::LlamaTokenAttr;
use llama_cpp_2::vocab::LlamaVocab;
use rustix::process::{Resource, getrlimit};
use sha2::{Digest, Sha256};

use roomcast_core::label_trie::TokenTree;
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{
    Clock, DecodeStats, IsStopped, LanguageModel, ModelError, ModelInfo, Progress, TextStart, Token, TokenCounter,
    common_prefix,
};

use crate::backend::backend;
use crate::gguf::{Header, open_plain};
use crate::options::{BLOCK, CacheType, LlamaOptions, SEQUENCES_MAX, broken_blocks};
use crate::pieces::Pieces;

/// Tokens times parameters of a call in the background. A new event waits for its end, or shares the memory with it. A core of some years
/// ago takes 20 to 60 ms for it. A call reads all weights, so smaller calls take more time in all.
const SMALL_CALL: u64 = 2_000_000_000;
/// Most tokens of such a call: llama.cpp allocates memory for them.
const SMALL_CALL_TOKENS: usize = 64;

/// llama.cpp rounds the positions of a context up to a multiple of this.
const POSITIONS_STEP: u32 = 256;

/// Most prefixes outside the context: two for each of four persons. One of the embedded model takes about half a megabyte.
const STORED_MAX: usize = 8;

/// Tokens that llama.cpp computes at a time. Its buffers have a row of logits for each, and most events are shorter.
const TOKENS_AT_A_TIME: u32 = 128;

self_cell::self_cell!(
    /// A context borrows its weights, so both move together. Another thread that counts tokens shares the weights.
    struct Loaded {
        owner: Arc<Weights>,
        #[not_covariant]
        dependent: MaybeContext,
    }
);

/// `None` until the first [`LanguageModel::reserve`]: only then the needed size is known.
type MaybeContext<'a> = Option<LlamaContext<'a>>;

/// A model that llama.cpp runs.
pub struct LlamaModel {
    loaded: Loaded,
    batch: LlamaBatch<'static>,
    batch_tokens: usize,
    info: ModelInfo,
    options: LlamaOptions,
    /// Positions of the context, 0 without one.
    positions: u32,
    small_tokens: usize,
    /// Set on the prefetcher's copy.
    is_stopped: Option<IsStopped>,
    moved: Option<Progress>,
    add_start_token: bool,
    start_token: Token,
    /// `None` if sentences cannot be cut one by one.
    pieces: Option<Arc<Pieces>>,
    sequences: u32,
    /// The prompt in the cache.
    kept: Vec<Token>,
    /// Sequences `0..kept_sequences` hold it.
    kept_sequences: u32,
    /// Whether the cache holds a tree beyond `kept`.
    untidy: bool,
    /// Prefixes outside the context, with their cells: the oldest first.
    stored: Vec<(Vec<Token>, SeqState)>,
    sequence_ids: Vec<i32>,
    rows: Vec<(i32, usize)>,
    /// Working memory of the tokeniser.
    tokens: RefCell<Vec<LlamaToken>>,
}

impl std::fmt::Debug for LlamaModel {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LlamaModel").field("info", &self.info).field("kept", &self.kept.len()).finish_non_exhaustive()
    }
}

/// SHA-256 of a file.
///
/// # Errors
/// When it cannot be read, or is no plain file.
pub fn file_sha256(path: &Path) -> std::io::Result<[u8; 32]> {
    let mut file = open_plain(path)?;
    let mut hash = Sha256::new();
    let mut block = vec![0; 1 << 20];
    loop {
        match file.read(&mut block)? {
            0 => return Ok(hash.finalize().into()),
            count => hash.update(&block[..count]),
        }
    }
}

/// Whether texts may be tokenised sentence by sentence with this SentencePiece vocabulary. It merges two neighbours only to a token that it
/// has, best score first. So it merges nothing across the end of a sentence and a space if no token contains both. User-defined tokens
/// follow other rules, and NaN scores have no order.
fn sentences_apart(vocabulary: &LlamaVocab<'_>) -> bool {
    let cut = |text: &str| vocabulary.tokenize(text.as_bytes(), false, false);
    let joins = |token| {
        let own = vocabulary.attr(token).contains(LlamaTokenAttr::UserDefined);
        own || vocabulary.score(token).is_nan()
            || vocabulary.text(token).is_none_or(|text| {
                let text = text.to_string_lossy();
                [".\u{2581}", "!\u{2581}", "?\u{2581}"].iter().any(|both| text.contains(both))
            })
    };
    // If the vocabulary does not put a space before every text, a sentence alone differs from one after a space.
    [cut("a."), cut("a")].concat() == cut("a. a") && !vocabulary.tokens().any(joins)
}

fn sized(options: &LlamaOptions, trained_tokens: u32, positions: u32, batch_tokens: u32) -> LlamaContextParams {
    let parameters = options.context_parameters(trained_tokens).with_n_ctx(NonZeroU32::new(positions));
    // One more for prefixes of later prompts.
    let sequences = options.sequences.saturating_add(1).clamp(1, SEQUENCES_MAX);
    // llama.cpp aborts if a batch has fewer tokens than there are sequences.
    let parameters = parameters.with_n_seq_max(sequences).with_n_batch(batch_tokens.max(sequences));
    parameters.with_n_ubatch(batch_tokens.min(TOKENS_AT_A_TIME))
}

/// Tokens of a [`SMALL_CALL`], at most `most`. llama.cpp multiplies by fours.
fn small_tokens(parameters: u64, most: usize) -> usize {
    let tokens = usize::try_from(SMALL_CALL / parameters.max(1)).unwrap_or(usize::MAX);
    let tokens = if tokens >= 4 { tokens / 4 * 4 } else { tokens.max(1) };
    tokens.min(most)
}

/// What is known of a loaded model.
fn info_of(
    weights: &Weights,
    path: &Path,
    header: &Header,
    fingerprint: [u8; 32],
    context_tokens: u32,
) -> Result<ModelInfo, String> {
    let text = |key: &str| weights.meta_val_str(key).ok();
    Ok(ModelInfo {
        name: text("general.name")
            .filter(|n| !n.is_empty())
            .or_else(|| path.file_stem().map(|s| s.to_string_lossy().into_owned()))
            .unwrap_or_default(),
        architecture: text("general.architecture").unwrap_or_else(|| "unknown".into()),
        description: format!(
            "{} {:.1}M parameters, {:.1} MB",
            text("general.size_label").unwrap_or_default(),
            weights.n_params() as f64 / 1e6,
            weights.size() as f64 / 1e6
        )
        .trim()
        .to_owned(),
        parameters: weights.n_params(),
        size_bytes: weights.size(),
        vocabulary: usize::try_from(weights.vocab().n_tokens()).unwrap_or(0),
        context_tokens: context_tokens as usize,
        shares_prefix: !weights.is_recurrent() && !weights.is_hybrid(),
        correction: Correction::recommended(|key| header.written(key))?,
        weakness: None,
        fingerprint,
    })
}

impl LlamaModel {
    /// Loads a GGUF file.
    ///
    /// # Errors
    /// When the file is missing, damaged, or of a kind that llama.cpp cannot run.
    pub fn load(path: &Path, options: &LlamaOptions) -> Result<Self, ModelError> {
        let fail = |reason: String| ModelError::Load { path: path.display().to_string(), reason };
        // llama.cpp may abort on a damaged file and end the service.
        let header = Header::read_language_model(path).map_err(|fault| ModelError::File(Box::new(fault)))?;
        if options.cache == CacheType::Q8
            && let Some(width) = broken_blocks(&header)
        {
            return Err(fail(format!(
                "its heads of {width} numbers are not whole blocks of {BLOCK}, as a \"q8\" key-value cache stores them: choose \"mixed\""
            )));
        }
        let fingerprint = file_sha256(path).map_err(|e| fail(e.to_string()))?;
        let backend = backend().map_err(fail)?;
        // The file is read, not mapped. If a mapped file is truncated while it is in use, this process ends (SIGBUS).
        let parameters = LlamaModelParams::default().with_use_mmap(false).with_use_mlock(options.lock_memory);
        let weights = Weights::load_from_file(backend, path, &parameters);
        // llama.cpp does not report a lack of memory.
        let weights = weights.map_err(|error| match getrlimit(Resource::As).current {
            Some(limit) => fail(format!(
                "{error}; it takes {} bytes, and this process may have {limit} bytes of address space: raise the limit (ulimit -v, LimitAS=)",
                header.size_bytes
            )),
            None => fail(error.to_string()),
        })?;
        let text = |key: &str| weights.meta_val_str(key).ok();
        let options = &LlamaOptions { cache: options.cache.chosen(&header, weights.n_params()), ..options.clone() };
        let context_tokens = options.positions(weights.n_ctx_train());
        let sequences = options.sequences.clamp(1, SEQUENCES_MAX);
        let vocabulary = weights.vocab();
        let info = info_of(&weights, path, &header, fingerprint, context_tokens).map_err(fail)?;
        let is_apart = text("tokenizer.ggml.model").as_deref() == Some("llama") && sentences_apart(&vocabulary);
        let piece = |token| Some((vocabulary.text(token)?.to_str().ok()?, Token(token.0), vocabulary.score(token)));
        let pieces = is_apart.then(|| Arc::new(Pieces::new(vocabulary.tokens().filter_map(piece))));
        let add_start_token = vocabulary.should_add_bos();
        let start_token = Token(vocabulary.bos().0);
        let batch_tokens = options.context_parameters(weights.n_ctx_train()).n_batch();
        let small_tokens = small_tokens(weights.n_params(), SMALL_CALL_TOKENS.min(batch_tokens as usize));
        Ok(Self {
            loaded: Loaded::new(Arc::new(weights), |_| None),
            batch: LlamaBatch::new(batch_tokens as usize, sequences.cast_signed()),
            batch_tokens: batch_tokens as usize,
            info,
            options: options.clone(),
            positions: 0,
            small_tokens,
            is_stopped: None,
            moved: None,
            add_start_token,
            start_token,
            pieces,
            sequences,
            kept: Vec::new(),
            kept_sequences: 1,
            untidy: false,
            stored: Vec::new(),
            sequence_ids: Vec::new(),
            rows: Vec::new(),
            tokens: RefCell::new(Vec::with_capacity(context_tokens as usize)),
        })
    }

    /// This model, known to be weak for a reason, or usable ([`ModelInfo::weakness`]).
    #[must_use]
    pub fn judged(mut self, weakness: Option<String>) -> Self {
        self.info.weakness = weakness;
        self
    }

    /// The model's options, with the chosen cache in place of `Auto`.
    #[must_use]
    pub fn options(&self) -> &LlamaOptions {
        &self.options
    }

    /// Positions that have memory, at most the context's limit.
    #[must_use]
    pub fn positions(&self) -> u32 {
        self.positions
    }

    fn with_context<T>(&mut self, run: impl FnOnce(&mut LlamaContext<'_>) -> T) -> Option<T> {
        self.loaded.with_dependent_mut(|_, context| context.as_mut().map(run))
    }

    /// Removes all positions from `position` on from every sequence.
    fn truncate_cache(&mut self, position: usize) -> Result<(), ModelError> {
        let from = u32::try_from(position).unwrap_or(u32::MAX);
        let removed = self.with_context(|c| c.clear_kv_cache_seq(None, Some(from), None));
        match removed {
            None | Some(Ok(true)) => Ok(()),
            Some(Ok(false) | Err(_)) => {
                Err(self.decode_error(0, format!("positions from {position} on cannot be removed from its cache")))
            }
        }
    }

    /// Empties the cache, which is then consistent again, and returns the error.
    fn decode_error(&mut self, tokens: usize, reason: String) -> ModelError {
        self.forget();
        ModelError::Decode { tokens, reason }
    }

    /// The place of the prefix in `stored` that shares most tokens with `prompt`, and how many.
    fn nearest_stored(&self, prompt: &[Token]) -> Option<(usize, usize)> {
        let shared = self.stored.iter().map(|(tokens, _)| common_prefix(tokens, prompt)).enumerate();
        shared.max_by_key(|&(_, shared)| shared)
    }

    /// Makes a prefix of `stored` the kept one, if `prompt` shares more tokens with it.
    fn fetch_stored(&mut self, prompt: &[Token]) -> Result<(), ModelError> {
        let Some((place, shared)) = self.nearest_stored(prompt) else { return Ok(()) };
        if shared <= common_prefix(&self.kept, prompt) {
            return Ok(());
        }
        let (tokens, state) = self.stored.remove(place);
        self.truncate_cache(0)?;
        self.kept.clear();
        (self.kept_sequences, self.untidy) = (1, false);
        if let Some(set) = self.with_context(|context| context.state_seq_set(&state, 0)) {
            set.map_err(|error| self.decode_error(0, error.to_string()))?;
            // Without the loss of its memory.
            self.kept.extend(tokens);
        }
        Ok(())
    }

    /// Sends the batch to the decoder and passes its rows to `visit`.
    fn flush(&mut self, stats: &mut DecodeStats, visit: &mut dyn FnMut(usize, &[f32])) -> Result<(), ModelError> {
        let tokens = self.batch.n_tokens();
        if tokens == 0 {
            return Ok(());
        }
        if self.is_stopped.as_ref().is_some_and(|is_stopped| is_stopped()) {
            self.batch.clear();
            self.rows.clear();
            // Earlier calls may have decoded positions beyond `kept`.
            self.untidy = true;
            return Err(ModelError::Stopped);
        }
        let (batch, rows) = (&mut self.batch, &self.rows);
        let start = Instant::now();
        let result = self.loaded.with_dependent_mut(|_, context| {
            let Some(context) = context else { return Err("it has no context".to_owned()) };
            context.decode(batch).map_err(|error| error.to_string())?;
            stats.decoder_ns += u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
            for &(position, row) in rows {
                visit(row, context.get_logits_ith(position));
            }
            Ok(())
        });
        self.batch.clear();
        self.rows.clear();
        stats.calls += 1;
        if let Some(moved) = &self.moved {
            moved();
        }
        result.map_err(|reason| self.decode_error(usize::try_from(tokens).unwrap_or(0), reason))
    }

    fn push(
        &mut self,
        token: Token,
        position: usize,
        sequences: std::ops::Range<u32>,
        row: Option<usize>,
        stats: &mut DecodeStats,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<(), ModelError> {
        if self.batch.n_tokens() as usize >= self.batch_tokens {
            self.flush(stats, visit)?;
        }
        self.sequence_ids.clear();
        // The batch was created for `sequences` ids a token, and does not check.
        self.sequence_ids.extend(sequences.take(self.sequences as usize).map(u32::cast_signed));
        if let Some(row) = row {
            self.rows.push((self.batch.n_tokens(), row));
        }
        let position = i32::try_from(position).unwrap_or(i32::MAX);
        self.batch
            .add(LlamaToken(token.0), position, &self.sequence_ids, row.is_some())
            .map_err(|e| ModelError::Decode { tokens: 1, reason: e.to_string() })
    }

    /// Decodes a tree behind a prompt, as many paths at once as there are sequences.
    fn push_tree(
        &mut self,
        prompt_tokens: usize,
        tree: &TokenTree,
        wave_paths: u32,
        stats: &mut DecodeStats,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<(), ModelError> {
        let room = self.positions as usize - prompt_tokens;
        let mut wave = 0;
        while wave < tree.path_count() {
            let end = (wave + wave_paths).min(tree.path_count());
            let mut in_wave = 0;
            for index in 0..tree.len() {
                let (first, last) = tree.paths(index);
                let (first, last) = (first.max(wave), last.min(end));
                if first >= last {
                    continue;
                }
                in_wave += 1;
                if in_wave > room {
                    self.forget();
                    return Err(ModelError::TooLong {
                        prompt: prompt_tokens,
                        tree: tree.len(),
                        context: self.info.context_tokens,
                    });
                }
                let position = prompt_tokens + tree.depth(index) as usize - 1;
                self.untidy = true;
                self.push(tree.token(index), position, first - wave..last - wave, Some(index + 1), stats, visit)?;
                stats.tree_tokens_decoded += 1;
            }
            wave = end;
            if wave < tree.path_count() {
                self.flush(stats, visit)?;
                self.truncate_cache(prompt_tokens)?;
            }
        }
        Ok(())
    }
}

impl LanguageModel for LlamaModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn clock(&self) -> Clock {
        static START: LazyLock<Instant> = LazyLock::new(Instant::now);
        || u64::try_from(START.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    fn tokenise(&self, text: &str, start: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
        if start == TextStart::Sequence && self.add_start_token && self.start_token.0 >= 0 {
            out.push(self.start_token);
        }
        if self.pieces.as_ref().is_some_and(|pieces| pieces.cut(text, out)) {
            return Ok(());
        }
        let mut tokens = self.tokens.borrow_mut();
        tokens.clear();
        self.loaded.borrow_owner().vocab().tokenize_into(text.as_bytes(), &mut tokens, false, false);
        out.extend(tokens.iter().map(|t| Token(t.0)));
        Ok(())
    }

    fn sentences_apart(&self) -> bool {
        self.pieces.is_some()
    }

    fn token_counter(&self) -> TokenCounter {
        let weights = Arc::clone(self.loaded.borrow_owner());
        Arc::new(move |text| weights.vocab().tokenize(text.as_bytes(), false, false).len())
    }

    fn token_text(&self, token: Token) -> String {
        let bytes = self.loaded.borrow_owner().vocab().token_to_piece(LlamaToken(token.0), true, None);
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn forget(&mut self) {
        self.stored.clear();
        self.batch.clear();
        self.rows.clear();
        self.with_context(|context| context.clear_kv_cache());
        self.kept.clear();
        self.kept_sequences = 1;
        self.untidy = false;
    }

    fn reserve(&mut self, positions: usize) -> Result<(), ModelError> {
        let most = u32::try_from(self.info.context_tokens).unwrap_or(u32::MAX);
        let positions = u32::try_from(positions).unwrap_or(most).clamp(1, most);
        let positions = positions.div_ceil(POSITIONS_STEP).saturating_mul(POSITIONS_STEP).min(most);
        if positions == self.positions {
            return Ok(());
        }
        let fail = |reason| ModelError::Context { model: self.info.name.clone(), context_tokens: positions, reason };
        let backend = backend().map_err(fail)?;
        let trained_tokens = self.loaded.borrow_owner().n_ctx_train();
        let batch_tokens = u32::try_from(self.batch_tokens).unwrap_or(u32::MAX);
        let parameters = sized(&self.options, trained_tokens, positions, batch_tokens);
        // First the old one goes, so that memory never holds both.
        let made = self.loaded.with_dependent_mut(|weights, context| {
            *context = None;
            *context = Some(weights.new_context(backend, parameters)?);
            Ok::<(), llama_cpp_2::LlamaContextLoadError>(())
        });
        self.positions = if made.is_ok() { positions } else { 0 };
        let made = made.map_err(|error| fail(error.to_string()));
        self.forget();
        made
    }

    fn read(&mut self, prompt: &[Token]) -> Result<bool, ModelError> {
        let until = prompt.len().min(common_prefix(&self.kept, prompt) + self.small_tokens);
        self.decode(&prompt[..until], &TokenTree::default(), false, &mut |_, _| {})?;
        Ok(until == prompt.len())
    }

    fn read_part(&mut self, prompt: &[Token], calls: usize) -> Result<bool, ModelError> {
        let extra = self.sequences;
        let most = self.kept.len() + prompt.len();
        if !self.info.shares_prefix || extra >= SEQUENCES_MAX || most > self.info.context_tokens {
            return Ok(true);
        }
        if most > self.positions as usize {
            self.reserve(most)?;
        }
        let nearest = self.nearest_stored(prompt);
        let shared = nearest.map_or(0, |(_, shared)| shared);
        if shared == prompt.len() {
            return Ok(true);
        }
        if self.untidy {
            self.truncate_cache(self.kept.len())?;
            self.untidy = false;
        }
        let shared_kept = common_prefix(&self.kept, prompt);
        let from = shared.max(shared_kept);
        // llama.cpp multiplies by fours.
        let part = (prompt.len() - from).div_ceil(calls.max(1)).next_multiple_of(4).min(self.small_tokens);
        let until = prompt.len().min(from + part);
        let stored = nearest.filter(|_| shared > shared_kept).map(|(place, _)| &self.stored[place].1);
        let id = extra.cast_signed();
        let filled = self.loaded.with_dependent_mut(|_, context| {
            let Some(context) = context else { return Ok(()) };
            let from = u32::try_from(from).ok();
            match stored {
                Some(state) => {
                    context.state_seq_set(state, id).map_err(|error| error.to_string())?;
                    context.clear_kv_cache_seq(Some(extra), from, None).map(drop).map_err(|error| error.to_string())
                }
                None if shared_kept > 0 => {
                    context.copy_kv_cache_seq(0, id, Some(0), from).map_err(|error| error.to_string())
                }
                None => Ok(()),
            }
        });
        filled.map_err(|reason| self.decode_error(0, reason))?;
        let (mut stats, mut none) = (DecodeStats::default(), |_: usize, _: &[f32]| {});
        for (position, &token) in prompt.iter().enumerate().take(until).skip(from) {
            self.push(token, position, extra..extra + 1, None, &mut stats, &mut none)?;
        }
        self.flush(&mut stats, &mut none)?;
        let state = self.with_context(|context| {
            let state = context.state_seq_get(id, LlamaStateSeqFlags::empty()).map_err(|error| error.to_string())?;
            context.clear_kv_cache_seq(Some(extra), None, None).map_err(|error| error.to_string())?;
            Ok(state)
        });
        let Some(state) = state.transpose().map_err(|reason: String| self.decode_error(0, reason))? else {
            return Ok(true);
        };
        match nearest {
            // The former part of the same prompt.
            Some((place, shared)) if shared == self.stored[place].0.len() => drop(self.stored.remove(place)),
            _ if self.stored.len() >= STORED_MAX => drop(self.stored.remove(0)),
            _ => {}
        }
        self.stored.push((prompt[..until].to_vec(), state));
        Ok(until == prompt.len())
    }

    fn twin(&self, is_stopped: IsStopped) -> Result<Option<Self>, ModelError> {
        // With several threads, OpenMP would have more of them than there are cores, and put waiting threads to sleep.
        let options = LlamaOptions { threads: 1, ..self.options.clone() };
        let mut twin = Self {
            loaded: Loaded::new(Arc::clone(self.loaded.borrow_owner()), |_| None),
            positions: 0,
            batch: LlamaBatch::new(self.small_tokens, self.sequences.cast_signed()),
            batch_tokens: self.small_tokens,
            info: self.info.clone(),
            pieces: self.pieces.clone(),
            options,
            is_stopped: Some(is_stopped),
            moved: None,
            kept: Vec::new(),
            kept_sequences: 1,
            untidy: false,
            stored: Vec::new(),
            sequence_ids: Vec::new(),
            rows: Vec::new(),
            tokens: RefCell::new(Vec::new()),
            ..*self
        };
        twin.reserve(self.positions as usize)?;
        Ok(Some(twin))
    }

    fn watch(&mut self, moved: Progress) {
        self.moved = Some(moved);
    }

    fn tidy(&mut self, keep: usize) {
        if self.untidy || keep < self.kept.len() {
            self.untidy = false;
            self.kept.truncate(keep);
            // A failure empties the cache, which only costs time at the next event.
            let _ = self.truncate_cache(self.kept.len());
        }
    }

    fn decode(
        &mut self,
        prompt: &[Token],
        tree: &TokenTree,
        want_prompt_row: bool,
        visit: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<DecodeStats, ModelError> {
        let mut stats = DecodeStats::default();
        let context = self.info.context_tokens;
        if prompt.is_empty() {
            return Err(ModelError::EmptyPrompt);
        }
        let deepest = (0..tree.len()).map(|i| tree.depth(i)).max().unwrap_or(0) as usize;
        if prompt.len() + deepest > context || prompt.len() >= context {
            return Err(ModelError::TooLong { prompt: prompt.len(), tree: deepest, context });
        }
        let needed = (prompt.len() + tree.len()).min(context);
        if needed > self.positions as usize {
            self.reserve(needed)?;
        }
        if !self.info.shares_prefix {
            self.forget();
        }
        self.fetch_stored(prompt)?;
        // The last prompt token is decoded again if its logits are asked for.
        let keep = common_prefix(&self.kept, prompt).min(prompt.len() - usize::from(want_prompt_row));
        if self.untidy || keep < self.kept.len() {
            self.truncate_cache(keep)?;
            self.kept.truncate(keep);
            self.untidy = false;
        }
        if keep == 0 {
            self.kept_sequences = 1;
        }
        let wave_paths = tree.path_count().clamp(1, self.sequences);
        if wave_paths > self.kept_sequences {
            let (from, to) = (self.kept_sequences, wave_paths);
            let copied =
                self.with_context(|c| (from..to).try_for_each(|s| c.copy_kv_cache_seq(0, s.cast_signed(), None, None)));
            if keep > 0 {
                copied.transpose().map_err(|e| self.decode_error(0, e.to_string()))?;
            }
            self.kept_sequences = wave_paths;
        }
        let all = 0..self.kept_sequences;
        for (position, &token) in prompt.iter().enumerate().skip(keep) {
            let row = (want_prompt_row && position + 1 == prompt.len()).then_some(0);
            self.push(token, position, all.clone(), row, &mut stats, visit)?;
        }
        stats.prompt_tokens_decoded = (prompt.len() - keep) as u32;
        self.push_tree(prompt.len(), tree, wave_paths, &mut stats, visit)?;
        self.flush(&mut stats, visit)?;
        self.kept.truncate(keep);
        self.kept.extend_from_slice(&prompt[keep..]);
        Ok(stats)
    }
}
