//! The history window N_h: the last observations of one person, as many as the prompt may hold.

use std::collections::{BTreeMap, VecDeque};

use serde::{Deserialize, Serialize};

use super::Observation;

/// Most persons whose histories are kept; the one seen longest ago makes room for a new one.
pub const PERSONS_MAX: usize = 64;
/// Most observations that a window can be asked for.
pub const OBSERVATIONS_MAX: usize = 1000;

/// How much of the past a prompt holds.
///
/// With `slack` 0 the window is the paper's: the last n_h observations, and the prompt's beginning changes at every
/// event. With slack it grows to n_h + slack before it is cut back to n_h, so that between two cuts the prompt only
/// gets longer and what the model has already read of it stays valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HistoryLimits {
    /// n_h: at least this many of the last observations stay, if the tokens allow. At least 1.
    pub observations: usize,
    /// How many more may gather before the window is cut back.
    pub slack: usize,
    /// Most tokens of all sentences together; the newest observation stays even if it alone exceeds them.
    pub tokens: usize,
}

impl HistoryLimits {
    /// The paper's window of exactly the last `observations`, however long they are.
    #[must_use]
    pub fn exact(observations: usize) -> Self {
        Self { observations, slack: 0, tokens: usize::MAX }
    }
}

impl Default for HistoryLimits {
    /// 12 to 16 observations, the length that the shipped model was trained on, and 1024 tokens.
    fn default() -> Self {
        Self { observations: 12, slack: 4, tokens: 1024 }
    }
}

/// The window of one person. Observations enter at the end and leave at the front, whole.
#[derive(Debug, Clone)]
pub struct History {
    limits: HistoryLimits,
    window: VecDeque<(Observation, usize)>,
    tokens: usize,
    left: u64,
}

impl History {
    /// An empty window. `observations` of 0 is taken as 1: a forecast without narration is a binding of its own.
    #[must_use]
    pub fn new(limits: HistoryLimits) -> Self {
        let limits = HistoryLimits { observations: limits.observations.max(1), ..limits };
        Self { limits, window: VecDeque::new(), tokens: 0, left: 0 }
    }

    /// Appends an observation whose sentence costs `tokens`; without a tokeniser its length in bytes is a safe bound.
    /// Gives how many observations left the window.
    pub fn push(&mut self, observation: Observation, tokens: usize) -> usize {
        self.window.push_back((observation, tokens));
        self.tokens = self.tokens.saturating_add(tokens);
        self.cut()
    }

    /// Sets how many tokens the window may hold, and cuts it at once if it holds more.
    fn limit_tokens(&mut self, tokens: usize) {
        self.limits.tokens = tokens;
        self.cut();
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
        let over_tokens = self.tokens > self.limits.tokens;
        while self.window.len() > 1
            && (self.window.len() > self.limits.observations || (over_tokens && self.tokens as u128 > tokens_low))
        {
            if let Some((_, tokens)) = self.window.pop_front() {
                self.tokens -= tokens;
            }
        }
        let left = before - self.window.len();
        self.left += left as u64;
        left
    }

    /// Cuts a window that is full now rather than at the next observation, so that the work this makes is done while
    /// nobody waits. Gives how many observations left; always 0 without slack, where the window is exact.
    pub(crate) fn compact(&mut self) -> usize {
        let high = self.limits.observations.saturating_add(self.limits.slack);
        if self.limits.slack == 0 || self.window.len() < high {
            return 0;
        }
        let left = self.window.len() - self.limits.observations;
        for (_, tokens) in self.window.drain(..left) {
            self.tokens -= tokens;
        }
        self.left += left as u64;
        left
    }

    /// The sentences, oldest first.
    pub fn sentences(&self) -> impl DoubleEndedIterator<Item = &str> + ExactSizeIterator {
        self.window.iter().map(|(observation, _)| observation.sentence.as_str())
    }

    /// The observations, oldest first.
    pub fn observations(&self) -> impl DoubleEndedIterator<Item = &Observation> + ExactSizeIterator {
        self.window.iter().map(|(observation, _)| observation)
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
}

/// One history per person, at most [`PERSONS_MAX`].
#[derive(Debug, Clone)]
pub struct Histories {
    limits: HistoryLimits,
    by_person: BTreeMap<u32, (u64, History)>,
    pushes: u64,
}

impl Histories {
    /// Nobody yet.
    #[must_use]
    pub fn new(limits: HistoryLimits) -> Self {
        Self { limits, by_person: BTreeMap::new(), pushes: 0 }
    }

    /// Appends to the history of the observation's person; see [`History::push`].
    pub fn push(&mut self, observation: Observation, tokens: usize) -> usize {
        self.pushes += 1;
        let person = observation.person;
        if self.by_person.len() >= PERSONS_MAX && !self.by_person.contains_key(&person) {
            let oldest = self.by_person.iter().min_by_key(|(_, (seen, _))| *seen).map(|(person, _)| *person);
            if let Some(oldest) = oldest {
                self.by_person.remove(&oldest);
            }
        }
        let (seen, history) = self.by_person.entry(person).or_insert_with(|| (0, History::new(self.limits)));
        *seen = self.pushes;
        history.push(observation, tokens)
    }

