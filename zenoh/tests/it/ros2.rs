//! ROS 2 topics, checked by other implementations: keys and tokens by zenoh-ros2-sdk, hashes and messages by rosbags.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::support::{Robot, free_port, python, router, skipped};

#[test]
fn another_implementation_hears_every_topic_and_narrates() {
    let python = python().filter(|python| {
        let has = Command::new(python).args(["-c", "import zenoh_ros2_sdk, rosbags"]).output();
        has.is_ok_and(|output| output.status.success())
    });
    let Some(python) = python else {
        return skipped(
            "PyPI's zenoh-ros2-sdk and rosbags are not installed for the tests (`make zenoh` does, with a network)",
        );
    };
    let folder = tempfile::tempdir().unwrap();
    let port = free_port();
    let _router = router(folder.path(), &python, port);
    let _robot = Robot::start_with_ros2(folder.path(), port);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros2.py");
    let output = Command::new(python).arg(script).arg(port.to_string()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said: Value = serde_json::from_slice(&output.stdout).unwrap();
    let heard = &said["heard"];
    for topic in [
        "/roomcast/rooms",
        "/roomcast/rooms/in_60s",
        "/roomcast/person/ada",
        "/roomcast/person/ada/in_600s",
        "/roomcast/keepout_mask",
        "/roomcast/keepout_info",
        "/roomcast/markers",
        "/diagnostics",
    ] {
        // The mask's information for Nav2 is sent once, before any listener starts.
        let live = topic != "/roomcast/keepout_info";
        assert!(
            !live || heard[topic].is_object(),
            "{topic} was not heard: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        let last = topic != "/diagnostics";
        assert_eq!(said["kept"][topic].is_object(), last, "{topic} for who comes late");
    }
    let score = |topic: &str| -> f64 {
        let results = heard[topic]["results"].as_array().unwrap();
        results.iter().map(|result| result["score"].as_f64().unwrap()).sum()
    };
    assert!((score("/roomcast/person/ada") - 1.0).abs() < 1e-6, "a person is somewhere: {heard}");
    assert_eq!(heard["/roomcast/rooms"]["header"]["frame_id"], "map");
    let mask = &heard["/roomcast/keepout_mask"];
    let cells: Vec<i64> = mask["data"].as_array().unwrap().iter().map(|cell| cell.as_i64().unwrap()).collect();
    assert_eq!((cells.len(), &mask["info"]["width"]), (160 * 160, &160.into()));
    assert!(
        cells.iter().all(|cell| (0..=98).contains(cell)) && cells.iter().any(|cell| *cell > 0),
        "{:?}",
        cells.iter().max()
    );
    let info = &said["kept"]["/roomcast/keepout_info"];
    assert_eq!(
        (&info["filter_mask_topic"], &info["type"], &info["multiplier"]),
        (&"/roomcast/keepout_mask".into(), &0.into(), &1.0.into())
    );
    assert!(heard["/roomcast/markers"]["markers"].as_array().unwrap().len() >= 2);
    assert_eq!(heard["/diagnostics"]["status"][0]["message"], "rooms are scored");
    assert!(
        said["attachment_bytes"].as_object().unwrap().values().all(|bytes| *bytes == 33),
        "{}",
        said["attachment_bytes"]
    );
    assert_eq!(said["gid_lengths"], serde_json::json!([16]));
    let tokens: Vec<&str> = said["tokens"].as_array().unwrap().iter().map(|token| token.as_str().unwrap()).collect();
    let has = |part: &str| tokens.iter().any(|token| token.contains(part));
    assert!(
        has("/NN/%/%/roomcast") && has("/MS/%/%/roomcast/%roomcast%narration/std_msgs::msg::dds_::String_/RIHS01_"),
        "{tokens:?}"
    );
    assert!(tokens.iter().any(|token| token.contains("/MP/%/%/roomcast/%roomcast%keepout_mask/") && token.ends_with("/:1:,1:,:,:,,")), "{tokens:?}");
}
