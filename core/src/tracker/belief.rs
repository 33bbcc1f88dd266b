//! The joint distribution over the places of all persons: its most probable states, each with a weight.
//!
//! A state holds one column per person, one byte each: elsewhere or a room. Within a state, each person has a distribution over the phases of
//! that column (walks, stays, is hardly seen), independent of the others:
//!
//! ```text
//! p(x) = sum over states s of w(s) prod over persons i of f(s, i, phase of x_i)    if x_i lies in the column s_i of all persons
//! ```
//!
//! Doubt about rooms is joint, and the three phases of a person do not multiply the states (Rao-Blackwellised in the phases). States
//! that meet mix their phases by weight, which keeps the marginals of each person. [`Belief::apart`] gives each phase its own state: the exact filter,
//! by the same code. The belief keeps the `most` heaviest states, the way of Reid's multiple hypothesis tracking. Unlike particles it needs no
//! random numbers, and the dropped probability is known.

use super::TrackerError;
use super::motion::{Column, Phases, Transitions, column_of, moved, place_of};

/// Most persons, known and unknown.
pub const SLOTS_MAX: usize = 16;

/// A step may grow the belief this many times before the heaviest states are kept.
const GROWTH: usize = 8;

/// In a full belief, smaller shares of the lightest state do not move.
const SMALL_FLOW: f64 = 0.2;

/// Columns of all persons: slot s in byte s. In a belief with phases apart, places.
type Key = u128;

/// The state with another byte of one slot.
fn with(key: Key, slot: usize, byte: u8) -> Key {
    key & !(0xff << (8 * slot)) | Key::from(byte) << (8 * slot)
}

fn columns_of(key: Key, apart: bool) -> [Column; SLOTS_MAX] {
    let bytes = key.to_le_bytes();
    if apart { bytes.map(column_of) } else { bytes }
}

/// A joint state.
#[derive(Debug, Clone, Copy)]
pub(super) struct State<'a> {
    columns: [Column; SLOTS_MAX],
    pub(super) weight: f64,
    phases: &'a [Phases],
}

impl<'a> State<'a> {
    /// The column and phases of each slot.
    pub(super) fn slots(&self) -> impl Iterator<Item = (Column, &'a Phases)> + use<'a> {
        self.columns.into_iter().zip(self.phases)
    }

    /// The rooms with at least one person, and with several, as bit sets.
    pub(super) fn rooms(&self) -> (u64, u64) {
        rooms(&self.columns[..self.phases.len()])
    }

    /// The phases of the most visible person in a column.
    pub(super) fn seen(&self, column: Column) -> Phases {
        let here = self.slots().filter(|(own, _)| *own == column);
        let below = here.fold(ONES, |all, (_, phases)| times(&all, &tails(phases)));
        [below[0] - below[1], below[1] - below[2], below[2], 0.0]
    }
}

/// The rooms with at least one person, and with several, as bit sets.
fn rooms(columns: &[Column]) -> (u64, u64) {
    columns.iter().fold((0, 0), |(any, several), column| {
        let room = column.checked_sub(1).map_or(0, |room| 1_u64 << room);
        (any | room, several | any & room)
    })
}

fn times(a: &Phases, b: &Phases) -> Phases {
    std::array::from_fn(|phase| a[phase] * b[phase])
}

fn sum(own: &Phases) -> f32 {
    (own[0] + own[1]) + (own[2] + own[3])
}

/// Per phase: the probability of a phase that is at most as visible. The phases of a room are in the order of their visibility.
fn tails(own: &Phases) -> Phases {
    [own[0] + own[1] + own[2], own[1] + own[2], own[2], 0.0]
}

/// The sensors of a room together change the odds of a phase at most by this factor.
pub(super) const MOST: f32 = 1e18;

const ONES: Phases = [1.0; 4];

/// Likelihoods of an observation that are independent for each room and person.
#[derive(Debug, Clone, Default)]
pub(super) struct Likelihood {
    /// Per column: by the phase of the most visible person there, relative to a room without persons.
    pub(super) rooms: Vec<Phases>,
    /// Per slot and column: by the phase of that person.
    pub(super) slots: Vec<Phases>,
    /// The product of both, for the only person of a room.
    alone: Vec<Phases>,
}

impl Likelihood {
    /// No observation.
    pub(super) fn clear(&mut self, columns: usize, slots: usize) {
        self.rooms.clear();
        self.rooms.resize(columns, ONES);
        self.slots.clear();
        self.slots.resize(columns * slots, ONES);
    }

