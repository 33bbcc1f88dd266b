//! What the journal asks of a disk, one call each, so that a test can let every one of them fail, and take what was not synced.

use std::fmt::{self, Debug};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

use rustix::fs::FlockOperation;

use crate::state_file::{self, sync_folder};

/// A half of the journal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Half {
    /// The full one.
    Older,
    /// The one that is written.
    Current,
}

/// Two halves under their names, the file that is open as the current half, and a next one that has no half's name yet.
///
/// What is written, cut off or renamed outlives this process at once. It outlives a loss of power after [`Disk::sync`] for the open file, and
/// after [`Disk::sync_names`] for names.
pub trait Disk: Debug {
    /// What a half holds; nothing where there is none.
    ///
    /// # Errors
    /// When the disk refuses.
    fn read(&self, half: Half) -> io::Result<Vec<u8>>;

    /// Puts bytes behind those of the open file. Where it fails, part of them may be there.
    ///
    /// # Errors
    /// When the disk refuses, or is full.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Cuts the open file off after so many bytes.
    ///
    /// # Errors
    /// When the disk refuses.
    fn cut(&mut self, length: u64) -> io::Result<()>;

    /// Writes pieces over what the open file has from the byte on that comes before each of them.
    ///
    /// # Errors
    /// When the disk refuses; some of them may be written.
    fn rewrite(&mut self, pieces: &[(u64, Vec<u8>)]) -> io::Result<()>;

    /// Brings the open file to the disk. What that fails with is lost with the power, also when a later call succeeds, unless it is written again.
    ///
    /// # Errors
    /// When the disk refuses.
    fn sync(&mut self) -> io::Result<()>;

    /// Makes the next file, with these bytes, locked, and brings it to the disk. One that was made before is gone.
    ///
    /// # Errors
    /// When the disk refuses, or is full.
    fn prepare(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Whether the open file has the name of the current half.
    ///
    /// # Errors
    /// When the disk refuses.
    fn is_current(&self) -> io::Result<bool>;

    /// Gives the open file the name of the older half, which goes.
    ///
    /// # Errors
    /// When the disk refuses.
    fn retire(&mut self) -> io::Result<()>;

    /// Gives the next file the name of a half, which goes; as the current half it is the open one from now on.
    ///
    /// # Errors
    /// When the disk refuses, or nothing is prepared.
    fn place(&mut self, half: Half) -> io::Result<()>;

    /// Brings the names to the disk.
    ///
    /// # Errors
    /// When the disk refuses.
    fn sync_names(&mut self) -> io::Result<()>;

    /// Refuses where no half's name leads to the open file: whoever opens the journal next does not find what is in it. A disk whose files
    /// nobody else removes has nothing to say.
    ///
    /// # Errors
    /// When they were removed or moved, or their disk is gone.
    fn require_name(&self) -> io::Result<()> {
        Ok(())
    }

    /// Removes the halves that were too large and are kept aside.
    ///
    /// # Errors
    /// When the disk refuses.
    fn remove_aside(&mut self) -> io::Result<()>;
}

/// A folder of a real disk.
pub struct Folder {
    file: File,
    current: PathBuf,
    older: PathBuf,
    /// Where the next file is made, and the file.
    next: (PathBuf, Option<File>),
    /// Most bytes of a half that are read.
    half_bytes_max: u64,
}

/// As the log names it.
impl Debug for Folder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.current.display())
    }
}

/// More than a half of the journal can have.
const HALF_MARGIN: u64 = 1 << 20;
/// The operation of a file that another user could have put there.
pub(super) const USE: &str = "use";
/// Most halves that were too large and are kept aside.
const ASIDE_MAX: usize = 64;

