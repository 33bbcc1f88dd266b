//! Forecasts a later place from the length and the destination of stays: a stay of some age in a place ends at the rate of exits over time spent. Each
//! level has the next wider one as its prior: place and part of the day, then place, then all rooms, then the shipped stay. After a stay the person goes
//! where earlier exits led, and a new stay begins there.

use super::context::Fact::{Here, Horizon, Hours3, Spent};
use super::context::{CLASSES, Context, Level, NONE, class_s, level, time_class};
use super::names::ELSEWHERE;
use super::view::{View, normalise};

/// Symbols of the counts of stays.
pub(crate) const EXITS: u16 = 0;
pub(crate) const MINUTES: u16 = 1;
/// Contexts of exits and time spent. The first is of all rooms, and time out of the house does not count for it. A stay has no horizon.
pub(crate) static STAY: [Level; 3] = [
    level(19, "stay", &[Horizon, Spent], [0.0, 0.0]),
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
    /// The time ahead of the probabilities, in seconds.
    at_s: f64,
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
    /// Begins a forecast at most `farthest_s` ahead. The stay has lasted for `spent_s`. Without a place the person came back then, into an unknown room.
    pub(crate) fn begin(
        &mut self,
        view: &View<'_>,
        here: Option<usize>,
        spent_s: f64,
        (now_s, farthest_s): (f64, f64),
    ) {
        // After a return the forecast starts at the return.
        self.at_s = if here.is_some() { 0.0 } else { -spent_s.clamp(0.0, FARTHEST_S) };
        let [oldest, newest] = [spent_s, farthest_s.min(FARTHEST_S) - self.at_s].map(|s| usize::from(time_class(s)));
        // The rate of leaving in these contexts, with a wider one as the prior.
        let narrowed = |wider, levels: &'static [Level], context| {
            levels.iter().flat_map(|level| view.seen(level, &context)).fold(wider, |rate, (seen, _)| {
                let (exits, spent_s) = (seen.count(EXITS), 60.0 * seen.count(MINUTES));
                (exits + RATE_STRENGTH) / (spent_s + RATE_STRENGTH / rate)
            })
        };
        let shipped = |scale_s, age| 2.0 / (scale_s + 0.5 * class_s(age).iter().sum::<f64>());
        let of_rooms = |age| narrowed(shipped(SHIPPED_STAY_S, age), &STAY[..1], Context::new(NONE, age as u16, now_s));
        let (places, in_rooms) = (view.home.places(), std::array::from_fn::<_, CLASSES, _>(of_rooms));
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
            // At the ages that a stay can have.
            let is_possible = |age| age <= newest || Some(place) == here && age >= oldest;
            for (age, rate) in rates.iter_mut().enumerate().filter(|(age, _)| is_possible(*age)) {
                let wider = if number == ELSEWHERE { shipped(SHIPPED_AWAY_S, age) } else { in_rooms[age] };
                *rate = narrowed(wider, &STAY[1..], Context::new(number, age as u16, now_s));
            }
        }
        self.mass.clear();
        self.mass.resize(places, [0.0; CLASSES]);
        if let Some(here) = here {
            self.mass[here][oldest] = 1.0;
            return;
        }
        let elsewhere = view.home.rooms();
        self.mass.iter_mut().zip(&self.leads[elsewhere * places..]).for_each(|(mass, led)| mass[0] = *led);
        self.step_until(0.0);
        // The person has not left again until now.
        self.mass[elsewhere] = [0.0; CLASSES];
    }

    /// Writes the probabilities of places so many seconds ahead; later calls go further ahead.
    pub(crate) fn at(&mut self, horizon_s: f64, out: &mut [f64]) {
        self.step_until(horizon_s.min(FARTHEST_S));
        out.iter_mut().zip(&self.mass).for_each(|(p, mass)| *p = mass.iter().sum());
        normalise(out);
    }

    /// Moves probability by leaving, arriving and ageing.
    fn step_until(&mut self, until_s: f64) {
        while self.at_s < until_s {
            let step_s = (STEP_SHARE * self.at_s).clamp(STEPS_S[0], STEPS_S[1]).min(until_s - self.at_s);
            let ageing: [f64; CLASSES] = std::array::from_fn(|age| {
                let [begin_s, end_s] = class_s(age);
                if age + 1 < CLASSES { gone(step_s / (end_s - begin_s)) } else { 0.0 }
            });
            self.left.clear();
            for (mass, rates) in self.mass.iter_mut().zip(&self.rates) {
                let (mut older, mut left) = (0.0, 0.0);
                for ((mass, rate), ages) in mass.iter_mut().zip(rates).zip(ageing) {
                    let leaves = *mass * gone(step_s * rate);
                    let grows = (*mass - leaves) * ages;
                    *mass += older - leaves - grows;
                    (older, left) = (grows, left + leaves);
                }
                self.left.push(left);
            }
            for (left, leads) in self.left.iter().zip(self.leads.chunks_exact(self.rates.len())) {
                self.mass.iter_mut().zip(leads).for_each(|(mass, lead)| mass[0] += left * lead);
            }
            self.at_s += step_s;
        }
    }
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
