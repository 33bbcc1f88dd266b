//! The robot among people: disturbance D_T, time of coverage t_c, failure F, as the paper defines them.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::timeline::Timeline;
use roomcast_core::grounding::Grounding;
use roomcast_core::policy::{Policy, PolicyError, RobotState};
use roomcast_core::semantic_map::SemanticMap;

/// A simulation cannot be run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WorldError {
    /// There are no persons.
    #[error("no person is in the simulation: give at least one activity program")]
    NoPersons,
    /// The robot cannot finish a single room.
    #[error(
        "T_r of {room_time_s} s is longer than the horizon T of {horizon_s} s: give a shorter --room-time or a longer activity"
    )]
    RoomTime {
        /// T_r.
        room_time_s: usize,
        /// T.
        horizon_s: usize,
    },
    /// T_r is zero.
    #[error("T_r must be at least 1 s")]
    NoRoomTime,
    /// There are no rooms.
    #[error("the scene has no rooms: the robot has nowhere to work")]
    NoRooms,
    /// The policy failed.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

/// The rule for when a robot disturbs a person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Disturbance {
    /// Both are in the same room: the paper's rule.
    SameRoom,
    /// They are closer than this, in metres; the robot works in the middle of its room.
    Near(f64),
    /// The person sees the robot: both are in the same room, or the line between them passes within half a metre of a door that joins their
    /// rooms.
    InSight,
}

/// The number of people that a robot disturbs in each room at each time step.
#[derive(Debug, Clone, PartialEq)]
pub struct Cost {
    rooms: usize,
    steps: usize,
    /// `before[t * rooms + r]` is the sum over the steps before t in room r; its length is (steps + 1) times rooms.
    before: Vec<f64>,
}

/// Half the width of a door, in metres.
const DOOR_M: f64 = 0.5;

impl Cost {
    /// Adds up several persons. The horizon T is the longest of their timelines. After the end of a timeline its person is away.
    ///
    /// # Errors When there are no persons or no rooms.
    pub fn new(
        persons: &[&Timeline],
        map: &SemanticMap,
        grounding: &Grounding,
        disturbance: Disturbance,
    ) -> Result<Self, WorldError> {
        let rooms = grounding.partitions().len();
        if rooms == 0 {
            return Err(WorldError::NoRooms);
        }
        let steps = persons.iter().map(|person| person.len()).max().ok_or(WorldError::NoPersons)?;
        let centre_m: Vec<[f64; 3]> = grounding
            .partitions()
            .iter()
            .map(|p| p.spaces.first().map_or([0.0; 3], |bounds| bounds.centre_m()))
            .collect();
        let mut cost = vec![0.0; rooms * steps];
        for person in persons {
            for (step, (at, position)) in person.rooms.iter().zip(&person.positions_m).enumerate() {
                for (room, centre) in centre_m.iter().enumerate() {
                    let same = at.0 as usize == room;
                    let disturbs = match disturbance {
                        Disturbance::SameRoom => same,
                        Disturbance::Near(limit_m) => {
                            (centre[0] - position[0]).hypot(centre[1] - position[1]) < limit_m
                        }
                        Disturbance::InSight => {
                            let joins = |door: &&roomcast_core::semantic_map::Door| {
                                let of = |p: usize| &grounding.partitions()[p].rooms;
                                let [a, b] = door.rooms;
                                let (here, there) = (of(room), of(at.0 as usize));
                                (here.contains(&a) && there.contains(&b)) || (here.contains(&b) && there.contains(&a))
                            };
                            let through = |door: &roomcast_core::semantic_map::Door| {
                                let [x, y, _] = door.position_m;
                                distance_to_line_m([x, y], [centre[0], centre[1]], *position) < DOOR_M
                            };
                            same || map.doors().iter().filter(joins).any(through)
                        }
                    };
                    cost[step * rooms + room] += f64::from(u8::from(disturbs));
                }
            }
        }
        Ok(Self::from_steps(rooms, &cost))
    }

