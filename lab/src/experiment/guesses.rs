//! How often the next sentence is among the guesses that the daemon prefetches, by the number of guesses.

use std::collections::BTreeMap;

use roomcast_core::grounding::Grounding;
use roomcast_core::guess::{Counts, Guesser, Thread};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::places::PlaceMatcher;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::semantic_map::SemanticMap;
use serde::Serialize;

use roomcast_cli::Failure;

use super::prediction::{NamedProgram, sentences};
use super::{Progress, nothing_bound};
use roomcast_simulation::ScoreSource;

/// The number of steps with their sentence among the first K guesses.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Hits {
    /// Sentences that could be guessed: all except a program's first.
    pub steps: usize,
    /// Steps for each K of [`Report::k`].
    pub among: Vec<usize>,
}

impl Hits {
    fn new(k: &[usize]) -> Self {
        Self { steps: 0, among: vec![0; k.len()] }
    }

    fn add(&mut self, k: &[usize], rank: Option<usize>) {
        self.steps += 1;
        for (among, k) in self.among.iter_mut().zip(k) {
            *among += usize::from(rank.is_some_and(|rank| rank < *k));
        }
    }

    /// The shares of the steps for each K.
    pub fn shares(&self) -> impl Iterator<Item = f64> {
        self.among.iter().map(|among| *among as f64 / self.steps.max(1) as f64)
    }
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Report {
    /// The numbers of guesses, ascending.
    pub k: Vec<usize>,
    /// With the training split's programs alone.
    pub seed: Hits,
    /// With learning of each sentence after its guess, from the first program to the last.
    pub learning: Hits,
    /// The same by the action's name.
    pub learning_by_action: BTreeMap<String, Hits>,
}

/// Plays each program from its start, once with a guesser that only follows and once with one that learns.
pub fn run<M: LanguageModel>(
    (programs, counts): (&[NamedProgram], &Counts),
    (map, grounding): (&SemanticMap, &Grounding),
    source: &mut ScoreSource<M>,
    (limits, binding): (HistoryLimits, &BindingSequence),
    k: &[usize],
    progress: &Progress,
) -> Result<Report, Failure> {
    let labels = grounding.label_texts();
    let mut seeded = Guesser::new(counts, &labels);
    let mut learner = seeded.clone();
    let most = k.iter().copied().max().unwrap_or_default();
    let none = || Hits::new(k);
    let mut report = Report { k: k.to_vec(), seed: none(), learning: none(), learning_by_action: BTreeMap::new() };
    let mut mentions = PlaceMatcher::new(map, grounding);
    let mut mentioned = false;
    for NamedProgram { program, .. } in programs {
        let told = sentences(&program.steps)?;
        mentioned |= told.iter().any(|sentence| mentions.last(sentence.as_str()).is_some());
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
                report.learning_by_action.entry(verb).or_insert_with(none).add(k, rank);
            }
            seeded.follow(&mut thread, sentence.as_str());
            learner.hear(&mut own, sentence.as_str());
        }
        progress.step();
    }
    source.flush()?;
    if mentioned { Ok(report) } else { Err(nothing_bound(map.name())) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::narration::Program;
    use roomcast_core::scorer::correction::CorrectionChoice;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::scorer::{Method, Tokenisation};

    #[test]
    fn a_share_is_there_without_a_step_and_no_result_where_nothing_is_in_the_map() {
        let map = SemanticMap::from_json(include_str!("../../../scenes/studio.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let run_with = |step: &str| {
            let program = Program::parse(&format!("T\nd\n\n{step}\n")).unwrap();
            let programs = [NamedProgram { path: "a".into(), program, activity: "a".into() }];
            let labels = grounding.label_texts();
            let (method, tokens) = (Method::Trie, Tokenisation::Joint);
            let correction = CorrectionChoice::default();
            let mut source = ScoreSource::new(TableModel::new(1), &labels, method, tokens, correction, None).unwrap();
            let how = (HistoryLimits::default(), &BindingSequence::default());
            let told = (programs.as_slice(), &Counts::default());
            run(told, (&map, &grounding), &mut source, how, &[8, 16], &Progress::hidden())
        };
        let report = run_with("[Walk] <fridge> (1)").unwrap();
        assert_eq!((report.seed.steps, report.seed.among, report.learning.among), (0, vec![0; 2], vec![0; 2]));
        let failure = run_with("[Walk] <spaceship> (1)").unwrap_err();
        assert!(failure.to_string().contains("has none of the things"), "{failure}");
    }
}
