//! Whose an observation is, and what of it is taken in.

use roomcast_core::forecast::Mentions;
use roomcast_core::grounding::Grounding;
use roomcast_core::narration::{Observation, Presence, PresenceStatement, Pronoun, SOMEBODY, Said, Voice, same_name};
use roomcast_core::pipeline::PersonScores;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::text::has_words;
use roomcast_ipc::RoomV1;

use super::super::persons::is_at_front_door;
use super::{Attributed, Board, STRANGE_ROOMS_LOGGED, Seen, room_named, seconds};

/// What says where somebody is.
#[derive(Debug, Clone, Copy)]
enum Place {
    /// A label that was mentioned.
    Label(usize),
    /// A room.
    Room(usize),
    /// Where the house is left.
    WayOut,
}

impl<M: LanguageModel> Board<M> {
    /// The observations that one of several clauses stands for, each of those whom it names; itself where it has one.
    pub(super) fn clauses(&self, observation: Observation) -> impl Iterator<Item = Observation> + use<M> {
        let observation = self.of_its_person(observation);
        let is_visitor = |name: &str| self.persons.is_visitor(self.persons.number_of(name));
        let said = observation.said.clauses(|name| self.persons.is_called(name), is_visitor);
        let of_known = |said: Said| match said {
            Said::Presence(statement) => Said::Presence(statement.of_known(|name| self.persons.is_called(name))),
            said @ Said::Sentence(_) => said,
        };
        let observation = Observation { said: of_known(observation.said), ..observation };
        // What is keyed, or was found by fit, is so in the clauses that name nobody.
        let own = |said: Said| {
            let mut names = if said.is_of_a_pronoun() { Vec::new() } else { self.persons.named(&said) };
            let is_own = |name: &String| match &observation.name {
                Some(own) => same_name(own, name),
                None => self.persons.number_of(name) == observation.person,
            };
            if names.is_empty() || (names.len() == 1 && names.iter().all(is_own)) {
                return Observation { said, ..observation.clone() };
            }
            let name = if names.len() == 1 { names.pop().map(Into::into) } else { None };
            Observation { person: SOMEBODY, name, by_fit: false, said, ..observation.clone() }
        };
        let several: Vec<Observation> = said.into_iter().map(of_known).map(own).collect();
        several.is_empty().then_some(observation).into_iter().chain(several)
    }

    /// An observation whose sentence is read as one of its person: one that begins with a deed, where its key says whose it is ("Leaves the house."), and
    /// one that begins with the name of somebody who is known, where the name is another word, too ("August leaves the house.").
    fn of_its_person(&self, observation: Observation) -> Observation {
        let Some(sentence) = observation.sentence() else { return observation };
        let is_open = observation.person == SOMEBODY && observation.name.is_none();
        let first = sentence.split([' ', '.', '!']).next().unwrap_or_default();
        // Most begin so; nothing is allocated for them.
        if ["they", "he", "she"].iter().any(|pronoun| first.eq_ignore_ascii_case(pronoun)) {
            return observation;
        }
        let is_own = |name: &str| observation.name.as_deref().is_none_or(|own| same_name(own, name));
        if !Said::is_read_as_a_name(first) && is_own(first) && self.persons.is_called(first) {
            let may_name = is_open || observation.name.is_some();
            let name = Some(first.into());
            return match observation.said.of_its_person(first).filter(|_| may_name) {
                Some(said) => Observation { said, name, ..observation },
                None => observation,
            };
        }
        let own = if is_open { None } else { observation.said.of_its_person("") };
        // What is done in the house stays as it was said.
        match own.filter(|said| matches!(said, Said::Presence(_))) {
            Some(Said::Presence(own)) => Observation { said: Said::Presence(own.with_pronoun(None)), ..observation },
            _ => observation,
        }
    }

