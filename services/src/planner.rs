//! The planner: keeps the robot's state, applies a policy each time the robot is free, publishes decisions with their reason.
//!
//! Scores that the daemon has not confirmed for longer than the deadline are not acted upon. The fallback is to **stay where
//! the robot is**: it is the one choice that brings it nearer to nobody by its own doing. Such a decision is flagged, is
//! published once, and the next one follows as soon as there are fresh scores again.
//!
//! Work goes in rounds. A round has a deadline, so that the slots that are left become fewer with time and no plan can put a room off
//! for ever. A room that is undone at the deadline belongs to the next round. Where the configuration gives the length of rounds, one
//! that is done early goes on to its deadline, and the robot keeps where the person is not; otherwise the next one begins at once.

use std::time::Duration;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use roomcast_ipc::{
    DecisionV1, Domain, ForecastV1, IpcError, Publisher, RoomScoresV1, action, clock, decision_flags, score_flags,
    sequence, text,
};
use sd_notify::NotifyState;

use crate::config::{Config, PlannerConfig};
use crate::logging::Limiter;
use crate::notify::notify;
use crate::stop::Stop;
use roomcast_core::policy::{Policy, PolicyError, PolicyName, RobotState};
use roomcast_core::semantic_map::PartitionId;

/// How often connections are renewed.
const TICK: Duration = Duration::from_millis(100);
/// How many stays a round has for each room, where the configuration gives no deadline: one to do it, one to wait for it.
const STAYS_PER_ROOM: u64 = 2;
/// A stay may end so much after the deadline, as a share of itself: each decision comes a little after the stay before it.
const OVERTIME: u64 = 20;
/// Most slots that are planned at once: of a round with more, the first.
const SLOTS_MAX: u64 = 256;

/// The robot as the planner knows it, and what it decides. Pure: time comes in as a number.
#[derive(Debug)]
pub struct Planner {
    policy: Box<dyn Policy>,
    rng: ChaCha8Rng,
    robot: u64,
    epoch: u64,
    sequence: u64,
    room_time_ns: u64,
    deadline_ns: u64,
    /// How long a round is; without it, so long as [`STAYS_PER_ROOM`] says.
    round_ns: Option<u64>,
    repeat: bool,
    scores: Option<RoomScoresV1>,
    forecast: Option<ForecastV1>,
    room: Option<usize>,
    covered: Vec<bool>,
    /// When the round began; none between two rounds.
    began_ns: Option<u64>,
    /// The robot has said that it stays because every room is covered.
    finished: bool,
    /// When the robot is free again.
    free_ns: u64,
    /// Epoch and sequence of the scores last decided upon.
    decided: Option<(u64, u64)>,
    /// The fallback has been published and holds until scores are fresh.
    falling_back: bool,
}

impl Planner {
    /// A robot in no room, with nothing covered; `epoch` is random per start.
    #[must_use]
    pub fn new(config: &PlannerConfig, epoch: u64) -> Self {
        Self {
            policy: config.policy.policy(),
            rng: ChaCha8Rng::seed_from_u64(config.seed),
            robot: sequence::source_of_name(&config.robot),
            epoch,
            sequence: 0,
            room_time_ns: nanoseconds(config.room_time_s),
            deadline_ns: config.deadline_ms.saturating_mul(1_000_000),
            round_ns: config.round_s.map(nanoseconds),
            repeat: config.repeat,
            scores: None,
            forecast: None,
            room: None,
            covered: Vec::new(),
            began_ns: None,
            finished: false,
            free_ns: 0,
            decided: None,
            falling_back: false,
        }
    }

    /// Takes a checked snapshot, unless it is older than the one known. When the daemon's map was changed, rooms that are still
    /// there keep what was done in them, and rooms that are new are to be done; another daemon's other map makes all rooms new.
    pub fn take(&mut self, scores: &RoomScoresV1) {
        if let Some(known) = &self.scores {
            if known.epoch == scores.epoch
                && (known.sequence, known.published_ns) > (scores.sequence, scores.published_ns)
            {
                return;
            }
            // A delayed snapshot of a former daemon.
            if known.epoch != scores.epoch && known.published_ns > scores.published_ns {
                return;
            }
        }
        let same_map = self.scores.as_ref().is_some_and(|known| {
            known.map_fingerprint == scores.map_fingerprint
                && known.rooms().iter().map(|room| room.id).eq(scores.rooms().iter().map(|room| room.id))
        });
        let changed = self.scores.as_ref().filter(|known| !same_map && known.epoch == scores.epoch);
        if let Some(known) = changed {
            let before = |id| known.rooms().iter().position(|room| room.id == id);
            let covered = scores.rooms().iter().map(|room| before(room.id).is_some_and(|index| self.covered[index]));
            let room = self.room.and_then(|index| known.rooms().get(index)).map(|room| room.id);
            let covered: Vec<bool> = covered.collect();
            self.room = room.and_then(|id| scores.rooms().iter().position(|room| room.id == id));
            self.covered = covered;
            if self.room.is_none() {
                self.free_ns = 0;
            }
        } else if !same_map {
            self.covered = vec![false; scores.rooms().len()];
            self.began_ns = None;
            self.room = None;
            self.free_ns = 0;
        }
        self.scores = Some(*scores);
    }

