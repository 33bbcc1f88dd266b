//! How far one robot has a hub's narration, and what is sent to it next. Pure: time comes in as a number.

use crate::wire::Confirmed;

/// Narrations that are sent ahead of what the robot has confirmed.
const AHEAD_MAX: u64 = 64;
/// A robot that says nothing for so long is away, and nothing is sent to it.
const AWAY_NS: u64 = 5_000_000_000;
/// What the robot waits for is sent again after so long.
const AGAIN_NS: u64 = 1_000_000_000;

/// One robot.
#[derive(Debug, Clone, Default)]
pub struct Delivery {
    /// Up to here the robot's daemon has dealt with everything.
    confirmed: u64,
    /// Up to here it was sent.
    sent: u64,
    /// Up to here it was sent by this start, or can have been by those before it.
    given: u64,
    /// Up to here the robot has it, as it said last.
    has: u64,
    /// When the number that it waits for was sent, or the one before it came. What is sent beyond it says nothing of it.
    waits_ns: Option<u64>,
    heard_ns: Option<u64>,
    /// Up to here nothing is kept any more.
    gone: u64,
    /// Narrations that were given up before the robot had them, or whose numbers it had for others.
    lost: u64,
    /// What the robot has refused, as it said last; none until it has said so.
    said_refused: Option<u64>,
    /// Narrations that it has refused since this start.
    refused: u64,
}

impl Delivery {
    /// Begins with the first number that is kept: what was before it has come, as far as it is `confirmed`, or was given up before this start.
    /// `last` is the last one that was given before it.
    #[must_use]
    pub fn from(first: u64, last: u64, confirmed: u64) -> Self {
        let gone = first.saturating_sub(1);
        Self { confirmed: confirmed.min(gone), sent: gone, given: last, has: gone, gone, ..Self::default() }
    }

    /// Numbers up to this one can have been sent before this start, as a robot says.
    pub fn given_before(&mut self, last: u64) {
        self.given = self.given.max(last);
    }

    /// Takes note of what the robot says: `epoch` is the hub's own, `last` the last number that it has.
    pub fn hear(&mut self, said: Confirmed, epoch: u64, last: u64, now_ns: u64) {
        self.heard_ns = Some(now_ns);
        let may_repeat = self.waits_ns.is_none_or(|waits_ns| now_ns.saturating_sub(waits_ns) >= AGAIN_NS);
        if said.epoch.0 != epoch {
            // It knows nothing of this start: whatever it has not confirmed goes again.
            self.has = self.begin();
            if may_repeat {
                self.sent = self.begin();
            }
            return;
        }
        self.confirmed = self.confirmed.max(said.confirmed.min(last));
        // What it refused before this start was counted then; of a bridge that starts again it is counted from 0.
        let before = self.said_refused.unwrap_or(if self.waits_ns.is_none() { said.refused } else { 0 });
        let more = said.refused.checked_sub(before).unwrap_or(said.refused);
        (self.said_refused, self.refused) = (Some(said.refused), self.refused.saturating_add(more).min(last));
        let has = said.next.saturating_sub(1).min(last);
        // It had these numbers before this start gave them to something else, which it has not.
        self.lost = self.lost.saturating_add(has.saturating_sub(self.given));
        self.given = self.given.max(has);
        if has > self.has {
            // What it waits for now may be right behind what came.
            self.waits_ns = Some(now_ns);
        } else if may_repeat {
            self.sent = has;
        }
        self.has = has;
        self.sent = self.sent.max(has).max(self.begin());
    }

    /// What is older than `first` is not kept any more.
    pub fn give_up_before(&mut self, first: u64) {
        let gone = first.saturating_sub(1);
        self.lost += gone.saturating_sub(self.begin());
        self.gone = self.gone.max(gone);
        self.sent = self.sent.max(self.gone);
    }

    /// The number that is to be sent next, up to `last`; none where nothing may go now.
    #[must_use]
    pub fn next(&self, last: u64, now_ns: u64) -> Option<u64> {
        let there = !self.is_away(now_ns);
        let next = self.sent + 1;
        (there && next <= last && next - self.begin() <= AHEAD_MAX).then_some(next)
    }

    /// Takes note that the next one was sent.
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

    /// Up to here nothing is sent any more.
    #[must_use]
    pub fn begin(&self) -> u64 {
        self.confirmed.max(self.gone)
    }

    /// Up to here it is confirmed.
    #[must_use]
    pub fn confirmed(&self) -> u64 {
        self.confirmed
    }