    fn from_steps(rooms: usize, cost: &[f64]) -> Self {
        let mut before = vec![0.0; rooms];
        for (index, cost) in cost.iter().enumerate() {
            before.push(before[index] + cost);
        }
        Self { rooms, steps: cost.len() / rooms, before }
    }

    /// K: the number of rooms.
    #[must_use]
    pub fn rooms(&self) -> usize {
        self.rooms
    }

    /// T: the number of time steps of one second.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Disturbance by a robot in `room` from one step up to another.
    #[must_use]
    pub fn between(&self, room: usize, from: usize, to: usize) -> f64 {
        let at = |step: usize| self.before[step.min(self.steps) * self.rooms + room];
        at(to) - at(from)
    }

    /// Disturbance per slot of `room_time_s` steps and room, slot by slot. The horizon may cut the last slot short.
    #[must_use]
    pub fn slots(&self, room_time_s: usize) -> Vec<f64> {
        let starts = (0..self.steps).step_by(room_time_s.max(1));
        starts.flat_map(|from| (0..self.rooms).map(move |room| self.between(room, from, from + room_time_s))).collect()
    }

    /// The expected D_T of the naive policy: every room at every step with the same chance.
    #[must_use]
    pub fn naive_disturbance(&self) -> f64 {
        (0..self.rooms).map(|room| self.between(room, 0, self.steps)).sum::<f64>() / self.rooms as f64
    }
}

fn distance_to_line_m(point: [f64; 2], from: [f64; 2], to: [f64; 2]) -> f64 {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let length2 = dx * dx + dy * dy;
    let share = if length2 > 0.0 {
        (((point[0] - from[0]) * dx + (point[1] - from[1]) * dy) / length2).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (from[0] + share * dx - point[0]).hypot(from[1] + share * dy - point[1])
}

/// F of the naive policy in closed form: the chance that `slots` uniform draws out of `rooms` do not include all, by inclusion and
/// exclusion over the missing rooms.
#[cfg(test)]
fn naive_failure(rooms: usize, slots: usize) -> f64 {
    let mut binomial = 1.0;
    let mut covered = 0.0;
    for out in 0..=rooms {
        let sign = if out % 2 == 0 { 1.0 } else { -1.0 };
        covered += sign * binomial * (1.0 - out as f64 / rooms as f64).powi(i32::try_from(slots).unwrap_or(i32::MAX));
        binomial *= (rooms - out) as f64 / (out + 1) as f64;
    }
    (1.0 - covered).clamp(0.0, 1.0)
}

/// The robot's knowledge at the beginning of each slot. The person acts independently of the robot.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Knowledge {
    /// The room probabilities of each slot.
    pub scores: Vec<Vec<f64>>,
    /// For each slot, the expected disturbance of the slots from it on: slots left times rooms. Rows are empty without a forecast.
    pub expected_shared_s: Vec<Vec<f64>>,
}

/// One run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Run {
    /// D_T in time steps.
    pub disturbance_s: f64,
    /// t_c: the time when every room had its T_r, if that happened.
    pub coverage_s: Option<usize>,
    /// The start room.
    pub start: usize,
}

/// The robot's place from a time step until its next stay.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stay {
    /// The time step.
    pub from_s: usize,
    /// The room; `None` outside all.
    pub room: Option<usize>,
    /// Whether it works there.
    pub works: bool,
}

