//! A state database of a test.

use std::fs;

use tempfile::TempDir;

use super::*;

/// A state directory and the writer of its database.
#[derive(Debug)]
pub(in crate::daemon) struct Notes {
    folder: TempDir,
    writer: Option<Writer>,
    /// All records.
    pub(in crate::daemon) records: Vec<Record>,
    unwritten: Vec<Record>,
}

impl Default for Notes {
    fn default() -> Self {
        // A sync takes no time there.
        let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
        let mut notes = Self { folder, writer: None, records: Vec::new(), unwritten: Vec::new() };
        notes.open();
        notes
    }
}

impl Notes {
    fn open(&mut self) {
        let opened = Database::open(&self.folder.path().join(FILE), SCHEMA).unwrap();
        self.writer = Some(Writer::open(opened, None, u64::MAX, &boot_id()).unwrap().0);
    }

    pub(in crate::daemon) fn push(&mut self, record: impl Into<Record>) {
        let record = record.into();
        self.records.push(record.clone());
        self.unwritten.push(record);
    }

    pub(in crate::daemon) fn observe(&mut self, observation: &Observation) {
        self.push(Record::Event { observation: observation.clone(), is_of_this_boot: true });
    }

    /// The content for a daemon that starts now.
    pub(in crate::daemon) fn recovered(&mut self) -> Recovered {
        self.write();
        let recovered = self.writer.as_mut().unwrap().recover().unwrap();
        assert_eq!(recovered.damaged, 0);
        recovered
    }

    fn write(&mut self) {
        self.writer.as_mut().unwrap().write(self.unwritten.drain(..)).unwrap();
    }

    /// All bytes of all files, as text.
    pub(in crate::daemon) fn text(&mut self) -> String {
        self.write();
        text_of(self.folder.path())
    }

    /// Does something with a journal that has this database.
    pub(in crate::daemon) fn with<T>(&mut self, work: impl FnOnce(&JournalHandle) -> T) -> T {
        self.write();
        self.writer = None;
        let directory = self.folder.path().to_owned();
        let (journal, _) = Journal::open(&JournalOptions { directory, bytes_max: 16 << 20, sync_ms: 1000 }).unwrap();
        let done = work(&journal.handle());
        drop(journal);
        self.open();
        done
    }
}

/// All bytes of a folder's files, as text.
pub(in crate::daemon) fn text_of(folder: &std::path::Path) -> String {
    let files = fs::read_dir(folder).unwrap().map(|file| fs::read(file.unwrap().path()).unwrap());
    files.map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).collect()
}
