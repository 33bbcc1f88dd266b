//! Every byte, every failure of a disk, every loss of power.

use std::collections::HashSet;
use std::path::Path;

use proptest::prelude::*;
use roomcast_core::forecast::PACES;
use roomcast_core::ids::{BootNs, EventId, PersonId, UnixNs};
use roomcast_core::narration::{Event, Sentence, person_number};

use super::record::*;
use super::writer::{SyncDue, UNREAD_MAX};
use super::*;

/// A folder on a disk that fails as it is told.
#[derive(Debug)]
struct Failing {
    folder: Folder,
    /// Nothing can be made or written, but for a part of it.
    is_full: bool,
    /// A next file finds no name.
    keeps_names: bool,
    /// A sync fails, and loses all that the open file has: its pages count as written.
    loses: bool,
    /// Names do not reach the disk.
    names_fail: bool,
    /// What a sync lost cannot be written again, and what an append left cannot be cut off.
    keeps_faults: bool,
    /// Nothing can be read.
    unreadable: bool,
    /// What is read of the current half from a byte on, in place of what is there.
    misread: Option<(usize, Vec<u8>)>,
}

impl Disk for Failing {
    fn read(&self, half: Half) -> io::Result<Vec<u8>> {
        if self.unreadable {
            return Err(io::Error::other("cannot be read"));
        }
        let mut bytes = self.folder.read(half)?;
        if let Some((at, given)) = self.misread.as_ref().filter(|_| half == Half::Current) {
            bytes[*at..*at + given.len()].copy_from_slice(given);
        }
        Ok(bytes)
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self.is_full {
            true => self.folder.append(&bytes[..bytes.len() / 2]).and(Err(io::ErrorKind::StorageFull.into())),
            false => self.folder.append(bytes),
        }
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        match self.keeps_faults {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => self.folder.cut(length),
        }
    }

    fn rewrite(&mut self, pieces: &[(u64, Vec<u8>)]) -> io::Result<()> {
        match self.keeps_faults {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => self.folder.rewrite(pieces),
        }
    }

    fn sync(&mut self) -> io::Result<()> {
        if self.loses {
            let length = self.folder.read(Half::Current)?.len();
            self.folder.rewrite(&[(0, vec![0; length])])?;
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.folder.sync()
    }

    fn prepare(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self.is_full {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => self.folder.prepare(bytes),
        }
    }

    fn is_current(&self) -> io::Result<bool> {
        self.folder.is_current()
    }

    fn retire(&mut self) -> io::Result<()> {
        self.folder.retire()
    }

    fn place(&mut self, half: Half) -> io::Result<()> {
        match self.keeps_names {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => self.folder.place(half),
        }
    }

    fn sync_names(&mut self) -> io::Result<()> {
        match self.names_fail {
            true => Err(io::ErrorKind::StorageFull.into()),
            false => self.folder.sync_names(),
        }
    }

    fn remove_aside(&mut self) -> io::Result<()> {
        self.folder.remove_aside()
    }
}

fn observation(sequence: u64) -> Observation {
    let sentence = Sentence::new(&format!("They do thing {sequence}.")).unwrap();
    let (observed_ns, observed_unix_ns) = (100 + sequence, 5);
    Observation {
        person: PersonId(3),
        source: 7,
        epoch: 1,
        observed_ns: BootNs(observed_ns),
        observed_unix_ns: UnixNs(observed_unix_ns),
        ..Observation::of(sequence, sentence)
    }
}

fn options(directory: &Path, bytes_max: u64) -> JournalOptions {
    JournalOptions { directory: directory.to_owned(), bytes_max, sync_ms: 1 }
}

/// Row "a sparse narration.journal.old of 4 GB" of the attacks; and a journal that was allowed to be larger before.
#[test]
fn a_half_that_is_too_large_is_kept_aside_and_its_newest_part_read() {
    let directory = tempfile::tempdir().unwrap();
    let (current, older) = (directory.path().join("narration.journal"), directory.path().join("narration.journal.old"));
    let large = options(directory.path(), 16 << 20);
    let (mut journal, _) = Journal::open(&large).unwrap();
    let all = 30_000;
    (0..all).for_each(|sequence| _ = journal.append(&observation(sequence)));
    drop(journal);
    let whole = fs::read(&current).unwrap();
    assert!(whole.len() > 2 << 20);
    let sparse = fs::File::create(&older).unwrap();
    sparse.set_len(4 << 30).unwrap();
    let small = options(directory.path(), 8192);
    let (mut journal, recovered) = Journal::open(&small).unwrap();
    let newest: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
    assert_eq!(newest, (all - newest.len() as u64..all).collect::<Vec<_>>());
    assert!(newest.len() > 1000 && newest.len() < all as usize);
    let [kept, other] = [&current, &older].map(|half| PathBuf::from(format!("{}.large-1", half.display())));
    assert_eq!(fs::read(&kept).unwrap(), whole);
    assert_eq!(fs::metadata(&other).unwrap().len(), 4 << 30);
    assert!(fs::metadata(&older).unwrap().len() < 2 << 20);
    // It goes on as any journal does, and is not set aside again.
    journal.append(&observation(all));
    drop(journal);
    let (_journal, recovered) = Journal::open(&small).unwrap();
    assert_eq!(recovered.carried.iter().chain(&recovered.observations).last().unwrap().sequence, all);
    assert!(!PathBuf::from(format!("{}.large-2", older.display())).exists());
}

/// Whoever is forgotten is in no file of the state directory afterwards, whatever was kept aside.
#[test]
fn what_is_kept_aside_goes_when_somebody_is_forgotten() {
    let directory = tempfile::tempdir().unwrap();
    let (mut journal, _) = Journal::open(&options(directory.path(), 16 << 20)).unwrap();
    let carla = |sequence| {
        let sentence = Sentence::new("Carla opens the fridge.").unwrap();
        Observation { person: PersonId(7), source: 3, epoch: 1, ..Observation::of(sequence, sentence) }
    };
    (0..20_000).for_each(|sequence| _ = journal.append(&carla(sequence)));
    drop(journal);
    let (journal, _) = Journal::open(&options(directory.path(), 8192)).unwrap();
    // One whose number follows none: somebody has removed the others.
    let current = directory.path().join("narration.journal");
    let first = PathBuf::from(format!("{}.large-1", current.display()));
    fs::copy(&first, format!("{}.large-64", current.display())).unwrap();
    let is_carla = |observation: &Observation, _: Option<PersonId>| observation.person == PersonId(7);
    assert!(journal.handle().forget(PersonId(7), is_carla, Instant::now() + Duration::from_secs(60)).unwrap() > 0);
    drop(journal);
    for file in fs::read_dir(directory.path()).unwrap() {
        let path = file.unwrap().path();
        let bytes = fs::read(&path).unwrap();
        assert!(!bytes.windows(5).any(|word| word == b"Carla"), "{}", path.display());
    }
    assert!(!first.exists());
}

#[test]
fn what_was_appended_comes_back() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 1 << 20);
    for run in 0..3 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let expected: Vec<_> = (0..run * 10).map(observation).collect();
        assert_eq!(recovered.observations, expected);
        for sequence in run * 10..(run + 1) * 10 {
            let number = journal.append(&observation(sequence));
            assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
        }
    }
}

