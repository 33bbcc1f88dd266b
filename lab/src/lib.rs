//! Roomcast's laboratory: simulated persons and robots, the paper's experiments and ours, charts and drawings.
//!
//! It uses the method of `roomcast-core` exactly as the robot does, on simulated time.
//!
//! ```
//! use roomcast_core::grounding::{Grounding, GroundingOptions};
//! use roomcast_core::semantic_map::SemanticMap;
//! use roomcast_lab::drawing;
//!
//! let map = SemanticMap::from_json(include_str!("../../core/example.json"))?;
//! let grounding = Grounding::new(&map, &GroundingOptions::default())?;
//! let plan = drawing::svg(&map, &grounding, None)?;
//! assert!(plan.contains("<svg"));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod drawing;

pub mod simulation;

pub mod home_simulation;

pub mod experiment;

#[cfg(feature = "png")]
pub mod png;

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
