//! Grounding by size of the map: cost per map, and cost per event.
//!
//! `cargo bench --bench grounding`

#![expect(clippy::expect_used, reason = "a bench that cannot set up has nothing to measure")]

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use roomcast_core::grounding::{GroundedScores, Grounding, GroundingOptions};
use roomcast_core::semantic_map::SemanticMap;

#[derive(Clone, Copy)]
enum Shape {
    Boxes,
    /// Outlines of twelve corners: the box with a notch at each corner, like pillars and shafts.
    Outlines,
}

/// A building with a grid of `rooms` rooms and `items` items in them, with at most five hundred labels.
fn building(rooms: usize, items: usize, shape: Shape) -> SemanticMap {
    let columns = (rooms as f64).sqrt().ceil() as usize;
    let corner = |room: usize| [5.0 * (room % columns) as f64, 5.0 * (room / columns) as f64];
    let room = |index: usize| {
        let [x, y] = corner(index);
        if let Shape::Outlines = shape {
            let notch = 0.2;
            let (low, high) = (notch, 5.0 - notch);
            let corners = [
                [low, 0.0],
                [high, 0.0],
                [high, low],
                [5.0, low],
                [5.0, high],
                [high, high],
                [high, 5.0],
                [low, 5.0],
                [low, high],
                [0.0, high],
                [0.0, low],
                [low, low],
            ];
            let ring: Vec<String> =
                corners.iter().map(|[east, north]| format!("[{},{}]", x + east, y + north)).collect();
            let ring = ring.join(",");
            return format!(r#"{{"id":"r{index}","label":"room {index}","footprint":[[{ring}]],"height":3}}"#);
        }
        format!(
            r#"{{"id":"r{index}","label":"room {index}","box":{{"min_m":[{x},{y},0],"max_m":[{},{},3]}}}}"#,
            x + 5.0,
            y + 5.0
        )
    };
    let item = |index: usize| {
        let [x, y] = corner(index % rooms);
        let (x, y) = (x + 4.7 * ((index * 7) % 100) as f64 / 100.0, y + 4.7 * ((index * 13) % 100) as f64 / 100.0);
        format!(
            r#"{{"id":"i{index}","label":"thing {}","position_m":[{x},{y},1],"box":{{"min_m":[{x},{y},1],"max_m":[{},{},1.3]}}}}"#,
            index % 500,
            x + 0.3,
            y + 0.3
        )
    };
    let list = |entries: Vec<String>| entries.join(",");
    let json = format!(
        r#"{{"format":"roomcast-scene","version":2,"name":"building","rooms":[{}],"items":[{}]}}"#,
        list((0..rooms).map(room).collect()),
        list((0..items).map(item).collect())
    );
    SemanticMap::from_json(&json).expect("the building is well formed")
}

fn event(criterion: &mut Criterion, name: &str, sizes: &[(usize, usize)]) {
    let mut group = criterion.benchmark_group(name);
    for &(rooms, items) in sizes {
        let grounding =
            Grounding::new(&building(rooms, items, Shape::Boxes), &GroundingOptions::default()).expect("it has labels");
        let labels = grounding.scored_labels().len();
        let log_prob_nats: Vec<f64> = (0..labels).map(|label| -5.0 - (label % 37) as f64 / 3.0).collect();
        let mut scores = GroundedScores::default();
        group.throughput(Throughput::Elements(items as u64));
        group.bench_function(BenchmarkId::from_parameter(format!("{rooms} rooms, {items} items")), |bencher| {
            bencher.iter(|| grounding.ground(black_box(&log_prob_nats), &mut scores));
        });
    }
    group.finish();
}

/// The extra cost of item scores.
fn items(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("items' scores");
    for items in [100, 10_000, 100_000] {
        let grounding =
            Grounding::new(&building(4, items, Shape::Boxes), &GroundingOptions::default()).expect("it has labels");
        let log_prob_nats = vec![-5.0; grounding.scored_labels().len()];
        group.throughput(Throughput::Elements(items as u64));
        group.bench_function(BenchmarkId::from_parameter(format!("{items} items")), |bencher| {
            bencher.iter(|| grounding.item_log_score_nats(black_box(&log_prob_nats)).sum::<f64>());
        });
    }
    group.finish();
}

fn ground(criterion: &mut Criterion) {
    event(criterion, "ground, by items", &[(4, 100), (4, 1_000), (4, 10_000), (4, 100_000)]);
    event(criterion, "ground, by rooms", &[(10, 10_000), (64, 10_000)]);
}

fn assign(criterion: &mut Criterion) {
    assign_to(criterion, "assign", Shape::Boxes);
    assign_to(criterion, "assign to outlines", Shape::Outlines);
}

fn assign_to(criterion: &mut Criterion, name: &str, shape: Shape) {
    let mut group = criterion.benchmark_group(name);
    group.sample_size(10);
    for (rooms, items) in [(4, 1_000), (4, 10_000), (4, 100_000), (64, 10_000)] {
        let map = building(rooms, items, shape);
        group.throughput(Throughput::Elements(items as u64));
        group.bench_function(BenchmarkId::from_parameter(format!("{rooms} rooms, {items} items")), |bencher| {
            bencher.iter(|| Grounding::new(black_box(&map), &GroundingOptions::default()));
        });
    }
    group.finish();
}

criterion_group!(benches, items, ground, assign);
criterion_main!(benches);
