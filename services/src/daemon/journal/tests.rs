use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::PermissionsExt;

use roomcast_core::forecast::PACES;
use roomcast_core::habits::{HabitsOptions, Place, Turn};
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Observation, Sentence, person_number};
use roomcast_core::semantic_map::SemanticMap;
use roomcast_core::semantic_map::delta::parse_changes;
use roomcast_database::Connection;
use roomcast_database::rusqlite::types::Value;
use roomcast_database::rusqlite::{self, Row};
use roomcast_ipc::Sender as Port;

use super::notes::text_of;
use super::*;
use crate::daemon::{KeptMap, Memory};

const BOOT: [u8; 16] = [3; 16];
const SENSOR: &str = r#"{"sensor": "motion", "id": "hall-1", "room": "hall", "on": true}"#;

fn observation(sequence: u64) -> Observation {
    let sentence = Sentence::new(&format!("They do thing {sequence}.")).unwrap();
    let (observed_ns, observed_unix_ns) = (BootNs(100 + sequence), UnixNs(5));
    let own = Observation { person: PersonId(3), source: 7, epoch: 1, ..Observation::of(sequence, sentence) };
    Observation { observed_ns, observed_unix_ns, ..own }
}

fn open(directory: &Path) -> Result<(Journal, Recovered), JournalError> {
    Journal::open(directory, 1 << 20, Duration::from_millis(1))
}

fn writer(folder: &Path, bytes_max: u64) -> (Writer, Recovered) {
    let opened = Database::open(&folder.join(FILE), SCHEMA).unwrap();
    Writer::open(opened, None, bytes_max, &BOOT).unwrap()
}

fn event(observation: &Observation) -> Record {
    observation.into()
}

/// A database that was set aside.
fn aside(directory: &Path) -> Option<Vec<u8>> {
    fs::read(directory.join("roomcast.db.damaged-1")).ok()
}

fn expected(of: &Observation, person: PersonId, probability: &[f32]) -> Record {
    let expectation = Expectation { map: 7, paces: None, probability: probability.to_vec() };
    Record::Expected { of: of.id(), person, expectation }
}

/// Writes events of source 7 until trims have gone several times over the database.
fn flood(writer: &mut Writer, sequences: std::ops::Range<u64>) {
    for sequence in sequences {
        let own = observation(sequence);
        writer.write([event(&own), expected(&own, PersonId(3), &[0.5, 0.5])]).unwrap();
        if sequence % 20 == 0 {
            writer.sync().unwrap();
        }
    }
    writer.sync().unwrap();
}

#[test]
fn values_that_no_sound_row_has_cost_their_rows_and_not_the_start() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&observation(1)), expected(&observation(1), PersonId(3), &[0.5, 0.5])]).unwrap();
    let rows = [
        "departure VALUES (1099511627781, 1)",
        "moved VALUES (1, 0, 1099511627781, NULL, 0, NULL, NULL, NULL)",
        "person VALUES (1099511627781, 'Eve', 0, '[]', 0)",
        "source VALUES (9, 9, x'01', 1, 1, 1, 1)",
        "meta VALUES ('habits_version', 4)",
        "habit VALUES (1, 1, '[[1]]')",
        "changed_map VALUES ('1', '2', CAST(x'ff' AS TEXT))",
    ];
    rows.iter().for_each(|row| own.plant(&format!("INSERT INTO {row}")));
    own.plant("UPDATE expectation SET person = 1099511627781");
    drop(own);
    for _ in 0..2 {
        let (_, recovered) = writer(directory.path(), 1 << 20);
        assert_eq!(recovered.observations, [observation(1)]);
        assert!(aside(directory.path()).is_none(), "a start sets nothing aside");
        assert!(recovered.persons.is_empty() && recovered.habits.unwrap().is_damaged());
        assert_eq!(recovered.map, Some(KeptMap::default()));
    }
}

#[test]
fn each_departure_of_a_visitor_comes_back_at_its_place_also_from_the_first_schema_and_so_do_habits() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(FILE);
    let old = Connection::open(&path).unwrap();
    old.execute_batch("CREATE TABLE meta (key TEXT PRIMARY KEY, value ANY NOT NULL) WITHOUT ROWID, STRICT").unwrap();
    old.execute_batch(SCHEMA.migrations[0]).unwrap();
    let rows = "INSERT INTO departure VALUES (4, 0); INSERT INTO habit VALUES (9, 65, 7, 300, 65535, 2, 0.1, 8), (9, 65, 7, 300, 65535, 3, 4, 8)";
    old.execute_batch(&format!("{rows}; PRAGMA user_version = 1")).unwrap();
    old.pragma_update(None, "application_id", SCHEMA.application).unwrap();
    drop(old);
    fs::set_permissions(&path, PermissionsExt::from_mode(0o600)).unwrap();
    let (mut own, recovered) = writer(directory.path(), 1 << 20);
    let counts = "SELECT group_concat(concat_ws(' ', kind, slot, after_1, after_2, after_3, symbol, count, touched_min)) FROM habit_count";
    let counts = Connection::open(&path).unwrap().query_row(counts, [], |row| row.get::<_, String>(0)).unwrap();
    assert_eq!(counts, "9 65 7 300 65535 2 0.1 8,9 65 7 300 65535 3 4.0 8");
    assert_eq!(recovered.forgotten, [(0, PersonId(4))]);
    own.write([1, 2, 3].map(|sequence| event(&observation(sequence)))).unwrap();
    for after in [1, 2] {
        own.write([Record::Gone { person: PersonId(4), after: Some(observation(after).id()) }]).unwrap();
    }
    drop(own);
    let (_, recovered) = writer(directory.path(), 1 << 20);
    assert_eq!(recovered.forgotten, [0, 1, 2].map(|events| (events, PersonId(4))));
}

