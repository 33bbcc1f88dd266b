//! A rate limit with a burst, for the ports of `intake.rs` and the narrators' lines. Pure: time is an argument.

use std::time::Duration;

use crate::config::IntakeLimits;
use roomcast_core::ids::BootNs;

/// A token bucket.
#[derive(Debug, Clone)]
pub struct TokenBucket {
    limits: IntakeLimits,
    tokens: f64,
    refilled_ns: BootNs,
}

impl TokenBucket {
    /// A full bucket. A rate of 0 is no limit.
    #[must_use]
    pub fn full(limits: IntakeLimits, now_ns: BootNs) -> Self {
        Self { limits, tokens: limits.burst, refilled_ns: now_ns }
    }

    pub(crate) fn has_one(&mut self, now_ns: BootNs) -> bool {
        let IntakeLimits { rate_per_s, burst } = self.limits;
        if rate_per_s <= 0.0 {
            return true;
        }
        let since_s = now_ns.since(self.refilled_ns) as f64 / 1e9;
        self.tokens = (self.tokens + since_s * rate_per_s).min(burst);
        self.refilled_ns = now_ns;
        self.tokens >= 1.0
    }

    /// The wait for the next token, at least a nanosecond if there is none.
    pub fn wait(&mut self, now_ns: BootNs) -> Duration {
        if self.has_one(now_ns) {
            return Duration::ZERO;
        }
        let wait = Duration::try_from_secs_f64((1.0 - self.tokens) / self.limits.rate_per_s).unwrap_or(Duration::MAX);
        wait.max(Duration::from_nanos(1))
    }

    /// Takes a token, even if there is none.
    pub fn take(&mut self) {
        self.tokens -= 1.0;
    }
}
