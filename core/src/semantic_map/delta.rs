//! Changes to a map in use: items are added, moved and removed, rooms are added and removed.
//!
//! A change is data (one JSON object per change); applying it is a pure function from map to map. [`crate::grounding::Grounding::regroup`] decides
//! whether a prepared model must be prepared again for the new map.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use super::schema::{DoorEntry, ItemEntry, RoomEntry, SceneFile, VERSION, parse_json};
use super::{Box3, SceneError, SemanticMap, room_of};
use crate::parsing::Keyed;
use crate::text::excerpt;

/// One change. In JSON the key `change` names it: `{"change": "move-item", "id": "mug-1", "position_m": [..], "box": {..}}`.
///
/// The other keys are those of the scene file, documented in `scenes/README.md`.
#[derive(Serialize, Deserialize)]
#[serde(tag = "change", rename_all = "kebab-case", deny_unknown_fields)]
pub enum MapChange {
    /// A new item: `item` is an entry of the scene file's `items`.
    AddItem {
        /// The entry.
        item: ItemEntry,
    },
    /// Moves an item.
    MoveItem {
        /// Id of the item.
        id: String,
        /// The new position, in metres.
        position_m: [f64; 3],
        /// The new extent.
        r#box: Box3,
    },
    /// Removes an item.
    RemoveItem {
        /// Id of the item.
        id: String,
    },
    /// Adds a room with its doors: entries of the scene file's `rooms` and `doors`.
    AddRoom {
        /// Entry of the room.
        room: RoomEntry,
        /// Entries of the doors.
        #[serde(default)]
        doors: Vec<DoorEntry>,
    },
    /// Removes a room with its items, doors, parts and aliases.
    RemoveRoom {
        /// Id of the room.
        id: String,
    },
}

/// Why changes cannot be applied.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DeltaError {
    /// The text is not a list of changes. The message names the element and the line.
    #[error("{0}; expected a JSON list of changes such as {{\"change\": \"remove-item\", \"id\": \"mug-1\"}}")]
    Json(String),
    /// There is no item with this id.
    #[error("changes[{index}]: there is no item {:?}; name one that `roomcast scene show --json` lists", excerpt(.id))]
    NoSuchItem {
        /// Index of the change.
        index: usize,
        /// The given id.
        id: String,
    },
    /// There is no room with this id.
    #[error("changes[{index}]: there is no room with the id {:?}; the ids are {}", excerpt(.id), excerpt(&.there.join(", ")))]
    NoSuchRoom {
        /// Index of the change.
        index: usize,
        /// The given id.
        id: String,
        /// Ids of the existing rooms.
        there: Vec<String>,
    },
    /// The resulting map breaks a rule of scenes.
    #[error("the changed map is malformed")]
    Scene(#[from] SceneError),
}

/// Parses a JSON list of changes.
///
/// # Errors
/// [`DeltaError::Json`].
pub fn parse_changes(json: &str) -> Result<Vec<MapChange>, DeltaError> {
    let changes: Vec<Keyed<MapChange>> = parse_json(json).map_err(DeltaError::Json)?;
    Ok(changes.into_iter().map(|change| change.0).collect())
}

impl SemanticMap {
    /// Applies all changes in order, or none. The time is proportional to the map and the changes.
    ///
    /// # Errors
    /// If a change names an unknown item or room, or the result breaks a rule of scenes.
    pub fn changed(&self, changes: Vec<MapChange>) -> Result<Self, DeltaError> {
        let mut file = self.to_file();
        // A change may add a footprint; writing selects the version that the new map needs.
        file.version = VERSION;
        let mut items = Items::new(std::mem::take(&mut file.items));
        for (index, change) in changes.into_iter().enumerate() {
            let no_item = |id: String| DeltaError::NoSuchItem { index, id };
            match change {
                MapChange::AddItem { item } => items.add(item),
                MapChange::MoveItem { id, position_m, r#box } => {
                    let Some(item) = items.slot(&id).and_then(Option::as_mut) else { return Err(no_item(id)) };
                    item.position_m = position_m;
                    item.r#box = r#box;
                }
                MapChange::RemoveItem { id } => {
                    items.slot(&id).and_then(Option::take).ok_or_else(|| no_item(id))?;
                }
                MapChange::AddRoom { room, doors } => {
                    if !doors.is_empty() && file.doors.is_empty() {
                        // An explicit door must not remove the found ones.
                        file.doors = self.door_entries();
                    }
                    file.rooms.push(room);
                    file.doors.extend(doors);
                }
                MapChange::RemoveRoom { id } => {
                    if !file.rooms.iter().any(|room| room.id == id) {
                        let there = file.rooms.into_iter().map(|room| room.id).collect();
                        return Err(DeltaError::NoSuchRoom { index, id, there });
                    }
                    file.items = items.into_list();
                    // Only a checked map knows the items of a room.
                    file = Self::check(file)?.without_room(&id);
                    items = Items::new(std::mem::take(&mut file.items));
                }
            }
        }
        file.items = items.into_list();
        Ok(Self::check(file)?)
    }

