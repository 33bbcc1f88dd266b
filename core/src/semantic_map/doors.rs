//! Doors for a map without doors: between rooms that touch.

use super::footprint::{Footprint, Space, edges};
use super::{Door, MAX_TEXT_BYTES, Room, RoomId};

/// Largest gap between rooms that touch, in metres: outlines are measured, not exact.
const TOUCH_M: f64 = 0.1;
/// Least width of a passage, in metres.
const LEAST_M: f64 = 0.5;
/// Distance of the points that sample an outline, in metres; and the most points per room.
const STEP_M: f64 = 0.05;
const MOST_POINTS: f64 = 4_000.0;
/// Most tests of points against edges for the doors of a map. Larger outlines are sampled less densely.
const MOST_LOOKS: usize = 1 << 25;
/// Height of a door's position above the higher of both floors, in metres.
const HANDLE_M: f64 = 1.0;

/// A door for every two rooms that touch, in the middle of the longest common stretch.
pub(super) fn found(rooms: &[Room]) -> Vec<Door> {
    let seen = seen(rooms, MOST_LOOKS);
    let mut doors = Vec::new();
    for (here, room) in rooms.iter().enumerate() {
        for (there, other) in rooms.iter().enumerate().skip(here + 1) {
            let found = seen[here].passage(&seen[there]);
            // The outline of a nook inside a room touches the room, but not the reverse.
            let found = found.or_else(|| seen[there].passage(&seen[here]));
            let Some([x, y, z]) = found else { continue };
            let id = format!("{}--{}", room.id, other.id);
            let id = if id.len() <= MAX_TEXT_BYTES { id } else { format!("door-{here}-{there}") };
            let of = |index: usize| RoomId(u32::try_from(index).unwrap_or(u32::MAX));
            doors.push(Door { id, rooms: [of(here), of(there)], position_m: [x, y, z] });
        }
    }
    doors
}

/// A room with its sampled outline.
struct Seen<'a> {
    space: &'a Space,
    rings: Vec<Vec<[f64; 2]>>,
    /// Per ring: distance between the points in metres, and the points.
    points: Vec<(f64, Vec<[f64; 2]>)>,
}

/// Samples the rooms as densely as `most` tests allow, with at least one point per ring.
fn seen(rooms: &[Room], most: usize) -> Vec<Seen<'_>> {
    let spaces = rooms.iter().map(|room| &room.space);
    let mut seen: Vec<Seen> = spaces.map(|space| Seen { space, rings: space.rings(), points: Vec::new() }).collect();
    let mut coarser = 1.0;
    loop {
        seen.iter_mut().for_each(|room| room.put_points(coarser));
        let looks = looks(&seen);
        let are_fewest = || seen.iter().flat_map(|room| &room.points).all(|(_, points)| points.len() <= 1);
        if looks <= most || are_fewest() {
            return seen;
        }
        coarser *= (looks as f64 / most as f64).max(2.0);
    }
}

/// Number of point-edge tests.
fn looks(seen: &[Seen]) -> usize {
    let others = |here: usize| seen.iter().enumerate().filter(move |(there, _)| *there != here).map(|(_, room)| room);
    seen.iter().enumerate().flat_map(|(here, room)| others(here).map(|other| room.looks(other))).sum()
}

fn length_m((a, b): ([f64; 2], [f64; 2])) -> f64 {
    (b[0] - a[0]).hypot(b[1] - a[1])
}

fn along(ring: &[[f64; 2]], step_m: f64) -> Vec<[f64; 2]> {
    let mut points = Vec::new();
    // Position of the next point along the edge.
    let mut next_m = 0.0;
    for (a, b) in edges(ring) {
        let edge_m = length_m((a, b));
        while next_m < edge_m {
            let part = next_m / edge_m;
            points.push([a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])]);
            next_m += step_m;
        }
        next_m -= edge_m;
    }
    points
}

