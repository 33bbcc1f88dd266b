//! The client interface of `roomcast-ipc`, against a daemon.

use std::time::Duration;

use roomcast_ipc::{Error, MapChange, Sensor, SensorKind, Who};

use super::World;

const PATIENCE: Duration = Duration::from_secs(60);

#[test]
fn a_narrators_event_is_confirmed_and_the_daemon_answers_typed_questions() {
    let mut world = World::new("front");
    world.start_daemon();
    let domain = world.domain.clone();
    let mut camera = domain.narrator("hall-camera").unwrap();
    camera.present("ada", Some("kitchen")).unwrap();
    let understood = camera.did("ada", "opens the fridge").unwrap().confirmed(PATIENCE).unwrap();
    assert_eq!((understood.event.as_str(), understood.presence.as_str()), ("did", "present"), "{understood:?}");
    assert_eq!(understood.place.as_deref(), Some("fridge"), "{understood:?}");
    assert_eq!(understood.persons[0].name.as_deref(), Some("ada"), "{understood:?}");

    let persons = domain.persons(PATIENCE).unwrap();
    assert!(persons.iter().any(|person| person.name.as_deref() == Some("ada") && person.presence == "present"));
    assert!(
        domain.rename_person("nobody-here", "Bo", PATIENCE).is_err_and(|error| matches!(error, Error::NotGiven { .. }))
    );
    let moment = domain.moment(PATIENCE).unwrap();
    assert!(moment.narration.iter().any(|sentence| sentence.text.contains("fridge")), "{moment:?}");
    assert!(moment.labels.iter().all(|label| label.log_prob_nats.is_some_and(|nats| nats < 0.0)), "{moment:?}");
    assert!(moment.scene.is_object() && moment.version == 1);
    domain.habits(PATIENCE).unwrap();
    let refused = domain.change_map(&[MapChange::RemoveItem { id: "no-such-item".to_owned() }], PATIENCE);
    assert!(refused.is_err_and(|error| error.to_string().contains("no-such-item")));
    domain.status(PATIENCE).unwrap();

    // The forecast is about the present; the scores are about the next room.
    let mut forecasts = domain.forecasts().unwrap();
    let forecast = forecasts.next_within(PATIENCE).unwrap().unwrap();
    let kitchen = forecast.rooms().find(|room| room.contains("kitchen")).unwrap().to_owned();
    assert!(
        forecast.occupied(&kitchen, Duration::ZERO).unwrap() > 0.9,
        "{:?}",
        forecast.occupied(&kitchen, Duration::ZERO)
    );
    let motion = Sensor { room: Some("hall"), on: Some(true), ..Sensor::new(SensorKind::Motion, "hall-motion") };
    camera.sensor(Who::Somebody, &motion).unwrap();
    camera.wait_until_included(PATIENCE).unwrap();
    camera.close().unwrap();
}
