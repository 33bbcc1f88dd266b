//! Open-vocabulary maps, as perception pipelines export them: objects with caption candidates and boxes, rooms with boxes or
//! polygons.
//!
//! Three shapes are read, alone or together:
//!
//! - ConceptGraphs' object file, `{"object_1": {"id", "object_tag", "bbox_center", "bbox_extent"}, ...}`, or its scene graph, a list of such objects;
//!   neither has rooms;
//! - HOV-SG's room and object files: `room_id`, `name`, `vertices` (a polygon, or the centres of the room's grid cells), `room_zero_level`,
//!   `room_height`, and `object_id`, `room_id`, `name`, `vertices` (corners, or points without heights); y is up there. Its floors and
//!   navigation graphs are skipped;
//! - one object with `rooms` and `objects`, lists of either kind of entry, and `up`, `"y"` or `"z"`.
//!
//! An object's `captions` are its candidates: texts, or objects with `text` and `weight`. They become soft labels.

use std::collections::{BTreeMap, HashMap};

use serde::{Deserialize, Deserializer};
use serde_json::{Map, Value, json};

use super::{Ids, ImportError, Imported, parse, unnamed, valetudo, words};
use crate::semantic_map::checks::check_count;
use crate::semantic_map::footprint::Footprint;
use crate::semantic_map::schema::{
    CaptionEntry, ItemEntry, MAX_CAPTIONS, ROOM_HEIGHT_M, Rings, RoomEntry, SHARE_MIN, SceneFile,
};
use crate::semantic_map::{Box3, MAX_CORNERS, MAX_ROOMS, MAX_TEXT_BYTES};
use crate::text::without_mark;

const EXPECTED: &str = "an open-vocabulary map: `objects` and `rooms`, or ConceptGraphs' objects";
/// Fewer vertices are a polygon. A room's grid cells are more: HOV-SG leaves out rooms below 0.25 m², which are 100 cells.
const CELLS_MIN: usize = 64;
/// Most cells along one side: 500 m at HOV-SG's 0.05 m.
const CELLS_ASIDE_MAX: f64 = 10_000.0;
/// How far a vertex may lie off the grid, in cells: numbers are rounded.
const OFF_GRID: f64 = 0.1;
/// How far a corner may lie off a box's and be one of its corners, in metres: numbers are rounded.
const ROUNDED_M: f64 = 0.01;
/// Captions of captioners for an unrecognised object.
const NOTHING: [&str; 6] = ["invalid", "unknown", "none", "object", "item", "n/a"];

crate::choices! {
    /// The axis that points up in the map.
    #[derive(Default)]
    pub enum Up {
        /// Right-handed, y up: HOV-SG and Habitat.
        Y,
        /// Right-handed, z up: most others.
        #[default]
        Z,
    }
}

impl Up {
    /// Turns a point so that z is up; a rotation, so the frame stays right-handed.
    fn turn(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::Y => [x, -z, y],
            Self::Z => [x, y, z],
        }
    }
}

#[derive(Deserialize)]
struct File {
    up: Option<Up>,
    #[serde(default)]
    rooms: Vec<Room>,
    #[serde(default)]
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Room {
    #[serde(alias = "id")]
    room_id: Option<Value>,
    #[serde(alias = "label")]
    name: Option<String>,
    r#box: Option<Box3>,
    /// Corners on the floor, `[x, y]` (the two level axes), or `[x, y, z]`.
    #[serde(default, deserialize_with = "or_none")]
    vertices: Vec<Vec<f64>>,
    #[serde(alias = "height")]
    room_height: Option<f64>,
    #[serde(alias = "floor")]
    room_zero_level: Option<f64>,
}

#[derive(Deserialize)]
struct Object {
    #[serde(alias = "id")]
    object_id: Option<Value>,
    #[serde(alias = "object_tag", alias = "label", alias = "class_name")]
    name: Option<String>,
    #[serde(default)]
    captions: Vec<Candidate>,
    r#box: Option<Box3>,
    bbox_center: Option<[f64; 3]>,
    bbox_extent: Option<[f64; 3]>,
    room_id: Option<Value>,
    /// Corners; or, without heights, points of two coordinates.
    #[serde(default, deserialize_with = "or_none")]
    vertices: Vec<Vec<f64>>,
}

/// A list. Python writes `null` for a list that was never set.
fn or_none<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Vec<f64>>, D::Error> {
    Option::deserialize(deserializer).map(Option::unwrap_or_default)
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "no caption: give a text, or {\"text\": text, \"weight\": number}")]
enum Candidate {
    Text(String),
    Weighted {
        #[serde(alias = "label", alias = "caption")]
        text: String,
        #[serde(alias = "score", alias = "probability")]
        weight: f64,
    },
}

