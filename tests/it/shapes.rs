//! A real flat: the bounding box of its L-shaped living room covers half of the open kitchen. With outlines, items are in their rooms; with boxes, as
//! in version 1, the kitchen's island is in the living room.

use std::collections::BTreeMap;

use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_services::embedded;
use serde_json::Value;

fn scene() -> Value {
    serde_json::from_str(embedded::scene("flat").unwrap().text).unwrap()
}

fn boxes() -> Value {
    let mut scene = scene();
    scene["version"] = 1.into();
    for room in scene["rooms"].as_array_mut().unwrap() {
        ["footprint", "floor", "height"].iter().for_each(|key| drop(room.as_object_mut().unwrap().remove(*key)));
    }
    scene
}

/// The room of each item, by the item's id.
fn landed(scene: &Value) -> BTreeMap<String, String> {
    let map = SemanticMap::from_json(&scene.to_string()).unwrap();
    let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
    let room = |place: usize| grounding.partitions()[grounding.item_partition()[place].unwrap().0 as usize].id.clone();
    map.items().iter().enumerate().map(|(place, item)| (item.id.clone(), room(place))).collect()
}

/// Whether a point lies within a ring: a ray to the east crosses it an odd number of times.
fn within(ring: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    let next = ring.iter().cycle().skip(1);
    let crossed = ring
        .iter()
        .zip(next)
        .filter(|([ax, ay], [bx, by])| (ay > &y) != (by > &y) && x < ax + (y - ay) / (by - ay) * (bx - ax));
    crossed.count() % 2 == 1
}

/// The room with an item's centre above its floor, computed from the scene file alone.
fn stands_in(scene: &Value, item: &Value) -> String {
    let number = |value: &Value| value.as_f64().unwrap();
    let at = [0, 1].map(|axis| number(&item["position_m"][axis]));
    let under = |room: &&Value| match room["footprint"].as_array() {
        Some(rings) => {
            let ring: Vec<_> =
                rings[0].as_array().unwrap().iter().map(|corner| [number(&corner[0]), number(&corner[1])]).collect();
            within(&ring, at)
        }
        None => [0, 1].iter().all(|&axis| {
            (number(&room["box"]["min_m"][axis])..number(&room["box"]["max_m"][axis])).contains(&at[axis])
        }),
    };
    let rooms: Vec<&Value> = scene["rooms"].as_array().unwrap().iter().filter(under).collect();
    assert_eq!(rooms.len(), 1, "{item}");
    rooms[0]["id"].as_str().unwrap().to_owned()
}

#[test]
fn things_land_where_they_stand_and_boxes_have_the_kitchens_island_in_the_living_room() {
    let scene = scene();
    let (outlines, boxes) = (landed(&scene), landed(&boxes()));
    let items = scene["items"].as_array().unwrap();
    for item in items {
        let id = item["id"].as_str().unwrap();
        assert_eq!(outlines[id], stands_in(&scene, item), "{id}");
    }
    let wrong: Vec<&String> = outlines.iter().filter(|(id, room)| boxes[*id] != **room).map(|(id, _)| id).collect();
    for island in ["kitchen-counter-1", "coffee-maker-1", "kettle-1", "fruit-bowl-1", "frying-pan-1", "plate-1"] {
        assert_eq!((outlines[island].as_str(), boxes[island].as_str()), ("kitchen", "living-room"), "{island}");
    }
    assert!(wrong.len() >= 12, "boxes have only {wrong:?} wrong");
    assert!(wrong.iter().all(|id| boxes[*id] == "living-room"), "{wrong:?}");
}

#[test]
fn rooms_of_the_flat_are_reached_through_its_corridor() {
    let map = SemanticMap::from_json(embedded::scene("flat").unwrap().text).unwrap();
    let room = |id: &str| map.find_room(id).unwrap();
    let way = map.path(room("bedroom"), room("study")).unwrap();
    let names: Vec<&str> = way.iter().map(|room| map.rooms()[room.0 as usize].id.as_str()).collect();
    assert_eq!(names, ["bedroom", "corridor", "living-room", "study"]);
    assert_eq!(map.find_room("hallway"), Some(room("corridor")));
}
