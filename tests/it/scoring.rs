//! The included model through the real scorer: all methods agree on every scene, with or without a kept prompt. Once with the included weights, with
//! kernels that round, and once in single precision, where only the order of sums differs.

use std::collections::HashMap;
use std::sync::Arc;

use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use roomcast_core::grounding::{GroundedScores, Grounding, GroundingOptions};
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::program::Program;
use roomcast_core::narration::{Observation, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::prompt::{BindingSequence, write_prompt};
use roomcast_core::scorer::certified::Effort;
use roomcast_core::scorer::correction::{Continuation, Correction};
use roomcast_core::scorer::{LabelScores, LanguageModel, Method, Scorer, Tokenisation};
use roomcast_core::semantic_map::{SemanticMap, import};
use roomcast_ipc::raw::{forecast_flags, person_flags, score_flags};
use roomcast_llama::gguf::Header;
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions};
use roomcast_services::daemon::{Engine, Entry};
use roomcast_services::embedded;
use roomcast_services::setup::load_model;

/// The included weights, or the same in single precision.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Weights {
    /// Quantised kernels round activations, cache keys and cache values to 127 steps. Another order of sums changes the last bits, and in about one
    /// of a hundred prompts that selects another step: scores then differ by hundredths of a nat.
    Shipped,
    /// The same, with unrounded keys and values in the cache.
    ShippedWithMixedCache,
    /// All in f32: only the order of sums differs.
    SinglePrecision,
}

impl Weights {
    /// Tolerances in nats per token of a label: in any prompt, and in 49 of 50 prompts.
    fn tolerances(self) -> (f64, f64) {
        match self {
            Self::Shipped | Self::ShippedWithMixedCache => (0.05, 2e-3),
            Self::SinglePrecision => (SINGLE_PRECISION_NATS_PER_TOKEN, SINGLE_PRECISION_NATS_PER_TOKEN),
        }
    }

    fn load(self, options: &LlamaOptions) -> LlamaModel {
        match self {
            Self::Shipped => load_model(None, options).unwrap(),
            Self::ShippedWithMixedCache => {
                load_model(None, &LlamaOptions { cache: CacheType::Mixed, ..options.clone() }).unwrap()
            }
            Self::SinglePrecision => single_precision_model(&LlamaOptions { cache: CacheType::F32, ..options.clone() }),
        }
    }
}

fn single_precision_model(options: &LlamaOptions) -> LlamaModel {
    let file = tempfile::Builder::new().suffix(".gguf").tempfile().unwrap();
    std::fs::write(file.path(), single_precision(embedded::MODEL)).unwrap();
    load_model(Some(file.path()), options).unwrap()
}

const SINGLE_PRECISION_NATS_PER_TOKEN: f64 = 1e-5;

/// Converts IQ4_NL tensors of a GGUF file to F32. A block has a half-precision scale and 32 step numbers, the first half in the bytes' lower bits.
fn single_precision(model: &[u8]) -> Vec<u8> {
    const IQ4_NL_BLOCK_BYTES: usize = 18;
    const STEPS: [i8; 16] = [-127, -104, -83, -65, -49, -35, -22, -10, 1, 13, 25, 38, 53, 69, 89, 113];
    const ALIGNMENT_BYTES: usize = 32;
    let header = Header::read(&embedded::ModelFile::create().unwrap().path()).unwrap();
    // Tensor descriptions start with the first tensor's name, and a name starts with its length.
    let first = &header.tensors.iter().min_by_key(|t| t.start).unwrap().name;
    let name = |name: &str| [&(name.len() as u64).to_le_bytes(), name.as_bytes()].concat();
    let wanted = name(first);
    let descriptions = model.windows(wanted.len()).position(|bytes| bytes == wanted).unwrap();
    let (mut out, mut data) = (model[..descriptions].to_vec(), Vec::new());
    for tensor in &header.tensors {
        let bytes = &model[tensor.start as usize..][..tensor.size_bytes as usize];
        out.extend(name(&tensor.name));
        out.extend((tensor.shape.len() as u32).to_le_bytes());
        tensor.shape.iter().for_each(|extent| out.extend(extent.to_le_bytes()));
        out.extend(0_u32.to_le_bytes()); // F32
        out.extend((data.len() as u64).to_le_bytes());
        match tensor.kind {
            "F32" => data.extend_from_slice(bytes),
            "IQ4_NL" => {
                for block in bytes.chunks_exact(IQ4_NL_BLOCK_BYTES) {
                    let scale = half::f16::from_le_bytes([block[0], block[1]]).to_f32();
                    let numbers =
                        block[2..].iter().map(|byte| byte & 15).chain(block[2..].iter().map(|byte| byte >> 4));
                    data.extend(numbers.flat_map(|n| (scale * f32::from(STEPS[usize::from(n)])).to_le_bytes()));
                }
            }
            kind => unreachable!("the shipped model has a tensor of type {kind}; teach this test to write it out"),
        }
        data.resize(data.len().next_multiple_of(ALIGNMENT_BYTES), 0);
    }
    out.resize(out.len().next_multiple_of(ALIGNMENT_BYTES), 0);
    out.extend(data);
    out
}

