//! A home as Home Assistant's registries describe it: areas become rooms, entities become things, and a rules file says what their states
//! mean.
//!
//! The registries know no geometry, so rooms are boxes of one size side by side, floor above floor, and things stand in rows in them.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use serde::Deserialize;
use serde_json::Value;

use super::{Ids, ImportError, Imported, parse, room_aliases, room_label};
use crate::names::{Names, plain_words};
use crate::narration::{RoomName, check_name};
use crate::semantic_map::schema::{DoorEntry, FORMAT, ItemEntry, RoomEntry, SceneFile, VERSION, check_count, check_id};
use crate::semantic_map::{Box3, MAX_ROOMS, MAX_TEXT_BYTES, SemanticMap};
use crate::text::is_hidden;

const EXPECTED: &str = "a registry of Home Assistant, from the folder `.storage`";
/// Length, width and height of every room, in metres.
const ROOM_M: [f64; 3] = [4.0, 4.0, 2.5];
/// From floor to floor, in metres.
const STOREY_M: f64 = 3.0;
/// Edge of a thing, and from one to the next, in metres.
const THING_M: f64 = 0.3;
const APART_M: f64 = 0.5;
/// The part of topics before domain and object, as `mqtt_statestream` is set up in Home Assistant's own example.
const BASE_TOPIC: &str = "homeassistant";
/// Longest name of a device or an entity that is looked at, in bytes.
const NAME_BYTES_MAX: usize = 1_024;
/// So many of its words are.
const NAME_WORDS_MAX: usize = 16;
/// What things are called by their kind alone.
const KINDS: [&str; 8] = ["lamp", "door", "window", "speaker", "television", "blinds", "fan", "radiator"];
/// More words are a description, and name no thing.
const THING_WORDS_MAX: usize = 4;

/// The texts of the registries.
#[derive(Debug, Clone, Copy, Default)]
pub struct Registries<'a> {
    /// `core.area_registry`.
    pub areas: &'a str,
    /// `core.floor_registry`; older homes have none.
    pub floors: Option<&'a str>,
    /// `core.device_registry`.
    pub devices: Option<&'a str>,
    /// `core.entity_registry`.
    pub entities: Option<&'a str>,
    /// `person`.
    pub persons: Option<&'a str>,
}

/// A home: its map, and rules for `narrate --mqtt`.
#[derive(Debug, Clone, PartialEq)]
pub struct Home {
    /// The map.
    pub imported: Imported,
    /// The text of a rules file; none where nothing in the home says anything.
    pub rules: Option<String>,
    /// The names of its persons.
    pub persons: Vec<String>,
}

#[derive(Deserialize)]
struct Registry<T> {
    data: T,
}

#[derive(Default, Deserialize)]
struct Areas {
    areas: Vec<Area>,
}

#[derive(Deserialize)]
struct Area {
    /// The API has it under another name than the file.
    #[serde(alias = "area_id")]
    id: String,
    name: String,
    #[serde(default)]
    floor_id: Option<String>,
    /// Texts, where there are any.
    #[serde(default)]
    aliases: Value,
}

impl Area {
    fn aliases(&self) -> impl Iterator<Item = &str> {
        self.aliases.as_array().into_iter().flatten().filter_map(Value::as_str)
    }

    /// What is needed of it for each of its entities.
    fn texts(&self) -> AreaTexts {
        let label = room_label(&self.name).unwrap_or_default();
        let mut words = HashSet::new();
        for text in [self.name.as_str(), &self.id, &label].into_iter().chain(self.aliases()) {
            words.extend(Names::bare(text).split(' ').map(str::to_owned));
        }
        AreaTexts { words, comment: comment(&self.name) }
    }
}

/// An area's names, made ready once.
struct AreaTexts {
    /// The words of all of them.
    words: HashSet<String>,
    /// Its name, for a comment.
    comment: String,
}

#[derive(Default, Deserialize)]
struct Floors {
    floors: Vec<Floor>,
}

#[derive(Deserialize)]
struct Floor {
    floor_id: String,
    #[serde(default)]
    level: Option<i64>,
}

#[derive(Default, Deserialize)]
struct Devices {
    devices: Vec<Device>,
}

#[derive(Deserialize)]
struct Device {
    id: String,
    #[serde(default)]
    area_id: Option<String>,
    #[serde(default)]
    name: Option<String>,
    #[serde(default)]
    name_by_user: Option<String>,
}

#[derive(Default, Deserialize)]
struct Entities {
    entities: Vec<Entity>,
}

#[derive(Deserialize)]
struct Entity {
    entity_id: String,
    #[serde(default)]
    area_id: Option<String>,
    #[serde(default)]
    device_id: Option<String>,
    #[serde(default)]
    name: Option<String>,
    #[serde(default)]
    original_name: Option<String>,
    #[serde(default)]
    device_class: Option<String>,
    #[serde(default)]
    original_device_class: Option<String>,
    #[serde(default)]
    disabled_by: Value,
    #[serde(default)]
    hidden_by: Value,
    #[serde(default)]
    entity_category: Value,
    #[serde(default)]
    unique_id: Value,
}

#[derive(Default, Deserialize)]
struct Persons {
    items: Vec<Person>,
}

#[derive(Deserialize)]
struct Person {
    id: String,
    name: String,
}

/// A registry that may be missing; a fault names its file.
fn registry<'a, T: Deserialize<'a> + Default>(file: &str, text: Option<&'a str>) -> Result<T, ImportError> {
    let Some(text) = text else { return Ok(T::default()) };
    let named = |error| match error {
        ImportError::Json { element, message, expected } => {
            let within = if ["?", "."].contains(&&*element) { String::new() } else { format!(": {element}") };
            ImportError::Json { element: format!("{file}{within}"), message, expected }
        }
        other => other,
    };
    parse::<Registry<T>>(text, EXPECTED).map(|registry| registry.data).map_err(named)
}

