//! The place a time later (leaving.rs has the length of stays): the forecasts of P(place at now + t) are mixed by fixed share, with separate weights at
//! each of [`ANCHORS_S`]. Between the anchors they are interpolated over the logarithm of the time.
//!
//! | expert | source |
//! | --- | --- |
//! | shipped | the forecast without habits ([`crate::forecast`]) |
//! | leaving | the rate of leaving a place, and where exits led ([`super::leaving`]) |
//! | by place | the places that much later in the past, by place, over the share of unchanged places |
//! | later | as by place, by hour and by time spent as well |
//!
//! Outcomes are learned a horizon later. If a person came back and has no known room yet, only leaving has data.

use std::collections::VecDeque;

use super::context::Fact::{Here, Horizon, HorizonSpent, Hours2, Hours3};
use super::context::{CLASSES_S, Context, Level, NONE, Without, level, time_class};
use super::leaving::{EXIT, EXITS, Leaving, MINUTES, SHIPPED_AWAY_S, STAY};
use super::names::ELSEWHERE;
use super::pool::{Begin, Plan, Pool, Source, expert};
use super::sets::AdaptiveSets;
use super::view::{View, add, normalise};

/// Horizons at which the weights are learned, in seconds.
pub(crate) const ANCHORS_S: [f64; 4] = [60.0, 300.0, 900.0, 3_600.0];
const EXPERTS: usize = 4;
const SHARE: f64 = 0.0005;
const SHIPPED: usize = 0;
const LEAVING: usize = 1;
const BY_PLACE: usize = 2;
static OF_PLACE: [Level; 1] = [level(24, "later-by-place", &[Here, Horizon], [0.0, 8.0])];
pub(crate) static PLAN: Plan = Plan {
    experts: &[
        expert(0, "", [0.4, 0.0], Source::Model, Begin::Given),
        expert(51, "leaving", [0.2, 0.0], Source::Habit, Begin::Given),
        expert(52, "by-place", [0.2, 0.0], Source::Habit, Begin::Given).over(&OF_PLACE),
        expert(53, "later", [0.2, 0.0], Source::Hour, Begin::After(BY_PLACE, 1)).over(&[
            level(25, "later-by-hour", &[Here, Horizon, Hours3], [0.0, 40.0]),
            level(26, "later-by-dwell", &[Here, HorizonSpent, Hours2], [0.0, 40.0]),
        ]),
    ],
    product: None,
};
/// First weight of the forecast without habits.
const FIRST: f64 = 0.4;
/// Least time between forecasts that are kept for learning. Outcomes that are closer together than their horizon are alike: they count as if they
/// came once a horizon.
const SAMPLE_S: f64 = 60.0;
/// After a longer silence of the whole system the time is not counted as a stay.
const GAP_S: f64 = 36.0 * 3_600.0;
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
    context: Context,
    /// Of the set.
    threshold: f64,
    /// The probabilities of experts and mixture, row by row.
    rows: Vec<f64>,
}

/// One horizon.
#[derive(Debug, Clone)]
pub(crate) struct Anchor {
    /// The weights, and the rows of by place and later in the latest forecast.
    pub(crate) pool: Pool,
    /// Samples in which the person was in the same place, and all samples: one of two at the start.
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
    leaving: Leaving,
    /// The rows of the experts and of the mixture for the last horizon of the latest forecast.
    rows: Vec<f64>,
}

impl Stays {
    pub(crate) fn new(coverage: f64, without: Without) -> Self {
        let anchor = |_| Anchor {
            pool: Pool::new(&PLAN, FIRST, without),
            stayed: [1.0, 2.0],
            sets: AdaptiveSets::new(coverage, true),
            waiting: VecDeque::new(),
        };
        Self {
            place: NONE,
            entered_s: 0.0,
            is_back: false,
            before: NONE,
            updated_s: 0.0,
            sampled_s: f64::NEG_INFINITY,
            anchors: ANCHORS_S.map(anchor),
            leaving: Leaving::default(),
            rows: Vec::new(),
        }
    }

    /// Minutes for which the person's place was known, about.
    pub(crate) fn watched_min(&self) -> f64 {
        self.anchors[0].stayed[1] - 2.0
    }