/// Comparisons, and those rounded to another step.
#[derive(Debug)]
struct Compared {
    weights: Weights,
    all: usize,
    rounded: usize,
    worst: f64,
}

impl Compared {
    fn with(weights: Weights) -> Self {
        Self { weights, all: 0, rounded: 0, worst: 0.0 }
    }

    fn add(&mut self, nats_per_token: f64, what: &str) {
        let (any, most) = self.weights.tolerances();
        assert!(nats_per_token <= any, "{what}, {:?}: {nats_per_token} nats per token apart", self.weights);
        self.all += 1;
        self.rounded += usize::from(nats_per_token > most);
        self.worst = self.worst.max(nats_per_token);
    }

    fn finish(self) {
        println!("{self:?}");
        assert!(self.all > 0 && 50 * self.rounded <= self.all, "not only here and there: {self:?}");
    }
}

fn options(sequences: u32) -> LlamaOptions {
    LlamaOptions { sequences, ..LlamaOptions::default() }
}

fn model(sequences: u32) -> LlamaModel {
    load_model(None, &options(sequences)).unwrap()
}

/// The included scenes, and an office.
fn maps() -> Vec<SemanticMap> {
    let included = embedded::SCENES.iter().map(|scene| SemanticMap::from_json(scene.text).unwrap());
    included.chain([office()]).collect()
}

/// A robot's map of rooms with German names, furnished as usual: the fridge implies the kitchen, the sofa the living room.
#[test]
fn a_robots_map_with_usual_furniture_forecasts_sensibly() {
    let own = include_str!("../data/valetudo.json")
        .replace("{\"segmentId\":\"3\"", "{\"segmentId\":\"3\",\"name\":\"Wohnzimmer\"");
    let map = import::valetudo(&own, "robot", &HashMap::new()).unwrap().furnish(import::Furnish::Typical).unwrap().map;
    let mut likeliest = likeliest_rooms(&map, Correction::default());
    for (said, expected) in [("They open the fridge.", "kitchen"), ("They sit down on the sofa.", "living room")] {
        assert_eq!(likeliest(said), expected, "{said}");
    }
}

fn likeliest_rooms(map: &SemanticMap, correction: Correction) -> impl FnMut(&str) -> String {
    let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
    let (mut scorer, binding) = (Scorer::new(model(24)), BindingSequence::default());
    let prepared = scorer.prepare(&grounding.label_texts(), &binding, Tokenisation::Joint, correction).unwrap();
    let (mut prompt, mut scores, mut grounded) = (String::new(), LabelScores::default(), GroundedScores::default());
    move |said| {
        write_prompt([said], &binding, false, &mut prompt);
        scorer.score(&prepared, &prompt, Method::Trie, &mut scores).unwrap();
        grounding.ground(&scores.log_prob_nats, &mut grounded).unwrap();
        let likeliest = (grounding.partitions().iter().zip(&grounded.partition_probability))
            .max_by(|a, b| a.1.total_cmp(b.1))
            .map(|(partition, _)| partition.label.clone());
        likeliest.unwrap()
    }
}

/// Sentences in other people's words and from captioning models. In the flat, all but two put the expected room first.
#[test]
fn sentences_of_others_are_understood() {
    use roomcast_core::scorer::LanguageModel;
    let said = [
        ("The woman takes a shower and dries herself with a towel.", "bathroom"),
        ("A person is taking a shower.", "bathroom"),
        ("A person is brushing his teeth.", "bathroom"),
        ("A person is using the toilet.", "bathroom"),
        ("Anna goes to sleep.", "bedroom"),
        ("They sleep.", "bedroom"),
        ("He gets into bed.", "bedroom"),
        ("A man opens the refrigerator and takes out a bottle of milk.", "kitchen"),
        ("Someone is heading over to the bathroom.", "bathroom"),
        ("She chops vegetables on a cutting board.", "kitchen"),
        ("Someone is pouring a cup of coffee in the kitchen.", "kitchen"),
        ("A woman turns the television on and sits down on the couch.", "living room"),
        ("He is watching a film on the sofa.", "living room"),
        ("She puts her shoes and her coat on.", "corridor"),
        ("Somebody types on the keyboard.", "home office"),
        ("A man loads the washing machine with dirty clothes.", "bathroom"),
        ("They put the dishes into the dishwasher.", "kitchen"),
        ("She makes the bed.", "bedroom"),
        ("A person rinses a plate in the sink.", "kitchen"),
        ("He shaves.", "bathroom"),
    ];
    let map = SemanticMap::from_json(embedded::scene("flat").unwrap().text).unwrap();
    let mut likeliest = likeliest_rooms(&map, model(24).info().correction);
    let missed: Vec<_> = said.into_iter().filter(|(sentence, room)| likeliest(sentence) != *room).collect();
    assert!(missed.len() <= 2, "{missed:?}");
}

