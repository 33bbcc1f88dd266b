//! What was learned of the home, on disk: one file in the state directory, mode 0600, replaced whole or not at all, by a thread of its own.
//!
//! | bytes | what |
//! | --- | --- |
//! | 8 | `RCHOME1` and a line feed |
//! | 4 | CRC-32 of all that follows |
//! | 8 | until when time spent was counted, in seconds since 1970, local time |
//! | 4, then 24 each | names of observations that were learned: source, epoch, sequence |
//! | the rest | counts of names and hours, as [`roomcast_core::habits`] writes them, with a version and a checksum of their own |
//!
//! Integers are little endian. A file that cannot be used is set aside under [`ASIDE`], and the log says what is lost.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Instant;

use crossbeam::channel::{Receiver, Sender, bounded};
use roomcast_core::habits::{BYTES_MAX, Habits, HabitsOptions};
use roomcast_core::ids::EventId;

use super::habits::{Heard, Memory};
use crate::state_file;

/// The file in the state directory.
const FILE: &str = "habits";
/// A file that could not be used.
const ASIDE: &str = "habits.damaged";
const MAGIC: &[u8; 8] = b"RCHOME1\n";
/// Most names that are read.
const NAMES_MAX: u32 = 4_096;

/// The place of the file.
#[derive(Debug, Clone)]
pub struct HabitsFile {
    directory: PathBuf,
    /// It is there and cannot be read or set aside: what may be in it must not be lost.
    unusable: bool,
}

impl HabitsFile {
    /// Reads what was learned. Without a file nothing was; with one that cannot be used, as well, and the log says why.
    #[must_use]
    pub fn load(directory: &Path, options: HabitsOptions) -> (Self, Memory) {
        let path = directory.join(FILE);
        let mut unusable = false;
        // A directory that cannot be written is told of where something is to be written.
        let _removed = state_file::remove_unfinished(&path);
        let read = match state_file::read_bytes(&path, BYTES_MAX as u64 + 24 * u64::from(NAMES_MAX) + 24) {
            Ok(bytes) => Ok(bytes.map(|bytes| decode_memory(&bytes, options))),
            Err(error) if error.kind() == io::ErrorKind::FileTooLarge => Ok(Some(Err(error.to_string()))),
            Err(error) => Err(error),
        };
        let memory = match read {
            Ok(None) => None,
            Ok(Some(Ok(memory))) => {
                if memory.habits.is_converted() {
                    tracing::info!(path = %path.display(), "the habits file is of an earlier version: its counts are kept, and which forecasts were right is learned again");
                }
                Some(memory)
            }
            Ok(Some(Err(reason))) => {
                let aside = fs::rename(&path, directory.join(ASIDE));
                unusable = aside.is_err();
                let fate = match aside {
                    Ok(()) => format!("it is set aside as {ASIDE}"),
                    Err(error) => {
                        format!(
                            "it cannot be set aside as {ASIDE} ({error}), so nothing is written until somebody removes both"
                        )
                    }
                };
                tracing::warn!(
                    reason,
                    path = %path.display(),
                    "the habits file cannot be used: what was learned of the home is lost, but for what the journal holds; {fate}"
                );
                None
            }
            Err(error) => {
                unusable = true;
                tracing::warn!(%error, path = %path.display(), "the habits file cannot be read: the daemon begins without what was learned, and does not write the file");
                None
            }
        };
        let directory = directory.to_owned();
        (Self { directory, unusable }, memory.unwrap_or_else(|| Memory::new(options)))
    }

    /// Puts what was learned in place of what the file holds.
    ///
    /// # Errors
    /// When the state directory cannot be written, or the file was not readable at the start.
    pub fn write(&self, memory: &Memory) -> io::Result<()> {
        if self.unusable {
            return Err(io::Error::other(
                "the habits file could not be used at the start; repair or remove it, and start the daemon again",
            ));
        }
        // Others may not read it: its mode is 0600.
        state_file::replace_for_good(&self.directory.join(FILE), &encode_memory(memory))
    }

    /// Removes a file that was set aside: what it holds of somebody cannot be taken out of it.
    ///
    /// # Errors
    /// When the state directory cannot be written.
    pub(crate) fn remove_aside(&self) -> io::Result<()> {
        let aside = self.directory.join(ASIDE);
        match fs::remove_file(&aside) {
            Ok(()) => state_file::sync_folder(&aside),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            Err(error) => Err(error),
        }
    }
}

/// What the file holds.
#[must_use]
pub fn encode_memory(memory: &Memory) -> Vec<u8> {
    let names = memory.heard.names();
    let mut body = memory.watched_until_s.to_le_bytes().to_vec();
    body.extend_from_slice(&(names.len() as u32).to_le_bytes());
    for EventId { source, epoch, sequence } in names {
        [source, epoch, sequence].into_iter().for_each(|number| body.extend_from_slice(&number.to_le_bytes()));
    }
    body.extend_from_slice(&memory.habits.to_bytes());
    let mut bytes = MAGIC.to_vec();
    bytes.extend_from_slice(&crc32fast::hash(&body).to_le_bytes());
    bytes.append(&mut body);
    bytes
}

