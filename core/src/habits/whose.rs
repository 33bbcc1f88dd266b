//! Whose counts are read: a person's own, over those of the others in the home.

use super::counts::{Counts, Seen};
use super::key::{Kind, key, with_times};
use super::smoothing::smooth;

/// Others whose counts are a person's prior, at most: those with the most.
pub(crate) const OTHERS_MAX: usize = 3;
/// How many observations of its own outweigh what another one did.
const OTHERS_STRENGTH: f64 = 4.0;

/// One person's view of the home's counts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Whose<'a> {
    pub(crate) counts: &'a Counts,
    pub(crate) slot: u8,
    pub(crate) others: [Option<u8>; OTHERS_MAX],
    pub(crate) now_min: u32,
    /// How often the last thing was mentioned again, for contexts to which it matters.
    pub(crate) times: u8,
}

impl<'a> Whose<'a> {
    pub(crate) fn own(&self, kind: Kind, after: [u16; 3]) -> Option<Seen<'a>> {
        self.counts.get(key(kind, with_times(self.slot, self.times), after), self.now_min)
    }

    /// What the others have seen in a context.
    pub(crate) fn of_others(&self, kind: Kind, after: [u16; 3]) -> impl Iterator<Item = Seen<'a>> {
        let Self { counts, others, now_min, times, .. } = *self;
        let of = move |slot| counts.get(key(kind, with_times(slot, times), after), now_min);
        others.into_iter().flatten().filter_map(of)
    }

    /// Mixes a context over the forecast of a shorter one: the others' counts first, then the person's own. Gives the weight that
    /// the shorter one keeps, and how many observations of its own there are.
    pub(crate) fn smooth(
        &self,
        kind: Kind,
        after: [u16; 3],
        discount: f64,
        concentration: f64,
        index: impl Fn(u16) -> Option<usize>,
        p: &mut [f64],
    ) -> (f64, f64) {
        let kept = self.prior(kind, after, discount, concentration, &index, p).unwrap_or(1.0);
        let (own, total) = smooth(self.own(kind, after), discount, concentration, &index, p);
        (kept * own, total)
    }

    /// Mixes what the others have seen in a context over the forecast of a shorter one. Gives the weight that the shorter one keeps, if
    /// they have seen anything.
    pub(crate) fn prior(
        &self,
        kind: Kind,
        after: [u16; 3],
        discount: f64,
        concentration: f64,
        index: impl Fn(u16) -> Option<usize>,
        p: &mut [f64],
    ) -> Option<f64> {
        let mut kept = None;
        for seen in self.of_others(kind, after) {
            let (left, total) = smooth(Some(seen), discount, OTHERS_STRENGTH * concentration, &index, p);
            if total > 0.0 {
                kept = Some(kept.unwrap_or(1.0) * left);
            }
        }
        kept
    }
}
