use std::path::Path;

use roomcast_zenoh::{ask, config, habits, inward, line, link, peers, relay, ros2, spool, wire};

#[test]
fn the_page_states_the_limits_of_the_code() {
    let page = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/fleet.md")).unwrap();
    for (what, most) in [
        ("narrators elsewhere, each with a port of its own", config::NARRATORS_MAX.to_string()),
        ("bytes of any message", link::MESSAGE_BYTES_MAX.to_string()),
        ("bytes of a narration's message", wire::BYTES_MAX.to_string()),
        ("messages of hubs that wait", inward::HEARD_MAX.to_string()),
        (
            "narrations of a hub that wait at the robot, and that are under way to the daemon",
            format!("{} and {}", relay::WAITING_MAX, relay::UNDER_WAY_MAX),
        ),
        ("numbers that a start of a hub gives up because a robot has them", spool::TAKEN_MAX.to_string()),
        ("robots of a hub", config::ROBOTS_MAX.to_string()),
        ("other robots that are followed", peers::PEERS_MAX.to_string()),
        ("bytes of a robot's counts of habits", habits::BYTES_MAX.to_string()),
        ("questions that wait", ask::WAITING_MAX.to_string()),
        ("bytes of a line of a hub", line::LINE_BYTES_MAX.to_string()),
        ("bytes of a configuration", config::FILE_BYTES_MAX.to_string()),
        ("cells of a map of ROS 2", ros2::mask::CELLS_MAX.to_string()),
    ] {
        assert!(page.contains(&format!("| {what} | {most} |")), "{what}: {most}");
    }
}
