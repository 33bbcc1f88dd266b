//! Counts of symbols by context, bounded, with a half-life.
//!
//! A context is an exact 64-bit key. Its row holds the decayed number of observations and a chain of blocks, each of up to four
//! symbols with their counts: a walk waits for memory once per block. Decay is lazy: a row is updated when it is written, and read through a factor
//! otherwise. At the limit a clock hand compares the next rows and evicts the least useful one (fewest decayed observations), as sampled caches do.
//! Rows and blocks live in two slabs with free lists, so that nothing is allocated once they have grown to their limits.

const END: u32 = u32::MAX;
/// The key of a free row, which no context has.
const FREE: u64 = u64::MAX;
/// The symbol of a free place in a block; no symbol is counted under it.
const NOTHING: u16 = u16::MAX;
/// Smaller counts are dropped when their row is updated.
const FORGOTTEN: f32 = 0.02;
/// A row is updated when its counts have decayed below this factor. Before that, additions are scaled up instead.
const WORTH: f32 = 0.7;
/// Rows that the hand compares per eviction.
const COMPARED: usize = 16;
/// Most rows per bucket of the hash table, on average.
const LOAD: usize = 1;

/// A row as it is stored: 24 bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Row {
    key: u64,
    /// The next row of the bucket, or of the free list.
    next: u32,
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

const BLOCK: usize = 4;
const EMPTY: Block = Block { next: END, counts: [0.0; BLOCK], symbols: [NOTHING; BLOCK] };

impl Block {
    fn iter(self) -> impl Iterator<Item = (u16, f32)> {
        self.symbols.into_iter().zip(self.counts).filter(|(symbol, _)| *symbol != NOTHING)
    }

    fn len(&self) -> usize {
        self.symbols.iter().filter(|symbol| **symbol != NOTHING).count()
    }
}

type Place = (u32, usize);

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Limits {
    pub(crate) rows: usize,
    pub(crate) blocks: usize,
    /// Half-life in minutes; no decay unless positive.
    pub(crate) half_life_min: f64,
}

#[derive(Debug, Clone)]
pub(crate) struct Counts {
    limits: Limits,
    buckets: Vec<u32>,
    rows: Vec<Row>,
    blocks: Vec<Block>,
    free_row: u32,
    free_block: u32,
    live_rows: usize,
    live_counts: usize,
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
        counts.chain(first).flat_map(Block::iter).map(move |(symbol, count)| (symbol, f64::from(count * factor)))
    }

    pub(crate) fn count(&self, symbol: u16) -> f64 {
        self.symbols().find(|(other, _)| *other == symbol).map_or(0.0, |(_, count)| count)
    }
}

fn bucket_of(key: u64, buckets: usize) -> usize {
    // The finaliser of splitmix64; `buckets` is a power of two.
    let mut hash = key.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (hash ^ (hash >> 31)) as usize & (buckets - 1)
}

impl Counts {
    pub(crate) fn new(limits: Limits) -> Self {
        let limits = Limits { rows: limits.rows.clamp(1, 1 << 24), blocks: limits.blocks.clamp(1, 1 << 24), ..limits };
        Self {
            limits,
            buckets: vec![END; 16],
            rows: Vec::new(),
            blocks: Vec::new(),
            free_row: END,
            free_block: END,
            live_rows: 0,
            live_counts: 0,
            hand: 0,
        }
    }

    /// Numbers of contexts and counts.
    pub(crate) fn len(&self) -> (usize, usize) {
        (self.live_rows, self.live_counts)
    }

    pub(crate) fn bytes(&self) -> usize {
        self.buckets.capacity() * size_of::<u32>()
            + self.rows.capacity() * size_of::<Row>()
            + self.blocks.capacity() * size_of::<Block>()
    }

    fn factor(&self, touched_min: u32, now_min: u32) -> f32 {
        let age_min = now_min.saturating_sub(touched_min);
        if age_min == 0 || self.limits.half_life_min <= 0.0 {
            return 1.0;
        }
        ((-f64::from(age_min) / self.limits.half_life_min) as f32).exp2()
    }

    fn chain(&self, first: u32) -> impl Iterator<Item = Block> {
        let mut at = first;
        std::iter::from_fn(move || {
            let block = *self.blocks.get(at as usize)?;
            at = block.next;
            Some(block)
        })
    }

    fn find(&self, key: u64) -> Option<u32> {
        let mut at = self.buckets[bucket_of(key, self.buckets.len())];
        while at != END {
            let row = self.rows[at as usize];
            if row.key == key {
                return Some(at);
            }
            at = row.next;
        }
        None
    }

