//! Charts as SVG text: points, lines and steps over two axes. They need no other files.

use std::fmt::Write;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    Points,
    /// Dots joined by a line; with more than 60 of them the line alone.
    Line,
    /// A histogram's outline: each y holds from its x to the next.
    Steps,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    pub name: String,
    /// (x, y); points that are not finite are skipped.
    pub points: Vec<(f64, f64)>,
    pub mark: Mark,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    pub title: String,
    pub x: String,
    pub y: String,
    pub series: Vec<Series>,
}

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 440.0;
const LEFT: f64 = 76.0;
const RIGHT: f64 = 210.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 58.0;

const DOTS_MAX: usize = 60;

/// Colours that colour-blind people can distinguish, in the order of the series.
const COLOURS: [&str; 8] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#b8860b", "#444444", "#7b4fa6"];

impl Chart {
    pub fn svg(&self) -> String {
        let points = || self.series.iter().flat_map(|s| &s.points).filter(|(x, y)| x.is_finite() && y.is_finite());
        let x = Axis::covering(points().map(|p| p.0));
        let y = Axis::covering(points().map(|p| p.1));
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        let at_x = |value: f64| LEFT + x.share(value) * (right - LEFT);
        let at_y = |value: f64| bottom - y.share(value) * (bottom - TOP);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" width=\"{WIDTH}\" height=\"{HEIGHT}\" \
             font-family=\"DejaVu Sans, sans-serif\" font-size=\"12\"><rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>"
        );
        text(&mut svg, LEFT, 24.0, "start", "#222222", "font-size=\"15\" font-weight=\"bold\"", &self.title);
        text(&mut svg, (LEFT + right) / 2.0, HEIGHT - 16.0, "middle", "#222222", "", &self.x);
        let turned = format!("transform=\"rotate(-90 18 {})\"", (TOP + bottom) / 2.0);
        text(&mut svg, 18.0, (TOP + bottom) / 2.0, "middle", "#222222", &turned, &self.y);
        for tick in x.ticks() {
            let at = at_x(tick);
            line(&mut svg, [at, TOP, at, bottom], "#e4e4e4");
            text(&mut svg, at, bottom + 18.0, "middle", "#444444", "", &x.label(tick));
        }
        for tick in y.ticks() {
            let at = at_y(tick);
            line(&mut svg, [LEFT, at, right, at], "#e4e4e4");
            text(&mut svg, LEFT - 8.0, at + 4.0, "end", "#444444", "", &y.label(tick));
        }
        line(&mut svg, [LEFT, bottom, right, bottom], "#444444");
        line(&mut svg, [LEFT, TOP, LEFT, bottom], "#444444");
        // The first one is drawn last, above the others.
        for (index, series) in self.series.iter().enumerate().rev() {
            let colour = COLOURS[index % COLOURS.len()];
            let shown: Vec<(f64, f64)> = series
                .points
                .iter()
                .filter(|(x, y)| x.is_finite() && y.is_finite())
                .map(|(x, y)| (at_x(*x), at_y(*y)))
                .collect();
            if series.mark != Mark::Points && !shown.is_empty() {
                let mut path = String::new();
                for (i, (x, y)) in shown.iter().enumerate() {
                    // Writing to a string cannot fail.
                    let _ = match (i, series.mark) {
                        (0, _) => write!(path, "M{x:.1} {y:.1}"),
                        (_, Mark::Steps) => write!(path, "H{x:.1}V{y:.1}"),
                        _ => write!(path, "L{x:.1} {y:.1}"),
                    };
                }
                let _ = write!(svg, "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>");
            }
            // More dots on a line would merge into a band.
            if series.mark == Mark::Points || (series.mark == Mark::Line && shown.len() <= DOTS_MAX) {
                for (x, y) in &shown {
                    let _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{colour}\"/>");
                }
            }
            let legend = TOP + 10.0 + 20.0 * index as f64;
            let _ = write!(
                svg,
                "<rect x=\"{}\" y=\"{}\" width=\"12\" height=\"12\" fill=\"{colour}\"/>",
                right + 16.0,
                legend - 10.0
            );
            text(&mut svg, right + 34.0, legend, "start", "#222222", "", &series.name);
        }
        svg.push_str("</svg>\n");
        svg
    }
}

