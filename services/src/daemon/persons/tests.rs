use roomcast_core::grounding::{Grounding, GroundingOptions};
use roomcast_core::narration::{PresenceStatement, SOMEBODY, Sentence, person_number};
use roomcast_core::pipeline::{Pipeline, PipelineOptions};
use roomcast_core::scorer::table::TableModel;
use roomcast_core::semantic_map::SemanticMap;
use roomcast_ipc::{Message, PersonV1, forecast_flags, score_flags};

use super::super::answers::answer_about_person;
use super::super::journal::{
    Journal, JournalOptions, Outcome, Recovered, each_record, encode, encode_believed, encode_forgotten, encode_moved,
    encode_outcome, read_records,
};
use super::super::person_question::{PersonAnswer, PersonQuestion};
use super::super::{Board, Entry};
use super::*;

mod sentences;

const S: u64 = 1_000_000_000;
const BOOT: [u8; 16] = [5; 16];
const STUDIO: &str = include_str!("../../../../scenes/studio.json");
const FLAT: &str = include_str!("../../../../scenes/flat.json");

/// A daemon without threads, and its journal.
struct House {
    board: Board<TableModel>,
    config: PersonsConfig,
    journal: Vec<u8>,
    said: u64,
    now_ns: u64,
}

fn board(config: &PersonsConfig) -> Board<TableModel> {
    board_of(STUDIO, config)
}

fn board_of(scene: &str, config: &PersonsConfig) -> Board<TableModel> {
    board_on(SemanticMap::from_json(scene).unwrap(), config)
}

fn board_on(map: SemanticMap, config: &PersonsConfig) -> Board<TableModel> {
    let options = GroundingOptions::default();
    let grounding = Grounding::new(&map, &options).unwrap();
    let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
    let persons = Persons::new(config.clone(), PersonsFile::default());
    Board::new(pipeline, map, options, 1).unwrap().with_persons(persons)
}

impl House {
    fn new(residents: &[&str]) -> Self {
        let residents = residents.iter().map(|name| (*name).to_owned()).collect();
        let config = PersonsConfig { residents, ..PersonsConfig::default() };
        Self { board: board(&config), config, journal: Vec::new(), said: 0, now_ns: 100_000 * S }
    }

    fn observation(&mut self, who: &str, text: &str) -> Observation {
        let statement = PresenceStatement::parse(text).map(Said::Presence);
        let said = statement.unwrap_or_else(|_| Said::of(Sentence::new(text).unwrap()));
        self.said += 1;
        Observation {
            person: who.parse().unwrap_or(SOMEBODY),
            name: Some(who).filter(|name| name.parse::<u32>().is_err() && *name != "somebody").map(Into::into),
            source: 7,
            epoch: 1,
            observed_ns: self.now_ns,
            observed_unix_ns: 1_000_000 * S + self.now_ns,
            said,
            ..Observation::of(self.said, Sentence::new("They wait.").unwrap())
        }
    }

    fn enter(&mut self, observation: Observation) {
        self.journal.extend(encode(&observation, &BOOT));
        let entry = Entry::new(observation, self.now_ns);
        self.step(Some(entry));
    }

    fn step(&mut self, entry: Option<Entry>) {
        self.board.step(entry, self.now_ns, 1_000_000 * S + self.now_ns).unwrap();
        let journal = &mut self.journal;
        self.board.tell_beliefs(|believed| journal.extend(encode_believed(&believed)));
        self.board.tell_moved(|moved| journal.extend(encode_moved(moved)));
        self.board.tell_gone(|person| journal.extend(encode_forgotten(person, false)));
        self.board.tell_outcomes(|outcome| journal.extend(encode_outcome(outcome)));
    }

    /// Another narrator says something at once.
    fn after_by(&mut self, source: u64, who: &str, text: &str) {
        self.said += 1;
        self.now_ns += S;
        let observation = Observation {
            name: Some(who.into()),
            source,
            epoch: 1,
            observed_ns: self.now_ns,
            ..Observation::of(self.said, Sentence::new(text).unwrap())
        };
        self.step(Some(Entry::new(observation, self.now_ns)));
    }

    /// Time passes, and then somebody says or does something.
    fn after(&mut self, seconds: u64, who: &str, text: &str) {
        self.wait(seconds);
        let observation = self.observation(who, text);
        self.enter(observation);
    }

    /// Time passes; the loop looks once at its end whether that changes something.
    fn wait(&mut self, seconds: u64) -> bool {
        self.now_ns += seconds * S;
        let overdue = self.board.is_overdue(self.now_ns);
        if overdue {
            self.step(None);
            assert!(!self.board.is_overdue(self.now_ns), "once");
        }
        overdue
    }

    fn person(&mut self, who: &str) -> Option<PersonV1> {
        let told = *self.board.person_scores(self.now_ns);
        told.check().unwrap();
        let number = who.parse().unwrap_or_else(|_| self.board.persons().number_of(who));
        told.persons().iter().find(|person| person.person == number).copied()
    }

    fn presence(&mut self, who: &str) -> Option<u32> {
        self.person(who).map(|person| person.presence)
    }

    /// How likely somebody is in each room now, and elsewhere.
    fn now(&mut self) -> (Vec<f32>, f32) {
        let forecast = self.board.forecast(self.now_ns);
        forecast.check().unwrap();
        (forecast.probability.iter().take(3).map(|row| row[0]).collect(), forecast.elsewhere[0])
    }

    fn known(&mut self) -> u32 {
        self.board.snapshot().persons
    }

    /// The daemon is killed and starts again.
    fn restart(&mut self) {
        self.restart_on(board(&self.config));
    }

    /// The same on another board.
    fn restart_on(&mut self, board: Board<TableModel>) {
        let mut recovered = Recovered::default();
        read_records(&self.journal, &BOOT, &mut recovered);
        assert_eq!(recovered.damaged_bytes, 0);
        self.board = board;
        let unix_ns = 1_000_000 * S + self.now_ns;
        self.board.restore(recovered.join(), self.now_ns, unix_ns);
        self.step(None);
    }
}

#[test]
fn everybody_may_leave_and_come_back() {
    let mut house = House::new(&[]);
    house.after(1, "ada", "They sit on the sofa.");
    house.after(1, "ben", "They lie on the bed.");
    assert_eq!((house.presence("ada"), house.known()), (Some(presence::PRESENT), 2));
    house.after(10, "ada", "Ada leaves the house.");
    let ada = house.person("ada").unwrap();
    assert_eq!((ada.presence, ada.elsewhere, ada.window), (presence::AWAY, 1.0, 0));
    assert_eq!((ada.since_ns, ada.observed_ns, ada.name()), (house.now_ns, house.now_ns, "ada"));
    assert!(ada.probability.iter().all(|p| *p == 0.0) && ada.log_score_nats[0] == f64::NEG_INFINITY);
    assert!(!house.board.snapshot().has(score_flags::NOBODY_HOME));
    assert_eq!(house.board.snapshot().person, house.board.persons().number_of("ben"));
    house.after(10, "ben", "away");
    let snapshot = *house.board.snapshot();
    snapshot.check().unwrap();
    assert!(snapshot.has(score_flags::NOBODY_HOME) && !snapshot.has(score_flags::NO_NARRATION));
    assert!(snapshot.rooms().iter().all(|room| room.probability == 0.0));
    let forecast = *house.board.forecast(house.now_ns);
    assert_eq!((forecast.flags, forecast.elsewhere[0]), (forecast_flags::NOBODY_HOME, 1.0));
    assert!(forecast.elsewhere[15] < 1.0, "somebody comes back some time");
    let persons = *house.board.person_forecasts(house.now_ns);
    persons.check().unwrap();
    for person in persons.persons() {
        for horizon in 0..16 {
            let rooms: f32 = person.probability.iter().map(|row| row[horizon]).sum();
            assert!((rooms + person.elsewhere[horizon] - 1.0).abs() < 1e-5);
        }
    }
    house.after(600, "ada", "They come home.");
    assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::PRESENT), Some(presence::AWAY)));
    assert!((house.now().0.iter().sum::<f32>() - 1.0).abs() < 1e-5);
    house.after(1, "ada", "present in the kitchen");
    let forecast = house.now().0;
    assert!(forecast.iter().any(|p| *p > 0.9), "{forecast:?}");
}

/// Gone is told once, and then forgotten.
#[test]
fn who_is_gone_is_forgotten() {
    let mut house = House::new(&["Ada"]);
    house.after(1, "ada", "They sit on the sofa.");
    house.after(1, "plumber", "They walk to the kitchen.");
    assert_eq!(house.person("plumber").unwrap().flags, person_flags::VISITOR);
    assert_eq!(house.person("ada").unwrap().flags, 0);
    house.after(60, "plumber", "gone");
    let gone = house.person("plumber").unwrap();
    assert_eq!((gone.presence, gone.elsewhere, house.known()), (presence::GONE, 1.0, 1));
    let told = *house.board.person_forecasts(house.now_ns);
    told.check().unwrap();
    assert_eq!(told.persons().iter().filter(|person| person.elsewhere[3] == 1.0).count(), 1);
    house.after(1, "ada", "They stand up.");
    assert!(house.person("plumber").is_none());
    // A visitor who falls silent is gone, too; a resident is not, and a restart does not bring the visitor back.
    house.after(1, "3", "They walk to the kitchen.");
    assert!(!house.wait(3 * 3600) || house.presence("3") == Some(presence::PRESENT));
    assert!(house.wait(2));
    assert_eq!((house.presence("3"), house.presence("ada")), (Some(presence::GONE), Some(presence::PRESENT)));
    house.restart();
    house.after(1, "ada", "They sit on the sofa.");
    assert_eq!((house.presence("3"), house.known()), (None, 1));
}

/// What names nobody goes to whom it fits, says so, and makes nobody new.
#[test]
fn what_names_nobody_goes_to_whom_it_fits() {
    let mut house = House::new(&[]);
    house.after(1, "somebody", "They sit on the sofa.");
    assert_eq!((house.known(), house.person("0").unwrap().flags), (1, person_flags::BY_FIT));
    let mut house = House::new(&[]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "ben", "They lie on the bed.");
    for (sentence, who, other) in [
        ("They close the fridge.", "ada", "ben"),
        ("They sit on the bed.", "ben", "ada"),
        ("They walk to the kitchen.", "ada", "ben"),
        // Nothing says where: whoever did something last.
        ("They stretch.", "ada", "ben"),
        ("present in the kitchen", "ada", "ben"),
    ] {
        let before = house.person(other).unwrap().observed_ns;
        house.after(3, "somebody", sentence);
        let fits = house.person(who).unwrap();
        assert_eq!((fits.flags, fits.observed_ns), (person_flags::BY_FIT, house.now_ns), "{sentence}");
        assert_eq!((house.person(other).unwrap().observed_ns, house.known()), (before, 2), "{sentence}");
    }
    house.after(3, "ada", "They grab the mug.");
    assert_eq!(house.person("ada").unwrap().flags, 0);
    // Somebody leaves: not the one in bed. With nobody there, the one who is away for longer is back.
    house.after(3, "somebody", "away");
    assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::AWAY), Some(presence::PRESENT)));
    house.after(3, "ben", "away");
    house.after(3, "somebody", "They open the fridge.");
    assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::PRESENT), Some(presence::AWAY)));
    assert_eq!(house.known(), 2);
}

/// A sleeper is not the one who leaves.
#[test]
fn who_lies_in_bed_in_silence_is_possibly_asleep() {
    let mut house = House::new(&[]);
    house.after(1, "ada", "They lie on the bed.");
    house.after(1, "ada", "They fall asleep.");
    assert_eq!(house.person("ada").unwrap().flags, 0);
    house.wait(1201);
    assert_eq!(house.person("ada").unwrap().flags, person_flags::ASLEEP);
    house.after(1, "ben", "They sit on the sofa.");
    house.after(5, "somebody", "away");
    assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::PRESENT), Some(presence::AWAY)));
    house.after(1, "ada", "They walk to the fridge.");
    house.wait(1300);
    assert_eq!(house.person("ada").unwrap().flags, 0);
}

/// What lies hours back does not say what comes next, also when nothing new is said; where they are, is still believed.
#[test]
fn silence_ends_a_window_once() {
    let mut house = House::new(&[]);
    house.after(1, "ada", "They lie on the bed.");
    let (before, sequence) = (house.now().0, house.board.snapshot().sequence);
    assert!(!house.wait(3600) && house.wait(1) && !house.wait(100_000));
    assert_eq!((house.person("ada").unwrap().window, house.board.snapshot().sequence), (0, sequence + 1));
    let likeliest = |rooms: &[f32]| (0..rooms.len()).max_by(|a, b| rooms[*a].total_cmp(&rooms[*b])).unwrap();
    assert_eq!(likeliest(&house.now().0), likeliest(&before));
    // A sensor that only says that they are there ends no silence.
    house.after(1, "ada", "They sit on the bed.");
    house.after(3000, "ada", "present");
    assert_eq!(house.person("ada").unwrap().window, 1);
    house.after(601, "ada", "present");
    assert_eq!(house.person("ada").unwrap().window, 0);
}

