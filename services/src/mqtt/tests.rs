//! Rules, memory of messages, and real brokers.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Packet;
use rumqttc::v5::{AsyncClient, Client, Event};

use super::client::broken;
use super::rehearsal::report;
use super::rules::{covers, matches};
use super::*;
use crate::line::{Who, line_item};
use crate::mosquitto::{Mosquitto, NO_BROKER, free_port};
use crate::skipped::skipped;

const RULES: &str = r#"rule = [
    { topic = "home/binary_sensor/fridge_door/state", when = "on", say = "They open the fridge." },
    { topic = "home/+/+/json", field = "/state/power", say = "the {2} is {value}", person = 1, retained = true },
]"#;

fn hear(listener: &mut Listener, topic: &str, payload: &str, retained: bool) -> Option<String> {
    let mut lines = listener.hear(topic.as_bytes(), payload.as_bytes(), retained, Instant::now());
    assert!(lines.len() <= 1, "{lines:?}");
    lines.pop()
}

/// Each message of a topic gives these lines.
fn gives(rules: &str, messages: &[(&str, &str, &str)]) -> Heard {
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    for (topic, payload, lines) in messages {
        let said = listener.hear(topic.as_bytes(), payload.as_bytes(), false, Instant::now());
        assert_eq!(said.join("\n"), *lines, "{topic} {payload}");
    }
    listener.heard
}

#[test]
fn rules_make_sentences() {
    gives(
        RULES,
        &[
            ("home/binary_sensor/fridge_door/state", "ON", r#"{"text":"They open the fridge."}"#),
            ("home/binary_sensor/fridge_door/state", "off", ""),
            (
                "home/switch/coffee_maker/json",
                r#"{"state": {"power": "on"}}"#,
                r#"{"kind":"device","person":1,"text":"the coffee maker is on"}"#,
            ),
            ("home/switch/coffee_maker/json", "{", ""),
        ],
    );
    assert!(Rules::parse(RULES).unwrap().readings("elsewhere", b"\xff\xfe").is_empty());
}

const SEVERAL: &str = r#"rule = [
    { topic = "z/+", field = "/occupancy", when = "true", presence = "present", room = "{1}" },
    { topic = "z/+", field = "/state", when = "on", say = "They turn on the lamp." },
    { topic = "z/+", field = "/state", say = "the lamp is {value}" },
    { topic = "z/+", field = "/state", when = "on", presence = "present" },
]"#;

