//! Names of persons: how two names compare, and the number of a name.

use crate::ids::PersonId;
use crate::names::Names;

/// Most bytes of a person's name; messages have as many.
pub const PERSON_NAME_BYTES_MAX: usize = 48;

/// A name in lower case, with single spaces, without "the" before it.
fn bare(name: &str) -> String {
    let name = name.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
    let without = name.strip_prefix("the ").map(str::trim_start).filter(|name| !name.is_empty());
    without.map(str::to_owned).unwrap_or(name)
}

/// A name by its letters and digits alone, without accents: "lena o neill" of "Lena O'Neill" and of "lena_o_neill". An owner stays one: "ada's" is
/// not "Ada S.".
fn spaced(name: &str) -> String {
    let owner = name.strip_suffix("'s").or_else(|| name.strip_suffix("’s"));
    owner.map_or_else(|| Names::bare(name), |owner| format!("{}'s", Names::bare(owner)))
}

/// The words of a text as names are compared: "ben", "hugs" and "zoe" of "Ben hugs Zoë's".
#[must_use]
pub fn name_words(text: &str) -> Vec<String> {
    let word = |said: &str| {
        let word = said.trim_matches(|c: char| !c.is_alphanumeric());
        let owner = word.strip_suffix("'s").or_else(|| word.strip_suffix("’s"));
        Names::bare(owner.unwrap_or(word))
    };
    let bare = text.split_whitespace().map(word).collect::<Vec<_>>().join(" ");
    bare.split(' ').filter(|word| !word.is_empty()).map(str::to_owned).collect()
}

/// Whether two names are one: without regard to case, to space more than needed, and to "the" before them.
#[must_use]
pub fn same_name(a: &str, b: &str) -> bool {
    bare(a) == bare(b)
}

/// A name as the daemon compares it with others; it reads each name once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadName {
    whole: String,
    number: PersonId,
    bare: String,
    first: Option<String>,
}

impl ReadName {
    /// Reads a name.
    #[must_use]
    pub fn new(name: &str) -> Self {
        const TITLES: [&str; 7] = ["dr", "mr", "mrs", "ms", "miss", "prof", "sir"];
        let whole = bare(name);
        let bare_name = spaced(&whole);
        // "Night falls." is not about the night nurse.
        let has_article = name.trim_start().to_lowercase().starts_with("the ");
        let first = bare_name.split_once(' ').map(|(first, _)| first);
        let first = first.filter(|first| !TITLES.contains(first) && !has_article);
        Self { whole, number: person_number(name), first: first.map(str::to_owned), bare: bare_name }
    }

    /// The name in lower case. Two names with the same one are one name.
    #[must_use]
    pub fn whole(&self) -> &str {
        &self.whole
    }

    /// The number of the name ([`person_number`]).
    #[must_use]
    pub fn number(&self) -> PersonId {
        self.number
    }

    /// Its letters and digits, without accents.
    #[must_use]
    pub fn letters(&self) -> &str {
        &self.bare
    }

    /// The first of several words: "ada" of "Ada Lovelace". `None` for a name of one word, and for a title or "the".
    #[must_use]
    pub fn first(&self) -> Option<&str> {
        self.first.as_deref()
    }

    /// Whether both names have the same letters and digits without accents: "Zoe" and "Zoë", "anne marie" and "Anne-Marie".
    #[must_use]
    pub fn may_be_one(&self, other: &Self) -> bool {
        self.bare == other.bare
    }
}

/// Whether two names are one, without regard to accents and signs: "Zoë" and "Zoe", "O'Neill" and "o_neill".
#[must_use]
pub fn same_but_for_accents(a: &str, b: &str) -> bool {
    same_name(a, b) || spaced(a) == spaced(b)
}

/// The number of a name, the same in every process and over restarts, unless the home says otherwise: 32-bit FNV-1a of the trimmed name in
/// lower case without "the" before it, with the highest bit set, so that it is none of the small numbers that narrators give by hand. Never [`PersonId::SOMEBODY`].
///
/// ```
/// use roomcast_core::ids::PersonId;
/// use roomcast_core::narration::person_number;
///
/// assert_eq!(person_number("Ada"), person_number(" ada "));
/// assert_ne!(person_number("ada"), person_number("ben"));
/// assert!(person_number("ada").0 >> 31 == 1 && person_number("ada") != PersonId::SOMEBODY);
/// ```
#[must_use]
pub fn person_number(name: &str) -> PersonId {
    let mut hash = 0x811c_9dc5_u32;
    for byte in bare(name).bytes() {
        hash = (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193);
    }
    PersonId((hash | 1 << 31).min(PersonId::SOMEBODY.0 - 1))
}

