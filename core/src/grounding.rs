//! From label scores to partition scores: the partition of each item, and the sums of Equation 2.
//!
//! A partition is a part of a room, a room, or a group of rooms ([`PartitionLevel`]). Geometry is done once per map, in [`Grounding::new`];
//! [`Grounding::ground`] is a matrix product per event.
//!
//! # Where an item belongs
//!
//! 1. To the partition with the largest overlap with its box, by volume (the paper's argmax of V_o). A partition with a footprint is the
//!    prism over it. The overlap with a group is the sum over its rooms.
//! 2. If several partitions have the largest overlap: to the last of them in the scene file. So a thing in a nook
//!    belongs to the nook if the nook follows the room around it. Volumes that differ by less than one part in 10^9
//!    are equal, so that rounding does not decide.
//! 3. If the box overlaps with no partition (flat, empty or outside): to the last partition that contains the
//!    item's position.
//! 4. At the level of parts: else to the nearest part of the room that rules 1 to 3 give at the level of rooms.
//! 5. Else to none: the item is listed in [`Grounding::unassigned`]. It still counts in n_l, so the score of its label is
//!    not moved into rooms of other items with that label.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::like_things::LikeThings;
use crate::matrix::Matrix;
use crate::scorer::softmax::log_sum_exp_of;
use crate::semantic_map::{Box3, Footprint, ItemId, PartitionId, RoomId, SemanticMap, Space};

mod levels;

use levels::rooms_as_partitions;
pub use levels::{partition_named, partition_names, partitions};

/// Most entries of the matrix of labels by partitions: 256 MiB.
pub const MAX_WEIGHTS: usize = 1 << 25;

/// Most footprint edges tested to place a map's items. Each item tests the edges of every footprint whose bounding box meets the item's box.
pub const MAX_LOOKS: usize = 1 << 26;

/// Volumes with a smaller relative difference tie.
const TIE: f64 = 1e-9;

crate::choices! {
    /// What a partition is.
    #[derive(Default)]
    pub enum PartitionLevel {
        /// The parts of rooms; a room without parts is one partition.
        Part,
        /// Rooms.
        #[default]
        Room,
        /// Groups of rooms; a room in no group is one partition.
        Group,
    }
}

/// Options of grounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GroundingOptions {
    /// What a partition is.
    pub level: PartitionLevel,
    /// If true, room names are labels too, each grounded in its own room.
    pub room_labels: bool,
}

impl Default for GroundingOptions {
    fn default() -> Self {
        Self { level: PartitionLevel::Room, room_labels: true }
    }
}

/// A map or scores that cannot be grounded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GroundingError {
    /// There is no label.
    #[error(
        "the map `{map}` has no items and room names are switched off as labels, so there is nothing to score; add items or allow room labels"
    )]
    NoLabels {
        /// The map's name.
        map: String,
    },
    /// More than 2^25 entries.
    #[error(
        "the map `{map}` has {labels} labels and {partitions} partitions, a matrix of more than {MAX_WEIGHTS} entries; \
         merge labels or split the building into several maps"
    )]
    TooLarge {
        /// The map's name.
        map: String,
        /// Distinct labels.
        labels: usize,
        /// Partitions.
        partitions: usize,
    },
    /// Placing the items needs more than [`MAX_LOOKS`] tests of footprint edges.
    #[error(
        "the map `{map}` has so many items near footprints of so many corners that more than {MAX_LOOKS} edges would be looked at; \
         simplify the outlines: a corner per bend of a wall is enough"
    )]
    TooManyEdges {
        /// The map's name.
        map: String,
    },
    /// The scores belong to another list of labels.
    #[error(
        "{given} label scores were given for {expected} labels; score exactly the list of `label_texts`, in its order"
    )]
    WrongLength {
        /// Number of scores given.
        given: usize,
        /// Number of labels.
        expected: usize,
    },
    /// A score is not a log-probability.
    #[error("the log-probability of `{label}` is {log_prob_nats}; it must be at most 0 and a number")]
    NotALogProbability {
        /// The label.
        label: String,
        /// Its score.
        log_prob_nats: f64,
    },
}

/// A place that gets a score.
#[derive(Debug, Clone, PartialEq)]
pub struct Partition {
    /// The id of the part, room or group.
    pub id: String,
    /// Its words.
    pub label: String,
    /// Rooms that the partition lies in or consists of.
    pub rooms: Vec<RoomId>,
    /// Spaces of the partition: one, or one per room of a group without a footprint.
    pub spaces: Vec<Space>,
}

impl Partition {
    /// V_o: the overlap with a box, in cubic metres.
    #[must_use]
    pub(crate) fn overlap_m3(&self, bounds: &Box3) -> f64 {
        self.spaces.iter().map(|own| own.overlap_m3(bounds)).sum()
    }

    /// The middle, in metres; for several rooms the middle of all.
    fn middle_m(&self) -> [f64; 3] {
        let count = self.spaces.len().max(1) as f64;
        [0, 1, 2].map(|axis| self.spaces.iter().map(|space| space.centre_m()[axis]).sum::<f64>() / count)
    }

    fn contains(&self, point_m: &[f64; 3]) -> bool {
        self.spaces.iter().any(|own| own.contains(point_m))
    }

    fn distance_m(&self, point_m: &[f64; 3]) -> f64 {
        self.spaces.iter().map(|own| own.distance_m(point_m)).fold(f64::INFINITY, f64::min)
    }

    /// A cheap lower bound of [`Self::distance_m`]: the distance to the bounding boxes.
    fn box_distance_m(&self, point_m: &[f64; 3]) -> f64 {
        self.spaces.iter().map(|own| own.bounds.distance_m(point_m)).fold(f64::INFINITY, f64::min)
    }

