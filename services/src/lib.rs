//! Roomcast's processes: the daemon that scores rooms, the planner that sends the robot elsewhere, and narrators.
//!
//! Data flows one way: a narrator publishes events, the daemon publishes room scores, the planner publishes decisions. The deciding parts
//! ([`daemon::Intake`], [`daemon::Engine`], [`planner::Planner`]) are separate from threads, ports and clocks, so that faults can be
//! simulated.
//!
//! The crate is the program's library: its signatures contain types of its dependencies (`crossbeam`, `rumqttc`, `sd-notify`). Other
//! programs build on `roomcast-ipc` and `roomcast-core`.
//!
//! ```
//! use roomcast_services::config::Config;
//!
//! let config: Config = toml::from_str("[planner]\nroom_time_s = 60.0")?;
//! config.check()?;
//! assert_eq!(config.planner.room_time_s, 60.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

// A module uses only those above it. The empty lines keep rustfmt from sorting them.
pub mod clock;

pub mod logging;

pub use roomcast_ipc::stop;

pub mod notify;

pub mod config;

pub mod embedded;

pub mod no_model;

pub mod setup;

pub mod state_file;

mod kept;

pub mod slug;

pub mod message_text;

pub mod token_bucket;

mod awake;

mod power;

pub mod receive;

pub mod moment;

pub mod daemon;

mod line;

mod condition;

mod rule;

pub mod narrator;

pub mod dry_run;

pub mod sensor_log;

#[cfg(feature = "mqtt")]
pub mod mqtt;

pub mod planner;

pub mod participant;

pub mod reporter;

#[cfg(feature = "mqtt")]
pub mod vacuum;

#[cfg(feature = "recording")]
pub mod recording;

pub mod habits_reason;
pub mod lessons;

#[cfg(all(test, feature = "mqtt"))]
#[path = "../../tests/support/skipped.rs"]
mod skipped;

#[cfg(all(test, feature = "mqtt"))]
#[path = "../../tests/support/mosquitto.rs"]
#[expect(clippy::unwrap_used, reason = "a panic in a test is the report")]
mod mosquitto;

#[cfg(all(test, feature = "mqtt"))]
#[path = "../../tests/support/fake_valetudo.rs"]
#[expect(dead_code, reason = "a test needs some of it")]
#[expect(clippy::unwrap_used, reason = "a panic in a test is the report")]
mod fake_valetudo;

#[cfg(all(test, feature = "mqtt"))]
#[path = "../../tests/support/lived_day.rs"]
mod lived_day;

#[cfg(test)]
#[path = "../../tests/support/household.rs"]
mod household;

#[cfg(test)]
#[path = "../../tests/support/fleet_day.rs"]
mod fleet_day;

#[cfg(test)]
#[path = "../../tests/support/eventually.rs"]
mod eventually;
