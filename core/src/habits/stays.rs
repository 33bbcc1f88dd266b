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

use super::counts::Counts;
use super::key::{Kind, NONE, key};
use super::leaving::{EXITS, Leaving, MINUTES, SHIPPED_AWAY_S, Stay, exit_contexts, stay_contexts};
use super::mixture::FixedShare;
use super::moment::{self, CLASSES_S, PART_HOURS, time_class};
use super::names::{ELSEWHERE, Home};
use super::parts::{Expert, Without};
use super::rooms::normalise;
use super::sets::{AdaptiveSets, Issued, SetOptions};
use super::whose::View;

/// Horizons at which the weights are learned, in seconds.
pub(crate) const ANCHORS_S: [f64; 4] = [60.0, 300.0, 900.0, 3_600.0];
pub(crate) const EXPERTS: usize = 4;
pub(crate) const PRIOR: [f64; EXPERTS] = [0.4, 0.2, 0.2, 0.2];
pub(crate) const SHARE: f64 = 0.0005;
const SHIPPED: usize = 0;
const LEAVING: usize = 1;
const BY_PLACE: usize = 2;
const LATER: usize = 3;
/// Least time between forecasts that are kept for learning. Outcomes that are closer together than their horizon are alike: they count as if they
/// came once a horizon.
const SAMPLE_S: f64 = 60.0;
/// After a longer silence of the whole system the time is not counted as a stay.
const GAP_S: f64 = 36.0 * 3_600.0;
/// Samples that the wider level is worth.
const LATER_STRENGTH: [f64; 3] = [8.0, 40.0, 40.0];
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
    issued: Issued,
    /// The probabilities of experts and mixture, row by row; empty if only the counts learn.
    rows: Vec<f64>,
}

/// One horizon.
#[derive(Debug, Clone)]
pub(crate) struct Anchor {
    pub(crate) mixture: FixedShare<EXPERTS>,
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
    is_back: bool,
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
    /// Per anchor the rows of by place and later.
    anchored: Vec<f64>,
    /// Per horizon the row of leaving.
    ahead: Vec<f64>,
    leaving: Leaving,
}

