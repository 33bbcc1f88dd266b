//! When: how long people stay in a place, and where they are a time later.
//!
//! Five forecasts of P(place at now + t), mixed by fixed share with weights of their own at each of [`ANCHORS_S`] (between these,
//! interpolated over the logarithm of the time):
//!
//! | expert | what it knows |
//! | --- | --- |
//! | shipped | what the forecast says without this home ([`crate::forecast`]) |
//! | persistence | the share of times that the person was still, or again, in the same place |
//! | semi-Markov | the hazard of leaving a place by time spent there and part of the day, and where exits led |
//! | later, by place | where the person was that much later |
//! | later | the same by hour and time spent there as well |
//!
//! Of whoever has come back and was seen in no room yet, the semi-Markov forecast alone knows something: it begins where earlier
//! returns led to, at the time of this one. It counts against the shipped forecast by how many returns were seen.
//!
//! Hazards are exits over time spent, each level with the next wider one as its prior: place and part of the day over place over all
//! places over the shipped stay; of a time out of the house, over the shipped absence, since rooms say nothing of how long it lasts. What happened is known only a horizon later, and is learned then.

use super::counts::Counts;
use super::frame::{ELSEWHERE, Frame};
use super::key::{Kind, NONE, key};
use super::mixture::FixedShare;
use super::moment;
use super::sets::{AdaptiveSets, Issued, SetOptions};
use super::visits::PART_HOURS;
use super::whose::Whose;

/// Horizons at which is learned how good each forecast is, in seconds.
pub(crate) const ANCHORS_S: [f64; 4] = [60.0, 300.0, 900.0, 3_600.0];
pub(crate) const EXPERTS: usize = 5;
pub(crate) const PRIOR: [f64; EXPERTS] = [0.3, 0.25, 0.15, 0.15, 0.15];
pub(crate) const SHARE: f64 = 0.0005;
/// Samples as close together as the horizon say much the same; they count as if they came this often.
const RATE_S: f64 = 60.0;
/// A forecast is kept until its label comes at most this often.
const SAMPLE_S: f64 = 60.0;
/// Farther ahead than this the semi-Markov forecast no longer changes.
const FARTHEST_S: f64 = 4.0 * 3_600.0;
/// A longer silence of the whole system is no stay.
const GAP_S: f64 = 36.0 * 3_600.0;
/// Upper ends of the times spent that are told apart, in seconds.
const DWELLS_S: [f64; 12] =
    [15.0, 30.0, 60.0, 120.0, 240.0, 480.0, 960.0, 1_920.0, 3_840.0, 7_680.0, 15_360.0, 30_720.0];
const DWELLS: usize = DWELLS_S.len() + 1;
/// Steps of the semi-Markov forecast in seconds, and until how far ahead; and beyond.
const STEPS_S: [(f64, f64); 4] = [(7.5, 60.0), (20.0, 300.0), (50.0, 900.0), (90.0, 3_600.0)];
const STEP_S: (f64, f64) = (180.0, f64::INFINITY);
/// Symbols of the counts of stays.
const EXITS: u16 = 0;
const MINUTES: u16 = 1;
/// How many exits the wider level is worth.
const HAZARD_STRENGTH: f64 = 2.0;
/// How many samples the wider level is worth in what is counted directly.
const LATER_STRENGTH: [f64; 3] = [8.0, 40.0, 40.0];
/// Experts whose forecasts at the anchors are read from counts, and how many they are.
const COUNTED_EXPERTS: [usize; COUNTED] = [1, 3, 4];
const COUNTED: usize = 3;
/// Samples that a horizon begins with, of which half stayed.
const SAMPLED: f64 = 2.0;
/// The least probability that weights are learned from: one surprise is not to silence whoever was sure for long. The mixture's bound is that of
/// forecasts with this least.
const FLOOR: f64 = 1e-3;
/// Whoever came back and is first seen in a room within this time has come into it, in seconds; later they may have been in others before.
const ARRIVAL_S: f64 = 600.0;
/// How many returns that were seen the shipped forecast is worth, of somebody who is back: it says where they are in the long run, as in bed.
const BACK_STRENGTH: f64 = 1.0;
/// Mean stay that the shipped forecast begins with, in seconds, and the exponent of its survival.
const SHIPPED_STAY_S: f64 = 120.0;
/// The same of a time out of the house.
const SHIPPED_AWAY_S: f64 = 14_400.0;