/// As after the disk under a mount point is gone: the folder is there, and another one.
#[test]
fn what_is_said_into_a_folder_that_was_made_again_is_not_kept() {
    let outer = tempfile::tempdir().unwrap();
    let state = outer.path().join("state");
    for is_made_again in [false, true] {
        let (mut journal, _) = Journal::open(&options(&state, 1 << 20)).unwrap();
        journal.append(&observation(1));
        if is_made_again {
            fs::rename(&state, outer.path().join("gone")).unwrap();
            fs::create_dir(&state).unwrap();
        }
        let handle = journal.handle();
        assert!(handle.is_kept());
        // It syncs before it ends.
        drop(journal);
        assert_eq!(handle.is_kept(), !is_made_again);
    }
}

#[test]
fn the_size_is_bounded_and_the_newest_survive() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let (mut journal, _) = Journal::open(&options).unwrap();
    for sequence in 0..2000 {
        let number = journal.append(&observation(sequence));
        if sequence % 50 == 0 {
            assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
        }
    }
    let handle = journal.handle();
    drop(journal);
    let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
    assert!(size <= 16_384, "{size}");
    assert_eq!(handle.bytes(), size, "what is told is what is on the disk");
    let (journal, recovered) = Journal::open(&options).unwrap();
    assert_eq!(journal.handle().bytes(), size);
    assert_eq!(recovered.observations.last().unwrap().sequence, 1999);
    assert!(recovered.observations.len() > 50);
}

#[test]
fn a_source_that_fell_silent_stays_known() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let quiet = Observation { source: 99, ..observation(41) };
    let mut sequence = 0;
    for run in 0..4 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let known = recovered.carried.iter().chain(&recovered.observations).filter(|o| **o == quiet).count();
        assert!(run == 0 || known > 0, "{run}: {recovered:?}");
        assert!(
            recovered
                .observations
                .windows(2)
                .all(|pair| pair[0].source == 99 || pair[0].sequence < pair[1].sequence || pair[1].source == 99)
        );
        let port = recovered.ports.get(&(quiet.source, quiet.epoch));
        assert!(run == 0 || port == Some(&Port::simulated(3)), "{run}: {port:?}");
        if run == 0 {
            journal.bind((quiet.source, quiet.epoch), Port::simulated(3));
            journal.append(&quiet);
        }
        // Some rotations in every run.
        for _ in 0..700 {
            sequence += 1;
            let number = journal.append(&observation(sequence));
            assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
        }
        drop(journal);
        let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
        assert!(size <= 16_384, "{size}");
    }
}

/// A writer of an empty journal.
fn writer(folder: &Path, half_bytes: u64) -> Writer<Failing> {
    let folder = Folder::open(folder, 1 << 30).unwrap();
    let disk = Failing {
        folder,
        is_full: false,
        keeps_names: false,
        loses: false,
        names_fail: false,
        keeps_faults: false,
        unreadable: false,
        misread: None,
    };
    Writer::open(disk, half_bytes, &[0; 16]).unwrap().0
}

