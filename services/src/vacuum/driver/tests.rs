use super::*;
use crate::config::{PlannerConfig, Reports, RobotKind};
use crate::fake_valetudo::{Doing, FakeValetudo};
use crate::lived_day::{HOURS, ROOM_S, mean, person_at, plain_schedules, segments};
use crate::planner::Planner;
use crate::reporter::Reporter;
use crate::vacuum::Dialect;
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::ids::UnixNs;
use roomcast_core::policy::PolicyName;
use roomcast_ipc::raw::{ForecastV1, RoomScoresV1};
use roomcast_ipc::{sequence, text};

const S: u64 = 1_000_000_000;
const ROOMS: [&str; 4] = ["bedroom-1", "hall-2", "kitchen-3", "office-4"];
const TOPIC: &str = "valetudo/fake";

fn config() -> RobotConfig {
    RobotConfig { topic: TOPIC.to_owned(), obey: true, ..RobotConfig::default() }
}

fn decision(sequence: u64, action: u32, room: &str) -> DecisionV1 {
    let to = text::encode("to", room).unwrap();
    DecisionV1 { robot: 7, epoch: 1, sequence, action, to, stay_ns: 600 * S, ..Default::default() }
}

/// A driver and the fake robot, second by second.
struct Pair {
    driver: Driver,
    robot: FakeValetudo,
    dialect: Dialect,
    now_s: u64,
    reports: Vec<Report>,
    /// The delay of commands, the ones on their way, and the ones that get lost.
    delay_s: u64,
    on_the_way: Vec<(u64, (String, String))>,
    lost: Vec<usize>,
    ordered: usize,
    away: bool,
}

impl Pair {
    fn new(config: &RobotConfig, seconds: f64) -> Self {
        let mut driver = Driver::new(config, 7);
        driver.know_rooms(ROOMS.into_iter());
        let mut pair = Self {
            driver,
            robot: FakeValetudo::new(TOPIC, &segments(seconds)),
            dialect: Dialect::new(config, "roomcast", "robot"),
            now_s: 0,
            reports: Vec::new(),
            delay_s: 0,
            on_the_way: Vec::new(),
            lost: Vec::new(),
            ordered: 0,
            away: false,
        };
        pair.pass(1);
        pair.reports.clear();
        pair
    }

    fn carry_out(&mut self, acts: Vec<Act>) {
        for act in acts {
            match act {
                Act::Order(order) => {
                    if !self.away && !self.lost.contains(&self.ordered) {
                        self.on_the_way.push((self.now_s + self.delay_s, self.dialect.order(&order)));
                    }
                    self.ordered += 1;
                }
                Act::Report(report) => self.reports.push(report),
            }
        }
        self.arrive();
    }

    /// Delivers commands after their delay.
    fn arrive(&mut self) {
        let now_s = self.now_s;
        for (_, (topic, payload)) in self.on_the_way.extract_if(.., |(due_s, _)| *due_s <= now_s) {
            self.robot.hear(&topic, &payload);
        }
    }

    fn decide(&mut self, decision: &DecisionV1) {
        let acts = self.driver.decide(decision, BootNs(self.now_s * S));
        self.carry_out(acts);
    }

    /// The broker goes, or returns and sends its retained messages.
    fn be_away(&mut self, away: bool) {
        self.away = away;
        let acts = self.driver.link(!away, BootNs(self.now_s * S));
        self.carry_out(acts);
        if !away {
            self.hear_again();
        }
    }

    fn hear_again(&mut self) {
        for (topic, payload) in self.robot.say(true) {
            let sensed = self.dialect.hear(&topic, payload.as_bytes()).unwrap();
            let acts = self.driver.sense(sensed, BootNs(self.now_s * S));
            self.carry_out(acts);
        }
    }

    fn start_again(&mut self, config: &RobotConfig) {
        self.driver = Driver::new(config, 7);
        self.driver.know_rooms(ROOMS.into_iter());
    }

    fn pass(&mut self, seconds: u64) {
        for _ in 0..seconds {
            self.now_s += 1;
            self.arrive();
            self.robot.pass(1.0);
            let said = self.robot.say(false).into_iter().filter(|_| !self.away).collect::<Vec<_>>();
            for (topic, payload) in said {
                if let Some(sensed) = self.dialect.hear(&topic, payload.as_bytes()) {
                    let acts = self.driver.sense(sensed, BootNs(self.now_s * S));
                    self.carry_out(acts);
                }
            }
            let acts = self.driver.tick(BootNs(self.now_s * S));
            self.carry_out(acts);
        }
    }

    /// The reports about work, in order, with the decision that each answers.
    fn of_work(&mut self) -> Vec<(Kind, Option<u64>)> {
        let work = |report: &Report| !matches!(report.kind, Kind::Battery | Kind::Docked | Kind::Position);
        let told = self.reports.drain(..).filter(work).map(|report| (report.kind, report.decision));
        told.collect()
    }

    fn last_note(&self) -> String {
        self.reports.iter().rev().find_map(|report| report.note.clone()).unwrap_or_default()
    }
}

