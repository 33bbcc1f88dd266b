//! Changes of the map in use: the questions on `roomcast/v1/map-change`, their answers, and the changed map of the state database.

use serde::{Deserialize, Serialize};

use super::asked::{Answer, Question};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::semantic_map::delta::MapChange;

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

/// A changed map, which holds until the configured scene changes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct KeptMap {
    /// The fingerprint of the configured scene, hexadecimal.
    pub(super) scene: String,
    /// The fingerprint of the changed map, because SQLite does not notice a flipped bit in a text.
    pub(super) fingerprint: String,
    /// The changed map as JSON.
    pub(super) map: String,
}

impl KeptMap {
    /// A changed form of the scene with this fingerprint.
    #[must_use]
    pub fn new(scene: String, map: &SemanticMap) -> Self {
        Self { scene, fingerprint: hex::encode(map.fingerprint()), map: map.to_json() }
    }

    /// The changed map of the configured scene. If there is none, the log says why.
    #[must_use]
    pub fn of(&self, configured: &SemanticMap) -> Option<SemanticMap> {
        let map = SemanticMap::from_json(&self.map).map_err(|error| crate::logging::chain(&error));
        let map = map.and_then(|map| match map.fingerprint() {
            _ if self.scene != hex::encode(configured.fingerprint()) => Err("it is of another scene".to_owned()),
            fingerprint if self.fingerprint == hex::encode(fingerprint) => Ok(map),
            _ => Err("it is damaged".to_owned()),
        });
        let used = map.inspect_err(|reason| {
            tracing::warn!(
                reason,
                "the changed map in the state database is not used, but the configured scene: apply the changes again"
            );
        });
        used.ok()
    }
}
