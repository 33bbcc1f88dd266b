//! The semantic map: labelled items with boxes, rooms, parts and groups of rooms; its file format, checks, changes and import.

use std::collections::{BTreeMap, VecDeque};

use crate::names::{Names, plain_words};

mod checks;
pub mod delta;
mod doors;
pub(crate) mod footprint;
pub mod import;
mod schema;
mod storeys;

pub use footprint::{Footprint, MAX_CORNERS, Space};
pub use schema::{MAX_FILE_BYTES, MAX_ITEMS, MAX_ROOMS, MAX_TEXT_BYTES, SceneError, read_limited};
pub(crate) use storeys::STOREY_M;
pub use storeys::{Storey, Storeys};

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

impl Box3 {
    /// Length along each axis, in metres.
    #[must_use]
    pub fn size_m(&self) -> [f64; 3] {
        std::array::from_fn(|axis| self.max_m[axis] - self.min_m[axis])
    }

    /// The middle of the box, in metres.
    #[must_use]
    pub fn centre_m(&self) -> [f64; 3] {
        std::array::from_fn(|axis| 0.5 * (self.min_m[axis] + self.max_m[axis]))
    }

    /// Volume in cubic metres; zero for a flat box.
    #[must_use]
    pub(crate) fn volume_m3(&self) -> f64 {
        self.size_m().iter().product()
    }

    /// V_o of the paper: the common volume of both boxes in cubic metres; zero if they only touch.
    #[must_use]
    pub(crate) fn overlap_m3(&self, other: &Self) -> f64 {
        let mut volume_m3 = 1.0;
        for axis in 0..3 {
            let length_m = self.max_m[axis].min(other.max_m[axis]) - self.min_m[axis].max(other.min_m[axis]);
            if length_m <= 0.0 {
                return 0.0;
            }
            volume_m3 *= length_m;
        }
        volume_m3
    }

    /// The smallest box around both.
    #[must_use]
    pub(crate) fn with(self, other: Self) -> Self {
        Self {
            min_m: std::array::from_fn(|axis| self.min_m[axis].min(other.min_m[axis])),
            max_m: std::array::from_fn(|axis| self.max_m[axis].max(other.max_m[axis])),
        }
    }

    /// Whether the point is in the box or on a face.
    #[must_use]
    pub fn contains(&self, point_m: &[f64; 3]) -> bool {
        (0..3).all(|axis| self.min_m[axis] <= point_m[axis] && point_m[axis] <= self.max_m[axis])
    }

    /// Distance in metres from the point to the nearest point of the box; zero inside.
    #[must_use]
    pub fn distance_m(&self, point_m: &[f64; 3]) -> f64 {
        let away = |axis: usize| (self.min_m[axis] - point_m[axis]).max(point_m[axis] - self.max_m[axis]).max(0.0);
        (0..3).map(|axis| away(axis).powi(2)).sum::<f64>().sqrt()
    }
}

/// One of several labels for an item, from a captioner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Caption {
    /// The caption as a label.
    pub label: LabelId,
    /// Share of the item; an item's weights sum to one.
    pub weight: f64,
}

/// A thing in the map.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// Unique name within the map.
    pub id: String,
    /// Its label.
    pub label: LabelId,
    /// Soft labels; empty for an item with a certain label.
    pub captions: Vec<Caption>,
    /// The item's position, in metres.
    pub position_m: [f64; 3],
    /// The item's box.
    pub bounds: Box3,
}

/// A room.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// Unique name within the map.
    pub id: String,
    /// Its words for a language model ("living room").
    pub label: String,
    /// The room's extent.
    pub space: Space,
}

/// The room of an item by the rules of grounding: the one with the largest overlap, else one that contains its position; of equal ones the last.
/// The boxes around footprints decide as soon as footprints have more edges than are `left` to look at.
pub(crate) fn room_of(rooms: &[Room], item: &Item, left: &mut usize) -> Option<usize> {
    const TIE: f64 = 1e-9;
    let mut is_exact = |edges: usize| {
        let rest = left.checked_sub(edges);
        *left = rest.unwrap_or(0);
        rest.is_some()
    };
    let mut most: Option<(usize, f64)> = None;
    for (room, Room { space, .. }) in rooms.iter().enumerate() {
        let exact = is_exact(space.edges_met(&item.bounds));
        let shared_m3 = if exact { space.overlap_m3(&item.bounds) } else { space.bounds.overlap_m3(&item.bounds) };
        if shared_m3 > 0.0 && most.is_none_or(|(_, most_m3)| shared_m3 >= most_m3 * (1.0 - TIE)) {
            most = Some((room, shared_m3));
        }
    }
    let holds = |Room { space, .. }: &Room| {
        let exact = is_exact(space.edges_at(&item.position_m));
        if exact { space.contains(&item.position_m) } else { space.bounds.contains(&item.position_m) }
    };
    most.map(|(room, _)| room).or_else(|| rooms.iter().rposition(holds))
}

