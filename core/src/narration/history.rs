//! The history window N_h: the last observations of one person, as many as the prompt may hold.

use std::collections::{BTreeMap, VecDeque};

use serde::{Deserialize, Serialize};

use super::Observation;
use crate::ids::PersonId;

/// Most persons with a history; a new person replaces the person without an event for longest.
pub const PERSONS_MAX: usize = 64;
/// Most observations that a window can be asked for.
pub const OBSERVATIONS_MAX: usize = 1000;
/// For so long a narrator keeps its places in a window against others, in nanoseconds of observed time: ten minutes.
pub const KEPT_NS: u64 = 600_000_000_000;

/// The owner of an observation. From a full window, the quota that holds most places or tokens for its share loses its oldest observation. So each
/// quota keeps its observations of the last [`KEPT_NS`], up to its share, however much the others say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quota {
    /// Its number.
    pub number: u64,
    /// Its places for each place of a quota of share 1.
    pub share: u32,
}

impl Quota {
    /// The quota of all observations from before a restart: the window keeps no places for it.
    pub const EARLIER: Self = Self { number: 0, share: 1 };

    /// A source with a share of 1, if the configuration does not name it.
    #[must_use]
    pub fn of_source(source: u64) -> Self {
        Self { number: source, share: 1 }
    }
}

/// How much of the past a prompt holds. With `slack` 0 the window is the paper's: the last n_h observations, and the prompt's beginning changes at
/// every event. With slack it grows to n_h + slack before it is cut back to n_h, so that the model's read prompt stays valid between two cuts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HistoryLimits {
    /// n_h: this many of the last observations stay, if the tokens allow. At least 1.
    pub observations: usize,
    /// How many more may gather before the window is cut back.
    pub slack: usize,
    /// Most tokens of all sentences together. A sentence that alone exceeds them never enters: nothing could be scored with it.
    pub tokens: usize,
    /// An observation that comes more than this many seconds after all others begins a new window. 0 means no limit.
    pub gap_s: u64,
}

impl HistoryLimits {
    /// The paper's window of exactly the last `observations`, however long they are and however long ago.
    #[must_use]
    pub fn exact(observations: usize) -> Self {
        Self { observations, slack: 0, tokens: usize::MAX, gap_s: 0 }
    }

    /// Whether this time is a gap.
    #[must_use]
    pub fn is_gap(&self, seconds: f64) -> bool {
        self.gap_s > 0 && seconds > self.gap_s as f64
    }
}

impl Default for HistoryLimits {
    /// 12 to 16 observations, the length that the shipped model was trained on, 1024 tokens, and an hour.
    fn default() -> Self {
        Self { observations: 12, slack: 4, tokens: 1024, gap_s: 3600 }
    }
}

#[derive(Debug, Clone)]
struct Held {
    observation: Observation,
    tokens: usize,
    quota: Quota,
}

/// The window of one person. Observations enter at the end and leave as [`Quota`] says.
#[derive(Debug, Clone)]
pub struct History {
    limits: HistoryLimits,
    window: VecDeque<Held>,
    tokens: usize,
    left: u64,
}

impl History {
    /// An empty window. `observations` of 0 is taken as 1.
    #[must_use]
    pub fn new(limits: HistoryLimits) -> Self {
        let limits = HistoryLimits { observations: limits.observations.max(1), ..limits };
        Self { limits, window: VecDeque::new(), tokens: 0, left: 0 }
    }

    /// Appends an observation of its source's own quota; see [`History::hear`].
    pub fn push(&mut self, observation: Observation, tokens: usize) -> usize {
        let quota = Quota::of_source(observation.source);
        self.hear(observation, quota, tokens)
    }

    /// Appends an observation with a sentence of `tokens` tokens; without a tokeniser its length in bytes is a safe bound. Gives how many observations
    /// left: also this one, if it has more tokens than the window, or than its quota's share of a full one.
    pub fn hear(&mut self, observation: Observation, quota: Quota, tokens: usize) -> usize {
        if tokens > self.limits.tokens {
            return 1;
        }
        // A late observation begins no window if another observation of that time is there.
        let apart = self.window.iter().filter_map(|held| observation.seconds_after(&held.observation)).reduce(f64::min);
        let ended = if apart.is_some_and(|seconds| self.limits.is_gap(seconds)) { self.end() } else { 0 };
        self.window.push_back(Held { observation, tokens, quota });
        self.tokens = self.tokens.saturating_add(tokens);
        ended + self.cut()
    }

