//! Results of a step: scores of all persons together, and of each.

use super::person::{Due, Person};
use crate::grounding::GroundedScores;
use crate::ids::{BootNs, PersonId};
use crate::scorer::DecodeStats;
use crate::scorer::certified::Effort;

/// The last event of one start of a source that scores include.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Included {
    /// The event's source.
    pub source: u64,
    /// Epoch of the source.
    pub epoch: u64,
    /// Sequence number in that epoch.
    pub sequence: u64,
    /// When the event was observed, monotonic nanoseconds.
    pub observed_ns: BootNs,
    /// Number of events of this epoch in the histories.
    pub accepted: u64,
    /// Number of the event's quota ([`crate::narration::history::Quota`]).
    pub quota: u64,
    /// Increases with every event of any source.
    pub turn: u64,
}

/// Where a step's time went, in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Timing {
    /// Writing and tokenising the prompt.
    #[serde(rename = "tokenise")]
    pub tokenise_ns: u64,
    /// Decoder calls with the prompt; nodes of the trie are in the same call.
    #[serde(rename = "prefix")]
    pub prefix_ns: u64,
    /// The softmax and the pass over the trie.
    #[serde(rename = "trie")]
    pub trie_ns: u64,
    /// Grounding in items and partitions.
    #[serde(rename = "ground")]
    pub ground_ns: u64,
    /// The whole step.
    #[serde(rename = "total")]
    pub total_ns: u64,
}

/// The combined scores of all persons after a step.
#[derive(Debug, Clone, Default)]
pub struct Scores {
    /// Per label: `ln s_c` in nats, corrected, if there is one person. For several, the logarithm of each label's share of its person's label mass,
    /// averaged over persons, times the mean label mass. Every person has the same weight.
    pub label_log_prob_nats: Vec<f64>,
    /// Per partition: the person's scores, if there is one person. For several, the probability that at least one person is there next, its logarithm
    /// as the score, and the mean label mass.
    pub grounded: GroundedScores,
    /// Per start of a source, the last event that these scores include.
    pub included: Vec<Included>,
    /// When the newest included event was observed, monotonic nanoseconds; 0 before the first.
    pub newest_observed_ns: BootNs,
    /// How exact the scores are. For several persons, as far as the combined bounds show.
    pub reached: Effort,
    /// Certified lower bound of the score per partition in nats; equal to the score if exact.
    pub lower_log_score_nats: Vec<f64>,
    /// Certified upper bound of the score per partition in nats; equal to the score if exact.
    pub upper_log_score_nats: Vec<f64>,
    /// The model takes longer for a prompt than [`super::PipelineOptions::deadline_ns`]: this step kept the last scores, without the waiting events.
    pub is_cut: bool,
    /// The least weight of a person's scores ([`PersonScores::trust`]) among the persons at home.
    pub trust: f64,
    /// Tokens of the prompts scored in this step.
    pub prompt_tokens: usize,
    /// Prompts scored in this step.
    pub asked: usize,
    /// Prompts answered by prefetched answers ([`super::Idle::keep_answer`]).
    pub prepared: usize,
    /// Cost of decoding in this step.
    pub stats: DecodeStats,
    /// Timing of this step.
    pub timing: Timing,
}

/// One person's scores, independent of other persons.
#[derive(Debug, Clone, Copy)]
pub struct PersonScores<'a> {
    /// The person.
    pub person: PersonId,
    /// Whether the person is in the house. If not, they are in no partition.
    pub at_home: bool,
    /// Number of events behind the scores; the history may have been cut since.
    pub window: usize,
    /// The scores include everything known of the person.
    pub is_current: bool,
    /// A unique number of these scores; 0 before the first.
    pub number: u64,
    /// `ln s_c` per label in nats, corrected.
    pub label_log_prob_nats: &'a [f64],
    /// Scores per partition.
    pub grounded: &'a GroundedScores,
    /// The weight of the scores in a forecast, 0 to 1. Below 1 the model does not know the words ([`crate::scorer::familiarity`]).
    pub trust: f64,
    /// How exact the scores are.
    pub reached: Effort,
    /// Certified lower bound of `ln S_j` per partition in nats; equal to the score if exact.
    pub lower_log_score_nats: &'a [f64],
    /// Certified upper bound of `ln S_j` per partition in nats; equal to the score if exact.
    pub upper_log_score_nats: &'a [f64],
}

