//! The usual furniture of rooms that come without things, so that a map of bare rooms forecasts sensibly. It is assumed, and marked so.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use super::valetudo::CHARGER;
use super::{Ids, ImportError, Imported};
use crate::names::Names;
use crate::semantic_map::schema::{ItemEntry, MAX_PROSE_BYTES};
use crate::semantic_map::{Box3, Room, SemanticMap, room_of};

/// Label, width, depth, height, and how far above the floor, in metres.
type Piece = (String, f64, f64, f64, f64);

static USUAL: LazyLock<BTreeMap<String, Vec<Piece>>> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the table is compiled in and a test parses it")]
    toml::from_str(include_str!("furniture.toml")).expect("furniture.toml is valid")
});

/// The kind of a room that no table knows.
const ANY: &str = "room";
crate::choices! {
    /// Which rooms get the usual furniture.
    #[derive(Default)]
    pub enum Furnish {
        /// The usual furniture of their kind in rooms without things. Structural things, such as walls and windows, do not count.
        #[default]
        Typical,
        /// The same, and the missing pieces in rooms with only one or two kinds of things.
        Sparse,
    }
}

/// What ids of assumed things begin with.
const ASSUMED: &str = "assumed";
/// What a map says of them.
const MARK: &str =
    "Things whose ids begin with \"assumed\" are not measured: they are the usual furniture of their rooms.";
/// So many kinds of things tell a room from the others. The usual furniture of a few kinds of rooms has fewer.
const ENOUGH_KINDS: usize = 3;
/// Labels of things that are no furniture: a room with these alone counts as bare.
const BARE: [&str; 10] =
    [CHARGER, "wall", "floor", "ceiling", "door", "window", "blinds", "curtain", "curtains", "radiator"];
/// How densely places for a piece are tried, in metres; and the most along one side of a room.
const STEP_M: f64 = 0.1;
const MOST_STEPS: f64 = 60.0;
/// Most edges and things that are looked at to find places in a room; a piece for which none are left stands in the middle.
const MOST_LOOKS: usize = 1 << 24;
/// Most edges that the search for the rooms of things looks at; then the boxes around footprints decide.
const MOST_LOOKS_FOR_ROOMS: usize = 1 << 26;
/// How near a wall a piece stands at it, and how far from a door it keeps, in metres.
const AT_WALL_M: f64 = 0.15;
const DOOR_M: f64 = 0.7;

/// The usual furniture of a room by its label: "guest bedroom", "bedroom 2" and "küche" are of their kinds.
fn usual(label: &str) -> &'static [Piece] {
    let known = |kind: &str| USUAL.get(kind).map(Vec::as_slice);
    // A person sleeps in their own room.
    let of_somebody = || label.ends_with("'s room").then_some("bedroom").and_then(known);
    let found = known(label).or_else(|| Names::built_in().kind_of_room(label).and_then(known)).or_else(of_somebody);
    found.or_else(|| known(ANY)).unwrap_or_default()
}

/// Whether the usual furniture of a room, by its label, has a thing.
pub(super) fn usually_has(room: &str, thing: &str) -> bool {
    usual(room).iter().any(|(label, ..)| label == thing)
}

/// Puts pieces into one room.
struct Furnisher<'a> {
    room: &'a Room,
    doors: Vec<[f64; 2]>,
    taken: Vec<Box3>,
    /// How many edges and things may still be looked at.
    left: usize,
}

