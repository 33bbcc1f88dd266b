//! Roomcast's language model: GGUF files on llama.cpp, in this process and on its processor.
//!
//! [`LlamaModel`] is what `roomcast-core` asks for as a language model. A file is read and checked by safe code ([`gguf`]) before
//! llama.cpp sees it, and no other crate talks to llama.cpp. Its own types are in two signatures, for who compares with the bare
//! decoder: [`backend`] and [`LlamaOptions::context_parameters`].
//!
//! ```no_run
//! use roomcast_core::scorer::LanguageModel;
//! use roomcast_llama::{LlamaModel, LlamaOptions};
//!
//! let model = LlamaModel::load("models/household.gguf".as_ref(), &LlamaOptions::default())?;
//! println!("{} parameters", model.info().parameters);
//! # Ok::<(), roomcast_core::scorer::ModelError>(())
//! ```

pub mod gguf;
pub mod memory;

mod backend;
mod model;
mod options;
mod pieces;

pub mod affinity;

pub use backend::{backend, build_features};
pub use model::*;
pub use options::{CacheType, LlamaOptions, SEQUENCES_MAX, THREADS_MAX};
