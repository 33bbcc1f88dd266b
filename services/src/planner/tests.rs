use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::places::PlaceMatcher;
use roomcast_ipc::raw::{Message, RobotReportV1, forecast_flags, report_flags, report_kind};

use super::*;
use crate::config::Reports;

mod house;

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

/// Messages that arrive as soon as they are sent.
impl Planner {
    fn hear(&mut self, scores: &RoomScoresV1) {
        self.take(scores, BootNs(scores.published_ns)).unwrap();
    }

    fn hear_forecast(&mut self, forecast: &ForecastV1) {
        self.take_forecast(forecast, BootNs(forecast.published_ns)).unwrap();
    }

    fn hear_sets(&mut self, sets: &PersonForecastsV1) {
        self.take_persons(sets, BootNs(sets.published_ns)).unwrap();
    }
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
    // By the scores alone the robot would go to room 0 first.
    let scores = scores(1, S, &[0.1, 0.9]);
    planner.hear(&scores);
    planner.hear_forecast(&forecast(&scores, &[[1.0, 0.0], [0.0, 1.0]]));
    let decision = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
    assert_eq!(decision.to(), "room-1");
    assert!(decision.reason().contains("; plan: "), "{}", decision.reason());
}

/// A home with a person who lies down in the bedroom, and the daemon's messages about it.
struct Sleeper {
    forecaster: Forecaster,
}

const HORIZONS_S: [f32; 9] = [0.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0, 3600.0];
const ROOMS: [&str; 4] = ["bedroom", "corridor", "kitchen", "office"];

