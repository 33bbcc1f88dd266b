//! The MQTT messages of robots.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::config::{RobotConfig, RobotKind};
use crate::slug::slug;

const SEGMENTS_MAX: usize = 256;

/// The activity of a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// It is at its dock.
    Docked,
    /// It stands somewhere.
    Idle,
    /// It works, or is on its way there.
    Cleaning,
    /// Its work was interrupted.
    Paused,
    /// It is on its way to the dock.
    Returning,
    /// A person steers it.
    Manual,
    /// It cannot continue.
    Error,
}

/// The content of a robot's message.
#[derive(Debug, Clone, PartialEq)]
pub enum Sensed {
    /// The activity.
    Status(Status),
    /// Whether it will continue its unfinished work by itself, as after charging.
    Resumes(bool),
    /// The battery's level, 0 to 1.
    Battery(f64),
    /// The fault in the robot's words; empty without a fault.
    Fault(String),
    /// Its segments: numbers and names.
    Segments(BTreeMap<String, String>),
    /// Whether it is connected.
    Online(bool),
}

/// A command for a robot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Order {
    /// Clean a segment, which is this room.
    Clean {
        /// The robot's number or name of the segment.
        segment: String,
        /// The room's id in Roomcast's map.
        room: String,
    },
    /// End the work and stand still.
    Stop,
    /// Interrupt the work in place.
    Pause,
    /// Go to the dock.
    Home,
}

/// The topics of one robot.
#[derive(Debug, Clone)]
pub struct Dialect {
    kind: RobotKind,
    /// The prefix of its topics, without a slash at the end.
    topic: String,
    battery: String,
    /// The topic of commands for Home Assistant.
    orders: String,
}

impl Dialect {
    /// The dialect of the configured robot; `base` is the prefix of Roomcast's topics, `name` the robot's name in them.
    #[must_use]
    pub fn new(config: &RobotConfig, base: &str, name: &str) -> Self {
        let orders = format!("{base}/robots/{}/order", slug(name));
        let own = match config.kind {
            RobotKind::Valetudo => "BatteryStateAttribute/level",
            RobotKind::HomeAssistant => "battery_level",
        };
        // If a battery sensor is configured, only that counts: the broker may still have an old value of the robot.
        let battery = config.battery.clone().unwrap_or_else(|| format!("{}/{own}", config.topic));
        Self { kind: config.kind, topic: config.topic.clone(), battery, orders }
    }

    /// The topics below the robot's prefix, without its battery.
    fn parts(&self) -> &'static [&'static str] {
        match self.kind {
            RobotKind::Valetudo => &[
                "$state",
                "StatusStateAttribute/status",
                "StatusStateAttribute/flag",
                "StatusStateAttribute/error_description",
                "MapData/segments",
            ],
            RobotKind::HomeAssistant => &["state", "error"],
        }
    }

    /// The filters to subscribe to.
    #[must_use]
    pub fn filters(&self) -> Vec<String> {
        self.parts().iter().map(|part| format!("{}/{part}", self.topic)).chain([self.battery.clone()]).collect()
    }

    /// Whether a message should have a known content and has not. Home Assistant's words for unknown values are not a fault.
    #[must_use]
    pub(crate) fn is_garbled(&self, topic: &str, payload: &[u8]) -> bool {
        let part = topic.strip_prefix(&self.topic).and_then(|part| part.strip_prefix('/'));
        let is_read = part.is_some_and(|part| self.parts().contains(&part)) || self.battery == topic;
        let is_unknown =
            ["", "unknown", "unavailable", "None", "null"].map(str::as_bytes).contains(&payload.trim_ascii());
        is_read && !is_unknown && self.hear(topic, payload).is_none()
    }

    /// The content of a message; `None` if it is not understood.
    #[must_use]
    pub fn hear(&self, topic: &str, payload: &[u8]) -> Option<Sensed> {
        let text = std::str::from_utf8(payload).ok()?.trim();
        let plain = text.trim_matches('"');
        if self.battery == topic {
            let share = plain.parse::<f64>().ok()? / 100.0;
            return (0.0..=1.0).contains(&share).then_some(Sensed::Battery(share));
        }
        let part = topic.strip_prefix(&self.topic)?.strip_prefix('/')?;
        match (self.kind, part) {
            (RobotKind::Valetudo, "$state") => Some(Sensed::Online(matches!(plain, "ready" | "alert"))),
            (RobotKind::Valetudo, "StatusStateAttribute/status") => status(plain).map(Sensed::Status),
            (RobotKind::Valetudo, "StatusStateAttribute/flag") => Some(Sensed::Resumes(plain == "resumable")),
            (RobotKind::Valetudo, "StatusStateAttribute/error_description") => {
                Some(Sensed::Fault(if plain.eq_ignore_ascii_case("no error") {
                    String::new()
                } else {
                    plain.to_owned()
                }))
            }
            (RobotKind::Valetudo, "MapData/segments") => segments(text).map(Sensed::Segments),
            (RobotKind::HomeAssistant, "state") => match plain {
                "unavailable" | "unknown" => Some(Sensed::Online(false)),
                known => status(known).map(Sensed::Status),
            },
            (RobotKind::HomeAssistant, "error") => {
                let none = ["", "null", "none", "no error"].iter().any(|none| plain.eq_ignore_ascii_case(none));
                Some(Sensed::Fault(if none { String::new() } else { plain.to_owned() }))
            }
            _ => None,
        }
    }

    /// A command as a message: topic and payload.
    #[must_use]
    pub fn order(&self, order: &Order) -> (String, String) {
        if self.kind == RobotKind::HomeAssistant {
            let message = match order {
                Order::Clean { segment, room } => json!({ "order": "clean", "segment": segment, "room": room }),
                Order::Stop => json!({ "order": "stop" }),
                Order::Pause => json!({ "order": "pause" }),
                Order::Home => json!({ "order": "return" }),
            };
            return (self.orders.clone(), message.to_string());
        }
        let operation = |word: &str| (format!("{}/BasicControlCapability/operation/set", self.topic), word.to_owned());
        match order {
            Order::Clean { segment, .. } => (
                format!("{}/MapSegmentationCapability/clean/set", self.topic),
                json!({ "segment_ids": [segment], "iterations": 1, "customOrder": true }).to_string(),
            ),
            Order::Stop => operation("STOP"),
            Order::Pause => operation("PAUSE"),
            Order::Home => operation("HOME"),
        }
    }
}

