//! The place matcher: finds the thing or room of the map that a text names, by the names of the map and grounding's table.

use std::collections::HashMap;

use crate::grounding::Grounding;
use crate::names::{Names, plain_words};
use crate::semantic_map::SemanticMap;

/// A thing or room named by a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mention {
    /// Index into [`Grounding::scored_labels`].
    pub label: usize,
    /// Index of the partition, if the text names one of several rooms with this label ("Lena's room" of two bedrooms).
    pub room: Option<usize>,
    /// If true, the person leaves this room ("They leave the *kitchen*") and is in any other place.
    pub is_left: bool,
}

impl From<usize> for Mention {
    /// A label that the person turns to.
    fn from(label: usize) -> Self {
        Self { label, room: None, is_left: false }
    }
}

impl Mention {
    /// The share of the label's items in a partition; if the text names a room, 1 there and 0 elsewhere.
    #[must_use]
    pub fn share(&self, grounding: &Grounding, partition: usize) -> f64 {
        let only = |room| if room == partition { 1.0 } else { 0.0 };
        self.room.map_or_else(|| grounding.weights[(self.label, partition)], only)
    }
}

/// The names of a map. It is built once per map; matching allocates nothing once the buffers are warm.
#[derive(Debug, Clone)]
pub struct PlaceMatcher {
    /// Each name of a label or room, in singular and plural.
    place_of_name: HashMap<String, Mention>,
    /// The number of words of the longest name.
    longest_words: usize,
    /// Per label: whether it is a room's name.
    is_room: Vec<bool>,
    /// Buffers: the words in lower case, the same without hyphens, and each word's start and end in both.
    lower: String,
    plain: String,
    words: Vec<Word>,
}

/// A word of the text.
#[derive(Debug, Clone, Copy)]
struct Word {
    start: usize,
    end: usize,
    /// A sentence ends before it.
    is_first: bool,
}

/// Words of a thing's owner or number, and "the".
const ARTICLES: [&str; 18] = [
    "the", "a", "an", "some", "this", "that", "these", "those", "their", "his", "her", "its", "my", "our", "your",
    "both", "each", "another",
];

/// Other words before a thing.
const PREPOSITIONS: [&str; 10] = ["to", "into", "in", "inside", "at", "on", "onto", "near", "by", "under"];

/// Most adjectives between an article and its thing.
const ADJECTIVES_MAX: usize = 3;

/// Words that are no adjective.
const NO_ADJECTIVES: [&str; 14] =
    ["and", "or", "is", "are", "was", "of", "with", "while", "then", "to", "from", "past", "out", "towards"];

/// Words for the subject of a sentence; a verb follows.
const SUBJECTS: [&str; 24] = [
    "they", "he", "she", "i", "we", "you", "somebody", "someone", "who", "person", "people", "man", "woman", "men",
    "women", "boy", "girl", "child", "children", "kid", "kids", "guy", "lady", "couple",
];

/// A thing behind these words goes along with the person.
const CARRIES: [&str; 5] = ["with", "holding", "holds", "carrying", "carries"];
/// And behind these it says nothing about a place.
const WEARS: [&str; 4] = ["wearing", "wears", "wore", "dressed"];

const LEAVES: [&str; 8] = ["leave", "leaves", "left", "leaving", "exit", "exits", "exited", "exiting"];

fn words_of(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| !(c.is_alphanumeric() || c == '\'' || c == '-')).filter(|word| !word.is_empty())
}

/// The other grammatical numbers of a name: "shelves" for "shelf", "mug" for "mugs".
fn other_numbers(name: &str) -> [Option<String>; 3] {
    let with = |end: &str, new: &str| {
        let stem = name.strip_suffix(end)?;
        (stem.len() > 1).then(|| format!("{stem}{new}"))
    };
    let plural = if name.ends_with(['s', 'x', 'z']) || name.ends_with("ch") || name.ends_with("sh") {
        Some(format!("{name}es"))
    } else {
        Some(format!("{name}s"))
    };
    let irregular = match name {
        _ if name.ends_with("ies") => with("ies", "y"),
        _ if name.ends_with("ives") => with("ves", "fe"),
        _ if name.ends_with("ves") => with("ves", "f"),
        _ if name.ends_with('f') => with("f", "ves"),
        _ if name.ends_with("fe") => with("fe", "ves"),
        _ if name.ends_with('y') && !["ay", "ey", "oy", "uy"].iter().any(|end| name.ends_with(end)) => with("y", "ies"),
        _ if name.ends_with("sses") || name.ends_with("xes") || name.ends_with("ches") || name.ends_with("shes") => {
            with("es", "")
        }
        _ => None,
    };
    let singular = if name.ends_with("ss") { None } else { with("s", "") };
    [plural, singular, irregular]
}

