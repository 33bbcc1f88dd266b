use roomcast_core::ids::PersonId;
use roomcast_ipc::raw::{NarrationV1, PersonForecastsV1, RoomScoresV1, narration_kind};
use roomcast_ipc::sequence;
use rustix::process::Signal;

use roomcast_database::rusqlite::Connection;

use super::{World, eventually, habits, includes, recorder_listens, scores_with};

/// Learned events of all persons.
fn learned(world: &World) -> f64 {
    let (code, answer, errors) = habits(world, &["show", "--json"]);
    assert_eq!(code, 0, "{errors}");
    answer["persons"].as_array().unwrap().iter().map(|person| person["observations"].as_f64().unwrap()).sum()
}

#[test]
fn habits_are_learned_once_over_kills_and_damage() {
    const WALK: &str = "They open the fridge.\nThey grab the kettle.\nThey sit on the sofa.\nThey go to bed.\n";
    let mut world = World::new("habits");
    let config = world.directory.path().join("roomcast.toml");
    std::fs::write(&config, "[habits]\nsave_s = 1.0\n").unwrap();
    let (config, state) = (config.to_str().unwrap().to_owned(), world.state());
    let start = |world: &mut World| world.start(&["daemon", "--config", &config, "--state", state.to_str().unwrap()]);
    let file = world.state().join("roomcast.db");
    let database = || Connection::open(&file).unwrap();
    let is_written = || database().query_row("SELECT count(*) > 0 FROM habit", [], |row| row.get::<_, bool>(0));
    let mut daemon = start(&mut world);
    assert_eq!(world.narrate("one", WALK).0, 0);
    let once = eventually("it is learned", || Some(learned(&world)).filter(|learned| *learned > 2.0));
    for number in 2..5_u32 {
        // Kills before and after a save.
        if number % 2 == 0 {
            eventually("it is written", || is_written().unwrap_or_default().then_some(()));
        }
        world.end(daemon, Signal::KILL);
        daemon = start(&mut world);
        assert_eq!(learned(&world), f64::from(number - 1) * once);
        assert_eq!(world.narrate(&format!("walk-{number}"), WALK).0, 0);
        eventually("all is learned", || (learned(&world) == f64::from(number) * once).then_some(()));
    }
    world.stop(daemon);
    daemon = start(&mut world);
    assert_eq!(learned(&world), 4.0 * once);

    // Damaged habits are learned again from the events.
    world.end(daemon, Signal::KILL);
    database().execute("UPDATE habit SET touched_min = touched_min + 1", []).unwrap();
    daemon = start(&mut world);
    assert_eq!(learned(&world), 4.0 * once);
    // Forgotten habits stay forgotten over a kill.
    assert_eq!(habits(&world, &["forget", "--person", "eve"]).0, 3);
    let (code, _, errors) = habits(&world, &["forget", "--all"]);
    assert_eq!((code, learned(&world)), (0, 0.0), "{errors}");
    world.signal(daemon, Signal::KILL);
    let (_, log) = world.wait(daemon);
    assert!(log.contains("the habits in the state database cannot be used"), "{log}");
    start(&mut world);
    assert_eq!(learned(&world), 0.0);
}

