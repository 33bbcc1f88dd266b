//! A clean stop on ctrl-C and on a termination signal; one more, from somebody who has waited, ends at once. As the robot's programs do.

use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;
use signal_hook::low_level::{self, pipe};

/// Signals closer together are one request: `timeout` and terminals send theirs to a process and again to its group.
const SAME_REQUEST: Duration = Duration::from_millis(500);
/// The exit code after a second request.
const SECOND: i32 = 130;

/// Whether somebody has asked this process to stop.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// One that SIGINT and SIGTERM set; a further signal half a second later or more ends the process at once.
    ///
    /// # Errors
    ///
    /// When the system refuses the handlers, or the thread that waits for further signals.
    pub fn on_signals() -> io::Result<Self> {
        let stop = Self::default();
        // Where a limit on files' sizes is reached the call fails, as on a full disk; without a handler the signal would end the process.
        flag::register(SIGXFSZ, Arc::default())?;
        // A byte for each signal.
        let (mut signals, given) = UnixStream::pair()?;
        for signal in [SIGINT, SIGTERM] {
            flag::register(signal, Arc::clone(&stop.0))?;
            pipe::register(signal, given.try_clone()?)?;
        }
        let wait = move || {
            // Kept, so that there is an end to read from whatever becomes of the handlers.
            let _given = given;
            let mut first = None;
            loop {
                if signals.read_exact(&mut [0]).is_err() {
                    std::thread::sleep(SAME_REQUEST);
                } else if first.get_or_insert_with(Instant::now).elapsed() >= SAME_REQUEST {
                    low_level::exit(SECOND);
                }
            }
        };
        std::thread::Builder::new().name("signals".to_owned()).spawn(wait)?;
        Ok(stop)
    }

    /// Asks to stop.
    pub fn request(&self) {
        self.0.store(true, Ordering::SeqCst);
    }

    /// Whether it was asked.
    #[must_use]
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }

    /// Asks to stop when it is dropped: whatever a thread ends by, also a panic, the others end with it.
    #[must_use]
    pub fn at_end(&self) -> AtEnd<'_> {
        AtEnd(self)
    }
}

/// What [`Stop::at_end`] gives.
#[derive(Debug)]
pub struct AtEnd<'a>(&'a Stop);

impl Drop for AtEnd<'_> {
    fn drop(&mut self) {
        self.0.request();
    }
}
