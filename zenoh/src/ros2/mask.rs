//! A Nav2 keepout mask over the rooms of a map: the probability that a room is occupied, as a cost that is never lethal.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use roomcast_core::grounding::Partition;
use roomcast_core::semantic_map::{Storey, Storeys};
use roomcast_ros2::types::{Header, MapMetaData, OccupancyGrid, Point, Pose, Quaternion};

/// The value of a room that is certainly occupied. Nav2's keepout filter maps 100 to the lethal cost 254; this becomes 249, below the costs that a
/// robot's body must not touch.
pub const MOST: i8 = 98;
/// Most cells of a map.
pub const CELLS_MAX: u64 = 16_000_000;
/// Most bytes of a map's YAML file.
const YAML_BYTES_MAX: u64 = 64 << 10;

/// Why a Nav2 map cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}; ros2.map is the YAML file that nav2_map_server loads, with its PGM image beside it")]
pub struct MapError {
    path: PathBuf,
    problem: String,
}

/// The storey of a map is ambiguous.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the storeys of ros2.scene: {storeys}; ros2.floor_m says in metres which of these floors ros2.map is of")]
pub struct StoreyError {
    storeys: String,
}

/// Tolerance of a floor's height in metres.
const FLOOR_M: f64 = 1.0;

/// The storey with a floor at this height. Without a height, the scene must have only one storey.
///
/// # Errors
///
/// [`StoreyError`].
pub fn storey(storeys: &Storeys, floor_m: Option<f64>) -> Result<usize, StoreyError> {
    let apart_m = |floor_m: f64| move |(_, storey): &(usize, &Storey)| (storey.floor_m - floor_m).abs();
    let all = storeys.all();
    let storey = match floor_m {
        None if all.len() < 2 => Some(0),
        None => None,
        Some(floor_m) => {
            let apart_m = apart_m(floor_m);
            let nearest = (0..).zip(all).min_by(|a, b| apart_m(a).total_cmp(&apart_m(b)));
            nearest.filter(|nearest| apart_m(nearest) <= FLOOR_M).map(|(storey, _)| storey)
        }
    };
    let names = || all.iter().map(Storey::name).collect::<Vec<_>>().join(", ");
    storey.ok_or_else(|| StoreyError { storeys: names() })
}

/// Place and size of a Nav2 map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Metres per cell.
    pub resolution_m: f64,
    /// Cells from west to east.
    pub width: u32,
    /// Cells from south to north.
    pub height: u32,
    /// The lower left corner: x and y in metres, and the rotation in radians.
    pub origin: [f64; 3],
}

impl Grid {
    /// Reads a map's YAML file, and the size of its PGM image.
    ///
    /// # Errors
    ///
    /// [`MapError`].
    pub fn load(path: &Path) -> Result<Self, MapError> {
        let fault = |path: &Path, problem: String| MapError { path: path.to_owned(), problem };
        let mut text = String::new();
        let file = fs::File::open(path).map_err(|error| fault(path, error.to_string()))?;
        file.take(YAML_BYTES_MAX).read_to_string(&mut text).map_err(|error| fault(path, error.to_string()))?;
        let value = |key: &str| {
            let found = text.lines().find_map(|line| line.trim().strip_prefix(key)?.trim_start().strip_prefix(':'));
            let found = found.map(|value| value.split(" #").next().unwrap_or("").trim().trim_matches(['"', '\'']));
            found.filter(|value| !value.is_empty()).ok_or_else(|| fault(path, format!("{key} is missing")))
        };
        let number = |key: &str, text: &str| {
            let number = text.trim().parse::<f64>().ok().filter(|number| number.is_finite());
            number.ok_or_else(|| fault(path, format!("{key}: {text:?} is no number")))
        };
        let resolution_m = number("resolution", value("resolution")?)?;
        if !(0.001..=10.0).contains(&resolution_m) {
            return Err(fault(path, format!("resolution: {resolution_m} is no size of a cell, 0.001 to 10 m")));
        }
        let origin = value("origin")?.trim_matches(['[', ']']);
        let numbers = origin.split(',').map(|text| number("origin", text)).collect::<Result<Vec<_>, _>>()?;
        let origin = <[f64; 3]>::try_from(numbers).map_err(|_| fault(path, "origin: three numbers".to_owned()))?;
        let image = path.parent().unwrap_or(Path::new("")).join(value("image")?);
        let (width, height) = pgm_size(&image).map_err(|problem| fault(&image, problem))?;
        if u64::from(width) * u64::from(height) > CELLS_MAX || width == 0 || height == 0 {
            return Err(fault(&image, format!("{width} times {height} cells, 1 to {CELLS_MAX}")));
        }
        Ok(Self { resolution_m, width, height, origin })
    }

