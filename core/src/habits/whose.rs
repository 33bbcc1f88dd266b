//! A person's counts, over those of the other persons in the home.

use super::counts::{Counts, Seen};
use super::key::{Kind, key, with_times};
use super::names::Home;
use super::parts::Without;
use super::smoothing::smooth;

/// Most other persons in a prior: those with the most observations.
pub(crate) const OTHERS_MAX: usize = 3;
/// Own observations that outweigh one observation of another person.
const OTHERS_STRENGTH: f64 = 4.0;

#[derive(Debug, Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) counts: &'a Counts,
    pub(crate) home: &'a Home,
    pub(crate) slot: u8,
    pub(crate) others: [Option<u8>; OTHERS_MAX],
    pub(crate) now_min: u32,
    /// Number of repeated mentions of the last thing, for the contexts that use it.
    pub(crate) times: u8,
    pub(crate) without: Without,
}

impl<'a> View<'a> {
    fn of(&self, slot: u8, kind: Kind, after: [u16; 3]) -> Option<Seen<'a>> {
        let key = key(kind, with_times(slot, self.times), after);
        self.without.uses(kind as u8).then(|| self.counts.get(key, self.now_min)).flatten()
    }

    pub(crate) fn own(&self, kind: Kind, after: [u16; 3]) -> Option<Seen<'a>> {
        self.of(self.slot, kind, after)
    }

    /// The counts in a context, each with its strength: first the others', then the person's.
    pub(crate) fn seen(&self, kind: Kind, after: [u16; 3]) -> impl Iterator<Item = (Seen<'a>, f64)> {
        let others = self.others.into_iter().flatten().map(|slot| (slot, OTHERS_STRENGTH));
        others
            .chain([(self.slot, 1.0)])
            .filter_map(move |(slot, strength)| Some((self.of(slot, kind, after)?, strength)))
    }

    /// Mixes a context over the forecast of a shorter one. Returns the shorter one's remaining weight, and the person's own observations.
    pub(crate) fn smooth(
        &self,
        (kind, after): (Kind, [u16; 3]),
        (discount, concentration): (f64, f64),
        index: impl Fn(u16) -> Option<usize>,
        p: &mut [f64],
    ) -> (f64, f64) {
        let (mut kept, mut own) = (1.0, 0.0);
        for (seen, strength) in self.seen(kind, after) {
            let (left, total) = smooth(seen, discount, strength * concentration, &index, p);
            kept *= left;
            own = if strength == 1.0 { total } else { own };
        }
        (kept, own)
    }
}
