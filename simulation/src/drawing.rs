//! The map from above, as SVG: rooms, doors, furniture and small things. With scores, it shows the heat of each.
//!
//! Drawing is a pure function of map, grounding and scores.

use std::fmt::Write as _;

use svg::Document;
use svg::node::element::{Circle, Group, Line, Path, Rectangle, Text};

use roomcast_core::grounding::Grounding;
use roomcast_core::semantic_map::{Box3, Footprint, SemanticMap, Space, Storeys};
use roomcast_core::text::count;

mod names;
mod panel;

use panel::warmest;

/// The font of all drawings; `png.rs` compiles it in.
pub const FONT: &str = "DejaVu Sans";
/// Sizes of a room's name, in pixels; the first that fits the room's width is used. With many rooms, the first two are left out.
const NAME_PX: [f64; 5] = [17.0, 14.0, 12.0, 10.5, 9.0];
/// Least space between a room's width and its name, in pixels.
const NAME_MARGIN_PX: f64 = 24.0;
/// Factor of the width of bold letters.
const BOLDER: f64 = 1.17;
const PLAN_PX: [f64; 2] = [1_120.0, 860.0];
const MARGIN_PX: f64 = 36.0;
const TITLE_PX: f64 = 76.0;
const PANEL_PX: f64 = 300.0;
const FOOT_PX: f64 = 56.0;
/// Height of the names of storeys, in pixels.
const STOREY_PX: f64 = 26.0;

const INK: &str = "#20242b";
const QUIET: &str = "#6d7480";
const PAPER: &str = "#ffffff";
const FLOOR: &str = "#f6f2ea";
const WALL: &str = "#3b414b";
const FURNITURE: &str = "#fffdf8";
const RUG: &str = "#e6dcc6";
const EDGE: &str = "#a9a292";
const DOT: &str = "#8b8574";
const HEAT: [[f64; 3]; 6] = [
    [253.0, 248.0, 238.0],
    [254.0, 226.0, 172.0],
    [253.0, 187.0, 112.0],
    [244.0, 127.0, 72.0],
    [212.0, 56.0, 38.0],
    [139.0, 10.0, 26.0],
];

/// Items of the building itself. They are not drawn as things.
const STRUCTURE: [&str; 6] = ["wall", "floor", "ceiling", "door jamb", "doorjamb", "door"];
/// Things with at least this longest side are drawn as boxes, others as dots; metres.
const FURNITURE_FROM_M: f64 = 0.42;
/// Width of a door; metres.
const DOOR_M: f64 = 0.84;
/// Largest distance between a door and the wall with its gap; metres. A robot's map has unseen space between two rooms.
const WALL_M: f64 = 0.4;
/// Things that begin above this height hang from the ceiling; metres. They are drawn as dots, so that no lamp or cupboard hides the floor.
const OVERHEAD_M: f64 = 1.85;

/// The scores that a drawing shows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Heat {
    /// The probability of each partition.
    pub partition_probability: Vec<f64>,
    /// The share of each item in the scores of all items.
    pub item_share: Vec<f64>,
    /// A line under the title, such as the last sentence of the narration; may be empty.
    pub caption: String,
}

impl Heat {
    /// Heat from log scores of items: ln s_i in nats, relative to one another.
    #[must_use]
    pub fn new(partition_probability: &[f64], item_log_score_nats: &[f64], caption: &str) -> Self {
        let largest = item_log_score_nats.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let relative = |log_score: &f64| if largest.is_finite() { (log_score - largest).exp() } else { 0.0 };
        let total: f64 = item_log_score_nats.iter().map(relative).sum();
        let share = |log_score: &f64| if total > 0.0 { relative(log_score) / total } else { 0.0 };
        Self {
            partition_probability: partition_probability.to_vec(),
            item_share: item_log_score_nats.iter().map(share).collect(),
            caption: caption.to_owned(),
        }
    }
}

/// A drawing failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DrawingError {
    /// The scores are from another map or another level.
    #[error(
        "the scores are of {partitions} partitions and {items} items, the map has {expected_partitions} and \
         {expected_items}; draw the scene and the level that were scored"
    )]
    OtherMap {
        /// Partitions of the scores.
        partitions: usize,
        /// Items of the scores.
        items: usize,
        /// Partitions of the map.
        expected_partitions: usize,
        /// Items of the map.
        expected_items: usize,
    },
}

/// The plan as SVG text.
///
/// # Errors
/// [`DrawingError::OtherMap`].
pub fn svg(map: &SemanticMap, grounding: &Grounding, heat: Option<&Heat>) -> Result<String, DrawingError> {
    if let Some(heat) = heat {
        let (partitions, items) = (heat.partition_probability.len(), heat.item_share.len());
        let (expected_partitions, expected_items) = (grounding.partitions().len(), map.items().len());
        if (partitions, items) != (expected_partitions, expected_items) {
            return Err(DrawingError::OtherMap { partitions, items, expected_partitions, expected_items });
        }
    }
    Ok(Plan::new(map, grounding, heat).draw().to_string())
}

