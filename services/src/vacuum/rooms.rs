//! Which segment of the robot's map a room is.

use std::collections::BTreeMap;

use roomcast_core::names::Names;
use roomcast_core::semantic_map::SemanticMap;

/// The configured segments by their rooms' ids, for rooms may be configured by any name that the map has for them. Rooms that it does not have
/// stay as they are.
pub fn by_ids(configured: &BTreeMap<String, String>, map: &SemanticMap) -> BTreeMap<String, String> {
    let id = |room: &str| map.find_room(room).map_or(room, |known| &map.rooms()[known.0 as usize].id).to_owned();
    configured.iter().map(|(room, segment)| (id(room), segment.clone())).collect()
}

/// The segment of a room: the one that is configured, else the one whose number the room's id ends with, as an imported map has it, else
/// the only one whose name means the room.
///
/// # Errors
///
/// Why there is none, in words for the planner's log.
pub fn segment_of(
    room: &str,
    configured: &BTreeMap<String, String>,
    segments: &BTreeMap<String, String>,
) -> Result<String, String> {
    if let Some(segment) = configured.get(room) {
        return Ok(segment.clone());
    }
    if segments.is_empty() {
        return Err("the robot has told of no segments; name them in [robot.segments]".to_owned());
    }
    if let Some(number) =
        room.rsplit_once('-').map(|(_, number)| number).filter(|number| segments.contains_key(*number))
    {
        return Ok(number.to_owned());
    }
    let means = |name: &str| {
        let plain = name.to_lowercase().split([' ', '_', '-']).collect::<Vec<_>>().join("-");
        let kind = Names::built_in().room(name).map(|kind| kind.replace(' ', "-"));
        plain == room || kind.as_deref() == Some(room)
    };
    let mut named = segments.iter().filter(|(_, name)| means(name)).map(|(number, _)| number.clone());
    match (named.next(), named.next()) {
        (Some(segment), None) => Ok(segment),
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
        let of = |room: &str| segment_of(room, &configured, &segments);
        assert_eq!(of("office").unwrap(), "9");
        assert_eq!(of("room-17").unwrap(), "17");
        assert_eq!(of("kitchen").unwrap(), "1");
        assert_eq!(of("kitchen-1").unwrap(), "1");
        assert_eq!(of("living-room").unwrap(), "2");
        assert!(of("bathroom").unwrap_err().contains("several"));
        assert!(of("garage").unwrap_err().contains("no segment"));
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let by_names = by_ids(&table(&[("living room", "17"), ("kitchen", "1"), ("attic", "3")]), &map);
        assert_eq!(by_names, table(&[("living-room", "17"), ("kitchen", "1"), ("attic", "3")]));
        assert!(segment_of("kitchen", &configured, &BTreeMap::new()).unwrap_err().contains("told of no segments"));
    }
}
