//! The tables of events: records go in, and a starting daemon gets them back.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use roomcast_core::forecast::PACES;
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, RoomName, SensorReport, Sentence, person_number};
use roomcast_core::pipeline::SOURCES_MAX;
use roomcast_database::rusqlite::{self, OptionalExtension, Row, named_params, params};
use roomcast_database::{Transaction, sound};
use roomcast_ipc::Sender as Port;

use super::learned::HabitRows;
use super::record::{EVENT_BYTES, Expectation, KeptPerson, Move, Moved, PART_BYTES, Record};
use super::recovered::Recovered;
use crate::daemon::map_change::KeptMap;

/// At most so many events of each person stay, fewer if they have more than a quarter of the bytes.
const WORDS: [u32; 5] = [12, 6, 3, 2, 1];

type Result<T> = rusqlite::Result<T>;

/// An event with its number and the persons that it moved.
pub(super) struct Known {
    pub(super) id: i64,
    pub(super) observation: Observation,
    pub(super) is_of_this_boot: bool,
    pub(super) found: Option<PersonId>,
    pub(super) moves: Option<Vec<Move>>,
}

/// The event as columns: kind, room and text.
fn columns(event: &Event) -> (&'static str, Option<&str>, Option<Cow<'_, str>>) {
    let (kind, room, text) = match event {
        Event::Did(sentence) => ("did", None, Some(sentence.as_str())),
        Event::Present(room) => ("present", room.as_ref().map(RoomName::as_str), None),
        Event::Away => ("away", None, None),
        Event::Gone => ("gone", None, None),
        Event::AllAway => ("all-away", None, None),
        Event::Empty(room) => ("empty", Some(room.as_str()), None),
        Event::Sensor(report) => {
            return ("sensor", report.room.as_ref().map(RoomName::as_str), Some(report.to_string().into()));
        }
    };
    (kind, room, text.map(Cow::Borrowed))
}

fn event_of(kind: &str, room: Option<&str>, text: Option<&str>) -> Option<Event> {
    if kind == "sensor" {
        return Some(Event::Sensor(Arc::new(SensorReport::parse(text?).ok()?)));
    }
    let room = room.map(RoomName::new).transpose().ok()?;
    Some(match kind {
        "did" => Event::Did(Sentence::new(text?).ok()?),
        "present" => Event::Present(room),
        "away" => Event::Away,
        "gone" => Event::Gone,
        "all-away" => Event::AllAway,
        "empty" => Event::Empty(room?),
        _ => return None,
    })
}

/// The checksum of a narrator's words, because SQLite does not notice a flipped bit in a text. The columns that change are added to it: a statement can
/// take them out of the sum. A flipped bit of a time changes the remainder.
fn checksum(observation: &Observation, observed_ns: Option<i64>, found: Option<u32>) -> i64 {
    let Observation { person, name, observed_unix_ns: UnixNs(time), count, may_be_form, event, .. } = observation;
    let EventId { source, epoch, sequence } = observation.id();
    let (kind, room, text) = columns(event);
    let said =
        format!("{source} {epoch} {sequence} {time} {person} {name:?} {count} {may_be_form} {kind} {room:?} {text:?}");
    // One flipped bit makes 0 of null.
    let found = found.map_or(0, |found| i64::from(found) + 1);
    let added = observed_ns.unwrap_or_default() % 1_000_000_007 + found;
    i64::from(crc32fast::hash(said.as_bytes())) + added
}

