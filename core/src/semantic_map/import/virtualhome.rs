//! VirtualHome's environment graphs: nodes with a class, a category and a box (y up), edges with a relation.

use std::collections::{BTreeMap, HashMap, HashSet};

use serde::Deserialize;

use super::{Ids, ImportError, Imported, parse, words};
use crate::semantic_map::Box3;
use crate::semantic_map::schema::{DoorEntry, ItemEntry, MAX_ALIASES, RoomEntry, SceneFile};

#[derive(Deserialize)]
struct Graph {
    nodes: Vec<Node>,
    #[serde(default)]
    edges: Vec<Edge>,
}

#[derive(Deserialize)]
struct Node {
    id: i64,
    class_name: String,
    #[serde(default)]
    category: String,
    bounding_box: Option<Extent>,
}

#[derive(Deserialize)]
struct Extent {
    center: [f64; 3],
    size: [f64; 3],
}

#[derive(Deserialize)]
struct Edge {
    from_id: i64,
    to_id: i64,
    relation_type: String,
}

impl Extent {
    /// Unity's frame is left-handed with y up; exchanging y and z makes it right-handed with z up.
    fn to_box(&self) -> Box3 {
        let axis = [0, 2, 1];
        Box3 {
            min_m: axis.map(|axis| self.center[axis] - 0.5 * self.size[axis].abs()),
            max_m: axis.map(|axis| self.center[axis] + 0.5 * self.size[axis].abs()),
        }
    }
}

/// Converts an environment graph to a map.
///
/// Nodes of the category `Rooms` become rooms, all others items. Characters are left out (the forecast is about them), and so are nodes without a
/// box. Doors come from BETWEEN edges. Class names become words by the built-in table. If several rooms or items have the same class, each gets its
/// own id; an item's id ends with its number in the graph ("mug-173"), as in activity programs. `equivalence` is VirtualHome's table of class names
/// (a JSON object from a program's name to the scene's names) and adds aliases for the map's labels.
///
/// # Errors
/// If the text is not a VirtualHome graph, has no room, or breaks a rule of scenes.
pub fn virtualhome(json: &str, name: &str, equivalence: Option<&str>) -> Result<Imported, ImportError> {
    let graph: Graph = parse(json, "a VirtualHome environment graph: an object with `nodes` and `edges`")?;
    let mut notes = Vec::new();
    let mut room_ids = Ids::default();
    let mut item_ids = Ids::default();
    let mut rooms = Vec::new();
    let mut items = Vec::new();
    let mut node_of: HashMap<i64, &Node> = HashMap::new();
    let mut room_of: HashMap<i64, String> = HashMap::new();
    for node in &graph.nodes {
        let label = words(&node.class_name);
        node_of.insert(node.id, node);
        let Some(extent) = &node.bounding_box else {
            notes.push(format!("Left out node {} ({label}): it has no box.", node.id));
            continue;
        };
        let bounds = extent.to_box();
        if node.category == "Rooms" {
            let id = room_ids.take(&label);
            room_of.insert(node.id, id.clone());
            rooms.push(RoomEntry::boxed(id, label, bounds));
        } else if node.category == "Characters" {
            notes.push(format!("Left out node {} ({label}): a person is not part of the map.", node.id));
        } else {
            items.push(ItemEntry::boxed(item_ids.take(&format!("{label} {}", node.id)), &label, bounds));
        }
    }
    if rooms.is_empty() {
        return Err(ImportError::NoRooms { remedy: "at least one node must have the category `Rooms` and a box" });
    }
    let file = SceneFile {
        doors: doors(&graph.edges, &node_of, &room_of),
        aliases: aliases(&items, equivalence, &mut notes)?,
        ..SceneFile::new(name, "VirtualHome environment graph, imported", rooms, items)
    };
    Imported::new(file, notes, Vec::new())
}

