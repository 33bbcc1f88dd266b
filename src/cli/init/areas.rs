//! Matches areas of Home Assistant with rooms of a robot's map. The map has only one storey: areas of others become additional rooms.

use std::collections::{BTreeMap, BTreeSet};

use roomcast_core::names::Names;
use roomcast_core::semantic_map::import::Imported;
use roomcast_core::semantic_map::{Door, MAX_ROOMS, RoomId, SemanticMap, delta};
use serde_json::{Value, json};

use super::{Failure, count, input, inside};

/// Floors with a smaller difference in height are one, in metres.
const SAME_FLOOR_M: f64 = 0.1;
/// The kind of room that leads to other storeys.
const WAY_OUT: &str = "hallway";

#[derive(Debug, Default)]
pub(super) struct Areas {
    /// The room's id of each matched area, by the area's id.
    rooms: BTreeMap<String, String>,
}

impl Areas {
    /// Matches the areas with a robot's map, and adds those of other floors, with the boxes of the areas' own map.
    pub(super) fn find(imported: Imported, areas: &SemanticMap) -> Result<(Imported, Self), Failure> {
        let map = &imported.map;
        let floor_m = floor_of(map, areas);
        let (here, elsewhere): (Vec<RoomId>, Vec<RoomId>) = all(areas)
            .partition(|area| floor_m.is_none_or(|floor_m| (floor_m_of(areas, *area) - floor_m).abs() < SAME_FLOOR_M));
        let known = here.iter().filter_map(|area| Some((*area, room_of_area(map, areas, &here, *area)?)));
        let id = |map: &SemanticMap, room: RoomId| map.rooms()[room.0 as usize].id.clone();
        let mut rooms: BTreeMap<String, String> = known.map(|(area, room)| (id(areas, area), id(map, room))).collect();
        if elsewhere.is_empty() || map.rooms().len() + elsewhere.len() > MAX_ROOMS {
            return Ok((imported, Self { rooms }));
        }
        let map = beside(map, areas, &elsewhere, floor_m.unwrap_or_default(), &mut rooms)?;
        let mut notes = imported.notes;
        notes.push(format!(
            "{} of other floors than the robot's map put beside it, boxes of which nothing is measured: {}. The robot cannot go there.",
            count(elsewhere.len(), "area"),
            elsewhere.iter().map(|area| areas.room_key(area.0 as usize)).collect::<Vec<_>>().join(", ")
        ));
        Ok((Imported { map, notes, ..imported }, Self { rooms }))
    }

    /// The room of an area, on the home's map.
    pub(super) fn room(&self, map: &SemanticMap, area: &str) -> Option<RoomId> {
        let id = self.rooms.get(area)?;
        all(map).find(|room| map.rooms()[room.0 as usize].id == *id)
    }
}

fn all(map: &SemanticMap) -> impl Iterator<Item = RoomId> + use<> {
    (0..map.rooms().len()).filter_map(|room| u32::try_from(room).ok().map(RoomId))
}

fn only(found: Vec<RoomId>) -> Option<RoomId> {
    <[RoomId; 1]>::try_from(found).ok().map(|[room]| room)
}

fn kind(map: &SemanticMap, room: RoomId) -> &str {
    let label = &map.rooms()[room.0 as usize].label;
    Names::built_in().kind_of_room(label).unwrap_or(label)
}

fn floor_m_of(areas: &SemanticMap, area: RoomId) -> f64 {
    areas.rooms()[area.0 as usize].space.bounds.min_m[2]
}

/// The floor with most areas on the robot's map; `None` if two have equally many.
fn floor_of(map: &SemanticMap, areas: &SemanticMap) -> Option<f64> {
    let mut floors: Vec<(usize, f64)> = Vec::new();
    for area in all(areas) {
        let floor_m = floor_m_of(areas, area);
        let of_floor: Vec<RoomId> =
            all(areas).filter(|other| (floor_m_of(areas, *other) - floor_m).abs() < SAME_FLOOR_M).collect();
        // Each floor once, at its first area.
        if of_floor.first() == Some(&area) {
            let known = of_floor.iter().filter(|area| room_of_area(map, areas, &of_floor, **area).is_some());
            floors.push((known.count(), floor_m));
        }
    }
    floors.sort_by_key(|(known, _)| std::cmp::Reverse(*known));
    match floors[..] {
        [(most, _), (next, _), ..] if most == next => None,
        [(_, floor_m), ..] => Some(floor_m),
        [] => None,
    }
}

