use roomcast_core::grounding::GroundingOptions;
use roomcast_core::ids::PersonId;
use roomcast_core::narration::{Event, Quota, SensorReport, Sentence};
use roomcast_core::pipeline::Pipeline;
use roomcast_core::scorer::table::TableModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::semantic_map::delta::parse_changes;
use roomcast_ipc::raw::Message;

use super::super::engine::HORIZONS_S;
use super::super::intake::OTHERS;
use super::super::{Engine, Entry, Persons, PersonsFile, Recovered};
use super::*;

const S: u64 = 1_000_000_000;
const TWO_ROOMS: &str = include_str!("../../../../tests/data/two_rooms.json");
/// A Monday, in seconds since 1970.
const MONDAY_S: u64 = 1_704_067_200;
const DAY_S: u64 = 86_400;
const H: u64 = 3_600;
/// The monotonic clock then.
const BEGIN_NS: u64 = 1_000 * S;
const KITCHEN: usize = 0;
const LIVING_ROOM: usize = 1;
/// The kind of stays by place and time spent, in an export.
const STAYS_BY_PLACE: u8 = 20;
/// Horizons of the messages: a quarter of an hour, and an hour.
const QUARTER: usize = 13;
const HOUR: usize = 15;

fn options(learn: bool) -> HabitsOptions {
    HabitsOptions { learn, ..HabitsOptions::default() }
}

fn engine(home: Option<HomeHabits>) -> Engine<TableModel> {
    let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
    let pipeline = Pipeline::of(&map, TableModel::new(7)).unwrap();
    let engine = Engine::new(pipeline, map, GroundingOptions::default(), 1).unwrap();
    match home {
        Some(home) => engine.with_habits(home),
        None => engine,
    }
}

/// A daemon without threads, with its journal and its clocks.
struct House {
    engine: Engine<TableModel>,
    journal: Vec<Observation>,
    now_ns: u64,
    /// Wall clock minus monotonic clock.
    unix_ns: u64,
}

impl House {
    fn new(learn: bool) -> Self {
        let engine = engine(Some(HomeHabits::new(Memory::new(options(learn)), Zone::UTC)));
        Self { engine, journal: Vec::new(), now_ns: BEGIN_NS, unix_ns: MONDAY_S * S - BEGIN_NS }
    }

    /// Advances the clocks to so many seconds after the Monday began, with a tick every minute.
    fn until(&mut self, at_s: u64) {
        let until_ns = BEGIN_NS + at_s * S;
        while self.now_ns < until_ns {
            self.now_ns = until_ns.min(self.now_ns + 60 * S);
            self.engine.tick(BootNs(self.now_ns), UnixNs(self.now_ns + self.unix_ns));
        }
    }

    fn say(&mut self, person: PersonId, at_s: u64, text: &str) {
        let event = Event::presence(text).unwrap_or_else(|_| Event::Did(Sentence::new(text).unwrap()));
        self.hear(person, at_s, event);
    }

    fn hear(&mut self, person: PersonId, at_s: u64, event: Event) {
        self.until(at_s);
        let observation = Observation {
            person,
            source: 7,
            epoch: 1,
            observed_ns: BootNs(self.now_ns),
            observed_unix_ns: UnixNs(self.now_ns + self.unix_ns),
            by_fit: matches!(event, Event::Sensor(_)),
            event,
            ..Observation::of(self.journal.len() as u64 + 1, Sentence::new("They wait.").unwrap())
        };
        self.journal.push(observation.clone());
        let entry = Entry::new(observation, BootNs(self.now_ns));
        self.engine.step([entry], BootNs(self.now_ns), UnixNs(self.now_ns + self.unix_ns)).unwrap();
        self.engine.tell_outcomes(|_| {});
        self.engine.tidy();
    }

    /// A day: the living room from seven, the kitchen half an hour later, out from nine to five, and then in the kitchen.
    fn day(&mut self, person: PersonId, day: u64) {
        let midnight_s = day * DAY_S;
        for (hour, minute, text) in [
            (7, 0, "They sit on the sofa."),
            (7, 10, "They stand up."),
            (7, 30, "They grab the coffee maker."),
            (7, 40, "They open the fridge."),
            (9, 0, "away"),
            (17, 0, "They grab the coffee maker."),
        ] {
            self.say(person, midnight_s + hour * H + minute * 60, text);
        }
    }

    /// The stored state if the daemon is killed now.
    fn memory(&mut self) -> Memory {
        self.engine.tidy();
        self.engine.habits_mut().changed = true;
        let mut memory = self.engine.habits_mut().memory_if_changed().unwrap();
        memory.habits = Habits::from_stored(options(true), memory.habits.stored()).unwrap();
        memory
    }

