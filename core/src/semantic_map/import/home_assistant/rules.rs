//! The rules that say what the states of a home mean, and the names of things in their sentences.

use std::collections::{BTreeSet, HashMap};

use super::comment;
use super::thing::Sensor;
use crate::narration::{RoomName, SENSOR_ID_BYTES_MAX, SensorKind, check_name};
use crate::semantic_map::import::furnish::usually_has;
use crate::semantic_map::schema::RoomEntry;

/// The part of topics before domain and object, as `mqtt_statestream` is set up in Home Assistant's own example.
const BASE_TOPIC: &str = "homeassistant";

/// A thing that takes more is in use, in watts. Less is standby.
const IN_USE_W: f64 = 15.0;

/// A sensor in its room.
pub(super) struct Placed<'a> {
    pub(super) domain: &'a str,
    pub(super) object: &'a str,
    /// The room, as an index of the plan's rooms.
    pub(super) room: usize,
    pub(super) sensor: Sensor,
    /// The person that it is bound to.
    pub(super) person: Option<&'a str>,
}

/// What sentences call the things of a home: "the lamp", or "the kitchen lamp" where another room has a lamp, too.
pub(super) struct Phrases(HashMap<(usize, String), String>);

impl Phrases {
    /// The phrases of all things. `spoken` names the rooms. If rooms are `furnished` later, their usual furniture counts, too.
    pub(super) fn of(sensors: &[Placed<'_>], rooms: &[RoomEntry], spoken: &[String], furnished: bool) -> Self {
        let things: BTreeSet<(&str, usize)> =
            sensors.iter().filter_map(|placed| Some((placed.sensor.thing.as_deref()?, placed.room))).collect();
        let is_elsewhere = |thing: &str, own: usize| {
            rooms.iter().enumerate().any(|(room, RoomEntry { label, .. })| {
                room != own && (things.contains(&(thing, room)) || furnished && usually_has(label, thing))
            })
        };
        let short = |thing: &str, room: usize| match &spoken[room] {
            _ if !is_elsewhere(thing, room) => thing.to_owned(),
            name if thing.strip_prefix(name.as_str()).is_some_and(|rest| rest.starts_with(' ')) => thing.to_owned(),
            name if stands_before(name) => format!("{name} {thing}"),
            name => long(thing, name),
        };
        let mut rooms_of: HashMap<String, BTreeSet<usize>> = HashMap::new();
        for (thing, room) in &things {
            rooms_of.entry(short(thing, *room)).or_default().insert(*room);
        }
        let phrase = |(thing, room): &(&str, usize)| {
            let short = short(thing, *room);
            // "garage" and "door" are a garage door, too.
            let is_clear = rooms_of.get(&short).is_none_or(|rooms| rooms.len() == 1);
            ((*room, (*thing).to_owned()), if is_clear { short } else { long(thing, &spoken[*room]) })
        };
        Self(things.iter().map(phrase).collect())
    }

    fn get(&self, thing: &str, room: usize) -> String {
        self.0.get(&(room, thing.to_owned())).cloned().unwrap_or_else(|| thing.to_owned())
    }
}

/// A thing in its room. "lena's room" has no article, and neither has a name with a number.
fn long(thing: &str, room: &str) -> String {
    let is_named =
        room.contains("'s ") && !room.starts_with("children's") || room.ends_with(|c: char| c.is_ascii_digit());
    format!("{thing} in {}{room}", if is_named { "" } else { "the " })
}

/// Whether a room's name can stand before a thing: "kitchen lamp", but "lamp in bedroom 2" and "lamp in lena's room".
fn stands_before(room: &str) -> bool {
    const WORDS_MAX: usize = 3;
    let is_plain = |word: &str| word.chars().all(|c| c.is_ascii_alphabetic()) || word == "children's";
    room.split(' ').count() <= WORDS_MAX && room.split(' ').all(is_plain)
}

/// The rules, as they are written.
#[derive(Default)]
pub(super) struct Rules {
    text: String,
    pub(super) count: usize,
}

impl Rules {
    fn about(&mut self, what: &str) {
        self.text.push_str(&format!("\n# {}\n", comment(what)));
    }

