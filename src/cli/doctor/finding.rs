//! The findings of checks.

use std::path::Path;
use std::time::Duration;

use roomcast_core::grounding::{Grounding, partition_named};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::text::nearest;
use roomcast_services::config::{Config, RobotKind, is_room};
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Verdict {
    Good,
    /// Works, with a limit that the remedy lifts.
    Limited,
    /// Does not work, or many times worse than it could.
    Wrong,
}

#[derive(Debug, Serialize)]
pub(super) struct Finding {
    pub(super) check: &'static str,
    pub(super) verdict: Verdict,
    pub(super) found: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) remedy: Option<String>,
}

impl Finding {
    pub(super) fn good(check: &'static str, found: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Good, found: found.into(), remedy: None }
    }

    pub(super) fn limited(check: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Limited, found: found.into(), remedy: Some(remedy.into()) }
    }

    pub(super) fn wrong(check: &'static str, found: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self { check, verdict: Verdict::Wrong, found: found.into(), remedy: Some(remedy.into()) }
    }
}

/// The configuration's path, for remedies that name it.
pub(super) struct Place<'a> {
    pub(super) config: &'a Path,
    /// How long topics are listened to.
    #[cfg_attr(not(feature = "whole"), expect(dead_code, reason = "nothing is listened to"))]
    pub(super) wait: Duration,
}

impl Place<'_> {
    pub(super) fn shown(&self) -> String {
        self.config.display().to_string()
    }
}

pub(super) fn some_of<'a>(names: impl IntoIterator<Item = &'a str>) -> String {
    const SHOWN: usize = 6;
    let names: Vec<&str> = names.into_iter().collect();
    let shown = names.iter().take(SHOWN).copied().collect::<Vec<_>>().join(", ");
    match names.len().saturating_sub(SHOWN) {
        0 => shown,
        more => format!("{shown} and {more} more"),
    }
}

/// The first room in `[robot.segments]` that the map lacks, as a fault with its remedy.
pub(super) fn segment_of_no_room(config: &Config, map: &SemanticMap, file: &str) -> Option<(String, String)> {
    let room = config.robot.segments.keys().find(|room| map.find_room(room).is_none())?;
    let found = format!("[robot.segments] of {file} names the room {room:?}, which the map does not have");
    Some((found, room_remedy(room, map)))
}

/// The remedy for the name of a room that the map lacks.
pub(super) fn room_remedy(room: &str, map: &SemanticMap) -> String {
    let keys: Vec<&str> = (0..map.rooms().len()).map(|room| map.room_key(room)).collect();
    let names = (0..map.rooms().len()).map(|room| map.room_name(room));
    let rooms = keys.join(", ");
    match nearest(&room.to_lowercase(), keys.iter().copied().chain(names)) {
        Some(meant) => format!("write {meant:?}; the map's rooms are {rooms}"),
        None => format!("write one of the map's rooms: {rooms}"),
    }
}

/// The rooms of the planner's rules that the map lacks. The planner ignores these rules.
pub(super) fn rules_of_no_room(config: &Config, map: &SemanticMap, grounding: &Grounding, file: &str) -> Vec<Finding> {
    let partitions = grounding.partitions();
    let is_known = |own: &str| {
        partition_named(own, map, partitions).is_some()
            || partitions.iter().any(|partition| is_room(own, &partition.id))
    };
    let mut planner = config.planner.clone();
    let unknown = planner.named_rooms().filter(|(_, room)| !is_known(room)).map(|(key, room)| {
        let found = format!("{key} of {file} names the room {room:?}, which the map does not have");
        Finding::wrong("house rules", found, room_remedy(room, map))
    });
    unknown.collect()
}

