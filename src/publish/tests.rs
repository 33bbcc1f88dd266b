use super::known::ROBOTS_MAX;
use super::*;
use proptest::prelude::*;
use roomcast_core::ids::{BootNs, UnixNs};
use roomcast_ipc::raw::{StatusResponseV1, action, decision_flags, forecast_flags, presence};
use roomcast_ipc::text;
use roomcast_services::config::BridgeConfig;
use roomcast_services::participant::PLANNER;
use serde_json::{Value, json};

const ODD: &str = "a/b+c#<b>&\"{{x}}";

fn scores(ids: &[&str]) -> RoomScoresV1 {
    let mut scores = RoomScoresV1 { epoch: 1, sequence: 1, published_ns: 5, ..Default::default() };
    scores.room_count = ids.len() as u32;
    for (room, id) in scores.room.iter_mut().zip(ids) {
        room.id = text::encode("id", id).unwrap();
        room.probability = 1.0 / ids.len() as f64;
    }
    scores
}

/// Horizons 0, 60 and 600 s; a row for each room.
fn forecast(of: &RoomScoresV1, rows: &[[f32; 3]]) -> ForecastV1 {
    let mut forecast = ForecastV1 { room_count: of.room_count, horizon_count: 3, ..Default::default() };
    forecast.horizon_s[1..3].copy_from_slice(&[60.0, 600.0]);
    for (index, row) in rows.iter().enumerate() {
        forecast.id[index] = of.room[index].id;
        forecast.probability[index][..3].copy_from_slice(row);
    }
    forecast
}

fn persons(of: &RoomScoresV1, names: &[&str]) -> PersonForecastsV1 {
    let mut persons = PersonForecastsV1 { room_count: of.room_count, horizon_count: 3, ..Default::default() };
    persons.horizon_s[1..3].copy_from_slice(&[60.0, 600.0]);
    for (index, room) in of.rooms().iter().enumerate() {
        persons.id[index] = room.id;
    }
    persons.person_count = names.len() as u32;
    for (person, name) in persons.person.iter_mut().zip(names) {
        person.name = text::encode("name", name).unwrap();
        person.presence = presence::PRESENT;
        person.probability[0] = [0.7; roomcast_ipc::raw::MAX_HORIZONS];
        person.elsewhere[2] = 0.9;
    }
    persons
}

fn known(ids: &[&str], rows: &[[f32; 3]], names: &[&str]) -> Known {
    let mut known = Known::default();
    let scores = scores(ids);
    known.take_scores(&scores);
    known.take_forecast(&forecast(&scores, rows));
    known.take_persons(&persons(&scores, names));
    known
}

fn draw(known: &mut Known) -> Picture {
    known.picture(&BridgeConfig::default(), "robot", true)
}

fn message(picture: &Picture, topic: &str) -> Value {
    serde_json::from_str(picture.get(topic).unwrap_or_else(|| panic!("no {topic} in {:?}", picture.keys()))).unwrap()
}

#[test]
fn rooms_are_told_now_and_later() {
    let mut known = known(&["kitchen", "hall"], &[[0.9, 0.4, 0.2], [0.0, 0.104, 0.3]], &["ada"]);
    let picture = draw(&mut known);
    assert_eq!(
        message(&picture, "roomcast/rooms/hall"),
        json!({
            "room": "hall", "name": "hall", "next": 0.5, "now": 0.0, "at": { "60": 0.1, "600": 0.3 }, "soon": false,
            "good": null, "reason": null, "cleaned_unix_s": null,
        })
    );
    assert_eq!(message(&picture, "roomcast/rooms/kitchen")["soon"], true);
    assert_eq!(message(&picture, "roomcast/home"), json!({ "somebody": true, "persons": 0 }));
    assert_eq!(picture["roomcast/status"], "online");
}

#[test]
fn what_is_not_known_is_null_and_nobody_home_is_false() {
    let scores = scores(&["kitchen"]);
    let mut known = known(&["kitchen"], &[[0.5, 0.5, 0.5]], &[]);
    let of = |flags| ForecastV1 { flags, ..forecast(&scores, &[[0.5; 3]]) };
    known.take_forecast(&of(forecast_flags::NOT_KNOWN));
    let picture = draw(&mut known);
    assert_eq!(message(&picture, "roomcast/rooms/kitchen")["now"], Value::Null);
    assert_eq!(message(&picture, "roomcast/rooms/kitchen")["soon"], Value::Null);
    assert_eq!(message(&picture, "roomcast/home")["somebody"], Value::Null);
    known.take_forecast(&of(forecast_flags::NOBODY_HOME));
    assert_eq!(message(&draw(&mut known), "roomcast/home")["somebody"], false);
}

