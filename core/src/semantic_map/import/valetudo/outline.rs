//! Outlines of pixels: a room is the largest piece of its segment, without holes and narrow slits, simplified to a tolerance.

use std::collections::BTreeMap;

use super::raster::{FREE, Raster, WALL, beside, piece};
use super::{Cell, Grid, MAX_PIXELS, TOLERANCE_M};
use crate::semantic_map::footprint::{Footprint, MAX_CORNERS};
use crate::semantic_map::schema::Rings;

/// How often pixels that meet at a corner are looked for.
const JOINING_ROUNDS: usize = 64;
/// Most corners that are looked at to simplify them, over all tries. Only outlines of noise take more, and become boxes.
pub(super) const MAX_LOOKS: usize = 1 << 26;

/// A set of pixels with room around it.
type Mask = Grid<bool>;

impl Mask {
    /// A mask around the cells with free pixels on each side, unless that takes more than are left.
    fn around(cells: &[Cell], margin: i64, left: &mut usize) -> Option<Self> {
        let axis = |axis: usize| cells.iter().map(move |cell| cell[axis]);
        let min = [0, 1].map(|own| axis(own).min().unwrap_or(0) - margin);
        let max = [0, 1].map(|own| axis(own).max().unwrap_or(0) + margin);
        let mut mask = Self::filled(min, max, false, *left).ok()?;
        *left -= mask.cells.len();
        cells.iter().for_each(|cell| mask.put(*cell, true));
        Some(mask)
    }

    fn has(&self, cell: Cell) -> bool {
        self.get(cell).unwrap_or(false)
    }

    /// Fills the holes that are no part of the mask's margin, if they are `filled`.
    fn fill_holes(&mut self, filled: impl Fn(&[Cell]) -> bool) {
        let corner = self.min;
        for hole in self.holes().collect::<Vec<_>>() {
            if !hole.contains(&corner) && filled(&hole) {
                hole.into_iter().for_each(|cell| self.put(cell, true));
            }
        }
    }

    /// Pieces of the pixels that are not set.
    fn holes(&self) -> impl Iterator<Item = Vec<Cell>> {
        let mut seen = self.cells.clone();
        (0..seen.len()).filter_map(move |start| {
            let is_free = |cell| self.place(cell).filter(|place| !self.cells[*place]);
            piece(self.at(start), &mut seen, is_free)
        })
    }

    /// For every pixel whether one within `reach` along an axis is set, or, with `all`, whether all are. Beyond the mask none is.
    fn spread(&self, axis: usize, reach: usize, all: bool) -> Vec<bool> {
        let [width, height] = self.size;
        let (lines, count, line_step, step) =
            if axis == 0 { (height, width, width, 1) } else { (width, height, 1, width) };
        // Whether one that decides is near: one that is set or, with `all`, one that is not.
        let mut near = vec![false; self.cells.len()];
        for line in 0..lines {
            for back in [false, true] {
                // How many pixels ago one that decides was.
                let mut since = if all { 0 } else { reach };
                for index in 0..count {
                    let place = line * line_step + step * if back { count - 1 - index } else { index };
                    since = if self.cells[place] != all { 0 } else { since + 1 };
                    near[place] |= since <= reach;
                }
            }
        }
        near.into_iter().map(|near| near != all).collect()
    }

    /// Pixels that are free in slits no wider than twice the reach: set after all were spread and drawn in again.
    fn slits(&self, reach: usize) -> Vec<Cell> {
        let mut closed = Self { cells: self.cells.clone(), ..*self };
        for all in [false, true] {
            for axis in [0, 1] {
                closed.cells = closed.spread(axis, reach, all);
            }
        }
        let is_slit = |place: &usize| closed.cells[*place] && !self.cells[*place];
        (0..self.cells.len()).filter(is_slit).map(|place| self.at(place)).collect()
    }

