//! How much weight the model's scores deserve after a text, by the text's tokens per byte.
//!
//! Cases are those of [`super::prediction`], with the nearest things. The words of a program's sentences are replaced by invented ones: none, those of
//! the things, all, or all of the last sentence. The true next room stays known. So the weight that gives it the highest probability can be read off
//! for each number of tokens per byte, where the rest of the weight goes to the room that the person is believed to be in.

use std::collections::BTreeMap;

use serde::Serialize;

use super::prediction::{LeftOut, NamedProgram, cases, sentences};
use roomcast_cli::Failure;
use roomcast_core::forecast::{ForecastOptions, Forecaster};
use roomcast_core::grounding::{GroundedScores, Grounding};
use roomcast_core::narration::history::{History, HistoryLimits};
use roomcast_core::narration::{Observation, Sentence};
use roomcast_core::places::PlaceMatcher;
use roomcast_core::prompt::BindingSequence;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::scorer::familiarity::Vocabulary;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_simulation::ScoreSource;
use roomcast_simulation::binding::{Binder, ItemChoice};

/// Which words of a sentence are replaced.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Replaced {
    /// None: the product's sentences.
    Nothing,
    Things,
    Everything,
    /// All words of the last sentence. The belief knows the sentences before it.
    Newest,
}

/// One case: what model and belief gave the true next room.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Case {
    pub tokens_per_byte: f64,
    /// The weight that the product gives the model.
    pub trust: f64,
    model: f64,
    belief: f64,
}

/// Weights from 0 to 1 in tenths.
pub const WEIGHTS: usize = 11;

/// Mean loss of the next room over some cases.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Losses {
    pub cases: usize,
    /// Share of the cases with less than the full weight.
    pub flagged: f64,
    /// With the product's weights, in nats.
    pub product_nats: f64,
    /// With the weights 0, 0.1, and so on up to 1, in nats.
    pub by_weight_nats: [f64; WEIGHTS],
}

impl Losses {
    pub fn of<'a>(cases: impl Iterator<Item = &'a Case> + Clone) -> Self {
        let count = cases.clone().count();
        let mean = |value: &dyn Fn(&Case) -> f64| cases.clone().map(value).sum::<f64>() / count.max(1) as f64;
        // No forecast of the product has a probability of zero.
        let nats = |case: &Case, weight: f64| -(weight * case.model + (1.0 - weight) * case.belief).max(1e-6).ln();
        Self {
            cases: count,
            flagged: mean(&|case| f64::from(u8::from(case.trust < 1.0))),
            product_nats: mean(&|case| nats(case, case.trust)),
            by_weight_nats: std::array::from_fn(|tenths| mean(&|case| nats(case, tenths as f64 / 10.0))),
        }
    }

    pub fn best(&self) -> usize {
        let by_nats = |a: &usize, b: &usize| self.by_weight_nats[*a].total_cmp(&self.by_weight_nats[*b]);
        (0..WEIGHTS).min_by(by_nats).unwrap_or_default()
    }
}

/// A text's weight, and the probability of the likeliest room by the scores alone and with their weight.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Text {
    pub tokens_per_byte: f64,
    /// The weight of the scores.
    pub trust: f64,
    /// The likeliest room's probability by the scores.
    pub top: f64,
    /// The same in a forecast for a person who may be in any room.
    pub forecast_top: f64,
}

/// An invented word in place of `word`, the same for each mention.
fn invented(word: &str) -> String {
    const BEGINNINGS: [&str; 16] =
        ["bl", "kr", "sn", "v", "gr", "pl", "thr", "m", "z", "fl", "qu", "d", "w", "sh", "tr", "n"];
    const MIDDLES: [&str; 10] = ["a", "e", "i", "o", "u", "oo", "ai", "ea", "ou", "y"];
    const ENDS: [&str; 16] = ["b", "rk", "mp", "x", "sh", "nd", "g", "ft", "l", "zz", "rn", "ck", "d", "m", "st", "pt"];
    // FNV-1a.
    let mix = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
    let mut hash = word.bytes().fold(0xcbf2_9ce4_8422_2325, mix);
    let mut take = |parts: &[&'static str]| {
        let part = parts[(hash % parts.len() as u64) as usize];
        hash /= parts.len() as u64;
        part
    };
    let syllables = 1 + usize::from(word.len() > 4) + usize::from(word.len() > 8);
    (0..syllables).map(|_| [take(&BEGINNINGS), take(&MIDDLES), take(&ENDS)].concat()).collect()
}

