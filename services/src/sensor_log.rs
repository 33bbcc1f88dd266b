//! Narration from sensor logs, in the shape of public smart-home data sets: one interval per line, when it began and ended, which
//! sensor, of which kind, in which place. A rules file says which sentence it makes; `docs/sensors.md` is the manual.
//!
//! ```toml
//! columns = ["start", "end", "sensor", "kind", "place"]   # the default; "-" for a column that is of no interest
//!
//! [[rule]]
//! sensor = "fridge"                  # whatever its case; any where left out, as with kind and place
//! at = "start"                       # or "end"
//! say = "They open the {sensor}."    # {sensor}, {kind}, {place}, {seconds}
//!
//! [[rule]]
//! sensor = "front door"
//! at = "end"
//! presence = "away"                  # or "gone", or with a room "present" or "empty": no sentence, but who is where
//! person = "ada"                     # a name or a number
//! quiet_s = 600.0                    # said where no rule fits anything for so long
//! ```
//!
//! Pure: from the texts of log and rules to items with the times between them.

use std::collections::{BTreeMap, HashMap};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use csv::{ByteRecord, Position, ReaderBuilder, Trim};

use crate::daemon::Zone;
use crate::line::{Faults, Item, LINE_BYTES_MAX, Who, line_item};
use crate::rule::{Keys, Saying, Whereabouts};
use roomcast_core::parsing::{list_of_keyed, toml_says};
use roomcast_core::text::{read_at_most, read_text_at_most};

/// Largest log that is read, in bytes: it is held in memory.
pub const FILE_BYTES_MAX: u64 = 256 << 20;
/// Rules that a file may have.
const RULES_MAX: usize = 4_096;
/// Most bytes of a file of rules, and of one with credentials or certificates.
pub const RULES_BYTES_MAX: u64 = 4 << 20;
/// Bytes of a log that are looked at together; lines are shorter, as a rule.
const LINE_BYTES: usize = 256;
/// A plain number above this is no number of seconds: it would be later than the year 5000, and milliseconds of today are more.
const SECONDS_MAX: f64 = 1e11;
/// A number of seconds from here on (September 2001) is a time since 1970, in UTC; a smaller one counts from anywhere.
const UNIVERSAL_FROM_S: f64 = 1e9;
/// By so much clocks are set back in autumn, in seconds, on a Sunday before three o'clock.
const FOLD_S: f64 = 3_600.0;
const FOLD_UNTIL_S: f64 = 3.0 * 3_600.0;
/// Most characters of a field that an error quotes.
const QUOTED_MAX: usize = 80;
/// Lines that say what separates a log's fields.
const SAMPLE_LINES: usize = 1_000;

/// Why a log cannot be narrated at all. Single lines that are malformed are [`SensorLog::faults`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SensorError {
    /// A file cannot be read.
    #[error("failed to read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        source: io::Error,
    },
    /// The log is larger than [`FILE_BYTES_MAX`].
    #[error("the sensor log {path} has more than {FILE_BYTES_MAX} bytes; split it by days")]
    TooLarge {
        /// The file.
        path: PathBuf,
    },
    /// The rules are malformed.
    #[error("the rules {path} are malformed: {reason}; docs/sensors.md shows what they look like")]
    Rules {
        /// The file.
        path: PathBuf,
        /// Where and why.
        reason: String,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
enum Column {
    #[serde(rename = "start")]
    Start,
    #[serde(rename = "end")]
    End,
    #[serde(rename = "sensor")]
    Sensor,
    #[serde(rename = "kind")]
    Kind,
    #[serde(rename = "place")]
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

/// The rules by which intervals become narration.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorRules {
    columns: Vec<Column>,
    rules: Vec<Rule>,
    /// Where a clock shows the times of a log that are universal.
    zone: Zone,
}

/// A rules file.
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

/// A rule as it stands in the file.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct RuleKeys {
    sensor: Option<String>,
    kind: Option<String>,
    place: Option<String>,
    #[serde(default)]
    at: Edge,
    #[serde(default)]
    shortest_s: f64,
    #[serde(default)]
    again_s: f64,
    say: Option<String>,
    presence: Option<Whereabouts>,
    room: Option<String>,
    person: Option<Who>,
    quiet_s: Option<f64>,
}

#[derive(Debug, Clone, PartialEq)]
struct Rule {
    sensor: Option<String>,
    kind: Option<String>,
    place: Option<String>,
    at: Edge,
    shortest_s: f64,
    again_s: f64,
    saying: Saying,
}

impl Rule {
    fn new(keys: RuleKeys) -> Result<Self, String> {
        let RuleKeys { sensor, kind, place, at, shortest_s, again_s, say, presence, room, person, quiet_s } = keys;
        if !(shortest_s >= 0.0 && again_s >= 0.0) {
            return Err("shortest_s and again_s are 0 or more".to_owned());
        }
        let (say, room, person) = (say.as_deref(), room.as_deref(), person.as_ref());
        let saying = Saying::new(Keys { say, presence, room, person, quiet_s }, &NAMES.map(str::to_owned))?;
        Ok(Self { sensor, kind, place, at, shortest_s, again_s, saying })
    }

    fn fits(&self, edge: Edge, interval: &Interval) -> bool {
        let fits =
            |wanted: &Option<String>, own: &str| wanted.as_ref().is_none_or(|wanted| wanted.eq_ignore_ascii_case(own));
        self.at == edge
            && fits(&self.sensor, &interval.sensor)
            && fits(&self.kind, &interval.kind)
            && fits(&self.place, &interval.place)
    }
}

/// What stands for the interval's words in a rule.
const NAMES: [&str; 4] = ["sensor", "kind", "place", "seconds"];

