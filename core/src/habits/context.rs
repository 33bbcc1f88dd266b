//! The facts of a forecast: the place, the last things, time spent and the part of the day. A level is a context that some of them form.
//!
//! A key of counts has 64 bits: the level's number, the person's slot, and up to three facts. More than three things are a digest of 48 bits; two
//! contexts collide once in 10^14.

/// Hours of one part of the day, from midnight on, in local time.
pub const PART_HOURS: u16 = 3;
/// Parts of a day.
pub const PARTS: usize = 24 / PART_HOURS as usize;
/// Upper ends of the classes of time spent, in seconds.
pub(crate) const CLASSES_S: [f64; 6] = [15.0, 60.0, 240.0, 960.0, 3_840.0, 15_360.0];
pub(crate) const CLASSES: usize = CLASSES_S.len() + 1;
/// Things of the longest context.
pub(crate) const LAST: usize = 5;
pub(crate) const NONE: u16 = u16::MAX;
/// Bits of the slot; the bits above hold how often the last thing was mentioned in a row, up to a limit.
pub(crate) const SLOT_MASK: u8 = 0x3f;
const TIMES_MAX: u8 = 3;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Fact {
    Here,
    /// The last different things.
    Last,
    Second,
    Third,
    /// The digest of the last five things.
    Five0,
    Five1,
    Five2,
    /// Classes of the time between the last two observations, and of the time spent here.
    Pace,
    Spent,
    Horizon,
    HorizonSpent,
    /// Parts of the day, of two hours and of three.
    Hours2,
    Hours3,
}

/// The facts of a forecast, and how often the last thing was mentioned again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Context {
    facts: [u16; Fact::Hours3 as usize + 1],
    times: u8,
}

impl Context {
    pub(crate) fn new(here: u16, spent: u16, at_s: f64) -> Self {
        let hour = ((at_s.rem_euclid(86_400.0) / 3_600.0) as u16).min(23);
        let facts =
            [(Fact::Here, here), (Fact::Spent, spent), (Fact::Hours2, hour / 2), (Fact::Hours3, hour / PART_HOURS)];
        Self { facts: [NONE; _], times: 0 }.with(facts)
    }

    fn with<const N: usize>(mut self, facts: [(Fact, u16); N]) -> Self {
        facts.into_iter().for_each(|(fact, number)| self.facts[fact as usize] = number);
        self
    }

    /// After the last different things, the latest first, mentioned so many times again, at this pace.
    pub(crate) fn after(mut self, last: &[u16; LAST], times: u8, pace: u16) -> Self {
        let things = [[last[0], last[1], last[2]], digest(last)];
        self.facts[Fact::Last as usize..][..6].copy_from_slice(things.as_flattened());
        self.times = times;
        self.with([(Fact::Pace, pace)])
    }

    /// With this thing as the last one.
    pub(crate) fn of_thing(self, number: u16) -> Self {
        self.with([(Fact::Last, number)])
    }

    /// A horizon before the outcome.
    pub(crate) fn before(self, horizon: u16) -> Self {
        self.with([(Fact::Horizon, horizon), (Fact::HorizonSpent, horizon << 8 | self.get(Fact::Spent))])
    }

    pub(crate) fn get(&self, fact: Fact) -> u16 {
        self.facts[fact as usize]
    }

    pub(crate) fn key(&self, level: &Level, slot: u8) -> u64 {
        let times = if level.by_times { self.times.min(TIMES_MAX) } else { 0 };
        let fact = |at| level.facts.get(at).map_or(NONE, |fact| self.get(*fact));
        key(level.part.number, slot & SLOT_MASK | times << 6, std::array::from_fn(fact))
    }
}

/// An expert or a level. Each can be left out, to measure how much it adds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Part {
    /// The database holds the numbers of levels: those of removed levels stay unused.
    pub(crate) number: u8,
    /// A part without a name is never left out.
    pub(crate) name: &'static str,
}

