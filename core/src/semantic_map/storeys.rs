//! The storeys of a map, and how they lie beside each other on a plan from above: one over the other, they would hide each other.

use super::{Box3, Item, SemanticMap, Space};

/// Floors that differ by more in height are of different storeys, in metres; a step into a sunken living room is none.
pub(crate) const STOREY_M: f64 = 1.5;
/// How far storeys are apart on a plan, as a share of the largest one's length, and at least, in metres: a line of text has room.
const APART: f64 = 0.08;
const APART_MIN_M: f64 = 1.0;

/// A storey on a plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Storey {
    /// The height of its lowest floor, in metres.
    pub floor_m: f64,
    /// What its rooms take up on the plan: west and south end, in metres.
    pub min_m: [f64; 2],
    /// East and north end.
    pub max_m: [f64; 2],
    /// How far it is moved from its place on the map.
    shift_m: [f64; 2],
}

impl Storey {
    /// What a plan of several storeys calls it: the map has no names for them.
    #[must_use]
    pub fn name(&self) -> String {
        format!("floor at {} m", (self.floor_m * 100.0).round() / 100.0 + 0.0)
    }
}

/// All storeys of a map, laid out side by side, or one above the other where that is nearer to a square; the lowest is first, in the west or in the
/// south. A map of one storey stays where it is.
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
        // The side of a square around all of them.
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

    /// The storey that something at this height is on: the highest one whose floor is not above it.
    #[must_use]
    pub fn at(&self, height_m: f64) -> usize {
        self.storeys.iter().rposition(|storey| storey.floor_m <= height_m).unwrap_or(0)
    }

    /// The storey of a room, a part or a group.
    #[must_use]
    pub fn of_space(&self, space: &Space) -> usize {
        self.at(space.bounds.min_m[2])
    }

    /// The storey of a thing: that of its room where it is in one. A rug may lie a little in the floor.
    #[must_use]
    pub fn of_item(&self, map: &SemanticMap, item: &Item) -> usize {
        let room = map.rooms_at(item.position_m).next().map(|room| &map.rooms()[room.0 as usize].space);
        room.map_or_else(|| self.at(item.position_m[2]), |space| self.of_space(space))
    }

    /// Where a place on a storey is on the plan.
    #[must_use]
    pub fn moved(&self, storey: usize, [east_m, north_m]: [f64; 2]) -> [f64; 2] {
        let [right_m, up_m] = self.storeys.get(storey).map_or([0.0; 2], |storey| storey.shift_m);
        [east_m + right_m, north_m + up_m]
    }

    /// The space as it lies on the plan.
    #[must_use]
    pub fn moved_space(&self, space: &Space) -> Space {
        let storey = self.of_space(space);
        let footprint = space.footprint.as_ref().map(|footprint| footprint.mapped(|place| self.moved(storey, place)));
        Space { bounds: self.moved_box(storey, &space.bounds), footprint }
    }

    /// A box on a storey as it lies on the plan.
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

    /// A map of boxes: west and south end, floor, and size on the floor.
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
        // A sunken living room is no storey of its own, nor is the hall half a storey up.
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
            // From the cellar to the top, apart from each other.
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
