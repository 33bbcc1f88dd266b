//! Forecasts a later place from the length and the destination of stays: a stay of some age in a place ends at the rate of exits over time spent. Each
//! level has the next wider one as its prior: place and part of the day, then place, then all rooms, then the shipped stay. After a stay the person goes
//! where earlier exits led, and a new stay begins there.

use super::context::Fact::{Here, Hours3, Nothing, Spent};
use super::context::{CLASSES, Context, Level, NONE, class_s, level, time_class};
use super::names::ELSEWHERE;
use super::view::{View, normalise};

/// Symbols of the counts of stays.
pub(crate) const EXITS: u16 = 0;
pub(crate) const MINUTES: u16 = 1;
/// Contexts of exits and time spent.
pub(crate) static STAY: [Level; 3] = [
    level(19, "stay", &[Nothing, Spent], [0.0, 0.0]),
    level(20, "stay-by-place", &[Here, Spent], [0.0, 0.0]),
    level(21, "stay-by-hour", &[Here, Spent, Hours3], [0.0, 0.0]),
];
/// Contexts of destinations.
pub(crate) static EXIT: [Level; 2] =
    [level(22, "exit", &[Here], [0.25, 2.0]), level(23, "exit-by-hour", &[Here, Hours3], [0.25, 4.0])];

/// Scales of an absence and of a stay in a room in the shipped forecast, in seconds.
pub(crate) const SHIPPED_AWAY_S: f64 = 14_400.0;
const SHIPPED_STAY_S: f64 = 120.0;
/// The forecast no longer changes beyond this time, in seconds.
const FARTHEST_S: f64 = 4.0 * 3_600.0;
/// The shortest and the longest step, in seconds; between them a step is `STEP_SHARE` of the time ahead.
const STEPS_S: [f64; 2] = [15.0, 300.0];
const STEP_SHARE: f64 = 0.2;
/// Exits that the wider level is worth.
const RATE_STRENGTH: f64 = 2.0;

#[derive(Debug, Clone, Default)]
pub(crate) struct Leaving {
    /// Per place and age of a stay, the rate of leaving and the probability of being there.
    rates: Vec<[f64; CLASSES]>,
    mass: Vec<[f64; CLASSES]>,
    /// Per place its destinations, row by row.
    leads: Vec<f64>,
    left: Vec<f64>,
}

/// `1 - exp(-x)`, to three digits up to one, at low cost.
fn gone(x: f64) -> f64 {
    if x < 1.0 { x / (1.0 + x * (0.5 + x / 12.0)) } else { 1.0 - (-x).exp() }
}

impl Leaving {
    /// Writes the probabilities per horizon (ascending) and place, row by row, into `out`. The stay has lasted for `spent_s`. Without a place the person
    /// came back then, into an unknown room.
    pub(crate) fn forecast(
        &mut self,
        view: &View<'_>,
        (here, spent_s): (Option<usize>, f64),
        (now_s, horizons_s): (f64, &[f64]),
        out: &mut Vec<f64>,
    ) {
        let (places, elsewhere) = (view.home.places(), view.home.rooms());
        // After a return the forecast starts at the return.
        let mut at_s = if here.is_some() { 0.0 } else { -spent_s.clamp(0.0, FARTHEST_S) };
        let farthest_s = horizons_s.last().map_or(0.0, |horizon_s| horizon_s.min(FARTHEST_S));
        let [oldest, newest] = [spent_s, farthest_s - at_s].map(|time_s| usize::from(time_class(time_s)));
        self.learned(view, now_s, |place, age| age <= newest || Some(place) == here && age >= oldest);
        self.mass.clear();
        self.mass.resize(places, [0.0; CLASSES]);
        match here {
            Some(here) => self.mass[here][oldest] = 1.0,
            None => self.mass.iter_mut().zip(&self.leads[elsewhere * places..]).for_each(|(mass, led)| mass[0] = *led),
        }
        self.step_until(&mut at_s, 0.0);
        if here.is_none() {
            // The person has not left again until now.
            self.mass[elsewhere] = [0.0; CLASSES];
        }
        out.clear();
        for horizon_s in horizons_s {
            self.step_until(&mut at_s, horizon_s.min(FARTHEST_S));
            out.extend(self.mass.iter().map(|mass| mass.iter().sum::<f64>()));
            let begin = out.len() - places;
            normalise(&mut out[begin..]);
        }
    }

