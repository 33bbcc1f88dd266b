//! The persons that the daemon knows: names and numbers, presence, residents and visitors. No clock: times come in as nanoseconds of
//! the monotonic clock, negative before the machine's start.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::{
    Event, Observation, PERSONS_MAX, Presence, Quota, ReadName, check_name, is_number, name_words,
};
use roomcast_ipc::raw::{NAME_BYTES, person_flags};
use roomcast_ipc::text;

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

#[derive(Debug, Clone, PartialEq)]
struct Name {
    said: Box<str>,
    read: ReadName,
}

impl Name {
    fn new(said: &str) -> Self {
        Self { said: said.into(), read: ReadName::new(said) }
    }
}

pub(super) use called::Called;

mod called;

/// A known person, without history and forecast.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Known {
    /// As narrators write it.
    name: Option<Name>,
    pub(super) presence: Presence,
    /// The start of this presence.
    pub(super) since_ns: i64,
    /// The newest time of an event.
    pub(super) heard_ns: i64,
    /// The time of the newest action; `i64::MIN` before the first.
    pub(super) did_ns: i64,
    /// The newest event: source, epoch, sequence.
    pub(super) last: EventId,
    /// The time of `last`, which may be late.
    last_ns: i64,
    /// The quota of the narrator that reported the person first.
    quota: u64,
    /// The newest report by a guarded narrator; `i64::MIN` before the first.
    guarded_ns: i64,
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
    fn is_trusted(&self) -> bool {
        self.guarded_ns > i64::MIN
    }

    fn is_asleep(&self, asleep_ns: i64, now_ns: i64) -> bool {
        self.presence == Presence::Present && self.on_bed && now_ns - self.heard_ns > asleep_ns
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
    file: PersonsFile,
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

    /// The number of a name: the number that the home gave it, or the number of the name itself.
    #[must_use]
    pub fn number_of(&self, name: &str) -> PersonId {
        self.number_of_read(&ReadName::new(name))
    }

    fn number_of_read(&self, name: &ReadName) -> PersonId {
        self.known_number(name).unwrap_or_else(|| self.own_number(name))
    }

    /// The number that the home gave to a name, or the number of the name itself.
    fn own_number(&self, name: &ReadName) -> PersonId {
        self.file.given_number(name).unwrap_or_else(|| name.number())
    }

    /// The number of a name that the home knows. "Zoe" is Zoë if no other name differs by accents or signs only.
    fn known_number(&self, name: &ReadName) -> Option<PersonId> {
        let number = self.own_number(name);
        if self.is_number_named(number) || self.lives_here(name) {
            return Some(number);
        }
        self.only_number_where(|known| known.may_be_one(name))
    }

    fn is_number_named(&self, number: PersonId) -> bool {
        self.known.get(&number).is_some_and(|known| known.name.is_some()) || self.file.of_number(number).is_some()
    }

    fn lives_here(&self, name: &ReadName) -> bool {
        self.residents.iter().any(|resident| resident.whole() == name.whole())
    }

    /// The number of all names for which `is_such` holds, if they have the same one.
    fn only_number_where(&self, is_such: impl Fn(&ReadName) -> bool) -> Option<PersonId> {
        // A name that the home gave to a person has that person's number.
        let number = |read: &ReadName, own: PersonId| self.file.given_number(read).unwrap_or(own);
        let named = self.known.iter().filter_map(|(own, known)| Some((*own, &known.name.as_ref()?.read)));
        let residents = self.residents.iter().map(|read| (read.number(), read));
        let all = named.chain(self.file.newest()).chain(residents);
        let mut numbers = all.filter(|(_, read)| is_such(read)).map(|(own, read)| number(read, own));
        numbers.next().filter(|first| numbers.all(|other| other == *first))
    }

    /// The number of a name that the home knows: a resident, a given name, a name from a keyed event, or the first name of one person only.
    pub(super) fn called(&self, name: &str) -> Option<PersonId> {
        let read = ReadName::new(name);
        self.known_number(&read).or_else(|| self.only_number_where(|known| known.first() == Some(read.letters())))
    }

    /// Whether the home knows a name.
    #[must_use]
    pub fn is_name(&self, name: &str) -> bool {
        self.called(name).is_some()
    }

    /// The known person at the start of a text, in whole words; the longest name counts.
    pub(super) fn at_start<'a>(&self, text: &'a str) -> Option<(PersonId, &'a str)> {
        const WORDS_MAX: usize = 4;
        // Nearly all texts; these checks allocate nothing.
        if text.starts_with("They ") || self.all_names().next().is_none() {
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
        if self.not_persons.is_empty() {
            return false;
        }
        let words = name_words(text);
        self.not_persons.iter().any(|name| {
            let name: Vec<&str> = name.letters().split(' ').collect();
            let skips_the = usize::from(words.first().is_some_and(|word| word == "the"));
            !name.is_empty() && words[skips_the..].iter().take(name.len()).eq(name.iter())
        })
    }

    /// A person's name; `None` for a person known by number only.
    #[must_use]
    pub fn name_of(&self, number: PersonId) -> Option<&str> {
        let told = || Some(&*self.known.get(&number)?.name.as_ref()?.said);
        let is_listed =
            |(who, read): &(&String, &ReadName)| who.parse::<u32>().is_err() && self.number_of_read(read) == number;
        let listed = || self.listed().find(is_listed).map(|(who, _)| who.as_str());
        self.file.of_number(number).map(|kept| kept.name.as_str()).or_else(told).or_else(listed)
    }

    /// Whether a person is a visitor. Without a list of residents each person is a resident.
    #[must_use]
    pub fn is_visitor(&self, number: PersonId) -> bool {
        // A renamed resident is still a resident.
        let is_numbered = || self.residents().any(|resident| resident == number);
        let is_listed = || {
            let name = self.name_of(number).map(ReadName::new);
            self.residents.iter().any(|read| name.as_ref().is_some_and(|name| name.whole() == read.whole()))
        };
        let by_list = || !self.residents.is_empty() && !is_numbered() && !is_listed();
        let kept = self.file.of_number(number).and_then(|kept| kept.resident);
        kept.map_or_else(by_list, |resident| !resident)
    }

    /// The residents of the configuration, as written and as read.
    fn listed(&self) -> impl Iterator<Item = (&String, &ReadName)> {
        self.config.residents.iter().zip(&self.residents)
    }

    /// The persons that an event without a name may be about. A named narrator follows only persons that named narrators reported, if there
    /// are any.
    fn candidates(&self, is_unknown: bool) -> impl Iterator<Item = (PersonId, &Known)> {
        let is_all =
            is_unknown || !self.known.values().any(|known| known.is_trusted() && known.presence != Presence::Gone);
        self.iter().filter(move |(_, known)| (is_all || known.is_trusted()) && known.presence != Presence::Gone)
    }

    /// Each person in the house, and each resident: the persons that leave when everybody does.
    pub(super) fn everybody(&self) -> BTreeSet<PersonId> {
        let here = self.iter().filter(|(_, known)| known.presence == Presence::Present).map(|(number, _)| number);
        here.chain(self.residents()).collect()
    }

    /// Whether an event at `at_ns` is too late to count: a newer event contradicts its presence, or is a minute newer. A person that is gone may
    /// be back.
    pub(super) fn is_outdated(&self, observation: &Observation, at_ns: i64) -> bool {
        let differs = |known: &Known| ![Presence::Gone, observation.event.person_presence()].contains(&known.presence);
        let is_old = |known: &Known| at_ns.saturating_add(LATE_NS) < known.heard_ns && known.presence != Presence::Gone;
        self.known
            .get(&observation.person)
            .is_some_and(|known| (at_ns < known.heard_ns && differs(known)) || is_old(known))
    }

    /// Whether an unknown narrator's event about a person at `at_ns` is ignored: a guarded narrator reported the person within `guard_s`.
    pub(super) fn is_guarded(&self, number: PersonId, at_ns: i64) -> bool {
        let guard_ns = (self.config.guard_s * 1e9) as i64;
        guard_ns > 0 && self.known.get(&number).is_some_and(|known| at_ns <= known.guarded_ns.saturating_add(guard_ns))
    }

    pub(super) fn is_anybody_guarded(&self, at_ns: i64) -> bool {
        self.known.keys().any(|number| self.is_guarded(*number, at_ns))
    }

    pub(super) fn is_trusted(&self, number: PersonId) -> bool {
        self.known.get(&number).is_some_and(Known::is_trusted)
    }

    /// The time of an event in the order of its source, although its clock rounds or the network delays.
    pub(super) fn in_order(&self, observation: &Observation, at_ns: i64) -> i64 {
        let Some(known) = self.known.get(&observation.person) else { return at_ns };
        let (last, event) = (known.last, observation.id());
        let is_next = last.start() == event.start() && last.sequence <= event.sequence;
        let is_near = at_ns.saturating_add(ORDER_NS) >= known.last_ns;
        if is_next && is_near { at_ns.max(known.last_ns) } else { at_ns }
    }

    pub(super) fn guard(&mut self, number: PersonId, at_ns: i64) {
        if let Some(known) = self.known.get_mut(&number) {
            known.guarded_ns = known.guarded_ns.max(at_ns);
        }
    }

    /// Takes in an event of a person at `at_ns`. Returns the person that is dropped, if there is one too many.
    pub(super) fn note(&mut self, observation: &Observation, quota: Quota, at_ns: i64) -> Option<PersonId> {
        let number = observation.person;
        // A person that comes back starts afresh.
        if observation.event != Event::Gone && self.known.get(&number).is_some_and(|own| own.presence == Presence::Gone)
        {
            self.known.remove(&number);
        }
        let is_full = self.known.len() >= PERSONS_MAX && !self.known.contains_key(&number);
        let dropped = if is_full { self.least_missed(quota.number) } else { None };
        dropped.map(|dropped| self.known.remove(&dropped));
        let name = observation.name.as_deref().map(Name::new).map(|name| self.spelled(number, name));
        let known = self.known.entry(number).or_insert_with(|| Known {
            name: None,
            presence: Presence::Unknown,
            since_ns: at_ns,
            heard_ns: at_ns,
            did_ns: i64::MIN,
            last: EventId::new(0, 0, 0),
            last_ns: at_ns,
            quota: quota.number,
            guarded_ns: i64::MIN,
            by_fit: false,
            on_bed: false,
            restored: false,
            told: false,
        });
        if name.is_some() {
            known.name = name;
        }
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

    /// The spelling of a person's name: a resident's as in the configuration, any other as its first narrator wrote it.
    fn spelled(&self, number: PersonId, name: Name) -> Name {
        let mut residents = self.listed();
        let is_resident = |read: &ReadName| {
            read.whole() == name.read.whole() || read.may_be_one(&name.read) && self.own_number(read) == number
        };
        if let Some((who, read)) = residents.find(|(_, read)| is_resident(read)) {
            return Name { said: who.as_str().into(), read: read.clone() };
        }
        // Of two spellings the first one counts.
        let known = self.known.get(&number).and_then(|known| known.name.as_ref());
        known.filter(|known| known.read.may_be_one(&name.read)).cloned().unwrap_or(name)
    }

    /// A person on a bed is probably asleep after this silence.
    fn asleep_ns(&self) -> i64 {
        (self.config.asleep_s * 1e9) as i64
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
            let sleeps = known.presence == Presence::Present && known.on_bed;
            now_ns - known.heard_ns > if sleeps { visitor_ns.max(NIGHT_NS) } else { visitor_ns }
        };
        self.known.get(&number).is_some_and(expires) && self.is_visitor(number)
    }

    pub(super) fn nobody_is_home(&self) -> bool {
        self.are_all_away() && !self.misses_residents()
    }

    /// Whether all known persons are away, and a resident was never observed.
    pub(super) fn is_anybodys_guess(&self) -> bool {
        self.are_all_away() && self.misses_residents()
    }

    fn are_all_away(&self) -> bool {
        let (known, present) = self.count();
        known > 0 && present == 0
    }

    pub(super) fn misses_residents(&self) -> bool {
        self.residents().any(|number| !self.known.contains_key(&number))
    }

    fn residents(&self) -> impl Iterator<Item = PersonId> {
        self.listed().map(|(who, read)| who.parse().unwrap_or_else(|_| self.number_of_read(read)))
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
    #[must_use]
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
        let next = move |last: Option<_>| {
            self.candidates(is_unknown).map(rank).filter(|own| last.as_ref().is_none_or(|last| own > last)).min()
        };
        let known = std::iter::successors(next(None), move |last| next(Some(*last))).map(|(.., number)| number);
        let is_gone = |number: PersonId| self.known.get(&number).is_none_or(|known| known.presence == Presence::Gone);
        let invented = if self.residents.is_empty() { 2 * PERSONS_MAX as u32 } else { 0 };
        let further = self.residents().chain((0..invented).map(PersonId));
        known.chain(further.filter(move |number| is_gone(*number)))
    }

    pub(super) fn has_residents(&self) -> bool {
        !self.config.residents.is_empty()
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

    fn all_names(&self) -> impl Iterator<Item = &str> {
        let kept = self.file.persons().iter().flat_map(KeptPerson::names);
        let known = self.known.values().filter_map(|known| Some(&*known.name.as_ref()?.said));
        kept.chain(known).chain(self.config.residents.iter().map(String::as_str))
    }

    pub(super) fn names_of(&self, number: PersonId) -> Vec<String> {
        let kept = self.file.of_number(number).into_iter().flat_map(KeptPerson::names);
        kept.chain(self.name_of(number)).map(str::to_lowercase).collect()
    }

    /// The known person of a name or number.
    #[must_use]
    pub fn find(&self, who: &str) -> Option<PersonId> {
        let number = self.meant(who);
        (self.known.contains_key(&number) || self.file.of_number(number).is_some()).then_some(number)
    }

    /// Whether a name or number is a resident's without an event yet.
    pub(super) fn is_awaited(&self, who: &str) -> bool {
        let number = self.meant(who);
        self.find(who).is_none() && self.residents().any(|resident| resident == number)
    }

    /// Gives a person a name that outlives restarts.
    ///
    /// # Errors
    /// If the name is wrong, belongs to another person, or cannot be stored.
    pub(super) fn rename(&mut self, number: PersonId, name: &str) -> Result<(), NotRenamed> {
        let name = name.trim();
        check_name(name).map_err(NotRenamed::Refused)?;
        let owner = self.number_of(name);
        let known = self.known.contains_key(&owner) || self.file.of_number(owner).is_some();
        if owner != number && known {
            let reason = format!("{name} is person {owner} already: forget that one first, or choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        // One resident cannot take the name of another.
        let is_resident = |number| self.residents().any(|resident| resident == number);
        if owner != number && self.lives_here(&ReadName::new(name)) && is_resident(number) {
            let own = self.name_of(number).unwrap_or("this person");
            let reason = format!("{name} and {own} both live here by persons.residents: choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        // Narrators may go on with the old name.
        let own = || self.name_of(number).unwrap_or(name).to_owned();
        let former = self.file.of_number(number).cloned();
        let former = former.unwrap_or_else(|| KeptPerson { number, name: own(), resident: None, former: Vec::new() });
        self.file.put(former.renamed(name)).map_err(|error| {
            NotRenamed::Failed(format!("the persons file cannot be written: {error}; nothing was changed"))
        })
    }

    /// The names that the home gave.
    pub fn file(&self) -> &PersonsFile {
        &self.file
    }

    pub(super) fn file_mut(&mut self) -> &mut PersonsFile {
        &mut self.file
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
        let flag = |holds: bool, flag: u32| if holds { flag } else { 0 };
        flag(known.restored, person_flags::RESTORED)
            | flag(known.is_asleep(self.asleep_ns(), now_ns), person_flags::ASLEEP)
            | flag(known.by_fit, person_flags::BY_FIT)
            | flag(self.is_visitor(number), person_flags::VISITOR)
    }

    pub(super) fn name_bytes(&self, number: PersonId) -> [u8; NAME_BYTES] {
        text::encode_cut(self.name_of(number).unwrap_or_default())
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

pub(super) fn presence_value(of: Presence) -> u32 {
    of as u32
}

/// A time in messages: 0 before the machine's start.
pub(super) fn message_ns(at_ns: i64) -> u64 {
    at_ns.try_into().unwrap_or_default()
}

#[cfg(test)]
mod tests;
