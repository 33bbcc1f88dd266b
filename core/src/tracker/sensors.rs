//! Sensors as two-state Markov chains that the occupancy of their room drives: default rates per kind, false alarms among them, and how they are learned.
//!
//! A sensor is off or on. It flips at a rate that depends on its room's class: empty, or the most visible person is still, settled, or walks.
//! This gives both kinds of evidence (Nodelman's continuous-time Bayesian networks):
//!
//! ```text
//! a flip at t                 likelihood  rate(state, class)
//! no flip for a time d        likelihood  exp(-rate(state, class) d)
//! ```
//!
//! So a bed that stays on speaks for its person as long as it is on, a motion sensor's "off" says little, and an armed sensor's silence
//! speaks against a person who walks there. All rates are learned online with a Gamma prior: weighted flips over weighted time.

pub use crate::narration::SensorKind;

use super::belief::{Likelihood, MOST};
use super::motion::{Column, PHONELESS, Phases, place_of, room_at, visibility};

/// A sensor as the configuration names it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorSpec {
    /// The kind.
    pub kind: SensorKind,
    /// The room it sees; of a door, the room inside. `None` for a phone.
    pub room: Option<usize>,
    /// Of a door, the room on the other side; `None` for a front door.
    pub beyond: Option<usize>,
    /// The person it belongs to, as an index of [`super::Tracker::add_person`].
    pub person: Option<usize>,
    /// Whether the device reports "off". If not, it is off after `hold_s`.
    pub holds: bool,
    /// False alarms per day; the kind's default if `None`.
    pub false_alarms_per_day: Option<f64>,
    /// How long it stays on after its person left; the kind's default if `None`.
    pub hold_s: Option<f64>,
}

impl SensorSpec {
    /// A sensor that sees a room.
    #[must_use]
    pub fn of_room(kind: SensorKind, room: usize) -> Self {
        let holds = true;
        Self { kind, room: Some(room), beyond: None, person: None, holds, false_alarms_per_day: None, hold_s: None }
    }

    /// The phone of a person.
    #[must_use]
    pub fn phone(person: usize) -> Self {
        Self { room: None, person: Some(person), ..Self::of_room(SensorKind::Phone, 0) }
    }
}

/// The classes of occupancy: empty, and by the most visible person: still, settled, moving.
pub(super) const CLASSES: usize = 4;
pub(super) const EMPTY: usize = 0;
const MOVING: usize = 3;

const DAY_S: f64 = 86_400.0;

/// A rate with its Gamma posterior.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Rate {
    prior: f64,
    /// Flips the prior is worth.
    strength: f64,
    /// How far the learned rate may leave the prior: down and up.
    range: (f64, f64),
    flips: f64,
    seconds: f64,
}

/// Learned evidence of more than this many flips is halved, so that a moved or repaired sensor is learned again.
const MEMORY: f64 = 200.0;

impl Rate {
    fn new(per_s: f64, strength: f64, range: (f64, f64)) -> Self {
        Self { prior: per_s, strength, range, flips: 0.0, seconds: 0.0 }
    }

    fn per_s(&self) -> f64 {
        let learned = (self.strength + self.flips) / (self.strength / self.prior + self.seconds);
        learned.clamp(self.prior * self.range.0, self.prior * self.range.1)
    }

    fn learn(&mut self, flips: f64, seconds: f64) {
        self.flips += flips;
        self.seconds += seconds;
        if self.flips > MEMORY {
            self.flips *= 0.5;
            self.seconds *= 0.5;
        }
    }
}

