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
//! ```
//!
//! Pure: from the texts of log and rules to items with the times between them.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use csv::{ByteRecord, ReaderBuilder, Trim};

use crate::narrator::{InputError, Item, line_item};

/// Largest log that is read, in bytes: it is held in memory.
pub const FILE_BYTES_MAX: u64 = 256 << 20;
/// Rules that a file may have.
const RULES_MAX: usize = 4_096;

/// Bytes of a log that are looked at together; lines are shorter, as a rule.
const LINE_BYTES: usize = 256;

/// Why a log cannot be narrated at all. Single lines that are malformed are [`InputError::Sensor`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SensorError {
    /// A file cannot be read.
    #[error("failed to read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's word.
        source: std::io::Error,
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
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorRules {
    #[serde(default = "default_columns")]
    columns: Vec<Column>,
    #[serde(rename = "rule")]
    rules: Vec<Rule>,
}

fn default_columns() -> Vec<Column> {
    vec![Column::Start, Column::End, Column::Sensor, Column::Kind, Column::Place]
}

#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Rule {
    sensor: Option<String>,
    kind: Option<String>,
    place: Option<String>,
    #[serde(default)]
    at: Edge,
    say: String,
    #[serde(default)]
    person: u32,
    #[serde(default)]
    shortest_s: f64,
    #[serde(default)]
    again_s: f64,
}

/// One line of a log.
#[derive(Debug, Clone, Default, PartialEq)]
struct Interval {
    start_s: f64,
    end_s: f64,
    sensor: String,
    kind: String,
    place: String,
}

/// A log as narration.
#[derive(Debug, Default)]
pub struct SensorLog {
    /// What is said, in the order of time, and the lines that are malformed, before all else.
    pub items: Vec<Result<Item, InputError>>,
    /// Intervals that no rule fits.
    pub unfit: u64,
    /// Sentences left out, because the interval was too short or the same was said shortly before.
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
            std::fs::read_to_string(path).map_err(|source| SensorError::Read { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|reason| SensorError::Rules { path: path.to_owned(), reason })
    }

    /// Reads and checks the text of a rules file.
    ///
    /// # Errors
    ///
    /// What is wrong, with the rule's number.
    pub fn parse(text: &str) -> Result<Self, String> {
        let rules: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        if rules.rules.is_empty() || rules.rules.len() > RULES_MAX {
            return Err(format!("{} rules; give 1 to {RULES_MAX}", rules.rules.len()));
        }
        for wanted in [Column::Start, Column::Sensor] {
            let count = rules.columns.iter().filter(|column| **column == wanted).count();
            if count != 1 {
                return Err(format!("columns names {wanted:?} {count} times; name it once"));
            }
        }
        for (number, rule) in (1..).zip(&rules.rules) {
            let mut said = rule.say.clone();
            for name in ["{sensor}", "{kind}", "{place}", "{seconds}"] {
                said = said.replace(name, "1");
            }
            if said.contains(['{', '}']) {
                return Err(format!("rule {number}: say knows {{sensor}}, {{kind}}, {{place}} and {{seconds}}"));
            }
            // What can be narrated at all is checked here, where the rule can be named.
            line_item(&said, 1, 0).map_err(|error| format!("rule {number}: {error}"))?;
            if !(rule.shortest_s >= 0.0 && rule.again_s >= 0.0) {
                return Err(format!("rule {number}: shortest_s and again_s are 0 or more"));
            }
        }
        Ok(rules)
    }

    /// Reads a log's file.
    ///
    /// # Errors
    ///
    /// [`SensorError::Read`], [`SensorError::TooLarge`].
    pub fn narrate_file(&self, path: &Path) -> Result<SensorLog, SensorError> {
        let read = |source| SensorError::Read { path: path.to_owned(), source };
        if std::fs::metadata(path).map_err(read)?.len() > FILE_BYTES_MAX {
            return Err(SensorError::TooLarge { path: path.to_owned() });
        }
        Ok(self.narrate(&std::fs::read(path).map_err(read)?))
    }

