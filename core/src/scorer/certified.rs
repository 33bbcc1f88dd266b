//! Bounds on partition scores from a part of the trie.
//!
//! Let `q(n)` be the probability of the path from the prompt to trie node `n`, and `w(c, r)` the share of label `c`'s items in partition `r`. A label
//! that ends at `n` scores exactly `q(n)`, which is known once `n`'s parent is decoded.
//!
//! **Theorem.** Let `own(m, r)` be the sum of `w(c, r)` over the labels that end at `m`, and
//! `B(n, r) = max over children m of n of own(m, r) + B(m, r)`, 0 for a leaf. Then the labels strictly below `n` add at most `q(n) B(n, r)` to the
//! score of `r`, and at least 0.
//!
//! *Proof.* By induction from the leaves. The children `m` of `n` have conditional probabilities `p_m >= 0` with `sum p_m <= 1`. The labels below `n`
//! add `sum_m q(n) p_m own(m, r)` plus the contribution of the labels below the children, at most `sum_m q(n) p_m B(m, r)`; together at most
//! `q(n) sum_m p_m (own(m, r) + B(m, r)) <= q(n) B(n, r)`. ∎
//!
//! Under [`Continuation::Labels`] the `p_m` sum to exactly 1, which makes the differences below tighter still. A prior multiplies label `c`'s score
//! by its gain, which is part of `w(c, r)`, and all scores by one scale `k`: the labels' sum without gains over their sum with gains. Both sums are
//! bounded like two more partitions, and so is `k`. The order of one person's partitions does not depend on `k`.
//!
//! Chains of labels ("coffee", "coffee maker") are covered: `own` adds up along a path. The same argument on `w(c, a) - w(c, b)`, with 0 among the
//! choices because mass may go to no label at all, bounds the *difference* of two partitions' scores far more tightly than their two intervals do; a
//! ranking is certified by these differences.
//!
//! So with `F` the undecoded nodes whose parents are decoded, `S_r` lies between `L_r`, the sum over decided labels, and
//! `L_r + sum over F of q(n) B(n, r)`.

use crate::matrix::Matrix;

use super::PreparedLabels;
use super::correction::Continuation;
use crate::label_trie::{LabelTrie, PROMPT};

crate::choices! {
    /// How far an answer goes.
    #[derive(Default, Hash)]
    pub enum Effort {
        /// Every label is scored exactly.
        #[default]
        Exact,
        /// Until the order of the partitions can no longer change.
        Ranking,
        /// Until the most likely partition is certain.
        Top,
        /// As far as the time allows.
        Deadline,
    }
}

/// Most entries of the table of pairwise bounds; above it, intervals decide, which takes more decoding.
const PAIR_ENTRIES_MAX: usize = 4 << 20;

/// `own`, `B` and the pairwise bounds of one trie under one grounding: built once.
#[derive(Debug, Clone)]
pub struct BoundTable {
    partitions: usize,
    /// The partitions, then the sum over all labels without gains, then the sum with gains.
    columns: usize,
    /// Least and greatest gain of a label. `None` without a prior.
    gains: Option<(f64, f64)>,
    /// If true, the labels below a node sum to exactly its probability.
    complete: bool,
    /// Nodes x columns.
    own: Vec<f64>,
    /// Nodes x columns: `B(n, r)`.
    below: Vec<f64>,
    /// Per inner node and ordered pair `(a, b)`: the most that the labels below can add to `S_a - S_b`, over `q(n)`. Empty if there are too many
    /// partitions.
    pairs: Vec<f64>,
}