impl PlaceMatcher {
    /// The names in `map` ([`SemanticMap::find_label`], [`SemanticMap::find_room`]); `grounding` must be of the same map.
    #[must_use]
    pub fn new(map: &SemanticMap, grounding: &Grounding) -> Self {
        let label_of_text: HashMap<&str, usize> =
            grounding.scored_labels.iter().enumerate().map(|(index, label)| (label.text.as_str(), index)).collect();
        let meant = |name: &str| {
            let item = map.find_label(name).map(|label| map.labels[label.0 as usize].as_str());
            let text = item.or_else(|| map.find_room(name).map(|room| map.rooms[room.0 as usize].label.as_str()))?;
            let label = *label_of_text.get(text)?;
            let is_shared = map.rooms.iter().filter(|room| room.label == text).count() > 1;
            let has_columns = grounding.weights.columns() == map.rooms.len();
            let one = || map.find_one_room(name).map(|room| room.0 as usize);
            let room = (item.is_none() && is_shared && has_columns).then(one).flatten();
            Some(Mention { room, ..label.into() })
        };
        let aliases = map.aliases.values().flatten().map(String::as_str);
        let rooms = map.rooms.iter().map(|room| room.id.as_str());
        let names = Names::built_in().names().chain(aliases).chain(rooms);
        let forms = names.flat_map(|name| [name.to_owned(), plain_words(name)]);
        let known = forms.filter_map(|name| meant(&name).map(|place| (name, place)));
        // The labels themselves come last and win.
        let labels = label_of_text.iter().map(|(text, label)| ((*text).to_owned(), (*label).into()));
        let mut place_of_name: HashMap<String, Mention> = known.chain(labels).collect();
        // A text has no brackets: "tv (left)" is "tv left".
        add_new(&mut place_of_name, |name| [Some(words_of(name).collect::<Vec<_>>().join(" ")), None, None]);
        add_new(&mut place_of_name, other_numbers);
        let is_room = |text: &str| map.rooms.iter().any(|room| room.label.as_str() == text);
        Self {
            is_room: grounding.scored_labels.iter().map(|label| is_room(&label.text)).collect(),
            longest_words: place_of_name.keys().map(|name| words_of(name).count()).max().unwrap_or(0),
            place_of_name,
            lower: String::new(),
            plain: String::new(),
            words: Vec::new(),
        }
    }

    /// Whether these words, in lower case, name a thing or a room of the map.
    #[must_use]
    pub fn knows(&self, words: &str) -> bool {
        self.place_of_name.contains_key(words)
    }

    /// Whether a text names a thing or room of the map, including a place that the person comes from.
    #[must_use]
    pub fn names_any(&mut self, text: &str) -> bool {
        self.split(text);
        (0..self.words.len()).any(|at| self.named(at).is_some_and(|named| self.is_thing_at(at, named)))
    }

    /// The place of a text: the last thing or room that it names in whole words, longest name first. A place that the person comes from ("from", "out
    /// of", "leaves", "away from", "past") does not count, nor does what the person wears. A thing that the person holds counts if the text names
    /// nothing else. If the text names only a room that the person leaves, the person is in any other place.
    #[must_use]
    pub fn last(&mut self, text: &str) -> Option<Mention> {
        self.split(text);
        let (mut held, mut left) = (None, None);
        for at in (0..self.words.len()).rev() {
            let Some((place, end)) = self.named(at).filter(|named| self.is_thing_at(at, *named)) else { continue };
            // "Lily's bed" is not any bed: the longest name that ends here counts.
            let starts = end.saturating_sub(self.longest_words)..at;
            let longer = starts.into_iter().find_map(|from| Some((from, self.place_of(from, end)?)));
            let (at, place) = longer.unwrap_or((at, place));
            match self.relation(at) {
                Relation::At => return Some(place),
                Relation::Held => held = held.or(Some(place)),
                Relation::Origin if self.is_room[place.label] && left.is_none() && self.is_exit(at) => {
                    left = Some(Mention { is_left: true, ..place });
                }
                Relation::Origin | Relation::Worn => {}
            }
        }
        held.or(left)
    }