impl Sleeper {
    fn new() -> Self {
        let rooms = ROOMS.map(|id| {
            let x = ROOMS.iter().position(|other| *other == id).unwrap() * 4;
            format!(r#"{{"id": "{id}", "label": "{id}", "box": {{"min_m": [{x}, 0, 0], "max_m": [{}, 4, 3]}}}}"#, x + 4)
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
        let bed = PlaceMatcher::new(&map, &grounding).last("They lie on the bed.");
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
        planner.hear(&scores);
        planner.hear_forecast(&forecast);
    }
}

#[test]
fn while_somebody_sleeps_every_other_room_is_done_in_its_slot() {
    let sleeper = Sleeper::new();
    let mut planner = Planner::new(&PlannerConfig::default(), 1);
    let stay_ns = 600 * S;
    // The person has slept for an hour, and sleeps for five more.
    for round in 0..4 {
        let mut visited = Vec::new();
        for slot in 0..8 {
            let now_ns = 3600 * S + (8 * round + slot) * stay_ns;
            sleeper.tell(&mut planner, now_ns);
            let decision = planner.decide(BootNs(now_ns), UnixNs(0)).unwrap().unwrap();
            if slot > 2 {
                let said = decision.reason().contains("Waits in a room that is done")
                    && decision.reason().contains("; 1 room would take more than ");
                assert!(said, "slot {slot}: {}", decision.reason());
            } else if slot == 0 && round > 0 {
                let ended = "The round's deadline came with 1 of 4 rooms undone, a round of all rooms begins: ";
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
        planner.hear(&scores(1, S, &[0.1, 0.2, 0.7]));
        assert_eq!(planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap().to(), "room-0");
        // The daemon is silent for two of the three stays.
        assert!(planner.decide(BootNs(11 * S), UnixNs(0)).unwrap().unwrap().has(decision_flags::FALLBACK));
        planner.hear(&scores(2, 31 * S, &[0.1, 0.2, 0.7]));
        let decision = planner.decide(BootNs(31 * S), UnixNs(0)).unwrap().unwrap();
        let said = format!("The round's deadline came with 2 of 3 rooms undone, {next}: ");
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
        planner.hear(&scores);
        planner.hear_forecast(&forecast(&scores, &[[0.1, 0.1], [0.0, 0.0]]));
        let decision = planner.decide(BootNs(now_ns), UnixNs(0)).unwrap().unwrap();
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
        planner.hear(&scores(visit as u64 + 1, now_ns, &[0.6, 0.4]));
        assert_eq!(planner.decide(BootNs(now_ns), UnixNs(0)).unwrap().unwrap().to(), to);
    }
    planner.hear(&scores(3, 21 * S, &[0.6, 0.4]));
    let finished = planner.decide(BootNs(21 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!((finished.action, finished.reason()), (action::STAY, "Every room is covered"));
    assert_eq!((planner.idle(BootNs(21 * S)), planner.decide(BootNs(99 * S), UnixNs(0)).unwrap()), (TICK, None));

    let added = RoomScoresV1 { map_fingerprint: [1; 32], ..scores(4, 100 * S, &[0.3, 0.3, 0.4]) };
    planner.hear(&added);
    let decision = planner.decide(BootNs(100 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!((decision.action, decision.to(), decision.covered), (action::GO, "room-2", 0b011));
    planner.hear(&RoomScoresV1 { published_ns: 110 * S, ..added });
    assert_eq!(planner.decide(BootNs(110 * S), UnixNs(0)).unwrap().unwrap().action, action::STAY);
}

#[test]
fn a_long_round_of_short_stays_is_planned_in_bounds() {
    let config = PlannerConfig { room_time_s: 0.001, round_s: Some(1e9), ..Default::default() };
    let mut planner = Planner::new(&config, 1);
    let scores = scores(1, S, &[1.0 / 64.0; 64]);
    planner.hear(&scores);
    planner.hear_forecast(&forecast(&scores, &[[0.5, 0.5]; 64]));
    let decision = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
    assert!(decision.reason().ends_with("plan: 64 rooms left, about 0 s near people"), "{}", decision.reason());
}

#[test]
fn a_changed_map_keeps_what_was_done_in_rooms_that_stay() {
    let mut planner = planner(PolicyName::UncoveredFirst, true);
    planner.hear(&scores(1, S, &[0.5, 0.5]));
    let first = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
    planner.hear(&scores(2, 11 * S, &[0.5, 0.5]));
    planner.decide(BootNs(11 * S), UnixNs(0)).unwrap().unwrap();
    // A new room comes first, and the two known ones move by a place.
    let mut changed = scores(3, 12 * S, &[0.2, 0.4, 0.4]);
    changed.map_fingerprint = [1; 32];
    for (room, id) in changed.room.iter_mut().zip(["garage", "room-0", "room-1"]) {
        room.id = text::encode("id", id).unwrap();
    }
    planner.hear(&changed);
    assert!(planner.decide(BootNs(12 * S), UnixNs(0)).unwrap().is_none(), "it goes on with its work");
    planner.hear(&RoomScoresV1 { published_ns: 21 * S, ..changed });
    let next = planner.decide(BootNs(21 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!(next.to(), "garage", "the first room {} stays covered", first.to());
    // Another daemon with another map.
    let other = RoomScoresV1 { epoch: 6, map_fingerprint: [2; 32], ..scores(1, 22 * S, &[0.5, 0.5]) };
    planner.hear(&other);
    assert_eq!(planner.decide(BootNs(22 * S), UnixNs(0)).unwrap().unwrap().covered, 0);
}

#[test]
fn the_robot_goes_where_the_person_is_not_and_stays_for_its_time() {
    let mut planner = planner(PolicyName::GreedyAvoidance, true);
    planner.hear(&scores(1, S, &[0.7, 0.1, 0.2]));
    let decision = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
    assert_eq!((decision.action, decision.to(), decision.flags), (action::GO, "room-1", 0));
    assert_eq!((decision.scores_sequence, decision.stay_ns), (1, 10 * S));
    planner.hear(&scores(2, 2 * S, &[0.1, 0.7, 0.2]));
    assert_eq!(planner.decide(BootNs(2 * S), UnixNs(0)).unwrap(), None, "not free yet");
    planner.hear(&scores(3, 11 * S, &[0.1, 0.7, 0.2]));
    let decision = planner.decide(BootNs(11 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!((decision.from(), decision.to(), decision.covered), ("room-1", "room-0", 0b010));
}

#[test]
fn stale_scores_are_never_acted_upon() {
    let mut planner = planner(PolicyName::Naive, true);
    let none = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
    assert_eq!(none.flags, decision_flags::FALLBACK | decision_flags::NO_SCORES);
    assert_eq!((none.action, none.to()), (action::STAY, ""));
    assert_eq!(planner.decide(BootNs(2 * S), UnixNs(0)).unwrap(), None, "the fallback is said once");

    planner.hear(&scores(1, 3 * S, &[0.5, 0.5]));
    let gone = planner.decide(BootNs(3 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!(gone.action, action::GO);
    let silent = planner.decide(BootNs(20 * S), UnixNs(0)).unwrap().unwrap();
    assert!(silent.has(decision_flags::FALLBACK) && silent.has(decision_flags::DAEMON_SILENT));
    assert_eq!((silent.action, silent.to()), (action::STAY, gone.to()));

    // A heartbeat makes the same scores fresh again.
    planner.hear(&RoomScoresV1 { published_ns: 21 * S, ..scores(1, 3 * S, &[0.5, 0.5]) });
    assert_eq!(planner.decide(BootNs(21 * S), UnixNs(0)).unwrap().unwrap().action, action::GO);
}

/// One snapshot of a recording from a boot with a longer uptime was used for days, and the daemon was ignored.
#[test]
fn what_is_dated_ahead_is_refused_and_the_daemon_is_heard() {
    let config = PlannerConfig { room_time_s: 10.0, avoid_sets: true, ..Default::default() };
    let mut planner = Planner::new(&config, 1);
    let ahead = RoomScoresV1 { epoch: 9, ..scores(9, 240 * 3600 * S, &[0.1, 0.9]) };
    for far in [ahead, scores(9, u64::MAX, &[0.1, 0.9]), RoomScoresV1 { published_ns: S, ..ahead }] {
        assert!(planner.take(&far, BootNs(S)).is_err());
        assert_eq!(planner.stale(BootNs(S)), decision_flags::NO_SCORES);
    }
    let message = planner.take(&ahead, BootNs(S)).unwrap_err().to_string();
    assert!(message.starts_with("dated 863999 s ahead"), "{message}");
    assert!(planner.take_forecast(&forecast(&ahead, &[[0.0, 0.0]; 2]), BootNs(S)).is_err());
    let sets = PersonForecastsV1 { published_ns: ahead.published_ns, ..Default::default() };
    assert!(planner.take_persons(&sets, BootNs(S)).is_err());
    assert!(planner.forecast.is_none() && planner.persons.is_none());
    // The difference of two clocks is not a reason to reject a message.
    planner.take(&scores(1, 2 * S, &[0.9, 0.1]), BootNs(S)).unwrap();
    assert_eq!(planner.stale(BootNs(2 * S)), 0);
    assert_ne!(planner.stale(BootNs(12 * S)), 0, "it goes stale as ever");
}

#[test]
fn scores_that_a_failed_scorer_left_behind_are_stale_too() {
    let mut planner = planner(PolicyName::Naive, true);
    let failed = RoomScoresV1 { flags: score_flags::SCORER_FAILED, published_ns: 9 * S, ..scores(1, S, &[0.5, 0.5]) };
    planner.hear(&failed);
    let decision = planner.decide(BootNs(9 * S), UnixNs(0)).unwrap().unwrap();
    assert_eq!(decision.flags, decision_flags::FALLBACK | decision_flags::STALE);
}

#[test]
fn a_robot_that_is_always_free_decides_once_per_score() {
    let config = PlannerConfig { policy: PolicyName::GreedyAvoidance, room_time_s: 0.0, ..PlannerConfig::default() };
    let mut planner = Planner::new(&config, 1);
    planner.hear(&scores(1, S, &[0.7, 0.3]));
    assert_eq!(planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap().to(), "room-1");
    assert_eq!(planner.decide(BootNs(S + 1), UnixNs(0)).unwrap(), None);
    planner.hear(&scores(2, S + 2, &[0.2, 0.8]));
    assert_eq!(planner.decide(BootNs(S + 2), UnixNs(0)).unwrap().unwrap().to(), "room-0");
}

#[test]
fn old_and_foreign_snapshots_do_not_replace_newer_ones() {
    let mut planner = planner(PolicyName::Naive, true);
    planner.hear(&scores(5, 5 * S, &[0.5, 0.5]));
    planner.hear(&scores(4, 6 * S, &[1.0, 0.0]));
    planner.hear(&RoomScoresV1 { epoch: 4, ..scores(9, 4 * S, &[1.0, 0.0]) });
    assert_eq!(planner.decide(BootNs(6 * S), UnixNs(0)).unwrap().unwrap().scores_sequence, 5);
    // A restarted daemon counts from 1 again.
    planner.hear(&RoomScoresV1 { epoch: 6, ..scores(1, 20 * S, &[0.5, 0.5]) });
    assert_eq!(planner.decide(BootNs(20 * S), UnixNs(0)).unwrap().unwrap().scores_epoch, 6);
}

/// A reporting robot, its planner and its home.
struct Home {
    planner: Planner,
    likely: Vec<f32>,
    flags: u32,
    sequence: u64,
    reports: u64,
}

impl Home {
    /// With stays of 100 s, in rooms without persons.
    fn new(rooms: usize, config: &PlannerConfig) -> Self {
        let config = PlannerConfig { room_time_s: 100.0, ..config.clone() };
        let planner = Planner::new(&config, 1);
        Self { planner, likely: vec![0.0; rooms], flags: 0, sequence: 0, reports: 0 }
    }

    fn scores(&self, now_ns: u64) -> RoomScoresV1 {
        scores(self.sequence, now_ns, &self.likely.iter().map(|p| f64::from(*p)).collect::<Vec<_>>())
    }

    /// Sends the daemon's messages, and returns the planner's decision.
    fn look(&mut self, at_s: u64) -> Option<DecisionV1> {
        self.sequence += 1;
        let scores = self.scores(at_s * S);
        let curves: Vec<_> = self.likely.iter().map(|p| [*p, *p]).collect();
        self.planner.hear(&scores);
        self.planner.hear_forecast(&ForecastV1 { flags: self.flags, ..forecast(&scores, &curves) });
        self.planner.decide(BootNs(at_s * S), UnixNs(0)).unwrap()
    }

    /// The decision of this moment, which must exist.
    fn decision(&mut self, at_s: u64) -> DecisionV1 {
        let decision = self.look(at_s).unwrap_or_else(|| panic!("no decision at {at_s} s"));
        decision.check().unwrap();
        decision
    }

    fn report(&mut self, at_s: u64, kind: u32, change: impl Fn(&mut RobotReportV1)) {
        self.reports += 1;
        let mut report = RobotReportV1 {
            robot: sequence::source_of_name("robot"),
            epoch: 77,
            sequence: self.reports,
            reported_ns: at_s * S,
            kind,
            ..Default::default()
        };
        change(&mut report);
        report.check().unwrap();
        self.planner.take_report(&report, BootNs(at_s * S)).unwrap();
    }

    /// Another planner continues with the kept round.
    fn restart(&mut self, config: &PlannerConfig) {
        let kept = serde_json::to_string(&self.planner.kept("boot").unwrap()).unwrap();
        self.planner = Planner::new(config, 2).with_kept(serde_json::from_str(&kept).unwrap());
    }

    /// The robot answers a decision.
    fn answer(&mut self, at_s: u64, kind: u32, decision: &DecisionV1) {
        let (epoch, sequence) = (decision.epoch, decision.sequence);
        self.report(at_s, kind, |report| (report.decision_epoch, report.decision_sequence) = (epoch, sequence));
    }
}

#[test]
fn without_reports_the_clock_says_what_is_done_and_with_them_the_robot() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let first = home.decision(1);
    assert_eq!((first.covered, first.has(decision_flags::REPORTED), first.minor), (0, false, 4));
    assert_eq!(first.robot_name(), PlannerConfig::default().robot);
    assert!(!first.has(decision_flags::OWED));
    // By the clock.
    let second = home.decision(101);
    assert_eq!((second.covered, second.cancels), (0b001, 0));
    home.answer(103, report_kind::STARTED, &second);
    // The stay is over, and the robot has not reported its end.
    assert_eq!(home.look(250), None);
    home.answer(260, report_kind::FINISHED, &second);
    let third = home.decision(260);
    assert_eq!((third.covered, third.has(decision_flags::REPORTED), third.cancels), (0b011, true, 0));
    // Earlier than the clock.
    home.answer(270, report_kind::FINISHED, &third);
    assert!(home.decision(270).has(decision_flags::COVERED));
}

#[test]
fn a_robot_of_which_reports_are_always_or_never_wanted() {
    let always = PlannerConfig { reports: Reports::Always, ..Default::default() };
    let mut home = Home::new(2, &always);
    home.decision(1);
    assert_eq!(home.look(220), None, "the clock says nothing");
    let late = home.decision(221);
    assert!(
        late.has(decision_flags::ROBOT_SILENT | decision_flags::REPORTED) && late.covered == 0 && late.cancels == 1
    );

    let mut home = Home::new(2, &PlannerConfig { reports: Reports::Never, ..Default::default() });
    let decision = home.decision(1);
    home.answer(2, report_kind::FINISHED, &decision);
    assert_eq!(home.look(50), None);
    assert!(!home.decision(101).has(decision_flags::REPORTED));
}

#[test]
fn a_room_that_could_not_be_done_is_tried_after_the_others() {
    for kind in [report_kind::FAILED, report_kind::BLOCKED, report_kind::CANCELLED] {
        let mut home = Home::new(3, &PlannerConfig::default());
        let first = home.decision(1);
        home.answer(5, kind, &first);
        let mut at_s = 5;
        let mut rooms = Vec::new();
        for _ in 0..3 {
            let decision = home.decision(at_s);
            assert_eq!(decision.cancels, 0, "the robot is free by its own word");
            rooms.push(decision.to().to_owned());
            at_s += 40;
            home.answer(at_s, report_kind::FINISHED, &decision);
        }
        assert_eq!(rooms, ["room-1", "room-2", "room-0"], "{kind}");
    }
}

#[test]
fn the_next_decision_says_why_the_robot_could_not_do_a_room() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let first = home.decision(1);
    home.report(5, report_kind::FAILED, |report| report.note = text::encode("note", "brush jammed").unwrap());
    let next = home.decision(5);
    assert!(next.reason().starts_with("The robot could not do the room 0 (brush jammed). "), "{}", next.reason());
    assert_ne!(next.to(), first.to());
    home.answer(50, report_kind::FAILED, &next);
    assert!(!home.decision(50).reason().contains("could not"), "without a reason there is none to tell");
}

#[test]
fn a_robot_that_gets_nowhere_pauses_between_its_tries() {
    let mut home = Home::new(1, &PlannerConfig { repeat: false, ..Default::default() });
    let first = home.decision(1);
    home.answer(2, report_kind::BLOCKED, &first);
    let pause = home.decision(2);
    assert_eq!((pause.action, pause.to()), (action::PAUSE, ""));
    assert!(pause.reason().contains("No other room can be done now"), "{}", pause.reason());
    assert_eq!(home.look(30), None, "said once");
    assert_eq!(home.decision(63).to(), "room-0");
}

#[test]
fn a_robot_in_trouble_is_asked_ever_less_often_until_it_is_well() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let asked_in = |home: &mut Home, from_s: u64, to_s: u64| -> Vec<u64> {
        let mut asked = Vec::new();
        for at_s in from_s..to_s {
            if let Some(decision) = home.look(at_s).filter(|decision| decision.action == action::GO) {
                asked.push(at_s);
                home.report(at_s, report_kind::FAILED, |report| {
                    (report.decision_epoch, report.decision_sequence) = (decision.epoch, decision.sequence);
                    report.note = text::encode("note", "the robot has an error: stuck").unwrap();
                });
            }
        }
        asked
    };
    let asked = asked_in(&mut home, 1, 3600);
    assert!((8..=12).contains(&asked.len()), "asked at {asked:?}");
    let gaps: Vec<u64> = asked.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert!(gaps[1] >= 60 && gaps[2] >= 120 && gaps.iter().all(|gap| *gap <= 620), "{gaps:?}");
    // A person has freed it and put it on its dock: it is asked at once.
    assert_eq!(home.look(3601).map(|decision| decision.action), None);
    home.report(3602, report_kind::DOCKED, |_| ());
    let well = home.decision(3670);
    assert_eq!(well.action, action::GO, "{}", well.reason());
    home.answer(3671, report_kind::STARTED, &well);
    home.answer(3700, report_kind::FAILED, &well);
    assert_eq!(home.decision(3770).action, action::GO, "one room that fails after it began is no trouble of the robot");
}

/// A planner that restarts often asks a robot in trouble no more often than one that does not.
#[test]
fn a_restarted_planner_leaves_a_robot_in_trouble_alone() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let mut asked = Vec::new();
    for at_s in 1..1800 {
        if at_s % 30 == 0 {
            let kept = serde_json::to_string(&home.planner.kept("boot").unwrap()).unwrap();
            let config = PlannerConfig { room_time_s: 100.0, ..PlannerConfig::default() };
            home.planner = Planner::new(&config, at_s).with_kept(serde_json::from_str(&kept).unwrap());
        }
        if let Some(decision) = home.look(at_s).filter(|decision| decision.action == action::GO) {
            asked.push(at_s);
            home.answer(at_s, report_kind::FAILED, &decision);
        }
    }
    assert!((5..=8).contains(&asked.len()), "asked at {asked:?}");
}

#[test]
fn a_robot_in_trouble_pauses_and_says_why() {
    let mut home = Home::new(3, &PlannerConfig::default());
    for at_s in [1, 2] {
        let decision = home.decision(at_s);
        home.answer(at_s, report_kind::FAILED, &decision);
    }
    let pause = home.decision(3);
    assert_eq!(pause.action, action::PAUSE);
    assert!(
        pause.reason().contains("The robot failed 2 times in a row before it began: it is asked again in 1 min"),
        "{}",
        pause.reason()
    );
    assert_eq!(home.look(30), None, "said once");
}

#[test]
fn a_report_without_a_decision_means_the_work_in_hand_if_it_is_of_its_room_and_time() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let first = home.decision(10);
    let room = |id: &'static str| move |report: &mut RobotReportV1| report.room = text::encode("room", id).unwrap();
    // Before it was sent there.
    home.report(9, report_kind::FINISHED, room("room-0"));
    assert_eq!(home.look(11), None);
    // Another room is done on the way.
    home.report(12, report_kind::FINISHED, room("room-2"));
    assert_eq!(home.look(13), None);
    home.report(14, report_kind::FINISHED, |_| ());
    let second = home.decision(14);
    assert_eq!((first.to(), second.to(), second.covered), ("room-0", "room-1", 0b101));
    // A late report about the first decision does not end the second.
    home.answer(15, report_kind::FAILED, &first);
    assert_eq!(home.look(16), None);
}

#[test]
fn a_robot_that_is_started_by_hand_is_at_work_where_it_says() {
    let mut home = Home::new(3, &PlannerConfig { repeat: false, ..Default::default() });
    home.sequence += 1;
    let scores = home.scores(S);
    home.planner.hear(&scores);
    home.report(1, report_kind::STARTED, |report| report.room = text::encode("room", "room-1").unwrap());
    assert_eq!(home.look(1), None, "it is busy");
    home.report(30, report_kind::FINISHED, |_| ());
    let decision = home.decision(30);
    assert_eq!((decision.from(), decision.to(), decision.covered), ("room-1", "room-0", 0b010));
    // It goes to another room than ordered.
    home.report(31, report_kind::STARTED, |report| report.room = text::encode("room", "room-2").unwrap());
    home.report(60, report_kind::FINISHED, |_| ());
    assert_eq!(home.decision(60).covered, 0b110);
}

#[test]
fn a_robot_with_a_low_battery_is_not_sent_out_before_it_is_ready() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let battery = |level: f64| {
        move |report: &mut RobotReportV1| (report.flags, report.battery) = (report_flags::HAS_BATTERY, level)
    };
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    home.report(3, report_kind::BATTERY, battery(0.1));
    assert_eq!(home.look(3), None, "it goes on with its work while it can");
    home.report(40, report_kind::DOCKED, battery(0.09));
    let pause = home.decision(40);
    assert_eq!((pause.action, pause.covered), (action::PAUSE, 0));
    assert_eq!(pause.reason(), "The battery is at 9 %: the robot charges until 50 %");
    home.report(150, report_kind::BATTERY, battery(0.49));
    assert_eq!(home.look(150), None);
    home.report(200, report_kind::BATTERY, battery(0.5));
    let next = home.decision(200);
    assert_eq!((next.action, next.to()), (action::GO, "room-1"), "what it has left comes after the others");
    // A person or the robot itself sent it out.
    home.report(201, report_kind::DOCKED, battery(0.2));
    assert_eq!(home.decision(201).action, action::PAUSE);
    home.report(250, report_kind::STARTED, |report| report.room = text::encode("room", "room-1").unwrap());
    home.report(270, report_kind::FINISHED, battery(0.18));
    assert_eq!(home.decision(270).action, action::GO);
}

/// A robot that is lost on its dock does not block work for ever, and the restarted planner knows the time of its last report.
#[test]
fn a_robot_that_charges_and_says_nothing_counts_as_charged() {
    let mut home = Home::new(2, &PlannerConfig { charge_timeout_s: 1000.0, ..PlannerConfig::default() });
    home.decision(1);
    let battery = |report: &mut RobotReportV1| (report.flags, report.battery) = (report_flags::HAS_BATTERY, 0.1);
    home.report(120, report_kind::DOCKED, battery);
    assert_eq!(home.decision(120).action, action::PAUSE);
    let kept = home.planner.kept("boot").unwrap();
    assert_eq!(home.look(1119), None);
    let next = home.decision(1120);
    assert!(
        next.has(decision_flags::ROBOT_SILENT) && next.reason().contains("it counts as charged"),
        "{}",
        next.reason()
    );
    assert_eq!(next.action, action::GO);
    // A restarted planner rounds to the minute.
    let config = PlannerConfig { charge_timeout_s: 1000.0, room_time_s: 100.0, ..PlannerConfig::default() };
    let mut again = Home { planner: Planner::new(&config, 2).with_kept(kept), ..Home::new(2, &config) };
    assert_eq!(again.decision(200).action, action::PAUSE);
    assert_eq!(again.look(1119), None);
    assert_eq!(again.decision(1120).action, action::GO);
}

/// Failed rooms, and rooms left to a person, survive a restart.
#[test]
fn a_restarted_planner_knows_which_rooms_failed_and_which_are_left_to_somebody() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    home.likely = vec![0.9, 0.0, 0.0];
    home.look(3);
    let second = home.decision(6);
    assert!(second.has(decision_flags::INTERRUPTED) && second.to() == "room-1");
    home.answer(7, report_kind::BLOCKED, &second);
    assert_eq!(home.decision(8).to(), "room-2");
    let kept = home.planner.kept("boot").unwrap();
    let text = serde_json::to_string(&kept).unwrap();
    assert!(text.contains(r#""failed":[["room-1",7000000000,1]],"held":["room-0"]"#), "{text}");
    let config = PlannerConfig { room_time_s: 100.0, ..PlannerConfig::default() };
    let planner = Planner::new(&config, 2).with_kept(kept.clone());
    let mut again = Home { planner, likely: vec![0.5, 0.0, 0.0], reports: home.reports, ..Home::new(3, &config) };
    again.look(9);
    assert_eq!(
        again.planner.kept("boot").map(|kept| serde_json::to_string(&kept).unwrap().contains(r#""held":["room-0"]"#)),
        Some(true)
    );
    again.report(20, report_kind::FINISHED, |report| report.room = text::encode("room", "room-2").unwrap());
    let next = again.decision(20);
    assert_ne!(next.to(), "room-0", "somebody may still be there");
}

/// A reporter's service repeats its last reports for a planner that joins; the saved round knows them.
#[test]
fn a_restarted_planner_takes_no_report_of_work_twice() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let mut said = Vec::new();
    let mut says = |planner: &mut Planner, at_s: u64, kind: u32, decision: Option<&DecisionV1>| {
        let (decision_epoch, decision_sequence) = decision.map_or((0, 0), |asked| (asked.epoch, asked.sequence));
        let report = RobotReportV1 {
            robot: sequence::source_of_name("robot"),
            epoch: 77,
            sequence: 1 + said.len() as u64,
            reported_ns: at_s * S,
            kind,
            room: decision.map_or([0; 48], |asked| asked.to),
            decision_epoch,
            decision_sequence,
            ..Default::default()
        };
        planner.take_report(&report, BootNs(at_s * S)).unwrap();
        said.push(report);
    };
    let first = home.decision(1);
    says(&mut home.planner, 2, report_kind::STARTED, Some(&first));
    home.likely = vec![0.9, 0.0, 0.0];
    home.look(3);
    let second = home.decision(6);
    assert!(second.has(decision_flags::INTERRUPTED) && second.to() == "room-1");
    says(&mut home.planner, 50, report_kind::FINISHED, Some(&second));
    says(&mut home.planner, 51, report_kind::DOCKED, None);
    let kept = home.planner.kept("boot").unwrap();
    let config = PlannerConfig { room_time_s: 100.0, ..PlannerConfig::default() };
    home.planner = Planner::new(&config, 2).with_kept(kept.clone());
    home.planner.hear(&home.scores(52 * S));
    for report in &said {
        home.planner.take_report(report, BootNs(52 * S)).unwrap();
    }
    assert_eq!(home.planner.kept("boot"), Some(kept));
}

/// A room that is nearly free is done before the round ends, although the house is nearly empty.
#[test]
fn a_nearly_free_room_is_not_left_undone() {
    let mut home = Home::new(2, &PlannerConfig::default());
    home.planner =
        Planner::new(&PlannerConfig { room_time_s: 600.0, round_s: Some(1200.0), ..PlannerConfig::default() }, 1);
    home.likely = vec![0.0, 0.1];
    assert_eq!(home.decision(1).to(), "room-0");
    let last = home.decision(602);
    assert_eq!((last.action, last.to()), (action::GO, "room-1"), "{}", last.reason());
}

#[test]
fn a_dock_alone_keeps_no_robot_in() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let first = home.decision(1);
    home.report(2, report_kind::DOCKED, |_| ());
    assert_eq!(home.look(2), None, "it has not left yet");
    home.answer(3, report_kind::STARTED, &first);
    home.report(4, report_kind::DOCKED, |_| ());
    assert_eq!(home.decision(4).to(), "room-1", "it came back before its work was done");
}

#[test]
fn a_robot_that_says_nothing_for_too_long_gives_its_room_up() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    // Its stay ends at 102 s, and its patience 120 s later.
    assert_eq!(home.look(221), None);
    let next = home.decision(222);
    assert!(next.has(decision_flags::ROBOT_SILENT) && next.cancels == first.sequence && next.covered == 0);
    assert_eq!(
        (next.to(), next.reason().starts_with("The robot says nothing of its work in the room 0")),
        ("room-1", true)
    );
    home.answer(230, report_kind::STARTED, &next);
    home.answer(240, report_kind::FINISHED, &next);
    let waits = home.decision(240);
    assert_eq!((waits.to(), waits.action, waits.has(decision_flags::ROBOT_SILENT)), ("room-1", action::STAY, false));
    let heard = home.decision(282);
    assert_eq!((heard.to(), heard.cancels), ("room-0", waits.sequence), "a minute after it was given up");
    // A robot that reports is not silent, however long it takes.
    home.answer(283, report_kind::STARTED, &heard);
    for at_s in (300..1000).step_by(100) {
        home.report(at_s, report_kind::POSITION, |report| report.room = text::encode("room", "room-0").unwrap());
        assert_eq!(home.look(at_s), None);
    }
}

#[test]
fn somebody_who_comes_in_interrupts_and_the_room_is_done_later() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let first = home.decision(1);
    assert_eq!(first.to(), "room-0");
    home.likely = vec![0.9, 0.0, 0.0];
    assert_eq!(home.look(10), None);
    assert_eq!(home.look(11), None);
    let second = home.decision(12);
    assert!(second.has(decision_flags::INTERRUPTED), "{second:?}");
    assert_eq!((second.cancels, second.to(), second.covered), (first.sequence, "room-1", 0));
    let begin = "A person came into the room 0 (90 %), so the work there stops. It goes to the room 1: works here";
    assert!(second.reason().starts_with(begin), "{}", second.reason());
    // The person may still be there.
    home.likely = vec![0.4, 0.0, 0.0];
    assert_eq!(home.decision(112).to(), "room-2");
    let waits = home.decision(212);
    assert!(waits.reason().contains("Waits in a room that is done"), "{}", waits.reason());
    assert_eq!((waits.action, waits.to()), (action::STAY, "room-2"), "no needless way");
    // The person has left: the robot waits no longer.
    home.likely = vec![0.1, 0.0, 0.0];
    let last = home.decision(220);
    assert_eq!((last.to(), last.cancels, last.covered), ("room-0", waits.sequence, 0b110));
}

#[test]
fn where_somebody_is_everywhere_the_robot_pauses() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let first = home.decision(1);
    home.likely = vec![0.9, 0.8];
    home.look(10);
    let pause = home.decision(12);
    assert!(pause.has(decision_flags::INTERRUPTED) && pause.action == action::PAUSE && pause.cancels == first.sequence);
    assert_eq!(home.look(20), None);
    home.likely = vec![0.9, 0.1];
    assert_eq!(home.decision(30).to(), "room-1");
}

#[test]
fn a_home_without_knowledge_is_equally_free_everywhere() {
    let config = PlannerConfig { know_s: 0.0, room_time_s: 10.0, ..Default::default() };
    let mut home = Home::new(3, &config);
    // The model's scores after an unknown past are not about persons of this home.
    (home.likely, home.flags) = (vec![0.7, 0.2, 0.1], forecast_flags::NOT_KNOWN);
    let decision = home.decision(1);
    assert!(decision.has(decision_flags::NOT_KNOWN));
    assert!((decision.probability - 1.0 / 3.0).abs() < 1e-9, "{}", decision.probability);
    assert!(decision.reason().starts_with("Nothing is known of anybody, so every room counts alike: "));
    assert_eq!(decision.to(), "room-0", "the likeliest room of the model's is as good as any");
    // Without a forecast, the scores decide.
    for policy in PolicyName::ALL {
        let mut planner = Planner::new(&PlannerConfig { policy, ..config.clone() }, 1);
        let unknown = RoomScoresV1 { flags: score_flags::NO_NARRATION, ..scores(1, S, &[0.7, 0.2, 0.1]) };
        planner.hear(&unknown);
        let decision = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
        assert!(decision.has(decision_flags::NOT_KNOWN) && (decision.probability - 1.0 / 3.0).abs() < 1e-9, "{policy}");
    }
}

#[test]
fn a_home_without_people_is_free() {
    let mut home = Home::new(2, &PlannerConfig::default());
    home.flags = forecast_flags::NOBODY_HOME;
    let decision = home.decision(1);
    assert!(decision.has(decision_flags::NOBODY_HOME) && decision.reason().starts_with("Nobody is home: "));
}

#[test]
fn the_last_stay_of_a_round_leaves_an_occupied_room_to_the_next_one() {
    let round = |forced, likely: f32| {
        let config = PlannerConfig { forced, round_s: Some(200.0), ..Default::default() };
        let mut home = Home::new(2, &config);
        home.likely = vec![likely, 0.0];
        assert_eq!(home.decision(1).to(), "room-1");
        home.decision(101)
    };
    // The price of a room, 42 s, is more than the expected cost of the stay at 40 %, and less than at 70 %.
    let enters = round(Forced::Skip, 0.4);
    assert_eq!((enters.to(), enters.has(decision_flags::DEADLINE)), ("room-0", true));
    assert!(enters.reason().contains("The deadline leaves no later time for this room (40 % occupied): "));
    // Two people, which makes a room left undone more expensive.
    for (forced, to) in [(Forced::Skip, "room-1"), (Forced::Enter, "room-0")] {
        let config = PlannerConfig { forced, room_time_s: 40.0, round_s: Some(80.0), ..Default::default() };
        let mut planner = Planner::new(&config, 1);
        let mut last = None;
        for at_s in [1, 41] {
            let scores = scores(at_s, at_s * S, &[0.9, 0.0]);
            planner.hear(&scores);
            planner.hear_forecast(&forecast(&scores, &[[0.9, 0.9], [0.0, 0.0]]));
            last = planner.decide(BootNs(at_s * S), UnixNs(0)).unwrap();
        }
        let last = last.unwrap();
        assert_eq!((last.to(), last.has(decision_flags::DEADLINE)), (to, forced == Forced::Enter), "{}", last.reason());
        let left = last.reason().contains("Left to the next round, since somebody is likely there: room 0");
        assert_eq!(left, forced == Forced::Skip, "{}", last.reason());
    }
}

#[test]
fn positions_mean_rooms_of_the_map_in_use_and_no_other() {
    let scene = r#"{"format": "roomcast-scene", "version": 1, "name": "two", "items": [], "rooms": [
        {"id": "room-0", "label": "kitchen", "box": {"min_m": [0, 0, 0], "max_m": [4, 4, 3]}},
        {"id": "room-1", "label": "bedroom", "box": {"min_m": [4, 0, 0], "max_m": [8, 4, 3]}}]}"#;
    let map = SemanticMap::from_json(scene).unwrap();
    let of_map = |fingerprint| RoomScoresV1 { map_fingerprint: fingerprint, ..scores(1, S, &[0.0, 0.0]) };
    let report = |sequence, x: f64| RobotReportV1 {
        robot: sequence::source_of_name("robot"),
        epoch: 3,
        sequence,
        reported_ns: sequence * S,
        flags: report_flags::HAS_POSITION,
        position_m: [x, 1.0, 0.1],
        ..Default::default()
    };
    let mut planner = planner(PolicyName::CoverageAware, true).with_map(map.clone(), PartitionLevel::Room);
    planner.hear(&of_map(map.fingerprint()));
    for (sequence, (x, room)) in (1..).zip([(5.0, Some(1)), (1.0, Some(0)), (9.0, None)]) {
        planner.take_report(&report(sequence, x), BootNs(9 * S)).unwrap();
        assert_eq!(planner.room(), room, "{x}");
    }
    let named = RobotReportV1 { room: text::encode("room", "Bedroom").unwrap(), flags: 0, ..report(4, 0.0) };
    planner.take_report(&named, BootNs(9 * S)).unwrap();
    assert_eq!(planner.room(), Some(1), "by its name in the map");
    let unknown = RobotReportV1 { room: text::encode("room", "attic").unwrap(), flags: 0, ..report(5, 0.0) };
    let fault = planner.take_report(&unknown, BootNs(9 * S)).unwrap_err().to_string();
    assert!(fault.contains("`attic`") && fault.contains("room-0, room-1"), "{fault}");

    // `scene apply` may have moved a thing: the rooms count.
    let mut changed = Planner::new(&PlannerConfig::default(), 1).with_map(map.clone(), PartitionLevel::Room);
    changed.hear(&of_map([9; 32]));
    changed.take_report(&report(1, 5.0), BootNs(9 * S)).unwrap();
    assert_eq!(changed.room(), Some(1));

    let mut other = Planner::new(&PlannerConfig::default(), 1).with_map(map, PartitionLevel::Room);
    let mut of_other = of_map([9; 32]);
    of_other.room[1].id = text::encode("id", "attic").unwrap();
    other.hear(&of_other);
    assert_eq!(other.take_report(&report(1, 5.0), BootNs(9 * S)), Err(ReportFault::OtherMap));
    assert_eq!(other.room(), None);
}

/// A misspelt room counted as the robot's current room. An unknown decision gives no room.
#[test]
fn a_report_of_an_unknown_room_or_decision_does_not_end_the_work() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    let of = |sequence, room, decision_sequence| RobotReportV1 {
        robot: sequence::source_of_name("robot"),
        epoch: 78,
        sequence,
        reported_ns: 5 * S,
        kind: report_kind::FINISHED,
        room: text::encode("room", room).unwrap(),
        decision_sequence,
        ..Default::default()
    };
    let mut fault = |report| home.planner.take_report(&report, BootNs(5 * S)).unwrap_err();
    assert!(matches!(fault(of(1, "attic", 0)), ReportFault::UnknownRoom { .. }));
    assert_eq!(fault(of(2, "", 12_345)), ReportFault::UnknownDecision { decision: 12_345 });
    assert_eq!(home.look(6), None, "it is still at work");
    home.answer(7, report_kind::FINISHED, &first);
    assert_eq!(home.decision(7).covered.count_ones(), 1);
}

#[test]
fn reports_of_other_robots_and_reports_heard_before_change_nothing() {
    let mut home = Home::new(2, &PlannerConfig::default());
    let first = home.decision(1);
    home.report(2, report_kind::FINISHED, |report| report.robot = 5);
    assert_eq!(home.look(2), None);
    home.answer(3, report_kind::FINISHED, &first);
    let second = home.decision(3);
    home.reports -= 1;
    home.report(4, report_kind::FINISHED, |_| ());
    assert_eq!(home.look(4), None, "it was heard before");
    // A number from the future does not make the planner trust the robot for ever.
    home.answer(5, report_kind::STARTED, &second);
    home.report(5, report_kind::POSITION, |report| report.reported_ns = u64::MAX);
    assert!(home.decision(900).has(decision_flags::ROBOT_SILENT));
}

#[test]
fn a_restarted_planner_goes_on_with_the_round() {
    for (reports, of_the_first) in [(false, false), (true, false), (true, true)] {
        let config = PlannerConfig { room_time_s: 100.0, ..Default::default() };
        let mut home = Home::new(3, &config);
        let first = home.decision(1);
        if reports {
            home.answer(2, report_kind::STARTED, &first);
            home.answer(101, report_kind::FINISHED, &first);
        }
        let second = home.decision(101);
        assert_eq!(second.covered, 0b001);
        home.restart(&config);
        let again = home.decision(131);
        assert_eq!((again.to(), again.covered, again.cancels), (second.to(), 0b001, 0));
        assert_eq!((again.stay_ns, again.has(decision_flags::REPORTED)), (70 * S, reports));
        assert_eq!(home.look(132), None);
        if reports {
            // The robot may know the first planner's decision, or the second's.
            let heard = if of_the_first { &second } else { &again };
            home.answer(201, report_kind::FINISHED, heard);
        }
        assert_eq!(home.decision(201).covered, 0b011);
    }
}

/// A robot continued to work among people that entered its room while its planner was down.
#[test]
fn who_came_while_the_planner_was_down_interrupts_and_who_was_there_before_does_not() {
    let config = PlannerConfig { room_time_s: 100.0, ..Default::default() };
    for (likely_before, by_hand) in [(0.0, false), (0.0, true), (0.9, true)] {
        let mut home = Home::new(2, &config);
        let first = home.decision(1);
        if by_hand {
            home.likely = vec![0.0, likely_before];
            home.report(2, report_kind::STARTED, |report| report.room = text::encode_cut("room-1"));
        } else {
            home.answer(2, report_kind::STARTED, &first);
        }
        home.look(3);
        home.restart(&config);
        home.likely = if by_hand { vec![0.0, 0.9] } else { vec![0.9, 0.0] };
        let stops = (31..35).filter_map(|at_s| home.look(at_s)).filter(|told| told.has(decision_flags::INTERRUPTED));
        assert_eq!(stops.count(), usize::from(likely_before < 0.5), "{likely_before} {by_hand}");
    }
}

/// A robot that a person started by hand also avoids persons after its round is over.
#[test]
fn work_after_the_last_round_is_interrupted_too() {
    let mut home = Home::new(1, &PlannerConfig { repeat: false, ..Default::default() });
    let only = home.decision(1);
    home.answer(2, report_kind::STARTED, &only);
    home.answer(90, report_kind::FINISHED, &only);
    assert!(home.decision(90).has(decision_flags::COVERED));
    home.report(100, report_kind::STARTED, |report| report.room = only.to);
    assert_eq!(home.look(101), None);
    home.likely = vec![0.9];
    assert_eq!(home.look(110), None);
    let stop = home.decision(120);
    assert!(stop.has(decision_flags::INTERRUPTED) && stop.action == action::PAUSE, "{}", stop.reason());
    assert_eq!(home.look(121), None);
}

/// Without work the robot is not sent to work, even if it is to wait in another room.
#[test]
fn a_room_to_wait_in_is_no_room_to_work_in() {
    let mut home = Home::new(3, &PlannerConfig::default());
    let (first, second) = (home.decision(1), home.decision(101));
    assert_eq!((first.to(), second.to()), ("room-0", "room-1"));
    // A person comes into the robot's room and is likely in the other undone room: the robot waits in its earlier place.
    home.likely = vec![0.0, 0.9, 0.9];
    home.look(110);
    let waits = home.decision(112);
    assert_eq!((waits.from(), waits.to(), waits.covered), ("room-1", "room-0", 0b001));
    assert_eq!((waits.action, waits.cancels), (action::STAY, second.sequence), "{}", waits.reason());
    assert!(waits.reason().contains("waits in a room that is done"), "{}", waits.reason());
    // The wait ends with the scores, not with its time.
    let silent = home.planner.decide(BootNs(118 * S), UnixNs(0)).unwrap().unwrap();
    assert!(silent.has(decision_flags::FALLBACK | decision_flags::DAEMON_SILENT), "{}", silent.reason());
    assert_eq!(silent.cancels, waits.sequence);
    // Work follows as soon as it is possible.
    home.likely = vec![0.0, 0.9, 0.0];
    assert_eq!((home.decision(120).action, home.planner.room()), (action::GO, Some(2)));
}

/// A waiting robot makes way for a robot that comes to work, and waits in a room without another robot.
#[test]
fn a_robot_waits_where_no_other_robot_is() {
    let other = |action, sequence, to: &str, at_s: u64| DecisionV1 {
        robot: u64::MAX,
        epoch: 1,
        sequence,
        decided_ns: at_s * S,
        stay_ns: 100 * S,
        action,
        to: text::encode("to", to).unwrap(),
        ..Default::default()
    };
    let mut home = Home::new(3, &PlannerConfig { avoid_robots: true, ..Default::default() });
    // A person is in room-0, which is undone; the others are done.
    home.likely = vec![0.9, 0.0, 0.0];
    assert_eq!((home.decision(1).to(), home.decision(101).to()), ("room-1", "room-2"));
    home.planner.take_other(&other(action::STAY, 1, "room-2", 200), BootNs(200 * S));
    let waits = home.decision(201);
    assert_eq!((waits.action, waits.to()), (action::STAY, "room-1"), "{}", waits.reason());
    assert_eq!(home.look(210), None);
    home.planner.take_other(&other(action::GO, 2, "room-1", 220), BootNs(220 * S));
    let leaves = home.decision(221);
    assert_eq!((leaves.action, leaves.to(), leaves.cancels), (action::STAY, "room-2", waits.sequence));
    assert!(leaves.reason().starts_with("Another robot has the room 1, so it waits no longer there. "), "{leaves:?}");
    // Work has precedence over the other robot's wait.
    home.planner.take_other(&other(action::STAY, 3, "room-0", 230), BootNs(230 * S));
    home.likely = vec![0.0, 0.0, 0.0];
    assert_eq!((home.decision(231).action, home.planner.room()), (action::GO, Some(0)));
}

/// With every room done it waits for the next round, but leaves a room when a person enters.
#[test]
fn a_robot_that_waits_makes_room_for_who_comes() {
    let mut home = Home::new(3, &PlannerConfig { round_s: Some(1_000.0), ..Default::default() });
    home.likely = vec![0.0; 3];
    (0..3).for_each(|stay| assert_eq!(home.decision(1 + 100 * stay).action, action::GO));
    let waits = home.decision(301);
    assert_eq!((waits.action, waits.covered), (action::STAY, 0b111), "{}", waits.reason());
    let room = (0..3).find(|room| waits.to() == format!("room-{room}")).unwrap();
    assert_eq!(home.look(310), None);
    home.likely[room] = 0.9;
    let leaves = home.look(312).unwrap();
    assert_ne!(leaves.to(), waits.to(), "{}", leaves.reason());
    assert_eq!(home.look(313), None);
}

/// One person is on the sofa, and by the forecast no other room is ever quite empty. Rooms that are likely empty are done, one after the
/// other.
#[test]
fn rooms_that_are_likely_empty_are_done_without_waiting() {
    for (likely_later, works) in [(0.002, true), (0.06, true)] {
        let mut planner = Planner::new(&PlannerConfig { reports: Reports::Always, ..Default::default() }, 1);
        // The living room, and seven others; the last of them slowly becomes emptier.
        let now = [0.92, 0.004, 0.006, 0.008, 0.01, 0.012, 0.015, 0.025];
        for stay in 0..7 {
            let now_ns = (1 + 300 * stay) * S;
            let scores = scores(stay + 1, now_ns, &now.map(f64::from));
            planner.hear(&scores);
            let mut curves = now.map(|p: f32| [p, p]);
            curves[7][1] = likely_later;
            let mut told = forecast(&scores, &curves);
            told.horizon_s[1] = 3600.0;
            planner.hear_forecast(&told);
            let decision = planner.decide(BootNs(now_ns), UnixNs(0)).unwrap().unwrap();
            assert_eq!(decision.action == action::GO, works, "stay {stay}: {}", decision.reason());
            assert!(decision.to() != "room-0" && decision.covered.count_ones() as u64 == stay, "{}", decision.reason());
            let report = RobotReportV1 {
                robot: sequence::source_of_name("robot"),
                epoch: 77,
                sequence: stay + 1,
                reported_ns: now_ns + 290 * S,
                kind: report_kind::FINISHED,
                decision_epoch: decision.epoch,
                decision_sequence: decision.sequence,
                ..Default::default()
            };
            planner.take_report(&report, BootNs(now_ns + 290 * S)).unwrap();
        }
    }
}

/// The planner asks for a report that came while no planner was running; it does not wait for it.
#[test]
fn a_restarted_planner_asks_for_the_report_that_is_owed() {
    let config = PlannerConfig { room_time_s: 100.0, ..Default::default() };
    let mut home = Home::new(3, &config);
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    home.restart(&config);
    let again = home.decision(150);
    assert_eq!((again.to(), again.action, again.stay_ns), (first.to(), action::GO, 0));
    assert!(again.has(decision_flags::OWED));
    assert!(again.reason().contains("Asks what became of"), "{}", again.reason());
    assert_eq!(home.look(151), None);
    home.answer(152, report_kind::FINISHED, &again);
    let next = home.decision(152);
    assert!(next.to() != first.to() && next.covered.count_ones() == 1, "{} {:b}", next.to(), next.covered);
}

/// This holds for every decision, not only if rooms are weighed.
#[test]
fn every_decision_upon_scores_says_whether_anybody_is_known_and_home() {
    let known = decision_flags::NOT_KNOWN | decision_flags::NOBODY_HOME;
    for (said, told) in [
        (forecast_flags::NOBODY_HOME, decision_flags::NOBODY_HOME),
        (forecast_flags::NOT_KNOWN, decision_flags::NOT_KNOWN),
        (0, 0),
    ] {
        let config = PlannerConfig { repeat: false, know_s: 0.0, ..Default::default() };
        let mut home = Home::new(1, &config);
        home.flags = said;
        let go = home.decision(1);
        home.report(2, report_kind::BATTERY, |report| {
            (report.battery, report.flags) = (0.1, report_flags::HAS_BATTERY)
        });
        home.answer(3, report_kind::FAILED, &go);
        let pause = home.decision(3);
        home.report(4, report_kind::BATTERY, |report| {
            (report.battery, report.flags) = (0.9, report_flags::HAS_BATTERY)
        });
        let again = home.decision(104);
        let kept = home.planner.kept("boot").unwrap();
        home.planner = Planner::new(&PlannerConfig { room_time_s: 100.0, ..config }, 2).with_kept(kept);
        let goes_on = home.decision(105);
        home.answer(106, report_kind::FINISHED, &goes_on);
        let done = home.decision(106);
        let decided = [go, pause, again, goes_on, done];
        assert_eq!(decided.map(|d| d.action), [action::GO, action::PAUSE, action::GO, action::GO, action::STAY]);
        assert_eq!(decided.map(|d| d.flags & known), [told; 5]);
    }
}

/// The service's history holds reports of any age.
#[test]
fn what_failed_before_the_round_is_no_failure_of_it() {
    for kind in [report_kind::FAILED, report_kind::BLOCKED, report_kind::CANCELLED] {
        let mut home = Home::new(2, &PlannerConfig::default());
        home.look(100);
        home.report(101, kind, |report| {
            report.reported_ns = 50 * S;
            report.room = text::encode("room", "room-1").unwrap();
        });
        assert!(!home.planner.round.has_failed(1), "{kind}");
        home.report(102, kind, |report| report.room = text::encode("room", "room-1").unwrap());
        assert!(home.planner.round.has_failed(1), "{kind}");
    }
}

/// A restarted planner does not send a robot that waits in a completed room to work there.
#[test]
fn a_restarted_planner_lets_its_robot_wait() {
    let config = PlannerConfig { room_time_s: 100.0, ..Default::default() };
    let mut home = Home::new(2, &config);
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    home.likely = vec![0.0, 0.9];
    home.answer(90, report_kind::FINISHED, &first);
    let waits = home.decision(90);
    assert_eq!((waits.action, waits.to(), waits.covered), (action::STAY, "room-0", 0b01), "{}", waits.reason());
    home.restart(&config);
    let again = home.decision(100);
    assert_eq!((again.action, again.to(), again.covered), (action::STAY, "room-0", 0b01), "{}", again.reason());
    // The person has left: the robot gets work at once.
    home.likely = vec![0.0, 0.0];
    let next = home.decision(110);
    assert_eq!((next.action, next.to()), (action::GO, "room-1"), "{}", next.reason());
}

#[test]
fn a_kept_round_of_another_map_is_left() {
    let mut home = Home::new(2, &PlannerConfig::default());
    home.decision(1);
    home.decision(101);
    let kept = home.planner.kept("boot").unwrap();
    let mut planner = planner(PolicyName::CoverageAware, true).with_kept(kept);
    planner.hear(&RoomScoresV1 { map_fingerprint: [1; 32], ..scores(1, 150 * S, &[0.0, 0.0]) });
    assert_eq!(planner.decide(BootNs(150 * S), UnixNs(0)).unwrap().unwrap().covered, 0);
}

/// If the configuration says so, a room in a person's set is not entered, and a robot without another room pauses.
#[test]
fn rooms_of_the_sets_are_not_entered() {
    let of = |avoid_sets| PlannerConfig {
        policy: PolicyName::UncoveredFirst,
        room_time_s: 10.0,
        avoid_sets,
        ..Default::default()
    };
    // By the scores alone the robot would go to room 0.
    let scores = scores(1, S, &[0.1, 0.5, 0.4]);
    let mut sets = PersonForecastsV1 {
        epoch: scores.epoch,
        sequence: scores.sequence,
        computed_ns: S,
        published_ns: S,
        room_count: 3,
        horizon_count: 2,
        person_count: 1,
        ..Default::default()
    };
    sets.horizon_s[1] = 60.0;
    (0..3).for_each(|room| sets.id[room] = scores.room[room].id);
    sets.person[0].set_coverage = 0.9;
    sets.person[0].room_set[1] = 0b011;
    let decide = |avoid_sets, sets: &PersonForecastsV1| {
        let mut planner = Planner::new(&of(avoid_sets), 1);
        planner.hear(&scores);
        planner.hear_sets(sets);
        planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap()
    };
    assert_eq!(decide(false, &sets).to(), "room-0");
    assert_eq!(decide(true, &sets).to(), "room-2");
    sets.person[0].room_set[0] = 0b100;
    let nowhere = decide(true, &sets);
    assert_eq!((nowhere.action, nowhere.to()), (action::PAUSE, ""));
    assert!(nowhere.reason().contains("by the room sets"), "{}", nowhere.reason());
    sets.person[0].set_coverage = 0.0;
    assert_eq!(decide(true, &sets).to(), "room-0", "nothing was learned yet");
}

/// The daemon sends scores first and sets last: the sets from before an event allow no room after it.
#[test]
fn no_room_is_entered_by_the_sets_of_the_event_before() {
    for room_time_s in [10.0, 0.0] {
        let config =
            PlannerConfig { policy: PolicyName::UncoveredFirst, room_time_s, avoid_sets: true, ..Default::default() };
        let mut planner = Planner::new(&config, 1);
        let sets = |of: &RoomScoresV1, rooms: u64| {
            let mut sets = PersonForecastsV1 {
                epoch: of.epoch,
                sequence: of.sequence,
                computed_ns: of.published_ns,
                published_ns: of.published_ns,
                room_count: of.room_count,
                horizon_count: 1,
                person_count: 1,
                ..Default::default()
            };
            of.rooms().iter().zip(&mut sets.id).for_each(|(room, id)| *id = room.id);
            (sets.person[0].set_coverage, sets.person[0].room_set[0]) = (0.9, rooms);
            sets
        };
        // Without sets no room is entered, and the planner says so once.
        let first = scores(1, S, &[0.1, 0.5, 0.4]);
        planner.hear(&first);
        assert!(planner.lacks_sets(BootNs(S)));
        let without = planner.decide(BootNs(S), UnixNs(0)).unwrap().unwrap();
        assert_eq!((without.action, without.to()), (action::PAUSE, ""));
        assert!(without.reason().contains("It is not known which rooms are in somebody's set"), "{}", without.reason());
        assert_eq!(planner.decide(BootNs(S + 1), UnixNs(0)).unwrap(), None);
        // The sets come, and the robot goes at once.
        planner.hear_sets(&sets(&first, 0b010));
        assert!(!planner.lacks_sets(BootNs(S + 2)));
        assert_eq!(planner.decide(BootNs(S + 2), UnixNs(0)).unwrap().unwrap().to(), "room-0");
        // A person moves, and the new sets are still on their way.
        let second = scores(2, 12 * S, &[0.1, 0.5, 0.4]);
        planner.hear(&second);
        planner.hear_sets(&PersonForecastsV1 { published_ns: 12 * S, ..sets(&first, 0b010) });
        assert!(planner.lacks_sets(BootNs(12 * S)));
        assert_eq!(planner.decide(BootNs(12 * S), UnixNs(0)).unwrap().unwrap().action, action::PAUSE);
        planner.hear_sets(&sets(&second, 0b101));
        assert_eq!(planner.decide(BootNs(12 * S + 1), UnixNs(0)).unwrap().unwrap().to(), "room-1");
        // Sets that were not renewed are stale.
        let third = RoomScoresV1 { published_ns: 23 * S, ..scores(2, 12 * S, &[0.1, 0.5, 0.4]) };
        planner.hear(&third);
        assert!(planner.lacks_sets(BootNs(23 * S)));
        if let Some(decision) = planner.decide(BootNs(23 * S), UnixNs(0)).unwrap() {
            assert_eq!(decision.action, action::PAUSE);
        }
    }
}

/// When the daemon fell silent, a robot that had made way for a person got an order to wait next to that person.
#[test]
fn the_fallback_of_a_robot_that_pauses_is_to_pause() {
    for silent in [false, true] {
        let mut home = Home::new(2, &PlannerConfig { interrupt_after_s: 0.0, ..PlannerConfig::default() });
        let first = home.decision(1);
        home.answer(2, report_kind::STARTED, &first);
        home.likely = vec![0.9, 0.9];
        let paused = (3..60).find_map(|at_s| home.look(at_s)).unwrap();
        assert_eq!((paused.action, paused.from()), (action::PAUSE, first.to()));
        if silent {
            let fallback = home.planner.decide(BootNs(1000 * S), UnixNs(0)).unwrap().unwrap();
            fallback.check().unwrap();
            assert!(fallback.has(decision_flags::FALLBACK | decision_flags::DAEMON_SILENT));
            assert_eq!((fallback.action, fallback.to()), (action::PAUSE, ""));
            assert!(
                fallback.reason().ends_with(": the robot had paused, and goes on pausing"),
                "{}",
                fallback.reason()
            );
            assert_eq!(home.planner.decide(BootNs(1001 * S), UnixNs(0)).unwrap(), None, "said once");
            // The reason of its pause is checked again.
            assert_eq!(home.decision(1002).flags & decision_flags::FALLBACK, 0);
        }
    }
}

/// A person pressed the button for another room. The answer to the earlier decision ended that room's work, which was not done.
#[test]
fn an_answer_to_a_decision_is_of_its_room_also_when_the_robot_is_at_another() {
    let mut home = Home::new(2, &PlannerConfig { reports: Reports::Always, ..PlannerConfig::default() });
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    let other = if first.to() == "room-0" { "room-1" } else { "room-0" };
    home.report(10, report_kind::STARTED, |report| report.room = text::encode("room", other).unwrap());
    home.answer(20, report_kind::FINISHED, &first);
    let done = |home: &Home| home.planner.round.covered().iter().position(|covered| *covered);
    let room = first.to().strip_prefix("room-").unwrap().parse().unwrap();
    assert_eq!(done(&home), Some(room));
    assert!(home.planner.robot.work.is_some(), "it is at the other one still");
}

/// A vacuum waits at its dock at the end of each round: that is not a failure of the room.
#[test]
fn a_robot_that_waits_and_goes_to_charge_has_failed_at_nothing() {
    let config = PlannerConfig { reports: Reports::Always, round_s: Some(36_000.0), ..PlannerConfig::default() };
    let mut home = Home::new(1, &config);
    let first = home.decision(1);
    home.answer(2, report_kind::STARTED, &first);
    home.answer(100, report_kind::FINISHED, &first);
    let waits = (101..200).find_map(|at_s| home.look(at_s)).unwrap();
    assert_eq!((waits.action, waits.to()), (action::STAY, first.to()));
    home.report(210, report_kind::DOCKED, |report| (report.battery, report.flags) = (0.1, report_flags::HAS_BATTERY));
    assert!(home.planner.robot.work.is_none() && home.planner.robot.charges);
    // In the next round its first failure counts as the first.
    home.planner.round.begin_again();
    home.planner.round.fail(0, BootNs(300 * S));
    assert_eq!(home.planner.round.failed().map(|(_, _, failures)| failures).collect::<Vec<_>>(), [1]);
}
