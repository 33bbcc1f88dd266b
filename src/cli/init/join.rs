//! Joins a robot's map with the things and rules of Home Assistant's areas.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use roomcast_core::semantic_map::{SemanticMap, delta};
use serde_json::json;

use super::areas::Areas;
use super::{Failure, count, input};

/// Size in metres of a thing that only Home Assistant knows.
const THING_M: f64 = 0.3;

/// The robot's map with the things of Home Assistant's areas, each in the middle of its room.
pub(super) fn with_things(
    map: &SemanticMap,
    areas: &SemanticMap,
    known: &Areas,
    notes: &mut Vec<String>,
) -> Result<SemanticMap, Failure> {
    let (mut changes, mut homeless) = (Vec::new(), 0);
    for item in areas.items() {
        let area = areas.rooms_at(item.position_m).next();
        let Some(room) = area.and_then(|area| known.room(map, &areas.rooms()[area.0 as usize].id)) else {
            homeless += 1;
            continue;
        };
        let label = &areas.labels()[item.label.0 as usize];
        let space = &map.rooms()[room.0 as usize].space;
        let has = |other: &roomcast_core::semantic_map::Item| {
            map.labels()[other.label.0 as usize] == *label && space.contains(&other.position_m)
        };
        if map.items().iter().any(has) {
            continue;
        }
        let at = inside(map, room.0 as usize);
        let half = 0.5 * THING_M;
        let (min_m, max_m) = (at.map(|metres| metres - half), at.map(|metres| metres + half));
        let id = format!("home-{}", item.id);
        changes.push(json!({"change": "add-item", "item": {
            "id": id, "label": label, "position_m": at, "box": {"min_m": min_m, "max_m": max_m}}}));
    }
    if homeless > 0 {
        notes.push(format!(
            "{} of Home Assistant left out, in areas that are no known room of the robot's map.",
            count(homeless, "thing")
        ));
    }
    if changes.is_empty() {
        return Ok(map.clone());
    }
    notes.push(format!(
        "{} of Home Assistant put into the middle of the rooms, with ids that begin with \"home\".",
        count(changes.len(), "thing")
    ));
    let changed =
        delta::parse_changes(&serde_json::Value::from(changes).to_string()).and_then(|changes| map.changed(changes));
    changed.map_err(|error| input(format!("Home Assistant's things do not fit into the robot's map: {error}")))
}

pub(super) fn inside(map: &SemanticMap, room: usize) -> [f64; 3] {
    const STEPS: i32 = 20;
    let space = &map.rooms()[room].space;
    let (middle, size) = (space.bounds.centre_m(), space.bounds.size_m());
    let z = space.bounds.min_m[2] + 0.5 * THING_M;
    let grid = (-STEPS..=STEPS).flat_map(|right| (-STEPS..=STEPS).map(move |down| (right, down)));
    let mut places: Vec<_> = grid.collect();
    places.sort_by_key(|(right, down)| right * right + down * down);
    let point = |(right, down): (i32, i32)| {
        let part = |steps: i32, metres: f64| f64::from(steps) / f64::from(2 * STEPS) * metres;
        let tidy = |metres: f64| (metres * 1e3).round() / 1e3;
        [tidy(middle[0] + part(right, size[0])), tidy(middle[1] + part(down, size[1])), z]
    };
    let near = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]].map(|way| way.map(|step: f64| step * THING_M));
    let is_inside = |at: &[f64; 3]| near.iter().all(|[x, y]| space.contains(&[at[0] + x, at[1] + y, z]));
    places.into_iter().map(point).find(is_inside).unwrap_or(middle)
}

/// The first line of a rule.
const RULE: &str = "[[rule]]\n";

/// The number of rules that are not comments.
pub(super) fn rules_in(text: &str) -> usize {
    text.lines().filter(|line| *line == RULE.trim_end()).count()
}

/// Rules with the rooms' names of the robot's map. A rule of an unmatched area becomes a comment, so that it moves no person into a wrong room.
pub(super) fn in_rooms_of(
    map: &SemanticMap,
    areas: &SemanticMap,
    known: &Areas,
    rules: &str,
    notes: &mut Vec<String>,
) -> String {
    let name_of = |id: &str| {
        let place = areas.rooms().iter().position(|room| room.id == id);
        place.map_or_else(|| id.to_owned(), |place| areas.room_key(place).to_owned())
    };
    let ids: Vec<&str> = map.rooms().iter().map(|room| room.id.as_str()).collect();
    let ids = ids.join(", ");
    let (mut unknown, mut unknown_rules) = (BTreeSet::new(), 0);
    let mut parts = rules.split(RULE);
    let mut text = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // A comment after an empty line belongs to the next rule.
        let (rule, rest) = part.split_at(part.find("\n\n").map_or(part.len(), |at| at + 1));
        let named = rule.parse::<toml::Table>().ok();
        let area = named.as_ref().and_then(|table| table.get("room")).and_then(toml::Value::as_str);
        let room = area.map(|area| known.room(map, area).ok_or(area));
        match room {
            None => text.extend([RULE, rule]),
            Some(Ok(room)) => {
                let id = toml::Value::from(map.rooms()[room.0 as usize].id.as_str());
                text.push_str(RULE);
                for line in rule.lines() {
                    let own = if line.starts_with("room = ") { format!("room = {id}") } else { line.to_owned() };
                    let _ = writeln!(text, "{own}");
                }
            }
            Some(Err(area)) => {
                let area = name_of(area);
                unknown.insert(format!("{area:?}"));
                unknown_rules += 1;
                let _ = writeln!(
                    text,
                    "# Which room is the area {area:?}? Write one of {ids}, and take out the signs # below."
                );
                RULE.lines().chain(rule.lines()).for_each(|line| {
                    let _ = writeln!(text, "# {line}");
                });
            }
        }
        text.push_str(rest);
    }
    if !unknown.is_empty() {
        let which = if unknown.len() == 1 { "the area" } else { "the areas" };
        notes.push(format!(
            "{} of {which} {} written as comments, since no room of the robot's map is known to be that: write one of {ids} there, and take out \
             the signs #.",
            count(unknown_rules, "rule"),
            unknown.into_iter().collect::<Vec<_>>().join(", "),
        ));
    }
    text
}
