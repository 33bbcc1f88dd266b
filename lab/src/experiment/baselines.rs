//! Forecasts without a language model, which the model must beat.

use std::collections::{BTreeMap, HashMap};

use serde::Deserialize;

use roomcast_core::grounding::Grounding;
use roomcast_core::names::Names;
use roomcast_core::narration::Program;
use roomcast_simulation::binding::Binder;

/// Uses of each object after a context.
type NextCounts = BTreeMap<String, BTreeMap<String, f64>>;

/// Counts of the order of objects in activity programs, in words and without a map. Immediate repeats of an object do not count, since they
/// are not targets either.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Statistics {
    pub about: String,
    pub programs: usize,
    /// Uses of each object.
    pub frequency: BTreeMap<String, f64>,
    /// Uses of each object after another.
    pub markov1: NextCounts,
    /// Uses of each object after two others, written `before>last`.
    pub markov2: NextCounts,
    /// Uses of each object after three others; `^` stands for places before the first.
    #[serde(default)]
    pub markov3: NextCounts,
    /// The fitted parameters of smoothing.
    #[serde(default)]
    pub kneser_ney: KneserNeyFit,
}

/// Stands in a context for places before the first object.
const START: &str = "^";
/// The longest context of Kneser-Ney smoothing.
const ORDER: usize = 3;
/// Counts with separate discounts: one, two, and more.
const KINDS: usize = 3;

/// The fitted parameters of Kneser-Ney smoothing and its recency cache.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KneserNeyFit {
    /// The discount of each count after 0 to 3 objects: of one, of two, and of each greater one.
    pub discounts: [[f64; KINDS]; ORDER + 1],
    /// The cache's share: objects of this activity.
    pub cache_weight: f64,
    /// Decay of the weight of each earlier object.
    pub cache_decay: f64,
}

impl Default for KneserNeyFit {
    /// The values without a split to fit them on.
    fn default() -> Self {
        Self { discounts: [[0.75; KINDS]; ORDER + 1], cache_weight: 0.15, cache_decay: 0.9 }
    }
}

impl Statistics {
    /// Reads the format of `models/household-statistics.json`.
    pub fn from_json(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }

    pub fn fit<'a>(programs: impl IntoIterator<Item = &'a Program>) -> Self {
        let mut counts = Self { about: "counted from the programs given".into(), ..Self::default() };
        for program in programs {
            counts.programs += 1;
            let mut visited: Vec<String> = Vec::new();
            for object in program.steps.iter().filter_map(|step| step.objects().first()) {
                let words = object.words();
                if visited.last() != Some(&words) {
                    visited.push(words);
                }
            }
            for words in &visited {
                *counts.frequency.entry(words.clone()).or_default() += 1.0;
            }
            let count = |table: &mut NextCounts, words: &[String]| {
                let (context, next) = words.split_at(words.len() - 1);
                *table.entry(context.join(">")).or_default().entry(next[0].clone()).or_default() += 1.0;
            };
            visited.windows(2).for_each(|words| count(&mut counts.markov1, words));
            visited.windows(3).for_each(|words| count(&mut counts.markov2, words));
            let padded = [vec![START.to_owned(); ORDER], visited].concat();
            padded.windows(ORDER + 1).for_each(|words| count(&mut counts.markov3, words));
        }
        counts
    }
}

#[derive(Debug, Clone, Default)]
struct Counts {
    total: f64,
    of_label: BTreeMap<usize, f64>,
}

impl Counts {
    fn add(&mut self, label: usize, count: f64) {
        self.total += count;
        *self.of_label.entry(label).or_default() += count;
    }

    /// The mean of the counts and `strength` pseudo-counts from `prior`.
    fn smoothed(counts: Option<&Self>, prior: &[f64], strength: f64) -> Vec<f64> {
        let Some(counts) = counts else { return prior.to_vec() };
        let mut smoothed: Vec<f64> = prior.iter().map(|p| strength * p / (strength + counts.total)).collect();
        for (label, count) in &counts.of_label {
            smoothed[*label] += count / (strength + counts.total);
        }
        smoothed
    }
}

/// Candidates for the strength of a prior; leave-one-out likelihood chooses.
const STRENGTHS: [f64; 8] = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0];

/// Pseudo-count of each label in the frequencies, so that an unseen label is possible.
const UNSEEN: f64 = 0.5;