/// The smallest box around points; `None` without points.
fn around(points_m: impl Iterator<Item = [f64; 3]>) -> Option<Box3> {
    points_m.map(|point_m| Box3 { min_m: point_m, max_m: point_m }).reduce(Box3::with)
}

fn turned(bounds: &Box3, up: Up) -> Option<Box3> {
    around([up.turn(bounds.min_m), up.turn(bounds.max_m)].into_iter())
}

/// Vertices with z up, at height 0 if they have two coordinates; `None` if a vertex has fewer.
fn points(vertices: &[Vec<f64>], up: Up) -> Option<Vec<[f64; 3]>> {
    let point = |vertex: &Vec<f64>| match (vertex[..].try_into().ok(), up) {
        (Some(point), _) => Some(up.turn(point)),
        (None, Up::Z) => Some([*vertex.first()?, *vertex.get(1)?, 0.0]),
        (None, Up::Y) => Some([*vertex.first()?, -*vertex.get(1)?, 0.0]),
    };
    vertices.iter().map(point).collect()
}

/// The outline around the centres of grid cells; none where the points are no filled area of a grid.
fn outline_of_cells(points: &[[f64; 3]]) -> Option<Rings> {
    if points.len() < CELLS_MIN {
        return None;
    }
    let bounds = around(points.iter().copied())?;
    let step_m = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|point| point[axis]).collect();
        values.sort_by(f64::total_cmp);
        let steps = values.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 1e-4);
        steps.fold(f64::INFINITY, f64::min)
    };
    let least_m = step_m(0).min(step_m(1));
    let longer_m = bounds.size_m()[0].max(bounds.size_m()[1]);
    let along = (longer_m / least_m).round();
    if !(1.0..=CELLS_ASIDE_MAX).contains(&along) {
        return None;
    }
    // The long side has the least rounding per cell.
    let cell_m = longer_m / along;
    let mut cells = Vec::with_capacity(points.len());
    for point in points {
        let at = [point[0] - bounds.min_m[0], bounds.max_m[1] - point[1]].map(|metres| metres / cell_m);
        if !at.iter().all(|at| (at - at.round()).abs() < OFF_GRID) {
            return None;
        }
        cells.push(at.map(|at| at.round() as i64));
    }
    let rings = valetudo::outline(&cells, cell_m)?;
    // A cell reaches half its size around its centre, and the outline's y points down from the first row.
    let to_map = |[x, y]: [f64; 2]| [x + bounds.min_m[0] - 0.5 * cell_m, y + bounds.max_m[1] + 0.5 * cell_m];
    Some(rings.into_iter().map(|ring| ring.into_iter().map(to_map).collect()).collect())
}

impl Room {
    /// Its corners, with z up; none where one has fewer than two coordinates.
    fn corners(&self, up: Up) -> Option<Vec<[f64; 3]>> {
        points(&self.vertices, up)
    }

    /// The outline around its grid cells, or the polygon.
    fn outline(&self, up: Up) -> Rings {
        let corners = self.corners(up).unwrap_or_default();
        outline_of_cells(&corners).unwrap_or_else(|| vec![corners.iter().map(|&[x, y, _]| [x, y]).collect()])
    }

    /// Whether its outline is that of the box: both have the same corners.
    fn is_box(&self, bounds: &Box3, up: Up) -> bool {
        let near = |a: &[f64; 3], b: &[f64; 2]| (a[0] - b[0]).abs() <= ROUNDED_M && (a[1] - b[1]).abs() <= ROUNDED_M;
        let (min, max) = (bounds.min_m, bounds.max_m);
        let wanted = [[min[0], min[1]], [min[0], max[1]], [max[0], min[1]], [max[0], max[1]]];
        let corners = self.corners(up).unwrap_or_default();
        self.r#box.is_some()
            || (corners.iter().all(|corner| wanted.iter().any(|own| near(corner, own)))
                && wanted.iter().all(|own| corners.iter().any(|corner| near(corner, own))))
    }

