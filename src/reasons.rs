//! Reasons for beliefs in words: one line a person, from the daemon's answer.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use roomcast_ipc::{IpcError, Node, QuestionPort, question};
use roomcast_services::daemon::{PersonAnswer, PersonQuestion, UnderstoodPerson, Whereabouts, WhyLine};

/// Period of questions about all persons.
const EVERY: Duration = Duration::from_secs(2);
/// Longest wait for each answer. A person without an answer keeps the line.
const PATIENCE: Duration = Duration::from_millis(100);

/// A person with a smaller share did not cause an event.
const LEAST_SHARE: f64 = 0.05;

#[derive(Debug)]
pub struct Reasons {
    port: QuestionPort,
    asked: Option<Instant>,
    lines: BTreeMap<u32, String>,
}

impl Reasons {
    /// Opens the question's service.
    ///
    /// # Errors
    /// If the service cannot be opened.
    pub fn new(node: &Node) -> Result<Self, IpcError> {
        Ok(Self { port: node.question_port(question::PERSON)?, asked: None, lines: BTreeMap::new() })
    }

    /// Asks about these persons. Returns the lines; `None` if it asked a moment ago.
    pub fn refresh(&mut self, persons: impl Iterator<Item = u32>) -> Option<&BTreeMap<u32, String>> {
        if self.asked.is_some_and(|asked| asked.elapsed() < EVERY) {
            return None;
        }
        self.asked = Some(Instant::now());
        let before = std::mem::take(&mut self.lines);
        for person in persons {
            let question = serde_json::to_string(&PersonQuestion::Where { who: person.to_string() });
            let answer = question.ok().and_then(|question| self.port.ask(&question, PATIENCE).ok());
            let Some(text) = answer else {
                // After one missing answer the others are not asked for.
                self.lines = before;
                break;
            };
            let answer: Option<PersonAnswer> = serde_json::from_str(&text).ok();
            if let Some(line) = answer.and_then(|answer| answer.whereabouts).as_ref().and_then(line) {
                self.lines.insert(person, line);
            }
        }
        Some(&self.lines)
    }
}

/// The observation that speaks most for a person's most probable place, or else against it. `None` if each event had one person.
fn line(found: &Whereabouts) -> Option<String> {
    let place = found.places.first()?;
    let why = place.why.iter().find(|why| why.log_odds > 0.0).or(place.why.first()).filter(|_| found.is_joint)?;
    let text = why_text(&called(&found.person), why, &ago(why.ago_s));
    Some(format!("{} {:.0} %: {text}", place.place, 100.0 * place.probability))
}

/// An age that seldom changes, since Home Assistant stores each change.
fn ago(seconds: f64) -> String {
    match (seconds / 60.0) as u64 {
        0 => "in the last minute".to_owned(),
        minutes if minutes < 120 => format!("{minutes} min ago"),
        minutes => format!("{} h ago", minutes / 60),
    }
}

#[must_use]
pub fn called(person: &UnderstoodPerson) -> String {
    person.name.clone().unwrap_or_else(|| format!("person {}", person.person))
}

/// One observation in words: "motion hall-pir on, 12 s ago, could be Jon or Mira: weak for".
#[must_use]
pub fn why_text(name: &str, why: &WhyLine, ago: &str) -> String {
    let what = why.sensor.as_deref().unwrap_or(&why.what);
    let whose = match why.or.as_ref().map(called) {
        Some(other) if why.share < LEAST_SHARE => format!(", by {other}"),
        Some(other) => format!(", could be {name} or {other}"),
        None => String::new(),
    };
    let side = if why.log_odds < 0.0 { "against" } else { "for" };
    format!("{what}, {ago}{whose}: {} {side}", why.weight)
}

#[cfg(test)]
mod tests {
    use roomcast_core::ids::PersonId;
    use roomcast_services::daemon::PlaceLine;

    use super::*;

    #[test]
    fn a_line_names_the_place_the_observation_and_the_other_person() {
        let person =
            |number: u32, name: &str| UnderstoodPerson { person: PersonId(number), name: Some(name.to_owned()) };
        let why = WhyLine {
            what: "sensor".to_owned(),
            sensor: Some("motion hall-pir on".to_owned()),
            ago_s: 12.2,
            log_odds: 0.4,
            weight: "weak".to_owned(),
            share: 0.6,
            or: Some(person(2, "Mira")),
        };
        let place = PlaceLine { place: "hall".to_owned(), probability: 0.62, why: vec![why] };
        let (house_empty, visited, visited_by_two, noisy) = (0.0, 0.0, 0.0, Vec::new());
        let found = Whereabouts {
            person: person(1, "Jon"),
            places: vec![place],
            house_empty,
            visited,
            visited_by_two,
            is_joint: true,
            is_followed: true,
            noisy,
        };
        let expected = "hall 62 %: motion hall-pir on, in the last minute, could be Jon or Mira: weak for";
        assert_eq!(line(&found).as_deref(), Some(expected));
        let mut other = found.clone();
        other.places[0].why[0].share = 0.0;
        assert!(line(&other).unwrap().ends_with("in the last minute, by Mira: weak for"));
        let against = WhyLine { log_odds: -4.0, ..other.places[0].why[0].clone() };
        other.places[0].why.insert(0, against);
        assert!(line(&other).unwrap().ends_with("weak for"), "a reason for the place comes first");
        assert_eq!(line(&Whereabouts { is_joint: false, ..found }), None);
    }
}
