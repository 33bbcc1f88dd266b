use super::*;
use crate::narration::check_name;
use crate::semantic_map::import::Furnish;
use serde_json::Value;

const AREAS: &str = r#"{"version": 1, "minor_version": 6, "key": "core.area_registry", "data": {"areas": [
    {"aliases": ["Kochecke"], "floor_id": "ground", "icon": null, "id": "kuche", "labels": [], "name": "Küche", "picture": null},
    {"aliases": [], "id": "living_room", "name": "Living Room", "picture": null},
    {"aliases": [], "floor_id": "first", "id": "bedroom", "name": "Bedroom", "picture": null}]}}"#;
const FLOORS: &str = r#"{"data": {"floors": [{"floor_id": "first", "name": "First", "level": 1, "aliases": []},
    {"floor_id": "ground", "name": "Ground", "level": 0, "aliases": []}]}}"#;
const DEVICES: &str = r#"{"data": {"devices": [{"id": "d1", "area_id": "kuche", "name": "Aqara MCCGQ11LM", "name_by_user": "Kühlschranktür"},
    {"id": "d2", "area_id": "bedroom", "name": "Hue motion sensor", "name_by_user": null}], "deleted_devices": []}}"#;
const ENTITIES: &str = r#"{"data": {"entities": [
    {"entity_id": "binary_sensor.fridge_door", "area_id": "kuche", "device_id": null, "original_device_class": "door", "disabled_by": null, "unique_id": "1"},
    {"entity_id": "binary_sensor.0x00158d", "area_id": null, "device_id": "d1", "original_device_class": "opening", "unique_id": "2"},
    {"entity_id": "switch.kuche_coffee_maker", "area_id": "kuche", "name": null, "unique_id": "3"},
    {"entity_id": "light.living_room_ceiling", "area_id": "living_room", "unique_id": "4"},
    {"entity_id": "media_player.wohnzimmer_tv", "area_id": "living_room", "device_class": "tv", "unique_id": "5"},
    {"entity_id": "binary_sensor.hue_motion", "device_id": "d2", "original_device_class": "motion", "unique_id": "6"},
    {"entity_id": "binary_sensor.front_door", "area_id": "living_room", "device_class": "door", "unique_id": "7"},
    {"entity_id": "sensor.washer_power", "area_id": "bedroom", "original_device_class": "power", "unique_id": "8"},
    {"entity_id": "sensor.outdoor_temperature", "area_id": "bedroom", "original_device_class": "temperature", "unique_id": "9"},
    {"entity_id": "light.attic", "unique_id": "10"},
    {"entity_id": "light.off", "area_id": "kuche", "disabled_by": "user", "unique_id": "11"},
    {"entity_id": "switch.kuche_led", "area_id": "kuche", "entity_category": "config", "unique_id": "12"},
    {"entity_id": "person.grace", "unique_id": "p-2", "platform": "person"},
    {"entity_id": "person.joan", "unique_id": "yaml", "original_name": "Joan Clarke", "platform": "person"}], "deleted_entities": []}}"#;
const PERSONS: &str = r#"{"data": {"items": [{"id": "p-1", "name": "Ada Lovelace", "device_trackers": []}, {"id": "p-2", "name": "Grace \"Amazing\" Hopper"}]}}"#;

fn registries() -> Registries<'static> {
    Registries {
        areas: AREAS,
        floors: Some(FLOORS),
        devices: Some(DEVICES),
        entities: Some(ENTITIES),
        persons: Some(PERSONS),
        ..Registries::default()
    }
}

/// A rule with such a name would make the whole home unreadable.
#[test]
fn a_person_whom_no_sentence_can_name_is_left_out_and_told_of() {
    let long = "a".repeat(100);
    for name in ["Me", "nobody", "Who", "We", "They", "You", "Everyone", "12", "!", "{value}", &long] {
        let persons = format!(
            r#"{{"data": {{"items": [{{"id": "p-1", "name": "Ada"}}, {{"id": "p-2", "name": "{name}"}}, {{"id": "p-3", "name": "Me Too"}}]}}}}"#
        );
        let registries = Registries { entities: None, persons: Some(&persons), ..registries() };
        let home = home_assistant(&registries, "home").unwrap();
        assert_eq!(home.persons, ["Ada", "Me Too"], "{name}");
        let rules: toml::Table = toml::from_str(&home.rules.unwrap()).unwrap();
        for rule in rules["rule"].as_array().unwrap() {
            check_name(rule["person"].as_str().unwrap()).unwrap();
        }
        let says = |note: &String| note.starts_with("Left out the persons") && note.contains(&format!("\"{name}\""));
        assert!(name == "!" || home.imported.notes.iter().any(says), "{name}: {:?}", home.imported.notes);
    }
}

