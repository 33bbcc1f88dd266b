//! Whom a plain sentence is about. What is not understood is about nobody: nobody is moved by it.

use super::clause::{self, NAME_WORDS_MAX, Word};
use super::deeds;

/// Whom a plain sentence is about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum About {
    /// Persons who are known, or are called by what they are ("plumber"), in lower case.
    Named(Vec<String>),
    /// Somebody by a name that nobody here has.
    Stranger(String),
    /// Somebody of whom it says no name: "They open the fridge.", "A woman sits down.", "Opens the fridge.", "The oven is on."
    Somebody,
    /// A thing, an animal, several persons without names, or what nobody does now: "The robot drives off.", "Ada was in the kitchen."
    Nobody,
}

/// Reads a sentence in plain form; `is_known` says whether a name is a person's, `is_name` whether a word is written as a name.
pub(super) fn about(said: &str, is_known: &mut dyn FnMut(&str) -> bool, is_name: &dyn Fn(&str) -> bool) -> About {
    let said = clause::without_opening(clause::without_first(said));
    let words: Vec<&str> = said.split(' ').map(|word| word.trim_matches([',', ':', ';'])).collect();
    let Some((&first, rest)) = words.split_first() else { return About::Somebody };
    let word = |at: usize| words.get(at).copied().unwrap_or_default();
    if clause::is(Word::Condition, first) || said.ends_with('?') || clause::is_order(said) {
        return About::Nobody;
    }
    // Who only greets may be anywhere: "Hello!" is of nobody, and "Hi, Ada comes in." of Ada.
    if clause::is(Word::Greeting, first.trim_end_matches(['!', '.'])) {
        let rest = said.split_once([',', '!']).map_or("", |(_, rest)| rest.trim_start());
        return match about(rest, is_known, is_name) {
            named @ About::Named(_) if !rest.is_empty() => named,
            _ => before_its_verb(said, is_known).unwrap_or(About::Nobody),
        };
    }
    // What stands before it was speech: "says Ada".
    if clause::is(Word::Report, first) {
        let name = rest.join(" ");
        return if is_known(&name) { About::Named(vec![name]) } else { About::Nobody };
    }
    if clause::is(Word::Begin, first) {
        return later_subject(said, &words, is_known, is_name);
    }
    let found = clause::longest_subject(said, |name| is_known(name) || clause::is(Word::People, name));
    // "Ada and Igor sit on the sofa" is of Igor, too, of whom nobody has told yet.
    let found = found.map(|(names, rest)| clause::with_strangers(said, is_known, is_name).unwrap_or((names, rest)));
    // "Aunt Rosa" is not "aunt".
    let is_called = |names: &[String]| {
        let verb = rest.first().copied().unwrap_or_default();
        !(clause::is(Word::Title, first) && names.len() == 1 && names[0] == first && !clause::is_verb(verb))
    };
    if let Some((names, rest)) = found.filter(|(names, _)| is_called(names)) {
        if clause::is_past_state(rest) || clause::is_unreal(rest) {
            return About::Nobody;
        }
        // "Our daughter Lily" is Lily, of whom nobody has told yet.
        let (kind, own, verb) = (word(1), word(2), word(3));
        let of_kind = names == [kind] && clause::is(Word::Possessive, first) && !is_known(kind);
        let is_own = of_kind && !clause::is_verb(own) && clause::is_verb(verb) && is_name(own);
        return match is_own && clause::may_be_a_person(own) {
            true => About::Stranger(own.to_owned()),
            false => About::Named(names),
        };
    }
    // Whatever stands before them, it is of whom it names before what they do: "Carefully, Ben opens the fridge.", "Hungry Ben opens it."
    if let Some(main) = clause::behind_opening(said, &mut *is_known) {
        return about(main, is_known, is_name);
    }
    if let Some(named) = before_its_verb(said, is_known) {
        return named;
    }
    let (second, third) = (word(1), word(2));
    if clause::is(Word::Pronoun, first) {
        // What somebody thinks is no observation.
        if clause::is(Word::Report, second) && !clause::is_verb(second) {
            return About::Nobody;
        }
        let rest = said.split_once(' ').map_or("", |(_, rest)| rest);
        let is_not_so = clause::is_past_state(rest) || clause::is_unreal(rest);
        return if is_not_so { About::Nobody } else { About::Somebody };
    }
    // What a group does is of no one person: "Everybody sings.", "Two people sit on a couch."
    if clause::is(Word::Everybody, first) || clause::is_a_number_of(first, rest) {
        return About::Nobody;
    }
    if clause::is(Word::Determiner, first) {
        return of_a_noun(said, first, rest);
    }
    // "Ada's mother" is nobody who is known.
    if first.ends_with("'s") && clause::is(Word::People, second) && clause::is_verb(third) {
        return About::Stranger(format!("{first} {second}"));
    }
    if clause::is(Word::Nothing, first) || first.ends_with("'s") || clause::is(Word::Group, first) {
        return About::Nobody;
    }
    // "Leak detected" is a sensor's, and "human detected in the kitchen" of somebody there.
    if let Some(at) = words.iter().take(NAME_WORDS_MAX).position(|word| *word == "detected") {
        let is_there = || clause::is_of_a_room(&words[at + 1..].join(" "));
        return if clause::is(Word::Anybody, first) && is_there() { About::Somebody } else { About::Nobody };
    }
    let (first, is_title) = (first.trim_end_matches('.'), clause::is(Word::Title, first.trim_end_matches('.')));
    // "Olga Petrova opens the fridge": a first word is written as a name in any case.
    let is_whole = || !said.split(' ').next().is_some_and(|first| first.ends_with([',', ':', ';']));
    let has_last_name = !clause::is_verb(second) && is_name(second) && is_whole() && clause::is_verb(third);
    let (name, verb) = match is_title || has_last_name {
        true => (format!("{first} {second}"), third),
        false => (first.to_owned(), second),
    };
    // "Front Door opens" is the door's state, and "Baby Monitor turns on" nobody's deed.
    let is_of_two = has_last_name || !clause::is_verb(first) && !clause::is_verb(second);
    if is_of_two && clause::is_verb(third) && clause::is_named_thing(&format!("{first} {second}")) {
        return if clause::is_of_a_state(said) { About::Somebody } else { About::Nobody };
    }
    // "Opens the fridge." begins with what somebody does, "Jens opens the fridge." with who does it.
    let is_plain = |word: &str| word.chars().all(|c| c.is_alphabetic() || c == '-');
    let may_be_a_deed =
        || clause::may_be_third_person(first) && (clause::is_known_verb(first) || !clause::is_known_verb(second));
    let may_be_a_name = name.starts_with(char::is_alphabetic) && (name != first || is_plain(first) && !may_be_a_deed());
    if may_be_a_name && clause::is_verb(verb) && clause::may_be_a_person(&name) && clause::may_be_a_person(first) {
        // A show or a club is no person.
        let deed = said.find(verb).map_or("", |at| &said[at..]);
        let is_club = |other: &str| !other.is_empty() && !is_known(other) && is_name(other);
        if deeds::is_an_event(deed) || deeds::defeated(deed).is_some_and(is_club) {
            return About::Nobody;
        }
        // "Snow falls", and Mrs. Snow is a person.
        return if clause::is(Word::Stuff, &name) { About::Nobody } else { About::Stranger(name) };
    }
    // "Battery low" says what nobody does.
    if !words.iter().any(|word| clause::may_be_a_verb(word)) {
        return About::Nobody;
    }
    // The dishwasher by its name alone is no person.
    if clause::is_verb(second) && !clause::may_be_a_person(first) { About::Nobody } else { About::Somebody }
}

