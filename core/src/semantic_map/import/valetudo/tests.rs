use super::*;
use crate::grounding::{Grounding, GroundingOptions};
use crate::semantic_map::SemanticMap;
use crate::semantic_map::import::Furnish;
use proptest::prelude::*;

/// Two rooms of 3 m with a door between, a wall next to it; a speck of the kitchen far away, and a table's hole in it.
const FLAT: &str = include_str!("../../../../../tests/data/valetudo.json");

fn none() -> HashMap<String, String> {
    HashMap::new()
}

#[test]
fn segments_become_rooms_with_outlines() {
    let imported = valetudo(FLAT, "flat", &none()).unwrap();
    let map = &imported.map;
    let rooms: Vec<_> = map.rooms.iter().map(|room| (&*room.id, &*room.label)).collect();
    assert_eq!(rooms, [("kitchen-16", "kitchen"), ("hallway-17", "hallway"), ("room-3", "room 3")]);
    let area_m2 = |index: usize| map.rooms[index].space.footprint.as_ref().unwrap().area_m2();
    assert!((area_m2(0) - 9.0).abs() < 1e-6, "the table's hole is floor: {}", area_m2(0));
    assert_eq!(map.rooms[0].space.bounds, Box3 { min_m: [1.0, -4.0, 0.0], max_m: [4.0, -1.0, 2.5] });
    // An L of 3 x 3 m without a corner of 1 x 1 m.
    assert!((area_m2(1) - 8.0).abs() < 1e-6, "{}", area_m2(1));
    assert_eq!(map.doors.len(), 1, "room 3 lies behind a wall: {:?}", map.doors);
    let [x, y, _] = map.doors[0].position_m;
    assert!((x - 4.05).abs() < 0.1 && (y + 2.5).abs() < 0.1, "{x} {y}");
    assert_eq!(map.find_room("Küche"), Some(crate::semantic_map::RoomId(0)));
    assert_eq!(map.items[0].label, map.find_label("charging station").unwrap());
    assert!(Grounding::new(map, &GroundingOptions::default()).unwrap().unassigned.is_empty());
    assert!(imported.notes.iter().any(|note| note.contains("in pieces apart from it")), "{:?}", imported.notes);
    assert_eq!(SemanticMap::from_json(&map.to_json()).unwrap(), *map);
}

#[test]
fn names_can_be_given_by_segment() {
    let names = segment_names("3 = \"Lenas Zimmer\"\n\"17\" = \"Flur \"").unwrap();
    let map = valetudo(FLAT, "flat", &names).unwrap().map;
    assert_eq!((&*map.rooms[2].label, &*map.rooms[2].id), ("bedroom", "bedroom-3"));
    assert_eq!(map.find_room("Lenas Zimmer"), Some(crate::semantic_map::RoomId(2)));
    let unknown = segment_names("4 = \"attic\"").unwrap();
    let error = valetudo(FLAT, "flat", &unknown).unwrap_err().to_string();
    assert!(error.contains("segment \"4\", but the map has 16, 17, 3"), "{error}");
    // A map in place of its names.
    let map = format!("{{\"layers\": \"{}\"}}", "1,2,".repeat(1 << 18));
    assert!(segment_names(&map).unwrap_err().to_string().len() < 2_000);
    let error = valetudo(&map, "x", &HashMap::new()).unwrap_err().to_string();
    assert!(error.len() < 2_000, "{} bytes", error.len());
    assert!(segment_names("3 = 4").unwrap_err().to_string().contains("11 = \"kitchen\""));
}

/// The least number has no absolute value: a message at the broker ended `init`.
#[test]
fn pixels_at_the_ends_of_the_numbers_are_refused() {
    for far in [i64::MIN, i64::MAX] {
        for (key, run) in
            [("pixels", vec![far, 0, 1, 1]), ("pixels", vec![0, far]), ("compressedPixels", vec![far, far, far])]
        {
            let map = serde_json::json!({"pixelSize": 5, "layers": [{"type": "segment", "metaData": {"segmentId": "1"}, key: run}]});
            let error = valetudo(&map.to_string(), "home", &none()).unwrap_err().to_string();
            assert!(error.contains("lies too far out"), "{error}");
        }
    }
}

