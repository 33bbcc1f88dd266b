//! Cost of habits in addition to the model, after a year of events of two people: `cargo bench --bench habits`.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use roomcast_core::habits::{Habits, HabitsOptions, Turn};
use roomcast_core::ids::PersonId;

const LABELS: usize = 150;
const ROOMS: usize = 10;
const DAY_S: f64 = 86_400.0;
/// Horizons of the messages, in seconds.
const HORIZONS_S: [f64; 16] =
    [0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0, 900.0, 1800.0, 3600.0];

/// Synthetic days: each event mostly follows from the previous ones.
struct Days {
    state: u64,
    label: usize,
    at_s: f64,
}

impl Days {
    fn next(&mut self) -> (Turn, Vec<f64>) {
        self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let draw = (self.state >> 33) as usize;
        self.label = if draw.is_multiple_of(4) { draw / 4 % LABELS } else { (self.label * 7 + 3) % LABELS };
        self.at_s += 860.0;
        let turn = Turn {
            person: PersonId((draw / 1_024 % 2) as u32),
            label: Some(self.label),
            room: Some(self.label % ROOMS),
            at_s: self.at_s,
        };
        (turn, (0..LABELS).map(|label| 1.0 / (1 + (label + draw) % 17) as f64).collect())
    }
}

fn year(criterion: &mut Criterion) {
    let mut habits = Habits::new(HabitsOptions::default());
    let shares = (0..LABELS * ROOMS).map(|cell| f64::from(u8::from(cell / ROOMS % ROOMS == cell % ROOMS)));
    habits.bind(
        (0..LABELS).map(|label| format!("thing {label}")).collect(),
        (0..ROOMS).map(|room| format!("room {room}")).collect(),
        shares.collect(),
    );
    let mut days = Days { state: 1, label: 0, at_s: 4.0 * DAY_S };
    let rooms = [0.1; ROOMS];
    let event = |habits: &mut Habits, (turn, model): (Turn, Vec<f64>)| {
        habits.observe(&turn);
        black_box(
            habits.mix(turn.person, turn.at_s, &model).len() + habits.next_rooms(turn.person, turn.at_s, &rooms).len(),
        )
    };
    let mut minutes = 0.0;
    while days.at_s < 369.0 * DAY_S {
        event(&mut habits, days.next());
        // The last month has a reading every minute.
        while days.at_s > 339.0 * DAY_S && minutes < days.at_s {
            minutes = f64::max(minutes + 60.0, days.at_s - 860.0);
            (0..2).for_each(|person| habits.tick(PersonId(person), minutes, &mut |_, p| p.fill(1.0)));
        }
    }
    println!("{:?}", habits.learned());
    let mut group = criterion.benchmark_group("habits after a year");
    group.bench_function("learn from an event and look ahead", |bencher| {
        bencher.iter_batched(|| days.next(), |next| event(&mut habits, next), criterion::BatchSize::SmallInput);
    });
    let shipped = vec![1.0 / (ROOMS + 1) as f64; HORIZONS_S.len() * (ROOMS + 1)];
    let (mut out, mut weights, mut now_s) = (Vec::new(), Vec::new(), days.at_s);
    group.bench_function("forecast of a person, all horizons", |bencher| {
        bencher.iter(|| habits.at_times(PersonId(0), (now_s, &HORIZONS_S), &shipped, &mut out, &mut weights));
    });
    group.bench_function("a minute of a person", |bencher| {
        bencher.iter(|| {
            now_s += 60.0;
            habits.tick(PersonId(0), now_s, &mut |_, p| p.fill(1.0));
        });
    });
    group.finish();
}

criterion_group!(benches, year);
criterion_main!(benches);