    fn rule(&mut self, domain: &str, object: &str, keys: &[(&str, &str)]) {
        self.count += 1;
        let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
        let topic = quoted(&format!("{BASE_TOPIC}/{domain}/{object}/state"));
        self.text.push_str(&format!("[[rule]]\ntopic = {topic}\n"));
        for (key, value) in keys {
            self.text.push_str(&format!("{key} = {}\n", quoted(value)));
        }
    }

    /// The state of a sensor, by one rule. Objects with very long names are no ids.
    fn report(&mut self, domain: &str, object: &str, kind: SensorKind, keys: &[(&str, &str)]) {
        let (word, id) = (kind.to_string(), format!("{domain}.{object}"));
        if id.len() > SENSOR_ID_BYTES_MAX {
            return;
        }
        self.rule(domain, object, &[&[("sensor", &*word), ("id", &*id)], keys].concat());
        if kind == SensorKind::Appliance {
            self.text.push_str(&format!("above = {IN_USE_W:.1}\n"));
        }
    }

    /// A person is at home, in another zone or in no zone. Each zone is a state.
    pub(super) fn person(&mut self, object: &str, name: &str) {
        self.about(&format!("{name} comes and goes. A zone other than home is away, too."));
        self.report("person", object, SensorKind::Phone, &[("when", "home"), ("person", name)]);
    }

    /// The states of a sensor. `area` is the room's id and its name for a comment. `sees_room` says that no other sensor holds the room's state.
    pub(super) fn sensor(&mut self, placed: &Placed<'_>, area: (&str, &str), phrases: &Phrases, sees_room: bool) {
        let Placed { domain, object, room, sensor, person } = placed;
        let bound = person.map(|person| ("person", person));
        let (id, name) = area;
        // A motor moves a cover. So its state gives sentences only, and no sensor report.
        let device = sensor.device(sees_room).filter(|_| is_room(id) && *domain != "cover");
        let sentences: Vec<(&str, String)> = match sensor.thing.as_deref() {
            Some(seat) if sensor.is_seat() => {
                let says = if seat == "bed" { "get out of" } else { "get up from" };
                vec![("off", format!("They {says} the {}.", phrases.get(seat, *room)))]
            }
            Some(thing) => {
                let phrase = phrases.get(thing, *room);
                // A person may close a way out behind them, and is not in the room then.
                let count = if device == Some(SensorKind::Door) { 1 } else { usize::MAX };
                let verbs = sensor.kind.verbs(domain, thing).into_iter().take(count);
                verbs.map(|(when, verb)| (when, format!("They {verb} the {phrase}."))).collect()
            }
            None => Vec::new(),
        };
        if sentences.is_empty() && device.is_none() {
            return;
        }
        self.about(&format!("{domain}.{object}, in {name}"));
        for (when, say) in &sentences {
            let keys: Vec<(&str, &str)> = [("when", *when), ("say", &**say)].into_iter().chain(bound).collect();
            self.rule(domain, object, &keys);
        }
        if let Some(kind) = device {
            let keys: Vec<(&str, &str)> = [("room", id)].into_iter().chain(bound).collect();
            self.report(domain, object, kind, &keys);
        }
    }

    /// The text of the file. `None` without a rule.
    pub(super) fn into_text(self) -> Option<String> {
        let head = format!(
            "# Rules for `roomcast narrate --mqtt`, made from Home Assistant's registries. Edit them: remove rules that say nothing of people, and\n\
             # change what a sentence says. Home Assistant publishes these topics with\n\
             #\n#   mqtt_statestream:\n#     base_topic: {BASE_TOPIC}\n#\n# in its configuration.yaml. docs/mqtt.md describes every key.\n"
        );
        (self.count > 0).then(|| format!("{head}{}", self.text))
    }
}

/// Whether it is an object's id, as Home Assistant makes them.
pub(super) fn is_object(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// Whether a rule can name a person so: as narration can, and braces are placeholders.
pub(super) fn is_person(name: &str) -> bool {
    check_name(name).is_ok() && name.contains(char::is_alphabetic) && !name.contains(['{', '}'])
}

/// Whether a rule can name a room so.
fn is_room(id: &str) -> bool {
    RoomName::new(id).is_ok() && !id.contains(['{', '}'])
}