/// A rectangle in pixels, to keep labels apart.
#[derive(Clone, Copy)]
struct Area {
    left: f64,
    top: f64,
    right: f64,
    bottom: f64,
}

impl Area {
    fn around(x: f64, y: f64, width: f64, height: f64) -> Self {
        Self { left: x - width / 2.0, right: x + width / 2.0, top: y - height / 2.0, bottom: y + height / 2.0 }
    }

    fn meets(&self, other: &Self) -> bool {
        self.left < other.right && other.left < self.right && self.top < other.bottom && other.top < self.bottom
    }

    fn within(&self, other: &Self) -> bool {
        self.left >= other.left && self.right <= other.right && self.top >= other.top && self.bottom <= other.bottom
    }
}

/// The approximate width in pixels of a text in DejaVu Sans, to keep labels apart.
fn width_px(text: &str, size_px: f64) -> f64 {
    let em = |character: char| match character {
        'i' | 'j' | 'l' | '.' | ',' | '\'' | '|' | ':' => 0.31,
        ' ' | 't' | 'f' | 'r' | '(' | ')' | '-' => 0.41,
        'm' | 'w' | 'M' | 'W' | '%' => 0.92,
        'A'..='Z' => 0.70,
        _ => 0.61,
    };
    size_px * text.chars().map(em).sum::<f64>()
}

fn shortened(text: &str, size_px: f64, most_px: f64) -> String {
    if width_px(text, size_px) <= most_px {
        return text.to_owned();
    }
    let mut short = String::new();
    for character in text.chars() {
        if width_px(&short, size_px) + 2.0 * size_px > most_px {
            break;
        }
        short.push(character);
    }
    format!("{}\u{2026}", short.trim_end())
}

fn colour(heat: f64) -> String {
    let place = heat.clamp(0.0, 1.0) * (HEAT.len() - 1) as f64;
    let lower = (place as usize).min(HEAT.len() - 2);
    let part = place - lower as f64;
    let channel = |index: usize| (HEAT[lower][index] * (1.0 - part) + HEAT[lower + 1][index] * part).round() as u8;
    format!("#{:02x}{:02x}{:02x}", channel(0), channel(1), channel(2))
}

fn percent(probability: f64) -> String {
    let percent = 100.0 * probability;
    if percent >= 9.95 || percent == 0.0 {
        format!("{percent:.0} %")
    } else if percent >= 0.1 {
        format!("{percent:.1} %")
    } else {
        "< 0.1 %".to_owned()
    }
}

struct Label<'a> {
    text: &'a str,
    size_px: f64,
    colour: &'a str,
    bold: bool,
    anchor: &'a str,
    halo: bool,
}

impl<'a> Label<'a> {
    fn new(text: &'a str, size_px: f64) -> Self {
        Self { text, size_px, colour: INK, bold: false, anchor: "start", halo: false }
    }

    fn at(&self, x: f64, y: f64) -> Text {
        let text = Text::new(self.text)
            .set("x", rounded(x))
            .set("y", rounded(y + 0.36 * self.size_px))
            .set("font-size", self.size_px)
            .set("text-anchor", self.anchor)
            .set("fill", self.colour);
        let text = if self.bold { text.set("font-weight", "bold") } else { text };
        if self.halo {
            text.set("stroke", PAPER)
                .set("stroke-width", 3.5)
                .set("stroke-linejoin", "round")
                .set("paint-order", "stroke")
        } else {
            text
        }
    }
}

fn rounded(pixels: f64) -> f64 {
    (pixels * 10.0).round() / 10.0
}

struct Thing {
    /// Heights are above the floor of its storey.
    bounds: Box3,
    position_m: [f64; 2],
    storey: usize,
}

enum Door {
    /// The numbers of the rooms.
    Wall { position_m: [f64; 2], rooms: [usize; 2] },
    /// A place on each storey.
    Stairs([[f64; 2]; 2]),
}

impl Door {
    fn places_m(&self) -> impl Iterator<Item = [f64; 2]> {
        let (first, second) = match self {
            Self::Wall { position_m, .. } => (*position_m, None),
            Self::Stairs([lower, upper]) => (*lower, Some(*upper)),
        };
        std::iter::once(first).chain(second)
    }
}

struct Plan<'a> {
    map: &'a SemanticMap,
    grounding: &'a Grounding,
    heat: Option<&'a Heat>,
    largest_share: f64,
    storeys: Storeys,
    /// The spaces of the map and of its partitions on the plan, with the storeys side by side.
    rooms: Vec<Space>,
    parts: Vec<Space>,
    things: Vec<Thing>,
    doors: Vec<Door>,
    partitions: Vec<Vec<Space>>,
    scale: f64,
    /// West and north end of the plan, in metres.
    origin_m: [f64; 2],
    top_px: f64,
    size_px: [f64; 2],
    taken: Vec<Area>,
}