    fn bounds(&self, up: Up) -> Option<Box3> {
        if let Some(bounds) = &self.r#box {
            return turned(bounds, up);
        }
        let mut bounds = around(self.corners(up)?.into_iter())?;
        if self.room_zero_level.is_some() || bounds.size_m()[2] <= 0.0 {
            bounds.min_m[2] = self.room_zero_level.unwrap_or(bounds.min_m[2]);
            bounds.max_m[2] = bounds.min_m[2] + self.room_height.unwrap_or(ROOM_HEIGHT_M);
        }
        Some(bounds)
    }
}

impl Object {
    /// Whether it has points on the floor alone, without heights.
    fn is_flat(&self) -> bool {
        self.r#box.is_none() && self.bbox_center.is_none() && self.vertices.iter().any(|vertex| vertex.len() == 2)
    }

    /// The box around it. If it is flat, the box has the heights of its room.
    fn bounds(&self, up: Up, heights_m: &HashMap<String, [f64; 2]>) -> Option<Box3> {
        if let Some(bounds) = &self.r#box {
            return turned(bounds, up);
        }
        if let (Some(center), Some(extent)) = (self.bbox_center, self.bbox_extent) {
            let corner = |sign: f64| up.turn(std::array::from_fn(|axis| center[axis] + 0.5 * sign * extent[axis]));
            return around([corner(-1.0), corner(1.0)].into_iter());
        }
        let mut bounds = around(points(&self.vertices, up)?.into_iter())?;
        if self.is_flat() {
            let room = id_text(self.room_id.as_ref()).and_then(|id| heights_m.get(&id));
            [bounds.min_m[2], bounds.max_m[2]] = *room.unwrap_or(&[0.0, ROOM_HEIGHT_M]);
        }
        Some(bounds)
    }

    /// The labels that its name and captions come to, with summed weights, the heaviest first.
    fn labels(&self) -> Vec<(String, f64)> {
        let mut weights: BTreeMap<String, f64> = BTreeMap::new();
        for candidate in &self.captions {
            let (text, weight) = match candidate {
                Candidate::Text(text) => (text, 1.0),
                Candidate::Weighted { text, weight } => (text, *weight),
            };
            if let Some(label) = label_of(text) {
                *weights.entry(label).or_default() += weight;
            }
        }
        if weights.is_empty() {
            weights.extend(self.name.as_deref().and_then(label_of).map(|label| (label, 1.0)));
        }
        let least = SHARE_MIN * weights.values().sum::<f64>();
        let likely = |(_, weight): &(String, f64)| *weight > 0.0 && *weight > least;
        let mut labels: Vec<(String, f64)> = weights.into_iter().filter(likely).collect();
        labels.sort_by(|a, b| b.1.total_cmp(&a.1));
        labels.truncate(MAX_CAPTIONS);
        labels
    }
}

/// The label that a caption comes to: "A white coffee_maker." is "white coffee maker"; `None` for a caption without words.
fn label_of(caption: &str) -> Option<String> {
    let bare = caption.trim().trim_end_matches(['.', '!', ',', ';']);
    let label = words(bare);
    let label = ["a ", "an ", "the "].iter().find_map(|article| label.strip_prefix(article)).unwrap_or(&label);
    let says_something = !label.is_empty() && label.len() <= MAX_TEXT_BYTES && !NOTHING.contains(&label);
    says_something.then(|| label.to_owned())
}

