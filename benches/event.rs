//! Cost of one event compared with plain llama.cpp: `cargo bench --bench event` (`-- --help` lists the options).
//!
//! The bench narrates each shipped program in each apartment. At every event it times four things in turn, so that other load on the machine affects
//! all of them alike:
//!
//! - all work of the daemon from a received event to published exact scores, and to a certain order of the rooms
//!   (`ranking`);
//! - llama.cpp alone in a context with the same parameters: one decoder call with the same new tokens and the same inner nodes of the
//!   label trie, and one with the new tokens alone. Only the call is timed, neither filling its batch nor reading its rows.
//!
//! The bench compares the scores of both, to check that they do the same work. The last table compares the event with the bare products of its
//! matrices.

#![expect(unsafe_code, reason = "an allocator that counts, and ggml's functions")]
#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use clap::Parser;
use comfy_table::{ContentArrangement, Table, presets};
use llama_cpp_2::context::LlamaContext;
use llama_cpp_2::llama_batch::LlamaBatch;
use llama_cpp_2::model::LlamaModel as Weights;
use llama_cpp_2::model::params::LlamaModelParams;
use llama_cpp_2::token::LlamaToken;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::ids::PersonId;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::label_trie::{LabelTrie, PROMPT, TokenTree};
use roomcast_core::narration::history::HistoryLimits;
use roomcast_core::narration::{Action, Program};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::prompt::write_prompt;
use roomcast_core::scorer::certified::Effort;
use roomcast_core::scorer::correction::CorrectionChoice;
use roomcast_core::scorer::{LanguageModel, Token, common_prefix};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::raw::{ForecastV1, NarrationV1, RoomScoresV1, narration_kind};
use roomcast_ipc::{Domain, Publisher, Sender, Subscriber, clock};
use roomcast_llama::{CacheType, LlamaModel, LlamaOptions, backend};
use roomcast_services::config::IntakeLimits;
use roomcast_services::daemon::{Cycle, Engine, Entry, Intake, Taken};
use roomcast_services::embedded::{self, ModelFile};

use crate::products::Products;

#[path = "event/products.rs"]
mod products;

/// Events at the beginning of each program that are not counted.
const WARM_UP: usize = 3;
/// Largest difference of the scores, in nats per label: batches of another size use other kernels.
const TOLERANCE_NATS: f64 = 0.1;
/// Tokens of the bare products: fewer reach fewer operations per second, and longer calls are interrupted more often.
const MANY_TOKENS: usize = 32;

/// Allocations of Rust code. Those of llama.cpp are not in it.
static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);

struct Counting;

// SAFETY: the system's allocator does all the work.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller keeps the contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: `alloc` gave this memory.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[derive(Parser)]
struct Args {
    /// How often to narrate each program in each apartment.
    #[arg(long, default_value_t = 2)]
    rounds: usize,
    /// A GGUF model; by default the embedded household model.
    #[arg(long)]
    model: Option<PathBuf>,
    /// Threads of one decoder call; by default those of the product.
    #[arg(long)]
    threads: Option<usize>,
    /// Type of the key-value cache in all contexts.
    #[arg(long, default_value_t)]
    cache: CacheType,
    /// Cargo passes it to every bench.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Plain llama.cpp.
struct Bare<'a> {
    context: LlamaContext<'a>,
    batch: LlamaBatch<'static>,
    sequences: i32,
    kept: Vec<Token>,
}

impl<'a> Bare<'a> {
    /// `sequences` is the number of paths after every prompt.
    fn new(weights: &'a Weights, options: &LlamaOptions, sequences: u32) -> Self {
        let parameters = options.context_parameters(weights.n_ctx_train());
        let batch = LlamaBatch::new(parameters.n_batch() as usize, options.sequences.cast_signed());
        let backend = backend().expect("llama.cpp is set up");
        let context = weights.new_context(backend, parameters).expect("the context fits into memory");
        Self { context, batch, sequences: sequences.cast_signed().max(1), kept: Vec::new() }
    }

