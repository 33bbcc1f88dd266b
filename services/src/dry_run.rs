//! `roomcast narrate --dry-run`: how the daemon would understand each event, without a daemon and without a language model.

use std::fmt::Write;

use roomcast_core::grounding::{Grounding, GroundingError};
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::{Observation, SensorReport};
use roomcast_core::pipeline::{Pipeline, PipelineError, PipelineOptions};
use roomcast_core::scorer::table::TableModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::raw::narration_kind;
use roomcast_ipc::sequence::source_of_name;
use serde::Serialize;

use crate::config::Config;
use crate::daemon::{Engine, EngineError, Entry, Persons, PersonsFile, UnderstoodLine};
use crate::line::{Item, Who};
use crate::message_text::event_of;
use crate::setup;

/// Seconds between two events without times.
const APART_S: u64 = 5;

/// A dry run cannot begin or continue.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DryRunError {
    /// The map cannot be loaded.
    #[error(transparent)]
    Setup(#[from] setup::SetupError),
    /// The map cannot be grounded.
    #[error(transparent)]
    Grounding(#[from] GroundingError),
    /// The map does not fit.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A step failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
}

/// The belief about one person's room, before and after an event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Belief {
    /// The person's name, or number.
    pub person: String,
    /// The likeliest place afterwards: a room's id, or `elsewhere`.
    pub place: String,
    /// Its probability afterwards.
    pub probability: f32,
    /// Its probability before.
    pub before: f32,
}

/// The effect of an event.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DryLine {
    /// The text of the event.
    pub text: String,
    /// The daemon's reading of it.
    pub understood: UnderstoodLine,
    /// The belief about each person of the event.
    pub beliefs: Vec<Belief>,
}

impl DryLine {
    /// The line for people.
    #[must_use]
    pub fn shown(&self) -> String {
        let UnderstoodLine { event, persons, by, place, left, why, nearest_form, .. } = &self.understood;
        let named: Vec<String> =
            persons.iter().map(|own| own.name.clone().unwrap_or_else(|| format!("person {}", own.person))).collect();
        let by = serde_json::to_value(by).ok().and_then(|by| by.as_str().map(str::to_owned)).unwrap_or_default();
        let mut text = format!("{}\n    {event}", self.text);
        if !named.is_empty() {
            let _ = write!(text, ", by {by}: {}", named.join(", "));
        }
        if let Ok(report) = SensorReport::parse(&self.text) {
            let _ = write!(text, "; {}", meaning(&report));
        }
        if let Some(place) = place {
            let _ = write!(text, "; {} {place}", if *left { "leaves" } else { "place:" });
        }
        for Belief { person, place, probability, before } in &self.beliefs {
            let _ = write!(text, "; {person} in {place} {probability:.2} (was {before:.2})");
        }
        if let Some(why) = why {
            let _ = write!(text, "\n    {why}");
        }
        if let Some(form) = nearest_form {
            let _ = write!(text, "\n    this sets no presence; the nearest form is {form:?} (docs/persons.md)");
        }
        text.push('\n');
        text
    }
}

fn meaning(report: &SensorReport) -> String {
    let SensorReport { kind, id, room, beyond, on, only_on, .. } = report;
    let mut words = format!("the {kind} sensor {id:?}");
    if let Some(room) = room {
        let _ = write!(words, " of the room {:?}", room.as_str());
    }
    if let Some(beyond) = beyond {
        let _ = write!(words, " to {:?}", beyond.as_str());
    }
    words.push_str(match on {
        Some(true) if *only_on => " is on for its hold time",
        Some(true) => " is on until its next report",
        Some(false) => " is off until its next report",
        None => " is unavailable, and says nothing until its next report",
    });
    words
}

/// Reads events as the daemon does, one after the other.
#[derive(Debug)]
pub struct DryRun {
    engine: Engine<TableModel>,
    source: u64,
    sequence: u64,
    now_ns: BootNs,
    unix_ns: UnixNs,
}

impl DryRun {
    /// The home of a configuration at a time of the wall clock.
    ///
    /// # Errors
    /// When the map cannot be used.
    pub fn new(config: &Config, now_unix_ns: UnixNs) -> Result<Self, DryRunError> {
        let map = setup::load_map(config.scene.path.as_deref())?;
        let names = config.daemon.state_directory().map(|directory| PersonsFile::load(&directory)).unwrap_or_default();
        let persons = Persons::new(config.persons.clone(), names);
        Self::of(map, config, persons, now_unix_ns)
    }

