//! The likelihood of each observation over joint states, and the attribution to persons afterwards.

use super::belief::{Key, SLOTS_MAX, State, occupied, place, with};
use super::motion::{ELSEWHERE, FORGETS, PHONELESS, Place, moving, places, room_of, settled, still, visibility};
use super::sensors::{CLASSES, Sensor};
use super::{Cause, ROOMS_MAX, SensorKind, Tracker, number};
use crate::places::evenness;

/// One observation. Persons and rooms are indices of the tracker; a person of `None` is unknown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Observation<'a> {
    /// A sensor reports its state; `None` if it is unavailable.
    Sensor {
        /// Its index.
        sensor: usize,
        /// On or off.
        on: Option<bool>,
    },
    /// A person did something here. `rooms` has the likelihood of the text in each room, up to a factor: one for the room that it names, or the
    /// language model's tempered scores. An empty list says that the person is in the house.
    Action {
        /// Who.
        who: Option<usize>,
        /// Likelihood per room.
        rooms: &'a [f64],
    },
    /// As [`Observation::Action`], by a text that names no place. `rooms` are the language model's: without a place in the text they fit several
    /// rooms, and the more alike they are, the less they say that the filter lost the person.
    Text {
        /// Who.
        who: Option<usize>,
        /// Likelihood per room.
        rooms: &'a [f64],
    },
    /// A person is present, in a room if it is known.
    Present {
        /// Who.
        who: Option<usize>,
        /// Where.
        room: Option<usize>,
    },
    /// A person lies or sleeps in the present room.
    Lies {
        /// Who.
        who: usize,
    },
    /// A person left the house.
    Away {
        /// Who.
        who: Option<usize>,
    },
    /// A person left for good.
    Gone {
        /// Who; if unknown, a visitor.
        who: Option<usize>,
    },
    /// A room has no persons.
    Empty {
        /// Which.
        room: usize,
    },
    /// So many persons, at least, are in a room.
    Count {
        /// Which.
        room: usize,
        /// How many.
        persons: usize,
    },
    /// The robot is in these rooms, or on its way through them, until the next report.
    Robot {
        /// Which.
        rooms: &'a [usize],
    },
}

/// Probability that the filter lost a person, given a report about that person by name. The person is then placed again.
const LOST_PRESENT: f64 = 0.3;
/// The same for an action.
const LOST_ACTION: f64 = 0.1;
/// Probability that a person left unseen, given a report by name that the person is out.
const LEFT: f64 = 0.7;
/// In states below this probability the person stays.
const LIGHT: f64 = 1e-5;
/// Rooms with a smaller share of a text's likelihood are no place to put a lost person.
const LEAST_SHARE: f64 = 0.01;
/// A robot explains what sensors see for this long after it left, in seconds.
const ROBOT_S: f64 = 30.0;
/// A robot without a further report explains nothing after this time, in seconds.
pub const ROBOT_SILENT_S: f64 = 3_600.0;
/// Chance that a held phone or bed is wrong about its person at the moment of an anonymous departure.
const HELD_WRONG: f64 = 0.003;
/// Weight of a departure by an unseen visitor, next to a person at the door with weight 1.
const UNSEEN: f64 = 0.03;
/// Each door between a person and the way out makes a departure less probable by this factor.
const PER_DOOR: f64 = 0.4;
/// Weights of a departure of persons who walk, sit, and lie.
const WALKS: [f64; 3] = [1.0, 0.3, 0.05];
/// Weight of "present" without an arrival, next to each person that can have come home.
const NO_ARRIVAL: f64 = 0.3;
/// Likelihood of "lies" for a person who sits or walks.
const LIES_ELSE: f64 = 0.05;
/// A person is out for sure from this probability on.
const SURELY: f64 = 0.95;
/// Most probability that a flip in a house without residents has for a person, when the sensor learns from it.
const ALONE: f64 = 0.5;
/// A person at a door opens it without passing through this often, per second.
const OPENS_ONLY: f64 = 1.0 / 7_200.0;