#[test]
fn a_quiet_source_stays_known_when_the_disk_is_full_at_a_rotation() {
    let directory = tempfile::tempdir().unwrap();
    let (current, older) = (directory.path().join("narration.journal"), directory.path().join("narration.journal.old"));
    let boot = [0; 16];
    let mut writer = writer(directory.path(), 4096);
    let quiet = Observation { source: 99, ..observation(41) };
    writer.write(&encode(&quiet, &boot)).unwrap();
    let mut sequence = 0;
    let mut next = || {
        sequence += 1;
        encode(&observation(sequence), &boot)
    };
    // Nothing of the quiet source in the second half.
    while !older.exists() {
        writer.write(&next()).unwrap();
    }
    for round in 0..4 {
        // There is no room for the next half; it comes later.
        writer.disk.is_full = true;
        while writer.length + 300 < 4096 {
            writer.disk.is_full = false;
            writer.write(&next()).unwrap();
            writer.disk.is_full = true;
        }
        for _ in 0..5 {
            writer.write(&next()).unwrap_err();
        }
        writer.disk.is_full = false;
        writer.write(&next()).unwrap();
        let mut recovered = Recovered::default();
        for half in [&older, &current] {
            read_records(&fs::read(half).unwrap(), &boot, &mut recovered);
        }
        let known = recovered.carried.iter().chain(&recovered.observations).any(|o| *o == quiet);
        assert!(known, "a restart after rotation {round} takes it again");
        assert_eq!(recovered.observations.last().unwrap().sequence, sequence_of(&writer));
        assert_eq!(recovered.damaged_bytes, 0);
    }
}

/// Who is named once is known again, however often all are spoken of afterwards.
#[test]
fn words_about_all_push_no_own_word_out() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let own = Observation { source: 99, name: Some("ada".into()), ..observation(1) };
    let of_all = |sequence: u64| {
        let event = Event::presence("everybody away").unwrap();
        Observation { source: 98, person: PersonId::SOMEBODY, event, ..observation(sequence) }
    };
    let told = |journal: &Journal, o: &Observation| {
        let outcome = Outcome { event: o.id(), person: PersonId(1), by_fit: false, map: 7, probability: &[] };
        journal.handle().append(&outcome);
    };
    let mut sequence = 0;
    for run in 0..3 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let recovered = recovered.join();
        if run == 0 {
            journal.append(&own);
            told(&journal, &own);
            for word in (2..20).map(of_all) {
                journal.append(&word);
                told(&journal, &word);
            }
        } else {
            assert!(recovered.observations.iter().any(|o| o.source == 99), "ada is lost in run {run}");
        }
        for _ in 0..700 {
            sequence += 1;
            journal.append(&observation(sequence));
        }
    }
}

/// A daemon that was killed before it scored what it had taken, or lost with the power what it told of it: the next rotation knows whose that is all
/// the same, and drops nobody.
#[test]
fn of_whom_nothing_was_told_is_kept_too() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let away = Event::Away;
    let of = |sequence: u64, name: &str, event: Event| Observation {
        source: 99,
        person: PersonId::SOMEBODY,
        name: Some(name.into()),
        event,
        ..observation(sequence)
    };
    let mut sequence = 0;
    for run in 0..4 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let recovered = recovered.join();
        if run == 0 {
            let told = of(1, "ada", observation(1).event);
            journal.append(&told);
            let person = person_number("ada");
            let probability = &[0.5, 0.5];
            journal.handle().append(&Outcome { event: told.id(), person, by_fit: false, map: 7, probability });
            journal.append(&of(2, "ada", away.clone()));
            journal.append(&of(3, "ben", away.clone()));
            journal.append(&Observation { source: 99, person: PersonId(5), ..observation(4) });
        } else {
            let kept: Vec<_> = recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
            assert_eq!(kept, [1, 2, 3, 4], "{run}");
        }
        for _ in 0..700 {
            sequence += 1;
            let number = journal.append(&observation(sequence));
            let (event, person, map) = (EventId::new(7, 1, sequence), PersonId(3), 7);
            let probability = &[0.5, 0.5];
            let outcome = Outcome { event, person, by_fit: false, map, probability };
            assert!(journal.handle().wait_for(number.max(journal.handle().append(&outcome)), Duration::from_secs(30)));
        }
    }
}

