use super::counts::Row;
use super::names::ELSEWHERE;
use super::*;
use proptest::prelude::*;
use std::collections::BTreeMap;

const LABELS: [&str; 5] = ["bed", "shower", "kettle", "mug", "sofa"];
const ROOMS: [&str; 3] = ["bedroom", "bathroom", "kitchen"];
const ROOM_OF: [usize; 5] = [0, 1, 2, 2, 0];
const DAY_S: f64 = 86_400.0;
/// A Monday.
const MONDAY_S: f64 = 4.0 * DAY_S;

fn words(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

fn shares() -> Vec<f64> {
    ROOM_OF.iter().flat_map(|room| (0..3).map(move |other| if other == *room { 1.0 } else { 0.0 })).collect()
}

fn home(options: HabitsOptions) -> Habits {
    let mut habits = Habits::new(options);
    habits.bind(words(&LABELS), words(&ROOMS), shares());
    habits
}

fn at(
    habits: &mut Habits,
    person: PersonId,
    now_s: f64,
    horizon_s: f64,
    shipped: &[f64],
    out: &mut Vec<f64>,
) -> WhenShares {
    let mut shares = Vec::new();
    habits.at_times(person, (now_s, &[horizon_s]), shipped, out, &mut shares);
    shares[0]
}

fn observations(habits: &Habits, person: PersonId) -> f64 {
    habits.persons().find(|(known, _)| *known == person).map_or(0.0, |(_, observations)| observations)
}

fn turn(person: PersonId, label: usize, at_s: f64) -> Turn {
    Turn { person, label: Some(label), room: Some(ROOM_OF[label]), at_s }
}

/// Repeats a morning on several days. Returns each day's loss in nats per turn; each turn is forecast first and learned then.
fn mornings(habits: &mut Habits, person: PersonId, days: usize) -> Vec<f64> {
    let morning = [0, 1, 2, 3, 4, 3, 2];
    (0..days)
        .map(|day| {
            let mut loss = 0.0;
            for (step, label) in morning.into_iter().enumerate() {
                let at_s = MONDAY_S + day as f64 * DAY_S + 7.0 * 3_600.0 + 60.0 * step as f64;
                loss -= habits.mix(person, at_s, &[0.2; 5])[label].ln();
                habits.next_rooms(person, at_s, &[1.0 / 3.0; 3]);
                habits.observe(&turn(person, label, at_s));
            }
            loss / morning.len() as f64
        })
        .collect()
}

#[test]
fn a_habit_is_learned_within_days_and_the_first_day_is_the_models() {
    let mut habits = home(HabitsOptions::default());
    let losses = mornings(&mut habits, PersonId(0), 10);
    assert!(losses[0] < 5f64.ln() + 0.3, "{losses:?}");
    assert!(losses[9] < 0.4, "{losses:?}");
    let at_s = MONDAY_S + 10.0 * DAY_S + 7.0 * 3_600.0;
    habits.mix(PersonId(0), at_s, &[0.2; 5]);
    habits.observe(&turn(PersonId(0), 0, at_s));
    habits.mix(PersonId(0), at_s + 60.0, &[0.2; 5]);
    let shares = habits.explain(PersonId(0), 1).unwrap();
    let total = shares.model + shares.habit + shares.hour;
    assert!((total - 1.0).abs() < 1e-9 && shares.model < 0.3 && shares.observations[1] > 8.0, "{shares:?}");
    let rooms = habits.next_rooms(PersonId(0), at_s + 60.0, &[1.0 / 3.0; 3]);
    assert!(rooms[1] > 0.6 && (rooms.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{rooms:?}");
}

/// The number of mentions does not predict the next thing.
#[test]
fn what_comes_next_is_known_however_often_a_thing_is_mentioned() {
    let mut habits = home(HabitsOptions::default());
    let (mut draw, mut least) = (1u64, 1.0f64);
    for day in 0..6 {
        let mut at_s = MONDAY_S + f64::from(day) * DAY_S;
        for label in 0..5usize {
            let p = habits.mix(PersonId(0), at_s, &[0.2; 5]);
            if let Some(last) = label.checked_sub(1).filter(|_| day == 5) {
                least = least.min(p[label] / (1.0 - p[last]));
            }
            draw = draw.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            for _ in 0..=(draw >> 33) % 4 {
                habits.mix(PersonId(0), at_s, &[0.2; 5]);
                habits.observe(&turn(PersonId(0), label, at_s));
                at_s += 60.0;
            }
        }
    }
    assert!(least > 0.8, "{least}");
}

#[test]
fn another_person_of_the_home_begins_with_what_the_first_one_does() {
    let mut habits = home(HabitsOptions::default());
    let first = mornings(&mut habits, PersonId(0), 10);
    let second = mornings(&mut habits, PersonId(7), 1);
    assert!(second[0] < first[0] - 0.3, "{first:?} {second:?}");
    assert!(habits.forget(PersonId(0)) && !habits.forget(PersonId(0)));
    assert_eq!((habits.learned().persons, observations(&habits, PersonId(7))), (1, 7.0));
}

#[test]
fn what_was_learned_survives_another_map() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(0), 10);
    // The same things in another order, in a flat with one more room.
    let labels = ["lamp", "mug", "kettle", "sofa", "shower", "bed"];
    habits.bind(words(&labels), words(&["hall", "kitchen", "bedroom", "bathroom"]), vec![0.25; 24]);
    let at_s = MONDAY_S + 11.0 * DAY_S;
    habits.observe(&Turn { person: PersonId(0), label: Some(5), room: Some(2), at_s });
    assert!(habits.mix(PersonId(0), at_s + 60.0, &[1.0 / 6.0; 6])[4] > 0.5);
    assert!(habits.next_rooms(PersonId(0), at_s + 60.0, &[0.25; 4])[3] > 0.5);
}

#[test]
fn nothing_is_learned_where_it_may_not() {
    let mut still = home(HabitsOptions { learn: false, ..HabitsOptions::default() });
    mornings(&mut still, PersonId(0), 2);
    assert_eq!(still.learned().counts, 0);
}

/// Sensors alone teach places, which are the prior of a new person.
#[test]
fn what_is_seen_alone_is_the_prior_of_others() {
    let mut habits = home(HabitsOptions::default());
    for step in 0..200 {
        let at_s = MONDAY_S + 300.0 * f64::from(step);
        let place = Place::Room(usize::try_from(step).unwrap() % 2);
        habits.be(PersonId(0), place, at_s);
        (0..5).for_each(|minute| habits.tick(PersonId(0), at_s + 60.0 * f64::from(minute), &mut |_, p| p.fill(1.0)));
    }
    assert_eq!(observations(&habits, PersonId(0)), 0.0, "they did nothing");
    let at_s = MONDAY_S + 300.0 * 200.0;
    habits.be(PersonId(1), Place::Room(0), at_s);
    let (mut out, places) = (Vec::new(), habits.places());
    at(&mut habits, PersonId(1), at_s, 300.0, &vec![1.0 / places as f64; places], &mut out);
    let at_first = out.clone();
    let mut alone = home(HabitsOptions::default());
    alone.be(PersonId(1), Place::Room(0), at_s);
    at(&mut alone, PersonId(1), at_s, 300.0, &vec![1.0 / places as f64; places], &mut out);
    assert!(at_first[1] > out[1] + 0.05, "{at_first:?} {out:?}");
}

/// An empty room ends the stay; no further time is counted.
#[test]
fn a_stay_ends_where_its_place_is_empty() {
    let mut habits = home(HabitsOptions::default());
    let (mut seen, at_s) = (Vec::new(), MONDAY_S);
    habits.be(PersonId(0), Place::Room(0), at_s);
    habits.lose(PersonId(0), at_s + 60.0);
    assert_eq!(habits.place(PersonId(0)), None);
    (2..120).for_each(|minute| habits.tick(PersonId(0), at_s + 60.0 * f64::from(minute), &mut |_, p| p.fill(1.0)));
    habits.be(PersonId(0), Place::Room(1), at_s + 7_200.0);
    for (key, Row { counts, .. }) in habits.counts.rows() {
        match split(key).0 {
            // Time spent in a place.
            20 => seen.extend(counts),
            // The exits of a place, and the place later.
            22 | 24 => panic!("the person's next place is unknown: {counts:?}"),
            _ => {}
        }
    }
    let minutes: f32 = seen.iter().filter(|(symbol, _)| *symbol == 1).map(|(_, count)| count).sum();
    let exits: f32 = seen.iter().filter(|(symbol, _)| *symbol == 0).map(|(_, count)| count).sum();
    assert!((minutes - 1.0).abs() < 1e-3 && exits == 1.0, "{seen:?}");
    let places = habits.places();
    let (shipped, mut out) = (vec![0.5 / (places - 1) as f64; places], Vec::new());
    habits.lose(PersonId(0), at_s + 7_260.0);
    assert_eq!(at(&mut habits, PersonId(0), at_s + 7_300.0, 300.0, &shipped, &mut out).shipped, 1.0);
}

/// After a return the forecast uses earlier returns. A visit is learned only when a room is reported.
#[test]
fn who_is_back_goes_where_earlier_returns_led() {
    let mut habits = home(HabitsOptions::default());
    let evening_s = |day: usize| MONDAY_S + day as f64 * DAY_S + 17.0 * 3_600.0;
    let (mut p, shipped) = (Vec::new(), [0.9, 0.05, 0.05, 0.0]);
    for day in 0..14 {
        let at_s = evening_s(day);
        // The bathroom for a minute, the kitchen for an hour; nights in the bedroom.
        for (minute, place) in [(1, Some(1)), (2, Some(2)), (62, Some(0)), (14 * 60, None)] {
            if minute == 1 {
                habits.come_back(PersonId(0), at_s);
                assert_eq!((habits.place(PersonId(0)), habits.is_back(PersonId(0))), (None, day > 0));
            }
            habits.be(PersonId(0), place.map_or(Place::Elsewhere, Place::Room), at_s + 60.0 * f64::from(minute));
        }
    }
    let visits = |habits: &Habits| habits.visits(evening_s(14)).iter().map(|of_room| of_room[5]).collect::<Vec<_>>();
    let before = visits(&habits);
    assert!(before[0] < 0.01 && before[1] > 5.0, "{before:?}");
    let at_s = evening_s(14);
    habits.come_back(PersonId(0), at_s);
    let mut ahead = |habits: &mut Habits, now_s: f64, horizon_s: f64| {
        let shares = at(habits, PersonId(0), now_s, horizon_s, &shipped, &mut p);
        assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9, "{p:?}");
        (shares, p.clone())
    };
    let (shares, now) = ahead(&mut habits, at_s, 0.0);
    assert!(shares.shipped < 0.3 && now[1] > 0.6 && now[3] < 1e-9, "{shares:?} {now:?}");
    let (_, soon) = ahead(&mut habits, at_s, 900.0);
    assert!(soon[2] > 1.5 * soon[0], "{soon:?}");
    // The forecast moves on without a further event.
    let (_, later) = ahead(&mut habits, at_s + 900.0, 0.0);
    assert!(later[2] > 1.5 * later[0] && later[3] < 1e-9, "{later:?}");
    // Sets cover the forecast, because no threshold was learned for such forecasts.
    let mut set = Vec::new();
    habits.room_set(PersonId(0), 900.0, &[0.3, 0.3, 0.25, 0.15], false, &mut set);
    assert_eq!(set, [true, true, true, true]);
    assert_eq!(visits(&habits), before);
    // A room that is reported long after the return is not counted as the room entered.
    let exits = |habits: &Habits| habits.counts.get(key(22, 0, [ELSEWHERE, NONE, NONE]), minute(at_s)).unwrap().sum();
    let led = exits(&habits);
    habits.be(PersonId(0), Place::Room(0), at_s + 7_200.0);
    assert!(!habits.is_back(PersonId(0)) && exits(&habits) == led);
    // A person in a room does not come back. After a turn without a known place the person's place is unknown.
    habits.come_back(PersonId(0), at_s + 7_260.0);
    assert_eq!(habits.place(PersonId(0)), Some(Place::Room(0)));
    habits.be(PersonId(0), Place::Elsewhere, at_s + 7_300.0);
    habits.come_back(PersonId(0), at_s + 7_400.0);
    habits.lose(PersonId(0), at_s + 7_410.0);
    assert!(
        !habits.is_back(PersonId(0))
            && at(&mut habits, PersonId(0), at_s + 7_420.0, 60.0, &shipped, &mut p).shipped == 1.0
    );
}

