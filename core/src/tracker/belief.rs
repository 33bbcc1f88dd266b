//! The joint distribution over the places of all persons: its most probable states, each with a weight.
//!
//! A state holds one place per person, one byte each. Homes of a few persons have thousands to millions of states, but a few hundred hold
//! almost all of the probability. The belief keeps the `most` heaviest. Without a bound it is the exact filter; both run the same code.
//! Keeping the heaviest hypotheses is the way of Reid's multiple hypothesis tracking. Unlike particles it needs no random numbers, and the
//! dropped probability is known.

use super::TrackerError;
use super::motion::{Place, Transitions, room_of, visibility};

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
}

/// Occupancy of the rooms in one state, as bit sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Occupied {
    /// Rooms with at least one person.
    pub(super) any: u64,
    /// Rooms with at least one person who is not still.
    pub(super) seen: u64,
    /// Rooms in which at least one person walks.
    pub(super) moving: u64,
}

impl Occupied {
    pub(super) fn of(key: Key, slots: usize) -> Self {
        let mut own = Self { any: 0, seen: 0, moving: 0 };
        for place in key.to_le_bytes().into_iter().take(slots) {
            if let Some(room) = room_of(place) {
                own.any |= 1 << room;
                own.seen |= u64::from(visibility(place) >= 2) << room;
                own.moving |= u64::from(visibility(place) >= 3) << room;
            }
        }
        own
    }

    /// How well sensors see the most visible person of a room: 0 for an empty room, 1 still, 2 settled, 3 moving.
    pub(super) fn class(&self, room: usize) -> usize {
        [self.any, self.seen, self.moving].iter().map(|bits| (bits >> room & 1) as usize).sum()
    }
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
    gains: Vec<f64>,
    /// Open addressing: index into `states` plus one; 0 is free. Its length is a power of two.
    index: Vec<u32>,
}

impl Belief {
    /// Everybody at one place.
    pub(super) fn new(unknown: usize, most: usize, floor: f64) -> Self {
        let room = GROWTH * most.min(1 << 10);
        let mut states = Vec::with_capacity(room);
        states.push(State { key: 0, weight: 1.0 });
        Self {
            slots: unknown,
            unknown,
            most,
            floor,
            lightest: 0.0,
            states,
            gains: Vec::with_capacity(room),
            index: vec![0; (2 * room + 2).next_power_of_two()],
        }
    }

    /// Sets how many states are kept from the next step on.
    pub(super) fn keep_at_most(&mut self, most: usize) {
        self.most = most;
        // A small index stays in the first cache.
        let room = 2 * GROWTH * most.min(1 << 10) + 2;
        self.index = vec![0; room.next_power_of_two()];
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
            let State { key, weight } = self.states[at];
            let moved = prior.iter().map(|(place, p)| State { key: with(key, slot, *place), weight: weight * p });
            self.states.extend(moved);
        }
        self.states.drain(..before);
        self.tidy();
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
        self.tidy();
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
            self.index.resize(2 * self.index.len(), 0);
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
        self.states.push(State { key, weight: 0.0 });
        self.gains.push(0.0);
        self.index[at] = self.states.len() as u32;
        Some(self.states.len() - 1)
    }

    fn reindex(&mut self) {
        // A new person multiplies the states.
        let room = (2 * (self.states.len() + 1)).next_power_of_two().max(self.index.len());
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

    /// One step of motion, for each person independently given the state.
    pub(super) fn step(&mut self, level: usize, transitions: &[Transitions], of_slot: &[usize]) {
        self.reindex();
        self.gains.clear();
        self.gains.resize(self.states.len(), 0.0);
        let least = self.floor.max(0.05 * self.lightest);
        for slot in 0..self.slots {
            let own = &transitions[of_slot[slot]];
            for at in 0..self.states.len() {
                let State { key, weight } = self.states[at];
                let mut moved = 0.0;
                for &(to, p) in own.row(level, place(key, slot)) {
                    let flow = weight * p;
                    if flow <= least {
                        break;
                    }
                    let next = with(key, slot, to);
                    let next = if slot < self.unknown { self.sorted(next) } else { next };
                    if let Some(next) = self.find(next) {
                        self.gains[next] += flow;
                        moved += flow;
                    }
                }
                self.gains[at] -= moved;
            }
            for (state, gain) in self.states.iter_mut().zip(&mut self.gains) {
                state.weight += std::mem::take(gain);
            }
        }
        self.tidy();
    }

    /// Multiplies each state by its likelihood.
    pub(super) fn weigh(&mut self, mut likelihood: impl FnMut(Key) -> f64) {
        self.states.iter_mut().for_each(|state| state.weight *= likelihood(state.key));
        self.tidy();
    }

    /// An event that moves persons: each state goes to several, as `visit(state, add)` lists with factors.
    pub(super) fn transfer(&mut self, mut visit: impl FnMut(State, &mut dyn FnMut(Key, f64))) {
        self.reindex();
        self.gains.clear();
        self.gains.resize(self.states.len(), 0.0);
        for at in 0..self.states.len() {
            let state = self.states[at];
            visit(state, &mut |next, factor| {
                if let Some(next) = self.find(self.sorted(next)) {
                    self.gains[next] += state.weight * factor;
                }
            });
        }
        for (state, gain) in self.states.iter_mut().zip(&self.gains) {
            state.weight = *gain;
        }
        self.tidy();
    }

    /// Drops the lightest states and makes the weights sum to one.
    fn tidy(&mut self) {
        let total: f64 = self.states.iter().map(|state| state.weight).sum();
        let sound = total.is_finite() && total > f64::MIN_POSITIVE;
        if !sound {
            // Every state was ruled out. The states stay, all alike.
            let share = 1.0 / self.states.len().max(1) as f64;
            self.states.iter_mut().for_each(|state| state.weight = share);
            return;
        }
        let least = self.floor * total;
        self.states.retain(|state| state.weight > least);
        if self.states.len() > self.most {
            let by_weight = |a: &State, b: &State| b.weight.total_cmp(&a.weight).then(a.key.cmp(&b.key));
            self.states.select_nth_unstable_by(self.most, by_weight);
            self.states.truncate(self.most);
        }
        let kept: f64 = self.states.iter().map(|state| state.weight).sum();
        self.states.iter_mut().for_each(|state| state.weight /= kept);
        let is_full = self.states.len() == self.most;
        let lightest = self.states.iter().map(|state| state.weight).fold(1.0, f64::min);
        self.lightest = if is_full { lightest } else { 0.0 };
    }
}