    /// Restarts the daemon with a stored state.
    fn restart(&mut self, memory: Memory) {
        let home = HomeHabits::new(memory, Zone::UTC);
        self.engine = engine(Some(home));
        let mut recovered = Recovered::default();
        recovered.observations.clone_from(&self.journal);
        self.engine.restore(recovered, BootNs(self.now_ns), UnixNs(self.now_ns + self.unix_ns));
        self.engine.step([], BootNs(self.now_ns), UnixNs(self.now_ns + self.unix_ns)).unwrap();
    }

    fn observations(&self) -> f64 {
        self.engine.habits().learned().observations
    }

    /// The person's probability per place (elsewhere last) at a horizon.
    fn ahead(&mut self, person: PersonId, horizon: usize) -> [f32; 3] {
        self.engine.person_scores(BootNs(self.now_ns));
        let told = *self.engine.person_forecasts(BootNs(self.now_ns));
        told.check().unwrap();
        let own = told.persons().iter().find(|own| own.person == person.0).unwrap();
        let p = [own.probability[KITCHEN][horizon], own.probability[LIVING_ROOM][horizon], own.elsewhere[horizon]];
        assert!((p.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{p:?}");
        p
    }
}

/// The machine has no battery for its clock, or a user sets the wrong year.
#[test]
fn a_start_with_a_wrong_clock_costs_at_most_a_week_of_fading() {
    const YEAR_NS: u64 = 365 * DAY_S * S;
    // The sum of the counts, decayed to the time of the house.
    let worth = |house: &House| {
        let json: serde_json::Value = serde_json::from_str(&house.engine.habits().to_json().unwrap()).unwrap();
        let now_min = ((house.now_ns + house.unix_ns) / S / 60) as f64;
        let rows = json["rows"].as_array().unwrap().iter().map(|row| {
            let counts: f64 = row["counts"].as_array().unwrap().iter().map(|count| count[1].as_f64().unwrap()).sum();
            counts * (-((now_min - row["touched_min"].as_f64().unwrap()) / (60.0 * 1_440.0)).max(0.0)).exp2()
        });
        rows.sum::<f64>()
    };
    let mut house = House::new(true);
    (0..5).for_each(|day| house.day(PersonId(1), day));
    let right_ns = house.unix_ns;
    for wrong_ns in [right_ns + YEAR_NS, right_ns - YEAR_NS, BEGIN_NS] {
        let before = worth(&house);
        house.unix_ns = wrong_ns;
        let memory = house.memory();
        house.restart(memory);
        house.say(PersonId(1), (house.now_ns - BEGIN_NS) / S + 60, "They open the fridge.");
        // The clock is corrected while the daemon runs, or before the next start.
        house.unix_ns = right_ns;
        if wrong_ns == BEGIN_NS {
            house.until((house.now_ns - BEGIN_NS) / S + 120);
        } else {
            let memory = house.memory();
            house.restart(memory);
        }
        let after = worth(&house);
        // The counts decay by a week at most.
        assert!(after > 0.9 * before, "{after} of {before} with a clock of {wrong_ns}");
    }
}

/// A sensor event from before the last action changes neither belief nor habits.
#[test]
fn a_late_word_of_a_sensor_moves_nobody() {
    let mut house = House::new(true);
    house.say(PersonId(1), 0, "present in the kitchen");
    house.say(PersonId(1), 60, "They grab the coffee maker.");
    let before = house.ahead(PersonId(1), QUARTER);
    let at_ns = house.now_ns;
    house.now_ns -= 20 * S;
    house.say(PersonId(1), 0, "present in the living room");
    house.now_ns = at_ns;
    let after = house.ahead(PersonId(1), QUARTER);
    assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-6), "{before:?} {after:?}");
    assert_eq!(house.engine.habits().visits()[KITCHEN].iter().sum::<f64>(), 0.0);
}

