//! From a message to an event: rate limits, duplicates, forged names, and the counters. Pure: time is a parameter.
//!
//! A narrator's start (source and epoch) belongs to the port that first uses it. From any other port its messages are forged. If the configuration
//! calls the narrator relayed, another port may continue the start once the first port is closed, as after a restart of a bridge. A relayed narrator
//! resends its messages above the rate. Later messages wait for these, because otherwise the resent ones would count as lost.
//!
//! Each port has an equal quota of the followed starts and of the places in a person's window ([`Quota`]). The service has as many ports as quotas,
//! so no port can take the quota of an open one.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use roomcast_ipc::raw::{Message, NarrationV1, narration_kind};
use roomcast_ipc::sequence::{Arrival, Follower, source_of_name};
use roomcast_ipc::{MessageError, Sender};

use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Quota, check_name};
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_core::scorer::TokenCounter;

use crate::config::{IntakeLimits, KnownNarrator};
use crate::line::{AHEAD_NS, FAST_NS};
use crate::message_text::event_of;
use crate::token_bucket::TokenBucket;

/// Most followed starts of one port. The start with the longest silence gives way to another of the same port.
pub const SOURCES_OF_A_PORT: usize = SOURCES_MAX / NarrationV1::SERVICE.publishers;
/// Most remembered ports, those of ended processes included.
const PORTS_MAX: usize = 64;
/// Most remembered starts that are not followed, with port and last sequence. If there are more, the port with most of them loses the older half.
pub const FORMER_SOURCES_MAX: usize = 4096;
/// How long later messages wait for one above the rate, since it last arrived. A bridge resends it after five seconds, and may have to restart first.
/// After this time no process has the message.
pub const HELD_S: u64 = 30;
/// The number of the common quota of all unknown narrators, if the configuration names any narrator.
pub(super) const OTHERS: u64 = 1;
const FIRST_QUOTA: u64 = 2;

/// The outcome of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Taken {
    /// The event goes into the history.
    Accepted {
        /// The event.
        observation: Observation,
        /// The number of this start's events that were lost before it.
        missed: u64,
        /// The quota that it counts against in its person's window.
        quota: Quota,
        /// The start (source and epoch) that gave way to its start.
        leaves: Option<(u64, u64)>,
        /// It is the port's first event of this start. The state database must keep the owner.
        binds: bool,
        /// The lead of its time if that is more than a second; the event then counts as observed now.
        ahead_ns: Option<u64>,
    },
    /// The event was accepted before.
    Duplicate,
    /// The port exceeded its rate limit, or must resend dropped messages first.
    Limited,
    /// The start belongs to another port.
    Forged,
    /// The sentence alone has more tokens than a window holds, so it cannot be scored.
    Costly {
        /// The tokens of the sentence.
        tokens: usize,
        /// The most tokens of a sentence.
        most: usize,
        /// It is the first such sentence of its start.
        first: bool,
    },
    /// The message is no event. It is counted, logged and dropped.
    Malformed(String),
}

/// Counters since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct IntakeCounters {
    /// Received messages, malformed ones included.
    pub received: u64,
    /// Messages that went into a history.
    pub accepted: u64,
    /// Messages that were accepted before.
    pub duplicates: u64,
    /// Events that never arrived.
    pub missed: u64,
    /// Malformed messages.
    pub malformed: u64,
    /// Messages above the rate of their port.
    pub limited: u64,
    /// Messages for a start of another port.
    pub forged: u64,
    /// Sentences with more tokens than a window holds.
    pub costly: u64,
    /// Events that a clock dated more than a second ahead.
    pub ahead: u64,
    /// The lead of the newest of them.
    pub ahead_ns: u64,
}

/// The tokens of a sentence, and their limit: the room that the map's labels leave in a window.
#[derive(Clone)]
pub struct SentenceCost {
    count: TokenCounter,
    most: Arc<AtomicUsize>,
}

impl SentenceCost {
    /// Counts with the model's tokeniser. `most` changes with the map.
    #[must_use]
    pub fn new(count: TokenCounter, most: Arc<AtomicUsize>) -> Self {
        Self { count, most }
    }

    /// The tokens of a sentence and their limit, if the sentence exceeds it.
    fn excess(&self, sentence: &str) -> Option<(usize, usize)> {
        let most = self.most.load(Ordering::Relaxed);
        // An upper bound without the tokeniser: one token per byte, a space before the sentence, and the separator after it.
        if sentence.len() + 2 <= most {
            return None;
        }
        let tokens = (self.count)(sentence) + 1;
        (tokens > most).then_some((tokens, most))
    }
}

impl fmt::Debug for SentenceCost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SentenceCost").field("most", &self.most).finish_non_exhaustive()
    }
}

#[derive(Debug, Clone)]
struct Source {
    follower: Follower,
    /// `None` if a former run of the daemon did not store the port.
    port: Option<Sender>,
    /// The state database has the port.
    bound: bool,
    trust: u32,
    /// The number of its newest message among all messages.
    turn: u64,
    costly: bool,
}

#[derive(Debug, Clone)]
struct Port {
    bucket: TokenBucket,
    quota: u64,
    turn: u64,
    /// A relayed narrator's message above the rate.
    held: Option<Held>,
}

/// A message that its narrator must resend.
#[derive(Debug, Clone, Copy)]
struct Held {
    start: (u64, u64),
    sequence: u64,
    at_ns: BootNs,
}

impl Port {
    /// Whether a relayed narrator's message is accepted: there is a token, and no earlier message is awaited.
    fn admits(&mut self, start: (u64, u64), sequence: u64, now_ns: BootNs) -> bool {
        let since_ns = |held: &Held| now_ns.since(held.at_ns);
        self.held = self.held.filter(|held| since_ns(held) < HELD_S * 1_000_000_000);
        if self.held.is_some_and(|held| held.start != start || held.sequence < sequence) {
            return false;
        }
        let has_one = self.bucket.has_one(now_ns);
        self.held = (!has_one).then_some(Held { start, sequence, at_ns: now_ns });
        has_one
    }
}

