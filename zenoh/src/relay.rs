//! One narrator's narration on its way to the daemon: accepted, sent, confirmed. No I/O: the time is an argument.
//!
//! A number is accepted once, directly after its predecessor. The narrator resends everything else from the expected number, so a link may lose and
//! repeat messages. Each start of a narrator has its own numbers: another sender with its name, such as a second hub, does not block it. If many
//! starts send at once, some wait until others are confirmed, since the daemon follows only a few.
//!
//! The daemon reports, for each start, the number up to which it has processed narrations, and how many of them it accepted. The others count as
//! refused, for instance a sentence that is too long for a window. If a relayed narrator exceeds its rate, the daemon stops at that number: the
//! narrations are sent again, at half the pace.

use std::collections::{BTreeSet, VecDeque};

use roomcast_ipc::raw::{IncludedV1, Message, NarrationV1, RoomScoresV1};
use roomcast_ipc::sequence;

// By `super`, so that the daemon's tests can include this file.
use super::delay::Delay;
use super::wire::{Confirmed, Hex};

/// Most narrations that the daemon has not confirmed: the service's history holds as many for a restarted daemon.
pub const UNDER_WAY_MAX: usize = NarrationV1::SERVICE.history;
/// Most narrations that wait behind those.
pub const WAITING_MAX: usize = 64;
/// Most starts with unconfirmed narrations. The daemon follows this many per port and never confirms others.
pub const STARTS_UNDER_WAY_MAX: usize = 8;
/// Unconfirmed narrations are sent again after this time: they may have exceeded a limit, or were lost with a port.
const AGAIN_NS: u64 = 5_000_000_000;
/// A pace that was too fast is halved. After this time without a repetition it doubles.
const RECOVERS_S: f64 = 60.0;
/// The slowest pace.
const SLOWEST_PER_S: f64 = 0.2;
/// Starts that stay known, so that a delayed message of one is not accepted again.
const STARTS_MAX: usize = 9;

/// The verdict on a narration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Offered {
    /// It is the next one and was accepted.
    Taken,
    /// It was accepted before.
    Again,
    /// Others must come before it.
    Early,
    /// The queue is full.
    Full,
}

/// One start of a narrator.
#[derive(Debug)]
struct Start {
    epoch: u64,
    /// The expected number.
    next: u64,
    /// How many were not narration.
    passed_over: u64,
    tally: Tally,
    delay: Delay,
}

/// A daemon's report on a start when counting began.
#[derive(Debug, Clone, Copy)]
struct Since {
    daemon: u64,
    /// The daemon had processed the numbers up to this one, so they are not counted again.
    sequence: u64,
    accepted: u64,
}

/// Counts a start's narrations that the daemon dropped.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    /// The report when counting began; `None` before the first report.
    since: Option<Since>,
    /// Narrations after that report that the daemon has processed.
    dealt_with: u64,
    /// How many of them the daemon dropped, by its last report.
    dropped: u64,
    /// Narrations that earlier daemons dropped.
    before: u64,
}

impl Tally {
    /// Handles a daemon's report on a start. `dealt_with` are the newly processed numbers.
    fn take(&mut self, daemon: u64, included: &IncludedV1, dealt_with: &[u64]) {
        match self.since {
            Some(since) if since.daemon == daemon => {
                self.dealt_with += dealt_with.iter().filter(|sequence| **sequence > since.sequence).count() as u64;
                // The daemon may report a drop before an earlier acceptance, so the count can decrease.
                self.dropped = self.dealt_with.saturating_sub(included.accepted.saturating_sub(since.accepted));
            }
            // A restarted daemon may know less, so all that it processed counts as accepted.
            _ => {
                let before = self.dropped();
                let since = Since { daemon, sequence: included.sequence, accepted: included.accepted };
                *self = Self { since: Some(since), before, ..Self::default() };
            }
        }
    }

    fn dropped(&self) -> u64 {
        self.before + self.dropped
    }
}

/// The relay of one narrator.
#[derive(Debug)]
pub struct Relay {
    source: u64,
    /// The start that was heard last is at the end.
    starts: VecDeque<Start>,
    waiting: VecDeque<NarrationV1>,
    under_way: VecDeque<NarrationV1>,
    /// The daemon, and its last report on each start that it named.
    named: Option<(u64, Vec<IncludedV1>)>,
    /// When the oldest unconfirmed narration was sent, some were confirmed, or all were sent again. Other sends do not postpone a repetition.
    moved_ns: u64,
    /// Repetitions of all unconfirmed narrations in a row.
    repeats: u32,
    pace: Pace,
}