#[test]
fn forgetting_deletes_damaged_events_of_any_person() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&observation(1)), event(&observation(2))]).unwrap();
    own.plant("UPDATE event SET checksum = checksum + 1 WHERE sequence = 1");
    own.forget(PersonId(5), &|_, _| false).unwrap();
    let text = text_of(directory.path());
    assert!(!text.contains("They do thing 1.") && text.contains("They do thing 2."));
}

/// A lost mount leaves another folder at the same path.
#[test]
fn events_in_a_folder_that_was_made_again_are_not_kept() {
    let outer = tempfile::tempdir().unwrap();
    let state = outer.path().join("state");
    for is_made_again in [false, true] {
        let (journal, _) = open(&state).unwrap();
        journal.handle.append(&observation(1));
        if is_made_again {
            fs::rename(&state, outer.path().join("gone")).unwrap();
            fs::create_dir(&state).unwrap();
        }
        let handle = journal.handle.clone();
        assert!(handle.is_kept());
        // It syncs before it ends.
        drop(journal);
        assert_eq!(handle.is_kept(), !is_made_again);
    }
}

#[test]
fn events_are_bounded_and_the_newest_stay() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 64 << 10);
    flood(&mut own, 0..4000);
    assert!(own.trimmed > 3000);
    let file = fs::metadata(directory.path().join(FILE)).unwrap().len();
    assert!(file < 192 << 10, "{file}");
    drop(own);
    let (_, recovered) = writer(directory.path(), 64 << 10);
    assert_eq!(recovered.observations.last().unwrap().sequence, 3999);
    assert!(recovered.observations.len() > 100);
    let last_gone = recovered.observations[0].sequence - 1;
    assert_eq!(recovered.settled, BTreeMap::from([((7, 1), last_gone)]));
}

#[test]
fn a_source_that_fell_silent_stays_known() {
    let directory = tempfile::tempdir().unwrap();
    let quiet = Observation { source: 99, person: PersonId::SOMEBODY, ..observation(41) };
    for run in 0..4_u64 {
        let (mut own, recovered) = writer(directory.path(), 16_384);
        assert!(run == 0 || recovered.taken.contains(&EventId::new(99, 1, 41)), "{run}: {recovered:?}");
        let of_flood: Vec<_> = recovered.taken.iter().filter(|event| event.source == 7).collect();
        assert!(of_flood.windows(2).all(|pair| pair[0].sequence < pair[1].sequence));
        let port = recovered.ports.get(&(quiet.source, quiet.epoch));
        assert!(run == 0 || port == Some(&Port::simulated(3)), "{run}: {port:?}");
        if run == 0 {
            own.write([Record::Port { start: (99, 1), port: Port::simulated(3) }, event(&quiet)]).unwrap();
        }
        flood(&mut own, run * 700 + 1..run * 700 + 701);
    }
}

/// The events of a person with a single name stay, however much others say; so do events without any outcome.
#[test]
fn the_last_events_of_each_person_stay_in_their_order() {
    let directory = tempfile::tempdir().unwrap();
    let of = |sequence: u64, name: &str, said: &str| {
        let event = Event::presence(said);
        let event = event.unwrap_or_else(|_| Event::Did(Sentence::new(said).unwrap()));
        Observation { source: 99, person: PersonId::SOMEBODY, name: Some(name.into()), event, ..observation(sequence) }
    };
    let words = [
        of(1, "ada", "They walk."),
        of(2, "ben", "present"),
        of(3, "eve", "away"),
        of(4, "ada", "They lie."),
        of(5, "untold", "away"),
    ];
    for run in 0..4_u64 {
        let (mut own, recovered) = writer(directory.path(), 16_384);
        if run == 0 {
            for (word, name) in words.iter().zip(["ada", "ben", "eve", "ada", ""]) {
                own.write([event(word)]).unwrap();
                if !name.is_empty() {
                    own.write([expected(word, person_number(name), &[0.25, 0.75])]).unwrap();
                }
            }
            // Eve is forgotten, and then all are said to be away.
            let is_eve = |o: &Observation, _: Option<PersonId>| o.name.as_deref() == Some("eve");
            assert_eq!(own.forget(person_number("eve"), &is_eve).unwrap(), 1);
            for sequence in 10..40 {
                let event_of_all = Event::presence("everybody away").unwrap();
                let all = Observation {
                    source: 98,
                    person: PersonId::SOMEBODY,
                    event: event_of_all,
                    ..observation(sequence)
                };
                own.write([event(&all), expected(&all, person_number("ada"), &[]), expected(&all, PersonId(3), &[])])
                    .unwrap();
            }
        } else {
            let kept: Vec<u64> = recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
            assert_eq!(kept, [2, 4, 5], "{run}");
            assert_eq!(recovered.forgotten.len(), 1, "{run}");
            assert_eq!((recovered.forgotten[0].1), person_number("eve"), "{run}");
            let of_ben: Vec<_> =
                recovered.expectations.iter().filter(|(_, person, _)| *person == person_number("ben")).collect();
            assert_eq!((of_ben.len(), &of_ben[0].2.probability[..]), (1, &[0.25, 0.75][..]));
        }
        flood(&mut own, run * 700 + 1..run * 700 + 701);
        assert!(own.trimmed > 100);
    }
}