    /// Per phase of a person: the likelihood of the state if the person were in the column `to` instead, relative to the state, and at most 1.
    pub(super) fn of_move(
        &self,
        state: &State<'_>,
        slot: usize,
        (from, to): (Column, Column),
        phases: &Phases,
    ) -> Phases {
        let (any, several) = state.rooms();
        let is_in = |rooms: u64, column: Column| column.checked_sub(1).is_some_and(|room| rooms >> room & 1 == 1);
        let of = |column: Column, counts: bool| {
            let own = &self.slots[slot * self.rooms.len() + usize::from(column)];
            times(own, if counts { &self.rooms[usize::from(column)] } else { &ONES })
        };
        let there = sum(&times(&of(to, !is_in(any, to)), phases));
        of(from, !is_in(several, from)).map(|here| (there / here.max(f32::MIN_POSITIVE)).min(1.0))
    }

    fn join(&mut self) {
        self.alone.clear();
        let both = |(slot, room)| times(slot, room).map(|own| own.clamp(1.0 / MOST, MOST));
        self.alone.extend(self.slots.iter().zip(self.rooms.iter().cycle()).map(both));
    }

    /// Weighs the phases of a state. Returns the state's factor.
    fn weigh(&self, columns: &[Column], phases: &mut [Phases]) -> f64 {
        let (_, several) = rooms(columns);
        let mut all = 1.0;
        let of_slots = self.slots.chunks_exact(self.rooms.len()).zip(self.alone.chunks_exact(self.rooms.len()));
        for ((column, own), (slot, alone)) in columns.iter().zip(phases.iter_mut()).zip(of_slots) {
            let is_alone = column.checked_sub(1).is_none_or(|room| several >> room & 1 == 0);
            let factors = &if is_alone { alone } else { slot }[usize::from(*column)];
            if *factors != ONES {
                all *= f64::from(settle(own, times(own, factors)));
            }
        }
        let mut left = several;
        while left != 0 {
            let room = left.trailing_zeros() as Column;
            let seen = &self.rooms[usize::from(room) + 1];
            if *seen != ONES {
                all *= f64::from(together(columns, phases, room + 1, seen));
            }
            left &= left - 1;
        }
        all
    }
}

/// Takes weighed phases in as a distribution, and returns their sum.
fn settle(own: &mut Phases, weighed: Phases) -> f32 {
    let sum = sum(&weighed);
    if sum > f32::MIN_POSITIVE {
        *own = weighed.map(|share| share / sum);
    }
    sum
}

/// Sensors see only the most visible of several persons in a room: each person is weighed by what the others leave. Returns the factor.
fn together(columns: &[Column], phases: &mut [Phases], column: Column, seen: &Phases) -> f32 {
    let mut before = [[0.0; 4]; SLOTS_MAX];
    before[..phases.len()].copy_from_slice(phases);
    let here = |slot: &usize| columns[*slot] == column;
    let mut all = 0.0;
    for slot in (0..columns.len()).filter(here) {
        let others = (0..columns.len()).filter(|other| *other != slot && columns[*other] == column);
        let below = others.fold(ONES, |all, other| times(&all, &tails(&before[other])));
        let [first, second] = [seen[0] * (below[0] - below[1]), seen[1] * (below[1] - below[2])];
        let factors = [seen[0] * below[0], first + seen[1] * below[1], first + second + seen[2] * below[2], 0.0];
        all = settle(&mut phases[slot], times(&before[slot], &factors));
    }
    all
}

/// Weight that goes to another state in a step or event.
#[derive(Debug, Clone, Copy)]
struct Flow {
    from: usize,
    to: Key,
    slot: usize,
    weight: f64,
    phases: Phases,
}

/// Flows of a state to others.
pub(super) struct Flows<'a> {
    list: &'a mut Vec<Flow>,
    from: usize,
    key: Key,
    weight: f64,
    apart: bool,
}

