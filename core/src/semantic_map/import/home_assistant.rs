//! A home as Home Assistant's registries describe it: areas become rooms, entities become things, and a rules file says what their states
//! mean.
//!
//! In three steps: `registry` parses, `thing` and `plan` normalise, `rules` and this file build. The registries know no geometry, so rooms are
//! boxes of one size side by side, floor above floor, and things stand in rows in them.

use std::collections::{BTreeMap, HashMap, HashSet};

use super::{Ids, ImportError, Imported};
use crate::names::{Names, plain_words};
use crate::semantic_map::checks::{check_count, check_id};
use crate::semantic_map::schema::{ItemEntry, RoomEntry, SceneFile};
use crate::semantic_map::{Box3, MAX_ROOMS, MAX_TEXT_BYTES};
use crate::text::is_hidden;

mod plan;
mod registry;
mod rules;
#[cfg(test)]
mod tests;
mod thing;

use plan::{ROOM_M, plan};
use registry::{Area, AreaTexts, Areas, Device, Devices, Entities, Entity, Floors, Person, Persons, registry};
use rules::{Phrases, Placed, Rules, is_object, is_person};
use thing::{FirstNames, Kind, NoSensor, Sensor};

/// Edge of a thing, and from one to the next, in metres.
const THING_M: f64 = 0.3;
const APART_M: f64 = 0.5;
/// A note has at most so many names.
const NAMES_IN_NOTE: usize = 8;

/// The texts of the registries, and how to read them.
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
    /// Areas that become no rooms, each by its id, its name or an alias.
    pub leave_out: &'a [String],
    /// Names of residents, for sensors that have a person's name and are not of a person in `persons`.
    pub residents: &'a [String],
    /// Whether rooms get the usual furniture later: sentences then name the room of each thing that another room usually has.
    pub furnished: bool,
}

/// A home: its map, and rules for `narrate --mqtt`.
#[derive(Debug, Clone, PartialEq)]
pub struct Home {
    /// The map.
    pub imported: Imported,
    /// The text of a rules file. `None` if no entity says anything.
    pub rules: Option<String>,
    /// The names of its persons.
    pub persons: Vec<String>,
    /// For each vacuum, by its entity's id, the segments of its rooms.
    pub segments: BTreeMap<String, BTreeMap<String, String>>,
}

/// A text for a comment: on one line.
fn comment(text: &str) -> String {
    text.chars().filter(|c| !is_hidden(*c) && !c.is_control()).take(MAX_TEXT_BYTES).collect()
}

/// Home Assistant's own way from a name to an object's id.
fn slug(name: &str) -> String {
    let bare = Names::bare(name);
    let plain: String = bare.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { ' ' }).collect();
    plain_words(&plain).replace(' ', "_")
}

fn quoted(names: &[&str]) -> String {
    names.iter().map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(", ")
}

/// Turns Home Assistant's registries into a scene, and into rules for `narrate --mqtt` by the topics of `mqtt_statestream`.
///
/// Areas become rooms with the areas' ids. Domain and device class give a thing, and names that the built-in tables know make it more exact.
/// Entities that are disabled, hidden, or for configuration and diagnosis are left out, and so are entities without an area, except persons.
///
/// # Errors
/// When a text is no registry, there is no area, an area to leave out is not there, or the scene breaks a rule of scenes.
pub fn home_assistant(registries: &Registries<'_>, name: &str) -> Result<Home, ImportError> {
    let Areas { areas } = registry("core.area_registry", Some(registries.areas))?;
    let mut notes = Vec::new();
    let (areas, left_out) = kept(areas, registries.leave_out, &mut notes)?;
    // Before rooms are made of them: each area costs time in what follows.
    check_count("rooms", areas.len(), MAX_ROOMS)?;
    areas.iter().enumerate().try_for_each(|(index, area)| check_id("rooms", index, &area.id))?;
    let floors: Floors = registry("core.floor_registry", registries.floors)?;
    let Devices { devices } = registry("core.device_registry", registries.devices)?;
    let Entities { entities } = registry("core.entity_registry", registries.entities)?;
    let Persons { items: persons } = registry("person", registries.persons)?;
    let plan = plan(&areas, &floors, &mut notes);

    let people = people(&entities, &persons, &mut notes);
    let places = Places::new(&areas, &plan.rooms, &left_out);
    let names: Vec<&str> =
        people.iter().map(|(_, name)| &**name).chain(registries.residents.iter().map(|name| &**name)).collect();
    let sensors = sensors(&entities, &devices, &places, &names, &mut notes);
    let items = items(&sensors, &plan.rooms);
    let mut rules = Rules::default();
    let one_occupancy = with_one_occupancy(&sensors);
    let phrases = Phrases::of(&sensors, &plan.rooms, &plan::spoken(&plan.rooms, &areas), registries.furnished);
    for placed in &sensors {
        let area = (plan.rooms[placed.room].id.as_str(), places.texts[placed.room].comment.as_str());
        rules.sensor(placed, area, &phrases, one_occupancy.contains(&placed.room));
    }
    for (object, name) in &people {
        rules.person(object, name);
    }
    let with_things: HashSet<&str> = (sensors.iter())
        .filter(|placed| !placed.sensor.kind.is_meter())
        .map(|placed| plan.rooms[placed.room].id.as_str())
        .collect();
    let has_things: Vec<bool> = areas.iter().map(|area| with_things.contains(&*area.id)).collect();
    notes.extend(plan::no_rooms(&areas, &has_things));
    notes.push(format!(
        "{} things of {} entities, {} persons, {} rules.",
        items.len(),
        entities.len(),
        people.len(),
        rules.count
    ));

    let file = SceneFile {
        description: "Rooms are boxes of one size side by side, and things stand in rows in them: nothing is measured."
            .to_owned(),
        doors: plan.doors,
        aliases: plan.aliases,
        ..SceneFile::new(name, "Home Assistant registries, imported", plan.rooms, items)
    };
    let rooms: HashSet<&str> = areas.iter().map(|area| &*area.id).collect();
    let mut segments: BTreeMap<String, BTreeMap<String, String>> = BTreeMap::new();
    for entity in entities.iter().filter(|entity| entity.entity_id.starts_with("vacuum.")) {
        for (area, segment) in entity.segments().filter(|(area, _)| rooms.contains(area)) {
            segments.entry(entity.entity_id.clone()).or_default().insert(area.to_owned(), comment(segment));
        }
    }
    let persons = people.into_iter().map(|(_, name)| name).collect();
    let imported = Imported::new(file, notes, Vec::new())?;
    Ok(Home { imported, rules: rules.into_text(), persons, segments })
}