/// One narrator that says ten times what the journal holds makes the daemon forget nobody.
#[test]
fn who_says_much_pushes_nobody_out() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let boot = boot_id();
    let quiet = |sequence: u64, name: &str, said: &str| {
        let event = Event::presence(said);
        let event = event.unwrap_or_else(|_| Event::Did(Sentence::new("They lie on the bed.").unwrap()));
        Observation { source: 99, name: Some(name.into()), event, ..observation(sequence) }
    };
    let told = |journal: &Journal, o: &Observation, person: PersonId, probability: &[f64]| {
        journal.handle().append(&Outcome { event: o.id(), person, by_fit: false, map: 7, probability })
    };
    let words = [
        quiet(1, "ada", "They walk."),
        quiet(2, "ben", "present"),
        quiet(3, "eve", "away"),
        quiet(4, "ada", "They lie."),
        quiet(5, "all", "everybody away"),
    ];
    let mut sequence = 0;
    for run in 0..4 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let recovered = recovered.join();
        if run == 0 {
            for (word, person) in words.iter().zip([1, 2, 3, 1, 4]) {
                journal.append(word);
                told(&journal, word, PersonId(person), if person == 3 { &[] } else { &[0.25, 0.75] });
            }
            // Eve is forgotten, and then said to be away with everybody.
            let is_eve = |o: &Observation, _| o.name.as_deref() == Some("eve");
            assert_eq!(
                journal.handle().forget(PersonId(3), is_eve, Instant::now() + Duration::from_secs(30)).unwrap(),
                1
            );
            journal.append(&quiet(6, "ben", "present in the kitchen"));
            told(&journal, &quiet(6, "ben", "present"), PersonId(2), &[1.0, 0.0]);
        } else {
            let kept: Vec<u64> = recovered.observations.iter().filter(|o| o.source == 99).map(|o| o.sequence).collect();
            assert_eq!(kept, [1, 2, 4, 5, 6], "{run}");
            assert_eq!(recovered.observations[..5].iter().filter(|o| o.source == 99).count(), 5);
            let of_ben: Vec<_> =
                recovered.expectations.iter().filter(|(_, person, _)| *person == PersonId(2)).collect();
            assert_eq!(of_ben.len(), 2);
            assert_eq!((of_ben[1].0, &of_ben[1].2.probability[..]), (4, &[1.0, 0.0][..]));
            assert_eq!(recovered.forgotten, [(4, PersonId(3))], "{run}");
        }
        for _ in 0..700 {
            sequence += 1;
            let number = journal.append(&observation(sequence));
            let number = number.max(told(&journal, &observation(sequence), PersonId(0), &[0.5, 0.5]));
            assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
        }
        drop(journal);
        let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
        assert!(size <= 16_384, "{size}");
    }
    assert_ne!(boot, [0; 16]);
}

/// Who was told of by name in plain sentences, and since then by "she" or with all, is known by that name when the half that had it has gone.
#[test]
fn a_name_outlives_the_half_that_had_it() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let (mut journal, _) = Journal::open(&options).unwrap();
    let mut sequence = 0;
    let mut say = |journal: &mut Journal, text: &str, persons: &[PersonId], moves: Vec<Move>| {
        sequence += 1;
        let event = Event::Did(Sentence::new(text).unwrap());
        let said = Observation { person: PersonId::SOMEBODY, name: None, event, ..observation(sequence) };
        let mut number = journal.append(&said);
        if !moves.is_empty() {
            number = journal.handle().keep_moved(&Moved { observation: said.id(), moves });
        }
        for person in persons {
            for by_fit in [true, false] {
                let probability: &[f64] = if by_fit { &[] } else { &[0.5, 0.5] };
                let (person, map) = (*person, 7);
                let outcome = Outcome { event: said.id(), person, by_fit, map, probability };
                number = journal.handle().append(&outcome);
            }
        }
        assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
    };
    let [anna, tom] = ["anna", "tom"].map(person_number);
    for (person, name, text) in
        [(anna, "Anna", "Anna opens the fridge."), (tom, "Tom", "Tom sits on the sofa and yawns.")]
    {
        let of_them = Move { person, name: Some(name.into()), by_fit: false, event: None };
        say(&mut journal, text, &[person], vec![of_them]);
    }
    for _ in 0..20 {
        say(&mut journal, "She opens the fridge.", &[anna], vec![]);
        say(&mut journal, "He sits on the sofa.", &[tom], vec![]);
    }
    for _ in 0..400 {
        say(&mut journal, "Tomorrow, the weather will be fine.", &[], vec![]);
    }
    drop(journal);
    let (_, recovered) = Journal::open(&options).unwrap();
    assert!(recovered.has_rotated);
    let recovered = recovered.join();
    for name in ["Anna opens", "Tom sits on the sofa and"] {
        let has_it = |own: &Observation| own.sentence().is_some_and(|text| text.starts_with(name));
        assert!(recovered.observations.iter().any(has_it), "{name}");
    }
}

/// Words of one person that lie in different halves come back in their order, and so do those of one who was forgotten before.
#[test]
fn last_words_keep_their_order_over_rotations() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 8192);
    let of_ada = |sequence: u64| Observation { source: 99, name: Some("ada".into()), ..observation(sequence) };
    let say = |journal: &mut Journal, o: &Observation, person: PersonId, by_fit: bool| {
        journal.append(o);
        let outcome = Outcome { event: o.id(), person, by_fit, map: 7, probability: &[] };
        let number = journal.handle().append(&outcome);
        assert!(journal.handle().wait_for(number, Duration::from_secs(30)));
    };
    let (mut noise, mut expected) = (0, Vec::new());
    for round in 0..12 {
        let (mut journal, recovered) = Journal::open(&options).unwrap();
        let recovered = recovered.join();
        let of_source = recovered.observations.iter().filter(|o| o.source == 99 && o.sequence < 1000);
        assert_eq!(of_source.map(|o| o.sequence).collect::<Vec<_>>(), expected, "{round}");
        match round {
            0 | 1 | 2 | 6 => {
                say(&mut journal, &of_ada(round), PersonId(1), false);
                expected.push(round);
            }
            4 => {
                journal
                    .handle()
                    .forget(PersonId(1), |o, _| o.source == 99, Instant::now() + Duration::from_secs(30))
                    .unwrap();
                expected.clear();
            }
            // What names somebody and changes nothing does not count.
            7 => (0..20).for_each(|number| say(&mut journal, &of_ada(1000 + number), PersonId(1), true)),
            _ => {}
        }
        // About one rotation and a half.
        for _ in 0..35 {
            noise += 1;
            say(&mut journal, &observation(noise), PersonId(0), false);
        }
    }
    assert_eq!(expected, [6]);
}

