//! How good the forecasts of the last week were.

use std::collections::VecDeque;

use roomcast_ipc::raw::{PersonForecastV1, PersonForecastsV1, PersonScoresV1};
use serde_json::{Value, json};

/// A probability with the digits that the page needs.
pub(super) fn short(p: f64) -> f64 {
    (p * 1e4).round() / 1e4
}

/// A person's most probable room now, and its probability.
pub(super) fn likeliest(told: &PersonForecastsV1, own: &PersonForecastV1) -> Option<(usize, f32)> {
    let now = (0..told.rooms().len()).filter_map(|room| Some((room, *own.probability.get(room)?.first()?)));
    now.max_by(|a, b| a.1.total_cmp(&b.1))
}

/// The quality of forecasts: the probability that the forecast of 15 minutes before gave to the observed room. Unobserved rooms are not compared, or
/// the forecast would be its own judge.
#[derive(Debug, Default)]
pub(super) struct Quality {
    /// Forecasts a minute apart, the newest last.
    samples: VecDeque<(u64, Box<PersonForecastsV1>)>,
    /// Per hour, the newest last: its number, the sum of probabilities, and their count.
    hours: VecDeque<(u64, f64, u64)>,
}

impl Quality {
    const AHEAD_S: f32 = 900.0;
    const AHEAD_NS: u64 = 900_000_000_000;
    const MINUTE_NS: u64 = 60_000_000_000;
    const HOUR_NS: u64 = 3_600_000_000_000;
    /// A week.
    const HOURS: usize = 168;
    /// Least probability of a room that counts as known.
    const KNOWN: f32 = 0.9;

    pub(super) fn take(&mut self, now: &PersonForecastsV1, persons: Option<&PersonScoresV1>, taken_ns: u64) {
        if self.samples.back().is_some_and(|(then_ns, _)| taken_ns.saturating_sub(*then_ns) < Self::MINUTE_NS) {
            return;
        }
        let is_old = |then_ns: u64| taken_ns.saturating_sub(then_ns) >= Self::AHEAD_NS + Self::MINUTE_NS;
        while self.samples.front().is_some_and(|(then_ns, _)| is_old(*then_ns)) {
            self.samples.pop_front();
        }
        let before = self.samples.front().filter(|(then_ns, _)| taken_ns.saturating_sub(*then_ns) >= Self::AHEAD_NS);
        if let Some((_, before)) =
            before.filter(|(_, before)| before.room_count == now.room_count && before.id == now.id)
        {
            let observed = |person: &&PersonForecastV1| {
                let told = persons.filter(|told| told.epoch == now.epoch).map_or(&[][..], PersonScoresV1::persons);
                let own = told.iter().find(|own| own.person == person.person).filter(|own| own.observed_ns > 0);
                own.is_some_and(|own| now.computed_ns.saturating_sub(own.observed_ns) <= Self::MINUTE_NS)
            };
            let given = now.persons().iter().filter(observed).filter_map(|person| Self::given(before, now, person));
            let (sum, count) = given.fold((0.0, 0), |(sum, count), p| (sum + f64::from(p), count + 1));
            let hour = taken_ns / Self::HOUR_NS;
            match self.hours.back_mut() {
                _ if count == 0 => {}
                Some(last) if last.0 == hour => (last.1, last.2) = (last.1 + sum, last.2 + count),
                _ => self.hours.push_back((hour, sum, count)),
            }
            if self.hours.len() > Self::HOURS {
                self.hours.pop_front();
            }
        }
        self.samples.push_back((taken_ns, Box::new(*now)));
    }

    /// The probability that the earlier forecast gave to a person's present place.
    fn given(before: &PersonForecastsV1, now: &PersonForecastsV1, person: &PersonForecastV1) -> Option<f32> {
        let horizon = before.horizons_s().iter().position(|horizon_s| *horizon_s == Self::AHEAD_S)?;
        let then = before.persons().iter().find(|then| then.person == person.person)?;
        if person.elsewhere[0] >= Self::KNOWN {
            return then.elsewhere.get(horizon).copied();
        }
        let (room, _) = likeliest(now, person).filter(|(_, p)| *p >= Self::KNOWN)?;
        then.probability.get(room)?.get(horizon).copied()
    }

    pub(super) fn curve(&self) -> Vec<Value> {
        self.hours.iter().map(|(_, sum, count)| json!({"p": short(sum / *count as f64), "n": count})).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forecast_is_compared_with_where_people_then_are() {
        let mut quality = Quality::default();
        let mut told =
            PersonForecastsV1 { epoch: 1, room_count: 2, person_count: 1, horizon_count: 2, ..Default::default() };
        told.horizon_s[1] = 900.0;
        told.person[0].probability[0][..2].copy_from_slice(&[0.95, 0.25]);
        told.person[0].probability[1][..2].copy_from_slice(&[0.05, 0.5]);
        let mut persons = PersonScoresV1 { epoch: 1, person_count: 1, ..Default::default() };
        for minute in 0..15 {
            quality.take(&told, Some(&persons), minute * Quality::MINUTE_NS);
            assert!(quality.curve().is_empty(), "{minute}");
        }
        let mut at = |quality: &mut Quality, minute: u64, told: &PersonForecastsV1, observed: u64| {
            persons.person[0].observed_ns = observed * Quality::MINUTE_NS;
            let mut told = *told;
            told.computed_ns = minute * Quality::MINUTE_NS;
            quality.take(&told, Some(&persons), minute * Quality::MINUTE_NS);
        };
        at(&mut quality, 15, &told, 15);
        // Unobserved beliefs and uncertain observations are not compared.
        at(&mut quality, 16, &told, 14);
        at(&mut quality, 17, &told, 0);
        told.person[0].probability[0][0] = 0.5;
        at(&mut quality, 18, &told, 18);
        told.person[0].elsewhere[0] = 1.0;
        at(&mut quality, 19, &told, 19);
        assert_eq!(quality.curve(), [json!({"p": 0.125, "n": 2})]);
        for minute in (0..200).flat_map(|hour| [20 + 60 * hour, 35 + 60 * hour]) {
            at(&mut quality, minute, &told, minute);
        }
        assert_eq!(quality.curve().len(), Quality::HOURS);
        assert!(quality.samples.len() <= 17);
    }
}
