//! Who is who: the number of a person who is known by name, and what a person may be called.

use super::clause;
use crate::names::Names;
use crate::text::is_hidden;

/// Most bytes of a person's name; messages have as many.
pub const PERSON_NAME_BYTES_MAX: usize = 48;

/// The number of an observation that names nobody.
pub const SOMEBODY: u32 = u32::MAX;

/// What somebody is called by who is not named.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Pronoun {
    /// "He".
    He,
    /// "She".
    She,
}

/// A name without what does not count: case, more space than one between its words, and "the" before it.
fn bare(name: &str) -> String {
    let name = name.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
    let without = name.strip_prefix("the ").map(str::trim_start).filter(|name| !name.is_empty());
    without.map(str::to_owned).unwrap_or(name)
}

/// A name by its letters and digits alone, without accents: "lena o neill" of "Lena O'Neill" and of "lena_o_neill". What is somebody's stays so: "ada's" is
/// not "Ada S.".
fn spaced(name: &str) -> String {
    let owner = name.strip_suffix("'s").or_else(|| name.strip_suffix("’s"));
    owner.map_or_else(|| Names::bare(name), |owner| format!("{}'s", Names::bare(owner)))
}

/// A word of a text that may be part of a name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NameWord {
    /// As it is written, in lower case.
    pub said: String,
    /// By its letters and digits alone, without accents. Empty where a name ends: behind what is somebody's, and behind a comma or a full stop.
    pub bare: String,
}

/// The words of a text as names are compared: "ben", "hugs", "zoe" and "" of "Ben hugs Zoë's", and "lena", "o", "neill" of "lena_o_neill".
#[must_use]
pub fn name_words(text: &str) -> Vec<NameWord> {
    /// A full stop behind so few letters is that of a short form: "Dr. Grey".
    const SHORT_FORM: usize = 3;
    let mut words = Vec::new();
    for said in text.to_lowercase().split_whitespace() {
        let word = said.trim_matches(|c: char| !c.is_alphanumeric());
        let owner = word.strip_suffix("'s").or_else(|| word.strip_suffix("’s"));
        let word = owner.unwrap_or(word);
        let bare = Names::bare(word);
        for part in bare.split(' ').filter(|part| !part.is_empty()) {
            let is_whole = part.len() == bare.len();
            words.push(NameWord { said: if is_whole { word } else { part }.to_owned(), bare: part.to_owned() });
        }
        let ends =
            said.ends_with([',', ';', ':', '!', '?']) || said.ends_with('.') && word.chars().count() > SHORT_FORM;
        if owner.is_some() || ends {
            words.push(NameWord { said: String::new(), bare: String::new() });
        }
    }
    words
}

/// Whether two names are one: without regard to case, to space more than needed, and to "the" before them.
#[must_use]
pub fn same_name(a: &str, b: &str) -> bool {
    bare(a) == bare(b)
}

/// A name as it is compared with others, read once: who is known is looked up for every word of a sentence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadName {
    /// The whole of it, as [`same_name`] compares, and its number.
    whole: String,
    number: u32,
    /// Without its title: the same, and by its letters and digits alone, without accents.
    plain: String,
    bare: String,
    title: Option<String>,
    /// What somebody of this name may be called for short.
    first: Option<Box<ReadName>>,
}

impl ReadName {
    /// Reads a name.
    #[must_use]
    pub fn new(name: &str) -> Self {
        let (title, rest) = clause::titled(name);
        let title = title.map(|title| {
            let title = title.trim_end_matches('.').to_lowercase();
            if ["ms", "miss"].contains(&title.as_str()) { "mrs".to_owned() } else { title }
        });
        Self {
            whole: bare(name),
            number: person_number(name),
            plain: bare(rest),
            bare: spaced(rest),
            title,
            first: clause::first_name(name).map(|first| Box::new(Self::new(first))),
        }
    }