    /// Takes a checked forecast; it is used as long as it is of the same rooms as the scores.
    pub fn take_forecast(&mut self, forecast: &ForecastV1) {
        self.forecast = Some(*forecast);
    }

    /// How many stays fit before the round's deadline. A robot that stays nowhere has no round to plan.
    fn slots_left(&self, now_ns: u64) -> Option<usize> {
        let rooms = self.covered.len() as u64;
        let default_ns = || self.room_time_ns.saturating_mul(STAYS_PER_ROOM.saturating_mul(rooms));
        let end_ns = self.began_ns?.saturating_add(self.round_ns.unwrap_or_else(default_ns));
        let left_ns = end_ns.saturating_add(self.room_time_ns / OVERTIME).saturating_sub(now_ns);
        left_ns.checked_div(self.room_time_ns).map(|slots| slots.min(SLOTS_MAX) as usize)
    }

    /// How long robot and person are expected to share each room in each of the slots left, slot by slot, in seconds. Empty without
    /// a forecast that is fresh and of the scores' rooms, or without a time to stay.
    fn expected_shared_s(&self, scores: &RoomScoresV1, now_ns: u64) -> Vec<f64> {
        let rooms = scores.rooms();
        // A robot that decides with every score stays nowhere for a time that could be shared.
        let forecast = self.forecast.as_ref().filter(|_| self.room_time_ns > 0);
        let Some(forecast) = forecast.filter(|forecast| {
            forecast.epoch == scores.epoch
                && now_ns.saturating_sub(forecast.published_ns) <= self.deadline_ns
                && forecast.room_count == scores.room_count
                && forecast.horizon_count > 0
                && rooms.iter().enumerate().all(|(index, room)| forecast.id[index] == room.id)
        }) else {
            return Vec::new();
        };
        let room_time_s = self.room_time_ns as f64 / 1e9;
        let age_s = now_ns.saturating_sub(forecast.computed_ns) as f64 / 1e9;
        (0..self.slots_left(now_ns).unwrap_or(0))
            .flat_map(|slot| (0..rooms.len()).map(move |room| (slot, room)))
            .map(|(slot, room)| {
                let at_s = age_s + (slot as f64 + 0.5) * room_time_s;
                room_time_s * forecast.room(room).map_or(0.0, |(_, row)| interpolate(&forecast.horizon_s, row, at_s))
            })
            .collect()
    }

