//! The scene file, versions 1 and 2: reading, checking, writing. `scenes/README.md` documents it field by field.

use crate::parsing::json_says;
use crate::text::{excerpt, is_hidden, without_mark};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::footprint::{FEWER_CORNERS, Footprint, MAX_CORNERS, Space};
use super::{Box3, Caption, Door, Group, Item, LabelId, Part, Room, RoomId, SemanticMap, doors};

/// Largest scene file in bytes.
pub const MAX_FILE_BYTES: u64 = 64 << 20;
/// Most items in a map.
pub const MAX_ITEMS: usize = 100_000;
/// Most rooms in a map; parts, groups and doors may be ten times as many.
pub const MAX_ROOMS: usize = 64;
/// Longest id, label, name or alias, in bytes of UTF-8.
pub const MAX_TEXT_BYTES: usize = 128;

pub(super) const FORMAT: &str = "roomcast-scene";
/// The newest version. A map without footprints is written as version 1, so that its fingerprint does not change.
pub(super) const VERSION: u32 = 2;
/// Default height of a footprint, in metres.
pub(super) const ROOM_HEIGHT_M: f64 = 2.5;
/// Largest difference between a box and its footprint, in metres: numbers are rounded.
const ROUNDED_M: f64 = 0.01;
pub(super) const MAX_PROSE_BYTES: usize = 4_096;
pub(super) const MAX_CAPTIONS: usize = 64;
pub(super) const MAX_ALIASES: usize = 1_000;
/// Greatest coordinate of a map along each axis, in metres.
pub(super) const FARTHEST_M: f64 = 10_000.0;

/// Most faults in one report.
const FAULTS_MAX: usize = 20;

/// A scene that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// An error with its file.
    #[error("scene {}", path.display())]
    InFile {
        /// The file.
        path: PathBuf,
        /// The error.
        source: Box<SceneError>,
    },
    /// The file cannot be read.
    #[error("cannot be read; check that it exists and that you may read it")]
    Read(#[from] io::Error),
    /// The file is larger than [`MAX_FILE_BYTES`].
    #[error("is larger than {} MiB; split the building into several maps", MAX_FILE_BYTES >> 20)]
    FileTooLarge,
    /// Not JSON, or not the scene format: a missing or unknown key, or a wrong type.
    #[error(
        "{}{message}; see scenes/README.md for the format; `roomcast scene import` turns maps of other formats into scenes",
        place(.element)
    )]
    Json {
        /// Path to the element, such as `items[3].box`; `.` for the whole file.
        element: String,
        /// The parser's message, with line and column.
        message: String,
    },
    /// The text ends too early.
    #[error("ends too early, in line {line}{}: the file is empty or was cut off; get it again, whole", within(.element))]
    CutOff {
        /// The last line, from 1.
        line: usize,
        /// Path to the incomplete element; `.` for the whole file.
        element: String,
    },
    /// Another format or another version.
    #[error(
        "is `{format}` version {version}, but this program reads `{FORMAT}` versions 1 to {VERSION}; \
         import other maps with `roomcast scene import`"
    )]
    Format {
        /// The file's `format`.
        format: String,
        /// The file's `version`.
        version: u32,
    },
    /// Several of the other faults; at most the first 20.
    #[error("{}{} things are wrong:{}", if .0.len() < FAULTS_MAX { "" } else { "at least " }, .0.len(), listed(.0))]
    Several(Vec<SceneError>),
    /// One element breaks a rule.
    #[error("{element}, `{field}`: {problem}; {remedy}")]
    Element {
        /// Kind, index and id, such as `items[3] ("mug-1")`.
        element: String,
        /// The key with the problem.
        field: &'static str,
        /// The problem.
        problem: String,
        /// The remedy.
        remedy: &'static str,
    },
}

fn listed(faults: &[SceneError]) -> String {
    faults.iter().map(|fault| format!("\n- {fault}")).collect()
}

#[derive(Default)]
struct Faults(Vec<SceneError>);

