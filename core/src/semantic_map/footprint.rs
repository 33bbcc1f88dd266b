//! Footprints of rooms that are not boxes: checks, and the overlap of the prism over a footprint with a box.
//!
//! The common area of a ring and a rectangle is a sum over the ring's edges (Green's theorem), exact for concave rings too. So the time is
//! proportional to the corners, and neither memory nor general polygon clipping is needed.

use super::Box3;

/// Most corners of all footprints of a map together.
pub const MAX_CORNERS: usize = 10_000;
/// The remedy for too many corners.
pub(super) const FEWER_CORNERS: &str = "simplify the outlines: a corner per bend of a wall is enough";

/// A smaller share of a rectangle is a rounding error.
const NOTHING: f64 = 1e-9;
/// A point this near to an edge is on the edge, in metres.
const ON_EDGE_M: f64 = 1e-9;

/// An outline with holes, in metres. The rings are simple, do not meet, and do not repeat their first corner. The outline runs counterclockwise,
/// holes clockwise.
#[derive(Debug, Clone, PartialEq)]
pub struct Footprint {
    rings: Vec<Vec<[f64; 2]>>,
    corners: usize,
}

type Edge = ([f64; 2], [f64; 2]);

/// A problem with rings, and its remedy.
pub(super) type Fault = (String, &'static str);

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

/// Twice the area of the triangle, positive if it is counterclockwise.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    let ([ux, uy], [vx, vy]) = (minus(b, a), minus(c, a));
    ux * vy - uy * vx
}

pub(super) fn edges(ring: &[[f64; 2]]) -> impl Iterator<Item = Edge> + Clone {
    ring.iter().copied().zip(ring.iter().copied().cycle().skip(1))
}

/// Area in square metres, positive if the ring is counterclockwise.
fn signed_area_m2(ring: &[[f64; 2]]) -> f64 {
    ring.windows(2).map(|pair| turn(ring[0], pair[0], pair[1])).sum::<f64>() / 2.0
}

fn edge_distance_m(point: [f64; 2], (a, b): Edge) -> f64 {
    let ([ux, uy], [px, py]) = (minus(b, a), minus(point, a));
    let length = ux * ux + uy * uy;
    let along = if length > 0.0 { ((ux * px + uy * py) / length).clamp(0.0, 1.0) } else { 0.0 };
    (px - along * ux).hypot(py - along * uy)
}

/// Whether two edges share a point.
fn edges_meet((a, b): Edge, (c, d): Edge) -> bool {
    let apart =
        |axis: usize| a[axis].max(b[axis]) < c[axis].min(d[axis]) || c[axis].max(d[axis]) < a[axis].min(b[axis]);
    if apart(0) || apart(1) {
        return false;
    }
    let straddles = |p: f64, q: f64| (p <= 0.0 && q >= 0.0) || (p >= 0.0 && q <= 0.0);
    straddles(turn(a, b, c), turn(a, b, d)) && straddles(turn(c, d, a), turn(c, d, b))
}

/// Whether a ray from the point to the east crosses the edge.
fn is_east((a, b): Edge, point: [f64; 2]) -> bool {
    (a[1] > point[1]) != (b[1] > point[1]) && point[0] < a[0] + (b[0] - a[0]) * (point[1] - a[1]) / (b[1] - a[1])
}

/// Whether the point lies within the ring, or on it.
fn ring_contains(ring: &[[f64; 2]], point: [f64; 2]) -> bool {
    edges(ring).filter(|edge| is_east(*edge, point)).count() % 2 == 1
}

/// The contribution of an edge to the area of its ring within the rectangle from the origin to `size`, in square metres: the integral of y, clamped
/// to the rectangle, over the x in it, from right to left.
fn strip_m2(a: [f64; 2], b: [f64; 2], size: [f64; 2]) -> f64 {
    let [left, right] = [a[0], b[0]].map(|x| x.clamp(0.0, size[0]));
    if left == right {
        return 0.0;
    }
    let at = |x: f64| a[1] + (b[1] - a[1]) * (x - a[0]) / (b[0] - a[0]);
    let (low, high) = (at(left).min(at(right)), at(left).max(at(right)));
    let mean = if high <= 0.0 {
        0.0
    } else if low >= size[1] {
        size[1]
    } else {
        let (from, to) = (low.max(0.0), high.min(size[1]));
        if high > low { ((to - from) * (to + from) / 2.0 + size[1] * (high - to)) / (high - low) } else { from }
    };
    (left - right) * mean
}

