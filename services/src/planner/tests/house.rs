//! The rules of the house, orders of persons and needs of rooms, played with the planner.

use roomcast_ipc::raw::{NOTE_TEXT_BYTES, person_flags, presence};

use super::*;
use crate::config::{OnlyWhen, QuietHours, RoomNeeds, WhileAsleep};

const MIN: u64 = 60 * S;
const HOUR: u64 = 60 * MIN;
const ROOM_IDS: [&str; 4] = ["kitchen", "bedroom", "hall", "office"];

/// A flat of four rooms with doors from the hall to all others, and its persons. The clocks begin at midnight of a Thursday, in UTC.
struct Flat {
    config: PlannerConfig,
    planner: Planner,
    at_ns: u64,
    /// Each person: name, flags and room.
    persons: Vec<(&'static str, u32, Option<usize>)>,
    /// For each room the probability of a person in an hour, and the probability of an empty house then.
    later: Option<([f32; 4], f32)>,
    flags: u32,
    sequence: u64,
    orders: u64,
}

fn map() -> SemanticMap {
    let room = |(index, id): (usize, &&str)| {
        let x = 4 * index;
        serde_json::json!({"id": id, "label": id, "box": {"min_m": [x, 0, 0], "max_m": [x + 4, 4, 3]}})
    };
    let rooms: Vec<_> = ROOM_IDS.iter().enumerate().map(room).collect();
    let door = |(number, other): (usize, &&str)| serde_json::json!({"id": format!("door-{number}"), "rooms": ["hall", other], "position_m": [0, 0, 1]});
    let doors: Vec<_> = ["kitchen", "bedroom", "office"].iter().enumerate().map(door).collect();
    let scene = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "flat", "items": [], "rooms": rooms, "doors": doors});
    SemanticMap::from_json(&scene.to_string()).unwrap()
}

impl Flat {
    fn new(config: PlannerConfig) -> Self {
        let config = PlannerConfig { room_time_s: 600.0, know_s: config.know_s.min(600.0), ..config };
        let planner = Self::start(&config, 1);
        let (persons, at_ns) = (vec![("Mira", 0, Some(0))], 9 * HOUR);
        Self { config, planner, at_ns, persons, later: None, flags: 0, sequence: 0, orders: 0 }
    }

    fn start(config: &PlannerConfig, epoch: u64) -> Planner {
        let planner = Planner::new(config, epoch).with_map(map(), PartitionLevel::Room);
        planner.with_home(&["Mira".to_owned(), "Ben".to_owned()], Zone::UTC)
    }

    fn at(mut self, at_ns: u64) -> Self {
        self.at_ns = at_ns;
        self
    }

