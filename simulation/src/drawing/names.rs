//! Names of rooms and furniture on a plan. Each name has the place with the least covered drawing.

use roomcast_core::semantic_map::Space;
use svg::node::element::{Group, Rectangle};

use super::{
    Area, BOLDER, DOOR_M, Door, INK, Label, NAME_MARGIN_PX, NAME_PX, PAPER, Plan, Thing, WALL, floor_m2, percent,
    rounded, shortened, width_px,
};

impl Plan<'_> {
    /// Names of partitions with their probabilities, each in the place with the fewest things.
    pub(super) fn partition_names(&mut self) -> Group {
        let mut names = Group::new();
        let called = self.grounding.partition_names();
        for (index, spaces) in self.partitions.iter().enumerate() {
            let largest = |a: &&Space, b: &&Space| floor_m2(a).total_cmp(&floor_m2(b));
            let Some(space) = spaces.iter().max_by(largest) else { continue };
            let area = self.area(&space.bounds);
            let probability = self.heat.map(|heat| percent(heat.partition_probability[index]));
            let beside_px = |size_px: f64| probability.as_ref().map_or(0.0, |text| width_px(text, size_px) + 12.0);
            // A name is set smaller before it is cut off.
            let sizes = if self.grounding.partitions().len() <= 8 { &NAME_PX[..] } else { &NAME_PX[2..] };
            let most_px = area.right - area.left - NAME_MARGIN_PX;
            let whole = |size_px: &&f64| width_px(&called[index], **size_px) * BOLDER + beside_px(**size_px) <= most_px;
            let (size_px, name) = match sizes.iter().find(whole) {
                Some(size_px) => (*size_px, called[index].clone()),
                None => {
                    let size_px = NAME_PX[NAME_PX.len() - 1];
                    (size_px, shortened(&called[index], size_px * BOLDER, (most_px - beside_px(size_px)).max(40.0)))
                }
            };
            let width = width_px(&name, size_px) * BOLDER + beside_px(size_px);
            let (width, height) = (width + 20.0, size_px + 13.0);
            let place = self.quietest(space, &area, width, height);
            self.taken.push(place);
            let middle = (place.top + place.bottom) / 2.0;
            names = names.add(
                Rectangle::new()
                    .set("x", rounded(place.left))
                    .set("y", rounded(place.top))
                    .set("width", rounded(width))
                    .set("height", rounded(height))
                    .set("rx", rounded(height / 2.0))
                    .set("fill", WALL),
            );
            names = names
                .add(Label { bold: true, colour: PAPER, ..Label::new(&name, size_px) }.at(place.left + 10.0, middle));
            if let Some(text) = probability {
                let label = Label { colour: "#ffd9a0", anchor: "end", ..Label::new(&text, size_px) };
                names = names.add(label.at(place.right - 10.0, middle));
            }
        }
        names
    }

    /// The place of the given size in the area that covers the fewest things, nearest to the top left corner.
    fn quietest(&self, space: &Space, area: &Area, width: f64, height: f64) -> Area {
        let room_x = (area.right - area.left - width - 16.0).max(0.0);
        let room_y = (area.bottom - area.top - height - 16.0).max(0.0);
        let things: Vec<Area> = (0..self.things.len())
            .filter(|&index| !self.is_structure(index))
            .map(|index| {
                let Thing { bounds, position_m: [east_m, north_m], .. } = &self.things[index];
                if self.is_furniture(index) {
                    self.area(bounds)
                } else {
                    Area::around(self.x(*east_m), self.y(*north_m), 5.0, 5.0)
                }
            })
            .chain(self.doors.iter().flat_map(Door::places_m).map(|[east_m, north_m]| {
                let size_px = 2.0 * DOOR_M * self.scale;
                Area::around(self.x(east_m), self.y(north_m), size_px, size_px)
            }))
            .filter(|thing| thing.meets(area))
            .collect();
        const STEPS: usize = 24;
        let mut best = (usize::MAX, Area::around(0.0, 0.0, 0.0, 0.0));
        for step in 0..STEPS * STEPS {
            let (down, right) = (step / STEPS, step % STEPS);
            let left = area.left + 8.0 + room_x * right as f64 / (STEPS - 1) as f64;
            let top = area.top + 8.0 + room_y * down as f64 / (STEPS - 1) as f64;
            let place = Area { left, top, right: left + width, bottom: top + height };
            let off = [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height), (0.5 * width, 0.5 * height)];
            let off = off.iter().filter(|(right, down)| {
                let (east_m, north_m) = (self.east_m(left + right), self.north_m(top + down));
                space.footprint.is_some() && !space.contains(&[east_m, north_m, space.bounds.centre_m()[2]])
            });
            let covered = 200 * off.count()
                + things.iter().filter(|thing| thing.meets(&place)).count()
                + 100 * self.taken.iter().filter(|taken| taken.meets(&place)).count();
            if covered < best.0 {
                best = (covered, place);
            }
        }
        best.1
    }

    /// Names on large furniture, from the top down, each in the place that hides least.
    pub(super) fn furniture_names(&mut self) -> Group {
        let items = self.map.items();
        let order = self.furniture_order();
        let dots: Vec<Area> = (0..items.len())
            .filter(|&index| !self.is_furniture(index) && !self.is_structure(index))
            .map(|index| self.things[index].position_m)
            .map(|[east_m, north_m]| Area::around(self.x(east_m), self.y(north_m), 4.0, 4.0))
            .collect();
        let mut above: Vec<Area> = Vec::new();
        let mut names = Group::new();
        for &index in order.iter().rev() {
            let area = self.area(&self.things[index].bounds);
            let text = &self.map.labels()[items[index].label.0 as usize];
            let (width, height) = (area.right - area.left - 6.0, area.bottom - area.top - 4.0);
            if let Some(block) = TextBlock::fit(text, width, height) {
                let dots: Vec<&Area> = dots.iter().filter(|dot| dot.meets(&area)).collect();
                let cost = |place: &Area| {
                    let hides = above.iter().chain(&self.taken).filter(|other| other.meets(place)).count();
                    100 * hides + dots.iter().filter(|dot| dot.meets(place)).count()
                };
                let (place, cost) = block.best_place(&area, cost);
                if cost < 100 {
                    let hot = self.heat_of(index).is_some_and(|heat| heat > 0.7);
                    names = names.add(block.draw(&place, hot));
                    self.taken.push(place);
                }
            }
            above.push(area);
        }
        names
    }
}