/// One line of a log.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Interval {
    /// When it began, in seconds since 1970 without regard to time zones, or as the log counts seconds.
    pub start_s: f64,
    /// When it ended; not before it began.
    pub end_s: f64,
    /// Which sensor.
    pub sensor: String,
    /// Of which kind.
    pub kind: String,
    /// In which place.
    pub place: String,
}

/// What a rule makes of one edge of an interval.
#[derive(Debug)]
struct Matched<'a> {
    rule: &'a Rule,
    place: &'a str,
    said: Said,
}

/// What is said of an interval.
#[derive(Debug, Clone, PartialEq)]
pub struct Said {
    /// What; its duration is the time since what is said before it.
    pub item: Item,
    /// When, as [`Interval::start_s`].
    pub at_s: f64,
    /// The interval's line.
    pub line: u64,
    /// Which of [`SensorRules::intervals`] it is.
    pub interval: usize,
}

/// A log as narration.
#[derive(Debug, Default)]
pub struct SensorLog {
    /// What is said, in the order of time.
    pub said: Vec<Said>,
    /// Lines that are malformed, in their order.
    pub faults: Faults,
    /// Intervals that no rule fits.
    pub unfit: u64,
    /// What was left out: the interval was too short, the same was said shortly before, or there was no silence to say it after.
    pub silent: u64,
}