    /// Sends the daemon's messages after this time, and returns the planner's decision.
    fn after(&mut self, later_ns: u64) -> Option<DecisionV1> {
        self.at_ns += later_ns;
        self.sequence += 1;
        let mut scores = scores(self.sequence, self.at_ns, &[0.25; 4]);
        scores.map_fingerprint = map().fingerprint();
        for (room, id) in scores.room.iter_mut().zip(ROOM_IDS) {
            room.id = text::encode("id", id).unwrap();
        }
        let taken = |room: usize| self.persons.iter().any(|person| person.2 == Some(room));
        let empty = self.persons.iter().all(|person| person.2.is_none());
        let now: [f32; 4] = std::array::from_fn(|room| f32::from(u8::from(taken(room))));
        let (later, empty_later) = self.later.unwrap_or((now, f32::from(u8::from(empty))));
        let curves: Vec<[f32; 2]> = now.iter().zip(later).map(|(now, later)| [*now, later]).collect();
        let nobody = if empty && self.flags == 0 { forecast_flags::NOBODY_HOME } else { 0 };
        let mut whole = ForecastV1 { flags: self.flags | nobody, ..forecast(&scores, &curves) };
        whole.horizon_s[1] = 3_600.0;
        whole.elsewhere[..2].copy_from_slice(&[f32::from(u8::from(empty)), empty_later]);
        let mut each = PersonForecastsV1 {
            epoch: scores.epoch,
            sequence: scores.sequence,
            computed_ns: self.at_ns,
            published_ns: self.at_ns,
            room_count: 4,
            horizon_count: 2,
            persons: self.persons.len() as u32,
            person_count: self.persons.len() as u32,
            horizon_s: whole.horizon_s,
            ..Default::default()
        };
        each.id[..4].copy_from_slice(&whole.id[..4]);
        for (number, (own, (name, flags, room))) in each.person.iter_mut().zip(&self.persons).enumerate() {
            (own.person, own.flags, own.name) = (number as u32 + 1, *flags, text::encode("name", name).unwrap());
            own.presence = if room.is_some() { presence::PRESENT } else { presence::AWAY };
            own.elsewhere = [f32::from(u8::from(room.is_none())); 16];
            if let Some(room) = room {
                own.probability[*room][0] = 1.0;
                own.probability[*room][1] = self.later.map_or(1.0, |(later, _)| later[*room]);
            }
        }
        each.check().unwrap();
        self.planner.hear(&scores);
        self.planner.hear_forecast(&whole);
        self.planner.hear_sets(&each);
        let decision = self.planner.decide(BootNs(self.at_ns), UnixNs(self.at_ns)).unwrap();
        decision.iter().for_each(|decision| decision.check().unwrap());
        decision
    }

    fn decision(&mut self, later_ns: u64) -> DecisionV1 {
        self.after(later_ns).unwrap_or_else(|| panic!("no decision at {} min", self.at_ns / MIN))
    }

    /// The daemon sends messages for some time, and the planner makes no decision.
    fn quiet_for(&mut self, later_ns: u64) {
        let until_ns = self.at_ns + later_ns;
        while self.at_ns < until_ns {
            let decision = self.after(MIN);
            assert_eq!(decision.map(|decision| decision.reason().to_owned()), None, "at {} min", self.at_ns / MIN);
        }
    }

    fn order(&mut self, kind: u32, change: impl Fn(&mut RobotReportV1)) {
        self.orders += 1;
        let mut order = RobotReportV1 {
            robot: sequence::source_of_name("robot"),
            epoch: 99,
            sequence: self.orders,
            reported_ns: self.at_ns,
            reported_unix_ns: self.at_ns,
            kind,
            ..Default::default()
        };
        change(&mut order);
        order.check().unwrap();
        self.planner.take_report(&order, BootNs(self.at_ns)).unwrap();
    }

    fn of_room(&mut self, kind: u32, id: &str) {
        self.order(kind, |order| order.room = text::encode("room", id).unwrap());
    }

    /// Another planner takes over, with the orders and without the round, as after a reboot.
    fn reboot(&mut self) {
        let kept = serde_json::to_string(self.planner.orders()).unwrap();
        self.planner = Self::start(&self.config, 2).with_orders(serde_json::from_str(&kept).unwrap());
    }
}

fn paused(decision: &DecisionV1, reason: &str) {
    assert_eq!((decision.action, decision.reason()), (action::PAUSE, reason));
}

fn quiet_hours(hours: &str) -> PlannerConfig {
    PlannerConfig { quiet: vec![QuietHours::try_from(hours.to_owned()).unwrap()], ..PlannerConfig::default() }
}

fn needs(id: &str) -> RoomNeeds {
    RoomNeeds { id: id.to_owned(), every_s: None, priority: 1.0, time_s: None, exclude: false }
}

#[test]
fn the_first_order_waits_until_each_resident_was_observed() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.flags = forecast_flags::RESIDENT_UNKNOWN;
    paused(&flat.decision(0), "Waiting: Ben was not observed yet; until 09:10 at most.");
    flat.quiet_for(4 * MIN);
    (flat.flags, flat.persons) = (0, vec![("Mira", 0, Some(0)), ("Ben", 0, None)]);
    assert_eq!(flat.decision(MIN).action, action::GO);
}

