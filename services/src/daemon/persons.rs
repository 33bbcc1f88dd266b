//! Who is who, and who is in the house: names and numbers, presence, residents and visitors. No clock: times come in as nanoseconds of
//! the monotonic clock, negative before the machine's start.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

use roomcast_core::narration::{
    About, Observation, PERSONS_MAX, Presence, PresenceStatement, Pronoun, ReadName, SOMEBODY, Said, Voice, check_name,
    is_number, same_name,
};
use roomcast_core::text::has_words;
use roomcast_ipc::{NAME_BYTES, person_flags, presence, text};

use super::person_question::PersonLine;
use super::persons_file::{KeptPerson, PersonsFile};
use crate::config::PersonsConfig;

/// A visitor on a bed is not gone before so long a silence: a night's sleep.
const NIGHT_NS: i64 = 12 * 3_600_000_000_000;

/// What was observed so long before the newest observation of its person says nothing of where they are, nor of what they do next.
const LATE_NS: i64 = 60_000_000_000;

/// Times of one source that are out of its order by no more are the errors of its clock, or of the way that they came.
const ORDER_NS: i64 = 100_000_000;

/// So long "he" and "she" mean whom their source told of last by name.
const PRONOUN_NS: i64 = 60_000_000_000;
/// So long whoever was last at the front door is taken for who leaves.
const DOOR_NS: i64 = 900_000_000_000;
/// Of so many sources it is known whom they told of last.
const TOLD_OF_MAX: usize = 64;

/// Words of things that people sleep on.
const BEDS: [&str; 8] = ["bed", "beds", "mattress", "crib", "cot", "bunk", "futon", "bassinet"];

/// Whether people sleep on a thing of this label.
pub(super) fn is_bed(label: &str) -> bool {
    label.split(' ').next_back().is_some_and(|word| BEDS.contains(&word))
}

/// Whether a sentence says that somebody sleeps, or that they no longer do; none where it says neither.
pub(super) fn sleeps(sentence: &str) -> Option<bool> {
    const SLEEPS: [&str; 8] = ["sleep", "sleeps", "asleep", "nap", "naps", "doze", "dozes", "slept"];
    const WAKES: [&str; 8] = ["wake", "wakes", "woke", "awake", "get up", "gets up", "stand up", "stands up"];
    let says = |words: &[&str]| words.iter().any(|words| has_words(sentence, words));
    if says(&WAKES) { Some(false) } else { says(&SLEEPS).then_some(true) }
}

/// A person's name, and how it is compared with others.
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

/// What is known of a person beside their narration and where they will be.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Known {
    /// As narrators call them.
    name: Option<Name>,
    pub(super) presence: Presence,
    /// Since when that holds.
    pub(super) since_ns: i64,
    /// When they were observed last.
    pub(super) heard_ns: i64,
    /// The same of what they did; the least number where nothing is known of that.
    pub(super) did_ns: i64,
    /// What was observed last: source, epoch, sequence.
    pub(super) last: (u64, u64, u64),
    /// When that was, by its own time.
    last_ns: i64,
    /// The number of the voice that told of them first.
    voice: u64,
    /// When one told of them whose word is guarded; the least number where none did.
    guarded_ns: i64,
    /// When they were last observed at a door of the house; the least number where they never were.
    door_ns: i64,
    /// How often they were called "she" more than "he"; below zero where it is the other way round.
    she: i8,
    /// It named nobody.
    by_fit: bool,
    /// The last thing mentioned is one to sleep on, or they were said to sleep.
    pub(super) on_bed: bool,
    /// Everything is from before the daemon's start.
    pub(super) restored: bool,
    /// Scores were told since they were observed last.
    pub(super) told: bool,
}

impl Known {
    /// Whether one has told of them whose word is guarded.
    fn is_trusted(&self) -> bool {
        self.guarded_ns > i64::MIN
    }

    /// Whether they are called by a pronoun, as far as is known; none where nothing is.
    fn is_called_by(&self, pronoun: Pronoun) -> Option<bool> {
        (self.she != 0).then_some((self.she > 0) == (pronoun == Pronoun::She))
    }

    fn is_asleep(&self, asleep_ns: i64, now_ns: i64) -> bool {
        self.presence == Presence::Present && self.on_bed && now_ns - self.heard_ns > asleep_ns
    }
}

/// Whether somebody can do without getting up what a sentence says.
pub(super) fn may_be_done_lying(sentence: &str) -> bool {
    const UPRIGHT: [&str; 44] = [
        "walk", "walks", "go", "goes", "run", "runs", "stand", "stands", "sit", "sits", "open", "opens", "close",
        "closes", "cook", "cooks", "wash", "washes", "wipe", "wipes", "clean", "cleans", "sweep", "sweeps", "mop",
        "mops", "dress", "dresses", "put on", "puts on", "shower", "showers", "enter", "enters", "leave", "leaves",
        "climb", "climbs", "fold", "folds", "make", "makes", "pour", "pours",
    ];
    !UPRIGHT.iter().any(|words| has_words(sentence, words))
}

/// Whether a sentence is about the door of the house.
pub(super) fn is_at_front_door(sentence: &str) -> bool {
    const DOORS: [&str; 6] = ["front door", "entrance door", "main door", "house door", "apartment door", "doorbell"];
    DOORS.iter().any(|words| has_words(sentence, words))
}

/// Whether a sentence may be about it: also about a door, and not that of a thing.
fn is_at_a_door(sentence: &str) -> bool {
    const HOW: [&str; 5] = ["opens the door", "closes the door", "open the door", "close the door", "the door is"];
    let is_of_a_thing = || ["door of", "door to"].iter().any(|words| has_words(sentence, words));
    is_at_front_door(sentence) || (HOW.iter().any(|words| has_words(sentence, words)) && !is_of_a_thing())
}