#[test]
fn imported_habits_change_the_forecast_until_they_are_forgotten() {
    use roomcast_core::habits::{Habits, HabitsOptions, Place};
    const PERSON: PersonId = PersonId(3);
    // The teacher alternates all day: ten minutes in the living room, ten minutes in the kitchen.
    let mut teacher = Habits::new(HabitsOptions::default());
    let rooms = ["kitchen", "living room", "bathroom"].map(str::to_owned).to_vec();
    teacher.bind(vec!["sofa".to_owned()], rooms, vec![0.0, 1.0, 0.0]);
    let now_s = roomcast_ipc::clock::unix_ns() as f64 / 1e9;
    for minute in 0..4 * 1_440_u32 {
        let at_s = now_s - 5.0 * 86_400.0 + 60.0 * f64::from(minute);
        teacher.be(PERSON, Place::Room(usize::from(minute / 10 % 2 == 0)), at_s);
        teacher.tick(PERSON, at_s, &mut |_, p| p.fill(0.25));
    }
    let mut world = World::new("import");
    let export = world.directory.path().join("export.json");
    std::fs::write(&export, teacher.to_json().unwrap()).unwrap();
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let forecasts = node.subscriber::<PersonForecastsV1>().unwrap();
    let narration = node.publisher::<NarrationV1>().unwrap();
    scores_with(&scores, "the first scores", |_| true);
    let mut number = 0;
    // The forecast for the kitchen in 15 minutes.
    let mut kitchen = || {
        number += 1;
        let message = NarrationV1::new(narration_kind::SENTENCE, "They sit on the sofa.").unwrap();
        let source = sequence::source_of_name("test");
        narration.send(&NarrationV1 { source, epoch: 1, sequence: number, person: PERSON.0, ..message }).unwrap();
        let told = scores_with(&scores, "it is scored", |scores| includes(scores, "test", number));
        let forecast = eventually("the forecast", || {
            forecasts.newest().unwrap().filter(|forecast| forecast.sequence >= told.sequence)
        });
        let room = forecast.rooms().position(|room| room == "kitchen").unwrap();
        let horizon = forecast.horizon_s.iter().position(|horizon_s| *horizon_s == 900.0).unwrap();
        let own = forecast.persons()[0];
        let all: f32 = own.elsewhere[horizon] + own.probability.iter().map(|row| row[horizon]).sum::<f32>();
        assert!((all - 1.0).abs() < 1e-4, "{all}");
        own.probability[room][horizon]
    };
    let before = kitchen();
    let (code, _, errors) = habits(&world, &["import", export.to_str().unwrap()]);
    assert_eq!(code, 0, "{errors}");
    let known = kitchen();
    assert!(known > before + 0.2 && known > 0.6, "{before} {known}");
    let (_, answer, _) = habits(&world, &["show", "--json"]);
    let shipped = answer["persons"][0]["forecast"][1]["shipped"].as_f64().unwrap();
    assert!(shipped < 0.5, "{answer}");
    // In four days each of the two rooms was left every twenty minutes. Past visits count nearly as much as new ones.
    let visits = |room: usize| {
        let line = &answer["visits"][room];
        (line["room"].as_str().unwrap(), line["by_part"].as_array().unwrap().iter().map(|n| n.as_f64().unwrap()).sum())
    };
    let rooms: [(&str, f64); 3] = [visits(0), visits(1), visits(2)];
    assert!(rooms.iter().all(|(room, count)| (270.0..=292.0).contains(count) == (*room != "bathroom")), "{rooms:?}");
    let copy = world.directory.path().join("copy.json");
    assert_eq!(habits(&world, &["export", copy.to_str().unwrap()]).0, 0);
    assert!(std::fs::read_to_string(&copy).unwrap().contains("living room"));
    assert_eq!(habits(&world, &["export", copy.to_str().unwrap()]).0, 3, "a file is not overwritten");
    std::fs::write(&copy, "{}").unwrap();
    let (code, _, errors) = habits(&world, &["import", copy.to_str().unwrap()]);
    assert!(code == 3 && errors.contains("the daemon changed nothing"), "{errors}");
    assert!(kitchen() > 0.6);

    // If a person is forgotten, their habits are forgotten too.
    let output = world.command(&["person", "forget", "3"]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let after = kitchen();
    assert!((after - before).abs() < 0.15, "{before} {after}");
    world.stop(daemon);
}

#[test]
fn habits_are_learned_from_lines_with_times() {
    let mut world = World::new("learn");
    world.start_daemon();
    assert_eq!(world.narrate("camera", "They open the fridge.\n").0, 0);
    eventually("it is learned", || (learned(&world) == 1.0).then_some(()));
    let day = |day: u32| {
        let at_s = f64::from(day).mul_add(86_400.0, 1_709_280_900.0);
        let line = |at_s: f64, text: &str| format!(r#"{{"text": "{text}", "observed_unix_s": {at_s}, "person": 3}}"#);
        [line(at_s, "They sit on the sofa."), line(at_s + 900.0, "They open the fridge.")].join("\n")
    };
    let file = world.directory.path().join("days.jsonl");
    let ahead = r#"{"text": "They sit on the sofa.", "observed_unix_s": 4e9, "person": 3}"#;
    let lines = (0..5).map(day).collect::<Vec<_>>().join("\n") + "\nThey have no time.\n\n" + ahead;
    std::fs::write(&file, lines).unwrap();
    let (code, _, errors) = habits(&world, &["learn", file.to_str().unwrap()]);
    let said = errors.contains("line 11: it has no time") && errors.contains("line 13: its time lies");
    assert!(code == 3 && said && errors.contains("2 lines left out"), "{errors}");
    assert_eq!(learned(&world), 11.0);
    std::fs::write(&file, "They sit on the sofa.\n").unwrap();
    assert_eq!(habits(&world, &["learn", file.to_str().unwrap()]).0, 3);
    assert_eq!(habits(&world, &["learn"]).0, 2);
    assert_eq!(learned(&world), 11.0);
}

#[test]
fn habits_are_learned_from_a_recording_and_from_days() {
    let mut world = World::new("learn-days");
    let daemon = world.start_daemon();
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let file = world.directory.path().join("day.mcap");
    let recorder = world.start(&["record", file.to_str().unwrap()]);
    recorder_listens(&node);
    assert_eq!(world.narrate("camera", "They open the fridge.\nThey sit on the sofa.\n").0, 0);
    eventually("it is learned", || (learned(&world) == 2.0).then_some(()));
    world.stop(recorder);
    assert_eq!(habits(&world, &["forget", "--all"]).0, 0);
    assert_eq!(learned(&world), 0.0);
    let (code, _, errors) = habits(&world, &["learn", "--recording", file.to_str().unwrap()]);
    assert_eq!((code, learned(&world)), (0, 2.0), "{errors}");

    let days = world.directory.path().join("days");
    std::fs::create_dir(&days).unwrap();
    for day in 0..3 {
        let text = "### breakfast-00.txt\n[OPEN] <fridge> (305) [1]\n420.0\n[SIT] <sofa> (368) [2]\n430.5\n";
        std::fs::write(days.join(format!("{day:03}.txt")), text).unwrap();
    }
    let days = days.to_str().unwrap();
    let learn = ["learn", "--days", days, "--first-day", "2024-03-04", "--person", "3"];
    let (code, _, errors) = habits(&world, &learn);
    assert_eq!((code, learned(&world)), (0, 8.0), "{errors}");
    let (_, answer, _) = habits(&world, &["show", "--json"]);
    let of = |person: u64| answer["persons"].as_array().unwrap().iter().find(|own| own["person"] == person).cloned();
    assert_eq!(of(3).unwrap()["observations"], 6.0, "{answer}");
    assert_eq!(habits(&world, &["learn", "--days", days, "--first-day", "soon"]).0, 2);
    // Future events are not learned. A sensor log in seconds instead of milliseconds is refused.
    let (code, _, errors) = habits(&world, &["learn", "--days", days, "--first-day", "2200-01-01"]);
    assert!(code == 3 && errors.contains("day 1, action 1: its time lies"), "{errors}");
    let (log, rules) = (world.directory.path().join("log.tsv"), world.directory.path().join("rules.toml"));
    std::fs::write(&rules, "[[rule]]\nsay = \"They open the {sensor}.\"\n").unwrap();
    let learn = |text: &str| {
        std::fs::write(&log, text).unwrap();
        habits(&world, &["learn", "--sensors", log.to_str().unwrap(), "--rules", rules.to_str().unwrap()])
    };
    let (code, _, errors) = learn("2200-03-01 08:00:00\t2200-03-01 08:00:08\tfridge\t-\t-\n100\t105\tfridge\t-\t-\n");
    assert!(code == 3 && errors.contains("line 1: its time lies") && errors.contains("1 line left out"), "{errors}");
    assert_eq!(learned(&world), 9.0);
    let (code, _, errors) = learn("1709280900000\t1709280905000\tfridge\t-\t-\n");
    assert!(code == 3 && errors.contains("milliseconds"), "{errors}");
    assert_eq!(learned(&world), 9.0);
    drop((scores, node));
    world.stop(daemon);
    let daemon = world.start_daemon();
    assert_eq!(learned(&world), 9.0);
    assert_eq!(habits(&world, &["learn", "--days", world.state().to_str().unwrap()]).0, 3);
    world.stop(daemon);
}
