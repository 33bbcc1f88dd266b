//! What a step gives: scores of all persons together, and of each.

use super::person::{Due, Person};
use crate::grounding::GroundedScores;
use crate::ids::{BootNs, PersonId};
use crate::scorer::DecodeStats;
use crate::scorer::certified::Effort;

/// The last narration of one start of a source that scores include.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Included {
    /// The source.
    pub source: u64,
    /// Its epoch.
    pub epoch: u64,
    /// Its sequence number in that epoch.
    pub sequence: u64,
    /// When it was observed, monotonic nanoseconds.
    pub observed_ns: BootNs,
    /// How many narrations of this epoch went into the histories.
    pub accepted: u64,
    /// The number of the voice that it was heard as ([`crate::narration::history::Voice`]).
    pub voice: u64,
    /// Grows with every narration of any source.
    pub turn: u64,
}

/// Where a step's time went, in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Timing {
    /// Writing the prompt and cutting it into tokens.
    #[serde(rename = "tokenise")]
    pub tokenise_ns: u64,
    /// Decoder calls that held the prompt; the trie's nodes ride in the same call.
    #[serde(rename = "prefix")]
    pub prefix_ns: u64,
    /// The softmax and the walk over the trie.
    #[serde(rename = "trie")]
    pub trie_ns: u64,
    /// Items and partitions.
    #[serde(rename = "ground")]
    pub ground_ns: u64,
    /// All of the step.
    #[serde(rename = "total")]
    pub total_ns: u64,
}

/// The scores after a step, of all persons together.
#[derive(Debug, Clone, Default)]
pub struct Scores {
    /// Per label `ln s_c` in nats, corrected: of one person. Of several, the mean over persons of their label's share of their label
    /// mass, times the mean label mass: everybody counts the same.
    pub label_log_prob_nats: Vec<f64>,
    /// Per partition: of one person. Of several, the probability that somebody is there next, its logarithm as the score, and the mean
    /// label mass.
    pub grounded: GroundedScores,
    /// Per start of a source, the last narration that these scores include.
    pub included: Vec<Included>,
    /// When the newest of it was observed, monotonic nanoseconds; 0 before the first.
    pub newest_observed_ns: BootNs,
    /// How the scores were reached; of several persons, what the intervals of all together show.
    pub reached: Effort,
    /// Per partition a certified lower bound of the score in nats; the score itself when exact.
    pub lower_log_score_nats: Vec<f64>,
    /// Per partition a certified upper bound of the score in nats; the score itself when exact.
    pub upper_log_score_nats: Vec<f64>,
    /// Tokens of the prompts scored in this step.
    pub prompt_tokens: usize,
    /// How many prompts the model was asked about in this step.
    pub asked: usize,
    /// How many were answered before they were asked ([`super::Ahead::keep_answer`]).
    pub prepared: usize,
    /// What was decoded in this step.
    pub stats: DecodeStats,
    /// Where the time of this step went.
    pub timing: Timing,
}

/// One person's scores: those that they would have alone.
#[derive(Debug, Clone, Copy)]
pub struct PersonScores<'a> {
    /// Who.
    pub person: PersonId,
    /// In the house. Otherwise they are in no partition.
    pub at_home: bool,
    /// Narrations that the scores were computed from; the history may have been cut since.
    pub window: usize,
    /// Nothing that they rest on has changed since: they are of what the person did last.
    pub is_current: bool,
    /// The number of these scores, which no other ones have; 0 before the first.
    pub number: u64,
    /// Per label `ln s_c` in nats, corrected.
    pub label_log_prob_nats: &'a [f64],
    /// Per partition.
    pub grounded: &'a GroundedScores,
    /// How the scores were reached.
    pub reached: Effort,
    /// Per partition a certified lower bound of `ln S_j` in nats; the score itself when exact.
    pub lower_log_score_nats: &'a [f64],
    /// Per partition a certified upper bound of `ln S_j` in nats; the score itself when exact.
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
            reached: person.reached(),
            lower_log_score_nats: &person.lower_log_score_nats,
            upper_log_score_nats: &person.upper_log_score_nats,
        }
    }
}

/// The scores of all persons together who are in the house and have scores; without anybody there, no partition is likely.
pub(super) fn together(persons: &[Person], scores: &mut Scores) {
    let scored = || persons.iter().filter(|person| person.is_scored());
    let at_home = || scored().filter(|person| person.at_home);
    let count = at_home().count();
    let Some(first) = at_home().next().or(scored().next()) else { return };
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
    // 1 - prod(1 - p), exact for small p too.
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
        // Rounding must not put the score itself outside.
        let lower = anybody(&|person| person.probability_bounds(partition).0).ln();
        scores.lower_log_score_nats[partition] = lower.min(score);
        let upper = anybody(&|person| person.probability_bounds(partition).1).ln();
        scores.upper_log_score_nats[partition] = upper.max(score);
    }
    // What is certain of each person is not of all together: only the intervals tell.
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
