//! Checks that a broker still delivers messages: a broker that answers pings may have stopped.
//!
//! mosquitto up to 2.0.11 counts a message that is too large for the client against the receive maximum for ever. After 32 of them it
//! delivers no message of quality 1 over this connection. A new connection begins a new count.

use std::time::{Duration, Instant};

/// A retained message that mosquitto has and never changes. Each subscription to it delivers it in the same way as other messages.
pub(super) const TOPIC: &str = "$SYS/broker/version";
const SILENCE: Duration = Duration::from_secs(10);
/// The time for an answer, if the broker has answered probes before.
const ANSWER: Duration = Duration::from_secs(5);
pub(super) const SILENT: &str = "the broker delivers no messages any more: it did not answer a probe within 5 s. If devices publish messages above \
                                 16 MiB on topics of the rules, leave these topics out: some brokers drop each of them and then wait for its acknowledgement";

/// Decides when to probe a connection and when to give it up. Only a broker that has answered a probe is given up: another broker may lack the topic,
/// or refuse it to this client. Pure: time comes in.
#[derive(Debug)]
pub(super) struct Probe {
    /// The client must send a probe. Each connection begins with one, before any message can be too large.
    is_due: bool,
    asked: Option<Instant>,
    heard: Instant,
    answers: bool,
}

impl Probe {
    pub(super) fn new(now: Instant) -> Self {
        Self { is_due: false, asked: None, heard: now, answers: false }
    }

    pub(super) fn start(&mut self, now: Instant) {
        (self.is_due, self.asked, self.heard) = (true, None, now);
    }

    pub(super) fn stop(&mut self) {
        (self.is_due, self.asked) = (false, None);
    }

    /// Records a message of quality 1 or 2: the receive maximum limits these.
    pub(super) fn hear(&mut self, topic: &[u8], now: Instant) {
        (self.asked, self.heard) = (None, now);
        self.answers |= topic == TOPIC.as_bytes();
    }

    /// Whether to send a probe now. While the broker waits for acknowledgements (`is_busy`), it has a reason to be silent.
    pub(super) fn is_due(&mut self, is_busy: bool, now: Instant) -> bool {
        if is_busy {
            self.heard = now;
            self.asked = self.asked.map(|_| now);
        }
        let is_silent = now.saturating_duration_since(self.heard) >= SILENCE;
        self.is_due |= self.answers && self.asked.is_none() && is_silent;
        self.is_due
    }

    pub(super) fn sent(&mut self, now: Instant) {
        (self.is_due, self.asked) = (false, Some(now));
    }

    pub(super) fn is_unanswered(&self, now: Instant) -> bool {
        self.answers && self.asked.is_some_and(|asked| now.saturating_duration_since(asked) >= ANSWER)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(start: Instant, seconds: u64) -> Instant {
        start + Duration::from_secs(seconds)
    }

    #[test]
    fn a_silent_connection_is_probed_and_renewed_if_the_broker_has_answered_before() {
        let start = Instant::now();
        let mut probe = Probe::new(start);
        probe.start(start);
        assert!(probe.is_due(false, start), "a connection begins with a probe");
        probe.sent(start);
        probe.hear(TOPIC.as_bytes(), start);
        assert!(!probe.is_due(false, after(start, 9)) && probe.is_due(false, after(start, 10)));
        probe.sent(after(start, 10));
        assert!(!probe.is_unanswered(after(start, 14)) && probe.is_unanswered(after(start, 15)));
        probe.hear(b"home/step", after(start, 14));
        assert!(!probe.is_unanswered(after(start, 60)), "any message is an answer");
    }

    #[test]
    fn a_broker_that_never_answered_keeps_its_connection() {
        let start = Instant::now();
        let mut probe = Probe::new(start);
        probe.start(start);
        probe.sent(start);
        assert!(!probe.is_unanswered(after(start, 3_600)) && !probe.is_due(false, after(start, 3_600)));
    }

    #[test]
    fn a_broker_that_waits_for_acknowledgements_may_be_silent() {
        let start = Instant::now();
        let mut probe = Probe::new(start);
        probe.start(start);
        probe.sent(start);
        probe.hear(TOPIC.as_bytes(), start);
        assert!(!probe.is_due(true, after(start, 600)) && !probe.is_due(false, after(start, 609)));
        assert!(probe.is_due(false, after(start, 610)));
        probe.sent(after(start, 610));
        probe.is_due(true, after(start, 620));
        assert!(!probe.is_unanswered(after(start, 624)) && probe.is_unanswered(after(start, 625)));
    }
}
