//! ROS 2, by the wire format of its middleware rmw_zenoh. Only standard message types are used, so no package has to be built.

pub mod mask;
pub mod node;
pub mod run;
