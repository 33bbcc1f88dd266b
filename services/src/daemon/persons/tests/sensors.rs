//! Homes with sensors: the joint filter in the daemon.

use super::*;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{RobotReportV1, report_kind};

const ALL: [Device; 8] = [
    ("bed", "bed-jon", "bedroom", "Jon"),
    ("bed", "bed-mira", "bedroom", "Mira"),
    ("phone", "phone-jon", "", "Jon"),
    ("phone", "phone-mira", "", "Mira"),
    ("motion", "corridor", "corridor", ""),
    ("motion", "bathroom", "bathroom", ""),
    ("motion", "kitchen", "kitchen", ""),
    ("presence", "living", "living-room", ""),
];
const LIVING: Device = ALL[7];

/// Both persons leave.
const LEAVE: &str =
    "60 corridor on | 50 corridor off | 10 phone-jon off | 60 corridor on | 50 corridor off | 10 phone-mira off | 1800";

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

    fn of(steps: &str) -> Self {
        let mut own = Self::new();
        own.play(steps);
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

    /// Plays steps with ` | ` between them: `60 kitchen on` of a device, `60` of silence, and those of [`House::play`]. `? Jon away` and
    /// `? Jon kitchen > .5` demand a presence and a belief; "somebody" and "nobody" stand for the whole home.
    fn play(&mut self, steps: &str) {
        for step in steps.split(" | ") {
            match step.split(' ').collect::<Vec<_>>()[..] {
                ["?", who, word] => {
                    assert_eq!(
                        self.0.presence(who).map(|own| roomcast_ipc::Presence::of(own).word()),
                        Some(word),
                        "{step}"
                    );
                }
                ["?", who, place, sign, bound] => {
                    let (is, bound) = (self.at(who, place), bound.parse().unwrap());
                    assert!(if sign == ">" { is > bound } else { is < bound }, "{is}: {step} of {steps}");
                }
                [seconds] => drop(self.0.wait(seconds.parse().unwrap())),
                [seconds, id, state @ ("on" | "off")] => {
                    let device = ALL.into_iter().find(|device| device.1 == id).unwrap();
                    self.after(seconds.parse().unwrap(), device, state == "on");
                }
                _ => self.0.play(step),
            }
        }
    }

    /// The probability that a person is in a room now, or "out".
    fn at(&mut self, who: &str, room: &str) -> f32 {
        let (room, now_ns) = (self.0.engine.room_ids().position(|id| id == room), BootNs(self.0.now_ns));
        let forecast = self.0.engine.forecast(now_ns);
        forecast.check().unwrap();
        match (who, room) {
            ("somebody", Some(room)) => return forecast.probability[room][0],
            ("nobody", None) => return forecast.elsewhere[0],
            _ => {}
        }
        let number = self.0.engine.persons().number_of(who);
        let scores = *self.0.engine.person_scores(now_ns);
        let forecasts = *self.0.engine.person_forecasts(now_ns);
        forecasts.check().unwrap();
        let own = &forecasts.person[scores.persons().iter().position(|own| own.person == number.0).unwrap()];
        room.map_or(own.elsewhere[0], |room| own.probability[room][0])
    }
}

#[test]
fn sleepers_stay_in_bed_if_another_person_gets_up() {
    Flat::of(
        "60 bed-jon on | 60 bed-mira on | 10800 | 1 bed-jon off | 10 corridor on | 6 bathroom on | 30 corridor off | \
         ? Jon bathroom > .7 | ? Mira bedroom > .9 | ? somebody bathroom > .7 | ? somebody bedroom > .9",
    );
}

#[test]
fn false_alarms_bring_no_resident_home() {
    let mut flat = Flat::of(LEAVE);
    flat.play("? Jon away | ? Mira away | ? nobody out > .95 | 1 corridor on | ? Jon away | ? Mira away");
    flat.play("50 corridor off | 900 | ? Jon out > .9 | ? Mira out > .9");
    // Phones connect late.
    flat.play("60 corridor on | 20 phone-jon on | ? Jon present | ? Mira away");
}

#[test]
fn persons_whose_phone_left_are_away_after_some_silence_until_they_come_home() {
    // No sensor saw him pass the corridor.
    let mut flat =
        Flat::of("60 phone-jon off | ? Jon present | 3600 | ? Jon out > .95 | 1 | ? Jon away | ? Mira present");
    flat.play("1 Jon: They open the fridge. | ? Jon present");
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
    let mut flat = Flat::of("200 Jon: They open the fridge. | 1 Mira: They sit on the sofa.");
    let late = |own: Observation| Observation { observed_ns: own.observed_ns.saturating_sub(120 * S), ..own };
    let text = late(flat.0.observation("somebody", "They close the fridge."));
    let sensor = late(flat.report(ALL[6], true));
    let newer = flat.report(ALL[6], false);
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
    let mut flat = Flat::of("60 living on | 1 Mira: They sit on the sofa.");
    let before = flat.0.person("Mira").unwrap().observed_ns;
    flat.play("10 living on");
    assert_eq!(flat.0.person("Mira").unwrap().observed_ns, before);
}

