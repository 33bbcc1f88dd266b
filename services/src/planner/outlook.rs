//! A planner's view of persons: the probability of a person in each room next, now, and in each future slot.

use roomcast_core::ids::BootNs;
use roomcast_ipc::raw::probability_at;
use roomcast_ipc::raw::{ForecastV1, PersonForecastsV1, RoomScoresV1, decision_flags, forecast_flags, score_flags};

/// A forecast that matches the scores: it is fresh, and of the same daemon and rooms.
#[derive(Debug, Clone, Copy)]
pub(super) struct Forecast<'a> {
    message: &'a ForecastV1,
    age_s: f64,
}

impl<'a> Forecast<'a> {
    pub(super) fn usable(
        message: Option<&'a ForecastV1>,
        scores: &RoomScoresV1,
        now_ns: BootNs,
        deadline_ns: u64,
    ) -> Option<Self> {
        let message = message.filter(|forecast| {
            forecast.epoch == scores.epoch
                && now_ns.since(BootNs(forecast.published_ns)) <= deadline_ns
                && forecast.room_count == scores.room_count
                && forecast.horizon_count > 0
                && scores.rooms().iter().enumerate().all(|(index, room)| forecast.id[index] == room.id)
        })?;
        Some(Self { message, age_s: now_ns.since(BootNs(message.computed_ns)) as f64 / 1e9 })
    }

    /// No person is known: its rooms have no meaning.
    pub(super) fn knows_nobody(&self) -> bool {
        self.message.has(forecast_flags::NOT_KNOWN)
    }

    pub(super) fn misses_resident(&self) -> bool {
        self.message.has(forecast_flags::RESIDENT_UNKNOWN)
    }

    /// The probability of an empty house in so many seconds.
    pub(super) fn nobody_home(&self, ahead_s: f64) -> f64 {
        probability_at(&self.message.horizon_s, &self.message.elsewhere, self.age_s + ahead_s)
    }

    /// The least value of a curve over the next seconds, at the forecast's horizons and at the end.
    pub(super) fn least(&self, for_s: f64, of: impl Fn(f64) -> f64) -> f64 {
        let horizons = self.message.horizon_s.iter().take(self.message.horizon_count as usize);
        let within = horizons.map(|horizon_s| f64::from(*horizon_s) - self.age_s);
        let within = within.filter(|at_s| (0.0..for_s).contains(at_s)).chain([0.0, for_s]);
        within.map(of).fold(1.0, f64::min)
    }

    /// The probability of a person in a room in so many seconds.
    pub(super) fn likely(&self, room: usize, ahead_s: f64) -> f64 {
        let row = self.message.probability.get(room);
        row.map_or(0.0, |row| probability_at(self.message.horizons_s(), row, self.age_s + ahead_s))
    }

    pub(super) fn now(&self) -> Vec<f64> {
        (0..self.message.room_count as usize).map(|room| self.likely(room, 0.0)).collect()
    }
}

/// The scores' rooms in the set of any person at any time of a stay that begins now. `None` without matching sets: they are stale, of fewer
/// narrations, or of other rooms. A person without observations has no set.
pub(super) fn in_sets(
    sets: Option<&PersonForecastsV1>,
    scores: &RoomScoresV1,
    (now_ns, deadline_ns): (BootNs, u64),
    stay_s: f64,
) -> Option<Vec<bool>> {
    let rooms = scores.rooms();
    let sets = sets.filter(|sets| {
        sets.epoch == scores.epoch
            && sets.sequence >= scores.sequence
            && now_ns.since(BootNs(sets.published_ns)) <= deadline_ns
            && sets.room_count == scores.room_count
            && rooms.iter().zip(&sets.id).all(|(room, id)| *id == room.id)
    })?;
    let begin_s = now_ns.since(BootNs(sets.computed_ns)) as f64 / 1e9;
    let grid = sets.horizons_s();
    let at = |index: usize| f64::from(grid[index]);
    // From the last point before the stay to the first one after it.
    let first = (0..grid.len()).rev().find(|index| at(*index) <= begin_s).unwrap_or(0);
    let last = (0..grid.len()).find(|index| at(*index) >= begin_s + stay_s).unwrap_or(grid.len().saturating_sub(1));
    let horizons = || first..(last + 1).min(grid.len());
    let persons = sets.persons();
    let held = |room: usize| persons.iter().any(|own| horizons().any(|h| own.set_holds(h, room) == Some(true)));
    Some((0..rooms.len()).map(held).collect())
}