/// A sensor saw one of two persons, and the filter learned later whose visit that was. The restarted filter finds it again.
#[test]
fn a_restart_teaches_no_inferred_visit_twice() {
    let mut house = House::new(true);
    let both = [PersonId(1), PersonId(2)];
    both.into_iter().for_each(|person| house.say(person, 0, "present in the living room"));
    for (at_s, on) in [(30, false), (600, true)] {
        let report = format!(r#"{{"sensor":"presence","id":"oven","room":"kitchen","on":{on}}}"#);
        house.hear(PersonId(0), at_s, Event::Sensor(SensorReport::parse(&report).unwrap().into()));
    }
    (0..2).for_each(|_| house.say(PersonId(2), 660, "present in the living room"));
    house.until(900);
    let visits = |house: &House| house.engine.habits().visits().as_flattened().iter().sum::<f64>();
    let before = visits(&house);
    let memory = house.memory();
    house.restart(memory);
    house.until(1_200);
    assert!((before - 1.0).abs() < 0.01 && (visits(&house) - before).abs() < 0.01, "{before} {}", visits(&house));
}

/// An empty room ends the stay of the person believed there; the person's place is unknown until the next event.
#[test]
fn nobody_stays_where_it_is_empty() {
    let mut house = House::new(true);
    house.say(PersonId(1), 0, "They grab the coffee maker.");
    house.say(PersonId::SOMEBODY, 60, "nobody in the kitchen");
    house.until(7_200);
    let minutes = |house: &House| {
        let json: serde_json::Value = serde_json::from_str(&house.engine.habits().to_json().unwrap()).unwrap();
        let rows = json["rows"].as_array().unwrap().iter();
        let stays = rows.filter(|row| row["kind"] == STAYS_BY_PLACE);
        let counts = stays.flat_map(|row| row["counts"].as_array().unwrap().clone());
        counts.filter(|count| count[0] == 1).map(|count| count[1].as_f64().unwrap()).sum::<f64>()
    };
    assert!((minutes(&house) - 1.0).abs() < 0.1, "{}", minutes(&house));
    assert_eq!(house.engine.habits().visits()[KITCHEN].iter().sum::<f64>(), 0.0, "where to is not known");
    // Sets cover the belief.
    let [kitchen, living_room, _] = house.ahead(PersonId(1), 0);
    assert!(living_room > 0.9 && kitchen < 0.1);
    let told = *house.engine.person_forecasts(BootNs(house.now_ns));
    assert_eq!(told.persons()[0].set_holds(0, LIVING_ROOM), Some(true));
    house.say(PersonId(1), 7_260, "They sit on the sofa.");
    house.say(PersonId(1), 7_320, "away");
    assert!(house.engine.habits().visits()[LIVING_ROOM].iter().sum::<f64>() > 0.9);
}

/// A day of a home with a narrator that reports "present" when a phone is back, two minutes before a sensor reports the kitchen. Evening and night
/// are spent in the living room.
fn commuter(house: &mut House, day: u64) {
    let midnight_s = day * DAY_S;
    for (hour, minute, text) in [
        (7, 30, "away"),
        (16, 36, "present"),
        (16, 38, "present in the kitchen"),
        (19, 0, "present in the living room"),
    ] {
        house.say(PersonId(4), midnight_s + hour * H + minute * 60, text);
    }
}

/// After a return the forecast is not the room of the nights, and no unreported visit to it is learned. A restarted daemon forecasts the same.
#[test]
fn who_comes_home_is_not_where_they_spend_their_nights() {
    let horizon_of = |seconds: f32| HORIZONS_S.iter().position(|horizon_s| *horizon_s == seconds).unwrap();
    let horizons = [60.0, 300.0, 900.0].map(horizon_of);
    let mut house = House::new(true);
    (0..10).for_each(|day| commuter(&mut house, day));
    let now_s = 10 * DAY_S + 16 * H + 36 * 60;
    house.say(PersonId(4), 10 * DAY_S + 7 * H + 1_800, "away");
    let visits = |house: &House| house.engine.habits().visits()[LIVING_ROOM][16 / 3];
    assert!(visits(&house) < 0.01, "they were never there at that time: {}", visits(&house));
    let out = |house: &mut House| {
        house.until(now_s - 60);
        house.ahead(PersonId(4), QUARTER)
    };
    assert!(out(&mut house)[KITCHEN] > 0.2, "while they are out");
    house.say(PersonId(4), now_s, "present");
    for horizon in horizons {
        let [kitchen, living_room, elsewhere] = house.ahead(PersonId(4), horizon);
        assert!(kitchen > 0.5 && kitchen > 2.0 * living_room && elsewhere < 0.2, "{kitchen} {living_room} {elsewhere}");
    }
    // The same after a return without a room, and after an action without a room.
    for text in ["present", "They stand up."] {
        let mut again = House::new(true);
        (0..10).for_each(|day| commuter(&mut again, day));
        again.say(PersonId(4), 10 * DAY_S + 7 * H + 1_800, "away");
        again.say(PersonId(4), now_s, text);
        let before = horizons.map(|horizon| again.ahead(PersonId(4), horizon));
        assert!(before.iter().all(|[kitchen, living_room, _]| kitchen > living_room), "{text}: {before:?}");
        let memory = again.memory();
        again.restart(memory);
        let after = horizons.map(|horizon| again.ahead(PersonId(4), horizon));
        let pairs = before.iter().flatten().zip(after.iter().flatten());
        assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-3), "{text}: {before:?} {after:?}");
        again.say(PersonId(4), now_s + 120, "present in the kitchen");
        assert!(again.ahead(PersonId(4), 0)[KITCHEN] > 0.95);
        again.say(PersonId(4), now_s + 3_600, "present in the living room");
        assert!(visits(&again) < 0.01, "{text}: {}", visits(&again));
    }
}

