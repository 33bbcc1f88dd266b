//! The paper's tables and figures, and the project's own, with the pipeline's scorer, grounding and policies.

use indicatif::{ProgressBar, ProgressStyle};

use roomcast_cli::Failure;

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

/// A failure of which the caller knows the exit code.
pub type Fault = Box<dyn std::error::Error + Send + Sync>;

/// Each value once, in the order of the first ones.
pub fn distinct<T: PartialEq>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut once = Vec::new();
    for value in values {
        if !once.contains(&value) {
            once.push(value);
        }
    }
    once
}

/// No program, day or rule has a thing of the scene.
fn nothing_bound(scene: &str) -> Failure {
    Failure::input(format!(
        "the scene `{scene}` has none of the things that are narrated: give programs, days or rules for it, or aliases in the scene"
    ))
}

/// Progress of a long run, on standard error, shown only on a terminal.
#[derive(Debug)]
pub struct Progress(ProgressBar);

impl Progress {
    pub fn new(what: &'static str, steps: usize) -> Self {
        let bar = ProgressBar::new(steps as u64).with_message(what);
        if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}") {
            bar.set_style(style);
        }
        Self(bar)
    }

    #[cfg(test)]
    pub fn hidden() -> Self {
        Self(ProgressBar::hidden())
    }

    pub fn step(&self) {
        self.0.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