/// Anna is named in a plain sentence, and is "she" since then.
#[test]
fn the_event_that_has_a_persons_name_stays() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 65_536);
    let anna = person_number("anna");
    let say = |own: &mut Writer, sequence: u64, text: &str, name: Option<&str>| {
        let said = Event::Did(Sentence::new(text).unwrap());
        let said = Observation { source: 99, person: PersonId::SOMEBODY, event: said, ..observation(sequence) };
        let moves = vec![Move { person: anna, name: name.map(Into::into), by_fit: name.is_none(), event: None }];
        let observation = said.id();
        own.write([event(&said), Record::Moved(Moved { observation, moves }), expected(&said, anna, &[1.0])]).unwrap();
    };
    say(&mut own, 1, "Anna opens the fridge.", Some("Anna"));
    (2..40).for_each(|sequence| say(&mut own, sequence, "She opens the fridge.", None));
    flood(&mut own, 1..900);
    drop(own);
    let (_, recovered) = writer(directory.path(), 65_536);
    let of_anna: Vec<_> = recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
    assert_eq!((of_anna[0], of_anna.last(), of_anna.len()), (1, Some(&39), 13));
}

#[test]
fn two_daemons_cannot_share_it() {
    let directory = tempfile::tempdir().unwrap();
    let _first = open(directory.path()).unwrap();
    assert!(matches!(open(directory.path()), Err(JournalError::Locked { .. })));
}

/// Nothing of a forgotten person stays in file, log and free pages, and what a narrator sends again does not bring it back.
#[test]
fn a_forgotten_person_leaves_no_byte() {
    let directory = tempfile::tempdir().unwrap();
    // Earlier versions, and damage, have left files that are full of them.
    for file in ["narration.journal", "narration.journal.old", "narration.journal.large-7", "roomcast.db.damaged-3"] {
        fs::write(directory.path().join(file), "Ada's secret 3.").unwrap();
    }
    let (journal, _) = open(directory.path()).unwrap();
    let handle = journal.handle.clone();
    let of = |sequence: u64, name: &str| {
        let sentence = Sentence::new(&format!("They do secret {sequence}. {}", "and so on ".repeat(50))).unwrap();
        let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
        let person = PersonId::SOMEBODY;
        Observation { person, name, source: 7, epoch: sequence / 64, ..Observation::of(sequence, sentence) }
    };
    for sequence in 1..=120 {
        let name = ["ada-lovelace", "ben", ""][sequence as usize % 3];
        let mut number = journal.handle.append(&of(sequence, name));
        if name.is_empty() {
            let (event, person) = (EventId::new(7, sequence / 64, sequence), PersonId(1 + sequence as u32 % 2));
            let outcome = Outcome { event, person, by_fit: true, map: 1, probability: &[] };
            number = handle.append(&outcome);
        }
        assert!(handle.wait_for(number, Duration::from_secs(30)));
    }
    let is_ada = |o: &Observation| o.name.as_deref() == Some("ada-lovelace");
    let is_theirs = move |o: &Observation, found: Option<PersonId>| is_ada(o) || found == Some(PersonId(1));
    let forget = || {
        let until = Instant::now() + Duration::from_secs(30);
        handle.ask(move |writer| writer.forget(PersonId(1), &is_theirs), until).unwrap()
    };
    assert!(forget() > 0);
    let text = text_of(directory.path());
    assert!(!text.contains("ada-") && !text.contains("secret 3.") && text.contains("secret 4."));
    assert_eq!(forget(), 0);
    let last = journal.handle.append(&of(121, "ben"));
    assert!(handle.wait_for(last, Duration::from_secs(30)));
    drop(journal);
    let (_journal, recovered) = open(directory.path()).unwrap();
    let theirs = |o: &Observation| is_ada(o) || (o.by_fit && o.person == PersonId(1));
    assert!(!recovered.observations.iter().any(theirs) && recovered.observations.len() > 50);
    assert!(recovered.observations.iter().any(|o| o.by_fit && o.person == PersonId(2)));
    // All is still known to be taken.
    assert_eq!(recovered.taken.last(), Some(&EventId::new(7, 1, 121)));
    assert_eq!(recovered.settled.len(), 2);
}

/// A program that reads the database for long keeps the rows of a forgotten person in its file: the answer says so, and a later sync erases them.
#[test]
fn a_reader_that_stays_is_named_when_a_person_is_forgotten() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&Observation { name: Some("ada".into()), ..observation(1) })]).unwrap();
    let mut reader = Connection::open(directory.path().join(FILE)).unwrap();
    let query = reader.transaction().unwrap();
    query.query_row("SELECT count(*) FROM event", [], |row| row.get::<_, i64>(0)).unwrap();
    let is_ada = |_: &Observation, _: Option<PersonId>| true;
    let error = own.forget(person_number("ada"), &is_ada).unwrap_err().to_string();
    assert!(error.contains("another program reads the database"), "{error}");
    own.sync().unwrap();
    assert!(own.is_behind() && text_of(directory.path()).contains("ada"));
    // The daemon remembers it over a restart.
    drop(own);
    drop(query);
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&observation(2))]).unwrap();
    assert!(own.is_behind());
    own.sync().unwrap();
    assert!(!own.is_behind());
    drop(own);
    assert!(!writer(directory.path(), 1 << 20).0.is_behind());
    assert!(!text_of(directory.path()).contains("ada"));
}

