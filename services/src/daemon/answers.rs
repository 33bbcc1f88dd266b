//! The daemon's answers to questions about its map and about persons, and the requested changes.

use std::io;
use std::time::Instant;

use roomcast_core::ids::PersonId;
use roomcast_core::narration::Observation;
use roomcast_core::narration::line::Who;
use roomcast_core::pipeline::Prepared;
use roomcast_core::scorer::LanguageModel;
use roomcast_core::text::did_you_mean;

use super::engine::Engine;
use super::journal::{JournalHandle, PATIENCE};
use super::map_change::{KeptMap, MapAnswer, MapQuestion, Outcome};
use super::person_question::{PersonAnswer, PersonQuestion};
use super::persons::{Called, NotRenamed};
use crate::clock;

/// Applies a possible change to the engine and returns the result. `scene` is the fingerprint of the configured scene.
pub(super) fn answer_change<M: LanguageModel>(
    engine: &mut Engine<M>,
    journal: Option<&JournalHandle>,
    scene: &str,
    asked: Result<MapQuestion, String>,
) -> MapAnswer {
    let start_ns = clock::monotonic_ns();
    let in_use = hex::encode(engine.map().fingerprint());
    let result = asked.map_err(|reason| (Outcome::Refused, reason)).and_then(|question| {
        if let Some(expected) = question.expected_map.filter(|expected| !expected.eq_ignore_ascii_case(&in_use)) {
            return Err((Outcome::OtherMap, format!("the map in use is {in_use}, not {expected}")));
        }
        let refused = |error: &dyn std::error::Error| (Outcome::Refused, crate::logging::chain(error));
        let map = engine.map().changed(question.changes).map_err(|error| refused(&error))?;
        engine.change_map(map).map_err(|error| refused(&error))
    });
    let regrouped_in_ns = clock::monotonic_ns().since(start_ns);
    engine.tell_beliefs(|believed| _ = journal.map(|journal| journal.append(believed)));
    // The writer has the places of persons first.
    let kept = journal.filter(|_| result.is_ok()).is_some_and(|journal| {
        let map = KeptMap::new(scene.to_owned(), engine.map());
        let written = journal.ask(|writer| writer.write_map(map), Instant::now() + PATIENCE);
        written.inspect_err(|error| tracing::error!(%error, "the changed map cannot be kept for a restart")).is_ok()
    });
    let (outcome, reason, prepared) = match result {
        Ok(prepared) => (Outcome::Applied, None, prepared),
        Err((outcome, reason)) => (outcome, Some(reason), Prepared::default()),
    };
    MapAnswer {
        outcome,
        reason,
        map: hex::encode(engine.map().fingerprint()),
        epoch: format!("{:016x}", engine.snapshot().epoch),
        sequence: engine.snapshot().sequence,
        rooms: engine.map().rooms().len(),
        items: engine.map().items().len(),
        outside: engine.pipeline().grounding().unassigned().len(),
        new_labels: prepared.new_labels,
        prepared_again: prepared.again,
        regrouped_in_ns,
        kept,
    }
}

/// Does the requested change of a person, and returns the known persons after it.
pub(super) fn answer_about_person<M: LanguageModel>(
    engine: &mut Engine<M>,
    journal: Option<&JournalHandle>,
    asked: Result<PersonQuestion, String>,
) -> PersonAnswer {
    let find = |engine: &Engine<M>, who: &str| {
        engine.persons().find(who).ok_or_else(|| match engine.persons().is_resident(engine.persons().meant(who)) {
            true => format!(
                "no report has told of the resident {who:?} yet: an event with this name does, such as an action, a presence, or the person's phone or bed sensor"
            ),
            false => {
                let lines = engine.persons().lines(0);
                let names = lines.iter().filter_map(|line| line.name.as_deref());
                let meant = did_you_mean(who, names);
                format!("no person is known as {who:?}: `roomcast person list` shows all{meant}")
            }
        })
    };
    let (mut failed, mut understood, mut whereabouts) = (false, Vec::new(), None);
    let clock_ns = clock::monotonic_ns();
    let result = asked.and_then(|question| match question {
        PersonQuestion::List => Ok(None),
        PersonQuestion::Understood { source, epoch, from } => {
            understood = engine.understood_lines(source, epoch, from);
            Ok(None)
        }
        PersonQuestion::Where { who } => {
            let person = find(engine, &who)?;
            whereabouts = Some(engine.whereabouts(person, clock_ns));
            Ok(None)
        }
        PersonQuestion::Room { room } => engine.check_room(&room).map(|()| None),
        PersonQuestion::Rename { who, name, .. } => {
            let person = find(engine, &who)?;
            let renamed = engine.rename(person, &name);
            failed = matches!(renamed, Err(NotRenamed::Failed(_)));
            renamed.map(|()| None).map_err(|error| error.to_string())
        }
        PersonQuestion::Forget { who, .. } => {
            // Files may still mention a person that the engine no longer knows.
            let (is_known, person) = (find(engine, &who), engine.persons().meant(&who));
            let is_learned = engine.habits().persons().iter().any(|(known, _)| *known == person);
            let is_somebody = is_known.is_ok() || is_learned;
            if !is_somebody {
                who.parse::<Who>().map_err(|error| error.to_string())?;
            }
            let (left, records) = forget(engine, journal, person, &who, is_somebody);
            if records == 0 && !is_learned { is_known.map(|_| left) } else { Ok(left) }
        }
    });
    let now_ns = i64::try_from(clock_ns.0).unwrap_or(i64::MAX);
    let (done, left) = (result.is_ok(), result.unwrap_or_else(Some));
    let is_kept = engine.persons().file().is_kept() && journal.is_none_or(JournalHandle::is_kept);
    let kept = done && left.is_none() && is_kept;
    PersonAnswer { done, reason: left, failed, kept, persons: engine.persons().lines(now_ns), understood, whereabouts }
}