    /// Whether it was ever heard.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.heard_ns.is_some()
    }

    /// Whether it was silent for long.
    #[must_use]
    pub fn is_away(&self, now_ns: u64) -> bool {
        self.heard_ns.is_none_or(|heard_ns| now_ns.saturating_sub(heard_ns) > AWAY_NS)
    }

    /// Narrations that were given up before the robot had them, or whose numbers it had for others.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Narrations that the robot or its daemon has refused since this start.
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
    use roomcast_ipc::{IncludedV1, NarrationV1, RoomScoresV1, sequence};

    const S: u64 = 1_000_000_000;

    fn message(epoch: u64, sequence: u64) -> NarrationV1 {
        let source = sequence::source_of_name("hub");
        NarrationV1 { source, epoch, sequence, ..NarrationV1::new(0, "They sit.").unwrap() }
    }

    /// A daemon that has accepted everything up to this number.
    fn accepted(epoch: u64, sequence: u64) -> RoomScoresV1 {
        let mut scores = RoomScoresV1 { source_count: 1, ..Default::default() };
        let source = sequence::source_of_name("hub");
        scores.included[0] = IncludedV1 { source, epoch, sequence, accepted: sequence, ..Default::default() };
        scores
    }

    /// Sends what may go over a link that loses nothing.
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
        // A hub that starts again has lost nothing by that.
        let mut delivery = Delivery::from(4124, 4130, 4000);
        delivery.give_up_before(4124);
        assert_eq!((delivery.lost(), delivery.confirmed(), delivery.first()), (0, 4000, 4124));
    }

    /// The disk has lost the numbers 8 to 10 that a robot has, and 8 and 9 were given again before it was heard.
    #[test]
    fn a_number_that_a_robot_had_for_something_else_is_lost_and_not_confirmed() {
        let said = Confirmed { epoch: Hex(7), next: 11, confirmed: 10, refused: 0 };
        let mut delivery = Delivery::from(1, 7, 0);
        delivery.hear(said, 7, 9, S);
        assert_eq!(delivery.lost(), 2);
        delivery.given_before(10);
        delivery.hear(said, 7, 10, S);
        assert_eq!((delivery.lost(), delivery.next(11, S)), (2, Some(11)));
        // Heard before anything was given again, nothing is.
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
        // From before this start; then some, the same again, and a bridge that starts again.
        for (refused, so_far) in [(2, 0), (3, 1), (3, 1), (1, 2), (u64::MAX, 10)] {
            delivery.hear(said(refused), 7, 10, S);
            assert_eq!(delivery.refused(), so_far);
        }
        // One that knew nothing of this start has refused nothing of it before.
        let mut delivery = Delivery::default();
        delivery.hear(Confirmed::default(), 7, 10, S);
        delivery.sent(S);
        delivery.hear(said(2), 7, 10, S);
        assert_eq!(delivery.refused(), 2);
    }

    /// A link that loses one message of some, and a bridge that is away for two seconds, while lines come one by one. New lines must not put
    /// off giving again what was lost.
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
                // As a bridge does: at once when it is another word, and every second.
                if !is_away && (relay.confirmed() != said || now_ns - said_ns >= S) {
                    (said, said_ns) = (relay.confirmed(), now_ns);
                    delivery.hear(said, 7, last, now_ns);
                }
            }
            let last = 1 + 5_999 * 20 / gap_ms;
            assert!(last - taken <= 1 + 3_000 / gap_ms, "{gap_ms} ms, 1 of {loses} lost: {taken} of {last}");
        }
    }

    /// The daemon has more than the hub has heard of: what the hub then sends again was dealt with before, and is not dropped.
    #[test]
    fn a_bridge_that_starts_again_tells_a_hub_that_lags_of_no_loss() {
        let (mut delivery, mut relay, mut now_ns) = (Delivery::default(), Relay::new("hub", 1e9), S);
        delivery.hear(relay.confirmed(), 7, 20, now_ns);
        give(&mut delivery, &mut relay, 20, now_ns);
        relay.confirm(&accepted(7, 20), now_ns);
        delivery.hear(relay.confirmed(), 7, 30, now_ns);
        assert_eq!((delivery.confirmed(), delivery.refused()), (20, 0));
        // Ten more reach the daemon, and the bridge ends before it can say so.
        give(&mut delivery, &mut relay, 30, now_ns);
        // Its successor hears the daemon first; or the hub first, of which it has given the daemon nothing yet.
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
            // What it drops of those that are new still counts.
            give(&mut delivery, &mut relay, 40, now_ns);
            let mut scores = accepted(7, 40);
            scores.included[0].accepted = 38;
            assert_eq!(relay.confirm(&scores, now_ns), 2, "{daemon_first}");
            delivery.hear(relay.confirmed(), 7, 40, now_ns);
            assert_eq!((delivery.confirmed(), delivery.refused()), (40, 2));
        }
    }

    /// A link that loses and delays, a bridge and a hub that start again, and a daemon that confirms late: everything arrives once and in
    /// order. The random numbers are a plain generator, so that a seed names a run.
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
                        // The same again, as a link may do.
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
