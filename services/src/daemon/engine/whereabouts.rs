//! "Why is Jon in the hallway?": the belief about a person, and the events that moved it most.

use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::scorer::LanguageModel;
use roomcast_core::tracker::Cause;

use super::super::person_question::{NoisySensor, PlaceLine, UnderstoodPerson, Whereabouts, WhyLine};
use super::tracking::Tracking;
use super::{Engine, seconds};
use crate::habits_reason::ELSEWHERE;

/// Less probable places are left out.
const LEAST: f64 = 0.005;
/// Limits of the change of the log-odds by an event. Below the first limit the event is called weak, below the second clear, else strong.
const CLEAR: (f64, f64) = (0.7, 2.0);

impl<M: LanguageModel> Engine<M> {
    /// Where a person is believed to be at a time, as in their published forecast, and why.
    pub(in crate::daemon) fn whereabouts(&mut self, person: PersonId, now_ns: BootNs) -> Whereabouts {
        self.forecast(now_ns);
        let rooms: Vec<String> = self.publication.snapshot.rooms().iter().map(|room| room.id().to_owned()).collect();
        let own = self.belief.forecasters().get(&person).or_else(|| self.belief.followed.get(&person));
        let tracking = self.belief.tracking.as_deref();
        let now: Vec<f64> = match own {
            Some(own) => {
                self.publication.house.fill_rows((person, own), &mut self.home, now_ns);
                // The first horizon is now.
                let now = self.publication.house.by_horizon().take(1);
                now.flat_map(|(gone, known)| known.iter().copied().chain([gone])).collect()
            }
            None => {
                let places = (0..rooms.len()).map(Some).chain([None]);
                places.map(|room| tracking.map_or(0.0, |own| own.probability(person, room))).collect()
            }
        };
        let mut places: Vec<PlaceLine> = Vec::new();
        for (room, (id, probability)) in rooms.iter().map(String::as_str).chain([ELSEWHERE]).zip(now).enumerate() {
            if probability >= LEAST {
                let room = (room < rooms.len()).then_some(room);
                let why = tracking.map(|own| self.why(own, person, room, now_ns)).unwrap_or_default();
                places.push(PlaceLine { place: id.to_owned(), probability, why });
            }
        }
        places.sort_by(|a, b| b.probability.total_cmp(&a.probability));
        let filter = tracking.map(Tracking::now);
        let noisy =
            |(id, per_day, usual_per_day): (&str, f64, f64)| NoisySensor { id: id.to_owned(), per_day, usual_per_day };
        Whereabouts {
            person: self.called(person),
            places,
            house_empty: filter
                .map_or_else(|| f64::from(self.publication.forecast.elsewhere[0]), |own| own.house_empty()),
            visited: filter.map_or(0.0, |own| own.visitors(1)),
            visited_by_two: filter.map_or(0.0, |own| own.visitors(2)),
            is_joint: tracking.is_some(),
            is_followed: tracking.is_some_and(|own| own.follows(person)),
            noisy: tracking.map(|own| own.noisy().map(noisy).collect()).unwrap_or_default(),
        }
    }

    fn called(&self, person: PersonId) -> UnderstoodPerson {
        UnderstoodPerson { person, name: self.attribution.persons.name_of(person).map(str::to_owned) }
    }

    fn why(&self, tracking: &Tracking, person: PersonId, room: Option<usize>, now_ns: BootNs) -> Vec<WhyLine> {
        let now_s = seconds(i64::try_from(now_ns.0).unwrap_or(i64::MAX));
        let line = |own: roomcast_core::tracker::Reason| {
            let sensor = match own.cause {
                Cause::Sensor { sensor, on } => {
                    tracking.device(sensor).map(|(id, kind)| format!("{kind} {id} {}", if on { "on" } else { "off" }))
                }
                _ => None,
            };
            let what = match own.cause {
                Cause::Sensor { .. } => "sensor",
                Cause::Action => "did",
                Cause::Present => "present",
                Cause::Away => "away",
                Cause::Empty => "empty",
                Cause::Count => "count",
            };
            let weight = match own.log_odds.abs() {
                moved if moved < CLEAR.0 => "weak",
                moved if moved < CLEAR.1 => "clear",
                _ => "strong",
            };
            let other = own.other.and_then(|(index, _)| tracking.persons().get(index));
            WhyLine {
                what: what.to_owned(),
                sensor,
                ago_s: (now_s - own.at_s).max(0.0),
                log_odds: own.log_odds,
                weight: weight.to_owned(),
                share: own.share,
                or: other.map(|other| self.called(*other)),
            }
        };
        tracking.why(person, room).map(line).collect()
    }
}