impl Relay {
    /// Creates an empty relay.
    #[must_use]
    pub fn new(narrator: &str, rate_per_s: f64) -> Self {
        Self {
            source: sequence::source_of_name(narrator),
            starts: VecDeque::new(),
            waiting: VecDeque::new(),
            under_way: VecDeque::new(),
            named: None,
            moved_ns: 0,
            repeats: 0,
            pace: Pace::new(rate_per_s),
        }
    }

    /// Whether a narration would be accepted now.
    fn judge(&self, epoch: u64, sequence: u64, first: u64) -> Offered {
        let next = self.starts.iter().find(|start| start.epoch == epoch).map(|start| start.next);
        if next.is_some_and(|next| sequence < next) {
            Offered::Again
        } else if sequence != next.map_or(first, |next| next.max(first))
            || next.is_some_and(|next| sequence - next > sequence::JUMP_MAX)
        {
            // The daemon does not accept a larger jump either.
            Offered::Early
        } else if self.waiting.len() >= WAITING_MAX {
            Offered::Full
        } else {
            Offered::Taken
        }
    }

    /// Accepts a narration if it is the next one of its start. `first` is the first number that its narrator can still send. `message` goes to the
    /// daemon; it is `None` if the narration is invalid.
    pub fn offer(&mut self, epoch: u64, sequence: u64, first: u64, message: Option<NarrationV1>) -> Offered {
        let offered = self.judge(epoch, sequence, first);
        // Every start that is heard gets a report.
        let known = self.starts.iter().position(|start| start.epoch == epoch);
        let mut start = match known.and_then(|place| self.starts.remove(place)) {
            Some(start) => start,
            None if offered == Offered::Taken => {
                Start { epoch, next: first, passed_over: 0, tally: self.tally(epoch), delay: Delay::default() }
            }
            None => return offered,
        };
        if offered == Offered::Taken {
            start.next = sequence.saturating_add(1);
            match message {
                Some(message) => self.waiting.push_back(message),
                None => start.passed_over += 1,
            }
        }
        self.starts.push_back(start);
        if self.starts.len() > STARTS_MAX {
            self.starts.pop_front();
        }
        offered
    }

    /// The tally of a new start. A daemon that does not name it has accepted none of its narrations yet.
    fn tally(&self, epoch: u64) -> Tally {
        let since = self.named.as_ref().map(|(daemon, named)| {
            let known = named.iter().find(|included| included.epoch == epoch);
            let (sequence, accepted) = known.map_or((0, 0), |included| (included.sequence, included.accepted));
            Since { daemon: *daemon, sequence, accepted }
        });
        Tally { since, ..Tally::default() }
    }

    /// How much longer a message took than the fastest of its start ([`Delay::excess_ns`]); `None` if that is unknown.
    pub fn excess_ns(&mut self, epoch: u64, clock: u64, sent_ns: u64, now_ns: u64) -> Option<u64> {
        let start = self.starts.iter_mut().find(|start| start.epoch == epoch)?;
        start.delay.excess_ns(clock, sent_ns, now_ns)
    }

    /// The next message for the daemon, if one may go now.
    pub fn send(&mut self, now_ns: u64) -> Option<NarrationV1> {
        let epoch = self.waiting.front()?.epoch;
        if self.under_way.len() >= UNDER_WAY_MAX || self.would_be_forgotten(epoch) || !self.pace.take(now_ns) {
            return None;
        }
        let message = self.waiting.pop_front()?;
        if self.under_way.is_empty() {
            self.moved_ns = now_ns;
        }
        self.under_way.push_back(message);
        Some(message)
    }

    /// Whether sending for this start would make the daemon forget another one with unconfirmed narrations.
    fn would_be_forgotten(&self, epoch: u64) -> bool {
        let starts: BTreeSet<u64> = self.under_way.iter().map(|sent| sent.epoch).collect();
        starts.len() >= STARTS_UNDER_WAY_MAX && !starts.contains(&epoch)
    }

    /// All unconfirmed narrations, if the daemon has not confirmed any for long. `alive` says whether the daemon is heard.
    pub fn again(&mut self, now_ns: u64, alive: bool) -> Vec<NarrationV1> {
        if self.under_way.is_empty() || !alive || now_ns.saturating_sub(self.moved_ns) < AGAIN_NS {
            return Vec::new();
        }
        self.moved_ns = now_ns;
        self.repeats += 1;
        self.pace.slow_down(now_ns);
        self.under_way.iter().copied().collect()
    }