#[test]
fn one_message_says_several_things() {
    let occupied = r#"{"presence":"present","room":"hall"}"#;
    let all = format!("{occupied}\n{{\"text\":\"They turn on the lamp.\"}}\n{{\"presence\":\"present\"}}");
    let messages = [
        (r#"{"occupancy": true, "state": "ON", "linkquality": 80}"#, &*all),
        // Both values repeat.
        (r#"{"occupancy": true, "state": "ON", "linkquality": 81}"#, ""),
        // One of two is news.
        (r#"{"occupancy": true, "state": "OFF"}"#, r#"{"kind":"device","text":"the lamp is OFF"}"#),
        (r#"{"occupancy": false}"#, ""),
        (r#"{"occupancy": true}"#, occupied),
    ];
    let heard = gives(SEVERAL, &messages.map(|(payload, lines)| ("z/hall", payload, lines)));
    assert_eq!(heard, Heard { said: 5, unfit: 1, silent: 1, ..Heard::default() });
}

#[test]
fn a_rehearsal_tells_which_rule_says_what() {
    let mut listener = Listener::new(Rules::parse(SEVERAL).unwrap());
    let mut told = |topic: &str, payload: &str, retained| {
        let outcomes = listener.outcomes(topic.as_bytes(), payload.as_bytes(), retained, Instant::now());
        let mut remark = |line: &str| line.contains("kitchen").then(|| "no kitchen\u{1b}".to_owned());
        report(&listener.rules, (topic.as_bytes(), payload.as_bytes(), retained), &outcomes, &mut remark)
    };
    let on = r#"{"occupancy": true, "state": "ON"}"#;
    let text = told("z/hall", on, true);
    assert_eq!(text.matches("is silent: retained").count(), 3, "{text}");
    let text = told("z/kitchen", on, false);
    assert!(text.starts_with(&format!("z/kitchen  {on}\n")), "JSON can be read: {text}");
    let said = "\n  rule 1 says {\"presence\":\"present\",\"room\":\"kitchen\"}\n    no kitchen\\u001b\n";
    assert!(text.contains(said), "{text}");
    assert!(text.contains("\n  rule 2 says {\"text\":\"They turn on the lamp.\"}"), "{text}");
    assert!(text.contains("\n  rule 3 is silent: a rule before it"), "{text}");
    assert_eq!(told("z/kitchen", on, false).matches("is what the topic said before").count(), 3);
    assert!(
        told("z/kitchen", r#"{"occupancy": false}"#, false).contains("rule 1 is silent: \"false\" is not its `when`")
    );
    let text = told("else\u{1b}[2J", "\u{7}", false);
    assert!(text.ends_with("no rule can read it") && !text.contains(['\u{1b}', '\u{7}']), "{text:?}");
    // A character that changes the direction of a line, or a long text, is made harmless.
    let text = told("z/kitchen", &format!("{{\"state\": \"\u{202e}\u{9b}{}\"}}", "x".repeat(200)), false);
    assert!(text.starts_with("z/kitchen  {\"state\": \"\\u202e\\u009bxxx") && text.contains("xxx..."), "{text:?}");
    assert!(!text.contains(['\u{202e}', '\u{9b}']), "{text:?}");
    for (payload, lacks) in [("ON", "is no JSON"), (r#"{"linkquality": 80}"#, "has nothing at /occupancy")] {
        let text = told("z/hall", payload, false);
        assert!(text.ends_with(&format!("\n  rule 1 cannot read it: the payload {lacks}")), "{text}");
    }
}

#[test]
fn what_an_unread_payload_lacks_is_known() {
    let rules = Rules::parse(
        "[[rule]]\ntopic = \"lamp\"\nsay = \"the lamp is {value}\"\n[[rule]]\ntopic = \"face\"\n\
        field = \"/event\"\npresence = \"present\"\nperson = \"{/name}\"",
    );
    let rules = rules.unwrap();
    let lack = |topic, payload: &[u8]| rules.unreadable(topic, payload);
    assert_eq!(lack("lamp", b"on"), None);
    assert_eq!(lack("else", b"on"), None, "no rule listens there");
    assert_eq!(lack("lamp", b"\xff"), Some((1, "is no text".to_owned())));
    assert_eq!(lack("lamp", b" "), Some((1, "is empty".to_owned())));
    assert_eq!(lack("face", b"seen"), Some((2, "is no JSON".to_owned())));
    assert_eq!(lack("face", br#"{"name": "ada"}"#), Some((2, "has nothing at /event".to_owned())));
    assert_eq!(lack("face", br#"{"event": "seen"}"#), Some((2, "has nothing at /name".to_owned())));
    assert_eq!(lack("face", br#"{"event": "seen", "name": "ada"}"#), None);
    let sensors = Rules::parse(SENSORS).unwrap();
    assert_eq!(sensors.unreadable("plug/power", b"much"), Some((3, "is no number".to_owned())));
    for payload in ["20.5", "unavailable"] {
        assert_eq!(sensors.unreadable("plug/power", payload.as_bytes()), None, "{payload}");
    }
}

#[test]
fn payloads_that_are_no_state_say_nothing() {
    // The removal of a retained message arrives as an empty message. It does not mean that a person is away.
    let rules = r#"rule = [
        { topic = "count", unless = ["0"], presence = "present", room = "hall" },
        { topic = "person", unless = ["home", "unknown"], presence = "away", person = "ada" },
        { topic = "faces", field = "/event", when = "seen", presence = "present", room = "{/where/room}", person = "{/name}" },
        { topic = "+/occupancy", when = "off", presence = "empty", room = "{1}" },
    ]"#;
    let two = r#"{"presence":"present","room":"hall"}"#;
    let away = r#"{"person":"ada","presence":"away"}"#;
    let ada = r#"{"person":"ada","presence":"present","room":"hall"}"#;
    gives(
        rules,
        &[
            ("count", "unavailable", ""),
            ("count", "Unknown", ""),
            ("count", "offline", ""),
            ("count", "2", two),
            ("count", "None", ""),
            ("person", "", ""),
            ("person", " \n", ""),
            ("person", "home", ""),
            ("person", "not_home", away),
            ("faces", r#"{"event": "seen", "name": "ada", "where": {"room": "hall"}}"#, ada),
            // No person is named.
            ("faces", r#"{"event": "seen", "where": {"room": "hall"}}"#, ""),
            ("living_room/occupancy", "off", r#"{"presence":"empty","room":"living room"}"#),
        ],
    );
}

/// A rule names values of a JSON payload. The whole payload is not part of a sentence.
#[test]
fn an_object_in_braces_is_not_said() {
    let rules = r#"rule = [
        { topic = "lamp", say = "the lamp is {value}" },
        { topic = "plug", field = "/state", say = "the plug is {value}, {/more}" },
        { topic = "door", say = "They use the door." },
    ]"#;
    let messages = [
        ("lamp", r#"{"state": "on"}"#, ""),
        ("lamp", "[1, 2]", ""),
        ("plug", r#"{"state": "on", "more": {"a": 1}}"#, ""),
        ("plug", r#"{"state": "off", "more": "idle"}"#, r#"{"kind":"device","text":"the plug is off, idle"}"#),
        ("lamp", "{on", r#"{"kind":"device","text":"the lamp is on"}"#),
        // It says nothing of the value.
        ("door", r#"{"state": "on"}"#, r#"{"text":"They use the door."}"#),
    ];
    assert_eq!(gives(rules, &messages), Heard { said: 3, unsayable: 3, ..Heard::default() });
}

const SENSORS: &str = r#"rule = [
    { topic = "ha/binary_sensor/+/state", sensor = "motion", room = "{1}" },
    { topic = "z/hall", field = "/occupancy", sensor = "presence", room = "hall", hold_s = 30, false_alarms_per_day = 4 },
    { topic = "plug/power", above = 15, sensor = "appliance", room = "kitchen", id = "kettle" },
    { topic = "ha/person/mira/state", sensor = "phone", person = "Mira" },
    { topic = "beam", sensor = "motion", room = "hall", only_on = true },
]"#;

#[test]
fn one_sensor_rule_reports_on_off_and_unavailable_and_no_state_twice() {
    let hall =
        |on: &str| format!(r#"{{"id":"ha/binary_sensor/hall/state","on":{on},"room":"hall","sensor":"motion"}}"#);
    let presence = |on: &str| {
        format!(
            r#"{{"false_alarms_per_day":4.0,"hold_s":30.0,"id":"z/hall/occupancy","on":{on},"room":"hall","sensor":"presence"}}"#
        )
    };
    let kettle = |on: &str| format!(r#"{{"id":"kettle","on":{on},"room":"kitchen","sensor":"appliance"}}"#);
    let mira = |on: &str| format!(r#"{{"id":"ha/person/mira/state","on":{on},"person":"Mira","sensor":"phone"}}"#);
    let mut listener = Listener::new(Rules::parse(SENSORS).unwrap());
    let none = String::new;
    for (topic, payload, expected) in [
        ("ha/binary_sensor/hall/state", "on", hall("true")),
        ("ha/binary_sensor/hall/state", "on", none()),
        ("ha/binary_sensor/hall/state", "off", hall("false")),
        ("ha/binary_sensor/hall/state", "clear", none()),
        ("ha/binary_sensor/hall/state", "unavailable", hall("null")),
        ("ha/binary_sensor/hall/state", "unknown", none()),
        ("ha/binary_sensor/hall/state", "off", hall("false")),
        ("z/hall", r#"{"occupancy": true, "battery": 80}"#, presence("true")),
        ("z/hall", r#"{"occupancy": true, "battery": 79}"#, none()),
        ("z/hall", r#"{"battery": 78}"#, none()),
        ("z/hall", r#"{"occupancy": null}"#, presence("null")),
        ("z/hall", r#"{"occupancy": false}"#, presence("false")),
        ("plug/power", "2.1", kettle("false")),
        ("plug/power", "2.3", none()),
        ("plug/power", "1800.5", kettle("true")),
        ("plug/power", "1799", none()),
        ("plug/power", "0", kettle("false")),
        ("ha/person/mira/state", "home", mira("true")),
        ("ha/person/mira/state", "Work", mira("false")),
        ("ha/person/mira/state", "not_home", none()),
    ] {
        assert_eq!(hear(&mut listener, topic, payload, false).unwrap_or_default(), expected, "{topic} {payload}");
    }
}

#[test]
fn a_sensor_that_reports_no_off_reports_each_on() {
    let mut listener = Listener::new(Rules::parse(SENSORS).unwrap());
    let on = Some(r#"{"id":"beam","on":true,"only_on":true,"room":"hall","sensor":"motion"}"#);
    for (payload, retained, expected) in
        [("on", true, None), ("on", false, on), ("on", false, on), ("off", false, None), ("offline", false, None)]
    {
        assert_eq!(hear(&mut listener, "beam", payload, retained).as_deref(), expected, "{payload} {retained}");
    }
}

#[test]
fn retained_messages_give_the_state_of_sensors_after_a_start() {
    let mut listener = Listener::new(Rules::parse(SENSORS).unwrap());
    let said = hear(&mut listener, "ha/binary_sensor/hall/state", "on", true).unwrap();
    assert!(said.contains(r#""on":true"#), "{said}");
    // At the next connection the messages come again.
    listener.first_connection = false;
    assert_eq!(hear(&mut listener, "ha/binary_sensor/hall/state", "on", true), None);
    assert!(hear(&mut listener, "ha/binary_sensor/hall/state", "off", true).unwrap().contains(r#""on":false"#));
}

#[test]
fn a_sensor_rule_changes_nothing_for_the_rules_beside_it() {
    let rules = r#"rule = [
        { topic = "lamp", when = "on", say = "They turn on the lamp." },
        { topic = "lamp", sensor = "appliance", room = "hall" },
        { topic = "door", when = "off", presence = "away", quiet_s = 600.0 },
        { topic = "door", sensor = "door", room = "hall" },
    ]"#;
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    let now = Instant::now();
    let mut said = |topic: &str, payload: &str| listener.hear(topic.as_bytes(), payload.as_bytes(), false, now);
    let counts = ["on", "unavailable", "on", "off", "on"].map(|payload| said("lamp", payload).len());
    assert_eq!(counts, [2, 1, 1, 1, 2], "unavailable is no state of the sentence's rule");
    // A sensor that turns off breaks no silence.
    assert_eq!(said("door", "on").len(), 1);
    assert_eq!(said("door", "off").len(), 1);
    assert_eq!(said("lamp", "off").len(), 1);
    let due = listener.due(now + Duration::from_secs(601));
    assert_eq!(due, [r#"{"presence":"away"}"#]);
}

#[test]
fn a_sentence_with_a_limit_is_said_when_the_number_passes_it() {
    let rules = r#"rule = [
        { topic = "plug", above = 15, say = "They use the kettle." },
        { topic = "plug", below = 5, say = "They switch off the kettle." },
    ]"#;
    let (on, off) = (r#"{"text":"They use the kettle."}"#, r#"{"text":"They switch off the kettle."}"#);
    let numbers = [("1.5", off), ("20", on), ("21.5", ""), ("10", ""), ("20", on), ("3", off), ("2", "")];
    gives(rules, &numbers.map(|(power, lines)| ("plug", power, lines)));
}

#[test]
fn a_rehearsal_tells_the_state_of_a_sensor() {
    let mut listener = Listener::new(Rules::parse(SENSORS).unwrap());
    let mut told = |topic: &str, payload: &str| {
        let outcomes = listener.outcomes(topic.as_bytes(), payload.as_bytes(), false, Instant::now());
        report(&listener.rules, (topic.as_bytes(), payload.as_bytes(), false), &outcomes, &mut |_| None)
    };
    assert!(told("plug/power", "20").contains("rule 3 says {\"id\":\"kettle\",\"on\":true"));
    assert!(told("plug/power", "21").contains("rule 3 is silent: \"21\" means the same state as before"));
    assert!(told("plug/power", "much").contains("is no narration: its value is no number"));
}

#[test]
fn an_address_without_a_scheme_is_told_with_one() {
    let told = |address: &str| {
        let broker = Broker { address: address.to_owned(), ..Broker::default() };
        broker.options().unwrap_err().to_string()
    };
    assert!(told("192.168.1.5:1884").ends_with("with a CA file, here mqtt://192.168.1.5:1884"));
    assert!(told("broker.lan").ends_with("with a CA file, here mqtt://broker.lan:1883"));
    for address in ["tcp://broker.lan", "", "a:b:c"] {
        assert!(told(address).ends_with("with a CA file"), "{}", told(address));
    }
}

#[test]
fn missing_rules_are_told_with_the_whole_path() {
    let told = Rules::load(Path::new("no-such-rules.toml")).unwrap_err().to_string();
    let whole = std::path::absolute("no-such-rules.toml").unwrap();
    assert!(told.contains(&whole.display().to_string()), "{told}");
}

/// Messages of programs and devices of smart homes, in their original form.
#[test]
fn devices_of_many_makers_are_understood() {
    let rules = r#"rule = [
        { topic = "zigbee2mqtt/hall_motion", field = "/occupancy", when = "true", presence = "present", room = "hall" },
        { topic = "zigbee2mqtt/fridge", field = "/contact", when = "false", say = "They open the fridge." },
        { topic = "zigbee2mqtt/button", field = "/action", when = "single", repeats = true, say = "They press the button." },
        { topic = "stat/+/POWER", when = "ON", say = "They turn on the {1}." },
        { topic = "tele/door/SENSOR", field = "/Switch1", when = "ON", say = "They open the front door." },
        { topic = "esp-bath/binary_sensor/motion/state", when = "ON", presence = "present", room = "bathroom" },
        { topic = "frigate/+/person", unless = ["0"], presence = "present", room = "{1}" },
        { topic = "shellies/+/input_event/0", field = "/event", when = "S", say = "They press the {1}." },
        { topic = "owntracks/+/phone/event", field = "/event", when = "leave", presence = "away", person = "{1}" },
        { topic = "homeassistant/person/ada/state", when = "home", presence = "present", person = "Ada" },
        { topic = "homeassistant/person/ada/state", unless = ["home", "unknown", "unavailable"], presence = "away", person = "Ada" },
    ]"#;
    gives(
        rules,
        &[
            (
                "zigbee2mqtt/hall_motion",
                r#"{"battery":97,"illuminance":12,"occupancy":true,"linkquality":120}"#,
                r#"{"presence":"present","room":"hall"}"#,
            ),
            ("zigbee2mqtt/hall_motion", r#"{"battery":96,"occupancy":true}"#, ""),
            ("zigbee2mqtt/hall_motion", r#"{"battery":96}"#, ""),
            (
                "zigbee2mqtt/fridge",
                r#"{"battery":100,"contact":false,"voltage":3005}"#,
                r#"{"text":"They open the fridge."}"#,
            ),
            ("zigbee2mqtt/button", r#"{"action":"single"}"#, r#"{"text":"They press the button."}"#),
            ("zigbee2mqtt/button", r#"{"battery":88}"#, ""),
            ("zigbee2mqtt/button", r#"{"action":"single"}"#, r#"{"text":"They press the button."}"#),
            ("stat/coffee_maker/POWER", "ON", r#"{"kind":"device","text":"They turn on the coffee maker."}"#),
            (
                "tele/door/SENSOR",
                r#"{"Time":"2025-11-24T07:30:00","Switch1":"ON"}"#,
                r#"{"text":"They open the front door."}"#,
            ),
            ("esp-bath/binary_sensor/motion/state", "ON", r#"{"presence":"present","room":"bathroom"}"#),
            ("frigate/kitchen/person", "0", ""),
            ("frigate/kitchen/person", "2", r#"{"presence":"present","room":"kitchen"}"#),
            (
                "shellies/door_bell/input_event/0",
                r#"{"event":"S","event_cnt":7}"#,
                r#"{"kind":"device","text":"They press the door bell."}"#,
            ),
            (
                "owntracks/ada/phone/event",
                r#"{"_type":"transition","event":"leave","desc":"Home"}"#,
                r#"{"person":"ada","presence":"away"}"#,
            ),
            ("homeassistant/person/ada/state", "home", r#"{"person":"Ada","presence":"present"}"#),
            // A zone other than home is out of the house; an unknown value is not an event.
            ("homeassistant/person/ada/state", "unavailable", ""),
            ("homeassistant/person/ada/state", "home", ""),
            ("homeassistant/person/ada/state", "Work", r#"{"person":"Ada","presence":"away"}"#),
            ("homeassistant/person/ada/state", "unknown", ""),
            ("homeassistant/person/ada/state", "not_home", r#"{"person":"Ada","presence":"away"}"#),
        ],
    );
}

#[test]
fn a_device_that_was_not_heard_for_a_while_has_done_nothing() {
    let rules = "[[rule]]\ntopic = \"door\"\nwhen = \"off\"\nsay = \"They close the door.\"\n\
        [[rule]]\ntopic = \"watched\"\nwhen = \"unavailable\"\nsay = \"the lamp is gone\"";
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    let said = ["off", "unavailable", "off", "unknown", "off", "on", "off"]
        .map(|value| hear(&mut listener, "door", value, false).is_some());
    assert_eq!(said, [true, false, false, false, false, false, true]);
    let said = ["unavailable", "unavailable", "on", "unavailable"]
        .map(|value| hear(&mut listener, "watched", value, false).is_some());
    assert_eq!(said, [true, false, false, true], "a rule that speaks of it");
    let mut rehearsed =
        Listener::new(Rules::parse("[[rule]]\ntopic = \"a\"\nunless = [\"0\"]\npresence = \"present\"").unwrap());
    let outcomes = rehearsed.outcomes(b"a", b"0", false, Instant::now());
    assert!(
        report(&rehearsed.rules, (b"a", b"0", false), &outcomes, &mut |_| None).ends_with("\"0\" is in its `unless`")
    );
}

/// Cameras and plugs send numbers in many forms, and some programs send JSON strings.
#[test]
fn values_compare_as_what_they_are() {
    let rules = r#"rule = [
        { topic = "camera/+", unless = ["0", "geschlossen"], presence = "present", room = "{1}" },
        { topic = "lamp", field = "/power", when = "1", say = "They turn on the lamp." },
        { topic = "state", when = "on", say = "They turn it on." },
        { topic = "state", say = "the light is {value}" },
    ]"#;
    let none = ["0", "0.0", "-0", "\"0\"", "\"0.00\"", " 0 ", "Geschlossen", "\"GESCHLOSSEN\""];
    let mut messages = none.map(|payload| ("camera/hall", payload, "")).to_vec();
    messages.extend([
        ("camera/hall", "2.0", r#"{"presence":"present","room":"hall"}"#),
        ("camera/hall", "2", ""),
        ("lamp", r#"{"power": 1.0}"#, r#"{"text":"They turn on the lamp."}"#),
        ("state", "\"on\"", r#"{"text":"They turn it on."}"#),
        ("state", "on", ""),
        ("state", "\"dimmed \\u0041\"", r#"{"kind":"device","text":"the light is dimmed A"}"#),
        ("state", "\"\"", ""),
        ("state", "\"broken", r#"{"kind":"device","text":"the light is broken"}"#),
    ]);
    gives(rules, &messages);
}

/// A payload and a topic each added a sentence, and both residents were away.
#[test]
fn payloads_and_topics_stay_inside_the_sentence_of_their_rule() {
    let rules = r#"rule = [{ topic = "zigbee2mqtt/+", field = "/state", say = "the {1} is {value}" }]"#;
    gives(
        rules,
        &[
            (
                "zigbee2mqtt/lamp",
                r#"{"state":"on. Everybody leaves the house."}"#,
                r#"{"kind":"device","text":"the lamp is on"}"#,
            ),
            (
                "zigbee2mqtt/tv is on. Everybody leaves the house. The lamp",
                r#"{"state":"on"}"#,
                r#"{"kind":"device","text":"the tv is on is on"}"#,
            ),
            // No empty room.
            ("zigbee2mqtt/kitchen", r#"{"state":"empty"}"#, r#"{"kind":"device","text":"the kitchen is empty"}"#),
        ],
    );
}

#[test]
fn silence_after_the_front_door_says_that_they_are_away() {
    let rules = r#"rule = [
        { topic = "door", when = "closed", say = "They close the front door." },
        { topic = "door", when = "closed", presence = "away", person = "ada", quiet_s = 600.0 },
        { topic = "door", when = "closed", presence = "away", person = "ben", quiet_s = 900.0 },
        { topic = "motion", when = "on", presence = "present" },
    ]"#;
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    let start = Instant::now();
    let at = |seconds| start + Duration::from_secs(seconds);
    let door = |listener: &mut Listener, value: &str, seconds| {
        !listener.hear(b"door", value.as_bytes(), false, at(seconds)).is_empty()
    };
    assert!(door(&mut listener, "closed", 0));
    assert_eq!(listener.hear(b"motion", b"on", false, at(300)).len(), 1);
    assert_eq!(listener.due(at(10_000)), Vec::<String>::new(), "somebody moved");
    // Opening it gives no line, so it breaks no silence; closing it begins the silence again.
    assert!(!door(&mut listener, "open", 20_000) && door(&mut listener, "closed", 20_100));
    assert!(!door(&mut listener, "open", 20_200) && door(&mut listener, "closed", 20_300));
    assert!(!door(&mut listener, "closed", 20_400), "a value that repeats says nothing new");
    assert_eq!(listener.due(at(20_899)), Vec::<String>::new());
    // One silence does not end the other.
    assert_eq!(listener.due(at(20_900)), [r#"{"person":"ada","presence":"away"}"#]);
    assert_eq!(listener.due(at(21_200)), [r#"{"person":"ben","presence":"away"}"#]);
    assert_eq!(listener.due(at(99_999)), Vec::<String>::new());
    // Time without a connection is not silence.
    assert!(!door(&mut listener, "open", 100_000) && door(&mut listener, "closed", 100_000));
    listener.listen_from(at(100_599));
    assert_eq!(listener.due(at(101_198)), Vec::<String>::new());
    assert_eq!(listener.due(at(101_199)).len(), 1);
    // A retained message from before this process is not an event.
    listener.first_connection = true;
    assert!(listener.hear(b"door", b"open", true, at(200_000)).is_empty());
    assert!(listener.hear(b"door", b"closed", true, at(200_000)).is_empty());
    assert_eq!(listener.due(at(300_000)).len(), 1, "ben's silence of before");
    assert_eq!(listener.heard, Heard { said: 9, unfit: 4, silent: 2, ..Heard::default() });
}

#[test]
fn filters_fit_as_mqtt_has_it() {
    assert_eq!(matches("a/+/c", "a/b/c"), Some(vec!["b"]));
    assert_eq!(matches("a/#", "a/b/c"), Some(vec![]));
    assert_eq!(matches("a/#", "a"), Some(vec![]));
    assert_eq!(matches("a/+", "a/b/c"), None);
    assert_eq!(matches("a/b/c", "a/b"), None);
}

proptest::proptest! {
    /// A topic of a covered filter also matches the covering filter, so the covered one needs no subscription.
    #[test]
    fn what_a_filter_covers_it_hears(
        wide in "[ab+$](/[ab+]){0,2}(/#)?|#",
        narrow in "[ab+$](/[ab+]){0,2}(/#)?|#",
        topics in proptest::collection::vec("[ab$](/[ab]){0,3}", 1..40),
    ) {
        // A wildcard at the beginning does not match the broker's own topics.
        let fits = |filter: &str, topic: &str| {
            matches(filter, topic).is_some() && !(topic.starts_with('$') && filter.starts_with(['+', '#']))
        };
        let covered = topics.iter().all(|topic| fits(&wide, topic) || !fits(&narrow, topic));
        proptest::prop_assert!(!covers(&wide, &narrow) || covered, "{wide} does not hear all of {narrow}");
        proptest::prop_assert!(covers(&narrow, &narrow));
    }
}

#[test]
fn filters_that_others_cover_are_named() {
    for (wide, narrow) in
        [("#", "a/b"), ("a/+", "a/b"), ("a/#", "a"), ("a/#", "a/+/c"), ("+/b", "a/b"), ("a/#", "a/b/#")]
    {
        assert!(covers(wide, narrow) && !covers(narrow, wide), "{wide} {narrow}");
    }
    for (one, other) in [("a/+", "+/b"), ("a/+", "b/+"), ("a/+", "a/b/c"), ("#", "$SYS/a"), ("a/+", "a/#")] {
        assert!(!covers(one, other), "{one} {other}");
    }
}

#[test]
fn malformed_rules_are_named() {
    for (text, part) in [
        ("[[rule]]\ntopic = \"a/b#\"\nsay = \"x\"", "rule 1: the topic"),
        ("[[rule]]\ntopic = \"#/b\"\nsay = \"x\"", "rule 1: the topic"),
        ("[[rule]]\ntopic = \"$share/g/a/+\"\nsay = \"x\"", "is a shared subscription"),
        ("[[rule]]\ntopic = \"a\"\nsay = \" \"", "rule 1: say is empty"),
        ("[[rule]]\ntopic = \"a/+\"\nsay = \"the {2} is {value}\"", "rule 1: say has {2}; it knows {value}, {1}"),
        ("[[rule]]\ntopic = \"a\"\npresence = \"present\"\nroom = \"{1}\"", "rule 1: room has {1}; it knows {value}"),
        (
            "[[rule]]\ntopic = \"a\"\npresence = \"home\"",
            "unknown word `home`, expected one of `present`, `away`, `gone`, `empty`",
        ),
        ("[[rule]]\ntopic = \"a\"\npresence = \"empty\"", "rule 1: presence = \"empty\" says that nobody"),
        ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nperson = -1", "`-1` is no person"),
        ("[[rule]]\ntopic = \"a\"", "rule 1: give say, presence or the state"),
        ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nfield = \"state\"", "JSON pointer"),
        ("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nwhen = \"on\"\nunless = [\"off\"]", "rule 1: when and unless exclude"),
        ("[[rule]]\ntopic = \"a\"\nsays = \"x\"", "unknown key"),
    ] {
        let error = Rules::parse(text).unwrap_err();
        assert!(error.contains(part), "{text}: {error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let error = Rules::load(&pem(folder.path(), "rules.toml", "")).unwrap_err().to_string();
    assert!(error.ends_with("docs/mqtt.md shows what they look like"), "{error}");
}

#[test]
fn retained_and_repeated_messages_say_nothing_new() {
    let mut listener = Listener::new(Rules::parse(RULES).unwrap());
    let door = "home/binary_sensor/fridge_door/state";
    let oven = "home/switch/oven/json";
    assert_eq!(hear(&mut listener, door, "on", true), None);
    assert!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, true).unwrap().contains("the oven is on"));
    assert_eq!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, false), None);
    listener.first_connection = false;
    // Retained again after a reconnection: a changed value is an event, the same value is not.
    assert_eq!(hear(&mut listener, oven, r#"{"state": {"power": "on"}}"#, true), None);
    assert!(hear(&mut listener, oven, r#"{"state": {"power": "off"}}"#, true).unwrap().contains("the oven is off"));
    assert_eq!(listener.heard, Heard { said: 2, unfit: 0, silent: 3, ..Heard::default() });
}

#[test]
fn addresses_and_their_faults() {
    let broker = |address: &str| Broker { address: address.into(), client: "test".into(), ..Broker::default() };
    assert_eq!(broker("mqtt://hub").options().unwrap().broker_address(), ("hub".into(), 1883));
    assert_eq!(broker("mqtt://hub:99").options().unwrap().broker_address(), ("hub".into(), 99));
    assert_eq!(broker("mqtt://hub:99/").options().unwrap().broker_address(), ("hub".into(), 99));
    assert_eq!(broker("mqtt://[::1]").options().unwrap().broker_address(), ("[::1]".into(), 1883));
    assert_eq!(broker("mqtt://[::1]:99").options().unwrap().broker_address(), ("[::1]".into(), 99));
    for wrong in [
        "hub",
        "http://hub",
        "mqtt://",
        "mqtt://hub:port",
        "mqtt://hub:99999",
        "mqtt://::1",
        "mqtt://hub/a",
        "mqtt://a:1:2",
        "mqtt://hub:0",
        "mqtt://my hub",
        "mqtt://hub?tls",
        "mqtt://\"hub\"",
    ] {
        assert!(matches!(broker(wrong).options(), Err(MqttError::Address { .. })), "{wrong}");
    }
    let login = broker("mqtt://home:secret@hub").options().unwrap_err().to_string();
    assert!(login.contains("--mqtt-credentials FILE") && !login.contains("secret"), "{login}");
    let folder = tempfile::tempdir().unwrap();
    let with = |address: &str, authority| Broker { authority, ..broker(address) }.options().unwrap_err();
    let text = Some(pem(folder.path(), "text", "no certificate"));
    assert!(with("mqtts://hub", None).to_string().contains("without a CA file"));
    assert!(with("mqtt://hub", text.clone()).to_string().contains("with a CA file"));
    assert!(matches!(with("mqtts://hub", text), MqttError::Authority { .. }));
    assert!(matches!(with("mqtts://hub", Some(folder.path().join("nowhere"))), MqttError::Read { .. }));
    for text in ["robot\n", "robot", "", "\nsecret\n"] {
        let credentials = Some(pem(folder.path(), "short", text));
        let broker = Broker { credentials, address: "mqtt://hub".to_owned(), ..Broker::default() };
        let error = broker.options().unwrap_err();
        assert!(matches!(error, MqttError::Credentials { .. }), "{text:?}: {error}");
    }
}

fn pem(folder: &Path, name: &str, text: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path
}

/// An authority that signs a certificate for this machine. Returns the authority's certificate, and the other with its key.
fn certificates() -> (String, String, String) {
    use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
    let key = KeyPair::generate().unwrap();
    let params = CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
    let own = params.signed_by(&key, &authority).unwrap();
    (authority.as_ref().pem(), own.pem(), key.serialize_pem())
}

/// The client's error at its first attempt to connect.
fn refusal(broker: &Broker) -> String {
    let (_client, mut connection) = Client::new(broker.options().unwrap(), 10);
    connection.recv().unwrap().unwrap_err().to_string()
}

/// TLS with a private authority, and credentials from a file.
#[test]
fn a_broker_is_reached_by_tls_with_credentials_and_by_nobody_else() {
    let port = free_port();
    let folder = tempfile::tempdir().unwrap();
    let (authority, own, key) = certificates();
    let authority = pem(folder.path(), "authority.pem", &authority);
    let (own, key) = (pem(folder.path(), "broker.pem", &own), pem(folder.path(), "broker.key", &key));
    let passwords = folder.path().join("passwords");
    let made = Command::new("mosquitto_passwd").args(["-b", "-c"]).arg(&passwords).args(["robot", "secret"]).output();
    if !made.is_ok_and(|made| made.status.success()) {
        skipped(NO_BROKER);
        return;
    }
    let (authority_path, own, key) = (authority.display(), own.display(), key.display());
    let access = format!(
        "cafile {authority_path}\ncertfile {own}\nkeyfile {key}\nallow_anonymous false\npassword_file {}",
        passwords.display()
    );
    let Some(_broker) = Mosquitto::start(port, tempfile::tempdir().unwrap(), &access) else {
        skipped(NO_BROKER);
        return;
    };
    let to = Broker {
        address: format!("mqtts://localhost:{port}"),
        client: "listener".into(),
        credentials: Some(pem(folder.path(), "credentials", "robot\nsecret\n")),
        authority: Some(authority.clone()),
    };

    // Another authority, another password, no TLS: no connection.
    let stranger = pem(folder.path(), "stranger.pem", &certificates().0);
    let error = refusal(&Broker { authority: Some(stranger), ..to.clone() });
    assert!(error.contains("certificate"), "{error}");
    let wrong = pem(folder.path(), "wrong", "robot\nguess\n");
    let error = refusal(&Broker { credentials: Some(wrong), ..to.clone() });
    assert!(error.contains("NotAuthorized") || error.contains("BadUserNamePassword"), "{error}");
    refusal(&Broker { address: format!("mqtt://localhost:{port}"), authority: None, ..to.clone() });

    let rules =
        Rules::parse("[[rule]]\ntopic = \"home/oven\"\nsay = \"the oven is {value}\"\nretained = true").unwrap();
    let (reader, writer) = std::io::pipe().unwrap();
    let stop = Stop::new();
    let (own_stop, own_options) = (stop.clone(), to.options().unwrap());
    let listening = std::thread::spawn(move || listen(own_options, rules, writer, &own_stop));
    let (client, mut connection) = Client::new(Broker { client: "publisher".into(), ..to }.options().unwrap(), 10);
    client.try_publish("home/oven", QoS::AtLeastOnce, true, "on").unwrap();
    while !matches!(connection.recv().unwrap().unwrap(), Event::Incoming(Packet::PubAck(_))) {}
    let line = BufReader::new(reader).lines().next().unwrap().unwrap();
    assert!(line.contains("the oven is on"), "{line}");
    stop.request();
    assert_eq!(listening.join().unwrap().unwrap().said, 1);
}

/// Two clients of one name at a real broker: the client that loses its place gets a hint at the cause.
#[tokio::test]
async fn a_client_whose_place_is_taken_says_so() {
    let Some((_broker, port)) = Mosquitto::ready() else { return };
    let address = format!("mqtt://127.0.0.1:{port}");
    let broker = Broker { address, client: "roomcast-home".to_owned(), credentials: None, authority: None };
    let client = || AsyncClient::new(broker.options().unwrap(), 4);
    let ((_one, mut first), (_other, mut second)) = (client(), client());
    while !matches!(first.poll().await, Ok(Event::Incoming(Packet::ConnAck(_)))) {}
    while !matches!(second.poll().await, Ok(Event::Incoming(Packet::ConnAck(_)))) {}
    let error = loop {
        if let Err(error) = first.poll().await {
            break error;
        }
    };
    assert!(broken(&error).contains("another client has this one's name"), "{error}");
}

/// The lock of tests that measure the memory of this process, so that one does not see the other's.
static MEMORY: Mutex<()> = Mutex::new(());

fn resident() -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let kilobytes = text.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    kilobytes.unwrap().parse::<u64>().unwrap() << 10
}

struct Listening {
    thread: std::thread::JoinHandle<Result<Heard, MqttError>>,
    lines: std::io::Lines<BufReader<std::io::PipeReader>>,
    stop: Stop,
}

fn to(port: u16) -> Broker {
    Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "listener".into(), ..Broker::default() }
}

impl Listening {
    fn start(port: u16, rules: &str) -> Self {
        Self::start_with(port, rules, PACKET_BYTES_MAX)
    }

    fn start_with(port: u16, rules: &str, packet_bytes_max: u32) -> Self {
        let mut options = to(port).options().unwrap();
        options.set_max_packet_size(Some(packet_bytes_max));
        let (reader, writer) = std::io::pipe().unwrap();
        let (stop, rules) = (Stop::new(), Rules::parse(rules).unwrap());
        let own_stop = stop.clone();
        let thread = std::thread::spawn(move || listen(options, rules, writer, &own_stop));
        Self { thread, lines: BufReader::new(reader).lines(), stop }
    }

    fn next(&mut self) -> Option<String> {
        self.lines.next().map(Result::unwrap)
    }

    /// Stops it as a signal does. Returns its last lines, and its counts.
    fn end(self) -> (Vec<String>, Heard) {
        self.stop.request();
        let rest = self.lines.map(Result::unwrap).collect();
        (rest, self.thread.join().unwrap().unwrap())
    }
}

/// The greeting of a stand-in for a broker.
const CONNACK: [u8; 5] = [0x20, 3, 0, 0, 0];

const STEPS: &str = "[[rule]]\ntopic = \"home/step\"\nsay = \"They do step {value}.\"";

/// A rehearsal at the same time as the narrator of the same name: it reports the lines, and the narrator's session keeps every message.
#[test]
fn a_rehearsal_takes_nothing_from_the_narrator() {
    let Some((broker, port)) = Mosquitto::ready() else { return };
    // Filters are subscribed in order: when the retained message has come, the broker knows both.
    broker.publish(&[("home/welcome", "first".into(), true)]);
    let rules =
        format!("{STEPS}\n[[rule]]\ntopic = \"home/welcome\"\nsay = \"They do the {{value}}.\"\nretained = true");
    let mut first = Listening::start(port, &rules);
    assert!(first.next().unwrap().contains("the first"));
    first.end();
    broker.publish(&[("home/step", "1".into(), false)]);

    let to = to(port);
    let (reader, writer) = std::io::pipe().unwrap();
    let (stop, own) = (Stop::new(), Rules::parse(&rules).unwrap());
    let own_stop = stop.clone();
    let rehearsal = std::thread::spawn(move || rehearse(to.options().unwrap(), own, writer, &own_stop, &mut |_| None));
    let mut lines = BufReader::new(reader).lines().map(Result::unwrap);
    assert_eq!(lines.next().unwrap(), "home/welcome  first  (retained)");
    assert_eq!(lines.next().unwrap(), r#"  rule 2 says {"kind":"device","text":"They do the first."}"#);
    broker.publish(&[("home/step", "2".into(), false)]);
    assert_eq!(lines.next().unwrap(), "home/step  2");
    assert_eq!(lines.next().unwrap(), r#"  rule 1 says {"kind":"device","text":"They do step 2."}"#);
    stop.request();
    assert_eq!(rehearsal.join().unwrap().unwrap().said, 2);

    let mut second = Listening::start(port, &rules);
    let said: Vec<_> = (0..3).map(|_| second.next().unwrap()).collect();
    for step in ["step 1", "step 2"] {
        assert!(said.iter().any(|line| line.contains(step)), "{said:?}");
    }
    second.end();
}

/// The attack: MQTT backlog. `ROOMCAST_MQTT_RESTARTS=1000` is the long form; a restart takes about a second.
/// `ROOMCAST_MQTT_SEED` chooses other moments.
#[test]
fn a_backlog_of_5000_messages_is_said_once_and_in_order_over_restarts() {
    const BACKLOG: u32 = 5_000;
    let _alone = MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
    let restarts = std::env::var("ROOMCAST_MQTT_RESTARTS").map_or(6, |text| text.parse().unwrap());
    let Some((mut broker, port)) = Mosquitto::ready() else { return };
    let seed = std::env::var("ROOMCAST_MQTT_SEED").map_or(22, |text| text.parse().unwrap());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Its session exists when a later message has arrived.
    broker.publish(&[("home/start", "first".into(), true)]);
    let start = "[[rule]]\ntopic = \"home/start\"\nsay = \"They do the {value}.\"\nretained = true";
    let mut first = Listening::start(port, &format!("{STEPS}\n{start}"));
    assert!(first.next().unwrap().contains("the first"));
    assert_eq!(first.end().1.said, 1);
    let before = resident();
    let mut largest = 0;
    let (mut published, mut said) = (0, 0);
    let mut check = |line: &str| {
        assert!(line.contains(&format!("They do step {said}.")), "step {said}: {line}");
        said += 1;
        said
    };
    for restart in 0..restarts {
        let backlog: Vec<_> = (published..published + BACKLOG).map(|n| ("home/step", n.to_string(), false)).collect();
        broker.publish(&backlog);
        published += BACKLOG;
        // One narrator is stopped in the middle of the backlog, and the next one continues; now and then the broker restarts, too.
        if restart % 3 == 2 {
            broker = broker.restart();
        }
        let mut listening = Listening::start(port, STEPS);
        for _ in 0..rng.random_range(0..BACKLOG) {
            check(&listening.next().unwrap());
        }
        largest = largest.max(resident().saturating_sub(before));
        let (rest, heard) = listening.end();
        assert_eq!((heard.unfit, heard.oversized), (0, 0));
        let mut now = rest.iter().map(|line| check(line)).last().unwrap_or_default();
        let mut listening = Listening::start(port, STEPS);
        let mut middle = (restart % 3 == 1).then(|| published - rng.random_range(0..BACKLOG / 2));
        while now < published {
            now = check(&listening.next().unwrap());
            if middle.is_some_and(|middle| now >= middle) {
                middle = None;
                broker = broker.restart();
                // This message follows everything that the broker sends again: a narrator that has processed it has acknowledged the rest.
                broker.publish(&[("home/step", published.to_string(), false)]);
                published += 1;
            }
        }
        let (rest, _heard) = listening.end();
        assert_eq!(rest, Vec::<String>::new());
    }
    println!("{restarts} restarts, {published} messages, at most {largest} bytes more than before");
    assert!(largest < 64 << 20, "{largest} bytes more");
}

/// Reads lines as a daemon that is slower than the broker.
struct Slow(Arc<Mutex<Vec<u8>>>);

impl Write for Slow {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        // The time of a slow daemon.
        std::thread::sleep(Duration::from_millis(2));
        Ok(())
    }
}

/// mosquitto 2.0.11 sends its whole queue at once, regardless of the receive maximum.
#[test]
fn who_is_killed_in_a_backlog_says_few_messages_twice() {
    const BACKLOG: u64 = 2_000;
    let Some((broker, port)) = Mosquitto::ready() else { return };
    let (mut next, mut twice, mut lives) = (0, 0, 0);
    let mut live = |most: Duration| {
        let to = Broker { address: format!("mqtt://127.0.0.1:{port}"), client: "killed".into(), ..Broker::default() };
        let (out, stop) = (Arc::new(Mutex::new(Vec::new())), Stop::new());
        let connection = Connection::new(to.options().unwrap(), Rules::parse(STEPS).unwrap(), Slow(Arc::clone(&out)));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().unwrap();
        // It ends without a farewell.
        let killed = runtime.block_on(async { tokio::time::timeout(most, connection.listen(&stop)).await.is_err() });
        assert!(killed);
        let said = String::from_utf8(std::mem::take(&mut *out.lock().unwrap())).unwrap();
        let steps = said.lines().map(|line| {
            let (_, step) = line.split_once("step ").unwrap();
            step.split_once('.').unwrap().0.parse::<u64>().unwrap()
        });
        let steps: Vec<u64> = steps.collect();
        let Some(first) = steps.first().copied() else { return next };
        // Beside those without an acknowledgement, the broker repeats those whose acknowledgement it had not read: the connection ends with
        // unread messages, so the system discards what the broker has not read either.
        let repeated_max = 4 * u64::from(MESSAGES_AHEAD_MAX);
        assert!(first <= next && next - first <= repeated_max, "{next} is next, and {first} is said");
        assert!(steps.iter().copied().eq(first..first + steps.len() as u64), "{steps:?}");
        (twice, lives) = (twice + next - first, lives + 1);
        next = first + steps.len() as u64;
        next
    };
    // First the session, and then its backlog.
    live(Duration::from_millis(300));
    let backlog: Vec<_> = (0..BACKLOG).map(|n| ("home/step", n.to_string(), false)).collect();
    broker.publish(&backlog);
    let began = Instant::now();
    while live(Duration::from_millis(700)) < BACKLOG {
        assert!(began.elapsed() < Duration::from_secs(120));
    }
    println!("{lives} lives, {BACKLOG} messages, {twice} of them twice");
    assert!(lives > 2);
}

#[test]
fn silence_behind_a_real_broker_is_said_when_it_has_lasted() {
    let Some((broker, port)) = Mosquitto::ready() else { return };
    let door = "[[rule]]\ntopic = \"home/door\"\nwhen = \"closed\"\npresence = \"away\"\nquiet_s = 1.0";
    broker.publish(&[("home/step", "first".into(), true)]);
    let mut listening = Listening::start(port, &format!("{STEPS}\nretained = true\n{door}"));
    assert!(listening.next().unwrap().contains("step first"));
    // A later step breaks the silence of the first closing, but not the silence of the second.
    broker.publish(&[("home/door", "closed".into(), false), ("home/step", "next".into(), false)]);
    assert!(listening.next().unwrap().contains("step next"));
    broker.publish(&[("home/door", "open".into(), false), ("home/door", "closed".into(), false)]);
    let closed = Instant::now();
    assert_eq!(listening.next().unwrap(), r#"{"presence":"away"}"#);
    assert!(closed.elapsed() > Duration::from_millis(500), "it waited: {:?}", closed.elapsed());
    assert_eq!(listening.end().0, Vec::<String>::new());
}

/// The attack: MQTT payloads of 10 MB.
#[test]
fn oversized_messages_are_refused_by_name_and_passed_over() {
    let _alone = MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
    let Some((broker, port)) = Mosquitto::ready() else { return };
    broker.publish(&[("home/step", "first".into(), true)]);
    let rules =
        format!("{STEPS}\nretained = true\n[[rule]]\ntopic = \"home/camera\"\nsay = \"They look at {{value}}.\"");
    let mut listening = Listening::start(port, &rules);
    assert!(listening.next().unwrap().contains("step first"));
    let before = resident();
    let of = |bytes: usize| "x".repeat(bytes);
    for round in 0..6 {
        // The broker drops the message of 17 MB itself, three are dropped here, and one is narration.
        broker.publish(&[("home/camera", of(10 << 20), false), ("home/camera", of(17 << 20), false)]);
        broker.publish(&[("home/camera", of(PAYLOAD_BYTES_MAX + 1), false)]);
        broker.publish(&[("home/camera", of(PACKET_BYTES_MAX as usize - 64), false)]);
        broker.publish(&[("home/step", round.to_string(), false)]);
        assert!(listening.next().unwrap().contains(&format!("They do step {round}.")));
    }
    let more = resident().saturating_sub(before);
    let (rest, heard) = listening.end();
    assert_eq!((rest.len(), heard.said, heard.oversized), (0, 7, 18));
    assert!(more < 128 << 20, "{more} bytes more");
}

/// More messages of 1.2 MB than the broker may send ahead: mosquitto 2.0.11 delivers no more messages if it has to drop so many.
fn images(topic: &'static str, count: usize) -> Vec<(&'static str, String, bool)> {
    vec![(topic, "x".repeat(1_200_000), false); count]
}

const CAMERA: &str = "[[rule]]\ntopic = \"home/camera/#\"\nsay = \"They look at {value}.\"";

#[test]
fn many_images_do_not_silence_the_narrator() {
    let _alone = MEMORY.lock().unwrap_or_else(PoisonError::into_inner);
    let Some((broker, port)) = Mosquitto::ready() else { return };
    broker.publish(&[("home/step", "first".into(), true)]);
    let rules = format!("{STEPS}\nretained = true\n{CAMERA}");
    let mut listening = Listening::start(port, &rules);
    assert!(listening.next().unwrap().contains("step first"));
    broker.publish(&images("home/camera/front", 64));
    broker.publish(&[("home/step", "1".into(), false)]);
    assert!(listening.next().unwrap().contains("step 1."));
    assert_eq!(listening.end().1.oversized, 64);
    // Each subscription delivers retained images again.
    let retained: Vec<String> = (0..40).map(|camera| format!("home/camera/{camera}")).collect();
    let image = "x".repeat(1_200_000);
    broker.publish(&retained.iter().map(|topic| (topic.as_str(), image.clone(), true)).collect::<Vec<_>>());
    let mut listening = Listening::start(port, &rules);
    broker.publish(&[("home/step", "2".into(), false)]);
    assert!(std::iter::from_fn(|| listening.next()).any(|line| line.contains("step 2.")));
    listening.end();
}

#[test]
#[ignore = "full"]
fn a_connection_over_which_the_broker_delivers_nothing_is_renewed() {
    let Some((broker, port)) = Mosquitto::ready() else { return };
    broker.publish(&[("home/step", "first".into(), true)]);
    let rules = format!("{STEPS}\nretained = true\n{CAMERA}");
    let mut listening = Listening::start_with(port, &rules, 1 << 20);
    assert!(listening.next().unwrap().contains("step first"));
    broker.publish(&images("home/camera/front", 64));
    broker.publish(&[("home/step", "1".into(), false)]);
    assert!(listening.next().unwrap().contains("step 1."));
    assert_eq!(listening.end().1.oversized, 0, "the broker has dropped them");
}

/// The attack: a refused subscription. mosquitto's own access list grants every subscription, so the broker is a stand-in.
#[test]
fn a_refused_subscription_is_an_error_with_its_name() {
    const NOT_AUTHORIZED: u8 = 0x87;
    let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = socket.local_addr().unwrap().port();
    let broker = move |codes: &[u8]| {
        let (mut stream, _) = socket.accept().unwrap();
        let mut packet = [0; 512];
        let _connect = stream.read(&mut packet).unwrap();
        stream.write_all(&CONNACK).unwrap();
        for code in codes {
            loop {
                stream.read_exact(&mut packet[..2]).unwrap();
                let end = 2 + usize::from(packet[1]);
                stream.read_exact(&mut packet[2..end]).unwrap();
                if !is_probe(&packet[..end]) {
                    break;
                }
            }
            stream.write_all(&[0x90, 4, packet[2], packet[3], 0, *code]).unwrap();
        }
        // A granted filter gets a message of quality 0.
        if codes.iter().any(|code| *code < 0x80) {
            stream.write_all(b"\x30\x0d\x00\x09home/step\x001").unwrap();
        }
        // Waits until the client has left.
        let _rest = stream.read_to_end(&mut Vec::new());
    };
    let refused = "[[rule]]\ntopic = \"secret/#\"\nsay = \"They hide {value}.\"";
    let listening = Listening::start(port, refused);
    broker(&[NOT_AUTHORIZED]);
    let error = listening.thread.join().unwrap().unwrap_err().to_string();
    assert!(error.contains("\"secret/#\": NotAuthorized"), "{error}");
    // If another filter is granted, its messages arrive.
    let mut listening = Listening::start(port, &format!("{STEPS}\n{refused}"));
    let answering = std::thread::spawn(move || broker(&[0, NOT_AUTHORIZED]));
    assert!(listening.next().unwrap().contains("step 1"));
    assert_eq!(listening.end().1.said, 1);
    answering.join().unwrap();
}

/// A broker that sends random packets, by seeds.
#[test]
fn a_broker_that_sends_anything_is_survived() {
    let message = |rng: &mut ChaCha8Rng| {
        let topic = b"home/step";
        let payload: Vec<u8> = (0..rng.random_range(0..40)).map(|_| rng.random()).collect();
        let mut packet = vec![0x30 | (rng.random_range(0..16_u8))];
        packet.push(u8::try_from(2 + topic.len() + 2 + 1 + payload.len()).unwrap());
        packet.extend([0, u8::try_from(topic.len()).unwrap()]);
        packet.extend(topic);
        packet.extend([0, rng.random(), 0]);
        packet.extend(payload);
        packet
    };
    let seeds: Vec<u64> = (0..64).collect();
    std::thread::scope(|scope| {
        for seeds in seeds.chunks(8) {
            scope.spawn(move || {
                for seed in seeds {
                    let mut rng = ChaCha8Rng::seed_from_u64(*seed);
                    let mut bytes = Vec::new();
                    for _ in 0..rng.random_range(1..200) {
                        bytes.extend(message(&mut rng));
                    }
                    for _ in 0..rng.random_range(0..8) {
                        let at = rng.random_range(0..bytes.len());
                        bytes[at] = rng.random();
                    }
                    let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
                    let mut listening = Listening::start(socket.local_addr().unwrap().port(), STEPS);
                    let (mut stream, _) = socket.accept().unwrap();
                    let mut greeting = [0; 256];
                    let _read = stream.read(&mut greeting).unwrap();
                    let _gone = stream.write_all(&CONNACK).and_then(|()| stream.write_all(&bytes));
                    drop(stream);
                    listening.stop.request();
                    while listening.next().is_some() {}
                    let ended = listening.thread.join();
                    assert!(ended.is_ok_and(|heard| heard.is_ok()), "seed {seed}");
                }
            });
        }
    });
}

/// The attack: 4 200 messages of control characters. Lines that wait for silence have a byte limit.
#[test]
fn what_waits_for_silence_is_bounded_in_bytes() {
    let rules = "[[rule]]\ntopic = \"home/+/state\"\nsay = \"the {1} is {value}\"\nquiet_s = 600.0";
    let start = Instant::now();
    let after = start + Duration::from_secs(600);
    let bytes = |listener: &Listener| listener.waiting.iter().map(|waiting| waiting.line.capacity()).sum::<usize>();
    for (text, waits) in [
        ("\u{1}".repeat(PAYLOAD_BYTES_MAX - 20), false),
        ("x".repeat(PAYLOAD_BYTES_MAX - 20), false),
        ("\u{1}".repeat(1_300), false),
        ("on\u{1b}[2J".to_owned(), false),
        ("x".repeat(400), true),
        ("on".to_owned(), true),
    ] {
        let mut listener = Listener::new(Rules::parse(rules).unwrap());
        for n in 0..4_200 {
            let (topic, payload) = (format!("home/t{n}/state"), format!("{text}{n:08}"));
            assert!(listener.hear(topic.as_bytes(), payload.as_bytes(), false, start).is_empty());
            assert!(bytes(&listener) <= WAITING_BYTES_MAX);
        }
        let kept = listener.waiting.len();
        assert_eq!(kept > 0, waits, "{kept} lines of {} bytes", text.len());
        assert!(kept <= WAITING_MAX && listener.refused == 4_200 - kept as u64, "{kept}: {:?}", listener.heard);
        let due = listener.due(after);
        assert_eq!(due.len(), kept);
        assert!(due.iter().all(|line| line_item(line, &Who::Somebody).is_ok()));
    }
    // There is room again. A rejected line does not end a silence.
    let mut listener = Listener::new(Rules::parse(&format!("{rules}\n{STEPS}")).unwrap());
    assert!(listener.hear(b"home/lamp/state", b"on", false, start).is_empty());
    assert!(listener.hear(b"home/step", b"\x07", false, start).is_empty());
    assert_eq!(listener.due(after), [r#"{"kind":"device","text":"the lamp is on"}"#]);
}

/// The attack: 900 rules for one field. A message is read once for all rules.
#[test]
fn a_message_is_read_once_for_all_rules() {
    let rule =
        |n: usize| format!("[[rule]]\ntopic = \"z\"\nfield = \"/a\"\nwhen = \"{n}\"\nsay = \"the lamp is on\"\n");
    let mut listener = Listener::new(Rules::parse(&(0..900).map(rule).collect::<String>()).unwrap());
    let items = "1,".repeat(PAYLOAD_BYTES_MAX / 2 - 20);
    let payload = format!(r#"{{"b":[{items}1],"a":"none"}}"#);
    let one = Instant::now();
    for _ in 0..10 {
        serde_json::from_str::<serde_json::Value>(&payload).unwrap();
    }
    let one = one.elapsed() / 10;
    let all = Instant::now();
    listener.hear(b"z", payload.as_bytes(), false, all);
    let all = all.elapsed();
    assert!(all < one * 100, "900 rules took {all:?}, reading it once {one:?}");
    assert_eq!((listener.heard.unfit, listener.heard.oversized), (1, 0));
}

fn is_probe(subscribe: &[u8]) -> bool {
    subscribe.windows(probe::TOPIC.len()).any(|part| part == probe::TOPIC.as_bytes())
}

/// A false broker that does as a test says.
struct Liar {
    socket: std::net::TcpListener,
    stream: Option<std::net::TcpStream>,
}

/// A message of quality 1.
fn message(topic: &str, payload: &str, pkid: u16, dup: bool) -> Vec<u8> {
    let rest = 2 + topic.len() + 2 + 1 + payload.len();
    assert!(rest < 128);
    let mut packet = vec![0x32 | u8::from(dup) << 3, rest as u8, 0, topic.len() as u8];
    packet.extend(topic.as_bytes());
    packet.extend(pkid.to_be_bytes());
    packet.push(0);
    packet.extend(payload.as_bytes());
    packet
}

impl Liar {
    fn new() -> (Self, u16) {
        let socket = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        (Self { socket, stream: None }, port)
    }

    /// The next packet that is not a probe.
    fn read(&mut self) -> Option<(u8, Vec<u8>)> {
        loop {
            let packet = self.read_any()?;
            if !(packet.0 == 8 && is_probe(&packet.1)) {
                return Some(packet);
            }
        }
    }

    fn read_any(&mut self) -> Option<(u8, Vec<u8>)> {
        let stream = self.stream.as_mut().unwrap();
        let mut head = [0; 2];
        stream.read_exact(&mut head).ok()?;
        let (mut length, mut shift, mut byte) = (usize::from(head[1] & 127), 7, head[1]);
        while byte & 128 != 0 {
            let mut more = [0];
            stream.read_exact(&mut more).ok()?;
            byte = more[0];
            length |= usize::from(byte & 127) << shift;
            shift += 7;
        }
        let mut body = vec![0; length];
        stream.read_exact(&mut body).ok()?;
        Some((head[0] >> 4, body))
    }

    fn write(&mut self, bytes: &[u8]) {
        self.stream.as_mut().unwrap().write_all(bytes).unwrap();
    }

    /// Accepts a connection, greets it with these properties, and grants its subscription.
    fn greet(&mut self, is_kept: bool, properties: &[u8]) {
        // This ends the earlier connection.
        self.stream = None;
        self.stream = Some(self.socket.accept().unwrap().0);
        let _connect = self.read().unwrap();
        let length = properties.len() as u8;
        let greeting = [&[0x20, 3 + length, u8::from(is_kept), 0, length], properties].concat();
        self.write(&greeting);
    }

    fn greet_and_grant(&mut self, is_kept: bool, properties: &[u8]) {
        self.greet(is_kept, properties);
        self.grant();
    }

    fn grant(&mut self) {
        let (_, subscribe) = self.read_kind(8);
        self.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1]);
    }

    /// The next packet of a kind. It answers pings on the way.
    fn read_kind(&mut self, kind: u8) -> (u8, Vec<u8>) {
        loop {
            let packet = self.read().unwrap();
            if packet.0 == 12 {
                self.write(&[0xd0, 0]);
            }
            if packet.0 == kind {
                return packet;
            }
        }
    }

    fn acknowledged(&mut self, messages: usize) {
        (0..messages).for_each(|_| _ = self.read_kind(4));
    }
}

const BELL: &str = "[[rule]]\ntopic = \"bell\"\nrepeats = true\nsay = \"They ring the bell for {value}.\"";

/// A broker that uses the lowest free identifier has its acknowledgements, and its new messages are lost on their way.
#[test]
fn an_identifier_that_was_acknowledged_is_free_for_a_new_message() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, BELL);
    for round in 0..4 {
        broker.greet_and_grant(round > 0, &[]);
        // From the second round on, their first sending was lost with the connection.
        broker.write(&[message("bell", "ada", 1, round > 0), message("bell", "ben", 2, round > 0)].concat());
        for name in ["ada", "ben"] {
            assert_eq!(
                listening.next().unwrap(),
                format!("{{\"kind\":\"device\",\"text\":\"They ring the bell for {name}.\"}}")
            );
        }
        broker.acknowledged(2);
    }
    assert_eq!(listening.end().1.said, 8);
}

/// An unacknowledged message certainly comes again, in whatever order the broker uses identifiers.
#[test]
fn what_was_not_acknowledged_is_recognised() {
    let (mut broker, port) = Liar::new();
    let to = to(port);
    let (reader, writer) = std::io::pipe().unwrap();
    let (stop, rules) = (Stop::new(), Rules::parse(BELL).unwrap());
    let (mut tell, news) = settled();
    let own_stop = stop.clone();
    let thread =
        std::thread::spawn(move || listen_until_settled(to.options().unwrap(), rules, None, writer, news, &own_stop));
    let mut lines = BufReader::new(reader).lines().map(Result::unwrap);
    broker.greet_and_grant(false, &[]);
    broker.write(&message("bell", "ada", 1, false));
    assert!(lines.next().unwrap().contains("ada"));
    broker.greet_and_grant(true, &[]);
    broker.write(&[message("bell", "ada", 1, true), message("bell", "ben", 2, true)].concat());
    assert!(lines.next().unwrap().contains("ben"));
    tell(2);
    broker.acknowledged(2);
    stop.request();
    assert_eq!(thread.join().unwrap().unwrap().said, 2);
}

/// A broker that counts identifiers lacks the last acknowledgements, until a ping shows that it has them.
#[test]
fn a_broker_that_counts_says_nothing_twice_until_it_has_answered_a_ping() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, BELL);
    let all = 100_u16;
    broker.greet_and_grant(false, &[]);
    for n in 1..=all {
        broker.write(&message("bell", &n.to_string(), n, false));
        assert!(listening.next().unwrap().contains(&format!("for {n}.")));
    }
    broker.acknowledged(usize::from(all));
    // It expects a ping each second now. The last message is new: its first sending was lost.
    broker.greet_and_grant(true, &[19, 0, 1]);
    let again: Vec<_> = (all - 20..=all).flat_map(|n| message("bell", &n.to_string(), n, true)).collect();
    broker.write(&again);
    broker.write(&message("bell", "last", all + 1, true));
    assert!(listening.next().unwrap().contains("for last."), "the others are recognised");
    broker.acknowledged(22);
    broker.read_kind(12);
    broker.write(&message("bell", "more", all + 2, false));
    assert!(listening.next().unwrap().contains("for more."));
    broker.greet_and_grant(true, &[]);
    broker.write(&message("bell", "last", all + 1, true));
    assert!(listening.next().unwrap().contains("for last."), "it had the acknowledgement");
    // After a new session no message comes again.
    broker.greet_and_grant(false, &[]);
    broker.write(&message("bell", "more", all + 2, true));
    assert!(listening.next().unwrap().contains("for more."));
    listening.end();
}

/// A new narrator in the middle of a session with a broker that counts. The broker ends before it has stored any acknowledgement, and sends
/// everything again.
#[test]
fn a_broker_that_counts_says_nothing_twice_to_a_young_narrator() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, BELL);
    let ids = 9_949..=10_001_u16;
    let all = |dup: bool| ids.clone().flat_map(move |n| message("bell", &n.to_string(), n, dup)).collect::<Vec<_>>();
    broker.greet_and_grant(true, &[]);
    broker.write(&all(false));
    for n in ids.clone() {
        assert!(listening.next().unwrap().contains(&format!("for {n}.")));
    }
    broker.acknowledged(ids.len());
    broker.greet_and_grant(true, &[]);
    broker.write(&all(true));
    broker.write(&message("bell", "last", 10_002, false));
    assert!(listening.next().unwrap().contains("for last."));
    broker.acknowledged(ids.len() + 1);
    assert_eq!(listening.end().1.said, ids.len() as u64 + 1);
}

/// The attack: a server keep alive of 0. The broker expects no pings, and none is too late.
#[test]
fn a_broker_that_wants_no_pings_is_not_left() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, STEPS);
    broker.greet_and_grant(false, &[19, 0, 0]);
    let start = Instant::now();
    let mut n = 0;
    while start.elapsed() < Duration::from_secs(4) {
        broker.write(&message("home/step", &n.to_string(), 1, false));
        assert!(listening.next().unwrap().contains(&format!("step {n}.")));
        n += 1;
        // Messages instead of pings, for longer than a client waits for a ping's answer.
        std::thread::sleep(Duration::from_millis(300));
    }
    broker.socket.set_nonblocking(true).unwrap();
    assert!(broker.socket.accept().is_err(), "one connection is enough");
    listening.end();
}

/// The attack: a receive maximum of 0, and the same broker after it has recovered.
#[test]
fn a_broker_that_allows_nothing_is_tried_again() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, STEPS);
    let start = Instant::now();
    broker.greet(false, &[33, 0, 0]);
    broker.greet(false, &[33, 0, 0]);
    broker.greet(false, &[]);
    assert!(start.elapsed() > Duration::from_millis(2_500), "the second pause is longer: {:?}", start.elapsed());
    broker.grant();
    broker.write(&message("home/step", "1", 1, false));
    assert!(listening.next().unwrap().contains("step 1."));
    listening.end();
}

/// The attack: 150 answers to one subscription.
#[test]
fn more_answers_than_questions_say_nothing() {
    let rule = |n: usize| format!("[[rule]]\ntopic = \"t{n:03}\"\nsay = \"They do step {{value}}.\"\n");
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, &(0..200).map(rule).collect::<String>());
    broker.greet(false, &[]);
    let (_, subscribe) = broker.read_kind(8);
    broker.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1].repeat(150));
    (1..200).for_each(|_| broker.grant());
    broker.write(&message("t199", "1", 1, false));
    assert!(listening.next().unwrap().contains("step 1."));
    listening.end();
}

fn is_identified(subscribe: &[u8]) -> bool {
    subscribe[2] > 0
}

/// The attack: overlapping filters. The broker sends a copy for each of them.
#[test]
fn what_fits_two_filters_is_said_once() {
    const PRESSES: &str = "[[rule]]\ntopic = \"zigbee/+\"\nrepeats = true\nsay = \"They press {value}.\"\n\
        [[rule]]\ntopic = \"+/button\"\nrepeats = true\npresence = \"present\"\n";
    let Some((mut broker, port)) = Mosquitto::ready() else { return };
    let press = |broker: &Mosquitto| {
        let presses: Vec<_> =
            ["once", "once", "twice", "once"].map(|press| ("zigbee/button", press.into(), false)).to_vec();
        broker.publish(&presses);
    };
    let mut expected = Vec::new();
    for press in ["once", "once", "twice", "once"] {
        expected.extend([
            format!("{{\"kind\":\"device\",\"text\":\"They press {press}.\"}}"),
            r#"{"presence":"present"}"#.to_owned(),
        ]);
    }
    broker.publish(&[("home/start", "first".into(), true)]);
    let start = "[[rule]]\ntopic = \"home/start\"\nsay = \"They do the {value}.\"\nretained = true";
    let mut first = Listening::start(port, &format!("{PRESSES}{start}"));
    assert!(first.next().unwrap().contains("the first"));
    press(&broker);
    let said: Vec<_> = (0..8).map(|_| first.next().unwrap()).collect();
    assert_eq!(said, expected);
    assert_eq!(first.end(), (Vec::new(), Heard { said: 9, ..Heard::default() }));
    // The broker stores messages for an absent narrator, also over its own restart, and also if that narrator then has another filter.
    press(&broker);
    broker = broker.restart();
    let other = "[[rule]]\ntopic = \"zigbee/#\"\nrepeats = true\nsay = \"They press {value}.\"\n\
        [[rule]]\ntopic = \"+/button\"\nrepeats = true\npresence = \"present\"\n";
    let mut second = Listening::start(port, other);
    let said: Vec<_> = (0..8).map(|_| second.next().unwrap()).collect();
    assert_eq!(said, expected);
    // Its session still has the earlier filter.
    press(&broker);
    let said: Vec<_> = (0..8).map(|_| second.next().unwrap()).collect();
    assert_eq!(said, expected);
    assert_eq!(second.end(), (Vec::new(), Heard { said: 16, ..Heard::default() }));
}

/// A broker may reject identifiers, in its greeting or in its answer.
#[test]
fn a_broker_without_identifiers_is_asked_without() {
    let (mut broker, port) = Liar::new();
    let mut listening = Listening::start(port, BELL);
    broker.greet(false, &[]);
    let (_, subscribe) = broker.read_kind(8);
    assert!(is_identified(&subscribe));
    broker.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 0xa1]);
    let (_, subscribe) = broker.read_kind(8);
    assert!(!is_identified(&subscribe));
    broker.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1]);
    broker.write(&[message("bell", "ada", 1, false), message("bell", "ada", 2, false)].concat());
    assert_eq!(listening.next(), listening.next(), "each is a ring of its own");
    broker.greet(true, &[41, 0]);
    let (_, subscribe) = broker.read_kind(8);
    assert!(!is_identified(&subscribe));
    broker.write(&[0x90, 4, subscribe[0], subscribe[1], 0, 1]);
    listening.end();
}

/// A covered filter is unsubscribed once, and only in a session that the broker has kept.
#[test]
fn a_subscription_that_is_left_out_is_ended_once() {
    let rules = "[[rule]]\ntopic = \"bell\"\nrepeats = true\nsay = \"They ring.\"\n\
        [[rule]]\ntopic = \"#\"\nsay = \"They do {value}.\"";
    // Whether it unsubscribes before it acknowledges a message.
    let asks = |broker: &mut Liar| {
        broker.write(&message("bell", "x", 1, false));
        broker.read().unwrap()
    };
    let (mut broker, port) = Liar::new();
    let listening = Listening::start(port, rules);
    broker.greet_and_grant(false, &[]);
    assert_eq!(asks(&mut broker).0, 4, "a new session has nothing to end");
    broker.greet_and_grant(true, &[]);
    assert_eq!(asks(&mut broker).0, 4, "nor what this narrator began");
    listening.end();

    let (mut broker, port) = Liar::new();
    let listening = Listening::start(port, rules);
    // The first answer is lost.
    for is_answered in [false, true] {
        broker.greet_and_grant(true, &[]);
        let (kind, unsubscribe) = asks(&mut broker);
        assert_eq!(kind, 10);
        assert!(unsubscribe.ends_with(b"bell"));
        broker.acknowledged(1);
        if is_answered {
            broker.write(&[0xb0, 4, unsubscribe[0], unsubscribe[1], 0, 0]);
            assert_eq!(asks(&mut broker).0, 4, "one end is enough");
        }
    }
    broker.greet_and_grant(true, &[]);
    assert_eq!(asks(&mut broker).0, 4, "it was ended");
    listening.end();
}

#[test]
fn every_example_of_the_manual_is_a_rules_file() {
    const MANUAL: &str = include_str!("../../../docs/mqtt.md");
    let blocks = MANUAL.split("```toml\n").skip(1).filter_map(|rest| rest.split("```").next());
    let numbers: Vec<usize> = blocks.map(|block| Rules::parse(block).unwrap().about().count()).collect();
    assert_eq!(numbers, [8, 3, 1]);
}

#[test]
fn one_rule_covers_many_sensors_and_takes_the_room_from_the_topic() {
    let rules = "[[rule]]\ntopic = \"zigbee2mqtt/{room}_motion\"\nfield = \"/occupancy\"\nsensor = \"motion\"\n\
        [[rule]]\ntopic = \"{floor}/{room}/lamp\"\nwhen = \"on\"\nsay = \"They turn on the lamp in the {room}.\"\n";
    let rules = Rules::parse(rules).unwrap();
    assert_eq!(rules.filters(), ["+/+/lamp", "zigbee2mqtt/+"]);
    assert!(rules.fits(1, "zigbee2mqtt/hall_motion") && !rules.fits(1, "zigbee2mqtt/hall_door"));
    assert_eq!(rules.unreadable("zigbee2mqtt/bridge", b"{}"), None, "no rule speaks of it");
    let mut listener = Listener::new(rules);
    let on = hear(&mut listener, "zigbee2mqtt/living_room_motion", r#"{"occupancy": true}"#, false).unwrap();
    let line: serde_json::Value = serde_json::from_str(&on).unwrap();
    assert_eq!((&line["room"], &line["sensor"], &line["on"]), (&"living room".into(), &"motion".into(), &true.into()));
    let off = hear(&mut listener, "zigbee2mqtt/living_room_motion", r#"{"occupancy": false}"#, false).unwrap();
    assert!(off.contains("living room") && off.contains("false"), "one rule is enough for on and off: {off}");
    assert_eq!(hear(&mut listener, "zigbee2mqtt/_motion", r#"{"occupancy": true}"#, false), None);
    let lamp = hear(&mut listener, "upstairs/bath/lamp", "on", false).unwrap();
    assert!(lamp.contains("They turn on the lamp in the bath."), "{lamp}");
    let mixed = "[[rule]]\ntopic = \"w/{room}/+/x/+\"\nsay = \"They open the {2} and the {1} in the {room}.\"\n";
    let mut listener = Listener::new(Rules::parse(mixed).unwrap());
    let said = hear(&mut listener, "w/hall/lamp/x/fridge", "on", false).unwrap();
    assert!(said.contains("They open the fridge and the lamp in the hall."), "{said}");
    assert!(Rules::parse(&mixed.replace("{2}", "{3}")).is_err(), "only + has a number");
    for (topic, fault) in [
        ("a/{room", "not closed"),
        ("a/{Room}", "no name for a part of the topic"),
        ("a/{value}", "no name for a part of the topic"),
        ("a/{room}_{kind}", "one for each level"),
    ] {
        let error = Rules::parse(&format!("[[rule]]\ntopic = \"{topic}\"\nsay = \"x\"")).unwrap_err();
        assert!(error.contains(fault), "{error}");
    }
}

#[test]
fn an_event_counts_only_if_all_conditions_hold() {
    let rules = "[[rule]]\ntopic = \"frigate/events\"\nfield = \"/type\"\nequals = \"new\"\nrepeats = true\n\
        all = [{ field = \"/after/label\", equals = \"person\" }, { field = \"/after/score\", above = 0.7 }]\n\
        presence = \"present\"\nroom = \"{/after/camera}\"\n\
        [[rule]]\ntopic = \"owntracks/ada/phone/event\"\nfield = \"/event\"\nequals = \"enter\"\n\
        all = [{ field = \"/desc\", equals = \"Home\" }]\npresence = \"present\"\nperson = \"ada\"\n";
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    let event = |label: &str, score: f64| {
        format!(r#"{{"type": "new", "after": {{"label": "{label}", "score": {score}, "camera": "hall"}}}}"#)
    };
    assert_eq!(hear(&mut listener, "frigate/events", &event("cat", 0.9), false), None);
    assert_eq!(hear(&mut listener, "frigate/events", &event("person", 0.5), false), None);
    assert!(hear(&mut listener, "frigate/events", &event("person", 0.9), false).unwrap().contains("hall"));
    let enters = |region: &str| format!(r#"{{"_type": "transition", "event": "enter", "desc": "{region}"}}"#);
    assert_eq!(hear(&mut listener, "owntracks/ada/phone/event", &enters("Work"), false), None);
    assert!(hear(&mut listener, "owntracks/ada/phone/event", &enters("home"), false).unwrap().contains("ada"));
    let error = Rules::parse("[[rule]]\ntopic = \"a\"\nsay = \"x\"\nall = [{ field = \"label\" }]").unwrap_err();
    assert!(error.contains("rule 1: all: field is a JSON pointer"), "{error}");
}

#[test]
fn a_state_is_said_when_it_has_lasted() {
    let rules = "[[rule]]\ntopic = \"plug/washer\"\nfield = \"/power\"\nabove = 5.0\nfor_s = 30.0\nsensor = \"appliance\"\nroom = \"bath\"\n";
    let mut listener = Listener::new(Rules::parse(rules).unwrap());
    let start = Instant::now();
    let mut power = |watts: f64, at_s: u64| {
        let at = start + Duration::from_secs(at_s);
        let said = listener.hear(b"plug/washer", format!("{{\"power\": {watts}}}").as_bytes(), false, at);
        (said, listener.due(at))
    };
    // A peak of ten seconds does not count as use of the machine.
    assert_eq!(power(900.0, 0), (vec![], vec![]));
    assert!(power(0.2, 10).0.len() <= 1);
    assert_eq!(power(0.2, 50).1, [""; 0]);
    assert_eq!(power(900.0, 100), (vec![], vec![]));
    assert_eq!(power(850.0, 120), (vec![], vec![]), "it lasts, and does not begin again");
    let (said, due) = power(910.0, 131);
    assert!(said.is_empty() && due.len() == 1 && due[0].contains("appliance") && due[0].contains("true"), "{due:?}");
    let (off, _) = power(0.3, 200);
    assert!(off.len() == 1 && off[0].contains("false"), "{off:?}");
    let error =
        |keys: &str| Rules::parse(&format!("[[rule]]\ntopic = \"a\"\npresence = \"present\"\n{keys}")).unwrap_err();
    assert!(error("for_s = 0.0").contains("for_s is 0; give seconds above 0, at most 86400"));
    assert!(error("for_s = 5.0\nquiet_s = 5.0").contains("for_s excludes quiet_s"));
}