/// A text in lines, turned if its place is narrow.
struct TextBlock {
    lines: Vec<String>,
    size_px: f64,
    upright: bool,
    /// Width and height on the page, in pixels.
    extent_px: [f64; 2],
}

impl TextBlock {
    /// The largest legible way to write the text into the given width and height; `None` if there is none.
    fn fit(text: &str, width: f64, height: f64) -> Option<Self> {
        let by_word: Vec<String> = text.split(' ').map(str::to_owned).collect();
        let layouts = [vec![text.to_owned()], by_word];
        for upright in [false, true] {
            for size_px in [13.0, 11.0, 9.5] {
                for lines in &layouts {
                    let along = lines.iter().map(|line| width_px(line, size_px)).fold(0.0, f64::max);
                    let across = size_px * 1.15 * lines.len() as f64;
                    let extent_px = if upright { [across, along] } else { [along, across] };
                    if extent_px[0] <= width && extent_px[1] <= height {
                        return Some(Self { lines: lines.clone(), size_px, upright, extent_px });
                    }
                }
            }
        }
        None
    }

    /// The cheapest place in the area; of several, the nearest to its centre.
    fn best_place(&self, area: &Area, cost: impl Fn(&Area) -> usize) -> (Area, usize) {
        let [width, height] = self.extent_px;
        let (x, y) = ((area.left + area.right) / 2.0, (area.top + area.bottom) / 2.0);
        let room_x = ((area.right - area.left - width) / 2.0 - 3.0).max(0.0);
        let room_y = ((area.bottom - area.top - height) / 2.0 - 2.0).max(0.0);
        const STEPS: i32 = 4;
        let step = |index: i32| f64::from(index) / f64::from(STEPS);
        let steps = (-STEPS..=STEPS).flat_map(|down| (-STEPS..=STEPS).map(move |right| (right, down)));
        let mut steps: Vec<(i32, i32)> = steps.collect();
        steps.sort_by_key(|(right, down)| right * right + down * down);
        let place = |(right, down): (i32, i32)| {
            let place = Area::around(x + room_x * step(right), y + room_y * step(down), width, height);
            (place, cost(&place))
        };
        let centre = place((0, 0));
        steps.into_iter().skip(1).map(place).fold(centre, |best, next| if next.1 < best.1 { next } else { best })
    }

    fn draw(&self, place: &Area, hot: bool) -> Group {
        let (x, y) = ((place.left + place.right) / 2.0, (place.top + place.bottom) / 2.0);
        let mut group = Group::new();
        for (line, text) in self.lines.iter().enumerate() {
            let offset = (line as f64 - (self.lines.len() - 1) as f64 / 2.0) * self.size_px * 1.15;
            let colour = if hot { PAPER } else { INK };
            let label = Label { anchor: "middle", colour, halo: !hot, ..Label::new(text, self.size_px) };
            group = group.add(label.at(x, y + offset));
        }
        if self.upright { group.set("transform", format!("rotate(-90 {} {})", rounded(x), rounded(y))) } else { group }
    }
}
