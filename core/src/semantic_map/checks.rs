//! The rules of scenes: limits, ids, labels, numbers and references. A file becomes a map only if it breaks none.

use std::collections::{BTreeSet, HashMap};
use std::fmt::Display;

use sha2::{Digest, Sha256};

use super::footprint::{FEWER_CORNERS, Footprint, MAX_CORNERS, Space};
use super::schema::{
    CaptionEntry, DoorEntry, Extent, FARTHEST_M, FAULTS_MAX, FORMAT, GroupEntry, ItemEntry, MAX_ALIASES, MAX_CAPTIONS,
    MAX_ITEMS, MAX_PROSE_BYTES, MAX_ROOMS, MAX_TEXT_BYTES, PartEntry, ROOM_HEIGHT_M, Rings, RoomEntry, SHARE_MIN,
    SceneError, SceneFile, VERSION,
};
use super::{Box3, Caption, Door, Group, Item, LabelId, Part, Room, RoomId, SemanticMap, doors};
use crate::text::{excerpt, is_hidden};

/// Largest difference between a box and its footprint, in metres: numbers are rounded.
const ROUNDED_M: f64 = 0.01;

#[derive(Clone, Copy)]
struct Place<'a> {
    list: &'static str,
    index: usize,
    id: &'a str,
}

impl Place<'_> {
    fn error(self, field: &'static str, problem: impl Into<String>, remedy: &'static str) -> SceneError {
        let id: String = self.id.chars().take(MAX_TEXT_BYTES).collect();
        SceneError::Element {
            element: format!("{}[{}] ({id:?})", self.list, self.index),
            field,
            problem: excerpt(&problem.into()).into_owned(),
            remedy,
        }
    }

    /// Refuses the element unless the rule holds.
    fn ensure(
        self,
        holds: bool,
        field: &'static str,
        problem: impl Display,
        remedy: &'static str,
    ) -> Result<(), SceneError> {
        if holds { Ok(()) } else { Err(self.error(field, problem.to_string(), remedy)) }
    }

    fn label(self, label: &str) -> Result<(), SceneError> {
        let remedy = "write lower-case words separated by single spaces, as \"washing machine\"";
        check_label(label).map_err(|problem| self.error("label", problem, remedy))
    }

    fn point(self, field: &'static str, point_m: &[f64; 3]) -> Result<(), SceneError> {
        // This form also refuses NaN.
        let is_near = point_m.iter().all(|metres| metres.abs() <= FARTHEST_M);
        let problem = format_args!("{point_m:?} lies farther than 10 km from the origin");
        self.ensure(is_near, field, problem, "give metres and move the origin into the building")
    }

    fn bounds(self, bounds: &Box3) -> Result<(), SceneError> {
        self.point("box", &bounds.min_m)?;
        self.point("box", &bounds.max_m)?;
        let is_box = (0..3).all(|axis| bounds.min_m[axis] <= bounds.max_m[axis]);
        let problem = format_args!("min_m {:?} exceeds max_m {:?}", bounds.min_m, bounds.max_m);
        self.ensure(is_box, "box", problem, "give the least corner as min_m and the greatest as max_m")
    }

    fn captions(self, entry: &ItemEntry) -> Result<(), SceneError> {
        let captions = &entry.captions;
        let problem = format_args!("{} entries, more than {MAX_CAPTIONS}", captions.len());
        self.ensure(captions.len() <= MAX_CAPTIONS, "captions", problem, "keep the heaviest")?;
        let total: f64 = captions.iter().map(|caption| caption.weight).sum();
        for (index, CaptionEntry { label, weight }) in captions.iter().enumerate() {
            self.label(label)?;
            // Within these bounds no sum or share overflows or underflows; NaN fails, too.
            let problem = format_args!("the weight {weight} is not between 1e-9 and 1e9");
            let remedy = "give a positive weight or remove the caption";
            self.ensure((1e-9..=1e9).contains(weight), "captions", problem, remedy)?;
            // Files contain the shares, so they must be large enough to be read back.
            let problem = format_args!("the weight {weight} is less than {SHARE_MIN} of all");
            self.ensure(weight / total.max(1.0) >= SHARE_MIN, "captions", problem, "remove the caption")?;
            let is_new = captions[..index].iter().all(|earlier| earlier.label != *label);
            self.ensure(is_new, "captions", format_args!("has {label:?} twice"), "add the weights up in one entry")?;
        }
        let has_own = captions.is_empty() || captions.iter().any(|caption| caption.label == entry.label);
        let problem = format_args!("{:?} is not among its captions", entry.label);
        self.ensure(has_own, "label", problem, "make it the heaviest caption")
    }
}