/// What an entity's states say.
enum Says {
    /// These values, each with its sentence.
    Sentences(Vec<(&'static str, String)>),
    /// Somebody is in its room.
    Somebody,
    /// Nothing that a person does.
    Nothing,
}

impl Entity {
    fn class(&self) -> &str {
        self.device_class.as_deref().or(self.original_device_class.as_deref()).unwrap_or_default()
    }

    /// What it is a state of, in plain words; none where it is of no thing.
    fn thing(
        &self,
        domain: &str,
        object: &str,
        device: Option<&Device>,
        area_words: &HashSet<String>,
    ) -> Option<String> {
        let device = device.and_then(|device| device.name_by_user.as_deref().or(device.name.as_deref()));
        let texts = [self.name.as_deref(), Some(object), device, self.original_name.as_deref()];
        let door = ["door", "opening", "garage_door"].contains(&self.class());
        let kind = match domain {
            "light" => Some("lamp"),
            "binary_sensor" if door => Some("door"),
            "binary_sensor" if self.class() == "window" => Some("window"),
            "media_player" if self.class() == "speaker" => Some("speaker"),
            "media_player" => Some("television"),
            "cover" => Some("blinds"),
            "fan" => Some("fan"),
            "lock" => Some("door"),
            "climate" => Some("radiator"),
            _ => None,
        };
        // Many entities have one device.
        let texts = texts.into_iter().flatten().filter(|text| text.len() <= NAME_BYTES_MAX);
        let found = texts.into_iter().find_map(|text| thing_in(text, area_words, kind));
        found.or_else(|| kind.map(str::to_owned)).filter(|label| label.len() <= MAX_TEXT_BYTES)
    }

    fn says(&self, domain: &str, thing: Option<&str>) -> Says {
        let pair = |on: &'static str, on_says: &str, off: &'static str, off_says: &str| match thing {
            Some(thing) => Says::Sentences(vec![
                (on, format!("They {on_says} the {thing}.")),
                (off, format!("They {off_says} the {thing}.")),
            ]),
            None => Says::Nothing,
        };
        match (domain, self.class()) {
            ("binary_sensor", "motion" | "occupancy" | "presence" | "moving") => Says::Somebody,
            ("binary_sensor", "door" | "opening" | "garage_door" | "window") => pair("on", "open", "off", "close"),
            ("binary_sensor", "running" | "power" | "plug" | "vibration") => match thing {
                Some(thing) => Says::Sentences(vec![("on", format!("They use the {thing}."))]),
                None => Says::Nothing,
            },
            ("light" | "switch" | "fan" | "humidifier", _) => pair("on", "turn on", "off", "turn off"),
            ("cover", _) => pair("open", "open", "closed", "close"),
            ("lock", _) => pair("unlocked", "unlock", "locked", "lock"),
            ("media_player", class) => match thing {
                Some(thing) if class == "speaker" || ["speaker", "radio"].iter().any(|word| thing.contains(word)) => {
                    Says::Sentences(vec![
                        ("playing", format!("They listen to the {thing}.")),
                        ("off", format!("They turn off the {thing}.")),
                    ])
                }
                // Many televisions tell that they are on, and no more.
                Some(thing) => Says::Sentences(vec![
                    ("playing", format!("They watch the {thing}.")),
                    ("on", format!("They turn on the {thing}.")),
                    ("off", format!("They turn off the {thing}.")),
                ]),
                None => Says::Nothing,
            },
            _ => Says::Nothing,
        }
    }
}

/// The thing in a text such as "Fridge door sensor": the words that say neither what is measured nor in which room.
fn thing_in(text: &str, area_words: &HashSet<String>, kind: Option<&str>) -> Option<String> {
    let names = Names::built_in();
    let words = names.entities();
    let bare = Names::bare(text);
    // A number tells one of several from the others, and a Latin letter alone is what is left of an apostrophe or of markup.
    let is_none = |word: &str| word.chars().any(|c| c.is_ascii_digit()) || word.len() < 2;
    let all: Vec<&str> = bare.split(' ').filter(|word| !is_none(word)).take(NAME_WORDS_MAX).collect();
    // The longest run of words that is a thing ("apple tv"); single words have to be more than a word of the room.
    let runs = (2..=all.len().min(THING_WORDS_MAX)).rev().flat_map(|count| all.windows(count));
    if let Some(known) = runs.map(|run| run.join(" ")).find_map(|run| of_kind(names.thing(&run)?, kind)) {
        return Some(known);
    }
    let mut left = Vec::new();
    for word in all {
        if area_words.contains(word) || words.is_measured(word) && names.thing(word).is_none() {
            continue;
        }
        let stem = words.stem(word).filter(|_| names.thing(word).is_none());
        match stem {
            // The kitchen's window is a window.
            Some(stem) if area_words.contains(stem) || is_room_stem(stem) => {}
            _ => left.push(stem.unwrap_or(word)),
        }
    }
    if left.is_empty() {
        return None;
    }
    if let Some(known) = left.iter().find_map(|word| of_kind(names.thing(word)?, kind)) {
        return Some(known);
    }
    let phrase = names.words(&left.join(" "));
    match kind {
        Some(kind @ ("door" | "window")) if left.iter().all(|word| words.is_which(word)) => {
            Some(format!("{phrase} {kind}"))
        }
        _ if left.len() > THING_WORDS_MAX => None,
        // "ceiling" is a ceiling lamp.
        Some("lamp") if !phrase.ends_with("lamp") => Some(format!("{phrase} lamp")),
        _ => Some(phrase),
    }
}

/// A thing that a name means, as an entity of this kind: the lamp at a bed is a bed lamp, and only a door is a front door.
fn of_kind(thing: &str, kind: Option<&str>) -> Option<String> {
    match kind {
        Some("lamp") if thing.ends_with("door") => None,
        Some("lamp") if !thing.ends_with("lamp") => Some(format!("{thing} lamp")),
        kind if thing.ends_with("door") && kind != Some("door") => None,
        _ => Some(thing.to_owned()),
    }
}

/// Whether what is left of a compound is a room: "küchen" of "Küchenfenster", "schlafzimmer" of "Schlafzimmertür".
fn is_room_stem(stem: &str) -> bool {
    let names = Names::built_in();
    names.room(stem).is_some() || stem.strip_suffix(['n', 's']).is_some_and(|stem| names.room(stem).is_some())
}

/// A text for a comment: on one line.
fn comment(text: &str) -> String {
    text.chars().filter(|c| !is_hidden(*c) && !c.is_control()).take(MAX_TEXT_BYTES).collect()
}

fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// Home Assistant's own way from a name to an object's id.
fn slug(name: &str) -> String {
    let bare = Names::bare(name);
    let plain: String = bare.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { ' ' }).collect();
    plain_words(&plain).replace(' ', "_")
}

/// The rules, as they are written.
#[derive(Default)]
struct Rules {
    text: String,
    count: usize,
}

impl Rules {
    fn about(&mut self, what: &str) {
        self.text.push_str(&format!("\n# {}\n", comment(what)));
    }

