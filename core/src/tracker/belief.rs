//! The joint distribution over the places of all persons: its most probable states, each with a weight.
//!
//! A state holds one place per person, one byte each. Homes of a few persons have thousands to millions of states, but a few hundred hold
//! almost all of the probability. The belief keeps the `most` heaviest. Without a bound it is the exact filter; both run the same code.
//! Keeping the heaviest hypotheses is the way of Reid's multiple hypothesis tracking. Unlike particles it needs no random numbers, and the
//! dropped probability is known.

use super::TrackerError;
use super::motion::{Place, Transitions, room_of};

/// Most persons, known and unknown.
pub const SLOTS_MAX: usize = 16;

/// A step may grow the belief this many times before the heaviest states are kept.
const GROWTH: usize = 8;

/// Places of all persons: slot s in byte s.
pub(super) type Key = u128;

/// The place of a slot.
pub(super) fn place(key: Key, slot: usize) -> Place {
    (key >> (8 * slot)) as Place
}

/// The state with another place of one slot.
pub(super) fn with(key: Key, slot: usize, place: Place) -> Key {
    key & !(0xff << (8 * slot)) | Key::from(place) << (8 * slot)
}

/// A joint state and its probability.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct State {
    pub(super) key: Key,
    pub(super) weight: f64,
    /// What it gains in the present step.
    gain: f64,
}

impl State {
    fn new(key: Key, weight: f64) -> Self {
        Self { key, weight, gain: 0.0 }
    }
}

/// The rooms with at least one person in a state, as a bit set. `hidden` gets the place of each person who shares a room with a more visible one:
/// the room's sensors see only the most visible person.
pub(super) fn occupied(key: Key, slots: usize, mut hidden: impl FnMut(Place)) -> u64 {
    let places = &key.to_le_bytes()[..slots];
    let (mut any, mut shared) = (0_u64, 0_u64);
    for place in places {
        let room = room_of(*place).map_or(0, |room| 1 << room);
        shared |= any & room;
        any |= room;
    }
    while shared != 0 {
        let room = Some(shared.trailing_zeros() as usize);
        let here = places.iter().copied().filter(|place| room_of(*place) == room);
        // The places of a room are in the order of their visibility, the most visible first.
        here.reduce(|seen, place| {
            hidden(seen.max(place));
            seen.min(place)
        });
        shared &= shared - 1;
    }
    any
}

/// The belief.
#[derive(Debug, Clone)]
pub(super) struct Belief {
    slots: usize,
    /// The first slots are unknown persons. They have no names, so their order carries no meaning and is kept sorted.
    unknown: usize,
    most: usize,
    /// Smaller weights are not kept, and smaller flows do not move.
    floor: f64,
    /// The lightest weight of a full belief: much smaller flows would be dropped at once, so they stay.
    lightest: f64,
    states: Vec<State>,
    /// Open addressing: index into `states` plus one; 0 is free. Its length is a power of two.
    index: Vec<u32>,
}

impl Belief {
    /// Everybody at one place.
    pub(super) fn new(unknown: usize, most: usize, floor: f64) -> Self {
        let room = GROWTH * most.min(1 << 10);
        let mut states = Vec::with_capacity(room);
        states.push(State::new(0, 1.0));
        Self {
            slots: unknown,
            unknown,
            most,
            floor,
            lightest: 0.0,
            states,
            index: Vec::with_capacity((4 * room).next_power_of_two()),
        }
    }

    /// Sets how many states are kept from the next step on.
    pub(super) fn keep_at_most(&mut self, most: usize) {
        self.most = most;
    }

    pub(super) fn states(&self) -> &[State] {
        &self.states
    }

    pub(super) fn slots(&self) -> usize {
        self.slots
    }

    /// A further person, with a distribution over places. Returns the slot.
    pub(super) fn add(&mut self, prior: &[(Place, f64)]) -> Result<usize, TrackerError> {
        if self.slots == SLOTS_MAX {
            return Err(TrackerError::Persons);
        }
        let slot = self.slots;
        self.slots += 1;
        let before = self.states.len();
        for at in 0..before {
            let State { key, weight, .. } = self.states[at];
            let moved = prior.iter().map(|(place, p)| State::new(with(key, slot, *place), weight * p));
            self.states.extend(moved);
        }
        self.states.drain(..before);
        let total = self.scale(|_| 1.0);
        self.tidy(total);
        Ok(slot)
    }

    /// Removes a person; the slots above move down by one.
    pub(super) fn remove(&mut self, slot: usize) {
        self.slots -= 1;
        for state in &mut self.states {
            let below = state.key & ((1 << (8 * slot)) - 1);
            let above = if slot + 1 == SLOTS_MAX { 0 } else { state.key >> (8 * (slot + 1)) << (8 * slot) };
            state.key = below | above;
        }
        self.merge();
        let total = self.scale(|_| 1.0);
        self.tidy(total);
    }

    /// Unknown persons in sorted order.
    fn sorted(&self, mut key: Key) -> Key {
        for end in (1..self.unknown).rev() {
            for slot in 0..end {
                let (a, b) = (place(key, slot), place(key, slot + 1));
                if a > b {
                    key = with(with(key, slot, b), slot + 1, a);
                }
            }
        }
        key
    }