/// The map with rooms for these areas, above and below it, connected with the way out of its storey.
fn beside(
    map: &SemanticMap,
    areas: &SemanticMap,
    elsewhere: &[RoomId],
    floor_m: f64,
    rooms: &mut BTreeMap<String, String>,
) -> Result<SemanticMap, Failure> {
    let stairs = all(map).find(|room| kind(map, *room) == WAY_OUT).unwrap_or(RoomId(0));
    let foot_m = inside(map, stairs.0 as usize);
    let first = areas.rooms()[elsewhere[0].0 as usize].space.bounds.centre_m();
    let own_floor_m = map.rooms()[stairs.0 as usize].space.bounds.min_m[2];
    let shift_m = [foot_m[0] - first[0], foot_m[1] - first[1], own_floor_m - floor_m];
    let tidy = |metres: f64| (metres * 1e3).round() / 1e3;
    let moved = |at: [f64; 3]| -> [f64; 3] { std::array::from_fn(|axis| tidy(at[axis] + shift_m[axis])) };
    for area in elsewhere {
        let own = &areas.rooms()[area.0 as usize].id;
        let is_taken = map.rooms().iter().any(|room| room.id == *own);
        rooms.insert(own.clone(), if is_taken { format!("home-{own}") } else { own.clone() });
    }
    let end = |area: RoomId| match elsewhere.contains(&area) {
        true => rooms[&areas.rooms()[area.0 as usize].id].clone(),
        false => map.rooms()[stairs.0 as usize].id.clone(),
    };
    let leads_there = |door: &&Door| door.rooms.iter().any(|area| elsewhere.contains(area));
    let doors = areas.doors().iter().filter(leads_there);
    let mut doors: Vec<Value> = doors
        .map(|door| json!({"id": format!("home-{}", door.id), "rooms": door.rooms.map(end), "position_m": moved(door.position_m)}))
        .collect();
    let mut changes = Vec::new();
    for area in elsewhere {
        let own = &areas.rooms()[area.0 as usize];
        let bounds = json!({"min_m": moved(own.space.bounds.min_m), "max_m": moved(own.space.bounds.max_m)});
        changes.push(
            json!({"change": "add-room", "doors": [], "room": {"id": end(*area), "label": own.label, "box": bounds}}),
        );
    }
    // Doors name rooms that the last change may add.
    if let Some(last) = changes.last_mut() {
        last["doors"] = std::mem::take(&mut doors).into();
    }
    let unfit = |error: String| input(format!("Home Assistant's areas do not fit beside the robot's map: {error}"));
    let changed = delta::parse_changes(&Value::from(changes).to_string())
        .and_then(|changes| map.changed(changes))
        .map_err(|error| unfit(error.to_string()))?;
    let taken: BTreeSet<String> =
        all(map).flat_map(|room| own_names(map, &all(map).collect::<Vec<_>>(), room)).collect();
    let mut scene: Value = serde_json::from_str(&changed.to_json()).map_err(|error| unfit(error.to_string()))?;
    let everywhere: Vec<RoomId> = all(areas).collect();
    for area in elsewhere {
        let id = end(*area);
        let names = own_names(areas, &everywhere, *area);
        let names: Vec<&String> = names.iter().filter(|name| !taken.contains(*name) && **name != words(&id)).collect();
        if !names.is_empty() {
            scene["aliases"][&id] = json!(names);
        }
    }
    SemanticMap::from_json(&scene.to_string()).map_err(|error| unfit(error.to_string()))
}

fn words(name: &str) -> String {
    name.to_lowercase().replace(['_', '-'], " ")
}

/// The unambiguous names of a room among some: its id, its label if no other room has it, and their aliases.
fn own_names(map: &SemanticMap, among: &[RoomId], room: RoomId) -> BTreeSet<String> {
    let own = &map.rooms()[room.0 as usize];
    let is_only = among.iter().filter(|other| map.rooms()[other.0 as usize].label == own.label).count() == 1;
    let by_label = is_only.then_some(&own.label);
    let keys = || by_label.into_iter().chain([&own.id]);
    let aliases = keys().filter_map(|key| map.aliases().get(key)).flatten();
    keys().chain(aliases).map(|name| words(name)).collect()
}