/// The baselines for one map's labels. Each gives a probability per scored label.
#[derive(Debug, Clone)]
pub struct Baselines {
    pub frequency: Vec<f64>,
    first: HashMap<String, Counts>,
    first_strength: f64,
    second: HashMap<String, Counts>,
    second_strength: f64,
    pub kneser_ney: KneserNey,
    /// Probability that the next object is in the room of the last.
    stay: f64,
}

impl Baselines {
    /// Binds the statistics to the labels of a map. Objects that the map lacks are not targets, but still context.
    pub fn new(statistics: &Statistics, binder: &mut Binder<'_>, grounding: &Grounding) -> Self {
        let labels = grounding.scored_labels().len();
        let mut frequency = vec![UNSEEN; labels];
        for (words, count) in &statistics.frequency {
            if let Some(label) = binder.label(words) {
                frequency[label] += count;
            }
        }
        let total: f64 = frequency.iter().sum();
        frequency.iter_mut().for_each(|p| *p /= total);

        let mut bound = |table: &NextCounts| {
            let mut contexts: HashMap<String, Counts> = HashMap::new();
            for (context, next) in table {
                let mut key =
                    |words: &str| if words == START { START.to_owned() } else { key(words, binder, grounding) };
                let words: Vec<String> = context.split('>').map(&mut key).collect();
                let in_hand = context.rsplit('>').next().and_then(|last| binder.label(last));
                let counts = contexts.entry(words.join(">")).or_default();
                for (words, count) in next {
                    // Two words of one label are not two things.
                    if let Some(label) = binder.label(words).filter(|label| Some(*label) != in_hand) {
                        counts.add(label, *count);
                    }
                }
            }
            contexts
        };
        let (first, second) = (bound(&statistics.markov1), bound(&statistics.markov2));
        let first_strength = best_strength(&first, |_| frequency.clone());
        let prior = |context: &str| {
            let last = context.rsplit('>').next().unwrap_or(context);
            Counts::smoothed(first.get(last), &frequency, first_strength)
        };
        let second_strength = best_strength(&second, prior);
        let third = bound(&statistics.markov3);
        let kneser_ney = KneserNey::new(third, labels, statistics.kneser_ney);
        let stay = stay(statistics, binder);
        Self { frequency, first, first_strength, second, second_strength, kneser_ney, stay }
    }

    /// After the last object, given as a [`key`]; frequencies if it was never seen.
    pub(crate) fn markov1(&self, last: Option<&str>) -> Vec<f64> {
        Counts::smoothed(last.and_then(|last| self.first.get(last)), &self.frequency, self.first_strength)
    }

    /// After the last two objects; as [`Baselines::markov1`] if the pair was never seen.
    pub(crate) fn markov2(&self, before: Option<&str>, last: Option<&str>) -> Vec<f64> {
        let prior = self.markov1(last);
        let context = before.zip(last).map(|(before, last)| format!("{before}>{last}"));
        Counts::smoothed(context.and_then(|context| self.second.get(&context)), &prior, self.second_strength)
    }

    /// For each partition, with the fitted probability of staying in the present one.
    pub fn stay(&self, partition: Option<usize>, partitions: usize) -> Vec<f64> {
        staying(partition, self.stay, partitions)
    }
}

/// One probability for the present place, and equal parts for the others. Uniform without a present one.
pub fn staying(here: Option<usize>, stay: f64, places: usize) -> Vec<f64> {
    match here {
        Some(here) if places > 1 => {
            let other = (1.0 - stay) / (places - 1) as f64;
            (0..places).map(|place| if place == here { stay } else { other }).collect()
        }
        _ => vec![1.0 / places as f64; places],
    }
}

/// Modified Kneser-Ney smoothing, interpolated and of third order (Kneser and Ney 1995; Chen and Goodman 1999): shorter contexts count the
/// distinct longer ones before a label, and counts of one, two and more have separate discounts.
#[derive(Debug, Clone)]
pub struct KneserNey {
    tables: [HashMap<String, Counts>; ORDER + 1],
    labels: usize,
    fit: KneserNeyFit,
}

impl KneserNey {
    fn new(third: HashMap<String, Counts>, labels: usize, fit: KneserNeyFit) -> Self {
        let mut tables: [HashMap<String, Counts>; ORDER + 1] = Default::default();
        tables[ORDER] = third;
        for order in (0..ORDER).rev() {
            let (shorter, longer) = tables.split_at_mut(order + 1);
            for (context, counts) in &longer[0] {
                let context = context.split_once('>').map_or("", |(_, later)| later);
                let counted = shorter[order].entry(context.to_owned()).or_default();
                counts.of_label.keys().for_each(|label| counted.add(*label, 1.0));
            }
        }
        Self { tables, labels, fit }
    }