    fn edges(&self) -> usize {
        self.spaces.iter().filter_map(|own| own.footprint.as_ref()).map(Footprint::corners).sum()
    }
}

/// A label to score.
#[derive(Debug, Clone, PartialEq)]
pub struct ScoredLabel {
    /// Its words.
    pub text: String,
    /// The items with this label or caption.
    pub items: Vec<ItemId>,
    /// The rooms with this name; each counts as one item in its own room.
    pub rooms: Vec<RoomId>,
    /// n_l: the caption weights of the items, summed, plus the number of rooms.
    pub count: f64,
}

crate::choices! {
    /// How an item's partition was found; the rules are numbered in the [module's documentation](self).
    pub enum Placement {
        /// Rule 1: the largest overlap.
        Overlap,
        /// Rule 2: the last of several with the largest overlap.
        Tie,
        /// Rule 3: the item's position.
        Position,
        /// Rule 4: the nearest part of its room.
        NearestPart,
        /// Rule 5: no partition.
        Outside,
    }
}

/// The reason why an item is in no partition.
#[derive(Debug, Clone, PartialEq)]
pub enum Reason {
    /// Box and position are outside all partitions.
    Outside {
        /// The partition nearest to its position.
        nearest: PartitionId,
        /// The distance to it in metres.
        distance_m: f64,
    },
}

/// An item's share of a label's score: label and ln(weight / n_l).
#[derive(Debug, Clone, Copy, PartialEq)]
struct Term {
    label: usize,
    ln_share: f64,
}

/// The geometry of a map, prepared for sums. Immutable; one per map and level.
#[derive(Debug, Clone, PartialEq)]
pub struct Grounding {
    /// In the scene file's order (groups before the rooms in no group).
    pub(crate) partitions: Vec<Partition>,
    /// The items' labels, sorted; then room names without items, in the rooms' order. After [`Grounding::regroup`] the previous labels come first.
    pub(crate) scored_labels: Vec<ScoredLabel>,
    pub(crate) item_partition: Vec<Option<PartitionId>>,
    pub(crate) item_placement: Vec<Placement>,
    pub(crate) unassigned: Vec<(ItemId, Reason)>,
    /// Labels x partitions; see [`Grounding::weights()`].
    pub(crate) weights: Matrix,
    /// Weights of like things by the person's room.
    pub(crate) like_things: LikeThings,
    /// Item i's terms are `item_terms[term_start[i]..term_start[i + 1]]`.
    item_terms: Vec<Term>,
    term_start: Vec<usize>,
    /// The list contains labels without items. Cached, so that an event need not check every label.
    idle_labels: bool,
}

/// The grounding of a changed map, which keeps the indices of existing labels.
#[derive(Debug, Clone, PartialEq)]
pub struct Regrouped {
    /// The new map's grounding.
    pub grounding: Grounding,
    /// Number of labels after those that the model was prepared for. If 0, the model can stay as it is.
    pub new_labels: usize,
}

/// The scores of one event. Reuse one for all calls: it allocates nothing once it has its size.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundedScores {
    /// `ln S_j` per partition (Equation 2); minus infinity for a partition without a scored item.
    pub partition_log_score_nats: Vec<f64>,
    /// S_j / sum of all S per partition; uniform if all S are zero.
    pub partition_probability: Vec<f64>,
    /// Sum of s_c over the labels: the probability that the continuation is a label of the map. If labels' further tokens compete only with one
    /// another, the probability that it begins like a label. Under Equation 1 it can exceed one if labels begin with other labels ("coffee", "coffee
    /// maker").
    pub label_mass: f64,
    /// s_c over the largest s_c.
    pub(crate) relative: Vec<f64>,
    sums: Vec<f64>,
}

impl Default for GroundedScores {
    fn default() -> Self {
        Self {
            partition_log_score_nats: Vec::new(),
            partition_probability: Vec::new(),
            label_mass: 0.0,
            relative: Vec::new(),
            sums: Vec::new(),
        }
    }
}

impl GroundedScores {
    /// Allocates nothing once it has its size.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.partition_log_score_nats.clone_from(&other.partition_log_score_nats);
        self.partition_probability.clone_from(&other.partition_probability);
        self.label_mass = other.label_mass;
    }

    /// The scores of a person outside all `partitions`.
    pub(crate) fn nowhere(&mut self, partitions: usize) {
        self.set(0.0, std::iter::repeat_n(0.0, partitions));
    }

    /// Sets probabilities, and their logarithms as scores.
    pub(crate) fn set(&mut self, label_mass: f64, probability: impl Iterator<Item = f64>) {
        self.partition_probability.clear();
        self.partition_probability.extend(probability);
        self.partition_log_score_nats.clear();
        self.partition_log_score_nats.extend(self.partition_probability.iter().map(|p| p.ln()));
        self.label_mass = label_mass;
    }
}

impl Grounding {
    /// The partitions, in the scene file's order (groups before the rooms in no group).
    #[must_use]
    pub fn partitions(&self) -> &[Partition] {
        &self.partitions
    }

    /// The labels to score: the items' labels, sorted; then room names without items, in the rooms' order. After [`Grounding::regroup`] the previous
    /// labels come first.
    #[must_use]
    pub fn scored_labels(&self) -> &[ScoredLabel] {
        &self.scored_labels
    }

    /// The partition of each item.
    #[must_use]
    pub fn item_partition(&self) -> &[Option<PartitionId>] {
        &self.item_partition
    }

    /// The rule that placed each item.
    #[must_use]
    pub fn item_placement(&self) -> &[Placement] {
        &self.item_placement
    }

    /// The items in no partition.
    #[must_use]
    pub fn unassigned(&self) -> &[(ItemId, Reason)] {
        &self.unassigned
    }

    /// Labels x partitions: `weights[(c, r)]` is the share of label c's items in partition r. A row sums to one minus the share of the label's items
    /// outside all partitions.
    #[must_use]
    pub fn weights(&self) -> &Matrix {
        &self.weights
    }

