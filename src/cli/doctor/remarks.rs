//! Remarks on the lines that rules make of messages: unknown persons, sentences that set no presence, and places that the map lacks.

use roomcast_core::names::Names;
use roomcast_core::narration::Sentence;
use roomcast_core::narration::forms::{self, near_miss};
use roomcast_core::places::PlaceMatcher;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_services::daemon::Persons;
use serde_json::Value;

/// The home that lines are compared with.
pub(in crate::cli) struct Remarks<'a> {
    pub(in crate::cli) persons: Persons,
    pub(in crate::cli) residents: &'a [String],
    pub(in crate::cli) home: Option<(&'a SemanticMap, PlaceMatcher)>,
}

impl Remarks<'_> {
    pub(in crate::cli) fn on(&mut self, line: &str) -> Option<String> {
        let line: Value = serde_json::from_str(line).ok()?;
        let nobody = no_person(&line, &self.persons);
        let nobody = nobody.or_else(|| no_resident(&line, &self.persons, self.residents));
        let near = not_quite_a_form(&line, &self.persons, self.home.as_ref().map(|(map, _)| *map));
        let lacking = self.home.as_mut().and_then(|(map, mentions)| lacking(&line, map, mentions));
        let all: Vec<String> = [nobody, near, lacking].into_iter().flatten().collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

/// A text that begins with a name that belongs to no person.
fn no_person(line: &Value, persons: &Persons) -> Option<String> {
    let is_none = persons.begins_with_no_person(line.get("text")?.as_str()?);
    is_none.then(|| "the text begins with a name from persons.not_persons, so it moves no person".to_owned())
}

/// A text that resembles a presence form but is none.
fn not_quite_a_form(line: &Value, persons: &Persons, map: Option<&SemanticMap>) -> Option<String> {
    let text = line.get("text")?.as_str()?;
    let is_room = |room: &str| map.is_none_or(|map| map.find_room(room).is_some());
    let is_form = forms::read(text, |name| persons.called(name).is_some(), is_room).is_some();
    let form = near_miss(text).filter(|_| !is_form)?;
    Some(format!("this sets no presence; the nearest form is {:?} (docs/persons.md)", form.sentence))
}

fn no_resident(line: &Value, persons: &Persons, residents: &[String]) -> Option<String> {
    let name = line.get("person")?.as_str()?;
    let is_guest = persons.is_visitor(persons.number_of(name)) && persons.find(name).is_none();
    let who = residents.join(", ");
    is_guest.then(|| format!("nobody who lives here is called {name:?} (persons.residents: {who}): they are a visitor"))
}

fn lacking(line: &Value, map: &SemanticMap, mentions: &mut PlaceMatcher) -> Option<String> {
    let of = |key: &str| line.get(key).and_then(Value::as_str);
    let rooms = ["room", "beyond"].into_iter().filter_map(of);
    if let Some(room) = rooms.into_iter().find(|room| map.find_one_room(room).is_none()) {
        let rooms: Vec<&str> = (0..map.rooms().len()).map(|room| map.room_key(room)).collect();
        let has = if map.find_room(room).is_some() { "several rooms called" } else { "no room" };
        return Some(format!("the map has {has} {room:?}; its rooms are {}", rooms.join(", ")));
    }
    let thing = missing_thing(of("text")?, map, mentions)?;
    Some(format!("the map has no {thing:?}"))
}

/// The thing of a sentence, if neither it nor another thing in the sentence is on the map. `None` if the sentence names no thing, reports only
/// presence in the house, or has a placeholder with an unknown value.
pub(super) fn missing_thing(said: &str, map: &SemanticMap, mentions: &mut PlaceMatcher) -> Option<String> {
    let sentence = Sentence::new(said).ok().filter(|_| !said.contains('{'))?;
    if mentions.names_any(said) {
        return None;
    }
    if let Some((.., event)) = forms::read(sentence.as_str(), |_| true, |_| true) {
        let room = event.room()?;
        return map.find_room(room).is_none().then(|| room.to_owned());
    }
    let words: Vec<String> = said
        .split(|c: char| !(c.is_alphanumeric() || c == '\'' || c == '-'))
        .filter(|word| !word.is_empty())
        .map(str::to_lowercase)
        .collect();
    // A word in the table of names is a thing wherever it stands after subject and verb.
    let runs = (1..=4).rev().flat_map(|length| words.get(2..).unwrap_or_default().windows(length));
    let is_known = |run: &String| Names::built_in().names().any(|name| name == run);
    if let Some(known) = runs.map(|run| run.join(" ")).find(is_known) {
        return Some(known);
    }
    // An unknown word after "the" is a thing.
    let at = words.iter().position(|word| word == "the")?;
    let named = words[at + 1..].join(" ");
    (!named.is_empty()).then_some(named)
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::{Grounding, GroundingOptions};
    use roomcast_services::config::PersonsConfig;
    use roomcast_services::daemon::PersonsFile;

    #[test]
    fn a_rule_whose_thing_is_not_on_the_map_is_told_from_one_that_says_it_otherwise() {
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let mut missing = |said: &str| missing_thing(said, &map, &mut mentions);
        for (said, thing) in [
            ("They open the fridge.", "fridge"),
            ("They open the mailbox.", "mailbox"),
            ("They turn on the washing machine.", "washing machine"),
            ("They watch television.", "television"),
            ("They walk to the attic.", "attic"),
            ("They get out of the bed.", "bed"),
            ("They come from the attic.", "attic"),
        ] {
            assert_eq!(missing(said).as_deref(), Some(thing), "{said}");
        }
        let json = |line: &str| serde_json::from_str::<Value>(line).unwrap();
        let mut beside = |line: &str| lacking(&json(line), &map, &mut mentions);
        let rooms = map.rooms().iter().map(|room| room.id.as_str()).collect::<Vec<_>>().join(", ");
        let unknown = format!("the map has no room \"attic\"; its rooms are {rooms}");
        assert_eq!(beside(r#"{"presence":"present","room":"attic"}"#).as_ref(), Some(&unknown));
        let door = r#"{"sensor":"door","id":"d","room":"kitchen","beyond":"attic","on":true}"#;
        assert_eq!(beside(door), Some(unknown));
        assert_eq!(beside(r#"{"text":"They walk to the attic."}"#).as_deref(), Some("the map has no \"attic\""));
        for line in
            [r#"{"presence":"present","room":"kitchen"}"#, r#"{"presence":"away"}"#, r#"{"text":"They come home."}"#]
        {
            assert_eq!(beside(line), None, "{line}");
        }
        let config = PersonsConfig { not_persons: vec!["Rex".to_owned()], ..PersonsConfig::default() };
        let with_rex = Persons::new(config, PersonsFile::default());
        let nobody = |line: &str| no_person(&json(line), &with_rex);
        assert!(nobody(r#"{"text":"Rex lies on the sofa."}"#).is_some());
        let near = |line: &str| not_quite_a_form(&json(line), &with_rex, Some(&map));
        assert!(near(r#"{"text":"Ada leaves."}"#).is_some_and(|near| near.contains("NAME leaves the house")));
        for line in [r#"{"text":"They leave the house."}"#, r#"{"text":"They sit."}"#, r#"{"presence":"away"}"#] {
            assert_eq!(near(line), None, "{line}");
        }
        for line in [r#"{"text":"Ada lies on the sofa."}"#, r#"{"text":"They feed Rex."}"#, r#"{"presence":"away"}"#] {
            assert_eq!(nobody(line), None, "{line}");
        }
        let residents = vec!["Lena O'Neill".to_owned(), "Zoë".to_owned()];
        let config = PersonsConfig { residents: residents.clone(), ..PersonsConfig::default() };
        let persons = Persons::new(config, PersonsFile::default());
        let guest = |line: &str| no_resident(&json(line), &persons, &residents);
        let other =
            "nobody who lives here is called \"igor\" (persons.residents: Lena O'Neill, Zoë): they are a visitor";
        assert_eq!(guest(r#"{"person":"igor","presence":"away"}"#).as_deref(), Some(other));
        for line in [
            r#"{"person":"lena o neill","presence":"away"}"#,
            r#"{"person":"zoe","presence":"away"}"#,
            r#"{"presence":"away"}"#,
            r#"{"text":"Igor leaves the house."}"#,
        ] {
            assert_eq!(guest(line), None, "{line}");
        }
        let nobody_lives_here = Persons::new(PersonsConfig::default(), PersonsFile::default());
        assert_eq!(no_resident(&json(r#"{"person":"igor","presence":"away"}"#), &nobody_lives_here, &[]), None);
        let mut missing = |said: &str| missing_thing(said, &map, &mut mentions);
        for said in [
            "They sit on the sofa.",
            "They sit on the settee.",
            "They turn on the coffee-maker.",
            "They put the plate on the table.",
            "They switch on the light in the kitchen.",
            "They get up from the sofa.",
            "They get out of the living room.",
            "They leave the kitchen.",
            "They walk to the living room.",
            "They leave the house.",
            "They come home.",
            "They wake up.",
            "They go to sleep.",
            "They go for a walk.",
            "They turn on the {device}.",
        ] {
            assert_eq!(missing(said), None, "{said}");
        }
    }
}