/// A disk that cannot be read for a while takes nobody's last words; one that can never be read again does not end the journal.
#[test]
fn a_rotation_that_cannot_read_is_put_off_and_not_for_ever() {
    for (fails, is_known) in [(UNREAD_MAX, true), (u32::MAX, false)] {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path(), 4096);
        let ada = Observation { source: 99, name: Some("ada".into()), ..observation(1) };
        let outcome =
            Outcome { event: EventId::new(99, 1, 1), person: PersonId(1), by_fit: false, map: 7, probability: &[] };
        writer.write(&[encode(&ada, &[0; 16]), encode_outcome(&outcome)].concat()).unwrap();
        let mut failed = 0;
        // Until nothing but last words can have ada's.
        for sequence in 2..400 {
            writer.disk.unreadable = failed < fails;
            failed += u32::from(writer.write(&encode(&observation(sequence), &[0; 16])).is_err());
        }
        writer.disk.unreadable = false;
        let mut recovered = Recovered::default();
        for half in [Half::Older, Half::Current] {
            read_records(&writer.disk.read(half).unwrap(), &[0; 16], &mut recovered);
        }
        let back = recovered.join().observations;
        assert_eq!(back.iter().any(|own| own.source == 99), is_known, "{fails}");
        writer.write(&encode(&observation(400), &[0; 16])).unwrap();
        assert!(failed >= fails.min(UNREAD_MAX) && writer.unwritten.is_empty(), "{failed}");
    }
}

fn sequence_of(writer: &Writer<Failing>) -> u64 {
    let mut recovered = Recovered::default();
    read_records(&writer.last[&(7, 1)].record, &[0; 16], &mut recovered);
    recovered.observations[0].sequence
}

#[test]
fn two_daemons_cannot_share_it() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 1 << 20);
    let _first = Journal::open(&options).unwrap();
    assert!(matches!(Journal::open(&options), Err(JournalError::Locked { .. })));
}