#[test]
fn health_says_what_the_forecast_lacks() {
    let scores = scores(&["kitchen"]);
    let mut known = Known::default();
    known.take_scores(&scores);
    assert_eq!(message(&draw(&mut known), "roomcast/health")["forecast"], Value::Null);
    known.take_forecast(&ForecastV1 { flags: forecast_flags::RESIDENT_UNKNOWN, ..forecast(&scores, &[[0.5; 3]]) });
    assert_eq!(message(&draw(&mut known), "roomcast/health")["forecast"], json!(["resident-unknown"]));
}

/// Home Assistant warns about an invalid time, and shows a null text as the word `None`.
#[test]
fn no_entity_is_told_of_a_time_or_a_text_that_is_none() {
    let (topic, entity) = ("roomcast/narrated", "homeassistant/sensor/roomcast/narrated/config");
    let mut known = known(&["kitchen"], &[[0.0; 3]], &["ada"]);
    let picture = draw(&mut known);
    assert_eq!((picture.get(topic), picture.get(entity)), (None, None));
    assert_eq!(message(&picture, "roomcast/health")["narrated_unix_s"], Value::Null);
    let heard = RoomScoresV1 {
        observed_ns: 3_000_000_000,
        computed_ns: 5_000_000_000,
        computed_unix_ns: 1_790_000_000_000_000_000,
        ..scores(&["kitchen"])
    };
    known.take_scores(&heard);
    assert_eq!(message(&draw(&mut known), topic), 1_789_999_998);
    // A daemon without memory does not retract the time.
    known.take_scores(&scores(&["kitchen"]));
    let picture = draw(&mut known);
    assert_eq!(message(&picture, topic), 1_789_999_998);
    assert_eq!(message(&picture, entity)["state_topic"], topic);
    let has_state = |topic: &str| topic.ends_with("/config") && !topic.contains("/button/");
    for (topic, payload) in picture.iter().filter(|(topic, _)| has_state(topic)) {
        let config: Value = serde_json::from_str(payload).unwrap();
        let template = config["value_template"].as_str().unwrap();
        // Numbers and binary sensors take `None` for unknown.
        let takes_none = topic.contains("/binary_sensor/")
            || topic.contains("/select/")
            || config.get("unit_of_measurement").is_some();
        assert_eq!(template.contains("None"), takes_none, "{topic}: {template}");
        let is_never_none = ["narrated", "_decision", "_reason", "_hold"].iter().any(|part| topic.contains(part));
        assert!(takes_none || is_never_none || template.contains("or 'unknown'"), "{topic}: {template}");
    }
}

#[test]
fn somebody_soon_has_hysteresis() {
    let scores = scores(&["kitchen"]);
    let mut known = known(&["kitchen"], &[[0.0; 3]], &[]);
    let mut soon = |p: f32| {
        known.take_forecast(&forecast(&scores, &[[0.0, p, 1.0]]));
        message(&draw(&mut known), "roomcast/rooms/kitchen")["soon"].as_bool().unwrap()
    };
    assert_eq!([0.45, 0.5, 0.45, 0.4, 0.39, 0.45].map(&mut soon), [false, true, true, true, false, false]);
}

#[test]
fn persons_are_in_their_likeliest_room_or_away() {
    let mut known = known(&["kitchen", "hall"], &[[0.9; 3]; 2], &["ada"]);
    let ada = message(&draw(&mut known), "roomcast/persons/ada");
    assert_eq!(
        (&ada["likely"], &ada["presence"], &ada["at"]["60"]["likely"]),
        (&json!("kitchen"), &json!("present"), &json!("kitchen"))
    );
    assert_eq!(ada["at"]["600"], json!({ "likely": "away", "likely_name": "away", "probability": 0.9, "away": 0.9 }));
    assert_eq!(ada.get("set"), None, "the daemon made no sets");
    let mut all = persons(&scores(&["kitchen", "hall"]), &["ada", ""]);
    (all.person[0].set_coverage, all.person[0].room_set[0]) = (0.9, 0b10);
    (all.person[1].person, all.person[1].presence) = (7, presence::UNKNOWN);
    known.take_persons(&all);
    let picture = draw(&mut known);
    assert_eq!(
        message(&picture, "roomcast/persons/ada")["set"],
        json!({ "coverage": 0.9, "rooms": ["hall"], "away": false })
    );
    let stranger = picture.keys().find(|topic| topic.starts_with("roomcast/persons/person_7_")).unwrap();
    assert_eq!(message(&picture, stranger)["likely"], Value::Null);
}