/// The knowledge of persons: one of [`decision_flags`], or 0 if a person is known and may be home.
pub(super) fn what_is_known(scores: &RoomScoresV1, forecast: Option<Forecast<'_>>) -> u32 {
    let not_known = forecast.map_or(scores.has(score_flags::NO_NARRATION), |forecast| forecast.knows_nobody());
    let nobody_home = forecast
        .map_or(scores.has(score_flags::NOBODY_HOME), |forecast| forecast.message.has(forecast_flags::NOBODY_HOME));
    match (not_known, nobody_home) {
        (true, _) => decision_flags::NOT_KNOWN,
        (false, true) => decision_flags::NOBODY_HOME,
        (false, false) => 0,
    }
}

#[derive(Debug)]
pub(super) struct Outlook {
    /// By room, the probability of a person there next.
    pub(super) likely: Vec<f64>,
    /// The expected time in seconds of a robot with persons in each room in each remaining slot, slot by slot. Empty without a forecast or
    /// a time to stay.
    pub(super) shared_s: Vec<f64>,
    pub(super) flags: u32,
    /// A resident is missing from the probabilities.
    pub(super) misses_resident: bool,
}

impl Outlook {
    pub(super) fn new(scores: &RoomScoresV1, forecast: Option<Forecast<'_>>, stay_s: f64, slots: usize) -> Self {
        let rooms = scores.rooms().len();
        // A robot that decides with every score has no time to share.
        let slots = if stay_s > 0.0 { slots } else { 0 };
        let flags = what_is_known(scores, forecast);
        if flags == decision_flags::NOT_KNOWN {
            // The model's scores after an unknown past are not about persons of this home: every room counts alike.
            let alike = 1.0 / rooms.max(1) as f64;
            let shared_s = vec![alike * stay_s; if forecast.is_some() { slots * rooms } else { 0 }];
            return Self { likely: vec![alike; rooms], shared_s, flags, misses_resident: false };
        }
        // Without an observed person the scores are of an unknown past; the sensors' forecast is of this home.
        let likely = match forecast.filter(|_| scores.has(score_flags::NO_NARRATION)) {
            Some(forecast) => forecast.now(),
            None => scores.rooms().iter().map(|room| room.probability).collect(),
        };
        let shared_s = forecast.map(|forecast| {
            let places = (0..slots).flat_map(|slot| (0..rooms).map(move |room| (slot, room)));
            places.map(|(slot, room)| stay_s * forecast.likely(room, (slot as f64 + 0.5) * stay_s)).collect()
        });
        let misses_resident = forecast.is_some_and(|forecast| forecast.misses_resident());
        Self { likely, shared_s: shared_s.unwrap_or_default(), flags, misses_resident }
    }

    /// The probability of a person in a room during a stay that begins now, if there is a forecast.
    pub(super) fn over_stay(&self, room: usize, stay_s: f64) -> Option<f64> {
        Some((self.shared_s.get(room)? / stay_s).clamp(0.0, 1.0))
    }