    /// The map's file without a room, its items, doors, parts and aliases.
    fn without_room(&self, id: &str) -> SceneFile {
        let mut file = self.to_file();
        file.version = VERSION;
        let Some(gone) = self.rooms.iter().position(|room| room.id == id) else { return file };
        // Grounding has looked at all edges already.
        let mut left = usize::MAX;
        let mut is_kept = self.items.iter().map(|item| room_of(&self.rooms, item, &mut left) != Some(gone));
        file.items.retain(|_| is_kept.next().unwrap_or(true));
        file.rooms.retain(|room| room.id != id);
        file.doors.retain(|door| door.rooms.iter().all(|room| room != id));
        file.parts.retain(|part| part.room != id);
        for group in &mut file.groups {
            group.rooms.retain(|room| room != id);
        }
        file.groups.retain(|group| !group.rooms.is_empty());
        let label = &self.rooms[gone].label;
        let is_shared =
            file.rooms.iter().any(|room| room.label == *label) || file.items.iter().any(|item| item.label == *label);
        file.aliases.retain(|key, _| key != id && (key != label || is_shared));
        file
    }
}

struct Items {
    list: Vec<Option<ItemEntry>>,
    place_of: HashMap<String, usize>,
}

impl Items {
    fn new(items: Vec<ItemEntry>) -> Self {
        let place_of = items.iter().enumerate().map(|(index, item)| (item.id.clone(), index)).collect();
        Self { list: items.into_iter().map(Some).collect(), place_of }
    }

    fn add(&mut self, item: ItemEntry) {
        // A duplicate id stays in the list, so that the check reports it.
        self.place_of.insert(item.id.clone(), self.list.len());
        self.list.push(Some(item));
    }

    /// The item's place in the list; empty after its removal.
    fn slot(&mut self, id: &str) -> Option<&mut Option<ItemEntry>> {
        self.list.get_mut(*self.place_of.get(id)?)
    }