/// Names, presence and attributions come back as they were; what the model said comes with the observation that it followed.
#[test]
fn each_kind_of_record_comes_back() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    let named = |sequence: u64, name: &str| Observation { name: Some(name.into()), ..observation(sequence) };
    let said = |text: &str| Event::presence(text).unwrap();
    let mut told = vec![
        observation(1),
        named(2, "Ada"),
        Observation { event: Event::Away, ..named(3, "Éva") },
        Observation { person: PersonId::SOMEBODY, count: 2, may_be_form: false, ..observation(4) },
    ];
    let presences = ["present", "present in the kitchen", "gone", "everybody away", "nobody in the hall", SENSOR];
    told.extend(
        (5..).zip(presences).map(|(sequence, text)| Observation { event: said(text), ..observation(sequence) }),
    );
    own.write(told.iter().map(event)).unwrap();
    let outcome = |sequence: u64, by_fit: bool, probability: &'static [f64]| {
        let (event, person, map) = (EventId::new(7, 1, sequence), PersonId(9), 77);
        Record::from(&Outcome { event, person, by_fit, map, probability })
    };
    own.write([outcome(2, false, &[0.25, 0.75]), outcome(4, true, &[]), outcome(99, true, &[1.0])]).unwrap();
    let was = Expectation { map: 78, paces: Some([40.5; PACES]), probability: vec![0.5, 0.5] };
    own.write([Record::Expected { of: EventId::new(7, 1, 2), person: PersonId(9), expectation: was.clone() }]).unwrap();
    // The persons that an observation moved come back in their order; so does an empty list.
    let sentence = Sentence::new("Mia cooks.").ok().map(Event::Did);
    let by = |person: PersonId, name: &str, event: Option<Event>| {
        let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
        Move { person, name, by_fit: person == PersonId(3), event }
    };
    let moved = [
        Moved { observation: EventId::new(7, 1, 1), moves: Vec::new() },
        Moved {
            observation: EventId::new(7, 1, 2),
            moves: vec![
                by(PersonId(1), "Éva", None),
                by(PersonId(3), "", Some(said("away"))),
                by(PersonId::SOMEBODY, "", Some(said("nobody in the kitchen"))),
                by(PersonId(4), "Mia", sentence),
            ],
        },
    ];
    own.write(moved.iter().cloned().map(Record::Moved)).unwrap();
    let mut recovered = own.recover().unwrap();
    told[3] = Observation { person: PersonId(9), by_fit: true, ..told[3].clone() };
    assert_eq!(recovered.observations, told);
    let next = Expectation { map: 77, paces: None, probability: vec![0.25, 0.75] };
    assert_eq!(recovered.expectations, [(1, PersonId(9), next), (1, PersonId(9), was)]);
    for Moved { observation, moves } in moved {
        assert_eq!(recovered.moved.remove(&observation), Some(moves));
    }
    assert!(recovered.of_other_boots.is_empty() && recovered.moved.is_empty());
    // The machine starts again: its monotonic clock says nothing of these any more.
    drop(own);
    let opened = Database::open(&directory.path().join(FILE), SCHEMA).unwrap();
    let (_, recovered) = Writer::open(opened, None, 1 << 20, &[4; 16]).unwrap();
    assert!(recovered.observations.iter().all(|o| o.observed_ns == BootNs(0)));
    assert_eq!(recovered.of_other_boots.len(), recovered.observations.len());
}

/// The daemon starts whatever became of the file, and the damaged one is there to be looked at.
#[test]
fn a_damaged_database_is_set_aside() {
    let random = |seed: u64| seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407) >> 20;
    let (scene, map) = maps();
    let (whole, stored) = {
        let directory = tempfile::tempdir().unwrap();
        let (mut own, _) = writer(directory.path(), 1 << 20);
        flood(&mut own, 0..300);
        own.write_map(map.clone()).unwrap();
        let mut memory = Memory::new(HabitsOptions::default());
        memory.habits.bind(vec!["bed".to_owned()], vec!["hall".to_owned()], vec![1.0]);
        for hour in 0..300_u16 {
            let at_s = 1e9 + 3_600.0 * f64::from(hour);
            memory.habits.observe(&Turn { person: PersonId(1), label: Some(0), room: Some(0), at_s });
        }
        own.write_habits(&memory).unwrap();
        own.forget(PersonId(1), &|_, _| false).unwrap();
        // With the note to erase, a start would remove the databases that were set aside.
        own.plant("PRAGMA wal_checkpoint(TRUNCATE)");
        (fs::read(directory.path().join(FILE)).unwrap(), memory.habits.stored())
    };
    let number = |name: &str, default| std::env::var(name).map_or(default, |number| number.parse().unwrap());
    let rounds = number("ROOMCAST_CORRUPTIONS", 40);
    let first = number("ROOMCAST_CORRUPTIONS_SEED", 0) * rounds;
    let mut kinds = [(0, 0); 4];
    for round in first..first + rounds {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(FILE);
        let mut bytes = whole.clone();
        let (at, how) = (random(round) as usize % bytes.len(), random(round + 7777) % 4);
        match how {
            0 => bytes.truncate(at),
            1 => bytes[at] ^= 1 << (round % 8),
            2 => bytes[at..].iter_mut().take(4096).for_each(|byte| *byte = 0),
            _ => bytes[at..].iter_mut().take(300).for_each(|byte| *byte = byte.wrapping_mul(31).wrapping_add(7)),
        }
        fs::write(&path, &bytes).unwrap();
        let (journal, recovered) = open(directory.path()).unwrap();
        let set_aside = aside(directory.path());
        if let Some(damaged) = &set_aside {
            assert_eq!(damaged.len(), bytes.len());
            let (asides, saved) = &mut kinds[how as usize];
            (*asides, *saved) = (*asides + 1, *saved + recovered.observations.len() as u64);
        }
        // Damaged ones are refused.
        let read = recovered.map.and_then(|map| map.of(&scene));
        assert!(read.is_none_or(|read| map.fingerprint == hex::encode(read.fingerprint())), "{round}");
        let habits = recovered.habits.and_then(|habits| habits.memory(HabitsOptions::default()).ok());
        assert!(habits.is_none_or(|memory| memory.habits.stored() == stored), "{round}");
        let lost = 300 - recovered.observations.len() as u64;
        assert!(set_aside.is_some() || lost <= recovered.damaged + u64::from(bytes.is_empty()) * 300, "{round}");
        journal.handle.append(&observation(1000));
        drop(journal);
        assert_eq!(look(directory.path()).unwrap().observations.last().unwrap().sequence, 1000, "{round}");
    }
    println!("{rounds} corruptions of the database");
    for ((asides, saved), kind) in kinds.iter().zip(["cut", "a bit", "zeros", "garbled"]) {
        println!("{kind}: {asides} databases set aside, with {saved} of {} events saved", asides * 300);
    }
    let (asides, saved) = kinds.iter().fold((0, 0), |sum, kind| (sum.0 + kind.0, sum.1 + kind.1));
    assert!(asides > rounds / 4 && saved > asides * 100, "{kinds:?}");
    // A cut takes the rows of the pages behind it.
    assert!(kinds[0].1 > kinds[0].0 * 60, "{kinds:?}");
}

