//! Areas and floors as rooms: boxes of one size side by side, floor above floor, with doors from each to the next.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::registry::{Area, Floor, Floors};
use crate::names::Names;
use crate::semantic_map::Box3;
use crate::semantic_map::import::{room_aliases, room_label};
use crate::semantic_map::schema::{DoorEntry, RoomEntry};

/// Length, width and height of every room, in metres.
pub(super) const ROOM_M: [f64; 3] = [4.0, 4.0, 2.5];
/// From floor to floor, in metres.
const STOREY_M: f64 = 3.0;

/// The rooms of a home.
pub(super) struct Plan {
    /// In the order of the storeys, the lowest first.
    pub(super) rooms: Vec<RoomEntry>,
    pub(super) doors: Vec<DoorEntry>,
    pub(super) aliases: BTreeMap<String, Vec<String>>,
}

/// The storey of each area, from 0 for the lowest. Floors of one level are one storey, and areas without a level are on the ground floor.
fn storeys(areas: &[Area], floors: &Floors, notes: &mut Vec<String>) -> Vec<usize> {
    let mut level_of: HashMap<&str, i64> = HashMap::new();
    for floor in &floors.floors {
        if let Some(level) = floor.level {
            level_of.entry(&floor.floor_id).or_insert(level);
        }
    }
    let is_used = |id: &str| areas.iter().any(|area| area.floor_id.as_deref() == Some(id));
    let without: Vec<String> = (floors.floors.iter())
        .filter(|floor| floor.level.is_none() && is_used(&floor.floor_id))
        .map(floor_name)
        .collect();
    if !without.is_empty() && floors.floors.len() > 1 {
        notes.push(format!(
            "Floors without a level: {}. Their rooms are on the ground floor, for the order of the list is not height. Set the levels in Home \
             Assistant (Settings, Areas) and import again.",
            without.join(", ")
        ));
    }
    notes.extend(of_one_level(floors, is_used));
    // Where all levels are above 0, the lowest is the ground: some count floors from 1.
    let ground = level_of.values().copied().min().map_or(0, |lowest| lowest.max(0));
    let level = |area: &Area| {
        let own = area.floor_id.as_deref().and_then(|floor| level_of.get(floor).copied());
        own.unwrap_or(ground)
    };
    let levels: BTreeSet<i64> = level_of.values().copied().chain(areas.iter().map(level)).collect();
    areas.iter().map(|area| levels.range(..level(area)).count()).collect()
}

/// A note on floors of one level.
fn of_one_level(floors: &Floors, is_used: impl Fn(&str) -> bool) -> Option<String> {
    let mut names_at: BTreeMap<i64, Vec<String>> = BTreeMap::new();
    for floor in floors.floors.iter().filter(|floor| is_used(&floor.floor_id)) {
        if let Some(level) = floor.level {
            names_at.entry(level).or_default().push(floor_name(floor));
        }
    }
    let shared: Vec<String> = (names_at.iter())
        .filter(|(_, names)| names.len() > 1)
        .map(|(level, names)| format!("{} (level {level})", names.join(" and ")))
        .collect();
    (!shared.is_empty()).then(|| {
        format!(
            "Floors of one level: {}. Their rooms have one height, side by side. If one floor is above the other, set the levels in Home \
             Assistant (Settings, Areas) and import again.",
            shared.join(", ")
        )
    })
}

fn floor_name(floor: &Floor) -> String {
    super::comment(if floor.name.trim().is_empty() { &floor.floor_id } else { &floor.name })
}