/// A name or number, as an id.
fn id_text(id: Option<&Value>) -> Option<String> {
    match id? {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

/// Puts the files of a folder, as HOV-SG writes them, into one map: each file is a room, an object, a list of these, or a whole map.
///
/// # Errors
/// When a text is not JSON.
pub fn combine<'a>(files: impl IntoIterator<Item = &'a str>) -> Result<String, ImportError> {
    let (mut up, mut rooms, mut objects) = (Value::Null, Vec::new(), Vec::new());
    for json in files {
        let is_list = without_mark(json).trim_start().starts_with('[');
        let entries: Vec<Map<String, Value>> =
            if is_list { parse(json, EXPECTED)? } else { vec![parse(json, EXPECTED)?] };
        for entry in entries {
            let has = |key: &str| entry.contains_key(key);
            if has("object_id") || has("room_id") {
                let list = if has("object_id") { &mut objects } else { &mut rooms };
                list.push(Value::Object(entry));
                // Only HOV-SG's entries have these keys.
                up = Value::from("y");
            } else if has("floor_id") || has("multigraph") {
                // HOV-SG's floors, which have no more than its rooms, and its navigation graphs.
            } else if is_list {
                objects.push(Value::Object(entry));
            } else {
                let mut whole = whole(entry);
                for (key, all) in [("rooms", &mut rooms), ("objects", &mut objects)] {
                    match whole.remove(key).unwrap_or_default() {
                        Value::Null => {}
                        Value::Array(list) => all.extend(list),
                        other => drop(parse::<File>(&json!({ key: other }).to_string(), EXPECTED)?),
                    }
                }
                up = whole.remove("up").unwrap_or(up);
            }
        }
    }
    Ok(json!({"up": up, "rooms": rooms, "objects": objects}).to_string())
}

/// A map with `objects`: ConceptGraphs' file is an object of objects.
fn whole(entry: Map<String, Value>) -> Map<String, Value> {
    if entry.contains_key("objects") || entry.contains_key("rooms") {
        return entry;
    }
    // `object_10` stands before `object_2` in the order of letters; the order of items is for people, so sort by number.
    let number = |key: &str| key.rsplit('_').next().and_then(|digits| digits.parse::<u64>().ok());
    let mut objects: Vec<(String, Value)> = entry.into_iter().collect();
    objects.sort_by_key(|(key, _)| (number(key), key.clone()));
    let objects: Vec<Value> = objects.into_iter().map(|(_, object)| object).collect();
    Map::from_iter([("objects".to_owned(), objects.into())])
}

/// Turns an open-vocabulary map into a scene.
///
/// Captions become labels: lower-case words without article and full stop, machine names turned into words. An object with
/// several captions becomes an item with soft labels. Oriented boxes are taken as if along the axes. Polygons of rooms become footprints, and so do
/// the outlines of their grid cells; where one meets itself, the box around it stands for it. `up` decides where the file does not. Left out, with a
/// note: objects without box or caption, rooms without outline.
///
/// # Errors
/// When the text is no open-vocabulary map, has no room, or breaks a rule of scenes.
pub fn open_vocabulary(json: &str, name: &str, up: Up) -> Result<Imported, ImportError> {
    let File { up: own_up, rooms: room_list, objects } = parse(&combine([json])?, EXPECTED)?;
    let up = own_up.unwrap_or(up);
    let (mut notes, mut boxed) = (Vec::new(), Vec::new());

    let mut room_ids = Ids::default();
    let mut found = Vec::new();
    let mut heights_m = HashMap::new();
    for (index, room) in room_list.iter().enumerate() {
        check_count("rooms", found.len(), MAX_ROOMS)?;
        let Some(bounds) = room.bounds(up) else {
            notes.push(format!("Left out rooms[{index}]: it has neither a box nor vertices."));
            continue;
        };
        let id = id_text(room.room_id.as_ref());
        let label = room.name.as_deref().map(words).filter(|label| !label.is_empty());
        let label = label.or_else(|| Some(words(&format!("room {}", id.as_ref()?))));
        let label = label.unwrap_or_else(|| "room".to_owned());
        heights_m.extend(id.map(|id| (id, [bounds.min_m[2], bounds.max_m[2]])));
        found.push((room_ids.take(&label), label, bounds, (!room.is_box(&bounds, up)).then(|| room.outline(up))));
    }
    let corners: usize = found.iter().flat_map(|(.., rings)| rings).flatten().map(Vec::len).sum();
    // The check of the map refuses more corners before it looks at them.
    let is_usable = |rings: &Rings| corners > MAX_CORNERS || Footprint::new(rings).is_ok();
    let room = |(id, label, bounds, rings): (String, String, Box3, Option<Rings>)| match rings {
        Some(rings) if is_usable(&rings) => RoomEntry::outlined(id, label, rings, bounds.min_m[2], bounds.size_m()[2]),
        unusable => {
            boxed.extend(unusable.map(|_| id.clone()));
            RoomEntry::boxed(id, label, bounds)
        }
    };
    let rooms: Vec<RoomEntry> = found.into_iter().map(room).collect();
    if rooms.is_empty() {
        let remedy = "add `rooms` with a `name` and a `box` or `vertices`; ConceptGraphs' object files have none, so give a file of rooms, too";
        return Err(ImportError::NoRooms { remedy });
    }

    let mut item_ids = Ids::default();
    let (mut items, mut flat) = (Vec::new(), 0);
    for (index, object) in objects.iter().enumerate() {
        let labels = object.labels();
        let (Some(bounds), Some((label, _))) = (object.bounds(up, &heights_m), labels.first()) else {
            notes.push(format!("Left out objects[{index}]: it has no box or no caption that says anything."));
            continue;
        };
        flat += usize::from(object.is_flat());
        let number = id_text(object.object_id.as_ref()).unwrap_or_else(|| index.to_string());
        let item = ItemEntry::boxed(item_ids.take(&format!("{label} {number}")), label, bounds);
        let captions = if labels.len() > 1 { labels } else { Vec::new() };
        let captions = captions.into_iter().map(|(label, weight)| CaptionEntry { label, weight }).collect();
        items.push(ItemEntry { captions, ..item });
    }
    if flat > 0 {
        notes
            .push(format!("Objects without heights ({flat}): each reaches from the floor of its room to the ceiling."));
    }
    notes.extend(unnamed(&rooms, "write a `name` as \"kitchen\" into their files, and import again"));
    Imported::new(SceneFile::new(name, "open-vocabulary map, imported", rooms, items), notes, boxed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{Grounding, GroundingOptions};
    use proptest::prelude::*;

    const MAP: &str = r#"{"up": "z",
        "rooms": [{"id": 1, "name": "Kitchen", "box": {"min_m": [0, 0, 0], "max_m": [4, 4, 2.5]}},
                  {"id": 2, "name": "living_room", "vertices": [[4, 0], [9, 0], [9, 3], [6, 4], [4, 4]], "floor": 0.1, "height": 2.4},
                  {"id": 3, "name": "attic"}],
        "objects": [{"id": 7, "captions": [{"text": "A mug.", "weight": 2}, {"text": "the Cup", "weight": 1}, {"text": "mug", "weight": 1}],
                     "bbox_center": [1, 1, 1], "bbox_extent": [0.1, 0.1, 0.1]},
                    {"id": 8, "captions": ["sofa"], "box": {"min_m": [5, 1, 0], "max_m": [7, 2, 0.8]}},
                    {"id": 9, "captions": ["unknown"], "bbox_center": [1, 1, 1], "bbox_extent": [1, 1, 1]}]}"#;

    #[test]
    fn captions_become_soft_labels() {
        let imported = open_vocabulary(MAP, "home", Up::Z).unwrap();
        let map = &imported.map;
        assert_eq!(map.labels, ["cup", "mug", "sofa"]);
        assert_eq!(map.items[0].id, "mug-7");
        let weights: Vec<f64> = map.items[0].captions.iter().map(|caption| caption.weight).collect();
        assert_eq!(weights, [0.75, 0.25]);
        assert!(map.items[1].captions.is_empty(), "one caption is a plain label");
        assert_eq!(map.rooms[1].space.bounds, Box3 { min_m: [4.0, 0.0, 0.1], max_m: [9.0, 4.0, 2.5] });
        assert_eq!((imported.notes.len(), &imported.boxed[..]), (2, &[][..]));
        assert_eq!(map.rooms[1].space.footprint.as_ref().unwrap().area_m2(), 18.5);
        assert!(Grounding::new(map, &GroundingOptions::default()).unwrap().unassigned.is_empty());
    }

    #[test]
    fn files_of_concept_graphs_and_hov_sg_are_read() {
        let objects = r#"{"object_10": {"id": 10, "object_tag": "office chair", "object_caption": "a chair", "bbox_extent": [1, 1, 1], "bbox_center": [1, 1, 0.5], "bbox_volume": 1},
                          "object_2": {"id": 2, "object_tag": "washingmachine", "bbox_extent": [1, 1, 1], "bbox_center": [2, 1, 0.5], "bbox_volume": 1}}"#;
        let error = open_vocabulary(objects, "office", Up::Z).unwrap_err();
        assert!(error.to_string().contains("give a file of rooms"), "{error}");
        let rooms = r#"{"rooms": [{"name": "office", "box": {"min_m": [0, 0, 0], "max_m": [4, 4, 3]}}]}"#;
        let map = open_vocabulary(&combine([objects, rooms]).unwrap(), "office", Up::Z).unwrap().map;
        assert_eq!(map.labels, ["office chair", "washing machine"]);
        assert_eq!(map.items[0].id, "washing-machine-2");

        let room = r#"{"room_id": "0_1", "name": "bedroom", "floor_id": "0", "objects": ["0_1_3"], "vertices": [[0, 1], [4, 1], [4, 5]], "room_height": 3.2, "room_zero_level": 0.0, "embeddings": []}"#;
        let object = r#"{"object_id": "0_1_3", "room_id": "0_1", "name": "bed", "vertices": [[1, 0, 2], [3, 0.6, 4]]}"#;
        let Imported { map, boxed, .. } = open_vocabulary(&combine([room, object]).unwrap(), "home", Up::Z).unwrap();
        assert!(boxed.is_empty());
        let footprint = map.rooms[0].space.footprint.as_ref();
        assert_eq!(footprint.unwrap().area_m2(), 8.0, "a triangle is no box, although its corners are a box's");
        let crossed = room.replace("[4, 5]]", "[0, 5], [4, 4.5]]");
        let crossed = open_vocabulary(&combine([&crossed[..]]).unwrap(), "home", Up::Z).unwrap();
        assert_eq!(crossed.boxed, ["bedroom"], "an outline that meets itself");
        let square = room.replace("[4, 5]]", "[4, 5], [0, 5]]");
        let square = open_vocabulary(&combine([&square[..]]).unwrap(), "home", Up::Z).unwrap().map;
        assert_eq!(square.rooms[0].space.footprint, None);
        assert_eq!(map.rooms[0].space.bounds, Box3 { min_m: [0.0, -5.0, 0.0], max_m: [4.0, -1.0, 3.2] });
        assert_eq!(map.items[0].bounds, Box3 { min_m: [1.0, -4.0, 0.0], max_m: [3.0, -2.0, 0.6] });
        assert!(Grounding::new(&map, &GroundingOptions::default()).unwrap().unassigned.is_empty());
    }

    const FLOOR: &str = r#"{"floor_id": "0", "name": "floor_0", "rooms": ["0_0"], "vertices": [[0, 0, 0], [8, 0, 4]], "floor_height": 2.4}"#;
    const ROUTES: &str = r#"{"directed": false, "multigraph": false, "graph": {}, "nodes": [{"id": 0}], "links": []}"#;

    #[test]
    fn a_hov_sg_folder_is_read_without_its_floors_and_routes() {
        let room = |id: &str, name: &str, vertices: &str| {
            format!(
                r#"{{"room_id": "{id}", "floor_id": "0", "name": {name}, "objects": ["{id}_0"], "vertices": {vertices},
                "room_height": 2.5, "room_zero_level": 0.5, "embeddings": [[0.1]], "represent_images": [1]}}"#
            )
        };
        let files = [
            FLOOR.to_owned(),
            ROUTES.to_owned(),
            r#"{"object_id": "0_0_0", "room_id": "0_0", "name": "chair", "vertices": [[1, 1], [1.5, 1.5], [1.2, 1.2]], "embedding": ""}"#.to_owned(),
            r#"{"object_id": "0_1_0", "room_id": "0_1", "name": "sofa", "vertices": null}"#.to_owned(),
            room("0_0", "\"room_0\"", "[[0, 0], [4, 0], [4, 4], [0, 4]]"),
            room("0_1", "null", "[[4, 0, 0], [8, 0, 0], [8, 0, 4], [4, 0, 4]]"),
        ];
        let imported = open_vocabulary(&combine(files.iter().map(String::as_str)).unwrap(), "home", Up::Z).unwrap();
        let map = &imported.map;
        let labels: Vec<_> = map.rooms.iter().map(|room| room.label.as_str()).collect();
        assert_eq!(labels, ["room 0", "room 0 1"]);
        assert_eq!(map.rooms[1].space.bounds, Box3 { min_m: [4.0, -4.0, 0.5], max_m: [8.0, 0.0, 3.0] });
        // Points without heights: from the floor to the ceiling.
        assert_eq!(map.items.len(), 1);
        assert_eq!(map.items[0].bounds, Box3 { min_m: [1.0, -1.5, 0.5], max_m: [1.5, -1.0, 3.0] });
        assert_eq!(imported.notes.len(), 3, "{:?}", imported.notes);
    }

    /// HOV-SG writes the centres of all cells of a room, row by row.
    #[test]
    fn grid_cells_of_a_room_become_its_outline() {
        let in_room = |x: usize, z: usize| x < 40 || z < 20;
        let cells = (0..80).flat_map(|z| (0..60).map(move |x| (x, z))).filter(|(x, z)| in_room(*x, *z));
        let vertices: Vec<[f64; 2]> = cells.map(|(x, z)| [1.025 + 0.05 * x as f64, -2.0 + 0.05 * z as f64]).collect();
        assert_eq!(vertices.len(), 3_600);
        let room = serde_json::json!({"room_id": "0_0", "name": "bedroom", "vertices": vertices, "room_height": 2.0, "room_zero_level": 0.0});
        let Imported { map, boxed, .. } = open_vocabulary(&room.to_string(), "home", Up::Y).unwrap();
        let footprint = map.rooms[0].space.footprint.as_ref().unwrap();
        assert!(boxed.is_empty());
        assert!((footprint.area_m2() - 9.0).abs() < 0.05, "{} m2", footprint.area_m2());
        let bounds = map.rooms[0].space.bounds;
        for (is, wanted) in bounds.min_m.iter().chain(&bounds.max_m).zip([1.0, -1.975, 0.0, 4.0, 2.025, 2.0]) {
            assert!((is - wanted).abs() < 1e-3, "{bounds:?}");
        }
    }

    #[test]
    fn a_scene_graph_of_concept_graphs_is_a_list() {
        let objects = r#"[{"id": 0, "bbox_extent": [1.0, 1.0, 1.0], "bbox_center": [1, 1, 0.5], "possible_tags": ["chair", "stool"], "object_tag": "office chair", "caption": "a chair"},
            {"id": 3, "bbox_extent": [1, 1, 1], "bbox_center": [2, 1, 0.5], "possible_tags": ["wall"], "object_tag": "invalid", "caption": "conflicting captions"}]"#;
        let rooms = r#"{"rooms": [{"name": "office", "box": {"min_m": [0, 0, 0], "max_m": [4, 4, 3]}}]}"#;
        let imported = open_vocabulary(&combine([objects, rooms]).unwrap(), "office", Up::Z).unwrap();
        assert_eq!((&imported.map.labels[..], imported.notes.len()), (&["office chair".to_owned()][..], 1));
    }

    /// Outlines that are none are refused before they are looked at, where all of them have more corners than a map.
    #[test]
    fn polygons_of_too_many_corners_are_refused_at_once() {
        let crossed = |corners: usize| {
            let zigzag = (0..corners - 2).map(|at| [(at % 2) as f64, at as f64 * 1e-3]);
            serde_json::json!({"name": "room", "vertices": zigzag.chain([[-1.0, -1.0], [2.0, 9.0]]).collect::<Vec<_>>()})
        };
        let imported =
            |rooms: Vec<Value>| open_vocabulary(&serde_json::json!({"rooms": rooms}).to_string(), "x", Up::Z);
        let few = imported((0..10).map(|_| crossed(1_000)).collect()).unwrap();
        assert_eq!(few.boxed.len(), 10, "they meet themselves");
        let message = |rooms: Vec<Value>| imported(rooms).unwrap_err().to_string();
        let many = message((0..11).map(|_| crossed(1_000)).collect());
        assert!(
            many.contains("rooms[10] (\"room-11\"), `footprint`: the map's footprints have more than 10000"),
            "{many}"
        );
        assert!(message(vec![crossed(60_000)]).contains("more than 10000 corners; simplify"));
        let rooms = message((0..9_000).map(|_| crossed(3)).collect());
        assert!(rooms.contains("65 entries, more than 64"), "{rooms}");
    }

    #[test]
    fn what_is_no_map_is_refused() {
        let message = |json: &str| open_vocabulary(json, "x", Up::Z).unwrap_err().to_string();
        assert!(message("3").contains("open-vocabulary map"));
        assert!(message("[3]").contains("[0]: the number `3`"), "{}", message("[3]"));
        assert!(message("[]").contains("has no room"));
        assert!(message("{\"rooms\": 3}").contains("rooms: the number `3`, expected a list"));
        assert!(message(&MAP.replace("[1, 1, 1], \"bbox", "[1, 1, 1e9], \"bbox")).contains("farther than 10 km"));
        assert!(message(&MAP.replace("\"weight\": ", "\"weight\": 1e10")).contains("between 1e-9 and 1e9"));
    }

    proptest! {
        #[test]
        fn hostile_text_never_panics(cut in 0..MAP.len(), noise in "\\PC{0,8}") {
            let text = format!("{}{noise}{}", &MAP[..cut], &MAP[cut..]);
            let _ = open_vocabulary(&text, "x", Up::Y);
            let _ = combine([text.as_str(), noise.as_str()]);
        }
    }
}