/// Decides about each message, and remembers the accepted sequence of each start.
#[derive(Debug, Clone, Default)]
pub struct Intake {
    limits: IntakeLimits,
    narrators: BTreeMap<u64, KnownNarrator>,
    cost: Option<SentenceCost>,
    sources: BTreeMap<(u64, u64), Source>,
    /// Starts that gave way. No other port may continue them.
    former: BTreeMap<(u64, u64), Source>,
    ports: BTreeMap<Sender, Port>,
    /// The port that speaks for each narrator of the configuration.
    holders: BTreeMap<u64, Sender>,
    alive: BTreeSet<Sender>,
    quotas: u64,
    turns: u64,
    counters: IntakeCounters,
}

impl Intake {
    /// An intake without events.
    #[must_use]
    pub fn new(limits: IntakeLimits) -> Self {
        Self { limits, quotas: FIRST_QUOTA, ..Self::default() }
    }

    /// The narrators of the configuration. All others then share one quota.
    #[must_use]
    pub(crate) fn with_narrators(mut self, narrators: &[KnownNarrator]) -> Self {
        self.narrators = narrators.iter().map(|known| (source_of_name(&known.name), known.clone())).collect();
        self
    }

    /// Refuses sentences with too many tokens.
    #[must_use]
    pub fn with_cost(mut self, cost: SentenceCost) -> Self {
        self.cost = Some(cost);
        self
    }

    /// Takes note of an event of a former run, so that it is not accepted twice. Events come in order. If there are too many starts, the latest ones
    /// count.
    pub fn restore(&mut self, event: EventId) {
        let name = event.start();
        self.make_room_for_source(name);
        self.turns += 1;
        let (trust, turn) = (self.trust(event.source), self.turns);
        let source = self.source(name, trust, turn);
        source.follower.take(event.epoch, event.sequence);
        source.turn = turn;
    }

    /// Takes note of the port of a start that is still remembered.
    pub(crate) fn restore_port(&mut self, name: (u64, u64), port: Sender) {
        if let Some(source) = self.sources.get_mut(&name).or_else(|| self.former.get_mut(&name)) {
            (source.port, source.bound) = (Some(port), true);
        }
    }

    /// Whether a port is known. Before a new port's message, [`Intake::note_alive`] must get the open ports.
    #[must_use]
    pub fn knows_port(&self, sender: Sender) -> bool {
        self.ports.contains_key(&sender)
    }

    /// Takes note of the open ports, whose quotas no other port can take.
    pub fn note_alive(&mut self, alive: impl IntoIterator<Item = Sender>) {
        self.alive = alive.into_iter().collect();
    }

    /// Whether a port uses the name of a configured narrator, or a start of a relayed one, that another open port owns. Then [`Intake::note_alive`]
    /// must get the ports whose processes run.
    #[must_use]
    pub(crate) fn is_contested(&self, source: u64, epoch: u64, sender: Sender) -> bool {
        let holder = self.holders.get(&source);
        let owner =
            self.followed((source, epoch)).and_then(|known| known.port.as_ref()).filter(|_| self.is_relayed(source));
        [holder, owner].into_iter().flatten().any(|other| *other != sender && self.alive.contains(other))
    }

    fn followed(&self, start: (u64, u64)) -> Option<&Source> {
        self.sources.get(&start).or_else(|| self.former.get(&start))
    }

    fn is_relayed(&self, source: u64) -> bool {
        self.narrators.get(&source).is_some_and(|known| known.relayed)
    }

    /// Judges a message that has passed [`roomcast_ipc::raw::Message::check`], or counts its fault.
    pub fn receive(&mut self, received: Result<&NarrationV1, MessageError>, sender: Sender, now_ns: BootNs) -> Taken {
        match received {
            Ok(message) => self.take(message, sender, now_ns),
            Err(error) => {
                self.counters.received += 1;
                self.counters.malformed += 1;
                Taken::Malformed(error.to_string())
            }
        }
    }

    /// Judges a message that has passed [`roomcast_ipc::raw::Message::check`].
    pub fn take(&mut self, message: &NarrationV1, sender: Sender, now_ns: BootNs) -> Taken {
        let taken = self.judge(message, sender, now_ns);
        let counters = &mut self.counters;
        counters.received += 1;
        match &taken {
            Taken::Accepted { missed, ahead_ns, .. } => {
                counters.missed = counters.missed.saturating_add(*missed);
                counters.accepted += 1;
                if let Some(ahead_ns) = ahead_ns {
                    (counters.ahead, counters.ahead_ns) = (counters.ahead + 1, *ahead_ns);
                }
            }
            Taken::Duplicate => counters.duplicates += 1,
            Taken::Limited => counters.limited += 1,
            Taken::Forged => counters.forged += 1,
            Taken::Costly { .. } => counters.costly += 1,
            Taken::Malformed(_) => counters.malformed += 1,
        }
        taken
    }

