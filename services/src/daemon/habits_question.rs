//! Questions about habits on `roomcast/v1/habits`, and their answers. No port, no clock.

use serde::{Deserialize, Serialize};

use super::asked::{Answer, Question};
use super::engine::Engine;
use crate::habits_reason::HorizonLine;
use roomcast_core::habits::{BYTES_MAX, PARTS};
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::scorer::LanguageModel;

/// Most bytes of one part of an import, because a question has a limit.
pub const PART_BYTES: usize = 1 << 18;
/// Most bytes of a whole import.
pub const IMPORT_BYTES_MAX: usize = 4 * BYTES_MAX;

/// A question. A change has a unique name; the same name gets the same answer, without a second change.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "ask", rename_all = "kebab-case", deny_unknown_fields)]
pub enum HabitsQuestion {
    /// The amount of learned habits, and their part in the forecast.
    Show,
    /// The learned habits as JSON.
    Export,
    /// Forget the habits of a person, or all habits.
    Forget {
        /// The question's name.
        id: String,
        /// A name or a number; all persons if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        who: Option<String>,
    },
    /// Replace all habits by an export. Its parts come in order, each with its own name.
    Import {
        /// The question's name.
        id: String,
        /// The name of the whole import.
        whole: String,
        /// The index of this part, from 0.
        part: usize,
        /// The number of parts.
        parts: usize,
        /// The part.
        text: String,
        /// The import is refused if [`HabitsAnswer::taken`] is another number, because newer habits would be lost. Any number if left out.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        expected: Option<u64>,
    },
}

impl Question for HabitsQuestion {
    fn id(&self) -> Option<&str> {
        match self {
            Self::Show | Self::Export => None,
            Self::Forget { id, .. } | Self::Import { id, .. } => Some(id),
        }
    }
}

/// The habits of a person.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HabitsLine {
    /// The number.
    pub person: PersonId,
    /// The name, if the person has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The number of events learned from.
    pub observations: f64,
    /// About how many hours the person's place was known. Presence counts here, but not in `observations`.
    #[serde(default)]
    pub watched_h: f64,
    /// The horizons of the present forecast; empty if habits add nothing to it.
    pub forecast: Vec<HorizonLine>,
}

/// The visits of a room by all persons.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VisitsLine {
    /// The room's id.
    pub room: String,
    /// Ended visits in each part of the day, from midnight on, rounded to a hundredth. Older visits count less.
    pub by_part: [f64; PARTS],
}

/// The answer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct HabitsAnswer {
    /// Whether the question was done.
    pub done: bool,
    /// The reason for a refusal, or the work that is left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Whether a restarted daemon has the habits, which needs a state directory.
    pub kept: bool,
    /// Whether the daemon learns now.
    pub learn: bool,
    /// The number of known things.
    pub names: usize,
    /// The number of known contexts.
    pub contexts: usize,
    /// The number of counts in these contexts.
    pub counts: usize,
    /// The size in memory.
    pub bytes: usize,
    /// The number of changes since the daemon started: by an event, by forgetting, by an import.
    pub taken: u64,
    /// Whether an import was refused because the daemon learned in the meantime.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub learned_meanwhile: bool,
    /// The persons with habits.
    pub persons: Vec<HabitsLine>,
    /// The visits of each room of the map by all persons together.
    #[serde(default)]
    pub visits: Vec<VisitsLine>,
    /// The answer to [`HabitsQuestion::Export`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub export: Option<String>,
}

impl Answer for HabitsAnswer {
    fn reason(&mut self) -> &mut Option<String> {
        &mut self.reason
    }
}

/// The parts of an unfinished import.
#[derive(Debug, Default)]
pub(super) struct Importing {
    whole: String,
    parts: usize,
    text: String,
}

impl Importing {
    /// Adds a part. Returns the whole import if this is its last part.
    fn take(&mut self, whole: &str, (part, parts): (usize, usize), text: &str) -> Result<Option<String>, String> {
        if part == 0 {
            *self = Self { whole: whole.to_owned(), ..Self::default() };
        }
        if self.whole != whole || self.parts != part || part >= parts {
            return Err("another import has begun meanwhile, or parts came out of order: import again".to_owned());
        }
        if self.text.len() + text.len() > IMPORT_BYTES_MAX {
            *self = Self::default();
            return Err(format!("it has more than {IMPORT_BYTES_MAX} bytes: that is no export of habits"));
        }
        self.text.push_str(text);
        self.parts += 1;
        Ok((self.parts == parts).then(|| std::mem::take(self).text))
    }
}

/// The work on the disk after a question.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum After {
    Nothing,
    /// The habits must be written, and earlier answers dropped.
    Forget,
}

