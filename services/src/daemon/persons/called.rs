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
    own: BTreeSet<String>,
    /// The names of others that hold a word of an own name: "anna maria" next to "anna".
    others: BTreeSet<String>,
    words_max: usize,
    /// No known name gives this number: words that give it count as the person's name.
    unnamed: Option<PersonId>,
}

impl Called {
    /// A person by number, and the name or number that the question gave.
    pub(in super::super) fn new(persons: &Persons, person: PersonId, who: &str) -> Self {
        let own = persons.names().filter(|(own, _)| *own == person).map(|(_, name)| name.clone());
        let own: Vec<ReadName> = own.chain(Some(ReadName::new(who)).filter(|_| !is_number(who.trim()))).collect();
        let unnamed = Some(person).filter(|person| own.iter().all(|name| name.number != *person));
        let words = |name: &ReadName| name_words(&name.whole).join(" ");
        let firsts = own.iter().filter_map(|name| name.first.clone());
        let firsts = firsts.filter(|first| persons.called(first) == Some(person));
        let mut own: BTreeSet<String> = own.iter().map(words).chain(firsts).collect();
        own.retain(|name| !name.is_empty());
        let others = persons.names().map(|(_, name)| words(name)).filter(|name| !own.contains(name)).collect();
        let words_max = own.iter().chain(&others).map(|name| name.split(' ').count()).max().unwrap_or_default();
        Self { own, others, words_max: words_max.max(FORMER_WORDS), unnamed }
    }

    /// Whether a text names the person, also as an owner. A longer name of another person does not: "Anna Maria" is not Anna.
    pub(in super::super) fn is_in(&self, text: &str) -> bool {
        // "Tom greets Anna. Maria sings." names Anna.
        self.is_in_part(text) || text.split([',', ';', '!', '?', '.']).any(|part| self.is_in_part(part))
    }

    fn is_in_part(&self, text: &str) -> bool {
        let words = name_words(text);
        let mut rest = &words[..];
        while !rest.is_empty() {
            let found = (1..=self.words_max.min(rest.len())).rev().find_map(|count| {
                let name = rest[..count].join(" ");
                let is_former = |person| count <= FORMER_WORDS && person_number(&name) == person;
                let is_own = self.own.contains(&name) || self.unnamed.is_some_and(is_former);
                (is_own || self.others.contains(&name)).then_some((is_own, count))
            });
            if found.is_some_and(|(is_own, _)| is_own) {
                return true;
            }
            rest = &rest[found.map_or(1, |(_, count)| count)..];
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
        // Another resident, the person, texts that name the person, and texts that do not.
        const CASES: &str = "\
Tom; Zoë Grey; Tom gives Zoe a kiss. | Tom takes Zoe's cup. | Tom takes ZOË’S cup. | zoe sleeps. | Zoe Grey's cup.; Tom sees Zoella. | Tom hugs Lena.
Tom; Lena O'Neill; Tom hugs lena_o_neill. | Tom hugs Lena O’Neill | Tom hugs Lena. | Lena's cup.; Tom hugs Zoe. | Tom visits Mr. O'Neill.
Lena O'Neill; Lena; Tom hugs Lena. | They open Lena's bag, and lena sits.; Tom hugs Lena O'Neill. | Lena O’Neill sits. | lena_o_neill's cup.
Lena; Lena O'Neill; Lena O'Neill goes to bed.; Tom hugs Lena. | Lena goes to bed.
Anna Maria; Anna; Tom hugs Anna | Tom greets Anna. Maria sings.; Tom hugs Anna Maria. | Tom takes Anna-Maria's cup.
Ben; the smith; The Smith works.; They sit on the bench.";
        for case in CASES.lines() {
            let [others, who, names, no_names] = case.split("; ").collect::<Vec<_>>()[..] else { panic!("{case}") };
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