    /// Fills one of the free pixels wherever two pixels meet at a corner only, so that no outline touches itself.
    fn join_corners(&mut self) {
        // A filled pixel can meet another at its corner; more rounds than a map of rooms needs make a raster of noise a box.
        // After the first round, only where something was filled.
        let mut looked_at = vec![false; self.cells.len()];
        for _ in 0..JOINING_ROUNDS {
            let mut filled = false;
            for place in 0..self.cells.len() {
                if std::mem::replace(&mut looked_at[place], true) {
                    continue;
                }
                let [x, y] = self.at(place);
                let [a, b, c, d] = [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]].map(|cell| self.has(cell));
                let [x, y] = match (a && d && !b && !c, b && c && !a && !d) {
                    (true, _) => [x + 1, y],
                    (_, true) => [x, y],
                    _ => continue,
                };
                self.put([x, y], true);
                filled = true;
                for near in [[x, y], [x - 1, y], [x, y - 1], [x - 1, y - 1]] {
                    if let Some(near) = self.place(near) {
                        looked_at[near] = false;
                    }
                }
            }
            if !filled {
                return;
            }
        }
    }

    /// The outlines between pixels that are set and others, corners only.
    fn outlines(&self) -> Vec<Vec<Cell>> {
        let mut next: BTreeMap<Cell, Cell> = BTreeMap::new();
        for (place, _) in self.cells.iter().enumerate().filter(|(_, set)| **set) {
            let [x, y] = self.at(place);
            let [right, left, below, above] = beside([x, y]).map(|cell| self.has(cell));
            // Around the pixel, one way.
            let sides = [
                (above, [x, y], [x + 1, y]),
                (right, [x + 1, y], [x + 1, y + 1]),
                (below, [x + 1, y + 1], [x, y + 1]),
                (left, [x, y + 1], [x, y]),
            ];
            next.extend(sides.into_iter().filter(|(joined, ..)| !joined).map(|(_, from, to)| (from, to)));
        }
        let mut outlines = Vec::new();
        while let Some((start, mut at)) = next.pop_first() {
            let mut ring = vec![start];
            while at != start {
                let Some(to) = next.remove(&at) else { break };
                ring.push(at);
                at = to;
            }
            let count = ring.len();
            let straight = |index: usize| {
                let (before, here, after) = (ring[(index + count - 1) % count], ring[index], ring[(index + 1) % count]);
                (before[0] == here[0] && here[0] == after[0]) || (before[1] == here[1] && here[1] == after[1])
            };
            outlines.push((0..count).filter(|index| !straight(*index)).map(|index| ring[index]).collect());
        }
        outlines
    }
}

/// The corners that an outline needs to stay within the tolerance (Douglas and Peucker's). None where more are looked at than are left.
fn simplified(ring: &[[f64; 2]], tolerance_m: f64, left: &mut usize) -> Option<Vec<[f64; 2]>> {
    let count = ring.len();
    let apart = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let far = (0..count).max_by(|&a, &b| apart(ring[0], ring[a]).total_cmp(&apart(ring[0], ring[b]))).unwrap_or(0);
    let mut kept = vec![false; count];
    (kept[0], kept[far]) = (true, true);
    let mut stretches = vec![(0, far), (far, count)];
    while let Some((from, to)) = stretches.pop() {
        let rest = left.checked_sub(to - from);
        // Without a rest, nothing shorter is tried either.
        *left = rest.unwrap_or(0);
        rest?;
        let (a, b) = (ring[from], ring[to % count]);
        let length = apart(a, b);
        let off = |index: usize| {
            let [px, py] = [ring[index][0] - a[0], ring[index][1] - a[1]];
            if length > 0.0 { ((b[0] - a[0]) * py - (b[1] - a[1]) * px).abs() / length } else { px.hypot(py) }
        };
        let Some(worst) = (from + 1..to).max_by(|&a, &b| off(a).total_cmp(&off(b))) else { continue };
        if off(worst) > tolerance_m {
            kept[worst] = true;
            stretches.extend([(from, worst), (worst, to)]);
        }
    }
    Some((0..count).filter(|index| kept[*index]).map(|index| ring[index]).collect())
}