/// The rooms' boxes and the doors between them.
pub(super) fn plan(areas: &[Area], floors: &Floors, notes: &mut Vec<String>) -> Plan {
    let storey_of = storeys(areas, floors, notes);
    let count = storey_of.iter().max().map_or(0, |highest| highest + 1);
    let (mut rooms, mut doors) = (Vec::new(), Vec::new());
    let mut named = Vec::new();
    let mut below: Option<(String, [f64; 3])> = None;
    for storey in 0..count {
        let own: Vec<&Area> =
            areas.iter().zip(&storey_of).filter(|(_, of)| **of == storey).map(|(area, _)| area).collect();
        let columns = (own.len() as f64).sqrt().ceil().max(1.0) as usize;
        for (place, area) in own.iter().enumerate() {
            let (column, row) = (place % columns, place / columns);
            let min_m = [column as f64 * ROOM_M[0], row as f64 * ROOM_M[1], storey as f64 * STOREY_M];
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
    Plan { rooms, doors, aliases }
}

/// A note on areas that look like no rooms, with the option that leaves them out. `has_things` says which areas have things or sensors of rooms.
pub(super) fn no_rooms(areas: &[Area], has_things: &[bool]) -> Option<String> {
    const OUTSIDE: [&str; 1] = ["garden"];
    let names = Names::built_in();
    let is_none = |(area, has_things): &(&Area, &bool)| match names.kind_of_room(&area.name) {
        _ if names.is_no_room(&area.name) => true,
        Some(kind) => OUTSIDE.contains(&kind),
        None => !**has_things && !area.name.to_lowercase().contains("room"),
    };
    let found: Vec<String> =
        areas.iter().zip(has_things).filter(is_none).map(|(area, _)| super::comment(area.name.trim())).collect();
    let options: String = found.iter().map(|name| format!(" --leave-out {name:?}")).collect();
    let looks = if found.len() == 1 { "looks like no room" } else { "look like no rooms" };
    (!found.is_empty()).then(|| {
        format!(
            "{} {looks}. Every room takes part in the forecasts: if the robot never works there and no person is ever there, import again with{options}.",
            found.join(", "),
        )
    })
}

/// What sentences call each room: its label where no other room has it, else the area's own name, else the label with a number.
pub(super) fn spoken(rooms: &[RoomEntry], areas: &[Area]) -> Vec<String> {
    let labels: Vec<String> = rooms.iter().map(|room| plain(&room.label)).collect();
    let name_of: HashMap<&str, String> = areas.iter().map(|area| (&*area.id, plain(&area.name))).collect();
    let own: Vec<&str> = rooms.iter().map(|room| name_of.get(&*room.id).map_or("", |name| &**name)).collect();
    let is_only = |name: &str, at: usize| {
        let others = (0..rooms.len()).filter(|other| *other != at);
        !name.is_empty() && others.into_iter().all(|other| labels[other] != name && own[other] != name)
    };
    let mut taken = BTreeSet::new();
    let mut spoken = Vec::new();
    for at in 0..rooms.len() {
        let found = [&*labels[at], own[at]].into_iter().find(|name| is_only(name, at));
        let kind = if labels[at].is_empty() { "room" } else { &*labels[at] };
        let numbered = || (1..).map(|number| format!("{kind} {number}"));
        let is_free =
            |name: &String| !taken.contains(name) && (0..rooms.len()).all(|other| is_other(&labels, &own, other, name));
        let name = found.map(str::to_owned).or_else(|| numbered().find(is_free)).unwrap_or_default();
        taken.insert(name.clone());
        spoken.push(name);
    }
    spoken
}

fn is_other(labels: &[String], own: &[&str], room: usize, name: &str) -> bool {
    labels[room] != name && own[room] != name
}

/// A name as a sentence can hold it: words alone, so that a name ends no sentence and is no placeholder of a rule.
fn plain(name: &str) -> String {
    const WORDS_MAX: usize = 6;
    let is_part = |c: char| c.is_alphanumeric() || c == '\'' || ('\u{300}'..='\u{36f}').contains(&c);
    let name: String = name.to_lowercase().replace('’', "'");
    let name: String = name.chars().map(|c| if is_part(c) { c } else { ' ' }).collect();
    name.split_whitespace().take(WORDS_MAX).collect::<Vec<_>>().join(" ")
}