    /// Repetitions in a row that the daemon did not accept.
    #[must_use]
    pub fn repeats(&self) -> u32 {
        self.repeats
    }

    /// Handles checked scores. Returns how many more narrations the daemon has dropped.
    pub fn confirm(&mut self, scores: &RoomScoresV1, now_ns: u64) -> u64 {
        let own = scores.included().iter().filter(|included| included.source == self.source);
        let named: Vec<IncludedV1> = own.copied().collect();
        let mut dropped = 0;
        for included in &named {
            let is_open = |sent: &NarrationV1| sent.epoch != included.epoch || sent.sequence > included.sequence;
            let dealt_with: Vec<u64> =
                self.under_way.iter().filter(|sent| !is_open(sent)).map(|sent| sent.sequence).collect();
            self.under_way.retain(is_open);
            if !dealt_with.is_empty() {
                (self.moved_ns, self.repeats) = (now_ns, 0);
                self.pace.recover(now_ns);
            }
            if let Some(start) = self.starts.iter_mut().find(|start| start.epoch == included.epoch) {
                let before = start.tally.dropped();
                start.tally.take(scores.epoch, included, &dealt_with);
                dropped += start.tally.dropped().saturating_sub(before);
            }
        }
        self.named = Some((scores.epoch, named));
        dropped
    }

    /// The report to the narrator.
    #[must_use]
    pub fn confirmed(&self) -> Confirmed {
        let Some(Start { epoch, next, passed_over, tally, .. }) = self.starts.back() else {
            return Confirmed::default();
        };
        let refused = passed_over + tally.dropped();
        let own = self.under_way.iter().chain(&self.waiting).find(|message| message.epoch == *epoch);
        let open = own.map_or(*next, |message| message.sequence);
        Confirmed { epoch: Hex(*epoch), next: *next, confirmed: open.saturating_sub(1), refused }
    }
}

/// A rate with one second's worth of burst. It slows down if the daemon cannot follow.
#[derive(Debug)]
struct Pace {
    most_per_s: f64,
    rate_per_s: f64,
    /// When the rate last changed.
    changed_ns: u64,
    tokens: f64,
    at_ns: u64,
}

impl Pace {
    fn new(rate_per_s: f64) -> Self {
        let tokens = rate_per_s.max(1.0);
        Self { most_per_s: rate_per_s, rate_per_s, changed_ns: 0, tokens, at_ns: 0 }
    }

    fn slow_down(&mut self, now_ns: u64) {
        self.rate_per_s = (self.rate_per_s / 2.0).max(SLOWEST_PER_S).min(self.most_per_s);
        self.changed_ns = now_ns;
    }

    fn recover(&mut self, now_ns: u64) {
        let passed_s = now_ns.saturating_sub(self.changed_ns) as f64 / 1e9;
        self.rate_per_s = (self.rate_per_s * (1.0 + passed_s / RECOVERS_S)).min(self.most_per_s);
        self.changed_ns = now_ns;
    }

    fn take(&mut self, now_ns: u64) -> bool {
        let passed_s = now_ns.saturating_sub(self.at_ns) as f64 / 1e9;
        self.tokens = (self.tokens + passed_s * self.rate_per_s).min(self.rate_per_s.max(1.0));
        self.at_ns = now_ns;
        let may = self.tokens >= 1.0;
        self.tokens -= f64::from(u8::from(may));
        may
    }
}

#[cfg(test)]
mod tests {
    use roomcast_ipc::raw::IncludedV1;

    use super::*;

    fn message(epoch: u64, sequence: u64) -> Option<NarrationV1> {
        let source = sequence::source_of_name("hub");
        Some(NarrationV1 { source, epoch, sequence, ..NarrationV1::new(0, "They sit.").unwrap() })
    }

    fn scores(epoch: u64, sequence: u64) -> RoomScoresV1 {
        accepted(1, epoch, sequence, sequence)
    }

    fn accepted(daemon: u64, epoch: u64, sequence: u64, accepted: u64) -> RoomScoresV1 {
        let mut scores = RoomScoresV1 { epoch: daemon, source_count: 1, ..Default::default() };
        let source = sequence::source_of_name("hub");
        scores.included[0] = IncludedV1 { source, epoch, sequence, accepted, ..Default::default() };
        scores
    }

