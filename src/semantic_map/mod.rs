//! The semantic map: labelled items with boxes, rooms, parts and groups of rooms; its file format, checks, import and drawing.

use std::collections::BTreeMap;

/// Index of an item in [`SemanticMap::items`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ItemId(pub u32);

/// Index of a label in [`SemanticMap::labels`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LabelId(pub u32);

/// Index of a room in [`SemanticMap::rooms`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RoomId(pub u32);

/// Index of a partition in [`crate::grounding::Grounding::partitions`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PartitionId(pub u32);

/// An axis-aligned box in metres; x east, y north, z up.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Box3 {
    /// The corner with the least coordinates.
    pub min_m: [f64; 3],
    /// The corner with the greatest coordinates.
    pub max_m: [f64; 3],
}

/// One thing in the map.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// Unique name within the map.
    pub id: String,
    /// Its label.
    pub label: LabelId,
    /// Where it is.
    pub position_m: [f64; 3],
    /// Its extent.
    pub bounds: Box3,
}

/// A room.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// Unique name within the map.
    pub id: String,
    /// Its words for a language model ("living room").
    pub label: String,
    /// Its extent.
    pub bounds: Box3,
}

/// A part of one room.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Unique name within the map.
    pub id: String,
    /// Its words.
    pub label: String,
    /// The room it lies in.
    pub room: RoomId,
    /// Its extent.
    pub bounds: Box3,
}

/// Several rooms taken as one partition.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// Unique name within the map.
    pub id: String,
    /// Its words.
    pub label: String,
    /// Its rooms; groups are disjoint.
    pub rooms: Vec<RoomId>,
}

/// A passage between two rooms.
#[derive(Debug, Clone, PartialEq)]
pub struct Door {
    /// Unique name within the map.
    pub id: String,
    /// The rooms it joins.
    pub rooms: [RoomId; 2],
    /// Where it is.
    pub position_m: [f64; 3],
}

/// A checked map: every reference resolves, every number is finite, every id is unique.
#[derive(Debug, Clone, PartialEq)]
pub struct SemanticMap {
    /// The map's name.
    pub name: String,
    /// Rooms, in file order.
    pub rooms: Vec<Room>,
    /// Parts of rooms, in file order.
    pub parts: Vec<Part>,
    /// Groups of rooms, in file order.
    pub groups: Vec<Group>,
    /// Doors, in file order.
    pub doors: Vec<Door>,
    /// Distinct item labels, sorted.
    pub labels: Vec<String>,
    /// Items, in file order.
    pub items: Vec<Item>,
    /// Label to other words that mean the same, to bind activity programs.
    pub aliases: BTreeMap<String, Vec<String>>,
    /// SHA-256 of the canonical file content: which map a score belongs to.
    pub fingerprint: [u8; 32],
}
