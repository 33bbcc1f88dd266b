//! When answers are prepared: after a silence, at a share of a core, and not for a while where one takes longer than an event may wait. Pure:
//! time comes in as a number.

/// Silence before answers are prepared: a burst of narration is not held up by them.
const QUIET_NS: u64 = 50_000_000;
/// An event that comes meanwhile waits for a step's end: a longer one is slow.
const SLOW_NS: u64 = 5_000_000;
/// So many slow answers in a row are no accident of a busy machine.
const SLOW_ANSWERS_MAX: u32 = 8;
/// One step of so long is enough.
const FAR_TOO_SLOW_NS: u64 = 50_000_000;
/// Nothing is prepared for so long then, and twice as long each time after it, at most an hour.
const PAUSE_NS: u64 = 60_000_000_000;
const PAUSE_NS_MAX: u64 = 3_600_000_000_000;

/// When the next step of preparation is due.
#[derive(Debug)]
pub(super) struct Pace {
    at_ns: u64,
    /// What this may take of a core.
    share: f64,
    /// Slow answers in a row.
    slow: u32,
    pause_ns: u64,
    /// Until when the last pause lasts.
    paused_until_ns: u64,
}

impl Pace {
    pub(super) fn new(share: f64) -> Self {
        Self { at_ns: 0, share, slow: 0, pause_ns: PAUSE_NS, paused_until_ns: 0 }
    }

    /// When the next step is due.
    pub(super) fn at_ns(&self) -> u64 {
        self.at_ns
    }

    /// For how long from now there is a pause.
    pub(super) fn pauses_for_ns(&self, now_ns: u64) -> u64 {
        self.paused_until_ns.saturating_sub(now_ns)
    }

    /// There was narration: silence comes first.
    pub(super) fn after_event(&mut self, now_ns: u64) {
        self.at_ns = self.at_ns.max(now_ns.saturating_add(QUIET_NS));
    }

    /// A step has ended, with an answer or with something else. Gives for how long there is none from now on, where steps are too slow.
    pub(super) fn took(&mut self, took_ns: u64, is_answer: bool, end_ns: u64) -> Option<u64> {
        self.at_ns = end_ns.saturating_add((took_ns as f64 * (1.0 / self.share - 1.0)) as u64);
        let is_far_too_slow = took_ns > FAR_TOO_SLOW_NS;
        if !is_answer && !is_far_too_slow {
            return None;
        }
        if took_ns <= SLOW_NS {
            (self.slow, self.pause_ns) = (0, PAUSE_NS);
            return None;
        }
        self.slow += 1;
        if self.slow < SLOW_ANSWERS_MAX && !is_far_too_slow {
            return None;
        }
        // After the pause one more that is slow is enough.
        self.slow = SLOW_ANSWERS_MAX - 1;
        let pause_ns = self.pause_ns;
        self.pause_ns = (2 * pause_ns).min(PAUSE_NS_MAX);
        self.at_ns = end_ns.saturating_add(pause_ns);
        self.paused_until_ns = self.at_ns;
        Some(pause_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn slow_answers_end_preparing_for_a_while_also_with_events_between() {
        let mut pace = Pace::new(0.25);
        for number in 0..7 {
            assert_eq!(pace.took(6_000_000, true, S), None, "{number}");
            pace.after_event(S);
            // A plan.
            assert_eq!(pace.took(100_000, false, S), None);
        }
        assert_eq!(pace.took(6_000_000, true, 2 * S), Some(PAUSE_NS));
        pace.after_event(3 * S);
        assert_eq!(pace.at_ns(), 2 * S + PAUSE_NS, "an event does not end the pause");
        assert_eq!([3 * S, 2 * S + PAUSE_NS].map(|now_ns| pace.pauses_for_ns(now_ns)), [PAUSE_NS - S, 0]);
        assert_eq!(pace.took(6_000_000, true, 100 * S), Some(2 * PAUSE_NS));
        assert_eq!(pace.took(1_000_000, true, 300 * S), None);
        assert_eq!(pace.at_ns(), 300 * S + 3_000_000, "a quarter of a core");
        for _ in 0..7 {
            assert_eq!(pace.took(6_000_000, true, 300 * S), None);
        }
        assert_eq!(pace.took(6_000_000, true, 300 * S), Some(PAUSE_NS), "one that was fast begins the count again");
    }

    #[test]
    fn one_answer_or_plan_that_is_far_too_slow_is_enough() {
        let mut pauses = vec![Pace::new(1.0).took(S, true, 0), Pace::new(1.0).took(S, false, 0)];
        let mut pace = Pace::new(1.0);
        pauses.extend((0..9).map(|_| pace.took(S, true, 0)));
        let minutes = |n: u64| Some(n * PAUSE_NS);
        assert_eq!(pauses, [1, 1, 1, 2, 4, 8, 16, 32, 60, 60, 60].map(minutes));
    }

    #[test]
    fn an_event_is_followed_by_silence() {
        let mut pace = Pace::new(0.25);
        pace.after_event(S);
        assert_eq!(pace.at_ns(), S + QUIET_NS);
    }
}
