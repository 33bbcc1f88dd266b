//! The method of Roomcast: from a person's latest action to the rooms they will be in, and to the robot's next room.
//!
//! A map, a sentence, and the probability of each room to be the next one:
//!
//! ```
//! # use roomcast_core::narration::{Observation, Sentence};
//! # use roomcast_core::pipeline::Pipeline;
//! # use roomcast_core::scorer::table::TableModel;
//! # use roomcast_core::semantic_map::SemanticMap;
//! let map = SemanticMap::from_json(include_str!("../example.json"))?;
//! let mut pipeline = Pipeline::of(&map, TableModel::new(7))?;
//! let scores = pipeline.step([Observation::of(1, Sentence::new("They walk to the mug.")?)])?;
//! for (room, probability) in map.rooms().iter().zip(&scores.grounded.partition_probability) {
//!     println!("{}: {probability:.2}", room.label);
//! }
//! # assert!((scores.grounded.partition_probability.iter().sum::<f64>() - 1.0).abs() < 1e-9);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`scorer::table::TableModel`] replaces a language model here. `roomcast-llama` has a language model, on llama.cpp.
//!
//! Data flow in one direction; the modules are in this order:
//!
//! ```text
//! observation -> narration -> prompt -> label trie -> label scores -> item scores -> partition scores -> policy -> decision
//! ```
//!
//! The crate has no clock, port, network, process or C code. Only the `load` functions, [`text::read_at_most`] and
//! [`semantic_map::read_limited`] read files. A language model is a [`scorer::LanguageModel`]; `roomcast-llama` has one, and you can write
//! another, as below.
//!
//! These types of other crates are part of the interface: `rand`'s random numbers for policies, `serde`'s and `strum`'s traits, by which configuration and command line parse choices.
//!
//! The method is GG-LLM (Graule and Isler, "Geometrically Grounding Large Language Models for Zero-shot Human Activity
//! Forecasting in Human-Aware Task Planning"); equation numbers in this documentation follow the paper.
//!
//! A custom model needs four methods. This model prefers letters that it has read before:
//!
//! ```
//! use roomcast_core::grounding::{Grounding, GroundingOptions};
//! use roomcast_core::label_trie::TokenTree;
//! use roomcast_core::narration::{Observation, Sentence};
//! use roomcast_core::pipeline::{Pipeline, PipelineOptions};
//! use roomcast_core::scorer::{DecodeStats, LanguageModel, ModelError, ModelInfo, TextStart, Token};
//! use roomcast_core::semantic_map::SemanticMap;
//!
//! struct Letters(ModelInfo);
//!
//! impl LanguageModel for Letters {
//!     fn info(&self) -> &ModelInfo {
//!         &self.0
//!     }
//!     fn tokenise(&self, text: &str, _: TextStart, out: &mut Vec<Token>) -> Result<(), ModelError> {
//!         out.extend(text.bytes().map(|byte| Token(byte.into())));
//!         Ok(())
//!     }
//!     fn decode(
//!         &mut self,
//!         prompt: &[Token],
//!         tree: &TokenTree,
//!         want_prompt_row: bool,
//!         visit: &mut dyn FnMut(usize, &[f32]),
//!     ) -> Result<DecodeStats, ModelError> {
//!         let mut logits = [0.0; 256];
//!         prompt.iter().for_each(|letter| logits[letter.0 as usize] += 0.1);
//!         (usize::from(!want_prompt_row)..=tree.len()).for_each(|row| visit(row, &logits));
//!         Ok(DecodeStats::default())
//!     }
//!     fn token_text(&self, token: Token) -> String {
//!         char::from(token.0 as u8).into()
//!     }
//! }
//!
//! let map = SemanticMap::from_json(include_str!("../example.json"))?;
//! let grounding = Grounding::new(&map, &GroundingOptions::default())?;
//! let info = ModelInfo { vocabulary: 256, context_tokens: 4096, shares_prefix: true, ..ModelInfo::default() };
//! let mut pipeline = Pipeline::new(Letters(info), grounding, PipelineOptions::default())?;
//! let scores = pipeline.step([Observation::of(1, Sentence::new("they walk to the mug")?)])?;
//! for (room, probability) in map.rooms().iter().zip(&scores.grounded.partition_probability) {
//!     println!("{} {probability:.2}", room.label);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod choices;

// In the order of the flow; the empty lines keep rustfmt from sorting them.
pub mod ids;

pub mod matrix;

pub mod text;

pub mod parsing;

pub mod names;

pub mod narration;

pub mod prompt;

pub mod label_trie;

pub mod scorer;

pub mod prepared;

pub mod semantic_map;

mod like_things;

pub mod grounding;

pub mod places;

pub mod forecast;

pub mod tracker;

pub mod habits;

pub mod policy;

pub mod guess;

pub mod draft;

pub mod pipeline;

pub mod explanation;

#[cfg(test)]
#[path = "../../tests/support/skipped.rs"]
mod skipped;
