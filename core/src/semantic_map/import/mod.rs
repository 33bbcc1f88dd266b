//! Maps of other formats, turned into scenes: VirtualHome environment graphs, open-vocabulary maps, maps of vacuum robots and Home Assistant's registries.
//!
//! Whatever is read passes the same checks as a scene file, so an import is a map or an error, never half a map.

use std::collections::{HashMap, HashSet};

use super::SemanticMap;
use super::schema::{self, SceneError};
use crate::names::Names;

mod furnish;
mod home_assistant;
mod open_vocabulary;
mod spelling;
mod valetudo;
mod virtualhome;

pub use home_assistant::{Home, Registries, home_assistant};
pub use open_vocabulary::{Up, combine, open_vocabulary};
pub use valetudo::{MAX_PIXELS, TOLERANCE_M, segment_names, valetudo};
pub use virtualhome::virtualhome;

/// A map and what the import has to say about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// The checked map.
    pub map: SemanticMap,
    /// What was left out or changed, one sentence each, for people.
    pub notes: Vec<String>,
    /// Ids of the rooms whose polygon is no outline, so that they are the boxes around them now.
    pub boxed: Vec<String>,
}

/// Why a map of another format cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// Not JSON, or not of the format: a missing key, a wrong type.
    #[error("{}{message}; expected {expected}", schema::place(.element))]
    Json {
        /// Path to the element, as `nodes[3].bounding_box`; `.` for the whole file.
        element: String,
        /// What the parser says, with line and column.
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
    /// The scene that came out breaks a rule of scenes.
    #[error(transparent)]
    Scene(#[from] SceneError),
}

fn parse<'a, T: serde::Deserialize<'a>>(json: &'a str, expected: &'static str) -> Result<T, ImportError> {
    let fail = |element: String, message: String| ImportError::Json { element, message, expected };
    let mut parser = serde_json::Deserializer::from_str(json);
    let value = serde_path_to_error::deserialize(&mut parser)
        .map_err(|error| fail(error.path().to_string(), error.inner().to_string()))?;
    parser.end().map_err(|error| fail("end".to_owned(), error.to_string()))?;
    Ok(value)
}

/// Gives ids: words joined by hyphens, numbered from the second use on.
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

/// The words of a name, for a label.
fn words(name: &str) -> String {
    Names::built_in().words(name)
}
