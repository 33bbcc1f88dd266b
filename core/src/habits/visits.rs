//! Visits to each room by part of the day, of all persons together, so that they identify no person.

use super::Habits;
use super::context::{PARTS, minute};
use super::parts::{NONE, Part, key};

impl Habits {
    /// Per room of the bound map, decayed number of visits that ended in each part of the day.
    #[must_use]
    pub fn visits(&self, now_s: f64) -> Vec<[f64; PARTS]> {
        let now_min = minute(now_s);
        let ended = |place: u16, part: u16| -> f64 {
            let of = |slot| self.counts.get(key(Part::ExitByHour, slot, [place, part, NONE]), now_min);
            let seen = self.persons.iter().filter_map(|person| of(person.slot));
            seen.map(|seen| seen.symbols().map(|(_, count)| count).sum::<f64>()).sum()
        };
        let room = |room| {
            let place = self.home.places.number(room);
            std::array::from_fn(|part| place.map_or(0.0, |place| ended(place, part as u16)))
        };
        (0..self.home.rooms()).map(room).collect()
    }
}
