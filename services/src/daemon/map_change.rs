//! Changes to the map in use: what is asked on `roomcast/v1/map-change`, what is answered, and the file that keeps a changed map
//! over a restart. Pure but for that file.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::asked::{Answer, Question};
use crate::state_file;
use roomcast_core::semantic_map::delta::MapChange;
use roomcast_core::semantic_map::{MAX_FILE_BYTES, SemanticMap};

/// The changed map's file in the state directory.
pub(super) const FILE: &str = "changed-map.json";
/// Most bytes of it that are read: a scene, as JSON writes it again.
const FILE_BYTES_MAX: u64 = 2 * MAX_FILE_BYTES;

impl Question for MapQuestion {
    fn id(&self) -> Option<&str> {
        Some(&self.id)
    }
}

/// A question: change the map in use.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapQuestion {
    /// A name that no other question has: the same one asked again is answered again, and not done again.
    pub id: String,
    /// The fingerprint, hexadecimal, that the map in use must have; any where left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected_map: Option<String>,
    /// The changes, all or none; `scenes/README.md` documents them.
    pub changes: Vec<MapChange>,
}

/// What became of a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// The map is in use.
    Applied,
    /// The question or its changes are malformed; nothing changed.
    Refused,
    /// The map in use is not the one that was expected; nothing changed.
    OtherMap,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MapAnswer {
    /// What became of the change.
    pub outcome: Outcome,
    /// Why, where it was not applied.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Fingerprint of the map in use now, hexadecimal.
    pub map: String,
    /// The daemon's epoch, hexadecimal.
    pub epoch: String,
    /// Scores with a greater sequence are of the map in use now.
    pub sequence: u64,
    /// Rooms of the map in use now.
    pub rooms: usize,
    /// Items of it.
    pub items: usize,
    /// Items of it that lie in no room.
    pub outside: usize,
    /// Labels that the model did not know before.
    pub new_labels: usize,
    /// Whether the model was prepared for the map's labels again: where some are new, and, where scores are corrected, where some are gone.
    #[serde(alias = "prepared_anew")]
    pub prepared_again: bool,
    /// How long it took to change, check and regroup the map, and to prepare the model, in nanoseconds.
    pub regrouped_in_ns: u64,
    /// Whether a restarted daemon will have the changed map: only with a state directory.
    pub kept: bool,
}

impl Answer for MapAnswer {
    fn reason(&mut self) -> &mut Option<String> {
        &mut self.reason
    }
}

/// Keeps a changed map over a restart, as long as the configured scene stays the one that was changed.
#[derive(Debug)]
pub struct KeptMap {
    path: PathBuf,
    base: String,
}

#[derive(Serialize, Deserialize)]
struct KeptFile {
    /// Fingerprint of the configured scene.
    base: String,
    scene: serde_json::Value,
}

impl KeptMap {
    /// In the state directory, for the configured scene.
    #[must_use]
    pub fn new(directory: &Path, configured: &SemanticMap) -> Self {
        Self { path: directory.join(FILE), base: hex::encode(configured.fingerprint()) }
    }

    /// The map that was kept, if it is a changed form of the configured scene. A file that cannot be used is left where it is, and
    /// the log says so.
    #[must_use]
    pub fn load(&self) -> Option<SemanticMap> {
        let text = match state_file::read(&self.path, FILE_BYTES_MAX) {
            Ok(text) => text?,
            Err(error) => {
                tracing::warn!(%error, path = %self.path.display(), "the changed map cannot be read, and the configured scene is used: remove it, and apply the changes again");
                return None;
            }
        };
        let kept: KeptFile = match serde_json::from_str(&text) {
            Ok(kept) => kept,
            Err(error) => {
                tracing::warn!(%error, path = %self.path.display(), "the changed map is damaged, and the configured scene is used: remove it, and apply the changes again");
                return None;
            }
        };
        if kept.base != self.base {
            tracing::warn!(path = %self.path.display(), "the changed map is of another scene; the configured scene is used");
            return None;
        }
        match SemanticMap::from_json(&kept.scene.to_string()) {
            Ok(map) => Some(map),
            Err(error) => {
                tracing::warn!(%error, path = %self.path.display(), "the changed map is malformed; the configured scene is used");
                None
            }
        }
    }

    /// Keeps a map; the old file stays whole until the new one is.
    ///
    /// # Errors
    /// When the state directory cannot be written.
    pub fn keep(&self, map: &SemanticMap) -> std::io::Result<()> {
        let scene = serde_json::from_str(&map.to_json())?;
        let text = serde_json::to_string(&KeptFile { base: self.base.clone(), scene })?;
        state_file::replace_for_good(&self.path, text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::semantic_map::delta::parse_changes;

    fn map() -> SemanticMap {
        SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap()
    }

    #[test]
    fn a_changed_map_comes_back_as_long_as_the_scene_is_the_same() {
        let directory = tempfile::tempdir().unwrap();
        let changed = map().changed(parse_changes(r#"[{"change": "remove-item", "id": "sofa-1"}]"#).unwrap()).unwrap();
        let kept = KeptMap::new(directory.path(), &map());
        assert!(kept.load().is_none());
        kept.keep(&changed).unwrap();
        assert_eq!(kept.load().unwrap().fingerprint(), changed.fingerprint());
        assert!(KeptMap::new(directory.path(), &changed).load().is_none(), "of another scene");
        std::fs::write(directory.path().join(FILE), "{").unwrap();
        assert!(kept.load().is_none(), "damaged");
    }
}
