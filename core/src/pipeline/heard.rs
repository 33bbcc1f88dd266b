//! The events that scores include, by source, so that a narrator knows which events it need not resend.

use std::collections::{BTreeMap, VecDeque};

use super::person::Person;
use super::scores::{Included, Scores};
use crate::ids::{BootNs, EventId};
use crate::narration::Observation;
use crate::narration::history::Quota;

/// Most source starts in [`Scores::included`]; a new one replaces the one heard longest ago.
pub const SOURCES_MAX: usize = 64;
/// Most events per source start that wait for their scores separately; later ones are merged into the newest.
const TRAIL_MAX: usize = 32;

/// Progress of one start of a source.
#[derive(Debug)]
struct Heard {
    /// The newest event that the scores contain, with all before it.
    included: Option<Included>,
    /// Later events, oldest first.
    trail: VecDeque<Included>,
    /// The newest scores do not contain all events.
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

#[derive(Debug, Default)]
pub(super) struct Sources {
    starts: Vec<Heard>,
    /// Per (source, epoch): the last sequence that a former run handled. Events up to it are not counted again.
    settled: BTreeMap<(u64, u64), u64>,
    /// Number of events included so far.
    turns: u64,
    newest_observed_ns: BootNs,
}

impl Sources {
    pub(super) const fn turns(&self) -> u64 {
        self.turns
    }

    pub(super) fn pass_over(&mut self, event: EventId) {
        self.note(event.source, event.epoch, |included| included.sequence = included.sequence.max(event.sequence));
    }

    pub(super) fn include(&mut self, observation: &Observation, quota: Quota) {
        let settled = self.settled_of(observation.source, observation.epoch);
        let observed_ns = observation.observed_ns;
        self.newest_observed_ns = self.newest_observed_ns.max(observed_ns);
        self.turns += 1;
        let turn = self.turns;
        self.note(observation.source, observation.epoch, |included| {
            // A later event that was refused may have raised the sequence already.
            included.sequence = included.sequence.max(observation.sequence);
            included.accepted += u64::from(observation.sequence > settled);
            (included.observed_ns, included.quota, included.turn) = (observed_ns, quota.number, turn);
        });
    }

    pub(super) fn settle(&mut self, settled: BTreeMap<(u64, u64), u64>) {
        self.settled = settled;
    }

    pub(super) fn forget(&mut self, source: u64, epoch: u64) {
        self.starts.retain(|heard| !heard.is_of(source, epoch));
    }

    fn settled_of(&self, source: u64, epoch: u64) -> u64 {
        self.settled.get(&(source, epoch)).copied().unwrap_or_default()
    }

    /// Records a change to the newest state of a source start, and queues it until the scores contain it.
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
        let none = Included { source, epoch, sequence: 0, observed_ns: BootNs(0), accepted, quota: 0, turn: 0 };
        let mut newest = heard.newest().copied().unwrap_or(none);
        change(&mut newest);
        if heard.trail.len() >= TRAIL_MAX {
            heard.trail.pop_back();
        }
        heard.trail.push_back(newest);
    }

    /// Updates `scores.included`: per source start, all events before the first one that a person has not been scored with.
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
                    // Narrators must see it as new, even if the event is old.
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
