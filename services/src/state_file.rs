//! Small files in the state directory, and outputs of commands. They are read with a limit, and replaced atomically.

use std::ffi::OsString;
use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

pub(crate) use roomcast_ipc::own_file::require_own;

/// The content of a text file; `None` if it is missing.
///
/// # Errors
/// As [`read_bytes`], and [`io::ErrorKind::InvalidData`] when it is not UTF-8.
pub(crate) fn read(path: &Path, bytes_max: u64) -> io::Result<Option<String>> {
    let text =
        |bytes| String::from_utf8(bytes).map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8"));
    read_bytes(path, bytes_max)?.map(text).transpose()
}

/// The content of a file; `None` if it is missing.
///
/// # Errors
/// When it cannot be read, or [`require_own`] refuses it; [`io::ErrorKind::FileTooLarge`] when it has more than `bytes_max` bytes.
pub(crate) fn read_bytes(path: &Path, bytes_max: u64) -> io::Result<Option<Vec<u8>>> {
    require_own(path)?;
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

/// Replaces a file atomically. Only its owner may read it. It survives a power loss.
///
/// # Errors
/// When the directory cannot be written or [`require_own`] refuses the file; the old file is as it was.
pub(crate) fn replace_for_good(path: &Path, bytes: &[u8]) -> io::Result<()> {
    require_own(path)?;
    write(path, bytes, OWNER_ALONE, true)
}

/// Writes an output. A plain file is replaced atomically, and all users may read it if the umask allows. A symbolic link and a FIFO are
/// rejected: another user may have put them there. A file of `/dev` gets the bytes.
///
/// # Errors
/// When it cannot be written or is refused; an old file is as it was.
pub fn write_out(path: &Path, bytes: &[u8]) -> io::Result<()> {
    if path.starts_with("/dev") && !path.starts_with("/dev/shm") {
        // The given name is opened: an open pipe has no path.
        return OpenOptions::new().write(true).open(path)?.write_all(bytes);
    }
    require_out(path)?;
    write(path, bytes, EVERYBODY, false)
}

/// Rejects a path of a symbolic link, a FIFO or a device as the place of a new file.
///
/// # Errors
/// When one is there, or the place cannot be looked at.
pub fn require_out(path: &Path) -> io::Result<()> {
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
        Ok(found) if found.is_file() => Ok(()),
        Ok(found) if found.is_symlink() => Err(io::Error::other("a symbolic link is there; give the name of a file")),
        Ok(_) => Err(io::Error::other("it is no plain file; give the name of a file")),
    }
}

/// Permissions of a file before the umask.
const OWNER_ALONE: u32 = 0o600;
const EVERYBODY: u32 = 0o666;

fn write(path: &Path, bytes: &[u8], mode: u32, for_good: bool) -> io::Result<()> {
    let (prefix, permissions) = (unfinished(path), Permissions::from_mode(mode));
    let mut file = tempfile::Builder::new().prefix(&prefix).permissions(permissions).tempfile_in(folder(path))?;
    file.write_all(bytes)?;
    if for_good {
        file.as_file().sync_all()?;
    }
    file.persist(path).map_err(|error| error.error)?;
    if for_good { sync_folder(path) } else { Ok(()) }
}

/// The prefix of the names of temporary files that are to replace a file.
fn unfinished(path: &Path) -> OsString {
    let mut prefix = OsString::from(".");
    prefix.push(path.file_name().unwrap_or_default());
    prefix.push(".");
    prefix
}

/// Removes the temporary files of a killed process. No other process may write the file now.
///
/// # Errors
/// When the directory cannot be read or written.
pub(crate) fn remove_unfinished(path: &Path) -> io::Result<()> {
    let prefix = unfinished(path);
    for entry in std::fs::read_dir(folder(path))? {
        let entry = entry?;
        if entry.file_name().as_encoded_bytes().starts_with(prefix.as_encoded_bytes()) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

/// Syncs a file's folder, so that new and renamed files in it survive a power loss.
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
        replace_for_good(&path, b"abcd").unwrap();
        assert!(read(&path, 3).unwrap_err().to_string().contains("more than 3 bytes"));
        std::fs::write(&path, [0xff]).unwrap();
        read(&path, 3).unwrap_err();
        let folder = directory.path().join("folder");
        std::fs::create_dir(&folder).unwrap();
        assert!(read(&folder, 3).unwrap_err().to_string().contains("no plain file"));
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
        // A replaced file leaves no temporary file.
        replace_for_good(&at("habits"), b"new").unwrap();
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 5);
        assert!(remove_unfinished(&at("none/habits")).is_err());
    }

    #[test]
    fn files_that_others_could_have_planted_are_neither_read_nor_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::write(at("victim"), "precious").unwrap();
        std::os::unix::fs::symlink("victim", at("link")).unwrap();
        rustix::fs::mknodat(rustix::fs::CWD, at("pipe"), rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU, 0)
            .unwrap();
        for (name, reason) in [("link", "it is a symbolic link"), ("pipe", "it is no plain file")] {
            for error in [read(&at(name), 9).unwrap_err(), replace_for_good(&at(name), b"new").unwrap_err()] {
                assert!(error.to_string().starts_with(reason), "{error}");
            }
        }
        std::fs::set_permissions(at("victim"), Permissions::from_mode(0o666)).unwrap();
        assert!(
            replace_for_good(&at("victim"), b"new").unwrap_err().to_string().contains("other users may write to it")
        );
        std::fs::set_permissions(directory.path(), Permissions::from_mode(0o1777)).unwrap();
        assert!(replace_for_good(&at("new"), b"new").unwrap_err().to_string().contains("may write to its folder"));
        assert_eq!(std::fs::read_to_string(at("victim")).unwrap(), "precious");
    }

    #[test]
    fn outputs_follow_no_link_and_wait_for_no_fifo() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::write(at("victim"), "precious").unwrap();
        for (name, target) in [("link", "victim"), ("dangling", "missing"), ("turn", "turn"), ("null", "/dev/null")] {
            std::os::unix::fs::symlink(target, at(name)).unwrap();
            let error = write_out(&at(name), b"drawing").unwrap_err().to_string();
            assert_eq!(error, "a symbolic link is there; give the name of a file", "{name}");
        }
        rustix::fs::mknodat(rustix::fs::CWD, at("pipe"), rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU, 0)
            .unwrap();
        for path in [&at("pipe"), directory.path()] {
            assert!(write_out(path, b"drawing").unwrap_err().to_string().starts_with("it is no plain file"));
        }
        assert_eq!(std::fs::read_to_string(at("victim")).unwrap(), "precious");
        assert!(!at("missing").exists());
        write_out(Path::new("/dev/null"), b"drawing").unwrap();
        write_out(&at("victim"), b"drawing").unwrap();
        assert_eq!(std::fs::read_to_string(at("victim")).unwrap(), "drawing");
    }

    /// Other users may read a drawing, but no state file.
    #[test]
    fn what_is_asked_for_is_for_others_and_what_is_kept_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let plain = at("plain");
        std::fs::write(&plain, "").unwrap();
        write_out(&at("out"), b"new").unwrap();
        replace_for_good(&at("kept"), b"new").unwrap();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!((mode(&at("out")), mode(&at("kept"))), (mode(&plain), OWNER_ALONE));
    }
}