    /// Places every item and sums up the shares. The time is proportional to items x partitions (plus tests of footprint edges, at most
    /// [`MAX_LOOKS`]), once per map.
    ///
    /// # Errors
    /// [`GroundingError::NoLabels`], [`GroundingError::TooLarge`] and [`GroundingError::TooManyEdges`].
    pub fn new(map: &SemanticMap, options: &GroundingOptions) -> Result<Self, GroundingError> {
        Self::with_labels(map, options, &[])
    }

    /// Grounds a changed map and keeps the indices of existing labels, so that a model prepared for the old list stays usable. New labels follow the
    /// old ones; labels without items stay, without weight. If [`Regrouped::new_labels`] is 0, scores of the old list by Equation 1 are scores of the
    /// new one; corrected scores ([`crate::scorer::correction`]) also depend on the set of labels.
    ///
    /// # Errors
    /// As [`Grounding::new`].
    pub fn regroup(&self, map: &SemanticMap, options: &GroundingOptions) -> Result<Regrouped, GroundingError> {
        let grounding = Self::with_labels(map, options, &self.label_texts())?;
        let new_labels = grounding.scored_labels.len() - self.scored_labels.len();
        Ok(Regrouped { grounding, new_labels })
    }

    fn with_labels(map: &SemanticMap, options: &GroundingOptions, known: &[&str]) -> Result<Self, GroundingError> {
        let partitions = partitions(map, options.level);
        let (scored_labels, place_of) = scored_labels(map, options.room_labels, known);
        if scored_labels.is_empty() {
            return Err(GroundingError::NoLabels { map: map.name.clone() });
        }
        if scored_labels.len().saturating_mul(partitions.len()) > MAX_WEIGHTS {
            let (labels, partitions) = (scored_labels.len(), partitions.len());
            return Err(GroundingError::TooLarge { map: map.name.clone(), labels, partitions });
        }

        let rooms = if options.level == PartitionLevel::Part { rooms_as_partitions(map) } else { Vec::new() };
        let mut item_partition = Vec::with_capacity(map.items.len());
        let mut item_placement = Vec::with_capacity(map.items.len());
        let mut unassigned = Vec::new();
        let mut placer = Placer { shared_m3: Vec::new(), looks: 0 };
        for (index, item) in (0u32..).zip(&map.items) {
            let (partition, placement) = (placer.place(&item.bounds, &item.position_m, &partitions))
                .or_else(|| {
                    let (room, _) = placer.place(&item.bounds, &item.position_m, &rooms)?;
                    let nearest = placer.nearest(&item.position_m, &partitions, Some(RoomId(room.0)))?;
                    Some((nearest.0, Placement::NearestPart))
                })
                .map_or((None, Placement::Outside), |(partition, placement)| (Some(partition), placement));
            if partition.is_none() {
                unassigned.extend(
                    placer
                        .nearest(&item.position_m, &partitions, None)
                        .map(|(nearest, distance_m)| (ItemId(index), Reason::Outside { nearest, distance_m })),
                );
            }
            if placer.looks > MAX_LOOKS {
                return Err(GroundingError::TooManyEdges { map: map.name.clone() });
            }
            item_partition.push(partition);
            item_placement.push(placement);
        }

        let mut weights = Matrix::zeros(scored_labels.len(), partitions.len());
        let mut item_terms = Vec::with_capacity(map.items.len());
        let mut term_start = Vec::with_capacity(map.items.len() + 1);
        for (item, partition) in map.items.iter().zip(&item_partition) {
            term_start.push(item_terms.len());
            for (label, weight) in words_of(item) {
                let label = place_of[label];
                let share = weight / scored_labels[label].count;
                item_terms.push(Term { label, ln_share: share.ln() });
                if let Some(PartitionId(partition)) = partition {
                    weights[(label, *partition as usize)] += share;
                }
            }
        }
        term_start.push(item_terms.len());
        for (label, scored) in scored_labels.iter().enumerate() {
            for room in &scored.rooms {
                // Each part of a divided room gets the same share of the room's name.
                let within = || (0..partitions.len()).filter(|&index| partitions[index].rooms.contains(room));
                let parts = within().count() as f64;
                within().for_each(|partition| weights[(label, partition)] += 1.0 / (scored.count * parts));
            }
        }
        let idle_labels = scored_labels.iter().any(|label| label.count <= 0.0);
        Ok(Self {
            like_things: LikeThings::new(&weights, &partitions.iter().map(Partition::middle_m).collect::<Vec<_>>()),
            partitions,
            scored_labels,
            idle_labels,
            item_partition,
            item_placement,
            unassigned,
            weights,
            item_terms,
            term_start,
        })
    }

    #[must_use]
    pub(crate) fn has_idle_labels(&self) -> bool {
        self.idle_labels
    }

    /// The labels to score, in the order in which [`Grounding::ground`] expects their scores.
    #[must_use]
    pub fn label_texts(&self) -> Vec<&str> {
        self.scored_labels.iter().map(|label| label.text.as_str()).collect()
    }

