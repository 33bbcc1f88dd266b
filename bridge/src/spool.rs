//! What a hub keeps until every robot has confirmed it: in memory, and in a file that a killed hub goes on with.
//!
//! A line of JSON for each narration, behind one that says the epoch. A line that was cut off by a power loss is dropped; it was not sent
//! before it was on disk. Narrations up to a damaged line in the middle are given up: numbers go on behind it, so that none is given twice.
//! Folder and file are their owner's alone, for narration is private.

use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use roomcast_ipc::{clock, sequence};
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};

use crate::delay::clock_id;
use crate::wire::{Hex, Observation};

/// The file's name in its folder.
const FILE: &str = "narration";
/// The file is written again when it has so many lines of narrations that are gone.
const GONE_MAX: u64 = 4096;
/// Longest line of the file.
const LINE_BYTES_MAX: u64 = 16 << 10;

/// Why there is no spool.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {what}: {source}; is the folder this program's, and the disk not full?")]
pub struct SpoolError {
    path: PathBuf,
    what: &'static str,
    source: io::Error,
}

/// The file's first line.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Head {
    epoch: Hex,
    /// The first number that is kept.
    first: u64,
    /// So many bytes of the input were read.
    input: u64,
}

/// A narration that is kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    /// Its number.
    pub sequence: u64,
    /// The clock of `observed_ns`.
    clock: Hex,
    observed_ns: u64,
    observed_unix_ns: u64,
    /// So many bytes of the input were read with it.
    input: u64,
    /// What was observed.
    #[serde(flatten)]
    pub observation: Observation,
}

/// The spool.
#[derive(Debug)]
pub struct Spool {
    path: PathBuf,
    file: File,
    head: Head,
    clock: Hex,
    kept: VecDeque<Kept>,
    keep: usize,
    /// Lines of the file whose narrations are gone.
    gone: u64,
    /// A write failed, and the file is to end here before the next one.
    cut_at: Option<u64>,
    _lock: File,
}