/// The areas that become rooms, and the ids of the areas that do not.
fn kept(
    areas: Vec<Area>,
    leave_out: &[String],
    notes: &mut Vec<String>,
) -> Result<(Vec<Area>, HashSet<String>), ImportError> {
    const NO_AREA: &str = "make areas in Home Assistant (Settings, Areas) and assign devices to them";
    const NONE_LEFT: &str = "every area is left out: leave out fewer";
    if areas.is_empty() {
        return Err(ImportError::NoRooms { remedy: NO_AREA });
    }
    let is_called = |area: &Area, name: &str| {
        let is_it = |own: &str| own == name || Names::bare(own) == Names::bare(name);
        [&*area.id, &*area.name].into_iter().chain(area.aliases()).any(is_it)
    };
    for name in leave_out {
        if !areas.iter().any(|area| is_called(area, name)) {
            let there = areas.iter().map(|area| comment(area.name.trim())).collect();
            return Err(ImportError::NoArea { unknown: name.clone(), there });
        }
    }
    let is_kept = |area: &Area| !leave_out.iter().any(|name| is_called(area, name));
    let (kept, left): (Vec<Area>, Vec<Area>) = areas.into_iter().partition(is_kept);
    if kept.is_empty() {
        return Err(ImportError::NoRooms { remedy: NONE_LEFT });
    }
    if !left.is_empty() {
        let names: Vec<String> = left.iter().map(|area| comment(area.name.trim())).collect();
        notes.push(format!("Areas left out: {}.", names.join(", ")));
    }
    Ok((kept, left.into_iter().map(|area| area.id).collect()))
}

/// Where entities are.
struct Places<'a> {
    /// The room of an area's id, as an index of the plan's rooms.
    room_of: HashMap<&'a str, usize>,
    /// The names of each room's area.
    texts: Vec<AreaTexts>,
    left_out: &'a HashSet<String>,
}

impl<'a> Places<'a> {
    fn new(areas: &'a [Area], rooms: &'a [RoomEntry], left_out: &'a HashSet<String>) -> Self {
        let area_of: HashMap<&str, &Area> = areas.iter().map(|area| (&*area.id, area)).collect();
        let room_of = rooms.iter().enumerate().map(|(place, room)| (&*room.id, place)).collect();
        let texts = rooms.iter().filter_map(|room| area_of.get(&*room.id)).map(|area| area.texts()).collect();
        Self { room_of, texts, left_out }
    }
}