fn check_text(text: &str, longest_bytes: usize) -> Result<(), String> {
    if text.is_empty() { Err("is empty".to_owned()) } else { check_prose(text, longest_bytes) }
}

fn check_prose(text: &str, longest_bytes: usize) -> Result<(), String> {
    if text.len() > longest_bytes {
        return Err(format!("is {} bytes long, more than {longest_bytes}", text.len()));
    }
    match text.chars().find(|character| is_hidden(*character)) {
        Some(character) => Err(format!("has the control character {character:?}")),
        None => Ok(()),
    }
}

pub(super) fn check_label(label: &str) -> Result<(), String> {
    check_text(label, MAX_TEXT_BYTES)?;
    if label.split(' ').any(|word| word.is_empty() || word.contains(char::is_whitespace)) {
        return Err(format!("{label:?} has spaces at an end or side by side"));
    }
    if label.to_lowercase() != label {
        return Err(format!("{label:?} has capital letters"));
    }
    Ok(())
}

pub(super) fn check_count(list: &'static str, count: usize, most: usize) -> Result<(), SceneError> {
    if count <= most {
        return Ok(());
    }
    Err(SceneError::Element {
        element: "scene".to_owned(),
        field: list,
        problem: format!("{count} entries, more than {most}"),
        remedy: "split the building into several maps",
    })
}

/// Checks an element's id alone, for callers that use ids before the whole map is checked.
pub(super) fn check_id(list: &'static str, index: usize, id: &str) -> Result<(), SceneError> {
    let place = Place { list, index, id };
    check_text(id, MAX_TEXT_BYTES).map_err(|problem| place.error("id", problem, "give every element a short id"))
}

fn index_u32(index: usize) -> u32 {
    u32::try_from(index).unwrap_or(u32::MAX)
}

/// Ids of one kind of element, to resolve references; refuses duplicates.
#[derive(Default)]
struct Ids<'a>(HashMap<&'a str, usize>);

impl<'a> Ids<'a> {
    fn insert(&mut self, place: Place<'a>) -> Result<(), SceneError> {
        check_id(place.list, place.index, place.id)?;
        let is_new = self.0.insert(place.id, place.index).is_none();
        place.ensure(is_new, "id", "is used twice", "give every element an id of its own")
    }
}

/// Collects the valid entries and the faults of the others. It stops after [`FAULTS_MAX`] faults.
fn each<T, U>(
    faults: &mut Vec<SceneError>,
    entries: impl IntoIterator<Item = T>,
    mut check: impl FnMut(usize, T) -> Result<U, SceneError>,
) -> Vec<U> {
    let mut good = Vec::new();
    for (index, entry) in entries.into_iter().enumerate() {
        if faults.len() >= FAULTS_MAX {
            break;
        }
        match check(index, entry) {
            Ok(checked) => good.push(checked),
            Err(fault) => faults.push(fault),
        }
    }
    good
}