/// Writes one record as number `id`. A record that is there already changes nothing.
pub(super) fn write(transaction: &Transaction<'_>, id: i64, record: &Record) -> Result<()> {
    match record {
        Record::Event { observation, is_of_this_boot } => {
            insert_event(transaction, id, observation, *is_of_this_boot)?;
            note_event(transaction, observation.id(), id)
        }
        Record::Taken(event) => {
            note_event(transaction, *event, id)?;
            settle(transaction, &BTreeMap::from([(event.start(), event.sequence)]))
        }
        Record::Port { start, port } => note_source(transaction, *start, |source| source.port = Some(port.to_bytes())),
        Record::Found { of, person } => {
            let Some(event) = find(transaction, *of)? else { return Ok(()) };
            let mut set = transaction.prepare_cached(
                "UPDATE event SET checksum = checksum - coalesce(found + 1, 0) + ?2 + 1, found = ?2 WHERE id = ?1",
            )?;
            set.execute(params![event, person.0]).map(|_| ())
        }
        Record::Expected { of, person, expectation } => {
            let Some(event) = find(transaction, *of)? else { return Ok(()) };
            let Expectation { map, paces, probability } = expectation;
            let mut insert =
                transaction.prepare_cached("INSERT OR REPLACE INTO expectation VALUES (?1, ?2, ?3, ?4, ?5, ?6)")?;
            let paces = paces.as_ref().map(|paces| bytes_of(paces));
            let probability = bytes_of(probability);
            insert.execute(params![event, person.0, paces.is_some(), map.cast_signed(), paces, probability]).map(|_| ())
        }
        Record::Moved(Moved { observation, moves }) => {
            let Some(event) = find(transaction, *observation)? else { return Ok(()) };
            insert_moves(transaction, event, moves)
        }
        Record::Gone { person, after } => {
            let after = after.map_or(Ok(None), |after| find(transaction, after))?.unwrap_or(id);
            let mut insert = transaction.prepare_cached("INSERT OR REPLACE INTO departure VALUES (?1, ?2)")?;
            insert.execute(params![person.0, after]).map(|_| ())
        }
    }
}

fn insert_event(
    transaction: &Transaction<'_>,
    id: i64,
    observation: &Observation,
    is_of_this_boot: bool,
) -> Result<()> {
    let Observation { person, name, by_fit, observed_ns, observed_unix_ns, count, may_be_form, .. } = observation;
    let EventId { source, epoch, sequence } = observation.id();
    let (kind, room, text) = columns(&observation.event);
    let number = match name {
        Some(name) => Some(person_number(name)),
        None => Some(*person).filter(|person| *person != PersonId::SOMEBODY),
    };
    let number = number.map(|number| number.0);
    // An attribution of before.
    let found = by_fit.then_some(person.0);
    let observed_ns = is_of_this_boot.then_some(observed_ns.0.cast_signed());
    let mut insert = transaction.prepare_cached(
        "INSERT INTO event VALUES
         (:id, :source, :epoch, :sequence, :observed_ns, :observed_unix_ns, :kind, :room, :text, :person, :name, :number, :found, :count, :may_be_form,
          0, :checksum)
         ON CONFLICT (id) DO UPDATE SET kind = :kind, room = :room, text = :text, person = :person, name = :name, number = :number,
             found = :found, count = :count, may_be_form = :may_be_form, is_told = 0, checksum = :checksum
         ON CONFLICT DO NOTHING",
    )?;
    insert
        .execute(named_params! {
            ":id": id, ":source": source.cast_signed(), ":epoch": epoch.cast_signed(), ":sequence": sequence.cast_signed(),
            ":observed_ns": observed_ns, ":observed_unix_ns": observed_unix_ns.0.cast_signed(),
            ":kind": kind, ":room": room, ":text": text, ":person": person.0, ":name": name, ":number": number,
            ":found": found, ":count": count, ":may_be_form": may_be_form, ":checksum": checksum(observation, observed_ns, found),
        })
        .map(|_| ())
}

/// Replaces the persons that an event moved.
pub(super) fn insert_moves(transaction: &Transaction<'_>, event: i64, moves: &[Move]) -> Result<()> {
    transaction.prepare_cached("UPDATE event SET is_told = 1 WHERE id = ?1")?.execute([event])?;
    transaction.prepare_cached("DELETE FROM moved WHERE event = ?1")?.execute([event])?;
    let mut insert = transaction.prepare_cached("INSERT INTO moved VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)")?;
    for (place, Move { person, name, by_fit, event: said }) in moves.iter().enumerate() {
        let (kind, room, text) = said.as_ref().map_or((None, None, None), |said| {
            let (kind, room, text) = columns(said);
            (Some(kind), room, text)
        });
        insert.execute(params![event, place as i64, person.0, name, by_fit, kind, room, text])?;
    }
    Ok(())
}