    pub(crate) fn get(&self, key: u64, now_min: u32) -> Option<Seen<'_>> {
        let row = self.rows[self.find(key)? as usize];
        let factor = self.factor(row.touched_min, now_min);
        Some(Seen { counts: self, first: row.first, factor })
    }

    /// Adds to the count of `symbol` in the context `key`. Returns true if the symbol is new there. A weight that has decayed below the limit by now
    /// is ignored.
    pub(crate) fn add(&mut self, key: u64, symbol: u16, weight: f64, now_min: u32) -> bool {
        debug_assert_ne!(symbol, NOTHING);
        let found = self.find(key);
        let touched_min = found.map_or(now_min, |row| self.rows[row as usize].touched_min);
        // An addition that is older than the row decays to the row's time.
        let faded = self.factor(now_min, touched_min);
        let weight = (weight * f64::from(faded)) as f32;
        if weight < f32::MIN_POSITIVE || (faded < WORTH && weight < FORGOTTEN) {
            return false;
        }
        let row = found.unwrap_or_else(|| self.insert(key, now_min));
        let factor = self.factor(touched_min, now_min);
        let (known, weight) = match factor >= WORTH {
            true => (self.bring_forward(row, symbol), weight / factor),
            false => (self.decay(row, factor, now_min, symbol), weight),
        };
        self.rows[row as usize].total += weight;
        let (at, place) = match known {
            Ok((at, place)) => {
                self.blocks[at as usize].counts[place] += weight;
                return false;
            }
            Err(Some(free)) => free,
            Err(None) => (self.new_block(row), 0),
        };
        let block = &mut self.blocks[at as usize];
        (block.symbols[place], block.counts[place]) = (symbol, weight);
        self.live_counts += 1;
        true
    }

    /// Finds a symbol and moves it to the row's first place, so that frequent symbols are found soon. Otherwise returns a free place of the row.
    fn bring_forward(&mut self, row: u32, symbol: u16) -> Result<Place, Option<Place>> {
        let first = self.rows[row as usize].first;
        let (mut at, mut free) = (first, None);
        while at != END {
            let Block { next, symbols, counts } = self.blocks[at as usize];
            if let Some(place) = symbols.iter().position(|own| *own == symbol) {
                let front = &mut self.blocks[first as usize];
                let behind = (
                    std::mem::replace(&mut front.symbols[0], symbol),
                    std::mem::replace(&mut front.counts[0], counts[place]),
                );
                let block = &mut self.blocks[at as usize];
                if (at, place) != (first, 0) {
                    (block.symbols[place], block.counts[place]) = behind;
                }
                return Ok((first, 0));
            }
            free = free.or_else(|| symbols.iter().position(|own| *own == NOTHING).map(|place| (at, place)));
            at = next;
        }
        Err(free)
    }

    /// Updates a row and drops small counts. Returns the place of a symbol, or a free place of the row.
    fn decay(&mut self, row: u32, factor: f32, now_min: u32, symbol: u16) -> Result<Place, Option<Place>> {
        let touched_min = self.rows[row as usize].touched_min;
        self.rows[row as usize].touched_min = touched_min.max(now_min);
        self.keep(row, |_, count| {
            *count *= factor;
            *count >= FORGOTTEN
        });
        self.rows[row as usize].total =
            self.chain(self.rows[row as usize].first).flat_map(Block::iter).map(|(_, count)| count).sum();
        self.bring_forward(row, symbol)
    }

    /// Drops unwanted counts of a row, and empty blocks.
    fn keep(&mut self, row: u32, mut wanted: impl FnMut(u16, &mut f32) -> bool) {
        let (mut at, mut before) = (self.rows[row as usize].first, END);
        while at != END {
            let block = &mut self.blocks[at as usize];
            for (symbol, count) in block.symbols.iter_mut().zip(&mut block.counts) {
                if *symbol != NOTHING && !wanted(*symbol, count) {
                    (*symbol, *count) = (NOTHING, 0.0);
                    self.live_counts -= 1;
                }
            }
            let Block { next, symbols, .. } = *block;
            if symbols == EMPTY.symbols {
                match before {
                    END => self.rows[row as usize].first = next,
                    before => self.blocks[before as usize].next = next,
                }
                self.give_back_block(at);
            } else {
                before = at;
            }
            at = next;
        }
    }

    fn insert(&mut self, key: u64, now_min: u32) -> u32 {
        if self.free_row == END && self.rows.len() >= self.limits.rows {
            self.evict(None, now_min);
        }
        let row = Row { key, next: END, first: END, total: 0.0, touched_min: now_min };
        let at = match self.free_row {
            END => {
                reserve(&mut self.rows, self.limits.rows);
                self.rows.push(row);
                self.rows.len() as u32 - 1
            }
            free => {
                self.free_row = self.rows[free as usize].next;
                self.rows[free as usize] = row;
                free
            }
        };
        self.live_rows += 1;
        if self.live_rows > self.buckets.len() * LOAD {
            self.spread();
        }
        let bucket = bucket_of(key, self.buckets.len());
        self.rows[at as usize].next = std::mem::replace(&mut self.buckets[bucket], at);
        at
    }

    fn spread(&mut self) {
        let buckets = 2 * self.buckets.len();
        let mut wider = vec![END; buckets];
        for head in &self.buckets {
            let mut at = *head;
            while at != END {
                let row = &mut self.rows[at as usize];
                let next = row.next;
                row.next = std::mem::replace(&mut wider[bucket_of(row.key, buckets)], at);
                at = next;
            }
        }
        self.buckets = wider;
    }

    /// Adds a block in front of a row.
    fn new_block(&mut self, row: u32) -> u32 {
        while self.free_block == END && self.blocks.len() >= self.limits.blocks {
            if !self.evict(Some(row), self.rows[row as usize].touched_min) {
                // Only the row itself is left: one of its own blocks is dropped.
                self.shorten(row);
            }
        }
        let block = Block { next: self.rows[row as usize].first, ..EMPTY };
        let at = match self.free_block {
            END => {
                reserve(&mut self.blocks, self.limits.blocks);
                self.blocks.push(block);
                self.blocks.len() as u32 - 1
            }
            free => {
                self.free_block = std::mem::replace(&mut self.blocks[free as usize], block).next;
                free
            }
        };
        self.rows[row as usize].first = at;
        at
    }

    fn give_back_block(&mut self, at: u32) {
        let block = &mut self.blocks[at as usize];
        self.live_counts -= block.len();
        *block = Block { next: std::mem::replace(&mut self.free_block, at), ..EMPTY };
    }

    fn shorten(&mut self, row: u32) {
        let first = self.rows[row as usize].first;
        if let Some(block) = self.blocks.get(first as usize) {
            let (next, gone) = (block.next, block.iter().map(|(_, count)| count).sum::<f32>());
            self.rows[row as usize].first = next;
            self.rows[row as usize].total -= gone;
            self.give_back_block(first);
        }
    }

    /// Usefulness of a row: the base-2 logarithm of its decayed observations, up to a constant. The mantissa stands for its logarithm, with an error
    /// of at most a tenth. Each eviction compares many rows, and a power of two for each would dominate the cost.
    fn worth(&self, row: &Row, now_min: u32) -> f32 {
        const ONE: f32 = (1_u32 << (f32::MANTISSA_DIGITS - 1)) as f32;
        let faded = match self.limits.half_life_min > 0.0 {
            true => f64::from(now_min.saturating_sub(row.touched_min)) / self.limits.half_life_min,
            false => 0.0,
        };
        // Rounding can leave an emptied row below zero.
        row.total.max(0.0).to_bits() as f32 / ONE - faded as f32
    }

    /// Evicts the least useful of the next rows. Returns false if there was none.
    fn evict(&mut self, keep: Option<u32>, now_min: u32) -> bool {
        let (mut least, mut compared) = (None, 0);
        for _ in 0..self.rows.len() {
            self.hand = (self.hand + 1) % self.rows.len();
            let at = self.hand as u32;
            let row = self.rows[self.hand];
            if keep == Some(at) || row.key == FREE {
                continue;
            }
            let worth = self.worth(&row, now_min);
            if least.is_none_or(|(_, other)| worth < other) {
                least = Some((at, worth));
            }
            compared += 1;
            if compared == COMPARED {
                break;
            }
        }
        least.map(|(at, _)| self.remove(at)).is_some()
    }

    fn remove(&mut self, at: u32) {
        let Row { key, next, first, .. } = self.rows[at as usize];
        let bucket = bucket_of(key, self.buckets.len());
        if self.buckets[bucket] == at {
            self.buckets[bucket] = next;
        } else {
            let mut before = self.buckets[bucket];
            while before != END {
                let row = &mut self.rows[before as usize];
                if row.next == at {
                    row.next = next;
                    break;
                }
                before = row.next;
            }
        }
        let mut block = first;
        while block != END {
            let next = self.blocks[block as usize].next;
            self.give_back_block(block);
            block = next;
        }
        let row = &mut self.rows[at as usize];
        // The hand skips free rows.
        *row = Row { key: FREE, next: self.free_row, first: END, total: 0.0, touched_min: 0 };
        self.free_row = at;
        self.live_rows -= 1;
    }

    pub(crate) fn touched_min(&mut self) -> impl Iterator<Item = &mut u32> {
        self.rows.iter_mut().map(|row| &mut row.touched_min)
    }

    pub(crate) fn retain(
        &mut self,
        mut wanted: impl FnMut(u64) -> bool,
        mut symbol_wanted: impl FnMut(u64, u16) -> bool,
    ) {
        for at in 0..self.rows.len() as u32 {
            let key = self.rows[at as usize].key;
            if self.find(key) != Some(at) {
                continue;
            }
            if !wanted(key) {
                self.remove(at);
                continue;
            }
            let mut gone = 0.0;
            self.keep(at, |symbol, count| {
                let wanted = symbol_wanted(key, symbol);
                gone += if wanted { 0.0 } else { *count };
                wanted
            });
            self.rows[at as usize].total -= gone;
        }
    }

    /// Every context, sorted by key, with its last minute and its counts as of that minute.
    pub(crate) fn rows(&self) -> Vec<StoredRow> {
        let live = self.buckets.iter().flat_map(|head| {
            let mut at = *head;
            std::iter::from_fn(move || {
                let row = self.rows.get(at as usize)?;
                at = row.next;
                Some((row.key, row.touched_min, self.chain(row.first).flat_map(Block::iter).collect()))
            })
        });
        let mut rows: Vec<StoredRow> = live.collect();
        rows.sort_by_key(|(key, ..)| *key);
        rows.iter_mut().for_each(|(.., symbols)| symbols.sort_by_key(|(symbol, _)| *symbol));
        rows
    }
}