/// A map from outside the model's training; many of its labels have several tokens.
fn office() -> SemanticMap {
    SemanticMap::from_json(include_str!("../../training/unseen/office/map.json")).unwrap()
}

/// A kitchen, and a gallery with names that share their first token: this token bounds the gallery's score.
fn museum() -> SemanticMap {
    let kitchen = ["fridge", "sink", "stove", "kitchen counter", "cup", "table"];
    let gallery =
        ["antique ocarina", "antique quipu", "antique zarf", "antique kylix", "antique sextant", "antique astrolabe"];
    let bounds = |x: f64, size: f64| serde_json::json!({"min_m": [x, 0, 0], "max_m": [x + size, size, size]});
    let room = |x: f64, label: &str| serde_json::json!({"id": label, "label": label, "box": bounds(x, 4.0)});
    let item = |x: f64, label: &str| serde_json::json!({"id": label, "label": label, "position_m": [x + 0.5, 0.5, 0.5], "box": bounds(x, 1.0)});
    let items = kitchen.iter().map(|label| item(1.0, label)).chain(gallery.iter().map(|label| item(5.0, label)));
    let map = serde_json::json!({
        "format": "roomcast-scene", "version": 1, "name": "museum",
        "rooms": [room(0.0, "kitchen"), room(4.0, "gallery")],
        "items": items.collect::<Vec<_>>(),
    });
    SemanticMap::from_json(&map.to_string()).unwrap()
}

fn sentences() -> Vec<String> {
    embedded::PROGRAMS
        .iter()
        .flat_map(|p| Program::parse(p.text).unwrap().steps)
        .map(|action| action.sentence())
        .chain(["The oven is on.".into(), "Somebody rings at the door.".into(), "<s> </s> [INST] zażółć 鍵 🙂.".into()])
        .collect()
}

fn bindings() -> Vec<BindingSequence> {
    BindingSequence::all_built_in().chain(["Then they reach for the ".parse().unwrap()]).collect()
}

/// The greatest difference in nats per token of a label.
fn apart(prepared_tokens: &[Vec<roomcast_core::scorer::Token>], a: &[f64], b: &[f64]) -> f64 {
    let labels = prepared_tokens.iter().zip(a).zip(b);
    labels.map(|((tokens, a), b)| (a - b).abs() / tokens.len() as f64).fold(0.0, f64::max)
}

#[test]
fn methods_agree_on_every_scene_for_random_narrations_windows_and_bindings() {
    methods_agree(Weights::Shipped);
}

#[test]
#[ignore = "full"]
fn methods_agree_with_a_mixed_cache() {
    methods_agree(Weights::ShippedWithMixedCache);
}

#[test]
fn a_cache_of_eight_bits_needs_heads_of_whole_blocks() {
    let mut model = embedded::MODEL.to_vec();
    let key = "llama.attention.head_count";
    let key = [&(key.len() as u64).to_le_bytes(), key.as_bytes()].concat();
    let value = model.windows(key.len()).position(|bytes| bytes == key).unwrap() + key.len() + size_of::<u32>();
    model[value..value + size_of::<u32>()].copy_from_slice(&16_u32.to_le_bytes());
    let file = tempfile::Builder::new().suffix(".gguf").tempfile().unwrap();
    std::fs::write(file.path(), model).unwrap();
    let options = LlamaOptions { cache: CacheType::Q8, ..LlamaOptions::default() };
    let error = load_model(Some(file.path()), &options).unwrap_err().to_string();
    assert!(
        error.contains("heads of 24 numbers are not whole blocks of 32") && error.contains("choose \"mixed\""),
        "{error}"
    );
}

#[test]
#[ignore = "full"]
fn methods_agree_in_single_precision_to_the_last_digits() {
    methods_agree(Weights::SinglePrecision);
}