fn dwell(spent_s: f64) -> usize {
    DWELLS_S.iter().position(|end_s| spent_s < *end_s).unwrap_or(DWELLS - 1)
}

fn dwell_begin_s(bucket: usize) -> f64 {
    bucket.checked_sub(1).map_or(0.0, |before| DWELLS_S[before])
}

/// A forecast that waits for its label.
#[derive(Debug, Clone, Copy, Default)]
struct Waiting {
    at_s: f64,
    entered_s: f64,
    place: u16,
    issued: Issued,
    /// Whether the experts said something, or only the counts learn.
    forecast: bool,
}

/// One horizon.
#[derive(Debug, Clone)]
pub(crate) struct Anchor {
    pub(crate) mixture: FixedShare<EXPERTS>,
    pub(crate) stayed: f64,
    pub(crate) sampled: f64,
    pub(crate) sets: AdaptiveSets,
    waiting: Vec<Waiting>,
    /// Of each waiting forecast, the experts' probabilities and the mixture's, row by row.
    probabilities: Vec<f64>,
    first: usize,
    count: usize,
}

/// How long one person stays, and where they were.
#[derive(Debug, Clone)]
pub(crate) struct Stays {
    pub(crate) place: u16,
    pub(crate) entered_s: f64,
    /// Whether they came back then, into a room that nobody knows.
    is_back: bool,
    /// The places before, the latest first.
    pub(crate) before: [u16; 2],
    updated_s: f64,
    sampled_s: f64,
    pub(crate) anchors: [Anchor; ANCHORS_S.len()],
    scratch: Scratch,
}

#[derive(Debug, Clone, Default)]
struct Scratch {
    rows: Vec<f64>,
    mass: Vec<f64>,
    hazard: Vec<f64>,
    lead: Vec<f64>,
    leaving: Vec<f64>,
    /// Per place and time spent, the share that leaves in a step.
    leave: Vec<f64>,
    semi: Vec<f64>,
    /// Per anchor what the counted experts say, row by row.
    anchored: Vec<f64>,
}

impl Stays {
    pub(crate) fn new(sets: SetOptions) -> Self {
        Self {
            place: NONE,
            entered_s: 0.0,
            is_back: false,
            before: [NONE; 2],
            updated_s: 0.0,
            sampled_s: f64::NEG_INFINITY,
            anchors: ANCHORS_S.map(|horizon_s| {
                let slots = (horizon_s / SAMPLE_S) as usize + 2;
                Anchor {
                    mixture: FixedShare::new(PRIOR),
                    stayed: 1.0,
                    sampled: SAMPLED,
                    sets: AdaptiveSets::new(sets),
                    waiting: vec![Waiting::default(); slots],
                    probabilities: Vec::new(),
                    first: 0,
                    count: 0,
                }
            }),
            scratch: Scratch::default(),
        }
    }

    /// For about how many minutes it was known where they were.
    pub(crate) fn watched_min(&self) -> f64 {
        self.anchors[0].sampled - SAMPLED
    }

    /// Another map: waiting forecasts say nothing of its rooms.
    pub(crate) fn forget_forecasts(&mut self) {
        for anchor in &mut self.anchors {
            anchor.count = 0;
            anchor.probabilities.clear();
        }
    }

    /// A number stands for another place from now on.
    pub(crate) fn forget_number(&mut self, number: u16) {
        for place in self.before.iter_mut().chain([&mut self.place]) {
            if *place == number {
                *place = NONE;
            }
        }
        self.forget_forecasts();
    }

    /// The clock was set on by so many seconds, or back.
    pub(crate) fn shift_clock(&mut self, by_s: f64) {
        for time_s in [&mut self.entered_s, &mut self.updated_s, &mut self.sampled_s] {
            *time_s += by_s;
        }
        for waiting in self.anchors.iter_mut().flat_map(|anchor| &mut anchor.waiting) {
            waiting.at_s += by_s;
            waiting.entered_s += by_s;
        }
    }