#[test]
fn a_home_describes_itself() {
    let home = home_assistant(&registries(), "home").unwrap();
    let map = &home.imported.map;
    let rooms: Vec<_> = map.rooms.iter().map(|room| (&*room.id, &*room.label, room.space.bounds.min_m[2])).collect();
    assert_eq!(rooms, [("kuche", "kitchen", 0.0), ("living_room", "living room", 0.0), ("bedroom", "bedroom", 3.0)]);
    assert_eq!(map.find_room("Kochecke"), map.find_room("kuche"));
    assert_eq!(
        map.path(crate::semantic_map::RoomId(1), crate::semantic_map::RoomId(2)).map(|path| path.len()),
        Some(3)
    );
    let room_of = |position_m| map.rooms_at(position_m).next().unwrap().0;
    let things: Vec<_> =
        (map.items.iter()).map(|item| (map.labels[item.label.0 as usize].as_str(), room_of(item.position_m))).collect();
    let expected = [
        ("fridge", 0),
        ("coffee maker", 0),
        ("ceiling lamp", 1),
        ("television", 1),
        ("front door", 1),
        ("washing machine", 2),
    ];
    assert_eq!(things, expected);
    assert!(
        home.imported.notes.iter().any(|note| note.contains("1 entities without an area")),
        "{:?}",
        home.imported.notes
    );
    assert!(map.description.contains("nothing is measured"));
}

#[test]
fn rules_say_what_states_mean() {
    let home = home_assistant(&registries(), "home").unwrap();
    for (object, expected) in [
        ("binary_sensor.fridge_door", &["on|They open the fridge.", "off|They close the fridge."][..]),
        // By its device's name.
        ("binary_sensor.0x00158d", &["on|They open the fridge.", "off|They close the fridge."]),
        ("binary_sensor.hue_motion", &["motion|bedroom"]),
        ("person.ada_lovelace", &["home|phone|Ada Lovelace"]),
        ("person.grace", &["home|phone|Grace \"Amazing\" Hopper"]),
        ("person.joan", &["home|phone|Joan Clarke"]),
        // A front door is only a sensor: a person may close it from outside.
        ("binary_sensor.front_door", &["on|They open the front door.", "door|living_room"]),
        ("sensor.washer_power", &["appliance|bedroom"]),
    ] {
        assert_eq!(says(&home, object), expected, "{object}");
    }
    assert_eq!(says(&home, "media_player.wohnzimmer_tv")[0], "playing|They watch the television.");
    let rules = home.rules.unwrap();
    let file: toml::Table = rules.parse().unwrap();
    let sensors: Vec<_> = file["rule"].as_array().unwrap().iter().filter(|rule| rule.get("sensor").is_some()).collect();
    let washer = sensors.iter().find(|rule| rule["id"].as_str() == Some("sensor.washer_power")).unwrap();
    assert_eq!(washer["above"].as_float(), Some(15.0));
    assert!(!rules.contains("light.off") && !rules.contains("kuche_led") && !rules.contains("presence"));
}

