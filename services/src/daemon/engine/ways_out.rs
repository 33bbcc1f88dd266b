//! Where people leave the house, by the names of rooms and things.

use roomcast_core::grounding::Grounding;
use roomcast_core::text::has_words;

/// The share of the way out of the house in each partition, at most 1: a hall by its name, and a front door by its share.
pub(super) fn ways_out(grounding: &Grounding) -> Vec<f64> {
    const HALLS: [&str; 8] = ["hall", "hallway", "entrance", "entry", "entryway", "foyer", "vestibule", "lobby"];
    const DOORS: [&str; 5] = ["front door", "entrance door", "main door", "house door", "apartment door"];
    let is_hall = |text: &str| has_words(text, &HALLS);
    let lower = |text: &str| text.to_lowercase();
    let mut near: Vec<f64> =
        grounding.partitions().iter().map(|own| if is_hall(&lower(&own.label)) { 1.0 } else { 0.0 }).collect();
    for (label, own) in grounding.scored_labels().iter().enumerate() {
        let text = lower(&own.text);
        // The only door of a map is the front door.
        let is_only = || text == "door" && own.items.len() == 1;
        if has_words(&text, &DOORS) || is_only() {
            for (near, share) in near.iter_mut().zip(grounding.weights().row(label).iter()) {
                *near = near.max(*share);
            }
        }
    }
    near
}
