//! What the verb of a deed tells of where its person is, by classes of verbs and what they are done to. The words are in `deeds.toml`.

use std::sync::LazyLock;

use foldhash::HashMap;
use serde::Deserialize;

static DEEDS: LazyLock<Deeds> = LazyLock::new(|| {
    #[expect(clippy::expect_used, reason = "the table is compiled in and a test parses it")]
    toml::from_str(include_str!("deeds.toml")).expect("deeds.toml is valid")
});

/// Every form of every verb of the classes.
static CLASSES: LazyLock<Classes> = LazyLock::new(|| {
    let forms = |verbs: &[String]| {
        let mut forms = HashMap::<_, Vec<_>>::default();
        for verb in verbs {
            let (first, behind) = verb.split_once(' ').unwrap_or((verb, ""));
            // "One's" is that of whoever does it.
            let behind: Vec<String> = match behind.contains("one's") {
                true => ["his", "her", "their", "the"].iter().map(|whose| behind.replace("one's", whose)).collect(),
                false => vec![behind.to_owned()],
            };
            for form in all_forms(first) {
                forms.entry(form).or_default().extend(behind.iter().cloned());
            }
        }
        Forms(forms)
    };
    Classes {
        elsewhere: forms(&DEEDS.elsewhere),
        anywhere: forms(&DEEDS.anywhere),
        boards: forms(&DEEDS.boards),
        happens: forms(&DEEDS.happens),
        moves: forms(&DEEDS.moves),
        errands: forms(&DEEDS.errands),
        fetches: forms(&DEEDS.fetches),
        alights: forms(&DEEDS.alights),
        defeats: forms(&DEEDS.defeats),
        touches: forms(&DEEDS.touches),
        gives: forms(&["give".to_owned()]),
    }
});

/// The table of verbs; see there.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Deeds {
    elsewhere: Vec<String>,
    anywhere: Vec<String>,
    boards: Vec<String>,
    carriers: Vec<String>,
    vehicles: Vec<String>,
    moves: Vec<String>,
    errands: Vec<String>,
    fetches: Vec<String>,
    alights: Vec<String>,
    defeats: Vec<String>,
    touches: Vec<String>,
    given: Vec<String>,
    happens: Vec<String>,
    broadcast: Vec<String>,
    irregular: HashMap<String, Vec<String>>,
}

#[derive(Debug)]
struct Classes {
    elsewhere: Forms,
    anywhere: Forms,
    boards: Forms,
    happens: Forms,
    moves: Forms,
    errands: Forms,
    fetches: Forms,
    alights: Forms,
    defeats: Forms,
    touches: Forms,
    gives: Forms,
}

/// Forms of verbs, and the words that make one verb of them with each: "check" and "into".
#[derive(Debug)]
struct Forms(HashMap<String, Vec<String>>);

impl Forms {
    /// What follows a verb of the class, of the longest one.
    fn after<'a>(&self, words: &'a str) -> Option<&'a str> {
        let (verb, rest) = words.split_once([' ', ',']).unwrap_or((words, ""));
        let ends = |more: &str| more.is_empty() || more.starts_with([' ', ',']);
        let behind = self.0.get(verb)?.iter();
        let found = behind
            .filter_map(|behind| rest.strip_prefix(behind.as_str()).filter(|more| behind.is_empty() || ends(more)));
        found.min_by_key(|more| more.len()).map(str::trim_start)
    }
}

