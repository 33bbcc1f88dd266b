//! A line of narration: a sentence, an action, or a JSON object that says of whom and when.

use serde::Deserialize;

use crate::wire::{Fault, Kind, Observation, Person};

/// Longest line, in bytes.
pub const LINE_BYTES_MAX: u64 = 4096;

/// A line of input as JSON.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct JsonLine {
    text: String,
    kind: Option<Kind>,
    person: Option<Person>,
    observed_unix_s: Option<f64>,
}

/// A line as an observation, and how long ago it was: JSON where it opens with `{`, an action where with `[`, else a sentence.
///
/// # Errors
///
/// [`Fault`] for what is no narration.
pub fn line(text: &str, now_unix_ns: u64) -> Result<(Observation, u64), Fault> {
    let text = text.trim();
    let kind = |text: &str| if text.starts_with('[') { Kind::Action } else { Kind::Sentence };
    if !text.starts_with('{') {
        return Ok((Observation { text: text.to_owned(), kind: kind(text), person: None }, 0)).and_then(checked);
    }
    let json: JsonLine = serde_json::from_str(text).map_err(|error| Fault(error.to_string()))?;
    let age_ns = match json.observed_unix_s {
        None => 0,
        Some(observed_s) if (0.0..1e11).contains(&observed_s) => now_unix_ns.saturating_sub((observed_s * 1e9) as u64),
        Some(_) => return Err(Fault("observed_unix_s: seconds since 1970".to_owned())),
    };
    let kind = json.kind.unwrap_or_else(|| kind(json.text.trim_start()));
    let person = json.person.map(Person::of_digits);
    checked((Observation { text: json.text.trim().to_owned(), kind, person }, age_ns))
}

fn checked((observation, age_ns): (Observation, u64)) -> Result<(Observation, u64), Fault> {
    observation.message()?;
    Ok((observation, age_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_sentences_actions_and_json() {
        let read = |text: &str| line(text, 100_000_000_000);
        assert_eq!(read(" They sit. \n").unwrap().0.text, "They sit.");
        assert_eq!(read("[Grab] <mug> (1)").unwrap().0.kind, Kind::Action);
        let (observation, age_ns) =
            read(r#"{"text":"away","kind":"presence","person":"Ada","observed_unix_s":98.5}"#).unwrap();
        assert_eq!(
            (observation.kind, observation.person, age_ns),
            (Kind::Presence, Some(Person::Name("Ada".into())), 1_500_000_000)
        );
        assert_eq!(read(r#"{"text":"They sit.","person":"3"}"#).unwrap().0.person, Some(Person::Number(3)));
        for bad in [
            "[Fly] <mug> (1)",
            "{",
            r#"{"text":"a","txt":1}"#,
            r#"{"text":"a","observed_unix_s":-1}"#,
            r#"{"text":"They sit.","person":"who"}"#,
            "{\"text\":\"\"}",
        ] {
            read(bad).unwrap_err();
        }
    }
}
