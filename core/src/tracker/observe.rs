//! The likelihood of each observation over joint states, and the attribution to persons afterwards.

use super::belief::{SLOTS_MAX, State};
use super::motion::{Column, FORGETS, Phases, moved, room_at};
use super::sensors::{EMPTY, Sensor};
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
    /// All persons left the house.
    AllAway,
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
/// A lost person left the former room within this time, in seconds.
const UNSEEN_S: f64 = 3_600.0;
/// In states below this probability the person stays.
const LIGHT: f64 = 1e-5;
/// Rooms with a smaller share of a text's likelihood are no place to put a lost person.
const LEAST_SHARE: f64 = 0.01;
/// A robot explains what sensors see for this long after it left, in seconds.
const ROBOT_S: f64 = 30.0;
/// A robot without a further report explains nothing after this time, in seconds.
pub const ROBOT_SILENT_S: f64 = 3_600.0;
/// Weight of a departure by an unseen visitor, next to a person at the door with weight 1.
const UNSEEN: f64 = 0.03;
/// Each door between a person and the way out makes a departure less probable by this factor.
const PER_DOOR: f64 = 0.4;
/// Weights of a departure of persons who walk, sit, and lie.
const WALKS: Phases = [1.0, 0.3, 0.05, 0.0];
/// Weight of "present" without an arrival, next to each person that can have come home.
const NO_ARRIVAL: f64 = 0.3;
/// Likelihood of "lies" for a person who sits or walks.
const LIES_ELSE: f64 = 0.05;
/// A person is out for sure from this probability on.
const SURELY: f64 = 0.95;
/// Most probability that a flip in a house without residents has for a person, when the sensor learns from it.
const ALONE: f64 = 0.5;
/// Probability that a visitor came in unseen, given an action of an unknown person.
const CAME_IN: f64 = 1e-4;
/// Probability that a second visitor comes in with the first.
const TOGETHER: f32 = 0.3;
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
            let is_there = |column: Column| column > 0 && (room.is_none() || room_at(column) == room);
            if own.probability(person, None) > 0.5 || room.is_some() {
                relocate(own, |_| Some(slot), LOST_PRESENT, |column| if is_there(column) { 1.0 } else { 0.0 });
            }
            weigh_person(own, slot, |column| if is_there(column) { trust } else { 1.0 - trust });
        }
        Observation::Present { who: None, room: None } => arrival(own, trust),
        Observation::Present { who: None, room: Some(room) } => {
            if !has(room) {
                return None;
            }
            own.belief.weigh_states(|state| if state.rooms().0 >> room & 1 == 1 { trust } else { 1.0 - trust });
        }
        Observation::Lies { who } => {
            let slot = own.slot(who)?;
            let else_ = (trust * LIES_ELSE + (1.0 - trust)) as f32;
            weigh_person_phases(own, slot, |column| if column > 0 { [else_, else_, 1.0, 0.0] } else { [else_; 4] });
        }
        Observation::Away { who: Some(person) } | Observation::Gone { who: Some(person) } => {
            let slot = own.slot(person)?;
            relocate(own, |_| Some(slot), LEFT, |column| if column == 0 { 1.0 } else { 0.0 });
            weigh_person(own, slot, |column| if column == 0 { trust } else { 1.0 - trust });
        }
        Observation::AllAway => {
            // Phones and motion sensors are still on when everybody leaves.
            own.fill_states(UNSEEN_S, |kind| matches!(kind, SensorKind::Bed | SensorKind::Presence));
            // In this order, unknown persons who are out now take no other slot.
            for slot in (0..own.belief.slots()).rev() {
                recall(own, 0, LEFT, |_, other, _| f64::from(u8::from(other == slot)));
            }
            own.belief.weigh_states(|state| if state.rooms().0 == 0 { trust } else { 1.0 - trust });
        }
        Observation::Away { who: None } => departure(own, trust, false),
        Observation::Gone { who: None } => departure(own, trust, true),
        Observation::Empty { room } => {
            let is_free = |state: State<'_>| state.rooms().0 >> room & 1 == 0;
            has(room).then(|| own.belief.weigh_states(|state| if is_free(state) { trust } else { 1.0 - trust }))?;
        }
        Observation::Count { room, persons } => has(room).then(|| count(own, room, persons, trust))?,
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

/// Weighs the belief by the column of one person.
fn weigh_person(own: &mut Tracker, slot: usize, likelihood: impl Fn(Column) -> f64) {
    weigh_person_phases(own, slot, |column| [likelihood(column) as f32; 4]);
}

