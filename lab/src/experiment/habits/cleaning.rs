//! The value of habits to a robot: rounds of all rooms, one after another, planned with the forecast without habits and with habits. Each stay is
//! decided before its outcome is learned, so no day was seen before.
//!
//! Robots use [`CoverageAware`]. One always covers if it can, so that both forecasts are compared at the same coverage. One has the default price of
//! an undone room, and one enters no room of the set. Disturbance is the time in which robot and person share a room.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::super::resampling::{ci95, drawn};
use roomcast_core::policy::{CoverageAware, Policy, RobotState};
use roomcast_simulation::trace::Trace;

/// Seconds of work in each room.
pub(crate) const STAY_S: f64 = 300.0;
/// Stays of a round for each room.
const STAYS: usize = 2;
/// Bootstrap samples of days for an interval.
const RESAMPLES: usize = 2_000;

/// The robots, each with its forecast and its policy.
const ROBOTS: [(&str, &str); 5] = [
    ("model", "always-covers"),
    ("mixture", "always-covers"),
    ("model", "coverage-aware"),
    ("mixture", "coverage-aware"),
    ("mixture", "avoids-sets"),
];
const MIXTURE: &str = "mixture";
/// Pairs of robots to compare: the second has the forecast without habits, and the same policy if there is one.
const COMPARED: [(usize, usize); 3] = [(1, 0), (3, 2), (4, 2)];

/// The forecasts for a free robot.
pub(crate) struct Sight<'a> {
    /// Per remaining stay and room, the probability that the room is occupied in the middle of the stay: without habits, and with.
    pub(crate) shipped: &'a [f64],
    pub(crate) mixture: &'a [f64],
    /// Per room, whether the set has it at any time of the first stay.
    pub(crate) set: &'a [bool],
}

#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    disturbed_s: f64,
    worked_s: f64,
    covered: f64,
    rooms: f64,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.disturbed_s += other.disturbed_s;
        self.worked_s += other.worked_s;
        self.covered += other.covered;
        self.rooms += other.rooms;
    }

    /// Seconds of disturbance per hour, and the share of done rooms.
    fn rates(&self) -> [f64; 2] {
        [3_600.0 * self.disturbed_s / self.worked_s.max(1.0), self.covered / self.rooms.max(1.0)]
    }
}

#[derive(Debug)]
struct Robot {
    mixture: bool,
    avoids_sets: bool,
    policy: CoverageAware,
    covered: Vec<bool>,
    /// The current round, which counts when it ends: a robot that defers rooms pays for them in the same round.
    round: Sums,
    days: Vec<Sums>,
}

/// All robots; every stay begins for all of them together.
#[derive(Debug)]
pub(crate) struct Cleaning {
    robots: Vec<Robot>,
    rng: ChaCha8Rng,
    rooms: usize,
    stay: usize,
    next_s: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Forecast: `mixture` with habits, `model` without.
    pub predictor: &'static str,
    pub policy: &'static str,
    /// Seconds of disturbance per hour.
    pub disturbance_s_per_h: f64,
    /// Share of rooms that were done at the ends of their rounds.
    pub coverage: f64,
    pub less: Option<Less>,
}

/// A robot's figures minus another's on the same days.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Less {
    /// Seconds of disturbance per hour.
    pub disturbance_s_per_h: f64,
    /// 95 % interval, by days; `None` if fewer than two days have a whole round.
    pub disturbance_ci95: Option<[f64; 2]>,
    pub coverage: f64,
    pub coverage_ci95: Option<[f64; 2]>,
}

impl Cleaning {
    pub(crate) fn new(rooms: usize, seed: u64) -> Self {
        let robot = |(predictor, rule): (&str, &str)| Robot {
            mixture: predictor == MIXTURE,
            avoids_sets: rule == "avoids-sets",
            policy: if rule == "always-covers" { CoverageAware::clairvoyant() } else { CoverageAware::new(None) },
            covered: vec![false; rooms],
            round: Sums::default(),
            days: Vec::new(),
        };
        let robots = ROBOTS.into_iter().map(robot).collect();
        Self { robots, rng: ChaCha8Rng::seed_from_u64(seed), rooms, stay: 0, next_s: f64::NEG_INFINITY }
    }

    /// Starts a round after unobserved time.
    pub(crate) fn begin(&mut self) {
        (self.stay, self.next_s) = (0, f64::NEG_INFINITY);
        for robot in &mut self.robots {
            robot.covered.fill(false);
            robot.round = Sums::default();
        }
    }

    /// If the next stay begins now and ends within the observed time: the number of stays left in the round.
    pub(crate) fn stays_left(&self, now_s: f64, until_s: f64) -> Option<usize> {
        (now_s >= self.next_s && now_s + STAY_S <= until_s).then_some(STAYS * self.rooms - self.stay)
    }

