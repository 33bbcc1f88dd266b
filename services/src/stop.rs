//! A clean stop on ctrl-C and on a termination signal. A further signal after a while ends the process at once.

use std::convert::Infallible;
use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, bounded};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;
use signal_hook::low_level::{self, pipe};

use crate::logging;

/// Signals closer together are one request: `timeout` and terminals send theirs to a process and again to its group.
const SAME_REQUEST: Duration = Duration::from_millis(500);

/// Whether a stop was requested.
#[derive(Debug, Clone)]
pub struct Stop {
    asked: Arc<AtomicBool>,
    /// A signal ends the process at once.
    at_once: Arc<AtomicBool>,
    /// `None` after a request: dropping the sender wakes the receivers of [`Stop::woken`].
    awake: Arc<Mutex<Option<Sender<Infallible>>>>,
    woken: Receiver<Infallible>,
}

impl Default for Stop {
    fn default() -> Self {
        Self::new()
    }
}

impl Stop {
    /// A stop that only [`Stop::request`] sets.
    #[must_use]
    pub fn new() -> Self {
        let (awake, woken) = bounded(0);
        Self { asked: Arc::default(), at_once: Arc::default(), awake: Arc::new(Mutex::new(Some(awake))), woken }
    }

    /// A stop on SIGINT and SIGTERM. A further signal at least half a second later ends the process with the exit code `second_signal`.
    ///
    /// # Errors
    ///
    /// If the system rejects the handlers, or the thread that waits for further signals.
    pub fn on_signals(second_signal: u8) -> io::Result<Self> {
        let stop = Self::new();
        // At a limit on file sizes, a write then fails as on a full disk. Without a handler the signal would end the process.
        flag::register(SIGXFSZ, Arc::default())?;
        for signal in [SIGINT, SIGTERM] {
            flag::register(signal, Arc::clone(&stop.asked))?;
        }
        // A byte for each signal. The library's own way of waiting panics if a read fails.
        let (mut signals, given) = UnixStream::pair()?;
        for signal in [SIGINT, SIGTERM] {
            pipe::register(signal, given.try_clone()?)?;
        }
        let asked = stop.clone();
        let wait = move || {
            // This keeps the pipe open, so that reading does not end if the handlers are gone.
            let _given = given;
            let mut first = None;
            loop {
                if signals.read_exact(&mut [0]).is_err() {
                    std::thread::sleep(SAME_REQUEST);
                    continue;
                }
                asked.request();
                if asked.at_once.load(Ordering::SeqCst) {
                    logging::finish();
                    low_level::exit(0);
                }
                if first.get_or_insert_with(Instant::now).elapsed() >= SAME_REQUEST {
                    low_level::exit(i32::from(second_signal));
                }
            }
        };
        std::thread::Builder::new().name("signals".to_owned()).spawn(wait)?;
        Ok(stop)
    }

    /// Asks to stop.
    pub fn request(&self) {
        self.asked.store(true, Ordering::SeqCst);
        drop(self.awake.lock().unwrap_or_else(PoisonError::into_inner).take());
    }

    /// Runs `load`, which cannot be interrupted and has nothing to finish, such as loading a model: a signal ends the process at once, with exit
    /// code 0. `None` if a stop was requested before.
    pub fn while_loading<T>(&self, load: impl FnOnce() -> T) -> Option<T> {
        self.at_once.store(true, Ordering::SeqCst);
        let loaded = (!self.requested()).then(load);
        self.at_once.store(false, Ordering::SeqCst);
        loaded
    }

    /// A channel without messages that disconnects at a request: for a thread that waits for several things.
    #[must_use]
    pub fn woken(&self) -> &Receiver<Infallible> {
        &self.woken
    }

    /// Whether a stop was requested.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.asked.load(Ordering::SeqCst)
    }
}

#[cfg(test)]
mod tests {
    use crossbeam::channel::RecvTimeoutError;

    use super::*;

    #[test]
    fn who_waits_for_a_stop_is_woken() {
        let stop = Stop::new();
        assert_eq!(stop.woken().recv_timeout(Duration::ZERO), Err(RecvTimeoutError::Timeout));
        let other = stop.clone();
        std::thread::spawn(move || other.request());
        assert_eq!(stop.woken().recv_timeout(Duration::from_secs(60)), Err(RecvTimeoutError::Disconnected));
        assert!(stop.requested());
    }
}