    fn split(&mut self, text: &str) {
        self.lower.clear();
        self.words.clear();
        let mut since = 0;
        for word in words_of(text) {
            let at = word.as_ptr().addr() - text.as_ptr().addr();
            let is_first = text[since..at].contains(['.', '!', '?', ';']);
            since = at + word.len();
            if !self.lower.is_empty() {
                self.lower.push(' ');
            }
            let start = self.lower.len();
            self.lower.extend(word.chars().flat_map(char::to_lowercase));
            self.words.push(Word { start, end: self.lower.len(), is_first });
        }
        self.plain.clear();
        self.plain.extend(self.lower.chars().map(|c| if c == '-' { ' ' } else { c }));
    }

    fn word(&self, at: usize) -> &str {
        self.words.get(at).map_or("", |word| &self.lower[word.start..word.end])
    }

    fn place_of(&self, from: usize, to: usize) -> Option<Mention> {
        let (start, end) = (self.words[from].start, self.words[to - 1].end);
        let words = &self.lower[start..end];
        let plain = || words.contains('-').then(|| self.place_of_name.get(self.plain[start..end].trim()));
        // "The kitchen's corner."
        let owner = || self.place_of_name.get(words.strip_suffix("'s")?);
        self.place_of_name.get(words).or_else(|| plain()?).or_else(owner).copied()
    }

    /// The place of the longest name that begins at a word, and its end.
    fn named(&self, at: usize) -> Option<(Mention, usize)> {
        let ends = at + 1..=self.words.len().min(at + self.longest_words);
        ends.rev().find_map(|end| Some((self.place_of(at, end)?, end)))
    }

    /// The word before a word in the same sentence.
    fn before(&self, at: usize) -> Option<usize> {
        self.words.get(at).filter(|word| !word.is_first).and(at.checked_sub(1))
    }

    fn is_any(&self, at: usize, list: &[&str]) -> bool {
        list.contains(&self.word(at))
    }

    fn is_article(&self, at: usize) -> bool {
        self.is_any(at, &ARTICLES) || self.word(at).ends_with("'s") || self.word(at) == "s"
    }

    /// The word before a thing with its adjectives and article: the "past" of "past the old white fridge". And whether it has an article.
    fn governor(&self, at: usize) -> (Option<usize>, bool) {
        let direct = self.before(at);
        let mut next = direct;
        for _ in 0..=ADJECTIVES_MAX {
            let Some(word) = next else { break };
            if self.is_article(word) {
                return (self.before(word), true);
            }
            let is_other =
                self.is_any(word, &NO_ADJECTIVES) || self.is_any(word, &SUBJECTS) || self.is_any(word, &PREPOSITIONS);
            if is_other || self.named(word).is_some() {
                break;
            }
            next = self.before(word);
        }
        (direct, false)
    }

    /// Whether a name at this word is a thing and not a verb. It is a thing after an article or preposition, with some adjectives between. Without any
    /// article in the text, it is a thing unless the word is the subject, its verb, or part of an activity ("goes grocery shopping"). A room needs no article.
    fn is_thing_at(&self, at: usize, (place, end): (Mention, usize)) -> bool {
        let (governor, has_article) = self.governor(at);
        let is_announced = |at| self.is_any(at, &PREPOSITIONS) || self.is_any(at, &["from", "towards"]);
        if has_article || governor.is_some_and(is_announced) {
            return true;
        }
        let is_verb = at > 0 && self.is_any(at - 1, &SUBJECTS);
        let is_action = self.word(end).ends_with("ing");
        let is_free = self.is_room[place.label] || at > 0 && !(0..at).any(|at| self.is_article(at) || is_announced(at));
        !is_verb && !is_action && is_free
    }