/// Weighs the belief. `None` if the observation changes nothing.
pub(super) fn weigh(own: &mut Tracker, observation: &Observation<'_>, trust: f64) -> Option<Cause> {
    let rooms = own.home.rooms();
    let has = |room: usize| room < rooms;
    match *observation {
        Observation::Sensor { sensor, on } => return sensor_reports(own, sensor, on),
        Observation::Action { who, rooms: list } => action(own, who, list, 1.0, trust)?,
        Observation::Text { who, rooms: list } => action(own, who, list, 1.0 - evenness(list), trust)?,
        Observation::Present { who: Some(person), room } => {
            let slot = own.slot(person)?;
            if room.is_some_and(|room| !has(room)) {
                return None;
            }
            if own.probability(person, None) > 0.5 || room.is_some() {
                let places = Places::of(rooms, |own| f64::from(u8::from(room.is_none_or(|room| room == own))));
                relocate(own, slot, LOST_PRESENT, places.list());
            }
            let is_there =
                |place: Place| if room.is_some() { room_of(place) == room } else { room_of(place).is_some() };
            own.belief.weigh(|key| if is_there(place(key, slot)) { trust } else { 1.0 - trust });
        }
        Observation::Present { who: None, room: None } => arrival(own, trust),
        Observation::Present { who: None, room } => {
            if room.is_some_and(|room| !has(room)) {
                return None;
            }
            let slots = own.belief.slots();
            own.belief.weigh(|key| {
                let any = occupied(key, slots, |_| ());
                let is_so = room.map_or(any != 0, |room| any >> room & 1 == 1);
                if is_so { trust } else { 1.0 - trust }
            });
        }
        Observation::Lies { who } => {
            let slot = own.slot(who)?;
            let else_ = trust * LIES_ELSE + (1.0 - trust);
            own.belief.weigh(|key| if visibility(place(key, slot)) == 1 { 1.0 } else { else_ });
        }
        Observation::Away { who: Some(person) } | Observation::Gone { who: Some(person) } => {
            let slot = own.slot(person)?;
            relocate(own, slot, LEFT, &[(ELSEWHERE, 1.0 - FORGETS), (PHONELESS, FORGETS)]);
            own.belief.weigh(|key| if room_of(place(key, slot)).is_none() { trust } else { 1.0 - trust });
        }
        Observation::Away { who: None } => departure(own, trust, false),
        Observation::Gone { who: None } => departure(own, trust, true),
        Observation::Empty { room } => {
            let slots = own.belief.slots();
            let is_free = |key: Key| occupied(key, slots, |_| ()) >> room & 1 == 0;
            has(room).then(|| own.belief.weigh(|key| if is_free(key) { trust } else { 1.0 - trust }))?;
        }
        Observation::Count { room, persons } => {
            if !has(room) {
                return None;
            }
            let slots = own.belief.slots();
            own.belief.weigh(|key| {
                let here = (0..slots).filter(|slot| room_of(place(key, *slot)) == Some(room)).count();
                trust * (1.0 - trust).powi(persons.saturating_sub(here).min(4) as i32)
            });
        }
        Observation::Robot { rooms: list } => {
            for (room, until_s) in own.robot_until_s.iter_mut().enumerate() {
                if list.contains(&room) {
                    *until_s = own.now_s + ROBOT_SILENT_S;
                } else {
                    *until_s = until_s.min(own.now_s + ROBOT_S);
                }
            }
            return None;
        }
    }
    own.summarise();
    Some(match observation {
        Observation::Action { .. } | Observation::Text { .. } | Observation::Lies { .. } => Cause::Action,
        Observation::Present { .. } => Cause::Present,
        Observation::Empty { .. } => Cause::Empty,
        Observation::Count { .. } => Cause::Count,
        _ => Cause::Away,
    })
}

/// Places for a person that the filter lost, with probabilities. It needs no allocation.
struct Places {
    places: [(Place, f64); 3 * ROOMS_MAX],
    count: usize,
}

impl Places {
    /// The places of all rooms by weight.
    fn of(rooms: usize, weight: impl Fn(usize) -> f64) -> Self {
        let total: f64 = (0..rooms).map(&weight).sum::<f64>().max(f64::MIN_POSITIVE);
        let mut own = Self { places: [(ELSEWHERE, 0.0); 3 * ROOMS_MAX], count: 0 };
        for room in (0..rooms).filter(|room| weight(*room) > 0.0) {
            for place in [moving(room), settled(room), still(room)] {
                own.places[own.count] = (place, weight(room) / (3.0 * total));
                own.count += 1;
            }
        }
        own
    }