#[test]
fn a_selection_of_rooms_corrects_a_persons_place_and_disappears_with_the_person() {
    let mut known = known(&["kitchen", "hall-2"], &[[0.9; 3]; 2], &["ada"]);
    let topic = "homeassistant/select/roomcast/person_ada_place/config";
    let select = message(&draw(&mut known), topic);
    assert_eq!(select["options"], json!(["kitchen", "hall", "away"]));
    assert_eq!(select["command_topic"], "roomcast/persons/ada/place");
    assert_eq!(known.correctable(), [("ada".to_owned(), "ada".parse().unwrap())]);
    known.take_persons(&persons(&scores(&["kitchen", "hall-2"]), &[]));
    assert!(!draw(&mut known).contains_key(topic));
}

#[test]
fn decisions_come_with_their_reason_and_robots_are_bounded() {
    let mut known = known(&["kitchen"], &[[0.0; 3]], &[]);
    let decision = DecisionV1 {
        robot: sequence::source_of_name("robot"),
        sequence: 3,
        action: action::GO,
        to: text::encode("to", "kitchen").unwrap(),
        reason: text::encode("reason", "nobody is \"there\"").unwrap(),
        ..Default::default()
    };
    known.take_decision(&decision, "robot");
    let told = message(&draw(&mut known), "roomcast/robots/robot");
    assert_eq!(
        (&told["action"], &told["room"], &told["reason"]),
        (&json!("go"), &json!("kitchen"), &json!("nobody is \"there\""))
    );
    let mut other = decision;
    for number in 1..100 {
        (other.robot, other.decided_ns) = (number, number);
        known.take_decision(&other, "robot");
    }
    let all = draw(&mut known);
    let robots = all.keys().filter(|topic| topic.starts_with("roomcast/robots/")).count();
    assert_eq!(robots, ROBOTS_MAX);
    assert_eq!(message(&all, "roomcast/robots/robot")["reason"], told["reason"], "the configured one keeps its place");
}

#[test]
fn robots_have_their_planners_names_and_go_with_them() {
    let mut known = known(&["kitchen"], &[[0.0; 3]], &[]);
    let decision = |robot: &str| DecisionV1 {
        robot: sequence::source_of_name(robot),
        // A decision from another machine may have no name.
        robot_name: text::encode_cut(if robot == "far" { "" } else { robot }),
        ..Default::default()
    };
    let robots = |known: &mut Known| {
        let all = draw(known).into_keys();
        all.filter_map(|topic| topic.strip_prefix("roomcast/robots/").map(str::to_owned)).collect::<Vec<_>>()
    };
    ["robot", "mop2", "far", "Staubi Ä"].iter().for_each(|robot| known.take_decision(&decision(robot), "robot"));
    // Names of participants are ASCII.
    let planners = ["robot", "mop2", "Staubi Ä"].map(|robot| PLANNER.name(robot).replace('Ä', "?"));
    known.take_planners(&[&planners[..], &["roomcast-publish".to_owned()]].concat(), "robot");
    let far = format!("robot_{:016x}", sequence::source_of_name("far"));
    let shown = robots(&mut known);
    assert!(shown[0] == "mop2" && shown[1] == "robot" && shown.len() == 4, "{shown:?}");
    assert!(shown[2].starts_with(&far) && shown[3] == roomcast_services::slug::slug("Staubi Ä"), "{shown:?}");
    // If a robot's planner is here, a bridge's decisions for it are ignored.
    for robot in ["robot", "mop2"] {
        let flags = decision_flags::ELSEWHERE;
        known.take_decision(&DecisionV1 { flags, sequence: 9, ..decision(robot) }, "robot");
        assert_eq!(message(&draw(&mut known), &format!("roomcast/robots/{robot}"))["decision"], 0);
    }
    // The configured robot stays, and a robot on another machine cannot be seen to end.
    known.take_planners(&[], "robot");
    assert_eq!(robots(&mut known), shown[1..3]);
}

