//! Words by what they mean in a sentence. They are in `clause.toml`.

use std::sync::LazyLock;

use foldhash::{HashMap, HashSet};
use serde::Deserialize;

use crate::names::Names;
use crate::narration::deeds;

pub(super) static WORDS: LazyLock<Words> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the table is compiled in and a test parses it")]
    toml::from_str(include_str!("../clause.toml")).expect("clause.toml is valid")
});

/// What may begin a predicate: the first words of all verbs that say where somebody is or goes. Most of what is narrated is something else,
/// and is passed over by a look at one word.
static PREDICATES: LazyLock<HashSet<&'static str>> = LazyLock::new(|| {
    let verbs = [
        &WORDS.leaves,
        &WORDS.goes,
        &WORDS.travels,
        &WORDS.moves,
        &WORDS.vehicles,
        &WORDS.takes,
        &WORDS.comes,
        &WORDS.drops_in,
        &WORDS.stays,
        &WORDS.visits,
    ];
    let verbs = verbs.into_iter().flat_map(List::iter).map(|verb| first_word(verb));
    verbs.chain(STATE_VERBS.iter().map(|verb| verb.trim_end())).chain(["just"]).collect()
});

/// Verbs before what somebody is.
pub(super) const STATE_VERBS: [&str; 8] = ["is ", "are ", "am ", "stays ", "stay ", "stayed ", "remains ", "remain "];

/// As much of words as is one word.
pub(super) fn first_word(words: &str) -> &str {
    let end = words.find(|c: char| !(c.is_alphanumeric() || c == '\'')).unwrap_or(words.len());
    &words[..end]
}

/// Whether words may say where somebody is or goes.
pub(super) fn may_be_predicate(rest: &str) -> bool {
    PREDICATES.contains(first_word(rest)) || deeds::moves(rest).is_some() || deeds::carrier(rest).is_some()
}

/// The table of words; see there.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Words {
    pub(super) first: List,
    pub(super) between: List,
    pub(super) not_said: List,
    pub(super) pronouns: List,
    pub(super) nobody: List,
    pub(super) everybody: List,
    pub(super) both: List,
    pub(super) of_each: List,
    pub(super) numbers: Vec<String>,
    pub(super) two: List,
    pub(super) orders: List,
    pub(super) moves: List,
    pub(super) vehicles: List,
    pub(super) stays: List,
    pub(super) farewells: List,
    pub(super) on_leaving: List,
    pub(super) purposes: List,
    pub(super) relatives: List,
    pub(super) visits: List,
    pub(super) drops_in: List,
    pub(super) except: List,
    pub(super) takes: List,
    pub(super) lets: List,
    pub(super) ways_out: List,
    pub(super) ways_by: List,
    pub(super) ways_to: List,
    pub(super) postures: List,
    pub(super) delayed: List,
    pub(super) near_the_house: List,
    pub(super) openings: List,
    pub(super) calls: List,
    pub(super) trackers: List,
    pub(super) tracked: List,
    pub(super) tracked_states: List,
    pub(super) zones: List,
    pub(super) possessives: List,
    pub(super) own: List,
    pub(super) meals: List,
    pub(super) outside: List,
    pub(super) rooms_elsewhere: List,
    pub(super) away_for: List,
    pub(super) not_now: List,
    pub(super) lasting: List,
    pub(super) another_thought: List,
    pub(super) units: List,
    pub(super) hours: List,
    pub(super) doubtful: List,
    pub(super) along: List,
    pub(super) not_along: List,
    pub(super) animals: List,
    pub(super) unreal: List,
    pub(super) speaks: List,
    pub(super) determiners: List,
    pub(super) devices: List,
    pub(super) titles: List,
    pub(super) people: List,
    pub(super) nothing: List,
    pub(super) stuff: List,
    pub(super) of_itself: List,
    pub(super) leaves: List,
    pub(super) goes: List,
    pub(super) travels: List,
    pub(super) under_way: List,
    pub(super) errands: List,
    pub(super) outings: List,
    pub(super) comes: List,
    pub(super) house: List,
    pub(super) at_house: List,
    pub(super) out: List,
    pub(super) r#in: List,
    pub(super) indoors: List,
    pub(super) resorts: List,
    pub(super) trades: List,
    pub(super) at_home: List,
    pub(super) goes_on: List,
    pub(super) rooms: List,
    pub(super) from_afar: List,
    pub(super) afar: List,
    pub(super) anybody: List,
    pub(super) begin: List,
    pub(super) conditions: List,
    pub(super) groups: List,
    pub(super) addresses: List,
    pub(super) begun: List,
    pub(super) reports: List,
    pub(super) supposes: List,
    pub(super) greetings: List,
    pub(super) past: List,
    pub(super) no_verbs: List,
    pub(super) ended: List,
    pub(super) verbs_with_after: List,
    pub(super) perceives: List,
    pub(super) sends: List,
    pub(super) guests: List,
}

