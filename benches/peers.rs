//! Roomcast's side of the comparison with its peers (`benches/peers/run`): one running narration, one event per input line.
//!
//! Arguments: method or `ranking` (the trie until the order of the rooms is certain), model file or `-` for the embedded one, cache, scene, threads,
//! observations in the window, program files. The first output line has the labels and their tokens. Every input line runs one event; the answer has
//! its prompt, its log-probabilities in nats and its time, from the sentence to the scores of the rooms.

#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::program::Program;
use roomcast_core::narration::{Observation, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::scorer::Method;
use roomcast_core::scorer::certified::Effort;
use roomcast_core::scorer::correction::CorrectionChoice;
use roomcast_llama::{CacheType, LlamaOptions};
use roomcast_services::setup;
use serde_json::json;
use std::str::FromStr;

fn main() {
    // Cargo adds `--bench`.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let [method, model, cache, scene, threads, observations, programs @ ..] = arguments.as_slice() else {
        println!("peers: run by benches/peers/run");
        return;
    };
    let map = setup::load_map(Some(Path::new(scene))).expect("a scene");
    let grounding = Grounding::new(&map, &GroundingOptions::default()).expect("a scene that can be grounded");
    let threads = threads.parse().expect("a number of threads");
    let cache = CacheType::from_str(cache).expect("a cache type");
    let options = LlamaOptions { threads, cache, ..LlamaOptions::default() };
    let model = setup::load_model((model != "-").then_some(Path::new(model)), &options).expect("a model");
    let observations = observations.parse().expect("a number of observations");
    let ranking = method == "ranking";
    let options = PipelineOptions {
        method: if ranking { Method::Trie } else { Method::from_str(method).expect("a method") },
        effort: if ranking { Effort::Ranking } else { Effort::Exact },
        history: HistoryLimits { observations, ..HistoryLimits::default() },
        // The peers compute Equation 1.
        correction: CorrectionChoice::EQUATION_1,
        ..PipelineOptions::default()
    };
    let mut pipeline = Pipeline::new(model, grounding, options).expect("a model that fits the scene");
    let sentences: Vec<Sentence> = programs
        .iter()
        .flat_map(|program| Program::load(Path::new(program)).expect("a program").steps)
        .map(|action| Sentence::new(&action.sentence()).expect("a sentence"))
        .collect();
    let mut narration =
        (0..).zip(sentences.iter().cycle()).map(|(sequence, sentence)| Observation::of(sequence, sentence.clone()));
    pipeline.intake().observe(narration.by_ref().take(observations));
    let mut output = std::io::stdout().lock();
    let labels = pipeline.inside().prepared();
    writeln!(output, "{}", json!({"labels": labels.labels(), "tokens": labels.tokens()})).expect("a reader");
    for line in std::io::stdin().lock().lines() {
        line.expect("a line");
        let observation = narration.next().expect("narration without end");
        let start = Instant::now();
        pipeline.step([observation]).expect("scores");
        let event_ns = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
        let mut prompt = String::new();
        for (_, sentence) in pipeline.inside().read_sentences() {
            prompt.push_str(sentence);
            prompt.push(' ');
        }
        prompt.push_str(pipeline.inside().options().binding.stem());
        let scores = pipeline.scores();
        let answer = json!({
            "ns": event_ns, "prompt": prompt, "prompt_tokens": scores.prompt_tokens,
            "log_prob_nats": scores.label_log_prob_nats,
        });
        while pipeline.idle().tidy() {}
        writeln!(output, "{answer}").expect("a reader");
    }
}