#[test]
fn a_room_is_done_when_the_robot_has_left_it_by_itself() {
    let mut pair = Pair::new(&config(), 300.0);
    pair.decide(&decision(1, action::GO, "kitchen-3"));
    pair.pass(5);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1))]);
    pair.pass(280);
    assert_eq!(pair.of_work(), [], "it is still at it");
    pair.pass(30);
    assert_eq!(pair.of_work(), [(Kind::Finished, Some(1))]);
    assert_eq!(
        (pair.robot.cleaned.as_slice(), pair.robot.orders.as_slice()),
        (&["3".to_owned()][..], &["clean 3".to_owned()][..])
    );
    // The next one, from wherever it is.
    pair.decide(&decision(2, action::GO, "office-4"));
    pair.pass(400);
    let docked = pair.reports.iter().filter(|report| report.kind == Kind::Docked).count();
    assert_eq!(pair.of_work(), [(Kind::Started, Some(2)), (Kind::Finished, Some(2))]);
    assert_eq!(docked, 1, "at its dock, after it has said that it is done");
    assert!(pair.reports.is_empty() && pair.driver.wish.is_none());
}

#[test]
fn orders_that_are_lost_are_given_again_and_in_the_end_have_failed() {
    let mut pair = Pair::new(&config(), 300.0);
    pair.robot.orders_ignored = 2;
    pair.decide(&decision(1, action::GO, "hall-2"));
    pair.pass(60);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1))]);
    pair.pass(400);
    assert_eq!(pair.of_work(), [(Kind::Finished, Some(1))]);
    pair.robot.orders_ignored = 4;
    pair.decide(&decision(2, action::GO, "kitchen-3"));
    pair.pass(100);
    assert!(pair.last_note().contains("does not do what it is told"), "{}", pair.last_note());
    assert_eq!(pair.of_work(), [(Kind::Failed, Some(2))]);
    assert_eq!(pair.robot.orders_ignored, 0, "the last order takes the others back");
}

#[test]
fn a_person_who_comes_in_sends_it_home_or_elsewhere() {
    for (on_pause, order, then) in [
        (OnPause::Return, Some("HOME"), Doing::Docked),
        (OnPause::Pause, Some("PAUSE"), Doing::Paused),
        (OnPause::GoOn, None, Doing::Cleaning),
    ] {
        let mut pair = Pair::new(&RobotConfig { on_pause, ..config() }, 600.0);
        pair.decide(&decision(1, action::GO, "hall-2"));
        pair.pass(60);
        pair.decide(&decision(2, action::PAUSE, ""));
        pair.pass(60);
        assert_eq!(pair.robot.orders.get(1).map(String::as_str), order);
        assert_eq!(pair.robot.doing, then, "{on_pause}");
        assert_eq!(pair.of_work(), [(Kind::Started, Some(1))], "the planner has taken the room back itself");
    }
    let mut pair = Pair::new(&config(), 600.0);
    pair.decide(&decision(1, action::GO, "hall-2"));
    pair.pass(60);
    pair.decide(&decision(2, action::GO, "office-4"));
    pair.pass(20);
    assert_eq!(pair.robot.orders, ["clean 2", "STOP", "clean 4"]);
    pair.pass(700);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Started, Some(2)), (Kind::Finished, Some(2))]);
    assert_eq!(pair.robot.cleaned, ["4"]);
}

#[test]
fn a_decision_to_stay_that_cancels_the_work_in_the_room_sends_the_robot_home() {
    for (cancels, doing) in [(1, Doing::Docked), (0, Doing::Cleaning)] {
        let mut pair = Pair::new(&config(), 600.0);
        pair.decide(&decision(1, action::GO, "hall-2"));
        pair.pass(60);
        let from = text::encode("from", "hall-2").unwrap();
        pair.decide(&DecisionV1 { cancels, from, ..decision(2, action::STAY, "hall-2") });
        pair.pass(60);
        assert_eq!(pair.robot.doing, doing, "cancels {cancels}");
    }
}

/// A person comes in before the robot has begun: even with late or lost commands, it does not clean the room.
#[test]
fn a_robot_that_was_only_told_to_clean_is_told_not_to() {
    let mut begun = 0;
    for on_pause in [OnPause::Return, OnPause::Pause] {
        for (delay_s, after_s, lost) in (0..12).flat_map(|delay_s| {
            (0..12).flat_map(move |after_s| [&[][..], &[1], &[1, 2], &[0]].map(|lost| (delay_s, after_s, lost)))
        }) {
            let mut pair = Pair::new(&RobotConfig { on_pause, ..config() }, 3600.0);
            (pair.delay_s, pair.lost) = (delay_s, lost.to_vec());
            pair.decide(&decision(1, action::GO, "hall-2"));
            pair.pass(after_s);
            pair.decide(&decision(2, action::PAUSE, ""));
            pair.pass(delay_s + 1);
            begun += usize::from(pair.robot.doing == Doing::Cleaning);
            pair.pass(120);
            let case =
                format!("{on_pause}: {delay_s} s late, after {after_s} s, {lost:?} lost: {:?}", pair.robot.orders);
            assert_ne!(pair.robot.doing, Doing::Cleaning, "{case}");
            // It gets no more commands then.
            let told = pair.robot.orders.len();
            pair.pass(300);
            assert_eq!((pair.robot.orders.len(), &pair.driver.state), (told, &State::Free), "{case}");
        }
    }
    assert!(begun > 0, "some have begun before they heard that they are not to");
}