    /// Computes the destinations of each place, and the rates of leaving it at the ages that a stay can have.
    fn learned(&mut self, view: &View<'_>, now_s: f64, is_possible: impl Fn(usize, usize) -> bool) {
        let places = view.home.places();
        self.rates.clear();
        self.rates.resize(places, [0.0; CLASSES]);
        self.leads.clear();
        self.leads.resize(places * places, 1.0);
        for (place, (rates, leads)) in self.rates.iter_mut().zip(self.leads.chunks_exact_mut(places)).enumerate() {
            let number = view.home.places.number(place).unwrap_or(NONE);
            leads[place] = 0.0;
            normalise(leads);
            let index = |number| view.home.places.index(number).filter(|other| *other != place);
            EXIT.iter().for_each(|level| _ = view.smooth(level, &Context::new(number, 0, now_s), index, leads));
            let scale_s = if number == ELSEWHERE { SHIPPED_AWAY_S } else { SHIPPED_STAY_S };
            for (age, rate) in rates.iter_mut().enumerate().filter(|(age, _)| is_possible(place, *age)) {
                let [begin_s, end_s] = class_s(age);
                *rate = 2.0 / (scale_s + 0.5 * (begin_s + end_s));
                let context = Context::new(number, age as u16, now_s);
                for (seen, _) in stay_levels(number).iter().flat_map(|level| view.seen(level, &context)) {
                    let (exits, spent_s) = (seen.count(EXITS), 60.0 * seen.count(MINUTES));
                    *rate = (exits + RATE_STRENGTH) / (spent_s + RATE_STRENGTH / *rate);
                }
            }
        }
    }

    /// Moves probability by leaving, arriving and ageing.
    fn step_until(&mut self, at_s: &mut f64, until_s: f64) {
        let places = self.mass.len();
        while *at_s < until_s {
            let step_s = (STEP_SHARE * *at_s).clamp(STEPS_S[0], STEPS_S[1]).min(until_s - *at_s);
            self.left.clear();
            for (mass, rates) in self.mass.iter_mut().zip(&self.rates) {
                let (mut older, mut left) = (0.0, 0.0);
                for (age, (mass, rate)) in mass.iter_mut().zip(rates).enumerate() {
                    let leaves = *mass * gone(step_s * rate);
                    let [begin_s, end_s] = class_s(age);
                    let grows =
                        if age + 1 < CLASSES { (*mass - leaves) * gone(step_s / (end_s - begin_s)) } else { 0.0 };
                    *mass += older - leaves - grows;
                    (older, left) = (grows, left + leaves);
                }
                self.left.push(left);
            }
            for (left, leads) in self.left.iter().zip(self.leads.chunks_exact(places)) {
                self.mass.iter_mut().zip(leads).for_each(|(mass, lead)| mass[0] += left * lead);
            }
            *at_s += step_s;
        }
    }
}

/// The contexts of a stay. Time out of the house does not count for the length of stays in rooms.
pub(crate) fn stay_levels(place: u16) -> &'static [Level] {
    &STAY[usize::from(place == ELSEWHERE)..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_that_is_gone_is_known_to_three_digits() {
        for x in [0.0, 0.01, 0.3, 0.7, 0.999, 1.0, 3.0, 50.0] {
            assert!((gone(x) - (1.0 - (-x).exp())).abs() < 1e-3, "{x}");
        }
    }
}