    fn judge(&mut self, message: &NarrationV1, sender: Sender, now_ns: BootNs) -> Taken {
        let event = match event_of(message.kind, message.text()) {
            Ok(event) => event,
            Err(error) => return Taken::Malformed(error.to_string()),
        };
        let name = Some(message.person_name().trim()).filter(|name| !name.is_empty());
        if let Some(Err(fault)) = name.map(check_name) {
            return Taken::Malformed(fault);
        }
        self.turns += 1;
        let turn = self.turns;
        let start = (message.source, message.epoch);
        let is_new = self.followed(start).is_none_or(|known| message.sequence > known.follower.sequence());
        let is_held = is_new && self.is_relayed(message.source);
        let port = self.port(sender, message.source, now_ns);
        port.turn = turn;
        let may = if is_held { port.admits(start, message.sequence, now_ns) } else { port.bucket.has_one(now_ns) };
        if !may {
            return Taken::Limited;
        }
        let known = self.followed(start);
        // Any port may repeat an accepted event, as a replay does.
        if known.is_some_and(|known| message.sequence <= known.follower.sequence()) {
            // A start that gave way takes no place from others by a repetition.
            if self.sources.contains_key(&start) {
                self.claim(start, sender, turn);
            }
            return Taken::Duplicate;
        }
        let other = known.and_then(|known| known.port).filter(|port| *port != sender);
        if other.is_some_and(|port| !self.is_relayed(message.source) || self.alive.contains(&port)) {
            return Taken::Forged;
        }
        if known.is_some_and(|known| message.sequence - known.follower.sequence() > roomcast_ipc::sequence::JUMP_MAX) {
            return Taken::Malformed(format!(
                "its sequence {} is too far ahead of what its source said",
                message.sequence
            ));
        }
        if other.is_some()
            && let Some(known) = self.sources.get_mut(&start).or_else(|| self.former.get_mut(&start))
        {
            (known.port, known.bound) = (None, false);
        }
        let leaves = self.claim(start, sender, turn);
        let excess =
            self.cost.as_ref().zip(event.sentence()).and_then(|(cost, sentence)| cost.excess(sentence.as_str()));
        let Some(source) = self.sources.get_mut(&start) else { return Taken::Limited };
        let missed = match source.follower.take(message.epoch, message.sequence) {
            Arrival::AfterGap { missed } => missed,
            _ => 0,
        };
        let Some(port) = self.ports.get_mut(&sender) else { return Taken::Limited };
        port.bucket.take();
        let binds = excess.is_none() && !source.bound;
        source.bound |= binds;
        if let Some((tokens, most)) = excess {
            let first = !std::mem::replace(&mut source.costly, true);
            return Taken::Costly { tokens, most, first };
        }
        let port_quota = port.quota;
        let quota = self.quota_of(message.source, sender, port_quota);
        let ahead_ns = BootNs(message.observed_ns).since(now_ns);
        let observation = observation_of(message, event, name, now_ns);
        let ahead_ns = Some(ahead_ns).filter(|ahead_ns| *ahead_ns > FAST_NS);
        Taken::Accepted { observation, missed, quota, leaves, binds, ahead_ns }
    }

    /// The quota for sentences of a source: its own, if the configuration names the narrator.
    fn quota_of(&mut self, source: u64, sender: Sender, of_port: u64) -> Quota {
        match self.narrators.get(&source).map(|known| known.share) {
            Some(share) if self.holds(source, sender) => Quota { number: source.max(FIRST_QUOTA), share },
            None if self.narrators.is_empty() => Quota { number: of_port, share: 1 },
            _ => Quota { number: OTHERS, share: 1 },
        }
    }

    /// The counters.
    #[must_use]
    pub fn counters(&self) -> IntakeCounters {
        self.counters
    }

    /// The number of followed starts.
    #[must_use]
    pub fn sources(&self) -> usize {
        self.sources.len()
    }

    /// Whether a port speaks for a narrator of the configuration. The first one does while it is open. Other ports with this name count as unknown
    /// narrators, and take none of its quota.
    fn holds(&mut self, source: u64, sender: Sender) -> bool {
        let holder = self.holders.entry(source).or_insert(sender);
        if *holder != sender && !self.alive.contains(holder) {
            *holder = sender;
        }
        *holder == sender
    }

    /// Follows a start, with its remembered state if there is one.
    fn source(&mut self, name: (u64, u64), trust: u32, turn: u64) -> &mut Source {
        let Self { sources, former, .. } = self;
        sources.entry(name).or_insert_with(|| {
            let fresh =
                || Source { follower: Follower::default(), port: None, bound: false, trust, turn, costly: false };
            former.remove(&name).unwrap_or_else(fresh)
        })
    }

    /// Stops following a start, and remembers its port.
    fn retire(&mut self, name: (u64, u64)) {
        let Some(source) = self.sources.remove(&name) else { return };
        self.former.insert(name, source);
        if self.former.len() <= FORMER_SOURCES_MAX {
            return;
        }
        let mut of_ports = BTreeMap::<_, Vec<_>>::new();
        for (name, source) in &self.former {
            of_ports.entry(source.port).or_default().push((source.turn, *name));
        }
        // Between ports with equally many, the one with the longest silence.
        let newest = |own: &[(u64, (u64, u64))]| own.iter().map(|(turn, _)| *turn).max();
        let most = of_ports.into_values().max_by_key(|own| (own.len(), std::cmp::Reverse(newest(own))));
        let Some(mut own) = most else { return };
        own.sort_unstable();
        for (_, name) in own.iter().take(own.len().div_ceil(2)) {
            self.former.remove(name);
        }
    }

    fn trust(&self, source: u64) -> u32 {
        self.narrators.get(&source).map_or(0, |known| known.trust)
    }

    /// A known or new port; `source` is the first narrator that it speaks for.
    fn port(&mut self, sender: Sender, source: u64, now_ns: BootNs) -> &mut Port {
        if !self.ports.contains_key(&sender) && self.ports.len() >= PORTS_MAX {
            let silent = self.ports.iter().min_by_key(|(port, known)| (self.alive.contains(port), known.turn));
            if let Some(silent) = silent.map(|(port, _)| *port) {
                self.ports.remove(&silent);
            }
        }
        let inherited = if self.ports.contains_key(&sender) { None } else { self.quota_left_by(source) };
        let (limits, narrators, quotas) = (self.limits, &self.narrators, &mut self.quotas);
        self.ports.entry(sender).or_insert_with(|| {
            let known = narrators.get(&source);
            let rate_per_s = known.and_then(|known| known.rate_per_s).unwrap_or(limits.rate_per_s);
            let quota = inherited.unwrap_or_else(|| {
                *quotas += 1;
                *quotas
            });
            let bucket = TokenBucket::full(IntakeLimits { rate_per_s, ..limits }, now_ns);
            Port { bucket, quota, turn: 0, held: None }
        })
    }