/// D_T and t_c of a robot with these `stays`, in their order, simulated or real. A room that the next stay or the horizon cuts short is not
/// done.
#[must_use]
pub fn tally(cost: &Cost, room_time_s: usize, stays: &[Stay]) -> (f64, Option<usize>) {
    let ends = stays.iter().skip(1).map(|next| next.from_s).chain([cost.steps]);
    let mut done_s: Vec<Option<usize>> = vec![None; cost.rooms];
    let mut disturbance_s = 0.0;
    for (stay, to_s) in stays.iter().zip(ends) {
        let Some(room) = stay.room.filter(|room| *room < cost.rooms) else { continue };
        let to_s = to_s.min(cost.steps);
        disturbance_s += cost.between(room, stay.from_s, to_s);
        if stay.works && stay.from_s + room_time_s <= to_s {
            done_s[room].get_or_insert(stay.from_s + room_time_s);
        }
    }
    (disturbance_s, done_s.into_iter().collect::<Option<Vec<_>>>().and_then(|done_s| done_s.into_iter().max()))
}

/// The generator of one restart: the same for every policy, so that runs are paired.
#[must_use]
pub fn restart_rng(seed: u64, restart: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(restart);
    rng
}

/// Runs the robot through the horizon: it begins in a random room, works T_r in it, asks its policy, and goes on. A room that the horizon
/// cuts short is not done.
///
/// # Errors
/// When T_r does not fit the horizon or the policy refuses.
pub fn run(
    cost: &Cost,
    room_time_s: usize,
    knowledge: &Knowledge,
    policy: &mut dyn Policy,
    rng: &mut ChaCha8Rng,
) -> Result<Run, WorldError> {
    check_room_time(room_time_s, cost.steps)?;
    let start = rng.random_range(0..cost.rooms);
    let mut room = start;
    let mut covered = vec![false; cost.rooms];
    let mut stays = Vec::with_capacity(cost.steps.div_ceil(room_time_s));
    let all_done = vec![true; cost.rooms];
    for (slot, from) in (0..cost.steps).step_by(room_time_s).enumerate() {
        if slot > 0 {
            let whole = from + room_time_s <= cost.steps;
            let expected = knowledge.expected_shared_s.get(slot).map_or(&[][..], Vec::as_slice);
            // A last slot that is too short for a room does not count for coverage.
            let slots = if whole { (cost.steps - from) / room_time_s } else { 1 };
            let state = RobotState {
                covered: if whole { &covered } else { &all_done },
                closed: &[],
                room_time_s: room_time_s as f64,
                expected_shared_s: &expected[..expected.len().min(slots * cost.rooms)],
                weights: &[],
            };
            let scores = knowledge.scores.get(slot).map_or(&[][..], Vec::as_slice);
            room = policy.choose(&state, scores, rng)?.partition.0 as usize;
        }
        stays.push(Stay { from_s: from, room: Some(room), works: true });
        covered[room] |= from + room_time_s <= cost.steps;
    }
    let (disturbance_s, coverage_s) = tally(cost, room_time_s, &stays);
    Ok(Run { disturbance_s, coverage_s, start })
}

