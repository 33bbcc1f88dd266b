//! The persons file: names, numbers and residents of the home. A rename writes it, whole or not at all. People may edit it while the daemon is
//! stopped.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::state_file;
use roomcast_core::ids::PersonId;
use roomcast_core::narration::{ReadName, check_name, same_name};
use roomcast_core::parsing::{Keyed, json_says};

/// The file in the state directory.
pub(super) const FILE: &str = "persons.json";
/// Most bytes of it that are read, and written: ten thousand persons.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Former names that a person keeps, the newest.
const FORMER_MAX: usize = 8;

/// A person with a name from the home.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeptPerson {
    /// The number.
    pub number: PersonId,
    /// The name; narrators may use it in any case.
    pub name: String,
    /// Whether they live here; where left out, the configuration's list says it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub resident: Option<bool>,
    /// Names that the home gave before, oldest first: narrators that use them mean this person.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub former: Vec<String>,
}

impl KeptPerson {
    /// The names that mean this person, the newest first.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        std::iter::once(self.name.as_str()).chain(self.former.iter().rev().map(String::as_str))
    }

    /// The same person with another name.
    pub(super) fn renamed(&self, name: &str) -> Self {
        let mut former: Vec<String> = self.former.iter().chain([&self.name]).cloned().collect();
        former.retain(|former| !same_name(former, name));
        former.drain(..former.len().saturating_sub(FORMER_MAX));
        Self { name: name.to_owned(), former, ..self.clone() }
    }
}

/// The names of the home.
#[derive(Debug, Default, Clone)]
pub struct PersonsFile {
    /// Without a state directory nothing outlives the daemon.
    path: Option<PathBuf>,
    /// The file is malformed or unreadable. It is not overwritten, since people may have written it.
    unusable: bool,
    persons: Vec<KeptPerson>,
    index: Index,
}

/// Places of persons. A sentence looks up many names, and a home may have ten thousand.
#[derive(Debug, Default, Clone)]
struct Index {
    by_number: HashMap<PersonId, usize>,
    /// By all names, as they are compared.
    by_name: HashMap<String, usize>,
    /// By the numbers that follow from their names.
    by_named_number: HashMap<PersonId, usize>,
    /// The newest names, and the persons by the letters and first names that they share.
    names: Vec<ReadName>,
    sharing: HashMap<String, Vec<usize>>,
}

impl Index {
    fn new(persons: &[KeptPerson]) -> Self {
        let mut index =
            Self { names: persons.iter().map(|kept| ReadName::new(&kept.name)).collect(), ..Self::default() };
        for (at, kept) in persons.iter().enumerate() {
            index.by_number.entry(kept.number).or_insert(at);
            for name in kept.names().map(ReadName::new) {
                index.by_name.entry(name.whole().to_owned()).or_insert(at);
                index.by_named_number.entry(name.number()).or_insert(at);
            }
            let name = &index.names[at];
            for shared in std::iter::once(name.letters()).chain(name.first()) {
                let sharing = index.sharing.entry(shared.to_owned()).or_default();
                if sharing.last() != Some(&at) {
                    sharing.push(at);
                }
            }
        }
        index
    }
}

impl PersonsFile {
    /// The file in the state directory. A malformed file stays as it is, with a warning in the log.
    #[must_use]
    pub fn load(directory: &Path) -> Self {
        let path = directory.join(FILE);
        let mut unusable = false;
        let persons = match state_file::read(&path, FILE_BYTES_MAX) {
            Ok(None) => Vec::new(),
            Ok(Some(text)) => parse(&text).unwrap_or_else(|reason| {
                unusable = true;
                tracing::warn!(reason, path = %path.display(), "the persons file is malformed, and the names in it are not known: correct or remove it, and restart");
                Vec::new()
            }),
            Err(error) => {
                unusable = true;
                tracing::warn!(%error, path = %path.display(), "the persons file cannot be read, and the names in it are not known: correct or remove it, and restart");
                Vec::new()
            }
        };
        Self { path: Some(path), unusable, index: Index::new(&persons), persons }
    }

    /// All persons with a name.
    #[must_use]
    pub fn persons(&self) -> &[KeptPerson] {
        &self.persons
    }

    /// The number of a name: from the file, or else from the name itself.
    #[must_use]
    pub fn number_of(&self, name: &str) -> PersonId {
        let name = ReadName::new(name);
        self.given_number(&name).unwrap_or(name.number())
    }

