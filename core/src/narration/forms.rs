//! The twelve sentences that set presence, for people who type and for the `say` of rules. A form is the whole text: case does not
//! matter, a full stop is optional, and nothing may stand before, behind or between. Any other sentence is an action.

use super::event::{Event, RoomName};
use crate::text::has_words;

/// The subject of a form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Subject {
    /// A name that the home knows, in lower case.
    Named(String),
    /// "They", "he", "she" or "somebody".
    Unknown,
    /// The house or a room: no single person.
    House,
}

/// A form as the manual shows it, and its event in words.
#[derive(Debug, Clone, Copy)]
pub struct Form {
    /// The sentence, with NAME and ROOM.
    pub sentence: &'static str,
    /// The event.
    pub event: &'static str,
    kind: Kind,
    /// The words behind "they".
    they: &'static str,
    /// Words of sentences that resemble this form.
    near: &'static str,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Away,
    Present,
    PresentIn,
    AllAway,
    Empty,
    Gone,
}

const fn form(s: &'static str, event: &'static str, kind: Kind, they: &'static str, near: &'static str) -> Form {
    Form { sentence: s, event, kind, they, near }
}

const AWAY: &str = "NAME is away";
const PRESENT: &str = "NAME is present";
const ALL_AWAY: &str = "each present person and each resident is away";
const EMPTY: &str = "the room is empty";

/// All forms. The manual's table is generated from this list.
pub const FORMS: [Form; 12] = [
    form("NAME leaves the house", AWAY, Kind::Away, "leave the house", "leaves|leave|left"),
    form("NAME goes out", AWAY, Kind::Away, "go out", "goes out|went out"),
    form("NAME is away", AWAY, Kind::Away, "are away", "is away|is at work|is at school|is out|is not home|is gone"),
    form("NAME comes home", PRESENT, Kind::Present, "come home", "comes home|came home|arrives"),
    form("NAME is home", PRESENT, Kind::Present, "are home", "is home|is at home"),
    form("NAME is back", PRESENT, Kind::Present, "are back", "is back|returns"),
    form("NAME is in the ROOM", "NAME is present in the room", Kind::PresentIn, "are in the ROOM", "is in the"),
    form(
        "Everybody leaves the house",
        ALL_AWAY,
        Kind::AllAway,
        "",
        "everyone leaves|everyone left|everyone is gone|everyone is out|everyone is away|everybody left|everybody is gone|everybody is out|everybody is away",
    ),
    form(
        "Nobody is home",
        ALL_AWAY,
        Kind::AllAway,
        "",
        "no one is home|no one is at home|nobody is at home|nobody's home|house is empty",
    ),
    form(
        "Nobody is in the ROOM",
        EMPTY,
        Kind::Empty,
        "",
        "nobody in the|no one in the|no one is in the|no people in the",
    ),
    form("The ROOM is empty", EMPTY, Kind::Empty, "", "an empty"),
    form("NAME leaves for good", "NAME is gone", Kind::Gone, "leave for good", "leaves for good"),
];

/// Whether a text may be a form at all. Nearly all texts are none, and this allocates nothing.
fn may_be_form(text: &str) -> bool {
    const LAST: [&str; 7] = ["house", "out", "away", "home", "back", "good", "empty"];
    let last = text.rsplit(' ').next().unwrap_or_default();
    LAST.iter().any(|word| word.eq_ignore_ascii_case(last))
        || text.as_bytes().windows(8).any(|bytes| bytes.eq_ignore_ascii_case(b" in the "))
}

/// Reads a text that is a form. `is_name` knows the names of the home; `is_room` knows the rooms of the map.
pub fn read(
    text: &str,
    is_name: impl Fn(&str) -> bool,
    is_room: impl Fn(&str) -> bool,
) -> Option<(&'static Form, Subject, Event)> {
    let text = text.trim();
    let text = text.strip_suffix('.').unwrap_or(text).trim_end();
    if !may_be_form(text) {
        return None;
    }
    let lower = text.to_lowercase();
    let is_they = lower.starts_with("they ");
    FORMS.iter().find_map(|form| {
        let words = if is_they && !form.they.is_empty() { form.they } else { form.sentence }.to_lowercase();
        let words = words.trim_start_matches("name ");
        let (verb, rest) = words.split_once("room").unwrap_or((words, ""));
        let behind_name = || lower.strip_suffix(verb)?.strip_suffix(' ');
        let (name, room) = match form.kind {
            Kind::AllAway => (lower == words).then_some(("", None))?,
            Kind::Empty => ("", Some(lower.strip_prefix(verb)?.strip_suffix(rest)?)),
            Kind::PresentIn => lower.split_once(&format!(" {verb}")).map(|(name, room)| (name, Some(room)))?,
            _ => (behind_name()?, None),
        };
        let subject = match name {
            "" if matches!(form.kind, Kind::AllAway | Kind::Empty) => Subject::House,
            "they" | "he" | "she" | "somebody" => Subject::Unknown,
            name => is_name(name).then(|| Subject::Named(name.to_owned()))?,
        };
        // A question is no form.
        let is_plain =
            |room: &str| room.chars().all(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '\'' | '’' | '_'));
        let room = room.map(|room| (is_plain(room) && is_room(room)).then(|| RoomName::new(room).ok()).flatten());
        let event = match form.kind {
            Kind::Away => Event::Away,
            Kind::Gone => Event::Gone,
            Kind::AllAway => Event::AllAway,
            Kind::Empty => Event::Empty(room??),
            Kind::PresentIn => Event::Present(Some(room??)),
            Kind::Present => Event::Present(None),
        };
        Some((form, subject, event))
    })
}