    /// The newest observation, and the quota that it was heard as.
    pub(crate) fn newest(&self) -> Option<(Observation, Quota)> {
        self.window.back().map(|held| (held.observation.clone(), held.quota))
    }

    /// Empties the window: the next observation does not follow from it. Gives how many observations left.
    pub fn end(&mut self) -> usize {
        self.keep(|_| false)
    }

    /// Removes the observations that `is_kept` does not select. Gives how many observations left.
    fn keep(&mut self, is_kept: impl Fn(&Held) -> bool) -> usize {
        let before = self.window.len();
        self.window.retain(is_kept);
        self.tokens = self.window.iter().map(|held| held.tokens).sum();
        let left = before - self.window.len();
        self.left += left as u64;
        left
    }

    /// Cuts a window that has grown beyond its limits. Gives how many observations left.
    fn cut(&mut self) -> usize {
        let high = self.limits.observations.saturating_add(self.limits.slack);
        if self.window.len() <= high && self.tokens <= self.limits.tokens {
            return 0;
        }
        // Cut tokens back by the same share as observations, so that a window bound by tokens is as stable.
        let tokens_low = self.limits.tokens as u128 * self.limits.observations as u128 / high.max(1) as u128;
        let before = self.window.len();
        let is_over = self.tokens > self.limits.tokens;
        while self.window.len() > 1 {
            // First the tokens: their excess may be all that has to leave.
            let by_tokens = is_over && self.tokens as u128 > tokens_low;
            if !by_tokens && self.window.len() <= self.limits.observations {
                break;
            }
            let place = self.next_to_leave(by_tokens);
            self.tokens -= self.window.remove(place).map_or(0, |gone| gone.tokens);
        }
        let left = before - self.window.len();
        self.left += left as u64;
        left
    }

    /// The observation that leaves next: an expired one, else the oldest of the quota that holds most for its share. The newest leaves only if
    /// it alone has more tokens than that share: otherwise a long sentence would remove all others.
    fn next_to_leave(&self, by_tokens: bool) -> usize {
        let first = self.window[0].quota;
        if self.window.iter().all(|held| held.quota.number == first.number) {
            return 0;
        }
        let observed_ns = |held: &Held| held.observation.observed_ns;
        let newest_ns = self.window.iter().map(observed_ns).max().unwrap_or_default();
        let others = self.window.len() - 1;
        let expired = |held: &Held| held.quota == Quota::EARLIER || newest_ns.since(observed_ns(held)) > KEPT_NS;
        if let Some(place) = self.window.iter().take(others).position(expired) {
            return place;
        }
        let holds = |quota: Quota| {
            let own = self.window.iter().filter(|held| held.quota.number == quota.number);
            own.map(|held| if by_tokens { held.tokens as u128 } else { 1 }).sum::<u128>()
        };
        let mut most = (0, first);
        for (place, own) in self.window.iter().take(others + usize::from(by_tokens)).enumerate() {
            // Of equal ones, the one that spoke first.
            let (_, than) = most;
            if own.quota != than
                && holds(own.quota) * u128::from(than.share) > holds(than) * u128::from(own.quota.share)
            {
                most = (place, own.quota);
            }
        }
        most.0
    }

    /// How many observations leave with the next cut, and how many arrive until then, if one quota speaks. `None` while the window has more places.
    pub(crate) fn next_cut(&self) -> Option<(usize, usize)> {
        let over = self.limits.observations.saturating_add(self.limits.slack).saturating_add(1);
        let is_near = self.window.len() >= self.limits.observations;
        is_near.then(|| (over - self.limits.observations, over.saturating_sub(self.window.len()).max(1)))
    }