/// Watches a person: in the bedroom until seven, in the bathroom for half an hour, in the kitchen for an hour, out until six, and in the
/// kitchen then. Returns the last day's losses at the horizon of an hour: of the habits, and of the present place.
fn week(habits: &mut Habits, days: usize) -> (f64, f64) {
    let place = |minute: usize| match minute % 1440 {
        0..420 => Place::Room(0),
        420..450 => Place::Room(1),
        450..510 => Place::Room(2),
        510..1080 => Place::Elsewhere,
        _ => Place::Room(2),
    };
    let index = |place| match place {
        Place::Room(room) => room,
        Place::Elsewhere => 3,
    };
    let (mut loss, mut same, mut p) = (0.0, 0.0, Vec::new());
    for minute in 0..days * 1440 {
        let now_s = MONDAY_S + 60.0 * minute as f64;
        habits.be(PersonId(0), place(minute), now_s);
        habits.tick(PersonId(0), now_s, &mut |_, p| p.fill(0.25));
        if minute >= (days - 1) * 1440 {
            at(habits, PersonId(0), now_s, 3_600.0, &[0.25; 4], &mut p);
            assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9 && p.iter().all(|p| *p >= 0.0));
            let truth = index(place(minute + 60));
            loss -= p[truth].ln();
            same += f64::from(u8::from(truth == index(place(minute))));
        }
    }
    (loss / 1440.0, same / 1440.0)
}

