//! Guesses of a person's next sentence, with probabilities, for prefetching by [`crate::prepared::Preparer`].
//!
//! A sentence is split into its form and its things. "They put the mug on the table." becomes `They put the <1> on the <n>.` if the mug was the last
//! thing but one mentioned, and the table was not mentioned recently. The guesser counts which form follows which ([`Guesser::hear`]), first over
//! activity programs ([`Guesser::new`]), then over this home's events. Things that were not mentioned recently get their probability from the model's
//! scores.
//!
//! `P(sentence) = P(form | two forms before) * prod over its new things P(thing) * P(form | thing) / P(form)`, the first by Witten-Bell interpolation
//! of the counts.

use std::collections::VecDeque;

use foldhash::{HashMap, HashMapExt, HashSet};

use crate::names::Names;

/// Number of recent things that a sentence can refer to; equal to the value in `training/forms_file.py`.
const RECENT_MAX: usize = 5;
/// Most distinct forms; a guesser with more starts again ([`Guesser::is_full`]).
pub const FORMS_MAX: usize = 4096;
/// Most counts of each kind; see [`FORMS_MAX`].
pub const COUNTS_MAX: usize = 65_536;
/// Longer sentences are not guessed.
pub const SENTENCE_BYTES_MAX: usize = 200;
/// Most words of a thing's name.
const NAME_WORDS_MAX: usize = 4;
/// Weight of one sentence of this home against one of the programs: chosen before any figure was seen.
const HOME_WEIGHT: f64 = 5.0;
/// Number of forms and of things that a guess considers.
const FORMS_TRIED: usize = 96;
const THINGS_TRIED: usize = 64;
/// Sentences with more new things are not guessed: each thing's probability counts, and their product is too small.
const NEW_THINGS_MAX: usize = 3;
/// Most ways to fill a form; if there are more, only the likeliest continue to the next place.
const WAYS_MAX: usize = 512;
/// Weight of the prior that a form occurs with a thing at the general frequency.
const PRIOR_TIMES: f64 = 5.0;
/// The form before the first sentence.
const START: &str = "";

/// Counts of successive forms in activity programs: `models/household-forms.json`, written by `training/forms_file.py`.
#[derive(Debug, Clone, Default, serde::Deserialize)]
pub struct Counts {
    forms: Vec<String>,
    after: Vec<(u32, u32, f64)>,
    after_two: Vec<(u32, u32, u32, f64)>,
    things: Vec<(u32, usize, String, f64)>,
}

impl Counts {
    /// Parses the file's text.
    ///
    /// # Errors
    /// If it is not JSON of that structure.
    pub fn from_json(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }
}

/// Counts of the forms that follow one context.
#[derive(Debug, Clone, Default)]
struct Following {
    times: f64,
    by_form: Vec<(u32, f64)>,
}

impl Following {
    /// Returns the number of new counts.
    fn add(&mut self, form: u32, times: f64) -> usize {
        self.times += times;
        match self.by_form.iter_mut().find(|(known, _)| *known == form) {
            Some((_, known)) => {
                *known += times;
                0
            }
            None => {
                self.by_form.push((form, times));
                1
            }
        }
    }

    /// Interpolates these counts with the probabilities of a shorter context: Witten-Bell.
    fn mix(&self, chances: &mut [f64]) {
        let distinct = self.by_form.len() as f64;
        let whole = self.times + distinct;
        if whole <= 0.0 {
            return;
        }
        chances.iter_mut().for_each(|chance| *chance *= distinct / whole);
        for &(form, times) in &self.by_form {
            chances[form as usize] += times / whole;
        }
    }
}

/// Counts of the things at one place of a form.
#[derive(Debug, Clone, Default)]
struct Place {
    times: f64,
    by_thing: HashMap<String, f64>,
}

/// A sentence split into form and things.
struct Parts {
    /// Each thing is replaced by its rank among the recent ones, or n.
    typed: String,
    /// Each thing is replaced by an empty place.
    bare: String,
    things: Vec<String>,
}

/// A name that a sentence may use, with the map's label for it.
#[derive(Debug, Clone)]
struct Thing {
    label: Option<usize>,
    /// Its share of the label's probability, because a label may have several names.
    share: f64,
}

/// A person's latest sentences.
#[derive(Debug, Clone, Default)]
pub struct Thread {
    /// The forms of the last two sentences.
    forms: [u32; 2],
    /// The distinct recent things, those of the last sentence first.
    recent: VecDeque<String>,
}

