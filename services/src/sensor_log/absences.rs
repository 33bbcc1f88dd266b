//! The times when the home was empty, from a log of absences or presences.

use std::collections::BTreeMap;

use super::{Column, Interval, SensorRules};
use crate::daemon::Zone;

/// The times when the home was empty.
#[derive(Debug, Default, PartialEq)]
pub struct Absences {
    /// Start and end of each.
    pub intervals: Vec<(f64, f64)>,
    /// The labels that count as absence or presence, with their counts; empty if the log has no labels.
    pub labels: BTreeMap<String, usize>,
    /// Intervals with other labels, which are skipped.
    pub others: usize,
}

/// The times when the home was empty, from a log with the columns start, end and label. Without a third column, every interval is an absence. Otherwise
/// the intervals labelled as absences count, or, if there are none, the gaps between the intervals labelled as presences.
///
/// # Errors
/// The number of the line that cannot be read. A sentence if no label means absence or presence.
pub fn absences(log: &[u8]) -> Result<Absences, String> {
    let columns = vec![Column::Start, Column::End];
    let reader = SensorRules { columns: columns.clone(), rules: Vec::new(), zone: Zone::UTC };
    let named = SensorRules { columns: [columns, vec![Column::Sensor]].concat(), rules: Vec::new(), zone: Zone::UTC };
    let (mut all, mut away, mut home) = (Vec::new(), Vec::new(), Vec::new());
    let mut labels: [BTreeMap<String, usize>; 2] = Default::default();
    let mut with_labels = 0;
    for ((line, interval), (_, with_name)) in reader.lines(log).zip(named.lines(log)) {
        let Interval { start_s, end_s, is_open, .. } = interval.map_err(|reason| format!("line {line}: {reason}"))?;
        if is_open {
            return Err(format!("line {line}: its end is missing"));
        }
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

/// Whether a label means absence or presence; `None` for other labels. The whole label counts, because "Putting away dishes" and "Taking
/// out the trash" also contain such words.
pub(super) fn says_away(label: &str) -> Option<bool> {
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
