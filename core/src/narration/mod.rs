//! Narration: what a person has just done, as one sentence per observation, and the window of it that a prompt holds. Actions in VirtualHome's
//! notation ([`Action`]), device states ([`device_state`]) and plain sentences of any captioning source become a [`Sentence`].

use std::fmt;
use std::sync::Arc;

use crate::ids::{BootNs, EventId, PersonId, UnixNs};
use crate::text::is_hidden;

pub mod action;
mod event;
pub mod forms;
pub mod history;
pub mod line;
mod person;
pub mod program;
mod sensor;

pub use action::{Action, ActionEntry, LINE_BYTES_MAX, ObjectRef, table as action_table};
pub use event::{Event, Presence, RoomName};
pub use history::{Histories, History, HistoryLimits, PERSONS_MAX, Quota};
pub use person::{
    PERSON_NAME_BYTES_MAX, ReadName, check_name, is_number, name_words, person_number, same_but_for_accents, same_name,
};
pub use program::{PROGRAM_BYTES_MAX, Program, STEPS_MAX};
pub use sensor::{SENSOR_ID_BYTES_MAX, SensorKind, SensorReport};

/// Longest sentence of one observation, in bytes of UTF-8; the narration message holds as many.
pub const SENTENCE_BYTES_MAX: usize = 1024;

/// Why a text is no narration, with the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct TextError(pub String);

fn refused<T>(reason: impl Into<String>) -> Result<T, TextError> {
    Err(TextError(reason.into()))
}

/// Refuses control characters, except those that `is_allowed` selects.
fn check_control(text: &str, what: &str, is_allowed: impl Fn(char) -> bool) -> Result<(), TextError> {
    match text.chars().find(|c| is_hidden(*c) && !is_allowed(*c)) {
        Some(c) => refused(format!("{what} holds the control character U+{:04X}: remove it", u32::from(c))),
        None => Ok(()),
    }
}

/// A plain sentence in the form the prompt wants: single spaces, a capital first letter, closing punctuation. Its copies share one text.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Sentence(Arc<str>);

impl Sentence {
    /// Normalises `text`. Line breaks and tabs count as space.
    ///
    /// # Errors
    /// Empty, overlong texts and control characters are refused.
    pub fn new(text: &str) -> Result<Self, TextError> {
        let too_long = |bytes: usize| {
            refused(format!(
                "the sentence has {bytes} bytes, more than {SENTENCE_BYTES_MAX}: shorten it or send it as several observations"
            ))
        };
        if text.len() > SENTENCE_BYTES_MAX {
            return too_long(text.len());
        }
        check_control(text, "the sentence", char::is_whitespace)?;
        if !text.contains(char::is_alphanumeric) {
            return refused(
                "the sentence holds no letter or digit: say what was observed, such as `They open the fridge.`",
            );
        }
        let mut sentence = String::with_capacity(text.len() + 1);
        let mut words = text.split_whitespace();
        let mut letters = words.next().unwrap_or_default().chars();
        sentence.extend(letters.next().into_iter().flat_map(char::to_uppercase));
        sentence.push_str(letters.as_str());
        words.for_each(|word| sentence.extend([" ", word]));
        if !sentence.ends_with(['.', '!', '?']) {
            sentence.truncate(sentence.trim_end_matches([',', ';', ':', ' ']).len());
            sentence.push('.');
        }
        match sentence.len() {
            0..=SENTENCE_BYTES_MAX => Ok(Self(sentence.into())),
            bytes => too_long(bytes),
        }
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Sentence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The device and its state in "the oven is on"; `None` if the text has another form, in which case it is a plain sentence.
#[must_use]
pub fn device_state(text: &str) -> Option<(&str, &str)> {
    let text = text.trim().trim_end_matches('.');
    let rest = text.strip_prefix("the ").or_else(|| text.strip_prefix("The "))?;
    let (device, state) = rest.split_once(" is ")?;
    let (device, state) = (device.trim(), state.trim());
    (!device.is_empty() && !state.is_empty()).then_some((device, state))
}

/// One event with person, narrator and times.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Observation {
    /// The person; [`PersonId::SOMEBODY`] until the event is attributed.
    pub person: PersonId,
    /// The name that the narrator gave the person, which counts before the number.
    pub name: Option<Box<str>>,
    /// `person` was found by fit, since the narrator gave no person.
    pub by_fit: bool,
    /// The narrator that sent it.
    pub source: u64,
    /// Random number of the narrator's process start: a new one begins a new count of sequences.
    pub epoch: u64,
    /// Counts the narrator's observations within an epoch.
    pub sequence: u64,
    /// Monotonic time of the observation, in nanoseconds.
    pub observed_ns: BootNs,
    /// Wall clock, in nanoseconds since 1970, for people.
    pub observed_unix_ns: UnixNs,
    /// The number of persons that the narrator counted; 0 if it counted none.
    pub count: u8,
    /// The text may be a presence form: it is a plain sentence, and no action, device state or filled template of a rule.
    pub may_be_form: bool,
    /// The report.
    pub event: Event,
}

impl Observation {
    /// What a text says rather than a port: of person 0, by source 0 in its epoch 0, at no known time.
    #[must_use]
    pub fn of(sequence: u64, sentence: Sentence) -> Self {
        Self::saying(sequence, Event::Did(sentence))
    }

