//! A clean stop on SIGINT or SIGTERM, as in the robot's programs. A second signal ends the process at once.

use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM, SIGXFSZ};
use signal_hook::flag;
use signal_hook::low_level::{self, pipe};

/// Signals closer together are one request: `timeout` and terminals signal a process and then its group.
const SAME_REQUEST: Duration = Duration::from_millis(500);
/// The exit code after a second request.
const SECOND: i32 = 130;

/// Whether this process was asked to stop.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Set by SIGINT and SIGTERM. A further signal, half a second later or more, ends the process at once.
    ///
    /// # Errors
    ///
    /// When the system refuses the handlers, or the thread that waits for further signals.
    pub fn on_signals() -> io::Result<Self> {
        let stop = Self::default();
        // Without a handler, the signal for a reached file size limit would end the process. With one, the write fails as on a full disk.
        flag::register(SIGXFSZ, Arc::default())?;
        let (mut signals, given) = UnixStream::pair()?;
        for signal in [SIGINT, SIGTERM] {
            flag::register(signal, Arc::clone(&stop.0))?;
            pipe::register(signal, given.try_clone()?)?;
        }
        let wait = move || {
            // Kept open, so that reading never hits the end of the stream.
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