impl BoundTable {
    /// Builds the table; `weights` has one row per label of the trie and one column per partition.
    #[must_use]
    pub fn new(prepared: &PreparedLabels, weights: &Matrix) -> Self {
        let trie = prepared.trie();
        let partitions = weights.columns();
        let columns = partitions + 2;
        let nodes = trie.nodes();
        let gains = || prepared.gain_nats().iter().map(|gain_nats| gain_nats.exp());
        let mut own = vec![0.0; nodes.len() * columns];
        for (label, (&end, gain)) in trie.label_end().iter().zip(gains()).enumerate() {
            let own = &mut own[end as usize * columns..][..columns];
            for r in 0..partitions {
                own[r] += gain * weights[(label, r)];
            }
            own[partitions] += 1.0;
            own[partitions + 1] += gain;
        }
        let mut below = vec![0.0_f64; nodes.len() * columns];
        let with_pairs = trie.inner().len() * partitions * partitions <= PAIR_ENTRIES_MAX;
        // Mass may go to no label at all, unless the labels share all of it.
        let nothing = match prepared.correction().continuation {
            Continuation::Free => 0.0,
            Continuation::Labels => f64::NEG_INFINITY,
        };
        let mut pairs = vec![nothing; if with_pairs { trie.inner().len() * partitions * partitions } else { 0 }];
        // Children stand behind their parents, so one pass from the back is the induction of the proof.
        for index in (0..nodes.len()).rev() {
            let node = nodes[index];
            if node.parent == PROMPT {
                continue;
            }
            let (this, parent) = (index * columns, node.parent as usize * columns);
            for r in 0..columns {
                below[parent + r] = below[parent + r].max(own[this + r] + below[this + r]);
            }
            if with_pairs {
                let square = partitions * partitions;
                let parent = nodes[node.parent as usize].inner as usize * square;
                for a in 0..partitions {
                    for b in 0..partitions {
                        let deeper = if node.inner == PROMPT {
                            0.0
                        } else {
                            pairs[node.inner as usize * square + a * partitions + b]
                        };
                        let gain = own[this + a] - own[this + b] + deeper;
                        let entry = &mut pairs[parent + a * partitions + b];
                        *entry = entry.max(gain);
                    }
                }
            }
        }
        let correction = prepared.correction();
        let gains =
            (correction.prior > 0.0).then(|| (gains().fold(f64::INFINITY, f64::min), gains().fold(0.0, f64::max)));
        let complete = correction.continuation == Continuation::Labels && {
            let mut ends = trie.label_end().to_vec();
            ends.sort_unstable();
            ends.windows(2).all(|pair| pair[0] != pair[1])
        };
        Self { partitions, columns, gains, complete, own, below, pairs }
    }

    /// Number of partitions.
    #[must_use]
    pub fn partitions(&self) -> usize {
        self.partitions
    }

    fn own(&self, node: usize) -> &[f64] {
        &self.own[node * self.columns..][..self.columns]
    }

    fn below(&self, node: usize) -> &[f64] {
        &self.below[node * self.columns..][..self.columns]
    }

    /// The most that one unit of mass at an inner node can add to `S_a - S_b`.
    fn pair(&self, inner: usize, node: usize, a: usize, b: usize) -> f64 {
        if self.pairs.is_empty() {
            self.below(node)[a]
        } else {
            self.pairs[(inner * self.partitions + a) * self.partitions + b]
        }
    }
}

/// Certified bounds on the partition scores of one event, and the working memory for them.
#[derive(Debug, Clone, Default)]
pub struct Bounds {
    /// `L_r` per partition, as a probability.
    pub lower: Vec<f64>,
    /// Upper bound per partition, as a probability.
    pub upper: Vec<f64>,
    /// The question that these bounds answer. It can be [`Effort::Exact`] even if less was asked for.
    pub reached: Effort,
    /// Per column: the sum over decided labels, before the scale.
    decided: Vec<f64>,
    /// Per column: the most that the undecided labels add, before the scale.
    undecided: Vec<f64>,
    /// Per column: an estimate within the bounds, which ranks the partitions.
    estimate: Vec<f64>,
    order: Vec<usize>,
    /// Undecoded inner nodes whose parent is decoded, as indices into the trie's inner nodes.
    frontier: Vec<u32>,
    impact: Vec<f64>,
    /// Smallest difference of estimates between neighbours in the ranking.
    margin: f64,
}

