//! What the state database stores of each step: attributions, moves, expectations, and beliefs at a change of the map.

use std::collections::BTreeMap;

use roomcast_core::forecast::Forecaster;
use roomcast_core::ids::{EventId, PersonId};
use roomcast_core::narration::Presence;
use roomcast_core::scorer::LanguageModel;

use super::Engine;
use crate::daemon::journal::{Expectation, Move, Moved, Outcome, Record};

/// An unnamed event, and the person that it fits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Attributed {
    pub(super) event: EventId,
    pub(super) person: PersonId,
}

#[derive(Debug, Default)]
pub(super) struct Records {
    /// Attributions of unnamed events.
    pub(super) attributed: Vec<Attributed>,
    /// The persons that events moved. Only events that a daemon with other known persons would attribute differently.
    moved: Vec<Moved>,
    /// Working memory.
    no_moves: Vec<Vec<Move>>,
    /// Beliefs at a change of the map.
    believed: Vec<Record>,
    /// Visitors that are gone by silence.
    gone: Vec<(PersonId, Option<EventId>)>,
    /// The newest event that entered.
    newest: Option<EventId>,
    /// The state database was read, and no expectation was written since. Restored persons without new events need no repetition.
    pub(super) recalled: bool,
    /// The expectation after each person's newest restored event, as the state database has it; empty if the person was out.
    pub(super) said: BTreeMap<PersonId, Vec<f64>>,
}

impl Records {
    /// An empty list of moves.
    pub(super) fn no_moves(&mut self) -> Vec<Move> {
        self.no_moves.pop().unwrap_or_default()
    }

    /// A restart repeats the moves of this event.
    pub(super) fn note_moves(&mut self, observation: EventId, moves: Vec<Move>) {
        self.moved.push(Moved { observation, moves });
    }

    /// A restart reads this event again.
    pub(super) fn drop_moves(&mut self, mut moves: Vec<Move>) {
        moves.clear();
        self.no_moves.push(moves);
    }

    /// An event enters now.
    pub(super) fn begin(&mut self, observation: EventId) {
        self.newest = Some(observation);
    }

    pub(super) fn note_gone(&mut self, person: PersonId) {
        self.gone.retain(|(other, _)| *other != person);
        self.gone.push((person, self.newest));
    }

    pub(super) fn lose(&mut self, person: PersonId) {
        self.attributed.retain(|attributed| attributed.person != person);
        self.moved.iter_mut().for_each(|moved| moved.moves.retain(|own| own.person != person));
    }
}

impl<M: LanguageModel> Engine<M> {
    /// Notes the belief about each person in the house, by the rooms of the changed map. A restart must not read earlier events by that map.
    pub(super) fn note_beliefs(&mut self) {
        let map = self.map.number();
        let (new, rooms) = self.new_places();
        self.records.believed.clear();
        for (person, own) in &self.belief.followed {
            let Some(known) = self.attribution.persons.get(*person).filter(|known| known.presence == Presence::Present)
            else {
                continue;
            };
            let mut own = own.clone();
            own.take_rooms(&new, rooms);
            let probability = own.belief().iter().map(|probability| *probability as f32).collect();
            let expectation = Expectation { map, paces: Some(own.paces().map(|pace| pace as f32)), probability };
            self.records.believed.push(Record::Expected { of: known.last, person: *person, expectation });
        }
    }

    /// The index in the changed map of each room of the newest scores, and the number of rooms of the changed map.
    pub(super) fn new_places(&self) -> (Vec<Option<usize>>, usize) {
        let before = self.publication.snapshot.rooms().iter().map(|room| room.id);
        let after = match self.map.next_rooms.as_deref() {
            Some((room, count)) => room.iter().take(*count as usize).map(|room| room.id).collect(),
            None => before.clone().collect::<Vec<_>>(),
        };
        (before.map(|id| after.iter().position(|other| *other == id)).collect(), after.len())
    }

    /// Passes the beliefs at a change of the map to `tell`, once, for the state database.
    pub fn tell_beliefs(&mut self, tell: impl FnMut(Record)) {
        self.records.believed.drain(..).for_each(tell);
    }

    /// Passes the visitors that are gone by silence to `tell`, once, for the state database.
    pub fn tell_gone(&mut self, tell: impl FnMut(Record)) {
        let gone = self.records.gone.drain(..);
        gone.map(|(person, after)| Record::Gone { person, after }).for_each(tell);
    }

    /// Passes the outcomes of the last good step to `tell`, once, for the state database.
    pub fn tell_outcomes(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.tell_whose(&mut tell);
        self.tell_expected(tell);
        // A caller that stores moves has taken them before.
        self.tell_moved(|_| {});
    }

    /// Passes the moves of the last step's events to `tell`, once, for the state database. Without them, a restart would attribute the events by the
    /// persons known then.
    pub fn tell_moved(&mut self, mut tell: impl FnMut(&Moved)) {
        for mut moved in self.records.moved.drain(..) {
            tell(&moved);
            moved.moves.clear();
            self.records.no_moves.push(moved.moves);
        }
    }

    /// Passes the attributions of unnamed events to `tell`, once. The scores rest on them.
    pub(in crate::daemon) fn tell_whose(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        let map = self.map.number();
        for Attributed { event, person } in self.records.attributed.drain(..) {
            tell(&Outcome { event, person, by_fit: true, map, probability: &[] });
        }
    }

    /// Passes each person's expectation to `tell`, once. This can wait until the scores and the forecast are sent.
    pub(in crate::daemon) fn tell_expected(&mut self, mut tell: impl FnMut(&Outcome<'_>)) {
        self.watch();
        let map = self.map.number();
        let (recalled, said) = (self.records.recalled, &self.records.said);
        self.scoring.rescored.retain(|&person| {
            if self.scoring.pipeline.inside().waits(person) {
                return true;
            }
            // A person who is out has no expectation; the record confirms the attribution.
            let own = self.scoring.pipeline.inside().person(person).filter(|own| own.at_home);
            let expected = self.belief.followed.get(&person).and_then(Forecaster::expected);
            let own = own.map(|own| expected.unwrap_or(&own.grounded.partition_probability));
            // If events were lost, the model's expectation differs from the stored one, and is written. It is also written if a killed daemon, or a
            // power loss, left none.
            let is_same = said.get(&person).is_some_and(|said| own.is_none_or(|own| are_alike(said, own)));
            let is_said = |restored| recalled && restored && is_same;
            if let Some(known) = self.attribution.persons.get(person).filter(|known| !is_said(known.restored)) {
                let probability = own.unwrap_or_default();
                tell(&Outcome { event: known.last, person, by_fit: false, map, probability });
            }
            false
        });
        if !self.scoring.pipeline.inside().is_behind() {
            self.records.recalled = false;
            self.records.said.clear();
        }
    }
}

/// Whether two expectations are equal up to the rounding of the state database. A wider bound would gain nothing: the included model scores an equal
/// window identically to the last bit, also after a restart. Another window changes the probabilities by about 1e-2, and no claim waits for these
/// records.
fn are_alike(said: &[f64], now: &[f64]) -> bool {
    const ROUNDING: f64 = 1e-6;
    said.len() == now.len() && said.iter().zip(now).all(|(said, now)| (said - now).abs() < ROUNDING)
}
