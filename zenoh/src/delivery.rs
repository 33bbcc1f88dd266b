//! Tracks which of a hub's narrations one robot has, and which one is sent next. No I/O: the time is an argument.

use crate::wire::Confirmed;

/// Most narrations that are sent before the robot confirms the first.
const AHEAD_MAX: u64 = 64;
/// A robot that is silent for this long is away and gets no narration.
const AWAY_NS: u64 = 5_000_000_000;
/// The narration that the robot waits for is sent again after this time.
const AGAIN_NS: u64 = 1_000_000_000;

/// The state of one robot.
#[derive(Debug, Clone, Default)]
pub struct Delivery {
    /// The robot's daemon has processed everything up to this number.
    confirmed: u64,
    /// The last number that was sent.
    sent: u64,
    /// The last number that this start sent, or that earlier starts may have sent.
    given: u64,
    /// The last number in order that the robot reported.
    has: u64,
    /// When the awaited number was sent, or its predecessor was received. Numbers sent beyond it do not count.
    waits_ns: Option<u64>,
    heard_ns: Option<u64>,
    /// Numbers up to this one are no longer kept.
    gone: u64,
    /// Narrations that were given up before the robot had them, or with numbers that it had for other ones.
    lost: u64,
    /// The refusals in the robot's last report; `None` before the first one.
    said_refused: Option<u64>,
    /// Narrations that it refused since this start.
    refused: u64,
}

impl Delivery {
    /// Begins at `first`, the first number that is kept. Earlier ones up to `confirmed` have arrived; the others were given up. `last` is the last
    /// number of earlier starts.
    #[must_use]
    pub fn from(first: u64, last: u64, confirmed: u64) -> Self {
        let gone = first.saturating_sub(1);
        Self { confirmed: confirmed.min(gone), sent: gone, given: last, has: gone, gone, ..Self::default() }
    }

    /// Records that earlier starts may have sent numbers up to `last`, as a robot reports.
    pub fn given_before(&mut self, last: u64) {
        self.given = self.given.max(last);
    }

    /// Handles a robot's report. `epoch` is the hub's own, `last` the hub's last number.
    pub fn hear(&mut self, said: Confirmed, epoch: u64, last: u64, now_ns: u64) {
        self.heard_ns = Some(now_ns);
        let may_repeat = self.waits_ns.is_none_or(|waits_ns| now_ns.saturating_sub(waits_ns) >= AGAIN_NS);
        if said.epoch.0 != epoch {
            // The robot does not know this epoch: unconfirmed narrations are sent again.
            self.has = self.begin();
            if may_repeat {
                self.sent = self.begin();
            }
            return;
        }
        self.confirmed = self.confirmed.max(said.confirmed.min(last));
        // Refusals before this start were counted then. A restarted bridge counts from 0.
        let before = self.said_refused.unwrap_or(if self.waits_ns.is_none() { said.refused } else { 0 });
        let more = said.refused.checked_sub(before).unwrap_or(said.refused);
        (self.said_refused, self.refused) = (Some(said.refused), self.refused.saturating_add(more).min(last));
        let has = said.next.saturating_sub(1).min(last);
        // The robot has these numbers for other narrations, from before this start.
        self.lost = self.lost.saturating_add(has.saturating_sub(self.given));
        self.given = self.given.max(has);
        if has > self.has {
            // The next awaited number may follow at once.
            self.waits_ns = Some(now_ns);
        } else if may_repeat {
            self.sent = has;
        }
        self.has = has;
        self.sent = self.sent.max(has).max(self.begin());
    }

    /// Gives up narrations before `first`.
    pub fn give_up_before(&mut self, first: u64) {
        let gone = first.saturating_sub(1);
        self.lost += gone.saturating_sub(self.begin());
        self.gone = self.gone.max(gone);
        self.sent = self.sent.max(self.gone);
    }

    /// The next number to send, up to `last`; `None` if nothing may be sent now.
    #[must_use]
    pub fn next(&self, last: u64, now_ns: u64) -> Option<u64> {
        let there = !self.is_away(now_ns);
        let next = self.sent + 1;
        (there && next <= last && next - self.begin() <= AHEAD_MAX).then_some(next)
    }

    /// Records that the next number was sent.
    pub fn sent(&mut self, now_ns: u64) {
        if self.sent <= self.has.max(self.begin()) {
            self.waits_ns = Some(now_ns);
        }
        self.sent += 1;
        self.given = self.given.max(self.sent);
    }