impl Flows<'_> {
    /// A share of the state stays as it is.
    pub(super) fn keep(&mut self, share: f64) {
        let weight = self.weight * share;
        self.list.push(Flow { from: self.from, to: self.key, slot: SLOTS_MAX, weight, phases: [0.0; 4] });
    }

    /// A person is in a column, with these phases, which are shares of the state.
    pub(super) fn put(&mut self, slot: usize, column: Column, phases: Phases) {
        parts(self.apart, column, phases, |byte, phases| {
            let share = sum(&phases);
            if share > 0.0 {
                let weight = self.weight * f64::from(share);
                let phases = phases.map(|own| own / share);
                self.list.push(Flow { from: self.from, to: with(self.key, slot, byte), slot, weight, phases });
            }
        });
    }
}

/// The bytes of a column, with their phases.
fn parts(apart: bool, column: Column, phases: Phases, mut visit: impl FnMut(u8, Phases)) {
    if !apart {
        return visit(column, phases);
    }
    for (phase, share) in phases.into_iter().enumerate().filter(|(_, share)| *share > 0.0) {
        let mut own = [0.0; 4];
        own[phase] = share;
        visit(place_of(column, phase), own);
    }
}

/// The belief.
#[derive(Debug, Clone)]
pub(super) struct Belief {
    slots: usize,
    /// The first slots are unknown persons.
    unknown: usize,
    /// Each phase is a state of its own.
    apart: bool,
    most: usize,
    /// Smaller weights are not kept, and smaller flows do not move.
    floor: f64,
    /// The lightest weight of a full belief: much smaller flows would be dropped at once, so they stay.
    lightest: f64,
    keys: Vec<Key>,
    weights: Vec<f64>,
    /// Per state and slot.
    phases: Vec<Phases>,
    /// The phases before the present flows.
    former: Vec<Phases>,
    flows: Vec<Flow>,
    sorted: Vec<f64>,
    /// Open addressing: index into `keys` plus one; 0 is free. Its length is a power of two.
    index: Vec<u32>,
}

impl Belief {
    /// So many unknown persons, who are elsewhere.
    pub(super) fn new(unknown: usize, most: usize, floor: f64, apart: bool) -> Self {
        let mut own = Self {
            slots: unknown,
            unknown,
            apart,
            most,
            floor,
            lightest: 0.0,
            keys: Vec::new(),
            weights: Vec::new(),
            phases: Vec::new(),
            former: Vec::new(),
            flows: Vec::new(),
            sorted: Vec::new(),
            index: vec![0; 4],
        };
        own.push(0);
        own.weights[0] = 1.0;
        own.phases.fill([1.0, 0.0, 0.0, 0.0]);
        own
    }

    pub(super) fn slots(&self) -> usize {
        self.slots
    }

