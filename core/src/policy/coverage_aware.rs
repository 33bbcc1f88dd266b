use rand::Rng;

use super::{Choice, Policy, PolicyError, PolicyName, RobotState, UncoveredFirst, check, partition_id};

/// Most partitions that the dynamic program holds: 2^12 sets of rooms per slot. More are planned by the heuristic of [`plan`].
pub const DP_PARTITIONS_MAX: usize = 12;

/// Default price of ending without having been in every room, in seconds of disturbance: rooms are left undone only where
/// covering them would mean sharing one for most of a minute. Chosen on the experiments' grid and on held-out activities, where it
/// disturbs less than informed avoidance and fails no more often than chance (docs/experiments.md).
pub const WEIGHT_DEFAULT_S: f64 = 42.0;

/// The default price is no less than this share of the time that people are expected to be about in one slot: where the
/// robot works for a quarter of an hour in each room, a minute is no price.
pub const WEIGHT_DEFAULT_SLOTS: f64 = 0.4;

/// Differences of less than this many seconds are ties.
const TIE_S: f64 = 1e-9;

/// The project's own policy: plans the rooms of all slots left against the forecast and takes the first, and plans anew at
/// every decision.
///
/// The plan minimises the expected time shared with the person plus `weight_s` if any room stays undone. Without a
/// forecast or a horizon it does as [`UncoveredFirst`].
#[derive(Debug, Clone, Copy)]
pub struct CoverageAware {
    weight_s: Option<f64>,
}

impl CoverageAware {
    /// `weight_s`: how many seconds of disturbance a failed coverage is worth. 0 only avoids the person; infinite always
    /// covers when it can; `None` (or no number) is [`WEIGHT_DEFAULT_S`], or [`WEIGHT_DEFAULT_SLOTS`] if that is more.
    #[must_use]
    pub fn new(weight_s: Option<f64>) -> Self {
        Self { weight_s: weight_s.filter(|weight_s| !weight_s.is_nan()).map(|weight_s| weight_s.max(0.0)) }
    }

    fn weight_s(self, state: &RobotState<'_>) -> f64 {
        self.weight_s.unwrap_or_else(|| {
            let slot_s: f64 = state.expected_shared_s.iter().take(state.covered.len()).sum();
            WEIGHT_DEFAULT_S.max(WEIGHT_DEFAULT_SLOTS * slot_s)
        })
    }
}

impl Policy for CoverageAware {
    fn name(&self) -> PolicyName {
        PolicyName::CoverageAware
    }

    fn choose(&mut self, state: &RobotState<'_>, scores: &[f64], rng: &mut dyn Rng) -> Result<Choice, PolicyError> {
        check(state, scores)?;
        let Some(plan) = plan(state.expected_shared_s, state.covered, self.weight_s(state)) else {
            return UncoveredFirst.choose(state, scores, rng);
        };
        let partition = plan.partitions.first().copied().ok_or(PolicyError::NoPartitions)?;
        // Keep the generator in step with the policies that draw.
        let _: f64 = rand::RngExt::random(rng);
        let slots = plan.partitions.len();
        let covers = if plan.covers { "every room done" } else { "some room left undone" };
        Ok(Choice {
            partition: partition_id(partition),
            reason: format!("first of {slots} slots planned, {:.0} s of disturbance expected, {covers}", plan.shared_s),
        })
    }
}

/// A room for every slot left.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Partition per slot.
    pub partitions: Vec<usize>,
    /// Time shared with the person over all slots, as forecast, in seconds.
    pub shared_s: f64,
    /// Every partition is done at the end.
    pub covers: bool,
}

/// The plan of least `shared_s` plus `weight_s` if it leaves a room undone.
///
/// `shared_s` holds slots times partitions (`covered.len()`), slot by slot. Exact up to [`DP_PARTITIONS_MAX`] partitions
/// still to do, by dynamic programming over (slot, set of rooms still to do), where a step either goes to one of the rooms
/// to do or to the cheapest room of the slot. Beyond it, a heuristic: the room to do whose best free slot costs the most
/// over staying in the slot's cheapest room is placed first. `None` when there is no slot or no partition.
#[must_use]
pub fn plan(shared_s: &[f64], covered: &[bool], weight_s: f64) -> Option<Plan> {
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
    let rooms = if to_do.len() <= DP_PARTITIONS_MAX {
        dynamic_program(shared_s, partitions, &cheapest, &to_do, weight_s)
    } else {
        by_regret(shared_s, partitions, &cheapest, &to_do, weight_s)
    };
    let total = rooms.iter().enumerate().map(|(slot, p)| shared_s[slot * partitions + p]).sum();
    let covers = to_do.iter().all(|p| rooms.contains(p));
    Some(Plan { partitions: rooms, shared_s: total, covers })
}