#[test]
fn a_day_is_learned_with_its_hours() {
    let mut habits = home(HabitsOptions::default());
    let (loss, same) = week(&mut habits, 14);
    let persistence = -(same * same.ln() + (1.0 - same) * ((1.0 - same) / 3.0).ln());
    assert!(loss < 0.6 * persistence, "{loss} against {persistence}");
    let mut set = Vec::new();
    let now_s = MONDAY_S + 14.0 * DAY_S + 3.0 * 3_600.0;
    habits.be(PersonId(0), Place::Room(0), now_s);
    let mut p = Vec::new();
    at(&mut habits, PersonId(0), now_s, 900.0, &[0.25; 4], &mut p);
    habits.room_set(PersonId(0), 900.0, &p, false, &mut set);
    assert_eq!(set, [true, false, false, false], "{p:?}");
}

#[test]
fn without_knowledge_the_forecast_is_the_shipped_one() {
    let mut habits = home(HabitsOptions::default());
    let shipped = [0.1, 0.2, 0.3, 0.4];
    let mut p = Vec::new();
    let shares = at(&mut habits, PersonId(0), MONDAY_S, 600.0, &shipped, &mut p);
    assert_eq!((p.as_slice(), shares.shipped), (shipped.as_slice(), 1.0));
}

#[test]
fn values_and_json_give_back_what_was_learned() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(3), 5);
    week(&mut habits, 3);
    let stored = habits.stored();
    assert!(Habits::from_stored(*habits.options(), stored.clone()).unwrap().stored() == stored);
    let json = habits.to_json().unwrap();
    // Objects become lists of values.
    fn without_keys(value: &serde_json::Value) -> serde_json::Value {
        match value {
            serde_json::Value::Object(keys) => keys.values().map(without_keys).collect(),
            serde_json::Value::Array(entries) => entries.iter().map(without_keys).collect(),
            other => other.clone(),
        }
    }
    let bare = without_keys(&serde_json::from_str(&json).unwrap()).to_string();
    assert!(Habits::from_json(*habits.options(), &bare).is_err());
    assert!(Habits::from_json(*habits.options(), &json).unwrap().stored() == stored);
    assert!(Habits::from_json(*habits.options(), &json.replace("\"slot\":0", "\"slot\":77")).is_err());
    let later = Habits::from_stored(*habits.options(), Stored { version: 9, ..stored });
    assert!(later.unwrap_err().to_string().contains("are of version 9, this program reads versions 3 to 7"));
}