/// A person who may be in any room is in no set of one room.
#[test]
fn a_set_holds_what_it_promises_where_nothing_is_known() {
    let held = |house: &mut House| {
        house.engine.person_scores(BootNs(house.now_ns));
        let told = *house.engine.person_forecasts(BootNs(house.now_ns));
        let own = told.persons()[0];
        let sum = |horizon: usize| {
            let rooms = [KITCHEN, LIVING_ROOM].into_iter().filter(|room| own.set_holds(horizon, *room).unwrap());
            let elsewhere = if own.set_holds_elsewhere(horizon).unwrap() { own.elsewhere[horizon] } else { 0.0 };
            rooms.map(|room| own.probability[room][horizon]).sum::<f32>() + elsewhere
        };
        (0..MAX_HORIZONS).map(sum).fold(1.0, f32::min)
    };
    // A new home, where sets have no outcomes.
    let mut house = House::new(true);
    house.say(PersonId(4), 60, "present in the kitchen");
    assert!(held(&mut house) > 0.899, "{}", held(&mut house));
    house.say(PersonId(4), 120, "away");
    house.say(PersonId(4), 3_600, "present");
    assert!(held(&mut house) > 0.899, "{}", held(&mut house));
    // A home with days of outcomes; its threshold belongs to persons with a reported room.
    (1..10).for_each(|day| commuter(&mut house, day));
    house.say(PersonId(4), 10 * DAY_S + 7 * H + 1_800, "away");
    house.say(PersonId(4), 10 * DAY_S + 12 * H, "present");
    assert!(held(&mut house) > 0.899, "{}", held(&mut house));
}

/// A person that leaves a new home is not back within the minute: stays in rooms do not predict the length of an absence.
#[test]
fn who_has_just_left_a_new_home_is_out() {
    let mut house = House::new(true);
    house.say(PersonId(1), 10, "They grab the coffee maker.");
    house.say(PersonId(1), 40, "They sit on the sofa.");
    house.say(PersonId(1), 60, "away");
    let horizon_of = |seconds: f32| HORIZONS_S.iter().position(|horizon_s| *horizon_s == seconds).unwrap();
    for (seconds, least) in [(60.0, 0.95), (900.0, 0.85), (3600.0, 0.55)] {
        let [.., elsewhere] = house.ahead(PersonId(1), horizon_of(seconds));
        assert!(elsewhere >= least, "{seconds} s: {elsewhere}");
    }
}

/// All published messages, without the fields that name the moment.
fn told(
    engine: &mut Engine<TableModel>,
    now_ns: u64,
) -> (roomcast_ipc::raw::ForecastV1, roomcast_ipc::raw::PersonForecastsV1) {
    (*engine.forecast(BootNs(now_ns)), *engine.person_forecasts(BootNs(now_ns)))
}

/// The same daemon without habits.
fn without_habits(house: &House) -> Engine<TableModel> {
    let mut plain = engine(None);
    for observation in house.journal.clone() {
        let now_ns = observation.observed_ns;
        plain.step([Entry::new(observation, now_ns)], now_ns, UnixNs(now_ns.0 + house.unix_ns)).unwrap();
        plain.tell_outcomes(|_| {});
        plain.tidy();
        plain.person_scores(now_ns);
    }
    plain
}

/// A daemon without learning and without habits forecasts exactly as one without this feature.
#[test]
fn without_learning_nothing_changes() {
    let mut house = House::new(false);
    for day in 0..2 {
        for person in 1..3 {
            house.day(PersonId(person), 2 * day + u64::from(person) - 1);
        }
    }
    let mut plain = without_habits(&house);
    for later_s in [0, 7, 100, 4_000] {
        let now_ns = house.now_ns + later_s * S;
        assert_eq!(told(&mut house.engine, now_ns), told(&mut plain, now_ns));
    }
    assert_eq!(house.engine.habits().learned().counts, 0);
    assert!(house.engine.habits_mut().memory_if_changed().is_none(), "there is nothing to write");
}

/// An answer about a person's place and the forecast for now showed 69 % and 87 %.
#[test]
fn where_a_person_is_believed_to_be_is_the_forecast_for_now() {
    let mut house = House::new(true);
    (0..3).for_each(|day| house.day(PersonId(3), day));
    house.say(PersonId(3), 3 * DAY_S + 7 * H, "They sit on the sofa.");
    let sensor = "present in the kitchen";
    for (later_s, text) in [(20, None), (60, Some(sensor)), (90, None)] {
        let at_s = 3 * DAY_S + 7 * H + later_s;
        house.until(at_s);
        text.into_iter().for_each(|text| house.say(PersonId(3), at_s, text));
        let [kitchen, living_room, elsewhere] = house.ahead(PersonId(3), 0);
        let found = house.engine.whereabouts(PersonId(3), BootNs(house.now_ns));
        assert!(found.places[0].probability > 0.5);
        for own in found.places {
            let published = match own.place.as_str() {
                "kitchen" => kitchen,
                "living-room" => living_room,
                _ => elsewhere,
            };
            assert!((own.probability - f64::from(published)).abs() < 1e-6, "{later_s} s, {}: {published}", own.place);
        }
    }
}