/// Does everything but the work on the disk.
pub(super) fn answer<M: LanguageModel>(
    engine: &mut Engine<M>,
    importing: &mut Importing,
    asked: Result<HabitsQuestion, String>,
    now_ns: BootNs,
) -> (HabitsAnswer, After) {
    let mut export = None;
    let (mut after, mut learned_meanwhile) = (After::Nothing, false);
    let result = asked.and_then(|question| match question {
        HabitsQuestion::Show => Ok(()),
        HabitsQuestion::Export => {
            export = Some(engine.habits().to_json().map_err(|error| error.to_string())?);
            Ok(())
        }
        HabitsQuestion::Forget { who: None, .. } => {
            engine.habits_mut().forget_all();
            engine.bind_habits();
            engine.forget_prefetched();
            after = After::Forget;
            Ok(())
        }
        HabitsQuestion::Forget { who: Some(who), .. } => {
            let person = engine.persons().meant(&who);
            if !engine.habits_mut().forget(person) {
                return Err(format!(
                    "nothing was learned of {who:?}: `roomcast habits show` says of whom something was"
                ));
            }
            // The prefetcher also knows the person's events.
            engine.forget_prefetched();
            after = After::Forget;
            Ok(())
        }
        HabitsQuestion::Import { whole, part, parts, text, expected, .. } => {
            let Some(json) = importing.take(&whole, (part, parts), &text)? else { return Ok(()) };
            learned_meanwhile = expected.is_some_and(|expected| expected != engine.habits().taken());
            if learned_meanwhile {
                return Err("it has learned something meanwhile, which would be lost: try again".to_owned());
            }
            engine.habits_mut().take_json(&json).map_err(|error| error.to_string())?;
            engine.bind_habits();
            after = After::Forget;
            Ok(())
        }
    });
    engine.forecast(now_ns);
    let habits = engine.habits();
    let learned = habits.learned();
    let line = |(person, observations): (PersonId, f64)| HabitsLine {
        person,
        name: engine.persons().name_of(person).map(str::to_owned),
        observations,
        watched_h: habits.watched_h(person),
        forecast: engine.habits_ahead(person),
    };
    let answer = HabitsAnswer {
        done: result.is_ok(),
        reason: result.err(),
        kept: false,
        learn: habits.learns_now(),
        names: learned.names,
        contexts: learned.contexts,
        counts: learned.counts,
        bytes: learned.bytes,
        taken: habits.taken(),
        learned_meanwhile,
        persons: habits.persons().into_iter().map(line).collect(),
        visits: visits(engine),
        export,
    };
    (answer, after)
}

/// Adding zero removes the sign of a negative zero, such as an empty sum.
fn hundredth(count: f64) -> f64 {
    (count * 100.0).round() / 100.0 + 0.0
}

fn visits<M: LanguageModel>(engine: &Engine<M>) -> Vec<VisitsLine> {
    let line =
        |(room, by_part): (&str, [f64; PARTS])| VisitsLine { room: room.to_owned(), by_part: by_part.map(hundredth) };
    engine.room_ids().zip(engine.habits().visits()).map(line).collect()
}

#[cfg(test)]
mod tests {
    use roomcast_core::grounding::GroundingOptions;
    use roomcast_core::habits::{Habits, HabitsOptions, Place};
    use roomcast_core::narration::person_number;
    use roomcast_core::pipeline::Pipeline;
    use roomcast_core::scorer::table::TableModel;
    use roomcast_core::semantic_map::SemanticMap;

    use super::*;
    use crate::daemon::{HomeHabits, Memory, Zone};

    #[test]
    fn parts_make_a_whole_in_their_order() {
        let mut importing = Importing::default();
        assert_eq!(importing.take("a", (0, 3), "x"), Ok(None));
        assert_eq!(importing.take("a", (1, 3), "y"), Ok(None));
        assert!(importing.take("a", (1, 3), "y").is_err());
        assert!(importing.take("b", (2, 3), "z").is_err());
        assert_eq!(importing.take("a", (2, 3), "z"), Ok(Some("xyz".to_owned())));
        assert!(importing.take("a", (3, 3), "z").is_err());
        assert_eq!(importing.take("b", (0, 1), "all"), Ok(Some("all".to_owned())));
        assert!(importing.take("c", (0, 0), "").is_err());
    }

    #[test]
    fn no_count_is_less_than_nothing() {
        let told = |count: f64| serde_json::to_string(&hundredth(count)).unwrap();
        assert_eq!([-0.0, std::iter::empty::<f64>().sum(), 0.0, 1.236].map(told), ["0.0", "0.0", "0.0", "1.24"]);
    }

    fn engine(memory: Memory) -> Engine<TableModel> {
        let map = SemanticMap::from_json(include_str!("../../../tests/data/two_rooms.json")).unwrap();
        let pipeline = Pipeline::of(&map, TableModel::new(7)).unwrap();
        let engine = Engine::new(pipeline, map, GroundingOptions::default(), 1).unwrap();
        engine.with_habits(HomeHabits::new(memory, Zone::UTC))
    }