/// Single-precision weights add no rounding, so the differences are the caches'.
#[test]
#[ignore = "full"]
fn smaller_caches_move_scores_by_no_more_than_they_say() {
    let caches = [(CacheType::Mixed, 1e-2), (CacheType::F16, 1e-2), (CacheType::Q8, 5e-2)];
    let load = |cache| Scorer::new(single_precision_model(&LlamaOptions { cache, ..options(64) }));
    let mut single = load(CacheType::F32);
    let grounding = Grounding::new(&maps()[0], &GroundingOptions::default()).unwrap();
    let binding = BindingSequence::default();
    let labels = grounding.label_texts();
    let prepared = single.prepare(&labels, &binding, Tokenisation::Joint, Correction::default()).unwrap();
    let (mut scores, mut other) = (LabelScores::default(), LabelScores::default());
    let sentences = sentences();
    for (cache, most_nats) in caches {
        let mut smaller = load(cache);
        let (mut prompt, mut worst) = (String::new(), 0.0_f64);
        for window in sentences.windows(12) {
            write_prompt(window.iter().map(String::as_str), &binding, false, &mut prompt);
            smaller.score(&prepared, &prompt, Method::Trie, &mut scores).unwrap();
            single.score(&prepared, &prompt, Method::Trie, &mut other).unwrap();
            worst = worst.max(apart(prepared.tokens(), &scores.log_prob_nats, &other.log_prob_nats));
        }
        println!("{cache:?}: {worst} nats per token");
        assert!(worst > 0.0, "{cache:?} is single precision");
        assert!(worst < most_nats, "{cache:?}: {worst} nats per token");
    }
}

fn methods_agree(weights: Weights) {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
    let (sentences, bindings) = (sentences(), bindings());
    // With few sequences the trie, and more so the chains, need several waves.
    let mut scorer = Scorer::new(weights.load(&options(24)));
    let mut fresh = Scorer::new(weights.load(&options(64)));
    let (mut scores, mut other) = (LabelScores::default(), LabelScores::default());
    let mut compared = Compared::with(weights);
    for map in maps() {
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        for round in 0..5 {
            let binding = bindings.choose(&mut rng).unwrap();
            let tokenisation = if round >= 3 { Tokenisation::Paper } else { Tokenisation::Joint };
            let corrected = Correction { continuation: Continuation::Labels, prior: 0.4 };
            let correction = if round == 1 || round == 4 { corrected } else { Correction::default() };
            let prepared = scorer.prepare(&grounding.label_texts(), binding, tokenisation, correction).unwrap();
            let mut prompt = String::new();
            let mut window: Vec<&str> = Vec::new();
            // One scorer follows a sliding window, the other starts fresh for each event.
            for event in 0..5 {
                window.push(sentences.choose(&mut rng).unwrap());
                let keep = rng.random_range(1..=16);
                let cut = window.len().saturating_sub(keep);
                write_prompt(window[cut..].iter().copied(), binding, tokenisation == Tokenisation::Paper, &mut prompt);
                scorer.score(&prepared, &prompt, Method::Trie, &mut scores).unwrap();
                fresh.forget();
                fresh.score(&prepared, &prompt, Method::Trie, &mut other).unwrap();
                let what = format!("{} {:?} {event}", map.name(), binding.text());
                compared.add(apart(prepared.tokens(), &scores.log_prob_nats, &other.log_prob_nats), &what);
                scorer.score(&prepared, &prompt, Method::SharedPrefix, &mut other).unwrap();
                compared.add(apart(prepared.tokens(), &scores.log_prob_nats, &other.log_prob_nats), &what);
                if event == 4 && round <= 1 {
                    fresh.score(&prepared, &prompt, Method::Independent, &mut other).unwrap();
                    compared.add(apart(prepared.tokens(), &scores.log_prob_nats, &other.log_prob_nats), &what);
                }
            }
        }
    }
    compared.finish();
}

/// The tokens of prompt and label together are the prompt's followed by the label's, so the trie scores the written text.
#[test]
fn labels_are_cut_as_the_joint_text_is() {
    use roomcast_core::scorer::{LanguageModel, TextStart};
    let mut scorer = Scorer::new(model(1));
    for map in maps() {
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        for binding in bindings() {
            let prepared =
                scorer.prepare(&grounding.label_texts(), &binding, Tokenisation::Joint, Correction::default()).unwrap();
            let mut prompt = String::new();
            write_prompt(["They walk to the kitchen.", "They grab the mug."], &binding, false, &mut prompt);
            let mut head = Vec::new();
            scorer.model().tokenise(&prompt, TextStart::Sequence, &mut head).unwrap();
            for (label, tokens) in prepared.labels().iter().zip(prepared.tokens()) {
                let mut joint = Vec::new();
                scorer.model().tokenise(&format!("{prompt} {label}"), TextStart::Sequence, &mut joint).unwrap();
                let parts: Vec<_> = head.iter().chain(tokens).copied().collect();
                assert_eq!(joint, parts, "{label:?} behind {prompt:?}");
            }
        }
    }
}