    /// Decides if the robot is free and there is something new to say.
    ///
    /// # Errors
    ///
    /// [`PolicyError`] when the policy cannot use the scores; the robot stays.
    pub fn decide(&mut self, now_ns: u64, now_unix_ns: u64) -> Result<Option<DecisionV1>, PolicyError> {
        if now_ns < self.free_ns || self.is_finished() {
            return Ok(None);
        }
        self.finished = false;
        let stale = self.stale(now_ns);
        let Some(scores) = self.scores.filter(|_| stale == 0) else {
            if self.falling_back {
                return Ok(None);
            }
            self.falling_back = true;
            self.decided = None;
            let why = match stale {
                decision_flags::NO_SCORES => "no scores have arrived",
                decision_flags::STALE => "the scores lack narration that the scorer failed on",
                _ => "the daemon has been silent for longer than the deadline",
            };
            let decision = self.decision(now_ns, now_unix_ns, self.room, &format!("{why}: staying is safe"));
            return Ok(Some(DecisionV1 { flags: decision.flags | decision_flags::FALLBACK | stale, ..decision }));
        };
        self.falling_back = false;
        // A robot that is always free decides once per score, not as often as it looks.
        let of = Some((scores.epoch, scores.sequence));
        if self.room_time_ns == 0 && self.decided == of {
            return Ok(None);
        }
        self.decided = of;
        // The stay that ends now is work done.
        if let Some(covered) = self.room.and_then(|room| self.covered.get_mut(room))
            && self.free_ns > 0
        {
            *covered = true;
        }
        let (rooms, undone, left) = (self.covered.len(), self.undone(), self.slots_left(now_ns));
        let (mut flags, mut ended) = (0, String::new());
        if undone == 0 {
            flags = decision_flags::COVERED;
            if !self.repeat {
                (self.finished, self.began_ns) = (true, None);
                let decision = self.decision(now_ns, now_unix_ns, self.room, "every room is covered");
                return Ok(Some(DecisionV1 { flags: decision.flags | flags, ..decision }));
            }
            let goes_on = self.round_ns.is_some() && left.is_some_and(|slots| slots > 0);
            if !goes_on {
                self.covered.fill(false);
                self.began_ns = None;
            }
        } else if left == Some(0) {
            let next = if self.repeat { "a round of all rooms begins" } else { "another round for them begins" };
            ended = format!("the round's deadline came with {undone} of {rooms} rooms undone, {next}: ");
            self.began_ns = None;
            if self.repeat {
                self.covered.fill(false);
            }
        }
        self.began_ns.get_or_insert(now_ns);
        let likely: Vec<f64> = scores.rooms().iter().map(|room| room.probability).collect();
        let expected_shared_s = self.expected_shared_s(&scores, now_ns);
        let state = RobotState {
            partition: self.room.map(|room| PartitionId(room as u32)),
            covered: &self.covered,
            room_time_s: self.room_time_ns as f64 / 1e9,
            expected_shared_s: &expected_shared_s,
        };
        let choice = self.policy.choose(&state, &likely, &mut self.rng)?;
        let to = choice.partition.0 as usize;
        let decision = self.decision(now_ns, now_unix_ns, Some(to), &format!("{ended}{}", choice.reason));
        // What a policy that plans by the forecast acts on: the expected share of the stay that somebody is there.
        let planned = (self.policy.name() == PolicyName::CoverageAware).then(|| expected_shared_s.get(to)).flatten();
        let forecast = planned.map(|shared_s| (shared_s / (self.room_time_ns as f64 / 1e9)).clamp(0.0, 1.0));
        self.room = Some(to);
        self.free_ns = now_ns.saturating_add(self.room_time_ns).max(1);
        Ok(Some(DecisionV1 {
            probability: forecast.unwrap_or(decision.probability),
            action: action::GO,
            stay_ns: self.room_time_ns,
            flags: decision.flags | flags,
            ..decision
        }))
    }

    fn undone(&self) -> usize {
        self.covered.iter().filter(|covered| !**covered).count()
    }

    /// Nothing is left to do or to say, until a map has a room that is not covered.
    fn is_finished(&self) -> bool {
        self.finished && self.undone() == 0
    }

    /// Why the scores may not be acted upon: bits of [`decision_flags`], 0 when they may.
    #[must_use]
    pub fn stale(&self, now_ns: u64) -> u32 {
        match &self.scores {
            None => decision_flags::NO_SCORES,
            Some(scores) if scores.silence_ns(now_ns) > self.deadline_ns => {
                decision_flags::STALE | decision_flags::DAEMON_SILENT
            }
            // The daemon lives, but these scores do not contain what has happened since.
            Some(scores) if scores.has(score_flags::SCORER_FAILED) && scores.age_ns(now_ns) > self.deadline_ns => {
                decision_flags::STALE
            }
            Some(_) => 0,
        }
    }

    /// When the robot is free again: monotonic nanoseconds.
    #[must_use]
    pub fn free_ns(&self) -> u64 {
        self.free_ns
    }

    /// How long there is nothing to decide unless something arrives, at most 100 ms.
    #[must_use]
    pub fn idle(&self, now_ns: u64) -> Duration {
        if self.room_time_ns == 0 || self.is_finished() {
            return TICK;
        }
        Duration::from_nanos(self.free_ns.saturating_sub(now_ns)).clamp(Duration::from_millis(1), TICK)
    }

    /// The room that the robot is in, by index in the scores' rooms.
    #[must_use]
    pub fn room(&self) -> Option<usize> {
        self.room
    }

