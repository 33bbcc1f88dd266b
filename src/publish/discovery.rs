//! Home Assistant's discovery by MQTT: a message for each entity, all of one device.

use serde_json::{Value, json};

use super::names::{AWAY, Named, PERSON, ahead, in_s, of_room};
use super::orders;
use roomcast_services::config::BridgeConfig;
use roomcast_services::slug::slug;

/// The origin of the entities in discovery messages.
pub(super) const ORIGIN: &str = "roomcast";
/// Most bytes of the state of a text sensor in Home Assistant.
const STATE_BYTES_MAX: usize = 255;

pub(super) struct Discovery<'a> {
    config: &'a BridgeConfig,
    node: String,
    device: Value,
    messages: Vec<(String, String)>,
}

/// The bridge's node in discovery topics.
pub(super) fn node(config: &BridgeConfig) -> String {
    slug(&config.topic)
}

/// Whether a discovery message comes from a bridge with this node, not from another program with its name.
pub(super) fn is_own(payload: &[u8], node: &str) -> bool {
    let Ok(message) = serde_json::from_slice::<Value>(payload) else { return false };
    let at = |pointer: &str| message.pointer(pointer).and_then(Value::as_str);
    at("/origin/name") == Some(ORIGIN) && at("/device/identifiers/0") == Some(node)
}

/// A template for a share as a percentage, or unknown.
fn percent(at: &str) -> String {
    format!("{{{{ 'None' if value_json.{at} is none else (value_json.{at} * 100) | round | int }}}}")
}

/// A template for a binary sensor, or unknown.
fn on_off(at: &str) -> String {
    format!("{{{{ 'None' if value_json.{at} is none else ('ON' if value_json.{at} else 'OFF') }}}}")
}

/// A template for a text, or unknown. Home Assistant 2024.3 shows `None` as a text.
fn text(at: &str) -> String {
    format!("{{{{ {at} or 'unknown' }}}}")
}

struct Entity<'a> {
    component: &'a str,
    object: String,
    name: String,
    topic: String,
    template: String,
    more: Value,
}

impl<'a> Discovery<'a> {
    pub(super) fn new(config: &'a BridgeConfig, map: &str) -> Self {
        let node = node(config);
        let mut device = json!({
            "identifiers": [node],
            "name": if config.topic == "roomcast" { "Roomcast".to_owned() } else { format!("Roomcast {}", config.topic) },
            "manufacturer": "Roomcast",
            "sw_version": env!("CARGO_PKG_VERSION"),
        });
        if let (false, Some(device)) = (map.is_empty(), device.as_object_mut()) {
            device.insert("model".to_owned(), map.into());
        }
        Self { config, node, device, messages: Vec::new() }
    }

    pub(super) fn messages(self) -> Vec<(String, String)> {
        self.messages
    }

    /// Adds an entity. It is available while the bridge runs and, if `needs_daemon`, the daemon.
    fn add(&mut self, entity: Entity<'_>, needs_daemon: bool) {
        let Entity { component, object, name, topic, template, more } = entity;
        let (base, node) = (&self.config.topic, &self.node);
        let mut availability = vec![json!({ "topic": format!("{base}/status") })];
        if needs_daemon {
            availability.push(json!({ "topic": format!("{base}/daemon") }));
        }
        let id = format!("{node}_{object}");
        let mut message = json!({
            "name": name,
            "unique_id": id,
            // The key `default_entity_id` was `object_id` until 2025.
            "object_id": id,
            "default_entity_id": format!("{component}.{id}"),
            "state_topic": format!("{base}/{topic}"),
            "value_template": template,
            "availability": availability,
            "availability_mode": "all",
            "device": self.device,
            "origin": { "name": ORIGIN, "sw_version": env!("CARGO_PKG_VERSION") },
        });
        if let (Value::Object(more), Some(message)) = (more, message.as_object_mut()) {
            message.extend(more);
            if component == "button" {
                // A button has no state.
                message.retain(|key, _| key != "state_topic" && key != "value_template");
            }
        }
        let topic = format!("{}/{component}/{node}/{object}/config", self.config.discovery);
        self.messages.push((topic, message.to_string()));
    }