/// Rates per second: off to on, then on to off; each for empty, still, settled, moving.
fn defaults(spec: &SensorSpec) -> [[f64; CLASSES]; 2] {
    let (per_day, hold_s) = match spec.kind {
        SensorKind::Motion => (0.5, 45.0),
        SensorKind::Presence => (1.0, 20.0),
        SensorKind::Bed => (0.1, 4.0),
        SensorKind::Door => (0.5, 30.0),
        SensorKind::Phone => (0.03, 200.0),
        SensorKind::Appliance => (1.0, 1_800.0),
        SensorKind::Camera => (2.0, 15.0),
    };
    let sound = |value: Option<f64>, default: f64| value.filter(|v| v.is_finite() && *v >= 0.0).unwrap_or(default);
    let alarm = sound(spec.false_alarms_per_day, per_day).clamp(1e-3, 1e5) / DAY_S;
    let hold_s = sound(spec.hold_s, hold_s).clamp(0.5, DAY_S);
    let goes = 1.0 / hold_s;
    match spec.kind {
        SensorKind::Motion => [[alarm, 1.0 / 14_400.0, 1.0 / 200.0, 1.0 / 3.0], [goes, goes, goes / 1.5, goes / 4.0]],
        SensorKind::Presence => {
            [[alarm, 1.0 / 600.0, 1.0 / 30.0, 0.5], [goes, 1.0 / 3_600.0, 1.0 / 5_400.0, 1.0 / 5_400.0]]
        }
        SensorKind::Bed => {
            [[alarm, 1.0 / 1_200.0, 1.0 / 1_200.0, 1.0 / 1_200.0], [goes, 1.0 / 14_400.0, 1.0 / 14_400.0, 0.2]]
        }
        SensorKind::Phone => {
            let lost = 1.0 / DAY_S;
            [[alarm, 1.0 / 300.0, 1.0 / 300.0, 1.0 / 300.0], [goes, lost, lost, lost]]
        }
        SensorKind::Appliance => [[alarm, 1.0 / 7_200.0, 1.0 / 3_600.0, 1.0 / 900.0], [goes; CLASSES]],
        SensorKind::Camera => {
            [[alarm, 1.0 / 3_600.0, 1.0 / 60.0, 1.0 / 3.0], [goes, 1.0 / 120.0, 1.0 / 600.0, 1.0 / 300.0]]
        }
        SensorKind::Door => [[alarm; CLASSES], [goes; CLASSES]],
    }
}

/// A device that said nothing for this long is no evidence any more, in seconds.
fn stale_s(kind: SensorKind, on: bool) -> f64 {
    match (kind, on) {
        (SensorKind::Motion, true) => 3_600.0,
        (SensorKind::Presence | SensorKind::Camera, true) => 8.0 * 3_600.0,
        (SensorKind::Bed, true) => 18.0 * 3_600.0,
        _ => f64::INFINITY,
    }
}

/// A phone that is lost at home stays lost with this probability.
const DEAD: f64 = 0.5;
/// A smaller probability of a dead phone counts as none.
const LEAST_DEAD: f64 = 0.01;

/// A sensor with its state and its learned rates.
#[derive(Debug, Clone)]
pub(super) struct Sensor {
    pub(super) spec: SensorSpec,
    /// The slot of its person.
    pub(super) slot: Option<usize>,
    /// `None` before its first report and while it is unavailable.
    pub(super) on: Option<bool>,
    pub(super) since_s: f64,
    /// The probability that its person is in the house and the phone is asleep or empty, so that its silence says nothing.
    pub(super) dead: f64,
    /// The probability that the phone is not, if its person is in the house.
    alive: f64,
    rates: [[Rate; CLASSES]; 2],
}

impl Sensor {
    pub(super) fn new(spec: SensorSpec, slot: Option<usize>) -> Self {
        let per_s = defaults(&spec);
        let rate = |state: usize, class: usize| match (state, class) {
            (0, EMPTY) => Rate::new(per_s[0][EMPTY], 0.5, (0.1, 1_000.0)),
            _ => Rate::new(per_s[state][class], 20.0, (0.25, 4.0)),
        };
        let rates = std::array::from_fn(|state| std::array::from_fn(|class| rate(state, class)));
        Self { spec, slot, on: None, since_s: 0.0, dead: 0.0, alive: 1.0, rates }
    }

    /// Whether it sees a person as it sees the room's robot.
    pub(super) fn sees_robots(&self) -> bool {
        matches!(self.spec.kind, SensorKind::Motion | SensorKind::Presence | SensorKind::Camera)
    }

    /// Multiplies a likelihood by one per class. A person's sensor sees only that person; other sensors see the most visible one. Only ratios to an
    /// empty room count.
    pub(super) fn weigh(&self, classes: [f64; CLASSES], likelihood: &mut Likelihood) {
        let columns = likelihood.rooms.len();
        let relative = classes.map(|own| (own / classes[EMPTY]) as f32);
        match (self.slot, self.spec.room) {
            (Some(slot), _) => {
                let own = likelihood.slots.chunks_exact_mut(columns).nth(slot).into_iter().flatten();
                own.enumerate().for_each(|(column, own)| self.weigh_column(column as Column, &relative, own));
            }
            (None, Some(room)) => self.weigh_column(1 + room as Column, &relative, &mut likelihood.rooms[1 + room]),
            (None, None) => {}
        }
    }

    fn weigh_column(&self, column: Column, classes: &[f32; CLASSES], own: &mut Phases) {
        for (phase, own) in own.iter_mut().enumerate().take(if column == 0 { 2 } else { 3 }) {
            *own = (*own * classes[self.class_of(column, phase)]).clamp(1.0 / MOST, MOST);
        }
    }