impl SemanticMap {
    pub(super) fn check(file: SceneFile) -> Result<Self, SceneError> {
        if file.format != FORMAT || !(1..=VERSION).contains(&file.version) {
            let format = file.format.chars().take(MAX_TEXT_BYTES).collect();
            return Err(SceneError::Format { format, version: file.version });
        }
        let scene = Place { list: "scene", index: 0, id: &file.name };
        for (list, count, most) in [
            ("rooms", file.rooms.len(), MAX_ROOMS),
            ("parts", file.parts.len(), 10 * MAX_ROOMS),
            ("groups", file.groups.len(), 10 * MAX_ROOMS),
            ("doors", file.doors.len(), 10 * MAX_ROOMS),
            ("items", file.items.len(), MAX_ITEMS),
            // A label without other words counts, too.
            ("aliases", file.aliases.values().map(|others| others.len().max(1)).sum(), MAX_ALIASES),
        ] {
            check_count(list, count, most)?;
        }
        scene.ensure(!file.rooms.is_empty(), "rooms", "has no entry", "give at least one room")?;

        let mut faults = Vec::new();
        let texts = [
            ("name", check_text(&file.name, MAX_TEXT_BYTES), "give a short name"),
            ("description", check_prose(&file.description, MAX_PROSE_BYTES), "shorten it to one line"),
            ("source", check_prose(&file.source, MAX_PROSE_BYTES), "shorten it to one line"),
        ];
        each(&mut faults, texts, |_, (field, checked, remedy)| {
            checked.map_err(|problem| scene.error(field, problem, remedy))
        });
        let mut partitions = Partitions {
            ids: Ids::default(),
            rooms: Vec::new(),
            room_ids: Ids::default(),
            version: file.version,
            corners_left: MAX_CORNERS,
        };
        partitions.rooms = each(&mut faults, &file.rooms, |index, entry| partitions.room(index, entry));
        let (mut parts, mut groups, mut doors) = (Vec::new(), Vec::new(), Vec::new());
        if partitions.rooms.len() == file.rooms.len() {
            parts = each(&mut faults, &file.parts, |index, entry| partitions.part(index, entry));
            let mut grouped = BTreeSet::new();
            groups = each(&mut faults, &file.groups, |index, entry| partitions.group(index, entry, &mut grouped));
            let mut ids = Ids::default();
            doors = each(&mut faults, &file.doors, |index, entry| partitions.door(index, entry, &mut ids));
        }
        each(&mut faults, &file.aliases, |index, (label, others)| {
            let place = Place { list: "aliases", index, id: label };
            [label].into_iter().chain(others).try_for_each(|words| place.label(words))
        });
        let (labels, items) = check_items(&file.items, &mut faults);
        match faults.len() {
            0 => {}
            1 => return Err(faults.remove(0)),
            _ => return Err(SceneError::Several(faults)),
        }
        let (rooms, doors_found) = (partitions.rooms, file.doors.is_empty());
        if doors_found {
            doors = doors::found(&rooms);
        }
        let mut map = Self {
            name: file.name,
            description: file.description,
            source: file.source,
            rooms,
            parts,
            groups,
            doors,
            doors_found,
            labels,
            items,
            aliases: file.aliases,
            fingerprint: [0; 32],
        };
        map.fingerprint = Sha256::digest(map.to_json()).into();
        Ok(map)
    }
}

/// Checks rooms, parts and groups. All can be partitions, so they share one namespace of ids.
struct Partitions<'a> {
    ids: Ids<'a>,
    rooms: Vec<Room>,
    room_ids: Ids<'a>,
    version: u32,
    /// Corners that the map's footprints may still have.
    corners_left: usize,
}

impl<'a> Partitions<'a> {
    fn room(&mut self, index: usize, entry: &'a RoomEntry) -> Result<Room, SceneError> {
        let place = Place { list: "rooms", index, id: &entry.id };
        self.ids.insert(place)?;
        self.room_ids.insert(place)?;
        place.label(&entry.label)?;
        let space = self.space(place, entry.extent(), None)?;
        Ok(Room { id: entry.id.clone(), label: entry.label.clone(), space })
    }

    fn part(&mut self, index: usize, entry: &'a PartEntry) -> Result<Part, SceneError> {
        let place = Place { list: "parts", index, id: &entry.id };
        self.ids.insert(place)?;
        place.label(&entry.label)?;
        let room = self.find(place, "room", &entry.room)?;
        let around = self.rooms[room.0 as usize].space.bounds;
        let space = self.space(place, entry.extent(), Some(around))?;
        let field = if space.footprint.is_some() { "footprint" } else { "box" };
        let is_inside = self.rooms[room.0 as usize].space.meets(&space);
        place.ensure(is_inside, field, "lies outside its room", "give a place inside the room")?;
        Ok(Part { id: entry.id.clone(), label: entry.label.clone(), room, space })
    }