    /// Counts the time spent until now.
    fn advance(&mut self, counts: &mut Counts, slot: u8, now_s: f64, learn: bool) {
        let from_s = self.updated_s;
        self.updated_s = from_s.max(now_s);
        if self.place == NONE || !learn || now_s <= from_s || now_s - from_s > GAP_S {
            return;
        }
        let mut at_s = from_s;
        while at_s < now_s {
            let spent_s = at_s - self.entered_s;
            let bucket = dwell(spent_s);
            let older_s = DWELLS_S.get(bucket).map_or(f64::INFINITY, |end_s| self.entered_s + end_s);
            let hour_s = ((at_s / 3_600.0).floor() + 1.0) * 3_600.0;
            // A step of at least a millisecond: rounding may not keep it from ending.
            let until_s = now_s.min(older_s).min(hour_s).max(at_s + 1e-3);
            self.add_stay(counts, slot, bucket, at_s, MINUTES, (until_s - at_s) / 60.0);
            at_s = until_s;
        }
    }

    fn add_stay(&self, counts: &mut Counts, slot: u8, bucket: usize, at_s: f64, symbol: u16, weight: f64) {
        let (bucket, now_min) = (bucket as u16, moment::minute(at_s));
        let part = moment::part_of_day(at_s, PART_HOURS);
        let levels = [
            (Kind::Stay, [NONE, bucket, NONE]),
            (Kind::StayPlace, [self.place, bucket, NONE]),
            (Kind::StayPlaceHour, [self.place, bucket, part]),
        ];
        // A time out of the house says nothing of how long stays in rooms last.
        for (kind, after) in levels.into_iter().skip(usize::from(self.place == ELSEWHERE)) {
            counts.add(key(kind, slot, after), symbol, weight, now_min);
        }
    }

    /// The person is in the place `number` at `now_s`, or nobody knows where.
    pub(crate) fn be(&mut self, counts: &mut Counts, slot: u8, number: u16, now_s: f64, learn: bool) {
        let now_s = now_s.max(self.updated_s);
        self.advance(counts, slot, now_s, learn);
        let was_back = std::mem::take(&mut self.is_back);
        if number == self.place {
            return;
        }
        if self.place != NONE && learn {
            self.add_stay(counts, slot, dwell(now_s - self.entered_s), now_s, EXITS, 1.0);
        }
        let has_arrived = was_back && number != ELSEWHERE && now_s - self.entered_s <= ARRIVAL_S;
        let from = if has_arrived { ELSEWHERE } else { self.place };
        if from != NONE && number != NONE && learn {
            let (now_min, part) = (moment::minute(now_s), moment::part_of_day(now_s, PART_HOURS));
            counts.add(key(Kind::Exit, slot, [from, NONE, NONE]), number, 1.0, now_min);
            counts.add(key(Kind::ExitHour, slot, [from, part, NONE]), number, 1.0, now_min);
        }
        self.before = [std::mem::replace(&mut self.place, number), self.before[0]];
        self.entered_s = now_s;
        self.updated_s = now_s;
    }

    /// Whoever was out is in the house at `now_s`, and nobody knows in which room.
    pub(crate) fn come_back(&mut self, counts: &mut Counts, slot: u8, now_s: f64, learn: bool) {
        if self.place == ELSEWHERE {
            self.be(counts, slot, NONE, now_s, learn);
            self.is_back = true;
        }
    }

    /// Whether the person came back, and was seen in no room since.
    pub(crate) fn is_back(&self) -> bool {
        self.is_back
    }

    /// Whether another sample is due.
    pub(crate) fn due(&self, now_s: f64) -> bool {
        now_s - self.sampled_s >= SAMPLE_S
    }

    /// Counts the time spent until now, and learns from the forecasts whose time has come.
    pub(crate) fn learn_due(&mut self, counts: &mut Counts, slot: u8, frame: &Frame, now_s: f64, learn: bool) {
        self.advance(counts, slot, now_s, learn);
        let places = frame.places();
        for (index, (anchor, horizon_s)) in self.anchors.iter_mut().zip(ANCHORS_S).enumerate() {
            let slots = anchor.waiting.len();
            while anchor.count > 0 {
                let at = anchor.first;
                let Waiting { at_s, entered_s, place, issued, forecast } = anchor.waiting[at];
                let due_s = at_s + horizon_s;
                if due_s > now_s {
                    break;
                }
                anchor.first = (at + 1) % slots;
                anchor.count -= 1;
                let truth = if due_s >= self.entered_s { self.place } else { self.before[0] };
                // What was not watched is not known.
                if truth == NONE || place == NONE || !learn || now_s - due_s > 2.0 * SAMPLE_S {
                    continue;
                }
                anchor.sampled += 1.0;
                anchor.stayed += f64::from(u8::from(truth == place));
                let spent = dwell(at_s - entered_s) as u16;
                let horizon = index as u16;
                let now_min = moment::minute(at_s);
                let part = moment::part_of_day(at_s, 3);
                for (kind, after) in [
                    (Kind::Later, [place, horizon, NONE]),
                    (Kind::LaterHour, [place, horizon, part]),
                    (Kind::LaterDwell, [place, horizon << 8 | spent, moment::part_of_day(at_s, 2)]),
                ] {
                    counts.add(key(kind, slot, after), truth, 1.0, now_min);
                }
                let Some(truth) = frame.place(truth).filter(|_| forecast) else { continue };
                let row = |row: usize| &anchor.probabilities[(at * (EXPERTS + 1) + row) * places..][..places];
                let given: [f64; EXPERTS] = std::array::from_fn(|expert| row(expert)[truth].max(FLOOR));
                anchor.mixture.learn(&given, &PRIOR, SHARE, (RATE_S / horizon_s).min(1.0));
                let mixed = &anchor.probabilities[(at * (EXPERTS + 1) + EXPERTS) * places..][..places];
                anchor.sets.learn(mixed, issued, truth);
            }
        }
    }