    /// The home, the daemon's health, and the time of the last event if there was one.
    pub(super) fn home(&mut self, narrated: bool) {
        let entity = |component, object: &str, name: &str, topic: &str, template, more| Entity {
            component,
            object: object.to_owned(),
            name: name.to_owned(),
            topic: topic.to_owned(),
            template,
            more,
        };
        let occupancy = json!({ "device_class": "occupancy" });
        self.add(entity("binary_sensor", "somebody", "somebody home", "home", on_off("somebody"), occupancy), true);
        let attributes = format!("{}/health", self.config.topic);
        let connectivity = json!({
            "device_class": "connectivity", "entity_category": "diagnostic", "json_attributes_topic": attributes,
        });
        self.add(entity("binary_sensor", "daemon", "daemon", "health", on_off("daemon"), connectivity), false);
        if narrated {
            let timestamp = json!({ "device_class": "timestamp", "entity_category": "diagnostic" });
            let time = "{{ value | int | as_datetime }}".to_owned();
            self.add(entity("sensor", "narrated", "last narration", "narrated", time, timestamp), false);
        }
    }

    /// A room: the probability that it is occupied now and later, whether a person is expected soon, whether this is a good time to clean it, and, if
    /// known, when it was last cleaned.
    pub(super) fn room(&mut self, id: &str, shown: &str, is_cleaned: bool) {
        let room = of_room(id);
        let topic = format!("rooms/{room}");
        let measured = |icon: &str| json!({ "unit_of_measurement": "%", "state_class": "measurement", "icon": icon });
        let mut now = measured("mdi:account-eye");
        if let Some(now) = now.as_object_mut() {
            now.insert("json_attributes_topic".to_owned(), format!("{}/{topic}", self.config.topic).into());
        }
        let entity = |component, object: String, name, template, more| Entity {
            component,
            object,
            name,
            topic: topic.clone(),
            template,
            more,
        };
        self.add(entity("sensor", format!("{room}_now"), format!("{shown} now"), percent("now"), now), true);
        for seconds in self.config.horizons_s.clone() {
            let object = format!("{room}{}", in_s(seconds));
            let name = format!("{shown} in {}", ahead(seconds));
            let template = percent(&format!("at['{seconds}']"));
            self.add(entity("sensor", object, name, template, measured("mdi:account-clock")), true);
        }
        let soon = json!({ "device_class": "occupancy" });
        let (object, name) = (format!("{room}_soon"), format!("{shown} soon"));
        self.add(entity("binary_sensor", object, name, on_off("soon"), soon), true);
        let attributes = json!({
            "icon": "mdi:broom", "json_attributes_topic": format!("{}/{topic}", self.config.topic),
            "json_attributes_template": "{{ {'reason': value_json.reason} | tojson }}",
        });
        let (object, name) = (format!("{room}_good"), format!("{shown} good time to clean"));
        self.add(entity("binary_sensor", object, name, on_off("good"), attributes), true);
        if is_cleaned {
            let timestamp = json!({ "device_class": "timestamp" });
            let template = "{{ value_json.cleaned_unix_s | int | as_datetime }}".to_owned();
            let (object, name) = (format!("{room}_cleaned"), format!("{shown} last cleaned"));
            self.add(entity("sensor", object, name, template, timestamp), false);
        }
    }