impl<'a> Plan<'a> {
    fn new(map: &'a SemanticMap, grounding: &'a Grounding, heat: Option<&'a Heat>) -> Self {
        let storeys = Storeys::of(map);
        // Only rooms set the frame: an item far outside would make them tiny.
        let (mut min_m, mut max_m) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for storey in storeys.all() {
            for axis in 0..2 {
                min_m[axis] = min_m[axis].min(storey.min_m[axis]);
                max_m[axis] = max_m[axis].max(storey.max_m[axis]);
            }
        }
        let moved = |space: &Space| storeys.moved_space(space);
        let things = map.items().iter().map(|item| {
            let (storey, [east_m, north_m, _]) = (storeys.of_item(map, item), item.position_m);
            let mut bounds = storeys.moved_box(storey, &item.bounds);
            for corner in [&mut bounds.min_m, &mut bounds.max_m] {
                corner[2] -= storeys.all()[storey].floor_m;
            }
            Thing { bounds, position_m: storeys.moved(storey, [east_m, north_m]), storey }
        });
        let doors = map.doors().iter().map(|door| {
            let [east_m, north_m, _] = door.position_m;
            let rooms = door.rooms.map(|room| room.0 as usize);
            let on = rooms.map(|room| storeys.of_space(&map.rooms()[room].space));
            let [first, second] = on.map(|storey| storeys.moved(storey, [east_m, north_m]));
            match on[0] == on[1] {
                true => Door::Wall { position_m: first, rooms },
                false => Door::Stairs([first, second]),
            }
        });
        let size_m = [max_m[0] - min_m[0], max_m[1] - min_m[1]];
        let scale = (PLAN_PX[0] / size_m[0]).min(PLAN_PX[1] / size_m[1]);
        Self {
            map,
            grounding,
            heat,
            largest_share: heat.map_or(0.0, |heat| heat.item_share.iter().copied().fold(0.0, f64::max)),
            rooms: map.rooms().iter().map(|room| moved(&room.space)).collect(),
            parts: map.parts().iter().map(|part| moved(&part.space)).collect(),
            things: things.collect(),
            doors: doors.collect(),
            partitions: grounding.partitions().iter().map(|own| own.spaces.iter().map(moved).collect()).collect(),
            scale,
            origin_m: [min_m[0], max_m[1]],
            top_px: TITLE_PX + if storeys.all().len() > 1 { STOREY_PX } else { 0.0 },
            storeys,
            size_px: size_m.map(|metres| metres * scale),
            taken: Vec::new(),
        }
    }

    fn x(&self, east_m: f64) -> f64 {
        MARGIN_PX + (east_m - self.origin_m[0]) * self.scale
    }

    fn y(&self, north_m: f64) -> f64 {
        self.top_px + (self.origin_m[1] - north_m) * self.scale
    }

    fn east_m(&self, x: f64) -> f64 {
        (x - MARGIN_PX) / self.scale + self.origin_m[0]
    }

    fn north_m(&self, y: f64) -> f64 {
        self.origin_m[1] - (y - self.top_px) / self.scale
    }

    fn area(&self, bounds: &Box3) -> Area {
        Area {
            left: self.x(bounds.min_m[0]),
            right: self.x(bounds.max_m[0]),
            top: self.y(bounds.max_m[1]),
            bottom: self.y(bounds.min_m[1]),
        }
    }

    fn frame(&self, storey: usize) -> Area {
        let storey = &self.storeys.all()[storey];
        Area {
            left: self.x(storey.min_m[0]),
            right: self.x(storey.max_m[0]),
            top: self.y(storey.max_m[1]),
            bottom: self.y(storey.min_m[1]),
        }
    }

    fn rectangle(&self, bounds: &Box3) -> Rectangle {
        let area = self.area(bounds);
        Rectangle::new()
            .set("x", rounded(area.left))
            .set("y", rounded(area.top))
            .set("width", rounded(area.right - area.left))
            .set("height", rounded(area.bottom - area.top))
    }

    /// The outline of a room, part or group, without its holes.
    fn outline(&self, space: &Space) -> Path {
        let mut steps = String::new();
        for ring in space.rings() {
            for (index, [east_m, north_m]) in ring.into_iter().enumerate() {
                let step = if index == 0 { 'M' } else { 'L' };
                let _ = write!(steps, "{step} {} {} ", rounded(self.x(east_m)), rounded(self.y(north_m)));
            }
            steps.push_str("Z ");
        }
        Path::new().set("d", steps.trim_end()).set("fill-rule", "evenodd")
    }