fn replace(sentence: &str, things: &[String], replaced: Replaced) -> String {
    let invent = |text: &str| text.split(' ').map(invented).collect::<Vec<_>>().join(" ");
    match replaced {
        Replaced::Nothing => sentence.to_owned(),
        Replaced::Things => things.iter().fold(sentence.to_owned(), |text, thing| text.replace(thing, &invent(thing))),
        Replaced::Everything | Replaced::Newest => invent(sentence.trim_end_matches('.')) + ".",
    }
}

/// Tokens and bytes of the sentences of a window, each with the space after it.
fn measure<'a, M: LanguageModel>(model: &M, window: impl Iterator<Item = &'a str>) -> (usize, usize) {
    let count = model.token_counter();
    window.fold((0, 0), |(tokens, bytes), text| (tokens + count(text), bytes + text.len() + 1))
}

/// The cases of some programs in one map.
pub fn losses<M: LanguageModel>(
    programs: &[NamedProgram],
    (map, grounding): (&SemanticMap, &Grounding),
    source: &mut ScoreSource<M>,
    limits: HistoryLimits,
    replaced: Replaced,
) -> Result<Vec<Case>, Failure> {
    let binding = BindingSequence::default();
    let vocabulary = Vocabulary::of(source.language_model()).map_err(Failure::model)?;
    let mut mentions = PlaceMatcher::new(map, grounding);
    let mut binder = Binder::new(map, grounding, ItemChoice::Nearest);
    let mut found = Vec::new();
    for NamedProgram { path, program, .. } in programs {
        binder.begin(1, &path.file_stem().unwrap_or_default().to_string_lossy());
        let cases = cases(program, &mut binder, grounding, &mut LeftOut::default());
        let steps = &program.steps[..cases.last().map_or(0, |case| case.done)];
        let (mut said, mut newest) = (Vec::with_capacity(steps.len()), Vec::with_capacity(steps.len()));
        for (step, sentence) in steps.iter().zip(sentences(steps)?) {
            let things: Vec<String> = step.objects().iter().map(|object| object.words()).collect();
            newest.push(Sentence::new(&replace(sentence.as_str(), &things, replaced))?);
            said.push(if replaced == Replaced::Newest { sentence } else { newest[said.len()].clone() });
        }
        let rows = source.score_steps(&said, limits, &binding)?;
        let mut forecaster = Forecaster::new(grounding.partitions().len(), ForecastOptions::default(), 0.0);
        let (mut window, mut at_s, mut heard) = (History::new(limits), 0.0, 0);
        let add = |window: &mut History, text: &Sentence, source: &ScoreSource<M>| {
            let (tokens, _) = measure(source.language_model(), [text.as_str()].into_iter());
            window.push(Observation::of(0, text.clone()), tokens + 1);
        };
        for case in &cases {
            let mut before = None;
            for at in heard..case.done {
                at_s += steps[at].entry().duration_s;
                before = (replaced == Replaced::Newest).then(|| (forecaster.clone(), window.clone()));
                forecaster.observe(at_s, mentions.last(said[at].as_str()), grounding, &[]);
                forecaster.expect_next(grounding, &rows[at + 1], 1.0, 0);
                add(&mut window, &said[at], source);
            }
            heard = case.done;
            if let Some((forecaster, window)) = &mut before {
                let last = &newest[heard - 1];
                add(window, last, source);
                forecaster.observe(at_s, mentions.last(last.as_str()), grounding, &[]);
                forecaster.expect_next(grounding, &source.score(window.sentences(), &binding)?, 1.0, 0);
            }
            let (forecaster, window) = before.as_ref().map_or((&forecaster, &window), |(own, window)| (own, window));
            let (Some(room), Some(expected)) = (case.room, forecaster.expected()) else { continue };
            let (tokens, bytes) = measure(source.language_model(), window.sentences());
            found.push(Case {
                tokens_per_byte: tokens as f64 / bytes as f64,
                trust: vocabulary.trust(tokens, bytes),
                model: expected[room],
                belief: forecaster.belief()[room],
            });
        }
    }
    source.flush()?;
    Ok(found)
}

