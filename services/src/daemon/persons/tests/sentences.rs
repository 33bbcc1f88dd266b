//! What sentences do, row by row. `sentences.txt` says how its rows are read.

use std::fmt::Write;
use std::sync::LazyLock;

use super::*;
use roomcast_core::narration::line::{Line, Who};

const TABLE: &str = include_str!("sentences.txt");

/// Where residents are in the beginning, in their order.
const ROOMS: [&str; 3] = ["kitchen", "bedroom", "living room"];

/// Who says the sentences: others than who said who is home.
const NARRATOR: u64 = 8;

/// The home of all rows.
static HOME: LazyLock<(SemanticMap, Grounding)> = LazyLock::new(|| {
    let map = SemanticMap::from_json(FLAT).unwrap();
    let grounding = Grounding::new(&map, &GroundingOptions::default()).unwrap();
    (map, grounding)
});

fn board_of_home(config: &PersonsConfig) -> Board<TableModel> {
    let (map, grounding) = HOME.clone();
    let pipeline = Pipeline::new(TableModel::new(7), grounding, PipelineOptions::default()).unwrap();
    let persons = Persons::new(config.clone(), PersonsFile::default());
    Board::new(pipeline, map, GroundingOptions::default(), 1).unwrap().with_persons(persons)
}

/// A row of the table.
struct Row<'a> {
    residents: Vec<&'a str>,
    home: &'a str,
    said: &'a str,
    expected: &'a str,
}

fn rows(table: &str) -> Vec<Row<'_>> {
    let (mut residents, mut rows) = (vec!["Ada", "Ben", "Nora"], Vec::new());
    for line in table.lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        if let Some(names) = line.strip_prefix('@') {
            residents = names.split(',').map(str::trim).collect();
            continue;
        }
        let (home, row) = line.split_once('|').unwrap_or_else(|| panic!("no row: {line}"));
        let (said, expected) = row.rsplit_once("=>").unwrap_or_else(|| panic!("no row: {line}"));
        rows.push(Row {
            residents: residents.clone(),
            home: home.trim(),
            said: said.trim(),
            expected: expected.trim(),
        });
    }
    rows
}

impl House {
    fn narrate(&mut self, line: &str) {
        let Line { kind, text, person, .. } = Line::read(line, &Who::Somebody).unwrap();
        self.said += 1;
        self.now_ns += S;
        let name = Some(person.name()).filter(|name| !name.is_empty());
        let observation = Observation {
            person: person.number(),
            name: name.map(Into::into),
            source: NARRATOR,
            epoch: 1,
            observed_ns: self.now_ns,
            observed_unix_ns: 1_000_000 * S + self.now_ns,
            said: kind.said(&text).unwrap(),
            ..Observation::of(self.said, Sentence::new("They wait.").unwrap())
        };
        self.enter(observation);
    }

    /// The room that somebody is most likely in.
    fn room(&mut self, who: &str) -> String {
        let number = self.board.persons().number_of(who);
        let forecasts = *self.board.person_forecasts(self.now_ns);
        let forecast = forecasts.persons().iter().find(|person| person.person == number).unwrap();
        let likelihood = |row: usize| forecast.probability[row][0];
        let rooms = self.board.snapshot().rooms().to_vec();
        let row = (0..rooms.len()).max_by(|a, b| likelihood(*a).total_cmp(&likelihood(*b))).unwrap();
        rooms[row].id().to_owned()
    }
}

/// The letters of those of the residents of whom `is_such` says so.
fn letters(residents: &[&str], mut is_such: impl FnMut(&str) -> bool) -> String {
    let mut letters: Vec<char> =
        residents.iter().filter(|name| is_such(name)).filter_map(|name| name.chars().next()).collect();
    letters.sort_unstable();
    if letters.is_empty() { "-".to_owned() } else { letters.into_iter().collect() }
}

/// What a row comes to, in the words of the table: as much as it expects, and all who are home and known.
fn outcome(row: &Row<'_>) -> String {
    let residents = &row.residents;
    let residents_of = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
    let config = PersonsConfig { residents: residents_of(residents), ..PersonsConfig::default() };
    let board = board_of_home(&config);
    let mut house = House { board, config, journal: Vec::new(), said: 0, now_ns: 100_000 * S };
    for (who, room) in residents.iter().zip(ROOMS) {
        let is_home = row.home.contains(&who[..1]);
        let said = if is_home { format!("present in the {room}") } else { "away".to_owned() };
        house.after(1, who, &said);
    }
    let begun_ns = house.now_ns;
    for said in row.said.split("||").map(str::trim) {
        match said {
            "(restart)" => house.restart_on(board_of_home(&house.config)),
            said => house.narrate(said),
        }
    }
    let is_home = |name: &str, house: &mut House| house.presence(name) == Some(presence::PRESENT);
    let mut found = letters(residents, |name| is_home(name, &mut house));
    let told = *house.board.person_scores(house.now_ns);
    let number = |name: &str, house: &House| house.board.persons().number_of(name);
    let own: Vec<u32> = residents.iter().map(|name| number(name, &house)).collect();
    let others = told.persons().iter().filter(|person| !own.contains(&person.person));
    let mut others: Vec<String> = others
        .map(|person| {
            let name = if person.name().is_empty() { person.person.to_string() } else { person.name().to_owned() };
            let is_away = person.presence != presence::PRESENT;
            format!(" +{name}{}", if is_away { ":away" } else { "" })
        })
        .collect();
    others.sort_unstable();
    found.extend(others);
    for word in row.expected.split(' ') {
        if let Some((letter, _)) = word.split_once('@') {
            let who = residents.iter().find(|name| name.starts_with(letter)).unwrap();
            write!(found, " {letter}@{}", if is_home(who, &mut house) { house.room(who) } else { "-".to_owned() })
                .unwrap();
        } else if word.starts_with("of:") {
            let is_told = |name: &str| {
                let number = number(name, &house);
                told.persons().iter().any(|person| person.person == number && person.observed_ns > begun_ns)
            };
            write!(found, " of:{}", letters(residents, is_told)).unwrap();
        }
    }
    found
}

#[test]
fn sentences_do_what_a_reader_makes_of_them() {
    let rows = rows(TABLE);
    let differ: Vec<String> = rows
        .iter()
        .filter_map(|row| {
            let found = outcome(row);
            (found != row.expected).then(|| format!("{} | {} => {found}\n    not {}", row.home, row.said, row.expected))
        })
        .collect();
    assert!(differ.is_empty(), "{} of {} rows differ:\n{}", differ.len(), rows.len(), differ.join("\n"));
}
