//! The scene file, versions 1 and 2: its entries, reading and writing. `scenes/README.md` documents it field by field.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::footprint::Space;
use super::{Box3, LabelId, RoomId, SemanticMap};
use crate::parsing::json_says;
use crate::text::{excerpt, without_mark};

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
pub(super) const MAX_PROSE_BYTES: usize = 4_096;
pub(super) const MAX_CAPTIONS: usize = 64;
pub(super) const MAX_ALIASES: usize = 1_000;
/// Greatest coordinate of a map along each axis, in metres.
pub(super) const FARTHEST_M: f64 = 10_000.0;
/// Least share of a caption.
pub(super) const SHARE_MIN: f64 = 1e-9;

/// Most faults in one report.
pub(super) const FAULTS_MAX: usize = 20;

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
    /// Not JSON, or not the scene format: a missing or unknown key, or a wrong type. The text names the element and the line.
    #[error(
        "{0}; see scenes/README.md for the format; `roomcast scene import` turns maps of other formats into scenes"
    )]
    Json(String),
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

impl SceneFile {
    /// A file with rooms and items alone.
    pub(super) fn new(name: &str, source: &str, rooms: Vec<RoomEntry>, items: Vec<ItemEntry>) -> Self {
        Self {
            format: FORMAT.to_owned(),
            version: VERSION,
            name: name.to_owned(),
            description: String::new(),
            source: source.to_owned(),
            rooms,
            parts: Vec::new(),
            groups: Vec::new(),
            doors: Vec::new(),
            aliases: BTreeMap::new(),
            items,
        }
    }
}

/// An outline and its holes, as lists of `[x, y]`.
pub(super) type Rings = Vec<Vec<[f64; 2]>>;

/// The keys of an entry that describe its space.
#[derive(Clone, Copy)]
pub(super) struct Extent<'a> {
    pub(super) bounds: Option<Box3>,
    pub(super) footprint: Option<&'a Rings>,
    pub(super) floor: Option<f64>,
    pub(super) height: Option<f64>,
}