/// Who told of somebody by name: whether that was a stranger, and the source, which goes on with what it said before it was started again. What
/// strangers say is kept apart.
pub(super) type Teller = (bool, u64);

/// Whom a source told of by name.
#[derive(Debug, Clone, PartialEq)]
struct ToldOf {
    teller: Teller,
    /// Who did something, or the last of several.
    person: u32,
    /// Who else was told of in the same narration: "Ada hugs Ben."
    beside: Vec<u32>,
    /// Its epoch and sequence.
    told: (u64, u64),
    at_ns: i64,
}

/// Why somebody has no other name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NotRenamed {
    /// Nobody can have that name, or somebody else has it.
    #[error("{0}")]
    Refused(String),
    /// The name cannot be kept, whatever it is.
    #[error("{0}")]
    Failed(String),
}

/// All persons that the daemon knows.
#[derive(Debug, Default, Clone)]
pub struct Persons {
    config: PersonsConfig,
    /// The configuration's names, read.
    residents: Vec<ReadName>,
    not_persons: Vec<ReadName>,
    file: PersonsFile,
    known: BTreeMap<u32, Known>,
    /// Whom sources told of by name last; newest last.
    told_of: VecDeque<ToldOf>,
}

impl Persons {
    /// Nobody yet; `file` says which names are whose.
    #[must_use]
    pub fn new(config: PersonsConfig, file: PersonsFile) -> Self {
        let read = |names: &[String]| names.iter().map(|name| ReadName::new(name)).collect();
        let (residents, not_persons) = (read(&config.residents), read(&config.not_persons));
        Self { config, residents, not_persons, file, known: BTreeMap::new(), told_of: VecDeque::new() }
    }