#[test]
fn the_planner_goes_on_without_a_resident_after_a_time() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.flags = forecast_flags::RESIDENT_UNKNOWN;
    flat.decision(0);
    flat.quiet_for(9 * MIN);
    let goes = flat.decision(MIN);
    assert!(goes.action == action::GO && goes.reason().contains("was not observed yet"), "{}", goes.reason());
    // Without a wait the first order goes out at once.
    let mut flat = Flat::new(PlannerConfig { know_s: 0.0, ..PlannerConfig::default() });
    flat.flags = forecast_flags::NOT_KNOWN;
    assert_eq!(flat.decision(0).action, action::GO);
}

#[test]
fn the_wait_for_residents_does_not_pass_in_quiet_hours() {
    let mut flat = Flat::new(quiet_hours("22:00-07:00")).at(3 * HOUR);
    flat.flags = forecast_flags::RESIDENT_UNKNOWN;
    paused(&flat.decision(0), "Quiet hours until 07:00.");
    flat.quiet_for(3 * HOUR + 59 * MIN);
    paused(&flat.decision(MIN), "Waiting: Ben was not observed yet; until 07:09 at most.");
    flat.quiet_for(8 * MIN);
    assert_eq!(flat.decision(MIN).action, action::GO);
}

#[test]
fn quiet_hours_stop_the_robot_and_let_it_go_on_afterwards() {
    let mut flat =
        Flat::new(PlannerConfig { reports: Reports::Always, report_timeout_s: 3600.0, ..quiet_hours("22:00-07:00") })
            .at(21 * HOUR + 45 * MIN);
    let goes = flat.decision(0);
    assert_eq!(goes.action, action::GO);
    // It takes longer than its stay.
    flat.quiet_for(14 * MIN);
    let stops = flat.decision(MIN);
    let id = goes.to().to_owned();
    paused(&stops, &format!("The work in the {id} stops. Quiet hours until 07:00."));
    assert_eq!(stops.cancels, goes.sequence);
    flat.quiet_for(8 * HOUR + 59 * MIN);
    let goes = flat.decision(MIN);
    assert_eq!((goes.action, goes.covered), (action::GO, 0));
}

#[test]
fn while_a_person_sleeps_the_rooms_beside_theirs_are_silent() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.persons = vec![("Mira", person_flags::ASLEEP, Some(1)), ("Ben", 0, None)];
    let mut rooms = Vec::new();
    for _ in 0..2 {
        rooms.push(flat.decision(10 * MIN).to().to_owned());
    }
    rooms.sort();
    assert_eq!(rooms, ["kitchen", "office"], "hall and bedroom have a door between them");
    paused(&flat.decision(10 * MIN), "Waiting: Mira sleeps in the bedroom.");
    flat.persons[0].1 = 0;
    assert_eq!(flat.decision(MIN).to(), "hall");
}

#[test]
fn a_person_who_falls_asleep_ends_the_work_nearby() {
    for (while_asleep, stops) in [(WhileAsleep::Room, false), (WhileAsleep::Beside, true), (WhileAsleep::Ignore, false)]
    {
        let mut flat = Flat::new(PlannerConfig { while_asleep, ..PlannerConfig::default() });
        flat.persons = vec![("Mira", 0, Some(1)), ("Ben", 0, None)];
        flat.decision(0);
        flat.of_room(report_kind::CLEAN, "hall");
        assert_eq!(flat.decision(0).to(), "hall");
        flat.persons[0].1 = person_flags::ASLEEP;
        let stopped = flat.after(MIN);
        assert_eq!(stopped.is_some(), stops, "{while_asleep}");
        stopped.iter().for_each(|stopped| {
            assert!(
                stopped.reason().starts_with("The work in the hall stops. Waiting: Mira sleeps"),
                "{}",
                stopped.reason()
            );
        });
    }
}