    /// The number of a name in the file.
    pub(super) fn given_number(&self, name: &ReadName) -> Option<PersonId> {
        self.index.by_name.get(name.whole()).map(|at| self.persons[*at].number)
    }

    /// The number in the file for a number that follows from a name.
    #[must_use]
    pub fn current(&self, number: PersonId) -> PersonId {
        self.index.by_named_number.get(&number).map_or(number, |at| self.persons[*at].number)
    }

    /// The person of a number.
    #[must_use]
    pub(crate) fn of_number(&self, number: PersonId) -> Option<&KeptPerson> {
        self.index.by_number.get(&number).map(|at| &self.persons[*at])
    }

    /// The persons with a full or first name like this one, and their names.
    pub(super) fn sharing(&self, name: &ReadName) -> impl Iterator<Item = (PersonId, &ReadName)> {
        let sharing = self.index.sharing.get(name.letters()).into_iter().flatten();
        sharing.map(|at| (self.persons[*at].number, &self.index.names[*at]))
    }

    /// Whether a change outlives the daemon: the state directory exists.
    #[must_use]
    pub fn is_kept(&self) -> bool {
        self.path.as_deref().and_then(Path::parent).is_some_and(Path::is_dir)
    }

    /// Replaces the person of that number. The file changes first: if it cannot be written, nothing changes.
    ///
    /// # Errors
    /// When the state directory cannot be written, or the file would have more bytes than are read.
    pub fn put(&mut self, person: KeptPerson) -> std::io::Result<()> {
        let others = self.persons.iter().filter(|kept| kept.number != person.number).cloned();
        self.replace(others.chain([person.clone()]).collect())
    }

    /// Removes the person of a number.
    ///
    /// # Errors
    /// As [`PersonsFile::put`].
    pub fn remove(&mut self, number: PersonId) -> std::io::Result<()> {
        // A malformed file may still hold the person: the error says so.
        if self.of_number(number).is_none() && !self.unusable {
            return Ok(());
        }
        self.replace(self.persons.iter().filter(|kept| kept.number != number).cloned().collect())
    }

    fn replace(&mut self, persons: Vec<KeptPerson>) -> std::io::Result<()> {
        if self.unusable {
            let path = self.path.as_deref().unwrap_or(Path::new(FILE)).display();
            return Err(std::io::Error::other(format!(
                "{path} could not be used at the start; repair or remove it, and start the daemon again"
            )));
        }
        if let Some(path) = &self.path {
            state_file::replace_for_good(path, text_of(&persons)?.as_bytes())?;
        }
        self.index = Index::new(&persons);
        self.persons = persons;
        Ok(())
    }
}

/// The text of the file: lines for people, or one line if the lines would exceed the limit. One line is never longer than the text that was
/// read, so a person can always be forgotten.
fn text_of(persons: &[KeptPerson]) -> std::io::Result<String> {
    let is_readable = |text: &String| text.len() as u64 <= FILE_BYTES_MAX;
    let lines = serde_json::to_string_pretty(persons)?;
    let text = if is_readable(&lines) { lines } else { serde_json::to_string(persons)? };
    Some(text).filter(is_readable).ok_or_else(|| {
        std::io::Error::new(
            std::io::ErrorKind::FileTooLarge,
            format!("{FILE} would have more than {FILE_BYTES_MAX} bytes: forget somebody, or give a shorter name"),
        )
    })
}

/// Reads the file. A name or number that stands twice is an error.
fn parse(text: &str) -> Result<Vec<KeptPerson>, String> {
    let persons: Vec<Keyed<KeptPerson>> = serde_json::from_str(text).map_err(|error| json_says(&error))?;
    let persons: Vec<_> = persons.into_iter().map(|Keyed(person)| person).collect();
    let (mut numbers, mut names) = (HashMap::new(), HashMap::new());
    for (at, person) in persons.iter().enumerate() {
        person.names().try_for_each(check_name)?;
        if person.number == PersonId::SOMEBODY {
            return Err(format!("{:?} has the number {}, which means somebody", person.name, PersonId::SOMEBODY));
        }
        let of_number = numbers.insert(person.number, at);
        let mut of_names = person.names().map(|name| names.insert(ReadName::new(name).whole().to_owned(), at));
        if let Some(other) = of_number.or_else(|| of_names.find_map(|other| other.filter(|other| *other != at))) {
            return Err(format!("{:?} and {:?} have the same name or number", persons[other].name, person.name));
        }
    }
    Ok(persons)
}

#[cfg(test)]
mod tests {
    use roomcast_core::narration::person_number;