#[test]
fn forgotten_persons_take_no_belief_of_others_along() {
    let mut flat = Flat::of("1 Guest: They open the fridge. | 1 Guest: away | 1 Mira: They sit on the sofa.");
    flat.play("? Mira living-room > .8");
    forget(&mut flat.0, "Guest");
    flat.play("0 | ? Mira present | ? Mira living-room > .8");
}

#[test]
fn unnamed_departures_turn_no_resident_away_whose_bed_or_phone_says_otherwise() {
    let mut flat =
        Flat::of("60 living on | 10 Mira: They sit on the sofa. | 10 Jon: They lie on the bed. | 1 bed-jon on");
    flat.play("60: away | ? Jon present | ? Mira present | ? Mira living-room > .8");
}

#[test]
fn unnamed_actions_go_to_the_person_in_the_room_and_else_to_nobody() {
    let mut flat = Flat::of("1 Jon: They open the fridge. | 1 Mira: They sit on the sofa. | 1 living on");
    let told = |flat: &mut Flat| ["Jon", "Mira"].map(|who| flat.0.person(who).unwrap().observed_ns == flat.0.now_ns);
    flat.play("5: They close the fridge.");
    assert_eq!(told(&mut flat), [true, false]);
    flat.play("5: They laugh.");
    assert_eq!(told(&mut flat), [false, false]);
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
    let mut flat = Flat::of("1 Jon: They open the fridge. | 1 Mira: They lie on the bed.");
    flat.after(60, ("motion", "kitchen", "bathroom", ""), true);
    flat.play("? somebody bathroom > .5");
}

#[test]
fn sensors_outlive_a_restart() {
    let mut flat = Flat::of("60 bed-jon on | 60 Mira: They sit on the sofa. | 1 living on");
    let places = [("Jon", "bedroom"), ("Mira", "living-room"), ("somebody", "kitchen")];
    let before = places.map(|(who, room)| flat.at(who, room));
    flat.0.restart_on(board_of(FLAT, &flat.0.config));
    let after = places.map(|(who, room)| flat.at(who, room));
    assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 0.01), "{before:?} {after:?}");
    // The bed is still on.
    flat.play("3600 | ? Jon bedroom > .9");
}

#[test]
fn a_device_of_a_renamed_narrator_counts_once() {
    let mut flat = Flat::of("1 Jon: They open the fridge. | 60 living on | 60 | ? somebody living-room > .8");
    for (on, seconds) in [(true, 60), (false, 600)] {
        let report = flat.report(LIVING, on);
        flat.0.enter(Observation { source: 8, ..report });
        flat.0.wait(seconds);
    }
    flat.play("0 | ? somebody living-room < .3");
}

#[test]
fn the_motion_of_a_robot_is_explained_also_after_a_restart() {
    let mut flat = Flat::of(LEAVE);
    let mut report = RobotReportV1 { kind: report_kind::STARTED, robot: 5, ..Default::default() };
    for room in ["corridor", "kitchen", "bathroom"] {
        report.room = text::encode("room", room).unwrap();
        flat.0.engine.see_report(&report, BootNs(flat.0.now_ns));
        (0..4).for_each(|_| flat.play(&format!("5 {room} on | 60 {room} off")));
    }
    let before = flat.at("nobody", "out");
    flat.0.restart_on(board_of(FLAT, &flat.0.config));
    let after = flat.at("nobody", "out");
    assert!(before > 0.9 && (before - after).abs() < 0.05, "{before} {after}");
}

#[test]
fn the_joint_belief_is_no_product_of_its_marginals() {
    // One of both leaves the kitchen.
    let mut flat = Flat::of("1 Jon: They open the fridge. | 1 Mira: They close the fridge. | 20 corridor on");
    let [jon, mira, occupied] = ["Jon", "Mira", "somebody"].map(|who| flat.at(who, "corridor"));
    assert!(jon > 0.2 && mira > 0.2 && jon < 0.8, "{jon} {mira}");
    let product = 1.0 - (1.0 - jon) * (1.0 - mira);
    assert!(occupied > product + 0.05, "{occupied} {product}");
}

#[test]
fn persons_in_a_bed_are_asleep_after_a_silence_until_they_get_up() {
    let are_asleep =
        |own: &mut Flat| ["Jon", "Mira"].map(|who| own.0.person(who).unwrap().flags & person_flags::ASLEEP != 0);
    for bed in [ALL[0], ("bed", "bed", "bedroom", "")] {
        let mut own = Flat::of("1 Jon: present in the corridor | 1 Mira: present in the kitchen");
        own.after(60, bed, true);
        own.0.wait(7_200);
        assert_eq!(are_asleep(&mut own), [true, false], "{bed:?}");
        own.0.restart_on(board_of(FLAT, &own.0.config));
        assert!(are_asleep(&mut own)[0], "{bed:?}, after a restart");
        own.after(60, bed, false);
        own.0.wait(7_200);
        assert!(!are_asleep(&mut own)[0], "{bed:?}");
    }
}