/// Row "somebody else below our topics" of the attacks.
#[test]
fn only_what_an_earlier_run_has_listed_is_found() {
    let mut incoming = Incoming::new(&Config::default());
    let heard = |topic: &str, payload: &str| Heard { topic: topic.into(), payload: payload.into(), retained: true };
    let entity = r#"{"origin": {"name": "roomcast"}, "device": {"identifiers": ["roomcast"]}}"#;
    let list = r##"{"origin": {"name": "roomcast"}, "node": "roomcast",
        "topics": ["rooms/attic", "rooms/gone", "rooms/#", "#", "persons/+", "elsewhere/x", "status"]}"##;
    let said = [
        heard("roomcast/persons/of_my_neighbour", "keep me"),
        heard("roomcast/rooms/attic", "{}"),
        heard("roomcast/bridge/topics", list),
        heard("roomcast/status", "offline"),
        heard("roomcast/rooms/other_program", "{}"),
        // Topics that no broker retains, and topics outside the filters.
        heard("roomcast/#", "x"),
        heard("roomcast/rooms/#", "x"),
        heard("roomcast/persons/+", "x"),
        heard("roomcast/elsewhere/x", "x"),
        heard("homeassistant/#/roomcast/x/config", entity),
        heard("lamp/sensor/roomcast/x/config", entity),
        heard("homeassistant/sensor/roomcast/old/config", entity),
        heard("homeassistant/sensor/roomcast/x/config", r#"{"origin": {"name": "else"}}"#),
    ];
    let mut outbox = Outbox::with_list("roomcast", "roomcast");
    said.into_iter().for_each(|said| incoming.hear(said, &mut outbox));
    let marker = Heard { topic: incoming.marker.clone(), payload: incoming.nonce.clone().into(), retained: false };
    incoming.hear(marker, &mut outbox);
    assert!(incoming.all);
    let mut removed = Vec::new();
    for _ in 0..8 {
        outbox.want(Picture::new(), true);
        while let Some((topic, payload)) = outbox.next().map(|(topic, payload)| (topic.to_owned(), payload.to_owned()))
        {
            outbox.done(&topic);
            removed.extend(payload.is_empty().then_some(topic));
        }
    }
    assert!(outbox.is_done());
    let own = ["homeassistant/sensor/roomcast/old/config", "roomcast/rooms/attic", "roomcast/status"];
    assert_eq!(removed, [&own[..], &["roomcast/bridge/topics"]].concat());
}

#[test]
fn discovery_is_one_device_with_unique_safe_ids_whatever_names_are_like() {
    let long = "x".repeat(48);
    let ids = ["kitchen", ODD, "küche", "a b", "a_b", long.as_str()];
    let mut known = known(&ids, &[[0.1; 3]; 6], &[ODD, "Ada Lovelace"]);
    let picture = draw(&mut known);
    let configs: Vec<_> = picture.iter().filter(|(topic, _)| topic.ends_with("/config")).collect();
    // Two of the home, five of each room, five of each person, five of the robot, and two of its buttons for each room.
    assert_eq!(configs.len(), 2 + 6 * 5 + 2 * 5 + 5 + 6 * 2);
    let mut unique = std::collections::HashSet::new();
    for (topic, payload) in configs {
        let levels: Vec<_> = topic.split('/').collect();
        assert!(
            matches!(
                levels[..],
                ["homeassistant", "sensor" | "binary_sensor" | "switch" | "button" | "select", "roomcast", _, "config"]
            ),
            "{topic}"
        );
        let safe = |text: &str| text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
        let config: Value = serde_json::from_str(payload).unwrap();
        assert!(safe(levels[3]) && safe(config["unique_id"].as_str().unwrap()), "{topic}: {payload}");
        assert!(unique.insert(config["unique_id"].clone()), "{payload}");
        assert_eq!(config["device"]["identifiers"], json!(["roomcast"]));
        assert_eq!(config["origin"]["name"], "roomcast");
        assert_eq!(config["availability"][0]["topic"], "roomcast/status");
        assert!(discovery::is_own(payload.as_bytes(), "roomcast") && !discovery::is_own(payload.as_bytes(), "other"));
        if levels[1] == "button" {
            assert!(config["command_topic"].as_str().unwrap().starts_with("roomcast/robots/robot/"), "{payload}");
            assert!(config.get("state_topic").is_none() && config.get("value_template").is_none(), "{payload}");
            continue;
        }
        let state = config["state_topic"].as_str().unwrap();
        assert!(state == "roomcast/robots/robot" || picture.contains_key(state), "{state}");
        assert!(!config["value_template"].as_str().unwrap().contains("<b>"), "no name is part of a template");
    }
    assert!(picture.keys().all(|topic| !topic.contains(['+', '#', '\0', ' '])), "{:?}", picture.keys());
    assert!(!discovery::is_own(b"{\"name\": \"lamp\"}", "roomcast") && !discovery::is_own(b"\xff", "roomcast"));
}