/// The form of a text for any name and any room, as the manual shows it.
#[must_use]
pub fn form_of(text: &str) -> Option<&'static str> {
    read(text, |name| super::check_name(name).is_ok(), |_| true).map(|(form, ..)| form.sentence)
}

/// The nearest form of a short text that speaks of presence and is no form: "Ada leaves." is near "NAME leaves the house".
#[must_use]
pub fn near_miss(text: &str) -> Option<&'static Form> {
    const WORDS_MAX: usize = 6;
    const KEYS: [&str; 14] = [
        "leaves", "leave", "left", "out", "is", "isn't", "comes", "came", "arrives", "returns", "nobody", "nobody's",
        "no", "empty",
    ];
    // Nearly all texts are near no form.
    let is_key = |word: &str| KEYS.iter().any(|key| word.eq_ignore_ascii_case(key));
    let mut words = text.split_whitespace().map(|word| word.trim_end_matches(['.', '!']));
    if words.clone().count() > WORDS_MAX || !words.any(is_key) {
        return None;
    }
    let says = |words: &str| words.split('|').filter(|words| has_words(text, &[words])).map(str::len).max();
    // "They leave the kitchen." speaks of a room.
    if says("leave the|leaves the|left the|out of the").is_some()
        && says("house|home|building|flat|apartment").is_none()
    {
        return None;
    }
    let near = |form: &'static Form| Some((form, says(form.near)?));
    let of_house = |form: &&Form| matches!(form.kind, Kind::AllAway | Kind::Empty);
    let nearest = |is_of_house: bool| {
        FORMS
            .iter()
            .filter(move |form| of_house(form) == is_of_house)
            .filter_map(near)
            .max_by_key(|(_, letters)| *letters)
    };
    // "Everybody is back." is about no single person.
    let is_single = says("everyone|everybody|nobody|nobody's|no one|no people").is_none();
    nearest(true).or_else(|| nearest(false).filter(|_| is_single)).map(|(form, _)| form)
}

/// Whether a text reports an absence: "There is no one in the kitchen.", "an empty kitchen", "Ada is not home."
/// Such a text is about no person. `is_room` knows the rooms of the map.
pub fn says_nobody(text: &str, is_room: impl Fn(&str) -> bool) -> bool {
    const NOBODY: &str =
        "nobody|nobody's|no one|no-one|noone|no people|no person|no persons|no humans|no human|not anyone|not anybody";
    const NOT: &str = "is not|are not|isn't|aren't|was not|wasn't";
    const THERE: [&str; 6] = ["home", "at", "in", "here", "there", "inside"];
    const HOUSE: [&str; 6] = ["house", "home", "room", "flat", "apartment", "building"];
    const SEEMS: [&str; 7] = ["is", "looks", "appears", "seems", "be", "now", "completely"];
    // Nearly all texts have no word that begins so; this allocates nothing.
    const MARKS: [&str; 5] = ["no", "empty", "isn", "aren", "wasn"];
    let begins = |word: &str, mark: &str| word.get(..mark.len()).is_some_and(|own| own.eq_ignore_ascii_case(mark));
    let is_between = |c: char| !(c.is_alphanumeric() || matches!(c, '\'' | '’' | '-'));
    let words = || text.split(is_between).filter(|word| !word.is_empty());
    if !words().any(|word| MARKS.iter().any(|mark| begins(word, mark))) {
        return false;
    }
    let words = words().collect::<Vec<_>>().join(" ").replace('’', "'").to_lowercase();
    if NOBODY.split('|').any(|none| has_words(&words, &[none])) {
        return true;
    }
    let says_not = |not: &str| {
        let found = words.find(not).map(|at| words[at + not.len()..].trim_start());
        has_words(&words, &[not])
            && found.is_some_and(|rest| THERE.contains(&rest.split(' ').next().unwrap_or_default()))
    };
    let is_place = |name: &str| HOUSE.contains(&name) || is_room(name);
    let words: Vec<&str> = words.split(' ').collect();
    let empty = words.iter().position(|word| *word == "empty");
    let is_empty = empty.is_some_and(|at| {
        let ahead =
            (1..=3).any(|length| words.get(at + 1..at + 1 + length).is_some_and(|name| is_place(&name.join(" "))));
        let is_verb = at > 0 && ["they", "he", "she", "to", "and"].contains(&words[at - 1]);
        let start = (0..at).rev().take_while(|before| SEEMS.contains(&words[*before])).last();
        let behind = start.is_some_and(|start| {
            (1..=3).any(|length| start >= length && is_place(&words[start - length..start].join(" ")))
        });
        ahead && !is_verb || behind
    });
    is_empty || NOT.split('|').any(says_not)
}