    /// The quota of the closed port that last spoke for this source. A restarted narrator continues with it, because it must not share the window
    /// with its own past. The quota of an open port stays with that port.
    fn quota_left_by(&self, source: u64) -> Option<u64> {
        let starts = self.sources.range((source, 0)..=(source, u64::MAX));
        let last = starts.filter(|(_, known)| known.port.is_some()).max_by_key(|(_, known)| known.turn);
        let port = last.and_then(|(_, known)| known.port).filter(|port| !self.alive.contains(port))?;
        let quota = self.ports.get(&port)?.quota;
        let taken = self.ports.iter().any(|(port, known)| known.quota == quota && self.alive.contains(port));
        (!taken).then_some(quota)
    }

    /// Assigns a start to the port if it has none. Returns the start that gives way to it.
    fn claim(&mut self, name: (u64, u64), sender: Sender, turn: u64) -> Option<(u64, u64)> {
        let mut left = None;
        if self.sources.get(&name).is_none_or(|known| known.port.is_none()) {
            let own = self.sources.iter().filter(|(_, known)| known.port == Some(sender));
            if own.clone().count() >= SOURCES_OF_A_PORT {
                left = own.min_by_key(|(_, known)| known.turn).map(|(name, _)| *name);
                left.into_iter().for_each(|left| self.retire(left));
            }
            left = left.or(self.make_room_for_source(name));
        }
        let trust = self.trust(name.0);
        let source = self.source(name, trust, turn);
        source.port = source.port.or(Some(sender));
        source.turn = turn;
        left
    }

    /// If a new start has no room, one gives way: the start without an open port first, then the least trusted, then the one with the longest
    /// silence.
    fn make_room_for_source(&mut self, name: (u64, u64)) -> Option<(u64, u64)> {
        if self.sources.contains_key(&name) || self.sources.len() < SOURCES_MAX {
            return None;
        }
        let alive = |known: &Source| known.port.is_some_and(|port| self.alive.contains(&port));
        let left = self.sources.iter().min_by_key(|(_, known)| (alive(known), known.trust, known.turn));
        let left = left.map(|(name, _)| *name)?;
        self.retire(left);
        Some(left)
    }
}

/// The event with the daemon's times.
fn observation_of(message: &NarrationV1, event: Event, name: Option<&str>, now_ns: BootNs) -> Observation {
    let ahead_ns = BootNs(message.observed_ns).since(now_ns);
    Observation {
        person: PersonId(message.person),
        name: name.map(Into::into),
        by_fit: false,
        source: message.source,
        epoch: message.epoch,
        sequence: message.sequence,
        // An event cannot lie in the future, whatever the narrator's clock says. An event without a time is from now.
        observed_ns: match (message.observed_ns, message.observed_unix_ns) {
            (0, 0) => now_ns,
            (observed_ns, _) => BootNs(observed_ns.min(now_ns.0)),
        },
        // With a larger lead, the two times are from different clocks.
        observed_unix_ns: UnixNs(message.observed_unix_ns.saturating_sub(if ahead_ns > AHEAD_NS {
            0
        } else {
            ahead_ns
        })),
        count: message.counted(),
        may_be_form: ![narration_kind::ACTION, narration_kind::DEVICE].contains(&message.kind),
        event,
    }
}

/// The relay of the bridge, by its own source file: a test with both sides fails if one of them changes alone. Neither crate can depend on the other:
/// the bridge would get llama.cpp, and this crate zenoh. They share only the contract; the relay is no part of it.
#[cfg(test)]
#[path = "../../../zenoh/src/relay.rs"]
mod relay;

#[cfg(test)]
#[path = "../../../zenoh/src/delay.rs"]
#[expect(dead_code, reason = "the relay needs some of it")]
mod delay;

#[cfg(test)]
mod wire {
    #[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
    pub struct Hex(pub u64);

    #[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
    pub struct Confirmed {
        pub epoch: Hex,
        pub next: u64,
        pub confirmed: u64,
        pub refused: u64,
    }
}

#[cfg(test)]
mod tests {
    use crate::config::May;
    use roomcast_ipc::raw::{IncludedV1, RoomScoresV1, narration_kind};

    use super::relay::{Offered, Relay, STARTS_UNDER_WAY_MAX};
    use super::*;

    const S: u64 = 1_000_000_000;

    const PORT: Sender = Sender::simulated(1);
    const OTHER: Sender = Sender::simulated(2);

    fn message(source: u64, epoch: u64, sequence: u64, text: &str) -> NarrationV1 {
        let kind = if text.starts_with('[') { narration_kind::ACTION } else { narration_kind::SENTENCE };
        NarrationV1 { source, epoch, sequence, observed_ns: 5, ..NarrationV1::new(kind, text).unwrap() }
    }

    /// The narrator "hall" of a configuration.
    fn known(share: u32, rate_per_s: Option<f64>, relayed: bool) -> KnownNarrator {
        KnownNarrator { name: "hall".into(), trust: share.min(3), share, may: May::ALL, rate_per_s, relayed }
    }

    fn accepted(taken: Taken) -> (Observation, Quota, Option<(u64, u64)>) {
        let Taken::Accepted { observation, quota, leaves, .. } = taken else { panic!("{taken:?}") };
        (observation, quota, leaves)
    }

    #[test]
    fn each_narration_is_taken_once_and_gaps_are_counted() {
        let mut intake = Intake::new(IntakeLimits::default());
        let first = intake.take(&message(7, 1, 1, "[Grab] <mug> (1)"), PORT, BootNs(10));
        assert_eq!(accepted(first).0.sentence(), Some("They grab the mug."));
        assert_eq!(intake.take(&message(7, 1, 1, "[Grab] <mug> (1)"), PORT, BootNs(11)), Taken::Duplicate);
        assert!(matches!(
            intake.take(&message(7, 1, 4, "They sit."), PORT, BootNs(12)),
            Taken::Accepted { missed: 2, .. }
        ));
        assert!(matches!(intake.take(&message(8, 1, 1, "They sit."), OTHER, BootNs(12)), Taken::Accepted { .. }));
        assert!(matches!(intake.take(&message(7, 1, 5, "[Fly] <mug> (1)"), PORT, BootNs(13)), Taken::Malformed(_)));
        let counters = intake.counters();
        assert_eq!((counters.received, counters.accepted, counters.duplicates), (5, 3, 1));
        assert_eq!((counters.missed, counters.malformed), (2, 1));
    }

