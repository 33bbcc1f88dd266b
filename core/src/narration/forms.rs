//! The twelve sentences that set presence, for people who type and for the `say` of rules. A form is the whole text: case does not
//! matter, a full stop is optional, and nothing may stand before, behind or between. Any other sentence is an action.

use super::event::{Event, RoomName};

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
    /// The words behind NAME for one person, and behind "they".
    verbs: (&'static str, &'static str),
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

const fn form(sentence: &'static str, event: &'static str, kind: Kind, one: &'static str, they: &'static str) -> Form {
    Form { sentence, event, kind, verbs: (one, they) }
}

/// All forms. The manual's table is generated from this list.
pub const FORMS: [Form; 12] = [
    form("NAME leaves the house", "NAME is away", Kind::Away, "leaves the house", "leave the house"),
    form("NAME goes out", "NAME is away", Kind::Away, "goes out", "go out"),
    form("NAME is away", "NAME is away", Kind::Away, "is away", "are away"),
    form("NAME comes home", "NAME is present", Kind::Present, "comes home", "come home"),
    form("NAME is home", "NAME is present", Kind::Present, "is home", "are home"),
    form("NAME is back", "NAME is present", Kind::Present, "is back", "are back"),
    form("NAME is in the ROOM", "NAME is present in the room", Kind::PresentIn, "is in the ", "are in the "),
    form("Everybody leaves the house", "each present person and each resident is away", Kind::AllAway, "", ""),
    form("Nobody is home", "each present person and each resident is away", Kind::AllAway, "", ""),
    form("Nobody is in the ROOM", "the room is empty", Kind::Empty, "nobody is in the ", ""),
    form("The ROOM is empty", "the room is empty", Kind::Empty, "the ", " is empty"),
    form("NAME leaves for good", "NAME is gone", Kind::Gone, "leaves for good", "leave for good"),
];

/// Words that stand for an unknown person.
const UNKNOWN: [&str; 4] = ["they", "he", "she", "somebody"];

/// Whether a text may be a form at all. Nearly all texts are none, and this allocates nothing.
fn may_be_form(text: &str) -> bool {
    const LAST: [&str; 7] = ["house", "out", "away", "home", "back", "good", "empty"];
    let last = text.rsplit(' ').next().unwrap_or_default();
    LAST.iter().any(|word| word.eq_ignore_ascii_case(last))
        || text.as_bytes().windows(8).any(|bytes| bytes.eq_ignore_ascii_case(b" in the "))
}

/// Reads a text that is a form. `is_name` knows the names of the home; `is_room` knows the rooms of the map.
pub fn read(text: &str, is_name: impl Fn(&str) -> bool, is_room: impl Fn(&str) -> bool) -> Option<(Subject, Event)> {
    matched(text, is_name, is_room).map(|(_, subject, event)| (subject, event))
}

fn matched(
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
    FORMS.iter().find_map(|form| {
        let (one, they) = form.verbs;
        match form.kind {
            Kind::AllAway => {
                return (lower == form.sentence.to_lowercase()).then_some((form, Subject::House, Event::AllAway));
            }
            Kind::Empty => {
                let room = lower.strip_prefix(one)?.strip_suffix(they)?;
                return is_room(room).then_some((form, Subject::House, Event::Empty(RoomName::new(room).ok()?)));
            }
            _ => {}
        }
        let verb = if lower.starts_with("they ") { they } else { one };
        let (name, room) = match form.kind {
            Kind::PresentIn => lower.split_once(&format!(" {verb}")).map(|(name, room)| (name, Some(room)))?,
            _ => (lower.strip_suffix(verb)?.strip_suffix(' ')?, None),
        };
        let is_unknown = UNKNOWN.contains(&name);
        if !is_unknown && !is_name(name) || room.is_some_and(|room| !is_room(room)) {
            return None;
        }
        let event = match form.kind {
            Kind::Away => Event::Away,
            Kind::Gone => Event::Gone,
            Kind::PresentIn => Event::Present(Some(RoomName::new(room?).ok()?)),
            _ => Event::Present(None),
        };
        let subject = if is_unknown { Subject::Unknown } else { Subject::Named(name.to_owned()) };
        Some((form, subject, event))
    })
}

/// The form of a text for any name and any room, as the manual shows it.
#[must_use]
pub fn form_of(text: &str) -> Option<&'static str> {
    matched(text, |name| super::check_name(name).is_ok(), |_| true).map(|(form, ..)| form.sentence)
}

/// Words of a sentence that speaks of presence without being a form, and the place of the nearest form.
const NEAR: [(&str, usize); 12] = [
    (" leaves ", 0),
    (" leave ", 0),
    (" left ", 0),
    (" went out ", 1),
    (" is at home ", 4),
    (" is out ", 2),
    (" is at ", 2),
    (" is not home ", 2),
    (" arrives ", 3),
    (" came home ", 3),
    (" returns ", 5),
    (" is in the ", 6),
];