fn no_area(index: usize) -> Fault {
    (format!("ring {index} has no area"), "give corners that are not all on one line")
}

impl Footprint {
    /// Checks rings and normalises them; the outline comes first. A ring may repeat its first corner at its end.
    pub(super) fn new(rings: &[Vec<[f64; 2]>]) -> Result<Self, Fault> {
        if rings.is_empty() {
            return Err(("has no ring".to_owned(), "give the outline as a list of [x, y]"));
        }
        // Checked first, because later checks take quadratic time.
        if rings.iter().map(Vec::len).sum::<usize>() > MAX_CORNERS {
            return Err((format!("has more than {MAX_CORNERS} corners"), FEWER_CORNERS));
        }
        let mut checked = Vec::with_capacity(rings.len());
        for (index, ring) in rings.iter().enumerate() {
            let mut ring = ring.clone();
            ring.dedup();
            while ring.len() > 1 && ring.first() == ring.last() {
                ring.pop();
            }
            if ring.len() < 3 {
                return Err((
                    format!("ring {index} has fewer than 3 corners"),
                    "give at least three different corners",
                ));
            }
            let area_m2 = signed_area_m2(&ring);
            let on_one_line = ring.iter().all(|corner| turn(ring[0], ring[1], *corner) == 0.0);
            if on_one_line {
                return Err(no_area(index));
            }
            if (area_m2 > 0.0) != (index == 0) {
                ring.reverse();
            }
            checked.push(ring);
        }
        let corners = checked.iter().map(Vec::len).sum();
        let footprint = Self { rings: checked, corners };
        footprint.check_edges()?;
        // Checked after the crossings: a figure of eight with equal halves has no area either, and the crossing is the better message.
        if let Some(index) = footprint.rings.iter().position(|ring| signed_area_m2(ring) == 0.0) {
            return Err(no_area(index));
        }
        footprint.check_holes()?;
        Ok(footprint)
    }

    /// Applies `moved` to every corner.
    pub(super) fn mapped(&self, moved: impl Fn([f64; 2]) -> [f64; 2]) -> Self {
        Self {
            rings: self.rings.iter().map(|ring| ring.iter().map(|corner| moved(*corner)).collect()).collect(),
            corners: self.corners,
        }
    }

    /// Edges may meet only at the common corner of neighbours.
    fn check_edges(&self) -> Result<(), Fault> {
        let mut all: Vec<(usize, usize, Edge)> = (self.rings.iter().enumerate())
            .flat_map(|(ring, corners)| edges(corners).enumerate().map(move |(index, edge)| (ring, index, edge)))
            .collect();
        let from = |edge: &Edge| edge.0[0].min(edge.1[0]);
        all.sort_by(|a, b| from(&a.2).total_cmp(&from(&b.2)));
        for (place, &(ring, index, edge)) in all.iter().enumerate() {
            let end = edge.0[0].max(edge.1[0]);
            for &(other_ring, other_index, other) in all[place + 1..].iter().take_while(|next| from(&next.2) <= end) {
                let wrong = if ring != other_ring {
                    edges_meet(edge, other)
                } else if edge.1 == other.0 || other.1 == edge.0 {
                    // Neighbours share a corner. An edge must not run back over its neighbour.
                    let ((a, b), (_, c)) = if edge.1 == other.0 { (edge, other) } else { (other, edge) };
                    let ([ux, uy], [vx, vy]) = (minus(b, a), minus(c, b));
                    let neighbours =
                        index.abs_diff(other_index) == 1 || index.abs_diff(other_index) + 1 == self.rings[ring].len();
                    !neighbours || (turn(a, b, c) == 0.0 && ux * vx + uy * vy < 0.0)
                } else {
                    edges_meet(edge, other)
                };
                if wrong {
                    let [x, y] = other.0;
                    let problem = if ring == other_ring {
                        format!("ring {ring} meets itself near [{x}, {y}]")
                    } else {
                        format!("rings {ring} and {other_ring} meet near [{x}, {y}]")
                    };
                    return Err((
                        problem,
                        "list the corners in the order in which one walks along the wall, each once",
                    ));
                }
            }
        }
        Ok(())
    }

