//! ROS 2, by the wire format of its middleware rmw_zenoh: standard message types alone, so that nobody has to build a package of ours.

pub mod mask;
pub mod node;
pub mod run;
