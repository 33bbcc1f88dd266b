//! Homes with sensors: the joint filter in the daemon.

use super::*;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{RobotReportV1, report_kind};

const BED_JON: Device = ("bed", "bed-jon", "bedroom", "Jon");
const BED_MIRA: Device = ("bed", "bed-mira", "bedroom", "Mira");
const PHONE_JON: Device = ("phone", "phone-jon", "", "Jon");
const PHONE_MIRA: Device = ("phone", "phone-mira", "", "Mira");
const CORRIDOR: Device = ("motion", "motion-corridor", "corridor", "");
const BATHROOM: Device = ("motion", "motion-bathroom", "bathroom", "");
const KITCHEN: Device = ("motion", "motion-kitchen", "kitchen", "");
const LIVING: Device = ("presence", "mmwave-living", "living-room", "");
const ALL: [Device; 8] = [BED_JON, BED_MIRA, PHONE_JON, PHONE_MIRA, CORRIDOR, BATHROOM, KITCHEN, LIVING];

/// Kind, id, room, person.
type Device = (&'static str, &'static str, &'static str, &'static str);

/// A flat of two with ordinary devices. The phones are in, and all else is off.
struct Flat(House);

impl Flat {
    fn new() -> Self {
        let mut house = House::new(&["Jon", "Mira"]);
        house.engine = board_of(FLAT, &house.config);
        let mut own = Self(house);
        for device in ALL {
            own.after(1, device, device.0 == "phone");
        }
        own
    }

