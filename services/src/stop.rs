//! A clean stop on ctrl-C and on a termination signal; one more, from somebody who has waited, ends at once.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::{flag, low_level};

/// The exit code of a process that a second signal ends.
pub const INTERRUPTED: u8 = 130;

/// Signals closer together are one wish to stop: `timeout` and terminals send theirs to a process and again to its group.
const ONE_WISH: Duration = Duration::from_millis(500);

/// Whether somebody has asked this process to stop.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// One that only [`Stop::request`] sets.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// One that SIGINT and SIGTERM set; a further signal half a second later or more ends the process with [`INTERRUPTED`].
    ///
    /// # Errors
    ///
    /// When the system refuses the handlers, or the thread that waits for further signals.
    pub fn on_signals() -> io::Result<Self> {
        let stop = Self::new();
        for signal in [SIGINT, SIGTERM] {
            flag::register(signal, Arc::clone(&stop.0))?;
        }
        let mut signals = Signals::new([SIGINT, SIGTERM])?;
        let wait = move || {
            let mut first = None;
            for _signal in &mut signals {
                if first.get_or_insert_with(Instant::now).elapsed() >= ONE_WISH {
                    low_level::exit(i32::from(INTERRUPTED));
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
}