    /// Takes a sample: what is forecast now is learned from later. `shipped` writes what the forecast says without this home.
    pub(crate) fn sample(
        &mut self,
        whose: Whose<'_>,
        frame: &Frame,
        now_s: f64,
        next_rooms: &[f64],
        shipped: &mut dyn FnMut(f64, &mut [f64]),
    ) {
        self.sampled_s = now_s;
        let places = frame.places();
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.semi.clear();
        scratch.semi.resize(ANCHORS_S.len() * places, 0.0);
        // What is forecast of whoever is in no known place is not learned from.
        let forecast = !self.is_back && self.semi_markov(whose, frame, now_s, next_rooms, &ANCHORS_S, &mut scratch);
        for (index, horizon_s) in ANCHORS_S.into_iter().enumerate() {
            let rows = (EXPERTS + 1) * places;
            scratch.rows.clear();
            scratch.rows.resize(rows, 0.0);
            if forecast {
                let (own, rest) = scratch.rows.split_at_mut(places);
                shipped(horizon_s, own);
                normalise(own);
                rest[places..2 * places].copy_from_slice(&scratch.semi[index * places..(index + 1) * places]);
                self.persistence(index, frame, &mut rest[..places]);
                let (persistence, rest) = rest.split_at_mut(places);
                let (by_place, rest) = rest[places..].split_at_mut(places);
                self.later(whose, frame, index, now_s, persistence, by_place, &mut rest[..places]);
                let weights = *self.anchors[index].mixture.weights();
                mix(&weights, &mut scratch.rows, places);
            }
            let (place, entered_s) = (self.place, self.entered_s);
            let anchor = &mut self.anchors[index];
            let slots = anchor.waiting.len();
            if anchor.probabilities.len() != slots * rows {
                anchor.probabilities.clear();
                anchor.probabilities.resize(slots * rows, 0.0);
                anchor.count = 0;
            }
            if anchor.count == slots {
                anchor.first = (anchor.first + 1) % slots;
                anchor.count -= 1;
            }
            let at = (anchor.first + anchor.count) % slots;
            let issued = anchor.sets.issue();
            anchor.waiting[at] = Waiting { at_s: now_s, entered_s, place, issued, forecast };
            anchor.probabilities[at * rows..(at + 1) * rows].copy_from_slice(&scratch.rows);
            anchor.count += 1;
        }
        self.scratch = scratch;
    }

