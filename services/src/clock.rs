//! The two clocks as typed values.

use roomcast_core::ids::{BootNs, UnixNs};

/// Now, by the clock for ages ([`roomcast_ipc::clock::monotonic_ns`]).
#[must_use]
pub fn monotonic_ns() -> BootNs {
    BootNs(roomcast_ipc::clock::monotonic_ns())
}

/// Now, by the wall clock ([`roomcast_ipc::clock::unix_ns`]).
#[must_use]
pub fn unix_ns() -> UnixNs {
    UnixNs(roomcast_ipc::clock::unix_ns())
}