/// Each sentence of a text alone.
pub fn texts<M: LanguageModel>(
    lines: &[&str],
    grounding: &Grounding,
    source: &mut ScoreSource<M>,
) -> Result<Vec<Text>, Failure> {
    let vocabulary = Vocabulary::of(source.language_model()).map_err(Failure::model)?;
    let mut grounded = GroundedScores::default();
    let mut found = Vec::with_capacity(lines.len());
    for line in lines {
        let sentence = Sentence::new(line)?;
        let row = source.score([sentence.as_str()], &BindingSequence::default())?;
        grounding.ground(&row, &mut grounded)?;
        let (tokens, bytes) = measure(source.language_model(), [sentence.as_str()].into_iter());
        let (trust, rooms) = (vocabulary.trust(tokens, bytes), grounded.partition_probability.len() as f64);
        let top = grounded.partition_probability.iter().copied().fold(0.0, f64::max);
        let tokens_per_byte = tokens as f64 / bytes as f64;
        found.push(Text { tokens_per_byte, trust, top, forecast_top: trust * top + (1.0 - trust) / rooms });
    }
    Ok(found)
}

/// The sets of a file: a line in brackets names a set, and the lines after it are its sentences.
pub fn sets(text: &str) -> BTreeMap<&str, Vec<&str>> {
    let named = text.split("\n[").skip(1).filter_map(|set| set.split_once("]\n"));
    named.map(|(name, lines)| (name, lines.lines().filter(|line| !line.is_empty()).collect())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaced_words_are_invented_and_the_same_at_each_mention() {
        let things = ["coffee maker".to_owned()];
        let replace = |replaced| replace("They clean the coffee maker.", &things, replaced);
        assert_eq!(replace(Replaced::Nothing), "They clean the coffee maker.");
        let invented = format!("{} {}", invented("coffee"), invented("maker"));
        assert_eq!(replace(Replaced::Things), format!("They clean the {invented}."));
        let all = replace(Replaced::Everything);
        assert!(all.ends_with('.') && !all.contains("They") && all.split(' ').count() == 5, "{all}");
        assert_ne!(super::invented("fridge"), super::invented("sofa"));
    }

    #[test]
    fn the_best_weight_is_that_of_the_likelier_source() {
        let case = |model, belief, trust| Case { tokens_per_byte: 0.2, trust, model, belief };
        let losses = |cases: &[Case]| Losses::of(cases.iter());
        assert_eq!(losses(&[case(0.9, 0.1, 1.0)]).best(), 10);
        let wrong = losses(&[case(0.1, 0.5, 0.0), case(0.2, 0.5, 0.5)]);
        assert_eq!((wrong.best(), wrong.cases, wrong.flagged), (0, 2, 1.0));
        assert!((wrong.product_nats - (-0.5_f64.ln() - 0.35_f64.ln()) / 2.0).abs() < 1e-12);
    }

    #[test]
    fn a_line_in_brackets_begins_a_set() {
        let sets = sets("# A comment.\n\n[a b]\nOne.\n\nTwo.\n\n[c]\nThree.\n");
        assert_eq!(sets, BTreeMap::from([("a b", vec!["One.", "Two."]), ("c", vec!["Three."])]));
    }
}
