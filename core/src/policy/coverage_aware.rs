//! The default policy: it weighs seconds near people against rooms left undone.

use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, UncoveredFirst, check, partition_id};
use crate::text::count;

/// Limit of the dynamic program: 2^12 sets of rooms per slot. Beyond it, [`plan`] uses its heuristic.
pub const DP_PARTITIONS_MAX: usize = 12;

/// Default price per room left undone, in seconds of disturbance. The robot skips a room only if covering it would mean sharing it for most of a
/// minute. Chosen on the experiments' grid and on held-out activities, where it disturbs less than informed avoidance and fails no more often than
/// chance (docs/tables.md).
pub const WEIGHT_DEFAULT_S: f64 = 42.0;

/// The default price is at least this share of the people's expected time in one slot. If the robot works for a quarter of an hour per room, a minute
/// is too low a price.
pub const WEIGHT_DEFAULT_SLOTS: f64 = 0.4;

/// The default price is at least this share of a stay: a room that is empty with 70 % or more is done now.
pub const WEIGHT_DEFAULT_STAY: f64 = 0.3;

/// Cost differences below this share of a slot count as zero: the chance to meet a person then rounds to 0 %.
pub(crate) const FREE_SHARE: f64 = 0.005;

/// A room counts as empty if it is occupied during a slot with at most this probability. A forecast of an occupied home never says 0, and becomes
/// less certain with time.
const EMPTY_SHARE: f64 = 0.05;

/// Weight of the cost of later slots against the cost of the current stay, while there are more slots than rooms to do. A room with a higher cost now
/// is done first only if that saves at least twice the difference later.
///
/// The current stay uses current knowledge. Later slots are planned again with later knowledge, and the forecasts of far slots all equal the long-run
/// occupancy. For a room occupied half of the time, a plan made today charges half a stay at any later slot. With one spare slot there are two
/// chances for the room, and the robot sees both before it takes one: the room costs as much only if it is occupied both times, 1/2 of 1/2. So with a
/// spare slot at most half of the saving is lost, and without one nothing is discounted. This is reasoned, not fitted to any run.
pub(crate) const LATER_SHARE: f64 = 0.5;

/// Differences of less than this many seconds are rounding.
const TIE_S: f64 = 1e-6;

/// Greatest price, in seconds: above it, costs would be lost to rounding. No timeline is that long.
const WEIGHT_MAX_S: f64 = 1e9;

/// The project's own policy: plans the rooms of all remaining slots against the forecast, takes the first, and plans again at every decision.
///
/// The plan minimises the expected time shared with the person plus `weight_s` per room left undone. Work is never postponed for a gain below half a
/// percent of a slot, nor, with the default weight, while a room to do counts as empty (5 %). Without a forecast or a horizon it acts like
/// [`UncoveredFirst`].
///
/// **Which room first.** While there are more slots than rooms to do, the robot can wait for better forecasts. The first room then minimises its own
/// seconds now plus half of the seconds of the rest of the plan. So the robot takes the emptiest room now, unless another room saves at least twice
/// the difference later. A room that is empty now and a bedroom tonight saves a whole stay, which counts; a room with 52 % tomorrow and 49 % now
/// saves nothing. If every slot is needed, the robot follows the cheapest plan. With a given weight and for a clairvoyant robot, later slots are not
/// discounted.
#[derive(Debug, Clone, Copy)]
pub struct CoverageAware {
    weight_s: Option<f64>,
    free_share: f64,
}

impl CoverageAware {
    /// `weight_s` is the price per room left undone, in seconds of disturbance. 0 only avoids the person; infinity always covers if possible; `None`
    /// or NaN is the greatest of [`WEIGHT_DEFAULT_S`], [`WEIGHT_DEFAULT_SLOTS`] and [`WEIGHT_DEFAULT_STAY`].
    #[must_use]
    pub fn new(weight_s: Option<f64>) -> Self {
        let weight_s = weight_s.filter(|weight_s| !weight_s.is_nan()).map(|weight_s| weight_s.max(0.0));
        Self { weight_s, free_share: FREE_SHARE }
    }

    /// For a robot that knows the future: it covers if possible, and waits for any gain, however small.
    #[must_use]
    pub fn clairvoyant() -> Self {
        Self { weight_s: Some(WEIGHT_MAX_S), free_share: 0.0 }
    }

