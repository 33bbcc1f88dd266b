//! The narrator, planner and robot of the crate's first page, against a stand-in for the daemon.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use roomcast_ipc::raw::{ForecastV1, NarrationV1, RobotReportV1, RoomScoresV1, report_kind};
use roomcast_ipc::{Action, Error, Node, Who, clock, question, text};

use crate::Private;
use crate::eventually::PATIENCE;

fn forecast(sequence: u64, kitchen: f32) -> ForecastV1 {
    let mut forecast = ForecastV1 { epoch: 9, sequence, room_count: 2, horizon_count: 1, ..ForecastV1::default() };
    (forecast.computed_ns, forecast.published_ns) = (clock::monotonic_ns(), clock::monotonic_ns());
    for (room, (id, probability)) in [("kitchen", kitchen), ("hall", 0.25)].into_iter().enumerate() {
        forecast.id[room] = text::encode("room id", id).unwrap();
        forecast.probability[room][0] = probability;
    }
    forecast
}

/// Confirms all events like the daemon, until `stop`.
fn confirm(node: &Node, stop: &AtomicBool) -> Vec<NarrationV1> {
    let (heard, scores) = (node.subscriber::<NarrationV1>().unwrap(), node.publisher::<RoomScoresV1>().unwrap());
    let answers = node.answer_port(question::PERSON).unwrap();
    let mut all: Vec<NarrationV1> = Vec::new();
    let start = Instant::now();
    while !stop.load(Ordering::Relaxed) && start.elapsed() < PATIENCE {
        heard.wait(Duration::from_millis(20)).unwrap();
        while let Some(narration) = heard.receive().unwrap() {
            all.push(narration);
            let mut message =
                RoomScoresV1 { epoch: 9, sequence: all.len() as u64, room_count: 1, ..Default::default() };
            message.room[0].id = text::encode("room id", "kitchen").unwrap();
            message.source_count = 1;
            message.included[0].source = narration.source;
            message.included[0].epoch = narration.epoch;
            message.included[0].sequence = narration.sequence;
            message.included[0].accepted = narration.sequence;
            scores.send(&message).unwrap();
        }
        scores.tick().unwrap();
        let last = all.last().map_or(0, |narration| narration.sequence);
        let understood = format!(
            r#"{{"done": true, "kept": false, "persons": [], "understood": [{{"sequence": {last}, "event": "did",
                "persons": [{{"person": 1, "name": "ada"}}], "by": "key", "place": "fridge", "presence": "present"}}]}}"#
        );
        answers.answer(|_| understood.clone()).unwrap();
    }
    all
}

#[test]
fn a_narrators_events_are_confirmed_with_the_daemons_understanding_of_them() {
    let private = Private::new("narrates");
    let node = private.domain.open("daemon").unwrap();
    let stop = AtomicBool::new(false);
    let heard = std::thread::scope(|scope| {
        let daemon = scope.spawn(|| confirm(&node, &stop));
        let mut camera = private.domain.narrator("hall-camera").unwrap();
        camera.present("ada", Some("kitchen")).unwrap();
        let understood = camera.did("ada", "opens the fridge").unwrap().confirmed(PATIENCE).unwrap();
        assert_eq!((understood.sequence, understood.place.as_deref()), (2, Some("fridge")));
        assert_eq!((camera.under_way(), camera.dropped()), (0, 0));
        camera.close().unwrap();
        stop.store(true, Ordering::Relaxed);
        daemon.join().unwrap()
    });
    let said: Vec<_> = heard.iter().map(|event| (event.sequence, event.text(), event.person_name())).collect();
    assert_eq!(said, [(1, "present in the kitchen", "ada"), (2, "ada opens the fridge.", "ada")]);
    assert!(heard.iter().all(|event| event.source_name() == "hall-camera" && event.observed_ns > 0));
}

#[test]
fn a_narrator_without_a_daemon_learns_that_no_process_received_the_event() {
    let private = Private::new("alone");
    let mut camera = private.domain.narrator("hall-camera").unwrap();
    let said = camera.say("They grab the mug.").unwrap();
    assert_eq!(said.receivers(), 0);
    let error = said.confirmed(Duration::from_millis(50)).unwrap_err();
    assert!(matches!(error, Error::NotIncluded { under_way: 1, sent: 1, .. }), "{error}");
    assert!(format!("{error:?}").contains("does the daemon run in this domain?"), "main() shows the remedy");
    assert!(matches!(camera.did("nobody", "sits"), Err(Error::Argument(_))));
    assert!(matches!(camera.did(Who::Somebody, " . "), Err(Error::Argument(_))));
    assert!(matches!(camera.empty(""), Err(Error::Argument(_))));
    let mut planner = private.domain.planner("robot").unwrap();
    assert!(matches!(planner.decide("", "a reason"), Err(Error::Argument(_))));
    assert!(matches!(private.domain.robot(" "), Err(Error::Argument(_))));
}

#[test]
fn a_planners_decision_reaches_its_robot_and_the_report_names_the_decision() {
    let private = Private::new("decides");
    let node = private.domain.open("daemon").unwrap();
    let forecasts = node.publisher::<ForecastV1>().unwrap();
    let reports = node.subscriber::<RobotReportV1>().unwrap();
    let mut planner = private.domain.planner("robot").unwrap();
    let mut robot = private.domain.robot("robot").unwrap();
    let mut other = private.domain.robot("other-robot").unwrap();

    assert_eq!(forecasts.send(&forecast(1, 0.75)).unwrap(), 1);
    let seen = planner.next_forecast(PATIENCE).unwrap().unwrap();
    assert_eq!(seen.occupied("kitchen", Duration::ZERO), Some(0.75));
    let unknown = planner.decide("cellar", "it is quiet").unwrap_err();
    assert!(unknown.to_string().contains("kitchen, hall"), "{unknown}");
    assert_eq!(planner.decide("hall", "it is quiet").unwrap(), 2);

    let decision = robot.next(PATIENCE).unwrap().unwrap();
    assert_eq!((decision.action(), decision.room(), decision.robot()), (Action::Go, "hall", "robot"));
    assert_eq!((decision.reason(), decision.raw().probability), ("it is quiet", 0.25));
    assert!(other.next(Duration::from_millis(50)).unwrap().is_none());

    robot.started().unwrap();
    robot.failed("the door is closed").unwrap();
    let (_, failed) = (reports.receive().unwrap().unwrap(), reports.receive().unwrap().unwrap());
    assert_eq!((failed.kind, failed.room(), failed.note()), (report_kind::FAILED, "hall", "the door is closed"));
    assert_eq!((failed.decision_sequence, failed.sequence), (1, 2));

    planner.pause("a person is in the way").unwrap();
    assert_eq!(robot.next(PATIENCE).unwrap().unwrap().action(), Action::Pause);
}

#[test]
fn a_follower_gets_each_forecast_once_and_drops_malformed_ones() {
    let private = Private::new("follows");
    let node = private.domain.open("daemon").unwrap();
    let publisher = node.publisher::<ForecastV1>().unwrap();
    let mut forecasts = private.domain.forecasts().unwrap();
    let first = forecast(1, 0.5);
    publisher.send(&first).unwrap();
    publisher.send_unchecked(&ForecastV1 { room_count: 99, ..first }).unwrap();
    let heard = forecasts.next().unwrap().unwrap();
    assert_eq!(heard.rooms().collect::<Vec<_>>(), ["kitchen", "hall"]);
    assert!(forecasts.next_within(Duration::from_millis(50)).unwrap().is_none());
    assert_eq!(forecasts.malformed(), 1);
}