/// Paths of all numbers of an export.
fn numbers(value: &serde_json::Value, path: &str, found: &mut Vec<String>) {
    match value {
        serde_json::Value::Number(_) => found.push(path.to_owned()),
        serde_json::Value::Array(items) => {
            items.iter().enumerate().for_each(|(at, item)| numbers(item, &format!("{path}/{at}"), found));
        }
        serde_json::Value::Object(items) => {
            items.iter().for_each(|(name, item)| numbers(item, &format!("{path}/{name}"), found));
        }
        _ => {}
    }
}

/// A manipulated export is refused or has no impossible effect.
#[test]
fn an_import_is_refused_or_harmless() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(3), 5);
    week(&mut habits, 3);
    let export: serde_json::Value = serde_json::from_str(&habits.to_json().unwrap()).unwrap();
    let mut paths = Vec::new();
    numbers(&export, "", &mut paths);
    let hostile = ["-1", "0", "1e-300", "0.5", "3e38", "1e39", "1e308", "65535", "4294967295", "18446744073709551615"];
    let (mut refused, mut taken) = (0, 0);
    // Of numbers that differ only in their list index, a sample.
    let mut alike: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for path in paths {
        alike.entry(path.replace(|c: char| c.is_ascii_digit(), "")).or_default().push(path);
    }
    let mut tried = Vec::new();
    for paths in alike.values() {
        for path in paths.iter().step_by(paths.len().div_ceil(4)) {
            for number in hostile {
                let mut other = export.clone();
                *other.pointer_mut(path).unwrap() = serde_json::from_str(number).unwrap();
                tried.push((format!("{path} = {number}"), other));
            }
        }
    }
    let mut twice = export.clone();
    let row = twice["rows"][0].clone();
    twice["rows"].as_array_mut().unwrap().push(row);
    tried.push(("a row twice".to_owned(), twice));
    let mut twice = export.clone();
    let count = twice["rows"][0]["counts"][0].clone();
    twice["rows"][0]["counts"].as_array_mut().unwrap().push(count);
    tried.push(("a symbol twice".to_owned(), twice));
    for (what, json) in tried {
        let Ok(mut habits) = Habits::from_json(HabitsOptions::default(), &json.to_string()) else {
            refused += 1;
            continue;
        };
        taken += 1;
        habits.bind(words(&LABELS), words(&ROOMS), shares());
        let (mut p, mut set) = (Vec::new(), Vec::new());
        let sums_to_one = |p: &[f64]| (p.iter().sum::<f64>() - 1.0).abs() < 1e-6 && p.iter().all(|p| *p >= 0.0);
        for minute in 0..70 {
            let at_s = MONDAY_S + 20.0 * DAY_S + 60.0 * f64::from(minute);
            if minute % 20 == 0 {
                habits.observe(&turn(PersonId(3), minute as usize / 20, at_s));
                assert!(sums_to_one(habits.mix(PersonId(3), at_s, &[0.2; 5])), "{what}");
                assert!(sums_to_one(habits.next_rooms(PersonId(3), at_s, &[1.0 / 3.0; 3])), "{what}");
            }
            habits.tick(PersonId(3), at_s, &mut |_, p| p.fill(0.25));
            at(&mut habits, PersonId(3), at_s, 900.0, &[0.25; 4], &mut p);
            assert!(sums_to_one(&p), "{what}: {p:?}");
            habits.room_set(PersonId(3), 900.0, &p, false, &mut set);
            assert!(set.contains(&true) && (observations(&habits, PersonId(3)) as f32).is_finite(), "{what}");
        }
        // A state with such values can be stored and read again.
        assert!(Habits::from_stored(HabitsOptions::default(), habits.stored()).is_ok(), "{what}");
    }
    assert!(refused > 100 && taken > 100, "{refused} refused, {taken} taken");
}