#[test]
fn a_database_without_its_last_page_keeps_its_events() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    flood(&mut own, 0..300);
    own.forget(PersonId(1), &|_, _| false).unwrap();
    drop(own);
    let file = fs::File::options().write(true).open(directory.path().join(FILE)).unwrap();
    file.set_len(file.metadata().unwrap().len() - 2048).unwrap();
    let (_, recovered) = writer(directory.path(), 1 << 20);
    assert!(aside(directory.path()).is_some());
    assert_eq!(recovered.observations.len(), 300);
}

/// Runs statements in a database that no process has.
fn change(directory: &Path, statements: &str) {
    Connection::open(directory.join(FILE)).unwrap().execute_batch(statements).unwrap();
}

#[test]
fn a_newer_database_is_refused_and_stays_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&observation(1))]).unwrap();
    drop(own);
    let newer = "PRAGMA user_version = 99; UPDATE meta SET value = 99 WHERE key = 'schema'";
    change(directory.path(), newer);
    let bytes = fs::read(directory.path().join(FILE)).unwrap();
    for _ in 0..2 {
        let error = open(directory.path()).unwrap_err();
        assert!(
            matches!(error, JournalError::Newer(..)) && error.to_string().contains("move the file away"),
            "{error}"
        );
        assert!(aside(directory.path()).is_none());
        assert_eq!(fs::read(directory.path().join(FILE)).unwrap(), bytes);
    }
    // A flipped bit in one of both numbers is no newer version.
    let known = SCHEMA.migrations.len();
    for one in [format!("UPDATE meta SET value = {known} WHERE key = 'schema'"), "PRAGMA user_version = 1".to_owned()] {
        change(directory.path(), &one);
        let (_, recovered) = writer(directory.path(), 1 << 20);
        assert!(aside(directory.path()).is_none());
        assert_eq!(recovered.observations, [observation(1)]);
    }
}

#[test]
fn a_foreign_database_is_set_aside() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    own.write([event(&observation(1))]).unwrap();
    drop(own);
    change(directory.path(), "PRAGMA application_id = 1");
    let (_, recovered) = writer(directory.path(), 1 << 20);
    assert!(aside(directory.path()).is_some() && recovered.observations.is_empty());
}

/// A name of an earlier version was changed since.
#[test]
fn old_files_do_not_come_back_after_the_database_is_lost() {
    let directory = tempfile::tempdir().unwrap();
    let names = r#"[{"number": 3, "name": "Eve", "resident": null, "former": []}]"#;
    fs::write(directory.path().join("persons.json"), names).unwrap();
    let open = || {
        let opened = Database::open(&directory.path().join(FILE), SCHEMA).unwrap();
        Writer::open(opened, Some(directory.path().to_owned()), 1 << 20, &BOOT).unwrap()
    };
    let (mut own, recovered) = open();
    own.write_persons(vec![recovered.persons[0].renamed("Maria")]).unwrap();
    drop(own);
    fs::write(directory.path().join(FILE), "no database").unwrap();
    fs::remove_file(directory.path().join("roomcast.db-wal")).unwrap();
    for _ in 0..2 {
        assert_eq!(open().1.persons, []);
    }
    assert!(aside(directory.path()).is_some());
}