    /// Reduces or extends the cache to exactly `prefix`.
    fn hold(&mut self, prefix: &[Token]) {
        let shared = self.kept.iter().zip(prefix).take_while(|(a, b)| a == b).count();
        let removed = self.context.clear_kv_cache_seq(None, Some(shared as u32), None);
        assert!(removed.expect("the position is one"), "the cache can be cut");
        self.batch.clear();
        let all: Vec<i32> = (0..self.sequences).collect();
        for (position, token) in prefix.iter().enumerate().skip(shared) {
            self.batch.add(LlamaToken(token.0), position as i32, &all, false).expect("the batch has room");
        }
        if self.batch.n_tokens() > 0 {
            self.context.decode(&mut self.batch).expect("the prefix is decoded");
        }
        prefix.clone_into(&mut self.kept);
    }

    /// One call with the tokens of `prompt` outside the cache and `tree` after them; returns its nanoseconds.
    fn decode(&mut self, prompt: &[Token], tree: &TokenTree) -> u64 {
        self.batch.clear();
        let all: Vec<i32> = (0..self.sequences).collect();
        for (position, token) in prompt.iter().enumerate().skip(self.kept.len()) {
            let last = position + 1 == prompt.len();
            self.batch.add(LlamaToken(token.0), position as i32, &all, last).expect("the batch has room");
        }
        for index in 0..tree.len() {
            let (first, last) = tree.paths(index);
            let paths = &all[first as usize..last as usize];
            let position = prompt.len() as i32 + tree.depth(index) as i32 - 1;
            self.batch.add(LlamaToken(tree.token(index).0), position, paths, true).expect("the batch has room");
        }
        let start = Instant::now();
        self.context.decode(&mut self.batch).expect("the batch is decoded");
        let time = nanoseconds(start);
        prompt.clone_into(&mut self.kept);
        time
    }

    /// Log-probability per label of the last call in nats, computed by hand.
    fn log_prob_nats(&self, new_tokens: usize, trie: &LabelTrie) -> Vec<f64> {
        let row = |parent: u32| {
            let place = if parent == PROMPT { 0 } else { 1 + trie.nodes()[parent as usize].inner as usize };
            let row = self.context.get_logits_ith((new_tokens - 1 + place) as i32);
            let max = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let sum: f64 = row.iter().map(|&logit| f64::from(logit - max).exp()).sum();
            (row, f64::from(max) + sum.ln())
        };
        let rows: Vec<_> = [PROMPT].iter().chain(trie.inner()).map(|&parent| row(parent)).collect();
        let mut path = Vec::with_capacity(trie.nodes().len());
        for node in trie.nodes() {
            let place = if node.parent == PROMPT { 0 } else { 1 + trie.nodes()[node.parent as usize].inner as usize };
            let (row, denominator) = &rows[place];
            let above = if node.parent == PROMPT { 0.0 } else { path[node.parent as usize] };
            path.push(above + f64::from(row[node.token.0 as usize]) - denominator);
        }
        trie.label_end().iter().map(|&end| path[end as usize]).collect()
    }
}

/// All work of the daemon for an event, without its threads.
struct Ours {
    intake: Intake,
    cycle: Cycle<LlamaModel>,
    forecasts: Publisher<ForecastV1>,
    scores: Publisher<RoomScoresV1>,
    received: Subscriber<RoomScoresV1>,
    sequence: u64,
}

/// Durations of an event's parts, in nanoseconds.
#[derive(Default, Clone, Copy)]
struct Parts {
    total: u64,
    intake: u64,
    decoder: u64,
    prompt: u64,
    cache: u64,
    trie: u64,
    ground: u64,
    forecast: u64,
    publish_forecast: u64,
    publish_scores: u64,
    /// In the step and the forecast.
    allocations: u64,
}