    pub(crate) fn stay(&mut self, (now_s, day): (f64, usize), sight: &Sight<'_>, trace: &Trace) {
        let rooms = self.rooms;
        // All robots share one draw, so that they differ only by their forecasts.
        let seed: u64 = self.rng.random();
        for robot in &mut self.robots {
            let likely = if robot.mixture { sight.mixture } else { sight.shipped };
            let expected_shared_s: Vec<f64> = likely.iter().map(|p| p * STAY_S).collect();
            let closed = if robot.avoids_sets { sight.set } else { &[] };
            let state = RobotState {
                covered: &robot.covered,
                closed,
                room_time_s: STAY_S,
                expected_shared_s: &expected_shared_s,
                weights: &[],
            };
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            // If every room is closed the robot is in no room.
            let chosen = robot.policy.choose(&state, &likely[..rooms], &mut rng).ok();
            if robot.days.len() <= day {
                robot.days.resize(day + 1, Sums::default());
            }
            let sums = &mut robot.round;
            sums.worked_s += STAY_S;
            if let Some(room) = chosen.map(|choice| choice.partition.0 as usize) {
                sums.disturbed_s += trace.time_in(room, now_s, now_s + STAY_S);
                robot.covered[room] = true;
            }
        }
        (self.stay, self.next_s) = (self.stay + 1, now_s + STAY_S);
        if self.stay == STAYS * rooms {
            self.stay = 0;
            for robot in &mut self.robots {
                let covered = robot.covered.iter().filter(|covered| **covered).count();
                let Sums { disturbed_s, worked_s, .. } = std::mem::take(&mut robot.round);
                robot.days[day].add(&Sums { disturbed_s, worked_s, covered: covered as f64, rooms: rooms as f64 });
                robot.covered.fill(false);
            }
        }
    }

    pub(crate) fn rows(&self, seed: u64) -> Vec<Row> {
        // All robots have the same rounds.
        let whole = |robot: &Robot| (0..robot.days.len()).filter(|day| robot.days[*day].rooms > 0.0).collect();
        let days: Vec<usize> = self.robots.first().map(whole).unwrap_or_default();
        let rates = |robot: usize, of: &[usize]| {
            let mut sums = Sums::default();
            of.iter().for_each(|day| sums.add(&self.robots[robot].days[*day]));
            sums.rates()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let resamples = if days.len() > 1 { RESAMPLES } else { 0 };
        let samples: Vec<Vec<usize>> = (0..resamples).map(|_| drawn(&days, &mut rng)).collect();
        let less = |own: usize, other: usize, of: &[usize]| {
            let (own, other) = (rates(own, of), rates(other, of));
            [own[0] - other[0], own[1] - other[1]]
        };
        let row = |(index, (predictor, policy)): (usize, (&'static str, &'static str))| {
            let [disturbance_s_per_h, coverage] = rates(index, &days);
            let compared = COMPARED.into_iter().find(|(own, _)| *own == index);
            let less = compared.map(|(own, other)| {
                let mut values: [Vec<f64>; 2] = Default::default();
                for sample in &samples {
                    values.iter_mut().zip(less(own, other, sample)).for_each(|(values, value)| values.push(value));
                }
                let [disturbance_ci95, coverage_ci95] = values.map(ci95);
                let [disturbance_s_per_h, coverage] = less(own, other, &days);
                Less { disturbance_s_per_h, disturbance_ci95, coverage, coverage_ci95 }
            });
            Row { predictor, policy, disturbance_s_per_h, coverage, less }
        };
        if days.is_empty() { Vec::new() } else { ROBOTS.into_iter().enumerate().map(row).collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A robot that knows the person's place does all rooms without disturbing. A robot with the opposite forecast disturbs.
    #[test]
    fn who_knows_more_disturbs_less_at_the_same_coverage() {
        // The person changes between two rooms with every stay, and a third room is always free.
        let at = |stay: usize| stay % 2;
        let mut trace = Trace::default();
        (0..60).for_each(|stay| trace.places.push((stay as f64 * STAY_S, at(stay))));
        let mut cleaning = Cleaning::new(3, 1);
        for stay in 0..60 {
            let now_s = stay as f64 * STAY_S;
            let left = cleaning.stays_left(now_s, f64::INFINITY).unwrap();
            let knows: Vec<f64> =
                (stay..stay + left).flat_map(|s| (0..3).map(move |room| f64::from(u8::from(room == at(s))))).collect();
            let even = vec![1.0 / 3.0; knows.len()];
            let set: Vec<bool> = (0..3).map(|room| room == at(stay)).collect();
            cleaning.stay((now_s, stay / 20), &Sight { shipped: &even, mixture: &knows, set: &set }, &trace);
            assert_eq!(cleaning.stays_left(now_s + 60.0, f64::INFINITY), None);
        }
        let rows = cleaning.rows(1);
        assert_eq!((rows[1].disturbance_s_per_h, rows[1].coverage, rows[0].coverage), (0.0, 1.0, 1.0), "{rows:?}");
        let less = rows[1].less.unwrap();
        assert!(
            rows[0].disturbance_s_per_h > 100.0 && less.disturbance_ci95.is_some_and(|[_, high]| high < -50.0),
            "{rows:?}"
        );
        assert_eq!((rows[4].disturbance_s_per_h, rows[4].coverage), (0.0, 1.0), "{rows:?}");
        assert!(Cleaning::new(3, 1).rows(1).is_empty());
    }
}
