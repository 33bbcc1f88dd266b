//! Facts for the rules of the house, from scores, forecasts, orders and the map.

use roomcast_core::ids::BootNs;
use roomcast_core::narration::same_but_for_accents;
use roomcast_ipc::raw::probability_at;
use roomcast_ipc::raw::{
    MAX_ROOMS, PersonForecastV1, PersonForecastsV1, RoomScoresV1, decision_flags, person_flags, presence,
};

use super::outlook::{Forecast, what_is_known};
use super::rules::{Facts, RoomSet, Sleeper, Staying};
use crate::config::{OnlyWhen, PlannerConfig, WhileAsleep};

/// A sleeper may be in each room with this probability or more.
const MAY_BE: f64 = 0.1;
/// A person with a higher probability outside is not at home.
const OUTSIDE: f64 = 0.5;

/// The rooms next to each room, and the rooms on its floor. Both contain the room.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Near {
    pub(super) beside: RoomSet,
    pub(super) floor: RoomSet,
}

pub(super) struct Known<'a> {
    pub(super) config: &'a PlannerConfig,
    pub(super) scores: &'a RoomScoresV1,
    pub(super) forecast: Option<Forecast<'a>>,
    pub(super) persons: Option<People<'a>>,
    /// By room; empty without a map.
    pub(super) near: &'a [Near],
    /// By room.
    pub(super) stays_s: Vec<f64>,
}

#[derive(Clone, Copy)]
pub(super) struct People<'a> {
    message: &'a PersonForecastsV1,
    age_s: f64,
}

impl<'a> People<'a> {
    /// The forecasts, if they are fresh and match the scores' daemon and rooms.
    pub(super) fn usable(
        message: Option<&'a PersonForecastsV1>,
        scores: &RoomScoresV1,
        (now_ns, deadline_ns): (BootNs, u64),
    ) -> Option<Self> {
        let message = message.filter(|persons| {
            persons.epoch == scores.epoch
                && now_ns.since(BootNs(persons.published_ns)) <= deadline_ns
                && persons.room_count == scores.room_count
                && persons.horizon_count > 0
                && scores.rooms().iter().zip(&persons.id).all(|(room, id)| room.id == *id)
        })?;
        Some(Self { message, age_s: now_ns.since(BootNs(message.computed_ns)) as f64 / 1e9 })
    }

    fn at_home(&self) -> impl Iterator<Item = &'a PersonForecastV1> {
        let here =
            move |person: &&PersonForecastV1| person.presence == presence::PRESENT && self.out(person) <= OUTSIDE;
        self.message.persons().iter().filter(here)
    }

    fn out(&self, person: &PersonForecastV1) -> f64 {
        probability_at(self.message.horizons_s(), &person.elsewhere, self.age_s)
    }

    fn likely(&self, person: &PersonForecastV1, room: usize, ahead_s: f64) -> f64 {
        let row = person.probability.get(room);
        row.map_or(0.0, |row| probability_at(self.message.horizons_s(), row, self.age_s + ahead_s))
    }

    fn likeliest(&self, person: &PersonForecastV1) -> Option<usize> {
        let rooms = 0..(self.message.room_count as usize).min(MAX_ROOMS);
        rooms.max_by(|a, b| self.likely(person, *a, 0.0).total_cmp(&self.likely(person, *b, 0.0)))
    }

    /// The residents of a list, by name or number, without an observation.
    pub(super) fn lacking(&self, residents: &[String]) -> Vec<String> {
        let is = |person: &PersonForecastV1, who: &str| {
            who.trim().parse() == Ok(person.person) || same_but_for_accents(person.name(), who)
        };
        let known = |who: &&String| !self.message.persons().iter().any(|person| is(person, who));
        residents.iter().filter(known).cloned().collect()
    }

    /// The likeliest person in a room with probability `from` or more, and the time until it is `to` or less.
    fn staying(&self, room: usize, (from, to): (f64, f64)) -> Option<Staying> {
        let likely = |person: &&PersonForecastV1| self.likely(person, room, 0.0);
        let person = self.at_home().max_by(|a, b| likely(a).total_cmp(&likely(b)))?;
        if likely(&person) < from {
            return None;
        }
        let ahead = self.message.horizons_s().iter().map(|horizon_s| f64::from(*horizon_s) - self.age_s);
        let ahead: Vec<f64> = ahead.filter(|ahead_s| *ahead_s > 0.0).collect();
        let leaves = ahead.iter().find(|ahead_s| self.likely(person, room, **ahead_s) <= to);
        let for_s = leaves.or(ahead.last()).copied().unwrap_or_default();
        Some(Staying { name: name_of(person), for_s, is_open: leaves.is_none() })
    }
}