/// Forgets a person, also on the disk. Returns the reason if the disk failed, and the number of deleted journal records. For a known person
/// (`is_somebody`), other persons' events that mention the name are deleted as well; an unknown name might be any word.
fn forget<M: LanguageModel>(
    engine: &mut Engine<M>,
    journal: Option<&JournalHandle>,
    person: PersonId,
    who: &str,
    is_somebody: bool,
) -> (Option<String>, usize) {
    let called = Called::new(engine.persons(), person, who);
    let is_theirs = move |observation: &Observation, found: Option<PersonId>| {
        let names_them = || called.is_in(&observation.event.to_string());
        let own = match (&observation.name, found) {
            (Some(name), _) if called.is_in(name) => true,
            (_, Some(found)) if found == person => true,
            (Some(_), _) => false,
            (None, None) if observation.person == PersonId::SOMEBODY => names_them(),
            (None, _) => observation.person == person,
        };
        own || is_somebody && names_them()
    };
    // Observations in a window are already attributed.
    engine.forget(person, |observation| is_theirs(observation, Some(observation.person)));
    let until = Instant::now() + PATIENCE;
    let in_file = engine.persons_mut().file.set(person, None);
    let in_journal =
        journal.map_or(Ok(0), |journal| journal.ask(move |writer| writer.forget(person, &is_theirs), until));
    let records = match &in_journal {
        Ok(records) => *records,
        // The rows are deleted, and a later sync erases them: a name that no person has is no success.
        Err(error) => usize::from(error.kind() != io::ErrorKind::ResourceBusy),
    };
    let in_habits = forget_habits(engine, journal, until);
    let error = in_journal.err().or(in_file.err()).or(in_habits.err());
    (error.map(|error| not_yet_kept(&error)), records)
}

/// Why the disk still has data of a forgotten person, and the remedy.
fn not_yet_kept(error: &io::Error) -> String {
    if error.kind() == io::ErrorKind::TimedOut {
        let patience_s = PATIENCE.as_secs();
        return format!(
            "they are forgotten in memory; the files of the state directory are still being rewritten after {patience_s} s, which goes on: ask \
             again until no person is known by that name"
        );
    }
    if error.kind() == io::ErrorKind::ResourceBusy {
        return format!("they are forgotten, but {error}, and the file has their deleted rows until that program ends");
    }
    format!("they are forgotten until the daemon starts again: the state directory cannot be written: {error}")
}

/// Writes the remaining habits after a person was forgotten, and waits `until` then.
pub(super) fn forget_habits<M: LanguageModel>(
    engine: &mut Engine<M>,
    journal: Option<&JournalHandle>,
    until: Instant,
) -> io::Result<()> {
    let Some(journal) = journal else { return Ok(()) };
    let Some(memory) = engine.habits_mut().memory_if_changed() else { return Ok(()) };
    journal.keep_habits(memory);
    journal.ask(|writer| writer.forget_habits(), until)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slow journal is not a failing disk, and has another remedy.
    #[test]
    fn whoever_waits_too_long_is_told_to_ask_again() {
        let slow = not_yet_kept(&io::Error::from(io::ErrorKind::TimedOut));
        assert!(slow.contains("still being rewritten after 5 s") && slow.contains("ask again"), "{slow}");
        assert!(!slow.contains("cannot be written"), "{slow}");
        let full = not_yet_kept(&io::Error::from(io::ErrorKind::StorageFull));
        assert!(full.contains("cannot be written: ") && !full.contains("ask again"), "{full}");
    }
}
