//! What a hub keeps until every robot has confirmed it: in memory, and in a file that a killed hub goes on with.
//!
//! A line for each narration, and one for what is confirmed now and then: a checksum, and JSON with the epoch. A line that was cut off by a
//! power loss is dropped; it was not sent before it was on disk. Narrations up to a damaged line in the middle are given up: numbers go on
//! behind it, so that none is given twice. Of an end that was lost the robots know how far it went ([`Spool::number_on`]). Where no line is
//! whole, the epoch is a new one, and the input is read from its end: what the robots had already is not said again. Folder and file are their
//! owner's alone, for narration is private.

use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use roomcast_ipc::own_file::require_own;
use roomcast_ipc::{clock, sequence};
use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;
use serde::{Deserialize, Serialize};

use crate::delay::clock_id;
use crate::wire::{Hex, Kind, Observation, Who, is_zero};

/// The file's name in its folder.
const FILE: &str = "narration";
/// The file by which no two hubs use one spool.
const LOCK: &str = "lock";
/// The file is written again when it has so many lines of narrations that are gone.
const GONE_MAX: u64 = 4096;
/// Longest line of the file.
const LINE_BYTES_MAX: u64 = 16 << 10;
/// Digits of a line's checksum.
const DIGITS: usize = 8;
/// What is confirmed goes to the file when it is so many narrations, or so long after the last time.
const NOTE_EACH: u64 = 64;
const NOTE_NS: u64 = 1_000_000_000;

/// Numbers that one start gives up at most because a robot says that it has them.
pub const TAKEN_MAX: u64 = 1024;

/// Why there is no spool.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SpoolError {
    /// Another hub has it.
    #[error("{path}: another hub uses it: end that one, or give this one another hub.spool")]
    InUse {
        /// The folder.
        path: PathBuf,
    },
    /// Another user could have put it there, or may write to it.
    #[error("{path}: {source}")]
    Refused {
        /// The file.
        path: PathBuf,
        /// The reason and the remedy.
        source: io::Error,
    },
    /// The system refuses it.
    #[error("{path}: {what}: {source}; is the folder this program's, and the disk not full?")]
    Failed {
        /// The file.
        path: PathBuf,
        /// What cannot be done.
        what: &'static str,
        /// The system's word.
        source: io::Error,
    },
}

impl SpoolError {
    /// Whether what is called the spool can be none: starting again is of no use then.
    #[must_use]
    pub fn is_of_configuration(&self) -> bool {
        match self {
            Self::InUse { .. } => false,
            Self::Refused { .. } => true,
            Self::Failed { source, .. } => matches!(
                source.kind(),
                io::ErrorKind::NotFound
                    | io::ErrorKind::AlreadyExists
                    | io::ErrorKind::NotADirectory
                    | io::ErrorKind::PermissionDenied
                    | io::ErrorKind::ReadOnlyFilesystem
                    | io::ErrorKind::InvalidInput
            ),
        }
    }
}

/// A place in the input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The file's number in its file system; 0 where the input is no file.
    pub file: u64,
    /// So many bytes of it were read.
    pub at: u64,
    /// A checksum of the bytes before that, which says whether it is still the same file; none in a spool of an earlier version.
    #[serde(default)]
    pub before: Option<u32>,
}

/// The file's first line, and what is confirmed later.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Head {
    epoch: Hex,
    /// The first number that is kept.
    first: u64,
    /// Up to here every robot has confirmed it; what is between that and `first` was given up. 0 in a spool of an earlier version.
    #[serde(default)]
    confirmed: u64,
    /// How far the input was read; none where nobody knows any more.
    input: Option<Place>,
}

/// A line of the file.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Entry {
    Head(Head),
    Kept {
        epoch: Hex,
        #[serde(flatten)]
        kept: Kept,
    },
}

/// What was observed, when, and how far the input was read with it.
#[derive(Debug, Clone, PartialEq)]
pub struct Dated {
    observation: Observation,
    observed_ns: u64,
    observed_unix_ns: u64,
    ahead_ns: u64,
    input: Option<Place>,
}

