//! Like things: the room of the next thing if a label has things in several rooms and the person's room is known.
//!
//! Equation 2 gives every thing of a label the same share of the label's score, wherever the person is. People take the nearest sink, and return to
//! the table they used before. So the forecast of a person's next room divides a label's probability differently:
//!
//! ```text
//! P(r | l) = a w(l, r) + (1 - a) v(l) (m u(l, r) + (1 - m) w(l, r) n(r) / sum over r' of w(l, r') n(r'))
//!
//! w(l, r)   the share of label l's things in room r (Equation 2)
//! v(l)      sum over r of w(l, r): the share of label l's things in any room
//! n(r)      sum over r' of b(r') k(r', r): nearness of room r to the person's believed room b
//! k(r', r)  1 in the room itself, else c exp(-distance of the rooms' middles / d)
//! u(l, r)   the person's room when a sentence last named label l as its last thing since their last rest, among the
//!           rooms with such a thing; without it, m is 0
//! a, m      the part that all things share evenly; of the rest, the part of the thing that was in use
//! ```
//!
//! Scores stay those of Equation 2. `a` is [`crate::forecast::ForecastOptions::any_thing`]; 1 gives Equation 2.

use crate::matrix::Matrix;

use crate::semantic_map::STOREY_M;

/// m: the part of the thing in use.
const AGAIN: f64 = 0.8;
/// c: nearness of another room at distance 0.
const NEXT_DOOR: f64 = 0.4;
/// d: the distance in metres at which nearness falls by a factor of e.
const FALLS_M: f64 = 4.0;
/// If the middles of two rooms differ by more than [`STOREY_M`] in height, the way between them is longer by this many times the difference.
const STAIRS: f64 = 4.0;

/// The rooms of each label's things, and the nearness of rooms. One per map.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LikeThings {
    /// The shares of label l are `shares[start[l]..start[l + 1]]`: room and w.
    shares: Vec<(u32, f64)>,
    start: Vec<usize>,
    /// The matrix k.
    near: Matrix,
}

/// The room probabilities when a thing of the label was last turned to.
#[derive(Debug, Clone)]
struct Used {
    label: usize,
    rooms: Vec<f64>,
}

/// The things that a person used recently, the last one last.
#[derive(Debug, Clone, Default)]
pub(crate) struct InUse {
    /// Entries from index `count` on are spare memory.
    used: Vec<Used>,
    count: usize,
}

impl InUse {
    const MAX: usize = 16;

    /// Records that a person with the room probabilities `belief` turned to a thing of a label.
    pub(crate) fn turn_to(&mut self, label: usize, belief: &[f64]) {
        let known = self.used[..self.count].iter().position(|used| used.label == label);
        let from = match known {
            Some(at) => at,
            None if self.count >= Self::MAX => 0,
            None => {
                if self.used.len() == self.count {
                    self.used.push(Used { label, rooms: Vec::with_capacity(belief.len()) });
                }
                self.count += 1;
                self.count - 1
            }
        };
        self.used[from..self.count].rotate_left(1);
        let used = &mut self.used[self.count - 1];
        used.label = label;
        used.rooms.clear();
        used.rooms.extend_from_slice(belief);
    }

    pub(crate) fn clear(&mut self) {
        self.count = 0;
    }

    /// Adopts another list of labels; labels without a new index are dropped.
    pub(crate) fn relabel(&mut self, new: &dyn Fn(usize) -> Option<usize>) {
        self.used.truncate(self.count);
        self.used.retain_mut(|used| new(used.label).map(|label| used.label = label).is_some());
        self.count = self.used.len();
    }

    fn rooms(&self, label: usize) -> Option<&[f64]> {
        self.used[..self.count].iter().find(|used| used.label == label).map(|used| used.rooms.as_slice())
    }
}

impl LikeThings {
    /// `weights` are w (labels x rooms); `middles_m` are the rooms' middles in metres.
    pub(crate) fn new(weights: &Matrix, middles_m: &[[f64; 3]]) -> Self {
        let near = Matrix::from_fn(middles_m.len(), middles_m.len(), |from, to| {
            let ([x, y, z], [to_x, to_y, to_z]) = (middles_m[from], middles_m[to]);
            let up_m = (z - to_z).abs();
            let stairs_m = if up_m > STOREY_M { STAIRS * up_m } else { 0.0 };
            if from == to { 1.0 } else { NEXT_DOOR * (-((x - to_x).hypot(y - to_y) + stairs_m) / FALLS_M).exp() }
        });
        let (mut shares, mut start) = (Vec::new(), vec![0]);
        for row in (0..weights.rows()).map(|label| weights.row(label)) {
            shares.extend((0u32..).zip(row.iter().copied()).filter(|(_, share)| *share > 0.0));
            start.push(shares.len());
        }
        Self { shares, start, near }
    }