impl SensorRules {
    /// Reads and checks a rules file.
    ///
    /// # Errors
    ///
    /// [`SensorError::Read`], [`SensorError::Rules`] with the rule's number.
    pub fn load(path: &Path) -> Result<Self, SensorError> {
        let text = read_text_at_most(path, RULES_BYTES_MAX)
            .map_err(|source| SensorError::Read { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|reason| SensorError::Rules { path: path.to_owned(), reason })
    }

    /// Reads and checks the text of a rules file.
    ///
    /// # Errors
    ///
    /// What is wrong, with the rule's number.
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
            let rule = Rule::new(keys);
            rule.map_err(|fault: String| format!("rule {number}: {fault}"))
        });
        Ok(Self { columns: file.columns, rules: rules.collect::<Result<_, _>>()?, zone: Zone::UTC })
    }

    /// The same rules, for a log whose times are wanted as a clock of that zone shows them: those that say their zone, and seconds since 1970.
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
        let read = |source| SensorError::Read { path: path.to_owned(), source };
        let bytes = read_at_most(path, FILE_BYTES_MAX).map_err(read)?;
        let bytes = bytes.ok_or_else(|| SensorError::TooLarge { path: path.to_owned() })?;
        Ok(self.narrate(&bytes, person))
    }

    /// The narration of a log: tab-, semicolon- or comma-separated; heading and underline are passed over. What a rule without a person
    /// says is of `person`.
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
        for (number, (line, interval)) in intervals.iter().enumerate() {
            self.say((number, interval), person, *line, &mut narrated, &mut matched);
        }
        matched.sort_by(|a, b| a.said.at_s.total_cmp(&b.said.at_s));
        let all = matched.len();
        let mut matched = after_silence(matched);
        narrated.silent += (all - matched.len()) as u64;
        matched.sort_by(|a, b| a.said.at_s.total_cmp(&b.said.at_s));
        let mut before_s = None;
        // The kitchen's door is another than the bathroom's, though both are "the door".
        let mut last: HashMap<(Who, String, &str), f64> = HashMap::new();
        for Matched { rule, place, mut said } in matched {
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

    /// Every line with its number, one at a time; heading and underline are passed over.
    fn lines(&self, log: &[u8]) -> impl Iterator<Item = (u64, Result<Interval, String>)> {
        self.lines_by(self.delimiter(log), log)
    }

    /// What separates a log's fields. Of several that occur, as a semicolon in a name between commas, it is the one by which most lines can be read.
    fn delimiter(&self, log: &[u8]) -> u8 {
        let found: Vec<u8> = [b',', b';', b'\t'].into_iter().filter(|byte| log.contains(byte)).collect();
        let read_by = |delimiter: &u8| {
            let lines = self.lines_by(*delimiter, log).take(SAMPLE_LINES);
            lines.filter(|(_, interval)| interval.is_ok()).count()
        };
        match found[..] {
            [only] => only,
            // Of those that are as good, the last.
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
            // In this order: when it is sought first, a reader takes what it has for headings.
            let begun = reader.seek_raw(SeekFrom::Start(0), Position::new());
            *reader.get_mut() = Line(bytes);
            match begun.and_then(|()| reader.read_byte_record(&mut record)) {
                Ok(false) => return None,
                Ok(true) => {}
                Err(error) => return Some((line, Err(error.to_string()))),
            }
            let underline = record.iter().flatten().all(|byte| matches!(byte, b'-' | b' '));
            // A first line with a time in it is none: its other times are wrong. Nor is one with a number.
            let is_time = |field: &str| seconds(field).is_some() || field.parse().is_ok_and(f64::is_finite);
            let heading = std::mem::take(&mut first) && !record.iter().any(|field| is_time(&text(field)));
            (!underline && !heading).then(|| (line, self.interval(&record, delimiter == b'\t')))
        })
    }

    fn interval(&self, record: &ByteRecord, tabs: bool) -> Result<Interval, String> {
        // An empty field is a column with nothing in it. But some of the public files align their columns by several tabs: there the times
        // are not where they belong, until empty fields are taken out.
        let as_it_is = self.interval_of(record.iter());
        if as_it_is.is_ok() || !tabs || !record.iter().any(<[u8]>::is_empty) {
            return as_it_is;
        }
        let not_empty = || record.iter().filter(|field| !field.is_empty());
        if not_empty().count() < self.columns.len() { as_it_is } else { self.interval_of(not_empty()) }
    }

    fn interval_of<'a>(&self, fields: impl Iterator<Item = &'a [u8]>) -> Result<Interval, String> {
        let fields: Vec<String> = fields.take(self.columns.len()).map(text).collect();
        if fields.len() < self.columns.len() {
            let (found, wanted) = (fields.len(), self.columns.len());
            return Err(format!("it has {found} of {wanted} fields, which tabs, semicolons or commas separate"));
        }
        let mut interval = Interval { end_s: f64::NAN, ..Interval::default() };
        let (mut is_local, mut ends_local) = (true, true);
        for (column, field) in self.columns.iter().zip(fields) {
            let time = || {
                let is_number = field.parse().is_ok_and(f64::is_finite);
                let hint = if is_number { "; are these milliseconds?" } else { "" };
                let fault = || format!("{} is no time; expected 2024-03-01 08:15:00, or seconds{hint}", quoted(&field));
                seconds(&field).ok_or_else(fault)
            };
            match column {
                Column::Start => (interval.start_s, is_local) = (time()?, is_clock_time(&field)),
                Column::End => (interval.end_s, ends_local) = (time()?, is_clock_time(&field)),
                Column::Sensor => interval.sensor = field,
                Column::Kind => interval.kind = field,
                Column::Place => interval.place = field,
                Column::Other => {}
            }
        }
        if interval.end_s.is_nan() {
            (interval.end_s, ends_local) = (interval.start_s, is_local);
        }
        if !is_local {
            let ahead_s = self.ahead_s(interval.start_s);
            interval.start_s += ahead_s;
            // An interval is as long as it was, whatever became of the clock meanwhile.
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

    /// How far the clock of the zone is ahead of a universal time. Of a number that is no time since 1970 nobody knows what it counts from.
    fn ahead_s(&self, at_s: f64) -> f64 {
        if at_s < UNIVERSAL_FROM_S { 0.0 } else { self.zone.local_s((at_s * 1e9) as u64) - at_s }
    }

    /// What the rules say of both edges: the first that fits and says it at once, and each that fits and waits for silence.
    fn say<'a>(
        &'a self,
        (number, interval): (usize, &'a Interval),
        person: &Who,
        line: u64,
        narrated: &mut SensorLog,
        matched: &mut Vec<Matched<'a>>,
    ) {
        let length_s = interval.end_s - interval.start_s;
        let mut some = false;
        for (edge, at_s) in [(Edge::Start, interval.start_s), (Edge::End, interval.end_s)] {
            let fitting = self.rules.iter().filter(|rule| rule.fits(edge, interval));
            let (waiting, at_once): (Vec<_>, Vec<_>) = fitting.partition(|rule| rule.saying.quiet().is_some());
            for rule in at_once.into_iter().take(1).chain(waiting) {
                some = true;
                if length_s < rule.shortest_s {
                    narrated.silent += 1;
                    continue;
                }
                let words = |name: &str| name.replace('_', " ").to_lowercase();
                let json = rule.saying.line(|name| match name {
                    "sensor" => words(&interval.sensor),
                    "kind" => words(&interval.kind),
                    "place" => words(&interval.place),
                    _ => format!("{length_s:.0}"),
                });
                match line_item(&json, person) {
                    Ok(item) => {
                        let said = Said { item, at_s, line, interval: number };
                        matched.push(Matched { rule, place: &interval.place, said });
                    }
                    Err(source) => narrated.faults.add(line, source),
                }
            }
        }
        narrated.unfit += u64::from(!some);
    }
}

/// Of what waits for silence, that which has it, at its end; all else as it was. The order is that of time, before.
fn after_silence(matched: Vec<Matched<'_>>) -> Vec<Matched<'_>> {
    // Going back in time: when something is said at once next, and when the same line begins to wait again. Of whatever place: silence is that
    // of the whole home, and "away" by the back door takes the place of "away" by the front door.
    let mut next_s = f64::INFINITY;
    let mut again: HashMap<(Who, String), f64> = HashMap::new();
    let mut kept = Vec::with_capacity(matched.len());
    for Matched { rule, place, mut said } in matched.into_iter().rev() {
        if let Some(quiet) = rule.saying.quiet() {
            let end_s = said.at_s + quiet.as_secs_f64();
            let same = again.insert((said.item.person.clone(), said.item.text.clone()), said.at_s);
            if next_s.min(same.unwrap_or(f64::INFINITY)) < end_s {
                continue;
            }
            said.at_s = end_s;
        } else {
            next_s = said.at_s;
        }
        kept.push(Matched { rule, place, said });
    }
    kept.reverse();
    kept
}

/// A line of a log, which a reader takes for a whole file.
struct Line<'a>(&'a [u8]);

impl Read for Line<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        self.0.read(to)
    }
}

/// A reader begins again with a new line; that is at its beginning.
impl Seek for Line<'_> {
    fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
        Ok(0)
    }
}

/// The beginning of a field, for an error.
fn quoted(field: &str) -> String {
    match field.char_indices().nth(QUOTED_MAX) {
        Some((end, _)) => format!("{:?}...", &field[..end]),
        None => format!("{field:?}"),
    }
}

fn text(field: &[u8]) -> String {
    String::from_utf8_lossy(field).into_owned()
}

/// Times in which nobody was at home.
#[derive(Debug, Default, PartialEq)]
pub struct Absences {
    /// When each began and ended.
    pub intervals: Vec<(f64, f64)>,
    /// What was taken for absence or presence, and how often; nothing where no interval says what it is.
    pub labels: BTreeMap<String, usize>,
    /// Intervals with other labels, which were passed over.
    pub others: usize,
}

