//! Changes of the map in use: the questions on `roomcast/v1/map-change`, their answers, and the file that keeps a changed map over a restart.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::asked::{Answer, Question};
use crate::state_file;
use roomcast_core::semantic_map::delta::MapChange;
use roomcast_core::semantic_map::{MAX_FILE_BYTES, SemanticMap};

pub(super) const FILE: &str = "changed-map.json";
/// Most bytes of the file: a scene, as the daemon writes it.
const FILE_BYTES_MAX: u64 = 2 * MAX_FILE_BYTES;

impl Question for MapQuestion {
    fn id(&self) -> Option<&str> {
        Some(&self.id)
    }
}

/// A question that changes the map in use.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapQuestion {
    /// A unique name. The same name gets the same answer, without a second change.
    pub id: String,
    /// The hexadecimal fingerprint that the map in use must have; any if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected_map: Option<String>,
    /// The changes, all or none; `scenes/README.md` documents them.
    pub changes: Vec<MapChange>,
}

/// The outcome of a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// The map is in use.
    Applied,
    /// The question or its changes are malformed; nothing changed.
    Refused,
    /// The map in use has another fingerprint; nothing changed.
    OtherMap,
}

/// The answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MapAnswer {
    /// The outcome of the change.
    pub outcome: Outcome,
    /// Why the change was not applied.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The fingerprint of the map in use, hexadecimal.
    pub map: String,
    /// The daemon's epoch, hexadecimal.
    pub epoch: String,
    /// Scores with a greater sequence are for this map.
    pub sequence: u64,
    /// The number of rooms.
    pub rooms: usize,
    /// The number of items.
    pub items: usize,
    /// The number of items that lie in no room.
    pub outside: usize,
    /// The number of labels that are new to the model.
    pub new_labels: usize,
    /// Whether the model was prepared for the labels again: if labels are new, or if scores are corrected and labels are gone.
    #[serde(alias = "prepared_anew")]
    pub prepared_again: bool,
    /// The time to change, check and regroup the map and to prepare the model, in nanoseconds.
    pub regrouped_in_ns: u64,
    /// Whether a restarted daemon has the changed map, which needs a state directory.
    pub kept: bool,
}

impl Answer for MapAnswer {
    fn reason(&mut self) -> &mut Option<String> {
        &mut self.reason
    }
}

/// Keeps a changed map over a restart, until the configured scene changes.
#[derive(Debug)]
pub struct KeptMap {
    path: PathBuf,
    base: String,
}

#[derive(Serialize, Deserialize)]
struct KeptFile {
    /// The fingerprint of the configured scene.
    base: String,
    scene: serde_json::Value,
}

impl KeptMap {
    /// A file in the state directory, for the configured scene.
    #[must_use]
    pub fn new(directory: &Path, configured: &SemanticMap) -> Self {
        Self { path: directory.join(FILE), base: hex::encode(configured.fingerprint()) }
    }

    /// The kept map, if it is a changed form of the configured scene. An unusable file stays in place, and the log says why.
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

    /// Keeps a map. The old file stays until the new one is complete.
    ///
    /// # Errors
    /// If the state directory cannot be written.
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