    /// The narration of a log: tab-, semicolon- or comma-separated; heading and underline are passed over.
    #[must_use]
    pub fn narrate(&self, log: &[u8]) -> SensorLog {
        let mut narrated = SensorLog::default();
        // When, which rule, what, by whom.
        let mut said: Vec<(f64, usize, Item)> = Vec::new();
        let delimiter = [b'\t', b';', b','].into_iter().find(|byte| log.contains(byte)).unwrap_or(b'\t');
        let mut builder = ReaderBuilder::new();
        builder.delimiter(delimiter).has_headers(false).flexible(true).trim(Trim::All).buffer_capacity(LINE_BYTES);
        let mut record = ByteRecord::new();
        let mut first = true;
        // Line by line: a stray quotation mark spoils its own line, and does not swallow those behind it.
        for (line, bytes) in (1..).zip(log.split(|byte| *byte == b'\n')) {
            match builder.from_reader(bytes).read_byte_record(&mut record) {
                Ok(false) => continue,
                Ok(true) => {}
                Err(error) => {
                    narrated.items.push(Err(InputError::Sensor { line, reason: error.to_string() }));
                    continue;
                }
            }
            let underline = record.iter().flatten().all(|byte| matches!(byte, b'-' | b' '));
            let heading =
                std::mem::take(&mut first) && record.get(0).is_some_and(|field| seconds(&text(field)).is_none());
            if underline || heading {
                continue;
            }
            match self.interval(&record, delimiter == b'\t') {
                Ok(interval) => self.say(&interval, line, &mut narrated, &mut said),
                Err(reason) => narrated.items.push(Err(InputError::Sensor { line, reason })),
            }
        }
        said.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut before_s = None;
        let mut last: HashMap<(u32, String), f64> = HashMap::new();
        for (at_s, rule, item) in said {
            let again_s = self.rules[rule].again_s;
            let same = last.insert((item.person, item.text.clone()), at_s);
            if same.is_some_and(|same_s| at_s - same_s < again_s) {
                narrated.silent += 1;
                continue;
            }
            let duration_s = before_s.replace(at_s).map_or(0.0, |before_s| at_s - before_s);
            narrated.items.push(Ok(Item { duration_s, ..item }));
        }
        narrated
    }

    fn interval(&self, record: &ByteRecord, tabs: bool) -> Result<Interval, String> {
        // Some of the public files align their columns by several tabs.
        let fields: Vec<String> = record.iter().filter(|field| !(tabs && field.is_empty())).map(text).collect();
        if fields.len() < self.columns.len() {
            return Err(format!("{} fields, {} are expected", fields.len(), self.columns.len()));
        }
        let mut interval = Interval { end_s: f64::NAN, ..Interval::default() };
        for (column, field) in self.columns.iter().zip(fields) {
            let time = || {
                seconds(&field).ok_or_else(|| format!("{field:?} is no time; expected 2024-03-01 08:15:00, or seconds"))
            };
            match column {
                Column::Start => interval.start_s = time()?,
                Column::End => interval.end_s = time()?,
                Column::Sensor => interval.sensor = field,
                Column::Kind => interval.kind = field,
                Column::Place => interval.place = field,
                Column::Other => {}
            }
        }
        if interval.end_s.is_nan() {
            interval.end_s = interval.start_s;
        }
        if interval.end_s < interval.start_s {
            return Err("it ends before it begins".to_owned());
        }
        Ok(interval)
    }

    /// All rules that fit, one per edge: the first for each of start and end.
    fn say(&self, interval: &Interval, line: u64, narrated: &mut SensorLog, said: &mut Vec<(f64, usize, Item)>) {
        let fits =
            |wanted: &Option<String>, own: &str| wanted.as_ref().is_none_or(|wanted| wanted.eq_ignore_ascii_case(own));
        let length_s = interval.end_s - interval.start_s;
        let mut some = false;
        for edge in [Edge::Start, Edge::End] {
            let found = self.rules.iter().enumerate().find(|(_, rule)| {
                rule.at == edge
                    && fits(&rule.sensor, &interval.sensor)
                    && fits(&rule.kind, &interval.kind)
                    && fits(&rule.place, &interval.place)
            });
            let Some((number, rule)) = found else { continue };
            some = true;
            if length_s < rule.shortest_s {
                narrated.silent += 1;
                continue;
            }
            let words = |name: &str| name.replace('_', " ").to_lowercase();
            let text = (rule.say.replace("{sensor}", &words(&interval.sensor)))
                .replace("{kind}", &words(&interval.kind))
                .replace("{place}", &words(&interval.place))
                .replace("{seconds}", &format!("{length_s:.0}"));
            let at_s = if edge == Edge::Start { interval.start_s } else { interval.end_s };
            match line_item(&text, line, rule.person) {
                Ok(item) => said.push((at_s, number, Item { person: rule.person, ..item })),
                Err(error) => narrated.items.push(Err(error)),
            }
        }
        narrated.unfit += u64::from(!some);
    }
}

fn text(field: &[u8]) -> String {
    String::from_utf8_lossy(field).into_owned()
}