/// Words that stand for any person.
const NO_NAMES: &str = "nobody|me|who|they|he|she|i|we|you|somebody|someone|everybody|everyone|all|the whole family|the entire family|\
                        the whole household|they all|we all|all of them|all of us";

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
        let most = PersonId::SOMEBODY.0 - 1;
        return Err(format!("{shown:?} is a number: give a name with a letter, or a person's number from 0 to {most}"));
    }
    let lower = name.to_lowercase();
    if NO_NAMES.split('|').any(|word| word == lower) {
        return Err(format!("{shown:?} is no name of one person: give a name, or none where nobody is named"));
    }
    super::check_control(name, &format!("{shown:?}"), |_| false).map_err(|fault| fault.0)?;
    if name.len() > PERSON_NAME_BYTES_MAX || !name.contains(char::is_alphanumeric) {
        return Err(format!("{shown:?} is no name: give at most {PERSON_NAME_BYTES_MAX} bytes with a letter or digit"));
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
    use super::super::line::Who;
    use super::*;

    #[test]
    fn a_number_in_any_digits_is_no_name() {
        for number in ["7", "-3", "٣"] {
            check_name(number).unwrap_err();
        }
        check_name("R2").unwrap();
        assert_eq!("007".parse(), Ok(Who::Number(PersonId(7))));
        for none in ["-3", "٣", "4294967295", "99999999999", ""] {
            none.parse::<Who>().unwrap_err();
        }
    }

    /// Home Assistant calls "Lena O'Neill" `person.lena_o_neill`.
    #[test]
    fn names_with_the_same_letters_are_one() {
        let is_one = |one: &str, other: &str| ReadName::new(one).may_be_one(&ReadName::new(other));
        for (name, said) in [
            ("Lena O'Neill", "lena o neill"),
            ("Lena O’Neill", "Lena O'Neill"),
            ("Anne-Marie", "anne marie"),
            ("Jean Luc", "jean_luc"),
            ("Jörg Müßig", "jorg_mussig"),
        ] {
            assert!(is_one(name, said) && same_but_for_accents(name, said), "{name} {said}");
        }
        for (name, other) in [("Ada S.", "ada's"), ("Anne-Marie", "annemarie"), ("Anne-Marie", "anne"), ("Li", "Lia")] {
            assert!(!is_one(name, other) && !same_but_for_accents(name, other), "{name} {other}");
        }
        assert_eq!(ReadName::new("Ada Lovelace").first(), Some("ada"));
        assert!(is_one("The plumber", "plumber"), "\"the\" is no first name");
        assert_eq!((ReadName::new("The Plumber").first(), ReadName::new("the night nurse").first()), (None, None));
        assert_eq!((ReadName::new("Mrs. Novak").first(), ReadName::new("Ada").first()), (None, None));
    }

    #[test]
    fn words_of_a_text_compare_as_names_do() {
        for (text, words) in [
            ("Ben takes Zoë's cup", "ben takes zoe cup"),
            ("hugs lena_o_neill.", "hugs lena o neill"),
            ("Lena O’Neill, Ana-Maria", "lena o neill ana maria"),
        ] {
            assert_eq!(name_words(text).join(" "), words, "{text}");
        }
    }

    /// Journals and narrators rely on it.
    #[test]
    fn a_names_number_stays_what_it_is() {
        assert_eq!(person_number("ada"), PersonId(0xb839_0dbb));
        assert!(same_name(" Ada", "ada") && same_name("Éva", "éva") && !same_name("ada", "adam"));
        assert_eq!(person_number("Ada  Lovelace"), person_number("ada lovelace"));
        assert!(same_name("the plumber", "Plumber") && same_name("ΝΊΚΟΣ", "Νίκος") && !same_name("the", ""));
    }
}
