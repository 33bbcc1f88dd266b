//! Whose counts are read: a person's own, over those of the others in the home.

use super::counts::{Counts, Seen};
use super::key::{Kind, key, with_times};
use super::names::Home;
use super::parts::Without;
use super::smoothing::smooth;

/// Others whose counts are a person's prior, at most: those with the most.
pub(crate) const OTHERS_MAX: usize = 3;
/// How many observations of its own outweigh an observation of another person.
const OTHERS_STRENGTH: f64 = 4.0;

/// One person's view of the home's counts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) counts: &'a Counts,
    pub(crate) home: &'a Home,
    pub(crate) slot: u8,
    pub(crate) others: [Option<u8>; OTHERS_MAX],
    pub(crate) now_min: u32,
    /// How often the last thing was mentioned again, for contexts to which it matters.
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

    /// What was seen in a context, each with its strength: by the others first, then by the person.
    pub(crate) fn seen(&self, kind: Kind, after: [u16; 3]) -> impl Iterator<Item = (Seen<'a>, f64)> {
        let others = self.others.into_iter().flatten().map(|slot| (slot, OTHERS_STRENGTH));
        others
            .chain([(self.slot, 1.0)])
            .filter_map(move |(slot, strength)| Some((self.of(slot, kind, after)?, strength)))
    }

    /// Mixes a context over the forecast of a shorter one. Gives the weight that the shorter one keeps, and how many observations of its own
    /// there are.
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