    /// Probability per room that the next thing is there, from a value per label in the ratios of s_c, the person's room probabilities `belief` and the
    /// things in use; `any_thing` is a. If no label has a score in any room, all rooms are equally likely.
    ///
    /// Allocates nothing once `near` and `out` have their size.
    pub(crate) fn next_rooms(
        &self,
        by_label: &[f64],
        belief: &[f64],
        (in_use, any_thing): (&InUse, f64),
        near: &mut Vec<f64>,
        out: &mut Vec<f64>,
    ) {
        near.resize(self.near.columns(), 0.0);
        self.near.transposed_product(belief, near);
        out.clear();
        out.resize(near.len(), 0.0);
        for (label, (bounds, &p)) in self.start.windows(2).zip(by_label).enumerate() {
            let shares = &self.shares[bounds[0]..bounds[1]];
            if let [(room, share)] = shares {
                out[*room as usize] += p * share;
                continue;
            }
            let fits = |(room, share): &(u32, f64)| share * near[*room as usize];
            let all_near: f64 = shares.iter().map(fits).sum();
            if p <= 0.0 {
                continue;
            }
            let used = in_use.rooms(label);
            let all_used: f64 = used.map_or(0.0, |used| shares.iter().map(|(room, _)| used[*room as usize]).sum());
            let again = if all_used > 0.0 { AGAIN } else { 0.0 };
            // Things outside all rooms keep their share.
            let inside: f64 = shares.iter().map(|(_, share)| share).sum();
            for place @ (room, share) in shares {
                let used = used.map_or(0.0, |used| used[*room as usize] / all_used.max(f64::MIN_POSITIVE));
                // If all rooms are too far away, nearness is ignored.
                let near = if all_near > 0.0 { fits(place) / all_near } else { share / inside };
                let meant = again * used + (1.0 - again) * near;
                out[*room as usize] += p * (any_thing * share + (1.0 - any_thing) * inside * meant);
            }
        }
        let total: f64 = out.iter().sum();
        let even = 1.0 / out.len().max(1) as f64;
        out.iter_mut().for_each(|p| *p = if total > 0.0 { *p / total } else { even });
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::grounding::{GroundedScores, Grounding, GroundingOptions, relative_to_largest};
    use crate::semantic_map::SemanticMap;

    fn apartment() -> Grounding {
        let map = SemanticMap::from_json(include_str!("../../scenes/apartment-e0.json")).unwrap();
        Grounding::new(&map, &GroundingOptions::default()).unwrap()
    }

    fn next(grounding: &Grounding, nats: &[f64], belief: &[f64], in_use: &InUse, any_thing: f64) -> Vec<f64> {
        let (mut near, mut out) = (Vec::new(), Vec::new());
        let mut by_label = Vec::new();
        relative_to_largest(nats, &mut by_label);
        grounding.like_things.next_rooms(&by_label, belief, (in_use, any_thing), &mut near, &mut out);
        out
    }

    /// A label with things in several rooms, and these rooms.
    fn spread(grounding: &Grounding) -> (usize, Vec<usize>) {
        let rooms =
            |label: usize| (0..grounding.partitions.len()).filter(move |room| grounding.weights[(label, *room)] > 0.0);
        let label = (0..grounding.scored_labels.len()).max_by_key(|label| rooms(*label).count()).unwrap();
        (label, rooms(label).collect())
    }

    fn only(grounding: &Grounding, label: usize) -> Vec<f64> {
        (0..grounding.scored_labels.len()).map(|other| if other == label { 0.0 } else { f64::NEG_INFINITY }).collect()
    }

    fn at(room: usize, rooms: usize) -> Vec<f64> {
        (0..rooms).map(|other| f64::from(u8::from(other == room))).collect()
    }

    #[test]
    fn the_thing_in_the_same_room_is_meant_and_then_the_one_that_was_in_use() {
        let grounding = apartment();
        let (label, rooms) = spread(&grounding);
        let (first, second, count) = (rooms[0], rooms[1], grounding.partitions.len());
        let nats = only(&grounding, label);
        let fresh = next(&grounding, &nats, &at(first, count), &InUse::default(), 0.3);
        let likeliest = |p: &[f64]| (0..count).max_by(|a, b| p[*a].total_cmp(&p[*b])).unwrap();
        assert_eq!(likeliest(&fresh), first, "{fresh:?}");
        let mut in_use = InUse::default();
        in_use.turn_to(label, &at(second, count));
        let used = next(&grounding, &nats, &at(first, count), &in_use, 0.3);
        assert_eq!(likeliest(&used), second, "{used:?}");
        // After a change of the map, things in use are identified by label.
        let mut relabelled = in_use.clone();
        relabelled.relabel(&|label| Some(label + 1));
        assert_eq!(next(&grounding, &nats, &at(first, count), &relabelled, 0.3), fresh);
        relabelled.relabel(&|label| label.checked_sub(1));
        assert_eq!(next(&grounding, &nats, &at(first, count), &relabelled, 0.3), used);
        relabelled.relabel(&|_| None);
        assert_eq!(next(&grounding, &nats, &at(first, count), &relabelled, 0.3), fresh);
        // Newer things replace the oldest.
        (0..InUse::MAX).for_each(|other| in_use.turn_to(1_000 + other, &at(first, count)));
        assert_eq!(next(&grounding, &nats, &at(first, count), &in_use, 0.3), fresh);
        in_use.clear();
        in_use.turn_to(label, &at(second, count));
        assert_eq!(next(&grounding, &nats, &at(first, count), &in_use, 0.3), used);
    }

    #[test]
    fn another_storey_is_farther_than_the_next_room_and_what_is_beyond_all_distance_is_shared_evenly() {
        let weights = Matrix::from_fn(1, 3, |_, room| [0.0, 0.5, 0.5][room]);
        let here = [1.0, 0.0, 0.0];
        let next = |middles_m: &[[f64; 3]], any_thing: f64| {
            let (mut near, mut out) = (Vec::new(), Vec::new());
            let things = LikeThings::new(&weights, middles_m);
            things.next_rooms(&[1.0], &here, (&InUse::default(), any_thing), &mut near, &mut out);
            out
        };
        let stairs = next(&[[0.0, 0.0, 1.2], [0.0, 0.0, 4.0], [6.0, 0.0, 1.3]], 0.5);
        assert!(stairs[2] > stairs[1] && stairs[0] == 0.0, "{stairs:?}");
        assert_eq!(next(&[[0.0; 3], [1e5, 0.0, 0.0], [2e5, 0.0, 0.0]], 0.0), [0.0, 0.5, 0.5]);
    }

    proptest! {
        #[test]
        fn with_any_thing_it_is_equation_2_and_it_is_always_a_distribution(
            nats in prop::collection::vec(prop_oneof![3 => -20.0..0.0f64, 1 => Just(f64::NEG_INFINITY)], 200),
            belief in prop::collection::vec(0.0..1.0f64, 16),
            used in prop::collection::vec(0usize..200, 0..20),
            any_thing in 0.0..=1.0f64,
        ) {
            let grounding = apartment();
            let (labels, rooms) = (grounding.scored_labels.len(), grounding.partitions.len());
            prop_assume!(labels <= nats.len() && rooms <= belief.len());
            let nats = &nats[..labels];
            let total: f64 = belief[..rooms].iter().sum::<f64>() + 1e-9;
            let belief: Vec<f64> = belief[..rooms].iter().map(|p| (p + 1e-9 / rooms as f64) / total).collect();
            let mut in_use = InUse::default();
            used.iter().for_each(|label| in_use.turn_to(label % labels, &belief));
            let mut equation_2 = GroundedScores::default();
            grounding.ground(nats, &mut equation_2).unwrap();
            for (p, own) in next(&grounding, nats, &belief, &in_use, 1.0).iter().zip(&equation_2.partition_probability) {
                prop_assert!((p - own).abs() < 1e-9, "{p} and {own}");
            }
            let told_apart = next(&grounding, nats, &belief, &in_use, any_thing);
            prop_assert!((told_apart.iter().sum::<f64>() - 1.0).abs() < 1e-9);
            // A room with a share by Equation 2 keeps at least a part of it.
            for (p, own) in told_apart.iter().zip(&equation_2.partition_probability) {
                prop_assert!((0.0..=1.0).contains(p) && *p >= any_thing * own - 1e-9, "{p} and {own}");
            }
        }
    }
}