impl Bounds {
    /// Recomputes the bounds from `q` (per node) and `decoded` (per inner node). Allocates nothing once warm.
    ///
    /// `q` is exact if the parent is decoded. Below, it is an estimate: any sub-distribution over the children. The theorem holds for these too, so
    /// the estimates lie within the bounds.
    pub fn update(&mut self, trie: &LabelTrie, table: &BoundTable, q: &[f64], decoded: &[bool]) {
        let partitions = table.partitions;
        for values in [&mut self.decided, &mut self.undecided, &mut self.estimate] {
            values.clear();
            values.resize(table.columns, 0.0);
        }
        self.frontier.clear();
        let nodes = trie.nodes();
        let mut index = 0;
        // Nodes at or past this index are outside the undecoded subtree that is being skipped.
        let mut undecided_until = 0;
        while index < nodes.len() {
            let node = nodes[index];
            let own = table.own(index);
            for (estimate, own) in self.estimate.iter_mut().zip(own) {
                *estimate += q[index] * own;
            }
            if index >= undecided_until {
                for (decided, own) in self.decided.iter_mut().zip(own) {
                    *decided += q[index] * own;
                }
                if node.inner != PROMPT && !decoded[node.inner as usize] {
                    self.frontier.push(node.inner);
                    undecided_until = index + node.subtree as usize;
                    for (undecided, below) in self.undecided.iter_mut().zip(table.below(index)) {
                        *undecided += q[index] * below;
                    }
                }
            }
            index += 1;
        }
        let (least_scale, greatest_scale) = self.scale(table);
        let most = |column: usize| self.decided[column] + self.undecided[column];
        self.lower.clear();
        self.lower.extend((0..partitions).map(|r| least_scale * self.decided[r]));
        self.upper.clear();
        self.upper.extend((0..partitions).map(|r| greatest_scale * most(r)));
        self.order.clear();
        self.order.extend(0..partitions);
        let estimate = &self.estimate;
        self.order.sort_unstable_by(|&a, &b| estimate[b].total_cmp(&estimate[a]).then(a.cmp(&b)));
        self.margin = (self.order.windows(2))
            .map(|pair| self.estimate[pair[0]] - self.estimate[pair[1]])
            .fold(f64::INFINITY, f64::min);
    }

    /// The bounds of `k`: the quotients of the two sums' bounds, intersected with 1 over the greatest and the least gain, because `1 / k` is a mean
    /// of the gains.
    fn scale(&self, table: &BoundTable) -> (f64, f64) {
        let Some((least_gain, greatest_gain)) = table.gains else { return (1.0, 1.0) };
        let least = |column: usize| self.decided[column];
        let most = |column: usize| self.decided[column] + self.undecided[column];
        let (plain, gained) = (table.partitions, table.partitions + 1);
        let (least_sum, greatest_sum) = (if table.complete { most(plain) } else { least(plain) }, most(plain));
        // The plain sum is capped at 1 in `k`. The bound by the gains ignores the cap, so it holds only if the sum is at most 1.
        let by_gains = if greatest_sum <= 1.0 { 1.0 / greatest_gain } else { 0.0 };
        let least_scale = (least_sum.min(1.0) / most(gained)).max(by_gains);
        let greatest_scale = (greatest_sum.min(1.0) / least(gained)).min(1.0 / least_gain);
        (least_scale, greatest_scale)
    }