    /// The history of a person, if anything of them is known.
    #[must_use]
    pub fn get(&self, person: u32) -> Option<&History> {
        self.by_person.get(&person).map(|(_, history)| history)
    }

    /// The history of a person, to compact it.
    pub fn get_mut(&mut self, person: u32) -> Option<&mut History> {
        self.by_person.get_mut(&person).map(|(_, history)| history)
    }

    /// Persons and their histories, by id.
    pub fn iter(&self) -> impl Iterator<Item = (u32, &History)> {
        self.by_person.iter().map(|(person, (_, history))| (*person, history))
    }

    /// Sets how many tokens each window may hold, for a prompt that has less room than before.
    pub(crate) fn limit_tokens(&mut self, tokens: usize) {
        self.limits.tokens = tokens;
        self.by_person.values_mut().for_each(|(_, history)| history.limit_tokens(tokens));
    }

    /// Forgets a person, for instance one who has left.
    pub fn remove(&mut self, person: u32) -> Option<History> {
        self.by_person.remove(&person).map(|(_, history)| history)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::narration::Sentence;
    use proptest::prelude::*;

    fn observation(person: u32, sequence: u64) -> Observation {
        Observation {
            person,
            source: 1,
            epoch: 1,
            sequence,
            observed_ns: sequence,
            observed_unix_ns: sequence,
            sentence: Sentence::new(&format!("They do thing {sequence}")).unwrap(),
        }
    }

    fn sequences(history: &History) -> Vec<u64> {
        history.observations().map(|o| o.sequence).collect()
    }

    #[test]
    fn without_slack_the_window_is_the_last_n() {
        let mut history = History::new(HistoryLimits::exact(3));
        let left: Vec<usize> = (0..5).map(|i| history.push(observation(0, i), 5)).collect();
        assert_eq!(left, [0, 0, 0, 1, 1]);
        assert_eq!(sequences(&history), [2, 3, 4]);
        assert_eq!(history.sentences().last(), Some("They do thing 4."));
    }

    #[test]
    fn with_slack_it_is_cut_back_seldom() {
        let mut history = History::new(HistoryLimits { observations: 3, slack: 2, tokens: 1000 });
        let left: Vec<usize> = (0..9).map(|i| history.push(observation(0, i), 5)).collect();
        assert_eq!(left, [0, 0, 0, 0, 0, 3, 0, 0, 3]);
        assert_eq!(sequences(&history), [6, 7, 8]);
        assert_eq!(history.left(), 6);
    }

    #[test]
    fn one_overlong_observation_stays_alone() {
        let mut history = History::new(HistoryLimits { observations: 8, slack: 0, tokens: 20 });
        history.push(observation(0, 0), 5);
        assert_eq!(history.push(observation(0, 1), 500), 1);
        assert_eq!(sequences(&history), [1]);
        assert_eq!(history.push(observation(0, 2), 5), 1);
        assert_eq!(sequences(&history), [2]);
    }

    #[test]
    fn persons_do_not_mix_and_are_bounded() {
        let mut histories = Histories::new(HistoryLimits::default());
        for sequence in 0..200 {
            histories.push(observation(sequence as u32 % 2, sequence), 5);
        }
        assert!(histories.get(0).unwrap().observations().all(|o| o.person == 0 && o.sequence % 2 == 0));
        for person in 0..1000 {
            histories.push(observation(person, 0), 5);
        }
        assert_eq!(histories.iter().count(), PERSONS_MAX);
        assert!(histories.get(999).is_some() && histories.get(0).is_none());
        assert!(histories.remove(999).is_some() && histories.get(999).is_none());
    }

    proptest! {
        #[test]
        fn the_window_is_a_recent_run_within_its_limits(
            observations in 0usize..6, slack in 0usize..6, tokens in 0usize..60,
            costs in prop::collection::vec(0usize..20, 1..80),
        ) {
            let mut history = History::new(HistoryLimits { observations, slack, tokens });
            for (i, cost) in costs.iter().enumerate() {
                let before = history.len();
                let left = history.push(observation(0, i as u64), *cost);
                prop_assert_eq!(history.len(), before + 1 - left);
                let first = (i + 1 - history.len()) as u64;
                prop_assert_eq!(sequences(&history), (first..=i as u64).collect::<Vec<_>>());
                prop_assert_eq!(history.left(), first);
                prop_assert!(history.len() <= observations.max(1) + slack);
                let held: usize = costs[first as usize..=i].iter().sum();
                prop_assert!(held <= tokens || history.len() == 1);
            }
        }
    }
}
