//! Habits as rows. A write changes the rows that differ from the last write, in one transaction, every `habits.save_s`. A killed daemon learns the
//! events since then again, from the rows that are left of them.

use std::collections::BTreeMap;

use roomcast_core::habits::{Habits, HabitsOptions, Stored, StoredName, StoredRow};
use roomcast_core::ids::EventId;
use roomcast_database::rusqlite::types::Type;
use roomcast_database::rusqlite::{Error, OptionalExtension, Result, Row, params};
use roomcast_database::{Transaction, sound};

use crate::daemon::habits::{Heard, Memory};

static NOTHING: Stored =
    Stored { version: 0, objects: Vec::new(), places: Vec::new(), persons: Vec::new(), rows: Vec::new() };

/// All rows of the habits.
#[derive(Debug, Clone, PartialEq)]
pub struct HabitRows {
    /// Without the persons.
    stored: Stored,
    /// Models of persons as JSON, by number.
    persons: BTreeMap<u32, String>,
    /// Time spent was counted until then, in seconds since 1970, local time.
    watched_until_s: f64,
    /// The last learned event of each start of a narrator, the newest last.
    learned: Vec<EventId>,
    /// The checksum is wrong: SQLite does not notice a flipped bit in a number.
    is_damaged: bool,
}

impl HabitRows {
    /// The rows of a memory.
    ///
    /// # Errors
    /// When a person's model cannot be written as JSON: a fault of the program.
    pub fn of(memory: &Memory) -> serde_json::Result<Self> {
        let mut stored = memory.habits.stored();
        let persons = stored.persons.drain(..).map(|person| Ok((person.number, serde_json::to_string(&person)?)));
        let persons = persons.collect::<serde_json::Result<_>>()?;
        let (watched_until_s, learned) = (memory.watched_until_s, memory.heard.names().to_vec());
        Ok(Self { stored, persons, watched_until_s, learned, is_damaged: false })
    }

    /// The memory of these rows.
    ///
    /// # Errors
    /// When the rows are damaged or of another version: the reason.
    pub fn memory(self, options: HabitsOptions) -> std::result::Result<Memory, String> {
        let Self { stored, persons, watched_until_s, learned, is_damaged } = self;
        if is_damaged {
            return Err("their checksum is wrong".to_owned());
        }
        let persons = persons.values().map(|person| serde_json::from_str(person)).collect::<serde_json::Result<_>>();
        let stored = Stored { persons: persons.map_err(|error| error.to_string())?, ..stored };
        let habits = Habits::from_stored(options, stored).map_err(|error| error.to_string())?;
        Ok(Memory { habits, heard: Heard::new(learned), watched_until_s })
    }

    /// Writes the rows that differ from the `before` ones, or all of them in place of others.
    pub(super) fn write(&self, transaction: &Transaction<'_>, before: Option<&Self>) -> Result<()> {
        if before.is_none() {
            transaction.execute_batch("DELETE FROM habit_name; DELETE FROM habit_person; DELETE FROM habit")?;
        }
        let (old, now) = (before.map_or(&NOTHING, |before| &before.stored), &self.stored);
        let mut delete = transaction.prepare_cached("DELETE FROM habit_name WHERE kind = ?1 AND number = ?2")?;
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO habit_name VALUES (?1, ?2, ?3)")?;
        for (kind, old, now) in [("thing", &old.objects, &now.objects), ("place", &old.places, &now.places)] {
            changes((0_u32..).zip(old), (0_u32..).zip(now), |number, name| match name {
                Some(StoredName { name }) => write.execute(params![kind, number, name]).map(|_| ()),
                None => delete.execute(params![kind, number]).map(|_| ()),
            })?;
        }
        let mut delete = transaction.prepare_cached("DELETE FROM habit_person WHERE person = ?1")?;
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO habit_person VALUES (?1, ?2)")?;
        let old_persons = before.into_iter().flat_map(|before| &before.persons);
        changes(old_persons, self.persons.iter(), |person, model| match model {
            Some(model) => write.execute(params![person, model]).map(|_| ()),
            None => delete.execute([person]).map(|_| ()),
        })?;
        let mut delete = transaction.prepare_cached("DELETE FROM habit WHERE context = ?1")?;
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO habit VALUES (?1, ?2, ?3)")?;
        let by_context = |row| (context(row), row);
        let (old, now) = (old.rows.iter().map(by_context), now.rows.iter().map(by_context));
        changes(old, now, |context, row| match row {
            Some(StoredRow { touched_min, counts, .. }) => {
                let counts = serde_json::to_string(counts).unwrap_or_default();
                write.execute(params![context, touched_min, counts]).map(|_| ())
            }
            None => delete.execute([context]).map(|_| ()),
        })?;
        transaction.execute("DELETE FROM learned", [])?;
        let mut write = transaction.prepare_cached("INSERT INTO learned VALUES (?1, ?2, ?3, ?4)")?;
        for (place, EventId { source, epoch, sequence }) in (0_i64..).zip(&self.learned) {
            write.execute(params![source.cast_signed(), epoch.cast_signed(), sequence.cast_signed(), place])?;
        }
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO meta VALUES (?1, ?2)")?;
        write.execute(params!["habits_version", self.stored.version])?;
        write.execute(params!["habits_until_s", self.watched_until_s])?;
        write.execute(params!["habits_checksum", self.checksum()]).map(|_| ())
    }