    /// The observations of persons that one stands for; none where it moves nobody ("The milk is out."), or where its subject is somebody who is not known
    /// and may be anywhere ("Carl is on his way.").
    pub(super) fn of_persons(
        &self,
        mut observation: Observation,
        is_strange: bool,
    ) -> impl Iterator<Item = Observation> + use<M> {
        let said = &observation.said;
        // A sentence that says where somebody else is, or that they come, is of them, whoever's narrator heard it.
        let is_keyed = observation.person != SOMEBODY || observation.name.is_some();
        let statement = match said {
            _ if !is_keyed => None,
            Said::Presence(statement) => Some(statement.clone()),
            Said::Sentence(sentence) => PresenceStatement::of_sentence(sentence.as_str()),
        };
        let is_of_others = match statement {
            Some(statement) => statement.is_of_everybody() || self.persons.is_of_others(&observation, &statement),
            None => is_keyed && self.persons.tells_of_others(&observation),
        };
        if is_of_others {
            (observation.person, observation.name) = (SOMEBODY, None);
        }
        let said = &observation.said;
        let is_open = observation.person == SOMEBODY && observation.name.is_none();
        let is_thing = |name: &str| {
            let is_known = |words: &str| self.mentions.knows(words);
            (is_known(name) || name.split(' ').any(is_known)) && !self.persons.is_called(name)
        };
        let is_of_things = match said {
            Said::Presence(statement) => statement.names().any(is_thing),
            Said::Sentence(_) => said.moves_nobody(),
        };
        let is_unknown =
            || is_open && said.is_from_afar() && !said.is_of_a_pronoun() && self.persons.named(said).is_empty();
        // What has ended brings nobody home.
        let is_over = || is_open && said.is_of_an_end() && !self.persons.is_anybody_here(is_strange);
        let is_of_none = || is_open && self.persons.is_of_nobody(said, is_thing);
        let is_anybodys = || is_open && self.persons.are_several_away(is_strange) && said.is_own_arrival();
        let is_of_nobody = is_of_things || is_over() || is_of_none() || is_unknown() || is_anybodys();
        (!is_of_nobody).then(|| self.persons.each(observation, is_strange)).into_iter().flatten()
    }

    /// Decides whom an observation is of, and takes note of it: also for the forecasts, where its time is known. Gives it back for the
    /// history, unless something later has said otherwise of whether its person is in the house.
    /// What a stranger says of somebody who is guarded is passed over, too.
    pub(super) fn take(
        &mut self,
        mut observation: Observation,
        voice: Voice,
        is_strange: bool,
        at_ns: Option<i64>,
    ) -> Option<Observation> {
        let noted_ns = at_ns.unwrap_or_default();
        // What a stranger says is not what a named narrator goes on with, whatever number it took.
        let teller = (is_strange, observation.source);
        let mut pronoun = None;
        let told = (observation.epoch, observation.sequence);
        let is_beside = is_beside(&observation);
        match &observation.name {
            Some(name) => {
                observation.person = self.persons.number_of(name);
                self.persons.remember(teller, observation.person, is_beside, told, noted_ns);
            }
            None if observation.person == SOMEBODY => {
                observation.name = self.persons.named(&observation.said).pop().map(Into::into);
                pronoun = observation.said.pronoun();
                let leaves = observation.said.presence() == Presence::Away;
                let meant = || self.persons.antecedent(teller, pronoun?, leaves, noted_ns);
                let person = match &observation.name {
                    Some(name) => self.persons.number_of(name),
                    None => match meant() {
                        // Where "he" may be either, it sends neither away.
                        Some((_, false)) if leaves => return None,
                        Some((person, _)) => person,
                        None => self.fitting(&observation.said, noted_ns, is_strange),
                    },
                };
                if observation.name.is_some() {
                    self.persons.remember(teller, person, is_beside, told, noted_ns);
                }
                (observation.person, observation.by_fit) = (person, observation.name.is_none());
                let Observation { source, epoch, sequence, .. } = observation;
                self.attributed.push(Attributed { source, epoch, sequence, person });
            }
            None if observation.by_fit => {
                // Who was told apart by a sentence's subject before a restart goes by it again.
                let mut names = self.persons.named(&observation.said).into_iter();
                let own = names.find(|name| self.persons.number_of(name) == observation.person);
                observation.name = own.map(Into::into);
                observation.by_fit = observation.name.is_none();
                pronoun = observation.said.pronoun();
            }
            None => {}
        }
        if is_strange && self.persons.is_guarded(observation.person, noted_ns) {
            return None;
        }
        self.persons.see_off(&mut observation);
        // Where the map has no office by that name, it is the one that people go to work at.
        let has_office =
            || self.pipeline.grounding().partitions().iter().any(|own| own.id == "office" || own.label == "office");
        if observation.said.goes_to_an_office()
            && !has_office()
            && let Ok(away) = PresenceStatement::new(Presence::Away, None)
        {
            observation.said = Said::Presence(away);
        }
        self.admit(observation, pronoun, voice, (is_strange, false), at_ns)
    }

