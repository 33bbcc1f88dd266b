//! The rooms as markers for RViz and Foxglove.

use roomcast_core::grounding::Partition;

use crate::types::{ColorRgba, Header, Marker, MarkerArray, Point, Pose, Quaternion};

/// Each room's outline and its name with a probability. A higher probability makes it redder.
#[must_use]
pub fn markers(rooms: &[(&Partition, f64)], header: &Header) -> MarkerArray {
    let mut markers = Vec::new();
    for (room, probability) in rooms {
        let share = probability.clamp(0.0, 1.0) as f32;
        let color = ColorRgba { r: share, g: 1.0 - share, b: 0.2, a: 0.9 };
        let mut add = |kind: i32, marker: Marker| {
            let id = i32::try_from(markers.len()).unwrap_or(i32::MAX);
            let ns = "rooms".to_owned();
            markers.push(Marker { header: header.clone(), ns, id, r#type: kind, color, ..marker });
        };
        for ring in room.spaces.iter().flat_map(|space| space.rings()) {
            let corner = |corner: &[f64; 2]| Point { x: corner[0], y: corner[1], z: 0.02 };
            let points = ring.iter().chain(ring.first()).map(corner).collect();
            add(4, Marker { scale: Point { x: 0.05, y: 0.0, z: 0.0 }, points, ..Marker::default() });
        }
        if let Some(space) = room.spaces.first() {
            let [x, y, _] = space.centre_m();
            let pose = Pose { position: Point { x, y, z: 0.3 }, orientation: Quaternion::default() };
            let text = format!("{} {:.0} %", room.label, probability * 100.0);
            add(9, Marker { pose, scale: Point { x: 0.0, y: 0.0, z: 0.3 }, text, ..Marker::default() });
        }
    }
    MarkerArray { markers }
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::{PartitionLevel, partitions};
    use roomcast_core::semantic_map::SemanticMap;

    use super::*;

    #[test]
    fn a_room_is_a_closed_line_and_a_name_with_its_probability() {
        let map = SemanticMap::from_json(include_str!("../../tests/data/two_rooms.json")).unwrap();
        let rooms = partitions(&map, PartitionLevel::Room);
        let shown: Vec<_> = rooms.iter().zip([0.75, 2.0]).collect();
        let drawn = markers(&shown, &Header::of_unix_ns(1_500_000_000, "map")).markers;
        let [line, name, ..] = drawn.as_slice() else { panic!("{drawn:?}") };
        assert_eq!((line.r#type, line.points.first()), (4, line.points.last()));
        assert_eq!((name.r#type, name.text.as_str()), (9, format!("{} 75 %", rooms[0].label).as_str()));
        assert_eq!((name.header.stamp.sec, name.header.stamp.nanosec), (1, 500_000_000));
        assert!(drawn.iter().zip(0..).all(|(marker, id)| marker.id == id));
        assert!((0.0..=1.0).contains(&drawn[3].color.g), "what is no probability is no other colour");
    }
}