/// Newer registries: floors and labels, aliases that are not text, areas without a floor, a floor without a level, rooms of one kind.
#[test]
fn registries_of_newer_homes_are_read() {
    let areas = r#"{"version": 1, "minor_version": 9, "key": "core.area_registry", "data": {"areas": [
        {"aliases": ["Lenas Reich"], "floor_id": "og", "humidity_entity_id": null, "icon": "mdi:bed", "id": "kinderzimmer_lena", "labels": ["kids"],
         "name": "Kinderzimmer Lena", "picture": null, "temperature_entity_id": null, "created_at": "2025-01-01T00:00:00+00:00", "modified_at": "2025-01-01T00:00:00+00:00"},
        {"aliases": [null], "floor_id": "og", "id": "kinderzimmer_tom", "labels": [], "name": "Kinderzimmer Tom"},
        {"aliases": null, "floor_id": null, "id": "wohn_esszimmer", "name": "🛋 Wohn-/Esszimmer"},
        {"floor_id": "gone", "id": "bad", "name": "Bad "},
        {"floor_id": "keller", "id": "hobbyraum", "name": "Hobbyraum"}]}}"#;
    let floors = r#"{"version": 1, "minor_version": 2, "data": {"floors": [
        {"aliases": [], "floor_id": "og", "icon": null, "level": 1, "name": "Obergeschoss"},
        {"aliases": [], "floor_id": "eg", "icon": null, "level": null, "name": "Erdgeschoss"},
        {"aliases": [], "floor_id": "keller", "icon": null, "level": -1, "name": "Keller"}]}}"#;
    let devices = r#"{"version": 1, "minor_version": 11, "data": {"devices": [
        {"id": "d1", "area_id": "kinderzimmer_tom", "name": "Bewegungsmelder Tom", "name_by_user": null, "labels": [], "primary_config_entry": "x",
         "config_entries_subentries": {"x": [null]}, "disabled_by": null, "entry_type": null, "model_id": "E2134"}], "deleted_devices": []}}"#;
    let entities = r#"{"version": 1, "minor_version": 18, "data": {"entities": [
        {"aliases": [], "area_id": null, "categories": {}, "device_id": "d1", "entity_id": "binary_sensor.bewegungsmelder_tom_belegung",
         "has_entity_name": true, "labels": [], "name": null, "original_name": "Belegung", "original_device_class": "occupancy", "disabled_by": null,
         "hidden_by": null, "entity_category": null, "unique_id": 12, "options": {"conversation": {"should_expose": true}}},
        {"area_id": "bad", "device_id": null, "entity_id": "light.bad_spiegel", "name": "Spiegel", "hidden_by": null, "unique_id": "2"},
        {"area_id": "bad", "device_id": null, "entity_id": "binary_sensor.f", "name": "Fenster", "device_class": "window", "unique_id": "8"},
        {"area_id": "bad", "device_id": null, "entity_id": "light.bad_alle", "name": "Alle", "hidden_by": "integration", "unique_id": "3"},
        {"area_id": "wohn_esszimmer", "device_id": null, "entity_id": "media_player.lg_webos_tv", "unique_id": "4"},
        {"area_id": "wohn_esszimmer", "device_id": null, "entity_id": "cover.rollo_links", "unique_id": "5"},
        {"area_id": "hobbyraum", "device_id": null, "entity_id": "switch.kompressor_saege", "name": "Компрессор", "unique_id": "6"},
        {"area_id": "bad", "device_id": null, "entity_id": "event.bad_taster", "unique_id": "7"}], "deleted_entities": [{"entity_id": "light.was"}]}}"#;
    let persons = r#"{"version": 2, "data": {"items": [{"id": "a", "name": "Łukasz", "device_trackers": ["device_tracker.phone"], "picture": null, "user_id": null}]}}"#;
    let registries = Registries {
        areas,
        floors: Some(floors),
        devices: Some(devices),
        entities: Some(entities),
        persons: Some(persons),
        ..Registries::default()
    };
    let home = home_assistant(&registries, "home").unwrap();
    let map = &home.imported.map;
    let rooms: Vec<_> = map.rooms.iter().map(|room| (&*room.id, &*room.label, room.space.bounds.min_m[2])).collect();
    assert_eq!(
        rooms,
        [
            ("hobbyraum", "living room", 0.0),
            ("wohn_esszimmer", "living room", 3.0),
            ("bad", "bathroom", 3.0),
            ("kinderzimmer_lena", "children's bedroom", 6.0),
            ("kinderzimmer_tom", "children's bedroom", 6.0),
        ]
    );
    // Each of two rooms of one kind is found by its own names.
    for (name, room) in [
        ("Kinderzimmer Lena", Some("kinderzimmer_lena")),
        ("lenas reich", Some("kinderzimmer_lena")),
        ("Kinderzimmer Tom", Some("kinderzimmer_tom")),
        ("Bad", Some("bad")),
        ("Badezimmer", Some("bad")),
        ("Kinderzimmer", None),
    ] {
        let found = map.find_room(name).map(|room| map.rooms[room.0 as usize].id.as_str());
        assert_eq!(found, room, "{name}");
    }
    let things: Vec<_> = map.items.iter().map(|item| map.labels[item.label.0 as usize].as_str()).collect();
    assert_eq!(things, ["lamp", "window", "television", "blinds"], "no word of another language is a thing");
    let nameless = "No rules for switches and machines whose names are no known things: switch.kompressor_saege.";
    assert!(home.imported.notes.iter().any(|note| note.starts_with(nameless)), "{:?}", home.imported.notes);
    let rules = home.rules.unwrap();
    for part in [
        "room = \"kinderzimmer_tom\"",
        "They watch the television.",
        "They turn on the television.",
        "topic = \"homeassistant/person/lukasz/state\"",
        "sensor = \"phone\"",
        "person = \"Łukasz\"",
    ] {
        assert!(rules.contains(part), "{part} in {rules}");
    }
    assert!(!rules.contains("bad_alle") && !rules.contains("taster"), "{rules}");
    assert_eq!(home.persons, ["Łukasz"]);
    let furnished = home.imported.furnish(Furnish::Typical).unwrap();
    assert!(furnished.map.find_label("bed").is_some() && furnished.map.find_label("toy").is_some());
}

