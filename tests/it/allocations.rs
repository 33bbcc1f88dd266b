//! A warm event allocates nothing in Rust code. Counted on the scoring thread with the included model; llama.cpp's own memory is not counted.

use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::habits::HabitsOptions;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_core::narration::{Observation, Program, Sentence};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::scorer::certified::Effort;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::raw::{ForecastV1, RoomScoresV1};
use roomcast_ipc::{Domain, clock};
use roomcast_llama::LlamaOptions;
use roomcast_services::daemon::{Cycle, Engine, Entry, HomeHabits, Memory, Zone};
use roomcast_services::embedded;
use roomcast_services::setup::load_model;

/// iceoryx2 itself allocates once for each message: `send_copy` puts an `Arc` around the mutex of its sample.
const SENDS: u64 = 2;

/// The event that cuts the window takes the cells of the next one, which idle work has read: llama.cpp's binding allocates for both.
const CUT: u64 = 1;
const TIDY: u64 = 4;

/// Rounds of the programs before an event counts as warm: habits see new contexts in the second round, and in the third.
const TOLD: usize = 5;

/// Allocations of each event in the last round: the step, writing the messages, sending them, the idle work.
fn allocations(effort: Effort) -> Vec<[u64; 4]> {
    let map = SemanticMap::from_json(embedded::scene("apartment-e0").unwrap().text).unwrap();
    let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
    let options = PipelineOptions { effort, ..PipelineOptions::default() };
    let pipeline = Pipeline::new(load_model(None, &LlamaOptions::default()).unwrap(), grounding, options).unwrap();
    let engine = Engine::new(pipeline, map, GroundingOptions::default(), 1).unwrap();
    let engine = engine.with_habits(HomeHabits::new(Memory::new(HabitsOptions::default()), Zone::UTC));
    let mut cycle = Cycle::new(engine, u64::MAX / 2);
    let sentences: Vec<String> = embedded::PROGRAMS
        .iter()
        .flat_map(|program| Program::parse(program.text).unwrap().steps)
        .map(|action| action.sentence())
        .collect();

    let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let domain = Domain::new(directory.path().join("d"), &format!("alloc-{}", std::process::id())).unwrap();
    let mut counts = Vec::new();
    {
        let node = domain.open("allocations").unwrap();
        let forecasts = node.publisher::<ForecastV1>().unwrap();
        let scores = node.publisher::<RoomScoresV1>().unwrap();
        let received = node.subscriber::<RoomScoresV1>().unwrap();
        for (sequence, sentence) in (1..).zip(sentences.iter().cycle().take((TOLD + 1) * sentences.len())) {
            let now_ns = clock::monotonic_ns();
            let sentence = Sentence::new(sentence).unwrap();
            let observation = Observation { observed_ns: BootNs(now_ns), ..Observation::of(sequence, sentence) };
            let scored = allocation_counter::measure(|| {
                cycle.enter(Entry::new(observation, BootNs(now_ns)), 0);
                cycle.step(BootNs(now_ns), UnixNs(now_ns)).unwrap();
            });
            let (mut forecast, mut message) = (None, None);
            let written = allocation_counter::measure(|| {
                forecast = Some(*cycle.engine_mut().forecast(BootNs(now_ns)));
                cycle.engine_mut().person_scores(BootNs(now_ns));
                cycle.engine_mut().person_forecasts(BootNs(now_ns));
                cycle.engine_mut().tick(BootNs(now_ns), UnixNs(now_ns));
                message = cycle.message(BootNs(now_ns), u64::MAX, false).copied();
            });
            let sent = allocation_counter::measure(|| {
                forecasts.send(&forecast.unwrap()).unwrap();
                scores.send(&message.unwrap()).unwrap();
            });
            let tidied = allocation_counter::measure(|| while cycle.tidy() {});
            // Drains the records for the journal, outside the measurement.
            cycle.engine_mut().tell_outcomes(|_| {});
            counts.push([scored, written, sent, tidied].map(|part| part.count_total));
            assert_eq!(received.newest().unwrap().unwrap().sequence, sequence);
        }
    }
    domain.clean_up().unwrap();
    assert!(counts[0][0] > 0, "the first event finds its memory, or nothing is counted");
    assert!(cycle.engine().habits().learned().observations > sentences.len() as f64);
    counts.split_off(TOLD * sentences.len())
}

#[test]
fn an_event_allocates_nothing_once_warm() {
    for effort in [Effort::Exact, Effort::Ranking] {
        let counts = allocations(effort);
        assert!(
            counts
                .iter()
                .all(|&[step, messages, send, tidy]| step <= CUT && messages == 0 && send <= SENDS && tidy <= TIDY),
            "{effort:?}: {counts:?}"
        );
    }
}
