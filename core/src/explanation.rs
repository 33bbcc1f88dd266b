//! Explains a room's score: the narration that the model read, the labels behind each partition with their tokens, and their items.
//!
//! A pure function of a step's results. It follows the flow backwards, so that every number can be recomputed from the next level: a partition's
//! score is the sum of its labels' contributions, a contribution is the label's probability times the share of its items here, and a label's
//! probability is the product over its tokens (Equations 1 and 2), adjusted by the prior ([`crate::scorer::correction`]).

use std::fmt::{self, Display, Formatter};

use serde::{Deserialize, Serialize};

use crate::grounding::{GroundedScores, Grounding};
use crate::semantic_map::{PartitionId, SemanticMap};

/// The results of one step that an explanation needs.
#[derive(Debug, Clone, Copy)]
pub struct Evidence<'a> {
    /// The map.
    pub map: &'a SemanticMap,
    /// Its grounding.
    pub grounding: &'a Grounding,
    /// `ln s_c` per label in nats.
    pub label_log_prob_nats: &'a [f64],
    /// The partitions' scores.
    pub scores: &'a GroundedScores,
    /// The sentences that the model read, oldest first.
    pub narration: &'a [String],
    /// The binding sequence after them.
    pub binding: &'a str,
}

/// A token of a label.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TokenReason {
    /// Its text.
    pub piece: String,
    /// ln p(token | prompt and the tokens before it), corrected, in nats.
    pub log_prob_nats: f64,
}

/// A label behind a partition's score.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LabelReason {
    /// Its words.
    pub label: String,
    /// ln s_c in nats.
    pub log_prob_nats: f64,
    /// Share of the label's items in the partition, w\[c, r\].
    pub share: f64,
    /// s_c w\[c, r\] over the partition's score.
    pub part_of_score: f64,
    /// Ids of the label's items in the partition.
    pub items: Vec<String>,
    /// The label's tokens; empty if the scorer has no probabilities per token.
    pub tokens: Vec<TokenReason>,
    /// The prior's contribution in nats; 0 without a prior.
    pub prior_nats: f64,
}

/// A partition with the labels behind its score.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PartitionReason {
    /// Its id.
    pub id: String,
    /// Its words.
    pub label: String,
    /// Display name: the label, or the id if several partitions share the label.
    pub name: String,
    /// S_j over the sum of all S.
    pub probability: f64,
    /// ln S_j in nats.
    pub log_score_nats: f64,
    /// The labels with the largest contributions, the largest first.
    pub labels: Vec<LabelReason>,
    /// Number of further labels.
    pub other_labels: usize,
    /// Contribution of the further labels over the partition's score.
    pub other_part_of_score: f64,
}

/// The explanation of all partitions' scores.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Explanation {
    /// The sentences that the model read, oldest first.
    pub narration: Vec<String>,
    /// The binding sequence after them.
    pub binding: String,
    /// Sum of s_c over the labels.
    pub label_mass: f64,
    /// The partitions, the likeliest first.
    pub partitions: Vec<PartitionReason>,
}

/// Explains every partition's score by its `most_labels` largest contributions. `tokens` returns, for an index into [`Grounding::scored_labels`], the
/// label's tokens (empty if unknown) and the prior's contribution in nats.
///
/// # Panics
/// If the scores are those of another map, or from before the first step.
#[must_use]
pub fn explain(
    evidence: &Evidence,
    most_labels: usize,
    tokens: impl Fn(usize) -> (Vec<TokenReason>, f64),
) -> Explanation {
    let Evidence { map, grounding, label_log_prob_nats, scores, narration, binding } = *evidence;
    let names = grounding.partition_names();
    let reason = |(index, partition): (u32, &crate::grounding::Partition)| {
        let (own, place) = (PartitionId(index), index as usize);
        let log_score_nats = scores.partition_log_score_nats[place];
        let all = grounding.top_labels(own, label_log_prob_nats, usize::MAX);
        let (shown, others) = all.split_at(most_labels.min(all.len()));
        let part = |contribution_nats: f64| (contribution_nats - log_score_nats).exp();
        let labels = shown.iter().map(|&(label, contribution_nats)| {
            let scored = &grounding.scored_labels[label];
            let here = scored.items.iter().filter(|item| grounding.item_partition[item.0 as usize] == Some(own));
            let (tokens, prior_nats) = tokens(label);
            LabelReason {
                label: scored.text.clone(),
                log_prob_nats: label_log_prob_nats[label],
                share: grounding.weights[(label, place)],
                part_of_score: part(contribution_nats),
                items: here.map(|item| map.items[item.0 as usize].id.clone()).collect(),
                tokens,
                prior_nats,
            }
        });
        PartitionReason {
            id: partition.id.clone(),
            label: partition.label.clone(),
            name: names[place].clone(),
            probability: scores.partition_probability[place],
            log_score_nats,
            labels: labels.collect(),
            other_labels: others.len(),
            other_part_of_score: others.iter().map(|&(_, contribution_nats)| part(contribution_nats)).sum(),
        }
    };
    let mut partitions: Vec<PartitionReason> = (0u32..).zip(&grounding.partitions).map(reason).collect();
    partitions.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    Explanation {
        narration: narration.to_vec(),
        binding: binding.to_owned(),
        label_mass: scores.label_mass,
        partitions,
    }
}