/// The attacks: floors times areas, entities times aliases. A registry that is too large is refused before rooms are built; any other is read once.
#[test]
fn large_registries_are_refused_or_read_once() {
    let area = |index: usize, aliases: usize| {
        let aliases: Vec<String> = (0..aliases).map(|alias| format!("alias {index} {alias}")).collect();
        serde_json::json!({"id": format!("a{index}"), "name": format!("room {index}"), "floor_id": "f63", "aliases": aliases})
    };
    let areas = |count: usize, aliases: usize| {
        let list: Vec<Value> = (0..count).map(|index| area(index, aliases)).collect();
        serde_json::json!({"data": {"areas": list}}).to_string()
    };
    let read = |areas: &str, floors: &str, entities: &str| {
        let registries = Registries { areas, floors: Some(floors), entities: Some(entities), ..Registries::default() };
        home_assistant(&registries, "x")
    };
    // The floor registry is invalid, and not even read.
    let error = read(&areas(65, 0), "no registry", "").unwrap_err().to_string();
    assert!(error.contains("65 entries, more than 64"), "{error}");
    let long = areas(1, 0).replace("\"a0\"", &format!("\"{}\"", "a".repeat(129)));
    let error = read(&long, "no registry", "").unwrap_err().to_string();
    assert!(error.contains("`id`: is 129 bytes long"), "{error}");

    let floor = |index: usize| serde_json::json!({"floor_id": format!("f{index}"), "level": index});
    let floors = serde_json::json!({"data": {"floors": (0..64).map(floor).collect::<Vec<_>>()}}).to_string();
    let entity = |index: usize| serde_json::json!({"entity_id": format!("light.alias_{index}_lamp"), "area_id": "a0", "unique_id": index.to_string()});
    let entities: Vec<Value> = (0..20_000).map(entity).collect();
    let entities = serde_json::json!({"data": {"entities": entities}}).to_string();
    let home = read(&areas(1, 20_000), &floors, &entities).unwrap();
    assert_eq!(home.imported.map.items.len(), 1, "all of them are the lamp of the room");
    assert_eq!(home.imported.map.aliases.values().map(Vec::len).sum::<usize>(), 1_000);
    let long = "fridge ".repeat(200);
    let named = entities.replace("light.alias_0_lamp", "switch.x1").replacen(
        "\"area_id\"",
        &format!("\"name\": \"{long}\", \"area_id\""),
        1,
    );
    let home = read(&areas(1, 0), &floors, &named).unwrap();
    assert!(home.imported.map.find_label("fridge").is_none(), "a name as long as that names nothing");
}

