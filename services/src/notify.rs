//! Tells systemd how the service is: ready, alive, stopping.

use sd_notify::NotifyState;

/// Tells systemd; without it (no `$NOTIFY_SOCKET`) this does nothing.
pub fn notify(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::debug!(%error, "systemd cannot be notified");
    }
}
