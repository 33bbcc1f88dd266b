//! Which narrations scores include, by source: a narrator learns by it what it need not say again.

use std::collections::{BTreeMap, VecDeque};

use super::person::Person;
use super::scores::{Included, Scores};
use crate::ids::{BootNs, EventId};
use crate::narration::Observation;
use crate::narration::history::Voice;

/// Most starts of narration sources that scores name; the one heard longest ago makes room for a new one.
pub const SOURCES_MAX: usize = 64;
/// So many steps of what a source said wait for their scores apart from each other; the newest ones wait together.
const TRAIL_MAX: usize = 32;

/// What was heard of one start of a source.
#[derive(Debug)]
struct Heard {
    /// The last of what the scores contain, and all before it.
    included: Option<Included>,
    /// What came after it, oldest first.
    trail: VecDeque<Included>,
    /// The newest scores do not contain all of it.
    is_late: bool,
}

impl Heard {
    fn newest(&self) -> Option<&Included> {
        self.trail.back().or(self.included.as_ref())
    }

    fn is_of(&self, source: u64, epoch: u64) -> bool {
        self.newest().is_some_and(|newest| (newest.source, newest.epoch) == (source, epoch))
    }
}

/// What was heard of all sources.
#[derive(Debug, Default)]
pub(super) struct Sources {
    starts: Vec<Heard>,
    /// Per start up to which sequence a former run has dealt with it, and does not tell of it any more.
    settled: BTreeMap<(u64, u64), u64>,
    /// Narrations included so far.
    turns: u64,
    newest_observed_ns: BootNs,
}

impl Sources {
    /// How many narrations were included so far.
    pub(super) const fn turns(&self) -> u64 {
        self.turns
    }

    /// See [`super::Intake::pass_over`].
    pub(super) fn pass_over(&mut self, event: EventId) {
        self.note(event.source, event.epoch, |included| included.sequence = included.sequence.max(event.sequence));
    }

    /// See [`super::Intake::include`].
    pub(super) fn include(&mut self, observation: &Observation, voice: Voice) {
        let settled = self.settled_of(observation.source, observation.epoch);
        let observed_ns = observation.observed_ns;
        self.newest_observed_ns = self.newest_observed_ns.max(observed_ns);
        self.turns += 1;
        let turn = self.turns;
        self.note(observation.source, observation.epoch, |included| {
            // What was refused after it may be named already.
            included.sequence = included.sequence.max(observation.sequence);
            included.accepted += u64::from(observation.sequence > settled);
            (included.observed_ns, included.voice, included.turn) = (observed_ns, voice.number, turn);
        });
    }

    /// See [`super::Intake::settle`].
    pub(super) fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.settled = settled;
    }

    /// See [`super::Intake::forget_source`].
    pub(super) fn forget(&mut self, source: u64, epoch: u64) {
        self.starts.retain(|heard| !heard.is_of(source, epoch));
    }

    fn settled_of(&self, source: u64, epoch: u64) -> u64 {
        self.settled.get(&(source, epoch)).copied().unwrap_or_default()
    }

    /// Takes note of what was heard of one start of a source, known or new, until the scores contain it.
    fn note(&mut self, source: u64, epoch: u64, change: impl FnOnce(&mut Included)) {
        let accepted = self.settled_of(source, epoch);
        let known = self.starts.iter().position(|heard| heard.is_of(source, epoch));
        let place = known.unwrap_or_else(|| {
            let turn = |heard: &Heard| heard.newest().map_or(0, |newest| newest.turn);
            if self.starts.len() >= SOURCES_MAX
                && let Some(oldest) = (0..self.starts.len()).min_by_key(|&i| turn(&self.starts[i]))
            {
                self.starts.swap_remove(oldest);
            }
            self.starts.push(Heard { included: None, trail: VecDeque::new(), is_late: false });
            self.starts.len() - 1
        });
        let heard = &mut self.starts[place];
        let none = Included { source, epoch, sequence: 0, observed_ns: BootNs(0), accepted, voice: 0, turn: 0 };
        let mut newest = heard.newest().copied().unwrap_or(none);
        change(&mut newest);
        if heard.trail.len() >= TRAIL_MAX {
            heard.trail.pop_back();
        }
        heard.trail.push_back(newest);
    }

    /// Says what the newest scores include: of each source all before the first narration with which somebody has not been scored.
    pub(super) fn tell(&mut self, persons: &[Person], scores: &mut Scores) {
        let Self { starts, turns, .. } = self;
        scores.included.clear();
        let mut is_late = false;
        for own in starts {
            let Some(&Included { source, epoch, .. }) = own.newest() else { continue };
            let unscored = persons.iter().flat_map(|person| &person.unscored);
            let first = unscored.filter(|known| (known.source, known.epoch) == (source, epoch));
            let first = first.map(|known| known.sequence).min().unwrap_or(u64::MAX);
            let news = own.trail.iter().take_while(|next| next.sequence < first).count();
            if let Some(mut included) = own.trail.drain(..news).next_back() {
                if own.is_late {
                    // It is news now, however long ago it was heard.
                    *turns += 1;
                    included.turn = *turns;
                }
                own.included = Some(included);
            }
            own.is_late = !own.trail.is_empty();
            is_late |= own.is_late;
            scores.included.extend(own.included);
        }
        let observed_ns = scores.included.iter().map(|included| included.observed_ns).max().unwrap_or_default();
        let newest_ns = if is_late { observed_ns } else { self.newest_observed_ns };
        scores.newest_observed_ns = scores.newest_observed_ns.max(newest_ns);
    }
}