#[test]
fn what_is_no_home_is_refused() {
    let message =
        |areas: &str| home_assistant(&Registries { areas, ..Registries::default() }, "x").unwrap_err().to_string();
    assert!(message("{}").contains("expected a registry of Home Assistant"));
    assert!(message("{").starts_with("core.area_registry: "), "{}", message("{"));
    assert!(message(r#"{"data": {"areas": []}}"#).contains("make areas in Home Assistant"));
    assert!(
        message(r#"{"data": {"areas": [{"id": "a", "name": "A"}, {"id": "a", "name": "B"}]}}"#)
            .contains("is used twice")
    );
    let bare = home_assistant(&Registries { areas: AREAS, ..Registries::default() }, "x").unwrap();
    assert_eq!((bare.rules, bare.imported.map.items.len()), (None, 0));
    assert!(bare.imported.furnish(Furnish::Typical).unwrap().map.items.len() > 10);
}

/// A home of areas with names, and of entities: id, area, device class.
fn home_of(areas: &[(&str, &str)], entities: &[(&str, &str, &str)]) -> Home {
    home_with(areas, entities, &[], &[])
}

fn home_with(areas: &[(&str, &str)], entities: &[(&str, &str, &str)], persons: &[&str], leave_out: &[&str]) -> Home {
    read(areas, entities, persons, leave_out).unwrap()
}

fn read(
    areas: &[(&str, &str)],
    entities: &[(&str, &str, &str)],
    persons: &[&str],
    leave_out: &[&str],
) -> Result<Home, ImportError> {
    let leave_out: Vec<String> = leave_out.iter().map(|area| (*area).to_owned()).collect();
    read_with(areas, entities, persons, Registries { leave_out: &leave_out, ..Registries::default() })
}

fn read_with(
    areas: &[(&str, &str)],
    entities: &[(&str, &str, &str)],
    persons: &[&str],
    options: Registries<'_>,
) -> Result<Home, ImportError> {
    let area = |(id, name): &(&str, &str)| serde_json::json!({"id": id, "name": name, "aliases": []});
    let areas = serde_json::json!({"data": {"areas": areas.iter().map(area).collect::<Vec<_>>()}}).to_string();
    let entity = |(id, area, class): &(&str, &str, &str)| {
        let class = Some(class).filter(|class| !class.is_empty());
        serde_json::json!({"entity_id": id, "area_id": area, "original_device_class": class, "unique_id": id})
    };
    let entities =
        serde_json::json!({"data": {"entities": entities.iter().map(entity).collect::<Vec<_>>()}}).to_string();
    let person = |name: &&str| serde_json::json!({"id": name, "name": name});
    let persons = serde_json::json!({"data": {"items": persons.iter().map(person).collect::<Vec<_>>()}}).to_string();
    let registries = Registries { areas: &areas, entities: Some(&entities), persons: Some(&persons), ..options };
    home_assistant(&registries, "home")
}

#[test]
fn a_vacuums_segments_are_those_of_its_area_mapping() {
    let areas = r#"{"data": {"areas": [{"id": "kitchen", "name": "Kitchen"}, {"id": "hall", "name": "Hall"}]}}"#;
    let of = |options: &str| {
        let entities = format!(
            r#"{{"data": {{"entities": [{{"entity_id": "vacuum.dusty", "unique_id": "1", "options": {options}}},
                {{"entity_id": "vacuum.old", "unique_id": "2"}}]}}}}"#
        );
        let registries = Registries { areas, entities: Some(&entities), ..Registries::default() };
        home_assistant(&registries, "home").unwrap().segments
    };
    let mapped = of(r#"{"vacuum": {"area_mapping": {"kitchen": ["16", "17"], "hall": [], "attic": ["3"]}}}"#);
    let kitchen = [("kitchen".to_owned(), "16".to_owned())].into();
    assert_eq!(mapped, [("vacuum.dusty".to_owned(), kitchen)].into());
    for odd in
        ["{}", "null", "3", r#"{"vacuum": {"area_mapping": [1]}}"#, r#"{"vacuum": {"area_mapping": {"hall": 3}}}"#]
    {
        assert!(of(odd).is_empty(), "{odd}");
    }
}

/// The sentences of an object's rules for on or open.
fn says(home: &Home, object: &str) -> Vec<String> {
    let rules: toml::Table = home.rules.as_deref().unwrap_or_default().parse().unwrap();
    let rules = rules.get("rule").and_then(toml::Value::as_array).cloned().unwrap_or_default();
    let topic = format!("homeassistant/{}/state", object.replace('.', "/"));
    let own = rules.iter().filter(|rule| rule["topic"].as_str() == Some(&topic));
    let text = |rule: &toml::Value, key: &str| rule.get(key).and_then(toml::Value::as_str).map(str::to_owned);
    own.map(|rule| {
        let keys = ["when", "say", "sensor", "room", "person"];
        keys.iter().filter_map(|key| text(rule, key)).collect::<Vec<_>>().join("|")
    })
    .collect()
}

#[test]
fn like_things_in_two_rooms_are_told_apart_by_their_rooms() {
    let rooms = [("living_room", "Living Room"), ("kuche", "Küche"), ("bath", "Bathroom")];
    let home = home_of(
        &rooms,
        &[
            ("light.living_room", "living_room", ""),
            ("light.kuche", "kuche", ""),
            ("switch.bath_light", "bath", ""),
            ("binary_sensor.window", "kuche", "window"),
            ("binary_sensor.bath_window", "bath", "window"),
            ("media_player.bath", "bath", "speaker"),
            ("light.kuche_2", "kuche", ""),
            ("switch.kettle", "kuche", "outlet"),
        ],
    );
    for (object, expected) in [
        ("light.living_room", "on|They turn on the living room lamp."),
        ("light.kuche", "on|They turn on the kitchen lamp."),
        ("light.kuche_2", "on|They turn on the kitchen lamp."),
        ("switch.bath_light", "on|They turn on the bathroom lamp."),
        ("binary_sensor.window", "on|They open the kitchen window."),
        ("binary_sensor.bath_window", "on|They open the bathroom window."),
        ("media_player.bath", "playing|They listen to the speaker."),
        ("switch.kettle", "on|They turn on the kettle."),
    ] {
        assert_eq!(says(&home, object)[0], expected, "{object}");
    }
}

/// Rooms of one kind have their own names in sentences, or a number.
#[test]
fn no_two_devices_in_different_rooms_say_the_same() {
    let rooms = [
        ("a", "Kinderzimmer Lena"),
        ("b", "Kinderzimmer Tom"),
        ("c", "Kinderzimmer"),
        ("d", "Bedroom 2"),
        ("e", "Lena's room"),
        ("f", "Garage"),
        ("g", "Carport"),
        ("h", "Everybody leaves. {value}"),
        ("i", "Hall"),
        ("j", "Hall"),
    ];
    let of = |domain: &str, class: &'static str| -> Vec<(String, &str, &str)> {
        rooms.iter().map(|(id, _)| (format!("{domain}.{id}x"), *id, class)).collect()
    };
    let mut entities = of("light", "");
    entities.extend(of("binary_sensor", "door"));
    entities.push(("cover.roll".to_owned(), "g", "garage"));
    let entities: Vec<(&str, &str, &str)> = entities.iter().map(|(id, area, class)| (&**id, *area, *class)).collect();
    let home = home_of(&rooms, &entities);
    let mut room_of: HashMap<String, &str> = HashMap::new();
    for (id, area, _) in &entities {
        let said = says(&home, id);
        assert_eq!(said.len(), 2, "{id}");
        for sentence in said {
            let (_, sentence) = sentence.split_once('|').unwrap();
            assert!(!sentence.contains('{') && sentence.matches('.').count() == 1, "{sentence}");
            let own = room_of.entry(sentence.to_owned()).or_insert(area);
            assert_eq!(own, area, "{sentence}");
        }
    }
    assert_eq!(says(&home, "light.dx")[0], "on|They turn on the lamp in bedroom 2.");
    assert_eq!(says(&home, "light.ex")[0], "on|They turn on the lamp in lena's room.");
    assert_eq!(says(&home, "light.ax")[0], "on|They turn on the kinderzimmer lena lamp.");
}