    #[test]
    fn who_and_what_is_said_is_passed_through() {
        let mut intake = Intake::new(IntakeLimits::default());
        let named = NarrationV1 {
            person_name: roomcast_ipc::text::encode("name", "Ada ").unwrap(),
            kind: narration_kind::PRESENCE,
            ..message(7, 1, 1, "present in the kitchen")
        };
        let Taken::Accepted { observation, .. } = intake.take(&named, PORT, BootNs(10)) else { panic!() };
        assert_eq!((observation.name.as_deref(), observation.sentence()), (Some("Ada"), None));
        assert_eq!(observation.event.to_string(), "present in the kitchen");
        let nonsense = NarrationV1 { kind: narration_kind::PRESENCE, ..message(7, 1, 2, "perhaps") };
        assert!(matches!(intake.take(&nonsense, PORT, BootNs(10)), Taken::Malformed(why) if why.contains("perhaps")));
    }

    /// Narrators of this program send no such names, but other ports can.
    #[test]
    fn what_is_no_name_of_a_person_is_malformed() {
        let mut intake = Intake::new(IntakeLimits::default());
        for name in ["nobody", "Me", "who", "12", " -1", "they", "!"] {
            let person_name = roomcast_ipc::text::encode("name", name).unwrap();
            let taken = intake.take(&NarrationV1 { person_name, ..message(7, 1, 1, "They sit.") }, PORT, BootNs(10));
            assert!(matches!(&taken, Taken::Malformed(why) if why.contains(name.trim())), "{name}: {taken:?}");
        }
        let person_name = roomcast_ipc::text::encode("name", " ").unwrap();
        let nobody = intake.take(&NarrationV1 { person_name, ..message(7, 1, 1, "They sit.") }, PORT, BootNs(10));
        assert_eq!(accepted(nobody).0.name, None);
        assert_eq!((intake.counters().malformed, intake.counters().accepted), (7, 1));
    }

    #[test]
    fn a_flooding_source_is_held_and_the_others_are_not() {
        let mut intake = Intake::new(IntakeLimits { rate_per_s: 10.0, burst: 5.0 });
        // Other names give a port no other rate.
        let taken = (1..=100).filter(|n| {
            matches!(intake.take(&message(7 + n % 3, 1, *n, "A."), PORT, BootNs(0)), Taken::Accepted { .. })
        });
        assert_eq!(taken.count(), 5);
        assert!(matches!(intake.take(&message(18, 1, 1, "B."), OTHER, BootNs(0)), Taken::Accepted { .. }));
        let later = intake.take(&message(7, 1, 101, "C."), PORT, BootNs(100_000_000));
        assert!(matches!(later, Taken::Accepted { missed: 97, .. }), "{later:?}");
    }

    #[test]
    fn the_wait_for_a_relayed_message_above_the_rate_ends() {
        let hall = source_of_name("hall");
        // The hub may have given up a message. The wait for it ends, also for the next start.
        for next in [(1, 7), (2, 1)] {
            let mut intake =
                Intake::new(IntakeLimits { rate_per_s: 1.0, burst: 1.0 }).with_narrators(&[known(1, Some(1.0), true)]);
            accepted(intake.take(&message(hall, 1, 1, "A."), PORT, BootNs(0)));
            assert_eq!(intake.take(&message(hall, 1, 2, "B."), PORT, BootNs(0)), Taken::Limited);
            let mut later = |now_ns| intake.take(&message(hall, next.0, next.1, "C."), PORT, now_ns);
            assert_eq!(later(BootNs((HELD_S - 1) * S)), Taken::Limited);
            accepted(later(BootNs(HELD_S * S)));
        }
    }

    /// The relay resends messages above the rate between new ones, at any interval.
    #[test]
    fn nothing_that_a_bridge_relays_above_the_rate_is_lost() {
        let hall = source_of_name("hall");
        for gap_ms in [300, 700, 1_000, 1_100, 1_300, 2_000, 3_000, 4_500, 6_000] {
            let limits = IntakeLimits { rate_per_s: 1000.0, burst: 5.0 };
            let mut intake = Intake::new(limits).with_narrators(&[known(1, Some(1.0), true)]);
            intake.note_alive([PORT]);
            let mut relay = Relay::new("hall", 100.0);
            let (mut offered, mut said, mut newest, mut refused) = (0, 0, 0, 0);
            for now_ns in (0..4_000).map(|tick| S + tick * 50_000_000) {
                // Six at once, one more than a burst, and then one by one.
                said = 6 + (now_ns - S) / (gap_ms * 1_000_000);
                while offered < said {
                    let next = message(hall, 1, offered + 1, "They sit.");
                    if relay.offer(1, offered + 1, 1, Some(next)) != Offered::Taken {
                        break;
                    }
                    offered += 1;
                }
                let sent: Vec<_> = std::iter::from_fn(|| relay.send(now_ns)).collect();
                for given in sent.into_iter().chain(relay.again(now_ns, true)) {
                    match intake.take(&given, PORT, BootNs(now_ns)) {
                        Taken::Accepted { missed, .. } => {
                            assert_eq!(missed, 0, "a line each {gap_ms} ms: lost before {}", given.sequence);
                            newest = given.sequence;
                        }
                        Taken::Limited => refused += 1,
                        Taken::Duplicate => {}
                        other => panic!("{other:?}"),
                    }
                }
                let (source, accepted) = (hall, intake.counters().accepted);
                let mut scores = RoomScoresV1 { epoch: 1, source_count: 1, ..Default::default() };
                scores.included[0] = IncludedV1 { source, epoch: 1, sequence: newest, accepted, ..Default::default() };
                assert_eq!(relay.confirm(&scores, now_ns), 0, "a line each {gap_ms} ms");
            }
            assert!(newest >= said.min(120) && refused > 0, "a line each {gap_ms} ms: {newest} of {said}");
        }
    }