    fn slot_of(&self, key: Key) -> usize {
        let folded = (key as u64) ^ ((key >> 64) as u64).rotate_left(29);
        (folded.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize & (self.index.len() - 1)
    }

    /// The index of a state, which is added with weight 0 if it is new. `None` if it is new and the belief is full.
    fn find(&mut self, key: Key) -> Option<usize> {
        if 2 * (self.states.len() + 1) > self.index.len() {
            self.reindex();
        }
        let mut at = self.slot_of(key);
        loop {
            match self.index[at] {
                0 => break,
                own if self.states[own as usize - 1].key == key => return Some(own as usize - 1),
                _ => at = (at + 1) & (self.index.len() - 1),
            }
        }
        if self.states.len() >= self.most.saturating_mul(GROWTH) {
            return None;
        }
        self.states.push(State::new(key, 0.0));
        self.index[at] = self.states.len() as u32;
        Some(self.states.len() - 1)
    }

    fn reindex(&mut self) {
        // A small index stays in the first cache.
        let room = (4 * self.states.len()).next_power_of_two();
        self.index.clear();
        self.index.resize(room, 0);
        for number in 0..self.states.len() {
            let mut at = self.slot_of(self.states[number].key);
            while self.index[at] != 0 {
                at = (at + 1) & (self.index.len() - 1);
            }
            self.index[at] = number as u32 + 1;
        }
    }

    /// Adds up states with the same key.
    fn merge(&mut self) {
        self.states.sort_unstable_by_key(|state| state.key);
        self.states.dedup_by(|next, kept| {
            let is_same = next.key == kept.key;
            if is_same {
                kept.weight += next.weight;
            }
            is_same
        });
    }

    /// One step of motion, for each person independently given the state, after a likelihood.
    pub(super) fn step<'a>(
        &mut self,
        likelihood: impl FnMut(Key) -> f64,
        units: usize,
        of_slot: impl Fn(usize) -> &'a Transitions,
    ) {
        let total = self.scale(likelihood);
        self.reindex();
        let least = total * self.floor.max(0.05 * self.lightest);
        for slot in 0..self.slots {
            let own = of_slot(slot);
            // Per place: its bits in a state, and the weight up to which nothing moves.
            let mut moves = [0; 256];
            let mut stays = [f64::INFINITY; 256];
            for from in 0..own.places() {
                moves[from] = with(0, slot, from as Place);
                stays[from] =
                    own.row(units, from as Place).first().map_or(f64::INFINITY, |way| least / f64::from(way.0));
            }
            for at in 0..self.states.len() {
                let State { key, weight, .. } = self.states[at];
                let from = key.to_le_bytes()[slot];
                if weight <= stays[usize::from(from)] {
                    continue;
                }
                let others = key ^ moves[usize::from(from)];
                let mut moved = 0.0;
                for &(p, to) in own.row(units, from) {
                    let flow = weight * f64::from(p);
                    if flow <= least {
                        break;
                    }
                    let next = others ^ moves[usize::from(to)];
                    let next = if slot < self.unknown { self.sorted(next) } else { next };
                    if let Some(next) = self.find(next) {
                        self.states[next].gain += flow;
                        moved += flow;
                    }
                }
                self.states[at].gain -= moved;
            }
            self.states.iter_mut().for_each(|state| state.weight += std::mem::take(&mut state.gain));
        }
        self.tidy(total);
    }

    /// Multiplies each state by its likelihood. Returns the sum of the weights, which is never zero.
    fn scale(&mut self, mut likelihood: impl FnMut(Key) -> f64) -> f64 {
        let mut total = 0.0;
        for state in &mut self.states {
            state.weight *= likelihood(state.key);
            total += state.weight;
        }
        if total.is_finite() && total > f64::MIN_POSITIVE {
            return total;
        }
        // Every state was ruled out. The states stay, all alike.
        let share = 1.0 / self.states.len().max(1) as f64;
        self.states.iter_mut().for_each(|state| state.weight = share);
        1.0
    }

    /// Multiplies each state by its likelihood, and drops the lightest.
    pub(super) fn weigh(&mut self, likelihood: impl FnMut(Key) -> f64) {
        let total = self.scale(likelihood);
        self.tidy(total);
    }

    /// An event that moves persons: each state goes to several, as `visit(state, add)` lists with factors.
    pub(super) fn transfer(&mut self, mut visit: impl FnMut(State, &mut dyn FnMut(Key, f64))) {
        self.reindex();
        for at in 0..self.states.len() {
            let state = self.states[at];
            visit(state, &mut |next, factor| {
                if let Some(next) = self.find(self.sorted(next)) {
                    self.states[next].gain += state.weight * factor;
                }
            });
        }
        self.states.iter_mut().for_each(|state| state.weight = std::mem::take(&mut state.gain));
        let total = self.scale(|_| 1.0);
        self.tidy(total);
    }

    /// Drops the lightest states and makes the weights, which sum to `total`, sum to one.
    fn tidy(&mut self, total: f64) {
        let least = self.floor * total;
        self.states.retain(|state| state.weight > least);
        if self.states.len() > self.most {
            let by_weight = |a: &State, b: &State| b.weight.total_cmp(&a.weight).then(a.key.cmp(&b.key));
            self.states.select_nth_unstable_by(self.most, by_weight);
            self.states.truncate(self.most);
        }
        let kept: f64 = self.states.iter().map(|state| state.weight).sum();
        self.lightest = f64::INFINITY;
        for state in &mut self.states {
            state.weight /= kept;
            self.lightest = self.lightest.min(state.weight);
        }
        if self.states.len() < self.most {
            self.lightest = 0.0;
        }
    }
}
