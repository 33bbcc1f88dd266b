//! How often the next sentence is among the guesses that the daemon scores ahead, by how many it makes.

use std::collections::BTreeMap;

use roomcast_core::grounding::Grounding;
use roomcast_core::guess::{Counts, Guesser, Thread};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use serde::Serialize;

use super::prediction::{NamedProgram, sentences};
use super::{ExperimentError, Progress, ScoreSource};

/// Of so many steps, how many had their sentence among the first K guesses.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Hits {
    /// Sentences that could be guessed: all but a program's first.
    pub steps: usize,
    /// Per K of [`Report::k`].
    pub among: Vec<usize>,
}

impl Hits {
    fn add(&mut self, k: &[usize], rank: Option<usize>) {
        self.among.resize(k.len(), 0);
        self.steps += 1;
        for (among, k) in self.among.iter_mut().zip(k) {
            *among += usize::from(rank.is_some_and(|rank| rank < *k));
        }
    }

    /// The shares of the steps, per K.
    pub fn shares(&self) -> impl Iterator<Item = f64> {
        self.among.iter().map(|among| *among as f64 / self.steps.max(1) as f64)
    }
}

/// What the experiment found.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// How many guesses were made, ascending.
    pub k: Vec<usize>,
    /// With what the training split's programs say alone.
    pub seed: Hits,
    /// Learning each sentence after it was guessed, from the first program to the last.
    pub learning: Hits,
    /// The same by the action's name.
    pub learning_by_action: BTreeMap<String, Hits>,
}

/// Tells each program from its start, once with a guesser that only follows and once with one that learns.
///
/// # Errors
/// When the model fails, or an object's name makes no sentence.
pub fn run<M: LanguageModel>(
    (programs, counts): (&[NamedProgram], &Counts),
    grounding: &Grounding,
    source: &mut ScoreSource<M>,
    (limits, binding): (HistoryLimits, &BindingSequence),
    k: &[usize],
    progress: &Progress,
) -> Result<Report, ExperimentError> {
    let labels = grounding.label_texts();
    let mut seeded = Guesser::new(counts, &labels);
    let mut learner = seeded.clone();
    let most = k.iter().copied().max().unwrap_or_default();
    let mut report = Report { k: k.to_vec(), ..Report::default() };
    for NamedProgram { program, .. } in programs {
        let told = sentences(&program.steps)?;
        let rows = source.score_steps(&told, limits, binding)?;
        let (mut thread, mut own) = (Thread::default(), Thread::default());
        for (at, sentence) in told.iter().enumerate() {
            if at > 0 {
                let rank_of =
                    |guesses: &[(String, f64)]| guesses.iter().position(|(guess, _)| guess == sentence.as_str());
                report.seed.add(k, rank_of(&seeded.guess(&thread, &rows[at], most)));
                let rank = rank_of(&learner.guess(&own, &rows[at], most));
                report.learning.add(k, rank);
                let verb = program.steps[at].verb().to_owned();
                report.learning_by_action.entry(verb).or_default().add(k, rank);
            }
            seeded.follow(&mut thread, sentence.as_str());
            learner.hear(&mut own, sentence.as_str());
        }
        progress.step();
    }
    source.flush()?;
    Ok(report)
}
