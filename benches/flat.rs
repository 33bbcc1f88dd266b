//! Whether an event costs after days of narration what it cost at first: `cargo bench --bench flat -- --events 10000`.
//!
//! One pipeline hears everything. Beside it a young one hears the same, and is replaced after every hundred events, so that each event is
//! measured in an old and in a young pipeline in turn, whatever else the machine does.

#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::time::Instant;

use clap::Parser;
use roomcast::daemon::{Board, Cycle, Entry};
use roomcast::embedded;
use roomcast::grounding::{Grounding, GroundingOptions};
use roomcast::narration::{Observation, Program, Sentence};
use roomcast::pipeline::{Pipeline, PipelineOptions};
use roomcast::scorer::llama::{LlamaModel, LlamaOptions};
use roomcast::semantic_map::SemanticMap;
use roomcast::setup::load_model;
use roomcast_ipc::clock;

/// Events before a young pipeline is measured, and after which it is replaced.
const YOUNG: std::ops::Range<u64> = 10..110;

#[derive(Parser)]
struct Args {
    /// How many events are told.
    #[arg(long, default_value_t = 10_000)]
    events: u64,
    /// Cargo adds it.
    #[arg(long, hide = true)]
    bench: bool,
}

fn cycle() -> Cycle<LlamaModel> {
    let map = SemanticMap::from_json(embedded::scene("apartment-e0").expect("it ships").text).expect("it ships");
    let grounding = Grounding::new(&map, &GroundingOptions::default()).expect("the scene has labels");
    let model = load_model(None, &LlamaOptions::default()).expect("it ships");
    let pipeline = Pipeline::new(model, grounding, PipelineOptions::default()).expect("the context is large enough");
    Cycle::new(Board::new(pipeline, map, GroundingOptions::default(), 1).expect("the rooms fit"), u64::MAX / 2)
}

/// One event in nanoseconds, without the idle work after it.
fn event(cycle: &mut Cycle<LlamaModel>, sequence: u64, sentence: &Sentence) -> u64 {
    let now_ns = clock::monotonic_ns();
    let observation = Observation {
        person: 0,
        source: 1,
        epoch: 1,
        sequence,
        observed_ns: now_ns,
        observed_unix_ns: 0,
        sentence: sentence.clone(),
    };
    let start = Instant::now();
    cycle.enter(Entry { observation, received_ns: now_ns, after_gap: false }, 0);
    cycle.step(now_ns, now_ns).expect("the model scores");
    let forecast = cycle.board().forecast(now_ns);
    let message = cycle.message(now_ns, u64::MAX, false);
    let took_ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
    std::hint::black_box((forecast, message));
    cycle.tidy();
    took_ns
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
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
    let (mut old, mut young) = (cycle(), cycle());
    let mut young_age = 0;
    let (mut olds, mut youngs, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    println!("events           old p50 (us)  young p50 (us)  old / young  resident (KiB)");
    let block = (args.events / 10).max(1);
    for (number, sentence) in (0..args.events).zip(sentences.iter().cycle()) {
        let (mut old_ns, mut young_ns) = (0, 0);
        for turn in 0..2 {
            // Each goes first as often as the other.
            match (turn + number) % 2 {
                0 => old_ns = event(&mut old, number + 1, sentence),
                _ => young_ns = event(&mut young, number + 1, sentence),
            }
        }
        if YOUNG.contains(&young_age) && number >= YOUNG.start {
            olds.push(old_ns as f64 / 1e3);
            youngs.push(young_ns as f64 / 1e3);
            ratios.push(old_ns as f64 / young_ns.max(1) as f64);
        }
        young_age += 1;
        if young_age == YOUNG.end {
            (young, young_age) = (cycle(), 0);
        }
        if (number + 1) % block == 0 {
            let (from, to) = (number + 2 - block, number + 1);
            println!(
                "{:16} {:12.0} {:15.0} {:12.3} {:15}",
                format!("{from} to {to}"),
                median(&mut olds),
                median(&mut youngs),
                median(&mut ratios),
                resident_kib()
            );
            (olds, youngs, ratios) = (Vec::new(), Vec::new(), Vec::new());
        }
    }
}
