//! Counts of symbols by context, bounded, with a half-life.
//!
//! A context is an exact 64-bit key. Decay is lazy: a row is updated when it is written, and read through a factor otherwise. At a limit the rows with
//! the fewest decayed counts are dropped, an eighth of all.

use std::collections::HashMap;

use foldhash::fast::FixedState;

/// Smaller counts are dropped when their row is updated.
const FORGOTTEN: f32 = 0.02;
/// A row is updated when its counts have decayed below this factor. Before that, additions are scaled up instead.
const WORTH: f32 = 0.7;

#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Row {
    pub(crate) touched_min: u32,
    /// Symbols with their counts as of that minute.
    pub(crate) counts: Vec<(u16, f32)>,
}

#[derive(Debug, Clone)]
pub(crate) struct Counts {
    contexts_max: usize,
    counts_max: usize,
    /// No decay unless positive.
    half_life_min: f64,
    /// Keys consist of small numbers that no input chooses.
    rows: HashMap<u64, Row, FixedState>,
    /// Counts of all rows.
    len: usize,
}

/// A row at a time of reading: its counts times a factor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen<'a> {
    counts: &'a [(u16, f32)],
    factor: f32,
}

impl<'a> Seen<'a> {
    /// Every symbol with its decayed count.
    pub(crate) fn symbols(self) -> impl Iterator<Item = (u16, f64)> + 'a {
        self.counts.iter().map(move |(symbol, count)| (*symbol, f64::from(count * self.factor)))
    }

    pub(crate) fn count(self, symbol: u16) -> f64 {
        self.symbols().find(|(other, _)| *other == symbol).map_or(0.0, |(_, count)| count)
    }

    pub(crate) fn sum(self) -> f64 {
        self.symbols().map(|(_, count)| count).sum()
    }
}

impl Counts {
    pub(crate) fn new(contexts_max: usize, counts_max: usize, half_life_min: f64) -> Self {
        let [contexts_max, counts_max] = [contexts_max, counts_max].map(|limit| limit.max(1));
        Self { contexts_max, counts_max, half_life_min, rows: HashMap::default(), len: 0 }
    }

    /// Numbers of contexts and counts.
    pub(crate) fn len(&self) -> (usize, usize) {
        (self.rows.len(), self.len)
    }

    pub(crate) fn bytes(&self) -> usize {
        let counts: usize = self.rows.values().map(|row| row.counts.capacity()).sum();
        self.rows.capacity() * size_of::<(u64, Row)>() + counts * size_of::<(u16, f32)>()
    }

    fn factor(&self, touched_min: u32, now_min: u32) -> f32 {
        let age_min = f64::from(now_min.saturating_sub(touched_min));
        if self.half_life_min > 0.0 { ((-age_min / self.half_life_min) as f32).exp2() } else { 1.0 }
    }