/// Nothing that a person did stays in the journal, in neither half, and what a narrator sends again does not bring it back.
#[test]
fn who_is_forgotten_leaves_no_trace() {
    let directory = tempfile::tempdir().unwrap();
    let options = options(directory.path(), 16_384);
    let (mut journal, _) = Journal::open(&options).unwrap();
    let handle = journal.handle();
    let of = |sequence: u64, name: &str| {
        let sentence = Sentence::new(&format!("They do secret {sequence}.")).unwrap();
        let name = Some(name).filter(|name| !name.is_empty()).map(Into::into);
        let person = PersonId::SOMEBODY;
        Observation { person, name, source: 7, epoch: sequence / 64, ..Observation::of(sequence, sentence) }
    };
    for sequence in 1..=120 {
        let name = ["ada", "ben", ""][sequence as usize % 3];
        let mut number = journal.append(&of(sequence, name));
        if name.is_empty() {
            let event = EventId::new(7, sequence / 64, sequence);
            let person = PersonId(1 + sequence as u32 % 2);
            let outcome = Outcome { event, person, by_fit: true, map: 1, probability: &[] };
            number = handle.append(&outcome);
        }
        // More at once than a half holds would be cut.
        assert!(handle.wait_for(number, Duration::from_secs(30)));
    }
    let is_ada = |o: &Observation| o.name.as_deref() == Some("ada");
    let is_theirs = move |o: &Observation, found: Option<PersonId>| is_ada(o) || found == Some(PersonId(1));
    assert!(handle.forget(PersonId(1), is_theirs, Instant::now() + Duration::from_secs(30)).unwrap() > 0);
    assert_eq!(handle.forget(PersonId(1), is_theirs, Instant::now() + Duration::from_secs(30)).unwrap(), 0);
    let last = journal.append(&of(121, "ben"));
    assert!(handle.wait_for(last, Duration::from_secs(30)));
    let size: u64 = fs::read_dir(directory.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
    assert_eq!(handle.bytes(), size);
    assert!(matches!(Journal::open(&options), Err(JournalError::Locked { .. })));
    drop(journal);
    let (_, recovered) = Journal::open(&options).unwrap();
    let theirs = |o: &Observation| is_ada(o) || (o.by_fit && o.person == PersonId(1));
    assert!(!recovered.observations.iter().any(theirs) && recovered.observations.len() > 50);
    assert!(recovered.observations.iter().any(|o| o.by_fit && o.person == PersonId(2)));
    let all: Vec<u8> = ["narration.journal", "narration.journal.old"]
        .iter()
        .flat_map(|half| fs::read(directory.path().join(half)).unwrap())
        .collect();
    let all = String::from_utf8_lossy(&all);
    assert!(!all.contains("ada") && !all.contains("secret 3.") && all.contains("secret 4."));
    // All is still known to be taken, in its order.
    let taken: Vec<u64> = recovered.taken().map(|o| o.sequence).collect();
    assert!(taken.windows(2).all(|pair| pair[0] < pair[1]) && taken.last() == Some(&121), "{taken:?}");
}

/// Names, presence and attributions come back as they were; what the model said comes with the observation that it followed.
#[test]
fn who_was_where_comes_back() {
    let boot = [3; 16];
    let named = |sequence: u64, name: &str| Observation { name: Some(name.into()), ..observation(sequence) };
    let away = Event::Away;
    let told = [
        observation(1),
        named(2, "Ada"),
        Observation { event: away, ..named(3, "Éva") },
        Observation { person: PersonId::SOMEBODY, ..observation(4) },
    ];
    let mut bytes: Vec<u8> = told.iter().flat_map(|observation| encode(observation, &boot)).collect();
    let outcome = |sequence: u64, by_fit: bool, probability: &'static [f64]| {
        let (person, map) = (9, 77);
        encode_outcome(&Outcome {
            event: EventId::new(7, 1, sequence),
            person: PersonId(person),
            by_fit,
            map,
            probability,
        })
    };
    for outcome in [outcome(2, false, &[0.25, 0.75]), outcome(4, true, &[]), outcome(99, true, &[1.0])] {
        bytes.extend_from_slice(&outcome);
    }
    let (last, probability) = (EventId::new(7, 1, 2), vec![0.5, 0.5]);
    bytes.extend(encode_believed(&Believed { last, person: PersonId(9), map: 78, paces: [40.5; PACES], probability }));
    let mut recovered = Recovered::default();
    read_records(&bytes, &boot, &mut recovered);
    let attributed = Observation { person: PersonId(9), by_fit: true, ..told[3].clone() };
    assert_eq!(recovered.observations, [told[0].clone(), told[1].clone(), told[2].clone(), attributed.clone()]);
    let next = Expectation { map: 77, paces: None, probability: vec![0.25, 0.75] };
    let was = Expectation { map: 78, paces: Some([40.5; PACES]), probability: vec![0.5, 0.5] };
    assert_eq!(recovered.expectations, [(1, PersonId(9), next), (1, PersonId(9), was)]);
    assert_eq!(recovered.damaged_bytes, 0);
    // Whom an observation moved comes back in its order, nobody included.
    let said = |text: &str| Event::presence(text).ok();
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
                by(PersonId(2), "", said("away")),
                by(PersonId(3), "", said("away")),
                by(PersonId::SOMEBODY, "", said("nobody in the kitchen")),
                by(PersonId(4), "Mia", sentence.clone()),
                by(PersonId(5), "", sentence),
                by(PersonId(6), "", None),
            ],
        },
    ];
    let mut again = Recovered::default();
    read_records(&moved.iter().flat_map(encode_moved).collect::<Vec<u8>>(), &boot, &mut again);
    assert_eq!(again.damaged_bytes, 0);
    for Moved { observation, moves } in moved {
        assert_eq!(again.moved.remove(&observation), Some(moves));
    }
    // An attribution that is carried over stays one.
    let mut again = Recovered::default();
    read_records(&encode(&attributed, &boot), &boot, &mut again);
    assert_eq!(again.observations, [attributed]);
}

#[test]
fn another_boots_monotonic_time_is_dropped() {
    let mut recovered = Recovered::default();
    read_records(&encode(&observation(1), &[1; 16]), &[2; 16], &mut recovered);
    read_records(&encode(&observation(2), &[2; 16]), &[2; 16], &mut recovered);
    assert_eq!(recovered.observations[0].observed_ns, BootNs(0));
    assert_eq!(recovered.of_other_boots, HashSet::from([EventId::new(7, 1, 1)]));
}

proptest! {
    #[test]
    fn a_torn_end_loses_one_record_and_damage_only_what_it_touches(cut in 0usize..500, at in 0usize..500, bit in 0u8..8) {
        let boot = [0; 16];
        let whole: Vec<u8> = (0..5).flat_map(|n| encode(&observation(n), &boot)).collect();
        let record = whole.len() / 5;

        let cut = cut.min(whole.len());
        let mut torn = Recovered::default();
        read_records(&whole[..cut], &boot, &mut torn);
        prop_assert_eq!(torn.observations.len(), cut / record);

        let mut damaged = whole.clone();
        let at = at % damaged.len();
        damaged[at] ^= 1 << bit;
        let mut found = Recovered::default();
        read_records(&damaged, &boot, &mut found);
        prop_assert_eq!(found.observations.len(), 4);
        let lost = (at / record) as u64;
        prop_assert!(found.observations.iter().all(|o| o.sequence != lost && *o == observation(o.sequence)));
    }

    #[test]
    fn arbitrary_bytes_are_no_trap(bytes in prop::collection::vec(any::<u8>(), 0..2000)) {
        let mut recovered = Recovered::default();
        read_records(&bytes, &[0; 16], &mut recovered);
        prop_assert!(recovered.damaged_bytes as usize <= bytes.len());
    }
}