    fn decision(&mut self, now_ns: u64, now_unix_ns: u64, to: Option<usize>, reason: &str) -> DecisionV1 {
        self.sequence += 1;
        let covered = self.covered.iter().take(64).enumerate();
        let mut decision = DecisionV1 {
            robot: self.robot,
            epoch: self.epoch,
            sequence: self.sequence,
            decided_ns: now_ns,
            decided_unix_ns: now_unix_ns,
            covered: covered.fold(0, |bits, (room, covered)| bits | u64::from(*covered) << room),
            action: action::STAY,
            policy: text::encode_cut(self.policy.name().as_str()),
            reason: text::encode_cut(reason),
            ..Default::default()
        };
        if let Some(scores) = &self.scores {
            decision.scores_epoch = scores.epoch;
            decision.scores_sequence = scores.sequence;
            decision.scores_age_ns = scores.age_ns(now_ns);
            decision.observed_ns = scores.observed_ns;
            let room = |index: Option<usize>| index.and_then(|index| scores.rooms().get(index));
            decision.from = room(self.room).map_or([0; 48], |room| room.id);
            decision.to = room(to).map_or([0; 48], |room| room.id);
            decision.probability = room(to).map_or(0.0, |room| room.probability);
        }
        decision
    }
}

/// Runs until asked to stop.
///
/// # Errors
///
/// [`IpcError`] when a service cannot be opened or is lost.
pub fn run(config: &Config, domain: &Domain, stop: &Stop) -> Result<(), IpcError> {
    let config = &config.planner;
    // The number is the one by which decisions name the robot.
    let number = sequence::source_of_name(&config.robot);
    let node = domain.open(&format!("roomcast-planner {} {number:016x}", config.robot))?;
    node.be_the_only_one()?;
    let scores = node.subscriber::<RoomScoresV1>()?;
    let forecasts = node.subscriber::<ForecastV1>()?;
    let decisions = node.publisher::<DecisionV1>()?;
    let mut planner = Planner::new(config, sequence::random_epoch());
    let mut log = Limiter::new(5_000_000_000);
    // At the start the scores need a moment to arrive; saying that there are none is worth something only after the deadline.
    let patience_ns = clock::monotonic_ns() + config.deadline_ms.saturating_mul(1_000_000);
    let (mut snapshot, mut forecast) = (Box::<RoomScoresV1>::default(), Box::<ForecastV1>::default());
    notify(&[NotifyState::Ready]);
    while !stop.requested() {
        let now_ns = clock::monotonic_ns();
        scores.wait(planner.idle(now_ns))?;
        while let Some(checked) = scores.receive_into(&mut snapshot)? {
            match checked {
                Ok(()) => planner.take(&snapshot),
                Err(error) => {
                    if let Some(held_back) = log.pass(now_ns) {
                        tracing::warn!(%error, held_back, "malformed scores");
                    }
                }
            }
        }
        while let Some(checked) = forecasts.receive_into(&mut forecast)? {
            match checked {
                Ok(()) => planner.take_forecast(&forecast),
                Err(error) => {
                    if let Some(held_back) = log.pass(now_ns) {
                        tracing::warn!(%error, held_back, "malformed forecast");
                    }
                }
            }
        }
        let now_ns = clock::monotonic_ns();
        if planner.stale(now_ns) != decision_flags::NO_SCORES || now_ns >= patience_ns {
            decide(&mut planner, now_ns, &decisions, &mut log)?;
        }
        // What comes after may wait for the decision.
        decisions.tick()?;
        notify(&[NotifyState::Watchdog]);
    }
    notify(&[NotifyState::Stopping]);
    tracing::info!("stopped");
    Ok(())
}

/// Decides, if there is something to decide, sends it and logs it.
fn decide(
    planner: &mut Planner,
    now_ns: u64,
    decisions: &Publisher<DecisionV1>,
    log: &mut Limiter,
) -> Result<(), IpcError> {
    match planner.decide(now_ns, clock::unix_ns()) {
        Ok(None) => {}
        Ok(Some(decision)) => {
            decisions.send(&decision)?;
            tracing::info!(
                sequence = decision.sequence,
                from = decision.from(),
                to = decision.to(),
                probability = decision.probability,
                fallback = decision.has(decision_flags::FALLBACK),
                scores = decision.scores_sequence,
                age_us = decision.scores_age_ns / 1000,
                why = decision.reason(),
                "decision"
            );
        }
        Err(error) => {
            if let Some(held_back) = log.pass(now_ns) {
                tracing::error!(%error, held_back, "the policy cannot decide; the robot stays");
            }
        }
    }
    Ok(())
}

/// A time of the configuration, which bounds it.
fn nanoseconds(seconds: f64) -> u64 {
    (seconds.max(0.0) * 1e9) as u64
}

