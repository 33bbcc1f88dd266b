//! Staying awake for some time after a message: who owns a core may spend it on the microseconds that waking up takes.

use std::time::{Duration, Instant};

use roomcast_ipc::IpcError;

/// Waits for news, and for some time after the last message it looks again and again instead of sleeping.
#[derive(Debug)]
pub struct Awake {
    spin: Duration,
    /// Until when it does not sleep; none before the first message, and where it always sleeps.
    until: Option<Instant>,
}

impl Awake {
    /// Stays awake for so many microseconds after a message; 0 for never.
    #[must_use]
    pub fn new(spin_us: u64) -> Self {
        Self { spin: Duration::from_micros(spin_us), until: None }
    }

    /// There was a message.
    pub fn heard(&mut self) {
        self.until = (!self.spin.is_zero()).then(|| Instant::now() + self.spin);
    }

    /// Waits by `wait`, which sleeps for at most as long as it is told and says whether there was news, for at most `patience`.
    ///
    /// # Errors
    /// As `wait`.
    pub fn wait(
        &mut self,
        patience: Duration,
        mut wait: impl FnMut(Duration) -> Result<bool, IpcError>,
    ) -> Result<bool, IpcError> {
        let Some(until) = self.until else { return wait(patience) };
        let end = Instant::now() + patience;
        loop {
            if wait(Duration::ZERO)? {
                return Ok(true);
            }
            let now = Instant::now();
            if now >= end {
                return Ok(false);
            }
            if now >= until {
                self.until = None;
                return wait(end - now);
            }
            std::hint::spin_loop();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_looks_for_so_long_after_a_message_and_sleeps_then() {
        let (mut awake, patience) = (Awake::new(20_000), Duration::from_secs(9));
        let mut asked = Vec::new();
        let mut nothing = |own: &mut Awake| {
            asked.clear();
            let news = own.wait(patience, |left| {
                asked.push(left);
                Ok(!left.is_zero())
            });
            assert!(news.unwrap());
            asked.clone()
        };
        assert_eq!(nothing(&mut awake), [patience], "before the first message it sleeps at once");
        awake.heard();
        let looks = nothing(&mut awake);
        assert!(looks.len() > 10 && looks[..looks.len() - 1].iter().all(Duration::is_zero), "{looks:?}");
        assert!(looks.last().is_some_and(|left| (Duration::ZERO..patience).contains(left)));
        assert_eq!(nothing(&mut awake), [patience], "it stays asleep until the next message");
        awake.heard();
        assert!(awake.wait(patience, |_| Ok(true)).unwrap());
        assert!(!awake.wait(Duration::ZERO, |_| Ok(false)).unwrap());
    }

    #[test]
    fn without_a_time_it_always_sleeps() {
        let mut awake = Awake::new(0);
        awake.heard();
        let mut asked = 0;
        assert!(
            !awake
                .wait(Duration::from_millis(3), |left| {
                    asked += 1;
                    Ok(left.is_zero())
                })
                .unwrap()
        );
        assert_eq!(asked, 1);
    }
}
