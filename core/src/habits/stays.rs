//! The length of stays, and the place a time later.
//!
//! The forecasts of P(place at now + t) are mixed by fixed share, with separate weights at each of [`ANCHORS_S`]. Between the anchors they are
//! interpolated over the logarithm of the time.
//!
//! | expert | source |
//! | --- | --- |
//! | shipped | the forecast without habits ([`crate::forecast`]) |
//! | by place | the places that much later in the past, by place, over the share of unchanged places |
//! | leaving | the rate of leaving a place by the time spent there and the part of the day, and where exits led ([`super::leaving`]) |
//! | later | as by place, by hour and by time spent as well |
//!
//! Outcomes are learned a horizon later. If a person came back and has no known room yet, only leaving has data. Its weight against the shipped
//! forecast grows with the number of observed returns.

use std::collections::VecDeque;

use super::context::{CLASSES_S, Context, minute, time_class};
use super::counts::Counts;
use super::leaving::{EXIT, EXITS, Leaving, MINUTES, SHIPPED_AWAY_S, Stay, stay_parts};
use super::names::{ELSEWHERE, Home};
use super::parts::{NONE, Part, Without};
use super::pool::{Begin, Plan, Pool, Source, expert};
use super::sets::{AdaptiveSets, SetOptions};
use super::view::{Level, View, level, normalise};

/// Horizons at which the weights are learned, in seconds.
pub(crate) const ANCHORS_S: [f64; 4] = [60.0, 300.0, 900.0, 3_600.0];
pub(crate) const EXPERTS: usize = 4;
const SHARE: f64 = 0.0005;
const SHIPPED: usize = 0;
const LEAVING: usize = 1;
const BY_PLACE: usize = 2;
const LATER: usize = 3;
const PLAN: Plan = Plan {
    experts: &[
        expert(None, [0.4, 0.0], Source::Model, Begin::Given, &[]),
        expert(Some(Part::Leaving), [0.2, 0.0], Source::Habit, Begin::Given, &[]),
        expert(Some(Part::ByPlace), [0.2, 0.0], Source::Habit, Begin::Given, &[level(Part::LaterByPlace, 0.0, 8.0)]),
        expert(
            Some(Part::Later),
            [0.2, 0.0],
            Source::Hour,
            Begin::After(BY_PLACE, 1),
            &[level(Part::LaterByHour, 0.0, 40.0), level(Part::LaterByDwell, 0.0, 40.0)],
        ),
    ],
    product: None,
    even: 0.0,
};
/// First weight of the forecast without habits.
const FIRST: f64 = 0.4;
/// Least time between forecasts that are kept for learning. Outcomes that are closer together than their horizon are alike: they count as if they
/// came once a horizon.
const SAMPLE_S: f64 = 60.0;
/// After a longer silence of the whole system the time is not counted as a stay.
const GAP_S: f64 = 36.0 * 3_600.0;
/// Samples at the start of a horizon; half of them stayed.
const SAMPLED: f64 = 2.0;
/// Least probability for learning weights: one surprise must not silence an expert that was right for long. The mixture's bound holds for forecasts
/// with this least probability.
const FLOOR: f64 = 1e-3;
/// If a person who came back has a known room within this time, in seconds, the return led into that room.
const ARRIVAL_S: f64 = 600.0;
/// Returns that the shipped forecast, a long-run average, is worth after a return.
const BACK_STRENGTH: f64 = 1.0;

/// A forecast that waits for its outcome.
#[derive(Debug, Clone)]
struct Waiting {
    at_s: f64,
    entered_s: f64,
    place: u16,
    /// Of the set.
    threshold: f64,
    /// The probabilities of experts and mixture, row by row; empty if only the counts learn.
    rows: Vec<f64>,
}

/// One horizon.
#[derive(Debug, Clone)]
pub(crate) struct Anchor {
    /// The weights, and the rows of by place and later in the latest forecast.
    pub(crate) pool: Pool,
    /// Samples in which the person was in the same place, and all samples.
    pub(crate) stayed: [f64; 2],
    pub(crate) sets: AdaptiveSets,
    waiting: VecDeque<Waiting>,
}

#[derive(Debug, Clone)]
pub(crate) struct Stays {
    pub(crate) place: u16,
    pub(crate) entered_s: f64,
    /// Whether the person came back at `entered_s`, into an unknown room.
    pub(crate) is_back: bool,
    /// The place before.
    before: u16,
    updated_s: f64,
    sampled_s: f64,
    pub(crate) anchors: [Anchor; ANCHORS_S.len()],
    scratch: Scratch,
}