/// Names that are parts of topics and ids: endings, numbers, checksums, and names that look like results.
fn names() -> impl Strategy<Value = String> {
    let word = proptest::sample::select(vec!["lily", "tom", "person", "robot", "x", "Ä", "in", "s", "5", "600"]);
    let joint = proptest::sample::select(vec!["_", " ", "_in_", "-", ""]);
    let ending = proptest::sample::select(vec![
        "",
        "",
        "_in_600_s",
        "_in_60_s",
        "_in_1.5_s",
        "_home",
        "_place",
        "_now",
        "_soon",
        "_decision",
        "_room",
        "_s",
        " 0000000000000005",
    ]);
    let name = (word.clone(), joint, word, ending).prop_map(|(a, b, c, d)| format!("{a}{b}{c}{d}"));
    let name = proptest::prop_oneof![4 => name, 1 => Just("person 5".to_owned()), 1 => Just("lily".to_owned())];
    // Also the results of names, and the results of results.
    let names = (name, 0..4_u32, 0..3).prop_map(|(name, number, times)| {
        let becomes = |name: String, _| match number {
            0 => names::of_room(&name),
            1 => names::of_person(5, &name),
            2 => names::of_robot(5, Some(&name)),
            _ => name,
        };
        (0..times).fold(name, becomes)
    });
    names.prop_filter("a name fits into a message", |name| name.len() <= roomcast_ipc::raw::NAME_BYTES)
}

proptest::proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, failure_persistence: None, ..ProptestConfig::default() })]

    /// All topics, ids and states stay apart, for any names of rooms, persons and robots.
    #[test]
    fn nobodys_name_takes_anothers_place(
        rooms in proptest::collection::btree_set(names(), 1..4),
        named in proptest::collection::btree_set(names().prop_map(|name| name.to_lowercase()), 0..5),
        robots in proptest::collection::btree_set(names(), 0..3),
        unnamed in 0..3_u32,
        unknown in 0..2_u64,
        horizons_s in proptest::sample::subsequence(vec![1.5, 60.0, 600.0], 0..3),
    ) {
        let rooms: Vec<&str> = rooms.iter().map(String::as_str).collect();
        let mut people: Vec<&str> = named.iter().map(String::as_str).collect();
        people.extend(vec![""; unnamed as usize]);
        let mut known = known(&rooms, &vec![[0.1; 3]; rooms.len()], &[]);
        let mut told = persons(&scores(&rooms), &people);
        (4..).zip(&mut told.person).for_each(|(number, person)| person.person = number);
        known.take_persons(&told);
        let participants: Vec<_> = robots.iter().map(|name| PLANNER.name(name)).collect();
        for name in &robots {
            let (robot, robot_name) = (sequence::source_of_name(name), text::encode_cut(name));
            known.take_decision(&DecisionV1 { robot, robot_name, ..Default::default() }, "own");
        }
        (0..unknown).for_each(|n| known.take_decision(&DecisionV1 { robot: 5 + n, ..Default::default() }, "own"));
        known.take_planners(&participants, "own");
        let config = BridgeConfig { horizons_s: horizons_s.clone(), ..BridgeConfig::default() };
        let picture = known.picture(&config, "own", true);
        let entities: Vec<Value> = picture
            .iter()
            .filter(|(topic, _)| topic.ends_with("/config"))
            .map(|(_, payload)| serde_json::from_str(payload).unwrap())
            .collect();
        let (each, all_robots) = (2 + horizons_s.len(), robots.len() + unknown as usize);
        let own = 1 + 2 * rooms.len();
        let expected = 2 + each * (rooms.len() + people.len()) + rooms.len() + people.len() + 4 * (all_robots + 1) + own;
        let of = |key: &str| {
            entities.iter().filter_map(|entity| Some(entity.get(key)?.to_string())).collect::<BTreeSet<_>>()
        };
        prop_assert_eq!(entities.len(), expected, "topics of {:?} {:?} {:?}", rooms, people, robots);
        prop_assert_eq!(of("unique_id").len(), expected, "ids of {:?} {:?} {:?}", rooms, people, robots);
        // The home's, the daemon's, and one for each.
        let states = 2 + rooms.len() + people.len() + all_robots + 1;
        prop_assert_eq!(of("state_topic").len(), states, "states of {:?} {:?} {:?}", rooms, people, robots);
        let kept = picture.keys().filter(|topic| ["/rooms/", "/persons/", "/robots/"].iter().any(|kind| topic.contains(kind)));
        prop_assert_eq!(kept.count(), states - 3, "messages of {:?} {:?} {:?}", rooms, people, robots);
    }
}