/// A dog or a robot that has a name is no visitor.
#[test]
fn what_is_said_of_no_person_moves_nobody() {
    let mut house = House::new(&["ada"]);
    house.config.not_persons = vec!["Rocky".to_owned()];
    house.restart();
    house.after(1, "ada", "They sit on the sofa.");
    for sentence in
        ["Rocky cleans the kitchen.", "Rocky leaves the house.", "Rocky comes home.", "Rocky is in the kitchen."]
    {
        house.after(60, "somebody", sentence);
        assert_eq!((house.known(), house.presence("ada")), (1, Some(presence::PRESENT)), "{sentence}");
        assert_eq!(house.person("ada").unwrap().window, 1, "{sentence}");
    }
    house.after(60, "somebody", "Ada and Rocky go to the kitchen.");
    assert_eq!((house.known(), house.person("ada").unwrap().window), (1, 2));
    for sentence in ["Only Rocky is home.", "Nobody is home but Rocky.", "Everybody has left except Rocky."] {
        house.after(60, "ada", "They come home.");
        house.after(60, "somebody", sentence);
        assert_eq!((house.known(), house.presence("ada")), (1, Some(presence::AWAY)), "{sentence}");
    }
    // Whom JSON names is somebody, also for who starts again.
    house.after(60, "Rocky", "Rocky opens the fridge.");
    assert_eq!(house.presence("Rocky"), Some(presence::PRESENT));
    house.restart();
    assert_eq!(house.presence("Rocky"), Some(presence::PRESENT));
}

#[test]
fn a_resident_with_another_name_is_still_one() {
    let config = PersonsConfig { residents: vec!["ben".to_owned()], ..PersonsConfig::default() };
    let mut persons = Persons::new(config, PersonsFile::default());
    persons.rename(person_number("ben"), "Benjamin").unwrap();
    assert_eq!(persons.name_of(person_number("ben")), Some("Benjamin"));
    assert!(!persons.is_visitor(person_number("ben")) && persons.is_visitor(person_number("eve")));
}

#[test]
fn no_resident_becomes_another() {
    let config = PersonsConfig { residents: vec!["ada".to_owned(), "ben".to_owned()], ..PersonsConfig::default() };
    let mut persons = Persons::new(config, PersonsFile::default());
    let refused = persons.rename(person_number("ada"), "Ben").unwrap_err();
    assert!(matches!(&refused, NotRenamed::Refused(reason) if reason.contains("both live here")), "{refused}");
    assert_eq!(persons.name_of(person_number("ada")), Some("ada"));
    // Of whom only a number was known is one of them.
    persons.rename(3, "Ben").unwrap();
    assert_eq!((persons.number_of("ben"), persons.is_visitor(3)), (3, false));
}

#[test]
fn visitors_make_room_for_residents() {
    let mut house = House::new(&["0", "ada"]);
    house.after(1, "0", "They sit on the sofa.");
    for visitor in 1..=PERSONS_MAX {
        house.after(1, &visitor.to_string(), "They walk to the kitchen.");
    }
    house.after(1, "ada", "They lie on the bed.");
    let known = house.board.persons();
    assert_eq!(known.iter().count(), PERSONS_MAX);
    assert!([0, known.number_of("ada"), 3, PERSONS_MAX as u32].iter().all(|person| known.get(*person).is_some()));
    assert!(known.get(1).is_none() && known.get(2).is_none());
    assert_eq!(house.known(), PERSONS_MAX as u32);
}

/// Two doors that tell of one leaving, or a switch that bounces, send no sleeper away.
#[test]
fn who_sleeps_does_not_leave() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They lie on the bed.");
    house.after(1_500, "ben", "They sit on the sofa.");
    house.after(5, "somebody", "away");
    house.after(5, "somebody", "away");
    let known = house.board.persons();
    let presence = |who: &str| known.get(known.number_of(who)).unwrap().presence;
    assert_eq!((presence("ada"), presence("ben")), (Presence::Present, Presence::Away));
}

/// Whoever was at the door leaves, not whoever was silent for longest.
#[test]
fn who_was_at_the_door_leaves() {
    for away in ["away", "They leave the house.", "Somebody leaves the house."] {
        let mut house = House::new(&["ada", "ben"]);
        for (who, what) in [
            ("ben", "They sit on the sofa."),
            ("ben", "They turn on the television."),
            ("ada", "They open the fridge."),
            ("somebody", "They open the front door."),
            ("somebody", "Front door closes."),
        ] {
            house.after(30, who, what);
        }
        house.after(600, "somebody", away);
        let of = |house: &mut House| ["ada", "ben"].map(|who| house.presence(who));
        assert_eq!(of(&mut house), [Some(presence::AWAY), Some(presence::PRESENT)], "{away}");
        house.restart();
        assert_eq!(of(&mut house), [Some(presence::AWAY), Some(presence::PRESENT)], "{away}");
        // Also where somebody else was observed since.
        house.after(5, "ada", "They come home.");
        house.after(60, "ada", "Ada opens the front door.");
        house.after(60, "ben", "They stand up.");
        house.after(60, "somebody", away);
        assert_eq!(of(&mut house), [Some(presence::AWAY), Some(presence::PRESENT)], "{away}");
        // Where nothing tells, who was observed last.
        house.after(5, "ada", "They come home.");
        house.after(3000, "ben", "They open the fridge.");
        house.after(60, "somebody", away);
        assert_eq!(of(&mut house), [Some(presence::PRESENT), Some(presence::AWAY)], "{away}");
    }
}

/// A sleeper stays in bed when somebody else leaves in the morning.
#[test]
fn who_slept_for_a_night_does_not_leave() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They lie on the bed.");
    house.after(1, "ben", "They lie on the bed.");
    house.after(1, "ben", "They fall asleep.");
    house.after(8 * 3600, "ada", "They get up.");
    house.after(60, "ada", "They open the fridge.");
    house.after(60, "ada", "They open the front door.");
    house.after(10, "somebody", "away");
    assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::AWAY), Some(presence::PRESENT)));
    assert_eq!(house.person("ben").unwrap().flags & person_flags::ASLEEP, person_flags::ASLEEP);
}

/// What is done in bed ends no lying on it.
#[test]
fn who_turns_off_a_lamp_in_bed_lies_on() {
    let asleep = |sentences: &[&str]| {
        let mut house = House::new(&["ben"]);
        for sentence in sentences {
            house.after(20, "ben", sentence);
        }
        house.now_ns += 2 * 3600 * S;
        house.person("ben").unwrap().flags & person_flags::ASLEEP != 0
    };
    assert!(asleep(&["Ben lies down in bed and turns off the bedside lamp."]));
    assert!(asleep(&["Ben lies on the bed and grabs the pillow."]));
    assert!(asleep(&["They lie on the bed.", "They grab the pillow."]));
    for up in [
        "They open the closet.",
        "They turn on the stove.",
        "They get up.",
        "They walk to the pillow.",
        "They grab the milk.",
    ] {
        assert!(!asleep(&["They lie on the bed.", up]), "{up}");
    }
    assert!(!asleep(&["Ben lies on the bed, gets up and opens the fridge."]));
}

/// People tell several things at once, and of others than those who are known.
#[test]
fn what_people_write_moves_whom_it_is_about() {
    let [here, away] = [presence::PRESENT, presence::AWAY].map(Some);
    for (said, who, expected, known) in [
        ("Ada gets up, showers and leaves for work.", ["ada", "ben", "igor"], [away, here, None], 2),
        ("Ben eats, dresses and goes to work.", ["ada", "ben", "igor"], [here, away, None], 2),
        ("Ada wakes up, stretches and is in the kitchen.", ["ada", "ben", "igor"], [here, here, None], 2),
        ("Ada leaves.", ["ada", "ben", "igor"], [away, here, None], 2),
        ("Ada leaves now.", ["ada", "ben", "igor"], [away, here, None], 2),
        ("Ada is leaving the house.", ["ada", "ben", "igor"], [away, here, None], 2),
        ("Ada goes out the door.", ["ada", "ben", "igor"], [away, here, None], 2),
        ("The plumber leaves.", ["ada", "ben", "plumber"], [here, here, away], 3),
        ("Igor leaves.", ["ada", "ben", "igor"], [here, here, away], 3),
        ("Ada and Ben put on their coats and leave for work.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("Ada leaves the house, and so does Ben.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("Ada leaves the house and Ben too.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("Ada and her friend Igor leave the house.", ["ada", "ben", "igor"], [away, here, away], 3),
        ("Both leave.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("They both go out.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("Both of them leave the house.", ["ada", "ben", "igor"], [away, away, None], 2),
        ("Ben opens the front door and Igor comes in.", ["ada", "ben", "igor"], [here, here, here], 3),
        ("Ben lets Igor in.", ["ada", "ben", "igor"], [here, here, here], 3),
        ("Ada and Igor sit on the sofa.", ["ada", "ben", "igor"], [here, here, here], 3),
    ] {
        let mut house = House::new(&["ada", "ben"]);
        house.after(1, "ada", "They open the fridge.");
        house.after(1, "ben", "They sit on the sofa.");
        house.after(5, "somebody", said);
        for _ in 0..2 {
            assert_eq!((who.map(|who| house.presence(who)), house.known()), (expected, known), "{said}");
            house.restart();
        }
    }
}

/// Both are two: who are here, or are away and come home. Of three nobody knows which.
#[test]
fn both_are_the_two_who_are_meant() {
    let mut house = House::new(&["ada", "ben"]);
    let of = |house: &mut House| ["ada", "ben"].map(|who| house.presence(who));
    let [here, away] = [presence::PRESENT, presence::AWAY].map(Some);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "somebody", "They both leave the house.");
    assert_eq!(of(&mut house), [here, None], "one is not both");
    house.after(1, "ben", "They sit on the sofa.");
    house.after(1, "somebody", "They both leave the house.");
    assert_eq!(of(&mut house), [away, away]);
    house.after(1, "somebody", "Both come home.");
    assert_eq!(of(&mut house), [here, here]);
    house.after(1, "somebody", "They both go to bed.");
    let told = house.now_ns;
    assert_eq!(["ada", "ben"].map(|who| house.person(who).unwrap().observed_ns), [told; 2]);
    house.after(1, "plumber", "They open the fridge.");
    house.after(1, "somebody", "Both leave.");
    assert_eq!(of(&mut house), [here, here]);
    // Who comes home from work is home, whatever they do then.
    house.after(1, "ada", "away");
    house.after(1, "ben", "away");
    house.after(60, "somebody", "Ada comes home from work and puts the groceries into the fridge.");
    assert_eq!(of(&mut house), [here, away]);
}

/// A narrator of plain sentences gives no names, but the sentences do.
#[test]
fn a_sentences_subject_is_its_person() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "ben", "They sit on the sofa.");
    house.after(1, "somebody", "Ben leaves the house.");
    let known = |house: &House, who: &str| {
        let persons = house.board.persons();
        persons.get(persons.number_of(who)).map(|known| known.presence)
    };
    assert_eq!((known(&house, "ada"), known(&house, "ben")), (Some(Presence::Present), Some(Presence::Away)));
    // Somebody of whom nothing is known is not one of those who are.
    house.after(1, "somebody", "Cleo leaves the house.");
    assert_eq!((known(&house, "ada"), known(&house, "cleo")), (Some(Presence::Present), Some(Presence::Away)));
    for nobody in ["Nobody leaves the house.", "12 leaves the house."] {
        let before = house.board.persons().iter().count();
        house.after(1, "somebody", nobody);
        assert_eq!(house.board.persons().iter().count(), before, "{nobody}");
    }
    house.after(1, "ada", "present");
    assert_eq!(known(&house, "ada"), Some(Presence::Present));
    house.after(1, "somebody", "Ben opens the fridge.");
    assert_eq!(known(&house, "ben"), Some(Presence::Present));
    house.restart();
    assert_eq!((known(&house, "ben"), known(&house, "cleo")), (Some(Presence::Present), Some(Presence::Away)));
}

/// A sentence is of all whom it names, also after a restart; who is named is not guessed.
#[test]
fn a_sentence_of_several_is_of_each() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "ben", "They lie on the bed.");
    house.after(1, "somebody", "Ada and Ben sit on the sofa.");
    let newest = |house: &House, who: &str| {
        let number = house.board.persons().number_of(who);
        let history = house.board.pipeline().histories().get(number).unwrap();
        history.observations().last().and_then(|last| last.sentence().map(str::to_owned))
    };
    for who in ["ada", "ben"] {
        assert_eq!(newest(&house, who).as_deref(), Some("Ada and Ben sit on the sofa."), "{who}");
    }
    house.after(1, "somebody", "Ada and the plumber leave the house.");
    let presences = |house: &mut House| ["ada", "ben", "plumber"].map(|who| house.presence(who));
    let expected = [Some(presence::AWAY), Some(presence::PRESENT), Some(presence::AWAY)];
    assert_eq!(presences(&mut house), expected);
    let flags = house.person("plumber").unwrap().flags;
    assert_eq!(flags, person_flags::VISITOR, "a name is no guess");
    house.restart();
    assert_eq!(presences(&mut house), expected);
    house.after(1, "somebody", "The plumber walks to the kitchen.");
    assert_eq!(house.presence("plumber"), Some(presence::PRESENT));
    assert_eq!(house.presence("ada"), Some(presence::AWAY));
}

