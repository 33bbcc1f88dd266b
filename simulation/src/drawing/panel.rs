//! The panel beside a plan: the rooms, the warmest things, and the legend.

use roomcast_core::semantic_map::PartitionId;
use roomcast_core::text::count;
use svg::node::element::{Circle, Definitions, Group, Line, LinearGradient, Rectangle, Stop};

use super::{
    DOT, Door, EDGE, FURNITURE, HEAT, Heat, Label, PANEL_PX, PAPER, Plan, QUIET, TITLE_PX, WALL, colour, percent,
    rounded, shortened, stairs,
};

/// Most rows of a list.
const ROWS: usize = 12;
const BAR_PX: f64 = 92.0;

fn heading(text: &str) -> Label<'_> {
    Label { bold: true, ..Label::new(text, 14.0) }
}

impl<'a> Plan<'a> {
    pub(super) fn panel(&self, left: f64) -> (Group, f64) {
        let mut panel = Group::new();
        let mut y = TITLE_PX + 8.0;

        panel = panel.add(heading(if self.heat.is_some() { "Where next" } else { "What is where" }).at(left, y));
        y += 26.0;
        let (partitions, called) = (self.grounding.partitions(), self.grounding.partition_names());
        let order = match self.heat {
            Some(heat) => warmest(&heat.partition_probability, ROWS),
            None => (0..partitions.len().min(ROWS)).collect(),
        };
        for &index in &order {
            let name = shortened(&called[index], 13.0, PANEL_PX - BAR_PX - 70.0);
            panel = panel.add(Label::new(&name, 13.0).at(left, y));
            let value = if let Some(heat) = self.heat {
                let probability = heat.partition_probability[index];
                panel = panel.add(bar(
                    left + PANEL_PX - BAR_PX - 58.0,
                    y,
                    BAR_PX,
                    probability,
                    &colour(probability.max(0.4)),
                ));
                percent(probability)
            } else {
                let own = PartitionId(u32::try_from(index).unwrap_or(u32::MAX));
                let items = self.grounding.item_partition().iter().filter(|partition| **partition == Some(own)).count();
                count(items, "item")
            };
            panel =
                panel.add(Label { anchor: "end", colour: QUIET, ..Label::new(&value, 13.0) }.at(left + PANEL_PX, y));
            y += 22.0;
        }
        let hidden = partitions.len() - order.len();
        if hidden > 0 {
            let text = format!("and {hidden} more");
            panel = panel.add(Label { colour: QUIET, ..Label::new(&text, 12.0) }.at(left, y));
            y += 22.0;
        }
        let outside = self.grounding.unassigned().len();
        if outside > 0 {
            let text = format!("{outside} outside every partition");
            panel = panel.add(Label { colour: "#b3261e", ..Label::new(&text, 12.0) }.at(left, y));
            y += 22.0;
        }

        if let Some(heat) = self.heat {
            y += 16.0;
            panel = panel.add(heading("Warmest things").at(left, y));
            y += 26.0;
            for (label, share) in self.warmest_labels(heat, ROWS) {
                let name = shortened(label, 13.0, PANEL_PX - BAR_PX - 70.0);
                panel = panel.add(Label::new(&name, 13.0).at(left, y));
                panel = panel.add(bar(left + PANEL_PX - BAR_PX - 58.0, y, BAR_PX, share, "#d4682f"));
                let value = percent(share);
                panel = panel
                    .add(Label { anchor: "end", colour: QUIET, ..Label::new(&value, 13.0) }.at(left + PANEL_PX, y));
                y += 22.0;
            }
            y += 18.0;
            panel = panel.add(heat_scale(left, y));
            y += 48.0;
        }

        self.legend(panel, left, y)
    }