/// A state on the way to work is not a reply.
#[test]
fn a_robot_that_leaves_its_dock_is_not_taken_for_one_that_has_stopped() {
    for (on_pause, order) in [(OnPause::Return, Order::Home), (OnPause::Pause, Order::Pause)] {
        let mut driver = Driver::new(&RobotConfig { on_pause, ..config() }, 7);
        driver.know_rooms(ROOMS.into_iter());
        let say = |driver: &mut Driver, sensed: Sensed, at_s: u64| {
            let acts = driver.sense(sensed, BootNs(at_s * S));
            acts.into_iter().filter(|act| matches!(act, Act::Order(_))).collect::<Vec<_>>()
        };
        say(&mut driver, Sensed::Segments(BTreeMap::from([("2".to_owned(), "hall".to_owned())])), 1);
        say(&mut driver, Sensed::Status(Status::Docked), 1);
        assert_eq!(driver.decide(&decision(1, action::GO, "hall-2"), BootNs(2 * S)).len(), 1);
        let told = [Act::Order(order)];
        assert_eq!(driver.decide(&decision(2, action::PAUSE, ""), BootNs(3 * S)), told);
        for status in [Status::Docked, Status::Idle] {
            assert_eq!(say(&mut driver, Sensed::Status(status), 4), []);
        }
        assert_eq!(say(&mut driver, Sensed::Status(Status::Cleaning), 5), told, "it is told again at once");
        assert_eq!(say(&mut driver, Sensed::Status(Status::Cleaning), 6), [], "and once");
        let then = if on_pause == OnPause::Return { Status::Returning } else { Status::Paused };
        say(&mut driver, Sensed::Status(then), 7);
        assert_eq!(driver.state, State::Free);
    }
}

/// The same with another room: the robot does not count as being there while it is in the first one.
#[test]
fn a_robot_that_was_only_told_to_clean_goes_to_another_room() {
    for (delay_s, lost) in (0..8).flat_map(|delay_s| [&[][..], &[1], &[0]].map(|lost| (delay_s, lost))) {
        let mut pair = Pair::new(&config(), 300.0);
        (pair.delay_s, pair.lost) = (delay_s, lost.to_vec());
        pair.decide(&decision(1, action::GO, "hall-2"));
        pair.pass(1);
        pair.decide(&decision(2, action::GO, "office-4"));
        pair.pass(600);
        assert_eq!(pair.robot.cleaned, ["4"], "{delay_s} s late, {lost:?} lost: {:?}", pair.robot.orders);
        assert_eq!(pair.of_work().last(), Some(&(Kind::Finished, Some(2))));
    }
}

#[test]
fn a_stuck_robot_has_failed_and_says_why() {
    let mut pair = Pair::new(&config(), 300.0);
    pair.robot.sticks = Some(("1".to_owned(), 600.0));
    pair.decide(&decision(1, action::GO, "bedroom-1"));
    pair.pass(10);
    assert!(pair.last_note().contains("Wheel lost floor contact"), "{}", pair.last_note());
    // The next room fails at once, without a command that a robot in an error would not follow.
    let orders = pair.robot.orders.len();
    pair.decide(&decision(2, action::GO, "hall-2"));
    pair.pass(1);
    assert_eq!((pair.robot.orders.len(), pair.of_work().last()), (orders, Some(&(Kind::Failed, Some(2)))));
    pair.pass(700);
    pair.decide(&decision(3, action::GO, "bedroom-1"));
    pair.pass(400);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(3)), (Kind::Finished, Some(3))]);
}

/// The planner waits until the battery is at `battery_ready`, which may be full.
#[test]
fn a_robot_at_its_dock_tells_each_hundredth_of_its_battery_up_to_full() {
    let mut driver = Driver::new(&config(), 7);
    let mut told = Vec::new();
    let mut sense = |driver: &mut Driver, sensed: Sensed, at_s: u64| {
        for act in driver.sense(sensed, BootNs(at_s * S)) {
            let Act::Report(report) = act else { continue };
            told.extend(report.battery);
        }
    };
    sense(&mut driver, Sensed::Status(Status::Docked), 1);
    let levels: Vec<f64> = (12..=100).map(|level| f64::from(level) / 100.0).collect();
    for (at_s, level) in levels.iter().enumerate() {
        sense(&mut driver, Sensed::Battery(*level), 2 + at_s as u64);
        sense(&mut driver, Sensed::Battery(*level), 2 + at_s as u64);
    }
    assert_eq!(told, levels, "each once");
    // Elsewhere a change of one twentieth counts as one, despite floating point.
    let mut driver = Driver::new(&config(), 7);
    let mut told = Vec::new();
    for level in (0..=100).rev() {
        for act in driver.sense(Sensed::Battery(f64::from(level) / 100.0), BootNs(S)) {
            let Act::Report(report) = act else { continue };
            told.extend(report.battery.map(|battery| (100.0 * battery).round() as u32));
        }
    }
    assert_eq!(told, (0..=20).rev().map(|step| 5 * step).collect::<Vec<_>>());
}

