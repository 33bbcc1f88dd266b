//! The parts of an event, each by the size that it grows with.
//!
//! `cargo bench --bench parts`; `ROOMCAST_BENCH_MODELS=a.gguf:b.gguf` also measures the scoring with those models.

#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::hint::black_box;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::label_trie::LabelTrie;
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Observation, Program, Sentence, forms};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::places::PlaceMatcher;
use roomcast_core::prompt::{BindingSequence, write_prompt};
use roomcast_core::scorer::correction::Correction;
use roomcast_core::scorer::{LabelScores, LanguageModel, Method, Scorer, TextStart, Tokenisation, softmax};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::tracker::{self, Home, Options, RoomUse, SensorKind, SensorSpec, Tracker};
use roomcast_llama::{LlamaModel, LlamaOptions};
use roomcast_services::embedded;
use roomcast_services::setup::load_model;

fn sentences() -> Vec<String> {
    let programs = embedded::PROGRAMS.iter().flat_map(|p| Program::parse(p.text).expect("it ships").steps);
    programs.map(|action| action.sentence()).collect()
}

fn apartment() -> SemanticMap {
    SemanticMap::from_json(embedded::scene("apartment-e0").expect("it ships").text).expect("it ships")
}

fn model(path: Option<&PathBuf>) -> LlamaModel {
    load_model(path.map(PathBuf::as_path), &LlamaOptions::default()).expect("the model can be loaded")
}

/// `count` different labels of two words known to the model: "mug table", "mug lamp", ...
fn labels(count: usize) -> Vec<String> {
    let words: Vec<String> = apartment().labels().iter().filter(|label| !label.contains(' ')).cloned().collect();
    let side = (count as f64).sqrt().ceil() as usize;
    (0..count).map(|at| format!("{} {}", words[at / side % words.len()], words[at % side % words.len()])).collect()
}

fn trie(criterion: &mut Criterion) {
    let mut scorer = Scorer::new(model(None));
    let mut group = criterion.benchmark_group("trie, built once per map");
    group.sample_size(10);
    for count in [10, 100, 1_000, 10_000] {
        let labels = labels(count);
        let prepared = scorer
            .prepare(&labels, &BindingSequence::default(), Tokenisation::Joint, Correction::default())
            .expect("words");
        group.throughput(Throughput::Elements(count as u64));
        group.bench_function(BenchmarkId::new("of tokens", count), |bencher| {
            bencher.iter_with_large_drop(|| LabelTrie::new(black_box(prepared.tokens())));
        });
        group.bench_function(BenchmarkId::new("cut into tokens and built", count), |bencher| {
            bencher.iter_with_large_drop(|| {
                scorer.prepare(
                    black_box(&labels),
                    &BindingSequence::default(),
                    Tokenisation::Joint,
                    Correction::default(),
                )
            });
        });
    }
    group.finish();
}

fn prompt(criterion: &mut Criterion) {
    let (told, binding, model) = (sentences(), BindingSequence::default(), model(None));
    let mut group = criterion.benchmark_group("prompt, by sentences");
    for count in [4, 16, 64] {
        let narration = || told.iter().cycle().take(count).map(String::as_str);
        let mut text = String::new();
        group.throughput(Throughput::Elements(count as u64));
        group.bench_function(BenchmarkId::new("written", count), |bencher| {
            bencher.iter(|| write_prompt(black_box(narration()), &binding, false, &mut text));
        });
        write_prompt(narration(), &binding, false, &mut text);
        let mut tokens = Vec::new();
        group.bench_function(BenchmarkId::new("cut into tokens whole", count), |bencher| {
            bencher.iter(|| {
                tokens.clear();
                model.tokenise(black_box(&text), TextStart::Sequence, &mut tokens)
            });
        });
        let mut scorer = Scorer::new(self::model(None));
        group.bench_function(BenchmarkId::new("cut into tokens, every sentence known", count), |bencher| {
            bencher.iter(|| scorer.sentence_tokens(black_box(&text)));
        });
    }
    let mut scorer = Scorer::new(self::model(None));
    let mut number = 0_u64;
    group.bench_function("a sentence never heard, cut into tokens", |bencher| {
        let fresh = || {
            number += 1;
            format!("They grab the mug {number}.")
        };
        bencher.iter_batched(fresh, |text| scorer.sentence_tokens(&text), BatchSize::SmallInput);
    });
    group.finish();
}