/// Whom a sentence names right before its verb, who is known; nobody where it is not told that it is so.
fn before_its_verb(said: &str, is_known: &mut dyn FnMut(&str) -> bool) -> Option<About> {
    let (name, rest, is_told) = clause::known_before_a_verb(said, is_known)?;
    let is_so = is_told && !clause::is_past_state(rest) && !clause::is_unreal(rest);
    Some(if is_so { About::Named(vec![name.to_owned()]) } else { About::Nobody })
}

/// What a thing is called by has at most so many words: "robot lawn mower".
const THING_WORDS_MAX: usize = 4;

/// A sentence about what stands behind an article: a person without a name, a device and its state, or a thing.
fn of_a_noun(said: &str, article: &str, rest: &[&str]) -> About {
    let noun = rest.first().copied().unwrap_or_default();
    // "An old man", "the young woman".
    let next = rest.get(1).copied().unwrap_or_default();
    let is_several = rest.get(1) == Some(&"and");
    // "The delivery man" is none of those who live here, whoever he is.
    if clause::is(Word::Trade, noun) && clause::is(Word::Anybody, next) {
        return About::Nobody;
    }
    if (clause::is(Word::Anybody, noun) || clause::is(Word::Anybody, next)) && !is_several {
        return About::Somebody;
    }
    // What moves by itself, or was brought, tells of nobody: "the robot vacuum is running".
    let is_before_verb = |words: &[&str]| clause::is_verb(words[1]) || words[1] == "are";
    let head = rest.windows(2).take(THING_WORDS_MAX).find(|words| is_before_verb(words)).map_or(noun, |words| words[0]);
    let is_of_itself = clause::is(Word::OfItself, head) || clause::is(Word::Group, head);
    let is_device = matches!(article, "the" | "a" | "an") && !is_of_itself && clause::is_of_a_state(said);
    if is_device { About::Somebody } else { About::Nobody }
}

