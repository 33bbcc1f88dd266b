//! A clean stop on ctrl-C and on a termination signal. A further signal after a while ends the process at once.

use std::fmt;
use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;
use signal_hook::low_level::{self, pipe};

/// Signals closer together are one request: `timeout` and terminals send theirs to a process and again to its group.
const SAME_REQUEST: Duration = Duration::from_millis(500);

type Act = Box<dyn FnOnce() + Send>;

/// Whether a stop was requested.
#[derive(Clone, Default)]
pub struct Stop {
    asked: Arc<AtomicBool>,
    /// A signal ends the process at once.
    at_once: Arc<AtomicBool>,
    acts: Arc<Mutex<Vec<Act>>>,
}

impl fmt::Debug for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Stop").field(&self.asked).finish()
    }
}

impl Stop {
    /// A stop that only [`Stop::request`] sets.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A stop on SIGINT and SIGTERM. A further signal at least half a second later ends the process with the exit code `second_signal`. `finish` is
    /// called before a signal ends the process during [`Stop::while_loading`].
    ///
    /// # Errors
    ///
    /// If the system rejects the handlers, or the thread that waits for further signals.
    pub fn on_signals(second_signal: u8, finish: fn()) -> io::Result<Self> {
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
                    finish();
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
        let acts = std::mem::take(&mut *self.acts.lock().unwrap_or_else(PoisonError::into_inner));
        acts.into_iter().for_each(|act| act());
    }

    /// Calls `act` at a request, or now if a stop was requested before: to wake a thread that waits for several things.
    pub fn then(&self, act: impl FnOnce() + Send + 'static) {
        self.acts.lock().unwrap_or_else(PoisonError::into_inner).push(Box::new(act));
        if self.requested() {
            self.request();
        }
    }

    /// Runs `load`, which cannot be interrupted and has nothing to finish, such as loading a model: a signal ends the process at once, with exit
    /// code 0. `None` if a stop was requested before.
    pub fn while_loading<T>(&self, load: impl FnOnce() -> T) -> Option<T> {
        self.at_once.store(true, Ordering::SeqCst);
        let loaded = (!self.requested()).then(load);
        self.at_once.store(false, Ordering::SeqCst);
        loaded
    }

    /// Whether a stop was requested.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.asked.load(Ordering::SeqCst)
    }

    /// Requests a stop when it is dropped. If a thread ends in any way, even by a panic, the others end too.
    #[must_use]
    pub fn at_end(&self) -> AtEnd<'_> {
        AtEnd(self)
    }
}

/// The guard of [`Stop::at_end`].
#[derive(Debug)]
pub struct AtEnd<'a>(&'a Stop);

impl Drop for AtEnd<'_> {
    fn drop(&mut self) {
        self.0.request();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{RecvTimeoutError, channel};

    use super::*;

    #[test]
    fn who_waits_for_a_stop_is_woken() {
        let (stop, (awake, woken)) = (Stop::new(), channel::<()>());
        let late = awake.clone();
        stop.then(move || drop(awake));
        assert_eq!(woken.recv_timeout(Duration::ZERO), Err(RecvTimeoutError::Timeout));
        let other = stop.clone();
        std::thread::spawn(move || drop(other.at_end()));
        while !stop.requested() {
            std::thread::yield_now();
        }
        stop.then(move || drop(late));
        assert_eq!(woken.recv_timeout(Duration::from_secs(60)), Err(RecvTimeoutError::Disconnected));
    }
}