/// The words that Valetudo and Home Assistant share, and Valetudo's own.
fn status(word: &str) -> Option<Status> {
    Some(match word {
        "docked" => Status::Docked,
        "idle" => Status::Idle,
        "cleaning" | "moving" => Status::Cleaning,
        "paused" => Status::Paused,
        "returning" => Status::Returning,
        "manual_control" => Status::Manual,
        "error" => Status::Error,
        _ => return None,
    })
}

/// Valetudo's segments: an object from numbers to names.
fn segments(json: &str) -> Option<BTreeMap<String, String>> {
    let Value::Object(segments) = serde_json::from_str(json).ok()? else { return None };
    let named = segments.into_iter().take(SEGMENTS_MAX);
    Some(named.map(|(number, name)| (number, name.as_str().unwrap_or_default().to_owned())).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dialect(kind: RobotKind, topic: &str) -> Dialect {
        let config = RobotConfig { kind, topic: topic.to_owned(), ..RobotConfig::default() };
        Dialect::new(&config, "roomcast", "My robot")
    }

    #[test]
    fn valetudo_is_understood_and_told() {
        let robot = dialect(RobotKind::Valetudo, "valetudo/rockrobo");
        let hear = |part: &str, payload: &str| robot.hear(&format!("valetudo/rockrobo/{part}"), payload.as_bytes());
        assert_eq!(hear("StatusStateAttribute/status", "cleaning"), Some(Sensed::Status(Status::Cleaning)));
        assert_eq!(hear("StatusStateAttribute/status", "dancing"), None);
        assert_eq!(hear("StatusStateAttribute/flag", "resumable"), Some(Sensed::Resumes(true)));
        assert_eq!(hear("StatusStateAttribute/error_description", "No error"), Some(Sensed::Fault(String::new())));
        assert_eq!(hear("BatteryStateAttribute/level", "62"), Some(Sensed::Battery(0.62)));
        for nonsense in ["", "full", "620", "-1", "nan"] {
            assert_eq!(hear("BatteryStateAttribute/level", nonsense), None, "{nonsense}");
        }
        let segments = BTreeMap::from([("16".to_owned(), "Küche".to_owned()), ("17".to_owned(), String::new())]);
        assert_eq!(hear("MapData/segments", r#"{"16": "Küche", "17": null}"#), Some(Sensed::Segments(segments)));
        assert_eq!(hear("MapData/segments", "[1]"), None);
        // A robot with a warning is still connected.
        assert_eq!(hear("$state", "alert"), Some(Sensed::Online(true)));
        assert_eq!(hear("$state", "lost"), Some(Sensed::Online(false)));
        assert_eq!(robot.hear("valetudo/rockrobo2/StatusStateAttribute/status", b"idle"), None);
        assert_eq!(robot.hear("valetudo/rockrobo/StatusStateAttribute/status", b"\xff"), None);
        let is_garbled = |part: &str, payload: &[u8]| robot.is_garbled(&format!("valetudo/rockrobo/{part}"), payload);
        assert!(is_garbled("StatusStateAttribute/status", b"dancing") && is_garbled("MapData/segments", b"[1]"));
        assert!(is_garbled("BatteryStateAttribute/level", b"620") && is_garbled("$state", b"\xff"));
        assert!(!is_garbled("BatteryStateAttribute/level", b"") && !is_garbled("StatusStateAttribute/status", b"idle"));
        assert!(!is_garbled("StatusStateAttribute/detail", b"dancing"), "it is not read at all");
        let (topic, payload) = robot.order(&Order::Clean { segment: "16".into(), room: "kitchen".into() });
        assert_eq!(topic, "valetudo/rockrobo/MapSegmentationCapability/clean/set");
        assert_eq!(payload, r#"{"customOrder":true,"iterations":1,"segment_ids":["16"]}"#);
        let home = ("valetudo/rockrobo/BasicControlCapability/operation/set".to_owned(), "HOME".to_owned());
        assert_eq!(robot.order(&Order::Home), home);
    }

    /// Two robots with one topic would both follow the commands for one.
    #[test]
    fn robots_of_different_names_have_topics_of_their_own() {
        let config = RobotConfig { kind: RobotKind::HomeAssistant, ..RobotConfig::default() };
        let topics: std::collections::BTreeSet<_> = ["Vac", "vac", "Staubi Ä", "Staubi Ö", "staubi__", "robot"]
            .map(|name| Dialect::new(&config, "roomcast", name).order(&Order::Stop).0)
            .into();
        assert_eq!(topics.len(), 6, "{topics:?}");
        assert!(topics.contains("roomcast/robots/robot/order") && topics.contains("roomcast/robots/vac/order"));
    }

    #[test]
    fn home_assistants_vacuums_are_understood_and_told() {
        let robot = dialect(RobotKind::HomeAssistant, "homeassistant/vacuum/dusty");
        let hear =
            |part: &str, payload: &str| robot.hear(&format!("homeassistant/vacuum/dusty/{part}"), payload.as_bytes());
        assert_eq!(hear("state", "returning"), Some(Sensed::Status(Status::Returning)));
        assert_eq!(hear("state", "unavailable"), Some(Sensed::Online(false)));
        assert_eq!(hear("battery_level", "80"), Some(Sensed::Battery(0.8)));
        assert_eq!(hear("error", "\"main brush\""), Some(Sensed::Fault("main brush".into())));
        // Its battery may be a separate sensor.
        let sensor = "homeassistant/sensor/dusty_battery/state";
        let config = RobotConfig {
            kind: RobotKind::HomeAssistant,
            topic: "homeassistant/vacuum/dusty".into(),
            battery: Some(sensor.into()),
            ..RobotConfig::default()
        };
        let with_sensor = Dialect::new(&config, "roomcast", "My robot");
        let own = "homeassistant/vacuum/dusty/battery_level";
        let listens = |robot: &Dialect| [sensor, own].map(|topic| robot.filters().contains(&topic.to_owned()));
        assert_eq!((listens(&with_sensor), listens(&robot)), ([true, false], [false, true]));
        // The broker's value of the vacuum's attribute is old.
        assert_eq!(with_sensor.hear(own, b"80"), None);
        assert_eq!(with_sensor.hear(sensor, b"7"), Some(Sensed::Battery(0.07)));
        assert!(with_sensor.is_garbled(sensor, b"full") && !with_sensor.is_garbled(sensor, b"unavailable"));
        assert_eq!(robot.hear(sensor, b"7"), None);
        let is_garbled =
            |part: &str, payload: &[u8]| robot.is_garbled(&format!("homeassistant/vacuum/dusty/{part}"), payload);
        assert!(is_garbled("battery_level", b"full") && !is_garbled("battery_level", b"unknown"));
        let (topic, payload) = robot.order(&Order::Clean { segment: "2".into(), room: "a\"b".into() });
        assert_eq!(
            (topic.as_str(), payload.as_str()),
            ("roomcast/robots/my_robot_3621ba68/order", r#"{"order":"clean","room":"a\"b","segment":"2"}"#)
        );
    }
}