/// What was said of everybody before somebody was forgotten says nothing of them after a restart.
#[test]
fn who_is_forgotten_stays_so() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "somebody", "Nobody is home.");
    let ada = house.board.persons().number_of("ada");
    house.board.forget(ada, |_| false);
    house.journal.extend(encode_forgotten(ada, false));
    house.step(None);
    for _ in 0..2 {
        assert_eq!((house.presence("ada"), house.presence("ben")), (None, Some(presence::AWAY)));
        house.restart();
    }
    house.after(1, "ada", "They open the fridge.");
    house.restart();
    assert_eq!(house.presence("ada"), Some(presence::PRESENT));
}

/// Each clause of a text is of its own persons, also after a restart.
#[test]
fn two_clauses_are_of_two_persons() {
    let mut house = House::new(&["mia", "tom"]);
    house.after(1, "mia", "They open the fridge.");
    house.after(1, "tom", "They sit on the sofa.");
    let newest = |house: &House, who: &str| {
        let number = house.board.persons().number_of(who);
        let history = house.board.pipeline().histories().get(number);
        history.and_then(|own| own.observations().last()?.sentence().map(str::to_owned)).unwrap_or_default()
    };
    house.after(1, "somebody", "Mia lies on the bed and Tom goes to the kitchen.");
    assert_eq!(
        (newest(&house, "mia"), newest(&house, "tom")),
        ("Mia lies on the bed.".into(), "Tom goes to the kitchen.".into())
    );
    house.after(1, "somebody", "Tom leaves the house. He takes the car. Mia opens the fridge.");
    for _ in 0..2 {
        assert_eq!((house.presence("mia"), house.presence("tom")), (Some(presence::PRESENT), Some(presence::AWAY)));
        assert_eq!(newest(&house, "mia"), "Mia opens the fridge.");
        house.restart();
    }
    house.after(1, "mia", "They leave the house and lock the door.");
    assert_eq!(house.presence("mia"), Some(presence::AWAY));
    house.after(1, "somebody", "Tom and the plumber come home.");
    let presences = |house: &mut House| ["mia", "tom", "plumber"].map(|who| house.presence(who));
    assert_eq!(presences(&mut house), [Some(presence::AWAY), Some(presence::PRESENT), Some(presence::PRESENT)]);
    house.after(1, "somebody", "Mia is home. Nobody is in the kitchen.");
    assert_eq!(presences(&mut house)[0], Some(presence::PRESENT));
    assert!(house.now().0[0] < 0.9);
}

/// A family, and what is narrated of it by people and by machines: one wrong answer is one too many.
#[test]
fn what_is_said_moves_whom_it_is_about() {
    let mut house = House::new(&["sophie", "david", "lily"]);
    let begin = |house: &mut House| {
        for (who, what) in
            [("sophie", "They open the fridge."), ("david", "They sit on the sofa."), ("lily", "They lie on the bed.")]
        {
            house.after(2, who, what);
        }
    };
    let newest = |house: &House, who: &str| {
        let number = house.board.persons().number_of(who);
        let history = house.board.pipeline().histories().get(number);
        history.and_then(|own| own.observations().last()?.sentence().map(str::to_owned)).unwrap_or_default()
    };
    for (said, who) in [
        ("In the bathroom, Sophie brushes her teeth.", "sophie"),
        ("At eight David opens the door.", "david"),
        ("While she cooks, David sets the table.", "david"),
        ("But Lily opens the fridge.", "lily"),
    ] {
        begin(&mut house);
        house.after(2, "somebody", said);
        let told = said.strip_prefix("While she cooks, ").unwrap_or(said);
        let moved: Vec<&str> =
            ["sophie", "david", "lily"].into_iter().filter(|who| newest(&house, who) == told).collect();
        assert_eq!(moved, [who], "{said}");
    }
    house.after(2, "somebody", "While Sophie cooks, David sets the table.");
    assert_eq!(
        ["sophie", "david"].map(|who| newest(&house, who)),
        ["Sophie cooks.", "David sets the table."],
        "each clause is of its own person"
    );
    for said in [
        "The robot vacuum drives into the bathroom.",
        "The washing machine beeps.",
        "Music is playing in the bathroom.",
        "The cat jumps onto the table.",
        "It is raining.",
        "The kids are in the bathroom.",
        "The parents leave the house.",
        "Sophie's guitar is in the bathroom.",
        "Sophie was in the bathroom.",
        "If Sophie cooks and David leaves the house, lock the door.",
    ] {
        begin(&mut house);
        let (known, before) = (house.known(), house.now().0);
        house.after(0, "somebody", said);
        assert_eq!((house.known(), house.now().0), (known, before), "{said}");
    }
    // Who is not there is brought home by nobody's doing.
    house.after(1, "somebody", "Everybody leaves the house.");
    for said in
        ["The cat jumps onto the table.", "It is raining.", "David waits for the bus.", "Sophie eats at a restaurant."]
    {
        house.after(1, "somebody", said);
        assert!(house.board.snapshot().has(score_flags::NOBODY_HOME), "{said}");
    }
    begin(&mut house);
    for (said, who, expected) in [
        ("Sophie grabs her keys and leaves.", "sophie", presence::AWAY),
        ("Sophie leaves the house. Then she comes home.", "sophie", presence::PRESENT),
        ("The cleaner says goodbye and leaves.", "cleaner", presence::AWAY),
        ("David cooks and Cleo leaves the house.", "david", presence::PRESENT),
        ("David cooks and Cleo leaves the house.", "cleo", presence::AWAY),
        ("David cooks and the children leave the house.", "david", presence::PRESENT),
    ] {
        house.after(2, "somebody", said);
        assert_eq!(house.presence(who), Some(expected), "{said}");
    }
    // Of whom it is where somebody is named and meant on by a pronoun.
    begin(&mut house);
    house.after(2, "somebody", "David goes to the kitchen.");
    house.after(2, "somebody", "He lies on the bed.");
    assert_eq!(newest(&house, "david"), "He lies on the bed.");
    let known = house.known();
    house.after(2, "somebody", "A woman sits on the sofa.");
    assert_eq!(house.known(), known, "she is one of those who are here");
    house.after(2, "somebody", "Igor sits on the sofa.");
    assert_eq!((house.known(), newest(&house, "igor")), (known + 1, "Igor sits on the sofa.".to_owned()));
    // A sentence about somebody else than its key.
    house.after(2, "david", "away");
    house.after(2, "sophie", "David comes home.");
    house.after(2, "sophie", "Wilhelmina leaves the house.");
    let of = |house: &mut House| ["david", "sophie", "wilhelmina"].map(|who| house.presence(who));
    assert_eq!(of(&mut house), [Some(presence::PRESENT), Some(presence::PRESENT), Some(presence::AWAY)]);
    house.restart();
    assert_eq!(of(&mut house), [Some(presence::PRESENT), Some(presence::PRESENT), Some(presence::AWAY)]);
}

/// What is said of all, of all but a few, of a few alone, and of who goes along, holds after a restart, too.
#[test]
fn a_sentence_about_a_group_moves_the_group() {
    let mut house = House::new(&["sophie", "david", "lily"]);
    let family = ["sophie", "david", "lily"];
    let [here, away] = [presence::PRESENT, presence::AWAY].map(Some);
    for (said, expected) in [
        ("Everybody except David leaves.", [away, here, away]),
        ("Everybody leaves the house, but Lily.", [away, away, here]),
        ("Only Lily is home.", [away, away, here]),
        ("Nobody but Sophie and David is at home.", [here, here, away]),
        ("Only Lily leaves the house.", [here, here, away]),
        ("Everybody but Lily is in the kitchen.", [here, here, here]),
        ("Sophie takes Lily to school.", [away, here, away]),
        ("David goes shopping with Lily.", [here, away, away]),
        ("David leaves the house with a suitcase.", [here, away, here]),
        ("Everybody except the plumber leaves the house.", [here, here, here]),
        ("Everybody except Mum leaves the house.", [here, here, here]),
        ("Everybody except little Lily leaves the house.", [away, away, here]),
        ("Only Lily's mother is home.", [here, here, here]),
        ("Sophie leaves the house with Lily still asleep.", [away, here, here]),
        ("Sophie leaves the house after a quarrel with David.", [away, here, here]),
        ("SOPHIE LEAVES THE HOUSE WITH LILY.", [away, here, away]),
        ("The house is empty except for Lily.", [away, away, here]),
        ("Everybody except Sophie and David leaves.", [here, here, away]),
        ("Sophie, David and Lily leave the house.", [away, away, away]),
        ("All but Sophie, David and Lily are away.", [here, here, here]),
        ("Sophie is away with David.", [away, away, here]),
    ] {
        for keyed in ["somebody", "lily"] {
            for who in family {
                house.after(2, who, "They open the fridge.");
            }
            house.after(2, keyed, said);
            let found = family.map(|who| house.presence(who));
            assert_eq!(found, expected, "{said} by {keyed}");
            house.restart();
            assert_eq!(family.map(|who| house.presence(who)), expected, "{said} by {keyed}, restarted");
        }
    }
    house.after(2, "somebody", "Everybody leaves.");
    house.after(2, "somebody", "Sophie comes home with Lily.");
    assert_eq!(family.map(|who| house.presence(who)), [here, away, here]);
    let room = house.board.snapshot().rooms().iter().position(|room| room.id() == "bathroom").unwrap();
    house.after(2, "somebody", "Everybody is in the bathroom.");
    assert_eq!(house.presence("david"), away, "who is away is not in the house");
    for who in ["sophie", "lily"] {
        let number = house.board.persons().number_of(who);
        let told = *house.board.person_forecasts(house.now_ns);
        let own = told.persons().iter().find(|own| own.person == number).unwrap();
        assert!(own.probability[room][0] > 0.9, "{who} {:?}", own.probability[room][0]);
    }
}

/// A sentence, and who is where after it, of two who live here and a visitor.
#[test]
fn people_come_and_go_in_many_words() {
    let mut house = House::new(&["Mia", "Jon"]);
    house.config.not_persons = vec!["Rocky".to_owned()];
    house.board = board(&house.config);
    let all = ["Mia", "Jon", "Anna"];
    let [here, away] = [presence::PRESENT, presence::AWAY].map(Some);
    for (said, expected) in [
        ("While Jon takes a shower, Mia leaves.", [away, here, here]),
        ("Before Jon leaves, he goes to the kitchen.", [here, here, here]),
        ("After Mia leaves, Jon goes to the kitchen.", [away, here, here]),
        ("Jon goes to the kitchen after Mia leaves.", [away, here, here]),
        ("Mia goes to the kitchen before Jon leaves.", [here, here, here]),
        ("When Mia leaves, Jon goes to the kitchen.", [here, here, here]),
        ("Mia leaves. Jon leaves. Anna leaves.", [away, away, away]),
        ("The guest leaves.", [here, here, away]),
        ("The visitor leaves the house.", [here, here, away]),
        ("Anna goes home.", [here, here, away]),
        ("Mia goes home.", [here, here, here]),
        ("Jon takes Anna home.", [here, away, away]),
        ("Mia and the dog go out.", [away, here, here]),
        ("Mia and Rocky go out.", [away, here, here]),
        ("Mia leaves with Jon and Anna.", [away, away, away]),
        ("Mia/Jon leave.", [away, away, here]),
        ("Mia has just left.", [away, here, here]),
        ("Mia has already left.", [away, here, here]),
        ("Mia is finally home.", [here, here, here]),
        ("Everybody leaves the living room.", [here, here, here]),
        ("Everybody goes to bed.", [here, here, here]),
        ("Mia sees Jon in the bathroom.", [here, here, here]),
        ("Spotify starts playing.", [here, here, here]),
        ("Alexa plays music.", [here, here, here]),
    ] {
        for who in all {
            house.after(2, who, "They open the fridge.");
        }
        house.after(2, "somebody", said);
        assert_eq!(all.map(|who| house.presence(who)), expected, "{said}");
        assert_eq!(house.known(), 3, "{said}");
        house.restart();
        assert_eq!(all.map(|who| house.presence(who)), expected, "{said}, restarted");
    }
    for who in all {
        house.after(2, who, "away");
    }
    for said in [
        "Jon works late.",
        "Mia sleeps at his parents' house.",
        "Mia eats out.",
        "Jon has lunch with a colleague.",
        "Jon sits in the train.",
        "Jon stays at the office.",
        "Jon left the light on in the kitchen.",
        "Hello!",
        "Good morning!",
    ] {
        house.after(2, "somebody", said);
        assert_eq!(all.map(|who| house.presence(who)), [away; 3], "{said}");
        assert_eq!(house.known(), 3, "{said}");
    }
    house.after(2, "somebody", "A visitor arrives.");
    assert_eq!((house.presence("anna"), house.presence("visitor")), (away, here));
    house.after(2, "somebody", "The visitor leaves.");
    assert_eq!(house.presence("visitor"), away);
    house.after(2, "somebody", "Jon's mother arrives.");
    assert_eq!((house.presence("jon's mother"), house.presence("jon")), (here, away));
}