    /// Scores every partition: S_j = sum of s_i over the items i of partition j (Equation 2), from `ln s_c` per label in nats. The time is linear in
    /// labels x partitions, independent of the number of items. Allocates nothing once `out` has its size.
    ///
    /// # Errors
    /// If the scores are not one log-probability per label. Minus infinity is allowed.
    pub fn ground(&self, label_log_prob_nats: &[f64], out: &mut GroundedScores) -> Result<(), GroundingError> {
        self.check(label_log_prob_nats)?;
        out.sums.resize(self.weights.columns(), 0.0);

        // Relative to the likeliest label nothing overflows; partitions that underflow are summed again below.
        let reference = relative_to_largest(label_log_prob_nats, &mut out.relative);
        if self.idle_labels {
            // Labels without items are not part of the map.
            let idle = out.relative.iter_mut().zip(&self.scored_labels).filter(|(_, label)| label.count <= 0.0);
            idle.for_each(|(relative, _)| *relative = 0.0);
        }
        out.label_mass = reference.exp() * out.relative.iter().sum::<f64>();
        self.weights.transposed_product(&out.relative, &mut out.sums);

        out.partition_log_score_nats.clear();
        for (partition, &sum) in out.sums.iter().enumerate() {
            const EXACT_ABOVE: f64 = 1e-280;
            let log_score_nats = if sum > EXACT_ABOVE {
                reference + sum.ln()
            } else {
                self.log_score_nats(partition, label_log_prob_nats)
            };
            out.partition_log_score_nats.push(log_score_nats);
        }
        normalise(&out.partition_log_score_nats, &mut out.partition_probability);
        Ok(())
    }

    /// `ln s_i` per item, with s_i = s_c,i / n_l,i, from `ln s_c` per label in nats. A label without a score counts as impossible.
    pub fn item_log_score_nats<'a>(&'a self, label_log_prob_nats: &'a [f64]) -> impl ExactSizeIterator<Item = f64> {
        let log_score_nats =
            |term: &Term| label_log_prob_nats.get(term.label).copied().unwrap_or(f64::NEG_INFINITY) + term.ln_share;
        self.term_start.windows(2).map(move |bounds| match &self.item_terms[bounds[0]..bounds[1]] {
            [term] => log_score_nats(term),
            terms => log_sum_exp_of(terms.iter().map(log_score_nats)),
        })
    }

    /// Display names of the partitions, in their order, by [`partition_names`].
    #[must_use]
    pub fn partition_names(&self) -> Vec<String> {
        partition_names(&self.partitions)
    }

    /// The labels that contribute most to a partition's score, at most `count`: index in [`Grounding::scored_labels`] and
    /// ln(s_c w\[c, r\]) in nats, the largest first; equal ones in the labels' order.
    #[must_use]
    pub fn top_labels(&self, partition: PartitionId, label_log_prob_nats: &[f64], count: usize) -> Vec<(usize, f64)> {
        let column = self.weights.column(partition.0 as usize);
        let mut contributions: Vec<(usize, f64)> = (column.zip(label_log_prob_nats).enumerate())
            .filter(|(_, (weight, log_prob_nats))| *weight > 0.0 && **log_prob_nats > f64::NEG_INFINITY)
            .map(|(label, (weight, log_prob_nats))| (label, log_prob_nats + weight.ln()))
            .collect();
        contributions.sort_by(|a, b| b.1.total_cmp(&a.1));
        contributions.truncate(count);
        contributions
    }

    /// Number of items placed by the given rule.
    #[must_use]
    pub fn placed_by(&self, placement: Placement) -> usize {
        self.item_placement.iter().filter(|&&own| own == placement).count()
    }

    fn check(&self, label_log_prob_nats: &[f64]) -> Result<(), GroundingError> {
        if label_log_prob_nats.len() != self.scored_labels.len() {
            let (given, expected) = (label_log_prob_nats.len(), self.scored_labels.len());
            return Err(GroundingError::WrongLength { given, expected });
        }
        // Rounding can make a probability of one slightly larger.
        let wrong =
            label_log_prob_nats.iter().position(|log_prob_nats| log_prob_nats.is_nan() || *log_prob_nats > 1e-3);
        wrong.map_or(Ok(()), |label| {
            let log_prob_nats = label_log_prob_nats[label];
            Err(GroundingError::NotALogProbability { label: self.scored_labels[label].text.clone(), log_prob_nats })
        })
    }

    /// `ln S_j` with its own reference, for partitions with labels far below the likeliest.
    fn log_score_nats(&self, partition: usize, label_log_prob_nats: &[f64]) -> f64 {
        let column = self.weights.column(partition);
        let shares = column.zip(label_log_prob_nats).filter(|(weight, _)| *weight > 0.0);
        log_sum_exp_of(shares.map(|(weight, log_prob_nats)| log_prob_nats + weight.ln()))
    }
}

/// Fills `relative` with the labels' probabilities over the largest one. Returns the largest in nats, 0 if it is not finite.
pub(crate) fn relative_to_largest(label_log_prob_nats: &[f64], relative: &mut Vec<f64>) -> f64 {
    let largest = label_log_prob_nats.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let reference = if largest.is_finite() { largest } else { 0.0 };
    relative.clear();
    relative.extend(label_log_prob_nats.iter().map(|log_prob_nats| (log_prob_nats - reference).exp()));
    reference
}

fn normalise(log_scores_nats: &[f64], probabilities: &mut Vec<f64>) {
    probabilities.clear();
    let total_nats = log_sum_exp_of(log_scores_nats.iter().copied());
    if total_nats == f64::NEG_INFINITY {
        probabilities.resize(log_scores_nats.len(), 1.0 / log_scores_nats.len() as f64);
    } else {
        probabilities.extend(log_scores_nats.iter().map(|log_score_nats| (log_score_nats - total_nats).exp()));
    }
}

/// The labels of an item (index, weight): its captions, or its label alone.
fn words_of(item: &crate::semantic_map::Item) -> impl Iterator<Item = (usize, f64)> {
    let only = item.captions.is_empty().then_some((item.label.0 as usize, 1.0));
    only.into_iter().chain(item.captions.iter().map(|caption| (caption.label.0 as usize, caption.weight)))
}