impl Seen<'_> {
    fn put_points(&mut self, coarser: f64) {
        let all_m: f64 = self.rings.iter().flat_map(|ring| edges(ring)).map(length_m).sum();
        let step_m = coarser * STEP_M.max(all_m / MOST_POINTS);
        self.points = self.rings.iter().map(|ring| (step_m, along(ring, step_m))).collect();
    }

    /// Height of a door between the rooms, in metres. `None` if the rooms cannot touch.
    fn handle_m(&self, other: &Self) -> Option<f64> {
        let (own, far) = (&self.space.bounds, &other.space.bounds);
        let floor_m = own.min_m[2].max(far.min_m[2]);
        let ceiling_m = own.max_m[2].min(far.max_m[2]);
        let apart =
            |axis: usize| own.min_m[axis] > far.max_m[axis] + TOUCH_M || far.min_m[axis] > own.max_m[axis] + TOUCH_M;
        if ceiling_m <= floor_m || apart(0) || apart(1) {
            return None;
        }
        Some(floor_m + HANDLE_M.min(0.5 * (ceiling_m - floor_m)))
    }

    /// Whether the room's bounding box touches a point.
    fn is_around(&self, [x, y]: [f64; 2], z: f64) -> bool {
        self.space.bounds.distance_m(&[x, y, z]) <= TOUCH_M
    }

    /// Number of tests of this room's points against the other room's edges.
    fn looks(&self, other: &Self) -> usize {
        let (Some(z), Some(footprint)) = (self.handle_m(other), &other.space.footprint) else { return 0 };
        let points = self.points.iter().flat_map(|(_, points)| points);
        footprint.corners() * points.filter(|point| other.is_around(**point, z)).count()
    }

    /// The middle of the longest stretch of the outline that touches the other room.
    fn passage(&self, other: &Self) -> Option<[f64; 3]> {
        let z = self.handle_m(other)?;
        let near = |point: &[f64; 2]| {
            let is_near = |footprint: &Footprint| footprint.is_near(*point, TOUCH_M);
            other.is_around(*point, z) && other.space.footprint.as_ref().is_none_or(is_near)
        };
        let mut best: (f64, Option<[f64; 2]>) = (0.0, None);
        for (step_m, points) in &self.points {
            let touches: Vec<bool> = points.iter().map(near).collect();
            // Start at a point that does not touch, so that the end of the list does not split a stretch.
            let first = touches.iter().position(|touches| !touches).unwrap_or(0);
            let count = points.len();
            let mut run = 0;
            for step in 0..=count {
                let place = (first + step) % count.max(1);
                if step < count && touches[place] {
                    run += 1;
                    continue;
                }
                let length_m = run as f64 * step_m;
                if run > 0 && length_m > best.0 {
                    let middle = (first + step - run + run / 2) % count;
                    best = (length_m, Some(points[middle]));
                }
                run = 0;
            }
        }
        // A stretch reaches around the other room's corners by `TOUCH_M` at each end.
        best.1.filter(|_| best.0 - 2.0 * TOUCH_M >= LEAST_M).map(|[x, y]| [x, y, z])
    }
}

#[cfg(test)]
mod tests {
    use super::super::SemanticMap;
    use super::{MOST_LOOKS, looks, seen};
    use serde_json::json;

    fn rooms(rooms: &serde_json::Value) -> SemanticMap {
        let scene = json!({"format": "roomcast-scene", "version": 2, "name": "x", "rooms": rooms, "items": []});
        SemanticMap::from_json(&scene.to_string()).unwrap()
    }

    fn boxed(id: &str, min_m: [f64; 3], max_m: [f64; 3]) -> serde_json::Value {
        json!({"id": id, "label": id, "box": {"min_m": min_m, "max_m": max_m}})
    }

    #[test]
    fn doors_are_found_where_rooms_touch() {
        let map = rooms(&json!([
            boxed("a", [0.0; 3], [4.0, 4.0, 2.5]),
            boxed("b", [4.0, 1.0, 0.0], [8.0, 3.0, 2.5]),
            boxed("corner", [8.0, 3.0, 0.0], [9.0, 5.0, 2.5]),
            boxed("upstairs", [0.0, 0.0, 2.5], [4.0, 4.0, 5.0]),
            boxed("far", [0.0, 4.3, 0.0], [4.0, 5.0, 2.5]),
        ]));
        assert_eq!(map.doors().len(), 1, "{:?}", map.doors());
        let [x, y, z] = map.doors()[0].position_m;
        assert!((x - 4.0).abs() < 0.05 && (y - 2.0).abs() < 0.05 && z == 1.0, "{x} {y} {z}");
        assert!(map.doors_found() && !map.to_json().contains("a--b"), "a file without doors stays one");
        assert_eq!(SemanticMap::from_json(&map.to_json()).unwrap(), map);
    }

