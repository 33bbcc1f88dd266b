//! The persons that the daemon knows: names and numbers, presence, residents and visitors. No clock: times come in as nanoseconds of
//! the monotonic clock, negative before the machine's start.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::{
    Event, Observation, PERSONS_MAX, Presence, Quota, ReadName, check_name, is_number, name_words,
};
use roomcast_ipc::raw::person_flags;

use super::journal::KeptPerson;
use super::person_question::PersonLine;
use super::persons_file::PersonsFile;
use crate::config::PersonsConfig;

/// A visitor on a bed is gone only after this silence: a night's sleep.
const NIGHT_NS: i64 = 12 * 3_600_000_000_000;

/// An event this much older than its person's newest event changes nothing.
pub(super) const LATE_NS: i64 = 60_000_000_000;

/// Times of one source may be out of order by this much: clock errors and delays on the way.
const ORDER_NS: i64 = 100_000_000;

pub(super) use called::Called;

mod called;

/// A known person, without history and forecast.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct Known {
    name: Option<ReadName>,
    pub(super) presence: Presence,
    pub(super) since_ns: i64,
    /// The newest time of an event.
    pub(super) heard_ns: i64,
    /// The time of the newest action; `i64::MIN` before the first.
    pub(super) did_ns: i64,
    pub(super) last: EventId,
    /// The time of `last`, which may be late.
    last_ns: i64,
    /// The quota of the narrator that reported the person first.
    quota: u64,
    /// The newest report by a named narrator.
    guarded_ns: Option<i64>,
    /// The person was found by fit, without key or name.
    by_fit: bool,
    /// The person lies in bed or sleeps, as far as actions and bed sensors tell.
    pub(super) on_bed: bool,
    /// The daemon has accepted no event of this person since its start.
    pub(super) restored: bool,
    /// The scores since the newest event were sent.
    pub(super) told: bool,
}

impl Known {
    fn is_on_bed(&self) -> bool {
        self.presence == Presence::Present && self.on_bed
    }
}

/// Why a person keeps the old name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotRenamed {
    /// The name is no name, or belongs to another person.
    #[error("{0}")]
    Refused(String),
    /// The name cannot be stored.
    #[error("{0}")]
    Failed(String),
}

/// All persons that the daemon knows.
#[derive(Debug, Default, Clone)]
pub struct Persons {
    config: PersonsConfig,
    residents: Vec<ReadName>,
    not_persons: Vec<ReadName>,
    pub(super) file: PersonsFile,
    known: BTreeMap<PersonId, Known>,
}

impl Persons {
    /// No person yet. `file` has the names that the home gave.
    #[must_use]
    pub fn new(config: PersonsConfig, file: PersonsFile) -> Self {
        let read = |names: &[String]| names.iter().map(|name| ReadName::new(name)).collect();
        let (residents, not_persons) = (read(&config.residents), read(&config.not_persons));
        Self { config, residents, not_persons, file, known: BTreeMap::new() }
    }

    /// Persons by number, also those that are gone and not yet published as gone.
    pub(super) fn iter(&self) -> impl Iterator<Item = (PersonId, &Known)> {
        self.known.iter().map(|(number, known)| (*number, known))
    }

    pub(super) fn get(&self, number: PersonId) -> Option<&Known> {
        self.known.get(&number)
    }

    pub(super) fn get_mut(&mut self, number: PersonId) -> Option<&mut Known> {
        self.known.get_mut(&number)
    }

    /// The number of a name: of the person that the home knows by it, or the number of the name itself.
    #[must_use]
    pub fn number_of(&self, name: &str) -> PersonId {
        self.number_of_read(&ReadName::new(name))
    }

    fn number_of_read(&self, name: &ReadName) -> PersonId {
        self.known_number(name).unwrap_or(name.number)
    }

    /// The number of a name that the home knows. "Zoe" is Zoë if no other name differs by accents or signs only.
    fn known_number(&self, name: &ReadName) -> Option<PersonId> {
        let same = self.names().find(|(_, own)| own.whole == name.whole).map(|(number, _)| number);
        same.or_else(|| self.only_number_where(|own| own.may_be_one(name)))
    }