#[test]
fn a_routine_becomes_the_forecast_and_is_forgotten() {
    let mut house = House::new(true);
    for day in 0..14 {
        house.day(PersonId(3), day);
    }
    house.say(PersonId(3), 14 * DAY_S + 7 * H, "They sit on the sofa.");
    house.until(14 * DAY_S + 7 * H + 1_200);
    let known = house.ahead(PersonId(3), QUARTER);
    let shipped = without_habits(&house).forecast(BootNs(house.now_ns)).probability[KITCHEN][QUARTER];
    assert!(known[KITCHEN] > shipped + 0.15 && known[KITCHEN] > 0.5, "{known:?} {shipped}");
    // With one person the forecast of all persons is that person's.
    let all = *house.engine.forecast(BootNs(house.now_ns));
    assert!((all.probability[KITCHEN][QUARTER] - known[KITCHEN]).abs() < 1e-6);
    let (sure, shares) = house.engine.habits().shares(PersonId(3)).unwrap();
    assert!(sure > 0.5 && shares[QUARTER].shipped < 0.2, "{sure} {shares:?}");
    // An absent person returns at five, as on earlier days.
    house.say(PersonId(3), 14 * DAY_S + 9 * H, "away");
    house.until(14 * DAY_S + 12 * H);
    let at_noon = house.ahead(PersonId(3), HOUR)[2];
    house.until(14 * DAY_S + 17 * H - 120);
    let soon_back = house.ahead(PersonId(3), HOUR)[2];
    assert!(soon_back < at_noon - 0.05, "{at_noon} {soon_back}");
    assert!(house.ahead(PersonId(3), 0)[2] > 0.9);

    assert!(house.engine.habits_mut().forget(PersonId(3)));
    assert!(!house.engine.habits_mut().forget(PersonId(3)));
    let (now_ns, mut plain) = (house.now_ns, without_habits(&house));
    assert_eq!(told(&mut house.engine, now_ns), told(&mut plain, now_ns));
}

/// Sets are the smallest with the promised coverage, and the messages state their basis; without habits there are none.
#[test]
fn sets_and_their_grounds_are_told_of_each_person() {
    let mut house = House::new(true);
    for day in 0..14 {
        house.day(PersonId(3), day);
    }
    house.say(PersonId(3), 14 * DAY_S + 7 * H, "They sit on the sofa.");
    house.until(14 * DAY_S + 7 * H + 1_200);
    house.ahead(PersonId(3), QUARTER);
    let message = *house.engine.person_forecasts(BootNs(house.now_ns));
    message.check().unwrap();
    let own = message.persons()[0];
    assert!((own.set_coverage - 0.9).abs() < 1e-6 && message.minor == 1);
    assert_eq!(own.observations, house.observations() as f32);
    assert!(own.learned_share[1] > 0.5 && own.learned_share.iter().all(|share| (0.0..=1.0).contains(share)), "{own:?}");
    for horizon in 0..MAX_HORIZONS {
        let places =
            [(KITCHEN, own.probability[KITCHEN][horizon]), (LIVING_ROOM, own.probability[LIVING_ROOM][horizon])];
        let likeliest = places.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        let elsewhere = (own.set_holds_elsewhere(horizon).unwrap(), own.elsewhere[horizon]);
        let held = places.map(|(room, p)| (own.set_holds(horizon, room).unwrap(), p));
        assert!(own.set_holds(horizon, likeliest.0).unwrap() || elsewhere.0, "the likeliest place is in every set");
        // Every place that is likelier than one of the set is in the set, too.
        let all = [held[0], held[1], elsewhere];
        let least = all.iter().filter(|(held, _)| *held).map(|(_, p)| *p).fold(1.0, f32::min);
        assert!(all.iter().all(|(held, p)| *held || *p <= least), "{horizon}: {all:?}");
    }
    let reasons = house.engine.moment(BootNs(house.now_ns));
    let learned = reasons.habits_of(PersonId(3)).unwrap();
    assert_eq!((learned.forecast.len(), learned.coverage), (3, 0.9));
    assert!(learned.forecast.iter().all(|line| !line.set.is_empty()), "{learned}");
    let thing = &learned.things[0].shares;
    let sum = thing.model + thing.habit + thing.hour;
    assert!((sum - 1.0).abs() < 1e-6 && thing.observations[0] > 10.0, "{thing:?}");
    let room = &learned.rooms[0].shares;
    let sum = room.model + room.habit + room.things.unwrap() + room.hour;
    assert!((sum - 1.0).abs() < 1e-6 && room.observations[0] > 10.0, "{room:?}");
    let total: f64 = learned.rooms.iter().map(|room| room.shares.probability).sum();
    assert!((total - 1.0).abs() < 1e-6, "{total}");

    let mut plain = without_habits(&house);
    let nothing = *plain.person_forecasts(BootNs(house.now_ns));
    let own = nothing.persons()[0];
    assert_eq!((own.set_coverage, own.observations, own.room_set), (0.0, 0.0, [0; MAX_HORIZONS]));
    assert!(plain.moment(BootNs(house.now_ns)).habits.is_empty());
}