/// What failed at the start: the file, and what was done with it.
type Refused = (PathBuf, &'static str, io::Error);

impl Folder {
    /// Opens the current half in the folder, or begins it, for this process alone. What a rotation that was cut short has left is put to
    /// rights: a next file becomes the current half where there is none, and goes where there is one.
    ///
    /// A half that is larger than a journal of `bytes_max` is either of a time when it might have more, or damaged. It is kept under another
    /// name, whole; the half goes on with what it said last.
    pub(super) fn open(folder: &Path, bytes_max: u64) -> Result<Self, Refused> {
        let [current, older, next] =
            ["narration.journal", "narration.journal.old", "narration.journal.next"].map(|name| folder.join(name));
        let failed = |path: &Path, operation| {
            let path = path.to_owned();
            move |error| (path, operation, error)
        };
        for path in [&current, &older, &next] {
            state_file::require_own(path).map_err(failed(path, USE))?;
        }
        // Whoever is in the middle of it has the next file locked, and so this one after it.
        if fs::symlink_metadata(&current).is_err_and(|error| error.kind() == io::ErrorKind::NotFound) {
            match fs::rename(&next, &current) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    return Err(failed(&next, "rename")(error));
                }
                _ => {}
            }
        }
        let file = open_file(&current).map_err(failed(&current, "open"))?;
        rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive)
            .map_err(|error| failed(&current, "lock")(error.into()))?;
        remove(&next).map_err(failed(&next, "remove"))?;
        sync_folder(&current).map_err(failed(folder, "sync"))?;
        let half_bytes_max = bytes_max.saturating_add(HALF_MARGIN);
        let mut opened = Self { file, current, older, next: (next, None), half_bytes_max };
        for half in [Half::Older, Half::Current] {
            let path = opened.path(half).to_owned();
            opened.keep_large_aside(half).map_err(failed(&path, "keep aside"))?;
        }
        Ok(opened)
    }

    /// Makes a half that is too large one of its newest part. Whatever it is killed in between, the whole one is there.
    fn keep_large_aside(&mut self, half: Half) -> io::Result<()> {
        let path = self.path(half).to_owned();
        state_file::require_own(&path)?;
        let mut file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error),
        };
        let bytes = file.metadata()?.len();
        if bytes <= self.half_bytes_max {
            return Ok(());
        }
        file.seek(SeekFrom::Start(bytes - self.half_bytes_max))?;
        let mut newest = Vec::new();
        file.take(self.half_bytes_max).read_to_end(&mut newest)?;
        let aside = set_aside(&path)?;
        self.prepare(&newest)?;
        self.place(half)?;
        self.sync_names()?;
        tracing::warn!(
            path = %path.display(),
            aside = %aside.display(),
            bytes,
            "a file of the journal has more than daemon.journal_bytes: it is kept aside until somebody is forgotten, and its newest part is read"
        );
        Ok(())
    }

    fn path(&self, half: Half) -> &Path {
        match half {
            Half::Older => &self.older,
            Half::Current => &self.current,
        }
    }
}

impl Disk for Folder {
    fn read(&self, half: Half) -> io::Result<Vec<u8>> {
        let path = self.path(half);
        state_file::require_own(path)?;
        let mut bytes = Vec::new();
        match File::open(path) {
            Ok(file) => {
                file.take(self.half_bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
                match bytes.len() as u64 <= self.half_bytes_max {
                    true => Ok(bytes),
                    false => Err(io::Error::new(io::ErrorKind::FileTooLarge, "somebody else has written to it")),
                }
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(bytes),
            Err(error) => Err(error),
        }
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)
    }

    fn rewrite(&mut self, pieces: &[(u64, Vec<u8>)]) -> io::Result<()> {
        // The file appends, so it is written to through another descriptor.
        let again = format!("/proc/self/fd/{}", self.file.as_raw_fd());
        let file = OpenOptions::new().write(true).open(again)?;
        pieces.iter().try_for_each(|(at, bytes)| file.write_all_at(bytes, *at))
    }

    fn sync(&mut self) -> io::Result<()> {
        self.file.sync_data()
    }

    fn require_name(&self) -> io::Result<()> {
        let ours = self.file.metadata()?;
        let leads_here = |path: &PathBuf| {
            fs::metadata(path).is_ok_and(|there| (there.dev(), there.ino()) == (ours.dev(), ours.ino()))
        };
        // In the middle of a rotation it has the older half's name.
        if leads_here(&self.current) || leads_here(&self.older) {
            return Ok(());
        }
        Err(io::Error::new(
            io::ErrorKind::NotFound,
            "it was removed, or its disk is gone, so a restarted daemon will know nothing of it; restart the daemon, which makes a new one",
        ))
    }

    fn prepare(&mut self, bytes: &[u8]) -> io::Result<()> {
        let (path, next) = &mut self.next;
        *next = None;
        remove(path)?;
        let made = open_file(path).and_then(|mut file| {
            file.write_all(bytes)?;
            file.sync_all()?;
            rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive)?;
            Ok(file)
        });
        // What a full disk has of it helps nobody.
        *next = Some(made.inspect_err(|_| _ = fs::remove_file(path))?);
        Ok(())
    }

