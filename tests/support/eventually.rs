//! Waits for what another process or thread does.

use std::time::{Duration, Instant};

/// Far longer than anything takes here, also on a loaded machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// Waits until an attempt gives something. `what` names it in the report when it does not come.
pub(crate) fn eventually<T>(what: &str, attempt: impl FnMut() -> Option<T>) -> T {
    within(PATIENCE, what, attempt)
}

/// As [`eventually`], with a patience of its own.
pub(crate) fn within<T>(patience: Duration, what: &str, mut attempt: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = attempt() {
            return value;
        }
        assert!(start.elapsed() < patience, "not within {patience:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