impl Spool {
    /// Opens the spool in a folder, which is made where it is missing, and goes on with what it has.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] for a folder that cannot be used, or that another hub uses.
    pub fn open(folder: &Path, keep: usize) -> Result<Self, SpoolError> {
        let path = folder.join(FILE);
        let failed = |what| {
            let path = path.clone();
            move |source| SpoolError { path, what, source }
        };
        fs::DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(failed("cannot make its folder"))?;
        let lock = OpenOptions::new()
            .create(true)
            .append(true)
            .mode(0o600)
            .open(folder.join("lock"))
            .map_err(failed("cannot lock"))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive)
            .map_err(|error| failed("another hub uses it")(error.into()))?;
        let (head, kept, given_up) = match File::open(&path) {
            Ok(file) => read(BufReader::new(file)).map_err(failed("cannot read"))?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => (None, VecDeque::new(), 0),
            Err(error) => return Err(failed("cannot read")(error)),
        };
        if given_up > 0 {
            let path = path.display();
            tracing::error!(%path, given_up, "the spool is damaged: what was kept before that is given up; is the disk failing?");
        }
        let head = head.unwrap_or_else(|| Head { epoch: Hex(sequence::random_epoch()), first: 1, input: 0 });
        let file = write(&path, head, &kept).map_err(failed("cannot write"))?;
        let mut spool =
            Self { path, file, head, clock: Hex(clock_id()), kept, keep, gone: 0, cut_at: None, _lock: lock };
        spool.trim();
        Ok(spool)
    }

    /// The narrator's epoch.
    #[must_use]
    pub fn epoch(&self) -> u64 {
        self.head.epoch.0
    }

    /// The first number that is kept.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.head.first
    }

    /// The last number that was given; one less than `first` where nothing is kept.
    #[must_use]
    pub fn last(&self) -> u64 {
        self.head.first + self.kept.len() as u64 - 1
    }

    /// So many bytes of the input are in what was kept.
    #[must_use]
    pub fn input(&self) -> u64 {
        self.kept.back().map_or(self.head.input, |kept| kept.input)
    }

    /// A narration that is kept.
    #[must_use]
    pub fn get(&self, sequence: u64) -> Option<&Kept> {
        let place = sequence.checked_sub(self.head.first)?;
        self.kept.get(usize::try_from(place).ok()?)
    }

    /// How long ago it was observed. After a restart of the machine that is the wall clock's word.
    #[must_use]
    pub fn age_ns(&self, kept: &Kept) -> u64 {
        if kept.clock == self.clock {
            clock::monotonic_ns().saturating_sub(kept.observed_ns)
        } else {
            clock::unix_ns().saturating_sub(kept.observed_unix_ns)
        }
    }

    /// Keeps narrations, each observed so long ago and read up to a place of the input, on disk when this returns.
    ///
    /// # Errors
    ///
    /// [`SpoolError`]; then nothing of them counts as kept.
    pub fn append(&mut self, observed: Vec<(Observation, u64, u64)>) -> Result<(), SpoolError> {
        let (now_ns, now_unix_ns, mut next) = (clock::monotonic_ns(), clock::unix_ns(), self.last() + 1);
        let mut lines = Vec::new();
        let mut fresh = Vec::new();
        for (observation, age_ns, input) in observed {
            let kept = Kept {
                sequence: next,
                clock: self.clock,
                observed_ns: now_ns.saturating_sub(age_ns),
                observed_unix_ns: now_unix_ns.saturating_sub(age_ns),
                input,
                observation,
            };
            serde_json::to_writer(&mut lines, &kept).map_err(|error| self.failed("cannot write", error.into()))?;
            lines.push(b'\n');
            fresh.push(kept);
            next += 1;
        }
        // Half a line would hide what comes after it.
        if let Some(end) = self.cut_at {
            self.file.set_len(end).map_err(|error| self.failed("cannot write", error))?;
            self.cut_at = None;
        }
        let end = self.file.metadata().map_err(|error| self.failed("cannot write", error))?.len();
        if let Err(error) = self.file.write_all(&lines).and_then(|()| self.file.sync_data()) {
            self.cut_at = self.file.set_len(end).is_err().then_some(end);
            return Err(self.failed("cannot write", error));
        }
        self.kept.extend(fresh);
        self.trim();
        Ok(())
    }

    /// Keeps no more than the newest.
    fn trim(&mut self) {
        let over = self.kept.len().saturating_sub(self.keep);
        self.forget(over);
    }

    /// Forgets everything up to a number, itself included.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] when the file cannot be written again; it is then longer than it has to be.
    pub fn confirm(&mut self, sequence: u64) -> Result<(), SpoolError> {
        let over = (sequence.min(self.last()) + 1).saturating_sub(self.head.first);
        self.forget(usize::try_from(over).unwrap_or(usize::MAX));
        if self.gone >= GONE_MAX && self.gone > self.kept.len() as u64 {
            self.file = write(&self.path, self.head, &self.kept).map_err(|error| self.failed("cannot write", error))?;
            (self.gone, self.cut_at) = (0, None);
        }
        Ok(())
    }

    fn forget(&mut self, count: usize) {
        for kept in self.kept.drain(..count.min(self.kept.len())) {
            (self.head.first, self.head.input) = (kept.sequence + 1, kept.input);
            self.gone += 1;
        }
    }

    fn failed(&self, what: &'static str, source: io::Error) -> SpoolError {
        SpoolError { path: self.path.clone(), what, source }
    }
}

/// What a file has, and how many narrations are given up: those before a damaged line that others follow. What follows no good line any more
/// was cut off.
fn read(mut file: impl BufRead) -> io::Result<(Option<Head>, VecDeque<Kept>, u64)> {
    let mut line = Vec::new();
    let mut next = |line: &mut Vec<u8>| -> io::Result<bool> {
        line.clear();
        io::Read::take(&mut file, LINE_BYTES_MAX).read_until(b'\n', line)?;
        Ok(!line.is_empty())
    };
    let (mut kept, mut given_up) = (VecDeque::<Kept>::new(), 0);
    let head = if next(&mut line)? { serde_json::from_slice::<Head>(&line).ok() } else { None };
    let head = head.filter(|head| head.epoch.0 != 0 && (1..u64::MAX / 2).contains(&head.first));
    let Some(mut head) = head else { return Ok((None, kept, given_up)) };
    let mut damaged = 0_u64;
    while next(&mut line)? {
        let expected = head.first.saturating_add(kept.len() as u64);
        match serde_json::from_slice::<Kept>(&line) {
            // Without its end of line it may be half of a longer one.
            Ok(_) if !line.ends_with(b"\n") => damaged += 1,
            // Damage may join two lines: no more numbers than those are gone. Any other number is damage itself.
            Ok(own) if own.sequence < expected || own.sequence - expected > 2 * damaged => damaged += 1,
            Ok(own) => {
                if own.sequence > expected {
                    given_up += own.sequence - head.first;
                    (head.first, head.input) = (own.sequence, own.input);
                    kept.clear();
                }
                kept.push_back(own);
                damaged = 0;
            }
            Err(_) => damaged += 1,
        }
    }
    Ok((Some(head), kept, given_up))
}