    /// Drops waiting forecasts, because their outcome will not be observed or has another number.
    pub(crate) fn forget_forecasts(&mut self) {
        self.anchors.iter_mut().for_each(|anchor| anchor.waiting.clear());
    }

    pub(crate) fn forget_place(&mut self, number: u16) {
        self.forget_forecasts();
        self.place = if self.place == number { NONE } else { self.place };
    }

    pub(crate) fn shift_clock(&mut self, by_s: f64) {
        [&mut self.entered_s, &mut self.updated_s, &mut self.sampled_s].into_iter().for_each(|time_s| *time_s += by_s);
        self.anchors.iter_mut().flat_map(|anchor| &mut anchor.waiting).for_each(|waiting| waiting.at_s += by_s);
    }

    /// Counts the time spent until now.
    fn advance(&mut self, view: &mut View<'_>, now_s: f64) {
        let mut at_s = self.updated_s;
        self.updated_s = at_s.max(now_s);
        if self.place == NONE || !view.learns || now_s - at_s > GAP_S {
            return;
        }
        while at_s < now_s {
            let class = usize::from(time_class(at_s - self.entered_s));
            let older_s = CLASSES_S.get(class).map_or(f64::INFINITY, |end_s| self.entered_s + end_s);
            let hour_s = ((at_s / 3_600.0).floor() + 1.0) * 3_600.0;
            // Steps last at least a millisecond: with rounding the loop might not end.
            let until_s = now_s.min(older_s).min(hour_s).max(at_s + 1e-3);
            self.count(view, at_s, (MINUTES, (until_s - at_s) / 60.0));
            at_s = until_s;
        }
    }

    fn count(&self, view: &mut View<'_>, at_s: f64, symbol: (u16, f64)) {
        let context = self.context(at_s);
        let levels = &STAY[usize::from(self.place == ELSEWHERE)..];
        levels.iter().for_each(|level| view.count(level, &context, symbol, at_s));
    }

    /// Puts the person in the place `number`, or in an unknown one (`NONE`). Due forecasts learn first: their outcome is the place before.
    pub(crate) fn be(&mut self, view: &mut View<'_>, number: u16, now_s: f64) {
        self.learn_due(view, now_s);
        let (now_s, was_back) = (self.updated_s, std::mem::take(&mut self.is_back));
        if number == self.place {
            return;
        }
        if self.place != NONE {
            self.count(view, now_s, (EXITS, 1.0));
        }
        let has_arrived = was_back && number != ELSEWHERE && now_s - self.entered_s <= ARRIVAL_S;
        let from = if has_arrived { ELSEWHERE } else { self.place };
        if from != NONE && number != NONE {
            let context = Context::new(from, 0, now_s);
            EXIT.iter().for_each(|level| view.count(level, &context, (number, 1.0), now_s));
        }
        self.before = std::mem::replace(&mut self.place, number);
        (self.entered_s, self.updated_s) = (now_s, now_s);
    }

    /// Counts the time spent until now, and learns from due forecasts.
    pub(crate) fn learn_due(&mut self, view: &mut View<'_>, now_s: f64) {
        self.advance(view, now_s);
        let places = view.home.places();
        for (Anchor { pool, stayed, sets, waiting }, horizon_s) in self.anchors.iter_mut().zip(ANCHORS_S) {
            let is_due = |waiting: &Waiting| waiting.at_s + horizon_s <= now_s;
            while waiting.front().is_some_and(is_due)
                && let Some(Waiting { at_s, context, threshold, rows }) = waiting.pop_front()
            {
                let due_s = at_s + horizon_s;
                let truth = if due_s >= self.entered_s { self.place } else { self.before };
                // Outcomes that were not observed in time are unknown.
                if truth == NONE || !view.learns || now_s - due_s > 2.0 * SAMPLE_S {
                    continue;
                }
                *stayed = [stayed[0] + f64::from(u8::from(truth == context.get(Here))), stayed[1] + 1.0];
                pool.count(view, &context, truth, at_s);
                if let Some(truth) = view.home.places.index(truth) {
                    let given = |expert: usize| rows[expert * places + truth].max(FLOOR);
                    pool.mixture.learn(given, SHARE, (SAMPLE_S / horizon_s).min(1.0));
                    sets.learn(rows[EXPERTS * places + truth], threshold);
                }
            }
        }
    }