    /// Presence without an action counts as time in a known place.
    #[test]
    fn hours_in_known_places_count_without_a_thing() {
        let mut memory = Memory::new(HabitsOptions::default());
        memory.habits.bind(Vec::new(), vec!["kitchen".to_owned()], Vec::new());
        memory.habits.be(PersonId(7), Place::Room(0), 1e9);
        (0..=180).for_each(|minute| {
            memory.habits.tick(PersonId(7), 1e9 + 60.0 * f64::from(minute), &mut |_, p| p.fill(0.5))
        });
        memory.habits = Habits::from_stored(HabitsOptions::default(), memory.habits.stored()).unwrap();
        let mut engine = engine(memory);
        let (answer, _) = answer(&mut engine, &mut Importing::default(), Ok(HabitsQuestion::Show), BootNs(0));
        let line = &answer.persons[0];
        assert!(line.observations == 0.0 && (line.watched_h - 3.0).abs() < 0.1, "{line:?}");
    }

    /// A regression: an import by `habits learn` restored persons that were forgotten while it ran, and of two imports at once, one was lost.
    #[test]
    fn nothing_is_put_in_place_of_what_was_changed_meanwhile() {
        let mut memory = Memory::new(HabitsOptions::default());
        memory.habits.bind(Vec::new(), vec!["kitchen".to_owned()], Vec::new());
        memory.habits.be(PersonId(7), Place::Room(0), 1e9);
        memory.habits.be(PersonId(7), Place::Elsewhere, 1e9 + 3_600.0);
        let mut engine = engine(memory);
        let (mut importing, mut number) = (Importing::default(), 0);
        let mut ask = |question| {
            let (answer, _) = answer(&mut engine, &mut importing, Ok(question), BootNs(0));
            (answer.done, answer.taken, answer.export.unwrap_or_default())
        };
        let mut import = |text: &str, expected| {
            number += 1;
            let whole = number.to_string();
            HabitsQuestion::Import {
                id: whole.clone(),
                whole,
                part: 0,
                parts: 1,
                text: text.to_owned(),
                expected: Some(expected),
            }
        };
        let (_, taken, export) = ask(HabitsQuestion::Export);
        assert!(ask(import(&export, taken)).0, "nothing has changed");
        assert!(!ask(import(&export, taken)).0, "another import was first");
        let (_, taken, export) = ask(HabitsQuestion::Export);
        for who in [Some("7".to_owned()), None] {
            assert!(ask(HabitsQuestion::Forget { id: format!("{who:?}"), who }).0);
            assert!(!ask(import(&export, taken)).0, "somebody was forgotten meanwhile");
        }
    }

    /// Names are read as in questions about persons: a number has digits only.
    #[test]
    fn a_name_that_reads_like_a_number_is_a_name() {
        let ada = person_number("ada");
        let mut memory = Memory::new(HabitsOptions::default());
        memory.habits.bind(Vec::new(), vec!["kitchen".to_owned()], Vec::new());
        memory.habits.be(ada, Place::Room(0), 1e9);
        memory.habits.be(ada, Place::Elsewhere, 1e9 + 3_600.0);
        let mut engine = engine(memory);
        let mut is_done = |who: String| {
            let question = HabitsQuestion::Forget { id: "1".to_owned(), who: Some(who) };
            answer(&mut engine, &mut Importing::default(), Ok(question), BootNs(0)).0.done
        };
        assert!(!is_done(format!("+{ada}")));
        assert!(is_done(format!(" {ada} ")) && !is_done("ada".to_owned()), "it is forgotten");
    }

    /// `docs/json.md` lists the keys of each answer.
    #[test]
    fn an_answer_has_no_key_of_another_question() {
        let told = |answer: &HabitsAnswer| serde_json::to_string(answer).unwrap();
        assert!(!told(&HabitsAnswer::default()).contains("learned_meanwhile"));
        let refused = HabitsAnswer { learned_meanwhile: true, ..HabitsAnswer::default() };
        assert_eq!(serde_json::from_str::<HabitsAnswer>(&told(&refused)).unwrap(), refused);
        assert!(!serde_json::from_str::<HabitsAnswer>(&told(&HabitsAnswer::default())).unwrap().learned_meanwhile);
    }

    #[test]
    fn questions_are_words() {
        let forget = HabitsQuestion::Forget { id: "7".to_owned(), who: None };
        assert_eq!(serde_json::to_string(&forget).unwrap(), r#"{"ask":"forget","id":"7"}"#);
        assert!(serde_json::from_str::<HabitsQuestion>(r#"{"ask":"forget"}"#).is_err());
    }
}
