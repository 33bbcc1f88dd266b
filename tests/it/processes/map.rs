use std::process::Command;

use roomcast_ipc::raw::RoomScoresV1;
use rustix::process::Signal;

use super::{MOVED, World, apply, exit_code, includes, probabilities, scores_with};

#[test]
fn the_map_of_a_running_daemon_changes_without_a_restart_and_without_the_model() {
    let mut world = World::new("changes");
    let daemon = world.start_daemon();
    assert_eq!(world.narrate("camera", "They walk to the kitchen.\nThey open the fridge.\n").0, 0);
    let node = world.domain.open("test").unwrap();
    let scores = node.subscriber::<RoomScoresV1>().unwrap();
    let before = scores_with(&scores, "scores", |scores| includes(scores, "camera", 2));

    // The fridge moves from the kitchen to the main room. Labels are regrouped and the model decodes no tokens.
    let (code, answer, error) = apply(&world, MOVED, &[]);
    assert_eq!((code, answer["new_labels"].as_u64()), (0, Some(0)), "{answer} {error}");
    let after =
        scores_with(&scores, "scores of the new map", |scores| scores.map_fingerprint != before.map_fingerprint);
    assert_eq!(after.epoch, before.epoch, "the same daemon");
    assert_eq!((after.tokenise_ns, after.prefix_ns, after.trie_ns), (0, 0, 0), "nothing was decoded");
    assert!(after.sequence > answer["sequence"].as_u64().unwrap() && includes(&after, "camera", 2));
    let (old, new) = (probabilities(&before), probabilities(&after));
    assert!(new["main-room"] > old["main-room"] + 0.01 && new["kitchen"] < old["kitchen"], "{old:?} {new:?}");

    // The same change in the scene file gives the same map and the same scores.
    let file = world.directory.path().join("changed.json");
    let changes = world.directory.path().join("changes.json");
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
    let changed = command.args(["scene", "change", "studio"]).arg(&changes).arg("--out").arg(&file).output().unwrap();
    assert!(changed.status.success(), "{changed:?}");
    let mut command = Command::new(env!("CARGO_BIN_EXE_roomcast"));
    command.args(["score", "--json", "--narration", "They walk to the kitchen. They open the fridge.", "--scene"]);
    let once: serde_json::Value = serde_json::from_slice(&command.arg(&file).output().unwrap().stdout).unwrap();
    for room in once["partitions"].as_array().unwrap() {
        let probability = room["probability"].as_f64().unwrap();
        assert!((probability - new[room["id"].as_str().unwrap()]).abs() < 5e-3, "{once} {new:?}");
    }

    // A new label in a new room: the running daemon prepares the model for it.
    let room = r#"[{"change": "add-room", "room": {"id": "garage", "label": "garage",
        "box": {"min_m": [7, 0, 0], "max_m": [10, 3, 2.5]}}, "doors": [{"id": "k-g", "rooms": ["kitchen", "garage"], "position_m": [6.9, 1, 1]}]},
        {"change": "add-item", "item": {"id": "unicycle-1", "label": "unicycle", "position_m": [8, 1, 0.5],
        "box": {"min_m": [7.8, 0.8, 0], "max_m": [8.2, 1.2, 1]}}}]"#;
    let (code, answer, error) = apply(&world, room, &["--expect", answer["map"].as_str().unwrap()]);
    assert_eq!(
        (code, answer["new_labels"].as_u64(), answer["rooms"].as_u64()),
        (0, Some(2), Some(4)),
        "{answer} {error}"
    );
    let with_garage = scores_with(&scores, "scores with a garage", |scores| scores.room_count == 4);
    let garage = with_garage.rooms().iter().find(|room| room.id() == "garage").unwrap();
    assert!(garage.probability > 0.0 && garage.log_score_nats.is_finite());
    assert!(includes(&with_garage, "camera", 2) && with_garage.window == before.window);

    let (code, answer, error) = apply(&world, r#"[{"change": "remove-room", "id": "garage"}]"#, &[]);
    assert_eq!((code, answer["rooms"].as_u64()), (0, Some(3)), "{answer} {error}");
    let without = scores_with(&scores, "scores without a garage", |scores| scores.room_count == 3);
    assert!(without.rooms().iter().all(|room| room.id() != "garage") && includes(&without, "camera", 2));
    let (code, answer, error) = apply(&world, room, &[]);
    assert_eq!((code, answer["rooms"].as_u64()), (0, Some(4)), "{answer} {error}");
    let with_garage = scores_with(&scores, "scores with a garage again", |scores| scores.room_count == 4);

    let (code, refused, error) = apply(&world, r#"[{"change": "remove-item", "id": "piano-1"}]"#, &[]);
    assert_eq!((code, &refused["map"]), (i32::from(exit_code::INPUT), &answer["map"]), "{error}");
    assert!(error.contains("there is no item \"piano-1\""), "{error}");
    let (code, refused, error) = apply(&world, MOVED, &["--expect", &"0".repeat(64)]);
    assert_eq!((code, &refused["outcome"]), (i32::from(exit_code::INPUT), &serde_json::json!("other-map")), "{error}");

    // A killed daemon starts again with the changed map.
    world.end(daemon, Signal::KILL);
    let daemon = world.start_daemon();
    let restarted = scores_with(&scores, "the new daemon's scores", |scores| scores.epoch != before.epoch);
    assert_eq!(restarted.map_fingerprint, with_garage.map_fingerprint);

    // A damaged database is set aside with the map; log and status say so.
    world.end(daemon, Signal::KILL);
    std::fs::write(world.state().join("roomcast.db"), "no database").unwrap();
    std::fs::remove_file(world.state().join("roomcast.db-wal")).unwrap();
    let daemon = world.start_daemon();
    let anew = scores_with(&scores, "scores without the database", |scores| {
        ![before.epoch, restarted.epoch].contains(&scores.epoch)
    });
    assert_eq!((anew.map_fingerprint, anew.included().len()), (before.map_fingerprint, 0));
    assert_eq!(world.status(&node).journal_failures, 1);
    world.signal(daemon, Signal::TERM);
    let (_, log) = world.wait(daemon);
    assert!(log.contains("roomcast.db.damaged-1") && log.contains("a changed map can be missing"), "{log}");
}