#[test]
fn domain_and_class_give_the_thing() {
    let rooms = [("living_room", "Living Room"), ("garage", "Garage"), ("bedroom", "Bedroom"), ("kitchen", "Kitchen")];
    let entities = [
        ("cover.living_room_blinds", "living_room", "blind", "open|They open the living room blinds."),
        ("cover.fenetre_jar", "bedroom", "shutter", "open|They open the bedroom blinds."),
        ("cover.garage_door", "garage", "garage", "open|They open the garage door."),
        ("cover.garage", "garage", "", "open|They open the garage door."),
        ("cover.vorhang", "kitchen", "curtain", "open|They open the curtain."),
        ("cover.markise", "garage", "awning", "open|They open the awning."),
        ("cover.tor", "garage", "gate", "open|They open the gate."),
        ("binary_sensor.bed_door_1", "bedroom", "door", "on|They open the bedroom door."),
        ("binary_sensor.lr_door_1", "living_room", "door", "on|They open the living room door."),
        ("binary_sensor.bed_window_1", "bedroom", "window", "on|They open the window."),
        ("binary_sensor.gefrierschrank", "kitchen", "door", "on|They open the freezer."),
        ("media_player.bed_tv_player", "bedroom", "", "playing|They watch the television."),
        ("media_player.lr_receiver", "living_room", "receiver", "playing|They listen to the stereo."),
        ("fan.bed_ceiling", "bedroom", "", "on|They turn on the fan."),
        ("lock.hintereingang", "kitchen", "", "unlocked|They unlock the kitchen door."),
        ("humidifier.keller", "bedroom", "dehumidifier", "on|They turn on the dehumidifier."),
        ("light.wandlampe_flur_oben", "bedroom", "", "on|They turn on the lamp."),
        ("binary_sensor.bed_lights_power", "bedroom", "power", "on|They use the lamp."),
    ];
    let home = home_of(&rooms, &entities.map(|(id, area, class, _)| (id, area, class)));
    for (id, _, _, expected) in entities {
        assert_eq!(says(&home, id).first().map(String::as_str), Some(expected), "{id}");
    }
    let labels: Vec<&str> = home.imported.map.labels.iter().map(String::as_str).collect();
    assert!(!labels.contains(&"bed") && !labels.contains(&"lr") && !labels.contains(&"jar"), "{labels:?}");
}

#[test]
fn furniture_that_is_assumed_later_makes_the_sentence_name_the_room() {
    let rooms = [("bedroom", "Bedroom"), ("kitchen", "Kitchen"), ("lounge", "Living Room")];
    let entities = [("media_player.tv", "bedroom", ""), ("switch.kettle", "kitchen", "outlet")];
    for (furnished, television) in [(false, "the television"), (true, "the bedroom television")] {
        let home = read_with(&rooms, &entities, &[], Registries { furnished, ..Registries::default() }).unwrap();
        assert_eq!(says(&home, "media_player.tv")[0], format!("playing|They watch {television}."));
        assert_eq!(says(&home, "switch.kettle")[0], "on|They turn on the kettle.");
    }
}