    /// The sentences, oldest first.
    pub fn sentences(&self) -> impl DoubleEndedIterator<Item = &str> + ExactSizeIterator {
        self.window.iter().map(|held| held.observation.sentence().unwrap_or_default())
    }

    /// The observations, oldest first.
    pub fn observations(&self) -> impl DoubleEndedIterator<Item = &Observation> + ExactSizeIterator {
        self.window.iter().map(|held| &held.observation)
    }

    /// How many observations the window holds.
    #[must_use]
    pub fn len(&self) -> usize {
        self.window.len()
    }

    /// Nothing observed yet.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.window.is_empty()
    }

    /// How many observations have left since the start: it changes exactly when the prompt's beginning does.
    #[must_use]
    pub fn left(&self) -> u64 {
        self.left
    }

    /// How many observations have entered since the start.
    #[must_use]
    pub fn told(&self) -> u64 {
        self.left + self.window.len() as u64
    }
}

/// One history per person, at most [`PERSONS_MAX`].
#[derive(Debug, Clone)]
pub struct Histories {
    limits: HistoryLimits,
    by_person: BTreeMap<PersonId, (u64, History)>,
    pushes: u64,
}

impl Histories {
    /// No persons.
    #[must_use]
    pub fn new(limits: HistoryLimits) -> Self {
        Self { limits, by_person: BTreeMap::new(), pushes: 0 }
    }

    /// The history of a person; a new one if there is none.
    pub fn known(&mut self, person: PersonId) -> &mut History {
        self.pushes += 1;
        if self.by_person.len() >= PERSONS_MAX && !self.by_person.contains_key(&person) {
            let oldest = self.by_person.iter().min_by_key(|(_, (seen, _))| *seen).map(|(person, _)| *person);
            oldest.and_then(|oldest| self.by_person.remove(&oldest));
        }
        let (seen, history) = self.by_person.entry(person).or_insert_with(|| (0, History::new(self.limits)));
        *seen = self.pushes;
        history
    }

    /// The history of a person, if anything of them is known.
    #[must_use]
    pub fn get(&self, person: PersonId) -> Option<&History> {
        self.by_person.get(&person).map(|(_, history)| history)
    }

    /// The history of a person, to end it.
    pub fn get_mut(&mut self, person: PersonId) -> Option<&mut History> {
        self.by_person.get_mut(&person).map(|(_, history)| history)
    }

    /// Persons and their histories, by id.
    pub fn iter(&self) -> impl Iterator<Item = (PersonId, &History)> {
        self.by_person.iter().map(|(person, (_, history))| (*person, history))
    }

    /// Removes the observations that `is_it` selects from all histories. Gives the persons of the histories that had some.
    pub(crate) fn forget(&mut self, is_it: impl Fn(&Observation) -> bool) -> Vec<PersonId> {
        let histories = self.by_person.iter_mut();
        let changed = histories.filter_map(|(person, (_, history))| {
            (history.keep(|held| !is_it(&held.observation)) > 0).then_some(*person)
        });
        changed.collect()
    }

    /// Sets how many tokens each window may hold, for a prompt that has less room than before.
    pub(crate) fn limit_tokens(&mut self, tokens: usize) {
        self.limits.tokens = tokens;
        for (_, history) in self.by_person.values_mut() {
            history.limits.tokens = tokens;
            history.keep(|held| held.tokens <= tokens);
            history.cut();
        }
    }

    /// All present observations are from before a restart: the windows keep no places for them.
    pub(crate) fn forget_quotas(&mut self) {
        let held = self.by_person.values_mut().flat_map(|(_, history)| &mut history.window);
        held.for_each(|held| held.quota = Quota::EARLIER);
    }