    /// The class if only the person in this column and phase counts.
    pub(super) fn class_of(&self, column: Column, phase: usize) -> usize {
        let place = place_of(column, phase);
        match (self.spec.kind, self.spec.room) {
            (SensorKind::Phone, _) if place == PHONELESS => 1,
            (SensorKind::Phone, _) | (_, None) => visibility(place),
            (_, room) if room_at(column) == room => visibility(place),
            _ => EMPTY,
        }
    }

    /// Flip rates of its present state by class, while it does not flip.
    pub(super) fn silence(&self, on: bool, has_robot: bool) -> [f64; CLASSES] {
        // A robot on its way may pass this room unseen: a sensor that stays off says nothing about it.
        let mut rates = self.flips(on, has_robot && on);
        rates[1..].iter_mut().for_each(|rate| *rate *= self.alive);
        rates
    }

    /// A phone that is off, while its person is in the house with this probability.
    pub(super) fn note_inside(&mut self, inside: f64) {
        self.dead = self.dead.min(inside);
        self.alive = 1.0 - self.dead / inside.max(f64::MIN_POSITIVE);
    }

    /// A phone turned on or off, after which its person is in the house with this probability.
    pub(super) fn note_phone(&mut self, on: bool, inside: f64) {
        let dead = if on { 0.0 } else { DEAD * inside };
        self.dead = if self.spec.kind == SensorKind::Phone && dead > LEAST_DEAD { dead } else { 0.0 };
        self.alive = 1.0;
    }

    /// Flip rates of its present state by class, at a flip. An empty room with the robot looks like a room with a person.
    pub(super) fn flips(&self, on: bool, has_robot: bool) -> [f64; CLASSES] {
        let mut rates = self.rates[usize::from(on)].map(|rate| rate.per_s());
        if has_robot && self.sees_robots() {
            rates[EMPTY] = rates[MOVING];
        }
        rates
    }

    /// Share of the time for which it shows a state, by class.
    pub(super) fn shows(&self, on: bool) -> [f64; CLASSES] {
        std::array::from_fn(|class| {
            let [up, down] = [0, 1].map(|state| self.rates[state][class].per_s());
            let is_on = (up / (up + down)).clamp(1e-4, 1.0 - 1e-4);
            if on { is_on } else { 1.0 - is_on }
        })
    }

    /// The state that counts as evidence at a time.
    pub(super) fn evidence(&self, now_s: f64) -> Option<bool> {
        self.on.filter(|on| now_s - self.since_s <= stale_s(self.spec.kind, *on))
    }

    /// How long it stays on without a person, in seconds.
    pub(super) fn hold_s(&self) -> f64 {
        1.0 / self.rates[1][EMPTY].per_s()
    }

    /// False alarms per day: learned, and before anything was learned.
    pub(super) fn false_alarms_per_day(&self) -> (f64, f64) {
        (DAY_S * self.rates[0][EMPTY].per_s(), DAY_S * self.rates[0][EMPTY].prior)
    }

    /// Learns from time without a flip, given the probability of each class.
    pub(super) fn learn_time(&mut self, on: bool, classes: [f64; CLASSES], seconds: f64) {
        for (rate, p) in self.rates[usize::from(on)].iter_mut().zip(classes) {
            rate.learn(0.0, p * seconds);
        }
    }

    /// Learns from a flip, given the probability of each class after it.
    pub(super) fn learn_flip(&mut self, was_on: bool, classes: [f64; CLASSES]) {
        for (rate, p) in self.rates[usize::from(was_on)].iter_mut().zip(classes) {
            rate.learn(p, 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_follow_their_flips_within_their_range() {
        let mut rate = Rate::new(1.0 / DAY_S, 2.0, (0.1, 1_000.0));
        assert!((rate.per_s() * DAY_S - 1.0).abs() < 1e-9);
        rate.learn(98.0, 8.0 * DAY_S);
        assert!((rate.per_s() * DAY_S - 10.0).abs() < 1e-9, "100 flips in 10 days");
        rate.learn(0.0, 1e12);
        assert!((rate.per_s() * DAY_S - 0.1).abs() < 1e-9, "not below a tenth");
    }

    #[test]
    fn odd_numbers_of_a_configuration_fall_back_to_the_kind() {
        let odd = SensorSpec {
            false_alarms_per_day: Some(f64::NAN),
            hold_s: Some(-1.0),
            ..SensorSpec::of_room(SensorKind::Motion, 0)
        };
        assert_eq!(defaults(&odd), defaults(&SensorSpec::of_room(SensorKind::Motion, 0)));
    }
}
