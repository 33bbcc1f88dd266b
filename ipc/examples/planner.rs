//! A planner: sends the robot to the room that is least likely to be occupied in a minute, and stops it while nothing is known of the persons.

use std::time::Duration;

use roomcast_ipc::{Domain, Error};

fn main() -> Result<(), Error> {
    let mut planner = Domain::for_user()?.planner("example-planner")?;
    loop {
        let known = planner.next_forecast(Duration::from_secs(2))?.filter(|forecast| forecast.is_known());
        let Some(forecast) = known else {
            planner.pause("no forecast, or no person was observed yet")?;
            continue;
        };
        let soon = Duration::from_secs(60);
        let rooms = forecast.rooms().filter_map(|room| Some((room.to_owned(), forecast.occupied(room, soon)?)));
        let Some((calmest, p)) = rooms.min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        println!("go to {calmest}: occupied in a minute with {:.0} %", 100.0 * p);
        planner.decide(&calmest, "it is the calmest room")?;
    }
}