    /// A room counts as empty up to this cost of a stay, in seconds. 0 with a given weight: then costs alone decide.
    fn empty_s(self, state: &RobotState<'_>) -> f64 {
        if self.weight_s.is_none() { EMPTY_SHARE * state.room_time_s } else { 0.0 }
    }

    fn weight_s(self, state: &RobotState<'_>) -> f64 {
        self.weight_s.unwrap_or_else(|| {
            let slot_s: f64 = state.expected_shared_s.iter().take(state.covered.len()).sum();
            WEIGHT_DEFAULT_S.max(WEIGHT_DEFAULT_SLOTS * slot_s).max(WEIGHT_DEFAULT_STAY * state.room_time_s)
        })
    }
}

impl Policy for CoverageAware {
    fn name(&self) -> PolicyName {
        PolicyName::CoverageAware
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let weight_s = self.weight_s(state);
        // The plan contains only open rooms.
        let open: Vec<usize> = state.open(scores.len()).collect();
        let slots = state.expected_shared_s.chunks(scores.len());
        let shared_s: Vec<f64> = slots.flat_map(|slot| open.iter().map(|p| slot[*p])).collect();
        let covered: Vec<bool> = open.iter().map(|p| state.covered[*p]).collect();
        let weights_s: Vec<f64> =
            open.iter().map(|p| weight_s * state.weights.get(*p).copied().unwrap_or(1.0)).collect();
        let later_share = if self.weight_s.is_none() { LATER_SHARE } else { 1.0 };
        let free = Free { tie_s: self.free_share * state.room_time_s, empty_s: self.empty_s(state), later_share };
        let Some(plan) = plan_free(&shared_s, &covered, &weights_s, free) else {
            return UncoveredFirst.choose(state, scores, rng);
        };
        let first = plan.partitions.first().copied().ok_or(PolicyError::NoPartitions)?;
        // Draws once, so that paired runs with random policies stay paired.
        let _: f64 = rand::RngExt::random(rng);
        let to_do = covered.iter().filter(|done| !**done).count();
        let all_done = state.covered.iter().all(|done| *done);
        let now = match (all_done, covered[first]) {
            (true, _) => "all rooms are done: waits where it is least likely to meet somebody",
            (false, true) => "waits in a room that is done",
            (false, false) => "works here",
        };
        // A closed room is not in the plan, but still to do.
        let is_all = to_do == state.covered.iter().filter(|done| !**done).count();
        let rooms = match (plan.works, plan.undone) {
            (works, 0) if is_all => format!("{} left", count(works, "room")),
            (works, 0) => format!("{} left", count(works, "open room")),
            (works, undone) => format!("{works} of {}", count(works + undone, "room")),
        };
        let does = match plan.works {
            0 => String::new(),
            _ => format!("; plan: {rooms}, about {} near people", about(plan.work_s)),
        };
        let late = plan.undone.min(to_do.saturating_sub(plan.partitions.len()));
        let mut left = match late {
            0 => String::new(),
            late => format!("; there is no time for {}", count(late, "room")),
        };
        match plan.undone - late {
            0 => {}
            1 => left += &format!("; 1 room would take more than {weight_s:.0} s near people"),
            dear => left += &format!("; {dear} rooms would each take more than {weight_s:.0} s near people"),
        }
        Ok(Choice { partition: partition_id(open[first]), reason: format!("{now}{does}{left}") })
    }
}

/// A time in words: "40 s", "4 min".
fn about(seconds: f64) -> String {
    if seconds < 90.0 { format!("{seconds:.0} s") } else { format!("{:.0} min", seconds / 60.0) }
}

/// A room for every remaining slot.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Partition per slot.
    pub partitions: Vec<usize>,
    /// Time shared with the person over all slots, as forecast, in seconds.
    pub shared_s: f64,
    /// The part of `shared_s` in stays in which the robot works. In the other stays it waits.
    pub work_s: f64,
    /// Number of partitions that the plan does.
    pub works: usize,
    /// Number of partitions left to do at the end.
    pub undone: usize,
}

/// The plan with the least `shared_s` plus `weight_s` per room left undone. A plan that does a room in the first slot is preferred if it costs at
/// most `tie_s` more.
///
/// `shared_s` has slots x partitions (`covered.len()`) entries, slot by slot, in seconds. Exact up to [`DP_PARTITIONS_MAX`] partitions to do, by
/// dynamic programming over (slot, set of rooms to do): a step goes to one of the rooms to do or to the cheapest room of the slot. Beyond it, a
/// heuristic: the room with the greatest cost of its best free slot, compared with the slot's cheapest room, is placed first. `None` if there is no
/// slot or no partition.
#[must_use]
pub fn plan(shared_s: &[f64], covered: &[bool], weight_s: f64, tie_s: f64) -> Option<Plan> {
    plan_free(shared_s, covered, &vec![weight_s; covered.len()], Free { tie_s, empty_s: 0.0, later_share: 1.0 })
}

