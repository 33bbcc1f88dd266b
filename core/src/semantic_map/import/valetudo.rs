//! A vacuum robot's map as Valetudo exports it: segments become rooms with their outlines.
//!
//! The map is a raster. A room is the largest piece of its segment, without the holes that furniture leaves in it and without slits
//! narrower than twice [`TOLERANCE_M`]. Its outline follows the pixels' edges, simplified to the same tolerance. A door is where two segments lie side by side and no wall between them.
//!
//! The frame is the robot's own, in metres, with y turned, so that the plan is not its mirror image: x is Valetudo's x / 100, y its
//! -y / 100.

use std::collections::HashMap;

use serde::Deserialize;
use serde_json::Value;

use super::{Ids, ImportError, Imported, parse, room_aliases, room_label, room_words, unnamed};
use crate::names::Names;
use crate::parsing::toml_says;
use crate::semantic_map::schema::{DoorEntry, ItemEntry, ROOM_HEIGHT_M, Rings, RoomEntry, SceneFile};
use crate::semantic_map::{Box3, MAX_ROOMS};

mod outline;
mod raster;
#[cfg(test)]
mod tests;

pub(super) use outline::outline;

use outline::{MAX_LOOKS, Traced, footprints, outlines, tidy};
use raster::{Raster, WALL, contacts, raster, widest};

const EXPECTED: &str = "a map as Valetudo exports it: `pixelSize` and `layers`";
/// Most pixels of a robot's map, and of the rectangle around it.
pub const MAX_PIXELS: usize = 4_000_000;
/// Most pixels of the rectangles around all rooms: rooms of a home lie side by side, and hardly in one another's rectangle.
pub const MAX_ROOM_PIXELS: usize = 4 * MAX_PIXELS;
/// How far a room's outline may lie from its pixels, in metres.
pub(crate) const TOLERANCE_M: f64 = 0.1;
/// Most corners of all outlines before they are simplified.
const MAX_STEPS: usize = 50_000;
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

/// A place on a grid, or a corner between its cells.
type Cell = [i64; 2];

/// A rectangle of cells.
struct Grid<T> {
    min: Cell,
    size: [usize; 2],
    cells: Vec<T>,
}

impl<T: Copy> Grid<T> {
    /// Cells with one value, both ends included; gives back the size if they would be more than `most`.
    fn filled(min: Cell, max: Cell, value: T, most: usize) -> Result<Self, [usize; 2]> {
        let size = [0, 1].map(|axis| usize::try_from(max[axis] - min[axis] + 1).unwrap_or(usize::MAX));
        let count = size[0].checked_mul(size[1]).filter(|count| *count <= most).ok_or(size)?;
        Ok(Self { min, size, cells: vec![value; count] })
    }

    fn place(&self, [x, y]: Cell) -> Option<usize> {
        let column = usize::try_from(x - self.min[0]).ok().filter(|column| *column < self.size[0])?;
        let row = usize::try_from(y - self.min[1]).ok().filter(|row| *row < self.size[1])?;
        Some(row * self.size[0] + column)
    }

    fn at(&self, place: usize) -> Cell {
        [self.min[0] + (place % self.size[0]) as i64, self.min[1] + (place / self.size[0]) as i64]
    }

    fn get(&self, cell: Cell) -> Option<T> {
        self.place(cell).map(|place| self.cells[place])
    }

    fn put(&mut self, cell: Cell, value: T) {
        if let Some(place) = self.place(cell) {
            self.cells[place] = value;
        }
    }
}

/// Runs of pixels: where each begins, and how many there are.
type Runs = Vec<(Cell, i64)>;

