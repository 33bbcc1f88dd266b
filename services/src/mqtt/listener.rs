//! Decides which messages become narration.

use std::collections::{HashMap, HashSet};
use std::mem::{Discriminant, discriminant};
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::rules::{Fingerprint, Rules, Said, Value, fingerprint};
use super::{PAYLOAD_BYTES_MAX, TOPICS_MAX, WAITING_BYTES_MAX, WAITING_MAX};
use crate::rule::Class;

/// Home Assistant's values for a device out of reach. They are not a state of the device, unless a rule names them.
const NO_STATE: [&str; 2] = ["unknown", "unavailable"];

/// Counts of messages and lines.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Heard {
    /// Lines of narration.
    pub said: u64,
    /// Messages without a matching rule.
    pub unfit: u64,
    /// Messages that repeated a value, or only gave a state.
    pub silent: u64,
    /// Messages with a line that would not be narration.
    pub unsayable: u64,
    /// Messages that are larger than [`PAYLOAD_BYTES_MAX`].
    pub oversized: u64,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Outcome {
    /// The rule's number, from 1.
    pub(super) number: usize,
    pub(super) value: Rc<Value>,
    pub(super) what: What,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum What {
    /// A line of JSON, sent at once.
    Said(String),
    /// A line to be sent after this silence.
    Waits(String, Duration),
    /// An earlier rule has used this value.
    Later,
    /// The rule is for other values.
    OtherValue,
    Repeated,
    /// The message is retained: a state, not an event.
    State,
    /// The line is not narration, for this reason.
    Unfit(String),
}

/// A line that is sent unless another line is sent before.
#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) line: String,
    since: Instant,
    quiet: Duration,
    /// The line waits for a state to last instead of for silence.
    lasting: Option<Lasting>,
}

type Lasting = (usize, Fingerprint, Fingerprint);

/// Decides which messages become narration. Pure: time is an argument.
#[derive(Debug)]
pub struct Listener {
    pub(super) rules: Rules,
    last: HashMap<Fingerprint, Fingerprint>,
    /// Lines of rules with `quiet_s`, each once.
    pub(super) waiting: Vec<Waiting>,
    /// Whether retained messages precede the first connection of this process.
    pub(super) first_connection: bool,
    pub(super) heard: Heard,
    /// Rejected lines: lines that are not narration, and lines without room to wait.
    pub(super) refused: u64,
    /// The number of messages that each rule matched.
    pub(super) fitted: Vec<u64>,
}

impl Listener {
    /// A new listener.
    #[must_use]
    pub fn new(rules: Rules) -> Self {
        let fitted = vec![0; rules.0.len()];
        let (last, waiting, heard) = (HashMap::new(), Vec::new(), Heard::default());
        Self { rules, last, waiting, first_connection: true, heard, refused: 0, fitted }
    }

    /// The lines of JSON that a message gives at once; `retained` is the broker's flag.
    pub fn hear(&mut self, topic: &[u8], payload: &[u8], retained: bool, now: Instant) -> Vec<String> {
        let outcomes = self.outcomes(topic, payload, retained, now).into_iter();
        let said = outcomes.filter_map(|outcome| if let What::Said(line) = outcome.what { Some(line) } else { None });
        said.collect()
    }