impl<'a> PersonScores<'a> {
    pub(super) fn of(person: &'a Person) -> Self {
        Self {
            person: person.id,
            at_home: person.at_home,
            window: person.window,
            is_current: person.due == Due::Nothing,
            number: person.number,
            label_log_prob_nats: &person.scores.log_prob_nats,
            grounded: &person.grounded,
            trust: person.scores.trust,
            reached: person.reached(),
            lower_log_score_nats: &person.lower_log_score_nats,
            upper_log_score_nats: &person.upper_log_score_nats,
        }
    }
}

/// Combines the scores of all persons at home. If all are out, no partition is likely.
pub(super) fn together(persons: &[Person], scores: &mut Scores) {
    let scored = || persons.iter().filter(|person| person.is_scored());
    let at_home = || scored().filter(|person| person.at_home);
    let count = at_home().count();
    let Some(first) = at_home().next().or(scored().next()) else { return };
    scores.trust = at_home().map(|person| person.scores.trust).fold(1.0, f64::min);
    if count <= 1 {
        scores.label_log_prob_nats.clone_from(&first.scores.log_prob_nats);
        scores.grounded.copy_from(&first.grounded);
        scores.lower_log_score_nats.clone_from(&first.lower_log_score_nats);
        scores.upper_log_score_nats.clone_from(&first.upper_log_score_nats);
        scores.reached = first.reached();
        return;
    }
    let count = count as f64;
    let label_mass = at_home().map(|person| person.grounded.label_mass).sum::<f64>() / count;
    let label = |label: usize| {
        let share = |person: &Person| match person.grounded.label_mass {
            mass if mass > 0.0 => person.scores.log_prob_nats[label].exp() / mass,
            _ => 0.0,
        };
        (at_home().map(share).sum::<f64>() / count * label_mass).ln()
    };
    scores.label_log_prob_nats.clear();
    scores.label_log_prob_nats.extend((0..first.scores.log_prob_nats.len()).map(label));

    let partitions = first.grounded.partition_probability.len();
    // `1 - prod(1 - p)`, accurate for small p too.
    let anybody = |of: &dyn Fn(&Person) -> f64| -at_home().map(|person| (-of(person)).ln_1p()).sum::<f64>().exp_m1();
    scores.grounded.set(label_mass, (0..partitions).map(|j| anybody(&|p| p.grounded.partition_probability[j])));
    let score = &scores.grounded.partition_log_score_nats;
    scores.lower_log_score_nats.clone_from(score);
    scores.upper_log_score_nats.clone_from(score);
    scores.reached = Effort::Exact;
    if at_home().all(|person| person.partial().is_none()) {
        return;
    }
    for (partition, &score) in score.iter().enumerate() {
        // Rounding must not exclude the score itself.
        let lower = anybody(&|person| person.probability_bounds(partition).0).ln();
        scores.lower_log_score_nats[partition] = lower.min(score);
        let upper = anybody(&|person| person.probability_bounds(partition).1).ln();
        scores.upper_log_score_nats[partition] = upper.max(score);
    }
    // A certificate of each person's order does not order the combined scores: only their bounds do.
    let (lower, upper) = (&scores.lower_log_score_nats, &scores.upper_log_score_nats);
    let all = 0..partitions;
    let ahead = |first: usize, second: usize| lower[first] > upper[second];
    let is_separate = |a: usize| (0..a).all(|b| ahead(a, b) || ahead(b, a));
    let first = |a: usize| all.clone().all(|b| a == b || ahead(a, b));
    scores.reached = if all.clone().all(is_separate) {
        Effort::Ranking
    } else if all.clone().any(first) {
        Effort::Top
    } else {
        Effort::Deadline
    };
}