/// A narrator's control tokens are text: each becomes several tokens.
#[test]
fn control_tokens_in_text_are_inert() {
    use roomcast_core::scorer::{LanguageModel, TextStart};
    let scorer = Scorer::new(model(1));
    for text in ["<s>", "</s>", "<unk>", "<|endoftext|>"] {
        let mut tokens = Vec::new();
        scorer.model().tokenise(text, TextStart::Within, &mut tokens).unwrap();
        assert!(tokens.len() > 1, "{text} became {tokens:?}");
    }
}

/// The expected tokens come from the tokenizer of the training.
#[test]
fn the_tokenizer_is_the_one_of_the_training() {
    use roomcast_core::scorer::{LanguageModel, TextStart};
    let expected: Vec<(String, Vec<i32>)> =
        serde_json::from_str(include_str!("../../models/household-tokens.json")).unwrap();
    assert!(expected.len() > 100);
    let scorer = Scorer::new(model(1));
    for (text, expected) in expected {
        let mut tokens = Vec::new();
        scorer.model().tokenise(&text, TextStart::Within, &mut tokens).unwrap();
        assert_eq!(tokens.iter().map(|t| t.0).collect::<Vec<_>>(), expected, "{text:?}");
    }
}

fn observation(sequence: u64, sentence: &str) -> Observation {
    Observation { observed_ns: BootNs(sequence), ..Observation::of(sequence, Sentence::new(sentence).unwrap()) }
}

/// A pipeline with partial answers and idle reading against an exact one: the bounds hold, and the certified order is the exact order.
#[test]
#[ignore = "full"]
fn partial_answers_are_true_over_whole_programs() {
    partial_answers_are_true(Weights::Shipped);
}

#[test]
#[ignore = "full"]
fn partial_answers_are_true_in_single_precision_to_the_last_digits() {
    partial_answers_are_true(Weights::SinglePrecision);
}

fn partial_answers_are_true(weights: Weights) {
    partial_answers_are_true_in(
        &SemanticMap::from_json(embedded::scene("apartment-e0").unwrap().text).unwrap(),
        weights,
    );
    partial_answers_are_true_in(&office(), weights);
    // In the apartment every label is one token, so all answers are exact. In the office, early ends depend on the model.
    assert!(partial_answers_are_true_in(&museum(), weights) > 0, "answers end early in the museum");
}

/// The number of answers that ended before all labels were scored.
fn partial_answers_are_true_in(map: &SemanticMap, weights: Weights) -> usize {
    let mut early = 0;
    let pipeline = |effort| {
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        let options = PipelineOptions { effort, history: HistoryLimits::default(), ..PipelineOptions::default() };
        Pipeline::new(weights.load(&self::options(64)), grounding, options).unwrap()
    };
    let mut exact = pipeline(Effort::Exact);
    let mut compared = Compared::with(weights);
    for effort in [Effort::Ranking, Effort::Top, Effort::Deadline] {
        let mut exact_scores = Vec::new();
        let mut partial = pipeline(effort);
        exact.intake().forget_person(PersonId(0));
        for (sequence, sentence) in (0..).zip(sentences()) {
            let truth = exact.step([observation(sequence, &sentence)]).unwrap();
            exact_scores.clone_from(&truth.grounded.partition_log_score_nats);
            while exact.idle().tidy() {}
            // A slow machine keeps the last scores for a step.
            if partial.step([observation(sequence, &sentence)]).unwrap().is_cut {
                partial.score().unwrap();
            }
            let scores = partial.scores();
            early += usize::from(scores.reached != Effort::Exact);
            for (r, &exact) in exact_scores.iter().enumerate() {
                let (lower, upper) = (scores.lower_log_score_nats[r], scores.upper_log_score_nats[r]);
                compared.add((lower - exact).max(exact - upper).max(0.0), "a bound");
            }
            let order = |values: &[f64]| {
                let mut order: Vec<usize> = (0..values.len()).collect();
                order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
                order
            };
            let margin =
                order(&exact_scores).windows(2).map(|w| exact_scores[w[0]] - exact_scores[w[1]]).fold(9.0, f64::min);
            if scores.reached == Effort::Ranking && margin > weights.tolerances().0 {
                assert_eq!(order(&scores.grounded.partition_log_score_nats), order(&exact_scores));
            }
            while partial.idle().tidy() {}
        }
    }
    compared.finish();
    early
}