/// Entries with a space differ in the keys after the label alone. `flatten` would hide the element of an error.
macro_rules! entry_with_space {
    ($(#[$about:meta])* $name:ident { $($key:ident: $kind:ty),* }) => {
        $(#[$about])*
        #[derive(Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            pub(super) id: String,
            pub(super) label: String,
            $(pub(super) $key: $kind,)*
            #[serde(skip_serializing_if = "Option::is_none")]
            pub(super) r#box: Option<Box3>,
            #[serde(skip_serializing_if = "Option::is_none")]
            pub(super) footprint: Option<Rings>,
            #[serde(skip_serializing_if = "Option::is_none")]
            pub(super) floor: Option<f64>,
            #[serde(skip_serializing_if = "Option::is_none")]
            pub(super) height: Option<f64>,
        }

        impl $name {
            fn new(id: &str, label: &str, $($key: $kind,)* space: Option<&Space>) -> Self {
                let footprint = space.and_then(|space| Some(space.footprint.as_ref()?.rings().to_vec()));
                let r#box = space.map(|space| space.bounds);
                Self { id: id.to_owned(), label: label.to_owned(), $($key,)* r#box, footprint, floor: None, height: None }
            }

            pub(super) fn extent(&self) -> Extent<'_> {
                let Self { r#box: bounds, footprint, floor, height, .. } = self;
                Extent { bounds: *bounds, footprint: footprint.as_ref(), floor: *floor, height: *height }
            }
        }
    };
}

entry_with_space!(
    /// An entry of a scene file's `rooms`, checked when the map is.
    RoomEntry {}
);
entry_with_space!(
    /// An entry of a scene file's `parts`.
    PartEntry { room: String }
);
entry_with_space!(
    /// An entry of a scene file's `groups`.
    GroupEntry { rooms: Vec<String> }
);

impl RoomEntry {
    pub(super) fn boxed(id: String, label: String, bounds: Box3) -> Self {
        Self { id, label, r#box: Some(bounds), footprint: None, floor: None, height: None }
    }

    pub(super) fn outlined(id: String, label: String, footprint: Rings, floor_m: f64, height_m: f64) -> Self {
        let (floor, height) = (Some(floor_m), Some(height_m));
        Self { id, label, r#box: None, footprint: Some(footprint), floor, height }
    }
}

/// An entry of a scene file's `doors`, checked when the map is.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoorEntry {
    pub(super) id: String,
    pub(super) rooms: [String; 2],
    pub(super) position_m: [f64; 3],
}

/// An entry of a scene file's `items`, checked when the map is.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ItemEntry {
    pub(super) id: String,
    pub(super) label: String,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) captions: Vec<CaptionEntry>,
    pub(super) position_m: [f64; 3],
    pub(super) r#box: Box3,
}

impl ItemEntry {
    /// An item with a certain label, in the middle of its box.
    pub(super) fn boxed(id: String, label: &str, bounds: Box3) -> Self {
        Self { id, label: label.to_owned(), captions: Vec::new(), position_m: bounds.centre_m(), r#box: bounds }
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CaptionEntry {
    pub(super) label: String,
    pub(super) weight: f64,
}

/// Parses JSON. The fault names the element, unless it is the whole text, and the line.
pub(super) fn parse_json<'a, T: Deserialize<'a>>(text: &'a str) -> Result<T, String> {
    let mut parser = serde_json::Deserializer::from_str(without_mark(text));
    let value = serde_path_to_error::deserialize(&mut parser).map_err(|error| {
        let said = match error.inner() {
            inner if inner.is_eof() => {
                format!("the text ends too early, in line {}: it is empty or was cut off", inner.line())
            }
            inner => json_says(inner),
        };
        format!("{}{said}", place_of(error.path()))
    })?;
    parser.end().map_err(|error| format!("end: {}", json_says(&error)))?;
    Ok(value)
}

/// The element at which a parser stopped, before its message. If the text is not JSON, the last step is unknown.
fn place_of(path: &serde_path_to_error::Path) -> String {
    let known = path.iter().take_while(|segment| !matches!(segment, serde_path_to_error::Segment::Unknown));
    let mut element = String::new();
    for segment in known {
        let is_index = matches!(segment, serde_path_to_error::Segment::Seq { .. });
        element.push_str(if is_index || element.is_empty() { "" } else { "." });
        element.push_str(&segment.to_string());
    }
    if element.is_empty() { element } else { format!("{}: ", excerpt(&element)) }
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
        Self::check(parse_json(text).map_err(SceneError::Json)?)
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
        hex::encode(&self.fingerprint[..8])
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
        let room = |RoomId(index): &RoomId| self.rooms[*index as usize].id.clone();
        let rooms = self.rooms.iter().map(|room| RoomEntry::new(&room.id, &room.label, Some(&room.space)));
        let parts = self.parts.iter();
        let parts = parts.map(|part| PartEntry::new(&part.id, &part.label, room(&part.room), Some(&part.space)));
        let groups = self.groups.iter().map(|group| {
            GroupEntry::new(&group.id, &group.label, group.rooms.iter().map(room).collect(), group.space.as_ref())
        });
        let items = self.items.iter().map(|item| {
            let captions = item.captions.iter();
            ItemEntry {
                id: item.id.clone(),
                label: label(item.label),
                captions: captions.map(|own| CaptionEntry { label: label(own.label), weight: own.weight }).collect(),
                position_m: item.position_m,
                r#box: item.bounds,
            }
        });
        let mut file = SceneFile {
            description: self.description.clone(),
            parts: parts.collect(),
            groups: groups.collect(),
            doors: if self.doors_found { Vec::new() } else { self.door_entries() },
            aliases: self.aliases.clone(),
            ..SceneFile::new(&self.name, &self.source, rooms.collect(), items.collect())
        };
        let outlines = (file.rooms.iter().map(|room| &room.footprint))
            .chain(file.parts.iter().map(|part| &part.footprint))
            .chain(file.groups.iter().map(|group| &group.footprint));
        if outlines.flatten().next().is_none() {
            file.version = 1;
        }
        file
    }
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
