//! The contract against real shared memory and against C: one program.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a panic in a test is the report")]

mod c_header;
mod clock;
#[path = "../../../tests/support/eventually.rs"]
mod eventually;
mod front_door;
mod killed;
mod ports;
#[path = "../../../tests/support/skipped.rs"]
mod skipped;

use roomcast_ipc::Domain;

/// A domain that is removed on drop, also if the test fails.
struct Private {
    domain: Domain,
    _root: tempfile::TempDir,
}

impl Private {
    fn new(name: &str) -> Self {
        let root = tempfile::Builder::new().prefix("rc-").tempdir_in("/tmp").unwrap();
        let name = format!("{name}-{}", std::process::id());
        Self { domain: Domain::new(root.path(), &name).unwrap(), _root: root }
    }
}

impl Drop for Private {
    fn drop(&mut self) {
        self.domain.clean_up().unwrap();
    }
}