    fn report(&mut self, (kind, id, room, person): Device, on: bool) -> Observation {
        let room = if room.is_empty() { String::new() } else { format!(r#""room":"{room}","#) };
        let text = format!(r#"{{"sensor":"{kind}","id":"{id}",{room}"on":{on}}}"#);
        self.0.observation(if person.is_empty() { "somebody" } else { person }, &text)
    }

    fn after(&mut self, seconds: u64, device: Device, on: bool) {
        self.0.wait(seconds);
        let observation = self.report(device, on);
        self.0.enter(observation);
    }

    /// The probability that a person is in a room now; of `""`, out of the house.
    fn at(&mut self, who: &str, room: &str) -> f32 {
        let number = self.0.engine.persons().number_of(who);
        let now_ns = self.0.now_ns;
        let scores = *self.0.engine.person_scores(BootNs(now_ns));
        let forecasts = *self.0.engine.person_forecasts(BootNs(now_ns));
        forecasts.check().unwrap();
        let place = scores.persons().iter().position(|own| own.person == number.0).unwrap();
        let own = &forecasts.person[place];
        match self.room(room) {
            Some(room) => own.probability[room][0],
            None => own.elsewhere[0],
        }
    }

    fn room(&self, id: &str) -> Option<usize> {
        self.0.engine.room_ids().position(|room| room == id)
    }

    fn occupied(&mut self, room: &str) -> f32 {
        let room = self.room(room).unwrap();
        let forecast = self.0.engine.forecast(BootNs(self.0.now_ns));
        forecast.check().unwrap();
        forecast.probability[room][0]
    }

    fn house_empty(&mut self) -> f32 {
        self.0.engine.forecast(BootNs(self.0.now_ns)).elsewhere[0]
    }
}

#[test]
fn sleepers_stay_in_bed_if_another_person_gets_up() {
    let mut flat = Flat::new();
    flat.after(60, BED_JON, true);
    flat.after(60, BED_MIRA, true);
    flat.0.wait(3 * 3_600);
    flat.after(1, BED_JON, false);
    flat.after(10, CORRIDOR, true);
    flat.after(6, BATHROOM, true);
    flat.after(30, CORRIDOR, false);
    assert!(flat.at("Jon", "bathroom") > 0.7, "{}", flat.at("Jon", "bathroom"));
    assert!(flat.at("Mira", "bedroom") > 0.9, "{}", flat.at("Mira", "bedroom"));
    assert!(flat.occupied("bathroom") > 0.7 && flat.occupied("bedroom") > 0.9);
}

#[test]
fn false_alarms_bring_no_resident_home() {
    let mut flat = Flat::new();
    for phone in [PHONE_JON, PHONE_MIRA] {
        flat.after(60, CORRIDOR, true);
        flat.after(50, CORRIDOR, false);
        flat.after(10, phone, false);
    }
    flat.0.wait(1_800);
    assert_eq!((flat.0.presence("Jon"), flat.0.presence("Mira")), (Some(presence::AWAY), Some(presence::AWAY)));
    assert!(flat.house_empty() > 0.95, "{}", flat.house_empty());
    flat.after(1, CORRIDOR, true);
    assert_eq!((flat.0.presence("Jon"), flat.0.presence("Mira")), (Some(presence::AWAY), Some(presence::AWAY)));
    flat.after(50, CORRIDOR, false);
    flat.0.wait(900);
    assert!(flat.at("Jon", "") > 0.9 && flat.at("Mira", "") > 0.9, "{} {}", flat.at("Jon", ""), flat.at("Mira", ""));
    // Phones connect late.
    flat.after(60, CORRIDOR, true);
    flat.after(20, PHONE_JON, true);
    assert_eq!((flat.0.presence("Jon"), flat.0.presence("Mira")), (Some(presence::PRESENT), Some(presence::AWAY)));
}

#[test]
fn persons_whose_phone_left_are_away_after_some_silence_until_they_come_home() {
    let mut flat = Flat::new();
    flat.after(60, PHONE_JON, false);
    // No sensor saw him pass the corridor.
    assert_eq!(flat.0.presence("Jon"), Some(presence::PRESENT));
    flat.0.wait(3_600);
    assert!(flat.at("Jon", "") > 0.95, "{}", flat.at("Jon", ""));
    flat.0.wait(1);
    assert_eq!((flat.0.presence("Jon"), flat.0.presence("Mira")), (Some(presence::AWAY), Some(presence::PRESENT)));
    flat.0.after(1, "Jon", "They open the fridge.");
    assert_eq!(flat.0.presence("Jon"), Some(presence::PRESENT), "who comes home is present at once");
}

#[test]
fn events_with_a_date_of_1970_cost_no_time_and_no_belief() {
    let mut house = House::new(&["Jon", "Mira"]);
    house.engine = board_of(FLAT, &house.config);
    let old = |own: Observation| Observation { observed_ns: BootNs(0), observed_unix_ns: UnixNs(S), ..own };
    let first = old(house.observation("somebody", r#"{"sensor":"motion","id":"m","room":"corridor","on":true}"#));
    house.enter(first);
    house.after(1, "Jon", "They open the fridge.");
    let counted = old(house.observation("somebody", "Two people cook in the kitchen."));
    house.enter(counted);
    assert_eq!(house.presence("Jon"), Some(presence::PRESENT));
}

#[test]
fn late_unnamed_events_and_late_reports_move_nobody_and_say_why() {
    let mut flat = Flat::new();
    flat.0.after(200, "Jon", "They open the fridge.");
    flat.0.after(1, "Mira", "They sit on the sofa.");
    let late = |own: Observation| Observation { observed_ns: own.observed_ns.saturating_sub(120 * S), ..own };
    let text = late(flat.0.observation("somebody", "They close the fridge."));
    let sensor = late(flat.report(KITCHEN, true));
    let newer = flat.report(KITCHEN, false);
    for observation in [text, newer, sensor] {
        flat.0.enter(observation);
    }
    let lines = flat.0.engine.understood_lines(7, 1, 1);
    let why: Vec<_> = lines.iter().rev().take(3).map(|line| (line.persons.len(), line.why.clone())).collect();
    let outdated = (0, Some("a later event of this person or device says otherwise".to_owned()));
    assert_eq!(why, [outdated.clone(), (0, None), outdated]);
}

#[test]
fn repeated_reports_of_one_state_move_nobody() {
    let mut flat = Flat::new();
    flat.after(60, LIVING, true);
    flat.0.after(1, "Mira", "They sit on the sofa.");
    let before = flat.0.person("Mira").unwrap().observed_ns;
    flat.after(10, LIVING, true);
    assert_eq!(flat.0.person("Mira").unwrap().observed_ns, before);
}

#[test]
fn forgotten_persons_take_no_belief_of_others_along() {
    let mut flat = Flat::new();
    flat.0.after(1, "Guest", "They open the fridge.");
    flat.0.after(1, "Guest", "away");
    flat.0.after(1, "Mira", "They sit on the sofa.");
    assert!(flat.at("Mira", "living-room") > 0.8);
    forget(&mut flat.0, "Guest");
    flat.0.step(None);
    assert_eq!(flat.0.presence("Mira"), Some(presence::PRESENT));
    assert!(flat.at("Mira", "living-room") > 0.8);
}

#[test]
fn unnamed_departures_turn_no_resident_away_whose_bed_or_phone_says_otherwise() {
    let mut flat = Flat::new();
    flat.after(60, LIVING, true);
    flat.0.after(10, "Mira", "They sit on the sofa.");
    flat.0.after(10, "Jon", "They lie on the bed.");
    flat.after(1, BED_JON, true);
    flat.0.after(60, "somebody", "away");
    assert_eq!((flat.0.presence("Jon"), flat.0.presence("Mira")), (Some(presence::PRESENT), Some(presence::PRESENT)));
    assert!(flat.at("Mira", "living-room") > 0.8, "{}", flat.at("Mira", "living-room"));
}

#[test]
fn unnamed_actions_go_to_the_person_in_the_room_and_else_to_nobody() {
    let mut flat = Flat::new();
    flat.0.after(1, "Jon", "They open the fridge.");
    flat.0.after(1, "Mira", "They sit on the sofa.");
    flat.after(1, LIVING, true);
    flat.0.after(5, "somebody", "They close the fridge.");
    let told = |flat: &mut Flat, who: &str| flat.0.person(who).unwrap().observed_ns == flat.0.now_ns;
    assert!(told(&mut flat, "Jon") && !told(&mut flat, "Mira"));
    flat.0.after(5, "somebody", "They laugh.");
    assert!(!told(&mut flat, "Jon") && !told(&mut flat, "Mira"));
    let lines = flat.0.engine.understood_lines(7, 1, 1);
    assert!(lines.last().unwrap().why.as_deref().unwrap().contains("several persons"), "{lines:?}");
}

#[test]
fn sensors_of_unknown_rooms_change_nothing_and_say_why() {
    let mut flat = Flat::new();
    flat.after(1, ("motion", "attic", "attic", ""), true);
    let line = flat.0.engine.understood_lines(7, 1, 1).pop().unwrap();
    assert_eq!((line.event.as_str(), line.persons.len()), ("sensor", 0));
    assert!(line.why.as_deref().unwrap().contains("lacks the room"), "{line:?}");
}

#[test]
fn changed_devices_count_from_their_next_report() {
    let mut flat = Flat::new();
    flat.0.after(1, "Jon", "They open the fridge.");
    flat.0.after(1, "Mira", "They lie on the bed.");
    flat.after(60, ("motion", "motion-kitchen", "bathroom", ""), true);
    assert!(flat.occupied("bathroom") > 0.5, "{}", flat.occupied("bathroom"));
}

#[test]
fn sensors_outlive_a_restart() {
    let mut flat = Flat::new();
    flat.after(60, BED_JON, true);
    flat.0.after(60, "Mira", "They sit on the sofa.");
    flat.after(1, LIVING, true);
    let before = (flat.at("Jon", "bedroom"), flat.at("Mira", "living-room"), flat.occupied("kitchen"));
    let engine = board_of(FLAT, &flat.0.config);
    flat.0.restart_on(engine);
    let after = (flat.at("Jon", "bedroom"), flat.at("Mira", "living-room"), flat.occupied("kitchen"));
    let are_near = |a: f32, b: f32| (a - b).abs() < 0.01;
    assert!(
        are_near(before.0, after.0) && are_near(before.1, after.1) && are_near(before.2, after.2),
        "{before:?} {after:?}"
    );
    flat.0.wait(3_600);
    assert!(flat.at("Jon", "bedroom") > 0.9, "the bed is still on: {}", flat.at("Jon", "bedroom"));
}

#[test]
fn a_device_of_a_renamed_narrator_counts_once() {
    let mut flat = Flat::new();
    flat.0.after(1, "Jon", "They open the fridge.");
    flat.after(60, LIVING, true);
    flat.0.wait(60);
    assert!(flat.occupied("living-room") > 0.8, "{}", flat.occupied("living-room"));
    let report = flat.report(LIVING, true);
    flat.0.enter(Observation { source: 8, ..report });
    flat.0.wait(60);
    let report = flat.report(LIVING, false);
    flat.0.enter(Observation { source: 8, ..report });
    flat.0.wait(600);
    assert!(flat.occupied("living-room") < 0.3, "{}", flat.occupied("living-room"));
}

#[test]
fn the_motion_of_a_robot_is_explained_also_after_a_restart() {
    let mut flat = Flat::new();
    for phone in [PHONE_JON, PHONE_MIRA] {
        flat.after(60, CORRIDOR, true);
        flat.after(50, CORRIDOR, false);
        flat.after(10, phone, false);
    }
    flat.0.wait(1_800);
    let mut report = RobotReportV1 { kind: report_kind::STARTED, robot: 5, ..Default::default() };
    for (room, sensor) in [("corridor", CORRIDOR), ("kitchen", KITCHEN), ("bathroom", BATHROOM)] {
        report.room = text::encode("room", room).unwrap();
        flat.0.engine.see_report(&report, BootNs(flat.0.now_ns));
        for _ in 0..4 {
            flat.after(5, sensor, true);
            flat.after(60, sensor, false);
        }
    }
    let before = flat.house_empty();
    flat.0.restart_on(board_of(FLAT, &flat.0.config));
    let after = flat.house_empty();
    assert!(before > 0.9 && (before - after).abs() < 0.05, "{before} {after}");
}

#[test]
fn the_joint_belief_is_no_product_of_its_marginals() {
    let mut flat = Flat::new();
    flat.0.after(1, "Jon", "They open the fridge.");
    flat.0.after(1, "Mira", "They close the fridge.");
    // One of both leaves the kitchen.
    flat.after(20, CORRIDOR, true);
    let (jon, mira) = (flat.at("Jon", "corridor"), flat.at("Mira", "corridor"));
    assert!(jon > 0.2 && mira > 0.2 && jon < 0.8, "{jon} {mira}");
    let product = 1.0 - (1.0 - jon) * (1.0 - mira);
    let occupied = flat.occupied("corridor");
    assert!(occupied > product + 0.05, "{occupied} {product}");
}

#[test]
fn persons_in_a_bed_are_asleep_after_a_silence_until_they_get_up() {
    let is_asleep = |own: &mut Flat, who: &str| own.0.person(who).unwrap().flags & person_flags::ASLEEP != 0;
    for bed in [BED_JON, ("bed", "bed", "bedroom", "")] {
        let mut own = Flat::new();
        own.0.after(1, "Jon", "present in the corridor");
        own.0.after(1, "Mira", "present in the kitchen");
        own.after(60, bed, true);
        own.0.wait(7_200);
        assert!(is_asleep(&mut own, "Jon") && !is_asleep(&mut own, "Mira"), "{bed:?}");
        own.0.restart_on(board_of(FLAT, &own.0.config));
        assert!(is_asleep(&mut own, "Jon"), "{bed:?}, after a restart");
        own.after(60, bed, false);
        own.0.wait(7_200);
        assert!(!is_asleep(&mut own, "Jon"), "{bed:?}");
    }
}