/// A context's key, its last minute, and its symbols with their counts as of that minute.
pub(crate) type StoredRow = (u64, u32, Vec<(u16, f32)>);

/// Grows a slab by doubling, up to its limit.
fn reserve<T>(slab: &mut Vec<T>, limit: usize) {
    if slab.len() == slab.capacity() {
        let wanted = (2 * slab.capacity()).clamp(64, limit.max(64));
        slab.reserve_exact(wanted.saturating_sub(slab.len()).max(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    const DAY_MIN: u32 = 1440;

    fn counts(rows: usize, blocks: usize, half_life_min: f64) -> Counts {
        Counts::new(Limits { rows, blocks, half_life_min })
    }

    #[test]
    fn a_count_is_worth_half_after_the_half_life() {
        let mut counts = counts(8, 8, f64::from(DAY_MIN));
        assert!(counts.add(1, 7, 4.0, 0));
        assert!(!counts.add(1, 7, 1.0, DAY_MIN));
        let seen = counts.get(1, 2 * DAY_MIN).unwrap();
        assert!((seen.count(7) - 1.5).abs() < 1e-6);
        assert!(counts.get(2, 0).is_none());
    }

    #[test]
    fn a_row_that_rounding_leaves_below_zero_gives_way_first() {
        let mut counts = counts(2, 8, 0.0);
        counts.add(1, 7, 1000.0, 0);
        counts.add(2, 7, 1.0, 0);
        counts.rows[1].total = -1e-6;
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
            assert!(!counts.add(1, 2, 1.0, 0) && !counts.add(1, 1, 1.0, 1));
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
                let new = counts.add(key, symbol, 1.0, minute);
                let count = maps.entry(key).or_default().entry(symbol).or_default();
                prop_assert_eq!(new, *count == 0.0);
                *count += 1.0;
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
                let older_min = counts.rows[counts.find(key).unwrap() as usize].touched_min.saturating_sub(minute);
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
                let row = counts.rows[counts.find(key).unwrap() as usize];
                prop_assert!((row.total - total).abs() < 1e-3 && row.touched_min == touched_min);
            }
            counts.retain(|key| key % 2 == 0, |_, symbol| symbol < 10);
            prop_assert!(counts.rows().iter().all(|(key, _, s)| key % 2 == 0 && s.iter().all(|(s, _)| *s < 10)));
        }
    }
}
