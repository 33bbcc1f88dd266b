//! Habits as rows. A write changes the rows that differ from the last write, in one transaction with the events before it.

use std::collections::BTreeMap;

use roomcast_core::habits::{Habits, HabitsOptions, Stored, StoredName, StoredRow};
use roomcast_core::ids::EventId;
use roomcast_database::rusqlite::{OptionalExtension, Result, params};
use roomcast_database::{Transaction, sound};

use crate::daemon::habits::{Heard, Memory};

/// Names are of things or of places.
const KINDS: [&str; 2] = ["thing", "place"];

/// A count's kind, the number of its person, its context, and the symbol that followed.
type Key = (u8, u8, [u16; 3], u16);

/// All rows of the habits.
#[derive(Debug, Default, Clone, PartialEq)]
pub struct HabitRows {
    version: u16,
    /// Time spent was counted until then, in seconds since 1970, local time.
    watched_until_s: f64,
    /// By kind and number, each with the minute when it was last seen.
    names: BTreeMap<(usize, u32), String>,
    /// Models of persons as JSON, by number.
    persons: BTreeMap<u32, String>,
    /// Each with the minute of its last change.
    counts: BTreeMap<Key, (f32, u32)>,
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
        let Stored { version, objects, places, persons, rows } = memory.habits.stored();
        let names = [objects, places].into_iter().enumerate().flat_map(|(kind, names)| {
            (0..).zip(names).map(move |(number, StoredName { name })| ((kind, number), name))
        });
        let persons = persons.iter().map(|person| Ok((person.number, serde_json::to_string(person)?)));
        let counts = rows.into_iter().flat_map(|StoredRow { kind, slot, after, touched_min, counts }| {
            counts.into_iter().map(move |(symbol, count)| ((kind, slot, after, symbol), (count, touched_min)))
        });
        Ok(Self {
            version,
            watched_until_s: memory.watched_until_s,
            names: names.collect(),
            persons: persons.collect::<serde_json::Result<_>>()?,
            counts: counts.collect(),
            learned: memory.heard.names().to_vec(),
            is_damaged: false,
        })
    }

    /// The memory of these rows.
    ///
    /// # Errors
    /// When the rows are damaged or of another version: the reason.
    pub fn memory(self, options: HabitsOptions) -> std::result::Result<Memory, String> {
        if self.is_damaged {
            return Err("their checksum is wrong".to_owned());
        }
        let [mut objects, mut places] = [Vec::new(), Vec::new()];
        for ((kind, _), name) in self.names {
            if kind == 0 { &mut objects } else { &mut places }.push(StoredName { name });
        }
        let mut rows = Vec::<StoredRow>::new();
        for ((kind, slot, after, symbol), (count, touched_min)) in self.counts {
            match rows.last_mut().filter(|row| (row.kind, row.slot, row.after) == (kind, slot, after)) {
                Some(row) => row.counts.push((symbol, count)),
                None => rows.push(StoredRow { kind, slot, after, touched_min, counts: vec![(symbol, count)] }),
            }
        }
        let persons =
            self.persons.values().map(|person| serde_json::from_str(person)).collect::<serde_json::Result<_>>();
        let persons = persons.map_err(|error| error.to_string())?;
        let stored = Stored { version: self.version, objects, places, persons, rows };
        let habits = Habits::from_stored(options, stored).map_err(|error| error.to_string())?;
        Ok(Memory { habits, heard: Heard::new(self.learned), watched_until_s: self.watched_until_s })
    }

    /// Writes the rows that differ from the `before` ones.
    pub(super) fn write(&self, transaction: &Transaction<'_>, before: &Self) -> Result<()> {
        let mut delete = transaction.prepare_cached("DELETE FROM habit_name WHERE kind = ?1 AND number = ?2")?;
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO habit_name VALUES (?1, ?2, ?3)")?;
        changes(&before.names, &self.names, |(kind, number), name| match name {
            Some(name) => write.execute(params![KINDS[*kind], number, name]),
            None => delete.execute(params![KINDS[*kind], number]),
        })?;
        let mut delete = transaction.prepare_cached("DELETE FROM habit_person WHERE person = ?1")?;
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO habit_person VALUES (?1, ?2)")?;
        changes(&before.persons, &self.persons, |person, model| match model {
            Some(model) => write.execute(params![person, model]),
            None => delete.execute([person]),
        })?;
        let mut delete = transaction.prepare_cached(
            "DELETE FROM habit WHERE (kind, slot, after_1, after_2, after_3, symbol) = (?1, ?2, ?3, ?4, ?5, ?6)",
        )?;
        let mut write =
            transaction.prepare_cached("INSERT OR REPLACE INTO habit VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")?;
        changes(&before.counts, &self.counts, |(kind, slot, [first, second, third], symbol), count| match count {
            Some((count, touched_min)) => {
                write.execute(params![kind, slot, first, second, third, symbol, count, touched_min])
            }
            None => delete.execute(params![kind, slot, first, second, third, symbol]),
        })?;
        transaction.execute("DELETE FROM learned", [])?;
        let mut write = transaction.prepare_cached("INSERT INTO learned VALUES (?1, ?2, ?3, ?4)")?;
        for (place, EventId { source, epoch, sequence }) in (0_i64..).zip(&self.learned) {
            write.execute(params![source.cast_signed(), epoch.cast_signed(), sequence.cast_signed(), place])?;
        }
        let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO meta VALUES (?1, ?2)")?;
        write.execute(params!["habits_version", self.version])?;
        write.execute(params!["habits_until_s", self.watched_until_s])?;
        write.execute(params!["habits_checksum", self.checksum()]).map(|_| ())
    }

    fn checksum(&self) -> u32 {
        let Self { version, watched_until_s, names, persons, counts, learned, .. } = self;
        let mut hasher = crc32fast::Hasher::new();
        let few = format!("{version} {} {names:?} {persons:?} {learned:?}", watched_until_s.to_bits());
        hasher.update(few.as_bytes());
        for ((kind, slot, [first, second, third], symbol), (count, touched_min)) in counts {
            hasher.update(&[*kind, *slot]);
            [first, second, third, symbol].into_iter().for_each(|number| hasher.update(&number.to_le_bytes()));
            hasher.update(&count.to_le_bytes());
            hasher.update(&touched_min.to_le_bytes());
        }
        hasher.finalize()
    }

    /// The rows that were read have a wrong checksum or a value that no sound row has.
    pub(super) fn is_damaged(&self) -> bool {
        self.is_damaged
    }

    /// Deletes all rows.
    pub(super) fn clear(transaction: &Transaction<'_>) -> Result<()> {
        transaction
            .execute_batch("DELETE FROM habit_name; DELETE FROM habit_person; DELETE FROM habit; DELETE FROM learned")
    }

    /// Reads the rows; `None` if habits were never written.
    pub(super) fn read(transaction: &Transaction<'_>) -> Result<Option<Self>> {
        let read = sound(Self::rows(transaction))?;
        Ok(read.unwrap_or_else(|| Some(Self { is_damaged: true, ..Self::default() })))
    }

    fn rows(transaction: &Transaction<'_>) -> Result<Option<Self>> {
        let mut meta = transaction.prepare("SELECT value FROM meta WHERE key = ?1")?;
        let Some(version) = meta.query_row(["habits_version"], |row| row.get(0)).optional()? else { return Ok(None) };
        let watched_until_s = meta.query_row(["habits_until_s"], |row| row.get(0)).optional()?;
        let checksum = meta.query_row(["habits_checksum"], |row| row.get::<_, u32>(0)).optional()?;
        let mut query = transaction.prepare("SELECT kind = 'place', number, name FROM habit_name")?;
        let names = query.query_map([], |row| Ok(((usize::from(row.get::<_, bool>(0)?), row.get(1)?), row.get(2)?)))?;
        let names = names.collect::<Result<_>>()?;
        let mut query = transaction.prepare("SELECT person, model FROM habit_person")?;
        let persons = query.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?.collect::<Result<_>>()?;
        let mut query = transaction.prepare("SELECT * FROM habit")?;
        let counts = query.query_map([], |row| {
            let after = [row.get(2)?, row.get(3)?, row.get(4)?];
            Ok(((row.get(0)?, row.get(1)?, after, row.get(5)?), (row.get(6)?, row.get(7)?)))
        })?;
        let counts = counts.collect::<Result<_>>()?;
        let mut query = transaction.prepare("SELECT source, epoch, sequence FROM learned ORDER BY place")?;
        let learned = query.query_map([], |row| {
            let number = |at| row.get::<_, i64>(at).map(i64::cast_unsigned);
            Ok(EventId::new(number(0)?, number(1)?, number(2)?))
        })?;
        let learned = learned.collect::<Result<_>>()?;
        let watched_until_s = watched_until_s.unwrap_or(f64::NEG_INFINITY);
        let rows = Self { version, watched_until_s, names, persons, counts, learned, is_damaged: false };
        let is_damaged = checksum != Some(rows.checksum());
        Ok(Some(Self { is_damaged, ..rows }))
    }
}

/// Calls `write` for each changed key, with the new value, or with `None` if the key is gone.
fn changes<K: Ord, V: PartialEq>(
    before: &BTreeMap<K, V>,
    now: &BTreeMap<K, V>,
    mut write: impl FnMut(&K, Option<&V>) -> Result<usize>,
) -> Result<()> {
    let mut before = before.iter().peekable();
    for (key, value) in now {
        while let Some((gone, _)) = before.next_if(|(old, _)| *old < key) {
            write(gone, None)?;
        }
        if before.next_if(|(old, _)| *old == key).is_none_or(|(_, old)| old != value) {
            write(key, Some(value))?;
        }
    }
    before.try_for_each(|(gone, _)| write(gone, None).map(|_| ()))
}