    /// The names that the home gave, those of residents as the configuration spells them, and those from keyed events.
    fn names(&self) -> impl Iterator<Item = (PersonId, &ReadName)> {
        let known = self.known.iter().filter_map(|(number, known)| Some((*number, known.name.as_ref()?)));
        let residents = self.residents.iter().filter(|read| read.said.parse::<u32>().is_err());
        self.file.names().chain(residents.map(|read| (read.number, read))).chain(known)
    }

    /// The number of all names for which `is_such` holds, if they have the same one.
    fn only_number_where(&self, is_such: impl Fn(&ReadName) -> bool) -> Option<PersonId> {
        // A name that the home gave to a person has that person's number.
        let number = |(own, read): (PersonId, &ReadName)| self.file.given_number(read).unwrap_or(own);
        let mut numbers = self.names().filter(|(_, read)| is_such(read)).map(number);
        numbers.next().filter(|first| numbers.all(|other| other == *first))
    }

    /// The number of a name that the home knows, or of the first name of one person only.
    #[must_use]
    pub fn called(&self, name: &str) -> Option<PersonId> {
        let read = ReadName::new(name);
        let is_first = |known: &ReadName| known.first.as_ref() == Some(&read.letters);
        self.known_number(&read).or_else(|| self.only_number_where(is_first))
    }

