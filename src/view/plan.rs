//! The plan of the map, as the page draws it.

use std::collections::BTreeMap;

use roomcast_core::grounding::{Partition, partition_named};
use roomcast_core::semantic_map::{SceneError, SemanticMap, Storey, Storeys};
use roomcast_services::moment::{Moment, MomentError};
use serde_json::{Value, json};

/// The beginning of a presence event's text.
const PRESENT_IN: &str = "present in the ";

/// A map to draw, in its partitions. One map can have several plans.
#[derive(Debug)]
pub(super) struct Plan {
    /// The map's fingerprint, hexadecimal.
    pub(super) map: String,
    level: &'static str,
    /// The names of its partitions, by id.
    pub(super) names: BTreeMap<String, String>,
    pub(super) drawing: Value,
    scene: SemanticMap,
    partitions: Vec<Partition>,
}

fn key_of(fingerprint: &str, level: &str) -> String {
    format!("{fingerprint}-{level}")
}

impl Plan {
    /// The page's key for the plan.
    pub(super) fn key(&self) -> String {
        key_of(&self.map, self.level)
    }

    /// The name of the room that a narrator calls so; `None` if the map has no single room of this name.
    pub(super) fn name_of(&self, said: &str) -> Option<String> {
        self.names.get(&partition_named(said, &self.scene, &self.partitions)?.id).cloned()
    }

    pub(super) fn of_moment(moment: &Moment) -> Result<Self, MomentError> {
        let explained = SemanticMap::from_json(&moment.scene.to_string());
        Self::of_map(explained.map_err(MomentError::Scene)?, moment).map_err(MomentError::Scene)
    }

    fn of_map(scene: SemanticMap, moment: &Moment) -> Result<Self, SceneError> {
        let map = &scene;
        let metres = |value: f64| (value * 1e3).round() / 1e3;
        let point = |[x, y]: [f64; 2]| json!([metres(x), metres(y)]);
        let partitions = roomcast_core::grounding::partitions(map, moment.grounding.level);
        let names = roomcast_core::grounding::partition_names(&partitions);
        let storeys = Storeys::of(map);
        let room = |(partition, name): (&Partition, &String)| {
            let rings = partition.spaces.iter().flat_map(|space| storeys.moved_space(space).rings());
            let rings: Vec<Vec<Value>> = rings.map(|ring| ring.into_iter().map(point).collect()).collect();
            json!({"id": partition.id, "name": name, "rings": rings})
        };
        let item = |item: &roomcast_core::semantic_map::Item| {
            let [x, y, _] = item.position_m;
            let at = storeys.moved(storeys.of_item(map, item), [x, y]);
            json!({"id": item.id, "label": map.labels()[item.label.0 as usize], "at": point(at)})
        };
        let doors = map.doors().iter().flat_map(|door| {
            // A door between storeys is drawn on both.
            let mut on = door.rooms.map(|room| storeys.of_space(&map.rooms()[room.0 as usize].space)).to_vec();
            on.dedup();
            let [x, y, _] = door.position_m;
            on.into_iter().map(|storey| point(storeys.moved(storey, [x, y]))).collect::<Vec<_>>()
        });
        let storey = |own: &Storey| json!({"name": own.name(), "at": point([own.min_m[0], own.max_m[1]])});
        let named = storeys.all().iter().filter(|_| storeys.all().len() > 1);
        let rooms: Vec<Value> = partitions.iter().zip(&names).map(room).collect();
        let names = partitions.iter().map(|partition| partition.id.clone()).zip(names).collect();
        let (fingerprint, level) = (moment.map_fingerprint.clone(), moment.grounding.level.into());
        let drawing = json!({
            "map": key_of(&fingerprint, level), "name": map.name(),
            "rooms": rooms,
            "storeys": named.map(storey).collect::<Vec<_>>(), "doors": doors.collect::<Vec<_>>(), "items": map.items().iter().map(item).collect::<Vec<_>>(),
        });
        Ok(Self { map: fingerprint, level, names, drawing, scene, partitions })
    }

    pub(super) fn name(&self, state: &mut Value) {
        for room in state["rooms"].as_array_mut().into_iter().flatten() {
            if let Some(name) = room["id"].as_str().and_then(|id| self.names.get(id)) {
                room["name"] = name.as_str().into();
            }
        }
        for (part, name) in [("decision", "text"), ("decision", "reason")] {
            if let Some(text) = state[part][name].as_str() {
                state[part][name] = self.in_names(text).into();
            }
        }
        for stay in state.pointer_mut("/decision/stays").and_then(Value::as_array_mut).into_iter().flatten() {
            if let Some(name) = stay["room"].as_str().and_then(|id| self.names.get(id)) {
                stay["name"] = name.as_str().into();
            }
        }
        for told in state["narration"].as_array_mut().into_iter().flatten() {
            // A sentence is shown as the model reads it. Only presence has a room's id.
            if let Some(text) = told["text"].as_str().filter(|text| text.starts_with(PRESENT_IN)) {
                told["text"] = self.in_names(text).into();
            }
        }
    }

    /// Replaces rooms' ids by their names.
    fn in_names(&self, text: &str) -> String {
        let is_id = |character: char| character.is_alphanumeric() || character == '-' || character == '_';
        let (mut named, mut rest) = (String::with_capacity(text.len()), text);
        while !rest.is_empty() {
            let (word, after) = rest.split_at(rest.find(|character| !is_id(character)).unwrap_or(rest.len()));
            named.push_str(self.names.get(word).map_or(word, String::as_str));
            let (between, after) = after.split_at(after.find(is_id).unwrap_or(after.len()));
            named.push_str(between);
            rest = after;
        }
        named
    }
}