    fn list(&self) -> &[(Place, f64)] {
        &self.places[..self.count]
    }
}

/// The filter may have lost a person: with this probability the person is placed again.
fn relocate(own: &mut Tracker, slot: usize, lost: f64, places: &[(Place, f64)]) {
    let light: f64 = own.belief.states().iter().filter(|state| state.weight < LIGHT).map(|state| state.weight).sum();
    // Light states weigh little, but all of them may be light.
    let least = if light > 0.5 { 0.0 } else { LIGHT };
    own.belief.transfer(|State { key, weight, .. }, add| {
        if weight < least {
            add(key, 1.0);
            return;
        }
        add(key, 1.0 - lost);
        for (to, share) in places {
            add(with(key, slot, *to), lost * share);
        }
    });
}

/// An action: the likelihood of its text where the person is. Of an unknown person, where the most probable person is. `placed` is how surely the
/// text places a person that the filter lost.
fn action(own: &mut Tracker, who: Option<usize>, list: &[f64], placed: f64, trust: f64) -> Option<()> {
    let rooms = own.home.rooms();
    let raw = |room: usize| list.get(room).copied().filter(|own| own.is_finite() && *own > 0.0).unwrap_or(0.0);
    let sum: f64 = (0..rooms).map(raw).sum();
    let share = |room: usize| if sum > 0.0 { raw(room) / sum } else { 1.0 / rooms as f64 };
    let even = 1.0 / rooms as f64;
    let at = |place: Place| room_of(place).map_or(0.0, share);
    let slots = own.belief.slots();
    match who {
        Some(person) => {
            let slot = own.slot(person)?;
            let places = Places::of(rooms, |room| if share(room) > LEAST_SHARE { share(room) } else { 0.0 });
            if list.is_empty() {
                // No place: the person is in.
                relocate(own, slot, LOST_ACTION * own.probability(person, None), places.list());
                own.belief.weigh(|key| if room_of(place(key, slot)).is_none() { 1.0 - trust } else { trust });
            } else {
                let lost = LOST_ACTION * if placed < 1.0 { placed.max(own.probability(person, None)) } else { 1.0 };
                relocate(own, slot, lost, places.list());
                own.belief.weigh(|key| trust * at(place(key, slot)) + (1.0 - trust) * even);
            }
        }
        None => own.belief.weigh(|key| {
            let best = (0..slots).map(|slot| at(place(key, slot))).fold(0.0, f64::max);
            trust * best + (1.0 - trust) * even
        }),
    }
    Some(())
}

/// How probable it is that a person at this place walks out of the house now.
fn departs(own: &Tracker, slot: usize, place: Place) -> f64 {
    let Some(room) = room_of(place) else { return 0.0 };
    let doors = own.home.steps_out(room);
    if doors == usize::MAX {
        return 0.0;
    }
    let is_held = |sensor: &Sensor| {
        let binds = matches!(sensor.spec.kind, SensorKind::Phone | SensorKind::Bed) && sensor.slot == Some(slot);
        binds && sensor.evidence(own.now_s) == Some(true)
    };
    let held = if own.sensors.iter().any(is_held) { HELD_WRONG } else { 1.0 };
    let walks = WALKS[3 - visibility(place).clamp(1, 3)];
    held * walks * PER_DOOR.powi(doors.min(8) as i32)
}

/// An unknown person leaves: each person near the door, or a visitor that no sensor saw.
fn departure(own: &mut Tracker, trust: f64, only_unknown: bool) {
    let slots = if only_unknown { own.unknown() } else { own.belief.slots() };
    let places = places(own.home.rooms());
    let mut weights = [[0.0; 256]; SLOTS_MAX];
    for (slot, weights) in weights.iter_mut().enumerate().take(slots) {
        (0..places).for_each(|place| weights[place] = departs(own, slot, place as Place));
    }
    own.belief.transfer(|State { key, .. }, add| {
        add(key, 1.0 - trust + trust * UNSEEN);
        for slot in 0..slots {
            let weight = weights[slot][usize::from(place(key, slot))];
            if weight > 0.0 {
                add(with(key, slot, ELSEWHERE), trust * weight);
            }
        }
    });
}