    /// Takes note of whom an observation told of by name that moved nobody: "Ben calls." Who is "he" after it goes by that.
    pub(super) fn hear_of(&mut self, observation: &Observation, is_strange: bool, at_ns: Option<i64>) {
        for clause in self.clauses(observation.clone()) {
            for own in self.of_persons(clause, is_strange) {
                let is_beside = is_beside(&own);
                if let Some(name) = own.name.map(String::from).or_else(|| self.persons.named(&own.said).pop()) {
                    let person = self.persons.number_of(&name);
                    let (teller, told) = ((is_strange, own.source), (own.epoch, own.sequence));
                    self.persons.remember(teller, person, is_beside, told, at_ns.unwrap_or_default());
                }
            }
        }
    }

    /// Takes again what a former run found an observation to say of a person, whoever is known by now; of an empty room nothing is left then.
    /// `pronoun` is the one that it was said with.
    pub(super) fn retake(
        &mut self,
        own: Observation,
        pronoun: Option<Pronoun>,
        is_strange: bool,
        at_ns: Option<i64>,
    ) -> Option<Observation> {
        if own.person == SOMEBODY {
            self.exclude(&own, is_strange, at_ns);
            return None;
        }
        if own.name.is_some() {
            let (teller, told) = ((is_strange, own.source), (own.epoch, own.sequence));
            self.persons.remember(teller, own.person, is_beside(&own), told, at_ns.unwrap_or_default());
        }
        self.admit(own, pronoun, Voice::EARLIER, (is_strange, true), at_ns)
    }

    /// Takes in what is said of a person, unless something later says otherwise; what a former run has taken in says something in any case.
    fn admit(
        &mut self,
        observation: Observation,
        pronoun: Option<Pronoun>,
        voice: Voice,
        (is_strange, was_taken): (bool, bool),
        at_ns: Option<i64>,
    ) -> Option<Observation> {
        let at_ns = at_ns.map(|at_ns| self.persons.in_order(&observation, at_ns));
        let noted_ns = at_ns.unwrap_or_default();
        // After such a silence a visitor was gone, whether or not anybody looked meanwhile.
        if self.persons.has_expired(observation.person, noted_ns) {
            self.watch();
            self.persons.remove(observation.person);
            self.drop_person(observation.person);
        }
        let is_outdated = || at_ns.is_some_and(|at_ns| self.persons.is_outdated(&observation, at_ns));
        if !was_taken
            && (is_outdated() || self.persons.is_heard_from_afar(&observation) || self.is_out_still(&observation))
        {
            return None;
        }
        // "She" is whom its teller told of last, as they were before; whoever was found otherwise may be called anything.
        let teller = (is_strange, observation.source);
        let leaves = observation.said.presence() == Presence::Away;
        let is_meant = |pronoun: &Pronoun| {
            self.persons.antecedent(teller, *pronoun, leaves, noted_ns) == Some((observation.person, true))
        };
        let pronoun = if observation.name.is_some() {
            observation.said.own_pronoun()
        } else if observation.by_fit {
            pronoun.filter(is_meant)
        } else {
            None
        };
        if let Some(dropped) = self.persons.note(&observation, voice, noted_ns) {
            self.drop_person(dropped);
        }
        if let Some(pronoun) = pronoun {
            self.persons.call(observation.person, pronoun);
        }
        if !is_strange {
            self.persons.guard(observation.person, noted_ns);
        }
        if !self.rescored.contains(&observation.person) {
            self.rescored.push(observation.person);
        }
        let Some(at_ns) = at_ns else { return Some(observation) };
        if self.unwatched == self.seen.len() {
            let (words, presence) = (String::new(), Presence::Unknown);
            self.seen.push(Seen { name: (0, 0, 0), person: 0, at_ns: 0, presence, words, is_sentence: false });
        }
        if let Said::Presence(statement) = &observation.said
            && let Some(room) = statement.room()
        {
            self.note_room(room);
        }
        let place = &mut self.seen[self.unwatched];
        self.unwatched += 1;
        (place.person, place.at_ns, place.presence) = (observation.person, at_ns, observation.said.presence());
        place.name = (observation.source, observation.epoch, observation.sequence);
        place.words.clear();
        place.is_sentence = observation.sentence().is_some();
        match &observation.said {
            Said::Sentence(sentence) => {
                let words = place_words(sentence.as_str(), &observation);
                place.words.push_str(words);
                let name = observation.name.as_deref().or_else(|| self.persons.name_of(observation.person));
                if let Some(name) = name {
                    name_owners(&mut place.words, name, &self.mentions);
                }
            }
            Said::Presence(statement) => place.words.push_str(statement.room().unwrap_or_default()),
        }
        Some(observation)
    }