    /// Per place the probability that the person is there at `now_s` and each horizon (ascending) after it, row by row; `shipped` is what the
    /// forecast says without this home, row by row. Gives `given` the weights of the experts for each.
    #[expect(clippy::too_many_arguments, reason = "what is read and what is written have nothing in common")]
    pub(crate) fn at(
        &mut self,
        whose: Whose<'_>,
        frame: &Frame,
        (now_s, horizons_s): (f64, &[f64]),
        next_rooms: &[f64],
        shipped: &[f64],
        out: &mut Vec<f64>,
        mut given: impl FnMut([f64; EXPERTS]),
    ) {
        let places = frame.places();
        let cells = horizons_s.len() * places;
        out.clear();
        out.extend_from_slice(&shipped[..cells.min(shipped.len())]);
        out.resize(cells, 0.0);
        out.chunks_exact_mut(places).for_each(normalise);
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.semi.clear();
        scratch.semi.resize(cells, 0.0);
        let known = self.semi_markov(whose, frame, now_s, next_rooms, horizons_s, &mut scratch);
        scratch.anchored.clear();
        scratch.anchored.resize(ANCHORS_S.len() * COUNTED * places, 0.0);
        let returns = if self.is_back { whose.own(Kind::Exit, [ELSEWHERE, NONE, NONE]) } else { None };
        let returns: f64 = returns.map_or(0.0, |seen| seen.symbols().map(|(_, count)| count).sum());
        let is_back = known && self.is_back;
        let known = known && !self.is_back;
        let needed = |index: usize| horizons_s.iter().any(|horizon_s| between(*horizon_s).uses(index));
        for (index, rows) in scratch.anchored.chunks_exact_mut(COUNTED * places).enumerate() {
            if known && needed(index) {
                self.counted(whose, frame, index, now_s, rows);
            }
        }
        for (index, (horizon_s, out)) in horizons_s.iter().zip(out.chunks_exact_mut(places)).enumerate() {
            given(if known {
                self.mixed_at(frame, *horizon_s, index, out, &mut scratch)
            } else if is_back {
                let semi = &scratch.semi[index * places..(index + 1) * places];
                let seen = returns / (returns + BACK_STRENGTH);
                out.iter_mut().zip(semi).for_each(|(p, semi)| *p = (1.0 - seen) * *p + seen * semi);
                [1.0 - seen, 0.0, seen, 0.0, 0.0]
            } else {
                [1.0, 0.0, 0.0, 0.0, 0.0]
            });
        }
        self.scratch = scratch;
    }

    /// One row of [`Stays::at`], whose semi-Markov forecast is the row `index` of the scratch.
    fn mixed_at(
        &self,
        frame: &Frame,
        horizon_s: f64,
        index: usize,
        out: &mut [f64],
        scratch: &mut Scratch,
    ) -> [f64; EXPERTS] {
        let places = out.len();
        let Scratch { rows, semi, anchored, .. } = scratch;
        // Between two anchors, by the logarithm of the time; before the first one towards certainty of the present place.
        let Between { lower, upper, share } = between(horizon_s);
        rows.clear();
        rows.resize((EXPERTS + 1) * places, 0.0);
        rows[..places].copy_from_slice(out);
        rows[2 * places..3 * places].copy_from_slice(&semi[index * places..(index + 1) * places]);
        let mut weights = [0.0; EXPERTS];
        for (index, part) in [(lower, 1.0 - share), (Some(upper), share)] {
            match index {
                Some(index) => {
                    let counted = &anchored[index * COUNTED * places..(index + 1) * COUNTED * places];
                    for (expert, row) in COUNTED_EXPERTS.into_iter().zip(counted.chunks_exact(places)) {
                        let sums = &mut rows[expert * places..(expert + 1) * places];
                        sums.iter_mut().zip(row).for_each(|(sum, p)| *sum += part * p);
                    }
                }
                // At once everybody is where they are.
                None => {
                    if let Some(here) = frame.place(self.place) {
                        COUNTED_EXPERTS.into_iter().for_each(|expert| rows[expert * places + here] += part);
                    }
                }
            }
            let of = self.anchors[index.unwrap_or(upper)].mixture.weights();
            weights.iter_mut().zip(of).for_each(|(sum, weight)| *sum += part * weight);
        }
        mix(&weights, rows, places);
        out.copy_from_slice(&rows[EXPERTS * places..]);
        weights
    }

    /// What [`COUNTED_EXPERTS`] say at an anchor, row by row.
    fn counted(&self, whose: Whose<'_>, frame: &Frame, index: usize, now_s: f64, rows: &mut [f64]) {
        let places = rows.len() / COUNTED;
        let (persistence, rest) = rows.split_at_mut(places);
        let (by_place, later) = rest.split_at_mut(places);
        self.persistence(index, frame, persistence);
        self.later(whose, frame, index, now_s, persistence, by_place, later);
    }

    /// The places of a set with the promised coverage, `horizon_s` ahead, for probabilities that [`Stays::at`] gave. Where these are of
    /// `another` kind, or little was learned yet, the fewest places that have that much of them.
    pub(crate) fn set(&self, horizon_s: f64, probabilities: &[f64], another: bool, set: &mut Vec<bool>) {
        let Between { lower, upper, share } = between(horizon_s);
        let index = if share < 0.5 { lower.unwrap_or(upper) } else { upper };
        let sets = &self.anchors[index].sets;
        if another || sets.knows_little() {
            sets.cover(probabilities, set);
        } else {
            sets.set(probabilities, sets.issue(), set);
        }
    }

