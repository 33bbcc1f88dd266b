//! A robot cleans the simulated homes by a belief, and counts the minutes with somebody in its room.
//!
//! The robot has the planner's policy and leaves a room as the planner does. It sets off no sensor.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{Believer, Mean};
use crate::home_simulation::DAY_S;
use roomcast_core::policy::{CoverageAware, Policy, RobotState};
use roomcast_services::config::PlannerConfig;

const STAY_S: usize = 600;
/// Stays of a round for each room.
const STAYS: usize = 2;
/// The robot works between these hours.
const HOURS: std::ops::Range<usize> = 8..20;

/// Minutes of work with somebody in the robot's room, and rooms that were done at the end of their round.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Work {
    pub(super) beside: Mean,
    pub(super) done: Mean,
}

#[derive(Debug)]
pub(super) struct Robot {
    covered: Vec<bool>,
    /// The room that the robot left for a person, until its next stay begins.
    left: Option<usize>,
    /// The room and the second in which its stay ends.
    at: Option<(usize, usize)>,
    round_ends: Option<usize>,
    /// The robot leaves a room that is occupied with this probability.
    leaves_at: f64,
    random: ChaCha8Rng,
    pub(super) work: Work,
}

impl Robot {
    pub(super) fn new(rooms: usize) -> Self {
        let (covered, random) = (vec![false; rooms], ChaCha8Rng::seed_from_u64(0));
        let leaves_at = PlannerConfig::default().interrupt_at;
        Self { covered, left: None, at: None, round_ends: None, leaves_at, random, work: Work::default() }
    }

    /// Passes a minute. `is_occupied` is the truth.
    pub(super) fn pass(&mut self, second: usize, own: &dyn Believer, is_occupied: impl Fn(usize) -> bool) {
        if !HOURS.contains(&(second % DAY_S / 3_600)) {
            // A round that the evening ends does not count.
            (self.at, self.left, self.round_ends) = (None, None, None);
            return;
        }
        match self.at {
            Some((room, _)) if own.occupied(room) >= self.leaves_at => (self.at, self.left) = (None, Some(room)),
            Some((room, ends)) if second >= ends => {
                self.covered[room] = true;
                self.at = None;
            }
            _ => {}
        }
        if self.at.is_none() {
            self.at = self.next(second, own).map(|room| (room, second + STAY_S));
        }
        if let Some((room, _)) = self.at {
            self.work.beside.add(is_occupied(room));
        }
    }

    fn next(&mut self, second: usize, own: &dyn Believer) -> Option<usize> {
        let rooms = self.covered.len();
        let is_done = self.covered.iter().all(|done| *done);
        if self.round_ends.is_some_and(|ends| is_done || second + STAY_S > ends) {
            self.covered.iter().for_each(|done| self.work.done.add(*done));
            self.round_ends = None;
        }
        let ends = *self.round_ends.get_or_insert_with(|| {
            self.covered.fill(false);
            second + STAYS * rooms * STAY_S
        });
        let slots = (ends - second) / STAY_S;
        let ahead = (0..slots).flat_map(|slot| own.ahead(((2 * slot + 1) * STAY_S / 2) as f64, rooms));
        let expected_shared_s: Vec<f64> = ahead.map(|p| p * STAY_S as f64).collect();
        let now: Vec<f64> = (0..rooms).map(|room| own.occupied(room)).collect();
        let left = self.left.take();
        let closed: Vec<bool> = (0..rooms).map(|room| left == Some(room)).collect();
        let state = RobotState {
            covered: &self.covered,
            closed: &closed,
            room_time_s: STAY_S as f64,
            expected_shared_s: &expected_shared_s,
            weights: &[],
        };
        let chosen = CoverageAware::new(None).choose(&state, &now, &mut self.random);
        // The planner pauses in front of an occupied room.
        chosen.ok().map(|choice| choice.partition.0 as usize).filter(|room| now[*room] < self.leaves_at)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Report;
    use super::*;

    const DAY_MIN: usize = 24 * 60;

    /// A fake belief: sure of one room.
    struct Sure(usize);

    impl Believer for Sure {
        fn report(&mut self, _report: &Report) {}
        fn advance(&mut self, _now_s: f64) {}
        fn place(&self, _person: usize, room: Option<usize>) -> f64 {
            f64::from(u8::from(room == Some(self.0)))
        }
        fn occupied(&self, room: usize) -> f64 {
            self.place(0, Some(room))
        }
        fn empty(&self) -> f64 {
            0.0
        }
    }

    /// The person changes the room every 20 minutes, and the belief follows `lag_min` later.
    fn work(lag_min: usize) -> Work {
        let at = |minute: usize| minute / 20 % 3;
        let mut robot = Robot::new(3);
        for minute in 0..DAY_MIN {
            let own = Sure(at((minute + DAY_MIN - lag_min) % DAY_MIN));
            robot.pass(60 * minute, &own, |room| room == at(minute));
        }
        robot.work
    }

    #[test]
    fn a_robot_that_knows_where_the_person_is_works_beside_nobody() {
        let knows = work(0);
        assert_eq!(knows.beside.sum, 0.0);
        assert!(knows.beside.count > 650.0 && knows.done.value() > 0.9, "{knows:?}");
        let is_late = work(20);
        assert!(is_late.beside.sum > 100.0, "{is_late:?}");
    }
}