/// Seconds of `2024-03-01 08:15:00` (with `T`, `/` and fractions as well) since 1970, without regard to time zones and leap seconds;
/// or of a plain number of seconds.
fn seconds(text: &str) -> Option<f64> {
    if let Ok(seconds) = text.parse::<f64>() {
        return seconds.is_finite().then_some(seconds);
    }
    let (date, time) = text.split_once([' ', 'T'])?;
    let mut parts = date.splitn(3, ['-', '/']).map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (parts.next()??, parts.next()??, parts.next()??);
    let mut parts = time.trim().trim_end_matches('Z').splitn(3, ':');
    let (hour, minute) = (parts.next()?.parse::<u32>().ok()?, parts.next()?.parse::<u32>().ok()?);
    let second: f64 = parts.next().unwrap_or("0").parse().ok()?;
    let plausible = (1..=9999).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
    if !plausible || hour > 23 || minute > 59 || !(0.0..61.0).contains(&second) {
        return None;
    }
    // Days since 1970-01-01 in the proleptic Gregorian calendar, counted from March so that the leap day comes last.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1 - 719_468;
    Some(days as f64 * 86_400.0 + f64::from(hour) * 3_600.0 + f64::from(minute) * 60.0 + second)
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: &str = include_str!("../../tests/data/sensor-rules.toml");
    const LOG: &str = include_str!("../../tests/data/sensors.tsv");

    fn said(log: &SensorLog) -> Vec<(String, f64)> {
        log.items
            .iter()
            .filter_map(|item| item.as_ref().ok())
            .map(|item| (item.text.clone(), item.duration_s))
            .collect()
    }

    #[test]
    fn the_documented_example_is_narrated_in_the_order_of_time() {
        let log = SensorRules::parse(RULES).unwrap().narrate(LOG.as_bytes());
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
        assert_eq!(said(&log)[1].1, 20.0);
        assert_eq!((log.unfit, log.silent), (1, 2));
        assert_eq!(log.items.iter().filter(|item| item.is_err()).count(), 0);
    }

    #[test]
    fn malformed_lines_are_named_and_the_others_are_said() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let log = "start,end,sensor,kind,place\n2024-03-01 08:00:00,2024-03-01 08:00:05,fridge,door,kitchen\nyesterday,,fridge,door,kitchen\n\
                   2024-03-01 08:00:09,2024-03-01 08:00:05,fridge,door,kitchen\n10,20\n30,40,oven,door,kitchen\n50,60,a\u{7}b,door,kitchen\n";
        let narrated = rules.narrate(log.as_bytes());
        let errors: Vec<String> =
            narrated.items.iter().filter_map(|item| item.as_ref().err()).map(|error| error.to_string()).collect();
        assert_eq!(errors.len(), 4, "{errors:?}");
        for (error, part) in errors.iter().zip([
            "line 3: \"yesterday\" is no time",
            "line 4: it ends before",
            "line 5: 2 fields",
            "line 7: ",
        ]) {
            assert!(error.starts_with(part), "{error}");
        }
        assert_eq!(said(&narrated).len(), 2);
    }

    #[test]
    fn columns_can_stand_in_any_order_and_some_can_be_left_out() {
        let rules = "columns = [\"-\", \"sensor\", \"start\"]\n[[rule]]\nsensor = \"Front_Door\"\nperson = 2\nsay = \"They leave by the {sensor}.\"";
        let narrated = SensorRules::parse(rules).unwrap().narrate(b"1;front_door;100\n2;FRONT_DOOR;160.5\n");
        assert_eq!(
            said(&narrated),
            [("They leave by the front door.".to_owned(), 0.0), ("They leave by the front door.".to_owned(), 60.5)]
        );
        assert!(narrated.items.iter().all(|item| item.as_ref().unwrap().person == 2));
    }

    #[test]
    fn malformed_rules_are_named() {
        for (text, part) in [
            ("", "missing field `rule`"),
            ("[[rule]]\nsay = \"They {value}.\"", "rule 1: say knows"),
            ("[[rule]]\nsay = \"\"", "rule 1"),
            ("[[rule]]\nsay = \"They sit.\"\nshortest_s = -1.0", "rule 1: shortest_s"),
            ("columns = [\"sensor\"]\n[[rule]]\nsay = \"They sit.\"", "columns names Start 0 times"),
            ("[[rule]]\nsays = \"They sit.\"", "unknown field"),
        ] {
            let error = SensorRules::parse(text).unwrap_err();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn times_are_read_as_the_data_sets_write_them() {
        assert_eq!(seconds("1970-01-01 00:00:00"), Some(0.0));
        assert_eq!(seconds("2024-03-01T00:00:00Z"), Some(1_709_251_200.0));
        assert_eq!(seconds("2024/02/29 23:59:59.5"), Some(1_709_251_199.5));
        assert_eq!(seconds("17.25"), Some(17.25));
        for wrong in ["", "noon", "2024-13-01 00:00:00", "2024-03-01", "2024-03-01 25:00:00", "inf"] {
            assert_eq!(seconds(wrong), None, "{wrong}");
        }
    }

    /// Row "a stray quotation mark in a sensor log" of the attacks.
    #[test]
    fn a_stray_quotation_mark_costs_its_own_line_alone() {
        let rules = SensorRules::parse("[[rule]]\nsay = \"They open the {sensor}.\"").unwrap();
        let mut lines: Vec<_> = (0..500).map(|n| format!("{n}\t{n}\tdoor{n}\tmagnetic\thall")).collect();
        lines[100] = "100\t\"100\tdoor100\tmagnetic\thall".to_owned();
        let narrated = rules.narrate(lines.join("\r\n").as_bytes());
        let (said, wrong): (Vec<_>, Vec<_>) = narrated.items.iter().partition(|item| item.is_ok());
        assert_eq!((said.len(), wrong.len()), (499, 1));
        assert!(wrong[0].as_ref().unwrap_err().to_string().starts_with("line 101:"), "{wrong:?}");
        // A quoted field may hold the separator, as before.
        let quoted = rules.narrate(b"1,2,\"door, left\",magnetic,hall\n");
        assert_eq!(quoted.items[0].as_ref().unwrap().text, "They open the door, left.");
    }
}