    fn persistence(&self, index: usize, frame: &Frame, p: &mut [f64]) {
        let anchor = &self.anchors[index];
        let places = p.len();
        let Some(here) = frame.place(self.place) else {
            p.fill(1.0 / places as f64);
            return;
        };
        // Being out is another kind of stay: rooms say nothing of how long it lasts.
        let stay = match self.place {
            ELSEWHERE => (SHIPPED_AWAY_S / (SHIPPED_AWAY_S + ANCHORS_S[index])).powi(2),
            _ => anchor.stayed / anchor.sampled,
        };
        p.fill((1.0 - stay) / (places - 1).max(1) as f64);
        p[here] = if places > 1 { stay } else { 1.0 };
    }

    /// What was counted directly, over `persistence`: by place alone, and by hour and time spent as well.
    #[expect(
        clippy::too_many_arguments,
        reason = "two rows are written, and what they are read from has nothing in common"
    )]
    fn later(
        &self,
        whose: Whose<'_>,
        frame: &Frame,
        index: usize,
        now_s: f64,
        persistence: &[f64],
        by_place: &mut [f64],
        p: &mut [f64],
    ) {
        p.copy_from_slice(persistence);
        let spent = dwell(now_s - self.entered_s) as u16;
        let horizon = index as u16;
        let contexts = [
            (Kind::Later, [self.place, horizon, NONE]),
            (Kind::LaterHour, [self.place, horizon, moment::part_of_day(now_s, 3)]),
            (Kind::LaterDwell, [self.place, horizon << 8 | spent, moment::part_of_day(now_s, 2)]),
        ];
        for ((kind, after), strength) in contexts.into_iter().zip(LATER_STRENGTH) {
            whose.smooth(kind, after, 0.0, strength, |number| frame.place(number), p);
            if kind == Kind::Later {
                by_place.copy_from_slice(p);
            }
        }
    }

    /// Per place and time spent there the hazard of leaving it per second at this part of the day, for the times spent that are `wanted`.
    fn hazards(whose: Whose<'_>, frame: &Frame, part: u16, wanted: impl Fn(usize, usize) -> bool, hazard: &mut [f64]) {
        let level = |kind: Kind, after: [u16; 3], rate: f64| {
            let seen = whose.of_others(kind, after).chain(whose.own(kind, after));
            seen.fold(rate, |rate, seen| {
                let (exits, spent_s) = (seen.count(EXITS), 60.0 * seen.count(MINUTES));
                (exits + HAZARD_STRENGTH) / (spent_s + HAZARD_STRENGTH / rate)
            })
        };
        for bucket in (0..DWELLS).filter(|bucket| (0..frame.places()).any(|place| wanted(place, *bucket))) {
            let middle_s = match DWELLS_S.get(bucket) {
                Some(end_s) => 0.5 * (dwell_begin_s(bucket) + end_s),
                None => 1.5 * dwell_begin_s(bucket),
            };
            let shipped = |stay_s: f64| 2.0 / (stay_s + middle_s);
            let spent = bucket as u16;
            let of_all_rooms = level(Kind::Stay, [NONE, spent, NONE], shipped(SHIPPED_STAY_S));
            for place in (0..frame.places()).filter(|place| wanted(*place, bucket)) {
                let number = frame.place_number(place).unwrap_or(NONE);
                let wider = if number == ELSEWHERE { shipped(SHIPPED_AWAY_S) } else { of_all_rooms };
                let of_place = level(Kind::StayPlace, [number, spent, NONE], wider);
                hazard[place * DWELLS + bucket] = level(Kind::StayPlaceHour, [number, spent, part], of_place);
            }
        }
    }

    /// Per horizon (ascending) and place, row by row, into `scratch.semi`. Says whether anything is known of where the person is, or has come from.
    fn semi_markov(
        &self,
        whose: Whose<'_>,
        frame: &Frame,
        now_s: f64,
        next_rooms: &[f64],
        horizons_s: &[f64],
        scratch: &mut Scratch,
    ) -> bool {
        let here = frame.place(self.place);
        if here.is_none() && !self.is_back {
            return false;
        }
        let places = frame.places();
        let Scratch { mass, hazard, lead, leaving, leave, semi, .. } = scratch;
        let part = moment::part_of_day(now_s, PART_HOURS);
        let spent_s = now_s - self.entered_s;
        // Of whoever came back the way since then is followed.
        let since_s = if self.is_back { spent_s.clamp(0.0, FARTHEST_S) } else { 0.0 };
        let ahead = |horizon_s: f64| (since_s + horizon_s).clamp(0.0, FARTHEST_S);
        let farthest_s = horizons_s.last().map_or(0.0, |horizon_s| ahead(*horizon_s));
        hazard.clear();
        hazard.resize(places * DWELLS, 0.0);
        // Nobody comes anywhere before now; this stay is older.
        let (newest, oldest) = (dwell(farthest_s), dwell(spent_s + farthest_s));
        let ages =
            |place, bucket| bucket <= newest || Some(place) == here && bucket >= dwell(spent_s) && bucket <= oldest;
        Self::hazards(whose, frame, part, ages, hazard);
        lead.clear();
        for place in 0..places {
            let number = frame.place_number(place).unwrap_or(NONE);
            let begin = lead.len();
            // Where this stay leads to the mixture knows better than even chances; it knows nothing of leaving the house.
            let others = (places - 1).max(1) as f64;
            lead.extend((0..places).map(|_| 1.0 / others));
            let row = &mut lead[begin..];
            if Some(place) == here && next_rooms.len() + 1 == places {
                let known: f64 = next_rooms.iter().enumerate().filter(|(room, _)| *room != place).map(|(_, p)| p).sum();
                if known > 0.0 {
                    let elsewhere = frame.elsewhere();
                    let kept = if place == elsewhere { 1.0 } else { 1.0 - row[elsewhere] };
                    row.iter_mut().zip(next_rooms).for_each(|(p, next)| *p = kept * next / known);
                }
            }
            row[place] = 0.0;
            normalise(row);
            let index = |number| frame.place(number).filter(|other| *other != place);
            whose.smooth(Kind::Exit, [number, NONE, NONE], 0.25, 2.0, index, row);
            whose.smooth(Kind::ExitHour, [number, part, NONE], 0.25, 4.0, index, row);
        }
        if places == 1 {
            semi.fill(1.0);
            return true;
        }

        mass.clear();
        mass.resize(places * DWELLS, 0.0);
        leave.clear();
        leave.resize(places * DWELLS, 0.0);
        leaving.clear();
        leaving.resize(places, 0.0);
        let mut older = [0.0; DWELLS];
        let elsewhere = frame.elsewhere();
        let (mut original, mut spent_s, mut ahead_s) = (1.0, spent_s, 0.0);
        if self.is_back {
            original = 0.0;
            let led = &lead[elsewhere * places..(elsewhere + 1) * places];
            mass.chunks_exact_mut(DWELLS).zip(led).for_each(|(mass, led)| mass[0] = *led);
        }
        let rows =
            horizons_s.iter().zip(semi.chunks_exact_mut(places)).map(|(horizon, row)| (ahead(*horizon), Some(row)));
        for (horizon_s, row) in self.is_back.then_some((since_s, None)).into_iter().chain(rows) {
            while ahead_s < horizon_s {
                // Equal steps up to the next horizon, or to the time from which longer ones do.
                let (wanted_s, until_s) = STEPS_S.into_iter().find(|(_, until_s)| ahead_s < *until_s).unwrap_or(STEP_S);
                let span_s = horizon_s.min(until_s) - ahead_s;
                let steps = (span_s / wanted_s).ceil().max(1.0);
                let (step_s, until_s) = (span_s / steps, ahead_s + span_s);
                // Whoever comes is there no longer than since now: stays of greater age are not looked at.
                let ages = dwell(until_s) + 1;
                for (age, older) in older.iter_mut().take(ages).enumerate() {
                    let end_s = DWELLS_S.get(age).filter(|_| age + 1 < ages);
                    *older = end_s.map_or(0.0, |end_s| gone(step_s / (end_s - dwell_begin_s(age))));
                }
                for (leave, rate) in leave.chunks_exact_mut(DWELLS).zip(hazard.chunks_exact(DWELLS)) {
                    leave.iter_mut().zip(rate).take(ages).for_each(|(leave, rate)| *leave = gone(step_s * rate));
                }
                for _ in 0..steps as usize {
                    leaving.fill(0.0);
                    if let Some(here) = here {
                        let left = original * leave_of(hazard, here, spent_s, step_s);
                        original -= left;
                        leaving[here] = left;
                    }
                    let of_places = mass.chunks_exact_mut(DWELLS).zip(leave.chunks_exact(DWELLS));
                    for ((mass, leave), leaving) in of_places.zip(leaving.iter_mut()) {
                        let (mut aged, mut left) = (0.0, 0.0);
                        for ((mass, leave), older) in mass.iter_mut().zip(leave).zip(&older).take(ages) {
                            let gone = *mass * leave;
                            let grown = (*mass - gone) * older;
                            *mass += aged - gone - grown;
                            (aged, left) = (grown, left + gone);
                        }
                        *leaving += left;
                    }
                    for (left, lead) in leaving.iter().zip(lead.chunks_exact(places)) {
                        for (mass, lead) in mass.chunks_exact_mut(DWELLS).zip(lead) {
                            mass[0] += left * lead;
                        }
                    }
                    spent_s += step_s;
                }
                ahead_s = until_s;
            }
            let Some(row) = row else {
                // Until now nobody said that they left again.
                mass[elsewhere * DWELLS..].fill(0.0);
                normalise(mass);
                continue;
            };
            for (p, mass) in row.iter_mut().zip(mass.chunks_exact(DWELLS)) {
                *p = mass.iter().sum();
            }
            if let Some(here) = here {
                row[here] += original;
            }
            normalise(row);
        }
        true
    }

    /// Whether the person is known to be elsewhere.
    pub(crate) fn elsewhere(&self) -> bool {
        self.place == ELSEWHERE
    }
}