/// When work in the first slot counts as free.
#[derive(Debug, Clone, Copy)]
struct Free {
    /// If the plan costs at most this much more, in seconds.
    tie_s: f64,
    /// If the robot would wait otherwise, and the work itself costs at most this much, in seconds.
    empty_s: f64,
    /// The weight of later slots ([`LATER_SHARE`]) if there are spare slots.
    later_share: f64,
}

/// As [`plan`], but does a room that counts as empty in the first slot instead of waiting for it.
fn plan_free(shared_s: &[f64], covered: &[bool], weights_s: &[f64], free: Free) -> Option<Plan> {
    let partitions = covered.len();
    let slots = shared_s.len().checked_div(partitions)?;
    if slots == 0 {
        return None;
    }
    let cheapest: Vec<usize> = (0..slots)
        .map(|slot| {
            let costs = &shared_s[slot * partitions..][..partitions];
            (0..partitions).min_by(|a, b| costs[*a].total_cmp(&costs[*b])).unwrap_or(0)
        })
        .collect();
    let to_do: Vec<usize> = (0..partitions).filter(|p| !covered[*p]).collect();
    let weights_s: Vec<f64> = weights_s.iter().map(|weight_s| weight_s.min(WEIGHT_MAX_S)).collect();
    let task = Task {
        shared_s,
        partitions,
        cheapest: &cheapest,
        to_do: &to_do,
        weights_s: &weights_s,
        tie_s: free.tie_s.max(TIE_S),
        empty_s: free.empty_s,
        later_share: if slots > to_do.len() { free.later_share } else { 1.0 },
    };
    let rooms = if to_do.len() <= DP_PARTITIONS_MAX { task.dynamic_program() } else { task.by_regret() };
    let total = rooms.iter().enumerate().map(|(slot, p)| task.cost(slot, *p)).sum();
    // A room is done in the first of its stays.
    let stays = to_do.iter().filter_map(|p| Some((rooms.iter().position(|room| room == p)?, *p)));
    let (works, work_s) = stays.fold((0, 0.0), |(works, s), (slot, p)| (works + 1, s + task.cost(slot, p)));
    let undone = to_do.len() - works;
    Some(Plan { partitions: rooms, shared_s: total, work_s, works, undone })
}

struct Task<'a> {
    shared_s: &'a [f64],
    partitions: usize,
    /// The partition of least cost per slot.
    cheapest: &'a [usize],
    to_do: &'a [usize],
    /// Price per partition left undone, in seconds.
    weights_s: &'a [f64],
    tie_s: f64,
    empty_s: f64,
    later_share: f64,
}

