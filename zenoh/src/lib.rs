//! Connects Roomcast to other machines over zenoh. The robot itself uses shared memory, and its daemon has no socket: this bridge is a separate
//! participant.
//!
//! ```text
//! hub: lines -> spool -> [router] -> inward -> daemon            the hub keeps what the daemon has not confirmed
//!                        [router] <- outward <- scores, forecasts, decisions
//! operator: watch     <- [router]
//! ```

pub use roomcast_ipc::stop;

pub mod config;
pub mod delay;
pub mod delivery;
pub mod keys;
pub mod limiter;
pub mod line;
pub mod relay;
pub mod spool;
pub mod wire;

pub mod told;

pub mod link;

pub mod ros2;

pub mod ask;
pub mod inward;
pub mod namesake;
pub mod outward;
pub mod peers;
pub mod understood;

pub mod habits;

pub mod hub;
pub mod robot;
pub mod watch;

#[cfg(test)]
#[path = "../../tests/support/eventually.rs"]
mod eventually;
