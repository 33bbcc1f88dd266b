//! Small files, in the state directory and where a command is told to write: read with a limit, replaced whole or not at all.

use std::ffi::OsString;
use std::fs::{DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use roomcast_ipc::clock;
use serde::Serialize;

use crate::logging::Limiter;

/// Most links that are followed to where a file is to be, as the system does.
const LINKS_MAX: usize = 40;
/// How often a file that cannot be written is complained of.
const COMPLAINT_NS: u64 = 60_000_000_000;

/// Makes a folder for what is kept, and those above it, where they are not there yet: nobody else reads who lives here.
///
/// # Errors
/// When it cannot be made.
pub(crate) fn make_folder(path: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(path)
}

/// What a file of text holds; none where there is none.
///
/// # Errors
/// As [`read_bytes`], and [`io::ErrorKind::InvalidData`] when it is not UTF-8.
pub(crate) fn read(path: &Path, bytes_max: u64) -> io::Result<Option<String>> {
    let text =
        |bytes| String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8"));
    read_bytes(path, bytes_max)?.map(text).transpose()
}

/// What a file holds; none where there is none.
///
/// # Errors
/// When it cannot be read or is no plain file; [`io::ErrorKind::FileTooLarge`] when it has more than `bytes_max` bytes.
pub(crate) fn read_bytes(path: &Path, bytes_max: u64) -> io::Result<Option<Vec<u8>>> {
    require_plain(path)?;
    let mut bytes = Vec::new();
    match File::open(path) {
        Ok(file) => _ = file.take(bytes_max + 1).read_to_end(&mut bytes)?,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    }
    if bytes.len() as u64 > bytes_max {
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, format!("it has more than {bytes_max} bytes")));
    }
    Ok(Some(bytes))
}