/// Each observation is learned once, at whatever time the daemon is killed and whatever it had stored.
#[test]
fn nothing_is_learned_twice() {
    let mut house = House::new(true);
    house.day(PersonId(3), 0);
    let sentences = house.observations();
    assert!(sentences >= 4.0, "{sentences}");
    let minutes = |house: &House| house.engine.habits().learned();
    // Killed before anything was stored: the journal has all observations.
    let nothing = Memory::new(options(true));
    house.restart(nothing.clone());
    assert_eq!(house.observations(), sentences);
    // Killed several times, with everything stored.
    for _ in 0..3 {
        let memory = house.memory();
        let before = memory.habits.to_json().unwrap();
        house.restart(memory);
        assert_eq!(house.observations(), sentences);
        assert_eq!(house.engine.habits().to_json().unwrap(), before);
    }
    // With an earlier stored state.
    let early = house.memory();
    house.day(PersonId(3), 1);
    let (all, learned) = (house.observations(), minutes(&house));
    assert!(all > sentences);
    house.restart(early.clone());
    assert_eq!(house.observations(), all);
    assert_eq!(minutes(&house).names, learned.names);
    // A narrator that resends an event that the journal lost in a power failure teaches nothing.
    let late = house.memory();
    let again = house.journal.pop().unwrap();
    house.restart(late);
    house
        .engine
        .step(
            [Entry::new(again.clone(), BootNs(house.now_ns))],
            BootNs(house.now_ns),
            UnixNs(house.now_ns + house.unix_ns),
        )
        .unwrap();
    house.engine.tidy();
    house.journal.push(again);
    assert_eq!(house.observations(), all);
    // The journal lacks the older and then the newer observations: the order of learning is unknown.
    house.journal.drain(..3);
    let memory = house.memory();
    house.restart(memory);
    assert_eq!(house.observations(), all);
    for (sequence, observation) in (100..).zip(&mut house.journal) {
        (observation.epoch, observation.sequence) = (9, sequence);
    }
    let memory = house.memory();
    house.restart(memory);
    assert_eq!(house.observations(), all);
}

/// Time without a daemon, and a clock step, are not time spent.
#[test]
fn time_that_nobody_watched_is_not_counted() {
    let mut house = House::new(true);
    for day in 0..5 {
        house.day(PersonId(3), day);
    }
    house.say(PersonId(3), 5 * DAY_S + 7 * H, "They sit on the sofa.");
    let stays = |house: &mut House| house.engine.habits().to_json().unwrap();
    let memory = house.memory();
    let before = memory.habits.to_json().unwrap();
    // Twenty minutes without a daemon.
    house.now_ns += 1_200 * S;
    house.restart(memory);
    assert_eq!(stays(&mut house), before);
    // The clock is set by half a day; a minute later one minute was counted.
    let minute = |house: &mut House| {
        house.now_ns += 60 * S;
        house.engine.tick(BootNs(house.now_ns), UnixNs(house.now_ns + house.unix_ns));
    };
    house.unix_ns += 12 * H * S;
    minute(&mut house);
    let set = house.ahead(PersonId(3), 0);
    assert!(set[LIVING_ROOM] > 0.5, "{set:?}");
    house.unix_ns -= 400 * DAY_S * S;
    (0..10).for_each(|_| minute(&mut house));
    let at_home: f32 = house.ahead(PersonId(3), 0)[..2].iter().sum();
    assert!(at_home > 0.9, "{at_home}");
}

#[test]
fn habits_survive_a_change_of_the_map() {
    let mut house = House::new(true);
    for day in 0..5 {
        house.day(PersonId(3), day);
    }
    house.say(PersonId(3), 5 * DAY_S + 7 * H, "They sit on the sofa.");
    let learned = house.observations();
    let before = house.ahead(PersonId(3), QUARTER);
    let hall = r#"[{"change": "add-room", "room": {"id": "hall", "label": "hall", "box": {"min_m": [9, 0, 0], "max_m": [12, 3, 2.5]}}}]"#;
    let map = house.engine.map().changed(parse_changes(hall).unwrap()).unwrap();
    house.engine.change_map(map).unwrap();
    house.say(PersonId(3), 5 * DAY_S + 7 * H + 10, "They sit on the sofa.");
    assert_eq!(house.observations(), learned + 1.0);
    let forecast = *house.engine.person_forecasts(BootNs(house.now_ns));
    let own = forecast.persons()[0];
    assert!((own.probability[LIVING_ROOM][QUARTER] - before[LIVING_ROOM]).abs() < 0.2);
    assert!(own.probability[2][QUARTER] < 0.1);
}

