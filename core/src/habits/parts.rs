//! Gathers the parts of the forecasts, experts and levels of counts, which next.rs, stays.rs and leaving.rs list and pool.rs mixes.

use std::sync::LazyLock;

use super::context::{Level, Number, Part, Without, split};
use super::pool::Plan;
use super::{leaving, next, stays};

/// Each plan with the names that its counted symbols stand for.
static PLANS: [(&Plan, Number); 4] = [
    (&next::THINGS, Number::Thing),
    (&next::AGAIN, Number::Plain),
    (&next::ROOMS, Number::Place),
    (&stays::PLAN, Number::Place),
];

/// The levels, each with the names that its counted symbols stand for.
fn levels() -> impl Iterator<Item = (&'static Level, Number)> {
    let of_plan = |(plan, counted): (&'static Plan, _)| {
        plan.experts.iter().flat_map(|expert| expert.levels).zip(std::iter::repeat(counted))
    };
    let of_stays = leaving::STAY.iter().map(|level| (level, Number::Plain));
    let of_exits = leaving::EXIT.iter().chain([&next::OF_THING]).map(|level| (level, Number::Place));
    PLANS.into_iter().flat_map(of_plan).chain(of_stays).chain(of_exits)
}

/// By the number of a level, what its keys' numbers and its counted symbols name; `None` for removed levels.
pub(crate) static KINDS: LazyLock<[Option<[Number; 4]>; 256]> = LazyLock::new(|| {
    let mut kinds = [None; 256];
    for (level, counted) in levels() {
        let [first, second, third] = level.names();
        kinds[usize::from(level.part.number)] = Some([first, second, third, counted]);
    }
    kinds
});

/// The numbers of a key, then a symbol counted in it, each with the kind of its name.
pub(crate) fn names_of(key: u64, symbol: u16) -> impl DoubleEndedIterator<Item = (Number, u16)> {
    let (level, _, [first, second, third]) = split(key);
    KINDS[usize::from(level)].unwrap_or_default().into_iter().zip([first, second, third, symbol])
}

impl Without {
    fn parts() -> impl Iterator<Item = Part> {
        let experts = PLANS.into_iter().flat_map(|(plan, _)| plan.experts.iter().chain(&plan.product));
        let parts = experts.map(|expert| expert.part).chain(levels().map(|(level, _)| level.part));
        parts.filter(|part| !part.name.is_empty())
    }

    /// The names of all parts.
    pub fn names() -> impl Iterator<Item = &'static str> {
        Self::parts().map(|part| part.name)
    }

    /// Without one more part; `None` if there is none of this name.
    #[must_use]
    pub fn and(self, name: &str) -> Option<Self> {
        let part = Self::parts().find(|part| part.name == name)?;
        Some(Self(self.0 | 1 << part.number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_parts_have_the_same_number_or_name() {
        let parts: Vec<_> = Without::parts().collect();
        for (at, part) in parts.iter().enumerate() {
            assert!(part.number < 64 && !part.name.is_empty(), "{part:?}");
            assert!(parts[..at].iter().all(|other| other.number != part.number && other.name != part.name), "{part:?}");
        }
        assert!(Without::default().and("later").is_some_and(|without| without.and("").is_none()));
    }
}
