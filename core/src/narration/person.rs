//! Who is who: the number of a person who is known by name.

use crate::names::Names;

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

/// Whether two names are one: without regard to case, to space more than needed, and to "the" before them.
#[must_use]
pub fn same_name(a: &str, b: &str) -> bool {
    bare(a) == bare(b)
}

/// Whether two names are one, also without regard to accents: "Zoë" and "Zoe". Titles count: "Grandma Edith" may live with her namesake.
#[must_use]
pub fn same_but_for_accents(a: &str, b: &str) -> bool {
    same_name(a, b) || Names::bare(a) == Names::bare(b)
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

#[cfg(test)]
mod tests {
    use super::*;

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
