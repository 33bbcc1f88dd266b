//! Counts of symbols by context, bounded, with a half-life.
//!
//! A context is an exact 64-bit key. It has one of the rows of the set that its hash names; the row holds a chain of blocks, each of up to four symbols
//! with their counts. Decay is lazy: a row is updated when it is written, and read through a factor otherwise. The table doubles when a set is full. At
//! the limit the set's row with the fewest decayed observations is evicted. Nothing is allocated once table and blocks have grown to their limits.

const END: u32 = u32::MAX;
/// The key of a free row, which no context has.
const FREE: u64 = u64::MAX;
/// The symbol of a free place in a block; no symbol is counted under it.
const NOTHING: u16 = u16::MAX;
/// Smaller counts are dropped when their row is updated.
const FORGOTTEN: f32 = 0.02;
/// A row is updated when its counts have decayed below this factor. Before that, additions are scaled up instead.
const WORTH: f32 = 0.7;
/// Least rows of a set.
const WAYS: usize = 16;
/// Symbols of a block.
const BLOCK: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq)]
struct Row {
    first: u32,
    total: f32,
    touched_min: u32,
}

/// Up to four symbols with their counts: 28 bytes. Free places can be anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Block {
    next: u32,
    counts: [f32; BLOCK],
    symbols: [u16; BLOCK],
}

const EMPTY_ROW: Row = Row { first: END, total: 0.0, touched_min: 0 };
const EMPTY: Block = Block { next: END, counts: [0.0; BLOCK], symbols: [NOTHING; BLOCK] };

impl Block {
    fn iter(self) -> impl Iterator<Item = (u16, f32)> {
        self.symbols.into_iter().zip(self.counts).filter(|(symbol, _)| *symbol != NOTHING)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Counts {
    rows_max: usize,
    blocks_max: usize,
    /// No decay unless positive.
    half_life_min: f64,
    /// Rows of a set. The number of sets is a power of two.
    ways: usize,
    keys: Vec<u64>,
    rows: Vec<Row>,
    blocks: Vec<Block>,
    free_block: u32,
    /// The set that is the next to give way to other blocks.
    hand: usize,
}

/// A row at a time of reading: its counts times a factor.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen<'a> {
    counts: &'a Counts,
    first: u32,
    factor: f32,
}

impl Seen<'_> {
    /// Every symbol with its decayed count.
    pub(crate) fn symbols(&self) -> impl Iterator<Item = (u16, f64)> {
        let Self { counts, first, factor } = *self;
        counts.symbols(first).map(move |(symbol, count)| (symbol, f64::from(count * factor)))
    }

    pub(crate) fn count(&self, symbol: u16) -> f64 {
        self.symbols().find(|(other, _)| *other == symbol).map_or(0.0, |(_, count)| count)
    }
}

impl Counts {
    pub(crate) fn new(rows_max: usize, blocks_max: usize, half_life_min: f64) -> Self {
        let [rows_max, blocks_max] = [rows_max, blocks_max].map(|limit| limit.clamp(1, 1 << 24));
        let sets_max = 1 << (rows_max / WAYS).max(1).ilog2();
        let ways = rows_max / sets_max;
        Self {
            rows_max: ways * sets_max,
            blocks_max,
            half_life_min,
            ways,
            keys: vec![FREE; ways],
            rows: vec![EMPTY_ROW; ways],
            blocks: Vec::new(),
            free_block: END,
            hand: 0,
        }
    }

    /// Numbers of contexts and counts.
    pub(crate) fn len(&self) -> (usize, usize) {
        let contexts = self.keys.iter().filter(|key| **key != FREE).count();
        (contexts, self.rows.iter().map(|row| self.symbols(row.first).count()).sum())
    }

    pub(crate) fn bytes(&self) -> usize {
        self.keys.len() * (size_of::<u64>() + size_of::<Row>()) + self.blocks.capacity() * size_of::<Block>()
    }

