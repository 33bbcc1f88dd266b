//! Roomcast says, in time to matter, which room a person will be in next.
//!
//! One direction of flow; the modules stand in its order and nothing flows back:
//!
//! ```text
//! observation -> narration -> history -> prompt -> label trie -> label scores -> item scores
//!             -> partition scores -> policy -> decision
//! ```
//!
//! What is pure stays pure: narration, prompt, label trie, semantic map, grounding and policy read no clock, no port and
//! no model. `scorer::llama` alone talks to llama.cpp, the crate `roomcast-ipc` alone talks to iceoryx2.
//!
//! The method is that of GG-LLM (Graule and Isler, "Geometrically Grounding Large Language Models for Zero-shot Human
//! Activity Forecasting in Human-Aware Task Planning"); equation numbers in this documentation are those of the paper.

// In the order of the flow, not of the alphabet; the empty lines keep rustfmt from sorting them.
pub mod narration;

pub mod prompt;

pub mod label_trie;

pub mod scorer;

pub mod semantic_map;

pub mod grounding;

pub mod policy;

pub mod forecast;

pub mod pipeline;

pub mod explanation;

pub mod moment;

pub mod daemon;

pub mod planner;

pub mod mqtt;

pub mod sensor_log;

pub mod narrator;

pub mod config;

pub mod embedded;

pub mod gguf;

pub mod hub;

pub mod setup;

pub mod affinity;

pub mod stop;

pub mod logging;

pub mod simulation;

pub mod experiment;

pub mod recording;

pub mod latency;

pub mod top;

pub mod metrics;

pub mod exit_code;

pub mod cli;
