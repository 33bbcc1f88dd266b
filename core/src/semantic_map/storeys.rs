//! The storeys of a map, and their layout next to each other on a plan from above.

use super::{Box3, Item, SemanticMap, Space};

/// Least height between the floors of two storeys, in metres. A step into a sunken living room is lower.
pub(crate) const STOREY_M: f64 = 1.5;
/// Gap between storeys on a plan, as a share of the largest one's length; and the least gap in metres, enough for a line of text.
const APART: f64 = 0.08;
const APART_MIN_M: f64 = 1.0;

/// A storey on a plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Storey {
    /// Height of its lowest floor, in metres.
    pub floor_m: f64,
    /// West and south end of its rooms on the plan, in metres.
    pub min_m: [f64; 2],
    /// East and north end, in metres.
    pub max_m: [f64; 2],
    /// Offset from the map to the plan, in metres.
    shift_m: [f64; 2],
}

impl Storey {
    /// Name for plans: the map has no names for storeys.
    #[must_use]
    pub fn name(&self) -> String {
        format!("floor at {} m", (self.floor_m * 100.0).round() / 100.0 + 0.0)
    }
}

/// All storeys of a map, laid out from west to east or from south to north, by the shape closer to a square. The lowest comes first. A map of one
/// storey is not moved.
#[derive(Debug, Clone, PartialEq)]
pub struct Storeys {
    storeys: Vec<Storey>,
}

impl Storeys {
    /// The storeys of a map, by the heights of its rooms' floors.
    #[must_use]
    pub fn of(map: &SemanticMap) -> Self {
        let mut bounds: Vec<Box3> = map.rooms().iter().map(|room| room.space.bounds).collect();
        bounds.sort_by(|a, b| a.min_m[2].total_cmp(&b.min_m[2]));
        let mut storeys: Vec<Storey> = Vec::new();
        for Box3 { min_m, max_m } in bounds {
            let ([west, south, floor_m], [east, north, _]) = (min_m, max_m);
            let Some(last) = storeys.last_mut().filter(|last| floor_m - last.floor_m <= STOREY_M) else {
                let (min_m, max_m) = ([west, south], [east, north]);
                storeys.push(Storey { floor_m, min_m, max_m, shift_m: [0.0; 2] });
                continue;
            };
            last.min_m = [last.min_m[0].min(west), last.min_m[1].min(south)];
            last.max_m = [last.max_m[0].max(east), last.max_m[1].max(north)];
        }
        let mut own = Self { storeys };
        own.lay_out();
        own
    }

    fn lay_out(&mut self) {
        let size_m = |storey: &Storey, axis: usize| storey.max_m[axis] - storey.min_m[axis];
        let sum_m = |axis: usize| self.storeys.iter().map(|storey| size_m(storey, axis)).sum::<f64>();
        let most_m = |axis: usize| self.storeys.iter().map(|storey| size_m(storey, axis)).fold(0.0, f64::max);
        // Compare the sides of the enclosing squares.
        let along = usize::from(sum_m(1).max(most_m(0)) < sum_m(0).max(most_m(1)));
        let apart_m = (APART * most_m(0).max(most_m(1))).max(APART_MIN_M);
        for next in 1..self.storeys.len() {
            let shift_m = self.storeys[next - 1].max_m[along] + apart_m - self.storeys[next].min_m[along];
            let Storey { min_m, max_m, shift_m: own, .. } = &mut self.storeys[next];
            for place in [&mut min_m[along], &mut max_m[along], &mut own[along]] {
                *place += shift_m;
            }
        }
    }

    /// The storeys, the lowest first.
    #[must_use]
    pub fn all(&self) -> &[Storey] {
        &self.storeys
    }

    /// The storey at a height in metres: the highest with a floor at or below it.
    #[must_use]
    pub fn at(&self, height_m: f64) -> usize {
        self.storeys.iter().rposition(|storey| storey.floor_m <= height_m).unwrap_or(0)
    }

    /// The storey of a room, a part or a group.
    #[must_use]
    pub fn of_space(&self, space: &Space) -> usize {
        self.at(space.bounds.min_m[2])
    }

    /// The storey of an item's room, or by the item's height outside all rooms. A rug may be slightly below the floor.
    #[must_use]
    pub fn of_item(&self, map: &SemanticMap, item: &Item) -> usize {
        let room = map.rooms_at(item.position_m).next().map(|room| &map.rooms()[room.0 as usize].space);
        room.map_or_else(|| self.at(item.position_m[2]), |space| self.of_space(space))
    }