#[test]
fn what_is_exported_teaches_another_home() {
    let mut house = House::new(true);
    for day in 0..7 {
        house.day(PersonId(3), day);
    }
    let json = house.engine.habits().to_json().unwrap();
    let mut other = House::new(false);
    other.say(PersonId(3), 7 * DAY_S + 7 * H, "They sit on the sofa.");
    other.until(7 * DAY_S + 7 * H + 1_200);
    let before = other.ahead(PersonId(3), QUARTER);
    other.engine.habits_mut().take_json(&json).unwrap();
    other.engine.bind_habits();
    other.say(PersonId(3), 7 * DAY_S + 7 * H + 1_210, "They stand up.");
    other.say(PersonId(3), 7 * DAY_S + 7 * H + 1_220, "They sit on the sofa.");
    let after = other.ahead(PersonId(3), QUARTER);
    assert!(after[KITCHEN] != before[KITCHEN], "{before:?} {after:?}");
    assert_eq!(other.engine.habits().to_json().unwrap(), json, "nothing is learned");
    assert!(other.engine.habits_mut().take_json("{}").is_err());
    assert_eq!(other.engine.habits().to_json().unwrap(), json);
    other.engine.habits_mut().forget_all();
    other.engine.bind_habits();
    assert_eq!(other.engine.habits().learned().counts, 0);
}

/// The last minutes of all rows of an export.
fn dates(json: &str) -> Vec<u64> {
    let json: serde_json::Value = serde_json::from_str(json).unwrap();
    json["rows"].as_array().unwrap().iter().map(|row| row["touched_min"].as_u64().unwrap()).collect()
}

/// A narrator with an unset clock reports times in 1970. The next start can read the stored state and has the same habits.
#[test]
fn a_narrator_with_a_dead_clock_harms_nothing() {
    let mut house = House::new(true);
    (0..5).for_each(|day| house.day(PersonId(1), day));
    let (counts, observations) = (house.engine.habits().learned().counts, house.observations());
    // After a restart without a journal, events older than the stored state are not learned.
    let (memory, last) = (house.memory(), house.journal[0].clone());
    house.journal.clear();
    house.restart(memory);
    for (number, text) in (1..).zip(["They open the fridge.", "They grab the coffee maker.", "They sit on the sofa."]) {
        let event = Event::Did(Sentence::new(text).unwrap());
        let (sequence, observed_unix_ns) = (number, 1_000 * S);
        let observation = Observation {
            source: 9,
            sequence,
            observed_ns: BootNs(0),
            observed_unix_ns: UnixNs(observed_unix_ns),
            event,
            ..last.clone()
        };
        house
            .engine
            .step(
                [Entry::new(observation, BootNs(house.now_ns))],
                BootNs(house.now_ns),
                UnixNs(house.now_ns + house.unix_ns),
            )
            .unwrap();
        house.engine.tell_outcomes(|_| {});
    }
    let memory = house.memory();
    let read = crate::daemon::HabitRows::of(&memory).unwrap().memory(options(true)).unwrap();
    assert!(read.habits.learned().counts >= counts && read.habits.learned().observations > observations);
}

/// Imported or stored counts from a clock that is years ahead are dated as of now.
#[test]
fn what_was_learned_ahead_of_now_is_of_now() {
    let mut ahead = House::new(true);
    ahead.unix_ns += 9 * 365 * DAY_S * S;
    (0..5).for_each(|day| ahead.day(PersonId(3), day));
    let json = ahead.engine.habits().to_json().unwrap();
    let mut house = House::new(true);
    (0..5).for_each(|day| house.day(PersonId(3), day));
    let now_min = |house: &House| (house.now_ns + house.unix_ns) / S / 60;
    house.engine.habits_mut().take_json(&json).unwrap();
    house.engine.bind_habits();
    let after = house.engine.habits().to_json().unwrap();
    assert_eq!(dates(&after).into_iter().max(), Some(now_min(&house)));
    // A file with such dates and a correct end of the counted time.
    let memory = Memory { habits: Habits::from_json(options(true), &json).unwrap(), ..house.memory() };
    house.restart(memory);
    assert_eq!(dates(&house.engine.habits().to_json().unwrap()).into_iter().max(), Some(now_min(&house)));
    // Another week of the same days is learned in addition.
    let first = |house: &House| house.engine.habits().visits().into_iter().flatten().sum::<f64>();
    let before = first(&house);
    (5..10).for_each(|day| house.day(PersonId(3), day));
    assert!(first(&house) > before + 5.0, "{before} {}", first(&house));
}

#[test]
fn nothing_is_learned_of_visitors() {
    let mut house = House::new(true);
    let residents = crate::config::PersonsConfig { residents: vec!["3".to_owned()], ..Default::default() };
    house.engine = house.engine.with_persons(Persons::new(residents, PersonsFile::default()));
    house.say(PersonId(3), 7 * H, "They sit on the sofa.");
    house.say(PersonId(4), 7 * H + 60, "They open the fridge.");
    house.say(PersonId(4), 7 * H + 120, "away");
    house.say(PersonId(3), 7 * H + 180, "They stand up.");
    assert_eq!(house.engine.habits().persons(), [(PersonId(3), 2.0)]);
}