fn soft_max(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("softmax, by vocabulary");
    for size in [4_096_usize, 32_000, 49_152, 151_936] {
        let row: Vec<f32> = (0..size).map(|at| ((at * 2_654_435_761) % 1_000) as f32 / 50.0 - 10.0).collect();
        group.throughput(Throughput::Elements(size as u64));
        group.bench_function(BenchmarkId::from_parameter(size), |bencher| {
            bencher.iter(|| softmax::log_sum_exp(black_box(&row)));
        });
    }
    group.finish();
}

/// A running narration: each event adds a sentence after the cached history.
struct Told {
    pipeline: Pipeline<LlamaModel>,
    sentences: Vec<Sentence>,
    next: u64,
}

impl Told {
    fn new(model: LlamaModel, grounding: Grounding, options: PipelineOptions) -> Self {
        let pipeline = Pipeline::new(model, grounding, options).expect("the context is large enough");
        let sentences = sentences().iter().map(|text| Sentence::new(text).expect("it is one")).collect();
        let mut told = Self { pipeline, sentences, next: 0 };
        // Until the window has its full length.
        (0..2 * options_window(&told.pipeline)).for_each(|_| told.event());
        told
    }

    fn event(&mut self) {
        let place = usize::try_from(self.next).unwrap_or(0) % self.sentences.len();
        self.next += 1;
        let observation = Observation::of(self.next, self.sentences[place].clone());
        self.pipeline.step([observation]).expect("the model scores");
        while self.pipeline.idle().tidy() {}
    }
}

fn options_window(pipeline: &Pipeline<LlamaModel>) -> usize {
    pipeline.inside().options().history.observations
}

fn event(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("event with the idle work after it");
    group.sample_size(20);
    let grounding = || Grounding::new(&apartment(), &GroundingOptions::default()).expect("the scene has labels");
    for observations in [4, 12, 40] {
        let history = HistoryLimits { observations, ..HistoryLimits::default() };
        let mut told = Told::new(model(None), grounding(), PipelineOptions { history, ..PipelineOptions::default() });
        group.bench_function(BenchmarkId::new("by sentences kept", observations), |bencher| {
            bencher.iter(|| told.event());
        });
    }
    let others = std::env::var("ROOMCAST_BENCH_MODELS").unwrap_or_default();
    for path in std::iter::once(None).chain(others.split(':').filter(|p| !p.is_empty()).map(|p| Some(PathBuf::from(p))))
    {
        let name = path.as_ref().map_or("embedded".into(), |path| path.display().to_string());
        let mut told = Told::new(model(path.as_ref()), grounding(), PipelineOptions::default());
        group.bench_function(BenchmarkId::new("by model", name), |bencher| bencher.iter(|| told.event()));
    }
    group.finish();
}

/// A cached prompt of twelve sentences: its last token and the labels are decoded again, and the labels of the previous round are dropped.
fn scoring(criterion: &mut Criterion) {
    let binding = BindingSequence::default();
    let mut text = String::new();
    write_prompt(sentences().iter().take(12).map(String::as_str), &binding, false, &mut text);
    let mut scorer = Scorer::new(model(None));
    let mut scores = LabelScores::default();
    let mut group = criterion.benchmark_group("labels behind a prompt that is kept");
    group.sample_size(10);
    let two_words = labels(100);
    for method in [Method::Trie, Method::SharedPrefix, Method::Independent] {
        let prepared = scorer.prepare(&two_words, &binding, Tokenisation::Joint, Correction::default()).expect("words");
        group.bench_function(BenchmarkId::new("by method, 100 labels", format!("{method:?}")), |bencher| {
            bencher.iter(|| scorer.score(&prepared, black_box(&text), method, &mut scores).expect("scores"));
        });
    }
    for count in [10, 100, 1_000, 10_000] {
        let labels = labels(count);
        let prepared = scorer.prepare(&labels, &binding, Tokenisation::Joint, Correction::default()).expect("words");
        group.throughput(Throughput::Elements(count as u64));
        group.bench_function(BenchmarkId::new("by labels", count), |bencher| {
            bencher.iter(|| scorer.score(&prepared, black_box(&text), Method::Trie, &mut scores).expect("scores"));
        });
    }
    group.finish();
}

