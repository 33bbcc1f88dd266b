//! Small numbers for names, bounded. Counts use these numbers, so that they survive changes of the map; forecasts use the map's order.

use std::collections::HashMap;

/// Longest name, in bytes. Longer names are not learned.
const NAME_BYTES_MAX: usize = 256;
/// The name of elsewhere, which always has the number [`ELSEWHERE`] among the places.
pub(crate) const ELSEWHERE_NAME: &str = "(elsewhere)";
pub(crate) const ELSEWHERE: u16 = 0;

/// Numbers of names, 0 to `limit - 1`, and the names of the bound map. A further name takes the number of another one.
#[derive(Debug, Clone, Default)]
pub(crate) struct Names {
    /// By number.
    pub(crate) names: Vec<String>,
    /// By number, the index in the bound map.
    indices: Vec<Option<usize>>,
    limit: usize,
    /// By index in the bound map, the name and its number.
    pub(crate) bound: Vec<String>,
    number_of: Vec<Option<u16>>,
}

impl Names {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit: limit.clamp(2, usize::from(u16::MAX - 1)), ..Self::default() }
    }

    /// Binds the names of a map, each once. Existing numbers stay.
    pub(crate) fn bind(&mut self, bound: Vec<String>) {
        let numbers: HashMap<_, _> = self.names.iter().zip(0..).collect();
        self.number_of = bound.iter().map(|name| numbers.get(name).copied()).collect();
        self.indices.fill(None);
        for (index, number) in self.number_of.iter().enumerate() {
            number.iter().for_each(|number| self.indices[usize::from(*number)] = Some(index));
        }
        self.bound = bound;
    }

    /// The map's index of the name with this number.
    pub(crate) fn index(&self, number: u16) -> Option<usize> {
        self.indices.get(usize::from(number)).copied().flatten()
    }

    /// The number of a name of the map, if it has one.
    pub(crate) fn number(&self, index: usize) -> Option<u16> {
        self.number_of.get(index).copied().flatten()
    }

    /// The number of a name of the map. A new name gets one as in [`Names::add`].
    pub(crate) fn learn(&mut self, index: usize, freed: impl FnOnce() -> Option<u16>) -> Option<u16> {
        if self.number(index).is_none() {
            let number = self.add(self.bound.get(index)?.clone(), freed)?;
            (self.indices[usize::from(number)], self.number_of[index]) = (Some(index), Some(number));
        }
        self.number(index)
    }

    /// The number of a new name, at the limit a `freed` one; `None` for an empty, long or known name.
    pub(crate) fn add(&mut self, name: String, freed: impl FnOnce() -> Option<u16>) -> Option<u16> {
        if name.is_empty() || name.len() > NAME_BYTES_MAX || self.names.contains(&name) {
            return None;
        }
        let number = if self.names.len() < self.limit { self.names.len() as u16 } else { freed()? };
        let at = usize::from(number);
        self.names.resize(self.names.len().max(at + 1), String::new());
        self.indices.resize(self.names.len(), None);
        if let Some(index) = self.indices[at].take() {
            self.number_of[index] = None;
        }
        self.names[at] = name;
        Some(number)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Home {
    pub(crate) things: Names,
    /// The rooms, then elsewhere.
    pub(crate) places: Names,
    /// Per thing and room, row by row, the share of the thing's items that lie there.
    pub(crate) shares: Vec<f64>,
}

impl Home {
    pub(crate) fn rooms(&self) -> usize {
        self.places().saturating_sub(1)
    }

    /// Number of rooms, plus elsewhere, the last place.
    pub(crate) fn places(&self) -> usize {
        self.places.bound.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_the_limit_a_further_name_takes_a_freed_number() {
        let mut names = Names::new(2);
        names.bind(["", "mug", "sofa", "bed"].map(str::to_owned).to_vec());
        assert_eq!([0, 1, 2, 1, 3].map(|index| names.learn(index, || None)), [None, Some(0), Some(1), Some(0), None]);
        assert_eq!((names.number(3), names.index(1), names.names.len()), (None, Some(2), 2));
        assert_eq!(
            (names.learn(3, || Some(0)), &names.names[..]),
            (Some(0), &["bed".to_owned(), "sofa".to_owned()][..])
        );
        assert_eq!((names.number(1), names.index(0)), (None, Some(3)));
        names.bind(["sofa", "mug"].map(str::to_owned).to_vec());
        assert_eq!((names.index(0), names.index(1), names.number(0), names.number(1)), (None, Some(0), Some(1), None));
    }

    /// A map may have 100 000 labels, more than 16 bits can number.
    #[test]
    fn labels_beyond_16_bits_have_numbers_of_their_own() {
        let mut names = Names::new(8);
        names.bind((0..70_000).map(|label| format!("thing {label}")).collect());
        for (number, label) in [65_534, 65_535, 65_536, 65_541, 69_999].into_iter().enumerate() {
            assert_eq!(names.learn(label, || None), Some(number as u16));
            assert_eq!((names.index(number as u16), names.number(label)), (Some(label), Some(number as u16)));
        }
        assert_eq!(names.number(0), None);
    }
}
