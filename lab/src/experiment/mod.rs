//! The paper's tables and figures, and the project's own, with the pipeline's scorer, grounding and policies.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};

use roomcast_cli::{Failure, exit_code};
use roomcast_core::grounding::GroundingError;
use roomcast_core::narration::TextError;
use roomcast_simulation::{ScoresError, StudyError};

pub mod baselines;
pub mod chart;
pub mod familiarity;
pub mod guesses;
pub mod habits;
pub mod losses;
pub mod persons;
pub mod prediction;
pub mod report;
mod resampling;
pub mod setups;
pub mod tables;
pub mod wishes;

/// An error of an experiment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExperimentError {
    /// A file or folder cannot be read.
    #[error("failed to read {path}: {source}")]
    Read {
        /// The path.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// There are no programs.
    #[error("no activity program in {path}{}: give a folder of .txt files in VirtualHome's format", .fault.as_ref().map(|f| format!(" ({f})")).unwrap_or_default())]
    NoPrograms {
        /// The path of the search.
        path: PathBuf,
        /// The first fault, if files were there.
        fault: Option<String>,
    },
    /// The scene has none of the things in the programs.
    #[error(
        "the scene `{scene}` has none of the things that are narrated: give programs, days or rules for it, or aliases in the scene"
    )]
    NothingBound {
        /// The scene's name.
        scene: String,
    },
    /// The simulation or the scorer failed.
    #[error(transparent)]
    Study(#[from] StudyError),
}

impl From<ScoresError> for ExperimentError {
    fn from(error: ScoresError) -> Self {
        StudyError::from(error).into()
    }
}

impl From<GroundingError> for ExperimentError {
    fn from(error: GroundingError) -> Self {
        StudyError::from(error).into()
    }
}

impl From<TextError> for ExperimentError {
    fn from(error: TextError) -> Self {
        StudyError::from(error).into()
    }
}

impl From<ExperimentError> for Failure {
    fn from(error: ExperimentError) -> Self {
        match error {
            ExperimentError::Study(error) => error.into(),
            _ => Self::new(exit_code::INPUT, error),
        }
    }
}

/// Progress of a long run, on standard error, shown only on a terminal.
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

    /// Hidden progress.
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