/// Two contradictory lines of `[robot.segments]`, as a fault with its remedy: a room with two segments, where one is never used, or two rooms with
/// one segment, where the robot cleans neither. Home Assistant's automation may clean several rooms as one.
pub(super) fn segments_at_odds(config: &Config, map: &SemanticMap, file: &str) -> Option<(String, String)> {
    let table = &config.robot.segments;
    let pairs =
        || table.iter().enumerate().flat_map(|(at, one)| table.iter().skip(at + 1).map(move |other| (one, other)));
    // Two names of one room may have the same segment.
    let is_one = |room: &str, other: &str| map.find_room(room).is_some_and(|known| map.find_room(other) == Some(known));
    if let Some(((room, segment), (other, own))) =
        pairs().find(|((room, segment), (other, own))| segment != own && is_one(room, other))
    {
        let found = format!(
            "[robot.segments] of {file} gives {room:?} the segment {segment:?} and {other:?} the segment {own:?}, and both are one room of the map"
        );
        return Some((found, "leave out one of the two".to_owned()));
    }
    let is_shared = config.robot.kind == RobotKind::Valetudo;
    let ((room, segment), (other, _)) =
        pairs().filter(|_| is_shared).find(|((room, segment), (other, own))| segment == own && !is_one(room, other))?;
    let found = format!(
        "[robot.segments] of {file} gives {room:?} and {other:?} the same segment {segment:?}, so the robot does neither"
    );
    Some((found, "give each its own, and leave out a room that the robot has no segment for".to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;

    #[test]
    fn segments_that_cannot_both_be_meant_are_told() {
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let found = |text: &str| {
            let config: Config = toml::from_str(text).unwrap();
            segments_at_odds(&config, &map, "home.toml").map(|(found, _)| found)
        };
        let twice = "[robot.segments]\nkitchen = \"1\"\nliving-room = \"1\"\n";
        let told = "[robot.segments] of home.toml gives \"kitchen\" and \"living-room\" the same segment \"1\", so the robot does neither";
        assert_eq!(found(twice).as_deref(), Some(told));
        assert_eq!(found("[robot.segments]\n\"living room\" = \"1\"\nliving-room = \"1\"\nkitchen = \"2\"\n"), None);
        assert_eq!(found(&format!("[robot]\nkind = \"home-assistant\"\n{twice}")), None);
        let one = "[robot.segments]\n\"living room\" = \"1\"\nliving-room = \"2\"\n";
        let told = "[robot.segments] of home.toml gives \"living room\" the segment \"1\" and \"living-room\" the segment \"2\", and both are one room of the map";
        assert_eq!(found(one).as_deref(), Some(told));
        assert_eq!(found(&format!("[robot]\nkind = \"home-assistant\"\n{one}")).as_deref(), Some(told));
    }

    #[test]
    fn rules_of_rooms_that_the_map_lacks_are_told_with_the_nearest_room() {
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let found = |quiet: &str, id: &str| {
            let text = format!("[planner]\nquiet = [\"11:00-13:00 in {quiet}\"]\n[[planner.room]]\nid = \"{id}\"\n");
            let config: Config = toml::from_str(&text).unwrap();
            let findings = rules_of_no_room(&config, &map, &grounding, "home.toml");
            findings.into_iter().map(|own| format!("{}: {}", own.found, own.remedy.unwrap())).collect::<Vec<_>>()
        };
        for (quiet, id) in [("kitchen", "living-room"), ("Küche", "Living room"), ("kitchen, Wohnzimmer", "kuche")] {
            assert_eq!(found(quiet, id), [""; 0]);
        }
        let told = [
            "planner.quiet of home.toml names the room \"Nursery\", which the map does not have: write one of the map's rooms: kitchen, living-room",
            "planner.room.id of home.toml names the room \"Kitchn\", which the map does not have: write \"kitchen\"; the map's rooms are kitchen, living-room",
        ];
        assert_eq!(found("Nursery", "Kitchn"), told);
    }

    #[test]
    fn a_typo_is_told_from_another_word() {
        let rooms = ["kitchen", "living-room", "bathroom", "bedroom"];
        assert_eq!(nearest("kichen", rooms), Some("kitchen"));
        assert_eq!(nearest("living room", rooms), Some("living-room"));
        assert_eq!(nearest("garage", rooms), None);
        assert_eq!(nearest("home/fridge/stat", ["home/fridge/state", "home/oven/state"]), Some("home/fridge/state"));
        assert_eq!(some_of(["a"; 8]), "a, a, a, a, a, a and 2 more");
    }
}
