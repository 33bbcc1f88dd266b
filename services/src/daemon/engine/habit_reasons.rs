//! How habits change a person's forecast, for `explain` and the views.

use roomcast_core::habits::WhenShares;
use roomcast_core::ids::{BootNs, PersonId};
use roomcast_core::scorer::LanguageModel;
use roomcast_ipc::raw::{LEARNED_SHARE_S, RoomV1};

use super::{Engine, HORIZONS_S};
use crate::daemon::habits::PlaceSet;
use crate::habits_reason::{ELSEWHERE, HorizonLine, PersonHabits, RoomReason, ThingReason};
use crate::moment::Moment;

/// Most things in an explanation by habits.
const REASONS: usize = 12;

impl<M: LanguageModel> Engine<M> {
    /// The data behind the newest scores, and the habits, with the forecasts of `now_ns`.
    #[must_use]
    pub fn moment(&mut self, now_ns: BootNs) -> Moment {
        self.forecast(now_ns);
        let names = self
            .attribution
            .persons
            .iter()
            .filter_map(|(person, _)| Some((person, self.attribution.persons.name_of(person)?.to_owned())));
        let known = self.home.persons().into_iter().map(|(person, _)| person);
        let known = known.filter(|person| self.attribution.persons.get(*person).is_some());
        Moment {
            names: names.collect(),
            habits: known.map(|person| self.habits_of(person)).collect(),
            ..Moment::of(&self.scoring.pipeline, &self.map.map, &self.map.options, Some(&self.publication.snapshot))
        }
    }

    /// The parts of a person's latest forecast, with the room sets, for some horizons.
    pub(in crate::daemon) fn habits_ahead(&self, person: PersonId) -> Vec<HorizonLine> {
        let (Some((sure, shares)), Some((_, sets))) = (self.home.shares(person), self.home.sets(person)) else {
            return Vec::new();
        };
        let Some(probabilities) = self.home.probabilities(person) else { return Vec::new() };
        let rooms = self.publication.snapshot.rooms();
        let told = HORIZONS_S.iter().zip(shares.iter().zip(sets).zip(probabilities));
        let told = told.filter(|(horizon_s, _)| LEARNED_SHARE_S.contains(horizon_s));
        let line = |(horizon_s, ((shares, set), row)): (&f32, ((&WhenShares, &PlaceSet), &[f64]))| {
            let of_places = row.split_last().map(|(elsewhere, known)| {
                let of_rooms = known.iter().enumerate().filter(|(room, _)| set.rooms >> room & 1 == 1);
                of_rooms.map(|(_, p)| p).chain(set.elsewhere.then_some(elsewhere)).sum()
            });
            let held = rooms.iter().enumerate().filter(|(room, _)| set.rooms >> room & 1 == 1);
            let held = held.map(|(_, room)| room.id().to_owned());
            HorizonLine {
                horizon_s: f64::from(*horizon_s),
                shipped: 1.0 - sure + sure * shares.shipped,
                leaving: sure * shares.leaving,
                later: sure * shares.later,
                set: held.chain(set.elsewhere.then(|| ELSEWHERE.to_owned())).collect(),
                set_probability: of_places,
            }
        };
        told.map(line).collect()
    }

    /// The part of habits in a person's latest forecast.
    fn habits_of(&self, person: PersonId) -> PersonHabits {
        let labels = self.scoring.pipeline.grounding().label_texts();
        let thing = |(label, text): (usize, &&str)| {
            Some(ThingReason { label: (*text).to_owned(), shares: self.home.why_thing(person, label)? })
        };
        let mut things: Vec<_> = labels.iter().enumerate().filter_map(thing).collect();
        things.sort_by(|a, b| b.shares.probability.total_cmp(&a.shares.probability));
        things.truncate(REASONS);
        let room = |(index, room): (usize, &RoomV1)| {
            Some(RoomReason { room: room.id().to_owned(), shares: self.home.why_room(person, index)? })
        };
        let mut rooms: Vec<_> = self.publication.snapshot.rooms().iter().enumerate().filter_map(room).collect();
        rooms.sort_by(|a, b| b.shares.probability.total_cmp(&a.shares.probability));
        PersonHabits {
            person,
            observations: self.home.observations_of(person),
            things,
            rooms,
            forecast: self.habits_ahead(person),
            coverage: self.home.sets(person).map_or(0.0, |(coverage, _)| coverage),
        }
    }
}