    /// A regression: a hub without a lasting queue restarted fourteen times while the daemon was away. The daemon never confirmed starts that it did
    /// not follow, and the bridge resent their messages for ever.
    #[test]
    fn of_many_starts_that_a_bridge_relays_each_is_confirmed() {
        assert_eq!(STARTS_UNDER_WAY_MAX, SOURCES_OF_A_PORT);
        let (hall, starts) = (source_of_name("hall"), 40);
        let limits = IntakeLimits { rate_per_s: 1000.0, burst: 100.0 };
        let mut intake = Intake::new(limits).with_narrators(&[known(1, None, true)]);
        intake.note_alive([PORT]);
        let mut relay = Relay::new("hall", 100.0);
        for epoch in 1..=starts {
            assert_eq!(relay.offer(epoch, 1, 1, Some(message(hall, epoch, 1, "They sit."))), Offered::Taken);
        }
        for now_ns in (10..40).map(|tenth| tenth * S / 10) {
            for given in std::iter::from_fn(|| relay.send(now_ns)) {
                accepted(intake.take(&given, PORT, BootNs(now_ns)));
            }
            let mut scores = RoomScoresV1 { epoch: 1, source_count: intake.sources() as u32, ..Default::default() };
            for (included, ((source, epoch), known)) in scores.included.iter_mut().zip(&intake.sources) {
                let sequence = known.follower.sequence();
                *included = IncludedV1 { source: *source, epoch: *epoch, sequence, accepted: 1, ..Default::default() };
            }
            assert_eq!(relay.confirm(&scores, now_ns), 0);
        }
        assert_eq!(intake.counters().accepted, starts);
        let confirmed = relay.confirmed();
        assert_eq!((confirmed.epoch.0, confirmed.confirmed), (starts, 1));
        assert!(relay.again(1_000 * S, true).is_empty(), "nothing is left under way");
    }

    /// Row "an honest narrator's source and epoch with sequence 2^64 - 1" of the attacks.
    #[test]
    fn what_another_port_says_in_a_sources_name_is_forged() {
        let mut intake = Intake::new(IntakeLimits::default());
        accepted(intake.take(&message(7, 1, 1, "They sit."), PORT, BootNs(1)));
        for sequence in [2, 9, u64::MAX] {
            assert_eq!(intake.take(&message(7, 1, sequence, "They go to the attic."), OTHER, BootNs(2)), Taken::Forged);
        }
        // Its own port cannot jump so far either.
        assert!(matches!(intake.take(&message(7, 1, u64::MAX, "They sit."), PORT, BootNs(3)), Taken::Malformed(_)));
        let next = intake.take(&message(7, 1, 2, "They stand up."), PORT, BootNs(4));
        assert!(matches!(next, Taken::Accepted { missed: 0, .. }), "{next:?}");
        assert_eq!((intake.counters().forged, intake.counters().malformed), (3, 1));
    }

    /// A port that speaks first after a restart does not get a start of another port.
    #[test]
    fn a_restarted_daemon_knows_whose_each_source_is() {
        let mut intake = Intake::new(IntakeLimits::default());
        let binds = |taken| match taken {
            Taken::Accepted { binds, observation, .. } => (binds, observation),
            other => panic!("{other:?}"),
        };
        let (first, said) = binds(intake.take(&message(7, 1, 1, "They sit."), PORT, BootNs(1)));
        assert!(first && !binds(intake.take(&message(7, 1, 2, "They sit."), PORT, BootNs(2))).0, "it is told once");
        let mut restarted = Intake::new(IntakeLimits::default());
        restarted.restore(said.id());
        restarted.restore_port((7, 1), PORT);
        restarted.restore_port((8, 1), PORT);
        assert_eq!(restarted.sources(), 1);
        for sequence in [2, 3, u64::MAX] {
            assert_eq!(restarted.take(&message(7, 1, sequence, "They hide."), OTHER, BootNs(3)), Taken::Forged);
        }
        assert_eq!(restarted.take(&message(7, 1, 1, "They sit."), OTHER, BootNs(3)), Taken::Duplicate);
        assert!(!binds(restarted.take(&message(7, 1, 2, "They sit."), PORT, BootNs(4))).0);
        // A state database without the port binds it at once.
        let mut older = Intake::new(IntakeLimits::default());
        older.restore(said.id());
        assert_eq!(older.take(&message(7, 1, 1, "They sit."), PORT, BootNs(3)), Taken::Duplicate);
        assert!(binds(older.take(&message(7, 1, 2, "They sit."), PORT, BootNs(4))).0);
    }

    /// A regression of the chaos test: starts of ended narrators gave way to invented ones, and then any port could continue them.
    #[test]
    fn what_gave_way_is_still_whose_it_was() {
        let mut intake = Intake::new(IntakeLimits { rate_per_s: 0.0, burst: 1.0 });
        let (said, ..) = accepted(intake.take(&message(7, 1, 5, "They sit."), PORT, BootNs(1)));
        // The narrator has ended, and others invent sources, some from many ports.
        let invent = |intake: &mut Intake| {
            intake.note_alive([OTHER]);
            for n in 0..10_000 {
                let port = if n % 2 == 0 { OTHER } else { Sender::simulated(3 + n % 40) };
                accepted(intake.take(&message(1000 + n, 1, 1, "B."), port, BootNs(2)));
            }
        };
        invent(&mut intake);
        for sequence in [6, 7, u64::MAX] {
            assert_eq!(
                intake.take(&message(7, 1, sequence, "They hide."), OTHER, BootNs(3)),
                Taken::Forged,
                "{sequence}"
            );
        }
        assert_eq!(intake.take(&message(7, 1, 5, "They sit."), OTHER, BootNs(3)), Taken::Duplicate);
        assert!(intake.former.len() <= FORMER_SOURCES_MAX);
        // After a restart, the invented ones are the newest in the state database.
        let mut restarted = Intake::new(IntakeLimits::default());
        restarted.restore(said.id());
        for source in 1000..1100 {
            restarted.restore(EventId { source, ..said.id() });
        }
        restarted.restore_port((7, 1), PORT);
        assert_eq!(restarted.take(&message(7, 1, 6, "They hide."), OTHER, BootNs(3)), Taken::Forged);
        assert!(matches!(
            restarted.take(&message(7, 1, 7, "They sit."), PORT, BootNs(3)),
            Taken::Accepted { missed: 1, .. }
        ));
    }