impl Dated {
    /// Something that was observed so long before now, whenever it is kept; with it the input was read so far, where anybody knows.
    #[must_use]
    pub fn new(observation: Observation, age_ns: u64, input: Option<Place>) -> Self {
        let observed_ns = clock::monotonic_ns().saturating_sub(age_ns);
        let observed_unix_ns = clock::unix_ns().saturating_sub(age_ns);
        Self { observation, observed_ns, observed_unix_ns, ahead_ns: 0, input }
    }

    /// With an input that has a fast clock: its time lay so far ahead.
    #[must_use]
    pub fn with_ahead(self, ahead_ns: u64) -> Self {
        Self { ahead_ns, ..self }
    }
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
    /// How far ahead its time lay.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub ahead_ns: u64,
    /// How far the input was read with it; none where nobody knows.
    input: Option<Place>,
    /// What was observed.
    #[serde(flatten)]
    pub observation: Observation,
}

/// The spool.
#[derive(Debug)]
pub struct Spool {
    path: PathBuf,
    folder: File,
    file: File,
    /// Whether the file's name is on disk, too.
    is_named: bool,
    head: Head,
    clock: Hex,
    kept: VecDeque<Kept>,
    keep: usize,
    /// Lines of the file whose narrations are gone.
    gone: u64,
    /// The first number that is kept, as the file says it, and when that was written.
    noted: (u64, u64),
    /// A write failed, and the file is to end here before the next one.
    cut_at: Option<u64>,
    /// Numbers that this start has given up.
    taken: u64,
    _lock: File,
}

impl Spool {
    /// Opens the spool in a folder, which is made where it is missing, and goes on with what it has. More than `keep` narrations of that stay until
    /// [`Self::trim`], so that who counts what is given up begins before it.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] for a folder that cannot be used, or that another hub uses.
    pub fn open(folder: &Path, keep: usize) -> Result<Self, SpoolError> {
        let path = folder.join(FILE);
        let failed = |what| {
            let path = path.clone();
            move |source| SpoolError::Failed { path, what, source }
        };
        fs::DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(failed("cannot make its folder"))?;
        for file in [FILE, LOCK] {
            let path = folder.join(file);
            require_own(&path).map_err(|source| SpoolError::Refused { path, source })?;
        }
        let mut to_lock = OpenOptions::new();
        to_lock.create(true).append(true).mode(0o600);
        let lock = open_plain(&mut to_lock, &folder.join(LOCK)).map_err(failed("cannot lock"))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|error| match error {
            Errno::WOULDBLOCK => SpoolError::InUse { path: folder.to_owned() },
            _ => failed("cannot lock")(error.into()),
        })?;
        let new = |input| Head { epoch: Hex(sequence::random_epoch()), first: 1, confirmed: 0, input };
        let found = match open_plain(OpenOptions::new().read(true), &path) {
            Ok(file) => Some(read(BufReader::new(file)).map_err(failed("cannot read"))?),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(failed("cannot read")(error)),
        };
        let (head, kept) = match found {
            None => (new(Some(Place::default())), VecDeque::new()),
            Some(Found { head: Some(head), kept, given_up }) => {
                if given_up > 0 {
                    let path = path.display();
                    tracing::error!(%path, given_up, "the spool is damaged: what was kept before that is given up; is the disk failing?");
                }
                (head, kept)
            }
            Some(Found { head: None, .. }) => {
                let path = path.display();
                tracing::error!(
                    %path,
                    "nothing of the spool can be read: what was kept is given up, and a followed input is read from its end; is the disk failing, or was it emptied?"
                );
                (new(None), VecDeque::new())
            }
        };
        let is_folder = OFlags::DIRECTORY.bits().cast_signed();
        let opened = OpenOptions::new().read(true).custom_flags(is_folder).open(folder);
        let folder = opened.map_err(failed("cannot open its folder"))?;
        let file = write(&path, head, &kept).map_err(failed("cannot write"))?;
        let (clock, noted) = (Hex(clock_id()), (head.first, clock::monotonic_ns()));
        let mut spool = Self {
            path,
            folder,
            file,
            is_named: false,
            head,
            clock,
            kept,
            keep,
            gone: 0,
            noted,
            cut_at: None,
            taken: 0,
            _lock: lock,
        };
        spool.name()?;
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