    pub(super) fn states(&self) -> impl Iterator<Item = State<'_>> {
        (0..self.keys.len()).map(|at| self.state(at))
    }

    fn state(&self, at: usize) -> State<'_> {
        let phases = &self.phases[at * self.slots..(at + 1) * self.slots];
        State { columns: columns_of(self.keys[at], self.apart), weight: self.weights[at], phases }
    }

    /// The probability that a person is in the house.
    pub(super) fn inside(&self, slot: usize) -> f64 {
        let least = if self.apart { 1 } else { 0 };
        let is_in = |key: &Key| key.to_le_bytes().get(slot).is_some_and(|own| *own > least);
        self.keys.iter().zip(&self.weights).filter(|(key, _)| is_in(key)).map(|(_, weight)| weight).sum()
    }

    /// A further person, with shares of columns and phases. Returns the slot.
    pub(super) fn add(&mut self, prior: &[(Column, Phases)]) -> Result<usize, TrackerError> {
        if self.slots == SLOTS_MAX {
            return Err(TrackerError::Persons);
        }
        let slot = self.slots;
        let (keys, weights) = (std::mem::take(&mut self.keys), std::mem::take(&mut self.weights));
        let phases = std::mem::take(&mut self.phases);
        self.slots += 1;
        for (at, (key, weight)) in keys.into_iter().zip(weights).enumerate() {
            for &(column, own) in prior {
                parts(self.apart, column, own, |byte, own| {
                    let share = sum(&own);
                    self.keys.push(with(key, slot, byte));
                    self.weights.push(weight * f64::from(share));
                    self.phases.extend_from_slice(&phases[at * slot..(at + 1) * slot]);
                    self.phases.push(own.map(|own| own / share));
                });
            }
        }
        let total = self.weights.iter().sum();
        self.tidy(total);
        Ok(slot)
    }

    /// Removes a person; the slots above move down by one.
    pub(super) fn remove(&mut self, slot: usize) {
        let (keys, weights) = (std::mem::take(&mut self.keys), std::mem::take(&mut self.weights));
        let mut phases = std::mem::take(&mut self.phases);
        let mut at = 0;
        phases.retain(|_| {
            at += 1;
            (at - 1) % self.slots != slot
        });
        self.slots -= 1;
        self.reindex();
        self.former = phases;
        for (from, (key, weight)) in keys.into_iter().zip(weights).enumerate() {
            let below = key & ((1 << (8 * slot)) - 1);
            let above = if slot + 1 == SLOTS_MAX { 0 } else { key >> (8 * (slot + 1)) << (8 * slot) };
            self.take(&Flow { from, to: below | above, slot: SLOTS_MAX, weight, phases: [0.0; 4] });
        }
        let total = self.weights.iter().sum();
        self.tidy(total);
    }

    fn slot_of(&self, key: Key) -> usize {
        let folded = (key as u64) ^ ((key >> 64) as u64).rotate_left(29);
        (folded.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize & (self.index.len() - 1)
    }

    fn push(&mut self, key: Key) {
        self.keys.push(key);
        self.weights.push(0.0);
        self.phases.extend(std::iter::repeat_n([0.0; 4], self.slots));
    }

    /// The index of a state, which is added with weight 0 if it is new. `None` if it is new and the belief is full.
    fn find(&mut self, key: Key) -> Option<usize> {
        if 2 * (self.keys.len() + 1) > self.index.len() {
            self.reindex();
        }
        let mut at = self.slot_of(key);
        loop {
            match self.index[at] {
                0 => break,
                own if self.keys[own as usize - 1] == key => return Some(own as usize - 1),
                _ => at = (at + 1) & (self.index.len() - 1),
            }
        }
        if self.keys.len() >= self.most.saturating_mul(GROWTH) {
            return None;
        }
        self.push(key);
        self.index[at] = self.keys.len() as u32;
        Some(self.keys.len() - 1)
    }

    fn reindex(&mut self) {
        // A small index stays in the first cache.
        let room = (4 * self.keys.len()).next_power_of_two();
        self.index.clear();
        self.index.resize(room, 0);
        for number in 0..self.keys.len() {
            let mut at = self.slot_of(self.keys[number]);
            while self.index[at] != 0 {
                at = (at + 1) & (self.index.len() - 1);
            }
            self.index[at] = number as u32 + 1;
        }
    }

    /// Unknown persons have no names: their order carries no meaning, and the one with the last column is the first. Returns the former slot of
    /// each slot, too.
    fn sorted(&self, key: Key) -> (Key, [u8; SLOTS_MAX]) {
        let (mut bytes, mut order) = (key.to_le_bytes(), std::array::from_fn(|slot| slot as u8));
        for end in (1..self.unknown).rev() {
            for slot in 0..end {
                if bytes[slot] < bytes[slot + 1] {
                    bytes.swap(slot, slot + 1);
                    order.swap(slot, slot + 1);
                }
            }
        }
        (Key::from_le_bytes(bytes), order)
    }

    /// Adds a flow to its state: the phases mix by weight. Returns whether the belief had room for it.
    fn take(&mut self, flow: &Flow) -> bool {
        let (to, order) = self.sorted(flow.to);
        let Some(at) = self.find(to) else { return false };
        self.weights[at] += flow.weight;
        let share = (flow.weight / self.weights[at].max(f64::MIN_POSITIVE)) as f32;
        let slots = self.slots;
        let own = &mut self.phases[at * slots..(at + 1) * slots];
        let former = &self.former[flow.from * slots..(flow.from + 1) * slots];
        for (own, slot) in own.iter_mut().zip(order) {
            let slot = usize::from(slot);
            let other = if slot == flow.slot { &flow.phases } else { &former[slot] };
            own.iter_mut().zip(other).for_each(|(own, other)| *own += share * (other - *own));
        }
        true
    }

    /// One step of motion, for each person independently given the state, after a likelihood.
    pub(super) fn step<'a>(
        &mut self,
        likelihood: &mut Likelihood,
        units: usize,
        of_slot: impl Fn(usize) -> &'a Transitions,
    ) {
        let total = self.scale(likelihood);
        self.reindex();
        let least = total * self.floor.max(SMALL_FLOW * self.lightest);
        // In order, an unknown person could move twice: a swap comes after all have moved.
        let unknown = std::mem::take(&mut self.unknown);
        for slot in 0..self.slots {
            self.move_person(slot, least, of_slot(slot), units);
        }
        self.unknown = unknown;
        if self.keys.iter().any(|key| self.sorted(*key).0 != *key) {
            return self.transfer(|_, flows| flows.keep(1.0));
        }
        self.tidy(total);
    }

    /// One step of one person.
    fn move_person(&mut self, slot: usize, least: f64, own: &Transitions, units: usize) {
        let mut flows = std::mem::take(&mut self.flows);
        flows.clear();
        let apart = self.apart;
        let states = self.phases.chunks_exact_mut(self.slots.max(1)).zip(&mut self.weights).zip(&self.keys);
        for (from, ((phases, left), &key)) in states.enumerate() {
            let (phases, weight) = (&mut phases[slot], *left);
            let before = *phases;
            let byte = key.to_le_bytes()[slot];
            let column = if apart { column_of(byte) } else { byte };
            let (stays, ways) = own.row(units, column);
            let least = (least / weight) as f32;
            let mut go = |to, phases: Phases| {
                let share = sum(&phases);
                if share > least {
                    let weight = weight * f64::from(share);
                    *left -= weight;
                    let phases = phases.map(|own| own / share);
                    flows.push(Flow { from, to: with(key, slot, to), slot, weight, phases });
                }
            };
            let leaves = apart || sum(&times(&before, &stays.leave)) > least;
            if column == 0 && !leaves {
                continue;
            }
            let stay = moved(&before, &stays.shares);
            if apart {
                parts(true, column, stay, |to, phases| {
                    if to != byte {
                        go(to, phases)
                    }
                });
            } else {
                *phases = stay.map(|own| own * (1.0 / sum(&stay)));
            }
            for way in ways.iter().take_while(|_| leaves) {
                if way.most <= least {
                    break;
                }
                if sum(&times(&before, &way.leave)) > least {
                    parts(apart, way.to, moved(&before, &way.shares), &mut go);
                }
            }
        }
        if !flows.is_empty() {
            self.former.clone_from(&self.phases);
        }
        for flow in &flows {
            if !self.take(flow) {
                self.weights[flow.from] += flow.weight;
            }
        }
        self.flows = flows;
    }

    /// Multiplies each state by its likelihood. Returns the sum of the weights, which is never zero.
    fn scale(&mut self, likelihood: &mut Likelihood) -> f64 {
        likelihood.join();
        for (at, phases) in self.phases.chunks_exact_mut(self.slots.max(1)).enumerate() {
            let columns = columns_of(self.keys[at], self.apart);
            self.weights[at] *= likelihood.weigh(&columns[..phases.len()], phases);
        }
        self.total()
    }

    /// The sum of the weights. If every state was ruled out, the states stay, all alike.
    fn total(&mut self) -> f64 {
        let total: f64 = self.weights.iter().sum();
        if total.is_finite() && total > f64::MIN_POSITIVE {
            return total;
        }
        let share = 1.0 / self.weights.len().max(1) as f64;
        self.weights.fill(share);
        1.0
    }

    /// Multiplies each state by its likelihood, and drops the lightest.
    pub(super) fn weigh(&mut self, likelihood: &mut Likelihood) {
        let total = self.scale(likelihood);
        self.tidy(total);
    }

    /// The same, by a likelihood of whole states.
    pub(super) fn weigh_states(&mut self, mut likelihood: impl FnMut(State<'_>) -> f64) {
        for at in 0..self.keys.len() {
            let factor = likelihood(self.state(at));
            self.weights[at] *= factor;
        }
        let total = self.total();
        self.tidy(total);
    }

    /// An event that moves persons: each state goes to several, as `visit(state, flows)` lists.
    pub(super) fn transfer(&mut self, mut visit: impl FnMut(State<'_>, &mut Flows<'_>)) {
        let mut list = std::mem::take(&mut self.flows);
        list.clear();
        self.reindex();
        for from in 0..self.keys.len() {
            let (key, weight, apart) = (self.keys[from], self.weights[from], self.apart);
            visit(self.state(from), &mut Flows { list: &mut list, from, key, weight, apart });
        }
        self.former.clone_from(&self.phases);
        self.weights.fill(0.0);
        list.iter().for_each(|flow| _ = self.take(flow));
        self.flows = list;
        let total = self.total();
        self.tidy(total);
    }

    /// Drops the lightest states and makes the weights, which sum to `total`, sum to one.
    fn tidy(&mut self, total: f64) {
        let mut least = self.floor * total;
        self.sorted.clear();
        self.sorted.extend(self.weights.iter().filter(|weight| **weight > least));
        // Of states that weigh the same as the lightest one that is kept, the first stay.
        let mut alike = 0;
        if self.sorted.len() > self.most {
            let (heavier, lightest, _) = self.sorted.select_nth_unstable_by(self.most - 1, |a, b| b.total_cmp(a));
            least = *lightest;
            alike = self.most - heavier.iter().filter(|weight| **weight > least).count();
        }
        let (mut kept, mut sum) = (0, 0.0);
        for at in 0..self.keys.len() {
            let weight = self.weights[at];
            let is_alike = alike > 0 && weight == least;
            if weight <= least && !is_alike {
                continue;
            }
            alike -= usize::from(is_alike);
            sum += weight;
            if kept != at {
                (self.keys[kept], self.weights[kept]) = (self.keys[at], weight);
                self.phases.copy_within(at * self.slots..(at + 1) * self.slots, kept * self.slots);
            }
            kept += 1;
        }
        self.keys.truncate(kept);
        self.weights.truncate(kept);
        self.phases.truncate(kept * self.slots);
        self.weights.iter_mut().for_each(|weight| *weight /= sum);
        // A copy of the belief needs none of these.
        self.former.clear();
        self.flows.clear();
        self.sorted.clear();
        self.index.clear();
        self.lightest = if kept < self.most { 0.0 } else { least / sum };
    }
}