/// The share that is gone after a time at a rate: `1 - exp(-x)`, to three digits up to one, without its cost.
fn gone(x: f64) -> f64 {
    if x < 1.0 { x / (1.0 + x * (0.5 + x / 12.0)) } else { 1.0 - (-x).exp() }
}

/// The share that leaves `here` in a step, after so long.
fn leave_of(hazard: &[f64], here: usize, spent_s: f64, step_s: f64) -> f64 {
    gone(step_s * hazard[here * DWELLS + dwell(spent_s)])
}

/// The anchors below and above a horizon, and the share of the latter.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Between {
    lower: Option<usize>,
    upper: usize,
    share: f64,
}

impl Between {
    fn uses(self, index: usize) -> bool {
        self.upper == index || self.lower == Some(index)
    }
}

fn between(horizon_s: f64) -> Between {
    let last = ANCHORS_S.len() - 1;
    let Some(upper) = ANCHORS_S.iter().position(|anchor_s| horizon_s <= *anchor_s) else {
        return Between { lower: Some(last), upper: last, share: 1.0 };
    };
    match upper.checked_sub(1) {
        None => Between { lower: None, upper: 0, share: (horizon_s / ANCHORS_S[0]).clamp(0.0, 1.0) },
        Some(lower) => {
            let share = (horizon_s / ANCHORS_S[lower]).ln() / (ANCHORS_S[upper] / ANCHORS_S[lower]).ln();
            Between { lower: Some(lower), upper, share }
        }
    }
}