impl Furnisher<'_> {
    fn within(&mut self, bounds: &Box3) -> bool {
        self.left = self.left.saturating_sub(self.room.space.edges_met(bounds));
        let volume_m3 = bounds.volume_m3();
        self.room.space.overlap_m3(bounds) >= volume_m3 * (1.0 - 1e-6)
    }

    /// The best place for a piece of this size on the floor: within the room, on nothing else, away from doors, and at a wall if there is one.
    fn place(&mut self, size_m: [f64; 3]) -> Option<Box3> {
        let room = self.room.space.bounds;
        let mut best = None;
        for [width, depth] in [[size_m[0], size_m[1]], [size_m[1], size_m[0]]] {
            let free = [room.size_m()[0] - width, room.size_m()[1] - depth];
            if free[0] < 0.0 || free[1] < 0.0 {
                continue;
            }
            let steps = free.map(|free_m| (free_m / STEP_M).ceil().min(MOST_STEPS));
            for down in 0..=steps[1] as u32 {
                for right in 0..=steps[0] as u32 {
                    let part = |axis: usize, step: u32| f64::from(step) / steps[axis].max(1.0) * free[axis];
                    let tidy = |metres: f64| (metres * 1e3).round() / 1e3;
                    let (x, y) = (tidy(room.min_m[0] + part(0, right)), tidy(room.min_m[1] + part(1, down)));
                    let z = room.min_m[2];
                    let bounds =
                        Box3 { min_m: [x, y, z], max_m: [tidy(x + width), tidy(y + depth), tidy(z + size_m[2])] };
                    self.left = self.left.saturating_sub(1 + self.taken.len());
                    if self.left == 0 {
                        return best;
                    }
                    let is_at_door = self.doors.iter().any(|[x, y]| bounds.distance_m(&[*x, *y, z]) < DOOR_M);
                    let is_taken = || self.taken.iter().any(|other| other.overlap_m3(&bounds) > 0.0);
                    if is_at_door || is_taken() || !self.within(&bounds) {
                        continue;
                    }
                    let shifted = |[east, north]: [f64; 2]| {
                        let by = [AT_WALL_M * east, AT_WALL_M * north, 0.0];
                        Box3 {
                            min_m: std::array::from_fn(|axis| bounds.min_m[axis] + by[axis]),
                            max_m: std::array::from_fn(|axis| bounds.max_m[axis] + by[axis]),
                        }
                    };
                    let at_wall = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
                        .iter()
                        .any(|way| !self.within(&shifted(*way)));
                    if at_wall {
                        return Some(bounds);
                    }
                    best = best.or(Some(bounds));
                }
            }
        }
        best
    }

    /// A box for a piece, smaller where the room is too small for it; a small one in the middle where there is no room at all.
    fn put(&mut self, &(_, width, depth, height, above): &Piece) -> Box3 {
        let floor_m = self.room.space.bounds.min_m[2];
        let around = |[x, y, _]: [f64; 3], above: f64, side: [f64; 2]| Box3 {
            min_m: [x - 0.5 * side[0], y - 0.5 * side[1], floor_m + above],
            max_m: [x + 0.5 * side[0], y + 0.5 * side[1], floor_m + above + height],
        };
        if above > 0.0
            && let Some(below) = self.taken.last()
        {
            return around(below.centre_m(), above, [width, depth]);
        }
        const SMALLER: [f64; 4] = [1.0, 0.7, 0.5, 0.3];
        let mut parts = SMALLER.iter();
        let placed = parts.find_map(|part| self.place([part * width, part * depth, height]));
        let bounds = placed.unwrap_or_else(|| around(self.room.space.centre_m(), 0.0, [0.1, 0.1]));
        self.taken.push(bounds);
        bounds
    }
}

/// The things of each room that count as furniture, with their labels.
fn standing(map: &SemanticMap) -> Vec<Vec<(&str, Box3)>> {
    let mut rooms = vec![Vec::new(); map.rooms.len()];
    let mut left = MOST_LOOKS_FOR_ROOMS;
    for item in &map.items {
        let label = map.labels[item.label.0 as usize].as_str();
        if BARE.contains(&label) {
            continue;
        }
        if let Some(room) = room_of(&map.rooms, item, &mut left) {
            rooms[room].push((label, item.bounds));
        }
    }
    rooms
}