    /// How the person relates to the place at this word.
    fn relation(&self, at: usize) -> Relation {
        let Some(word) = self.governor(at).0 else { return Relation::At };
        let before = |word: usize| self.before(word).map_or("", |at| self.word(at));
        match self.word(word) {
            "from" | "past" => Relation::Origin,
            "of" if before(word) == "out" => Relation::Origin,
            "inside" | "behind" if before(word) == "from" => Relation::Origin,
            "in" if before(word) == "dressed" => Relation::Worn,
            own if WEARS.contains(&own) => Relation::Worn,
            own if CARRIES.contains(&own) => Relation::Held,
            // "From the kitchen and the bathroom."
            "and" | "or" => {
                let starts = word.saturating_sub(self.longest_words)..word;
                let joined = starts.into_iter().find(|from| self.place_of(*from, word).is_some());
                joined.map(|from| self.relation(from)).filter(|own| *own != Relation::Held).unwrap_or(Relation::At)
            }
            _ if self.leaves(word) => Relation::Origin,
            _ => Relation::At,
        }
    }

    /// Whether a word is a verb of leaving: "leaves", but not "to leave" or the "left" side.
    fn leaves(&self, at: usize) -> bool {
        self.is_any(at, &LEAVES) && at > 0 && !self.is_any(at - 1, &["to", "turn", "turns", "turning"])
    }

    /// Whether the person leaves the room at this word: "leaves the kitchen", "goes out of the kitchen". "From" is not
    /// enough: a person also takes things from a place.
    fn is_exit(&self, at: usize) -> bool {
        let before = std::iter::successors(self.before(at), |at| self.before(*at)).take(3 + ADJECTIVES_MAX);
        let mut before = before.take_while(|at| !matches!(self.word(*at), "and" | "then"));
        before.any(|at| self.leaves(at) || self.word(at) == "out")
    }
}

/// How a person relates to a place that the text names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Relation {
    At,
    /// The person comes from there.
    Origin,
    Held,
    Worn,
}

/// Adds the forms that are not names yet. If names share a form, the choice is deterministic.
fn add_new(place_of_name: &mut HashMap<String, Mention>, forms: impl Fn(&str) -> [Option<String>; 3]) {
    let known: Vec<_> = place_of_name.iter().map(|(name, place)| (name.clone(), *place)).collect();
    let mut new: Vec<(String, Mention)> = known
        .iter()
        .flat_map(|(name, place)| forms(name).into_iter().flatten().map(|form| (form, *place)))
        .filter(|(form, _)| !form.is_empty() && !place_of_name.contains_key(form))
        .collect();
    new.sort_unstable_by(|(a, own), (b, other)| (b, other.label, other.room).cmp(&(a, own.label, own.room)));
    place_of_name.extend(new);
}