/// A sentence, and who is where after it, of two who live here, are there or not, and two visitors.
#[test]
fn groups_plans_and_shows_are_told_from_persons() {
    let mut house = House::new(&["Lena", "Paul"]);
    let all = ["Lena", "Paul", "Igor", "Vera"];
    let [here, away] = [presence::PRESENT, presence::AWAY].map(Some);
    for (said, expected) in [
        ("The visitors leave.", [here, here, away, away]),
        ("The guests are gone.", [here, here, away, away]),
        ("All the guests have left.", [here, here, away, away]),
        ("The guests go to the bathroom.", [here; 4]),
        ("All four leave.", [away; 4]),
        ("All three leave.", [here; 4]),
        ("Neither Lena nor Paul is home.", [away, away, here, here]),
        ("Lena is neither in the kitchen nor in the bathroom.", [here; 4]),
        ("Both are out of milk.", [here; 4]),
        ("Paul walks the dog.", [here, away, here, here]),
        ("Paul moved out.", [here, away, here, here]),
        ("Lena goes on vacation.", [away, here, here, here]),
        ("Paul closes the door behind him and drives away.", [here, away, here, here]),
        ("Although Lena is out, the fridge is open.", [away, here, here, here]),
        ("Lena is leaving.", [here; 4]),
        ("We leave after dinner.", [here; 4]),
        ("Lena, leave the house!", [here; 4]),
        ("Bayern plays against Dortmund on TV.", [here; 4]),
        ("Tatort starts on TV.", [here; 4]),
        ("Schalke wins.", [here; 4]),
        ("All three of them leave.", [here; 4]),
        ("Lena leaves and takes Rocky with her.", [away, here, here, here]),
    ] {
        for who in all {
            house.after(2, who, "They open the fridge.");
        }
        house.after(2, "somebody", said);
        assert_eq!(all.map(|who| house.presence(who)), expected, "{said}");
        assert_eq!(house.known(), 4, "{said}");
        house.restart();
        assert_eq!(all.map(|who| house.presence(who)), expected, "{said}, restarted");
    }
    house.after(2, "igor", "away");
    house.after(2, "lena", "They sit on the sofa.");
    house.after(2, "vera", "They sit on the sofa.");
    house.after(2, "paul", "They sit on the sofa.");
    house.after(2, "somebody", "The three of them lie on the bed.");
    for who in ["Lena", "Paul", "Vera"] {
        assert_eq!(house.person(who).map(|own| own.observed_ns), Some(house.now_ns), "{who}");
    }
    house.after(2, "somebody", "The guests come back.");
    assert_eq!(["Igor", "Vera"].map(|who| house.presence(who)), [here; 2]);
    for who in all {
        house.after(2, who, "away");
    }
    for said in [
        "Lena forgot her umbrella.",
        "Lena takes the bus home.",
        "Lena lands in Berlin.",
        "Lena buys milk.",
        "Lena sees Paul.",
        "Lena is leaving.",
        "Lena visits Zoe.",
        "The visitors leave.",
    ] {
        house.after(2, "somebody", said);
        assert_eq!(all.map(|who| house.presence(who)), [away; 4], "{said}");
    }
    for said in ["Lena takes the bus home and opens the fridge.", "Lena rings and comes in."] {
        house.after(2, "lena", "away");
        house.after(2, "somebody", said);
        assert_eq!(house.presence("lena"), here, "{said}");
    }
    house.after(2, "somebody", "Zoe comes to visit Lena.");
    assert_eq!((house.presence("zoe"), house.known()), (here, 5));
    house.after(2, "somebody", "Kim visits Lena.");
    assert_eq!((house.presence("kim"), house.known()), (here, 6));
}

/// Where somebody is by what another one does, and by what all do.
#[test]
fn a_room_is_that_of_whom_it_is_told() {
    let mut house = House::new(&["Mia", "Jon"]);
    let rooms: Vec<String> = house.board.snapshot().rooms().iter().map(|room| room.id().to_owned()).collect();
    let room_of = |house: &mut House, who: &str| {
        let number = house.board.persons().number_of(who);
        let told = *house.board.person_forecasts(house.now_ns);
        let own = told.persons().iter().find(|own| own.person == number).unwrap();
        let best = (0..rooms.len()).max_by(|a, b| own.probability[*a][0].total_cmp(&own.probability[*b][0])).unwrap();
        rooms[best].clone()
    };
    for (said, mia, jon) in [
        ("Jon left the light on in the bathroom.", "kitchen", "kitchen"),
        ("Mia sees Jon in the bathroom.", "kitchen", "bathroom"),
        ("Mia sends Jon to the bathroom.", "kitchen", "bathroom"),
        ("Before Jon goes to the bathroom, Mia leaves the house.", "", "kitchen"),
        ("Everybody is in the bathroom.", "bathroom", "bathroom"),
        ("Everybody sits down on the toilet.", "bathroom", "bathroom"),
        ("They are both in the bathroom.", "bathroom", "bathroom"),
    ] {
        for who in ["mia", "jon"] {
            house.after(90, who, "present in the kitchen");
        }
        house.after(2, "somebody", said);
        let found = ["mia", "jon"].map(|who| {
            if house.presence(who) == Some(presence::PRESENT) { room_of(&mut house, who) } else { String::new() }
        });
        assert_eq!(found, [mia, jon], "{said}");
    }
    for leave in ["Everybody leaves the kitchen.", "Both leave the kitchen."] {
        for who in ["mia", "jon"] {
            house.after(90, who, "present in the kitchen");
        }
        house.after(30, "somebody", leave);
        assert!(["mia", "jon"].iter().all(|who| room_of(&mut house, who) != "kitchen"), "{leave}");
    }
    // Another process of the same narrator goes on with what it said.
    for who in ["mia", "jon"] {
        house.after(90, who, "present in the kitchen");
    }
    house.after(2, "somebody", "Mia opens the fridge.");
    house.wait(20);
    let mut next = house.observation("somebody", "She goes to the bathroom.");
    next.epoch += 1;
    house.enter(next);
    let told = ["mia", "jon"].map(|who| house.person(who).unwrap().observed_ns == house.now_ns);
    assert_eq!(told, [true, false]);
}

/// A resident keeps the name that the configuration has.
#[test]
fn a_resident_is_written_as_the_home_writes_them() {
    let mut house = House::new(&["Mia"]);
    house.after(1, "MIA", "They open the fridge.");
    house.after(1, "somebody", "mia sits on the sofa.");
    let number = house.board.persons().number_of("mia");
    assert_eq!(house.board.persons().name_of(number), Some("Mia"));
}

/// Titles and what relatives are called make no other person, and what is not done moves nobody.
#[test]
fn a_title_makes_nobody_else() {
    let mut house = House::new(&["edith", "priya"]);
    house.after(1, "edith", "They open the fridge.");
    house.after(1, "priya", "They open the fridge.");
    house.after(1, "Mrs. Novak", "They open the fridge.");
    let known = house.known();
    for (sentence, who) in [
        ("Mrs. Novak leaves the house.", "Mrs. Novak"),
        ("Novak comes home.", "Mrs. Novak"),
        ("Mrs. Novak leaves the house.", "Mrs. Novak"),
        ("Grandma Edith leaves the house.", "edith"),
    ] {
        house.after(2, "somebody", sentence);
        assert_eq!(house.known(), known, "{sentence}");
        let is = if sentence.contains("leaves") { presence::AWAY } else { presence::PRESENT };
        assert_eq!(house.presence(who), Some(is), "{sentence}");
    }
    house.after(2, "somebody", "Mrs. Novak opens the fridge.");
    house.restart();
    assert_eq!(["Mrs. Novak", "edith"].map(|who| house.presence(who)), [presence::PRESENT, presence::AWAY].map(Some));
    for sentence in ["Edith will open the fridge.", "Edith doesn't open the fridge.", "Is Edith home?"] {
        house.after(2, "somebody", sentence);
        assert_eq!((house.known(), house.presence("edith")), (known, Some(presence::AWAY)), "{sentence}");
    }
}

/// Two persons of one surname are two, and who is called by a first name is nobody new.
#[test]
fn a_title_tells_apart_and_a_first_name_does_not() {
    let mut house = House::new(&["Ada Lovelace", "Ben"]);
    house.after(1, "Ada Lovelace", "They open the fridge.");
    house.after(1, "Ben", "They sit on the sofa.");
    house.after(1, "somebody", "Ada leaves the house.");
    assert_eq!((house.presence("Ada Lovelace"), house.known()), (Some(presence::AWAY), 2));
    house.after(1, "somebody", "Ada opens the fridge and Ben leaves the house.");
    let of = |house: &mut House| ["Ada Lovelace", "Ben"].map(|who| house.presence(who));
    assert_eq!((of(&mut house), house.known()), ([Some(presence::PRESENT), Some(presence::AWAY)], 2));
    house.after(1, "somebody", "Everybody except Ada leaves the house.");
    assert_eq!(of(&mut house), [Some(presence::PRESENT), Some(presence::AWAY)]);
    assert_eq!(house.person("Ada Lovelace").unwrap().name(), "Ada Lovelace");
    house.restart();
    assert_eq!((of(&mut house), house.known()), ([Some(presence::PRESENT), Some(presence::AWAY)], 2));
    house.after(1, "somebody", "Mrs. Novak sits on the sofa.");
    house.after(1, "somebody", "Mr. Novak opens the fridge.");
    assert_eq!(house.known(), 4);
    house.after(1, "somebody", "Mrs Novak leaves the house.");
    let of = |house: &mut House| ["Mrs. Novak", "Mr. Novak"].map(|who| house.presence(who));
    assert_eq!(of(&mut house), [Some(presence::AWAY), Some(presence::PRESENT)]);
    // Either of them may be meant.
    house.after(1, "somebody", "Novak leaves the house.");
    assert_eq!((of(&mut house), house.known()), ([Some(presence::AWAY), Some(presence::PRESENT)], 4));
    // As soon as there are two of a first name it tells nobody.
    house.after(1, "Ada Byron", "They open the fridge.");
    house.after(1, "somebody", "Ada leaves the house.");
    let of = |house: &mut House| ["Ada Lovelace", "Ada Byron"].map(|who| house.presence(who));
    assert_eq!((of(&mut house), house.known()), ([Some(presence::PRESENT); 2], 5));
    // Accents are left out by one narrator, and written in two characters by another.
    house.after(1, "Zoë", "They open the fridge.");
    house.after(1, "somebody", "Zoe leaves the house.");
    assert_eq!((house.presence("Zoë"), house.known()), (Some(presence::AWAY), 6));
    house.after(1, "Zoe\u{308}", "They open the fridge.");
    assert_eq!((house.presence("Zoë"), house.known()), (Some(presence::PRESENT), 6));
}

/// Of whom a narrator tells by first and last name, though the home knows the first one alone.
#[test]
fn a_longer_name_is_the_same_person_in_deeds_and_where_they_are() {
    let mut house = House::new(&["Jonas", "Anna", "Oma Trude"]);
    let of = |house: &mut House| house.presence("Jonas");
    for (text, expected) in [
        ("Jonas Müller opens the fridge.", presence::PRESENT),
        ("Jonas Müller leaves the house.", presence::AWAY),
        ("Jonas Müller comes home.", presence::PRESENT),
        ("Jonas Müller is away.", presence::AWAY),
        ("Dr. Jonas Müller opens the fridge.", presence::PRESENT),
        ("Dr. Jonas Müller goes to work.", presence::AWAY),
        ("Jonas Müller is in the kitchen.", presence::PRESENT),
    ] {
        house.after(1, "somebody", text);
        assert_eq!((of(&mut house), house.known()), (Some(expected), 1), "{text}");
    }
    // Whom a longer name is told of is that person, also where another one has a part of it.
    house.after(1, "Jonas Meier", "They sit on the sofa.");
    house.after(1, "somebody", "Jonas Meier leaves the house.");
    assert_eq!((of(&mut house), house.presence("Jonas Meier")), (Some(presence::PRESENT), Some(presence::AWAY)));
    // Whom nobody knows is nobody who is known.
    house.after(1, "somebody", "Olga Petrova opens the fridge.");
    house.after(1, "somebody", "Olga Petrova leaves the house.");
    house.after(1, "somebody", "Two people are sitting on a couch.");
    assert_eq!((of(&mut house), house.presence("Olga Petrova")), (Some(presence::PRESENT), Some(presence::AWAY)));
}