/// A start of a narrator.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Source {
    port: Option<[u8; 16]>,
    last: Option<u64>,
    settled: Option<u64>,
    event: i64,
}

impl Source {
    /// The start in a row; none if it is damaged.
    fn at(row: &Row<'_>) -> Result<Option<((u64, u64), Self)>> {
        let number = |at| row.get::<_, Option<i64>>(at).map(|number| number.map(i64::cast_unsigned));
        let start = (number(0)?.unwrap_or_default(), number(1)?.unwrap_or_default());
        let source = Self { port: row.get(2)?, last: number(3)?, settled: number(4)?, event: row.get(5)? };
        Ok((row.get::<_, i64>(6)? == source.checksum(start)).then_some((start, source)))
    }

    fn checksum(&self, start: (u64, u64)) -> i64 {
        crc32fast::hash(format!("{start:?} {self:?}").as_bytes()).into()
    }
}

/// Changes the row of a start of a narrator.
fn note_source(transaction: &Transaction<'_>, start: (u64, u64), change: impl FnOnce(&mut Source)) -> Result<()> {
    let (number, epoch) = (start.0.cast_signed(), start.1.cast_signed());
    let mut read = transaction.prepare_cached("SELECT * FROM source WHERE source = ?1 AND epoch = ?2")?;
    let known = sound(read.query_row([number, epoch], Source::at).optional())?.flatten().flatten();
    let mut source = known.map(|(_, source)| source).unwrap_or_default();
    change(&mut source);
    let mut write = transaction.prepare_cached("INSERT OR REPLACE INTO source VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)")?;
    let [last, settled] = [source.last, source.settled].map(|sequence| sequence.map(u64::cast_signed));
    write.execute(params![number, epoch, source.port, last, settled, source.event, source.checksum(start)]).map(|_| ())
}

/// Takes note of an event of a start of a narrator.
fn note_event(transaction: &Transaction<'_>, event: EventId, number: i64) -> Result<()> {
    note_source(transaction, event.start(), |source| {
        // A record that is written again may be older.
        if number >= source.event {
            (source.last, source.event) = (Some(event.sequence), number);
        }
    })
}

/// Takes note up to which sequence events of some starts are gone.
fn settle(transaction: &Transaction<'_>, gone: &BTreeMap<(u64, u64), u64>) -> Result<()> {
    let mut gone = gone.iter();
    gone.try_for_each(|(start, sequence)| {
        note_source(transaction, *start, |source| source.settled = source.settled.max(Some(*sequence)))
    })
}

fn find(transaction: &Transaction<'_>, EventId { source, epoch, sequence }: EventId) -> Result<Option<i64>> {
    let mut find =
        transaction.prepare_cached("SELECT id FROM event WHERE source = ?1 AND epoch = ?2 AND sequence = ?3")?;
    find.query_row([source, epoch, sequence].map(u64::cast_signed), |row| row.get(0)).optional()
}

