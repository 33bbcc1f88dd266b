//! Finds the segment of the robot's map for a room.

use std::collections::BTreeMap;

use roomcast_core::names::Names;
use roomcast_core::semantic_map::SemanticMap;

/// The configured segments by their rooms' ids. The configuration may use any name of a room in the map. Unknown rooms stay unchanged.
pub fn by_ids(configured: &BTreeMap<String, String>, map: &SemanticMap) -> BTreeMap<String, String> {
    let id = |room: &str| map.find_room(room).map_or(room, |known| &map.rooms()[known.0 as usize].id).to_owned();
    configured.iter().map(|(room, segment)| (id(room), segment.clone())).collect()
}

/// The segment of a room: the configured one, else the one with the number at the end of the room's id, as in an imported map, else the
/// only one with a matching name. If the robot's list is empty, the number in the id counts. `rooms` are all rooms of the map: two of them
/// never share a segment, and a segment that is configured for another room is not used.
///
/// # Errors
///
/// The reason, in words for the planner's log.
pub fn segment_of(
    room: &str,
    rooms: &[impl AsRef<str>],
    configured: &BTreeMap<String, String>,
    segments: &BTreeMap<String, String>,
) -> Result<String, String> {
    let own = unshared_segment(room, configured, segments)?;
    let is_other = |other: &&str| *other != room && unshared_segment(other, configured, segments).as_ref() == Ok(&own);
    let mut others = rooms.iter().map(AsRef::as_ref).filter(is_other);
    let wins = |one: &str, other: &str| configured.contains_key(one) && !configured.contains_key(other);
    match others.find(|other| !wins(room, other)) {
        Some(other) => Err(format!("the segment {own} is that of {other}, too; give each its own in [robot.segments]")),
        None => Ok(own),
    }
}

fn is_plain_number(text: &str) -> bool {
    !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit())
}