#[test]
fn of_each_start_of_a_source_the_newest_sequence_is_kept() {
    let mut heard = Heard::default();
    assert!(
        heard.note(EventId::new(1, 1, 5))
            && !heard.note(EventId::new(1, 1, 5))
            && !heard.note(EventId::new(1, 1, 4))
            && heard.note(EventId::new(1, 2, 1))
    );
    for source in 0..2 * SOURCES_MAX as u64 {
        assert!(heard.note(EventId::new(100 + source, 1, 1)));
    }
    assert_eq!(heard.names().len(), SOURCES_MAX);
    assert_eq!(Heard::new(heard.names().iter().copied()), heard);
}

/// An event about all persons is learned for each of them, once, also after a kill.
#[test]
fn what_is_said_of_everybody_is_learned_of_each() {
    let mut house = House::new(true);
    let exits = |house: &House| {
        let json: serde_json::Value = serde_json::from_str(&house.engine.habits().to_json().unwrap()).unwrap();
        let (persons, rows) = (json["persons"].as_array().unwrap(), json["rows"].as_array().unwrap());
        let of = |slot: &serde_json::Value| {
            // Destinations of stays.
            let own = rows.iter().filter(|row| row["kind"] == EXIT && row["slot"] == *slot);
            own.flat_map(|row| row["counts"].as_array().unwrap()).map(|count| count[1].as_f64().unwrap()).sum::<f64>()
        };
        persons.iter().map(|person| of(&person["slot"])).collect::<Vec<_>>()
    };
    /// The kind of destinations in an export.
    const EXIT: u8 = 22;
    for person in [3, 5] {
        house.say(PersonId(person), 7 * H + u64::from(person), "They sit on the sofa.");
    }
    house.say(PersonId::SOMEBODY, 9 * H, "everybody away");
    house.until(9 * H + 60);
    assert_eq!(exits(&house), [1.0, 1.0]);
    let memory = house.memory();
    house.restart(memory);
    assert_eq!(exits(&house), [1.0, 1.0], "written before the daemon was killed");
    house.restart(Memory::new(options(true)));
    assert_eq!(exits(&house), [1.0, 1.0], "learned from the journal");
}

/// Time in which the machine was suspended is not a stay.
#[test]
fn a_night_in_which_the_machine_slept_is_not_counted() {
    let minutes = |sleeps: bool| {
        let mut house = House::new(true);
        house.say(PersonId(3), 22 * H, "They sit on the sofa.");
        if sleeps {
            // Both clocks advance without a tick.
            house.now_ns += 8 * H * S;
        }
        house.until(30 * H + 600);
        house.say(PersonId(3), 30 * H + 600, "They open the fridge.");
        let json: serde_json::Value = serde_json::from_str(&house.engine.habits().to_json().unwrap()).unwrap();
        let rows = json["rows"].as_array().unwrap().iter().filter(|row| row["kind"] == STAYS_BY_PLACE);
        let counts = rows.flat_map(|row| row["counts"].as_array().unwrap());
        counts.filter(|count| count[0] == 1).map(|count| count[1].as_f64().unwrap()).sum::<f64>()
    };
    let (awake, asleep) = (minutes(false), minutes(true));
    assert!((asleep - (awake - 480.0)).abs() < 6.0, "{awake} {asleep}");
}

/// While learning is off, new persons do not replace persons with habits.
#[test]
fn whoever_is_not_learned_pushes_nobody_out() {
    let mut house = House::new(true);
    for person in 0..PERSONS_MAX as u32 {
        house.say(PersonId(person), 7 * H + u64::from(person), "They sit on the sofa.");
    }
    let memory = house.memory();
    let mut house = House::new(false);
    let memory =
        Memory { habits: Habits::from_json(options(false), &memory.habits.to_json().unwrap()).unwrap(), ..memory };
    house.engine = engine(Some(HomeHabits::new(memory, Zone::UTC)));
    let known = house.engine.habits().persons();
    house.say(PersonId(1_000), 8 * H, "They open the fridge.");
    assert_eq!(house.engine.habits().persons(), known);
}

#[test]
fn unknown_narrators_do_not_teach_habits_if_narrators_are_named() {
    let mut house = House::new(true);
    house.engine = house.engine.with_named([(7, crate::config::May::ALL)]);
    house.say(PersonId(3), 7 * H, "They sit on the sofa.");
    let at_ns = house.now_ns + S;
    let strange = Observation {
        source: 9,
        ..Observation { person: PersonId(4), observed_ns: BootNs(at_ns), ..house.journal[0].clone() }
    };
    let quota = Quota { number: OTHERS, share: 1 };
    house
        .engine
        .step([Entry { quota, ..Entry::new(strange, BootNs(at_ns)) }], BootNs(at_ns), UnixNs(at_ns + house.unix_ns))
        .unwrap();
    house.engine.tell_outcomes(|_| {});
    house.engine.tidy();
    assert_eq!(house.engine.habits().persons(), [(PersonId(3), 1.0)]);
}
