//! Learns habits from the past: a recording, a sensor log, or lines with times. A engine with its own model gets all events at their times,
//! minute by minute, and returns what it has learned. It has no ports and no clock.

use std::collections::BTreeSet;
use std::fmt::Display;

use roomcast_core::habits::{Habits, HabitsOptions, StoredError};
use roomcast_core::ids::{BootNs, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation};
use roomcast_core::pipeline::PipelineError;
use roomcast_core::scorer::LanguageModel;
use roomcast_llama::LlamaModel;

use crate::config::Config;
use crate::daemon::{Engine, EngineError, Entry, HomeHabits, Memory, Persons, PersonsFile, Zone};
use crate::line::{FAST_NS, Faults, Item, Who, line_item};
use crate::message_text::event_of;
#[cfg(feature = "recording")]
use crate::recording::{Recorded, Recording};
use crate::sensor_log::{Said as Narrated, SensorLog};
use crate::setup::{self, SetupError};

const MINUTE_NS: u64 = 60_000_000_000;
/// A longer silence means that the home was not observed.
const GAP_NS: u64 = 36 * 3_600_000_000_000;

/// Learning failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LessonError {
    /// Model, map or configuration failed.
    #[error(transparent)]
    Setup(#[from] SetupError),
    /// The map does not fit into messages.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The model failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The earlier habits cannot be used.
    #[error(transparent)]
    Stored(#[from] StoredError),
}

/// An event to learn from.
#[derive(Debug, Clone, PartialEq)]
pub struct Lesson {
    /// The time of the event, in nanoseconds since 1970, by the clock of [`Lessons::zone`].
    at_ns: UnixNs,
    person: PersonId,
    name: Option<Box<str>>,
    count: u8,
    event: Event,
}

#[derive(Debug, thiserror::Error)]
enum Unfit {
    #[error("it has no time: give \"observed_unix_s\"")]
    NoTime,
    #[error("its time lies before 1970; correct it")]
    Early,
    #[error("its time lies {} ahead; give a time in the past, or set this machine's clock", in_words(*.0))]
    Prefetcher(u64),
    #[error("{0}")]
    Text(String),
}

fn in_words(length_ns: u64) -> String {
    let length_s = length_ns / 1_000_000_000;
    match length_s {
        0..120 => format!("{length_s} s"),
        120..7_200 => format!("{} min", length_s / 60),
        7_200..172_800 => format!("{} h", length_s / 3_600),
        _ => format!("{} days", length_s / 86_400),
    }
}

/// Events to learn from, from any input. All inputs share this check: an event without a time or in the future is not learned. A future
/// event would not fade until its time, and events in between would have no effect.
#[derive(Debug)]
pub struct Lessons {
    lessons: Vec<Lesson>,
    zone: Zone,
    now_ns: UnixNs,
    faults: Faults,
}

impl Lessons {
    /// No lessons yet. Times are of the wall clock in UTC, now `now_unix_ns`; hours of the day are of `zone`.
    #[must_use]
    pub fn of_wall_clock(zone: Zone, now_unix_ns: UnixNs) -> Self {
        Self { lessons: Vec::new(), zone, now_ns: now_unix_ns, faults: Faults::default() }
    }

    /// No lessons yet. Times are local times of `zone` without a time zone, as in logs; the wall clock is at `now_unix_ns`.
    #[must_use]
    pub fn of_local_time(zone: &Zone, now_unix_ns: UnixNs) -> Self {
        Self::of_wall_clock(Zone::UTC, UnixNs((zone.local_s(now_unix_ns).max(0.0) * 1e9) as u64))
    }

    /// Takes an event at `at_s` seconds since 1970, or else at its own time. If it cannot be learned, this adds a fault at `place`.
    pub fn take(&mut self, place: impl Display, item: &Item, at_s: Option<f64>) {
        let at_ns = match at_s {
            Some(at_s) if at_s < 0.0 => return self.faults.add_at(place, Unfit::Early),
            Some(at_s) => Some(UnixNs((at_s * 1e9) as u64)),
            None => item.observed_unix_ns,
        };
        let (person, name) = match &item.person {
            Who::Somebody => (PersonId::SOMEBODY, None),
            Who::Number(number) => (*number, None),
            Who::Name(name) => (PersonId::SOMEBODY, Some(name.as_str().into())),
        };
        let event = event_of(item.kind, &item.text).map_err(|error| Unfit::Text(error.to_string()));
        let count = item.count;
        self.admit(place, at_ns, event.map(|event| Lesson { at_ns: UnixNs(0), person, name, count, event }));
    }

    fn admit(&mut self, place: impl Display, at_ns: Option<UnixNs>, lesson: Result<Lesson, Unfit>) {
        let lesson = lesson.and_then(|lesson| {
            let at_ns = at_ns.ok_or(Unfit::NoTime)?;
            match at_ns.since(self.now_ns) {
                ahead_ns if ahead_ns > FAST_NS => Err(Unfit::Prefetcher(ahead_ns)),
                _ => Ok(Lesson { at_ns: at_ns.min(self.now_ns), ..lesson }),
            }
        });
        match lesson {
            Ok(lesson) => self.lessons.push(lesson),
            Err(unfit) => self.faults.add_at(place, unfit),
        }
    }

    /// Takes lines of JSON with times, as `roomcast narrate` does. `person` is for lines without one.
    pub fn take_lines(&mut self, text: &str, person: &Who) {
        for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty()) {
            match line_item(line, person) {
                Ok(item) => self.take(format_args!("line {number}"), &item, None),
                Err(error) => self.faults.add(number, error),
            }
        }
    }

    /// Takes a sensor log with local times, and its malformed lines.
    pub fn take_sensors(&mut self, log: SensorLog) {
        self.faults = log.faults;
        // A line with an event at its begin and at its end gives one fault at most.
        let mut unfit = BTreeSet::new();
        for Narrated { item, at_s, line, .. } in log.said {
            if !unfit.contains(&line) {
                let before = self.faults.count();
                self.take(format_args!("line {line}"), &item, Some(at_s));
                if self.faults.count() > before {
                    unfit.insert(line);
                }
            }
        }
    }

    /// Takes a recording. A narration without a time gets the time of its receipt, and a repeated one counts once.
    #[cfg(feature = "recording")]
    pub fn take_recording(&mut self, recording: &Recording) {
        let mut names = BTreeSet::new();
        let received = recording.received_unix_ns.iter().zip(&recording.messages);
        let narrations = received.filter_map(|(received_unix_ns, (_, message))| match message {
            Recorded::Narration(narration) => Some((*received_unix_ns, narration)),
            _ => None,
        });
        for (number, (received_unix_ns, narration)) in (1..).zip(narrations) {
            let number: u64 = number;
            let name = Some(narration.person_name().trim()).filter(|name| !name.is_empty());
            let at_unix_ns = match narration.observed_unix_ns {
                0 => received_unix_ns,
                observed_unix_ns => observed_unix_ns.min(received_unix_ns),
            };
            // The daemon rejected this narration.
            let Ok(event) = event_of(narration.kind, narration.text()) else { continue };
            if names.insert((narration.source, narration.epoch, narration.sequence)) {
                let (person, name, count) = (narration.person, name.map(Into::into), narration.counted());
                let lesson = Lesson { at_ns: UnixNs(0), person: PersonId(person), name, count, event };
                self.admit(format_args!("narration {number}"), Some(UnixNs(at_unix_ns)), Ok(lesson));
            }
        }
    }

    /// The events to learn from.
    #[must_use]
    pub fn lessons(&self) -> &[Lesson] {
        &self.lessons
    }

    /// The faults of the other events.
    #[must_use]
    pub fn faults(&self) -> &Faults {
        &self.faults
    }

    /// The home's time zone, for hours of the day.
    #[must_use]
    pub fn zone(&self) -> &Zone {
        &self.zone
    }
}