/// The value at `at` of a curve through points with rising `grid`; constant beyond both ends.
fn interpolate(grid: &[f32], values: &[f32], at: f64) -> f64 {
    let points = || grid.iter().zip(values).map(|(x, y)| (f64::from(*x), f64::from(*y)));
    let mut before: Option<(f64, f64)> = None;
    for (x, y) in points() {
        if x >= at {
            return match before {
                Some((x0, y0)) if x > x0 => y0 + (y - y0) * (at - x0) / (x - x0),
                _ => y,
            };
        }
        before = Some((x, y));
    }
    before.map_or(0.0, |(_, y)| y)
}

#[cfg(test)]
mod tests {
    use roomcast_core::forecast::{ForecastOptions, Forecaster, Mentions};
    use roomcast_core::grounding::{Grounding, GroundingOptions};
    use roomcast_core::semantic_map::SemanticMap;

    use super::*;

    const S: u64 = 1_000_000_000;

    fn scores(sequence: u64, now_ns: u64, likely: &[f64]) -> RoomScoresV1 {
        let mut scores = RoomScoresV1 {
            epoch: 5,
            sequence,
            computed_ns: now_ns,
            published_ns: now_ns,
            room_count: likely.len() as u32,
            ..Default::default()
        };
        for (index, probability) in likely.iter().enumerate() {
            scores.room[index].id = text::encode("id", &format!("room-{index}")).unwrap();
            scores.room[index].probability = *probability;
        }
        scores
    }

    fn planner(policy: PolicyName, repeat: bool) -> Planner {
        let config = PlannerConfig { policy, room_time_s: 10.0, repeat, ..Default::default() };
        Planner::new(&config, 1)
    }

    fn forecast(of: &RoomScoresV1, curves: &[[f32; 2]]) -> ForecastV1 {
        let mut forecast = ForecastV1 {
            epoch: of.epoch,
            computed_ns: of.computed_ns,
            published_ns: of.published_ns,
            room_count: of.room_count,
            horizon_count: 2,
            ..Default::default()
        };
        forecast.horizon_s[1] = 20.0;
        for (index, curve) in curves.iter().enumerate() {
            forecast.id[index] = of.room[index].id;
            forecast.probability[index][..2].copy_from_slice(curve);
        }
        forecast
    }

    #[test]
    fn coverage_aware_waits_for_a_room_that_the_forecast_says_becomes_free() {
        let mut planner = planner(PolicyName::CoverageAware, true);
        // The scores alone would send the robot into room 0 first.
        let scores = scores(1, S, &[0.1, 0.9]);
        planner.take(&scores);
        planner.take_forecast(&forecast(&scores, &[[1.0, 0.0], [0.0, 1.0]]));
        let decision = planner.decide(S, 0).unwrap().unwrap();
        assert_eq!(decision.to(), "room-1");
        assert!(decision.reason().contains("slots planned"), "{}", decision.reason());
    }

    /// A home where somebody lies down in the bedroom, and what the daemon publishes of it.
    struct Sleeper {
        forecaster: Forecaster,
    }

    const HORIZONS_S: [f32; 9] = [0.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0, 3600.0];
    const ROOMS: [&str; 4] = ["bedroom", "corridor", "kitchen", "office"];

