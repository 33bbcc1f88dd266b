//! One complaint in a while, and how many were held back.

/// Nanoseconds between two.
const QUIET_NS: u64 = 5_000_000_000;

/// Lets one message through and counts the others.
#[derive(Debug, Default)]
pub struct Limiter {
    next_ns: u64,
    held: u64,
}

impl Limiter {
    /// Whether to log now, and then how many were held back since the last.
    pub fn pass(&mut self, now_ns: u64) -> Option<u64> {
        if now_ns < self.next_ns {
            self.held += 1;
            return None;
        }
        self.next_ns = now_ns + QUIET_NS;
        Some(std::mem::take(&mut self.held))
    }
}