    use super::*;

    fn ada() -> KeptPerson {
        KeptPerson { number: PersonId(3), name: "Ada".to_owned(), resident: Some(true), former: Vec::new() }
    }

    #[test]
    fn persons_are_objects_and_not_lists() {
        assert!(parse(r#"[{"number": 5, "name": "Ada", "resident": true}]"#).is_ok());
        assert!(parse(r#"[[5, "Ada", true]]"#).is_err());
    }

    #[test]
    fn names_are_kept_over_a_restart() {
        let directory = tempfile::tempdir().unwrap();
        let mut file = PersonsFile::load(directory.path());
        assert!(file.persons().is_empty());
        file.put(ada()).unwrap();
        file.put(KeptPerson { number: PersonId(4), name: "ben".to_owned(), resident: None, former: Vec::new() })
            .unwrap();
        file.put(ada().renamed("Ada L.")).unwrap();
        let again = PersonsFile::load(directory.path());
        assert_eq!(again.persons(), file.persons());
        assert_eq!(again.number_of(" ada l. "), PersonId(3));
        // The former name still means the person.
        assert_eq!((again.number_of("ada"), again.number_of("adele")), (PersonId(3), person_number("adele")));
        file.remove(PersonId(3)).unwrap();
        assert!(PersonsFile::load(directory.path()).of_number(PersonId(3)).is_none());
        // A failed write changes nothing.
        let mut nowhere = PersonsFile::load(&directory.path().join("missing"));
        nowhere.put(ada()).unwrap_err();
        assert!(nowhere.persons().is_empty());
    }

    #[test]
    fn a_file_that_would_be_too_long_is_not_written() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(FILE);
        let person = |number: PersonId| KeptPerson {
            number,
            name: format!("n{number}{}", "x".repeat(40)),
            resident: None,
            former: Vec::new(),
        };
        let count = (1..)
            .find(|count| text_of(&(0..*count * 100).map(PersonId).map(person).collect::<Vec<_>>()).is_err())
            .unwrap();
        let most: Vec<_> = (0..(count - 1) * 100).map(PersonId).map(person).collect();
        std::fs::write(&path, serde_json::to_string(&most).unwrap()).unwrap();
        let mut file = PersonsFile::load(directory.path());
        file.put(person(PersonId(5)).renamed("Ada")).unwrap();
        let again = PersonsFile::load(directory.path());
        assert_eq!((again.persons().len(), again.of_number(PersonId(5)).unwrap().name.as_str()), (most.len(), "Ada"));
        let refused = (0..100).find_map(|more| file.put(person(PersonId(1_000_000 + more))).err()).unwrap().to_string();
        assert!(refused.contains("more than 1048576 bytes: forget somebody"), "{refused}");
        assert_eq!(PersonsFile::load(directory.path()).persons(), file.persons());
        file.remove(PersonId(5)).unwrap();
        assert!(PersonsFile::load(directory.path()).of_number(PersonId(5)).is_none());
    }

    #[test]
    fn a_current_name_is_no_former_name() {
        let mut ada = ada();
        for name in ["Adele", "ada", "Adele"] {
            ada = ada.renamed(name);
        }
        assert_eq!((ada.name.as_str(), ada.former.as_slice()), ("Adele", &["ada".to_owned()][..]));
        for number in 0..20 {
            ada = ada.renamed(&format!("name {number}"));
        }
        assert_eq!((ada.former.len(), ada.former[7].as_str()), (FORMER_MAX, "name 18"));
    }

    #[test]
    fn files_with_a_name_or_number_twice_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        for text in [
            r#"[{"number": 1, "name": "ada"}, {"number": 2, "name": "Ada"}]"#,
            r#"[{"number": 1, "name": "ada"}, {"number": 1, "name": "ben"}]"#,
            r#"[{"number": 4294967295, "name": "ada"}]"#,
            r#"[{"number": 1, "name": "ada"}, {"number": 2, "name": "ben", "former": ["Ada"]}]"#,
            r#"[{"number": 1, "name": "12"}]"#,
            r#"[{"number": 1, "name": " "}]"#,
            "{",
        ] {
            std::fs::write(directory.path().join(FILE), text).unwrap();
            let mut file = PersonsFile::load(directory.path());
            assert!(file.persons().is_empty(), "{text}");
            assert!(file.put(ada()).unwrap_err().to_string().contains("repair or remove it"));
            assert_eq!(std::fs::read_to_string(directory.path().join(FILE)).unwrap(), text);
        }
    }
}