    /// Holes must lie within the outline and in no other hole. Since rings do not meet, one corner per ring decides.
    fn check_holes(&self) -> Result<(), Fault> {
        let (outline, holes) = (&self.rings[0], &self.rings[1..]);
        for (index, hole) in holes.iter().enumerate() {
            let within_other =
                holes.iter().enumerate().any(|(other, ring)| other != index && ring_contains(ring, hole[0]));
            if within_other || !ring_contains(outline, hole[0]) {
                let problem = format!("ring {} is no hole of ring 0", index + 1);
                return Err((
                    problem,
                    "give one outline first, then the holes in it; a second area is a room of its own",
                ));
            }
        }
        Ok(())
    }

    /// The rings: the outline, then the holes, each without a repeated corner at its end.
    #[must_use]
    pub fn rings(&self) -> &[Vec<[f64; 2]>] {
        &self.rings
    }

    /// Number of corners of all rings, equal to the number of edges.
    pub(crate) fn corners(&self) -> usize {
        self.corners
    }

    fn edges(&self) -> impl Iterator<Item = Edge> {
        self.rings.iter().flat_map(|ring| edges(ring))
    }

    /// Area in square metres, without the holes.
    #[must_use]
    pub fn area_m2(&self) -> f64 {
        self.rings.iter().map(|ring| signed_area_m2(ring)).sum()
    }

    /// South-west and north-east corner of the bounding rectangle.
    pub(super) fn around(&self) -> [[f64; 2]; 2] {
        let corners = || self.rings[0].iter();
        let least = std::array::from_fn(|axis| corners().map(|corner| corner[axis]).fold(f64::INFINITY, f64::min));
        let most = std::array::from_fn(|axis| corners().map(|corner| corner[axis]).fold(f64::NEG_INFINITY, f64::max));
        [least, most]
    }

    /// Area within the rectangle, in square metres.
    fn area_within_m2(&self, min: [f64; 2], max: [f64; 2]) -> f64 {
        let size = minus(max, min);
        let area_m2: f64 = self.edges().map(|(a, b)| strip_m2(minus(a, min), minus(b, min), size)).sum();
        let most_m2 = size[0] * size[1];
        if area_m2 > NOTHING * most_m2 { area_m2.min(most_m2) } else { 0.0 }
    }

    /// Whether the point is inside or on an edge.
    fn contains(&self, point: [f64; 2]) -> bool {
        self.is_near(point, ON_EDGE_M)
    }

    /// Whether the point is inside, or within this reach of an edge.
    pub(super) fn is_near(&self, point: [f64; 2], reach_m: f64) -> bool {
        // Rings do not meet, so a point in a hole has an even number of edges to its east.
        self.edges().filter(|edge| is_east(*edge, point)).count() % 2 == 1
            || self.edges().any(|edge| edge_distance_m(point, edge) <= reach_m)
    }

    /// Distance in metres from the point; zero inside.
    fn distance_m(&self, point: [f64; 2]) -> f64 {
        if self.contains(point) {
            return 0.0;
        }
        self.edges().map(|edge| edge_distance_m(point, edge)).fold(f64::INFINITY, f64::min)
    }

    fn meets(&self, other: &Self) -> bool {
        self.contains(other.rings[0][0])
            || other.contains(self.rings[0][0])
            || self.edges().any(|own| other.edges().any(|edge| edges_meet(own, edge)))
    }

    /// The x of the edges that cross this y, in ascending order; every two of them bound a stretch inside.
    fn crossings(&self, y: f64) -> Vec<f64> {
        let mut crossings: Vec<f64> = (self.edges())
            .filter(|(a, b)| (a[1] > y) != (b[1] > y))
            .map(|(a, b)| a[0] + (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1]))
            .collect();
        crossings.sort_by(f64::total_cmp);
        crossings
    }

    /// The middle of the widest stretch inside at this y.
    fn widest(&self, y: f64) -> Option<f64> {
        let crossings = self.crossings(y);
        let widest = crossings.chunks_exact(2).max_by(|a, b| (a[1] - a[0]).total_cmp(&(b[1] - b[0])))?;
        Some(0.5 * (widest[0] + widest[1]))
    }
}