    fn into_list(self) -> Vec<ItemEntry> {
        self.list.into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{GroundedScores, Grounding, GroundingOptions};
    use crate::semantic_map::RoomId;
    use proptest::prelude::*;

    const TWO_ROOMS: &str = include_str!("../../../tests/data/two_rooms.json");

    fn map() -> SemanticMap {
        SemanticMap::from_json(TWO_ROOMS).unwrap()
    }

    fn changed(json: &str) -> Result<SemanticMap, DeltaError> {
        map().changed(parse_changes(json)?)
    }

    const ADD: &str = r#"[{"change": "add-item", "item": {"id": "mug-9", "label": "mug", "position_m": [1, 1, 1],
        "box": {"min_m": [1, 1, 1], "max_m": [1.1, 1.1, 1.1]}}}]"#;
    const MOVE: &str = r#"[{"change": "move-item", "id": "sofa-1", "position_m": [1, 1, 0.4], "box": {"min_m": [0, 0, 0], "max_m": [2, 0.9, 0.8]}}]"#;
    const REMOVE: &str = r#"[{"change": "remove-item", "id": "sofa-1"}]"#;
    const ROOM: &str = r#"[{"change": "add-room", "room": {"id": "garage", "label": "garage", "box": {"min_m": [10, 0, 0], "max_m": [14, 3, 2.5]}},
        "doors": [{"id": "living-room--garage", "rooms": ["living-room", "garage"], "position_m": [9, 1, 1]}]}]"#;

    #[test]
    fn items_come_move_and_go() {
        assert_eq!(changed(ADD).unwrap().items.len(), map().items.len() + 1);
        let moved = changed(MOVE).unwrap();
        let grounding = Grounding::new(&moved, &GroundingOptions::default()).unwrap();
        assert_eq!(grounding.item_partition[5].map(|room| room.0), Some(0));
        assert_eq!(changed(REMOVE).unwrap().find_label("sofa"), None);
        assert_ne!(moved.fingerprint, map().fingerprint);
    }

    #[test]
    fn a_new_room_gathers_what_was_outside() {
        let map = changed(ROOM).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        assert!(grounding.unassigned.is_empty());
        assert_eq!(map.path(RoomId(0), RoomId(2)).map(|path| path.len()), Some(3));
    }

    #[test]
    fn a_room_of_any_shape_can_be_added() {
        let outline = ROOM.replace(
            r#""box": {"min_m": [10, 0, 0], "max_m": [14, 3, 2.5]}"#,
            r#""footprint": [[[9, 0], [14, 0], [14, 3], [12, 3], [12, 1.5], [9, 1.5]]], "height": 2.5"#,
        );
        let map = changed(&outline).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        assert_eq!(grounding.item_partition[8].map(|room| room.0), Some(2), "the bicycle");
        assert!(map.to_json().contains("\"version\": 2"));
        assert_ne!(map.fingerprint, changed(ROOM).unwrap().fingerprint);
    }

    #[test]
    fn a_given_door_does_not_close_those_that_were_found() {
        let corners = SemanticMap::from_json(include_str!("../../../tests/data/corners.json")).unwrap();
        let room = ROOM.replace("[10, 0, 0]", "[20, 0, 0]").replace("[14, 3, 2.5]", "[24, 3, 2.5]");
        let more = corners.changed(parse_changes(&room).unwrap()).unwrap();
        assert_eq!(more.doors.len(), corners.doors.len() + 1);
        assert!(!more.doors_found);
        let item = corners.changed(parse_changes(ADD).unwrap()).unwrap();
        assert!(item.doors_found);
        assert_eq!(item.doors, corners.doors);
    }

    const NO_ROOM: &str = r#"[{"change": "remove-room", "id": "living-room"}]"#;

    #[test]
    fn a_room_goes_with_its_items_and_doors() {
        let before = map();
        let grounding = Grounding::new(&before, &GroundingOptions::default()).unwrap();
        let gone = before.rooms.iter().position(|room| room.id == "living-room").unwrap();
        let in_it = grounding.item_partition.iter().flatten().filter(|room| room.0 as usize == gone);
        let count = in_it.count();
        let after = changed(NO_ROOM).unwrap();
        assert!(count > 0);
        assert_eq!((after.rooms.len(), after.items.len()), (before.rooms.len() - 1, before.items.len() - count));
        assert!(after.find_room("living room").is_none() && after.doors.is_empty());
        // A room added in the same list can be removed, and a room can be replaced by one of another shape.
        let list = |changes: &[&str]| {
            changes.iter().map(|list| list[1..list.len() - 1].to_owned()).collect::<Vec<_>>().join(",")
        };
        let both = format!("[{}]", list(&[ROOM, &NO_ROOM.replace("living-room", "garage")]));
        assert_eq!(changed(&both).unwrap().rooms, before.rooms);
        let again = r#"[{"change": "add-room", "room": {"id": "living-room", "label": "lounge", "box": {"min_m": [10, 0, 0], "max_m": [14, 3, 2.5]}}}]"#;
        let map = changed(&format!("[{}]", list(&[NO_ROOM, again]))).unwrap();
        assert_eq!(map.rooms.last().map(|room| room.label.as_str()), Some("lounge"));
    }

    #[test]
    fn a_room_that_cannot_go_is_refused() {
        let message = |json: &str| changed(json).unwrap_err().to_string();
        let unknown = message(&NO_ROOM.replace("living-room", "cellar"));
        assert!(unknown.contains("changes[0]: there is no room with the id \"cellar\"; the ids are "), "{unknown}");
        let ids: Vec<String> =
            map().rooms.iter().map(|room| format!(r#"{{"change": "remove-room", "id": "{}"}}"#, room.id)).collect();
        let all = format!("[{}]", ids.join(","));
        assert_eq!(message(&all), "the changed map is malformed", "a map has a room");
    }

    #[test]
    fn changes_that_cannot_be_are_refused() {
        let message = |json: &str| changed(json).unwrap_err().to_string();
        assert!(message("{}").contains("expected a JSON list"));
        assert!(message(&REMOVE.replace("sofa-1", "sofa-2")).contains("changes[0]: there is no item \"sofa-2\""));
        assert!(message(r#"[["remove-item", "mug-1"]]"#).contains("a list, expected keys and values"));
        assert!(message(&REMOVE.replace("remove", "paint")).contains("unknown word"));
        let twice = ADD.replace("mug-9", "mug-1");
        let error = changed(&twice).unwrap_err();
        assert!(std::error::Error::source(&error).unwrap().to_string().contains("is used twice"));
    }

    #[test]
    fn a_change_without_new_labels_leaves_the_models_list_alone() {
        let options = GroundingOptions::default();
        let before = Grounding::new(&map(), &options).unwrap();
        for json in [ADD, MOVE, REMOVE] {
            let after = before.regroup(&changed(json).unwrap(), &options).unwrap();
            assert_eq!(after.new_labels, 0, "{json}");
            assert_eq!(after.grounding.label_texts(), before.label_texts());
        }
        let after = before.regroup(&changed(ROOM).unwrap(), &options).unwrap();
        assert_eq!(after.new_labels, 1, "the room's name");
        assert_eq!(after.grounding.label_texts().last(), Some(&"garage"));
    }

    #[test]
    fn a_label_without_items_has_no_weight() {
        let options = GroundingOptions::default();
        let before = Grounding::new(&map(), &options).unwrap();
        let sofa = before.label_texts().iter().position(|text| *text == "sofa").unwrap();
        let after = before.regroup(&changed(REMOVE).unwrap(), &options).unwrap().grounding;
        let mut log_prob_nats = vec![f64::NEG_INFINITY; after.scored_labels.len()];
        log_prob_nats[sofa] = -0.1;
        let mut scores = GroundedScores::default();
        after.ground(&log_prob_nats, &mut scores).unwrap();
        assert_eq!(scores.partition_log_score_nats, [f64::NEG_INFINITY; 2]);
        assert_eq!(scores.label_mass, 0.0, "what the map no longer holds covers nothing");
    }

    proptest! {
        #[test]
        fn regrouping_agrees_with_grounding_afresh(moves in prop::collection::vec((0..9usize, 0.0..9.0f64, 0.0..3.0f64), 0..12), gone in 0..9usize) {
            let before = map();
            let mut changes: Vec<MapChange> = moves.iter().map(|&(index, x, y)| MapChange::MoveItem {
                id: before.items[index].id.clone(), position_m: [x, y, 1.0], r#box: Box3 { min_m: [x - 0.5, y - 0.5, 0.5], max_m: [x + 0.5, y + 0.5, 1.5] },
            }).collect();
            changes.push(MapChange::RemoveItem { id: before.items[gone].id.clone() });
            let after = before.changed(changes).unwrap();
            let options = GroundingOptions::default();
            let regrouped = Grounding::new(&before, &options).unwrap().regroup(&after, &options).unwrap().grounding;
            let fresh = Grounding::new(&after, &options).unwrap();
            let score = |text: &str| -1.0 - text.len() as f64;
            let scores = |grounding: &Grounding| {
                let log_prob_nats: Vec<f64> = grounding.label_texts().into_iter().map(score).collect();
                let mut scores = GroundedScores::default();
                grounding.ground(&log_prob_nats, &mut scores).unwrap();
                (scores, grounding.item_log_score_nats(&log_prob_nats).collect::<Vec<_>>())
            };
            let ((a, a_items), (b, b_items)) = (scores(&regrouped), scores(&fresh));
            for (a, b) in a.partition_probability.iter().zip(&b.partition_probability) {
                prop_assert!((a - b).abs() < 1e-12);
            }
            prop_assert!((a.label_mass - b.label_mass).abs() < 1e-12);
            prop_assert_eq!(a_items, b_items);
        }
    }
}