    /// The first number that the robot can still get.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.begin() + 1
    }

    /// Numbers up to this one are not sent again.
    #[must_use]
    pub fn begin(&self) -> u64 {
        self.confirmed.max(self.gone)
    }

    /// Numbers up to this one are confirmed.
    #[must_use]
    pub fn confirmed(&self) -> u64 {
        self.confirmed
    }

    /// Whether the robot was ever heard.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.heard_ns.is_some()
    }

    /// Whether the robot has been silent too long.
    #[must_use]
    pub fn is_away(&self, now_ns: u64) -> bool {
        self.heard_ns.is_none_or(|heard_ns| now_ns.saturating_sub(heard_ns) > AWAY_NS)
    }

    /// Narrations that were given up before the robot had them, or with numbers that it had for other ones.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Narrations that the robot or its daemon refused since this start.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::relay::{Offered, Relay};
    use crate::wire::Hex;
    use roomcast_ipc::raw::{IncludedV1, NarrationV1, RoomScoresV1};
    use roomcast_ipc::sequence;

    const S: u64 = 1_000_000_000;

    fn message(epoch: u64, sequence: u64) -> NarrationV1 {
        let source = sequence::source_of_name("hub");
        NarrationV1 { source, epoch, sequence, ..NarrationV1::new(0, "They sit.").unwrap() }
    }

    /// Scores of a daemon that has accepted everything up to this number.
    fn accepted(epoch: u64, sequence: u64) -> RoomScoresV1 {
        let mut scores = RoomScoresV1 { source_count: 1, ..Default::default() };
        let source = sequence::source_of_name("hub");
        scores.included[0] = IncludedV1 { source, epoch, sequence, accepted: sequence, ..Default::default() };
        scores
    }

    fn give(delivery: &mut Delivery, relay: &mut Relay, last: u64, now_ns: u64) {
        while let Some(number) = delivery.next(last, now_ns) {
            relay.offer(7, number, delivery.first(), Some(message(7, number)));
            delivery.sent(now_ns);
        }
        while relay.send(now_ns).is_some() {}
    }

    #[test]
    fn nobody_is_sent_to_who_is_away() {
        let mut delivery = Delivery::default();
        assert_eq!(delivery.next(10, S), None);
        delivery.hear(Confirmed::default(), 7, 10, S);
        assert_eq!(delivery.next(10, S), Some(1));
        assert_eq!(delivery.next(10, 7 * S), None);
    }

    #[test]
    fn a_robot_that_lies_harms_itself_alone() {
        let mut delivery = Delivery::default();
        let lie = Confirmed { epoch: Hex(7), next: u64::MAX, confirmed: u64::MAX, refused: 0 };
        delivery.hear(lie, 7, 10, S);
        assert_eq!((delivery.confirmed(), delivery.next(10, S), delivery.next(11, S)), (10, None, Some(11)));
        delivery.hear(Confirmed { epoch: Hex(7), next: 0, confirmed: 0, refused: 0 }, 7, 10, 9 * S);
        assert_eq!(delivery.next(11, 9 * S), Some(11));
    }

    #[test]
    fn what_is_not_kept_is_given_up_and_counted() {
        let mut delivery = Delivery::default();
        delivery.give_up_before(4);
        delivery.hear(Confirmed::default(), 7, 10, S);
        assert_eq!((delivery.lost(), delivery.next(10, S), delivery.first(), delivery.confirmed()), (3, Some(4), 4, 0));
        delivery.give_up_before(6);
        assert_eq!((delivery.lost(), delivery.first()), (5, 6));
        // A hub loses nothing by a restart.
        let mut delivery = Delivery::from(4124, 4130, 4000);
        delivery.give_up_before(4124);
        assert_eq!((delivery.lost(), delivery.confirmed(), delivery.first()), (0, 4000, 4124));
    }

    /// The disk lost the numbers 8 to 10, which a robot has. The hub gave out 8 and 9 again before it heard the robot.
    #[test]
    fn a_number_that_a_robot_had_for_something_else_is_lost_and_not_confirmed() {
        let said = Confirmed { epoch: Hex(7), next: 11, confirmed: 10, refused: 0 };
        let mut delivery = Delivery::from(1, 7, 0);
        delivery.hear(said, 7, 9, S);
        assert_eq!(delivery.lost(), 2);
        delivery.given_before(10);
        delivery.hear(said, 7, 10, S);
        assert_eq!((delivery.lost(), delivery.next(11, S)), (2, Some(11)));
        // If the robot is heard first, no number is given out twice.
        let mut delivery = Delivery::from(1, 7, 0);
        delivery.hear(said, 7, 7, S);
        delivery.given_before(10);
        delivery.hear(said, 7, 11, S);
        assert_eq!((delivery.lost(), delivery.next(11, S)), (0, Some(11)));
    }

    #[test]
    fn what_a_robot_refuses_is_counted_once() {
        let said = |refused| Confirmed { epoch: Hex(7), next: 5, confirmed: 4, refused };
        let mut delivery = Delivery::from(3, 10, 2);
        // A count from before this start, a higher one, the same again, and one of a restarted bridge.
        for (refused, so_far) in [(2, 0), (3, 1), (3, 1), (1, 2), (u64::MAX, 10)] {
            delivery.hear(said(refused), 7, 10, S);
            assert_eq!(delivery.refused(), so_far);
        }
        // A robot that did not know this start has refused nothing before.
        let mut delivery = Delivery::default();
        delivery.hear(Confirmed::default(), 7, 10, S);
        delivery.sent(S);
        delivery.hear(said(2), 7, 10, S);
        assert_eq!(delivery.refused(), 2);
    }

    /// The link loses one message in n, and the bridge is away for two seconds, while lines come one by one. New lines must not postpone a resend.
    #[test]
    fn a_line_is_late_by_three_seconds_however_lines_are_spaced() {
        for (gap_ms, loses) in
            [50, 250, 500, 900, 1_100, 3_000].into_iter().flat_map(|gap| [101, 1_009, 10_000].map(|n| (gap, n)))
        {
            let (mut delivery, mut relay) = (Delivery::default(), Relay::new("hub", 1e9));
            let (mut sent, mut taken, mut said, mut said_ns) = (0_u64, 0, Confirmed::default(), 0);
            for tick in 0..6_000 {
                let now_ns = S + tick * 20_000_000;
                let written_ns = |number: u64| S + (number - 1) * gap_ms * 1_000_000;
                let last = 1 + (now_ns - S) / (gap_ms * 1_000_000);
                let is_away = (31 * S..33 * S).contains(&now_ns);
                if is_away {
                    relay = Relay::new("hub", 1e9);
                }
                while let Some(number) = delivery.next(last, now_ns) {
                    sent += 1;
                    if !is_away && sent % loses != 0 {
                        relay.offer(7, number, delivery.first(), Some(message(7, number)));
                    }
                    delivery.sent(now_ns);
                }
                while let Some(message) = relay.send(now_ns) {
                    if message.sequence > taken {
                        taken = message.sequence;
                        let late_ns = now_ns - written_ns(taken);
                        assert!(late_ns <= 3 * S, "{gap_ms} ms, 1 of {loses} lost: {taken} is {late_ns} ns late");
                    }
                }
                if taken > 0 {
                    relay.confirm(&accepted(7, taken), now_ns);
                }
                // A bridge reports each change at once, and every second.
                if !is_away && (relay.confirmed() != said || now_ns - said_ns >= S) {
                    (said, said_ns) = (relay.confirmed(), now_ns);
                    delivery.hear(said, 7, last, now_ns);
                }
            }
            let last = 1 + 5_999 * 20 / gap_ms;
            assert!(last - taken <= 1 + 3_000 / gap_ms, "{gap_ms} ms, 1 of {loses} lost: {taken} of {last}");
        }
    }

    /// The daemon has more than the hub knows. Narrations that the hub then resends were processed before; they are not dropped.
    #[test]
    fn a_bridge_that_starts_again_tells_a_hub_that_lags_of_no_loss() {
        let (mut delivery, mut relay, mut now_ns) = (Delivery::default(), Relay::new("hub", 1e9), S);
        delivery.hear(relay.confirmed(), 7, 20, now_ns);
        give(&mut delivery, &mut relay, 20, now_ns);
        relay.confirm(&accepted(7, 20), now_ns);
        delivery.hear(relay.confirmed(), 7, 30, now_ns);
        assert_eq!((delivery.confirmed(), delivery.refused()), (20, 0));
        // Ten more reach the daemon, but the bridge ends before it reports them.
        give(&mut delivery, &mut relay, 30, now_ns);
        // Its successor first hears either the daemon or the hub.
        for daemon_first in [true, false] {
            let (mut delivery, mut relay) = (delivery.clone(), Relay::new("hub", 1e9));
            now_ns += 3 * S;
            if daemon_first {
                assert_eq!(relay.confirm(&accepted(7, 30), now_ns), 0);
            }
            delivery.hear(relay.confirmed(), 7, 40, now_ns);
            while let Some(number) = delivery.next(30, now_ns) {
                relay.offer(7, number, delivery.first(), Some(message(7, number)));
                delivery.sent(now_ns);
            }
            assert_eq!(relay.confirm(&accepted(7, 30), now_ns), 0);
            give(&mut delivery, &mut relay, 30, now_ns);
            assert_eq!(relay.confirm(&accepted(7, 30), now_ns), 0);
            delivery.hear(relay.confirmed(), 7, 40, now_ns);
            assert_eq!((delivery.confirmed(), delivery.refused()), (30, 0), "{daemon_first}");
            // New narrations that the daemon drops still count.
            give(&mut delivery, &mut relay, 40, now_ns);
            let mut scores = accepted(7, 40);
            scores.included[0].accepted = 38;
            assert_eq!(relay.confirm(&scores, now_ns), 2, "{daemon_first}");
            delivery.hear(relay.confirmed(), 7, 40, now_ns);
            assert_eq!((delivery.confirmed(), delivery.refused()), (40, 2));
        }
    }

    /// The link loses and delays, bridge and hub restart, and the daemon confirms late. The generator is plain, so that a seed names a run.
    #[test]
    fn whatever_the_link_does_everything_arrives_once_and_in_order() {
        for seed in 1..200_u64 {
            let mut state = seed;
            let mut random = |below: u64| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) % below
            };
            let (epoch, last) = (7, 300);
            let (mut delivery, mut relay) = (Delivery::default(), Relay::new("hub", 1e9));
            let mut taken = Vec::<u64>::new();
            let mut on_the_way = std::collections::VecDeque::<(u64, u64)>::new();
            let mut answers = std::collections::VecDeque::<Confirmed>::new();
            let source = sequence::source_of_name("hub");
            let mut now_ns = S;
            let mut rounds = 0;
            while delivery.confirmed() < last {
                rounds += 1;
                assert!(rounds < 100_000, "seed {seed} does not end");
                now_ns += 20_000_000 + random(200_000_000);
                match random(200) {
                    0 => delivery = Delivery::default(),
                    1 => relay = Relay::new("hub", 1e9),
                    2 => on_the_way.clear(),
                    3 => answers.clear(),
                    _ => {}
                }
                while let Some(number) = delivery.next(last, now_ns) {
                    if random(10) > 0 {
                        on_the_way.push_back((number, delivery.first()));
                    }
                    delivery.sent(now_ns);
                }
                for _ in 0..random(40) {
                    let Some((number, first)) = on_the_way.pop_front() else { break };
                    let message = message(epoch, number);
                    if relay.offer(epoch, number, first, Some(message)) == Offered::Taken && random(10) == 0 {
                        // A link may duplicate a message.
                        assert_eq!(relay.offer(epoch, number, first, Some(message)), Offered::Again);
                    }
                }
                while let Some(message) = relay.send(now_ns) {
                    // The daemon takes each number once.
                    if taken.last().is_none_or(|newest| message.sequence > *newest) {
                        taken.push(message.sequence);
                    }
                }
                if random(3) == 0
                    && let Some(newest) = taken.last()
                {
                    let mut scores = RoomScoresV1 { source_count: 1, ..Default::default() };
                    let accepted = taken.len() as u64;
                    scores.included[0] =
                        IncludedV1 { source, epoch, sequence: *newest, accepted, ..Default::default() };
                    relay.confirm(&scores, now_ns);
                }
                answers.push_back(relay.confirmed());
                while answers.len() > random(5) as usize {
                    let Some(said) = answers.pop_front() else { break };
                    delivery.hear(said, epoch, last, now_ns);
                }
            }
            assert!(taken.iter().copied().eq(1..=last), "seed {seed}: {taken:?}");
        }
    }
}