/// A part of one room.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Unique name within the map.
    pub id: String,
    /// Its words.
    pub label: String,
    /// The room that contains it.
    pub room: RoomId,
    /// The part's extent.
    pub space: Space,
}

/// Several rooms that form one partition.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// Unique name within the map.
    pub id: String,
    /// Its words.
    pub label: String,
    /// The rooms of the group; groups are disjoint.
    pub rooms: Vec<RoomId>,
    /// The group's own extent; `None` for the extent of its rooms.
    pub space: Option<Space>,
}

/// A passage between two rooms.
#[derive(Debug, Clone, PartialEq)]
pub struct Door {
    /// Unique name within the map.
    pub id: String,
    /// The two rooms.
    pub rooms: [RoomId; 2],
    /// The door's position, in metres.
    pub position_m: [f64; 3],
}

/// A checked map: every reference resolves, every number is finite, every id is unique.
///
/// It comes from [`SemanticMap::load`] or [`SemanticMap::from_json`]; the format is documented in `scenes/README.md`.
#[derive(Debug, Clone, PartialEq)]
pub struct SemanticMap {
    pub(crate) name: String,
    pub(crate) description: String,
    pub(crate) source: String,
    pub(crate) rooms: Vec<Room>,
    pub(crate) parts: Vec<Part>,
    pub(crate) groups: Vec<Group>,
    pub(crate) doors: Vec<Door>,
    /// The doors were found and are not written to the file.
    pub(crate) doors_found: bool,
    pub(crate) labels: Vec<String>,
    pub(crate) items: Vec<Item>,
    pub(crate) aliases: BTreeMap<String, Vec<String>>,
    pub(crate) fingerprint: [u8; 32],
}

impl SemanticMap {
    /// The map's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Description of the home, for people.
    #[must_use]
    pub fn description(&self) -> &str {
        &self.description
    }

    /// Origin of the map, for people.
    #[must_use]
    pub fn source(&self) -> &str {
        &self.source
    }

    /// Rooms, in file order.
    #[must_use]
    pub fn rooms(&self) -> &[Room] {
        &self.rooms
    }

    /// Parts of rooms, in file order.
    #[must_use]
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// Groups of rooms, in file order.
    #[must_use]
    pub fn groups(&self) -> &[Group] {
        &self.groups
    }

    /// Doors, in file order. If the file has none, a door for every two rooms that touch.
    #[must_use]
    pub fn doors(&self) -> &[Door] {
        &self.doors
    }

    /// Whether the file has no doors, so that they were derived from touching rooms.
    #[must_use]
    pub fn doors_found(&self) -> bool {
        self.doors_found
    }

    /// Distinct item labels, captions included, sorted.
    #[must_use]
    pub fn labels(&self) -> &[String] {
        &self.labels
    }

    /// Items, in file order.
    #[must_use]
    pub fn items(&self) -> &[Item] {
        &self.items
    }

    /// Other words for a label or a room, for binding activity programs.
    #[must_use]
    pub fn aliases(&self) -> &BTreeMap<String, Vec<String>> {
        &self.aliases
    }

    /// SHA-256 of [`SemanticMap::to_json`]: identifies the map of a score.
    #[must_use]
    pub fn fingerprint(&self) -> [u8; 32] {
        self.fingerprint
    }

    /// The label for a name: the name's words themselves, else a label with this alias in the map, else the first of its aliases in the built-in
    /// table that is a label. Names may have a program's spelling ("coffe_maker").
    #[must_use]
    pub fn find_label(&self, name: &str) -> Option<LabelId> {
        self.find(name, |words| {
            let found = self.labels.binary_search_by(|label| label.as_str().cmp(words)).ok()?;
            u32::try_from(found).ok().map(LabelId)
        })
    }

