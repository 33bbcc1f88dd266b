//! The events of a former run, from the state database.

use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::{Observation, Presence, Quota};
use roomcast_core::scorer::LanguageModel;

use super::{Engine, observed_at_ns};
use crate::daemon::journal::{Expectation, Move, Recovered};

impl<M: LanguageModel> Engine<M> {
    /// Restores the events of a former run without scoring, with their times, and the expectations after some of them. Returns the number of events
    /// that were left out because they cost more tokens than a window holds.
    pub fn restore(&mut self, recovered: Recovered, now_ns: BootNs, now_unix_ns: UnixNs) -> usize {
        let mut costly = 0;
        let Recovered { observations, mut expectations, forgotten, mut moved, of_other_boots, .. } = recovered;
        let started_unix_ns = now_unix_ns.saturating_sub(now_ns.0);
        self.belief.local_ahead_s = self.home.local_ahead_s(now_ns, now_unix_ns);
        let mut forgotten = forgotten.into_iter().peekable();
        let learned = self.home.begin_recall(&observations, now_ns, now_unix_ns);
        // Expectations of several persons after one step have no order.
        expectations.sort_by_key(|(after, person, _)| (*after, *person));
        let mut expectations = expectations.iter().peekable();
        for (index, mut observation) in observations.into_iter().enumerate() {
            if observation.by_fit {
                // The home may have given the person another number in the meantime.
                observation.person = self.attribution.persons.file().current(observation.person);
            }
            if index == learned {
                self.home.end_recall();
            }
            while let Some((_, person)) = forgotten.next_if(|(before, _)| *before <= index) {
                self.lose(person);
            }
            if self.scoring.pipeline.intake().is_costly(&observation) {
                costly += 1;
                self.pass_over(observation.id());
                // The expectation after it rests on it.
                while expectations.next_if(|(after, ..)| *after <= index).is_some() {}
                continue;
            }
            self.scoring.readings.begin();
            let name = observation.id();
            self.records.begin(name);
            let is_of_another_boot = of_other_boots.contains(&name);
            if is_of_another_boot {
                // The event was before the machine's start, whatever the wall clock says. A time of 0 would mean no time.
                observation.observed_unix_ns = observation.observed_unix_ns.min(started_unix_ns.max(UnixNs(1)));
            }
            let mut at_ns = observed_at_ns(&observation, now_ns, now_unix_ns);
            if is_of_another_boot {
                at_ns = Some(at_ns.unwrap_or(0).min(0));
            }
            let persons = self.repeat(observation, moved.remove(&name), at_ns);
            while let Some((_, person, expectation)) = expectations.next_if(|(after, ..)| *after <= index) {
                let person = self.attribution.persons.file().current(*person);
                // The attribution may be lost. The event may then be another person's, and this expectation is void.
                if !persons.contains(&person) {
                    continue;
                }
                self.restore_expectation(person, expectation);
            }
        }
        forgotten.for_each(|(_, person)| self.lose(person));
        self.records.recalled = true;
        self.home.end_restore();
        self.scoring.pipeline.intake().forget_quotas();
        costly
    }

    /// Takes one event of a former run again, by the moves that were stored with it, if there are any. Returns its persons.
    fn repeat(&mut self, observation: Observation, moved: Option<Vec<Move>>, at_ns: Option<i64>) -> Vec<PersonId> {
        let quota = Quota::of_source(observation.source);
        let is_unknown =
            !self.attribution.named.is_empty() && !self.attribution.named.contains_key(&observation.source);
        let reporter = self.attribution.reporter(observation.source, is_unknown);
        self.scoring.pipeline.intake().include(&observation, quota);
        let mut persons = Vec::new();
        let Some(mut moves) = moved else {
            // A former run that was killed, or an older version, did not store the moves.
            let name = observation.id();
            let enter = |engine: &mut Self, own: Observation| {
                persons.push(own.person);
                engine.enter_restored(quota, own);
            };
            let (is_read_alone, moves) = self.attribute(observation, Quota::EARLIER, reporter, at_ns, enter);
            // The next start repeats these moves, also with other known persons. An attribution to one person is stored already.
            if persons.is_empty() || !is_read_alone && moves.len() != 1 {
                self.records.note_moves(name, moves);
            } else {
                self.records.drop_moves(moves);
            }
            return persons;
        };
        for own in &mut moves {
            own.person = self.attribution.persons.file().current(own.person);
        }
        // A refused event has no moves.
        if !moves.is_empty() {
            self.weigh_again(&observation, reporter, at_ns, &moves);
        }
        for own in moves {
            if let Some(own) = self.retake(own.apply(&observation), reporter, at_ns) {
                persons.push(own.person);
                self.enter_restored(quota, own);
            }
        }
        persons
    }

    fn restore_expectation(&mut self, person: PersonId, stored: &Expectation) {
        let said: Vec<f64> = stored.probability.iter().map(|probability| f64::from(*probability)).collect();
        // The stored expectation of a person outside is empty.
        if said.is_empty() {
            self.records.said.insert(person, said);
            return;
        }
        let is_of_map = stored.map == self.map.number();
        let Some(own) = self.belief.followed.get_mut(&person).filter(|_| is_of_map) else { return };
        if let Some(paces) = stored.paces {
            own.believe(&said, paces.map(f64::from));
            let heard_ns = self.attribution.persons.get(person).map_or(0, |known| known.heard_ns);
            self.home.stayed(person, heard_ns, own);
        } else {
            own.expect(&said);
            self.records.said.insert(person, said);
        }
    }

    /// Restores the part of one person in an event of a former run.
    fn enter_restored(&mut self, quota: Quota, own: Observation) {
        let person = own.person;
        self.scoring.pipeline.intake().enter(quota, own);
        self.follow();
        match self.attribution.persons.get_mut(person) {
            // The departure was published.
            Some(known) if known.presence == Presence::Gone => _ = self.attribution.persons.remove(person),
            Some(known) => known.restored = true,
            None => {}
        }
        self.records.said.remove(&person);
    }
}