/// The labels to score, known ones first; and for each label of the map its index among them.
fn scored_labels(map: &SemanticMap, room_labels: bool, known: &[&str]) -> (Vec<ScoredLabel>, Vec<usize>) {
    fn place<'a>(text: &'a str, labels: &mut Vec<ScoredLabel>, places: &mut HashMap<&'a str, usize>) -> usize {
        *places.entry(text).or_insert_with(|| {
            labels.push(ScoredLabel { text: text.to_owned(), items: Vec::new(), rooms: Vec::new(), count: 0.0 });
            labels.len() - 1
        })
    }
    let mut labels = Vec::new();
    let mut places = HashMap::new();
    for text in known {
        place(text, &mut labels, &mut places);
    }
    let place_of: Vec<usize> = map.labels.iter().map(|text| place(text, &mut labels, &mut places)).collect();
    for (index, item) in (0u32..).zip(&map.items) {
        for (label, weight) in words_of(item) {
            labels[place_of[label]].items.push(ItemId(index));
            labels[place_of[label]].count += weight;
        }
    }
    if room_labels {
        for (index, room) in (0u32..).zip(&map.rooms) {
            let own = place(&room.label, &mut labels, &mut places);
            labels[own].rooms.push(RoomId(index));
            labels[own].count += 1.0;
        }
    }
    (labels, place_of)
}

struct Placer {
    /// Scratch: volumes above zero.
    shared_m3: Vec<(u32, f64)>,
    /// Footprint edges tested so far.
    looks: usize,
}

impl Placer {
    /// Rules 1 to 3. Computes each volume once.
    fn place(
        &mut self,
        bounds: &Box3,
        position_m: &[f64; 3],
        partitions: &[Partition],
    ) -> Option<(PartitionId, Placement)> {
        let Self { shared_m3, looks } = self;
        let spaces = || partitions.iter().flat_map(|partition| &partition.spaces);
        *looks += spaces().map(|space| space.edges_met(bounds)).sum::<usize>();
        shared_m3.clear();
        let overlaps_m3 = (0u32..).zip(partitions.iter().map(|partition| partition.overlap_m3(bounds)));
        shared_m3.extend(overlaps_m3.filter(|(_, overlap_m3)| *overlap_m3 > 0.0));
        let largest_m3 = shared_m3.iter().map(|(_, overlap_m3)| *overlap_m3).fold(0.0, f64::max);
        if largest_m3 > 0.0 {
            let mut largest = shared_m3.iter().filter(|(_, overlap_m3)| *overlap_m3 >= largest_m3 * (1.0 - TIE));
            let first = largest.next()?.0;
            return Some(match largest.next_back() {
                Some((last, _)) => (PartitionId(*last), Placement::Tie),
                None => (PartitionId(first), Placement::Overlap),
            });
        }
        *looks += spaces().map(|space| space.edges_at(position_m)).sum::<usize>();
        let last = (0u32..).zip(partitions).filter(|(_, partition)| partition.contains(position_m)).last()?;
        Some((PartitionId(last.0), Placement::Position))
    }