/// If a person changes rooms twice between two looks, a forecast's outcome is the place at its due time.
#[test]
fn where_somebody_was_is_known_until_they_go_on() {
    let mut habits = home(HabitsOptions::default());
    habits.be(PersonId(0), Place::Room(0), MONDAY_S);
    habits.tick(PersonId(0), MONDAY_S, &mut |_, p| p.fill(0.25));
    // The minute is over at 60 s.
    habits.be(PersonId(0), Place::Room(1), MONDAY_S + 70.0);
    habits.be(PersonId(0), Place::Room(2), MONDAY_S + 90.0);
    habits.tick(PersonId(0), MONDAY_S + 110.0, &mut |_, p| p.fill(0.25));
    let anchor = &habits.persons[0].stays.anchors[0];
    assert_eq!(anchor.stayed, [2.0, 3.0]);
}

/// 0.1.0 wrote version 3. Its counts are read, except for those with other numbers in their keys, and its weights are learned again.
#[test]
fn counts_of_version_3_are_read_and_its_weights_are_not() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(0), 6);
    let whole = habits.stored();
    let mut older = Stored { version: 3, ..whole.clone() };
    older.persons[0].weights = vec![0.5];
    let read = Habits::from_stored(HabitsOptions::default(), older.clone()).unwrap().stored();
    let others = [11, 19, 20, 21, 26, 31];
    let kept = whole.rows.iter().filter(|row| !others.contains(&row.kind)).cloned().collect::<Vec<_>>();
    assert!(read.rows == kept && kept.len() < whole.rows.len());
    assert_eq!((read.version, read.persons[0].observations), (stored::VERSION, whole.persons[0].observations));
    assert_ne!(read.persons[0].weights, whole.persons[0].weights);
    assert_eq!(read.persons[0].weights.len(), whole.persons[0].weights.len());
    older.version = 2;
    let refused = Habits::from_stored(HabitsOptions::default(), older).unwrap_err();
    assert!(refused.to_string().contains("are of version 2"));
}

/// Version 5 had further contexts and experts. The other counts and the sets are read, and the weights are learned again.
#[test]
fn version_5_is_read_without_its_removed_contexts_and_its_weights() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(0), 6);
    week(&mut habits, 3);
    let whole = habits.stored();
    let mut older = Stored { version: 5, ..whole.clone() };
    older.persons[0].weights.push(0.5);
    // After the last four things, and a number that no level had.
    older.rows.extend([5, 60].map(|kind| StoredRow { kind, ..whole.rows[0].clone() }));
    let read = Habits::from_stored(HabitsOptions::default(), older).unwrap().stored();
    assert!(read.rows == whole.rows && read.persons[0].anchors == whole.persons[0].anchors);
    assert_ne!(read.persons[0].weights, whole.persons[0].weights);
}

/// A year of two people who do much at random stays within the stated memory.
#[test]
fn memory_is_bounded() {
    let mut habits = Habits::new(HabitsOptions::default());
    let labels: Vec<String> = (0..150).map(|label| format!("thing {label}")).collect();
    habits.bind(labels, words(&ROOMS), vec![1.0 / 3.0; 450]);
    let mut state = 1u64;
    for step in 0..400_000u64 {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let label = (state >> 33) as usize % 150;
        let at_s = step as f64 * 80.0;
        habits.observe(&Turn { person: PersonId((step % 2) as u32), label: Some(label), room: Some(label % 3), at_s });
    }
    let learned = habits.learned();
    assert!(learned.bytes <= 5 << 20, "{learned:?}");
}

/// Each name of a flood replaces the one before, which has fewer counts than the home's names.
#[test]
fn at_the_limit_of_names_the_least_counted_one_gives_way_with_its_counts() {
    let mut habits = home(HabitsOptions { names_max: LABELS.len(), ..HabitsOptions::default() });
    mornings(&mut habits, PersonId(0), 10);
    let before = habits.home.things.names.to_vec();
    habits.bind((0..100).map(|label| format!("thing {label}")).collect(), words(&ROOMS), vec![1.0 / 3.0; 300]);
    for label in 0..100 {
        let at_s = MONDAY_S + 10.0 * DAY_S + 60.0 * label as f64;
        habits.observe(&Turn { person: PersonId(0), label: Some(label), room: Some(0), at_s });
    }
    let after = habits.home.things.names.to_vec();
    let replaced = (0..before.len()).filter(|number| before[*number] != after[*number]).collect::<Vec<_>>();
    assert_eq!((replaced.len(), after[replaced[0]].as_str()), (1, "thing 99"));
    // Bed, shower and sofa were mentioned ten times, the bed earliest in the day.
    assert_eq!(before[replaced[0]], "bed");
    // The new name has its own counts only.
    let key =
        |after| key(next::THINGS.experts[1].levels[usize::from(after != NONE)].part.number, 0, [after, NONE, NONE]);
    let number = replaced[0] as u16;
    let count = habits.counts.get(key(NONE), minute(MONDAY_S + 10.0 * DAY_S)).unwrap().count(number);
    assert!((count - 1.0).abs() < 0.01 && habits.counts.get(key(number), 0).is_none(), "{count}");
    let read = Habits::from_stored(*habits.options(), habits.stored()).unwrap();
    assert!(read.stored() == habits.stored());
    // The home is still known.
    habits.bind(words(&LABELS), words(&ROOMS), shares());
    let at_s = MONDAY_S + 11.0 * DAY_S;
    habits.observe(&turn(PersonId(0), 1, at_s));
    assert!(habits.mix(PersonId(0), at_s + 60.0, &[0.2; 5])[2] > 0.5);
}