/// The mixture of the first rows into the last one.
fn mix(weights: &[f64; EXPERTS], rows: &mut [f64], places: usize) {
    let (experts, mixed) = rows.split_at_mut(EXPERTS * places);
    mixed.fill(0.0);
    for (row, weight) in experts.chunks_exact(places).zip(weights) {
        mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p);
    }
    normalise(mixed);
}

fn normalise(p: &mut [f64]) {
    let total: f64 = p.iter().sum();
    if total > 0.0 {
        p.iter_mut().for_each(|p| *p /= total);
    } else {
        let even = 1.0 / p.len().max(1) as f64;
        p.fill(even);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_gone_after_a_time_is_known_to_three_digits() {
        for x in [0.0, 0.01, 0.3, 0.7, 0.999, 1.0, 3.0, 50.0] {
            assert!((gone(x) - (1.0 - (-x).exp())).abs() < 1e-3, "{x}");
        }
    }

    #[test]
    fn times_between_the_anchors_are_interpolated() {
        assert_eq!(between(0.0), Between { lower: None, upper: 0, share: 0.0 });
        assert_eq!(between(60.0), Between { lower: None, upper: 0, share: 1.0 });
        assert_eq!(between(1e9), Between { lower: Some(3), upper: 3, share: 1.0 });
        let Between { lower, upper, share } = between(150.0);
        assert_eq!((lower, upper), (Some(0), 1));
        assert!((0.5..0.6).contains(&share));
    }
}
