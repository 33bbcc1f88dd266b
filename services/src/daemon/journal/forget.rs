//! A person's events leave the database. The last sequence number of each narrator stays, so that an event that is sent again does not bring them
//! back.

use roomcast_core::ids::PersonId;
use roomcast_core::narration::{Event, Observation, Presence, Sentence};
use roomcast_database::Transaction;
use roomcast_database::rusqlite::Result;

use super::record::{Move, Record};
use super::store::{self, Known};

/// Says whether an observation is of the forgotten person or names them. It gets the person that the daemon found for the observation.
pub(super) type IsTheirs = dyn Fn(&Observation, Option<PersonId>) -> bool + Send;

/// The sentence in place of a forgotten person's.
const BLANK: &str = "Forgotten.";

/// Takes a person out. Gives how many events were theirs; `id` is the number of the change.
pub(super) fn forget(transaction: &Transaction<'_>, person: PersonId, is_theirs: &IsTheirs, id: i64) -> Result<usize> {
    let (events, damaged) = store::events(transaction)?;
    store::delete_events(transaction, &damaged)?;
    let (mut theirs, mut is_changed) = (0, !damaged.is_empty());
    for known in events {
        let forgets = Forgets { person, is_theirs, known: &known };
        if forgets.is_theirs() {
            theirs += 1;
            let bare = forgets.bare();
            let by = bare.as_ref().map(|(observation, moves)| (observation, moves.as_deref()));
            store::replace(transaction, &known, by)?;
        } else if let Some(moves) = &known.moves {
            let others: Vec<Move> = moves.iter().filter(|own| !forgets.names_them(own)).cloned().collect();
            if others.len() < moves.len() {
                is_changed = true;
                store::insert_moves(transaction, known.id, &others)?;
            }
        }
    }
    is_changed |= theirs > 0;
    is_changed |= store::delete_expectations(transaction, person)? > 0;
    if is_changed {
        // Earlier events about all persons do not bring them back after a restart.
        store::write(transaction, id, &Record::Gone { person, after: None })?;
    }
    Ok(theirs)
}

struct Forgets<'a> {
    person: PersonId,
    is_theirs: &'a IsTheirs,
    known: &'a Known,
}

impl Forgets<'_> {
    fn is_theirs(&self) -> bool {
        let (found, observation) = (store::attributed(self.known), &self.known.observation);
        match found.is_empty() {
            true => (self.is_theirs)(observation, None),
            false => found.into_iter().any(|found| (self.is_theirs)(observation, Some(found))),
        }
    }

    /// Whether a part of an event of others is the person's, or names them.
    fn names_them(&self, own: &Move) -> bool {
        let named = || {
            let event = own.event.clone()?;
            let observation = Observation { event, ..self.known.observation.clone() };
            let observation = Observation { person: own.person, name: own.name.clone(), ..observation };
            Some((self.is_theirs)(&observation, Some(own.person)))
        };
        own.person == self.person || named().unwrap_or_default()
    }

    /// The event without the person: the presence of others stays. `None` if it moved no other person.
    fn bare(&self) -> Option<(Observation, Option<Vec<Move>>)> {
        let Known { observation, moves, found, .. } = self.known;
        let mut bare = observation.clone();
        if let Some(moves) = moves {
            let others = moves.iter().filter(|own| ![self.person, PersonId::SOMEBODY].contains(&own.person));
            let other = |own: &Move| {
                let event = bare_presence(own.event.as_ref().unwrap_or(&observation.event));
                Move { event: Some(event), ..own.clone() }
            };
            let others: Vec<Move> = others.map(other).collect();
            (bare.person, bare.name, bare.by_fit) = (PersonId::SOMEBODY, None, false);
            bare.event = Event::Did(Sentence::new(BLANK).ok()?);
            return (!others.is_empty()).then_some((bare, Some(others)));
        }
        // Its key or the daemon gives it to another person.
        bare.event = bare_presence(&observation.event);
        let is_somebodys = bare.person != PersonId::SOMEBODY || bare.name.is_some() || found.is_some();
        if !is_somebodys || (self.is_theirs)(&bare, *found) {
            return None;
        }
        if let Some(found) = found {
            (bare.person, bare.by_fit) = (*found, true);
        }
        Some((bare, None))
    }
}

/// The presence of an event, without text and room.
fn bare_presence(event: &Event) -> Event {
    match event.person_presence() {
        Presence::Away => Event::Away,
        Presence::Gone => Event::Gone,
        Presence::Present | Presence::Unknown => Event::Present(None),
    }
}
