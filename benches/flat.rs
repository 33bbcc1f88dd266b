//! Does an event cost the same after days of narration: `cargo bench --bench flat -- --events 10000`.
//!
//! An old pipeline hears the shipped programs over and over. A young pipeline hears the same events and is replaced after every hundred measured
//! events. Each event is measured in both in turn, so that other load on the machine affects both alike. `--alone` leaves out the young pipelines,
//! for measuring the old one's memory.

#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::time::Instant;

use clap::Parser;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::narration::{Observation, Program, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::clock;
use roomcast_llama::{LlamaModel, LlamaOptions};
use roomcast_services::daemon::{Cycle, Engine, Entry};
use roomcast_services::embedded;
use roomcast_services::setup::load_model;

/// Measured events per young pipeline. Before them it hears every sentence once, as the old one has.
const YOUNG: u64 = 100;

#[derive(Parser)]
struct Args {
    /// Number of events.
    #[arg(long, default_value_t = 10_000)]
    events: u64,
    /// Without young pipelines.
    #[arg(long)]
    alone: bool,
    /// Cargo passes it to every bench.
    #[arg(long, hide = true)]
    bench: bool,
}

fn cycle() -> Cycle<LlamaModel> {
    let map = SemanticMap::from_json(embedded::scene("apartment-e0").expect("it ships").text).expect("it ships");
    let grounding = Grounding::new(&map, &GroundingOptions::default()).expect("the scene has labels");
    let model = load_model(None, &LlamaOptions::default()).expect("it ships");
    let pipeline = Pipeline::new(model, grounding, PipelineOptions::default()).expect("the context is large enough");
    Cycle::new(Engine::new(pipeline, map, GroundingOptions::default(), 1).expect("the rooms fit"), u64::MAX / 2)
}

/// Runs one event; returns microseconds without and with the idle work after it.
fn event(cycle: &mut Cycle<LlamaModel>, sequence: u64, sentence: &Sentence) -> [f64; 2] {
    let now_ns = clock::monotonic_ns();
    let observation = Observation { observed_ns: BootNs(now_ns), ..Observation::of(sequence, sentence.clone()) };
    let start = Instant::now();
    cycle.enter(Entry::new(observation, BootNs(now_ns)), 0);
    cycle.step(BootNs(now_ns), UnixNs(now_ns)).expect("the model scores");
    std::hint::black_box(cycle.engine_mut().forecast(BootNs(now_ns)));
    std::hint::black_box(cycle.message(BootNs(now_ns), u64::MAX, false));
    let event_us = start.elapsed().as_secs_f64() * 1e6;
    // As the daemon does after writing its journal.
    cycle.engine_mut().tell_outcomes(|_| {});
    while cycle.tidy() {}
    [event_us, start.elapsed().as_secs_f64() * 1e6]
}

fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get((values.len() as f64 * share) as usize).copied().unwrap_or(f64::NAN)
}

/// The ratio to the young pipeline, or "-" without one.
fn ratio(value: f64) -> String {
    if value.is_nan() { "-".into() } else { format!("{value:.3}") }
}

fn resident_kib() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    statm.split_whitespace().nth(1).and_then(|pages| pages.parse::<u64>().ok()).unwrap_or(0) * 4
}

fn main() {
    let args = Args::parse();
    let programs = embedded::PROGRAMS.iter().flat_map(|p| Program::parse(p.text).expect("it ships").steps);
    let sentences: Vec<Sentence> =
        programs.map(|action| Sentence::new(&action.sentence()).expect("it is one")).collect();
    let heard = sentences.len() as u64;
    let (mut old, mut young, mut young_age) = (cycle(), cycle(), 0);
    // Per event: old pipeline, young pipeline.
    let mut samples: Vec<([f64; 2], [f64; 2])> = Vec::new();
    println!(
        "events            p50 (us)   p99 (us)  with idle work, mean (us)  old / young  with idle work  resident (KiB)"
    );
    let block = (args.events / 10).max(1);
    for (number, sentence) in (0..args.events).zip(sentences.iter().cycle()) {
        let (mut old_us, mut young_us) = ([f64::NAN; 2], [f64::NAN; 2]);
        for turn in 0..2 {
            // Alternate the order, so that each goes first equally often.
            match (turn + number) % 2 {
                0 => old_us = event(&mut old, number + 1, sentence),
                _ if args.alone => {}
                _ => young_us = event(&mut young, number + 1, sentence),
            }
        }
        if args.alone || (number >= heard && young_age >= heard) {
            samples.push((old_us, young_us));
        }
        young_age += 1;
        if !args.alone && young_age == heard + YOUNG {
            (young, young_age) = (cycle(), 0);
        }
        if (number + 1) % block == 0 {
            let olds = |part: usize| samples.iter().map(move |(old, _)| old[part]);
            // With idle work, compare means over whole repetitions: idle work occurs at every fifth event, and not at the same ones in both.
            let young_mean = samples.iter().map(|(_, young)| young[1]).sum::<f64>();
            println!(
                "{:16} {:9.0} {:10.0} {:26.0} {:>12} {:>15} {:15}",
                format!("{} to {}", number + 2 - block, number + 1),
                quantile(olds(0), 0.5),
                quantile(olds(0), 0.99),
                olds(1).sum::<f64>() / samples.len() as f64,
                ratio(quantile(samples.iter().map(|(old, young)| old[0] / young[0]), 0.5)),
                ratio(olds(1).sum::<f64>() / young_mean),
                resident_kib()
            );
            samples.clear();
        }
    }
}