/// The segment of a room, regardless of the other rooms.
fn unshared_segment(
    room: &str,
    configured: &BTreeMap<String, String>,
    segments: &BTreeMap<String, String>,
) -> Result<String, String> {
    if let Some(segment) = configured.get(room) {
        return Ok(segment.clone());
    }
    let is_number = |number: &str| segments.contains_key(number) || is_plain_number(number);
    let numbered = room.rsplit_once('-').filter(|(_, number)| is_number(number));
    if segments.is_empty() {
        let number = numbered.map(|(_, number)| number.to_owned());
        return number
            .ok_or_else(|| "the robot's list of segments is empty; name the segment in [robot.segments]".to_owned());
    }
    // Home Assistant's ids of areas have underscores and no umlauts.
    let (whole, stem) = (Names::folded(room), Names::folded(numbered.map_or(room, |(stem, _)| stem)));
    let kind = |name: &str| Names::built_in().room(name).map(Names::folded);
    let means = |name: &str| {
        let name_of = Names::folded(name);
        name_of == whole || name_of == stem || kind(name).as_deref() == Some(&*stem)
    };
    // A name outside all tables may well be this room's: "Lenas Zimmer" is a bedroom.
    let means_another = |name: &str| !means(name) && kind(name).is_some();
    let mut named = segments.iter().filter(|(_, name)| means(name));
    if let Some((number, name)) = numbered.and_then(|(_, number)| segments.get_key_value(number)) {
        // A robot that divides its map again also assigns new numbers.
        return match named.next() {
            Some((other, known)) if other != number && means_another(name) => Err(format!(
                "its number {number} is now {name:?} to the robot, and {known:?} is {other}: the robot has divided its map again; import that again, \
                 or name the segment in [robot.segments]"
            )),
            _ => Ok(number.clone()),
        };
    }
    match (named.next(), named.next()) {
        (Some((segment, _)), None) => Ok(segment.clone()),
        (Some(_), Some(_)) => Err("several segments have its name; name one in [robot.segments]".to_owned()),
        _ => Err("no segment of the robot's map has its name; name one in [robot.segments]".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rooms_are_segments_by_configuration_number_or_name() {
        let table = |pairs: &[(&str, &str)]| -> BTreeMap<String, String> {
            pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
        };
        let configured = table(&[("office", "9")]);
        let segments = table(&[("1", "Küche"), ("2", "Living Room"), ("3", "Bad"), ("4", "Bathroom"), ("17", "")]);
        let of = |room: &str| segment_of(room, &[""; 0], &configured, &segments);
        assert_eq!(of("office").unwrap(), "9");
        assert_eq!(of("room-17").unwrap(), "17");
        for kitchen in ["kitchen", "kuche", "kueche", "Küche"] {
            assert_eq!(of(kitchen).unwrap(), "1", "{kitchen}");
        }
        assert_eq!(of("kitchen-1").unwrap(), "1");
        assert_eq!(of("living-room").unwrap(), "2");
        assert_eq!(of("living_room").unwrap(), "2", "an area of Home Assistant");
        assert!(of("bathroom").unwrap_err().contains("several"));
        assert!(of("garage").unwrap_err().contains("no segment"));
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let by_names = by_ids(&table(&[("living room", "17"), ("kitchen", "1"), ("attic", "3")]), &map);
        assert_eq!(by_names, table(&[("living-room", "17"), ("kitchen", "1"), ("attic", "3")]));
    }

    /// Valetudo sends `{}` while it has no map, and rooms of an imported map still have their numbers.
    #[test]
    fn rooms_with_a_number_keep_it_if_the_list_of_segments_is_empty() {
        let rooms = ["bathroom-1", "bedroom-2", "office-2", "hall-x", "attic-"];
        let of = |room: &str| segment_of(room, &rooms, &BTreeMap::new(), &BTreeMap::new());
        assert_eq!(of("bathroom-1").unwrap(), "1");
        assert!(of("bedroom-2").unwrap_err().contains("is that of office-2, too"));
        for room in ["hall-x", "attic-", "kitchen"] {
            assert!(of(room).unwrap_err().contains("list of segments is empty"), "{room}");
        }
    }

    #[test]
    fn a_segment_is_one_rooms() {
        let table = |pairs: &[(&str, &str)]| -> BTreeMap<String, String> {
            pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
        };
        let segments = table(&[("1", "Bad"), ("2", "Schlafzimmer"), ("3", "Küche")]);
        let rooms = ["bathroom-1", "bedroom-2", "kitchen-3"];
        // The configuration has precedence over a number.
        let configured = table(&[("kitchen-3", "2")]);
        let of = |room: &str, configured: &_| segment_of(room, &rooms, configured, &segments);
        assert_eq!(of("kitchen-3", &configured).unwrap(), "2");
        assert!(of("bedroom-2", &configured).unwrap_err().contains("the segment 2 is that of kitchen-3, too"));
        let twice = table(&[("kitchen-3", "2"), ("bathroom-1", "2")]);
        for room in ["kitchen-3", "bathroom-1", "bedroom-2"] {
            assert!(of(room, &twice).unwrap_err().contains("is that of"), "{room}");
        }
    }

    #[test]
    fn a_robot_that_divided_its_map_again_is_noticed() {
        let names = |pairs: &[(&str, &str)]| -> BTreeMap<String, String> {
            pairs.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
        };
        let rooms = ["bathroom-1", "bedroom-2", "kitchen-3", "hallway-4"];
        let of = |room: &str, segments: &_| segment_of(room, &rooms, &BTreeMap::new(), segments);
        let again = names(&[("1", "Flur"), ("2", "Küche"), ("3", "Bad")]);
        for (room, known) in [("bathroom-1", "\"Bad\" is 3"), ("kitchen-3", "\"Küche\" is 2")] {
            let why = of(room, &again).unwrap_err();
            assert!(why.contains("divided its map again") && why.contains(known), "{why}");
        }
        // No other segment is the bedroom: its name may be a deliberate one.
        assert_eq!(of("bedroom-2", &again).unwrap(), "2");
        let own_words = names(&[("2", "Bei Lena"), ("4", "Schlafzimmer")]);
        assert_eq!(of("bedroom-2", &own_words).unwrap(), "2", "what nobody knows contradicts nothing");
        assert_eq!(of("room-3a", &names(&[("3a", "")])).unwrap(), "3a", "a number may have letters");
        // For a missing number the name decides.
        assert_eq!(of("hallway-4", &again).unwrap(), "1");
        assert_eq!(
            of("kitchen-3", &names(&[("3", ""), ("4", "Küche")])).unwrap(),
            "3",
            "without a name nothing is known"
        );
    }
}
