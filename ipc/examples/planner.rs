//! A planner in ten lines: prints the room where the robot disturbs least, whenever there are new scores.

use std::time::Duration;

use roomcast_ipc::{Domain, RoomScoresV1, clock};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node = Domain::default_for_user()?.open("example-planner")?;
    let scores = node.subscriber::<RoomScoresV1>()?;
    loop {
        scores.wait(Duration::from_millis(500))?;
        let Some(snapshot) = scores.newest()? else { continue };
        let calmest = snapshot.rooms().iter().min_by(|a, b| a.probability.total_cmp(&b.probability));
        let age_ms = snapshot.age_ns(clock::monotonic_ns()) / 1_000_000;
        println!("go to {} (scores are {age_ms} ms old)", calmest.map_or("nowhere", |room| room.id()));
    }
}