    /// The plan position of a map position on a storey, in metres.
    #[must_use]
    pub fn moved(&self, storey: usize, [east_m, north_m]: [f64; 2]) -> [f64; 2] {
        let [right_m, up_m] = self.storeys.get(storey).map_or([0.0; 2], |storey| storey.shift_m);
        [east_m + right_m, north_m + up_m]
    }

    /// The space at its position on the plan.
    #[must_use]
    pub fn moved_space(&self, space: &Space) -> Space {
        let storey = self.of_space(space);
        let footprint = space.footprint.as_ref().map(|footprint| footprint.mapped(|place| self.moved(storey, place)));
        Space { bounds: self.moved_box(storey, &space.bounds), footprint }
    }

    /// A box on a storey, at its position on the plan.
    #[must_use]
    pub fn moved_box(&self, storey: usize, bounds: &Box3) -> Box3 {
        let corner = |[east_m, north_m, height_m]: [f64; 3]| {
            let [east_m, north_m] = self.moved(storey, [east_m, north_m]);
            [east_m, north_m, height_m]
        };
        Box3 { min_m: corner(bounds.min_m), max_m: corner(bounds.max_m) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A map of boxes: west and south end with floor height, and size on the floor.
    fn map(rooms: &[([f64; 3], [f64; 2])]) -> SemanticMap {
        let room = |(index, (min_m, size_m)): (usize, &([f64; 3], [f64; 2]))| {
            let max_m = [min_m[0] + size_m[0], min_m[1] + size_m[1], min_m[2] + 2.5];
            serde_json::json!({"id": format!("room-{index}"), "label": "room", "box": {"min_m": min_m, "max_m": max_m}})
        };
        let rooms: Vec<_> = rooms.iter().enumerate().map(room).collect();
        let text = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "home", "rooms": rooms, "doors": [], "items": [
            {"id": "lamp", "label": "lamp", "position_m": [0.5, 0.5, 2.4], "box": {"min_m": [0.4, 0.4, 2.3], "max_m": [0.6, 0.6, 2.5]}}]});
        SemanticMap::from_json(&text.to_string()).unwrap()
    }

    fn places(map: &SemanticMap) -> (Storeys, Vec<Space>) {
        let storeys = Storeys::of(map);
        let spaces = map.rooms().iter().map(|room| storeys.moved_space(&room.space)).collect();
        (storeys, spaces)
    }

    #[test]
    fn one_storey_stays_where_it_is() {
        // A sunken living room is not a storey, nor is a hall half a storey up.
        let map = map(&[([0.0, 0.0, 0.0], [4.0, 4.0]), ([4.0, 0.0, -0.4], [4.0, 4.0]), ([8.0, 0.0, 1.0], [4.0, 4.0])]);
        let (storeys, spaces) = places(&map);
        assert_eq!(storeys.all().len(), 1);
        assert!(map.rooms().iter().map(|room| &room.space).eq(&spaces));
    }

    #[test]
    fn storeys_lie_beside_each_other_and_each_keeps_its_shape() {
        for (size_m, along) in [([4.0, 6.0], 0), ([12.0, 4.0], 1)] {
            let map = map(&[([0.0, 0.0, 3.0], size_m), ([0.0, 0.0, 0.0], size_m), ([1.0, 0.0, -2.6], size_m)]);
            let (storeys, spaces) = places(&map);
            let names: Vec<String> = storeys.all().iter().map(Storey::name).collect();
            assert_eq!(names, ["floor at -2.6 m", "floor at 0 m", "floor at 3 m"]);
            for (index, space) in spaces.iter().enumerate() {
                let before = map.rooms()[index].space.size_m();
                assert!(space.size_m().iter().zip(before).all(|(now, before)| (now - before).abs() < 1e-9));
                let across = 1 - along;
                assert_eq!(
                    space.bounds.min_m[across],
                    map.rooms()[index].space.bounds.min_m[across],
                    "none is moved across"
                );
            }
            // From the cellar to the top, without overlap.
            for (lower, upper) in [(2, 1), (1, 0)] {
                let apart_m = spaces[upper].bounds.min_m[along] - spaces[lower].bounds.max_m[along];
                assert!(apart_m >= 0.96, "{apart_m}");
            }
        }
    }

    #[test]
    fn a_thing_is_where_its_room_is() {
        let map = map(&[([0.0, 0.0, 0.0], [4.0, 4.0]), ([0.0, 0.0, 2.6], [4.0, 4.0])]);
        let storeys = Storeys::of(&map);
        assert_eq!(storeys.of_item(&map, &map.items()[0]), 0, "the lamp hangs below");
        let at = |height_m| Item { position_m: [9.0, 9.0, height_m], ..map.items()[0].clone() };
        assert_eq!([-1.0, 2.0, 2.7].map(|height_m| storeys.of_item(&map, &at(height_m))), [0, 0, 1]);
    }
}