    /// The known person at the start of a text, in whole words; the longest name counts.
    pub(super) fn at_start<'a>(&self, text: &'a str) -> Option<(PersonId, &'a str)> {
        const WORDS_MAX: usize = 4;
        // Nearly all texts; these checks allocate nothing.
        if text.starts_with("They ") || self.names().next().is_none() {
            return None;
        }
        let is_end = |c: char| c.is_whitespace() || matches!(c, ',' | ':');
        let ends: Vec<usize> = text.match_indices(is_end).map(|(at, _)| at).take(WORDS_MAX).collect();
        ends.iter().rev().find_map(|end| {
            let name = text[..*end].trim_end_matches([',', ':']);
            Some((self.called(name)?, name)).filter(|_| !name.is_empty())
        })
    }

    /// Whether a text begins with a name from `persons.not_persons`, as of a robot or a pet.
    #[must_use]
    pub fn begins_with_no_person(&self, text: &str) -> bool {
        let words = if self.not_persons.is_empty() { String::new() } else { name_words(text).join(" ") + " " };
        let words = words.strip_prefix("the ").unwrap_or(&words);
        self.not_persons.iter().any(|name| words.starts_with(&format!("{} ", name.letters)))
    }

    /// A person's name; `None` for a person known by number only.
    #[must_use]
    pub fn name_of(&self, number: PersonId) -> Option<&str> {
        self.names().find(|(own, _)| *own == number).map(|(_, read)| &*read.said)
    }

    /// Whether a person is a visitor. Without a list of residents each person is a resident.
    #[must_use]
    pub fn is_visitor(&self, number: PersonId) -> bool {
        let by_list = || !self.residents.is_empty() && !self.is_resident(number);
        self.file.of_number(number).and_then(|kept| kept.resident).map_or_else(by_list, |resident| !resident)
    }

    pub(super) fn is_resident(&self, number: PersonId) -> bool {
        self.residents().any(|resident| resident == number)
    }

    /// The persons that an event without a name may be about. A named narrator follows only persons that named narrators reported, if there
    /// are any.
    fn candidates(&self, is_unknown: bool) -> impl Iterator<Item = (PersonId, &Known)> {
        let here = || self.iter().filter(|(_, known)| known.presence != Presence::Gone);
        let is_all = is_unknown || here().all(|(_, known)| known.guarded_ns.is_none());
        here().filter(move |(_, known)| is_all || known.guarded_ns.is_some())
    }

    /// Each person in the house, and each resident: the persons that leave when everybody does.
    pub(super) fn everybody(&self) -> BTreeSet<PersonId> {
        let here = self.iter().filter(|(_, known)| known.presence == Presence::Present).map(|(number, _)| number);
        here.chain(self.residents()).collect()
    }

    /// Whether an event at `at_ns` is too late to count: a newer event contradicts its presence, or is a minute newer. A person that is gone may
    /// be back.
    pub(super) fn is_outdated(&self, observation: &Observation, at_ns: i64) -> bool {
        let known = self.known.get(&observation.person).filter(|known| known.presence != Presence::Gone);
        known.is_some_and(|known| {
            let differs = known.presence != observation.event.person_presence();
            differs && at_ns < known.heard_ns || at_ns.saturating_add(LATE_NS) < known.heard_ns
        })
    }

    /// Whether an unknown narrator's event about a person, or about anybody, is ignored: a named narrator reported them within `guard_s`.
    pub(super) fn is_guarded(&self, person: Option<PersonId>, at_ns: i64) -> bool {
        let guard_ns = (self.config.guard_s * 1e9) as i64;
        let is_guarded = |ns: i64| guard_ns > 0 && at_ns <= ns.saturating_add(guard_ns);
        let own = self.iter().filter(|(number, _)| person.is_none_or(|person| person == *number));
        own.filter_map(|(_, known)| known.guarded_ns).any(is_guarded)
    }

    pub(super) fn is_trusted(&self, number: PersonId) -> bool {
        self.known.get(&number).is_some_and(|known| known.guarded_ns.is_some())
    }

    /// The time of an event in the order of its source, although its clock rounds or the network delays.
    pub(super) fn in_order(&self, observation: &Observation, at_ns: i64) -> i64 {
        let Some(known) = self.known.get(&observation.person) else { return at_ns };
        let (last, event) = (known.last, observation.id());
        let is_next = last.start() == event.start() && last.sequence <= event.sequence;
        let is_near = at_ns.saturating_add(ORDER_NS) >= known.last_ns;
        if is_next && is_near { at_ns.max(known.last_ns) } else { at_ns }
    }

    /// Takes in an event of a person by a named narrator or an unknown one. Returns the person that is dropped, if there is one too many.
    pub(super) fn note(
        &mut self,
        observation: &Observation,
        (quota, is_named): (Quota, bool),
        at_ns: i64,
    ) -> Option<PersonId> {
        let number = observation.person;
        // A person that comes back starts afresh.
        if observation.event != Event::Gone && self.known.get(&number).is_some_and(|own| own.presence == Presence::Gone)
        {
            self.known.remove(&number);
        }
        let is_full = self.known.len() >= PERSONS_MAX && !self.known.contains_key(&number);
        let dropped = if is_full { self.least_missed(quota.number) } else { None };
        dropped.map(|dropped| self.known.remove(&dropped));
        let (did_ns, quota) = (i64::MIN, quota.number);
        let new = || Known { did_ns, heard_ns: at_ns, since_ns: at_ns, quota, ..Known::default() };
        let known = self.known.entry(number).or_insert_with(new);
        // Of two spellings the first one counts.
        known.name = known.name.take().or_else(|| observation.name.as_deref().map(ReadName::new));
        known.guarded_ns = known.guarded_ns.max(is_named.then_some(at_ns));
        if observation.event.sentence().is_some() {
            known.did_ns = at_ns.max(known.did_ns);
        }
        known.last_ns = at_ns;
        // A late event does not turn back time.
        let at_ns = at_ns.max(known.heard_ns);
        let presence = observation.event.person_presence();
        (known.heard_ns, known.by_fit, known.restored, known.told) = (at_ns, observation.by_fit, false, false);
        known.last = observation.id();
        if known.presence != presence {
            (known.presence, known.since_ns) = (presence, at_ns);
        }
        known.on_bed &= presence == Presence::Present;
        dropped
    }

    /// The person to drop for one more of `newcomer`: visitors before residents, then persons of the quota with most persons, then the longest
    /// silence. A narrator that invents persons drops its own.
    fn least_missed(&self, newcomer: u64) -> Option<PersonId> {
        let told = |quota: u64| {
            self.known.values().filter(|known| known.quota == quota).count() + usize::from(quota == newcomer)
        };
        let rank = |(number, known): &(PersonId, &Known)| {
            (!self.is_visitor(*number), Reverse(told(known.quota)), known.heard_ns)
        };
        self.iter().min_by_key(rank).map(|(number, _)| number)
    }

    pub(super) fn remove(&mut self, number: PersonId) -> bool {
        self.known.remove(&number).is_some()
    }

    /// Forgets persons that are gone, once that was published.
    pub(super) fn remove_gone(&mut self) {
        self.known.retain(|_, known| known.presence != Presence::Gone || !known.told);
    }

    /// Whether a visitor has been silent for long enough to be gone.
    pub(super) fn has_expired(&self, number: PersonId, now_ns: i64) -> bool {
        let visitor_ns = (self.config.visitor_s * 1e9) as i64;
        let expires = |known: &Known| {
            now_ns - known.heard_ns > if known.is_on_bed() { visitor_ns.max(NIGHT_NS) } else { visitor_ns }
        };
        self.known.get(&number).is_some_and(expires) && self.is_visitor(number)
    }

    pub(super) fn are_all_away(&self) -> bool {
        let (known, present) = self.count();
        known > 0 && present == 0
    }

    /// Whether a resident was never observed.
    pub(super) fn misses_residents(&self) -> bool {
        self.residents().any(|number| !self.known.contains_key(&number))
    }

    fn residents(&self) -> impl Iterator<Item = PersonId> {
        self.residents.iter().map(|read| read.said.parse().unwrap_or_else(|_| self.number_of_read(read)))
    }

    /// The next visitor that is gone by silence.
    pub(super) fn expired(&self, now_ns: i64) -> Option<PersonId> {
        let here = self.iter().filter(|(_, known)| known.presence != Presence::Gone);
        here.map(|(number, _)| number).find(|number| self.has_expired(*number, now_ns))
    }

    pub(super) fn expire(&mut self, number: PersonId, now_ns: i64) {
        if let Some(known) = self.known.get_mut(&number) {
            (known.presence, known.since_ns, known.on_bed, known.told) = (Presence::Gone, now_ns, false, false);
        }
    }

    /// The number of known persons, and of those in the house.
    pub(super) fn count(&self) -> (usize, usize) {
        let of = |presence: Presence| self.known.values().filter(|known| known.presence == presence).count();
        (self.known.len() - of(Presence::Gone), of(Presence::Present))
    }

    /// The persons that an unnamed event may be about if two of them cannot have caused it: the person in the house, then the person that is away,
    /// then the resident that was not observed. An unknown house has the numbers from 0.
    pub(super) fn unnamed(&self, is_unknown: bool) -> impl Iterator<Item = PersonId> {
        let rank = |(number, known): (PersonId, &Known)| {
            (known.presence != Presence::Present, Reverse(known.heard_ns), number)
        };
        let mut known: Vec<_> = self.candidates(is_unknown).map(rank).collect();
        known.sort_unstable();
        let known = known.into_iter().map(|(.., number)| number);
        let is_gone = |number: PersonId| self.known.get(&number).is_none_or(|known| known.presence == Presence::Gone);
        let invented = if self.residents.is_empty() { 2 * PERSONS_MAX as u32 } else { 0 };
        let further = self.residents().chain((0..invented).map(PersonId));
        known.chain(further.filter(move |number| is_gone(*number)))
    }

    pub(super) fn has_residents(&self) -> bool {
        !self.residents.is_empty()
    }

    /// Whether two persons or more can have caused an unnamed event.
    pub(super) fn are_several(&self, is_unknown: bool) -> bool {
        let mut numbers = self.candidates(is_unknown).map(|(number, _)| number).chain(self.residents());
        numbers.next().is_some_and(|first| numbers.any(|other| other != first))
    }

    /// The persons that the joint filter follows: known ones and residents. Persons that only unknown narrators reported are left out if named
    /// narrators reported any.
    pub(super) fn followed(&self) -> BTreeSet<PersonId> {
        self.residents().chain(self.candidates(false).map(|(number, _)| number)).collect()
    }

    /// The number of a name or number, known or not.
    pub(super) fn meant(&self, who: &str) -> PersonId {
        let who = who.trim();
        who.parse().ok().filter(|_| is_number(who)).unwrap_or_else(|| self.number_of(who))
    }

    /// The known person of a name or number.
    #[must_use]
    pub fn find(&self, who: &str) -> Option<PersonId> {
        let number = self.meant(who);
        (self.known.contains_key(&number) || self.file.of_number(number).is_some()).then_some(number)
    }

    /// Gives a person a name that outlives restarts.
    ///
    /// # Errors
    /// If the name is wrong, belongs to another person, or cannot be stored.
    pub(super) fn rename(&mut self, number: PersonId, name: &str) -> Result<(), NotRenamed> {
        let name = name.trim();
        check_name(name).map_err(NotRenamed::Refused)?;
        let owner = self.number_of(name);
        if owner != number && self.find(name).is_some() {
            let reason = format!("{name} is person {owner} already: forget that one first, or choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        // One resident cannot take the name of another.
        let lives_here = self.residents.iter().any(|resident| resident.whole == ReadName::new(name).whole);
        if owner != number && lives_here && self.is_resident(number) {
            let own = self.name_of(number).unwrap_or("this person");
            let reason = format!("{name} and {own} both live here by persons.residents: choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        // Narrators may go on with the old name.
        let own = || self.name_of(number).unwrap_or(name).to_owned();
        let new = || KeptPerson { number, name: own(), resident: None, former: Vec::new() };
        let former = self.file.of_number(number).cloned().unwrap_or_else(new);
        self.file
            .set(number, Some(former.renamed(name)))
            .map_err(|error| NotRenamed::Failed(format!("the name cannot be stored: {error}; nothing was changed")))
    }

    /// The names that the home gave.
    pub fn file(&self) -> &PersonsFile {
        &self.file
    }

    /// All persons that are known, have a given name, or are residents.
    pub(super) fn lines(&self, now_ns: i64) -> Vec<PersonLine> {
        let kept = self.file.persons().iter().map(|kept| kept.number);
        let numbers: BTreeSet<PersonId> = self.known.keys().copied().chain(kept).chain(self.residents()).collect();
        let line = |person: PersonId| {
            let known = self.known.get(&person);
            let seconds = |since_ns: i64| (now_ns - since_ns) as f64 / 1e9;
            let flags = self.flags(person, now_ns);
            PersonLine {
                person,
                name: self.name_of(person).map(str::to_owned),
                presence: known.map_or(Presence::Unknown, |known| known.presence),
                since_s: known.map(|known| seconds(known.since_ns)),
                silent_s: known.map(|known| seconds(known.heard_ns)),
                flags: flag_words(flags).map(str::to_owned).collect(),
            }
        };
        numbers.into_iter().map(line).collect()
    }

    pub(super) fn flags(&self, number: PersonId, now_ns: i64) -> u32 {
        let Some(known) = self.known.get(&number) else { return 0 };
        let asleep_ns = (self.config.asleep_s * 1e9) as i64;
        let flags = [
            (known.restored, person_flags::RESTORED),
            (known.is_on_bed() && now_ns - known.heard_ns > asleep_ns, person_flags::ASLEEP),
            (known.by_fit, person_flags::BY_FIT),
            (self.is_visitor(number), person_flags::VISITOR),
        ];
        flags.into_iter().filter(|(holds, _)| *holds).fold(0, |flags, (_, flag)| flags | flag)
    }
}

/// Words for bits of [`person_flags`].
pub fn flag_words(flags: u32) -> impl Iterator<Item = &'static str> {
    let words = [
        (person_flags::RESTORED, "restored"),
        (person_flags::ASLEEP, "asleep"),
        (person_flags::BY_FIT, "by-fit"),
        (person_flags::VISITOR, "visitor"),
        (person_flags::UNFAMILIAR, "unfamiliar"),
    ];
    words.into_iter().filter(move |(flag, _)| flags & flag != 0).map(|(_, word)| word)
}

#[cfg(test)]
mod tests;
