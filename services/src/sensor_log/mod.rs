//! Narration from sensor logs in the form of public smart-home data sets. Each line is an interval with its start, end, sensor, kind and place. A rules
//! file gives the sentences; `docs/sensors.md` is the manual.
//!
//! Pure: from the texts of log and rules to items with the times between them.

mod absences;
#[cfg(test)]
mod tests;
mod times;

pub use absences::{Absences, absences};
pub use times::seconds;

use std::collections::HashMap;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use csv::{ByteRecord, Position, ReaderBuilder, Trim};

use crate::condition::{Condition, ConditionKeys, State, comparable};
use crate::daemon::Zone;
use crate::line::{Faults, Item, LINE_BYTES_MAX, Who, line_item};
use crate::rule::{Class, Device, Keys, Saying, Whereabouts};
use roomcast_core::ids::UnixNs;
use roomcast_core::narration::SensorKind;
use roomcast_core::parsing::{list_of_keyed, toml_says};
use roomcast_core::text::{read_at_most, read_text_at_most};
use times::{FOLD_S, begins_with_time, is_clock_time, is_date, may_be_folded};

/// Largest log that is read, in bytes: it is held in memory.
pub const FILE_BYTES_MAX: u64 = 256 << 20;
const RULES_MAX: usize = 4_096;
/// Most bytes of a file of rules, and of one with credentials or certificates.
pub const RULES_BYTES_MAX: u64 = 4 << 20;
/// Block size for a look at a log; most lines are shorter.
const LINE_BYTES: usize = 256;
/// A number of seconds from here on (September 2001) is a time since 1970, in UTC; a smaller one has no known origin.
const UNIVERSAL_FROM_S: f64 = 1e9;
const QUOTED_MAX: usize = 80;
/// Words for a missing end, in lower case: the interval was open when the log was written.
const OPEN: [&str; 9] = ["", "-", "nat", "nan", "none", "null", "unknown", "unavailable", "open"];
/// Lines for finding the separator of a log's fields.
const SAMPLE_LINES: usize = 1_000;