/// Reads and checks what [`encode_memory`] made.
///
/// # Errors
/// When the bytes are damaged, of another version, or say something impossible: why.
pub fn decode_memory(bytes: &[u8], options: HabitsOptions) -> Result<Memory, String> {
    fn take<'a, const N: usize>(rest: &mut &'a [u8]) -> Result<&'a [u8; N], String> {
        let (taken, after) = rest.split_first_chunk().ok_or("it ends early")?;
        *rest = after;
        Ok(taken)
    }
    let mut rest = bytes;
    if take::<8>(&mut rest)? != MAGIC {
        return Err("it does not begin as one of this version".to_owned());
    }
    if u32::from_le_bytes(*take(&mut rest)?) != crc32fast::hash(rest) {
        return Err("its checksum is wrong".to_owned());
    }
    let watched_until_s = f64::from_le_bytes(*take(&mut rest)?);
    let count = u32::from_le_bytes(*take(&mut rest)?);
    if count > NAMES_MAX || watched_until_s.is_nan() {
        return Err("it says something impossible".to_owned());
    }
    let mut names = Vec::new();
    for _ in 0..count {
        let mut number = || Ok::<_, String>(u64::from_le_bytes(*take(&mut rest)?));
        names.push(EventId::new(number()?, number()?, number()?));
    }
    let habits = Habits::from_bytes(options, rest).map_err(|error| error.to_string())?;
    Ok(Memory { habits, heard: Heard::new(names), watched_until_s })
}

/// What the keeper is to do.
enum Work {
    Write(Box<Memory>),
    /// The same after somebody was forgotten: nothing of them is to be left. Says whether that went well.
    Forget(Box<Memory>, Sender<io::Result<()>>),
}

/// Writes the file beside the scoring, whose thread waits for the disk only where somebody is forgotten, and at the end.
#[derive(Debug)]
pub(super) struct Keeper {
    /// What was to be written last is not.
    failed: Arc<AtomicBool>,
    work: Option<Sender<Work>>,
    thread: Option<JoinHandle<()>>,
}

impl Keeper {
    /// Starts the thread.
    pub(super) fn start(file: HabitsFile) -> io::Result<Self> {
        let (work, queue) = bounded(1);
        let failed = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&failed);
        let thread = std::thread::Builder::new().name("habits".to_owned()).spawn(move || run(&file, &queue, &told))?;
        Ok(Self { failed, work: Some(work), thread: Some(thread) })
    }

    /// Whether what was handed over last could not be written: it is to be handed over again. Says it once.
    pub(super) fn has_failed(&self) -> bool {
        self.failed.swap(false, Ordering::Relaxed)
    }

    /// Hands over what is to be written, unless the last one waits still.
    pub(super) fn write(&self, memory: Memory) -> bool {
        self.work.as_ref().is_some_and(|work| work.try_send(Work::Write(Box::new(memory))).is_ok())
    }

    /// Hands over the last one, and waits until all is written.
    pub(super) fn finish(&mut self, memory: Option<Memory>) {
        if let (Some(work), Some(memory)) = (&self.work, memory) {
            // It fails only when the thread is gone, which has said so.
            let _handed = work.send(Work::Write(Box::new(memory)));
        }
        drop(self.work.take());
        if let Some(thread) = self.thread.take() {
            let _ended = thread.join();
        }
    }

    /// Writes what is left after somebody was forgotten, `until` then at the latest.
    pub(super) fn forget(&self, memory: Memory, until: Instant) -> io::Result<()> {
        let (done, answer) = bounded(1);
        let sent = self.work.as_ref().map(|work| work.send_deadline(Work::Forget(Box::new(memory), done), until));
        match sent.map(|sent| sent.map(|()| answer.recv_deadline(until))) {
            Some(Ok(Ok(result))) => result,
            _ => Err(io::Error::from(io::ErrorKind::TimedOut)),
        }
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        self.finish(None);
    }
}

