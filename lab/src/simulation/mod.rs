//! The simulated home: activity programs, the person, the robot, and the best that a robot could do.

pub mod binding;
pub mod clairvoyant;
pub mod homer;
#[cfg(feature = "solver")]
pub mod mixed_integer;
pub mod timeline;
pub mod world;