impl Task<'_> {
    fn cost(&self, slot: usize, partition: usize) -> f64 {
        self.shared_s[slot * self.partitions + partition]
    }

    /// The cost of a room minus the cost of the slot's cheapest room.
    fn extra(&self, slot: usize, partition: usize) -> f64 {
        self.cost(slot, partition) - self.cost(slot, self.cheapest[slot])
    }

    fn is_empty(&self, partition: usize) -> bool {
        self.empty_s > 0.0 && self.cost(0, partition) <= self.empty_s
    }

    fn dynamic_program(&self) -> Vec<usize> {
        let slots = self.cheapest.len();
        let sets = 1usize << self.to_do.len();
        // Value of the best continuation per set of rooms to do, computed backwards from the last slot.
        let price_s = |set: usize| {
            let left = self.to_do.iter().enumerate().filter(|(bit, _)| set & (1 << bit) != 0);
            left.map(|(_, p)| self.weights_s[*p]).sum()
        };
        let mut after: Vec<f64> = (0..sets).map(price_s).collect();
        let mut choices = vec![0u32; slots * sets];
        for slot in (1..slots).rev() {
            let mut before = vec![0.0; sets];
            for set in 0..sets {
                let (value, choice) = self.best(slot, set, &after, TIE_S);
                before[set] = value;
                choices[slot * sets + set] = choice as u32;
            }
            after = before;
        }
        let mut set = sets - 1;
        // Forecasts change, but finished work stays finished. So work that is nearly free is done now, and of equal plans the cheapest now wins.
        let (least, choice) = self.best(0, set, &after, self.tie_s);
        let is_worth_it = self.works(0, set, &after).any(|(value, _)| value <= least + TIE_S);
        let weighed = |(value, partition): (f64, usize)| {
            let now_s = self.cost(0, partition);
            now_s + self.later_share * (value - now_s)
        };
        let least = self.works(0, set, &after).map(weighed).fold(f64::INFINITY, f64::min);
        let equal = self.works(0, set, &after).filter(|work| is_worth_it && weighed(*work) <= least + TIE_S);
        let now = equal.map(|work| work.1).min_by(|a, b| self.cost(0, *a).total_cmp(&self.cost(0, *b)));
        let empty = self.works(0, set, &after).filter(|(_, partition)| self.is_empty(*partition));
        let empty = empty.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, partition)| partition);
        let waits = !self.to_do.contains(&choice);
        choices[set] = now.or(empty.filter(|_| waits)).unwrap_or(choice) as u32;
        (0..slots)
            .map(|slot| {
                let partition = choices[slot * sets + set] as usize;
                if let Some(bit) = self.to_do.iter().position(|p| *p == partition) {
                    set &= !(1 << bit);
                }
                partition
            })
            .collect()
    }

    /// The rooms of a set, with their cost in a slot plus the cost of the best continuation.
    fn works<'b>(&'b self, slot: usize, set: usize, after: &'b [f64]) -> impl Iterator<Item = (f64, usize)> + 'b {
        let of_set = self.to_do.iter().enumerate().filter(move |(bit, _)| set & (1 << bit) != 0);
        of_set.map(move |(bit, partition)| (self.cost(slot, *partition) + after[set & !(1 << bit)], *partition))
    }

    /// Least value and its room. Work is preferred if it costs at most `tie_s` more.
    fn best(&self, slot: usize, set: usize, after: &[f64], tie_s: f64) -> (f64, usize) {
        let idle = (self.cost(slot, self.cheapest[slot]) + after[set], self.cheapest[slot]);
        let work = self.works(slot, set, after).min_by(|a, b| a.0.total_cmp(&b.0));
        work.filter(|work| work.0 <= idle.0 + tie_s).unwrap_or(idle)
    }

    fn by_regret(&self) -> Vec<usize> {
        let slots = self.cheapest.len();
        let mut slot_of: Vec<Option<usize>> = vec![None; self.partitions];
        let mut free = vec![true; slots];
        // The best free slot of a room, unless leaving it undone is cheaper.
        let best = |p: usize, free: &[bool]| {
            let slot =
                (0..slots).filter(|s| free[*s]).min_by(|a, b| self.extra(*a, p).total_cmp(&self.extra(*b, p)))?;
            let extra = self.extra(slot, p);
            (extra <= self.weights_s[p]).then_some((extra, slot, p))
        };
        let mut left: Vec<_> = self.to_do.iter().filter_map(|p| best(*p, &free)).collect();
        // If there are more rooms than slots, the rooms with the least gain stay undone.
        let gain_s = |(extra_s, _, p): &(f64, usize, usize)| self.weights_s[*p] - extra_s;
        left.sort_by(|a, b| gain_s(b).total_cmp(&gain_s(a)).then(a.0.total_cmp(&b.0)));
        left.truncate(slots);
        while let Some((_, slot, p)) = left.iter().copied().max_by(|a, b| a.0.total_cmp(&b.0)) {
            (slot_of[p], free[slot]) = (Some(slot), false);
            left = left.iter().filter(|other| other.2 != p).filter_map(|other| best(other.2, &free)).collect();
        }
        if free.first() == Some(&true) {
            let more = |p: usize| self.extra(0, p) - slot_of[p].map_or(self.weights_s[p], |slot| self.extra(slot, p));
            let as_good = self.to_do.iter().copied().filter(|p| more(*p) <= self.tie_s || self.is_empty(*p));
            if let Some(now) = as_good.min_by(|a, b| self.cost(0, *a).total_cmp(&self.cost(0, *b))) {
                // The room may have had a later slot.
                if let Some(slot) = slot_of[now].replace(0) {
                    free[slot] = true;
                }
                free[0] = false;
            }
        }
        if let Some(first) = slot_of.iter().position(|slot| *slot == Some(0)) {
            self.swap_first(first, &mut slot_of, &free);
        }
        let mut rooms = self.cheapest.to_vec();
        slot_of.iter().enumerate().filter_map(|(p, slot)| Some((p, (*slot)?))).for_each(|(p, slot)| rooms[slot] = p);
        rooms
    }

    /// Replaces `first` in the first slot if another room costs less with later slots discounted. `first` then takes the other room's slot or a free
    /// one, or stays undone.
    fn swap_first(&self, first: usize, slot_of: &mut [Option<usize>], free: &[bool]) {
        let now_s = |p: usize| self.extra(0, p);
        let later_s = |p: usize, slot: Option<usize>| slot.map_or(self.weights_s[p], |slot| self.extra(slot, p));
        let swapped = |p: usize| {
            let slots = (0..free.len()).filter(|slot| free[*slot] || slot_of[p] == Some(*slot));
            let slot = slots.min_by(|a, b| self.extra(*a, first).total_cmp(&self.extra(*b, first)));
            let slot = slot.filter(|slot| self.extra(*slot, first) <= self.weights_s[first]);
            // Compared with the current plan, which has `first` in the first slot.
            let more_s = later_s(first, slot) - later_s(p, slot_of[p]);
            (now_s(p) - now_s(first) + self.later_share * more_s, p, slot)
        };
        let others = self.to_do.iter().copied().filter(|p| *p != first).map(swapped);
        let best = others.min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((_, p, slot)) = best.filter(|(more_s, ..)| *more_s < -TIE_S) {
            (slot_of[p], slot_of[first]) = (Some(0), slot);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Reference by definition: tries every sequence of rooms.
    fn brute_force(shared_s: &[f64], covered: &[bool], weight_s: f64) -> f64 {
        let partitions = covered.len();
        let slots = shared_s.len() / partitions;
        let mut best = f64::INFINITY;
        for code in 0..partitions.pow(slots as u32) {
            let mut done = covered.to_vec();
            let (mut code, mut cost) = (code, 0.0);
            for slot in 0..slots {
                let partition = code % partitions;
                code /= partitions;
                done[partition] = true;
                cost += shared_s[slot * partitions + partition];
            }
            best = best.min(cost + done.iter().filter(|d| !**d).count() as f64 * weight_s);
        }
        best
    }

    fn value(plan: &Plan, weight_s: f64) -> f64 {
        plan.shared_s + plan.undone as f64 * weight_s
    }

    fn choose(covered: &[bool], shared_s: &[f64], room_time_s: f64, weight_s: Option<f64>) -> Choice {
        let state = RobotState { covered, room_time_s, expected_shared_s: shared_s, ..RobotState::default() };
        let scores = vec![0.5; covered.len()];
        CoverageAware::new(weight_s).choose(&state, &scores, &mut ChaCha8Rng::seed_from_u64(1)).unwrap()
    }

    fn home(
        partitions: std::ops::Range<usize>,
        slots: std::ops::Range<usize>,
    ) -> impl Strategy<Value = (Vec<bool>, Vec<f64>)> {
        (partitions, slots).prop_flat_map(|(partitions, slots)| {
            let cost = prop_oneof![Just(0.0), 0.0..10.0f64];
            (prop::collection::vec(any::<bool>(), partitions), prop::collection::vec(cost, partitions * slots))
        })
    }

    /// With one slot for two equally occupied rooms, the room with the higher price is done. If neither is worth its price, neither is done.
    #[test]
    fn of_rooms_that_are_alike_the_overdue_one_is_done() {
        let shared_s = [20.0, 20.0, 5.0];
        let chosen = |weights: &[f64], shared_s: &[f64]| {
            let state = RobotState {
                covered: &[false, false, true],
                room_time_s: 100.0,
                expected_shared_s: shared_s,
                weights,
                ..RobotState::default()
            };
            let choice = CoverageAware::new(None).choose(&state, &[0.5; 3], &mut ChaCha8Rng::seed_from_u64(1)).unwrap();
            choice.partition.0
        };
        assert_eq!([chosen(&[1.0, 3.0, 1.0], &shared_s), chosen(&[3.0, 1.0, 1.0], &shared_s)], [1, 0]);
        // At the usual price of 42 s the robot waits. An overdue room is worth meeting the person.
        let busy_s = [60.0, 60.0, 5.0];
        assert_eq!([chosen(&[], &busy_s), chosen(&[1.0, 2.0, 1.0], &busy_s)], [2, 1]);
    }

    proptest! {
        #[test]
        fn the_dynamic_program_finds_the_least_of_all_plans(
            (covered, shared_s) in home(1..5, 1..6), weight_s in 0.0..30.0f64,
        ) {
            let plan = plan(&shared_s, &covered, weight_s, 0.0).unwrap();
            prop_assert!((value(&plan, weight_s) - brute_force(&shared_s, &covered, weight_s)).abs() < 1e-4);
        }

        /// Free work is never postponed for a finished room, whatever the later forecast. It is postponed only for work in another room, and only if
        /// the whole plan gains.
        #[test]
        fn work_that_is_free_now_is_done_now(
            (mut covered, mut shared_s) in home(1..5, 1..6), free in any::<prop::sample::Index>(),
            weight_s in prop::option::of(0.0..30.0f64),
        ) {
            let free = free.index(covered.len());
            (covered[free], shared_s[free]) = (false, 0.0);
            let slot_s: f64 = shared_s[..covered.len()].iter().sum();
            let chosen = choose(&covered, &shared_s, 10.0, weight_s).partition.0 as usize;
            prop_assert!(!covered[chosen], "{chosen} is done");
            let weight_s = weight_s.unwrap_or(WEIGHT_DEFAULT_S.max(WEIGHT_DEFAULT_SLOTS * slot_s));
            let with_first = |room: usize| {
                let mut done = covered.clone();
                done[room] = true;
                shared_s[room] + if shared_s.len() == done.len() {
                    done.iter().filter(|d| !**d).count() as f64 * weight_s
                } else {
                    brute_force(&shared_s[done.len()..], &done, weight_s)
                }
            };
            prop_assert!(
                shared_s[chosen] <= 1e-9 || with_first(chosen) < with_first(free),
                "room {chosen} for {} s, and {free} is free", shared_s[chosen]
            );
        }

        #[test]
        fn work_that_is_free_now_is_done_now_in_large_homes_too(
            (mut covered, mut shared_s) in home(13..24, 1..30), free in any::<prop::sample::Index>(),
        ) {
            let free = free.index(covered.len());
            (covered[free], shared_s[free]) = (false, 0.0);
            let chosen = choose(&covered, &shared_s, 10.0, None).partition.0 as usize;
            prop_assert!(!covered[chosen], "{chosen} is done");
        }

        /// If the plan starts with the emptier room, its extra cost over the cheapest plan is at most the cost saved now. Without a spare slot it is
        /// the cheapest plan.
        #[test]
        fn the_emptier_room_costs_no_more_than_it_spares_now(
            (covered, shared_s) in home(1..5, 1..6), weight_s in 0.0..30.0f64,
        ) {
            let free = |later_share| Free { tie_s: 0.0, empty_s: 0.0, later_share };
            let least = plan_free(&shared_s, &covered, &vec![weight_s; covered.len()], free(1.0)).unwrap();
            let emptier = plan_free(&shared_s, &covered, &vec![weight_s; covered.len()], free(LATER_SHARE)).unwrap();
            let spared_s = shared_s[least.partitions[0]] - shared_s[emptier.partitions[0]];
            let more_s = value(&emptier, weight_s) - value(&least, weight_s);
            prop_assert!((-1e-4..=spared_s + 1e-4).contains(&more_s), "{more_s} s more, {spared_s} s spared");
            let to_do = covered.iter().filter(|done| !**done).count();
            prop_assert!(shared_s.len() / covered.len() > to_do || more_s < 1e-4, "{more_s} s more");
        }

        #[test]
        fn the_heuristic_covers_and_costs_no_less_than_the_optimum(
            shared_s in prop::collection::vec(0.0..10.0f64, 6 * 8),
        ) {
            let cheapest: Vec<usize> = shared_s.chunks(6)
                .map(|c| (0..6).min_by(|a, b| c[*a].total_cmp(&c[*b])).unwrap()).collect();
            let task = Task {
                shared_s: &shared_s, partitions: 6, cheapest: &cheapest, to_do: &[0, 1, 2, 3, 4, 5], weights_s: &[1e9; 6], tie_s: TIE_S,
                empty_s: 0.0, later_share: 1.0,
            };
            let rooms = task.by_regret();
            prop_assert!((0..6).all(|p| rooms.contains(&p)));
            let cost: f64 = rooms.iter().enumerate().map(|(s, p)| shared_s[s * 6 + p]).sum();
            prop_assert!(cost >= plan(&shared_s, &[false; 6], 1e9, 0.0).unwrap().shared_s - 1e-4);
        }
    }

    #[test]
    fn of_equal_plans_the_one_that_works_now_wins() {
        assert_eq!(plan(&[1.0; 6], &[true, false], 100.0, 0.0).unwrap().partitions[0], 1);
        // Waiting gains little: a chance to meet the person that rounds to 0 %.
        let later = [0.0, 2.0, 0.0, 0.0, 0.0, 0.0];
        let dear = Some(WEIGHT_DEFAULT_S);
        assert_eq!(choose(&[true, false], &later, 600.0, dear).partition.0, 1);
        assert_eq!(choose(&[true, false], &later, 60.0, dear).partition.0, 0);
        // By default a room that is probably empty is done now: at 3 % of a minute, not at 6 %.
        assert_eq!(choose(&[true, false], &later, 60.0, None).partition.0, 1);
        assert_eq!(choose(&[true, false], &later, 33.0, None).partition.0, 0);
        let large: Vec<f64> = (0..20 * 30).map(|index| if index == 19 { 2.0 } else { 0.0 }).collect();
        let covered: Vec<bool> = (0..20).map(|room| room < 19).collect();
        assert_eq!([60.0, 33.0].map(|stay_s| choose(&covered, &large, stay_s, None).partition.0), [19, 0]);
    }

    /// A forecast with spare slots: `now` for the first slot, then `later` for `slots` slots. Values are shares of a stay.
    fn flat(now: &[f64], later: &[f64], slots: usize, stay_s: f64) -> Vec<f64> {
        let rest = std::iter::repeat_n(later, slots - 1).flatten();
        now.iter().chain(rest).map(|share| share * stay_s).collect()
    }

    /// A case from a real household: the bedroom has 51 % now because of the nights and will not become emptier; the living room has a person who
    /// watches television.
    #[test]
    fn of_the_rooms_to_do_the_emptiest_comes_first() {
        // Kitchen, bathroom, hallway, bedroom, office, living room: in the morning, forecast for ten minutes ahead.
        let now = [0.45, 0.40, 0.10, 0.51, 0.10, 0.19];
        for bedroom in [0.52, 0.55, 0.65, 0.75, 0.96] {
            let shared_s = flat(&now, &[0.15, 0.13, 0.10, bedroom, 0.10, 0.19], 96, 600.0);
            let chosen = choose(&[false; 6], &shared_s, 600.0, None);
            assert!([2, 4].contains(&chosen.partition.0), "bedroom {bedroom}: {chosen:?}");
        }
        // The living room with Ben, and five empty rooms.
        let now = [0.05, 0.07, 0.03, 0.09, 0.11, 0.41];
        for living in [0.42, 0.45, 0.6, 1.0] {
            let later = [0.05, 0.07, 0.03, 0.09, 0.11, living];
            let shared_s = flat(&now, &later, 144, 100.0);
            let chosen = choose(&[false; 6], &shared_s, 100.0, None);
            assert_eq!(chosen.partition.0, 2, "living room {living}: {chosen:?}");
            // The same with more rooms than the dynamic program allows. More people are present, so the price is higher.
            let more = |rooms: &[f64]| [rooms, &[0.12; 10]].concat();
            let shared_s = flat(&more(&now), &more(&later), 144, 100.0);
            let chosen = choose(&[false; 16], &shared_s, 100.0, None);
            assert!(living > 0.6 || chosen.partition.0 == 2, "living room {living}: {chosen:?}");
        }
    }

    #[test]
    fn a_room_that_will_be_taken_comes_first_where_that_saves_twice_what_it_costs_now() {
        let first = |now: &[f64], later: &[f64], slots: usize| {
            choose(&[false; 2], &flat(now, later, slots, 100.0), 100.0, None).partition.0
        };
        // A person goes to bed: 5 % now, 90 % for the night.
        assert_eq!(first(&[0.05, 0.03], &[0.90, 0.03], 40), 0);
        // Two slots for two rooms: no discount. With a spare slot there will be a newer forecast first.
        assert_eq!(first(&[0.50, 0.10], &[0.70, 0.10], 2), 0);
        assert_eq!(first(&[0.50, 0.10], &[0.70, 0.10], 3), 1);
    }

    /// While the robot waits, it is docked: persons in its room are not disturbed by this plan.
    #[test]
    fn only_the_seconds_of_its_work_are_said() {
        let alike = vec![100.0; 144 * 6];
        let said = |covered: &[bool]| choose(covered, &alike, 600.0, None).reason;
        let whole = said(&[false; 6]);
        assert!(whole.ends_with("works here; plan: 6 rooms left, about 10 min near people"), "{whole}");
        let one = said(&[true, true, false, true, true, true]);
        assert!(one.ends_with("; plan: 1 room left, about 2 min near people"), "{one}");
        let none = said(&[true; 6]);
        assert!(none.ends_with("least likely to meet somebody"), "{none}");
    }

    #[test]
    fn a_room_that_is_too_dear_keeps_no_other_from_being_done() {
        // A person sleeps in room 0; the other rooms are improbable, not impossible.
        let slots: Vec<f64> = [[570.0, 8.0, 10.0, 12.0]; 6].concat();
        let plan = plan(&slots, &[false, true, false, false], 240.0, 6.0).unwrap();
        assert_eq!((plan.undone, plan.partitions[0]), (1, 2));
        let many: Vec<f64> = (0..30 * 20).map(|index| if index % 20 == 0 { 570.0 } else { 8.0 }).collect();
        assert_eq!(super::plan(&many, &[false; 20], 240.0, 6.0).unwrap().undone, 1);
    }

    #[test]
    fn what_does_not_fit_is_said() {
        let plan = plan(&[5.0, 1.0, 3.0], &[false; 3], f64::INFINITY, 0.0).unwrap();
        assert_eq!((plan.partitions, plan.undone), (vec![1], 2));
        let few = choose(&[false; 3], &[5.0, 1.0, 3.0], 600.0, None);
        assert!(
            few.reason.ends_with("plan: 1 of 3 rooms, about 1 s near people; there is no time for 2 rooms"),
            "{}",
            few.reason
        );
        // Two of three rooms fit into the time, and the better of the other two is too expensive.
        let both = choose(&[false; 3], &[0.0, 500.0, 500.0, 0.0, 500.0, 500.0], 600.0, None);
        let left = "; there is no time for 1 room; 1 room would take more than 400 s near people";
        assert!(both.reason.ends_with(left), "{}", both.reason);
        let dear = choose(&[false, true, false], &[590.0, 10.0, 590.0], 600.0, Some(240.0));
        let left = "; there is no time for 1 room; 1 room would take more than 240 s near people";
        assert!(dear.reason.ends_with(left), "{}", dear.reason);
        let dear = choose(&[false, true], &[590.0, 10.0], 600.0, None);
        assert!(dear.reason.starts_with("waits in a room that is done"), "{}", dear.reason);
        let left = "waits in a room that is done; 1 room would take more than 240 s near people";
        assert!(dear.reason.ends_with(left), "{}", dear.reason);
    }

    #[test]
    fn a_closed_room_is_planned_around_and_keeps_its_people_in_the_price() {
        // A person is in room 0. Room 1 costs 120 s: less than the price of 240 s.
        let (covered, closed, shared_s) = ([false, false, true], [true, false, false], [480.0, 120.0, 0.0]);
        let state = RobotState {
            covered: &covered,
            closed: &closed,
            room_time_s: 600.0,
            expected_shared_s: &shared_s,
            ..RobotState::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let choice = CoverageAware::new(None).choose(&state, &[0.5; 3], &mut rng).unwrap();
        assert_eq!(
            (choice.partition.0, choice.reason.ends_with("plan: 1 open room left, about 2 min near people")),
            (1, true),
            "{}",
            choice.reason
        );
        let only_done = RobotState { closed: &[true, true, false], ..state };
        assert_eq!(CoverageAware::new(None).choose(&only_done, &[0.5; 3], &mut rng).unwrap().partition.0, 2);
    }

    #[test]
    fn many_rooms_fall_back_to_the_heuristic() {
        let shared_s = vec![1.0; 40 * 50];
        let whole = plan(&shared_s, &[false; 40], 1e9, 0.0).unwrap();
        assert_eq!((whole.undone, whole.partitions.len()), (0, 50));
        assert_eq!(plan(&shared_s[..40 * 30], &[false; 40], 1e9, 0.0).unwrap().undone, 10);
    }

    #[test]
    fn no_slot_no_plan() {
        assert_eq!(plan(&[], &[false], 1.0, 0.0), None);
        assert_eq!(plan(&[], &[], 1.0, 0.0), None);
    }
}
