//! Small numbers for names, bounded. Counts use these numbers, so that they survive changes of the map; forecasts use the map's order.

use std::collections::HashMap;

/// Longest name, in bytes. Longer names are not learned.
const NAME_BYTES_MAX: usize = 256;
/// The name of elsewhere, which always has the number [`ELSEWHERE`] among the places.
pub(crate) const ELSEWHERE_NAME: &str = "(elsewhere)";
pub(crate) const ELSEWHERE: u16 = 0;

#[derive(Debug, Clone)]
struct Name {
    name: String,
    /// Last minute in which it was seen.
    seen_min: u32,
    /// Its index in the bound map.
    index: Option<usize>,
}

/// Numbers of names, 0 to `limit - 1`, and the names of the bound map.
#[derive(Debug, Clone, Default)]
pub(crate) struct Names {
    names: Vec<Name>,
    numbers: HashMap<String, u16>,
    limit: usize,
    bound: Vec<String>,
    number_of: Vec<Option<u16>>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Numbered {
    /// The name has this number.
    As(u16),
    /// The name has this number from now on. The caller must forget the counts of the number.
    Reused(u16),
    /// The name is empty or too long.
    Refused,
}

impl Names {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit: limit.clamp(2, usize::from(u16::MAX - 1)), ..Self::default() }
    }

    /// Binds the names of a map, each once. Existing numbers stay.
    pub(crate) fn bind(&mut self, bound: Vec<String>) {
        self.names.iter_mut().for_each(|name| name.index = None);
        self.number_of = bound.iter().map(|name| self.numbers.get(name).copied()).collect();
        for (index, number) in self.number_of.iter().enumerate() {
            if let Some(number) = number {
                self.names[usize::from(*number)].index = Some(index);
            }
        }
        self.bound = bound;
    }

    pub(crate) fn bound(&self) -> &[String] {
        &self.bound
    }

    /// The map's index of the name with this number.
    pub(crate) fn index(&self, number: u16) -> Option<usize> {
        self.names.get(usize::from(number))?.index
    }

    /// The number of a name of the map, if it has one.
    pub(crate) fn number(&self, index: usize) -> Option<u16> {
        self.number_of.get(index).copied().flatten()
    }

    /// Marks a name of the map as seen. A name without a number gets one. At the limit that is the number of the name that was not seen for longest.
    pub(crate) fn see(&mut self, index: usize, now_min: u32) -> Numbered {
        if let Some(number) = self.number(index) {
            let seen_min = &mut self.names[usize::from(number)].seen_min;
            *seen_min = now_min.max(*seen_min);
            return Numbered::As(number);
        }
        let Some(name) = self.bound.get(index).cloned() else { return Numbered::Refused };
        let numbered = self.add(name, now_min);
        if let Numbered::As(number) | Numbered::Reused(number) = numbered {
            let name = &mut self.names[usize::from(number)];
            if let Some(before) = name.index.replace(index) {
                self.number_of[before] = None;
            }
            self.number_of[index] = Some(number);
        }
        numbered
    }

    pub(crate) fn add(&mut self, name: String, seen_min: u32) -> Numbered {
        if name.is_empty() || name.len() > NAME_BYTES_MAX || self.numbers.contains_key(&name) {
            return Numbered::Refused;
        }
        let own = Name { name: name.clone(), seen_min, index: None };
        if self.names.len() < self.limit {
            let number = self.names.len() as u16;
            self.names.push(own);
            self.numbers.insert(name, number);
            return Numbered::As(number);
        }
        let may_go = self.names.iter().enumerate().filter(|(_, name)| name.name != ELSEWHERE_NAME);
        let Some((oldest, _)) = may_go.min_by_key(|(_, name)| name.seen_min) else { return Numbered::Refused };
        let index = self.names[oldest].index;
        let before = std::mem::replace(&mut self.names[oldest], Name { index, ..own });
        self.numbers.remove(&before.name);
        self.numbers.insert(name, oldest as u16);
        Numbered::Reused(oldest as u16)
    }

    pub(crate) fn len(&self) -> usize {
        self.names.len()
    }

    /// Every name and its last minute, by number.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&str, u32)> {
        self.names.iter().map(|name| (name.name.as_str(), name.seen_min))
    }

    pub(crate) fn seen_min(&mut self) -> impl Iterator<Item = &mut u32> {
        self.names.iter_mut().map(|name| &mut name.seen_min)
    }

    /// Raises the last minute of a name.
    pub(crate) fn date(&mut self, number: u16, minute: u32) {
        if let Some(name) = self.names.get_mut(usize::from(number)) {
            name.seen_min = minute.max(name.seen_min);
        }
    }

    pub(crate) fn bytes(&self) -> usize {
        self.names.iter().map(|name| 2 * name.name.len() + 64).sum()
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
        self.places.bound().len()
    }

    /// The index of the room with this number, if the map has it.
    pub(crate) fn room(&self, number: u16) -> Option<usize> {
        self.places.index(number).filter(|place| *place < self.rooms())
    }

    /// Per room, the share of a thing's items in it, by the map.
    pub(crate) fn shares_of(&self, thing: usize) -> &[f64] {
        let rooms = self.rooms();
        self.shares.get(thing * rooms..(thing + 1) * rooms).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_the_limit_the_name_seen_longest_ago_gives_way() {
        let mut names = Names::new(2);
        names.bind(["mug", "sofa", "bed", ""].map(str::to_owned).to_vec());
        assert_eq!([names.see(0, 1), names.see(1, 2), names.see(0, 3)], [0, 1, 0].map(Numbered::As));
        assert_eq!((names.see(2, 4), names.see(3, 5)), (Numbered::Reused(1), Numbered::Refused));
        assert_eq!((names.number(1), names.index(1), names.len()), (None, Some(2), 2));
        assert_eq!(names.iter().collect::<Vec<_>>(), [("mug", 3), ("bed", 4)]);
    }

    /// A map may have 100 000 labels, more than 16 bits can number.
    #[test]
    fn labels_beyond_16_bits_have_numbers_of_their_own() {
        let mut names = Names::new(8);
        names.bind((0..70_000).map(|label| format!("thing {label}")).collect());
        for (number, label) in [65_534, 65_535, 65_536, 65_541, 69_999].into_iter().enumerate() {
            assert_eq!(names.see(label, 1), Numbered::As(number as u16));
            assert_eq!((names.index(number as u16), names.number(label)), (Some(label), Some(number as u16)));
        }
        assert_eq!(names.number(0), None);
    }
}