    fn draw(mut self) -> Document {
        let panel_left = MARGIN_PX + self.size_px[0] + MARGIN_PX;
        let width = panel_left + PANEL_PX + MARGIN_PX;
        let panel = self.panel(panel_left);
        let height = (self.top_px + self.size_px[1] + FOOT_PX).max(panel.1 + 24.0);
        let names = self.partition_names();
        let furniture_names = self.furniture_names();
        let marked = self.marked_items();
        Document::new()
            .set("viewBox", (0, 0, rounded(width), rounded(height)))
            .set("width", rounded(width))
            .set("height", rounded(height))
            .set("font-family", format!("'{FONT}', Verdana, sans-serif"))
            .add(Rectangle::new().set("width", "100%").set("height", "100%").set("fill", PAPER))
            .add(self.title(width))
            .add(self.floors())
            .add(self.furniture())
            .add(self.walls())
            .add(self.dots())
            .add(furniture_names)
            .add(names)
            .add(marked)
            .add(self.scale_bar())
            .add(panel.0)
    }

    fn title(&self, width: f64) -> Group {
        let map = self.map;
        let facts = format!(
            "{}, {}, {} \u{b7} map {}",
            count(map.items().len(), "item"),
            count(map.labels().len(), "label"),
            count(map.rooms().len(), "room"),
            map.short_fingerprint()
        );
        let caption = self.heat.map(|heat| heat.caption.as_str()).filter(|caption| !caption.is_empty());
        let line = caption.unwrap_or(&facts);
        let name = shortened(map.name(), 24.0, width - 2.0 * MARGIN_PX);
        let line = shortened(line, 13.0, width - 2.0 * MARGIN_PX);
        Group::new()
            .add(Label { bold: true, ..Label::new(&name, 24.0) }.at(MARGIN_PX, 30.0))
            .add(Label { colour: QUIET, ..Label::new(&line, 13.0) }.at(MARGIN_PX, 54.0))
    }

    fn floors(&self) -> Group {
        let mut floors = Group::new();
        for room in &self.rooms {
            floors = floors.add(self.outline(room).set("fill", FLOOR));
        }
        for (index, spaces) in self.partitions.iter().enumerate() {
            for space in spaces {
                let floor = self.outline(space);
                floors = floors.add(match self.heat {
                    Some(heat) => floor.set("fill", colour(heat.partition_probability[index])).set("fill-opacity", 0.8),
                    None => floor.set("fill", FLOOR),
                });
            }
        }
        floors
    }

    fn walls(&self) -> Group {
        let mut walls = Group::new();
        for part in &self.parts {
            let outline = self.outline(part);
            walls = walls.add(outline.set("fill", "none").set("stroke", QUIET).set("stroke-dasharray", "3 5"));
        }
        for room in &self.rooms {
            let outline = self.outline(room);
            walls = walls.add(
                outline.set("fill", "none").set("stroke", WALL).set("stroke-width", 5).set("stroke-linejoin", "round"),
            );
        }
        for door in &self.doors {
            walls = walls.add(match door {
                Door::Wall { position_m, rooms } => self.door(position_m, rooms.map(|room| &self.rooms[room])),
                Door::Stairs(places_m) => {
                    let stairs = places_m.iter().map(|[east_m, north_m]| stairs(self.x(*east_m), self.y(*north_m)));
                    stairs.fold(Group::new(), Group::add)
                }
            });
        }
        if self.storeys.all().len() > 1 { walls.add(self.storey_names()) } else { walls }
    }

    fn storey_names(&self) -> Group {
        let mut names = Group::new();
        for storey in self.storeys.all() {
            let (left, top) = (self.x(storey.min_m[0]), self.y(storey.max_m[1]));
            let most_px = (self.x(storey.max_m[0]) - left).max(120.0);
            let name = shortened(&storey.name(), 13.0, most_px);
            names = names.add(Label { colour: QUIET, ..Label::new(&name, 13.0) }.at(left, top - 14.0));
        }
        names
    }

    /// A gap in the nearest wall of each of the rooms, with the leaf and its swing.
    fn door(&self, position_m: &[f64; 2], rooms: [&Space; 2]) -> Group {
        let walls = rooms.map(|room| wall(room, position_m));
        let nearest = if walls[1].distance_m < walls[0].distance_m { &walls[1] } else { &walls[0] };
        let mut door = Group::new();
        for wall in walls.iter().filter(|wall| wall.distance_m <= WALL_M || std::ptr::eq(*wall, nearest)) {
            let [[x1, y1], [x2, y2]] = self.gap(wall);
            let line = Line::new().set("x1", rounded(x1)).set("y1", rounded(y1));
            let line = line.set("x2", rounded(x2)).set("y2", rounded(y2));
            door = door.add(line.set("stroke", PAPER).set("stroke-width", 7));
        }
        let [hinge, end] = self.gap(nearest);
        let (across, down) = (end[0] - hinge[0], end[1] - hinge[1]);
        let swing = format!(
            "M {} {} L {} {} A {r} {r} 0 0 1 {} {}",
            rounded(hinge[0]),
            rounded(hinge[1]),
            rounded(hinge[0] + down),
            rounded(hinge[1] - across),
            rounded(end[0]),
            rounded(end[1]),
            r = rounded(across.hypot(down)),
        );
        door.add(Path::new().set("d", swing).set("fill", "none").set("stroke", WALL).set("stroke-width", 1.2))
    }