impl Imported {
    /// Puts the usual furniture of their kind into rooms. Ids of these things begin with "assumed".
    ///
    /// # Errors
    /// If the map becomes too large.
    pub fn furnish(self, which: Furnish) -> Result<Self, ImportError> {
        let Self { map, mut notes, boxed } = self;
        let mut file = map.to_file();
        let mut ids = Ids::default();
        ids.taken.extend(file.items.iter().map(|item| item.id.clone()));
        let before = file.items.len();
        let (mut bare, mut filled, mut sparse, mut unknown) = (0, 0, Vec::new(), Vec::new());
        for (index, (room, standing)) in map.rooms.iter().zip(standing(&map)).enumerate() {
            let pieces = usual(&room.label);
            let kinds = standing.iter().map(|(label, _)| label).collect::<BTreeSet<_>>().len();
            match which {
                _ if kinds == 0 => bare += 1,
                _ if kinds >= ENOUGH_KINDS.min(pieces.len()) => continue,
                Furnish::Sparse => filled += 1,
                Furnish::Typical => {
                    sparse.push(map.room_name(index));
                    continue;
                }
            }
            if pieces.as_ptr() == usual(ANY).as_ptr() && !unknown.contains(&room.label) {
                unknown.push(room.label.clone());
            }
            let doors = map.doors.iter().filter(|door| door.rooms.iter().any(|joined| joined.0 as usize == index));
            let doors = doors.map(|door| [door.position_m[0], door.position_m[1]]).collect();
            let taken = standing.iter().map(|(_, bounds)| *bounds).collect();
            let mut furnisher = Furnisher { room, doors, taken, left: MOST_LOOKS };
            for piece in pieces {
                if let Some((_, bounds)) = standing.iter().find(|(label, _)| *label == piece.0) {
                    // A thing on a piece of furniture stands on the room's own piece.
                    furnisher.taken.push(*bounds);
                    continue;
                }
                let bounds = furnisher.put(piece);
                file.items.push(ItemEntry::boxed(ids.take(&format!("{ASSUMED} {}", piece.0)), &piece.0, bounds));
            }
        }
        if !sparse.is_empty() {
            notes.push(format!(
                "Rooms with one or two kinds of things alone: {}. `--furnish sparse` assumes the furniture that they lack, too.",
                sparse.join(", ")
            ));
        }
        let assumed = file.items.len() - before;
        if assumed == 0 {
            notes.push("Every room has things of its own, so no furniture was assumed.".to_owned());
            return Ok(Self { map, notes, boxed });
        }
        // A map that says so already says it once.
        let description = format!("{} {MARK}", file.description.trim_end_matches(MARK).trim_end());
        if description.len() <= MAX_PROSE_BYTES {
            file.description = description.trim_start().to_owned();
        }
        notes.push(match filled {
            0 => format!("Rooms without things: {bare}; assumed in them: {assumed} things."),
            _ => format!(
                "Rooms without things: {bare}; with one or two kinds alone: {filled}; assumed in them: {assumed} things."
            ),
        });
        if !unknown.is_empty() {
            notes.push(format!(
                "Nothing is known of the usual furniture of {}: a table, a chair, a shelf and a lamp were assumed.",
                unknown.iter().map(|label| format!("\"{label}\"")).collect::<Vec<_>>().join(", ")
            ));
        }
        Self::new(file, notes, boxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{Grounding, GroundingOptions};
    use crate::semantic_map::{Item, LabelId};

    #[test]
    fn kinds_of_rooms_are_known_by_many_names() {
        let first = |label: &str| usual(label)[0].0.as_str();
        assert_eq!(first("kitchen"), "fridge");
        assert_eq!(first("guest bedroom"), "bed");
        assert_eq!(first("master bedroom"), "bed");
        assert_eq!(first("küche"), "fridge");
        assert_eq!(first("restroom"), "toilet");
        assert_eq!(first("corridor"), "coat rack");
        assert_eq!((first("bedroom 2"), first("lena's room"), first("kid's room")), ("bed", "bed", "bed"));
        assert_eq!((first("living room upstairs"), first("back yard")), ("sofa", "garden chair"));
        assert_eq!(first("room 7"), "table");
        for (kind, pieces) in &*USUAL {
            assert!(!pieces.is_empty() && pieces[0].4 == 0.0, "{kind}");
        }
    }

    #[test]
    fn bare_rooms_are_furnished_and_others_left_alone() {
        let bare = include_str!("../../../../tests/data/corners.json");
        let mut file: serde_json::Value = serde_json::from_str(bare).unwrap();
        let bed = file["items"].as_array().unwrap().iter().find(|item| item["id"] == "bed-1").unwrap().clone();
        file["items"] = serde_json::json!([bed]);
        let map = SemanticMap::from_json(&file.to_string()).unwrap();
        let imported = Imported { map, notes: Vec::new(), boxed: Vec::new() };
        let furnished = imported.furnish(Furnish::Typical).unwrap();
        let map = &furnished.map;
        let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
        assert!(grounding.unassigned().is_empty(), "{:?}", grounding.unassigned());
        let room_of = |label: &str| {
            let LabelId(label) = map.find_label(label).unwrap();
            let item = map.items.iter().position(|item| item.label.0 == label).unwrap();
            map.rooms[grounding.item_partition()[item].unwrap().0 as usize].id.as_str()
        };
        assert_eq!((room_of("fridge"), room_of("sofa"), room_of("coat rack")), ("kitchen", "living-room", "hallway"));
        assert_eq!(map.items.iter().filter(|item| !item.id.starts_with("assumed-")).count(), 1);
        assert!(map.find_label("wardrobe").is_none(), "the bedroom has a bed");
        assert!(map.description.ends_with(MARK));
        // Large pieces keep apart and within their rooms.
        let large: Vec<_> = map.items.iter().filter(|item| item.bounds.min_m[2] == 0.0).collect();
        for (index, item) in large.iter().enumerate() {
            assert!(large[index + 1..].iter().all(|other| item.bounds.overlap_m3(&other.bounds) == 0.0), "{}", item.id);
        }
        let again = furnished.furnish(Furnish::Typical).unwrap();
        assert!(again.notes.iter().any(|note| note.contains("Every room has things")));
    }

    /// A piece is smaller rather than at a door.
    #[test]
    fn furniture_leaves_doors_free() {
        let space = Box3 { min_m: [0.0; 3], max_m: [2.4, 2.4, 2.5] }.into();
        let room = Room { id: "room".to_owned(), label: "room".to_owned(), space };
        let doors = vec![[0.0, 0.8], [2.4, 1.2], [1.2, 0.0]];
        let mut furnisher = Furnisher { room: &room, doors: doors.clone(), taken: Vec::new(), left: MOST_LOOKS };
        for side_m in [2.0, 1.6, 0.8, 0.4] {
            let bounds = furnisher.put(&("table".to_owned(), side_m, side_m, 0.7, 0.0));
            for [x, y] in &doors {
                let apart_m = bounds.distance_m(&[*x, *y, 0.0]);
                assert!(apart_m >= DOOR_M, "{side_m}: {bounds:?} is {apart_m} m from a door");
            }
        }
    }

    /// However many things stand in a room that lacks some, so many are looked at.
    #[test]
    fn what_is_looked_at_to_find_places_is_bounded() {
        let room = |side_m: f64| Room {
            id: "room".to_owned(),
            label: "room".to_owned(),
            space: Box3 { min_m: [0.0; 3], max_m: [side_m, side_m, 2.5] }.into(),
        };
        let thing = Box3 { min_m: [0.0; 3], max_m: [9.0, 9.0, 0.5] };
        let piece = ("bed".to_owned(), 2.0, 1.6, 0.5, 0.0);
        let room = room(9.0);
        let mut furnisher = Furnisher { room: &room, doors: Vec::new(), taken: vec![thing; 100_000], left: MOST_LOOKS };
        let bounds = furnisher.put(&piece);
        assert_eq!((bounds.centre_m()[0], furnisher.left), (4.5, 0), "in the middle");
        let mut furnisher = Furnisher { room: &room, doors: Vec::new(), taken: Vec::new(), left: MOST_LOOKS };
        furnisher.put(&piece);
        assert!(furnisher.left > MOST_LOOKS - 100);
        let item =
            Item { id: "x".to_owned(), label: LabelId(0), captions: Vec::new(), position_m: [0.5; 3], bounds: thing };
        assert_eq!(room_of(&[room], &item, &mut 0), Some(0));
    }

    /// A home's devices are not all things of a room.
    #[test]
    fn rooms_with_one_or_two_kinds_of_things_get_what_they_lack_on_request() {
        let bare = include_str!("../../../../tests/data/corners.json");
        let mut file: serde_json::Value = serde_json::from_str(bare).unwrap();
        let bed = file["items"].as_array().unwrap().iter().find(|item| item["id"] == "bed-1").unwrap().clone();
        let beside = |label: &str| {
            let mut item = bed.clone();
            (item["id"], item["label"]) = (label.replace(' ', "-").into(), label.into());
            item
        };
        let mut furnished = |labels: &[&str], sparse: bool| {
            file["items"] = labels.iter().map(|label| beside(label)).collect();
            let map = SemanticMap::from_json(&file.to_string()).unwrap();
            let bed = map.items[0].clone();
            let room = room_of(&map.rooms, &bed, &mut { usize::MAX }).unwrap();
            let imported = Imported { map, notes: Vec::new(), boxed: Vec::new() };
            let Imported { map, notes, .. } =
                imported.furnish(if sparse { Furnish::Sparse } else { Furnish::Typical }).unwrap();
            let own = map.items.iter().filter(|item| room_of(&map.rooms, item, &mut { usize::MAX }) == Some(room));
            let own: Vec<String> = own.map(|item| item.id.clone()).collect();
            (own, notes.join(" "), map)
        };
        let (own, notes, _) = furnished(&["ceiling lamp", "wardrobe"], false);
        assert_eq!(own, ["ceiling-lamp", "wardrobe"]);
        assert!(
            notes.contains("Rooms with one or two kinds of things alone: bedroom")
                && notes.contains("--furnish sparse"),
            "{notes}"
        );
        let (own, notes, map) = furnished(&["ceiling lamp", "wardrobe"], true);
        let lacking = ["bed", "pillow", "nightstand", "alarm-clock", "dresser"].map(|piece| format!("assumed-{piece}"));
        assert_eq!(own[..2], ["ceiling-lamp", "wardrobe"]);
        assert_eq!(own[2..], lacking, "a wardrobe is there already");
        assert!(notes.contains("with one or two kinds alone: 1; assumed in them"), "{notes}");
        let once = Imported { map, notes: Vec::new(), boxed: Vec::new() };
        let again = once.clone().furnish(Furnish::Sparse).unwrap();
        assert_eq!(again.map, once.map, "what has furniture is left alone");
        let (own, ..) = furnished(&["ceiling lamp", "wardrobe", "desk"], true);
        assert_eq!(own.len(), 3, "three kinds tell a room: {own:?}");
        // Every room has a window and a radiator.
        let (own, ..) = furnished(&["window", "blinds", "radiator"], false);
        assert!(own.contains(&"assumed-bed".to_owned()), "{own:?}");
        let (own, ..) = furnished(&["wall", "floor", "door", "ceiling"], false);
        assert!(own.contains(&"assumed-bed".to_owned()), "{own:?}");
    }
}
