//! Properties that hold for any input, and the bounded belief against the exact one.

use super::situations::rooms;
use super::*;
use proptest::prelude::*;

const PERSONS: usize = 2;

/// A home of two persons with a sensor of every kind.
fn tracker(options: Options) -> Tracker {
    let mut tracker = Tracker::new(rooms(), options, 0.0);
    (0..PERSONS).for_each(|_| assert!(tracker.add_person().is_ok()));
    let of = SensorSpec::of_room;
    let specs = [
        of(SensorKind::Motion, 0),
        of(SensorKind::Motion, 1),
        of(SensorKind::Motion, 2),
        of(SensorKind::Presence, 4),
        SensorSpec { person: Some(0), ..of(SensorKind::Bed, 0) },
        SensorSpec::phone(0),
        SensorSpec::phone(1),
        of(SensorKind::Door, 1),
        SensorSpec { beyond: Some(3), ..of(SensorKind::Door, 4) },
        of(SensorKind::Appliance, 3),
        of(SensorKind::Camera, 3),
        SensorSpec { holds: false, ..of(SensorKind::Motion, 5) },
    ];
    specs.into_iter().for_each(|spec| assert!(tracker.add_sensor(spec).is_ok()));
    tracker
}

/// One step of a random day: seconds, kind, person or none, room, on.
type Step = (f64, u8, Option<usize>, usize, bool);

fn steps(most: usize) -> impl Strategy<Value = Vec<Step>> {
    let seconds = prop_oneof![0.0..10.0, 0.0..600.0, 0.0..20_000.0];
    prop::collection::vec((seconds, 0u8..12, prop::option::of(0usize..3), 0usize..7, any::<bool>()), 1..most)
}

fn play(tracker: &mut Tracker, now_s: &mut f64, (seconds, kind, who, room, on): Step) {
    *now_s += seconds;
    let scores: Vec<f64> = (0..6).map(|own| if own == room { 0.8 } else { 0.04 }).collect();
    let robot = [room];
    let observation = match kind {
        0 => Observation::Action { who, rooms: &scores },
        1 => Observation::Present { who, room: on.then_some(room) },
        2 => Observation::Away { who },
        3 => Observation::Gone { who },
        4 if who.is_none() && !on => Observation::AllAway,
        4 => Observation::Empty { room },
        5 => Observation::Count { room, persons: 1 + usize::from(on) },
        6 => Observation::Robot { rooms: &robot },
        _ => Observation::Sensor { sensor: (room + 7 * usize::from(kind)) % 12, on: Some(on) },
    };
    tracker.observe(*now_s, &observation, if on { 0.99 } else { 0.7 });
}

fn check(tracker: &Tracker) -> Result<(), TestCaseError> {
    for person in 0..PERSONS {
        let all = (0..6).map(Some).chain([None]).map(|room| tracker.probability(person, room));
        prop_assert!(all.clone().all(|p| (-1e-9..=1.0 + 1e-9).contains(&p)));
        let sum: f64 = all.sum();
        prop_assert!((sum - 1.0).abs() < 1e-6, "{sum}");
    }
    for room in 0..6 {
        let any = tracker.occupied(room);
        let most = (0..PERSONS).map(|person| tracker.probability(person, Some(room))).fold(0.0, f64::max);
        prop_assert!(any >= most - 1e-6 && any <= 1.0 + 1e-9, "{any} {most}");
    }
    prop_assert!((0.0..=1.0 + 1e-9).contains(&tracker.house_empty()) && tracker.visitors(1).is_finite());
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    #[test]
    fn any_input_leaves_distributions_that_sum_to_one(steps in steps(30)) {
        let mut own = tracker(Options::default());
        let mut now_s = 0.0;
        for step in steps {
            play(&mut own, &mut now_s, step);
            check(&own)?;
        }
        let forecast = own.forecast(600.0);
        prop_assert!((forecast.probability(0, None) + (0..6).map(|room| forecast.probability(0, Some(room))).sum::<f64>() - 1.0).abs() < 1e-6);
        prop_assert!((0..6).all(|room| (0.0..=1.0 + 1e-9).contains(&forecast.occupied(room))));
    }

    #[test]
    fn the_same_input_gives_the_same_belief_to_the_bit(steps in steps(20)) {
        let run = || {
            let mut own = tracker(Options::default());
            let mut now_s = 0.0;
            steps.iter().for_each(|step| play(&mut own, &mut now_s, *step));
            (0..6).map(|room| own.occupied(room).to_bits()).collect::<Vec<_>>()
        };
        prop_assert_eq!(run(), run());
    }

    #[test]
    fn observations_of_one_instant_commute(steps in steps(20), first in 0usize..4, second in 0usize..4) {
        prop_assume!(first != second);
        let mut own = tracker(Options { learns: false, unknown: 1, ..Options::exact() });
        let mut now_s = 0.0;
        for (seconds, kind, who, room, on) in steps.into_iter().take(3) {
            play(&mut own, &mut now_s, (seconds % 20.0, kind, who, room, on));
        }
        // A first state, so that both orders see the same flips.
        for sensor in [first, second] {
            own.observe(now_s + 10.0, &Observation::Sensor { sensor, on: Some(false) }, 1.0);
        }
        let run = |order: [usize; 2]| {
            let mut own = own.clone();
            for sensor in order {
                own.observe(now_s + 20.0, &Observation::Sensor { sensor, on: Some(true) }, 1.0);
            }
            own
        };
        let (a, b) = (run([first, second]), run([second, first]));
        for room in 0..6 {
            prop_assert!((a.occupied(room) - b.occupied(room)).abs() < 1e-9);
        }
    }

    #[test]
    fn a_held_phone_or_bed_outweighs_the_departure_of_an_unknown_person(room in 0usize..6, repeats in 1usize..4, bed in any::<bool>(), trust in 0.5..0.99) {
        let mut own = tracker(Options::default());
        let (sensor, room) = if bed { (4, 0) } else { (5, room) };
        own.observe(0.0, &Observation::Sensor { sensor, on: Some(true) }, 1.0);
        for _ in 0..2 {
            own.observe(1.0, &Observation::Present { who: Some(0), room: Some(room) }, 0.999);
        }
        own.advance(30.0);
        let before = own.probability(0, None);
        for _ in 0..repeats {
            own.observe(30.0, &Observation::Away { who: None }, trust);
        }
        prop_assert!(before < 0.05 && own.probability(0, None) < 0.2, "{} {}", before, own.probability(0, None));
    }
}