/// Words of one kind, found by the first of each: a sentence is looked at by many lists, and has something of few.
#[derive(Debug, Deserialize)]
#[serde(from = "Vec<String>")]
pub(super) struct List {
    /// What most words are not in, told without a look at the tables, which are seldom in the processor's cache when an event comes.
    maybe: Filter,
    maybe_first: Filter,
    all: HashSet<String>,
    by_first: HashMap<String, Vec<String>>,
}

/// Words by their length, first and last letter: says of most others that they are none of them.
#[derive(Debug, Default)]
struct Filter([u64; 4]);

impl Filter {
    pub(super) fn of<'a>(words: impl Iterator<Item = &'a str>) -> Self {
        let mut filter = Self::default();
        for word in words {
            let (place, bit) = Self::place(word);
            filter.0[place] |= bit;
        }
        filter
    }

    pub(super) fn may_have(&self, word: &str) -> bool {
        let (place, bit) = Self::place(word);
        self.0[place] & bit != 0
    }

    fn place(word: &str) -> (usize, u64) {
        let end = |byte: Option<&u8>| byte.map_or(0, |byte| usize::from(*byte));
        let number = end(word.as_bytes().first()) + 11 * end(word.as_bytes().last()) + 29 * word.len();
        (number / 64 % 4, 1 << (number % 64))
    }
}

impl From<Vec<String>> for List {
    fn from(words: Vec<String>) -> Self {
        let mut by_first = HashMap::<_, Vec<_>>::default();
        for word in &words {
            by_first.entry(first_word(word).to_owned()).or_default().push(word.clone());
        }
        Self {
            maybe: Filter::of(words.iter().map(String::as_str)),
            maybe_first: Filter::of(by_first.keys().map(String::as_str)),
            all: words.into_iter().collect(),
            by_first,
        }
    }
}

impl List {
    pub(super) fn iter(&self) -> impl Iterator<Item = &String> {
        self.by_first.values().flatten()
    }

    /// Those that a text begins with, which may go on within a word behind them, and what follows.
    pub(super) fn begin<'a>(&self, text: &'a str) -> impl Iterator<Item = (&str, &'a str)> {
        let first = Some(first_word(text)).filter(|first| self.maybe_first.may_have(first));
        let found = first.and_then(|first| self.by_first.get(first)).into_iter().flatten();
        found.filter_map(move |word| Some((word.as_str(), text.strip_prefix(word.as_str())?)))
    }

    /// Whether one of them stands in a text as whole words.
    pub(super) fn is_in(&self, text: &str) -> bool {
        let begins = text.char_indices().scan(false, |in_word, (at, c)| {
            let was_in_word = std::mem::replace(in_word, c.is_alphanumeric());
            Some((*in_word && !was_in_word).then_some(at))
        });
        begins.flatten().any(|at| self.after(&text[at..]).any(|after| !after.starts_with(char::is_alphanumeric)))
    }

    /// What follows those.
    pub(super) fn after<'a>(&self, text: &'a str) -> impl Iterator<Item = &'a str> {
        self.begin(text).map(|(_, after)| after)
    }
}

pub(super) fn has(words: &List, word: &str) -> bool {
    words.maybe.may_have(word) && words.all.contains(word)
}

/// A kind of words in the table.
#[derive(Debug, Clone, Copy)]
pub(in crate::narration) enum Word {
    Anybody,
    Begin,
    Condition,
    Determiner,
    Everybody,
    Greeting,
    Group,
    Nothing,
    OfItself,
    People,
    Possessive,
    Pronoun,
    Report,
    Stuff,
    Title,
    Trade,
}