    #[test]
    fn each_number_is_taken_once_and_in_order() {
        let mut relay = Relay::new("hub", 1e6);
        assert_eq!(relay.confirmed(), Confirmed::default());
        assert_eq!(relay.offer(9, 2, 1, message(9, 2)), Offered::Early, "the narrator still has the first");
        assert_eq!(relay.offer(9, 1, 1, message(9, 1)), Offered::Taken);
        assert_eq!(relay.offer(9, 1, 1, message(9, 1)), Offered::Again);
        assert_eq!(relay.offer(9, 3, 1, message(9, 3)), Offered::Early);
        assert_eq!(relay.offer(9, 2, 1, None), Offered::Taken, "it is no narration, and is passed over");
        assert_eq!(relay.send(0).unwrap().sequence, 1);
        assert_eq!(relay.confirmed(), Confirmed { epoch: Hex(9), next: 3, confirmed: 0, refused: 1 });
        relay.confirm(&scores(9, 1), 1);
        assert_eq!(relay.confirmed().confirmed, 2);
        // Numbers that the narrator cannot send any more are skipped.
        assert_eq!(relay.offer(9, 8, 7, message(9, 8)), Offered::Early);
        assert_eq!(relay.offer(9, 7, 7, message(9, 7)), Offered::Taken);
    }

    #[test]
    fn each_start_has_numbers_of_its_own() {
        let mut relay = Relay::new("hub", 1e6);
        assert_eq!(relay.offer(9, 1, 1, message(9, 1)), Offered::Taken);
        assert_eq!(relay.offer(10, 1, 1, message(10, 1)), Offered::Taken);
        assert_eq!(relay.offer(9, 1, 1, message(9, 1)), Offered::Again, "a delayed message is taken once");
        assert_eq!((relay.send(0).unwrap().epoch, relay.send(0).unwrap().epoch), (9, 10), "in the order they came");
        relay.confirm(&scores(10, 1), 1);
        assert_eq!(relay.again(2 * AGAIN_NS, true).len(), 1, "the first start's is still under way");
        // A second hub with this name, or an unknown sender, does not block it.
        assert_eq!(relay.offer(u64::MAX, u64::MAX, u64::MAX, message(u64::MAX, u64::MAX)), Offered::Taken);
        assert_eq!(relay.confirmed().epoch, Hex(u64::MAX));
        assert_eq!(relay.offer(9, 3, 2, message(9, 3)), Offered::Early);
        assert_eq!((relay.confirmed().epoch, relay.confirmed().next), (Hex(9), 2), "it is told where it is");
        assert_eq!(relay.offer(9, 2, 2, message(9, 2)), Offered::Taken);
        // A jump in its own name does not block it either.
        assert_eq!(relay.offer(9, u64::MAX, u64::MAX, None), Offered::Early);
        assert_eq!(relay.offer(9, 3, 2, message(9, 3)), Offered::Taken);
        for epoch in 100..200 {
            relay.offer(epoch, 1, 1, None);
        }
        assert_eq!(relay.starts.len(), STARTS_MAX);
    }

    #[test]
    fn what_is_said_in_anothers_name_does_not_age_its_narration() {
        const S: u64 = 1_000_000_000;
        let mut relay = Relay::new("hub", 1e6);
        relay.offer(9, 1, 1, None);
        for second in 10..20 {
            let _known = relay.excess_ns(9, 1, second * S, second * S);
        }
        assert_eq!(relay.excess_ns(10, 1, 7_200 * S, 20 * S), None, "it is no start");
        relay.offer(10, 1, 1, None);
        let _first = relay.excess_ns(10, 1, 7_200 * S, 21 * S);
        assert_eq!(relay.excess_ns(9, 1, 22 * S, 22 * S), Some(0));
    }

    #[test]
    fn memory_is_bounded_and_what_finds_no_room_is_sent_again() {
        let mut relay = Relay::new("hub", 1e6);
        let all = (UNDER_WAY_MAX + WAITING_MAX) as u64;
        for number in 1..=all {
            assert_eq!(relay.offer(9, number, 1, message(9, number)), Offered::Taken);
            relay.send(number);
        }
        assert_eq!(relay.offer(9, all + 1, 1, message(9, all + 1)), Offered::Full);
        assert_eq!((relay.under_way.len(), relay.waiting.len()), (UNDER_WAY_MAX, WAITING_MAX));
        assert!(relay.send(1).is_none());
        assert_eq!(relay.confirmed().next, all + 1);
        assert!(relay.again(AGAIN_NS, true).is_empty());
        assert!(relay.again(10 * AGAIN_NS, false).is_empty(), "a daemon that is away has its history");
        assert_eq!(relay.again(10 * AGAIN_NS, true).len(), UNDER_WAY_MAX);
        assert_eq!(relay.repeats(), 1);
        relay.confirm(&scores(9, 32), 1);
        assert_eq!((relay.repeats(), relay.offer(9, all + 1, 1, message(9, all + 1))), (0, Offered::Full));
        while relay.send(2).is_some() {}
        assert_eq!(relay.offer(9, all + 1, 1, message(9, all + 1)), Offered::Taken);
    }

