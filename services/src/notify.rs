//! Notifies systemd that the service is ready, alive, or stopping.

use std::time::{Duration, Instant};

use sd_notify::NotifyState;

/// The shortest interval of watchdog messages. The units allow ten seconds.
const EVERY: Duration = Duration::from_secs(1);

/// Notifies systemd; without it (no `$NOTIFY_SOCKET`) this does nothing.
pub fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "systemd cannot be notified");
    }
}

/// The watchdog of systemd, for loops that turn more often than it needs.
#[derive(Debug, Default)]
pub struct Watchdog {
    told: Option<Instant>,
}

impl Watchdog {
    /// Reports that the process is alive.
    pub fn lives(&mut self) {
        if self.told.is_none_or(|told| told.elapsed() >= EVERY) {
            self.told = Some(Instant::now());
            notify(&[NotifyState::Watchdog]);
        }
    }
}