/// After eight hours of sleep, the evening's sentences no longer affect the scores, and the forecast still has the sleeper in the bedroom.
#[test]
fn what_lies_hours_back_does_not_say_what_comes_next() {
    const S: u64 = 1_000_000_000;
    let map = SemanticMap::from_json(embedded::scene("apartment-e0").unwrap().text).unwrap();
    let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
    let pipeline = || Pipeline::new(model(64), grounding.clone(), PipelineOptions::default()).unwrap();
    let room = |id: &str| grounding.partitions().iter().position(|partition| partition.id == id).unwrap();
    let (kitchen, bedroom) = (room("kitchen"), room("bedroom"));
    let mut engine = Engine::new(pipeline(), map.clone(), GroundingOptions::default(), 1).unwrap();
    let evening = ["They open the fridge.", "They grab the milk.", "They lie on the bed.", "They fall asleep."];
    for (sequence, sentence) in (1..).zip(evening) {
        let observation =
            Observation { observed_ns: BootNs((1000 + 20 * sequence) * S), ..observation(sequence, sentence) };
        let now_ns = observation.observed_ns;
        engine.step([Entry::new(observation, now_ns)], now_ns, UnixNs(now_ns.0)).unwrap();
    }
    let evening = engine.snapshot().rooms()[kitchen].probability;
    let morning_ns = (1080 + 8 * 3600) * S;
    assert!(!engine.is_overdue(BootNs((1080 + 3600) * S)) && engine.is_overdue(BootNs(morning_ns)));
    engine.step([], BootNs(morning_ns), UnixNs(morning_ns)).unwrap();
    assert!(!engine.is_overdue(BootNs(morning_ns)) && engine.snapshot().window == 0);
    let mut unknown = pipeline();
    let unknown = &unknown.score().unwrap().grounded.partition_probability;
    for (room, unknown) in engine.snapshot().rooms().iter().zip(unknown) {
        assert!((room.probability - unknown).abs() < 1e-3, "{}: {} {unknown}", room.id(), room.probability);
    }
    let forecast = engine.forecast(BootNs(morning_ns));
    println!("kitchen {evening:.3} in the evening, {:.3} in the morning", unknown[kitchen]);
    println!(
        "bedroom now {:.3}, in a quarter of an hour {:.3}",
        forecast.probability[bedroom][0], forecast.probability[bedroom][13]
    );
    assert!(unknown[kitchen] < 0.6, "{unknown:?}");
    assert!(forecast.probability[bedroom][0] > 0.8, "{:?}", forecast.probability[bedroom]);
}

#[test]
fn contexts_grow_for_longer_prompts_and_score_them_alike() {
    use roomcast_core::scorer::LanguageModel;
    let mut grown = Scorer::new(single_precision_model(&LlamaOptions { cache: CacheType::F32, ..options(8) }));
    let mut whole = Scorer::new(single_precision_model(&LlamaOptions { cache: CacheType::F32, ..options(8) }));
    let limit = whole.model().info().context_tokens;
    whole.reserve(limit).unwrap();
    grown.reserve(1).unwrap();
    let least = grown.model().positions();
    assert!((least as usize) < limit && whole.model().positions() as usize == limit);
    let binding = BindingSequence::default();
    let labels = ["mug", "washing machine"];
    let prepared = grown.prepare(&labels, &binding, Tokenisation::Joint, Correction::default()).unwrap();
    let (mut scores, mut other) = (LabelScores::default(), LabelScores::default());
    for prompt in ["They walk. Next, they go to the".to_owned(), "They walk to the sink. ".repeat(100) + binding.text()]
    {
        grown.score(&prepared, &prompt, Method::Trie, &mut scores).unwrap();
        whole.score(&prepared, &prompt, Method::Trie, &mut other).unwrap();
        let apart = apart(prepared.tokens(), &scores.log_prob_nats, &other.log_prob_nats);
        assert!(apart < SINGLE_PRECISION_NATS_PER_TOKEN, "{apart}");
    }
    assert!(grown.model().positions() > least, "the second prompt is longer than the least context");
    grown.reserve(1).unwrap();
    assert_eq!(grown.model().positions(), least);
    grown.score(&prepared, "They walk. Next, they go to the", Method::Trie, &mut scores).unwrap();
}

#[test]
fn a_prompt_that_does_not_fit_is_refused_and_the_next_one_works() {
    let small = LlamaOptions { context_tokens: 64, ..options(8) };
    let mut scorer = Scorer::new(load_model(None, &small).unwrap());
    let prepared = scorer
        .prepare(&["mug", "washing machine"], &BindingSequence::default(), Tokenisation::Joint, Correction::default())
        .unwrap();
    let mut scores = LabelScores::default();
    let error = scorer.score(&prepared, &"They walk. ".repeat(100), Method::Trie, &mut scores).unwrap_err();
    assert!(error.to_string().contains("context"), "{error}");
    scorer.score(&prepared, "They walk. Next, they go to the", Method::Trie, &mut scores).unwrap();
    assert!(scores.log_prob_nats.iter().all(|p| p.is_finite() && *p < 0.0));
}