impl Parts {
    /// PlaceMatcher, history, tokens of the new sentence (cached after the first round), forecasts' update, snapshot.
    fn rest(&self) -> u64 {
        let scored = self.decoder + self.prompt + self.cache + self.trie + self.ground;
        let sent = self.forecast + self.publish_forecast + self.publish_scores;
        self.total.saturating_sub(self.intake + scored + sent)
    }
}

impl Ours {
    fn new(model: LlamaModel, map: &SemanticMap, effort: Effort, domain: &Domain) -> Self {
        let grounding = Grounding::new(map, &GroundingOptions::default()).expect("the scene has labels");
        // Plain llama.cpp gives Equation 1.
        let options =
            PipelineOptions { effort, correction: CorrectionChoice::EQUATION_1, ..PipelineOptions::default() };
        let pipeline = Pipeline::new(model, grounding, options).expect("the context is large enough");
        let engine =
            Engine::new(pipeline, map.clone(), GroundingOptions::default(), 1).expect("the rooms fit a message");
        let node = domain.open("bench").expect("the domain is private");
        Self {
            intake: Intake::new(IntakeLimits { rate_per_s: 0.0, burst: 1.0 }),
            cycle: Cycle::new(engine, u64::MAX / 2),
            forecasts: node.publisher().expect("a port is free"),
            scores: node.publisher().expect("a port is free"),
            received: node.subscriber().expect("a port is free"),
            sequence: 0,
        }
    }

    fn event(&mut self, sentence: &str) -> Parts {
        self.sequence += 1;
        let message = NarrationV1::new(narration_kind::SENTENCE, sentence).expect("the sentence is one");
        let now_ns = clock::monotonic_ns();
        let message = NarrationV1 { source: 1, epoch: 1, sequence: self.sequence, observed_ns: now_ns, ..message };
        let start = Instant::now();
        let taken = self.intake.receive(Ok(&message), Sender::simulated(1), BootNs(now_ns));
        if let Taken::Accepted { observation, .. } = taken {
            self.cycle.enter(Entry::new(observation, BootNs(now_ns)), 0);
        }
        let intake = nanoseconds(start);
        let allocated = ALLOCATIONS.load(Ordering::Relaxed);
        self.cycle.step(BootNs(now_ns), UnixNs(now_ns)).expect("the model scores");
        let forecasting = Instant::now();
        let forecast = self.cycle.engine_mut().forecast(BootNs(now_ns));
        let forecast_ns = nanoseconds(forecasting);
        let allocations = ALLOCATIONS.load(Ordering::Relaxed) - allocated;
        let publishing = Instant::now();
        self.forecasts.send(forecast).expect("the forecast is sent");
        let publish_forecast = nanoseconds(publishing);
        let publishing = Instant::now();
        let scores = self.cycle.message(BootNs(now_ns), u64::MAX, false).expect("there are new scores");
        self.scores.send(scores).expect("the scores are sent");
        let publish_scores = nanoseconds(publishing);
        let total = nanoseconds(start);
        assert!(self.received.newest().expect("the port works").is_some(), "the scores arrive");
        let scores = self.cycle.engine().pipeline().scores();
        let decoder = scores.stats.decoder_ns;
        let trie = scores.timing.trie_ns;
        let calls = scores.timing.prefix_ns;
        // Under `ranking`, further calls count as time in the trie.
        let (cache, trie) = match calls.checked_sub(decoder) {
            Some(cache) => (cache, trie),
            None => (0, (trie + calls).saturating_sub(decoder)),
        };
        Parts {
            total,
            intake,
            decoder,
            prompt: scores.timing.tokenise_ns,
            cache,
            trie,
            ground: scores.timing.ground_ns,
            forecast: forecast_ns,
            publish_forecast,
            publish_scores,
            allocations,
        }
    }

