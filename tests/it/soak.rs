//! Many events through the daemon's whole path, with real ports and a real database, and a model with equal probabilities. Memory and file
//! descriptors stay flat, and no event is lost.
//!
//! `ROOMCAST_SOAK_EVENTS=1000000 cargo test --release --test it soak -- --nocapture` runs a million and prints the percentiles of latency in the
//! first and in the last tenth.

use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_ipc::raw::{DecisionV1, NarrationV1, RoomScoresV1, narration_kind};
use roomcast_ipc::{Domain, Sender, clock, sequence};
use roomcast_services::config::{IntakeLimits, PlannerConfig};
use roomcast_services::daemon::{Cycle, Engine, Entry, Intake, Journal, Taken, journal};
use roomcast_services::narrator::{Account, Item, Who};
use roomcast_services::no_model::NoModel;
use roomcast_services::planner::Planner;
use roomcast_services::setup;

use crate::alone::is_alone;
use crate::number;

const EVENTS: u64 = 20_000;
/// Memory may still grow after the first tenth: allocator caches, and pages of shared memory that are touched for the first time.
const GROWTH_BYTES: u64 = 4 << 20;

fn events() -> u64 {
    let events = number("ROOMCAST_SOAK_EVENTS").unwrap_or(EVENTS);
    assert!(events >= 100, "ROOMCAST_SOAK_EVENTS is {events}: give at least 100, so that tenths can be compared");
    events
}

/// Resident memory of this process: anonymous, file and shared.
fn resident_bytes() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    statm.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 4096
}

fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

fn shown(latency_ns: &Histogram<u64>) -> String {
    let us = |quantile| latency_ns.value_at_quantile(quantile) as f64 / 1e3;
    let max_us = latency_ns.max() as f64 / 1e3;
    format!("p50 {:.1} us, p99 {:.1} us, p99.9 {:.1} us, worst {max_us:.1} us", us(0.5), us(0.99), us(0.999))
}

#[test]
fn memory_and_descriptors_stay_flat() {
    if !is_alone() {
        return;
    }
    let events = events();
    let directory = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
    let domain = Domain::new(directory.path().join("d"), &format!("soak-{}", std::process::id())).unwrap();
    let node = domain.open("soak").unwrap();
    let (narration_out, narration_in) =
        (node.publisher::<NarrationV1>().unwrap(), node.subscriber::<NarrationV1>().unwrap());
    let (scores_out, scores_in) =
        (node.publisher::<RoomScoresV1>().unwrap(), node.subscriber::<RoomScoresV1>().unwrap());
    let decisions = node.publisher::<DecisionV1>().unwrap();

    let map = setup::load_map(None).unwrap();
    let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
    let pipeline = Pipeline::new(NoModel::default(), grounding, PipelineOptions::default()).unwrap();
    let mut cycle = Cycle::new(Engine::new(pipeline, map, GroundingOptions::default(), 1).unwrap(), 250_000_000);
    let mut intake = Intake::new(IntakeLimits { rate_per_s: 0.0, burst: 1.0 });
    // So small that the oldest events are deleted within the first tenth: memory for the deletion does not count as growth.
    let state = directory.path().join("state");
    let (journal, _) = Journal::open(&state, 1 << 17, Duration::from_secs(1)).unwrap();
    let handle = journal.handle.clone();
    let mut account = Account::new("soak", sequence::random_epoch());
    let mut planner = Planner::new(&PlannerConfig { room_time_s: 0.001, ..PlannerConfig::default() }, 1);

    let fresh = || Histogram::<u64>::new_with_max(10_000_000_000, 3).unwrap();
    let (mut first, mut last) = (fresh(), fresh());
    let (mut early, mut decided) = ((0, 0), 0_u64);
    let start = Instant::now();
    for event in 0..events {
        let sent = Instant::now();
        let text = format!("They do thing {event}.");
        let item = Item::new(narration_kind::SENTENCE, text, Who::Number(PersonId((event % 3) as u32)));
        let message = account.next(&item, BootNs(clock::monotonic_ns()), UnixNs(clock::unix_ns())).unwrap();
        narration_out.send(&message).unwrap();
        narration_in.wait(Duration::from_secs(1)).unwrap();
        while let Some(received) = narration_in.receive().unwrap() {
            let now_ns = clock::monotonic_ns();
            let Taken::Accepted { observation, missed: 0, .. } =
                intake.take(&received, Sender::simulated(1), BootNs(now_ns))
            else {
                panic!("{event}")
            };
            let record = journal.handle.append(&observation);
            cycle.enter(Entry::new(observation, BootNs(now_ns)), record);
        }
        cycle.step(BootNs(clock::monotonic_ns()), UnixNs(clock::unix_ns())).unwrap();
        assert!(handle.wait_for(cycle.scored_record(), Duration::from_secs(60)), "the journal stands still");
        let scores = cycle.message(BootNs(clock::monotonic_ns()), handle.written(), false).unwrap();
        scores_out.send(scores).unwrap();
        let scores = scores_in.newest().unwrap().unwrap();
        account.confirm(&scores);
        planner.take(&scores, BootNs(clock::monotonic_ns())).unwrap();
        if let Some(decision) = planner.decide(BootNs(clock::monotonic_ns()), UnixNs(clock::unix_ns())).unwrap() {
            decisions.send(&decision).unwrap();
            decided += 1;
        }
        assert_eq!(account.under_way(), 0, "every narration is confirmed by the scores that it made");
        let took_ns = u64::try_from(sent.elapsed().as_nanos()).unwrap();
        if event < events / 10 {
            first.saturating_record(took_ns);
            early = (resident_bytes(), descriptors());
        } else if event >= events - events / 10 {
            last.saturating_record(took_ns);
        }
        while cycle.tidy() {}
        if (event + 1).is_multiple_of((events / 10).max(1)) {
            let seconds = start.elapsed().as_secs_f64();
            println!("{} events in {seconds:.0} s, resident {} KiB", event + 1, resident_bytes() >> 10);
        }
    }
    let late = (resident_bytes(), descriptors());
    let journal_bytes = std::fs::metadata(state.join(journal::FILE)).unwrap().len();
    println!(
        "{events} events in {:.0} s, {decided} decisions, database {journal_bytes} bytes",
        start.elapsed().as_secs_f64()
    );
    println!("first tenth: {}", shown(&first));
    println!("last tenth:  {}", shown(&last));
    println!(
        "resident after the first tenth {} KiB, at the end {} KiB; descriptors {} and {}",
        early.0 >> 10,
        late.0 >> 10,
        early.1,
        late.1
    );
    assert!(late.0 <= early.0 + GROWTH_BYTES, "memory grows: {} to {} bytes", early.0, late.0);
    assert_eq!(late.1, early.1, "file descriptors leak");
    assert_eq!(handle.failures(), 0, "the journal could not be written");
    assert!(0 < journal_bytes && journal_bytes <= 4 << 17);
    assert_eq!(intake.counters().accepted, events);
    drop((journal, handle));
    let (_, recovered) = Journal::open(&state, 1 << 17, Duration::from_secs(1)).unwrap();
    let newest = recovered.observations.last().unwrap().sentence().unwrap();
    assert_eq!(newest, format!("They do thing {}.", events - 1), "what the journal holds after all");
    drop((narration_out, narration_in, scores_out, scores_in, decisions, node));
    assert!(domain.clean_up().unwrap());
}