    /// The result of each rule that can read a message, in order.
    pub(super) fn outcomes(&mut self, topic: &[u8], payload: &[u8], retained: bool, now: Instant) -> Vec<Outcome> {
        let Ok(topic) = std::str::from_utf8(topic) else {
            self.heard.unfit += 1;
            return Vec::new();
        };
        if payload.len() > PAYLOAD_BYTES_MAX {
            self.heard.oversized += 1;
            return Vec::new();
        }
        let readings = self.rules.readings(topic, payload);
        if readings.iter().all(|said| said.line.is_none()) {
            self.heard.unfit += 1;
        }
        let spoken_of: HashSet<Option<&str>> = (readings.iter())
            .filter(|said| said.line.is_some() && said.held.is_none())
            .map(|said| said.rule.field.as_deref())
            .collect();
        let mut known: HashMap<Fingerprint, Option<Fingerprint>> = HashMap::new();
        let mut spoken: HashSet<(Option<&str>, Discriminant<Class>)> = HashSet::new();
        let mut outcomes = Vec::with_capacity(readings.len());
        // A sensor that turns off does not break a silence.
        let mut is_silence_over = false;
        let mut lasts: HashMap<usize, Lasting> = HashMap::new();
        for Said { number, rule, line, value, held } in readings {
            let field = rule.field.as_deref();
            // Rules with the same field read the same value.
            let by_value = || (fingerprint(format!("{topic}\n{}", field.unwrap_or_default()).as_bytes()), value.own);
            let (place, own) = held.map_or_else(by_value, |held| (held.place, held.own));
            let known = *known.entry(place).or_insert_with(|| {
                let known = self.last.get(&place).copied();
                let is_state = held.is_some()
                    || spoken_of.contains(&field)
                    || !NO_STATE.iter().any(|no| no.eq_ignore_ascii_case(&value.text));
                if is_state && (known.is_some() || self.last.len() < TOPICS_MAX) {
                    self.last.insert(place, own);
                }
                known
            });
            if rule.lasting.is_some() {
                let is_over = |(other, at, value): Lasting| other == number && at == place && value != own;
                self.waiting.retain(|waiting| !waiting.lasting.is_some_and(is_over));
            }
            let is_on = held.is_none_or(|held| held.is_on);
            let lasting = rule.lasting.filter(|_| is_on).map(|time| (time, (number, place, own)));
            let unknown = self.first_connection || known.is_none();
            let quiet = rule.saying.quiet();
            let what = match line {
                None => What::OtherValue,
                // Only the first rule with an immediate line for a value is used.
                Some(_) if quiet.is_none() && !spoken.insert((field, discriminant(&rule.saying.class))) => What::Later,
                Some(_) if known == Some(own) && (retained || !rule.repeats) => What::Repeated,
                Some(_) if retained && !rule.retained && unknown => What::State,
                Some(Err(reason)) => What::Unfit(reason),
                Some(Ok(line)) => match (quiet, lasting) {
                    (None, None) => What::Said(line),
                    (_, Some((time, state))) => {
                        lasts.insert(number, state);
                        What::Waits(line, time)
                    }
                    (Some(quiet), None) => What::Waits(line, quiet),
                },
            };
            is_silence_over |= matches!(what, What::Said(_)) && held.is_none_or(|held| held.is_on);
            outcomes.push(Outcome { number, value, what });
        }
        if is_silence_over {
            self.waiting.retain(|waiting| waiting.lasting.is_some());
        }
        self.account(topic, &outcomes, &lasts, now);
        outcomes
    }

    /// Counts what came of a message, and keeps the lines that wait.
    fn account(&mut self, topic: &str, outcomes: &[Outcome], lasts: &HashMap<usize, Lasting>, now: Instant) {
        let said = outcomes.iter().filter(|outcome| matches!(outcome.what, What::Said(_))).count();
        self.heard.said += said as u64;
        for outcome in outcomes {
            match &outcome.what {
                What::Waits(line, quiet) => {
                    let lasting = lasts.get(&outcome.number).copied();
                    if !self.wait(Waiting { line: line.clone(), since: now, quiet: *quiet, lasting }) {
                        self.refuse(topic, outcome.number, "too much waits for silence");
                    }
                }
                What::Unfit(reason) => self.refuse(topic, outcome.number, reason),
                _ => {}
            }
        }
        for outcome in outcomes.iter().filter(|outcome| outcome.what != What::OtherValue) {
            if let Some(count) = self.fitted.get_mut(outcome.number.wrapping_sub(1)) {
                *count = count.saturating_add(1);
            }
        }
        let acts = |outcome: &Outcome| matches!(outcome.what, What::Said(_) | What::Waits(..));
        let fits = |outcome: &Outcome| outcome.what != What::OtherValue;
        if outcomes.iter().any(fits) && !outcomes.iter().any(acts) {
            let is_unsayable = outcomes.iter().any(|outcome| matches!(outcome.what, What::Unfit(_)));
            *(if is_unsayable { &mut self.heard.unsayable } else { &mut self.heard.silent }) += 1;
        }
    }

    /// Adds a waiting line; the wait of an equal line starts again. Returns whether there was room.
    fn wait(&mut self, waiting: Waiting) -> bool {
        self.waiting.retain(|other| other.line != waiting.line);
        let has_room =
            self.waiting.len() < WAITING_MAX && self.waiting_bytes() + waiting.line.len() <= WAITING_BYTES_MAX;
        if has_room {
            self.waiting.push(waiting);
        }
        has_room
    }

    fn waiting_bytes(&self) -> usize {
        self.waiting.iter().map(|waiting| waiting.line.capacity()).sum()
    }

    /// The log has one line for each doubling of their number.
    fn refuse(&mut self, topic: &str, rule: usize, reason: &str) {
        self.refused += 1;
        if self.refused.is_power_of_two() {
            tracing::warn!(topic, rule, reason, refused = self.refused, "what a rule would say is not narrated");
        }
    }

    /// The lines of JSON after their silence.
    pub fn due(&mut self, now: Instant) -> Vec<String> {
        let due = |waiting: &mut Waiting| now.saturating_duration_since(waiting.since) >= waiting.quiet;
        let lines: Vec<_> = self.waiting.extract_if(.., due).map(|waiting| waiting.line).collect();
        self.heard.said += lines.len() as u64;
        lines
    }

    /// Restarts all silences: before this time no message could arrive.
    pub(super) fn listen_from(&mut self, now: Instant) {
        self.waiting.iter_mut().for_each(|waiting| waiting.since = now);
    }
}