fn bytes_of(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

fn numbers_of(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

/// The number of the last record.
pub(super) fn last_number(transaction: &Transaction<'_>) -> Result<i64> {
    transaction.query_row(
        "SELECT max(coalesce((SELECT max(id) FROM event), 0), coalesce((SELECT max(event) FROM source), 0),
                    coalesce((SELECT max(after) FROM departure), 0))",
        [],
        |row| row.get(0),
    )
}

/// A note until deleted data is erased from file and log.
pub(super) const TO_ERASE: &str = "to_erase";

/// Notes something for later starts.
pub(super) fn note(transaction: &Transaction<'_>, key: &str) -> Result<()> {
    transaction.execute("INSERT OR REPLACE INTO meta VALUES (?1, 1)", [key]).map(|_| ())
}

pub(super) fn has_note(transaction: &Transaction<'_>, key: &str) -> Result<bool> {
    transaction.query_row("SELECT count(*) FROM meta WHERE key = ?1", [key], |row| row.get(0))
}

pub(super) fn remove_to_erase(transaction: &Transaction<'_>) -> Result<()> {
    transaction.execute("DELETE FROM meta WHERE key = ?1", [TO_ERASE]).map(|_| ())
}

/// Drops the monotonic times of events from before the machine's last start.
pub(super) fn begin_boot(transaction: &Transaction<'_>, boot_id: &[u8; 16]) -> Result<()> {
    let known: Option<Vec<u8>> =
        transaction.query_row("SELECT value FROM meta WHERE key = 'boot'", [], |row| row.get(0)).optional()?;
    if known.as_deref() == Some(boot_id) {
        return Ok(());
    }
    transaction.execute(
        "UPDATE event SET checksum = checksum - observed_ns % 1000000007, observed_ns = NULL WHERE observed_ns IS NOT NULL",
        [],
    )?;
    transaction.execute("INSERT OR REPLACE INTO meta VALUES ('boot', ?1)", [boot_id]).map(|_| ())
}

/// About how many bytes each event has with the rows that belong to it, oldest first.
fn costs(transaction: &Transaction<'_>) -> Result<Vec<(i64, EventId, u64)>> {
    let each = format!(
        "SELECT id, source, epoch, sequence, {EVENT_BYTES} + coalesce(length(text), 0) + coalesce(length(room), 0)
              + (SELECT coalesce(sum({PART_BYTES} + coalesce(length(text), 0) + coalesce(length(room), 0)), 0)
                 FROM moved WHERE moved.event = id)
              + (SELECT coalesce(sum({PART_BYTES} + length(probability)), 0) FROM expectation WHERE expectation.event = id)
         FROM event ORDER BY id"
    );
    let mut query = transaction.prepare(&each)?;
    let rows = query.query_map([], |row| Ok((row.get(0)?, id_at(row, 1)?, row.get::<_, i64>(4)?.cast_unsigned())))?;
    rows.collect()
}

fn id_at(row: &Row<'_>, at: usize) -> Result<EventId> {
    let number = |at| row.get::<_, i64>(at).map(i64::cast_unsigned);
    Ok(EventId::new(number(at)?, number(at + 1)?, number(at + 2)?))
}

/// Deletes the oldest events until the rest has no more than seven eighths of `bytes_max`. The last events of each person stay, in at most a
/// quarter of that; so does each narrator's last sequence number. Gives the number of deleted events, and the bytes of the rest.
pub(super) fn trim(transaction: &Transaction<'_>, bytes_max: u64) -> Result<(usize, u64)> {
    let costs = costs(transaction)?;
    let mut bytes: u64 = costs.iter().map(|(.., cost)| cost).sum();
    if bytes <= bytes_max {
        return Ok((0, bytes));
    }
    let kept = last_words(transaction, &costs, bytes_max / 4)?;
    let (mut gone, mut deleted) = (BTreeMap::new(), 0);
    let mut delete = transaction.prepare_cached("DELETE FROM event WHERE id = ?1")?;
    for (id, event, cost) in costs {
        if bytes <= bytes_max / 8 * 7 {
            break;
        }
        if !kept.contains(&id) {
            delete.execute([id])?;
            let last = gone.entry(event.start()).or_insert(event.sequence);
            *last = event.sequence.max(*last);
            (bytes, deleted) = (bytes - cost, deleted + 1);
        }
    }
    settle(transaction, &gone)?;
    transaction.execute("DELETE FROM departure WHERE after < (SELECT min(id) FROM event)", [])?;
    // Of too many starts, the newest of every port stays, then the second of every port: a port that invents narrators pushes out its own.
    transaction.execute(
        "WITH quiet AS (
             SELECT source, epoch, event, row_number() OVER (PARTITION BY coalesce(port, source || ' ' || epoch) ORDER BY event DESC) AS rank
             FROM source WHERE NOT EXISTS (SELECT 1 FROM event WHERE event.source = source.source AND event.epoch = source.epoch))
         DELETE FROM source WHERE (source, epoch) IN (SELECT source, epoch FROM quiet ORDER BY rank, event DESC LIMIT -1 OFFSET ?1)",
        [SOURCES_MAX as i64],
    )?;
    Ok((deleted, bytes))
}

