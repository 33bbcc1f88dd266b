//! Tells systemd how the service is: ready, alive, stopping.

use std::time::{Duration, Instant};

use sd_notify::NotifyState;

/// How often systemd hears that a process lives, at most. The units give it ten seconds.
const EVERY: Duration = Duration::from_secs(1);

/// Tells systemd; without it (no `$NOTIFY_SOCKET`) this does nothing.
pub fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "systemd cannot be notified");
    }
}

/// Tells systemd that this process lives, for loops that turn more often than it needs to hear that.
#[derive(Debug, Default)]
pub struct Watchdog {
    told: Option<Instant>,
}

impl Watchdog {
    /// The process lives at this moment.
    pub fn lives(&mut self) {
        if self.told.is_none_or(|told| told.elapsed() >= EVERY) {
            self.told = Some(Instant::now());
            notify(&[NotifyState::Watchdog]);
        }
    }
}