    /// After the last three objects, the latest last.
    pub fn after(&self, context: [Option<&str>; ORDER]) -> Vec<f64> {
        let words = context.map(|word| word.unwrap_or(START));
        let mut p = vec![1.0 / self.labels as f64; self.labels];
        for (order, table) in self.tables.iter().enumerate() {
            let Some(counts) = table.get(&words[ORDER - order..].join(">")).filter(|counts| counts.total > 0.0) else {
                continue;
            };
            let discounts = &self.fit.discounts[order];
            // Counts are whole numbers from one on.
            let taken = |count: f64| discounts[(count as usize).clamp(1, KINDS) - 1].min(count);
            let all: f64 = counts.of_label.values().copied().map(taken).sum();
            p.iter_mut().for_each(|p| *p *= all / counts.total);
            for (label, count) in &counts.of_label {
                p[*label] += (count - taken(*count)) / counts.total;
            }
        }
        p
    }

    /// A forecast of the chain with the objects of this activity, by label, the latest last; `here` is in hand and is not next.
    pub fn with_cache(&self, chain: &[f64], visited: &[usize], here: Option<usize>) -> Vec<f64> {
        Cache { weight: self.fit.cache_weight, decay: self.fit.cache_decay }.mixed(chain, visited, here)
    }
}

/// The objects of this activity, with the largest weight for the latest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cache {
    /// Its share of a forecast.
    weight: f64,
    /// Decay of the weight of each earlier object.
    decay: f64,
}

/// The cache for the model, which shows what the model has not learned. With this weight and decay, the calibration split is likeliest
/// under the shipped model.
pub(crate) const MODEL_CACHE: Cache = Cache { weight: 0.25, decay: 0.3 };
/// The chain's share in the mixture with the model and that cache, chosen in the same way.
const CHAIN_SHARE: f64 = 0.15;

/// The model mixed with the chain and the cache, which shows what it has not learned of them. All three assume that the next thing is not
/// the one in hand.
pub(crate) fn mixture(model: &[f64], chain: &[f64], visited: &[usize], in_hand: Option<usize>) -> Vec<f64> {
    let both = |(model, chain): (&f64, &f64)| (1.0 - CHAIN_SHARE) * model + CHAIN_SHARE * chain;
    let mixed: Vec<f64> = model.iter().zip(chain).map(both).collect();
    MODEL_CACHE.mixed(&mixed, visited, in_hand)
}

impl Cache {
    /// A forecast of labels, mixed with the cache; `here` is in hand and is not next.
    pub(crate) fn mixed(self, forecast: &[f64], visited: &[usize], here: Option<usize>) -> Vec<f64> {
        let mut cache = vec![0.0; forecast.len()];
        let mut weight = 1.0;
        for label in visited.iter().rev() {
            if Some(*label) != here {
                cache[*label] += weight;
            }
            weight *= self.decay;
        }
        let total: f64 = cache.iter().sum();
        if total == 0.0 {
            return forecast.to_vec();
        }
        let share = self.weight;
        forecast.iter().zip(&cache).map(|(own, cached)| (1.0 - share) * own + share * cached / total).collect()
    }
}

/// The name of an object in a context: its label in the map, so that synonyms count together, else its words.
pub fn key(name: &str, binder: &mut Binder<'_>, grounding: &Grounding) -> String {
    let label = binder.label(name);
    label.map_or_else(|| Names::built_in().words(name), |label| grounding.scored_labels()[label].text.clone())
}

/// The strength with the greatest leave-one-out likelihood of all counts.
fn best_strength(contexts: &HashMap<String, Counts>, prior: impl Fn(&str) -> Vec<f64>) -> f64 {
    let mut likelihood = [0.0; STRENGTHS.len()];
    for (context, counts) in contexts {
        let prior = prior(context);
        for (label, count) in &counts.of_label {
            for (sum, strength) in likelihood.iter_mut().zip(STRENGTHS) {
                let p = (count - 1.0 + strength * prior[*label]) / (counts.total - 1.0 + strength);
                *sum += count * p.max(f64::MIN_POSITIVE).ln();
            }
        }
    }
    let best = likelihood.iter().zip(STRENGTHS).max_by(|a, b| a.0.total_cmp(b.0));
    best.map_or(STRENGTHS[0], |(_, strength)| strength)
}