/// A scene, and a changed map of it.
fn maps() -> (SemanticMap, KeptMap) {
    let scene = SemanticMap::from_json(include_str!("../../../../tests/data/two_rooms.json")).unwrap();
    let changed = scene.changed(parse_changes(r#"[{"change": "remove-item", "id": "sofa-1"}]"#).unwrap()).unwrap();
    let kept = KeptMap::new(hex::encode(scene.fingerprint()), &changed);
    (scene, kept)
}

/// A file of an earlier version has the first one.
#[test]
fn a_changed_map_outlives_the_daemon_but_not_its_scene_its_row_or_the_database() {
    let directory = tempfile::tempdir().unwrap();
    let (scene, kept) = maps();
    let file = directory.path().join("changed-map.json");
    let old = format!(r#"{{"base": "{}", "scene": {}}}"#, kept.scene, kept.map);
    fs::write(&file, &old).unwrap();
    let open = || {
        let opened = Database::open(&directory.path().join(FILE), SCHEMA).unwrap();
        Writer::open(opened, Some(directory.path().to_owned()), 1 << 20, &BOOT).unwrap()
    };
    let (mut own, recovered) = open();
    assert_eq!(recovered.map.as_ref(), Some(&kept));
    let first = recovered.map.unwrap().of(&scene).unwrap();
    let second = first.changed(parse_changes(r#"[{"change": "remove-item", "id": "mug-1"}]"#).unwrap()).unwrap();
    own.write_map(KeptMap::new(kept.scene, &second)).unwrap();
    drop(own);
    let (mut own, recovered) = open();
    let map = recovered.map.unwrap();
    assert_eq!(map.of(&scene).unwrap().fingerprint(), second.fingerprint());
    assert!(map.of(&second).is_none());
    // A flipped bit that SQLite does not see.
    own.plant("UPDATE changed_map SET map = replace(map, 'sofa', 'sofb')");
    assert!(own.recover().unwrap().map.unwrap().of(&scene).is_none());
    drop(own);
    fs::write(directory.path().join(FILE), "no database").unwrap();
    fs::remove_file(directory.path().join("roomcast.db-wal")).unwrap();
    for _ in 0..2 {
        let (own, recovered) = open();
        assert_eq!((recovered.map, own.progress.failures.load(Ordering::Relaxed)), (None, 1));
    }
    assert_eq!(fs::read_to_string(file).unwrap(), old);
}

#[test]
fn a_database_that_another_user_could_have_planted_is_refused() {
    use std::os::unix::fs::{PermissionsExt, symlink};
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(FILE);
    let refused = || matches!(open(directory.path()), Err(JournalError::Refused { .. }));
    for file in [path.clone(), directory.path().join("roomcast.db-wal"), directory.path().join("roomcast.db-shm")] {
        symlink("/dev/null", &file).unwrap();
        assert!(refused());
        fs::remove_file(&file).unwrap();
        rustix::fs::mknodat(rustix::fs::CWD, &file, rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR, 0).unwrap();
        assert!(refused());
        fs::remove_file(&file).unwrap();
    }
    let (journal, _) = open(directory.path()).unwrap();
    journal.handle.append(Record::Gone { person: PersonId(1), after: None });
    drop(journal);
    for file in fs::read_dir(directory.path()).unwrap() {
        assert_eq!(file.unwrap().metadata().unwrap().permissions().mode() & 0o777, 0o600);
    }
    fs::set_permissions(directory.path(), fs::Permissions::from_mode(0o777)).unwrap();
    assert!(refused());
}

/// The journal of earlier versions is read once, and left as it is.
#[test]
fn the_old_journal_is_read_once() {
    let record = |letter: u8, payload: &[u8]| {
        let mut record = [b"RCJ".as_slice(), &[letter]].concat();
        record.extend((payload.len() as u32).to_le_bytes());
        record.extend(crc32fast::hash(payload).to_le_bytes());
        [record, payload.to_vec()].concat()
    };
    let numbers = |numbers: &[u64]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
    let said = |letter: u8, sequence: u64, rest: &[u8]| {
        let person = 3_u32.to_le_bytes();
        record(letter, &[&numbers(&[7, 1, sequence, 50, 60])[..], &person, &[9; 16], rest].concat())
    };
    let gone = |person: u32, is_before: u8| record(b'9', &[&person.to_le_bytes()[..], &[is_before]].concat());
    let older = [said(b'7', 1, b"They wait."), gone(5, 1), said(b'1', 4, b"They walk.")].concat();
    let found = record(b'5', &[&numbers(&[7, 1, 5])[..], &9_u32.to_le_bytes(), &[1], &[0; 8]].concat());
    let next =
        record(b'5', &[&numbers(&[7, 1, 4])[..], &3_u32.to_le_bytes(), &[0], &[1; 8], &0.5_f32.to_le_bytes()].concat());
    let belief = record(
        b'A',
        &[&numbers(&[7, 1, 4])[..], &3_u32.to_le_bytes(), &[1; 8], &[0; 4 * PACES], &1_f32.to_le_bytes()].concat(),
    );
    let moved = record(b'B', &[&numbers(&[7, 1, 5])[..], &8_u32.to_le_bytes(), &[1 << 2, 3], b"Ada"].concat());
    let current = [
        said(b'8', 2, &[&[1, 3][..], b"Adaaway\n\nbeside"].concat()),
        gone(6, 1),
        record(b'2', &numbers(&[44, 1, 9])),
        record(b'6', &[&numbers(&[7, 1])[..], &Port::simulated(4).to_bytes()].concat()),
        b"damage".to_vec(),
        said(b'3', 5, &[&[1, 0][..], b"everybody present in the kitchen"].concat()),
        found,
        next,
        belief,
        moved,
        gone(3, 0),
    ]
    .concat();
    for name in ["narration.journal", "narration.journal.next"] {
        // A daemon that was killed had not renamed its next half yet.
        let directory = tempfile::tempdir().unwrap();
        let [old, new] = ["narration.journal.old", name].map(|name| directory.path().join(name));
        fs::write(&old, &older).unwrap();
        fs::write(&new, &current).unwrap();
        for _ in 0..2 {
            let (_journal, recovered) = open(directory.path()).unwrap();
            let said: Vec<_> =
                recovered.observations.iter().map(|o| (o.sequence, o.event.to_string(), o.person.0)).collect();
            let expected = [(2, "away", 3), (4, "They walk.", 3), (5, "present in the kitchen", 9)];
            assert_eq!(said, expected.map(|(sequence, text, person)| (sequence, text.to_owned(), person)));
            assert_eq!(recovered.forgotten, [(1, PersonId(6)), (3, PersonId(3))]);
            assert_eq!(recovered.expectations.len(), 2);
            assert_eq!(recovered.moved[&EventId::new(7, 1, 5)][0].name.as_deref(), Some("Ada"));
            assert_eq!(recovered.ports[&(7, 1)], Port::simulated(4));
            assert!(recovered.taken.contains(&EventId::new(44, 1, 9)));
            assert_eq!(recovered.of_other_boots.len(), 3);
        }
        assert_eq!([fs::read(&old).unwrap(), fs::read(&new).unwrap()], [older.clone(), current.clone()]);
    }
}

#[test]
fn a_sync_waits_for_silence_and_not_longer_than_promised() {
    let start = Instant::now();
    let at = |ms: u64| start + Duration::from_millis(ms);
    let every = Duration::from_secs(1);
    let mut due = SyncDue::new(every, start);
    assert_eq!(due.at(), Some(at(1000)));
    due.synced(true, at(1000));
    assert_eq!(due.at(), None);
    // A single record waits until a second after the last sync, and for silence.
    due.wrote(at(1200));
    assert_eq!(due.at(), Some(at(2000)));
    due.wrote(at(1950));
    assert_eq!(due.at(), Some(at(2050)));
    // A stream of records waits no longer than promised.
    due.wrote(at(2190));
    assert_eq!(due.at(), Some(at(2200)));
    due.synced(false, at(2210));
    assert_eq!(due.at(), Some(at(3210)));
}

#[test]
fn habits_are_rows_that_are_written_once_and_forgotten_whole() {
    use crate::daemon::habits::Heard;

    let directory = tempfile::tempdir().unwrap();
    let (mut own, recovered) = writer(directory.path(), 1 << 20);
    assert_eq!(recovered.habits, None);
    let options = HabitsOptions::default();
    let mut memory = Memory::new(options);
    memory.habits.bind(vec!["bed".to_owned()], vec!["secret-room".to_owned()], vec![1.0]);
    memory.watched_until_s = 1e9 + 600.0;
    let learn = |memory: &mut Memory, person: u32, sequence: u64| {
        let at_s = 1e9 + 60.0 * sequence as f64;
        memory.habits.observe(&Turn { person: PersonId(person), label: Some(0), room: Some(0), at_s });
        memory.heard = Heard::new([EventId::new(4, 5, 6), EventId::new(1, 2, sequence)]);
    };
    (1..5).for_each(|sequence| learn(&mut memory, 1, sequence));
    memory.habits.be(PersonId(1), Place::Elsewhere, 1e9 + 600.0);
    own.write_habits(&memory).unwrap();
    let other = Connection::open(directory.path().join(FILE)).unwrap();
    let changes = || other.query_row("SELECT sum(count) FROM habit_count", [], |row| row.get::<_, f64>(0)).unwrap();
    let before = changes();
    learn(&mut memory, 1, 5);
    own.write_habits(&memory).unwrap();
    assert!(changes() > before);
    // No event is learned twice: the start of a narrator has one row.
    other.execute("INSERT INTO learned VALUES (1, 2, 7, 9)", []).unwrap_err();
    drop(own);
    let (mut own, recovered) = writer(directory.path(), 1 << 20);
    let again = recovered.habits.unwrap().memory(options).unwrap();
    assert_eq!(again.habits.stored(), memory.habits.stored());
    assert_eq!((again.heard, again.watched_until_s), (memory.heard.clone(), memory.watched_until_s));
    // A flipped bit that SQLite does not see.
    other.execute("UPDATE habit SET touched_min = touched_min + 1", []).unwrap();
    let damaged = own.recover().unwrap().habits.unwrap().memory(options);
    assert!(damaged.unwrap_err().contains("checksum"));
    drop(other);
    fs::write(directory.path().join("roomcast.db.damaged-2"), "secret-room").unwrap();
    own.write_habits(&Memory::new(options)).unwrap();
    own.forget_habits().unwrap();
    assert!(!text_of(directory.path()).contains("secret-room"));
}

/// A name in two spellings, a text without a name, a sensor, and an event that was attributed to a person.
#[test]
fn the_queries_of_the_manual_find_each_person_once() {
    let directory = tempfile::tempdir().unwrap();
    let (mut own, _) = writer(directory.path(), 1 << 20);
    let yesterday = UnixNs(crate::clock::unix_ns().0 - 86_400_000_000_000);
    let said = |sequence: u64, name: &str, said: &str| {
        let event = Event::presence(said).unwrap_or_else(|_| Event::Did(Sentence::new(said).unwrap()));
        let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
        let unnamed = Observation { name, person: PersonId::SOMEBODY, ..observation(sequence) };
        Observation { observed_unix_ns: yesterday, event, ..unnamed }
    };
    let events = [
        said(1, "ada", "present in the kitchen"),
        said(2, "Ada", "away"),
        said(3, "ada", "present"),
        said(4, "", "Ada walks to the bathroom."),
        said(5, "ben", "present in the bathroom"),
        said(6, "", SENSOR),
        said(7, "", "He opens the kitchen cupboard."),
    ];
    own.write(events.iter().map(event)).unwrap();
    let ben = person_number("ben");
    own.write([Record::Found { of: events[5].id(), person: ben }]).unwrap();
    for (of, person, name) in [(3, person_number("ada"), Some("Ada")), (6, ben, None)] {
        let moves = vec![Move { person, name: name.map(Into::into), by_fit: name.is_none(), event: None }];
        own.write([Record::Moved(Moved { observation: events[of].id(), moves })]).unwrap();
    }
    drop(own);
    let database = Connection::open(directory.path().join(FILE)).unwrap();
    let manual = include_str!("../../../../docs/database.md");
    let rows = |query: &str| {
        let mut statement = database.prepare(query.trim().trim_end_matches(';')).unwrap();
        let columns = statement.column_count();
        let shown = |value: Value| match value {
            Value::Text(text) => text,
            Value::Integer(number) => number.to_string(),
            _ => String::new(),
        };
        let row = |row: &Row<'_>| (0..columns).map(|at| row.get(at).map(shown)).collect();
        statement.query_map([], row).unwrap().collect::<Result<Vec<Vec<_>>, _>>().unwrap()
    };
    let queries = manual.split("\n\n").filter(|part| part.starts_with("    SELECT"));
    let answers: Vec<_> = queries.map(rows).collect();
    let [newest, rooms, departures, kitchen, narrators] = &answers[..] else { panic!("{answers:?}") };
    let persons: Vec<_> = newest.iter().map(|row| &*row[1]).collect();
    assert_eq!(persons, ["ben", "ben", "ben", "Ada", "Ada", "Ada", "Ada"]);
    let mut rooms: Vec<_> = rooms.iter().map(|row| (&*row[0], &*row[1], &*row[4])).collect();
    rooms.sort_unstable();
    let of_ben = ["bathroom", "hall", "kitchen"].map(|room| ("ben", room, "1"));
    assert_eq!(rooms, [&[("Ada", "bathroom", "1"), ("Ada", "kitchen", "1")][..], &of_ben].concat());
    assert_eq!(departures.iter().map(|row| &row[1..]).collect::<Vec<_>>(), [["Ada", "1"]]);
    assert_eq!(kitchen.iter().map(|row| &row[1..]).collect::<Vec<_>>(), [["2", "2"]]);
    let rooms =
        |own: &PersonDay| (own.person.clone(), own.rooms.iter().map(|(room, _)| room.clone()).collect::<Vec<_>>());
    let week: Vec<_> = week(directory.path()).unwrap().iter().map(rooms).collect();
    let of = |person: &str, rooms: &[&str]| (person.to_owned(), rooms.iter().map(|room| (*room).to_owned()).collect());
    assert_eq!(week, [of("Ada", &["bathroom", "kitchen"]), of("ben", &["bathroom", "hall", "kitchen"])]);
    assert_eq!(narrators.iter().map(|row| &row[1..]).collect::<Vec<_>>(), [["7", "7", ""]]);
}

/// A process of another user can have made the log.
#[test]
fn a_database_without_permission_to_write_is_no_damage() {
    use rustix::thread::set_thread_res_uid;

    let outer = tempfile::tempdir().unwrap();
    let directory = outer.path().join("state");
    fs::create_dir(&directory).unwrap();
    drop(writer(&directory, 1 << 20));
    fs::set_permissions(directory.join("roomcast.db-wal"), PermissionsExt::from_mode(0o400)).unwrap();
    let user = rustix::process::geteuid().is_root().then(|| rustix::fs::Uid::from_raw(65_534));
    if user.is_some() {
        // Root may write anything, so a thread is another user.
        fs::set_permissions(outer.path(), PermissionsExt::from_mode(0o711)).unwrap();
        let files = fs::read_dir(&directory).unwrap().map(|file| file.unwrap().path());
        files.chain([directory.clone()]).for_each(|file| rustix::fs::chown(&file, user, None).unwrap());
    }
    let opens = || {
        user.map_or(Ok(()), |user| set_thread_res_uid(user, user, user)).unwrap();
        Database::open(&directory.join(FILE), SCHEMA).map(|_| ())
    };
    let opened = std::thread::scope(|scope| scope.spawn(opens).join().unwrap());
    assert!(matches!(&opened, Err(JournalError::Sqlite(..))), "{opened:?}");
    assert!(aside(&directory).is_none() && directory.join(FILE).exists());
}

#[test]
fn a_database_that_cannot_be_set_aside_keeps_its_log() {
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("roomcast.db-wal");
    fs::write(directory.path().join(FILE), "no database ".repeat(1000)).unwrap();
    fs::write(&log, "log").unwrap();
    (1..=16).for_each(|number| fs::create_dir(directory.path().join(format!("roomcast.db.damaged-{number}"))).unwrap());
    assert!(matches!(open(directory.path()), Err(JournalError::File(_, "set aside", _))));
    assert_eq!(fs::read(log).unwrap(), b"log");
}

#[test]
fn an_error_of_sqlite_is_said_once() {
    let full = rusqlite::ffi::Error::new(13);
    let error = Error::SqliteFailure(full, Some("database or disk is full".to_owned()));
    let said = crate::logging::chain(&JournalError::Sqlite("roomcast.db".into(), error));
    assert_eq!(said, "database roomcast.db: database or disk is full; check the disk and its space");
}

#[test]
fn a_failed_sync_writes_events_names_and_map_again_and_habits_that_were_never_written_stay_so() {
    let outer = tempfile::tempdir().unwrap();
    let (state, gone) = (outer.path().join("state"), outer.path().join("gone"));
    fs::create_dir(&state).unwrap();
    let (mut own, _) = writer(&state, 1 << 20);
    let ada = KeptPerson { number: PersonId(3), name: "Ada".to_owned(), resident: None, former: Vec::new() };
    own.write_persons(vec![ada.clone()]).unwrap();
    let (_, map) = maps();
    own.write_map(map.clone()).unwrap();
    own.write([event(&observation(1))]).unwrap();
    fs::rename(&state, &gone).unwrap();
    fs::create_dir(&state).unwrap();
    // The disk has not taken another name, so that it is in no later start either.
    own.write_persons(vec![ada.renamed("Eve")]).unwrap_err();
    own.write([event(&observation(2))]).unwrap();
    let recovered = own.recover().unwrap();
    let sequences: Vec<_> = recovered.observations.iter().map(|own| own.sequence).collect();
    assert_eq!((sequences, recovered.persons, recovered.habits), (vec![1, 2], vec![ada], None));
    assert_eq!(recovered.map, Some(map));
}