    fn checksum(&self) -> u32 {
        let Self { stored: Stored { version, objects, places, rows, .. }, persons, watched_until_s, learned, .. } =
            self;
        let kinds = [objects, places].into_iter().enumerate();
        let names: BTreeMap<_, _> = kinds
            .flat_map(|(kind, names)| (0_u32..).zip(names).map(move |(number, own)| ((kind, number), &own.name)))
            .collect();
        let few = format!("{version} {} {names:?} {persons:?} {learned:?}", watched_until_s.to_bits());
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(few.as_bytes());
        for StoredRow { kind, slot, after, touched_min, counts } in rows {
            for (symbol, count) in counts {
                hasher.update(&[*kind, *slot]);
                after.iter().chain([symbol]).for_each(|number| hasher.update(&number.to_le_bytes()));
                hasher.update(&count.to_le_bytes());
                hasher.update(&touched_min.to_le_bytes());
            }
        }
        hasher.finalize()
    }

    /// The rows that were read have a wrong checksum or a value that no sound row has.
    pub(super) fn is_damaged(&self) -> bool {
        self.is_damaged
    }

    /// Reads the rows; `None` if habits were never written.
    pub(super) fn read(transaction: &Transaction<'_>) -> Result<Option<Self>> {
        let (persons, learned) = Default::default();
        let damaged = Self { stored: NOTHING.clone(), persons, watched_until_s: 0.0, learned, is_damaged: true };
        Ok(sound(Self::rows(transaction))?.unwrap_or(Some(damaged)))
    }

    fn rows(transaction: &Transaction<'_>) -> Result<Option<Self>> {
        let mut meta = transaction.prepare("SELECT value FROM meta WHERE key = ?1")?;
        let Some(version) = meta.query_row(["habits_version"], |row| row.get(0)).optional()? else { return Ok(None) };
        let watched_until_s = meta.query_row(["habits_until_s"], |row| row.get(0)).optional()?;
        let checksum = meta.query_row(["habits_checksum"], |row| row.get::<_, u32>(0)).optional()?;
        let mut query = transaction.prepare("SELECT name FROM habit_name WHERE kind = ?1 ORDER BY number")?;
        let mut names = |kind: &str| -> Result<Vec<_>> {
            query.query_map([kind], |row| Ok(StoredName { name: row.get(0)? }))?.collect()
        };
        let (objects, places) = (names("thing")?, names("place")?);
        let mut query = transaction.prepare("SELECT person, model FROM habit_person")?;
        let persons = query.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect::<Result<_>>()?;
        let mut query = transaction.prepare("SELECT * FROM habit ORDER BY context")?;
        let row = |row: &Row<'_>| {
            let [kind, slot, a, b, c, d, e, f] = row.get::<_, i64>(0)?.to_be_bytes();
            let counts = serde_json::from_str(row.get_ref(2)?.as_str()?);
            let counts = counts.map_err(|error| Error::FromSqlConversionFailure(2, Type::Text, error.into()))?;
            let after = [[a, b], [c, d], [e, f]].map(u16::from_be_bytes);
            Ok(StoredRow { kind, slot, after, touched_min: row.get(1)?, counts })
        };
        let rows = query.query_map([], row)?.collect::<Result<_>>()?;
        let mut query = transaction.prepare("SELECT source, epoch, sequence FROM learned ORDER BY place")?;
        let learned = query.query_map([], |row| {
            let number = |at| row.get::<_, i64>(at).map(i64::cast_unsigned);
            Ok(EventId::new(number(0)?, number(1)?, number(2)?))
        })?;
        let learned = learned.collect::<Result<_>>()?;
        let watched_until_s = watched_until_s.unwrap_or(f64::NEG_INFINITY);
        let stored = Stored { version, objects, places, persons: Vec::new(), rows };
        let read = Self { stored, persons, watched_until_s, learned, is_damaged: false };
        let is_damaged = checksum != Some(read.checksum());
        Ok(Some(Self { is_damaged, ..read }))
    }
}

/// The key of a row: no kind is so great that it is negative.
fn context(&StoredRow { kind, slot, after, .. }: &StoredRow) -> i64 {
    let [[a, b], [c, d], [e, f]] = after.map(u16::to_be_bytes);
    i64::from_be_bytes([kind, slot, a, b, c, d, e, f])
}

/// Calls `write` for each changed key, with the new value, or with `None` if the key is gone.
fn changes<K: Ord, V: PartialEq>(
    before: impl IntoIterator<Item = (K, V)>,
    now: impl IntoIterator<Item = (K, V)>,
    mut write: impl FnMut(K, Option<V>) -> Result<()>,
) -> Result<()> {
    let mut before = before.into_iter().peekable();
    for (key, value) in now {
        while let Some((gone, _)) = before.next_if(|(old, _)| *old < key) {
            write(gone, None)?;
        }
        if before.next_if(|(old, _)| *old == key).is_none_or(|(_, old)| old != value) {
            write(key, Some(value))?;
        }
    }
    before.try_for_each(|(gone, _)| write(gone, None))
}