    /// The two ends of a door's gap in a wall, in pixels, from the left or from the top.
    fn gap(&self, wall: &Wall) -> [[f64; 2]; 2] {
        let half_m = 0.5 * DOOR_M.min(wall.length_m);
        let middle_m = wall.along_m.clamp(half_m, wall.length_m - half_m);
        let end = |along_m: f64| {
            let [east_m, north_m] = [0, 1].map(|axis| wall.from_m[axis] + along_m * wall.way[axis]);
            [self.x(east_m), self.y(north_m)]
        };
        let [from, to] = [end(middle_m - half_m), end(middle_m + half_m)];
        if from[0] + from[1] <= to[0] + to[1] { [from, to] } else { [to, from] }
    }

    fn is_structure(&self, index: usize) -> bool {
        let label = self.map.items()[index].label;
        STRUCTURE.contains(&self.map.labels()[label.0 as usize].as_str())
    }

    fn is_furniture(&self, index: usize) -> bool {
        let bounds = &self.things[index].bounds;
        let size_m = bounds.size_m();
        let large = size_m[0].max(size_m[1]) >= FURNITURE_FROM_M && size_m[0].min(size_m[1]) > 0.05;
        large && bounds.min_m[2] < OVERHEAD_M && !self.is_structure(index)
    }

    fn heat_of(&self, index: usize) -> Option<f64> {
        let share = self.heat?.item_share[index];
        // A few items have nearly all of the score; the square root keeps the others distinguishable.
        Some(if self.largest_share > 0.0 { (share / self.largest_share).sqrt() } else { 0.0 })
    }

    /// Indices of large things; a thing follows the thing that it stands on.
    fn furniture_order(&self) -> Vec<usize> {
        let things = &self.things;
        let mut order: Vec<usize> = (0..things.len()).filter(|&index| self.is_furniture(index)).collect();
        // A headboard is higher than the blanket on its bed, so the lower edge counts first, in steps that tolerate a millimetre.
        let key = |index: usize| ((things[index].bounds.min_m[2] * 20.0).round(), things[index].bounds.max_m[2]);
        let compare = |(a0, a1): (f64, f64), (b0, b1): (f64, f64)| a0.total_cmp(&b0).then(a1.total_cmp(&b1));
        order.sort_by(|&a, &b| compare(key(a), key(b)));
        order
    }

    fn furniture(&self) -> Group {
        let mut furniture = Group::new().set("stroke-width", 1);
        for index in self.furniture_order() {
            let bounds = &self.things[index].bounds;
            // A rug is below everything and hides nothing.
            let flat = bounds.max_m[2] < 0.1;
            let cold = if flat { RUG } else { FURNITURE };
            furniture = furniture.add(
                self.rectangle(bounds)
                    .set("rx", 3)
                    .set("fill", self.heat_of(index).map_or_else(|| cold.to_owned(), colour))
                    .set("fill-opacity", if flat { 0.6 } else { 0.9 })
                    .set("stroke", EDGE),
            );
        }
        furniture
    }

    /// Small things, the warm ones larger and above the others.
    fn dots(&self) -> Group {
        let small = |index: &usize| !self.is_furniture(*index) && !self.is_structure(*index);
        let mut order: Vec<usize> = (0..self.map.items().len()).filter(small).collect();
        order.sort_by(|&a, &b| self.heat_of(a).unwrap_or(0.0).total_cmp(&self.heat_of(b).unwrap_or(0.0)));
        let mut dots = Group::new();
        for index in order {
            let Thing { position_m: [east_m, north_m], storey, .. } = self.things[index];
            let (x, y) = (self.x(east_m), self.y(north_m));
            if !Area::around(x, y, 0.0, 0.0).within(&self.frame(storey)) {
                continue;
            }
            let dot = Circle::new().set("cx", rounded(x)).set("cy", rounded(y));
            dots = dots.add(match self.heat_of(index) {
                Some(heat) => {
                    let dot = dot.set("r", rounded(2.2 + 4.0 * heat)).set("fill", colour(0.12 + 0.88 * heat));
                    dot.set("stroke", INK).set("stroke-width", 0.5).set("stroke-opacity", 0.25 + 0.6 * heat)
                }
                None => dot.set("r", 2.2).set("fill", DOT).set("fill-opacity", 0.7),
            });
        }
        dots
    }