fn name_of(person: &PersonForecastV1) -> String {
    match person.name() {
        "" => format!("person {}", person.person),
        name => name.to_owned(),
    }
}

impl<'a> Known<'a> {
    /// Without orders and residents.
    pub(super) fn facts(&self) -> Facts<'a> {
        let rooms = self.scores.rooms();
        let count = rooms.len();
        let persons = self.persons;
        let levels = (self.config.interrupt_at, self.config.resume_at);
        // Only these rules need a look at the whole forecast.
        let only_when = self.config.only_when;
        Facts {
            config: self.config,
            ids: rooms.iter().map(|room| room.id()).collect(),
            hold: None,
            asked: 0,
            skipped: 0,
            unobserved: None,
            sleepers: persons.map_or_else(Vec::new, |persons| self.sleepers(&persons)),
            at_home: persons.map_or_else(Vec::new, |persons| persons.at_home().map(name_of).collect()),
            missing: Vec::new(),
            house_empty: only_when.map_or((0.0, 0.0), |_| self.house_empty()),
            room_free: only_when.map_or_else(Vec::new, |_| (0..count).map(|room| self.room_free(room)).collect()),
            staying: (0..count).map(|room| persons?.staying(room, levels)).collect(),
        }
    }

    fn sleepers(&self, persons: &People<'_>) -> Vec<Sleeper> {
        let all = |rooms: usize| (0..rooms.min(64)).fold(0, |set, room| set | 1 << room);
        let near = |room: usize| match (self.config.while_asleep, self.near.get(room)) {
            (WhileAsleep::Ignore, _) => 0,
            (WhileAsleep::Room, _) => 1 << room,
            (WhileAsleep::Beside, Some(near)) => near.beside,
            (WhileAsleep::Floor, Some(near)) => near.floor,
            // Without a map every room may be next to the sleeper's.
            _ => all(self.scores.rooms().len()),
        };
        let sleep = |person: &PersonForecastV1| {
            let room = persons.likeliest(person)?;
            let may_be = |other: &usize| *other == room || persons.likely(person, *other, 0.0) >= MAY_BE;
            let near = (0..self.scores.rooms().len()).filter(may_be).fold(0, |set, room| set | near(room));
            Some(Sleeper { name: name_of(person), room, near })
        };
        persons.at_home().filter(|person| person.flags & person_flags::ASLEEP != 0).filter_map(sleep).collect()
    }

    fn is_unsure(&self) -> bool {
        what_is_known(self.scores, self.forecast) == decision_flags::NOT_KNOWN
            || self.forecast.is_some_and(|forecast| forecast.misses_resident())
    }

    /// The probability that the house is empty now, and for all of `min_absence_s`.
    fn house_empty(&self) -> (f64, f64) {
        let is_empty = what_is_known(self.scores, self.forecast) == decision_flags::NOBODY_HOME;
        match self.forecast.filter(|_| !self.is_unsure()) {
            Some(forecast) => {
                let now = forecast.nobody_home(0.0);
                (
                    if is_empty { 1.0 } else { now },
                    forecast.least(self.config.min_absence_s, |at| forecast.nobody_home(at)),
                )
            }
            None if is_empty => (1.0, 0.0),
            None => (0.0, 0.0),
        }
    }

    fn room_free(&self, room: usize) -> (f64, f64) {
        let Some(forecast) = self.forecast.filter(|_| !self.is_unsure()) else { return (0.0, 0.0) };
        let for_s = match self.config.only_when {
            Some(OnlyWhen::RoomFree) => self.config.min_absence_s.max(self.stays_s[room]),
            _ => self.config.min_absence_s,
        };
        let free = |at_s: f64| 1.0 - forecast.likely(room, at_s);
        (free(0.0), forecast.least(for_s, free))
    }
}