/// A person in a place that lost its number is in an unknown place.
#[test]
fn at_the_limit_of_places_the_least_counted_one_gives_way_and_elsewhere_stays() {
    let mut habits = home(HabitsOptions::default());
    habits.be(PersonId(1), Place::Room(0), MONDAY_S);
    for room in 0..1_100 {
        habits.bind(Vec::new(), vec![format!("room {room}")], Vec::new());
        (0..2)
            .for_each(|step| habits.be(PersonId(0), [Place::Room(0), Place::Elsewhere][step], MONDAY_S + step as f64));
        assert_eq!(habits.place(PersonId(0)), Some(Place::Elsewhere));
    }
    let names = &habits.home.places.names;
    assert_eq!((names.len(), names[usize::from(ELSEWHERE)].as_str()), (1_024, "(elsewhere)"));
    assert!(names.contains(&"room 1099".to_owned()) && !names.contains(&"bedroom".to_owned()));
    habits.bind(words(&LABELS), words(&ROOMS), shares());
    assert_eq!(habits.place(PersonId(1)), None);
    assert!(Habits::from_stored(*habits.options(), habits.stored()).is_ok());
}

/// A Friday in 2024.
const NOW_S: f64 = 1_709_280_900.0;

/// Within a hundred years of now, often near it, or impossible.
fn any_time() -> impl Strategy<Value = f64> {
    const YEARS_S: f64 = 100.0 * 365.25 * DAY_S;
    prop_oneof![
        2 => (-YEARS_S..YEARS_S).prop_map(|by_s| NOW_S + by_s),
        2 => (-DAY_S..DAY_S).prop_map(|by_s| NOW_S + by_s),
        1 => (0.0..100.0 * DAY_S).prop_map(|by_s| NOW_S - by_s),
        1 => prop_oneof![Just(0.0), Just(1e300), Just(-1e300)],
    ]
}

/// Earlier versions wrote counts of no symbol, and contexts that this version does not know; only these are dropped.
#[test]
fn counts_of_nothing_are_dropped_and_all_others_are_read() {
    let mut habits = home(HabitsOptions::default());
    mornings(&mut habits, PersonId(0), 3);
    let mut stored = habits.stored();
    let whole = stored.clone();
    let mut without = stored.rows[0].clone();
    (without.slot, without.counts) = (without.slot | 0x40, vec![(0, 0.0)]);
    // The next room after the last thing, and a number that no level had.
    let unknown = [15, 30].map(|kind| StoredRow { kind, ..stored.rows[0].clone() });
    let unused = (0..).find(|symbol| stored.rows[1].counts.iter().all(|(known, _)| known != symbol)).unwrap();
    stored.rows[1].counts.push((unused, 0.0));
    stored.rows.extend(unknown.into_iter().chain([without]));
    assert!(Habits::from_stored(HabitsOptions::default(), stored.clone()).unwrap().stored() == whole);
    stored.rows[1].counts[0].1 = -1.0;
    assert!(Habits::from_stored(HabitsOptions::default(), stored).is_err());
}