/// Probability that two consecutive objects are in the same partition, if the person chooses the second as the binder does: any of several
/// things of a kind, or the nearest to the first.
fn stay(statistics: &Statistics, binder: &mut Binder<'_>) -> f64 {
    let (mut same, mut all) = (1.0, 2.0);
    for (last, next) in &statistics.markov1 {
        let from = binder.places(last, None);
        for here in &from {
            for (words, count) in next {
                let to = binder.places(words, Some(here.position_m));
                let each = count / (from.len() * to.len()).max(1) as f64;
                for there in to.iter().filter(|there| there.label != here.label) {
                    let (Some(here), Some(there)) = (here.partition, there.partition) else { continue };
                    same += if here == there { each } else { 0.0 };
                    all += each;
                }
            }
        }
    }
    same / all
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::semantic_map::SemanticMap;
    use roomcast_simulation::binding::ItemChoice;

    #[test]
    fn counts_follow_the_programs_and_sum_to_one() {
        let text = "T\nd\n\n[Walk] <sofa> (1)\n[Find] <sofa> (1)\n[Walk] <fridge> (1)\n[StandUp]\n[Walk] <sofa> (1)\n";
        let program = Program::parse(text).unwrap();
        let statistics = Statistics::fit([&program, &program]);
        assert_eq!(statistics.frequency["sofa"], 4.0);
        assert_eq!(statistics.markov1["sofa"]["fridge"], 2.0);
        assert_eq!(statistics.markov2["sofa>fridge"]["sofa"], 2.0);

        let map = SemanticMap::from_json(include_str!("../../../scenes/studio.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut binder = Binder::new(&map, &grounding, ItemChoice::Uniform);
        let baselines = Baselines::new(&statistics, &mut binder, &grounding);
        let fridge = binder.label("fridge").unwrap();
        let likeliest = |p: &[f64]| (0..p.len()).max_by(|a, b| p[*a].total_cmp(&p[*b])).unwrap();
        let key = key("couch", &mut binder, &grounding);
        assert_eq!(likeliest(&baselines.markov1(Some(&key))), fridge);
        let chain = baselines.kneser_ney.after([None, None, Some(&key)]);
        assert_eq!(likeliest(&chain), fridge);
        let sofa = binder.label("sofa").unwrap();
        let cached = baselines.kneser_ney.with_cache(&chain, &[fridge, sofa], Some(sofa));
        assert!(cached[fridge] > 0.85 * chain[fridge] && cached[sofa] < chain[sofa]);
        assert_eq!(baselines.kneser_ney.with_cache(&chain, &[sofa], Some(sofa)), chain);
        for p in [
            chain,
            cached,
            baselines.kneser_ney.after([Some("x"), Some("y"), Some("z")]),
            baselines.kneser_ney.after([None; 3]),
            baselines.frequency.clone(),
            baselines.markov1(Some("x")),
            baselines.markov2(Some("fridge"), Some("sofa")),
        ] {
            assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        }
        assert!((baselines.stay(Some(1), 3).iter().sum::<f64>() - 1.0).abs() < 1e-9);
    }

    /// A person who takes the nearest of several things of a kind leaves the room less often than one who takes any.
    #[test]
    fn staying_is_fitted_to_which_thing_is_taken() {
        let map = SemanticMap::from_json(include_str!("../../../scenes/apartment-e0.json")).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let statistics = Statistics::from_json(include_str!("../../../models/household-statistics.json")).unwrap();
        let stay = |choice| {
            let mut binder = Binder::new(&map, &grounding, choice);
            Baselines::new(&statistics, &mut binder, &grounding).stay(Some(0), 2)[0]
        };
        let (any, nearest) = (stay(ItemChoice::Uniform), stay(ItemChoice::Nearest));
        assert!(nearest > any + 0.05, "{any} {nearest}");
    }

    #[test]
    fn the_shipped_statistics_can_be_read() {
        let statistics = Statistics::from_json(include_str!("../../../models/household-statistics.json")).unwrap();
        assert!(statistics.programs > 1000 && statistics.frequency.len() > 100 && statistics.markov3.len() > 1000);
        assert_ne!(statistics.kneser_ney, KneserNeyFit::default());
    }
}
