//! Follows its decisions, and reports. The work takes one second.

use std::time::Duration;

use roomcast_ipc::{Action, Domain, Error};

fn main() -> Result<(), Error> {
    let mut robot = Domain::for_user()?.robot("robot")?;
    while let Some(decision) = robot.next(Duration::MAX)? {
        println!("{} {}: {}", decision.action(), decision.room(), decision.reason());
        match decision.action() {
            // The planner asks what became of earlier work: this robot does not remember it.
            Action::Go if decision.is_owed() => robot.failed("the robot was restarted")?,
            Action::Go => {
                robot.started()?;
                std::thread::sleep(Duration::from_secs(1));
                robot.finished()?
            }
            Action::Pause => robot.docked(None)?,
            _ => 0,
        };
    }
    Ok(())
}