#[derive(Debug, Clone, Default)]
struct Scratch {
    /// The experts' probabilities and the mixture's, row by row.
    rows: Vec<f64>,
    /// Per horizon the row of leaving.
    ahead: Vec<f64>,
    leaving: Leaving,
}

impl Stays {
    pub(crate) fn new(sets: SetOptions, without: Without) -> Self {
        let anchor = || Anchor {
            pool: Pool::new(&PLAN, FIRST, without),
            stayed: [0.5 * SAMPLED, SAMPLED],
            sets: AdaptiveSets::new(sets),
            waiting: VecDeque::new(),
        };
        Self {
            place: NONE,
            entered_s: 0.0,
            is_back: false,
            before: NONE,
            updated_s: 0.0,
            sampled_s: f64::NEG_INFINITY,
            anchors: std::array::from_fn(|_| anchor()),
            scratch: Scratch::default(),
        }
    }

    /// Minutes for which the person's place was known, about.
    pub(crate) fn watched_min(&self) -> f64 {
        self.anchors[0].stayed[1] - SAMPLED
    }

    /// Drops waiting forecasts, which belong to another map.
    pub(crate) fn forget_forecasts(&mut self) {
        self.anchors.iter_mut().for_each(|anchor| anchor.waiting.clear());
    }

    pub(crate) fn shift_clock(&mut self, by_s: f64) {
        let waiting = self.anchors.iter_mut().flat_map(|anchor| &mut anchor.waiting);
        waiting
            .flat_map(|waiting| [&mut waiting.at_s, &mut waiting.entered_s])
            .chain([&mut self.entered_s, &mut self.updated_s, &mut self.sampled_s])
            .for_each(|time_s| *time_s += by_s);
    }

    /// Counts the time spent until now.
    fn advance(&mut self, counts: &mut Counts, slot: u8, now_s: f64, learn: bool) {
        let mut at_s = self.updated_s;
        self.updated_s = at_s.max(now_s);
        if self.place == NONE || !learn || now_s - at_s > GAP_S {
            return;
        }
        while at_s < now_s {
            let spent_s = at_s - self.entered_s;
            let older_s =
                CLASSES_S.get(usize::from(time_class(spent_s))).map_or(f64::INFINITY, |end_s| self.entered_s + end_s);
            let hour_s = ((at_s / 3_600.0).floor() + 1.0) * 3_600.0;
            // Steps last at least a millisecond: with rounding the loop might not end.
            let until_s = now_s.min(older_s).min(hour_s).max(at_s + 1e-3);
            self.add_stay(counts, slot, at_s, MINUTES, (until_s - at_s) / 60.0);
            at_s = until_s;
        }
    }

    fn add_stay(&self, counts: &mut Counts, slot: u8, at_s: f64, symbol: u16, weight: f64) {
        let context = Context::of_stay(self.place, time_class(at_s - self.entered_s), at_s);
        for part in stay_parts(self.place) {
            counts.add(context.key(*part, slot), symbol, weight, minute(at_s));
        }
    }

    /// Puts the person in the place `number`, or in an unknown one (`NONE`).
    pub(crate) fn be(&mut self, counts: &mut Counts, slot: u8, number: u16, now_s: f64, learn: bool) {
        let now_s = now_s.max(self.updated_s);
        self.advance(counts, slot, now_s, learn);
        let was_back = std::mem::take(&mut self.is_back);
        if number == self.place {
            return;
        }
        if self.place != NONE && learn {
            self.add_stay(counts, slot, now_s, EXITS, 1.0);
        }
        let has_arrived = was_back && number != ELSEWHERE && now_s - self.entered_s <= ARRIVAL_S;
        let from = if has_arrived { ELSEWHERE } else { self.place };
        if from != NONE && number != NONE && learn {
            let context = Context::of_stay(from, 0, now_s);
            for Level { part, .. } in EXIT {
                counts.add(context.key(part, slot), number, 1.0, minute(now_s));
            }
        }
        self.before = std::mem::replace(&mut self.place, number);
        (self.entered_s, self.updated_s) = (now_s, now_s);
    }

    /// A person who was out is in the house, in an unknown room.
    pub(crate) fn come_back(&mut self, counts: &mut Counts, slot: u8, now_s: f64, learn: bool) {
        if self.place == ELSEWHERE {
            self.be(counts, slot, NONE, now_s, learn);
            self.is_back = true;
        }
    }