proptest! {
    /// Habits that were learned with any clock can be read again. After `shift_counts`, new counts weigh nearly as much as in new habits.
    #[test]
    fn whatever_the_clocks_say_it_is_read_again_and_now_counts(
        past in prop::collection::vec((any_time(), 0..3u32, 0..5usize, 0..5u8), 0..60),
        half_life_days in prop_oneof![Just(0.0), 0.001..1.0f64, 1.0..400.0f64],
    ) {
        let options = HabitsOptions { half_life_days, ..HabitsOptions::default() };
        let mut habits = home(options);
        for (at_s, person, label, what) in past {
            match what {
                0 => habits.be(PersonId(person), Place::Room(ROOM_OF[label]), at_s),
                1 => habits.be(PersonId(person), Place::Elsewhere, at_s),
                2 => habits.tick(PersonId(person), at_s, &mut |_, p| p.fill(1.0)),
                _ => {
                    habits.mix(PersonId(person), at_s, &[0.2; 5]);
                    habits.observe(&turn(PersonId(person), label, at_s));
                }
            }
        }
        let read = Habits::from_stored(options, habits.stored());
        prop_assert!(read.is_ok(), "{:?}", read.err());
        prop_assert!(Habits::from_json(options, &habits.to_json().unwrap()).is_ok());
        let now = |mut habits: Habits| {
            habits.shift_counts(0.0, NOW_S);
            habits.bind(words(&LABELS), words(&ROOMS), shares());
            for step in 0..20u8 {
                let at_s = NOW_S + 60.0 * f64::from(step);
                let forecast = habits.mix(PersonId(0), at_s, &[0.2; 5]);
                assert!(forecast.iter().all(|p| (0.0..=1.0).contains(p)), "{forecast:?}");
                habits.observe(&turn(PersonId(0), usize::from(step % 2), at_s));
            }
            habits.mix(PersonId(0), NOW_S + 1_200.0, &[0.2; 5]);
            habits.explain(PersonId(0), 0).unwrap().observations[1]
        };
        let (after, alone) = (now(read.unwrap()), now(home(options)));
        prop_assert!(after > 0.98 * alone - 0.05, "{after} of {alone}");
    }

    /// Over any day the mixture's loss exceeds the model's by no more than its bounds: for another thing, and for the same thing again.
    #[test]
    fn a_day_is_never_much_worse_than_the_model(
        steps in prop::collection::vec((0..5usize, 0.01..1.0f64, 0.01..1.0f64), 1..200),
    ) {
        let mut habits = home(HabitsOptions::default());
        let (mut mixture, mut model) = (0.0, 0.0);
        let mut at_s = MONDAY_S;
        for (label, one, other) in steps {
            let mut p = [one, other, 0.2, 0.2, 0.2];
            let total: f64 = p.iter().sum();
            p.iter_mut().for_each(|p| *p /= total);
            mixture -= habits.mix(PersonId(0), at_s, &p)[label].ln();
            model -= p[label].ln();
            habits.observe(&turn(PersonId(0), label, at_s));
            at_s += 60.0;
            let steps = ((at_s - MONDAY_S) / 60.0) as usize;
            let begun = next::FIRST[0].map(|first| mixture::tests::bound_nats(first, next::SHARE, 1));
            let bound = begun[0] + begun[1] + 2.0 * steps as f64 * -(1.0 - next::SHARE).ln();
            prop_assert!(mixture <= model + bound + 1e-4 * steps as f64, "{mixture} {model} {bound}");
        }
    }

    /// As above for the next room, with separate bounds of staying and destination.
    #[test]
    fn a_day_of_rooms_is_never_much_worse_than_the_model(
        steps in prop::collection::vec((0..5usize, 0.02..1.0f64, 0.02..1.0f64), 1..200),
    ) {
        let mut habits = home(HabitsOptions::default());
        let (mut mixture, mut model) = (0.0, 0.0);
        let mut at_s = MONDAY_S;
        for (step, (label, one, other)) in steps.into_iter().enumerate() {
            let mut p = [one, other, 0.2];
            let total: f64 = p.iter().sum();
            p.iter_mut().for_each(|p| *p /= total);
            habits.mix(PersonId(0), at_s, &[0.2; 5]);
            mixture -= habits.next_rooms(PersonId(0), at_s, &p)[ROOM_OF[label]].ln();
            model -= p[ROOM_OF[label]].ln();
            habits.observe(&turn(PersonId(0), label, at_s));
            at_s += 60.0;
            let begun = next::FIRST[1].map(|first| mixture::tests::bound_nats(first, next::SHARE, 1));
            let bound = begun[0] + begun[1] + 2.0 * (step + 1) as f64 * -(1.0 - next::SHARE).ln();
            prop_assert!(mixture <= model + bound + 1e-3 * (step + 1) as f64, "{mixture} {model} {bound}");
        }
    }

    #[test]
    fn forecasts_are_probabilities_whatever_is_told(
        told in prop::collection::vec((0..3u32, prop::option::of(0..7usize), prop::option::of(0..5usize), -1e5..1e7f64), 0..60),
    ) {
        let mut habits = home(HabitsOptions { names_max: 3, contexts_max: 40, counts_max: 50, ..HabitsOptions::default() });
        let mut p = Vec::new();
        for (person, label, room, at_s) in told {
            habits.observe(&Turn { person: PersonId(person), label, room, at_s });
            if let Some(room) = room {
                habits.be(PersonId(person), if room == 4 { Place::Elsewhere } else { Place::Room(room) }, at_s);
            } else {
                habits.come_back(PersonId(person), at_s);
            }
            habits.tick(PersonId(person), at_s, &mut |_, p| p.fill(0.0));
            let labels: f64 = habits.mix(PersonId(person), at_s, &[0.0, 1.0, 0.0, 0.3, 0.0]).iter().sum();
            let rooms: f64 = habits.next_rooms(PersonId(person), at_s, &[0.5, 0.0, 0.5]).iter().sum();
            at(&mut habits, PersonId(person), at_s + f64::from(person) * 700.0, 777.0, &[0.0, 0.5, 0.5, 0.0], &mut p);
            prop_assert!((labels - 1.0).abs() < 1e-6 && (rooms - 1.0).abs() < 1e-6);
            prop_assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-6 && p.iter().all(|p| *p >= 0.0));
        }
    }
}

