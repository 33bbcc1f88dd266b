//! A vacuum robot's map as Valetudo exports it: segments become rooms with their outlines.
//!
//! The map is a raster. A room is the largest piece of its segment, without the holes that furniture leaves in it and without slits
//! narrower than twice [`TOLERANCE_M`]. Its outline follows the pixels' edges, simplified to the same tolerance. A door is where two segments lie side by side and no wall between them.
//!
//! The frame is the robot's own, in metres, with y turned, so that the plan is not its mirror image: x is Valetudo's x / 100, y its
//! -y / 100.

use std::collections::{BTreeMap, HashMap};

use serde::Deserialize;
use serde_json::Value;

use super::{Ids, ImportError, Imported, parse, room_aliases, room_label, room_words};
use crate::names::Names;
use crate::parsing::toml_says;
use crate::semantic_map::footprint::{Footprint, MAX_CORNERS};
use crate::semantic_map::schema::{
    DoorEntry, FARTHEST_M, FORMAT, ItemEntry, ROOM_HEIGHT_M, Rings, RoomEntry, SceneFile, VERSION,
};
use crate::semantic_map::{Box3, MAX_ROOMS, SemanticMap};

const EXPECTED: &str = "a map as Valetudo exports it: `pixelSize` and `layers`";
/// Most pixels of a robot's map, and of the rectangle around it.
pub const MAX_PIXELS: usize = 4_000_000;
/// Most pixels of the rectangles around all rooms: rooms of a home lie side by side, and hardly in one another's rectangle.
pub const MAX_ROOM_PIXELS: usize = 4 * MAX_PIXELS;
/// How far a room's outline may lie from its pixels, in metres.
pub(crate) const TOLERANCE_M: f64 = 0.1;
/// Most corners of all outlines before they are simplified.
const MAX_STEPS: usize = 50_000;
/// Most corners that are looked at to simplify them, over all tries. Only outlines of noise take more, and become boxes.
const MAX_LOOKS: usize = 1 << 26;
/// How often pixels that meet at a corner are looked for.
const JOINING_ROUNDS: usize = 64;
/// How far slits are looked for, in pixels.
const MAX_REACH: usize = 8;
/// Pixels farther from the origin than this are none.
const FARTHEST: i64 = 1_000_000;
/// How far two segments may lie apart at a door, in metres: robots leave a strip between them.
const GAP_M: f64 = 0.15;
/// The narrowest door, in metres.
const DOOR_M: f64 = 0.4;
/// Width and height of a charging station, in metres.
const CHARGER_M: [f64; 2] = [0.3, 0.1];
/// What the robot's charger is called.
pub(super) const CHARGER: &str = "charging station";
/// The name of the one room of a map without segments.
const HOME: &str = "home";

#[derive(Deserialize)]
struct File {
    #[serde(rename = "pixelSize")]
    pixel_size_cm: f64,
    layers: Vec<Layer>,
    #[serde(default)]
    entities: Vec<Entity>,
}

#[derive(Deserialize)]
struct Layer {
    r#type: String,
    #[serde(default, rename = "metaData")]
    about: About,
    /// x, y, x, y, ...
    #[serde(default)]
    pixels: Vec<i64>,
    /// x, y, how many to the right, ...
    #[serde(default, rename = "compressedPixels")]
    runs: Vec<i64>,
}

#[derive(Default, Deserialize)]
struct About {
    #[serde(default, rename = "segmentId")]
    segment: Value,
    #[serde(default)]
    name: Value,
}

#[derive(Deserialize)]
struct Entity {
    r#type: String,
    /// Numbers; what else may stand there is no concern of an import.
    #[serde(default)]
    points: Value,
}

/// A place on the raster, or a corner between its pixels.
type Cell = [i64; 2];

/// Runs of pixels: where each begins, and how many there are.
type Runs = Vec<(Cell, i64)>;

impl Layer {
    fn runs(&self, index: usize, left: &mut usize) -> Result<Runs, ImportError> {
        let fault =
            |message: String| ImportError::Json { element: format!("layers[{index}]"), message, expected: EXPECTED };
        if !self.pixels.len().is_multiple_of(2) || !self.runs.len().is_multiple_of(3) {
            let message = "pixels are pairs of numbers, compressedPixels triples".to_owned();
            return Err(fault(message));
        }
        let single = self.pixels.chunks_exact(2).map(|pixel| ([pixel[0], pixel[1]], 1));
        let runs = single.chain(self.runs.chunks_exact(3).map(|run| ([run[0], run[1]], run[2])));
        runs.map(|(at, count)| {
            let near = at.iter().all(|place| (-FARTHEST..=FARTHEST).contains(place));
            let count = usize::try_from(count).ok().filter(|count| near && *count <= MAX_PIXELS);
            let rest = count.and_then(|count| left.checked_sub(count).map(|rest| (rest, count)));
            let Some((rest, count)) = rest else {
                return Err(fault(format!(
                    "has a run at {at:?} that lies too far out, or more than {MAX_PIXELS} pixels"
                )));
            };
            *left = rest;
            // Not more than MAX_PIXELS.
            Ok((at, count as i64))
        })
        .collect()
    }
}

/// What a pixel belongs to.
const FREE: u8 = 0;
const WALL: u8 = u8::MAX;

/// The pixels of a rectangle: [`FREE`], [`WALL`] or the number of a segment, from 1.
struct Raster {
    min: Cell,
    size: [usize; 2],
    cells: Vec<u8>,
}