/// A log cannot be narrated at all. Single malformed lines are in [`SensorLog::faults`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SensorError {
    /// A file cannot be read.
    #[error("failed to read {0}: {1}")]
    Read(PathBuf, #[source] io::Error),
    /// The log is larger than [`FILE_BYTES_MAX`].
    #[error("the sensor log {0} has more than {FILE_BYTES_MAX} bytes; split it by days")]
    TooLarge(PathBuf),
    /// The rules are malformed.
    #[error("the rules {0} are malformed: {1}; docs/sensors.md shows what they look like")]
    Rules(PathBuf, String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum Column {
    Start,
    End,
    Sensor,
    Kind,
    Place,
    #[serde(rename = "-")]
    Other,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum Edge {
    #[default]
    Start,
    End,
}

/// The rules that turn intervals into narration.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorRules {
    columns: Vec<Column>,
    rules: Vec<Rule>,
    /// The zone for universal times of a log.
    zone: Zone,
}

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RulesFile {
    #[serde(default = "default_columns")]
    columns: Vec<Column>,
    #[serde(rename = "rule", default, deserialize_with = "list_of_keyed")]
    rules: Vec<RuleKeys>,
}

fn default_columns() -> Vec<Column> {
    vec![Column::Start, Column::End, Column::Sensor, Column::Kind, Column::Place]
}

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RuleKeys {
    sensor: Option<String>,
    kind: Option<String>,
    place: Option<String>,
    at: Option<Edge>,
    #[serde(default)]
    shortest_s: f64,
    #[serde(default)]
    again_s: f64,
    say: Option<String>,
    presence: Option<Whereabouts>,
    #[serde(rename = "as")]
    device: Option<SensorKind>,
    when: Option<String>,
    #[serde(default)]
    unless: Vec<String>,
    above: Option<f64>,
    below: Option<f64>,
    id: Option<String>,
    room: Option<String>,
    beyond: Option<String>,
    person: Option<Who>,
    count: Option<serde_json::Value>,
    quiet_s: Option<f64>,
    hold_s: Option<f64>,
    false_alarms_per_day: Option<f64>,
    #[serde(default)]
    only_on: bool,
}

#[derive(Debug, Clone, PartialEq)]
struct Rule {
    sensor: Option<String>,
    kind: Option<String>,
    place: Option<String>,
    at: Edge,
    shortest_s: f64,
    again_s: f64,
    condition: Condition,
    saying: Saying,
}

impl Rule {
    fn new(keys: RuleKeys, columns: &[Column]) -> Result<Self, String> {
        let RuleKeys { sensor, kind, place, at, shortest_s, again_s, say, presence, unless, quiet_s, .. } = keys;
        if !(shortest_s >= 0.0 && again_s >= 0.0) {
            return Err("shortest_s and again_s are 0 or more".to_owned());
        }
        let RuleKeys { above, below, hold_s, false_alarms_per_day, only_on, device: as_kind, .. } = keys;
        let when = keys.when.as_deref();
        let conditions = ConditionKeys { when, unless: &unless, above, below };
        let has_condition = conditions.when.is_some() || !unless.is_empty() || above.is_some() || below.is_some();
        let (has_end, has_kind) = (columns.contains(&Column::End), columns.contains(&Column::Kind));
        if as_kind.is_some() {
            if at.is_some() || again_s > 0.0 {
                return Err("at and again_s go with say or presence: the state of a sensor has both edges".to_owned());
            }
            if !has_end && !has_kind && !only_on {
                return Err("as needs the column \"end\" or \"kind\"; or give only_on = true".to_owned());
            }
            if !has_end && kind.is_some() && !only_on {
                return Err("without the column \"end\" the column \"kind\" is the state: leave kind out".to_owned());
            }
        }
        if has_condition && (as_kind.is_none() || has_end) {
            return Err("when, unless, above and below go with as, in a log without the column \"end\"".to_owned());
        }
        let (say, room, person) = (say.as_deref(), keys.room.as_deref(), keys.person.as_ref());
        let (id, beyond, count) = (keys.id.as_deref(), keys.beyond.as_deref(), keys.count.as_ref());
        let device = Device { id, beyond, hold_s, false_alarms_per_day, only_on };
        let saying = Keys { say, presence, sensor: as_kind, room, person, count, quiet_s, device };
        let saying = Saying::new(saying, &NAMES.map(str::to_owned))?;
        let at = at.unwrap_or_default();
        let condition = Condition::new(conditions)?;
        Ok(Self { sensor, kind, place, at, shortest_s, again_s, condition, saying })
    }

    /// The state of a sensor at an edge of an interval; `None` if the rule has no event there.
    fn state(&self, edge: Edge, interval: &Interval, has_end: bool) -> Result<Option<State>, String> {
        let Some(kind) = self.device() else { return Ok(None) };
        let is_start = edge == Edge::Start;
        let is_event = self.saying.only_on;
        if has_end || is_event && self.kind.is_some() {
            return Ok((is_start || !is_event).then_some(Some(is_start)));
        }
        if !is_start {
            return Ok(None);
        }
        // A log without the column has events alone.
        let value = if interval.kind.is_empty() && is_event { "on" } else { &*interval.kind };
        let on = self.condition.state(kind, None, &comparable(value))?;
        Ok(Some(on).filter(|on| !is_event || *on == Some(true)))
    }

    fn device(&self) -> Option<SensorKind> {
        if let Class::Sensor(kind) = self.saying.class { Some(kind) } else { None }
    }

    fn fits(&self, edge: Edge, interval: &Interval) -> bool {
        let fits =
            |wanted: &Option<String>, own: &str| wanted.as_ref().is_none_or(|wanted| wanted.eq_ignore_ascii_case(own));
        (self.at == edge || self.device().is_some())
            && fits(&self.sensor, &interval.sensor)
            && fits(&self.kind, &interval.kind)
            && fits(&self.place, &interval.place)
    }
}

const NAMES: [&str; 4] = ["sensor", "kind", "place", "seconds"];

/// One line of a log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Interval {
    /// The start, in seconds since 1970 without regard to time zones, or in the log's count of seconds.
    pub start_s: f64,
    /// The end, not before the start. The start if the interval is open.
    pub end_s: f64,
    /// Whether it had not ended when the log was written.
    pub is_open: bool,
    /// The sensor.
    pub sensor: String,
    /// Its kind.
    pub kind: String,
    /// Its place.
    pub place: String,
}

#[derive(Debug)]
struct Matched<'a> {
    rule: &'a Rule,
    place: &'a str,
    said: Said,
    state: Option<(State, String)>,
}