/// The room of the robot's map for an area of its floor: the one with one of the area's names, else the only one of its kind, if the area is also the
/// only one of that kind.
fn room_of_area(map: &SemanticMap, areas: &SemanticMap, here: &[RoomId], area: RoomId) -> Option<RoomId> {
    let rooms: Vec<RoomId> = all(map).collect();
    let names = own_names(areas, here, area);
    let is_named = |room: &RoomId| !own_names(map, &rooms, *room).is_disjoint(&names);
    let named = rooms.iter().copied().filter(is_named).collect();
    let wanted = kind(areas, area);
    let of_kind = |map: &SemanticMap, among: &[RoomId]| {
        only(among.iter().copied().filter(|room| kind(map, *room) == wanted).collect())
    };
    only(named).or_else(|| of_kind(areas, here).and_then(|_| of_kind(map, &rooms)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::semantic_map::import::{Registries, home_assistant};

    fn areas(areas: &[(&str, &str, &str)]) -> SemanticMap {
        let area = |(id, name, floor): &(&str, &str, &str)| json!({"id": id, "name": name, "floor_id": floor});
        let areas = json!({"data": {"areas": areas.iter().map(area).collect::<Vec<_>>()}}).to_string();
        let floor = |(id, level): (&str, i64)| json!({"floor_id": id, "name": id, "level": level});
        let floors = [("keller", -1), ("unten", 0), ("oben", 1)].map(floor);
        let floors = json!({"data": {"floors": floors}}).to_string();
        let registries = Registries { areas: &areas, floors: Some(&floors), ..Registries::default() };
        home_assistant(&registries, "home").unwrap().imported.map
    }

    fn robot(rooms: &[&str]) -> Imported {
        let room = |(at, name): (u32, &&str)| {
            let bounds = json!({"min_m": [20 + 4 * at, 30, 0], "max_m": [24 + 4 * at, 34, 2.5]});
            json!({"id": format!("{name}-{at}"), "label": name, "box": bounds})
        };
        let rooms: Vec<_> = (1..).zip(rooms).map(room).collect();
        let scene = json!({"format": "roomcast-scene", "version": 1, "name": "home", "rooms": rooms, "items": []});
        Imported { map: SemanticMap::from_json(&scene.to_string()).unwrap(), notes: Vec::new(), boxed: Vec::new() }
    }

    const HOME: [(&str, &str, &str); 7] = [
        ("kuche", "Küche", "unten"),
        ("flur_unten", "Flur unten", "unten"),
        ("bad_gaste", "Bad Gäste", "unten"),
        ("flur_oben", "Flur oben", "oben"),
        ("eltern", "Elternschlafzimmer", "oben"),
        ("bad_oben", "Bad oben", "oben"),
        ("hobby", "Hobbyraum", "keller"),
    ];

    /// A robot knows one storey. A person on another one is known to be there, so the robot need not wait.
    #[test]
    fn areas_of_other_floors_become_rooms_beside_the_robots() {
        let (home, own) = (areas(&HOME), robot(&["kitchen", "hallway", "bathroom"]));
        let (Imported { map, notes, .. }, known) = Areas::find(own.clone(), &home).unwrap();
        let id = |area: &str| map.rooms()[known.room(&map, area).unwrap().0 as usize].id.as_str();
        let ids = HOME.map(|(area, ..)| id(area));
        assert_eq!(ids, ["kitchen-1", "hallway-2", "bathroom-3", "flur_oben", "eltern", "bad_oben", "hobby"]);
        assert_eq!(map.rooms()[..3], own.map.rooms()[..]);
        let floor_m = |area: &str| map.rooms()[known.room(&map, area).unwrap().0 as usize].space.bounds.min_m[2];
        assert!(floor_m("hobby") < -2.0 && floor_m("kuche") == 0.0 && floor_m("eltern") > 2.0);
        // All can be reached on foot, through the hallway.
        let mut reached = BTreeSet::from([known.room(&map, "flur_unten").unwrap().0]);
        for _ in 0..map.rooms().len() {
            for [one, other] in map.doors().iter().map(|door| door.rooms.map(|room| room.0)) {
                if reached.contains(&one) || reached.contains(&other) {
                    reached.extend([one, other]);
                }
            }
        }
        assert_eq!(reached.len(), map.rooms().len());
        assert_eq!(map.find_room("Elternschlafzimmer"), known.room(&map, "eltern"));
        assert!(notes.len() == 1 && notes[0].starts_with("4 areas of other floors"), "{notes:?}");
    }

    #[test]
    fn where_no_floor_is_known_to_be_the_robots_no_room_is_added() {
        let own = robot(&["room", "room"]);
        let (same, known) = Areas::find(own.clone(), &areas(&HOME)).unwrap();
        assert_eq!((&same.map, &same.notes, known.rooms.len()), (&own.map, &own.notes, 0));
    }
}