    /// Whether an observation says of somebody who is out, or of whom nothing is known, what they are or where they go, and of nothing that is on
    /// the map: that brings nobody home.
    fn is_out_still(&mut self, observation: &Observation) -> bool {
        let known = self.persons.get(observation.person).map(|known| known.presence);
        let is_out = known.map_or(observation.name.is_some(), |presence| presence == Presence::Away);
        is_out
            && observation.said.may_be_elsewhere()
            && observation.sentence().is_some_and(|sentence| self.mentions.last(sentence).is_none())
    }

    /// Takes a statement that a room is empty into the forecasts; gives whether it is one that is believed.
    pub(super) fn exclude(&mut self, observation: &Observation, is_strange: bool, at_ns: Option<i64>) -> bool {
        let Said::Presence(statement) = &observation.said else { return false };
        let Some(empty) = statement.empty_room() else { return false };
        if is_strange && self.persons.is_anybody_guarded(at_ns.unwrap_or_default()) {
            return false;
        }
        self.note_room(empty);
        // Of a changed map nobody knows yet where they are.
        let (Some(at_ns), None) = (at_ns, &self.next_rooms) else { return true };
        // What was observed before it comes first.
        self.follow();
        if let Some(room) = room_named(empty, &self.map, self.pipeline.grounding()) {
            let name = (observation.source, observation.epoch, observation.sequence);
            let mut followed = std::mem::take(&mut self.followed);
            for (person, own) in &mut followed {
                own.exclude(seconds(at_ns), room);
                self.home.next_is(name, *person, self.is_learned_of(*person));
                self.home.is_empty(*person, at_ns, room, own);
            }
            self.followed = followed;
        }
        true
    }

    /// Says once of each name that no room of the map has it, or several have: whoever is said to be there is present, and no more is known of where.
    fn note_room(&mut self, room: &str) {
        let is_strange = self.next_rooms.is_none() && room_named(room, &self.map, self.pipeline.grounding()).is_none();
        if is_strange && self.strange_rooms.len() < STRANGE_ROOMS_LOGGED && self.strange_rooms.insert(room.to_owned()) {
            let rooms = self.snapshot.rooms().iter().map(RoomV1::id).collect::<Vec<_>>().join(", ");
            tracing::warn!(
                room,
                rooms,
                "somebody is said to be in a room that the map does not have, or of which it has several: they count as present, in no room in particular, or in any of these; correct the narrator, with a room's id, or the scene"
            );
        }
    }