    fn centre_m(&self, column: u32, row: u32) -> [f64; 2] {
        let [x, y, turn] = self.origin;
        let (across, up) = ((f64::from(column) + 0.5) * self.resolution_m, (f64::from(row) + 0.5) * self.resolution_m);
        [x + across * turn.cos() - up * turn.sin(), y + across * turn.sin() + up * turn.cos()]
    }
}

fn pgm_size(path: &Path) -> Result<(u32, u32), String> {
    let mut head = Vec::new();
    let file = fs::File::open(path).map_err(|error| error.to_string())?;
    file.take(4096).read_to_end(&mut head).map_err(|error| error.to_string())?;
    if !head.starts_with(b"P5") && !head.starts_with(b"P2") {
        return Err("no PGM image".to_owned());
    }
    let text = String::from_utf8_lossy(&head[2..]).into_owned();
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or(""));
    let mut words = lines.flat_map(str::split_whitespace);
    let mut next = || words.next().and_then(|word| word.parse().ok()).ok_or_else(|| "its head has no size".to_owned());
    Ok((next()?, next()?))
}

/// The room of each cell of a grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    grid: Grid,
    room: Vec<Option<u16>>,
}

impl Mask {
    /// Assigns each cell to the storey's room at its centre. Scene and map have one frame.
    #[must_use]
    pub fn new(grid: Grid, rooms: &[Partition], storeys: &Storeys, storey: usize) -> Self {
        let cells = (0..grid.height).flat_map(|row| (0..grid.width).map(move |column| (column, row)));
        let of = |(column, row)| {
            let [x, y] = grid.centre_m(column, row);
            let within = |room: &Partition| {
                let mut spaces = room.spaces.iter().filter(|space| storeys.of_space(space) == storey);
                spaces.any(|space| space.contains(&[x, y, space.centre_m()[2]]))
            };
            rooms.iter().position(within).and_then(|room| u16::try_from(room).ok())
        };
        Self { grid, room: cells.map(of).collect() }
    }

    /// The grid of values, one for each room.
    #[must_use]
    pub fn draw(&self, values: &[i8], header: Header) -> OccupancyGrid {
        let [x, y, turn] = self.grid.origin;
        let orientation = Quaternion { z: (turn / 2.0).sin(), w: (turn / 2.0).cos(), ..Quaternion::default() };
        let info = MapMetaData {
            map_load_time: header.stamp,
            resolution: self.grid.resolution_m as f32,
            width: self.grid.width,
            height: self.grid.height,
            origin: Pose { position: Point { x, y, z: 0.0 }, orientation },
        };
        let value = |room: &Option<u16>| room.and_then(|room| values.get(usize::from(room))).copied().unwrap_or(0);
        OccupancyGrid { header, info, data: self.room.iter().map(value).collect() }
    }
}