impl Stays {
    pub(crate) fn new(sets: SetOptions, without: Without) -> Self {
        let uses = |expert: Expert| without.uses(expert as u8);
        let prior = FixedShare::of(PRIOR, [true, uses(Expert::Leaving), uses(Expert::ByPlace), uses(Expert::Later)]);
        let anchor = || Anchor {
            mixture: FixedShare::new(prior),
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

    pub(crate) fn forget_number(&mut self, number: u16) {
        [&mut self.before, &mut self.place]
            .into_iter()
            .filter(|place| **place == number)
            .for_each(|place| *place = NONE);
        self.forget_forecasts();
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
        let spent = time_class(at_s - self.entered_s);
        for (kind, after) in stay_contexts(self.place, spent, moment::part_of_day(at_s, PART_HOURS)) {
            counts.add(key(kind, slot, after), symbol, weight, moment::minute(at_s));
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
            for context in exit_contexts(from, moment::part_of_day(now_s, PART_HOURS)) {
                counts.add(key(context.0, slot, context.1), number, 1.0, moment::minute(now_s));
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

    /// Whether the person came back and has no known room since.
    pub(crate) fn is_back(&self) -> bool {
        self.is_back
    }

    pub(crate) fn is_due(&self, now_s: f64) -> bool {
        now_s - self.sampled_s >= SAMPLE_S
    }

    /// Counts the time spent until now, and learns from due forecasts.
    pub(crate) fn learn_due(&mut self, counts: &mut Counts, slot: u8, home: &Home, now_s: f64, learn: bool) {
        self.advance(counts, slot, now_s, learn);
        let places = home.places();
        for (index, (anchor, horizon_s)) in self.anchors.iter_mut().zip(ANCHORS_S).enumerate() {
            while anchor.waiting.front().is_some_and(|waiting| waiting.at_s + horizon_s <= now_s) {
                let Some(Waiting { at_s, entered_s, place, issued, rows }) = anchor.waiting.pop_front() else { break };
                let due_s = at_s + horizon_s;
                let truth = if due_s >= self.entered_s { self.place } else { self.before };
                // Outcomes that were not observed in time are unknown.
                if truth == NONE || place == NONE || !learn || now_s - due_s > 2.0 * SAMPLE_S {
                    continue;
                }
                anchor.stayed[1] += 1.0;
                anchor.stayed[0] += f64::from(u8::from(truth == place));
                for (kind, after) in later_contexts(place, index, at_s, at_s - entered_s) {
                    counts.add(key(kind, slot, after), truth, 1.0, moment::minute(at_s));
                }
                if let Some(truth) = home.places.index(truth).filter(|_| rows.len() == (EXPERTS + 1) * places) {
                    let given = std::array::from_fn(|expert| rows[expert * places + truth].max(FLOOR));
                    anchor.mixture.learn(&given, SHARE, (SAMPLE_S / horizon_s).min(1.0));
                    anchor.sets.learn(&rows[EXPERTS * places..], issued, truth);
                }
            }
        }
    }

    /// Keeps a forecast to learn from later. `shipped` writes the forecast without habits.
    pub(crate) fn sample(
        &mut self,
        view: View<'_>,
        now_s: f64,
        next_rooms: &[f64],
        shipped: &mut dyn FnMut(f64, &mut [f64]),
    ) {
        self.sampled_s = now_s;
        let places = view.home.places();
        let mut own = vec![0.0; ANCHORS_S.len() * places];
        own.chunks_exact_mut(places).zip(ANCHORS_S).for_each(|(row, horizon_s)| shipped(horizon_s, row));
        let (place, entered_s) = (self.place, self.entered_s);
        let is_known = view.home.places.index(place).is_some();
        let mut rows = Vec::new();
        self.forecast(view, (now_s, &ANCHORS_S), next_rooms, &mut own, |_, all| {
            rows.push(if is_known { all.to_vec() } else { Vec::new() })
        });
        for (anchor, rows) in self.anchors.iter_mut().zip(rows) {
            let issued = anchor.sets.issue();
            anchor.waiting.push_back(Waiting { at_s: now_s, entered_s, place, issued, rows });
        }
    }

    /// Writes the probabilities per horizon (ascending) and place, row by row, into `out`, which holds the forecast without habits. Passes the
    /// experts' weights and all rows, the mixture's last, to `given`.
    pub(crate) fn forecast(
        &mut self,
        view: View<'_>,
        (now_s, horizons_s): (f64, &[f64]),
        next_rooms: &[f64],
        out: &mut [f64],
        mut given: impl FnMut([f64; EXPERTS], &[f64]),
    ) {
        let places = view.home.places();
        let here = view.home.places.index(self.place);
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { rows, anchored, ahead, leaving } = &mut scratch;
        if here.is_some() || self.is_back {
            let from = Stay { here, spent_s: now_s - self.entered_s };
            leaving.forecast(view, from, now_s, next_rooms, horizons_s, ahead);
        }
        anchored.clear();
        anchored.resize(ANCHORS_S.len() * 2 * places, 0.0);
        if let Some(here) = here {
            for (index, rows) in anchored.chunks_exact_mut(2 * places).enumerate() {
                if horizons_s.iter().any(|horizon_s| between(*horizon_s).uses(index)) {
                    let (by_place, later) = rows.split_at_mut(places);
                    self.persistence(index, here, by_place);
                    let contexts = later_contexts(self.place, index, now_s, now_s - self.entered_s);
                    for (at, (context, strength)) in contexts.into_iter().zip(LATER_STRENGTH).enumerate() {
                        let row = if at == 0 { &mut *by_place } else { &mut *later };
                        view.smooth(context, (0.0, strength), |number| view.home.places.index(number), row);
                        if at == 0 {
                            later.copy_from_slice(by_place);
                        }
                    }
                }
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
                let Between { lower, upper, share } = between(*horizon_s);
                for (index, part) in [(lower, 1.0 - share), (Some(upper), share)] {
                    for (expert, row) in [BY_PLACE, LATER].into_iter().zip(0..) {
                        let sums = &mut rows[expert * places..][..places];
                        match index {
                            Some(index) => {
                                let of = &anchored[(2 * index + row) * places..][..places];
                                sums.iter_mut().zip(of).for_each(|(sum, p)| *sum += part * p);
                            }
                            // At time zero the person is in the present place.
                            None => sums[here] += part,
                        }
                    }
                    let of = self.anchors[index.unwrap_or(upper)].mixture.weights();
                    weights.iter_mut().zip(of).for_each(|(sum, weight)| *sum += part * weight);
                }
            } else {
                let returns = view.own(Kind::Exit, [ELSEWHERE, NONE, NONE]).filter(|_| self.is_back);
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
        let Between { lower, upper, share } = between(horizon_s);
        let sets = &self.anchors[lower.filter(|_| share < 0.5).unwrap_or(upper)].sets;
        if another || sets.knows_little() {
            sets.cover(probabilities, set);
        } else {
            sets.set(probabilities, sets.issue(), set);
        }
    }

    fn persistence(&self, index: usize, here: usize, p: &mut [f64]) {
        let [stayed, sampled] = self.anchors[index].stayed;
        // Stays in rooms do not predict the length of an absence.
        let stay = match self.place {
            ELSEWHERE => (SHIPPED_AWAY_S / (SHIPPED_AWAY_S + ANCHORS_S[index])).powi(2),
            _ => stayed / sampled,
        };
        let others = p.len() - 1;
        p.fill((1.0 - stay) / others.max(1) as f64);
        p[here] = if others > 0 { stay } else { 1.0 };
    }
}

/// The contexts of the place a horizon later.
fn later_contexts(place: u16, horizon: usize, at_s: f64, spent_s: f64) -> [(Kind, [u16; 3]); 3] {
    let horizon = horizon as u16;
    [
        (Kind::Later, [place, horizon, NONE]),
        (Kind::LaterHour, [place, horizon, moment::part_of_day(at_s, 3)]),
        (Kind::LaterDwell, [place, horizon << 8 | time_class(spent_s), moment::part_of_day(at_s, 2)]),
    ]
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

#[cfg(test)]
mod tests {
    use super::*;

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