    /// Up to this number every robot has confirmed it, as far as the file knows.
    #[must_use]
    pub fn confirmed(&self) -> u64 {
        self.head.confirmed
    }

    /// How much of the input is in what was kept; none where nobody knows.
    #[must_use]
    pub fn input(&self) -> Option<Place> {
        self.kept.back().map_or(self.head.input, |kept| kept.input)
    }

    /// A narration that is kept.
    #[must_use]
    pub fn get(&self, sequence: u64) -> Option<&Kept> {
        let place = sequence.checked_sub(self.head.first)?;
        self.kept.get(usize::try_from(place).ok()?)
    }

    /// How long ago it was observed. Of before this start of the machine that is the wall clock's word: no monotonic time is before it, and 0 is none.
    #[must_use]
    pub fn age_ns(&self, kept: &Kept) -> u64 {
        if kept.clock == self.clock && kept.observed_ns > 0 {
            clock::monotonic_ns().saturating_sub(kept.observed_ns)
        } else {
            clock::unix_ns().saturating_sub(kept.observed_unix_ns)
        }
    }

    /// Numbers that are gone, where a robot says that the next one is `next`: the disk has lost what was given them, and what comes now must not be
    /// taken for it. Their places hold nothing, which a robot that never had them passes over. Gives how many, and none where so many cannot be
    /// gone.
    ///
    /// # Errors
    ///
    /// [`SpoolError`]; then the numbers are still to be given.
    pub fn number_on(&mut self, next: u64) -> Result<Option<u64>, SpoolError> {
        let count = next.saturating_sub(self.last() + 1);
        if count > TAKEN_MAX - self.taken {
            return Ok(None);
        }
        if count > 0 {
            let nothing = Observation { text: String::new(), kind: Kind::Sentence, person: Who::Somebody, count: 0 };
            let nothing = Dated::new(nothing, 0, self.input());
            self.append((0..count).map(|_| nothing.clone()).collect())?;
            self.taken += count;
        }
        Ok(Some(count))
    }

    /// Keeps narrations, on disk when this returns.
    ///
    /// # Errors
    ///
    /// [`SpoolError`]; then nothing of them counts as kept.
    pub fn append(&mut self, dated: Vec<Dated>) -> Result<(), SpoolError> {
        let mut lines = Vec::new();
        let mut fresh = Vec::new();
        for (sequence, dated) in (self.last() + 1..).zip(dated) {
            let Dated { observation, observed_ns, observed_unix_ns, ahead_ns, input } = dated;
            let kept =
                Kept { sequence, clock: self.clock, observed_ns, observed_unix_ns, ahead_ns, input, observation };
            let entry = Entry::Kept { epoch: self.head.epoch, kept: kept.clone() };
            lines.extend(line(&entry).map_err(|error| self.failed("cannot write", error))?);
            fresh.push(kept);
        }
        self.name()?;
        self.write_lines(&lines, true)?;
        self.kept.extend(fresh);
        self.trim();
        Ok(())
    }

    /// The file's name is on disk when this returns: until then a power loss brings the file back that it has replaced.
    fn name(&mut self) -> Result<(), SpoolError> {
        if !self.is_named {
            self.folder.sync_all().map_err(|error| self.failed("cannot write its folder", error))?;
            self.is_named = true;
        }
        Ok(())
    }

    fn write_lines(&mut self, lines: &[u8], sync: bool) -> Result<(), SpoolError> {
        // Half a line would hide what comes after it.
        if let Some(end) = self.cut_at {
            self.file.set_len(end).map_err(|error| self.failed("cannot write", error))?;
            self.cut_at = None;
        }
        let end = self.file.metadata().map_err(|error| self.failed("cannot write", error))?.len();
        let written = self.file.write_all(lines).and_then(|()| if sync { self.file.sync_data() } else { Ok(()) });
        if let Err(error) = written {
            self.cut_at = self.file.set_len(end).is_err().then_some(end);
            return Err(self.failed("cannot write", error));
        }
        Ok(())
    }

    /// Keeps no more than the newest.
    pub fn trim(&mut self) {
        let over = self.kept.len().saturating_sub(self.keep);
        self.forget(over);
    }