    /// The first room whose id or label matches a name, looked up as by [`SemanticMap::find_label`]; an alias may also belong to one room's id. Then
    /// a room with this id in plain words, whatever the spelling of umlauts ("Büro 2" is `buro_2`). Last the only room of a kind by its name in
    /// another language ("Küche" is a kitchen); a longer name ("Küche oben") does not match the kind.
    #[must_use]
    pub fn find_room(&self, name: &str) -> Option<RoomId> {
        let place = |is_meant: &dyn Fn(&Room) -> bool| {
            let found = self.rooms.iter().position(is_meant)?;
            u32::try_from(found).ok().map(RoomId)
        };
        let only = |kind: &str| {
            let is_one = self.rooms.iter().filter(|room| room.label == kind).count() == 1;
            is_one.then(|| place(&|room| room.label == kind)).flatten()
        };
        let by_folded_id = || {
            let folded = Names::folded(name);
            place(&|room| Names::folded(&room.id) == folded)
        };
        place(&|room| room.id == name)
            .or_else(|| self.find(name, |words| place(&|room| room.label == words || room.id == words)))
            .or_else(by_folded_id)
            .or_else(|| only(Names::built_in().room_itself(name)?))
    }

    /// As [`SemanticMap::find_room`]. `None` if the name is the label of several rooms and not the id or alias of the found one.
    #[must_use]
    pub fn find_one_room(&self, name: &str) -> Option<RoomId> {
        let found = self.find_room(name)?;
        let own = &self.rooms[found.0 as usize];
        let plain = plain_words(name);
        let is_its_id = Names::folded(&own.id) == Names::folded(name);
        let is_its_alias = || self.aliases.get(&own.id).is_some_and(|own| own.contains(&plain));
        let is_one = || self.rooms.iter().filter(|other| other.label == own.label).count() == 1;
        (is_its_id || is_its_alias() || is_one()).then_some(found)
    }

    /// Display name of a room: its label if it is unique, else an alias of the room, else its id.
    #[must_use]
    pub fn room_name(&self, room: usize) -> &str {
        let own = &self.rooms[room];
        let is_only = self.rooms.iter().filter(|other| other.label == own.label).count() == 1;
        let alias = || self.aliases.get(&own.id).and_then(|names| names.first());
        if is_only { &own.label } else { alias().unwrap_or(&own.id) }
    }

    /// Name of a room for use in files: its id, or its display name if the id consists of 32 digits, as in Home Assistant before 2022.
    #[must_use]
    pub fn room_key(&self, room: usize) -> &str {
        const DIGITS: usize = 32;
        let id = &self.rooms[room].id;
        let is_digits = id.len() == DIGITS && id.chars().all(|c| c.is_ascii_hexdigit());
        let name = self.room_name(room);
        if is_digits && self.find_one_room(name).is_some_and(|found| found.0 as usize == room) { name } else { id }
    }

    fn find<T>(&self, name: &str, known: impl Fn(&str) -> Option<T>) -> Option<T> {
        let plain = plain_words(name);
        let words = Names::built_in().words(name);
        let own_aliases = || {
            let means = |others: &[String]| others.iter().any(|other| *other == plain || *other == words);
            self.aliases.iter().filter(move |(_, others)| means(others)).find_map(|(label, _)| known(label))
        };
        known(&plain)
            .or_else(|| known(&words))
            .or_else(own_aliases)
            .or_else(|| Names::built_in().aliases(&words).find_map(&known))
    }

    /// The items with this label or caption, in file order.
    pub fn items_of(&self, label: LabelId) -> impl Iterator<Item = ItemId> {
        (0u32..).zip(&self.items).filter_map(move |(index, item)| {
            let bears = item.label == label || item.captions.iter().any(|caption| caption.label == label);
            bears.then_some(ItemId(index))
        })
    }

    /// The rooms that contain the point, in file order. There are several if rooms overlap.
    pub fn rooms_at(&self, position_m: [f64; 3]) -> impl Iterator<Item = RoomId> {
        (0u32..)
            .zip(&self.rooms)
            .filter(move |(_, room)| room.space.contains(&position_m))
            .map(|(index, _)| RoomId(index))
    }