/// Whoever's narrator hears it: a sentence about somebody else whom it names is of them.
#[test]
fn a_sentence_about_others_is_theirs_by_whatever_key() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "ben", "They sit on the sofa.");
    for key in ["ada", "0"] {
        let before = house.person("ada").unwrap().observed_ns;
        house.after(3, key, "Ben opens the fridge.");
        assert_eq!(house.person("ben").unwrap().observed_ns, house.now_ns, "by {key}");
        assert_eq!((house.person("ada").unwrap().observed_ns, house.known()), (before, 2), "by {key}");
    }
    house.after(3, "ada", "They help Ben.");
    assert_eq!(house.person("ada").unwrap().observed_ns, house.now_ns);
}

/// Who is out is brought home neither by a place that the map does not know, nor by what is so at another time.
#[test]
fn who_is_out_is_not_back_at_a_place_that_nobody_knows() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ben", "They open the fridge.");
    house.after(1, "ada", "They sit on the sofa.");
    house.after(1, "ada", "away");
    for sentence in [
        "Ada is at the gym.",
        "Ada is in Rome.",
        "Ada goes to the hairdresser.",
        "Ada is back at the hotel.",
        "Ada drives to the lake.",
        "Ada is almost home.",
        "Ada is late.",
        "Ada is coming home.",
        "Ada is in the waiting room.",
        "Ada is back in an hour.",
        "Ada comes home at the weekend.",
        "Ada sits on the sofa every evening.",
    ] {
        for who in ["somebody", "ada"] {
            house.after(2, who, sentence);
            assert_eq!(house.presence("ada"), Some(presence::AWAY), "{sentence} by {who}");
            assert_eq!(house.presence("ben"), Some(presence::PRESENT), "{sentence} by {who}");
        }
    }
    house.after(2, "somebody", "Igor is at the gym.");
    assert_eq!(house.presence("igor"), None);
    for sentence in [
        "Ada is on the sofa.",
        "Ada goes to the kitchen.",
        "Ada goes to bed.",
        "Ada laughs.",
        "Ada is cooking.",
        "Ada is home.",
    ] {
        house.after(2, "ada", "away");
        house.after(2, "somebody", sentence);
        assert_eq!(house.presence("ada"), Some(presence::PRESENT), "{sentence}");
    }
    // Who is there and goes to work is out, in whatever words.
    for sentence in ["Ada returns to work.", "Ada is back at school.", "Ada walks to the bus stop."] {
        house.after(2, "ada", "They open the fridge.");
        house.after(2, "somebody", sentence);
        assert_eq!(house.presence("ada"), Some(presence::AWAY), "{sentence}");
    }
    house.after(2, "ada", "They open the fridge.");
    house.after(2, "somebody", "Ada usually leaves the house at eight.");
    assert_eq!(house.presence("ada"), Some(presence::PRESENT));
}

/// A light that goes off moves nobody, and brings nobody home.
#[test]
fn what_has_ended_moves_nobody() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They sit on the sofa.");
    house.after(60, "ben", "away");
    let before = house.now().0;
    house.after(1, "somebody", "The fridge is closed.");
    let after = house.now().0;
    assert!(before.iter().zip(&after).all(|(a, b)| (a - b).abs() < 0.05), "{before:?} {after:?}");
    house.after(1, "ada", "away");
    for sentence in ["The fridge is closed.", "The light is off."] {
        house.after(1, "somebody", sentence);
        assert_eq!((house.presence("ada"), house.presence("ben")), (Some(presence::AWAY), Some(presence::AWAY)));
    }
    house.after(1, "somebody", "They open the fridge.");
    assert_eq!(house.presence("ben"), Some(presence::PRESENT));
}

/// A forecast says when it lacks somebody who lives here.
#[test]
fn who_was_never_observed_is_missed() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They sit on the sofa.");
    assert_eq!(house.board.forecast(house.now_ns).flags, forecast_flags::RESIDENT_UNKNOWN);
    house.after(1, "ben", "away");
    assert_eq!(house.board.forecast(house.now_ns).flags, 0);
}

/// Who sleeps is asleep wherever they lie, until they do something else.
#[test]
fn who_says_that_they_sleep_is_asleep() {
    let mut house = House::new(&[]);
    let asleep = |house: &mut House| {
        house.now_ns += 3 * 3600 * S;
        house.person("ada").unwrap().flags & person_flags::ASLEEP != 0
    };
    for (sentence, expected) in [
        ("They sit on the sofa.", false),
        ("They fall asleep on the sofa.", true),
        ("They wake up.", false),
        ("They go to sleep.", true),
        ("They snore.", true),
        ("They open the fridge.", false),
    ] {
        house.after(1, "ada", sentence);
        assert_eq!(asleep(&mut house), expected, "{sentence}");
    }
}

/// Who calls, or will come, is not home for that; things are nobody.
#[test]
fn who_calls_is_not_home() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ben", "They open the fridge.");
    house.after(1, "ada", "away");
    for sentence in ["Ada calls.", "Ada will be home soon.", "Ada is on her way."] {
        house.after(1, "somebody", sentence);
        assert_eq!(house.presence("ada"), Some(presence::AWAY), "{sentence}");
    }
    house.after(1, "ada", "They call a friend.");
    assert_eq!(house.presence("ada"), Some(presence::PRESENT), "a sentence of theirs about a call is an action");
    let before = house.known();
    for sentence in ["The coffee maker is out.", "Sofa is away.", "The dishwasher is out."] {
        house.after(1, "somebody", sentence);
        assert_eq!((house.known(), house.presence("ben")), (before, Some(presence::PRESENT)), "{sentence}");
    }
    house.after(1, "somebody", "Ada comes home.");
    assert_eq!(house.presence("ada"), Some(presence::PRESENT));
}

/// What is said of everybody is said of each who lives here, and holds after a restart.
#[test]
fn nobody_is_home() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "plumber", "They sit on the sofa.");
    house.after(5, "somebody", "Nobody is home.");
    let presences = |house: &mut House| ["ada", "ben", "plumber"].map(|who| house.presence(who));
    assert_eq!(presences(&mut house), [Some(presence::AWAY); 3]);
    assert!(house.board.snapshot().has(score_flags::NOBODY_HOME));
    assert_eq!(house.person("ben").unwrap().name(), "ben");
    house.restart();
    assert_eq!(presences(&mut house), [Some(presence::AWAY); 3]);
    house.after(5, "somebody", "Ben is home.");
    assert_eq!(house.presence("ben"), Some(presence::PRESENT));
}

/// A sensor that sees nobody tells where nobody is, and of nobody that they are here.
#[test]
fn a_room_may_be_empty() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "somebody", "Nobody is in the kitchen.");
    assert_eq!((house.known(), house.presence("ada")), (0, None));
    house.after(1, "ada", "present in the kitchen");
    let kitchen = house.now().0.iter().position(|p| *p > 0.9).unwrap();
    house.after(1, "somebody", "nobody in the kitchen");
    let empty = house.now().0;
    assert!(empty[kitchen] < 0.02, "{empty:?}");
    assert_eq!((house.known(), house.presence("ben")), (1, None));
    let before = house.person("ada").unwrap().observed_ns;
    house.restart();
    assert!(house.now().0.iter().zip(&empty).all(|(a, b)| (a - b).abs() < 1e-5));
    assert_eq!(house.person("ada").unwrap().observed_ns, before);
    // What was seen before the last word on somebody is past.
    house.after(5, "ada", "present in the kitchen");
    let late = Observation { observed_ns: house.now_ns - S, ..house.observation("somebody", "nobody in the kitchen") };
    house.enter(late);
    assert!(house.now().0[kitchen] > 0.9);
}

/// Whoever comes home was not there.
#[test]
fn who_comes_home_is_one_who_was_away() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "away");
    house.after(1, "ben", "They sit on the sofa.");
    house.after(60, "somebody", "They come home.");
    assert_eq!((house.presence("ada"), house.known()), (Some(presence::PRESENT), 2));
    house.after(1, "somebody", "Carla comes home.");
    assert_eq!((house.presence("carla"), house.known()), (Some(presence::PRESENT), 3));
}

/// A name that a sentence gave is there after a restart, and means the same person.
/// What was said before the map changed is not read by the map of now: everybody is believed where they were.
#[test]
fn a_restart_after_a_map_change_moves_nobody() {
    let config = PersonsConfig::default();
    let mut house = House { board: board_of(FLAT, &config), config: config.clone(), ..House::new(&[]) };
    house.after(1, "Ada", "She opens the fridge.");
    house.after(40, "Ada", "She sits down on the sofa.");
    house.after(1, "Ben", "He grabs the milk.");
    house.after(1, "Cleo", "present in the study");
    house.after(1, "Dan", "away");
    let told = |house: &mut House| -> Vec<(u32, Vec<f32>)> {
        let forecasts = *house.board.person_forecasts(house.now_ns);
        let rooms = forecasts.room_count as usize;
        let own = |own: &roomcast_ipc::PersonForecastV1| {
            (own.person, (0..rooms).flat_map(|room| [0, 6, 10].map(|at| own.probability[room][at])).collect())
        };
        forecasts.persons().iter().map(own).collect()
    };
    let changes = |changes: &str| roomcast_core::semantic_map::delta::parse_changes(changes).unwrap();
    let moved = r#"[{"change": "move-item", "id": "sofa-1", "position_m": [6.0, 6.8, 0.4],
        "box": {"min_m": [5.7, 6.4, 0.0], "max_m": [6.3, 7.2, 0.8]}}, {"change": "remove-item", "id": "milk-1"}]"#;
    let before = told(&mut house);
    for change in [moved, r#"[{"change": "remove-item", "id": "sofa-1"}]"#] {
        let map = house.board.map().changed(changes(change)).unwrap();
        house.board.change_map(map.clone()).unwrap();
        house.step(None);
        assert_eq!(told(&mut house).len(), before.len());
        let changed = told(&mut house);
        house.restart_on(board_on(map, &config));
        for ((person, changed), (again, restarted)) in changed.iter().zip(told(&mut house)) {
            assert_eq!(*person, again);
            let differ = changed.iter().zip(&restarted).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
            assert!(differ < 0.02, "{person}: {changed:?} {restarted:?}");
        }
    }
}

/// A visitor who is gone by silence is told to be gone once, also where the daemon is killed then.
#[test]
fn who_is_gone_by_silence_is_gone_once() {
    let mut house = House::new(&["Ada"]);
    house.after(1, "Ada", "She sits down on the sofa.");
    house.after(1, "Olaf", "He opens the fridge.");
    house.wait(11_000);
    assert_eq!(house.presence("Olaf"), Some(presence::GONE));
    house.restart();
    assert_eq!((house.presence("Olaf"), house.known()), (None, 1));
    // Who comes back is known again, and one who was gone while no daemon ran is told of once.
    house.after(1, "Olaf", "He opens the fridge.");
    house.now_ns += 11_000 * S;
    house.restart();
    assert_eq!(house.presence("Olaf"), Some(presence::GONE));
    house.restart();
    assert_eq!(house.presence("Olaf"), None);
}

/// Home Assistant's id of a person is their name in other letters.
#[test]
fn a_name_in_a_topic_is_the_residents() {
    let mut house = House::new(&["Lena O'Neill", "Anne-Marie", "Jean Luc"]);
    for (name, resident) in [("lena o neill", "Lena O'Neill"), ("anne marie", "Anne-Marie"), ("jean_luc", "Jean Luc")] {
        house.after(1, name, "away");
        assert_eq!(house.presence(resident), Some(presence::AWAY), "{name}");
    }
    assert_eq!(house.known(), 3);
}