    /// Forgets everything up to a number, itself included: every robot has confirmed it.
    ///
    /// # Errors
    ///
    /// [`SpoolError`] when the file cannot be written again; it is then longer than it has to be.
    pub fn confirm(&mut self, sequence: u64) -> Result<(), SpoolError> {
        let over = (sequence.min(self.last()) + 1).saturating_sub(self.head.first);
        if over > 0 {
            self.forget(usize::try_from(over).unwrap_or(usize::MAX));
            self.head.confirmed = self.head.first - 1;
        }
        if self.gone >= GONE_MAX && self.gone > self.kept.len() as u64 {
            // Where it fails it is tried again when as many more are gone.
            self.gone = 0;
            self.file = write(&self.path, self.head, &self.kept).map_err(|error| self.failed("cannot write", error))?;
            (self.cut_at, self.is_named) = (None, false);
            self.noted = (self.head.first, clock::monotonic_ns());
        }
        self.note()
    }

    /// Writes down now and then what is gone, so that a hub that is killed does not say all of it again. What is not on disk is said again
    /// and taken once.
    fn note(&mut self) -> Result<(), SpoolError> {
        let (now_ns, (first, at_ns)) = (clock::monotonic_ns(), self.noted);
        let new = self.head.first.saturating_sub(first);
        if new >= NOTE_EACH || (new > 0 && now_ns.saturating_sub(at_ns) >= NOTE_NS) {
            let note = line(&Entry::Head(self.head)).map_err(|error| self.failed("cannot write", error))?;
            self.write_lines(&note, false)?;
            (self.noted, self.gone) = ((self.head.first, now_ns), self.gone + 1);
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
        SpoolError::Failed { path: self.path.clone(), what, source }
    }
}

/// A line of the file: its checksum, and itself.
fn line(entry: &Entry) -> io::Result<Vec<u8>> {
    let json = serde_json::to_vec(entry)?;
    let mut line = format!("{:0DIGITS$x} ", crc32fast::hash(&json)).into_bytes();
    line.extend(json);
    line.push(b'\n');
    Ok(line)
}

/// What a line says, where it is whole.
fn entry(line: &[u8]) -> Option<Entry> {
    let (digits, json) = line.strip_suffix(b"\n")?.split_at_checked(DIGITS)?;
    let checksum = u32::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
    let json = json.strip_prefix(b" ")?;
    (crc32fast::hash(json) == checksum).then(|| serde_json::from_slice(json).ok())?
}

/// What a file has.
#[derive(Debug)]
struct Found {
    /// None where nothing of it is whole.
    head: Option<Head>,
    kept: VecDeque<Kept>,
    /// Narrations that others follow, and that are gone with a damaged line.
    given_up: u64,
}

/// What follows no good line any more was cut off.
fn read(mut file: impl BufRead) -> io::Result<Found> {
    let mut line = Vec::new();
    let mut found = Found { head: None, kept: VecDeque::new(), given_up: 0 };
    loop {
        line.clear();
        if io::Read::take(&mut file, LINE_BYTES_MAX).read_until(b'\n', &mut line)? == 0 {
            return Ok(found);
        }
        let Some(entry) = entry(&line) else { continue };
        let (epoch, first) = match &entry {
            Entry::Head(head) => (head.epoch, head.first),
            Entry::Kept { epoch, kept } => (*epoch, kept.sequence),
        };
        // Lines of another spool are none of this one's, whole as they are.
        let known = found.head.map(|head| head.epoch);
        if epoch.0 == 0 || !(1..u64::MAX / 2).contains(&first) || known.is_some_and(|known| known != epoch) {
            continue;
        }
        let head = found.head.get_or_insert(Head { epoch, first, confirmed: 0, input: None });
        let next = head.first + found.kept.len() as u64;
        match entry {
            Entry::Head(own) if own.first >= head.first => {
                while found.kept.front().is_some_and(|kept| kept.sequence < own.first) {
                    found.kept.pop_front();
                }
                *head = own;
            }
            Entry::Kept { kept, .. } if kept.sequence >= next => {
                if kept.sequence > next {
                    found.given_up += kept.sequence - head.first;
                    found.kept.clear();
                    head.first = kept.sequence;
                }
                head.input = head.input.or(kept.input);
                found.kept.push_back(kept);
            }
            _ => {}
        }
    }
}

/// Opens a plain file. Opening a FIFO would wait for its other end, deaf to signals.
pub(crate) fn open_plain(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    // A FIFO that nobody reads is refused by the system, since this does not wait for one.
    let file = options.custom_flags(OFlags::NONBLOCK.bits().cast_signed()).open(path);
    let is_other = match &file {
        Ok(file) => !file.metadata()?.is_file(),
        Err(_) => fs::metadata(path).is_ok_and(|about| !about.is_file()),
    };
    if is_other {
        let fault = format!("{} is no plain file: remove it", path.display());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, fault));
    }
    file
}