#[cfg(test)]
mod tests {
    use super::super::Movement;
    use super::super::home::{Home, RoomUse};
    use super::super::motion::FORGETS;
    use super::*;

    #[test]
    fn sensors_of_a_room_see_the_most_visible_of_three_persons() {
        let before = [[0.2, 0.5, 0.3, 0.0], [0.1, 0.1, 0.8, 0.0], [0.3, 0.6, 0.1, 0.0]];
        let likelihood = [0.9, 0.2, 0.05, 0.0];
        let (mut all, mut seen, mut each) = (0.0, [0.0; 4], [[0.0; 4]; 3]);
        for code in 0..27 {
            let phases = [code % 3, code / 3 % 3, code / 9];
            let p: f32 = phases.iter().zip(&before).map(|(phase, own)| own[*phase]).product();
            let first = phases.into_iter().min().unwrap();
            seen[first] += p;
            all += p * likelihood[first];
            each.iter_mut().zip(phases).for_each(|(own, phase)| own[phase] += p * likelihood[first]);
        }
        let state = State { columns: [1; SLOTS_MAX], weight: 1.0, phases: &before };
        let mut after = before;
        let factor = together(&[1; 3], &mut after, 1, &likelihood);
        let apart = |a: &Phases, b: &Phases| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!((factor - all).abs() < 1e-6 && apart(&state.seen(1), &seen) < 1e-6);
        assert!(after.iter().zip(each).all(|(own, each)| apart(own, &each.map(|p| p / all)) < 1e-6));
    }