#[test]
fn settings_counters_and_alarms_are_no_things() {
    let entities = [
        ("binary_sensor.office_multi_sensor_tamper", "kitchen", "tamper"),
        ("sensor.energy_this_month", "kitchen", "energy"),
        ("sensor.fridge_energy_this_month", "kitchen", "energy"),
        ("binary_sensor.kitchen_camera_animal", "kitchen", ""),
        ("binary_sensor.kitchen_camera_cat", "kitchen", "motion"),
        ("binary_sensor.kitchen_package", "kitchen", "occupancy"),
        ("switch.kitchen_away_mode", "kitchen", ""),
        ("switch.kitchen_camera_motion_detection", "kitchen", ""),
        ("switch.fridge_vacation_mode", "kitchen", ""),
        ("switch.waschmaschine_kindersicherung", "kitchen", ""),
        ("switch.adaptive_lighting_kitchen", "kitchen", ""),
        ("switch.dishwasher_child_lock", "kitchen", ""),
        ("light.printer_status_led", "kitchen", ""),
        ("button.coffee_maker", "kitchen", ""),
        ("camera.fridge", "kitchen", ""),
    ];
    let home = home_of(&[("kitchen", "Kitchen")], &entities);
    assert_eq!((home.rules, home.imported.map.items.len()), (None, 0), "{:?}", home.imported.map.labels);
}

#[test]
fn devices_with_a_state_become_sensors_and_are_bound_to_persons_by_name() {
    let rooms = [("bedroom", "Bedroom"), ("hall", "Hall"), ("office", "Office"), ("mira", "Mira's room")];
    let entities = [
        ("binary_sensor.bed_mira", "bedroom", "occupancy"),
        ("binary_sensor.bett_jon", "bedroom", "occupancy"),
        ("binary_sensor.bedroom_presence", "bedroom", "presence"),
        ("binary_sensor.hall_motion", "hall", "motion"),
        ("binary_sensor.hall_camera_person", "hall", "occupancy"),
        ("binary_sensor.hall_presence", "hall", "presence"),
        ("binary_sensor.office_left", "office", "occupancy"),
        ("binary_sensor.office_right", "office", "occupancy"),
        ("binary_sensor.mira_presence", "mira", "presence"),
        ("binary_sensor.haustuer", "hall", "door"),
        ("binary_sensor.office_door", "office", "door"),
        ("sensor.kettle_power", "hall", "power"),
        ("sensor.kettle_energy", "hall", "energy"),
        ("sensor.fridge_power", "hall", "power"),
        ("switch.kettle", "hall", "outlet"),
    ];
    let home = home_with(&rooms, &entities, &["Mira Mint", "Jon"], &[]);
    for (object, expected) in [
        ("binary_sensor.bed_mira", &["off|They get out of the bed.|Mira Mint", "bed|bedroom|Mira Mint"][..]),
        ("binary_sensor.bett_jon", &["off|They get out of the bed.|Jon", "bed|bedroom|Jon"]),
        ("binary_sensor.bedroom_presence", &["presence|bedroom"]),
        ("binary_sensor.hall_motion", &["motion|hall"]),
        ("binary_sensor.hall_camera_person", &["camera|hall"]),
        // The camera does not hold the room's state.
        ("binary_sensor.hall_presence", &["presence|hall"]),
        // Each covers a part of the room.
        ("binary_sensor.office_left", &["motion|office"]),
        ("binary_sensor.office_right", &["motion|office"]),
        // The room has her name.
        ("binary_sensor.mira_presence", &["presence|mira"]),
        ("binary_sensor.haustuer", &["on|They open the front door.", "door|hall"]),
        // The other side of the door is unknown.
        ("binary_sensor.office_door", &["on|They open the door.", "off|They close the door."]),
        ("sensor.kettle_power", &["appliance|hall"]),
        ("sensor.kettle_energy", &[]),
        // Its compressor runs by itself.
        ("sensor.fridge_power", &[]),
        ("switch.kettle", &["on|They turn on the kettle.", "off|They turn off the kettle."]),
    ] {
        assert_eq!(says(&home, object), expected, "{object}");
    }
    // A resident need not be a person in Home Assistant.
    let residents = ["Mira".to_owned(), "Jon".to_owned()];
    let options = Registries { residents: &residents, ..Registries::default() };
    let home = read_with(&rooms, &entities, &["Mira Mint"], options).unwrap();
    assert_eq!(says(&home, "binary_sensor.bed_mira")[1], "bed|bedroom|Mira Mint");
    assert_eq!(says(&home, "binary_sensor.bett_jon")[1], "bed|bedroom|Jon");
    // A first name of two persons matches neither.
    let home = home_with(&rooms, &entities, &["Mira Mint", "Mira Moss"], &[]);
    assert_eq!(says(&home, "binary_sensor.bed_mira"), ["motion|bedroom"]);
}

