//! Which room a report speaks of: by its id, by its name in the map, or by the robot's position on the map.

use roomcast_core::grounding::{Partition, PartitionLevel, partitions};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::{RoomScoresV1, RoomV1};

/// The planner's own copy of the map.
#[derive(Debug)]
pub(super) struct Places {
    map: SemanticMap,
    partitions: Vec<Partition>,
    /// The daemon that has scored this very map: a map that it changes afterwards keeps the places of the rooms that stay.
    epoch: Option<u64>,
}

impl Places {
    pub(super) fn new(map: SemanticMap, level: PartitionLevel) -> Self {
        let partitions = partitions(&map, level);
        Self { map, partitions, epoch: None }
    }

    /// Takes note of which map the scores are of.
    pub(super) fn see(&mut self, scores: &RoomScoresV1) {
        if self.map.fingerprint() == scores.map_fingerprint {
            self.epoch = Some(scores.epoch);
        }
    }

    /// Whether positions and names on this map mean the rooms of these scores.
    pub(super) fn fits(&self, scores: &RoomScoresV1) -> bool {
        self.epoch == Some(scores.epoch)
    }

    /// The scores' room that holds a position.
    pub(super) fn at(&self, position_m: [f64; 3], scores: &RoomScoresV1) -> Option<usize> {
        let holds = |room: &RoomV1| {
            let own = self.partitions.iter().find(|partition| partition.id == room.id());
            own.is_some_and(|partition| partition.spaces.iter().any(|bounds| bounds.contains(&position_m)))
        };
        scores.rooms().iter().position(holds)
    }

    /// The scores' room that a name means on this map: of several in one room, none.
    pub(super) fn named(&self, name: &str, scores: &RoomScoresV1) -> Option<usize> {
        let room = self.map.find_one_room(name)?;
        let mut within = self.partitions.iter().filter(|partition| partition.rooms.contains(&room));
        let only = within.next().filter(|_| within.next().is_none())?;
        scores.rooms().iter().position(|room| room.id() == only.id)
    }
}