    fn seen<'a>(&self, row: &'a Row, now_min: u32) -> Seen<'a> {
        Seen { counts: &row.counts, factor: self.factor(row.touched_min, now_min) }
    }

    pub(crate) fn get(&self, key: u64, now_min: u32) -> Option<Seen<'_>> {
        self.rows.get(&key).map(|row| self.seen(row, now_min))
    }

    /// Every context.
    pub(crate) fn all(&self, now_min: u32) -> impl Iterator<Item = (u64, Seen<'_>)> {
        self.rows.iter().map(move |(key, row)| (*key, self.seen(row, now_min)))
    }

    /// Adds to the count of `symbol` in the context `key`. A weight that has decayed below the limit by now is ignored.
    pub(crate) fn add(&mut self, key: u64, symbol: u16, weight: f64, now_min: u32) {
        let touched_min = self.rows.get(&key).map_or(now_min, |row| row.touched_min);
        // An addition that is older than the row decays to the row's time.
        let faded = self.factor(now_min, touched_min);
        let mut weight = (weight * f64::from(faded)) as f32;
        if weight < f32::MIN_POSITIVE || (faded < WORTH && weight < FORGOTTEN) {
            return;
        }
        if self.len >= self.counts_max || self.rows.len() >= self.contexts_max && !self.rows.contains_key(&key) {
            self.evict(key, now_min);
        }
        let factor = self.factor(touched_min, now_min);
        let row = self.rows.entry(key).or_insert_with(|| Row { touched_min, counts: Vec::with_capacity(1) });
        self.len -= row.counts.len();
        if factor >= WORTH {
            weight /= factor;
        } else {
            row.touched_min = now_min;
            row.counts.retain_mut(|(_, count)| {
                *count *= factor;
                *count >= FORGOTTEN
            });
        }
        match row.counts.iter_mut().find(|(own, _)| *own == symbol) {
            Some((_, count)) => *count += weight,
            None => row.counts.push((symbol, weight)),
        }
        self.len += row.counts.len();
    }

    /// Drops the least useful eighth of the rows, except one. If that is the only row, it loses a count.
    fn evict(&mut self, except: u64, now_min: u32) {
        let others = self.all(now_min).filter(|(key, _)| *key != except);
        let mut others: Vec<_> = others.map(|(key, seen)| (seen.sum(), key)).collect();
        others.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        others.truncate(others.len().div_ceil(8));
        others.iter().for_each(|(_, key)| _ = self.rows.remove(key));
        if others.is_empty() {
            self.rows.values_mut().for_each(|row| _ = row.counts.pop());
        }
        self.len = self.rows.values().map(|row| row.counts.len()).sum();
    }

    pub(crate) fn touched_min(&mut self) -> impl Iterator<Item = &mut u32> {
        self.rows.values_mut().map(|row| &mut row.touched_min)
    }

    /// Drops unwanted counts, by context and symbol.
    pub(crate) fn retain(&mut self, wanted: impl Fn(u64, u16) -> bool) {
        self.rows.retain(|key, row| {
            row.counts.retain(|(symbol, _)| wanted(*key, *symbol));
            !row.counts.is_empty()
        });
        self.len = self.rows.values().map(|row| row.counts.len()).sum();
    }

    /// Every context, sorted by key, with its counts sorted by symbol.
    pub(crate) fn rows(&self) -> Vec<(u64, Row)> {
        let mut rows: Vec<_> = self.rows.iter().map(|(key, row)| (*key, row.clone())).collect();
        rows.sort_unstable_by_key(|(key, _)| *key);
        rows.iter_mut().for_each(|(_, row)| row.counts.sort_unstable_by_key(|(symbol, _)| *symbol));
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    const DAY_MIN: u32 = 1440;

    fn counts(rows: usize, blocks: usize, half_life_min: f64) -> Counts {
        Counts::new(rows, blocks, half_life_min)
    }

    #[test]
    fn a_count_is_worth_half_after_the_half_life() {
        let mut counts = counts(8, 8, f64::from(DAY_MIN));
        counts.add(1, 7, 4.0, 0);
        counts.add(1, 7, 1.0, DAY_MIN);
        let seen = counts.get(1, 2 * DAY_MIN).unwrap();
        assert!((seen.count(7) - 1.5).abs() < 1e-6);
        assert!(counts.get(2, 0).is_none());
    }

    #[test]
    fn on_a_clock_that_was_set_counts_are_as_old_as_before() {
        let mut counts = counts(8, 8, f64::from(DAY_MIN));
        counts.add(1, 7, 4.0, DAY_MIN);
        counts.touched_min().for_each(|minute| *minute += 400 * DAY_MIN);
        assert!((counts.get(1, 402 * DAY_MIN).unwrap().count(7) - 2.0).abs() < 1e-6);
    }

    #[test]
    fn at_a_limit_the_least_used_contexts_give_way() {
        let mut counts = counts(16, 64, 0.0);
        for key in 0..16 {
            (0..=key).for_each(|_| counts.add(key, 1, 1.0, 0));
        }
        counts.add(100, 1, 1.0, 0);
        assert_eq!((0..16).filter(|key| counts.get(*key, 0).is_none()).collect::<Vec<_>>(), [0, 1]);
        assert_eq!((counts.get(100, 0).is_some(), counts.len()), (true, (15, 15)));
    }

    /// An event from a year ago decays as if it had been counted then.
    #[test]
    fn what_is_older_than_its_row_has_faded() {
        let mut counts = counts(4, 16, 10_000.0);
        counts.add(1, 1, 1.0, 30_000);
        counts.add(1, 1, 1.0, 10_000);
        counts.add(1, 2, 1.0, 0);
        let seen = counts.get(1, 30_000).unwrap();
        assert!((seen.count(1) - 1.25).abs() < 1e-3 && (seen.count(2) - 0.125).abs() < 1e-3, "{seen:?}");
    }

    /// Events from twenty years ago, mixed with newer counts.
    #[test]
    fn what_had_been_forgotten_by_now_is_not_counted() {
        for half_life_min in [0.5, f64::from(DAY_MIN), 60.0 * f64::from(DAY_MIN)] {
            let mut counts = counts(4, 16, half_life_min);
            counts.add(1, 1, 1.0, 10_000 * DAY_MIN);
            let before = counts.rows();
            counts.add(1, 2, 1.0, 0);
            counts.add(1, 1, 1.0, 1);
            assert_eq!((counts.rows(), counts.len()), (before, (1, 1)));
        }
    }

    #[test]
    fn what_is_dated_later_than_now_is_of_now() {
        let mut counts = counts(4, 16, f64::from(DAY_MIN));
        counts.add(1, 1, 1.0, 5_000 * DAY_MIN);
        counts.add(2, 1, 1.0, DAY_MIN);
        counts.touched_min().for_each(|minute| *minute = (2 * DAY_MIN).min(*minute));
        counts.add(1, 2, 1.0, 3 * DAY_MIN);
        let seen = counts.get(1, 3 * DAY_MIN).unwrap();
        assert_eq!((seen.count(1), seen.count(2), counts.get(2, 2 * DAY_MIN).unwrap().count(1)), (0.5, 1.0, 0.5));
    }

    proptest! {
        /// Compared with a map of maps, within the limits.
        #[test]
        fn it_counts_as_maps_do(adds in prop::collection::vec((0..40u64, 0..30u16, 0..3000u32), 0..300)) {
            let mut counts = counts(64, 2048, 0.0);
            let mut maps: BTreeMap<u64, BTreeMap<u16, f64>> = BTreeMap::new();
            for (key, symbol, minute) in adds {
                counts.add(key, symbol, 1.0, minute);
                *maps.entry(key).or_default().entry(symbol).or_default() += 1.0;
            }
            for (key, map) in &maps {
                let seen = counts.get(*key, 0).unwrap();
                let found: BTreeMap<u16, f64> = seen.symbols().collect();
                prop_assert_eq!(&found, map);
            }
            prop_assert_eq!(counts.rows().len(), maps.len());
        }

        #[test]
        fn limits_hold_and_totals_are_sums(
            adds in prop::collection::vec((0..500u64, 0..30u16, 0..200_000u32), 0..400),
            rows in 1..20usize, blocks in 1..30usize,
        ) {
            let mut counts = counts(rows, blocks, 10_000.0);
            for (key, symbol, minute) in adds {
                counts.add(key, symbol, 1.0, minute);
                prop_assert!(counts.len().0 <= rows && counts.len().1 <= blocks);
                // An older addition is worth less there, in the end zero.
                let older_min = counts.rows.get(&key).map_or(0, |row| row.touched_min.saturating_sub(minute));
                let worth = 0.9 * (-f64::from(older_min) / 10_000.0).exp2();
                let count = counts.get(key, minute).map(|seen| seen.count(symbol));
                prop_assert!(count.is_some_and(|count| count >= worth || worth < f64::from(FORGOTTEN)));
                prop_assert!(counts.rows().iter().flat_map(|(_, row)| &row.counts).all(|(_, count)| count.is_normal()));
            }
            let stored = counts.rows();
            prop_assert_eq!(stored.len(), counts.len().0);
            prop_assert_eq!(stored.iter().map(|(_, row)| row.counts.len()).sum::<usize>(), counts.len().1);
            counts.retain(|key, symbol| key % 2 == 0 && symbol != 3);
            prop_assert!(counts.rows().iter().all(|(key, row)| key % 2 == 0 && !row.counts.is_empty()));
            prop_assert!(counts.rows().iter().flat_map(|(_, row)| &row.counts).all(|(symbol, _)| *symbol != 3));
        }
    }
}