    /// The tokens of the next window that the model has read in the idle time.
    fn aside(&self, weights: &Weights) -> Vec<Token> {
        let inside = self.cycle.engine().pipeline().inside();
        let HistoryLimits { observations, slack, .. } = inside.options().history;
        let history = inside.histories().get(PersonId(0)).expect("there is one person");
        let sentences: Vec<&str> = history.sentences().skip(slack + 1).collect();
        if history.len() < observations { Vec::new() } else { tokens(weights, &sentences.join(" ")) }
    }
}

/// The tokens of a text by llama.cpp's tokeniser, after the model's start token.
fn tokens(weights: &Weights, text: &str) -> Vec<Token> {
    weights.vocab().tokenize(text.as_bytes(), true, false).into_iter().map(|token| Token(token.0)).collect()
}

fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}

struct Sample {
    new_tokens: usize,
    nodes: usize,
    exact: Parts,
    bare_exact: u64,
    ranking: Parts,
    bare_new: u64,
    /// Positions that the tokens see, all together.
    seen: usize,
    products: u64,
    many_products: u64,
}

impl Sample {
    fn tokens(&self) -> usize {
        self.new_tokens + self.nodes
    }

    /// The last prompt token and the nodes have logits.
    fn rows(&self) -> usize {
        1 + self.nodes
    }
}

fn tell(
    program: &[String],
    map: &SemanticMap,
    load: &dyn Fn() -> LlamaModel,
    read: &dyn Fn() -> Weights,
    options: &LlamaOptions,
    rounds: usize,
    products: &Products,
) -> Vec<Sample> {
    let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").expect("/tmp can be used");
    let domain = |name: &str| {
        let name = format!("{name}-{}", std::process::id());
        Domain::new(directory.path().join(&name), &name).expect("the domain can be named")
    };
    let domains = [domain("exact"), domain("ranking")];
    let mut samples = Vec::new();
    // llama.cpp may rearrange weights for the processor. Each side has its own copy, because a shared one would be warmer in the cache.
    let (weights, others) = (read(), read());
    {
        let mut exact = Ours::new(load(), map, Effort::Exact, &domains[0]);
        let mut ranking = Ours::new(load(), map, Effort::Ranking, &domains[1]);
        let prepared = exact.cycle.engine().pipeline().inside().prepared().clone();
        let tree = TokenTree::of_inner_nodes(prepared.trie());
        assert!(tree.path_count() <= options.sequences, "the whole trie fits into one call");
        let mut bare_exact = Bare::new(&weights, options, tree.path_count());
        let mut bare_new = Bare::new(&others, options, 1);
        let none = TokenTree::default();
        let (mut kept, mut aside) = (Vec::new(), Vec::new());
        let mut prompt_text = String::new();
        for (number, sentence) in program.iter().cycle().take(program.len() * rounds).enumerate() {
            let pipeline = exact.cycle.engine().pipeline();
            let history = pipeline.inside().histories().get(PersonId(0));
            let HistoryLimits { observations, slack, .. } = pipeline.inside().options().history;
            let before = history.into_iter().flat_map(|history| history.sentences());
            let mut sentences: Vec<&str> = before.chain([sentence.as_str()]).collect();
            if sentences.len() > observations + slack {
                sentences.drain(..sentences.len() - observations);
            }
            write_prompt(sentences, prepared.binding(), false, &mut prompt_text);
            let prompt = tokens(&weights, &prompt_text);
            let shared = |known: &[Token]| common_prefix(known, &prompt).min(prompt.len() - 1);
            let keep = shared(&kept).max(shared(&aside));
            let mut sample = Sample {
                new_tokens: prompt.len() - keep,
                nodes: tree.len(),
                exact: Parts::default(),
                bare_exact: 0,
                ranking: Parts::default(),
                bare_new: 0,
                seen: (keep..prompt.len()).map(|position| position + 1).sum::<usize>()
                    + (0..tree.len()).map(|index| prompt.len() + tree.depth(index) as usize).sum::<usize>(),
                products: 0,
                many_products: 0,
            };
            bare_exact.hold(&prompt[..keep]);
            bare_new.hold(&prompt[..keep]);
            for turn in 0..4 {
                // Rotate the order, so that each goes first equally often.
                match (turn + number) % 4 {
                    0 => sample.exact = exact.event(sentence),
                    1 => sample.bare_exact = bare_exact.decode(&prompt, &tree),
                    2 => sample.ranking = ranking.event(sentence),
                    _ => sample.bare_new = bare_new.decode(&prompt, &none),
                }
            }
            sample.products = products.time_ns(sample.tokens(), sample.rows());
            sample.many_products = products.time_ns(MANY_TOKENS, MANY_TOKENS);
            let scores = exact.cycle.engine().pipeline().scores();
            assert_eq!(scores.stats.prompt_tokens_decoded as usize, sample.new_tokens, "the same new tokens");
            assert_eq!(scores.stats.tree_tokens_decoded as usize, tree.len(), "the same nodes");
            let by_hand = bare_exact.log_prob_nats(sample.new_tokens, prepared.trie());
            let apart = |(a, b): (&f64, &f64)| (a - b).abs();
            let worst = scores.label_log_prob_nats.iter().zip(&by_hand).map(apart).fold(0.0, f64::max);
            assert!(worst < TOLERANCE_NATS, "the scores are {worst} nats apart");
            while exact.cycle.tidy() {}
            while ranking.cycle.tidy() {}
            aside = exact.aside(&weights);
            kept = prompt;
            if number >= WARM_UP {
                samples.push(sample);
            }
        }
    }
    for domain in &domains {
        domain.clean_up().expect("nobody is left in the domain");
    }
    samples
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_MARKDOWN).set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header.iter().copied());
    table
}

