//! Polls for some time after a message, since waking up takes microseconds.

use std::time::{Duration, Instant};

use roomcast_ipc::IpcError;

/// Waits for news. For some time after a message it polls instead of sleeping.
#[derive(Debug)]
pub struct Awake {
    spin: Duration,
    /// The end of the polling; `None` while it sleeps.
    until: Option<Instant>,
}

impl Awake {
    /// Polls for so many microseconds after a message; 0 for never.
    #[must_use]
    pub fn new(spin_us: u64) -> Self {
        Self { spin: Duration::from_micros(spin_us), until: None }
    }

    /// Notes a message.
    pub fn heard(&mut self) {
        self.until = (!self.spin.is_zero()).then(|| Instant::now() + self.spin);
    }

    /// Calls `wait` until there is news, for at most `patience`. `wait` sleeps for at most its argument and returns whether there was news.
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
            // The message may come from a process that waits for this core.
            std::thread::yield_now();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_looks_for_so_long_after_a_message_and_sleeps_then() {
        let (mut awake, patience) = (Awake::new(200_000), Duration::from_secs(9));
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