/// The newest events of each person since they were forgotten, and of each the newest that has their name, in at most so many bytes.
fn last_words(transaction: &Transaction<'_>, costs: &[(i64, EventId, u64)], bytes_max: u64) -> Result<HashSet<i64>> {
    let costs: HashMap<i64, u64> = costs.iter().map(|(id, _, cost)| (*id, *cost)).collect();
    let mut query = transaction.prepare_cached(
        "WITH said (person, event, is_named) AS (
             SELECT expectation.person, event, name IS NOT NULL FROM expectation JOIN event ON id = event
             UNION SELECT person, event, name IS NOT NULL FROM moved WHERE person <> 4294967295 AND name IS NOT NULL
             UNION SELECT number, id, name IS NOT NULL FROM event WHERE number IS NOT NULL),
         since AS (SELECT * FROM said WHERE event > coalesce((SELECT max(after) FROM departure WHERE departure.person = said.person), 0)),
         ranked AS (
             SELECT event, is_named, row_number() OVER (PARTITION BY person ORDER BY event DESC) AS rank,
                    row_number() OVER (PARTITION BY person, is_named ORDER BY event DESC) AS own FROM since)
         SELECT DISTINCT event FROM ranked WHERE rank <= ?1 OR (is_named AND own = 1) ORDER BY event DESC",
    )?;
    for words in WORDS {
        let newest: Vec<i64> = query.query_map([words], |row| row.get(0))?.collect::<Result<_>>()?;
        let cost = |event: &i64| costs.get(event).copied().unwrap_or_default();
        if newest.iter().map(cost).sum::<u64>() <= bytes_max || words == 1 {
            let mut room = bytes_max;
            let fits = newest.into_iter().take_while(|event| {
                let left = room.checked_sub(cost(event));
                room = left.unwrap_or_default();
                left.is_some()
            });
            return Ok(fits.collect());
        }
    }
    Ok(HashSet::new())
}

/// All events that can be read, oldest first, and how many cannot.
pub(super) fn events(transaction: &Transaction<'_>) -> Result<(Vec<Known>, Vec<i64>)> {
    let mut moves = moves(transaction)?;
    let mut query = transaction.prepare(
        "SELECT id, source, epoch, sequence, observed_ns, observed_unix_ns, kind, room, text, person, name, found, count, may_be_form, is_told, checksum
         FROM event ORDER BY id",
    )?;
    let (mut known, mut damaged) = (Vec::new(), Vec::new());
    let mut rows = query.query([])?;
    while let Some(row) = rows.next()? {
        match sound(event_at(row, &mut moves))?.flatten() {
            Some(event) => known.push(event),
            None => damaged.push(row.get(0)?),
        }
    }
    Ok((known, damaged))
}

/// The event in a row, with the persons that it moved; `None` if the row is damaged.
fn event_at(row: &Row<'_>, moves: &mut HashMap<i64, Vec<Move>>) -> Result<Option<Known>> {
    let EventId { source, epoch, sequence } = id_at(row, 1)?;
    let observed_ns: Option<i64> = row.get(4)?;
    let (kind, room, text): (String, Option<String>, Option<String>) = (row.get(6)?, row.get(7)?, row.get(8)?);
    let Some(event) = event_of(&kind, room.as_deref(), text.as_deref()) else { return Ok(None) };
    let observation = Observation {
        person: PersonId(row.get(9)?),
        name: row.get(10)?,
        source,
        epoch,
        observed_ns: BootNs(observed_ns.map_or(0, i64::cast_unsigned)),
        observed_unix_ns: UnixNs(row.get::<_, i64>(5)?.cast_unsigned()),
        count: row.get(12)?,
        may_be_form: row.get(13)?,
        ..Observation::saying(sequence, event)
    };
    let found: Option<u32> = row.get(11)?;
    let is_sound = row.get::<_, i64>(15)? == checksum(&observation, observed_ns, found);
    let (id, found, is_of_this_boot) = (row.get(0)?, found.map(PersonId), observed_ns.is_some());
    let moves = row.get::<_, bool>(14)?.then(|| moves.remove(&id).unwrap_or_default());
    Ok(is_sound.then_some(Known { id, observation, is_of_this_boot, found, moves }))
}

