//! Binds the objects of an activity program to items of a map.
//!
//! An object's name binds to a label through the map's aliases and the built-in table of names ([`SemanticMap::find_label`]), or to a room
//! of that name. A program does not say which of the label's items it means: [`ItemChoice`] decides. One identifier (name and number) keeps
//! its item throughout a program.

use std::collections::HashMap;

use sha2::{Digest, Sha256};

use roomcast_core::grounding::Grounding;
use roomcast_core::names::Names;
use roomcast_core::narration::ObjectRef;
use roomcast_core::semantic_map::{ItemId, PartitionId, RoomId, SemanticMap};

roomcast_core::choices! {
    /// How one of several items of a label is chosen.
    #[derive(Default)]
    pub enum ItemChoice {
        /// By a seeded draw, each with the same chance: no scene says which chair is meant, and Equation 2 shares a label's
        /// score equally among its items.
        #[default]
        Uniform,
        /// The one nearest to the person.
        Nearest,
        /// The first in the scene file.
        First,
    }
}

/// The place of an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Index of its label among [`Grounding::scored_labels`]; `None` for a room while room names are no labels.
    pub label: Option<usize>,
    /// The item; `None` for a room.
    pub item: Option<ItemId>,
    /// The partition that contains it, if any.
    pub partition: Option<PartitionId>,
    /// Its position; for a room, the middle of its floor.
    pub position_m: [f64; 3],
}

#[derive(Debug, Clone)]
struct Candidates {
    label: Option<usize>,
    items: Vec<ItemId>,
    room: Option<RoomId>,
}

/// Binds objects to places of one map.
#[derive(Debug, Clone)]
pub struct Binder<'a> {
    map: &'a SemanticMap,
    grounding: &'a Grounding,
    choice: ItemChoice,
    label_of_text: HashMap<&'a str, usize>,
    candidates: HashMap<String, Option<Candidates>>,
    bound: HashMap<ObjectRef, Option<Place>>,
    stream: u64,
}

impl<'a> Binder<'a> {
    /// A new binder. `grounding` must be of `map`.
    #[must_use]
    pub fn new(map: &'a SemanticMap, grounding: &'a Grounding, choice: ItemChoice) -> Self {
        let labels = grounding.scored_labels().iter().enumerate();
        Self {
            map,
            grounding,
            choice,
            label_of_text: labels.map(|(index, label)| (label.text.as_str(), index)).collect(),
            candidates: HashMap::new(),
            bound: HashMap::new(),
            stream: 0,
        }
    }

    /// Forgets all bindings and begins another program. Its draws follow from `seed` and `name` alone.
    pub fn begin(&mut self, seed: u64, name: &str) {
        self.bound.clear();
        self.stream = stable_hash(&[&seed.to_le_bytes(), name.as_bytes()]);
    }

    /// The label of a name, as an index of [`Grounding::scored_labels`].
    pub fn label(&mut self, name: &str) -> Option<usize> {
        self.candidates(name).and_then(|candidates| candidates.label)
    }

    /// The place of an object; `None` if the map has no label for it. `from_m` is the person's position, for [`ItemChoice::Nearest`].
    pub fn bind(&mut self, object: &ObjectRef, from_m: [f64; 3]) -> Option<Place> {
        if let Some(known) = self.bound.get(object) {
            return *known;
        }
        let (choice, stream, map, grounding) = (self.choice, self.stream, self.map, self.grounding);
        let place = self.candidates(&object.name).and_then(|candidates| {
            if let Some(room) = candidates.room {
                return Some(room_place(map, grounding, room, candidates.label));
            }
            let items = &candidates.items;
            let item = match choice {
                ItemChoice::First => *items.first()?,
                ItemChoice::Uniform => {
                    let draw = stable_hash(&[&stream.to_le_bytes(), object.name.as_bytes(), &object.id.to_le_bytes()]);
                    *items.get((draw % items.len().max(1) as u64) as usize)?
                }
                ItemChoice::Nearest => nearest(map, items, from_m)?,
            };
            Some(item_place(map, grounding, item, candidates.label))
        });
        self.bound.insert(object.clone(), place);
        place
    }

    /// All possible places of an object's name, for a person at `from_m` if that is given.
    pub fn places(&mut self, name: &str, from_m: Option<[f64; 3]>) -> Vec<Place> {
        let (choice, map, grounding) = (self.choice, self.map, self.grounding);
        let Some(candidates) = self.candidates(name) else { return Vec::new() };
        if let Some(room) = candidates.room {
            return vec![room_place(map, grounding, room, candidates.label)];
        }
        let place = |item: &ItemId| item_place(map, grounding, *item, candidates.label);
        match (choice, from_m) {
            (ItemChoice::Nearest, Some(from_m)) => nearest(map, &candidates.items, from_m).iter().map(place).collect(),
            (ItemChoice::First, _) => candidates.items.first().map(place).into_iter().collect(),
            _ => candidates.items.iter().map(place).collect(),
        }
    }

