//! The simulated home: activity programs, the person, the robot.

pub mod binding;
pub mod homer;
