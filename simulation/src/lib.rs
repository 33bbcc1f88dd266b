//! Simulated persons and robots, and drawings of maps: `roomcast demo` and `roomcast-lab` use them.
//!
//! The simulation uses the method of `roomcast-core` exactly as the robot does, on simulated time.
//!
//! ```
//! use roomcast_core::grounding::{Grounding, GroundingOptions};
//! use roomcast_core::semantic_map::SemanticMap;
//! use roomcast_simulation::drawing;
//!
//! let map = SemanticMap::from_json(include_str!("../../core/example.json"))?;
//! let grounding = Grounding::new(&map, &GroundingOptions::default())?;
//! let plan = drawing::svg(&map, &grounding, None)?;
//! assert!(plan.contains("<svg"));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod binding;
pub mod clairvoyant;
pub mod drawing;
pub mod homer;
#[cfg(feature = "solver")]
pub mod mixed_integer;
#[cfg(feature = "png")]
pub mod png;
pub mod scores;
pub mod study;
pub mod timeline;
pub mod trace;
pub mod world;

use roomcast_core::grounding::GroundingError;
use roomcast_core::narration::TextError;

pub use scores::{ScoreSource, ScoresError};
use timeline::TimelineError;
use world::WorldError;

/// An error of a simulation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StudyError {
    /// The trace has too many days for a forecast of every minute.
    #[error("{days} days, more than {}: give the first of them in a folder of their own", trace::DAYS_MAX)]
    TooManyDays {
        /// The number of days.
        days: usize,
    },
    /// The log spans too many days, for example because of a wrong year.
    #[error(
        "the log reaches from {from} to {to}, over more than {} days: correct the times that are wrong, or give a part of it",
        trace::DAYS_MAX
    )]
    LongLog {
        /// The date of its first time.
        from: String,
        /// The date of its last time.
        to: String,
    },
    /// The scorer or its cache failed.
    #[error(transparent)]
    Scores(#[from] ScoresError),
    /// The model failed.
    #[error(transparent)]
    Model(Box<dyn std::error::Error + Send + Sync>),
    /// A person's timeline failed.
    #[error(transparent)]
    Timeline(#[from] TimelineError),
    /// A simulation failed.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The mixed-integer solver failed.
    #[cfg(feature = "solver")]
    #[error(transparent)]
    Solver(#[from] mixed_integer::SolverError),
    /// The map has more rooms than the dynamic program can hold.
    #[cfg(not(feature = "solver"))]
    #[error(
        "a map of {rooms} rooms needs the mixed-integer solver for the clairvoyant bound: build with `--features optimum`, or give a map of at most {} rooms",
        study::ROOMS_PROGRAMMED_MAX
    )]
    NeedsSolver {
        /// The number of rooms.
        rooms: usize,
    },
    /// A run is better than the least possible disturbance.
    #[error(
        "{decider} disturbed for {found_s} s, less than the clairvoyant bound of {bound_s} s: this is a fault of the simulation, please report it"
    )]
    BelowBound {
        /// The decider.
        decider: String,
        /// D_T of the run.
        found_s: f64,
        /// The least possible.
        bound_s: f64,
    },
    /// Two exact methods have different results.
    #[cfg(feature = "solver")]
    #[error(
        "dynamic programming gives {dynamic_s:?} s and HiGHS {solver_s:?} s for the clairvoyant optimum: this is a fault of the simulation, please report it"
    )]
    SolversDisagree {
        /// The result of dynamic programming.
        dynamic_s: Option<f64>,
        /// The result of HiGHS.
        solver_s: Option<f64>,
    },
    /// The map's grounding failed.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// An action makes no sentence.
    #[error(transparent)]
    Sentence(#[from] TextError),
}

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
