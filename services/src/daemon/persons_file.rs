//! The names that the home gave to persons, and their numbers, in the table `person` of the state database.

use std::path::Path;
use std::time::Instant;

use super::journal::{self, JournalHandle, KeptPerson, PATIENCE};
use roomcast_core::ids::PersonId;
use roomcast_core::narration::{ReadName, check_name, same_name};

/// Most persons with a name from the home.
pub const NAMED_MAX: usize = 1000;

/// The names from the home.
#[derive(Debug, Default, Clone)]
pub struct PersonsFile {
    /// `None` without a state directory: names are lost at the end.
    journal: Option<JournalHandle>,
    persons: Vec<KeptPerson>,
    /// All names of each person, the newest first.
    names: Vec<Vec<ReadName>>,
}

impl PersonsFile {
    /// The names in another process's database, for reading; empty without a database.
    #[must_use]
    pub fn load(directory: &Path) -> Self {
        let persons = journal::look(directory).map(|recovered| recovered.persons);
        Self::new(persons.unwrap_or_else(|_| journal::old_persons(directory)), None)
    }

    /// The names in the database, and the access for changes. If names or numbers are duplicate, all names are left out.
    #[must_use]
    pub(super) fn new(persons: Vec<KeptPerson>, journal: Option<JournalHandle>) -> Self {
        let persons = check(&persons).map(|()| persons).unwrap_or_else(|reason| {
            tracing::warn!(reason, "the table person of the state database is wrong, and the names in it are not known: correct it, and restart");
            Vec::new()
        });
        Self { journal, names: read(&persons), persons }
    }

    /// The persons with a name from the home.
    #[must_use]
    pub fn persons(&self) -> &[KeptPerson] {
        &self.persons
    }

    /// All names with their numbers; of one person, the newest first.
    pub(super) fn names(&self) -> impl Iterator<Item = (PersonId, &ReadName)> {
        let of_each = self.persons.iter().zip(&self.names);
        of_each.flat_map(|(kept, names)| names.iter().map(|name| (kept.number, name)))
    }

    /// The number that the home gave to a name.
    pub(super) fn given_number(&self, name: &ReadName) -> Option<PersonId> {
        self.names().find(|(_, own)| own.whole == name.whole).map(|(number, _)| number)
    }

    /// The number of the person with this number or a name that leads to it.
    #[must_use]
    pub fn current(&self, number: PersonId) -> PersonId {
        self.names().find(|(_, own)| own.number == number).map_or(number, |(current, _)| current)
    }

    /// The person of a number.
    #[must_use]
    pub(crate) fn of_number(&self, number: PersonId) -> Option<&KeptPerson> {
        self.persons.iter().find(|kept| kept.number == number)
    }

    /// Whether a change survives a restart: there is a state database, and its last sync succeeded.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.journal.as_ref().is_some_and(JournalHandle::is_kept)
    }

    /// Replaces or removes the person of a number. The database changes first: if it cannot be written, nothing changes.
    ///
    /// # Errors
    /// When the state database cannot be written, or there would be too many persons.
    pub fn set(&mut self, number: PersonId, person: Option<KeptPerson>) -> std::io::Result<()> {
        if person.is_none() && self.of_number(number).is_none() {
            return Ok(());
        }
        let others = self.persons.iter().filter(|kept| kept.number != number).cloned();
        let persons: Vec<_> = others.chain(person).collect();
        if persons.len() > NAMED_MAX {
            let reason = format!("the home has named {NAMED_MAX} persons already: forget some");
            return Err(std::io::Error::new(std::io::ErrorKind::StorageFull, reason));
        }
        if let Some(journal) = &self.journal {
            let new = persons.clone();
            journal.ask(|writer| writer.write_persons(new), Instant::now() + PATIENCE)?;
        }
        self.names = read(&persons);
        self.persons = persons;
        Ok(())
    }
}

fn read(persons: &[KeptPerson]) -> Vec<Vec<ReadName>> {
    persons.iter().map(|kept| kept.names().map(ReadName::new).collect()).collect()
}

