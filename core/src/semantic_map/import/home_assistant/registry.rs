//! The registries as Home Assistant writes them.

use std::collections::HashSet;

use serde::Deserialize;
use serde_json::Value;

use super::comment;
use crate::names::Names;
use crate::semantic_map::import::{ImportError, room_label};
use crate::semantic_map::schema::parse_json;

const EXPECTED: &str = "a registry of Home Assistant, from the folder `.storage`";
/// Longer names of devices and entities are ignored, in bytes.
const NAME_BYTES_MAX: usize = 1_024;
/// So many words of an area's name can be abbreviated.
const AREA_WORDS_MAX: usize = 8;

#[derive(Deserialize)]
struct Registry<T> {
    data: T,
}

#[derive(Default, Deserialize)]
pub(super) struct Areas {
    pub(super) areas: Vec<Area>,
}

#[derive(Deserialize)]
pub(super) struct Area {
    /// The API has it under another name than the file.
    #[serde(alias = "area_id")]
    pub(super) id: String,
    pub(super) name: String,
    pub(super) floor_id: Option<String>,
    /// Some homes have values here that are no texts.
    #[serde(default)]
    aliases: Value,
}

impl Area {
    pub(super) fn aliases(&self) -> impl Iterator<Item = &str> {
        self.aliases.as_array().into_iter().flatten().filter_map(Value::as_str)
    }

    /// The area's names, prepared once for all of its entities.
    pub(super) fn texts(&self) -> AreaTexts {
        let label = room_label(&self.name).unwrap_or_default();
        let mut words = HashSet::new();
        for text in [self.name.as_str(), &self.id, &label].into_iter().chain(self.aliases()) {
            words.extend(Names::bare(text).split(' ').map(str::to_owned));
        }
        let long = Names::bare(&self.name).split(' ').take(AREA_WORDS_MAX).map(str::to_owned).collect();
        AreaTexts { words, long, comment: comment(&self.name) }
    }
}

/// An area's names, made ready once.
pub(super) struct AreaTexts {
    /// The words of all names.
    pub(super) words: HashSet<String>,
    /// The first words of its name, which entities may abbreviate.
    pub(super) long: Vec<String>,
    /// The name, for a comment.
    pub(super) comment: String,
}

#[derive(Default, Deserialize)]
pub(super) struct Floors {
    pub(super) floors: Vec<Floor>,
}

#[derive(Deserialize)]
pub(super) struct Floor {
    pub(super) floor_id: String,
    #[serde(default)]
    pub(super) name: String,
    pub(super) level: Option<i64>,
}

#[derive(Default, Deserialize)]
pub(super) struct Devices {
    pub(super) devices: Vec<Device>,
}

#[derive(Deserialize)]
pub(super) struct Device {
    pub(super) id: String,
    pub(super) area_id: Option<String>,
    name: Option<String>,
    name_by_user: Option<String>,
}

#[derive(Default, Deserialize)]
pub(super) struct Entities {
    pub(super) entities: Vec<Entity>,
}

#[derive(Deserialize)]
pub(super) struct Entity {
    pub(super) entity_id: String,
    pub(super) area_id: Option<String>,
    pub(super) device_id: Option<String>,
    pub(super) name: Option<String>,
    pub(super) original_name: Option<String>,
    device_class: Option<String>,
    original_device_class: Option<String>,
    platform: Option<String>,
    #[serde(default)]
    translation_key: Value,
    disabled_by: Option<Value>,
    hidden_by: Option<Value>,
    entity_category: Option<Value>,
    #[serde(default)]
    pub(super) unique_id: Value,
    #[serde(default)]
    options: Value,
}

impl Entity {
    /// The segments of a vacuum by area, as Home Assistant 2026.3 and later know them. An area of several segments has the first one.
    pub(super) fn segments(&self) -> impl Iterator<Item = (&str, &str)> {
        let areas = self.options.pointer("/vacuum/area_mapping").and_then(Value::as_object);
        areas.into_iter().flatten().filter_map(|(area, segments)| {
            let segment = segments.as_array().map_or(Some(segments), |segments| segments.first())?.as_str()?;
            Some((area.as_str(), segment))
        })
    }

    pub(super) fn class(&self) -> &str {
        self.device_class.as_deref().or(self.original_device_class.as_deref()).unwrap_or_default()
    }

    pub(super) fn platform(&self) -> &str {
        self.platform.as_deref().unwrap_or_default()
    }

    /// Disabled, hidden, or an entity of diagnosis or configuration. The registry has null if it is neither.
    pub(super) fn is_quiet(&self) -> bool {
        [&self.disabled_by, &self.hidden_by, &self.entity_category].iter().any(|value| value.is_some())
    }

    /// The names that can name its thing, the user's own first.
    pub(super) fn names<'a>(&'a self, object: &'a str, device: Option<&'a Device>) -> impl Iterator<Item = &'a str> {
        let device = device.and_then(|device| device.name_by_user.as_deref().or(device.name.as_deref()));
        // Many entities have one device, so a long name would be read often.
        let is_short = |text: &&str| text.len() <= NAME_BYTES_MAX;
        [self.name.as_deref(), Some(object), device, self.original_name.as_deref()]
            .into_iter()
            .flatten()
            .filter(is_short)
    }

    /// The texts that say what the entity itself is, its device left aside.
    pub(super) fn own_names<'a>(&'a self, object: &'a str) -> impl Iterator<Item = &'a str> {
        self.names(object, None).chain(self.translation_key.as_str().filter(|key| key.len() <= NAME_BYTES_MAX))
    }
}

#[derive(Default, Deserialize)]
pub(super) struct Persons {
    pub(super) items: Vec<Person>,
}

#[derive(Deserialize)]
pub(super) struct Person {
    pub(super) id: String,
    pub(super) name: String,
}

/// A registry that may be missing. An error names its file.
pub(super) fn registry<'a, T: Deserialize<'a> + Default>(file: &str, text: Option<&'a str>) -> Result<T, ImportError> {
    let Some(text) = text else { return Ok(T::default()) };
    let named = |message| ImportError::Json { message: format!("{file}: {message}"), expected: EXPECTED };
    parse_json::<Registry<T>>(text).map(|registry| registry.data).map_err(named)
}
