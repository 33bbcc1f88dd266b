//! Sends a robot to the room that is least likely to be occupied in a minute.

use std::time::Duration;

use roomcast_ipc::{Domain, Error};

const SOON: Duration = Duration::from_secs(60);

fn main() -> Result<(), Error> {
    let mut planner = Domain::for_user()?.planner("robot")?;
    let mut room = String::new();
    while let Some(forecast) = planner.next_forecast(Duration::MAX)? {
        let rooms = forecast.rooms().filter_map(|room| Some((room.to_owned(), forecast.occupied(room, SOON)?)));
        let Some((calmest, p)) = rooms.min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        if room != calmest {
            planner.decide(&calmest, &format!("occupied in a minute with {:.0} %", 100.0 * p))?;
            println!("go to {calmest}: occupied in a minute with {:.0} %", 100.0 * p);
            room = calmest;
        }
    }
    Ok(())
}