fn row(name: &str, samples: &[&Sample]) -> Vec<String> {
    let us = |of: &dyn Fn(&Sample) -> u64| format!("{:.0}", median(samples.iter().map(|s| of(s) as f64 / 1e3)));
    let ratio = |of: &dyn Fn(&Sample) -> f64| format!("{:.3}", median(samples.iter().map(|s| of(s))));
    vec![
        name.to_owned(),
        samples.len().to_string(),
        format!(
            "{:.0} + {:.0}",
            median(samples.iter().map(|s| s.new_tokens as f64)),
            median(samples.iter().map(|s| s.nodes as f64))
        ),
        us(&|s| s.exact.total),
        us(&|s| s.bare_exact),
        ratio(&|s| s.exact.total as f64 / s.bare_exact as f64),
        us(&|s| s.ranking.total),
        us(&|s| s.bare_new),
        ratio(&|s| s.ranking.total as f64 / s.bare_new as f64),
        format!("{:.1} %", 100.0 * median(samples.iter().map(|s| 1.0 - s.exact.decoder as f64 / s.exact.total as f64))),
    ]
}

/// How near the event is to the most that this processor does with the same arithmetic: the fastest bare products of [`MANY_TOKENS`].
fn limits(samples: &[&Sample], products: &Products) -> Table {
    let mut limits = table(&["near the limit", "million operations", "us", "billions per second", "of the fastest"]);
    let many = products.operations(MANY_TOKENS, MANY_TOKENS);
    let fastest_ns = samples.iter().map(|s| s.many_products).min().unwrap_or(u64::MAX) as f64;
    let inside = |s: &Sample| products.operations(s.tokens(), s.rows());
    let all = |s: &Sample| inside(s) + products.attention_operations(s.seen);
    type Of<'a> = &'a dyn Fn(&Sample) -> f64;
    let rows: [(&str, Of<'_>, Of<'_>); 4] = [
        ("event, exact", &all, &|s| s.exact.total as f64),
        ("decoder call, bare", &all, &|s| s.bare_exact as f64),
        ("the call's matrix products alone", &inside, &|s| s.products as f64),
        ("bare products of 32 tokens, fastest", &|_| many, &|_| fastest_ns),
    ];
    for (name, operations, ns) in rows {
        let of = |value: Of<'_>| median(samples.iter().map(|s| value(s)));
        limits.add_row(vec![
            name.to_owned(),
            format!("{:.0}", of(&|s| operations(s) / 1e6)),
            format!("{:.0}", of(&|s| ns(s) / 1e3)),
            format!("{:.0}", of(&|s| operations(s) / ns(s))),
            format!("{:.0} %", of(&|s| 100.0 * operations(s) / ns(s) / (many / fastest_ns))),
        ]);
    }
    limits
}

