//! Which observations moved the belief, and who can have caused them.
//!
//! The trace keeps the last "on" and the last "off" of each sensor and a ring of the other observations, each with its change of the log-odds per person and place.

use super::belief::SLOTS_MAX;

/// Observations other than flips that are kept.
const RING: usize = 48;
/// The weight of an observation halves in this time, in seconds. A sensor that is still on keeps its weight.
const HALF_LIFE_S: f64 = 900.0;
/// Log-odds beyond this are certain.
const CERTAIN: f64 = 12.0;

/// What moved the belief.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cause {
    /// A sensor turned on or off.
    Sensor {
        /// Its index.
        sensor: usize,
        /// Whether it is on.
        on: bool,
    },
    /// An action that a narrator reported.
    Action,
    /// A report that a person is present.
    Present,
    /// A report that a person left the house, for a while or for good.
    Away,
    /// A report that a room is empty.
    Empty,
    /// A count of persons in a room.
    Count,
}

/// An observation that moved the belief about a person and a place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reason {
    /// The observation.
    pub cause: Cause,
    /// When, in seconds.
    pub at_s: f64,
    /// Change of the log-odds; positive speaks for the place.
    pub log_odds: f64,
    /// The probability that this person caused it.
    pub share: f64,
    /// Another person who may have caused it, with the probability; the index of a known person.
    pub other: Option<(usize, f64)>,
}

/// An observation with its effect.
#[derive(Debug, Clone, PartialEq)]
struct Heard {
    at_s: f64,
    cause: Cause,
    shares: [f64; SLOTS_MAX],
    /// Per slot: rooms, then elsewhere.
    log_odds: Vec<f32>,
}

/// The trace.
#[derive(Debug, Clone)]
pub(super) struct Trace {
    columns: usize,
    /// Per sensor: off, and on.
    flips: Vec<[Option<Heard>; 2]>,
    ring: Vec<Heard>,
    next: usize,
    last: [f64; SLOTS_MAX],
}

fn log_odds(p: f64) -> f64 {
    let p = p.clamp(1e-9, 1.0 - 1e-9);
    (p / (1.0 - p)).ln().clamp(-CERTAIN, CERTAIN)
}

impl Trace {
    pub(super) fn new(rooms: usize) -> Self {
        Self { columns: rooms + 1, flips: Vec::new(), ring: Vec::with_capacity(RING), next: 0, last: [0.0; SLOTS_MAX] }
    }

    /// A new sensor, perhaps in the place of another.
    pub(super) fn put_sensor(&mut self, sensor: usize) {
        self.flips.resize(self.flips.len().max(sensor + 1), [None, None]);
        self.flips[sensor] = [None, None];
    }

    /// Forgets all observations: the numbers of persons changed.
    pub(super) fn forget(&mut self) {
        self.flips.iter_mut().for_each(|own| *own = [None, None]);
        self.ring.clear();
        self.next = 0;
        self.last = [0.0; SLOTS_MAX];
    }

    /// A new observation, with the share that each person caused.
    pub(super) fn attribute(&mut self, shares: [f64; SLOTS_MAX]) {
        self.last = shares;
    }

    pub(super) fn last_share(&self, slot: usize) -> f64 {
        self.last[slot]
    }

    /// Records an observation with the marginals before and after it.
    pub(super) fn record(
        &mut self,
        at_s: f64,
        cause: Cause,
        shares: [f64; SLOTS_MAX],
        (before, after): (&[f64], &[f64]),
    ) {
        self.attribute(shares);
        let empty = || Heard { at_s, cause, shares, log_odds: Vec::with_capacity(SLOTS_MAX * self.columns) };
        let own = if let Cause::Sensor { sensor, on } = cause {
            let Some(place) = self.flips.get_mut(sensor) else { return };
            place[usize::from(on)].get_or_insert_with(empty)
        } else {
            if self.ring.len() < RING {
                self.ring.push(empty());
                self.next = self.ring.len() % RING;
                let last = self.ring.len() - 1;
                &mut self.ring[last]
            } else {
                let at = self.next;
                self.next = (at + 1) % RING;
                &mut self.ring[at]
            }
        };
        (own.at_s, own.cause, own.shares) = (at_s, cause, shares);
        own.log_odds.clear();
        own.log_odds.extend(before.iter().zip(after).map(|(a, b)| (log_odds(*b) - log_odds(*a)) as f32));
    }

    /// The three strongest for a slot and column.
    pub(super) fn strongest(
        &self,
        (slot, column): (usize, usize),
        now_s: f64,
        unknown: usize,
        is_on: impl Fn(usize) -> bool,
    ) -> [Option<Reason>; 3] {
        let mut best: [Option<(f64, Reason)>; 3] = [None; 3];
        for own in self.flips.iter().flatten().flatten().chain(&self.ring) {
            let Some(moved) = own.log_odds.get(slot * self.columns + column).map(|moved| f64::from(*moved)) else {
                continue;
            };
            let is_held = matches!(own.cause, Cause::Sensor { sensor, on: true } if is_on(sensor));
            let age = if is_held { 1.0 } else { (-(now_s - own.at_s).max(0.0) / HALF_LIFE_S).exp2() };
            let weight = moved.abs() * age;
            if weight < 0.05 {
                continue;
            }
            let others =
                (unknown..SLOTS_MAX).filter(|other| *other != slot).map(|other| (other - unknown, own.shares[other]));
            let other = others.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, share)| *share >= 0.05);
            let reason = Reason { cause: own.cause, at_s: own.at_s, log_odds: moved, share: own.shares[slot], other };
            if let Some(at) = best.iter().position(|kept| kept.is_none_or(|(kept, _)| kept < weight)) {
                best[at..].rotate_right(1);
                best[at] = Some((weight, reason));
            }
        }
        best.map(|kept| kept.map(|(_, reason)| reason))
    }
}