/// Refuses duplicate names and numbers: they would merge two persons.
fn check(persons: &[KeptPerson]) -> Result<(), String> {
    for (at, person) in persons.iter().enumerate() {
        person.names().try_for_each(check_name)?;
        if person.number == PersonId::SOMEBODY {
            return Err(format!("{:?} has the number {}, which means somebody", person.name, PersonId::SOMEBODY));
        }
        let is_one = |other: &&KeptPerson| {
            other.number == person.number || other.names().any(|name| person.names().any(|own| same_name(own, name)))
        };
        if let Some(other) = persons[..at].iter().find(is_one) {
            return Err(format!("{:?} and {:?} have the same name or number", other.name, person.name));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::daemon::Journal;

    fn kept(number: u32, name: &str) -> KeptPerson {
        KeptPerson { number: PersonId(number), name: name.to_owned(), resident: None, former: Vec::new() }
    }

    #[test]
    fn names_outlive_the_daemon() {
        let directory = tempfile::tempdir().unwrap();
        let (journal, recovered) = Journal::open(directory.path(), 1 << 20, Duration::from_secs(1)).unwrap();
        let mut file = PersonsFile::new(recovered.persons, Some(journal.handle.clone()));
        assert!(file.persons().is_empty());
        let ada = KeptPerson { resident: Some(true), ..kept(3, "Ada") };
        for person in [ada.clone(), kept(4, "ben"), ada.renamed("Ada L.")] {
            file.set(person.number, Some(person)).unwrap();
        }
        let again = PersonsFile::load(directory.path());
        assert_eq!(again.persons(), file.persons());
        let number_of = |name: &str| again.given_number(&ReadName::new(name));
        // A narrator that knows the former name continues to use it.
        assert_eq!([" ada l. ", "ada", "adele"].map(number_of), [Some(PersonId(3)), Some(PersonId(3)), None]);
        file.set(PersonId(3), None).unwrap();
        assert!(file.is_kept() && PersonsFile::load(directory.path()).of_number(PersonId(3)).is_none());
        // When it cannot be written, nothing changes.
        drop(journal);
        file.set(PersonId(3), Some(ada)).unwrap_err();
        assert_eq!(file.persons().len(), 1);
        let full = (0..NAMED_MAX as u32).map(|number| kept(number, &format!("n{number}x"))).collect();
        let error = PersonsFile::new(full, None).set(PersonId(1_000_000), Some(kept(1_000_000, "Ada"))).unwrap_err();
        assert!(error.to_string().contains("forget some"));
    }

    #[test]
    fn a_name_that_is_taken_up_again_is_no_former_one() {
        let ada = ["Adele", "ada", "Adele"].iter().fold(kept(3, "Ada"), |ada, name| ada.renamed(name));
        assert_eq!((ada.name.as_str(), ada.former.as_slice()), ("Adele", &["ada".to_owned()][..]));
        let ada = (0..20).fold(ada, |ada, number| ada.renamed(&format!("name {number}")));
        assert_eq!((ada.former.len(), ada.former[7].as_str()), (8, "name 18"));
    }

    #[test]
    fn a_file_that_makes_two_of_one_is_not_used() {
        let directory = tempfile::tempdir().unwrap();
        for (text, persons) in [
            (r#"[{"number": 5, "name": "Ada", "resident": true}]"#, 1),
            (r#"[[5, "Ada", true]]"#, 0),
            (r#"[{"number": 1, "name": "ada"}, {"number": 2, "name": "Ada"}]"#, 0),
            (r#"[{"number": 1, "name": "ada"}, {"number": 1, "name": "ben"}]"#, 0),
            (r#"[{"number": 4294967295, "name": "ada"}]"#, 0),
            (r#"[{"number": 1, "name": "ada"}, {"number": 2, "name": "ben", "former": ["Ada"]}]"#, 0),
            (r#"[{"number": 1, "name": "12"}]"#, 0),
            (r#"[{"number": 1, "name": " "}]"#, 0),
            ("{", 0),
        ] {
            let path = directory.path().join("persons.json");
            std::fs::write(&path, text).unwrap();
            assert_eq!(PersonsFile::load(directory.path()).persons().len(), persons, "{text}");
            assert_eq!(std::fs::read_to_string(&path).unwrap(), text);
        }
        assert!(PersonsFile::new(vec![kept(3, "Ada"), kept(4, "Ada")], None).persons().is_empty());
    }
}
