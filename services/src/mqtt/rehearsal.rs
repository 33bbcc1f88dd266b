//! Reports for people about each message.

use roomcast_core::text::visible;

use super::PAYLOAD_BYTES_MAX;
use super::listener::{Outcome, What};
use super::rules::{Rules, Value};

/// The beginning of an outside text, on one line of a terminal. Quotes stay, so that JSON is legible.
#[must_use]
pub fn shown(bytes: &[u8]) -> String {
    const LONGEST: usize = 120;
    let text = String::from_utf8_lossy(bytes);
    let mut chars = text.chars();
    let start: String = chars.by_ref().take(LONGEST).collect();
    let rest = if chars.next().is_some() { "..." } else { "" };
    format!("{}{rest}", visible(&start))
}

/// Gives a remark about a line, if there is one.
pub(super) type Remark<'a> = dyn FnMut(&str) -> Option<String> + 'a;

pub(super) fn remarked(line: &str, remark: &mut Remark<'_>) -> String {
    remark(line).map_or_else(|| line.to_owned(), |remark| format!("{line}\n    {}", visible(&remark)))
}

pub(super) fn report(
    rules: &Rules,
    (topic, payload, retained): (&[u8], &[u8], bool),
    outcomes: &[Outcome],
    remark: &mut Remark<'_>,
) -> String {
    let quoted = |value: &Value| format!("\"{}\"", shown(value.text.as_bytes()));
    let mut text = format!("{}  {}{}", shown(topic), shown(payload), if retained { "  (retained)" } else { "" });
    for Outcome { number, value, what } in outcomes {
        let said = match what {
            What::Said(line) => format!("says {}", remarked(line, remark)),
            What::Waits(line, quiet) => {
                format!("says after {} s of silence {}", quiet.as_secs_f64(), remarked(line, remark))
            }
            What::Later => "is silent: a rule before it speaks of this value".to_owned(),
            What::OtherValue if rules.is_excepted(*number, &value.text) => {
                format!("is silent: {} is in its `unless`", quoted(value))
            }
            What::OtherValue if rules.is_numeric(*number) => {
                format!("is silent: {} is outside its `above` and `below`", quoted(value))
            }
            What::OtherValue => format!("is silent: {} is not its `when`", quoted(value)),
            What::Repeated if rules.holds_states(*number) => {
                format!("is silent: {} means the same state as before", quoted(value))
            }
            What::Repeated => format!("is silent: {} is what the topic said before", quoted(value)),
            What::Unfit(reason) => {
                format!("is silent: what it would say is no narration: {}", shown(reason.as_bytes()))
            }
            What::State => "is silent: retained, so no event (`retained = true` says it)".to_owned(),
        };
        text.push_str(&format!("\n  rule {number} {said}"));
    }
    if payload.len() > PAYLOAD_BYTES_MAX {
        text.push_str(&format!("\n  is dropped: its payload has more than {PAYLOAD_BYTES_MAX} bytes"));
    } else if outcomes.is_empty() {
        let lacks = std::str::from_utf8(topic).ok().and_then(|topic| rules.unreadable(topic, payload));
        text.push_str(&match lacks {
            Some((number, lack)) => format!("\n  rule {number} cannot read it: the payload {}", visible(&lack)),
            None => "\n  no rule can read it".to_owned(),
        });
    }
    text
}