/// For the planner `docked` ends any fault of a robot. A robot that had stood there all along, and followed no command, was asked again
/// without a pause.
#[test]
fn a_docked_robot_that_follows_no_order_is_left_alone_for_longer_and_longer() {
    let planning = PlannerConfig { room_time_s: 600.0, ..PlannerConfig::default() };
    let number = sequence::source_of_name(&planning.robot);
    let (mut planner, mut reporter) = (Planner::new(&planning, 1), Reporter::new(&planning.robot, 9).unwrap());
    let mut driver = Driver::new(&config(), number);
    driver.know_rooms(ROOMS.into_iter());
    let forecaster = Forecaster::new(ROOMS.len(), ForecastOptions::default(), 0.0);
    let (mut failed_s, mut said_docked) = (Vec::<u64>::new(), 0);
    for second in 1..2 * 3600 {
        let mut acts = driver.tick(BootNs(second * S));
        if second == 1 {
            let known = segments(0.0).into_iter().map(|(segment, name, _)| (segment.to_owned(), name.to_owned()));
            acts.extend(driver.sense(Sensed::Segments(known.collect()), BootNs(S)));
            acts.extend(driver.sense(Sensed::Status(Status::Docked), BootNs(S)));
        }
        let (scores, forecast) = tell(&forecaster, second);
        planner.take(&scores, BootNs(second * S)).unwrap();
        planner.take_forecast(&forecast, BootNs(second * S)).unwrap();
        if let Some(decision) = planner.decide(BootNs(second * S), UnixNs(0)).unwrap() {
            acts.extend(driver.decide(&decision, BootNs(second * S)));
        }
        for act in acts {
            let Act::Report(report) = act else { continue };
            said_docked += usize::from(report.kind == Kind::Docked);
            failed_s.extend((report.kind == Kind::Failed).then_some(second));
            planner
                .take_report(&reporter.message(&report, BootNs(second * S), UnixNs(0)).unwrap(), BootNs(second * S))
                .unwrap();
        }
    }
    let gaps: Vec<u64> = failed_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    assert!(said_docked == 1 && failed_s.len() >= 8, "docked {said_docked} times, failed at {failed_s:?}");
    for (gap, minutes) in gaps.iter().skip(1).zip([1, 2, 4, 8, 10, 10]) {
        assert!(*gap >= 60 * minutes, "failed at {failed_s:?}");
    }
}

#[test]
fn a_robot_that_has_to_charge_in_the_middle_has_not_finished_and_does_not_go_on_by_itself() {
    let mut pair = Pair::new(&config(), 3600.0);
    pair.robot.battery = 0.2;
    pair.decide(&decision(1, action::GO, "kitchen-3"));
    pair.pass(600);
    assert!(pair.last_note().contains("charge"), "{}", pair.last_note());
    let docked = pair.reports.iter().find(|report| report.kind == Kind::Docked).unwrap();
    assert!(docked.battery.unwrap() < 0.2);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Failed, Some(1))]);
    pair.pass(4 * 3600);
    assert!(pair.robot.cleaned.is_empty() && pair.robot.doing == Doing::Docked);
    let told = pair.reports.iter().filter_map(|report| report.battery).next_back().unwrap();
    assert!(told > 0.9, "the planner hears how full the battery is: {told}");
}

#[test]
fn what_somebody_else_does_with_the_robot_is_understood() {
    let mut pair = Pair::new(&config(), 600.0);
    // A person has sent it out by its button.
    pair.robot
        .hear(&format!("{TOPIC}/MapSegmentationCapability/clean/set"), r#"{"segment_ids": ["1"], "iterations": 1}"#);
    pair.pass(5);
    let decided_ns = pair.now_s * S;
    pair.decide(&DecisionV1 { decided_ns, ..decision(1, action::GO, "office-4") });
    pair.pass(5);
    assert_eq!(pair.robot.orders, ["clean 1", "STOP", "clean 4"]);
    // A person pauses it, and never resumes.
    pair.robot.hear(&format!("{TOPIC}/BasicControlCapability/operation/set"), "PAUSE");
    pair.pass(300);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Cancelled, Some(1))]);
}

#[test]
fn a_robot_that_never_ends_is_called_home() {
    let mut pair = Pair::new(&RobotConfig { most_s: 600.0, ..config() }, 1e9);
    pair.decide(&decision(1, action::GO, "office-4"));
    pair.pass(700);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Failed, Some(1))]);
    assert_eq!((pair.robot.doing, pair.robot.orders.last().map(String::as_str)), (Doing::Docked, Some("HOME")));
}

#[test]
fn a_planner_or_driver_that_is_started_again_does_not_begin_the_room_again() {
    let mut pair = Pair::new(&config(), 300.0);
    pair.decide(&decision(1, action::GO, "office-4"));
    pair.pass(60);
    // The planner asks for it once more.
    pair.decide(&DecisionV1 { epoch: 2, ..decision(1, action::GO, "office-4") });
    pair.pass(10);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)); 2]);
    // Another driver finds the robot at work; the broker has retained its messages.
    pair.start_again(&config());
    pair.decide(&DecisionV1 { epoch: 2, ..decision(1, action::GO, "office-4") });
    pair.hear_again();
    pair.pass(300);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Finished, Some(1))]);
    assert_eq!(pair.robot.orders, ["clean 4"]);
}

#[test]
fn what_is_owed_is_told_to_a_planner_that_asks_for_it() {
    let mut pair = Pair::new(&config(), 100.0);
    pair.decide(&decision(1, action::GO, "office-4"));
    pair.pass(200);
    pair.of_work();
    let owed = DecisionV1 { epoch: 2, stay_ns: 0, flags: decision_flags::OWED, ..decision(1, action::GO, "office-4") };
    pair.decide(&owed);
    assert_eq!(pair.of_work(), [(Kind::Finished, Some(1))]);
    pair.decide(&DecisionV1 { sequence: 2, to: text::encode("to", "hall-2").unwrap(), ..owed });
    assert_eq!(pair.of_work(), [(Kind::Failed, Some(2))]);
}

/// From a planner without planned stays.
#[test]
fn a_decision_without_a_stay_is_work_like_any_other() {
    let mut pair = Pair::new(&config(), 100.0);
    for (sequence, room) in [(1, "office-4"), (2, "hall-2")] {
        pair.decide(&DecisionV1 { stay_ns: 0, ..decision(sequence, action::GO, room) });
        pair.pass(200);
        assert_eq!(pair.of_work(), [(Kind::Started, Some(sequence)), (Kind::Finished, Some(sequence))]);
    }
    assert_eq!(pair.robot.orders, ["clean 4", "clean 2"]);
}