    pub(super) fn has(&self, flag: u32) -> bool {
        self.flags & flag != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use roomcast_ipc::text;

    #[test]
    fn a_room_is_in_a_set_if_any_person_may_be_there_during_the_stay() {
        let mut scores = RoomScoresV1 { epoch: 1, room_count: 3, ..Default::default() };
        let mut sets =
            PersonForecastsV1 { epoch: 1, room_count: 3, horizon_count: 3, person_count: 2, ..Default::default() };
        for (room, id) in ["kitchen", "bathroom", "hall"].into_iter().enumerate() {
            scores.room[room].id = text::encode("id", id).unwrap();
            sets.id[room] = scores.room[room].id;
        }
        sets.horizon_s[..3].copy_from_slice(&[0.0, 60.0, 600.0]);
        (sets.person[0].set_coverage, sets.person[1].set_coverage) = (0.9, 0.9);
        sets.person[0].room_set[..3].copy_from_slice(&[0b001, 0b001, 0b011]);
        sets.person[1].set_elsewhere = 0b111;
        (scores.sequence, sets.sequence) = (4, 4);
        let of =
            |sets: &PersonForecastsV1, now_ns, stay_s| in_sets(Some(sets), &scores, (now_ns, 2_000_000_000), stay_s);
        assert_eq!(of(&sets, BootNs(0), 60.0), Some(vec![true, false, false]));
        assert_eq!(of(&sets, BootNs(0), 61.0), Some(vec![true, true, false]));
        assert_eq!(of(&sets, BootNs(1_000_000_000), 60.0), Some(vec![true, true, false]), "the sets are a second old");
        assert_eq!(of(&sets, BootNs(3_000_000_000), 60.0), None, "they are too old");
        sets.person[1].room_set[0] = 0b100;
        assert_eq!(of(&sets, BootNs(0), 60.0), Some(vec![true, false, true]));
        sets.person[1].set_coverage = 0.0;
        assert_eq!(of(&sets, BootNs(0), 60.0), Some(vec![true, false, false]));
        assert_eq!(
            of(&PersonForecastsV1 { sequence: 5, ..sets }, BootNs(0), 60.0),
            of(&sets, BootNs(0), 60.0),
            "they know more"
        );
        assert_eq!(
            of(&PersonForecastsV1 { sequence: 3, ..sets }, BootNs(0), 60.0),
            None,
            "they are of the event before"
        );
        assert_eq!(of(&PersonForecastsV1 { epoch: 2, ..sets }, BootNs(0), 60.0), None, "they are another daemon's");
        assert_eq!(in_sets(None, &scores, (BootNs(0), 2_000_000_000), 60.0), None, "there are none");
        sets.id[1] = text::encode("id", "attic").unwrap();
        assert_eq!(of(&sets, BootNs(0), 60.0), None, "they are of other rooms");
    }

    #[test]
    fn the_forecast_of_sensors_counts_before_a_person_is_observed() {
        let mut scores =
            RoomScoresV1 { epoch: 1, room_count: 2, flags: score_flags::NO_NARRATION, ..Default::default() };
        (scores.room[0].probability, scores.room[1].probability) = (0.5, 0.5);
        let mut sent = ForecastV1 { epoch: 1, room_count: 2, horizon_count: 1, published_ns: 10, ..Default::default() };
        for (room, id) in ["kitchen", "hall"].into_iter().enumerate() {
            scores.room[room].id = text::encode("id", id).unwrap();
            sent.id[room] = scores.room[room].id;
        }
        (sent.probability[0][0], sent.flags) = (1.0, forecast_flags::RESIDENT_UNKNOWN);
        let likely = |sent: &ForecastV1| {
            let forecast = Forecast::usable(Some(sent), &scores, BootNs(10), 1);
            Outlook::new(&scores, forecast, 60.0, 1).likely
        };
        assert_eq!(likely(&sent), [1.0, 0.0]);
        assert_eq!(likely(&ForecastV1 { flags: forecast_flags::NOT_KNOWN, ..sent }), [0.5, 0.5]);
    }

    /// The daemon sends a forecast again with each heartbeat.
    #[test]
    fn a_forecast_that_is_sent_again_is_read_at_its_age() {
        const S: u64 = 1_000_000_000;
        let mut scores = RoomScoresV1 { epoch: 1, room_count: 1, ..Default::default() };
        scores.room[0].id = text::encode("id", "kitchen").unwrap();
        let mut sent =
            ForecastV1 { epoch: 1, room_count: 1, horizon_count: 2, published_ns: 10 * S, ..Default::default() };
        sent.id[0] = scores.room[0].id;
        sent.horizon_s[1] = 20.0;
        sent.probability[0][1] = 1.0;
        let forecast = Forecast::usable(Some(&sent), &scores, BootNs(10 * S), S).unwrap();
        assert!((forecast.likely(0, 0.0) - 0.5).abs() < 1e-6 && (forecast.likely(0, 10.0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn curves_are_straight_between_their_points_and_flat_beyond() {
        let value = |at| probability_at(&[10.0, 20.0], &[0.2, 0.4], at);
        assert!(
            (value(0.0) - 0.2).abs() < 1e-6 && (value(15.0) - 0.3).abs() < 1e-6 && (value(99.0) - 0.4).abs() < 1e-6
        );
    }
}
