//! Receives messages from a port one after the other, and logs malformed ones.

use roomcast_ipc::raw::Message;
use roomcast_ipc::{IpcError, Subscriber};

use crate::clock;
use crate::logging::Limiter;

/// Takes the next good message, if any. Malformed ones are skipped, and logged as often as `log` allows.
///
/// # Errors
/// [`IpcError::Port`] when the port fails.
pub fn receive<M: Message>(port: &Subscriber<M>, message: &mut M, log: &mut Limiter) -> Result<bool, IpcError> {
    while let Some((checked, _)) = port.receive_from(message)? {
        let Err(error) = checked else { return Ok(true) };
        if let Some(not_told) = log.pass(clock::monotonic_ns()) {
            tracing::warn!(%error, not_told, service = M::SERVICE.name, "malformed message");
        }
    }
    Ok(false)
}