impl Matched<'_> {
    /// Whether it breaks a silence: a sensor that turns off does not.
    fn is_heard(&self) -> bool {
        self.rule.saying.quiet().is_none() && self.state.as_ref().is_none_or(|(on, _)| *on == Some(true))
    }
}

/// A sentence or presence from an interval.
#[derive(Debug, Clone, PartialEq)]
pub struct Said {
    /// The sentence or presence. Its duration is the time since the item before it.
    pub item: Item,
    /// The time, as in [`Interval::start_s`].
    pub at_s: f64,
    /// The interval's line.
    pub line: u64,
    /// The index in [`SensorRules::intervals`].
    pub interval: usize,
}

/// A log as narration.
#[derive(Debug, Default)]
pub struct SensorLog {
    /// The narration, in the order of time.
    pub said: Vec<Said>,
    /// Lines that are malformed, in their order.
    pub faults: Faults,
    /// Intervals without a matching rule.
    pub unfit: u64,
    /// The number of skipped items: the interval was too short, the same item came shortly before, or no silence followed.
    pub silent: u64,
}

impl SensorRules {
    /// Reads and checks a rules file.
    ///
    /// # Errors
    ///
    /// [`SensorError::Read`], [`SensorError::Rules`] with the rule's number.
    pub fn load(path: &Path) -> Result<Self, SensorError> {
        let text =
            read_text_at_most(path, RULES_BYTES_MAX).map_err(|source| SensorError::Read(path.to_owned(), source))?;
        Self::parse(&text).map_err(|reason| SensorError::Rules(path.to_owned(), reason))
    }

    /// Reads and checks the text of a rules file.
    ///
    /// # Errors
    ///
    /// The fault, with the rule's number.
    pub fn parse(text: &str) -> Result<Self, String> {
        let file: RulesFile = toml::from_str(text).map_err(|error| toml_says(&error))?;
        if file.rules.is_empty() || file.rules.len() > RULES_MAX {
            return Err(format!("{} rules; give 1 to {RULES_MAX}, each begins with [[rule]]", file.rules.len()));
        }
        for (wanted, name) in [(Column::Start, "start"), (Column::Sensor, "sensor")] {
            let count = file.columns.iter().filter(|column| **column == wanted).count();
            if count != 1 {
                return Err(format!("columns has \"{name}\" {count} times; name it once"));
            }
        }
        let rules = (1..).zip(file.rules).map(|(number, keys)| {
            let rule = Rule::new(keys, &file.columns);
            rule.map_err(|fault: String| format!("rule {number}: {fault}"))
        });
        let rules = rules.collect::<Result<_, _>>()?;
        Ok(Self { columns: file.columns, rules, zone: Zone::UTC })
    }

    /// The same rules with a time zone: times with a zone, and seconds since 1970, become times of a clock in this zone.
    #[must_use]
    pub fn in_zone(self, zone: Zone) -> Self {
        Self { zone, ..self }
    }

    /// Reads a log's file; see [`Self::narrate`].
    ///
    /// # Errors
    ///
    /// [`SensorError::Read`], [`SensorError::TooLarge`].
    pub fn narrate_file(&self, path: &Path, person: &Who) -> Result<SensorLog, SensorError> {
        let read = |source| SensorError::Read(path.to_owned(), source);
        let bytes = read_at_most(path, FILE_BYTES_MAX).map_err(read)?;
        let bytes = bytes.ok_or_else(|| SensorError::TooLarge(path.to_owned()))?;
        Ok(self.narrate(&bytes, person))
    }