/// A verb's first form and those that are made of it.
fn all_forms(verb: &str) -> Vec<String> {
    let is_vowel = |c: char| matches!(c, 'a' | 'e' | 'i' | 'o' | 'u');
    let stem = verb.strip_suffix('e').unwrap_or(verb);
    let y = verb.strip_suffix('y').filter(|stem| !stem.ends_with(is_vowel));
    let hisses = ["s", "sh", "ch", "x", "o"].iter().any(|end| verb.ends_with(end));
    let third = match y {
        Some(stem) => format!("{stem}ies"),
        None => format!("{verb}{}", if hisses { "es" } else { "s" }),
    };
    let past = y.map_or_else(|| format!("{stem}ed"), |stem| format!("{stem}ied"));
    // "Beginning" and "stopping" double what they end with, "hearing" does not: the word that nobody writes does no harm.
    let last = verb.chars().next_back().unwrap_or_default();
    let doubled = [format!("{verb}{last}ing"), format!("{verb}{last}ed")];
    let irregular = DEEDS.irregular.get(verb).cloned().unwrap_or_default();
    [verb.to_owned(), third, past, format!("{stem}ing")].into_iter().chain(doubled).chain(irregular).collect()
}

/// Whether a word is a form of a verb of the classes.
pub(super) fn is_form(word: &str) -> bool {
    let Classes { elsewhere, anywhere, boards, happens, moves, errands, fetches, alights, defeats, touches, gives } =
        &*CLASSES;
    [elsewhere, anywhere, boards, happens, moves, errands, fetches, alights, defeats, touches, gives]
        .into_iter()
        .any(|class| class.0.contains_key(word))
}

/// Words after a subject without what says only that it is done just now: "buys milk" of "is buying milk".
fn plain(rest: &str) -> &str {
    let mut rest = rest;
    while let Some(more) = ["is ", "are ", "am ", "has ", "have ", "just ", "already ", "still "]
        .iter()
        .find_map(|word| rest.strip_prefix(word))
    {
        rest = more;
    }
    rest
}

/// Whether what is said of a subject may be done by somebody who is not in the house.
pub(super) fn may_be_done_elsewhere(rest: &str) -> bool {
    let rest = plain(rest);
    [&CLASSES.elsewhere, &CLASSES.anywhere].iter().any(|class| class.after(rest).is_some())
        || carrier(rest).is_some()
        || carried(CLASSES.alights.after(rest), &DEEDS.carriers).is_some()
}

/// What follows a verb of going: "off to the gym" of "dashes off to the gym".
pub(super) fn moves(rest: &str) -> Option<&str> {
    CLASSES.moves.after(plain(rest))
}

/// Whether what somebody goes to do is done out of the house: "buy bread", "pick up a pizza". Of who has only set out, it has to say from where.
pub(super) fn is_errand(what: &str, is_gone: bool) -> bool {
    CLASSES.errands.after(what).is_some() || (is_gone && CLASSES.fetches.after(what).is_some())
}

/// Where from somebody fetches something: "school" of "fetch the kids from school".
pub(super) fn fetched_from(what: &str) -> Option<&str> {
    CLASSES.fetches.after(what)?.split_once(" from ").map(|(_, place)| place)
}

/// What one club is said to have won against, or so, which another one may be: "dortmund" of "beats dortmund".
pub(super) fn defeated(rest: &str) -> Option<&str> {
    CLASSES.defeats.after(plain(rest)).map(|more| more.split([' ', ',']).next().unwrap_or_default())
}

/// Whom somebody touches who is there, and what follows: "lena in the hall" of "hugs lena in the hall".
pub(super) fn touched(rest: &str) -> Option<&str> {
    let rest = plain(rest);
    let given = || {
        let more = CLASSES.gives.after(rest)?;
        let is_one = |word: &str| DEEDS.given.iter().any(|given| given == word);
        more.split([' ', ',']).any(is_one).then_some(more)
    };
    CLASSES.touches.after(rest).or_else(given)
}

/// Whether a word may begin such a deed.
pub(super) fn may_touch(word: &str) -> bool {
    CLASSES.touches.0.contains_key(word) || CLASSES.gives.0.contains_key(word)
}

/// What may follow what carries many people.
const BEHIND_CARRIERS: [&str; 14] =
    ["again", "alone", "and", "at", "back", "for", "from", "home", "in", "into", "now", "to", "together", "with"];

/// What follows what carries many people, where somebody boards it: "to town" of "takes the bus to town".
pub(super) fn carrier(rest: &str) -> Option<&str> {
    carried(CLASSES.boards.after(plain(rest)), &DEEDS.carriers)
}