/// Replaces the file at once, so that a kill leaves the old one or the new one. Gives it, opened for more.
fn write(path: &Path, head: Head, kept: &VecDeque<Kept>) -> io::Result<File> {
    let unfinished = path.with_extension("unfinished");
    // One that is left of an earlier write may have another mode.
    match fs::remove_file(&unfinished) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut file = BufWriter::new(OpenOptions::new().create_new(true).write(true).mode(0o600).open(&unfinished)?);
    serde_json::to_writer(&mut file, &head)?;
    file.write_all(b"\n")?;
    for own in kept {
        serde_json::to_writer(&mut file, own)?;
        file.write_all(b"\n")?;
    }
    file.into_inner().map_err(io::IntoInnerError::into_error)?.sync_data()?;
    fs::rename(&unfinished, path)?;
    if let Some(folder) = path.parent() {
        File::open(folder)?.sync_all()?;
    }
    OpenOptions::new().append(true).open(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Kind;

    fn observation(text: &str) -> Observation {
        Observation { text: text.to_owned(), kind: Kind::Sentence, person: None }
    }

    fn append(spool: &mut Spool, count: u64) {
        for _ in 0..count {
            let input = spool.input() + 10;
            spool.append(vec![(observation("They sit."), 7, input)]).unwrap();
        }
    }

    #[test]
    fn a_killed_hub_goes_on_where_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!((spool.first(), spool.last(), spool.input()), (1, 0, 0));
        append(&mut spool, 5);
        let epoch = spool.epoch();
        let path = folder.path().join(FILE);
        assert!(Spool::open(folder.path(), 100).unwrap_err().to_string().contains("another hub"));
        let again = || read(BufReader::new(File::open(&path).unwrap())).unwrap();
        assert_eq!((again().0.unwrap().epoch.0, again().1.len()), (epoch, 5));
        spool.confirm(3).unwrap();
        assert_eq!((spool.first(), spool.last(), spool.input()), (4, 5, 50));
        assert!(spool.get(3).is_none() && spool.get(4).unwrap().sequence == 4 && spool.get(6).is_none());
        // A power loss cuts the last line off, or a disk makes nonsense of it.
        for tail in [b"{\"sequence\":6,".as_slice(), b"\xff\n", b"{\"sequence\":9}\n"] {
            let mut file = OpenOptions::new().append(true).open(&path).unwrap();
            file.write_all(tail).unwrap();
            assert_eq!(again().1.len(), 5);
            let end = fs::metadata(&path).unwrap().len();
            file.set_len(end - tail.len() as u64).unwrap();
        }
        drop(spool);
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!((spool.epoch(), spool.first(), spool.last(), spool.input()), (epoch, 1, 5, 50));
        append(&mut spool, 1);
        assert_eq!(again().1.len(), 6);
    }

    #[test]
    fn numbers_go_on_behind_what_is_damaged() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        append(&mut spool, 6);
        let epoch = spool.epoch();
        drop(spool);
        let path = folder.path().join(FILE);
        let whole = fs::read(&path).unwrap();
        let begins: Vec<usize> = (0..whole.len()).filter(|at| *at == 0 || whole[at - 1] == b'\n').collect();
        // The head, narrations 1 to 6. Of the third of them one byte is another.
        for byte in [b'x', b'\n', 0xff] {
            let mut damaged = whole.clone();
            damaged[begins[3] + 4] = byte;
            fs::write(&path, &damaged).unwrap();
            let spool = Spool::open(folder.path(), 100).unwrap();
            assert_eq!((spool.epoch(), spool.first(), spool.last()), (epoch, 4, 6));
        }
        // Of what is damaged at its end, all before that is kept.
        fs::write(&path, &whole[..whole.len() - 3]).unwrap();
        assert_eq!(Spool::open(folder.path(), 100).unwrap().last(), 5);
    }

    #[test]
    fn narration_is_its_owners_alone() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let spool = Spool::open(&folder.path().join("hub"), 100).unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let paths = [folder.path().join("hub"), spool.path.clone(), folder.path().join("hub/lock")];
        assert_eq!(paths.map(|path| mode(&path)), [0o700, 0o600, 0o600]);
    }

    #[test]
    fn what_is_kept_is_bounded_in_memory_and_on_disk() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        append(&mut spool, 130);
        assert_eq!((spool.first(), spool.last()), (31, 130));
        for _ in 0..50 {
            spool.append((0..100).map(|_| (observation("They sit."), 0, 0)).collect()).unwrap();
            spool.confirm(spool.last()).unwrap();
        }
        assert_eq!((spool.first(), spool.last()), (5131, 5130));
        let lines = fs::read_to_string(folder.path().join(FILE)).unwrap().lines().count();
        assert!(lines < 1200, "{lines}");
        spool.confirm(u64::MAX).unwrap();
        append(&mut spool, 1);
        assert_eq!(spool.last(), 5131);
    }
}