#[test]
fn without_the_map_a_sleeper_keeps_the_whole_house_silent() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.planner = Planner::new(&flat.config, 1).with_home(&[], Zone::UTC);
    flat.persons = vec![("Mira", person_flags::ASLEEP, Some(1))];
    paused(&flat.decision(0), "Waiting: Mira sleeps in the bedroom.");
}

#[test]
fn only_an_empty_house_is_cleaned_and_only_if_it_stays_empty() {
    let config = PlannerConfig {
        only_when: Some(OnlyWhen::HouseEmpty),
        min_absence_s: 1800.0,
        interrupt: false,
        ..PlannerConfig::default()
    };
    let mut flat = Flat::new(config);
    paused(&flat.decision(0), "Waiting: Mira is at home.");
    // Ada leaves, and is back within the hour with 90 %.
    (flat.persons[0].2, flat.later) = (None, Some(([0.2; 4], 0.1)));
    paused(&flat.decision(MIN), "Waiting: the house stays empty for 30 minutes with only 55 %.");
    flat.later = Some(([0.0; 4], 0.9));
    let goes = flat.decision(MIN);
    assert_eq!(goes.action, action::GO);
    (flat.persons[0].2, flat.later) = (Some(3), None);
    let stops = flat.decision(MIN);
    assert!(
        stops.action == action::PAUSE && stops.reason().contains("Waiting: Mira is at home."),
        "{}",
        stops.reason()
    );
}

#[test]
fn a_robot_that_waits_says_who_is_where_and_for_how_long() {
    let mut flat = Flat::new(PlannerConfig {
        room: ["bedroom", "hall", "office"].map(|id| RoomNeeds { exclude: true, ..needs(id) }).to_vec(),
        ..PlannerConfig::default()
    });
    flat.later = Some(([0.0; 4], 0.0));
    paused(&flat.decision(0), "Waiting: Mira is likely in the kitchen for 60 more minutes.");
    flat.persons[0].2 = Some(3);
    assert_eq!(flat.decision(MIN).to(), "kitchen");
}

/// The map has the rooms in English.
#[test]
fn rules_of_rooms_apply_by_each_name_that_the_map_knows() {
    let room = ["Küche", "Schlafzimmer"].map(|name| RoomNeeds { exclude: true, ..needs(name) }).to_vec();
    let mut flat = Flat::new(PlannerConfig { room, ..quiet_hours("09:00-10:00 in Hall") });
    assert_eq!(flat.decision(0).to(), "office");
    assert_eq!(flat.planner.rooms_not_on_the_map(), [""; 0]);
}

#[test]
fn a_hold_stops_the_robot_until_its_end_also_over_a_reboot() {
    let mut flat = Flat::new(PlannerConfig { reports: Reports::Always, ..PlannerConfig::default() });
    let goes = flat.decision(0);
    flat.order(report_kind::HOLD, |order| {
        order.note = text::encode::<NOTE_TEXT_BYTES>("note", "meeting").unwrap();
        order.until_unix_ns = 10 * HOUR;
    });
    let stops = flat.decision(MIN);
    paused(&stops, &format!("The work in the {} stops. On hold until 10:00: meeting.", goes.to()));
    assert!(stops.has(decision_flags::HELD) && stops.held_until_unix_ns == 10 * HOUR && stops.cancels == goes.sequence);
    flat.quiet_for(10 * MIN);
    flat.reboot();
    paused(&flat.decision(MIN), "On hold until 10:00: meeting.");
    flat.quiet_for(47 * MIN);
    let goes = flat.decision(MIN);
    assert!(goes.action == action::GO && !goes.has(decision_flags::HELD));
}

#[test]
fn a_person_resumes_a_robot_that_is_held() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.order(report_kind::HOLD, |_| ());
    paused(&flat.decision(0), "On hold.");
    flat.order(report_kind::RESUME, |_| ());
    assert_eq!(flat.decision(S).action, action::GO);
    // A port repeats its last reports for a planner that joins.
    flat.order(report_kind::HOLD, |order| order.sequence = 1);
    assert!(flat.planner.orders().hold.is_none());
}