    /// Keeps a forecast to learn from later, once a [`SAMPLE_S`]. `shipped` writes the forecast without habits.
    pub(crate) fn sample(&mut self, view: &View<'_>, now_s: f64, shipped: &mut dyn FnMut(f64, &mut [f64])) {
        if now_s - self.sampled_s < SAMPLE_S || view.home.places.index(self.place).is_none() {
            return;
        }
        self.sampled_s = now_s;
        let places = view.home.places();
        let mut own = vec![0.0; ANCHORS_S.len() * places];
        own.chunks_exact_mut(places).zip(ANCHORS_S).for_each(|(row, horizon_s)| shipped(horizon_s, row));
        let mut rows = Vec::new();
        self.forecast(view, (now_s, &ANCHORS_S), &mut own, |_, all| rows.push(all.to_vec()));
        let context = self.context(now_s);
        for ((horizon, anchor), rows) in (0..).zip(&mut self.anchors).zip(rows) {
            let (context, threshold) = (context.before(horizon), anchor.sets.threshold());
            anchor.waiting.push_back(Waiting { at_s: now_s, context, threshold, rows });
        }
    }

    fn context(&self, now_s: f64) -> Context {
        Context::new(self.place, time_class(now_s - self.entered_s), now_s)
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
        let (places, context) = (view.home.places(), self.context(now_s));
        let here = view.home.places.index(self.place);
        let Self { anchors, leaving, rows, .. } = self;
        let may_leave = here.is_some() || self.is_back;
        if may_leave {
            let farthest_s = horizons_s.last().copied().unwrap_or(0.0);
            leaving.begin(view, here, now_s - self.entered_s, (now_s, farthest_s));
        }
        for ((horizon, horizon_s), Anchor { pool, stayed, .. }) in (0..).zip(ANCHORS_S).zip(&mut *anchors) {
            let Some(here) = here else { break };
            let stay = match self.place {
                // Stays in rooms do not predict the length of an absence.
                ELSEWHERE => (SHIPPED_AWAY_S / (SHIPPED_AWAY_S + horizon_s)).powi(2),
                _ => stayed[0] / stayed[1],
            };
            pool.begin(places);
            let by_place = pool.row_mut(BY_PLACE);
            by_place.fill((1.0 - stay) / (places - 1).max(1) as f64);
            by_place[here] = stay;
            pool.smooth(view, &context.before(horizon), |number| view.home.places.index(number));
        }
        for (horizon_s, out) in horizons_s.iter().zip(out.chunks_exact_mut(places)) {
            normalise(out);
            rows.clear();
            rows.resize((EXPERTS + 1) * places, 0.0);
            let (experts, mixed) = rows.split_at_mut(EXPERTS * places);
            let mut weights = [0.0; EXPERTS];
            experts[SHIPPED * places..][..places].copy_from_slice(out);
            if may_leave {
                leaving.at(*horizon_s, &mut experts[LEAVING * places..][..places]);
            }
            if let Some(here) = here {
                for (index, part) in between(*horizon_s).into_iter().filter(|(_, part)| *part > 0.0) {
                    for (expert, row) in experts.chunks_exact_mut(places).enumerate().skip(BY_PLACE) {
                        match index {
                            Some(index) => add(row, anchors[index].pool.row(expert), part),
                            // At time zero the person is in the present place.
                            None => row[here] += part,
                        }
                    }
                    add(&mut weights, &anchors[index.unwrap_or(0)].pool.mixture.weights, part);
                }
            } else {
                let key = Context::new(ELSEWHERE, 0, now_s).key(&EXIT[0], view.slot);
                let seen = view.get(&EXIT[0], key).filter(|_| self.is_back).map_or(0.0, |returns| returns.sum());
                weights[LEAVING] = seen / (seen + BACK_STRENGTH);
                weights[SHIPPED] = 1.0 - weights[LEAVING];
            }
            experts.chunks_exact(places).zip(weights).for_each(|(row, weight)| add(mixed, row, weight));
            if weights[SHIPPED] < 1.0 {
                normalise(mixed);
                out.copy_from_slice(mixed);
            }
            given(weights, rows);
        }
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