    fn is_current(&self) -> io::Result<bool> {
        match fs::symlink_metadata(&self.current) {
            Ok(there) => {
                let ours = self.file.metadata()?;
                Ok((there.dev(), there.ino()) == (ours.dev(), ours.ino()))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn retire(&mut self) -> io::Result<()> {
        fs::rename(&self.current, &self.older)
    }

    fn place(&mut self, half: Half) -> io::Result<()> {
        let Some(file) = self.next.1.take() else { return Err(io::Error::other("no file is prepared")) };
        fs::rename(&self.next.0, self.path(half))?;
        if half == Half::Current {
            self.file = file;
        }
        Ok(())
    }

    fn sync_names(&mut self) -> io::Result<()> {
        sync_folder(&self.current)
    }

    fn remove_aside(&mut self) -> io::Result<()> {
        let halves = [&self.older, &self.current];
        halves.into_iter().try_for_each(|half| (1..=ASIDE_MAX).try_for_each(|number| remove(&aside(half, number))))
    }
}

/// The name of a half that is kept aside, beside its own.
fn aside(half: &Path, number: usize) -> PathBuf {
    let mut name = half.as_os_str().to_owned();
    name.push(format!(".large-{number}"));
    name.into()
}

/// Gives a file another name, beside its own.
fn set_aside(path: &Path) -> io::Result<PathBuf> {
    for number in 1..=ASIDE_MAX {
        let name = aside(path, number);
        match fs::hard_link(path, &name) {
            Ok(()) => return Ok(name),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::other(format!("{ASIDE_MAX} are kept aside already; remove some")))
}

fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn open_file(path: &Path) -> io::Result<File> {
    use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
    state_file::require_own(path)?;
    let file = OpenOptions::new().read(true).append(true).create(true).mode(0o600).open(path)?;
    // Others could read a copy, as a backup makes one. Who does not own the file cannot change that.
    let is_open = file.metadata().is_ok_and(|found| found.permissions().mode() & 0o077 != 0);
    if is_open {
        let _kept = file.set_permissions(fs::Permissions::from_mode(0o600));
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whoever removes or moves the state folder under a daemon, or lets its disk go, is told: what is confirmed is in no journal any more.
    #[test]
    fn a_journal_that_was_removed_is_noticed() {
        let outer = tempfile::tempdir().unwrap();
        let (state, moved) = (outer.path().join("state"), outer.path().join("moved"));
        fs::create_dir(&state).unwrap();
        let Ok(mut disk) = Folder::open(&state, 1 << 20) else { panic!("the folder can be used") };
        disk.append(b"one").unwrap();
        disk.require_name().unwrap();
        disk.prepare(b"two").unwrap();
        disk.retire().unwrap();
        disk.require_name().unwrap();
        disk.place(Half::Current).unwrap();
        disk.require_name().unwrap();
        fs::rename(&state, &moved).unwrap();
        assert!(disk.require_name().unwrap_err().to_string().contains("restart the daemon"));
        fs::rename(&moved, &state).unwrap();
        disk.require_name().unwrap();
        fs::remove_dir_all(&state).unwrap();
        assert_eq!(disk.require_name().unwrap_err().kind(), io::ErrorKind::NotFound);
        // Another daemon's file of the same name is not this one's.
        fs::create_dir(&state).unwrap();
        let Ok(_other) = Folder::open(&state, 1 << 20) else { panic!("the folder can be used") };
        assert!(disk.require_name().is_err());
    }

    #[test]
    fn the_log_names_a_folder_by_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let Ok(disk) = Folder::open(folder.path(), 1 << 20) else { panic!("the folder can be used") };
        assert_eq!(format!("{disk:?}"), folder.path().join("narration.journal").display().to_string());
    }
}
