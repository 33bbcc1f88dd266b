use std::time::{Duration, Instant};

/// Far longer than any test step takes, also on a loaded machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// Waits until `attempt` returns a value. After the timeout, the panic contains `what`.
pub(crate) fn eventually<T>(what: &str, attempt: impl FnMut() -> Option<T>) -> T {
    within(PATIENCE, what, attempt)
}

/// Like [`eventually`], with another timeout.
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
