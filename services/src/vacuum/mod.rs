//! A vacuum that obeys: the planner's decisions as orders to a real robot, and what the robot says of itself as reports to the planner.
//!
//! [`Driver`] decides, apart from ports and clocks. [`Dialect`] knows how robots speak: Valetudo's topics, or those of Home Assistant, which
//! calls the services of any vacuum that it has. [`run()`] joins them with the domain and the broker.

mod dialect;
mod driver;
mod rooms;
mod run;

pub use dialect::{Dialect, Order, Sensed, Status};
pub use driver::{Act, Driver};
pub use rooms::{by_ids, segment_of};
pub use run::{DriveError, Way, run};