/// A prefetched answer equals the later one within the cache's rounding, over hits, misses and cut windows.
fn prepared_answers_are_those_computed_afterwards(weights: Weights) {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(26);
    let map = &maps()[0];
    let pipeline = || {
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        Pipeline::new(weights.load(&options(64)), grounding, PipelineOptions::default()).unwrap()
    };
    let (mut ahead, mut behind) = (pipeline(), pipeline());
    let mut aside = ahead.inside().preparer(Arc::new(|| false)).unwrap().unwrap();
    let sentences = sentences();
    let (mut used, mut compared) = (0, Compared::with(weights));
    for sequence in 1..=60 {
        let said = sentences.choose(&mut rng).unwrap();
        if sequence > 1 {
            while ahead.idle().tidy() {}
            let mut guesses: Vec<&String> = sentences.sample(&mut rng, 6).collect();
            if rng.random_bool(0.5) {
                guesses.insert(rng.random_range(0..guesses.len()), said);
            }
            let outlook = ahead.idle().outlook();
            for guess in guesses {
                let ask = aside.ask(&outlook, PersonId(0), &Sentence::new(guess).unwrap()).unwrap();
                let answer = aside.answer(ask).unwrap();
                assert!(ahead.idle().keep_answer(answer));
            }
        }
        used += ahead.step([observation(sequence, said)]).unwrap().prepared;
        while behind.idle().tidy() {}
        behind.step([observation(sequence, said)]).unwrap();
        let tokens = ahead.inside().prepared().tokens();
        let nats = apart(tokens, &ahead.scores().label_log_prob_nats, &behind.scores().label_log_prob_nats);
        compared.add(nats, &format!("sentence {sequence}"));
    }
    assert!(used >= 20, "{used} of 60 were prepared");
    compared.finish();
}

#[test]
fn prepared_answers_of_the_shipped_model_are_those_computed_afterwards() {
    prepared_answers_are_those_computed_afterwards(Weights::Shipped);
}

#[test]
#[ignore = "full"]
fn prepared_answers_in_single_precision_are_the_same_to_the_last_digits() {
    prepared_answers_are_those_computed_afterwards(Weights::SinglePrecision);
}

/// The sets of `training/unfamiliar.txt`, each with its sentences.
fn unfamiliar() -> impl Iterator<Item = (&'static str, Vec<&'static str>)> {
    let sets = include_str!("../../training/unfamiliar.txt").split("\n[").skip(1);
    sets.filter_map(|set| set.split_once("]\n"))
        .map(|(name, text)| (name, text.lines().filter(|l| !l.is_empty()).collect()))
}

/// Nothing is fitted on these texts.
#[test]
fn other_languages_code_and_nonsense_are_flagged_and_plain_sentences_are_not() {
    let mut pipeline = Pipeline::of(&studio(), model(64)).unwrap();
    let mut sets = 0;
    for (name, sentences) in unfamiliar() {
        let mut trust = |sentence: &&str| {
            pipeline.intake().forget_person(PersonId(0));
            pipeline.step([observation(1, sentence)]).unwrap().trust
        };
        let trusts: Vec<f64> = sentences.iter().map(&mut trust).collect();
        match name {
            "known: other wordings" => assert!(trusts.iter().all(|trust| *trust == 1.0), "{name}: {trusts:?}"),
            // Sentences of known words with one unknown thing.
            "unknown words" => assert!(trusts.iter().any(|trust| *trust < 1.0), "{name}: {trusts:?}"),
            _ => assert!(trusts.iter().all(|trust| *trust < 1.0), "{name}: {trusts:?}"),
        }
        sets += 1;
    }
    assert_eq!(sets, 15);
}

fn studio() -> SemanticMap {
    SemanticMap::from_json(embedded::SCENES[0].text).unwrap()
}

#[test]
fn a_map_of_unknown_words_is_flagged_whatever_is_narrated() {
    let mut map: serde_json::Value = serde_json::from_str(embedded::SCENES[0].text).unwrap();
    for item in map["items"].as_array_mut().unwrap() {
        let backwards: String = item["label"].as_str().unwrap().chars().rev().collect();
        item["label"] = backwards.into();
    }
    let map = SemanticMap::from_json(&map.to_string()).unwrap();
    let mut pipeline = Pipeline::of(&map, model(64)).unwrap();
    assert!(pipeline.step([observation(1, "They open the fridge.")]).unwrap().trust < 1.0);
}