impl Layer {
    fn runs(&self, index: usize, left: &mut usize) -> Result<Runs, ImportError> {
        if !self.pixels.len().is_multiple_of(2) || !self.runs.len().is_multiple_of(3) {
            return Err(fault(format!("layers[{index}]: pixels are pairs of numbers, compressedPixels triples")));
        }
        let single = self.pixels.chunks_exact(2).map(|pixel| ([pixel[0], pixel[1]], 1));
        let runs = single.chain(self.runs.chunks_exact(3).map(|run| ([run[0], run[1]], run[2])));
        runs.map(|(at, count)| {
            let near = at.iter().all(|place| (-FARTHEST..=FARTHEST).contains(place));
            let count = usize::try_from(count).ok().filter(|count| near && *count <= MAX_PIXELS);
            let rest = count.and_then(|count| left.checked_sub(count).map(|rest| (rest, count)));
            let Some((rest, count)) = rest else {
                return Err(fault(format!(
                    "layers[{index}]: has a run at {at:?} that lies too far out, or more than {MAX_PIXELS} pixels"
                )));
            };
            *left = rest;
            // Not more than MAX_PIXELS.
            Ok((at, count as i64))
        })
        .collect()
    }
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
#[expect(clippy::implicit_hasher, reason = "the names come from segment_names")]
pub fn valetudo(json: &str, name: &str, names: &HashMap<String, String>) -> Result<Imported, ImportError> {
    let file: File = parse(json, EXPECTED)?;
    if !(0.1..=100.0).contains(&file.pixel_size_cm) {
        return Err(fault(format!("pixelSize: {} is no size of a pixel in cm", file.pixel_size_cm)));
    }
    let pixel_m = file.pixel_size_cm / 100.0;
    let mut notes = Vec::new();
    let segments = Segments::of(&file, names, &mut notes)?;
    let raster = segments.raster(&file, pixel_m)?;
    if let Some(unknown) = names.keys().filter(|number| !segments.numbers.contains(number)).min() {
        return Err(ImportError::Names { unknown: unknown.clone(), there: segments.numbers });
    }
    let traced = trace(&raster, segments.layers.len(), pixel_m)?;
    let (shapes, tolerance_m) = shapes(&traced, pixel_m);
    let Rooms { rooms, boxed, named, room_of } = segments.rooms(&traced, shapes, pixel_m, &mut notes);
    if rooms.is_empty() {
        return Err(ImportError::NoRooms { remedy: "its segments have no pixels; let the robot map the home again" });
    }
    notes.extend(ignored(&file));
    notes.extend(nameless(&rooms));
    let source = match tolerance_m {
        Some(tolerance_m) => format!("Valetudo map, imported; outlines to {tolerance_m} m"),
        None => "Valetudo map, imported".to_owned(),
    };
    let file = SceneFile {
        aliases: room_aliases(&rooms, named),
        doors: doors(&raster, &room_of, pixel_m),
        ..SceneFile::new(name, &source, rooms, charger(&file).into_iter().collect())
    };
    Imported::new(file, notes, boxed)
}

fn fault(message: String) -> ImportError {
    ImportError::Json { message, expected: EXPECTED }
}

/// The layers that become rooms, with the numbers and names of their segments.
struct Segments<'a> {
    layers: Vec<&'a Layer>,
    /// The map has segments; else its floor is the one room.
    divided: bool,
    numbers: Vec<String>,
    /// The names as they were given, or as the map has them.
    given: Vec<Option<String>>,
}

impl<'a> Segments<'a> {
    fn of(file: &'a File, names: &HashMap<String, String>, notes: &mut Vec<String>) -> Result<Self, ImportError> {
        let of_type = |own: &'static str| file.layers.iter().filter(move |layer| layer.r#type == own);
        let mut layers: Vec<&Layer> = of_type("segment").collect();
        let divided = !layers.is_empty();
        if !divided {
            layers = of_type("floor").take(1).collect();
            notes.push(
                "The map has no segments, so the whole floor is one room: let the robot divide it into rooms, and import the map again.".to_owned(),
            );
        }
        if layers.is_empty() {
            let remedy = "it has neither segments nor a floor; let the robot map the home first";
            return Err(ImportError::NoRooms { remedy });
        }
        if layers.len() > MAX_ROOMS {
            return Err(fault(format!("layers: {} segments, more than {MAX_ROOMS}", layers.len())));
        }
        let number_of = |(index, layer): (usize, &&Layer)| {
            let given = text_of(&layer.about.segment).filter(|_| divided);
            let sound =
                |text: &String| !text.is_empty() && text.len() <= 32 && text.chars().all(|c| c.is_ascii_alphanumeric());
            given.filter(sound).unwrap_or_else(|| (index + 1).to_string())
        };
        let numbers: Vec<String> = layers.iter().enumerate().map(number_of).collect();
        let name_of = |(layer, number): (&&Layer, &String)| {
            let told = || text_of(&layer.about.name).filter(|_| divided);
            names.get(number).cloned().or_else(told)
        };
        let given = layers.iter().zip(&numbers).map(name_of).collect();
        Ok(Self { layers, divided, numbers, given })
    }