    /// A person: the likely room now and later, whether the person is at home, and a selection of the rooms (names) that corrects the place.
    pub(super) fn person(&mut self, Named { part: person, name }: &Named, rooms: &[(String, String)]) {
        let topic = format!("persons/{person}");
        let entity = |component, object: String, name, template: String, more| Entity {
            component,
            object,
            name,
            topic: topic.clone(),
            template,
            more,
        };
        let attributes = format!("{}/{topic}", self.config.topic);
        let now = json!({ "icon": "mdi:account", "json_attributes_topic": attributes });
        let template = text("value_json.likely_name");
        self.add(entity("sensor", format!("{PERSON}{person}"), name.to_owned(), template, now), true);
        for seconds in self.config.horizons_s.clone() {
            let object = format!("{PERSON}{person}{}", in_s(seconds));
            let template = text(&format!("(value_json.at['{seconds}'] or {{}}).likely_name"));
            let (name, later) = (format!("{name} in {}", ahead(seconds)), json!({ "icon": "mdi:account-clock" }));
            self.add(entity("sensor", object, name, template, later), true);
        }
        let home = "{{ {'present': 'ON', 'away': 'OFF', 'gone': 'OFF'}.get(value_json.presence, 'None') }}".to_owned();
        let presence = json!({ "device_class": "presence" });
        let object = format!("{PERSON}{person}_home");
        self.add(entity("binary_sensor", object, format!("{name} home"), home, presence), true);
        let options: Vec<&str> = rooms.iter().map(|(_, shown)| shown.as_str()).chain([AWAY]).collect();
        let place = json!({
            "command_topic": orders::place_topic(&self.config.topic, person), "options": options,
            "icon": "mdi:map-marker-account",
        });
        let template = "{{ value_json.likely_name or 'None' }}".to_owned();
        self.add(entity("select", format!("{PERSON}{person}_place"), format!("{name} place"), template, place), true);
    }

    /// The orders to a robot: a switch that holds it, and for each room (id and name) buttons to clean and to skip it.
    pub(super) fn orders(&mut self, Named { part: robot, name }: &Named, rooms: &[(String, String)]) {
        let base = self.config.topic.clone();
        let topic = format!("robots/{robot}");
        let entity = |component, object: String, name, template: &str, more| Entity {
            component,
            object,
            name,
            topic: topic.clone(),
            template: template.to_owned(),
            more,
        };
        let hold = json!({ "command_topic": orders::topic(&base, robot, "hold"), "icon": "mdi:hand-back-right" });
        let is_held = "{{ 'ON' if 'held' in value_json.flags else 'OFF' }}";
        self.add(entity("switch", format!("robot_{robot}_hold"), format!("{name} hold"), is_held, hold), false);
        for (id, shown) in rooms {
            for (level, words, icon) in
                [("clean", "clean now:", "mdi:broom"), ("skip", "skip today:", "mdi:debug-step-over")]
            {
                let press = json!({
                    "command_topic": orders::topic(&base, robot, level), "payload_press": id, "icon": icon,
                });
                let (object, name) =
                    (format!("robot_{robot}_{level}_{}", of_room(id)), format!("{name} {words} {shown}"));
                self.add(entity("button", object, name, "", press), true);
            }
        }
    }

    /// A robot: its decision, the target room and the reason.
    pub(super) fn robot(&mut self, Named { part: robot, name }: &Named) {
        let topic = format!("robots/{robot}");
        let attributes = format!("{}/{topic}", self.config.topic);
        let entity = |part: &str, template: String, more: Value| Entity {
            component: "sensor",
            object: format!("robot_{robot}_{part}"),
            name: format!("{name} {part}"),
            topic: topic.clone(),
            template,
            more,
        };
        let options = json!({
            "device_class": "enum", "options": ["go", "stay", "pause"], "icon": "mdi:robot-vacuum",
            "json_attributes_topic": attributes,
        });
        let plain = |icon: &str| json!({ "icon": icon });
        let reason = format!("{{{{ value_json.reason[:{STATE_BYTES_MAX}] }}}}");
        let all = [
            entity("decision", "{{ value_json.action }}".to_owned(), options),
            entity("room", text("value_json.room_name"), plain("mdi:floor-plan")),
            entity("place", text("value_json.place"), plain("mdi:map-marker")),
            entity("reason", reason, plain("mdi:comment-question")),
        ];
        // A robot's decision stays valid while the daemon is away.
        all.into_iter().for_each(|entity| self.add(entity, false));
    }
}