/// The entropy of a text's likelihood, as a share of the most that its rooms can have.
pub(crate) fn evenness(list: &[f64]) -> f64 {
    let sound = || list.iter().copied().filter(|own| own.is_finite() && *own > 0.0);
    let sum: f64 = sound().sum();
    let entropy: f64 = sound().map(|own| -own / sum * (own / sum).ln()).sum();
    if list.len() > 1 { (entropy / (list.len() as f64).ln()).clamp(0.0, 1.0) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grounding::GroundingOptions;

    fn matcher(scene: &str) -> (SemanticMap, Grounding, PlaceMatcher) {
        let map = SemanticMap::from_json(scene).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let matcher = PlaceMatcher::new(&map, &grounding);
        (map, grounding, matcher)
    }

    const FLAT: &str = include_str!("../../scenes/flat.json");
    const SHIPPED: [&str; 7] = [
        FLAT,
        include_str!("../../scenes/apartment-e0.json"),
        include_str!("../../scenes/apartment-e2.json"),
        include_str!("../../scenes/apartment-e1.json"),
        include_str!("../../scenes/studio.json"),
        include_str!("../../scenes/ward.json"),
        include_str!("../../scenes/warehouse.json"),
    ];

    #[test]
    fn each_label_of_each_shipped_map_is_found_in_each_sentence() {
        const SENTENCES: &str = "The nurse walks to the X.|The nurse goes to the X.|The nurse is at the X.|The nurse opens the X.|\
            The nurse drives to the X.|A person stands near a large white X.|A man is beside my X.|They sit at Ada's old X.";
        for scene in SHIPPED {
            let (_, grounding, mut matcher) = matcher(scene);
            for (index, label) in grounding.scored_labels.iter().enumerate() {
                for sentence in SENTENCES.split('|') {
                    let text = sentence.replace('X', &label.text);
                    assert_eq!(matcher.last(&text), Some(index.into()), "{text}");
                }
                for sentence in "I walk past my X.|She comes from this X.|They come out of our X.".split('|') {
                    let text = sentence.replace('X', &label.text);
                    assert!(matcher.last(&text).is_none_or(|found| found.is_left), "{text}");
                }
            }
        }
    }

    #[test]
    fn captions_name_their_room() {
        let (_, grounding, mut matcher) = matcher(FLAT);
        let mut label = |text: &str| matcher.last(text).map(|found| grounding.scored_labels[found.label].text.clone());
        for text in [
            "A man is standing in a kitchen.",
            "a man in a kitchen",
            "The image shows a man standing in the kitchen.",
            "In the kitchen, a man is washing his hands.",
            "A man is in the kitchen washing up.",
            "Two people are cooking in the kitchen.",
            "There is a person in the small kitchen.",
            "woman standing in kitchen",
            "They walk from the bedroom into the kitchen.",
            "They go to the kitchen from the bedroom.",
            "They walk past the bathroom to the kitchen and talk.",
            "A woman is standing in a small modern kitchen.",
            "A young man wearing a blue shirt is standing in a small modern kitchen.",
            "Kitchen: a man is washing dishes.",
            "The man is in the kitchen's corner.",
            "Between the wall and kitchen stands a man.",
            "They walk out of Ada's bedroom into the kitchen.",
            "They turn left. The kitchen is warm.",
        ] {
            assert_eq!(label(text).as_deref(), Some("kitchen"), "{text}");
        }
        for text in [
            "She's opening the fridge.",
            "opens fridge",
            "opening fridge",
            "Person opens the fridge.",
            "The video shows a person opening a fridge.",
        ] {
            assert_eq!(label(text).as_deref(), Some("fridge"), "{text}");
        }
    }

    #[test]
    fn origins_do_not_count() {
        let (_, grounding, mut matcher) = matcher(FLAT);
        let mut found = |text: &str| {
            let found = matcher.last(text)?;
            Some((grounding.scored_labels[found.label].text.clone(), found.is_left))
        };
        assert_eq!(found("Ada goes grocery shopping."), None);
        for text in [
            "They walk past the kitchen.",
            "They come from the kitchen.",
            "They walk away from the fridge.",
            "I walk past my large white fridge.",
            "She comes from this kitchen.",
            "A man emerges from inside the bathroom.",
            "They come from the kitchen and the bathroom.",
            "They study.",
        ] {
            assert_eq!(found(text), None, "{text}");
        }
        assert_eq!(found("She leaves this kitchen."), Some(("kitchen".to_owned(), true)));
        for text in ["They leave the kitchen.", "He is leaving the kitchen.", "They walk out of the kitchen."] {
            assert_eq!(found(text), Some(("kitchen".to_owned(), true)), "{text}");
        }
        assert_eq!(found("They leave the mug in the kitchen."), Some(("kitchen".to_owned(), false)));
        assert_eq!(found("They take the milk from the fridge to the table.").map(|found| found.1), Some(false));
    }

    #[test]
    fn held_and_worn_things_are_no_place_beside_one() {
        let (_, grounding, mut matcher) = matcher(FLAT);
        let mut label = |text: &str| matcher.last(text).map(|found| grounding.scored_labels[found.label].text.clone());
        assert_eq!(label("a woman sitting on a couch with a laptop").as_deref(), Some("sofa"));
        assert_eq!(label("A woman holding a laptop.").as_deref(), Some("computer"));
        assert_eq!(label("A man wearing a warm jacket."), None);
    }

    #[test]
    fn the_name_of_one_of_two_bedrooms_means_that_room() {
        let bedrooms = FLAT.replacen("\"label\": \"home office\"", "\"label\": \"bedroom\"", 1).replacen(
            "\"aliases\": {",
            "\"aliases\": {\"study\": [\"zimmer lena\"], ",
            1,
        );
        let (map, grounding, mut matcher) = matcher(&bedrooms);
        let lena = map.rooms.iter().position(|room| room.id == "study");
        for text in ["They turn on the zimmer lena lamp.", "Ada is reading in Zimmer Lena.", "They go to the study."] {
            let found = matcher.last(text).unwrap();
            assert_eq!(found.room, lena, "{text}");
            let shares: f64 = (0..map.rooms.len()).map(|room| found.share(&grounding, room)).sum();
            assert!((shares - 1.0).abs() < 1e-9 && (found.share(&grounding, lena.unwrap()) - 1.0).abs() < 1e-9);
        }
        assert_eq!(matcher.last("They go to the bedroom.").map(|found| found.room), Some(None));
    }

    #[test]
    fn plurals_and_singulars_are_one_name() {
        for (name, other) in
            [("shelf", "shelves"), ("mug", "mugs"), ("glasses", "glass"), ("box", "boxes"), ("berries", "berry")]
        {
            assert!(other_numbers(name).into_iter().flatten().any(|form| form == other), "{name} {other}");
        }
    }

    #[test]
    fn of_names_with_the_same_end_the_longest_counts() {
        let json =
            include_str!("../../scenes/studio.json").replacen("\"label\": \"bed\"", "\"label\": \"lily's bed\"", 1);
        let map = SemanticMap::from_json(&json).unwrap();
        let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
        let mut mentions = PlaceMatcher::new(&map, &grounding);
        let own = grounding.scored_labels.iter().position(|label| label.text == "lily's bed").unwrap();
        for sentence in ["Lily makes lily's bed.", "Lily goes to lily's bed."] {
            assert_eq!(mentions.last(sentence).map(|found| found.label), Some(own), "{sentence}");
        }
    }

    /// For any number of words in a label, and any separators.
    #[test]
    fn every_label_of_a_map_can_be_mentioned() {
        let words = ["led", "strip", "board", "shelf's", "tv-set", "42", "grün", "upper", "left", "lamp"];
        let labels = (1..=words.len()).map(|count| words[..count].join(" "));
        for label in
            labels.chain(["lamp (hall)", "salt & pepper mill", "a/c unit no. 2", "l'armoire"].map(str::to_owned))
        {
            let of = format!("\"label\": {label:?}");
            let json = include_str!("../../scenes/studio.json").replacen("\"label\": \"bed\"", &of, 1);
            let map = SemanticMap::from_json(&json).unwrap();
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let mut mentions = PlaceMatcher::new(&map, &grounding);
            let own = grounding.scored_labels.iter().position(|scored| scored.text == label);
            for sentence in [format!("Lena turns on the {label}."), format!("They use the {label} in the morning.")] {
                assert_eq!(mentions.last(&sentence).map(|found| found.label), own, "{sentence}");
            }
        }
    }

    #[test]
    fn every_name_means_what_the_map_says() {
        let scenes = [
            include_str!("../../scenes/studio.json"),
            include_str!("../../scenes/apartment-e0.json"),
            include_str!("../../scenes/ward.json"),
            include_str!("../../scenes/warehouse.json"),
        ];
        for scene in scenes {
            let map = SemanticMap::from_json(scene).unwrap();
            let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
            let mut mentions = PlaceMatcher::new(&map, &grounding);
            let asked = |name: &str| {
                let item = map.find_label(name).map(|label| &map.labels[label.0 as usize]);
                let text = item.or_else(|| map.find_room(name).map(|room| &map.rooms[room.0 as usize].label))?;
                grounding.scored_labels.iter().position(|label| label.text == *text)
            };
            let own = map.aliases.values().flatten().chain(&map.labels).map(String::as_str);
            let rooms = map.rooms.iter().flat_map(|room| [room.id.as_str(), room.label.as_str()]);
            let mut found = 0;
            for name in Names::built_in().names().chain(own).chain(rooms) {
                for name in [name.replace('_', " "), plain_words(name), plain_words(name).replace(' ', "-")] {
                    let words: Vec<&str> = name.split(' ').collect();
                    // A plural is a name, too: "food eggs" is a "food egg".
                    let of = |name: &str| {
                        asked(name).or_else(|| other_numbers(name).into_iter().flatten().find_map(|form| asked(&form)))
                    };
                    let expected = (1..=words.len()).rev().find_map(|length| of(&words[..length].join(" ")));
                    // A word of a name that the map lacks may itself be a name: the "table" of "cpu table".
                    if expected.is_none() {
                        continue;
                    }
                    let mention = mentions.last(&format!("They see the {name}."));
                    assert_eq!(mention.map(|found| found.label), expected, "{}: {name}", map.name);
                    found += 1;
                }
            }
            assert!(found > map.labels.len(), "{}: {found}", map.name);
        }
    }
}
