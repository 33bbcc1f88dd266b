//! Names in words with small numbers, bounded: what is learned is keyed by words, so that it survives changes of the map.

use std::collections::HashMap;

use super::moment;

/// Longest name that is kept, in bytes; longer ones are learned nothing of.
const WORD_BYTES_MAX: usize = 256;

/// Numbers of names, 0 to `limit - 1`.
#[derive(Debug, Clone, Default)]
pub(crate) struct Words {
    names: Vec<String>,
    numbers: HashMap<String, u16>,
    /// When each was last seen, in minutes.
    seen_min: Vec<u32>,
    limit: usize,
}

/// What became of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Numbered {
    /// It has had this number.
    Known(u16),
    /// It has this number from now on.
    New(u16),
    /// It has this number from now on; what was known under the number is to be forgotten.
    Reused(u16),
    /// It is too long.
    Refused,
}

impl Words {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit: limit.clamp(1, usize::from(u16::MAX - 1)), ..Self::default() }
    }

    pub(crate) fn len(&self) -> usize {
        self.names.len()
    }

    pub(crate) fn name(&self, number: u16) -> Option<&str> {
        self.names.get(usize::from(number)).map(String::as_str)
    }

    pub(crate) fn number(&self, name: &str) -> Option<u16> {
        self.numbers.get(name).copied()
    }

    pub(crate) fn seen_min(&self, number: u16) -> u32 {
        self.seen_min.get(usize::from(number)).copied().unwrap_or(0)
    }

    /// A number was seen.
    pub(crate) fn touch(&mut self, number: u16, now_min: u32) {
        if let Some(seen_min) = self.seen_min.get_mut(usize::from(number)) {
            *seen_min = (*seen_min).max(now_min);
        }
    }

    /// When a number was seen last.
    pub(crate) fn set_seen_min(&mut self, number: u16, seen_min: u32) {
        if let Some(own) = self.seen_min.get_mut(usize::from(number)) {
            *own = seen_min;
        }
    }

    /// The clock was set on by so many minutes, or back.
    pub(crate) fn shift_clock(&mut self, by_min: i64) {
        self.seen_min.iter_mut().for_each(|seen_min| *seen_min = moment::shifted(*seen_min, by_min));
    }

    /// What was seen later than now was seen now.
    pub(crate) fn no_later_than(&mut self, now_min: u32) {
        self.seen_min.iter_mut().for_each(|seen_min| *seen_min = now_min.min(*seen_min));
    }

    /// Bytes of the names.
    pub(crate) fn bytes(&self) -> usize {
        self.names.iter().map(|name| 2 * name.len() + 64).sum()
    }

    /// The number of a name, which is new if need be: at the limit in the place of that seen longest ago.
    pub(crate) fn number_of(&mut self, name: &str, now_min: u32) -> Numbered {
        if let Some(number) = self.number(name) {
            self.touch(number, now_min);
            return Numbered::Known(number);
        }
        if name.is_empty() || name.len() > WORD_BYTES_MAX {
            return Numbered::Refused;
        }
        if self.names.len() < self.limit {
            let number = self.names.len() as u16;
            self.names.push(name.to_owned());
            self.seen_min.push(now_min);
            self.numbers.insert(name.to_owned(), number);
            return Numbered::New(number);
        }
        let Some(oldest) = (0..self.names.len()).min_by_key(|number| self.seen_min[*number]) else {
            return Numbered::Refused;
        };
        let number = oldest as u16;
        self.numbers.remove(&self.names[oldest]);
        name.clone_into(&mut self.names[oldest]);
        self.seen_min[oldest] = now_min;
        self.numbers.insert(name.to_owned(), number);
        Numbered::Reused(number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_the_limit_the_name_seen_longest_ago_gives_way() {
        let mut words = Words::new(2);
        assert_eq!(words.number_of("mug", 1), Numbered::New(0));
        assert_eq!(words.number_of("sofa", 2), Numbered::New(1));
        assert_eq!(words.number_of("mug", 3), Numbered::Known(0));
        assert_eq!(words.number_of("bed", 4), Numbered::Reused(1));
        assert_eq!((words.number("sofa"), words.name(1), words.len()), (None, Some("bed"), 2));
        assert_eq!(words.number_of("", 5), Numbered::Refused);
    }
}