/// A room's value for the probability that it is occupied, in steps of five so that masks are sent seldom.
#[must_use]
pub fn value(probability: f64) -> i8 {
    let steps = (probability.clamp(0.0, 1.0) * 20.0).round() as i8;
    (steps * 5).min(MOST)
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::{PartitionLevel, partitions};
    use roomcast_core::semantic_map::SemanticMap;

    use super::*;

    fn scene() -> SemanticMap {
        SemanticMap::load(Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/two_rooms.json")).unwrap()
    }

    fn mask(grid: Grid) -> (Vec<Partition>, Mask) {
        let (scene, rooms) = (scene(), partitions(&scene(), PartitionLevel::Room));
        let mask = Mask::new(grid, &rooms, &Storeys::of(&scene), 0);
        (rooms, mask)
    }

    /// Regression: a robot was kept out of the kitchen because of a person in the bedroom above.
    #[test]
    fn a_mask_has_the_rooms_of_one_storey() {
        let room = |id: &str, floor_m: f64| serde_json::json!({"id": id, "label": id, "box": {"min_m": [0.0, 0.0, floor_m], "max_m": [4.0, 4.0, floor_m + 2.5]}});
        let text = serde_json::json!({
            "format": "roomcast-scene", "version": 1, "name": "home", "doors": [], "items": [],
            "rooms": [room("bedroom", 2.6), room("kitchen", 0.0), room("cellar", -2.6)],
        });
        let scene = SemanticMap::from_json(&text.to_string()).unwrap();
        let (rooms, storeys) = (partitions(&scene, PartitionLevel::Room), Storeys::of(&scene));
        let grid = Grid { resolution_m: 1.0, width: 5, height: 1, origin: [0.0, 0.0, 0.0] };
        let values: Vec<i8> = rooms
            .iter()
            .map(|room| ["bedroom", "kitchen", "cellar"].iter().position(|id| room.id == *id).unwrap() as i8 + 1)
            .collect();
        for (floor_m, value) in [(2.5, 1), (0.0, 2), (-0.3, 2), (-2.6, 3)] {
            let storey = storey(&storeys, Some(floor_m)).unwrap();
            let drawn = Mask::new(grid, &rooms, &storeys, storey).draw(&values, Header::default());
            assert_eq!(drawn.data, [value, value, value, value, 0], "{floor_m}");
        }
        for unknown in [None, Some(9.0), Some(-1.3)] {
            let error = storey(&storeys, unknown).unwrap_err().to_string();
            assert!(error.contains("floor at -2.6 m, floor at 0 m, floor at 2.6 m; ros2.floor_m"), "{error}");
        }
        let flat = Storeys::of(&self::scene());
        assert_eq!(storey(&flat, None), Ok(0));
    }

    #[test]
    fn no_cost_is_lethal() {
        for percent in -10..120 {
            assert!((0..=MOST).contains(&value(f64::from(percent) / 100.0)));
        }
        assert_eq!((value(0.0), value(0.5), value(1.0), value(f64::NAN)), (0, 50, MOST, 0));
    }

    #[test]
    fn cells_have_their_rooms_value_and_others_nothing() {
        let [left, bottom, _] = scene().rooms()[0].space.bounds.min_m;
        let grid = Grid { resolution_m: 0.5, width: 40, height: 40, origin: [left - 1.0, bottom - 1.0, 0.0] };
        let (rooms, drawn) = mask(grid);
        let drawn = drawn.draw(&[98, 5], Header::default());
        assert_eq!((drawn.data.len(), drawn.data[0]), (1600, 0));
        let at = |room: usize| {
            let [x, y, _] = rooms[room].spaces[0].centre_m();
            let cell = |along: f64, from: f64| ((along - from) / 0.5) as usize;
            drawn.data[cell(y, bottom - 1.0) * 40 + cell(x, left - 1.0)]
        };
        assert_eq!((at(0), at(1)), (98, 5));
        // A map that is rotated by 90 degrees has the same rooms.
        let turned = Grid { origin: [left + 19.0, bottom - 1.0, std::f64::consts::FRAC_PI_2], ..grid };
        let mut values = mask(turned).1.draw(&[98, 5], Header::default()).data;
        let mut before = drawn.data;
        values.sort_unstable();
        before.sort_unstable();
        assert_eq!(values, before);
    }

    #[test]
    fn a_map_of_nav2_is_read_and_what_is_none_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let yaml = folder.path().join("map.yaml");
        fs::write(folder.path().join("map.pgm"), b"P5\n# made by hand\n30 20\n255\n\0").unwrap();
        let good = "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2, 0]\nnegate: 0\n";
        fs::write(&yaml, good).unwrap();
        let grid = Grid::load(&yaml).unwrap();
        assert_eq!(grid, Grid { resolution_m: 0.05, width: 30, height: 20, origin: [-1.5, 2.0, 0.0] });
        for (from, to, says) in [
            ("resolution: 0.05", "", "resolution is missing"),
            ("0.05", "0", "no size of a cell"),
            ("[-1.5, 2, 0]", "[nan, 2, 0]", "no number"),
            ("[-1.5, 2, 0]", "[1, 2]", "three numbers"),
            ("map.pgm", "map.png", "map.png"),
        ] {
            fs::write(&yaml, good.replace(from, to)).unwrap();
            let fault = Grid::load(&yaml).unwrap_err().to_string();
            assert!(fault.contains(says), "{fault}");
        }
        fs::write(&yaml, good).unwrap();
        fs::write(folder.path().join("map.pgm"), b"P5\n4000000000 4000000000\n255\n").unwrap();
        assert!(Grid::load(&yaml).is_err());
    }
}