    fn group(
        &mut self,
        index: usize,
        entry: &'a GroupEntry,
        grouped: &mut BTreeSet<RoomId>,
    ) -> Result<Group, SceneError> {
        let place = Place { list: "groups", index, id: &entry.id };
        self.ids.insert(place)?;
        place.label(&entry.label)?;
        let remedy = "name at least one room or remove the group";
        place.ensure(!entry.rooms.is_empty(), "rooms", "has no entry", remedy)?;
        let mut rooms = Vec::with_capacity(entry.rooms.len());
        for id in &entry.rooms {
            let room = self.find(place, "rooms", id)?;
            let problem = format_args!("the room {id:?} is already in a group");
            place.ensure(grouped.insert(room), "rooms", problem, "put every room into at most one group, once")?;
            rooms.push(room);
        }
        let own = entry.extent();
        let space = match own {
            Extent { bounds: None, footprint: None, floor: None, height: None } => None,
            Extent { footprint: None, .. } => {
                let remedy = "leave it out, or give the group a `footprint`";
                return Err(place.error("box", "is no outline of a group, which takes up its rooms", remedy));
            }
            _ => {
                let bounds = rooms.iter().map(|room| self.rooms[room.0 as usize].space.bounds);
                Some(self.space(place, own, bounds.reduce(Box3::with))?)
            }
        };
        Ok(Group { id: entry.id.clone(), label: entry.label.clone(), rooms, space })
    }

    fn door(&self, index: usize, entry: &'a DoorEntry, ids: &mut Ids<'a>) -> Result<Door, SceneError> {
        let place = Place { list: "doors", index, id: &entry.id };
        ids.insert(place)?;
        place.point("position_m", &entry.position_m)?;
        let [a, b] = &entry.rooms;
        let rooms = [self.find(place, "rooms", a)?, self.find(place, "rooms", b)?];
        place.ensure(rooms[0] != rooms[1], "rooms", "joins a room to itself", "name two different rooms")?;
        Ok(Door { id: entry.id.clone(), rooms, position_m: entry.position_m })
    }

    fn find(&self, place: Place, field: &'static str, id: &str) -> Result<RoomId, SceneError> {
        let found = self.room_ids.0.get(id).map(|&index| RoomId(index_u32(index)));
        found.ok_or_else(|| {
            let id: String = id.chars().take(MAX_TEXT_BYTES).collect();
            place.error(field, format!("there is no room {id:?}"), "use the id of an entry of `rooms`")
        })
    }

    /// The box of an entry, or its footprint between floor and ceiling. `around` is the enclosing space, if known.
    fn space(&mut self, place: Place, extent: Extent, around: Option<Box3>) -> Result<Space, SceneError> {
        if let Some(bounds) = &extent.bounds {
            place.bounds(bounds)?;
            let problem = "has no volume, so nothing can lie in it";
            place.ensure(bounds.volume_m3() > 0.0, "box", problem, "give it a length, a width and a height")?;
        }
        if let Some(rings) = extent.footprint {
            return self.prism(place, rings, extent, around);
        }
        for (field, given) in [("floor", extent.floor), ("height", extent.height)] {
            let remedy = "give a `footprint`, too, or say it in the `box`";
            place.ensure(given.is_none(), field, "belongs to a footprint", remedy)?;
        }
        let remedy = "give a `box`, or a `footprint` with `floor` and `height`";
        extent.bounds.map(Space::from).ok_or_else(|| place.error("box", "is missing", remedy))
    }

    fn prism(
        &mut self,
        place: Place,
        rings: &Rings,
        extent: Extent,
        around: Option<Box3>,
    ) -> Result<Space, SceneError> {
        let remedy = "write \"version\": 2 at the top of the file";
        place.ensure(self.version >= 2, "footprint", "is a key of version 2", remedy)?;
        // Before any other work on the corners.
        let left = self.corners_left.checked_sub(rings.iter().map(Vec::len).sum());
        self.corners_left = left.ok_or_else(|| {
            let problem = format!("the map's footprints have more than {MAX_CORNERS} corners");
            place.error("footprint", problem, FEWER_CORNERS)
        })?;
        rings.iter().flatten().try_for_each(|[x, y]| place.point("footprint", &[*x, *y, 0.0]))?;
        let footprint = Footprint::new(rings).map_err(|(problem, remedy)| place.error("footprint", problem, remedy))?;

        let from = extent.bounds.or(around);
        let floor_m = extent.floor.or(from.map(|bounds| bounds.min_m[2])).unwrap_or(0.0);
        let height_m = extent.height.or(from.map(|bounds| bounds.size_m()[2])).unwrap_or(ROOM_HEIGHT_M);
        let [least, most] = footprint.around();
        let mut bounds = Box3 { min_m: [least[0], least[1], floor_m], max_m: [most[0], most[1], floor_m + height_m] };
        place.point("floor", &bounds.min_m)?;
        place.point("height", &bounds.max_m)?;
        if let Some(own) = extent.bounds {
            let agree = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= ROUNDED_M);
            let is_around = agree(own.min_m, bounds.min_m) && agree(own.max_m, bounds.max_m);
            let problem = format_args!(
                "from {:?} to {:?} is not the box around the footprint, from {:?} to {:?}",
                own.min_m, own.max_m, bounds.min_m, bounds.max_m
            );
            place.ensure(is_around, "box", problem, "leave out the box of an element that has a footprint")?;
            (bounds.min_m[2], bounds.max_m[2]) = (own.min_m[2], own.max_m[2]);
        }
        let problem = "leaves no volume, so nothing can lie in it";
        place.ensure(bounds.volume_m3() > 0.0, "height", problem, "give the height in metres")?;
        Ok(Space { bounds, footprint: Some(footprint) })
    }
}