#[test]
fn rooms_without_a_segment_are_blocked_and_another_robots_decisions_are_no_orders() {
    let mut pair = Pair::new(&config(), 100.0);
    pair.decide(&decision(1, action::GO, "garage"));
    assert_eq!(pair.of_work(), [(Kind::Blocked, Some(1))]);
    pair.decide(&DecisionV1 { robot: 8, ..decision(3, action::GO, "hall-2") });
    // A bridge repeats decisions for a robot of this name elsewhere.
    pair.decide(&DecisionV1 { flags: decision_flags::ELSEWHERE, ..decision(4, action::GO, "hall-2") });
    pair.pass(100);
    assert!(pair.robot.orders.is_empty() && pair.of_work().is_empty());
    // A decision for a completed room is intended.
    pair.decide(&DecisionV1 { covered: 0b0100, ..decision(2, action::GO, "kitchen-3") });
    assert_eq!(pair.robot.orders, ["clean 3"]);
}

#[test]
fn a_robot_that_has_not_spoken_is_not_taken_for_one_without_segments() {
    let configured = BTreeMap::from([("hall-2".to_owned(), "9".to_owned())]);
    let mut driver = Driver::new(&RobotConfig { segments: configured, ..config() }, 7);
    driver.know_rooms(ROOMS.into_iter());
    let plan = |driver: &Driver| driver.plan().map(|(_, segment)| segment).collect::<Vec<_>>();
    assert!(!driver.is_heard());
    assert_eq!(plan(&driver)[..2], [Err("nothing was heard of the robot yet".to_owned()), Ok("9".to_owned())]);
    let _acts = driver.sense(Sensed::Status(Status::Docked), BootNs(S));
    assert!(driver.is_heard() && !driver.knows_segments());
    assert!(plan(&driver)[0].as_ref().unwrap_err().contains("has told of no segments"));
}

#[test]
fn an_empty_list_of_segments_replaces_no_other() {
    let mut driver = Driver::new(&config(), 7);
    driver.know_rooms(["bedroom-2", "kitchen"].into_iter());
    let plan = |driver: &Driver| driver.plan().map(|(_, segment)| segment.ok()).collect::<Vec<_>>();
    let mut told = |segments: &[(&str, &str)]| {
        let segments = segments.iter().map(|(number, name)| (number.to_string(), name.to_string())).collect();
        let _acts = driver.sense(Sensed::Segments(segments), BootNs(S));
        plan(&driver)
    };
    assert_eq!(told(&[]), [Some("2".to_owned()), None], "the number in the id");
    let known = [Some("5".to_owned()), Some("3".to_owned())];
    assert_eq!(told(&[("5", "Schlafzimmer"), ("3", "Küche")]), known);
    assert_eq!(told(&[]), known, "the last list");
}

#[test]
fn a_room_to_wait_in_is_not_cleaned_and_ends_work_elsewhere() {
    let mut pair = Pair::new(&config(), 100.0);
    pair.decide(&decision(1, action::STAY, "kitchen-3"));
    pair.pass(10);
    assert!(pair.robot.orders.is_empty() && pair.of_work().is_empty(), "{:?}", pair.robot.orders);
    pair.decide(&decision(2, action::GO, "hall-2"));
    pair.pass(10);
    assert_eq!(pair.of_work(), [(Kind::Started, Some(2))]);
    pair.decide(&decision(3, action::STAY, "kitchen-3"));
    pair.pass(10);
    assert!(pair.driver.wish.is_none());
    assert!(
        !pair.robot.orders.contains(&"clean 3".to_owned()) && pair.robot.orders.len() > 1,
        "{:?}",
        pair.robot.orders
    );
}

#[test]
fn a_dry_run_gives_orders_to_nobody_and_reports_nothing() {
    let mut driver = Driver::new(&RobotConfig { obey: false, ..config() }, 7);
    let segments = BTreeMap::from([("3".to_owned(), "Küche".to_owned())]);
    assert!(driver.sense(Sensed::Segments(segments), BootNs(0)).is_empty());
    let clean = Act::Order(Order::Clean { segment: "3".to_owned(), room: "kitchen-3".to_owned() });
    assert_eq!(driver.decide(&decision(1, action::GO, "kitchen-3"), BootNs(S)), [clean]);
    let later: Vec<_> = (2..200).flat_map(|s| driver.tick(BootNs(s * S))).collect();
    assert!(later.is_empty() && driver.sense(Sensed::Status(Status::Docked), BootNs(300 * S)).is_empty(), "{later:?}");
    assert_eq!(driver.decide(&decision(2, action::GO, "kitchen-3"), BootNs(301 * S)).len(), 1);
}

const EVERY_S: u64 = 2;
const HORIZONS_S: [f32; 16] =
    [0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0, 300.0, 450.0, 600.0, 900.0, 1800.0, 3600.0];

#[derive(Debug, PartialEq)]
struct Day {
    shared_min: f64,
    cleaned: usize,
    failed: usize,
    /// Minutes of work while a person held the robot, after the minute that it takes to stop.
    held_min: f64,
}

/// The faults of a day: the robot gets stuck, loses commands, the broker is away, the driver restarts, and a person holds the robot.
#[derive(Debug, Clone, Copy)]
struct Trouble(bool);