    impl Sleeper {
        fn new() -> Self {
            let rooms = ROOMS.map(|id| {
                let x = ROOMS.iter().position(|other| *other == id).unwrap() * 4;
                format!(
                    r#"{{"id": "{id}", "label": "{id}", "box": {{"min_m": [{x}, 0, 0], "max_m": [{}, 4, 3]}}}}"#,
                    x + 4
                )
            });
            let scene = format!(
                r#"{{"format": "roomcast-scene", "version": 1, "name": "home", "rooms": [{}], "items": [
                    {{"id": "bed", "label": "bed", "position_m": [2, 2, 0.3],
                        "box": {{"min_m": [1, 1, 0], "max_m": [3, 3, 0.6]}}}},
                    {{"id": "fridge", "label": "fridge", "position_m": [10, 2, 1],
                        "box": {{"min_m": [9.5, 1.5, 0], "max_m": [10.5, 2.5, 2]}}}}]}}"#,
                rooms.join(", ")
            );
            let map = SemanticMap::from_json(&scene).unwrap();
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let bed = Mentions::new(&map, &grounding).last("They lie on the bed.");
            let mut forecaster = Forecaster::new(ROOMS.len(), ForecastOptions::default(), 0.0);
            forecaster.observe(0.0, bed, &grounding, &[0.4, 0.1, 0.4, 0.1]);
            Self { forecaster }
        }

        fn tell(&self, planner: &mut Planner, now_ns: u64) {
            let mut scores = scores(1, now_ns, &[0.4, 0.1, 0.4, 0.1]);
            let mut forecast = ForecastV1 { horizon_count: HORIZONS_S.len() as u32, ..forecast(&scores, &[]) };
            forecast.horizon_s[..HORIZONS_S.len()].copy_from_slice(&HORIZONS_S);
            for (room, id) in ROOMS.iter().enumerate() {
                scores.room[room].id = text::encode("id", id).unwrap();
                forecast.id[room] = scores.room[room].id;
            }
            for (place, horizon_s) in HORIZONS_S.iter().enumerate() {
                let now_s = now_ns as f64 / 1e9;
                for (room, p) in self.forecaster.at(now_s, f64::from(*horizon_s)).enumerate() {
                    forecast.probability[room][place] = p as f32;
                }
            }
            planner.take(&scores);
            planner.take_forecast(&forecast);
        }
    }

    #[test]
    fn while_somebody_sleeps_every_other_room_is_done_in_its_slot() {
        let sleeper = Sleeper::new();
        let mut planner = Planner::new(&PlannerConfig::default(), 1);
        let stay_ns = 600 * S;
        // The person has slept for an hour, and goes on for five.
        for round in 0..4 {
            let mut visited = Vec::new();
            for slot in 0..8 {
                let now_ns = 3600 * S + (8 * round + slot) * stay_ns;
                sleeper.tell(&mut planner, now_ns);
                let decision = planner.decide(now_ns, 0).unwrap().unwrap();
                let planned = format!("first of {} slot", 8 - slot);
                assert!(decision.reason().contains(&planned), "slot {slot}: {}", decision.reason());
                if slot > 2 {
                    let said = decision.reason().contains("waits in a room that is done")
                        && decision.reason().contains("1 left undone");
                    assert!(said, "slot {slot}: {}", decision.reason());
                } else if slot == 0 && round > 0 {
                    let ended = "the round's deadline came with 1 of 4 rooms undone, a round of all rooms begins: ";
                    assert!(decision.reason().starts_with(ended), "{}", decision.reason());
                }
                visited.push(decision.to().to_owned());
            }
            visited[..3].sort();
            assert_eq!(visited[..3], ROOMS[1..], "round {round}");
            assert!(!visited.iter().any(|room| room == "bedroom"), "round {round}: {visited:?}");
        }
    }

    #[test]
    fn a_round_ends_at_its_deadline_also_when_nobody_could_decide() {
        for (repeat, next) in [(true, "a round of all rooms begins"), (false, "another round for them begins")] {
            let config = PlannerConfig {
                room_time_s: 10.0,
                round_s: Some(30.0),
                repeat,
                policy: PolicyName::UncoveredFirst,
                ..Default::default()
            };
            let mut planner = Planner::new(&config, 1);
            planner.take(&scores(1, S, &[0.1, 0.2, 0.7]));
            assert_eq!(planner.decide(S, 0).unwrap().unwrap().to(), "room-0");
            // The daemon is silent for two of the three stays.
            assert!(planner.decide(11 * S, 0).unwrap().unwrap().has(decision_flags::FALLBACK));
            planner.take(&scores(2, 31 * S, &[0.1, 0.2, 0.7]));
            let decision = planner.decide(31 * S, 0).unwrap().unwrap();
            let said = format!("the round's deadline came with 2 of 3 rooms undone, {next}: ");
            assert!(decision.reason().starts_with(&said), "{}", decision.reason());
            let (to, covered) = if repeat { ("room-0", 0) } else { ("room-1", 0b1) };
            assert_eq!((decision.to(), decision.covered), (to, covered));
        }
    }

    #[test]
    fn a_round_of_a_given_length_that_is_done_early_goes_on_without_work() {
        let config = PlannerConfig { room_time_s: 10.0, round_s: Some(40.0), ..Default::default() };
        let mut planner = Planner::new(&config, 1);
        let mut said = Vec::new();
        for stay in 0..5 {
            let now_ns = (1 + 10 * stay) * S;
            let scores = scores(stay + 1, now_ns, &[0.9, 0.1]);
            planner.take(&scores);
            planner.take_forecast(&forecast(&scores, &[[0.1, 0.1], [0.0, 0.0]]));
            let decision = planner.decide(now_ns, 0).unwrap().unwrap();
            said.push((decision.to().to_owned(), decision.covered, decision.has(decision_flags::COVERED)));
        }
        let expected = [
            ("room-1", 0, false),
            ("room-0", 0b10, false),
            ("room-1", 0b11, true),
            ("room-1", 0b11, true),
            ("room-1", 0, true),
        ];
        assert_eq!(said, expected.map(|(to, covered, done)| (to.to_owned(), covered, done)));
    }

    #[test]
    fn rooms_that_are_added_after_all_was_done_are_done_too() {
        let mut planner = planner(PolicyName::CoverageAware, false);
        for (visit, to) in ["room-1", "room-0"].into_iter().enumerate() {
            let now_ns = (1 + 10 * visit as u64) * S;
            planner.take(&scores(visit as u64 + 1, now_ns, &[0.6, 0.4]));
            assert_eq!(planner.decide(now_ns, 0).unwrap().unwrap().to(), to);
        }
        planner.take(&scores(3, 21 * S, &[0.6, 0.4]));
        let finished = planner.decide(21 * S, 0).unwrap().unwrap();
        assert_eq!((finished.action, finished.reason()), (action::STAY, "every room is covered"));
        assert_eq!((planner.idle(21 * S), planner.decide(99 * S, 0).unwrap()), (TICK, None));

        let added = RoomScoresV1 { map_fingerprint: [1; 32], ..scores(4, 100 * S, &[0.3, 0.3, 0.4]) };
        planner.take(&added);
        let decision = planner.decide(100 * S, 0).unwrap().unwrap();
        assert_eq!((decision.action, decision.to(), decision.covered), (action::GO, "room-2", 0b011));
        planner.take(&RoomScoresV1 { published_ns: 110 * S, ..added });
        assert_eq!(planner.decide(110 * S, 0).unwrap().unwrap().action, action::STAY);
    }

    #[test]
    fn a_long_round_of_short_stays_is_planned_in_bounds() {
        let config = PlannerConfig { room_time_s: 0.001, round_s: Some(1e9), ..Default::default() };
        let mut planner = Planner::new(&config, 1);
        let scores = scores(1, S, &[1.0 / 64.0; 64]);
        planner.take(&scores);
        planner.take_forecast(&forecast(&scores, &[[0.5, 0.5]; 64]));
        let decision = planner.decide(S, 0).unwrap().unwrap();
        assert!(decision.reason().contains("first of 256 slots"), "{}", decision.reason());
    }

    #[test]
    fn a_changed_map_keeps_what_was_done_in_rooms_that_stay() {
        let mut planner = planner(PolicyName::UncoveredFirst, true);
        planner.take(&scores(1, S, &[0.5, 0.5]));
        let first = planner.decide(S, 0).unwrap().unwrap();
        planner.take(&scores(2, 11 * S, &[0.5, 0.5]));
        planner.decide(11 * S, 0).unwrap().unwrap();
        // A room is added in front; the two known ones move by a place.
        let mut changed = scores(3, 12 * S, &[0.2, 0.4, 0.4]);
        changed.map_fingerprint = [1; 32];
        for (room, id) in changed.room.iter_mut().zip(["garage", "room-0", "room-1"]) {
            room.id = text::encode("id", id).unwrap();
        }
        planner.take(&changed);
        assert!(planner.decide(12 * S, 0).unwrap().is_none(), "it goes on with its work");
        planner.take(&RoomScoresV1 { published_ns: 21 * S, ..changed });
        let next = planner.decide(21 * S, 0).unwrap().unwrap();
        assert_eq!(next.to(), "garage", "the first room {} stays covered", first.to());
        // Another daemon with another map.
        let other = RoomScoresV1 { epoch: 6, map_fingerprint: [2; 32], ..scores(1, 22 * S, &[0.5, 0.5]) };
        planner.take(&other);
        assert_eq!(planner.decide(22 * S, 0).unwrap().unwrap().covered, 0);
    }

    #[test]
    fn curves_are_straight_between_their_points_and_flat_beyond() {
        let value = |at| interpolate(&[10.0, 20.0], &[0.2, 0.4], at);
        assert!(
            (value(0.0) - 0.2).abs() < 1e-6 && (value(15.0) - 0.3).abs() < 1e-6 && (value(99.0) - 0.4).abs() < 1e-6
        );
    }

    #[test]
    fn the_robot_goes_where_the_person_is_not_and_stays_for_its_time() {
        let mut planner = planner(PolicyName::GreedyAvoidance, true);
        planner.take(&scores(1, S, &[0.7, 0.1, 0.2]));
        let decision = planner.decide(S, 0).unwrap().unwrap();
        assert_eq!((decision.action, decision.to(), decision.flags), (action::GO, "room-1", 0));
        assert_eq!((decision.scores_sequence, decision.stay_ns), (1, 10 * S));
        planner.take(&scores(2, 2 * S, &[0.1, 0.7, 0.2]));
        assert_eq!(planner.decide(2 * S, 0).unwrap(), None, "not free yet");
        planner.take(&scores(3, 11 * S, &[0.1, 0.7, 0.2]));
        let decision = planner.decide(11 * S, 0).unwrap().unwrap();
        assert_eq!((decision.from(), decision.to(), decision.covered), ("room-1", "room-0", 0b010));
    }

    #[test]
    fn stale_scores_are_never_acted_upon() {
        let mut planner = planner(PolicyName::Naive, true);
        let none = planner.decide(S, 0).unwrap().unwrap();
        assert_eq!(none.flags, decision_flags::FALLBACK | decision_flags::NO_SCORES);
        assert_eq!((none.action, none.to()), (action::STAY, ""));
        assert_eq!(planner.decide(2 * S, 0).unwrap(), None, "the fallback is said once");

        planner.take(&scores(1, 3 * S, &[0.5, 0.5]));
        let gone = planner.decide(3 * S, 0).unwrap().unwrap();
        assert_eq!(gone.action, action::GO);
        let silent = planner.decide(20 * S, 0).unwrap().unwrap();
        assert!(silent.has(decision_flags::FALLBACK) && silent.has(decision_flags::DAEMON_SILENT));
        assert_eq!((silent.action, silent.to()), (action::STAY, gone.to()));

        // A heartbeat makes the same scores good again.
        planner.take(&RoomScoresV1 { published_ns: 21 * S, ..scores(1, 3 * S, &[0.5, 0.5]) });
        assert_eq!(planner.decide(21 * S, 0).unwrap().unwrap().action, action::GO);
    }

    #[test]
    fn scores_that_a_failed_scorer_left_behind_are_stale_too() {
        let mut planner = planner(PolicyName::Naive, true);
        let failed =
            RoomScoresV1 { flags: score_flags::SCORER_FAILED, published_ns: 9 * S, ..scores(1, S, &[0.5, 0.5]) };
        planner.take(&failed);
        let decision = planner.decide(9 * S, 0).unwrap().unwrap();
        assert_eq!(decision.flags, decision_flags::FALLBACK | decision_flags::STALE);
    }

    #[test]
    fn a_robot_that_is_always_free_decides_once_per_score() {
        let config =
            PlannerConfig { policy: PolicyName::GreedyAvoidance, room_time_s: 0.0, ..PlannerConfig::default() };
        let mut planner = Planner::new(&config, 1);
        planner.take(&scores(1, S, &[0.7, 0.3]));
        assert_eq!(planner.decide(S, 0).unwrap().unwrap().to(), "room-1");
        assert_eq!(planner.decide(S + 1, 0).unwrap(), None);
        planner.take(&scores(2, S + 2, &[0.2, 0.8]));
        assert_eq!(planner.decide(S + 2, 0).unwrap().unwrap().to(), "room-0");
    }

    #[test]
    fn coverage_ends_or_begins_anew() {
        for repeat in [false, true] {
            let mut planner = planner(PolicyName::UncoveredFirst, repeat);
            let mut visited = Vec::new();
            for visit in 0..3 {
                let now_ns = (1 + 10 * visit) * S;
                planner.take(&scores(visit + 1, now_ns, &[0.6, 0.4]));
                let decision = planner.decide(now_ns, 0).unwrap().unwrap();
                visited.push((decision.to().to_owned(), decision.has(decision_flags::COVERED), decision.action));
            }
            assert_eq!(visited[0], ("room-1".to_owned(), false, action::GO));
            assert_eq!(visited[1], ("room-0".to_owned(), false, action::GO));
            let last = if repeat {
                ("room-1".to_owned(), true, action::GO)
            } else {
                ("room-0".to_owned(), true, action::STAY)
            };
            assert_eq!(visited[2], last);
        }
    }

    #[test]
    fn old_and_foreign_snapshots_do_not_replace_newer_ones() {
        let mut planner = planner(PolicyName::Naive, true);
        planner.take(&scores(5, 5 * S, &[0.5, 0.5]));
        planner.take(&scores(4, 6 * S, &[1.0, 0.0]));
        planner.take(&RoomScoresV1 { epoch: 4, ..scores(9, 4 * S, &[1.0, 0.0]) });
        assert_eq!(planner.decide(6 * S, 0).unwrap().unwrap().scores_sequence, 5);
        // A restarted daemon counts from 1 again.
        planner.take(&RoomScoresV1 { epoch: 6, ..scores(1, 20 * S, &[0.5, 0.5]) });
        assert_eq!(planner.decide(20 * S, 0).unwrap().unwrap().scores_epoch, 6);
    }
}