/// Replaces the file at once, so that a kill leaves the old one or the new one. Gives it, opened for more: what is written then is in the
/// file of that name, whatever fails afterwards.
fn write(path: &Path, head: Head, kept: &VecDeque<Kept>) -> io::Result<File> {
    let unfinished = path.with_extension("unfinished");
    // One that is left of an earlier write may have another mode.
    match fs::remove_file(&unfinished) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let mut file = BufWriter::new(OpenOptions::new().create_new(true).append(true).mode(0o600).open(&unfinished)?);
    file.write_all(&line(&Entry::Head(head))?)?;
    for own in kept {
        file.write_all(&line(&Entry::Kept { epoch: head.epoch, kept: own.clone() })?)?;
    }
    let file = file.into_inner().map_err(io::IntoInnerError::into_error)?;
    file.sync_data()?;
    fs::rename(&unfinished, path)?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn observation(text: &str) -> Observation {
        Observation { text: text.to_owned(), kind: Kind::Sentence, person: Who::Somebody, count: 0 }
    }

    fn append(spool: &mut Spool, count: u64) {
        for _ in 0..count {
            let mut input = spool.input().unwrap_or_default();
            input.at += 10;
            spool.append(vec![Dated::new(observation("They sit."), 7, Some(input))]).unwrap();
        }
    }

    /// Opening a FIFO waits for its other end: the hub hung at its start, deaf to signals.
    #[test]
    fn what_is_no_plain_file_is_refused_at_once() {
        for name in [FILE, LOCK] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join(name);
            for make in [
                |path: &Path| {
                    rustix::fs::mkfifoat(rustix::fs::CWD, path, rustix::fs::Mode::from_raw_mode(0o600)).unwrap()
                },
                |path: &Path| fs::create_dir(path).unwrap(),
                |path: &Path| std::os::unix::fs::symlink("/dev/zero", path).unwrap(),
            ] {
                make(&path);
                let error = Spool::open(folder.path(), 10).unwrap_err().to_string();
                assert!(error.contains(&format!("/{name}: it is ")), "{error}");
                assert!(
                    error.contains("no plain file: remove it") || error.contains("a symbolic link: remove it"),
                    "{error}"
                );
                fs::remove_file(&path).or_else(|_| fs::remove_dir(&path)).unwrap();
            }
            Spool::open(folder.path(), 10).unwrap();
        }
    }

    #[test]
    fn a_killed_hub_goes_on_where_it_was() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!((spool.first(), spool.last(), spool.input().unwrap().at), (1, 0, 0));
        append(&mut spool, 5);
        let epoch = spool.epoch();
        let path = folder.path().join(FILE);
        let in_use = Spool::open(folder.path(), 100).unwrap_err();
        assert!(in_use.to_string().contains("another hub") && !in_use.to_string().contains("disk"), "{in_use}");
        assert!(!in_use.is_of_configuration(), "the other one may end");
        let again = || read(BufReader::new(File::open(&path).unwrap())).unwrap();
        assert_eq!((again().head.unwrap().epoch.0, again().kept.len()), (epoch, 5));
        spool.confirm(3).unwrap();
        assert_eq!((spool.first(), spool.last(), spool.input().unwrap().at), (4, 5, 50));
        assert!(spool.get(3).is_none() && spool.get(4).unwrap().sequence == 4 && spool.get(6).is_none());
        // A power loss cuts the last line off, or a disk makes nonsense of it.
        for tail in [b"{\"sequence\":6,".as_slice(), b"\xff\n", b"{\"sequence\":9}\n"] {
            let mut file = OpenOptions::new().append(true).open(&path).unwrap();
            file.write_all(tail).unwrap();
            assert_eq!(again().kept.len(), 5);
            let end = fs::metadata(&path).unwrap().len();
            file.set_len(end - tail.len() as u64).unwrap();
        }
        drop(spool);
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!((spool.epoch(), spool.first(), spool.last(), spool.input().unwrap().at), (epoch, 1, 5, 50));
        append(&mut spool, 1);
        assert_eq!(again().kept.len(), 6);
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
        // The head may be damaged, and where everything is, nothing is said again.
        for (end, first) in [(20, 1), (begins[3] + 5, 4), (begins[6] + 5, 1)] {
            let mut damaged = whole.clone();
            damaged[..end].fill(b'x');
            fs::write(&path, &damaged).unwrap();
            let spool = Spool::open(folder.path(), 100).unwrap();
            let has = (spool.epoch() == epoch, spool.first(), spool.input().map(|place| place.at));
            let is_known = end < begins[6];
            assert_eq!(has, (is_known, first, is_known.then_some(60)));
        }
        // A number or a letter that is another one is damage, too.
        let text = String::from_utf8(whole.clone()).unwrap();
        for (from, to) in [("\"at\":60", "\"at\":96"), ("\"first\":1", "\"first\":9")] {
            fs::write(&path, text.replacen(from, to, 1)).unwrap();
            let spool = Spool::open(folder.path(), 100).unwrap();
            let last = if from.starts_with("\"at") { 5 } else { 6 };
            assert_eq!((spool.epoch(), spool.first(), spool.last()), (epoch, 1, last), "{from}");
        }
        // Of what is damaged at its end, all before that is kept.
        fs::write(&path, &whole[..whole.len() - 3]).unwrap();
        assert_eq!(Spool::open(folder.path(), 100).unwrap().last(), 5);
    }

    /// Where the disk is full it may wait for hours.
    #[test]
    fn what_waits_for_the_disk_is_of_when_it_was_observed() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        let dated = Dated::new(observation("They sit."), 7, None);
        std::thread::sleep(std::time::Duration::from_millis(5));
        spool.append(vec![dated]).unwrap();
        assert!(spool.age_ns(spool.get(1).unwrap()) >= 5_000_007);
    }

    #[test]
    fn numbers_that_a_robot_has_are_not_given_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100_000).unwrap();
        append(&mut spool, 5);
        assert_eq!(spool.number_on(4).unwrap(), Some(0));
        // The disk has lost 6 to 9.
        assert_eq!(spool.number_on(10).unwrap(), Some(4));
        append(&mut spool, 1);
        let nothing = spool.get(9).unwrap().observation.clone();
        assert_eq!((spool.last(), spool.input().unwrap().at), (10, 60));
        nothing.message().unwrap_err();
        spool.get(10).unwrap().observation.message().unwrap();
        // A robot that says anything does not fill the spool, however often.
        assert_eq!(spool.number_on(u64::MAX).unwrap(), None);
        assert_eq!(spool.number_on(11 + TAKEN_MAX - 4).unwrap(), Some(TAKEN_MAX - 4));
        assert_eq!(spool.number_on(spool.last() + 2).unwrap(), None);
        let last = spool.last();
        drop(spool);
        assert_eq!(Spool::open(folder.path(), 100_000).unwrap().last(), last);
    }

    /// What a hub reads behind a power cut was of the machine's start, however old it was.
    #[test]
    fn what_was_observed_before_the_machines_start_has_its_age() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        let hour_ns = 3_600_000_000_000;
        let ages = [0, 60_000_000_000, clock::monotonic_ns() + hour_ns, clock::monotonic_ns() + 72 * hour_ns];
        spool.append(ages.map(|age_ns| Dated::new(observation("They sit."), age_ns, None)).into()).unwrap();
        for (number, age_ns) in (1..).zip(ages) {
            let since_ns = spool.age_ns(spool.get(number).unwrap()).saturating_sub(age_ns);
            assert!(since_ns < 60_000_000_000, "{age_ns}: {since_ns}");
        }
    }

    /// A followed file was read from its start at the start after, and all of it said again.
    #[test]
    fn a_place_that_nobody_knows_stays_unknown() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FILE), "nonsense\n").unwrap();
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!(spool.number_on(4).unwrap(), Some(3));
        assert_eq!(spool.input(), None);
        drop(spool);
        let mut spool = Spool::open(folder.path(), 100).unwrap();
        assert_eq!((spool.last(), spool.input()), (3, None));
        spool.confirm(3).unwrap();
        assert_eq!(spool.input(), None);
    }

    /// A spool of before has no checksum.
    #[test]
    fn places_of_an_earlier_version_are_read() {
        let place: Place = serde_json::from_str(r#"{"file":3,"at":5}"#).unwrap();
        assert_eq!(place, Place { file: 3, at: 5, before: None });
    }

    /// The spool went on in a file without a name, which a kill takes along.
    #[test]
    fn what_is_kept_is_in_the_file_of_the_spool_though_its_folder_fails() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 100_000).unwrap();
        append(&mut spool, 10);
        spool.gone = GONE_MAX;
        // A pipe cannot be synced, as a folder on a failing disk.
        let whole = std::mem::replace(&mut spool.folder, rustix::pipe::pipe().unwrap().0.into());
        spool.confirm(1).unwrap();
        spool.append(vec![Dated::new(observation("They sit."), 0, None)]).unwrap_err();
        assert_eq!(spool.last(), 10, "what is not on disk is not kept");
        spool.folder = whole;
        append(&mut spool, 1);
        let found = read(BufReader::new(File::open(folder.path().join(FILE)).unwrap())).unwrap();
        assert_eq!((found.head.unwrap().first, found.kept.len()), (2, 10));
        // One that cannot be written again is not tried at each turn.
        fs::create_dir(spool.path.with_extension("unfinished")).unwrap();
        spool.gone = GONE_MAX;
        spool.confirm(2).unwrap_err();
        spool.confirm(3).unwrap();
    }

    #[test]
    fn what_is_confirmed_is_not_kept_over_a_kill() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = Spool::open(folder.path(), 1000).unwrap();
        append(&mut spool, 200);
        spool.confirm(150).unwrap();
        spool.confirm(160).unwrap();
        drop(spool);
        let spool = Spool::open(folder.path(), 1000).unwrap();
        assert_eq!((spool.first(), spool.last(), spool.input().unwrap().at), (151, 200, 2000));
    }

    /// What was given up before a start was confirmed after it.
    #[test]
    fn what_is_given_up_is_confirmed_after_no_start() {
        let folder = tempfile::tempdir().unwrap();
        let open = |keep| {
            let spool = Spool::open(folder.path(), keep).unwrap();
            (spool.first(), spool.last(), spool.confirmed(), spool)
        };
        let (.., mut spool) = open(1000);
        append(&mut spool, 300);
        spool.confirm(64).unwrap();
        drop(spool);
        let (first, last, confirmed, mut spool) = open(100);
        assert_eq!((first, last, confirmed), (65, 300, 64), "who counts what goes begins here");
        spool.trim();
        assert_eq!((spool.first(), spool.confirmed()), (201, 64));
        append(&mut spool, 1);
        drop(spool);
        let (.., confirmed, mut spool) = open(1000);
        assert_eq!(confirmed, 64);
        spool.trim();
        spool.confirm(290).unwrap();
        assert_eq!((spool.first(), spool.confirmed()), (291, 290));
    }

    /// A unit starts again what ends with another code than 2, without end.
    #[test]
    fn a_spool_that_can_be_none_is_of_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        for path in [&file, &file.join("spool"), Path::new("/proc/spool")] {
            let error = Spool::open(path, 100).unwrap_err();
            assert!(error.is_of_configuration(), "{error}");
        }
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
            let dated = || Dated::new(observation("They sit."), 0, None);
            spool.append((0..100).map(|_| dated()).collect()).unwrap();
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