fn moves(transaction: &Transaction<'_>) -> Result<HashMap<i64, Vec<Move>>> {
    let mut query =
        transaction.prepare("SELECT event, person, name, by_fit, kind, room, text FROM moved ORDER BY event, place")?;
    let (mut moves, mut rows) = (HashMap::<i64, Vec<Move>>::new(), query.query([])?);
    while let Some(row) = rows.next()? {
        if let Some((event, own)) = sound(move_at(row))? {
            moves.entry(event).or_default().push(own);
        }
    }
    Ok(moves)
}

fn move_at(row: &Row<'_>) -> Result<(i64, Move)> {
    let (kind, room, text): (Option<String>, Option<String>, Option<String>) = (row.get(4)?, row.get(5)?, row.get(6)?);
    let event = kind.and_then(|kind| event_of(&kind, room.as_deref(), text.as_deref()));
    Ok((row.get(0)?, Move { person: PersonId(row.get(1)?), name: row.get(2)?, by_fit: row.get(3)?, event }))
}

/// The content that a starting daemon needs.
pub(super) fn recover(transaction: &Transaction<'_>) -> Result<Recovered> {
    let (known, damaged) = events(transaction)?;
    let (persons, habits) = (persons(transaction)?, HabitRows::read(transaction)?);
    let map = changed_map(transaction)?;
    let mut recovered = Recovered { damaged: damaged.len() as u64, persons, map, habits, ..Recovered::default() };
    let mut ids = Vec::with_capacity(known.len());
    let mut newest = HashSet::new();
    for Known { id, mut observation, is_of_this_boot, found, moves } in known {
        let event = observation.id();
        if !newest.insert(event) {
            // A damaged index lets an event in twice.
            continue;
        }
        if let Some(person) = found {
            (observation.person, observation.by_fit) = (person, true);
        }
        if !is_of_this_boot {
            recovered.of_other_boots.insert(event);
        }
        recovered.moved.extend(moves.map(|moves| (event, moves)));
        recovered.observations.push(observation);
        ids.push(id);
    }
    let mut query = transaction
        .prepare("SELECT event, person, map, paces, probability FROM expectation ORDER BY event, person, is_belief")?;
    let mut rows = query.query([])?;
    while let Some(row) = rows.next()? {
        let columns = || Ok((row.get(0)?, row.get(1)?, row.get::<_, i64>(2)?, row.get(3)?, row.get(4)?));
        let Some((event, person, map, paces, probability)) = sound(columns())? else {
            recovered.damaged += 1;
            continue;
        };
        let (event, paces, probability): (i64, Option<Vec<u8>>, Vec<u8>) = (event, paces, probability);
        let paces: Option<[f32; PACES]> = paces.map(|paces| numbers_of(&paces).try_into().unwrap_or([0.0; PACES]));
        let probability = numbers_of(&probability);
        let is_sound = probability.iter().all(|probability| (0.0..=1.0).contains(probability))
            && paces.iter().flatten().all(|pace| pace.is_finite() && *pace >= 0.0);
        if let Ok(index) = ids.binary_search(&event)
            && is_sound
        {
            let expectation = Expectation { map: map.cast_unsigned(), paces, probability };
            recovered.expectations.push((index, PersonId(person), expectation));
        }
    }
    let place = |id: i64| ids.partition_point(|known| *known <= id);
    let mut query = transaction.prepare("SELECT after, person FROM departure ORDER BY after")?;
    let gone = query.query_map([], |row| Ok((place(row.get(0)?), PersonId(row.get(1)?))))?;
    recovered.forgotten = gone.filter_map(|gone| sound(gone).transpose()).collect::<Result<_>>()?;
    let mut query = transaction.prepare("SELECT * FROM source ORDER BY event")?;
    let (mut taken, mut rows) = (Vec::new(), query.query([])?);
    while let Some(row) = rows.next()? {
        let Some((start, source)) = sound(Source::at(row))?.flatten() else {
            recovered.damaged += 1;
            continue;
        };
        recovered.ports.extend(source.port.map(|port| (start, Port::from_bytes(port))));
        recovered.settled.extend(source.settled.map(|settled| (start, settled)));
        let last = source.last.map(|last| EventId::new(start.0, start.1, last));
        taken.extend(last.filter(|event| !newest.contains(event)).map(|event| (place(source.event), event)));
    }
    taken.extend(recovered.observations.iter().map(Observation::id).enumerate());
    taken.sort_by_key(|(place, _)| *place);
    recovered.taken = taken.into_iter().map(|(_, event)| event).collect();
    Ok(recovered)
}

