//! The clairvoyant optimum: the least disturbance of a robot that knows the person's whole timeline.
//!
//! It is computed by dynamic programming over (slot, set of rooms still to do). With the feature `solver` the paper's mixed-integer program
//! (`mixed_integer.rs`) checks it.

use roomcast_core::policy::plan;

use super::world::Cost;

/// The optimum of a robot that begins in one room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Optimum {
    /// Least D_T with every room done; `None` if there are too few slots.
    pub covering_s: Option<f64>,
    /// Least D_T without that condition.
    pub free_s: f64,
}

/// The optimum for each room in which the robot may begin, by dynamic programming.
#[must_use]
pub fn by_dynamic_program(cost: &Cost, room_time_s: usize) -> Vec<Optimum> {
    let (rooms, slots) = (cost.rooms(), cost.slots(room_time_s));
    let whole = cost.steps() / room_time_s;
    let last_s = cheapest_after(&slots, rooms, whole);
    (0..rooms)
        .map(|start| {
            let mut covered = vec![false; rooms];
            covered[start] = true;
            let begin_s = slots[start];
            let left = &slots[rooms.min(slots.len())..(whole * rooms).max(rooms).min(slots.len())];
            let total = |weight_s| {
                plan(left, &covered, weight_s, 0.0).map_or((0.0, rooms == 1), |plan| (plan.shared_s, plan.undone == 0))
            };
            // Higher than the cost of any plan, so that every room that can be covered is covered.
            let (covering_s, covers) = total(1e12);
            let (free_s, _) = total(0.0);
            Optimum { covering_s: covers.then_some(begin_s + covering_s + last_s), free_s: begin_s + free_s + last_s }
        })
        .collect()
}

/// The least cost of the slot that the horizon cuts short, if there is one.
fn cheapest_after(slots: &[f64], rooms: usize, whole: usize) -> f64 {
    let last = &slots[(whole * rooms).min(slots.len())..];
    last.iter().copied().reduce(f64::min).unwrap_or(0.0)
}

/// The least mean D_T over runs at a given share of failed coverage: the front of the clairvoyant robot. Failures are spent on the runs
/// with the greatest saving. `None` if coverage is not possible that often.
#[must_use]
pub fn bound_s(optima: &[Optimum], failure_rate: f64) -> Option<f64> {
    let n = optima.len().max(1) as f64;
    let mut left = failure_rate.clamp(0.0, 1.0) * n;
    let mut total = 0.0;
    let mut savings = Vec::new();
    for optimum in optima {
        match optimum.covering_s {
            Some(covering_s) => {
                total += covering_s;
                savings.push(covering_s - optimum.free_s);
            }
            None => {
                total += optimum.free_s;
                left -= 1.0;
            }
        }
    }
    if left < -1e-9 {
        return None;
    }
    savings.sort_by(|a, b| b.total_cmp(a));
    for saving in savings {
        let share = left.clamp(0.0, 1.0);
        total -= share * saving;
        left -= share;
    }
    Some(total / n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::tests::cost_of;
    use crate::world::{Knowledge, restart_rng, run};
    use proptest::prelude::*;
    use roomcast_core::policy::{CoverageAware, PolicyName};

    /// The true cost of every slot.
    fn perfect(cost: &Cost, room_time_s: usize) -> Knowledge {
        let (slots, rooms) = (cost.slots(room_time_s), cost.rooms());
        let count = slots.len() / rooms;
        Knowledge {
            scores: vec![vec![1.0 / rooms as f64; rooms]; count],
            expected_shared_s: (0..count).map(|slot| slots[slot * rooms..].to_vec()).collect(),
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn no_policy_is_below_the_bound_and_a_perfect_forecast_reaches_it(
            at in prop::collection::vec(0usize..3, 20..200), room_time_s in 5usize..20, restart: u64,
        ) {
            let cost = cost_of(3, &at);
            let optima = by_dynamic_program(&cost, room_time_s);
            let knowledge = perfect(&cost, room_time_s);
            for name in PolicyName::ALL {
                let run = run(&cost, room_time_s, &knowledge, &mut *name.policy(), &mut restart_rng(1, restart)).unwrap();
                let optimum = optima[run.start];
                prop_assert!(run.disturbance_s >= optimum.free_s);
                if run.coverage_s.is_some() {
                    prop_assert!(optimum.covering_s.is_some_and(|bound| run.disturbance_s >= bound));
                }
            }
            let mut always = CoverageAware::clairvoyant();
            let covered = run(&cost, room_time_s, &knowledge, &mut always, &mut restart_rng(1, restart)).unwrap();
            let mut never = CoverageAware::new(Some(0.0));
            let free = run(&cost, room_time_s, &knowledge, &mut never, &mut restart_rng(1, restart)).unwrap();
            let optimum = optima[covered.start];
            prop_assert_eq!(covered.coverage_s.is_some(), optimum.covering_s.is_some());
            // If not every room can be done, the robot does as many as it can.
            prop_assert!(optimum.covering_s.is_none_or(|covering_s| covered.disturbance_s == covering_s));
            prop_assert_eq!(free.disturbance_s, optimum.free_s);
        }
    }

    #[test]
    fn failures_are_bought_where_they_save_most() {
        let optima = [
            Optimum { covering_s: Some(10.0), free_s: 4.0 },
            Optimum { covering_s: Some(8.0), free_s: 8.0 },
            Optimum { covering_s: Some(9.0), free_s: 6.0 },
        ];
        assert_eq!(bound_s(&optima, 0.0), Some(9.0));
        assert_eq!(bound_s(&optima, 1.0 / 3.0), Some(7.0));
        assert_eq!(bound_s(&optima, 1.0), Some(6.0));
        assert_eq!(bound_s(&[Optimum { covering_s: None, free_s: 1.0 }], 0.5), None);
    }
}