    /// Whom an observation that names nobody fits best: where each person is believed to be, and what the model expects of them next.
    fn fitting(&mut self, said: &Said, at_ns: i64, is_strange: bool) -> u32 {
        /// What an expected object counts beside being where it is.
        const NEXT: f64 = 0.5;
        /// How near to the way out somebody is tells in so many steps: less says nothing.
        const STEPS: f64 = 4.0;
        // As far as everything before it is known.
        self.watch();
        let Self { persons, pipeline, followed, mentions, map, next_rooms, .. } = self;
        let grounding = pipeline.grounding();
        let place = match said {
            _ if said.presence() != Presence::Present => Some(Place::WayOut),
            Said::Sentence(sentence) if is_at_front_door(sentence.as_str()) => Some(Place::WayOut),
            Said::Sentence(sentence) => mentions.last(sentence.as_str()).map(|found| Place::Label(found.label)),
            Said::Presence(statement) => {
                statement.room().and_then(|room| room_named(room, map, grounding)).map(Place::Room)
            }
        };
        // Of a map that has not been scored yet nobody knows where they are.
        let place = place.filter(|_| next_rooms.is_none());
        let is_way_out = matches!(place, Some(Place::WayOut));
        let ways_out: Vec<f64> = if is_way_out { ways_out(grounding) } else { Vec::new() };
        persons.fitting(said, at_ns, is_strange, |person| {
            let (Some(own), Some(place)) = (followed.get(&person), place) else { return 0.0 };
            let mut belief = own.at(seconds(at_ns), 0.0);
            match place {
                Place::Label(label) => {
                    let here: f64 = belief.zip(grounding.weights().row(label).iter()).map(|(p, share)| p * share).sum();
                    let next = pipeline.person(person).filter(|own| own.at_home && own.grounded.label_mass > 0.0);
                    let share = |own: PersonScores<'_>| {
                        Some(own.label_log_prob_nats.get(label)?.exp() / own.grounded.label_mass)
                    };
                    // Whoever has just been heard of has no scores yet.
                    let next = next.and_then(share).unwrap_or_default();
                    here + NEXT * next
                }
                Place::Room(room) => belief.nth(room).unwrap_or_default(),
                Place::WayOut => {
                    let near: f64 = belief.zip(&ways_out).map(|(p, share)| p * share).sum();
                    (near * STEPS).floor() / STEPS
                }
            }
        })
    }
}

/// Whether an observation is of somebody whom its sentence is not about: of Ben, where it is "Ada hugs Ben."
fn is_beside(observation: &Observation) -> bool {
    matches!(&observation.said, Said::Presence(statement) if statement.is_beside())
}

/// How much of the way out of the house each partition has, at most 1: a hall by its name, and a front door by its share.
pub(super) fn ways_out(grounding: &Grounding) -> Vec<f64> {
    const HALLS: [&str; 8] = ["hall", "hallway", "entrance", "entry", "entryway", "foyer", "vestibule", "lobby"];
    let is_hall = |text: &str| HALLS.iter().any(|words| has_words(text, words));
    let lower = |text: &str| text.to_lowercase();
    let mut near: Vec<f64> =
        grounding.partitions().iter().map(|own| if is_hall(&lower(&own.label)) { 1.0 } else { 0.0 }).collect();
    for (label, own) in grounding.scored_labels().iter().enumerate() {
        let text = lower(&own.text);
        // A door alone is that of the house.
        let is_only = || text == "door" && own.items.len() == 1;
        if is_at_front_door(&text) || is_only() {
            for (near, share) in near.iter_mut().zip(grounding.weights().row(label).iter()) {
                *near = near.max(*share);
            }
        }
    }
    near
}

/// The words of a sentence that say where its person is: none where a device that was found to be theirs has ended something, where they
/// speak, and where it is of what they left behind.
pub(super) fn place_words<'a>(sentence: &'a str, observation: &Observation) -> &'a str {
    let Observation { by_fit, said, .. } = observation;
    let is_nowhere = *by_fit && said.is_of_an_end() || said.is_speech() || said.is_of_what_was_left();
    if is_nowhere { "" } else { sentence }
}

/// Gives what somebody has their name, where the map has it by that: "tom goes to his room" is to "tom's room".
fn name_owners(words: &mut String, name: &str, mentions: &Mentions) {
    for had in [" his ", " her ", " their "] {
        while let Some((at, next)) = words.match_indices(had).find_map(|(at, _)| {
            let rest = &words[at + had.len()..];
            let thing = rest.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
            let owned = format!(" {}'s ", name.to_lowercase());
            mentions.knows(&format!("{}{thing}", owned.trim_start()).to_lowercase()).then_some((at, owned))
        }) {
            words.replace_range(at..at + had.len(), &next);
        }
    }
    // "Tom goes to bed" is to his.
    let bed = format!("{}'s bed", name.to_lowercase());
    if mentions.knows(&bed) {
        for had in [" to bed", " in bed"] {
            let is_end = |at: usize| !words[at..].starts_with(char::is_alphanumeric);
            if let Some(at) = words.find(had).filter(|at| is_end(at + had.len())) {
                words.replace_range(at + had.len() - "bed".len()..at + had.len(), &bed);
            }
        }
    }
}
