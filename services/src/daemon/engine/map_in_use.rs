//! The map in use: which room a text names.

use std::collections::BTreeSet;

use roomcast_core::grounding::{Grounding, GroundingOptions, Partition};
use roomcast_core::places::PlaceMatcher;
use roomcast_core::semantic_map::SemanticMap;

use roomcast_ipc::raw::{MAX_ROOMS, RoomV1};
use roomcast_ipc::text;

use super::EngineError;

/// Most unknown room names that are logged, until the map changes.
const UNKNOWN_ROOMS_LOGGED: usize = 16;

#[derive(Debug)]
pub(super) struct MapInUse {
    pub(super) map: SemanticMap,
    pub(super) options: GroundingOptions,
    pub(super) matcher: PlaceMatcher,
    /// The rooms of a changed map, until a step has scored them. Until then the snapshot and the forecasts are for the previous map.
    pub(super) next_rooms: Option<Box<NamedRooms>>,
    /// Room names that the map lacks, once they were logged.
    unknown_rooms: BTreeSet<String>,
}

impl MapInUse {
    pub(super) fn new(map: SemanticMap, options: GroundingOptions, grounding: &Grounding) -> Self {
        let matcher = PlaceMatcher::new(&map, grounding);
        Self { map, options, matcher, next_rooms: None, unknown_rooms: BTreeSet::new() }
    }

    /// Replaces the map by one with this grounding. Its rooms are published after the first good step.
    pub(super) fn change(&mut self, map: SemanticMap, rooms: NamedRooms, grounding: &Grounding) {
        *self = Self { next_rooms: Some(Box::new(rooms)), ..Self::new(map, self.options, grounding) };
    }

    /// Whether the scores are for this map: false until the first scores of a changed map.
    pub(super) fn is_scored(&self) -> bool {
        self.next_rooms.is_none()
    }

    /// The first bytes of the map's fingerprint.
    pub(super) fn number(&self) -> u64 {
        let fingerprint = self.map.fingerprint();
        fingerprint.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    /// The partition that a room's name means.
    pub(super) fn room(&self, name: &str, grounding: &Grounding) -> Option<usize> {
        room_named(name, &self.map, grounding)
    }

    /// Logs a room name that the map lacks, once.
    pub(super) fn note_room(&mut self, room: &str, grounding: &Grounding, effect: &str) {
        let is_unknown = self.is_scored() && self.room(room, grounding).is_none();
        if is_unknown && self.unknown_rooms.len() < UNKNOWN_ROOMS_LOGGED && self.unknown_rooms.insert(room.to_owned()) {
            let rooms: Vec<&str> = grounding.partitions().iter().map(|room| room.id.as_str()).collect();
            tracing::warn!(
                room,
                rooms = rooms.join(", "),
                "the map has no single room of this name: {effect}; correct the narrator, with a room's id, or the scene"
            );
        }
    }
}

/// The partition that a room's name means: by its own name, or as the one that contains the room. `None` if several match.
pub(super) fn room_named(name: &str, map: &SemanticMap, grounding: &Grounding) -> Option<usize> {
    let partitions = grounding.partitions();
    if let Some(with_id) = partitions.iter().position(|partition| partition.id == name) {
        return Some(with_id);
    }
    let mut alike = rooms_alike(name, grounding);
    if let Some(first) = alike.next() {
        return alike.next().is_none().then_some(first);
    }
    let room = map.find_one_room(name)?;
    let mut within = (0..).zip(partitions).filter(|(_, partition)| partition.rooms.contains(&room));
    let (only, _) = within.next()?;
    // A room that is divided into several partitions is none of them.
    within.next().is_none().then_some(only)
}

pub(super) fn rooms_alike<'a>(name: &'a str, grounding: &'a Grounding) -> impl Iterator<Item = usize> + 'a {
    (0..).zip(grounding.partitions()).filter(move |(_, partition)| partition.label == name).map(|(at, _)| at)
}

/// The rooms of a message, and their number.
pub(super) type NamedRooms = ([RoomV1; MAX_ROOMS], u32);

pub(super) fn named_rooms(partitions: &[Partition]) -> Result<NamedRooms, EngineError> {
    if partitions.len() > MAX_ROOMS {
        return Err(EngineError::TooManyPartitions { partitions: partitions.len() });
    }
    let mut rooms = [RoomV1::default(); MAX_ROOMS];
    for (room, partition) in rooms.iter_mut().zip(partitions) {
        let name = |source| EngineError::Name { id: partition.id.clone(), source };
        room.id = text::encode("room id", &partition.id).map_err(name)?;
    }
    Ok((rooms, partitions.len() as u32))
}