/// To a tenth of a millimetre.
pub(super) fn tidy(metres: f64) -> f64 {
    (metres * 1e4).round() / 1e4
}

/// The outlines of a room, and the share of its pixels that lies apart from them; `None` for a room without pixels.
pub(super) type Traced = Option<(Vec<Vec<Cell>>, f64)>;

/// The rooms' outlines in metres, each a footprint as simple as the tolerance allows, or `None` if it is no footprint. None at all where
/// the map has too many corners then, or where more are looked at than are left.
pub(super) fn footprints(
    traced: &[Traced],
    pixel_m: f64,
    tolerance_m: f64,
    left: &mut usize,
) -> Option<Vec<Option<Rings>>> {
    let metres = |ring: &Vec<Cell>| -> Vec<[f64; 2]> {
        ring.iter().map(|&[x, y]| [x as f64 * pixel_m, -y as f64 * pixel_m]).collect()
    };
    let mut corners = MAX_CORNERS;
    let mut footprint = |outlines: &[Vec<Cell>]| -> Option<Option<Rings>> {
        let rings: Rings = outlines.iter().map(metres).collect();
        for part in [1.0, 0.5, 0.25, 0.0] {
            let simple = rings.iter().map(|ring| simplified(ring, part * tolerance_m, left));
            let simple: Rings = simple.collect::<Option<_>>()?;
            let rest = corners.checked_sub(simple.iter().map(Vec::len).sum())?;
            if let Ok(footprint) = Footprint::new(&simple) {
                corners = rest;
                let tidy = |ring: &Vec<[f64; 2]>| ring.iter().map(|corner| corner.map(tidy)).collect();
                return Some(Some(footprint.rings().iter().map(tidy).collect()));
            }
        }
        Some(None)
    };
    traced.iter().map(|traced| traced.as_ref().map_or(Some(None), |(outlines, _)| footprint(outlines))).collect()
}

/// The outlines of a segment: of its largest piece, with slits closed, the outer one first, with holes only where other segments lie in it.
/// None where a rectangle around it has more pixels than are left.
pub(super) fn outlines(
    raster: &Raster,
    mark: u8,
    largest: &[Cell],
    reach: usize,
    left: &mut usize,
) -> Option<Vec<Vec<Cell>>> {
    let mut mask = Mask::around(largest, 2 * reach as i64 + 1, left)?;
    let is_of_others = |cell: &Cell| ![FREE, WALL, mark].contains(&raster.mark(*cell));
    mask.slits(reach).into_iter().filter(|cell| !is_of_others(cell)).for_each(|cell| mask.put(cell, true));
    mask.fill_holes(|hole| hole.iter().filter(|cell| is_of_others(cell)).count() * 2 <= hole.len());
    mask.join_corners();
    let mut rings = mask.outlines();
    // The outer one reaches farthest to the left; holes lie within it.
    let outer = (0..rings.len()).min_by_key(|ring| rings[*ring].iter().map(|corner| corner[0]).min())?;
    rings.swap(0, outer);
    Some(rings)
}