impl Display for Explanation {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        writeln!(f, "The model read")?;
        for sentence in &self.narration {
            writeln!(f, "    {sentence}")?;
        }
        writeln!(f, "    {} ...", self.binding.trim_end())?;
        writeln!(f, "and gives the labels of this map {:.1} % together.", 100.0 * self.label_mass)?;
        for partition in &self.partitions {
            write!(f, "\n{partition}")?;
        }
        Ok(())
    }
}

impl Display for PartitionReason {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { name, probability, log_score_nats, .. } = self;
        writeln!(f, "{name}: {:.1} %  (ln score {log_score_nats:.3})", 100.0 * probability)?;
        for reason in &self.labels {
            writeln!(f, "{reason}")?;
        }
        if self.other_labels > 0 {
            writeln!(f, "  {:5.1} %  from {} other labels", 100.0 * self.other_part_of_score, self.other_labels)?;
        }
        Ok(())
    }
}

impl Display for LabelReason {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        const MOST_ITEMS: usize = 4;
        let Self { label, log_prob_nats, share, part_of_score, items, tokens, prior_nats } = self;
        write!(f, "  {:5.1} %  {label}: probability {:.2} %", 100.0 * part_of_score, 100.0 * log_prob_nats.exp())?;
        if *share < 1.0 - 1e-9 {
            write!(f, ", {:.0} % of it here", 100.0 * share)?;
        }
        if items.is_empty() {
            write!(f, " (the room's name)")?;
        } else {
            write!(f, " ({}", items[..items.len().min(MOST_ITEMS)].join(", "))?;
            if items.len() > MOST_ITEMS {
                write!(f, " and {} more", items.len() - MOST_ITEMS)?;
            }
            write!(f, ")")?;
        }
        let prior = *prior_nats != 0.0;
        if tokens.len() > 1 || (prior && !tokens.is_empty()) {
            write!(f, "\n           =")?;
            for (index, token) in tokens.iter().enumerate() {
                let times = if index == 0 { "" } else { " x" };
                write!(f, "{times} {:?} {:.2} %", token.piece, 100.0 * token.log_prob_nats.exp())?;
            }
            if prior {
                write!(f, " x {:.3} by the prior", prior_nats.exp())?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::GroundingOptions;

    const TWO_ROOMS: &str = include_str!("../../tests/data/two_rooms.json");

    fn explained(most_labels: usize) -> Explanation {
        let map = SemanticMap::from_json(TWO_ROOMS).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let label_log_prob_nats: Vec<f64> =
            (0..grounding.scored_labels.len()).map(|label| -1.0 - label as f64).collect();
        let mut scores = GroundedScores::default();
        grounding.ground(&label_log_prob_nats, &mut scores).unwrap();
        let narration = ["They grab the mug.".to_owned()];
        let evidence = Evidence {
            map: &map,
            grounding: &grounding,
            label_log_prob_nats: &label_log_prob_nats,
            scores: &scores,
            narration: &narration,
            binding: "Next, the human will go to the ",
        };
        explain(&evidence, most_labels, |label| {
            let token =
                |piece: &str| TokenReason { piece: piece.to_owned(), log_prob_nats: -0.625 - label as f64 / 2.0 };
            (vec![token(" a"), token(" b")], 0.25)
        })
    }

    #[test]
    fn contributions_add_up_to_every_score() {
        for most_labels in [0, 1, 3, 100] {
            for partition in explained(most_labels).partitions {
                let shown: f64 = partition.labels.iter().map(|label| label.part_of_score).sum();
                assert!((shown + partition.other_part_of_score - 1.0).abs() < 1e-12);
                let sum: f64 = partition.labels.iter().map(|label| label.log_prob_nats.exp() * label.share).sum();
                let all = shown * partition.log_score_nats.exp();
                assert!((sum - all).abs() < 1e-12);
                for label in &partition.labels {
                    let tokens: f64 = label.tokens.iter().map(|token| token.log_prob_nats).sum();
                    assert!((tokens + label.prior_nats - label.log_prob_nats).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn the_likeliest_partition_stands_first_and_items_are_its_own() {
        let explanation = explained(5);
        let partitions = &explanation.partitions;
        assert!(partitions[0].probability >= partitions[1].probability);
        let kitchen = partitions.iter().find(|partition| partition.id == "kitchen").unwrap();
        let mug = kitchen.labels.iter().find(|label| label.label == "mug").unwrap();
        assert_eq!(mug.items, ["mug-1", "mug-3"]);
    }

    #[test]
    fn the_text_says_what_was_read_and_why() {
        let text = explained(2).to_string();
        assert!(text.contains("They grab the mug."));
        assert!(text.contains("Next, the human will go to the ..."));
        assert!(text.contains("coffee maker: probability"), "{text}");
        assert!(text.contains("other labels"));
    }
}
