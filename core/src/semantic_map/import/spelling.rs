//! Near-duplicate labels of maps that a captioner named: one thing written in several ways becomes one label.

use std::collections::{BTreeMap, HashMap};

use super::{ImportError, Imported};
use crate::semantic_map::schema::{CaptionEntry, ItemEntry, MAX_ALIASES};

impl Imported {
    /// Joins labels that differ only in where words are parted ("coffeemaker", "coffee maker") or in number ("mugs", "mug"). The
    /// label that most items bear stays, of equal ones the one with more words, then the shorter; the others become its aliases.
    ///
    /// Words that merely resemble one another are left alone: "toaster" is no "coaster".
    ///
    /// # Errors
    /// When the merged scene breaks a rule of scenes.
    pub fn merge_spellings(self) -> Result<Self, ImportError> {
        let Self { map, mut notes, boxed } = self;
        let mut file = map.to_file();
        let stands_for = kept_labels(&file.items);
        let mut room_for = MAX_ALIASES.saturating_sub(file.aliases.values().map(Vec::len).sum());
        for (label, kept) in &stands_for {
            notes.push(format!("Merged the label {label:?} into {kept:?}."));
            let aliases = file.aliases.remove(label).unwrap_or_default();
            let own = file.aliases.entry(kept.clone()).or_default();
            for alias in aliases.into_iter().chain([label.clone()]) {
                if room_for > 0 && alias != *kept && !own.contains(&alias) {
                    own.push(alias);
                    room_for -= 1;
                }
            }
        }
        file.aliases.retain(|_, aliases| !aliases.is_empty());
        let kept = |label: &String| stands_for.get(label).unwrap_or(label).clone();
        for item in &mut file.items {
            item.label = kept(&item.label);
            let mut weights: BTreeMap<String, f64> = BTreeMap::new();
            for caption in &item.captions {
                *weights.entry(kept(&caption.label)).or_default() += caption.weight;
            }
            let sole = weights.len() < 2;
            let captions = weights.into_iter().map(|(label, weight)| CaptionEntry { label, weight });
            item.captions = if sole { Vec::new() } else { captions.collect() };
        }
        Self::new(file, notes, boxed)
    }
}

/// Each changed label and its replacement.
fn kept_labels(items: &[ItemEntry]) -> BTreeMap<String, String> {
    let mut bearers: HashMap<&str, usize> = HashMap::new();
    for item in items {
        *bearers.entry(&item.label).or_default() += 1;
        item.captions.iter().for_each(|caption| *bearers.entry(&caption.label).or_default() += 1);
    }
    let mut alike: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for label in bearers.keys() {
        alike.entry(bare(label)).or_default().push(label);
    }
    let mut stands_for = BTreeMap::new();
    for mut labels in alike.into_values() {
        labels.sort_by_key(|label| {
            (std::cmp::Reverse(bearers[label]), std::cmp::Reverse(label.split(' ').count()), label.len(), *label)
        });
        for label in &labels[1..] {
            stands_for.insert((*label).to_owned(), labels[0].to_owned());
        }
    }
    stands_for
}

/// The label without spaces and without the mark of the plural.
fn bare(label: &str) -> String {
    let joined: String = label.split(' ').collect();
    if let Some(stem) = joined.strip_suffix("ies").filter(|stem| stem.len() > 2) {
        format!("{stem}y")
    } else if let Some(stem) =
        joined.strip_suffix("es").filter(|stem| ["s", "x", "z", "ch", "sh"].iter().any(|end| stem.ends_with(end)))
    {
        stem.to_owned()
    } else if joined.ends_with("ss") || joined.ends_with("us") || joined.len() < 4 {
        joined
    } else {
        joined.strip_suffix('s').unwrap_or(&joined).to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::semantic_map::import::{Up, open_vocabulary};

    fn merged(captions: &[&str]) -> Imported {
        let entry = |(index, captions): (usize, &&str)| {
            let list: Vec<&str> = captions.split('/').collect();
            serde_json::json!({"id": index, "captions": list, "bbox_center": [1, 1, 1], "bbox_extent": [0.1, 0.1, 0.1]})
        };
        let objects: Vec<serde_json::Value> = captions.iter().enumerate().map(entry).collect();
        let map = serde_json::json!({"objects": objects,
            "rooms": [{"name": "room", "box": {"min_m": [0, 0, 0], "max_m": [2, 2, 2]}}]});
        open_vocabulary(&map.to_string(), "test", Up::Z).unwrap().merge_spellings().unwrap()
    }

    #[test]
    fn spellings_and_numbers_are_joined() {
        let Imported { map, notes, .. } =
            merged(&["mug", "mugs", "mug", "dish washer", "dishwasher", "boxes", "box", "glass"]);
        assert_eq!(map.labels, ["box", "dish washer", "glass", "mug"]);
        assert_eq!(map.aliases["mug"], ["mugs"]);
        assert_eq!(map.find_label("mugs"), map.find_label("mug"));
        assert_eq!(notes.len(), 3);
    }

    #[test]
    fn look_alikes_stay_apart() {
        assert_eq!(merged(&["toaster", "coaster", "bus", "bu", "glasses", "glass"]).map.labels.len(), 5);
        assert_eq!(bare("glasses"), bare("glass"));
        assert_ne!(bare("bus"), bare("bu"));
    }

    #[test]
    fn soft_labels_add_up() {
        let map = merged(&["mug/mugs/cup", "mugs/mug"]).map;
        assert_eq!(map.labels, ["cup", "mug"]);
        let weights: Vec<f64> = map.items[0].captions.iter().map(|caption| caption.weight).collect();
        assert!((weights[1] - 2.0 / 3.0).abs() < 1e-12);
        assert!(map.items[1].captions.is_empty(), "one label is left");
    }
}
