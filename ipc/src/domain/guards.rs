//! What a participant holds while it lives: the lock of its name, and the clean-up of unfinished and of last files.

use std::fs::TryLockError;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::sync::mpsc;
use std::thread::JoinHandle;
use std::{fs, io};

use super::{COUNTER_FILE, Domain, WATCH_EVERY};

/// Removes iceoryx2's counter of participants when the last one leaves, so that a clean stop leaves nothing in shared memory.
///
/// The counter keeps participants' numbers distinct, together with the process and the nanosecond in which they joined. A participant that
/// is joining at this moment already has its number, and the next one starts a new counter.
#[derive(Debug)]
pub(super) struct LastOut(pub(super) Domain);

impl Drop for LastOut {
    fn drop(&mut self) {
        if self.0.is_deserted() {
            for file in self.0.shared_memory().unwrap_or_default() {
                if file.extension().is_some_and(|suffix| suffix == COUNTER_FILE) {
                    // Another participant that leaves at the same moment may have removed it.
                    let _removed = fs::remove_file(file);
                }
            }
        }
    }
}

/// The lock of the only participant of a name, held while its process runs. The kernel releases it when the process is killed.
///
/// A list of participants is not enough: a participant that is just joining is not in it.
#[derive(Debug)]
pub(super) struct Only {
    pub(super) file: fs::File,
    path: PathBuf,
}

impl Only {
    /// Locks a file that was opened at `path`; `None` if another process has locked it.
    pub(super) fn lock(file: fs::File, path: PathBuf) -> io::Result<Option<Self>> {
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(None),
            Err(TryLockError::Error(error)) => return Err(error),
        }
        let only = Self { file, path };
        // The previous holder may have removed the file after it was opened here. A lock on it would then exclude no other process.
        Ok(Some(only).filter(Self::is_in_place))
    }

    fn is_in_place(&self) -> bool {
        let (own, there) = (self.file.metadata(), fs::symlink_metadata(&self.path));
        matches!((own, there), (Ok(own), Ok(there)) if (own.dev(), own.ino()) == (there.dev(), there.ino()))
    }
}

impl Drop for Only {
    fn drop(&mut self) {
        // The lock still excludes other processes.
        if self.is_in_place() {
            let _removed = fs::remove_file(&self.path);
        }
    }
}

/// Removes unfinished shared memory.
///
/// A process that is killed between creating shared memory and setting its size leaves an empty file. iceoryx2 waits for such memory
/// without end: when it opens a service, cleans up after the dead, or sends. So a thread of every participant removes these files when they
/// are [`MADE_WITHIN`] old, and the waiting call goes on with a temporary error.
#[derive(Debug)]
pub(super) struct Watch {
    stop: Option<mpsc::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    pub(super) fn start(domain: &Domain) -> io::Result<Self> {
        let domain = domain.clone();
        let (stop, stopped) = mpsc::channel();
        let watch = move || {
            while stopped.recv_timeout(WATCH_EVERY) == Err(mpsc::RecvTimeoutError::Timeout) {
                domain.remove_unmade_memory();
            }
        };
        let thread = std::thread::Builder::new().name("watch".to_owned()).spawn(watch)?;
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            // The thread does not panic, and returns nothing.
            let _ended = thread.join();
        }
    }
}
