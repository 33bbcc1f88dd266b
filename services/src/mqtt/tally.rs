//! Counts the matches of each rule of a narrator's rules file, in a database in the state directory, so that `doctor` can name the rules that never
//! matched.
//!
//! A rule's key is its content, not its number: an edited rule begins at zero, the others keep their count.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use roomcast_database::Schema;
use roomcast_ipc::sequence;
use serde::{Deserialize, Serialize};

use crate::clock;
use crate::kept::{self, Kept};

/// The interval of writes; the last one is at the end.
const SAVE_EVERY: Duration = Duration::from_secs(20);
const TABLE: &str = "counted";
const SCHEMA: Schema = Schema {
    application: 0x524d_4354,
    migrations: &["-- The fields of the counts, as JSON.
        CREATE TABLE counted (field TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT;"],
};

/// The counts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counted {
    /// The start of the count, in Unix seconds.
    pub since_unix_s: u64,
    fitted: BTreeMap<String, u64>,
}

impl Counted {
    /// The counts of the narrator of this name, also while it runs; `None` without a readable database.
    #[must_use]
    pub fn of(directory: &Path, narrator: &str) -> Option<Self> {
        kept::read(&path(directory, narrator), TABLE)
    }

    /// The counts of the rules with these keys; `None` for a rule that was not counted.
    #[must_use]
    pub fn fitted(&self, keys: &[String]) -> Vec<Option<u64>> {
        keys.iter().map(|key| self.fitted.get(key).copied()).collect()
    }
}

fn path(directory: &Path, narrator: &str) -> PathBuf {
    directory.join(format!("rules-{:016x}.db", sequence::source_of_name(narrator)))
}

/// Counts, and writes its counts.
#[derive(Debug)]
pub struct Tally {
    kept: Kept,
    keys: Vec<String>,
    /// The counts of earlier narrators.
    before: Counted,
    due: Instant,
}

impl Tally {
    /// Continues the counts of the narrator of this name; `keys` are its rules.
    #[must_use]
    pub fn new(directory: &Path, narrator: &str, keys: Vec<String>) -> Self {
        let new = || Counted { since_unix_s: clock::unix_ns().0 / 1_000_000_000, fitted: BTreeMap::new() };
        let mut kept = Kept::new(path(directory, narrator), SCHEMA);
        let mut before: Counted = kept.load(TABLE).unwrap_or_else(new);
        before.fitted.retain(|key, _| keys.contains(key));
        for key in &keys {
            before.fitted.entry(key.clone()).or_default();
        }
        Self { kept, keys, before, due: Instant::now() }
    }

    /// Writes changed counts of this process when they are due, or at the end.
    pub fn keep(&mut self, fitted: &[u64], at_end: bool) {
        let now = Instant::now();
        if now < self.due && !at_end {
            return;
        }
        self.due = now + SAVE_EVERY;
        let mut counted = self.before.clone();
        for (key, count) in self.keys.iter().zip(fitted) {
            let sum = counted.fitted.entry(key.clone()).or_default();
            *sum = sum.saturating_add(*count);
        }
        self.kept.keep(TABLE, &counted, false, "how often rules fit cannot be kept; check the directory");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(keys: &[&str]) -> Vec<String> {
        keys.iter().map(|key| (*key).to_owned()).collect()
    }

    #[test]
    fn counts_go_on_over_restarts_and_follow_their_rules() {
        let outer = tempfile::tempdir().unwrap();
        // The directory is missing.
        let folder = outer.path().join("state");
        let of = |rules: &[String]| Counted::of(&folder, "home").unwrap().fitted(rules);
        assert_eq!(Counted::of(&folder, "home"), None);
        let first = keys(&["sit", "use"]);
        let mut tally = Tally::new(&folder, "home", first.clone());
        tally.keep(&[0, 2], true);
        assert_eq!(of(&first), [Some(0), Some(2)]);
        tally.due = Instant::now() + SAVE_EVERY;
        tally.keep(&[1, 2], false);
        assert_eq!(of(&first), [Some(0), Some(2)], "not yet");
        tally.keep(&[1, 2], true);
        drop(tally);
        let mut tally = Tally::new(&folder, "home", first.clone());
        tally.keep(&[0, 1], true);
        drop(tally);
        assert_eq!(of(&first), [Some(1), Some(3)]);
        // One rule is edited: it begins again, and the other continues.
        let edited = keys(&["stand", "use"]);
        assert_eq!(of(&edited), [None, Some(3)]);
        Tally::new(&folder, "home", edited.clone()).keep(&[0, 1], true);
        assert_eq!(of(&edited), [Some(0), Some(4)]);
    }
}