    fn of(map: SemanticMap, config: &Config, persons: Persons, now_unix_ns: UnixNs) -> Result<Self, DryRunError> {
        let grounding = Grounding::new(&map, &config.grounding)?;
        let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default())?;
        let named = config.daemon.narrator.iter().map(|known| (source_of_name(&known.name), known.may));
        let engine = Engine::new(pipeline, map, config.grounding, 1)?
            .with_persons(persons)
            .with_forecast(config.forecast)
            .with_named(named);
        let source = source_of_name(&config.narrator.name);
        Ok(Self { engine, source, sequence: 0, now_ns: BootNs(1_000_000_000_000), unix_ns: now_unix_ns })
    }

    /// The effect of an item after all items before it; `None` if the daemon would reject the item.
    ///
    /// # Errors
    /// When a step fails.
    pub fn take(&mut self, item: &Item) -> Result<Option<DryLine>, DryRunError> {
        let Ok(event) = event_of(item.kind, &item.text) else { return Ok(None) };
        if self.sequence == 0 {
            self.unix_ns = item.observed_unix_ns.unwrap_or(self.unix_ns);
        }
        let apart_ns = item.observed_unix_ns.map_or(APART_S * 1_000_000_000, |at_ns| at_ns.since(self.unix_ns));
        let late_ns = item.observed_unix_ns.map_or(0, |at_ns| self.unix_ns.since(at_ns));
        (self.sequence, self.now_ns) = (self.sequence + 1, self.now_ns + apart_ns);
        self.unix_ns = self.unix_ns + apart_ns;
        let (person, name) = match &item.person {
            Who::Somebody => (PersonId::SOMEBODY, None),
            Who::Number(number) => (*number, None),
            Who::Name(name) => (PersonId::SOMEBODY, Some(name.as_str().into())),
        };
        let observation = Observation {
            person,
            name,
            source: self.source,
            epoch: 1,
            observed_ns: BootNs(self.now_ns.0.saturating_sub(late_ns)),
            observed_unix_ns: UnixNs(self.unix_ns.0.saturating_sub(late_ns)),
            count: item.count,
            may_be_form: ![narration_kind::ACTION, narration_kind::DEVICE].contains(&item.kind),
            ..Observation::saying(self.sequence, event)
        };
        let before = self.places();
        self.engine.step([Entry::new(observation, self.now_ns)], self.now_ns, self.unix_ns)?;
        self.engine.tell_outcomes(|_| {});
        let after = self.places();
        let line = self.engine.understood_lines(self.source, 1, self.sequence).pop();
        Ok(line.map(|understood| {
            let belief = |person: PersonId| {
                let (_, own) = after.iter().find(|(number, _)| *number == person)?;
                let (place, probability) = own.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
                let earlier = before.iter().find(|(number, _)| *number == person).map(|(_, own)| own);
                let of_place = |own: &Vec<(String, f32)>| own.iter().find(|(other, _)| other == place).map(|(_, p)| *p);
                Some(Belief {
                    person: self
                        .engine
                        .persons()
                        .name_of(person)
                        .map_or_else(|| format!("person {person}"), str::to_owned),
                    place: place.clone(),
                    probability: *probability,
                    before: earlier.and_then(of_place).unwrap_or_default(),
                })
            };
            let beliefs = understood.persons.iter().filter_map(|own| belief(own.person)).collect();
            DryLine { text: item.text.clone(), understood, beliefs }
        }))
    }

    /// The belief about each person's place: rooms, and `elsewhere`.
    fn places(&mut self) -> Vec<(PersonId, Vec<(String, f32)>)> {
        let rooms: Vec<String> = self.engine.snapshot().rooms().iter().map(|room| room.id().to_owned()).collect();
        let forecasts = self.engine.person_forecasts(self.now_ns);
        let of = |own: &roomcast_ipc::raw::PersonForecastV1| {
            let places = rooms.iter().cloned().zip(own.probability.iter().map(|row| row[0]));
            (PersonId(own.person), places.chain([("elsewhere".to_owned(), own.elsewhere[0])]).collect())
        };
        forecasts.persons().iter().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::PersonsConfig;
    use crate::line::line_item;

    #[test]
    fn dry_runs_show_person_place_and_belief() {
        let map = SemanticMap::from_json(include_str!("../../scenes/flat.json")).unwrap();
        let residents = vec!["Ada".to_owned(), "Ben".to_owned()];
        let config = PersonsConfig { residents, ..PersonsConfig::default() };
        let persons = Persons::new(config, PersonsFile::default());
        let mut dry_run = DryRun::of(map, &Config::default(), persons, UnixNs(1_000_000_000_000_000_000)).unwrap();
        let mut shown = |line: &str| {
            let item = line_item(line, &Who::Somebody).unwrap();
            dry_run.take(&item).unwrap().unwrap().shown()
        };
        let two = shown("Two people are in the bathroom.");
        assert!(two.contains("by fit: Ada, Ben; place: bathroom"), "{two}");
        let ada = shown(r#"{"person": "ada", "text": "They open the fridge."}"#);
        assert!(ada.contains("did, by key: Ada; place: fridge; Ada in kitchen 0.9"), "{ada}");
        let near = shown("Ada leaves.");
        assert!(near.contains("by name: Ada") && near.contains("nearest form is \"NAME leaves the house\""), "{near}");
        let away = shown("Ada leaves the house.");
        assert!(away.contains("away, by name: Ada; Ada in elsewhere 1.00 (was 0.00)"), "{away}");
        for (line, part) in [
            (
                r#"{"sensor": "motion", "id": "pir", "room": "kitchen", "on": true}"#,
                r#"; the motion sensor "pir" of the room "kitchen" is on until its next report"#,
            ),
            (
                r#"{"sensor": "phone", "id": "p", "person": "ada", "on": null}"#,
                r#"; the phone sensor "p" is unavailable"#,
            ),
            (
                r#"{"sensor": "door", "id": "d", "room": "hall", "beyond": "porch", "on": true, "only_on": true}"#,
                r#"of the room "hall" to "porch" is on for its hold time"#,
            ),
        ] {
            let said = shown(line);
            assert!(said.contains(part), "{said}");
        }
    }

    #[test]
    fn a_dry_run_drops_a_line_that_is_too_late() {
        let map = SemanticMap::from_json(include_str!("../../scenes/flat.json")).unwrap();
        let persons = Persons::new(PersonsConfig::default(), PersonsFile::default());
        let mut dry_run = DryRun::of(map, &Config::default(), persons, UnixNs(2_000_000_000_000_000_000)).unwrap();
        let why = [900, 1_000, 700].map(|at_s| {
            let line = format!(r#"{{"person": "Ada", "text": "They open the fridge.", "observed_unix_s": {at_s}}}"#);
            dry_run.take(&line_item(&line, &Who::Somebody).unwrap()).unwrap().unwrap().understood.why
        });
        let late = "a later event of this person or device says otherwise";
        assert_eq!(why, [None, None, Some(late.to_owned())]);
    }

    #[test]
    fn a_dry_run_has_the_rights_of_its_narrator() {
        let config = "[[daemon.narrator]]\nname = \"phones\"\nmay = [\"presence\"]\n[[daemon.narrator]]\nname = \"cam\"\nmay = [\"did\"]\n";
        let why = |name: &str, text: &str| {
            let map = SemanticMap::from_json(include_str!("../../scenes/flat.json")).unwrap();
            let config: Config = format!("{config}[narrator]\nname = \"{name}\"\n").parse().unwrap();
            let residents = vec!["Ada".to_owned()];
            let persons = Persons::new(PersonsConfig { residents, ..PersonsConfig::default() }, PersonsFile::default());
            let mut dry_run = DryRun::of(map, &config, persons, UnixNs(1_000_000_000_000_000_000)).unwrap();
            let item = line_item(text, &Who::Somebody).unwrap();
            dry_run.take(&item).unwrap().unwrap().understood.why.unwrap_or_default()
        };
        assert_eq!(why("phones", "Everybody leaves the house."), "");
        for name in ["cam", "other"] {
            assert!(why(name, "Everybody leaves the house.").contains("may not set presence"), "{name}");
        }
        assert!(why("phones", "They sit on the sofa.").contains("may send presence only"));
    }
}
