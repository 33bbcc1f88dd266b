//! What a person is called beside all others who are known: whose a name is that stands in a text.

use std::collections::BTreeSet;

use roomcast_core::narration::{NameWord, Said, is_number, name_words, person_number};

use super::super::persons_file::KeptPerson;
use super::Persons;

/// Names that narrators gave before the home gave another one have at most so many words, where only their number is known.
const FORMER_WORDS: usize = 3;

/// One person among all who were known at a time; names are read as narration reads them.
#[derive(Debug)]
pub(in super::super) struct Called {
    person: u32,
    persons: Persons,
    /// All that they are called, also by whoever asks.
    names: Vec<String>,
    /// What they and those are called who share a word of a name with them, by letters and digits alone.
    spelled: BTreeSet<String>,
    /// What each of these begins with.
    begins: BTreeSet<String>,
    /// Words of the longest of these.
    words_max: usize,
    /// Their number is that of a name which nobody knows any more: any word may be it.
    has_unknown_name: bool,
}

impl Called {
    /// A person by their number, whom somebody calls `who`.
    pub(in super::super) fn new(persons: &Persons, person: u32, who: &str) -> Self {
        let mut names = persons.names_of(person);
        names.extend(Some(who.trim().to_lowercase()).filter(|who| !is_number(who)));
        let own: BTreeSet<String> = names.iter().flat_map(|name| name_words(name)).map(|word| word.bare).collect();
        let kept = persons.file.persons().iter().flat_map(KeptPerson::names);
        let told = persons.known.values().filter_map(|known| Some(&*known.name.as_ref()?.said));
        let listed = persons.config.residents.iter().map(String::as_str);
        let mut spelled = BTreeSet::<String>::new();
        for name in kept.chain(told).chain(listed).chain(names.iter().map(String::as_str)) {
            let shorter = [Said::without_title(name), Said::first_name(name).unwrap_or(name)];
            spelled.extend([name].into_iter().chain(shorter).map(bare));
        }
        // As names are compared, "the" before one counts for nothing.
        let bare_of_the = |name: &String| name.strip_prefix("the ").map(str::to_owned);
        let without: Vec<String> = spelled.iter().filter_map(bare_of_the).collect();
        spelled.extend(without);
        let is_near = |name: &String| name.split(' ').any(|word| !word.is_empty() && own.contains(word));
        spelled.retain(is_near);
        let begins = spelled.iter().filter_map(|name| name.split(' ').next()).map(str::to_owned).collect();
        let words_max = spelled.iter().map(|name| name.split(' ').count()).max().unwrap_or_default().max(FORMER_WORDS);
        let has_unknown_name = !names.iter().any(|name| person_number(name) == person);
        Self { person, persons: persons.clone(), names, spelled, begins, words_max, has_unknown_name }
    }

    /// Whether a name is theirs in a sentence: whoever is known goes by it as narration has it, and it may be a name of who is known no more.
    pub(in super::super) fn is(&self, name: &str) -> bool {
        let short = self.persons.known_for_short(name).unwrap_or(name);
        if self.persons.is_called(short) {
            return self.persons.called(short) == Some(self.person);
        }
        let is_own = |name: &str| {
            self.persons.number_of(name) == self.person || self.names.iter().any(|own| Said::may_mean(own, name))
        };
        // "Jonas Müller" is Jonas, where nobody else has that name.
        is_own(name) || Said::first_name(name).is_some_and(is_own)
    }

    /// Whether a narrator that gives an observation this name means them.
    pub(in super::super) fn is_key(&self, name: &str) -> bool {
        self.persons.number_of(name) == self.person
            || !self.persons.is_name_known(name) && self.names.iter().any(|own| Said::may_be_one(own, name))
    }

    /// Whether a text names them, also as whose something is. A longer name of somebody else holds none of theirs: "Anna Maria" does not name Anna.
    pub(in super::super) fn is_in(&self, text: &str) -> bool {
        let words = name_words(text);
        let mut at = 0;
        while at < words.len() {
            let longest = self.words_max.min(words.len() - at);
            // A journal has millions of words, and nearly all of them begin no name.
            let may_begin = self.has_unknown_name || self.begins.contains(&words[at].bare);
            let mut counts = (1..=longest).rev().filter(|_| may_begin);
            match counts.find(|count| self.is_name(&words[at..at + count])) {
                Some(count) if self.is(&joined(&words[at..at + count], |word| &word.said)) => return true,
                Some(count) => at += count,
                None => at += 1,
            }
        }
        false
    }

    /// Whether these words are a name of theirs, or of somebody who shares a word of one.
    fn is_name(&self, words: &[NameWord]) -> bool {
        let is_theirs = || person_number(&joined(words, |word| &word.said)) == self.person;
        self.spelled.contains(&joined(words, |word| &word.bare))
            || self.has_unknown_name && words.len() <= FORMER_WORDS && is_theirs()
    }
}

fn joined(words: &[NameWord], of: impl Fn(&NameWord) -> &str) -> String {
    words.iter().map(of).collect::<Vec<_>>().join(" ")
}

/// A name as it stands among the words of a text.
fn bare(name: &str) -> String {
    let words: Vec<String> = name_words(name).into_iter().map(|word| word.bare).collect();
    words.join(" ").trim_end().to_owned()
}

#[cfg(test)]
mod tests {
    use super::super::super::persons_file::PersonsFile;
    use super::*;
    use crate::config::PersonsConfig;

    const NAMES: [&str; 6] = ["Anna", "Anna Maria", "Dr. Zoë Grey", "Lena_O'Neill", "the smith", "Ben"];

    /// Every word of a text may begin a name, and every name be that of the number.
    fn is_in_by_all_words(called: &Called, text: &str) -> bool {
        let words = name_words(text);
        let mut at = 0;
        while at < words.len() {
            let mut counts = (1..=called.words_max.min(words.len() - at)).rev();
            let of = |count: usize| joined(&words[at..at + count], |word| &word.said);
            let is_name = |count: &usize| {
                called.spelled.contains(&joined(&words[at..at + count], |word| &word.bare))
                    || *count <= FORMER_WORDS && person_number(&of(*count)) == called.person
            };
            match counts.find(is_name) {
                Some(count) if called.is(&of(count)) => return true,
                count => at += count.unwrap_or(1),
            }
        }
        false
    }

    proptest::proptest! {
        /// What is left out for speed changes no answer, also of somebody whose name nobody knows any more.
        #[test]
        fn whom_a_text_names_is_found_at_any_word(
            residents in proptest::collection::vec(proptest::sample::select(&NAMES[..]), 0..5),
            who in proptest::sample::select(&NAMES[..]),
            is_known in proptest::bool::ANY,
            words in proptest::collection::vec(proptest::sample::select(vec![
                "Anna", "Maria", "anna", "Dr.", "Zoe", "Zoë", "Grey's", "lena", "o'neill", "the", "Smith", "Smith,", "Ben", "hugs", "and", "Ben's",
            ]), 0..12),
        ) {
            let residents = residents.iter().map(|name| (*name).to_owned()).collect();
            let persons = Persons::new(PersonsConfig { residents, ..PersonsConfig::default() }, PersonsFile::default());
            let number = person_number(who);
            let asked = if is_known { who.to_owned() } else { number.to_string() };
            let called = Called::new(&persons, number, &asked);
            let text = words.join(" ");
            proptest::prop_assert_eq!(called.is_in(&text), is_in_by_all_words(&called, &text), "{} in {:?}", who, text);
        }
    }
}