fn text(svg: &mut String, x: f64, y: f64, anchor: &str, colour: &str, attributes: &str, text: &str) {
    let text = escape(text);
    let _ = write!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\" {attributes}>{text}</text>"
    );
}

fn line(svg: &mut String, [x1, y1, x2, y2]: [f64; 4], colour: &str) {
    let _ = write!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{colour}\"/>");
}

/// Escapes text for XML or HTML; names may come from other people's files.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

struct Axis {
    low: f64,
    high: f64,
    step: f64,
}

impl Axis {
    /// Round limits around the values, from 0 if they are near it.
    fn covering(values: impl Iterator<Item = f64> + Clone) -> Self {
        let low = values.clone().fold(f64::INFINITY, f64::min);
        let high = values.fold(f64::NEG_INFINITY, f64::max);
        let (low, high) = if low.is_finite() && high.is_finite() { (low, high) } else { (0.0, 1.0) };
        let low = if low >= 0.0 && low < 0.5 * high { 0.0 } else { low };
        let span = if high > low { high - low } else { 1.0 };
        let magnitude = 10f64.powf((span / 5.0).log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|f| f * magnitude).find(|s| span / s <= 6.0).unwrap_or(span);
        let low = (low / step).floor() * step;
        Self { low, high: (low + step).max((high / step).ceil() * step), step }
    }

    fn share(&self, value: f64) -> f64 {
        (value - self.low) / (self.high - self.low)
    }

    fn ticks(&self) -> impl Iterator<Item = f64> {
        let count = ((self.high - self.low) / self.step).round() as usize;
        (0..=count).map(|i| self.low + i as f64 * self.step)
    }

    fn label(&self, tick: f64) -> String {
        let decimals = (-self.step.log10().floor()).max(0.0) as usize;
        format!("{tick:.decimals$}")
    }
}

/// The outline of a histogram: shares of the values per bin of width `bin`.
pub fn histogram(values: &[f64], bin: f64) -> Vec<(f64, f64)> {
    let high = values.iter().copied().filter(|v| v.is_finite()).fold(0.0, f64::max);
    let bins = (high / bin) as usize + 1;
    let mut counts = vec![0.0; bins + 1];
    for value in values.iter().filter(|v| v.is_finite()) {
        counts[((value / bin) as usize).min(bins - 1)] += 1.0 / values.len() as f64;
    }
    counts.into_iter().enumerate().map(|(i, share)| (i as f64 * bin, share)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chart_is_well_formed_and_shows_every_series() {
        let series = |name: &str, mark| Series {
            name: name.into(),
            points: vec![(0.0, 1.0), (3.0, f64::NAN), (5.0, 9.0)],
            mark,
        };
        let chart = Chart {
            title: "a < b & c".into(),
            x: "x (s)".into(),
            y: "y (m)".into(),
            series: vec![series("one", Mark::Points), series("two", Mark::Line), series("three", Mark::Steps)],
        };
        let svg = chart.svg();
        assert!(svg.contains("a &lt; b &amp; c") && svg.contains("three") && !svg.contains("NaN"));
        roxmltree::Document::parse(&svg).unwrap();
        // The first one is drawn last, and the third's legend is below it.
        assert!(svg.find(">three<").unwrap() < svg.find(">one<").unwrap());
        let dots = |number: u32| {
            let points = (0..number).map(|at| (f64::from(at), 1.0)).collect();
            let series = vec![Series { name: "days".into(), points, mark: Mark::Line }];
            Chart { series, ..chart.clone() }.svg().matches("<circle").count()
        };
        assert_eq!([dots(60), dots(61)], [60, 0]);
        let empty = Chart { title: String::new(), x: String::new(), y: String::new(), series: Vec::new() }.svg();
        assert!(!empty.contains("NaN") && !empty.contains("inf"));
    }

    #[cfg(feature = "png")]
    #[test]
    fn charts_become_pictures() {
        let chart = Chart { title: "a < b".into(), x: "x (s)".into(), y: "y (m)".into(), series: Vec::new() };
        assert_eq!(roomcast_simulation::png::png(&chart.svg(), 1.0).unwrap()[..4], *b"\x89PNG");
    }

    #[test]
    fn histograms_hold_all_values() {
        let steps = histogram(&[0.0, 4.0, 5.0, 14.9], 5.0);
        assert_eq!(steps, [(0.0, 0.5), (5.0, 0.25), (10.0, 0.25), (15.0, 0.0)]);
    }
}