    fn candidates(&mut self, name: &str) -> Option<&Candidates> {
        if !self.candidates.contains_key(name) {
            let found = self.look_up(name);
            self.candidates.insert(name.to_owned(), found);
        }
        self.candidates.get(name)?.as_ref()
    }

    /// A room's own name first, then the items' labels with all aliases, then rooms by alias.
    fn look_up(&self, name: &str) -> Option<Candidates> {
        let words = Names::built_in().words(name);
        let by_room = |room: RoomId| {
            let text = self.map.rooms()[room.0 as usize].label.as_str();
            Candidates { label: self.label_of_text.get(text).copied(), items: Vec::new(), room: Some(room) }
        };
        let own_room = self.map.rooms().iter().position(|room| room.label == words);
        if let Some(room) = own_room.and_then(|index| u32::try_from(index).ok()) {
            return Some(by_room(RoomId(room)));
        }
        if let Some(label) = self.map.find_label(name) {
            let text = self.map.labels()[label.0 as usize].as_str();
            let items: Vec<_> = self.map.items_of(label).collect();
            if !items.is_empty() {
                return Some(Candidates { label: self.label_of_text.get(text).copied(), items, room: None });
            }
        }
        self.map.find_room(name).map(by_room)
    }
}

fn nearest(map: &SemanticMap, items: &[ItemId], from_m: [f64; 3]) -> Option<ItemId> {
    let far = |item: ItemId| distance_m(map.items()[item.0 as usize].position_m, from_m);
    items.iter().copied().min_by(|a, b| far(*a).total_cmp(&far(*b)))
}

fn item_place(map: &SemanticMap, grounding: &Grounding, item: ItemId, label: Option<usize>) -> Place {
    Place {
        label,
        item: Some(item),
        partition: grounding.item_partition()[item.0 as usize],
        position_m: map.items()[item.0 as usize].position_m,
    }
}

fn room_place(map: &SemanticMap, grounding: &Grounding, room: RoomId, label: Option<usize>) -> Place {
    let space = &map.rooms()[room.0 as usize].space;
    let [x, y, _] = space.centre_m();
    let partition = grounding.partitions().iter().position(|partition| partition.rooms.contains(&room));
    Place {
        label,
        item: None,
        partition: partition.and_then(|index| u32::try_from(index).ok()).map(PartitionId),
        position_m: [x, y, space.bounds.min_m[2]],
    }
}

/// Distance in the plane, since people walk on floors.
#[must_use]
pub fn distance_m(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// A hash of the parts, the same on every machine and in every run.
#[must_use]
pub fn stable_hash(parts: &[&[u8]]) -> u64 {
    let mut hasher = Sha256::new();
    for part in parts {
        hasher.update((part.len() as u64).to_le_bytes());
        hasher.update(part);
    }
    let digest = hasher.finalize();
    digest.iter().take(8).fold(0, |number, byte| number << 8 | u64::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;

    fn object(name: &str, id: u32) -> ObjectRef {
        ObjectRef { name: name.into(), id }
    }

    #[test]
    fn objects_bind_to_labels_rooms_or_nothing() {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::Uniform);
        binder.begin(1, "p");
        let kitchen = binder.bind(&object("kitchen", 1), [0.0; 3]).unwrap();
        assert_eq!(grounding.partitions()[kitchen.partition.unwrap().0 as usize].id, "kitchen");
        assert_eq!(grounding.scored_labels()[kitchen.label.unwrap()].text, "kitchen");
        let sofa = binder.bind(&object("couch", 1), [0.0; 3]).unwrap();
        assert_eq!(grounding.scored_labels()[sofa.label.unwrap()].text, "sofa");
        assert_eq!(binder.bind(&object("spaceship", 1), [0.0; 3]), None);
    }

    #[test]
    fn one_identifier_keeps_its_item_and_others_spread() {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::Uniform);
        binder.begin(1, "p");
        let first = binder.bind(&object("chair", 1), [0.0; 3]);
        assert_eq!(binder.bind(&object("chair", 1), [9.0; 3]), first);
        let items: std::collections::BTreeSet<_> =
            (0..200).map(|id| binder.bind(&object("chair", id), [0.0; 3]).unwrap().item).collect();
        let chair = map.find_label("chair").unwrap();
        assert_eq!(items.len(), map.items_of(chair).count());
        let mut nearest = Binder::new(&map, &grounding, ItemChoice::Nearest);
        let at = map.items()[map.items_of(chair).last().unwrap().0 as usize].position_m;
        assert_eq!(distance_m(nearest.bind(&object("chair", 1), at).unwrap().position_m, at), 0.0);
    }
}