/// What a sentence begins with becomes no person, neither in deeds nor where somebody is, and takes nothing from whom it is about.
#[test]
fn what_a_sentence_begins_with_is_no_person() {
    let told = |line: &str| {
        let config = PersonsConfig { residents: vec!["Ada".into(), "Ben".into()], ..PersonsConfig::default() };
        let mut house = House { board: board_of(FLAT, &config), config, ..House::new(&[]) };
        house.after(1, "Ada", "present in the kitchen");
        house.after(1, "Ben", "present in the living room");
        let rooms = |house: &House| -> Vec<String> {
            let map = house.board.pipeline().grounding().partitions();
            let room = |who: &str| {
                let number = house.board.persons().number_of(who);
                let likeliest = house
                    .board
                    .belief_of(number)
                    .and_then(|belief| (0..belief.len()).max_by(|a, b| belief[*a].total_cmp(&belief[*b])));
                likeliest.map_or_else(String::new, |room| map[room].id.clone())
            };
            ["Ada", "Ben"].map(room).into()
        };
        let before = rooms(&house);
        house.after(1, "somebody", line);
        let mut moved: Vec<String> = Vec::new();
        for (at, (who, short)) in [("Ada", "ada"), ("Ben", "ben")].into_iter().enumerate() {
            let is_out = house.presence(who) != Some(presence::PRESENT);
            if is_out {
                moved.push(format!("{short} out"));
            } else if rooms(&house)[at] != before[at] {
                moved.push(format!("{short} {}", rooms(&house)[at]));
            }
        }
        let new = house.board.persons().iter().filter_map(|(number, _)| house.board.persons().name_of(number));
        moved.extend(new.filter(|name| !["Ada", "Ben"].contains(name)).map(|name| format!("new {name}")));
        moved.join(", ")
    };
    for line in [
        "Front Door opens.",
        "Back Door closes.",
        "Solar Panel produces power.",
        "Home Assistant restarts.",
        "Baby Monitor turns on.",
        "Electric Car arrives.",
        "Electric Car leaves the house.",
        "Pizza Delivery arrives.",
        "Front Door: opened.",
        "Kitchen Light turns on.",
        "Perhaps Ada goes to bed.",
        "I think Ada goes to bed.",
        "I think Ada leaves the house.",
        "Maybe Ada leaves the house.",
        "Probably, Ben leaves the house.",
        "Tomorrow, Ben leaves the house.",
        "Ada: Ben is in the bedroom.",
        "The radio says: Ben leaves the house.",
        "Everybody except Ada sings.",
        "Ada's phone rings.",
        "Living room is empty?",
    ] {
        assert_eq!(told(line), "", "{line}");
    }
    for (line, expected) in [
        ("Carefully, Ben sits down on the bed.", "ben bedroom"),
        ("Again, Ben opens the fridge.", "ben kitchen"),
        ("Hungry, Ben opens the fridge.", "ben kitchen"),
        ("Yawning, Ada goes to bed.", "ada bedroom"),
        ("Still wet, Ben opens the fridge.", "ben kitchen"),
        ("Alone at home, Ben opens the fridge.", "ben kitchen"),
        ("Without looking, Ben opens the fridge.", "ben kitchen"),
        ("Poor Ada goes to bed.", "ada bedroom"),
        ("Tired Ben opens the fridge.", "ben kitchen"),
        ("Old Ben goes to bed.", "ben bedroom"),
        ("Sadly Ben leaves the house.", "ben out"),
        ("Hey Ben leaves the house.", "ben out"),
        ("Carefully, Ben leaves the house.", "ben out"),
        ("- Ada goes to bed.", "ada bedroom"),
        ("- Ada leaves the house.", "ada out"),
        ("10:32 Ben opens the fridge.", "ben kitchen"),
        ("10:32 Ben leaves the house.", "ben out"),
        ("Kitchen: Ben opens the fridge.", "ben kitchen"),
        ("Alert: Ben leaves the house.", "ben out"),
        ("Update: Ben leaves the house.", "ben out"),
        ("Note: Ada goes to bed.", "ada bedroom"),
        ("Correction: Ben is in the bedroom.", "ben bedroom"),
        ("Motion detected: Ben is in the bathroom.", "ben bathroom"),
        ("My wife Ada goes to bed.", "ada bedroom"),
        ("My wife Ada leaves the house.", "ada out"),
        ("Our daughter Lily goes to bed.", "new lily"),
        ("Jörg Müßig opens the fridge.", "new jörg müßig"),
        ("Jonas Müller leaves the house.", "new jonas müller"),
        ("Ada Müller goes to bed.", "ada bedroom"),
        ("Poor Ada and Ben leave the house.", "ada out, ben out"),
        ("Sadly Ben leaves the house, and Ada goes to bed.", "ada bedroom, ben out"),
        ("Ben and Ada sit down on the bed.", "ada bedroom, ben bedroom"),
        ("Everybody but poor Ada leaves the house.", "ben out"),
    ] {
        assert_eq!(told(line), expected, "{line}");
    }
    // What nobody is in needs no article.
    assert_eq!(told("Living room is empty."), told("The living room is empty."));
    assert_ne!(told("Living room is empty."), "");
}

/// Of whom comes home it is told, too, behind what a sentence begins with.
#[test]
fn who_comes_home_may_stand_behind_other_words() {
    for line in ["Carefully, Ben comes home.", "Alert: Ben comes home.", "Old Ben comes home.", "18:00 Ben comes home."]
    {
        let mut house = House::new(&["Ada", "Ben"]);
        house.after(1, "Ada", "away");
        house.after(1, "Ben", "away");
        house.after(1, "somebody", line);
        let present = |house: &mut House, who: &str| house.presence(who) == Some(presence::PRESENT);
        assert_eq!((present(&mut house, "Ada"), present(&mut house, "Ben")), (false, true), "{line}");
    }
}

/// Titles tell apart, whatever stands before the name.
#[test]
fn a_title_before_a_name_is_part_of_it() {
    let mut house = House::new(&["Ada"]);
    house.after(1, "Ada", "The wait.");
    house.after(1, "Mr. Novak", "present");
    house.after(1, "somebody", "Mrs. Novak leaves the house.");
    house.after(1, "somebody", "Mrs. Novak goes home.");
    assert_eq!(house.presence("Mr. Novak"), Some(presence::PRESENT));
}

#[test]
fn a_restart_keeps_the_names_of_plain_sentences() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ben", "They sit on the sofa.");
    house.after(1, "somebody", "Eve is in the kitchen.");
    assert_eq!(house.person("eve").unwrap().name(), "eve");
    house.restart();
    assert_eq!(house.person("eve").unwrap().name(), "eve");
    house.after(1, "somebody", "Eve opens the fridge.");
    assert_eq!((house.person("eve").unwrap().window, house.person("ben").unwrap().window), (1, 1));
}

/// What was told of hours later is of a visitor who sleeps, too.
#[test]
fn a_visitor_who_is_told_of_late_may_sleep_here() {
    let mut house = House::new(&["ada"]);
    let lies = house.observation("guest", "They lie on the bed.");
    house.now_ns += 8 * 3600 * S;
    house.enter(lies);
    assert_eq!(house.presence("guest"), Some(presence::PRESENT));
}

/// Of who lives here and was never observed nobody knows whether they are out.
#[test]
fn a_home_is_not_empty_as_long_as_somebody_may_be_there() {
    let mut house = House::new(&["ada", "ben"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "ada", "Ada is still at work.");
    assert!(!house.board.snapshot().has(score_flags::NOBODY_HOME));
    let forecast = *house.board.forecast(house.now_ns);
    assert_eq!((forecast.flags, forecast.elsewhere[0]), (forecast_flags::NOT_KNOWN, 0.0));
    let even = 1.0 / forecast.room_count as f32;
    assert!(forecast.probability.iter().take(forecast.room_count as usize).all(|row| row[0] == even));
    house.after(1, "ben", "away");
    assert!(house.board.snapshot().has(score_flags::NOBODY_HOME));
    assert_eq!(house.board.forecast(house.now_ns).flags, forecast_flags::NOBODY_HOME);
}

/// A home with one resident has nobody else.
#[test]
fn what_names_nobody_is_of_a_resident_first() {
    let mut house = House::new(&["ada"]);
    house.after(1, "somebody", "They open the fridge.");
    assert_eq!((house.presence("ada"), house.known()), (Some(presence::PRESENT), 1));
    assert_eq!(house.person("ada").unwrap().flags, person_flags::BY_FIT);
}

/// A phone that tells late that its person was out does not send them out of the room that they are in.
#[test]
fn what_arrives_late_does_not_turn_back_presence() {
    let mut house = House::new(&[]);
    house.after(1, "ada", "They open the fridge.");
    let before = house.now().0;
    let late = Observation { observed_ns: house.now_ns - S, ..house.observation("ada", "away") };
    let likeliest = |rooms: &[f32]| (0..rooms.len()).max_by(|a, b| rooms[*a].total_cmp(&rooms[*b])).unwrap();
    house.now_ns += 5 * S;
    house.enter(late);
    assert_eq!(house.presence("ada"), Some(presence::PRESENT));
    assert_eq!(likeliest(&house.now().0), likeliest(&before));
    house.restart();
    assert_eq!(house.presence("ada"), Some(presence::PRESENT));
}

#[test]
fn a_visitor_may_sleep_here() {
    let mut house = House::new(&["ada"]);
    house.after(1, "ada", "They open the fridge.");
    house.after(1, "guest", "They lie on the bed.");
    house.wait(9 * 3600);
    assert_eq!(house.person("guest").unwrap().flags, person_flags::ASLEEP | person_flags::VISITOR);
    house.wait(4 * 3600);
    assert_eq!(house.presence("guest"), Some(presence::GONE));
}

/// A room that is said is believed at once, however sure the belief was before.
#[test]
fn a_presence_in_a_room_is_believed_at_once() {
    let mut house = House::new(&[]);
    house.after(1, "ada", "They lie on the bed.");
    house.after(4, "ada", "present in the kitchen");
    let rooms = house.now().0;
    assert!(rooms.iter().any(|p| *p > 0.95), "{rooms:?}");
    house.after(4, "ada", "Ada is in the bedroom.");
    let again = house.now().0;
    assert_ne!(rooms.iter().position(|p| *p > 0.95), again.iter().position(|p| *p > 0.95));
    assert!(again.iter().any(|p| *p > 0.95), "{again:?}");
}

/// Row "10 000 persons" of the attacks, in a home that names nobody who lives there.
#[test]
fn who_invents_persons_pushes_out_their_own() {
    let mut house = House::new(&[]);
    for who in ["0", "ada", "ben"] {
        house.after(1, who, "They sit on the sofa.");
    }
    for invented in 0..1_000 {
        house.after_by(666, &format!("person {invented}"), "They walk to the kitchen.");
    }
    let known = house.board.persons();
    let here = |who: &str| known.get(who.parse().unwrap_or_else(|_| known.number_of(who))).is_some();
    assert!(["0", "ada", "ben", "person 999"].iter().all(|who| here(who)));
    assert!(!here("person 900"));
    // A voice that knows few is heard with its next one too.
    house.after(1, "carl", "They sit on the sofa.");
    let known = house.board.persons();
    assert!(["ada", "ben", "carl"].iter().all(|who| known.get(known.number_of(who)).is_some()));
    assert_eq!(known.iter().count(), PERSONS_MAX);
}

/// Presence, attributions, windows and forecasts are after a restart what they were before it: nobody is surer of a silent person.
#[test]
fn a_restart_changes_nothing() {
    let mut house = House::new(&["ada", "ben"]);
    let day = [
        ("ada", "They open the fridge."),
        ("ben", "They lie on the bed."),
        ("somebody", "They close the fridge."),
        ("ada", "They stand up."),
        ("somebody", "They sit on the bed."),
        ("plumber", "They walk to the bathroom."),
        ("ben", "away"),
        ("somebody", "present in the kitchen"),
        ("ada", "They walk to the sofa."),
        ("plumber", "gone"),
        ("somebody", "They sit on the sofa."),
        ("ben", "present"),
        ("ben", "They grab the mug."),
        ("somebody", "Ada opens the fridge and Ben lies on the bed."),
        ("somebody", "The light is off."),
        ("somebody", "They sit down. Ben leaves the house. Ada walks to the kitchen."),
        ("plumber", "They greet Ada and Ben comes home."),
        ("somebody", "Nobody is in the kitchen. Ada and the plumber sit on the sofa."),
    ];
    for round in 0..6 {
        for (number, (who, what)) in (0..).zip(day) {
            house.after([2, 45, 700, 4000][(number + round) % 4], who, what);
            let of = |house: &mut House| {
                let told = *house.board.person_scores(house.now_ns);
                let persons: Vec<_> = told.persons().iter().filter(|p| p.presence != presence::GONE).copied().collect();
                (persons, house.board.person_forecasts(house.now_ns).person)
            };
            for silence_s in [0, 20, 3000] {
                house.wait(silence_s);
                let before = of(&mut house);
                house.restart();
                let after = of(&mut house);
                assert_eq!(before.0.len(), after.0.len());
                for (before, after) in before.0.iter().zip(&after.0) {
                    let flags = before.flags | person_flags::RESTORED;
                    assert_eq!(*after, PersonV1 { flags, ..*before }, "{round} {who} {what}");
                }
                // Who fell silent before the start is gone again.
                let here = |forecast: &&roomcast_ipc::PersonForecastV1| forecast.presence != presence::GONE;
                for (before, after) in before.1.iter().filter(here).zip(after.1.iter().filter(here)) {
                    assert_eq!(before.elsewhere, after.elsewhere);
                    for (before, after) in before.probability.iter().zip(&after.probability) {
                        assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 1e-5), "{before:?} {after:?}");
                    }
                }
            }
        }
    }
}

/// Who leaves a room is in another, also where two do.
#[test]
fn two_who_leave_a_room_are_not_in_it() {
    let mut house = House::new(&["ada", "ben"]);
    let kitchen = |house: &mut House, who: &str| {
        let number = house.board.persons().number_of(who);
        let scores = *house.board.person_forecasts(house.now_ns);
        let person = scores.persons().iter().find(|person| person.person == number).unwrap();
        let room = scores.rooms().position(|room| room == "kitchen").unwrap();
        person.probability[room][0]
    };
    for (who, what) in [("ada", "They walk to the kitchen."), ("ben", "They sit on the sofa.")] {
        house.after(60, who, what);
    }
    house.after(60, "somebody", "Ada & Ben leave the kitchen.");
    for who in ["ada", "ben"] {
        let likely = kitchen(&mut house, who);
        assert!(likely < 0.2, "{who} is in the kitchen with {likely}");
    }
    house.after(60, "somebody", "Ada & Ben leave the house.");
    assert_eq!(["ada", "ben"].map(|who| house.presence(who)), [Some(presence::AWAY); 2]);
}