#[test]
fn without_a_prefix_there_is_no_discovery_and_horizons_can_be_any() {
    let mut known = known(&["kitchen"], &[[0.1, 0.2, 0.3]], &[]);
    let config = BridgeConfig { discovery: String::new(), horizons_s: vec![1.5, 86_400.0], ..BridgeConfig::default() };
    let picture = known.picture(&config, "robot", false);
    assert!(picture.keys().all(|topic| topic.starts_with("roomcast/")));
    assert_eq!(message(&picture, "roomcast/rooms/kitchen")["at"], json!({ "1.5": 0.1, "86400": 0.3 }));
    assert_eq!(picture["roomcast/daemon"], "offline");
    let config = BridgeConfig { discovery: "ha".to_owned(), ..config };
    let picture = known.picture(&config, "robot", true);
    assert!(picture.keys().all(|topic| !topic.contains('.')), "{:?}", picture.keys());
}

/// Regression: the daemon's counters are unchecked, and an overflowing sum ended the bridge.
#[test]
fn counters_without_measure_are_told_as_the_most_there_is() {
    let mut known = known(&["kitchen"], &[[0.0; 3]], &[]);
    known.take_status(Some(StatusResponseV1 { malformed: u64::MAX, limited: 1, ..Default::default() }));
    assert_eq!(message(&draw(&mut known), "roomcast/health")["refused"], json!(u64::MAX));
}

#[test]
fn a_room_says_whether_it_is_a_good_time_to_clean_it_and_when_that_was_done() {
    let text = "[planner]\nquiet = [\"00:00-00:00 in kitchen\"]\nknow_s = 0.0";
    let config = toml::from_str(text).unwrap();
    let mut known = known(&["kitchen", "hall"], &[[0.0; 3]; 2], &[]).with_advisor(Planner::for_advice(&config));
    let told = |known: &mut Known, room: &str| -> Value {
        known.advise(BootNs(6), UnixNs(6), "robot");
        serde_json::from_str(&draw(known)[&format!("roomcast/rooms/{room}")]).unwrap()
    };
    let kitchen = told(&mut known, "kitchen");
    let reason = kitchen["reason"].as_str().unwrap();
    assert!(kitchen["good"] == false && reason.starts_with("Quiet hours in the kitchen until "), "{kitchen}");
    let hall = told(&mut known, "hall");
    assert_eq!([&hall["good"], &hall["reason"], &hall["cleaned_unix_s"]], [&json!(true), &Value::Null, &Value::Null]);
    assert!(!draw(&mut known).contains_key("homeassistant/sensor/roomcast/hall_cleaned/config"));
    let mut decision = DecisionV1 {
        robot: sequence::source_of_name("robot"),
        decided_unix_ns: 10_000_000_000_000,
        flags: decision_flags::HELD,
        ..Default::default()
    };
    decision.cleaned_min[1] = 61;
    known.take_decision(&decision, "robot");
    let hall = told(&mut known, "hall");
    assert_eq!(
        [&hall["good"], &hall["reason"], &hall["cleaned_unix_s"]],
        [&json!(false), &json!("On hold."), &json!(6_360)]
    );
    assert!(draw(&mut known).contains_key("homeassistant/sensor/roomcast/hall_cleaned/config"));
}
