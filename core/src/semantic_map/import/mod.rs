//! Converts maps of other formats to scenes: VirtualHome environment graphs, open-vocabulary maps, maps of vacuum robots and Home Assistant's
//! registries.
//!
//! Whatever is read passes the same checks as a scene file, so an import is a map or an error, never half a map.

use std::collections::{BTreeMap, HashMap, HashSet};

use super::checks::check_label;
use super::schema::{MAX_ALIASES, RoomEntry, SceneError, SceneFile, parse_json};
use super::{MAX_TEXT_BYTES, SemanticMap};
use crate::names::{Names, plain_words};
use crate::text::{excerpt, is_hidden};

mod furnish;
mod home_assistant;
mod open_vocabulary;
mod spelling;
mod valetudo;
mod virtualhome;

pub use furnish::Furnish;
pub use home_assistant::{Home, Registries, home_assistant};
pub use open_vocabulary::{Up, combine, open_vocabulary};
pub use valetudo::{MAX_PIXELS, MAX_ROOM_PIXELS, segment_names, valetudo};
pub use virtualhome::virtualhome;

/// A map and what the import has to say about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// The checked map.
    pub map: SemanticMap,
    /// The parts that were left out or changed, one sentence each, for people.
    pub notes: Vec<String>,
    /// Ids of the rooms with a polygon that is no outline: they are the boxes around it.
    pub boxed: Vec<String>,
}

/// Why a map of another format cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// Not JSON, or not of the format: a missing key, a wrong type.
    #[error("{message}; expected {expected}")]
    Json {
        /// The element, as `nodes[3].bounding_box`, and what the parser says, with line and column.
        message: String,
        /// What the file should be.
        expected: &'static str,
    },
    /// No room.
    #[error("has no room; {remedy}")]
    NoRooms {
        /// What to do.
        remedy: &'static str,
    },
    /// The names of segments name one that the map does not have.
    #[error("name the segment {:?}, but the map has {}", excerpt(.unknown), excerpt(&.there.join(", ")))]
    Names {
        /// The segment that is not there.
        unknown: String,
        /// The areas of the home.
        there: Vec<String>,
    },
    /// An area in the list of areas to leave out is unknown.
    #[error("has no area {:?} to leave out; its areas are {}", excerpt(.unknown), excerpt(&.there.join(", ")))]
    NoArea {
        /// The area that is not there.
        unknown: String,
        /// The names of the areas.
        there: Vec<String>,
    },
    /// The scene that came out breaks a rule of scenes.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

impl Imported {
    /// Checks the file of a map.
    fn new(file: SceneFile, notes: Vec<String>, boxed: Vec<String>) -> Result<Self, ImportError> {
        Ok(Self { map: SemanticMap::check(file)?, notes, boxed })
    }
}

fn parse<'a, T: serde::Deserialize<'a>>(json: &'a str, expected: &'static str) -> Result<T, ImportError> {
    parse_json(json).map_err(|message| ImportError::Json { message, expected })
}

/// Generates ids: words joined by hyphens, numbered from the second use on.
#[derive(Default)]
struct Ids {
    taken: HashSet<String>,
    /// The last number given per slug, so that many of one class do not search from the start.
    last: HashMap<String, usize>,
}

impl Ids {
    fn take(&mut self, words: &str) -> String {
        let slug = words.replace(' ', "-");
        let last = self.last.entry(slug.clone()).or_insert(0);
        loop {
            *last += 1;
            let id = if *last == 1 { slug.clone() } else { format!("{slug}-{last}") };
            if self.taken.insert(id.clone()) {
                return id;
            }
        }
    }
}

/// A given name of a room as plain words; `None` if it cannot stand in a map.
fn room_words(name: &str) -> Option<String> {
    let shown: String = name.chars().filter(|c| c.is_whitespace() || !is_hidden(*c)).collect();
    let plain = plain_words(&shown);
    // A capital letter without a small one would be refused.
    let fits = !plain.is_empty() && plain.len() <= MAX_TEXT_BYTES && plain.to_lowercase() == plain;
    fits.then_some(plain)
}

/// The label of a room by its given name, in any language; `None` for a name without words.
fn room_label(name: &str) -> Option<String> {
    let plain = room_words(name)?;
    Some(Names::built_in().room(&plain).map_or(plain, str::to_owned))
}

/// Names that rooms were given, each with its room's place, as aliases: of the room's label where no other room bears it, else of the room by
/// its id. A name of several rooms is no alias, and neither is the room's own label or id.
fn room_aliases(rooms: &[RoomEntry], named: Vec<(usize, String)>) -> BTreeMap<String, Vec<String>> {
    let named: Vec<(usize, String)> =
        named.into_iter().filter_map(|(place, name)| Some((place, room_words(&name)?))).collect();
    // The room of a name; `None` for a name of several rooms.
    let mut room_of: HashMap<&str, Option<usize>> = HashMap::new();
    for (place, name) in &named {
        let own = room_of.entry(name).or_insert(Some(*place));
        *own = own.filter(|own| own == place);
    }
    let is_own = |room: &RoomEntry| rooms.iter().all(|other| other.id == room.id || other.label != room.label);
    let key = |room: &RoomEntry| if is_own(room) { room.label.clone() } else { room.id.clone() };
    let keys: Vec<Option<String>> =
        rooms.iter().map(|room| Some(key(room)).filter(|key| check_label(key).is_ok())).collect();
    let mut aliases = BTreeMap::<String, Vec<String>>::new();
    let mut left = MAX_ALIASES;
    let mut known = HashSet::new();
    for (place, name) in &named {
        let Some(key) = keys[*place].as_ref().filter(|_| room_of[name.as_str()].is_some()) else { continue };
        let room = &rooms[*place];
        if left > 0 && *name != room.label && *name != plain_words(&room.id) && known.insert(name) {
            aliases.entry(key.clone()).or_default().push(name.clone());
            left -= 1;
        }
    }
    aliases
}

/// A note on rooms that have a number in place of a name.
fn unnamed(rooms: &[RoomEntry], remedy: &str) -> Option<String> {
    let count = rooms.iter().filter(|room| room.label.starts_with("room ")).count();
    (count > 0).then(|| format!("Rooms without a name ({count}): {remedy}."))
}

/// The words of a name, for a label.
fn words(name: &str) -> String {
    Names::built_in().words(name)
}