fn run(file: &HabitsFile, queue: &Receiver<Work>, failed: &AtomicBool) {
    let write = |memory: &Memory| {
        let written = file.write(memory);
        failed.store(written.is_err(), Ordering::Relaxed);
        written.inspect_err(|error| {
            tracing::warn!(%error, directory = %file.directory.display(), "what was learned of the home cannot be written; the daemon goes on, and tries again later");
        })
    };
    for work in queue {
        match work {
            Work::Write(memory) => _ = write(&memory),
            Work::Forget(memory, done) => {
                // Whoever asked may have lost patience.
                let _told = done.send(write(&memory).and_then(|()| file.remove_aside()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use roomcast_core::ids::PersonId;
    use std::os::unix::fs::PermissionsExt;
    use std::time::Duration;

    use roomcast_core::habits::{Place, Turn};

    use super::*;

    fn learned() -> Memory {
        let mut memory = Memory::new(HabitsOptions::default());
        memory.habits.bind(vec!["bed".to_owned()], vec!["bedroom".to_owned()], vec![1.0]);
        for at in 1..5 {
            let at_s = 1e9 + 60.0 * f64::from(at);
            memory.habits.observe(&Turn { person: PersonId(1), label: Some(0), room: Some(0), at_s });
        }
        memory.habits.be(PersonId(1), Place::Elsewhere, 1e9 + 600.0);
        memory.heard = Heard::new([EventId::new(1, 2, 3), EventId::new(4, 5, 6)]);
        memory.watched_until_s = 1e9 + 600.0;
        memory
    }

    fn load(directory: &Path) -> (HabitsFile, Memory) {
        HabitsFile::load(directory, HabitsOptions::default())
    }

    #[test]
    fn what_was_learned_outlives_the_daemon() {
        let directory = tempfile::tempdir().unwrap();
        let (file, nothing) = load(directory.path());
        assert_eq!(nothing.habits.learned().counts, 0);
        file.write(&learned()).unwrap();
        let (_, again) = load(directory.path());
        assert_eq!(again.habits.to_bytes(), learned().habits.to_bytes());
        assert_eq!((again.heard, again.watched_until_s), (learned().heard, learned().watched_until_s));
        let mode = fs::metadata(directory.path().join(FILE)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    /// Whatever became of the file, the daemon begins, and the file is there to be looked at until somebody is forgotten.
    #[test]
    fn a_file_that_cannot_be_used_is_set_aside() {
        let whole = encode_memory(&learned());
        let newer = [b"RCHOME2\n", &whole[8..]].concat();
        let mut flipped = whole.clone();
        flipped[100] ^= 1;
        let mut older_habits = whole[..whole.len() - 1].to_vec();
        let sum = crc32fast::hash(&older_habits[12..]);
        older_habits[8..12].copy_from_slice(&sum.to_le_bytes());
        for damaged in [Vec::new(), whole[..whole.len() / 2].to_vec(), newer, flipped, older_habits] {
            let directory = tempfile::tempdir().unwrap();
            fs::write(directory.path().join(FILE), &damaged).unwrap();
            let (file, memory) = load(directory.path());
            assert_eq!(memory.habits.learned().counts, 0);
            assert_eq!(fs::read(directory.path().join(ASIDE)).unwrap(), damaged);
            file.write(&learned()).unwrap();
            assert!(load(directory.path()).1.habits.learned().counts > 0);
            file.remove_aside().unwrap();
            assert!(!directory.path().join(ASIDE).exists());
        }
    }

    /// A full disk and a directory that may not be written are one to the program: what was there before stays whole.
    #[test]
    fn what_cannot_be_written_leaves_what_was_there() {
        let directory = tempfile::tempdir().unwrap();
        let (file, _) = load(directory.path());
        file.write(&learned()).unwrap();
        let nowhere = HabitsFile { directory: directory.path().join("missing"), ..file };
        nowhere.write(&learned()).unwrap_err();
        // A directory in the file's place can neither be read nor be lost.
        let other = tempfile::tempdir().unwrap();
        fs::create_dir(other.path().join(FILE)).unwrap();
        let (file, memory) = load(other.path());
        assert_eq!(memory.habits.learned().counts, 0);
        assert!(file.write(&learned()).unwrap_err().to_string().contains("repair or remove it"));
        let mut keeper = Keeper::start(file).unwrap();
        assert!(keeper.forget(learned(), Instant::now() + Duration::from_secs(60)).is_err());
        keeper.finish(Some(learned()));
        assert!(load(directory.path()).1.habits.learned().counts > 0);
    }

    /// A disk that was full for a while: what was not written is handed over again, though nothing was learned since.
    #[test]
    fn what_could_not_be_written_is_asked_for_again() {
        let directory = tempfile::tempdir().unwrap();
        let folder = directory.path().join("later");
        let (file, _) = load(&folder);
        let keeper = Keeper::start(file).unwrap();
        let wait = |is_done: &dyn Fn() -> bool| {
            while !is_done() {
                std::thread::yield_now()
            }
        };
        assert!(keeper.write(learned()) && !folder.exists());
        wait(&|| keeper.failed.load(Ordering::Relaxed));
        assert!(keeper.has_failed() && !keeper.has_failed());
        fs::create_dir(&folder).unwrap();
        assert!(keeper.write(learned()));
        wait(&|| folder.join(FILE).exists());
        drop(keeper);
        assert!(load(&folder).1.habits.learned().counts > 0);
    }

    proptest::proptest! {
        /// No bytes make it panic.
        #[test]
        fn any_bytes_are_read_or_refused(mut body in proptest::collection::vec(proptest::num::u8::ANY, 0..200)) {
            let mut bytes = MAGIC.to_vec();
            bytes.extend_from_slice(&crc32fast::hash(&body).to_le_bytes());
            bytes.append(&mut body);
            proptest::prop_assert!(decode_memory(&bytes, HabitsOptions::default()).is_err());
        }
    }
}