/// A engine that continues earlier habits, with the model, map and persons of the configuration.
///
/// # Errors
/// When the set-up fails, or the earlier habits are malformed.
pub fn engine(config: &Config, before: &str, zone: Zone) -> Result<Engine<LlamaModel>, LessonError> {
    let (pipeline, map) = setup::open(config)?;
    let options = HabitsOptions { learn: true, ..config.habits.options() };
    let habits = Habits::from_json(options, before)?;
    let names = config.daemon.state_directory().map(|directory| PersonsFile::load(&directory)).unwrap_or_default();
    let engine = Engine::new(pipeline, map, config.grounding, 1)?;
    let engine = engine.with_persons(Persons::new(config.persons.clone(), names)).with_forecast(config.forecast);
    Ok(engine.with_habits(HomeHabits::new(Memory::of(habits), zone).of_the_past()))
}

/// Gives all lessons to a engine by time, and returns its habits. `told` gets the count after each lesson.
///
/// # Errors
/// When the model fails.
pub fn teach<M: LanguageModel>(
    mut engine: Engine<M>,
    mut lessons: Vec<Lesson>,
    mut told: impl FnMut(usize),
) -> Result<String, LessonError> {
    lessons.sort_by_key(|lesson| lesson.at_ns);
    let mut now_ns = lessons.first().map_or(UnixNs(0), |lesson| lesson.at_ns);
    // The engine's monotonic clock skips unobserved times.
    let mut skipped_ns = 0;
    for (sequence, lesson) in (1..).zip(lessons) {
        let Lesson { at_ns, person, name, count, event } = lesson;
        if at_ns.since(now_ns) > GAP_NS {
            skipped_ns += at_ns.since(now_ns) - MINUTE_NS;
            now_ns = at_ns;
        }
        while at_ns.since(now_ns) > MINUTE_NS {
            now_ns = now_ns + MINUTE_NS;
            engine.tick(BootNs(now_ns.0 - skipped_ns), now_ns);
        }
        now_ns = at_ns;
        let observed_ns = BootNs(now_ns.0 - skipped_ns);
        let observation = Observation {
            person,
            name,
            by_fit: false,
            source: 1,
            epoch: 1,
            sequence,
            observed_ns,
            observed_unix_ns: now_ns,
            count,
            may_be_form: true,
            event,
        };
        engine.step([Entry::new(observation, observed_ns)], observed_ns, now_ns)?;
        engine.tell_outcomes(|_| {});
        // A daemon does this once a minute, even when events are frequent.
        engine.tick(observed_ns, now_ns);
        while engine.tidy() {}
        told(sequence as usize);
    }
    Ok(engine.habits().to_json()?)
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::pipeline::Pipeline;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::semantic_map::SemanticMap;
    use roomcast_ipc::raw::narration_kind;

    use super::*;
    use crate::sensor_log::SensorRules;

    /// The real model would take long; this one has invented scores.
    fn engine() -> Engine<TableModel> {
        let map = SemanticMap::from_json(include_str!("../../tests/data/two_rooms.json")).unwrap();
        let pipeline = Pipeline::of(&map, TableModel::new(7)).unwrap();
        let home = HomeHabits::new(Memory::new(HabitsOptions::default()), Zone::UTC);
        Engine::new(pipeline, map, GroundingOptions::default(), 1).unwrap().with_habits(home)
    }

    fn item(at_s: u64, text: &str) -> Item {
        let observed_unix_ns = Some(UnixNs(at_s * 1_000_000_000));
        Item { observed_unix_ns, ..Item::new(narration_kind::SENTENCE, text, Who::Number(PersonId(3))) }
    }

    /// 2024-03-01 08:15:00.
    const NOW_NS: u64 = 1_709_280_900_000_000_000;

    fn lines() -> Lessons {
        Lessons::of_wall_clock(Zone::UTC, UnixNs(NOW_NS))
    }

    #[test]
    fn lines_with_times_teach_a_home() {
        let days = (0..10).flat_map(|day| {
            let seven_s = 1_704_067_200 + day * 86_400 + 7 * 3_600;
            [item(seven_s, "They sit on the sofa."), item(seven_s + 1_800, "They open the fridge.")]
        });
        let without = Item::new(narration_kind::SENTENCE, "They wait.", Who::Somebody);
        // The events are unordered, one has no time, and a year without events precedes them.
        let early = item(1_670_000_000, "They sit on the sofa.");
        let mut lessons = lines();
        for item in days.chain([early, without]).collect::<Vec<_>>().iter().rev() {
            lessons.take("x", item, None);
        }
        assert_eq!((lessons.lessons().len(), lessons.faults().count()), (21, 1));
        let mut counted = 0;
        let json = teach(engine(), lessons.lessons().to_vec(), |told| counted = told).unwrap();
        assert_eq!(counted, 21);
        let habits = Habits::from_json(HabitsOptions::default(), &json).unwrap();
        assert_eq!(habits.persons().collect::<Vec<_>>(), [(PersonId(3), 21.0)]);
        assert!(json.contains("sofa") && !json.contains("They"));
        assert!(teach(engine(), Vec::new(), |_| {}).is_ok());
    }

    fn fridge(log: &str) -> SensorLog {
        let rules =
            SensorRules::parse("[[rule]]\nsensor = \"fridge\"\nat = \"start\"\nsay = \"They open the {sensor}.\"\n");
        rules.unwrap().narrate(log.as_bytes(), &Who::Number(PersonId(3)))
    }

    #[test]
    fn a_sensor_log_teaches_a_home() {
        let log = "2024-03-01 07:15:00\t2024-03-01 07:15:10\tfridge\t-\t-\n2024-03-01 08:15:00\t2024-03-01 08:15:00\tfridge\t-\t-\n";
        let mut lessons = Lessons::of_local_time(&Zone::UTC, UnixNs(NOW_NS));
        lessons.take_sensors(fridge(log));
        let times: Vec<u64> = lessons.lessons().iter().map(|lesson| lesson.at_ns.0).collect();
        assert_eq!((times, lessons.faults().count()), (vec![NOW_NS - 3_600_000_000_000, NOW_NS], 0));
    }

    /// With each input, an event without a time or in the future is not learned, and its fault names its place.
    #[test]
    fn nothing_is_learned_from_the_future() {
        let now_s = NOW_NS / 1_000_000_000;
        let told = |lessons: &Lessons| (lessons.lessons().len(), lessons.faults().told().to_vec());
        let mut of_lines = lines();
        let line = |at_s: &str| format!("{{\"text\": \"They sit.\", \"observed_unix_s\": {at_s}}}");
        let text = [line("1e9"), line("4e9"), "They sit.".to_owned(), String::new(), line(&format!("{now_s}.5"))];
        of_lines.take_lines(&text.join("\n"), &Who::Somebody);
        let (taken, faults) = told(&of_lines);
        assert_eq!((taken, faults.len()), (2, 2), "{faults:?}");
        assert!(
            faults[0].starts_with("line 2: its time lies 26512 days ahead")
                && faults[1].starts_with("line 3: it has no time")
        );
        // A second ahead is a difference of clocks, and counts as now.
        assert_eq!(of_lines.lessons()[1].at_ns, UnixNs(NOW_NS));
        let log =
            "2024-03-01 08:15:03\t2024-03-01 08:16:00\tfridge\n1e10\t1e10\tfridge\n-5\t-4\tfridge\n10\t20\tfridge\n";
        let rules = "columns = [\"start\", \"end\", \"sensor\"]\n[[rule]]\nsay = \"They open the {sensor}.\"\n\
            [[rule]]\nat = \"end\"\nsay = \"They close the {sensor}.\"\n";
        let mut of_sensors = Lessons::of_local_time(&Zone::UTC, UnixNs(NOW_NS));
        of_sensors.take_sensors(SensorRules::parse(rules).unwrap().narrate(log.as_bytes(), &Who::Somebody));
        let (taken, faults) = told(&of_sensors);
        assert_eq!(taken, 2, "begin and end of the one in 1970");
        assert_eq!(faults.len(), 3, "{faults:?}");
        assert!(
            faults[0].starts_with("line 3: its time lies before 1970")
                && faults[1].starts_with("line 1: its time lies 3 s")
        );
        let mut day = lines();
        day.take("day 3, action 5", &item(now_s + 86_400, "They sit."), None);
        assert_eq!(
            told(&day),
            (
                0,
                vec![
                    "day 3, action 5: its time lies 24 h ahead; give a time in the past, or set this machine's clock"
                        .to_owned()
                ]
            )
        );
    }

    #[cfg(feature = "recording")]
    fn message(sequence: u64, observed_unix_ns: UnixNs) -> Recorded {
        let narration = roomcast_ipc::raw::NarrationV1::new(narration_kind::SENTENCE, "They sit.").unwrap();
        Recorded::Narration(Box::new(roomcast_ipc::raw::NarrationV1 {
            sequence,
            observed_unix_ns: observed_unix_ns.0,
            ..narration
        }))
    }

    /// The recording's times continue from a start in 1970, and the clock was set during it.
    #[cfg(feature = "recording")]
    #[test]
    fn a_recording_over_a_clock_that_was_set_teaches_hours_by_the_right_one() {
        let messages = vec![(1, message(1, UnixNs(0))), (2, message(2, UnixNs(NOW_NS - 7)))];
        let mut lessons = lines();
        let received_unix_ns = vec![NOW_NS - 9, NOW_NS - 5];
        lessons.take_recording(&Recording { messages, received_unix_ns, ..Recording::default() });
        let times: Vec<u64> = lessons.lessons().iter().map(|lesson| lesson.at_ns.0).collect();
        assert_eq!(times, [NOW_NS - 9, NOW_NS - 7]);
    }

    /// The recording machine's clock was ahead.
    #[cfg(feature = "recording")]
    #[test]
    fn a_recording_of_the_future_teaches_nothing() {
        let messages = vec![
            (NOW_NS, message(1, UnixNs(0))),
            (2 * NOW_NS, message(2, UnixNs(2 * NOW_NS))),
            (2 * NOW_NS, message(3, UnixNs(NOW_NS))),
        ];
        let mut lessons = lines();
        let received_unix_ns = vec![NOW_NS, 2 * NOW_NS, 2 * NOW_NS];
        lessons.take_recording(&Recording { messages, received_unix_ns, ..Recording::default() });
        assert_eq!((lessons.lessons().len(), lessons.faults().count()), (2, 1));
        assert!(lessons.faults().told()[0].starts_with("narration 2: its time lies"));
    }

    /// A log in plain seconds, learned into a home that knows something.
    #[test]
    fn what_is_of_long_ago_harms_nothing_that_is_known() {
        let mut lessons = Lessons::of_local_time(&Zone::UTC, UnixNs(NOW_NS));
        let day = |day: u64| format!("{}\t{}\tfridge\t-\t-\n", day * 86_400, day * 86_400 + 5);
        let recent: String = (19_770..19_780).map(day).collect();
        lessons.take_sensors(fridge(&recent));
        let json = teach(engine(), lessons.lessons().to_vec(), |_| {}).unwrap();
        let known = |json: &str| Habits::from_json(HabitsOptions::default(), json).unwrap();
        let engine = engine().with_habits(HomeHabits::new(Memory::of(known(&json)), Zone::UTC).of_the_past());
        let mut old = Lessons::of_local_time(&Zone::UTC, UnixNs(NOW_NS));
        old.take_sensors(fridge("100\t105\tfridge\t-\t-\n600\t605\tfridge\t-\t-\n"));
        let after = teach(engine, old.lessons().to_vec(), |_| {}).unwrap();
        let after = known(&after);
        assert_eq!(after.observations(PersonId(3)), 12.0);
        Habits::from_stored(HabitsOptions::default(), after.stored()).unwrap();
    }
}
