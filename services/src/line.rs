//! Turns one line of narration into an item to send. `docs/json-lines.md` is the manual; [`roomcast_core::narration::line`] reads it.

use std::fmt;
use std::io;
use std::path::PathBuf;

use crate::embedded;
use roomcast_core::ids::UnixNs;
use roomcast_core::narration::TextError;
pub use roomcast_core::narration::line::Who;
use roomcast_core::narration::line::{self, Line};
pub(crate) use roomcast_core::narration::line::{AHEAD_NS, LINE_BYTES_MAX};
use roomcast_ipc::raw::NarrationV1;
use roomcast_ipc::{MessageError, text};

/// If a time is further ahead than this, the clock of the event is fast. Less is rounding and transport.
pub(crate) const FAST_NS: u64 = 1_000_000_000;

/// An event to send.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// One of [`roomcast_ipc::raw::narration_kind`].
    pub kind: u32,
    /// The text, in the notation of its kind.
    pub text: String,
    /// The person observed.
    pub person: Who,
    /// The time of the observation, in Unix nanoseconds; `None` for now.
    pub observed_unix_ns: Option<UnixNs>,
    /// The number of persons that the narrator counted; 0 if it counted none.
    pub count: u8,
    /// The real duration in seconds, which passes before the event is observed.
    pub duration_s: f64,
}

impl Item {
    /// An event of now.
    #[must_use]
    pub fn new(kind: u32, text: impl Into<String>, person: Who) -> Self {
        Self { kind, text: text.into(), person, observed_unix_ns: None, count: 0, duration_s: 0.0 }
    }

    fn of_line(line: Line) -> Result<Self, TextError> {
        let Line { kind, text, person, observed_unix_ns, count } = line;
        let item = Self { observed_unix_ns, count, ..Self::new(kind as u32, text, person) };
        item.message().map_err(|error| TextError(error.to_string()))?;
        Ok(item)
    }

    /// The message without its sender and time.
    ///
    /// # Errors
    ///
    /// [`MessageError`] when text or name cannot be in a message.
    pub(crate) fn message(&self) -> Result<NarrationV1, MessageError> {
        let person_name = text::encode("person_name", self.person.name())?;
        let count = self.count.into();
        Ok(NarrationV1 {
            person: self.person.number().0,
            person_name,
            count,
            ..NarrationV1::new(self.kind, &self.text)?
        })
    }
}

/// An input is not a narration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InputError {
    /// It cannot be read.
    #[error("cannot read {0}: {1}")]
    Read(String, #[source] io::Error),
    /// Neither a file nor the name of an included activity program.
    #[error(
        "there is no file {0}: give a program's file, a file of lines, or an included program by its name, {names}",
        names = embedded::program_names()
    )]
    Missing(String),
    /// The path of the FIFO is another kind of file.
    #[error("{0} is there and is no named pipe: remove it, give another path, or leave out --fifo to read it once")]
    NoFifo(PathBuf),
    /// A FIFO cannot be created.
    #[error("cannot make the named pipe {0}: {1}; give --fifo a path in a folder of your own")]
    MakeFifo(PathBuf, #[source] io::Error),
    /// The program is malformed.
    #[error(transparent)]
    Program(#[from] TextError),
    /// A line is not a narration.
    #[error("line {0}: {1}")]
    Line(u64, #[source] TextError),
}

/// Lines that are not narrations: their count, and the texts of the first faults. The memory is bounded.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Faults {
    told: Vec<String>,
    count: u64,
}

impl Faults {
    /// Most faults with a text.
    pub const TOLD: usize = 100;

    /// Adds the fault of a line.
    pub fn add(&mut self, line: u64, reason: impl fmt::Display) {
        self.add_at(format_args!("line {line}"), reason);
    }

    /// Adds a fault at a place that is not a line.
    pub fn add_at(&mut self, place: impl fmt::Display, reason: impl fmt::Display) {
        self.count += 1;
        if self.told.len() < Self::TOLD {
            self.told.push(format!("{place}: {reason}"));
        }
    }

    /// The faults of the first lines, each with its line's number.
    #[must_use]
    pub fn told(&self) -> &[String] {
        &self.told
    }

    /// The number of faults.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }
}

/// Reads one line as an item, as [`Line::read`] does. It rejects lines that the daemon would reject, so that their writer sees the fault.
///
/// # Errors
///
/// [`TextError`] with the key of a line of JSON, and the allowed values.
pub fn line_item(line: &str, person: &Who) -> Result<Item, TextError> {
    Item::of_line(Line::read(line, person)?)
}

/// The item of a line's bytes, unless its time is too far ahead; `None` for a blank line.
///
/// # Errors
///
/// As [`line_item`].
pub(crate) fn item_by(
    bytes: &[u8],
    is_first: bool,
    person: &Who,
    now_unix_ns: UnixNs,
) -> Result<Option<Item>, TextError> {
    let Some(text) = line::text_of(bytes, is_first)? else { return Ok(None) };
    Item::of_line(Line::read(text, person)?.observed_by(now_unix_ns)?).map(Some)
}

#[cfg(test)]
mod tests {
    use roomcast_core::ids::PersonId;
    use roomcast_ipc::raw::{ALL_PERSONS, narration_kind};
    use serde_json::{Value, json};

    use super::*;

    /// The tests of the hub of `roomcast-zenoh` use the same table.
    #[test]
    fn a_narrator_takes_the_lines_that_a_hub_takes() {
        let table: Vec<Value> = serde_json::from_str(include_str!("../../tests/data/lines.json")).unwrap();
        for row in table {
            let now_ns = row["now_s"].as_u64().unwrap() * 1_000_000_000;
            let bytes = row["line"].as_str().unwrap().as_bytes();
            let taken = item_by(bytes, row["first"] == true, &Who::Somebody, UnixNs(now_ns));
            let says = match &taken {
                Ok(Some(item)) => {
                    let age_ns = item.observed_unix_ns.map_or(0, |observed_ns| UnixNs(now_ns).since(observed_ns));
                    let kind = line::Kind::from_repr(item.kind);
                    json!({"kind": kind, "text": item.text, "person": item.person, "age_s": age_ns as f64 / 1e9})
                }
                Ok(None) => json!("blank"),
                Err(_) => json!("refused"),
            };
            assert_eq!(says, row["says"], "{row}: {taken:?}");
        }
    }

    #[test]
    fn a_message_says_of_whom_it_is() {
        let of = |person: Who| {
            let message = Item::new(narration_kind::SENTENCE, "They sit.", person).message().unwrap();
            (message.person, message.person_name().to_owned())
        };
        assert_eq!(of(Who::Somebody), (ALL_PERSONS, String::new()));
        assert_eq!(of(Who::Number(PersonId(7))), (7, String::new()));
        assert_eq!(of("Ada".parse().unwrap()), (ALL_PERSONS, "Ada".to_owned()));
    }
}