/// A context. Its counts are mixed over the forecast of a shorter one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Level {
    pub(crate) part: Part,
    facts: &'static [Fact],
    by_times: bool,
    pub(crate) discount: f64,
    /// Observations that the shorter context is worth.
    pub(crate) concentration: f64,
}

pub(crate) const fn level(number: u8, name: &'static str, facts: &'static [Fact], weights: [f64; 2]) -> Level {
    let [discount, concentration] = weights;
    Level { part: Part { number, name }, facts, by_times: false, discount, concentration }
}

impl Level {
    /// The repeated mentions of the last thing are a further fact.
    pub(crate) const fn by_times(self) -> Self {
        Self { by_times: true, ..self }
    }

    /// What the numbers of its keys name.
    pub(crate) fn names(&self) -> [Number; 3] {
        std::array::from_fn(|at| match self.facts.get(at) {
            Some(Fact::Here) => Number::Place,
            Some(Fact::Last | Fact::Second | Fact::Third) => Number::Thing,
            _ => Number::Plain,
        })
    }
}

/// The name that a number in the counts stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Number {
    Thing,
    Place,
    #[default]
    Plain,
}

/// The key of a level's number, a slot, and facts.
pub(crate) fn key(level: u8, slot: u8, after: [u16; 3]) -> u64 {
    let [first, second, third] = after.map(u64::from);
    u64::from(level) << 56 | u64::from(slot) << 48 | first << 32 | second << 16 | third
}

/// The number of a key's level, the slot, and the facts.
pub(crate) fn split(key: u64) -> (u8, u8, [u16; 3]) {
    ((key >> 56) as u8, (key >> 48) as u8, [(key >> 32) as u16, (key >> 16) as u16, key as u16])
}

/// The parts that are left out; none by default. The language model and the shipped forecast always stay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Without(pub(crate) u64);

impl Without {
    pub(crate) fn uses(self, part: Part) -> bool {
        self.0 >> part.number & 1 == 0
    }
}

/// The database holds the result. A number is mixed in by SplitMix64.
fn digest(things: &[u16]) -> [u16; 3] {
    let mix = |digest: u64, number: &u16| {
        let mut hash = (digest ^ u64::from(*number)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        hash ^ (hash >> 31)
    };
    split(things.iter().fold(0, mix)).2
}

pub(crate) fn time_class(time_s: f64) -> u16 {
    CLASSES_S.partition_point(|end_s| *end_s <= time_s) as u16
}

/// The begin and the end of a class.
pub(crate) fn class_s(class: usize) -> [f64; 2] {
    let begin_s = class.checked_sub(1).map_or(0.0, |before| CLASSES_S[before]);
    [begin_s, CLASSES_S.get(class).copied().unwrap_or(2.0 * begin_s)]
}

/// Minutes since 1970 in local time; earlier times are 0.
pub(crate) fn minute(at_s: f64) -> u32 {
    (at_s / 60.0).clamp(0.0, f64::from(u32::MAX)) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_context_has_the_hour_and_the_digests_of_existing_databases() {
        // 2024-03-01 08:15:00.
        let context = Context::new(7, 2, 1_709_251_200.0 + 8.25 * 3_600.0).after(&[1, 2, 3, 4, 5], 9, 3);
        let key = |facts, slot| split(context.key(&level(31, "", facts, [0.0; 2]), slot));
        assert_eq!(key(&[Fact::Hours2, Fact::Hours3], 63), (31, 63, [4, 2, NONE]));
        assert_eq!(key(&[Fact::Five0, Fact::Five1, Fact::Five2], 1).2, [27063, 5733, 20958]);
        assert_eq!(
            split(context.key(&level(7, "", &[Fact::Second], [0.0; 2]).by_times(), 1)),
            (7, 0xc1, [2, NONE, NONE])
        );
        assert_eq!(Context::new(7, 2, -60.0).before(3).get(Fact::Hours2), 11);
        assert_eq!(Context::new(7, 2, 0.0).before(3).get(Fact::HorizonSpent), 0x302);
        assert_ne!(digest(&[1, 2, 3, 4]), digest(&[2, 1, 3, 4]));
        assert_eq!(minute(-5.0), 0);
    }
}