/// Refuses what is there and is no plain file: a named pipe would wait for whoever writes to it, and a device may have no end.
///
/// # Errors
/// When it is none, or cannot be looked at.
pub(crate) fn require_plain(path: &Path) -> io::Result<()> {
    match std::fs::metadata(path) {
        Ok(found) if !found.is_file() => Err(io::Error::other("it is no plain file; remove it")),
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// A small file of JSON that follows a value across changes.
#[derive(Debug)]
pub(crate) struct Kept<T> {
    path: PathBuf,
    /// What the file is known to hold.
    written: Option<T>,
    log: Limiter,
}

impl<T: PartialEq + Serialize> Kept<T> {
    /// Of nothing yet: whatever the file holds is replaced by the first value.
    pub(crate) fn new(path: PathBuf) -> Self {
        Self { path, written: None, log: Limiter::new(COMPLAINT_NS) }
    }

    /// The file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Replaces the file where it does not hold this value. What cannot be written is tried again with the next call, and is complained of now
    /// and then: `loss` says what it costs, and the remedy.
    pub(crate) fn keep(&mut self, value: T, loss: &str) {
        if self.written.as_ref() == Some(&value) {
            return;
        }
        let bytes = serde_json::to_vec(&value).map_err(io::Error::from);
        match bytes.and_then(|bytes| replace(&self.path, &bytes)) {
            Ok(()) => self.written = Some(value),
            Err(error) => {
                if let Some(not_told) = self.log.pass(clock::monotonic_ns()) {
                    tracing::warn!(%error, path = %self.path.display(), not_told, "{loss}");
                }
            }
        }
    }
}

/// Puts a new file, which its owner alone may read, in place of the old one, which stays whole until then. A link stays one: the file that it leads to is replaced. It
/// outlives a crash of this process, and may not outlive a loss of power.
///
/// # Errors
/// When the directory cannot be written; the old file is as it was.
pub(crate) fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write(&target(path), bytes, OWNER_ALONE, false)
}

/// The same, and it outlives a loss of power.
///
/// # Errors
/// As [`replace`], or when the disk refuses.
pub(crate) fn replace_for_good(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write(&target(path), bytes, OWNER_ALONE, true)
}

/// Writes what somebody asked for to where they want it. A plain file is replaced as by a service, and all may read it, less what the umask
/// takes. A device or a named pipe gets the bytes and stays what it is: `/dev/stdout` and `/dev/null` are good places for them.
///
/// # Errors
/// When it cannot be written; an old file is as it was.
pub fn write_out(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match std::fs::metadata(path) {
        // By the name that was given: that of an open pipe leads through /proc to no path.
        Ok(found) if !found.is_file() => OpenOptions::new().write(true).open(path)?.write_all(bytes),
        _ => write(&target(path), bytes, EVERYBODY, false),
    }
}

/// What a file's permissions are before the umask takes some.
const OWNER_ALONE: u32 = 0o600;
const EVERYBODY: u32 = 0o666;

fn write(path: &Path, bytes: &[u8], mode: u32, for_good: bool) -> io::Result<()> {
    // Nobody's device or named pipe is replaced by a file.
    require_plain(path)?;
    let (prefix, permissions) = (unfinished(path), Permissions::from_mode(mode));
    let mut file = tempfile::Builder::new().prefix(&prefix).permissions(permissions).tempfile_in(folder(path))?;
    file.write_all(bytes)?;
    if for_good {
        file.as_file().sync_all()?;
    }
    file.persist(path).map_err(|error| error.error)?;
    if for_good { sync_folder(path) } else { Ok(()) }
}

/// Where a path leads, so that a link stays one: also one to a file that is not there yet.
fn target(path: &Path) -> PathBuf {
    let mut path = path.to_owned();
    for _ in 0..LINKS_MAX {
        if let Ok(found) = std::fs::canonicalize(&path) {
            return found;
        }
        match std::fs::read_link(&path) {
            Ok(next) => path = folder(&path).join(next),
            Err(_) => break,
        }
    }
    path
}

/// What the names of files begin with that are to take the place of one, until they are whole.
fn unfinished(path: &Path) -> OsString {
    let mut prefix = OsString::from(".");
    prefix.push(path.file_name().unwrap_or_default());
    prefix.push(".");
    prefix
}

/// Removes what a process that was killed had begun to write in place of a file that nobody else writes now.
///
/// # Errors
/// When the directory cannot be read or written.
pub(crate) fn remove_unfinished(path: &Path) -> io::Result<()> {
    let path = target(path);
    let prefix = unfinished(&path);
    for entry in std::fs::read_dir(folder(&path))? {
        let entry = entry?;
        if entry.file_name().as_encoded_bytes().starts_with(prefix.as_encoded_bytes()) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Makes what was created, renamed or removed in a file's folder outlive a loss of power.
///
/// # Errors
/// When the folder cannot be opened, or the disk refuses.
pub(crate) fn sync_folder(file: &Path) -> io::Result<()> {
    File::open(folder(file))?.sync_all()
}

fn folder(file: &Path) -> PathBuf {
    file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new(".")).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_up_to_its_limit() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert_eq!(read(&path, 3).unwrap(), None);
        replace_for_good(&path, b"abc").unwrap();
        assert_eq!(read(&path, 3).unwrap().as_deref(), Some("abc"));
        replace(&path, b"abcd").unwrap();
        assert!(read(&path, 3).unwrap_err().to_string().contains("more than 3 bytes"));
        std::fs::write(&path, [0xff]).unwrap();
        read(&path, 3).unwrap_err();
        assert!(read(directory.path(), 3).unwrap_err().to_string().contains("no plain file"));
    }

    #[test]
    fn what_could_not_be_written_is_written_when_it_can_be() {
        let outer = tempfile::tempdir().unwrap();
        let path = outer.path().join("state/value.json");
        let mut kept = Kept::new(path.clone());
        kept.keep(7, "it is not kept");
        make_folder(path.parent().unwrap()).unwrap();
        kept.keep(7, "it is not kept");
        assert_eq!(read(&path, 9).unwrap().as_deref(), Some("7"));
        // What the file holds already is not written again.
        std::fs::remove_file(&path).unwrap();
        kept.keep(7, "it is not kept");
        assert!(!path.exists());
        kept.keep(8, "it is not kept");
        assert_eq!(read(&path, 9).unwrap().as_deref(), Some("8"));
    }

    #[test]
    fn what_was_begun_is_removed_and_nothing_else() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        for name in ["habits", ".habits.Ab12", ".habits", "habits.damaged", ".habits-2.x", ".persons.Ab12"] {
            std::fs::write(at(name), "content").unwrap();
        }
        remove_unfinished(&at("habits")).unwrap();
        assert!(!at(".habits.Ab12").exists());
        assert!(
            ["habits", ".habits", "habits.damaged", ".habits-2.x", ".persons.Ab12"]
                .iter()
                .all(|name| at(name).exists())
        );
        // A file that is replaced leaves nothing.
        replace(&at("habits"), b"new").unwrap();
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 5);
        assert!(remove_unfinished(&at("none/habits")).is_err());
    }

    /// Nobody writes to the pipe: to open it would wait for ever.
    #[test]
    fn a_named_pipe_is_no_file() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("pipe");
        rustix::fs::mknodat(rustix::fs::CWD, &path, rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR, 0).unwrap();
        assert!(read(&path, 3).unwrap_err().to_string().contains("no plain file"));
        // Nor is it replaced by one, also behind a link: a service that root runs could replace a device.
        let link = directory.path().join("link");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        assert!(replace(&link, b"new").unwrap_err().to_string().contains("no plain file"));
        assert!(!std::fs::metadata(&path).unwrap().is_file());
    }

    /// Whoever tries a command with `--out /dev/null` has a device afterwards, and whoever reads a pipe gets what was made.
    #[test]
    fn what_is_asked_for_goes_into_a_pipe_or_a_device_and_replaces_none() {
        let directory = tempfile::tempdir().unwrap();
        let (pipe, link) = (directory.path().join("pipe"), directory.path().join("link"));
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU, 0).unwrap();
        std::os::unix::fs::symlink(&pipe, &link).unwrap();
        for path in [&pipe, &link] {
            let from = pipe.clone();
            let reader = std::thread::spawn(move || std::fs::read(from).unwrap());
            write_out(path, b"drawing").unwrap();
            assert_eq!(reader.join().unwrap(), b"drawing");
        }
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 2);
        // A device of our own would need rights that tests may lack; a link to one needs none.
        let null = directory.path().join("null");
        std::os::unix::fs::symlink("/dev/null", &null).unwrap();
        write_out(&null, b"drawing").unwrap();
        assert!(std::fs::symlink_metadata(&null).unwrap().is_symlink());
        assert!(write_out(directory.path(), b"drawing").is_err());
    }

    /// Others may read a drawing, and nobody what is kept of a home.
    #[test]
    fn what_is_asked_for_is_for_others_and_what_is_kept_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let plain = at("plain");
        std::fs::write(&plain, "").unwrap();
        write_out(&at("out"), b"new").unwrap();
        replace(&at("kept"), b"new").unwrap();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!((mode(&at("out")), mode(&at("kept"))), (mode(&plain), OWNER_ALONE));
    }

    #[test]
    fn a_link_stays_one() {
        let directory = tempfile::tempdir().unwrap();
        let (file, link) = (directory.path().join("elsewhere"), directory.path().join("link"));
        std::fs::write(&file, "old").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        replace(&link, b"new").unwrap();
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "new");
        // Also one whose file is not there yet, by way of another.
        std::fs::remove_file(&file).unwrap();
        let outer = directory.path().join("outer");
        std::os::unix::fs::symlink("link", &outer).unwrap();
        write_out(&outer, b"newer").unwrap();
        assert!([&link, &outer].iter().all(|link| std::fs::symlink_metadata(link).unwrap().is_symlink()));
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "newer");
        // Links that lead nowhere end.
        let turn = directory.path().join("turn");
        std::os::unix::fs::symlink("turn", &turn).unwrap();
        assert!(write_out(&turn, b"new").is_err());
    }
}