/// Where a power loss took a part of what somebody did, the model says something else of the rest: that is what is believed from then on, and so
/// what the next restart is told. What the journal says already is not said again.
#[test]
fn a_restart_tells_what_the_model_makes_of_what_is_left() {
    let mut house = House::new(&[]);
    let observation = house.observation("3", "They grab the coffee maker.");
    let tell = |said: &[&[f64]]| {
        let mut journal = encode(&observation, &BOOT);
        let mut told = Vec::new();
        for probability in [&[][..]].iter().chain(said) {
            let (source, epoch, sequence) = (observation.source, observation.epoch, observation.sequence);
            let (person, by_fit, map) = (3, false, board(&house.config).map_number());
            journal.extend(encode_outcome(&Outcome { source, epoch, sequence, person, by_fit, map, probability }));
        }
        let mut recovered = Recovered::default();
        read_records(&journal, &BOOT, &mut recovered);
        let mut again = board(&house.config);
        again.restore(recovered, house.now_ns, 1_000_000 * S + house.now_ns);
        again.step([], house.now_ns, 1_000_000 * S + house.now_ns).unwrap();
        again.tell_outcomes(|outcome| told.push(outcome.probability.to_vec()));
        told
    };
    let now = tell(&[]).remove(0);
    assert!(now.len() > 1);
    assert_eq!(tell(&[&now]), [[0.0; 0]; 0]);
    let other: Vec<f64> = now.iter().rev().copied().collect();
    assert_eq!(tell(&[&other]), [&*now]);
    assert_eq!(tell(&[&other, &now]), [[0.0; 0]; 0]);
}

/// Of who is out the journal is told whose the word was. A restart tells it where a daemon that was killed, or the power, took that; and not twice.
#[test]
fn a_restart_tells_who_is_out_where_nothing_says_it() {
    let mut house = House::new(&["ada"]);
    let observation = house.observation("ada", "away");
    let tell = |journal: &mut Vec<u8>| {
        let mut recovered = Recovered::default();
        read_records(journal, &BOOT, &mut recovered);
        let mut again = board(&house.config);
        again.restore(recovered, house.now_ns, 1_000_000 * S + house.now_ns);
        again.step([], house.now_ns, 1_000_000 * S + house.now_ns).unwrap();
        let mut told = Vec::new();
        again.tell_outcomes(|outcome| {
            told.push((outcome.sequence, outcome.person, outcome.by_fit, outcome.probability.len()));
            journal.extend(encode_outcome(outcome));
        });
        told
    };
    let mut journal = encode(&observation, &BOOT);
    assert_eq!(tell(&mut journal), [(1, person_number("ada"), false, 0)]);
    assert_eq!(tell(&mut journal), []);
}

/// Who comes back after they were gone is known afresh, whether or not it was told in between that they were gone: a restart cannot know that.
#[test]
fn who_comes_back_is_known_afresh() {
    for is_told in [true, false] {
        let mut house = House::new(&[]);
        house.after(60, "guest", "They sit on the sofa.");
        house.wait(60);
        let mut late = |late_s: u64, text: &str| {
            let observation = house.observation("guest", text);
            let (observed_ns, observed_unix_ns) = (observation.observed_ns, observation.observed_unix_ns);
            Observation {
                observed_ns: observed_ns - late_s * S,
                observed_unix_ns: observed_unix_ns - late_s * S,
                ..observation
            }
        };
        let [goes, sits, goes_again] = [late(0, "gone"), late(5, "They sit on the sofa."), late(3, "gone")];
        if is_told {
            house.enter(goes);
            assert_eq!(house.presence("guest"), Some(presence::GONE));
            house.enter(sits);
        } else {
            let entries = [goes, sits].map(|observation| Entry::new(observation, house.now_ns));
            house.board.step(entries, house.now_ns, 1_000_000 * S + house.now_ns).unwrap();
        }
        house.enter(goes_again);
        assert_eq!(house.presence("guest"), Some(presence::GONE), "{is_told}");
    }
}

/// What people narrate at home: who of Lena and Paul is in before it, and who is after it, with the visitors.
#[test]
fn people_come_and_go_as_is_narrated() {
    for (before, text, after) in [
        ("LP", "Lena rushes off to work.", "P"),
        ("LP", "Paul rides his bike to the lake.", "L"),
        ("LP", "Paul has gone to pick up a pizza.", "L"),
        ("LP", "Lena is on the road.", "P"),
        ("LP", "Paul is stuck at the office.", "L"),
        ("LP", "Lena is on her way to the office.", "P"),
        ("LP", "Although it rains, Lena goes jogging.", "P"),
        ("P", "Lena gets off the bus.", "P"),
        ("P", "Lena leaves the office.", "P"),
        ("P", "Lena left work.", "P"),
        ("P", "Lena remembers the milk and turns around.", "P"),
        ("LP", "Leipzig beats Hamburg.", "LP"),
        ("-", "Paul comes home with Igor.", "P+igor"),
        ("P", "Paul opens the door for Lena.", "LP"),
        ("P", "Lena gives Paul a kiss.", "LP"),
        ("P", "Paul gives Lena a kiss.", "LP"),
        ("P", "Honey, I'm home!", "LP"),
        ("P", "I'm home!", "LP"),
        ("-", "Honey, I'm home!", "-"),
        ("-", "I'm home!", "-"),
        ("LP", "Lena opens the fridge.;;She sits down.;;He leaves the house.", "L"),
        ("LP", "Lena puts on her shoes.", "LP"),
        ("P", "Lena is taking a bath.", "LP"),
        ("LP", "Paul's phone left the home zone.", "L"),
        ("L", "Paul's phone is back in the home zone.", "LP"),
        ("LP", "Paul sits in the office.", "LP"),
        ("LP", "We leave after dinner.", "LP"),
        ("LP", "Everybody has left for the weekend.", "-"),
        ("LP", "Lena brushes her teeth.;;He leaves the house.", "L"),
        ("LP", "Paul shaves himself.;;Lena opens the fridge.;;He leaves the house.", "L"),
        ("LP", "Paul goes to the office.", "L"),
        ("LP", "Lena goes to the office to work at her desk.", "LP"),
        ("P", "Lena walks in through the front door.", "LP"),
        ("P", "Paul hugs Lena in the hallway.", "LP"),
        ("P", "Paul greets Lena at the door.", "LP"),
        ("LP", "Lena dashes off to the gym.", "P"),
        ("LP", "Paul jogs around the park.", "L"),
        ("LP", "Lena went to buy bread.", "P"),
        ("LP", "Lena goes to fetch the kids from school.", "P"),
        ("LP", "Lena has gone to collect a parcel.", "P"),
        ("LP", "Lena gives Paul a lift to the airport.", "-"),
        ("LP", "Paul rides his motorcycle to the mountains.", "L"),
        ("LP", "Lena takes her bike to work.", "P"),
        ("LP", "Lena is stuck in traffic.", "P"),
        ("LP", "Lena is still on the train.", "P"),
        ("LP", "Paul is sitting in a café.", "L"),
        ("LP", "Lena is standing at the bus stop.", "P"),
        ("LP", "Paul is out running errands.", "L"),
        ("LP", "Lena is in a meeting at work.", "P"),
        ("LP", "Lena is on a business trip in Berlin.", "P"),
        ("LP", "Paul is on his way to work.", "L"),
        ("P", "Lena gets out of the taxi.", "P"),
        ("P", "Lena steps off the plane.", "P"),
        ("P", "Lena leaves the gym.", "P"),
        ("P", "Lena left the supermarket.", "P"),
        ("P", "Lena leaves school.", "P"),
        ("P", "Lena finishes work.", "P"),
        ("P", "Lena starts her shift.", "P"),
        ("P", "Lena realizes that she forgot her wallet and turns back.", "P"),
        ("P", "Lena walks along the river.", "P"),
        ("P", "Lena crosses the street.", "P"),
        ("P", "Lena changes trains in Cologne.", "P"),
        ("L", "Paul leaves the stadium.", "L"),
        ("LP", "Bayern beats Dortmund.", "LP"),
        ("LP", "Hamburg defeats Bremen 2:1.", "LP"),
        ("LP", "Germany ties with Spain.", "LP"),
        ("-", "Lena comes home with her friend Igor.", "L+igor"),
        ("P", "Paul opens the front door for Lena.", "LP"),
        ("P", "Paul helps Lena out of her coat.", "LP"),
        ("P", "Paul hands Lena a cup of tea.", "LP"),
        ("P", "Hi, I'm back!", "LP"),
        ("P", "Hello, I'm home!", "LP"),
        ("LP", "Lena's phone left home.", "P"),
        ("L", "Paul's phone arrived home.", "LP"),
        ("LP", "Lena's phone is away.", "P"),
        ("LP", "Despite the rain, Paul goes for a run.", "L"),
        ("LP", "Because of the sun, Lena goes swimming.", "P"),
        ("LP", "Since it is Sunday, Paul goes to church.", "L"),
        ("LP", "As the sun shines, Lena goes for a walk.", "P"),
        ("LP", "The whole family is on vacation.", "-"),
        ("P", "Lena arrives home from work.", "LP"),
        ("P", "Lena unlocks the front door and comes inside.", "LP"),
        ("P", "Paul lets Lena in.", "LP"),
        ("LP", "Paul has left for the airport.", "L"),
        ("LP", "Paul heads for the supermarket.", "L"),
        ("P", "Lena misses her stop.", "P"),
        ("P", "Lena has lunch with a colleague.", "P"),
        ("LP", "Amazon delivers a parcel.", "LP"),
        ("LP", "Siri answers.", "LP"),
        ("LP", "The babysitter arrives.", "LP+babysitter"),
        ("P", "Lena kisses Paul.", "LP"),
        ("P", "Paul cooks dinner for Lena.", "P"),
        ("LP", "Lena cooks.;;She leaves the house.", "P"),
        ("LP", "Lena grabs her keys.", "LP"),
        ("LP", "Motion in the corridor.", "LP"),
        ("LP", "Lena wants to leave the house.", "LP"),
        ("LP", "Lena almost left the house.", "LP"),
        ("LP", "Paul heard that Lena left the company.", "LP"),
        ("LP", "Paul snores.", "LP"),
        ("LP", "Everyone has gone on holiday.", "-"),
        ("LP", "Paul walks the dog.", "L"),
        ("LP", "Lena cooks and Paul goes jogging.", "L"),
        ("LP", "Paul works in the home office.", "LP"),
    ] {
        let mut house = House::new(&["Lena", "Paul"]);
        house.board = board_of(FLAT, &house.config);
        for (letter, who) in [('L', "Lena"), ('P', "Paul")] {
            house.after(1, who, "They stand up.");
            if !before.contains(letter) {
                house.after(1, who, "away");
            }
        }
        for visitor in before.split('+').skip(1) {
            house.after(1, visitor, "They stand up.");
        }
        house.wait(300);
        for sentence in text.split(";;") {
            house.after(10, "somebody", sentence);
        }
        let told = *house.board.person_scores(house.now_ns);
        let here = told.persons().iter().filter(|person| person.presence == presence::PRESENT);
        let mut here: Vec<&str> = here.map(PersonV1::name).collect();
        here.sort_unstable();
        let (mut residents, mut visitors) = (String::new(), String::new());
        for name in here {
            match name {
                "Lena" => residents.push('L'),
                "Paul" => residents.push('P'),
                other => visitors.extend(["+", other]),
            }
        }
        let residents = if residents.is_empty() { "-" } else { &residents };
        assert_eq!(format!("{residents}{visitors}"), after, "{text}");
    }
}

/// Identifiers of devices have no accents: what they say of Zoë is of her, the second time too.
#[test]
fn a_name_without_accents_stays_the_same_persons() {
    let mut house = House::new(&["Zoë", "Jürgen"]);
    house.after(1, "zoe", "present");
    house.after(1, "zoe", "away");
    house.after(1, "Mrs. Zoe", "present");
    let named: Vec<_> = house.board.persons().iter().map(|(number, _)| number).collect();
    assert_eq!(named, [person_number("Zoë")]);
    assert_eq!(house.board.persons().name_of(named[0]), Some("Zoë"));
    // Of one who does not live here the first spelling stays, whatever the accents.
    house.after(1, "Renée", "present");
    house.after(1, "renee", "away");
    let renee = person_number("Renée");
    assert_eq!(house.board.persons().name_of(renee), Some("Renée"));
    assert_eq!(house.board.persons().count(), (2, 1));
}

/// What one source says goes in its order, though its times are a little out of it.
#[test]
fn the_later_line_of_a_source_counts_whatever_its_time_was_rounded_to() {
    for (earlier_ns, is_heard) in [(0, true), (50_000, true), (S / 10, true), (S / 2, false)] {
        let mut house = House::new(&["Ada"]);
        house.after(1, "Ada", "They open the fridge.");
        house.now_ns -= earlier_ns;
        house.after(0, "Ada", "away");
        let presence = house.board.persons().get(person_number("Ada")).unwrap().presence;
        assert_eq!(presence == Presence::Away, is_heard, "{earlier_ns} ns earlier");
    }
    // What another source has said since is later all the same.
    let mut house = House::new(&["Ada"]);
    house.after(1, "Ada", "They open the fridge.");
    house.after_by(9, "Ada", "They sit on the sofa.");
    house.now_ns -= S / 20;
    house.after(0, "Ada", "away");
    assert_eq!(house.board.persons().get(person_number("Ada")).unwrap().presence, Presence::Present);
}

