//! The raster of a robot's map: pixels, their pieces, and the places where two segments meet.

use std::collections::BTreeMap;

use super::{Cell, Grid, MAX_PIXELS, Runs, fault};
use crate::semantic_map::import::ImportError;
use crate::semantic_map::schema::FARTHEST_M;

/// What a pixel belongs to.
pub(super) const FREE: u8 = 0;
pub(super) const WALL: u8 = u8::MAX;

/// The pixels of a rectangle: [`FREE`], [`WALL`] or the number of a segment, from 1.
pub(super) type Raster = Grid<u8>;

/// The pixels of layers; later layers cover earlier ones.
pub(super) fn raster(layers: &[(u8, Runs)], pixel_m: f64) -> Result<Raster, ImportError> {
    let all = || layers.iter().flat_map(|(_, runs)| runs).filter(|(_, count)| *count > 0);
    let (mut min, mut max) = ([i64::MAX; 2], [i64::MIN; 2]);
    for &([x, y], count) in all() {
        min = [min[0].min(x), min[1].min(y)];
        max = [max[0].max(x + count - 1), max[1].max(y)];
    }
    if min[0] > max[0] {
        return Err(ImportError::NoRooms { remedy: "the layers have no pixels; let the robot map the home first" });
    }
    // No map reaches farther, so that tracing it would be for nothing.
    if let Some(far) = min.into_iter().chain(max).find(|place| (*place as f64 * pixel_m).abs() > FARTHEST_M) {
        return Err(fault(format!("layers: has pixels at {far}, which lie farther than 10 km from the origin")));
    }
    let mut raster = Raster::filled(min, max, FREE, MAX_PIXELS).map_err(|[width, height]| {
        fault(format!("layers: the map is {width} x {height} pixels, more than {MAX_PIXELS} in all"))
    })?;
    for (mark, runs) in layers {
        for &([x, y], count) in runs {
            (x..x + count).for_each(|x| raster.put([x, y], *mark));
        }
    }
    Ok(raster)
}

impl Raster {
    pub(super) fn mark(&self, cell: Cell) -> u8 {
        self.get(cell).unwrap_or(FREE)
    }

    /// The pixels of segments, each with its mark.
    fn marked(&self) -> impl Iterator<Item = (Cell, u8)> {
        let marks = self.cells.iter().enumerate().filter(|(_, mark)| ![FREE, WALL].contains(mark));
        marks.map(|(place, mark)| (self.at(place), *mark))
    }

    /// Per segment its largest piece, and how many pixels it has in all.
    pub(super) fn largest_pieces(&self) -> BTreeMap<u8, (Vec<Cell>, usize)> {
        let mut seen = vec![false; self.cells.len()];
        let mut largest = BTreeMap::<u8, (Vec<Cell>, usize)>::new();
        for (start, mark) in self.marked() {
            let own = |cell| self.place(cell).filter(|place| self.cells[*place] == mark);
            let Some(piece) = piece(start, &mut seen, own) else { continue };
            let (best, count) = largest.entry(mark).or_default();
            *count += piece.len();
            if piece.len() > best.len() {
                *best = piece;
            }
        }
        largest
    }
}

/// The four neighbours of a pixel.
pub(super) fn beside([x, y]: Cell) -> [Cell; 4] {
    [[x + 1, y], [x - 1, y], [x, y + 1], [x, y - 1]]
}

/// The pixels of a room that can be reached from a pixel, side by side; empty if that pixel was seen before or has no room.
pub(super) fn piece(start: Cell, seen: &mut [bool], place_of: impl Fn(Cell) -> Option<usize>) -> Option<Vec<Cell>> {
    let mut take = |cell: Cell| place_of(cell).is_some_and(|place| !std::mem::replace(&mut seen[place], true));
    let mut piece = Vec::from_iter(take(start).then_some(start));
    let mut next = 0;
    while next < piece.len() {
        piece.extend(beside(piece[next]).into_iter().filter(|cell| take(*cell)));
        next += 1;
    }
    Some(piece).filter(|piece| !piece.is_empty())
}
/// Where segments lie side by side without a wall between: per two of them, the pixels there.
pub(super) fn contacts(raster: &Raster, gap: i64) -> BTreeMap<(u8, u8), Vec<Cell>> {
    let mut contacts: BTreeMap<(u8, u8), Vec<Cell>> = BTreeMap::new();
    for ([x, y], mark) in raster.marked() {
        for [right, down] in [[1, 0], [0, 1]] {
            for step in 1..=gap + 1 {
                match raster.mark([x + step * right, y + step * down]) {
                    FREE => {}
                    WALL => break,
                    other => {
                        if other != mark {
                            let pair = (mark.min(other), mark.max(other));
                            contacts.entry(pair).or_default().push([x + step * right / 2, y + step * down / 2]);
                        }
                        break;
                    }
                }
            }
        }
    }
    contacts
}

/// The largest cluster of pixels of a raster, its middle, and how far it reaches in pixels. `waiting` has a place for each of the raster's
/// pixels, none of them set, before and after.
pub(super) fn widest(raster: &Raster, mut cells: Vec<Cell>, waiting: &mut [bool]) -> Option<(Cell, i64)> {
    const NEAR: i64 = 2;
    cells.sort_unstable();
    let mut set =
        |cell: Cell, to: bool| raster.place(cell).is_some_and(|place| std::mem::replace(&mut waiting[place], to));
    for cell in &cells {
        set(*cell, true);
    }
    let mut best: Option<(Cell, i64)> = None;
    let mut cluster = Vec::new();
    for first in cells {
        if !set(first, false) {
            continue;
        }
        cluster.clear();
        cluster.push(first);
        let mut next = 0;
        while next < cluster.len() {
            let [x, y]: Cell = cluster[next];
            for near in (-NEAR..=NEAR).flat_map(|right| (-NEAR..=NEAR).map(move |down| [x + right, y + down])) {
                if set(near, false) {
                    cluster.push(near);
                }
            }
            next += 1;
        }
        let span = |axis: usize| {
            let values = || cluster.iter().map(|cell| cell[axis]);
            values().max().unwrap_or(0) - values().min().unwrap_or(0) + 1
        };
        let length = span(0).max(span(1));
        if best.is_none_or(|(_, longest)| length > longest) {
            let middle = [0, 1].map(|axis| cluster.iter().map(|cell| cell[axis]).sum::<i64>() / cluster.len() as i64);
            let nearest = |cell: &&Cell| (cell[0] - middle[0]).abs() + (cell[1] - middle[1]).abs();
            best = cluster.iter().min_by_key(nearest).map(|cell| (*cell, length));
        }
    }
    best
}
