//! Names of rooms, persons and robots as parts of MQTT topics and of Home Assistant's ids.

use sha2::{Digest, Sha256};

/// Most characters that are taken of a name.
const LENGTH_MAX: usize = 40;
/// Characters of the sum that tells names apart which would look alike.
const SUM: usize = 8;

fn is_safe(character: char) -> bool {
    character.is_ascii_lowercase() || character.is_ascii_digit() || character == '-' || character == '_'
}

/// A name that is safe in a topic and in an id, the same at every start: the name itself where it is safe, else what is left of it
/// with a sum of the whole name, so that no two names become one.
pub(super) fn slug(name: &str) -> String {
    if !name.is_empty() && name.len() <= LENGTH_MAX && name.chars().all(is_safe) {
        return name.to_owned();
    }
    let lower = name.to_lowercase();
    let safe: String = lower.chars().map(|c| if is_safe(c) { c } else { '_' }).take(LENGTH_MAX).collect();
    let sum = hex::encode(Sha256::digest(name.as_bytes()));
    let sum = sum.get(..SUM).unwrap_or(&sum);
    match safe.trim_matches('_') {
        "" => sum.to_owned(),
        safe => format!("{safe}_{sum}"),
    }
}

/// A time ahead in words: "1 min", "90 s", "1 h".
pub(super) fn ahead(seconds: f64) -> String {
    match seconds {
        s if s >= 3600.0 && s % 3600.0 == 0.0 => format!("{} h", s / 3600.0),
        s if s >= 60.0 && s % 60.0 == 0.0 => format!("{} min", s / 60.0),
        s => format!("{s} s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn odd_names_are_safe_and_stay_apart() {
        assert_eq!(slug("living-room"), "living-room");
        let odd = [
            "", "a/b", "a+b", "a#b", "a b", "A b", "a_b", "<b>", "küche", "kuche", "\0", "🛏", "../..", "$SYS", "{{x}}",
        ];
        let long = ["x".repeat(41), format!("{}y", "x".repeat(41))];
        let slugs: Vec<_> = odd.into_iter().map(slug).chain(long.iter().map(|name| slug(name))).collect();
        assert!(slugs.iter().all(|slug| !slug.is_empty() && slug.chars().all(is_safe)), "{slugs:?}");
        assert_eq!(slugs.iter().collect::<HashSet<_>>().len(), slugs.len(), "{slugs:?}");
        assert!(slug("a/b").starts_with("a_b_"));
    }

    #[test]
    fn times_ahead_are_words() {
        assert_eq!([30.0, 60.0, 90.0, 600.0, 3600.0].map(ahead), ["30 s", "1 min", "90 s", "10 min", "1 h"]);
    }
}