    fn rule(&mut self, domain: &str, object: &str, keys: &[(&str, &str)]) {
        self.count += 1;
        self.text
            .push_str(&format!("[[rule]]\ntopic = {}\n", quoted(&format!("{BASE_TOPIC}/{domain}/{object}/state"))));
        for (key, value) in keys {
            self.text.push_str(&format!("{key} = {}\n", quoted(value)));
        }
    }

    /// A person is at home, or in another zone, which is a state of its own, or in none.
    fn person(&mut self, object: &str, name: &str) {
        self.about(&format!("{name} comes and goes. A zone other than home is away, too."));
        self.rule("person", object, &[("when", "home"), ("presence", "present"), ("person", name)]);
        self.text.push_str("retained = true\n");
        self.rule("person", object, &[("presence", "away"), ("person", name)]);
        self.text.push_str("unless = [\"home\", \"unknown\", \"unavailable\"]\nretained = true\n");
    }
}

/// Whether it is an object's id, as Home Assistant makes them.
fn is_object(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// Whether a rule can name a person so: as narration can, and braces are placeholders.
fn is_person(name: &str) -> bool {
    check_name(name).is_ok() && name.contains(char::is_alphabetic) && !name.contains(['{', '}'])
}

/// Whether a rule can name a room so.
fn is_room(id: &str) -> bool {
    RoomName::new(id).is_ok() && !id.contains(['{', '}'])
}

/// Whether a registry says so: `disabled_by` and its like are null where they do not.
fn said(value: &Value) -> bool {
    !value.is_null()
}

/// The rooms' boxes, side by side, floor above floor, with doors from each to the next.
fn rooms(
    areas: &[Area],
    floors: &Floors,
    notes: &mut Vec<String>,
) -> (Vec<RoomEntry>, Vec<DoorEntry>, BTreeMap<String, Vec<String>>) {
    let mut order: Vec<(i64, &str)> = floors
        .floors
        .iter()
        .enumerate()
        .map(|(at, floor)| (floor.level.unwrap_or(at as i64), &*floor.floor_id))
        .collect();
    order.sort_unstable();
    // An area without a floor is on the ground, which is rather above a cellar than in it.
    let height = |place: &usize| (order[*place].0.unsigned_abs(), order[*place].0 < 0);
    let ground = (0..order.len()).min_by_key(height).unwrap_or(0);
    let mut place_of: HashMap<&str, usize> = HashMap::new();
    for (place, (_, floor)) in order.iter().enumerate() {
        place_of.entry(floor).or_insert(place);
    }
    let mut storeys: Vec<Vec<&Area>> = vec![Vec::new(); order.len().max(1)];
    for area in areas {
        let own = area.floor_id.as_deref().and_then(|floor| place_of.get(floor).copied());
        storeys[own.unwrap_or(ground)].push(area);
    }
    let (mut rooms, mut doors) = (Vec::new(), Vec::new());
    let mut named = Vec::new();
    let mut below: Option<(String, [f64; 3])> = None;
    for (level, own) in storeys.iter().enumerate() {
        let columns = (own.len() as f64).sqrt().ceil().max(1.0) as usize;
        for (place, area) in own.iter().enumerate() {
            let (column, row) = (place % columns, place / columns);
            let min_m = [column as f64 * ROOM_M[0], row as f64 * ROOM_M[1], level as f64 * STOREY_M];
            let max_m = std::array::from_fn(|axis| min_m[axis] + ROOM_M[axis]);
            let label = room_label(&area.name).unwrap_or_else(|| format!("room {}", rooms.len() + 1));
            named.extend(std::iter::once(&*area.name).chain(area.aliases()).map(|name| (rooms.len(), name.to_owned())));
            rooms.push(RoomEntry::boxed(area.id.clone(), label, Box3 { min_m, max_m }));
            let mut join = |other: &str, position_m: [f64; 3]| {
                let id = format!("assumed-door-{}", doors.len() + 1);
                doors.push(DoorEntry { id, rooms: [other.to_owned(), area.id.clone()], position_m });
            };
            let middle = [min_m[0] + 0.5 * ROOM_M[0], min_m[1] + 0.5 * ROOM_M[1], min_m[2] + 1.0];
            if column > 0 {
                join(&own[place - 1].id, [min_m[0], middle[1], middle[2]]);
            } else if row > 0 {
                join(&own[place - columns].id, [middle[0], min_m[1], middle[2]]);
            } else {
                if let Some((other, at)) = &below {
                    join(other, [at[0], at[1], min_m[2]]);
                }
                below = Some((area.id.clone(), middle));
            }
        }
    }
    let aliases = room_aliases(&rooms, named);
    notes.push(
        "The registries know no geometry: rooms are boxes of 4 x 4 m side by side, and nothing is measured.".to_owned(),
    );
    (rooms, doors, aliases)
}

/// Turns Home Assistant's registries into a scene, and into rules for `narrate --mqtt` by the topics of `mqtt_statestream`.
///
/// Areas become rooms with the areas' ids. Names that the built-in tables know become English. Entities that are disabled, hidden, or for
/// settings and diagnosis are left out, and so are those without an area, but persons.
///
/// # Errors
/// When a text is no registry, there is no area, or the scene breaks a rule of scenes.
pub fn home_assistant(registries: &Registries<'_>, name: &str) -> Result<Home, ImportError> {
    let Areas { areas } = registry("core.area_registry", Some(registries.areas))?;
    if areas.is_empty() {
        let remedy = "make areas in Home Assistant (Settings, Areas) and assign devices to them";
        return Err(ImportError::NoRooms { remedy });
    }
    // Before rooms are made of them: what comes later takes time for each.
    check_count("rooms", areas.len(), MAX_ROOMS)?;
    areas.iter().enumerate().try_for_each(|(index, area)| check_id("rooms", index, &area.id))?;
    let floors: Floors = registry("core.floor_registry", registries.floors)?;
    let Devices { devices } = registry("core.device_registry", registries.devices)?;
    let Entities { entities } = registry("core.entity_registry", registries.entities)?;
    let Persons { items: persons } = registry("person", registries.persons)?;
    let mut notes = Vec::new();
    let (rooms, doors, aliases) = rooms(&areas, &floors, &mut notes);

    let devices: HashMap<&str, &Device> = devices.iter().map(|device| (&*device.id, device)).collect();
    let place_of: HashMap<&str, usize> = areas.iter().enumerate().map(|(place, area)| (&*area.id, place)).collect();
    let box_of: HashMap<&str, Box3> = rooms.iter().filter_map(|room| Some((&*room.id, room.r#box?))).collect();
    let (mut ids, mut items, mut rules) = (Ids::default(), Vec::new(), Rules::default());
    let texts: Vec<AreaTexts> = areas.iter().map(Area::texts).collect();
    let mut things: HashSet<(usize, String)> = HashSet::new();
    let mut count_in: HashMap<usize, usize> = HashMap::new();
    let mut homeless = 0;
    for entity in &entities {
        let Some((domain, object)) = entity.entity_id.split_once('.') else { continue };
        let quiet = said(&entity.disabled_by) || said(&entity.hidden_by) || said(&entity.entity_category);
        if quiet || ["person", "device_tracker", "vacuum"].contains(&domain) || !is_object(object) {
            continue;
        }
        let power = domain == "sensor" && ["power", "energy"].contains(&entity.class());
        let of_people =
            ["binary_sensor", "light", "switch", "media_player", "cover", "fan", "lock", "humidifier", "climate"];
        if !power && !of_people.contains(&domain) {
            continue;
        }
        let device = entity.device_id.as_deref().and_then(|id| devices.get(id).copied());
        let area = entity.area_id.as_deref().or(device.and_then(|device| device.area_id.as_deref()));
        let Some(place) = area.and_then(|area| place_of.get(area).copied()) else {
            homeless += 1;
            continue;
        };
        let (area, texts) = (&areas[place], &texts[place]);
        let says_somebody = matches!(entity.says(domain, None), Says::Somebody);
        let thing = if says_somebody { None } else { entity.thing(domain, object, device, &texts.words) };
        if let Some(label) = thing.clone().filter(|label| label.to_lowercase() == *label)
            && !things.contains(&(place, label.clone()))
            && let Some(bounds) = box_of.get(&*area.id)
        {
            let number = count_in.entry(place).or_default();
            let per_row = ((ROOM_M[0] - APART_M) / APART_M) as usize;
            let (column, row) = (*number % per_row, (*number / per_row) % per_row);
            *number += 1;
            let min_m = [
                bounds.min_m[0] + APART_M + column as f64 * APART_M,
                bounds.min_m[1] + APART_M + row as f64 * APART_M,
                bounds.min_m[2],
            ];
            let own = Box3 { min_m, max_m: min_m.map(|metres| metres + THING_M) };
            things.insert((place, label.clone()));
            items.push(ItemEntry {
                id: ids.take(&label),
                label,
                captions: Vec::new(),
                position_m: own.centre_m(),
                r#box: own,
            });
        }
        match entity.says(domain, thing.as_deref()) {
            Says::Nothing => {}
            Says::Somebody if !is_room(&area.id) => {}
            Says::Somebody => {
                rules.about(&format!("{}, in {}", entity.entity_id, texts.comment));
                rules.rule(domain, object, &[("when", "on"), ("presence", "present"), ("room", &area.id)]);
            }
            Says::Sentences(sentences) => {
                rules.about(&format!("{}, in {}", entity.entity_id, texts.comment));
                for (when, say) in &sentences {
                    rules.rule(domain, object, &[("when", when), ("say", say)]);
                }
            }
        }
    }
    // Persons of the page of persons, then those of configuration.yaml, which the registry of entities alone knows.
    let of_registry = |entity: &'_ Entity| entity.entity_id.strip_prefix("person.").map(str::to_owned);
    let mut registered: HashMap<&str, &Entity> = HashMap::new();
    for entity in &entities {
        if let Some(id) = entity.unique_id.as_str() {
            registered.entry(id).or_insert(entity);
        }
    }
    let mut people: Vec<(String, String)> = Vec::new();
    for person in &persons {
        let registered = registered.get(&*person.id).copied();
        let object = registered.and_then(of_registry).unwrap_or_else(|| slug(&person.name));
        people.push((object, comment(&person.name).trim().to_owned()));
    }
    let mut known: HashSet<String> = people.iter().map(|(object, _)| object.clone()).collect();
    for entity in &entities {
        let Some(object) = of_registry(entity).filter(|object| known.insert(object.clone())) else { continue };
        let name = entity.name.as_deref().or(entity.original_name.as_deref()).unwrap_or(&object);
        let name = comment(name).trim().to_owned();
        people.push((object, name));
    }
    people.retain(|(object, _)| is_object(object));
    let (people, nameless): (Vec<_>, Vec<_>) = people.into_iter().partition(|(_, name)| is_person(name));
    for (object, name) in &people {
        rules.person(object, name);
    }
    let english = Names::built_in().english();
    let is_english = |label: &&str| label.split(' ').all(|word| english.contains(word) || KINDS.contains(&word));
    let labels: BTreeSet<&str> = items.iter().map(|item| &*item.label).collect();
    let (unknown, foreign): (Vec<&str>, Vec<&str>) =
        labels.into_iter().filter(|label| !is_english(label)).partition(|label| label.is_ascii());
    let quoted = |labels: &[&str]| labels.iter().map(|label| format!("\"{label}\"")).collect::<Vec<_>>().join(", ");
    if !foreign.is_empty() {
        notes.push(format!(
            "No English is known for {}: write it into the map and into the rules, for the model reads English.",
            quoted(&foreign)
        ));
    }
    if !unknown.is_empty() {
        notes.push(format!(
            "Not known to be English: {}. Where it is none, write English into the map and into the rules, for the model reads that.",
            quoted(&unknown)
        ));
    }
    if !nameless.is_empty() {
        let names: Vec<&str> = nameless.iter().map(|(_, name)| &**name).collect();
        notes.push(format!(
            "Left out the persons {}, whom no sentence can name so: give them other names in Home Assistant and import again.",
            quoted(&names)
        ));
    }
    if homeless > 0 {
        notes.push(format!(
            "Left out {homeless} entities without an area; assign them in Home Assistant and import again."
        ));
    }
    notes.push(format!(
        "{} things of {} entities, {} persons, {} rules.",
        items.len(),
        entities.len(),
        people.len(),
        rules.count
    ));

    let file = SceneFile {
        format: FORMAT.to_owned(),
        version: VERSION,
        name: name.to_owned(),
        description: "Rooms are boxes of one size side by side, and things stand in rows in them: nothing is measured."
            .to_owned(),
        source: "Home Assistant registries, imported".to_owned(),
        rooms,
        parts: Vec::new(),
        groups: Vec::new(),
        doors,
        aliases,
        items,
    };
    let head = format!(
        "# Rules for `roomcast narrate --mqtt`, made from Home Assistant's registries. Edit them: leave out what says nothing of people, and\n\
         # change what a sentence says. Home Assistant publishes these topics with\n\
         #\n#   mqtt_statestream:\n#     base_topic: {BASE_TOPIC}\n#\n# in its configuration.yaml. docs/mqtt.md describes every key.\n"
    );
    let rules = (rules.count > 0).then(|| format!("{head}{}", rules.text));
    let persons = people.into_iter().map(|(_, name)| name).collect();
    Ok(Home { imported: Imported { map: SemanticMap::check(file)?, notes, boxed: Vec::new() }, rules, persons })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{Grounding, GroundingOptions};
    use proptest::prelude::*;

    const AREAS: &str = r#"{"version": 1, "minor_version": 6, "key": "core.area_registry", "data": {"areas": [
        {"aliases": ["Kochecke"], "floor_id": "ground", "icon": null, "id": "kuche", "labels": [], "name": "Küche", "picture": null},
        {"aliases": [], "id": "living_room", "name": "Living Room", "picture": null},
        {"aliases": [], "floor_id": "first", "id": "bedroom", "name": "Bedroom", "picture": null}]}}"#;
    const FLOORS: &str = r#"{"data": {"floors": [{"floor_id": "first", "name": "First", "level": 1, "aliases": []},
        {"floor_id": "ground", "name": "Ground", "level": 0, "aliases": []}]}}"#;
    const DEVICES: &str = r#"{"data": {"devices": [{"id": "d1", "area_id": "kuche", "name": "Aqara MCCGQ11LM", "name_by_user": "Kühlschranktür"},
        {"id": "d2", "area_id": "bedroom", "name": "Hue motion sensor", "name_by_user": null}], "deleted_devices": []}}"#;
    const ENTITIES: &str = r#"{"data": {"entities": [
        {"entity_id": "binary_sensor.fridge_door", "area_id": "kuche", "device_id": null, "original_device_class": "door", "disabled_by": null, "unique_id": "1"},
        {"entity_id": "binary_sensor.0x00158d", "area_id": null, "device_id": "d1", "original_device_class": "opening", "unique_id": "2"},
        {"entity_id": "switch.kuche_coffee_maker", "area_id": "kuche", "name": null, "unique_id": "3"},
        {"entity_id": "light.living_room_ceiling", "area_id": "living_room", "unique_id": "4"},
        {"entity_id": "media_player.wohnzimmer_tv", "area_id": "living_room", "device_class": "tv", "unique_id": "5"},
        {"entity_id": "binary_sensor.hue_motion", "device_id": "d2", "original_device_class": "motion", "unique_id": "6"},
        {"entity_id": "binary_sensor.front_door", "area_id": "living_room", "device_class": "door", "unique_id": "7"},
        {"entity_id": "sensor.washer_power", "area_id": "bedroom", "original_device_class": "power", "unique_id": "8"},
        {"entity_id": "sensor.outdoor_temperature", "area_id": "bedroom", "original_device_class": "temperature", "unique_id": "9"},
        {"entity_id": "light.attic", "unique_id": "10"},
        {"entity_id": "light.off", "area_id": "kuche", "disabled_by": "user", "unique_id": "11"},
        {"entity_id": "switch.kuche_led", "area_id": "kuche", "entity_category": "config", "unique_id": "12"},
        {"entity_id": "person.grace", "unique_id": "p-2", "platform": "person"},
        {"entity_id": "person.joan", "unique_id": "yaml", "original_name": "Joan Clarke", "platform": "person"}], "deleted_entities": []}}"#;
    const PERSONS: &str = r#"{"data": {"items": [{"id": "p-1", "name": "Ada Lovelace", "device_trackers": []}, {"id": "p-2", "name": "Grace \"Amazing\" Hopper"}]}}"#;

    fn registries() -> Registries<'static> {
        Registries {
            areas: AREAS,
            floors: Some(FLOORS),
            devices: Some(DEVICES),
            entities: Some(ENTITIES),
            persons: Some(PERSONS),
        }
    }

    /// The rules named a person "Me" and could not be read, so that there was no home at all.
    #[test]
    fn a_person_whom_no_sentence_can_name_is_left_out_and_told_of() {
        let long = "a".repeat(100);
        for name in ["Me", "nobody", "Who", "We", "They", "You", "Everyone", "12", "!", "{value}", &long] {
            let persons = format!(
                r#"{{"data": {{"items": [{{"id": "p-1", "name": "Ada"}}, {{"id": "p-2", "name": "{name}"}}, {{"id": "p-3", "name": "Me Too"}}]}}}}"#
            );
            let registries = Registries { entities: None, persons: Some(&persons), ..registries() };
            let home = home_assistant(&registries, "home").unwrap();
            assert_eq!(home.persons, ["Ada", "Me Too"], "{name}");
            let rules: toml::Table = toml::from_str(&home.rules.unwrap()).unwrap();
            for rule in rules["rule"].as_array().unwrap() {
                check_name(rule["person"].as_str().unwrap()).unwrap();
            }
            let says =
                |note: &String| note.starts_with("Left out the persons") && note.contains(&format!("\"{name}\""));
            assert!(name == "!" || home.imported.notes.iter().any(says), "{name}: {:?}", home.imported.notes);
        }
    }

    #[test]
    fn a_home_describes_itself() {
        let home = home_assistant(&registries(), "home").unwrap();
        let map = &home.imported.map;
        let rooms: Vec<_> =
            map.rooms.iter().map(|room| (&*room.id, &*room.label, room.space.bounds.min_m[2])).collect();
        assert_eq!(
            rooms,
            [("kuche", "kitchen", 0.0), ("living_room", "living room", 0.0), ("bedroom", "bedroom", 3.0)]
        );
        assert_eq!(map.find_room("Kochecke"), map.find_room("kuche"));
        assert_eq!(
            map.path(crate::semantic_map::RoomId(1), crate::semantic_map::RoomId(2)).map(|path| path.len()),
            Some(3)
        );
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        let things: Vec<_> = map
            .items
            .iter()
            .zip(grounding.item_partition())
            .map(|(item, room)| (map.labels[item.label.0 as usize].as_str(), room.unwrap().0))
            .collect();
        let expected = [
            ("fridge", 0),
            ("coffee maker", 0),
            ("ceiling lamp", 1),
            ("television", 1),
            ("front door", 1),
            ("washing machine", 2),
        ];
        assert_eq!(things, expected);
        assert!(
            home.imported.notes.iter().any(|note| note.contains("1 entities without an area")),
            "{:?}",
            home.imported.notes
        );
        assert!(map.description.contains("nothing is measured"));
    }

    #[test]
    fn rules_say_what_states_mean() {
        let rules = home_assistant(&registries(), "home").unwrap().rules.unwrap();
        let file: toml::Table = rules.parse().unwrap();
        let list = file["rule"].as_array().unwrap();
        let of = |topic: &str| -> Vec<String> {
            let own = list.iter().filter(|rule| rule["topic"].as_str() == Some(topic));
            own.map(|rule| {
                let text = |key: &str| rule.get(key).and_then(toml::Value::as_str).unwrap_or("-").to_owned();
                ["when", "say", "presence", "room", "person"].map(text).join("|")
            })
            .collect()
        };
        assert_eq!(
            of("homeassistant/binary_sensor/fridge_door/state"),
            ["on|They open the fridge.|-|-|-", "off|They close the fridge.|-|-|-"]
        );
        assert_eq!(of("homeassistant/binary_sensor/0x00158d/state").len(), 2, "by its device's name");
        assert_eq!(of("homeassistant/binary_sensor/hue_motion/state"), ["on|-|present|bedroom|-"]);
        assert_eq!(of("homeassistant/media_player/wohnzimmer_tv/state")[0], "playing|They watch the television.|-|-|-");
        assert_eq!(of("homeassistant/person/ada_lovelace/state")[1], "-|-|away|-|Ada Lovelace");
        assert_eq!(of("homeassistant/person/grace/state")[0], "home|-|present|-|Grace \"Amazing\" Hopper");
        assert_eq!(of("homeassistant/person/joan/state")[0], "home|-|present|-|Joan Clarke");
        assert!(!rules.contains("light.off") && !rules.contains("kuche_led") && !rules.contains("washer_power"));
    }

    /// What newer ones write: floors and labels, aliases that are no text, areas without a floor, a floor without a level, rooms of one kind.
    #[test]
    fn registries_of_newer_homes_are_read() {
        let areas = r#"{"version": 1, "minor_version": 9, "key": "core.area_registry", "data": {"areas": [
            {"aliases": ["Lenas Reich"], "floor_id": "og", "humidity_entity_id": null, "icon": "mdi:bed", "id": "kinderzimmer_lena", "labels": ["kids"],
             "name": "Kinderzimmer Lena", "picture": null, "temperature_entity_id": null, "created_at": "2025-01-01T00:00:00+00:00", "modified_at": "2025-01-01T00:00:00+00:00"},
            {"aliases": [null], "floor_id": "og", "id": "kinderzimmer_tom", "labels": [], "name": "Kinderzimmer Tom"},
            {"aliases": null, "floor_id": null, "id": "wohn_esszimmer", "name": "🛋 Wohn-/Esszimmer"},
            {"floor_id": "gone", "id": "bad", "name": "Bad "},
            {"floor_id": "keller", "id": "hobbyraum", "name": "Hobbyraum"}]}}"#;
        let floors = r#"{"version": 1, "minor_version": 2, "data": {"floors": [
            {"aliases": [], "floor_id": "og", "icon": null, "level": 1, "name": "Obergeschoss"},
            {"aliases": [], "floor_id": "eg", "icon": null, "level": null, "name": "Erdgeschoss"},
            {"aliases": [], "floor_id": "keller", "icon": null, "level": -1, "name": "Keller"}]}}"#;
        let devices = r#"{"version": 1, "minor_version": 11, "data": {"devices": [
            {"id": "d1", "area_id": "kinderzimmer_tom", "name": "Bewegungsmelder Tom", "name_by_user": null, "labels": [], "primary_config_entry": "x",
             "config_entries_subentries": {"x": [null]}, "disabled_by": null, "entry_type": null, "model_id": "E2134"}], "deleted_devices": []}}"#;
        let entities = r#"{"version": 1, "minor_version": 18, "data": {"entities": [
            {"aliases": [], "area_id": null, "categories": {}, "device_id": "d1", "entity_id": "binary_sensor.bewegungsmelder_tom_belegung",
             "has_entity_name": true, "labels": [], "name": null, "original_name": "Belegung", "original_device_class": "occupancy", "disabled_by": null,
             "hidden_by": null, "entity_category": null, "unique_id": 12, "options": {"conversation": {"should_expose": true}}},
            {"area_id": "bad", "device_id": null, "entity_id": "light.bad_spiegel", "name": "Spiegel", "hidden_by": null, "unique_id": "2"},
            {"area_id": "bad", "device_id": null, "entity_id": "binary_sensor.f", "name": "Fenster", "device_class": "window", "unique_id": "8"},
            {"area_id": "bad", "device_id": null, "entity_id": "light.bad_alle", "name": "Alle", "hidden_by": "integration", "unique_id": "3"},
            {"area_id": "wohn_esszimmer", "device_id": null, "entity_id": "media_player.lg_webos_tv", "unique_id": "4"},
            {"area_id": "wohn_esszimmer", "device_id": null, "entity_id": "cover.rollo_links", "unique_id": "5"},
            {"area_id": "hobbyraum", "device_id": null, "entity_id": "switch.kompressor_saege", "name": "Компрессор", "unique_id": "6"},
            {"area_id": "bad", "device_id": null, "entity_id": "event.bad_taster", "unique_id": "7"}], "deleted_entities": [{"entity_id": "light.was"}]}}"#;
        let persons = r#"{"version": 2, "data": {"items": [{"id": "a", "name": "Łukasz", "device_trackers": ["device_tracker.phone"], "picture": null, "user_id": null}]}}"#;
        let registries = Registries {
            areas,
            floors: Some(floors),
            devices: Some(devices),
            entities: Some(entities),
            persons: Some(persons),
        };
        let home = home_assistant(&registries, "home").unwrap();
        let map = &home.imported.map;
        let rooms: Vec<_> =
            map.rooms.iter().map(|room| (&*room.id, &*room.label, room.space.bounds.min_m[2])).collect();
        assert_eq!(
            rooms,
            [
                ("hobbyraum", "living room", 0.0),
                ("wohn_esszimmer", "living room", 3.0),
                ("bad", "bathroom", 3.0),
                ("kinderzimmer_lena", "children's bedroom", 6.0),
                ("kinderzimmer_tom", "children's bedroom", 6.0),
            ]
        );
        // Each of two rooms of one kind by its own names.
        for (name, room) in [
            ("Kinderzimmer Lena", Some("kinderzimmer_lena")),
            ("lenas reich", Some("kinderzimmer_lena")),
            ("Kinderzimmer Tom", Some("kinderzimmer_tom")),
            ("Bad", Some("bad")),
            ("Badezimmer", Some("bad")),
            ("Kinderzimmer", None),
        ] {
            let found = map.find_room(name).map(|room| map.rooms[room.0 as usize].id.as_str());
            assert_eq!(found, room, "{name}");
        }
        let things: Vec<_> = map.items.iter().map(|item| map.labels[item.label.0 as usize].as_str()).collect();
        assert_eq!(things, ["spiegel lamp", "window", "television", "blinds", "компрессор"]);
        assert!(home.imported.notes.iter().any(|note| note.starts_with("No English is known for \"компрессор\"")));
        let unknown = "Not known to be English: \"spiegel lamp\". Where";
        assert!(home.imported.notes.iter().any(|note| note.starts_with(unknown)), "{:?}", home.imported.notes);
        let rules = home.rules.unwrap();
        for part in [
            "room = \"kinderzimmer_tom\"",
            "They watch the television.",
            "They turn on the television.",
            "topic = \"homeassistant/person/lukasz/state\"",
            "unless = [\"home\", \"unknown\", \"unavailable\"]",
            "person = \"Łukasz\"",
        ] {
            assert!(rules.contains(part), "{part} in {rules}");
        }
        assert!(!rules.contains("bad_alle") && !rules.contains("taster"), "{rules}");
        assert_eq!(home.persons, ["Łukasz"]);
        let furnished = home.imported.furnished().unwrap();
        assert!(furnished.map.find_label("bed").is_some() && furnished.map.find_label("toy").is_some());
    }

    #[test]
    fn things_are_named_in_plain_words() {
        let area_words: HashSet<String> = ["kuche", "kitchen"].map(str::to_owned).into();
        for (text, kind, expected) in [
            ("fridge_door", Some("door"), Some("fridge")),
            ("Kühlschranktür", Some("door"), Some("fridge")),
            ("kitchen_ceiling", Some("lamp"), Some("ceiling lamp")),
            ("front_door", Some("door"), Some("front door")),
            ("kitchen motion", None, None),
            ("0x00158d0001", Some("door"), None),
            ("Coffee maker plug 2", None, Some("coffee maker")),
            ("Waschmaschine Leistung", None, Some("washing machine")),
            ("Wohnzimmer Licht Decke", Some("lamp"), Some("ceiling lamp")),
            ("Kitchen Rollo", Some("blinds"), Some("blinds")),
            ("Küchenfenster links", Some("window"), None),
            ("Schlafzimmertür", Some("door"), None),
            ("Haustür", Some("door"), Some("front door")),
            ("Haus Licht", Some("lamp"), Some("haus lamp")),
            ("TV Hintergrundlicht", Some("lamp"), Some("television lamp")),
            ("Porte frigo", Some("door"), Some("fridge")),
            ("Fenêtre de la cuisine gauche", Some("window"), Some("cuisine")),
            ("Lumière plafond", Some("lamp"), Some("ceiling lamp")),
            ("Puerta de la nevera", Some("door"), Some("fridge")),
            ("Enchufe lavadora", None, Some("washing machine")),
            ("Koelkast deur", Some("door"), Some("fridge")),
            ("Czujnik otwarcia lodówka", Some("door"), Some("fridge")),
            ("Aqara MCCGQ11LM Door", Some("door"), None),
            ("Hue color lamp 2", Some("lamp"), Some("color lamp")),
            ("Nest Mini", Some("speaker"), Some("speaker")),
            ("Living Room Apple TV", Some("television"), Some("television")),
            ("Холодильник", Some("door"), Some("fridge")),
            ("LED Strip TV Board", Some("lamp"), Some("television lamp")),
            ("LED strip bookshelf board", Some("lamp"), Some("led strip bookshelf board lamp")),
            ("LED strip behind bookshelf board", Some("lamp"), None),
            ("<b>LED-Stripe \"42\"</b>", Some("lamp"), Some("led stripe lamp")),
            ("f", Some("window"), None),
            ("灯", None, Some("灯")),
        ] {
            assert_eq!(thing_in(text, &area_words, kind).as_deref(), expected, "{text}");
        }
    }

    /// Rows "floors times areas" and "entities times aliases" of the attacks: what is too much is refused before rooms are made of it, and
    /// what is not is looked at once.
    #[test]
    fn large_registries_are_refused_or_read_once() {
        let area = |index: usize, aliases: usize| {
            let aliases: Vec<String> = (0..aliases).map(|alias| format!("alias {index} {alias}")).collect();
            serde_json::json!({"id": format!("a{index}"), "name": format!("room {index}"), "floor_id": "f63", "aliases": aliases})
        };
        let areas = |count: usize, aliases: usize| {
            let list: Vec<Value> = (0..count).map(|index| area(index, aliases)).collect();
            serde_json::json!({"data": {"areas": list}}).to_string()
        };
        let read = |areas: &str, floors: &str, entities: &str| {
            let registries =
                Registries { areas, floors: Some(floors), entities: Some(entities), ..Registries::default() };
            home_assistant(&registries, "x")
        };
        // The registry of floors is none: it is not even read.
        let error = read(&areas(65, 0), "no registry", "").unwrap_err().to_string();
        assert!(error.contains("65 entries, more than 64"), "{error}");
        let long = areas(1, 0).replace("\"a0\"", &format!("\"{}\"", "a".repeat(129)));
        let error = read(&long, "no registry", "").unwrap_err().to_string();
        assert!(error.contains("`id`: is 129 bytes long"), "{error}");

        let floor = |index: usize| serde_json::json!({"floor_id": format!("f{index}"), "level": index});
        let floors = serde_json::json!({"data": {"floors": (0..64).map(floor).collect::<Vec<_>>()}}).to_string();
        let entity = |index: usize| serde_json::json!({"entity_id": format!("light.alias_{index}_lamp"), "area_id": "a0", "unique_id": index.to_string()});
        let entities: Vec<Value> = (0..20_000).map(entity).collect();
        let entities = serde_json::json!({"data": {"entities": entities}}).to_string();
        let home = read(&areas(1, 20_000), &floors, &entities).unwrap();
        assert_eq!(home.imported.map.items.len(), 1, "all of them are the lamp of the room");
        assert_eq!(home.imported.map.aliases.values().map(Vec::len).sum::<usize>(), 1_000);
        let long = "fridge ".repeat(200);
        let named = entities.replace("light.alias_0_lamp", "switch.x1").replacen(
            "\"area_id\"",
            &format!("\"name\": \"{long}\", \"area_id\""),
            1,
        );
        let home = read(&areas(1, 0), &floors, &named).unwrap();
        assert!(home.imported.map.find_label("fridge").is_none(), "a name as long as that names nothing");
    }

    #[test]
    fn what_is_no_home_is_refused() {
        let message =
            |areas: &str| home_assistant(&Registries { areas, ..Registries::default() }, "x").unwrap_err().to_string();
        assert!(message("{}").contains("expected a registry of Home Assistant"));
        assert!(message("{").starts_with("core.area_registry: "), "{}", message("{"));
        assert!(message(r#"{"data": {"areas": []}}"#).contains("make areas in Home Assistant"));
        assert!(
            message(r#"{"data": {"areas": [{"id": "a", "name": "A"}, {"id": "a", "name": "B"}]}}"#)
                .contains("is used twice")
        );
        let bare = home_assistant(&Registries { areas: AREAS, ..Registries::default() }, "x").unwrap();
        assert_eq!((bare.rules, bare.imported.map.items.len()), (None, 0));
        assert!(bare.imported.furnished().unwrap().map.items.len() > 10);
    }

    proptest! {
        #[test]
        fn hostile_texts_never_panic(which in 0..5usize, cut in 0..3000usize, noise in "\\PC{0,8}") {
            let mut texts = [AREAS, FLOORS, DEVICES, ENTITIES, PERSONS].map(str::to_owned);
            let cut = (0..=cut.min(texts[which].len())).rev().find(|cut| texts[which].is_char_boundary(*cut)).unwrap_or(0);
            texts[which].insert_str(cut, &noise);
            let [areas, floors, devices, entities, persons] = &texts;
            let registries = Registries { areas, floors: Some(floors), devices: Some(devices), entities: Some(entities), persons: Some(persons) };
            let _ = home_assistant(&registries, "x");
        }
    }
}