    /// Teeth from west to east or from south to north, each across the whole room; the next room lies 0.01 m off.
    fn comb(index: usize, side_m: f64, teeth: usize, down: bool) -> serde_json::Value {
        let pitch_m = side_m / teeth as f64;
        let tooth = |tooth: usize| {
            let y = tooth as f64 * pitch_m;
            [[side_m, y], [side_m, y + 0.5 * pitch_m], [1.0, y + 0.5 * pitch_m], [1.0, y + pitch_m]]
        };
        let corners = [[0.0, 0.0]].into_iter().chain((0..teeth).flat_map(tooth)).chain([[0.0, side_m]]);
        let turned = |[x, y]: [f64; 2]| if down { [y, x] } else { [x, y] };
        let ring: Vec<_> = corners.map(|corner| turned(corner).map(|metres| metres + 0.01 * index as f64)).collect();
        json!({"id": format!("room-{index}"), "label": "room", "footprint": [ring]})
    }

    #[test]
    fn tests_of_points_for_doors_are_bounded_for_every_map() {
        let combs = |count: usize, side_m: f64, teeth: usize| {
            rooms(&json!((0..count).map(|index| comb(index, side_m, teeth, index == 1)).collect::<Vec<_>>()))
        };
        for (count, side_m, teeth) in [(2, 9_000.0, 1_249), (64, 9.0, 38)] {
            let map = combs(count, side_m, teeth);
            let seen = seen(&map.rooms, MOST_LOOKS);
            assert!(looks(&seen) <= MOST_LOOKS, "{count}: {}", looks(&seen));
            let points: usize = seen.iter().flat_map(|room| &room.points).map(|(_, points)| points.len()).sum();
            assert!(points <= 64 * 4_000, "{count}: {points}");
        }
        let dense = looks(&seen(&combs(64, 9.0, 38).rooms, usize::MAX));
        assert!(dense > MOST_LOOKS, "these rooms need the bound: {dense}");
    }

    #[test]
    fn rooms_of_a_large_building_are_looked_at_densely() {
        let room = |index: usize| {
            let [west, south] = [(index % 8) as f64 * 6.0, (index / 8) as f64 * 5.0];
            // Walls with 39 bends on each side.
            let bend = |at: usize| [0.15 * at as f64, 0.03 * (at % 2) as f64];
            let sides = (0..39).map(bend).chain((0..39).rev().map(|at| [bend(at)[0], 4.99 - bend(at)[1]]));
            let ring: Vec<_> = sides.map(|[x, y]| [west + x, south + y]).collect();
            json!({"id": format!("room-{index}"), "label": "room", "footprint": [ring]})
        };
        let map = rooms(&json!((0..64).map(room).collect::<Vec<_>>()));
        assert!(looks(&seen(&map.rooms, usize::MAX)) < MOST_LOOKS / 8);
        assert_eq!(map.doors().len(), 56, "one from each row to the next");
    }

    #[test]
    fn a_room_within_a_room_and_one_in_a_hole_have_doors() {
        let ring = json!([[[0, 0], [9, 0], [9, 9], [0, 9]], [[3, 3], [6, 3], [6, 6], [3, 6]]]);
        let map = rooms(&json!([
            {"id": "cloister", "label": "hallway", "footprint": ring},
            boxed("court", [3.0, 3.0, 0.0], [6.0, 6.0, 2.5]),
            boxed("nook", [0.5, 0.5, 0.0], [1.5, 1.5, 2.5]),
        ]));
        let joined: Vec<_> = map.doors().iter().map(|door| door.id.as_str()).collect();
        assert_eq!(joined, ["cloister--court", "cloister--nook"]);
    }
}