    /// Forgets a person, such as a visitor that has left.
    pub fn remove(&mut self, person: PersonId) -> Option<History> {
        self.by_person.remove(&person).map(|(_, history)| history)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{BootNs, UnixNs};
    use crate::narration::Sentence;
    use proptest::prelude::*;

    fn said(source: u64, sequence: u64) -> Observation {
        let own = Observation::of(sequence, Sentence::new("They sit.").unwrap());
        Observation { source, observed_ns: BootNs(sequence), observed_unix_ns: UnixNs(sequence), ..own }
    }

    fn sequences(history: &History) -> Vec<u64> {
        history.observations().map(|o| o.sequence).collect()
    }

    fn of_source(history: &History, source: u64) -> usize {
        history.observations().filter(|own| own.source == source).count()
    }

    #[test]
    fn with_slack_it_is_cut_back_seldom() {
        let mut history = History::new(HistoryLimits { observations: 3, slack: 2, tokens: 1000, gap_s: 0 });
        let left = [0, 1, 2, 3, 4, 5, 6, 7, 8].map(|i| history.push(said(1, i), 5));
        assert_eq!((left, sequences(&history), history.left()), ([0, 0, 0, 0, 0, 3, 0, 0, 3], vec![6, 7, 8], 6));
    }

    /// Events of hours ago do not predict the next one.
    #[test]
    fn a_gap_in_time_begins_a_new_window() {
        const S: u64 = 1_000_000_000;
        let at = |sequence: u64, monotonic_s: u64, unix_s: u64| Observation {
            observed_ns: BootNs(monotonic_s * S),
            observed_unix_ns: UnixNs(unix_s * S),
            ..said(1, sequence)
        };
        let mut history = History::new(HistoryLimits { gap_s: 60, ..HistoryLimits::default() });
        // The monotonic and the wall clock in seconds, and the first observation of the window. The machine starts before 4, 6 has no clock, the
        // wall clock is put back before 8, and 9 is late.
        const STEPS: &str = "10 0 1|70 0 1|131 500 3|0 550 3|5 611 5|0 0 5|9000 9000 7|9030 1 7|8900 1 7|9040 1 7";
        for (number, step) in (1..).zip(STEPS.split('|')) {
            let step: Vec<u64> = step.split(' ').map(|number| number.parse().unwrap()).collect();
            history.push(at(number, step[0], step[1]), 5);
            assert_eq!(sequences(&history), (step[2]..=number).collect::<Vec<_>>());
        }
        assert_eq!((history.end(), history.len(), history.left()), (4, 0, 10));
        let mut patient = History::new(HistoryLimits { gap_s: 0, ..HistoryLimits::default() });
        patient.push(at(1, 10, 10), 5);
        assert_eq!(patient.push(at(2, 1_000_000, 1_000_000), 5), 0);
    }

    /// The attack "a sentence of one kilobyte".
    #[test]
    fn sentences_with_more_tokens_than_the_window_never_enter() {
        let mut histories = Histories::new(HistoryLimits { observations: 8, slack: 0, tokens: 20, gap_s: 0 });
        let history = histories.known(PersonId(0));
        assert_eq!([(0, 5), (1, 21), (2, 5)].map(|(n, tokens)| history.push(said(1, n), tokens)), [0, 1, 0]);
        assert_eq!(sequences(history), [0, 2]);
        // A map with more labels leaves less room.
        histories.limit_tokens(4);
        assert!(histories.known(PersonId(0)).is_empty());
    }

    /// The attack "one narrator with long permitted sentences": each of them alone would fill the window.
    #[test]
    fn long_sentences_leave_the_others_their_part() {
        let mut history = History::new(HistoryLimits::default());
        (0..12).for_each(|n| _ = history.push(said(1, n), 20));
        for n in 12..100 {
            assert_eq!(history.push(said(2, n), 1000), 1, "it has no place among the others");
        }
        assert_eq!(sequences(&history), (0..12).collect::<Vec<_>>());
        // As many as go into its share stay.
        (100..200).for_each(|n| _ = history.push(said(2, n), 150));
        let (honest, held) = (of_source(&history, 1), history.len());
        assert!(honest >= 6 && history.observations().next_back().unwrap().sequence == 199, "{honest} of {held}");
        // Alone it has the whole window.
        let mut alone = History::new(HistoryLimits::default());
        (0..100).for_each(|n| _ = alone.push(said(2, n), 1000));
        assert_eq!(sequences(&alone), [99]);
    }

    #[test]
    fn no_quota_keeps_observations_for_more_than_ten_minutes() {
        let mut history = History::new(HistoryLimits::exact(4));
        (0..2).for_each(|n| _ = history.push(said(1, n), 5));
        let later = |n| Observation { observed_ns: BootNs(KEPT_NS + 10 + n), ..said(2, n) };
        (2..6).for_each(|n| _ = history.push(later(n), 5));
        assert_eq!(sequences(&history), [2, 3, 4, 5]);
    }

    #[test]
    fn a_larger_share_keeps_more_places() {
        let mut histories = Histories::new(HistoryLimits::exact(12));
        let history = histories.known(PersonId(0));
        (0..12).for_each(|n| _ = history.hear(said(1, n), Quota { number: 1, share: 3 }, 5));
        (12..100).for_each(|n| _ = history.push(said(2, n), 5));
        assert_eq!(of_source(history, 1), 9);
        // After a restart the oldest go first.
        let before = sequences(history);
        histories.forget_quotas();
        let history = histories.known(PersonId(0));
        (100..105).for_each(|n| _ = history.push(said(3, n), 5));
        assert_eq!(sequences(history)[..7], before[5..]);
    }

    #[test]
    fn persons_are_bounded() {
        let mut histories = Histories::new(HistoryLimits::default());
        (0..1000).for_each(|person| _ = histories.known(PersonId(person)));
        assert_eq!(histories.iter().count(), PERSONS_MAX);
        assert!(histories.get(PersonId(999)).is_some() && histories.get(PersonId(0)).is_none());
        assert!(histories.remove(PersonId(999)).is_some() && histories.get(PersonId(999)).is_none());
    }

    proptest! {
        #[test]
        fn the_window_is_a_recent_run_within_its_limits(
            observations in 0usize..6, slack in 0usize..6, tokens in 0usize..60,
            costs in prop::collection::vec(0usize..20, 1..80),
        ) {
            let mut history = History::new(HistoryLimits { observations, slack, tokens, gap_s: 0 });
            for (i, cost) in costs.iter().enumerate() {
                let before = history.len();
                let left = history.push(said(1, i as u64), *cost);
                prop_assert_eq!(history.len(), before + 1 - left);
                let fit: Vec<u64> = (0..=i as u64).filter(|i| costs[*i as usize] <= tokens).collect();
                let first = fit.len() - history.len();
                prop_assert_eq!(sequences(&history), &fit[first..]);
                prop_assert_eq!(history.left(), first as u64);
                prop_assert!(history.len() <= observations.max(1) + slack);
                let held: usize = fit[first..].iter().map(|i| costs[*i as usize]).sum();
                prop_assert!(held <= tokens);
            }
        }

        /// However the others flood, and with however long sentences, a quota keeps its newest observations up to its share of the places, less
        /// one for the rounding, and of the tokens that a cut leaves.
        #[test]
        fn a_narrator_keeps_its_share(
            observations in 1usize..20, slack in 0usize..6, tokens in 1usize..300, quotas in 2u64..5,
            said_by in prop::collection::vec((0u64..5, 1usize..400), 1..200),
        ) {
            let mut history = History::new(HistoryLimits { observations, slack, tokens, gap_s: 0 });
            for (i, (quota, cost)) in said_by.iter().enumerate() {
                history.push(said(1 + quota % quotas, i as u64), *cost);
            }
            let left_by_a_cut = tokens * observations / (observations + slack);
            for quota in 0..quotas {
                let own = |(i, (by, cost)): (u64, &(u64, usize))| (by % quotas == quota && *cost <= tokens).then_some((i, *cost));
                let own: Vec<(u64, usize)> = (0..).zip(&said_by).filter_map(own).collect();
                let mut sum = 0;
                let due = own.iter().rev().take(observations / quotas as usize);
                let due: Vec<u64> = due.take_while(|(_, cost)| { sum += cost; sum * quotas as usize <= left_by_a_cut }).map(|(i, _)| *i).collect();
                let held: Vec<u64> = history.observations().filter(|o| o.source == 1 + quota).map(|o| o.sequence).collect();
                prop_assert!(due.iter().all(|due| held.contains(due)), "{held:?} of {own:?}, due {due:?}");
            }
        }
    }
}