/// A day of plausible walks: both persons walk through doors, and the sensors that they pass speak.
fn walks(seed: u64) -> Vec<(f64, usize, bool)> {
    use rand::{RngExt, SeedableRng};
    let home = rooms();
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let mut flips: Vec<(f64, usize, bool)> = Vec::new();
    for start in [0usize, 4] {
        let (mut now_s, mut here) = (0.0, start);
        while now_s < 5_400.0 {
            now_s += if here == 1 { 5.0 } else { random.random_range(120.0..2_400.0) };
            let next: Vec<usize> = (0..6).filter(|room| home.are_joined(here, *room)).collect();
            here = next[random.random_range(0..next.len())];
            if let Some(sensor) = [Some(0), Some(1), Some(2), Some(10), Some(3), Some(11)][here] {
                flips.push((now_s, sensor, true));
                flips.push((now_s + random.random_range(30.0..90.0), sensor, false));
            }
        }
    }
    flips.sort_by(|a, b| a.0.total_cmp(&b.0));
    flips
}

#[test]
fn the_bounded_belief_differs_by_less_than_a_hundredth_on_average_from_the_exact_one() {
    let (mut worst, mut sum, mut count): (f64, f64, f64) = (0.0, 0.0, 0.0);
    for seed in 1..3 {
        let mut bounded = tracker(Options { learns: false, unknown: 1, ..Options::default() });
        let mut exact = tracker(Options { learns: false, unknown: 1, ..Options::exact() });
        for (at_s, sensor, on) in walks(seed) {
            for own in [&mut bounded, &mut exact] {
                own.observe(at_s, &Observation::Sensor { sensor, on: Some(on) }, 1.0);
            }
            for person in 0..PERSONS {
                for room in (0..6).map(Some).chain([None]) {
                    let apart = (bounded.probability(person, room) - exact.probability(person, room)).abs();
                    worst = worst.max(apart);
                    sum += apart;
                    count += 1.0;
                }
            }
        }
    }
    assert!(sum / count < 0.01 && worst < 0.08, "mean {}, worst {worst}", sum / count);
}

#[test]
fn a_room_with_a_hundred_silent_sensors_resets_no_belief() {
    let uses = [RoomUse::Bedroom, RoomUse::Hall, RoomUse::Bathroom];
    let home = Home::new(&uses, &[(0, 1), (1, 2)], &[0.0, 1.0, 0.0]).unwrap();
    let mut own = Tracker::new(home, Options::default(), 0.0);
    (0..3).for_each(|_| assert!(own.add_person().is_ok()));
    for _ in 0..100 {
        let sensor = own.add_sensor(SensorSpec::of_room(SensorKind::Motion, 1)).unwrap();
        own.observe(0.0, &Observation::Sensor { sensor, on: Some(false) }, 1.0);
    }
    let place = |person, room| Observation::Present { who: Some(person), room: Some(room) };
    [(0, 1), (1, 1), (2, 0)].iter().for_each(|&(person, room)| own.observe(1.0, &place(person, room), 0.95));
    own.advance(300.0);
    assert!(own.probability(2, Some(0)) > 0.9);
}

#[test]
fn tables_are_filled_once_before_a_step_and_shared_by_persons_who_move_alike() {
    let doors: Vec<(usize, usize)> = (1..ROOMS_MAX).map(|room| (0, room)).collect();
    let ways: Vec<f64> = (0..ROOMS_MAX).map(|room| f64::from(u8::from(room == 0))).collect();
    let home = Home::new(&[RoomUse::Other; ROOMS_MAX], &doors, &ways).unwrap();
    let mut own = Tracker::new(home, Options::default(), 0.0);
    (own.unknown()..SLOTS_MAX).for_each(|_| assert!(own.add_person().is_ok()));
    let night = Movement::usual(own.home(), 2);
    let sensors = [SensorKind::Door, SensorKind::Bed].map(|kind| SensorSpec::of_room(kind, 0));
    for spec in sensors.into_iter().cycle().take(32) {
        own.add_sensor(spec).unwrap();
        (0..own.persons()).for_each(|person| own.set_movement(person, &night));
    }
    assert!(!own.tables.are_full(), "no step needs them yet");
    own.advance(1.0);
    assert!(own.tables.are_full() && std::ptr::eq(own.tables.of(1, 0), own.tables.of(own.persons(), 0)));
    own.set_movement(0, &night);
    assert!(own.tables.are_full(), "the same movement needs no new ones");
}

#[test]
fn the_sensor_of_a_removed_person_says_nothing() {
    let mut own = tracker(Options::default());
    own.observe(0.0, &Observation::Sensor { sensor: 4, on: Some(true) }, 1.0);
    own.remove_person(0);
    own.set_late(4, Some(true));
    own.advance(600.0);
    assert!(own.probability(0, Some(0)) < 0.9);
}