fn check_items(entries: &[ItemEntry], faults: &mut Vec<SceneError>) -> (Vec<String>, Vec<Item>) {
    let mut ids = Ids::default();
    let mut words = BTreeSet::new();
    each(faults, entries, |index, entry| {
        let place = Place { list: "items", index, id: &entry.id };
        ids.insert(place)?;
        place.label(&entry.label)?;
        place.point("position_m", &entry.position_m)?;
        place.bounds(&entry.r#box)?;
        place.captions(entry)?;
        words.insert(entry.label.as_str());
        words.extend(entry.captions.iter().map(|caption| caption.label.as_str()));
        Ok(())
    });
    let labels: Vec<&str> = words.into_iter().collect();
    let label_id = |label: &str| LabelId(index_u32(labels.partition_point(|known| *known < label)));
    let item = |entry: &ItemEntry| {
        let total: f64 = entry.captions.iter().map(|caption| caption.weight).sum();
        // Normalised shares stay unchanged, so that writing and reading give an equal map.
        let total = if (total - 1.0).abs() < 1e-9 { 1.0 } else { total };
        let caption = |entry: &CaptionEntry| Caption { label: label_id(&entry.label), weight: entry.weight / total };
        Item {
            id: entry.id.clone(),
            label: label_id(&entry.label),
            captions: entry.captions.iter().map(caption).collect(),
            position_m: entry.position_m,
            bounds: entry.r#box,
        }
    };
    let items = entries.iter().map(item).collect();
    (labels.iter().map(|&label| label.to_owned()).collect(), items)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};
    use std::collections::BTreeMap;
    use std::path::Path;

    const TWO_ROOMS: &str = include_str!("../../../tests/data/two_rooms.json");

    fn message(error: &SceneError) -> String {
        let mut text = error.to_string();
        let mut cause = std::error::Error::source(error);
        while let Some(error) = cause {
            text.push_str(&format!(": {error}"));
            cause = error.source();
        }
        text
    }

    /// The message for a scene of two rooms with the value at `pointer` replaced or added.
    fn refused(pointer: &str, value: Value) -> String {
        let mut scene: Value = serde_json::from_str(TWO_ROOMS).unwrap();
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        match scene.pointer_mut(parent).unwrap() {
            Value::Object(object) => drop(object.insert(key.to_owned(), value)),
            Value::Array(array) => array[key.parse::<usize>().unwrap()] = value,
            _ => panic!("{parent} holds nothing"),
        }
        message(&SemanticMap::from_json(&scene.to_string()).unwrap_err())
    }

    #[test]
    fn an_error_does_not_repeat_the_scene() {
        let long = || "k".repeat(1 << 20);
        for pointer in [
            "/format",
            "/version",
            "/name",
            "/rooms",
            "/rooms/0",
            "/rooms/0/box",
            "/rooms/0/id",
            "/rooms/0/label",
            "/rooms/0/floor",
            "/items/0",
            "/items/0/id",
            "/items/0/label",
            "/items/0/position_m",
            "/doors",
            "/aliases",
            "/description",
            "/source",
        ] {
            let error = refused(pointer, json!(long()));
            assert!(error.len() < 2_000, "{pointer}: {} bytes, {}", error.len(), &error[..200]);
        }
        let key = format!("/{}", long());
        assert!(refused(&key, json!(1)).len() < 2_000);
        let mut aliases = serde_json::Map::new();
        aliases.insert(long(), json!([long()]));
        assert!(refused("/aliases", json!(aliases)).len() < 2_000);
    }

    const CORNERS: &str = include_str!("../../../tests/data/corners.json");

    #[test]
    fn footprints_survive_writing_and_reading() {
        let map = SemanticMap::from_json(CORNERS).unwrap();
        assert!(map.to_json().contains("\"version\": 2"));
        let again = SemanticMap::from_json(&map.to_json()).unwrap();
        assert_eq!((map.fingerprint, &map), (again.fingerprint, &again));
        let joined: Vec<&str> = map.doors.iter().map(|door| door.id.as_str()).collect();
        let expected = ["kitchen--bedroom", "kitchen--living-room", "hallway--bedroom", "hallway--living-room"];
        assert_eq!(joined, expected);
        let moved = SemanticMap::from_json(&CORNERS.replace("[7, 3], [4, 3]", "[7, 3], [4.1, 3]")).unwrap();
        assert_ne!(map.fingerprint, moved.fingerprint);
    }

    #[test]
    fn a_map_of_boxes_stays_version_1() {
        let two = SemanticMap::from_json(&TWO_ROOMS.replace("\"version\": 1", "\"version\": 2")).unwrap();
        assert_eq!(two.fingerprint, SemanticMap::from_json(TWO_ROOMS).unwrap().fingerprint);
        assert!(two.to_json().contains("\"version\": 1"));
    }

    #[test]
    fn footprints_are_checked() {
        let refused = |from: &str, to: &str| {
            assert!(CORNERS.contains(from), "{from}");
            message(&SemanticMap::from_json(&CORNERS.replacen(from, to, 1)).unwrap_err())
        };
        let many = format!("[{}[5, 3]]", "[4, 0], [7, 0], ".repeat(MAX_CORNERS));
        let cases = [
            ("\"version\": 2", "\"version\": 1", "rooms[1] (\"hallway\"), `footprint`: is a key of version 2"),
            ("[[[-2, 0], [0, 0]", "[[[-2, 0], [-1, 9]", "rooms[1] (\"hallway\"), `footprint`: ring 0 meets itself"),
            ("[[[-2, 0], [0, 0]", "[[[-2, 0], [0, 2e4]", "`footprint`: [0.0, 20000.0, 0.0] lies farther than 10 km"),
            ("[[[-2, 0], [0, 0]", "[[[-2, 0], [0]", "rooms[1].footprint[0][1]: a list of 1, expected 2 of them"),
            ("\"floor\": 0, \"height\": 2.5}", "\"floor\": 0, \"height\": 0}", "`height`: leaves no volume"),
            ("\"floor\": 0,", "\"floor\": 1e9,", "`floor`: "),
            (
                "\"floor\": 0,",
                "\"box\": {\"min_m\": [0, 0, 0], \"max_m\": [4, 8.5, 2.5]},",
                "is not the box around the footprint",
            ),
            (
                "\"box\": {\"min_m\": [4, 3, 0], \"max_m\": [8, 7, 2.5]}",
                "\"height\": 2.5",
                "`height`: belongs to a footprint",
            ),
            (
                ", \"box\": {\"min_m\": [4, 3, 0], \"max_m\": [8, 7, 2.5]}",
                "",
                "`box`: is missing; give a `box`, or a `footprint`",
            ),
            ("[[[4, 0], [7, 0], [7, 3], [5, 3]]]", "[[[5, 4], [6, 4], [6, 5]]]", "`footprint`: lies outside its room"),
            ("[[4, 0], [7, 0], [7, 3], [5, 3]]", &many, "more than 10000 corners; simplify"),
            (
                "\"rooms\": [\"kitchen\", \"living-room\"], \"footprint\": [[[0, 0], [8, 0], [8, 7], [0, 7]]]",
                "\"rooms\": [\"kitchen\"], \"height\": 3",
                "groups[0] (\"day\"), `box`: is no outline of a group",
            ),
        ];
        for (from, to, expected) in cases {
            let text = refused(from, to);
            assert!(text.contains(expected), "{expected}: {text}");
        }
    }

    #[test]
    fn soft_labels_survive_writing_and_reading() {
        let with = |weights: &[f64]| {
            let mut scene: Value = serde_json::from_str(TWO_ROOMS).unwrap();
            let label = |index: usize| if index == 0 { "mug".to_owned() } else { format!("thing {index}") };
            let caption = |(index, weight): (usize, &f64)| json!({"label": label(index), "weight": weight});
            scene["items"][0]["captions"] = weights.iter().enumerate().map(caption).collect();
            SemanticMap::from_json(&scene.to_string())
        };
        for weights in [&[0.11, 0.06, 0.85, 0.3, 0.27][..], &[2.0, 1.0], &[100.0, 1e-6], &[1e9, 3.0], &[1e-9, 1e-9]] {
            let map = with(weights).unwrap();
            let again = SemanticMap::from_json(&map.to_json()).unwrap();
            assert_eq!((map.fingerprint, &map), (again.fingerprint, &again));
        }
        assert!(message(&with(&[100.0, 5e-9]).unwrap_err()).contains("of all"));
    }

    #[test]
    fn the_fingerprint_follows_the_content_and_not_the_layout() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let compact = serde_json::from_str::<Value>(TWO_ROOMS).unwrap().to_string();
        assert_eq!(map.fingerprint, SemanticMap::from_json(&compact).unwrap().fingerprint);
        let moved = TWO_ROOMS.replacen("\"mug-1\"", "\"mug-one\"", 1);
        assert_ne!(map.fingerprint, SemanticMap::from_json(&moved).unwrap().fingerprint);
    }

    #[test]
    fn every_refusal_names_the_element_and_the_remedy() {
        let cases = [
            ("/format", json!("map"), "is `map` version 1"),
            ("/version", json!(3), "version 3, but this program reads `roomcast-scene` versions 1 to 2"),
            ("/color", json!(1), "unknown key `color`"),
            ("/name", json!(""), "scene[0] (\"\"), `name`: is empty; give a short name"),
            ("/rooms", json!([]), "`rooms`: has no entry"),
            ("/rooms/1/id", json!("kitchen"), "rooms[1] (\"kitchen\"), `id`: is used twice"),
            ("/rooms/0/label", json!("Kitchen"), "capital letters; write lower-case words"),
            ("/rooms/0/box/max_m", json!([0, 0, 0]), "rooms[0] (\"kitchen\"), `box`: has no volume"),
            ("/items/0/label", json!("  mug"), "items[0] (\"mug-1\"), `label`"),
            ("/items/0/label", json!("mug\u{7}"), "control character"),
            ("/items/0/label", json!("mug\u{202e}"), "control character"),
            ("/items/0/label", json!("m\u{200b}ug"), "control character"),
            ("/items/0/label", json!("m".repeat(129)), "is 129 bytes long, more than 128"),
            ("/items/0/box/min_m", json!([9, 9, 9]), "exceeds max_m"),
            ("/items/0/box/min_m", json!([0, 0]), "items[0].box.min_m: a list of 2, expected 3 of them"),
            ("/items/0/position_m", json!([0, 2e4, 0]), "farther than 10 km"),
            ("/items/0/position_m", json!([0, null, 0]), "items[0].position_m[1]: null, expected a number"),
            ("/items/1/id", json!("mug-1"), "items[1] (\"mug-1\"), `id`: is used twice"),
            ("/items/0/captions", json!([{"label": "cup", "weight": 1}]), "not among its captions"),
            ("/items/0/captions", json!([{"label": "mug", "weight": 0}]), "positive weight"),
            ("/parts/0/room", json!("attic"), "there is no room \"attic\""),
            ("/parts/0/box", json!({"min_m": [50, 50, 0], "max_m": [51, 51, 1]}), "outside its room"),
            ("/groups/0/rooms", json!(["kitchen", "kitchen"]), "already in a group"),
            ("/groups/0/rooms", json!([]), "groups[0] (\"all\"), `rooms`: has no entry"),
            ("/doors/0/rooms", json!(["kitchen", "kitchen"]), "joins a room to itself"),
            ("/aliases/sofa", json!([""]), "aliases[0] (\"sofa\"), `label`: is empty"),
        ];
        for (pointer, value, expected) in cases {
            let text = refused(pointer, value.clone());
            assert!(text.contains(expected), "{pointer} = {value}: {text}");
        }
    }

    #[test]
    fn all_faults_are_named_at_once() {
        let mut scene: Value = serde_json::from_str(TWO_ROOMS).unwrap();
        for (pointer, value) in [
            ("/name", json!("")),
            ("/items/0/label", json!("Mug")),
            ("/items/1/position_m", json!([0, 2e4, 0])),
            ("/parts/0/room", json!("attic")),
            ("/doors/0/rooms", json!(["kitchen", "kitchen"])),
            ("/aliases/sofa", json!([""])),
        ] {
            *scene.pointer_mut(pointer).unwrap() = value;
        }
        let said = |scene: &Value| message(&SemanticMap::from_json(&scene.to_string()).unwrap_err());
        let lists = |said: &str| -> Vec<String> {
            said.lines().skip(1).map(|line| line[2..].split('[').next().unwrap().to_owned()).collect()
        };
        let all = said(&scene);
        assert!(all.starts_with("6 things are wrong:\n- scene[0] (\"\"), `name`: is empty"), "{all}");
        assert_eq!(lists(&all), ["scene", "parts", "doors", "aliases", "items", "items"]);
        // Contents of an invalid room are not reported.
        scene["rooms"][0]["label"] = json!("Kitchen");
        assert_eq!(lists(&said(&scene)), ["scene", "rooms", "aliases", "items", "items"]);
        // A long list of faults is cut.
        let item = scene["items"][0].clone();
        scene["items"].as_array_mut().unwrap().extend(std::iter::repeat_n(item, 100));
        let many = said(&scene);
        assert!(many.starts_with("at least 20 things are wrong:") && lists(&many).len() == 20, "{many}");
    }

    #[test]
    fn text_that_is_no_json_is_refused_with_its_line_and_element() {
        let colon = TWO_ROOMS.replacen("\"label\": \"mug\"", "\"label\" \"mug\"", 1);
        let comma = TWO_ROOMS.trim_end().strip_suffix('}').unwrap().to_owned() + ",}";
        let half = TWO_ROOMS[..TWO_ROOMS.find("\"items\"").unwrap() + 60].to_owned();
        for (text, expected) in [
            (colon, "items[0]: expected `:` at line "),
            (comma, "trailing comma at line "),
            (half, "items[0].position_m: the text ends too early, in line "),
            (String::new(), "the text ends too early, in line 1: it is empty or was cut off"),
            (format!("{TWO_ROOMS} true"), "end: more stands behind the end"),
        ] {
            let said = message(&SemanticMap::from_json(&text).unwrap_err());
            assert!(said.starts_with(expected), "{said}");
        }
    }

    /// Editors on Windows write a byte order mark.
    #[test]
    fn a_byte_order_mark_is_no_part_of_a_map() {
        let marked = SemanticMap::from_json(&format!("\u{feff}{TWO_ROOMS}")).unwrap();
        assert_eq!(marked, SemanticMap::from_json(TWO_ROOMS).unwrap());
    }

    #[test]
    fn limits_on_counts_hold() {
        let item = |index: usize| {
            json!({"id": format!("i{index}"), "label": "mug", "position_m": [1, 1, 1],
                   "box": {"min_m": [1, 1, 1], "max_m": [1, 1, 1]}})
        };
        let items: Vec<Value> = (0..=MAX_ITEMS).map(item).collect();
        assert!(refused("/items", json!(items)).contains("100001 entries, more than 100000"));
        let aliases: BTreeMap<String, Vec<String>> = (0..1_001).map(|at| (format!("thing {at}"), Vec::new())).collect();
        assert!(refused("/aliases", json!(aliases)).contains("1001 entries, more than 1000"));
    }

    #[test]
    fn files_name_themselves() {
        let error = SemanticMap::load("no/such/scene.json").unwrap_err();
        assert!(message(&error).starts_with("scene no/such/scene.json: cannot be read"), "{}", message(&error));
        if Path::new("/dev/zero").exists() {
            assert!(matches!(
                SemanticMap::load("/dev/zero"),
                Err(SceneError::InFile { source, .. }) if matches!(*source, SceneError::FileTooLarge)
            ));
        }
    }
}
