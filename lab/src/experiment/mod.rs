//! The paper's tables and figures, and the project's own, by the pipeline's own scorer, grounding and policies.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use crate::simulation::timeline::TimelineError;
use crate::simulation::world::WorldError;
use roomcast_core::grounding::GroundingError;
use roomcast_core::narration::SentenceError;

pub mod baselines;
pub mod chart;
pub mod guesses;
pub mod habits;
pub mod losses;
pub mod persons;
pub mod prediction;
pub mod report;
mod resampling;
pub mod scores;
pub mod setups;
pub mod study;
pub mod tables;

pub use scores::{ScoreSource, ScoresError};

/// What keeps an experiment from its result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExperimentError {
    /// A file or folder.
    #[error("failed to read {path}: {source}")]
    Read {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// No program.
    #[error("no activity program in {path}{}: give a folder of .txt files in VirtualHome's format", .fault.as_ref().map(|f| format!(" ({f})")).unwrap_or_default())]
    NoPrograms {
        /// Where one was looked for.
        path: PathBuf,
        /// The first fault, if files were there.
        fault: Option<String>,
    },
    /// The programs and the scene have nothing in common.
    #[error(
        "the scene `{scene}` has none of the things that are narrated: give programs, days or rules for it, or aliases in the scene"
    )]
    NothingBound {
        /// The scene's name.
        scene: String,
    },
    /// More days than somebody is forecast in minute by minute.
    #[error("{days} days, more than {}: give the first of them in a folder of their own", habits::DAYS_MAX)]
    TooManyDays {
        /// How many.
        days: usize,
    },
    /// A log of more days than that, as one with a wrong year.
    #[error(
        "the log reaches from {from} to {to}, over more than {} days: correct the times that are wrong, or give a part of it",
        habits::DAYS_MAX
    )]
    LongLog {
        /// The date of its first time.
        from: String,
        /// The date of its last time.
        to: String,
    },
    /// The scorer or its cache.
    #[error(transparent)]
    Scores(ScoresError),
    /// The model.
    #[error(transparent)]
    Model(Box<dyn std::error::Error + Send + Sync>),
    /// A person.
    #[error(transparent)]
    Timeline(#[from] TimelineError),
    /// A simulation.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The mixed-integer solver.
    #[cfg(feature = "solver")]
    #[error(transparent)]
    Solver(#[from] crate::simulation::mixed_integer::SolverError),
    /// More rooms than the dynamic program holds.
    #[cfg(not(feature = "solver"))]
    #[error(
        "a map of {rooms} rooms needs the mixed-integer solver for the clairvoyant bound: build with `--features optimum`, or give a map of at most {} rooms",
        study::ROOMS_PROGRAMMED_MAX
    )]
    NeedsSolver {
        /// How many.
        rooms: usize,
    },
    /// A run that no robot can have had.
    #[error(
        "{decider} disturbed for {found_s} s, less than the clairvoyant bound of {bound_s} s: this is a fault of the simulation, please report it"
    )]
    BelowBound {
        /// Who decided.
        decider: String,
        /// D_T of the run.
        found_s: f64,
        /// The least possible.
        bound_s: f64,
    },
    /// Two exact methods with different results.
    #[cfg(feature = "solver")]
    #[error(
        "dynamic programming gives {dynamic_s:?} s and HiGHS {solver_s:?} s for the clairvoyant optimum: this is a fault of the simulation, please report it"
    )]
    SolversDisagree {
        /// One of them.
        dynamic_s: Option<f64>,
        /// The other.
        solver_s: Option<f64>,
    },
    /// The map.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// An action that makes no sentence.
    #[error(transparent)]
    Sentence(#[from] SentenceError),
}

/// Progress of a long run, on standard error and only where a person watches.
#[derive(Debug)]
pub struct Progress(ProgressBar);

impl Progress {
    /// A bar of `steps` steps.
    #[must_use]
    pub fn new(what: &'static str, steps: usize) -> Self {
        let bar = ProgressBar::new(steps as u64).with_message(what);
        if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}") {
            bar.set_style(style);
        }
        Self(bar)
    }

    /// None at all.
    #[must_use]
    pub fn hidden() -> Self {
        Self(ProgressBar::hidden())
    }

    /// One step done.
    pub fn step(&self) {
        self.0.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