/// A day of the whole chain: person, forecast, planner, driver, fake robot.
fn live(policy: PolicyName, Trouble(trouble): Trouble) -> Day {
    let planning = PlannerConfig {
        policy,
        room_time_s: ROOM_S,
        round_s: Some(3600.0 * (HOURS.1 - HOURS.0) as f64),
        reports: Reports::Always,
        ..PlannerConfig::default()
    };
    let number = sequence::source_of_name(&planning.robot);
    let (mut planner, mut reporter) = (Planner::new(&planning, 1), Reporter::new(&planning.robot, 9).unwrap());
    let mut driver = Driver::new(&config(), number);
    let mut robot = FakeValetudo::new(TOPIC, &segments(ROOM_S));
    let dialect = Dialect::new(&config(), "roomcast", "robot");
    let mut forecaster = Forecaster::new(ROOMS.len(), ForecastOptions::default(), 0.0);
    let mut person_says = Reporter::new(&planning.robot, 10).unwrap();
    let (mut before, mut shared_s, mut held_s, mut failed, mut was_away) = (None, 0.0, 0.0, 0, false);
    for second in HOURS.0 * 3600..HOURS.1 * 3600 {
        let (now_ns, now_s) = (second * S, second as f64);
        let person = person_at(now_s / 3600.0);
        if before != Some(person) {
            before = Some(person);
            match person {
                Some(room) => _ = forecaster.enter(now_s, Some(room)),
                None => forecaster.leave(now_s),
            }
        }
        let hour = |hours: f64| trouble && second == (hours * 3600.0) as u64;
        let away = trouble && (8.2..8.25).contains(&(now_s / 3600.0));
        if hour(8.0) {
            robot.orders_ignored = 2;
        }
        if hour(8.3) {
            // In an undone room.
            let at_work = robot.job.as_ref().map(|(segment, _)| segment.as_str());
            let left = segments(0.0).into_iter().map(|(segment, ..)| segment);
            let next = left
                .into_iter()
                .find(|segment| Some(*segment) != at_work && !robot.cleaned.iter().any(|done| done == segment));
            robot.sticks = Some((next.unwrap().to_owned(), 900.0));
        }
        if hour(8.1) {
            driver = Driver::new(&config(), number);
        }
        // A meeting, for which the robot stops.
        let order = [(8.4, Kind::Hold), (9.4, Kind::Resume)].into_iter().find(|(at, _)| hour(*at));
        if let Some((_, kind)) = order {
            let order = person_says.message(&Report::new(kind), BootNs(now_ns), UnixNs(now_ns)).unwrap();
            planner.take_report(&order, BootNs(now_ns)).unwrap();
        }
        robot.pass(1.0);
        let is_held = trouble && (8.4 + 60.0 / 3600.0..9.4).contains(&(now_s / 3600.0));
        held_s += f64::from(u8::from(is_held && robot.doing == Doing::Cleaning));
        if person.is_some()
            && robot.job.as_ref().is_some_and(|(segment, _)| {
                robot.doing == Doing::Cleaning && segments(0.0).iter().position(|s| s.0 == segment) == person
            })
        {
            shared_s += 1.0;
        }
        let mut acts = Vec::new();
        // A new connection delivers the broker's retained messages.
        let again = was_away && !away || hour(8.1);
        was_away = away;
        if !away {
            for (topic, payload) in robot.say(again) {
                acts.extend(
                    dialect
                        .hear(&topic, payload.as_bytes())
                        .into_iter()
                        .flat_map(|sensed| driver.sense(sensed, BootNs(now_ns))),
                );
            }
        }
        acts.extend(driver.tick(BootNs(now_ns)));
        if second % EVERY_S == 0 {
            let (scores, forecast) = tell(&forecaster, second);
            planner.take(&scores, BootNs(now_ns)).unwrap();
            planner.take_forecast(&forecast, BootNs(now_ns)).unwrap();
            driver.know_rooms(scores.rooms().iter().map(roomcast_ipc::raw::RoomV1::id));
        }
        if let Some(decision) = planner.decide(BootNs(now_ns), UnixNs(0)).unwrap() {
            acts.extend(driver.decide(&decision, BootNs(now_ns)));
        }
        for act in acts {
            match act {
                Act::Order(order) if !away => {
                    let (topic, payload) = dialect.order(&order);
                    robot.hear(&topic, &payload);
                }
                Act::Order(_) => {}
                Act::Report(report) => {
                    failed += usize::from(report.kind == Kind::Failed);
                    planner
                        .take_report(&reporter.message(&report, BootNs(now_ns), UnixNs(0)).unwrap(), BootNs(now_ns))
                        .unwrap();
                }
            }
        }
    }
    let cleaned: std::collections::BTreeSet<_> = robot.cleaned.iter().collect();
    Day { shared_min: shared_s / 60.0, cleaned: cleaned.len(), failed, held_min: held_s / 60.0 }
}

fn tell(forecaster: &Forecaster, second: u64) -> (RoomScoresV1, ForecastV1) {
    let (now_s, now_ns) = (second as f64, second * S);
    let mut scores =
        RoomScoresV1 { epoch: 1, sequence: second, computed_ns: now_ns, published_ns: now_ns, ..Default::default() };
    let mut forecast =
        ForecastV1 { epoch: 1, sequence: second, computed_ns: now_ns, published_ns: now_ns, ..Default::default() };
    (scores.room_count, forecast.room_count, forecast.horizon_count) = (4, 4, 16);
    forecast.horizon_s = HORIZONS_S;
    for (room, id) in ROOMS.iter().enumerate() {
        scores.room[room].id = text::encode("id", id).unwrap();
        scores.room[room].probability = forecaster.belief()[room];
        scores.room[room].log_score_nats = scores.room[room].probability.ln();
        forecast.id[room] = scores.room[room].id;
    }
    for (horizon, horizon_s) in HORIZONS_S.iter().enumerate() {
        for (room, p) in forecaster.at(now_s, f64::from(*horizon_s)).enumerate() {
            forecast.probability[room][horizon] = p as f32;
        }
    }
    (scores, forecast)
}

