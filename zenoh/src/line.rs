//! Reads a line of narration as every narrator does ([`roomcast_core::narration::line`]), for sending to robots.

use roomcast_core::ids::UnixNs;
pub use roomcast_core::narration::line::LINE_BYTES_MAX;
use roomcast_core::narration::line::{self, Line, Who};

use crate::wire::{Fault, Observation};

/// When a line was observed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Age {
    /// How long ago.
    pub age_ns: u64,
    /// How far its time lies in the future: the clock of the input's machine is fast, and the event counts as observed now.
    pub ahead_ns: u64,
}

/// A line as an observation, with its age.
///
/// # Errors
///
/// [`Fault`] if the line is not narration.
pub fn line(text: &str, now_unix_ns: u64) -> Result<(Observation, Age), Fault> {
    let read = Line::read(text, &Who::Somebody).and_then(|line| line.observed_by(UnixNs(now_unix_ns)));
    let Line { kind, text, person, observed_unix_ns, count } = read.map_err(|error| Fault(error.to_string()))?;
    let observation = Observation { text, kind, person, count };
    observation.message()?;
    let observed_ns = observed_unix_ns.map_or(now_unix_ns, |observed_ns| observed_ns.0);
    let age =
        Age { age_ns: now_unix_ns.saturating_sub(observed_ns), ahead_ns: observed_ns.saturating_sub(now_unix_ns) };
    Ok((observation, age))
}

/// Reads a line's bytes as [`line()`] does; `None` for a blank line.
///
/// # Errors
///
/// As [`line()`].
pub fn line_of(bytes: &[u8], is_first: bool, now_unix_ns: u64) -> Result<Option<(Observation, Age)>, Fault> {
    let text = line::text_of(bytes, is_first).map_err(|error| Fault(error.to_string()))?;
    text.map(|text| line(text, now_unix_ns)).transpose()
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    /// `roomcast narrate` is tested with the same table.
    #[test]
    fn a_hub_takes_the_lines_that_a_narrator_takes() {
        let table: Vec<Value> = serde_json::from_str(include_str!("../../tests/data/lines.json")).unwrap();
        for row in table {
            let (bytes, now_ns) =
                (row["line"].as_str().unwrap().as_bytes(), row["now_s"].as_u64().unwrap() * 1_000_000_000);
            let taken = line_of(bytes, row["first"] == true, now_ns);
            let says = match &taken {
                Ok(Some((observation, age))) => json!({
                    "kind": observation.kind, "text": observation.text, "person": observation.person,
                    "age_s": age.age_ns as f64 / 1e9,
                }),
                Ok(None) => json!("blank"),
                Err(_) => json!("refused"),
            };
            assert_eq!(says, row["says"], "{row}: {taken:?}");
        }
    }

    #[test]
    fn a_line_is_told_with_its_age() {
        let read = |text: &str| line(text, 100_000_000_000);
        assert_eq!(read(" They sit. \n").unwrap().0.text, "They sit.");
        let (observation, age) = read(r#"{"presence":"away","person":"Ada","observed_unix_s":98.5}"#).unwrap();
        assert_eq!((observation.text.as_str(), observation.person.name(), age.age_ns), ("away", "Ada", 1_500_000_000));
        let (_, age) = read(r#"{"text":"They sit.","observed_unix_s":102}"#).unwrap();
        assert_eq!(age, Age { age_ns: 0, ahead_ns: 2_000_000_000 });
        for bad in ["[Fly] <mug> (1)", "{", r#"{"text":"a","txt":1}"#, r#"{"text":"They sit.","person":"who"}"#] {
            read(bad).unwrap_err();
        }
    }
}
