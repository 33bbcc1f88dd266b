//! Options of a model: threads, positions, and how the key-value cache is stored.

use std::num::NonZeroU32;

use llama_cpp_2::context::params::{KvCacheType, LlamaContextParams};

use crate::gguf::Header;

/// llama.cpp's own limit on sequences in a context (LLAMA_MAX_SEQ).
pub const SEQUENCES_MAX: u32 = 256;
/// Most threads of one decoder call; with more, llama.cpp accesses memory out of bounds.
pub const THREADS_MAX: usize = 256;

/// Most parameters of a model for which [`CacheType::Auto`] is [`CacheType::Q8`]: with 11 million it takes less time than `mixed`, with 135 million more.
const Q8_PARAMETERS_MAX: u64 = 50_000_000;
roomcast_core::choices! {
    /// How the key-value cache is stored.
    #[derive(Default)]
    pub enum CacheType {
        /// `q8` for models of at most 50 million parameters, such as the embedded one, else `mixed` (docs/performance.md).
        #[default]
        Auto,
        /// Half precision: two thirds of the memory of `mixed`, and differences of up to 1e-2 nats per token between scoring methods, because
        /// llama.cpp multiplies values by half precision differently at other batch sizes.
        F16,
        /// Keys in half precision, values in single. llama.cpp multiplies half-precision keys in tiles, but takes single-precision ones one by
        /// one, which can be half of an event; scores of unquantised weights move by some 1e-3 nats (docs/performance.md).
        Mixed,
        /// Single precision: methods differ by the order of their sums alone. Quantised weights can make hundredths of a nat of
        /// that, once in some hundred prompts.
        F32,
        /// Blocks of 32 eight-bit numbers, as Q8_0 weights are, read by llama.cpp's fused attention: a third of the memory of `mixed`,
        /// and no work for positions that nobody sees. Faster behind short narrations, slower behind long ones and with larger models. Scores of
        /// unquantised weights move by less than 5e-2 nats, those of Q8_0 weights hardly further than these weights do by themselves.
        Q8,
    }
}

impl CacheType {
    pub(crate) fn chosen(self, header: &Header, parameters: u64) -> Self {
        match self {
            Self::Auto => {
                let whole = |width: Option<u64>| width.is_some_and(|width| width % BLOCK == 0);
                let fits = parameters <= Q8_PARAMETERS_MAX && head_widths(header).into_iter().all(whole);
                if fits { Self::Q8 } else { Self::Mixed }
            }
            named => named,
        }
    }

    /// The types of keys and values, and whether llama.cpp's fused attention reads them.
    fn stored(self) -> (KvCacheType, KvCacheType, bool) {
        match self {
            Self::F16 => (KvCacheType::F16, KvCacheType::F16, false),
            Self::Auto | Self::Mixed => (KvCacheType::F16, KvCacheType::F32, false),
            Self::F32 => (KvCacheType::F32, KvCacheType::F32, false),
            Self::Q8 => (KvCacheType::Q8_0, KvCacheType::Q8_0, true),
        }
    }
}

/// Numbers in a block of [`CacheType::Q8`]: a head's keys and values fill whole blocks.
pub(crate) const BLOCK: u64 = 32;

/// Options of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct LlamaOptions {
    /// Threads of one decoder call, 1 to [`THREADS_MAX`].
    pub threads: usize,
    /// Most positions in the cache: prompt and tree together. The model's training length limits them, and memory is allocated when it is
    /// needed ([`reserve`](roomcast_core::scorer::LanguageModel::reserve)).
    pub context_tokens: u32,
    /// Paths that are decoded in one call, 1 to [`SEQUENCES_MAX`].
    pub sequences: u32,
    /// How the cache is stored.
    pub cache: CacheType,
    /// Lock the weights in memory.
    pub lock_memory: bool,
}

impl Default for LlamaOptions {
    fn default() -> Self {
        // One core stays free for the rest of the robot, even of two. The threads of a call wait for one another a hundred times, so a core
        // in other use delays all of them.
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            threads: cores.saturating_sub(1).max(1),
            context_tokens: 2048,
            sequences: 64,
            cache: CacheType::default(),
            lock_memory: false,
        }
    }
}

impl LlamaOptions {
    pub(crate) fn positions(&self, trained_tokens: u32) -> u32 {
        self.context_tokens.min(trained_tokens).max(1)
    }

    /// llama.cpp's context parameters for a model that was trained on sequences of `trained_tokens`.
    #[must_use]
    pub fn context_parameters(&self, trained_tokens: u32) -> LlamaContextParams {
        let positions = self.positions(trained_tokens);
        let threads = i32::try_from(self.threads.clamp(1, THREADS_MAX)).unwrap_or(1);
        let (keys, values, fused) = self.cache.stored();
        let batch_tokens = positions.min(512);
        LlamaContextParams::default()
            .with_n_ctx(NonZeroU32::new(positions))
            .with_n_batch(batch_tokens)
            .with_n_ubatch(batch_tokens)
            .with_n_seq_max(self.sequences.clamp(1, SEQUENCES_MAX))
            .with_n_threads(threads)
            .with_n_threads_batch(threads)
            .with_type_k(keys)
            .with_type_v(values)
            // The fused kernels sum half or single precision in half precision. Only Q8 uses them, so that the arithmetic stays the same.
            .with_flash_attention_policy(if fused {
                llama_cpp_sys_2::LLAMA_FLASH_ATTN_TYPE_ENABLED
            } else {
                llama_cpp_sys_2::LLAMA_FLASH_ATTN_TYPE_DISABLED
            })
            .with_kv_unified(true)
            .with_swa_full(true)
            .with_no_perf(true)
    }
}

/// The widths of the model's keys and values per head. `None` if the model has no single number for it.
fn head_widths(header: &Header) -> [Option<u64>; 2] {
    let number = |name| header.architecture_number(name);
    let even = || number("embedding_length")?.checked_div(number("attention.head_count")?);
    [number("attention.key_length").or_else(even), number("attention.value_length").or_else(even)]
}

/// A head width that does not fill whole blocks of [`CacheType::Q8`]. llama.cpp rejects other widths that it cannot store.
pub(crate) fn broken_blocks(header: &Header) -> Option<u64> {
    head_widths(header).into_iter().flatten().find(|width| width % BLOCK != 0)
}
