//! Names of rooms, persons and robots as parts of MQTT topics and of Home Assistant's ids.
//!
//! Ordinary names stay as they are. Persons choose their names, so no name may yield another's topic or id: an ambiguous part gets a checksum.

use roomcast_services::slug::{slug, summed};

/// The place of a person outside all rooms.
pub(super) const AWAY: &str = "away";

/// Endings of the ids of persons' and rooms' entities, besides times ahead.
const ENDINGS: [&str; 4] = ["_home", "_now", "_place", "_soon"];
/// The beginning of the ids of persons' entities.
pub(super) const PERSON: &str = "person_";

/// The part of an id for a time ahead.
pub(super) fn in_s(seconds: f64) -> String {
    format!("_in_{}_s", slug(&seconds.to_string()))
}

/// A room's part of topics and ids.
pub(super) fn of_room(id: &str) -> String {
    if id.starts_with(PERSON) { summed(id, id) } else { slug(id) }
}

/// A person's part of topics and ids; without a name, only from the number.
pub(super) fn of_person(number: u32, name: &str) -> String {
    if name.is_empty() {
        return slug(&unnamed_person(number));
    }
    let name = name.to_lowercase();
    let ends = ENDINGS.iter().any(|ending| name.ends_with(ending)) || name.contains("_in_") && name.ends_with("_s");
    let is_like_unnamed =
        name.strip_prefix("person ").is_some_and(|rest| rest.bytes().all(|byte| byte.is_ascii_digit()));
    of_named(&name, ends, is_like_unnamed)
}

pub(super) fn unnamed_person(number: u32) -> String {
    format!("person {number}")
}

/// A robot's part of topics and ids; without a name, only from the number.
pub(super) fn of_robot(number: u64, name: Option<&str>) -> String {
    let Some(name) = name else { return slug(&unnamed_robot(number)) };
    let is_number = |rest: &str| rest.len() == 16 && rest.bytes().all(|byte| byte.is_ascii_hexdigit());
    of_named(name, false, name.strip_prefix("robot ").is_some_and(is_number))
}

pub(super) fn unnamed_robot(number: u64) -> String {
    format!("robot {number:016x}")
}

/// A name's part. It gets a checksum if it ends like an entity's id, and an impossible one if it looks like a numbered part.
fn of_named(name: &str, ends_like_id: bool, is_like_unnamed: bool) -> String {
    match (ends_like_id, is_like_unnamed) {
        // A name has no character zero.
        (_, true) => summed(name, &format!("{name}\0")),
        (true, false) => summed(name, name),
        (false, false) => slug(name),
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

/// A person or robot: the shown name, and the part of topics and ids.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Named {
    pub(super) part: String,
    pub(super) name: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_ahead_are_words() {
        assert_eq!([30.0, 60.0, 90.0, 600.0, 3600.0].map(ahead), ["30 s", "1 min", "90 s", "10 min", "1 h"]);
    }

    /// Automations of users contain these names.
    #[test]
    fn ordinary_names_have_the_parts_that_they_always_had() {
        assert_eq!([of_room("living-room"), of_room("küche")], ["living-room", "k_che_d4b04d03"]);
        assert_eq!([of_person(1, "Ada"), of_person(1, "ada lovelace")], ["ada", "ada_lovelace_177f85df"]);
        assert_eq!(of_person(5, ""), "person_5_859ad6ea");
        assert_eq!(of_robot(1, Some("robot")), "robot");
        assert_eq!(of_robot(1, None), "robot_0000000000000001_372d6ea4");
        assert_eq!(in_s(600.0), "_in_600_s");
    }
}
