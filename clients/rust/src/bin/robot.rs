//! Follows its decisions, and reports. The work is ten steps in one second, and a decision can end it between two of them.

use std::time::Duration;

use roomcast_ipc::{Action, Domain, Error};

fn main() -> Result<(), Error> {
    let mut robot = Domain::for_user()?.robot("robot")?;
    let (mut room, mut left) = (String::new(), 0);
    loop {
        // At work the robot only looks for a decision.
        let patience = if left > 0 { Duration::ZERO } else { Duration::MAX };
        if let Some(decision) = robot.next(patience)? {
            println!("{} {}: {}", decision.action(), decision.room(), decision.reason());
            match decision.action() {
                Action::Go | Action::Stay if left > 0 && decision.room() == room => {}
                // The planner asks for the outcome of earlier work: this robot does not remember it.
                Action::Go if decision.is_owed() => {
                    left = 0;
                    robot.failed("the robot was restarted")?;
                }
                Action::Go => {
                    decision.room().clone_into(&mut room);
                    left = 10;
                    robot.started()?;
                }
                Action::Pause => {
                    left = 0;
                    robot.docked(None)?;
                }
                _ => left = 0,
            }
        }
        if left > 0 {
            std::thread::sleep(Duration::from_millis(100));
            left -= 1;
            if left == 0 {
                robot.finished()?;
            }
        }
    }
}