/// A rotation that fails after the full half got its new name loses nothing, at the next one or at a restart.
#[test]
fn a_rotation_that_fails_half_way_keeps_both_halves() {
    for restarts in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let older = folder.path().join("narration.journal.old");
        let mut writer = writer(folder.path(), 4096);
        let mut sequence = 0;
        let mut next = || {
            sequence += 1;
            encode(&observation(sequence), &[0; 16])
        };
        while !older.exists() {
            writer.write(&next()).unwrap();
        }
        let before = writer.last.len();
        writer.disk.keeps_names = true;
        while writer.write(&next()).is_ok() {}
        let full = fs::read(&older).unwrap();
        assert!(full.len() > 2048 && !folder.path().join("narration.journal").exists());
        if restarts {
            drop(writer);
            writer = self::writer(folder.path(), 4096);
        }
        writer.disk.keeps_names = false;
        writer.write(&next()).unwrap();
        assert_eq!(fs::read(&older).unwrap(), full);
        assert_eq!(writer.last.len(), before);
    }
}

/// A sync keeps out of the way of what is written, is never later than promised, and not more frequent than that.
#[test]
fn a_sync_waits_for_silence_and_not_longer_than_promised() {
    let (start, every) = (Instant::now(), Duration::from_secs(1));
    let at = |ms: u64| start + Duration::from_millis(ms);
    let mut due = SyncDue::new(every, start);
    assert_eq!(due.at(), Some(at(1000)), "what a process before has left");
    due.synced(true, at(1003));
    assert_eq!(due.at(), None);
    // After a long silence it follows soon, and not at once.
    due.wrote(at(5000));
    due.wrote(at(5002));
    assert_eq!(due.at(), Some(at(5102)));
    due.synced(true, at(5105));
    // More often than promised it is not.
    due.wrote(at(5600));
    assert_eq!(due.at(), Some(at(6105)));
    // Who never falls silent does not put it off.
    for ms in (6050..6600).step_by(50) {
        due.wrote(at(ms));
    }
    assert_eq!(due.at(), Some(at(6600)));
    due.synced(false, at(6604));
    assert_eq!(due.at(), Some(at(7604)), "what it failed with is tried again");
    let mut due = SyncDue::new(Duration::from_millis(1), start);
    due.wrote(at(50));
    assert_eq!(due.at(), Some(at(1)));
}

/// A power loss that finds a folder not synced takes all that was written to a new half: so that is tried again.
#[test]
fn names_that_a_sync_fails_with_are_synced_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = writer(folder.path(), 4096);
    writer.sync().unwrap();
    writer.disk.names_fail = true;
    // No name has changed.
    writer.write(&encode(&observation(1), &[0; 16])).unwrap();
    writer.sync().unwrap();
    let mut sequence = 1;
    while !folder.path().join("narration.journal.old").exists() {
        sequence += 1;
        writer.write(&encode(&observation(sequence), &[0; 16])).unwrap();
    }
    writer.sync().unwrap_err();
    writer.sync().unwrap_err();
    writer.disk.names_fail = false;
    writer.sync().unwrap();
}

/// A disk that fails twice in a row: what a sync lost is not written again at once, and what a failed append left is not cut off at once.
/// The next sync and the next append do that first.
#[test]
fn faults_behind_faults_take_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = writer(folder.path(), 1 << 16);
    let record = |sequence| encode(&observation(sequence), &[7; 16]);
    let read = |writer: &Writer<Failing>| {
        let mut recovered = Recovered::default();
        read_records(&writer.disk.read(Half::Current).unwrap(), &[7; 16], &mut recovered);
        let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        (sequences, recovered.damaged_bytes)
    };
    writer.write(&record(1)).unwrap();
    (writer.disk.loses, writer.disk.keeps_faults) = (true, true);
    writer.sync().unwrap_err();
    (writer.disk.loses, writer.disk.keeps_faults) = (false, false);
    writer.sync().unwrap();
    assert_eq!(read(&writer), (vec![1], 0));

    (writer.disk.is_full, writer.disk.keeps_faults) = (true, true);
    writer.write(&record(2)).unwrap_err();
    // As long as nobody knows where the file ends, nothing is put behind it.
    writer.disk.is_full = false;
    writer.write(&record(3)).unwrap_err();
    writer.disk.keeps_faults = false;
    writer.write(&record(4)).unwrap();
    assert_eq!(read(&writer), (vec![1, 2, 3, 4], 0));
}

/// More at once than a half holds, as from a daemon that stood still, goes into both.
#[test]
fn a_batch_larger_than_half_is_rotated_and_not_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = writer(folder.path(), 4096);
    let batch: Vec<u8> = (1..=60).flat_map(|sequence| encode(&observation(sequence), &[7; 16])).collect();
    assert!(batch.len() > 4096 && batch.len() < 7000, "{}", batch.len());
    writer.write(&batch).unwrap();
    let (_, recovered) = Writer::open(writer.disk, 4096, &[7; 16]).unwrap();
    assert_eq!(recovered.observations.len(), 60);
}

/// Whoever invents sources leaves the others whose they are and what they said last, also in the smallest journal.
#[test]
fn invented_sources_push_out_their_own() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = writer(folder.path(), 4096);
    let said = |source, epoch| encode(&Observation { source, epoch, ..observation(epoch) }, &[7; 16]);
    let (honest, stranger) = (Port::simulated(1), Port::simulated(2));
    writer.write(&[encode_port((7, 1), honest), said(7, 1)].concat()).unwrap();
    for epoch in 1..=200 {
        writer.write(&[encode_port((99, epoch), stranger), said(99, epoch)].concat()).unwrap();
    }
    let (_, recovered) = Writer::open(writer.disk, 4096, &[7; 16]).unwrap();
    assert_eq!(recovered.ports.get(&(7, 1)), Some(&honest));
    assert!(recovered.carried.iter().any(|last| (last.source, last.sequence) == (7, 1)));
    assert_eq!(recovered.settled().get(&(7, 1)), Some(&1));
}