fn dynamic_program(
    shared_s: &[f64],
    partitions: usize,
    cheapest: &[usize],
    to_do: &[usize],
    weight_s: f64,
) -> Vec<usize> {
    let slots = cheapest.len();
    let sets = 1usize << to_do.len();
    // Value of the best continuation per set of rooms still to do, after the slot in hand; backwards from the end.
    let mut after: Vec<f64> = (0..sets).map(|set| if set == 0 { 0.0 } else { weight_s }).collect();
    let mut choices = vec![0u32; slots * sets];
    for slot in (0..slots).rev() {
        let costs = &shared_s[slot * partitions..][..partitions];
        let mut before = vec![0.0; sets];
        for set in 0..sets {
            let (mut best, mut choice) = (f64::INFINITY, cheapest[slot]);
            for (bit, partition) in to_do.iter().enumerate() {
                if set & (1 << bit) != 0 {
                    let value = costs[*partition] + after[set & !(1 << bit)];
                    if value < best {
                        (best, choice) = (value, *partition);
                    }
                }
            }
            // Of equal plans the one that does a room now wins: forecasts change, work done stays done.
            let idle = costs[cheapest[slot]] + after[set];
            if idle < best - TIE_S || best == f64::INFINITY {
                (best, choice) = (idle, cheapest[slot]);
            }
            before[set] = best;
            choices[slot * sets + set] = choice as u32;
        }
        after = before;
    }
    let mut set = sets - 1;
    (0..slots)
        .map(|slot| {
            let partition = choices[slot * sets + set] as usize;
            if let Some(bit) = to_do.iter().position(|p| *p == partition) {
                set &= !(1 << bit);
            }
            partition
        })
        .collect()
}

fn by_regret(shared_s: &[f64], partitions: usize, cheapest: &[usize], to_do: &[usize], weight_s: f64) -> Vec<usize> {
    let mut rooms = cheapest.to_vec();
    if to_do.len() > cheapest.len() {
        return rooms;
    }
    let extra = |slot: usize, p: usize| shared_s[slot * partitions + p] - shared_s[slot * partitions + cheapest[slot]];
    let mut free = vec![true; cheapest.len()];
    let mut left = to_do.to_vec();
    let mut price = 0.0;
    while !left.is_empty() {
        let placed = left
            .iter()
            .enumerate()
            .filter_map(|(index, p)| {
                let slot =
                    (0..free.len()).filter(|s| free[*s]).min_by(|a, b| extra(*a, *p).total_cmp(&extra(*b, *p)))?;
                Some((index, slot, extra(slot, *p)))
            })
            .max_by(|a, b| a.2.total_cmp(&b.2));
        let Some((index, slot, cost)) = placed else { break };
        rooms[slot] = left.swap_remove(index);
        free[slot] = false;
        price += cost;
    }
    if price > weight_s { cheapest.to_vec() } else { rooms }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition itself: every sequence of rooms.
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
            best = best.min(cost + if done.iter().all(|d| *d) { 0.0 } else { weight_s });
        }
        best
    }

    fn value(plan: &Plan, weight_s: f64) -> f64 {
        plan.shared_s + if plan.covers { 0.0 } else { weight_s }
    }

    proptest! {
        #[test]
        fn the_dynamic_program_finds_the_least_of_all_plans(
            (covered, shared_s) in (1usize..5, 1usize..6).prop_flat_map(|(partitions, slots)| (
                prop::collection::vec(any::<bool>(), partitions),
                prop::collection::vec(0.0..10.0f64, partitions * slots),
            )),
            weight_s in 0.0..30.0f64,
        ) {
            let plan = plan(&shared_s, &covered, weight_s).unwrap();
            prop_assert!((value(&plan, weight_s) - brute_force(&shared_s, &covered, weight_s)).abs() < 1e-9);
        }

        #[test]
        fn the_heuristic_covers_and_costs_no_less_than_the_optimum(
            shared_s in prop::collection::vec(0.0..10.0f64, 6 * 8),
        ) {
            let cheapest: Vec<usize> = shared_s.chunks(6)
                .map(|c| (0..6).min_by(|a, b| c[*a].total_cmp(&c[*b])).unwrap()).collect();
            let rooms = by_regret(&shared_s, 6, &cheapest, &[0, 1, 2, 3, 4, 5], 1e9);
            prop_assert!((0..6).all(|p| rooms.contains(&p)));
            let cost: f64 = rooms.iter().enumerate().map(|(s, p)| shared_s[s * 6 + p]).sum();
            prop_assert!(cost >= plan(&shared_s, &[false; 6], 1e9).unwrap().shared_s - 1e-9);
        }
    }

    #[test]
    fn of_equal_plans_the_one_that_works_now_wins() {
        assert_eq!(plan(&[1.0; 6], &[true, false], 100.0).unwrap().partitions[0], 1);
    }

    #[test]
    fn what_cannot_be_covered_is_not_paid_for() {
        let plan = plan(&[5.0, 1.0, 3.0], &[false; 3], f64::INFINITY).unwrap();
        assert_eq!((plan.partitions, plan.covers), (vec![1], false));
    }

    #[test]
    fn many_rooms_fall_back_to_the_heuristic() {
        let shared_s = vec![1.0; 40 * 50];
        let plan = plan(&shared_s, &[false; 40], 1e9).unwrap();
        assert!(plan.covers);
        assert_eq!(plan.partitions.len(), 50);
    }

    #[test]
    fn no_slot_no_plan() {
        assert_eq!(plan(&[], &[false], 1.0), None);
        assert_eq!(plan(&[], &[], 1.0), None);
    }
}