fn weigh_person_phases(own: &mut Tracker, slot: usize, likelihood: impl Fn(Column) -> Phases) {
    let columns = 1 + own.home.rooms();
    own.likelihood.clear(columns, own.belief.slots());
    let places = own.likelihood.slots[slot * columns..(slot + 1) * columns].iter_mut();
    places.enumerate().for_each(|(column, own)| *own = likelihood(column as Column));
    own.belief.weigh(&mut own.likelihood);
}

/// Persons do not move in lighter states than this.
fn lightest(own: &Tracker) -> f64 {
    let light: f64 = own.belief.states().map(|state| state.weight).filter(|weight| *weight < LIGHT).sum();
    // Light states weigh little, but all of them may be light.
    if light > 0.5 { 0.0 } else { LIGHT }
}

/// The filter may have lost a person of a state: with this probability the person is placed again, by a weight per column.
fn relocate(own: &mut Tracker, who: impl Fn(&State<'_>) -> Option<usize>, lost: f64, weight: impl Fn(Column) -> f64) {
    let columns = own.home.rooms() as Column + 1;
    let total: f64 = (0..columns).map(&weight).sum::<f64>().max(f64::MIN_POSITIVE);
    let least = lightest(own);
    own.belief.transfer(|state, flows| {
        let Some(slot) = who(&state).filter(|_| state.weight >= least) else { return flows.keep(1.0) };
        flows.keep(1.0 - lost);
        for column in (0..columns).filter(|column| weight(*column) > 0.0) {
            flows.put(slot, column, arrived(column).map(|own| own * (lost * weight(column) / total) as f32));
        }
    });
}

/// The first visitor in a column.
fn visitor(state: &State<'_>, unknown: usize, column: Column) -> Option<usize> {
    state.slots().take(unknown).position(|(own, _)| own == column)
}

/// The filter may have lost persons, who are in this column: with the probability `lost` times a weight of at most 1, and the less probably the more
/// the states of sensors speak against it, which [`Tracker::fill_states`] filled in. A state moves one person.
fn recall(own: &mut Tracker, to: Column, lost: f64, weight: impl Fn(&State<'_>, usize, Column) -> f64) {
    let least = lightest(own);
    let Tracker { belief, likelihood, .. } = own;
    belief.transfer(|state, flows| {
        let mut moves = [0.0; SLOTS_MAX];
        for (slot, (from, phases)) in state.slots().enumerate().filter(|(_, (from, _))| *from != to) {
            let weight = if state.weight < least { 0.0 } else { weight(&state, slot, from) };
            if weight > 0.0 {
                moves[slot] = weight * mean(phases, &likelihood.of_move(&state, slot, (from, to), &arrived(to)));
            }
        }
        let all: f64 = moves.iter().sum();
        let lost = lost / all.max(1.0);
        flows.keep(1.0 - lost * all);
        for (slot, share) in moves.into_iter().enumerate().filter(|(_, share)| *share > 0.0) {
            flows.put(slot, to, arrived(to).map(|own| own * (lost * share) as f32));
        }
    });
}

/// The phases of a person after a move into a column.
fn arrived(column: Column) -> Phases {
    if column == 0 { [1.0 - FORGETS as f32, FORGETS as f32, 0.0, 0.0] } else { [1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0, 0.0] }
}

/// So many persons are in a room.
fn count(own: &mut Tracker, room: usize, persons: usize, trust: f64) {
    let (column, unknown) = (1 + room as Column, own.unknown());
    let persons = persons.min(own.belief.slots());
    own.fill_states(UNSEEN_S, |_| true);
    for person in 1..=persons {
        let has = |state: &State<'_>| state.slots().filter(|(at, _)| *at == column).count() >= person;
        recall(own, column, LOST_PRESENT, |state, slot, from| match from {
            _ if has(state) => 0.0,
            0 if slot >= unknown || visitor(state, unknown, 0) == Some(slot) => CAME_IN,
            0 => 0.0,
            _ => 1.0,
        });
        own.belief.weigh_states(|state| if has(&state) { trust } else { 1.0 - trust });
    }
}

/// An action: the likelihood of its text where the person is. Of an unknown person, where the most probable person is. `placed` is how surely the
/// text places a person that the filter lost.
fn action(own: &mut Tracker, who: Option<usize>, list: &[f64], placed: f64, trust: f64) -> Option<()> {
    let rooms = own.home.rooms();
    let raw = |room: usize| list.get(room).copied().filter(|own| own.is_finite() && *own > 0.0).unwrap_or(0.0);
    let sum: f64 = (0..rooms).map(raw).sum();
    let share = |room: usize| if sum > 0.0 { raw(room) / sum } else { 1.0 / rooms as f64 };
    let even = 1.0 / rooms as f64;
    let at = |column: Column| room_at(column).map_or(0.0, share);
    let likely = |column: Column| if at(column) > LEAST_SHARE { at(column) } else { 0.0 };
    match who {
        Some(person) => {
            let slot = own.slot(person)?;
            if list.is_empty() {
                // No place: the person is in.
                relocate(own, |_| Some(slot), LOST_ACTION * own.probability(person, None), likely);
                weigh_person(own, slot, |column| if column == 0 { 1.0 - trust } else { trust });
            } else {
                let lost = LOST_ACTION * if placed < 1.0 { placed.max(own.probability(person, None)) } else { 1.0 };
                relocate(own, |_| Some(slot), lost, likely);
                weigh_person(own, slot, |column| trust * at(column) + (1.0 - trust) * even);
            }
        }
        None => {
            let unknown = own.unknown();
            relocate(own, |state| visitor(state, unknown, 0), CAME_IN, likely);
            own.belief.weigh_states(|state| {
                let best = state.slots().map(|(column, _)| at(column)).fold(0.0, f64::max);
                trust * best + (1.0 - trust) * even
            });
        }
    }
    Some(())
}

/// The expectation of a value of the phases.
fn mean(phases: &Phases, of: &Phases) -> f64 {
    phases.iter().zip(of).map(|(share, own)| f64::from(share * own)).sum()
}

/// An unknown person leaves: a person near the door, less probably if sensors hold that person, or an unseen visitor. For good: one of the visitors.
fn departure(own: &mut Tracker, trust: f64, for_good: bool) {
    let slots = if for_good { own.unknown() } else { own.belief.slots() };
    // The motion sensor at the door is still on.
    own.fill_states(f64::INFINITY, |kind| matches!(kind, SensorKind::Bed | SensorKind::Presence | SensorKind::Phone));
    let Tracker { belief, likelihood, home, .. } = own;
    belief.transfer(|state, flows| {
        flows.keep(1.0 - trust + trust * UNSEEN);
        let visitors = state.slots().take(slots).filter(|(column, _)| *column > 0).count();
        for (slot, (column, phases)) in state.slots().enumerate().take(slots) {
            let Some(room) = room_at(column) else { continue };
            let weight = if for_good {
                1.0 / visitors as f64
            } else {
                let held = likelihood.of_move(&state, slot, (column, 0), &arrived(0));
                let near: Phases = std::array::from_fn(|phase| held[phase] * WALKS[phase]);
                mean(phases, &near) * PER_DOOR.powi(home.steps_out(room).min(8) as i32)
            };
            flows.put(slot, 0, [(trust * weight) as f32, 0.0, 0.0, 0.0]);
        }
    });
}

/// An unknown person is present: each person outside or a visitor can have come home, or the report repeats known facts.
fn arrival(own: &mut Tracker, trust: f64) {
    let unknown = own.unknown();
    let ways: f64 = (0..own.home.rooms()).map(|room| own.home.way_out(room)).sum();
    let Tracker { belief, home, .. } = own;
    belief.transfer(|state, flows| {
        let is_empty = state.rooms().0 == 0;
        flows.keep(1.0 - trust + if is_empty { 0.0 } else { trust * NO_ARRIVAL });
        let persons = (unknown..SLOTS_MAX).zip(state.slots().skip(unknown)).filter(|(_, (column, _))| *column == 0);
        for slot in visitor(&state, unknown, 0).into_iter().chain(persons.map(|(slot, _)| slot)) {
            let weight = trust * if slot < unknown { UNSEEN } else { 1.0 };
            for room in (0..home.rooms()).filter(|room| home.way_out(*room) > 0.0) {
                let share = (weight * home.way_out(room) / ways) as f32;
                flows.put(slot, 1 + room as Column, [share, 0.0, 0.0, 0.0]);
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
        (_, was) => {
            let robot = sensor.spec.room.is_some_and(|room| own.has_robot(room));
            let classes = match was {
                Some(was) => sensor.flips(was && !again, robot),
                None => sensor.shows(on),
            };
            own.likelihood.clear(1 + own.home.rooms(), slots);
            sensor.weigh(classes, &mut own.likelihood);
            own.belief.weigh(&mut own.likelihood);
        }
    }
    own.summarise();
    if let (true, Some(was)) = (own.options.learns, before) {
        learn_flip(own, number, was && !again);
    }
    let inside = own.sensors[number].slot.map_or(0.0, |slot| own.belief.inside(slot));
    let sensor = &mut own.sensors[number];
    (sensor.on, sensor.since_s) = (Some(on), now_s);
    sensor.note_phone(on, inside);
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
    // The columns of both sides.
    let sides = [1 + room as Column, door.spec.beyond.map_or(0, |room| 1 + room as Column)];
    let false_alarm = door.flips(false, false)[EMPTY];
    own.fill();
    let (tables, unknown) = (&own.tables, own.unknown());
    own.belief.transfer(|state, flows| {
        // The outer side of a front door has no persons.
        let beside = state.slots().any(|(column, _)| column > 0 && sides.contains(&column));
        flows.keep(false_alarm + if beside { OPENS_ONLY } else { 0.0 });
        for (slot, (from, phases)) in state.slots().enumerate() {
            let Some(side) = sides.iter().position(|side| *side == from) else { continue };
            let to = sides[1 - side];
            flows.put(slot, to, moved(phases, &tables.of(number(slot, unknown), 1).rates(from, to)));
        }
    });
    if sides[1] == 0 && unknown > 1 {
        // Another visitor may come in behind one who walks at the door.
        own.belief.transfer(|state, flows| {
            let first = visitor(&state, unknown, sides[0]).and_then(|slot| state.slots().nth(slot));
            let (Some((_, phases)), Some(slot)) = (first, visitor(&state, unknown, 0)) else {
                return flows.keep(1.0);
            };
            let share = TOGETHER * phases[0];
            flows.keep(f64::from(1.0 - share));
            flows.put(slot, sides[0], [share, 0.0, 0.0, 0.0]);
        });
    }
}

/// Who caused the observation: per slot, the posterior probability. What remains belongs to the sensor's or the narrator's errors.
pub(super) fn attribute(own: &Tracker, observation: &Observation<'_>) -> [f64; SLOTS_MAX] {
    let slots = own.belief.slots();
    let rooms = own.home.rooms();
    let mut shares = [0.0; SLOTS_MAX];
    let named = match *observation {
        Observation::Action { who, .. } | Observation::Text { who, .. } | Observation::Present { who, .. } => who,
        Observation::Away { who } | Observation::Gone { who } => who,
        Observation::Lies { who } => Some(who),
        _ => None,
    };
    if let Some(slot) = named.and_then(|person| own.slot(person)) {
        shares[slot] = 1.0;
        return shares;
    }
    let mut spread = |weight: &dyn Fn(usize, Column) -> Phases| {
        let mut weights = [[[0.0; 4]; ROOMS_MAX + 1]; SLOTS_MAX];
        for (slot, weights) in weights.iter_mut().enumerate().take(slots) {
            (0..=rooms).for_each(|column| weights[column] = weight(slot, column as Column));
        }
        for state in own.belief.states() {
            let mut caused = [0.0; SLOTS_MAX];
            let mut all = 0.0;
            for ((own, weights), (column, phases)) in caused.iter_mut().zip(&weights).zip(state.slots()) {
                let weights = &weights[usize::from(column)];
                if *weights != [0.0; 4] {
                    *own = mean(phases, weights);
                    all += *own;
                }
            }
            if all > 0.0 {
                let factor = state.weight / all;
                shares.iter_mut().zip(caused).take(slots).for_each(|(share, own)| *share += factor * own);
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
                spread(&|slot, column| {
                    let at = slot * (rooms + 1) + room_at(column).unwrap_or(rooms);
                    let is_side = room_at(column) == room || room_at(column) == beyond;
                    [if is_side { (own.marginals[at] - own.earlier[at]).max(0.0) as f32 } else { 0.0 }; 4]
                });
            } else {
                let flips = sensor.flips(false, false);
                spread(&|_, column| {
                    let class = |phase| sensor.class_of(column, phase);
                    std::array::from_fn(|phase| if class(phase) == EMPTY { 0.0 } else { flips[class(phase)] as f32 })
                });
            }
        }
        Observation::Action { rooms: list, .. } | Observation::Text { rooms: list, .. } => spread(&|_, column| {
            [room_at(column).map_or(0.0, |room| list.get(room).copied().unwrap_or(1.0).max(0.0)) as f32; 4]
        }),
        Observation::Present { room: Some(room), .. } | Observation::Count { room, .. } => {
            spread(&|_, column| [f32::from(u8::from(room_at(column) == Some(room))); 4])
        }
        // Persons who went out or came in by it.
        Observation::Present { .. } | Observation::Away { .. } | Observation::Gone { .. } | Observation::AllAway => {
            let is_present = matches!(observation, Observation::Present { .. });
            for (slot, share) in shares.iter_mut().enumerate().take(slots) {
                let [now, before] = [&own.marginals, &own.earlier].map(|list| list[slot * (rooms + 1) + rooms]);
                *share = if is_present { before - now } else { now - before }.max(0.0);
            }
        }
        Observation::Lies { .. } | Observation::Empty { .. } | Observation::Robot { .. } => {}
    }
    shares
}