/// A person in the bedroom from seven and in the kitchen from eight, watched every minute.
fn watched_days(habits: &mut Habits, days: std::ops::Range<usize>) {
    for day in days {
        for minute in 0..180 {
            let now_s = MONDAY_S + day as f64 * DAY_S + 7.0 * 3_600.0 + 60.0 * f64::from(minute);
            match minute {
                0 => habits.be(PersonId(0), Place::Room(0), now_s),
                60 => habits.be(PersonId(0), Place::Room(2), now_s),
                _ => {}
            }
            habits.tick(PersonId(0), now_s, &mut |_, p| p.fill(0.25));
        }
        habits.be(PersonId(0), Place::Elsewhere, MONDAY_S + day as f64 * DAY_S + 10.0 * 3_600.0);
    }
}

#[test]
fn several_times_at_once_are_as_each_by_itself() {
    let mut habits = home(HabitsOptions::default());
    watched_days(&mut habits, 0..5);
    let now_s = MONDAY_S + 5.0 * DAY_S + 7.5 * 3_600.0;
    habits.be(PersonId(0), Place::Room(0), now_s - 1_800.0);
    assert_eq!(habits.place(PersonId(0)), Some(Place::Room(0)));
    let (horizons_s, shipped) = ([0.0, 60.0, 1_800.0, 3_600.0], [0.25; 16]);
    let (mut all, mut shares, mut one) = (Vec::new(), Vec::new(), Vec::new());
    habits.at_times(PersonId(0), (now_s, &horizons_s), &shipped, &mut all, &mut shares);
    for (horizon_s, (row, share)) in horizons_s.into_iter().zip(all.chunks_exact(4).zip(&shares)) {
        let alone = at(&mut habits, PersonId(0), now_s, horizon_s, &shipped[..4], &mut one);
        assert_eq!(alone, *share, "{horizon_s}");
        assert!(row.iter().zip(&one).all(|(row, one)| (row - one).abs() < 0.01), "{row:?} {one:?}");
        assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-9);
    }
    assert!(all[0] > 0.7 && all[3 * 4 + 2] > 0.5, "{all:?}");
}

#[test]
fn visits_are_counted_by_room_and_part_of_the_day_of_all_persons_together() {
    let mut habits = home(HabitsOptions { half_life_days: 0.0, ..HabitsOptions::default() });
    assert_eq!(habits.visits(MONDAY_S), [[0.0; PARTS]; 3]);
    let at_s = |hour: f64| MONDAY_S + 3_600.0 * hour;
    for person in [3, 8] {
        habits.be(PersonId(person), Place::Room(0), at_s(0.0));
        habits.be(PersonId(person), Place::Room(1), at_s(7.0));
        habits.be(PersonId(person), Place::Room(2), at_s(7.5));
    }
    habits.be(PersonId(3), Place::Elsewhere, at_s(10.0));
    habits.be(PersonId(3), Place::Room(2), at_s(22.0));
    habits.be(PersonId(3), Place::Room(0), at_s(23.9));
    let mut visits = [[0.0; PARTS]; 3];
    // Both persons left bedroom and bathroom between six and nine. The person still in the kitchen has not left it.
    (visits[0][2], visits[1][2], visits[2][3], visits[2][7]) = (2.0, 2.0, 1.0, 1.0);
    assert_eq!(habits.visits(at_s(24.0)), visits);
    habits.forget(PersonId(8));
    (visits[0][2], visits[1][2]) = (1.0, 1.0);
    assert_eq!(habits.visits(at_s(24.0)), visits);
    // A map with other rooms shows no visits; the counts stay for their rooms.
    habits.bind(words(&LABELS), words(&["hall"]), vec![0.0; LABELS.len()]);
    assert_eq!(habits.visits(at_s(24.0)), [[0.0; PARTS]]);
}

/// A clock step is not time spent, and unobserved time is not learned.
#[test]
fn time_that_nobody_watched_is_not_learned() {
    let mut habits = home(HabitsOptions::default());
    watched_days(&mut habits, 0..3);
    let now_s = MONDAY_S + 3.0 * DAY_S + 7.0 * 3_600.0;
    habits.be(PersonId(0), Place::Room(0), now_s);
    let state = |habits: &Habits| (habits.stored().rows, habits.stored().persons, habits.home.things.names.len());
    let before = state(&habits);
    habits.pass(now_s + 3_600.0);
    habits.shift_clock(-7_200.0);
    habits.tick(PersonId(0), now_s - 3_600.0, &mut |_, p| p.fill(0.25));
    assert!(state(&habits) == before);
    habits.set_learning(false);
    habits.observe(&turn(PersonId(0), 2, now_s));
    habits.be(PersonId(0), Place::Elsewhere, now_s + 60.0);
    assert!(state(&habits) == before);
    habits.set_learning(true);
    habits.be(PersonId(0), Place::Room(0), now_s + 120.0);
    assert!(state(&habits) != before);
}