/// The space of a room, a part or a group: a box or, with a footprint, the prism over it.
#[derive(Debug, Clone, PartialEq)]
pub struct Space {
    /// The box, or the bounding box of the prism.
    pub bounds: Box3,
    /// The outline; `None` for a box.
    pub footprint: Option<Footprint>,
}

impl Space {
    /// Size of `bounds` along each axis, in metres.
    #[must_use]
    pub fn size_m(&self) -> [f64; 3] {
        self.bounds.size_m()
    }

    /// The middle of `bounds`. If it is outside the footprint, the middle of the widest stretch of the footprint from west to east through it.
    #[must_use]
    pub fn centre_m(&self) -> [f64; 3] {
        let [x, y, z] = self.bounds.centre_m();
        let within = self.footprint.as_ref().filter(|footprint| !footprint.contains([x, y]));
        [within.and_then(|footprint| footprint.widest(y)).unwrap_or(x), y, z]
    }

    /// V_o of the paper: the common volume with a box in cubic metres; zero if they only touch.
    #[must_use]
    #[inline]
    pub(crate) fn overlap_m3(&self, other: &Box3) -> f64 {
        let boxes_m3 = self.bounds.overlap_m3(other);
        if boxes_m3 > 0.0
            && let Some(footprint) = &self.footprint
        {
            return self.prism_overlap_m3(footprint, other);
        }
        boxes_m3
    }

    /// Number of edges that [`Space::overlap_m3`] tests.
    pub(crate) fn edges_met(&self, other: &Box3) -> usize {
        let meets = |_: &&Footprint| self.bounds.overlap_m3(other) > 0.0;
        self.footprint.as_ref().filter(meets).map_or(0, Footprint::corners)
    }

    /// Number of edges that [`Space::contains`] tests.
    pub(crate) fn edges_at(&self, point_m: &[f64; 3]) -> usize {
        let holds = |_: &&Footprint| self.bounds.contains(point_m);
        self.footprint.as_ref().filter(holds).map_or(0, Footprint::corners)
    }

    /// Separate, so that boxes without footprint stay fast.
    #[inline(never)]
    fn prism_overlap_m3(&self, footprint: &Footprint, other: &Box3) -> f64 {
        let height_m = self.bounds.max_m[2].min(other.max_m[2]) - self.bounds.min_m[2].max(other.min_m[2]);
        let level = |[x, y, _]: [f64; 3]| [x, y];
        height_m * footprint.area_within_m2(level(other.min_m), level(other.max_m))
    }

    /// Whether the point is inside or on a face.
    #[must_use]
    pub fn contains(&self, point_m: &[f64; 3]) -> bool {
        let [x, y, _] = *point_m;
        self.bounds.contains(point_m) && self.footprint.as_ref().is_none_or(|footprint| footprint.contains([x, y]))
    }

    /// Distance in metres to the point; zero inside.
    #[must_use]
    pub fn distance_m(&self, point_m: &[f64; 3]) -> f64 {
        let Some(footprint) = &self.footprint else { return self.bounds.distance_m(point_m) };
        let [x, y, z] = *point_m;
        let above_m = (self.bounds.min_m[2] - z).max(z - self.bounds.max_m[2]).max(0.0);
        footprint.distance_m([x, y]).hypot(above_m)
    }

    /// The common volume in cubic metres. For two prisms it is a sum over stripes of one of them.
    #[must_use]
    pub fn shared_m3(&self, other: &Self) -> f64 {
        const STRIPES: u32 = 64;
        if self.bounds.overlap_m3(&other.bounds) <= 0.0 {
            return 0.0;
        }
        let (Some(_), Some(footprint)) = (&self.footprint, &other.footprint) else {
            let of_box = if self.footprint.is_some() { (self, other) } else { (other, self) };
            return of_box.0.overlap_m3(&of_box.1.bounds);
        };
        let Box3 { min_m, max_m } = other.bounds;
        let width_m = (max_m[1] - min_m[1]) / f64::from(STRIPES);
        let stripe_m3 = |stripe: u32| -> f64 {
            let south_m = min_m[1] + width_m * f64::from(stripe);
            let crossings = footprint.crossings(south_m + 0.5 * width_m);
            let within = crossings.chunks_exact(2).map(|stretch| Box3 {
                min_m: [stretch[0], south_m, min_m[2]],
                max_m: [stretch[1], south_m + width_m, max_m[2]],
            });
            within.map(|stretch| self.overlap_m3(&stretch)).sum()
        };
        (0..STRIPES).map(stripe_m3).sum()
    }