/// An unknown person is present: each person outside or a visitor can have come home, or the report repeats known facts.
fn arrival(own: &mut Tracker, trust: f64) {
    let slots = own.belief.slots();
    let unknown = own.unknown();
    let ways: f64 = (0..own.home.rooms()).map(|room| own.home.way_out(room)).sum();
    let Tracker { belief, home, .. } = own;
    belief.transfer(|State { key, .. }, add| {
        let is_empty = occupied(key, slots, |_| ()) == 0;
        add(key, 1.0 - trust + if is_empty { 0.0 } else { trust * NO_ARRIVAL });
        for slot in (0..slots).filter(|slot| room_of(place(key, *slot)).is_none()) {
            let weight = trust * if slot < unknown { UNSEEN } else { 1.0 };
            for room in (0..home.rooms()).filter(|room| home.way_out(*room) > 0.0) {
                add(with(key, slot, moving(room)), weight * home.way_out(room) / ways);
            }
        }
    });
}

/// A sensor reports its state.
fn sensor_reports(own: &mut Tracker, number: usize, on: Option<bool>) -> Option<Cause> {
    let now_s = own.now_s;
    let sensor = own.sensors.get_mut(number)?;
    let before = sensor.on;
    let Some(on) = on else {
        sensor.on = None;
        return None;
    };
    // A device that reports no "off" speaks again: it was off in between.
    let again = !sensor.spec.holds && before == Some(true) && on;
    if before == Some(on) && !again {
        return None;
    }
    let cause = Cause::Sensor { sensor: number, on };
    let sensor = sensor.clone();
    let slots = own.belief.slots();
    if sensor.slot.is_some_and(|slot| slot >= slots) {
        return None;
    }
    match (sensor.spec.kind, before) {
        (SensorKind::Door, Some(false)) if on => door_opens(own, &sensor),
        (SensorKind::Door, _) => {}
        (_, None) => own.belief.weigh(|key| {
            let share = sensor.is_on(sensor.class(key, slots));
            if on { share } else { 1.0 - share }
        }),
        (_, Some(was)) => {
            let robot = sensor.spec.room.is_some_and(|room| now_s < own.robot_until_s[room]);
            let flips = sensor.flips(was && !again, robot);
            own.belief.weigh(|key| flips[sensor.class(key, slots)]);
        }
    }
    own.summarise();
    if let (true, Some(was)) = (own.options.learns, before) {
        learn_flip(own, number, was && !again);
    }
    let sensor = &mut own.sensors[number];
    (sensor.on, sensor.since_s) = (Some(on), now_s);
    Some(cause)
}

fn learn_flip(own: &mut Tracker, number: usize, was: bool) {
    let Some(mut classes) = own.classes_of(number) else { return };
    // All residents were out: a noisy sensor explains the flip at least as well as an unknown person, unless such a person surely was in.
    let rooms = own.home.rooms();
    let out = |slot: usize| own.earlier.get(slot * (rooms + 1) + rooms).copied().unwrap_or(0.0);
    let slots = own.unknown()..own.belief.slots();
    let is_visited = (0..own.unknown()).any(|slot| out(slot) < 1.0 - SURELY);
    if !was && !slots.is_empty() && !is_visited && slots.map(out).all(|p| p > SURELY) {
        let kept = classes[1..].iter().sum::<f64>();
        let spread = if kept > ALONE { ALONE / kept } else { 1.0 };
        classes[1..].iter_mut().for_each(|own| *own *= spread);
        classes[0] = 1.0 - classes[1..].iter().sum::<f64>();
    }
    own.sensors[number].learn_flip(was, classes);
}

/// A door opens: a person passes through, at that person's rate; or it opens without a passage.
fn door_opens(own: &mut Tracker, door: &Sensor) {
    let Some(room) = door.spec.room else { return };
    let (slots, beyond) = (own.belief.slots(), door.spec.beyond);
    let is_side = |place: Place| room_of(place) == Some(room) || beyond.is_some() && room_of(place) == beyond;
    // The places behind the door, from either side of it.
    let behind = |from: Place| match (room_of(from), beyond) {
        (Some(here), Some(beyond)) if here == room => [Some(moving(beyond)), None],
        (Some(here), None) if here == room => [Some(ELSEWHERE), Some(PHONELESS)],
        (here, beyond) if here == beyond => [Some(moving(room)), None],
        _ => [None, None],
    };
    let false_alarm = door.flips(false, false)[0];
    own.fill();
    let (tables, unknown) = (&own.tables, own.unknown());
    own.belief.transfer(|State { key, .. }, add| {
        let beside = (0..slots).any(|slot| is_side(place(key, slot)));
        add(key, false_alarm + if beside { OPENS_ONLY } else { 0.0 });
        for slot in 0..slots {
            let from = place(key, slot);
            for to in behind(from).into_iter().flatten() {
                let rate = tables.of(number(slot, unknown), 1).rate(from, to);
                if rate > 0.0 {
                    add(with(key, slot, to), rate);
                }
            }
        }
    });
}