fn doors(edges: &[Edge], node_of: &HashMap<i64, &Node>, room_of: &HashMap<i64, String>) -> Vec<DoorEntry> {
    let mut joined: BTreeMap<i64, Vec<&String>> = BTreeMap::new();
    for edge in edges.iter().filter(|edge| edge.relation_type == "BETWEEN") {
        if let Some(room) = room_of.get(&edge.to_id) {
            joined.entry(edge.from_id).or_default().push(room);
        }
    }
    let mut ids = Ids::default();
    let door = |(node, rooms): (i64, Vec<&String>)| {
        let position_m = node_of.get(&node)?.bounding_box.as_ref()?.to_box().centre_m();
        match rooms[..] {
            [a, b] if a != b => {
                let (a, b) = (a.min(b), a.max(b));
                Some(DoorEntry { id: ids.take(&format!("{a}--{b}")), rooms: [a.clone(), b.clone()], position_m })
            }
            _ => None,
        }
    };
    joined.into_iter().filter_map(door).collect()
}

fn aliases(
    items: &[ItemEntry],
    equivalence: Option<&str>,
    notes: &mut Vec<String>,
) -> Result<BTreeMap<String, Vec<String>>, ImportError> {
    let mut aliases: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let Some(json) = equivalence else { return Ok(aliases) };
    let table: BTreeMap<String, Vec<String>> =
        parse(json, "a table of equivalent class names: an object of lists of names")?;
    let labels: HashSet<&str> = items.iter().map(|item| item.label.as_str()).collect();
    let mut taken: HashSet<(String, String)> = HashSet::new();
    for (name, others) in &table {
        let alias = words(name);
        for label in others.iter().map(|other| words(other)) {
            if !labels.contains(label.as_str()) || label == alias || !taken.insert((label.clone(), alias.clone())) {
                continue;
            }
            if taken.len() > MAX_ALIASES {
                notes.push(format!("Left out aliases after the first {MAX_ALIASES}."));
                return Ok(aliases);
            }
            aliases.entry(label).or_default().push(alias.clone());
        }
    }
    Ok(aliases)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{Grounding, GroundingOptions, Placement};
    use crate::semantic_map::RoomId;
    use proptest::prelude::*;
    use std::path::Path;

    const GRAPH: &str = r#"{"nodes": [
        {"id": 1, "category": "Rooms", "class_name": "livingroom", "bounding_box": {"center": [0, 1.25, 0], "size": [4, 2.5, 6]}},
        {"id": 2, "category": "Rooms", "class_name": "bedroom", "bounding_box": {"center": [4, 1.25, 0], "size": [4, 2.5, 6]}},
        {"id": 3, "category": "Rooms", "class_name": "bedroom", "bounding_box": {"center": [8, 1.25, 0], "size": [4, 2.5, 6]}},
        {"id": 4, "category": "Appliances", "class_name": "washingmachine", "bounding_box": {"center": [1, 0.5, 2], "size": [0.6, 1, -0.7]}},
        {"id": 5, "category": "Doors", "class_name": "door", "bounding_box": {"center": [2, 1, 1], "size": [0.1, 2, 0.9]}},
        {"id": 6, "category": "Characters", "class_name": "character", "bounding_box": {"center": [1, 0.5, 2], "size": [0.6, 1, 0.7]}},
        {"id": 7, "category": "Props", "class_name": "mug", "bounding_box": null}],
        "edges": [{"from_id": 5, "to_id": 2, "relation_type": "BETWEEN"}, {"from_id": 5, "to_id": 1, "relation_type": "BETWEEN"},
                  {"from_id": 5, "to_id": 99, "relation_type": "BETWEEN"}]}"#;

    #[test]
    fn a_graph_becomes_a_map() {
        let table = r#"{"washer": ["washing_machine"], "laundry": ["washingmachine", "washing_machine"], "x": ["y"]}"#;
        let imported = virtualhome(GRAPH, "small", Some(table)).unwrap();
        let map = &imported.map;
        let ids: Vec<&str> = map.rooms.iter().map(|room| room.id.as_str()).collect();
        assert_eq!(ids, ["living-room", "bedroom", "bedroom-2"]);
        assert_eq!(map.rooms[0].space.bounds, Box3 { min_m: [-2.0, -3.0, 0.0], max_m: [2.0, 3.0, 2.5] });
        assert_eq!(map.items.len(), 2);
        assert_eq!(map.items[0].id, "washing-machine-4");
        assert_eq!(map.items[0].position_m, [1.0, 2.0, 0.5]);
        assert_eq!(map.doors[0].id, "bedroom--living-room");
        assert_eq!(map.path(RoomId(0), RoomId(1)), Some(vec![RoomId(0), RoomId(1)]));
        assert_eq!(map.aliases["washing machine"], ["laundry", "washer"]);
        assert_eq!(imported.notes.len(), 2);
    }

    #[test]
    fn what_is_no_graph_is_refused() {
        let message = |json: &str| virtualhome(json, "x", None).unwrap_err().to_string();
        assert!(message("[]").contains("VirtualHome environment graph"));
        assert!(message("{\"nodes\": []}").contains("has no room"));
        assert!(
            message(&GRAPH.replace("\"size\": [4, 2.5, 6]", "\"size\": [4, 2.5]"))
                .contains("nodes[0].bounding_box.size")
        );
        assert!(message(&GRAPH.replace("[1, 0.5, 2]", "[1, 0.5, 1e300]")).contains("farther than 10 km"));
        assert!(message(&format!("{{\"x\": {}", "[".repeat(100_000))).contains("the text ends too early"));
    }

    proptest! {
        #[test]
        fn hostile_text_never_panics(cut in 0..GRAPH.len(), noise in "\\PC{0,8}") {
            if GRAPH.is_char_boundary(cut) {
                let _ = virtualhome(&format!("{}{noise}{}", &GRAPH[..cut], &GRAPH[cut..]), "x", Some(&noise));
            }
        }
    }

    /// VirtualHome gives each thing's room; the largest overlap must agree at least as often as it can.
    #[test]
    fn grounding_agrees_with_virtualhomes_own_rooms() {
        let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/virtualhome/scenes");
        if !scenes.is_dir() {
            crate::skipped::skipped(format_args!("{} is missing", scenes.display()));
            return;
        }
        for (scene, least, overlapping, tied) in
            [("TestScene1", 423, 430, 62), ("TestScene5", 341, 347, 7), ("TestScene2", 300, 303, 20)]
        {
            let json = std::fs::read_to_string(scenes.join(format!("{scene}_graph.json"))).unwrap();
            let imported = virtualhome(&json, scene, None).unwrap();
            let map = &imported.map;
            let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
            let graph: Graph = serde_json::from_str(&json).unwrap();
            let room_of: HashMap<i64, usize> = (graph.nodes.iter().filter(|node| node.category == "Rooms"))
                .enumerate()
                .map(|(index, node)| (node.id, index))
                .collect();
            let agrees = |index: &usize| {
                let id: i64 = map.items[*index].id.rsplit_once('-').unwrap().1.parse().unwrap();
                let inside = graph.edges.iter().filter(|edge| edge.from_id == id && edge.relation_type == "INSIDE");
                let room = inside.filter_map(|edge| room_of.get(&edge.to_id)).next();
                grounding.item_partition[*index].map(|room| room.0 as usize).as_ref() == room
            };
            let agreeing = (0..map.items.len()).filter(agrees).count();
            println!("{scene}: {agreeing} of {} items lie in the room that VirtualHome names", map.items.len());
            assert!(agreeing >= least, "{scene}: {agreeing} < {least}");
            assert_eq!(grounding.placed_by(Placement::Overlap) + grounding.placed_by(Placement::Tie), overlapping);
            assert_eq!(grounding.placed_by(Placement::Tie), tied);
            assert_eq!(grounding.unassigned, []);
        }
    }
}