/// Segments that lie around one another, each as large as the whole map: no home, and much to trace.
#[test]
fn rooms_around_one_another_are_refused() {
    let map = |size: usize, rooms: usize| {
        let corner = |room: usize| {
            let from = 10 * room;
            let across = (from..from + 5).flat_map(move |row| [from, row, size - from]);
            let down = (from + 5..size).flat_map(move |row| [from, row, 5]);
            let runs: Vec<usize> = across.chain(down).collect();
            serde_json::json!({"type": "segment", "compressedPixels": runs, "metaData": {"segmentId": (room + 1).to_string()}})
        };
        let layers: Vec<Value> = (0..rooms).map(corner).collect();
        valetudo(&serde_json::json!({"pixelSize": 5, "layers": layers}).to_string(), "home", &none())
    };
    assert_eq!(map(400, 5).unwrap().map.rooms.len(), 5);
    let error = map(1990, 5).unwrap_err().to_string();
    assert!(error.contains(&format!("more than {MAX_ROOM_PIXELS} pixels in all")), "{error}");
}

/// A map of square segments side by side, with these names.
fn named(names: &[Value], of: impl Fn(&mut Value)) -> Result<Imported, ImportError> {
    let layer = |(index, name): (usize, &Value)| {
        let runs: Vec<usize> = (0..60).flat_map(|row| [100 + 60 * index, 100 + row, 60]).collect();
        serde_json::json!({"__class": "MapLayer", "type": "segment", "compressedPixels": runs,
            "metaData": {"segmentId": (index + 1).to_string(), "name": name, "active": false, "area": 90000, "material": "tile"}})
    };
    let layers: Vec<Value> = names.iter().enumerate().map(layer).collect();
    let mut map = serde_json::json!({"__class": "ValetudoMap", "metaData": {"version": 2, "nonce": "x", "vendorMapId": 3}, "size": {"x": 5120, "y": 5120},
        "pixelSize": 5, "layers": layers, "entities": []});
    of(&mut map);
    valetudo(&map.to_string(), "home", &none())
}

#[test]
fn rooms_of_one_kind_are_told_apart_by_their_names() {
    let names =
        ["Bad oben", "Bad unten ", "Kinderzimmer Tom", "Kinderzimmer Lena", "Flur", "Flur", "\u{200b}", "寝室", "Oда"];
    let imported = named(&names.map(Value::from), |_| {}).unwrap();
    assert!(
        imported.notes.iter().any(|note| note.starts_with("No English is known for \"oда\"")),
        "{:?}",
        imported.notes
    );
    let map = imported.map;
    let ids: Vec<_> = map.rooms.iter().map(|room| &*room.id).collect();
    let expected = [
        "bad-oben-1",
        "bad-unten-2",
        "kinderzimmer-tom-3",
        "kinderzimmer-lena-4",
        "hallway-5",
        "hallway-6",
        "room-7",
        "bedroom-8",
        "oда-9",
    ];
    assert_eq!(ids, expected);
    assert_eq!(map.rooms[3].label, "children's bedroom");
    for (name, room) in [
        ("Bad unten", Some(1)),
        ("kinderzimmer lena", Some(3)),
        ("寝室", Some(7)),
        ("hallway", Some(4)),
        ("Flur", None),
        ("Bad", None),
    ] {
        assert_eq!(map.find_room(name).map(|room| room.0), room, "{name}");
    }
    assert_eq!(SemanticMap::from_json(&map.to_json()).unwrap(), map);
}

#[test]
fn maps_of_other_robots_are_read() {
    // Names that are no names, and entities that other robots have.
    let odd = [
        Value::Null,
        Value::from(7),
        Value::from("  "),
        Value::from("x".repeat(300)),
        Value::from("a\nb\u{7}c"),
        Value::from(["Bad"]),
    ];
    let imported = named(&odd, |map| {
        map["entities"] = serde_json::json!([
            {"__class": "PointMapEntity", "type": "obstacle", "points": [520, 530], "metaData": {"label": "Pedestal (85%)"}},
            {"__class": "PolygonMapEntity", "type": "no_go_area", "points": [500, 500, 520, 500, 520, 520, 500, 520]},
            {"__class": "PathMapEntity", "type": "predicted_path", "points": null},
            {"__class": "PointMapEntity", "type": "charger_location", "points": {"x": 1}}]);
    })
    .unwrap();
    let labels: Vec<_> = imported.map.rooms.iter().map(|room| &*room.label).collect();
    assert_eq!(labels, ["room 1", "7", "room 3", "room 4", "a bc", "room 6"]);
    assert!(imported.map.items.is_empty(), "it has no charger");
    assert!(imported.notes.iter().any(|note| note.ends_with("virtual walls and areas (1).")), "{:?}", imported.notes);
    // Finer and coarser pixels, far from the origin; the first format, with each pixel by itself.
    for (pixel, area_m2) in [(1.0, 0.36), (2.5, 2.25), (10.0, 36.0)] {
        let map = named(&["Küche".into()], |map| map["pixelSize"] = pixel.into()).unwrap().map;
        let own_m2 = map.rooms[0].space.footprint.as_ref().unwrap().area_m2();
        assert!((own_m2 - area_m2).abs() < 1e-6, "{pixel}: {own_m2}");
    }
    let first = named(&["Küche".into()], |map| {
        let pixels: Vec<i64> = (0..3600).flat_map(|place| [-800_000 + place % 60, 900_000 - place / 60]).collect();
        map["metaData"]["version"] = 1.into();
        map["layers"][0]["pixels"] = pixels.into();
        map["layers"][0].as_object_mut().unwrap().remove("compressedPixels");
        map["layers"][0]["metaData"]["segmentId"] = 16.into();
    });
    let error = first.unwrap_err().to_string();
    assert!(error.contains("farther than 10 km"), "{error}");
    // As many rooms as there can be, and one more.
    let many = |count: usize| named(&vec![Value::from("Room"); count], |_| {});
    assert_eq!(many(64).unwrap().map.rooms.len(), 64);
    assert!(many(65).unwrap_err().to_string().contains("65 segments, more than 64"));
}