    /// A port that uses the name of an open port gets none of its quota.
    #[test]
    fn the_name_of_a_living_narrator_gives_nobody_its_quota() {
        let mut intake = Intake::new(IntakeLimits::default()).with_narrators(&[known(4, None, false)]);
        let hall = source_of_name("hall");
        let mut quota = |epoch, port, alive: &[Sender]| {
            intake.note_alive(alive.iter().copied());
            accepted(intake.take(&message(hall, epoch, 1, "A."), port, BootNs(epoch))).1
        };
        let own = quota(1, PORT, &[PORT]);
        let stranger = quota(2, OTHER, &[PORT, OTHER]);
        assert_eq!((own.share, stranger), (4, Quota { number: OTHERS, share: 1 }));
        assert_eq!(quota(3, PORT, &[PORT, OTHER]), own);
        let next = Sender::simulated(3);
        assert_eq!(quota(4, next, &[OTHER, next]), own);
        assert_eq!(quota(5, OTHER, &[OTHER, next]), stranger);
        assert!(intake.is_contested(hall, 1, OTHER) && !intake.is_contested(hall, 1, next));
    }

    /// A restarted narrator does not share the window with its own past. A port that uses the name of an open port gains nothing.
    #[test]
    fn a_narrator_that_starts_again_keeps_its_quota() {
        let [third, fourth] = [3, 4].map(Sender::simulated);
        // Starts of one narrator, each on a port, with the open ports at that time.
        let quotas = |starts: &[(Sender, &[Sender])]| -> Vec<Quota> {
            let mut intake = Intake::new(IntakeLimits::default());
            let start = |(epoch, (port, alive)): (u64, &(Sender, &[Sender]))| {
                intake.note_alive(alive.iter().copied());
                accepted(intake.take(&message(7, epoch, 1, "They sit."), *port, BootNs(epoch))).1
            };
            (1..).zip(starts).map(start).collect()
        };
        // The first port is open, and the last speaker of this name had another quota.
        let told = quotas(&[(PORT, &[PORT]), (OTHER, &[PORT, OTHER]), (third, &[PORT, third])]);
        assert!(told[1] != told[0] && told[2] != told[0], "{told:?}");
        let told = quotas(&[(PORT, &[PORT]), (OTHER, &[OTHER]), (third, &[third]), (fourth, &[third, fourth])]);
        assert!(told[1] == told[0] && told[2] == told[0] && told[3] != told[0], "{told:?}");
    }

    #[test]
    fn a_bridge_that_starts_again_goes_on_for_the_narrator_elsewhere() {
        let hall = source_of_name("hall");
        let third = Sender::simulated(3);
        for relayed in [false, true] {
            let mut intake = Intake::new(IntakeLimits::default()).with_narrators(&[known(1, None, relayed)]);
            intake.note_alive([PORT]);
            let (first, ..) = accepted(intake.take(&message(hall, 1, 1, "A."), PORT, BootNs(0)));
            intake.note_alive([PORT, OTHER]);
            assert_eq!(intake.take(&message(hall, 1, 2, "B."), OTHER, BootNs(0)), Taken::Forged, "its port is open");
            assert!(intake.is_contested(hall, 1, OTHER));
            intake.note_alive([OTHER, third]);
            assert_eq!(intake.take(&message(hall, 1, 1, "A."), OTHER, BootNs(0)), Taken::Duplicate);
            let taken = intake.take(&message(hall, 1, 2, "B."), OTHER, BootNs(0));
            if relayed {
                assert!(matches!(taken, Taken::Accepted { binds: true, missed: 0, .. }), "{taken:?}");
                assert_eq!(intake.take(&message(hall, 1, 3, "C."), third, BootNs(0)), Taken::Forged);
                // Another port also continues after a restart of the daemon, by the restored port.
                let mut next = Intake::new(IntakeLimits::default()).with_narrators(&[known(1, None, true)]);
                next.restore(first.id());
                next.restore_port((hall, 1), PORT);
                next.note_alive([third]);
                accepted(next.take(&message(hall, 1, 2, "B."), third, BootNs(0)));
            } else {
                assert_eq!(taken, Taken::Forged);
            }
        }
    }