    /// The rooms on a shortest way through doors, both ends included. `None` if there is no way.
    #[must_use]
    pub fn path(&self, from: RoomId, to: RoomId) -> Option<Vec<RoomId>> {
        let mut reached_from = BTreeMap::from([(from, from)]);
        let mut waiting = VecDeque::from([from]);
        while let Some(room) = waiting.pop_front() {
            if room == to {
                let mut path = vec![to];
                let mut here = to;
                while here != from {
                    here = *reached_from.get(&here)?;
                    path.push(here);
                }
                path.reverse();
                return Some(path);
            }
            let neighbours = self.doors.iter().filter_map(|door| match door.rooms {
                [here, there] | [there, here] if here == room => Some(there),
                _ => None,
            });
            for next in neighbours {
                reached_from.entry(next).or_insert_with(|| {
                    waiting.push_back(next);
                    room
                });
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map() -> SemanticMap {
        SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap()
    }

    #[test]
    fn labels_are_found_by_words_names_and_aliases() {
        let map = map();
        let label = |name: &str| map.find_label(name).map(|LabelId(index)| map.labels[index as usize].as_str());
        assert_eq!(label("coffee maker"), Some("coffee maker"));
        assert_eq!(label("coffe_maker"), Some("coffee maker"));
        assert_eq!(label("Sofa"), Some("sofa"));
        assert_eq!(label("settee"), Some("sofa"), "the map's own alias");
        assert_eq!(label("couch"), Some("sofa"), "the built-in alias");
        assert_eq!(label("elephant"), None);
    }

    #[test]
    fn rooms_are_found_by_place_and_name() {
        let map = map();
        assert_eq!(map.rooms_at([1.0, 1.0, 1.0]).collect::<Vec<_>>(), [RoomId(0)]);
        assert_eq!(map.rooms_at([4.0, 1.0, 1.0]).collect::<Vec<_>>(), [RoomId(0), RoomId(1)], "the shared face");
        assert_eq!(map.rooms_at([4.0, 1.0, 9.0]).count(), 0);
        assert_eq!(map.find_room("living_room"), Some(RoomId(1)));
        assert_eq!(map.find_room("livingroom"), Some(RoomId(1)));
        assert_eq!(map.find_room("kuche"), Some(RoomId(0)), "by another language");
        assert_eq!(map.find_room("attic"), None);
        for name in ["Küche oben", "kuche_2", "Wohnküche der Nachbarn"] {
            assert_eq!(map.find_room(name), None, "{name} is not known to be the one kitchen");
        }
    }

    /// Topic levels are compared in plain words, with spaces for underscores.
    #[test]
    fn every_room_is_found_by_its_id_in_plain_words() {
        let mut map = map();
        for ids in [
            ["olga_s_kuche", "wz_2"],
            ["Büro Oma", "gaeste_wc"],
            ["kitchen-16", "Bad_OG-3"],
            ["wohnzimmer", "wohnzimmer_2"],
            ["a--b", "_c_"],
        ] {
            for (room, id) in map.rooms.iter_mut().zip(ids) {
                room.id = id.to_owned();
            }
            for (index, id) in (0..).zip(ids) {
                for name in [id.to_owned(), id.replace('_', " "), plain_words(id)] {
                    assert_eq!(map.find_room(&name), Some(RoomId(index)), "{name:?} of {id:?}");
                }
            }
        }
        (map.rooms[0].id, map.rooms[1].id) = ("buro_oma".to_owned(), "gaste_wc".to_owned());
        for (name, index) in [("Büro Oma", 0), ("buero-oma", 0), ("Gäste WC", 1), ("GAESTE_WC", 1)] {
            assert_eq!(map.find_one_room(name), Some(RoomId(index)), "{name:?}");
        }
    }

    #[test]
    fn ways_lead_through_doors() {
        let mut map = map();
        assert_eq!(map.path(RoomId(0), RoomId(1)), Some(vec![RoomId(0), RoomId(1)]));
        assert_eq!(map.path(RoomId(1), RoomId(1)), Some(vec![RoomId(1)]));
        map.doors.clear();
        assert_eq!(map.path(RoomId(0), RoomId(1)), None);
    }

    #[test]
    fn boxes_measure_themselves_and_each_other() {
        let unit = Box3 { min_m: [0.0; 3], max_m: [1.0; 3] };
        let half = Box3 { min_m: [0.5, 0.0, 0.0], max_m: [1.5, 1.0, 1.0] };
        let touching = Box3 { min_m: [1.0, 0.0, 0.0], max_m: [2.0, 1.0, 1.0] };
        assert_eq!(unit.overlap_m3(&half), 0.5);
        assert_eq!(unit.overlap_m3(&touching), 0.0);
        assert_eq!(unit.distance_m(&[4.0, 5.0, 0.5]), 5.0);
        assert_eq!(unit.distance_m(&[0.5; 3]), 0.0);
    }
}