#[test]
fn a_flat_is_cleaned_over_a_day_while_a_person_lives_there() {
    let quiet = live(PolicyName::CoverageAware, Trouble(false));
    let naive = live(PolicyName::Naive, Trouble(false));
    let schedules = plain_schedules();
    let mean = mean(&schedules);
    println!("coverage-aware {quiet:?}, naive {naive:?}, plain schedules {schedules:.1?} min, mean {mean:.1} min");
    assert_eq!((quiet.cleaned, quiet.failed), (4, 0));
    assert!(quiet.shared_min < naive.shared_min && quiet.shared_min < mean, "{quiet:?} {naive:?} {schedules:?}");
    // With lost commands, a stuck robot, an absent broker, a restarted driver and an hour on hold, all rooms are still done.
    let troubled = live(PolicyName::CoverageAware, Trouble(true));
    println!("with trouble {troubled:?}");
    assert_eq!((troubled.cleaned, troubled.held_min), (4, 0.0));
    assert!(troubled.failed >= 1 && troubled.shared_min < mean, "{troubled:?}");
}

/// The broker, its Wi-Fi or the robot was away for longer than three tries, and the robot continued next to the person afterwards.
#[test]
fn what_ends_work_is_told_again_until_it_is_followed() {
    for (on_pause, then) in [(OnPause::Return, Doing::Docked), (OnPause::Pause, Doing::Paused)] {
        for (away_s, deaf) in (0..40).step_by(3).chain([100, 3000]).flat_map(|away_s| [(away_s, 0), (away_s, 7)]) {
            let case = format!("{on_pause}: {away_s} s away, {deaf} orders not heard");
            let mut pair = Pair::new(&RobotConfig { on_pause, start_s: 5.0, ..config() }, 1e6);
            pair.decide(&decision(1, action::GO, "hall-2"));
            pair.pass(30);
            pair.be_away(true);
            pair.decide(&decision(2, action::PAUSE, ""));
            pair.pass(away_s);
            pair.robot.orders_ignored = deaf;
            pair.be_away(false);
            pair.pass(3);
            assert!(deaf > 0 || pair.robot.doing != Doing::Cleaning, "{case}: told as soon as it is back");
            pair.pass(100);
            assert_eq!(pair.robot.doing, then, "{case}");
            let told = pair.robot.orders.len();
            pair.pass(300);
            assert_eq!((pair.robot.orders.len(), &pair.driver.state), (told, &State::Free), "{case}: it is left alone");
        }
    }
}

/// The robot leaves the earlier room, whatever the report about it.
#[test]
fn a_robot_that_does_not_stop_for_another_room_is_told_until_it_does() {
    let mut pair = Pair::new(&RobotConfig { start_s: 5.0, ..config() }, 1e6);
    pair.decide(&decision(1, action::GO, "hall-2"));
    pair.pass(30);
    pair.robot.orders_ignored = 6;
    pair.decide(&decision(2, action::GO, "office-4"));
    pair.pass(25);
    assert!(pair.last_note().contains("does not stop when it is told to"), "{}", pair.last_note());
    assert_eq!(pair.of_work(), [(Kind::Started, Some(1)), (Kind::Failed, Some(2))]);
    pair.pass(30);
    assert_ne!(pair.robot.doing, Doing::Cleaning);
}

/// A room was reported as failed because the broker was away, and the robot, which had the command, cleaned it anyway.
#[test]
fn what_was_given_up_without_a_broker_is_not_done_later() {
    for away_after_s in 0..3 {
        let mut pair = Pair::new(&RobotConfig { start_s: 5.0, ..config() }, 1e6);
        pair.decide(&decision(1, action::GO, "hall-2"));
        pair.be_away(true);
        pair.pass(100 + away_after_s);
        assert_eq!((pair.of_work(), pair.robot.doing), (vec![(Kind::Failed, Some(1))], Doing::Cleaning));
        pair.be_away(false);
        pair.pass(10);
        assert_ne!(pair.robot.doing, Doing::Cleaning);
    }
}

/// The decision came before the robot's first message, and was forgotten then.
#[test]
fn a_driver_that_is_started_while_a_pause_stands_calls_the_robot_home() {
    let home = |action: u32, room: &str| {
        let mut pair = Pair::new(&config(), 1e6);
        pair.decide(&decision(1, action::GO, "kitchen-3"));
        pair.pass(60);
        pair.start_again(&config());
        pair.decide(&decision(2, action, room));
        pair.pass(2);
        pair.hear_again();
        pair.pass(2);
        pair.robot.doing != Doing::Cleaning
    };
    assert!(home(action::PAUSE, "") && home(action::STAY, "hall-2"));
    assert!(!home(action::STAY, "") && !home(action::GO, "kitchen-3"));
    // At its dock it gets no command.
    let mut pair = Pair::new(&config(), 1e6);
    pair.start_again(&config());
    pair.decide(&decision(2, action::PAUSE, ""));
    pair.hear_again();
    pair.pass(100);
    assert!(pair.robot.orders.is_empty());
}

