use std::time::{Duration, Instant};

/// Far longer than any test step takes, also on a loaded machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// Waits until `attempt` returns a value. After the timeout, the panic contains `what`.
pub(crate) fn eventually<T>(what: &str, attempt: impl FnMut() -> Option<T>) -> T {
    within(PATIENCE, what, attempt)
}

/// Like [`eventually`], with another timeout.
pub(crate) fn within<T>(patience: Duration, what: &str, attempt: impl FnMut() -> Option<T>) -> T {
    let value = waited(patience, attempt);
    assert!(value.is_some(), "not within {patience:?}: {what}");
    value.unwrap()
}

/// Like [`within`]; `None` after the timeout.
pub(crate) fn waited<T>(patience: Duration, mut attempt: impl FnMut() -> Option<T>) -> Option<T> {
    let start = Instant::now();
    loop {
        let value = attempt();
        if value.is_some() || start.elapsed() >= patience {
            return value;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}
