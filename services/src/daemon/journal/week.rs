//! The last seven days: the rooms that events of each person name.

use std::path::Path;

use roomcast_database::rusqlite::Result;

use super::FILE;

/// The events of a person on a day that name a room.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct PersonDay {
    /// The date, in local time.
    pub day: String,
    /// The person's newest name, or number.
    pub person: String,
    /// Each room with the number of its events, most first.
    pub rooms: Vec<(String, u64)>,
}

impl PersonDay {
    /// The same with the map's names: narrators name a room by its id, a name or an alias. A room without a name keeps the narrator's.
    #[must_use]
    pub fn named(&self, name_of: impl Fn(&str) -> Option<String>) -> Self {
        let mut rooms = Vec::<(String, u64)>::new();
        for (said, events) in &self.rooms {
            let name = name_of(said).unwrap_or_else(|| said.clone());
            match rooms.iter_mut().find(|(own, _)| *own == name) {
                Some((_, all)) => *all += events,
                None => rooms.push((name, *events)),
            }
        }
        rooms.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Self { rooms, ..self.clone() }
    }
}

/// The last seven days in the database of a state directory, also while a daemon uses it. Newest first.
///
/// # Errors
/// When there is none, or it cannot be read.
pub fn week(directory: &Path) -> Result<Vec<PersonDay>> {
    let database = roomcast_database::look(&directory.join(FILE))?;
    let mut query = database.prepare(
        "SELECT date(at, 'unixepoch', 'localtime') AS day, CAST(person AS TEXT), room, count(*) FROM person_room
         WHERE at > unixepoch('now', '-8 days') AND day > date('now', 'localtime', '-7 days')
         GROUP BY 1, 2, 3 ORDER BY 1 DESC, 2, 4 DESC, 3",
    )?;
    let mut days = Vec::<PersonDay>::new();
    let mut rows = query.query([])?;
    while let Some(row) = rows.next()? {
        let (day, person, room) = (row.get(0)?, row.get(1)?, (row.get(2)?, row.get::<_, i64>(3)?.cast_unsigned()));
        match days.last_mut().filter(|last| last.day == day && last.person == person) {
            Some(last) => last.rooms.push(room),
            None => days.push(PersonDay { day, person, rooms: vec![room] }),
        }
    }
    Ok(days)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_of_one_room_are_one_room() {
        let rooms =
            [("hall", 4), ("Küche", 3), ("kitchen-1", 2), ("attic", 1)].map(|(room, events)| (room.to_owned(), events));
        let day = PersonDay { day: "2026-11-30".to_owned(), person: "Mira".to_owned(), rooms: rooms.to_vec() };
        let named = day.named(|said| ["Küche", "kitchen-1"].contains(&said).then(|| "kitchen".to_owned()));
        let expected = [("kitchen", 5), ("hall", 4), ("attic", 1)].map(|(room, events)| (room.to_owned(), events));
        assert_eq!(named.rooms, expected);
    }
}