    /// The whole name as it is compared: names are one where this is.
    #[must_use]
    pub fn whole(&self) -> &str {
        &self.whole
    }

    /// The number that follows from the name ([`person_number`]).
    #[must_use]
    pub fn number(&self) -> u32 {
        self.number
    }

    /// What two names share that may be one person's: one of these is the same in both.
    #[must_use]
    pub fn shared(&self) -> [&str; 2] {
        [&self.plain, &self.bare]
    }

    /// The same of what somebody of this name may be called for short.
    #[must_use]
    pub fn shared_for_short(&self) -> Option<[&str; 2]> {
        self.first.as_deref().map(Self::shared)
    }

    /// Whether two names may be one person's: they are the same by their letters and digits, without accents, and their titles are, or one of them has
    /// none: "Zoe" is Zoë, "anne marie" is Anne-Marie, "Mrs. Novak" is Ms Novak and Novak, "Grandma Edith" is Edith.
    #[must_use]
    pub fn may_be_one(&self, other: &Self) -> bool {
        let has_title_of = self.title.as_ref().zip(other.title.as_ref()).is_none_or(|(own, other)| own == other);
        has_title_of && (self.plain == other.plain || self.bare == other.bare)
    }

    /// Whether a sentence that says `name` may mean somebody of this name: also by the first of several.
    #[must_use]
    pub fn may_be_called(&self, name: &Self) -> bool {
        self.may_be_one(name) || self.first.as_ref().is_some_and(|first| first.may_be_one(name))
    }
}

/// Whether two names are one, also without regard to accents and to what is no letter: "Zoë" and "Zoe", "O'Neill" and "o_neill". Titles count: "Grandma Edith" may live with her namesake.
#[must_use]
pub fn same_but_for_accents(a: &str, b: &str) -> bool {
    same_name(a, b) || spaced(a) == spaced(b)
}