/// Guesses the next sentence. See the [module's documentation](self).
#[derive(Debug, Clone)]
pub struct Guesser {
    forms: Vec<String>,
    numbers: HashMap<String, u32>,
    any: Following,
    after: HashMap<u32, Following>,
    after_two: HashMap<(u32, u32), Following>,
    places: HashMap<(String, usize), Place>,
    /// Count per thing, over all places.
    times: HashMap<String, f64>,
    all_times: f64,
    /// Number of counts, against [`COUNTS_MAX`].
    counts: usize,
    followers: usize,
    things: HashMap<String, Thing>,
    chances: Vec<f64>,
}

impl Guesser {
    /// A guesser with the counts of activity programs, for the labels of a map.
    #[must_use]
    pub fn new(seed: &Counts, labels: &[&str]) -> Self {
        let mut guesser = Self {
            forms: Vec::new(),
            numbers: HashMap::new(),
            any: Following::default(),
            after: HashMap::new(),
            after_two: HashMap::new(),
            places: HashMap::new(),
            times: HashMap::new(),
            all_times: 0.0,
            counts: 0,
            followers: 0,
            things: HashMap::new(),
            chances: Vec::new(),
        };
        guesser.number(START);
        let number =
            |guesser: &mut Self, form: u32| seed.forms.get(form as usize).and_then(|form| guesser.number(form));
        for &(before, next, times) in &seed.after {
            let (Some(before), Some(next)) = (number(&mut guesser, before), number(&mut guesser, next)) else {
                continue;
            };
            let _new = guesser.any.add(next, times);
            guesser.followers += guesser.after.entry(before).or_default().add(next, times);
        }
        for &(before, last, next, times) in &seed.after_two {
            let numbers = [before, last, next].map(|form| number(&mut guesser, form));
            let [Some(before), Some(last), Some(next)] = numbers else { continue };
            guesser.followers += guesser.after_two.entry((before, last)).or_default().add(next, times);
        }
        for (form, place, thing, times) in &seed.things {
            let Some(form) = seed.forms.get(*form as usize) else { continue };
            guesser.stand(form, *place, thing, *times);
        }
        guesser.set_labels(labels);
        guesser
    }