/// Who caused the observation: per slot, the posterior probability. What remains belongs to the sensor's or the narrator's errors.
pub(super) fn attribute(own: &Tracker, observation: &Observation<'_>) -> [f64; SLOTS_MAX] {
    let slots = own.belief.slots();
    let rooms = own.home.rooms();
    let mut shares = [0.0; SLOTS_MAX];
    let named = |who: Option<usize>| who.and_then(|person| own.slot(person));
    let mut spread = |weight: &dyn Fn(usize, Place) -> f64| {
        let mut weights = [[0.0; 256]; SLOTS_MAX];
        for (slot, weights) in weights.iter_mut().enumerate().take(slots) {
            (0..places(rooms)).for_each(|place| weights[place] = weight(slot, place as Place));
        }
        for State { key, weight, .. } in own.belief.states() {
            let all: f64 = (0..slots).map(|slot| weights[slot][usize::from(place(*key, slot))]).sum();
            if all > 0.0 {
                for (slot, share) in shares.iter_mut().enumerate().take(slots) {
                    *share += weight * weights[slot][usize::from(place(*key, slot))] / all;
                }
            }
        }
    };
    match *observation {
        Observation::Sensor { sensor, .. } => {
            let Some(sensor) = own.sensors.get(sensor) else { return shares };
            if let Some(slot) = sensor.slot {
                if let Some(share) = shares.get_mut(slot) {
                    *share = 1.0;
                }
            } else if sensor.spec.kind == SensorKind::Door {
                let (room, beyond) = (sensor.spec.room, sensor.spec.beyond);
                let moved = |slot: usize, place: Place| {
                    let column = slot * (rooms + 1) + room_of(place).unwrap_or(rooms);
                    let is_side = room_of(place) == room || room_of(place) == beyond;
                    if is_side { (own.marginals[column] - own.earlier[column]).max(0.0) } else { 0.0 }
                };
                spread(&moved);
            } else {
                let flips: [f64; CLASSES] = sensor.flips(false, false);
                spread(&|_, place| {
                    let class = sensor.class_of(place, sensor.spec.room);
                    if class == 0 { 0.0 } else { flips[class] }
                });
            }
        }
        Observation::Action { who, rooms: list } | Observation::Text { who, rooms: list } => match named(who) {
            Some(slot) => shares[slot] = 1.0,
            None => {
                spread(&|_, place| room_of(place).map_or(0.0, |room| list.get(room).copied().unwrap_or(1.0).max(0.0)))
            }
        },
        Observation::Lies { who } => shares[own.slot(who).unwrap_or(0)] = 1.0,
        Observation::Present { who: None, room: None } => {
            for (slot, share) in shares.iter_mut().enumerate().take(slots) {
                let column = slot * (rooms + 1) + rooms;
                *share = (own.earlier[column] - own.marginals[column]).max(0.0);
            }
        }
        Observation::Present { who, room } => match named(who) {
            Some(slot) => shares[slot] = 1.0,
            None => spread(&|_, place| {
                f64::from(u8::from(room_of(place).is_some() && (room.is_none() || room_of(place) == room)))
            }),
        },
        Observation::Away { who } | Observation::Gone { who } => match named(who) {
            Some(slot) => shares[slot] = 1.0,
            None => {
                for (slot, share) in shares.iter_mut().enumerate().take(slots) {
                    let column = slot * (rooms + 1) + rooms;
                    *share = (own.marginals[column] - own.earlier[column]).max(0.0);
                }
            }
        },
        Observation::Count { room, .. } => spread(&|_, place| f64::from(u8::from(room_of(place) == Some(room)))),
        Observation::Empty { .. } | Observation::Robot { .. } => {}
    }
    shares
}