    /// Persons by number, who are gone too, until they were told.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u32, &Known)> {
        self.known.iter().map(|(number, known)| (*number, known))
    }

    /// A person.
    pub(super) fn get(&self, number: u32) -> Option<&Known> {
        self.known.get(&number)
    }

    /// A person, to be changed.
    pub(super) fn get_mut(&mut self, number: u32) -> Option<&mut Known> {
        self.known.get_mut(&number)
    }

    /// The number of a name: the one that the home gave it, or the one that follows from the name.
    #[must_use]
    pub fn number_of(&self, name: &str) -> u32 {
        self.number_of_read(&ReadName::new(name))
    }

    fn number_of_read(&self, name: &ReadName) -> u32 {
        let number = self.file.given_number(name).unwrap_or_else(|| name.number());
        if self.is_number_named(number) || self.lives_here(name) {
            return number;
        }
        let mut alike = self.alike(name).into_iter();
        alike.next().filter(|_| alike.next().is_none()).unwrap_or(number)
    }

    /// Whether somebody of a number is known by name.
    fn is_number_named(&self, number: u32) -> bool {
        self.known.get(&number).is_some_and(|known| known.name.is_some()) || self.file.of_number(number).is_some()
    }

    fn lives_here(&self, name: &ReadName) -> bool {
        self.residents.iter().any(|resident| resident.whole() == name.whole())
    }

    /// Whose name differs by accents or a title alone: "Zoe" is Zoë, "Mrs. Novak" is Novak, and "Grandma Edith" Edith.
    fn alike(&self, name: &ReadName) -> BTreeSet<u32> {
        self.numbers_where(name, |known| known.may_be_one(name))
    }

    /// The numbers of those whose names are such, of all that may be meant by `name`.
    fn numbers_where(&self, name: &ReadName, is_such: impl Fn(&ReadName) -> bool) -> BTreeSet<u32> {
        // Whoever is known by a name has the number that they are known by, unless the home gave the name to somebody.
        let number = |read: &ReadName, own: u32| self.file.given_number(read).unwrap_or(own);
        let named = self.known.iter().filter_map(|(own, known)| Some((*own, &known.name.as_ref()?.read)));
        let residents = self.residents.iter().map(|read| (read.number(), read));
        let all = named.chain(self.file.sharing(name)).chain(residents);
        all.filter(|(_, read)| is_such(read)).map(|(own, read)| number(read, own)).collect()
    }

    /// Whose first name it is, of those who go by a longer one.
    fn first_named(&self, name: &ReadName) -> BTreeSet<u32> {
        let is_short = !name.whole().contains(' ');
        self.numbers_where(name, |known| is_short && known.whole().contains(' ') && known.may_be_called(name))
    }

    /// The number of whom a sentence calls by a name: also of the one person whose first name it is. None where it may be several.
    fn called(&self, name: &str) -> Option<u32> {
        let read = ReadName::new(name);
        if self.is_read_known(&read) {
            return Some(self.number_of_read(&read));
        }
        let guests = if Said::is_guest(name) { self.guests() } else { BTreeSet::new() };
        let mut numbers = self.alike(&read).into_iter().chain(self.first_named(&read)).chain(guests);
        let number = numbers.next().unwrap_or_else(|| self.number_of_read(&read));
        numbers.next().is_none().then_some(number)
    }

    /// By which name the one person is known of whose longer one nobody has told: "jonas" where a sentence says "jonas müller".
    fn known_for_short<'a>(&self, name: &'a str) -> Option<&'a str> {
        let is_whole_of = |first: &ReadName, known: &ReadName| !known.whole().contains(' ') && known.may_be_one(first);
        let is_of_one = |first: &&str| {
            let first = ReadName::new(first);
            self.numbers_where(&first, |known| is_whole_of(&first, known)).len() == 1
        };
        Said::first_name(name).filter(|_| !self.is_called(name)).filter(is_of_one)
    }

    /// Those who are known, do not live here and have a name: "the guest" is one of them.
    fn guests(&self) -> BTreeSet<u32> {
        let is_guest = |(number, known): &(u32, &Known)| known.presence != Presence::Gone && self.is_visitor(*number);
        let named = self.iter().filter(|(_, known)| known.name.is_some());
        named.filter(is_guest).map(|(number, _)| number).collect()
    }

    /// Whether a sentence may call somebody so who is known, has the name here, or lives here.
    pub(super) fn is_called(&self, name: &str) -> bool {
        let read = ReadName::new(name);
        self.is_read_known(&read)
            || !self.alike(&read).is_empty()
            || !self.first_named(&read).is_empty()
            || Said::is_guest(name) && !self.guests().is_empty()
    }

    /// A person's name; none where only a number is known.
    #[must_use]
    pub fn name_of(&self, number: u32) -> Option<&str> {
        let told = || Some(&*self.known.get(&number)?.name.as_ref()?.said);
        let is_listed = |who: &&String| who.parse::<u32>().is_err() && self.number_of(who) == number;
        let listed = || self.config.residents.iter().find(is_listed).map(String::as_str);
        self.file.of_number(number).map(|kept| kept.name.as_str()).or_else(told).or_else(listed)
    }

    /// Whether a person is not of the household. Without a list of residents everybody is of it.
    #[must_use]
    pub fn is_visitor(&self, number: u32) -> bool {
        let name = self.name_of(number).map(ReadName::new);
        let listed = |(resident, read): (&String, &ReadName)| {
            name.as_ref().is_some_and(|name| name.whole() == read.whole())
                // A resident who was given another name is still one.
                || resident.parse().unwrap_or_else(|_| self.number_of(resident)) == number
        };
        let residents = || self.config.residents.iter().zip(&self.residents);
        let by_list = || !self.config.residents.is_empty() && !residents().any(listed);
        let kept = self.file.of_number(number).and_then(|kept| kept.resident);
        kept.map_or_else(by_list, |resident| !resident)
    }

    /// The observations of persons that one stands for: itself; where it is of everybody, one of each who lives here or is in the house; where
    /// it names several, one of each; none where it says that nobody is in a room.
    pub(super) fn each(&self, observation: Observation, is_strange: bool) -> impl Iterator<Item = Observation> + use<> {
        let is_open = observation.person == SOMEBODY && observation.name.is_none();
        let names = if is_open { self.named(&observation.said) } else { Vec::new() };
        let statement = match &observation.said {
            Said::Presence(statement) => Some(statement),
            Said::Sentence(_) => None,
        };
        let of_nobody = statement.is_some_and(|statement| statement.empty_room().is_some());
        let of_group = statement.filter(|statement| is_open && statement.is_of_everybody() && !of_nobody);
        let (mut others, mut of_named) = (Vec::new(), None);
        // "Both Ada and Ben go to bed" has names.
        let so_many = observation.said.is_of_so_many().filter(|_| names.len() < 2);
        if is_open && (so_many.is_some() || observation.said.is_of_guests()) {
            let said = match statement.and_then(PresenceStatement::of_others) {
                Some(said) => Said::Presence(said),
                None => observation.said.clone(),
            };
            let meant = match so_many {
                Some(count) => self.so_many(count, &observation.said, is_strange),
                None => self.guests_meant(&said, is_strange),
            };
            let each =
                meant.into_iter().map(|person| Observation { person, said: said.clone(), ..observation.clone() });
            others.extend(each);
            return None.into_iter().chain(others);
        }
        if is_open && observation.said.is_of_all() {
            let candidates = self.candidates(is_strange).into_iter();
            let here = candidates.filter(|(_, known)| known.presence == Presence::Present);
            others.extend(here.map(|(person, _)| Observation { person, ..observation.clone() }));
            return None.into_iter().chain(others);
        }
        // Who is not understood may be anybody.
        let is_understood = |statement: &PresenceStatement| {
            statement
                .names()
                .chain(statement.excepted())
                .all(|name| self.is_no_person(name) || self.is_called(name) && self.called(name).is_some())
        };
        if of_group.is_some_and(|statement| !is_understood(statement)) {
            return None.into_iter().chain(others);
        }
        if let Some(statement) = of_group {
            let not_meant: Vec<u32> = names
                .iter()
                .map(String::as_str)
                .chain(statement.excepted())
                .filter_map(|name| self.called(name))
                .collect();
            of_named = statement.of_named().map(Said::Presence);
            if let Some(said) = statement.of_others() {
                let whose = self.meant_by_everybody(&said).into_iter().filter(|number| !not_meant.contains(number));
                let said = Said::Presence(said);
                others.extend(whose.map(|person| Observation { person, said: said.clone(), ..observation.clone() }));
            }
        }
        // Where nobody is known, it is of the one whom it fits.
        let is_group = of_group.is_some_and(|statement| !others.is_empty() || statement.subject().is_some());
        let of_name = |name: &String| {
            let said = of_named.clone().unwrap_or_else(|| observation.said.clone());
            Observation { name: Some(name.as_str().into()), said, ..observation.clone() }
        };
        let is_several = is_group || names.len() > 1;
        others.extend(names.iter().filter(|_| is_several).map(of_name));
        (!is_several && !of_nobody).then_some(observation).into_iter().chain(others)
    }

    /// A visitor who goes home leaves this house.
    pub(super) fn see_off(&self, observation: &mut Observation) {
        if self.is_visitor(observation.person)
            && observation.said.goes_home()
            && let Ok(away) = PresenceStatement::new(Presence::Away, None)
        {
            observation.said = Said::Presence(away);
        }
    }

    /// Those whom a number means, as "both" does: who is in the house, or, of who comes home, who is away; nobody where these are not so many. For a
    /// named narrator of those alone of whom one has told.
    fn so_many(&self, count: usize, said: &Said, is_strange: bool) -> Vec<u32> {
        let is_arrival = |sentence: &str| {
            PresenceStatement::of_sentence(sentence)
                .is_some_and(|statement| statement.is_of_so_many().is_some() && statement.room().is_none())
        };
        let comes = match said {
            Said::Sentence(sentence) => is_arrival(sentence.as_str()),
            Said::Presence(statement) => statement.presence() == Presence::Present && statement.room().is_none(),
        };
        let candidates = self.candidates(is_strange);
        let of = |is_meant: &dyn Fn(Presence) -> bool| {
            let meant = candidates.iter().filter(|(_, known)| is_meant(known.presence));
            let found: Vec<u32> = meant.map(|(number, _)| *number).collect();
            Some(found).filter(|found| found.len() == count)
        };
        let found = match comes {
            true => of(&|presence| presence == Presence::Away).or_else(|| of(&|presence| presence != Presence::Gone)),
            false => of(&|presence| presence == Presence::Present),
        };
        found.unwrap_or_default()
    }

    /// Those whom "the guests" means: who does not live here and is in the house, or, of who comes, was.
    fn guests_meant(&self, said: &Said, is_strange: bool) -> Vec<u32> {
        let comes = matches!(said, Said::Presence(statement)
            if statement.presence() == Presence::Present && statement.room().is_none());
        let is_meant = |presence: Presence| match presence {
            Presence::Present => true,
            Presence::Away => comes,
            Presence::Gone | Presence::Unknown => false,
        };
        let candidates = self.candidates(is_strange).into_iter();
        let meant = candidates.filter(|(number, known)| is_meant(known.presence) && self.is_visitor(*number));
        meant.map(|(number, _)| number).collect()
    }

    /// Whom an observation that names nobody may be of: for a named narrator, who does not follow what strangers invent, only those of whom one
    /// has told, if there are any.
    fn candidates(&self, is_strange: bool) -> Vec<(u32, &Known)> {
        let is_all =
            is_strange || !self.known.values().any(|known| known.is_trusted() && known.presence != Presence::Gone);
        self.iter().filter(|(_, known)| is_all || known.is_trusted()).collect()
    }

    /// Whether more than one whom an observation may be of is away: whose arrival nobody names, is not known then.
    pub(super) fn are_several_away(&self, is_strange: bool) -> bool {
        self.candidates(is_strange).iter().filter(|(_, known)| known.presence == Presence::Away).nth(1).is_some()
    }

    /// Whether anybody whom an observation may be of is in the house.
    pub(super) fn is_anybody_here(&self, is_strange: bool) -> bool {
        self.candidates(is_strange).iter().any(|(_, known)| known.presence == Presence::Present)
    }

    /// Whom a statement of everybody is about, other than those whom it names: of who is somewhere in the house those who are in it, and who lives
    /// here and was never observed; else who lives here, and who is away where it says that they are back.
    fn meant_by_everybody(&self, statement: &PresenceStatement) -> BTreeSet<u32> {
        let has_room = statement.room().is_some();
        let comes = statement.presence() == Presence::Present && !has_room;
        let meant = |known: &Known| known.presence == Presence::Present || comes && known.presence == Presence::Away;
        let here = self.iter().filter(|(_, known)| meant(known)).map(|(number, _)| number);
        let live_here = self.residents().filter(|number| !has_room || !self.known.contains_key(number));
        here.chain(live_here).collect()
    }

    /// Whether an observation that was made at `at_ns` arrives so late that it says nothing any more: after a later one that says otherwise of
    /// whether its person is in the house, or a minute after what is known of them. Who is gone may be back.
    pub(super) fn is_outdated(&self, observation: &Observation, at_ns: i64) -> bool {
        let differs = |known: &Known| ![Presence::Gone, observation.said.presence()].contains(&known.presence);
        let is_old = |known: &Known| at_ns.saturating_add(LATE_NS) < known.heard_ns && known.presence != Presence::Gone;
        self.known
            .get(&observation.person)
            .is_some_and(|known| (at_ns < known.heard_ns && differs(known)) || is_old(known))
    }

    /// Whether what a stranger says of a person at `at_ns` is passed over: somebody who is guarded has told of them a moment before, or since.
    pub(super) fn is_guarded(&self, number: u32, at_ns: i64) -> bool {
        let guard_ns = (self.config.guard_s * 1e9) as i64;
        guard_ns > 0 && self.known.get(&number).is_some_and(|known| at_ns <= known.guarded_ns.saturating_add(guard_ns))
    }

    /// The same of anybody.
    pub(super) fn is_anybody_guarded(&self, at_ns: i64) -> bool {
        self.known.keys().any(|number| self.is_guarded(*number, at_ns))
    }

    /// Whether one has told of a person whose word is guarded.
    pub(super) fn is_trusted(&self, number: u32) -> bool {
        self.known.get(&number).is_some_and(Known::is_trusted)
    }

    /// When an observation was made, of which its time says `at_ns`: what one source says goes in its order, however its times were rounded or came
    /// over a network.
    pub(super) fn in_order(&self, observation: &Observation, at_ns: i64) -> i64 {
        let Some(known) = self.known.get(&observation.person) else { return at_ns };
        let (source, epoch, sequence) = known.last;
        let is_next = (source, epoch) == (observation.source, observation.epoch) && sequence <= observation.sequence;
        let is_near = at_ns.saturating_add(ORDER_NS) >= known.last_ns;
        if is_next && is_near { at_ns.max(known.last_ns) } else { at_ns }
    }

    /// Takes note that one has told of a person whose word is guarded.
    pub(super) fn guard(&mut self, number: u32, at_ns: i64) {
        if let Some(known) = self.known.get_mut(&number) {
            known.guarded_ns = known.guarded_ns.max(at_ns);
        }
    }

    /// Takes in an observation of a person that was made at `at_ns`; gives who has to make room for them, if they are one too many.
    pub(super) fn note(&mut self, observation: &Observation, voice: Voice, at_ns: i64) -> Option<u32> {
        let number = observation.person;
        // Who comes back is known afresh, whether or not it was told meanwhile that they were gone.
        let is_back =
            |known: &&Known| known.presence == Presence::Gone && observation.said.presence() != Presence::Gone;
        if self.known.get(&number).filter(is_back).is_some() {
            self.known.remove(&number);
        }
        let full = self.known.len() >= PERSONS_MAX && !self.known.contains_key(&number);
        let dropped = if full { self.least_missed(voice.number) } else { None };
        if let Some(dropped) = dropped {
            self.known.remove(&dropped);
        }
        let name = observation.name.as_deref().map(Name::new).map(|name| self.spelled(number, name));
        let known = self.known.entry(number).or_insert_with(|| Known {
            name: None,
            presence: Presence::Unknown,
            since_ns: at_ns,
            heard_ns: at_ns,
            did_ns: i64::MIN,
            last: (0, 0, 0),
            last_ns: at_ns,
            voice: voice.number,
            guarded_ns: i64::MIN,
            door_ns: i64::MIN,
            she: 0,
            by_fit: false,
            on_bed: false,
            restored: false,
            told: false,
        });
        if name.is_some() {
            known.name = name;
        }
        if let Said::Sentence(sentence) = &observation.said {
            known.did_ns = at_ns.max(known.did_ns);
            if is_at_a_door(sentence.as_str()) {
                known.door_ns = at_ns.max(known.door_ns);
            }
        }
        known.last_ns = at_ns;
        // What arrives late does not turn back time.
        let at_ns = at_ns.max(known.heard_ns);
        let presence = observation.said.presence();
        (known.heard_ns, known.by_fit, known.restored, known.told) = (at_ns, observation.by_fit, false, false);
        known.last = (observation.source, observation.epoch, observation.sequence);
        if known.presence != presence {
            (known.presence, known.since_ns) = (presence, at_ns);
        }
        known.on_bed &= presence == Presence::Present;
        dropped
    }

    /// A person's name as it is written from now on: who lives here as the home writes them; others as they were called first, but for case.
    fn spelled(&self, number: u32, name: Name) -> Name {
        let mut residents = self.config.residents.iter().zip(&self.residents);
        let own_number = |read: &ReadName| self.file.given_number(read).unwrap_or(read.number());
        let is_resident = |read: &ReadName| {
            read.whole() == name.read.whole() || read.may_be_one(&name.read) && own_number(read) == number
        };
        if let Some((who, read)) = residents.find(|(_, read)| is_resident(read)) {
            return Name { said: who.as_str().into(), read: read.clone() };
        }
        let known = self.known.get(&number).and_then(|known| known.name.as_ref());
        let is_other = |known: &&Name| known.read.whole() != name.read.whole() && known.read.may_be_one(&name.read);
        known.filter(is_other).cloned().unwrap_or(name)
    }

    /// Whoever was last on a bed is possibly asleep after this silence.
    fn asleep_ns(&self) -> i64 {
        (self.config.asleep_s * 1e9) as i64
    }

    /// Who is dropped first, where `newcomer` tells of one more: visitors before residents, of them those of the voice that tells of most
    /// persons, of these who was silent for longest. So a narrator that invents persons pushes out its own.
    fn least_missed(&self, newcomer: u64) -> Option<u32> {
        let told = |voice: u64| {
            self.known.values().filter(|known| known.voice == voice).count() + usize::from(voice == newcomer)
        };
        let rank =
            |(number, known): &(u32, &Known)| (!self.is_visitor(*number), Reverse(told(known.voice)), known.heard_ns);
        self.iter().min_by_key(rank).map(|(number, _)| number)
    }

    /// Forgets a person; gives whether they were known.
    pub(super) fn remove(&mut self, number: u32) -> bool {
        self.told_of.retain(|told| told.person != number);
        self.told_of.iter_mut().for_each(|told| told.beside.retain(|other| *other != number));
        self.known.remove(&number).is_some()
    }

    /// Forgets whoever is gone, once that was told.
    pub(super) fn remove_gone(&mut self) {
        self.known.retain(|_, known| known.presence != Presence::Gone || !known.told);
    }

    /// Whether a person is a visitor who was silent for so long that they are gone.
    pub(super) fn has_expired(&self, number: u32, now_ns: i64) -> bool {
        let visitor_ns = (self.config.visitor_s * 1e9) as i64;
        let expires = |known: &Known| {
            let sleeps = known.presence == Presence::Present && known.on_bed;
            now_ns - known.heard_ns > if sleeps { visitor_ns.max(NIGHT_NS) } else { visitor_ns }
        };
        self.known.get(&number).is_some_and(expires) && self.is_visitor(number)
    }

    /// Whether everybody who is known or lives here is away.
    pub(super) fn nobody_is_home(&self) -> bool {
        self.are_all_away() && !self.misses_residents()
    }

    /// Whether all who are known are away, and of somebody who lives here nothing was observed.
    pub(super) fn is_anybodys_guess(&self) -> bool {
        self.are_all_away() && self.misses_residents()
    }

    fn are_all_away(&self) -> bool {
        let (known, present) = self.count();
        known > 0 && present == 0
    }

    /// Whether of somebody who lives here nothing was observed.
    pub(super) fn misses_residents(&self) -> bool {
        self.residents().any(|number| !self.known.contains_key(&number))
    }

    /// The numbers of the residents that the configuration lists.
    fn residents(&self) -> impl Iterator<Item = u32> {
        self.config.residents.iter().map(|who| who.parse().unwrap_or_else(|_| self.number_of(who)))
    }

    /// The next visitor who is gone by silence.
    pub(super) fn expired(&self, now_ns: i64) -> Option<u32> {
        let here = self.iter().filter(|(_, known)| known.presence != Presence::Gone);
        here.map(|(number, _)| number).find(|number| self.has_expired(*number, now_ns))
    }

    /// Lets a visitor be gone.
    pub(super) fn expire(&mut self, number: u32, now_ns: i64) {
        if let Some(known) = self.known.get_mut(&number) {
            (known.presence, known.since_ns, known.on_bed, known.told) = (Presence::Gone, now_ns, false, false);
        }
    }

    /// How many persons are known, and how many of them are in the house.
    #[must_use]
    pub(super) fn count(&self) -> (usize, usize) {
        let of = |presence: Presence| self.known.values().filter(|known| known.presence == presence).count();
        (self.known.len() - of(Presence::Gone), of(Presence::Present))
    }

    /// Whom an observation that names nobody fits best: of those in the house, for whom `fit` is greatest; where that does not tell, who
    /// was observed last. Who leaves, or is at the door, is awake and not in bed, if anybody is, and was at the door last, or is nearest to it. With
    /// nobody in the house, whoever is away for longest is back; where nobody is known at all it is the first of the residents, or person 0.
    pub(super) fn fitting(&self, said: &Said, now_ns: i64, is_strange: bool, mut fit: impl FnMut(u32) -> f64) -> u32 {
        /// What having been at the door last counts beside being near it.
        const AT_THE_DOOR: f64 = 1.0;
        let leaves = said.presence() != Presence::Present;
        let is_out = leaves || said.sentence().is_some_and(|sentence| is_at_front_door(sentence.as_str()));
        // Who comes home is none of those who are there.
        let comes = said.sentence().is_some_and(|sentence| PresenceStatement::is_arrival(sentence.as_str()));
        let mut candidates = self.candidates(is_strange);
        // Who is called "she" is not "he", if anybody else is there.
        if let Some(pronoun) = said.pronoun() {
            let rank = |known: &Known| known.is_called_by(pronoun).map_or(1, |is_so| if is_so { 2 } else { 0 });
            let here = candidates.iter().filter(|(_, known)| known.presence == Presence::Present);
            let best = here.map(|(_, known)| rank(known)).max().unwrap_or_default();
            candidates.retain(|(_, known)| known.presence != Presence::Present || rank(known) == best);
        }
        let present = candidates.iter().filter(|(_, known)| known.presence == Presence::Present);
        let at_door =
            |known: &Known| known.door_ns > i64::MIN && (0..=DOOR_NS).contains(&now_ns.saturating_sub(known.door_ns));
        let last_door = present.clone().filter(|(_, known)| at_door(known)).map(|(_, known)| known.door_ns).max();
        let ranked = present.map(|(number, known)| {
            let is_last = last_door.is_some_and(|last_ns| last_ns == known.door_ns);
            let own = fit(*number) + if leaves && is_last { AT_THE_DOOR } else { 0.0 };
            let awake = !(is_out && known.is_asleep(self.asleep_ns(), now_ns));
            (own, (awake, !(is_out && known.on_bed)), known.heard_ns, Reverse(*number))
        });
        let best =
            ranked.max_by(|a, b| a.1.cmp(&b.1).then(a.0.total_cmp(&b.0)).then_with(|| (a.2, a.3).cmp(&(b.2, b.3))));
        let away = || candidates.iter().filter(|(_, known)| known.presence == Presence::Away);
        let longest_away = || away().min_by_key(|(_, known)| known.since_ns).map(|(number, _)| *number);
        // Who sleeps does not leave: one who is away already has been told of twice. Whoever opens the door of a house of sleepers is one of them.
        let awake = best.filter(|(_, (awake, _), ..)| *awake || !leaves).map(|(.., Reverse(number))| number);
        let sleeper = best.map(|(.., Reverse(number))| number);
        let back = longest_away().filter(|_| comes);
        back.or(awake).or_else(longest_away).or(sleeper).or_else(|| self.residents().next()).unwrap_or_default()
    }

    /// The names of those whom an observation is about that was given no name: of persons who are known by them, have them here, or live here; of
    /// who is called by what they are ("the plumber"); or of strangers, unless one alone comes where nobody goes by a name.
    pub(super) fn named(&self, said: &Said) -> Vec<String> {
        self.names_in(self.about(said), said.is_of_a_new_guest())
    }

    /// Whether the home says that a name is no person's.
    fn is_no_person(&self, name: &str) -> bool {
        let name = ReadName::new(name);
        self.not_persons.iter().any(|other| other.whole() == name.whole())
    }

    /// Whether a number is of somebody whom the home says since then to be no person.
    pub(super) fn is_number_of_none(&self, person: u32) -> bool {
        self.not_persons.iter().any(|name| name.number() == person)
    }

    /// Whom an observation is about: of what the home says is no person, nothing.
    fn about(&self, said: &Said) -> About {
        let is_none = |name: &str| self.is_no_person(name);
        match said.about(|name| is_none(name) || self.is_called(name)) {
            About::Named(names) if names.iter().any(|name| is_none(name)) => {
                let names: Vec<_> = names.into_iter().filter(|name| !is_none(name)).collect();
                if names.is_empty() { About::Nobody } else { About::Named(names) }
            }
            // "Fire goes out."
            About::Named(names)
                if matches!(said, Said::Presence(_))
                    && names.iter().any(|name| Said::is_stuff(name) && !self.is_called(name)) =>
            {
                About::Nobody
            }
            about => about,
        }
    }

    /// The names in that; where a guest is new, "guest" is none of those who are known.
    fn names_in(&self, about: About, is_new_guest: bool) -> Vec<String> {
        let names = match about {
            About::Named(names) => names,
            About::Stranger(name) => vec![name],
            About::Somebody | About::Nobody => return Vec::new(),
        };
        // One person whom nobody has given a name may be meant by any.
        let is_alone = self.known.len() == 1 && !self.has_names();
        let may_be_new = !is_alone || names.len() > 1;
        let begins_with_known = |name: &str| name.split_once(' ').is_some_and(|(first, _)| self.is_name_known(first));
        let is_new = |name: &String| {
            may_be_new && Said::may_be_new(name) && !begins_with_known(name) && check_name(name).is_ok()
        };
        let whose = |name: String| {
            if is_new_guest && Said::is_guest(&name) {
                return Some(name);
            }
            let name = self.known_for_short(&name).map_or(name.clone(), str::to_owned);
            // Who goes by a longer name is told of by that.
            let number = self.called(&name)?;
            let known = self.is_called(&name).then(|| self.name_of(number)).flatten();
            known.map(str::to_owned).or_else(|| (self.is_name_known(&name) || is_new(&name)).then_some(name))
        };
        names.into_iter().map(whose).collect::<Option<_>>().unwrap_or_default()
    }

    /// Whether an observation that was given no name moves nobody: it is about things, also by their names, or about others than one person whom it
    /// names.
    pub(super) fn is_of_nobody(&self, said: &Said, is_thing: impl Fn(&str) -> bool) -> bool {
        match self.about(said) {
            // "Only Rocky is home" is of all the others.
            About::Nobody => {
                !said.is_of_all()
                    && !said.is_of_guests()
                    && said.is_of_so_many().is_none()
                    && !matches!(said, Said::Presence(statement) if statement.is_of_everybody())
            }
            named @ About::Named(_) => self.has_names() && self.names_in(named, said.is_of_a_new_guest()).is_empty(),
            About::Stranger(name) => is_thing(&name),
            About::Somebody => false,
        }
    }

    /// Whether a statement of a person names others, and not that person.
    pub(super) fn is_of_others(&self, observation: &Observation, statement: &PresenceStatement) -> bool {
        let number = observation.name.as_deref().map_or(observation.person, |name| self.number_of(name));
        // A person by number alone may go by any name.
        let has_name = observation.name.is_some() || self.name_of(number).is_some();
        let mut names = statement.names().peekable();
        names.peek().is_some()
            && names.all(|name| (has_name || self.is_called(name)) && self.called(name) != Some(number))
    }

    /// Whether a sentence is about others whom it names, who are all known, and not about the person that it was said of.
    pub(super) fn tells_of_others(&self, observation: &Observation) -> bool {
        if !self.has_names() || observation.said.is_of_a_pronoun() {
            return false;
        }
        let number = observation.name.as_deref().map_or(observation.person, |name| self.number_of(name));
        // A person by number alone may be any of them.
        let has_name = observation.name.is_some() || self.name_of(number).is_some();
        match self.about(&observation.said) {
            About::Named(names) => {
                let is_known = |name: &String| self.is_called(name);
                let is_other = |name: &String| self.called(name).is_some_and(|named| named != number);
                names.iter().any(is_known)
                    && names.iter().all(|name| if is_known(name) { is_other(name) } else { has_name && is_other(name) })
            }
            About::Stranger(_) | About::Somebody | About::Nobody => false,
        }
    }

    /// Takes note of whom a source told of by name in a narration of an epoch and sequence, where `is_beside` as one whom somebody else does something
    /// with. Strangers push out what strangers said.
    pub(super) fn remember(&mut self, teller: Teller, number: u32, is_beside: bool, told: (u64, u64), at_ns: i64) {
        let last = self.told_of.iter().position(|own| own.teller == teller).and_then(|at| self.told_of.remove(at));
        let last = last.filter(|last| last.told == told || is_beside && at_ns - last.at_ns <= PRONOUN_NS);
        let (person, mut beside) = match last {
            Some(last) if last.told != told => (last.person, vec![number]),
            Some(mut last) => {
                last.beside.push(if is_beside { number } else { last.person });
                (if is_beside { last.person } else { number }, last.beside)
            }
            None => (number, Vec::new()),
        };
        beside.retain(|other| *other != person);
        beside.truncate(PERSONS_MAX);
        if self.told_of.len() == TOLD_OF_MAX {
            let oldest = self.told_of.iter().position(|own| own.teller.0);
            if oldest.is_none() && teller.0 {
                return;
            }
            self.told_of.remove(oldest.unwrap_or_default());
        }
        self.told_of.push_back(ToldOf { teller, person, beside, told, at_ns });
    }

    /// Whom a source means by "he" or "she" that has told of somebody by name shortly before, and whether nobody else may be meant. That is who did
    /// something; whom they did it with only where that one alone fits. None where they are not in the house, or are called by the other one, or where
    /// others are called by this one and of them it is not known. Who has just left, and `leaves` again, is the same.
    pub(super) fn antecedent(&self, teller: Teller, pronoun: Pronoun, leaves: bool, at_ns: i64) -> Option<(u32, bool)> {
        let told = self.told_of.iter().find(|own| own.teller == teller)?;
        if !(0..=PRONOUN_NS).contains(&(at_ns - told.at_ns)) {
            return None;
        }
        // Whether it is theirs, as far as is known; none of who is not there.
        let fits = |person: u32| {
            let known = self.known.get(&person)?;
            let is_there = known.presence == Presence::Present || leaves && known.presence == Presence::Away;
            is_there.then(|| known.is_called_by(pronoun))
        };
        let beside = || told.beside.iter().copied();
        if fits(told.person) == Some(Some(true)) {
            return Some((told.person, true));
        }
        if let Some(other) = beside().find(|other| fits(*other) == Some(Some(true))) {
            return Some((other, true));
        }
        let mut known = self.known.values().filter(|known| known.presence == Presence::Present);
        if known.any(|known| known.is_called_by(pronoun) == Some(true)) {
            return None;
        }
        let mut open = [told.person].into_iter().chain(beside()).filter(|person| fits(*person) == Some(None));
        let (first, other) = (open.next()?, open.next());
        let is_first = first == told.person || fits(told.person) == Some(Some(false));
        is_first.then_some((first, other.is_none()))
    }

    /// Takes note that somebody was called by a pronoun.
    pub(super) fn call(&mut self, number: u32, pronoun: Pronoun) {
        const MOST: i8 = 8;
        if let Some(known) = self.known.get_mut(&number) {
            let step = if pronoun == Pronoun::She { 1 } else { -1 };
            known.she = (known.she + step).clamp(-MOST, MOST);
        }
    }

    /// Whether somebody who is known goes by a name, has it here, or lives here.
    pub(super) fn is_name_known(&self, name: &str) -> bool {
        self.is_read_known(&ReadName::new(name))
    }

    fn is_read_known(&self, name: &ReadName) -> bool {
        let number = self.file.given_number(name).unwrap_or_else(|| name.number());
        self.is_number_named(number) || self.lives_here(name) || self.alike(name).len() == 1
    }

    /// Whether an observation says of somebody who is not known to be in the house what they may do elsewhere.
    pub(super) fn is_heard_from_afar(&self, observation: &Observation) -> bool {
        let is_here = |known: &Known| known.presence == Presence::Present;
        let by_name = observation.name.is_some() || self.known.contains_key(&observation.person);
        let is_guest = || self.is_visitor(observation.person) && observation.said.is_visit();
        by_name
            && !self.known.get(&observation.person).is_some_and(is_here)
            && observation.said.is_from_afar()
            && !is_guest()
    }

    /// Whether anybody goes by a name here.
    fn has_names(&self) -> bool {
        let named = self.known.values().any(|known| known.name.is_some());
        named || !self.file.persons().is_empty() || self.config.residents.iter().any(|who| who.parse::<u32>().is_err())
    }

    /// The number that a name or a number means, whether or not anybody is known by it.
    pub(super) fn meant(&self, who: &str) -> u32 {
        let who = who.trim();
        who.parse().ok().filter(|_| is_number(who)).unwrap_or_else(|| self.number_of(who))
    }

    /// All that a person is called, in lower case.
    pub(super) fn names_of(&self, number: u32) -> Vec<String> {
        let kept = self.file.of_number(number).into_iter().flat_map(KeptPerson::names);
        kept.chain(self.name_of(number)).map(str::to_lowercase).collect()
    }

    /// The person that a name or a number means; none where it means nobody who is known or has a name here.
    #[must_use]
    pub fn find(&self, who: &str) -> Option<u32> {
        let number = self.meant(who);
        (self.known.contains_key(&number) || self.file.of_number(number).is_some()).then_some(number)
    }

    /// Whether a name or a number means one who lives here, and was not observed yet.
    pub(super) fn is_awaited(&self, who: &str) -> bool {
        let number = self.meant(who);
        self.find(who).is_none() && self.residents().any(|resident| resident == number)
    }

    /// Gives a person a name, from now on and over restarts.
    ///
    /// # Errors
    /// What is wrong with the name, whose it is already, or why it cannot be kept.
    pub(super) fn rename(&mut self, number: u32, name: &str) -> Result<(), NotRenamed> {
        let name = name.trim();
        check_name(name).map_err(NotRenamed::Refused)?;
        let owner = self.number_of(name);
        let known = self.known.contains_key(&owner) || self.file.of_number(owner).is_some();
        if owner != number && known {
            let reason = format!("{name} is person {owner} already: forget that one first, or choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        // One who lives here does not become another who does.
        if owner != number
            && self.lives_here(&ReadName::new(name))
            && self.residents().any(|resident| resident == number)
        {
            let own = self.name_of(number).unwrap_or("this person");
            let reason = format!("{name} and {own} both live here by persons.residents: choose another name");
            return Err(NotRenamed::Refused(reason));
        }
        let former = self.file.of_number(number);
        let kept = match former {
            Some(former) => former.renamed(name),
            None => {
                // Narrators go on with what they called them, and so does what they have said.
                let own = self.name_of(number).filter(|own| !same_name(own, name));
                let former = own.map(str::to_owned).into_iter().collect();
                KeptPerson { number, name: name.to_owned(), resident: None, former }
            }
        };
        let failed =
            |error| NotRenamed::Failed(format!("the persons file cannot be written: {error}; nothing was changed"));
        self.file.put(kept).map_err(failed)
    }

    /// The names that the home gave.
    pub fn file(&self) -> &PersonsFile {
        &self.file
    }

    /// The same, to remove somebody.
    pub(super) fn file_mut(&mut self) -> &mut PersonsFile {
        &mut self.file
    }

    /// Everybody who is known, has a name here, or lives here.
    pub(super) fn lines(&self, now_ns: i64) -> Vec<PersonLine> {
        let kept = self.file.persons().iter().map(|kept| kept.number);
        let numbers: BTreeSet<u32> = self.known.keys().copied().chain(kept).chain(self.residents()).collect();
        let line = |person: u32| {
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

    /// Bits of [`person_flags`] of a person.
    pub(super) fn flags(&self, number: u32, now_ns: i64) -> u32 {
        let Some(known) = self.known.get(&number) else { return 0 };
        let flag = |holds: bool, flag: u32| if holds { flag } else { 0 };
        flag(known.restored, person_flags::RESTORED)
            | flag(known.is_asleep(self.asleep_ns(), now_ns), person_flags::ASLEEP)
            | flag(known.by_fit, person_flags::BY_FIT)
            | flag(self.is_visitor(number), person_flags::VISITOR)
    }

    /// A person's name as a message has it.
    pub(super) fn name_bytes(&self, number: u32) -> [u8; NAME_BYTES] {
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
    ];
    words.into_iter().filter(move |(flag, _)| flags & flag != 0).map(|(_, word)| word)
}

/// What a message calls a presence.
pub(super) fn presence_value(of: Presence) -> u32 {
    match of {
        Presence::Unknown => presence::UNKNOWN,
        Presence::Present => presence::PRESENT,
        Presence::Away => presence::AWAY,
        Presence::Gone => presence::GONE,
    }
}

/// A time as a message has it: 0 where that was before the machine's start.
pub(super) fn message_ns(at_ns: i64) -> u64 {
    at_ns.try_into().unwrap_or_default()
}

#[cfg(test)]
mod tests;
