//! Names of rooms, persons and robots as parts of MQTT topics and of ids.

use sha2::{Digest, Sha256};

const LENGTH_MAX: usize = 40;
/// Characters of the checksum that keeps similar names apart.
const SUM: usize = 8;

fn is_safe(character: char) -> bool {
    character.is_ascii_lowercase() || character.is_ascii_digit() || character == '-' || character == '_'
}

/// Whether a name appears to end with a checksum.
fn has_sum(name: &str) -> bool {
    let sum = name.rsplit('_').next().unwrap_or_default();
    sum.len() == SUM && sum.bytes().all(|byte| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte))
}

/// A name that is safe in a topic and in an id, and the same at every start. A safe name stays. From any other name the safe characters
/// stay, with a checksum of the whole name. Two names never give the same result.
///
/// ```
/// use roomcast_services::slug::slug;
///
/// assert_eq!((slug("living-room").as_str(), slug("Küche/2").as_str()), ("living-room", "k_che_2_ca913034"));
/// assert_ne!(slug("k_che_2_ca913034"), slug("Küche/2"));
/// ```
#[must_use]
pub fn slug(name: &str) -> String {
    let is_plain = !name.is_empty() && name.len() <= LENGTH_MAX && name.chars().all(is_safe) && !has_sum(name);
    if is_plain { name.to_owned() } else { summed(name, name) }
}

/// The safe characters of a name, with a checksum of `text`. It is for safe names that would have another meaning in their place.
#[must_use]
pub fn summed(name: &str, text: &str) -> String {
    let lower = name.to_lowercase();
    let safe: String = lower.chars().map(|c| if is_safe(c) { c } else { '_' }).take(LENGTH_MAX).collect();
    let sum = hex::encode(Sha256::digest(text.as_bytes()));
    let sum = sum.get(..SUM).unwrap_or(&sum);
    match safe.trim_matches('_') {
        "" => sum.to_owned(),
        safe => format!("{safe}_{sum}"),
    }
}

/// A room's name for people. An imported map gives each room a number ("hallway-17"), which stays only if another room has the same words.
#[must_use]
pub fn room_name<'a>(id: &str, rooms: impl Iterator<Item = &'a str>) -> String {
    let stem = |id: &'a str| without_number(id);
    let own = without_number(id);
    let is_shared = rooms.filter(|other| *other != id).map(stem).any(|other| other == own);
    if is_shared { id } else { own }.replace('-', " ")
}

fn without_number(id: &str) -> &str {
    let is_number = |number: &str| !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    match id.rsplit_once('-') {
        Some((stem, number)) if is_number(number) && !stem.is_empty() => stem,
        _ => id,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn rooms_have_their_number_in_a_name_only_beside_a_room_of_the_same_words() {
        let rooms = ["hallway-17", "bedroom-1", "bedroom-2", "office", "office-3", "living-room", "-5", "wing-b"];
        let names = rooms.map(|id| room_name(id, rooms.into_iter()));
        assert_eq!(names, ["hallway", "bedroom 1", "bedroom 2", "office", "office 3", "living room", " 5", "wing b"]);
    }

    #[test]
    fn odd_names_are_safe_and_stay_apart() {
        assert_eq!(slug("living-room"), "living-room");
        let odd = [
            "",
            "a/b",
            "a+b",
            "a#b",
            "a b",
            "A b",
            "a_b",
            "<b>",
            "küche",
            "kuche",
            "\0",
            "🛏",
            "../..",
            "$SYS",
            "{{x}}",
            "Vac",
            "vac",
            "Staubi Ä",
            "Staubi Ö",
        ];
        let long = ["x".repeat(41), format!("{}y", "x".repeat(41))];
        let mut names: Vec<String> = odd.into_iter().map(str::to_owned).chain(long).collect();
        // These are the slugs of other names, and the slugs of those.
        for _ in 0..2 {
            names.extend(names.iter().map(|name| slug(name)).collect::<Vec<_>>());
        }
        let names: HashSet<_> = names.into_iter().collect();
        let slugs: HashSet<_> = names.iter().map(|name| slug(name)).collect();
        assert!(slugs.iter().all(|slug| !slug.is_empty() && slug.chars().all(is_safe)), "{slugs:?}");
        assert_eq!(slugs.len(), names.len(), "{names:?} {slugs:?}");
        assert!(slug("a/b").starts_with("a_b_"));
    }
}
