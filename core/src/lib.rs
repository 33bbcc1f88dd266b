//! The method of Roomcast: from what a person just did to the rooms they will be in, and to where the robot goes meanwhile.
//!
//! One direction of flow; the modules stand in its order and nothing flows back:
//!
//! ```text
//! observation -> narration -> prompt -> label trie -> label scores -> item scores -> partition scores -> policy -> decision
//! ```
//!
//! Everything here is pure: no clock, no port, no network, no C. A language model comes in as [`scorer::LanguageModel`]; the crate
//! `roomcast-llama` has one on llama.cpp, and a reader may bring another, as below.
//!
//! The method is that of GG-LLM (Graule and Isler, "Geometrically Grounding Large Language Models for Zero-shot Human Activity
//! Forecasting in Human-Aware Task Planning"); equation numbers in this documentation are those of the paper.
//!
//! ```
//! use roomcast_core::grounding::{Grounding, GroundingOptions};
//! use roomcast_core::narration::{Observation, Sentence};
//! use roomcast_core::pipeline::{Pipeline, PipelineOptions};
//! use roomcast_core::scorer::table::TableModel;
//! use roomcast_core::semantic_map::SemanticMap;
//!
//! let map = SemanticMap::from_json(
//!     r#"{"format": "roomcast-scene", "version": 1, "name": "flat",
//!         "rooms": [{"id": "kitchen", "label": "kitchen", "min_m": [0, 0, 0], "max_m": [4, 4, 3]},
//!                   {"id": "bedroom", "label": "bedroom", "min_m": [4, 0, 0], "max_m": [8, 4, 3]}],
//!         "items": [{"id": "mug", "label": "mug", "position_m": [1, 1, 1]},
//!                   {"id": "bed", "label": "bed", "position_m": [6, 2, 0.3]}]}"#,
//! )?;
//! let grounding = Grounding::new(&map, &GroundingOptions::default())?;
//! let model = TableModel::new(7);
//! let mut pipeline = Pipeline::new(model, grounding, PipelineOptions::default())?;
//! let sentence = Sentence::new("they walk to the mug")?;
//! let scores = pipeline.step([Observation::of(1, sentence)])?;
//! let probability = scores.grounded.probabilities();
//! assert_eq!(probability.len(), 2);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// In the order of the flow, not of the alphabet; the empty lines keep rustfmt from sorting them.
pub mod text;

pub mod narration;

pub mod prompt;

pub mod label_trie;

pub mod scorer;

pub mod semantic_map;

pub mod grounding;

pub mod forecast;

pub mod policy;

pub mod pipeline;

pub mod explanation;