/// The entities that report on people or name things, each in its room.
fn sensors<'a>(
    entities: &'a [Entity],
    devices: &'a [Device],
    places: &Places<'_>,
    people: &[&'a str],
    notes: &mut Vec<String>,
) -> Vec<Placed<'a>> {
    let devices: HashMap<&str, &Device> = devices.iter().map(|device| (&*device.id, device)).collect();
    let first_names = FirstNames::of(people);
    let (mut found, mut homeless, mut nameless) = (Vec::new(), 0, Vec::new());
    for entity in entities {
        let Some((domain, object)) = entity.entity_id.split_once('.') else { continue };
        if entity.is_quiet() || !is_object(object) || !Sensor::is_of(entity, domain) {
            continue;
        }
        let device = entity.device_id.as_deref().and_then(|id| devices.get(id).copied());
        let area = entity.area_id.as_deref().or(device.and_then(|device| device.area_id.as_deref()));
        let Some(room) = area.and_then(|area| places.room_of.get(area).copied()) else {
            homeless += usize::from(area.is_none_or(|area| !places.left_out.contains(area)));
            continue;
        };
        let texts = &places.texts[room];
        let mut sensor = match Sensor::of(entity, domain, object, device, texts) {
            Ok(sensor) => sensor,
            Err(NoSensor::Nameless) => {
                nameless.push(&*entity.entity_id);
                continue;
            }
            Err(NoSensor::Silent) => continue,
        };
        let is_bound = matches!(sensor.kind, Kind::Occupancy | Kind::Used);
        let person = is_bound.then(|| first_names.person_in(entity, object, device, texts)).flatten();
        sensor.bind(person.is_some(), entity, object, device);
        found.push(Placed { domain, object, room, sensor, person });
    }
    if !nameless.is_empty() {
        let more = nameless.len().saturating_sub(NAMES_IN_NOTE);
        notes.push(format!(
            "No rules for switches and machines whose names are no known things: {}{}. If people use one, give it the English name of its thing \
             in Home Assistant, or write its rules by hand.",
            nameless[..nameless.len() - more].join(", "),
            if more > 0 { format!(" and {more} more") } else { String::new() },
        ));
    }
    if homeless > 0 {
        notes.push(format!(
            "Left out {homeless} entities without an area; assign them in Home Assistant and import again."
        ));
    }
    found
}

/// The rooms with one sensor that holds its state and is on no seat.
fn with_one_occupancy(sensors: &[Placed<'_>]) -> HashSet<usize> {
    let mut count_in: HashMap<usize, usize> = HashMap::new();
    for placed in sensors.iter().filter(|placed| placed.sensor.is_of_room()) {
        *count_in.entry(placed.room).or_default() += 1;
    }
    count_in.into_iter().filter(|(_, count)| *count == 1).map(|(room, _)| room).collect()
}

/// The things, in rows in their rooms; each kind once in a room.
fn items(sensors: &[Placed<'_>], rooms: &[RoomEntry]) -> Vec<ItemEntry> {
    let (mut ids, mut items) = (Ids::default(), Vec::new());
    let mut things: HashSet<(usize, &str)> = HashSet::new();
    let mut count_in: HashMap<usize, usize> = HashMap::new();
    for placed in sensors {
        let Some(label) = placed.sensor.thing.as_deref() else { continue };
        let Some(bounds) = rooms[placed.room].r#box.filter(|_| things.insert((placed.room, label))) else { continue };
        let number = count_in.entry(placed.room).or_default();
        let per_row = ((ROOM_M[0] - APART_M) / APART_M) as usize;
        let (column, row) = (*number % per_row, (*number / per_row) % per_row);
        *number += 1;
        let min_m = [
            bounds.min_m[0] + APART_M + column as f64 * APART_M,
            bounds.min_m[1] + APART_M + row as f64 * APART_M,
            bounds.min_m[2],
        ];
        let own = Box3 { min_m, max_m: min_m.map(|metres| metres + THING_M) };
        items.push(ItemEntry::boxed(ids.take(label), label, own));
    }
    items
}

/// The persons with their objects: of the page of persons, then of configuration.yaml, which the registry of entities alone knows.
fn people(entities: &[Entity], persons: &[Person], notes: &mut Vec<String>) -> Vec<(String, String)> {
    let of_registry = |entity: &'_ Entity| entity.entity_id.strip_prefix("person.").map(str::to_owned);
    let mut registered: HashMap<&str, &Entity> = HashMap::new();
    for entity in entities {
        if let Some(id) = entity.unique_id.as_str() {
            registered.entry(id).or_insert(entity);
        }
    }
    let mut people: Vec<(String, String)> = Vec::new();
    for person in persons {
        let registered = registered.get(&*person.id).copied();
        let object = registered.and_then(of_registry).unwrap_or_else(|| slug(&person.name));
        people.push((object, comment(&person.name).trim().to_owned()));
    }
    let mut known: HashSet<String> = people.iter().map(|(object, _)| object.clone()).collect();
    for entity in entities {
        let Some(object) = of_registry(entity).filter(|object| known.insert(object.clone())) else { continue };
        let name = entity.name.as_deref().or(entity.original_name.as_deref()).unwrap_or(&object);
        let name = comment(name).trim().to_owned();
        people.push((object, name));
    }
    people.retain(|(object, _)| is_object(object));
    let (people, nameless): (Vec<_>, Vec<_>) = people.into_iter().partition(|(_, name)| is_person(name));
    if !nameless.is_empty() {
        let names: Vec<&str> = nameless.iter().map(|(_, name)| &**name).collect();
        notes.push(format!(
            "Left out the persons {}: no sentence can name a person so. Give them other names in Home Assistant and import again.",
            quoted(&names)
        ));
    }
    people
}