    /// Sets `reached`, and returns whether the bounds answer the question.
    pub(crate) fn certify(&mut self, trie: &LabelTrie, table: &BoundTable, q: &[f64], effort: Effort) -> bool {
        if self.frontier.is_empty() {
            self.reached = Effort::Exact;
            return true;
        }
        let certain = |ahead: usize, behind: usize| {
            let most: f64 = (self.frontier.iter())
                .map(|&inner| {
                    let node = trie.inner()[inner as usize] as usize;
                    q[node] * table.pair(inner as usize, node, behind, ahead)
                })
                .sum();
            self.decided[ahead] - self.decided[behind] > most
        };
        let top =
            self.order.split_first().is_some_and(|(&first, rest)| rest.iter().all(|&other| certain(first, other)));
        let ranking = top && self.order.windows(2).all(|pair| certain(pair[0], pair[1]));
        self.reached = match (top, ranking) {
            (_, true) => Effort::Ranking,
            (true, false) => Effort::Top,
            (false, false) => Effort::Deadline,
        };
        match effort {
            Effort::Exact | Effort::Deadline => false,
            Effort::Ranking => ranking,
            Effort::Top => top,
        }
    }

    /// Marks in `wanted` (per inner node) the frontier nodes to decode for the question: the heaviest, until the rest could not change the answer.
    pub(crate) fn want(
        &mut self,
        trie: &LabelTrie,
        table: &BoundTable,
        q: &[f64],
        effort: Effort,
        wanted: &mut [bool],
    ) {
        if matches!(effort, Effort::Exact | Effort::Deadline) {
            for &inner in &self.frontier {
                wanted[inner as usize] = true;
            }
            return;
        }
        self.impact.clear();
        for &inner in &self.frontier {
            let node = trie.inner()[inner as usize] as usize;
            self.impact.push(q[node] * spread(table, node));
        }
        let mut left: f64 = self.impact.iter().sum();
        while left > 0.5 * self.margin.max(0.0) {
            let Some(heaviest) = (0..self.impact.len()).max_by(|&a, &b| self.impact[a].total_cmp(&self.impact[b]))
            else {
                return;
            };
            if self.impact[heaviest] < 0.0 {
                return;
            }
            wanted[self.frontier[heaviest] as usize] = true;
            left -= self.impact[heaviest];
            self.impact[heaviest] = -1.0;
        }
        // A tie, or bounds that the spread misses and the pairs do not: at least one node is always wanted.
        if let Some(&first) = self.frontier.first()
            && !self.frontier.iter().any(|&inner| wanted[inner as usize])
        {
            wanted[first as usize] = true;
        }
    }

    /// Marks in `wanted` (per inner node) the nodes to decode together with the next event's prompt: the nodes that weighed most at this event, until
    /// the rest could not change the answer. A wrong guess costs tokens, never correctness.
    pub(crate) fn speculate(&self, trie: &LabelTrie, table: &BoundTable, q: &[f64], wanted: &mut [bool]) {
        // q(n) and the spread both shrink on the way down, so a threshold always keeps a node's ancestors with it.
        let inner = trie.inner();
        let mut threshold = 0.25 * self.margin.max(0.0) / inner.len().max(1) as f64;
        // The floor of 1e-9 applies to scores, which include the scale; `q` does not include it.
        let per_score = self.estimate[table.partitions + 1] / self.estimate[table.partitions];
        threshold = threshold.max(1e-9 * if per_score.is_finite() { per_score } else { 1.0 });
        for (place, &node) in inner.iter().enumerate() {
            wanted[place] = q[node as usize] * spread(table, node as usize) > threshold;
        }
    }
}

/// The most that one unit of mass at a node can add to any partition.
fn spread(table: &BoundTable, node: usize) -> f64 {
    table.below(node)[..table.partitions].iter().copied().fold(0.0, f64::max)
}

/// State of one person's certified scoring, reused from event to event.
#[derive(Debug, Clone)]
pub struct Certified {
    table: BoundTable,
    /// Bounds of the last event.
    pub bounds: Bounds,
    /// Per node `p(token | path to its parent)`: from this event if the parent is decoded, else from an earlier one, at first uniform. Stale values
    /// only shape estimates and guesses.
    pub(super) conditional: Vec<f64>,
    /// Per node: the product of `conditional` along its path.
    pub(super) q: Vec<f64>,
    pub(super) decoded: Vec<bool>,
    /// Inner nodes to decode in the next call.
    pub(super) wanted: Vec<bool>,
    /// Per node of `tree`: its index among the trie's inner nodes.
    pub(super) sent: Vec<u32>,
    /// Per inner node: its index in `tree`, or [`PROMPT`].
    pub(super) place: Vec<u32>,
    pub(super) tree: crate::label_trie::TokenTree,
}

