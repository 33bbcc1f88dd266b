//! Doors of a map that gives none: where rooms touch.

use super::footprint::Space;
use super::{Door, MAX_TEXT_BYTES, Room, RoomId};

/// How far apart two rooms may lie and touch, in metres: outlines are measured.
const TOUCH_M: f64 = 0.1;
/// The least stretch that a person can walk through, in metres.
const LEAST_M: f64 = 0.5;
/// How densely an outline is looked at, in metres; and the most points of one.
const STEP_M: f64 = 0.05;
const MOST_POINTS: f64 = 4_000.0;
/// Where a door is, above the higher of both floors, in metres.
const HANDLE_M: f64 = 1.0;

/// A door in the middle of the longest stretch along which two rooms touch, for every two rooms that do.
pub(super) fn found(rooms: &[Room]) -> Vec<Door> {
    let outlines: Vec<_> = rooms.iter().map(|room| points(&room.space)).collect();
    let mut doors = Vec::new();
    for (here, room) in rooms.iter().enumerate() {
        for (there, other) in rooms.iter().enumerate().skip(here + 1) {
            let found = passage(&room.space, &outlines[here], &other.space);
            // A nook in the middle of a room touches no wall of it.
            let found = found.or_else(|| passage(&other.space, &outlines[there], &room.space));
            let Some([x, y, z]) = found else { continue };
            let id = format!("{}--{}", room.id, other.id);
            let id = if id.len() <= MAX_TEXT_BYTES { id } else { format!("door-{here}-{there}") };
            let of = |index: usize| RoomId(u32::try_from(index).unwrap_or(u32::MAX));
            doors.push(Door { id, rooms: [of(here), of(there)], position_m: [x, y, z] });
        }
    }
    doors
}

/// Points along the outlines, a list per ring with the distance from one to the next.
fn points(space: &Space) -> Vec<(f64, Vec<[f64; 2]>)> {
    let rings = space.rings();
    rings.iter().map(|ring| along(ring)).collect()
}

fn along(ring: &[[f64; 2]]) -> (f64, Vec<[f64; 2]>) {
    let edges = || ring.iter().zip(ring.iter().cycle().skip(1));
    let length_m = |(a, b): (&[f64; 2], &[f64; 2])| (b[0] - a[0]).hypot(b[1] - a[1]);
    let step_m = STEP_M.max(edges().map(length_m).sum::<f64>() / MOST_POINTS);
    let mut points = Vec::new();
    // How far along the edge the next point lies.
    let mut next_m = 0.0;
    for (a, b) in edges() {
        let edge_m = length_m((a, b));
        while next_m < edge_m {
            let part = next_m / edge_m;
            points.push([a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])]);
            next_m += step_m;
        }
        next_m -= edge_m;
    }
    (step_m, points)
}

/// The middle of the longest stretch of the outline that touches the other room.
fn passage(space: &Space, outline: &[(f64, Vec<[f64; 2]>)], other: &Space) -> Option<[f64; 3]> {
    let (own, far) = (&space.bounds, &other.bounds);
    let floor_m = own.min_m[2].max(far.min_m[2]);
    let ceiling_m = own.max_m[2].min(far.max_m[2]);
    let apart =
        |axis: usize| own.min_m[axis] > far.max_m[axis] + TOUCH_M || far.min_m[axis] > own.max_m[axis] + TOUCH_M;
    if ceiling_m <= floor_m || apart(0) || apart(1) {
        return None;
    }
    let z = floor_m + HANDLE_M.min(0.5 * (ceiling_m - floor_m));
    let near = |&[x, y]: &[f64; 2]| {
        let point_m = [x, y, z];
        far.distance_m(&point_m) <= TOUCH_M && other.distance_m(&point_m) <= TOUCH_M
    };
    let mut best: (f64, Option<[f64; 2]>) = (0.0, None);
    for (step_m, points) in outline {
        let touches: Vec<bool> = points.iter().map(near).collect();
        // From a point that does not touch, so that no stretch is cut in two by the list's end.
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
    // The ends of a stretch reach around the other room's corners.
    best.1.filter(|_| best.0 - 2.0 * TOUCH_M >= LEAST_M).map(|[x, y]| [x, y, z])
}

#[cfg(test)]
mod tests {
    use super::super::SemanticMap;
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