/// Unordered work counted as the driver's own, hours after its start.
#[test]
fn a_robot_that_somebody_sends_out_after_the_start_is_not_at_its_own_work() {
    for wait_s in [0, 3, 3600] {
        let mut pair = Pair::new(&config(), 1e6);
        pair.start_again(&config());
        pair.hear_again();
        pair.pass(wait_s);
        pair.robot.hear(
            &format!("{TOPIC}/MapSegmentationCapability/clean/set"),
            r#"{"segment_ids": ["1"], "iterations": 1}"#,
        );
        pair.pass(5);
        pair.decide(&decision(1, action::GO, "kitchen-3"));
        pair.pass(10);
        assert_eq!(pair.robot.orders, ["clean 1", "STOP", "clean 3"]);
        assert_eq!(pair.of_work(), [(Kind::Started, Some(1))]);
    }
}

/// A robot with an unknown state was reported as alive, and the planner did not notice its silence.
#[test]
fn nothing_is_reported_while_broker_or_robot_are_away() {
    let mut pair = Pair::new(&config(), 1e6);
    pair.decide(&decision(1, action::GO, "kitchen-3"));
    pair.pass(60);
    pair.be_away(true);
    pair.reports.clear();
    pair.pass(3600);
    assert!(pair.reports.is_empty(), "{:?}", pair.reports);
    pair.be_away(false);
    pair.pass(60);
    assert!(!pair.reports.is_empty() && pair.of_work().is_empty(), "it is at the same work");
    // The broker has retained messages of a robot that is off, in any order.
    let said = [
        Sensed::Online(false),
        Sensed::Status(Status::Cleaning),
        Sensed::Battery(0.4),
        Sensed::Segments(BTreeMap::from([("3".to_owned(), "kitchen".to_owned())])),
    ];
    let mut driver = Driver::new(&config(), 7);
    driver.know_rooms(ROOMS.into_iter());
    let mut acts = driver.decide(&decision(1, action::GO, "kitchen-3"), BootNs(S));
    said.into_iter().for_each(|sensed| acts.extend(driver.sense(sensed, BootNs(S))));
    (2..100).for_each(|s| acts.extend(driver.tick(BootNs(s * S))));
    assert_eq!(acts, []);
    let acts = driver.sense(Sensed::Online(true), BootNs(100 * S));
    assert!(acts.iter().any(|act| matches!(act, Act::Report(report) if report.battery == Some(0.4))), "{acts:?}");
}

/// `mqtt_statestream` sends a state when it changes, and a broker without persistence loses its retained messages.
#[test]
fn home_assistants_robot_is_sent_out_after_the_broker_lost_what_it_kept() {
    let config = RobotConfig { kind: RobotKind::HomeAssistant, ..config() };
    let mut driver = Driver::new(&config, 7);
    driver.know_rooms(ROOMS.into_iter());
    let mut acts = driver.link(true, BootNs(S));
    acts.extend(driver.sense(Sensed::Status(Status::Docked), BootNs(S)));
    acts.extend(driver.link(false, BootNs(2 * S)));
    acts.extend(driver.link(true, BootNs(3 * S)));
    assert!(!acts.iter().any(|act| matches!(act, Act::Order(_))), "{acts:?}");
    let mut acts = driver.decide(&decision(1, action::GO, "hall-2"), BootNs(4 * S));
    acts.extend(driver.tick(BootNs(5 * S)));
    assert!(acts.iter().any(|act| matches!(act, Act::Order(Order::Clean { .. }))), "{acts:?}");
}

/// Home Assistant does not say why a vacuum goes home: one that had to charge had "finished" its room.
#[test]
fn home_assistants_robot_that_leaves_with_an_empty_battery_has_not_done_the_room() {
    let config = RobotConfig { kind: RobotKind::HomeAssistant, ..config() };
    for (battery, kind) in [(0.12, Kind::Failed), (0.15, Kind::Failed), (0.16, Kind::Finished), (0.9, Kind::Finished)] {
        let mut driver = Driver::new(&config, 7);
        driver.know_rooms(ROOMS.into_iter());
        let mut acts = driver.sense(Sensed::Status(Status::Docked), BootNs(S));
        acts.extend(driver.decide(&decision(1, action::GO, "hall-2"), BootNs(2 * S)));
        acts.extend(driver.sense(Sensed::Status(Status::Cleaning), BootNs(3 * S)));
        acts.extend(driver.sense(Sensed::Battery(battery), BootNs(500 * S)));
        acts.extend(driver.sense(Sensed::Status(Status::Returning), BootNs(600 * S)));
        acts.extend(driver.tick(BootNs(604 * S)));
        let ended: Vec<_> = acts
            .iter()
            .filter_map(|act| if let Act::Report(report) = act { Some(report.kind) } else { None })
            .filter(|kind| matches!(kind, Kind::Finished | Kind::Failed))
            .collect();
        assert_eq!(ended, [kind], "{battery}");
        // It continues by itself unless a command stops it.
        let mut docked = driver.sense(Sensed::Status(Status::Docked), BootNs(700 * S));
        (701..1000).for_each(|s| docked.extend(driver.tick(BootNs(s * S))));
        let stops = docked.iter().filter(|act| matches!(act, Act::Order(Order::Stop))).count();
        assert_eq!(stops, if kind == Kind::Failed { TRIES as usize } else { 0 }, "{battery}");
    }
}