    /// With heat: names of the small things that have most of it.
    fn marked_items(&mut self) -> Group {
        let mut marks = Group::new();
        let Some(heat) = self.heat else { return marks };
        const MOST: usize = 14;
        for index in warmest(&heat.item_share, MOST) {
            let warm = self.heat_of(index).is_some_and(|heat| heat > 0.2);
            if !warm || self.is_structure(index) || self.is_furniture(index) {
                continue;
            }
            let Thing { position_m: [east_m, north_m], storey, .. } = self.things[index];
            let (x, y) = (self.x(east_m), self.y(north_m));
            let text = &self.map.labels()[self.map.items()[index].label.0 as usize];
            let (size_px, width) = (11.5, width_px(text, 11.5) + 4.0);
            let places = [
                (0.0, -13.0),
                (0.0, 14.0),
                (width / 2.0 + 9.0, 0.0),
                (-width / 2.0 - 9.0, 0.0),
                (0.0, -26.0),
                (0.0, 27.0),
            ];
            let frame = self.frame(storey);
            let free = places
                .iter()
                .map(|(dx, dy)| Area::around(x + dx, y + dy, width, size_px + 2.0))
                .find(|place| place.within(&frame) && !self.taken.iter().any(|taken| taken.meets(place)));
            if let Some(place) = free {
                let label = Label { bold: true, anchor: "middle", halo: true, ..Label::new(text, size_px) };
                marks = marks.add(label.at((place.left + place.right) / 2.0, (place.top + place.bottom) / 2.0));
                self.taken.push(place);
            }
        }
        marks
    }

    fn scale_bar(&self) -> Group {
        let most_m = 160.0 / self.scale;
        let length_m = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1_000.0, 5_000.0];
        let length_m = length_m.into_iter().rfind(|length_m| *length_m <= most_m).unwrap_or(0.1);
        let (left, y) = (MARGIN_PX, self.top_px + self.size_px[1] + 26.0);
        let right = left + length_m * self.scale;
        let line = format!("M {left} {} V {y} H {} V {}", y - 6.0, rounded(right), y - 6.0);
        let text = format!("{length_m} m");
        let north = MARGIN_PX + self.size_px[0] - 10.0;
        Group::new()
            .add(Path::new().set("d", line).set("fill", "none").set("stroke", INK).set("stroke-width", 1.5))
            .add(Label { colour: QUIET, ..Label::new(&text, 12.0) }.at(right + 8.0, y - 3.0))
            .add(Path::new().set("d", format!("M {north} {} l 6 16 l -6 -4 l -6 4 z", y - 14.0)).set("fill", INK))
            .add(Label { colour: QUIET, anchor: "end", ..Label::new("north", 12.0) }.at(north - 12.0, y - 5.0))
    }
}

/// A way to another storey: a few steps.
fn stairs(x: f64, y: f64) -> Group {
    const HALF_PX: f64 = 8.0;
    let (left, right) = (rounded(x - HALF_PX), rounded(x + HALF_PX));
    let steps = [-HALF_PX, -0.5 * HALF_PX, 0.0, 0.5 * HALF_PX, HALF_PX].map(|down| rounded(y + down));
    let mut lines = String::new();
    for step in steps {
        let _ = write!(lines, "M {left} {step} H {right} ");
    }
    let _ = write!(lines, "M {left} {} V {} M {right} {} V {}", steps[0], steps[4], steps[0], steps[4]);
    Group::new().add(Path::new().set("d", lines).set("fill", "none").set("stroke", WALL).set("stroke-width", 1.2))
}

fn floor_m2(space: &Space) -> f64 {
    let size_m = space.size_m();
    space.footprint.as_ref().map_or(size_m[0] * size_m[1], Footprint::area_m2)
}

struct Wall {
    distance_m: f64,
    from_m: [f64; 2],
    /// Its direction, of length 1.
    way: [f64; 2],
    length_m: f64,
    /// Distance from its start to the point nearest to the door.
    along_m: f64,
}