    /// The base-2 logarithm of the factor by which counts have decayed.
    fn faded(&self, touched_min: u32, now_min: u32) -> f32 {
        let age_min = f64::from(now_min.saturating_sub(touched_min));
        if self.half_life_min > 0.0 { (-age_min / self.half_life_min) as f32 } else { 0.0 }
    }

    fn factor(&self, touched_min: u32, now_min: u32) -> f32 {
        self.faded(touched_min, now_min).exp2()
    }

    fn symbols(&self, first: u32) -> impl Iterator<Item = (u16, f32)> {
        let mut at = first;
        let blocks = std::iter::from_fn(move || {
            let block = *self.blocks.get(at as usize)?;
            at = block.next;
            Some(block)
        });
        blocks.flat_map(Block::iter)
    }

    /// The rows that a key can have.
    fn set(&self, key: u64) -> std::ops::Range<usize> {
        // The finaliser of splitmix64.
        let mut hash = key.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        let begin = self.ways * ((hash ^ (hash >> 31)) as usize & (self.keys.len() / self.ways - 1));
        begin..begin + self.ways
    }

    fn find(&self, key: u64) -> Option<usize> {
        let set = self.set(key);
        self.keys[set.clone()].iter().position(|own| *own == key).map(|at| set.start + at)
    }

