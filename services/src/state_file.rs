//! Files of earlier versions in the state directory, which are read with a limit, and outputs of commands, which are replaced atomically.

use std::fs::{File, OpenOptions, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

pub(crate) use roomcast_ipc::own_file::require_own;

/// The content of a file; `None` if it is missing.
///
/// # Errors
/// When it cannot be read, or [`require_own`] refuses it; [`io::ErrorKind::FileTooLarge`] when it has more than `bytes_max` bytes.
pub(crate) fn read(path: &Path, bytes_max: u64) -> io::Result<Option<Vec<u8>>> {
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
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = tempfile::Builder::new().permissions(Permissions::from_mode(0o666)).tempfile_in(folder)?;
    file.write_all(bytes)?;
    file.persist(path).map(|_| ()).map_err(|error| error.error)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_read_up_to_its_limit() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert_eq!(read(&path, 3).unwrap(), None);
        std::fs::write(&path, "abc").unwrap();
        assert_eq!(read(&path, 3).unwrap().as_deref(), Some(&b"abc"[..]));
        std::fs::write(&path, "abcd").unwrap();
        assert!(read(&path, 3).unwrap_err().to_string().contains("more than 3 bytes"));
        let folder = directory.path().join("folder");
        std::fs::create_dir(&folder).unwrap();
        assert!(read(&folder, 3).unwrap_err().to_string().contains("no plain file"));
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

    #[test]
    fn other_users_may_read_an_output() {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        std::fs::write(at("plain"), "").unwrap();
        write_out(&at("out"), b"new").unwrap();
        let mode = |name| std::fs::metadata(at(name)).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode("out"), mode("plain"));
    }
}
