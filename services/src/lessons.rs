//! Learning habits from what was narrated before: a recording, a sensor log, or lines with times. All is told again to a board with
//! its own model, minute by minute in its own time, and what that has learned is given back. No port, no clock.

use roomcast_core::habits::{Habits, HabitsOptions, StoredError};
use roomcast_core::narration::{Observation, SOMEBODY, Said};
use roomcast_core::pipeline::PipelineError;
use roomcast_core::scorer::LanguageModel;
use roomcast_llama::LlamaModel;

use crate::config::Config;
use crate::daemon::{Board, BoardError, Entry, HomeHabits, Memory, Persons, PersonsFile, Zone};
use crate::line::{Item, Who};
use crate::message_text::said_of;
#[cfg(feature = "recording")]
use crate::recording::{Recorded, Recording};
use crate::sensor_log::SensorLog;
use crate::setup::{self, SetupError};

const MINUTE_NS: u64 = 60_000_000_000;
/// Over a longer silence nobody watched.
const GAP_NS: u64 = 36 * 3_600_000_000_000;

/// Why nothing was learned.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LessonError {
    /// Model, map or configuration.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The map does not fit into messages.
    #[error(transparent)]
    Board(#[from] BoardError),
    /// The model fails.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// What was learned before cannot be used.
    #[error(transparent)]
    Stored(#[from] StoredError),
}

/// Something that was narrated.
#[derive(Debug, Clone, PartialEq)]
pub struct Lesson {
    /// When it was observed, in Unix nanoseconds.
    at_unix_ns: u64,
    person: u32,
    name: Option<Box<str>>,
    said: Said,
}

impl Lesson {
    /// Of an item with its own time, or else observed at `at_unix_ns`; none where it says nothing that a daemon takes.
    fn of_item(item: &Item, at_unix_ns: Option<u64>) -> Option<Self> {
        let (person, name) = match &item.person {
            Who::Somebody => (SOMEBODY, None),
            Who::Number(number) => (*number, None),
            Who::Name(name) => (SOMEBODY, Some(name.as_str().into())),
        };
        let said = said_of(item.kind, &item.text).ok()?;
        Some(Self { at_unix_ns: item.observed_unix_ns.or(at_unix_ns)?, person, name, said })
    }

    /// Of lines that have times; gives how many have none, or say nothing.
    #[must_use]
    pub fn of_lines(items: &[Item]) -> (Vec<Self>, usize) {
        let lessons: Vec<Self> = items.iter().filter_map(|item| Self::of_item(item, None)).collect();
        let left_out = items.len() - lessons.len();
        (lessons, left_out)
    }

    /// Of a sensor log, whose times are local ones; gives how many lines are malformed, or say nothing.
    #[must_use]
    pub fn of_sensors(log: &SensorLog) -> (Vec<Self>, usize) {
        let mut at_s = log.begins_s.unwrap_or_default();
        let mut lessons = Vec::new();
        for item in &log.items {
            at_s += item.duration_s;
            lessons.extend(Self::of_item(item, Some((at_s.max(0.0) * 1e9) as u64)));
        }
        let malformed = usize::try_from(log.faults.count()).unwrap_or(usize::MAX);
        let left_out = malformed.saturating_add(log.items.len() - lessons.len());
        (lessons, left_out)
    }

    /// Of a recording; what was narrated without a time was observed when it was received, and what was sent again counts once.
    #[cfg(feature = "recording")]
    #[must_use]
    pub fn of_recording(recording: &Recording) -> Vec<Self> {
        let mut names = std::collections::BTreeSet::new();
        let lesson = |(received_unix_ns, message): &(u64, Recorded)| {
            let Recorded::Narration(narration) = message else { return None };
            let name = Some(narration.person_name().trim()).filter(|name| !name.is_empty());
            let at_unix_ns = match narration.observed_unix_ns {
                0 => *received_unix_ns,
                observed_unix_ns => observed_unix_ns.min(*received_unix_ns),
            };
            let said = said_of(narration.kind, narration.text()).ok()?;
            let new = names.insert((narration.source, narration.epoch, narration.sequence));
            new.then(|| Self { at_unix_ns, person: narration.person, name: name.map(Into::into), said })
        };
        recording.messages.iter().filter_map(lesson).collect()
    }
}

/// A board that learns on from what was learned before, with the model, map and persons of the configuration.
///
/// # Errors
/// When something of it cannot be set up, or what was learned before is malformed.
pub fn board(config: &Config, before: &str, zone: Zone) -> Result<Board<LlamaModel>, LessonError> {
    let (pipeline, map) = setup::open(config)?;
    let options = HabitsOptions { learn: true, ..config.habits.options() };
    let habits = Habits::from_json(options, before)?;
    let names = config.daemon.state_directory().map(|directory| PersonsFile::load(&directory)).unwrap_or_default();
    let board = Board::new(pipeline, map, config.grounding, 1)?;
    let board = board.with_persons(Persons::new(config.persons.clone(), names)).with_forecast(config.forecast);
    Ok(board.with_habits(HomeHabits::new(Memory::of(habits), zone).of_the_past()))
}

/// Tells all of it to a board, in the order of time; gives what it has learned then. `told` hears how many were told.
///
/// # Errors
/// When the model fails.
pub fn teach<M: LanguageModel>(
    mut board: Board<M>,
    mut lessons: Vec<Lesson>,
    mut told: impl FnMut(usize),
) -> Result<String, LessonError> {
    lessons.sort_by_key(|lesson| lesson.at_unix_ns);
    let mut now_ns = lessons.first().map_or(0, |lesson| lesson.at_unix_ns);
    // The monotonic clock of the board stands still while nobody watched.
    let mut skipped_ns = 0;
    for (sequence, lesson) in (1..).zip(lessons) {
        let Lesson { at_unix_ns, person, name, said } = lesson;
        if at_unix_ns - now_ns > GAP_NS {
            skipped_ns += at_unix_ns - now_ns - MINUTE_NS;
            now_ns = at_unix_ns;
        }
        while at_unix_ns - now_ns > MINUTE_NS {
            now_ns += MINUTE_NS;
            board.tick(now_ns - skipped_ns, now_ns);
        }
        now_ns = at_unix_ns;
        let observed_ns = now_ns - skipped_ns;
        let observation = Observation {
            person,
            name,
            by_fit: false,
            source: 1,
            epoch: 1,
            sequence,
            observed_ns,
            observed_unix_ns: now_ns,
            said,
        };
        board.step([Entry::new(observation, observed_ns)], observed_ns, now_ns)?;
        board.tell_outcomes(|_| {});
        // As a daemon does once a minute, also while much is narrated.
        board.tick(observed_ns, now_ns);
        while board.tidy() {}
        told(sequence as usize);
    }
    Ok(board.habits().to_json()?)
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::{Grounding, GroundingOptions};
    use roomcast_core::pipeline::{Pipeline, PipelineOptions};
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::semantic_map::SemanticMap;
    use roomcast_ipc::narration_kind;

    use super::*;
    use crate::sensor_log::SensorRules;

    /// Without a model that takes long; what it says is made up.
    fn board() -> Board<TableModel> {
        let map = SemanticMap::from_json(include_str!("../../tests/data/two_rooms.json")).unwrap();
        let options = GroundingOptions::default();
        let grounding = Grounding::new(&map, &options).unwrap();
        let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
        let home = HomeHabits::new(Memory::new(HabitsOptions::default()), Zone::UTC);
        Board::new(pipeline, map, options, 1).unwrap().with_habits(home)
    }

    fn item(at_s: u64, text: &str) -> Item {
        let observed_unix_ns = Some(at_s * 1_000_000_000);
        Item { observed_unix_ns, ..Item::new(narration_kind::SENTENCE, text, Who::Number(3)) }
    }

    #[test]
    fn lines_with_times_teach_a_home() {
        let days = (0..10).flat_map(|day| {
            let seven_s = 1_704_067_200 + day * 86_400 + 7 * 3_600;
            [item(seven_s, "They sit on the sofa."), item(seven_s + 1_800, "They open the fridge.")]
        });
        let without = Item::new(narration_kind::SENTENCE, "They wait.", Who::Somebody);
        // In any order, and one without a time; then nothing for a year.
        let late = item(1_740_000_000, "They sit on the sofa.");
        let items: Vec<Item> = days.chain([late, without]).rev().collect();
        let (lessons, left_out) = Lesson::of_lines(&items);
        assert_eq!((lessons.len(), left_out), (21, 1));
        let mut counted = 0;
        let json = teach(board(), lessons, |told| counted = told).unwrap();
        assert_eq!(counted, 21);
        let habits = Habits::from_json(HabitsOptions::default(), &json).unwrap();
        assert_eq!(habits.persons().collect::<Vec<_>>(), [(3, 21.0)]);
        assert!(json.contains("sofa") && !json.contains("They"));
        assert!(teach(board(), Vec::new(), |_| {}).is_ok());
    }

    #[test]
    fn a_sensor_log_teaches_a_home() {
        let rules =
            SensorRules::parse("[[rule]]\nsensor = \"fridge\"\nat = \"start\"\nsay = \"They open the {sensor}.\"\n");
        let log = "2024-03-01 08:15:00\t2024-03-01 08:15:10\tfridge\t-\t-\n2024-03-01 09:15:00\t2024-03-01 09:15:10\tfridge\t-\t-\n";
        let log = rules.unwrap().narrate(log.as_bytes(), &Who::Number(3));
        let (lessons, left_out) = Lesson::of_sensors(&log);
        assert_eq!((lessons.len(), left_out), (2, 0));
        assert_eq!(lessons[1].at_unix_ns - lessons[0].at_unix_ns, 3_600_000_000_000);
        assert_eq!(lessons[0].at_unix_ns, 1_709_280_900_000_000_000);
    }
}