fn wall(space: &Space, position_m: &[f64; 2]) -> Wall {
    let mut nearest =
        Wall { distance_m: f64::INFINITY, from_m: [0.0; 2], way: [1.0, 0.0], length_m: 0.0, along_m: 0.0 };
    for ring in space.rings() {
        for (a, b) in ring.iter().zip(ring.iter().cycle().skip(1)) {
            let (to_m, door_m) = ([b[0] - a[0], b[1] - a[1]], [position_m[0] - a[0], position_m[1] - a[1]]);
            let length_m = to_m[0].hypot(to_m[1]);
            if length_m == 0.0 {
                continue;
            }
            let way = to_m.map(|metres| metres / length_m);
            let along_m = (way[0] * door_m[0] + way[1] * door_m[1]).clamp(0.0, length_m);
            let distance_m = (door_m[0] - along_m * way[0]).hypot(door_m[1] - along_m * way[1]);
            if distance_m < nearest.distance_m {
                nearest = Wall { distance_m, from_m: *a, way, length_m, along_m };
            }
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::{GroundingOptions, PartitionLevel};

    const TWO_ROOMS: &str = include_str!("../../tests/data/two_rooms.json");

    fn drawn(text: &str, level: PartitionLevel, warm: bool) -> String {
        let map = SemanticMap::from_json(text).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions { level, room_labels: true }).unwrap();
        let partitions = grounding.partitions().len();
        let scores: Vec<f64> = (0..map.items().len()).map(|index| -(index as f64)).collect();
        let heat = Heat::new(&vec![1.0 / partitions as f64; partitions], &scores, "They grab the mug.");
        svg(&map, &grounding, warm.then_some(&heat)).unwrap()
    }

    fn assert_well_formed(svg: &str) {
        roxmltree::Document::parse(svg).unwrap();
    }

    #[test]
    fn every_level_is_drawn_with_and_without_heat() {
        for level in [PartitionLevel::Part, PartitionLevel::Room, PartitionLevel::Group] {
            for warm in [false, true] {
                let text = drawn(TWO_ROOMS, level, warm);
                assert_eq!(text.contains("They grab the mug."), warm);
                assert_well_formed(&text);
            }
        }
    }

    #[test]
    fn names_cannot_break_the_drawing() {
        let hostile = TWO_ROOMS.replace("\"label\": \"sofa\"", "\"label\": \"</text><script>&\"");
        let text = drawn(&hostile, PartitionLevel::Room, true);
        assert!(!text.contains("<script>"));
        assert_well_formed(&text);
    }

    #[test]
    fn heat_of_another_map_is_refused() {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        assert!(matches!(svg(&map, &grounding, Some(&Heat::default())), Err(DrawingError::OtherMap { .. })));
    }

    #[test]
    fn shares_of_heat_sum_to_one() {
        let heat = Heat::new(&[1.0], &[-1_000.0, -1_001.0, f64::NEG_INFINITY], "");
        assert!((heat.item_share.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert_eq!(Heat::new(&[1.0], &[f64::NEG_INFINITY], "").item_share, [0.0]);
    }

    /// A map of rooms with these labels and widths in metres, from west to east.
    fn row_of_rooms(rooms: &[(&str, &str, f64)]) -> SemanticMap {
        let mut west = 0.0;
        let mut json = Vec::new();
        for (id, label, width) in rooms {
            json.push(serde_json::json!({"id": id, "label": label, "box": {"min_m": [west, 0.0, 0.0], "max_m": [west + width, 4.0, 2.5]}}));
            west += width;
        }
        let text = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "row", "rooms": json, "doors": [], "items": [
            {"id": "lamp", "label": "lamp", "position_m": [0.5, 0.5, 0.5], "box": {"min_m": [0.4, 0.4, 0.4], "max_m": [0.6, 0.6, 0.6]}}]});
        SemanticMap::from_json(&text.to_string()).unwrap()
    }

    #[test]
    fn a_small_rooms_name_is_written_small_before_it_is_cut_off() {
        // A probability after the name also takes space.
        for (heat, small_m) in [(None, 1.2), (Some(Heat::new(&[0.2, 0.2, 0.6], &[0.0], "")), 1.8)] {
            let map = row_of_rooms(&[
                ("wide", "dining room", 9.0),
                ("small", "laundry room", small_m),
                ("tiny", "guest bathroom", 0.3),
            ]);
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let text = svg(&map, &grounding, heat.as_ref()).unwrap();
            let drawing = roxmltree::Document::parse(&text).unwrap();
            let bold = drawing.descendants().filter(|node| node.attribute("font-weight") == Some("bold"));
            let size = |start: &str| {
                let mut all =
                    bold.clone().filter(|node| node.text().is_some_and(|text| text.trim().starts_with(start)));
                let found = all.next().unwrap_or_else(|| panic!("{start} in {text}"));
                (found.text().unwrap().trim().to_owned(), found.attribute("font-size").unwrap().parse::<f64>().unwrap())
            };
            assert_eq!(size("dining"), ("dining room".to_owned(), 17.0));
            let (name, size_px) = size("laundry");
            assert_eq!(name, "laundry room");
            assert!(size_px < 17.0, "{size_px}");
            assert!(size("gue").0.ends_with('\u{2026}'), "nothing else is left");
        }
    }

    #[test]
    fn rooms_of_one_name_are_told_apart_and_one_room_is_no_rooms() {
        let drawn = |rooms: &[(&str, &str, f64)]| {
            let map = row_of_rooms(rooms);
            svg(&map, &Grounding::new(&map, &GroundingOptions::default()).unwrap(), None).unwrap()
        };
        let text = drawn(&[("hallway-12", "hallway", 3.0), ("hallway-13", "hallway", 3.0)]);
        // Once on the plan and once in the panel.
        assert_eq!(["hallway-12", "hallway-13"].map(|name| text.matches(name).count()), [2, 2]);
        assert!(drawn(&[("home", "home", 3.0)]).contains("1 item, 1 label, 1 room "), "{text}");
    }

    /// Robots' maps have walls at any angle, and a gap between rooms.
    #[test]
    fn a_door_is_a_gap_along_its_walls() {
        let scene = serde_json::json!({"format": "roomcast-scene", "version": 2, "name": "slanted", "rooms": [
            {"id": "west", "label": "west", "footprint": [[[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]], "floor": 0.0, "height": 2.5},
            {"id": "east", "label": "east", "footprint": [[[4.0, 0.2], [4.0, 4.2], [0.0, 4.2]]], "floor": 0.0, "height": 2.5}],
            "doors": [{"id": "door", "rooms": ["west", "east"], "position_m": [2.0, 2.1, 1.0]}], "items": [
            {"id": "lamp", "label": "lamp", "position_m": [0.5, 0.5, 0.5], "box": {"min_m": [0.4, 0.4, 0.4], "max_m": [0.6, 0.6, 0.6]}}]});
        let map = SemanticMap::from_json(&scene.to_string()).unwrap();
        let text = svg(&map, &Grounding::new(&map, &GroundingOptions::default()).unwrap(), None).unwrap();
        let drawing = roxmltree::Document::parse(&text).unwrap();
        let gaps = drawing
            .descendants()
            .filter(|node| node.has_tag_name("line") && node.attribute("stroke-width") == Some("7"));
        let place = |node: roxmltree::Node<'_, '_>, name| node.attribute(name).unwrap().parse::<f64>().unwrap();
        let ways: Vec<f64> = (gaps
            .map(|node| (place(node, "y2") - place(node, "y1")) / (place(node, "x2") - place(node, "x1"))))
        .collect();
        // One in each wall, and the level one of the legend.
        assert_eq!(ways.len(), 3, "{text}");
        assert!(ways[..2].iter().all(|way| (way - 1.0).abs() < 0.05), "{ways:?}");
    }

    /// A hall with a bathroom over it, as the import from Home Assistant writes them, and a door between the two.
    #[test]
    fn storeys_are_drawn_beside_each_other() {
        let space =
            |floor_m: f64| serde_json::json!({"min_m": [0.0, 0.0, floor_m], "max_m": [4.0, 4.0, floor_m + 2.5]});
        let thing = |id: &str, at_m: [f64; 3]| {
            let end_m = at_m.map(|metres| metres + 0.8);
            serde_json::json!({"id": id, "label": id, "position_m": at_m.map(|metres| metres + 0.4), "box": {"min_m": at_m, "max_m": end_m}})
        };
        let scene = |upper_m: f64| {
            let scene = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "house",
                "rooms": [{"id": "hall", "label": "hall", "box": space(0.0)}, {"id": "bathroom", "label": "bathroom", "box": space(upper_m)}],
                "doors": [{"id": "stairs", "rooms": ["hall", "bathroom"], "position_m": [2.0, 2.0, upper_m]}],
                "items": [thing("bench", [1.0, 1.0, 0.0]), thing("bathtub", [1.0, 1.0, upper_m])]});
            let map = SemanticMap::from_json(&scene.to_string()).unwrap();
            svg(&map, &Grounding::new(&map, &GroundingOptions::default()).unwrap(), None).unwrap()
        };
        let text = scene(3.0);
        let drawing = roxmltree::Document::parse(&text).unwrap();
        let corner = |node: roxmltree::Node<'_, '_>| {
            let steps: Vec<f64> = node.attribute("d")?.split(' ').filter_map(|step| step.parse().ok()).collect();
            Some((steps[0], steps[2]))
        };
        let walls = drawing.descendants().filter(|node| node.attribute("stroke-linejoin") == Some("round"));
        let walls: Vec<(f64, f64)> = walls.filter_map(corner).collect();
        let [hall, bathroom] = walls[..] else { panic!("{walls:?}") };
        assert!(bathroom.0.min(bathroom.1) > hall.0.max(hall.1), "{walls:?}");
        let said: Vec<&str> =
            drawing.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).map(str::trim).collect();
        for name in ["floor at 0 m", "floor at 3 m", "bench", "bathtub", "way to another storey"] {
            assert_eq!(said.iter().filter(|own| **own == name).count(), 1, "{name} in {said:?}");
        }
        let things = drawing
            .descendants()
            .filter(|node| node.has_tag_name("rect") && node.attribute("fill-opacity") == Some("0.9"));
        let mut lefts: Vec<f64> = things.map(|node| node.attribute("x").unwrap().parse().unwrap()).collect();
        lefts.sort_by(f64::total_cmp);
        assert!(lefts[0] > hall.0 && lefts[0] < hall.1 && lefts[1] > bathroom.0 && lefts[1] < bathroom.1, "{lefts:?}");
    }

    #[test]
    fn a_map_of_one_storey_names_none() {
        assert!(!drawn(TWO_ROOMS, PartitionLevel::Room, false).contains("floor at"));
    }

    #[test]
    fn the_plan_is_the_same_each_time() {
        assert_eq!(drawn(TWO_ROOMS, PartitionLevel::Room, true), drawn(TWO_ROOMS, PartitionLevel::Room, true));
    }
}