/// The number of a name, the same in every process and over restarts, unless the home says otherwise: 32-bit FNV-1a of the trimmed name in
/// lower case without "the" before it, with the highest bit set, so that it is none of the small numbers that narrators give by hand. Never [`SOMEBODY`].
///
/// ```
/// use roomcast_core::narration::{SOMEBODY, person_number};
///
/// assert_eq!(person_number("Ada"), person_number(" ada "));
/// assert_ne!(person_number("ada"), person_number("ben"));
/// assert!(person_number("ada") >> 31 == 1 && person_number("ada") != SOMEBODY);
/// ```
#[must_use]
pub fn person_number(name: &str) -> u32 {
    let mut hash = 0x811c_9dc5_u32;
    for byte in bare(name).bytes() {
        hash = (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
    }
    (hash | 1 << 31).min(SOMEBODY - 1)
}

/// Whom a text names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Named<'a> {
    /// The person of this number.
    Number(u32),
    /// The person of this name.
    Name(&'a str),
}

impl<'a> Named<'a> {
    /// A text of digits alone is a person's number; any other is a name, which [`check_name`] judges.
    ///
    /// # Errors
    /// What is wrong with it, and what to do.
    ///
    /// ```
    /// use roomcast_core::narration::Named;
    ///
    /// assert_eq!(Named::parse(" 3"), Ok(Named::Number(3)));
    /// assert_eq!(Named::parse("Ada "), Ok(Named::Name("Ada")));
    /// assert!(Named::parse("-1").is_err() && Named::parse("me").is_err());
    /// ```
    pub fn parse(text: &'a str) -> Result<Self, String> {
        let text = text.trim();
        match text.parse() {
            Ok(number) if number != SOMEBODY && is_number(text) => Ok(Self::Number(number)),
            _ => check_name(text).map(|()| Self::Name(text)),
        }
    }
}

/// Whether a name can be a person's: it has letters or digits, fits into a message, hides nothing, and is no number.
///
/// # Errors
/// What is wrong with it, and what to do.
///
/// ```
/// use roomcast_core::narration::check_name;
///
/// assert!(check_name("Ada").is_ok() && check_name("12").is_err() && check_name("!").is_err());
/// ```
pub fn check_name(name: &str) -> Result<(), String> {
    let name = name.trim();
    let shown: String = name.chars().take(80).collect();
    if is_number(name) {
        return Err(format!("{shown:?} is a number: give a name with a letter"));
    }
    if ["nobody", "me", "who"].contains(&name.to_lowercase().as_str()) || super::Said::is_pronoun(name) {
        return Err(format!("{shown:?} is no name of one person: give a name, or none where nobody is named"));
    }
    if name.contains(is_hidden) || name.len() > PERSON_NAME_BYTES_MAX || !name.contains(char::is_alphanumeric) {
        return Err(format!(
            "{shown:?} is no name: give at most {PERSON_NAME_BYTES_MAX} bytes with a letter or digit and without control characters"
        ));
    }
    Ok(())
}

/// Whether a text is a number rather than a name, also one that no person has.
#[must_use]
pub fn is_number(text: &str) -> bool {
    let digits = text.trim_start_matches('-');
    !digits.is_empty() && digits.chars().all(char::is_numeric)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_in_any_digits_is_no_name() {
        for number in ["7", "-3", "٣"] {
            check_name(number).unwrap_err();
        }
        check_name("R2").unwrap();
        assert_eq!(Named::parse("007"), Ok(Named::Number(7)));
        for none in ["-3", "٣", "4294967295", "99999999999", ""] {
            Named::parse(none).unwrap_err();
        }
    }

    /// Home Assistant calls "Lena O'Neill" `person.lena_o_neill`.
    #[test]
    fn a_name_is_the_same_by_its_letters() {
        let is_one = |one: &str, other: &str| ReadName::new(one).may_be_one(&ReadName::new(other));
        for (name, said) in [
            ("Lena O'Neill", "lena o neill"),
            ("Lena O’Neill", "Lena O'Neill"),
            ("Anne-Marie", "anne marie"),
            ("Jean Luc", "jean_luc"),
            ("Jörg Müßig", "jorg_mussig"),
            ("Dr. Anne-Marie Weiß", "anne marie weiss"),
        ] {
            assert!(is_one(name, said) && same_but_for_accents(name.trim_start_matches("Dr. "), said), "{name} {said}");
        }
        for (name, other) in [("Ada S.", "ada's"), ("Anne-Marie", "annemarie"), ("Anne-Marie", "anne"), ("Li", "Lia")] {
            assert!(!is_one(name, other) && !same_but_for_accents(name, other), "{name} {other}");
        }
    }

    #[test]
    fn names_in_a_text_are_found_by_their_letters() {
        let bare = |text: &str| name_words(text).into_iter().map(|word| word.bare).collect::<Vec<_>>().join(" ");
        for (text, words) in [
            ("Ben takes Zoë's cup", "ben takes zoe  cup"),
            ("hugs lena_o_neill.", "hugs lena o neill "),
            ("Lena O’Neill, Ana-Maria", "lena o neill  ana maria"),
            ("Dr. Grey sits. Ada S. too", "dr grey sits  ada s too"),
        ] {
            assert_eq!(bare(text), words, "{text}");
        }
        assert_eq!(name_words("Zoë")[0].said, "zoë");
    }

    /// Journals and narrators rely on it.
    #[test]
    fn a_names_number_stays_what_it_is() {
        assert_eq!(person_number("ada"), 0xb839_0dbb);
        assert!(same_name(" Ada", "ada") && same_name("Éva", "éva") && !same_name("ada", "adam"));
        assert!(
            same_name("Ada  Lovelace", "ada lovelace")
                && person_number("Ada  Lovelace") == person_number("ada lovelace")
        );
        assert!(same_name("the plumber", "Plumber") && same_name("ΝΊΚΟΣ", "Νίκος") && !same_name("the", ""));
    }
}