fn main() {
    let args = Args::parse();
    let file = ModelFile::create().expect("there is memory for the model");
    let path = args.model.clone().unwrap_or_else(|| file.path());
    let mut options = LlamaOptions::default();
    options.threads = args.threads.unwrap_or(options.threads);
    options.cache = args.cache;
    let load = || LlamaModel::load(&path, &options).expect("the model can be loaded");
    options = load().options().clone();
    let load = || LlamaModel::load(&path, &options).expect("the model can be loaded");
    let read = || {
        let backend = backend().expect("llama.cpp is set up");
        Weights::load_from_file(backend, &path, &LlamaModelParams::default()).expect("the model can be loaded")
    };
    let products = Products::new(&path, options.threads);

    let mut told = Vec::new();
    for program in embedded::PROGRAMS {
        let sentences: Vec<String> =
            Program::parse(program.text).expect("it ships").steps.iter().map(Action::sentence).collect();
        for scene in embedded::SCENES.iter().filter(|scene| scene.name.starts_with("apartment")) {
            let map = SemanticMap::from_json(scene.text).expect("it ships");
            let samples = tell(&sentences, &map, &load, &read, &options, args.rounds, &products);
            told.push((program.name, scene.name, samples));
        }
    }

    println!("{}, {} threads\n", load().info().description, options.threads);
    let mut events = table(&[
        "program, scene",
        "events",
        "tokens + nodes",
        "exact (us)",
        "bare, same batch",
        "ratio",
        "ranking (us)",
        "bare, new tokens",
        "ratio",
        "ours around the decoder",
    ]);
    for (program, scene, samples) in &told {
        events.add_row(row(&format!("{program}, {scene}"), &samples.iter().collect::<Vec<_>>()));
    }
    let all: Vec<&Sample> = told.iter().flat_map(|(.., samples)| samples).collect();
    events.add_row(row("all", &all));
    println!("{events}\n\nMedians; ratios are taken event by event.\n");

    let mut parts = table(&["part", "exact (us)", "of the event", "ranking (us)", "of the event"]);
    type Part = fn(&Parts) -> u64;
    let named: [(&str, Part); 11] = [
        ("checks", |p| p.intake),
        ("decoder", |p| p.decoder),
        ("prompt: text and tokens", |p| p.prompt),
        ("cache and batch", |p| p.cache),
        ("softmax and trie", |p| p.trie),
        ("grounding", |p| p.ground),
        ("forecast", |p| p.forecast),
        ("publishing the forecast", |p| p.publish_forecast),
        ("publishing the scores", |p| p.publish_scores),
        ("history, new tokens, snapshot", Parts::rest),
        ("all", |p| p.total),
    ];
    for (name, of) in named {
        let us = |parts: fn(&Sample) -> &Parts| format!("{:.1}", median(all.iter().map(|s| of(parts(s)) as f64 / 1e3)));
        let share = |parts: fn(&Sample) -> &Parts| {
            format!("{:.1} %", 100.0 * median(all.iter().map(|s| of(parts(s)) as f64 / parts(s).total as f64)))
        };
        parts.add_row(vec![
            name.to_owned(),
            us(|s| &s.exact),
            share(|s| &s.exact),
            us(|s| &s.ranking),
            share(|s| &s.ranking),
        ]);
    }
    println!("{parts}\n\n{}\n", limits(&all, &products));
    let none = all.iter().filter(|s| s.exact.allocations == 0).count();
    println!("{none} of {} events made no allocation between intake and publishing", all.len());
}