/// The outline of the largest piece of the cells, without holes, in metres, with y upwards; `None` if the cells are no area with an outline.
pub(in crate::semantic_map::import) fn outline(cells: &[Cell], cell_m: f64) -> Option<Rings> {
    let mut left = MAX_PIXELS;
    let mask = Mask::around(cells, 0, &mut left)?;
    let mut seen = vec![false; mask.cells.len()];
    let set = |cell| mask.place(cell).filter(|place| mask.cells[*place]);
    let largest = cells.iter().filter_map(|cell| piece(*cell, &mut seen, set)).max_by_key(Vec::len)?;
    // A line of cells is a polygon that was drawn on a grid.
    let inner = largest.iter().filter(|cell| beside(**cell).into_iter().all(|near| mask.has(near))).count();
    if inner * 4 < largest.len() {
        return None;
    }
    let mut mask = Mask::around(&largest, 1, &mut left)?;
    mask.fill_holes(|_| true);
    mask.join_corners();
    let outer = mask.outlines().into_iter().max_by_key(Vec::len)?;
    let mut looks = MAX_LOOKS;
    footprints(&[Some((vec![outer], 0.0))], cell_m, TOLERANCE_M, &mut looks)?.pop().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_is_looked_at_to_simplify_outlines_is_bounded() {
        // Teeth that become shorter: each stretch is divided at its end.
        let worst: Vec<[f64; 2]> =
            (0..4_000).map(|at| [at as f64, 4e4 * (at % 2) as f64 / (1.0 + at as f64)]).collect();
        let mut left = MAX_LOOKS;
        assert!(simplified(&worst, 1e-3, &mut left).is_some());
        let looked = MAX_LOOKS - left;
        assert!(looked > 1_000_000, "{looked}");
        let mut left = looked - 1;
        assert_eq!((simplified(&worst, 1e-3, &mut left), left), (None, 0));
        assert_eq!((simplified(&worst, 1e-3, &mut left), left), (None, 0), "nor is anything else looked at");
        // A real outline takes little of it.
        let mut left = MAX_LOOKS;
        let traced = |rows: usize| {
            let ring: Vec<Cell> = (0..rows as i64).flat_map(|row| [[row % 2, row], [row % 2, row + 1]]).collect();
            Some((vec![[vec![[-9, 0]], ring, vec![[-9, rows as i64]]].concat()], 0.0))
        };
        assert!(footprints(&[traced(1_000)], 0.05, 0.1, &mut left).unwrap()[0].is_some());
        assert!(MAX_LOOKS - left < 1_000_000, "{left}");
        // More corners than a map may have; then no steps are left.
        assert_eq!(footprints(&[traced(5_000), traced(5_000)], 0.3, 0.1, &mut left), None);
        assert_eq!(footprints(&[traced(1_000)], 0.05, 0.1, &mut 1_000), None);
    }

    proptest! {
        /// Pixel by pixel, as the words have it.
        #[test]
        fn spreading_looks_along_an_axis(cells in prop::collection::vec(any::<bool>(), 9 * 7), reach in 0..4usize, axis in 0..2usize, all: bool) {
            let mask = Mask { min: [-2, 5], size: [9, 7], cells };
            let step = |at: Cell, by: i64| if axis == 0 { [at[0] + by, at[1]] } else { [at[0], at[1] + by] };
            let decide = |place: usize| {
                let reach = reach as i64;
                let mut around = (-reach..=reach).map(|by| mask.has(step(mask.at(place), by)));
                if all { around.all(|set| set) } else { around.any(|set| set) }
            };
            prop_assert_eq!(mask.spread(axis, reach, all), (0..mask.cells.len()).map(decide).collect::<Vec<_>>());
        }

        /// As if each round looked at every pixel.
        #[test]
        fn joining_leaves_no_corner(cells in prop::collection::vec(any::<bool>(), 12 * 12)) {
            let mut mask = Mask { min: [0, 0], size: [12, 12], cells };
            let mut every = Mask { min: mask.min, size: mask.size, cells: mask.cells.clone() };
            mask.join_corners();
            loop {
                let before = every.cells.clone();
                for place in 0..every.cells.len() {
                    let [x, y] = every.at(place);
                    let [a, b, c, d] = [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]].map(|cell| every.has(cell));
                    if a && d && !b && !c {
                        every.put([x + 1, y], true);
                    } else if b && c && !a && !d {
                        every.put([x, y], true);
                    }
                }
                if every.cells == before {
                    break;
                }
            }
            prop_assert_eq!(mask.cells, every.cells);
        }
    }
}