    /// Counts the time spent until now, and learns from due forecasts.
    pub(crate) fn learn_due(&mut self, counts: &mut Counts, slot: u8, home: &Home, now_s: f64, learn: bool) {
        self.advance(counts, slot, now_s, learn);
        let places = home.places();
        for (index, (anchor, horizon_s)) in self.anchors.iter_mut().zip(ANCHORS_S).enumerate() {
            while anchor.waiting.front().is_some_and(|waiting| waiting.at_s + horizon_s <= now_s) {
                let Some(Waiting { at_s, entered_s, place, threshold, rows }) = anchor.waiting.pop_front() else {
                    break;
                };
                let due_s = at_s + horizon_s;
                let truth = if due_s >= self.entered_s { self.place } else { self.before };
                // Outcomes that were not observed in time are unknown.
                if truth == NONE || place == NONE || !learn || now_s - due_s > 2.0 * SAMPLE_S {
                    continue;
                }
                anchor.stayed[1] += 1.0;
                anchor.stayed[0] += f64::from(u8::from(truth == place));
                anchor.pool.count(counts, slot, &later_context(place, index, at_s, at_s - entered_s), truth, at_s);
                if let Some(truth) = home.places.index(truth).filter(|_| rows.len() == (EXPERTS + 1) * places) {
                    let given = |expert: usize| rows[expert * places + truth].max(FLOOR);
                    anchor.pool.mixture.learn(given, SHARE, (SAMPLE_S / horizon_s).min(1.0));
                    anchor.sets.learn(rows[EXPERTS * places + truth], threshold);
                }
            }
        }
    }

    /// Keeps a forecast to learn from later, once a [`SAMPLE_S`]. `shipped` writes the forecast without habits.
    pub(crate) fn sample(&mut self, view: &View<'_>, now_s: f64, shipped: &mut dyn FnMut(f64, &mut [f64])) {
        if now_s - self.sampled_s < SAMPLE_S {
            return;
        }
        self.sampled_s = now_s;
        let places = view.home.places();
        let mut own = vec![0.0; ANCHORS_S.len() * places];
        own.chunks_exact_mut(places).zip(ANCHORS_S).for_each(|(row, horizon_s)| shipped(horizon_s, row));
        let (place, entered_s) = (self.place, self.entered_s);
        let is_known = view.home.places.index(place).is_some();
        let mut rows = Vec::new();
        self.forecast(view, (now_s, &ANCHORS_S), &mut own, |_, all| {
            rows.push(if is_known { all.to_vec() } else { Vec::new() })
        });
        for (anchor, rows) in self.anchors.iter_mut().zip(rows) {
            let threshold = anchor.sets.threshold();
            anchor.waiting.push_back(Waiting { at_s: now_s, entered_s, place, threshold, rows });
        }
    }