    fn legend(&self, mut panel: Group, left: f64, mut y: f64) -> (Group, f64) {
        y += 16.0;
        panel = panel.add(heading("Legend").at(left, y));
        y += 26.0;
        let swatch = Rectangle::new().set("x", left).set("y", y - 8.0).set("width", 24).set("height", 16);
        panel = panel
            .add(swatch.set("rx", 3).set("fill", FURNITURE).set("stroke", EDGE))
            .add(Label { colour: QUIET, ..Label::new("furniture, seen from above", 12.0) }.at(left + 36.0, y));
        y += 24.0;
        panel = panel
            .add(Circle::new().set("cx", left + 12.0).set("cy", y).set("r", 3).set("fill", DOT))
            .add(Label { colour: QUIET, ..Label::new("small or hanging thing", 12.0) }.at(left + 36.0, y));
        y += 24.0;
        let door = Line::new().set("x1", left).set("x2", left + 24.0).set("y1", y).set("y2", y);
        panel = panel
            .add(door.clone().set("stroke", WALL).set("stroke-width", 5))
            .add(door.set("x1", left + 6.0).set("x2", left + 18.0).set("stroke", PAPER).set("stroke-width", 7))
            .add(Label { colour: QUIET, ..Label::new("wall with a door", 12.0) }.at(left + 36.0, y));
        y += 24.0;
        if !self.map.parts().is_empty() {
            let line = Line::new().set("x1", left).set("x2", left + 24.0).set("y1", y).set("y2", y);
            panel = panel
                .add(line.set("stroke", QUIET).set("stroke-dasharray", "3 5"))
                .add(Label { colour: QUIET, ..Label::new("part of a room", 12.0) }.at(left + 36.0, y));
            y += 24.0;
        }
        if self.doors.iter().any(|door| matches!(door, Door::Stairs(_))) {
            panel = panel
                .add(stairs(left + 12.0, y))
                .add(Label { colour: QUIET, ..Label::new("way to another storey", 12.0) }.at(left + 36.0, y));
            y += 24.0;
        }
        (panel, y)
    }

    /// Labels by the summed share of their items.
    fn warmest_labels(&self, heat: &Heat, count: usize) -> Vec<(&'a str, f64)> {
        let mut shares = vec![0.0; self.map.labels().len()];
        for (item, share) in self.map.items().iter().zip(&heat.item_share) {
            shares[item.label.0 as usize] += share;
        }
        warmest(&shares, count).into_iter().map(|label| (self.map.labels()[label].as_str(), shares[label])).collect()
    }
}

pub(super) fn warmest(values: &[f64], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..values.len()).filter(|&index| values[index] > 0.0).collect();
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
    order.truncate(count);
    order
}

fn bar(left: f64, y: f64, width: f64, share: f64, fill: &str) -> Group {
    let track = Rectangle::new().set("x", rounded(left)).set("y", rounded(y - 5.0)).set("height", 10).set("rx", 3);
    let filled = track.clone().set("width", rounded((width * share.clamp(0.0, 1.0)).max(1.5))).set("fill", fill);
    Group::new().add(track.set("width", rounded(width)).set("fill", "#eeebe4")).add(filled)
}

fn heat_scale(left: f64, y: f64) -> Group {
    let mut gradient = LinearGradient::new().set("id", "heat");
    for step in 0..HEAT.len() {
        let place = step as f64 / (HEAT.len() - 1) as f64;
        gradient = gradient.add(Stop::new().set("offset", place).set("stop-color", colour(place)));
    }
    let strip = Rectangle::new().set("x", rounded(left)).set("y", rounded(y)).set("width", PANEL_PX).set("height", 10);
    let end = |text: &'static str, anchor: &'static str| Label { colour: QUIET, anchor, ..Label::new(text, 12.0) };
    Group::new()
        .add(Definitions::new().add(gradient))
        .add(strip.set("rx", 3).set("fill", "url(#heat)").set("stroke", "#e2ddd2").set("stroke-width", 0.5))
        .add(end("unlikely", "start").at(left, y + 22.0))
        .add(end("certain", "end").at(left + PANEL_PX, y + 22.0))
}
