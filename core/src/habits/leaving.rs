//! Forecasts a later place from the length and the destination of stays.
//!
//! A stay of some age in a place ends at the rate of exits over time spent. Each level has the next wider one as its prior: place and part of the
//! day, then place, then all rooms, then the shipped stay. Time out of the house has the shipped absence as its prior, since stays in rooms do not
//! predict its length. A person who leaves goes where earlier exits led, and a new stay begins there.

use super::context::{CLASSES, Context, class_s, time_class};
use super::names::ELSEWHERE;
use super::parts::{NONE, Part};
use super::view::{Level, View, level, normalise};

/// Symbols of the counts of stays.
pub(crate) const EXITS: u16 = 0;
pub(crate) const MINUTES: u16 = 1;
/// Scale of an absence in the shipped forecast, in seconds.
pub(crate) const SHIPPED_AWAY_S: f64 = 14_400.0;

/// The forecast no longer changes beyond this time, in seconds.
const FARTHEST_S: f64 = 4.0 * 3_600.0;
/// The shortest and the longest step, in seconds; between them a step is `STEP_SHARE` of the time ahead.
const STEPS_S: [f64; 2] = [15.0, 300.0];
const STEP_SHARE: f64 = 0.2;
/// Exits that the wider level is worth.
const RATE_STRENGTH: f64 = 2.0;
/// Contexts of destinations.
pub(crate) const EXIT: [Level; 2] = [level(Part::Exit, 0.25, 2.0), level(Part::ExitByHour, 0.25, 4.0)];
/// Scale of a stay in a room in the shipped forecast, in seconds.
const SHIPPED_STAY_S: f64 = 120.0;

/// The current stay. `here` is `None` if the person came back into an unknown room.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stay {
    pub(crate) here: Option<usize>,
    pub(crate) spent_s: f64,
}

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
    /// Writes the probabilities per horizon (ascending) and place, row by row, into `out`.
    pub(crate) fn forecast(
        &mut self,
        view: &View<'_>,
        from: Stay,
        (now_s, horizons_s): (f64, &[f64]),
        out: &mut Vec<f64>,
    ) {
        let places = view.home.places();
        out.clear();
        self.leads.clear();
        for place in 0..places {
            self.lead(view, place, now_s);
        }
        let elsewhere = places - 1;
        self.mass.clear();
        self.mass.resize(places, [0.0; CLASSES]);
        // After a return the forecast starts at the return.
        let mut at_s = 0.0;
        match from.here {
            Some(here) => self.mass[here][usize::from(time_class(from.spent_s))] = 1.0,
            None => {
                at_s = -from.spent_s.clamp(0.0, FARTHEST_S);
                let led = &self.leads[elsewhere * places..];
                self.mass.iter_mut().zip(led).for_each(|(mass, led)| mass[0] = *led);
            }
        }
        let farthest_s = horizons_s.last().map_or(0.0, |horizon_s| horizon_s.min(FARTHEST_S));
        self.rate(view, now_s, from, usize::from(time_class(farthest_s - at_s.min(0.0))));
        self.step_until(&mut at_s, 0.0);
        if from.here.is_none() {
            // The person has not left again until now.
            self.mass[elsewhere] = [0.0; CLASSES];
        }
        for horizon_s in horizons_s {
            self.step_until(&mut at_s, horizon_s.min(FARTHEST_S));
            out.extend(self.mass.iter().map(|mass| mass.iter().sum::<f64>()));
            let begin = out.len() - places;
            normalise(&mut out[begin..]);
        }
    }

    /// Appends the destinations of a place.
    fn lead(&mut self, view: &View<'_>, place: usize, now_s: f64) {
        let places = view.home.places();
        let begin = self.leads.len();
        self.leads.resize(begin + places, 1.0);
        let row = &mut self.leads[begin..];
        row[place] = 0.0;
        normalise(row);
        let context = Context::of_stay(view.home.places.number(place).unwrap_or(NONE), 0, now_s);
        let index = |number| view.home.places.index(number).filter(|other| *other != place);
        for level in &EXIT {
            view.smooth(level, &context, index, row);
        }
    }

    /// Computes the rates of leaving for the ages that stays can have.
    fn rate(&mut self, view: &View<'_>, now_s: f64, from: Stay, newest: usize) {
        let places = view.home.places();
        self.rates.clear();
        self.rates.resize(places, [0.0; CLASSES]);
        let oldest = usize::from(time_class(from.spent_s));
        for (place, rates) in self.rates.iter_mut().enumerate() {
            let number = view.home.places.number(place).unwrap_or(NONE);
            let scale_s = if number == ELSEWHERE { SHIPPED_AWAY_S } else { SHIPPED_STAY_S };
            for (age, rate) in rates.iter_mut().enumerate() {
                if age > newest && (Some(place) != from.here || age < oldest) {
                    continue;
                }
                let [begin_s, end_s] = class_s(age);
                *rate = 2.0 / (scale_s + 0.5 * (begin_s + end_s));
                let context = Context::of_stay(number, age as u16, now_s);
                for (seen, _) in stay_parts(number).iter().flat_map(|part| view.seen(*part, &context)) {
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
pub(crate) fn stay_parts(place: u16) -> &'static [Part] {
    const ALL: &[Part] = &[Part::Stay, Part::StayByPlace, Part::StayByHour];
    if place == ELSEWHERE { &ALL[1..] } else { ALL }
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