#[test]
fn a_held_robot_that_waits_is_told_so() {
    let mut flat = Flat::new(PlannerConfig { repeat: false, ..PlannerConfig::default() });
    flat.persons[0].2 = None;
    for _ in 0..4 {
        assert_eq!(flat.decision(10 * MIN).action, action::GO);
    }
    assert_eq!(flat.decision(10 * MIN).reason(), "Every room is covered");
    flat.order(report_kind::HOLD, |_| ());
    assert!(flat.decision(S).has(decision_flags::HELD));
}

#[test]
fn an_ordered_room_that_the_robot_cannot_do_hides_no_other_ordered_room() {
    let mut flat = Flat::new(PlannerConfig { reports: Reports::Always, ..PlannerConfig::default() });
    let rooms = ["hall", "office"];
    flat.decision(0);
    for room in rooms {
        flat.of_room(report_kind::CLEAN, room);
    }
    flat.order(report_kind::BLOCKED, |report| report.room = text::encode("room", rooms[0]).unwrap());
    let goes = flat.decision(S);
    assert_eq!(
        (goes.to(), goes.reason().ends_with("A person asked for this room.")),
        (rooms[1], true),
        "{}",
        goes.reason()
    );
}

#[test]
fn a_room_that_a_person_asks_for_is_done_next_also_if_it_was_done() {
    let mut flat = Flat::new(PlannerConfig { reports: Reports::Always, ..quiet_hours("08:00-20:00") });
    paused(&flat.decision(0), "Quiet hours until 20:00.");
    flat.of_room(report_kind::CLEAN, "office");
    let goes = flat.decision(S);
    assert_eq!((goes.to(), goes.reason(), goes.action), ("office", "A person asked for this room.", action::GO));
    flat.quiet_for(5 * MIN);
    flat.order(report_kind::FINISHED, |report| {
        (report.decision_epoch, report.decision_sequence) = (goes.epoch, goes.sequence);
    });
    let done = flat.decision(S);
    paused(&done, "Quiet hours until 20:00.");
    assert_eq!((done.covered, done.cleaned_min[3], flat.planner.orders().asked.len()), (0b1000, 1, 0));
    flat.of_room(report_kind::CLEAN, "office");
    assert_eq!(flat.decision(MIN).to(), "office");
}

#[test]
fn a_skipped_room_is_left_today_and_done_tomorrow() {
    let mut flat = Flat::new(PlannerConfig::default()).at(22 * HOUR);
    flat.persons[0].2 = None;
    flat.decision(0);
    flat.of_room(report_kind::SKIP, "hall");
    let mut rooms: Vec<String> = (0..5).map(|_| flat.decision(10 * MIN).to().to_owned()).collect();
    rooms.sort();
    rooms.dedup();
    assert_eq!(rooms, ["bedroom", "kitchen", "office"]);
    let rooms: Vec<String> = (0..20).filter_map(|_| Some(flat.after(10 * MIN)?.to().to_owned())).collect();
    assert!(rooms.contains(&"hall".to_owned()), "{rooms:?}");
}

#[test]
fn an_order_without_a_room_is_refused() {
    let mut flat = Flat::new(PlannerConfig::default());
    flat.decision(0);
    let order = RobotReportV1 {
        robot: sequence::source_of_name("robot"),
        epoch: 99,
        sequence: 1,
        kind: report_kind::SKIP,
        ..Default::default()
    };
    assert_eq!(flat.planner.take_report(&order, BootNs(flat.at_ns)), Err(ReportFault::NoRoom));
}

