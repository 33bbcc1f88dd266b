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
#[non_exhaustive]
pub struct ReadName {
    /// The name as written.
    pub said: Box<str>,
    /// The name in lower case. Two names with the same one are one name.
    pub whole: String,
    /// The number of the name ([`person_number`]).
    pub number: PersonId,
    /// Its letters and digits, without accents.
    pub letters: String,
    /// The first of several words: "ada" of "Ada Lovelace". `None` for a name of one word, and for a title or "the".
    pub first: Option<String>,
}

impl ReadName {
    /// Reads a name.
    #[must_use]
    pub fn new(name: &str) -> Self {
        const TITLES: [&str; 7] = ["dr", "mr", "mrs", "ms", "miss", "prof", "sir"];
        let whole = bare(name);
        let letters = spaced(&whole);
        // "Night falls." is not about the night nurse.
        let has_article = name.trim_start().to_lowercase().starts_with("the ");
        let first = letters.split_once(' ').map(|(first, _)| first);
        let first = first.filter(|first| !TITLES.contains(first) && !has_article).map(str::to_owned);
        Self { said: name.into(), whole, number: person_number(name), letters, first }
    }

    /// Whether both names have the same letters and digits without accents: "Zoe" and "Zoë", "anne marie" and "Anne-Marie".
    #[must_use]
    pub fn may_be_one(&self, other: &Self) -> bool {
        self.letters == other.letters
    }
}

/// Whether two names are one, without regard to accents and signs: "Zoë" and "Zoe", "O'Neill" and "o_neill".
#[must_use]
pub fn same_but_for_accents(a: &str, b: &str) -> bool {
    ReadName::new(a).may_be_one(&ReadName::new(b))
}

/// The number of a name, the same in every process and over restarts, unless the home says otherwise: 32-bit FNV-1a of the trimmed name in
/// lower case without "the" before it, with the highest bit set, so that it is none of the small numbers that narrators give by hand. Never [`PersonId::SOMEBODY`].
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
        assert_eq!(["R2", "7", "-3", "٣"].map(|name| check_name(name).is_ok()), [true, false, false, false]);
        assert_eq!("007".parse(), Ok(Who::Number(PersonId(7))));
        assert!(["-3", "٣", "4294967295", "99999999999", ""].iter().all(|none| none.parse::<Who>().is_err()));
    }

    /// Home Assistant calls "Lena O'Neill" `person.lena_o_neill`.
    #[test]
    fn names_with_the_same_letters_are_one() {
        const ONE: &str = "Lena O'Neill = lena o neill|Lena O’Neill = Lena O'Neill|Anne-Marie = anne marie|\
            Jean Luc = jean_luc|Jörg Müßig = jorg_mussig|The plumber = plumber";
        const OTHER: &str = "Ada S. = ada's|Anne-Marie = annemarie|Anne-Marie = anne|Li = Lia";
        for (pairs, are_one) in [(ONE, true), (OTHER, false)] {
            for (name, other) in pairs.split('|').map(|pair| pair.split_once(" = ").unwrap()) {
                assert_eq!(same_but_for_accents(name, other), are_one, "{name} {other}");
            }
        }
        let first = |name: &str| ReadName::new(name).first;
        assert_eq!(first("Ada Lovelace").as_deref(), Some("ada"));
        assert_eq!(["The Plumber", "the night nurse", "Mrs. Novak", "Ada"].map(first), [const { None }; 4]);
    }

    /// Journals and narrators rely on it.
    #[test]
    fn a_names_number_stays_what_it_is() {
        assert_eq!([" Ada ", "ben"].map(person_number), [PersonId(0xb839_0dbb), PersonId(0xdaae_56aa)]);
        assert_eq!(person_number("Ada  Lovelace"), person_number("ada lovelace"));
        assert!(same_name(" Ada", "ada") && same_name("Éva", "éva") && !same_name("ada", "adam"));
        assert!(same_name("the plumber", "Plumber") && same_name("ΝΊΚΟΣ", "Νίκος") && !same_name("the", ""));
    }
}