    /// Its volume in cubic metres.
    #[must_use]
    pub fn volume_m3(&self) -> f64 {
        match &self.footprint {
            Some(footprint) => footprint.area_m2() * self.bounds.size_m()[2],
            None => self.bounds.volume_m3(),
        }
    }

    /// Whether the two share more than a face.
    pub(super) fn meets(&self, other: &Self) -> bool {
        if self.bounds.overlap_m3(&other.bounds) <= 0.0 {
            return false;
        }
        match (&self.footprint, &other.footprint) {
            (Some(own), Some(footprint)) => own.meets(footprint),
            (Some(_), None) => self.overlap_m3(&other.bounds) > 0.0,
            (None, _) => other.overlap_m3(&self.bounds) > 0.0,
        }
    }

    /// The outlines on the floor: the footprint's rings, or the corners of the box.
    #[must_use]
    pub fn rings(&self) -> Vec<Vec<[f64; 2]>> {
        let Some(footprint) = &self.footprint else {
            let ([left, south, _], [right, north, _]) = (self.bounds.min_m, self.bounds.max_m);
            return vec![vec![[left, south], [right, south], [right, north], [left, north]]];
        };
        footprint.rings.clone()
    }
}

impl From<Box3> for Space {
    fn from(bounds: Box3) -> Self {
        Self { bounds, footprint: None }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// An L: four by four metres without the north-east quarter.
    const L: [[f64; 2]; 6] = [[0.0, 0.0], [4.0, 0.0], [4.0, 2.0], [2.0, 2.0], [2.0, 4.0], [0.0, 4.0]];

    fn space(rings: &[Vec<[f64; 2]>]) -> Space {
        let footprint = Footprint::new(rings).unwrap();
        let [[left, south], [right, north]] = footprint.around();
        let bounds = Box3 { min_m: [left, south, 0.0], max_m: [right, north, 2.0] };
        Space { bounds, footprint: Some(footprint) }
    }

    /// A star around a point, of any concave shape, with up to two holes: rings with random corners sorted by angle never cross themselves.
    pub(crate) fn any_rings() -> impl Strategy<Value = Vec<Vec<[f64; 2]>>> {
        let radii = |least: f64, most: f64| prop::collection::vec(least..most, 3..14);
        let ring = |centre: [f64; 2], radii: Vec<f64>| -> Vec<[f64; 2]> {
            let count = radii.len() as f64;
            let corner = |(index, radius): (usize, f64)| {
                let angle = std::f64::consts::TAU * (index as f64 + 0.3) / count;
                [centre[0] + radius * angle.cos(), centre[1] + radius * angle.sin()]
            };
            radii.into_iter().enumerate().map(corner).collect()
        };
        (
            prop::array::uniform2(-3.0..3.0f64),
            radii(2.0, 5.0),
            prop::collection::vec(radii(0.05, 0.3), 0..3),
            any::<bool>(),
        )
            .prop_map(move |(centre, outline, holes, backwards)| {
                let mut rings = vec![ring(centre, outline)];
                for (index, hole) in holes.into_iter().enumerate() {
                    // A triangle of radius 2 has an inner circle of radius 1: the holes stay within it and apart.
                    let side = if index == 0 { -0.4 } else { 0.4 };
                    rings.push(ring([centre[0] + side, centre[1]], hole));
                }
                if backwards {
                    rings.iter_mut().for_each(|ring| ring.reverse());
                }
                rings
            })
    }

    /// The area of the rings in the rectangle, in square metres, by sampling a grid.
    pub(crate) fn sampled_m2(rings: &[Vec<[f64; 2]>], min: [f64; 2], max: [f64; 2]) -> f64 {
        const STEPS: usize = 160;
        let at = |axis: usize, step: usize| min[axis] + (max[axis] - min[axis]) * (step as f64 + 0.5) / STEPS as f64;
        let inside = |point: [f64; 2]| {
            let crossings = rings.iter().flat_map(|ring| {
                (0..ring.len()).filter(move |&index| {
                    let (a, b) = (ring[index], ring[(index + 1) % ring.len()]);
                    (a[1] > point[1]) != (b[1] > point[1])
                        && a[0] + (b[0] - a[0]) * (point[1] - a[1]) / (b[1] - a[1]) > point[0]
                })
            });
            crossings.count() % 2 == 1
        };
        let points = (0..STEPS).flat_map(|x| (0..STEPS).map(move |y| (x, y)));
        let hits = points.filter(|&(x, y)| inside([at(0, x), at(1, y)])).count();
        hits as f64 / (STEPS * STEPS) as f64 * (max[0] - min[0]) * (max[1] - min[1])
    }

    #[test]
    fn a_footprint_of_too_many_corners_is_refused_at_once() {
        let zigzag = |count: usize| -> Vec<[f64; 2]> {
            let corner = |index: usize| [1.0 + 8.0 * (index % 2) as f64, 100.0 * index as f64 / count as f64];
            // The last corners cross all others.
            [[0.0, -1.0]].into_iter().chain((0..count).map(corner)).chain([[0.0, 101.0], [9.0, -1.0]]).collect()
        };
        let problem = |count: usize| Footprint::new(&[zigzag(count)]).unwrap_err().0;
        assert!(problem(MAX_CORNERS - 3).contains("meets itself"), "{}", problem(MAX_CORNERS - 3));
        assert_eq!(problem(MAX_CORNERS - 2), "has more than 10000 corners");
        let holes = vec![vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]; MAX_CORNERS / 3 + 1];
        assert_eq!(Footprint::new(&holes).unwrap_err().0, "has more than 10000 corners");
    }