impl Faults {
    /// Converts the valid entries. Stops after [`FAULTS_MAX`] faults.
    fn each<T, U>(
        &mut self,
        entries: impl IntoIterator<Item = T>,
        mut check: impl FnMut(T) -> Result<U, SceneError>,
    ) -> Vec<U> {
        let mut good = Vec::new();
        for entry in entries {
            if self.0.len() >= FAULTS_MAX {
                break;
            }
            match check(entry) {
                Ok(checked) => good.push(checked),
                Err(fault) => self.0.push(fault),
            }
        }
        good
    }

    fn end(mut self) -> Result<(), SceneError> {
        match self.0.len() {
            0 => Ok(()),
            1 => Err(self.0.remove(0)),
            _ => Err(SceneError::Several(self.0)),
        }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SceneFile {
    pub(super) format: String,
    pub(super) version: u32,
    pub(super) name: String,
    #[serde(default)]
    pub(super) description: String,
    #[serde(default)]
    pub(super) source: String,
    pub(super) rooms: Vec<RoomEntry>,
    #[serde(default)]
    pub(super) parts: Vec<PartEntry>,
    #[serde(default)]
    pub(super) groups: Vec<GroupEntry>,
    #[serde(default)]
    pub(super) doors: Vec<DoorEntry>,
    #[serde(default)]
    pub(super) aliases: BTreeMap<String, Vec<String>>,
    pub(super) items: Vec<ItemEntry>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RoomEntry {
    pub(super) id: String,
    pub(super) label: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) r#box: Option<Box3>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) footprint: Option<Rings>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) floor: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) height: Option<f64>,
}

/// An outline and its holes, as lists of `[x, y]`.
pub(super) type Rings = Vec<Vec<[f64; 2]>>;

impl RoomEntry {
    pub(super) fn boxed(id: String, label: String, bounds: Box3) -> Self {
        Self { id, label, r#box: Some(bounds), footprint: None, floor: None, height: None }
    }

    pub(super) fn outlined(id: String, label: String, footprint: Rings, floor_m: f64, height_m: f64) -> Self {
        let (floor, height) = (Some(floor_m), Some(height_m));
        Self { id, label, r#box: None, footprint: Some(footprint), floor, height }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PartEntry {
    pub(super) id: String,
    pub(super) label: String,
    pub(super) room: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) r#box: Option<Box3>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) footprint: Option<Rings>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) floor: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) height: Option<f64>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct GroupEntry {
    pub(super) id: String,
    pub(super) label: String,
    pub(super) rooms: Vec<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) r#box: Option<Box3>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) footprint: Option<Rings>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) floor: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) height: Option<f64>,
}

/// The keys of an entry that describe its space.
struct Extent<'a> {
    bounds: Option<Box3>,
    footprint: Option<&'a Rings>,
    floor: Option<f64>,
    height: Option<f64>,
}

/// Limits the cost of footprints.
struct Corners {
    version: u32,
    left: CornersLeft,
}

/// Corners that a map's footprints may still have.
pub(super) struct CornersLeft(usize);

impl CornersLeft {
    pub(super) fn new() -> Self {
        Self(MAX_CORNERS)
    }

    /// Counts the corners of an element's rings; call it before any other work on them.
    pub(super) fn take(&mut self, list: &'static str, index: usize, id: &str, rings: &Rings) -> Result<(), SceneError> {
        let count: usize = rings.iter().map(Vec::len).sum();
        self.0 = self.0.checked_sub(count).ok_or_else(|| {
            let problem = format!("the map's footprints have more than {MAX_CORNERS} corners");
            Place { list, index, id }.error("footprint", problem, FEWER_CORNERS)
        })?;
        Ok(())
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DoorEntry {
    pub(super) id: String,
    pub(super) rooms: [String; 2],
    pub(super) position_m: [f64; 3],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ItemEntry {
    pub(super) id: String,
    pub(super) label: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) captions: Vec<CaptionEntry>,
    pub(super) position_m: [f64; 3],
    pub(super) r#box: Box3,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CaptionEntry {
    pub(super) label: String,
    pub(super) weight: f64,
}

/// The prefix of a message about an element of a JSON file; empty for the whole file.
pub(super) fn place(element: &str) -> String {
    if element == "." { String::new() } else { format!("{element}: ") }
}

/// The element at which a parser stopped. If the text is not JSON, the last step is unknown.
pub(super) fn element_of(path: &serde_path_to_error::Path) -> String {
    let known = path.iter().take_while(|segment| !matches!(segment, serde_path_to_error::Segment::Unknown));
    let mut element = String::new();
    for segment in known {
        let is_index = matches!(segment, serde_path_to_error::Segment::Seq { .. });
        element.push_str(if is_index || element.is_empty() { "" } else { "." });
        element.push_str(&segment.to_string());
    }
    if element.is_empty() { ".".to_owned() } else { excerpt(&element).into_owned() }
}

/// The end of a message about a text that ends too early.
fn within(element: &str) -> String {
    if element == "." { String::new() } else { format!(", within {element}") }
}

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

    fn id(self) -> Result<(), SceneError> {
        check_text(self.id, MAX_TEXT_BYTES)
            .map_err(|problem| self.error("id", problem, "give every element a short id"))
    }

    fn label(self, label: &str) -> Result<(), SceneError> {
        let remedy = "write lower-case words separated by single spaces, as \"washing machine\"";
        check_label(label).map_err(|problem| self.error("label", problem, remedy))
    }

    fn point(self, field: &'static str, point_m: &[f64; 3]) -> Result<(), SceneError> {
        // This form also refuses NaN.
        if point_m.iter().all(|metres| metres.abs() <= FARTHEST_M) {
            return Ok(());
        }
        Err(self.error(
            field,
            format!("{point_m:?} lies farther than 10 km from the origin"),
            "give metres and move the origin into the building",
        ))
    }

    fn bounds(self, bounds: &Box3) -> Result<(), SceneError> {
        self.point("box", &bounds.min_m)?;
        self.point("box", &bounds.max_m)?;
        if (0..3).all(|axis| bounds.min_m[axis] <= bounds.max_m[axis]) {
            return Ok(());
        }
        Err(self.error(
            "box",
            format!("min_m {:?} exceeds max_m {:?}", bounds.min_m, bounds.max_m),
            "give the least corner as min_m and the greatest as max_m",
        ))
    }

    /// The box of an entry, or its footprint between floor and ceiling. `around` is the enclosing space, if known.
    fn space(self, extent: &Extent, around: Option<Box3>, corners: &mut Corners) -> Result<Space, SceneError> {
        if let Some(bounds) = &extent.bounds {
            self.bounds(bounds)?;
            if bounds.volume_m3() <= 0.0 {
                let problem = "has no volume, so nothing can lie in it";
                return Err(self.error("box", problem, "give it a length, a width and a height"));
            }
        }
        if let Some(rings) = extent.footprint {
            return self.prism(rings, extent, around, corners);
        }
        for (field, given) in [("floor", extent.floor), ("height", extent.height)] {
            if given.is_some() {
                return Err(self.error(
                    field,
                    "belongs to a footprint",
                    "give a `footprint`, too, or say it in the `box`",
                ));
            }
        }
        let remedy = "give a `box`, or a `footprint` with `floor` and `height`";
        extent.bounds.map(Space::from).ok_or_else(|| self.error("box", "is missing", remedy))
    }

    fn prism(
        self,
        rings: &Rings,
        extent: &Extent,
        around: Option<Box3>,
        corners: &mut Corners,
    ) -> Result<Space, SceneError> {
        if corners.version < 2 {
            let problem = "is a key of version 2";
            return Err(self.error("footprint", problem, "write \"version\": 2 at the top of the file"));
        }
        corners.left.take(self.list, self.index, self.id, rings)?;
        rings.iter().flatten().try_for_each(|[x, y]| self.point("footprint", &[*x, *y, 0.0]))?;
        let footprint = Footprint::new(rings).map_err(|(problem, remedy)| self.error("footprint", problem, remedy))?;

        let agree = |a: f64, b: f64| (a - b).abs() <= ROUNDED_M;
        let from = extent.bounds.or(around);
        let floor_m = extent.floor.or(from.map(|bounds| bounds.min_m[2])).unwrap_or(0.0);
        let height_m = extent.height.or(from.map(|bounds| bounds.size_m()[2])).unwrap_or(ROOM_HEIGHT_M);
        let [least, most] = footprint.around();
        let mut bounds = Box3 { min_m: [least[0], least[1], floor_m], max_m: [most[0], most[1], floor_m + height_m] };
        self.point("floor", &bounds.min_m)?;
        self.point("height", &bounds.max_m)?;
        if let Some(own) = extent.bounds {
            let same = (0..3)
                .all(|axis| agree(own.min_m[axis], bounds.min_m[axis]) && agree(own.max_m[axis], bounds.max_m[axis]));
            if !same {
                let problem = format!(
                    "from {:?} to {:?} is not the box around the footprint, from {:?} to {:?}",
                    own.min_m, own.max_m, bounds.min_m, bounds.max_m
                );
                return Err(self.error("box", problem, "leave out the box of an element that has a footprint"));
            }
            (bounds.min_m[2], bounds.max_m[2]) = (own.min_m[2], own.max_m[2]);
        }
        if bounds.volume_m3() <= 0.0 {
            return Err(self.error(
                "height",
                "leaves no volume, so nothing can lie in it",
                "give the height in metres",
            ));
        }
        Ok(Space { bounds, footprint: Some(footprint) })
    }
}

fn check_text(text: &str, longest_bytes: usize) -> Result<(), String> {
    if text.is_empty() {
        return Err("is empty".to_owned());
    }
    check_prose(text, longest_bytes)
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
    Place { list, index, id }.id()
}

/// Ids of one kind of element, to resolve references; refuses duplicates.
struct Ids<'a>(HashMap<&'a str, usize>);

impl<'a> Ids<'a> {
    fn new() -> Self {
        Self(HashMap::new())
    }

    fn insert(&mut self, place: Place<'a>) -> Result<(), SceneError> {
        place.id()?;
        match self.0.insert(place.id, place.index) {
            None => Ok(()),
            Some(_) => Err(place.error("id", "is used twice", "give every element an id of its own")),
        }
    }
}

fn index_u32(index: usize) -> u32 {
    u32::try_from(index).unwrap_or(u32::MAX)
}

impl SemanticMap {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// If the file cannot be read, or as [`SemanticMap::from_json`]; the error names the file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, SceneError> {
        let path = path.as_ref();
        read_limited(path)
            .and_then(|text| Self::from_json(&text))
            .map_err(|error| SceneError::InFile { path: path.to_owned(), source: Box::new(error) })
    }

    /// Parses and checks a scene.
    ///
    /// # Errors
    /// Names each element that is malformed, exceeds a limit, is duplicated, or refers to an unknown element. Contents and doors of rooms are checked
    /// only if all rooms are valid.
    pub fn from_json(text: &str) -> Result<Self, SceneError> {
        if text.len() as u64 > MAX_FILE_BYTES {
            return Err(SceneError::FileTooLarge);
        }
        let mut parser = serde_json::Deserializer::from_str(without_mark(text));
        let json_error = |element, error: &serde_json::Error| SceneError::Json { element, message: json_says(error) };
        let file: SceneFile = serde_path_to_error::deserialize(&mut parser).map_err(|error| {
            if error.inner().is_eof() {
                let (line, element) = (error.inner().line(), element_of(error.path()));
                return SceneError::CutOff { line, element };
            }
            json_error(element_of(error.path()), error.inner())
        })?;
        parser.end().map_err(|error| json_error("end".to_owned(), &error))?;
        Self::check(file)
    }

    /// The scene as JSON text, one element per line; [`SemanticMap::from_json`] reads it back as an equal map.
    #[must_use]
    pub fn to_json(&self) -> String {
        #[expect(clippy::expect_used, reason = "the file's types hold nothing that JSON cannot say: keys are strings")]
        to_json_lines(&self.to_file()).expect("a scene is always JSON")
    }

    /// The first 16 hexadecimal digits of the fingerprint, for people.
    #[must_use]
    pub fn short_fingerprint(&self) -> String {
        self.fingerprint[..8].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    pub(super) fn check(file: SceneFile) -> Result<Self, SceneError> {
        if file.format != FORMAT || !(1..=VERSION).contains(&file.version) {
            let format = file.format.chars().take(MAX_TEXT_BYTES).collect();
            return Err(SceneError::Format { format, version: file.version });
        }
        let scene = Place { list: "scene", index: 0, id: &file.name };
        check_count("rooms", file.rooms.len(), MAX_ROOMS)?;
        check_count("parts", file.parts.len(), 10 * MAX_ROOMS)?;
        check_count("groups", file.groups.len(), 10 * MAX_ROOMS)?;
        check_count("doors", file.doors.len(), 10 * MAX_ROOMS)?;
        check_count("items", file.items.len(), MAX_ITEMS)?;
        // A label without other words counts, too.
        check_count("aliases", file.aliases.values().map(|others| others.len().max(1)).sum(), MAX_ALIASES)?;
        if file.rooms.is_empty() {
            return Err(scene.error("rooms", "has no entry", "give at least one room"));
        }

        let mut faults = Faults::default();
        let texts = [
            ("name", check_text(&file.name, MAX_TEXT_BYTES), "give a short name"),
            ("description", check_prose(&file.description, MAX_PROSE_BYTES), "shorten it to one line"),
            ("source", check_prose(&file.source, MAX_PROSE_BYTES), "shorten it to one line"),
        ];
        faults.each(texts, |(field, checked, remedy)| checked.map_err(|problem| scene.error(field, problem, remedy)));

        // Rooms, parts and groups can all be partitions, so they share one namespace of ids.
        let mut partition_ids = Ids::new();
        let mut room_ids = Ids::new();
        let mut corners = Corners { version: file.version, left: CornersLeft::new() };
        let rooms = check_rooms(&file.rooms, &mut partition_ids, &mut room_ids, &mut corners, &mut faults);
        let (mut parts, mut groups, mut doors) = (Vec::new(), Vec::new(), Vec::new());
        let doors_found = file.doors.is_empty();
        if rooms.len() == file.rooms.len() {
            parts = check_parts(&file.parts, &mut partition_ids, &room_ids, &rooms, &mut corners, &mut faults);
            groups = check_groups(&file.groups, &mut partition_ids, &room_ids, &rooms, &mut corners, &mut faults);
            doors = check_doors(&file.doors, &room_ids, &mut faults);
        }
        faults.each(file.aliases.iter().enumerate(), |(index, (label, others))| {
            let place = Place { list: "aliases", index, id: label };
            [label].into_iter().chain(others).try_for_each(|words| place.label(words))
        });
        let (labels, items) = check_items(&file.items, &mut faults);
        faults.end()?;
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

    /// The doors as entries of a file, found doors included.
    pub(super) fn door_entries(&self) -> Vec<DoorEntry> {
        let room = |RoomId(index): RoomId| self.rooms[index as usize].id.clone();
        (self.doors.iter())
            .map(|door| DoorEntry { id: door.id.clone(), rooms: door.rooms.map(room), position_m: door.position_m })
            .collect()
    }

    pub(super) fn to_file(&self) -> SceneFile {
        let label = |LabelId(index): LabelId| self.labels[index as usize].clone();
        let room = |RoomId(index): RoomId| self.rooms[index as usize].id.clone();
        let outline = |space: &Space| space.footprint.as_ref().map(|footprint| footprint.rings().to_vec());
        let spaces = self.rooms.iter().map(|room| &room.space).chain(self.parts.iter().map(|part| &part.space));
        let spaces = spaces.chain(self.groups.iter().filter_map(|group| group.space.as_ref()));
        let version = if spaces.clone().any(|space| space.footprint.is_some()) { VERSION } else { 1 };
        SceneFile {
            format: FORMAT.to_owned(),
            version,
            name: self.name.clone(),
            description: self.description.clone(),
            source: self.source.clone(),
            rooms: (self.rooms.iter())
                .map(|room| RoomEntry {
                    footprint: outline(&room.space),
                    ..RoomEntry::boxed(room.id.clone(), room.label.clone(), room.space.bounds)
                })
                .collect(),
            parts: (self.parts.iter())
                .map(|part| PartEntry {
                    id: part.id.clone(),
                    label: part.label.clone(),
                    room: room(part.room),
                    r#box: Some(part.space.bounds),
                    footprint: outline(&part.space),
                    floor: None,
                    height: None,
                })
                .collect(),
            groups: (self.groups.iter())
                .map(|group| GroupEntry {
                    id: group.id.clone(),
                    label: group.label.clone(),
                    rooms: group.rooms.iter().map(|&id| room(id)).collect(),
                    r#box: group.space.as_ref().map(|space| space.bounds),
                    footprint: group.space.as_ref().and_then(outline),
                    floor: None,
                    height: None,
                })
                .collect(),
            doors: if self.doors_found { Vec::new() } else { self.door_entries() },
            aliases: self.aliases.clone(),
            items: (self.items.iter())
                .map(|item| ItemEntry {
                    id: item.id.clone(),
                    label: label(item.label),
                    captions: (item.captions.iter())
                        .map(|caption| CaptionEntry { label: label(caption.label), weight: caption.weight })
                        .collect(),
                    position_m: item.position_m,
                    r#box: item.bounds,
                })
                .collect(),
        }
    }
}

/// Reads a text file up to one byte over [`MAX_FILE_BYTES`], so that the caller can detect the excess.
///
/// # Errors
/// If the file cannot be read or is not UTF-8. The error does not name the file.
pub fn read_limited(path: &Path) -> Result<String, SceneError> {
    let mut text = String::new();
    // The limit applies while reading, because a device or a pipe has no size.
    File::open(path)?.take(MAX_FILE_BYTES + 1).read_to_string(&mut text)?;
    Ok(text)
}

fn to_json_lines(file: &SceneFile) -> serde_json::Result<String> {
    fn list<T: Serialize>(text: &mut String, key: &str, entries: &[T]) -> serde_json::Result<()> {
        text.push_str(&format!(",\n  \"{key}\": ["));
        for (index, entry) in entries.iter().enumerate() {
            text.push_str(if index == 0 { "\n    " } else { ",\n    " });
            text.push_str(&serde_json::to_string(entry)?);
        }
        text.push_str(if entries.is_empty() { "]" } else { "\n  ]" });
        Ok(())
    }
    let mut text = format!(
        "{{\n  \"format\": {}, \"version\": {},\n  \"name\": {},\n  \"description\": {},\n  \"source\": {}",
        serde_json::to_string(&file.format)?,
        file.version,
        serde_json::to_string(&file.name)?,
        serde_json::to_string(&file.description)?,
        serde_json::to_string(&file.source)?,
    );
    list(&mut text, "rooms", &file.rooms)?;
    list(&mut text, "parts", &file.parts)?;
    list(&mut text, "groups", &file.groups)?;
    list(&mut text, "doors", &file.doors)?;
    text.push_str(&format!(",\n  \"aliases\": {}", serde_json::to_string(&file.aliases)?));
    list(&mut text, "items", &file.items)?;
    text.push_str("\n}\n");
    Ok(text)
}

fn check_rooms<'a>(
    entries: &'a [RoomEntry],
    partition_ids: &mut Ids<'a>,
    room_ids: &mut Ids<'a>,
    corners: &mut Corners,
    faults: &mut Faults,
) -> Vec<Room> {
    faults.each(entries.iter().enumerate(), |(index, entry)| {
        let place = Place { list: "rooms", index, id: &entry.id };
        partition_ids.insert(place)?;
        room_ids.insert(place)?;
        place.label(&entry.label)?;
        let RoomEntry { r#box: bounds, ref footprint, floor, height, .. } = *entry;
        let extent = Extent { bounds, footprint: footprint.as_ref(), floor, height };
        let space = place.space(&extent, None, corners)?;
        Ok(Room { id: entry.id.clone(), label: entry.label.clone(), space })
    })
}

fn find_room(place: Place, field: &'static str, id: &str, room_ids: &Ids) -> Result<RoomId, SceneError> {
    let found = room_ids.0.get(id).map(|&index| RoomId(index_u32(index)));
    found.ok_or_else(|| {
        let id: String = id.chars().take(MAX_TEXT_BYTES).collect();
        place.error(field, format!("there is no room {id:?}"), "use the id of an entry of `rooms`")
    })
}

fn check_parts<'a>(
    entries: &'a [PartEntry],
    partition_ids: &mut Ids<'a>,
    room_ids: &Ids,
    rooms: &[Room],
    corners: &mut Corners,
    faults: &mut Faults,
) -> Vec<Part> {
    faults.each(entries.iter().enumerate(), |(index, entry)| {
        let place = Place { list: "parts", index, id: &entry.id };
        partition_ids.insert(place)?;
        place.label(&entry.label)?;
        let room = find_room(place, "room", &entry.room, room_ids)?;
        let around = &rooms[room.0 as usize].space;
        let PartEntry { r#box: bounds, ref footprint, floor, height, .. } = *entry;
        let extent = Extent { bounds, footprint: footprint.as_ref(), floor, height };
        let space = place.space(&extent, Some(around.bounds), corners)?;
        if !around.meets(&space) {
            let field = if space.footprint.is_some() { "footprint" } else { "box" };
            return Err(place.error(field, "lies outside its room", "give a place inside the room"));
        }
        Ok(Part { id: entry.id.clone(), label: entry.label.clone(), room, space })
    })
}

fn check_groups<'a>(
    entries: &'a [GroupEntry],
    partition_ids: &mut Ids<'a>,
    room_ids: &Ids,
    all_rooms: &[Room],
    corners: &mut Corners,
    faults: &mut Faults,
) -> Vec<Group> {
    let mut taken = BTreeSet::new();
    faults.each(entries.iter().enumerate(), |(index, entry)| {
        let place = Place { list: "groups", index, id: &entry.id };
        partition_ids.insert(place)?;
        place.label(&entry.label)?;
        if entry.rooms.is_empty() {
            return Err(place.error("rooms", "has no entry", "name at least one room or remove the group"));
        }
        let mut rooms = Vec::with_capacity(entry.rooms.len());
        for id in &entry.rooms {
            let room = find_room(place, "rooms", id, room_ids)?;
            if !taken.insert(room) {
                let problem = format!("the room {id:?} is already in a group");
                return Err(place.error("rooms", problem, "put every room into at most one group, once"));
            }
            rooms.push(room);
        }
        let GroupEntry { r#box: bounds, ref footprint, floor, height, .. } = *entry;
        let own = bounds.is_some() || footprint.is_some() || floor.is_some() || height.is_some();
        let space = if own {
            if footprint.is_none() {
                let remedy = "leave it out, or give the group a `footprint`";
                return Err(place.error("box", "is no outline of a group, which takes up its rooms", remedy));
            }
            let around = rooms.iter().map(|room| all_rooms[room.0 as usize].space.bounds).reduce(|a, b| Box3 {
                min_m: std::array::from_fn(|axis| a.min_m[axis].min(b.min_m[axis])),
                max_m: std::array::from_fn(|axis| a.max_m[axis].max(b.max_m[axis])),
            });
            Some(place.space(&Extent { bounds, footprint: footprint.as_ref(), floor, height }, around, corners)?)
        } else {
            None
        };
        Ok(Group { id: entry.id.clone(), label: entry.label.clone(), rooms, space })
    })
}

fn check_doors(entries: &[DoorEntry], room_ids: &Ids, faults: &mut Faults) -> Vec<Door> {
    let mut ids = Ids::new();
    faults.each(entries.iter().enumerate(), |(index, entry)| {
        let place = Place { list: "doors", index, id: &entry.id };
        ids.insert(place)?;
        place.point("position_m", &entry.position_m)?;
        let [a, b] = &entry.rooms;
        let rooms = [find_room(place, "rooms", a, room_ids)?, find_room(place, "rooms", b, room_ids)?];
        if rooms[0] == rooms[1] {
            return Err(place.error("rooms", "joins a room to itself", "name two different rooms"));
        }
        Ok(Door { id: entry.id.clone(), rooms, position_m: entry.position_m })
    })
}

fn check_items(entries: &[ItemEntry], faults: &mut Faults) -> (Vec<String>, Vec<Item>) {
    let mut ids = Ids::new();
    let mut words = BTreeSet::new();
    faults.each(entries.iter().enumerate(), |(index, entry)| {
        let place = Place { list: "items", index, id: &entry.id };
        ids.insert(place)?;
        place.label(&entry.label)?;
        place.point("position_m", &entry.position_m)?;
        place.bounds(&entry.r#box)?;
        check_captions(place, entry)?;
        words.insert(entry.label.as_str());
        words.extend(entry.captions.iter().map(|caption| caption.label.as_str()));
        Ok(())
    });
    let labels: Vec<&str> = words.into_iter().collect();
    let label_id = |label: &str| LabelId(index_u32(labels.partition_point(|known| *known < label)));
    let items = (entries.iter())
        .map(|entry| {
            let total: f64 = entry.captions.iter().map(|caption| caption.weight).sum();
            // Normalised shares stay unchanged, so that writing and reading give an equal map.
            let total = if (total - 1.0).abs() < 1e-9 { 1.0 } else { total };
            let caption =
                |entry: &CaptionEntry| Caption { label: label_id(&entry.label), weight: entry.weight / total };
            Item {
                id: entry.id.clone(),
                label: label_id(&entry.label),
                captions: entry.captions.iter().map(caption).collect(),
                position_m: entry.position_m,
                bounds: entry.r#box,
            }
        })
        .collect();
    (labels.iter().map(|&label| label.to_owned()).collect(), items)
}

/// Least share of a caption.
pub(crate) const SHARE_MIN: f64 = 1e-9;

fn check_captions(place: Place, entry: &ItemEntry) -> Result<(), SceneError> {
    let captions = &entry.captions;
    if captions.is_empty() {
        return Ok(());
    }
    if captions.len() > MAX_CAPTIONS {
        let problem = format!("{} entries, more than {MAX_CAPTIONS}", captions.len());
        return Err(place.error("captions", problem, "keep the heaviest"));
    }
    let total: f64 = captions.iter().map(|caption| caption.weight).sum();
    for (index, caption) in captions.iter().enumerate() {
        place.label(&caption.label)?;
        // Within these bounds no sum or share overflows or underflows; NaN fails, too.
        if !(1e-9..=1e9).contains(&caption.weight) {
            let problem = format!("the weight {} is not between 1e-9 and 1e9", caption.weight);
            return Err(place.error("captions", problem, "give a positive weight or remove the caption"));
        }
        // Files contain the shares, so they must be large enough to be read back.
        if caption.weight / total.max(1.0) < SHARE_MIN {
            let problem = format!("the weight {} is less than {SHARE_MIN} of all", caption.weight);
            return Err(place.error("captions", problem, "remove the caption"));
        }
        if captions[..index].iter().any(|earlier| earlier.label == caption.label) {
            let problem = format!("has {:?} twice", caption.label);
            return Err(place.error("captions", problem, "add the weights up in one entry"));
        }
    }
    if captions.iter().all(|caption| caption.label != entry.label) {
        let problem = format!("{:?} is not among its captions", entry.label);
        return Err(place.error("label", problem, "make it the heaviest caption"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::{Value, json};

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
    fn text_that_is_no_json_is_told_of_by_line_and_by_what_is_known_of_its_place() {
        let colon = TWO_ROOMS.replacen("\"label\": \"mug\"", "\"label\" \"mug\"", 1);
        let comma = TWO_ROOMS.trim_end().strip_suffix('}').unwrap().to_owned() + ",}";
        for (text, expected) in [(colon, "items[0]: expected `:` at line "), (comma, "trailing comma at line ")] {
            assert_ne!(text, TWO_ROOMS);
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
    fn a_file_that_was_cut_off_is_called_so() {
        let half = &TWO_ROOMS[..TWO_ROOMS.find("\"items\"").unwrap() + 60];
        let text = message(&SemanticMap::from_json(half).unwrap_err());
        assert!(text.contains("ends too early, in line ") && text.contains("within items[0]"), "{text}");
        let text = message(&SemanticMap::from_json("").unwrap_err());
        assert!(text.starts_with("ends too early, in line 1: the file is empty or was cut off"), "{text}");
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

    #[test]
    fn text_after_the_scene_is_refused() {
        let error = SemanticMap::from_json(&format!("{TWO_ROOMS} true")).unwrap_err();
        assert!(message(&error).starts_with("end: more stands behind the end"), "{}", message(&error));
    }

    proptest! {
        #[test]
        fn hostile_text_never_panics(cut in 0..TWO_ROOMS.len(), noise in "\\PC{0,8}") {
            if TWO_ROOMS.is_char_boundary(cut) {
                let text = format!("{}{noise}{}", &TWO_ROOMS[..cut], &TWO_ROOMS[cut..]);
                let _ = SemanticMap::from_json(&text);
                let _ = SemanticMap::from_json(&TWO_ROOMS[..cut]);
            }
        }
    }
}
