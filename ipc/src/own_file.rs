//! The check of files in a state directory before they are opened: whether another user could have put them there.

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use rustix::process::geteuid;

/// Write permission for the group and others.
const WIDE: u32 = 0o022;

/// Refuses a file of a state directory that another user could have put there or may write to: a symbolic link, a FIFO or a device, a file
/// or folder with a wide mode or of another user than this one and root. A missing file is good.
///
/// # Errors
/// When the file or its folder is refused, with the remedy, or cannot be looked at.
pub fn require_own(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    match fs::metadata(folder) {
        Ok(about) => require(&about, folder, "its folder")?,
        // Opening the file fails with the reason.
        Err(_) => return Ok(()),
    }
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
        Ok(about) if about.is_symlink() => Err(refused("it is a symbolic link: remove it".to_owned())),
        Ok(about) if !about.is_file() => Err(refused("it is no plain file: remove it".to_owned())),
        Ok(about) => require(&about, path, "it"),
    }
}

/// Refuses a state directory that another user owns or may write to. A missing directory is good.
///
/// # Errors
/// When the directory is refused, with the remedy.
pub fn require_own_folder(path: &Path) -> io::Result<()> {
    fs::metadata(path).map_or(Ok(()), |about| require(&about, path, "it"))
}

fn require(about: &Metadata, path: &Path, what: &str) -> io::Result<()> {
    let (own, owner) = (geteuid().as_raw(), about.uid());
    if owner != own && owner != 0 {
        return Err(refused(format!(
            "user {owner} owns {what}, and this process runs as user {own}: use a state directory of your own"
        )));
    }
    if about.mode() & WIDE != 0 {
        let (mode, path) = (about.mode() & 0o7777, path.display());
        return Err(refused(format!("other users may write to {what} (mode {mode:o}): run `chmod go-w {path}`")));
    }
    Ok(())
}

fn refused(reason: String) -> io::Error {
    io::Error::new(io::ErrorKind::PermissionDenied, reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, chown, symlink};

    fn fault(path: &Path) -> String {
        require_own(path).unwrap_err().to_string()
    }

    fn chmod(path: &Path, mode: u32) {
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    }

    #[test]
    fn files_that_others_could_have_planted_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        require_own(&at("missing")).unwrap();
        fs::write(at("own"), "x").unwrap();
        require_own(&at("own")).unwrap();
        for target in ["own", "missing", "/dev/null"] {
            let link = at(&format!("to-{}", target.trim_start_matches("/dev/")));
            symlink(target, &link).unwrap();
            assert_eq!(fault(&link), "it is a symbolic link: remove it");
        }
        rustix::fs::mknodat(rustix::fs::CWD, at("fifo"), rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR, 0)
            .unwrap();
        assert_eq!(fault(&at("fifo")), "it is no plain file: remove it");
        chmod(&at("own"), 0o666);
        assert!(fault(&at("own")).starts_with("other users may write to it (mode 666): run `chmod go-w "));
        chmod(&at("own"), 0o600);
        for mode in [0o1777, 0o770] {
            chmod(folder.path(), mode);
            for name in ["own", "missing"] {
                let fault = fault(&at(name));
                assert!(fault.starts_with("other users may write to its folder"), "{fault}");
                assert!(fault.ends_with(&format!("run `chmod go-w {}`", folder.path().display())), "{fault}");
            }
        }
        chmod(folder.path(), 0o700);
        require_own(&at("own")).unwrap();
    }

    #[test]
    fn files_of_another_user_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        fs::write(&path, "x").unwrap();
        // Only root can give a file away.
        if chown(&path, Some(12_345), None).is_err() {
            return;
        }
        assert!(fault(&path).starts_with("user 12345 owns it, and this process runs as user "));
        fs::remove_file(&path).unwrap();
        chown(folder.path(), Some(12_345), None).unwrap();
        assert!(fault(&path).starts_with("user 12345 owns its folder"));
    }
}
