//! A state database of a test.

use tempfile::TempDir;

use super::*;

/// A state directory and its journal.
#[derive(Debug)]
pub(in crate::daemon) struct Notes {
    pub(in crate::daemon) journal: Journal,
    folder: TempDir,
    /// All records.
    pub(in crate::daemon) records: Vec<Record>,
}

impl Default for Notes {
    fn default() -> Self {
        // A sync takes no time there.
        let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let (journal, _) = Journal::open(folder.path(), u64::MAX, Duration::from_secs(1)).unwrap();
        Self { journal, folder, records: Vec::new() }
    }
}

impl Notes {
    pub(in crate::daemon) fn push(&mut self, record: impl Into<Record>) {
        let record = record.into();
        self.records.push(record.clone());
        self.journal.handle.append(record);
    }

    /// The content for a daemon that starts now.
    pub(in crate::daemon) fn recovered(&self) -> Recovered {
        self.write();
        let recovered = look(self.folder.path()).unwrap();
        assert_eq!(recovered.damaged, 0);
        recovered
    }

    fn write(&self) {
        assert!(
            self.journal.handle.wait_for(self.records.len() as u64, Duration::from_secs(60)),
            "the journal stands still"
        );
    }

    /// All bytes of all files, as text.
    pub(in crate::daemon) fn text(&self) -> String {
        self.write();
        text_of(self.folder.path())
    }
}

/// All bytes of a folder's files, as text.
pub(in crate::daemon) fn text_of(folder: &Path) -> String {
    let files = fs::read_dir(folder).unwrap().map(|file| fs::read(file.unwrap().path()).unwrap());
    files.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).collect()
}