#[test]
fn rooms_are_done_as_often_as_they_need() {
    let every = |id: &str, hours: f64| RoomNeeds { every_s: Some(hours * 3_600.0), ..needs(id) };
    let room = vec![
        every("kitchen", 6.0),
        every("bedroom", 24.0),
        every("hall", 24.0),
        RoomNeeds { exclude: true, ..needs("office") },
    ];
    let mut flat = Flat::new(PlannerConfig { room, ..PlannerConfig::default() });
    flat.persons[0].2 = None;
    let mut done = [0; 4];
    for _ in 0..(48 * 6) {
        if let Some(goes) = flat.after(10 * MIN).filter(|decision| decision.action == action::GO) {
            done[ROOM_IDS.iter().position(|id| *id == goes.to()).unwrap()] += 1;
        }
    }
    assert_eq!(done, [8, 2, 2, 0]);
}

#[test]
fn what_was_cleaned_is_known_after_a_reboot() {
    let room = ROOM_IDS.map(|id| RoomNeeds { every_s: Some(86_400.0), ..needs(id) }).to_vec();
    let mut flat = Flat::new(PlannerConfig { room, ..PlannerConfig::default() });
    flat.persons[0].2 = None;
    let first = flat.decision(0).to().to_owned();
    flat.decision(10 * MIN);
    flat.reboot();
    let next = flat.decision(30 * MIN);
    let place = ROOM_IDS.iter().position(|id| *id == first).unwrap();
    assert!(next.to() != first && next.covered == 1 << place, "{} {:b}", next.to(), next.covered);
    assert_eq!(next.cleaned_unix_s(place), Some((9 * HOUR + 10 * MIN) / S));
}

/// With one stay left and two rooms of the same occupancy, the overdue one is done.
#[test]
fn an_overdue_room_costs_more_to_leave() {
    for (overdue, other) in [(0, 3), (3, 0)] {
        let every = |room: usize| RoomNeeds { every_s: Some(3_600.0), ..needs(ROOM_IDS[room]) };
        let config = PlannerConfig {
            room: vec![every(overdue), every(other)],
            round_s: Some(600.0),
            ..PlannerConfig::default()
        };
        let mut flat = Flat::new(config).at(20 * HOUR);
        flat.persons[0].2 = None;
        flat.later = Some(([0.4, 0.0, 0.0, 0.4], 0.2));
        let mut orders = flat.planner.orders().clone();
        orders.cleaned.insert(ROOM_IDS[overdue].to_owned(), 3_600);
        orders.cleaned.insert(ROOM_IDS[other].to_owned(), 19 * 3_600 - 1);
        flat.planner = Flat::start(&flat.config, 3).with_orders(orders);
        flat.planner.round = Round::new(&flat.config);
        let weights = {
            flat.decision(0);
            flat.planner.weights()
        };
        assert!(weights[overdue] > 10.0 && weights[other] < 1.1, "{weights:?}");
    }
}

#[test]
fn holds_and_quiet_hours_end_the_work_of_a_robot_without_fresh_scores() {
    let quiet = vec![QuietHours::try_from("09:05-10:00".to_owned()).unwrap()];
    for (quiet, holds, reason) in [(Vec::new(), true, "On hold."), (quiet, false, "Quiet hours until 10:00.")] {
        let config = PlannerConfig { reports: Reports::Always, report_timeout_s: 3_600.0, ..PlannerConfig::default() };
        let mut flat = Flat::new(PlannerConfig { quiet, ..config });
        flat.config.room_time_s = 60.0;
        flat.planner = Flat::start(&flat.config, 1);
        let goes = flat.decision(0);
        assert_eq!(goes.action, action::GO);
        if holds {
            flat.order(report_kind::HOLD, |_| ());
        }
        // The daemon is silent from now on.
        flat.at_ns += 6 * MIN;
        let decide = |flat: &mut Flat| flat.planner.decide(BootNs(flat.at_ns), UnixNs(flat.at_ns)).unwrap();
        let stops = decide(&mut flat).unwrap();
        assert_eq!((stops.action, stops.cancels), (action::PAUSE, goes.sequence), "{}", stops.reason());
        assert!(stops.reason().contains(reason) && stops.has(decision_flags::STALE), "{}", stops.reason());
    }
}
