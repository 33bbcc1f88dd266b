//! The partitions of a map at each level, and their names.

use std::collections::HashMap;

use super::{Partition, PartitionLevel};
use crate::semantic_map::{RoomId, SemanticMap};

pub(super) fn rooms_as_partitions(map: &SemanticMap) -> Vec<Partition> {
    (0u32..)
        .zip(&map.rooms)
        .map(|(index, room)| Partition {
            id: room.id.clone(),
            label: room.label.clone(),
            rooms: vec![RoomId(index)],
            spaces: vec![room.space.clone()],
        })
        .collect()
}

/// Unique display names of partitions, in their order: the label, or the id if several partitions share the label, as in a ward, or if the label is
/// the id of another partition that is shown by its id.
#[must_use]
pub fn partition_names(partitions: &[Partition]) -> Vec<String> {
    let mut by_id = vec![false; partitions.len()];
    loop {
        let name = |(partition, by_id): (&Partition, &bool)| {
            if *by_id { partition.id.clone() } else { partition.label.clone() }
        };
        let names: Vec<String> = partitions.iter().zip(&by_id).map(name).collect();
        let mut bearers = HashMap::<&str, usize>::new();
        names.iter().for_each(|name| *bearers.entry(name).or_default() += 1);
        let is_shared: Vec<bool> = names.iter().map(|name| bearers[name.as_str()] > 1).collect();
        let mut changes = false;
        for (by_id, shared) in by_id.iter_mut().zip(is_shared) {
            changes |= shared && !*by_id;
            *by_id |= shared;
        }
        if !changes {
            return names;
        }
    }
}

/// The partition with this id, or the only one in the room with this name ([`SemanticMap::find_one_room`]).
#[must_use]
pub fn partition_named<'a>(name: &str, map: &SemanticMap, partitions: &'a [Partition]) -> Option<&'a Partition> {
    let in_room = || {
        let room = map.find_one_room(name)?;
        let mut within = partitions.iter().filter(|partition| partition.rooms.contains(&room));
        within.next().filter(|_| within.next().is_none())
    };
    partitions.iter().find(|partition| partition.id == name).or_else(in_room)
}

/// The partitions of a map at a level, in their order in a [`super::Grounding`].
#[must_use]
pub fn partitions(map: &SemanticMap, level: PartitionLevel) -> Vec<Partition> {
    let rooms = rooms_as_partitions(map);
    match level {
        PartitionLevel::Room => rooms,
        PartitionLevel::Part => {
            let parts = |room: RoomId| map.parts.iter().filter(move |part| part.room == room);
            let divide = |room: Partition| {
                let id = room.rooms[0];
                let mut within: Vec<Partition> = parts(id)
                    .map(|part| Partition {
                        id: part.id.clone(),
                        label: part.label.clone(),
                        rooms: vec![id],
                        spaces: vec![part.space.clone()],
                    })
                    .collect();
                if within.is_empty() {
                    within.push(room);
                }
                within
            };
            rooms.into_iter().flat_map(divide).collect()
        }
        PartitionLevel::Group => {
            let grouped = |room: &Partition| map.groups.iter().any(|group| group.rooms.contains(&room.rooms[0]));
            let groups = map.groups.iter().map(|group| Partition {
                id: group.id.clone(),
                label: group.label.clone(),
                rooms: group.rooms.clone(),
                spaces: group.space.as_ref().map_or_else(
                    || group.rooms.iter().map(|room| map.rooms[room.0 as usize].space.clone()).collect(),
                    |space| vec![space.clone()],
                ),
            });
            groups.chain(rooms.iter().filter(|room| !grouped(room)).cloned()).collect()
        }
    }
}