/// Parsing of an event: presence form, count and place.
fn reading(criterion: &mut Criterion) {
    let sentences = sentences();
    let map = SemanticMap::from_json(include_str!("../scenes/flat.json")).expect("it ships");
    let grounding = Grounding::new(&map, &GroundingOptions::default()).expect("it has items");
    let mut places = PlaceMatcher::new(&map, &grounding);
    let mut next = sentences.iter().cycle();
    criterion.bench_function("reading of a sentence", |bencher| {
        bencher.iter(|| {
            let text = next.next().expect("there are some");
            black_box((forms::read(text, |_| false, |_| true), forms::count_of_persons(text), places.last(text)))
        });
    });
}

/// Rooms of the flat around its hall, and their sensors in the same order.
const ROOMS: [(RoomUse, SensorKind); 12] = [
    (RoomUse::Hall, SensorKind::Motion),
    (RoomUse::Bedroom, SensorKind::Motion),
    (RoomUse::Bedroom, SensorKind::Motion),
    (RoomUse::Bedroom, SensorKind::Motion),
    (RoomUse::Bathroom, SensorKind::Motion),
    (RoomUse::Bathroom, SensorKind::Motion),
    (RoomUse::Kitchen, SensorKind::Motion),
    (RoomUse::Living, SensorKind::Presence),
    (RoomUse::Living, SensorKind::Motion),
    (RoomUse::Office, SensorKind::Presence),
    (RoomUse::Other, SensorKind::Motion),
    (RoomUse::Other, SensorKind::Motion),
];

/// Six hours of persons who walk through the hall from room to room: time, sensor and state.
fn walks(persons: usize) -> Vec<(f64, usize, bool)> {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut flips = Vec::new();
    for _ in 0..persons {
        let (mut now_s, mut room) = (0.0_f64, 0);
        while now_s < 21_600.0 {
            room = if room == 0 { random.random_range(1..ROOMS.len()) } else { 0 };
            let stay_s = if room == 0 { 5.0 } else { random.random_range(60.0..2_400.0) };
            flips.push((now_s, room, true));
            let hold_s = if ROOMS[room].1 == SensorKind::Presence { stay_s } else { 0.0 };
            flips.push((now_s + hold_s + random.random_range(20.0..60.0), room, false));
            now_s += stay_s;
        }
    }
    flips.sort_by(|a, b| a.0.total_cmp(&b.0));
    flips
}

/// A sensor's report, by persons in twelve rooms: its own cost, and the cost of the idle time before it.
fn who_is_where(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("who is where, by persons");
    for persons in [1, 2, 4] {
        let uses = ROOMS.map(|(usage, _)| usage);
        let doors: Vec<(usize, usize)> = (1..ROOMS.len()).map(|room| (0, room)).collect();
        let home = Home::new(&uses, &doors, &[1.0]).expect("twelve rooms");
        let mut first = Tracker::new(home, Options::default(), 0.0);
        for person in 0..persons {
            first.add_person().expect("four persons at most");
            let sensor = first.add_sensor(SensorSpec::phone(person)).expect("the person exists");
            first.observe(0.0, &tracker::Observation::Sensor { sensor, on: Some(true) }, 1.0);
        }
        for (room, (_, kind)) in ROOMS.into_iter().enumerate() {
            first.add_sensor(SensorSpec::of_room(kind, room)).expect("the room exists");
        }
        let flips = walks(persons);
        for (name, is_report) in [("report", true), ("idle before it", false)] {
            let (mut own, mut next) = (first.clone(), 0);
            group.bench_function(BenchmarkId::new(name, persons), |bencher| {
                bencher.iter_custom(|count| {
                    let mut spent = Duration::ZERO;
                    for _ in 0..count {
                        if next == flips.len() {
                            (own, next) = (first.clone(), 0);
                        }
                        let (at_s, room, on) = flips[next];
                        let observation = tracker::Observation::Sensor { sensor: persons + room, on: Some(on) };
                        let began = Instant::now();
                        own.settle(at_s);
                        let settled = Instant::now();
                        own.observe(at_s, &observation, 1.0);
                        spent += if is_report { settled.elapsed() } else { settled - began };
                        next += 1;
                    }
                    spent
                });
            });
        }
    }
    group.finish();
}

criterion_group!(benches, reading, who_is_where, trie, prompt, soft_max, event, scoring);
criterion_main!(benches);