/// Times in which nobody was at home, from a log of intervals with two or more columns, when each began and ended and what it was:
/// all intervals if the third column is missing; else those that say so, or, where none does, what lies between those that say the
/// person was at home.
///
/// # Errors
/// The line that cannot be read, or that no interval says who was where.
pub fn absences(log: &[u8]) -> Result<Absences, String> {
    let columns = vec![Column::Start, Column::End];
    let reader = SensorRules { columns: columns.clone(), rules: Vec::new(), zone: Zone::UTC };
    let named = SensorRules { columns: [columns, vec![Column::Sensor]].concat(), rules: Vec::new(), zone: Zone::UTC };
    let (mut all, mut away, mut home) = (Vec::new(), Vec::new(), Vec::new());
    let mut labels: [BTreeMap<String, usize>; 2] = Default::default();
    let mut with_labels = 0;
    for ((line, interval), (_, with_name)) in reader.lines(log).zip(named.lines(log)) {
        let Interval { start_s, end_s, .. } = interval.map_err(|reason| format!("line {line}: {reason}"))?;
        all.push((start_s, end_s));
        let Ok(Interval { sensor: label, .. }) = with_name else { continue };
        with_labels += 1;
        let Some(is_away) = says_away(&label) else { continue };
        let own = if is_away { &mut away } else { &mut home };
        own.push((start_s, end_s));
        *labels[usize::from(!is_away)].entry(label).or_default() += 1;
    }
    let [labels_away, labels_home] = labels;
    if all.is_empty() || with_labels == 0 {
        return Ok(Absences { intervals: all, ..Absences::default() });
    }
    if !away.is_empty() {
        return Ok(Absences { others: with_labels - away.len(), intervals: away, labels: labels_away });
    }
    if home.is_empty() {
        return Err(
            "no interval says away or present in its third column; docs/experiments.md has the words".to_owned()
        );
    }
    let others = with_labels - home.len();
    home.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut until_s = home[0].1;
    for (start_s, end_s) in &home[1..] {
        if *start_s > until_s {
            away.push((until_s, *start_s));
        }
        until_s = until_s.max(*end_s);
    }
    Ok(Absences { intervals: away, labels: labels_home, others })
}

/// Whether an interval's label, as a whole, says that somebody was away, or at home; none where it says something else. "Putting away
/// dishes" and "Taking out the trash" do, so that a word in it is not enough.
fn says_away(label: &str) -> Option<bool> {
    const AWAY: [&str; 7] = ["away", "out", "gone", "absent", "elsewhere", "outside", "outdoors"];
    const LEAVES: [&str; 5] = ["leave", "leaves", "leaving", "left", "exit"];
    const GOES: [&str; 4] = ["go", "goes", "going", "went"];
    const HOUSE: [&str; 5] = ["house", "home", "apartment", "flat", "building"];
    const HOME: [&str; 5] = ["present", "home", "in", "inside", "indoors"];
    let label = label.to_lowercase().replace(['_', '-'], " ");
    let words: Vec<&str> = label.split_whitespace().filter(|word| !matches!(*word, "the" | "a" | "my")).collect();
    let is_house = |word: &str| HOUSE.contains(&word);
    match words.as_slice() {
        [word] if AWAY.contains(word) || LEAVES.contains(word) => Some(true),
        ["not", "home" | "present" | "in"] | ["not", "at", "home"] => Some(true),
        [word] if HOME.contains(word) => Some(false),
        // "leave house", "leaving home for work", "going out to work", "out of the house", "away from home".
        [verb, house, ..] if LEAVES.contains(verb) && is_house(house) => Some(true),
        [verb, "out" | "away" | "outside", ..] if GOES.contains(verb) => Some(true),
        ["out", "of", house] | ["away" | "absent", "from", house] | ["outside", house] if is_house(house) => Some(true),
        ["at", house] | ["in", house] if is_house(house) => Some(false),
        _ => None,
    }
}

/// Whether a time is what a clock on the wall shows: a date that does not say its zone, no number of seconds.
fn is_clock_time(field: &str) -> bool {
    field.parse::<f64>().is_err() && zone_of(field).1.is_none()
}

/// A time without the mark of its zone, and how many seconds a clock of that is ahead: "Z", "+01:00", "-0530".
fn zone_of(field: &str) -> (&str, Option<f64>) {
    let field = field.trim_end();
    if let Some(time) = field.strip_suffix('Z') {
        return (time, Some(0.0));
    }
    let marked = || {
        // Dates have signs, too.
        let at = field.rfind(['+', '-']).filter(|at| field[..*at].contains(':'))?;
        let digits = field[at + 1..].replace(':', "");
        let number: u32 =
            digits.parse().ok().filter(|_| digits.len() == 4 && digits.bytes().all(|b| b.is_ascii_digit()))?;
        let (hours, minutes) = (number / 100, number % 100);
        let sign = if field[at..].starts_with('-') { -1.0 } else { 1.0 };
        (hours < 15 && minutes < 60).then_some((&field[..at], sign * f64::from(3_600 * hours + 60 * minutes)))
    };
    marked().map_or((field, None), |(time, ahead_s)| (time, Some(ahead_s)))
}

/// Whether the clock may have been set back between two of its times. Where a log is from nobody says; but wherever summer time ends, it
/// does so by an hour in the early hours of a Sunday.
fn may_be_folded(start_s: f64, end_s: f64) -> bool {
    // The first day of 1970 was a Thursday.
    let is_sunday = (start_s / 86_400.0).floor().rem_euclid(7.0) == 3.0;
    let of_night = |at_s: f64| at_s.rem_euclid(86_400.0) < FOLD_UNTIL_S;
    is_sunday && of_night(start_s) && of_night(end_s) && (0.0..=FOLD_S).contains(&(start_s - end_s))
}