    /// The first of the nearest partitions, of one room or of all, and its distance in metres.
    fn nearest(
        &mut self,
        position_m: &[f64; 3],
        partitions: &[Partition],
        room: Option<RoomId>,
    ) -> Option<(PartitionId, f64)> {
        let mut best: Option<(PartitionId, f64)> = None;
        let of_room = |partition: &Partition| room.is_none_or(|room| partition.rooms.contains(&room));
        for (index, partition) in (0u32..).zip(partitions).filter(|(_, partition)| of_room(partition)) {
            let least_m = best.map_or(f64::INFINITY, |(_, least_m)| least_m);
            if partition.box_distance_m(position_m) >= least_m {
                continue;
            }
            self.looks += partition.edges();
            let distance_m = partition.distance_m(position_m);
            if distance_m < least_m {
                best = Some((PartitionId(index), distance_m));
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TWO_ROOMS: &str = include_str!("../../tests/data/two_rooms.json");

    fn map() -> SemanticMap {
        SemanticMap::from_json(TWO_ROOMS).unwrap()
    }

    fn grounding(level: PartitionLevel) -> (SemanticMap, Grounding) {
        let map = map();
        let grounding = Grounding::new(&map, &GroundingOptions { level, room_labels: true }).unwrap();
        (map, grounding)
    }

    fn of(map: &SemanticMap, grounding: &Grounding, id: &str) -> (Option<String>, Placement) {
        let index = map.items.iter().position(|item| item.id == id).unwrap();
        let partition = grounding.item_partition[index].map(|id| grounding.partitions[id.0 as usize].id.clone());
        (partition, grounding.item_placement[index])
    }

    #[test]
    fn rooms_of_one_label_are_called_by_their_ids() {
        let map = SemanticMap::from_json(include_str!("../../scenes/ward.json")).unwrap();
        let names = Grounding::new(&map, &GroundingOptions::default()).unwrap().partition_names();
        assert_eq!(
            (&names[1], &names[5], &names[6]),
            (&"nurse station".into(), &"patient-room-1".into(), &"patient-room-2".into())
        );
        assert_eq!(names.iter().collect::<std::collections::BTreeSet<_>>().len(), names.len());
    }

    #[test]
    fn every_rule_of_placement_is_followed() {
        let (map, rooms) = grounding(PartitionLevel::Room);
        assert_eq!(of(&map, &rooms, "mug-1"), (Some("kitchen".into()), Placement::Overlap));
        assert_eq!(of(&map, &rooms, "wall-1"), (Some("living-room".into()), Placement::Tie), "the last in the file");
        assert_eq!(of(&map, &rooms, "poster-1"), (Some("living-room".into()), Placement::Position), "a flat box");
        assert_eq!(of(&map, &rooms, "bicycle-1"), (None, Placement::Outside));
        assert_eq!(rooms.unassigned, [(ItemId(8), Reason::Outside { nearest: PartitionId(1), distance_m: 3.0 })]);

        let (map, parts) = grounding(PartitionLevel::Part);
        assert_eq!(of(&map, &parts, "table-1"), (Some("kitchen/dining".into()), Placement::Overlap));
        assert_eq!(of(&map, &parts, "mug-3"), (Some("kitchen/dining".into()), Placement::NearestPart));
        assert_eq!(
            of(&map, &parts, "sofa-1"),
            (Some("living-room".into()), Placement::Overlap),
            "a room without parts"
        );

        let (map, groups) = grounding(PartitionLevel::Group);
        assert_eq!(groups.partitions.len(), 1);
        assert_eq!(of(&map, &groups, "wall-1"), (Some("all".into()), Placement::Overlap));
    }

    #[test]
    fn shares_count_items_outside_and_rooms() {
        let (map, grounding) = grounding(PartitionLevel::Room);
        let label = |text: &str| grounding.label_texts().iter().position(|label| *label == text).unwrap();
        let share = |text: &str, room: usize| grounding.weights[(label(text), room)];
        assert_eq!([share("mug", 0), share("mug", 1)], [2.0 / 3.0, 1.0 / 3.0]);
        assert_eq!([share("bicycle", 0), share("bicycle", 1)], [0.0, 0.0]);
        assert_eq!([share("kitchen", 0), share("kitchen", 1)], [1.0, 0.0]);
        assert_eq!(grounding.scored_labels[label("mug")].count, 3.0);
        assert_eq!(grounding.scored_labels.len(), map.labels.len() + 2);
    }

    #[test]
    fn a_rooms_name_is_shared_by_its_parts() {
        let (_, grounding) = grounding(PartitionLevel::Part);
        let kitchen = grounding.label_texts().iter().position(|label| *label == "kitchen").unwrap();
        assert_eq!(grounding.weights.row(kitchen), [0.5, 0.5, 0.0]);
    }

    #[test]
    fn a_room_name_that_items_bear_is_one_label() {
        let text = TWO_ROOMS.replace("\"label\": \"poster\"", "\"label\": \"kitchen\"");
        let map = SemanticMap::from_json(&text).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let kitchen = grounding.label_texts().iter().position(|label| *label == "kitchen").unwrap();
        assert_eq!(grounding.scored_labels[kitchen].count, 2.0);
        assert_eq!([grounding.weights[(kitchen, 0)], grounding.weights[(kitchen, 1)]], [0.5, 0.5]);
    }

    #[test]
    fn captions_share_an_item() {
        let captions = "\"label\": \"poster\", \"captions\": [{\"label\": \"poster\", \"weight\": 3}, {\"label\": \"mug\", \"weight\": 1}]";
        let map = SemanticMap::from_json(&TWO_ROOMS.replace("\"label\": \"poster\"", captions)).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mug = map.find_label("mug").unwrap().0 as usize;
        assert_eq!(grounding.scored_labels[mug].count, 3.25);
        assert!((grounding.weights[(mug, 1)] - 1.25 / 3.25).abs() < 1e-15);
        let log_prob_nats: Vec<f64> = (0..grounding.scored_labels.len()).map(|label| -1.0 - label as f64).collect();
        let scores: Vec<f64> = grounding.item_log_score_nats(&log_prob_nats).collect();
        let poster = map.find_label("poster").unwrap().0 as usize;
        let expected = log_prob_nats[poster].exp() * (0.75 / 0.75) + log_prob_nats[mug].exp() * (0.25 / 3.25);
        assert!((scores[7] - expected.ln()).abs() < 1e-12);
    }

    #[test]
    fn labels_may_be_impossible_and_partitions_empty() {
        let (_, grounding) = grounding(PartitionLevel::Room);
        let mut scores = GroundedScores::default();
        let never = vec![f64::NEG_INFINITY; grounding.scored_labels.len()];
        grounding.ground(&never, &mut scores).unwrap();
        assert_eq!(scores.partition_log_score_nats, [f64::NEG_INFINITY; 2]);
        assert_eq!(scores.partition_probability, [0.5; 2]);
        assert_eq!(scores.label_mass, 0.0);
    }

    #[test]
    fn what_underflows_keeps_its_logarithm() {
        let (_, grounding) = grounding(PartitionLevel::Room);
        let sofa = grounding.label_texts().iter().position(|label| *label == "sofa").unwrap();
        let maker = grounding.label_texts().iter().position(|label| *label == "coffee maker").unwrap();
        let mut log_prob_nats = vec![f64::NEG_INFINITY; grounding.scored_labels.len()];
        log_prob_nats[maker] = -3.0;
        log_prob_nats[sofa] = -2000.0;
        let mut scores = GroundedScores::default();
        grounding.ground(&log_prob_nats, &mut scores).unwrap();
        assert_eq!(scores.partition_log_score_nats, [-3.0, -2000.0]);
    }

    #[test]
    fn scores_that_are_none_are_refused() {
        let (_, grounding) = grounding(PartitionLevel::Room);
        let mut scores = GroundedScores::default();
        let count = grounding.scored_labels.len();
        let given = |value: f64| vec![value; count];
        assert!(matches!(grounding.ground(&[-1.0], &mut scores), Err(GroundingError::WrongLength { given: 1, .. })));
        for value in [f64::NAN, f64::INFINITY, 1.0] {
            assert!(matches!(
                grounding.ground(&given(value), &mut scores),
                Err(GroundingError::NotALogProbability { .. })
            ));
        }
    }

    /// A comb with nearly as many corners as a map may have, full of things.
    #[test]
    fn items_at_too_many_edges_are_refused() {
        let teeth = crate::semantic_map::MAX_CORNERS / 4 - 1;
        let tooth = |tooth: usize| {
            let y = tooth as f64 * 0.01;
            [[8.0, y], [8.0, y + 0.005], [1.0, y + 0.005], [1.0, y + 0.01]]
        };
        let north = teeth as f64 * 0.01;
        let ring: Vec<_> = [[0.0, 0.0]].into_iter().chain((0..teeth).flat_map(tooth)).chain([[0.0, north]]).collect();
        let grounded = |items: usize, at: f64| {
            let item = |index: usize| {
                serde_json::json!({"id": format!("mug-{index}"), "label": "mug", "position_m": [at, at, 1.0],
                    "box": {"min_m": [at, at, 1.0], "max_m": [at + 0.1, at + 0.1, 1.1]}})
            };
            let scene = serde_json::json!({"format": "roomcast-scene", "version": 2, "name": "comb",
                "rooms": [{"id": "comb", "label": "comb", "footprint": [ring]}],
                "items": (0..items).map(item).collect::<Vec<_>>()});
            let map = SemanticMap::from_json(&scene.to_string()).unwrap();
            Grounding::new(&map, &GroundingOptions::default())
        };
        let most = MAX_LOOKS / (4 * teeth + 2);
        assert!(grounded(most, 2.0).is_ok());
        let refused = |result: Result<Grounding, GroundingError>| {
            assert!(matches!(result, Err(GroundingError::TooManyEdges { .. })), "{:?}", result.err());
        };
        refused(grounded(most + 1, 2.0));
        // An item outside searches all partitions for the nearest.
        refused(grounded(most + 1, 50.0));
    }

    #[test]
    fn a_map_without_labels_is_refused() {
        let mut map = map();
        map.items.clear();
        map.labels.clear();
        let options = GroundingOptions { room_labels: false, ..GroundingOptions::default() };
        assert!(matches!(Grounding::new(&map, &options), Err(GroundingError::NoLabels { .. })));
        assert_eq!(
            Grounding::new(&map, &GroundingOptions::default()).unwrap().label_texts(),
            ["kitchen", "living room"]
        );
    }

    #[test]
    fn warm_buffers_stay_where_they_are() {
        let (_, grounding) = grounding(PartitionLevel::Room);
        let mut scores = GroundedScores::default();
        let log_prob_nats = vec![-2.0; grounding.scored_labels.len()];
        grounding.ground(&log_prob_nats, &mut scores).unwrap();
        let place = |scores: &GroundedScores| {
            [
                scores.partition_log_score_nats.as_ptr(),
                scores.partition_probability.as_ptr(),
                scores.relative.as_ptr(),
                scores.sums.as_ptr(),
            ]
        };
        let before = place(&scores);
        grounding.ground(&log_prob_nats, &mut scores).unwrap();
        assert_eq!(before, place(&scores));
    }

    #[test]
    fn the_top_labels_are_those_that_give_most() {
        let (_, grounding) = grounding(PartitionLevel::Room);
        let log_prob_nats = vec![-1.0; grounding.scored_labels.len()];
        let top = grounding.top_labels(PartitionId(1), &log_prob_nats, 3);
        let texts: Vec<&str> = top.iter().map(|(label, _)| grounding.scored_labels[*label].text.as_str()).collect();
        assert_eq!(texts, ["poster", "sofa", "wall"]);
        assert_eq!(top[0].1, -1.0);
    }

    const CORNERS: &str = include_str!("../../tests/data/corners.json");

    #[test]
    fn what_stands_beside_an_l_shaped_room_is_not_in_it() {
        let map = SemanticMap::from_json(CORNERS).unwrap();
        let options = |level| GroundingOptions { level, room_labels: true };
        let rooms = Grounding::new(&map, &options(PartitionLevel::Room)).unwrap();
        let room = |id: &str| of(&map, &rooms, id).0.unwrap_or_else(|| "none".to_owned());
        let expected = [
            ("fridge-1", "kitchen"),
            ("stove-1", "kitchen"),
            ("kitchen-counter-1", "kitchen"),
            ("sofa-1", "living-room"),
            ("tv-1", "living-room"),
            ("dining-table-1", "living-room"),
            ("coat-rack-1", "hallway"),
            ("mirror-1", "hallway"),
            ("bed-1", "bedroom"),
        ];
        for (item, own) in expected {
            assert_eq!(room(item), own, "{item}");
        }
        assert_eq!(of(&map, &rooms, "pillar-1"), (None, Placement::Outside), "the hole of the living room");

        // The same rooms in version 1 of the format.
        let mut file: serde_json::Value = serde_json::from_str(&map.to_json()).unwrap();
        file["version"] = 1.into();
        for list in ["rooms", "parts", "groups"] {
            for entry in file[list].as_array_mut().unwrap() {
                entry.as_object_mut().unwrap().remove("footprint");
                if list == "groups" {
                    entry.as_object_mut().unwrap().remove("box");
                }
            }
        }
        let boxes = SemanticMap::from_json(&file.to_string()).unwrap();
        let grounding = Grounding::new(&boxes, &options(PartitionLevel::Room)).unwrap();
        let wrong = expected.iter().filter(|(item, own)| of(&boxes, &grounding, item).0.as_deref() != Some(own));
        let wrong: Vec<_> = wrong.map(|(item, _)| *item).collect();
        assert_eq!(wrong, ["fridge-1", "stove-1", "kitchen-counter-1"]);

        let parts = Grounding::new(&map, &options(PartitionLevel::Part)).unwrap();
        assert_eq!(of(&map, &parts, "dining-table-1"), (Some("living-room/dining".into()), Placement::Overlap));
        let groups = Grounding::new(&map, &options(PartitionLevel::Group)).unwrap();
        assert_eq!(
            of(&map, &groups, "pillar-1"),
            (Some("day".into()), Placement::Overlap),
            "its own outline has no hole"
        );
    }

    /// A map of boxes on a coarse grid, so that ties, touching faces and flat boxes are frequent.
    fn any_map() -> impl Strategy<Value = SemanticMap> {
        let bounds = |least: i32| {
            (prop::array::uniform3(0..8i32), prop::array::uniform3(least..5i32)).prop_map(|(min, size)| {
                let min_m = min.map(f64::from);
                (min_m, std::array::from_fn::<f64, 3, _>(|axis| min_m[axis] + f64::from(size[axis])))
            })
        };
        let rooms = prop::collection::vec(bounds(1), 1..6);
        let items = prop::collection::vec((bounds(0), 0..6usize), 0..30);
        (rooms, items).prop_map(|(rooms, items)| {
            let entry = |(min_m, max_m): &([f64; 3], [f64; 3])| serde_json::json!({"min_m": min_m, "max_m": max_m});
            let rooms: Vec<_> = (rooms.iter().enumerate())
                .map(|(index, bounds)| serde_json::json!({"id": format!("r{index}"), "label": format!("room {}", index % 3), "box": entry(bounds)}))
                .collect();
            let items: Vec<_> = (items.iter().enumerate())
                .map(|(index, (bounds, label))| serde_json::json!({"id": format!("i{index}"), "label": format!("thing {label}"),
                    "position_m": bounds.0, "box": entry(bounds)}))
                .collect();
            let scene = serde_json::json!({"format": "roomcast-scene", "version": 1, "name": "any", "rooms": rooms, "items": items});
            SemanticMap::from_json(&scene.to_string()).unwrap()
        })
    }

    proptest! {
        /// The largest overlap with prisms agrees with counting grid points, if that count distinguishes two rooms.
        #[test]
        fn polygons_agree_with_brute_force(
            rooms in prop::collection::vec(crate::semantic_map::footprint::tests::any_rings(), 1..4),
            min in prop::array::uniform2(-4.0..3.0f64), size in prop::array::uniform2(0.5..4.0f64),
        ) {
            let entries: Vec<_> = rooms.iter().enumerate()
                .map(|(index, rings)| serde_json::json!({"id": format!("r{index}"), "label": "room", "footprint": rings}))
                .collect();
            let max = [min[0] + size[0], min[1] + size[1]];
            let item = serde_json::json!({"id": "i", "label": "thing", "position_m": [min[0], min[1], 0.0],
                "box": {"min_m": [min[0], min[1], 0.0], "max_m": [max[0], max[1], 1.0]}});
            let scene = serde_json::json!({"format": "roomcast-scene", "version": 2, "name": "any", "rooms": entries, "items": [item]});
            let map = SemanticMap::from_json(&scene.to_string()).unwrap();
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let shares: Vec<f64> = rooms.iter()
                .map(|rings| crate::semantic_map::footprint::tests::sampled_m2(rings, min, max) / (size[0] * size[1])).collect();
            let largest = shares.iter().copied().fold(0.0, f64::max);
            match grounding.item_partition[0] {
                Some(PartitionId(room)) => prop_assert!(shares[room as usize] >= largest - 0.03, "{shares:?} {room}"),
                None => prop_assert!(largest < 0.03, "{shares:?}"),
            }
        }

        /// Equation 2 by definition: for every partition, the sum of s_i over the items with their largest overlap there.
        #[test]
        fn sums_agree_with_brute_force(map in any_map(), seeds in prop::collection::vec(-40.0..0.0f64, 9)) {
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let log_prob_nats: Vec<f64> = (0..grounding.scored_labels.len()).map(|label| seeds[label % 9]).collect();
            let mut scores = GroundedScores::default();
            grounding.ground(&log_prob_nats, &mut scores).unwrap();
            let items: Vec<f64> = grounding.item_log_score_nats(&log_prob_nats).collect();

            let texts = grounding.label_texts();
            let mut sums = vec![0.0; map.rooms.len()];
            for (index, item) in map.items.iter().enumerate() {
                let label = texts.iter().position(|text| *text == map.labels[item.label.0 as usize]).unwrap();
                let count = map.items.iter().filter(|other| other.label == item.label).count() as f64;
                let score = log_prob_nats[label].exp() / count;
                prop_assert!((items[index] - score.ln()).abs() < 1e-9);
                let overlaps: Vec<f64> = (map.rooms.iter())
                    .map(|room| (0..3).map(|axis| {
                        let upper = item.bounds.max_m[axis].min(room.space.bounds.max_m[axis]);
                        (upper - item.bounds.min_m[axis].max(room.space.bounds.min_m[axis])).max(0.0)
                    }).product())
                    .collect();
                let largest = overlaps.iter().copied().fold(0.0, f64::max);
                let room = if largest > 0.0 {
                    overlaps.iter().rposition(|overlap| *overlap >= largest * (1.0 - TIE))
                } else {
                    map.rooms_at(item.position_m).last().map(|room| room.0 as usize)
                };
                prop_assert_eq!(grounding.item_partition[index].map(|partition| partition.0 as usize), room);
                if let Some(room) = room {
                    sums[room] += score;
                }
            }
            for (index, room) in map.rooms.iter().enumerate() {
                let label = texts.iter().position(|text| *text == room.label).unwrap();
                let count = map.rooms.iter().filter(|other| other.label == room.label).count() as f64;
                sums[index] += log_prob_nats[label].exp() / count;
            }
            let total: f64 = sums.iter().sum();
            for (index, sum) in sums.iter().enumerate() {
                prop_assert!((scores.partition_log_score_nats[index].exp() - sum).abs() <= 1e-12 * total);
                prop_assert!((scores.partition_probability[index] - sum / total).abs() < 1e-9);
            }
            let mass: f64 = log_prob_nats.iter().map(|nats| nats.exp()).sum();
            prop_assert!((scores.label_mass - mass).abs() <= 1e-12 * mass);
            let unassigned = grounding.item_partition.iter().filter(|partition| partition.is_none()).count();
            prop_assert_eq!(unassigned, grounding.unassigned.len());
        }
    }
}