/// "In the bathroom, Ada brushes her teeth.": whom it names behind what it begins with.
fn later_subject(
    said: &str,
    words: &[&str],
    is_known: &mut dyn FnMut(&str) -> bool,
    is_name: &dyn Fn(&str) -> bool,
) -> About {
    if let Some((_, rest)) = said.split_once(", ") {
        return about(rest, is_known, is_name);
    }
    for at in 1..words.len() {
        for length in (1..=NAME_WORDS_MAX.min(words.len() - at)).rev() {
            if !words.get(at + length).is_some_and(|verb| clause::is_verb(verb)) {
                continue;
            }
            let name = words[at..at + length].join(" ");
            if is_known(&name) || clause::is(Word::People, &name) {
                return About::Named(vec![name]);
            }
        }
    }
    About::Somebody
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::narration::{is_written_as_a_name, reading};

    fn of(sentence: &str) -> String {
        let mut known = |name: &str| ["ada", "ben", "tom", "mr. klein", "lucas"].contains(&name);
        let is_name = |name: &str| is_written_as_a_name(sentence, name);
        match reading::with_plain(sentence, |plain| about(plain, &mut known, &is_name)) {
            About::Named(names) => names.join("+"),
            About::Stranger(name) => format!("new {name}"),
            About::Somebody => "somebody".to_owned(),
            About::Nobody => "nobody".to_owned(),
        }
    }

    #[test]
    fn sentences_are_about_whom_they_name() {
        for (sentence, expected) in [
            ("Ada opens the fridge.", "ada"),
            ("Ada and Ben sit on the sofa.", "ada+ben"),
            ("Ada and the plumber go to the kitchen.", "ada+plumber"),
            ("Ada and Igor sit on the sofa.", "ada+igor"),
            ("Ada and nobody else sits on the sofa.", "ada"),
            ("In the bathroom, Ada brushes her teeth.", "ada"),
            ("After dinner, Ben goes to the laundry room.", "ben"),
            ("At 7 am Ben walks into the bathroom.", "ben"),
            ("At eight Ben leaves the house.", "ben"),
            ("While Ada cooks, Ben sets the table.", "ben"),
            ("But Ben opens the door.", "ben"),
            ("Mr. Klein opens the door.", "mr. klein"),
            ("Lucas sits on the sofa.", "lucas"),
            ("Igor sits down on the sofa.", "new igor"),
            ("Aunt Rosa goes to the bathroom.", "new aunt rosa"),
            ("Olga Petrova opens the fridge.", "new olga petrova"),
            ("Tante Ilse opens the fridge.", "new tante ilse"),
            ("Ada Petrova opens the fridge.", "ada"),
            ("Opens Petrova's door.", "somebody"),
            ("Mrs. Novak mops the floor.", "new mrs novak"),
            ("Grandma Ada opens the fridge.", "new grandma ada"),
            ("Will opens the fridge.", "new will"),
            ("Lukas opens the fridge.", "new lukas"),
            ("Thomas comes home.", "new thomas"),
            ("Chris sneezes.", "new chris"),
            ("Iris sits down.", "new iris"),
            ("Niklas paints the wall.", "new niklas"),
            ("Marcus walks to the sofa.", "new marcus"),
            ("Inés waters the plants.", "new inés"),
            ("Jens goes to bed.", "new jens"),
            ("Nils leaves the house.", "new nils"),
            ("James opens the fridge.", "new james"),
            ("Agnes sat on the sofa.", "new agnes"),
            ("Hans-Jens opens the fridge.", "new hans-jens"),
            ("The cleaner says goodbye.", "cleaner"),
            ("Ada's mother sits down.", "new ada's mother"),
            ("Hi, Ada opens the door.", "ada"),
            ("My husband sits on the bed.", "husband"),
            ("\"I will leave the house soon\", says Ada.", "ada"),
            ("Ada says: \"Ben, leave the house!\"", "ada"),
        ] {
            assert_eq!(of(sentence), expected, "{sentence}");
        }
    }

    /// What a sentence begins with is no person, and takes none from whom it is about.
    #[test]
    fn what_stands_before_a_name_is_none() {
        for (sentence, expected) in [
            ("Carefully, Ben opens the fridge.", "ben"),
            ("Again, Ben opens the fridge.", "ben"),
            ("Smiling at last, Ben opens the fridge.", "ben"),
            ("Without looking, Ben opens the fridge.", "ben"),
            ("Alone at home, Ben opens the fridge.", "ben"),
            ("Yes, Ben goes to bed.", "ben"),
            ("Carefully, Ada and Ben open the fridge.", "ada+ben"),
            ("Igor, Ben opens the fridge.", "ben"),
            ("Carefully Ben opens the fridge.", "ben"),
            ("Poor Ada goes to bed.", "ada"),
            ("Poor tired Lucas goes to bed.", "lucas"),
            ("Tired Ben goes to bed.", "ben"),
            ("Old Ben goes to bed.", "ben"),
            ("Hey Ben goes to bed.", "ben"),
            ("- Ada goes to bed.", "ada"),
            ("1. Ada goes to bed.", "ada"),
            ("10:32 Ben opens the fridge.", "ben"),
            ("2026-11-27 10:32:05 Ben opens the fridge.", "ben"),
            ("Alert: Ben opens the fridge.", "ben"),
            ("Status: Ben opens the fridge.", "ben"),
            ("News: Ben opens the fridge.", "ben"),
            ("Kitchen: Ben opens the fridge.", "ben"),
            ("Camera 2: Ben sits down on the bed.", "ben"),
            ("Camera 2: Ada and Ben sit on the bed.", "ada+ben"),
            ("Living room - Ben turns on the TV.", "ben"),
            ("Ben: opens the fridge.", "ben"),
            ("My wife Ada goes to bed.", "ada"),
            ("My wife Ada and Ben sit down.", "ada+ben"),
            ("The plumber Ben repairs the sink.", "ben"),
            ("Our daughter Lily goes to bed.", "new lily"),
            ("My husband quickly goes to bed.", "husband"),
            ("Igor Ben opens the fridge.", "ben"),
            ("Hugs Ben sometimes.", "somebody"),
            ("Opens the door for Ben.", "somebody"),
            ("Ada's Ben opens the fridge.", "nobody"),
            ("2 people are in the kitchen.", "somebody"),
        ] {
            assert_eq!(of(sentence), expected, "{sentence}");
        }
        for sentence in [
            "Perhaps Ada goes to bed.",
            "Maybe Ada goes to bed.",
            "I think Ada goes to bed.",
            "I think she goes to bed.",
            "The radio says: Ben opens the fridge.",
            "Everybody except Ben goes to bed.",
            "Probably, Ben opens the fridge.",
            "Tomorrow, Ben opens the fridge.",
        ] {
            assert_eq!(of(sentence), "nobody", "{sentence}");
        }
    }

    /// A last name stands right behind a first one and before the verb; a thing has none.
    #[test]
    fn a_thing_with_a_capital_is_no_person() {
        for (sentence, expected) in [
            ("Jörg Müßig opens the fridge.", "new jörg müßig"),
            ("Anna-Lena Weiß sits down.", "new anna-lena weiß"),
            ("Lena O'Neill opens the fridge.", "new lena o'neill"),
            ("Jonas Müller sits down.", "new jonas müller"),
            ("Frau Kraus opens the fridge.", "new frau kraus"),
            ("Marcus Aurelius opens the fridge.", "new marcus aurelius"),
            ("Igor, Petrova opens the fridge.", "somebody"),
            ("Front Door opens.", "somebody"),
            ("Back Door closes.", "somebody"),
            ("Solar Panel produces power.", "nobody"),
            ("Home Assistant restarts.", "nobody"),
            ("Baby Monitor turns on.", "nobody"),
            ("Electric Car arrives.", "nobody"),
            ("Pizza Delivery arrives.", "nobody"),
            ("Living Room lights up.", "nobody"),
            ("Smart TV turns on.", "nobody"),
            ("Apple TV plays a film.", "nobody"),
            ("Google Home plays music.", "nobody"),
            ("Kitchen Light turns on.", "nobody"),
            ("Bedroom Sensor detects motion.", "nobody"),
            ("Washing Machine finishes.", "nobody"),
            ("Robot Vacuum cleans the bedroom.", "nobody"),
            ("Fire Alarm rings.", "nobody"),
        ] {
            assert_eq!(of(sentence), expected, "{sentence}");
        }
    }

    #[test]
    fn somebody_has_no_name() {
        for sentence in [
            "They open the fridge.",
            "She goes to the bathroom.",
            "A woman sits down on the sofa.",
            "The person goes to the bathroom.",
            "An old man walks into the hall.",
            "Opens the fridge.",
            "Washes dishes at the sink.",
            "Peels carrots.",
            "Opens windows in the bedroom.",
            "Waters plants.",
            "Has drinks.",
            "Grabs drinks.",
            "Skis.",
            "Goes to bed and sleeps.",
            "Somebody sings.",
            "The oven is on.",
            "The fridge is open.",
            "The door opens.",
            "In the bathroom, she brushes her teeth.",
            "The light is off.",
            "walking to the sofa",
        ] {
            assert_eq!(of(sentence), "somebody", "{sentence}");
        }
    }

    #[test]
    fn things_animals_and_the_past_are_nobody() {
        for sentence in [
            "The robot vacuum drives into the bedroom.",
            "The vacuum is stuck in the laundry room.",
            "The washing machine beeps.",
            "The cat jumps onto the table.",
            "The heating turns on in the bedroom.",
            "Music is playing in the bedroom.",
            "It is raining.",
            "Igor's guitar is in the living room.",
            "Ada's phone rings on the table.",
            "The kids sit down at the table.",
            "The parents watch television in the living room.",
            "A man and a woman are cooking.",
            "Two people are sitting on a couch.",
            "Ada was in the bedroom.",
            "She had been in the bedroom all morning.",
            "If Ada cooks, the light goes on.",
            "Yesterday Ben sat on the sofa.",
            "Dishwasher beeps.",
            "Hello!",
            "Good morning!",
            "Hello Ada!",
            "Spotify starts playing.",
            "Person detected in the garden.",
            "Merry Christmas everybody.",
            "Roborock cleans the living room.",
            "Unless Nora is out, do not vacuum.",
            "Apparently Nora has left.",
            "Whenever Nora is out, do not vacuum.",
            "Alexa turns on the light.",
            "Doorbell rings.",
            "Sensor reports motion.",
            "Robot starts.",
            "Vacuum drives into the bedroom.",
            "Thermostat clicks.",
            "Ada does not sit on the sofa.",
            "Ada wants to go to the kitchen.",
            "Ada will go to the kitchen.",
            "Ada has just left the bathroom.",
            "Ada went to the kitchen yesterday.",
            "Is Ada in the kitchen?",
            "Everybody sings.",
            "\"Everybody leaves the house\", says the radio.",
        ] {
            assert_eq!(of(sentence), "nobody", "{sentence}");
        }
    }
}
