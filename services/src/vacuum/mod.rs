//! Drives a real vacuum: the planner's decisions become commands, and the robot's messages become reports to the planner.
//!
//! [`Driver`] decides, apart from ports and clocks. [`Dialect`] knows the messages of robots: Valetudo's topics, or Home Assistant's, which
//! can call the services of any vacuum that it has. [`run()`] joins them with the domain and the broker.

mod dialect;
mod driver;
mod rooms;
mod run;

pub use dialect::{Dialect, Order, Sensed, Status};
pub use driver::{Act, Driver};
pub use rooms::{by_ids, segment_of};
pub use run::{DriveError, Way, run};