/// The nearest form of a short text that speaks of presence and is no form: "Ada leaves." is near "NAME leaves the house".
#[must_use]
pub fn near_miss(text: &str) -> Option<&'static Form> {
    const WORDS_MAX: usize = 6;
    const HOMES: [&str; 5] = ["house", "home", "building", "flat", "apartment"];
    const KEYS: &str = "leaves leave left out is arrives home returns back good everyone everybody";
    let text = text.trim().trim_end_matches(['.', '!']);
    let mut words = text.split_whitespace();
    // Nearly all texts; these checks allocate nothing.
    let is_key = |word: &str| KEYS.split(' ').any(|key| key.eq_ignore_ascii_case(word));
    if words.clone().count() > WORDS_MAX || !words.any(is_key) {
        return None;
    }
    let lower = format!(" {} ", text.to_lowercase());
    if lower.starts_with(" everyone ") || lower.starts_with(" everybody ") {
        return FORMS.get(7);
    }
    let is_near = |words: &str| {
        let rest = lower.rfind(words).map(|at| &lower[at + words.len()..]);
        // "They leave the kitchen." speaks of a room.
        let is_of_room = |rest: &str| rest.starts_with("the ") && !HOMES.iter().any(|home| rest.contains(home));
        rest.is_some_and(|rest| !(words.starts_with(" le") && is_of_room(rest)))
    };
    let ends = |form: &&Form| {
        let before = lower.trim_end().strip_suffix(form.verbs.0);
        !form.verbs.0.is_empty() && before.is_some_and(|before| before.ends_with(' '))
    };
    let near = || FORMS.get(NEAR.iter().find(|(words, _)| is_near(words))?.1);
    FORMS.iter().find(ends).or_else(near)
}

/// The forms as a table for the manual.
#[must_use]
pub fn table() -> String {
    let row = |form: &Form| format!("| {} | {} |\n", form.sentence, form.event);
    let rows: String = FORMS.iter().map(row).collect();
    format!("| the whole text | event |\n| --- | --- |\n{rows}")
}

/// Most persons that one event may count.
pub const COUNT_MAX: u8 = 8;

/// The number of persons that a text counts: a number word or "a couple" before a word for persons. `None` where it counts no persons.
///
/// ```
/// use roomcast_core::narration::forms::count_of_persons;
///
/// assert_eq!(count_of_persons("Two people are in the kitchen."), Some(2));
/// assert_eq!(count_of_persons("They put two plates on the table."), None);
/// ```
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
            Some((Subject::Named(name), event)) => format!("{name}: {event}"),
            Some((Subject::Unknown, event)) => format!("?: {event}"),
            Some((Subject::House, event)) => event.to_string(),
            None => String::new(),
        }
    }

    #[test]
    fn each_form_is_its_event() {
        for (text, expected) in [
            ("Ada leaves the house.", "ada: away"),
            ("ADA LEAVES THE HOUSE", "ada: away"),
            ("Ben Müller goes out", "ben müller: away"),
            ("İda is away.", "i̇da: away"),
            ("They leave the house.", "?: away"),
            ("she is away", "?: away"),
            ("Somebody comes home.", "?: present"),
            ("Ada is home.", "ada: present"),
            ("They are back.", "?: present"),
            ("Ada is in the nurse station.", "ada: present in the nurse station"),
            ("They are in the kitchen", "?: present in the kitchen"),
            ("Everybody leaves the house.", "everybody away"),
            ("nobody is home", "everybody away"),
            ("Nobody is in the Kitchen.", "nobody in the kitchen"),
            ("The kitchen is empty.", "nobody in the kitchen"),
            ("Ada leaves for good.", "ada: gone"),
        ] {
            assert_eq!(read_as(text), expected, "{text}");
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
            Ada  leaves the building|They is away|leaves the house|is in the kitchen||.";
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
        for (text, form) in [
            ("Ada leaves.", "NAME leaves the house"),
            ("Ada is at work.", "NAME is away"),
            ("Ada is at home.", "NAME is home"),
            ("Carl leaves the house.", "NAME leaves the house"),
            ("Ben left the building.", "NAME leaves the house"),
            ("Everyone is gone.", "Everybody leaves the house"),
            ("Ada is in the pharmacy.", "NAME is in the ROOM"),
        ] {
            assert_eq!(near_miss(text).map(|form| form.sentence), Some(form), "{text}");
        }
        for text in
            ["They open the fridge.", "They leave the kitchen.", "A man leaves the mug on the table in the hall.", ""]
        {
            assert!(near_miss(text).is_none(), "{text}");
        }
    }

    #[test]
    fn number_words_before_person_words_count() {
        for (text, count) in [
            ("Two people are in the kitchen.", Some(2)),
            ("There are three young men here.", Some(3)),
            ("A couple is sitting on the sofa.", Some(2)),
            ("A couple of people talk.", Some(2)),
            ("a couple of plates", None),
            ("They put two plates on the table.", None),
            ("They watch 3 films", None),
            ("The children sleep.", None),
        ] {
            assert_eq!(count_of_persons(text), count, "{text}");
        }
    }

    #[test]
    fn the_manual_has_the_table_of_forms() {
        let manual = include_str!("../../../docs/persons.md");
        assert!(manual.contains(&table()), "put this into docs/persons.md:\n{}", table());
    }
}