    #[test]
    fn what_the_daemon_drops_counts_as_refused() {
        let mut relay = Relay::new("hub", 1e6);
        let say = |relay: &mut Relay, numbers: std::ops::RangeInclusive<u64>| {
            for number in numbers {
                assert_eq!(relay.offer(9, number, 1, message(9, number)), Offered::Taken);
            }
            while relay.send(0).is_some() {}
        };
        // The daemon is alive and names other starts.
        assert_eq!(relay.confirm(&accepted(1, 8, 5, 5), 1), 0);
        say(&mut relay, 1..=10);
        assert_eq!(relay.confirm(&accepted(1, 9, 4, 4), 1), 0);
        // It dropped three of the next six, and reports that twice.
        assert_eq!(relay.confirm(&accepted(1, 9, 10, 7), 1), 3);
        assert_eq!(relay.confirm(&accepted(1, 9, 10, 7), 1), 0);
        assert_eq!(relay.confirmed(), Confirmed { epoch: Hex(9), next: 11, confirmed: 10, refused: 3 });
        // Narrations that were skipped here never reached it.
        assert_eq!(relay.offer(9, 11, 1, None), Offered::Taken);
        say(&mut relay, 12..=13);
        // An overlong one is reported before one that was accepted earlier.
        assert_eq!(relay.confirm(&accepted(1, 9, 13, 7), 1), 2);
        assert_eq!(relay.confirm(&accepted(1, 9, 13, 8), 1), 0);
        assert_eq!(relay.confirmed().refused, 5);
        // A restarted daemon counts from its own start. A restarted bridge takes over the daemon's count.
        say(&mut relay, 14..=15);
        assert_eq!(relay.confirm(&accepted(2, 9, 15, 13), 1), 0);
        say(&mut relay, 16..=17);
        assert_eq!((relay.confirm(&accepted(2, 9, 17, 14), 1), relay.confirmed().refused), (1, 6));
        let mut relay = Relay::new("hub", 1e6);
        relay.confirm(&accepted(2, 9, 17, 14), 1);
        for number in 18..=19 {
            relay.offer(9, number, 18, message(9, number));
        }
        while relay.send(0).is_some() {}
        assert_eq!((relay.confirm(&accepted(2, 9, 19, 16), 1), relay.confirmed().refused), (0, 0));
    }

    #[test]
    fn a_pace_that_is_too_fast_for_the_daemon_is_left_and_found_again() {
        const S: u64 = 1_000_000_000;
        let mut relay = Relay::new("hub", 100.0);
        relay.offer(9, 1, 1, message(9, 1));
        relay.send(S);
        (1..=20).for_each(|n| assert_eq!(relay.again(S + n * AGAIN_NS, true).len(), 1));
        assert_eq!(relay.pace.rate_per_s, SLOWEST_PER_S);
        let mut now_ns = 200 * S;
        for number in 2..100 {
            relay.confirm(&scores(9, number - 1), now_ns);
            relay.offer(9, number, 1, message(9, number));
            now_ns += 10 * S;
            assert!(relay.send(now_ns).is_some());
        }
        assert_eq!(relay.pace.rate_per_s, 100.0);
        // A slower configured rate stays as it is.
        let mut slow = Pace::new(0.1);
        slow.slow_down(S);
        assert_eq!(slow.rate_per_s, 0.1);
    }

    /// After a refusal the daemon waits for that number, so it must be repeated while others are sent.
    #[test]
    fn what_waits_is_given_again_while_others_are_sent() {
        const S: u64 = 1_000_000_000;
        let mut relay = Relay::new("hub", 100.0);
        let mut again = Vec::new();
        for second in 1..=6 {
            relay.offer(9, second, 1, message(9, second));
            assert!(relay.send(second * S).is_some());
            again.extend(relay.again(second * S, true).iter().map(|message| message.sequence));
        }
        assert_eq!(again, [1, 2, 3, 4, 5, 6]);
    }

    #[test]
    fn a_rate_holds() {
        let mut relay = Relay::new("hub", 2.0);
        for number in 1..=5 {
            relay.offer(9, number, 1, message(9, number));
        }
        let sent = (0..40).filter(|tenth| relay.send(tenth * 100_000_000).is_some()).collect::<Vec<_>>();
        assert_eq!(sent, [0, 1, 5, 10, 15]);
    }
}