    #[test]
    fn an_l_has_no_area_in_its_notch() {
        let room = space(&[L.to_vec()]);
        let thing = |min_m: [f64; 3], max_m: [f64; 3]| room.overlap_m3(&Box3 { min_m, max_m });
        assert_eq!(thing([0.0, 0.0, 0.0], [4.0, 4.0, 2.0]), 24.0);
        assert_eq!(thing([2.5, 2.5, 0.0], [3.5, 3.5, 1.0]), 0.0, "in the notch");
        assert_eq!(thing([1.0, 1.0, 0.0], [3.0, 3.0, 1.0]), 3.0, "around the inner corner");
        assert_eq!(thing([9.0, 9.0, 0.0], [9.5, 9.5, 1.0]), 0.0);
        assert!(
            room.contains(&[1.0, 3.0, 1.0]) && !room.contains(&[3.0, 3.0, 1.0]) && !room.contains(&[1.0, 1.0, 3.0])
        );
        assert!(room.contains(&[2.0, 3.0, 1.0]), "a wall belongs to its room");
        assert_eq!(room.distance_m(&[3.0, 3.0, 1.0]), 1.0);
        assert_eq!(room.distance_m(&[1.0, 1.0, 3.0]), 1.0);
        assert_eq!(room.footprint.as_ref().unwrap().area_m2(), 12.0);
    }

    #[test]
    fn the_centre_lies_within() {
        let u: Vec<[f64; 2]> = vec![[0., 0.], [6., 0.], [6., 4.], [5., 4.], [5., 1.], [2., 1.], [2., 4.], [0., 4.]];
        assert_eq!(space(&[u]).centre_m(), [1.0, 2.0, 1.0]);
    }

    #[test]
    fn rings_are_taken_closed_or_open_and_either_way_round() {
        let open = space(&[L.to_vec()]);
        let mut closed = L.to_vec();
        closed.push(L[0]);
        assert_eq!(space(&[closed.clone()]), open);
        closed.reverse();
        assert_eq!(space(&[closed]).footprint.unwrap().area_m2(), 12.0);
    }