    /// The narration of a log: tab-, semicolon- or comma-separated; heading and underline are skipped. `person` is for rules without a
    /// person.
    #[must_use]
    pub fn narrate(&self, log: &[u8], person: &Who) -> SensorLog {
        let mut narrated = SensorLog::default();
        let mut intervals: Vec<(u64, Interval)> = Vec::new();
        for (line, interval) in self.lines(log) {
            match interval {
                Ok(interval) => intervals.push((line, interval)),
                Err(reason) => narrated.faults.add(line, reason),
            }
        }
        let mut matched: Vec<Matched<'_>> = Vec::new();
        // An open interval lasted until the log ended, at least.
        let ended_s = intervals.iter().map(|(_, interval)| interval.end_s).fold(f64::NEG_INFINITY, f64::max);
        for (number, (line, interval)) in intervals.iter().enumerate() {
            self.say((number, interval, ended_s), person, *line, &mut narrated, &mut matched);
        }
        matched.sort_by(|a, b| a.said.at_s.total_cmp(&b.said.at_s));
        let all = matched.len();
        let mut matched = after_silence(matched);
        narrated.silent += (all - matched.len()) as u64;
        matched.sort_by(|a, b| a.said.at_s.total_cmp(&b.said.at_s));
        let mut before_s = None;
        // The kitchen's door and the bathroom's are different, though both are "the door".
        let mut last: HashMap<(Who, String, &str), f64> = HashMap::new();
        let mut states: HashMap<String, State> = HashMap::new();
        for Matched { rule, place, mut said, state } in matched {
            if let Some((on, id)) = state
                && states.insert(id, on) == Some(on)
                && !rule.saying.only_on
            {
                narrated.silent += 1;
                continue;
            }
            let same = last.insert((said.item.person.clone(), said.item.text.clone(), place), said.at_s);
            if same.is_some_and(|same_s| said.at_s - same_s < rule.again_s) {
                narrated.silent += 1;
                continue;
            }
            said.item.duration_s = before_s.replace(said.at_s).map_or(0.0, |before_s| said.at_s - before_s);
            narrated.said.push(said);
        }
        narrated
    }

    /// The intervals of a log that can be read, in its order, whether or not a rule fits them.
    #[must_use]
    pub fn intervals(&self, log: &[u8]) -> Vec<Interval> {
        self.lines(log).filter_map(|(_, interval)| interval.ok()).collect()
    }

    /// Every line with its number, one at a time; heading and underline are skipped.
    fn lines(&self, log: &[u8]) -> impl Iterator<Item = (u64, Result<Interval, String>)> {
        self.lines_by(self.delimiter(log), log)
    }

    /// The separator of a log's fields. If several occur, as a semicolon in a name between commas, it is the one with which most lines can
    /// be read.
    fn delimiter(&self, log: &[u8]) -> u8 {
        let found: Vec<u8> = [b',', b';', b'\t'].into_iter().filter(|byte| log.contains(byte)).collect();
        let read_by = |delimiter: &u8| {
            let lines = self.lines_by(*delimiter, log).take(SAMPLE_LINES);
            lines.filter(|(_, interval)| interval.is_ok()).count()
        };
        match found[..] {
            [only] => only,
            // If several are equally good, the last.
            _ => found.into_iter().max_by_key(read_by).unwrap_or(b'\t'),
        }
    }

    fn lines_by(&self, delimiter: u8, log: &[u8]) -> impl Iterator<Item = (u64, Result<Interval, String>)> {
        let mut builder = ReaderBuilder::new();
        builder.delimiter(delimiter).has_headers(false).flexible(true).trim(Trim::All).buffer_capacity(LINE_BYTES);
        let mut reader = builder.from_reader(Line(&[]));
        let mut record = ByteRecord::new();
        let mut first = true;
        // Line by line: a stray quotation mark spoils its own line, and does not swallow those behind it.
        (1..).zip(log.split(|byte| *byte == b'\n')).filter_map(move |(line, bytes)| {
            if bytes.len() as u64 > LINE_BYTES_MAX {
                return Some((line, Err(format!("it has more than {LINE_BYTES_MAX} bytes"))));
            }
            // Seek before the reader gets the line: its first seek reads headings.
            let begun = reader.seek_raw(SeekFrom::Start(0), Position::new());
            *reader.get_mut() = Line(bytes);
            match begun.and_then(|()| reader.read_byte_record(&mut record)) {
                Ok(false) => return None,
                Ok(true) => {}
                Err(error) => return Some((line, Err(error.to_string()))),
            }
            let underline = record.iter().flatten().all(|byte| matches!(byte, b'-' | b' '));
            // A first line with a time in it is none: its other times are wrong. Nor is one with a number.
            let heading = std::mem::take(&mut first) && !record.iter().any(|field| begins_with_time(&text(field)));
            (!underline && !heading).then(|| (line, self.interval(&record, delimiter == b'\t')))
        })
    }