/// Replaces an event and its persons. None takes it out; that it was taken stays known.
pub(super) fn replace(
    transaction: &Transaction<'_>,
    known: &Known,
    by: Option<(&Observation, Option<&[Move]>)>,
) -> Result<()> {
    match by {
        Some((observation, moves)) => {
            transaction.prepare_cached("DELETE FROM moved WHERE event = ?1")?.execute([known.id])?;
            insert_event(transaction, known.id, observation, known.is_of_this_boot)?;
            moves.map_or(Ok(()), |moves| insert_moves(transaction, known.id, moves))
        }
        None => {
            transaction.prepare_cached("DELETE FROM event WHERE id = ?1")?.execute([known.id])?;
            let event = known.observation.id();
            settle(transaction, &BTreeMap::from([(event.start(), event.sequence)]))
        }
    }
}

/// Deletes damaged events, which can be of any person.
pub(super) fn delete_events(transaction: &Transaction<'_>, ids: &[i64]) -> Result<()> {
    let mut delete = transaction.prepare_cached("DELETE FROM event WHERE id = ?1")?;
    ids.iter().try_for_each(|id| delete.execute([id]).map(|_| ()))
}

/// Deletes the model's expectations of a person, and their departures.
pub(super) fn delete_expectations(transaction: &Transaction<'_>, person: PersonId) -> Result<usize> {
    let deleted = transaction.execute("DELETE FROM expectation WHERE person = ?1", [person.0])?;
    Ok(deleted + transaction.execute("DELETE FROM departure WHERE person = ?1", [person.0])?)
}

/// Replaces the persons with a name that the home gave.
pub(super) fn write_persons(transaction: &Transaction<'_>, persons: &[KeptPerson]) -> Result<()> {
    transaction.execute("DELETE FROM person", [])?;
    let mut insert = transaction.prepare_cached("INSERT OR REPLACE INTO person VALUES (?1, ?2, ?3, ?4, ?5)")?;
    for (place, KeptPerson { number, name, resident, former }) in persons.iter().enumerate() {
        let former = serde_json::to_string(former).unwrap_or_default();
        insert.execute(params![number.0, name, resident, former, place as i64])?;
    }
    Ok(())
}

/// The persons with a name that the home gave.
pub(super) fn persons(transaction: &Transaction<'_>) -> Result<Vec<KeptPerson>> {
    let mut query = transaction.prepare("SELECT number, name, resident, former FROM person ORDER BY place")?;
    let person = |row: &Row<'_>| {
        let former = serde_json::from_str(&row.get::<_, String>(3)?).unwrap_or_default();
        Ok(KeptPerson { number: PersonId(row.get(0)?), name: row.get(1)?, resident: row.get(2)?, former })
    };
    query.query_map([], person)?.filter_map(|person| sound(person).transpose()).collect()
}

/// Replaces the changed map.
pub(super) fn write_map(transaction: &Transaction<'_>, map: Option<&KeptMap>) -> Result<()> {
    transaction.execute("DELETE FROM changed_map", [])?;
    let Some(KeptMap { scene, fingerprint, map }) = map else { return Ok(()) };
    transaction.execute("INSERT INTO changed_map VALUES (?1, ?2, ?3)", [scene, fingerprint, map]).map(|_| ())
}

/// The changed map; that of a damaged row is empty.
fn changed_map(transaction: &Transaction<'_>) -> Result<Option<KeptMap>> {
    let map = |row: &Row<'_>| Ok(KeptMap { scene: row.get(0)?, fingerprint: row.get(1)?, map: row.get(2)? });
    let row = transaction.query_row("SELECT * FROM changed_map", [], map).optional();
    Ok(sound(row)?.unwrap_or_else(|| Some(KeptMap::default())))
}

/// Persons who were found for events; several where a text names several.
pub(super) fn attributed(known: &Known) -> BTreeSet<PersonId> {
    let moves = known.moves.iter().flatten().filter(|own| own.name.is_some() || own.by_fit).map(|own| own.person);
    moves.chain(known.found).collect()
}