#[test]
fn a_map_without_segments_is_one_room() {
    let floor =
        r#"{"pixelSize": 5, "layers": [{"type": "floor", "compressedPixels": [0, 0, 20, 0, 1, 20, 0, 2, 20]}]}"#;
    let imported = valetudo(floor, "x", &none()).unwrap();
    assert_eq!((imported.map.rooms.len(), &*imported.map.rooms[0].label), (1, "home"));
    assert!(imported.notes[0].contains("let the robot divide it into rooms"));
}

#[test]
fn what_is_no_map_is_refused() {
    let message = |json: &str| valetudo(json, "x", &none()).unwrap_err().to_string();
    let layer =
        |runs: &str| format!(r#"{{"pixelSize": 5, "layers": [{{"type": "segment", "compressedPixels": {runs}}}]}}"#);
    for (json, expected) in [
        ("[]".to_owned(), "expected a map as Valetudo exports it"),
        (r#"{"pixelSize": 5, "layers": []}"#.to_owned(), "let the robot map the home first"),
        (r#"{"pixelSize": 0, "layers": []}"#.to_owned(), "pixelSize: 0 is no size"),
        (layer("[]"), "the layers have no pixels"),
        (layer("[1, 2]"), "compressedPixels triples"),
        (layer("[1, 2, -3]"), "layers[0]: has a run at [1, 2]"),
        (layer("[1, 2, 99999999999]"), "more than 4000000 pixels"),
        (layer("[0, 0, 9000000, 0, 1, 9000000]"), "more than 4000000 pixels"),
        (layer("[-9000000, 0, 1]"), "lies too far out"),
        (layer("[0, 0, 1, 19000, 19000, 1]"), "19001 x 19001 pixels"),
        (layer("[0, 0, 1, 900000, 0, 1]"), "pixels at 900000, which lie farther than 10 km"),
    ] {
        let text = message(&json);
        assert!(text.contains(expected), "{expected}: {text}");
    }
}

/// Rows of one segment, every other one a pixel longer: an outline of as many teeth as rows.
fn teeth(rows: usize, pixel_cm: f64) -> String {
    let runs: Vec<usize> = (0..rows).flat_map(|row| [0, row, 1 + row % 2]).collect();
    let layer = serde_json::json!({"type": "segment", "metaData": {"segmentId": "1"}, "compressedPixels": runs});
    serde_json::json!({"pixelSize": pixel_cm, "layers": [layer]}).to_string()
}

/// Pixels too far out are refused before names are compared, and so before anything is traced.
#[test]
fn a_map_beyond_10_km_is_refused_before_it_is_traced() {
    let unknown = segment_names("4 = \"attic\"").unwrap();
    let error = valetudo(&teeth(24_800, 100.0), "x", &unknown).unwrap_err().to_string();
    assert!(error.contains("pixels at 24799, which lie farther than 10 km"), "{error}");
    assert!(matches!(valetudo(&teeth(100, 100.0), "x", &unknown), Err(ImportError::Names { .. })));
}

#[test]
fn outlines_of_noise_become_a_box() {
    let map = valetudo(&teeth(24_800, 39.0), "x", &none()).unwrap();
    assert_eq!(map.map.rooms.len(), 1);
}

/// Rows of two segments, one after the other: each pixel touches the other segment.
#[test]
fn segments_that_touch_everywhere_have_one_door() {
    let layer = |first: usize| {
        let runs: Vec<usize> = (0..200).flat_map(|row| [0, 2 * row + first, 400]).collect();
        serde_json::json!({"type": "segment", "metaData": {"segmentId": (first + 1).to_string()}, "compressedPixels": runs})
    };
    let json = serde_json::json!({"pixelSize": 5, "layers": [layer(0), layer(1)]}).to_string();
    let map = valetudo(&json, "x", &none()).unwrap().map;
    assert_eq!(map.doors.len(), 1);
    let [x, y, _] = map.doors[0].position_m;
    assert!((x - 10.0).abs() < 0.2 && (y + 10.0).abs() < 0.2, "{x} {y}");
}

#[test]
fn segments_of_one_pixel_and_of_one_place_are_survived() {
    let twice = r#"{"pixelSize": 5, "layers": [{"type": "segment", "compressedPixels": [0, 0, 1]}, {"type": "segment", "pixels": [0, 0, 5, 5]}]}"#;
    let imported = valetudo(twice, "x", &none()).unwrap();
    assert_eq!(imported.map.rooms.len(), 1, "{:?}", imported.notes);
    assert!(imported.notes[0].contains("no pixels of its own"));
}

/// Six maps of real robots, if present: rooms as large as the robot counts them, every room reached but by a closed door.
#[test]
fn real_maps_become_rooms() {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/valetudo");
    if !folder.is_dir() {
        crate::skipped::skipped(format_args!("{} is missing", folder.display()));
        return;
    }
    let expected: [(&str, &[&str], usize); 6] = [
        ("1c_1096_fullcleanup", &["room 1", "room 2", "room 3"], 2),
        ("S5_FW2008_with_segments", &["room 1", "room 2"], 1),
        ("converted_3790", &["living room", "kitchen", "hallway", "hallway", "hallway", "hallway", "hallway"], 6),
        ("d9_1058_no_segments", &["home"], 0),
        ("d9_1058_with_custom_named_segments", &["room 1", "bathroom", "hallway", "room 4", "room 5", "room 6"], 5),
        (
            "z10_1056_paths",
            &["bathroom", "bedroom", "kitchen", "hallway", "living room", "dining room", "home office"],
            7,
        ),
    ];
    for (file, labels, doors) in expected {
        let json = std::fs::read_to_string(folder.join(format!("{file}.json"))).unwrap();
        let imported = valetudo(&json, file, &none()).unwrap().furnish(Furnish::Typical).unwrap();
        let map = &imported.map;
        assert!(map.rooms.iter().map(|room| room.label.as_str()).eq(labels.iter().copied()), "{file}");
        assert_eq!((map.doors.len(), &imported.boxed[..]), (doors, &[][..]), "{file}");
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        assert!(grounding.unassigned().is_empty(), "{file}: {:?}", grounding.unassigned());
        let read: Value = serde_json::from_str(&json).unwrap();
        for layer in read["layers"].as_array().unwrap().iter().filter(|layer| layer["type"] == "segment") {
            let number = text_of(&layer["metaData"]["segmentId"]).unwrap();
            let room = map.rooms.iter().find(|room| room.id.ends_with(&format!("-{number}"))).unwrap();
            let area_m2 = room.space.footprint.as_ref().unwrap().area_m2();
            let counted_m2 = layer["metaData"]["area"].as_f64().unwrap() / 1e4;
            assert!((0.85..1.2).contains(&(area_m2 / counted_m2)), "{file}, {}: {area_m2} {counted_m2}", room.id);
        }
    }
}

proptest! {
    /// Any raster becomes a checked map, and its rooms hold their pixels, to the tolerance.
    #[test]
    fn rooms_hold_their_pixels(cells in prop::collection::vec(0..4u8, 24 * 24)) {
        let mut layers = String::new();
        for mark in 1..4u8 {
            let pixels: Vec<String> = cells.iter().enumerate().filter(|(_, own)| **own == mark)
                .map(|(place, _)| format!("{},{}", place % 24, place / 24)).collect();
            layers.push_str(&format!(r#",{{"type": "segment", "metaData": {{"segmentId": {mark}}}, "pixels": [{}]}}"#, pixels.join(",")));
        }
        let json = format!(r#"{{"pixelSize": 10, "layers": [{{"type": "wall"}}{layers}]}}"#);
        if let Ok(imported) = valetudo(&json, "x", &HashMap::new()) {
            for room in &imported.map.rooms {
                prop_assert!(imported.boxed.contains(&room.id) || room.space.footprint.is_some());
            }
            prop_assert!(imported.furnish(Furnish::Typical).is_ok());
        }
    }
}