/// Whether a word in lower case is of a kind.
pub(in crate::narration) fn is(kind: Word, word: &str) -> bool {
    let words = match kind {
        Word::Anybody => &WORDS.anybody,
        Word::Begin => &WORDS.begin,
        Word::Condition => &WORDS.conditions,
        Word::Determiner => &WORDS.determiners,
        Word::Everybody => &WORDS.everybody,
        Word::Greeting => &WORDS.greetings,
        Word::Group => &WORDS.groups,
        Word::Nothing => &WORDS.nothing,
        Word::OfItself => &WORDS.of_itself,
        Word::People => &WORDS.people,
        Word::Possessive => &WORDS.possessives,
        Word::Pronoun => &WORDS.pronouns,
        Word::Report => &WORDS.reports,
        Word::Stuff => &WORDS.stuff,
        Word::Title => &WORDS.titles,
        Word::Trade => &WORDS.trades,
    };
    has(words, word)
}

/// Whether a subject begins with several persons without names: "two people", "three young women".
pub(in crate::narration) fn is_a_number_of(first: &str, rest: &[&str]) -> bool {
    WORDS.numbers.iter().any(|number| number == first) && rest.iter().take(2).any(|noun| has(&WORDS.groups, noun))
}

/// Whether a word may say what one person does: "goes", "opened", "went".
pub(in crate::narration) fn is_verb(word: &str) -> bool {
    // "Status" and "Marcus" are none.
    let is_third = word.ends_with('s') && !word.ends_with("ss") && !word.ends_with("us");
    (is_third || word.ends_with("ed") || has(&WORDS.past, word)) && !has(&WORDS.no_verbs, word)
}

/// Whether a word may be a verb in any form: "open", "opens", "opening".
pub(in crate::narration) fn may_be_a_verb(word: &str) -> bool {
    is_verb(word)
        || matches!(word, "are" | "am")
        || word.ends_with("ing")
        || deeds::is_form(word)
        || has(&WORDS.orders, word)
}

/// Whether a word may by its letters be what one person does, said in the present: "opens", and not "lukas", "chris" or "carlos", nor what has an accent.
pub(in crate::narration) fn may_be_third_person(word: &str) -> bool {
    const OTHERS: [&str; 4] = ["has", "is", "skis", "was"];
    let ends = word.strip_suffix('s').is_some_and(|stem| !stem.ends_with(['a', 'i', 'o', 's', 'u', '-']));
    word.is_ascii() && (ends && !word.contains('-') || OTHERS.contains(&word))
}

/// Whether a word is the form of a verb that the tables know, after one person.
pub(in crate::narration) fn is_known_verb(word: &str) -> bool {
    static KNOWN: LazyLock<HashSet<&'static str>> = LazyLock::new(|| {
        let lists = [
            &WORDS.leaves,
            &WORDS.goes,
            &WORDS.travels,
            &WORDS.moves,
            &WORDS.vehicles,
            &WORDS.stays,
            &WORDS.visits,
            &WORDS.drops_in,
            &WORDS.on_leaving,
            &WORDS.farewells,
            &WORDS.takes,
            &WORDS.lets,
            &WORDS.comes,
            &WORDS.speaks,
            &WORDS.from_afar,
            &WORDS.past,
            &WORDS.perceives,
            &WORDS.sends,
        ];
        let listed = lists.into_iter().flat_map(List::iter).map(|verb| first_word(verb));
        let actions = crate::narration::action_table().values().flat_map(|action| [&*action.third, &*action.past]);
        listed.chain(actions.map(first_word)).collect()
    });
    // A plural is what something is done to: "washes dishes", "grabs drinks".
    let is_thing = |word: &str| !is_possible(word);
    let singular = word.strip_suffix('s').unwrap_or(word);
    is_verb(word)
        && (KNOWN.contains(word) || deeds::is_form(word))
        && !is_thing(singular)
        && !singular.strip_suffix('e').is_some_and(is_thing)
}

/// Whether a word says where rather than whom: "upstairs".
pub(super) fn is_a_way(name: &&str) -> bool {
    name.split(' ').any(|word| has(&WORDS.begin, word))
}

/// Whether a name is not that of a thing.
pub(super) fn is_possible(name: &str) -> bool {
    !Names::built_in().knows(name)
}
