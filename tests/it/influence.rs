//! The effect of one narrator on a room's probability, with the included model. An honest narrator reports a person; another narrator reports the
//! same person once, or floods the window. The test asserts the bound on places in the window. The effect on the model has no bound: the test
//! measures it for SECURITY.md.
//!
//! `ROOMCAST_INFLUENCE_SEEDS=1000 cargo test --release --test it influence -- --nocapture` measures 1 000 seeds.

use rand::seq::{IndexedMutRandom, IndexedRandom};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::{Observation, Program, Quota, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_llama::{LlamaModel, LlamaOptions};
use roomcast_services::embedded;
use roomcast_services::setup::load_model;

use crate::number;

const SEEDS: u64 = 12;
/// Sentences of the honest narrator after a flood.
const AFTER: usize = 12;
/// Seeds behind SECURITY.md's table, and the tolerance of its figures: they have two digits, and processors round differently.
const TOLD_SEEDS: u64 = 300;
const ROUNDED: f64 = 0.015;
/// The places of each of two narrators in a window of twelve.
const PLACES: usize = 6;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Who {
    Honest,
    Other,
}

/// The difference of the room moved most from its probability without the other narrator: the worst case, and the sum over all cases.
#[derive(Debug, Default, Clone, Copy)]
struct Moved {
    worst: f64,
    sum: f64,
    count: u32,
}

impl Moved {
    fn note(&mut self, with: &[f64], without: &[f64]) {
        let moved = with.iter().zip(without).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        (self.worst, self.sum, self.count) = (self.worst.max(moved), self.sum + moved, self.count + 1);
    }

    fn mean(self) -> f64 {
        self.sum / f64::from(self.count.max(1))
    }

    fn shown(self) -> String {
        format!("worst {:.2}, mean {:.2}", self.worst, self.mean())
    }
}

/// A pipeline that forgets the person before each story.
struct Home {
    pipeline: Pipeline<LlamaModel>,
    sequence: u64,
}

impl Home {
    fn new(scene: &str) -> Self {
        let map = SemanticMap::from_json(embedded::scene(scene).unwrap().text).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let model = load_model(None, &LlamaOptions { threads: 1, ..LlamaOptions::default() }).unwrap();
        Self { pipeline: Pipeline::new(model, grounding, PipelineOptions::default()).unwrap(), sequence: 0 }
    }

    fn hear(&mut self, who: Who, sentence: &str) {
        self.sequence += 1;
        let (source, share) = (who as u64 + 1, 1);
        let said = Observation { source, ..Observation::of(self.sequence, Sentence::new(sentence).unwrap()) };
        self.pipeline.intake().hear([(Quota { number: source, share }, said)]);
    }

    fn rooms(&mut self) -> Vec<f64> {
        self.pipeline.score().unwrap().grounded.partition_probability.clone()
    }

    /// The honest narrator's places in the window.
    fn places(&self) -> usize {
        let window = self.pipeline.inside().histories().get(PersonId(0)).unwrap();
        window.observations().filter(|o| o.source == Who::Honest as u64 + 1).count()
    }
}

#[test]
fn one_narrator_alone_keeps_to_its_places() {
    let seeds = number("ROOMCAST_INFLUENCE_SEEDS").unwrap_or(SEEDS);
    // SECURITY.md's figures are from the six maps with boxes.
    let boxes = embedded::SCENES.iter().map(|scene| scene.name).filter(|name| *name != "flat");
    let scenes: Vec<&str> = boxes.collect();
    let mut homes: Vec<Home> = scenes.iter().map(|scene| Home::new(scene)).collect();
    let sentences: Vec<Vec<String>> = (embedded::PROGRAMS.iter().chain(&embedded::WORK_PROGRAMS))
        .map(|program| Program::parse(program.text).unwrap().steps.iter().map(|step| step.sentence()).collect())
        .collect();
    let (mut one, mut flood) = (Moved::default(), Moved::default());
    let mut after = [Moved::default(); AFTER];
    for seed in 0..seeds {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let home = homes.choose_mut(&mut rng).unwrap();
        let said = sentences.iter().filter(|said| said.len() > 2 * AFTER).collect::<Vec<_>>();
        let said = *said.choose(&mut rng).unwrap();
        let from = rng.random_range(AFTER..=said.len() - AFTER);
        let other = sentences.choose(&mut rng).unwrap().choose(&mut rng).unwrap().clone();
        let told = |home: &mut Home| {
            home.pipeline.intake().forget_person(PersonId(0));
            said[..from].iter().for_each(|sentence| home.hear(Who::Honest, sentence));
        };

        told(home);
        let without = home.rooms();
        home.hear(Who::Other, &other);
        one.note(&home.rooms(), &without);
        // At the highest rate that the intake permits, until the probabilities no longer change.
        for _ in 0..40 {
            home.hear(Who::Other, &other);
        }
        assert!(home.places() >= PLACES, "the honest one has {} places", home.places());
        flood.note(&home.rooms(), &without);
        let mut with = Vec::new();
        for sentence in &said[from..from + AFTER] {
            home.hear(Who::Honest, sentence);
            with.push(home.rooms());
            assert!(home.places() >= PLACES);
        }
        told(home);
        for (count, sentence) in said[from..from + AFTER].iter().enumerate() {
            home.hear(Who::Honest, sentence);
            after[count].note(&with[count], &home.rooms());
        }
    }
    println!("{seeds} seeds: one sentence moves a room by {}; a flood of it by {}", one.shown(), flood.shown());
    for (count, moved) in (1..).zip(after) {
        println!("after {count} more of the honest one: {}", moved.shown());
    }
    let measured = [one, flood, after[0], after[3], after[7], after[11]];
    for (moved, (row, worst, mean)) in measured.into_iter().zip(told()) {
        // The worst case of fewer seeds is no worse.
        if seeds <= TOLD_SEEDS {
            assert!(moved.worst < worst + ROUNDED, "SECURITY.md: {row}: {}", moved.shown());
        }
        if seeds == TOLD_SEEDS {
            let is_told = (moved.worst - worst).abs() < ROUNDED && (moved.mean() - mean).abs() < ROUNDED;
            assert!(is_told, "SECURITY.md: {row}: {}", moved.shown());
        }
    }
}

/// SECURITY.md's table: the other narrator's behaviour, its worst effect, its mean effect.
fn told() -> Vec<(String, f64, f64)> {
    let text = include_str!("../../SECURITY.md");
    let table = text.split_once("| the other narrator |").unwrap().1.lines().skip(2);
    let rows = table.take_while(|line| line.starts_with('|')).map(|line| {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        (cells[1].to_owned(), cells[2].parse().unwrap(), cells[3].parse().unwrap())
    });
    let rows: Vec<_> = rows.collect();
    assert_eq!(rows.len(), 6, "{rows:?}");
    rows
}