#[test]
fn areas_that_look_like_no_rooms_are_named_and_can_be_left_out() {
    let areas =
        [("kitchen", "Kitchen"), ("house", "House"), ("tesla", "Tesla"), ("misc", "Misc"), ("yard", "Front Yard")];
    let entities = [("switch.kettle", "kitchen", ""), ("light.porch", "yard", ""), ("light.x", "gone", "")];
    let home = home_of(&areas, &entities);
    let note = "House, Tesla, Misc, Front Yard look like no rooms";
    assert!(home.imported.notes.iter().any(|own| own.starts_with(note)), "{:?}", home.imported.notes);
    let home = home_with(&areas, &entities, &[], &["House", "tesla", "MISC", "front yard"]);
    let notes = &home.imported.notes;
    assert_eq!(home.imported.map.rooms.len(), 1);
    assert!(notes.iter().any(|note| note == "Areas left out: House, Tesla, Misc, Front Yard."), "{notes:?}");
    assert!(notes.iter().all(|note| !note.contains("look like no rooms")), "{notes:?}");
    assert!(notes.iter().any(|note| note.starts_with("Left out 1 entities without an area")), "{notes:?}");
    let error = read(&areas, &[], &[], &["Attic"]).unwrap_err().to_string();
    assert!(error.contains("has no area \"Attic\" to leave out; its areas are Kitchen, House"), "{error}");
    let all: Vec<&str> = areas.iter().map(|(id, _)| *id).collect();
    let error = read(&areas, &[], &[], &all).unwrap_err().to_string();
    assert!(error.contains("leave out fewer"), "{error}");
    let plain = home_of(&[("a", "Zaphod"), ("b", "Music room")], &[("light.a", "a", "")]);
    assert!(plain.imported.notes.iter().all(|note| !note.contains("look")), "{:?}", plain.imported.notes);
}

#[test]
fn floors_of_one_level_have_one_height() {
    let area = |(id, floor): &(&str, &str)| serde_json::json!({"id": id, "name": id, "floor_id": floor});
    let areas = [("kitchen", "main"), ("yard", "out"), ("cellar", "low"), ("shed", "")];
    let areas = serde_json::json!({"data": {"areas": areas.iter().map(area).collect::<Vec<_>>()}}).to_string();
    let heights = |levels: [Option<i64>; 3]| {
        let floors = ["main", "out", "low"].iter().zip(levels);
        let floors =
            floors.map(|(id, level)| serde_json::json!({"floor_id": id, "name": id.to_uppercase(), "level": level}));
        let floors = serde_json::json!({"data": {"floors": floors.collect::<Vec<_>>()}}).to_string();
        let registries = Registries { areas: &areas, floors: Some(&floors), ..Registries::default() };
        let home = home_assistant(&registries, "home").unwrap();
        let map = home.imported.map;
        let height = |id: &str| map.rooms.iter().find(|room| room.id == id).unwrap().space.bounds.min_m[2];
        let note = home.imported.notes.into_iter().find(|note| note.starts_with("Floors "));
        (["kitchen", "yard", "cellar", "shed"].map(height), note)
    };
    let (same, note) = heights([Some(0), Some(0), Some(-1)]);
    assert_eq!(same, [3.0, 3.0, 0.0, 3.0]);
    assert!(note.unwrap().starts_with("Floors of one level: MAIN and OUT (level 0)."));
    assert_eq!(heights([Some(0), Some(1), Some(-1)]).1, None);
    assert_eq!(heights([Some(1), Some(1), Some(2)]).0, [0.0, 0.0, 3.0, 0.0], "floors counted from 1");
    let (same, note) = heights([None, None, None]);
    assert_eq!(same, [0.0; 4]);
    assert!(note.unwrap().starts_with("Floors without a level: MAIN, OUT, LOW."));
    let (some, note) = heights([Some(0), None, Some(-1)]);
    assert_eq!((some, note.is_some()), ([3.0, 3.0, 0.0, 3.0], true));
}

#[test]
fn notes_name_rooms_as_people_do() {
    let ids = ["6ef2f63dc5044e53a442c6d51f8187cb", "6681723e5fb64ee9889bc0af463d09b4"];
    let home = home_of(
        &[(ids[0], "Living Room"), (ids[1], "Küche")],
        &[("light.ceiling", ids[0], ""), ("light.b", ids[1], "")],
    );
    let notes = home.imported.furnish(Furnish::Typical).unwrap().notes;
    assert!(notes.iter().any(|note| note.contains("alone: living room, kitchen.")), "{notes:?}");
    assert!(ids.iter().all(|id| notes.iter().all(|note| !note.contains(id))), "{notes:?}");
}