    /// Whether it can learn nothing new and must be replaced: many different sentences would otherwise end learning for good.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.forms.len() >= FORMS_MAX || self.counts >= COUNTS_MAX || self.followers >= COUNTS_MAX
    }

    /// Sets the labels of a changed map.
    pub fn set_labels(&mut self, labels: &[&str]) {
        let places: HashMap<&str, usize> = labels.iter().enumerate().map(|(place, label)| (*label, place)).collect();
        let mut things: HashMap<String, Thing> = HashMap::new();
        for (place, label) in labels.iter().enumerate() {
            things.insert(label.to_lowercase(), Thing { label: Some(place), share: 1.0 });
        }
        let names = Names::built_in();
        for thing in self.times.keys() {
            let mut known = std::iter::once(thing.as_str()).chain(names.aliases(thing));
            let label = known.find_map(|name| places.get(name).copied());
            things.entry(thing.clone()).or_insert(Thing { label, share: 1.0 });
        }
        // A label's names share its probability by their use.
        let mut used = vec![0.0; labels.len()];
        let times_of = |name: &str| self.times.get(name).copied().unwrap_or_default() + 1.0;
        for (name, thing) in &things {
            if let Some(label) = thing.label {
                used[label] += times_of(name);
            }
        }
        for (name, thing) in &mut things {
            thing.share = thing.label.map_or(0.0, |label| times_of(name) / used[label]);
        }
        self.things = things;
    }

    fn number(&mut self, form: &str) -> Option<u32> {
        if let Some(number) = self.numbers.get(form) {
            return Some(*number);
        }
        if self.forms.len() >= FORMS_MAX {
            return None;
        }
        let number = u32::try_from(self.forms.len()).ok()?;
        self.forms.push(form.to_owned());
        self.numbers.insert(form.to_owned(), number);
        Some(number)
    }

    fn stand(&mut self, bare: &str, place: usize, thing: &str, times: f64) {
        if self.counts >= COUNTS_MAX {
            return;
        }
        let own = self.places.entry((bare.to_owned(), place)).or_default();
        own.times += times;
        let before = own.by_thing.len();
        *own.by_thing.entry(thing.to_owned()).or_default() += times;
        self.counts += own.by_thing.len() - before;
        *self.times.entry(thing.to_owned()).or_default() += times;
        self.all_times += times;
    }

    /// Splits a sentence. `None` if it cannot be reassembled.
    fn take_apart(&self, sentence: &str, thread: &Thread) -> Option<Parts> {
        if sentence.len() > SENTENCE_BYTES_MAX || sentence.contains(['<', '>']) {
            return None;
        }
        let words: Vec<&str> = sentence.split(' ').collect();
        let bare_word = |word: &str| word.trim_end_matches(['.', ',', '!', '?', ';', ':']).len();
        let (mut typed, mut bare, mut things) = (String::new(), String::new(), Vec::new());
        let mut at = 0;
        while at < words.len() {
            if at > 0 {
                typed.push(' ');
                bare.push(' ');
            }
            let is_after_article =
                at > 0 && matches!(words[at - 1], "the" | "a" | "an" | "his" | "her" | "their" | "my" | "your" | "our");
            let run = (1..=NAME_WORDS_MAX.min(words.len() - at)).rev().find_map(|length| {
                let run = words[at..at + length].join(" ");
                let name = run[..bare_word(&run)].to_lowercase();
                // A punctuation mark within a run ends it.
                (is_after_article && self.things.contains_key(&name)).then_some((length, name, run))
            });
            match run {
                Some((length, name, run)) => {
                    let rank = thread.recent.iter().position(|known| *known == name);
                    let end = &run[bare_word(&run)..];
                    match rank {
                        Some(rank) => typed.push_str(&format!("<{rank}>{end}")),
                        None => typed.push_str(&format!("<n>{end}")),
                    }
                    bare.push_str(&format!("<>{end}"));
                    things.push(name);
                    at += length;
                }
                None => {
                    typed.push_str(words[at]);
                    bare.push_str(words[at]);
                    at += 1;
                }
            }
        }
        Some(Parts { typed, bare, things })
    }

    /// Advances the thread by a sentence without learning: for restored events, and for persons that are only followed.
    pub fn follow(&mut self, thread: &mut Thread, sentence: &str) {
        let parts = self.take_apart(sentence, thread);
        self.go_on(thread, parts);
    }

    /// Learns that a sentence followed the thread, and advances the thread.
    pub fn hear(&mut self, thread: &mut Thread, sentence: &str) {
        let parts = self.take_apart(sentence, thread);
        if let Some(Parts { typed, bare, things }) = &parts
            && let Some(next) = self.number(typed)
        {
            let [before, last] = thread.forms;
            let _new = self.any.add(next, HOME_WEIGHT);
            if self.followers < COUNTS_MAX {
                self.followers += self.after.entry(last).or_default().add(next, HOME_WEIGHT);
                self.followers += self.after_two.entry((before, last)).or_default().add(next, HOME_WEIGHT);
            }
            for (place, thing) in things.iter().enumerate() {
                self.stand(bare, place, thing, HOME_WEIGHT);
            }
        }
        self.go_on(thread, parts);
    }

    fn go_on(&mut self, thread: &mut Thread, parts: Option<Parts>) {
        let Some(Parts { typed, things, .. }) = parts else {
            *thread = Thread::default();
            return;
        };
        let form = self.numbers.get(&typed).copied().unwrap_or_default();
        thread.forms = [thread.forms[1], form];
        thread.recent.retain(|known| !things.contains(known));
        for thing in things.into_iter().rev() {
            thread.recent.retain(|known| *known != thing);
            thread.recent.push_front(thing);
        }
        thread.recent.truncate(RECENT_MAX);
    }

    /// The likeliest next sentences, at most `most`, likeliest first, with their relative probabilities. `log_prob_nats` is the model's score per
    /// label of the map, in nats.
    pub fn guess(&mut self, thread: &Thread, log_prob_nats: &[f64], most: usize) -> Vec<(String, f64)> {
        let mut chances = std::mem::take(&mut self.chances);
        chances.clear();
        chances.resize(self.forms.len(), 0.0);
        self.any.mix(&mut chances);
        let [before, last] = thread.forms;
        for context in [self.after.get(&last), self.after_two.get(&(before, last))].into_iter().flatten() {
            context.mix(&mut chances);
        }
        let mut forms: Vec<(u32, f64)> = chances
            .iter()
            .zip(0..)
            .filter(|(chance, _)| **chance > 0.0)
            .map(|(chance, form)| (form, *chance))
            .collect();
        self.chances = chances;
        forms.sort_by(|a, b| b.1.total_cmp(&a.1));
        forms.truncate(FORMS_TRIED);

        let whole: f64 = log_prob_nats.iter().map(|nats| nats.exp()).sum();
        let chance_of = |thing: &Thing| {
            thing.label.and_then(|label| log_prob_nats.get(label)).map_or(0.0, |nats| nats.exp() / whole * thing.share)
        };
        let mut new: Vec<(&str, f64)> = (self.things.iter())
            .filter(|(name, _)| !thread.recent.contains(name))
            .map(|(name, thing)| (name.as_str(), chance_of(thing)))
            .filter(|(_, chance)| *chance > 0.0)
            .collect();
        // Ties by name, so that guesses are deterministic.
        new.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(b.0)));
        new.truncate(4 * THINGS_TRIED);

        let mut guesses: Vec<(String, f64)> = Vec::new();
        for (form, chance) in forms {
            self.fill(&self.forms[form as usize], chance, thread, &new, &mut guesses);
        }
        guesses.sort_by(|a, b| b.1.total_cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        let mut seen = HashSet::default();
        guesses.retain(|(sentence, _)| seen.insert(sentence.clone()));
        guesses.truncate(most);
        guesses
    }

    /// The frequency of a thing at a place, relative to its frequency anywhere.
    fn lift(&self, bare: &str, place: usize, thing: &str) -> f64 {
        let anywhere = (self.times.get(thing).copied().unwrap_or_default() + 0.5) / (self.all_times + 0.5);
        let Some(own) = self.places.get(&(bare.to_owned(), place)) else { return 1.0 };
        let here = own.by_thing.get(thing).copied().unwrap_or_default();
        (here + PRIOR_TIMES * anywhere) / (own.times + PRIOR_TIMES) / anywhere
    }

    /// Fills a form's places in every likely way.
    fn fill(&self, form: &str, chance: f64, thread: &Thread, new: &[(&str, f64)], out: &mut Vec<(String, f64)>) {
        let mut parts = form.split('<');
        let mut bare = parts.next().unwrap_or_default().to_owned();
        let mut ways = vec![(bare.clone(), chance)];
        let rest: Vec<(&str, &str)> = parts.filter_map(|part| part.split_once('>')).collect();
        if rest.iter().filter(|(kind, _)| *kind == "n").count() > NEW_THINGS_MAX {
            return;
        }
        for (_, text) in &rest {
            bare.push_str("<>");
            bare.push_str(text);
        }
        for (place, (kind, text)) in rest.into_iter().enumerate() {
            let known =
                kind.parse().ok().and_then(|rank: usize| thread.recent.get(rank)).map(|thing| (thing.as_str(), 1.0));
            let mut things: Vec<(&str, f64)> = match (kind, known) {
                ("n", _) => {
                    new.iter().map(|(thing, chance)| (*thing, chance * self.lift(&bare, place, thing))).collect()
                }
                // The form's probability covers which recent thing it is. The lift covers whether the thing fits this place.
                (_, Some((thing, _))) => vec![(thing, self.lift(&bare, place, thing).min(1.0))],
                (_, None) => return,
            };
            things.sort_by(|a, b| b.1.total_cmp(&a.1));
            things.truncate(if place == 0 { THINGS_TRIED } else { THINGS_TRIED / 8 });
            let ends = |(begin, chance): &(String, f64)| -> Vec<(String, f64)> {
                things.iter().map(|(thing, own)| (format!("{begin}{thing}{text}"), chance * own)).collect()
            };
            ways = ways.iter().flat_map(ends).collect();
            if ways.len() > WAYS_MAX {
                ways.select_nth_unstable_by(WAYS_MAX, |a, b| b.1.total_cmp(&a.1));
                ways.truncate(WAYS_MAX);
            }
        }
        out.append(&mut ways);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LABELS: [&str; 6] = ["kitchen", "mug", "table", "coffee maker", "television", "sofa"];

    fn guesser() -> Guesser {
        let counts = Counts::from_json(include_str!("../../models/household-forms.json")).unwrap();
        Guesser::new(&counts, &LABELS)
    }

    fn evenly() -> Vec<f64> {
        vec![(1.0 / LABELS.len() as f64).ln(); LABELS.len()]
    }

    #[test]
    fn a_sentence_that_came_before_is_guessed_first() {
        let mut guesser = guesser();
        let mut thread = Thread::default();
        for _ in 0..4 {
            for sentence in ["Ada waters the mug.", "Ada sings to the mug.", "Ada dances around the table."] {
                guesser.hear(&mut thread, sentence);
            }
        }
        guesser.hear(&mut thread, "Ada waters the sofa.");
        let guesses = guesser.guess(&thread, &evenly(), 3);
        assert_eq!(guesses[0].0, "Ada sings to the sofa.", "{guesses:?}");
    }

    #[test]
    fn what_was_grabbed_is_put_somewhere() {
        let mut guesser = guesser();
        let mut thread = Thread::default();
        for sentence in ["They walk to the kitchen.", "They walk to the mug.", "They grab the mug."] {
            guesser.follow(&mut thread, sentence);
        }
        let mut likely = evenly();
        likely[2] += 2.0;
        let guesses = guesser.guess(&thread, &likely, 16);
        assert!(guesses.iter().any(|(sentence, _)| sentence == "They walk to the table."), "{guesses:?}");
        assert!(guesses.windows(2).all(|two| two[0].1 >= two[1].1), "likeliest first: {guesses:?}");
        let distinct: HashSet<_> = guesses.iter().map(|(sentence, _)| sentence).collect();
        assert_eq!(distinct.len(), guesses.len());
    }

    /// A sentence that is split and filled again is unchanged.
    #[test]
    fn what_is_taken_apart_is_put_together_again() {
        let mut guesser = guesser();
        let mut thread = Thread::default();
        for sentence in ["They grab the mug.", "They put the mug on the coffee maker, slowly.", "They sit on the sofa."]
        {
            let parts = guesser.take_apart(sentence, &thread).unwrap();
            let new: Vec<_> = LABELS.iter().map(|label| (*label, 1.0)).collect();
            let mut ways = Vec::new();
            guesser.fill(&parts.typed, 1.0, &thread, &new, &mut ways);
            assert!(ways.iter().any(|(way, _)| way == sentence), "{sentence}: {} {ways:?}", parts.typed);
            guesser.follow(&mut thread, sentence);
        }
    }

    /// A letter with a lower-case form of another length does not break the mark after it.
    #[test]
    fn letters_that_change_their_length_are_survived() {
        let counts = Counts::from_json(include_str!("../../models/household-forms.json")).unwrap();
        let mut guesser = Guesser::new(&counts, &["İ", "ẞİé"]);
        let mut thread = Thread::default();
        for sentence in ["They grab the İ.", "They grab the ẞİé!", "They grab the İé."] {
            guesser.hear(&mut thread, sentence);
        }
        assert!(!guesser.guess(&thread, &[-0.7, -0.7], 8).is_empty());
    }

    /// A form with many things has more fillings than fit into memory.
    #[test]
    fn sentences_of_many_things_are_guessed_in_bounds() {
        let things: Vec<String> = (0..40)
            .map(|n| format!("thing {}", char::from(b'A' + (n % 26) as u8).to_string().repeat(1 + n / 26)))
            .collect();
        let labels: Vec<&str> = things.iter().map(String::as_str).collect();
        let mut guesser = Guesser::new(&Counts::default(), &labels);
        let mut thread = Thread::default();
        for round in 0..16 {
            let named: Vec<String> =
                (0..1 + round % 8).map(|n| format!("the {}", things[(8 * round + n) % 40])).collect();
            guesser.hear(&mut thread, &format!("They move {}.", named.join(", ")));
        }
        let likely = vec![(1.0 / 40.0_f64).ln(); 40];
        let new: Vec<(&str, f64)> = labels.iter().map(|label| (*label, 1.0 / 40.0)).collect();
        let mut most = [0; 9];
        for form in &guesser.forms {
            let mut ways = Vec::new();
            guesser.fill(form, 1.0, &thread, &new, &mut ways);
            let places = form.matches("<n>").count();
            most[places] = most[places].max(ways.len());
        }
        assert_eq!(most[2..], [320, WAYS_MAX, 0, 0, 0, 0, 0]);
        assert_eq!(guesser.guess(&thread, &likely, 32).len(), 32);
    }

    #[test]
    fn nothing_grows_beyond_its_limit_whatever_is_said() {
        let mut guesser = guesser();
        let mut thread = Thread::default();
        for n in 0..2 * FORMS_MAX {
            guesser.hear(&mut thread, &format!("They do {n} with the mug and the <b> of {n}."));
            guesser.hear(&mut thread, &format!("They do {n} with the mug."));
        }
        assert!(guesser.is_full());
        assert!(guesser.forms.len() <= FORMS_MAX);
        let followers = guesser.after.values().chain(guesser.after_two.values()).map(|own| own.by_form.len());
        assert_eq!(followers.sum::<usize>(), guesser.followers);
        assert!(guesser.followers <= COUNTS_MAX + 2);
        assert!(guesser.guess(&thread, &evenly(), 64).len() <= 64);
    }
}