    fn interval(&self, record: &ByteRecord, tabs: bool) -> Result<Interval, String> {
        // An empty field is an empty column. But some public files align their columns with several tabs: then empty fields are dropped.
        let as_it_is = self.interval_of(record.iter());
        let is_closed = as_it_is.as_ref().is_ok_and(|interval| !interval.is_open);
        let not_empty = || record.iter().filter(|field| !field.is_empty());
        if is_closed || !tabs || not_empty().count() < self.columns.len() {
            return as_it_is;
        }
        // An end that seems missing may stand behind several tabs. More empty fields than the end's mean that tabs align columns.
        let aligned = self.interval_of(not_empty());
        let is_aligned = as_it_is.is_ok() && record.iter().filter(|field| field.is_empty()).count() > 1;
        if aligned.is_ok() || is_aligned { aligned } else { as_it_is }
    }

    fn interval_of<'a>(&self, fields: impl Iterator<Item = &'a [u8]>) -> Result<Interval, String> {
        let mut fields: Vec<String> = fields.take(self.columns.len()).map(text).collect();
        if fields.len() < self.columns.len() {
            let (found, wanted) = (fields.len(), self.columns.len());
            return Err(format!("it has {found} of {wanted} fields, which tabs, semicolons or commas separate"));
        }
        // A date alone has its time of the day in the next column.
        for at in 1..fields.len() {
            let is_split =
                matches!(self.columns[at - 1], Column::Start | Column::End) && self.columns[at] == Column::Other;
            if is_split && is_date(&fields[at - 1]) {
                fields[at - 1] = format!("{} {}", fields[at - 1], fields[at]);
            }
        }
        let mut interval = Interval { end_s: f64::NAN, ..Interval::default() };
        let (mut is_local, mut ends_local) = (true, true);
        for (column, field) in self.columns.iter().zip(fields) {
            let time = || {
                let is_number = field.parse().is_ok_and(f64::is_finite);
                let hint = match is_number {
                    true => "; are these milliseconds?",
                    false if is_date(&field) => "; name the column behind it \"-\" if the time of the day stands there",
                    false => "",
                };
                let fault = || format!("{} is no time; expected 2024-03-01 08:15:00, or seconds{hint}", quoted(&field));
                seconds(&field).ok_or_else(fault)
            };
            match column {
                Column::Start => (interval.start_s, is_local) = (time()?, is_clock_time(&field)),
                Column::End if OPEN.contains(&field.trim().to_ascii_lowercase().as_str()) => interval.is_open = true,
                Column::End => (interval.end_s, ends_local) = (time()?, is_clock_time(&field)),
                Column::Sensor => interval.sensor = field,
                Column::Kind => interval.kind = field,
                Column::Place => interval.place = field,
                Column::Other => {}
            }
        }
        // Numbers may be names of sensors; dates are not.
        if interval.is_open && interval.sensor.parse::<f64>().is_err() && seconds(&interval.sensor).is_some() {
            return Err(format!("{} is no sensor; name the columns in the rules file", quoted(&interval.sensor)));
        }
        if interval.end_s.is_nan() {
            (interval.end_s, ends_local) = (interval.start_s, is_local);
        }
        if !is_local {
            let ahead_s = self.ahead_s(interval.start_s);
            interval.start_s += ahead_s;
            // A change of the clock does not change the length of an interval.
            interval.end_s += if ends_local { 0.0 } else { ahead_s };
        } else if !ends_local {
            interval.end_s += self.ahead_s(interval.end_s);
        }
        if interval.end_s < interval.start_s
            && is_local
            && ends_local
            && may_be_folded(interval.start_s, interval.end_s)
        {
            // The clock was set back in between: the end's reading came twice, and the later one is meant.
            interval.end_s += FOLD_S;
        }
        if interval.end_s < interval.start_s {
            return Err("it ends before it begins".to_owned());
        }
        Ok(interval)
    }

    /// How far the clock of the zone is ahead of a universal time. A smaller number has no known origin.
    fn ahead_s(&self, at_s: f64) -> f64 {
        if at_s < UNIVERSAL_FROM_S { 0.0 } else { self.zone.local_s(UnixNs((at_s * 1e9) as u64)) - at_s }
    }

    /// The items of both edges: the first match without a wait, and each match that waits for silence.
    fn say<'a>(
        &'a self,
        (number, interval, ended_s): (usize, &'a Interval, f64),
        person: &Who,
        line: u64,
        narrated: &mut SensorLog,
        matched: &mut Vec<Matched<'a>>,
    ) {
        let end_s = if interval.is_open { ended_s } else { interval.end_s };
        let length_s = end_s - interval.start_s;
        let mut some = false;
        let has_end = self.columns.contains(&Column::End);
        let edges = [(Edge::Start, interval.start_s), (Edge::End, interval.end_s)];
        for (edge, at_s) in edges.into_iter().take(if interval.is_open { 1 } else { 2 }) {
            let fitting = self.rules.iter().filter(|rule| rule.fits(edge, interval));
            let (devices, sayings): (Vec<_>, Vec<_>) = fitting.partition(|rule| rule.device().is_some());
            let (waiting, at_once): (Vec<_>, Vec<_>) =
                sayings.into_iter().partition(|rule| rule.saying.quiet().is_some());
            let device = devices.into_iter().take(1);
            for rule in at_once.into_iter().take(1).chain(waiting).chain(device) {
                some = true;
                if length_s < rule.shortest_s {
                    narrated.silent += 1;
                    continue;
                }
                let words = |name: &str| name.replace('_', " ").to_lowercase();
                let value_of = |name: &str| match name {
                    "sensor" => words(&interval.sensor),
                    "kind" => words(&interval.kind),
                    "place" => words(&interval.place),
                    _ => format!("{length_s:.0}"),
                };
                let on = match rule.state(edge, interval, has_end) {
                    Ok(on) => on,
                    Err(fault) => {
                        narrated.faults.add(line, fault);
                        continue;
                    }
                };
                let (json, state) = match (rule.device(), on) {
                    (None, _) => (Some(rule.saying.line(value_of)), None),
                    (Some(_), None) => continue,
                    (Some(_), Some(on)) => {
                        let id = [&*interval.place, &*interval.sensor].join("/");
                        let json = rule.saying.report(on, id.trim_start_matches('/'), value_of);
                        (json, Some(on))
                    }
                };
                let json = json.ok_or_else(|| format!("it has more than {LINE_BYTES_MAX} bytes"));
                let item = json.and_then(|json| match line_item(&json, person) {
                    Ok(item) => Ok((id_of(&json), item)),
                    Err(source) => Err(source.to_string()),
                });
                match item {
                    Ok((id, item)) => {
                        let said = Said { item, at_s, line, interval: number };
                        let state = state.map(|on| (on, id));
                        matched.push(Matched { rule, place: &interval.place, said, state });
                    }
                    Err(fault) => narrated.faults.add(line, fault),
                }
            }
        }
        narrated.unfit += u64::from(!some);
    }
}