    pub(crate) fn get(&self, key: u64, now_min: u32) -> Option<Seen<'_>> {
        let row = self.rows[self.find(key)?];
        Some(Seen { counts: self, first: row.first, factor: self.factor(row.touched_min, now_min) })
    }

    /// Adds to the count of `symbol` in the context `key`. A weight that has decayed below the limit by now is ignored.
    pub(crate) fn add(&mut self, key: u64, symbol: u16, weight: f64, now_min: u32) {
        debug_assert_ne!(symbol, NOTHING);
        let found = self.find(key);
        let touched_min = found.map_or(now_min, |row| self.rows[row].touched_min);
        // An addition that is older than the row decays to the row's time.
        let faded = self.factor(now_min, touched_min);
        let mut weight = (weight * f64::from(faded)) as f32;
        if weight < f32::MIN_POSITIVE || (faded < WORTH && weight < FORGOTTEN) {
            return;
        }
        let row = found.unwrap_or_else(|| self.insert(key, now_min));
        let factor = self.factor(touched_min, now_min);
        if factor >= WORTH {
            weight /= factor;
        } else {
            self.rows[row].touched_min = touched_min.max(now_min);
            self.keep(row, |count| {
                *count *= factor;
                *count >= FORGOTTEN
            });
        }
        self.rows[row].total += weight;
        let (at, place) = self.place(row, symbol);
        let block = &mut self.blocks[at as usize];
        block.symbols[place] = symbol;
        block.counts[place] += weight;
    }

    /// The place of a symbol in a row's first block, so that frequent symbols are found soon.
    fn place(&mut self, row: usize, symbol: u16) -> (u32, usize) {
        let first = self.rows[row].first;
        let (mut at, mut free) = (first, None);
        while at != END {
            let Block { next, symbols, counts } = self.blocks[at as usize];
            if let Some(place) = symbols.iter().position(|own| *own == symbol) {
                let front = &mut self.blocks[first as usize];
                let behind = (front.symbols[0], front.counts[0]);
                (front.symbols[0], front.counts[0]) = (symbol, counts[place]);
                if (at, place) != (first, 0) {
                    let block = &mut self.blocks[at as usize];
                    (block.symbols[place], block.counts[place]) = behind;
                }
                return (first, 0);
            }
            free = free.or_else(|| symbols.iter().position(|own| *own == NOTHING).map(|place| (at, place)));
            at = next;
        }
        free.unwrap_or_else(|| (self.new_block(row), 0))
    }

    /// Drops unwanted counts of a row, and empty blocks.
    fn keep(&mut self, row: usize, mut wanted: impl FnMut(&mut f32) -> bool) {
        let (mut at, mut before) = (self.rows[row].first, END);
        while at != END {
            let block = &mut self.blocks[at as usize];
            for (symbol, count) in block.symbols.iter_mut().zip(&mut block.counts) {
                if *symbol != NOTHING && !wanted(count) {
                    (*symbol, *count) = (NOTHING, 0.0);
                }
            }
            let Block { next, symbols, .. } = *block;
            if symbols == EMPTY.symbols {
                match before {
                    END => self.rows[row].first = next,
                    before => self.blocks[before as usize].next = next,
                }
                self.give_back(at);
            } else {
                before = at;
            }
            at = next;
        }
        self.rows[row].total = self.symbols(self.rows[row].first).map(|(_, count)| count).sum();
    }

    fn insert(&mut self, key: u64, now_min: u32) -> usize {
        let mut free = self.set(key).find(|row| self.keys[*row] == FREE);
        while free.is_none() && self.keys.len() < self.rows_max {
            self.spread();
            free = self.set(key).find(|row| self.keys[*row] == FREE);
        }
        let row = free.or_else(|| self.evict(self.set(key), usize::MAX, now_min)).unwrap_or(self.set(key).start);
        self.keys[row] = key;
        self.rows[row] = Row { touched_min: now_min, ..EMPTY_ROW };
        row
    }

    /// Doubles the number of sets: each one becomes two.
    fn spread(&mut self) {
        let wider = 2 * self.keys.len();
        let keys = std::mem::replace(&mut self.keys, vec![FREE; wider]);
        let rows = std::mem::replace(&mut self.rows, vec![EMPTY_ROW; wider]);
        for (key, row) in keys.into_iter().zip(rows).filter(|(key, _)| *key != FREE) {
            if let Some(at) = self.set(key).find(|at| self.keys[*at] == FREE) {
                (self.keys[at], self.rows[at]) = (key, row);
            }
        }
    }

    /// Evicts the least useful row of a set, except one. Returns the row if there was one.
    fn evict(&mut self, set: std::ops::Range<usize>, except: usize, now_min: u32) -> Option<usize> {
        let others = set.filter(|row| *row != except && self.keys[*row] != FREE);
        let worth = |row: &Row| row.total.max(f32::MIN_POSITIVE).log2() + self.faded(row.touched_min, now_min);
        let least = others.min_by(|a, b| worth(&self.rows[*a]).total_cmp(&worth(&self.rows[*b])))?;
        self.remove(least);
        Some(least)
    }

    /// Adds a block in front of a row. At the limit other rows give way, set by set, and at last a block of the row itself.
    fn new_block(&mut self, row: usize) -> u32 {
        let sets = self.keys.len() / self.ways;
        let (mut empty, now_min) = (0, self.rows[row].touched_min);
        while self.free_block == END && self.blocks.len() >= self.blocks_max && empty < sets {
            self.hand = (self.hand + 1) % sets;
            let set = self.ways * self.hand..self.ways * (self.hand + 1);
            empty = if self.evict(set, row, now_min).is_some() { 0 } else { empty + 1 };
        }
        let mut at = self.free_block;
        if at == END && self.blocks.len() < self.blocks_max {
            at = self.blocks.len() as u32;
            self.blocks.push(EMPTY);
        } else if at == END {
            at = self.rows[row].first;
            self.rows[row].first = self.blocks[at as usize].next;
        } else {
            self.free_block = self.blocks[at as usize].next;
        }
        self.blocks[at as usize] = Block { next: std::mem::replace(&mut self.rows[row].first, at), ..EMPTY };
        at
    }

    fn give_back(&mut self, at: u32) {
        self.blocks[at as usize] = Block { next: std::mem::replace(&mut self.free_block, at), ..EMPTY };
    }

    fn remove(&mut self, row: usize) {
        self.keep(row, |_| false);
        (self.keys[row], self.rows[row]) = (FREE, EMPTY_ROW);
    }

    pub(crate) fn touched_min(&mut self) -> impl Iterator<Item = &mut u32> {
        self.rows.iter_mut().map(|row| &mut row.touched_min)
    }

    /// Drops contexts.
    pub(crate) fn retain(&mut self, wanted: impl Fn(u64) -> bool) {
        for row in 0..self.keys.len() {
            if self.keys[row] != FREE && !wanted(self.keys[row]) {
                self.remove(row);
            }
        }
    }

    /// Every context, sorted by key, with its last minute and its counts as of that minute.
    #[expect(clippy::type_complexity, reason = "one caller writes it to rows of the state database")]
    pub(crate) fn rows(&self) -> Vec<(u64, u32, Vec<(u16, f32)>)> {
        let live = self.keys.iter().zip(&self.rows).filter(|(key, _)| **key != FREE);
        let mut rows: Vec<_> =
            live.map(|(key, row)| (*key, row.touched_min, self.symbols(row.first).collect::<Vec<_>>())).collect();
        rows.sort_by_key(|(key, ..)| *key);
        rows.iter_mut().for_each(|(.., symbols)| symbols.sort_by_key(|(symbol, _)| *symbol));
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
    fn a_row_that_rounding_leaves_below_zero_gives_way_first() {
        let mut counts = counts(2, 8, 0.0);
        counts.add(1, 7, 1000.0, 0);
        counts.add(2, 7, 1.0, 0);
        let second = counts.find(2).unwrap();
        counts.rows[second].total = -1e-6;
        counts.add(3, 7, 1.0, 0);
        assert!(counts.get(1, 0).is_some() && counts.get(2, 0).is_none());
    }

    #[test]
    fn on_a_clock_that_was_set_counts_are_as_old_as_before() {
        let mut counts = counts(8, 8, f64::from(DAY_MIN));
        counts.add(1, 7, 4.0, DAY_MIN);
        counts.touched_min().for_each(|minute| *minute += 400 * DAY_MIN);
        assert!((counts.get(1, 402 * DAY_MIN).unwrap().count(7) - 2.0).abs() < 1e-6);
    }

    #[test]
    fn the_least_used_context_gives_way() {
        let mut counts = counts(8, 64, 0.0);
        for _ in 0..10 {
            (0..7).for_each(|key| {
                counts.add(key, 1, 1.0, 0);
            });
        }
        counts.add(100, 1, 1.0, 0);
        counts.add(101, 1, 1.0, 0);
        assert!(counts.get(100, 0).is_none() && counts.get(101, 0).is_some());
        assert!((0..7).all(|key| counts.get(key, 0).is_some()));
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
                prop_assert!(counts.len().0 <= rows && counts.blocks.len() <= blocks);
                // An older addition is worth less there, in the end zero.
                let older_min = counts.rows[counts.find(key).unwrap()].touched_min.saturating_sub(minute);
                let worth = 0.9 * (-f64::from(older_min) / 10_000.0).exp2();
                let count = counts.get(key, minute).map(|seen| seen.count(symbol));
                prop_assert!(count.is_some_and(|count| count >= worth || worth < f64::from(FORGOTTEN)));
                prop_assert!(counts.rows().iter().flat_map(|(.., symbols)| symbols).all(|(_, count)| count.is_normal()));
            }
            let stored = counts.rows();
            prop_assert_eq!(stored.len(), counts.len().0);
            prop_assert_eq!(stored.iter().map(|(.., symbols)| symbols.len()).sum::<usize>(), counts.len().1);
            for (key, touched_min, symbols) in stored {
                let total: f32 = symbols.iter().map(|(_, count)| count).sum();
                let row = counts.rows[counts.find(key).unwrap()];
                prop_assert!((row.total - total).abs() < 1e-3 && row.touched_min == touched_min);
            }
            counts.retain(|key| key % 2 == 0);
            prop_assert!(counts.rows().iter().all(|(key, ..)| key % 2 == 0));
        }
    }
}