    #[test]
    fn two_visitors_move_independently() {
        let home = Home::new(&[RoomUse::Kitchen, RoomUse::Hall, RoomUse::Living], &[(0, 1), (1, 2)], &[]).unwrap();
        let mut tables = Transitions::new(&home);
        tables.fill(&home, &Movement::usual(&home, 12), &[1.0; 3], FORGETS);
        let walks = |rooms: &[Column]| {
            let mut own = Belief::new(rooms.len(), usize::MAX, 0.0, false);
            for column in rooms {
                // The last slot is the one elsewhere.
                own.transfer(|_, flows| flows.put(rooms.len() - 1, *column, [1.0, 0.0, 0.0, 0.0]));
            }
            let mut likelihood = Likelihood::default();
            likelihood.clear(4, rooms.len());
            (0..3).for_each(|_| own.step(&mut likelihood, 64, |_| &tables));
            // The expected number of persons per column.
            let mut count = [0.0; 4];
            for state in own.states() {
                state.slots().for_each(|(column, _)| count[usize::from(column)] += state.weight);
            }
            count
        };
        let [both, one, other] = [&[3, 1][..], &[3], &[1]].map(walks);
        assert!((0..4).all(|at| (both[at] - one[at] - other[at]).abs() < 1e-6), "{both:?} {one:?} {other:?}");
    }
}