/// Fails if the robot cannot do at least one room.
///
/// # Errors
/// When it cannot.
pub fn check_room_time(room_time_s: usize, horizon_s: usize) -> Result<(), WorldError> {
    match room_time_s {
        0 => Err(WorldError::NoRoomTime),
        _ if room_time_s > horizon_s => Err(WorldError::RoomTime { room_time_s, horizon_s }),
        _ => Ok(()),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;
    use roomcast_core::policy::PolicyName;

    /// The room of the person at each step.
    pub fn cost_of(rooms: usize, at: &[usize]) -> Cost {
        let mut cost = vec![0.0; rooms * at.len()];
        at.iter().enumerate().for_each(|(step, room)| cost[step * rooms + room] = 1.0);
        Cost::from_steps(rooms, &cost)
    }

    fn even(cost: &Cost, room_time_s: usize) -> Knowledge {
        let slots = cost.steps.div_ceil(room_time_s);
        Knowledge { scores: vec![vec![1.0 / cost.rooms as f64; cost.rooms]; slots], expected_shared_s: Vec::new() }
    }

    #[test]
    fn the_naive_policy_meets_its_closed_forms() {
        let at: Vec<usize> = (0..610).map(|step| step / 70 % 3).collect();
        let cost = cost_of(3, &at);
        assert!((cost.naive_disturbance() - 610.0 / 3.0).abs() < 1e-9);
        for room_time_s in [25, 50, 100] {
            let knowledge = even(&cost, room_time_s);
            let runs: Vec<Run> = (0..20_000)
                .map(|i| {
                    run(&cost, room_time_s, &knowledge, &mut *PolicyName::Naive.policy(), &mut restart_rng(5, i))
                        .unwrap()
                })
                .collect();
            let n = runs.len() as f64;
            let mean = runs.iter().map(|r| r.disturbance_s).sum::<f64>() / n;
            let variance = runs.iter().map(|r| (r.disturbance_s - mean).powi(2)).sum::<f64>() / n;
            assert!((mean - cost.naive_disturbance()).abs() < 5.0 * (variance / n).sqrt(), "{room_time_s}: {mean}");
            let failed = runs.iter().filter(|r| r.coverage_s.is_none()).count() as f64 / n;
            let expected = naive_failure(3, 610 / room_time_s);
            assert!(
                (failed - expected).abs() < 5.0 * (expected / n).sqrt() + 1e-3,
                "{room_time_s}: {failed} {expected}"
            );
        }
        // Two draws out of three rooms never cover them; three do so in 6 of 27 cases.
        assert!((naive_failure(3, 2) - 1.0).abs() < 1e-12);
        assert!((naive_failure(3, 3) - 21.0 / 27.0).abs() < 1e-12);
        assert!(naive_failure(1, 1).abs() < 1e-12);
    }

    #[test]
    fn impossible_room_times_are_named() {
        let cost = cost_of(2, &[0; 10]);
        let run = |room_time_s| {
            run(&cost, room_time_s, &even(&cost, 1), &mut *PolicyName::Naive.policy(), &mut restart_rng(1, 1))
                .unwrap_err()
                .to_string()
        };
        assert!(run(11).contains("longer than the horizon T of 10 s"));
        assert!(run(0).contains("at least 1 s"));
    }

    #[test]
    fn a_tally_counts_what_the_robot_shared_and_did() {
        let cost = cost_of(2, &[0, 0, 0, 0, 1, 1, 1, 1, 0, 0]);
        let stay = |from_s, room, works| Stay { from_s, room, works };
        let both = [stay(0, Some(1), true), stay(3, Some(0), true), stay(7, Some(1), false)];
        assert_eq!(tally(&cost, 3, &both), (2.0, Some(6)));
        // A room is not done without work, in a stay cut short, or outside all rooms.
        assert_eq!(tally(&cost, 3, &[stay(0, Some(1), false), stay(3, Some(0), true)]), (3.0, None));
        assert_eq!(tally(&cost, 3, &[stay(0, Some(1), true), stay(2, Some(0), true)]), (4.0, None));
        assert_eq!(
            tally(&cost, 3, &[stay(0, Some(1), true), stay(3, None, true), stay(8, Some(0), true)]),
            (2.0, None)
        );
        assert_eq!(tally(&cost, 3, &[]), (0.0, None));
    }

    #[test]
    fn lines_of_sight_pass_through_doors() {
        assert!(distance_to_line_m([1.0, 0.2], [0.0, 0.0], [2.0, 0.0]) < 0.21);
        assert!(distance_to_line_m([5.0, 0.0], [0.0, 0.0], [2.0, 0.0]) > 2.9);
    }

    proptest! {
        #[test]
        fn one_seed_one_run(at in prop::collection::vec(0usize..3, 30..200), room_time_s in 5usize..30, restart: u64) {
            let cost = cost_of(3, &at);
            for name in PolicyName::ALL {
                let go = || run(&cost, room_time_s, &even(&cost, room_time_s), &mut *name.policy(), &mut restart_rng(1, restart)).unwrap();
                prop_assert_eq!(go(), go());
                prop_assert!(go().disturbance_s <= at.len() as f64);
            }
        }
    }
}
