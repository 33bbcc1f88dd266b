//! How often each rule of a narrator's rules file has fitted a message, kept in the state directory, so that `doctor` can name the rules
//! that never did.
//!
//! Rules are known by what they say, not by their number: a rule that is edited begins at zero, the others keep their count.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use roomcast_ipc::sequence;
use serde::{Deserialize, Serialize};

use crate::clock;
use crate::state_file::{self, Kept};

/// A count is written at most so often, and at the end.
const SAVE_EVERY: Duration = Duration::from_secs(20);
/// Most bytes of the file: more than the most rules need.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// What was counted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counted {
    /// Since when, in Unix seconds.
    pub since_unix_s: u64,
    /// How often each rule fitted, by its key.
    fitted: BTreeMap<String, u64>,
}

impl Counted {
    /// What a narrator of this name has counted; none where it has no file, or one that cannot be read.
    #[must_use]
    pub fn of(directory: &Path, narrator: &str) -> Option<Self> {
        let text = state_file::read(&path(directory, narrator), FILE_BYTES_MAX).ok()??;
        serde_json::from_str(&text).ok()
    }

    /// How often each rule of these keys fitted; none for a rule that was not there when it was counted.
    #[must_use]
    pub fn fitted(&self, keys: &[String]) -> Vec<Option<u64>> {
        keys.iter().map(|key| self.fitted.get(key).copied()).collect()
    }
}

fn path(directory: &Path, narrator: &str) -> PathBuf {
    directory.join(format!("rules-{:016x}.json", sequence::source_of_name(narrator)))
}

/// Counts, and writes what it has counted.
#[derive(Debug)]
pub struct Tally {
    file: Kept<Counted>,
    keys: Vec<String>,
    /// What narrators before this one have counted.
    before: Counted,
    due: Instant,
}

impl Tally {
    /// Goes on with what a narrator of this name has counted there; `keys` are those of its rules.
    #[must_use]
    pub fn new(directory: &Path, narrator: &str, keys: Vec<String>) -> Self {
        let new = || Counted { since_unix_s: clock::unix_ns().0 / 1_000_000_000, fitted: BTreeMap::new() };
        let mut before = Counted::of(directory, narrator).unwrap_or_else(new);
        before.fitted.retain(|key, _| keys.contains(key));
        for key in &keys {
            before.fitted.entry(key.clone()).or_default();
        }
        Self { file: Kept::new(path(directory, narrator)), keys, before, due: Instant::now() }
    }

    /// Writes the counts of this process where they have changed and it is time, or the end.
    pub(crate) fn keep(&mut self, fitted: &[u64], at_end: bool) {
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
        // The narrator may be there before the daemon has made the directory.
        let _made = self.file.path().parent().map(state_file::make_folder);
        self.file.keep(counted, "how often rules fit cannot be kept; check the directory");
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
        // A directory that is not there yet.
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
        let mut tally = Tally::new(&folder, "home", first.clone());
        tally.keep(&[0, 1], true);
        assert_eq!(of(&first), [Some(1), Some(3)]);
        // One is edited: it begins again, and the other goes on.
        let edited = keys(&["stand", "use"]);
        assert_eq!(of(&edited), [None, Some(3)]);
        let mut tally = Tally::new(&folder, "home", edited.clone());
        // A folder that cannot be for a moment: the same counts are written when it can.
        std::fs::remove_dir_all(&folder).unwrap();
        std::fs::write(&folder, "in the way").unwrap();
        tally.keep(&[0, 1], true);
        std::fs::remove_file(&folder).unwrap();
        tally.keep(&[0, 1], true);
        assert_eq!(of(&edited), [Some(0), Some(4)]);
        std::fs::write(path(&folder, "home"), "{").unwrap();
        assert_eq!(Counted::of(&folder, "home"), None);
    }
}
