//! Roomcast's laboratory: simulated persons and robots, the paper's experiments and ours, charts and drawings.
//!
//! It uses the method of `roomcast-core` exactly as the robot does, on simulated time.
//!
//! ```
//! use roomcast_core::grounding::{Grounding, GroundingOptions};
//! use roomcast_core::semantic_map::SemanticMap;
//! use roomcast_lab::drawing;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let scene = r#"{"format": "roomcast-scene", "version": 1, "name": "flat", "items": [],
//! #     "rooms": [{"id": "kitchen", "label": "kitchen", "min_m": [0, 0, 0], "max_m": [4, 4, 3]}]}"#;
//! let map = SemanticMap::from_json(scene)?;
//! let grounding = Grounding::new(&map, &GroundingOptions::default())?;
//! # let _ = (&map, &grounding);
//! # Ok(())
//! # }
//! ```

pub mod drawing;

pub mod simulation;

pub mod experiment;

/// The shipped activity programs for homes, by name, for tests.
#[cfg(test)]
const PROGRAMS: [(&str, &str); 3] = [
    ("p0-breakfast-and-television", include_str!("../../scenes/programs/p0-breakfast-and-television.txt")),
    ("p1-laundry-and-to-bed", include_str!("../../scenes/programs/p1-laundry-and-to-bed.txt")),
    ("p2-long-evening", include_str!("../../scenes/programs/p2-long-evening.txt")),
];

#[cfg(test)]
#[path = "../../tests/support/skipped.rs"]
mod skipped;
