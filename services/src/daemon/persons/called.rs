//! The texts that name a person, for `forget`: the state database has sentences of others that mention the person.

use std::collections::BTreeSet;

use roomcast_core::ids::PersonId;
use roomcast_core::narration::{ReadName, is_number, name_words, person_number};

use super::Persons;

/// A name that narrators gave before the home gave another one has at most so many words, if only its number is known.
const FORMER_WORDS: usize = 3;

/// The names of one person, and those of all others at that time.
#[derive(Debug)]
pub(in super::super) struct Called {
    person: PersonId,
    own: BTreeSet<String>,
    /// The names of others that hold a word of an own name: "anna maria" next to "anna".
    others: BTreeSet<String>,
    words_max: usize,
    /// No known name gives the person's number. Words that give this number count as the person's name.
    has_unknown_name: bool,
}

impl Called {
    /// A person by number, and the name or number that the question gave.
    pub(in super::super) fn new(persons: &Persons, person: PersonId, who: &str) -> Self {
        let mut names = persons.names_of(person);
        names.extend(Some(who.trim().to_lowercase()).filter(|who| !is_number(who)));
        let has_unknown_name = !names.iter().any(|name| person_number(name) == person);
        let bare = |name: &str| name_words(name).join(" ");
        let without_the = |name: String| name.strip_prefix("the ").map(str::to_owned).unwrap_or(name);
        let mut own: BTreeSet<String> = names.iter().map(|name| without_the(bare(name))).collect();
        let is_first = |first: &&str| persons.called(first) == Some(person);
        let firsts = names.iter().filter_map(|name| ReadName::new(name).first().filter(is_first).map(str::to_owned));
        own.extend(firsts.collect::<Vec<_>>());
        own.retain(|name| !name.is_empty());
        let others =
            persons.all_names().map(|name| without_the(bare(name))).filter(|name| !own.contains(name)).collect();
        let words_max = own.iter().chain(&others).map(|name| name.split(' ').count()).max().unwrap_or_default();
        Self { person, own, others, words_max: words_max.max(FORMER_WORDS), has_unknown_name }
    }

    /// Whether a text names the person, also as an owner. A longer name of another person does not: "Anna Maria" is not Anna.
    pub(in super::super) fn is_in(&self, text: &str) -> bool {
        // "Tom greets Anna. Maria sings." names Anna.
        self.is_in_part(text) || text.split([',', ';', '!', '?', '.']).any(|part| self.is_in_part(part))
    }

    fn is_in_part(&self, text: &str) -> bool {
        let words = name_words(text);
        let mut at = 0;
        while at < words.len() {
            let longest = self.words_max.min(words.len() - at);
            let found = (1..=longest).rev().find_map(|count| {
                let name = words[at..at + count].join(" ");
                let is_own = self.own.contains(&name)
                    || self.has_unknown_name && count <= FORMER_WORDS && person_number(&name) == self.person;
                (is_own || self.others.contains(&name)).then_some((is_own, count))
            });
            match found {
                Some((true, _)) => return true,
                Some((false, count)) => at += count,
                None => at += 1,
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::persons_file::PersonsFile;
    use super::*;
    use crate::config::PersonsConfig;

    #[test]
    fn texts_that_name_a_person_are_found() {
        for (others, who, names, no_names) in [
            (
                "Tom",
                "Zoë Grey",
                "Tom gives Zoe a kiss. | Tom takes Zoe's cup. | Tom takes ZOË’S cup. | zoe sleeps. | Zoe Grey's cup.",
                "Tom sees Zoella. | Tom hugs Lena.",
            ),
            (
                "Tom",
                "Lena O'Neill",
                "Tom hugs lena_o_neill. | Tom hugs Lena O’Neill | Tom hugs Lena. | Tom takes Lena's cup.",
                "Tom hugs Zoe. | Tom visits Mr. O'Neill.",
            ),
            (
                "Lena O'Neill",
                "Lena",
                "Tom hugs Lena. | They open Lena's bag, and lena sits. | Lena sits down.",
                "Tom hugs Lena O'Neill. | Lena O’Neill sits down. | Tom takes lena_o_neill's cup.",
            ),
            ("Lena", "Lena O'Neill", "Lena O'Neill goes to bed.", "Tom hugs Lena. | Lena goes to bed."),
            (
                "Anna Maria",
                "Anna",
                "Tom hugs Anna | Tom greets Anna. Maria sings.",
                "Tom hugs Anna Maria. | Tom takes Anna-Maria's cup.",
            ),
            ("Ben", "the smith", "The Smith works.", "They sit on the bench."),
        ] {
            let residents = [others, who].map(str::to_owned).to_vec();
            let persons = Persons::new(PersonsConfig { residents, ..PersonsConfig::default() }, PersonsFile::default());
            let called = Called::new(&persons, person_number(who), who);
            for (texts, is_named) in [(names, true), (no_names, false)] {
                texts.split(" | ").for_each(|text| assert_eq!(called.is_in(text), is_named, "{who}: {text}"));
            }
        }
        let (former, persons) = (person_number("Igor"), Persons::default());
        assert!(Called::new(&persons, former, &former.to_string()).is_in("They talk to Igor."), "by number only");
    }
}