impl Certified {
    /// State for prepared labels; `weights` is labels x partitions.
    #[must_use]
    pub fn new(prepared: &PreparedLabels, weights: &Matrix) -> Self {
        let trie = prepared.trie();
        let nodes = trie.nodes();
        let mut siblings = vec![0_u32; nodes.len() + 1];
        let slot = |parent: u32| if parent == PROMPT { nodes.len() } else { parent as usize };
        for node in nodes {
            siblings[slot(node.parent)] += 1;
        }
        let inner = trie.inner().len();
        Self {
            table: BoundTable::new(prepared, weights),
            bounds: Bounds::default(),
            conditional: nodes.iter().map(|n| 1.0 / f64::from(siblings[slot(n.parent)])).collect(),
            q: vec![0.0; nodes.len()],
            decoded: vec![false; inner],
            // At the first event every node may matter.
            wanted: vec![true; inner],
            sent: Vec::with_capacity(inner),
            place: vec![PROMPT; inner],
            tree: crate::label_trie::TokenTree::default(),
        }
    }

    /// Fills `tree` with the wanted nodes and their ancestors, in preorder.
    pub(super) fn plan(&mut self, trie: &LabelTrie) {
        for place in (0..self.wanted.len()).rev() {
            let parent = trie.nodes()[trie.inner()[place] as usize].parent;
            if self.wanted[place] && parent != PROMPT {
                self.wanted[trie.nodes()[parent as usize].inner as usize] = true;
            }
        }
        self.tree.clear();
        self.sent.clear();
        for place in 0..self.wanted.len() {
            self.place[place] = PROMPT;
            if self.wanted[place] {
                let node = trie.nodes()[trie.inner()[place] as usize];
                let parent = match node.parent {
                    PROMPT => PROMPT,
                    parent => self.place[trie.nodes()[parent as usize].inner as usize],
                };
                self.place[place] = self.tree.push(node.token, parent);
                self.sent.push(place as u32);
            }
        }
        self.tree.finish();
    }

    /// Recomputes `q` and the bounds after a call, and returns whether the question is answered.
    pub(super) fn settle(&mut self, trie: &LabelTrie, effort: Effort) -> bool {
        for (index, node) in trie.nodes().iter().enumerate() {
            let above = if node.parent == PROMPT { 1.0 } else { self.q[node.parent as usize] };
            self.q[index] = above * self.conditional[index];
        }
        self.bounds.update(trie, &self.table, &self.q, &self.decoded);
        self.bounds.certify(trie, &self.table, &self.q, effort)
    }

    /// Selects the nodes that the next call of this event decodes.
    pub(super) fn want_more(&mut self, trie: &LabelTrie, effort: Effort) {
        self.wanted.fill(false);
        self.bounds.want(trie, &self.table, &self.q, effort, &mut self.wanted);
        // A heavy child of a wanted node is decoded in the same call: it would be wanted next.
        for place in 0..self.wanted.len() {
            let node = trie.inner()[place] as usize;
            let parent = trie.nodes()[node].parent;
            if parent != PROMPT && !self.decoded[place] {
                let parent = trie.nodes()[parent as usize].inner as usize;
                let heavy = effort == Effort::Exact
                    || self.q[node] * spread(&self.table, node) > 0.05 * self.bounds.margin.max(0.0);
                self.wanted[place] |= self.wanted[parent] && heavy;
            }
        }
    }

