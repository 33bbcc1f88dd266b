//! The clairvoyant optimum as the paper's mixed-integer program, solved by HiGHS.

use highs::{HighsModelStatus, RowProblem, Sense};

use super::world::Cost;

/// The solver found no optimum.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SolverError {
    /// The solver gave up.
    #[error("HiGHS ended with {status} on a program of {slots} slots and {rooms} rooms")]
    Solver {
        /// Its status.
        status: String,
        /// Slots.
        slots: usize,
        /// Rooms.
        rooms: usize,
    },
    /// The program is malformed.
    #[error("HiGHS refused the program: {0}")]
    Refused(String),
}

/// The optimum as a mixed-integer program. Binary x(k, r) says that the robot spends slot k in room r. Every slot has one room, the first
/// is in the start room, and with `cover` every room has at least one whole slot. `None` if that is not possible.
///
/// # Errors
/// When the solver fails.
pub fn optimum_s(cost: &Cost, room_time_s: usize, start: usize, cover: bool) -> Result<Option<f64>, SolverError> {
    let (rooms, slots) = (cost.rooms(), cost.slots(room_time_s));
    let whole = cost.steps() / room_time_s;
    let mut problem = RowProblem::new();
    let columns: Vec<_> = slots
        .iter()
        .enumerate()
        .map(|(index, cost)| {
            let fixed = index < rooms;
            let low = f64::from(u8::from(fixed && index == start));
            let high = f64::from(u8::from(!fixed || index == start));
            problem.add_integer_column(*cost, low..=high)
        })
        .collect();
    for slot in columns.chunks(rooms) {
        problem.add_row(1.0..=1.0, slot.iter().map(|column| (*column, 1.0)));
    }
    if cover {
        for room in 0..rooms {
            let visits = columns.iter().skip(room).step_by(rooms).take(whole);
            problem.add_row(1.0.., visits.map(|column| (*column, 1.0)));
        }
    }
    let mut model =
        problem.try_optimise(Sense::Minimise).map_err(|status| SolverError::Refused(format!("{status:?}")))?;
    model.make_quiet();
    // The relaxation is nearly whole-numbered, so a search for a first solution takes longer than the program itself. The cells already run
    // in parallel. Neither option changes the optimum.
    let _faster = model.try_set_option("mip_heuristic_run_feasibility_jump", false);
    let _faster = model.try_set_option("parallel", "off");
    let solved = model.solve();
    match solved.status() {
        HighsModelStatus::Optimal => {
            let solution = solved.get_solution();
            Ok(Some(solution.columns().iter().zip(&slots).map(|(x, cost)| x.round() * cost).sum()))
        }
        HighsModelStatus::Infeasible | HighsModelStatus::UnboundedOrInfeasible => Ok(None),
        status => Err(SolverError::Solver { status: format!("{status:?}"), slots: slots.len() / rooms, rooms }),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::clairvoyant::by_dynamic_program;
    use crate::world::tests::cost_of;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn the_dynamic_program_equals_the_mixed_integer_program(
            at in prop::collection::vec(0usize..4, 20..120), room_time_s in 7usize..20,
        ) {
            let cost = cost_of(4, &at);
            for (start, optimum) in by_dynamic_program(&cost, room_time_s).iter().enumerate() {
                let covering_s = optimum_s(&cost, room_time_s, start, true).unwrap();
                let free_s = optimum_s(&cost, room_time_s, start, false).unwrap();
                prop_assert_eq!(optimum.covering_s, covering_s);
                prop_assert_eq!(Some(optimum.free_s), free_s);
            }
        }
    }
}