    /// Row "64 invented sources" of the attacks: open ports keep their starts, their memory and their quota, also after a restart.
    #[test]
    fn invented_sources_lock_nobody_out() {
        let mut intake = Intake::new(IntakeLimits::default());
        intake.note_alive([PORT, OTHER]);
        accepted(intake.take(&message(1, 1, 1, "A."), PORT, BootNs(0)));
        for source in 2..10_000 {
            let (_, quota, _) = accepted(intake.take(&message(source, 1, 1, "B."), OTHER, BootNs(source * 10_000_000)));
            assert_eq!(
                quota,
                accepted(intake.take(&message(source, 1, 2, "B."), OTHER, BootNs(source * 10_000_000))).1
            );
        }
        assert_eq!(intake.sources(), 1 + SOURCES_OF_A_PORT);
        assert_eq!(intake.take(&message(1, 1, 1, "A."), PORT, BootNs(0)), Taken::Duplicate);
        // Ended processes leave their starts until others need the places.
        for port in 3..1000 {
            let sender = Sender::simulated(port);
            intake.note_alive([PORT, OTHER, sender]);
            (0..8).for_each(|n| drop(intake.take(&message(port * 10_000 + n, 1, 1, "C."), sender, BootNs(1 << 40))));
        }
        assert_eq!(intake.sources(), SOURCES_MAX);
        assert_eq!(intake.take(&message(1, 1, 2, "A."), OTHER, BootNs(1 << 40)), Taken::Forged);
        accepted(intake.take(&message(1, 1, 2, "A."), PORT, BootNs(1 << 40)));

        let (said, ..) = accepted(Intake::default().take(&message(1, 1, 1, "A."), PORT, BootNs(0)));
        let mut restarted = Intake::new(IntakeLimits::default());
        for source in 1..=100 {
            restarted.restore(EventId { source, ..said.id() });
        }
        assert_eq!(restarted.sources(), SOURCES_MAX);
        assert_eq!(restarted.take(&message(100, 1, 1, "A."), PORT, BootNs(8)), Taken::Duplicate);
        for source in 1001..1009 {
            accepted(restarted.take(&message(source, 1, 1, "A."), Sender::simulated(source), BootNs(8)));
        }
    }

    /// Unknown narrators share one quota, so more processes get no more of a window.
    #[test]
    fn narrators_that_are_named_have_quotas_of_their_own() {
        let limits = IntakeLimits { rate_per_s: 1.0, burst: 2.0 };
        let mut intake = Intake::new(limits).with_narrators(&[known(4, Some(0.0), false)]);
        let hall = source_of_name("hall");
        let quota = |taken| accepted(taken).1;
        let own = quota(intake.take(&message(hall, 1, 1, "A."), PORT, BootNs(0)));
        assert_eq!(own.share, 4);
        (2..100).for_each(|n| drop(accepted(intake.take(&message(hall, 1, n, "A."), PORT, BootNs(0)))));
        let others: Vec<_> =
            (2..9).map(|n| quota(intake.take(&message(n, 1, 1, "A."), Sender::simulated(n), BootNs(0)))).collect();
        assert!(others.iter().all(|other| *other == others[0] && *other != own));
        // Of the starts without an open port, those of named narrators stay longest.
        let (said, ..) = accepted(intake.take(&message(3, 1, 2, "A."), Sender::simulated(3), BootNs(0)));
        for source in 0..100 {
            intake.restore(EventId { source: 50 + source, ..said.id() });
        }
        assert_eq!(intake.take(&message(hall, 1, 99, "A."), PORT, BootNs(0)), Taken::Duplicate);
    }

    /// Row "a sentence of one kilobyte that makes some 1 000 tokens" of the attacks.
    #[test]
    fn a_sentence_is_refused_by_what_it_costs() {
        let most = Arc::new(AtomicUsize::new(100));
        let cost = SentenceCost::new(Arc::new(|text| 2 * text.split(' ').count()), Arc::clone(&most));
        let mut intake = Intake::new(IntakeLimits::default()).with_cost(cost);
        let long = "A ".repeat(60);
        let taken = intake.take(&message(7, 1, 1, &long), PORT, BootNs(0));
        assert_eq!(taken, Taken::Costly { tokens: 121, most: 100, first: true });
        assert!(matches!(intake.take(&message(7, 1, 2, &long), PORT, BootNs(0)), Taken::Costly { first: false, .. }));
        // It is done: it does not count as missed, and a repetition is a duplicate.
        assert!(matches!(intake.take(&message(7, 1, 3, "A."), PORT, BootNs(0)), Taken::Accepted { missed: 0, .. }));
        assert_eq!(intake.take(&message(7, 1, 1, &long), PORT, BootNs(0)), Taken::Duplicate);
        // Words count, not bytes; a map with more labels leaves less room.
        accepted(intake.take(&message(7, 1, 4, &"abcdefghij ".repeat(49)), PORT, BootNs(0)));
        most.store(20, Ordering::Relaxed);
        assert!(matches!(intake.take(&message(7, 1, 5, &"abc ".repeat(10)), PORT, BootNs(0)), Taken::Costly { .. }));
        assert_eq!(intake.counters().costly, 3);
    }

    #[test]
    fn an_event_of_a_fast_clock_counts_as_observed_now_and_is_counted() {
        let (now_ns, unix_ns) = (100 * S, 1_000_000 * S);
        let mut intake = Intake::new(IntakeLimits::default());
        // The lead of the clock, the age of the event, and the resulting lead of its time, in seconds.
        for (sequence, (fast_s, age_s, ahead_s)) in (1..).zip([(0, 0, 0), (2, 0, 2), (2, 1, 1), (59, 0, 59), (2, 5, 0)])
        {
            let dated = NarrationV1 {
                observed_ns: now_ns + fast_s * S - age_s * S,
                observed_unix_ns: unix_ns + fast_s * S - age_s * S,
                ..message(7, 1, sequence, "A.")
            };
            let before = intake.counters();
            let (observation, ..) = accepted(intake.take(&dated, PORT, BootNs(now_ns)));
            let late_s = (age_s.saturating_sub(fast_s)) * S;
            assert_eq!(
                (observation.observed_ns, observation.observed_unix_ns),
                (BootNs(now_ns - late_s), UnixNs(unix_ns - late_s))
            );
            let counters = intake.counters();
            let is_told = ahead_s > 1;
            assert_eq!(counters.ahead - before.ahead, u64::from(is_told), "{fast_s} s fast");
            assert!(!is_told || counters.ahead_ns == ahead_s * S);
        }
    }

    #[test]
    fn a_narrator_can_date_an_observation_neither_into_the_future_nor_to_the_boot() {
        for (observed_ns, expected) in [(u64::MAX, 99), (0, 99), (98, 98)] {
            let mut intake = Intake::new(IntakeLimits::default());
            let dated = NarrationV1 { observed_ns, ..message(7, 1, 1, "A.") };
            assert_eq!(accepted(intake.take(&dated, PORT, BootNs(99))).0.observed_ns, BootNs(expected));
        }
    }
}