/// Most persons that one event may count.
pub const COUNT_MAX: u8 = 8;

/// The number of persons that a text counts: a number word or "a couple" before a word for persons. `None` where it counts no persons.
#[must_use]
pub fn count_of_persons(text: &str) -> Option<u8> {
    const NUMBERS: [&str; 7] = ["two", "three", "four", "five", "six", "seven", "eight"];
    const PERSONS: [&str; 11] =
        ["people", "persons", "men", "women", "adults", "children", "kids", "boys", "girls", "residents", "visitors"];
    let mut words = text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty()).peekable();
    let (mut count, mut since, mut before) = (None, 0, "");
    while let Some(word) = words.next() {
        let is = |name: &str| word.eq_ignore_ascii_case(name);
        // "A couple is sitting", "a couple of people", and not "a couple of plates".
        let is_couple_of = is("couple") && words.peek().is_some_and(|next| next.eq_ignore_ascii_case("of"));
        if is("couple") && !is_couple_of && ["a", "the"].iter().any(|article| before.eq_ignore_ascii_case(article)) {
            return Some(2);
        }
        let number = (2..=COUNT_MAX).zip(NUMBERS).find(|(number, name)| is(name) || word.parse() == Ok(*number));
        let two = (is_couple_of || is("both")).then_some(2);
        if let Some(number) = number.map(|(number, _)| number).or(two) {
            (count, since) = (Some(number), 0);
        } else if since > 2 || !PERSONS.iter().any(|name| is(name)) {
            since += 1;
        } else if count.is_some() {
            return count;
        }
        before = word;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::super::same_name;
    use super::*;

    fn read_as(text: &str) -> String {
        let is_name = |name: &str| ["ada", "ben müller", "İda"].iter().any(|known| same_name(known, name));
        let is_room = |room: &str| ["kitchen", "nurse station"].contains(&room);
        match read(text, is_name, is_room) {
            Some((_, Subject::Named(name), event)) => format!("{name}: {event}"),
            Some((_, Subject::Unknown, event)) => format!("?: {event}"),
            Some((_, Subject::House, event)) => event.to_string(),
            None => String::new(),
        }
    }

    #[test]
    fn each_form_is_its_event() {
        const EVENTS: &str = "Ada leaves the house. = ada: away|ADA LEAVES THE HOUSE = ada: away|\
            Ben Müller goes out = ben müller: away|İda is away. = i̇da: away|They leave the house. = ?: away|\
            she is away = ?: away|Somebody comes home. = ?: present|Ada is home. = ada: present|They are back. = ?: present|\
            Ada is in the nurse station. = ada: present in the nurse station|They are in the kitchen = ?: present in the kitchen|\
            Everybody leaves the house. = everybody away|nobody is home = everybody away|\
            Nobody is in the Kitchen. = nobody in the kitchen|The kitchen is empty. = nobody in the kitchen|\
            Ada leaves for good. = ada: gone";
        for (text, event) in EVENTS.split('|').map(|row| row.split_once(" = ").unwrap()) {
            assert_eq!(read_as(text), event, "{text}");
        }
    }

    #[test]
    fn any_other_text_is_no_form() {
        const TEXTS: &str = "Ada leaves.|Ada leaves the house now.|Now Ada leaves the house.|Ada leaves the house key at home.|\
            Ada is away in the kitchen.|Ada says that Ben is home.|Carl leaves the house.|Ada walks to the nurse station.|\
            Ada is in the pharmacy.|The fridge is empty.|The TV says: \"Everybody leaves the house.\"|\
            Hello. Everybody leaves the house. Bye.|A poster reads: Everybody leaves the house.|On TV, everybody leaves the house.|\
            Subtitle: Nobody is home.|Ada reads \"Ada leaves the house.\"|An elderly woman walks out of the front door.|\
            Everybody leaves the building.|the lamp is on. Everybody leaves the house.|Everybody leaves the house!!|\
            Ada  leaves the building|They is away|Nobody is in the kitchen?|The kitchen, is empty|Nobody is in the (kitchen)|leaves the house|is in the kitchen||.";
        for text in TEXTS.split('|') {
            assert_eq!(read_as(text), "", "{text}");
        }
    }

    #[test]
    fn a_form_is_one_for_any_name_and_room() {
        assert_eq!(form_of("Zoë leaves the house."), Some("NAME leaves the house"));
        assert_eq!(form_of("value is in the attic"), Some("NAME is in the ROOM"));
        assert_eq!(form_of("The attic is empty."), Some("The ROOM is empty"));
        assert_eq!(form_of("everybody leaves the house"), Some("Everybody leaves the house"));
        assert_eq!(form_of("They open the fridge."), None);
    }

    #[test]
    fn near_misses_name_the_nearest_form() {
        const NEAR: &str = "Ada leaves. = NAME leaves the house|Carl leaves the house. = NAME leaves the house|\
            Ben left the building. = NAME leaves the house|Ada is at work. = NAME is away|Ada is at home. = NAME is home|\
            No one is home. = Nobody is home|Nobody is at home. = Nobody is home|Everybody is home. = |Everyone is back. = |\
            Everybody is in the kitchen. = |She is at the sink. = |When the music stops, everyone sits. = |\
            There is nobody in the kitchen. = Nobody is in the ROOM|The house is empty. = Nobody is home|Ada is gone. = NAME is away|\
            Carl goes out! = NAME goes out|Carl is back = NAME is back|Carl leaves for good. = NAME leaves for good|\
            Everyone is gone. = Everybody leaves the house|Everyone leaves the house = Everybody leaves the house|\
            Ada is in the pharmacy. = NAME is in the ROOM|They open the fridge. = |They leave the kitchen. = |\
            Ada goes out of the hall. = |A man leaves the mug on the table in the hall. = | = ";
        for (text, form) in NEAR.split('|').map(|row| row.split_once(" = ").unwrap()) {
            assert_eq!(near_miss(text).map_or("", |form| form.sentence), form, "{text}");
        }
    }

    #[test]
    fn texts_about_nobody_are_told_from_actions() {
        let is_room = |room: &str| ["kitchen", "living room"].contains(&room);
        const NOBODY: &str = "There is nobody in the kitchen.|The image shows an empty kitchen.|No people are visible in the kitchen.|\
            No one is visible.|Nobody is at home.|The house is empty.|Ada is not home.|Ada isn’t at home.|The kitchen appears empty.|\
            A photo of an empty living room.|The living room is now empty.";
        const SOMEBODY: &str = "They empty the dishwasher.|The fridge is empty.|A man holds an empty glass in the kitchen.|They turn on no light.|\
            She empties the kitchen bin.|It is not clear what the man does.|They sit in the kitchen.|They empty kitchen cupboards.";
        for (texts, is_so) in [(NOBODY, true), (SOMEBODY, false)] {
            texts.split('|').for_each(|text| assert_eq!(says_nobody(text, is_room), is_so, "{text}"));
        }
    }

    #[test]
    fn number_words_before_person_words_count() {
        const COUNTS: &str = "Two people are in the kitchen. = 2|There are three young men here. = 3|\
            A couple is sitting on the sofa. = 2|A couple of people talk. = 2|a couple of plates = 0|\
            They put two plates on the table. = 0|They watch 3 films = 0|The children sleep. = 0";
        for (text, count) in COUNTS.split('|').map(|row| row.split_once(" = ").unwrap()) {
            assert_eq!(count_of_persons(text).unwrap_or(0).to_string(), count, "{text}");
        }
    }

    #[test]
    fn the_manual_has_the_table_of_forms() {
        let row = |form: &Form| format!("| {} | {} |\n", form.sentence, form.event);
        let rows: String = FORMS.iter().map(row).collect();
        let table = format!("| the whole text | event |\n| --- | --- |\n{rows}");
        let manual = include_str!("../../../docs/persons.md");
        assert!(manual.contains(&table), "put this into docs/persons.md:\n{table}");
    }
}