/// Seconds of `2024-03-01 08:15:00` (with `T`, `/` and fractions as well) since 1970, by the clock that it was read from, without regard to leap
/// seconds; universal ones of a time that says its zone; or those of a plain number of seconds. None for a date or time of the day that does not exist, and for so many seconds that they must be
/// something else.
#[must_use]
pub fn seconds(text: &str) -> Option<f64> {
    if let Ok(seconds) = text.parse::<f64>() {
        return (seconds.abs() <= SECONDS_MAX).then_some(seconds);
    }
    let (clock, ahead_s) = zone_of(text);
    let (date, time) = clock.split_once([' ', 'T'])?;
    let mut parts = date.splitn(3, ['-', '/']);
    let (year, month, day) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
    let mut parts = time.trim().splitn(3, ':');
    let (hour, minute) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
    let second: f64 = parts.next().unwrap_or("0").parse().ok()?;
    if !(1..=9_999).contains(&year) || !(0.0..61.0).contains(&second) {
        return None;
    }
    let whole = tz::UtcDateTime::new(year, month, day, hour, minute, second as u8, 0).ok()?;
    Some(whole.unix_time() as f64 + second.fract() - ahead_s.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: &str = include_str!("../../tests/data/sensor-rules.toml");
    const LOG: &str = include_str!("../../tests/data/sensors.tsv");

    fn said(log: &SensorLog) -> Vec<(String, f64)> {
        log.said.iter().map(|said| (said.item.text.clone(), said.item.duration_s)).collect()
    }

    #[test]
    fn the_documented_example_is_narrated_in_the_order_of_time() {
        let log = SensorRules::parse(RULES).unwrap().narrate(LOG.as_bytes(), &Who::Somebody);
        let sentences: Vec<String> = said(&log).into_iter().map(|(text, _)| text).collect();
        assert_eq!(
            sentences,
            [
                "They get up from the bed.",
                "They walk to the bathroom.",
                "They flush the toilet.",
                "They walk to the kitchen.",
                "They open the fridge.",
                "They close the fridge.",
                "They switch on the coffee maker.",
            ]
        );
        // The bed is left at 07:12:40; 20 seconds later somebody is in the bathroom.
        assert_eq!((Some(log.said[0].at_s), said(&log)[1].1), (seconds("2024-03-01 07:12:40"), 20.0));
        assert_eq!((log.unfit, log.silent), (1, 2));
        assert_eq!(log.faults.count(), 0);
    }

    #[test]
    fn malformed_lines_are_named_and_the_others_are_said() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let log = "start,end,sensor,kind,place\n2024-03-01 08:00:00,2024-03-01 08:00:05,fridge,door,kitchen\nyesterday,,fridge,door,kitchen\n\
                   2024-03-01 08:00:09,2024-03-01 08:00:05,fridge,door,kitchen\n10,20\n30,40,oven,door,kitchen\n50,60,a\u{7}b,door,kitchen\n";
        let narrated = rules.narrate(log.as_bytes(), &Who::Somebody);
        let errors = narrated.faults.told();
        assert_eq!((errors.len(), narrated.faults.count()), (4, 4), "{errors:?}");
        for (error, part) in errors.iter().zip([
            "line 3: \"yesterday\" is no time",
            "line 4: it ends before",
            "line 5: it has 2 of 5 fields",
            "line 7: ",
        ]) {
            assert!(error.starts_with(part), "{error}");
        }
        assert_eq!(said(&narrated).len(), 2);
    }

    /// One sensor "tv; upstairs" made a log of commas one of semicolons, of which no line could be read.
    #[test]
    fn a_separator_in_a_field_is_none_of_the_log() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They use the {sensor}.\"").unwrap();
        let fields = ["2024-03-01 08:00:00", "2024-03-01 08:00:05", "tv", "plug", "hall"];
        for (separator, others) in [(",", ";\t"), (";", ","), ("\t", ";,")] {
            for other in others.chars() {
                let of = |sensor: &str| fields.join(separator).replace("tv", sensor);
                let log = [of("tv"), of(&format!("\"tv{other} upstairs\"")), of("tv")].join("\n");
                assert_eq!(rules.intervals(log.as_bytes()).len(), 3, "{log}");
            }
        }
    }

    #[test]
    fn columns_can_stand_in_any_order_and_some_can_be_left_out() {
        let rules = "columns = [\"-\", \"sensor\", \"start\"]\n[[rule]]\nsensor = \"Front_Door\"\nperson = 2\nsay = \"They leave by the {sensor}.\"";
        let narrated =
            SensorRules::parse(rules).unwrap().narrate(b"1;front_door;100\n2;FRONT_DOOR;160.5\n", &Who::Somebody);
        assert_eq!(
            said(&narrated),
            [("They leave by the front door.".to_owned(), 0.0), ("They leave by the front door.".to_owned(), 60.5)]
        );
        assert!(narrated.said.iter().all(|said| said.item.person == Who::Number(2)));
    }

    #[test]
    fn sensors_say_who_is_where() {
        let rules = "[[rule]]\nkind = \"PIR\"\npresence = \"present\"\nroom = \"{place}\"\nagain_s = 300.0\n\
            [[rule]]\nsensor = \"front_door\"\nat = \"end\"\npresence = \"away\"\nperson = \"ada\"\nquiet_s = 600.0";
        let rules = SensorRules::parse(rules).unwrap();
        let log = "0,5,ceiling,PIR,Living_Room\n100,110,front_door,Magnetic,Hall\n200,205,ceiling,PIR,Living_Room\n\
            1000,1010,front_door,Magnetic,Hall\n1300,1310,front_door,Magnetic,Hall\n5000,5001,ceiling,PIR,Kitchen\n\
            5100,5110,front_door,Magnetic,Hall\n";
        let log = rules.narrate(log.as_bytes(), &Who::Number(4));
        let said: Vec<_> = log.said.iter().map(|said| &said.item).collect();
        let ada = Who::Name("ada".to_owned());
        let told: Vec<_> = said.iter().map(|item| (item.text.as_str(), item.person.clone(), item.duration_s)).collect();
        assert_eq!(
            told,
            [
                ("present in the living room", Who::Number(4), 0.0),
                // At 110 the door closes, and at 200 somebody moves, which was not worth saying again.
                ("away", ada.clone(), 1910.0),
                ("present in the kitchen", Who::Number(4), 3090.0),
                ("away", ada, 710.0),
            ]
        );
        assert!(said.iter().all(|item| item.kind == roomcast_ipc::narration_kind::PRESENCE));
        assert_eq!((log.unfit, log.silent), (0, 3));
    }

    #[test]
    fn the_same_sentence_of_another_place_is_said() {
        let rules = "[[rule]]\nsay = \"They open the door.\"\nagain_s = 30.0";
        let log =
            b"0,1,a,Magnetic,kitchen\n10,11,b,Magnetic,bathroom\n20,21,a,Magnetic,kitchen\n60,61,a,Magnetic,kitchen\n";
        let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Somebody);
        assert_eq!(log.said.iter().map(|said| said.at_s).collect::<Vec<_>>(), [0.0, 10.0, 60.0]);
        assert_eq!(log.silent, 1);
    }

    /// Also from another place: silence is that of the home.
    #[test]
    fn what_begins_to_wait_again_takes_the_place_of_what_waited() {
        let rules = "[[rule]]\nkind = \"Magnetic\"\npresence = \"away\"\nquiet_s = 600.0\n\
            [[rule]]\nkind = \"PIR\"\nat = \"end\"\npresence = \"empty\"\nroom = \"{place}\"";
        let log =
            b"0,1,front_door,Magnetic,hall\n300,301,back_door,Magnetic,kitchen\n2000,2010,ceiling,PIR,Living_Room\n";
        let log = SensorRules::parse(rules).unwrap().narrate(log, &Who::Number(4));
        let told: Vec<_> = log.said.iter().map(|said| (said.item.text.as_str(), said.at_s)).collect();
        assert_eq!(told, [("away", 900.0), ("nobody in the living room", 2010.0)]);
        assert_eq!((log.silent, log.said[1].item.person.clone()), (1, Who::Somebody));
    }

    #[test]
    fn malformed_rules_are_named() {
        for (text, part) in [
            ("", "0 rules; give 1 to 4096, each begins with [[rule]]"),
            (
                "[[rule]]\nsay = \"They {value}.\"",
                "rule 1: say has {value}; it knows {sensor}, {kind}, {place}, {seconds}",
            ),
            ("[[rule]]\npresence = \"away\"\nroom = \"hall\"", "rule 1: room goes with"),
            ("[[rule]]\npresence = \"away\"\nquiet_s = -1", "rule 1: quiet_s is -1"),
            ("[[rule]]\nsay = \"\"", "rule 1"),
            ("[[rule]]\nsay = \"They sit.\"\nshortest_s = -1.0", "rule 1: shortest_s"),
            ("columns = [\"sensor\"]\n[[rule]]\nsay = \"They sit.\"", "columns has \"start\" 0 times"),
            ("[[rule]]\nsays = \"They sit.\"", "unknown key"),
            (
                "[[rule]]\npresence = \"unknown\"",
                "unknown word `unknown`, expected one of `present`, `away`, `gone`, `empty`",
            ),
            (
                "[[rule]]\npresence = \"empty\"",
                "rule 1: presence = \"empty\" says that nobody is in a room: it needs room",
            ),
        ] {
            let error = SensorRules::parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn absences_are_read_from_intervals_of_either_kind() {
        let times = |log: &[u8]| absences(log).unwrap().intervals;
        assert_eq!(times(b"10\t20\n30\t40\n"), [(10.0, 20.0), (30.0, 40.0)]);
        let mixed = b"start;end;what\n10;20;Sleeping\n20;40;Leaving\n50;60;leave-house\n60;70;Leaving\n";
        let labels = [("Leaving".to_owned(), 2), ("leave-house".to_owned(), 1)].into();
        let intervals = vec![(20.0, 40.0), (50.0, 60.0), (60.0, 70.0)];
        assert_eq!(absences(mixed).unwrap(), Absences { intervals, labels, others: 1 });
        let home = b"start,end,what\n50,60,present\n0,20,at home\n15,30,present\n";
        assert_eq!(times(home), [(30.0, 50.0)]);
        assert!(absences(b"10,20,Sleeping\n").unwrap_err().contains("third column"));
        assert!(absences(b"10,20,x\nnoon,20,x\n").unwrap_err().starts_with("line 2"));
        // A heading has no time at all.
        assert!(absences(b"noon\t2024-03-01 08:18:00\n").unwrap_err().starts_with("line 1"));
        assert_eq!(times(b""), []);
    }

    /// Labels of public data sets that have such a word in them, and mean something else.
    #[test]
    fn a_label_says_who_is_out_as_a_whole() {
        for away in [
            "away",
            "Out",
            "GONE",
            "Leaving",
            "leave house",
            "Leave_Home",
            "leaving the house",
            "Going out to work",
            "Went out for shopping",
            "out of the house",
            "away from home",
            "not at home",
            "Left the home for work",
        ] {
            assert_eq!(says_away(away), Some(true), "{away}");
        }
        for home in ["present", "Home", "at home", "in", "in the house", "indoors"] {
            assert_eq!(says_away(home), Some(false), "{home}");
        }
        for other in [
            "Putting away dishes",
            "Putting away groceries",
            "Taking out the trash",
            "Sleep_Out_Of_Bed",
            "Lawnwork outside",
            "Working from home",
            "Getting in bed",
            "Leftovers",
            "",
            "left arm",
            "Come home",
            "Washing out the sink",
        ] {
            assert_eq!(says_away(other), None, "{other}");
        }
    }

    /// A column with nothing in it is empty, whatever stands between columns. Several tabs between the times align columns.
    #[test]
    fn an_empty_field_moves_no_column() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let day = "2024-03-01 08:00:00";
        let read = |fields: &[&str], separator: &str| {
            let line = fields.join(separator) + "\n";
            rules.intervals(line.as_bytes()).pop().map(|read| (read.sensor, read.kind, read.place))
        };
        let is = |sensor: &str, kind: &str, place: &str| Some((sensor.into(), kind.into(), place.into()));
        for separator in ["\t", ";", ","] {
            assert_eq!(read(&[day, day, "fridge", "", "Kitchen", "Cooking"], separator), is("fridge", "", "Kitchen"));
            assert_eq!(read(&[day, day, "fridge", "door", ""], separator), is("fridge", "door", ""));
            assert_eq!(read(&[day, day, "fridge", "", "", "Cooking", "x"], separator), is("fridge", "", ""));
            assert_eq!(read(&[day, day, "fridge", "door"], separator), None);
        }
        let aligned = [day, "", day, "", "Bed", "", "", "Pressure", "Bedroom"];
        assert_eq!(read(&aligned, "\t"), is("Bed", "Pressure", "Bedroom"));
        assert_eq!(read(&aligned, ";"), None);
        let faults = |line: &str| rules.narrate(line.as_bytes(), &Who::Somebody).faults.told().to_vec();
        let wrong = format!("{day}\t\tnoon\t\tBed\t\tPressure\tBedroom\n");
        assert!(faults(&wrong)[0].starts_with("line 1: \"noon\" is no time"), "{:?}", faults(&wrong));
        assert!(faults("1709280900000,1709280905000,fridge,-,-\n")[0].ends_with("are these milliseconds?"));
    }

    /// Each is of its own interval, also where two begin at the same time.
    #[test]
    fn what_is_said_says_of_which_interval() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They walk to the {place}.\"").unwrap();
        let log = b"start,end,sensor,kind,place\nx\n20,25,a,PIR,kitchen\n10,15,b,PIR,hall\n10,11,c,PIR,bath\n";
        let all = rules.intervals(log);
        let said = rules.narrate(log, &Who::Somebody).said;
        assert_eq!(
            said.iter().map(|said| (said.line, said.at_s)).collect::<Vec<_>>(),
            [(4, 10.0), (5, 10.0), (3, 20.0)]
        );
        for said in said {
            assert!(said.item.text.contains(&all[said.interval].place), "{said:?}");
        }
    }

    /// On 25 October 2026 clocks in Europe go back from 03:00 to 02:00.
    #[test]
    fn an_interval_over_the_end_of_summer_time_has_its_length() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They sit on the {sensor} for {seconds} s.\"").unwrap();
        let read = |start: &str, end: &str| {
            let log = rules.narrate(format!("{start},{end},sofa,-,-\n").as_bytes(), &Who::Somebody);
            log.said.first().map(|said| said.item.text.clone()).ok_or_else(|| log.faults.told().to_vec())
        };
        for (start, end, seconds) in [
            ("2026-10-25 02:30:00", "2026-10-25 02:10:00", 2_400),
            ("2026-10-25T02:59:59", "2026-10-25T02:00:00", 1),
            // In New York on 1 November.
            ("2026/11/01 01:45:00", "2026/11/01 01:30:00", 2_700),
            // Forward, nothing is known of the clock.
            ("2026-10-25 02:10:00", "2026-10-25 02:30:00", 1_200),
        ] {
            assert_eq!(read(start, end), Ok(format!("They sit on the sofa for {seconds} s.")));
        }
        for (start, end) in [
            // A Saturday, by day, by more than an hour, over midnight; in UTC, where nothing is set back; seconds.
            ("2026-10-24 02:30:00", "2026-10-24 02:10:00"),
            ("2026-10-25 08:30:00", "2026-10-25 08:10:00"),
            ("2026-10-25 02:30:00", "2026-10-25 01:10:00"),
            ("2026-10-25 00:10:00", "2026-10-24 23:50:00"),
            ("2026-10-25 02:30:00Z", "2026-10-25 02:10:00Z"),
            ("1792895400", "1792894200"),
        ] {
            assert!(read(start, end).unwrap_err()[0].contains("it ends before it begins"), "{start} {end}");
        }
    }

    /// Home Assistant's history has times in UTC; habits go by the hours of a clock on the wall.
    #[test]
    fn times_that_say_their_zone_are_those_of_the_home() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They sit on the {sensor} for {seconds} s.\"").unwrap();
        let berlin = rules.clone().in_zone(Zone::of_variable(Some("CET-1CEST,M3.5.0,M10.5.0/3".as_ref())).unwrap());
        let starts = |rules: &SensorRules, start: &str, end: &str| {
            let log = rules.narrate(format!("{start},{end},sofa,-,-\n").as_bytes(), &Who::Somebody);
            log.said.first().map(|said| (said.at_s, said.item.text.clone()))
        };
        let at =
            |time: &str, said_s: u32| Some((seconds(time).unwrap(), format!("They sit on the sofa for {said_s} s.")));
        for (start, end, local) in [
            ("2026-11-20T08:30:00Z", "2026-11-20T08:31:00Z", "2026-11-20 09:30:00"),
            ("2026-07-20T08:30:00.0Z", "2026-07-20T08:31:00Z", "2026-07-20 10:30:00"),
            ("2026-11-20T08:30:00+09:00", "2026-11-20T08:31:00+0900", "2026-11-20 00:30:00"),
            ("2026-11-20 08:30:00-05:00", "2026-11-20 08:31:00-05:00", "2026-11-20 14:30:00"),
            ("1784536200", "1784536260", "2026-07-20 10:30:00"),
            // A clock's own, and numbers that count from anywhere.
            ("2026-11-20 08:30:00", "2026-11-20 08:31:00", "2026-11-20 08:30:00"),
            ("17", "77", "1970-01-01 00:00:17"),
            // The clock is set back meanwhile.
            ("2026-10-25T00:59:30Z", "2026-10-25T01:00:30Z", "2026-10-25 02:59:30"),
        ] {
            assert_eq!(starts(&berlin, start, end), at(local, 60), "{start}");
        }
        // One that is not local has no fold.
        assert_eq!(starts(&berlin, "2026-10-25 02:30:00Z", "2026-10-25 02:10:00Z"), None);
        assert_eq!(starts(&rules, "2026-11-20T08:30:00Z", "2026-11-20T08:31:00Z"), at("2026-11-20 08:30:00", 60));
        for wrong in ["2026-11-20T08:30:00ZZ", "2026-11-20T08:30:00+1", "2026-11-20T08:30:00+99:00", "2026-11-20-05:00"]
        {
            assert_eq!(seconds(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn times_are_read_as_the_data_sets_write_them() {
        assert_eq!(seconds("1970-01-01 00:00:00"), Some(0.0));
        assert_eq!(seconds("2024-03-01T00:00:00Z"), Some(1_709_251_200.0));
        assert_eq!(seconds("2024/02/29 23:59:59.5"), Some(1_709_251_199.5));
        assert_eq!(seconds("17.25"), Some(17.25));
        assert_eq!(seconds("2024-02-29 00:00:60.5"), Some(1_709_164_860.5));
        assert_eq!([seconds("0001-01-01 00:00:00"), seconds("-5")], [Some(-62_135_596_800.0), Some(-5.0)]);
        let no_times = ["", "noon", "2024-03-01", "2024-03-01 25:00:00", "inf", "nan", "1709280900000"];
        let no_dates = ["2024-13-01 00:00:00", "2024-02-31 10:00:00", "2023-02-29 10:00:00", "2024-04-31 10:00:00"];
        for wrong in no_times.into_iter().chain(no_dates).chain(["0000-01-01 00:00:00", "2024-00-01 00:00:00"]) {
            assert_eq!(seconds(wrong), None, "{wrong}");
        }
    }

    /// Row "a stray quotation mark in a sensor log" of the attacks.
    #[test]
    fn a_stray_quotation_mark_costs_its_own_line_alone() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let mut lines: Vec<_> = (0..500).map(|n| format!("{n}\t{n}\tdoor{n}\tmagnetic\thall")).collect();
        lines[100] = "100\t\"100\tdoor100\tmagnetic\thall".to_owned();
        let narrated = rules.narrate(lines.join("\r\n").as_bytes(), &Who::Somebody);
        let wrong = narrated.faults.told();
        assert_eq!((narrated.said.len(), wrong.len()), (499, 1));
        assert!(wrong[0].starts_with("line 101:"), "{wrong:?}");
        // A quoted field may hold the separator, as before.
        let quoted = rules.narrate(b"1,2,\"door, left\",magnetic,hall\n", &Who::Somebody);
        assert_eq!(quoted.said[0].item.text, "They open the door, left.");
    }

    /// Row "a sensor log of malformed lines" of the attacks: what is kept of them does not grow with them.
    #[test]
    fn malformed_lines_are_counted_and_the_first_are_told() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let long = "y".repeat(4_000);
        let too_long = "z".repeat(LINE_BYTES_MAX as usize + 1);
        let fields = "8,".repeat(4_000);
        let log = format!(
            "start,end,sensor,kind,place\n{long},1,door,-,-\n{too_long}\n{fields}\n{}1,2,fridge,-,-\n",
            "x\n".repeat(100_000)
        );
        let SensorLog { said, faults, .. } = rules.narrate(log.as_bytes(), &Who::Somebody);
        let said: Vec<_> = said.iter().map(|said| said.item.text.as_str()).collect();
        assert_eq!(said, ["They open the fridge.", "They open the 8."]);
        assert_eq!((faults.count(), faults.told().len()), (100_002, Faults::TOLD));
        let told = faults.told();
        assert!(told[0].starts_with("line 2: \"yyyy") && told[0].contains("yy\"... is no time"), "{}", told[0]);
        assert_eq!(told[1], "line 3: it has more than 8192 bytes");
        assert!(told[2].starts_with("line 5: it has 1 of 5 fields"), "{}", told[2]);
        assert!(told.iter().all(|text| text.len() < 200), "{told:?}");
    }

    /// As a file of its own, whatever the lines before it were: with a mark of the byte order, carriage returns, open quotation marks.
    #[test]
    fn each_line_is_read_as_if_it_were_alone() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let line = [
            "1,2,door,-,-",
            "\u{feff}3,4,door,-,-",
            "5,6,\"door",
            "",
            "7,8,door,-,-\r",
            "\"9\",\"10\",\"a \"\"b\"\"\",-,-",
            "-----",
        ];
        let all = rules.intervals(line.join("\n").as_bytes());
        let alone: Vec<_> = line.iter().flat_map(|line| rules.intervals(format!("\n{line}").as_bytes())).collect();
        assert_eq!(all, alone);
        assert_eq!(all.iter().map(|interval| interval.start_s).collect::<Vec<_>>(), [1.0, 3.0, 7.0, 9.0]);
        assert_eq!(all[3].sensor, "a \"b\"");
    }
}