    /// The pixels of the segments and walls.
    fn raster(&self, file: &File, pixel_m: f64) -> Result<Raster, ImportError> {
        let mut left = MAX_PIXELS;
        let mut layers = Vec::new();
        for (index, layer) in file.layers.iter().enumerate() {
            let segment = self.layers.iter().position(|segment| std::ptr::eq(*segment, layer));
            let number = segment.and_then(|segment| u8::try_from(segment + 1).ok());
            let Some(mark) = number.or((layer.r#type == "wall").then_some(WALL)) else { continue };
            layers.push((mark, layer.runs(index, &mut left)?));
        }
        // Walls first: a pixel of a wall and a segment is floor.
        layers.sort_by_key(|(mark, _)| u8::from(*mark != WALL));
        raster(&layers, pixel_m)
    }

    /// The rooms of the segments that have pixels.
    fn rooms(&self, traced: &[Traced], shapes: Vec<Option<Rings>>, pixel_m: f64, notes: &mut Vec<String>) -> Rooms {
        let words: Vec<Option<String>> = self.given.iter().map(|given| given.as_deref().and_then(room_words)).collect();
        let labels: Vec<Option<String>> =
            self.given.iter().map(|given| given.as_deref().and_then(room_label)).collect();
        let mut ids = Ids::default();
        let mut found = Rooms::default();
        for (index, (traced, shape)) in traced.iter().zip(shapes).enumerate() {
            let number = &self.numbers[index];
            let Some((outlines, lost)) = traced else {
                notes.push(format!("Left out segment {number}: it has no pixels of its own."));
                continue;
            };
            let label = labels[index].clone().unwrap_or_else(|| {
                if self.divided { format!("room {}", number.to_lowercase()) } else { HOME.to_owned() }
            });
            // The given names distinguish rooms of one kind, if they differ.
            let bearers = |of: &[Option<String>]| of.iter().filter(|other| **other == of[index]).count();
            let is_told_apart = bearers(&labels) > 1 && bearers(&words) == 1;
            let slug = words[index].clone().filter(|_| is_told_apart).unwrap_or_else(|| label.clone());
            let slug: String = slug.chars().map(|c| if c.is_ascii_punctuation() { ' ' } else { c }).collect();
            let slug = slug.split_whitespace().collect::<Vec<_>>().join(" ");
            let is_named = labels[index].is_some() && self.divided && !slug.is_empty();
            let id = ids.take(&if is_named { format!("{slug} {number}") } else { label.clone() });
            found.named.extend(self.given[index].iter().map(|given| (found.rooms.len(), given.clone())));
            if *lost > 0.05 {
                notes.push(format!(
                    "Left out {:.0} % of segment {number} ({label}), in pieces apart from it.",
                    100.0 * lost
                ));
            }
            found.rooms.push(match shape {
                Some(rings) => RoomEntry::outlined(id.clone(), label, rings, 0.0, ROOM_HEIGHT_M),
                None => {
                    found.boxed.push(id.clone());
                    RoomEntry::boxed(id.clone(), label, around(&outlines[0], pixel_m))
                }
            });
            found.room_of.extend(u8::try_from(index + 1).ok().map(|mark| (mark, id)));
        }
        found
    }
}

/// The rooms of a map.
#[derive(Default)]
struct Rooms {
    rooms: Vec<RoomEntry>,
    /// The ids of the rooms that are boxes, since their outline is no footprint.
    boxed: Vec<String>,
    /// The given names, each with its room.
    named: Vec<(usize, String)>,
    /// The room's id of a mark of the raster.
    room_of: HashMap<u8, String>,
}

/// The outlines of the segments.
fn trace(raster: &Raster, segments: usize, pixel_m: f64) -> Result<Vec<Traced>, ImportError> {
    let reach = ((TOLERANCE_M / pixel_m).round() as usize).min(MAX_REACH);
    let (mut pieces, mut left) = (raster.largest_pieces(), MAX_ROOM_PIXELS);
    let mut trace = |mark: u8| {
        let Some((largest, count)) = pieces.remove(&mark) else { return Ok(None) };
        let outlines = outlines(raster, mark, &largest, reach, &mut left).ok_or_else(|| {
            fault(format!("layers: the rectangles around its segments are more than {MAX_ROOM_PIXELS} pixels in all"))
        })?;
        Ok(Some((outlines, 1.0 - largest.len() as f64 / count as f64)))
    };
    (1u8..).take(segments).map(&mut trace).collect()
}

/// The footprints and their tolerance in metres. Without a tolerance no outline is simple enough.
fn shapes(traced: &[Traced], pixel_m: f64) -> (Vec<Option<Rings>>, Option<f64>) {
    let corners: usize = traced.iter().flatten().flat_map(|(outlines, _)| outlines).map(Vec::len).sum();
    let mut left = MAX_LOOKS;
    if corners <= MAX_STEPS {
        for tolerance_m in [1.0, 2.0, 4.0, 8.0, 16.0].map(|coarser| coarser * TOLERANCE_M) {
            if let Some(shapes) = footprints(traced, pixel_m, tolerance_m, &mut left) {
                return (shapes, Some(tolerance_m));
            }
            if left == 0 {
                break;
            }
        }
    }
    (vec![None; traced.len()], None)
}

/// The box around an outline.
fn around(outline: &[Cell], pixel_m: f64) -> Box3 {
    let corner = |&[x, y]: &Cell| {
        let [x, y] = [x as f64 * pixel_m, -y as f64 * pixel_m];
        Box3 { min_m: [x, y, 0.0], max_m: [x, y, ROOM_HEIGHT_M] }
    };
    outline.iter().map(corner).reduce(Box3::with).unwrap_or(Box3 { min_m: [0.0; 3], max_m: [0.0; 3] })
}

/// The doors: places where two rooms lie side by side with no wall between them.
fn doors(raster: &Raster, room_of: &HashMap<u8, String>, pixel_m: f64) -> Vec<DoorEntry> {
    let mut waiting = vec![false; raster.cells.len()];
    let mut doors = Vec::new();
    for ((a, b), cells) in contacts(raster, (GAP_M / pixel_m).round() as i64) {
        let (Some(a), Some(b)) = (room_of.get(&a), room_of.get(&b)) else { continue };
        let Some(([x, y], length)) = widest(raster, cells, &mut waiting) else { continue };
        if (length as f64) * pixel_m >= DOOR_M {
            let position_m = [tidy((x as f64 + 0.5) * pixel_m), tidy(-(y as f64 + 0.5) * pixel_m), 1.0];
            doors.push(DoorEntry {
                id: format!("door-{}", doors.len() + 1),
                rooms: [a.clone(), b.clone()],
                position_m,
            });
        }
    }
    doors
}

fn charger(file: &File) -> Option<ItemEntry> {
    let entity = file.entities.iter().find(|entity| entity.r#type == "charger_location")?;
    let [x, y] = [tidy(entity.points.get(0)?.as_f64()? / 100.0), tidy(-entity.points.get(1)?.as_f64()? / 100.0)];
    let [width, height] = CHARGER_M;
    let corner = |side: f64, z: f64| [tidy(x + side * width), tidy(y + side * width), z];
    let bounds = Box3 { min_m: corner(-0.5, 0.0), max_m: corner(0.5, height) };
    let position_m = [x, y, 0.5 * height];
    Some(ItemEntry { position_m, ..ItemEntry::boxed("charging-station".to_owned(), CHARGER, bounds) })
}

/// A note on entities that the robot keeps itself.
fn ignored(file: &File) -> Option<String> {
    const OF_ROBOT: [&str; 4] = ["virtual_wall", "no_go_area", "no_mop_area", "active_zone"];
    let count = file.entities.iter().filter(|entity| OF_ROBOT.contains(&&*entity.r#type)).count();
    (count > 0).then(|| format!("Left out for the robot to keep: virtual walls and areas ({count})."))
}

/// Notes on rooms without an English name.
fn nameless(rooms: &[RoomEntry]) -> Vec<String> {
    let is_foreign =
        |room: &&RoomEntry| !room.label.is_ascii() && Names::built_in().kind_of_room(&room.label).is_none();
    let mut foreign: Vec<String> = rooms.iter().filter(is_foreign).map(|room| format!("\"{}\"", room.label)).collect();
    foreign.dedup();
    let mut notes = Vec::new();
    if !foreign.is_empty() {
        notes.push(format!(
            "No English is known for {}: name these segments with --names, for the model reads English.",
            foreign.join(", ")
        ));
    }
    let remedy = "name them with --names, or in the robot's own program, so that their names say something";
    notes.extend(unnamed(rooms, remedy));
    notes
}
