//! Roomcast in ROS 2's words: standard message types alone, their serialisation and their definitions, and what makes them of the messages
//! between Roomcast's processes. No clock, no network.
//!
//! ```
//! use roomcast_ros2::schema;
//! use roomcast_ros2::types::{Classification, Message, encode};
//!
//! assert_eq!(Classification::NAME, "vision_msgs/msg/Classification");
//! assert!(schema::of::<Classification>().starts_with("std_msgs/Header header\n"));
//! assert_eq!(encode(&Classification::default())?[..4], [0, 1, 0, 0]);
//! # Ok::<(), roomcast_ros2::types::CdrError>(())
//! ```

// A module uses only those above it. The empty lines keep rustfmt from sorting them.
pub mod types;

pub mod schema;

pub mod content;

pub mod markers;

pub mod words;