    /// Writes the probabilities per horizon (ascending) and place, row by row, into `out`, which holds the forecast without habits. Passes the
    /// experts' weights and all rows, the mixture's last, to `given`.
    pub(crate) fn forecast(
        &mut self,
        view: &View<'_>,
        (now_s, horizons_s): (f64, &[f64]),
        out: &mut [f64],
        mut given: impl FnMut([f64; EXPERTS], &[f64]),
    ) {
        let places = view.home.places();
        let here = view.home.places.index(self.place);
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { rows, ahead, leaving } = &mut scratch;
        if here.is_some() || self.is_back {
            let from = Stay { here, spent_s: now_s - self.entered_s };
            leaving.forecast(view, from, (now_s, horizons_s), ahead);
        }
        if let Some(here) = here {
            for index in 0..ANCHORS_S.len() {
                let stay = self.persistence(index, places);
                let pool = &mut self.anchors[index].pool;
                pool.begin(places, None);
                let by_place = pool.row_mut(BY_PLACE);
                by_place.fill((1.0 - stay) / (places - 1).max(1) as f64);
                by_place[here] = stay;
                let context = later_context(self.place, index, now_s, now_s - self.entered_s);
                pool.smooth(view, &context, |number| view.home.places.index(number));
            }
        }
        for (at, (horizon_s, out)) in horizons_s.iter().zip(out.chunks_exact_mut(places)).enumerate() {
            normalise(out);
            rows.clear();
            rows.resize((EXPERTS + 1) * places, 0.0);
            let mut weights = [0.0; EXPERTS];
            rows[SHIPPED * places..][..places].copy_from_slice(out);
            if here.is_some() || self.is_back {
                rows[LEAVING * places..][..places].copy_from_slice(&ahead[at * places..][..places]);
            }
            if let Some(here) = here {
                for (index, part) in between(*horizon_s).into_iter().filter(|(_, part)| *part > 0.0) {
                    for expert in [BY_PLACE, LATER] {
                        let sums = &mut rows[expert * places..][..places];
                        match index {
                            Some(index) => {
                                let of = self.anchors[index].pool.row(expert);
                                sums.iter_mut().zip(of).for_each(|(sum, p)| *sum += part * p);
                            }
                            // At time zero the person is in the present place.
                            None => sums[here] += part,
                        }
                    }
                    let of = self.anchors[index.unwrap_or(0)].pool.mixture.weights();
                    weights.iter_mut().zip(of).for_each(|(sum, weight)| *sum += part * weight);
                }
            } else {
                let returns = view.own(Part::Exit, &Context::of_stay(ELSEWHERE, 0, now_s)).filter(|_| self.is_back);
                let seen: f64 = returns.map_or(0.0, |seen| seen.symbols().map(|(_, count)| count).sum());
                weights[LEAVING] = seen / (seen + BACK_STRENGTH);
                weights[SHIPPED] = 1.0 - weights[LEAVING];
            }
            let (experts, mixed) = rows.split_at_mut(EXPERTS * places);
            for (row, weight) in experts.chunks_exact(places).zip(weights) {
                mixed.iter_mut().zip(row).for_each(|(mixed, p)| *mixed += weight * p);
            }
            if weights[SHIPPED] < 1.0 {
                normalise(mixed);
                out.copy_from_slice(mixed);
            }
            given(weights, rows);
        }
        self.scratch = scratch;
    }

    /// The places of the set with the promised coverage, `horizon_s` ahead, for probabilities of [`Stays::forecast`]. For `another` kind of forecast,
    /// or with few outcomes, the fewest places whose sum is the coverage.
    pub(crate) fn set(&self, horizon_s: f64, probabilities: &[f64], another: bool, set: &mut Vec<bool>) {
        let [(lower, rest), (upper, _)] = between(horizon_s);
        let sets = &self.anchors[if rest > 0.5 { lower } else { upper }.unwrap_or(0)].sets;
        if another || sets.knows_little() {
            sets.cover(probabilities, set);
        } else {
            sets.set(probabilities, sets.threshold(), set);
        }
    }

    /// The probability of the same place a horizon later.
    fn persistence(&self, index: usize, places: usize) -> f64 {
        let [stayed, sampled] = self.anchors[index].stayed;
        match self.place {
            _ if places < 2 => 1.0,
            // Stays in rooms do not predict the length of an absence.
            ELSEWHERE => (SHIPPED_AWAY_S / (SHIPPED_AWAY_S + ANCHORS_S[index])).powi(2),
            _ => stayed / sampled,
        }
    }
}

/// The context of the place a horizon later.
fn later_context(place: u16, horizon: usize, at_s: f64, spent_s: f64) -> Context {
    Context { horizon: horizon as u16, ..Context::of_stay(place, time_class(spent_s), at_s) }
}

/// The anchors before and after a horizon, each with its share; `None` is the present.
fn between(horizon_s: f64) -> [(Option<usize>, f64); 2] {
    let upper = ANCHORS_S.iter().position(|anchor_s| horizon_s <= *anchor_s).unwrap_or(ANCHORS_S.len() - 1);
    let lower = upper.checked_sub(1);
    let share = match lower {
        None => horizon_s / ANCHORS_S[0],
        Some(lower) => (horizon_s / ANCHORS_S[lower]).ln() / (ANCHORS_S[upper] / ANCHORS_S[lower]).ln(),
    };
    let share = share.clamp(0.0, 1.0);
    [(lower, 1.0 - share), (Some(upper), share)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_between_the_anchors_are_interpolated() {
        assert_eq!(between(0.0), [(None, 1.0), (Some(0), 0.0)]);
        assert_eq!(between(60.0), [(None, 0.0), (Some(0), 1.0)]);
        assert_eq!(between(1e9), [(Some(2), 0.0), (Some(3), 1.0)]);
        let [(lower, _), (upper, share)] = between(150.0);
        assert_eq!((lower, upper), (Some(0), Some(1)));
        assert!((0.5..0.6).contains(&share));
    }
}