fn studio_engine(model: LlamaModel) -> Engine<LlamaModel> {
    let (map, options) = (studio(), GroundingOptions::default());
    let grounding = Grounding::new(&map, &options).unwrap();
    let options_of = PipelineOptions { history: HistoryLimits::default(), ..PipelineOptions::default() };
    Engine::new(Pipeline::new(model, grounding, options_of).unwrap(), map, options, 1).unwrap()
}

/// Narrates a second later each, and returns the flags of scores, forecast and person, and the probability of each room a minute after the last one.
fn narrated(engine: &mut Engine<LlamaModel>, from_s: u64, sentences: &[&str]) -> ([u32; 3], Vec<f64>) {
    let mut now_ns = BootNs(0);
    for (sequence, sentence) in (from_s..).zip(sentences) {
        now_ns = BootNs(sequence * 1_000_000_000);
        let observation = Observation { observed_ns: now_ns, ..observation(sequence, sentence) };
        engine.step([Entry::new(observation, now_ns)], now_ns, UnixNs(now_ns.0)).unwrap();
    }
    let person = engine.person_scores(now_ns).persons()[0].flags;
    let forecast = engine.forecast(now_ns);
    let minute = forecast.horizons_s().iter().position(|horizon_s| *horizon_s == 60.0).unwrap();
    let rooms = forecast.rooms().map(|(_, row)| f64::from(row[minute])).collect();
    ([engine.snapshot().flags, engine.forecast(now_ns).flags, person], rooms)
}

#[test]
fn a_forecast_after_a_sentence_in_another_language_stays_in_the_known_room_and_says_so() {
    let mut engine = studio_engine(model(64));
    narrated(&mut engine, 1, &["They open the fridge."]);
    let (flags, known) = narrated(&mut engine, 2, &["They close the fridge."]);
    assert_eq!(flags, [0; 3]);
    let german = ["Sie gehen ins Wohnzimmer.", "Sie schalten den Fernseher ein.", "Sie nehmen ein Buch aus dem Regal."];
    let (flags, unfamiliar) = narrated(&mut engine, 3, &german);
    assert_eq!(flags, [score_flags::UNFAMILIAR, forecast_flags::UNFAMILIAR, person_flags::UNFAMILIAR]);
    let likeliest = |rooms: &[f64]| (0..rooms.len()).max_by(|a, b| rooms[*a].total_cmp(&rooms[*b])).unwrap();
    assert_eq!(likeliest(&unfamiliar), likeliest(&known), "{known:?} {unfamiliar:?}");
    // Known words around it make up for it.
    let english =
        ["They open the cupboard.", "They take a cup.", "They walk to the table.", "They sit down on the chair."];
    let (flags, _) = narrated(&mut engine, 6, &[english, english].concat());
    assert_eq!(flags, [0; 3]);
}

/// The included model with the rows of all its matrices in reverse order: random weights of the right sizes.
fn reversed(model: &[u8]) -> Vec<u8> {
    let header = Header::read(&embedded::ModelFile::create().unwrap().path()).unwrap();
    let mut reversed = model.to_vec();
    for tensor in header.tensors.iter().filter(|tensor| tensor.shape.len() > 1) {
        let (start, size) = (tensor.start as usize, tensor.size_bytes as usize);
        let row_bytes = size / tensor.shape[1..].iter().product::<u64>() as usize;
        let rows = model[start..start + size].chunks_exact(row_bytes).rev();
        reversed[start..start + size].copy_from_slice(&rows.flatten().copied().collect::<Vec<_>>());
    }
    reversed
}

#[test]
fn scores_of_a_model_with_random_weights_are_flagged_and_no_part_of_a_forecast() {
    let load = |bytes: &[u8]| {
        let file = tempfile::Builder::new().suffix(".gguf").tempfile().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        load_model(Some(file.path()), &options(64)).unwrap()
    };
    assert_eq!(load(embedded::MODEL).info().weakness, None);
    let random = load(&reversed(embedded::MODEL));
    let reason = random.info().weakness.clone().unwrap();
    assert!(reason.contains("twelve common things"), "{reason}");
    let mut engine = studio_engine(random);
    let (flags, rooms) = narrated(&mut engine, 1, &["They open the fridge.", "They close the fridge."]);
    assert_eq!(flags, [score_flags::MODEL_WEAK, forecast_flags::MODEL_WEAK, person_flags::UNFAMILIAR]);
    let kitchen = engine.snapshot().rooms().iter().position(|room| room.id() == "kitchen").unwrap();
    assert!(rooms.iter().all(|p| *p <= rooms[kitchen]), "{rooms:?}");
}
