//! Finds the room of a report: by its id, its name in the map, or the robot's position on the map.

use roomcast_core::grounding::{Partition, PartitionLevel, partition_named, partitions};
use roomcast_core::semantic_map::{Door, SemanticMap, Storeys};
use roomcast_ipc::raw::{RoomScoresV1, RoomV1};

use super::facts::Near;

#[derive(Debug)]
pub(super) struct Places {
    map: SemanticMap,
    partitions: Vec<Partition>,
    /// The daemon that has scored this map, or one with the same rooms. If it changes its rooms later, the remaining ones keep their places.
    epoch: Option<u64>,
    /// The log says that the maps differ in things, doors or shapes.
    is_warned: bool,
}

impl Places {
    pub(super) fn new(map: SemanticMap, level: PartitionLevel) -> Self {
        let partitions = partitions(&map, level);
        Self { map, partitions, epoch: None, is_warned: false }
    }

    pub(super) fn see(&mut self, scores: &RoomScoresV1) {
        if self.epoch == Some(scores.epoch) {
            return;
        }
        let is_same = self.map.fingerprint() == scores.map_fingerprint;
        let rooms = scores.rooms().iter().map(RoomV1::id);
        if !is_same && !rooms.eq(self.partitions.iter().map(|own| own.id.as_str())) {
            return;
        }
        if !is_same && !std::mem::replace(&mut self.is_warned, true) {
            tracing::warn!(
                "the daemon's map has the same rooms and is another one: doors and shapes come from the planner's scene.path; start both with one file if these differ"
            );
        }
        self.epoch = Some(scores.epoch);
    }

    /// Whether this map fits the rooms of these scores.
    pub(super) fn fits(&self, scores: &RoomScoresV1) -> bool {
        self.epoch == Some(scores.epoch)
    }

    pub(super) fn at(&self, position_m: [f64; 3], scores: &RoomScoresV1) -> Option<usize> {
        let holds = |room: &RoomV1| {
            let own = self.partitions.iter().find(|partition| partition.id == room.id());
            own.is_some_and(|partition| partition.spaces.iter().any(|bounds| bounds.contains(&position_m)))
        };
        scores.rooms().iter().position(holds)
    }

    /// For each of the scores' rooms the rooms next to it and on its floor.
    pub(super) fn near(&self, scores: &RoomScoresV1) -> Vec<Near> {
        let storeys = Storeys::of(&self.map);
        let own = |room: &RoomV1| self.partitions.iter().find(|partition| partition.id == room.id());
        let own: Vec<Option<&Partition>> = scores.rooms().iter().map(own).collect();
        let is_beside = |a: &Partition, b: &Partition| {
            let joins = |door: &Door| {
                door.rooms.iter().any(|room| a.rooms.contains(room))
                    && door.rooms.iter().any(|room| b.rooms.contains(room))
            };
            a.rooms.iter().any(|room| b.rooms.contains(room)) || self.map.doors().iter().any(joins)
        };
        let floor = |partition: &Partition| partition.spaces.first().map(|space| storeys.of_space(space));
        let of = |room: usize, is_near: &dyn Fn(&Partition, &Partition) -> bool| {
            // A room that this map lacks may be near every other.
            let near = |other: &usize| *other == room || own[room].zip(own[*other]).is_none_or(|(a, b)| is_near(a, b));
            (0..own.len().min(64)).filter(near).fold(0, |set, other| set | 1 << other)
        };
        let near = |room| Near { beside: of(room, &is_beside), floor: of(room, &|a, b| floor(a) == floor(b)) };
        (0..own.len()).map(near).collect()
    }

    /// The scores' room with a name on this map; `None` if the name fits several.
    pub(super) fn named(&self, name: &str, scores: &RoomScoresV1) -> Option<usize> {
        let own = self.id(name)?;
        scores.rooms().iter().position(|room| room.id() == own)
    }

    /// The id of the scores' room with a name on this map.
    pub(super) fn id(&self, name: &str) -> Option<&str> {
        partition_named(name, &self.map, &self.partitions).map(|own| own.id.as_str())
    }
}
