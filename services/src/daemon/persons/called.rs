//! What a person is called beside all others who are known: whose a name is that stands in a text.

use std::collections::BTreeSet;

use roomcast_core::narration::{Said, is_number, name_words, person_number};

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
    /// Words of the longest of these.
    words_max: usize,
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
        let mut spelled = BTreeSet::new();
        for name in kept.chain(told).chain(listed).chain(names.iter().map(String::as_str)) {
            let shorter = [Said::without_title(name), Said::first_name(name).unwrap_or(name)];
            spelled.extend([name].into_iter().chain(shorter).map(bare));
        }
        let is_near = |name: &String| name.split(' ').any(|word| !word.is_empty() && own.contains(word));
        spelled.retain(is_near);
        let words_max = spelled.iter().map(|name| name.split(' ').count()).max().unwrap_or_default().max(FORMER_WORDS);
        Self { person, persons: persons.clone(), names, spelled, words_max }
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
            let name = (1..=longest).rev().find_map(|count| {
                let words = &words[at..at + count];
                let join = |of: fn(&roomcast_core::narration::NameWord) -> &str| {
                    words.iter().map(of).collect::<Vec<_>>().join(" ")
                };
                let said = join(|word| &word.said);
                let is_name = self.spelled.contains(&join(|word| &word.bare))
                    || count <= FORMER_WORDS && person_number(&said) == self.person;
                is_name.then_some((count, said))
            });
            match name {
                Some((_, said)) if self.is(&said) => return true,
                Some((count, _)) => at += count,
                None => at += 1,
            }
        }
        false
    }
}

/// A name as it stands among the words of a text.
fn bare(name: &str) -> String {
    let words: Vec<String> = name_words(name).into_iter().map(|word| word.bare).collect();
    words.join(" ").trim_end().to_owned()
}