    /// An observation of any event, without narrator and time.
    #[must_use]
    pub fn saying(sequence: u64, event: Event) -> Self {
        let (person, name, by_fit, count, may_be_form) = (PersonId(0), None, false, 0, true);
        let (source, epoch, observed_ns, observed_unix_ns) = (0, 0, BootNs(0), UnixNs(0));
        Self { person, name, by_fit, source, epoch, sequence, observed_ns, observed_unix_ns, count, may_be_form, event }
    }

    /// The narrator, its start, and the number of the event.
    #[must_use]
    pub fn id(&self) -> EventId {
        EventId { source: self.source, epoch: self.epoch, sequence: self.sequence }
    }

    /// The sentence for the prompt; none where only presence is said.
    #[must_use]
    pub fn sentence(&self) -> Option<&str> {
        self.event.sentence().map(Sentence::as_str)
    }

    /// Seconds from `earlier` to this observation by a clock that both have, the monotonic one first; `None` if there is none, 0 if the order is the
    /// other one. If only the monotonic clock goes back, the machine was started in between.
    #[must_use]
    pub(crate) fn seconds_after(&self, earlier: &Self) -> Option<f64> {
        let between = |from_ns: u64, to_ns: u64| (from_ns > 0 && to_ns > 0).then(|| to_ns.checked_sub(from_ns));
        let clocks = [
            between(earlier.observed_ns.0, self.observed_ns.0),
            between(earlier.observed_unix_ns.0, self.observed_unix_ns.0),
        ];
        let known = clocks.into_iter().flatten();
        let after = known.clone().flatten().next().or(known.clone().next().map(|_| 0));
        after.map(|nanoseconds| nanoseconds as f64 / 1e9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn sentences_are_normalised_or_refused() {
        let normal = |text: &str| Sentence::new(text).map(|s| s.to_string());
        assert_eq!(normal("  she opens\n the  fridge ").as_deref(), Ok("She opens the fridge."));
        assert_eq!(normal("Is it on?").as_deref(), Ok("Is it on?"));
        assert_eq!(normal("then,").as_deref(), Ok("Then."));
        assert_eq!(normal("éteint la lampe").as_deref(), Ok("Éteint la lampe."));
        for (text, part) in [
            (" ... ", "no letter or digit"),
            ("a\u{0}b", "U+0000"),
            (&"a".repeat(1025), "1025 bytes"),
            (&"a".repeat(1024), "1025 bytes"),
        ] {
            assert!(normal(text).unwrap_err().0.contains(part), "{text}");
        }
    }

    proptest! {
        #[test]
        fn normalising_twice_changes_nothing(text in "\\PC{0,200}") {
            if let Ok(sentence) = Sentence::new(&text) {
                prop_assert_eq!(Sentence::new(sentence.as_str()), Ok(sentence.clone()));
                prop_assert!(!sentence.as_str().contains("  "));
            }
        }
    }
}