/// What another daemon wrote and did not sync is written again, too.
#[test]
fn what_a_killed_daemon_wrote_is_synced() {
    let folder = tempfile::tempdir().unwrap();
    let mut first = writer(folder.path(), 1 << 16);
    first.write(&encode(&observation(1), &[7; 16])).unwrap();
    drop(first);
    let mut second = writer(folder.path(), 1 << 16);
    second.disk.loses = true;
    assert!(second.sync().is_err());
    second.disk.loses = false;
    second.sync().unwrap();
    let mut recovered = Recovered::default();
    read_records(&second.disk.read(Half::Current).unwrap(), &[7; 16], &mut recovered);
    assert_eq!((recovered.observations.len(), recovered.damaged_bytes), (1, 0));
}

/// A disk that gives a start a block of elsewhere, or of before, and then fails a sync: what it gave is not written over what it has.
#[test]
fn what_was_misread_is_not_written_over_the_disk() {
    let boot = [7; 16];
    for is_stale in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let mut first = writer(folder.path(), 1 << 16);
        for sequence in 1..=20 {
            first.write(&encode(&observation(sequence), &boot)).unwrap();
        }
        first.sync().unwrap();
        let mut disk = first.disk;
        let whole = disk.read(Half::Current).unwrap();
        disk.misread = Some((512, if is_stale { vec![0; 512] } else { whole[1024..1536].to_vec() }));
        let (mut second, recovered) = Writer::open(disk, 1 << 16, &boot).unwrap();
        assert!((10..18).contains(&recovered.observations.len()), "{}", recovered.observations.len());
        second.write(&encode(&observation(21), &boot)).unwrap();
        // The sync loses what others had not brought to the disk: of where the block came from, too, and what is new.
        let length = second.disk.folder.read(Half::Current).unwrap().len();
        second.disk.folder.rewrite(&[(1152, vec![0; length - 1152])]).unwrap();
        second.lacks_pages = true;
        second.sync().unwrap();
        second.disk.misread = None;
        let mut recovered = Recovered::default();
        read_records(&second.disk.read(Half::Current).unwrap(), &boot, &mut recovered);
        let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
        assert_eq!((sequences, recovered.damaged_bytes), ((1..=21).collect(), 0), "{is_stale}");
    }
}

/// A disk that gives a block twice, or a daemon that was told again what its disk hid from it, makes nobody say anything twice.
#[test]
fn what_is_read_twice_is_said_once() {
    let boot = [7; 16];
    let all: Vec<u8> = [1, 2, 3, 2, 3, 4, 1].iter().flat_map(|n| encode(&observation(*n), &boot)).collect();
    let mut recovered = Recovered::default();
    read_records(&all, &boot, &mut recovered);
    read_records(&all, &boot, &mut recovered);
    let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
    assert_eq!(sequences, [1, 2, 3, 4]);
}

/// A named pipe would be waited for, and a device read without end.
#[test]
fn a_journal_that_is_no_plain_file_is_refused() {
    for name in ["narration.journal", "narration.journal.old"] {
        let folder = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink("/dev/null", folder.path().join(name)).unwrap();
        let options = JournalOptions { directory: folder.path().to_owned(), bytes_max: 8192, sync_ms: 1000 };
        let error = Journal::open(&options).unwrap_err().to_string();
        assert!(error.contains("it is a symbolic link: remove it"), "{name}: {error}");
    }
}

#[test]
fn a_journal_in_a_folder_that_others_may_write_to_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("narration.journal");
    fs::write(&path, "theirs").unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o1777)).unwrap();
    let options = JournalOptions { directory: folder.path().to_owned(), bytes_max: 8192, sync_ms: 1000 };
    let error = Journal::open(&options).unwrap_err().to_string();
    assert!(error.contains("other users may write to its folder (mode 1777): run `chmod go-w "), "{error}");
    assert_eq!(fs::read_to_string(&path).unwrap(), "theirs");
}

/// Row "fsync that fails once" of the attacks: what was written before it is lost with the power, if it is not written again.
#[test]
fn what_a_sync_fails_with_is_written_again() {
    let folder = tempfile::tempdir().unwrap();
    let current = folder.path().join("narration.journal");
    let mut writer = writer(folder.path(), 1 << 16);
    writer.disk.loses = true;
    for sequence in 1..=3 {
        writer.write(&encode(&observation(sequence), &[7; 16])).unwrap();
    }
    assert!(writer.sync().is_err());
    writer.disk.loses = false;
    writer.write(&encode(&observation(4), &[7; 16])).unwrap();
    writer.sync().unwrap();
    let mut recovered = Recovered::default();
    read_records(&fs::read(&current).unwrap(), &[7; 16], &mut recovered);
    let sequences: Vec<_> = recovered.observations.iter().map(|observation| observation.sequence).collect();
    assert_eq!((sequences, recovered.damaged_bytes), (vec![1, 2, 3, 4], 0));
}