/// Who is known, and whether they are in the house.
fn presences(house: &House) -> BTreeMap<u32, Presence> {
    let here = house.board.persons().iter().filter(|(_, known)| known.presence != Presence::Gone);
    here.map(|(number, known)| (number, known.presence)).collect()
}

/// Who is known, whether they are in the house, and when they were heard of last.
fn heard(house: &House) -> BTreeMap<u32, (Presence, i64)> {
    let known = house.board.persons().iter();
    known.map(|(number, known)| (number, (known.presence, known.heard_ns))).collect()
}

/// Somebody is forgotten, also in the journal.
fn forget(house: &mut House, who: &str) -> PersonAnswer {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("narration.journal");
    std::fs::write(&file, &house.journal).unwrap();
    let options = JournalOptions { directory: directory.path().into(), bytes_max: 16 << 20, sync_ms: 1000 };
    let (journal, _) = Journal::open(&options).unwrap();
    let question = PersonQuestion::Forget { id: "1".to_owned(), who: who.to_owned() };
    let answer = answer_about_person(&mut house.board, (Some(&journal.handle()), None), Ok(question));
    drop(journal);
    house.journal = std::fs::read(&file).unwrap();
    house.step(None);
    answer
}

const COMPANY: [&str; 5] = ["Anna", "Ben", "Igor", "Sophia", "Lukas"];
const SAID: [&str; 28] = [
    "They open the fridge.",
    "They leave the house.",
    "They come home.",
    "NAME sits on the sofa.",
    "NAME leaves the house.",
    "NAME comes home.",
    "NAME goes to bed.",
    "NAME calls.",
    "NAME hugs OTHER.",
    "NAME takes OTHER home.",
    "NAME and OTHER leave the house.",
    "NAME cooks and OTHER leaves the house.",
    "Everybody except NAME leaves.",
    "Only NAME is home.",
    "Both leave.",
    "Both come home.",
    "All three leave.",
    "Everybody goes to bed.",
    "Everybody leaves the house.",
    "The guests leave.",
    "The guest leaves.",
    "I'm home!",
    "Somebody leaves the house.",
    "Nobody is in the kitchen.",
    "She sits on the sofa.",
    "He opens the window.",
    "NAME brushes her teeth. She goes to the office.",
    "He leaves the house with OTHER.",
];

fn narrate(house: &mut House, said: &[(usize, usize, usize, bool)]) {
    for (sentence, name, other, is_keyed) in said {
        let text = SAID[*sentence].replace("NAME", COMPANY[*name]).replace("OTHER", COMPANY[*other]);
        let who = if *is_keyed { COMPANY[(*name + *other) % 5] } else { "somebody" };
        house.after(20, who, &text);
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig { cases: 150, ..Default::default() })]

    /// Nobody else is moved by what the home forgets of somebody, nor by who lives there from now on.
    #[test]
    fn who_is_forgotten_or_moves_in_moves_nobody_else(
        said in proptest::collection::vec((0..SAID.len(), 0..5_usize, 0..5_usize, proptest::bool::weighted(0.2)), 1..14),
        who in 0..5_usize,
        residents in proptest::collection::vec(proptest::bool::ANY, 5),
    ) {
        let mut house = House::new(&["Anna", "Ben"]);
        narrate(&mut house, &said);
        let forgotten = house.board.persons().number_of(COMPANY[who]);
        let mut before = presences(&house);
        let journal = house.journal.clone();
        forget(&mut house, COMPANY[who]);
        let was_known = before.remove(&forgotten).is_some();
        proptest::prop_assert_eq!(&presences(&house), &before);
        for _ in 0..2 {
            house.restart();
            proptest::prop_assert_eq!(&presences(&house), &before, "{} is forgotten", COMPANY[who]);
        }
        let text = String::from_utf8_lossy(&house.journal).to_lowercase();
        // Where nobody was known by the name it is a word that a sentence has.
        proptest::prop_assert!(!was_known || !text.contains(&COMPANY[who].to_lowercase()), "{}", text);

        let mut house = House::new(&["Anna", "Ben"]);
        narrate(&mut house, &said);
        let before = presences(&house);
        proptest::prop_assert!(house.journal == journal);
        let live_here = COMPANY.iter().zip(&residents).filter(|(_, lives_here)| **lives_here);
        house.config.residents = live_here.map(|(name, _)| (*name).to_owned()).collect();
        house.restart();
        proptest::prop_assert_eq!(&presences(&house), &before, "{:?} live here", house.config.residents);
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig { cases: 150, ..Default::default() })]

    /// What is said after a restart moves whom it would have moved without one: also what is known of who is "she" outlives it.
    #[test]
    fn a_restart_moves_nobody_else_afterwards(
        said in proptest::collection::vec((0..SAID.len(), 0..5_usize, 0..5_usize, proptest::bool::weighted(0.2)), 2..14),
        restarts in 1..13_usize,
    ) {
        let at = restarts.min(said.len() - 1);
        let mut house = House::new(&["Anna", "Ben"]);
        narrate(&mut house, &said[..at]);
        let mut restarted = House::new(&["Anna", "Ben"]);
        narrate(&mut restarted, &said[..at]);
        restarted.restart();
        for said in &said[at..] {
            narrate(&mut house, std::slice::from_ref(said));
            narrate(&mut restarted, std::slice::from_ref(said));
            proptest::prop_assert_eq!(heard(&restarted), heard(&house), "{}", SAID[said.0]);
        }
    }
}

/// The journals of older daemons do not say whom their sentences moved: these are read with who is known, and once.
#[test]
fn an_older_journal_is_read_as_before() {
    let mut house = House::new(&["Anna", "Ben"]);
    for (who, what) in [("Anna", "They sit down."), ("Ben", "They sit down."), ("somebody", "Both leave.")] {
        house.after(10, who, what);
    }
    let both_away = presences(&house);
    let mut older = Vec::new();
    each_record(&house.journal, |raw, _| {
        if !raw.starts_with(b"RCJB") {
            older.extend_from_slice(raw);
        }
    });
    assert!(older.len() < house.journal.len());
    house.journal = older;
    house.restart();
    assert_eq!(presences(&house), both_away);
    // From now on it is known whom it moved.
    house.config.residents.push("Igor".to_owned());
    assert!(house.journal.windows(4).any(|letters| letters == b"RCJB"));
    house.restart();
    assert_eq!(presences(&house), both_away);
}

/// What is said of somebody goes with them, however their name is written there; what is said of others stays, also of who has a longer name.
#[test]
fn what_names_who_is_forgotten_goes_and_no_more() {
    let keyed = [("Zoë", "They open the fridge."), ("Lena O'Neill", "They sit down."), ("Tom", "They sit down.")];
    for (others, who, goes, stays) in [
        (
            &[][..],
            "zoë",
            &["Tom gives Zoe a kiss", "Tom takes Zoe's cup", "Tom takes ZOË’S cup", "Tom looks at Zoë"][..],
            &["Tom sees Zoella", "Tom hugs Lena"][..],
        ),
        (
            &[],
            "lena o'neill",
            &["Tom hugs lena_o_neill", "Tom hugs Lena O’Neill", "Tom hugs Lena", "Tom takes Lena's cup"],
            &["Tom hugs Zoe", "Tom visits Mr. O'Neill"],
        ),
        (
            &["Lena"],
            "Lena",
            &["Tom hugs Lena", "Tom takes Lena's cup", "Lena sits down"],
            &["Tom hugs Lena O'Neill", "Lena O’Neill sits down", "Tom takes lena_o_neill's cup"],
        ),
        (
            &["Lena"],
            "Lena O'Neill",
            &["Tom hugs lena_o_neill", "Lena O'Neill goes to bed"],
            &["Tom hugs Lena", "Lena goes to bed"],
        ),
        (
            &["Anna", "Anna Maria"],
            "Anna",
            &["Tom hugs Anna", "Anna goes to bed", "Tom greets Anna. Maria sings"],
            &["Tom hugs Anna Maria", "Anna Maria leaves the house", "Tom takes Anna-Maria's cup"],
        ),
    ] {
        let mut house = House::new(&[]);
        for (who, what) in keyed {
            house.after(1, who, what);
        }
        for other in others {
            house.after(1, other, "They sit down.");
        }
        for (number, text) in goes.iter().chain(stays).enumerate() {
            house.after(100, "Tom", &format!("{text} MARK{number:02}."));
        }
        let answer = forget(&mut house, who);
        assert!(answer.done, "{answer:?}");
        let text = String::from_utf8_lossy(&house.journal).into_owned();
        for (number, said) in goes.iter().chain(stays).enumerate() {
            assert_eq!(text.contains(&format!("MARK{number:02}")), number >= goes.len(), "{who}: {said}");
        }
    }
    // A name that they had before the home gave them one, also where the file does not say it.
    let mut house = House::new(&[]);
    for (who, what) in [("ben", "They sit down."), ("Tom", "They sit down."), ("Tom", "Tom hugs Ben MARK.")] {
        house.after(1, who, what);
    }
    house.board.rename(person_number("ben"), "Ana-Maria").unwrap();
    assert_eq!(house.board.persons().file().persons()[0].former, ["ben"]);
    house.after(1, "Tom", "Tom hugs Ana Maria MARK.");
    house.after(1, "Tom", "Tom takes Ben's cup MARK.");
    assert!(forget(&mut house, "ana-maria").done);
    assert!(!String::from_utf8_lossy(&house.journal).contains("MARK"));
}

/// Who was taken for a person is none any more after a start with a configuration that says so.
#[test]
fn who_is_found_to_be_no_person_is_gone_after_a_restart() {
    for said in ["Rocky cleans the bathroom.", "Rocky opens the fridge and Ada leaves the house."] {
        let mut house = House::new(&["Ada"]);
        house.after(1, "somebody", "Ada opens the fridge.");
        house.after(1, "somebody", said);
        assert_eq!(house.presence("Rocky"), Some(presence::PRESENT), "{said}");
        house.config.not_persons.push("Rocky".to_owned());
        for _ in 0..2 {
            house.restart();
            assert_eq!(house.presence("Rocky"), None, "{said}");
        }
        house.after(1, "somebody", "Ada leaves the house.");
        assert!(house.board.snapshot().has(score_flags::NOBODY_HOME), "{said}");
    }
}

/// What others did to them is in nobody's window any more, and the others' scores are without it.
#[test]
fn who_is_forgotten_is_in_no_window() {
    let mut house = House::new(&["Ada", "Ben"]);
    for said in ["Ada opens the fridge.", "Igor sits on the sofa.", "Ada hugs Igor.", "Ben takes Igor's cup."] {
        house.after(1, "somebody", said);
    }
    let told = |house: &House| {
        let histories = house.board.pipeline().histories().iter();
        histories.flat_map(|(_, history)| history.sentences()).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(told(&house).len(), 4);
    assert!(forget(&mut house, "igor").done);
    assert_eq!(told(&house), ["Ada opens the fridge."]);
    let mut restarted = House::new(&["Ada", "Ben"]);
    restarted.after(1, "somebody", "Ada opens the fridge.");
    assert_eq!(house.person("Ada").unwrap().probability, restarted.person("Ada").unwrap().probability);
}

/// Where nothing is of somebody nothing is written, and nobody is said to be forgotten.
#[test]
fn who_was_never_known_is_not_forgotten() {
    let mut house = House::new(&["Anna"]);
    house.after(1, "Anna", "They sit down.");
    let before = house.journal.clone();
    let answer = forget(&mut house, "Ben");
    assert!(!answer.done && answer.reason.is_some_and(|reason| reason.contains("nobody is known as")));
    assert_eq!(house.journal, before);
}

/// Who ends in s is somebody, too, and moves nobody else.
#[test]
fn a_name_that_ends_as_a_verb_does_is_a_name() {
    for name in ["Lukas", "Thomas", "Chris", "Iris", "Niklas", "Jens", "James", "Agnes"] {
        let mut house = House::new(&[]);
        house.after(1, "somebody", "Anna goes to bed.");
        house.after(1, "Lily", "away");
        let before = presences(&house);
        house.after(60, "somebody", &format!("{name} comes home."));
        house.after(60, "somebody", &format!("{name} opens the fridge."));
        let mut after = presences(&house);
        assert_eq!(after.remove(&person_number(name)), Some(Presence::Present), "{name}");
        assert_eq!(after, before, "{name}");
    }
}

/// Messages and narration have one word for a presence.
#[test]
fn a_presence_has_one_word() {
    use roomcast_core::narration::Presence;
    for all in [Presence::Unknown, Presence::Present, Presence::Away, Presence::Gone] {
        assert_eq!(presence::word(presence_value(all)), all.as_str());
    }
}
