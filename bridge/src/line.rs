//! A line of narration, read as every narrator reads it ([`roomcast_core::narration::line`]), as what goes to robots.

pub use roomcast_core::narration::line::LINE_BYTES_MAX;
use roomcast_core::narration::line::{self, Line, Who};

use crate::wire::{Fault, Observation};

/// A line as an observation, and how long ago it was.
///
/// # Errors
///
/// [`Fault`] for what is no narration.
pub fn line(text: &str, now_unix_ns: u64) -> Result<(Observation, u64), Fault> {
    let read = Line::read(text, &Who::Somebody).and_then(|line| line.observed_by(now_unix_ns));
    let Line { kind, text, person, observed_unix_ns, count } = read.map_err(|error| Fault(error.to_string()))?;
    let observation = Observation { text, kind, person, count };
    observation.message()?;
    Ok((observation, observed_unix_ns.map_or(0, |observed_ns| now_unix_ns.saturating_sub(observed_ns))))
}

/// The same of a line's bytes; none of a blank line.
///
/// # Errors
///
/// As [`line()`].
pub fn line_of(bytes: &[u8], is_first: bool, now_unix_ns: u64) -> Result<Option<(Observation, u64)>, Fault> {
    let text = line::text_of(bytes, is_first).map_err(|error| Fault(error.to_string()))?;
    text.map(|text| line(text, now_unix_ns)).transpose()
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    /// The table that `roomcast narrate` is tested with, too.
    #[test]
    fn a_hub_takes_the_lines_that_a_narrator_takes() {
        let table: Vec<Value> = serde_json::from_str(include_str!("../../tests/data/lines.json")).unwrap();
        for row in table {
            let (bytes, now_ns) =
                (row["line"].as_str().unwrap().as_bytes(), row["now_s"].as_u64().unwrap() * 1_000_000_000);
            let taken = line_of(bytes, row["first"] == true, now_ns);
            let says = match &taken {
                Ok(Some((observation, age_ns))) => json!({
                    "kind": observation.kind, "text": observation.text, "person": observation.person.json(),
                    "age_s": *age_ns as f64 / 1e9,
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
        let (observation, age_ns) = read(r#"{"presence":"away","person":"Ada","observed_unix_s":98.5}"#).unwrap();
        assert_eq!((observation.text.as_str(), observation.person.name(), age_ns), ("away", "Ada", 1_500_000_000));
        for bad in ["[Fly] <mug> (1)", "{", r#"{"text":"a","txt":1}"#, r#"{"text":"They sit.","person":"who"}"#] {
            read(bad).unwrap_err();
        }
    }
}