    /// Selects the nodes that the first call of the next event decodes with the prompt.
    pub(super) fn guess(&mut self, trie: &LabelTrie, effort: Effort) {
        if effort == Effort::Exact {
            self.wanted.fill(true);
        } else {
            self.bounds.speculate(trie, &self.table, &self.q, &mut self.wanted);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::prompt::BindingSequence;
    use crate::scorer::correction::Correction;
    use crate::scorer::table::TableModel;
    use crate::scorer::{LabelScores, Method, Scorer, Tokenisation};

    fn exact(label_log_prob_nats: &[f64], weights: &Matrix) -> Vec<f64> {
        (0..weights.columns())
            .map(|r| label_log_prob_nats.iter().enumerate().map(|(c, l)| l.exp() * weights[(c, r)]).sum())
            .collect()
    }

    proptest! {
        /// The theorem: after every event and at any effort, the exact scores and the estimates lie within the bounds, and a certified order is the
        /// true one.
        #[test]
        fn exact_scores_lie_within_the_bounds(
            seed: u64,
            labels in proptest::collection::hash_set("[ab]{1,3}( [ab]{1,2}){0,2}", 2..25),
            shares in proptest::collection::vec(0.0..1.0f64, 25 * 4),
            prompts in proptest::collection::vec("[a-z]{1,12}", 1..5),
            effort in proptest::sample::select(vec![Effort::Exact, Effort::Ranking, Effort::Top, Effort::Deadline]),
            partitions in 1..5usize,
            continuation in proptest::sample::select(vec![Continuation::Free, Continuation::Labels]),
            prior in proptest::sample::select(vec![0.0, 0.4, 1.0]),
            twice: bool,
        ) {
            let mut labels: Vec<String> = labels.into_iter().collect();
            if twice {
                // Two labels with the same text always tie.
                labels[1] = labels[0].clone();
            }
            let mut weights = Matrix::from_fn(labels.len(), partitions, |c, r| shares[c * 4 + r].powi(3));
            for label in 0..labels.len() {
                let sum = weights.row(label).iter().sum::<f64>().max(1.0);
                (0..partitions).for_each(|room| weights[(label, room)] /= sum);
            }
            let mut scorer = Scorer::new(TableModel::new(seed));
            let prepared = scorer.prepare(&labels, &BindingSequence::default(), Tokenisation::Joint, Correction { continuation, prior }).unwrap();
            let mut state = Certified::new(&prepared, &weights);
            let mut certified = LabelScores::default();
            let mut full = LabelScores::default();
            for prompt in &prompts {
                scorer.score_certified(&prepared, &mut state, prompt, effort, Some(0), &mut certified).unwrap();
                scorer.score(&prepared, prompt, Method::Trie, &mut full).unwrap();
                let truth = exact(&full.log_prob_nats, &weights);
                let estimate = exact(&certified.log_prob_nats, &weights);
                let bounds = &state.bounds;
                for r in 0..partitions {
                    prop_assert!(bounds.lower[r] <= truth[r] + 1e-12 && truth[r] <= bounds.upper[r] + 1e-12);
                    prop_assert!(bounds.lower[r] <= estimate[r] + 1e-12 && estimate[r] <= bounds.upper[r] + 1e-12);
                }
                let order = |values: &[f64]| {
                    let mut order: Vec<usize> = (0..values.len()).collect();
                    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]).then(a.cmp(&b)));
                    order
                };
                match bounds.reached {
                    Effort::Exact => {
                        for (a, b) in full.log_prob_nats.iter().zip(&certified.log_prob_nats) {
                            prop_assert!((a - b).abs() < 1e-9);
                        }
                    }
                    Effort::Ranking => prop_assert_eq!(order(&estimate), order(&truth)),
                    Effort::Top => prop_assert_eq!(order(&estimate)[0], order(&truth)[0]),
                    Effort::Deadline => prop_assert_eq!(effort, Effort::Deadline),
                }
                if effort == Effort::Exact {
                    prop_assert_eq!(bounds.reached, Effort::Exact);
                }
            }
        }
    }
}