impl Raster {
    fn new(layers: &[(u8, Runs)], pixel_m: f64) -> Result<Self, ImportError> {
        let fault = |message: String| ImportError::Json { element: "layers".to_owned(), message, expected: EXPECTED };
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
            return Err(fault(format!("has pixels at {far}, which lie farther than 10 km from the origin")));
        }
        let size = [0, 1].map(|axis| usize::try_from(max[axis] - min[axis] + 1).unwrap_or(usize::MAX));
        let count = size[0].checked_mul(size[1]).filter(|count| *count <= MAX_PIXELS).ok_or_else(|| {
            fault(format!("the map is {} x {} pixels, more than {MAX_PIXELS} in all", size[0], size[1]))
        })?;
        let mut raster = Self { min, size, cells: vec![FREE; count] };
        for (mark, runs) in layers {
            for &([x, y], count) in runs {
                for x in x..x + count {
                    if let Some(place) = raster.place([x, y]) {
                        raster.cells[place] = *mark;
                    }
                }
            }
        }
        Ok(raster)
    }

    fn place(&self, [x, y]: Cell) -> Option<usize> {
        let column = usize::try_from(x - self.min[0]).ok().filter(|column| *column < self.size[0])?;
        let row = usize::try_from(y - self.min[1]).ok().filter(|row| *row < self.size[1])?;
        Some(row * self.size[0] + column)
    }

    fn get(&self, cell: Cell) -> u8 {
        self.place(cell).map_or(FREE, |place| self.cells[place])
    }

    /// Per segment its largest piece, and how many pixels it has in all.
    fn largest_pieces(&self) -> BTreeMap<u8, (Vec<Cell>, usize)> {
        let mut seen = vec![false; self.cells.len()];
        let mut largest = BTreeMap::<u8, (Vec<Cell>, usize)>::new();
        for (start, mark) in self.cells().filter(|(_, mark)| ![FREE, WALL].contains(mark)) {
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

    fn cells(&self) -> impl Iterator<Item = (Cell, u8)> {
        let [x, y] = self.min;
        let at = move |place: usize| [x + (place % self.size[0]) as i64, y + (place / self.size[0]) as i64];
        self.cells.iter().enumerate().map(move |(place, mark)| (at(place), *mark))
    }
}

/// The four neighbours of a pixel.
fn beside([x, y]: Cell) -> [Cell; 4] {
    [[x + 1, y], [x - 1, y], [x, y + 1], [x, y - 1]]
}

/// The pixels of a room that can be reached from a pixel, side by side; empty if that pixel was seen before or has no room.
fn piece(start: Cell, seen: &mut [bool], place_of: impl Fn(Cell) -> Option<usize>) -> Option<Vec<Cell>> {
    let mut take = |cell: Cell| place_of(cell).is_some_and(|place| !std::mem::replace(&mut seen[place], true));
    let mut piece = Vec::from_iter(take(start).then_some(start));
    let mut next = 0;
    while next < piece.len() {
        piece.extend(beside(piece[next]).into_iter().filter(|cell| take(*cell)));
        next += 1;
    }
    Some(piece).filter(|piece| !piece.is_empty())
}

/// A set of pixels with room around it.
struct Mask {
    min: Cell,
    size: [usize; 2],
    set: Vec<bool>,
}

impl Mask {
    /// A mask around the cells with free pixels on each side, unless that takes more than are left.
    fn around(cells: &[Cell], margin: i64, left: &mut usize) -> Option<Self> {
        let bound = |axis: usize, most: bool| {
            let values = cells.iter().map(|cell| cell[axis]);
            if most { values.max() } else { values.min() }.unwrap_or(0)
        };
        let min = [bound(0, false) - margin, bound(1, false) - margin];
        let size = [0, 1].map(|axis| usize::try_from(bound(axis, true) + 1 + margin - min[axis]).unwrap_or(0));
        *left = left.checked_sub(size[0] * size[1])?;
        let mut mask = Self { min, size, set: vec![false; size[0] * size[1]] };
        cells.iter().for_each(|cell| mask.put(*cell));
        Some(mask)
    }

    fn place(&self, [x, y]: Cell) -> Option<usize> {
        let column = usize::try_from(x - self.min[0]).ok().filter(|column| *column < self.size[0])?;
        let row = usize::try_from(y - self.min[1]).ok().filter(|row| *row < self.size[1])?;
        Some(row * self.size[0] + column)
    }

    fn at(&self, place: usize) -> Cell {
        [self.min[0] + (place % self.size[0]) as i64, self.min[1] + (place / self.size[0]) as i64]
    }

    fn has(&self, cell: Cell) -> bool {
        self.place(cell).is_some_and(|place| self.set[place])
    }

    fn put(&mut self, cell: Cell) {
        if let Some(place) = self.place(cell) {
            self.set[place] = true;
        }
    }

    /// Pieces of the pixels that are not set.
    fn holes(&self) -> impl Iterator<Item = Vec<Cell>> {
        let mut seen = self.set.clone();
        (0..seen.len()).filter_map(move |start| {
            let is_free = |cell| self.place(cell).filter(|place| !self.set[*place]);
            piece(self.at(start), &mut seen, is_free)
        })
    }

    /// For every pixel whether one within `reach` along an axis is set, or, with `all`, whether all are. Beyond the mask none is.
    fn spread(&self, axis: usize, reach: usize, all: bool) -> Vec<bool> {
        let [width, height] = self.size;
        let (lines, count, line_step, step) =
            if axis == 0 { (height, width, width, 1) } else { (width, height, 1, width) };
        // Whether one that decides is near: one that is set or, with `all`, one that is not.
        let mut near = vec![false; self.set.len()];
        for line in 0..lines {
            for back in [false, true] {
                // How many pixels ago one that decides was.
                let mut since = if all { 0 } else { reach };
                for index in 0..count {
                    let place = line * line_step + step * if back { count - 1 - index } else { index };
                    since = if self.set[place] != all { 0 } else { since + 1 };
                    near[place] |= since <= reach;
                }
            }
        }
        near.into_iter().map(|near| near != all).collect()
    }

    /// Pixels that are free in slits no wider than twice the reach: set after all were spread and drawn in again.
    fn slits(&self, reach: usize) -> Vec<Cell> {
        let mut closed = Self { min: self.min, size: self.size, set: self.set.clone() };
        for all in [false, true] {
            for axis in [0, 1] {
                closed.set = closed.spread(axis, reach, all);
            }
        }
        (0..self.set.len())
            .filter(|place| closed.set[*place] && !self.set[*place])
            .map(|place| self.at(place))
            .collect()
    }

    /// Fills one of the free pixels wherever two pixels meet at a corner only, so that no outline touches itself.
    fn join_corners(&mut self) {
        // A filled pixel can meet another at its corner; more rounds than a map of rooms needs make a raster of noise a box.
        // After the first round, only where something was filled.
        let mut looked_at = vec![false; self.set.len()];
        for _ in 0..JOINING_ROUNDS {
            let mut filled = false;
            for place in 0..self.set.len() {
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
                self.put([x, y]);
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
        for (place, _) in self.set.iter().enumerate().filter(|(_, set)| **set) {
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
fn tidy(metres: f64) -> f64 {
    (metres * 1e4).round() / 1e4
}

/// The outlines of a room, and the share of its pixels that lies apart from them; `None` for a room without pixels.
type Traced = Option<(Vec<Vec<Cell>>, f64)>;

/// The rooms' outlines in metres, each a footprint as simple as the tolerance allows, or `None` if it is no footprint. None at all where
/// the map has too many corners then, or where more are looked at than are left.
fn footprints(traced: &[Traced], pixel_m: f64, tolerance_m: f64, left: &mut usize) -> Option<Vec<Option<Rings>>> {
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
fn outlines(raster: &Raster, mark: u8, largest: &[Cell], reach: usize, left: &mut usize) -> Option<Vec<Vec<Cell>>> {
    let mut mask = Mask::around(largest, 2 * reach as i64 + 1, left)?;
    let corner = mask.min;
    for slit in mask.slits(reach) {
        if [FREE, WALL, mark].contains(&raster.get(slit)) {
            mask.put(slit);
        }
    }
    for hole in mask.holes().collect::<Vec<_>>() {
        let of_others = hole.iter().filter(|cell| ![FREE, WALL, mark].contains(&raster.get(**cell))).count();
        if !hole.contains(&corner) && of_others * 2 <= hole.len() {
            hole.into_iter().for_each(|cell| mask.put(cell));
        }
    }
    mask.join_corners();
    let mut rings = mask.outlines();
    // The outer one reaches farthest to the left; holes lie within it.
    let outer = (0..rings.len()).min_by_key(|ring| rings[*ring].iter().map(|corner| corner[0]).min())?;
    rings.swap(0, outer);
    Some(rings)
}

/// The outline of the largest piece of the cells, without holes, in metres, with y upwards; `None` if the cells are no area with an outline.
pub(super) fn outline(cells: &[Cell], cell_m: f64) -> Option<Rings> {
    let mut left = MAX_PIXELS;
    let mask = Mask::around(cells, 0, &mut left)?;
    let mut seen = vec![false; mask.set.len()];
    let set = |cell| mask.place(cell).filter(|place| mask.set[*place]);
    let largest = cells.iter().filter_map(|cell| piece(*cell, &mut seen, set)).max_by_key(Vec::len)?;
    // A line of cells is a polygon that was drawn on a grid.
    let inner = largest.iter().filter(|cell| beside(**cell).into_iter().all(|near| mask.has(near))).count();
    if inner * 4 < largest.len() {
        return None;
    }
    let mut mask = Mask::around(&largest, 1, &mut left)?;
    let corner = mask.min;
    for hole in mask.holes().collect::<Vec<_>>() {
        if !hole.contains(&corner) {
            hole.into_iter().for_each(|cell| mask.put(cell));
        }
    }
    mask.join_corners();
    let outer = mask.outlines().into_iter().max_by_key(Vec::len)?;
    let mut looks = MAX_LOOKS;
    footprints(&[Some((vec![outer], 0.0))], cell_m, TOLERANCE_M, &mut looks)?.pop().flatten()
}

/// Where segments lie side by side without a wall between: per two of them, the pixels there.
fn contacts(raster: &Raster, gap: i64) -> BTreeMap<(u8, u8), Vec<Cell>> {
    let mut contacts: BTreeMap<(u8, u8), Vec<Cell>> = BTreeMap::new();
    for ([x, y], mark) in raster.cells().filter(|(_, mark)| ![FREE, WALL].contains(mark)) {
        for [right, down] in [[1, 0], [0, 1]] {
            for step in 1..=gap + 1 {
                match raster.get([x + step * right, y + step * down]) {
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
fn widest(raster: &Raster, mut cells: Vec<Cell>, waiting: &mut [bool]) -> Option<(Cell, i64)> {
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

/// A name or number of a segment.
fn text_of(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

/// Reads names of segments: a TOML table from a segment's number to the room's name.
///
/// # Errors
/// When the text is no table of names.
pub fn segment_names(toml: &str) -> Result<HashMap<String, String>, ImportError> {
    toml::from_str(toml).map_err(|error: toml::de::Error| ImportError::Json {
        element: ".".to_owned(),
        message: toml_says(&error),
        expected: "names of segments, as 11 = \"kitchen\" on a line each",
    })
}

/// Turns a map that Valetudo exports into a scene.
///
/// Room names come from `names` (by the segment's number), else from the map; names that the built-in table knows become English.
/// A segment without a name is "room" and its number. Ids end with the segment's number. A map without segments becomes one room.
/// Left out, with a note: pieces of a segment apart from its largest, segments without outline, paths, virtual walls and areas.
///
/// # Errors
/// When the text is no map of Valetudo, has no pixels or too many, `names` names a segment that is not there, or the scene breaks a rule.
#[expect(clippy::implicit_hasher, reason = "whoever reads names gets them from segment_names")]
pub fn valetudo(json: &str, name: &str, names: &HashMap<String, String>) -> Result<Imported, ImportError> {
    let file: File = parse(json, EXPECTED)?;
    let fault =
        |element: &str, message: String| ImportError::Json { element: element.to_owned(), message, expected: EXPECTED };
    if !(0.1..=100.0).contains(&file.pixel_size_cm) {
        return Err(fault("pixelSize", format!("{} is no size of a pixel in cm", file.pixel_size_cm)));
    }
    let pixel_m = file.pixel_size_cm / 100.0;
    let mut notes = Vec::new();

    let mut segments: Vec<&Layer> = file.layers.iter().filter(|layer| layer.r#type == "segment").collect();
    let divided = !segments.is_empty();
    if !divided {
        segments = file.layers.iter().filter(|layer| layer.r#type == "floor").collect();
        segments.truncate(1);
        notes.push(
            "The map has no segments, so the whole floor is one room: let the robot divide it into rooms, and import the map again.".to_owned(),
        );
    }
    if segments.is_empty() {
        let remedy = "it has neither segments nor a floor; let the robot map the home first";
        return Err(ImportError::NoRooms { remedy });
    }
    if segments.len() > MAX_ROOMS {
        return Err(fault("layers", format!("{} segments, more than {MAX_ROOMS}", segments.len())));
    }
    let mut left = MAX_PIXELS;
    let mut layers = Vec::new();
    for (index, layer) in file.layers.iter().enumerate() {
        let segment = segments.iter().position(|segment| std::ptr::eq(*segment, layer));
        let number = segment.and_then(|segment| u8::try_from(segment + 1).ok());
        let Some(mark) = number.or((layer.r#type == "wall").then_some(WALL)) else { continue };
        layers.push((mark, layer.runs(index, &mut left)?));
    }
    // Walls first: what a segment claims is floor.
    layers.sort_by_key(|(mark, _)| u8::from(*mark != WALL));
    let raster = Raster::new(&layers, pixel_m)?;

    let number_of = |index: usize| {
        let given = text_of(&segments[index].about.segment).filter(|_| divided);
        let sound =
            |text: &String| !text.is_empty() && text.len() <= 32 && text.chars().all(|c| c.is_ascii_alphanumeric());
        given.filter(sound).unwrap_or_else(|| (index + 1).to_string())
    };
    let numbers: Vec<String> = (0..segments.len()).map(number_of).collect();
    if let Some(unknown) = names.keys().filter(|number| !numbers.contains(number)).min() {
        return Err(ImportError::Names { unknown: unknown.clone(), there: numbers });
    }

    let mut traced: Vec<Traced> = Vec::new();
    let mut steps = 0;
    let reach = ((TOLERANCE_M / pixel_m).round() as usize).min(MAX_REACH);
    let (mut pieces, mut left) = (raster.largest_pieces(), MAX_ROOM_PIXELS);
    for mark in (1u8..).take(segments.len()) {
        let Some((largest, count)) = pieces.remove(&mark) else {
            traced.push(None);
            continue;
        };
        let outlines = outlines(&raster, mark, &largest, reach, &mut left).ok_or_else(|| {
            fault("layers", format!("the rectangles around its segments are more than {MAX_ROOM_PIXELS} pixels in all"))
        })?;
        steps += outlines.iter().map(Vec::len).sum::<usize>();
        traced.push(Some((outlines, 1.0 - largest.len() as f64 / count as f64)));
    }
    let mut tolerance_m = if steps > MAX_STEPS { f64::INFINITY } else { TOLERANCE_M };
    let (mut ids, mut rooms, mut boxed) = (Ids::default(), Vec::new(), Vec::new());
    let mut named = Vec::new();
    let given: Vec<Option<String>> = (0..segments.len())
        .map(|index| {
            let told = || text_of(&segments[index].about.name).filter(|_| divided);
            names.get(&numbers[index]).cloned().or_else(told)
        })
        .collect();
    let words: Vec<Option<String>> = given.iter().map(|given| given.as_deref().and_then(room_words)).collect();
    let labels: Vec<Option<String>> = given.iter().map(|given| given.as_deref().and_then(room_label)).collect();
    let mut room_of: HashMap<u8, String> = HashMap::new();
    let mut left = MAX_LOOKS;
    let shapes = loop {
        if !tolerance_m.is_finite() {
            break vec![None; traced.len()];
        }
        if let Some(shapes) = footprints(&traced, pixel_m, tolerance_m, &mut left) {
            break shapes;
        }
        tolerance_m = if tolerance_m < 1.0 && left > 0 { 2.0 * tolerance_m } else { f64::INFINITY };
    };
    for (index, (traced, shape)) in traced.iter().zip(shapes).enumerate() {
        let number = &numbers[index];
        let Some((outlines, lost)) = traced else {
            notes.push(format!("Left out segment {number}: it has no pixels of its own."));
            continue;
        };
        // The given names distinguish rooms of one kind, if they differ.
        let bearers = |of: &[Option<String>]| of.iter().filter(|other| **other == of[index]).count();
        let is_told_apart = bearers(&labels) > 1 && bearers(&words) == 1;
        let label = labels[index].clone();
        let label =
            label.unwrap_or_else(|| if divided { format!("room {}", number.to_lowercase()) } else { HOME.to_owned() });
        let slug = words[index].clone().filter(|_| is_told_apart).unwrap_or_else(|| label.clone());
        let slug: String = slug.chars().map(|c| if c.is_ascii_punctuation() { ' ' } else { c }).collect();
        let slug = slug.split_whitespace().collect::<Vec<_>>().join(" ");
        let is_named = labels[index].is_some() && divided && !slug.is_empty();
        let id = ids.take(&if is_named { format!("{slug} {number}") } else { label.clone() });
        named.extend(given[index].iter().map(|given| (rooms.len(), given.clone())));
        if *lost > 0.05 {
            notes.push(format!(
                "Left out {:.0} % of segment {number} ({label}), in pieces apart from it.",
                100.0 * lost
            ));
        }
        rooms.push(match shape {
            Some(rings) => RoomEntry::outlined(id.clone(), label, rings, 0.0, ROOM_HEIGHT_M),
            None => {
                boxed.push(id.clone());
                let corners = || outlines[0].iter().map(|&[x, y]| [x as f64 * pixel_m, -y as f64 * pixel_m]);
                let least = |axis: usize| corners().map(|corner| corner[axis]).fold(f64::INFINITY, f64::min);
                let most = |axis: usize| corners().map(|corner| corner[axis]).fold(f64::NEG_INFINITY, f64::max);
                let bounds = Box3 { min_m: [least(0), least(1), 0.0], max_m: [most(0), most(1), ROOM_HEIGHT_M] };
                RoomEntry::boxed(id.clone(), label, bounds)
            }
        });
        room_of.extend(u8::try_from(index + 1).ok().map(|mark| (mark, id)));
    }
    if rooms.is_empty() {
        return Err(ImportError::NoRooms { remedy: "its segments have no pixels; let the robot map the home again" });
    }
    let aliases = room_aliases(&rooms, named);

    let mut doors = Vec::new();
    let gap = (GAP_M / pixel_m).round() as i64;
    let mut waiting = vec![false; raster.cells.len()];
    for ((a, b), cells) in contacts(&raster, gap) {
        let (Some(a), Some(b)) = (room_of.get(&a), room_of.get(&b)) else { continue };
        let Some(([x, y], _)) =
            widest(&raster, cells, &mut waiting).filter(|(_, length)| *length as f64 * pixel_m >= DOOR_M)
        else {
            continue;
        };
        let position_m = [tidy((x as f64 + 0.5) * pixel_m), tidy(-(y as f64 + 0.5) * pixel_m), 1.0];
        doors.push(DoorEntry { id: format!("door-{}", doors.len() + 1), rooms: [a.clone(), b.clone()], position_m });
    }

    let mut items = Vec::new();
    let charger = file.entities.iter().find(|entity| entity.r#type == "charger_location");
    let place = |entity: &Entity| Some([entity.points.get(0)?.as_f64()?, entity.points.get(1)?.as_f64()?]);
    if let Some([x, y]) = charger.and_then(place) {
        let [x, y] = [tidy(x / 100.0), tidy(-y / 100.0)];
        let [width, height] = CHARGER_M.map(|metres| 0.5 * metres);
        items.push(ItemEntry {
            id: "charging-station".to_owned(),
            label: CHARGER.to_owned(),
            captions: Vec::new(),
            position_m: [x, y, height],
            r#box: Box3 {
                min_m: [tidy(x - width), tidy(y - width), 0.0],
                max_m: [tidy(x + width), tidy(y + width), 2.0 * height],
            },
        });
    }
    let of_robot = ["virtual_wall", "no_go_area", "no_mop_area", "active_zone"];
    let ignored = file.entities.iter().filter(|entity| of_robot.contains(&&*entity.r#type)).count();
    if ignored > 0 {
        notes.push(format!("Left out for the robot to keep: virtual walls and areas ({ignored})."));
    }
    let is_foreign =
        |room: &&RoomEntry| !room.label.is_ascii() && Names::built_in().kind_of_room(&room.label).is_none();
    let mut foreign: Vec<String> = rooms.iter().filter(is_foreign).map(|room| format!("\"{}\"", room.label)).collect();
    foreign.dedup();
    if !foreign.is_empty() {
        notes.push(format!(
            "No English is known for {}: name these segments with --names, for the model reads English.",
            foreign.join(", ")
        ));
    }
    let unnamed = rooms.iter().filter(|room| room.label.starts_with("room ")).count();
    if unnamed > 0 {
        notes.push(format!("Rooms without a name ({unnamed}): name them with --names, or in the robot's own program, so that their names say something."));
    }
    let source = match tolerance_m {
        tolerance_m if tolerance_m.is_finite() => format!("Valetudo map, imported; outlines to {tolerance_m} m"),
        _ => "Valetudo map, imported".to_owned(),
    };
    let file = SceneFile {
        format: FORMAT.to_owned(),
        version: VERSION,
        name: name.to_owned(),
        description: String::new(),
        source,
        rooms,
        parts: Vec::new(),
        groups: Vec::new(),
        doors,
        aliases,
        items,
    };
    Ok(Imported { map: SemanticMap::check(file)?, notes, boxed })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::{Grounding, GroundingOptions};
    use proptest::prelude::*;

    /// Two rooms of 3 m with a door between, a wall next to it; a speck of the kitchen far away, and a table's hole in it.
    const FLAT: &str = include_str!("../../../../tests/data/valetudo.json");

    fn none() -> HashMap<String, String> {
        HashMap::new()
    }

    #[test]
    fn segments_become_rooms_with_outlines() {
        let imported = valetudo(FLAT, "flat", &none()).unwrap();
        let map = &imported.map;
        let rooms: Vec<_> = map.rooms.iter().map(|room| (&*room.id, &*room.label)).collect();
        assert_eq!(rooms, [("kitchen-16", "kitchen"), ("hallway-17", "hallway"), ("room-3", "room 3")]);
        let area_m2 = |index: usize| map.rooms[index].space.footprint.as_ref().unwrap().area_m2();
        assert!((area_m2(0) - 9.0).abs() < 1e-6, "the table's hole is floor: {}", area_m2(0));
        assert_eq!(map.rooms[0].space.bounds, Box3 { min_m: [1.0, -4.0, 0.0], max_m: [4.0, -1.0, 2.5] });
        // An L of 3 x 3 m without a corner of 1 x 1 m.
        assert!((area_m2(1) - 8.0).abs() < 1e-6, "{}", area_m2(1));
        assert_eq!(map.doors.len(), 1, "room 3 lies behind a wall: {:?}", map.doors);
        let [x, y, _] = map.doors[0].position_m;
        assert!((x - 4.05).abs() < 0.1 && (y + 2.5).abs() < 0.1, "{x} {y}");
        assert_eq!(map.find_room("Küche"), Some(crate::semantic_map::RoomId(0)));
        assert_eq!(map.items[0].label, map.find_label("charging station").unwrap());
        assert!(Grounding::new(map, &GroundingOptions::default()).unwrap().unassigned.is_empty());
        assert!(imported.notes.iter().any(|note| note.contains("in pieces apart from it")), "{:?}", imported.notes);
        assert_eq!(SemanticMap::from_json(&map.to_json()).unwrap(), *map);
    }

    #[test]
    fn names_can_be_given_by_segment() {
        let names = segment_names("3 = \"Lenas Zimmer\"\n\"17\" = \"Flur \"").unwrap();
        let map = valetudo(FLAT, "flat", &names).unwrap().map;
        assert_eq!((&*map.rooms[2].label, &*map.rooms[2].id), ("bedroom", "bedroom-3"));
        assert_eq!(map.find_room("Lenas Zimmer"), Some(crate::semantic_map::RoomId(2)));
        let unknown = segment_names("4 = \"attic\"").unwrap();
        let error = valetudo(FLAT, "flat", &unknown).unwrap_err().to_string();
        assert!(error.contains("segment \"4\", but the map has 16, 17, 3"), "{error}");
        // A map in place of its names.
        let map = format!("{{\"layers\": \"{}\"}}", "1,2,".repeat(1 << 18));
        assert!(segment_names(&map).unwrap_err().to_string().len() < 2_000);
        let error = valetudo(&map, "x", &HashMap::new()).unwrap_err().to_string();
        assert!(error.len() < 2_000, "{} bytes", error.len());
        assert!(segment_names("3 = 4").unwrap_err().to_string().contains("11 = \"kitchen\""));
    }

    /// The least number has no absolute value: a message at the broker ended `init`.
    #[test]
    fn pixels_at_the_ends_of_the_numbers_are_refused() {
        for far in [i64::MIN, i64::MAX] {
            for (key, run) in
                [("pixels", vec![far, 0, 1, 1]), ("pixels", vec![0, far]), ("compressedPixels", vec![far, far, far])]
            {
                let map = serde_json::json!({"pixelSize": 5, "layers": [{"type": "segment", "metaData": {"segmentId": "1"}, key: run}]});
                let error = valetudo(&map.to_string(), "home", &none()).unwrap_err().to_string();
                assert!(error.contains("lies too far out"), "{error}");
            }
        }
    }

    /// Segments that lie around one another, each as large as the whole map: no home, and much to trace.
    #[test]
    fn rooms_around_one_another_are_refused() {
        let map = |size: usize, rooms: usize| {
            let corner = |room: usize| {
                let from = 10 * room;
                let across = (from..from + 5).flat_map(move |row| [from, row, size - from]);
                let down = (from + 5..size).flat_map(move |row| [from, row, 5]);
                let runs: Vec<usize> = across.chain(down).collect();
                serde_json::json!({"type": "segment", "compressedPixels": runs, "metaData": {"segmentId": (room + 1).to_string()}})
            };
            let layers: Vec<Value> = (0..rooms).map(corner).collect();
            valetudo(&serde_json::json!({"pixelSize": 5, "layers": layers}).to_string(), "home", &none())
        };
        assert_eq!(map(400, 5).unwrap().map.rooms.len(), 5);
        let error = map(1990, 5).unwrap_err().to_string();
        assert!(error.contains(&format!("more than {MAX_ROOM_PIXELS} pixels in all")), "{error}");
    }

    /// A map of square segments side by side, with these names.
    fn named(names: &[Value], of: impl Fn(&mut Value)) -> Result<Imported, ImportError> {
        let layer = |(index, name): (usize, &Value)| {
            let runs: Vec<usize> = (0..60).flat_map(|row| [100 + 60 * index, 100 + row, 60]).collect();
            serde_json::json!({"__class": "MapLayer", "type": "segment", "compressedPixels": runs,
                "metaData": {"segmentId": (index + 1).to_string(), "name": name, "active": false, "area": 90000, "material": "tile"}})
        };
        let layers: Vec<Value> = names.iter().enumerate().map(layer).collect();
        let mut map = serde_json::json!({"__class": "ValetudoMap", "metaData": {"version": 2, "nonce": "x", "vendorMapId": 3}, "size": {"x": 5120, "y": 5120},
            "pixelSize": 5, "layers": layers, "entities": []});
        of(&mut map);
        valetudo(&map.to_string(), "home", &none())
    }

    #[test]
    fn rooms_of_one_kind_are_told_apart_by_their_names() {
        let names = [
            "Bad oben",
            "Bad unten ",
            "Kinderzimmer Tom",
            "Kinderzimmer Lena",
            "Flur",
            "Flur",
            "\u{200b}",
            "寝室",
            "Oда",
        ];
        let imported = named(&names.map(Value::from), |_| {}).unwrap();
        assert!(
            imported.notes.iter().any(|note| note.starts_with("No English is known for \"oда\"")),
            "{:?}",
            imported.notes
        );
        let map = imported.map;
        let ids: Vec<_> = map.rooms.iter().map(|room| &*room.id).collect();
        let expected = [
            "bad-oben-1",
            "bad-unten-2",
            "kinderzimmer-tom-3",
            "kinderzimmer-lena-4",
            "hallway-5",
            "hallway-6",
            "room-7",
            "bedroom-8",
            "oда-9",
        ];
        assert_eq!(ids, expected);
        assert_eq!(map.rooms[3].label, "children's bedroom");
        for (name, room) in [
            ("Bad unten", Some(1)),
            ("kinderzimmer lena", Some(3)),
            ("寝室", Some(7)),
            ("hallway", Some(4)),
            ("Flur", None),
            ("Bad", None),
        ] {
            assert_eq!(map.find_room(name).map(|room| room.0), room, "{name}");
        }
        assert_eq!(SemanticMap::from_json(&map.to_json()).unwrap(), map);
    }

    #[test]
    fn maps_of_other_robots_are_read() {
        // Names that are no names, and entities that other robots have.
        let odd = [
            Value::Null,
            Value::from(7),
            Value::from("  "),
            Value::from("x".repeat(300)),
            Value::from("a\nb\u{7}c"),
            Value::from(["Bad"]),
        ];
        let imported = named(&odd, |map| {
            map["entities"] = serde_json::json!([
                {"__class": "PointMapEntity", "type": "obstacle", "points": [520, 530], "metaData": {"label": "Pedestal (85%)"}},
                {"__class": "PolygonMapEntity", "type": "no_go_area", "points": [500, 500, 520, 500, 520, 520, 500, 520]},
                {"__class": "PathMapEntity", "type": "predicted_path", "points": null},
                {"__class": "PointMapEntity", "type": "charger_location", "points": {"x": 1}}]);
        })
        .unwrap();
        let labels: Vec<_> = imported.map.rooms.iter().map(|room| &*room.label).collect();
        assert_eq!(labels, ["room 1", "7", "room 3", "room 4", "a bc", "room 6"]);
        assert!(imported.map.items.is_empty(), "it has no charger");
        assert!(
            imported.notes.iter().any(|note| note.ends_with("virtual walls and areas (1).")),
            "{:?}",
            imported.notes
        );
        // Finer and coarser pixels, far from the origin; the first format, with each pixel by itself.
        for (pixel, area_m2) in [(1.0, 0.36), (2.5, 2.25), (10.0, 36.0)] {
            let map = named(&["Küche".into()], |map| map["pixelSize"] = pixel.into()).unwrap().map;
            let own_m2 = map.rooms[0].space.footprint.as_ref().unwrap().area_m2();
            assert!((own_m2 - area_m2).abs() < 1e-6, "{pixel}: {own_m2}");
        }
        let first = named(&["Küche".into()], |map| {
            let pixels: Vec<i64> = (0..3600).flat_map(|place| [-800_000 + place % 60, 900_000 - place / 60]).collect();
            map["metaData"]["version"] = 1.into();
            map["layers"][0]["pixels"] = pixels.into();
            map["layers"][0].as_object_mut().unwrap().remove("compressedPixels");
            map["layers"][0]["metaData"]["segmentId"] = 16.into();
        });
        let error = first.unwrap_err().to_string();
        assert!(error.contains("farther than 10 km"), "{error}");
        // As many rooms as there can be, and one more.
        let many = |count: usize| named(&vec![Value::from("Room"); count], |_| {});
        assert_eq!(many(64).unwrap().map.rooms.len(), 64);
        assert!(many(65).unwrap_err().to_string().contains("65 segments, more than 64"));
    }

    #[test]
    fn a_map_without_segments_is_one_room() {
        let floor =
            r#"{"pixelSize": 5, "layers": [{"type": "floor", "compressedPixels": [0, 0, 20, 0, 1, 20, 0, 2, 20]}]}"#;
        let imported = valetudo(floor, "x", &none()).unwrap();
        assert_eq!((imported.map.rooms.len(), &*imported.map.rooms[0].label), (1, "home"));
        assert!(imported.notes[0].contains("let the robot divide it into rooms"));
    }

    #[test]
    fn what_is_no_map_is_refused() {
        let message = |json: &str| valetudo(json, "x", &none()).unwrap_err().to_string();
        let layer = |runs: &str| {
            format!(r#"{{"pixelSize": 5, "layers": [{{"type": "segment", "compressedPixels": {runs}}}]}}"#)
        };
        for (json, expected) in [
            ("[]".to_owned(), "expected a map as Valetudo exports it"),
            (r#"{"pixelSize": 5, "layers": []}"#.to_owned(), "let the robot map the home first"),
            (r#"{"pixelSize": 0, "layers": []}"#.to_owned(), "pixelSize: 0 is no size"),
            (layer("[]"), "the layers have no pixels"),
            (layer("[1, 2]"), "compressedPixels triples"),
            (layer("[1, 2, -3]"), "layers[0]: has a run at [1, 2]"),
            (layer("[1, 2, 99999999999]"), "more than 4000000 pixels"),
            (layer("[0, 0, 9000000, 0, 1, 9000000]"), "more than 4000000 pixels"),
            (layer("[-9000000, 0, 1]"), "lies too far out"),
            (layer("[0, 0, 1, 19000, 19000, 1]"), "19001 x 19001 pixels"),
            (layer("[0, 0, 1, 900000, 0, 1]"), "pixels at 900000, which lie farther than 10 km"),
        ] {
            let text = message(&json);
            assert!(text.contains(expected), "{expected}: {text}");
        }
    }

    /// Rows of one segment, every other one a pixel longer: an outline of as many teeth as rows.
    fn teeth(rows: usize, pixel_cm: f64) -> String {
        let runs: Vec<usize> = (0..rows).flat_map(|row| [0, row, 1 + row % 2]).collect();
        let layer = serde_json::json!({"type": "segment", "metaData": {"segmentId": "1"}, "compressedPixels": runs});
        serde_json::json!({"pixelSize": pixel_cm, "layers": [layer]}).to_string()
    }

    /// Pixels too far out are refused before names are compared, and so before anything is traced.
    #[test]
    fn a_map_beyond_10_km_is_refused_before_it_is_traced() {
        let unknown = segment_names("4 = \"attic\"").unwrap();
        let error = valetudo(&teeth(24_800, 100.0), "x", &unknown).unwrap_err().to_string();
        assert!(error.contains("pixels at 24799, which lie farther than 10 km"), "{error}");
        assert!(matches!(valetudo(&teeth(100, 100.0), "x", &unknown), Err(ImportError::Names { .. })));
    }

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
        // Whatever the outline, a map comes of it.
        let map = valetudo(&teeth(24_800, 39.0), "x", &none()).unwrap();
        assert_eq!(map.map.rooms.len(), 1);
    }

    /// Rows of two segments, one after the other: each pixel touches the other segment.
    #[test]
    fn segments_that_touch_everywhere_have_one_door() {
        let layer = |first: usize| {
            let runs: Vec<usize> = (0..200).flat_map(|row| [0, 2 * row + first, 400]).collect();
            serde_json::json!({"type": "segment", "metaData": {"segmentId": (first + 1).to_string()}, "compressedPixels": runs})
        };
        let json = serde_json::json!({"pixelSize": 5, "layers": [layer(0), layer(1)]}).to_string();
        let map = valetudo(&json, "x", &none()).unwrap().map;
        assert_eq!(map.doors.len(), 1);
        let [x, y, _] = map.doors[0].position_m;
        assert!((x - 10.0).abs() < 0.2 && (y + 10.0).abs() < 0.2, "{x} {y}");
    }

    #[test]
    fn segments_of_one_pixel_and_of_one_place_are_survived() {
        let twice = r#"{"pixelSize": 5, "layers": [{"type": "segment", "compressedPixels": [0, 0, 1]}, {"type": "segment", "pixels": [0, 0, 5, 5]}]}"#;
        let imported = valetudo(twice, "x", &none()).unwrap();
        assert_eq!(imported.map.rooms.len(), 1, "{:?}", imported.notes);
        assert!(imported.notes[0].contains("no pixels of its own"));
    }

    /// Six maps of real robots, if present: rooms as large as the robot counts them, every room reached but by a closed door.
    #[test]
    fn real_maps_become_rooms() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/valetudo");
        if !folder.is_dir() {
            crate::skipped::skipped(format_args!("{} is missing", folder.display()));
            return;
        }
        let expected: [(&str, &[&str], usize); 6] = [
            ("1c_1096_fullcleanup", &["room 1", "room 2", "room 3"], 2),
            ("S5_FW2008_with_segments", &["room 1", "room 2"], 1),
            ("converted_3790", &["living room", "kitchen", "hallway", "hallway", "hallway", "hallway", "hallway"], 6),
            ("d9_1058_no_segments", &["home"], 0),
            ("d9_1058_with_custom_named_segments", &["room 1", "bathroom", "hallway", "room 4", "room 5", "room 6"], 5),
            (
                "z10_1056_paths",
                &["bathroom", "bedroom", "kitchen", "hallway", "living room", "dining room", "home office"],
                7,
            ),
        ];
        for (file, labels, doors) in expected {
            let json = std::fs::read_to_string(folder.join(format!("{file}.json"))).unwrap();
            let imported = valetudo(&json, file, &none()).unwrap().furnished().unwrap();
            let map = &imported.map;
            assert!(map.rooms.iter().map(|room| room.label.as_str()).eq(labels.iter().copied()), "{file}");
            assert_eq!((map.doors.len(), &imported.boxed[..]), (doors, &[][..]), "{file}");
            let grounding = Grounding::new(map, &GroundingOptions::default()).unwrap();
            assert!(grounding.unassigned().is_empty(), "{file}: {:?}", grounding.unassigned());
            let read: Value = serde_json::from_str(&json).unwrap();
            for layer in read["layers"].as_array().unwrap().iter().filter(|layer| layer["type"] == "segment") {
                let number = text_of(&layer["metaData"]["segmentId"]).unwrap();
                let room = map.rooms.iter().find(|room| room.id.ends_with(&format!("-{number}"))).unwrap();
                let area_m2 = room.space.footprint.as_ref().unwrap().area_m2();
                let counted_m2 = layer["metaData"]["area"].as_f64().unwrap() / 1e4;
                assert!((0.85..1.2).contains(&(area_m2 / counted_m2)), "{file}, {}: {area_m2} {counted_m2}", room.id);
            }
        }
    }

    proptest! {
        /// Pixel by pixel, as the words have it.
        #[test]
        fn spreading_looks_along_an_axis(cells in prop::collection::vec(any::<bool>(), 9 * 7), reach in 0..4usize, axis in 0..2usize, all: bool) {
            let mask = Mask { min: [-2, 5], size: [9, 7], set: cells };
            let step = |at: Cell, by: i64| if axis == 0 { [at[0] + by, at[1]] } else { [at[0], at[1] + by] };
            let decide = |place: usize| {
                let reach = reach as i64;
                let mut around = (-reach..=reach).map(|by| mask.has(step(mask.at(place), by)));
                if all { around.all(|set| set) } else { around.any(|set| set) }
            };
            prop_assert_eq!(mask.spread(axis, reach, all), (0..mask.set.len()).map(decide).collect::<Vec<_>>());
        }

        /// As if each round looked at every pixel.
        #[test]
        fn joining_leaves_no_corner(cells in prop::collection::vec(any::<bool>(), 12 * 12)) {
            let mut mask = Mask { min: [0, 0], size: [12, 12], set: cells };
            let mut every = Mask { min: mask.min, size: mask.size, set: mask.set.clone() };
            mask.join_corners();
            loop {
                let before = every.set.clone();
                for place in 0..every.set.len() {
                    let [x, y] = every.at(place);
                    let [a, b, c, d] = [[x, y], [x + 1, y], [x, y + 1], [x + 1, y + 1]].map(|cell| every.has(cell));
                    if a && d && !b && !c {
                        every.put([x + 1, y]);
                    } else if b && c && !a && !d {
                        every.put([x, y]);
                    }
                }
                if every.set == before {
                    break;
                }
            }
            prop_assert_eq!(mask.set, every.set);
        }

        /// Any raster becomes a checked map, and its rooms hold their pixels, to the tolerance.
        #[test]
        fn rooms_hold_their_pixels(cells in prop::collection::vec(0..4u8, 24 * 24)) {
            let mut layers = String::new();
            for mark in 1..4u8 {
                let pixels: Vec<String> = cells.iter().enumerate().filter(|(_, own)| **own == mark)
                    .map(|(place, _)| format!("{},{}", place % 24, place / 24)).collect();
                layers.push_str(&format!(r#",{{"type": "segment", "metaData": {{"segmentId": {mark}}}, "pixels": [{}]}}"#, pixels.join(",")));
            }
            let json = format!(r#"{{"pixelSize": 10, "layers": [{{"type": "wall"}}{layers}]}}"#);
            if let Ok(imported) = valetudo(&json, "x", &HashMap::new()) {
                for room in &imported.map.rooms {
                    prop_assert!(imported.boxed.contains(&room.id) || room.space.footprint.is_some());
                }
                prop_assert!(imported.furnished().is_ok());
            }
        }

        #[test]
        fn hostile_text_never_panics(cut in 0..FLAT.len(), noise in "\\PC{0,8}") {
            if FLAT.is_char_boundary(cut) {
                let _ = valetudo(&format!("{}{noise}{}", &FLAT[..cut], &FLAT[cut..]), "x", &HashMap::new());
            }
        }
    }
}