/// Drops items that wait for a silence that never comes, and moves the others to the end of their silence. Expects the order of time.
fn after_silence(matched: Vec<Matched<'_>>) -> Vec<Matched<'_>> {
    // Goes back in time, with the next immediate item and the next wait of the same line. The place does not matter: the silence is of the
    // whole home, and "away" by the back door replaces "away" by the front door.
    let mut next_s = f64::INFINITY;
    let mut again: HashMap<(Who, String), f64> = HashMap::new();
    let mut kept = Vec::with_capacity(matched.len());
    for own in matched.into_iter().rev() {
        let is_heard = own.is_heard();
        let Matched { rule, place, mut said, state } = own;
        if let Some(quiet) = rule.saying.quiet() {
            let end_s = said.at_s + quiet.as_secs_f64();
            let same = again.insert((said.item.person.clone(), said.item.text.clone()), said.at_s);
            if next_s.min(same.unwrap_or(f64::INFINITY)) < end_s {
                continue;
            }
            said.at_s = end_s;
        } else if is_heard {
            next_s = said.at_s;
        }
        kept.push(Matched { rule, place, said, state });
    }
    kept.reverse();
    kept
}

/// A line of a log, as a whole file for a reader.
struct Line<'a>(&'a [u8]);

impl Read for Line<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        self.0.read(to)
    }
}

/// A reader seeks to the beginning of a new line.
impl Seek for Line<'_> {
    fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
        Ok(0)
    }
}

fn id_of(json: &str) -> String {
    let line: serde_json::Value = serde_json::from_str(json).unwrap_or_default();
    line["id"].as_str().unwrap_or_default().to_owned()
}

fn quoted(field: &str) -> String {
    match field.char_indices().nth(QUOTED_MAX) {
        Some((end, _)) => format!("{:?}...", &field[..end]),
        None => format!("{field:?}"),
    }
}

fn text(field: &[u8]) -> String {
    String::from_utf8_lossy(field).into_owned()
}