    #[test]
    fn rings_that_are_no_outline_are_refused() {
        let square = |x: f64, y: f64, size: f64| vec![[x, y], [x + size, y], [x + size, y + size], [x, y + size]];
        let cases: [(&[Vec<[f64; 2]>], &str); 11] = [
            (&[], "has no ring"),
            (&[vec![[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]], "fewer than 3 corners"),
            (&[vec![[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]], "no area"),
            (&[vec![[0.0, 0.0], [2.0, 3.0], [2.0, 0.0], [0.0, 2.0]]], "ring 0 meets itself"),
            (&[vec![[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [4.0, 1.0], [0.0, 1.0]]], "ring 0 meets itself"),
            (&[vec![[0., 0.], [2., 0.], [1., 1.], [2., 2.], [0., 2.], [1., 1.]]], "ring 0 meets itself"),
            (&[square(0.0, 0.0, 4.0), square(3.0, 3.0, 2.0)], "rings 0 and 1 meet"),
            (&[square(0.0, 0.0, 4.0), square(2.0, 2.0, 2.0)], "meet"),
            (&[square(0.0, 0.0, 4.0), square(6.0, 6.0, 2.0)], "ring 1 is no hole of ring 0"),
            (&[square(0.0, 0.0, 9.0), square(1.0, 1.0, 5.0), square(2.0, 2.0, 1.0)], "ring 2 is no hole"),
            (&[square(1.0, 1.0, 1.0), square(0.0, 0.0, 4.0)], "ring 1 is no hole"),
        ];
        for (rings, expected) in cases {
            let (problem, _) = Footprint::new(rings).unwrap_err();
            assert!(problem.contains(expected), "{rings:?}: {problem}");
        }
    }

    proptest! {
        #[test]
        fn areas_add_up(rings in any_rings(), min in prop::array::uniform2(-9.0..5.0f64), size in prop::array::uniform2(0.2..9.0f64), cut in 0.1..0.9f64) {
            let footprint = Footprint::new(&rings).unwrap();
            let (max, middle) = ([min[0] + size[0], min[1] + size[1]], min[0] + cut * size[0]);
            let halves = footprint.area_within_m2(min, [middle, max[1]]) + footprint.area_within_m2([middle, min[1]], max);
            prop_assert!((footprint.area_within_m2(min, max) - halves).abs() < 1e-8);
            let [least, most] = footprint.around();
            prop_assert!((footprint.area_within_m2(least, most) - footprint.area_m2()).abs() < 1e-8);
        }

        #[test]
        fn hostile_rings_never_panic(rings in prop::collection::vec(prop::collection::vec(prop::array::uniform2(0..4i32), 0..9), 0..4)) {
            let rings: Vec<Vec<[f64; 2]>> =
                rings.iter().map(|ring| ring.iter().map(|corner| corner.map(f64::from)).collect()).collect();
            if let Ok(footprint) = Footprint::new(&rings) {
                let [least, most] = footprint.around();
                prop_assert!((footprint.area_within_m2(least, most) - footprint.area_m2()).abs() < 1e-9);
                prop_assert!(footprint.area_m2() > 0.0);
            }
        }
    }

    /// The common volume of two prisms is symmetric and agrees with boxes.
    #[test]
    fn the_volume_that_two_spaces_share_is_that_of_their_outlines() {
        let prism = |corners: &[[f64; 2]]| space(&[corners.to_vec()]);
        let square = |west: f64| prism(&[[west, 0.0], [west + 2.0, 0.0], [west + 2.0, 2.0], [west, 2.0]]);
        let half = prism(&[[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]);
        let flat = Space::from(square(0.0).bounds);
        assert!((half.volume_m3() - 4.0).abs() < 1e-9 && (flat.volume_m3() - 8.0).abs() < 1e-9);
        for (one, other, expected_m3) in [
            (&half, &square(0.0), 4.0),
            (&half, &flat, 4.0),
            (&half, &square(1.0), 1.0),
            (&half, &square(2.0), 0.0),
            (&square(0.5), &flat, 6.0),
            (&flat, &flat, 8.0),
        ] {
            for shared_m3 in [one.shared_m3(other), other.shared_m3(one)] {
                assert!((shared_m3 - expected_m3).abs() < 0.02, "{shared_m3} instead of {expected_m3}");
            }
        }
    }
}