/// The same of somebody's own vehicle: "to work" of "takes her bike to work".
pub(super) fn vehicle(rest: &str) -> Option<&str> {
    carried(CLASSES.boards.after(plain(rest)), &DEEDS.vehicles)
}

/// What follows one of `things` with an article.
fn carried<'a>(object: Option<&'a str>, things: &[String]) -> Option<&'a str> {
    let object = object?;
    let (article, thing) = object.split_once(' ')?;
    let is_one = ["the", "a", "an", "his", "her", "their"].contains(&article);
    let (thing, more) = thing.split_once([' ', ',']).unwrap_or((thing, ""));
    // A train set is none.
    let next = more.split([' ', ',']).next().unwrap_or_default();
    let is_whole = next.is_empty() || BEHIND_CARRIERS.contains(&next);
    (is_one && is_whole && things.iter().any(|own| own == thing)).then_some(more)
}

/// Whether what is said of a name that nobody has is what a show, a club or a device does: "starts on TV", "plays against Ajax".
pub(super) fn is_an_event(rest: &str) -> bool {
    const BEHIND: [&str; 7] = ["at", "in", "on", "against", "for", "after", "with"];
    let ends = |more: &str| more.is_empty() || BEHIND.contains(&more.split(' ').next().unwrap_or_default());
    let has_object = |more: &str| !more.is_empty() && !ends(more);
    let is_event = CLASSES.happens.after(rest).is_some_and(|more| !has_object(more) || is_against(rest));
    is_event || is_broadcast(rest)
}

/// Whether what is said is seen or heard from elsewhere: "on tv", "over the phone".
pub(super) fn is_broadcast(said: &str) -> bool {
    DEEDS.broadcast.iter().any(|place| crate::text::has_words(said, place))
}

/// Whether two clubs play: whatever follows is the other one.
fn is_against(rest: &str) -> bool {
    [" against ", " versus ", " vs "].iter().any(|word| rest.contains(word))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_verb_has_forms() {
        for (verb, forms) in [
            ("buy", ["buy", "buys", "bought", "buying"]),
            ("worry", ["worry", "worries", "worried", "worrying"]),
            ("miss", ["miss", "misses", "missed", "missing"]),
            ("love", ["love", "loves", "loved", "loving"]),
            ("begin", ["begin", "begins", "began", "beginning"]),
        ] {
            let all = all_forms(verb);
            assert!(forms.iter().all(|form| all.iter().any(|own| own == form)), "{verb}: {all:?}");
        }
    }

    #[test]
    fn deeds_of_elsewhere_are_told_from_those_in_the_house() {
        for rest in [
            "buys milk",
            "is buying milk",
            "lands in berlin",
            "forgot her umbrella",
            "takes the bus home",
            "has missed the train",
            "sees jon",
            "checks into the hotel",
            "just bought bread",
            "got on the plane",
            "loses",
        ] {
            assert!(may_be_done_elsewhere(rest), "{rest}");
        }
        for rest in [
            "opens the fridge",
            "takes the cup",
            "checks the oven",
            "writes a letter",
            "takes the train set",
            "gets on the sofa",
            "sits down",
        ] {
            assert!(!may_be_done_elsewhere(rest), "{rest}");
        }
        assert_eq!(carrier("takes the bus to town"), Some("to town"));
        assert_eq!(carrier("catches a train"), Some(""));
        assert_eq!(carrier("takes the bath"), None);
    }

    #[test]
    fn a_show_is_no_person() {
        for rest in [
            "starts on tv",
            "starts",
            "plays against dortmund",
            "wins",
            "wins against bremen",
            "speaks on tv",
            "loses",
            "begins at eight",
        ] {
            assert!(is_an_event(rest), "{rest}");
        }
        for rest in [
            "starts cooking",
            "plays with lena",
            "sits on the sofa",
            "arrives",
            "stops by",
            "loses her keys",
            "stops the oven",
        ] {
            assert!(!is_an_event(rest), "{rest}");
        }
    }
}
