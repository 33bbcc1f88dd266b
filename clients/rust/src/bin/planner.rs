//! Sends a robot to the room that is least likely to be occupied in a minute, and stops it while nothing is known of the persons.

use std::time::Duration;

use roomcast_ipc::{Domain, Error};

const SOON: Duration = Duration::from_secs(60);
/// The daemon publishes four forecasts a second. After this time without one it does not run.
const SILENT: Duration = Duration::from_secs(2);

fn main() -> Result<(), Error> {
    let mut planner = Domain::for_user()?.planner("robot")?;
    let mut ordered: Option<String> = None;
    loop {
        let known = planner.next_forecast(SILENT)?.filter(|forecast| forecast.is_known());
        let Some(forecast) = known else {
            if ordered.take().is_some() {
                planner.pause("no forecast, or no person was observed yet")?;
            }
            continue;
        };
        let rooms = forecast.rooms().filter_map(|room| Some((room.to_owned(), forecast.occupied(room, SOON)?)));
        let Some((calmest, p)) = rooms.min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
        if ordered.as_ref() != Some(&calmest) {
            planner.decide(&calmest, &format!("occupied in a minute with {:.0} %", 100.0 * p))?;
            println!("go to {calmest}: occupied in a minute with {:.0} %", 100.0 * p);
            ordered = Some(calmest);
        }
    }
}
